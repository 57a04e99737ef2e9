"""The least clearance along paths, against dense samples of an independent distance."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
import torch
from oracle.arms import Arm, Part, distances, least_gaps
from support.arms import UPRIGHT, beams, boxes, loaded, random_arm, untested
from support.cases import mostly_slow

import pgccd
from pgccd import Spline
from pgccd.robots import Clearance, Obstacles
from robots.test_curves import bernstein
from robots.test_moving_obstacles import Sweep, least

BLOCK = Part("prismatic", UPRIGHT, UPRIGHT, (1, 0, 0), half=(0.1, 0.1, 0.1))


@pytest.mark.parametrize("seed", mostly_slow(range(10), [1, 2]))
def test_bounds_of_random_paths(seed: int, tmp_path: Path) -> None:
    """Waypoints and curves, obstacles at rest, of environments of their own, and moving."""
    rng = np.random.default_rng([seed, 10])
    arm = beams(4) if seed % 2 else random_arm(rng, 5)
    robot = loaded(arm, tmp_path)
    degree, paths, segments, samples = (1, 3)[seed // 2 % 2], 4, 2, 201
    control = rng.uniform(-1.0, 1.0, (1, paths, robot.joint_count))
    control = control + 0.3 * rng.normal(size=(segments * degree + 1, paths, robot.joint_count)).cumsum(axis=0)
    still, frames, half = boxes(rng, 4, 0.7 * robot.reach, 1.2 * robot.reach)
    own = Obstacles(still.meshes, still.position.expand(paths, -1, -1), still.orientation.expand(paths, -1, -1))
    sweep = Sweep(rng, 3, segments, 0.8 * robot.reach, 1.2 * robot.reach, turn=1.0)
    names, s, tolerance = untested(robot), np.linspace(0.0, 1.0, samples), 1e-3 * robot.reach
    q = Spline(torch.tensor(control), degree)
    way = q if degree > 1 else torch.tensor(control).movedim(1, 0)

    def gaps_of(b: int, k: int, s: np.ndarray, moving: bool) -> np.ndarray:
        at = bernstein(control[k * degree : (k + 1) * degree + 1, b], s)
        if moving:
            return np.maximum(least(arm, at, sweep, k, s, names, distances), 0.0)
        return np.maximum(least_gaps(arm, at, frames, half, names, distances), 0.0)

    for obstacles in (still, own, sweep.obstacles):
        found = robot.clearance(way, obstacles)
        assert bool((found.upper - found.lower <= tolerance).all()) and bool((found.lower >= 0.0).all())
        for b in range(paths):
            sampled = min(gaps_of(b, k, s, obstacles is sweep.obstacles).min() for k in range(segments))
            lower, upper = float(found.lower[b]), float(found.upper[b])
            assert lower <= sampled + 1e-12 and upper <= sampled + tolerance, b
            k, toi = int(found.segment[b]), float(found.toi[b])
            assert gaps_of(b, k, np.array([toi]), obstacles is sweep.obstacles)[0] <= upper + 1e-9, b
            assert len(found.names(b)) == 2 and abs(float(found.time[b]) - (k + toi) / segments) < 1e-12
            apart = float((found.points[b, 0] - found.points[b, 1]).norm())
            assert apart >= lower - tolerance, b  # on the meshes, not their margins
            assert seed % 2 == 0 or upper <= tolerance or apart <= upper + tolerance, b
        free = robot.certify(way, obstacles).free
        assert bool((free | (found.lower <= tolerance)).all())


def slide(tmp_path: Path, gap: float, distance: float = 0.5) -> tuple[pgccd.robots.Robot, Obstacles]:
    """A block that slides along x, and a wall at this gap from the block's place at `distance`."""
    robot = loaded(Arm([BLOCK]), tmp_path)
    wall = pgccd.Mesh.box([0.2, 1.0, 1.0])
    return robot, Obstacles(
        [wall], torch.tensor([[distance + 0.2 + gap, 0.0, 0.0]], dtype=torch.float64), names=["wall"]
    )


