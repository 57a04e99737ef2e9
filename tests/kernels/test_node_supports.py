"""Support samples of nodes: bounds of what a node holds, in exact arithmetic, and pairs that touch along the line of
their centres, where these bounds are attained.
"""

from __future__ import annotations

from fractions import Fraction
from typing import Literal

import numpy as np
import pytest
import torch
from strategies import contacts
from strategies.contacts import Meetings
from support.candidates import BARELY, assert_all_there, assert_touching, candidates, missed, moving
from support.cases import few_and_many
from support.hierarchies import Hierarchy, prepared
from support.shapes import Bodies, bumpy, directions, turned, unit_quaternions
from support.truth import rigid_truth

import pgccd

STEP = Fraction(7, 1024)
# Integer multiples by 3 of the directions of samples (6, 4, 4, 3): face, p, q.
GRID = np.zeros((6, 4, 4, 3), dtype=int)
for axis in range(3):
    for face, side in ((2 * axis, 3), (2 * axis + 1, -3)):
        GRID[face, :, :, axis] = side
        GRID[face, :, :, (axis + 1) % 3] = (2 * np.arange(4) - 3)[:, None]
        GRID[face, :, :, (axis + 2) % 3] = 2 * np.arange(4) - 3


def samples(mesh: pgccd.Mesh) -> np.ndarray:
    """(nodes, 6, 4, 4): the bytes of all slots."""
    words = Hierarchy.of(mesh).supports.numpy().reshape(-1, 24).view(np.uint32)
    return np.stack([(words >> shift) & 255 for shift in (0, 8, 16, 24)], axis=-1).reshape(-1, 6, 4, 4)


def nodes_of(mesh: pgccd.Mesh) -> list[tuple[int, np.ndarray, float, np.ndarray]]:
    """Number, centre, radius and vertices (n, 3) of each node; float64 numbers relative to the SBV centre."""
    triangles, blocks, links = prepared(mesh)
    local = (mesh.vertices - mesh.centre_offset).numpy()

    def vertices(node: int) -> set[int]:
        first, count = links[node // 8, node % 8, :2]
        if count < 0:
            return set()
        if count > 0:
            return set(triangles[first : first + count, :3].ravel().tolist())
        return set().union(*(vertices(8 * int(first) + slot) for slot in range(8)))

    out = []
    for node in range(8 * len(links)):
        if links[node // 8, node % 8, 1] >= 0:
            block, slot = blocks[node // 8], node % 8
            points = local[sorted(vertices(node))]
            out.append((node, block[:3, slot].astype(float), float(block[3, slot]), points))
    return out


def assert_samples_bound(mesh: pgccd.Mesh) -> None:
    """Asserts in rational arithmetic that each sample is at least the support function, and the smallest such number of
    steps, to within rounding.
    """
    given = samples(mesh)
    for node, centre, radius, points in nodes_of(mesh):
        step = Fraction(radius) * STEP
        around = [[Fraction(x) - Fraction(c) for x, c in zip(p, centre, strict=True)] for p in points]
        slack = Fraction(4e-14) * (Fraction(float(np.abs(centre).sum())) + Fraction(radius))
        for at in np.ndindex(6, 4, 4):
            along = [Fraction(int(n), 3) for n in GRID[at]]
            support = max(sum(a * x for a, x in zip(along, p, strict=True)) for p in around)
            steps = int(given[(node, *at)])
            assert support <= steps * step
            assert steps == 0 or support + slack > (steps - 1) * step


def shapes(rng: np.random.Generator) -> list[pgccd.Mesh]:
    """Needles, plates, single triangles, bumpy spheres; some far from the origin of their frame, or tiny or huge."""

    def posed(mesh: pgccd.Mesh, size: float = 1.0, offset: float = 0.0) -> pgccd.Mesh:
        q = np.tile(unit_quaternions(rng, 1), (len(mesh.vertices), 1))
        x = size * turned(q, mesh.vertices.numpy()) + offset * rng.normal(size=3)
        return pgccd.Mesh(x, mesh.faces)

    triangle = pgccd.Mesh(rng.normal(size=(3, 3)), [[0, 1, 2]])
    sliver = pgccd.Mesh(np.array([[0.0, 0, 0], [1, 0, 0], [0.5, 1e-9, 0]]), [[0, 1, 2]])
    plain = [contacts.spindle(1e-4, 3), contacts.plate(3), triangle, sliver, bumpy(rng, 1)]
    return [posed(m, size, offset) for m in plain for size, offset in ((1.0, 0.0), (1e-20, 0.0), (1e20, 0.0), (1, 1e6))]


def test_samples_bound_the_vertices() -> None:
    rng = np.random.default_rng(1)
    for mesh in shapes(rng):
        assert_samples_bound(mesh)


def test_a_node_of_no_size() -> None:
    """The vertices of its triangles are at one place: the slack is more than 255 steps."""
    corners = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]])
    specks = np.tile([0.3, 0.7, 100.9], (24, 1))
    x = np.concatenate([*(corners + [3.0 * k, 0, 0] for k in range(8)), specks])
    mesh = pgccd.Mesh(x, np.arange(len(x)).reshape(-1, 3))
    node, centre, radius, points = min(nodes_of(mesh), key=lambda of: of[2])
    assert radius < 1e-5 and (points == points[0]).all()
    reach = samples(mesh)[node] * float(STEP) * radius
    assert (reach >= np.tensordot(GRID / 3.0, points[0] - centre, axes=1)).all()


