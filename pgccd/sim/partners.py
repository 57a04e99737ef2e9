"""Detection in rounds of resolution, for robots: between those slowed down and all others."""

import torch
from torch import Tensor

from pgccd.runtime.sizes import COUNT_ROWS, BufferSizes
from pgccd.search.memory import memory_limit
from pgccd.search.padded import lower_first_toi
from pgccd.search.query import Query
from pgccd.sim.model import Model

#: Options of the search of the whole step and of every round. nonzero_toi: robots that separate after a contact may
#: move. assume_free: robots start disjoint, and each step ends before the first contact.
FIRST_CONTACTS = Query("first", 0.0, None, True, "assume_free")

_CONTACTS = COUNT_ROWS["contacts"]


class Partners:
    """All pairs of a step's robots that may meet if robots are stopped or slowed down anywhere on their way, as a
    `pgccd.resolution.rounds.RoundSearch`: rounds search those with a robot that has changed. The PCS would not suffice:
    it is of equal times, and a robot may run into another that stopped in its way, although the two never come near at
    equal times of their whole paths.

    A robot that is slowed down moves on a part of its path, so two that meet then are near at two times of their whole
    paths, and `pgccd.search.passes.pairs_of_rounds` has the pair. No broad phase is needed in a round.

    Two that move by the same fraction are not searched: they are at equal times of their whole paths, before the first
    toi that the search of the whole step has certified (docs/explanation/exactness.md, "Rounds of the simulation").

    Args:
        model: the rules.
        own, ghosts: `moving_columns` of planned states; rows of ghosts follow those of own robots.
        pairs: `pairs_of_rounds`: (P, 2) int64 rows, the robot with the smaller id first; rows of -1 are padding.
    """

    def __init__(self, model: Model, own: dict[str, Tensor], ghosts: dict[str, Tensor] | None, pairs: Tensor) -> None:
        self._model, self._pairs = model, pairs
        self._own = list(own.values())
        self._ghosts = [column[:0] if ghosts is None else ghosts[name] for name, column in own.items()]
        self._copies = pairs[:0]

    def look_among(self, pairs: Tensor) -> None:
        """Replaces the pairs."""
        self._pairs = pairs

    def start_round(self, changed: Tensor, fraction: Tensor, capacity: BufferSizes, first: Tensor) -> Tensor:
        """As `RoundSearch.start_round`; robots move at constant velocities. Never synchronises on a GPU."""
        if self._pairs.device.type == "cpu":
            capacity = BufferSizes(pairs=len(self._pairs), contacts=0)
        pieces = self._pieces(capacity)
        if pieces == 1:
            return self._search(changed, fraction, self._pairs, capacity, first)
        share = capacity.times(1.0 / pieces) if pieces < len(self._pairs) else capacity
        parts = self._pairs.tensor_split(pieces)
        counts = torch.stack([self._search(changed, fraction, part, share, first) for part in parts])
        together = pieces * counts.amax(dim=0)
        together[_CONTACTS] = counts[:, _CONTACTS].sum()
        return together

    def _pieces(self, capacity: BufferSizes) -> int:
        """Number of parts in which the pairs are searched sequentially to fit into memory; at most one per pair."""
        limit = memory_limit(None, capacity.bytes, self._pairs.device)
        return max(1, min(-(-capacity.bytes // limit), len(self._pairs)))

    def _search(self, changed: Tensor, fraction: Tensor, pairs: Tensor, capacity: BufferSizes, first: Tensor) -> Tensor:
        given = self._own, self._ghosts, fraction, changed, pairs
        count = capacity.pairs
        if pairs.device.type == "cpu":
            count = int(self._model.affected_pairs(*given, 0)[2][COUNT_ROWS["pairs"]])
        found, bodies, pair_counts = self._model.affected_pairs(*given, count)
        copies, meshes = self._copies_of(count), self._model.meshes.tensors
        return lower_first_toi(first, found, meshes, bodies, False, copies, pair_counts, FIRST_CONTACTS, capacity)

    def _copies_of(self, count: int) -> Tensor:
        """(count, 2): rows of the two robots of each pair among the copies."""
        if count > len(self._copies):
            self._copies = torch.arange(2 * count, device=self._pairs.device).view(count, 2)
        return self._copies[:count]
