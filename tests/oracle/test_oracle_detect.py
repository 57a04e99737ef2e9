"""Broad phase, mesh topology and brute-force detection, each against a simpler method."""

from __future__ import annotations

from fractions import Fraction
from itertools import combinations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from strategies import PoseMotion, TriMesh, boxes, bumpy_spheres, meshes, pose_motions, tetrahedra

from . import broad, detect, linear, mesh, rigid

CUBE = np.array([[x, y, z] for x in (0.0, 1.0) for y in (0.0, 1.0) for z in (0.0, 1.0)])


def test_moving_spheres_analytic() -> None:
    pair = [[0.0, 0, 0], [4.0, 3, 0]], [[0.0, 0, 0], [-4.0, 3, 0]]
    assert broad.spheres_meet(*pair, 1.5, 1.5)  # passes at exactly 3
    assert not broad.spheres_meet(*pair, 1.5, 1.5 - 2.0**-52)
    assert broad.spheres_meet(*pair, 1.0, 1.5, 0.5)
    assert broad.spheres_meet(*pair[:1], pair[0], 2.0, 3.0)  # at rest, 5 apart
    assert not broad.spheres_meet(*pair[:1], pair[0], 2.0, 2.999)
    away = [[0.0, 0, 0], [5.0, 3, 0]]
    for ends in ((pair[0], away), (away, pair[0])):  # 5 apart at one end only
        assert broad.spheres_meet(*ends, 2.0, 3.0)
        assert not broad.spheres_meet(*ends, 2.0, 3.0 - 2.0**-51)


def test_sphere_pairs_are_all_pairs_and_no_others() -> None:
    rng = np.random.default_rng(0)
    for n, s in ((0, 0.0), (1, 0.0), (60, 0.0), (60, 0.25)):
        start = rng.integers(-8, 9, (n, 3)) / 2.0
        end, radius = start + rng.integers(-4, 5, (n, 3)), rng.integers(0, 4, n) / 4.0
        expected = [
            (i, j)
            for i, j in combinations(range(n), 2)
            if broad.spheres_meet(start[[i, j]], end[[i, j]], radius[i], radius[j], s)
        ]
        assert broad.sphere_pairs(start, end, radius, s).tolist() == [list(p) for p in expected]
        times = np.linspace(0, 1, 201)[:, None]
        for i, j in combinations(range(n), 2):
            w = (start[j] - start[i]) * (1 - times) + (end[j] - end[i]) * times
            least, reach = np.linalg.norm(w, axis=1).min(), radius[i] + radius[j] + s
            if least <= reach - 1e-12:
                assert (i, j) in expected
            if least > reach + 14 / 200:
                assert (i, j) not in expected


def test_pair_filters() -> None:
    at = np.zeros((4, 3))
    radius = np.ones(4)
    every = [list(p) for p in combinations(range(4), 2)]
    assert broad.sphere_pairs(at, at, radius).tolist() == every
    assert broad.sphere_pairs(at, at, radius, world=[0, 1, 0, 1]).tolist() == [[0, 2], [1, 3]]
    assert broad.sphere_pairs(at, at, radius, static=[True, True, False, False]).tolist() == every[1:]
    # 0 collides with 1 only; 1 with all; 2 and 3 with all but are in group 2 (bit 1)
    found = broad.sphere_pairs(at, at, radius, group=[1, 1, 2, 2], mask=[1, 3, 3, 3])
    assert found.tolist() == [[0, 1], [1, 2], [1, 3], [2, 3]]


@given(meshes())
@settings(max_examples=50, deadline=None)
def test_mesh_facts(shape: TriMesh) -> None:
    edges = mesh.unique_edges(shape.faces)
    assert (edges[:, 0] < edges[:, 1]).all()
    listed = [tuple(e) for e in edges.tolist()]
    assert listed == sorted(set(listed))
    sides = {frozenset((int(f[k]), int(f[k - 1]))) for f in shape.faces for k in range(3)}
    assert {frozenset(e) for e in edges.tolist()} == sides
    bound = mesh.sphere_bound(shape.vertices, shape.faces)
    corners = shape.vertices[shape.faces].reshape(-1, 3)
    assert np.allclose(bound.center, corners.mean(axis=0), atol=1e-14)
    assert bound.radius == pytest.approx(np.linalg.norm(corners - bound.center, axis=1).max(), rel=1e-14, abs=1e-14)
    assert abs(Fraction(bound.radius) ** 2 - bound.radius_squared_exact) <= bound.radius_squared_exact / 2**51
    pairs = mesh.feature_pairs(shape.faces, shape.faces[:1])
    used = len(set(shape.faces.ravel().tolist()))
    assert [len(p) for p in (pairs.vertex_face, pairs.face_vertex, pairs.edge_edge)] == [
        used,
        3 * len(shape.faces),
        3 * len(edges),
    ]


def test_faces_that_name_a_vertex_twice_are_refused() -> None:
    with pytest.raises(ValueError, match="twice"):
        mesh.unique_edges([[0, 1, 1]])