def test_a_vertex_beyond_a_step_by_less_than_rounding() -> None:
    """Only the slack before rounding up covers it."""
    for k in (40, 100, 140):
        far = np.array([[0.0, 0, 1], [0, 0, -1], [0, 1, 0], [0, -1, 0]])
        faces = [[0, 2, 4], [2, 1, 4], [1, 3, 4], [3, 0, 4], [0, 5, 2], [2, 5, 1], [1, 5, 3], [3, 5, 0]]
        radius = float(np.float32(1.0) + np.float32(2.0**-23))
        for beyond in (0.0, 1e-19, 1e-17):
            tip = np.array([radius * k * 7 / 1024, 0.0, beyond])
            mesh = pgccd.Mesh(np.concatenate([far, [tip, -tip]]), faces)
            ((node, centre, found, _),) = nodes_of(mesh)
            assert node == 0 and found == radius and not centre.any() and not mesh.centre_offset.any()
            assert_samples_bound(mesh)


@pytest.mark.parametrize("name", ["needle", "plate", "bumpy"])
def test_interpolation_bounds_every_direction(name: str) -> None:
    """What the kernel computes from the samples, here in float64, at random directions and at edges of the cube."""
    rng = np.random.default_rng(2)
    meshes = {"needle": contacts.spindle(1e-3, 3), "plate": contacts.plate(4), "bumpy": bumpy(rng, 2)}
    mesh = meshes[name]
    given = samples(mesh)
    along = np.concatenate([directions(rng, 400), rng.integers(-1, 2, (60, 3)) + 1e-9 * rng.normal(size=(60, 3))])
    size = np.abs(along).max(axis=1)
    axis = np.abs(along).argmax(axis=1)
    row = np.arange(len(along))
    face = 2 * axis + (along[row, axis] < 0)
    place = [1.5 * along[row, (axis + k) % 3] / size + 1.5 for k in (1, 2)]
    cell = [np.clip(p.astype(int), 0, 2) for p in place]
    part = [p - c for p, c in zip(place, cell, strict=True)]
    total = 0.0
    for node, centre, radius, points in nodes_of(mesh):
        exact = ((points - centre) @ along.T).max(axis=0)
        bound = np.zeros(len(along))
        for i in (0, 1):
            for j in (0, 1):
                weight = abs(1 - i - part[0]) * abs(1 - j - part[1])
                bound += weight * given[node][face, cell[0] + i, cell[1] + j]
        bound *= size * float(STEP) * radius
        assert (bound >= exact - 1e-9 * radius).all()
        total += float(((bound - exact) / radius).mean())
    assert total / len(nodes_of(mesh)) < 0.25  # not far above


def kite(along: np.ndarray) -> pgccd.Mesh:
    """A leaf about the origin with a tip on each side, vertices 0 and 1, at a whole number of steps along a direction
    of samples; its sphere and its slab reach further.
    """
    unit = along / np.linalg.norm(along)
    side = np.cross(unit, [0.3, -0.5, 0.8])
    side /= np.linalg.norm(side)
    other = np.cross(unit, side)
    longest = float(np.linalg.norm(along))  # of a direction, in the units of its face
    steps = int(0.8 * longest * 1024 / 7)
    reach = steps * 7 / 1024 / longest * (1.0 - 1e-6)
    x = np.array([reach * unit, -reach * unit, side, -side, 0.9 * other, -0.9 * other])
    faces = [[0, 2, 4], [0, 4, 3], [0, 3, 5], [0, 5, 2], [1, 4, 2], [1, 3, 4], [1, 5, 3], [1, 2, 5]]
    return pgccd.Mesh(x, faces)


