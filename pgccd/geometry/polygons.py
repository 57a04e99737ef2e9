"""Polygons of mesh files as triangles within their outlines. Readers join the corners of each polygon with its first
corner, which fills the notches of polygons that are not convex.
"""

from __future__ import annotations

import io
import re
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from pgccd.geometry.file_checks import ply_elements
from pgccd.geometry.mesh_formats import collada_without_looks

# Of areas of polygons and their triangles, relative.
_ROUNDING = 1e-9
_OBJ_LINE = re.compile(rb"(?m)^[ \t]*(v|f|o|g)[ \t]+([^\r\n#]*)")
# Lines of an OBJ file with four corners or more, or an index that counts backwards.
_OBJ_OTHER = re.compile(rb"(?m)^[ \t]*f(?:(?:[ \t]+[^\s#]+){4}|[^\r\n#]*[ \t]-\d)")


@dataclass
class Part:
    """An object of a file: polygons, each as rows of the file's vertices."""

    name: str | None
    polygons: list[list[int]] = field(default_factory=list)


@dataclass
class PolygonFile:
    """Vertices (V, 3) float64, and polygons by object."""

    vertices: np.ndarray
    parts: list[Part]

    def triangles(self, part: Part) -> np.ndarray:
        """(F, 3) int64: the triangles of an object's polygons.

        Raises:
            ValueError: naming the polygon whose outline crosses itself.
            ImportError: mapbox_earcut, which triangulates polygons that are not convex, is not installed.
        """
        found: list[list[int]] = []
        for number, polygon in enumerate(part.polygons):
            corners = self.vertices[polygon]
            if is_convex(corners):
                found += [[polygon[0], b, c] for b, c in zip(polygon[1:-1], polygon[2:], strict=True)]
                continue
            try:
                found += [[polygon[k] for k in triangle] for triangle in within_outline(corners)]
            except ValueError as error:
                named = f" of {part.name}" if part.name else ""
                raise ValueError(f"face {number}{named}: {error}") from error
        return np.array(found, dtype=np.int64).reshape(-1, 3)


def read_polygons(path: Path) -> PolygonFile | None:
    """The polygons of an OBJ, PLY or OFF file; None for other kinds, or where other readers give the same triangles.

    Raises:
        ValueError: the file is damaged.
    """
    read = _READERS.get(path.suffix.lower())
    if read is None:
        return None
    data = path.read_bytes()
    found, is_needed = read(data)
    if found is None:
        return None
    for part in found.parts:
        for number, polygon in enumerate(part.polygons):
            if polygon and not 0 <= min(polygon) <= max(polygon) < len(found.vertices):
                raise ValueError(f"face {number}: {polygon}: there are {len(found.vertices)} vertices")
    every = (polygon for part in found.parts for polygon in part.polygons)
    if is_needed or not all(is_convex(found.vertices[polygon]) for polygon in every if len(polygon) > 3):
        return found
    return None


def require_convex_polygons(collada: bytes) -> None:
    """Raises ValueError if a polygon of a Collada file is not convex: its readers fill the notches."""
    if not any(word in collada for word in (b"<polylist", b"<polygons", b":polylist", b":polygons")):
        return
    try:
        import collada as pycollada
    except ImportError as error:
        raise ImportError("No module named 'pycollada'") from error
    for geometry in pycollada.Collada(io.BytesIO(collada_without_looks(collada))).geometries:
        for primitives in geometry.primitives:
            if not isinstance(primitives, pycollada.polylist.Polylist) or primitives.vertex is None:
                continue
            for number, (begin, end) in enumerate(zip(primitives.polystarts, primitives.polyends, strict=True)):
                corners = np.asarray(primitives.vertex, dtype=np.float64)[primitives.vertex_index[begin:end]]
                # pycollada rounds coordinates to float32.
                if not is_convex(corners, 2.0**-24 * np.abs(corners).max()):
                    raise ValueError(
                        f"geometry {geometry.id!r}: polygon {number} is not convex: divide it in triangles"
                    )


def is_convex(corners: np.ndarray, error: float = 0.0) -> bool:
    """Whether a polygon (n, 3) turns to one side everywhere and once in all, seen along its normal; then the triangles
    from its first corner fill it.

    Args:
        corners: of the polygon.
        error: of their coordinates: a corner between two edges in one line may be this far beside the line.
    """
    if len(corners) <= 3:
        return True
    flat, area = _projected(corners)
    edges = np.roll(flat, -1, axis=0) - flat
    edges = edges[(edges != 0.0).any(axis=1)]
    if len(edges) < 3:
        return True  # without an area: in any way
    if not area > _ROUNDING * np.abs(corners - corners[0]).max() ** 2:
        # On a line, or the halves of an outline that crosses itself, which cancel.
        return bool(np.linalg.matrix_rank(corners - corners[0], tol=1e-12 * np.abs(corners - corners[0]).max()) < 2)
    after = np.roll(edges, -1, axis=0)
    crosses = edges[:, 0] * after[:, 1] - edges[:, 1] * after[:, 0]
    lengths = np.linalg.norm(edges, axis=1) + np.linalg.norm(after, axis=1)
    if (crosses < -_ROUNDING * np.abs(crosses).max() - 4.0 * error * lengths).any():
        return False
    turn = np.arctan2(crosses, (edges * after).sum(axis=1)).sum()
    return bool(turn < 3.0 * np.pi)


