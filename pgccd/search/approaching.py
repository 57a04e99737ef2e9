"""The contacts that a solver must respond to.

If the first contact of a pair recedes, later ones are searched for in growing windows of time, until one is not certain
to recede. An operator proves that contacts recede (csrc/kernels/contacts/recession_item.h).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any, TypeVar

import torch
from torch import Tensor

from pgccd import arguments, ops
from pgccd.contacts.approach import checked_rates, moving_bodies
from pgccd.contacts.contacts import Contacts, Stats, contacts_of, earliest_of_each
from pgccd.contacts.gradients import add_gradients
from pgccd.contacts.kinds import Kind, Status
from pgccd.contacts.operands import operands
from pgccd.geometry.scene import Scene
from pgccd.motion.differentiable import any_differentiated
from pgccd.motion.of_scene import in_scene, segments_as_step
from pgccd.motion.paths import RigidMotion, VertexMotion
from pgccd.motion.trajectory import Trajectory
from pgccd.search import narrow
from pgccd.search.bodies import MovingBodies
from pgccd.search.checks import RELATIVE_TOLERANCE, separation_value
from pgccd.search.detect import detect_moving
from pgccd.search.query import Query
from pgccd.search.trajectories import of_trajectory

C = TypeVar("C", bound=Contacts)

# The first window ends at the first contact. For bodies with fewer pairs of faces than this it is the whole step. Then:
# the factor by which each window is longer than the one before, and the least part of the step that the second one has.
_FEW_FACES = 1 << 12
_LONGER = 8.0
_SECOND_WINDOW = 1.0 / 8.0
# Number of pairs in the first batch, and of candidates that a batch should have.
_PAIRS = 32
_CANDIDATES = 1 << 18
# By how much later batches of pairs are larger.
_LARGER = 4


def approaching(
    scene: Scene, motion: RigidMotion | VertexMotion | Trajectory, hits: C, slack: float | None = None
) -> C:
    """The contacts that a solver must respond to: those whose surfaces may come closer after toi, by more than `slack`.
    For report="first", the first such contact of each pair: pairs whose first contact rests, slides or recedes are
    searched again for later ones.

    A contact is left out only if it certainly does not approach in the whole rest of the step. No approaching contact
    is left out; some that do not approach may stay in if bodies turn. `UNRESOLVED` contacts and intersections (`EF_AB`,
    `EF_BA`) always stay in.

    Args:
        scene, motion: those that `detect` found the contacts with, unchanged.
        hits: contacts of `detect` without a capacity, on the scene's device.
        slack: length >= 0. Default: the tolerance of the detection; if none was given, 1e-6 of the smaller SBV radius
            of each pair (for a sphere, of its radius).

    Returns:
        Contacts; for a trajectory, TrajectoryContacts. Synchronises with a GPU.

    Raises:
        TypeError, ValueError: naming the argument; also if the report was "earliest", which leaves out the contacts of
            other pairs, or the contacts come from a capacity, from ranks or from a state_dict.

    Example:
        >>> ahead = pgccd.approaching(scene, motion, hits)  # resting on a floor: the wall ahead
        >>> fraction = ahead.first_toi().clamp(max=1.0)
    """
    if isinstance(hits, Contacts) and hits._is_earliest:
        raise ValueError(
            'report: "earliest" leaves out the contacts of other pairs; ask for "first" or "all", and then for the '
            "earliest approaching one"
        )
    options = hits._found_with if isinstance(hits, Contacts) else {}
    if options is None:
        raise ValueError(
            "hits: expected contacts of `detect` without a capacity, whose options a search for later ones needs"
        )
    slack = options.get("tolerance") if slack is None else arguments.length(slack, "slack")
    copies, steps, bodies = moving_bodies(scene, motion, hits)
    with torch.no_grad():
        recession = Recession.of(copies, steps, slack)
        checked_rates(recession.scene, recession.motion, bodies, hits)
        recedes = recession.is_certain(hits, bodies)
    kept = hits[~recedes]
    if options["report"] == "first" and len(kept) < len(hits):
        later = _later(scene, motion, hits[recedes], recession, options)
        if later is not None:
            kept = _joined(kept, later)
    return replace(kept, stats=replace(kept.stats, contacts=len(kept)))


@dataclass
class Recession:
    """The proof that contacts recede: their features, and the surfaces around them, certainly come closer by at most
    `slack` in the rest of the step.

    Attributes:
        scene, motion: without gradients.
        slack: (N,), of each body; for a pair, the smaller one counts.
    """

    scene: Scene
    motion: RigidMotion | VertexMotion
    slack: Tensor

    @classmethod
    def of(cls, scene: Scene, motion: RigidMotion | VertexMotion, slack: float | None) -> Recession:
        """The proof for bodies; slack None: 1e-6 of the size."""
        radius = scene._detached()._size
        slacks = RELATIVE_TOLERANCE * radius if slack is None else torch.full_like(radius, slack)
        return cls(scene._detached(), motion._detached(), slacks)

    def surface_normals(self, contacts: Contacts, bodies: Tensor) -> Tensor:
        """(K, 3): normals as with normals="surface", for contacts of bodies (K, 2)."""
        return ops.surface_normals(*operands(self.scene, self.motion, bodies, contacts))

    def is_certain(self, contacts: Contacts, bodies: Tensor) -> Tensor:
        """(K,) bool: contacts of bodies (K, 2) that recede."""
        given = operands(self.scene, self.motion, bodies, contacts)
        return ops.certainly_recede(*given, contacts.status, self.slack).bool()


def _later(
    scene: Scene,
    motion: RigidMotion | VertexMotion | Trajectory,
    hits: C,
    recession: Recession,
    options: dict[str, Any],
) -> C | None:
    """For pairs whose first contact, in `hits`, recedes: their first contact that is not certain to recede. None if no
    pair has one.
    """
    names = ("tolerance", "nonzero_toi", "initial")
    separation = separation_value(options["min_separation"])
    query = Query("all", separation, **{name: options[name] for name in names})
    copies, steps, bodies = moving_bodies(scene, motion, hits)
    with torch.no_grad():
        moving = MovingBodies.of(copies._detached(), steps._detached())
        search = _Search(moving, query, recession, options["normals"] == "surface")
        if isinstance(motion, Trajectory):
            # The first contacts of each segment.
            pairs = segments_as_step(scene._detached(), motion, torch.unique(hits.pairs, dim=0))[2]
            first: Any = detect_moving(moving, replace(query, report="first"), pairs=pairs)
            bodies, toi = first.pairs, first.toi
        else:
            bodies, of_pair = _distinct(bodies, copies.body_count)
            toi = torch.ones(len(bodies), dtype=torch.float64, device=bodies.device)
            toi = toi.scatter_reduce(0, of_pair, hits.toi.detach(), "amin")
        found = search.of_segments(bodies, toi, scene.body_count)
        if found is None:
            return None
        if search.wants_surface:
            found.normal = recession.surface_normals(found, found.pairs)
    is_differentiated = any_differentiated(*steps._values(), copies.margin, options["min_separation"])
    if hits._differentiable is not None and is_differentiated:
        add_gradients(found, copies, steps, options["min_separation"])
    if isinstance(motion, Trajectory):
        return of_trajectory(found, scene, motion.segment_count, "all")  # type: ignore[return-value]
    return found  # type: ignore[return-value]


@dataclass
class _Search:
    """A search for the first contacts of pairs that are not certain to recede.

    Attributes:
        bodies: in motion.
        query: of the contacts.
        recession: of the same bodies.
        wants_surface: whether contacts have the normals of surfaces.
    """

    bodies: MovingBodies
    query: Query
    recession: Recession
    wants_surface: bool

    def of_segments(self, pairs: Tensor, toi: Tensor, count: int) -> Contacts | None:
        """The contact of each pair of a scene of `count` bodies in the first segment that has one; sorted by pair.

        Args:
            pairs: (P, 2) of copies of the scene's bodies for each segment, sorted.
            toi: (P,) of the first contact of each.
        """
        segment, of_scene = in_scene(pairs, count)
        distinct, owner = _distinct(of_scene, count)
        # Segments of each pair, first one, then two more, then four.
        order = torch.argsort(owner, stable=True)
        begin = torch.searchsorted(owner[order], torch.arange(len(distinct), device=pairs.device))
        rank = torch.empty_like(order)
        rank[order] = torch.arange(len(order), device=pairs.device) - begin[owner[order]]
        is_found = torch.zeros_like(begin, dtype=torch.bool)
        parts, low, number = [], 0, 1
        while bool(((rank >= low) & ~is_found[owner]).any()):
            chosen = torch.nonzero((rank >= low) & (rank < low + number) & ~is_found[owner])[:, 0]
            for contacts, place in self._of_pairs(pairs[chosen], toi[chosen]):
                is_found[owner[chosen[place]]] = True
                parts.append(contacts)
            low, number = low + number, 2 * number
        if not parts:
            return None
        found = Contacts.cat(parts)
        segment, of_scene = in_scene(found.pairs, count)
        _, owner = _distinct(of_scene, count)
        return found[earliest_of_each(owner, len(found), segment, found.toi)]

    def _of_pairs(self, pairs: Tensor, toi: Tensor) -> Iterator[tuple[Contacts, Tensor]]:
        """Contacts of pairs (P, 2), and their pairs' rows.

        Args:
            toi: (P,) of the first contact of each.
        """
        # The ends of this window and of the one before, and how many contacts within the one before recede.
        scene = self.bodies.scene
        faces = scene.meshes.offsets.diff(dim=0)[:, 1].to(pairs.device)[scene.mesh_index.long()][pairs].prod(1)
        until = torch.where(faces < _FEW_FACES, 1.0, toi)
        before, receding = torch.full_like(toi, -1.0), torch.zeros_like(pairs[:, 0])
        left, size = torch.arange(len(pairs), device=pairs.device), _PAIRS
        while len(left):
            begin = 0
            while begin < len(left):
                chosen = left[begin : begin + size]
                begin += size
                contacts, place, candidates = self._until(pairs[chosen], until[chosen])
                early = contacts.toi <= before[chosen][place]
                count = torch.bincount(place[early], minlength=len(chosen))
                # Known unless more contacts are now found in that window.
                is_known = early & (count == receding[chosen])[place]
                receding[chosen] = torch.bincount(place, minlength=len(chosen))
                rows = self._first(contacts, place, is_known, len(chosen))
                until[chosen[place[rows]]] = torch.inf
                yield contacts[rows], chosen[place[rows]]
                size = max(1, min(_LARGER * size, size * _CANDIDATES // max(1, candidates)))
            left = left[until[left] < 1.0]
            before[left] = until[left]
            until[left] = (_LONGER * until[left]).clamp(min=_SECOND_WINDOW, max=1.0)
            size = max(1, int(size / _LONGER))

    def _until(self, pairs: Tensor, until: Tensor) -> tuple[Contacts, Tensor, int]:
        """All contacts of pairs until times (P,); the row of their pair (K,); and the number of candidates."""
        operands, query, lengths = self.bodies.operands, self.query, self.query.lengths
        candidates, _ = ops.traverse(operands, pairs, until, *lengths, query.tests_start)
        rows = ops.narrow(operands, pairs, candidates, *lengths, query.nonzero_toi, narrow.REPORTS["all"])
        place = rows[0].long()
        contacts: Any = contacts_of((pairs[place], *rows[1:]), "all", Stats(bodies=len(self.recession.slack)))
        chosen = contacts.toi <= until[place]
        return contacts[chosen], place[chosen], len(candidates)

    def _first(self, contacts: Contacts, place: Tensor, is_known: Tensor, count: int) -> Tensor:
        """Rows of the first contacts that are not certain to recede, one for each of `count` pairs that has one.

        Args:
            contacts: K.
            place: (K,) the row of their pair.
            is_known: (K,) bool: contacts that are known to recede.
        """
        # These stay in without a test.
        stays = (contacts.kind > Kind.EE) | (contacts.status != Status.TOUCH)
        first = torch.full((count,), torch.inf, dtype=torch.float64, device=place.device)
        first = first.scatter_reduce(0, place[stays], contacts.toi[stays], "amin")
        tested = torch.nonzero(~is_known & ~stays & (contacts.toi <= first[place]))[:, 0]
        stays[tested] = ~self._recede(contacts[tested])
        rows = torch.nonzero(stays)[:, 0]
        return rows[earliest_of_each(place[rows], count, contacts.toi[rows])]

    def _recede(self, contacts: Contacts) -> Tensor:
        """(K,) bool: contacts that certainly recede."""
        if self.wants_surface:
            contacts = replace(contacts, normal=self.recession.surface_normals(contacts, contacts.pairs))
        return self.recession.is_certain(contacts, contacts.pairs)


def _distinct(pairs: Tensor, count: int) -> tuple[Tensor, Tensor]:
    """The distinct ones (D, 2) of pairs (P, 2) of `count` bodies, sorted, and the row of each among these (P,)."""
    keys, owner = torch.unique(pairs[:, 0] * count + pairs[:, 1], return_inverse=True)
    return torch.stack([keys // count, keys % count], 1), owner


def _joined(one: C, other: C) -> C:
    """Contacts with one row for each pair, joined with contacts of other pairs, in the order of pairs."""
    other = replace(other, _bodies=one._bodies, _found_with=one._found_with)
    both = type(one).cat([one, other])
    pairs = both.pairs
    order = torch.argsort(pairs[:, 0] * (pairs.amax() + 1 if len(pairs) else 1) + pairs[:, 1])
    return replace(both[order], stats=one.stats, _found_with=one._found_with)
