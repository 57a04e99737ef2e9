"""Meshes of points and segments, alone, mixed with triangles, with and without thickness."""

from __future__ import annotations

from fractions import Fraction

import numpy as np
import pytest
import torch
from oracle.surfaces import boundary_distance
from support.cases import few_and_many
from support.distances import Moving, assert_bounds_exactly, turned
from support.hierarchies import assert_encloses, prepared, walk
from support.shapes import bumpy, directions, tensors, unit_quaternions

import pgccd

MIXED = pgccd.Mesh(
    [[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1], [0.5, 0.5, 1.5], [1.5, 1.0, 0.2], [-0.7, 0.3, 0.1]],
    [[0, 1, 2], [0, 2, 3]],
    segments=[[1, 4], [4, 5]],
    points=[6],
)


def cloud(rng: np.random.Generator, count: int, radius: float = 0.0) -> pgccd.Mesh:
    return pgccd.Mesh.points(rng.uniform(-1.0, 1.0, (count, 3)), radius)


def wires(rng: np.random.Generator, count: int, radius: float = 0.0) -> pgccd.Mesh:
    """A polygonal line, and as many loose segments."""
    line = np.stack([np.arange(count), np.arange(1, count + 1)], axis=1)
    loose = count + 1 + np.arange(2 * count).reshape(-1, 2)
    return pgccd.Mesh.segments(rng.uniform(-1.0, 1.0, (3 * count + 1, 3)), np.concatenate([line, loose]), radius)


def shape(rng: np.random.Generator, kind: int) -> pgccd.Mesh:
    if kind == 0:
        return cloud(rng, int(rng.integers(1, 40)))
    if kind == 1:
        return wires(rng, int(rng.integers(1, 12)))
    return MIXED if kind == 2 else bumpy(rng, 1)


def pair(seed: int, first: int, second: int, path: str = "rigid") -> Moving:
    """Two bodies that pass by each other."""
    rng = np.random.default_rng([seed, first, second])
    meshes = [shape(rng, kind) for kind in (first, second)]
    start = np.array([[0.0, 0.0, 0.0], 3.0 * directions(rng, 1)[0]])
    end = np.array([[0.0, 0.0, 0.0], -2.0 * start[1] / 3.0 + 0.7 * rng.normal(size=3)])
    rotation = rng.choice([0.0, 0.5, 3.0]) * directions(rng, 2)
    return Moving(meshes, start, unit_quaternions(rng, 2), end, rotation, path, rng.uniform(0.01, 0.1, 2))


def distance_at(bodies: Moving, t: float) -> float:
    x, y = (bodies.vertices_at(body, t) for body in (0, 1))
    return boundary_distance(x, bodies.meshes[0].faces.numpy(), y, bodies.meshes[1].faces.numpy())


def least_before(bodies: Moving, toi: float, separation: float) -> float:
    """The least of 60 distances up to a time, without those that the speeds prove larger than the separation."""
    reach = [np.linalg.norm(mesh.vertices.numpy(), axis=1).max() for mesh in bodies.meshes]
    travel = np.linalg.norm(bodies.end[1] - bodies.start[1] - bodies.end[0] + bodies.start[0])
    speed = travel + sum(np.linalg.norm(turn) * r for turn, r in zip(bodies.rotation, reach, strict=True))
    t, least = 0.0, np.inf
    while t < toi:
        distance = distance_at(bodies, t)
        least, t = min(least, distance), t + max(toi / 59, (distance - separation) / speed)
    return min(least, distance_at(bodies, toi))


def gap_of(bodies: Moving, hits: pgccd.Contacts) -> np.ndarray:
    """(3,): from i to j at the first contact, by features and coordinates."""
    kind, (f, g), (u, v) = int(hits.kind[0]), hits.features[0].tolist(), hits.coordinates[0].tolist()
    x, y = (bodies.vertices_at(body, float(hits.toi[0])) for body in (0, 1))
    if kind == 2:
        (a, b), (c, d) = (mesh.edges[edge].tolist() for mesh, edge in zip(bodies.meshes, (f, g), strict=True))
        return ((1 - v) * y[c] + v * y[d]) - ((1 - u) * x[a] + u * x[b])
    side = 1 if kind == 0 else 0
    corners = (x, y)[side][bodies.meshes[side].faces[(f, g)[side]].long().numpy()]
    at = np.array([1 - u - v, u, v]) @ corners
    return at - x[f] if kind == 0 else y[g] - at


