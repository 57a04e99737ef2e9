"""Validity of states and motions for planners of OMPL, in its Python bindings (`pip install ompl`)."""

from __future__ import annotations

from typing import Any

from ompl import base

from pgccd.robots.obstacles import Obstacles
from pgccd.robots.robot import Robot
from pgccd.robots.validator import MotionValidator


class CertifiedMotions(base.MotionValidator):
    """OMPL's question whether the straight motion between two states is valid, answered by `pgccd`: only if it is
    certainly free of contact at every time.

    Args:
        space_information: of a `RealVectorStateSpace` with a dimension for each joint of the robot.
        validator: from `Robot.motion_validator`.

    Example:
        >>> pgccd.robots.ompl.use(space_information, robot, obstacles)
    """

    def __init__(self, space_information: Any, validator: MotionValidator) -> None:
        super().__init__(space_information)
        self._validator, self._count = validator, space_information.getStateDimension()

    def checkMotion(self, start: Any, goal: Any) -> bool:  # noqa: N802
        """As OMPL asks: whether the motion is valid. The start is known to be."""
        return self._validator(values_of(start, self._count), values_of(goal, self._count))


class StatesWithoutContact(base.StateValidityChecker):
    """OMPL's question whether a state is valid: within the bounds of its space, and no two surfaces touch.

    Args:
        space_information: as of `CertifiedMotions`.
        validator: from `Robot.motion_validator`.

    Example:
        >>> pgccd.robots.ompl.use(space_information, robot, obstacles)
    """

    def __init__(self, space_information: Any, validator: MotionValidator) -> None:
        super().__init__(space_information)
        self._information, self._validator = space_information, validator
        self._count = space_information.getStateDimension()

    def isValid(self, state: Any) -> bool:  # noqa: N802
        """As OMPL asks."""
        if not self._information.satisfiesBounds(state):
            return False
        return bool(self._validator.check_states(values_of(state, self._count)))


def use(
    space_information: Any, robot: Robot, obstacles: Obstacles | None = None, *, resolution: float | None = None
) -> MotionValidator:
    """Makes the planners of a space ask pgccd. Planners then run on one thread.

    Args:
        space_information: of a `RealVectorStateSpace` with a dimension for each joint of the robot.
        robot, obstacles, resolution: as of `Robot.motion_validator`.

    Returns:
        The validator that is asked.

    Raises:
        ValueError: the space has another dimension than the robot has joints.

    Example:
        >>> validator = pgccd.robots.ompl.use(space_information, robot, obstacles)
    """
    if space_information.getStateDimension() != robot.joint_count:
        expected = f"a space of {robot.joint_count} dimensions, as the robot has joints"
        raise ValueError(f"space_information: expected {expected}, got {space_information.getStateDimension()}")
    validator = robot.motion_validator(obstacles, resolution=resolution)
    space_information.setStateValidityChecker(StatesWithoutContact(space_information, validator))
    space_information.setMotionValidator(CertifiedMotions(space_information, validator))
    return validator


def values_of(state: Any, count: int) -> list[float]:
    """The values of a state of a `RealVectorStateSpace`."""
    return [state[k] for k in range(count)]
