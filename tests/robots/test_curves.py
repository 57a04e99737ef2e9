"""Paths whose segments are polynomials: bodies are as near to arcs as the bound says, and nothing is missed."""

from __future__ import annotations

import math
from pathlib import Path

import mpmath
import numpy as np
import pytest
import torch
from oracle.arms import Arm, Part, least_gaps
from support.arms import UPRIGHT, beams, boxes, loaded, random_arm, untested
from support.cases import mostly_slow

import pgccd
from pgccd import Spline, ops
from pgccd.robots import Obstacles, Robot, Verdict
from pgccd.robots.joint_paths import JointPaths
from robots.test_moving_obstacles import Sweep, least
from robots.test_path_search import same

HINGE = Part("revolute", UPRIGHT, UPRIGHT, (0, 0, 1), half=(0.1, 0.1, 0.1))


def bernstein(control: np.ndarray, s: np.ndarray) -> np.ndarray:
    """(K, J): values at times (K,) of the polynomial with control points (degree + 1, J), by de Casteljau."""
    points = np.repeat(control[:, None], len(s), axis=1)
    while len(points) > 1:
        points = (1.0 - s[:, None]) * points[:-1] + s[:, None] * points[1:]
    return points[0]


def strays(robot: Robot, control: np.ndarray, begin: float = 0.0, end: float = 1.0, error: float = 0.0) -> torch.Tensor:
    """(N,): the bound over a part of a segment with control points (degree + 1, J)."""
    times = (torch.tensor([time], dtype=torch.float64) for time in (begin, end))
    return ops.arm_arcs(robot._tables.on(torch.device("cpu")), torch.tensor(control)[None], error, *times)[-1][0]


def most_off(robot: Robot, control: np.ndarray, begin: float, end: float) -> np.ndarray:
    """(N,): the largest distance of points within the reach of bodies from their places on the arcs, at 21 times."""
    times = (torch.tensor([time], dtype=torch.float64) for time in (begin, end))
    arcs = ops.arm_arcs(robot._tables.on(torch.device("cpu")), torch.tensor(control)[None], 0.0, *times)
    x0, x1, r, w, _ = (column[0] for column in arcs)
    s = np.linspace(0.0, 1.0, 21)
    on_arc = pgccd.RigidMotion.from_rotation(x0, r, x1, w).at(torch.tensor(s)[:, None])
    truly = robot.poses(torch.tensor(bernstein(control, begin + s * (end - begin))))
    directions = np.random.default_rng(0).normal(size=(60, 3))
    directions = np.concatenate([directions, np.eye(3), -np.eye(3)])
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    reach = np.array([mesh.reach for mesh in robot.meshes])[:, None, None]
    places = [placed(x.numpy(), q.numpy(), reach * directions) for x, q in (on_arc, truly)]
    return np.linalg.norm(places[0] - places[1], axis=-1).max(axis=(0, 2))


def placed(position: np.ndarray, orientation: np.ndarray, points: np.ndarray) -> np.ndarray:
    """(K, N, D, 3): points (N, D, 3) of bodies in poses (K, N, 3) and (K, N, 4)."""
    w, v = orientation[:, :, None, :1], orientation[:, :, None, 1:]
    twice = 2.0 * np.cross(v, points)
    return position[:, :, None] + points + w * twice + np.cross(v, twice)


@pytest.mark.parametrize("seed", range(20))
def test_no_link_strays_further(seed: int, tmp_path: Path) -> None:
    rng = np.random.default_rng([seed, 8])
    robot = loaded(random_arm(rng, int(rng.integers(1, 8))), tmp_path)
    for _ in range(15):
        degree = int(rng.integers(2, 8))
        control = rng.normal(size=(degree + 1, robot.joint_count)) * 10.0 ** rng.uniform(-2, 0.5)
        begin = rng.uniform(0.0, 0.9)
        turn = float(JointPaths(torch.tensor(control)[None], degree).turns(robot)[0, 0])
        end = min(1.0, begin + min(1.0, rng.uniform(0.3, 1.0) / max(turn, 1e-9)))
        bound, found = strays(robot, control, begin, end).numpy(), most_off(robot, control, begin, end)
        assert (found <= bound + 1e-13).all(), (found / bound).max()


