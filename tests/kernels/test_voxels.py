"""Boxes of triangles' sweeps, and their overlapping pairs, each found once over all voxels."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from support.origins import recentred
from support.same_bits import assert_same
from support.shapes import bumpy, tensors, turned, unit_quaternions

import pgccd
from pgccd import ops
from pgccd.baselines import PCCCD

BOX = np.dtype([("lower", "<f4", 3), ("upper", "<f4", 3), ("body", "<i4"), ("triangle", "<i4")])


def boxes_of(moving: pgccd.MovingBodies, size: float, separation: float = 0.0, tolerance: float = -1e-6) -> tuple:
    given = (moving.mesh_set, moving.tensors, moving.linear_path, size, separation, tolerance)
    voxels, counts = ops.voxels_touched(*given)
    return voxels, counts, ops.voxel_boxes(*given, voxels, counts)


def pairs_of(voxels: torch.Tensor, counts: torch.Tensor, boxes: torch.Tensor, size: float) -> torch.Tensor:
    segments = torch.stack([counts.cumsum(0) - counts, counts, torch.full_like(counts, 5)], dim=1)
    found = ops.voxel_pairs(boxes, segments, voxels, torch.arange(len(counts) + 1), size)
    return torch.from_numpy(np.array(sorted(map(tuple, found.tolist()))).reshape(-1, 4))


def crowd(rng: np.random.Generator, count: int, scale: float = 1.0) -> pgccd.MovingBodies:
    meshes = [bumpy(rng, 1), bumpy(rng, 0, size=0.3)]
    x0 = scale * rng.uniform(-2.0, 2.0, size=(count, 3))
    x1 = x0 + rng.normal(size=(count, 3))
    q0, q1 = unit_quaternions(rng, count), unit_quaternions(rng, count)
    scene = pgccd.Scene(meshes, rng.integers(2, size=count).tolist())
    return pgccd.MovingBodies.of(scene, pgccd.RigidMotion(*tensors(x0, q0, x1, q1)))


@pytest.mark.parametrize("size", [0.2, 0.5, 1.0, 3.0, 1000.0])
def test_each_pair_is_found_once(size: float) -> None:
    moving = crowd(np.random.default_rng(0), 12)
    *whole, packed = boxes_of(moving, 1e4)
    every = packed.numpy().view(BOX)[:, 0]
    every = np.unique(every, axis=0)  # the origin is the corner of eight voxels
    overlap = (every["lower"][:, None] <= every["upper"]) & (every["lower"] <= every["upper"][:, None])
    a, b = np.nonzero(overlap.all(axis=2) & (every["body"][:, None] < every["body"]))
    expected = np.stack(
        [every["body"][a] + 5, every["triangle"][a], every["body"][b] + 5, every["triangle"][b]], axis=1
    )
    expected = expected[np.lexsort(expected.T[::-1])]
    assert len(expected) > 100
    assert np.array_equal(pairs_of(*boxes_of(moving, size), size).numpy(), expected)


def test_boxes_whose_faces_lie_in_planes_of_the_grid() -> None:
    """Cubes at rest at integer coordinates: boxes touch, or share a face, in grid planes."""
    corners = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], dtype=float)
    faces = [[0, 1, 3], [0, 3, 2], [4, 6, 7], [4, 7, 5], [0, 4, 5], [0, 5, 1]]
    faces += [[2, 3, 7], [2, 7, 6], [0, 2, 6], [0, 6, 4], [1, 5, 7], [1, 7, 3]]
    cube = pgccd.Mesh(torch.from_numpy(corners), torch.tensor(faces))
    place = torch.from_numpy(np.random.default_rng(0).integers(-3, 4, size=(20, 3)).astype(float))
    still = torch.tensor([[1.0, 0.0, 0.0, 0.0]]).double().expand(20, 4)
    motion = pgccd.RigidMotion(place, still, place, still)
    for report in ("first", "all"):
        expected = pgccd.detect(pgccd.Scene([cube], [0] * 20), motion, report, tolerance=0.0)
        found = PCCCD.create([cube], 1.0, report=report, tolerance=0.0).detect(motion)
        assert len(expected) > 30 and torch.equal(found.pairs, expected.pairs)
        assert torch.equal(found.toi, expected.toi) and torch.equal(found.features, expected.features)


def test_bodies_about_joints_outside_of_them() -> None:
    rng = np.random.default_rng(3)
    meshes = [recentred(bumpy(rng, 1), joint) for joint in ([1.5, 0.0, 0.0], [0.0, 3.0, 1.0])]
    x = rng.uniform(-1.5, 1.5, size=(8, 3))
    turn = unit_quaternions(rng, 8), unit_quaternions(rng, 8)
    motion = pgccd.RigidMotion(*tensors(x, turn[0], x + 0.2, turn[1]))
    index = torch.tensor([0, 1] * 4)
    for report in ("first", "all"):
        expected = pgccd.detect(pgccd.Scene(meshes, index), motion, report, 0.05)
        found = PCCCD.create(meshes, 1.0, report=report, min_separation=0.05).detect(motion, mesh_index=index)
        assert len(expected) > 5
        assert_same(found, expected)


@pytest.mark.parametrize("scale", [1.0, 1e4])
@pytest.mark.parametrize("turn", [0.1, 3.0, 30.0])
def test_boxes_hold_triangles_all_along(turn: float, scale: float) -> None:
    """Boxes enclose the triangles grown by half of separation and tolerance throughout the step, and are not larger
    than the bulge of the arcs and float32 rounding require.
    """
    rng = np.random.default_rng(1)
    mesh, count, separation, tolerance = bumpy(rng, 1), 6, 0.02, 0.01
    x0 = scale * rng.uniform(-1.0, 1.0, size=(count, 3))
    x1, q0 = x0 + rng.normal(size=(count, 3)), unit_quaternions(rng, count)
    axis = rng.normal(size=(count, 3))
    rotation = turn * axis / np.linalg.norm(axis, axis=1, keepdims=True)
    motion = pgccd.RigidMotion.from_rotation(*tensors(x0, q0, x1, rotation))
    moving = pgccd.MovingBodies.of(pgccd.Scene([mesh], [0] * count), motion)
    packed = boxes_of(moving, 100.0 * scale, separation, tolerance)[2].numpy().view(BOX)[:, 0]
    triangles = moving.mesh_set[3].numpy()[:, :3]
    vertices = mesh.vertices.numpy()
    lower, upper = np.full((2, count, len(vertices), 3), np.inf)
    upper = -upper
    for t in np.linspace(0.0, 1.0, 401):
        position, orientation = motion.at(float(t))
        now = np.repeat(orientation.numpy(), len(vertices), axis=0)
        placed = turned(now, np.tile(vertices, (count, 1))).reshape(lower.shape) + position.numpy()[:, None]
        lower, upper = np.minimum(lower, placed), np.maximum(upper, placed)
    half = 0.5 * (separation + tolerance)
    for box in packed:
        corners = triangles[box["triangle"]]
        low = lower[box["body"]][corners].min(axis=0) - half
        high = upper[box["body"]][corners].max(axis=0) + half
        assert (box["lower"] <= low).all() and (box["upper"] >= high).all()
        capacity = 1e-6 * scale + min(turn**2 / 4.0, 4.0) * 1.5
        assert (box["lower"] >= low - capacity).all() and (box["upper"] <= high + capacity).all()


def test_boxes_of_bodies_that_do_not_turn_fit_to_float32() -> None:
    """Boxes end where the triangles do: without the separation they would not overlap those of bodies as far apart."""
    rng = np.random.default_rng(2)
    mesh = bumpy(rng, 1)
    turn = unit_quaternions(rng, 1)
    for separation in (0.0, 0.25):
        motion = pgccd.RigidMotion(*tensors(np.zeros((1, 3)), turn, np.ones((1, 3)), turn), path="linear")
        moving = pgccd.MovingBodies.of(pgccd.Scene([mesh]), motion)
        packed = boxes_of(moving, 1e3, separation, 0.0)[2].numpy().view(BOX)[:, 0]
        placed = turned(np.repeat(turn, len(mesh.vertices), axis=0), mesh.vertices.numpy())
        for box in packed:
            corners = placed[moving.mesh_set[3].numpy()[box["triangle"], :3]]
            low, high = corners.min(axis=0) - 0.5 * separation, corners.max(axis=0) + 1.0 + 0.5 * separation
            assert (box["lower"] <= low).all() and (box["lower"] > low - 2e-6).all()
            assert (box["upper"] >= high).all() and (box["upper"] < high + 2e-6).all()
