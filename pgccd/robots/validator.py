"""Motions of planners, checked one by one."""

from __future__ import annotations

import os
import threading
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from pgccd import arguments
from pgccd.robots.certificate import Verdict
from pgccd.robots.motion_library import BUSY, NativeValidator
from pgccd.robots.obstacles import Obstacles
from pgccd.robots.path_search import PathSearch
from pgccd.robots.robot import Robot


@dataclass(frozen=True)
class Motion:
    """What is known of a motion between two configurations.

    Attributes:
        verdict: as for `certify`, but `COLLISION` and `NEAR` are not distinguished.
        free_until: the part of the motion, in [0, 1], before which it is certainly free of contact, as OMPL defines it:
            1 only if the whole motion is free, the goal included; 0 if the start is not free, or the verdict is
            `UNDECIDED`.
        names: of the link and of the link or obstacle that meet there; empty if nothing meets.
        point: (x, y, z) where they meet, world frame; nan if nothing meets.
    """

    verdict: Verdict
    free_until: float
    names: tuple[str, ...]
    point: tuple[float, float, float]


class MotionValidator:
    """Straight motions in joint space between two configurations, made by `Robot.motion_validator`.

    Call it with two configurations (J,): it returns whether the motion between them is certainly free of contact. It
    runs on a CPU. It keeps certified distances of pairs of bodies between calls; verdicts do not depend on them. Each
    thread needs a validator of its own, from `clone`. Calls release the global interpreter lock.

    Example:
        >>> is_valid = robot.motion_validator(obstacles)
        >>> is_valid([0.0, 0.0], [0.3, 0.1])
        True
    """

    def __init__(self, robot: Robot, obstacles: Obstacles | None, resolution: float | None) -> None:
        if isinstance(obstacles, Obstacles) and obstacles.environments not in (None, 1):
            expected = "obstacles of one environment, with poses (M, 3) and (M, 4)"
            raise ValueError(f"obstacles: expected {expected}, got {obstacles.environments} environments")
        if isinstance(obstacles, Obstacles) and obstacles.motion is not None:
            raise ValueError(
                "obstacles: expected obstacles at rest, since a motion does not say at which time it begins"
            )
        search = PathSearch(robot, obstacles, resolution)
        self._names = [robot.link_names[link] for link in robot.body_link.tolist()]
        self._names += [] if obstacles is None else obstacles.names
        self._joint_count = robot.joint_count
        mesh_set, bodies, of_obstacles = search._tensors_on(torch.device("cpu"))
        tables = [*mesh_set, *robot._tables.on(torch.device("cpu")), *bodies, *of_obstacles]
        self._native = NativeValidator.of(tables, robot.joint_count, robot._room, search.resolution)
        self._thread: int | None = None

    def __call__(self, start: Tensor | Sequence[float], goal: Tensor | Sequence[float]) -> bool:
        """Whether the motion is certainly free of contact.

        Args:
            start, goal: (J,) configurations.

        Raises:
            TypeError, ValueError: naming the argument.
            RuntimeError: another thread has used this validator.
        """
        return self._checked(start, goal, 0, False) == 0

    def check(
        self, start: Tensor | Sequence[float], goal: Tensor | Sequence[float], *, budget: int | None = None
    ) -> Motion:
        """Whether the motion is certainly free of contact; if not, until when it is free, and what meets.

        Args:
            start, goal: (J,) configurations.
            budget: the largest number of tests of a pair of bodies over a part of the motion; if it does not suffice,
                the verdict is `UNDECIDED`. A free motion takes some ten tests. Default: no limit.

        Raises:
            TypeError, ValueError: naming the argument.
            RuntimeError: another thread has used this validator.

        Example:
            >>> is_valid = robot.motion_validator(obstacles)
            >>> is_valid.check([0.0, 0.0], [0.3, 0.1]).free_until
            1.0
        """
        most = 0 if budget is None else arguments.integer(budget, "budget", 1, "a number of pairs > 0")
        verdict = Verdict(self._checked(start, goal, most, True))
        motion = self._native.motion
        names = tuple(self._names[body] for body in motion.bodies if body >= 0)
        x, y, z = motion.point
        return Motion(verdict, motion.free_until, names, (x, y, z))

    def last_valid(self, start: Tensor | Sequence[float], goal: Tensor | Sequence[float]) -> float:
        """`free_until` of `check`.

        Args:
            start, goal: (J,) configurations.

        Raises:
            TypeError, ValueError, RuntimeError: as `check`.

        Example:
            >>> is_valid = robot.motion_validator(obstacles)
            >>> is_valid.last_valid([0.0, 0.0], [0.3, 0.1])
            1.0
        """
        return self.check(start, goal).free_until

    def check_states(self, q: Tensor | Sequence[Sequence[float]] | Sequence[float]) -> Tensor:
        """For each configuration, whether no two surfaces touch in it.

        Args:
            q: (K, J) configurations, or one, (J,).

        Returns:
            (K,) bool, or () for one configuration. False also where a value is not finite, or too large.

        Raises:
            TypeError, ValueError, RuntimeError: as `check`.

        Example:
            >>> is_valid = robot.motion_validator(obstacles)
            >>> is_valid.check_states([[0.0, 0.0], [0.3, 0.1]])
            tensor([True, True])
        """
        expected = f"configurations (K, {self._joint_count})"
        states = arguments.real_numbers(q, "q", expected).to(torch.float64).cpu()
        if states.dim() not in (1, 2) or states.shape[-1] != self._joint_count:
            raise ValueError(f"q: expected {expected}, got shape {tuple(states.shape)}")
        self._require_thread()
        valid = self._native.check_states(states.reshape(-1, self._joint_count).contiguous())
        if valid is None:
            raise RuntimeError(_USED_BY_TWO)
        return valid.reshape(states.shape[:-1])

    def clone(self) -> MotionValidator:
        """A validator of the same robot and obstacles, for another thread. It starts without stored distances.

        Example:
            >>> another = robot.motion_validator(obstacles).clone()
        """
        other = object.__new__(MotionValidator)
        other.__dict__.update(self.__dict__, _native=self._native.clone(), _thread=None)
        return other

    def save(self, path: str | os.PathLike[str]) -> None:
        """Writes the robot and its obstacles, as they are, to a file for programs in C and C++: see
        docs/how-to/planners.md.

        Args:
            path: of the file.

        Raises:
            OSError: it cannot be written.

        Example:
            >>> robot.motion_validator(obstacles).save("arm.pgccd")
        """
        self._native.save(path)

    def _checked(self, start: Any, goal: Any, budget: int, wants_first: bool) -> int:
        self._require_thread()
        ends = [start, goal]
        for k, (values, name) in enumerate(zip(ends, ("start", "goal"), strict=True)):
            # Lists and tuples of Python's numbers are read as they are.
            if not (isinstance(values, (list, tuple)) and len(values) == self._joint_count and _are_floats(values)):
                q = arguments.real_numbers(values, name, f"{self._joint_count} numbers")
                if q.shape != (self._joint_count,):
                    raise ValueError(f"{name}: expected shape ({self._joint_count},), got {tuple(q.shape)}")
                ends[k] = q.tolist()
        code = self._native.check_motion(ends[0], ends[1], budget, wants_first)
        if code == BUSY:
            raise RuntimeError(_USED_BY_TWO)
        return code

    def _require_thread(self) -> None:
        here = threading.get_ident()
        if self._thread != here:
            if self._thread is not None:
                raise RuntimeError(_USED_BY_TWO)
            self._thread = here


_USED_BY_TWO = "a motion validator is used by one thread: clone() makes another one for another thread"


def _are_floats(values: Sequence[Any]) -> bool:
    return all(type(value) is float for value in values)
