"""Meshes: triangles, segments and points, the origin that poses refer to, and the hierarchy."""

from __future__ import annotations

import copy
from collections.abc import Sequence
from os import PathLike
from typing import Any, Literal

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from pgccd import arguments, ops
from pgccd.geometry import elements, mesh_files, shapes
from pgccd.geometry.boxes import elongated_box
from pgccd.geometry.coordinates import as_array, is_float32, warn_of_rounding
from pgccd.geometry.origin import Origin, checked_origin, checked_point, origin_point
from pgccd.geometry.solids import Solid, is_solid

# Maximum number of triangles per leaf of the hierarchy: one per lane of a vector unit.
LEAF_SIZE = 8

# Outside of these limits the float32 hierarchy would overflow or underflow.
SMALLEST_RADIUS, LARGEST_RADIUS = 1e-30, 1e30
# Sort keys of contacts hold the indices of two features and a kind.
_MOST_EDGES = 2**30 - 1
# Beyond this many SBV radii vertices have no more than four significant digits.
_FURTHEST_ORIGIN = 1e12


# Entries of a mesh's state_dict: what it is built from, and where it comes from.
_STATE = ("vertices", "faces", "origin", "centre", "centre_offset")
# Entries that former states lack.
_LATER: dict[str, Any] = {"unit": None, "solid": False, "thickness": 0.0}
#: Units that lengths of files are converted to.
Unit = Literal["m", "cm", "mm", "in", "ft"]
_OF_FILE = ("name", "welded_vertices", "dropped_faces", "source_vertex", "source_face")


