"""Brute-force continuous collision detection of two bodies: every vertex-face pair both ways and every edge-edge pair.

Only rigorous rejections (boxes of the swept features, then `filters` or `search`) precede the full tests.
"""

from __future__ import annotations

from dataclasses import dataclass
from fractions import Fraction

import numpy as np

from . import filters, linear, mesh, rigid, search, separation
from .interval import Interval, down, up

VF_AB, VF_BA, EE = 0, 1, 2
CHUNK = 20_000


@dataclass(frozen=True, order=True)
class Contact:
    """One feature pair that touches. VF_AB: vertex of A, face of B; VF_BA: face of A, vertex of B; EE: edges.

    Edges are numbered as `mesh.unique_edges` lists them. The first touch is in [toi_lower, toi_upper]; an undecided
    pair (rigid arcs only) has `certain` False, and an infinite toi_upper.
    """

    kind: int
    feature_a: int
    feature_b: int
    toi_lower: Fraction | float
    toi_upper: Fraction | float
    certain: bool = True


@dataclass(frozen=True)
class Detection:
    """Contacts in ascending order of (kind, feature_a, feature_b), and the bracket of the earliest (inf if none)."""

    contacts: list[Contact]
    unsure: list[Contact]

    @property
    def toi_lower(self) -> Fraction | float:
        """Lower bound of the first touch."""
        return min((c.toi_lower for c in [*self.contacts, *self.unsure]), default=float("inf"))

    @property
    def toi_upper(self) -> Fraction | float:
        """Upper bound of the first touch."""
        return min((c.toi_upper for c in self.contacts), default=float("inf"))

    def keys(self, include_unsure: bool = False) -> set[tuple[int, int, int]]:
        """(kind, feature_a, feature_b) of the contacts."""
        found = self.contacts + (self.unsure if include_unsure else [])
        return {(c.kind, c.feature_a, c.feature_b) for c in found}


Boxes = tuple[np.ndarray, np.ndarray]


def _of_features(boxes: Boxes, features: np.ndarray) -> Boxes:
    return boxes[0][..., features, :].min(axis=-2), boxes[1][..., features, :].max(axis=-2)


def _overlapping(a: Boxes, b: Boxes, separation: float) -> np.ndarray:
    # Boxes (slices, features, 3): index pairs (k, 2) whose boxes come within the separation in some slice.
    found = np.zeros((a[0].shape[1], b[0].shape[1]), dtype=bool)
    for low_a, high_a, low_b, high_b in zip(*a, *b, strict=True):
        near = np.ones_like(found)
        reach_low, reach_high = (
            (low_b, high_b) if separation == 0 else (down(low_b - separation), up(high_b + separation))
        )
        for axis in range(3):
            near &= low_a[:, None, axis] <= reach_high[None, :, axis]
            near &= high_a[:, None, axis] >= reach_low[None, :, axis]
        found |= near
    return np.argwhere(found)


def _candidates(
    boxes_a: Boxes, faces_a: np.ndarray, boxes_b: Boxes, faces_b: np.ndarray, separation: float
) -> list[tuple[int, np.ndarray, np.ndarray, np.ndarray]]:
    """(kind, pairs in (a, b) order, vertex indices of A's feature, of B's) for each kind."""
    features = []
    for faces, boxes in ((faces_a, boxes_a), (faces_b, boxes_b)):
        corner, edge = mesh.used_vertices(faces)[:, None], mesh.unique_edges(faces)
        features.append([(f, _of_features(boxes, f)) for f in (corner, np.asarray(faces, dtype=np.int64), edge)])
    found = []
    for kind, i, j in ((VF_AB, 0, 1), (VF_BA, 1, 0), (EE, 2, 2)):
        (of_a, around_a), (of_b, around_b) = features[0][i], features[1][j]
        pairs = _overlapping(around_a, around_b, separation)
        index_a, index_b = of_a[pairs[:, 0]], of_b[pairs[:, 1]]
        if i == 0:
            pairs[:, 0] = of_a[pairs[:, 0], 0]  # vertices have their mesh index
        if j == 0:
            pairs[:, 1] = of_b[pairs[:, 1], 0]
        found.append((kind, pairs, index_a, index_b))
    return found


def _gather(kind: int, x_a: np.ndarray, x_b: np.ndarray, index_a: np.ndarray, index_b: np.ndarray) -> np.ndarray:
    # Points (n, 4, 3) in the order of the elementary tests: the vertex first.
    parts = [x_a[index_a], x_b[index_b]]
    return np.concatenate(parts[::-1] if kind == VF_BA else parts, axis=1)


def detect_linear(
    a_t0: np.ndarray,
    a_t1: np.ndarray,
    faces_a: np.ndarray,
    b_t0: np.ndarray,
    b_t1: np.ndarray,
    faces_b: np.ndarray,
    min_separation: float = 0.0,
    width: Fraction = linear.WIDTH,
) -> Detection:
    """All touching feature pairs of two bodies whose vertices (v, 3) move on straight paths, exactly (faces (f, 3))."""
    ends_a, ends_b = ([np.asarray(x, dtype=np.float64) for x in ends] for ends in ((a_t0, a_t1), (b_t0, b_t1)))
    boxes = [(np.minimum(*ends)[None], np.maximum(*ends)[None]) for ends in (ends_a, ends_b)]
    contacts = []
    for kind, pairs, index_a, index_b in _candidates(boxes[0], faces_a, boxes[1], faces_b, min_separation):
        start, end = (_gather(kind, ends_a[k], ends_b[k], index_a, index_b) for k in (0, 1))
        contacts += _touching(kind, pairs, start, end, min_separation, width)
    return Detection(sorted(contacts), [])