def test_the_deviation_is_attained(tmp_path: Path) -> None:
    """A hinge and a slider on parabolas, whose chords stand still: over all of the segment and over a part of it, alone
    and with one more joint between.
    """
    rod = Part("revolute", UPRIGHT, UPRIGHT, (0, 0, 1))
    ball = Part("fixed", (1.0, 0.0, 0.0), UPRIGHT, (1, 0, 0), radius=1e-3)
    slider = Part("prismatic", UPRIGHT, UPRIGHT, (1, 0, 0), radius=1e-3)
    upper = Part("revolute", (0.5, 0.0, 0.0), UPRIGHT, (0, 0, 1))
    parabola = np.array([0.0, 1e-3, 0.0])
    for arm, column in ((Arm([rod, ball]), [1.0]), (Arm([slider]), [1.0]), (Arm([rod, upper, ball]), [1.0, 0.0])):
        robot = loaded(arm, tmp_path)
        control = parabola[:, None] * np.array(column)
        for begin, end in ((0.0, 1.0), (0.25, 0.75), (0.45, 0.55)):
            off, bound = most_off(robot, control, begin, end)[-1], float(strays(robot, control, begin, end)[-1])
            assert 0.9995 < off / (bound - float(strays(robot, control, 0.5, 0.5)[-1])) <= 1.0, (begin, end)
    # A joint that follows another one, three times as far.
    geared = Part("prismatic", UPRIGHT, UPRIGHT, (0, 1, 0), radius=1e-3, mimic=(0, 3.0, 0.0), parent=-1)
    robot = loaded(Arm([slider, geared]), tmp_path)
    off, bound = most_off(robot, parabola[:, None], 0.0, 1.0)[-1], float(strays(robot, parabola[:, None])[-1])
    assert 0.9995 < off / bound <= 1.0 and abs(off / 1.5e-3 - 1.0) < 1e-6
    # The reach of a body counts as the way to it does.
    robot = loaded(Arm([HINGE]), tmp_path)
    assert 0.9995 < most_off(robot, parabola[:, None], 0.0, 1.0)[0] / float(strays(robot, parabola[:, None])[0]) <= 1.0


def test_rounding_and_errors_of_curves(tmp_path: Path) -> None:
    """Values are within what the bound has for their rounding, which is that of its formula; likewise the error that
    the paths have been given.
    """
    robot = loaded(Arm([Part("prismatic", UPRIGHT, UPRIGHT, (1, 0, 0), radius=0.1)]), tmp_path)
    rng = np.random.default_rng(0)
    for degree in (2, 3, 7, 16):
        for _ in range(20):
            control = rng.normal(size=(degree + 1, 1)) * 1e3
            largest = np.abs(control).max()
            s = float(rng.random())
            value = float(ops.arm_arcs(*still(robot, control, s))[0][0, 0, 0])
            with mpmath.workdps(60):
                points = [mpmath.mpf(x) for x in control[:, 0].tolist()]
                while len(points) > 1:
                    points = [a + mpmath.mpf(s) * (b - a) for a, b in zip(points, points[1:], strict=False)]
                assert abs(points[0] - value) <= degree**2 * 2.0**-50 * largest
        still_one = np.full((degree + 1, 1), 1e3)
        own = float(strays(robot, still_one, 0.3, 0.3)[0])
        straight = float(strays(robot, still_one[:2], 0.3, 0.3)[0])
        assert abs((own - straight) / (degree**2 * 2.0**-50 * 1e3) - 1.0) < 1e-3
        wider = float(strays(robot, still_one, 0.3, 0.3, 0.5)[0])
        assert 0.5 <= wider - own <= 0.5 * (1.0 + 1e-9)
        of_waypoints = float(strays(robot, still_one[:2], 0.3, 0.3, 0.5)[0])
        assert 0.5 <= of_waypoints - straight <= 0.5 * (1.0 + 1e-9)


def still(robot: Robot, control: np.ndarray, s: float) -> tuple:  # type: ignore[type-arg]
    time = torch.tensor([s], dtype=torch.float64)
    return robot._tables.on(torch.device("cpu")), torch.tensor(control)[None], 0.0, time, time


