"""Contacts: the result of `detect`."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field, fields, replace
from typing import TYPE_CHECKING, Any, ClassVar, Literal, NoReturn, Self

import torch
from torch import Tensor

from pgccd import arguments
from pgccd.contacts.by_body import By, SceneBodies, any_contact, first_time, owners
from pgccd.contacts.rows import Columns, Form, Rows, have_equal_bits
from pgccd.contacts.stencils import stencils_of
from pgccd.geometry.scene import Scene
from pgccd.ops import ContactRows
from pgccd.runtime.sizes import BufferSizes, Capacity

# Dtypes and further sizes of columns.
_FORMS: dict[str, Form] = {
    "pairs": (torch.int64, (2,)),
    "kind": (torch.int8, ()),
    "features": (torch.int32, (2,)),
    "status": (torch.int8, ()),
    "toi": (torch.float64, ()),
    "coordinates": (torch.float64, (2,)),
    "point": (torch.float64, (3,)),
    "normal": (torch.float64, (3,)),
    "segment": (torch.int64, ()),
    "time": (torch.float64, ()),
    # Of passages.
    "approach": (torch.float64, ()),
    "measure": (torch.float64, ()),
}
# What contacts had in 0.1.0.
_GONE = {
    "approach": "call pgccd.approach_rates(scene, motion, hits)",
    "approaching": "call pgccd.approaching(scene, motion, hits)",
    "scene": "results keep `body_count` and `world` alone",
}
#: Names of the columns of contacts, in the operators' order.
COLUMNS: tuple[str, ...] = ("pairs", "kind", "features", "status", "toi", "coordinates", "point", "normal")


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


def earliest_of_each(owner: Tensor, count: int, *order: Tensor) -> Tensor:
    """One row of each owner that has any, ascending by owner: the first by the columns of `order` (K,), then by row.
    Synchronises.

    Args:
        owner: (K,) in [0, count).
    """
    rows = torch.arange(len(owner), device=owner.device)
    is_least = torch.ones_like(rows, dtype=torch.bool)
    least = rows
    for column in (*order, rows):
        column = column.detach()
        largest = torch.inf if column.is_floating_point() else torch.iinfo(column.dtype).max
        column = torch.where(is_least, column, largest)
        least = torch.full((count,), largest, dtype=column.dtype, device=column.device)
        least = least.scatter_reduce(0, owner, column, "amin")
        is_least &= column == least[owner]
    return least[least < len(rows)]


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

    Attributes:
        bodies: number of bodies.
        pcs: potentially colliding body pairs.
        node_tests: node pairs tested in the traversal.
        candidates: feature pairs left by the traversal.
        contacts: rows reported.
        unresolved: rows reported because the iteration budget was spent.
        broad_phase: "sweep", "grid" or "lbvh"; "given" if the caller passed the pairs.
        chunks: chunks in which the PCS was streamed.
        waits: number of times the host waited for a GPU.
        scratch_bytes: peak scratch memory of one GPU operator.
        needed: capacity the step needed; on a GPU None if it was streamed.
        seconds: by stage: bounds, broad, traverse, narrow. On a GPU device times, except for bounds and for streamed
            steps, where they are host times.
    """

    bodies: int = 0
    pcs: int = 0
    node_tests: int = 0
    candidates: int = 0
    contacts: int = 0
    unresolved: int = 0
    broad_phase: str = ""
    chunks: int = 0
    waits: int = 0
    scratch_bytes: int = 0
    needed: Capacity | None = None
    seconds: dict[str, float] = field(default_factory=dict)

    @classmethod
    def _of_parts(cls, parts: Sequence[Stats], contacts: int, device: torch.device) -> Stats:
        """The statistics of several searches of the same bodies, with this number of contacts: sums, and the largest
        scratch memory.
        """
        stats = cls(bodies=parts[0].bodies, broad_phase=parts[0].broad_phase, contacts=contacts)
        for part in parts:
            for name in ("pcs", "node_tests", "candidates", "unresolved", "chunks", "waits"):
                setattr(stats, name, getattr(stats, name) + getattr(part, name))
            for stage, spent in part.seconds.items():
                stats.seconds[stage] = stats.seconds.get(stage, 0.0) + spent
        stats.scratch_bytes = max(part.scratch_bytes for part in parts)
        if device.type == "cpu":
            stats.needed = BufferSizes(pairs=stats.pcs, contacts=contacts, candidates=stats.candidates)
        return stats


