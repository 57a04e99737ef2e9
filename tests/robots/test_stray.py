"""The bound of how far links stray from arcs: never exceeded, and nearly attained."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import mpmath
import numpy as np
import pytest
import torch
from oracle.arms import Arm, Part
from support.arms import UPRIGHT, loaded, pose_error, random_arm, stray

from pgccd.motion.paths import RigidMotion
from pgccd.robots import Robot
from pgccd.robots.tables import MOST_TURN, ArmTables

TIMES = np.linspace(0.0, 1.0, 41)


def bound_of(robot: Robot, q0: np.ndarray, q1: np.ndarray) -> np.ndarray:
    """(K, N) without the error of poses, which is that of the larger values."""
    return stray(robot, q0, q1) - stray(robot, q0, q1, 0.0, 0.0)


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
        points = directions[:, None] * np.array([mesh.reach for mesh in robot.meshes])[:, None]
        off = moved[:, :, None] + np.einsum("knij,dnj->kndi", rotated, points)
        most = np.maximum(most, np.linalg.norm(off, axis=3).max(axis=2))
    return most


@pytest.mark.parametrize("seed", range(30))
def test_no_link_strays_further(seed: int, tmp_path: Path) -> None:
    rng = np.random.default_rng(seed)
    arm = random_arm(rng, int(rng.integers(1, 9)))
    robot = loaded(arm, tmp_path)
    q0 = rng.uniform(-3.0, 3.0, (40, robot.joint_count))
    step = rng.normal(size=q0.shape) * (rng.random(q0.shape) < 0.7)
    most = np.maximum(robot._tables.turns(torch.tensor(step)).numpy(), 1e-9)
    step *= (np.minimum(MOST_TURN, 10.0 ** rng.uniform(-4, 0.2, 40)) / most)[:, None]
    q1 = q0 + np.clip(step, -1.0, 1.0)
    assert bool((robot._tables.turns(torch.tensor(q1 - q0)) <= 1.0 + 1e-9).all())
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
    assert abs(bound_of(robot, np.zeros((1, 1)), np.ones((1, 1)))).max() == 0.0
    arm = Arm([hinge, Part("fixed", UPRIGHT, (0, 0.4, 0), (1, 0, 0)), hinge, hinge])
    robot = loaded(arm, tmp_path)
    q0 = rng.uniform(-1, 1, (20, 3))
    q1 = q0 + rng.uniform(-0.3, 0.3, (20, 3))
    first = bound_of(robot, q0, q1)
    robot._tables = ArmTables(robot._tree, robot._frames, [1e3 * mesh.reach for mesh in robot.meshes])
    assert np.allclose(bound_of(robot, q0, q1), first, rtol=0, atol=1e-9)


def chain_of(arm: Arm, part: int) -> list[int]:
    """The parts from the base to this one."""
    chain = []
    while part >= 0:
        chain.append(part)
        parent = arm.parts[part].parent
        part = part - 1 if parent is None else parent
    return chain[::-1]


def values_of(arm: Arm, q: list[float]) -> list[mpmath.mpf]:
    """The exact value of the joint of each part, in a configuration."""
    value = [mpmath.mpf(0)] * len(arm.parts)
    for k, x in zip(arm.coordinates, q, strict=True):
        value[k] = mpmath.mpf(x)
    for k, part in enumerate(arm.parts):
        if part.mimic:
            of, factor, offset = part.mimic
            value[k] = mpmath.mpf(factor) * value[of] + mpmath.mpf(offset)
    return value


def exact_frame(arm: Arm, part: int, values: list[mpmath.mpf]) -> tuple[mpmath.matrix, mpmath.matrix]:
    """Rotation and position of the frame of a part."""

    def turned(axis: list[mpmath.mpf], angle: mpmath.mpf) -> mpmath.matrix:
        x, y, z = axis
        cross = mpmath.matrix([[0, -z, y], [z, 0, -x], [-y, x, 0]])
        return mpmath.eye(3) + mpmath.sin(angle) * cross + (1 - mpmath.cos(angle)) * (cross * cross)

    rotation, position = mpmath.eye(3), mpmath.zeros(3, 1)
    for k in chain_of(arm, part):
        of = arm.parts[k]
        position += rotation * mpmath.matrix([float(x) for x in of.xyz])
        for axis, angle in list(zip(np.eye(3).tolist(), of.rpy, strict=True))[::-1]:
            rotation = rotation * turned(axis, mpmath.mpf(float(angle)))
        length = mpmath.sqrt(sum(mpmath.mpf(float(x)) ** 2 for x in of.axis))
        axis = [mpmath.mpf(float(x)) / length for x in of.axis]
        if of.kind == "revolute":
            rotation = rotation * turned(axis, values[k])
        elif of.kind == "prismatic":
            position += rotation * (values[k] * mpmath.matrix(axis))
    return rotation, position


HINGE = Part("revolute", UPRIGHT, UPRIGHT, (0.3, 0.4, 0.6), half=(0.5, 0.05, 0.05), at=(1.0, 0.0, 0.0))
SLIDE = Part("prismatic", (0.1, 0.2, 0.3), (0.1, 0.7, -0.4), (1.0, 2.0, -0.5), half=(0.1, 0.2, 0.1))
FAR_AWAY = {
    "turns of all joints": (Arm([HINGE, replace(HINGE, half=None, mimic=(0, 98_765.4, 0.1)), HINGE]), [7.1, 0.2]),
    "slides": (Arm([SLIDE]), [-987_654.321]),
    "slides of the joint before": (Arm([SLIDE, HINGE]), [876_543.21, 0.3]),
    "values of a joint that follows": (Arm([HINGE, replace(HINGE, mimic=(0, 123_456.7, 0.1))]), [7.65]),
    "offset of a joint that follows": (Arm([HINGE, replace(HINGE, mimic=(0, 1.0, 912_345.6))]), [0.1]),
    "length of the chain": (Arm([HINGE, replace(HINGE, xyz=(98_765.4, 0.0, 43_210.9))]), [0.7, 0.2]),
}


def errors_and_bounds(arm: Arm, robot: Robot, q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(N,) of the bodies in one configuration (J,): how far a point within reach is from its exact place, at most, and
    the bound of that.
    """
    x, r = (column[0].tolist() for column in robot.poses(torch.tensor(q)[None]))
    bound = pose_error(robot, q[None])[0]
    errors, reaches = [], [mesh.reach for mesh in robot.meshes]
    with mpmath.workdps(40):
        values = values_of(arm, q.tolist())
        for link, position, turn, reach in zip(robot.body_link.tolist(), x, r, reaches, strict=True):
            rotation, exact = exact_frame(arm, int(robot.link_names[link].removeprefix("link")), values)
            w, a, b, c = (mpmath.mpf(part) for part in turn)
            found = mpmath.matrix(
                [
                    [w * w + a * a - b * b - c * c, 2 * (a * b - w * c), 2 * (a * c + w * b)],
                    [2 * (a * b + w * c), w * w - a * a + b * b - c * c, 2 * (b * c - w * a)],
                    [2 * (a * c - w * b), 2 * (b * c + w * a), w * w - a * a - b * b + c * c],
                ]
            ) / (w * w + a * a + b * b + c * c)
            away = mpmath.norm(mpmath.matrix(position) - exact)
            errors.append(float(away + reach * mpmath.mnorm(found - rotation, "f")))
    return np.array(errors), bound


