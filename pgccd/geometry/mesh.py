"""Meshes: triangles and the origin that poses refer to, prepared once and shared by any number of bodies."""

from __future__ import annotations

from collections.abc import Sequence
from os import PathLike
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from pgccd import _host, arguments
from pgccd.geometry import mesh_files
from pgccd.geometry.origin import Origin, checked_origin, origin_point

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
        self._node_links = torch.from_numpy(prepared["node_links"]).view(-1, 8, 4)
        self._leaf_points = torch.from_numpy(prepared["leaf_points"]).view(-1, 4, 8)

    @classmethod
    def from_trimesh(cls, mesh: Any, origin: Origin = (0.0, 0.0, 0.0), *, weld: bool = True) -> Mesh:
        """From a `trimesh.Trimesh`, or a `trimesh.Scene` (its meshes are placed by the scene's transforms, and joined).

        Args:
            mesh: what trimesh made.
            origin: as for the constructor.
            weld: make one vertex of those at the same position: files have several along the seams of a texture or of
                normals, at which the mesh would fall apart, and collide with itself where it deforms. Contacts then
                name vertices, edges and faces of the welded mesh; `source_vertex` and `source_face` say which these
                are of the mesh given.

        Faces that repeat a vertex, perhaps because it was welded, are dropped.

        Raises:
            TypeError, ValueError: if it holds no triangles, or something that is no mesh; or as the constructor.

        Example:
            >>> robot = pgccd.Mesh.from_trimesh(trimesh.creation.icosphere(subdivisions=3))
        """
        checked_origin(origin)
        return cls._of_geometry(mesh_files.joined_geometry(mesh), origin, weld)

    @classmethod
    def load(cls, path: str | PathLike[str], origin: Origin = (0.0, 0.0, 0.0), *, weld: bool = True) -> Mesh:
        """From any mesh file that trimesh loads (ply, stl, obj, off, glb, ...); all meshes in it are joined.

        Args:
            path: of the file.
            origin: as for the constructor.
            weld: as for `from_trimesh`.

        Raises:
            FileNotFoundError: no such file.
            ValueError: the file cannot be read as a mesh, holds no triangles, or holds something that is no mesh, such
                as a point cloud.
            ImportError: trimesh is not installed.

        Example:
            >>> rock = pgccd.Mesh.load("rock.ply")
            >>> rock.welded_vertices
            0
        """
        checked_origin(origin)
        loaded = mesh_files.load_geometry(path)
        try:
            return cls._of_geometry(mesh_files.joined_geometry(loaded), origin, weld)
        except ValueError as error:
            raise ValueError(f"path: {path}: {error}") from error

    @classmethod
    def load_all(cls, path: str | PathLike[str], origin: Origin = (0.0, 0.0, 0.0), *, weld: bool = True) -> list[Mesh]:
        """The meshes of a file one by one, with their names: of a scene (glb, gltf, 3mf, ...) each where the scene
        places it, of an obj file its objects and groups, of any other the only one. Arguments and errors as of `load`.

        Example:
            >>> parts = pgccd.Mesh.load_all("rock.ply")
            >>> scene = pgccd.Scene(parts)
        """
        checked_origin(origin)
        loaded, part = mesh_files.load_geometry(path, apart=True), ""
        meshes = []
        try:
            for geometry in mesh_files.placed_geometry(loaded):
                part = f": {geometry.name}" if geometry.name else ""
                meshes.append(cls._of_geometry(geometry, origin, weld))
        except ValueError as error:
            raise ValueError(f"path: {path}{part}: {error}") from error
        return meshes

    @classmethod
    def _of_geometry(cls, geometry: mesh_files.Geometry, origin: Origin, weld: bool) -> Mesh:
        cleaned = mesh_files.clean(geometry, arguments.flag(weld, "weld"))
        mesh = cls(cleaned.vertices, cleaned.faces, origin)
        mesh.name = geometry.name
        mesh.welded_vertices = len(geometry.vertices) - len(cleaned.vertices)
        mesh.dropped_faces = len(geometry.faces) - len(cleaned.faces)
        mesh.source_vertex = torch.from_numpy(cleaned.source_vertex)
        mesh.source_face = torch.from_numpy(cleaned.source_face)
        return mesh

    #: As the file calls it.
    name: str | None = None
    #: How many vertices of the file were one with others and are no longer there.
    welded_vertices: int = 0
    #: How many faces of the file repeated a vertex and are no longer there.
    dropped_faces: int = 0
    #: (V,) int64 row in the file of each vertex, the first of those welded; None of a mesh that comes from no file.
    source_vertex: Tensor | None = None
    #: (F,) int64 row in the file of each face.
    source_face: Tensor | None = None

    def __repr__(self) -> str:
        name = "" if self.name is None else f"{self.name!r}, "
        counts = f"vertices={len(self.vertices)}, faces={len(self.faces)}, edges={len(self.edges)}"
        gone = {"welded_vertices": self.welded_vertices, "dropped_faces": self.dropped_faces}
        changed = "".join(f", {what}={count}" for what, count in gone.items() if count)
        return f"Mesh({name}{counts}, radius={self.radius:g}{changed})"


