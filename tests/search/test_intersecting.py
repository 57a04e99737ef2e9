"""Surfaces that already intersect at t = 0: `detect` against exact arithmetic."""

from __future__ import annotations

from dataclasses import replace
from fractions import Fraction
from typing import Any

import numpy as np
import pytest
import torch
from oracle import distance, intersection
from oracle.intersection import as_integers, crossings_of_meshes, crossings_within, have_common_point
from support import intersecting, solids
from support.cases import few_and_many
from support.intersecting import EF_AB, EF_BA, integer_pairs
from support.reports import captured_loop, detected
from support.same_bits import COLUMNS, assert_same
from support.shapes import bumpy, tensors, turned, unit_quaternions

import pgccd
from pgccd import narrow

REPORTS = list(narrow.REPORTS)


def crossing_rows(hits: pgccd.Contacts) -> list[tuple[int, int, int]]:
    """(kind, features) of edges through faces."""
    rows = torch.cat([hits.kind[:, None].long(), hits.features.long()], dim=1)
    return [tuple(row) for row in rows.tolist() if row[0] >= EF_AB]


def at_rest(x: np.ndarray, device: torch.device | str) -> pgccd.VertexMotion:
    return pgccd.VertexMotion(*tensors(x, x, device=device))


def test_kinds() -> None:
    assert (pgccd.Kind.EF_AB, pgccd.Kind.EF_BA) == (EF_AB, EF_BA)


@pytest.mark.parametrize("path", ["rest", "linear", "rigid"])
@pytest.mark.parametrize("tolerance", [None, 0.0])
@few_and_many("count", 120, 300)
def test_rigid_triangles(device: torch.device, path: str, tolerance: float | None, count: int) -> None:
    rng = np.random.default_rng([1, len(path)])
    a, b = integer_pairs(rng, count, degenerate=False)
    scene, motion = intersecting.rigid_scene(rng, a, b, device, path)
    assert intersecting.check_reports(a, b, scene, motion, path == "rest", tolerance=tolerance) > 0.25 * count


@pytest.mark.parametrize("moving", [False, True], ids=["at rest", "moving"])
@pytest.mark.parametrize("tolerance", [None, 0.0])
def test_deforming_triangles(device: torch.device, moving: bool, tolerance: float | None) -> None:
    rng = np.random.default_rng([2, int(moving)])
    a, b = integer_pairs(rng, 3000)
    scene, motion = intersecting.deforming_scene(rng, a, b, device, moving)
    assert intersecting.check_reports(a, b, scene, motion, not moving, tolerance=tolerance) > 800


@pytest.mark.parametrize("report", REPORTS)
def test_single_pairs(device: torch.device, report: narrow.Report) -> None:
    """One pair a call, at small coordinates, where most pairs touch."""
    rng = np.random.default_rng(3)
    a, b = integer_pairs(rng, 60, 4)
    for k, meets in enumerate(have_common_point(a, b).tolist()):
        scene, motion = intersecting.deforming_scene(rng, a[k : k + 1], b[k : k + 1], device, False)
        hits = detected(scene, motion, report)
        assert (len(hits) > 0) == meets
        assert report == "any" or not meets or float(hits.first_toi()) == 0.0


@pytest.mark.parametrize("kind", ["deforming", "rest", "rigid"])
@few_and_many("count", 60, 200)
def test_settings_do_not_matter(device: torch.device, kind: str, count: int) -> None:
    rng = np.random.default_rng([4, len(kind)])
    a, b = integer_pairs(rng, count, degenerate=False)
    expected = intersecting.expected_crossings(a, b)
    assert len(expected) > 0.15 * count

    def found(margin: float | None = None, **options: Any) -> np.ndarray:
        same = np.random.default_rng(5)
        if kind == "deforming":
            scene, motion = intersecting.deforming_scene(same, a, b, device, True, margin=margin)
            return intersecting.crossings_of(pgccd.detect(scene, motion, "all", **options))
        still, still_motion = intersecting.rigid_scene(same, a, b, device, kind, margin=margin)
        return intersecting.crossings_of(pgccd.detect(still, still_motion, "all", **options))

    settings: list[dict[str, Any]] = [{"margin": 0.5}, {"min_separation": 1.0}, {"nonzero_toi": True}]
    settings += [{"tolerance": 3.0}, {"tolerance": 0.0, "nonzero_toi": True}, {"broad_phase": "lbvh"}]
    for options in settings:
        assert np.array_equal(found(**options), expected), options


