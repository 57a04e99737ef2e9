"""Meshes: triangles and the origin that poses refer to, prepared once and shared by any number of bodies."""

from __future__ import annotations

from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from pgccd import _host
from pgccd.origin import Origin, origin_point

# Triangles a leaf of the hierarchy holds at most: one for each lane of a vector unit.
LEAF_SIZE = 8

# Beyond these the float32 hierarchy would overflow or vanish.
SMALLEST_RADIUS, LARGEST_RADIUS = 1e-30, 1e30
# An origin further away than so many SBV radii leaves vertices no more than four digits.
_FURTHEST_ORIGIN = 1e12


class Mesh:
    """A triangle mesh with its sphere bounding volume (SBV) and hierarchy.

    A pose maps the coordinates as given: a point v of the mesh is at position + R (v - origin). The origin is the point
    whose place a pose's position is, and the one a rigid path turns about; nothing about a path depends on how finely
    the mesh is tessellated.

    Points are kept relative to the origin in float64, so an origin r SBV radii away costs them digits: their error is
    about 300 r times 2^-53 of a radius, which the default tolerance of detection (1e-6 radii) covers up to r of about
    1e6. Beyond that nothing is missed, but bodies are reported as touching that are a few such errors apart.

    Args:
        vertices: (V, 3) array or tensor of finite numbers, in scene length units.
        faces: (F, 3) integers, each face three different rows of `vertices`. Open, non-manifold and multi-component
            meshes are fine, and so are faces without area.
        origin: a point (3,) in the coordinates of `vertices`, for example a joint; "centroid", the SBV centre: the mean
            of the corner coordinates over all triangles (Du, Liu & Suzumura 2017, Eq. 1), which depends on the
            tessellation; or "center_of_mass", that of a solid of uniform density. The surface must then be closed and
            consistently oriented (each edge between two triangles that pass through it in opposite directions).

    Raises:
        ValueError: naming the first offending vertex or face, or when the mesh has no faces or no extent; or origin,
            when it is not a finite point or the surface bounds no solid.

    Example:
        >>> corners = [[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]]
        >>> tetrahedron = pgccd.Mesh(corners, [[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]])
        >>> tetrahedron.edges.shape
        torch.Size([6, 2])
    """

    def __init__(
        self, vertices: npt.ArrayLike | Tensor, faces: npt.ArrayLike | Tensor, origin: Origin = (0.0, 0.0, 0.0)
    ) -> None:
        points = _as_array(vertices, np.float64, "vertices")
        triangles = _as_array(faces, np.int64, "faces")
        _check_faces(points, triangles)

        corners = points[triangles]
        # From the first corner, so that a mesh far from the origin keeps its digits.
        centre = corners[0, 0] + (corners - corners[0, 0]).reshape(-1, 3).mean(axis=0)
        reference = origin_point(origin, points, triangles, centre)
        # Relative to the origin these are the truth; all else follows from them.
        body = points - reference
        offset = centre - reference
        local = body - offset if offset.any() else body
        radius = float(np.sqrt((local[triangles.ravel()] ** 2).sum(axis=1).max()))
        if not SMALLEST_RADIUS <= radius <= LARGEST_RADIUS:
            raise ValueError(
                f"vertices: the mesh has SBV radius {radius:g}; "
                f"it must lie in [{SMALLEST_RADIUS:g}, {LARGEST_RADIUS:g}]"
            )
        if float(np.abs(offset).max()) > _FURTHEST_ORIGIN * radius:
            raise ValueError(
                f"origin: it must lie within {_FURTHEST_ORIGIN:g} SBV radii of the SBV centre {centre.tolist()}, of "
                f'which one is {radius:g}, but it is {reference.tolist()}; origin="centroid" puts it there'
            )
        prepared = _host.prepare_mesh(local, triangles.astype(np.int32), LEAF_SIZE)
        #: (3,) float64: the origin in the coordinates given.
        self.origin = torch.from_numpy(reference)
        #: (3,) float64: the SBV centre in the coordinates given.
        self.centre = torch.from_numpy(centre)
        #: SBV radius: the largest distance of a used vertex from the centre (Eq. 2), rounded up.
        self.radius = radius * (1.0 + 2.0**-50)
        #: (3,) float64: the SBV centre relative to the origin; exactly 0 for "centroid".
        self.centre_offset = torch.from_numpy(offset)
        #: No used vertex is further from the origin; the radius where the centre is there.
        self.reach = self.radius
        if offset.any():
            self.reach = (self.radius + float(np.linalg.norm(offset))) * (1.0 + 2.0**-50)
        #: (V, 3) float64, relative to the origin.
        self.vertices = torch.from_numpy(body)
        #: (F, 3) int32.
        self.faces = torch.from_numpy(triangles.astype(np.int32))
        #: (E, 2) int32: each edge once, smaller vertex first, in lexicographic order. Contacts name edges by these
        #: rows.
        self.edges = torch.from_numpy(prepared["edges"])
        self._triangles = torch.from_numpy(prepared["triangles"])
        in_leaf_order = self.faces[self._triangles[:, 6].long()].long()
        # Corner coordinates as nine columns, relative to the SBV centre as the hierarchy is.
        self._corners = torch.from_numpy(local).float()[in_leaf_order].view(-1, 9).T.contiguous()
        self._node_blocks = torch.from_numpy(prepared["node_blocks"]).view(-1, 9, 8)
        self._node_links = torch.from_numpy(prepared["node_links"]).view(-1, 8, 2)

    @classmethod
    def from_trimesh(cls, mesh: Any, origin: Origin = (0.0, 0.0, 0.0)) -> Mesh:
        """From a `trimesh.Trimesh`, or a `trimesh.Scene` (its geometry is joined). `origin` as for the constructor.

        Raises:
            ValueError: if it holds no triangles, or as the constructor.

        Example:
            >>> robot = pgccd.Mesh.from_trimesh(trimesh.creation.icosphere(subdivisions=3))
        """
        if hasattr(mesh, "to_mesh"):  # a scene
            mesh = mesh.to_mesh()
        faces = getattr(mesh, "faces", None)
        if faces is None or len(faces) == 0:
            raise ValueError(f"mesh: {type(mesh).__name__} holds no triangles")
        return cls(np.asarray(mesh.vertices), np.asarray(faces), origin)

    @classmethod
    def load(cls, path: str | PathLike[str], origin: Origin = (0.0, 0.0, 0.0)) -> Mesh:
        """From any mesh file that trimesh loads (ply, stl, obj, off, glb, ...). Faces that repeat a vertex are dropped.
        `origin` as for the constructor.

        Raises:
            FileNotFoundError: no such file.
            ValueError: the file cannot be read as a mesh, or holds no triangles.
            ImportError: trimesh is not installed.

        Example:
            >>> rock = pgccd.Mesh.load("rock.ply")
        """
        try:
            import trimesh
        except ImportError as error:
            raise ImportError("Mesh.load reads files through trimesh: pip install trimesh") from error
        if not Path(path).is_file():
            raise FileNotFoundError(f"path: no mesh file at {path}")
        try:
            loaded: Any = trimesh.load(str(path), process=False)
            mesh = loaded.to_mesh() if hasattr(loaded, "to_mesh") else loaded
            faces = np.asarray(getattr(mesh, "faces", np.empty((0, 3))))
            vertices = np.asarray(mesh.vertices, dtype=np.float64)
        except Exception as error:
            raise ValueError(f"path: {path} cannot be read as a mesh: {error}") from error
        if len(faces) == 0:
            raise ValueError(f"path: {path} holds no triangles")
        if (
            Path(path).suffix.lower() == ".stl"
        ):  # lists every triangle's corners anew; connectivity is by equal coordinates
            vertices, inverse = np.unique(vertices, axis=0, return_inverse=True)
            faces = inverse.reshape(-1)[faces]
        repeats = (faces[:, 0] == faces[:, 1]) | (faces[:, 1] == faces[:, 2]) | (faces[:, 2] == faces[:, 0])
        if repeats.all():
            raise ValueError(f"path: {path} holds no triangles with three different corners")
        try:
            return cls(vertices, faces[~repeats], origin)
        except ValueError as error:
            raise ValueError(f"path: {path}: {error}") from error

    def __repr__(self) -> str:
        counts = f"vertices={len(self.vertices)}, faces={len(self.faces)}, edges={len(self.edges)}"
        return f"Mesh({counts}, radius={self.radius:g})"


