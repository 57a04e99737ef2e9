"""Steps of a `World` in which no two bodies meet: `pgccd.resolve` over ranks.

A round is a detection on the shortened paths, as in `pgccd.resolution.search`: each rank shortens the paths of its own
bodies and sends ghosts anew, so that a body that stopped is known wherever others may reach it. The rank that tests a
pair tells the owners of its bodies, which apply the rule. The first round in which no rank slowed a body down is the
last.

The rounds of the nanorobot simulation keep the ghosts of the whole step, and agree on the first toi of every copy. That
suffices for arcs, which are shortened to a part of themselves; vertices on linear paths leave theirs.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import ClassVar, Generic, cast

import torch
from torch import Tensor

from pgccd.contacts.contacts import Contacts
from pgccd.distributed.comm.exchange import Columns
from pgccd.distributed.detection.ids import rows_of
from pgccd.distributed.detection.options import PassEstimates, SearchOptions
from pgccd.distributed.detection.report import columns_for_owners, tell_owners
from pgccd.distributed.detection.share import Share, search_share
from pgccd.distributed.halo.vertices import Vertices, vertex_counts
from pgccd.distributed.partition.decomposition import Decomposition
from pgccd.distributed.world.columns import columns_to_send
from pgccd.geometry.scene import Scene
from pgccd.motion.paths import RigidMotion, VertexMotion
from pgccd.resolution.results import M, Resolution
from pgccd.resolution.search import at_rest, shortened
from pgccd.resolution.slowing import SlowedBodies
from pgccd.resolution.stoppers import Stoppers
from pgccd.runtime.stages import StageClock
from pgccd.search.bodies import MovingBodies
from pgccd.search.passes import search_seconds


@dataclass(frozen=True, eq=False, repr=False)
class WorldResolution(Resolution[M], Generic[M]):
    """How far the N own bodies of a rank move in a step of a `World` such that none meets another.

    Values are equal to those of `pgccd.resolve`, to the bit, for any number of ranks; bodies are named by global ids.

    Attributes:
        motion, fraction, rounds: as of `pgccd.Resolution`, of this rank's own bodies.
        stopped_by: (N,) int64, global id of the body whose contact stopped this one; -1 where `fraction` is 1.
        touching_at_start, unresolved: (S, 2), (U, 2) int64 pairs of global ids i <= j, sorted, of which this rank owns
            a body; a pair of bodies of two ranks is listed on both.
        hits: the first contacts of these bodies on their whole paths, as from `World.step` with report="first" and
            nonzero_toi=True.
    """

    hits: Contacts

    _parts: ClassVar[tuple[str, ...]] = ("motion", "hits")


@dataclass
class ResolutionEstimates:
    """Capacity estimates of the searches after the first; owned by a `World`."""

    rounds: PassEstimates = field(default_factory=PassEstimates)
    check: PassEstimates = field(default_factory=PassEstimates)


def options_of_resolution(options: SearchOptions) -> SearchOptions:
    """Options of the search of the whole step and of rounds."""
    return replace(options, report="first", nonzero_toi=True)


def vertices_of(motion: RigidMotion | VertexMotion, scene: Scene) -> Vertices | None:
    """The vertices to send with the bodies of a scene, if they deform."""
    if isinstance(motion, RigidMotion):
        return None
    return Vertices(motion.columns(), vertex_counts(scene.meshes, scene.mesh_index))


@dataclass
class ResolvedStep(Generic[M]):
    """One step, to be resolved; all ranks call `resolve`.

    Args:
        whole: the first contacts on the whole paths, by `options_of_resolution`.
        scene: of this rank's own bodies.
        motion: their whole step.
        fixed: (N,) bool: bodies that may not be stopped; None: none.
        payload: columns (N, ...) that `hits` carry, see `tell_owners`.
        decomposition: of space.
        estimates: of capacities.
        clock: records stage times.
    """

    whole: Share
    scene: Scene
    motion: M
    fixed: Tensor | None
    payload: Columns
    decomposition: Decomposition
    estimates: ResolutionEstimates
    clock: StageClock

    def resolve(self) -> WorldResolution[M]:
        """Makes the rounds, and tests the shortened motion."""
        comm, options, device = self.decomposition.comm, self.whole.options, self.scene.device
        hits = tell_owners(self.whole, self.payload)
        assert isinstance(hits, Contacts)
        stoppers = Stoppers(self.scene.body_count, device)
        bodies = SlowedBodies(self.scene.body_count, device, self.fixed, stoppers)
        rounds, columns = 0, {"pairs": hits.pairs, "toi": hits.toi}
        while comm.any(self._slow_down(bodies, stoppers, rounds, columns)):
            rounds += 1
            motion = shortened(self.scene, self.motion, bodies.fraction)
            motion._is_trusted = True  # it is checked with the whole step
            share = self._search(motion, options, self.estimates.rounds, changed=bodies.changed)
            found = share.contacts
            assert isinstance(found, Contacts)
            columns = columns_for_owners(share, {"pairs": found.pairs, "toi": found.toi})
        made = cast(M, shortened(self.scene, self.motion, bodies.fraction))
        meeting, rest = self._check(made) if comm.any(len(hits) > 0) else (hits.pairs, hits.toi == 0.0)
        touching = torch.cat([hits.pairs[hits.toi == 0.0], meeting[rest]]).unique(dim=0)
        return WorldResolution(made, bodies.fraction, stoppers.by, touching, meeting[~rest], rounds, hits)

    def _slow_down(self, bodies: SlowedBodies, stoppers: Stoppers, round: int, columns: Columns) -> bool:
        """Applies the rule to the own bodies among contacts, given "pairs" in global ids and "toi". Returns whether a
        body has changed.
        """
        pairs, toi = columns["pairs"], columns["toi"]
        rows = rows_of(self.whole.held.own_id, pairs)
        for row in rows.unbind(1):
            bodies.lower(row, toi)
        for row, other in zip(rows.unbind(1), pairs.flip(1).unbind(1), strict=True):
            stoppers.find_of(row, other, toi, bodies.first)
        change = torch.zeros(1, dtype=torch.int64, device=toi.device)
        bodies.slow_down(round, change)
        return bool(change)

    def _check(self, made: M) -> tuple[Tensor, Tensor]:
        """The pairs (P, 2) of own bodies that are not proven free on the shortened motion, and which of these (P,) bool
        are at rest.
        """
        rest = at_rest(self.scene, made)
        options = replace(self.whole.options, report="any")
        share = self._search(made, options, self.estimates.check, marks={"rest": rest})
        of_held = torch.cat([rest, share.held.ghosts["rest"]]) if share.ghosts is not None else rest
        pairs = share.contacts.pairs
        columns = columns_for_owners(share, {"pairs": pairs, "rest": of_held[pairs].all(dim=1)})
        return columns["pairs"], columns["rest"]

    def _search(
        self,
        motion: RigidMotion | VertexMotion,
        options: SearchOptions,
        estimates: PassEstimates,
        marks: Columns | None = None,
        changed: Tensor | None = None,
    ) -> Share:
        with self.clock.stage("plan"):
            bodies = MovingBodies.of(self.scene, motion, wait=False)
        share, _ = search_share(
            self.decomposition,
            columns_to_send(self.whole.held.own_id, bodies) | (marks or {}),
            bodies,
            lambda ghosts: ghosts,
            options,
            estimates,
            beside=lambda _: None,
            vertices=vertices_of(motion, self.scene),
            clock=self.clock,
            changed=changed,
        )
        self.clock.add(search_seconds(share.contacts.stats))
        return share
