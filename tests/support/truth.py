"""Oracle results for two bodies, and comparison with detection results in both directions."""

from __future__ import annotations

from dataclasses import dataclass
from fractions import Fraction

import numpy as np
from oracle import detect, distance, rigid, search
from oracle.mesh import unique_edges

import pgccd
from support.shapes import Bodies

Key = tuple[int, int, int]
KINDS = (pgccd.Kind.VF_AB, pgccd.Kind.VF_BA, pgccd.Kind.EE)


@dataclass(frozen=True)
class Row:
    """One contact of a body pair."""

    toi: float
    status: int
    coordinates: tuple[float, float]
    point: tuple[float, float, float]
    normal: tuple[float, float, float]


Rows = dict[Key, Row]


def rows_of(hits: pgccd.Contacts, i: int = 0, j: int = 1) -> Rows:
    """The contacts of bodies i < j; fails on duplicates."""
    mine = ((hits.pairs[:, 0] == i) & (hits.pairs[:, 1] == j)).nonzero().flatten().tolist()
    columns = [c.tolist() for c in (hits.toi, hits.status, hits.coordinates, hits.point, hits.normal)]
    keys = [(int(hits.kind[k]), *hits.features[k].tolist()) for k in mine]
    assert len(set(keys)) == len(keys), "a contact is reported twice"
    values = ([tuple(c[k]) if isinstance(c[k], list) else c[k] for c in columns] for k in mine)
    return {key: Row(*value) for key, value in zip(keys, values, strict=True)}


def without_crossings(hits: pgccd.Contacts) -> pgccd.Contacts:
    """The vertex-face and edge-edge contacts: the oracles of paths know no edges through faces, which
    test_intersecting.py covers.
    """
    assert hits.kind is not None
    return hits[hits.kind <= pgccd.Kind.EE]


def body_motion(bodies: Bodies, body: int) -> rigid.BodyMotion:
    """A body's motion for the rigid oracle."""
    columns = (bodies.position_t0, bodies.orientation_t0, bodies.position_t1, bodies.rotation)
    return rigid.BodyMotion.from_rotation(*(c[body] for c in columns))


def rigid_truth(bodies: Bodies, i: int = 0, j: int = 1, min_separation: float = 0.0) -> detect.Detection:
    """Every contact of two bodies on rigid arcs."""
    meshes = [(m.vertices.numpy(), m.faces.numpy()) for m in (bodies.meshes[i], bodies.meshes[j])]
    motions = [body_motion(bodies, b) for b in (i, j)]
    return detect.detect_rigid(*meshes[0], motions[0], *meshes[1], motions[1], min_separation)


def end_positions(bodies: Bodies, body: int, seen_from: int | None = None) -> list[np.ndarray]:
    """World positions (V, 3) of a body's vertices at t0 and t1, optionally relative to another body's position; rounded
    once.
    """
    poses = (bodies.position_t0, bodies.orientation_t0, bodies.position_t1, bodies.rotation)
    pose = [c[body] for c in poses]
    points, ends = bodies.meshes[body].vertices.numpy(), []
    for t, centres in ((0.0, bodies.position_t0), (1.0, bodies.position_t1)):
        origin = np.zeros(3) if seen_from is None else centres[seen_from]
        world = (rigid.position(p, *pose, t) for p in points)
        ends.append(np.array([[float(c - o) for c, o in zip(p, origin.tolist(), strict=True)] for p in world]))
    return ends


def linear_truth(
    ends: list[list[np.ndarray]], faces: list[np.ndarray], min_separation: float = 0.0
) -> detect.Detection:
    """Every contact of two bodies whose vertices move straight between `ends` (t0 and t1 of each body), exactly."""
    return detect.detect_linear(*ends[0], faces[0], *ends[1], faces[1], min_separation)


def self_truth(ends: list[np.ndarray], faces: np.ndarray, min_separation: float = 0.0) -> detect.Detection:
    """Every contact of a body with itself, whose vertices move straight between `ends` (t0 and t1), exactly."""
    return detect.detect_linear_self(*ends, faces, min_separation)


def assert_nothing_invented(rows: Rows, truth: detect.Detection) -> None:
    """Asserts that every contact reported on these straight vertex paths is true or unresolved."""
    invented = {key for key in rows.keys() - truth.keys() if rows[key].status != pgccd.Status.UNRESOLVED}
    assert invented == set(), "invented"


def assert_nothing_missed(rows: Rows, truth: detect.Detection) -> None:
    """Asserts that every certain contact is reported, and not later than it happens."""
    assert truth.keys() - rows.keys() == set(), "missed"
    late = [c for c in truth.contacts if Fraction(rows[c.kind, c.feature_a, c.feature_b].toi) > Fraction(c.toi_upper)]
    assert late == [], "a toi is late"


def feature_indices(faces: tuple[np.ndarray, np.ndarray], keys: list[Key], kind: int) -> tuple[np.ndarray, np.ndarray]:
    """Vertex indices of the first and of the second primitive of all contacts of one kind."""
    a, b = (np.array([key[k] for key in keys]) for k in (1, 2))
    if kind == pgccd.Kind.EE:
        return unique_edges(faces[0])[a], unique_edges(faces[1])[b]
    return (a[:, None], faces[1][b]) if kind == pgccd.Kind.VF_AB else (b[:, None], faces[0][a])


