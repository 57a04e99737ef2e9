"""A step whose body pairs are searched in parts, each as soon as it is known: while others are still looked for."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from pgccd.bodies import MovingBodies
from pgccd.capacity import Counts
from pgccd.contacts import Contacts
from pgccd.detect import find_contacts, finish_search, start_search
from pgccd.query import Query
from pgccd.streaming import join_contacts
from pgccd.within import Search


class Part:
    """Body pairs of a step that are searched together.

    Args:
        query: what is asked.
        bodies: moving; checked.
        pairs: (P, 2) int64 rows of these, of each pair first the body that contacts are to name first. Rows of -1 may
            follow.
        count: (1,) int64, left on the device: how many pairs there are. Default: P.
        rows: (B,) int64: which of the step's bodies each of `bodies` is. Default: they are those of the step.
    """

    def __init__(
        self,
        query: Query,
        bodies: MovingBodies,
        pairs: Tensor,
        count: Tensor | None = None,
        rows: Tensor | None = None,
    ) -> None:
        if count is not None and not pairs.is_cuda:
            pairs, count = pairs[: int(count)], None
        self.query, self.bodies, self.pairs, self.count, self.rows = query, bodies, pairs, count, rows
        self._search: Search | None = None
        self._contacts: Contacts | None = None

    def start(self) -> Search:
        """Starts the search for their contacts, if nobody has. Waits for nothing."""
        if self._search is None:
            self._search = start_search(self.bodies, self.query, self.pairs, self.count)
        return self._search

    def begin(self) -> None:
        """Starts the search on a GPU. Elsewhere makes it."""
        if self.pairs.is_cuda:
            self.start()
        else:
            self.find()

    def finish(self, counts: Counts) -> Contacts:
        """What the search found, if it did not overflow; counts: its own, which the host has read."""
        self._contacts = finish_search(self.start(), self.pairs, counts)
        return self._contacts

    def find(self) -> Contacts:
        """Their contacts, as rows of `bodies`. Waits for them."""
        if self._contacts is not None:
            return self._contacts
        if self._search is not None:
            counts = self._search.read()
            if not counts.overflow:
                return self.finish(counts)
        pairs = self.pairs if self.count is None else self.pairs[: int(self.count)]
        self._contacts = find_contacts(self.bodies, self.query, pairs=pairs)
        return self._contacts

    def in_step(self, pairs: Tensor) -> Tensor:
        """Rows of `bodies` (K, 2), perhaps -1, as rows of the step's."""
        if self.rows is None:
            return pairs
        return torch.cat([self.rows, self.rows.new_full((1,), -1)])[pairs]


def contacts_of_step(parts: Sequence[Part]) -> Contacts:
    """The contacts of all parts, one part after the other, as rows of the step's bodies. Waits for them."""
    found = [part.find() for part in parts]
    if len(parts) == 1:
        return found[0]
    return join_contacts(found, [part.in_step(each.pairs) for part, each in zip(parts, found, strict=True)])


def pairs_of_step(parts: Sequence[Part]) -> Tensor:
    """(P, 2) int64: the pairs of all parts as rows of the step's bodies, rows of -1 among them."""
    if len(parts) == 1:
        return parts[0].pairs
    return torch.cat([part.in_step(part.pairs) for part in parts])
