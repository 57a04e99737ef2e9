"""Scenes: bodies and their collision filters."""

from __future__ import annotations

import copy
from collections.abc import Hashable, Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from pgccd import arguments
from pgccd.geometry.columns import (
    bool_column,
    integer_column,
    margin_column,
    require_meshes,
    self_column,
    world_column,
)
from pgccd.geometry.mesh import Mesh, MeshSet

#: Columns of a scene that filter pairs.
FILTERS = ("group", "mask", "world", "static")
#: Columns of a scene that may be absent.
OPTIONAL_COLUMNS = (*FILTERS, "margin")


@dataclass(frozen=True)
class VertexLayout:
    """Layout of the vertices and hierarchies of deforming bodies, one body after the other."""

    vertex_count: int
    block_count: int  #: number of node blocks
    vertex_begin: Tensor  #: (N,) int64
    block_begin: Tensor  #: (N,) int64


class Scene:
    """N bodies, each an instance of one of a few meshes. Positions are not part of it: see `pgccd.motion.paths`.

    A pair of bodies is tested if both are in the same `world`, at least one is not `static`, and each one's `group` has
    a bit in common with the other's `mask`.

    Args:
        meshes: the meshes, or a `MeshSet` already on `device`.
        mesh_index: (N,) integers: mesh of each body. Default: one body per mesh.
        device: of all tensors; default the MeshSet's, else mesh_index's if it is a tensor, else the CPU.
        group, mask: (N,) int64 bit sets; default all bits.
        world: (N,) integers; default all in one.
        static: (N,) bool; default none.
        self_collision: bool, or (N,) bool: which bodies are also tested against themselves, as pairs (i, i), while they
            deform (`VertexMotion`); default none. Feature pairs that share a vertex are not tested. group, mask and
            world do not affect these tests; static bodies are not tested.
        margin: thickness of bodies, a number or (N,), scene length units, finite and >= 0: a pair is tested with the
            separation min_separation + margin_i + margin_j, and a body against itself with min_separation + 2 margin_i.
            Default none. If a body's true path never deviates from the tested one by more than its margin, no contact
            of the true path is missed.

    `mesh_index`, `group`, `mask`, `world`, `static` and `margin` may be written to or replaced later; the bodies that
    are tested against themselves are fixed.

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
        #: The meshes, concatenated.
        self.meshes = meshes
        self.device = meshes.device
        if device.type != self.device.type or device.index not in (None, self.device.index):
            raise ValueError(f"device: the MeshSet is on {self.device}, not {device}")
        if mesh_index is None:
            mesh_index = list(range(len(meshes)))
        #: (N,) int32.
        self.mesh_index = integer_column(mesh_index, "mesh_index", None, self.device)
        #: Number of bodies N.
        self.body_count = len(self.mesh_index)
        require_meshes(self.mesh_index, len(meshes))
        self.mesh_index = self.mesh_index.to(torch.int32)
        count = self.body_count
        self.group = None if group is None else integer_column(group, "group", count, self.device)
        self.mask = None if mask is None else integer_column(mask, "mask", count, self.device)
        self.world = None if world is None else world_column(world, count, self.device)
        self.static = None if static is None else bool_column(static, "static", count, self.device)
        _ = self.world_count  # computed now, so that a step need not synchronise
        #: (N,) float64, or None if no body has a margin.
        self.margin = None if margin is None else margin_column(margin, count, self.device)
        #: (N,) bool, or None if no body is tested against itself.
        self.self_collision = self_column(self_collision, count, self.device)
        if self.self_collision is not None and self.static is not None:
            self.self_collision &= self.static == 0
        self._count_self_colliding()

    # Capacity estimates by kind of step, managed by `pgccd.detection.memory`. They change how often a step is repeated
    # on a GPU, never its result.
    _capacity_estimates: dict[Hashable, Any] | None = None

    @property
    def capacity_estimates(self) -> dict[Hashable, Any]:
        """Capacity estimates of earlier steps. Successive scenes of a simulation may share them."""
        if self._capacity_estimates is None:
            self._capacity_estimates = {}
        return self._capacity_estimates

    @capacity_estimates.setter
    def capacity_estimates(self, estimates: dict[Hashable, Any]) -> None:
        self._capacity_estimates = estimates

    @classmethod
    def of_checked(
        cls, meshes: MeshSet, mesh_index: Tensor, self_collision: Tensor | None = None, **columns: Tensor
    ) -> Scene:
        """From columns of a scene that has been validated: rows of its `mesh_index`, `group`, `margin` and so on.
        Nothing is checked.

        Example:
            >>> part = pgccd.Scene.of_checked(scene.meshes, scene.mesh_index[rows])
        """
        scene = cls.__new__(cls)
        scene.meshes, scene.device = meshes, meshes.device
        scene.mesh_index, scene.body_count = mesh_index, mesh_index.shape[0]
        for name in OPTIONAL_COLUMNS:
            setattr(scene, name, columns.get(name))
        scene.self_collision = self_collision
        scene._count_self_colliding()
        return scene

    def _count_self_colliding(self) -> None:
        flags, begin = self.self_collision, self.meshes.offsets[:, 0]
        #: (S,) int64, ascending: the bodies tested against themselves. Computed once, so that a step need not
        #: synchronise.
        self.self_colliding = torch.empty(0, dtype=torch.int64, device=self.device)
        #: Their total number of vertices.
        self.self_colliding_vertices = 0
        if flags is not None:
            self.self_colliding = torch.nonzero(flags).flatten()
            meshes = self.mesh_index[self.self_colliding].cpu().long()
            self.self_colliding_vertices = int((begin[1:] - begin[:-1])[meshes].sum())

    # Cached values derived from `mesh_index` and `world`.
    _radius: _Derived | None = None
    _layout: _Derived | None = None
    _world_count: _Derived | None = None

    @property
    def radius(self) -> Tensor:
        """SBV radius of each body's mesh, (N,) float64."""
        if self._radius is None or not self._radius.is_of(self.mesh_index):
            if torch.compiler.is_compiling():  # values are not available while compiling
                return self.meshes.radius[self.mesh_index.long()]
            if self._radius is not None and self.device.type == "cpu":
                require_meshes(self.mesh_index, len(self.meshes))
            self._radius = _Derived(self.mesh_index, self.meshes.radius[self.mesh_index.long()])
        return self._radius.value

    @radius.setter
    def radius(self, radius: Tensor) -> None:
        self._radius = _Derived(self.mesh_index, radius)

    @property
    def layout(self) -> VertexLayout:
        """First rows of each body's vertices and node blocks, for bodies that deform."""
        if self._layout is None or not self._layout.is_of(self.mesh_index):
            self._layout = _Derived(self.mesh_index, self._find_layout())
        return self._layout.value

    def _find_layout(self) -> VertexLayout:
        index = self.mesh_index.cpu().long()
        require_meshes(index, len(self.meshes))
        offsets = self.meshes.offsets
        counts = (offsets[1:] - offsets[:-1])[index]
        begin = (counts.cumsum(0) - counts).to(self.device)
        vertex_count, _, _, block_count, _ = counts.sum(0).tolist()
        return VertexLayout(vertex_count, block_count, begin[:, 0].contiguous(), begin[:, 3].contiguous())

    @property
    def world_count(self) -> int:
        """One more than the largest `world`; 1 without worlds."""
        if self.world is None:
            return 1
        if self._world_count is None or not self._world_count.is_of(self.world):
            self._world_count = _Derived(self.world, 1 + int(self.world.max()) if self.body_count else 0)
        return self._world_count.value

    def check_columns(self) -> None:
        """Raises TypeError or ValueError if a column was replaced by one of another type, shape or device. Values are
        not checked.
        """
        for name, dtype in _DTYPES.items():
            column = getattr(self, name)
            if column is None and name != "mesh_index":
                continue
            if not isinstance(column, Tensor) or column.dtype != dtype:
                raise TypeError(
                    f"{name}: expected {arguments.dtype_name(dtype)} in a scene, got {arguments.describe(column)}"
                )
            if column.shape != (self.body_count,) or column.device != self.device:
                expected = f"shape ({self.body_count},) on {self.device}"
                raise ValueError(f"{name}: expected {expected}, got {tuple(column.shape)} on {column.device}")
            if not column.is_contiguous():
                raise ValueError(f"{name}: expected a contiguous tensor")

    def to(self, device: torch.device | str) -> Scene:
        """A copy on another device, meshes included.

        Example:
            >>> scene = scene.to("cpu")
        """
        meshes = self.meshes.to(device)
        moved = copy.copy(self)
        moved.meshes, moved.device = meshes, meshes.device
        moved._radius = moved._layout = moved._world_count = moved._capacity_estimates = None
        for name in (*_DTYPES, "self_collision", "self_colliding"):
            column = getattr(self, name)
            if column is not None:
                setattr(moved, name, column.to(meshes.device))
        return moved

    def __repr__(self) -> str:
        return f"Scene(bodies={self.body_count}, meshes={len(self.meshes)}, device={self.device})"


@dataclass
class _Derived:
    """A value derived from a column, with that column and its version."""

    column: Tensor
    value: Any
    version: int | None = None

    def __post_init__(self) -> None:
        self.version = _version(self.column)

    def is_of(self, column: Tensor) -> bool:
        """Whether the value was derived from this column, unmodified since."""
        return self.column is column and (torch.compiler.is_compiling() or self.version == _version(column) is not None)


def _version(column: Tensor) -> int | None:
    """Counter of in-place writes to the column; None where torch does not track it."""
    return None if torch.compiler.is_compiling() or column.is_inference() else column._version


# Dtypes of the columns, as the operators expect them.
_DTYPES = {
    "mesh_index": torch.int32,
    "group": torch.int64,
    "mask": torch.int64,
    "world": torch.int32,
    "static": torch.uint8,
    "margin": torch.float64,
}
