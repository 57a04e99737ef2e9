"""A step whose body pairs are searched in several passes, each as soon as its pairs are known."""

import functools
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import torch
from torch import Tensor

from pgccd import ops
from pgccd.contacts.contacts import CollidingPairs, Contacts, Stats
from pgccd.runtime.sizes import COUNT_ROWS, BufferSizes, Counts, sizes_of
from pgccd.search import broad
from pgccd.search.bodies import MovingBodies
from pgccd.search.detect import detect_moving, expected_capacity, start_search
from pgccd.search.memory import CapacityEstimate
from pgccd.search.padded import PaddedSearch
from pgccd.search.query import Query

# Capacity for pairs found without synchronising, relative to the last step. It is larger than for a known number of
# pairs, since that number may grow too.
PASS_SLACK = 1.5


class FoundPairs(NamedTuple):
    """Body pairs of a pass."""

    pairs: Tensor  #: (P, 2) int64, to search
    swept_pairs: Tensor | None  #: (S, 2) int64, see `SearchPass.swept_pairs`


@dataclass(eq=False)
class SearchPass:
    """One pass of a step's search: body pairs that are searched together."""

    query: Query
    bodies: MovingBodies  #: of the pairs
    #: (P, 2) int64 rows of `bodies`; contacts name the first body of a pair first. Rows of -1 may follow.
    pairs: Tensor
    pair_counts: Tensor | None = None  #: (7,) int64, left on the device: the first of `Counts`. Default: P pairs
    rows: Tensor | None = None  #: (B,) int64: index of each of `bodies` in the step. Default: the same
    capacity: BufferSizes | None = None  #: of the search, chosen before the pairs were known. Default: as estimated
    find_pairs: Callable[[], FoundPairs] | None = None  #: finds all pairs, called if they exceeded the capacity
    #: Capacity estimate of this pass, updated with what the search needed.
    estimate: CapacityEstimate = field(default_factory=CapacityEstimate)
    #: (S, 2) int64 rows of `bodies`: all pairs that may collide if bodies are stopped or slowed down on their way,
    #: `pairs` among them. Rows of -1 may follow. Default: not found
    swept_pairs: Tensor | None = None
    _search: PaddedSearch | None = field(default=None, init=False)
    _counts: Counts | None = field(default=None, init=False)
    _scratch_bytes: int = field(default=0, init=False)
    _contacts: Contacts | CollidingPairs | None = field(default=None, init=False)

    def __post_init__(self) -> None:
        # The capacity is proportional to the number of pairs, or of bodies if it was chosen before the pairs were
        # known.
        self._size = len(self.pairs) if self.capacity is None else self.bodies.scene.body_count

    def start(self) -> PaddedSearch:
        """Starts the search, unless it has been started. Does not synchronise."""
        if self._search is None:
            self._search = start_search(
                self.bodies, self.query, self.pairs, self.pair_counts, self.capacity, self.estimate
            )
            # Read now: another search may start before the counts are read.
            self._scratch_bytes = ops.take_scratch_peak() if self.pairs.is_cuda else 0
        return self._search

    def begin(self) -> None:
        """On a GPU starts the search; on a CPU runs it, unless it has been started."""
        if self.pairs.is_cuda or self._search is not None:
            self.start()
        else:
            self.find()

    def learn(self, counts: Counts) -> None:
        """Records the counts of the search, already read by the host, for `find` and for the estimate. No effect if
        `find` has already returned contacts.
        """
        if self._contacts is not None:
            return
        self._counts = counts
        if not counts.overflow:
            self.estimate.learn(self._size, counts.needed(self.start().capacity))

    def find(self) -> Contacts | CollidingPairs:
        """The contacts, as rows of `bodies`. Synchronises."""
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
        if self.pair_counts is not None:
            numbers, self.pair_counts = self.pair_counts.tolist(), None
            if numbers[COUNT_ROWS["pairs_overflow"]] and self.find_pairs is not None:
                self.pairs, self.swept_pairs = self.find_pairs()
            else:
                self.pairs = self.pairs[: numbers[COUNT_ROWS["pairs_written"]]]
        self._contacts = detect_moving(self.bodies, self.query, pairs=self.pairs)
        if self._contacts.stats.needed is not None:
            needed = sizes_of(self._contacts.stats.needed)
            if self._counts is not None:  # only the first search counts the broad phase
                needed = replace(
                    needed,
                    pairs=max(needed.pairs, self._counts.pairs),
                    overlaps=self._counts.overlaps,
                    long_rows=self._counts.long_rows != 0,
                )
            self.estimate.learn(self._size, needed)
        return self._contacts

    def first_contacts(self) -> tuple[Tensor, Tensor]:
        """Pairs (K, 2) as rows of the step's bodies, and toi (K,): of `find` if it has run, else of the search in
        progress, padded with -1 and inf. Does not synchronise; for report="first" only.
        """
        if self._contacts is None:
            return self._padded_first_contacts
        if isinstance(self._contacts, CollidingPairs):
            raise ValueError("pairs that collide have no toi")
        return self.in_step(self._contacts.pairs), self._contacts.toi

    @functools.cached_property
    def _padded_first_contacts(self) -> tuple[Tensor, Tensor]:
        rows = self.start().rows
        return self.in_step(rows[0]), rows[4]

    def counts(self) -> Tensor:
        """(22,) int64 on the device: `Counts` of the contacts that `first_contacts` returns."""
        if self._contacts is None:
            return self.start().counts[: len(COUNT_ROWS)]
        counts = _counts_of(self._contacts.stats)
        if self.swept_pairs is not None:
            listed = len(self.swept_pairs) if self._counts is None else self._counts.pairs
            counts[COUNT_ROWS["pairs"]] = listed
        return counts.to(self.pairs.device)

    def in_step(self, pairs: Tensor) -> Tensor:
        """Maps rows of `bodies` (K, 2), which may be -1, to rows of the step's bodies."""
        if self.rows is None:
            return pairs
        return self._rows_or_padding[pairs]

    @functools.cached_property
    def _rows_or_padding(self) -> Tensor:
        """`rows` followed by -1 for padding."""
        assert self.rows is not None
        return torch.cat([self.rows, self.rows.new_full((1,), -1)])


