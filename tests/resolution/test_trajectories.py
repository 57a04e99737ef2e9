"""`pgccd.resolve` on trajectories: a body stopped in a segment stays there."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
from support.random_scenes import random_scene
from support.resolving import check_boxes
from support.shapes import unit_quaternions

import pgccd

HALF = np.array([0.5, 0.3, 0.15])


def on_a_line(device: torch.device, *x: list[float]) -> tuple[pgccd.Scene, pgccd.Trajectory]:
    """Cubes of edge 1 that move along x through these waypoints."""
    scene = pgccd.Scene([pgccd.Mesh.box([1.0] * 3)], [0] * len(x), device)
    position = torch.zeros(len(x[0]), len(x), 3, dtype=torch.float64, device=device)
    position[:, :, 0] = torch.tensor(x, dtype=torch.float64).T
    orientation = torch.tensor([1.0, 0, 0, 0], dtype=torch.float64, device=device).expand(len(x[0]), len(x), 4)
    return scene, pgccd.Trajectory(position, orientation)


def test_a_stopped_body_stays(device: torch.device) -> None:
    """1 stops before the wall 2 in the second segment. Its third waypoint, back home, is void; 0 runs into it there,
    and 3 comes down where it would have been.
    """
    scene, trajectory = on_a_line(
        device, [-8.0, -7.0, -6.0, 4.0], [0.0, 2.0, 6.0, 0.0], [5.0, 5.0, 5.0, 5.0], [-20.0, -20.0, -20.0, -20.0]
    )
    resolved = pgccd.resolve(scene, trajectory, [True, True, False, True])
    fraction = resolved.fraction.tolist()
    assert fraction[0] == [1.0] * 4 and fraction[1][0] == 1.0 and 0.48 < fraction[1][1] < 0.5
    assert fraction[2][1] == 0.0 and 0.85 < fraction[2][0] < 0.9 and fraction[2][2:] == [1.0, 1.0]
    assert resolved.stopped_by.tolist() == [1, 2, -1, -1]
    x = resolved.motion.position[:, 1, 0].tolist()
    assert x[:2] == [0.0, 2.0] and 3.9 < x[2] == x[3] < 4.0
    assert len(resolved.touching_at_start) == 0 == len(resolved.unresolved)
    for segment, motion in enumerate(resolved.segments):
        assert len(pgccd.detect(scene, motion, nonzero_toi=True)) == 0
        part = resolved.motion.segment(segment)
        for name, column in part.columns().items():
            assert torch.equal(column, motion.columns()[name]), name  # nothing turns


def test_a_driven_body_and_pairs_in_contact(device: torch.device) -> None:
    """0 and 1 touch at the start. The driven 3 stops 2, and passes over it in the second segment."""
    scene, trajectory = on_a_line(device, [0.0, -1.0, -2.0], [1.0, 2.0, 3.0], [20.0, 15.0, 25.0], [16.0, 16.0, 30.0])
    resolved = pgccd.resolve(scene, trajectory, [True, True, True, False])
    assert resolved.touching_at_start.tolist() == [[0, 1]] and resolved.unresolved.tolist() == [[2, 3]]
    assert resolved.fraction[:, :2].tolist() == [[0.0, 0.0]] * 2 and resolved.fraction[:, 3].tolist() == [1.0, 1.0]
    assert resolved.stopped_by.tolist() == [1, 0, 3, -1]


def with_margin(trajectory: pgccd.Trajectory, margin: list[list[float]]) -> pgccd.Trajectory:
    thickness = torch.tensor(margin, dtype=torch.float64, device=trajectory.device)
    return pgccd.Trajectory(trajectory.position, trajectory.orientation, margin=thickness)


@pytest.mark.parametrize("of_scene", [None, 0.25])
def test_margins_of_segments(device: torch.device, of_scene: float | None) -> None:
    """0 stops before 1 in the second segment, where it is thick. It stays so, and 2 runs into it from behind."""
    scene, trajectory = on_a_line(device, [0.0, 1.0, 2.0, 2.0], [4.0] * 4, [-6.0, -6.0, -6.0, -1.0])
    margin = 1.5
    if of_scene is not None:
        scene = pgccd.Scene(scene.meshes, scene.mesh_index, margin=torch.tensor([of_scene, 0.0, 0.0], device=device))
        margin -= of_scene
    thick = with_margin(trajectory, [[0.0, 0.0, 0.0], [margin, 0.0, 0.0], [0.0, 0.0, 0.0]])
    assert bool((pgccd.resolve(scene, trajectory).fraction == 1.0).all())
    resolved = pgccd.resolve(scene, thick)
    half, most = pytest.approx(0.495), pytest.approx(0.99, abs=0.01)
    assert resolved.fraction.tolist() == [[1.0] * 3, [half, half, 1.0], [0.0, 0.0, most]]
    assert resolved.stopped_by.tolist() == [1, 0, 0]
    assert resolved.motion.margin is not None and resolved.motion.margin[:, 0].tolist() == [0.0, margin, margin]
    assert len(resolved.touching_at_start) == 0 == len(resolved.unresolved)
    assert len(pgccd.detect(scene, resolved.motion, nonzero_toi=True)) == 0 < len(pgccd.detect(scene, thick))
    with pytest.raises(ValueError, match=r"margin: expected shape \(3, 3\), as the scene has 3 bodies, got \(3, 2\)"):
        thick.margin = thick.margin[:, :2]
        pgccd.resolve(scene, thick)


def test_a_margin_that_grows(device: torch.device) -> None:
    """Both bodies stop where one has become thick."""
    scene, trajectory = on_a_line(device, [0.0] * 3, [2.0] * 3)
    resolved = pgccd.resolve(scene, with_margin(trajectory, [[0.0, 0.0], [0.0, 1.5]]))
    assert resolved.fraction.tolist() == [[1.0, 1.0], [0.0, 0.0]]
    assert len(resolved.touching_at_start) == 0 and resolved.unresolved.tolist() == [[0, 1]]


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_turns_of_more_than_half_a_revolution(device: torch.device, dtype: torch.dtype) -> None:
    """Bodies go on turning as they were given, and stop on the way."""
    scene, trajectory = on_a_line(device, [0.0, 1.0, 2.0, 3.0], [9.0, 7.0, 3.0, 3.0])
    start, upright = trajectory.position[0], trajectory.orientation[0]  # type: ignore[index]
    spin = torch.tensor([[0.0, 0.0, 4.0], [0.0, 5.0, 0.0]], dtype=dtype, device=device).expand(3, 2, 3)
    velocity = (trajectory.position[1:] - trajectory.position[:-1]).to(dtype)
    turning = pgccd.Trajectory.from_velocity(start.to(dtype), upright.to(dtype), velocity, spin, 1.0)
    resolved = pgccd.resolve(scene, turning)
    assert resolved.fraction[0].tolist() == [1.0, 1.0] and 0.0 < float(resolved.fraction[1, 0]) < 1.0
    turned = resolved.motion.rotation
    assert turned is not None
    assert torch.equal(turned, torch.where(resolved.fraction < 1.0, resolved.fraction, 1.0)[:, :, None] * spin.double())
    for segment, part in enumerate(resolved.segments):
        again = resolved.motion.segment(segment).columns()
        for name, column in part.columns().items():
            assert torch.allclose(column, again[name], rtol=0.0, atol=1e-7), name
    assert len(pgccd.detect(scene, resolved.motion, nonzero_toi=True)) == 0


def test_random_scenes(device: torch.device) -> None:
    """Nothing outside the lists touches on the segments, which begin where the ones before have ended."""
    seen = dict.fromkeys(("stopped", "later", "listed"), 0)
    for seed in range(160):
        made = random_scene(seed)
        if "trajectory" not in made.kind:
            continue
        scene, motion = made.scene(device), made.motion(device)
        movable = np.random.default_rng(seed).uniform(size=scene.body_count) < 0.8
        options = {name: made.arguments[name] for name in ("min_separation", "tolerance")}
        resolved = pgccd.resolve(scene, motion, movable.tolist(), **options)
        listed = {tuple(p) for pairs in (resolved.touching_at_start, resolved.unresolved) for p in pairs.tolist()}
        whole = resolved.motion
        for segment, part in enumerate(resolved.segments):
            found = pgccd.detect(scene, part, nonzero_toi=True, **options).pairs.tolist()
            assert set(map(tuple, found)) <= listed, made
            again = whole.segment(segment).columns()
            for name, column in part.columns().items():
                assert torch.allclose(column, again[name], rtol=0.0, atol=1e-9 * (1.0 + float(column.abs().amax())))
        for i, j in resolved.unresolved.tolist():
            assert not (movable[i] and movable[j]), made
        is_before = resolved.fraction.cumprod(0) == 1.0
        assert bool(((resolved.fraction[1:] == 0.0) | is_before[:-1]).all()), made
        assert torch.equal((resolved.fraction < 1.0).any(dim=0), resolved.stopped_by >= 0)
        unstopped = resolved.stopped_by < 0
        rows = unstopped if made.kind == "trajectory" else unstopped[torch.repeat_interleave(made._counts().to(device))]
        assert torch.equal(whole.position[:, rows], motion.position[:, rows])
        of_body = torch.arange(len(movable), device=device)
        if made.kind != "trajectory":
            of_body = torch.repeat_interleave(of_body, made._counts().to(device))
        for pose in (whole.position, whole.orientation):
            if pose is not None:  # a stopped body does not move on
                stays = (resolved.fraction == 0.0)[:, of_body]
                assert torch.equal(pose[1:][stays], pose[:-1][stays]), made
        seen["stopped"] += int((resolved.fraction[0] < 1.0).sum())
        seen["later"] += int(((resolved.fraction[1:] > 0.0) & (resolved.fraction[1:] < 1.0)).sum())
        seen["listed"] += len(listed)
    assert min(seen.values()) > 5, seen


def test_boxes_do_not_overlap_by_separating_axes(device: torch.device) -> None:
    rng, count, segments = np.random.default_rng(3), 100, 3
    scene = pgccd.Scene([pgccd.Mesh.box(list(2.0 * HALF))], torch.zeros(count, dtype=torch.int32), device)
    start = 1.4 * np.stack(np.unravel_index(np.arange(count), (5, 5, 4)), axis=1)
    position = np.concatenate([start[None], start + np.cumsum(0.6 * rng.normal(size=(segments, count, 3)), axis=0)])
    orientation = np.stack([unit_quaternions(rng, count) for _ in position])
    trajectory = pgccd.Trajectory(*(torch.tensor(column, device=device) for column in (position, orientation)))
    resolved = pgccd.resolve(scene, trajectory)
    listed = {tuple(pair) for pair in resolved.touching_at_start.tolist()}
    assert len(resolved.unresolved) == 0 and len(listed) < 40
    whole = torch.ones(count, dtype=torch.float64)
    for segment in range(segments):
        part: Any = resolved.motion.segment(segment)
        assert check_boxes(HALF, part, whole, listed) > 300
    assert int((resolved.fraction[1:] > 0.0).logical_and(resolved.fraction[1:] < 1.0).sum()) > 10


def test_arguments() -> None:
    scene, trajectory = on_a_line(torch.device("cpu"), [0.0, 1.0], [5.0, 6.0])
    with pytest.raises(TypeError, match="motion: with a capacity, expected one step, got a Trajectory"):
        pgccd.resolve(scene, trajectory, capacity=pgccd.Capacity.of(2))  # type: ignore[call-overload]
    with pytest.raises(ValueError, match="motion: has 2 bodies, the scene 1"):
        pgccd.resolve(pgccd.Scene([pgccd.Mesh.box([1.0] * 3)], [0]), trajectory)
    with pytest.raises(ValueError, match="motion: has 2 bodies, the scene 3"):
        pgccd.resolve(pgccd.Scene([pgccd.Mesh.box([1.0] * 3)], [0] * 3), trajectory)
    with pytest.raises(ValueError, match="movable: expected shape"):
        pgccd.resolve(scene, trajectory, [True])
