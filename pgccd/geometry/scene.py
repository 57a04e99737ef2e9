"""Scenes: bodies and their collision filters."""

from __future__ import annotations

import copy
from collections.abc import Hashable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from pgccd import arguments
from pgccd.geometry.mesh import SMALLEST_RADIUS, Mesh
from pgccd.geometry.mesh_set import MeshSet
from pgccd.geometry.scene_columns import (
    bool_column,
    integer_column,
    margin_column,
    pairs_never_tested,
    require_meshes,
    require_worlds,
    self_column,
    sum_of_margins,
    world_column,
)

#: Columns of a scene that filter pairs.
FILTERS = ("group", "mask", "world", "static")
#: Columns of a scene that may be absent.
OPTIONAL_COLUMNS = (*FILTERS, "margin")


@dataclass
class Derived:
    """A value derived from a column, and what shows whether the column has changed since. On a CPU that is a copy of
    the column, because NumPy may write to shared memory without torch's knowledge. On a GPU it is torch's counter of
    writes, which is read without waiting.
    """

    column: Tensor
    value: Any
    seen: Tensor | int | None = None

    def __post_init__(self) -> None:
        if not torch.compiler.is_compiling():
            self.seen = self.column.clone() if self.column.device.type == "cpu" else _version(self.column)

    def __getstate__(self) -> dict[str, Any]:
        """The copy of the column starts a new counter of writes, so the state says whether the value is current."""
        return {"column": self.column, "value": self.value, "is_current": self.is_of(self.column)}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.column, self.value, self.seen = state["column"], state["value"], None
        if state["is_current"]:
            self.__post_init__()

    def is_of(self, column: Tensor) -> bool:
        """Whether the value was derived from the present values of this column."""
        if torch.compiler.is_compiling():  # values are not available
            return self.column is column
        if isinstance(self.seen, Tensor):
            alike = self.seen.device == column.device and self.seen.dtype == column.dtype
            return alike and torch.equal(self.seen, column)
        return self.column is column and self.seen == _version(column) is not None


class _Fixed(Derived):
    """For a column that is never written to. torch does not count writes to tensors made in inference mode, so such
    writes are not seen.
    """

    def is_of(self, column: Tensor) -> bool:
        if super().is_of(column):
            return True
        return self.column is column and column.device.type != "cpu" and column.is_inference()


def _version(column: Tensor) -> int | None:
    """Counter of in-place writes to the column; None where torch does not track it."""
    return None if torch.compiler.is_compiling() or column.is_inference() else column._version


@dataclass(frozen=True)
class VertexLayout:
    """Layout of the vertices and hierarchies of deforming bodies, one body after the other."""

    vertex_count: int
    block_count: int  #: number of node blocks
    vertex_begin: Tensor  #: (N,) int64
    block_begin: Tensor  #: (N,) int64


