"""Paths in joint space as the operators read them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from pgccd import arguments
from pgccd.motion.splines import Spline
from pgccd.robots.tables import LARGEST_VALUE, LONGEST_TURN

if TYPE_CHECKING:
    from pgccd.robots.robot import Robot


@dataclass(frozen=True)
class JointPaths:
    """B paths of S segments, each a Bernstein polynomial.

    Attributes:
        control: (B, S degree + 1, J) float64 control points; of degree 1 waypoints.
        degree: of the polynomials.
        error: bound of the difference between the given paths and the paths of the control points.
    """

    control: Tensor
    degree: int = 1
    error: float = 0.0

    @classmethod
    def of(cls, robot: Robot, q: Tensor | Spline) -> JointPaths:
        """Paths given as waypoints (T, J) or (B, T, J), or as a spline of configurations (J,) or (B, J).

        Raises:
            TypeError, ValueError: they are something else, or require grad.
        """
        count = robot.joint_count
        if isinstance(q, Spline):
            shape = q.control.shape[1:]
            if len(shape) not in (1, 2) or shape[-1] != count:
                expected = f"a spline of values ({count},), or (B, {count})"
                raise ValueError(f"q: expected {expected}, got {tuple(shape)}")
            control = q.control.reshape(len(q.control), -1, count).swapaxes(0, 1)
            return cls(control.contiguous(), q.degree, q.error)
        expected = f"waypoints (T, {count}) or (B, T, {count}) with T >= 2"
        q = robot._configurations(arguments.real_numbers(q, "q", expected), "q")
        arguments.refuse_gradient(q, "q")
        if q.dim() not in (2, 3) or q.shape[-2] < 2:
            raise ValueError(f"q: expected {expected}, got shape {tuple(q.shape)}")
        return cls(q if q.dim() == 3 else q[None])

    @property
    def segment_count(self) -> int:
        """S."""
        return (self.control.shape[1] - 1) // self.degree

    def segments(self) -> Tensor:
        """(B, S, degree + 1, J) the control points of each segment."""
        own = self.control[:, :-1].unflatten(1, (self.segment_count, self.degree))
        return torch.cat([own, self.control[:, self.degree :: self.degree, None]], dim=2)

    def turns(self, robot: Robot) -> Tensor:
        """(B, S), on a CPU: the most that a body turns in each segment, all joints added, rounded up."""
        points = self.segments()
        steps = (points[:, :, 1:] - points[:, :, :-1]).abs().amax(dim=2) * self.degree
        return robot._tables.turns(steps.flatten(0, 1)).reshape(steps.shape[:2])

    def require_sound(self, robot: Robot) -> None:
        """Raises ValueError if a configuration has no pose, or a segment is too long."""
        name = "waypoint" if self.degree == 1 else "control point"
        allowed = (robot._magnitudes(self.control) <= LARGEST_VALUE).all(dim=-1)
        self._require(allowed, name, f"joint values of at most {LARGEST_VALUE:g}")
        slides = f"joints that slide by at most {robot._room:g}, added, since the robot has an infinite plane"
        self._require(~robot._may_leave(self.control), name, slides)
        turns = self.turns(robot)
        if not bool((turns <= LONGEST_TURN).all()):
            path, segment = torch.nonzero(~(turns <= LONGEST_TURN))[0].tolist()
            expected = f"turns of at most {LONGEST_TURN:g} rad, all joints added"
            where = f"path {path}, " if len(turns) > 1 else ""
            raise ValueError(f"q: {where}segment {segment}: expected {expected}, got {float(turns[path, segment]):.3g}")

    def _require(self, allowed: Tensor, name: str, expected: str) -> None:
        if bool(allowed.all()):
            return
        path, row = torch.nonzero(~allowed)[0].tolist()
        where = f"path {path}, " if len(allowed) > 1 else ""
        raise ValueError(f"q: {where}{name} {row}: expected {expected}, got {self.control[path, row].tolist()}")
