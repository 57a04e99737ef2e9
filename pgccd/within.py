"""Detection within a given room: nothing waits for the device until the result is asked for."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from pgccd import broad, narrow, ops
from pgccd.bodies import MovingBodies
from pgccd.capacity import COUNT_ROWS, COUNTS_OF_PAIRS, Capacity, Counts
from pgccd.contacts import ContactRows, Contacts, PaddedContacts, Stats
from pgccd.query import Query
from pgccd.traverse import operator_tolerance


class CapacityError(RuntimeError):
    """There was not room for all of a step; `needed` says how much it takes at least."""

    def __init__(self, capacity: Capacity, needed: Capacity) -> None:
        short = [
            f"{name}: {getattr(needed, name)} in {getattr(capacity, name)}"
            for name in capacity.__dataclass_fields__
            if getattr(needed, name) > getattr(capacity, name)
        ]
        super().__init__(f"capacity: the step needs more room: {', '.join(short)}; see Capacity.grown")
        self.capacity, self.needed = capacity, needed


@dataclass
class Search:
    """A step on its way."""

    bodies: MovingBodies
    query: Query
    capacity: Capacity
    broad_phase: str
    pairs: Tensor  #: (P, 2) int64 with padding
    rows: ContactRows  #: with padding
    faults: Tensor  #: see `MovingBodies.first_faults`
    counts: Tensor  #: (21,) int64, see `Counts`

    def read(self) -> Counts:
        """Waits for the counts.

        Raises:
            ValueError: the input is invalid.
        """
        values = torch.cat([self.counts, self.faults]).tolist()
        fields = len(self.counts)
        self.bodies.raise_faults(values[fields:])
        return Counts.of(values[:fields])

    def contacts(self, counts: Counts) -> Contacts:
        """The result, once the counts are known and there was room."""
        count = counts.contacts
        rows: ContactRows = tuple(column[:count] for column in self.rows)  # type: ignore[assignment]
        if self.query.report == "earliest":
            rows = narrow.keep_earliest(rows)
        stats = Stats(
            bodies=self.bodies.scene.body_count,
            pcs=counts.pairs,
            node_tests=counts.node_tests,
            candidates=counts.candidates,
            contacts=len(rows[0]),
            unresolved=counts.unresolved,
            broad_phase=self.broad_phase,
            chunks=1,
            waits=int(self.pairs.is_cuda),
            scratch_bytes=self.capacity.bytes if self.pairs.is_cuda else 0,
            needed=counts.needed(self.capacity),
            seconds=counts.seconds,
        )
        pairs = self.pairs[rows[0].long()]
        if self.query.report == "any":
            return Contacts(pairs, None, None, None, None, None, None, None, stats)
        _, kind, features, status, toi, coordinates, point, normal = rows
        return Contacts(pairs, toi, kind, features, coordinates, point, normal, status, stats)

    def padded(self) -> PaddedContacts:
        """The result, whatever the counts."""

        def trim() -> Contacts:
            counts = self.read()
            needed = counts.needed(self.capacity)
            if not self.capacity.holds(needed):
                raise CapacityError(self.capacity, needed)
            return self.contacts(counts)

        rows, count = self.rows, self._count("contacts")
        if self.query.report == "earliest":
            rows, count = _earliest_row(rows), count.clamp(max=1)
        row, kind, features, status, toi, coordinates, point, normal = rows
        pairs = torch.where(row[:, None] < 0, -1, self.pairs[row.clamp(min=0).long()])
        columns = (toi, kind, features, coordinates, point, normal, status)
        if self.query.report == "any":
            columns = (None,) * len(columns)  # type: ignore[assignment]
        lost = sum(self._count(f"{stage}_overflow") for stage in ("pairs", "traverse", "contacts"))
        overflow = (lost > 0) | self.bodies.invalid(self.faults)
        return PaddedContacts(pairs, *columns, count, overflow, self.faults, self.counts, self.capacity, trim)

    def _count(self, name: str) -> Tensor:
        return self.counts[COUNT_ROWS[name]].reshape(1)


def search_within(
    bodies: MovingBodies, query: Query, capacity: Capacity, broad_phase: broad.BroadPhase, pairs: Tensor | None
) -> Search:
    """Starts a step.

    Args:
        bodies: made with `wait=False`.
        query: what is asked.
        capacity: room for the answer and for what is needed on the way.
        broad_phase: how the PCS is found.
        pairs: (P, 2) int64, instead of that.
    """
    faults = bodies.first_faults()
    invalid = bodies.invalid(faults)
    if pairs is None:
        chosen = broad.choose(bodies, broad_phase)
        pairs, pair_counts = broad.find_pairs_within(bodies, query.min_separation, chosen, capacity, invalid)
        written = pair_counts[COUNT_ROWS["pairs_written"]].reshape(1)
    else:
        chosen = None
        written = torch.where(invalid, 0, len(pairs))
        pair_counts = torch.zeros(COUNTS_OF_PAIRS, dtype=torch.int64, device=pairs.device)
        pair_counts[COUNT_ROWS["pairs"]] = len(pairs)
        if len(pairs) == 0:
            pairs = pairs.new_full((1, 2), -1)
    settings = (query.min_separation, operator_tolerance(query.tolerance), query.nonzero_toi)
    rest = (pairs, written, *settings, narrow.REPORTS[query.report], capacity.of_contacts)
    if bodies.deforming:
        *rows, contact_counts = ops.contacts_within_deforming(bodies.mesh_set, bodies.tensors, *rest)
    else:
        *rows, contact_counts = ops.contacts_within_rigid(bodies.mesh_set, bodies.tensors, bodies.linear_path, *rest)
    counts = torch.cat([pair_counts, contact_counts])
    return Search(bodies, query, capacity, chosen or "given", pairs, tuple(rows), faults, counts)  # type: ignore[arg-type]


def _earliest_row(rows: ContactRows) -> ContactRows:
    """One row: of those with the least toi the first; padding if there is none."""
    toi = rows[4]
    row = torch.arange(len(toi), device=toi.device)
    first = torch.where(toi == toi.min(), row, len(toi)).min().reshape(1)
    return tuple(column[first] for column in rows)  # type: ignore[return-value]
