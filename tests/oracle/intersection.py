"""Whether triangles at rest have a common point, and which edges pass through which faces: exact integer arithmetic.

Coordinates are NumPy integers: int64 up to `BOUND` in magnitude, or Python integers (dtype object) of any size, which
`as_integers` makes from doubles. A triangle may be degenerate: a segment or a point. Nothing is rounded, so there is no
undecided case.

Common points, by separating axes: two convex polytopes A and B are disjoint iff the origin lies outside of D = {b - a},
a polytope whose edges are parallel to edges of A or B. If D has a volume, each facet is parallel to a facet of A or of
B or to an edge of both. If it is flat, with a normal m, the origin is beyond one of its edges or, along m, off its
plane. If it is a segment along g, the origin is beyond an end or off its line, at r: r - (r.g) g / g.g then separates.
If it is a point r, r separates. `_axes` lists all of these directions; none of them can separate sets that meet.
"""

from __future__ import annotations

from collections.abc import Iterator
from itertools import product

import numpy as np

from .mesh import unique_edges

#: Largest magnitude of int64 coordinates: differences are below 2^14, axes below 2^44, projections below 2^60.
BOUND = 2**13 - 1
# Rows at a time, so that what is computed from them stays in the cache.
_CHUNK = 4096

Rows = np.ndarray


def as_integers(points: Rows) -> Rows:
    """Doubles of any shape as integers (dtype object), all multiplied by the same power of two; exact."""
    values = np.asarray(points, dtype=np.float64)
    mantissa, exponent = np.frexp(values)
    whole = (mantissa * 2.0**53).astype(np.int64)
    shift = exponent - (exponent[whole != 0].min() if whole.any() else 0)
    scaled = [int(m) << int(s) if m else 0 for m, s in zip(whole.ravel(), shift.ravel(), strict=True)]
    return np.array(scaled, dtype=object).reshape(values.shape)


def _checked(points: Rows) -> Rows:
    if points.dtype == object:
        return points
    if points.dtype != np.int64 or np.abs(points).max(initial=0) > BOUND:
        raise ValueError(f"expected int64 coordinates up to {BOUND}, or Python integers")
    return points


def cross(a: Rows, b: Rows) -> Rows:
    """(..., 3), of integers of either kind."""
    x, y = [a[..., k] for k in range(3)], [b[..., k] for k in range(3)]
    return np.stack([x[1] * y[2] - x[2] * y[1], x[2] * y[0] - x[0] * y[2], x[0] * y[1] - x[1] * y[0]], axis=-1)


def dot(a: Rows, b: Rows) -> Rows:
    """(...), of integers of either kind."""
    return a[..., 0] * b[..., 0] + a[..., 1] * b[..., 1] + a[..., 2] * b[..., 2]


def sign(values: Rows) -> Rows:
    """int8 signs."""
    return (values > 0).astype(np.int8) - (values < 0).astype(np.int8)


def _edges(triangle: Rows) -> list[Rows]:
    return [triangle[:, (k + 1) % 3] - triangle[:, k] for k in range(3)]


def _first_nonzero(vectors: list[Rows]) -> Rows:
    found = vectors[0]
    for vector in vectors[1:]:
        found = np.where((found != 0).any(axis=1)[:, None], found, vector)
    return found


def _axes(a: Rows, b: Rows) -> Iterator[Rows]:
    edges_a, edges_b = _edges(a), _edges(b)
    normals = [cross(edges_a[0], edges_a[1]), cross(edges_b[0], edges_b[1])]
    normals += [cross(e, f) for e, f in product(edges_a, edges_b)]
    yield from normals
    m = _first_nonzero(normals)
    yield from (cross(m, e) for e in edges_a + edges_b)
    g, r = _first_nonzero(edges_a + edges_b), b[:, 0] - a[:, 0]
    yield g
    yield cross(cross(g, r), g)
    yield r


def have_common_point(a: Rows, b: Rows) -> Rows:
    """(n,) bool: do the closed triangles a and b (n, 3, 3) have a common point?"""
    a, b = _checked(a), _checked(b)
    apart = np.zeros(len(a), dtype=bool)
    for begin in range(0, len(a), _CHUNK):
        rows = slice(begin, begin + _CHUNK)
        for axis in _axes(a[rows], b[rows]):
            on_a, on_b = (np.stack([dot(x[rows, k], axis) for k in range(3)]) for x in (a, b))
            apart[rows] |= (on_a.max(axis=0) < on_b.min(axis=0)) | (on_b.max(axis=0) < on_a.min(axis=0))
    return ~apart


def volume(p: Rows, q: Rows, s: Rows, t: Rows) -> Rows:
    """(n,): six times the signed volume of the tetrahedra; points (n, 3)."""
    return dot(q - p, cross(s - p, t - p))


def passes_through(edge: Rows, face: Rows) -> Rows:
    """(n,) bool: do edges (n, 2, 3) pass through the interior of faces (n, 3, 3), from one side to the other?

    That is: the end points lie strictly on different sides, and the edge passes all three edges of the face on the same
    side.
    """
    edge, face = _checked(edge), _checked(face)
    p, q = edge[:, 0], edge[:, 1]
    corners = [face[:, k] for k in range(3)]
    ends = [sign(volume(x, *corners)) for x in (p, q)]
    sides = [sign(volume(p, q, corners[k], corners[(k + 1) % 3])) for k in range(3)]
    is_inside = (sides[0] != 0) & (sides[0] == sides[1]) & (sides[0] == sides[2])
    return (ends[0] * ends[1] < 0) & is_inside


def crossings(a: Rows, b: Rows) -> Rows:
    """(n, 6) bool: does edge k of a, from corner k to the next, pass through b; then: does edge k of b through a?"""
    around = [[k, (k + 1) % 3] for k in range(3)]
    return np.stack([passes_through(x[:, e], y) for x, y in ((a, b), (b, a)) for e in around], axis=1)


def edges_through_faces(vertices: Rows, edges: Rows, of: Rows, faces: Rows) -> list[tuple[int, int]]:
    """All (edge, face) that properly cross: edges (e, 2) of `vertices`, faces (f, 3) of the vertices `of`. Pairs with a
    common vertex index are left out where both are of the same array.
    """
    e, f = (k.ravel() for k in np.meshgrid(np.arange(len(edges)), np.arange(len(faces)), indexing="ij"))
    kept = np.ones(len(e), dtype=bool)
    if of is vertices:
        kept = ~(edges[e][:, :, None] == faces[f][:, None, :]).any(axis=(1, 2))
    e, f = e[kept], f[kept]
    found = passes_through(vertices[edges[e]], of[faces[f]])
    return list(zip(e[found].tolist(), f[found].tolist(), strict=True))


def crossings_of_meshes(vertices_a: Rows, faces_a: Rows, vertices_b: Rows, faces_b: Rows) -> set[tuple[int, int, int]]:
    """All (kind, feature of a, feature of b): kind 3, an edge of a through a face of b; 4, an edge of b through a face
    of a. Edges are numbered as by `unique_edges`.
    """
    of_a = edges_through_faces(vertices_a, unique_edges(faces_a), vertices_b, faces_b)
    of_b = edges_through_faces(vertices_b, unique_edges(faces_b), vertices_a, faces_a)
    return {(3, edge, face) for edge, face in of_a} | {(4, face, edge) for edge, face in of_b}


def crossings_within(vertices: Rows, faces: Rows) -> set[tuple[int, int, int]]:
    """All (3, edge, face) of one mesh without a common vertex."""
    return {(3, edge, face) for edge, face in edges_through_faces(vertices, unique_edges(faces), vertices, faces)}
