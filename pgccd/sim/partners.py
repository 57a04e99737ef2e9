"""Whom robots may meet that have been slowed down."""

from __future__ import annotations

import torch
from torch import Tensor

from pgccd.detection.capacity import Capacity
from pgccd.detection.contacts import Contacts
from pgccd.detection.memory import memory_limit
from pgccd.detection.padded import lower_first_toi
from pgccd.detection.pipeline import detect
from pgccd.detection.query import Query
from pgccd.sim.model import Model

#: What is asked of the whole step, and in every round of settling. nonzero_toi: robots that part after a contact are
#: free.
FIRST_CONTACTS = Query("first", 0.0, None, True)


class Partners:
    """What settling asks, answered for potentially colliding pairs.

    Args:
        model: the rules.
        own, ghosts: `moving_columns` of planned states; rows of ghosts follow own ones.
        pairs: (P, 2) int64 rows, the robot of smaller id first.
    """

    def __init__(self, model: Model, own: dict[str, Tensor], ghosts: dict[str, Tensor] | None, pairs: Tensor) -> None:
        self._model, self._pairs = model, pairs
        self._own = list(own.values())
        self._ghosts = [column[:0] if ghosts is None else ghosts[name] for name, column in own.items()]
        #: HaloCapacity that each round needed, where rounds were waited for.
        self.needed: list[Capacity] = []
        self._copies = self._copies_of(0)

    def look_among(self, pairs: Tensor) -> None:
        """From now on these are the PCS."""
        self._pairs = pairs

    def __call__(self, changed: Tensor, fraction: Tensor, any_changed: Tensor) -> tuple[Tensor, Tensor] | None:
        """See `FindContacts`."""
        # A slowed robot stays within the volume it was to sweep: it can only meet its partners in the PCS.
        given = self._own, self._ghosts, fraction, changed.view(torch.uint8), self._pairs
        _, _, counts = self._model.affected_pairs(*given, 0)
        # Read together: on a GPU each read of a number waits for the device.
        goes_on, count, *_ = torch.cat([any_changed, counts]).tolist()
        if not goes_on:
            return None
        if not count:
            self.needed.append(Capacity(0, 0))
            return self._pairs[:0], fraction[:0]
        pairs, bodies, _ = self._model.affected_pairs(*given, count)
        scene, motion = self._model.pair_motion(bodies)
        # nonzero_toi: as for the whole step.
        contacts = detect(scene, motion, report="first", nonzero_toi=True, pairs=self._copies_of(count))
        self.needed.append(contacts.stats.needed or Capacity.guess(2 * count, count))
        return pairs[contacts.pairs[:, 0] // 2], toi_of(contacts)

    def start_round(self, changed: Tensor, fraction: Tensor, capacity: Capacity, first: Tensor) -> Tensor:
        """See `StartRound`."""
        if capacity.bytes > memory_limit(None, capacity.bytes, fraction.device):
            capacity = Capacity(0, 0)  # which does not suffice: the rounds are waited for, then, and searched in pieces
        if capacity.pairs > len(self._copies):
            self._copies = self._copies_of(capacity.pairs)
        given = self._own, self._ghosts, fraction, changed, self._pairs
        pairs, bodies, pair_counts = self._model.affected_pairs(*given, capacity.pairs)
        copies, meshes = self._copies[: capacity.pairs], self._model.meshes.tensors
        return lower_first_toi(first, pairs, meshes, bodies, False, copies, pair_counts, FIRST_CONTACTS, capacity)

    def _copies_of(self, count: int) -> Tensor:
        """The two robots of each pair among their copies."""
        return torch.arange(2 * count, device=self._pairs.device).view(count, 2)


def toi_of(contacts: Contacts) -> Tensor:
    """(K,) float64: the column, which `detect(report="first")` always gives."""
    if contacts.toi is None:
        raise AssertionError("detect(report='first') gives a toi")
    return contacts.toi
