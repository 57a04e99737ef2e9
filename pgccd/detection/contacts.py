"""Contacts: the result of `detect`."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any, NoReturn, Self

import torch
from torch import Tensor

from pgccd import arguments
from pgccd.detection.capacity import COUNT_ROWS, Capacity, CapacityError, Counts, overflow_flags
from pgccd.detection.grouping import By, any_contact, first_time
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


@dataclass(eq=False)
class ContactColumns:
    """One row per contact. With report="any" only `pairs` is meaningful and all other columns are None."""

    pairs: Tensor  #: (K, 2) int64 body indices, i < j; i, i where a body touches itself
    toi: Tensor | None  #: (K,) float64 in [0, 1]: these features do not touch before it; 0 if they touch at t0
    kind: Tensor | None  #: (K,) int8, see `Kind`
    features: Tensor | None  #: (K, 2) int32: vertex, face or edge index of i, then of j, in their meshes
    #: (K, 2), of the nearest points at toi: (u, v) of the face point f0 + u (f1 - f0) + v (f2 - f0), or of kind EE
    #: parameters along i's and j's edge
    coordinates: Tensor | None
    #: (K, 3) world: halfway between the nearest points at toi; of an edge through a face, where it passes
    point: Tensor | None
    #: (K, 3) unit vector from i (or the first feature) towards j at toi; zero if degenerate features coincide. Of an
    #: edge through a face it is the face's, on the side of j's centre
    normal: Tensor | None
    status: Tensor | None  #: (K,) int8, see `Status`
    #: The scene of the bodies; None where `pairs` are not rows of one scene.
    scene: Scene | None = field(default=None, init=False, repr=False, compare=False)
    # Whether the report was "earliest", which leaves out the contacts of other pairs.
    _is_earliest: bool = field(default=False, init=False, repr=False, compare=False)

    @property
    def columns(self) -> dict[str, Tensor]:
        """The columns that are not None, by name."""
        columns = {name: getattr(self, name) for name in COLUMNS}
        return {name: column for name, column in columns.items() if column is not None}

    @property
    def _incomplete(self) -> Tensor | None:
        """(1,) bool: whether contacts may be missing; None: they are not."""
        return None

    def __eq__(self, other: object) -> bool:
        if type(other) is not type(self):
            return NotImplemented
        mine, theirs = self.columns, other.columns
        return mine.keys() == theirs.keys() and all(
            column.device == theirs[name].device and torch.equal(column, theirs[name]) for name, column in mine.items()
        )

    __hash__ = None  # type: ignore[assignment]

    def first_toi(self, by: By = "scene") -> Tensor:
        """The first toi, float64, inf without a contact: () for the "scene", (W,) per "world" (W is one more than the
        largest world index), or (N,) per "body". 0 where the result is incomplete, see `PaddedContacts`. With
        report="earliest" only that of the "scene" is the first of all contacts. Does not synchronise.

        All bodies of the scene, or of a world, may move until its first toi. A body may not move until its own toi
        alone: others, tested against its whole path, may then collide with it where it stops.

        Raises:
            ValueError: the report was "any", or `by` is unknown or needs a scene.

        Example:
            >>> x0 + hits.first_toi("scene").clamp(max=1.0) * (x1 - x0)  # the collision-free part of the step
        """
        return first_time(self.pairs, self.toi, self.scene, by, self._incomplete)

    def may_collide(self, by: By = "scene") -> Tensor:
        """Whether there is a contact, bool: () for the "scene", (W,) per "world", or (N,) per "body"; for every report.
        True where the result is incomplete, see `PaddedContacts`. With report="earliest" only the "scene" has all
        contacts. Does not synchronise.

        Raises:
            ValueError: `by` is unknown or needs a scene.

        Example:
            >>> x = torch.where(hits.may_collide(), x0, x1)  # all bodies move, or none
        """
        found, incomplete = any_contact(self.pairs, self.scene, by), self._incomplete
        return found if incomplete is None else found | incomplete.reshape(())

    @property
    def starts_intersecting(self) -> Tensor:
        """(K,) bool: contacts with toi 0, of pairs whose surfaces intersect, touch or are within min_separation and
        margins (plus the tolerance) at t = 0; of a trajectory, at the start of the segment. All other pairs are free
        until the first toi of the other contacts, which needs report="first" or "all": "earliest" has one contact, and
        leaves out those of other pairs. False in an incomplete result, see `PaddedContacts`.

        Raises:
            ValueError: the report was "any", which gives no times, or "earliest".

        Example:
            >>> fraction = hits[~hits.starts_intersecting].first_toi().clamp(max=1.0)
        """
        if self.toi is None:
            raise ValueError('report: "any" gives no times; ask for "first" or "all"')
        if self._is_earliest:
            raise ValueError('report: "earliest" leaves out the contacts of other pairs; ask for "first" or "all"')
        at_start = (self.toi == 0.0) & (self.pairs[:, 0] >= 0)
        return at_start if self._incomplete is None else at_start & ~self._incomplete


@dataclass(eq=False)
class Contacts(ContactColumns):
    """K contacts, sorted by pair, then kind and features. Equal (`==`) if all columns are, bit by bit."""

    stats: Stats

    def __iter__(self) -> NoReturn:
        raise TypeError(
            "Contacts: not iterable: loop over columns, such as zip(hits.pairs.tolist(), hits.toi.tolist()), or over "
            "single rows, hits[k : k + 1]"
        )

    def __len__(self) -> int:
        return self.pairs.shape[0]

    def __getitem__(self, rows: Tensor | slice | Sequence[int]) -> Self:
        """A subset of the contacts: a mask (K,), row numbers or a slice. `stats` remain those of the whole call.

        Example:
            >>> early = hits[hits.toi < 0.5]
        """
        if isinstance(rows, int) and not isinstance(rows, bool):
            raise TypeError(f"rows: expected a mask, row numbers or a slice, got {rows}: write hits[[{rows}]]")
        picked = arguments.rows(rows, "rows", len(self))
        return self._map(lambda column: column[picked])

    def earliest(self, *ties: Tensor) -> Self:
        """The contact with the smallest toi (see `earliest_row` for ties), or none if there are no contacts."""
        assert self.toi is not None
        found = self[earliest_row(self.toi, *ties)]
        earliest = replace(found, stats=replace(found.stats, contacts=len(found)))
        earliest.scene, earliest._is_earliest = self.scene, True
        return earliest

    def to(self, device: torch.device | str) -> Self:
        """A copy on another device.

        Example:
            >>> hits = hits.to("cpu")
        """
        device = arguments.device(device)
        return self._map(lambda column: column.to(device))

    def clone(self) -> Self:
        """A copy of all columns.

        Example:
            >>> kept = hits.clone()
        """
        return self._map(Tensor.clone)

    def _map(self, change: Callable[[Tensor], Tensor]) -> Self:
        columns: dict[str, Any] = {name: change(column) for name, column in self.columns.items()}
        changed = replace(self, **columns)
        changed.scene, changed._is_earliest = self.scene, self._is_earliest
        return changed

    def __repr__(self) -> str:
        return f"Contacts(count={len(self)}, pcs={self.stats.pcs}, device={self.pairs.device})"


@dataclass(eq=False)
class PaddedContacts(ContactColumns):
    """Contacts in a fixed number of rows, from `detect(capacity=...)`: the host has not synchronised yet.

    The first `count` rows are contacts as in `Contacts`. The rest is padding: pairs and features -1, toi inf, status
    FREE, all else 0, so `toi.min()` needs no mask.

    The result is incomplete if a capacity was exceeded or a pose is invalid. It then reads as contact at the start of
    the step, whatever was found: toi is 0 in every row, padding included, and `first_toi` is 0 and `may_collide` True
    for the scene, each world and each body. Only where rigid poses are invalid, and no pairs were given, worlds without
    an invalid body keep their result in `first_toi` and `may_collide`. A loop that reads only these stands still until
    the host has read the counts: by `trim` after `detect(capacity=...)`, two calls later with a `CapturedDetection`.
    """

    count: Tensor  #: (1,) int64: number of contacts found
    overflow: Tensor  #: (1,) bool: the result is incomplete. `trim` raises the error
    counts: Tensor  #: (21 + F,) int64: `pgccd.detection.capacity.Counts`, then `pgccd.MovingBodies._first_faults`
    capacity: Capacity
    broad_phase: str  #: as in `Stats`
    bodies: int  #: number of bodies
    faults: Faults  #: meaning of the last values of `counts`
    # The toi that were found, where those of an incomplete result are 0; and `Search.reach`.
    _found_toi: Tensor | None = field(default=None, init=False, repr=False, compare=False)
    _reach: Tensor | None = field(default=None, init=False, repr=False, compare=False)

    @property
    def invalid(self) -> Tensor:
        """(1,) bool: a pose is invalid. Where `overflow` is set and this is not, a capacity was exceeded."""
        return self.counts[-1:] != 0

    @property
    def _incomplete(self) -> Tensor:
        return self.overflow

    def first_toi(self, by: By = "scene") -> Tensor:
        if by == "scene" or self._reach is None:
            return super().first_toi(by)
        lost = torch.cat(overflow_flags(self.counts)).any()
        found = first_time(self.pairs, self._found_toi, self.scene, by, lost)
        return found.masked_fill(self._in_invalid_worlds(self._reach, by), 0.0)

    def may_collide(self, by: By = "scene") -> Tensor:
        if by == "scene" or self._reach is None:
            return super().may_collide(by)
        lost = torch.cat(overflow_flags(self.counts)).any()
        return any_contact(self.pairs, self.scene, by) | lost | self._in_invalid_worlds(self._reach, by)

    def _in_invalid_worlds(self, reach: Tensor, by: By) -> Tensor:
        """Which worlds (W,) have an invalid body, or which bodies (N,) are in these."""
        assert self.scene is not None
        rows = torch.arange(len(reach), device=reach.device)
        invalid = torch.where(reach < 0.0, rows, -1)[:, None].expand(-1, 2)
        of_world, world = any_contact(invalid, self.scene, "world"), self.scene.world
        if by == "world":
            return of_world
        return of_world.expand(len(reach)) if world is None else of_world[world.long()]

    def trim(self) -> Contacts:
        """The contacts without padding, with stats. Synchronises.

        Raises:
            CapacityError: a capacity was exceeded.
            ValueError: the input is invalid.

        Example:
            >>> hits = pgccd.detect(scene, motion, capacity=capacity).trim()
        """
        counts = checked_counts(self.counts.tolist(), self.capacity, self.faults)
        count = min(counts.contacts, len(self.pairs))  # "earliest" has one row
        columns = all_columns({name: column[:count] for name, column in self.columns.items()})
        stats = stats_of(counts, self.capacity, self.bodies, count, self.broad_phase, waits=int(self.counts.is_cuda))
        contacts = Contacts(**columns, stats=stats)
        contacts.scene, contacts._is_earliest = self.scene, self._is_earliest
        return contacts

    def __repr__(self) -> str:
        return f"PaddedContacts(capacity={len(self.pairs)}, device={self.pairs.device})"


def checked_counts(values: Sequence[int], capacity: Capacity, faults: Faults, later: bool = False) -> Counts:
    """The counts of a padded step, from the values of `PaddedContacts.counts`; faults, later: see `Faults.raise_from`.

    Raises:
        CapacityError: a capacity was exceeded.
        ValueError: the input is invalid.
    """
    faults.raise_from(values[len(COUNT_ROWS) :], later)
    counts = Counts.of(values[: len(COUNT_ROWS)])
    if counts.overflow:
        raise CapacityError(capacity, counts.needed(capacity))
    return counts


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
