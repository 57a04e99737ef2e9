"""Trajectories with rotation vectors and margins of their own in each segment."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from support.same_bits import assert_same
from support.shapes import tensors, tetrahedron, unit_quaternions

import pgccd

UPRIGHT = torch.tensor([1.0, 0.0, 0.0, 0.0], dtype=torch.float64)


def blade_and_post() -> tuple[pgccd.Scene, torch.Tensor, torch.Tensor]:
    """A blade that turns about z at the origin, and a post beside it: scene, positions (2, 3), orientations (2, 4)."""
    blade = pgccd.Mesh.box([2.0, 0.1, 0.1])
    arm = pgccd.Mesh(blade.vertices + torch.tensor([1.0, 0, 0]), blade.faces)
    scene = pgccd.Scene([arm, pgccd.Mesh.box([0.1] * 3)])
    return scene, torch.tensor([[0.0, 0, 0], [0.0, 1.5, 0.0]], dtype=torch.float64), UPRIGHT.repeat(2, 1)


def test_a_spin_is_not_the_shorter_way() -> None:
    """A turn by 350 degrees passes what the shorter way, by -10 degrees, does not."""
    scene, x, q = blade_and_post()
    spin = torch.tensor([[0.0, 0.0, math.radians(350.0)], [0.0, 0.0, 0.0]], dtype=torch.float64)
    motion = pgccd.RigidMotion.from_rotation(x, q, x, spin)
    single = pgccd.detect(scene, motion)
    assert len(single) == 1 and 0.2 < float(single.toi[0]) < 0.26
    positions, turned = x.repeat(2, 1, 1), pgccd.integrate_orientation(q, spin)
    assert len(pgccd.detect(scene, pgccd.Trajectory(positions, torch.stack([q, turned])))) == 0
    for orientation in (torch.stack([q, turned]), torch.stack([q, -turned]), q):
        trajectory = pgccd.Trajectory(positions, orientation, rotation=spin[None])
        found = pgccd.detect(scene, trajectory)
        assert torch.equal(found.toi, single.toi) and torch.equal(found.point, single.point)
    assert trajectory.orientation is not None and trajectory.orientation.shape == (2, 2, 4)


def random_walk(device: torch.device, segments: int = 7, bodies: int = 40) -> list[torch.Tensor]:
    """Positions, orientations, and velocities of each segment."""
    rng = np.random.default_rng(5)
    return tensors(
        rng.uniform(0.0, 5.0, (bodies, 3)),
        unit_quaternions(rng, bodies),
        rng.normal(size=(segments, bodies, 3)),
        5.0 * rng.normal(size=(segments, bodies, 3)),
        device=device,
    )


@pytest.mark.parametrize("path", ["rigid", "linear"])
def test_segments_are_motions_from_velocity(path: str, device: torch.device) -> None:
    x, q, velocity, spin = random_walk(device)
    dt = torch.tensor([0.3, 0.5, 1.0, 0.0, 0.25, 0.125, 0.7], dtype=torch.float64)
    scene = pgccd.Scene([tetrahedron(0.6)], torch.zeros(40, dtype=torch.int32), device)
    trajectory = pgccd.Trajectory.from_velocity(x, q, velocity, spin, dt, path)  # type: ignore[arg-type]
    found = pgccd.detect(scene, trajectory, "all")
    assert float(spin.norm(dim=2).max()) * 0.7 > math.pi
    for k in range(7):
        motion = pgccd.RigidMotion.from_velocity(x, q, velocity[k], spin[k], float(dt[k]), path)  # type: ignore[arg-type]
        same = found.segment == k
        single = pgccd.detect(scene, motion, "all")
        for name in ("pairs", "toi", "point", "normal", "features"):
            assert torch.equal(getattr(found, name)[same], getattr(single, name)), (k, name)
        assert_same(pgccd.detect(scene, trajectory.segment(k), "all"), single)
        x, q = motion.position_t1, pgccd.integrate_orientation(q, motion.rotation)
    assert len(found) > 30
    again = pgccd.Trajectory.from_velocity(*random_walk(device), 0.3)
    assert again.rotation is not None and torch.equal(again.rotation, 0.3 * spin)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_rotations_must_lead_to_the_next_orientation(dtype: torch.dtype) -> None:
    x, q, velocity, spin = random_walk(torch.device("cpu"))
    made = pgccd.Trajectory.from_velocity(x, q, velocity, spin, 1.0)
    assert made.orientation is not None and made.rotation is not None
    given = {"orientation": made.orientation.to(dtype), "rotation": made.rotation.to(dtype)}
    pgccd.Trajectory(made.position, **given)
    # One of both in float32: so is the rounding.
    pgccd.Trajectory(made.position, made.orientation, rotation=made.rotation.float())
    off = 1e-4 if dtype == torch.float32 else 1e-11
    wrong = given["rotation"].clone()
    wrong[4, 7] += off * wrong[4, 7] / wrong[4, 7].norm() * wrong[4, 7].norm().clamp(min=1.0)
    message = "^rotation: segment 4, body 7: expected a rotation vector that leads to the orientation of waypoint 5"
    with pytest.raises(ValueError, match=message):
        pgccd.Trajectory(made.position, given["orientation"], rotation=wrong)
    made.rotation = wrong.double()
    with pytest.raises(ValueError, match=message if dtype == torch.float64 else "^rotation: segment 0, body"):
        made.steps() if dtype == torch.float64 else made.segment(0)
        pgccd.detect(pgccd.Scene([tetrahedron()], [0] * 40), made)


def test_margins_of_segments_add_to_those_of_bodies(device: torch.device) -> None:
    x, q, velocity, spin = random_walk(device)
    rng = np.random.default_rng(8)
    of_bodies, of_segments = tensors(rng.uniform(0, 0.1, 40), rng.uniform(0, 0.3, (7, 40)), device=device)
    of_segments[2] = 0.0
    index = torch.zeros(40, dtype=torch.int32)
    for margin in (None, of_bodies):
        trajectory = pgccd.Trajectory.from_velocity(x, q, velocity, spin, 0.2, margin=of_segments)
        scene = pgccd.Scene([tetrahedron(0.4)], index, device, margin=margin)
        found = pgccd.detect(scene, trajectory, "all")
        for k in range(7):
            total = of_segments[k]
            if margin is not None:
                total = torch.nextafter(margin + total, torch.full_like(total, torch.inf)) if k != 2 else margin
            thick = pgccd.Scene([tetrahedron(0.4)], index, device, margin=total)
            single, same = pgccd.detect(thick, trajectory.segment(k), "all"), found.segment == k
            for name in ("pairs", "toi", "point", "normal"):
                assert torch.equal(getattr(found, name)[same], getattr(single, name)), (k, name)
        bare = pgccd.Trajectory.from_velocity(x, q, velocity, spin, 0.2)
        assert len(found) > len(pgccd.detect(scene, bare, "all"))


def test_margins_of_deforming_bodies() -> None:
    mesh = pgccd.Mesh.box([1.0, 1.0, 1.0])
    apart = torch.cat([mesh.vertices, mesh.vertices + torch.tensor([1.2, 0, 0])])
    frames = torch.stack([apart] * 4)
    scene = pgccd.Scene([mesh, mesh])
    assert len(pgccd.detect(scene, pgccd.Trajectory(frames))) == 0
    margin = torch.zeros((3, 2), dtype=torch.float64)
    margin[1] = 0.11
    assert pgccd.detect(scene, pgccd.Trajectory(frames, margin=margin)).segment.tolist() == [1]
    with pytest.raises(ValueError, match=r"^margin: expected shape \(3, 2\), as the scene has 2 bodies, got \(3, 5\)"):
        pgccd.detect(scene, pgccd.Trajectory(frames, margin=torch.zeros((3, 5))))


def test_what_rotations_and_margins_cannot_be() -> None:
    x, q = torch.zeros(3, 2, 3), torch.tensor([1.0, 0.0, 0.0, 0.0]).repeat(3, 2, 1)
    still = torch.zeros(2, 2, 3)
    nan, far, negative = still.clone(), still.clone(), torch.zeros(2, 2)
    nan[1, 0, 1], far[1, 1, 2], negative[1, 1] = float("nan"), 2e6, -1.0
    cases = [
        ((x, q), {"rotation": torch.zeros(3, 2, 3)}, r"rotation: expected shape \(2, 2, 3\), got \(3, 2, 3\)"),
        ((x, q), {"rotation": nan}, "rotation: segment 1, body 0: expected a turn of at most"),
        ((x, q), {"rotation": far}, "rotation: segment 1, body 1: expected a turn of at most"),
        ((x,), {"rotation": still}, "rotation: expected an orientation beside it"),
        ((x, q[0]), {"rotation": torch.zeros(1, 2, 3)}, "orientation: expected shape|rotation: expected shape"),
        ((x, q[0]), {}, r"orientation: expected shape \(T, N, 4\)"),
        ((x, q), {"margin": torch.zeros(3, 2)}, r"margin: expected shape \(2, 2\)"),
        ((x, q), {"margin": negative}, "margin: segment 1, body 1: expected a finite length >= 0"),
    ]
    for given, more, message in cases:
        with pytest.raises(ValueError, match="^" + message):
            pgccd.Trajectory(*given, **more)  # type: ignore[arg-type]
    with pytest.raises(TypeError, match="^rotation: "):
        pgccd.Trajectory(x, q, rotation=still.int())
    v = torch.zeros(2, 2, 3)
    start = (x[0], q[0])
    for given, message in [
        ((v[0], v, 1.0), r"linear_velocity: expected shape \(T - 1, 2, 3\)"),
        ((v, v[:1], 1.0), r"angular_velocity: expected shape \(2, 2, 3\), as of linear_velocity"),
        ((nan, v, 1.0), "linear_velocity: segment 1, body 0: expected finite"),
        ((v, v, torch.ones(3)), r"dt: expected a number or shape \(2,\)"),
        ((v, v, -1.0), "dt: expected finite durations"),
    ]:
        with pytest.raises(ValueError, match="^" + message):
            pgccd.Trajectory.from_velocity(*start, *given)  # type: ignore[arg-type]


def test_turns_and_velocities_out_of_range_are_named() -> None:
    """By what was passed, not by the orientations and positions that follow from it."""
    _, x, q = blade_and_post()
    still, fast = torch.zeros(2, 2, 3), torch.zeros(2, 2, 3, dtype=torch.float64)
    fast[1, 1, 2] = 3e6
    spin = r"^angular_velocity: segment 1, body 1: expected a turn of at most 1e\+06 radians .*got \[0.0, 0.0, 1500000"
    with pytest.raises(ValueError, match=spin):
        pgccd.Trajectory.from_velocity(x, q, still, fast, 0.5)
    quick = pgccd.Trajectory.from_velocity(x, q, still, fast, 0.25)
    assert quick.rotation is not None and float(quick.rotation.amax()) == 7.5e5
    with pytest.raises(ValueError, match=r"^rotation: segment 1, body 1: expected a turn of at most 1e\+06 radians"):
        pgccd.Trajectory(x.expand(3, -1, -1), q, rotation=fast)
    far = r"^linear_velocity: position after segment 1, body 1: expected finite numbers .*got \[0.0, 1.5, .*e\+151\]"
    with pytest.raises(ValueError, match=far):
        pgccd.Trajectory.from_velocity(x, q, 1e142 * fast, still, 1e3)
    turn = torch.tensor([[1.0, 0, 0], [1e6, 1.0, 0]], dtype=torch.float64)
    with pytest.raises(ValueError, match=r"^rotation: body 1: expected a turn of at most 1e\+06 radians"):
        pgccd.integrate_orientation(q, turn)
    for rotation in (torch.tensor([[0.0, 0, torch.nan]] * 2), torch.tensor([[0.0, 0, torch.inf]] * 2)):
        with pytest.raises(ValueError, match="^rotation: body 0"):
            pgccd.integrate_orientation(q, rotation)
    for wrong in (torch.zeros(2, 4), torch.full((2, 4), torch.nan)):
        with pytest.raises(ValueError, match="^orientation: body 0: expected a unit quaternion"):
            pgccd.integrate_orientation(wrong, turn[:1].expand(2, -1))


def test_segment_numbers_are_integers() -> None:
    _, x, q = blade_and_post()
    trajectory = pgccd.Trajectory(torch.stack([x, x]), torch.stack([q, q]))
    assert trajectory.segment(np.int64(0)).body_count == 2  # type: ignore[arg-type, union-attr]
    for wrong in (0.5, "0", None, True, torch.tensor([0])):
        with pytest.raises(TypeError, match=r"^index: expected a segment in \[0, 1\), got"):
            trajectory.segment(wrong)  # type: ignore[arg-type]
    for beyond in (-1, 1, 10**400):
        with pytest.raises(IndexError, match=r"^index: expected a segment in \[0, 1\), got"):
            trajectory.segment(beyond)


def test_thousands_of_trajectories_in_one_call(device: torch.device) -> None:
    """Each in a world of its own: the first contact of each pair, and the first time of each trajectory."""
    count, waypoints = 4000, 9
    rng = np.random.default_rng(3)
    start = np.array([[0.0, 0, 0], [4.0, 0, 0]])[None] + 0.1 * rng.normal(size=(count, 2, 3))
    goal = start.copy()
    goal[:, 1] -= rng.uniform(0.0, 4.0, (count, 1)) * [1.0, 0, 0]
    way = start + np.linspace(0, 1, waypoints)[:, None, None, None] * (goal - start)  # (T, count, 2, 3)
    position = torch.tensor(way.reshape(waypoints, -1, 3), device=device)
    orientation = UPRIGHT.to(device).expand(waypoints, 2 * count, 4)
    world = torch.arange(count).repeat_interleave(2)
    scene = pgccd.Scene([tetrahedron()], torch.zeros(2 * count, dtype=torch.int32), device, world=world)
    found = pgccd.detect(scene, pgccd.Trajectory(position, orientation))
    assert 100 < len(found) < count and len(found.pairs.unique(dim=0)) == len(found)
    first = found.first_toi("world")
    assert first.shape == (count,) and int((first < torch.inf).sum()) == len(found)
    # As one step of the whole straight path.
    whole = pgccd.RigidMotion(position[0], orientation[0], position[-1], orientation[-1])
    single = pgccd.detect(scene, whole)
    assert torch.equal(found.pairs, single.pairs)
    assert torch.allclose(found.time, single.toi, rtol=0.0, atol=1e-5)
