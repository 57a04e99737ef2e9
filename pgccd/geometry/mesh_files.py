"""Triangles, segments and points from files and from trimesh: extraction, placement and welding."""

from __future__ import annotations

import io
import re
from collections.abc import Iterator
from dataclasses import dataclass, replace
from os import PathLike, fspath
from pathlib import Path
from typing import Any

import numpy as np

from pgccd import arguments
from pgccd.geometry.file_checks import declared_triangles
from pgccd.geometry.mesh_formats import collada_without_looks, gltf_of_triangles, mujoco_mesh, plain_obj
from pgccd.geometry.point_files import read_points
from pgccd.geometry.polygons import PolygonFile, read_polygons, require_convex_polygons

#: Units of lengths that files state, in metres.
_METRES = {
    **{"meters": 1.0, "meter": 1.0, "micron": 1e-6, "millimeter": 1e-3, "millimeters": 1e-3, "centimeter": 1e-2},
    **{"inch": 0.0254, "foot": 0.3048},
}
#: Units that lengths are converted to.
UNITS = {"m": 1.0, "cm": 1e-2, "mm": 1e-3, "in": 0.0254, "ft": 0.3048}


@dataclass(frozen=True)
class Geometry:
    """Elements as a file gives them: triangles, or segments (a, b, b) and points (a, a, a)."""

    vertices: np.ndarray  #: (V, 3) float64
    faces: np.ndarray  #: (F, 3) int64
    name: str | None = None
    kinds: np.ndarray | None = None  #: (F,) 1 for segments, 2 for points; None: triangles

    @classmethod
    def of_elements(cls, vertices: np.ndarray, segments: np.ndarray, points: np.ndarray, name: str | None) -> Geometry:
        """Of segments (S, 2) and points (P,)."""
        table = np.concatenate([segments[:, [0, 1, 1]], points[:, None].repeat(3, axis=1)])
        return cls(vertices, table, name, np.repeat([1, 2], [len(segments), len(points)]))

    def elements(self) -> tuple[np.ndarray | None, np.ndarray | None, np.ndarray | None]:
        """Triangles (T, 3), segments (S, 2) and points (P,)."""
        if self.kinds is None:
            return self.faces, None, None
        return None, self.faces[self.kinds == 1, :2], self.faces[self.kinds == 2, 0]

    def scaled(self, factor: float) -> Geometry:
        """With lengths multiplied."""
        return self if factor == 1.0 else replace(self, vertices=factor * self.vertices)


class _Objects(tuple[Geometry, ...]):
    """The objects of a file that trimesh does not read."""


def check_unit(unit: str | None) -> None:
    """Raises TypeError or ValueError, naming `unit`, unless it is one of `UNITS` or None."""
    if unit is not None:
        arguments.choice(unit, "unit", UNITS)


def conversion(path: str | PathLike[str], loaded: Any, unit: str | None) -> tuple[float, float | None]:
    """The factor for lengths of a loaded file, and the unit of the result in metres, if it is known.

    Raises:
        ValueError: the file states an unknown unit.
    """
    stated = unit_of(Path(path), loaded)
    if unit is None:
        return 1.0, stated
    wanted = UNITS[unit]
    return (1.0 if stated is None else stated / wanted), wanted


def load_geometry(path: str | PathLike[str], apart: bool = False) -> Any:
    """Loads a file with trimesh.

    Args:
        path: of the file.
        apart: whether to keep objects and groups of an obj file separate.

    Raises:
        FileNotFoundError, ValueError, ImportError: as `pgccd.Mesh.load`.
    """
    arguments.path(path, "path")
    try:
        import trimesh
    except ImportError as error:
        raise ImportError("Mesh.load reads files through trimesh: pip install trimesh") from error
    if Path(path).is_dir():
        raise IsADirectoryError(f"path: {path} is a folder: expected a mesh file")
    if not Path(path).is_file():
        raise FileNotFoundError(f"path: no mesh file at {path}")
    if Path(path).stat().st_size == 0:
        raise ValueError(f"path: {path} is empty (0 bytes)")
    options: dict[str, Any] = {}
    if apart and Path(path).suffix.lower() == ".obj":
        options = {"split_objects": True, "split_groups": True}
    try:
        declared = declared_triangles(Path(path))
        loaded = _loaded(trimesh, Path(path), options)
        parts = list(_parts(loaded))
        # Some files are decoded only on access.
        if not any(len(getattr(each, "vertices", ())) for _, each, _ in parts):
            raise ValueError("it holds no triangles, segments or points")
        if Path(path).suffix.lower() in (".glb", ".gltf") and any(hasattr(each, "entities") for _, each, _ in parts):
            raise ValueError("lines of a glTF file, which cannot be read")  # trimesh joins those that are apart
        read = sum(len(getattr(each, "faces", ())) for _, each, _ in parts)
        if declared is not None and read < declared:
            raise ValueError(f"trimesh reads {read} of its {declared} triangles")
    except Exception as error:
        if package := _missing_package(error):
            raise ImportError(f"path: {path} cannot be read without {package}: pip install {package}") from error
        raise ValueError(f"path: {path} cannot be read as a mesh: {error}") from error
    return loaded