@pytest.mark.parametrize("path", ["rigid", "linear"])
@pytest.mark.parametrize("kinds", [(i, j) for i in range(4) for j in range(4) if (i, j) != (3, 3)])
def test_first_contacts_of_random_bodies(kinds: tuple[int, int], path: str, device: torch.device) -> None:
    """Never missed, never late, near the separation there."""
    met = 0
    for seed in range(6):
        bodies = pair(seed, *kinds, path)
        assert bodies.margin is not None
        separation = float(bodies.margin.sum())
        hits = pgccd.detect(bodies.scene(device), bodies.motion(device))
        toi = float(hits.toi[0]) if len(hits) else 1.0
        assert least_before(bodies, toi, separation) > separation - 1e-9
        if len(hits) == 0:
            continue
        met += 1
        assert (hits.status == 1).all()
        size = min(mesh.radius + margin for mesh, margin in zip(bodies.meshes, bodies.margin, strict=True))
        assert distance_at(bodies, toi) <= separation + 1.01e-6 * size + 1e-12
        gap, (normal,) = gap_of(bodies, hits), hits.normal.cpu().numpy()
        assert np.linalg.norm(gap) == pytest.approx(separation, rel=1e-4)
        assert np.linalg.norm(gap - np.linalg.norm(gap) * normal) < 1e-3 * separation
    assert met > 1


@pytest.mark.parametrize("kinds", [(i, j) for i in range(4) for j in range(i, 4)])
@few_and_many("seeds", 1, 3)
def test_distances_of_random_bodies(kinds: tuple[int, int], seeds: int, device: torch.device) -> None:
    for seed in range(seeds):
        bodies = pair(seed, *kinds)
        bodies.end[1] = bodies.start[1] + 0.3 * bodies.end[1]
        found = bodies.distance(device)
        assert found.converged.all()
        assert bodies.margin is not None
        truth = max(0.0, bodies.truth((0, 1)) - float(bodies.margin.sum()))
        assert float(found.lower[0]) <= truth + 1e-9 and truth - 1e-5 <= float(found.upper[0])


@pytest.mark.parametrize("kinds", [(i, j) for i in range(4) for j in range(i, 4)])
def test_distances_at_rest_are_exact(kinds: tuple[int, int], device: torch.device) -> None:
    for seed in range(3):
        bodies = pair(seed, *kinds)
        bodies.margin, bodies.end, bodies.rotation = None, bodies.start, np.zeros((2, 3))
        assert_bounds_exactly(bodies.distance(device), bodies)