def test_initial_state_assumed_free(device: torch.device) -> None:
    rng = np.random.default_rng(6)
    a, b = integer_pairs(rng, 2000)
    scene, motion = intersecting.deforming_scene(rng, a, b, device, True)
    for report in REPORTS:
        assumed, reported = (detected(scene, motion, report, initial=i) for i in ("assume_free", "report"))
        assert len(assumed) > 0 and (report == "any" or int(assumed.kind.max()) < EF_AB)
        if report == "all":
            rest = reported[reported.kind < EF_AB]
            assert_same(assumed, rest)


def there_and_back(kind: str, device: torch.device) -> tuple[pgccd.Scene, Any, pgccd.Trajectory]:
    """Pairs that intersect at the start, a step, and the step forward and backward."""
    rng = np.random.default_rng([14, len(kind)])
    a, b = integer_pairs(rng, 150, degenerate=False)
    if kind == "deforming":
        scene, motion = intersecting.deforming_scene(rng, a, b, device, True)
        return scene, motion, pgccd.Trajectory(torch.stack([motion.x_t0, motion.x_t1, motion.x_t0]))
    scene, rigid = intersecting.rigid_scene(rng, a, b, device, "rigid")
    ends = [rigid.at(t) for t in (0.0, 1.0, 0.0)]
    path = pgccd.Trajectory(*(torch.stack([end[k] for end in ends]) for k in range(2)))
    return scene, pgccd.RigidMotion(*ends[0], *ends[1]), path  # a trajectory turns the shorter way


@pytest.mark.parametrize("report", REPORTS)
@pytest.mark.parametrize("kind", ["deforming", "rigid"])
def test_graphs(device: torch.device, kind: str, report: narrow.Report) -> None:
    scene, motion, _ = there_and_back(kind, device)
    captured = captured_loop(scene, motion, report)
    for _ in range(2):
        assert_same(captured(motion).trim(), detected(scene, motion, report))


@pytest.mark.parametrize("report", REPORTS)
@pytest.mark.parametrize("kind", ["deforming", "rigid"])
def test_other_ways_of_searching(device: torch.device, kind: str, report: narrow.Report) -> None:
    """Given pairs, chunks, a fixed capacity and trajectories report the same contacts."""
    scene, motion, path = there_and_back(kind, device)
    expected, count = detected(scene, motion, report), scene.body_count
    pairs = torch.arange(count, device=device).view(-1, 2)
    assert_same(detected(scene, motion, report, pairs=pairs), expected)
    assert_same(detected(scene, motion, report, memory_budget=20_000), expected)
    capacity = replace(pgccd.Capacity.of(count), candidates=100_000, contacts=100_000)
    assert_same(detected(scene, motion, report, capacity=capacity).trim(), expected)
    along = detected(scene, path, report)
    if report == "any":
        assert torch.isin(expected.pairs, along.pairs).all()
        return
    for k in range(2 if report == "all" else 1):
        of_segment = detected(scene, path.segment(k), report)
        for column in COLUMNS:
            assert torch.equal(getattr(along, column)[along.segment == k], getattr(of_segment, column)), column
    if report == "all" and kind == "deforming":  # rigid ones no longer intersect
        assert int((along.kind[along.segment == 1] >= EF_AB).sum()) > 10


def test_place_of_a_crossing(device: torch.device) -> None:
    """The point lies on the edge and, at the coordinates, on the face, whose normal is oriented from i to j."""
    rng = np.random.default_rng(7)
    a, b = integer_pairs(rng, 300, degenerate=False)
    scene, motion = intersecting.rigid_scene(rng, a, b, device, "rest")
    hits = pgccd.detect(scene, motion, "all").to("cpu")
    hits = hits[hits.kind >= EF_AB]
    x = _world(scene, motion)
    assert len(hits) > 50
    for row in range(len(hits)):
        of_b = int(hits.kind[row]) == EF_BA
        i, j = hits.pairs[row].tolist()
        edge_body, face_body = (j, i) if of_b else (i, j)
        edge = scene.meshes.meshes[edge_body].edges[hits.features[row, 1 if of_b else 0]].numpy()
        (p, q), (r, s, t) = x[edge_body][edge], x[face_body]
        u, v = hits.coordinates[row].tolist()
        point = hits.point[row].numpy()
        assert u > 0 and v > 0 and u + v < 1
        size = np.abs(np.concatenate([x[i], x[j]])).max()
        assert np.abs(r + u * (s - r) + v * (t - r) - point).max() < 1e-14 * size
        along = np.dot(point - p, q - p) / np.dot(q - p, q - p)
        assert 0 < along < 1 and np.abs(p + along * (q - p) - point).max() < 1e-14 * size
        normal, full = hits.normal[row].numpy(), np.cross(s - r, t - r)
        assert abs(np.linalg.norm(normal) - 1) < 1e-14
        assert np.abs(np.cross(full / np.linalg.norm(full), normal)).max() < 1e-13
        assert np.dot(normal, x[j].mean(axis=0) - x[i].mean(axis=0)) > -1e-13 * size


