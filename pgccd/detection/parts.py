"""A step whose body pairs are searched in parts, each as soon as it is known: while others are still looked for."""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from dataclasses import replace

import torch
from torch import Tensor

from pgccd import ops
from pgccd.detection import broad
from pgccd.detection.bodies import MovingBodies
from pgccd.detection.capacity import COUNT_ROWS, Capacity, Counts
from pgccd.detection.contacts import Contacts, Stats
from pgccd.detection.memory import CapacityEstimate
from pgccd.detection.padded import Search
from pgccd.detection.pipeline import expected_capacity, find_contacts, start_search
from pgccd.detection.query import Query
from pgccd.detection.streaming import join_contacts

# Capacity for pairs found without waiting, over what the last step needed. More than where their number is known
# how many more pairs there are.
_SLACK = 1.5


class Part:
    """Body pairs of a step that are searched together.

    Args:
        query: what is asked.
        bodies: moving.
        pairs: (P, 2) int64 rows of these, of each pair first the body that contacts are to name first. Rows of -1 may
            follow.
        pair_counts: (7,) int64, left on the device: the first of `Counts`. Default: there are P pairs.
        rows: (B,) int64: which of the step's bodies each of `bodies` is. Default: they are those of the step.
        capacity: of the search, chosen before the pairs were known. Default: what is expected to suffice.
        find_pairs: finds all pairs, if they exceeded the capacity.
        estimate: of the capacity of the same part of the next step, which learns what this one needed.
    """

    def __init__(
        self,
        query: Query,
        bodies: MovingBodies,
        pairs: Tensor,
        pair_counts: Tensor | None = None,
        rows: Tensor | None = None,
        capacity: Capacity | None = None,
        find_pairs: Callable[[], Tensor] | None = None,
        estimate: CapacityEstimate | None = None,
    ) -> None:
        self.query, self.bodies, self.pairs, self.rows = query, bodies, pairs, rows
        self._estimate = estimate or CapacityEstimate()
        self._pair_counts, self._capacity, self._find_pairs = pair_counts, capacity, find_pairs
        # What the capacity is proportional to: bodies, if it was chosen before the pairs were known.
        self._size = len(pairs) if capacity is None else bodies.scene.body_count
        self._search: Search | None = None
        self._counts: Counts | None = None
        self._scratch_bytes = 0
        self._contacts: Contacts | None = None

    def start(self) -> Search:
        """Starts the search for their contacts, unless it has been started. Waits for nothing."""
        if self._search is None:
            given = self._pair_counts, self._capacity, self._estimate
            self._search = start_search(self.bodies, self.query, self.pairs, *given)
            # Now: when its counts are read, another search may have been started.
            self._scratch_bytes = ops.take_scratch_peak() if self.pairs.is_cuda else 0
        return self._search

    def begin(self) -> None:
        """Starts the search on a GPU. Elsewhere makes it, unless it has been started."""
        if self.pairs.is_cuda or self._search is not None:
            self.start()
        else:
            self.find()

    def learn(self, counts: Counts) -> None:
        """Takes note of what the search counted, which the host has read, for `find` and for the next step. Once the
        contacts have been found in another way, `find` has done so."""
        if self._contacts is not None:
            return
        self._counts = counts
        if not counts.overflow:
            self._estimate.learn(self._size, counts.needed(self.start().capacity))

    def find(self) -> Contacts:
        """Their contacts, as rows of `bodies`. Waits for them."""
        if self._contacts is not None:
            return self._contacts
        if self._search is not None:
            if self._counts is None:
                self.learn(self._search.read())
            assert self._counts is not None
            if not self._counts.overflow:
                self._contacts = self._search.contacts(self._counts)
                self._contacts.stats.scratch_bytes = self._scratch_bytes
                return self._contacts
        if self._pair_counts is not None:
            numbers, self._pair_counts = self._pair_counts.tolist(), None
            if numbers[COUNT_ROWS["pairs_overflow"]] and self._find_pairs is not None:
                self.pairs = self._find_pairs()
            else:
                self.pairs = self.pairs[: numbers[COUNT_ROWS["pairs_written"]]]
        self._contacts = find_contacts(self.bodies, self.query, pairs=self.pairs)
        needed = self._contacts.stats.needed
        if needed is not None:
            if self._counts is not None:  # only the first search has counts of the broad phase
                needed = replace(
                    needed,
                    pairs=max(needed.pairs, self._counts.pairs),
                    overlaps=self._counts.overlaps,
                    long_rows=self._counts.long_rows != 0,
                )
            self._estimate.learn(self._size, needed)
        return self._contacts

    def first_contacts(self) -> tuple[Tensor, Tensor]:
        """Pairs (K, 2) as rows of the step's bodies and toi (K,) of the contacts: those that `find` gave, else of the
        search as far as it goes, padded with -1 and inf. Asks for first contacts; waits for nothing."""
        if self._contacts is None:
            rows = self.start().rows
            return self.in_step(rows[0]), rows[4]
        if self._contacts.toi is None:
            raise ValueError('report: "any" gives no toi')
        return self.in_step(self._contacts.pairs), self._contacts.toi

    def counts(self) -> Tensor:
        """(21,) int64, on the device: `Counts` of what `first_contacts` gives."""
        if self._contacts is None:
            return self.start().counts[: len(COUNT_ROWS)]
        return _counts_of(self._contacts.stats).to(self.pairs.device)

    def in_step(self, pairs: Tensor) -> Tensor:
        """Rows of `bodies` (K, 2), perhaps -1, as rows of the step's."""
        if self.rows is None:
            return pairs
        return self._rows_or_padding[pairs]

    @functools.cached_property
    def _rows_or_padding(self) -> Tensor:
        """`rows`, and -1 for padding."""
        assert self.rows is not None
        return torch.cat([self.rows, self.rows.new_full((1,), -1)])