def detect_linear_self(
    t0: np.ndarray, t1: np.ndarray, faces: np.ndarray, min_separation: float = 0.0, width: Fraction = linear.WIDTH
) -> Detection:
    """All touching feature pairs of one body (vertices (v, 3), straight paths) that have no vertex in common: vertex
    and face as VF_AB, two edges as EE with the smaller index first.
    """
    ends = [np.asarray(x, dtype=np.float64) for x in (t0, t1)]
    boxes = np.minimum(*ends)[None], np.maximum(*ends)[None]
    contacts = []
    for kind, pairs, index_a, index_b in _candidates(boxes, faces, boxes, faces, min_separation):
        keep = ~(index_a[:, :, None] == index_b[:, None, :]).any(axis=(1, 2))
        keep &= (pairs[:, 0] < pairs[:, 1]) if kind == EE else np.array(kind == VF_AB)
        start, end = (_gather(kind, x, x, index_a[keep], index_b[keep]) for x in ends)
        contacts += _touching(kind, pairs[keep], start, end, min_separation, width)
    return Detection(sorted(contacts), [])


def _touching(
    kind: int, pairs: np.ndarray, start: np.ndarray, end: np.ndarray, min_separation: float, width: Fraction
) -> list[Contact]:
    # Contacts of feature pairs (k, 2) with points at `start` and `end` (k, 4, 3).
    is_face = kind != EE
    keep = filters.may_touch(start, end, is_face, min_separation)
    start, end, pairs = start[keep], end[keep], pairs[keep]
    if min_separation:
        hits = separation.within_many(start, end, min_separation, is_face, width)
    else:
        hits = (linear.vertex_face_many if is_face else linear.edge_edge_many)(start, end, width)
    named = zip(pairs.tolist(), hits, strict=True)
    return [Contact(kind, i, j, hit.toi_lower, hit.toi_upper) for (i, j), hit in named if hit is not None]


def _arc_boxes(vertices: np.ndarray, motion: rigid.BodyMotion, path: tuple[Interval, Interval], slices: int) -> Boxes:
    # Boxes (slices, v, 3) of every vertex over equal slices of time; the count is a power of two, so these are exact.
    arm = rigid.rotate(motion.orientation_t0, Interval(vertices))
    spin = Interval(*(np.broadcast_to(x, arm.lo.shape) for x in (motion.rotation.lo, motion.rotation.hi)))
    jerk = rigid.jerk_bound(arm, spin)[None]
    lower, upper = [], []
    for k in range(slices):
        middle, half = (k + 0.5) / slices, np.array([0.5 / slices])
        turned, rate, bend = rigid.turn(arm, spin, Interval(np.full(len(arm.lo), middle)))
        box = search.swept_box(
            ((path[0] + path[1] * middle + turned)[None], (path[1] + rate)[None], bend[None]), jerk, half
        )
        lower.append(box.lo[0])
        upper.append(box.hi[0])
    return np.stack(lower), np.stack(upper)


def detect_rigid(
    vertices_a: np.ndarray,
    faces_a: np.ndarray,
    motion_a: rigid.BodyMotion,
    vertices_b: np.ndarray,
    faces_b: np.ndarray,
    motion_b: rigid.BodyMotion,
    min_separation: float = 0.0,
    width: float = 1e-9,
) -> Detection:
    """All feature pairs of two bodies on rigid arcs that touch; vertices (v, 3) in body frames, faces (f, 3)."""
    x_a, x_b = np.asarray(vertices_a, dtype=np.float64), np.asarray(vertices_b, dtype=np.float64)
    turned = max(float(np.linalg.norm(m.rotation.magnitude())) for m in (motion_a, motion_b))
    slices = 4
    while turned / slices > 0.25 and slices < 256:
        slices *= 2
    still = Interval(np.zeros(3)), Interval(np.zeros(3))
    boxes_a = _arc_boxes(x_a, motion_a, still, slices)
    boxes_b = _arc_boxes(x_b, motion_b, rigid.relative_path(motion_a, motion_b), slices)
    contacts: list[Contact] = []
    unsure: list[Contact] = []
    for kind, pairs, index_a, index_b in _candidates(boxes_a, faces_a, boxes_b, faces_b, min_separation):
        points = _gather(kind, x_a, x_b, index_a, index_b)
        motions = (motion_b, motion_a) if kind == VF_BA else (motion_a, motion_b)
        decide = rigid.edge_edge if kind == EE else rigid.vertex_face
        for first in range(0, len(points), CHUNK):
            found = decide(points[first : first + CHUNK], *motions, min_separation, width)
            for k in np.flatnonzero(found.status != search.NO):
                certain = bool(found.status[k] == search.YES)
                i, j = pairs[first + k].tolist()
                contact = Contact(kind, i, j, float(found.toi_lower[k]), float(found.toi_upper[k]), certain)
                (contacts if certain else unsure).append(contact)
    return Detection(sorted(contacts), sorted(unsure))