@dataclass(eq=False, kw_only=True, repr=False)
class PairColumns(Columns):
    """What all results have: body pairs."""

    pairs: Tensor
    # None where `pairs` are not rows of one scene, as on many ranks.
    _bodies: SceneBodies | None = field(default=None, repr=False, compare=False)
    # Whether the contacts are those of the bodies of one of several ranks.
    _is_of_rank: bool = field(default=False, repr=False, compare=False)

    _names: ClassVar[tuple[str, ...]] = ("pairs",)

    @property
    def body_count(self) -> int | None:
        """Number of bodies of the scene; None where `pairs` are not rows of one scene, as on many ranks."""
        return None if self._bodies is None else self._bodies.count

    @property
    def world(self) -> Tensor | None:
        """(N,) int32: the world of each body, the column of the scene itself; None without worlds, or where `pairs` are
        not rows of one scene.
        """
        return None if self._bodies is None else self._bodies.world

    @property
    def _incomplete(self) -> Tensor | None:
        """(1,) bool: whether contacts may be missing; None: they are not."""
        return None

    def to(self, device: torch.device | str) -> Self:
        moved = super().to(device)
        if self._bodies is not None:
            moved._bodies = self._bodies.map(lambda column: column.to(moved.pairs.device))
        return moved

    def may_collide(self, by: By = "scene") -> Tensor:
        """Whether there is a contact, bool: () for the "scene", (W,) per "world" (W is one more than the largest world
        index), or (N,) per "body". Works with every report. True where the result is incomplete, see `PaddedContacts`.
        With report="earliest", which leaves out contacts of other pairs, one contact makes all values True. Does not
        synchronise.

        Raises:
            ValueError: `by` is unknown or needs a scene; or these are the contacts of one of several ranks.

        Example:
            >>> x = torch.where(hits.may_collide(), x0, x1)  # all bodies move, or none
        """
        self._require_all_ranks()
        found, incomplete = self._any_contact(by), self._incomplete
        return found if incomplete is None else found | incomplete.reshape(())

    def _any_contact(self, by: By) -> Tensor:
        """As `may_collide`, of a complete result."""
        return any_contact(self.pairs, self._bodies, by)

    def _require_all_ranks(self) -> None:
        """Raises ValueError if other ranks may have other contacts."""
        if self._is_of_rank:
            raise ValueError(
                "hits: holds only the contacts of this rank's bodies: for all ranks use World.first_toi, Comm.min or "
                "Comm.any"
            )