#: Selects the pairs to search from pairs (P, 2), which may be followed by rows of -1: returns a tensor of the same
#: shape with these pairs first, and their number (1,) int64 on the device.
Select = Callable[[Tensor], tuple[Tensor, Tensor]]


def find_pass(
    bodies: MovingBodies,
    query: Query,
    broad_phase: broad.BroadPhase = "auto",
    select: Select | None = None,
    discard: Tensor | None = None,
    rows: Tensor | None = None,
    estimate: CapacityEstimate | None = None,
    slack: float = PASS_SLACK,
    in_other_search: Tensor | None = None,
    at_any_times: bool = False,
) -> SearchPass:
    """The PCS of bodies, as a pass. On a GPU it is found in an estimated capacity without synchronising, if the
    estimate fits in memory. Then the bodies need not be validated: if they are invalid there are no pairs.

    Args:
        bodies, query, broad_phase: as for `detect_moving`.
        select: selects the pairs to search. Default: all.
        discard: (1,) int64 on the device; if nonzero, the result will be discarded and the search returns immediately.
        rows, estimate: as for `SearchPass`.
        slack: capacity relative to what the last step needed.
        in_other_search: (N,) uint8, nonzero for bodies whose pairs with each other another pass finds: left out here.
        at_any_times: whether to find `SearchPass.swept_pairs` too, by one broad phase.

    Raises:
        ValueError: the bodies are invalid, and the capacity could not be estimated.
    """
    separation, tolerance = query.min_separation, query.tolerance
    beyond: dict[str, Any] = {"in_other_search": in_other_search, "at_any_times": at_any_times}

    def select_pairs(pairs: Tensor) -> tuple[FoundPairs, Tensor | None]:
        """The pairs of this pass, which may be followed by rows of -1, and the number of those to search, if some were
        left out.
        """
        count = None
        if select is not None:
            pairs, count = select(pairs)
        if not at_any_times:
            return FoundPairs(pairs, None), count
        meeting, count = broad.meeting_pairs(bodies, pairs, separation, tolerance)
        return FoundPairs(meeting, pairs), count

    def find_pairs() -> FoundPairs:
        bodies._raise_invalid(bodies._first_invalid_rows().tolist())
        chosen = broad.choose(bodies, broad_phase)
        found, count = select_pairs(broad.find_pairs_of_checked(bodies, separation, chosen, tolerance, **beyond))
        return found if count is None else found._replace(pairs=found.pairs[: int(count)])

    estimate = estimate or CapacityEstimate()
    capacity = expected_capacity(bodies, None, estimate, slack=slack) if _looks_ahead(bodies) else None
    if capacity is None:
        found = find_pairs()
        return SearchPass(query, bodies, found.pairs, rows=rows, swept_pairs=found.swept_pairs)
    invalid = bodies._first_invalid_rows()[-1:]
    if discard is not None:
        invalid = torch.maximum(invalid, discard)
    pairs, counts = broad.find_pairs_padded(bodies, separation, broad_phase, capacity, invalid, tolerance, **beyond)
    found, count = select_pairs(pairs)
    if count is not None:
        row = COUNT_ROWS["pairs_written"]
        counts[row : row + 1].copy_(count)
    return SearchPass(query, bodies, found.pairs, counts, rows, capacity, find_pairs, estimate, found.swept_pairs)


