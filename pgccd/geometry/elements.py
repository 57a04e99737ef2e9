"""The elements of a mesh in one table: triangles (a, b, c), then segments (a, b, b), then points (a, a, a)."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from torch import Tensor

from pgccd import arguments
from pgccd.geometry.coordinates import as_array

Rows = npt.ArrayLike | Tensor


def elements(points: np.ndarray, faces: Rows | None, segments: Rows | None, single: Rows | None) -> np.ndarray:
    """(F, 3) int64: the table of a mesh.

    Args:
        points: (V, 3) vertices.
        faces, segments, single: as `faces`, `segments` and `points` of `pgccd.Mesh`.

    Raises:
        TypeError, ValueError: naming the argument and its first invalid row; or all are empty.
    """
    triangles = _rows(faces, "faces", 3)
    arguments.check_corners(points, triangles)
    _refuse_repeats(triangles, "faces", "face")
    pairs, alone = _rows(segments, "segments", 2), _rows(single, "points", None)
    for rows, name, what in ((pairs, "segments", "segment"), (alone[:, None], "points", "point")):
        is_out = ((rows < 0) | (rows >= len(points))).any(axis=1)
        if is_out.any():
            first = int(np.argmax(is_out))
            raise ValueError(f"{name}: {what} {first} is {rows[first].tolist()}, but there are {len(points)} vertices")
    _refuse_repeats(pairs, "segments", "segment")
    _refuse_twice(alone)
    table = np.concatenate([triangles, pairs[:, [0, 1, 1]], alone[:, None].repeat(3, axis=1)])
    if len(table) == 0:
        raise ValueError("faces: the mesh holds no triangles, segments or points")
    return table


def checked(points: np.ndarray, table: np.ndarray) -> np.ndarray:
    """A table (F, 3) that may come from a file.

    Raises:
        ValueError: a row names no vertex, or the table is not in the order of `elements`.
    """
    arguments.check_corners(points, table)
    if len(table) == 0:
        raise ValueError("faces: the mesh holds no triangles, segments or points")
    first, second, third = table.T
    kind = kinds(table)
    is_wrong = (kind == 0) & ((first == second) | (first == third))
    is_wrong[1:] |= kind[1:] < kind[:-1]
    if is_wrong.any():
        row = int(np.argmax(is_wrong))
        raise ValueError(
            f"faces: expected triangles, then segments (a, b, b), then points (a, a, a), got {table[row].tolist()} in "
            f"row {row}"
        )
    _refuse_twice(first[kind == 2])
    return table


def kinds(table: np.ndarray) -> np.ndarray:
    """(F,): 0 for triangles, 1 for segments, 2 for points of a table (F, 3)."""
    repeats = table[:, 1] == table[:, 2]
    return repeats.astype(np.int64) + (repeats & (table[:, 0] == table[:, 1]))


def counts(table: np.ndarray) -> tuple[int, int, int]:
    """Numbers of triangles, segments and points of a table (F, 3)."""
    triangles, segments, points = np.bincount(kinds(table), minlength=3).tolist()
    return triangles, segments, points


def centre(points: np.ndarray, table: np.ndarray) -> np.ndarray:
    """(3,) the SBV centre: the mean of the corners of all triangles; of a mesh without triangles the middle of its box.

    Args:
        points: (V, 3).
        table: (F, 3).
    """
    triangles = table[: counts(table)[0]]
    if len(triangles):
        # Relative to the first corner, so that a mesh far from the origin keeps its digits.
        first = points[table[0, 0]]
        corners = points[triangles]
        corners -= first
        return first + corners.reshape(-1, 3).mean(axis=0)
    corners = used(points, table)
    return 0.5 * (corners.min(axis=0) + corners.max(axis=0))


def used(points: np.ndarray, table: np.ndarray) -> np.ndarray:
    """The points (V, 3) that an element (F, 3) uses."""
    is_used = np.zeros(len(points), dtype=bool)
    is_used[table] = True
    return points if is_used.all() else points[is_used]


def _rows(given: Rows | None, name: str, width: int | None) -> np.ndarray:
    return as_array(() if given is None else given, np.int64, name, width)


def _refuse_repeats(rows: np.ndarray, name: str, what: str) -> None:
    repeats = rows[:, 0] == rows[:, -1]
    for column in range(rows.shape[1] - 1):
        repeats |= rows[:, column] == rows[:, column + 1]
    if repeats.any():
        first = int(np.argmax(repeats))
        raise ValueError(f"{name}: {what} {first} repeats a vertex: {rows[first].tolist()}")


def _refuse_twice(alone: np.ndarray) -> None:
    times = np.bincount(alone) if len(alone) else alone
    if (times > 1).any():
        raise ValueError(f"points: vertex {int(np.argmax(times > 1))} is listed twice")
