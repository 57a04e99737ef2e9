"""Arms for tests, small hand-written ones and random ones, what they carry, and boxes around them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from oracle.arms import Arm, Part, origin

import pgccd
from pgccd import ops, robots
from pgccd.robots import Obstacles, Robot, shapes
from pgccd.robots.kinematics import Joint, Tree, quaternion_of

UPRIGHT = (0.0, 0.0, 0.0)


def loaded(arm: Arm, folder: Path) -> robots.Robot:
    """The robot of an arm's URDF file."""
    pytest.importorskip("yourdfpy")
    path = folder / "arm.urdf"
    path.write_text(arm.urdf())
    return pgccd.robots.load_urdf(path)


def slider() -> robots.Robot:
    """A cube on a hinge, and one that slides on it: without a file."""
    along_x, z, upright = np.array([0.5, 0.0, 0.0]), np.array([0.0, 0.0, 1.0]), np.array([1.0, 0.0, 0.0, 0.0])
    joints = [Joint("", "fixed", -1, 0.0 * z, upright, z)]
    joints += [Joint(str(k), kind, k, along_x, upright, z, k) for k, kind in enumerate(("revolute", "prismatic"))]  # type: ignore[arg-type]
    links = [(str(k), k + 1, [shapes.box(np.full(3, 0.2))]) for k in range(2)]
    return robots.Robot("arm", Tree(joints), links, ["0", "1"], [(-1.0, 1.0)] * 2, lambda *_: None)


def pose_error(robot: robots.Robot, q: np.ndarray) -> np.ndarray:
    """(K, N): the bound of the error of poses in configurations (K, J)."""
    return stray(robot, q, q, 0.0, 0.0)


def stray(robot: robots.Robot, q0: np.ndarray, q1: np.ndarray, begin: float = 0.0, end: float = 1.0) -> np.ndarray:
    """(K, N): the bound of how far bodies stray, from one time to another while joints move from q0 to q1 (K, J), the
    error of poses included.
    """
    times = (torch.full((len(q0),), s, dtype=torch.float64) for s in (begin, end))
    control = torch.stack([torch.tensor(q, dtype=torch.float64) for q in (q0, q1)], dim=1)
    return ops.arm_arcs(robot._tables.on(torch.device("cpu")), control, 0.0, *times)[-1].numpy()


def beams(joints: int = 4, length: float = 0.4) -> Arm:
    """Beams in a row on joints about z and y in turn."""
    axes = ((0.0, 0.0, 1.0), (0.0, 1.0, 0.0))
    return Arm(
        [
            Part(
                "revolute",
                (length if k else 0.0, 0.0, 0.0),
                UPRIGHT,
                axes[k % 2],
                half=(0.5 * length - 0.03, 0.03, 0.03),
                at=(0.5 * length, 0.0, 0.0),
            )
            for k in range(joints)
        ]
    )


def random_arm(rng: np.random.Generator, parts: int = 6) -> Arm:
    """Any joints in any places, with boxes, balls, and links without a shape."""
    made = []
    for k in range(parts):
        kind = rng.choice(["revolute", "revolute", "revolute", "prismatic", "fixed"]) if k else "revolute"
        shape = {}
        if rng.random() < 0.5:
            shape = {"half": tuple(rng.uniform(0.02, 0.12, 3))}
        elif rng.random() < 0.7:
            shape = {"radius": float(rng.uniform(0.02, 0.1))}
        if not shape and k == parts - 1:
            shape = {"half": (0.05, 0.02, 0.1)}
        mimic = (0, float(rng.uniform(-1, 1)), 0.1) if k > 2 and kind == "revolute" and rng.random() < 0.3 else None
        axis = rng.normal(size=3) if rng.random() < 0.5 else np.eye(3)[rng.integers(3)]
        made.append(
            Part(
                str(kind),
                tuple(rng.uniform(-0.3, 0.3, 3)),
                tuple(rng.uniform(-2, 2, 3)) if rng.random() < 0.5 else UPRIGHT,
                tuple(axis),
                at=tuple(rng.uniform(-0.1, 0.1, 3)),
                mimic=mimic,
                parent=int(rng.integers(-1, k)) if k and rng.random() < 0.2 else None,
                **shape,  # type: ignore[arg-type]
            )
        )
    return Arm(made)


def boxes(rng: np.random.Generator, count: int, near: float, far: float) -> tuple[Obstacles, np.ndarray, np.ndarray]:
    """Obstacles of one environment, their frames and half edges."""
    half = rng.uniform(0.03, 0.15, (count, 3))
    away = rng.normal(size=(count, 3))
    position = away / np.linalg.norm(away, axis=1, keepdims=True) * rng.uniform(near, far, (count, 1))
    q = rng.normal(size=(count, 4))
    q /= np.linalg.norm(q, axis=1, keepdims=True)
    w, x, y, z = q.T
    frames = np.tile(np.eye(4), (count, 1, 1))
    frames[:, :3, :3] = np.moveaxis(
        np.array(
            [
                [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
                [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
                [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
            ]
        ),
        2,
        0,
    )
    frames[:, :3, 3] = position
    obstacles = Obstacles([pgccd.Mesh.box(2 * h) for h in half], torch.tensor(position), torch.tensor(q))
    return obstacles, frames, half


def part_of(robot: Robot, body: int) -> int:
    return int(robot.link_names[int(robot.body_link[body])].removeprefix("link"))


def untested(robot: Robot) -> set[tuple[int, int]]:
    pairs = {tuple(sorted((part_of(robot, i), part_of(robot, j)))) for i, j in robot.exclude.tolist()}
    return pairs  # type: ignore[return-value]


def with_object(arm: Arm, rng: np.random.Generator) -> tuple[Arm, int, tuple[np.ndarray, np.ndarray]]:
    """The arm with a box fixed to one of its parts that move, the part, and the pose of the box in it."""
    moving: list[int] = []
    for k, part in enumerate(arm.parts):
        if part.kind != "fixed" or (k - 1 if part.parent is None else part.parent) in moving:
            moving.append(k)
    carrier = moving[int(rng.integers(len(moving)))]
    xyz, rpy = rng.uniform(-0.3, 0.3, 3), rng.uniform(-2, 2, 3)
    half = tuple(rng.uniform(0.03, 0.15, 3))
    box = Part("fixed", tuple(xyz), tuple(rpy), (1.0, 0.0, 0.0), half=half, parent=carrier)
    return Arm([*arm.parts, box]), carrier, (xyz, quaternion_of(origin(xyz, rpy)[:3, :3]))


def attached_like(robot: Robot, whole: Arm, carrier: int, pose: Any, touching: list[str]) -> Robot:
    part = whole.parts[-1]
    assert part.half is not None
    mesh = pgccd.Mesh.box(2 * np.array(part.half))
    return robot.attach(f"link{carrier}", mesh, pose, touching, name=f"link{len(whole.parts) - 1}")
