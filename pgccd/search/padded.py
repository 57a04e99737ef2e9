"""Detection in a given capacity, without synchronising until the result is read."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from pgccd import ops
from pgccd.contacts.by_body import SceneBodies
from pgccd.contacts.contacts import COLUMNS, CollidingPairs, ContactRows, Contacts, contacts_of, take_earliest
from pgccd.contacts.padded import PaddedCollidingPairs, PaddedContacts, stats_of
from pgccd.runtime.sizes import COUNT_ROWS, COUNTS_OF_PAIRS, EXACTLY, BufferSizes, Counts, overflow_flags
from pgccd.search import broad
from pgccd.search.bodies import MovingBodies
from pgccd.search.query import Query

# Rows of a buffer that a result may keep, whatever its own number of rows.
_SMALL_BUFFER = 256


@dataclass
class PaddedSearch:
    """A step in progress."""

    bodies: MovingBodies
    query: Query
    capacity: BufferSizes
    broad_phase: str
    rows: ContactRows  #: padded; the first column is body pairs (., 2)
    counts: Tensor  #: (22 + F,) int64: `Counts`, then `MovingBodies._first_invalid_rows`
    #: (N,) float64, negative for bodies whose pose is invalid; all other bodies were searched. None: nothing was
    #: searched if a pose is invalid.
    reach: Tensor | None = None

    def read(self) -> Counts:
        """Reads the counts. Synchronises.

        Raises:
            ValueError: the input is invalid.
        """
        values = self.counts.tolist()
        self.bodies._raise_invalid(values[len(COUNT_ROWS) :])
        return Counts.of(values[: len(COUNT_ROWS)])

    def contacts(self, counts: Counts) -> Contacts | CollidingPairs:
        """The contacts, given the counts, if nothing overflowed."""
        count = counts.contacts
        rows = self.rows
        if rows[0].shape[0] != count:
            # A result that is kept does not keep large buffers of the search.
            if rows[0].shape[0] > max(_SMALL_BUFFER, 4 * count):
                rows = tuple(ops.take_rows(list(rows), [], torch.arange(count, device=rows[0].device)))  # type: ignore
            else:
                rows = tuple(column[:count] for column in rows)  # type: ignore[assignment]
        if self.query.report == "earliest":
            rows = take_earliest(rows)
        bodies, waits = self.bodies.scene.body_count, int(self.counts.is_cuda)
        stats = stats_of(counts, self.capacity, bodies, rows[0].shape[0], self.broad_phase, waits)
        return contacts_of(rows, self.query.report, stats)

    def padded(self) -> PaddedContacts | PaddedCollidingPairs:
        """The padded contacts, without reading the counts. Sets every toi to 0 if they are incomplete."""
        rows, count = self.rows, self.counts[COUNT_ROWS["contacts"]].reshape(1)
        if self.query.report == "earliest":
            rows, count = take_earliest(rows), count.clamp(max=1)
        incomplete = torch.cat([*overflow_flags(self.counts), self.counts[-1:]]).any().reshape(1)
        of_search: dict[str, Any] = {
            "count": count,
            "overflow": incomplete,
            "counts": self.counts,
            "capacity": self.capacity,
            "broad_phase": self.broad_phase,
            "_bodies": SceneBodies.of(self.bodies.scene),
            "_validation": self.bodies._validation.weakly(),
            "_reach": self.reach,
        }
        if self.query.report == "any":
            return PaddedCollidingPairs(pairs=rows[0], **of_search)
        columns: dict[str, Any] = dict(zip(COLUMNS, rows, strict=True))
        of_search |= {"_found_toi": columns["toi"], "_is_earliest": self.query.report == "earliest"}
        columns["toi"] = columns["toi"].masked_fill(incomplete, 0.0)
        return PaddedContacts(**columns, **of_search)


def counts_of_given(pairs: Tensor, count: Tensor | None = None) -> Tensor:
    """(7,) int64: the broad phase's counts for given pairs (P, 2), of which `count` (1,) are valid (default: all)."""
    if count is None and pairs.device.type == "cpu":
        values = [0] * COUNTS_OF_PAIRS
        values[COUNT_ROWS["pairs"]] = values[COUNT_ROWS["pairs_written"]] = pairs.shape[0]
        return torch.tensor(values)
    written = count
    if written is None:
        written = torch.full((1,), pairs.shape[0], dtype=torch.int64, device=pairs.device)
    counts, nothing = {"pairs": written, "pairs_written": written}, torch.zeros_like(written)
    return torch.cat([counts.get(name, nothing) for name in list(COUNT_ROWS)[:COUNTS_OF_PAIRS]])


