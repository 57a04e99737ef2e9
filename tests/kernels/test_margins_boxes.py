"""Margins of the broad phase's boxes: points that stray as far as is allowed for, and boxes that just touch."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
from support.origins import recentred
from support.shapes import directions, tensors, turned, unit_quaternions

import pgccd

U = 2.0**-53


def columns_of(bodies: pgccd.MovingBodies) -> dict[str, np.ndarray]:
    """Columns of csrc/core/moving_box.h, lengths in scene units."""
    assert bodies.boxes is not None
    rows = bodies.boxes.cpu().double().numpy()
    unit = rows[:, :1]
    return {
        "growth": (unit * rows[:, 1:2])[:, 0],
        "centre": unit[..., None] * rows[:, 2:8].reshape(-1, 2, 3),
        "half": unit[..., None, None] * rows[:, 8:26].reshape(-1, 2, 3, 3),
        "slender": rows[:, 1] < 0.75,
    }


def rotated(axis: np.ndarray, angle: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Points (n, 3) turned about unit axes (n, 3)."""
    across = np.cross(axis, points)
    return points + np.sin(angle)[:, None] * across + (1 - np.cos(angle))[:, None] * np.cross(axis, across)


def assert_enclosed(mesh: pgccd.Mesh, orientation: np.ndarray, rotation: np.ndarray, path: Any) -> float:
    """Asserts that vertices are in the boxes at both ends, and stray from the straight way by `growth` at most. Returns
    the largest part of `growth` that was needed.
    """
    count, rng = len(orientation), np.random.default_rng(0)
    position, velocity = rng.normal(size=(2, count, 3))
    motion = pgccd.RigidMotion.from_velocity(*tensors(position, orientation, velocity, rotation), dt=1.0, path=path)
    bodies = pgccd.MovingBodies.of(pgccd.Scene([mesh], torch.zeros(count, dtype=torch.int32)), motion)
    boxes = columns_of(bodies)
    assert boxes["slender"].all()
    angle = np.linalg.norm(rotation, axis=1)
    axis = rotation / np.where(angle > 0, angle, 1.0)[:, None]
    centres = bodies.centre_t0.numpy(), bodies.centre_t1.numpy()
    most = 0.0
    for vertex in mesh.vertices.numpy():
        from_origin = turned(orientation, np.tile(vertex, (count, 1)))

        def at(time: float, offset: np.ndarray = from_origin) -> np.ndarray:
            return position + time * velocity + rotated(axis, time * angle, offset)

        ends = at(0.0), at(1.0)
        for end in range(2):
            local = ends[end] - centres[end] - boxes["centre"][:, end]
            half = boxes["half"][:, end]
            length = np.linalg.norm(half, axis=2)
            beyond = np.abs(np.einsum("nkc,nc->nk", half, local)) / length - length
            assert beyond.max() < 1e-6 * mesh.radius
        for time in np.linspace(0.05, 0.95, 19) if path == "rigid" else ():
            straight = (1 - time) * ends[0] + time * ends[1]
            part = np.linalg.norm(at(time) - straight, axis=1) / boxes["growth"]
            assert part.max() <= 1.0 + 1e-6
            most = max(most, part.max())
    return most


@pytest.mark.parametrize("path", ["rigid", "linear"])
def test_boxes_enclose_bodies(path: Any) -> None:
    rng = np.random.default_rng(1)
    rod = pgccd.Mesh.box([6.0, 0.5, 0.3])
    for mesh in (rod, recentred(rod, [2.0, 1.0, 0.0]), recentred(rod, [5.0, 0.0, 0.0]), pgccd.Mesh.box([4, 4, 0.1])):
        assert_enclosed(mesh, unit_quaternions(rng, 50), rng.uniform(0, 0.4, (50, 1)) * directions(rng, 50), path)


def test_bulges_are_attained() -> None:
    """By a corner about an axis perpendicular to it, and by a strip about its long axis."""
    rng = np.random.default_rng(2)
    rod, strip = pgccd.Mesh.box([6.0, 0.5, 0.3]), pgccd.Mesh.box([6.0, 0.5, 1e-7])
    q = unit_quaternions(rng, 20)
    corner = turned(q, np.tile(rod.vertices[0].numpy(), (20, 1)))
    across = np.cross(corner, directions(rng, 20))
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    assert assert_enclosed(rod, q, 0.05 * across, "rigid") > 0.9998
    assert assert_enclosed(strip, q, 0.05 * turned(q, np.tile([1.0, 0, 0], (20, 1))), "rigid") > 0.9998
    joint = recentred(strip, [0.0, 0.0, 2.0])  # the centre turns too
    assert assert_enclosed(joint, q, 0.05 * turned(q, np.tile([0.0, 1.0, 0], (20, 1))), "rigid") > 0.7


