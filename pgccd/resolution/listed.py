"""Rounds of resolution that search a list of pairs: those that may meet at any two times of their paths."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, TypeGuard

import torch
from torch import Tensor

from pgccd import ops
from pgccd.geometry.mesh_set import MeshSet
from pgccd.motion.paths import RigidMotion, VertexMotion
from pgccd.resolution.rounds import Found, RoundSearch, found_by, ids_of
from pgccd.runtime.sizes import COUNT_ROWS, EXACTLY, BufferSizes
from pgccd.search.bodies import MovingBodies
from pgccd.search.memory import memory_limit
from pgccd.search.narrow import REPORTS
from pgccd.search.padded import lower_first_toi
from pgccd.search.passes import SearchPass
from pgccd.search.query import Query

# A list longer than this, relative to the PCS, costs more than the broad phases of rounds.
_LONGEST = 4
# If bodies move further than this, relative to their reach, no list is tried: in a crowd of unit boxes it would be at
# least six times as long as the PCS.
_FARTHEST = 6.0

_BYTES_OF_PAIR = BufferSizes(pairs=1, contacts=0).bytes
_PAIRS, _CONTACTS = COUNT_ROWS["pairs"], COUNT_ROWS["contacts"]


def is_short(listed: int, pcs: int) -> bool:
    """Whether rounds search the list, given its length and the number of pairs that may meet at equal times."""
    return listed <= _LONGEST * max(pcs, 1)


def travels_of(bodies: MovingBodies) -> Tensor:
    """(2,) float64 on the CPU: sums of the distances that bodies move and of the reach of each. Synchronises."""
    travel = (bodies.centre_t1 - bodies.centre_t0).norm(dim=1)
    return torch.stack([travel.sum(), bodies.reach.clamp(min=0.0).sum()]).cpu()


def are_near(travels: Tensor) -> bool:
    """Whether bodies move so little that a list may be short, given the sums of `travels_of` over all ranks."""
    travel, reach = travels.tolist()
    return travel <= _FARTHEST * reach


def is_on_arcs(motion: RigidMotion | VertexMotion) -> TypeGuard[RigidMotion]:
    """Whether a shortened path of bodies is a part of the whole one, which `ListedSearch` places."""
    return isinstance(motion, RigidMotion) and motion.path == "rigid"


class ListedSearch:
    """A `pgccd.resolution.rounds.RoundSearch` of rigid bodies on arcs, without a broad phase: a round searches those
    pairs of a list of which a body has changed, each on copies of its two bodies.

    The list has all pairs that may meet if bodies are stopped or slowed down anywhere on their way. The PCS does not
    suffice, because it compares bodies at equal times: a body may run into another that stopped in its way, although
    the two never come near at equal times of their whole paths. A body that is slowed down moves on a part of its path,
    so two bodies that then meet are near at two times of their whole paths.

    Args:
        passes: of the whole step.
        meshes: of the bodies.
        own, ghosts: `pgccd.MovingBodies.tensors`; rows of ghosts follow those of own bodies.
        list_pairs: returns the list, (P, 2) int64 rows, the body with the smaller id first; rows of -1 are padding.
            Called in the first round, and after the passes have found their pairs again. None: it is too long, and
            `otherwise` searches the rounds.
        query: of the whole step and of rounds.
        id: (N + G,) ids of the bodies. Default: their rows.
        lists_contacts: False: rounds lower the first toi, and do not test for surfaces that intersect at t = 0.
        skips_equal: leaves out pairs of bodies that move by the same fraction.
        by_velocity: bodies end at start + fraction * velocity, given by `own` and `ghosts` in place of position_t1.
        otherwise: see `list_pairs`.
    """

    waits = False

    def __init__(
        self,
        passes: Sequence[SearchPass],
        meshes: MeshSet,
        own: Sequence[Tensor],
        ghosts: Sequence[Tensor] | None,
        list_pairs: Callable[[], Tensor | None],
        query: Query,
        *,
        id: Tensor | None = None,
        lists_contacts: bool = True,
        skips_equal: bool = False,
        by_velocity: bool = False,
        otherwise: RoundSearch | None = None,
    ) -> None:
        self.passes = passes
        self._meshes, self._own, self._id, self._query = meshes, own, id, query
        self._ghosts = [column[:0] for column in own] if ghosts is None else ghosts
        self._list_pairs, self._lists_contacts = list_pairs, lists_contacts
        self._rule, self._otherwise = (skips_equal, by_velocity), otherwise
        self._pairs: Tensor | None = None
        self._is_listed = False
        self._copies = torch.empty((0, 2), dtype=torch.int64, device=own[0].device)

    def find_whole(self) -> list[Found]:
        """As of `RoundSearch`."""
        return found_by(self.passes, self._id)

    def look_again(self) -> None:
        """As of `RoundSearch`."""
        self._is_listed = False

    def find_round(
        self, changed: Tensor, fraction: Tensor, capacity: BufferSizes, first: Tensor
    ) -> tuple[list[Found], Tensor]:
        """As of `RoundSearch`."""
        if not self._is_listed:
            self._pairs, self._is_listed = self._list_pairs(), True
        if (pairs := self._pairs) is None:
            assert self._otherwise is not None
            return self._otherwise.find_round(changed, fraction, capacity, first)
        if pairs.device.type == "cpu":
            pieces, share = _pieces(_BYTES_OF_PAIR * len(pairs), pairs), EXACTLY
        else:
            pieces = _pieces(capacity.bytes, pairs)
            share = capacity.times(1.0 / pieces) if 1 < pieces < len(pairs) else capacity
        found: list[Found] = []
        counts = []
        for part in pairs.tensor_split(pieces):
            contacts, of_part = self._search(changed, fraction, part, share, first)
            found += contacts
            counts.append(of_part)
        if pieces == 1:
            return found, counts[0]
        of_parts = torch.stack(counts)
        together = pieces * of_parts.amax(dim=0)
        together[_CONTACTS] = of_parts[:, _CONTACTS].sum()
        return found, together

    def _search(
        self, changed: Tensor, fraction: Tensor, pairs: Tensor, capacity: BufferSizes, first: Tensor
    ) -> tuple[list[Found], Tensor]:

        def look(room: int) -> tuple[Tensor, list[Tensor], Tensor]:
            return ops.resolve_pairs(self._own, self._ghosts, fraction, changed, pairs, *self._rule, room)

        count = self._count(look, capacity, pairs)
        found, bodies, pair_counts = look(count)
        copies, meshes = self._copies_of(count), self._meshes.tensors
        if not self._lists_contacts:
            counts = lower_first_toi(first, found, meshes, bodies, False, copies, pair_counts, self._query, capacity)
            return [], counts
        *rows, counts = ops.contacts_padded(
            (meshes, bodies, False),
            copies,
            pair_counts,
            pair_counts.new_zeros(1),  # all poses have been validated
            *self._query.lengths,
            [*self._query.options[:-1], REPORTS["first"]],
            capacity.of_contacts,
        )
        of_copies = rows[0]
        held = torch.where(of_copies < 0, -1, found.view(-1)[of_copies])
        id = held if self._id is None else ids_of(self._id, held)
        return [Found(held, id, rows[4])], counts[: len(COUNT_ROWS)]

    def _count(self, look: Callable[[int], Sequence[Any]], capacity: BufferSizes, pairs: Tensor) -> int:
        """Number of pairs that a round has room for: on a CPU exact."""
        return int(look(0)[2][_PAIRS]) if pairs.device.type == "cpu" else capacity.pairs

    def _copies_of(self, count: int) -> Tensor:
        """(count, 2): rows of the two bodies of each pair among the copies."""
        if count > len(self._copies):
            self._copies = torch.arange(2 * count, device=self._copies.device).view(count, 2)
        return self._copies[:count]


def _pieces(wanted: int, pairs: Tensor) -> int:
    """Number of parts in which pairs (P, 2) are searched one after the other, if they need `wanted` bytes; at most one
    per pair.
    """
    limit = memory_limit(None, wanted, pairs.device)
    return max(1, min(-(-wanted // limit), len(pairs)))