#: Of pairs (P, 2), perhaps with rows of -1 after them, those to be searched: as many, in the first places; and their
#: number (1,) int64, left on the device.
Select = Callable[[Tensor], tuple[Tensor, Tensor]]


def find_part(
    bodies: MovingBodies,
    query: Query,
    broad_phase: broad.BroadPhase = "auto",
    select: Select | None = None,
    discard: Tensor | None = None,
    rows: Tensor | None = None,
    estimate: CapacityEstimate | None = None,
    slack: float = _SLACK,
) -> Part:
    """The PCS of bodies, as a part. On a GPU it is found without waiting for its size, in a capacity, where that can be
    foreseen how much suffices. Then the bodies need not be checked: if they are invalid there are no pairs.

    Args:
        bodies, query, broad_phase: as for `find_contacts`.
        select: which of the pairs are searched. Default: all.
        discard: (1,) int64 on the device; nonzero: the result will be discarded, and the search returns at once.
        rows, estimate: as for `Part`.
        slack: capacity over what the last step needed.

    Raises:
        ValueError: the bodies are invalid, and that had to be known.
    """
    separation, tolerance = query.min_separation, query.tolerance

    def find_pairs() -> Tensor:
        pairs = broad.find_pairs(bodies, separation, broad_phase, tolerance)
        if select is None:
            return pairs
        pairs, count = select(pairs)
        return pairs[: int(count)]

    estimate = estimate or CapacityEstimate()
    capacity = expected_capacity(bodies, None, estimate, slack=slack) if _looks_ahead(bodies) else None
    if capacity is None:
        if not bodies.checked:
            bodies.raise_faults(bodies.first_faults().tolist())
        return Part(query, bodies, find_pairs(), rows=rows)
    invalid = bodies.first_faults()[-1:]
    if discard is not None:
        invalid = torch.maximum(invalid, discard)
    pairs, counts = broad.find_pairs_padded(bodies, separation, broad_phase, capacity, invalid, tolerance)
    if select is not None:
        pairs, count = select(pairs)
        row = COUNT_ROWS["pairs_written"]
        counts[row : row + 1].copy_(count)
    return Part(query, bodies, pairs, counts, rows, capacity, find_pairs, estimate)


def _counts_of(stats: Stats) -> Tensor:
    """(21,) int64: what `Counts` would say of a search of which the statistics are known."""
    counts = dict.fromkeys(Counts._fields, 0)
    counts |= {"pairs": stats.pcs, "pairs_written": stats.pcs, "candidates": stats.candidates}
    counts |= {"contacts": stats.contacts, "unresolved": stats.unresolved, "node_tests": stats.node_tests}
    counts["traverse_ended"] = round(1e9 * stats.seconds["traverse"])
    counts["narrow_ended"] = counts["traverse_ended"] + round(1e9 * stats.seconds["narrow"])
    return torch.tensor(list(counts.values()))


def _looks_ahead(bodies: MovingBodies) -> bool:
    return bodies.device.type != "cpu"


def contacts_of_step(parts: Sequence[Part]) -> Contacts:
    """The contacts of all parts, one part after the other, as rows of the step's bodies. Waits for them."""
    found = [part.find() for part in parts]
    if len(parts) == 1:
        return found[0]
    return join_contacts(found, [part.in_step(each.pairs) for part, each in zip(parts, found, strict=True)])


def first_contacts_of(parts: Sequence[Part]) -> tuple[Tensor, Tensor]:
    """Pairs (K, 2) as rows of the step's bodies, and toi (K,), of all parts: see `Part.first_contacts`."""
    pairs, toi = zip(*(part.first_contacts() for part in parts), strict=True)
    return (pairs[0], toi[0]) if len(pairs) == 1 else (torch.cat(pairs), torch.cat(toi))


def search_seconds(found: Counts | Stats) -> dict[str, float]:
    """Of traversal and narrow phase. The time of the broad phase is measured where pairs are found."""
    return {stage: found.seconds[stage] for stage in ("traverse", "narrow")}


def pairs_of_step(parts: Sequence[Part]) -> Tensor:
    """(P, 2) int64: the pairs of all parts as rows of the step's bodies, rows of -1 among them."""
    if len(parts) == 1:
        return parts[0].pairs
    return torch.cat([part.in_step(part.pairs) for part in parts])