def _loaded(trimesh: Any, path: Path, options: dict[str, Any]) -> Any:
    kind = path.suffix.lower()
    if kind == ".msh":
        return trimesh.Trimesh(*mujoco_mesh(path.read_bytes()), process=False)
    if kind == ".dae":
        data = path.read_bytes()
        require_convex_polygons(data)
        return trimesh.load(io.BytesIO(collada_without_looks(data)), file_type="dae", process=False)
    if kind in (".glb", ".gltf") and (triangles := gltf_of_triangles(path)) is not None:
        return trimesh.load(io.BytesIO(triangles), file_type="glb", process=False)
    if (parts := read_points(path, bool(options))) is not None:
        return _Objects(Geometry.of_elements(part.vertices, part.segments, part.points, part.name) for part in parts)
    if (polygons := read_polygons(path)) is not None:
        return _of_polygons(trimesh, polygons, bool(options))
    if kind == ".obj" and (plain := plain_obj(path.read_bytes())) is not None:
        return trimesh.load(io.BytesIO(plain), file_type="obj", process=False, **options)
    return trimesh.load(fspath(path), process=False, **options)


def _of_polygons(trimesh: Any, file: PolygonFile, apart: bool) -> Any:
    """As trimesh loads a file; with `apart` a scene of its objects."""
    faces = [file.triangles(part) for part in file.parts]
    if not apart or len(faces) == 1:
        return trimesh.Trimesh(file.vertices, np.concatenate(faces), process=False)
    scene = trimesh.Scene()
    for number, (part, own) in enumerate(zip(file.parts, faces, strict=True)):
        if len(own):  # a scene numbers objects of one name
            mesh = trimesh.Trimesh(file.vertices, own, process=False)
            scene.add_geometry(mesh, geom_name=part.name or str(number))
    return scene


def unit_of(path: Path, loaded: Any) -> float | None:
    """The unit of lengths of a loaded file, in metres; None if the file states none."""
    kind = path.suffix.lower()
    if kind in (".glb", ".gltf"):
        return 1.0
    stated = [getattr(each, "metadata", {}).get("units") for _, each, _ in _parts(loaded)]
    stated.append(getattr(loaded, "metadata", {}).get("units"))
    name = next((each for each in stated if each), None)
    if kind not in (".dae", ".3mf") or name is None:
        return None
    number, _, word = str(name).rpartition(" * ")
    metres = _METRES.get(word)
    if metres is None:
        raise ValueError(f"expected lengths in one of {', '.join(_METRES)}; got {name!r}")
    length = float(number or 1.0) * metres
    if not 0.0 < length < np.inf:
        raise ValueError(f"unit: expected a length > 0 in metres, got {length}")
    return length


def _missing_package(error: Exception) -> str | None:
    """The optional package that trimesh asks for, if the error says that one is missing."""
    found = re.search(r"No module named '(\w+)|pip install ([\w-]+)", str(error))
    name = None if found is None else found[1] or found[2]
    return None if name is None else name.replace("_", "-")


def placed_geometry(loaded: Any) -> list[Geometry]:
    """The meshes of a loaded file, each in the frame of its scene: all of triangles, or all of segments and points.

    Raises:
        ValueError: it contains something else, both of these, or nothing.
    """
    found = []
    for name, part, transform in _parts(loaded):
        geometry = _geometry_of(part, name)
        vertices, faces = geometry.vertices, geometry.faces
        if transform is not None:
            vertices = vertices @ transform[:3, :3].T + transform[:3, 3]
            if geometry.kinds is None and np.linalg.det(transform[:3, :3]) < 0.0:
                faces = faces[:, ::-1]  # a mirror image: what was outside stays there
        found.append(replace(geometry, vertices=vertices, faces=faces))
    if not any(len(geometry.faces) for geometry in found):
        raise ValueError(f"mesh: {type(loaded).__name__} holds no triangles, segments or points")
    others = [geometry for geometry in found if geometry.kinds is not None and len(geometry.faces)]
    if others and any(geometry.kinds is None and len(geometry.faces) for geometry in found):
        what = "lines" if others[0].kinds is not None and (others[0].kinds == 1).any() else "a point cloud"
        raise ValueError(f"mesh: expected triangles alone, got {what}{_named(others[0].name)} beside them")
    return [geometry for geometry in found if geometry.kinds is not None] if others else found


