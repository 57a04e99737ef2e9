"""Mesh topology: unique edges, exhaustive feature pairs of two meshes, and the sphere bounding volume (SBV)."""

from __future__ import annotations

from dataclasses import dataclass
from fractions import Fraction
from math import isqrt

import numpy as np
from numpy.typing import ArrayLike


@dataclass(frozen=True)
class SphereBound:
    """SBV: exact centre and squared radius, and both rounded to the nearest double."""

    center: np.ndarray
    radius: float
    center_exact: tuple[Fraction, Fraction, Fraction]
    radius_squared_exact: Fraction


@dataclass(frozen=True)
class FeaturePairs:
    """Every elementary test of bodies A and B; each array is (n, 2) int64."""

    vertex_face: np.ndarray  # vertex of A, face of B
    face_vertex: np.ndarray  # vertex of B, face of A
    edge_edge: np.ndarray  # edge of A, edge of B


def _faces(faces: ArrayLike) -> np.ndarray:
    array = np.asarray(faces, dtype=np.int64)
    if array.ndim != 2 or array.shape[1] != 3:
        raise ValueError(f"faces must be (f, 3), got {array.shape}")
    if (array == np.roll(array, 1, axis=1)).any():
        raise ValueError("a face names a vertex twice")
    return array


def unique_edges(faces: ArrayLike) -> np.ndarray:
    """(e, 2) int64: each undirected edge of the faces (f, 3) once, as (smaller, larger) vertex, in lexicographic
    order.
    """
    found = {(min(a, b), max(a, b)) for f in _faces(faces).tolist() for a, b in zip(f, f[1:] + f[:1], strict=True)}
    return np.array(sorted(found), dtype=np.int64).reshape(-1, 2)


def used_vertices(faces: ArrayLike) -> np.ndarray:
    """Ascending indices of the vertices used by faces; only these take part in vertex-face tests."""
    return np.unique(_faces(faces))


def all_pairs(first: ArrayLike, second: ArrayLike) -> np.ndarray:
    """(len(first) len(second), 2) int64: the product of two index lists, in lexicographic order."""
    a, b = np.asarray(first, dtype=np.int64), np.asarray(second, dtype=np.int64)
    return np.stack([np.repeat(a, len(b)), np.tile(b, len(a))], axis=1)


def feature_pairs(faces_a: ArrayLike, faces_b: ArrayLike) -> FeaturePairs:
    """Every vertex-face pair both ways and every edge-edge pair; edges are numbered as `unique_edges` lists them."""
    a, b = _faces(faces_a), _faces(faces_b)
    return FeaturePairs(
        vertex_face=all_pairs(used_vertices(a), np.arange(len(b))),
        face_vertex=all_pairs(used_vertices(b), np.arange(len(a))),
        edge_edge=all_pairs(np.arange(len(unique_edges(a))), np.arange(len(unique_edges(b)))),
    )


def vertex_face_points(
    vertices_a: np.ndarray, vertices_b: np.ndarray, faces_b: np.ndarray, pairs: np.ndarray
) -> np.ndarray:
    """Points (n, 4, ...) in the order v, f0, f1, f2 of pairs (vertex of A, face of B)."""
    return np.concatenate([vertices_a[pairs[:, :1]], vertices_b[faces_b[pairs[:, 1]]]], axis=1)


def edge_edge_points(
    vertices_a: np.ndarray, edges_a: np.ndarray, vertices_b: np.ndarray, edges_b: np.ndarray, pairs: np.ndarray
) -> np.ndarray:
    """Points (n, 4, ...) in the order ea0, ea1, eb0, eb1 of pairs (edge of A, edge of B)."""
    return np.concatenate([vertices_a[edges_a[pairs[:, 0]]], vertices_b[edges_b[pairs[:, 1]]]], axis=1)


def rounded_root(square: Fraction) -> float:
    """The square root of a non-negative rational, correctly rounded to a double (normal range)."""
    if square == 0:
        return 0.0
    # 4^shift square has an integer root of at least 2^64, and the last bit is made sticky.
    shift = 66 - (square.numerator.bit_length() - square.denominator.bit_length()) // 2
    scaled = square * Fraction(4) ** shift
    whole = scaled.numerator // scaled.denominator
    root = isqrt(whole)
    inexact = root * root != scaled
    return float(Fraction(2 * root + inexact, 2) / Fraction(2) ** shift)


def sphere_bound(vertices: ArrayLike, faces: ArrayLike) -> SphereBound:
    """SBV of vertices (v, 3), faces (f, 3): centre = mean of the corner coordinates over all triangles (Du et al.
    2017, Eq. 1), radius = largest distance of a face's vertex from the exact centre (Eq. 2). Rational arithmetic,
    rounded once at the end.
    """
    index = _faces(faces)
    if not len(index):
        raise ValueError("a mesh without faces has no SBV")
    points = np.asarray(vertices, dtype=np.float64)
    exact = [[Fraction(c) for c in p] for p in points.tolist()]
    corners = index.ravel().tolist()
    x, y, z = (sum((exact[i][axis] for i in corners), Fraction(0)) / len(corners) for axis in range(3))
    center = (x, y, z)
    square = max(sum(((p - c) ** 2 for p, c in zip(exact[i], center, strict=True)), Fraction(0)) for i in set(corners))
    return SphereBound(np.array([float(c) for c in center]), rounded_root(square), center, square)