def test_growth_includes_margins_and_rounding() -> None:
    rod = pgccd.Mesh.box([6.0, 0.5, 0.3])
    far = recentred(rod, [1e7, 0.0, 0.0])
    margin, shift = torch.tensor([0.25, 0.0, 0.0], dtype=torch.float64), 1e12
    still = np.zeros((3, 3))
    position = np.array([[0.0, 0, 0], [0, 0, 0], [shift, 0, 0]])
    q = np.tile([1.0, 0, 0, 0], (3, 1))
    motion = pgccd.RigidMotion.from_velocity(*tensors(position, q, still, still + [0, 0, 1e-8]), dt=1.0)
    bodies = pgccd.MovingBodies.of(pgccd.Scene([rod, far], [0, 1, 1], margin=margin), motion)
    growth = columns_of(bodies)["growth"]
    of_points = (5.0 * 256.0 + 1536.0) * U * far.reach
    of_centre = (256.0 + 2.0) * U * 1e7
    below = 1.0 - 1e-4
    assert 0.25 * (1 - 1e-6) <= growth[0] < 0.2501
    assert growth[1] >= below * (of_points + of_centre) and of_points > 1e-6
    assert growth[2] >= below * (of_points + of_centre + 2.0 * U * shift)
    assert growth[2] < 2.0 * (of_points + of_centre + 2.0 * U * shift)


