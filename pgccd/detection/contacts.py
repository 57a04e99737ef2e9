"""The result of `detect`."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, fields, replace
from typing import TYPE_CHECKING, Any, Literal

import torch
from torch import Tensor

from pgccd import arguments
from pgccd.detection.capacity import COUNT_ROWS, Capacity, CapacityError, Counts
from pgccd.motion.faults import Faults

if TYPE_CHECKING:
    from pgccd.geometry.scene import Scene

#: Columns of contacts as the operators give them: row of the pairs (K,), kind (K,), features (K, 2), status (K,), toi
#: (K,), coordinates (K, 2), point (K, 3), normal (K, 3).
ContactRows = tuple[Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor]


def earliest_row(toi: Tensor, *ties: Tensor) -> Tensor:
    """(1,) int64: the row with the least toi (K,); of equal ones that with the least of the first of `ties` (K,), then
    of the next one, then the first row. (0,) if K is 0. Waits for nothing."""
    rows = torch.arange(len(toi), device=toi.device)
    is_least = torch.ones_like(rows, dtype=torch.bool)
    for column in (toi, *ties, rows) if len(rows) else ():
        largest = torch.inf if column.is_floating_point() else torch.iinfo(column.dtype).max
        column = torch.where(is_least, column, largest)
        is_least &= column == column.min()
    return torch.where(is_least, rows, 0).sum().reshape(1) if len(rows) else rows


def take_earliest(rows: ContactRows) -> ContactRows:
    """Of rows in canonical order, perhaps padded, the one with the least toi, the first of equal ones."""
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
    needed: Capacity | None = None  #: capacity the step needed; on a GPU None if it was streamed
    seconds: dict[str, float] = field(default_factory=dict)


#: Of what first times are asked for.
By = Literal["scene", "world", "body"]


def first_time(pairs: Tensor, time: Tensor | None, scene: Scene | None, by: By) -> Tensor:
    """The least `time` (K,) of rows of `pairs` (K, 2), perhaps padded with -1; see `Contacts.first_toi`."""
    if by not in ("scene", "world", "body"):
        raise ValueError(f'by: expected "scene", "world" or "body", got {by!r}')
    if time is None:
        raise ValueError('report: "any" gives no times; ask for "first" or "earliest"')
    if by == "scene":
        return torch.cat([time, time.new_full((1,), torch.inf)]).min()
    if scene is None:
        raise ValueError(f"by: {by!r} needs the result of `pgccd.detect`; on many ranks see `World.first_toi`")
    count = scene.body_count
    # One more, for padding.
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
    #: What the bodies are of; None where `pairs` are not rows of one scene.
    scene: Scene | None = field(default=None, init=False, repr=False, compare=False)

    def __len__(self) -> int:
        return self.pairs.shape[0]

    def first_toi(self, by: By = "scene") -> Tensor:
        """The first toi, float64, inf where nothing collides: () of the "scene", (W,) of each "world" (W is one more
        than the largest in the scene), or (N,) of each "body".

        Raises:
            ValueError: report: it was "any".

        Example:
            >>> x0 + hits.first_toi("scene").clamp(max=1.0) * (x1 - x0)  # as far as all may go
        """
        return first_time(self.pairs, self.toi, self.scene, by)

    def __getitem__(self, rows: Tensor | slice | Sequence[int]) -> Contacts:
        """The contacts of some rows: a mask (K,), row numbers or a slice. `stats` stay those of the whole call.

        Example:
            >>> early = hits[hits.toi < 0.5]
        """
        picked = arguments.rows(rows, "rows", len(self))
        return self._with({name: column[picked] for name, column in _columns(self).items()})

    def earliest(self, *ties: Tensor) -> Contacts:
        """The one with the least toi; of equal ones see `earliest_row`. None of none."""
        assert self.toi is not None
        found = self[earliest_row(self.toi, *ties)]
        return replace(found, stats=replace(found.stats, contacts=len(found)))

    def to(self, device: torch.device | str) -> Contacts:
        """The same on another device.

        Example:
            >>> hits = hits.to("cpu")
        """
        device = arguments.device(device)
        return self._with({name: column.to(device) for name, column in _columns(self).items()})

    def clone(self) -> Contacts:
        """The same in memory of its own.

        Example:
            >>> kept = hits.clone()
        """
        return self._with({name: column.clone() for name, column in _columns(self).items()})

    def _with(self, columns: dict[str, Any]) -> Contacts:
        changed = replace(self, **columns)
        changed.scene = self.scene
        return changed

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
    #: (1,) bool: a capacity was exceeded, or the input is invalid, and contacts may be missing. `trim` raises and says
    #: which.
    overflow: Tensor
    counts: Tensor  #: (21 + F,) int64: `pgccd.detection.capacity.Counts`, then `pgccd.MovingBodies.first_faults`
    capacity: Capacity
    broad_phase: str  #: as in `Stats`
    bodies: int  #: number of bodies
    faults: Faults  #: what the last of `counts` mean
    scene: Scene | None = field(default=None, init=False, repr=False, compare=False)

    def first_toi(self, by: By = "scene") -> Tensor:
        """As `Contacts.first_toi`; waits for nothing. On overflow some may be missing."""
        return first_time(self.pairs, self.toi, self.scene, by)

    def trim(self) -> Contacts:
        """The contacts alone, with stats. Waits for the device.

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
        count = min(counts.contacts, len(self.pairs))  # of the earliest there is one row
        columns = {name: None if column is None else column[:count] for name, column in _all_columns(self).items()}
        stats = stats_of(counts, self.capacity, self.bodies, count, self.broad_phase, waits=int(self.counts.is_cuda))
        contacts = Contacts(**columns, stats=stats)  # type: ignore[arg-type]
        contacts.scene = self.scene
        return contacts

    def __repr__(self) -> str:
        return f"PaddedContacts(capacity={len(self.pairs)}, device={self.pairs.device})"


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


_COLUMNS = tuple(each.name for each in fields(Contacts) if each.name not in ("stats", "scene"))


def _all_columns(contacts: Contacts | PaddedContacts) -> dict[str, Any]:
    return {name: getattr(contacts, name) for name in _COLUMNS}


def _columns(contacts: Contacts) -> dict[str, Tensor]:
    return {name: column for name, column in _all_columns(contacts).items() if column is not None}
