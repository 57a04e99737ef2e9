"""Steps of a `World` in which no two bodies meet: `pgccd.resolve` over ranks.

On arcs, each rank resolves all bodies that it holds, ghosts included. The ghosts of the whole step suffice, because a
shortened arc is a part of the whole one. In a round, a rank searches its share of the pairs that may meet at any two
times, and all ranks that hold a body agree on its first toi.

If the list of these pairs would be long, and on other paths, a round is a detection on the shortened paths, as in
`pgccd.resolution.search`: each rank shortens the paths of its own bodies and sends ghosts again. The rank that tests a
pair tells the owners of the two bodies, which apply the rule.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any, ClassVar, Generic, cast

import torch
from torch import Tensor

from pgccd.contacts.contacts import Contacts
from pgccd.distributed.comm.exchange import Columns
from pgccd.distributed.detection.ids import rows_of
from pgccd.distributed.detection.options import PassEstimates, SearchOptions
from pgccd.distributed.detection.replica_exchange import RankExchange, ReplicaExchange
from pgccd.distributed.detection.report import columns_for_owners, tell_owners
from pgccd.distributed.detection.share import Share, search_share
from pgccd.distributed.halo.local_bodies import LocalBodies
from pgccd.distributed.halo.vertices import Vertices, vertex_counts
from pgccd.distributed.partition.decomposition import Decomposition
from pgccd.distributed.steps.rank import Rank
from pgccd.distributed.world.input_checks import columns_to_send
from pgccd.geometry.scene import Scene
from pgccd.motion.paths import RigidMotion, VertexMotion
from pgccd.resolution.listed import ListedSearch, is_short
from pgccd.resolution.results import M, Resolution
from pgccd.resolution.round_plan import RoundPlan
from pgccd.resolution.rounds import Exchange, Found, RoundSearch, resolve_collisions
from pgccd.resolution.search import at_rest, shortened
from pgccd.resolution.stopped_by import StoppedBy
from pgccd.runtime.sizes import BufferSizes
from pgccd.runtime.stages import StageClock
from pgccd.search.bodies import MovingBodies
from pgccd.search.passes import SearchPass, pairs_of_rounds, search_seconds


@dataclass(frozen=True, eq=False, repr=False)
class WorldResolution(Resolution[M], Generic[M]):
    """How far the N own bodies of a rank move in a step of a `World` such that none meets another.

    Values equal those of `pgccd.resolve`, bit by bit, for any number of ranks. Bodies are named by global ids.

    Attributes:
        motion, fraction, rounds: as for `pgccd.Resolution`, of this rank's own bodies.
        stopped_by: (N,) int64, global id of the body whose contact stopped this one; -1 where `fraction` is 1.
        touching_at_start, unresolved: (S, 2), (U, 2) int64 pairs of global ids i <= j, sorted, with a body that this
            rank owns. A pair of bodies of two ranks is listed on both.
        hits: the first contacts of these bodies on their whole paths, as from `World.step` with report="first" and
            nonzero_toi=True.
    """

    hits: Contacts

    _parts: ClassVar[tuple[str, ...]] = ("motion", "hits")


@dataclass
class ResolutionPlan:
    """What earlier steps of a `World` needed; equal on all ranks, except for capacities. It changes how rounds are
    searched, never the result.
    """

    rounds: RoundPlan = field(default_factory=RoundPlan)
    shortened: PassEstimates = field(default_factory=PassEstimates)
    check: PassEstimates = field(default_factory=PassEstimates)
    lists: bool = True  #: whether rounds search a list of pairs, which was not too long in the last step


def options_of_resolution(options: SearchOptions, lists: bool) -> SearchOptions:
    """Options of the search of the whole step and of rounds.

    Args:
        options: of the world.
        lists: whether rounds search a list of pairs.
    """
    return replace(options, report="first", nonzero_toi=True, at_any_times=lists)


def vertices_of(motion: RigidMotion | VertexMotion, scene: Scene) -> Vertices | None:
    """The vertices to send with the bodies of a scene, if they deform."""
    if isinstance(motion, RigidMotion):
        return None
    return Vertices(motion.columns(), vertex_counts(scene.meshes, scene.mesh_index))


def listed_search(share: Share, id: Tensor | None = None, lists_contacts: bool = True) -> ListedSearch:
    """The rounds of a step of rigid bodies on arcs, given this rank's share of it, searched `at_any_times`; `id` and
    `lists_contacts` as of `ListedSearch`.
    """
    own = share.passes[0].bodies
    return ListedSearch(
        share.passes,
        own.scene.meshes,
        own.tensors,
        None if share.ghosts is None else share.ghosts.tensors,
        lambda: pairs_of_rounds(share.passes),
        share.options.query,
        id=id,
        lists_contacts=lists_contacts,
    )


@dataclass(eq=False)
class _Step(Generic[M]):
    """The own bodies of a rank, in a step to be resolved.

    Args:
        whole: the share of the whole step.
        scene, motion: of this rank's own bodies, and their whole step.
        decomposition: of space.
        plan: see `ResolutionPlan`.
        clock: records stage times.
    """

    whole: Share
    scene: Scene
    motion: M
    decomposition: Decomposition
    plan: ResolutionPlan
    clock: StageClock

    def shorten(self, fraction: Tensor) -> M:
        """The motion x_i(f_i t), given f (N,)."""
        return cast(M, shortened(self.scene, self.motion, fraction))

    def search(
        self,
        motion: RigidMotion | VertexMotion,
        options: SearchOptions,
        estimates: PassEstimates,
        marks: Columns | None = None,
        changed: Tensor | None = None,
    ) -> Share:
        """A detection on a shortened motion; `marks` (N, ...) are sent with ghosts."""
        with self.clock.stage("plan"):
            bodies = MovingBodies.of(self.scene, motion, wait=False)
        share, _ = search_share(
            self.decomposition,
            columns_to_send(self.whole.held.own_id, bodies) | (marks or {}),
            bodies,
            lambda ghosts: ghosts,
            options,
            estimates,
            concurrent_work=lambda _: None,
            vertices=vertices_of(motion, self.scene),
            clock=self.clock,
            changed=changed,
        )
        self.clock.add(search_seconds(share.contacts.stats))
        return share

    def check(self, made: M) -> tuple[Tensor, Tensor]:
        """The pairs (P, 2) of own bodies that are not proven free on the shortened motion, and which of these (P,) bool
        are at rest.
        """
        rest = at_rest(self.scene, made)
        options = replace(self.whole.options, report="any", at_any_times=False)
        share = self.search(made, options, self.plan.check, marks={"rest": rest})
        of_held = torch.cat([rest, share.held.ghosts["rest"]]) if share.ghosts is not None else rest
        pairs = share.contacts.pairs
        columns = columns_for_owners(share, {"pairs": pairs, "rest": of_held[pairs].all(dim=1)})
        return columns["pairs"], columns["rest"]


@dataclass(eq=False)
class _SentAnew:
    """A `pgccd.resolution.rounds.RoundSearch` of the own bodies of each rank: a round is a detection on shortened
    paths, with ghosts sent anew.
    """

    step: _Step[Any]
    found: Found  #: in the whole step
    waits = True

    @property
    def passes(self) -> list[SearchPass]:
        return self.step.whole.passes

    def find_whole(self) -> list[Found]:
        """As of `RoundSearch`."""
        return [self.found]

    def look_again(self) -> None:
        """Nothing to do: no capacity can have been exceeded."""

    def find_round(
        self, changed: Tensor, fraction: Tensor, _capacity: BufferSizes, _first: Tensor
    ) -> tuple[list[Found], Tensor]:
        """As of `RoundSearch`."""
        step = self.step
        share = step.search(step.shorten(fraction), step.whole.options, step.plan.shortened, changed=changed)
        found = share.contacts
        assert isinstance(found, Contacts)
        counts = torch.stack([search_pass.counts() for search_pass in share.passes]).sum(dim=0)
        received = columns_for_owners(share, {"pairs": found.pairs, "toi": found.toi})
        return [_of_own(step.whole, received)], counts


@dataclass(frozen=True, eq=False)
class OwnFractions:
    """The part of its path that each own body of a rank moves.

    Attributes:
        fraction: (N,) float64.
        stopped_by: (N,) int64, as of `WorldResolution`.
        rounds: detections after the first.
    """

    fraction: Tensor
    stopped_by: Tensor
    rounds: int


def find_fractions(
    whole: Share,
    scene: Scene,
    motion: RigidMotion | VertexMotion,
    fixed: Tensor | None,
    rank: Rank,
    plan: ResolutionPlan,
    clock: StageClock,
    keeps_common: bool = False,
) -> OwnFractions:
    """How far the own bodies move in a step; all ranks call it.

    Args:
        whole: the share of the whole step, by `options_of_resolution`; with a list, ghosts have the column "fixed" if
            it is given.
        scene: of this rank's own bodies.
        motion: their whole step.
        fixed: (N,) bool: bodies that may not be stopped; None: none.
        rank: this one.
        plan: see `ResolutionPlan`.
        clock: records stage times.
        keeps_common: whether `rank` learns how many bodies it holds in common with others, for a graph.
    """
    held, lists = whole.held, whole.options.at_any_times
    search: RoundSearch
    exchange: Exchange
    if lists:
        exchange = replica_exchange = ReplicaExchange.start(whole, rank.decomposition)
        search, count = listed_search(whole, held.id), len(held)
        if fixed is not None and whole.ghosts is not None:
            fixed = torch.cat([fixed, held.ghosts["fixed"]])
        if keeps_common:
            rank.learn_common(replica_exchange.common(rank.decomposition.neighbours))
    else:
        step = _Step(whole, scene, motion, rank.decomposition, plan, clock)
        exchange, search, count = RankExchange(rank.comm), _SentAnew(step, _first_contacts(whole)), held.own_count
    stopped_by = StoppedBy(count, scene.device)
    resolved = resolve_collisions(
        search, count, plan.rounds, _nothing, clock, exchange, fixed=fixed, stopped_by=stopped_by
    )
    if lists:
        plan.lists = is_short(*resolved.counts.listed)
    fraction, rounds = resolved.resolution.fraction[: held.own_count], resolved.resolution.rounds
    return OwnFractions(fraction, _of_owners(held, stopped_by.id) if lists else stopped_by.id, rounds)


def resolve_step(
    whole: Share,
    scene: Scene,
    motion: M,
    fixed: Tensor | None,
    payload: Columns,
    rank: Rank,
    plan: ResolutionPlan,
    clock: StageClock,
) -> WorldResolution[M]:
    """Resolves one step, and tests the shortened motion; all ranks call it.

    Args:
        payload: columns (N, ...) that `hits` carry, see `tell_owners`.
        whole, scene, motion, fixed, rank, plan, clock: as for `find_fractions`.
    """
    found = find_fractions(whole, scene, motion, fixed, rank, plan, clock)
    hits = tell_owners(whole, payload)
    assert isinstance(hits, Contacts)
    made = cast(M, shortened(scene, motion, found.fraction))
    meeting, rest = hits.pairs, hits.toi == 0.0
    if rank.comm.any(len(hits) > 0):
        meeting, rest = _Step(whole, scene, motion, rank.decomposition, plan, clock).check(made)
    touching = torch.cat([hits.pairs[hits.toi == 0.0], meeting[rest]]).unique(dim=0)
    return WorldResolution(made, found.fraction, found.stopped_by, touching, meeting[~rest], found.rounds, hits)


def _first_contacts(whole: Share) -> Found:
    """The contacts of the own bodies in the whole step, received from all ranks."""
    contacts = whole.contacts
    assert isinstance(contacts, Contacts)
    return _of_own(whole, columns_for_owners(whole, {"pairs": contacts.pairs, "toi": contacts.toi}))


def _of_own(whole: Share, columns: Columns) -> Found:
    return Found(rows_of(whole.held.own_id, columns["pairs"]), columns["pairs"], columns["toi"])


def _of_owners(held: LocalBodies, by: Tensor) -> Tensor:
    """(N,): for own bodies, the least of the values (N + G,) on the ranks that hold them."""
    own, of_ghosts = by.split([held.own_count, held.ghost_count])
    if held.route.neighbours.comm.size == 1:
        return own
    answer, rows = held.route.back({"by": of_ghosts.contiguous()}).wait()["by"], held.route.rows
    rows = torch.where(rows < 0, held.own_count, rows)  # padding
    return torch.cat([own, own.new_zeros(1)]).scatter_reduce(0, rows, answer, "amin")[: held.own_count]


def _nothing(fraction: Tensor) -> Tensor:
    return torch.empty(0, dtype=torch.int64, device=fraction.device)
