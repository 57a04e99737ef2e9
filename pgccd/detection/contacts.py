"""Contacts: the result of `detect`."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any, Literal

import torch
from torch import Tensor

from pgccd import arguments
from pgccd.detection.capacity import COUNT_ROWS, Capacity, CapacityError, Counts
from pgccd.motion.faults import Faults
from pgccd.ops import ContactRows

if TYPE_CHECKING:
    from pgccd.geometry.scene import Scene


#: Names of the columns of contacts, in the operators' order.
COLUMNS = ("pairs", "kind", "features", "status", "toi", "coordinates", "point", "normal")


def all_columns(columns: Mapping[str, Tensor]) -> dict[str, Any]:
    """The given columns of contacts, and None for the others."""
    return {name: columns.get(name) for name in COLUMNS}


def named_columns(rows: ContactRows, report: str) -> dict[str, Any]:
    """Columns of contacts by name, from rows with body pairs in the first column; of report="any" only the pairs."""
    return all_columns({"pairs": rows[0]}) if report == "any" else dict(zip(COLUMNS, rows, strict=True))


def earliest_row(toi: Tensor, *ties: Tensor) -> Tensor:
    """(1,) int64: the row with the smallest toi (K,); ties are broken by the first of `ties` (K,), then by the next,
    then by row. (0,) if K is 0. Does not synchronise.
    """
    rows = torch.arange(len(toi), device=toi.device)
    is_least = torch.ones_like(rows, dtype=torch.bool)
    for column in (toi, *ties, rows) if len(rows) else ():
        largest = torch.inf if column.is_floating_point() else torch.iinfo(column.dtype).max
        column = torch.where(is_least, column, largest)
        is_least &= column == column.min()
    return torch.where(is_least, rows, 0).sum().reshape(1) if len(rows) else rows


def take_earliest(rows: ContactRows) -> ContactRows:
    """The row with the smallest toi, the first of equal ones, from rows in canonical order, which may be padded."""
    toi = rows[4]
    if len(toi) <= 1:
        return rows
    if toi.device.type == "cpu" and not torch.compiler.is_compiling():  # one call instead of ten
        first = int(toi.numpy().argmin())
        return tuple(column[first : first + 1] for column in rows)  # type: ignore[return-value]
    row = earliest_row(toi)
    return tuple(column[row] for column in rows)  # type: ignore[return-value]


@dataclass
class Stats:
    """Statistics of one call of `detect`.

    `seconds` has one entry per stage: bounds, broad, traverse, narrow. On a GPU they are device times, except for
    bounds and for streamed steps, where they are host times.
    """

    bodies: int = 0
    pcs: int = 0  #: potentially colliding body pairs
    node_tests: int = 0  #: node pairs tested in the traversal
    candidates: int = 0  #: feature pairs left by the traversal
    contacts: int = 0  #: rows reported
    unresolved: int = 0  #: rows reported because the iteration budget was spent
    broad_phase: str = ""  #: "sweep", "grid" or "lbvh"; "given" if the caller passed the pairs
    chunks: int = 0  #: chunks in which the PCS was streamed
    waits: int = 0  #: number of times the host waited for a GPU
    scratch_bytes: int = 0  #: peak scratch memory of one GPU operator
    needed: Capacity | None = None  #: capacity the step needed; on a GPU None if it was streamed
    seconds: dict[str, float] = field(default_factory=dict)


#: The grouping of first times.
By = Literal["scene", "world", "body"]


def first_time(pairs: Tensor, time: Tensor | None, scene: Scene | None, by: By) -> Tensor:
    """The smallest `time` (K,) of rows of `pairs` (K, 2), which may be padded with -1; see `Contacts.first_toi`."""
    if by not in ("scene", "world", "body"):
        raise ValueError(f'by: expected "scene", "world" or "body", got {by!r}')
    if time is None:
        raise ValueError('report: "any" gives no times; ask for "first" or "earliest"')
    if by == "scene":
        return torch.cat([time, time.new_full((1,), torch.inf)]).min()
    if scene is None:
        raise ValueError(f"by: {by!r} needs the result of `pgccd.detect`; on many ranks see `World.first_toi`")
    count = scene.body_count
    # One extra row for padding.
    owner = torch.where(pairs < 0, count, pairs).reshape(-1)
    if by == "world":
        count = scene.world_count
        if scene.world is None:
            owner = (owner == scene.body_count).long()
        else:
            owner = torch.cat([scene.world.long(), scene.world.new_full((1,), count, dtype=torch.int64)])[owner]
    first = time.new_full((count + 1,), torch.inf)
    return first.scatter_reduce(0, owner, time.repeat_interleave(2), "amin")[:count]


@dataclass
class ContactColumns:
    """One row per contact. With report="any" only `pairs` is meaningful and all other columns are None."""

    pairs: Tensor  #: (K, 2) int64 body indices, i < j; i, i where a body touches itself
    toi: Tensor | None  #: (K,) float64 in [0, 1]: these features do not touch before it; 0 if they touch at t0
    kind: Tensor | None  #: (K,) int8, see `Kind`
    features: Tensor | None  #: (K, 2) int32: vertex, face or edge index of i, then of j, in their meshes
    #: (K, 2), of the nearest points at toi: (u, v) of the face point f0 + u (f1 - f0) + v (f2 - f0), or parameters
    #: along i's and j's edge
    coordinates: Tensor | None
    point: Tensor | None  #: (K, 3) world: halfway between the nearest points at toi
    #: (K, 3) unit vector from i (or the first feature) towards j at toi; zero if degenerate features coincide
    normal: Tensor | None
    status: Tensor | None  #: (K,) int8, see `Status`
    #: The scene of the bodies; None where `pairs` are not rows of one scene.
    scene: Scene | None = field(default=None, init=False, repr=False, compare=False)

    @property
    def columns(self) -> dict[str, Tensor]:
        """The columns that are not None, by name."""
        columns = {name: getattr(self, name) for name in COLUMNS}
        return {name: column for name, column in columns.items() if column is not None}

    def first_toi(self, by: By = "scene") -> Tensor:
        """The first toi, float64, inf without a contact: () for the "scene", (W,) per "world" (W is one more than the
        largest world index), or (N,) per "body". Does not synchronise; contacts missing after an overflow are ignored.

        Raises:
            ValueError: the report was "any", or `by` is unknown or needs a scene.

        Example:
            >>> x0 + hits.first_toi("scene").clamp(max=1.0) * (x1 - x0)  # the collision-free part of the step
        """
        return first_time(self.pairs, self.toi, self.scene, by)


@dataclass
class Contacts(ContactColumns):
    """K contacts, sorted by pair, then kind and features."""

    stats: Stats

    def __len__(self) -> int:
        return self.pairs.shape[0]

    def __getitem__(self, rows: Tensor | slice | Sequence[int]) -> Contacts:
        """A subset of the contacts: a mask (K,), row numbers or a slice. `stats` remain those of the whole call.

        Example:
            >>> early = hits[hits.toi < 0.5]
        """
        picked = arguments.rows(rows, "rows", len(self))
        return self._map(lambda column: column[picked])

    def earliest(self, *ties: Tensor) -> Contacts:
        """The contact with the smallest toi (see `earliest_row` for ties), or none if there are no contacts."""
        assert self.toi is not None
        found = self[earliest_row(self.toi, *ties)]
        return replace(found, stats=replace(found.stats, contacts=len(found)))

    def to(self, device: torch.device | str) -> Contacts:
        """A copy on another device.

        Example:
            >>> hits = hits.to("cpu")
        """
        device = arguments.device(device)
        return self._map(lambda column: column.to(device))

    def clone(self) -> Contacts:
        """A copy of all columns.

        Example:
            >>> kept = hits.clone()
        """
        return self._map(Tensor.clone)

    def _map(self, change: Callable[[Tensor], Tensor]) -> Contacts:
        columns: dict[str, Any] = {name: change(column) for name, column in self.columns.items()}
        changed = replace(self, **columns)
        changed.scene = self.scene
        return changed

    def __repr__(self) -> str:
        return f"Contacts(count={len(self)}, pcs={self.stats.pcs}, device={self.pairs.device})"


@dataclass
class PaddedContacts(ContactColumns):
    """Contacts in a fixed number of rows, from `detect(capacity=...)`: the host has not synchronised yet.

    The first `count` rows are contacts as in `Contacts`. The rest is padding: pairs and features -1, toi inf, status
    FREE, all else 0, so `toi.min()` needs no mask.
    """

    count: Tensor  #: (1,) int64: number of contacts
    #: (1,) bool: a capacity was exceeded or the input is invalid, so contacts may be missing. `trim` raises the error.
    overflow: Tensor
    counts: Tensor  #: (21 + F,) int64: `pgccd.detection.capacity.Counts`, then `pgccd.MovingBodies.first_faults`
    capacity: Capacity
    broad_phase: str  #: as in `Stats`
    bodies: int  #: number of bodies
    faults: Faults  #: meaning of the last values of `counts`

    def trim(self) -> Contacts:
        """The contacts without padding, with stats. Synchronises.

        Raises:
            CapacityError: a capacity was exceeded.
            ValueError: the input is invalid.

        Example:
            >>> hits = pgccd.detect(scene, motion, capacity=capacity).trim()
        """
        values = self.counts.tolist()
        self.faults.raise_from(values[len(COUNT_ROWS) :])
        counts = Counts.of(values[: len(COUNT_ROWS)])
        if counts.overflow:
            raise CapacityError(self.capacity, counts.needed(self.capacity))
        count = min(counts.contacts, len(self.pairs))  # "earliest" has one row
        columns = all_columns({name: column[:count] for name, column in self.columns.items()})
        stats = stats_of(counts, self.capacity, self.bodies, count, self.broad_phase, waits=int(self.counts.is_cuda))
        contacts = Contacts(**columns, stats=stats)
        contacts.scene = self.scene
        return contacts

    def __repr__(self) -> str:
        return f"PaddedContacts(capacity={len(self.pairs)}, device={self.pairs.device})"


def stats_of(counts: Counts, capacity: Capacity, bodies: int, contacts: int, broad_phase: str, waits: int) -> Stats:
    """Statistics of a step that was run at once, in `capacity`."""
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
