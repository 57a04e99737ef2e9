"""The result of `detect`."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, fields, replace
from typing import Any

import torch
from torch import Tensor

from pgccd import arguments
from pgccd.capacity import COUNT_ROWS, Capacity, CapacityError, Counts
from pgccd.faults import Faults

#: Columns of contacts as the operators give them: row of the pairs (K,), kind (K,), features (K, 2), status (K,), toi
#: (K,), coordinates (K, 2), point (K, 3), normal (K, 3).
ContactRows = tuple[Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor]


@dataclass
class Stats:
    """What one call of `detect` did.

    `seconds` has one entry a stage: bounds, broad, traverse, narrow. On a GPU these are times of the device, but for
    the host's time in bounds and in whatever is streamed.
    """

    bodies: int = 0
    pcs: int = 0  #: potentially colliding body pairs
    node_tests: int = 0  #: node pairs tested while traversing
    candidates: int = 0  #: feature pairs that survived it
    contacts: int = 0  #: rows reported
    unresolved: int = 0  #: rows reported because the iteration budget was spent
    broad_phase: str = ""  #: "sweep", "grid" or "lbvh"; "given" if the pairs were
    chunks: int = 0  #: pieces in which the PCS was streamed
    waits: int = 0  #: times the host waited for a GPU
    scratch_bytes: int = 0  #: most scratch memory that one operator on a GPU held
    needed: Capacity | None = None  #: room the step needed; on a GPU None if it was streamed
    seconds: dict[str, float] = field(default_factory=dict)


@dataclass
class Contacts:
    """K contacts, sorted by pair, then kind and features.

    With report="any" only `pairs` is meaningful (which contact proves a pair colliding depends on the order of work),
    and all other fields are None.
    """

    pairs: Tensor  #: (K, 2) int64 body indices, i < j; i, i where a body touches itself
    toi: (
        Tensor | None
    )  #: (K,) float64 in [0, 1]: no contact of these features happens before it; 0: touching at t0 already
    kind: Tensor | None  #: (K,) int8, see `Kind`
    features: Tensor | None  #: (K, 2) int32: vertex or face or edge of i, then of j, as numbered in their meshes
    coordinates: (
        Tensor | None
    )  #: (K, 2): face point f0 + u (f1 - f0) + v (f2 - f0), or parameters along i's and j's edge
    point: Tensor | None  #: (K, 3) world: halfway between the nearest points at toi
    normal: (
        Tensor | None
    )  #: (K, 3) unit vector from i (or the first feature) towards j at toi (zero if degenerate features coincide)
    status: Tensor | None  #: (K,) int8, see `Status`
    stats: Stats

    def __len__(self) -> int:
        return self.pairs.shape[0]

    def __getitem__(self, rows: Tensor | slice | Sequence[int]) -> Contacts:
        """The contacts of some rows: a mask (K,), row numbers or a slice. `stats` stay those of the whole call.

        Example:
            >>> early = hits[hits.toi < 0.5]
        """
        picked = arguments.rows(rows, "rows", len(self))
        return self._with({name: column[picked] for name, column in _columns(self).items()})

    def to(self, device: torch.device | str) -> Contacts:
        """The same on another device.

        Example:
            >>> hits = hits.to("cpu")
        """
        device = arguments.device(device)
        return self._with({name: column.to(device) for name, column in _columns(self).items()})

    def _with(self, columns: dict[str, Any]) -> Contacts:
        return replace(self, **columns)

    def __repr__(self) -> str:
        return f"Contacts(count={len(self)}, pcs={self.stats.pcs}, device={self.pairs.device})"


@dataclass
class PaddedContacts:
    """Contacts in a fixed number of rows, from `detect(capacity=...)`: nothing has waited for the device yet.

    The first `count` rows are contacts as in `Contacts`. The rest is padding: pairs and features -1, toi inf, status
    FREE, all else 0; so that `toi.min()` needs no mask. Columns are None where those of `Contacts` are.
    """

    pairs: Tensor  #: (capacity.contacts, 2) int64
    toi: Tensor | None
    kind: Tensor | None
    features: Tensor | None
    coordinates: Tensor | None
    point: Tensor | None
    normal: Tensor | None
    status: Tensor | None
    count: Tensor  #: (1,) int64: number of contacts
    #: (1,) bool: there was not room for everything, or the input is invalid, and contacts may be missing. `trim` says
    #: which.
    overflow: Tensor
    counts: Tensor  #: (21 + F,) int64: `pgccd.capacity.Counts`, then `pgccd.MovingBodies.first_faults`
    capacity: Capacity
    broad_phase: str  #: as in `Stats`
    bodies: int  #: number of bodies
    faults: Faults  #: what the last of `counts` mean

    def trim(self) -> Contacts:
        """The contacts alone, with stats. Waits for the device.

        Raises:
            CapacityError: there was not room for everything.
            ValueError: the input is invalid.

        Example:
            >>> hits = pgccd.detect(scene, motion, capacity=room).trim()
        """
        values = self.counts.tolist()
        self.faults.raise_from(values[len(COUNT_ROWS) :])
        counts = Counts.of(values[: len(COUNT_ROWS)])
        if counts.overflow:
            raise CapacityError(self.capacity, counts.needed(self.capacity))
        count = min(counts.contacts, len(self.pairs))  # of the earliest there is one row
        columns = {name: None if column is None else column[:count] for name, column in _all_columns(self).items()}
        stats = stats_of(counts, self.capacity, self.bodies, count, self.broad_phase, waits=int(self.counts.is_cuda))
        return Contacts(**columns, stats=stats)  # type: ignore[arg-type]

    def __repr__(self) -> str:
        return f"PaddedContacts(room={len(self.pairs)}, device={self.pairs.device})"


def stats_of(counts: Counts, capacity: Capacity, bodies: int, contacts: int, broad_phase: str, waits: int) -> Stats:
    """What a step did that was made at once, within `capacity`."""
    return Stats(
        bodies=bodies,
        pcs=counts.pairs_written,
        node_tests=counts.node_tests,
        candidates=counts.candidates,
        contacts=contacts,
        unresolved=counts.unresolved,
        broad_phase=broad_phase,
        chunks=1,
        waits=waits,
        needed=counts.needed(capacity),
        seconds=counts.seconds,
    )


_COLUMNS = tuple(each.name for each in fields(Contacts) if each.name != "stats")


def _all_columns(contacts: Contacts | PaddedContacts) -> dict[str, Any]:
    return {name: getattr(contacts, name) for name in _COLUMNS}


def _columns(contacts: Contacts) -> dict[str, Tensor]:
    return {name: column for name, column in _all_columns(contacts).items() if column is not None}