@pytest.mark.parametrize("what", FAR_AWAY)
def test_errors_of_poses_grow_with(what: str, tmp_path: Path) -> None:
    """Poses are compared with exact ones: the bound holds, and would not without the part of this name."""
    arm, q = FAR_AWAY[what]
    robot = loaded(arm, tmp_path)
    largest = 0.0
    for k in range(8):
        given = np.array(q) * (1.0 - k / 1000.0)
        errors, bounds = errors_and_bounds(arm, robot, given)
        assert (errors <= bounds).all(), (errors, bounds)
        largest = max(largest, errors[-1])
    assert largest > 2.0**-46 * (2 + len(arm.parts) + 1.0) * 3.0 * len(arm.parts)


def test_errors_of_poses_of_any_arm(tmp_path: Path) -> None:
    for seed in range(12):
        rng = np.random.default_rng(seed)
        arm = random_arm(rng, int(rng.integers(1, 7)))
        robot = loaded(arm, tmp_path)
        q = rng.uniform(-1.0, 1.0, robot.joint_count) * 10.0 ** rng.uniform(-1.0, 5.9, robot.joint_count)
        errors, bounds = errors_and_bounds(arm, robot, q)
        assert (errors <= bounds).all(), (seed, errors / bounds)


def test_the_error_of_poses_is_as_proven(tmp_path: Path) -> None:
    """128u (1 + joints + sum of angles) times the length of chain and link: known from the parts of the arm."""
    for seed in range(12):
        rng = np.random.default_rng(seed)
        arm = random_arm(rng, int(rng.integers(1, 9)))
        robot = loaded(arm, tmp_path)
        q = rng.uniform(-1.0, 1.0, robot.joint_count) * 10.0 ** rng.uniform(-3.0, 5.9, robot.joint_count)
        (bound,) = pose_error(robot, q[None]).tolist()
        values = [0.0] * len(arm.parts)
        for k, x in zip(arm.coordinates, np.abs(q).tolist(), strict=True):
            values[k] = x
        for k, part in enumerate(arm.parts):
            if part.mimic:
                of, factor, offset = part.mimic
                values[k] = abs(factor) * values[of] + abs(offset)
        for link, found in zip(robot.body_link.tolist(), bound, strict=True):
            last = int(robot.link_names[link].removeprefix("link"))
            chain, part = chain_of(arm, last), arm.parts[last]
            angles = sum(values[k] for k in chain if arm.parts[k].kind == "revolute")
            slides = sum(values[k] for k in chain if arm.parts[k].kind == "prismatic")
            farthest = np.abs(part.at) + (0.0 if part.half is None else np.array(part.half))
            length = np.linalg.norm(farthest) + sum(np.linalg.norm(arm.parts[k].xyz) for k in chain) + slides
            # The joint that places the base in the world counts too.
            least, most = (128.0 * 2.0**-53 * (1 + len(chain) + k + angles) * length for k in (0, 1))
            assert (1.0 - 1e-12) * least <= found <= 1.5 * most, (seed, last)


def test_turns_are_those_of_all_joints_of_a_chain(tmp_path: Path) -> None:
    """Also of joints that follow others at other rates; not of slides; of the link that turns most."""
    side = replace(HINGE, parent=-1)
    arm = Arm([HINGE, SLIDE, replace(HINGE, mimic=(0, -7.5, 0.3)), side])
    tables = loaded(arm, tmp_path)._tables
    step = torch.tensor([[0.2, 5.0, 0.1], [-0.2, 5.0, 1.8], [0.0, 5.0, 0.0]], dtype=torch.float64)
    assert np.allclose(tables.turns(step).numpy(), [0.2 * 8.5, 1.8, 0.0], rtol=1e-9, atol=0.0)


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