@dataclass(eq=False, kw_only=True, repr=False)
class ContactColumns(PairColumns):
    """What contacts have: a row each."""

    toi: Tensor
    kind: Tensor
    features: Tensor
    coordinates: Tensor
    point: Tensor
    normal: Tensor
    status: Tensor
    # Whether these are the earliest contacts, which leaves out those of other pairs; and whether there is one in each
    # world that has any.
    _is_earliest: bool = field(default=False, repr=False, compare=False)
    _has_each_world: bool = field(default=False, repr=False, compare=False)

    _names: ClassVar[tuple[str, ...]] = COLUMNS

    def first_toi(self, by: By = "scene") -> Tensor:
        """The first toi, float64, inf without a contact: () for the "scene", (W,) per "world" (W is one more than the
        largest world index), or (N,) per "body". 0 where the result is incomplete, see `PaddedContacts`. With
        report="earliest", which leaves out contacts of other pairs, every value is the scene's first toi: no world or
        body has an earlier one. Does not synchronise.

        All bodies of the scene, or of a world, may move until the first toi of that scene or world. Do not move each
        body until its own first toi: other bodies, which were tested against its whole path, may collide with it where
        it stops.

        Raises:
            ValueError: `by` is unknown or needs a scene; or these are the contacts of one of several ranks.

        Example:
            >>> x0 + hits.first_toi("scene").clamp(max=1.0) * (x1 - x0)  # the collision-free part of the step
        """
        self._require_all_ranks()
        return self._first_time(self.toi, by, self._incomplete)

    def stencils(self, scene: Scene) -> tuple[Tensor, Tensor]:
        """Each contact as a weighted sum of the four vertices of its features: the weights of body i are negative, and
        the sum of weight times position at toi is the gap between the features, from i to j, from which thickness
        of meshes and margins are not subtracted. The same weights spread a force over the vertices.

        Args:
            scene: of which these are the contacts.

        Returns:
            Vertices (K, 4) int64, rows of the vertices of the scene's bodies, one body after the other, as in a
            `VertexMotion`; and weights (K, 4) float64. Both are 0 for contacts without a stencil: edges through faces
            at the start, bodies inside of solids, and padding.

        Raises:
            TypeError, ValueError: `scene` has another number of bodies; or these are contacts of one of several ranks.

        Example:
            >>> vertices, weights = hits.stencils(scene)
            >>> pushed = 0.1 * weights[..., None] * hits.normal[:, None]  # (K, 4, 3)
            >>> pushed.sum(dim=1).abs().max() < 1e-12  # opposite forces on the two features
            tensor(True)
        """
        self._require_all_ranks()
        arguments.instance(scene, "scene", Scene)
        if self.body_count != scene.body_count:
            raise ValueError(f"scene: has {scene.body_count} bodies, the contacts are of {self.body_count}")
        return stencils_of(scene, self.pairs, self.kind, self.features, self.coordinates)

    def _first_time(self, time: Tensor, by: By, incomplete: Tensor | None = None) -> Tensor:
        """The least `time` (K,) of contacts; 0 if `incomplete` (1,) bool."""
        found = first_time(self.pairs, time, self._bodies, by, incomplete)
        if (bound := self._bound_by(by)) is None:
            return found
        return torch.minimum(found, self._of_all(bound, first_time(self.pairs, time, self._bodies, bound, incomplete)))

    def _any_contact(self, by: By) -> Tensor:
        found = any_contact(self.pairs, self._bodies, by)
        if (bound := self._bound_by(by)) is None:
            return found
        return found | self._of_all(bound, any_contact(self.pairs, self._bodies, bound))

    def _bound_by(self, by: By) -> By | None:
        """What has the contact that bounds those left out, of what results are asked for; None: none are left out."""
        if not self._is_earliest or by == "scene" or (by == "world" and self._has_each_world):
            return None
        return "world" if self._has_each_world else "scene"

    def _of_all(self, by: By, values: Tensor) -> Tensor:
        """Values of the scene (), or of worlds (W,) for each body (N,)."""
        if by == "scene":
            return values
        return values[0] if self.world is None else values[self.world.long()]

    @property
    def starts_intersecting(self) -> Tensor:
        """(K,) bool: contacts with toi 0: the surfaces of the pair intersect, touch or are within min_separation and
        margins (plus the tolerance) at t = 0; for a trajectory, at the start of the segment. All other pairs are free
        until the first toi of the other contacts. Needs report="first" or "all", since "earliest" leaves out the
        contacts of other pairs. False in an incomplete result, see `PaddedContacts`.

        Raises:
            ValueError: the report was "earliest".

        Example:
            >>> fraction = hits[~hits.starts_intersecting].first_toi().clamp(max=1.0)
        """
        if self._is_earliest:
            raise ValueError('report: "earliest" leaves out the contacts of other pairs; ask for "first" or "all"')
        at_start = (self.toi == 0.0) & (self.pairs[:, 0] >= 0)
        return at_start if self._incomplete is None else at_start & ~self._incomplete


@dataclass(eq=False, kw_only=True, repr=False)
class CountedRows(Rows, PairColumns):
    """What results without padding have: any number of rows."""

    _forms = _FORMS

    stats: Stats
    payload: dict[str, Tensor] = field(default_factory=dict, repr=False, compare=False)

    def __eq__(self, other: object) -> bool:
        equal = super().__eq__(other)
        return have_equal_bits(self.payload, other.payload) if isinstance(other, CountedRows) and equal else equal

    __hash__ = None  # type: ignore[assignment]

    def state_dict(self) -> dict[str, Any]:
        """The columns, stats, `body_count` and `world` as a dictionary of tensors and numbers, without gradients and
        `Stats.needed`, for `torch.save` and `torch.load` with weights_only=True.

        Example:
            >>> torch.save(hits.state_dict(), "hits.pt")
        """
        stats = {name: value for name, value in asdict(replace(self.stats, needed=None)).items() if name != "needed"}
        flags = {name: getattr(self, name) for name in _flags_of(type(self))}
        return super().state_dict() | {"stats": stats, "body_count": self.body_count, "world": self.world} | flags

    @classmethod
    def from_state_dict(cls, state: dict[str, Any]) -> Self:
        flags = _flags_of(cls)
        given = cls._columns_of(state, "stats", "body_count", "world", *flags)
        bodies = SceneBodies.of_state(state)
        _check_rows(state, bodies)
        _check_stats(state["stats"])
        given |= {name: arguments.flag(state[name], name) for name in flags}
        return cls(**given, stats=Stats(**state["stats"]), _bodies=bodies)

    def _map(self, change: Callable[[Tensor], Tensor]) -> Self:
        payload = {name: change(column) for name, column in self.payload.items()}
        return replace(super()._map(change), payload=payload)

    def _followed_by(self, others: Sequence[Self]) -> Self:
        every = [self, *others]
        for k, each in enumerate(others, 1):
            if each.body_count != self.body_count:
                raise ValueError(f"results[{k}]: is of {each.body_count} bodies, the first one of {self.body_count}")
            if each.world is not self.world and not _are_equal(each.world, self.world):
                raise ValueError(f"results[{k}]: is of bodies in other worlds than the first one")
            if each.payload.keys() != self.payload.keys():
                raise ValueError(f"results[{k}]: has payload {list(each.payload)}, the first one {list(self.payload)}")
        payload = {name: torch.cat([each.payload[name] for each in every]) for name in self.payload}
        joined = replace(super()._followed_by(others), payload=payload)
        joined._is_of_rank = any(each._is_of_rank for each in every)
        joined.stats = Stats._of_parts([each.stats for each in every], len(joined), joined.pairs.device)
        return joined

    def __repr__(self) -> str:
        return f"{type(self).__name__}(count={len(self)}, pcs={self.stats.pcs}, device={self.pairs.device})"


