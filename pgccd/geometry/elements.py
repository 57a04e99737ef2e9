"""The elements of a mesh in one table: triangles (a, b, c), then segments (a, b, b), then points (a, a, a)."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
from torch import Tensor

from pgccd import arguments

Rows = npt.ArrayLike | Tensor


def elements(points: np.ndarray, faces: Rows | None, segments: Rows | None, single: Rows | None) -> np.ndarray:
    """(F, 3) int64: the table of a mesh.

    Args:
        points: (V, 3) vertices.
        faces, segments, single: as `faces`, `segments` and `points` of `pgccd.Mesh`.

    Raises:
        TypeError, ValueError: naming the argument and its first offending row, or all are empty.
    """
    triangles = _rows(faces, "faces", 3)
    arguments.check_corners(points, triangles)
    _refuse_repeats(triangles, "faces", "face")
    pairs, alone = _rows(segments, "segments", 2), _rows(single, "points", 1)
    for rows, name, what in ((pairs, "segments", "segment"), (alone, "points", "point")):
        is_out = ((rows < 0) | (rows >= len(points))).any(axis=1)
        if is_out.any():
            first = int(np.argmax(is_out))
            raise ValueError(f"{name}: {what} {first} is {rows[first].tolist()}, but there are {len(points)} vertices")
    _refuse_repeats(pairs, "segments", "segment")
    _refuse_twice(alone[:, 0])
    table = np.concatenate([triangles, pairs[:, [0, 1, 1]], alone[:, [0, 0, 0]]])
    if len(table) == 0:
        raise ValueError("faces: the mesh holds no triangles, segments or points")
    return table


def checked(points: np.ndarray, table: np.ndarray) -> np.ndarray:
    """A table (F, 3) that may come from a file.

    Raises:
        ValueError: a row names no vertex, or it is not in the order of `elements`.
    """
    arguments.check_corners(points, table)
    if len(table) == 0:
        raise ValueError("faces: the mesh holds no triangles, segments or points")
    first, second, third = table.T
    is_point, is_segment = (first == second) & (second == third), (first != second) & (second == third)
    kind = np.where(is_point, 2, np.where(is_segment, 1, 0))
    is_wrong = (kind == 0) & ((first == second) | (first == third))
    is_wrong[1:] |= kind[1:] < kind[:-1]
    if is_wrong.any():
        row = int(np.argmax(is_wrong))
        raise ValueError(
            f"faces: expected triangles, then segments (a, b, b), then points (a, a, a), got {table[row].tolist()} in "
            f"row {row}"
        )
    _refuse_twice(first[is_point])
    return table


def counts(table: np.ndarray) -> tuple[int, int, int]:
    """Numbers of triangles, segments and points of a table (F, 3)."""
    repeats = table[:, 1] == table[:, 2]
    single = int((repeats & (table[:, 0] == table[:, 1])).sum())
    both = int(repeats.sum())
    return len(table) - both, both - single, single


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
        return first + (points[triangles] - first).reshape(-1, 3).mean(axis=0)
    used = points[np.unique(table)]
    return 0.5 * (used.min(axis=0) + used.max(axis=0))


def _rows(given: Any, name: str, width: int) -> np.ndarray:
    """(n, width) int64; points are given as (n,)."""
    if given is None:
        return np.empty((0, width), dtype=np.int64)
    values = arguments.as_tensor(given, name)
    raw = values.detach().cpu().numpy() if isinstance(values, Tensor) else _array(values, name)
    if raw.size and raw.dtype.kind not in "iu":
        raise TypeError(f"{name}: expected integers, got {raw.dtype}")
    if width == 1 and raw.ndim == 1:
        raw = raw[:, None]
    elif width == 1 or (raw.ndim != 2 or raw.shape[1] != width) and raw.size:
        raise ValueError(f"{name}: expected shape {'(n,)' if width == 1 else f'(n, {width})'}, got {raw.shape}")
    return np.ascontiguousarray(raw.reshape(-1, width), dtype=np.int64)


def _array(values: Any, name: str) -> np.ndarray:
    try:
        return np.asarray(values)
    except (TypeError, ValueError) as error:  # ragged lists
        raise TypeError(f"{name}: expected integers, got {arguments.describe(values)}: {error}") from error


def _refuse_repeats(rows: np.ndarray, name: str, what: str) -> None:
    repeats = (rows == np.roll(rows, 1, axis=1)).any(axis=1)
    if repeats.any():
        first = int(np.argmax(repeats))
        raise ValueError(f"{name}: {what} {first} repeats a vertex: {rows[first].tolist()}")


def _refuse_twice(alone: np.ndarray) -> None:
    ordered = np.sort(alone)
    twice = ordered[1:][ordered[1:] == ordered[:-1]]
    if len(twice):
        raise ValueError(f"points: vertex {int(twice[0])} is listed twice")
