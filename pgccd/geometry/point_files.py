"""Segments and points of OBJ and PLY files without faces. Other readers keep only the vertices."""

from __future__ import annotations

import bisect
import re
from pathlib import Path
from typing import NamedTuple

import numpy as np

from pgccd.geometry.file_checks import PlyColumns, ply_elements

_OBJ_FACE = re.compile(rb"(?m)^[ \t]*f[ \t]")
_OBJ_LINE = re.compile(rb"(?m)^[ \t]*(v|l|p|o|g)[ \t]+([^\r\n#]*)")
_PLY_FACES = re.compile(rb"(?m)^element[ \t]+face[ \t]+0*[1-9]")
# The two vertices of an edge of a PLY file.
_ENDS = ("vertex1", "vertex2")


class PointFile(NamedTuple):
    """What an object of a file holds."""

    name: str | None
    vertices: np.ndarray  #: (V, 3) float64: all of the file
    segments: np.ndarray  #: (S, 2) int64
    points: np.ndarray  #: (P,) int64


def read_points(path: Path, apart: bool) -> list[PointFile] | None:
    """The segments and points of an OBJ or PLY file, by object; None for other kinds, and for files with faces. All
    vertices of a PLY file without edges are points.

    Args:
        path: of the file.
        apart: whether to keep objects and groups of an OBJ file separate.

    Raises:
        ValueError: the file is damaged, or holds neither faces nor segments nor points.
    """
    kind = path.suffix.lower()
    if kind == ".ply":
        return _ply(path.read_bytes())
    return _obj(path.read_bytes(), apart) if kind == ".obj" else None


def _obj(data: bytes, apart: bool) -> list[PointFile] | None:
    text = data.replace(b"\\\r\n", b"   ").replace(b"\\\n", b"  ")  # what stands where stays the same
    if _OBJ_FACE.search(text):
        return None
    vertices: list[list[float]] = []
    begins: list[int] = []
    records: list[tuple[tuple[str, str], re.Match[bytes]]] = []
    object_, group = "", ""
    for match in _OBJ_LINE.finditer(text):
        kind = match[1]
        if kind == b"v":
            vertices.append([float(word) for word in match[2].split()[:3]])
            begins.append(match.start())
        elif kind in (b"l", b"p"):
            records.append(((object_, group) if apart else ("", ""), match))
        elif kind == b"o":
            object_ = _text(match[2])
        else:
            group = _text(match[2])
    if not records:
        raise ValueError(f"an OBJ file of {len(vertices)} vertices without faces (f), lines (l) and points (p)")
    segments: dict[tuple[str, str], list[tuple[int, int]]] = {}
    points: dict[tuple[str, str], list[int]] = {}
    for place, match in records:
        rows = _obj_rows(match, data, begins)
        segments.setdefault(place, []).extend(zip(rows, rows[1:], strict=False) if match[1] == b"l" else ())
        points.setdefault(place, []).extend(rows if match[1] == b"p" else ())
    corners = np.array(vertices, dtype=np.float64).reshape(-1, 3)
    return [
        PointFile(
            "_".join(word for word in place if word) or None,
            corners,
            np.array(segments[place], dtype=np.int64).reshape(-1, 2),
            np.array(points[place], dtype=np.int64),
        )
        for place in segments
    ]


def _text(words: bytes) -> str:
    return b" ".join(words.split()).decode("utf-8", "replace")


def _obj_rows(match: re.Match[bytes], data: bytes, begins: list[int]) -> list[int]:
    """The vertices of a line or of points, from 0; `begins` are the places of vertices in the file."""
    what, least = ("line", 2) if match[1] == b"l" else ("points", 1)
    said = match[2].decode("ascii", "replace").strip()
    named = f"line {data.count(bytes([10]), 0, match.start()) + 1}: {what} {said!r}"
    try:
        numbers = [int(word.split(b"/", 1)[0]) for word in match[2].split()]
    except ValueError as error:
        raise ValueError(f"{named}: expected vertex indices") from error
    if len(numbers) < least:
        raise ValueError(f"{named}: expected {'two vertices' if least == 2 else 'a vertex'} or more")
    if 0 in numbers:
        raise ValueError(f"{named}: vertices of an OBJ file are numbered from 1, or backwards from -1")
    before = bisect.bisect(begins, match.start())
    if max(numbers) > len(begins) or -min(numbers) > before:
        raise ValueError(f"{named}: there are {len(begins)} vertices, {before} of them before it")
    return [number - 1 if number > 0 else before + number for number in numbers]


def _ply(data: bytes) -> list[PointFile] | None:
    if _PLY_FACES.search(data.partition(b"end_header")[0]):
        return None
    vertices, segments, other = None, np.zeros((0, 2), dtype=np.int64), ""
    for name, columns, _ in ply_elements(data):
        rows = max((len(column) for column in columns.values()), default=0)
        if name == "vertex":
            if not set("xyz") <= set(columns):
                raise ValueError("a PLY file whose vertices have no x, y and z")
            vertices = np.stack([np.asarray(columns[axis], dtype=np.float64) for axis in "xyz"], axis=1)
        elif name == "edge" and rows:
            segments = _ply_edges(columns, 0 if vertices is None else len(vertices))
        elif rows and any(isinstance(column, list) or column.ndim > 1 for column in columns.values()):
            other = name
    if vertices is None:
        return None
    if other:
        raise ValueError(f"a PLY file without faces, but with lists of element {other}, which cannot be read")
    points = np.arange(0 if len(segments) else len(vertices))
    return [PointFile(None, vertices, segments, points)]


def _ply_edges(columns: PlyColumns, count: int) -> np.ndarray:
    """(S, 2) int64: the edges of a PLY file with so many vertices."""
    found = [np.asarray(columns[name]) for name in _ENDS if name in columns]
    if len(found) < 2 or any(column.ndim != 1 for column in found):
        raise ValueError(f"a PLY file whose edges have no {' and '.join(_ENDS)}")
    rows = np.stack(found, axis=1)
    with np.errstate(invalid="ignore"):  # infinite numbers
        is_wrong = ~((rows >= 0) & (rows < count) & (rows % 1 == 0)).all(axis=1)
    if is_wrong.any():
        first = int(np.argmax(is_wrong))
        raise ValueError(f"edge {first}: {rows[first].tolist()}: expected two of the {count} vertices")
    return rows.astype(np.int64)
