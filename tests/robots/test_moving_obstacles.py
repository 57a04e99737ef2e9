"""Obstacles that move on the clock of a path, compared with dense samples of both."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from oracle.arms import Arm, Measure, Part, gaps, least_gaps, turns
from support.arms import UPRIGHT, beams, loaded, random_arm, untested
from support.cases import mostly_slow

import pgccd
from pgccd.robots import Obstacles, Robot, Verdict
from pgccd.robots.kinematics import quaternion_of
from robots.test_path_search import same

SAMPLES = 1001
CUBE = pgccd.Mesh.box([0.1, 0.1, 0.1])


class Sweep:
    """Boxes that move and turn at constant rates in each segment, the latter by up to several turns."""

    def __init__(self, rng: np.random.Generator, count: int, segments: int, near: float, far: float, turn: float):
        self.half = rng.uniform(0.05, 0.2, (count, 3))
        away = rng.normal(size=(segments + 1, count, 3))
        away /= np.linalg.norm(away, axis=2, keepdims=True)
        self.position = away * rng.uniform(near, far, (segments + 1, count, 1))
        self.rotation = rng.normal(size=(segments, count, 3)) * turn
        self.first = np.stack([self.turned(rng.normal(size=3), np.ones(1))[0] for _ in range(count)])
        q = torch.tensor(np.stack([quaternion_of(frame) for frame in self.first]))
        self.motion = pgccd.Trajectory(torch.tensor(self.position), q, rotation=torch.tensor(self.rotation))
        self.obstacles = Obstacles([pgccd.Mesh.box(2 * half) for half in self.half], motion=self.motion)

    @staticmethod
    def turned(rotation: np.ndarray, s: np.ndarray) -> np.ndarray:
        angle = float(np.linalg.norm(rotation))
        return turns(rotation / angle, angle * s)

    def frames(self, segment: int, s: np.ndarray) -> np.ndarray:
        """(M, K, 4, 4): at times s (K,) of a segment."""
        found = np.tile(np.eye(4), (len(self.half), len(s), 1, 1))
        for m, first in enumerate(self.first):
            turn = first
            for k in range(segment):
                turn = self.turned(self.rotation[k, m], np.ones(1))[0] @ turn
            found[m, :, :3, :3] = self.turned(self.rotation[segment, m], s) @ turn
            begin, end = self.position[segment : segment + 2, m]
            found[m, :, :3, 3] = begin + s[:, None] * (end - begin)
        return found


def least(
    arm: Arm,
    q: np.ndarray,
    sweep: Sweep,
    segment: int,
    s: np.ndarray,
    names: set[tuple[int, int]],
    measure: Measure = gaps,
) -> np.ndarray:
    """(K,): the least gap of links with each other and with obstacles."""
    found = least_gaps(arm, q, np.empty((0, 4, 4)), np.empty((0, 3)), names, measure)
    shapes, (sizes, radii) = arm.shapes(q), arm.sizes()
    for frames, half in zip(sweep.frames(segment, s), sweep.half, strict=True):
        for k in range(len(arm.parts)):
            if not np.isnan(sizes[k]).any():
                found = np.minimum(found, measure(shapes[:, k], sizes[k], frames, half) - radii[k])
    return found


@pytest.mark.parametrize("seed", mostly_slow(range(8), [0, 1]))
def test_nothing_is_missed_and_nothing_late(seed: int, tmp_path: Path) -> None:
    rng = np.random.default_rng([seed, 3])
    arm = beams(4) if seed % 2 else random_arm(rng, 5)
    robot = loaded(arm, tmp_path)
    sweep = Sweep(rng, 5, 2, 0.3 * robot.reach, 0.9 * robot.reach, turn=(0.5, 2.0, 8.0)[seed % 3])
    q = rng.uniform(-1.0, 1.0, (8, 1, robot.joint_count))
    q = np.concatenate([q, q + 0.7 * rng.normal(size=(8, 2, robot.joint_count)).cumsum(axis=1)], axis=1)
    found = robot.certify(torch.tensor(q), sweep.obstacles)
    s, names, resolution = np.linspace(0.0, 1.0, SAMPLES), untested(robot), 1e-3 * robot.reach
    for b in range(len(q)):
        ways = [q[b, k] + s[:, None] * (q[b, k + 1] - q[b, k]) for k in range(2)]
        gap = np.stack([least(arm, way, sweep, k, s, names) for k, way in enumerate(ways)])
        verdict, time = Verdict(int(found.verdict[b])), float(found.time[b])
        if len(touching := np.argwhere(gap <= 0.0)):
            k, n = touching[0]
            assert verdict != Verdict.FREE and time <= (k + n / (SAMPLES - 1)) / 2, b
        assert (verdict == Verdict.START) == bool(gap[0, 0] <= 0.0), b
        if verdict in (Verdict.COLLISION, Verdict.NEAR):
            k, toi = int(found.segment[b]), float(found.toi[b])
            now = np.clip([toi, toi + 1e-5], 0.0, 1.0)
            around = q[b, k] + now[:, None] * (q[b, k + 1] - q[b, k])
            assert least(arm, around, sweep, k, now, names).min() <= 1.1 * resolution, b
        if verdict == Verdict.COLLISION:
            assert gap.min() <= 1e-3 * robot.reach, b
    assert int(Verdict.COLLISION) in found.verdict.tolist()
    for b in range(0, 8, 3):
        same(robot.certify(torch.tensor(q[b : b + 1]), sweep.obstacles), found, b)


def test_the_time_of_a_blade(tmp_path: Path) -> None:
    """It turns by 1.75 turns while the robot hardly moves: the longer way, at equal rate, whatever the steps."""
    post = Part("prismatic", (1.0, 0.0, 0.0), UPRIGHT, (0, 0, 1), radius=0.1)
    robot = loaded(Arm([post]), tmp_path)
    blade = pgccd.Mesh.box([2.4, 0.02, 0.02])
    for sign in (1.0, -1.0):
        # Both ends of the blade count: from a quarter turn on, the ball is a quarter turn ahead.
        begin = torch.tensor([[math.cos(math.pi / 4), 0.0, 0.0, math.sin(math.pi / 4)]], dtype=torch.float64)
        rotation = torch.tensor([[[0.0, 0.0, sign * 3.5 * math.pi]]], dtype=torch.float64)
        motion = pgccd.Trajectory(torch.zeros(2, 1, 3, dtype=torch.float64), begin, rotation=rotation)
        expected = (math.pi / 2 - math.asin(0.11)) / (3.5 * math.pi)
        for slide in (0.0, 0.01, 0.1):
            q = torch.tensor([[[0.0], [slide]]], dtype=torch.float64)
            found = robot.certify(q, Obstacles([blade], motion=motion, names=["blade"]))
            assert found.verdict.tolist() == [int(Verdict.COLLISION)] and found.names(0) == ("link0", "blade")
            assert -1e-3 < float(found.time[0]) - expected < 1e-3


def test_whole_segments_and_parts_of_them(tmp_path: Path) -> None:
    """Segments that are cut in halves, of joints and obstacles alike, have the same times."""
    rng = np.random.default_rng(12)
    robot = loaded(beams(4), tmp_path)
    sweep = Sweep(rng, 4, 1, 0.6 * robot.reach, 1.2 * robot.reach, turn=2.0)
    q = rng.uniform(-1.0, 1.0, (12, 1, 4)) + np.concatenate([np.zeros((12, 1, 4)), rng.normal(size=(12, 1, 4))], axis=1)
    whole = robot.certify(torch.tensor(q), sweep.obstacles)
    position, rotation = torch.tensor(sweep.position), torch.tensor(sweep.rotation)
    assert sweep.motion.orientation is not None
    halves = pgccd.Trajectory(
        torch.stack([position[0], 0.5 * (position[0] + position[1]), position[1]]),
        sweep.motion.orientation[0],
        rotation=0.5 * rotation.expand(2, -1, -1),
    )
    cut = np.stack([q[:, 0], 0.5 * (q[:, 0] + q[:, 1]), q[:, 1]], axis=1)
    parts = robot.certify(torch.tensor(cut), Obstacles(sweep.obstacles.meshes, motion=halves))
    assert parts.free.tolist() == whole.free.tolist() and 0 < int(whole.free.sum()) < 12
    met = ~whole.free
    torch.testing.assert_close(parts.time[met], whole.time[met], rtol=0.0, atol=5e-3)


def rest(robot: Robot, waypoints: int = 2) -> torch.Tensor:
    return torch.zeros(1, waypoints, robot.joint_count, dtype=torch.float64)


def along(*x: float, y: float = 0.0) -> pgccd.Trajectory:
    """Of an obstacle along x, through these waypoints."""
    position = torch.tensor([[[each, y, 0.0]] for each in x], dtype=torch.float64)
    return pgccd.Trajectory(position, torch.tensor([1.0, 0, 0, 0], dtype=torch.float64).expand(len(x), 1, 4))


def test_where_obstacles_are_when(tmp_path: Path) -> None:
    """Contacts at the start, on the way, at the very end and after it are told apart."""
    robot = loaded(Arm([Part("revolute", UPRIGHT, UPRIGHT, (0, 0, 1), half=(0.1, 0.1, 0.1))]), tmp_path)
    cases = [
        ((0.0, 5.0), Verdict.START, 0.0),
        ((5.0, 0.0), Verdict.COLLISION, (5.0 - 0.15) / 5.0),
        ((5.0, -5.0), Verdict.COLLISION, (5.0 - 0.15) / 10.0),
        ((5.0, 0.16), Verdict.FREE, math.inf),
        ((5.0, 3.0, 0.1), Verdict.COLLISION, 0.5 + 0.5 * 2.85 / 2.9),
        ((5.0, 3.0, -4.0, 9.0), Verdict.COLLISION, (1.0 + 2.85 / 7.0) / 3.0),
    ]
    for x, verdict, time in cases:
        found = robot.certify(rest(robot, len(x)), Obstacles([CUBE], motion=along(*x)))
        assert found.verdict.tolist() == [int(verdict)], x
        assert float(found.time[0]) == pytest.approx(time, abs=1e-3)
        beside = robot.certify(rest(robot, len(x)), Obstacles([CUBE], motion=along(*x, y=0.2)))
        assert bool(beside.free[0])
        thick = robot.certify(rest(robot, len(x)), Obstacles([CUBE], motion=along(*x, y=0.2), margin=0.06))
        assert bool(thick.free[0]) == (verdict == Verdict.FREE) or verdict == Verdict.FREE
    crossing = torch.tensor([[[0.0], [1.0]]], dtype=torch.float64)
    assert bool(robot.certify(crossing, Obstacles([CUBE], motion=along(5.0, 0.25))).free[0])


def test_what_is_tested_with_what(tmp_path: Path) -> None:
    """What moves is tested with links that do not, what rests is not; obstacles are not tested with each other."""
    parts = [Part("fixed", UPRIGHT, UPRIGHT, (0, 0, 1), half=(0.1,) * 3)]
    parts.append(Part("revolute", (5.0, 0.0, 0.0), UPRIGHT, (0, 0, 1), half=(0.1,) * 3))
    robot = loaded(Arm(parts), tmp_path)
    position = torch.tensor([[[0.0, 0.0, 0.0], [0.0, 3.0, 0.0], [0.0, 3.0, 0.0]]] * 3, dtype=torch.float64)
    turn = torch.tensor([1.0, 0, 0, 0], dtype=torch.float64).expand(3, 3, 4)
    names = ["table", "cart", "other"]

    def certified(y: float, robot: Robot = robot) -> Any:
        at = position.clone()
        at[1, 1, 1] = y
        obstacles = Obstacles([CUBE], motion=pgccd.Trajectory(at, turn), mesh_index=[0, 0, 0], names=names)
        assert obstacles.moves.tolist() == [False, y != 3.0, False]
        return robot.certify(rest(robot, 3), obstacles)

    assert bool(certified(3.0).free[0]) and bool(certified(0.5).free[0])
    found = certified(0.1)
    assert found.verdict.tolist() == [int(Verdict.COLLISION)] and found.names(0) == ("link0", "cart")
    assert bool(certified(0.1, robot.allow([("link0", "cart")])).free[0])
    assert not bool(certified(0.1, robot.allow([("link0", "other")])).free[0])
    upright = [1.0, 0.0, 0.0, 0.0]
    carrying = robot.attach("link1", CUBE, ([-4.95, 1.0, 0.0], upright), name="box")
    assert certified(0.95, carrying).names(0) == ("box", "cart") and bool(certified(1.3, carrying).free[0])
    inside = robot.attach("link1", CUBE, ([-5.0, 0.0, 0.0], upright), name="box")  # links are tested with each other
    for y in (3.0, 2.0):
        assert certified(y, inside).names(0) == ("link0", "box")
    # The last waypoint counts too, and a turn on the spot.
    spin = pgccd.Trajectory(
        torch.zeros(2, 1, 3, dtype=torch.float64),
        torch.tensor([[1.0, 0, 0, 0]], dtype=torch.float64),
        rotation=torch.tensor([[[0.0, 0.0, 1.0]]], dtype=torch.float64),
    )
    assert Obstacles([CUBE], motion=spin).moves.tolist() == [True]
    assert Obstacles([CUBE], motion=along(1.0, 1.0, 2.0)).moves.tolist() == [True]


def test_obstacles_that_do_not_move_after_all(tmp_path: Path) -> None:
    rng = np.random.default_rng(2)
    robot = loaded(beams(4), tmp_path)
    sweep = Sweep(rng, 4, 2, 0.4, 1.2, turn=1.0)
    assert sweep.motion.orientation is not None
    x, r = sweep.motion.position[:1], sweep.motion.orientation[:1]
    moving = Obstacles(sweep.obstacles.meshes, motion=pgccd.Trajectory(x.expand(3, -1, -1), r.expand(3, -1, -1)))
    q = torch.tensor(rng.uniform(-1, 1, (10, 3, 4)))
    a, b = robot.certify(q, moving), robot.certify(q, Obstacles(sweep.obstacles.meshes, x[0], r[0]))
    assert a.verdict.tolist() == b.verdict.tolist() and not bool(moving.moves.any())
    torch.testing.assert_close(a.time, b.time, rtol=0.0, atol=1e-9)


def test_what_cannot_move(tmp_path: Path) -> None:
    robot = loaded(Arm([Part("revolute", UPRIGHT, UPRIGHT, (0, 0, 1), half=(0.1, 0.1, 0.1))]), tmp_path)
    obstacles = Obstacles([CUBE], motion=along(5.0, 4.0))
    assert "moving=1" in repr(obstacles) and obstacles.environments is None
    with pytest.raises(ValueError, match="^q: expected 2 waypoints, as the obstacles have, got 3"):
        robot.certify(rest(robot, 3), obstacles)
    with pytest.raises(ValueError, match="^obstacles: expected obstacles at rest"):
        robot.motion_validator(obstacles)
    with pytest.raises(ValueError, match="^obstacles: expected obstacles with one pose each, got .*moving=1"):
        robot.trajectory(rest(robot)[0], obstacles)
    plain = along(5.0, 4.0)
    thick = pgccd.Trajectory(plain.position, plain.orientation, margin=torch.zeros(1, 1))
    linear = pgccd.Trajectory(plain.position, plain.orientation, "linear")
    wanting = pgccd.Trajectory(plain.position.clone().requires_grad_(), plain.orientation)
    cases: list[tuple[dict[str, Any], type[Exception], str]] = [
        ({"motion": thick}, ValueError, "motion: expected rigid bodies on rigid paths, without margins"),
        ({"motion": linear}, ValueError, "motion: expected rigid bodies on rigid paths"),
        ({"motion": pgccd.Trajectory(torch.zeros(2, 8, 3))}, ValueError, "motion: expected rigid bodies"),
        ({"motion": plain.position}, TypeError, "motion: expected"),
        ({"motion": plain, "mesh_index": [0, 0]}, ValueError, "motion: expected 2 bodies, one of each obstacle, got 1"),
        ({"motion": plain, "position": torch.zeros(1, 3)}, ValueError, "motion: expected it without position"),
        ({"motion": wanting}, ValueError, "position: requires grad"),
    ]
    for given, error, message in cases:
        with pytest.raises(error, match="^" + message):
            Obstacles([CUBE], **given)
    # What is given may be changed afterwards.
    before = robot.certify(rest(robot), obstacles)
    assert obstacles.motion is not None
    obstacles.motion.position[:] = 0.0
    same(robot.certify(rest(robot), obstacles), before, 0)