def assert_rigid_rows_close(rows: Rows, bodies: Bodies, within: float, i: int = 0, j: int = 1) -> None:
    """Asserts that each reported pair on rigid arcs is at most `within` apart at its toi, at the reported point."""
    faces = (bodies.meshes[i].faces.long().numpy(), bodies.meshes[j].faces.long().numpy())
    for kind in KINDS:
        keys = [key for key, row in rows.items() if key[0] == kind and row.status == pgccd.Status.TOUCH]
        if not keys:
            continue
        first, second = (j, i) if kind == pgccd.Kind.VF_BA else (i, j)
        index = feature_indices(faces, keys, kind)
        points = np.concatenate(
            [bodies.meshes[b].vertices.numpy()[v] for b, v in zip((first, second), index, strict=True)], axis=1
        )
        paths = rigid.RigidPaths(points, body_motion(bodies, first), body_motion(bodies, second), kind != pgccd.Kind.EE)
        toi = np.array([rows[key].toi for key in keys])
        at_toi = paths.derivatives(np.arange(len(keys)), toi)[0]
        assert (search.upper_bound(at_toi, kind != pgccd.Kind.EE) <= within).all(), "reported too far apart"
        start, end = bodies.position_t0[first], bodies.position_t1[first]
        centre = start + toi[:, None] * (end - start)
        _assert_places([rows[key] for key in keys], at_toi.middle(), centre, kind, within)


def assert_rigid_pair_agrees(
    hits: pgccd.Contacts, bodies: Bodies, i: int = 0, j: int = 1, separation: float = 0.0
) -> int:
    """Checks all contacts of one pair (report="all", default tolerance) against brute force. Returns the number of true
    contacts.
    """
    rows, truth = rows_of(hits, i, j), rigid_truth(bodies, i, j, separation)
    assert_nothing_missed(rows, truth)
    meshes = bodies.meshes[i], bodies.meshes[j]
    size = np.abs(bodies.position_t0[j] - bodies.position_t0[i]).max() + sum(mesh.radius for mesh in meshes)
    tolerance = 1e-6 * min(mesh.radius for mesh in meshes)
    assert_rigid_rows_close(rows, bodies, separation + tolerance + 1e-12 * size, i, j)
    # Contacts that the oracle does not have come within the tolerance or are unresolved, and are counted as such.
    assert hits.stats.unresolved >= sum(row.status == pgccd.Status.UNRESOLVED for row in rows.values())
    if truth.contacts and rows:
        assert min(row.toi for row in rows.values()) <= float(truth.toi_upper)
    return len(truth.contacts)


def _assert_places(rows: list[Row], points: np.ndarray, centre: np.ndarray, kind: int, within: float) -> None:
    is_face = kind != pgccd.Kind.EE
    coordinates = np.array([row.coordinates for row in rows])
    u, v = coordinates[:, :1], coordinates[:, 1:]
    slack = 1e-9
    assert (coordinates >= -slack).all() and ((u + v if is_face else coordinates) <= 1 + slack).all()
    gap = distance.gap_vector(points, coordinates, is_face)
    length = np.linalg.norm(gap, axis=1, keepdims=True)
    assert (length <= within).all(), "the coordinates do not name nearest points"
    p, q = points[:, 0], points[:, 1]
    here = (p if is_face else p + u * (q - p)) + 0.5 * gap + centre
    size = np.abs(points).max() + np.abs(centre).max()
    assert np.abs(here - np.array([row.point for row in rows])).max() <= 1e-12 * size
    normal = np.array([row.normal for row in rows])
    assert np.abs(np.linalg.norm(normal, axis=1) - 1).max() < 1e-12
    # Where the gap is much longer than rounding, the normal is its direction, from body i to body j.
    clear = (length > 1e-9 * size).ravel()
    towards = gap * (-1.0 if kind == pgccd.Kind.VF_BA else 1.0) / np.maximum(length, 1e-300)
    assert ((towards * normal).sum(axis=1)[clear] > 0.999).all()


def linear_points(
    ends: list[list[np.ndarray]], faces: tuple[np.ndarray, np.ndarray], keys: list[Key], kind: int
) -> list[np.ndarray]:
    """Points (n, 4, 3) at t0 and at t1 of contacts of one kind, in the order of the elementary tests."""
    index = feature_indices(faces, keys, kind)
    first, second = (1, 0) if kind == pgccd.Kind.VF_BA else (0, 1)
    return [np.concatenate([ends[first][t][index[0]], ends[second][t][index[1]]], axis=1) for t in (0, 1)]


def assert_linear_rows_close(rows: Rows, ends: list[list[np.ndarray]], faces: list[np.ndarray], within: float) -> None:
    """Asserts that each reported feature pair on straight paths is at most `within` apart at its toi."""
    for kind in KINDS:
        keys = [key for key, row in rows.items() if key[0] == kind and row.status == pgccd.Status.TOUCH]
        if keys:
            start, end = linear_points(ends, (faces[0], faces[1]), keys, kind)
            toi = np.array([rows[key].toi for key in keys])
            assert (distance.min_distance_at(start, end, toi, kind != pgccd.Kind.EE) <= within).all(), "too far apart"