@pytest.mark.parametrize("offset", [0.0, 1e6])
@pytest.mark.parametrize("scale", [1e-9, 1.0, 1e9])
def test_spheres_in_fractions(scale: float, offset: float, device: torch.device) -> None:
    """Of two spheres on straight ways: the time of contact is a root of a quadratic with known coefficients."""
    rng = np.random.default_rng(3)
    count, met, q = 300, 0, torch.tensor([[1.0, 0, 0, 0]], dtype=torch.float64, device=device)
    radii = scale * rng.uniform(0.1, 1.0, 4)
    meshes = [pgccd.Mesh.sphere(float(radius)) for radius in radii]
    kind = rng.integers(4, size=2 * count)
    x = scale * (rng.uniform(-1.0, 1.0, (2, 2 * count, 3)) + offset)
    x[:, 1::2] += scale * np.array([[[-2.5, 0, 0]], [[2.5, 0, 0]]])
    # Some graze, to the last bits.
    graze = np.arange(0, count, 3)
    x[:, 2 * graze] = x[:, 2 * graze + 1]
    both_radii = radii[kind[2 * graze]] + radii[kind[2 * graze + 1]]
    x[:, 2 * graze, 1] += both_radii * (1 + 1e-15 * rng.normal(size=len(graze)))
    x[1, 2 * graze] = x[0, 2 * graze]
    world = torch.arange(count, dtype=torch.int32, device=device).repeat_interleave(2)
    scene = pgccd.Scene(meshes, torch.tensor(kind), device, world=world)
    start, end = (torch.tensor(each, device=device) for each in x)
    hits = pgccd.detect(scene, pgccd.RigidMotion(start, q.expand(2 * count, 4), end, q.expand(2 * count, 4)))
    assert (hits.status == 1).all()
    toi = dict(zip(hits.pairs[:, 0].tolist(), hits.toi.tolist(), strict=True))
    exactly = np.vectorize(Fraction, otypes=[object])(x)
    for i in range(0, 2 * count, 2):
        first, last = (exactly[end, i + 1] - exactly[end, i] for end in (0, 1))
        way = last - first
        both = Fraction(float(radii[kind[i]])) + Fraction(float(radii[kind[i + 1]]))

        def gap(t: Fraction, first=first, way=way, both=both) -> Fraction:  # type: ignore[no-untyped-def]
            at = first + t * way
            return (at * at).sum() - both * both

        least = -(first * way).sum() / (way * way).sum()
        least = min(max(least, Fraction(0)), Fraction(1))
        if i not in toi:
            assert gap(least) > 0  # apart at the nearest, so always
            continue
        met += 1
        time = Fraction(toi[i])
        at = first + time * way
        allowed = both + Fraction(1.0001e-6) * Fraction(float(min(radii[kind[i]], radii[kind[i + 1]])))
        assert (at * at).sum() <= allowed * allowed
        assert time <= least or gap(least) > 0
        assert time == 0 or gap(time) >= 0  # not late
    assert met > count // 2


def test_points_of_one_place_touch_where_they_meet(device: torch.device) -> None:
    """Without thickness, on one line."""
    point = pgccd.Mesh.points([[0.0, 0.0, 0.0]])
    x0, x1, q = tensors([[0.0, 0, 0], [4.0, 0, 0]], [[2.0, 0, 0], [1.0, 0, 0]], [[1.0, 0, 0, 0]] * 2, device=device)
    hits = pgccd.detect(pgccd.Scene([point, point], device=device), pgccd.RigidMotion(x0, q, x1, q))
    assert hits.toi.item() == pytest.approx(0.8, abs=1e-12) and hits.toi.item() <= 0.8


def test_elements_are_named(device: torch.device) -> None:
    """Kinds, features, and the vertices of stencils."""
    point, rod = pgccd.Mesh.sphere(0.25), pgccd.Mesh.capsule(0.25, 2.0)
    box = pgccd.Mesh.box([1.0, 1.0, 1.0])
    cases = [
        ((point, point), 0, (0, 0)),
        ((point, rod), 0, (0, 0)),
        ((rod, point), 1, (0, 0)),
        ((rod, rod), 2, (0, 0)),
        ((point, box), 0, None),
        ((box, point), 1, None),
    ]
    for meshes, kind, features in cases:
        turn = [[0.8, 0.6, 0.0, 0.0], [0.8, 0.0, 0.6, 0.0]]
        x0, x1, q = tensors([[0.0, 0, 0], [5.0, 0.1, 0.05]], [[0.0, 0, 0], [0.0, 0.1, 0.05]], turn, device=device)
        scene = pgccd.Scene(list(meshes), device=device)
        hits = pgccd.detect(scene, pgccd.RigidMotion(x0, q, x1, q))
        assert hits.kind.tolist() == [kind]
        if features is not None:
            assert [tuple(row) for row in hits.features.tolist()] == [features]
        length = torch.linalg.vector_norm(hits.normal, dim=1)
        assert torch.allclose(length, torch.ones_like(length))