def _are_equal(one: Tensor | None, other: Tensor | None) -> bool:
    return one is not None and other is not None and torch.equal(one, other)


@dataclass(eq=False, kw_only=True, repr=False)
class CollidingPairs(CountedRows):
    """The pairs of bodies that collide, from `pgccd.collide`; sorted. Equal (`==`) if they are the same.

    Attributes:
        pairs: (K, 2) int64 body indices, i < j; (i, i) where a body touches itself.
        stats: of the call.
        payload: columns of both bodies, (K, 2, ...) by name: see `distributed.World.collide`; else empty.

    Example:
        >>> colliding = pgccd.collide(scene, motion)
        >>> colliding.pairs, colliding.may_collide("body")
        (tensor([[0, 1]]), tensor([True, True]))
    """


@dataclass(eq=False, kw_only=True, repr=False)
class Contacts(ContactColumns, CountedRows):
    """K contacts, sorted by pair, then kind and features. Equal (`==`) if all columns are, bit by bit. Points and
    normals are in the world frame, lengths in the scene's units.

    Attributes:
        pairs: (K, 2) int64 body indices, i < j; (i, i) where a body touches itself.
        toi: (K,) float64, time of impact in [0, 1] as a fraction of the step: these features do not touch before it; 0
            if they touch at t = 0.
        kind: (K,) int8, see `Kind`: which features touch.
        features: (K, 2) int32: vertex, face or edge index of i, then of j, in their meshes; an edge is a row of
            `Mesh.edges`.
        coordinates: (K, 2) float64, of the nearest points at toi: (u, v) of the face point f0 + u (f1 - f0) + v (f2 -
            f0), with the face's vertices in the order of `Mesh.faces`; for kind EE, u along i's edge and v along j's
            edge, each from its smaller vertex.
        point: (K, 3) float64: halfway between the nearest points at toi; for an edge through a face, where the edge
            passes.
        normal: (K, 3) float64, unit vector from i towards j at toi (for a body with itself, from the first feature
            towards the second); zero if degenerate features coincide. For an edge through a face, the face's normal, on
            the side of j's centre.
        status: (K,) int8, see `Status`: TOUCH or UNRESOLVED.
        stats: of the call.
        payload: columns of both bodies, (K, 2, ...) by name: see `distributed.World.step`; else empty.

    If an input of `detect` requires grad, then so do toi, coordinates, point and normal: see docs/how-to/gradients.md.

    Example:
        >>> for (i, j), toi in zip(hits.pairs.tolist(), hits.toi.tolist()):
        ...     print(f"{i} and {j} touch at {toi:.2f}")
        0 and 1 touch at 0.80
    """

    # See `differentiable`; None if no input required grad.
    _differentiable: Tensor | None = field(default=None, repr=False, compare=False)
    # The options of `detect` that found them; None of those of ranks, of a capacity, or from a state_dict.
    _found_with: dict[str, Any] | None = field(default=None, repr=False, compare=False)

    if not TYPE_CHECKING:  # which would accept every name

        def __getattr__(self, name: str) -> NoReturn:
            if name in _GONE:
                raise AttributeError(f"{type(self).__name__} has no {name!r} any more: {_GONE[name]}")
            raise AttributeError(f"{type(self).__name__!r} object has no attribute {name!r}")

    @property
    def differentiable(self) -> Tensor:
        """(K,) bool: contacts whose toi, coordinates, point and normal have derivatives, if an input of `detect`
        required grad; False if none did. False, with all derivatives zero, also for contacts at t = 0, for grazing
        contacts (the gap closes at less than 1e-6 of the relative speed) and for unresolved ones.

        Example:
            >>> loss = hits.toi[hits.differentiable].sum()
        """
        return torch.zeros_like(self.toi, dtype=torch.bool) if self._differentiable is None else self._differentiable

    def earliest(self, *ties: Tensor, by: Literal["scene", "world"] = "scene") -> Self:
        """The contact with the smallest toi, or for a trajectory with the smallest time; no rows if there are no
        contacts.

        Args:
            ties: (K,) each: among contacts of equal toi, the one with the smallest value is taken, then the first row.
            by: "scene"; or "world": one contact of each world that has any, in the order of worlds. "world"
                synchronises with a GPU.

        Raises:
            TypeError, ValueError: `by` is unknown or needs a scene.

        Example:
            >>> first_of_each = pgccd.detect(scene, motion).earliest(by="world")
        """
        arguments.choice(by, "by", ("scene", "world"))
        order = (*self._order, *ties)
        if by == "scene":
            row = earliest_row(*order)
        else:
            owner, count = owners(self.pairs, self._bodies, by)
            row = earliest_of_each(owner[::2], count, *order)
        found = self[row]
        stats = replace(found.stats, contacts=len(found))
        return replace(found, stats=stats, _is_earliest=True, _has_each_world=by == "world")

    @property
    def _order(self) -> tuple[Tensor, ...]:
        """Columns by which contacts are early."""
        return (self.toi,)

    def _followed_by(self, others: Sequence[Self]) -> Self:
        every = [self, *others]
        joined = super()._followed_by(others)
        joined._is_earliest = any(each._is_earliest for each in every)
        joined._has_each_world = all(each._has_each_world for each in every)
        if any(each._differentiable is not None for each in every):
            joined._differentiable = torch.cat([each.differentiable for each in every])
        if any(each._found_with != self._found_with for each in others):
            joined._found_with = None
        return joined

    def _map(self, change: Callable[[Tensor], Tensor]) -> Self:
        changed = super()._map(change)
        changed._differentiable = None if self._differentiable is None else change(self._differentiable)
        return changed