def test_known_clearances(tmp_path: Path) -> None:
    """Of a straight motion, of a curve whose control points are further, and from an intersecting start."""
    robot, obstacles = slide(tmp_path, 0.02)
    straight = robot.clearance(torch.tensor([[[0.0], [0.5], [0.1]]]), obstacles, tolerance=1e-5)
    assert float(straight.lower[0]) <= 0.02 <= float(straight.upper[0]) <= 0.02 + 1e-5
    assert straight.names(0) == ("link0", "wall") and abs(float(straight.time[0]) - 0.5) < 1e-4
    curve = robot.clearance(Spline(torch.tensor([[0.0], [1.0], [0.0]]), 2), obstacles, tolerance=1e-5)
    assert float(curve.lower[0]) <= 0.02 <= float(curve.upper[0]) <= 0.02 + 1e-5
    assert abs(float(curve.toi[0]) - 0.5) < 0.01 and int(curve.segment[0]) == 0
    inside = robot.clearance(torch.tensor([[[0.6], [0.0]]]), obstacles)
    assert inside.lower.tolist() == [0.0] and float(inside.upper[0]) < 1e-12
    assert repr(curve).startswith("Clearance(environments=1, least=0.0")


def test_cutoffs(tmp_path: Path) -> None:
    robot, obstacles = slide(tmp_path, 0.2)
    q = torch.tensor([[[0.0], [0.5]], [[0.3], [0.35]]])
    found = robot.clearance(q, obstacles, cutoff=0.3)
    assert 0.199 < float(found.lower[0]) <= 0.2 <= float(found.upper[0])
    assert float(found.lower[1]) == 0.3 and found.upper[1] == math.inf and int(found.segment[1]) == -1
    assert found.names(1) == () and math.isnan(float(found.time[1])) and bool(found.points[1].isnan().all())
    # Without obstacles nothing is near, however far one looks.
    alone = robot.clearance(q)
    assert alone.lower.tolist() == alone.upper.tolist() == [math.inf] * 2


def test_spheres_that_touch_their_bounds(tmp_path: Path) -> None:
    """Two points with margins, whose distance is that of their spheres, are found and not taken for the cutoff."""
    robot = loaded(Arm([Part("prismatic", UPRIGHT, UPRIGHT, (1, 0, 0), radius=0.1)]), tmp_path)
    ball = pgccd.Mesh.sphere(0.2)
    obstacles = Obstacles([ball], torch.tensor([[2.0, 0.0, 0.0]], dtype=torch.float64))
    found = robot.clearance(torch.tensor([[[1.0], [0.5]]]), obstacles, tolerance=1e-6)
    assert float(found.lower[0]) <= 0.7 <= float(found.upper[0]) <= 0.7 + 1e-6


def test_results_on_devices(tmp_path: Path, device: torch.device) -> None:
    """Equal bits on a GPU, and of many paths and one: also of those that are taken apart."""
    rng = np.random.default_rng(2)
    robot = loaded(beams(4), tmp_path)
    obstacles, _, _ = boxes(rng, 3, 0.8, 1.4)
    q = torch.tensor(rng.uniform(-1, 1, (5, 3, 4)))
    found, again = robot.clearance(q.to(device), obstacles), robot.clearance(q, obstacles)
    assert found.lower.device.type == device.type
    assert found.to("cpu") == again
    for b in range(len(q)):
        assert robot.clearance(q[b : b + 1], obstacles) == again[[b]]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("pgccd.robots.path_clearance._ROWS_AT_ONCE", 40)
        assert robot.clearance(q, obstacles) == again
    restored = Clearance.from_state_dict(again.state_dict())
    assert restored == again and again[again.lower > 0.0].lower.min() > 0.0


def test_bad_input_is_named(tmp_path: Path) -> None:
    robot, obstacles = slide(tmp_path, 0.1)
    q = torch.tensor([[[0.0], [0.5]]])
    two = Obstacles(obstacles.meshes, torch.tensor([[[2.0, 0, 0]], [[math.nan, 0, 0]]]))
    bad = [
        (lambda: robot.clearance(q, obstacles, tolerance=0.0), "^tolerance: expected a length > 0"),
        (lambda: robot.clearance(q, obstacles, cutoff=-1.0), "^cutoff: "),
        (lambda: robot.clearance(q * math.nan, obstacles), "^q: waypoint 0: expected joint values"),
        (lambda: robot.clearance(q, two), "^q: expected 2 environments"),
        (lambda: robot.clearance(q.expand(2, -1, -1), two), "^obstacles: environment 1 has invalid poses"),
    ]
    for call, message in bad:
        with pytest.raises(ValueError, match=message):
            call()