def kites(rng: np.random.Generator, separation: float, time: float, speed: float = 0.0, spin: float = 0.0) -> Meetings:
    """Pairs of kites that meet tip to tip at `time`, in each direction of samples, the second moving along the line of
    their centres, both turning about it.
    """
    grid = np.unique(GRID.reshape(-1, 3), axis=0) / 3.0
    n = len(grid)
    meshes, orientation, rotation, velocity, line = [], [], [], [], []
    for along in grid:
        mesh = kite(along)
        q = unit_quaternions(rng, 1)[0]
        way = turned(q[None], along[None] / np.linalg.norm(along))[0]
        meshes += [mesh, mesh]
        orientation += [q, q]
        rotation += [spin * way, -spin * way]
        velocity += [np.zeros(3), speed * way]
        line.append(way)
        assert len(Hierarchy.of(mesh).links) == 1
    return contacts.meet(
        meshes,
        [((0,), (1,))] * n,
        [([1.0], [1.0])] * n,
        np.array(orientation),
        np.array(rotation),
        np.array(velocity),
        np.full(n, time),
        separation * np.array(line),
    )


@pytest.mark.parametrize("separation", [0.0, 2.0**-10, 0.25, 1.0])
def test_tips_rest_at_the_separation(device: torch.device, separation: float) -> None:
    meetings = kites(np.random.default_rng(3), separation, 0.0)
    assert_touching(meetings, separation + BARELY)
    for path in ("rigid", "linear"):
        assert missed(meetings, device, separation + BARELY, path=path) == []


@pytest.mark.parametrize(("time", "speed"), [(0.0, 0.4), (1.0, -0.4)])
@pytest.mark.parametrize("spin", [0.0, 1.0, 12.0])
def test_tips_meet_at_one_end_of_the_step(device: torch.device, time: float, speed: float, spin: float) -> None:
    """Turning about the line of centres: of many segments only the first or the last one has the contact."""
    meetings = kites(np.random.default_rng(4), 0.0, time, speed, spin)
    assert_touching(meetings, BARELY)
    assert missed(meetings, device, BARELY) == []


@pytest.mark.parametrize("gap", [1e-4, 1e-3])
def test_tips_slightly_apart(device: torch.device, gap: float) -> None:
    meetings = kites(np.random.default_rng(5), gap, 0.0)
    pairs = torch.tensor(meetings.pairs, device=device)
    bodies = pgccd.MovingBodies.of(meetings.bodies.scene(device), meetings.bodies.motion("rigid", device))
    assert len(pgccd.traverse.find_candidates(bodies, pairs, 0.0, 0.0)[0]) == 0
    assert len(set(pgccd.traverse.find_candidates(bodies, pairs, 2.0 * gap, 0.0)[0][:, 0].tolist())) == len(pairs)


def test_few_splits(device: torch.device) -> None:
    """Of ellipsoids with overlapping spheres. Spheres and slabs alone need 330 tests a pair."""
    rng = np.random.default_rng(6)
    ball = pgccd.Mesh.icosphere(1.0, 3)
    mesh = pgccd.Mesh(ball.vertices.numpy() * [1.0, 0.5, 0.3], ball.faces)
    n = 40
    position = np.zeros((n, 2, 3))
    position[:, 1] = 1.3 * directions(rng, n)
    still = np.zeros((2 * n, 3))
    bodies = Bodies([mesh] * (2 * n), position.reshape(-1, 3), unit_quaternions(rng, 2 * n), still, still)
    pairs = torch.arange(2 * n, device=device).view(-1, 2)
    _, node_tests = pgccd.traverse.find_candidates(moving(bodies, device), pairs, 0.0, 0.0)
    assert int(node_tests) < 220 * n


@few_and_many("seeds", 2, 4)
@pytest.mark.parametrize("turn", [0.0, 1.0, 9.0])
def test_slender_flat_and_far_bodies(device: torch.device, turn: float, seeds: int) -> None:
    """Every feature pair that touches on exact arcs is a candidate."""
    touching = 0
    for seed in range(seeds):
        rng = np.random.default_rng([7, seed, int(turn)])
        kinds = [contacts.spindle(0.01, 2), contacts.plate(2), pgccd.Mesh(rng.normal(size=(3, 3)), [[0, 1, 2]])]
        first, second = rng.permutation(3)[:2]
        meshes = [kinds[first], kinds[second]]
        origin: Literal["centroid"] | np.ndarray = 30.0 * rng.normal(size=3) if seed % 2 else "centroid"
        meshes = [pgccd.Mesh(m.vertices, m.faces, origin if turn < 2.0 else "centroid") for m in meshes]
        q, spin = unit_quaternions(rng, 2), turn * directions(rng, 2)
        if seed % 2 and turn < 2.0:
            spin *= 0.03
        centre = np.stack([turned(q[k][None], m.centre_offset.numpy()[None])[0] for k, m in enumerate(meshes)])
        place = np.stack([np.zeros(3), 0.3 * directions(rng, 1)[0]]) - centre
        bodies = Bodies(meshes, place, q, np.stack([np.zeros(3), 0.5 * rng.normal(size=3)]), spin)
        truth = rigid_truth(bodies)
        touching += len(truth.contacts)
        assert_all_there(candidates(moving(bodies, device))[0], truth)
    assert touching > 0