class Mesh:
    """A mesh of triangles, segments and points with its sphere bounding volume (SBV) and hierarchy. A sphere is a point
    with a thickness, a capsule a segment with a thickness.

    A pose maps the coordinates that were given: a point v of the mesh is at position + R (v - origin). The position of
    a pose is where the origin is, and a rigid path rotates about the origin. Unless the origin is "centroid", the path
    does not depend on the tessellation.

    Points are stored in float64, relative to the origin. If the origin is r SBV radii from the SBV centre, their error
    is about 300 r times 2^-53 radii. The default tolerance of detection (1e-6 radii) covers this error up to r of about
    1e6. Beyond that no contact is missed, but bodies a few such errors apart are reported as touching.

    Args:
        vertices: (V, 3) array or tensor of finite numbers, in scene length units. Lists become float64. A UserWarning
            names faces so far from the origin of the coordinates that float32 has distorted them.
        faces: (T, 3) integers, three different rows of `vertices` per triangle. Meshes may be open, non-manifold or in
            several components, and triangles may have no area. Default: none.
        origin: a point (3,) in the coordinates of `vertices`, for example a joint; or "centroid" or "center_of_mass".
            "centroid" is the SBV centre: the mean of the corner coordinates over all triangles (Du, Liu & Suzumura
            2017, Eq. 1), which depends on the tessellation; for a mesh without triangles, the middle of its bounding
            box. "center_of_mass" is the centre of mass of a solid of uniform density. Its surface must be closed and
            consistently oriented (each edge shared by two triangles in opposite directions).
        segments: (S, 2) integers, two different rows of `vertices` per segment. Default: none.
        points: (P,) integers, different rows of `vertices`. Default: none.
        solid: whether the inside belongs to the body: a body that begins a step inside of it then touches it
            (`Kind.INSIDE`). True needs a closed and consistently oriented surface. "auto" is True for such surfaces
            that face outwards, around a volume > 0. A point is inside if the surface winds about it, also where several
            shells overlap. A cavity, whose surface faces the other way, is outside. Default False: only the surface
            counts.
        thickness: length >= 0, in the units of `vertices`, by which triangles, segments and points are thickened on all
            sides. A scene adds it to the margin of each body with this mesh.

    Attributes:
        origin: (3,) float64: the origin in the coordinates given.
        centre: (3,) float64: the SBV centre in the coordinates given.
        radius: SBV radius: the largest distance of a used vertex from the centre (Eq. 2), rounded up; 1e-30 for points
            at one place.
        centre_offset: (3,) float64: the SBV centre relative to the origin; exactly 0 for "centroid".
        reach: bound of the distance of used vertices from the origin; the radius if the SBV centre is the origin.
        vertices: (V, 3) float64, relative to the origin.
        faces: (F, 3) int32: the elements. First the triangles, then each segment (a, b) as (a, b, b), then each point a
            as (a, a, a). Face indices of contacts refer to it.
        triangle_count, segment_count, point_count: numbers of these elements.
        solid: bool: whether the inside belongs to the body.
        thickness: by how much the elements are thickened.
        edges: (E, 2) int32: each edge once, smaller vertex first, in lexicographic order. Edge indices of contacts
            refer to it.
        name: of the object in its file, or None.
        unit: length unit of the coordinates in metres, if their file states one or `unit` was given.
        welded_vertices: number of vertices of the file removed by welding.
        dropped_faces: number of faces and segments of the file dropped because they repeat a vertex, and of points
            dropped because the file lists their vertex already.
        source_vertex: (V,) int64: row in the file of each vertex, the first of those welded; None for a mesh not from a
            file.
        source_face: (F,) int64: row in the file of each face. In a file without triangles, rows count its segments,
            then its points. None for a mesh not from a file.

    Raises:
        ValueError: a vertex, face, segment or point is invalid (the first one is named); the mesh has none of these, or
            an SBV radius outside of [1e-30, 1e30]; the origin is not a finite point, is too far away, or is undefined
            because the surface bounds no solid; `solid` is True, but an edge is not shared by two faces in opposite
            directions; or `thickness` is no length.
        TypeError: `solid` is neither a bool nor "auto", or `thickness` is no number.

    Example:
        >>> corners = [[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]]
        >>> tetrahedron = pgccd.Mesh(corners, [[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]])
        >>> tetrahedron.edges.shape
        torch.Size([6, 2])
    """

    def __init__(
        self,
        vertices: npt.ArrayLike | Tensor,
        faces: npt.ArrayLike | Tensor | None = None,
        origin: Origin = (0.0, 0.0, 0.0),
        *,
        segments: npt.ArrayLike | Tensor | None = None,
        points: npt.ArrayLike | Tensor | None = None,
        solid: Solid = False,
        thickness: float = 0.0,
    ) -> None:
        x = as_array(vertices, np.float64, "vertices", 3)
        self._set_elements(x, elements.elements(x, faces, segments, points), origin, solid, thickness)
        if arguments.is_float32(vertices):
            warn_of_rounding(x, self.faces.long().numpy())

    @classmethod
    def _of_elements(cls, x: np.ndarray, table: np.ndarray, *, solid: Solid = False, thickness: float = 0.0) -> Mesh:
        """A mesh of vertices (V, 3) and a table of elements (F, 3) in any order."""
        ordered = table[np.argsort(elements.kinds(table), kind="stable")]
        mesh = cls.__new__(cls)
        mesh._set_elements(x, elements.checked(x, ordered), (0.0, 0.0, 0.0), solid, thickness)
        return mesh

    def _set_elements(self, x: np.ndarray, table: np.ndarray, origin: Origin, solid: Solid, thickness: float) -> None:
        self.solid = is_solid(solid, x, table)
        self.thickness = _checked_thickness(thickness)
        centre = elements.centre(x, table)
        reference = origin_point(origin, x, table, centre)
        # Coordinates relative to the origin are taken as exact; all else is derived from them.
        body = x - reference
        self._prepare(body, table, reference, centre, centre - reference)

    def _prepare(
        self, body: np.ndarray, table: np.ndarray, reference: np.ndarray, centre: np.ndarray, offset: np.ndarray
    ) -> None:
        """Sets all attributes that are derived.

        Args:
            body: (V, 3) vertices relative to the origin.
            table: (F, 3) elements.
            reference, centre: (3,) the origin and the SBV centre, in the coordinates given.
            offset: (3,) of the SBV centre relative to the origin.
        """
        local = body - offset if offset.any() else body
        self.triangle_count, self.segment_count, self.point_count = elements.counts(table)
        radius = float(np.sqrt((elements.used(local, table) ** 2).sum(axis=1).max()))
        is_one_place = self.point_count == len(table) and radius < SMALLEST_RADIUS
        radius = SMALLEST_RADIUS if is_one_place else radius
        if not SMALLEST_RADIUS <= radius <= LARGEST_RADIUS:
            raise ValueError(
                f"vertices: the mesh has SBV radius {radius:g}; "
                f"it must lie in [{SMALLEST_RADIUS:g}, {LARGEST_RADIUS:g}]"
            )
        if float(np.abs(offset).max()) > _FURTHEST_ORIGIN * radius and not is_one_place:
            raise ValueError(
                f"origin: expected a point within {_FURTHEST_ORIGIN:g} SBV radii (each {radius:g}) of the SBV centre "
                f'{centre.tolist()}, which is origin="centroid"; got {reference.tolist()}'
            )
        self.faces = torch.from_numpy(table.astype(np.int32))
        prepared = ops.prepare_mesh(torch.from_numpy(np.ascontiguousarray(local)), self.faces, LEAF_SIZE)
        self.origin = torch.from_numpy(reference)
        self.centre = torch.from_numpy(centre)
        self.radius = radius if is_one_place else radius * (1.0 + 2.0**-50)
        self.centre_offset = torch.from_numpy(offset)
        self.reach = self.radius
        if offset.any():
            self.reach = (self.radius + float(np.linalg.norm(offset))) * (1.0 + 2.0**-50)
        self.vertices = torch.from_numpy(body)
        self.edges, self._triangles, self._node_blocks, *others = prepared
        self._node_links, self._leaf_points, self._node_supports = others
        if len(self.edges) > _MOST_EDGES:
            raise ValueError(f"faces: the mesh has {len(self.edges)} edges; expected at most {_MOST_EDGES}")
        # Corner coordinates of triangles and segments as nine columns, relative to the SBV centre like the hierarchy;
        # padded, so that eight neighbours can be loaded at the last one.
        cornered = self._triangles[: len(table) - self.point_count, :3]
        self._corners = torch.zeros((9, len(cornered) + LEAF_SIZE))
        rounded = torch.from_numpy(local).float()
        for corner in range(3):
            self._corners[3 * corner : 3 * corner + 3, : len(cornered)] = rounded[cornered[:, corner]].T
        # (4, 3) float64, relative to the SBV centre; None for a mesh that fills much of its SBV.
        self._box = None if is_one_place else elongated_box(local, table, radius)

    @classmethod
    def box(
        cls, extents: Sequence[float] | np.ndarray | Tensor, origin: Origin = (0.0, 0.0, 0.0), *, solid: Solid = False
    ) -> Mesh:
        """A box of 12 triangles, centred on the origin, with sides along the axes.

        Args:
            extents: (3,) side lengths > 0 along x, y and z.
            origin, solid: as for the constructor.

        Raises:
            TypeError, ValueError: `extents` are not three lengths > 0.

        Example:
            >>> pgccd.Mesh.box([2.0, 1.0, 1.0]).faces.shape
            torch.Size([12, 3])
        """
        return cls(*shapes.box(extents), origin, solid=solid)

    @classmethod
    def points(cls, x: npt.ArrayLike | Tensor, radius: float = 0.0, origin: Origin = (0.0, 0.0, 0.0)) -> Mesh:
        """A cloud of points, or of spheres of equal radius.

        Args:
            x: (V, 3) array or tensor of finite numbers, in scene length units.
            radius: length >= 0, in scene length units: the mesh's thickness.
            origin: as for the constructor.

        Raises:
            TypeError, ValueError: as for the constructor.

        Example:
            >>> pgccd.Mesh.points([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0]], 0.1).point_count
            2
        """
        vertices = as_array(x, np.float64, "x", 3)
        if len(vertices) == 0:
            raise ValueError("x: expected at least one point")
        alone, thickness = np.arange(len(vertices)), arguments.length(radius, "radius")
        try:
            return cls(vertices, None, origin, points=alone, thickness=thickness)
        except ValueError as error:
            raise _renamed(error, vertices="x") from error

    @classmethod
    def segments(
        cls,
        x: npt.ArrayLike | Tensor,
        edges: npt.ArrayLike | Tensor,
        radius: float = 0.0,
        origin: Origin = (0.0, 0.0, 0.0),
    ) -> Mesh:
        """Segments, or capsules of equal radius: rods, wires, the skeleton of a robot.

        Args:
            x: (V, 3) array or tensor of finite numbers, in scene length units.
            edges: (S, 2) integers, two different rows of `x` per segment.
            radius: length >= 0, in scene length units: the mesh's thickness.
            origin: as for the constructor.

        Raises:
            TypeError, ValueError: as for the constructor.

        Example:
            >>> pgccd.Mesh.segments([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [1.0, 1.0, 0.0]], [[0, 1], [1, 2]]).edges.shape
            torch.Size([2, 2])
        """
        vertices, thickness = as_array(x, np.float64, "x", 3), arguments.length(radius, "radius")
        pairs = as_array(edges, np.int64, "edges", 2)
        if len(pairs) == 0:
            raise ValueError("edges: expected at least one segment")
        try:
            return cls(vertices, None, origin, segments=pairs, thickness=thickness)
        except ValueError as error:
            raise _renamed(error, vertices="x", segments="edges") from error

    @classmethod
    def sphere(cls, radius: float, origin: Origin = (0.0, 0.0, 0.0)) -> Mesh:
        """An exact sphere around the origin: a point with a thickness. `icosphere` makes a polyhedron.

        Args:
            radius: of the sphere, > 0, in scene length units.
            origin: as for the constructor.

        Raises:
            TypeError, ValueError: an argument is not such a number.

        Example:
            >>> pgccd.Mesh.sphere(0.5).thickness
            0.5
        """
        return cls.points(np.zeros((1, 3)), shapes.size(radius, "radius"), origin)

    @classmethod
    def capsule(cls, radius: float, length: float, origin: Origin = (0.0, 0.0, 0.0)) -> Mesh:
        """An exact capsule along the z axis, centred on the origin: a segment with a thickness.

        Args:
            radius: of its ends, > 0, in scene length units.
            length: of the segment between the centres of its ends, > 0, in scene length units.
            origin: as for the constructor.

        Raises:
            TypeError, ValueError: an argument is not such a number.

        Example:
            >>> pgccd.Mesh.capsule(0.1, 1.0).segment_count
            1
        """
        half = 0.5 * shapes.size(length, "length")
        return cls.segments([[0.0, 0.0, -half], [0.0, 0.0, half]], [[0, 1]], shapes.size(radius, "radius"), origin)

    @classmethod
    def icosphere(
        cls, radius: float, subdivisions: int = 3, origin: Origin = (0.0, 0.0, 0.0), *, solid: Solid = False
    ) -> Mesh:
        """A polyhedron of 20 x 4^subdivisions faces with its vertices on a sphere around the origin: each face of an
        icosahedron is divided into four, `subdivisions` times. It lies within the sphere: with 3 subdivisions, face
        centres are 0.5 % of the radius below the sphere.

        Args:
            radius: of the sphere, > 0, in scene length units.
            subdivisions: from 0 to 8.
            origin, solid: as for the constructor.

        Raises:
            TypeError, ValueError: an argument is not such a number.

        Example:
            >>> pgccd.Mesh.icosphere(0.5).faces.shape
            torch.Size([1280, 3])
        """
        return cls(*shapes.icosphere(radius, subdivisions), origin, solid=solid)

    @classmethod
    def cylinder(
        cls,
        radius: float,
        height: float,
        sections: int = 32,
        origin: Origin = (0.0, 0.0, 0.0),
        *,
        solid: Solid = False,
    ) -> Mesh:
        """A prism over a regular polygon, with its vertices on a cylinder around the z axis, centred on the origin:
        4 x sections faces.

        Args:
            radius: of the cylinder, > 0, in scene length units.
            height: along z, > 0, in scene length units.
            sections: corners of the polygon, from 3 to 1,000,000.
            origin, solid: as for the constructor.

        Raises:
            TypeError, ValueError: an argument is not such a number.

        Example:
            >>> pgccd.Mesh.cylinder(0.1, 1.0).faces.shape
            torch.Size([128, 3])
        """
        return cls(*shapes.cylinder(radius, height, sections), origin, solid=solid)

    @classmethod
    def from_trimesh(
        cls, mesh: Any, origin: Origin = (0.0, 0.0, 0.0), *, weld: bool = True, solid: Solid = False
    ) -> Mesh:
        """A mesh from a `trimesh.Trimesh`, a `trimesh.PointCloud` (points), a `trimesh.path.Path3D` (segments), or a
        `trimesh.Scene` either of meshes or of points and segments. The objects of a scene are transformed to its frame
        and joined.

        Args:
            mesh: the trimesh object.
            origin, solid: as for the constructor.
            weld: merge vertices at the same position. Files duplicate vertices along seams of textures or normals.
                Unless they are merged, a deforming mesh separates there and collides with itself. Contacts index the
                welded mesh; `source_vertex` and `source_face` map to the mesh given.

        Faces and segments that repeat a vertex, possibly after welding, are dropped, as are points that repeat a point.

        Raises:
            TypeError, ValueError: `mesh` is empty, or contains arcs, objects of another type, or points or lines beside
                meshes; or as for the constructor.

        Example:
            >>> robot = pgccd.Mesh.from_trimesh(trimesh.creation.icosphere(subdivisions=3))
        """
        checked_origin(origin)
        return cls._of_geometry(mesh_files.joined_geometry(mesh), origin, weld, solid)

    @classmethod
    def load(
        cls,
        path: str | PathLike[str],
        origin: Origin = (0.0, 0.0, 0.0),
        *,
        weld: bool = True,
        unit: Unit | None = None,
        solid: Solid = False,
    ) -> Mesh:
        """A mesh from any mesh file that trimesh loads (ply, stl, obj, off, glb, dae, ...), or from a binary mesh of
        MuJoCo (msh). All meshes in the file are joined. Polygons are divided into triangles within their outlines
        (polygons of Collada files must be convex). Coordinates and axes are those of the file: the up axis that Collada
        and glTF files state turns nothing, as in tools for URDF. **Lines and points beside triangles, which exporters
        add, are left out.** Files without triangles give segments and points: OBJ files their lines (l) and points (p),
        PLY files their edges, or all of their vertices if they have no edges, and other files their point clouds.

        Args:
            path: of the file.
            origin: as for the constructor, in units of the result.
            weld: as for `from_trimesh`.
            unit: of the result: "m", "cm", "mm", "in" or "ft". Lengths are converted if the file states its unit
                (Collada, 3MF, glTF); other files are taken to be in `unit`. Default: the numbers of the file, whose
                unit is `mesh.unit`.
            solid: as for the constructor.

        Raises:
            FileNotFoundError, IsADirectoryError: no such file.
            ValueError: the file is empty, cannot be read as a mesh, or holds less than it declares (a truncated STL,
                PLY or OFF file); or it contains no triangles, segments or points (such as an OBJ file of vertices
                alone), objects of another type, lines of glTF, or a point cloud beside objects of triangles.
            ImportError: trimesh, or a package that it needs for this kind of file, is not installed.

        Example:
            >>> rock = pgccd.Mesh.load("rock.ply")
            >>> rock.welded_vertices
            0
        """
        checked_origin(origin)
        mesh_files.check_unit(unit)
        loaded = mesh_files.load_geometry(path)
        try:
            factor, metres = mesh_files.conversion(path, loaded, unit)
            mesh = cls._of_geometry(mesh_files.joined_geometry(loaded).scaled(factor), origin, weld, solid, str(path))
            mesh.unit = metres
            return mesh
        except ValueError as error:
            raise ValueError(f"path: {path}: {error}") from error

    @classmethod
    def load_all(
        cls,
        path: str | PathLike[str],
        origin: Origin = (0.0, 0.0, 0.0),
        *,
        weld: bool = True,
        unit: Unit | None = None,
        solid: Solid = False,
    ) -> list[Mesh]:
        """One mesh per object of a file, with their names: each mesh of a scene file (glb, gltf, 3mf, ...) in the
        scene's frame, each object and group of an obj file (named object_group), or the only mesh of other files; in
        the order of the file.

        Args:
            path, origin, weld, unit, solid: as for `load`.

        Raises:
            FileNotFoundError, ValueError, ImportError: as for `load`; the object of the file is named.

        Example:
            >>> parts = pgccd.Mesh.load_all("rock.ply")
            >>> scene = pgccd.Scene(parts)
        """
        checked_origin(origin)
        mesh_files.check_unit(unit)
        loaded, part = mesh_files.load_geometry(path, apart=True), ""
        meshes = []
        try:
            factor, metres = mesh_files.conversion(path, loaded, unit)
            for geometry in mesh_files.placed_geometry(loaded):
                part = f": {geometry.name}" if geometry.name else ""
                meshes.append(cls._of_geometry(geometry.scaled(factor), origin, weld, solid, f"{path}{part}"))
                meshes[-1].unit = metres
        except ValueError as error:
            raise ValueError(f"path: {path}{part}: {error}") from error
        return meshes

    @classmethod
    def _of_geometry(
        cls, geometry: mesh_files.Geometry, origin: Origin, weld: bool, solid: Solid, source: str = ""
    ) -> Mesh:
        cleaned, source_vertex, source_face = mesh_files.clean(geometry, arguments.flag(weld, "weld"))
        if is_float32(geometry.vertices):  # before welding, which joins vertices that have become equal
            warn_of_rounding(geometry.vertices, geometry.faces, source, stacklevel=4)
        faces, segments, points = cleaned.elements()
        mesh = cls(cleaned.vertices, faces, origin, segments=segments, points=points, solid=solid)
        mesh.name = geometry.name
        mesh.welded_vertices = len(geometry.vertices) - len(cleaned.vertices)
        mesh.dropped_faces = len(geometry.faces) - len(cleaned.faces)
        mesh.source_vertex = torch.from_numpy(source_vertex)
        mesh.source_face = torch.from_numpy(source_face)
        return mesh

    def as_solid(self, solid: Solid = True) -> Mesh:
        """This mesh as a solid, or as a surface only. All else is shared.

        Args:
            solid: as for the constructor.

        Raises:
            TypeError, ValueError: as for the constructor.

        Example:
            >>> rock.as_solid("auto").solid
            True
        """
        other = copy.copy(self)
        other.solid = is_solid(solid, self.vertices.numpy(), self.faces.numpy())
        return other

    def thickened(self, thickness: float) -> Mesh:
        """This mesh with another thickness. All else is shared.

        Args:
            thickness: as for the constructor.

        Raises:
            TypeError, ValueError: as for the constructor.

        Example:
            >>> rock.thickened(0.01).thickness
            0.01
        """
        other = copy.copy(self)
        other.thickness = _checked_thickness(thickness)
        return other

    def state_dict(self) -> dict[str, Any]:
        """The mesh as a dictionary of tensors, numbers and its name, for `torch.save` and `torch.load` with
        weights_only=True.

        Example:
            >>> torch.save(rock.state_dict(), "rock.pt")
        """
        return {name: getattr(self, name) for name in (*_STATE, *_OF_FILE, *_LATER)}

    @classmethod
    def from_state_dict(cls, state: dict[str, Any]) -> Mesh:
        """The mesh of a `state_dict`, bit by bit. The hierarchy is built again.

        Args:
            state: from `state_dict`.

        Raises:
            TypeError, ValueError: naming the entry that is missing or invalid.

        Example:
            >>> again = pgccd.Mesh.from_state_dict(rock.state_dict())
        """
        if isinstance(state, dict):
            state = _LATER | state
        arguments.entries(state, (*_STATE, *_OF_FILE, *_LATER))
        points = as_array(state["vertices"], np.float64, "vertices", 3)
        table = elements.checked(points, as_array(state["faces"], np.int64, "faces", 3))
        places = [checked_point(state[name], name) for name in ("origin", "centre", "centre_offset")]
        mesh = cls.__new__(cls)
        mesh.solid = is_solid(arguments.flag(state["solid"], "solid"), points, table)
        mesh.thickness = _checked_thickness(state["thickness"])
        mesh._prepare(points, table, *places)
        for name in ("welded_vertices", "dropped_faces"):
            setattr(mesh, name, arguments.integer(state[name], name, 0, "a number >= 0"))
        for name, allowed in (("name", str), ("unit", float), ("source_vertex", Tensor), ("source_face", Tensor)):
            if not isinstance(state[name], (allowed, type(None))):
                raise TypeError(f"{name}: expected {allowed.__name__} or None, got {arguments.describe(state[name])}")
            setattr(mesh, name, state[name])
        return mesh

    solid: bool = False
    thickness: float = 0.0
    name: str | None = None
    unit: float | None = None
    welded_vertices: int = 0
    dropped_faces: int = 0
    source_vertex: Tensor | None = None
    source_face: Tensor | None = None

    def __repr__(self) -> str:
        name = "" if self.name is None else f"{self.name!r}, "
        numbers = {
            "vertices": len(self.vertices),
            "faces": self.triangle_count,
            "segments": self.segment_count,
            "points": self.point_count,
            "edges": len(self.edges),
        }
        counts = ", ".join(f"{what}={count}" for what, count in numbers.items() if count or what == "vertices")
        gone = {"welded_vertices": self.welded_vertices, "dropped_faces": self.dropped_faces}
        changed = "".join(f", {what}={count}" for what, count in gone.items() if count)
        solid = ", solid" if self.solid else ""
        solid += f", thickness={self.thickness:g}" if self.thickness else ""
        return f"Mesh({name}{counts}, radius={self.radius:g}{solid}{changed})"


def _renamed(error: ValueError, **names: str) -> ValueError:
    """An error about an argument of the constructor, with the names of the arguments that it is made of."""
    name, _, rest = str(error).partition(": ")
    return ValueError(f"{names.get(name, name)}: {rest}")


def _checked_thickness(thickness: float) -> float:
    length = arguments.length(thickness, "thickness")
    if length > LARGEST_RADIUS:
        raise ValueError(f"thickness: expected a length of at most {LARGEST_RADIUS:g}, got {length:g}")
    return length