class MeshSet:
    """Meshes concatenated for the kernels, on one device. `tensors` is the operators' `mesh_set` argument.

    Args:
        meshes: one or more `Mesh`.
        device: where the tensors live.
    """

    def __init__(self, meshes: list[Mesh], device: torch.device | str = "cpu") -> None:
        if not meshes:
            raise ValueError("meshes: expected at least one Mesh")
        for index, mesh in enumerate(meshes):
            if not isinstance(mesh, Mesh):
                raise TypeError(f"meshes[{index}]: expected a pgccd.Mesh, got {type(mesh).__name__}")
        self.meshes = list(meshes)
        counts = torch.tensor(
            [[len(m.vertices), len(m.faces), len(m.edges), len(m._node_links)] for m in meshes], dtype=torch.int64
        )
        #: (meshes + 1, 4) int64: first rows of each mesh's vertices, faces, edges and node blocks; the last row closes.
        self.offsets = torch.cat([torch.zeros((1, 4), dtype=torch.int64), counts.cumsum(0)])
        #: (meshes,) float64.
        self.radius = torch.tensor([m.radius for m in meshes], dtype=torch.float64, device=device)
        columns = ("vertices", "faces", "edges", "_triangles", "_node_blocks", "_node_links")
        joined = [torch.cat([getattr(m, column) for m in meshes]) for column in columns]
        # Padded, so that eight neighbours can be loaded at the last triangle too.
        corners = torch.nn.functional.pad(torch.cat([m._corners for m in meshes], dim=1), (0, LEAF_SIZE))
        #: Whether every mesh has its SBV centre at its origin.
        self.is_centred = not any(bool(m.centre_offset.any()) for m in meshes)
        off_centre = [] if self.is_centred else meshes
        centres = torch.cat([torch.empty((0, 3), dtype=torch.float64), *(m.centre_offset[None] for m in off_centre)])
        reaches = torch.tensor([m.reach for m in off_centre], dtype=torch.float64)
        columns_of_all = (*joined, corners, self.offsets, centres, reaches)
        self.tensors = [tensor.contiguous().to(device) for tensor in columns_of_all]
        #: As torch resolves it: "cuda" becomes "cuda:0".
        self.device = self.tensors[0].device
        #: What steps have needed; kept by `pgccd.memory`.
        self.experience: dict[str, object] = {}

    def __len__(self) -> int:
        return len(self.meshes)