def test_first_parts_turn_little(tmp_path: Path) -> None:
    """By the largest rate of the polynomial, not by the difference of its ends."""
    robot = loaded(Arm([HINGE]), tmp_path)
    there_and_back = Spline(torch.tensor([[0.0], [6.0], [-6.0], [0.0]]), 3)
    rate = 3 * 12.0
    paths = JointPaths.of(robot, there_and_back)
    assert abs(float(paths.turns(robot)) / rate - 1.0) < 1e-9
    trajectory = robot.trajectory(there_and_back)
    assert trajectory.segment_count == math.ceil(rate / 0.99)
    mesh_set, bodies, obstacles = pgccd.robots.path_search.PathSearch(robot, None, None)._tensors_on(
        paths.control.device
    )
    tables = robot._tables.on(paths.control.device)
    *_, counts = ops.certify_paths(mesh_set, tables, bodies, obstacles, False, robot._room, paths.control, 3, 0.0, 1e-3)
    assert int(counts[0, 0]) == math.ceil(rate / 0.99)


@pytest.mark.parametrize("seed", mostly_slow(range(8), [0, 1]))
def test_nothing_is_missed_and_nothing_late(seed: int, tmp_path: Path) -> None:
    """Random arms on random curves among boxes, at rest or moving, against 1,001 samples of each segment."""
    rng = np.random.default_rng([seed, 9])
    arm = beams(4) if seed % 2 else random_arm(rng, 5)
    robot = loaded(arm, tmp_path)
    degree, paths, segments, samples = int(rng.integers(2, 6)), 6, 2, 1001
    control = rng.uniform(-1.0, 1.0, (1, paths, robot.joint_count))
    control = control + 0.6 * rng.normal(size=(segments * degree + 1, paths, robot.joint_count)).cumsum(axis=0)
    obstacles, frames, half = boxes(rng, 5, 0.4 * robot.reach, 0.9 * robot.reach)
    sweep = Sweep(rng, 4, segments, 0.3 * robot.reach, 0.9 * robot.reach, turn=1.0)
    spline = Spline(torch.tensor(control), degree)
    names, s = untested(robot), np.linspace(0.0, 1.0, samples)
    for found in (robot.certify(spline, obstacles), robot.certify(spline, sweep.obstacles)):
        for b in range(paths):
            ways = [bernstein(control[k * degree : (k + 1) * degree + 1, b], s) for k in range(segments)]
            if found.obstacle_names == obstacles.names and len(obstacles.names) == 5:
                gap = np.stack([least_gaps(arm, way, frames, half, names) for way in ways])
            else:
                gap = np.stack([least(arm, way, sweep, k, s, names) for k, way in enumerate(ways)])
            verdict, time = Verdict(int(found.verdict[b])), float(found.time[b])
            if len(touching := np.argwhere(gap <= 0.0)):
                k, n = touching[0]
                assert verdict != Verdict.FREE and time <= (k + n / (samples - 1)) / segments, b
            assert (verdict == Verdict.START) == bool(gap[0, 0] <= 0.0), b
            if verdict in (Verdict.NEAR, Verdict.COLLISION):
                k, n = int(found.segment[b]), round(float(found.toi[b]) * (samples - 1))
                near = gap[k, max(n - 2, 0) : n + 3].min()
                assert near <= 0.02 * robot.reach, b


def test_the_deviation_is_needed(tmp_path: Path) -> None:
    """A block on a slider that comes near a wall on a parabola, and touches it at its apex only."""
    slider = Part("prismatic", UPRIGHT, UPRIGHT, (1, 0, 0), half=(0.1, 0.1, 0.1))
    robot = loaded(Arm([slider]), tmp_path)
    wall = pgccd.Mesh.box([0.2, 1.0, 1.0])
    # To 0.5 at time 0.5; and off the middle of parts, whose chords end short of it.
    for begin in (0.0, 0.123):
        control = [[begin], [1.0 - 0.5 * begin], [0.0]]
        # The largest value of (1 - s)^2 b + 2 s (1 - s) c, in the middle of which the derivative is zero.
        c = control[1][0]
        s = (c - begin) / (2.0 * c - begin)
        top = (1.0 - s) ** 2 * begin + 2.0 * s * (1.0 - s) * c
        for gap in (-1e-9, 2e-2):
            obstacles = Obstacles([wall], torch.tensor([[top + 0.2 + gap, 0.0, 0.0]], dtype=torch.float64))
            for resolution in (1e-1, 1e-2, 1e-5):
                found = robot.certify(
                    Spline(torch.tensor(control, dtype=torch.float64), 2), obstacles, resolution=resolution
                )
                assert not bool(found.free[0]) if gap < 0.0 else bool(found.free[0]) or resolution > 1e-2
                if gap < 0.0:
                    assert float(found.toi[0]) <= s + 1e-9 and abs(float(found.toi[0]) - s) < 3.0 * math.sqrt(
                        resolution
                    )