class Scene:
    """N bodies, each an instance of one of a few meshes. Positions are not part of it: see `pgccd.motion.paths`.

    A pair of bodies is tested if both are in the same `world`, at least one is not `static`, the `group` of each has a
    bit in common with the `mask` of the other, and the pair is not in `exclude`.

    Args:
        meshes: the meshes, or a `MeshSet` already on `device`.
        mesh_index: (N,) integers: mesh of each body. Default: one body per mesh.
        device: of all tensors. Default: the device of the MeshSet, else of `mesh_index` if it is a tensor, else the
            CPU.
        group, mask: (N,) int64 bit sets. Default: all bits.
        world: (N,) integers. Default: all bodies in one world.
        static: (N,) bool. Default: no body is static.
        self_collision: bool, or (N,) bool: which bodies are also tested against themselves, as pairs (i, i), while they
            deform (`VertexMotion`). Default: none. Feature pairs that share a vertex are not tested. group, mask and
            world do not affect these tests; static bodies are not tested.
        margin: thickness of bodies, a number or (N,), scene length units, from 0 to 1e150, added to the thickness of
            the body's mesh. A pair is tested with the separation min_separation + margin_i + margin_j, and a body
            against itself with min_separation + 2 margin_i. Default: none. If a body's true path never deviates from
            the tested one by more than its margin, no contact of the true path is missed.
        exclude: (E, 2) integers: pairs of bodies that are never tested, such as links joined by a joint; in any order.
            Default: none.

    `mesh_index`, `group`, `mask`, `world`, `static` and `margin` may be written to, or replaced by tensors of the same
    dtype, shape and device. Their values are checked at each use, like the poses of a motion. `self_collision` and
    `exclude` are fixed. A margin given as a Python number or list is float64; a float64 tensor or array is shared, not
    copied.

    Attributes:
        meshes: the meshes, concatenated: a `MeshSet`.
        mesh_index: (N,) int32.
        body_count: number of bodies N.
        group, mask: (N,) int64, or None.
        world: (N,) int32, or None.
        static: (N,) uint8, or None.
        margin: (N,) float64, or None if no body has a margin.
        self_collision: (N,) bool, or None if no body is tested against itself.
        exclude: (E, 2) int64, i < j, sorted, each once; or None.
        device: of all tensors.

    Raises:
        ValueError, TypeError: naming the argument.

    Example:
        >>> scene = pgccd.Scene([robot, rock], mesh_index=[0, 0, 1])
        >>> scene.body_count
        3
    """

    def __init__(
        self,
        meshes: Sequence[Mesh] | MeshSet,
        mesh_index: Tensor | Sequence[int] | None = None,
        device: torch.device | str | None = None,
        *,
        group: Tensor | Sequence[int] | None = None,
        mask: Tensor | Sequence[int] | None = None,
        world: Tensor | Sequence[int] | None = None,
        static: Tensor | Sequence[bool] | None = None,
        self_collision: Tensor | Sequence[bool] | bool = False,
        margin: Tensor | Sequence[float] | float | None = None,
        exclude: Tensor | Sequence[Sequence[int]] | None = None,
    ) -> None:
        if device is None:
            if isinstance(meshes, MeshSet):
                device = meshes.device
            else:
                device = mesh_index.device if isinstance(mesh_index, Tensor) else "cpu"
        device = arguments.device(device)
        if not isinstance(meshes, MeshSet):
            several = isinstance(meshes, Iterable) and not isinstance(meshes, (str, dict, Tensor, np.ndarray))
            meshes = MeshSet(list(meshes) if several else meshes, device)
        self.meshes = meshes
        self.device = meshes.device
        if device.type != self.device.type or device.index not in (None, self.device.index):
            raise ValueError(f"device: the MeshSet is on {self.device}, not {device}")
        if mesh_index is None:
            mesh_index = list(range(len(meshes)))
        mesh_index = integer_column(mesh_index, "mesh_index", None, self.device)
        require_meshes(mesh_index, len(meshes))
        self.body_count = count = len(mesh_index)
        self.mesh_index = mesh_index.to(torch.int32)
        self.group = None if group is None else integer_column(group, "group", count, self.device)
        self.mask = None if mask is None else integer_column(mask, "mask", count, self.device)
        self.world = None if world is None else world_column(world, count, self.device)
        self.static = None if static is None else bool_column(static, "static", count, self.device)
        _ = self.world_count  # computed now, so that a step need not synchronise
        self.margin = None if margin is None else margin_column(margin, count, self.device)
        own = self_column(self_collision, count, self.device)
        self.self_collision = own if own is None or self.static is None else own & (self.static == 0)
        self._count_self_colliding()
        self.exclude = None if exclude is None else pairs_never_tested(exclude, count, self.device)
        self._remember()

    meshes: MeshSet
    device: torch.device
    body_count: int
    mesh_index: Tensor
    group: Tensor | None
    mask: Tensor | None
    world: Tensor | None
    static: Tensor | None
    margin: Tensor | None
    self_collision: Tensor | None
    exclude: Tensor | None

    def __setattr__(self, name: str, value: Any) -> None:
        if name in _DTYPES and (value is not None or name == "mesh_index"):
            self._check_column(name, value)
        elif name in _FIXED and name in self.__dict__:
            raise ValueError(f"{name}: it is fixed: make a new Scene")
        super().__setattr__(name, value)

    def _check_column(self, name: str, column: Any) -> None:
        """Raises TypeError or ValueError unless the column has the dtype, shape and device of its name."""
        dtype = _DTYPES[name]
        if not isinstance(column, Tensor) or column.dtype != dtype:
            expected = f"{arguments.dtype_name(dtype)} in a scene"
            raise TypeError(f"{name}: expected {expected}, got {arguments.describe(column)}")
        if column.shape != (self.body_count,) or column.device != self.device:
            expected = f"shape ({self.body_count},) on {self.device}"
            raise ValueError(f"{name}: expected {expected}, got {tuple(column.shape)} on {column.device}")
        if not column.is_contiguous():
            raise ValueError(f"{name}: expected a contiguous tensor")

    #: Whether a user made the scene. Only users are warned of what a scene does not test.
    _is_of_user: bool = True

    # Capacity estimates by kind of step, managed by `pgccd.search.memory`. They change how often a step is repeated
    # on a GPU, never its result.
    _own_estimates: dict[Hashable, Any] | None = None

    @property
    def _capacity_estimates(self) -> dict[Hashable, Any]:
        """Capacity estimates of earlier steps. Successive scenes of a simulation may share them."""
        if self._own_estimates is None:
            self._own_estimates = {}
        return self._own_estimates

    @_capacity_estimates.setter
    def _capacity_estimates(self, estimates: dict[Hashable, Any]) -> None:
        self._own_estimates = estimates

    @classmethod
    def _of_checked(
        cls,
        meshes: MeshSet,
        mesh_index: Tensor,
        radius: Tensor | None = None,
        **columns: Tensor | None,
    ) -> Scene:
        """From columns of a scene that has been validated: rows of its `mesh_index`, `group`, `margin` and so on.

        Args:
            radius: (N,) of the bodies' SBVs; `mesh_index` is then never checked. Default: those of the meshes.

        Example:
            >>> part = pgccd.Scene._of_checked(scene.meshes, scene.mesh_index[rows])
        """
        scene = cls.__new__(cls)
        given = dict.fromkeys((*OPTIONAL_COLUMNS, *_FIXED)) | columns
        scene.__dict__.update(
            given, meshes=meshes, device=meshes.device, mesh_index=mesh_index, body_count=mesh_index.shape[0]
        )
        scene.__dict__.update(_given_radius=radius, _is_of_user=False)
        scene._count_self_colliding()
        return scene

    def _count_self_colliding(self) -> None:
        flags, begin = self.self_collision, self.meshes.offsets[:, 0]
        #: (S,) int64, ascending: the bodies tested against themselves. Computed once, so that a step need not
        #: synchronise.
        self._self_colliding = torch.empty(0, dtype=torch.int64, device=self.device)
        #: Their total number of vertices.
        self._self_colliding_vertices = 0
        if flags is not None:
            self._self_colliding = torch.nonzero(flags).flatten()
            meshes = self.mesh_index[self._self_colliding].cpu().long()
            self._self_colliding_vertices = int((begin[1:] - begin[:-1])[meshes].sum())

    # The radius given to `_of_checked`, and cached values derived from `mesh_index` and `world`.
    _given_radius: Tensor | None = None
    _layout: Derived | None = None
    _world_count: Derived | None = None
    # `self_collision`, which `_self_colliding` follows, and `exclude`, as given by a user.
    _fixed: Mapping[str, _Fixed] = {}
    # The number of bodies after which `exclude` repeats, in a scene of several copies. Default: the number of all
    # bodies.
    _exclude_period: int | None = None

    def _remember(self) -> None:
        given = {name: getattr(self, name) for name in _FIXED}
        self._fixed = {name: _Fixed(column, None) for name, column in given.items() if column is not None}

    @property
    def radius(self) -> Tensor:
        """SBV radius of each body's mesh, (N,) float64; a copy.

        Raises:
            ValueError: on a CPU, if a mesh is out of range.
        """
        if self._given_radius is not None:
            return self._given_radius.clone()
        if self.device.type == "cpu":
            require_meshes(self.mesh_index, len(self.meshes))
        return self.meshes.radius.index_select(0, self._sound_index if self._is_of_user else self.mesh_index)

    @property
    def _thickness(self) -> Tensor | None:
        """(N,) float64: margins and the thickness of meshes; None if no body has either."""
        if self.meshes.thickness is None:
            return self.margin
        return sum_of_margins(self.meshes.thickness.index_select(0, self._sound_index), self.margin)

    @property
    def _size(self) -> Tensor:
        """(N,) float64: the length that the default tolerance is a fraction of: the SBV radius; for points at one
        place, such as a sphere, the thickness and margin.
        """
        radius, thickness = self.radius, self._thickness
        is_point = (radius >= 0.0) & (radius <= SMALLEST_RADIUS)
        return radius if thickness is None else torch.where(is_point, torch.maximum(radius, thickness), radius)

    def _leave_out(self, is_padding: Tensor) -> None:
        """Gives the bodies marked by (N,) bool a negative radius, so that no pair contains them."""
        self._given_radius = torch.where(is_padding, -torch.inf, self.radius)

    @property
    def _sound_index(self) -> Tensor:
        """`mesh_index`, with numbers out of range replaced by valid ones. Checks report such numbers."""
        return self.mesh_index.clamp(0, len(self.meshes) - 1)

    @property
    def layout(self) -> VertexLayout:
        """First rows of each body's vertices and node blocks, for bodies that deform."""
        if self._layout is None or not self._layout.is_of(self.mesh_index):
            self._layout = Derived(self.mesh_index, self._find_layout())
        return self._layout.value

    def _find_layout(self) -> VertexLayout:
        index = self.mesh_index.cpu().long()
        require_meshes(index, len(self.meshes))
        offsets = self.meshes.offsets
        counts = (offsets[1:] - offsets[:-1])[index]
        begin = (counts.cumsum(0) - counts).to(self.device)
        vertex_count, _, _, block_count, *_ = counts.sum(0).tolist()
        return VertexLayout(vertex_count, block_count, begin[:, 0].contiguous(), begin[:, 3].contiguous())

    @property
    def world_count(self) -> int:
        """One more than the largest `world`; 1 without worlds.

        Raises:
            ValueError: a world is negative.
        """
        if self.world is None:
            return 1
        if self._world_count is None or not self._world_count.is_of(self.world):
            require_worlds(self.world)
            self._world_count = Derived(self.world, 1 + int(self.world.max()) if self.body_count else 0)
        return self._world_count.value

    def _detached(self) -> Scene:
        """The scene without gradients; itself if it has none. Both share capacity estimates."""
        if not arguments.is_differentiated(self.margin):
            return self
        assert self.margin is not None
        _ = self._capacity_estimates  # made now, to be shared
        plain = copy.copy(self)
        plain.margin = self.margin.detach()
        return plain

    def _refuse(self) -> None:
        """Raises ValueError if the margin requires grad, or a fixed column was written to."""
        if self.margin is not None:
            arguments.refuse_gradient(self.margin, "margin")
        for name, fixed in self._fixed.items():
            if not fixed.is_of(getattr(self, name)):
                raise ValueError(f"{name}: it is fixed, but was written to: make a new Scene")

    def __getitem__(self, rows: Tensor | slice | Sequence[int]) -> Scene:
        """The scene of some bodies: a mask (N,), row numbers or a slice. Motions are indexed in the same way. May
        synchronise with a GPU.

        Example:
            >>> part = scene[:1]
        """
        picked = arguments.rows(rows, "rows", self.body_count)
        columns: dict[str, Any] = {name: getattr(self, name) for name in (*OPTIONAL_COLUMNS, "self_collision")}
        given = {name: column[picked] for name, column in columns.items() if column is not None}
        if "static" in given:
            given["static"] = given["static"].bool()
        mesh_index = self.mesh_index[picked]
        if self.exclude is not None:
            given["exclude"] = self._excluded_among(torch.arange(self.body_count, device=self.device)[picked])
        return Scene(self.meshes, mesh_index, **given)

    def _excluded_among(self, picked: Tensor) -> Tensor:
        """`exclude` as rows of the bodies (K,)."""
        assert self.exclude is not None
        place = torch.full((self.body_count,), -1, device=self.device)
        place[picked] = torch.arange(len(picked), device=self.device)
        if not torch.equal(place[picked], torch.arange(len(picked), device=self.device)):
            raise ValueError("rows: expected each body at most once, since the scene has pairs to exclude")
        pairs = place[self.exclude]
        return pairs[(pairs >= 0).all(dim=1)]

    def state_dict(self) -> dict[str, Any]:
        """The scene and its meshes as a dictionary of tensors, lists and numbers, without gradients, for `torch.save`
        and `torch.load` with weights_only=True.

        Example:
            >>> torch.save(scene.state_dict(), "scene.pt")
        """
        plain = self._detached()
        plain._refuse()
        columns = {name: getattr(plain, name) for name in _ENTRIES}
        return {"meshes": [mesh.state_dict() for mesh in self.meshes.meshes], **columns}

    @classmethod
    def from_state_dict(cls, state: dict[str, Any], device: torch.device | str = "cpu") -> Scene:
        """The scene of a `state_dict`. It has the same detections as the original, bit by bit.

        Args:
            state: from `state_dict`.
            device: of all tensors.

        Raises:
            TypeError, ValueError: naming the entry that is missing or invalid.

        Example:
            >>> again = pgccd.Scene.from_state_dict(scene.state_dict())
        """
        arguments.entries(state, ("meshes", *_ENTRIES))
        given = {name: state[name] for name in _ENTRIES}
        if isinstance(given["static"], Tensor):
            given["static"] = given["static"].bool()
        given["self_collision"] = False if given["self_collision"] is None else given["self_collision"]
        if not isinstance(state["meshes"], list):
            raise TypeError(f"meshes: expected a list of states of meshes, got {arguments.describe(state['meshes'])}")
        return cls([Mesh.from_state_dict(mesh) for mesh in state["meshes"]], device=device, **given)

    def to(self, device: torch.device | str) -> Scene:
        """A copy on another device, meshes included.

        Raises:
            TypeError, ValueError: `device` is not a device, or a fixed column was written to.

        Example:
            >>> scene = scene.to("cpu")
        """
        meshes = self.meshes.to(device)
        self._detached()._refuse()
        moved = copy.copy(self)
        moved.meshes, moved.device = meshes, meshes.device
        moved._layout = moved._world_count = moved._own_estimates = None
        for name in (*_ENTRIES, "_self_colliding", "_given_radius"):
            column = getattr(self, name)
            if column is not None:
                moved.__dict__[name] = column.to(meshes.device)
        if self._is_of_user:
            require_meshes(moved.mesh_index, len(meshes))
            moved._remember()
            _ = moved.world_count  # computed now, as by the constructor
        return moved

    def __repr__(self) -> str:
        return f"Scene(bodies={self.body_count}, meshes={len(self.meshes)}, device={self.device})"


# Dtypes of the columns, as the operators expect them.
_DTYPES = {
    "mesh_index": torch.int32,
    "group": torch.int64,
    "mask": torch.int64,
    "world": torch.int32,
    "static": torch.uint8,
    "margin": torch.float64,
}
_FIXED = ("self_collision", "exclude")
# The entries of a state_dict besides meshes.
_ENTRIES = (*_DTYPES, *_FIXED)
