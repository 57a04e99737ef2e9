"""Motions of planners, checked one by one."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from pgccd import arguments
from pgccd.robots.certificate import Certificate
from pgccd.robots.obstacles import Obstacles
from pgccd.robots.path_search import PathSearch
from pgccd.robots.robot import Robot


class MotionValidator:
    """Straight motions in joint space between two configurations, made by `Robot.motion_validator`.

    Called with two configurations (J,), it says whether the motion between them is certainly free of contact.

    Example:
        >>> is_valid = robot.motion_validator(obstacles)
        >>> is_valid([0.0, 0.0], [0.3, 0.1])
        True
    """

    def __init__(self, robot: Robot, obstacles: Obstacles | None, resolution: float | None) -> None:
        if isinstance(obstacles, Obstacles) and obstacles.environments not in (None, 1):
            expected = "obstacles of one environment, with poses (M, 3) and (M, 4)"
            raise ValueError(f"obstacles: expected {expected}, got those of {obstacles.environments}")
        if isinstance(obstacles, Obstacles) and obstacles.motion is not None:
            raise ValueError(
                "obstacles: expected obstacles at rest: a motion alone does not say at which time it begins"
            )
        self._joint_count = robot.joint_count
        self._search = PathSearch(robot, obstacles, resolution)

    def __call__(self, start: Tensor | Sequence[float], goal: Tensor | Sequence[float]) -> bool:
        """Whether the motion is certainly free of contact.

        Args:
            start, goal: (J,) configurations.
        """
        return bool(self._certify(start, goal).free[0])

    def last_valid(self, start: Tensor | Sequence[float], goal: Tensor | Sequence[float]) -> float:
        """The part of the motion, in [0, 1], before which it is certainly free of contact, as OMPL asks: 1 only if all
        of it is, the goal included; 0 if the start is not.

        Args:
            start, goal: (J,) configurations.

        Raises:
            TypeError, ValueError: naming the argument.

        Example:
            >>> is_valid = robot.motion_validator(obstacles)
            >>> is_valid.last_valid([0.0, 0.0], [0.3, 0.1])
            1.0
        """
        found = self._certify(start, goal)
        # A contact at the goal leaves less than the whole motion, however late it is.
        return 1.0 if bool(found.free[0]) else min(float(found.time[0]), math.nextafter(1.0, 0.0))

    def _certify(self, start: Tensor | Sequence[float], goal: Tensor | Sequence[float]) -> Certificate:
        ends = []
        for values, name in ((start, "start"), (goal, "goal")):
            q = arguments.real_numbers(values, name, f"{self._joint_count} numbers")
            if q.shape != (self._joint_count,):
                raise ValueError(f"{name}: expected shape ({self._joint_count},), got {tuple(q.shape)}")
            ends.append(q)
        return self._search.certify(torch.stack(ends)[None])