@pytest.mark.parametrize("count", [500, 20_000])
def test_a_cloud_is_its_points(count: int, device: torch.device) -> None:
    """One mesh of many points finds the contacts of as many bodies."""
    rng = np.random.default_rng(5)
    x = rng.uniform(-1.0, 1.0, (count, 3))
    ball = bumpy(rng, 2)
    start, end, turn = [2.5, 0.1, 0.2], [-1.0, 0.0, 0.1], unit_quaternions(rng, 1)[0].tolist()
    one = [1.0, 0.0, 0.0, 0.0]
    x0, x1, q = tensors([start, [0.0, 0, 0]], [end, [0.0, 0, 0]], [turn, one], device=device)
    scene = pgccd.Scene([ball, pgccd.Mesh.points(x, 0.02)], device=device)
    every = pgccd.detect(scene, pgccd.RigidMotion(x0, q, x1, q), "all")
    x0, x1, q = tensors([start, *x.tolist()], [end, *x.tolist()], [turn, *[one] * count], device=device)
    index = torch.tensor([0, *[1] * count])
    static = torch.tensor([False, *[True] * count], device=device)
    apart = pgccd.Scene([ball, pgccd.Mesh.sphere(0.02)], index, device, static=static)
    others = pgccd.detect(apart, pgccd.RigidMotion(x0, q, x1, q), "all")
    assert len(every) > 300

    # By kind, feature of the ball, and point.
    keys = torch.cat([every.kind[:, None], every.features], 1).tolist()
    first = {tuple(key): toi for key, toi in zip(keys, every.toi.tolist(), strict=True)}
    keys = torch.cat([others.kind[:, None], others.features[:, :1], others.pairs[:, 1:] - 1], 1).tolist()
    second = {tuple(key): toi for key, toi in zip(keys, others.toi.tolist(), strict=True)}
    assert first.keys() == second.keys()
    assert max(abs(first[key] - second[key]) for key in first) < 1e-5


def test_no_feature_pair_twice(device: torch.device) -> None:
    rng = np.random.default_rng(6)
    meshes = [MIXED, cloud(rng, 30, 0.3), wires(rng, 9, 0.2)]
    x, q = tensors(rng.uniform(-0.5, 0.5, (6, 3)).tolist(), [[1.0, 0, 0, 0]] * 6, device=device)
    scene = pgccd.Scene(meshes, [0, 1, 2, 0, 1, 2], device)
    hits = pgccd.detect(scene, pgccd.RigidMotion.at_rest(x, q), "all")
    rows = torch.cat([hits.pairs, hits.kind[:, None], hits.features], 1).tolist()
    assert len({tuple(row) for row in rows}) == len(rows) > 100
    # Two points are one pair, as vertex of i and face of j.
    of_clouds = hits.kind[(hits.pairs[:, 0] == 1) & (hits.pairs[:, 1] == 4)]
    assert len(of_clouds) > 10 and (of_clouds == 0).all()


def test_deforming_wires_meet_themselves(device: torch.device) -> None:
    """A chain that is pulled through itself, and loose points of the same body."""
    x = torch.tensor([[0.0, 0, 0], [1, 0, 0], [2, 0, 0], [2, 1, 0], [1, 1, 1], [1, -1, 1], [0.5, 0.0, 3.0]])
    mesh = pgccd.Mesh(x, segments=[[0, 1], [1, 2], [2, 3], [3, 4], [4, 5]], points=[6], thickness=0.05)
    x = x.to(device, torch.float64)
    end = x.clone()
    end[4, 2] = end[5, 2] = -1.0
    end[6] = torch.tensor([0.5, 0.0, -1.0])
    scene = pgccd.Scene([mesh], device=device, self_collision=True)
    hits = pgccd.detect(scene, pgccd.VertexMotion(x, end), "all")
    assert [1, 4] in hits.features[hits.kind == 2].tolist()
    assert [6, 0] in hits.features[hits.kind == 0].tolist()
    by_features = {tuple(f): t for f, t in zip(hits.features.tolist(), hits.toi.tolist(), strict=True)}
    assert by_features[6, 0] == pytest.approx((3.0 - 0.1) / 4.0, abs=1e-6)