def within_outline(corners: np.ndarray) -> list[list[int]]:
    """Triangles (corners by number) of a polygon (n, 3), with its orientation.

    Raises:
        ValueError: its outline crosses itself.
        ImportError: mapbox_earcut is not installed.
    """
    try:
        import mapbox_earcut
    except ImportError as error:
        raise ImportError("No module named 'mapbox_earcut': pip install mapbox_earcut") from error
    flat, area = _projected(corners)
    rows = mapbox_earcut.triangulate_float64(flat, np.array([len(flat)], dtype=np.uint32)).astype(np.int64)
    triangles = rows.reshape(-1, 3)
    a, b, c = (flat[triangles[:, k]] for k in range(3))
    signed = 0.5 * ((b - a)[:, 0] * (c - a)[:, 1] - (b - a)[:, 1] * (c - a)[:, 0])
    if abs(np.abs(signed).sum() - area) > _ROUNDING * area:
        raise ValueError("expected a polygon whose outline does not cross itself")
    turned = np.where((signed < 0.0)[:, None], triangles[:, ::-1], triangles)
    return turned.tolist()


def _projected(corners: np.ndarray) -> tuple[np.ndarray, float]:
    """The corners (n, 2) seen along the polygon's normal, counterclockwise, and its area."""
    relative = corners - corners[0]
    normal = np.cross(relative, np.roll(relative, -1, axis=0)).sum(axis=0)
    length = float(np.linalg.norm(normal))
    if not length > 0.0:
        return relative[:, :2], 0.0
    normal = normal / length
    first = np.cross(normal, np.eye(3)[np.abs(normal).argmin()])
    first /= np.linalg.norm(first)
    return np.stack([relative @ first, relative @ np.cross(normal, first)], axis=1), 0.5 * length


def _obj(data: bytes) -> tuple[PolygonFile | None, bool]:
    """And whether an index counts backwards from the middle of the vertices, which trimesh cannot read."""
    text = data.replace(b"\\\r\n", b" ").replace(b"\\\n", b" ")
    if not _OBJ_OTHER.search(text):
        return None, False
    vertices: list[list[float]] = []
    parts: dict[tuple[str, str], Part] = {}
    object_, group, backwards = "", "", 0  # the fewest vertices before a face that counts backwards
    for match in _OBJ_LINE.finditer(text):
        kind, rest = match[1], match[2].split()
        if kind == b"v":
            vertices.append([float(word) for word in rest[:3]])
        elif kind == b"f":
            rows = [int(corner.split(b"/", 1)[0]) for corner in rest]
            if min(rows, default=0) < 0:
                backwards = backwards or len(vertices)
            name = "_".join(word for word in (object_, group) if word)
            part = parts.setdefault((object_, group), Part(name or None))
            part.polygons.append([row - 1 if row > 0 else len(vertices) + row for row in rows])
        elif kind == b"o":
            object_ = b" ".join(rest).decode("utf-8", "replace")
        else:
            group = b" ".join(rest).decode("utf-8", "replace")
    found = PolygonFile(np.array(vertices, dtype=np.float64).reshape(-1, 3), list(parts.values()))
    return found, 0 < backwards < len(vertices)


def _off(data: bytes) -> tuple[PolygonFile | None, bool]:
    words = re.split(rb"OFF", re.sub(rb"#[^\n]*", b"", data), maxsplit=1)[-1]
    lines = [line.split() for line in words.splitlines() if line.strip()]
    vertex_count, face_count = (int(word) for word in lines[0][:2])
    vertices = [[float(word) for word in line[:3]] for line in lines[1 : 1 + vertex_count]]
    faces = lines[1 + vertex_count : 1 + vertex_count + face_count]
    if all(line[0] == b"3" for line in faces):
        return None, False
    polygons = [[int(word) for word in line[1 : 1 + int(line[0])]] for line in faces]
    return PolygonFile(np.array(vertices).reshape(-1, 3), [Part(None, polygons)]), False


def _ply(data: bytes) -> tuple[PolygonFile | None, bool]:
    """And whether it is binary with faces of different numbers of corners, which trimesh cannot read."""
    vertices, polygons, is_text = None, None, False
    for name, columns, is_one in ply_elements(data):
        is_text = is_one
        if name == "vertex":
            vertices = np.stack([np.asarray(columns[axis], dtype=np.float64) for axis in "xyz"], axis=1)
        elif name == "face":
            polygons = columns.get("vertex_indices", columns.get("vertex_index"))
    if vertices is None or polygons is None or isinstance(polygons, np.ndarray):
        return None, False  # triangles only
    sizes = {len(polygon) for polygon in polygons}
    return PolygonFile(vertices, [Part(None, polygons)]), len(sizes) > 1 and not is_text


_READERS: dict[str, Callable[[bytes], tuple[PolygonFile | None, bool]]] = {".obj": _obj, ".off": _off, ".ply": _ply}