def _geometry_of(part: Any, name: str | None) -> Geometry:
    """A mesh, point cloud or lines of trimesh, or what this package has read itself."""
    if isinstance(part, Geometry):
        return part
    faces, kind = getattr(part, "faces", None), type(part).__name__
    if faces is None and kind not in ("PointCloud", "Path3D"):
        what = "lines in a plane" if kind == "Path2D" else kind
        raise ValueError(f"mesh: expected triangles, segments or points, got {what}{_named(name)}, which is not a mesh")
    vertices = np.asarray(part.vertices, dtype=np.float64).reshape(-1, 3)
    if faces is not None:
        return Geometry(vertices, np.asarray(faces, dtype=np.int64).reshape(-1, 3), name)
    if kind == "PointCloud":
        return Geometry.of_elements(vertices, _NO_SEGMENTS, np.arange(len(vertices)), name)
    pieces = [_NO_SEGMENTS]
    for entity in part.entities:
        if type(entity).__name__ != "Line":
            raise ValueError(f"mesh: expected lines, got {type(entity).__name__}{_named(name)}")
        rows = np.asarray(entity.points, dtype=np.int64)
        pieces.append(np.stack([rows[:-1], rows[1:]], axis=1))
    return Geometry.of_elements(vertices, np.concatenate(pieces), _NO_SEGMENTS[:, 0], name)


_NO_SEGMENTS = np.zeros((0, 2), dtype=np.int64)


def _named(name: str | None) -> str:
    return f" named {name!r}" if name else ""


def joined_geometry(loaded: Any) -> Geometry:
    """The meshes of a loaded file as one, their vertices and faces concatenated."""
    parts = placed_geometry(loaded)
    if len(parts) == 1:
        return parts[0]
    first = np.cumsum([0, *(len(part.vertices) for part in parts[:-1])])
    faces = [part.faces + begin for part, begin in zip(parts, first, strict=True)]
    kinds = [part.kinds for part in parts if part.kinds is not None]
    joined = Geometry(np.concatenate([part.vertices for part in parts]), np.concatenate(faces))
    return replace(joined, kinds=np.concatenate(kinds)) if kinds else joined


def clean(geometry: Geometry, weld: bool) -> tuple[Geometry, np.ndarray, np.ndarray]:
    """Drops faces and segments that repeat a vertex, and points that are listed already; with `weld`, first merges
    vertices at the same position. Segments come before points. Returns also the source row of each vertex (V,) and face
    (F,), int64.

    Raises:
        ValueError: a vertex is not finite, a vertex index is out of range, or no face is left.
    """
    vertices, faces = geometry.vertices, geometry.faces
    # Before welding, so that errors refer to rows of the file.
    arguments.check_corners(vertices, faces)
    source = np.arange(len(vertices))
    if weld:
        source, twin = _unique_rows(vertices)
        vertices, faces = vertices[source], twin[faces]
    if geometry.kinds is None:
        repeats = (faces == np.roll(faces, 1, axis=1)).any(axis=1)
        what = "triangles with three different corners"
    else:
        repeats, what = _repeated(faces, geometry.kinds), "segments with two different ends"
    if repeats.all():
        raise ValueError(f"mesh: there are no {what}")
    kept = np.flatnonzero(~repeats)
    if geometry.kinds is None:
        return Geometry(vertices, faces[kept], geometry.name), source, kept
    kept = kept[np.argsort(geometry.kinds[kept], kind="stable")]
    return Geometry(vertices, faces[kept], geometry.name, geometry.kinds[kept]), source, kept


def _repeated(table: np.ndarray, kinds: np.ndarray) -> np.ndarray:
    """(F,) bool: the segments with equal ends, and all but the first of the points of a vertex."""
    repeats = (kinds == 1) & (table[:, 0] == table[:, 1])
    alone = np.flatnonzero(kinds == 2)
    repeats[alone] = True
    repeats[alone[np.unique(table[alone, 0], return_index=True)[1]]] = False
    return repeats


def _unique_rows(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The first of each set of equal rows (n, 3), in order, and for each row the index of its representative."""
    order = np.lexsort(points.T)  # stable: the first of equal rows comes first
    ordered = points[order]
    begins = np.ones(len(points), dtype=bool)
    begins[1:] = (ordered[1:] != ordered[:-1]).any(axis=1)
    first = np.empty(len(points), dtype=np.int64)
    first[order] = order[begins][np.cumsum(begins) - 1]
    kept = np.flatnonzero(first == np.arange(len(points)))
    return kept, np.searchsorted(kept, first)


def _parts(loaded: Any) -> Iterator[tuple[str | None, Any, np.ndarray | None]]:
    """Name, geometry and transform of each part of a loaded file."""
    if isinstance(loaded, _Objects):
        yield from ((part.name, part, None) for part in loaded)
        return
    graph = getattr(loaded, "graph", None)
    if graph is None:
        name = getattr(loaded, "metadata", {}).get("name")
        yield name if isinstance(name, str) else None, loaded, None
        return
    order = {name: number for number, name in enumerate(loaded.geometry)}  # that of the file; the graph's is reversed
    placed = sorted(((node, *graph[node]) for node in graph.nodes_geometry), key=lambda each: order[each[2]])
    for node, transform, name in placed:
        yield node, loaded.geometry[name], np.asarray(transform)