def test_spheres_inside_solids_and_around_bodies(device: torch.device) -> None:
    box = pgccd.Mesh.box([4.0, 4.0, 4.0], solid=True)
    small = pgccd.Mesh.box([0.2, 0.2, 0.2])
    x, q = tensors([[0.0, 0, 0], [0.3, 0.2, 0.1]], [[1.0, 0, 0, 0]] * 2, device=device)
    inside = pgccd.detect(pgccd.Scene([box, pgccd.Mesh.sphere(0.1)], device=device), pgccd.RigidMotion.at_rest(x, q))
    assert inside.kind.tolist() == [pgccd.Kind.INSIDE] and inside.features.tolist() == [[-1, 0]]
    around = pgccd.detect(pgccd.Scene([pgccd.Mesh.sphere(1.0), small], device=device), pgccd.RigidMotion.at_rest(x, q))
    assert around.toi.tolist() == [0.0]
    scene = pgccd.Scene([pgccd.Mesh.sphere(1.0), small], device=device)
    assert pgccd.distance(scene, pgccd.RigidMotion.at_rest(x, q), cutoff=1.0).upper.tolist() == [0.0]


@pytest.mark.parametrize("deforms", [False, True])
def test_the_tolerance_of_a_sphere_is_part_of_its_radius(deforms: bool, device: torch.device) -> None:
    """Its SBV is a point. Bodies that turn touch within the tolerance."""
    for gap, met in ((1e-8, 1), (1e-5, 0)):
        x, q = tensors([[0.0, 0, 0], [1.0 + gap, 0, 0]], [[1.0, 0, 0, 0], [0.8, 0.6, 0, 0]], device=device)
        sphere = pgccd.Mesh.sphere(0.4)
        scene = pgccd.Scene([sphere, sphere], device=device, margin=0.1)
        if deforms:
            assert len(pgccd.detect(scene, pgccd.VertexMotion(x, x), tolerance=0.0)) == 0
            continue
        assert len(pgccd.detect(scene, pgccd.RigidMotion(x, q.flip(0), x, q))) == met


@pytest.mark.parametrize("count", [20_000, 3_000])
def test_hierarchies_of_large_meshes_contain_them(count: int) -> None:
    """Clouds of many points are put in order first."""
    rng = np.random.default_rng(count)
    x = rng.uniform(-1.0, 1.0, (count, 3))
    side = int(np.sqrt(count))
    number = np.arange(side * side).reshape(side, side)
    corners = [number[i : side - 1 + i, j : side - 1 + j].ravel() for i, j in ((0, 0), (0, 1), (1, 1), (1, 0))]
    faces = np.concatenate([np.stack([corners[0], corners[1], corners[2]], 1), np.stack(corners, 1)[:, [0, 2, 3]]])
    segments = np.stack([np.arange(count - 1), np.arange(1, count)], axis=1)
    for mesh in (pgccd.Mesh.points(x), pgccd.Mesh(x, faces), pgccd.Mesh(x, faces, segments=segments, points=[0, 5])):
        triangles, blocks, links = prepared(mesh)
        assert_encloses(blocks, links, triangles, mesh.vertices.numpy() - mesh.centre_offset.numpy())
        assert np.array_equal(np.sort(triangles[:, 6]), np.arange(len(mesh.faces)))
        assert np.array_equal(triangles[:, :3], mesh.faces.numpy()[triangles[:, 6]])
        found, deepest = walk(links)
        assert deepest <= 48
        leaf_points = mesh._leaf_points.view(-1, 32).numpy()
        rows = mesh._node_links.reshape(-1, 4).numpy()
        for first, many, begin, points in rows[rows[:, 1] > 0][::97].tolist():
            listed = set(leaf_points[begin : begin + points, 24:].view(np.int32).ravel().tolist())
            assert listed == set(triangles[first : first + many, :3].ravel().tolist())


