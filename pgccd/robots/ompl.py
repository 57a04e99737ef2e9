"""Validity of states and motions for planners of OMPL, in its Python bindings (`pip install ompl`)."""

from __future__ import annotations

from typing import Any

from ompl import base

from pgccd.robots.obstacles import Obstacles
from pgccd.robots.robot import Robot
from pgccd.robots.validator import MotionValidator


class CertifiedMotions(base.MotionValidator):
    """A motion validator of OMPL: the straight motion between two states is valid if it is certainly free of contact at
    every time.

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
        """Whether the motion is valid; OMPL calls it with a valid start."""
        return self._validator(values_of(start, self._count), values_of(goal, self._count))


class StatesWithoutContact(base.StateValidityChecker):
    """A state validity checker of OMPL: a state is valid within the bounds of its space if no two surfaces touch.

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
        """Whether the state is valid."""
        if not self._information.satisfiesBounds(state):
            return False
        return bool(self._validator.check_states(values_of(state, self._count)))


def use(
    space_information: Any, robot: Robot, obstacles: Obstacles | None = None, *, resolution: float | None = None
) -> MotionValidator:
    """Sets a motion validator and a state validity checker of pgccd. Planners then run on one thread.

    Args:
        space_information: of a `RealVectorStateSpace` with a dimension for each joint of the robot.
        robot, obstacles, resolution: as of `Robot.motion_validator`.

    Returns:
        The validator that both use.

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
