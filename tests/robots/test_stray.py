"""The bound of how far links stray from arcs: never exceeded, and nearly attained."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from oracle.arms import Arm, Part
from support.arms import UPRIGHT, loaded, random_arm

from pgccd.motion.paths import RigidMotion
from pgccd.robots import Robot
from pgccd.robots.stray import MOST_TURN, stray_bound, turns

TIMES = np.linspace(0.0, 1.0, 41)


def bound_of(robot: Robot, q0: np.ndarray, q1: np.ndarray) -> np.ndarray:
    """(K, N) without the error of poses."""
    start, end = (robot._tree.forward(torch.tensor(q)) for q in (q0, q1))
    return stray_bound(robot._chains_on(start.value.device), start, end).numpy()


def strays(robot: Robot, arm: Arm, q0: np.ndarray, q1: np.ndarray) -> np.ndarray:
    """(K, N): the largest distance of a point within the reach of a body from its place on the arc, at 41 times."""
    x, r = (column.flatten(0, 1) for column in robot.poses(torch.tensor(np.stack([q0, q1], axis=1))))
    count, bodies = len(q0), robot.body_count
    x, r = x.reshape(count, 2, bodies, 3), r.reshape(count, 2, bodies, 4)
    motion = RigidMotion(*(column.flatten(0, 1) for column in (x[:, 0], r[:, 0], x[:, 1], r[:, 1])))
    position, orientation = motion.at(torch.tensor(TIMES)[:, None])
    parts = [int(robot.link_names[link].removeprefix("link")) for link in robot.body_link.tolist()]
    most = np.zeros((count, bodies))
    for k, t in enumerate(TIMES):
        frames = arm.frames(q0 + t * (q1 - q0))[:, parts]
        w, a, b, c = orientation[k].numpy().reshape(count, bodies, 4).transpose(2, 0, 1)
        on_arc = np.array(
            [
                [1 - 2 * (b * b + c * c), 2 * (a * b - w * c), 2 * (a * c + w * b)],
                [2 * (a * b + w * c), 1 - 2 * (a * a + c * c), 2 * (b * c - w * a)],
                [2 * (a * c - w * b), 2 * (b * c + w * a), 1 - 2 * (a * a + b * b)],
            ]
        ).transpose(2, 3, 0, 1)
        moved = frames[..., :3, 3] - position[k].numpy().reshape(count, bodies, 3)
        rotated = frames[..., :3, :3] - on_arc
        # The farthest of points in several directions at the reach.
        directions = np.random.default_rng(0).normal(size=(60, 3))
        directions = np.concatenate([directions, np.eye(3), -np.eye(3)])
        directions /= np.linalg.norm(directions, axis=1, keepdims=True)
        points = directions[:, None] * np.array(robot._extents)[:, None]
        off = moved[:, :, None] + np.einsum("knij,dnj->kndi", rotated, points)
        most = np.maximum(most, np.linalg.norm(off, axis=3).max(axis=2))
    return most


@pytest.mark.parametrize("seed", range(30))
def test_no_link_strays_further(seed: int, tmp_path: Path) -> None:
    rng = np.random.default_rng(seed)
    arm = random_arm(rng, int(rng.integers(1, 9)))
    robot = loaded(arm, tmp_path)
    chains = robot._chains_on(torch.device("cpu"))
    q0 = rng.uniform(-3.0, 3.0, (40, robot.joint_count))
    step = rng.normal(size=q0.shape) * (rng.random(q0.shape) < 0.7)
    most = np.maximum(turns(chains, torch.tensor(step)).numpy(), 1e-9)
    step *= (np.minimum(MOST_TURN, 10.0 ** rng.uniform(-4, 0.2, 40)) / most)[:, None]
    q1 = q0 + np.clip(step, -1.0, 1.0)
    assert bool((turns(chains, torch.tensor(q1 - q0)) <= 1.0 + 1e-9).all())
    bound, stray = bound_of(robot, q0, q1), strays(robot, arm, q0, q1)
    assert (stray <= bound + 1e-13).all(), (stray / bound).max()
    assert (bound <= 60.0 * stray + 1e-12).mean() > 0.3  # not far from it


def attained(arm: Arm, step: list[float], tmp_path: Path) -> float:
    """The stray of the last body as a part of its bound."""
    robot = loaded(arm, tmp_path)
    q0 = np.zeros((1, len(step)))
    q1 = q0 + np.array([step])
    return float((strays(robot, arm, q0, q1) / bound_of(robot, q0, q1))[0, -1])


def test_the_bound_of_origins_is_attained(tmp_path: Path) -> None:
    """A slider at the end of a turning rod: its origin is on a circle, the arc is the chord."""
    rod = Part("revolute", UPRIGHT, UPRIGHT, (0, 0, 1))
    end = Part("prismatic", (1.0, 0.0, 0.0), UPRIGHT, (1, 0, 0), radius=1e-3)
    assert 0.99999 < attained(Arm([rod, end]), [0.01, 0.0], tmp_path) <= 1.0
    # Also while it slides: the acceleration is 2 d e across, besides d^2 L along the rod.
    across = attained(Arm([rod, Part("prismatic", UPRIGHT, UPRIGHT, (1, 0, 0), radius=1e-3)]), [1e-4, 1.0], tmp_path)
    assert 0.999 < across <= 1.0


def test_the_bound_of_rotations_is_attained(tmp_path: Path) -> None:
    """Two crossed axes through one point: the link turns about an axis that changes."""
    first = Part("revolute", UPRIGHT, UPRIGHT, (0, 0, 1))
    second = Part("revolute", UPRIGHT, UPRIGHT, (0, 1, 0), half=(0.5, 0.4, 0.3))
    assert 0.9985 < attained(Arm([first, second]), [1.5e-4, 1.5e-4], tmp_path) <= 1.0
    oblique = Part("revolute", UPRIGHT, (np.pi / 6, 0, 0), (0, 0, 1), half=(0.5, 0.4, 0.3))
    assert 0.998 < attained(Arm([first, oblique]), [1.5e-4, 1.5e-4], tmp_path) <= 1.0


def test_single_and_parallel_joints_turn_on_arcs(tmp_path: Path) -> None:
    """A link does not stray from an arc whose axis is its joint, nor does it turn otherwise on parallel axes."""
    rng = np.random.default_rng(1)
    hinge = Part("revolute", (0.2, 0.1, 0), UPRIGHT, (0, 1, 0), half=(0.1, 0.1, 0.1))
    robot = loaded(Arm([hinge]), tmp_path)
    assert float(bound_of(robot, np.zeros((1, 1)), np.ones((1, 1))).max()) == 0.0
    arm = Arm([hinge, Part("fixed", UPRIGHT, (0, 0.4, 0), (1, 0, 0)), hinge, hinge])
    robot = loaded(arm, tmp_path)
    q0 = rng.uniform(-1, 1, (20, 3))
    q1 = q0 + rng.uniform(-0.3, 0.3, (20, 3))
    first = bound_of(robot, q0, q1)
    robot._extents = [1e3 * extent for extent in robot._extents]
    assert np.allclose(bound_of(robot, q0, q1), first, rtol=0, atol=1e-9)


def test_margins_of_trajectories(tmp_path: Path) -> None:
    """`Robot.trajectory` has the bound and the error of poses as margins, and refuses larger turns."""
    rng = np.random.default_rng(4)
    arm = random_arm(rng, 6)
    robot = loaded(arm, tmp_path)
    q = rng.uniform(-1, 1, (1, robot.joint_count)) + np.linspace(0, 0.4, 9)[:, None] / robot.joint_count
    trajectory = robot.trajectory(torch.tensor(q))
    assert trajectory.margin is not None
    bound = bound_of(robot, q[:-1], q[1:])
    assert (trajectory.margin.numpy() > bound).all() and (trajectory.margin.numpy() < bound + 1e-11).all()
    with pytest.raises(ValueError, match="^q: segment 1: expected turns of at most 10000 rad, all joints added, got"):
        robot.trajectory(torch.tensor(q[[0, 1, 1]] + 2e4 * np.array([[0.0], [0.0], [1.0]])))