def test_normals_and_gradients(device: torch.device) -> None:
    """Of spheres, rods and a floor, whose derivatives are known."""
    ball, rod, floor = pgccd.Mesh.sphere(0.5), pgccd.Mesh.capsule(0.25, 2.0), pgccd.Mesh.box([20.0, 20.0, 1.0])
    x0, x1, q = tensors(
        [[0.0, 0.3, 3.0], [5.0, 0.1, 3.0], [0.0, 0.0, -0.5], [5.2, 0.0, 9.0]],
        [[0.0, 0.3, 0.0], [5.0, 0.1, 0.0], [0.0, 0.0, -0.5], [5.2, 0.0, 0.0]],
        [[1.0, 0, 0, 0], [0.5**0.5, 0, 0.5**0.5, 0], [1.0, 0, 0, 0], [1.0, 0, 0, 0]],
        device=device,
    )
    scene = pgccd.Scene([ball, rod, floor], [0, 1, 2, 0], device)
    for normals in ("features", "surface"):
        start = x0.clone().requires_grad_(normals == "features")
        hits = pgccd.detect(scene, pgccd.RigidMotion(start, q, x1, q), normals=normals)  # type: ignore[arg-type]
        assert hits.pairs.tolist() == [[0, 2], [1, 2], [1, 3], [2, 3]]
        up, down = [0.0, 0.0, -1.0], [0.0, 0.0, 1.0]
        assert torch.allclose(
            hits.normal[[0, 1, 3]].cpu(), torch.tensor([up, up, down], dtype=torch.float64), atol=1e-9
        )
        if normals == "surface":
            continue
        (of_first,) = torch.autograd.grad(hits.toi[0], start)
        # z (1 - t) = 0.5 at z = 3: dt / dz = (1 - t) / z
        assert of_first[0].tolist() == pytest.approx([0.0, 0.0, (0.5 / 3.0) / 3.0], abs=1e-6)
    at = pgccd.approach_rates(scene, pgccd.RigidMotion(x0, q, x1, q), hits)
    assert (at > 0.0).all()
    assert len(pgccd.approaching(scene, pgccd.RigidMotion(x0, q, x1, q), hits)) == 4
    # Apart again: of two that begin in contact, those that move away are left out.
    y0, y1 = x0[:2].clone(), x0[:2].clone()
    y0[1] = y1[1] = y0[0] + torch.tensor([0.75, 0.0, 0.0], device=device)
    y1[1, 0] += 1.0
    pair = pgccd.Scene([ball, rod], device=device)
    away = pgccd.RigidMotion(y0, q[[0, 0]], y1, q[[0, 0]])
    touching = pgccd.detect(pair, away, tolerance=1e-3)
    assert len(touching) == 1 and len(pgccd.approaching(pair, away, touching, slack=1e-3)) == 0


@pytest.mark.parametrize("deforms", [False, True])
def test_points_of_clouds_inside_solids(deforms: bool, device: torch.device) -> None:
    """Each is a piece of its own; off the origin of the cloud, which turns."""
    rng = np.random.default_rng(11)
    x = rng.uniform(-3.0, 3.0, (3000, 3)) + [5.0, 1.0, 0.0]
    cloud, box = pgccd.Mesh.points(x), pgccd.Mesh.box([1.0, 2.0, 3.0], solid=True)
    turn = unit_quaternions(rng, 1)[0]
    place = turned(turn, x) + [1.0, 2.0, 3.0]
    centre = place[17] + [0.1, 0.2, 0.3]
    is_inside = (np.abs(place - centre) < [0.5, 1.0, 1.5]).all(axis=1)
    if deforms:
        (vertices,) = tensors(np.concatenate([place, box.vertices.numpy() + centre]).tolist(), device=device)
        motion: pgccd.RigidMotion | pgccd.VertexMotion = pgccd.VertexMotion(vertices, vertices)
    else:
        at, q = tensors([[1.0, 2.0, 3.0], centre.tolist()], [turn.tolist(), [1.0, 0, 0, 0]], device=device)
        motion = pgccd.RigidMotion.at_rest(at, q)
    hits = pgccd.detect(pgccd.Scene([cloud, box], device=device), motion, "all")
    found = sorted(hits.features[hits.kind == pgccd.Kind.INSIDE][:, 0].tolist())
    assert found == np.flatnonzero(is_inside).tolist() and len(found) > 5