class MeshSet:
    """Meshes concatenated for the kernels, on one device. `tensors` is the operators' `mesh_set` argument.

    Args:
        meshes: one or more `Mesh`.
        device: where the tensors live.
    """

    def __init__(self, meshes: Sequence[Mesh], device: torch.device | str = "cpu") -> None:
        if isinstance(meshes, (Mesh, str)) or not isinstance(meshes, Sequence):
            hint = ": write [mesh]" if isinstance(meshes, Mesh) else ""
            raise TypeError(f"meshes: expected a list of meshes, got {arguments.describe(meshes)}{hint}")
        if not meshes:
            raise ValueError("meshes: expected at least one Mesh")
        device = arguments.device(device)
        for index, mesh in enumerate(meshes):
            if not isinstance(mesh, Mesh):
                raise TypeError(f"meshes[{index}]: expected a pgccd.Mesh, got {type(mesh).__name__}")
        self.meshes = list(meshes)
        counts = torch.tensor(
            [[len(rows) for rows in (m.vertices, m.faces, m.edges, m._node_links, m._leaf_points)] for m in meshes]
        )
        #: (meshes + 1, 5) int64: first rows of each mesh's vertices, faces, edges, node blocks and leaf points. The last
        #: row holds the totals.
        self.offsets = torch.cat([torch.zeros((1, 5), dtype=torch.int64), counts.cumsum(0)])
        #: (meshes,) float64.
        self.radius = torch.tensor([m.radius for m in meshes], dtype=torch.float64, device=device)
        columns = ("vertices", "faces", "edges", "_triangles", "_node_blocks", "_node_links", "_leaf_points")
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

    def __len__(self) -> int:
        return len(self.meshes)

    def __repr__(self) -> str:
        return f"MeshSet(meshes={len(self)}, device={self.device})"

    def to(self, device: torch.device | str) -> MeshSet:
        """A copy on another device.

        Example:
            >>> meshes = meshes.to("cpu")
        """
        return MeshSet(self.meshes, device)


def _as_array(values: npt.ArrayLike | Tensor, dtype: type, name: str) -> np.ndarray:
    if isinstance(values, Tensor):
        arguments.refuse_gradient(values, name)
    numbers = "float32, float64 or integers" if dtype is np.float64 else "integers"
    try:
        raw = values.detach().cpu().numpy() if isinstance(values, Tensor) else np.asarray(values)
    except (TypeError, ValueError, RuntimeError) as error:  # ragged lists, bfloat16
        raise TypeError(f"{name}: expected {numbers}, got {arguments.describe(values)}: {error}") from error
    is_real = raw.dtype.kind == "f" and raw.dtype.itemsize in (4, 8)
    if raw.size and not (raw.dtype.kind in "iu" or (is_real and dtype is np.float64)):
        raise TypeError(f"{name}: expected {numbers}, got {raw.dtype}")
    if raw.ndim != 2 or raw.shape[1] != 3:
        raise ValueError(f"{name}: expected shape (n, 3), got {raw.shape}")
    return np.ascontiguousarray(raw, dtype=dtype)


def _check_faces(points: np.ndarray, faces: np.ndarray) -> None:
    if len(faces) == 0:
        raise ValueError("faces: the mesh holds no triangles")
    arguments.check_corners(points, faces)
    repeats = (faces == np.roll(faces, 1, axis=1)).any(axis=1)
    if repeats.any():
        first = int(np.argmax(repeats))
        raise ValueError(f"faces: face {first} repeats a vertex: {faces[first].tolist()}")
