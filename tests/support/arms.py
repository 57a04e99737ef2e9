"""Arms for tests: small hand-written ones, and random ones."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from oracle.arms import Arm, Part

import pgccd
from pgccd import ops, robots
from pgccd.robots import shapes
from pgccd.robots.kinematics import Joint, Tree

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