def test_arguments_are_named() -> None:
    x = np.zeros((3, 3))
    x[1, 0] = x[2, 1] = 1.0
    wrong = [
        (lambda: pgccd.Mesh(x), "faces: the mesh holds no triangles, segments or points"),
        (lambda: pgccd.Mesh(x, segments=[[0, 3]]), r"segments: segment 0 is \[0, 3\], but there are 3 vertices"),
        (lambda: pgccd.Mesh(x, segments=[[0, 1], [2, 2]]), r"segments: segment 1 repeats a vertex: \[2, 2\]"),
        (lambda: pgccd.Mesh(x, segments=[0, 1]), r"segments: expected shape \(n, 2\)"),
        (lambda: pgccd.Mesh(x, points=[0, -1]), r"points: point 1 is \[-1\]"),
        (lambda: pgccd.Mesh(x, points=[1, 1]), "points: vertex 1 is listed twice"),
        (lambda: pgccd.Mesh(x, points=[[0], [1]]), r"points: expected shape \(n,\)"),
        (lambda: pgccd.Mesh.points(x, -1.0), "radius: "),
        (lambda: pgccd.Mesh.segments(x, [[0, 1]], float("nan")), "radius: "),
        (lambda: pgccd.Mesh.sphere(0.0), "radius: expected a finite length > 0"),
        (lambda: pgccd.Mesh.capsule(0.1, 0.0), "length: expected a finite length > 0"),
        (lambda: pgccd.Mesh(x, segments=[[0, 1]], solid=True), "solid: .* the mesh has segments or points"),
    ]
    for make, message in wrong:
        with pytest.raises(ValueError, match=message):
            make()  # type: ignore[no-untyped-call]
    with pytest.raises(TypeError, match="points: expected integers"):
        pgccd.Mesh(x, points=[0.5])
    assert not pgccd.Mesh(x, segments=[[0, 1]], solid="auto").solid


def test_states_keep_elements() -> None:
    again = pgccd.Mesh.from_state_dict(MIXED.state_dict())
    assert torch.equal(again.faces, MIXED.faces) and torch.equal(again._triangles, MIXED._triangles)
    state = MIXED.state_dict()
    state["faces"] = state["faces"].flip(0)
    with pytest.raises(ValueError, match="faces: expected triangles, then segments"):
        pgccd.Mesh.from_state_dict(state)


def test_leaves_have_elements_of_one_kind() -> None:
    rng = np.random.default_rng(8)
    x = rng.uniform(-1.0, 1.0, (4000, 3))
    faces, segments = np.arange(3000).reshape(-1, 3), np.arange(3000, 3600).reshape(-1, 2)
    mesh = pgccd.Mesh(x, faces, segments=segments, points=np.arange(3600, 4000))
    kind = mesh._triangles[:, 7].numpy() >> 6
    assert np.array_equal(kind, np.repeat([0, 1, 2], [1000, 300, 400]))
    links = mesh._node_links.reshape(-1, 4)
    full = 0
    for first, count, _, rows in links.tolist():
        if count > 0:
            assert len(set(kind[first : first + count].tolist())) == 1
            full += count == 8 and kind[first] == 2
            assert kind[first] != 2 or rows == 1
    assert full == 50  # all 400 points
    assert mesh._corners.shape == (9, 1300 + 8)


def test_many_points_take_little_memory() -> None:
    rng = np.random.default_rng(9)
    scene = pgccd.Scene([pgccd.Mesh.points(rng.uniform(-1.0, 1.0, (100_000, 3)))])
    assert sum(column.numel() * column.element_size() for column in scene.meshes.tensors) <= 120 * 100_000