def every_pair(
    a: list[np.ndarray], b: list[np.ndarray], faces_a: np.ndarray, faces_b: np.ndarray
) -> set[tuple[int, int, int]]:
    """Exact test of every pair, with no filter at all."""
    pairs = mesh.feature_pairs(faces_a, faces_b)
    edges = mesh.unique_edges(faces_a), mesh.unique_edges(faces_b)
    found = set()
    for v, f in pairs.vertex_face.tolist():
        if linear.vertex_face(*(np.concatenate([x[[v]], y[faces_b[f]]]) for x, y in zip(a, b, strict=True))):
            found.add((detect.VF_AB, v, f))
    for v, f in pairs.face_vertex.tolist():
        if linear.vertex_face(*(np.concatenate([y[[v]], x[faces_a[f]]]) for x, y in zip(a, b, strict=True))):
            found.add((detect.VF_BA, f, v))
    for i, j in pairs.edge_edge.tolist():
        if linear.edge_edge(*(np.concatenate([x[edges[0][i]], y[edges[1][j]]]) for x, y in zip(a, b, strict=True))):
            found.add((detect.EE, i, j))
    return found


@given(boxes(), tetrahedra(), st.integers(0, 2**32 - 1))
@settings(max_examples=15, deadline=None)
def test_linear_detection_is_every_pair(first: TriMesh, second: TriMesh, seed: int) -> None:
    rng = np.random.default_rng(seed)
    a = [first.vertices + rng.normal(size=3), first.vertices + rng.normal(size=3)]
    b = [second.vertices + rng.normal(size=3), second.vertices[:, [1, 2, 0]] + rng.normal(size=3)]
    found = detect.detect_linear(a[0], a[1], first.faces, b[0], b[1], second.faces)
    assert found.keys() == every_pair(a, b, first.faces, second.faces)
    wider = detect.detect_linear(a[0], a[1], first.faces, b[0], b[1], second.faces, min_separation=0.1)
    assert found.keys() <= wider.keys()
    assert wider.toi_lower <= found.toi_upper


def test_known_contacts_of_a_cube_and_a_wall() -> None:
    # The foremost corner of a tilted box starts at x = 1 and moves by 2 into a large face at x = 2.
    quads = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    faces = np.array([f for a, b, c, d in quads for f in ((a, b, c), (a, c, d))])
    turned = CUBE @ np.array([[1, 1, 1], [-1, 1, 0], [-1, -1, 2.0]])
    tip = int(turned[:, 0].argmax())
    start = turned - turned[tip] + [1.0, 0.25, 0.125]
    wall, wall_faces = np.array([[2.0, -5, -5], [2.0, 5, -5], [2.0, 0, 9]]), np.array([[0, 1, 2]])
    found = detect.detect_linear(start, start + [2.0, 0, 0], faces, wall, wall, wall_faces)
    assert found.toi_lower == found.toi_upper == Fraction(1, 2)
    first = [c for c in found.contacts if c.toi_upper == Fraction(1, 2)]
    assert [(c.kind, c.feature_a) for c in first] == [(detect.VF_AB, tip)]
    motion = rigid.BodyMotion.from_rotation([0.0, 0, 0], [1.0, 0, 0, 0], [2.0, 0, 0], [0.0, 0, 0])
    rest = rigid.BodyMotion.from_rotation([0.0, 0, 0], [1.0, 0, 0, 0], [0.0, 0, 0], [0.0, 0, 0])
    arcs = detect.detect_rigid(start, faces, motion, wall, wall_faces, rest)
    assert arcs.keys(include_unsure=True) == found.keys()  # three corners arrive at exactly t = 1
    assert arcs.keys() == {(c.kind, c.feature_a, c.feature_b) for c in first}
    assert arcs.toi_lower <= 0.5 <= arcs.toi_upper <= arcs.toi_lower + 1e-8


@given(bumpy_spheres(0), boxes(), pose_motions(scale=1.0), pose_motions(scale=1.0))
@settings(max_examples=3, deadline=None)
def test_rigid_detection_is_every_pair(
    first: TriMesh, second: TriMesh, motion_a: PoseMotion, motion_b: PoseMotion
) -> None:
    arcs = [
        rigid.BodyMotion.from_rotation(m.start.position, m.start.orientation, m.end.position, m.rotation)
        for m in (motion_a, motion_b)
    ]
    found = detect.detect_rigid(first.vertices, first.faces, arcs[0], second.vertices, second.faces, arcs[1])
    pairs = mesh.feature_pairs(first.faces, second.faces)
    points = {
        detect.VF_AB: mesh.vertex_face_points(first.vertices, second.vertices, second.faces, pairs.vertex_face),
        detect.VF_BA: mesh.vertex_face_points(second.vertices, first.vertices, first.faces, pairs.face_vertex),
    }
    touching = found.keys()
    for kind, listed in ((detect.VF_AB, pairs.vertex_face), (detect.VF_BA, pairs.face_vertex)):
        bodies = arcs if kind == detect.VF_AB else arcs[::-1]
        status = rigid.vertex_face(points[kind], *bodies).status
        expected = {(kind, *(p if kind == detect.VF_AB else p[::-1])) for p in listed[status == 1].tolist()}
        assert {key for key in touching if key[0] == kind} == expected
