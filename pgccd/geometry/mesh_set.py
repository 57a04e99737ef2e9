"""Sets of meshes, as the operators take them."""

from __future__ import annotations

import copy
from collections.abc import Sequence
from functools import cached_property

import numpy as np
import torch
from torch import Tensor

from pgccd import arguments
from pgccd.geometry.incidence import incidence
from pgccd.geometry.mesh import LEAF_SIZE, Mesh
from pgccd.geometry.solids import opening, vertices_of_components

# Of the tensors of a mesh set: where each mesh's pieces begin, if any is a solid.
PIECE_BEGIN = -2


class MeshSet:
    """Meshes concatenated for the kernels, on one device. `tensors` is the operators' `mesh_set` argument.

    Args:
        meshes: one or more `Mesh`.
        device: of the tensors, as resolved by torch: "cuda" becomes "cuda:0".

    Raises:
        TypeError, ValueError: `meshes` is not a list of at least one mesh, or `device` is not a device.

    Attributes:
        meshes: the meshes.
        offsets: (meshes + 1, 6) int64: first rows of each mesh's vertices, faces, edges, node blocks, leaf points and
            corners. The last row holds the totals.
        radius: (meshes,) float64 SBV radii.
        is_centred: whether every mesh has its SBV centre at its origin.
        has_boxes: whether a mesh fills so little of its SBV that the broad phase also tests boxes.
        has_solids: whether a mesh is a solid.
        thickness: (meshes,) float64; None if no mesh has any.
        tensors: the operators' `mesh_set` argument.
    """

    def __init__(self, meshes: Sequence[Mesh], device: torch.device | str = "cpu") -> None:
        if isinstance(meshes, (Mesh, str)) or not isinstance(meshes, Sequence):
            hint = ": write [mesh]" if isinstance(meshes, Mesh) else ""
            raise TypeError(f"meshes: expected a list of meshes, got {arguments.describe(meshes)}{hint}")
        if not meshes:
            raise ValueError("meshes: expected at least one Mesh")
        device = arguments.device(device)
        for index, mesh in enumerate(meshes):
            arguments.instance(mesh, f"meshes[{index}]", Mesh)
        self.meshes = list(meshes)
        columns = ("vertices", "faces", "edges", "_triangles", "_node_blocks", "_node_links", "_leaf_points")
        counted = ("vertices", "faces", "edges", "_node_links", "_leaf_points")
        sizes = [[len(getattr(m, each)) for each in counted] + [m._corners.shape[1] - LEAF_SIZE] for m in meshes]
        counts = torch.tensor(sizes)
        self.offsets = torch.cat([torch.zeros((1, 6), dtype=torch.int64), counts.cumsum(0)])
        self.radius = torch.tensor([m.radius for m in meshes], dtype=torch.float64, device=device)
        joined = [_joined([getattr(m, column) for m in meshes]) for column in columns]
        # All but the last without their padding.
        padded = [*(m._corners[:, :-LEAF_SIZE] for m in meshes[:-1]), meshes[-1]._corners]
        corners = _joined(padded, dim=1)
        self.is_centred = not any(bool(m.centre_offset.any()) for m in meshes)
        off_centre = [] if self.is_centred else meshes
        centres = torch.cat([torch.empty((0, 3), dtype=torch.float64), *(m.centre_offset[None] for m in off_centre)])
        reaches = torch.tensor([m.reach for m in off_centre], dtype=torch.float64)
        supports = _joined([m._node_supports for m in meshes])
        self.has_boxes = any(m._box is not None for m in meshes)
        boxes = torch.zeros((len(meshes) if self.has_boxes else 0, 4, 3), dtype=torch.float64)
        for index, mesh in enumerate(meshes):
            if mesh._box is not None:
                boxes[index] = torch.from_numpy(mesh._box)
        columns_of_all = (
            *joined,
            corners,
            self.offsets,
            centres,
            reaches,
            supports,
            boxes,
            *_solid_columns(meshes, [m.solid for m in meshes]),
        )
        self.tensors = [tensor.contiguous().to(device) for tensor in columns_of_all]
        self.device = self.tensors[0].device
        self.has_solids = any(mesh.solid for mesh in meshes)
        thickness = [mesh.thickness for mesh in meshes]
        self.thickness = torch.tensor(thickness, dtype=torch.float64, device=self.device) if any(thickness) else None

    @cached_property
    def _incidence(self) -> tuple[list[Tensor], int]:
        """Which faces and edges meet, see `incidence`; on the meshes' device. Made when first asked for."""
        vertices, faces, edges = (tensor.cpu() for tensor in self.tensors[:3])
        lists, most = incidence(vertices, faces, edges, self.offsets)
        return [column.to(self.device) for column in lists], most

    @cached_property
    def _surfaces(self) -> MeshSet:
        """The same meshes, of which none is a solid to the operators."""
        return self._with_solids([False] * len(self))

    @cached_property
    def _bare(self) -> MeshSet:
        """The same, without their thickness."""
        other = copy.copy(self._surfaces)
        other.thickness = None
        return other

    @cached_property
    def _closed(self) -> MeshSet:
        """The same meshes without their thickness, of which all that are closed are solids to the operators."""
        other = self._with_solids([opening(mesh.faces.numpy()) is None for mesh in self.meshes])
        other.thickness = None
        return other

    def _with_solids(self, are_solid: list[bool]) -> MeshSet:
        other = copy.copy(self)
        solids = [column.to(self.device) for column in _solid_columns(self.meshes, are_solid)]
        other.tensors = [*self.tensors[: -len(solids)], *solids]
        other.has_solids = any(are_solid)
        return other

    def __len__(self) -> int:
        return len(self.meshes)

    def __repr__(self) -> str:
        return f"MeshSet(meshes={len(self)}, device={self.device})"

    def to(self, device: torch.device | str) -> MeshSet:
        """A copy on another device.

        Raises:
            TypeError, ValueError: `device` is not a device.

        Example:
            >>> meshes = meshes.to("cpu")
        """
        return MeshSet(self.meshes, device)


def _joined(columns: list[Tensor], dim: int = 0) -> Tensor:
    """One after the other. A single one is not copied: a large mesh is in memory once."""
    return columns[0] if len(columns) == 1 else torch.cat(columns, dim=dim)


def _solid_columns(meshes: Sequence[Mesh], are_solid: list[bool]) -> tuple[Tensor, Tensor, Tensor]:
    """Which meshes are solids, (meshes,) uint8; the first row of each one's pieces, (meshes + 1,) int64; and a vertex
    of each piece of triangles and segments, int32. All empty if none is a solid.
    """
    if not any(are_solid):
        return torch.empty(0, dtype=torch.uint8), torch.empty(0, dtype=torch.int64), torch.empty(0, dtype=torch.int32)
    pieces = [torch.from_numpy(_pieces(mesh)).int() for mesh in meshes]
    begin = torch.tensor([0, *(len(vertices) for vertices in pieces)]).cumsum(0)
    return torch.tensor(are_solid, dtype=torch.uint8), begin, torch.cat(pieces)


def _pieces(mesh: Mesh) -> np.ndarray:
    joined = mesh.faces[: mesh.triangle_count + mesh.segment_count].numpy()
    return vertices_of_components(joined) if len(joined) else np.empty(0, dtype=np.int64)