def crossed(rng: np.random.Generator, gap: float, size: float = 1.0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Positions and orientations of two rods of which the long edges cross at a distance, and the direction of that."""
    q = unit_quaternions(rng, 2)
    edges = np.array([turned(np.tile(q[k], (3, 1)), size * np.diag([3.0, 0.25, 0.15])) for k in range(2)])
    along = np.cross(edges[0, 0], edges[1, 0])
    if np.linalg.norm(along) < 0.5 * np.linalg.norm(edges[0, 0]) * np.linalg.norm(edges[1, 0]):
        return crossed(rng, gap, size)  # they would not cross within their lengths
    along /= np.linalg.norm(along)
    reach = np.abs(edges @ along).sum()
    offset = (reach + gap) * along + rng.uniform(-0.6, 0.6) * edges[0, 0] + rng.uniform(-0.6, 0.6) * edges[1, 0]
    return np.array([np.zeros(3), offset]), q, along


def found(
    position: np.ndarray,
    q: np.ndarray,
    velocity: np.ndarray,
    size: float = 1.0,
    separation: float = 0.0,
    tolerance: float = 0.0,
    at_any_times: bool = False,
) -> bool:
    motion = pgccd.RigidMotion.from_velocity(*tensors(position, q, velocity, np.zeros((2, 3))), dt=1.0)
    rods = pgccd.Scene([pgccd.Mesh.box(size * np.array([6.0, 0.5, 0.3]))], [0, 0])
    bodies = pgccd.MovingBodies.of(rods, motion)
    pairs = pgccd.broad.find_pairs_of_checked(bodies, separation, "sweep", tolerance, at_any_times=at_any_times)
    return len(pairs) == 1


@pytest.mark.parametrize("size", [1e-28, 1e-20, 1e-3, 1.0, 1e3, 1e20, 1e28])
def test_rods_that_touch(size: float) -> None:
    """At either end of the step, and not at a gap of a few times the rounding."""
    rng = np.random.default_rng(3)
    for _ in range(25):
        position, q, along = crossed(rng, 0.0, size)
        away = np.array([np.zeros(3), size * along])
        assert found(position, q, 0.0 * away, size)
        assert found(position, q, away, size)
        assert found(position + away, q, -away, size)
        gap = 1e-3 * away
        assert not found(position + gap, q, 0.0 * away, size)
        assert not found(position + gap, q, away, size)


@pytest.mark.parametrize("kept", ["separation", "tolerance"])
def test_distances_are_kept(kept: str) -> None:
    rng = np.random.default_rng(4)
    for _ in range(20):
        position, q, along = crossed(rng, 0.5)
        apart = 1e-3 * np.array([np.zeros(3), along])
        named: dict[str, Any] = {kept: 0.5}
        assert found(position, q, 0.0 * apart, **named)
        assert not found(position + apart, q, 0.0 * apart, **named)
        assert found(position + 0.3 * apart, q, 0.0 * apart, **{kept: 0.5003})


def test_at_two_times() -> None:
    """One rod is later where the other has been."""
    rng = np.random.default_rng(5)
    for _ in range(20):
        position, q, along = crossed(rng, 0.1)
        both = np.array([along, along])
        for velocity in (both, -both):
            assert not found(position, q, velocity)
            assert found(position, q, velocity, at_any_times=True)
        assert not found(position, q, np.zeros((2, 3)), at_any_times=True)
        # Positions have a rounding error of 2^-53 of 1e11, which the paths of stopped bodies include several times.
        shift = np.array([1e11, 0.0, 0.0])
        assert found(np.round(position, 3) + shift, q, np.zeros((2, 3)), at_any_times=True) is False
        close, q, along = crossed(rng, 3e-4)
        assert found(close + shift, q, np.zeros((2, 3)), at_any_times=True)


def test_points_without_boxes() -> None:
    """A ball beside a rod, off its sides, edges and corners."""
    rng = np.random.default_rng(6)
    rod, ball = pgccd.Mesh.box([6.0, 0.5, 0.3]), pgccd.Mesh.icosphere(1.0, 1)
    scene = pgccd.Scene([rod, ball], [0, 1])
    half = np.array([3.0, 0.25, 0.15])
    for _ in range(100):
        # The nearest point of the box, and a direction of its normal cone there.
        sign = rng.choice([-1.0, 0.0, 1.0], 3)
        if not sign.any():
            continue
        point = np.where(sign == 0, rng.uniform(-1, 1, 3), sign) * half
        normal = sign * rng.uniform(0.1, 1.0, 3)
        normal /= np.linalg.norm(normal)
        q = np.vstack([unit_quaternions(rng, 1), [1.0, 0, 0, 0]])
        for gap, expected in ((0.0, True), (-1e-6, True), (1e-3, False)):
            centre = turned(q[:1], (point + (ball.radius + gap) * normal)[None])
            position = np.vstack([np.zeros((1, 3)), centre])
            motion = pgccd.RigidMotion.from_velocity(*tensors(position, q, np.zeros((2, 3)), np.zeros((2, 3))), dt=1.0)
            bodies = pgccd.MovingBodies.of(scene, motion)
            assert (len(pgccd.broad.sweep(bodies, tolerance=0.0)) == 1) == expected


def test_deforming_bodies_are_enclosed(device: torch.device) -> None:
    rng = np.random.default_rng(7)
    rod = pgccd.Mesh.box([6.0, 0.5, 0.3])
    count = 40
    x = rod.vertices.numpy()
    ends = []
    for _ in range(2):
        q, position = unit_quaternions(rng, count), rng.normal(size=(count, 3))
        bent = [
            turned(np.tile(q[k], (len(x), 1)), x + 0.1 * rng.normal(size=x.shape)) + position[k] for k in range(count)
        ]
        ends.append(bent)
    ends[1][: count // 2] = [e + rng.normal(size=3) for e in ends[0][: count // 2]]  # the others turn far
    motion = pgccd.VertexMotion(*tensors(*(np.concatenate(e) for e in ends), device=device))
    index = torch.zeros(count, dtype=torch.int32)
    margin = torch.full((count,), 0.125, dtype=torch.float64)
    bodies = pgccd.MovingBodies.of(pgccd.Scene([rod], index, device, margin=margin), motion)
    boxes = columns_of(bodies)
    assert np.allclose(boxes["growth"], 0.125, rtol=1e-5) and boxes["slender"].all()
    centres = bodies.centre_t0.cpu().numpy(), bodies.centre_t1.cpu().numpy()
    for k in range(count):
        for end in range(2):
            local = ends[end][k] - centres[end][k] - boxes["centre"][k, end]
            half = boxes["half"][k, end]
            parts = np.abs(np.linalg.solve(half.T, local.T))
            assert parts.max(axis=1) == pytest.approx(1.0, abs=1e-4)
        if k < count // 2:
            assert np.linalg.norm(boxes["half"][k, 0], axis=1).min() < 0.8