def search_padded(
    bodies: MovingBodies,
    query: Query,
    capacity: BufferSizes,
    broad_phase: broad.BroadPhase,
    pairs: Tensor | None,
    pair_counts: Tensor | None = None,
    marks_invalid: bool = False,
) -> PaddedSearch:
    """Starts a step.

    Args:
        bodies: made with `wait=False`.
        query: options of the search.
        capacity: of the result and of all intermediate lists.
        broad_phase: how the PCS is found.
        pairs: (P, 2) int64, instead of a broad phase.
        pair_counts: (7,) int64 on the device: the broad phase's counts, if the number of pairs is not P.
        marks_invalid: whether to search the other bodies if a pose is invalid, where `search_rigid` can.
    """
    if pairs is None and not bodies.deforming and bodies.scene.exclude is None:
        return search_rigid(bodies, query, capacity, broad_phase, capacity.of_pairs, marks_invalid)
    invalid_rows = bodies._first_invalid_rows()
    if pairs is None:
        chosen = broad.choose(bodies, broad_phase)
        pairs, pair_counts = broad.find_pairs_padded(
            bodies, query.min_separation, chosen, capacity, invalid_rows[-1:], query.tolerance
        )
    else:
        chosen = None
        pair_counts = counts_of_given(pairs) if pair_counts is None else pair_counts
        if capacity is not EXACTLY and bodies._motion is not None:  # on a CPU the caller has looked
            pair_counts = pair_counts * (1 - invalid_rows[-1:])
    *rows, counts = ops.contacts_padded(
        bodies.operands,
        pairs,
        pair_counts,
        invalid_rows,
        *query.lengths,
        query.options,
        capacity.of_contacts,
    )
    return PaddedSearch(bodies, query, capacity, chosen or "given", tuple(rows), counts)  # type: ignore[arg-type]


def search_rigid(
    bodies: MovingBodies,
    query: Query,
    capacity: BufferSizes,
    broad_phase: broad.BroadPhase,
    pair_capacity: Sequence[int],
    marks_invalid: bool = False,
) -> PaddedSearch:
    """A step of rigid bodies by one operator.

    Args:
        bodies, query, capacity, broad_phase: as for `search_padded`.
        pair_capacity: of the PCS, see `ops.pairs_padded`. If `capacity` is EXACTLY and there are more pairs, no
            contacts are searched, and the overflow is counted.
        marks_invalid: whether to search the other bodies if a pose is invalid: see `PaddedSearch.reach`.
    """
    chosen = broad.chosen_for(bodies, broad_phase)
    *rows, counts = ops.detect_rigid(
        bodies.scene.meshes.tensors,
        bodies.tensors,
        bodies.linear_path,
        bodies._swept(),
        bodies._first_invalid_rows(),
        marks_invalid,
        *query.lengths,
        query.options,
        broad.BROAD_PHASE_NUMBERS[chosen],
        pair_capacity,
        capacity.of_contacts,
    )
    found = tuple(rows)
    reach = bodies.reach if marks_invalid else None
    return PaddedSearch(bodies, query, capacity, chosen, found, counts, reach)  # type: ignore[arg-type]


def lower_first_toi(
    first: Tensor,
    owners: Tensor,
    mesh_set: Sequence[Tensor],
    tensors: Sequence[Tensor],
    linear_path: bool,
    pairs: Tensor,
    pair_counts: Tensor,
    query: Query,
    capacity: BufferSizes,
) -> Tensor:
    """Traversal and narrow phase of rigid bodies for the first toi of each pair alone. Surfaces are assumed not to
    intersect at t = 0. Does not synchronise.

    Args:
        first: (N,) float64: the first toi so far; lowered in place.
        owners: (P, 2) int64: the rows of `first` that each pair lowers.
        mesh_set, tensors, linear_path: as of `MovingBodies`.
        pairs: (P, 2) int64; rows beyond `pairs_written` are padding.
        pair_counts: (7,) int64 on the device, the first of `Counts`.
        query, capacity: of the search.

    Returns:
        Counts (22,); `contacts` is the number of pairs with a contact.
    """
    return ops.lower_first_toi_rigid(
        first,
        owners,
        mesh_set,
        tensors,
        linear_path,
        pairs,
        pair_counts,
        *query.lengths,
        query.nonzero_toi,
        capacity.of_contacts[:-1],  # no contacts are written
    )