def _as_array(values: npt.ArrayLike | Tensor, dtype: type, name: str) -> np.ndarray:
    raw = values.detach().cpu().numpy() if isinstance(values, Tensor) else np.asarray(values)
    if raw.ndim != 2 or raw.shape[1] != 3:
        raise ValueError(f"{name}: expected shape (n, 3), got {raw.shape}")
    if dtype is np.int64 and raw.size and not np.issubdtype(raw.dtype, np.integer):
        raise ValueError(f"{name}: expected integers, got {raw.dtype}")
    return np.ascontiguousarray(raw, dtype=dtype)


def _check_faces(points: np.ndarray, faces: np.ndarray) -> None:
    if len(faces) == 0:
        raise ValueError("faces: the mesh holds no triangles")
    finite = np.isfinite(points).all(axis=1)
    if not finite.all():
        first = int(np.argmin(finite))
        raise ValueError(f"vertices: vertex {first} is not finite: {points[first].tolist()}")
    out_of_range = ((faces < 0) | (faces >= len(points))).any(axis=1)
    if out_of_range.any():
        first = int(np.argmax(out_of_range))
        raise ValueError(f"faces: face {first} is {faces[first].tolist()}, but there are {len(points)} vertices")
    repeats = (faces == np.roll(faces, 1, axis=1)).any(axis=1)
    if repeats.any():
        first = int(np.argmax(repeats))
        raise ValueError(f"faces: face {first} repeats a vertex: {faces[first].tolist()}")