def _check_stats(stats: Any) -> None:
    """Raises TypeError or ValueError, naming the entry, unless these are the stats of a `state_dict`."""
    arguments.entries(stats, [each.name for each in fields(Stats) if each.name != "needed"], "stats")
    for name, value in stats.items():
        named = f"stats[{name!r}]"
        if name == "broad_phase":
            if not isinstance(value, str):
                raise TypeError(f"{named}: expected a str, got {arguments.describe(value)}")
        elif name == "seconds":
            if not isinstance(value, dict):
                raise TypeError(f"{named}: expected a dictionary, got {arguments.describe(value)}")
            for stage, spent in value.items():
                arguments.number(spent, f"{named}[{stage!r}]")
        else:
            arguments.integer(value, named, 0, "a number >= 0")


def _check_rows(state: dict[str, Any], bodies: SceneBodies | None) -> None:
    """Raises ValueError unless the rows of a `state_dict` name bodies, and times in [0, 1]."""
    most = 2**63 - 1 if bodies is None else bodies.count - 1
    limits = {"pairs": (0, most), "toi": (0.0, 1.0), "segment": (0, 2**63 - 1), "time": (0.0, 1.0)}
    for name, (low, high) in limits.items():
        if name not in state:
            continue
        column = state[name]
        sound = (column >= low) & (column <= high)
        sound = sound.all(dim=1) if sound.dim() == 2 else sound
        if not bool(sound.all()):
            row = int((~sound).long().argmax())
            raise ValueError(f"{name}: row {row}: expected numbers from {low} to {high}, got {column[row].tolist()}")


def _flags_of(result: type[PairColumns]) -> list[str]:
    """Names of the attributes that say what a result leaves out."""
    return [each.name for each in fields(result) if each.name in ("_is_of_rank", "_is_earliest", "_has_each_world")]


def contacts_of(rows: ContactRows, report: str, stats: Stats) -> Contacts | CollidingPairs:
    """The result of a search, from rows with body pairs in the first column; of report "any" these are all."""
    if report == "any":
        return CollidingPairs(pairs=rows[0], stats=stats)
    columns: dict[str, Any] = dict(zip(COLUMNS, rows, strict=True))
    return Contacts(**columns, stats=stats, _is_earliest=report == "earliest")