def _world(scene: pgccd.Scene, motion: pgccd.RigidMotion) -> list[np.ndarray]:
    x, q = motion.position_t0.cpu().numpy(), motion.orientation_t0.cpu().numpy()
    return [turned(np.tile(q[k], (3, 1)), m.vertices.numpy()) + x[k] for k, m in enumerate(scene.meshes.meshes)]


def least_distance(a: np.ndarray, b: np.ndarray) -> float:
    """Of two triangles (3, 3) of doubles that have no common point; from an exact square."""
    around = [[k, (k + 1) % 3] for k in range(3)]
    pairs = [(np.concatenate([x[k : k + 1], y]), True) for x, y in ((a, b), (b, a)) for k in range(3)]
    pairs += [(np.concatenate([a[e], b[f]]), False) for e in around for f in around]
    least = min(distance.squared_distance_exact(x, x, Fraction(0), is_face) for x, is_face in pairs)
    return float(least) ** 0.5


def slender_pairs(rng: np.random.Generator, n: int, family: str) -> tuple[np.ndarray, np.ndarray]:
    """Pairs of triangles in doubles that nearly cross, touch, or lie in one plane."""
    a, b = rng.normal(size=(2, n, 3, 3))
    tiny = 10.0 ** rng.uniform(-17, -9, (n, 1))
    inside = rng.dirichlet(np.ones(3), n)
    if family == "end at the face":
        b[:, 0] = (inside[:, :, None] * a).sum(axis=1) + tiny * rng.normal(size=(n, 3))
    elif family == "edge at the edge":
        s, t = rng.uniform(0.2, 0.8, (2, n, 1))
        target = a[:, 0] + s * (a[:, 1] - a[:, 0]) + tiny * rng.normal(size=(n, 3))
        b[:, 1] = b[:, 0] + (target - b[:, 0]) / t
    elif family == "one plane":
        frame = rng.normal(size=(n, 2, 3))
        a, b = (np.einsum("nik,nkj->nij", rng.normal(size=(n, 3, 2)), frame) for _ in range(2))
        b = b + tiny[:, None] * rng.normal(size=(n, 3, 3)) * (rng.random((n, 1, 1)) < 0.5)
    elif family == "units in the last place":  # products of two such distances are beyond two doubles
        along = rng.uniform(0.1, 0.9, (2, n, 1))
        for x, t in ((a[:, 2], along[0]), (b[:, 0], along[1])):
            on_edge = a[:, 0] + t * (a[:, 1] - a[:, 0])
            x[:] = on_edge + np.spacing(on_edge) * rng.integers(-1, 2, on_edge.shape)
    elif family == "needles":
        a, b = (x[:, :1] + rng.normal(size=(n, 3, 1)) * x[:, 1:2] + tiny[:, None] * x[:, [1, 2, 0]] for x in (a, b))
        b = b + a[:, 1:2] - b[:, 1:2]
    return a, b


FAMILIES = ["random", "end at the face", "edge at the edge", "one plane", "needles", "units in the last place"]


