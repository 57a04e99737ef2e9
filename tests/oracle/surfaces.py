"""Distances of two surfaces, unions of closed triangles, at one time: float64, or exact."""

from __future__ import annotations

from collections.abc import Iterator
from fractions import Fraction

import numpy as np

from oracle.distance import closest_coordinates, gap_vector, squared_distance
from oracle.mesh import unique_edges

# Rows of numpy's intermediate results.
_ROWS = 1 << 17


def _feature_pairs(
    x: np.ndarray, faces_x: np.ndarray, y: np.ndarray, faces_y: np.ndarray
) -> Iterator[tuple[np.ndarray, bool]]:
    """Points (n, 4, 3), and whether they are a vertex and a face or two edges, of all pairs of features."""
    edges_x, edges_y = x[_edges(faces_x)], y[_edges(faces_y)]
    sides = ((x[np.unique(faces_x)][:, None], y[faces_y], True), (y[np.unique(faces_y)][:, None], x[faces_x], True))
    for first, second, is_face in (*sides, (edges_x, edges_y, False)):
        if len(second) == 0:
            continue
        for begin in range(0, len(first), max(1, _ROWS // len(second))):
            part = first[begin : begin + max(1, _ROWS // len(second))]
            i, j = np.repeat(np.arange(len(part)), len(second)), np.tile(np.arange(len(second)), len(part))
            yield np.concatenate([part[i], second[j]], axis=1), is_face


def _edges(faces: np.ndarray) -> np.ndarray:
    """(E, 2) of faces, of which some may be segments (a, b, b) or points (a, a, a)."""
    is_triangle = faces[:, 1] != faces[:, 2]
    is_segment = ~is_triangle & (faces[:, 0] != faces[:, 1])
    of_triangles = unique_edges(faces[is_triangle]) if is_triangle.any() else np.empty((0, 2), dtype=np.int64)
    return np.concatenate([of_triangles, faces[is_segment][:, :2]])


def boundary_distance(x: np.ndarray, faces_x: np.ndarray, y: np.ndarray, faces_y: np.ndarray) -> float:
    """The least distance of a vertex and a face or of two edges: that of surfaces that do not pass through one another.

    Args:
        x, y: (n, 3) float64 vertices; faces_x, faces_y: (f, 3) triangles.
    """
    least = np.inf
    for points, is_face in _feature_pairs(x, faces_x, y, faces_y):
        gaps = np.linalg.norm(gap_vector(points, closest_coordinates(points, is_face), is_face), axis=1)
        least = min(least, float(gaps.min()))
    return least


def squared_distance_exact(x: np.ndarray, faces_x: np.ndarray, y: np.ndarray, faces_y: np.ndarray) -> Fraction:
    """As `boundary_distance`, squared, of vertices (n, 3) that are Fractions (dtype object)."""
    rough_x, rough_y = x.astype(np.float64), y.astype(np.float64)
    about = boundary_distance(rough_x, faces_x, rough_y, faces_y)
    size = max(np.abs(rough_x).max(), np.abs(rough_y).max())
    found = []
    # Only pairs that float64 cannot tell from the nearest one.
    exact = _feature_pairs(x, faces_x, y, faces_y)
    for (points, is_face), (rough, _) in zip(exact, _feature_pairs(rough_x, faces_x, rough_y, faces_y), strict=True):
        gaps = np.linalg.norm(gap_vector(rough, closest_coordinates(rough, is_face), is_face), axis=1)
        rows = np.flatnonzero(gaps <= about + 1e-9 * size)
        found += [squared_distance(points[row].tolist(), is_face) for row in rows]
    return Fraction(min(found))
