"""Robots of files, whatever their format."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch

from pgccd.motion.paths import RigidMotion
from pgccd.robots.robot import Robot
from pgccd.search.detect import collide


def robot_of_file(path: Path, neutral: Sequence[float], *parts: Any) -> Robot:
    """A robot of these parts, as `Robot` takes them, from a file. Warns of pairs of links that are tested and touch in
    the `neutral` configuration (J,).

    Raises:
        ValueError: naming the file.
    """
    try:
        robot = Robot(*parts)
    except ValueError as error:
        raise ValueError(f"path: {path}: {error}") from error
    if robot.body_count < 2:
        return robot
    x, r = robot.poses(torch.tensor(neutral, dtype=torch.float64).reshape(-1))
    touching = robot.body_link[collide(robot.scene(), RigidMotion.at_rest(x, r)).pairs]
    if len(touching):
        links = torch.unique(touching.sort(dim=1).values, dim=0).tolist()
        pairs = [(robot.link_names[a], robot.link_names[b]) for a, b in links]
        warnings.warn(
            f"{path}: links touch in the neutral configuration, so no path through it is free. If their surfaces "
            f"overlap by design: robot = robot.allow({pairs})",
            stacklevel=3,
        )
    return robot