def _counts_of(stats: Stats) -> Tensor:
    """(22,) int64: `Counts` reconstructed from the statistics of a finished search."""
    counts = dict.fromkeys(Counts._fields, 0)
    counts |= {"pairs": stats.pcs, "pairs_written": stats.pcs, "candidates": stats.candidates}
    counts |= {"contacts": stats.contacts, "unresolved": stats.unresolved, "node_tests": stats.node_tests}
    counts["traverse_ended"] = round(1e9 * stats.seconds["traverse"])
    counts["narrow_ended"] = counts["traverse_ended"] + round(1e9 * stats.seconds["narrow"])
    return torch.tensor(list(counts.values()))


def _looks_ahead(bodies: MovingBodies) -> bool:
    return bodies.device.type != "cpu"


def contacts_of_step(passes: Sequence[SearchPass]) -> Contacts | CollidingPairs:
    """The contacts of all passes, concatenated, as rows of the step's bodies. Synchronises."""
    found = [each.find() for each in passes]
    if len(passes) == 1:
        return found[0]
    in_step: Any = [replace(own, pairs=each.in_step(own.pairs)) for each, own in zip(passes, found, strict=True)]
    return type(found[0]).cat(in_step)


def first_contacts_of(passes: Sequence[SearchPass]) -> tuple[Tensor, Tensor]:
    """Pairs (K, 2) as rows of the step's bodies and toi (K,) of all passes: see `SearchPass.first_contacts`."""
    pairs, toi = zip(*(each.first_contacts() for each in passes), strict=True)
    return (pairs[0], toi[0]) if len(pairs) == 1 else (torch.cat(pairs), torch.cat(toi))


def search_seconds(found: Counts | Stats) -> dict[str, float]:
    """Seconds of traversal and narrow phase. The broad phase is timed where pairs are found."""
    return {stage: found.seconds[stage] for stage in ("traverse", "narrow")}


def pairs_of_rounds(passes: Sequence[SearchPass]) -> Tensor:
    """(P, 2) int64: the pairs of all passes as rows of the step's bodies, `swept_pairs` where these were found; rows of
    -1 may be anywhere.
    """
    found = [each.pairs if each.swept_pairs is None else each.swept_pairs for each in passes]
    if len(passes) == 1:
        return found[0]
    return torch.cat([each.in_step(pairs) for each, pairs in zip(passes, found, strict=True)])