@pytest.mark.parametrize("family", FAMILIES)
@pytest.mark.parametrize(
    ("scale", "offset"), [(1.0, 0.0), (1.0, 1e7), (1e-3, 1e9), (1e-28, 0.0), (1e28, 1e29)], ids=lambda v: f"{v:g}"
)
def test_doubles(device: torch.device, family: str, scale: float, offset: float) -> None:
    """Deforming bodies: coordinates are exact as given, at any scale and far from the origin."""
    rng = np.random.default_rng([8, len(family)])
    a, b = slender_pairs(rng, 60, family)
    x = scale * np.stack([a, b], axis=1) + offset
    a, b = np.moveaxis(as_integers(x), 1, 0)
    mesh = pgccd.Mesh([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]], [[0, 1, 2]])
    world = torch.arange(60, device=device).repeat_interleave(2)
    scene, motion = pgccd.Scene([mesh], [0] * 120, device, world=world), at_rest(x.reshape(-1, 3), device)
    meet = have_common_point(a, b)
    every = pgccd.detect(scene, motion, "all", tolerance=0.0)
    assert np.array_equal(intersecting.crossings_of(every), intersecting.expected_crossings(a, b))
    for report in ("any", "first"):
        hits = detected(scene, motion, report, tolerance=0.0)
        found = (hits.pairs[:, 0] // 2).cpu().numpy()
        assert np.isin(np.flatnonzero(meet), found).all(), "missed"
        for k in found[~meet[found]]:
            assert least_distance(*x[k]) < 1e-28 * np.ptp(x[k], axis=(0, 1)).max(), "invented"


def solid_boxes(
    rng: np.random.Generator, count: int
) -> tuple[list[solids.Surface], np.ndarray, np.ndarray, np.ndarray]:
    """Pairs of boxes: half extents (2 count, 3), centres and quaternions; small ones in large ones, bars across one
    another, and boxes of any shape.
    """
    half = np.exp(rng.uniform(-1, 1, (2 * count, 3)))
    half[::6] *= 3.0
    half[1::6] *= 0.3
    half[2::6], half[3::6] = [4.0, 0.3, 0.3], [0.3, 4.0, 0.3]
    centre = rng.normal(size=(2 * count, 3)) * np.where(np.arange(2 * count)[:, None] % 6 < 4, 0.5, 1.2)
    orientation = unit_quaternions(rng, 2 * count)
    return [solids.box(-h, h) for h in half], half, centre, orientation


def test_boxes(device: torch.device) -> None:
    """Against separating axes: solids that overlap have surfaces that meet, unless one contains the other."""
    count = 300
    rng = np.random.default_rng(9)
    surfaces, half, centre, orientation = solid_boxes(rng, count)
    axes = np.stack([turned(orientation, np.tile(e, (2 * count, 1))) for e in np.eye(3)], axis=1)  # (2n, axis, 3)
    a, b = slice(0, None, 2), slice(1, None, 2)
    between = centre[b] - centre[a]
    crossed = np.cross(axes[a][:, :, None], axes[b][:, None]).reshape(count, 9, 3)
    tried = np.concatenate([axes[a], axes[b], crossed], axis=1)
    tried /= np.linalg.norm(tried, axis=2, keepdims=True)

    def reach(k: slice) -> np.ndarray:
        """Half the width of the boxes along the axes."""
        return np.einsum("nae,ne->na", np.abs(np.einsum("nad,ned->nae", tried, axes[k])), half[k])

    gap = (np.abs(np.einsum("nad,nd->na", tried, between)) - reach(a) - reach(b)).max(axis=1)
    corners = np.array([[1.0 - 2 * (k >> c & 1) for c in range(3)] for k in range(8)])

    def depth(inner: slice, outer: slice) -> np.ndarray:
        """Of the corner of one box that is least deep in the other."""
        at = centre[inner][:, None] + np.einsum("kc,nc,ncd->nkd", corners, half[inner], axes[inner])
        local = np.einsum("nkd,ncd->nkc", at - centre[outer][:, None], axes[outer])
        return (half[outer][:, None] - np.abs(local)).min(axis=(1, 2))

    a_in_b, b_in_a = depth(a, b), depth(b, a)
    assert min(np.abs(gap).min(), np.abs(a_in_b).min(), np.abs(b_in_a).min()) > 1e-5, "too close to call"
    meet = (gap < 0) & (a_in_b < 0) & (b_in_a < 0)
    assert 0.2 * count < meet.sum() < 0.9 * count and (b_in_a > 0).sum() > 20 and (gap > 0).sum() > 20
    world = torch.arange(count, device=device).repeat_interleave(2)
    scene = pgccd.Scene([pgccd.Mesh(*s) for s in surfaces], device=device, world=world)
    start = tensors(centre, orientation, device=device)
    velocity = tensors(*rng.normal(size=(2, 2 * count, 3)), device=device)
    still, moving = pgccd.RigidMotion.at_rest(*start), pgccd.RigidMotion.from_velocity(*start, *velocity, dt=1.0)
    rows = [[2 * k, 2 * k + 1] for k in np.flatnonzero(meet).tolist()]
    for report in ("any", "first", "all"):
        hits = detected(scene, still, report)
        assert torch.unique(hits.pairs, dim=0).tolist() == rows
        if report != "any":
            hits = detected(scene, moving, report)
            assert torch.unique(hits.pairs[hits.toi == 0], dim=0).tolist() == rows
    inner = np.where(a_in_b > 0, 0, 1)
    contained = np.flatnonzero((a_in_b > 0) | (b_in_a > 0)).tolist()
    assert pgccd.enclosed(scene, moving).tolist() == sorted([2 * k + inner[k], 2 * k + 1 - inner[k]] for k in contained)


@pytest.mark.parametrize("offset", [0.0, 1e5])
def test_rigid_meshes(device: torch.device, offset: float) -> None:
    """Bodies of many triangles that penetrate one another, at any orientation."""
    rng = np.random.default_rng(10)
    meshes = [bumpy(rng, 2), bumpy(rng, 1, size=0.8)]
    orientation = unit_quaternions(rng, 2)
    at = np.array([[0.0, 0, 0], [1.0, 0.3, 0.2]])
    motion = pgccd.RigidMotion.at_rest(*tensors(at + offset, orientation, device=device))
    hits = pgccd.detect(pgccd.Scene(meshes, device=device), motion, "all")
    x = [
        turned(np.tile(q, (len(m.vertices), 1)), m.vertices.numpy()) + p
        for m, p, q in zip(meshes, at, orientation, strict=True)
    ]
    # Rounded to integers, which no crossing here depends on.
    whole = [np.rint(1e9 * k).astype(np.int64).astype(object) for k in x]
    expected = crossings_of_meshes(whole[0], meshes[0].faces.long().numpy(), whole[1], meshes[1].faces.long().numpy())
    assert set(crossing_rows(hits)) == expected and len(expected) > 40


TOPOLOGIES = {
    "two triangles": [[0, 1, 2], [3, 4, 5]],
    "a vertex in common": [[0, 1, 2], [0, 3, 4]],
    "strip": [[0, 1, 2], [2, 1, 3], [2, 3, 4], [4, 3, 5], [4, 5, 6], [6, 5, 7]],
    "octahedron": [[0, 2, 4], [2, 1, 4], [1, 3, 4], [3, 0, 4], [2, 0, 5], [1, 2, 5], [3, 1, 5], [0, 3, 5]],
    "three at an edge": [[0, 1, 2], [0, 1, 3], [0, 1, 4], [2, 3, 5], [4, 5, 6]],
}


def self_truth(x: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, list[set[tuple[int, int, int]]]]:
    """For meshes (n, vertices, 3) of integers: which have features without a common vertex that meet, and which edges
    pass through faces.
    """
    edges, vertices = intersection.unique_edges(faces), np.arange(x.shape[1])[:, None]
    meets = np.zeros(len(x), dtype=bool)
    for first, second in ((vertices, faces), (edges, edges)):
        for f in first:
            for g in second:
                if not np.isin(f, g).any():  # as triangles without area
                    shapes = [x[:, np.resize(k, 3)] for k in (f, g)]
                    meets |= have_common_point(*shapes)
    crossed = [crossings_within(mesh, faces) for mesh in x]
    return meets | np.array([len(c) > 0 for c in crossed]), crossed


@pytest.mark.parametrize("topology", TOPOLOGIES)
def test_self_collision(device: torch.device, topology: str) -> None:
    rng = np.random.default_rng([11, len(topology)])
    faces = np.array(TOPOLOGIES[topology])
    x = rng.integers(-4, 5, (150, faces.max() + 1, 3))
    x[::2] = rng.integers(-1, 2, x[::2].shape)
    meets, crossed = self_truth(x, faces)
    mesh = pgccd.Mesh(rng.normal(size=x[0].shape), faces)
    world = torch.arange(len(x), device=device)
    scene = pgccd.Scene([mesh], [0] * len(x), device, world=world, self_collision=True)
    start = x.reshape(-1, 3).astype(float)
    still, moving = (
        pgccd.VertexMotion(*tensors(start, start + k * rng.normal(size=start.shape), device=device)) for k in (0, 1)
    )
    for report in REPORTS:
        hits = detected(scene, still, report, tolerance=0.0)
        rows = torch.unique(hits.pairs, dim=0).tolist()
        assert rows == [[k, k] for k in np.flatnonzero(meets).tolist()][: 1 if report == "earliest" else None]
        if report != "any":
            hits = detected(scene, moving, report, tolerance=0.0)
            assert torch.unique(hits.pairs[hits.toi == 0], dim=0).tolist() == rows
    every = pgccd.detect(scene, moving, "all", tolerance=0.0)
    for k in range(len(x)):
        found = crossing_rows(every[every.pairs[:, 0] == k])
        assert found == sorted(crossed[k]), k
    assert sum(map(len, crossed)) > 10 and meets.sum() > 5


def cloth(rng: np.random.Generator, cells: int, wave: float) -> solids.Surface:
    """A wavy open sheet over [-4, 4]^2; coordinates are multiples of 2^-9."""
    x, y = np.meshgrid(np.linspace(-4, 4, cells + 1), np.linspace(-4, 4, cells + 1), indexing="ij")
    z = wave * (np.sin(1.3 * x + rng.uniform(0, 6)) + np.sin(1.1 * y + rng.uniform(0, 6)))
    number = np.arange((cells + 1) ** 2).reshape(cells + 1, cells + 1)
    a, b, c, d = number[:-1, :-1].ravel(), number[1:, :-1].ravel(), number[1:, 1:].ravel(), number[:-1, 1:].ravel()
    vertices = np.stack([x, y, z], axis=-1).reshape(-1, 3)
    return np.rint(vertices * 512) / 512, np.concatenate([np.stack([a, b, c], axis=1), np.stack([a, c, d], axis=1)])


@pytest.mark.parametrize("shape", ["nested", "overlapping", "standing"])
def test_cloth(device: torch.device, shape: str) -> None:
    """Two sheets as two bodies, and as one body that is tested against itself."""
    rng = np.random.default_rng(12)
    (x, faces), (y, others) = cloth(rng, 9, 0.4), cloth(rng, 7, 0.4)
    if shape == "nested":
        y, others = x + [0, 0, 3 / 512], faces  # 0.006 above it
    elif shape == "standing":
        y = y[:, [2, 0, 1]] + [1 / 512, 3 / 512, 1 / 512]
    whole = [(512 * k).astype(np.int64) for k in (x, y)]
    expected = crossings_of_meshes(whole[0], faces, whole[1], others)
    assert (len(expected) == 0) == (shape == "nested")
    scene = pgccd.Scene([pgccd.Mesh(x, faces), pgccd.Mesh(y, others)], device=device)
    both, all_faces = solids.joined((x, faces), (y, others))
    motion = at_rest(both, device)
    hits = pgccd.detect(scene, motion, "all")
    assert crossing_rows(hits) == sorted(expected)
    assert bool((hits.toi == 0).all()) and (len(hits) == 0) == (shape == "nested")
    own = pgccd.Scene([pgccd.Mesh(both, all_faces)], device=device, self_collision=True)
    within = crossing_rows(pgccd.detect(own, motion, "all"))
    assert within == sorted(crossings_within(np.concatenate(whole), all_faces)) and len(within) == len(expected)
    for report in ("any", "first", "earliest"):
        for one in (scene, own):
            assert (len(detected(one, motion, report)) > 0) == (shape != "nested")


def test_a_body_that_sticks_out_is_not_enclosed(device: torch.device) -> None:
    outer, rod = solids.box([0, 0, 0], [4, 4, 4]), solids.box([1, 1, 1], [2, 2, 9])
    motion = at_rest(np.concatenate([outer[0], rod[0]]), device)
    scene = pgccd.Scene([pgccd.Mesh(*outer), pgccd.Mesh(*rod)], device=device)
    assert len(pgccd.enclosed(scene, motion)) == 0
    assert pgccd.collide(scene, motion).pairs.tolist() == [[0, 1]]


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(25))
def test_a_million_pairs_of_triangles(device: torch.device, seed: int) -> None:
    rng = np.random.default_rng([13, seed])
    side, tolerance = [(intersecting.SIDE, None), (intersecting.SIDE, 0.0), (300, 0.0)][seed % 3]
    a, b = integer_pairs(rng, 40_200, side)
    scene, motion = intersecting.deforming_scene(rng, a, b, device, seed % 2 == 1)
    assert len(a) > 40_000 > intersecting.check_reports(a, b, scene, motion, seed % 2 == 0, tolerance=tolerance) > 9_000