def test_straight_curves_are_waypoints(tmp_path: Path, device: torch.device) -> None:
    """A polynomial of higher degree with evenly spaced control points moves as one of degree 1. Results of one path
    alone are those of many, and of a GPU those of a CPU.
    """
    rng = np.random.default_rng(3)
    robot = loaded(beams(4), tmp_path)
    obstacles, _, _ = boxes(rng, 4, 0.5, 1.2)
    q = torch.tensor(rng.uniform(-1, 1, (12, 3, 4)))
    straight = Spline(q.movedim(0, 1), 1)
    found = robot.certify(q, obstacles)
    for b in range(12):
        same(robot.certify(Spline(q[b], 1), obstacles), found, b)
    assert torch.equal(robot.certify(straight, obstacles).verdict, found.verdict)
    steps = torch.stack([q[:, 0] + k / 3 * (q[:, 1] - q[:, 0]) for k in range(3)], dim=1)
    steps = torch.cat([steps, torch.stack([q[:, 1] + k / 3 * (q[:, 2] - q[:, 1]) for k in range(4)], dim=1)], dim=1)
    raised = robot.certify(Spline(steps.movedim(0, 1), 3), obstacles)
    assert torch.equal(raised.verdict, found.verdict) and torch.equal(raised.links, found.links)
    assert 0 < int(found.free.sum()) < 12
    curved = Spline(torch.tensor(rng.uniform(-1, 1, (7, 12, 4))), 3)
    whole = robot.certify(Spline(curved.control.to(device), 3), obstacles)
    for b in range(12):
        same(robot.certify(Spline(curved.control[:, b], 3), obstacles), whole, b)


def test_trajectories_of_curves(tmp_path: Path) -> None:
    """The bodies of `Robot.trajectory` touch where the curve does."""
    robot = loaded(Arm([Part("prismatic", UPRIGHT, UPRIGHT, (1, 0, 0), half=(0.1, 0.1, 0.1))]), tmp_path)
    curve = Spline(torch.tensor([[0.0], [1.0], [0.0]]), 2)
    wall = pgccd.Mesh.box([0.2, 1.0, 1.0])
    for gap, touches in ((-1e-9, True), (0.6, False)):
        obstacles = Obstacles([wall], torch.tensor([[0.7 + gap, 0.0, 0.0]], dtype=torch.float64))
        hits = pgccd.detect(robot.scene(obstacles), robot.trajectory(curve, obstacles))
        assert bool(len(hits)) == touches


def test_invalid_curves(tmp_path: Path) -> None:
    robot = loaded(Arm([HINGE]), tmp_path)
    good, large, far = [[0.0], [1.0], [0.0]], [[0.0], [2e6], [0.0]], [[0.0], [2e4], [0.0]]
    control = torch.tensor([good, large, far, [[0.0], [math.nan], [0.0]]]).movedim(0, 1)
    found = robot.certify(Spline(control, 2))
    assert found.verdict.tolist() == [Verdict.FREE] + 3 * [Verdict.INVALID]
    for rows, message in ((large, "control point 1: expected joint values"), (far, "segment 0: expected turns")):
        with pytest.raises(ValueError, match=f"^q: {message}"):
            robot.trajectory(Spline(torch.tensor(rows), 2))
    with pytest.raises(ValueError, match=r"^q: expected a spline of values \(1,\), or \(B, 1\), got \(2,\)"):
        robot.certify(Spline(torch.zeros(3, 2), 2))
    with pytest.raises(ValueError, match=r"^q: expected a spline of values \(1,\), got 2 paths"):
        robot.trajectory(Spline(torch.zeros(3, 2, 1), 2))
