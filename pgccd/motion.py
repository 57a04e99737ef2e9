"""Motions: where the bodies of a scene are during one step, time normalised to [0, 1]."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

import torch
from torch import Tensor

from pgccd import ops
from pgccd.motion_checks import FINITE, TURN, UNIT, Faults, broadcast_times

PathKind = Literal["rigid", "linear"]


class RigidMotion:
    """Rigid bodies: the origin of the mesh moves on a straight line, the body turns about it at a constant rate.

    A point v of the mesh (in the coordinates given to `Mesh`) is at x(t) = position(t) + R(t) (v - origin), with
    R(t) = exp(t [w]x) R0 and the world-frame rotation vector w = log(R1 R0^T), the shorter way (at exactly half a
    turn, about the vector part of q1 * conj(q0)). With `path="linear"` every vertex moves on the straight line
    between its two end positions instead (the two vertex streams of Du, Liu & Suzumura 2017).

    Args:
        position_t0, position_t1: (N, 3) where the meshes' origins are at the two ends of the step, world frame, scene
            length units.
        orientation_t0, orientation_t1: (N, 4) unit quaternions (w, x, y, z), body to world.
        path: "rigid" or "linear".

    float32 input is widened to float64 exactly. All four on one device.

    Raises:
        TypeError, ValueError: naming the argument, and the first offending body.

    Example:
        >>> motion = pgccd.RigidMotion(position, orientation, position + dt * velocity, orientation)
    """

    def __init__(
        self,
        position_t0: Tensor,
        orientation_t0: Tensor,
        position_t1: Tensor,
        orientation_t1: Tensor,
        path: PathKind = "rigid",
    ) -> None:
        count = _body_count(position_t0, "position_t0")
        device = position_t0.device
        orientation_t1 = _rows(orientation_t1, "orientation_t1", count, 4, device)
        self._set(position_t0, orientation_t0, position_t1, path)
        self._check({"orientation_t1": (orientation_t1, *UNIT)})
        #: (N, 3) rotation vector of the whole step, radians, world frame.
        self.rotation = ops.rotations_between(self.orientation_t0, orientation_t1)

    @classmethod
    def from_velocity(
        cls,
        position: Tensor,
        orientation: Tensor,
        linear_velocity: Tensor,
        angular_velocity: Tensor,
        dt: float,
        path: PathKind = "rigid",
    ) -> RigidMotion:
        """From velocities, so that a body may turn more than half a turn in a step.

        Args:
            position, orientation: (N, 3) and (N, 4), at t0.
            linear_velocity: (N, 3), length units per time unit.
            angular_velocity: (N, 3), world frame, radians per time unit.
            dt: duration of the step, time units.

        Example:
            >>> motion = pgccd.RigidMotion.from_velocity(x, q, v, omega, dt=1e-3)
        """
        count = _body_count(position, "position")
        if not dt >= 0 or dt == float("inf"):
            raise ValueError(f"dt: expected a finite duration >= 0, got {dt}")
        velocity = _rows(linear_velocity, "linear_velocity", count, 3, position.device)
        spin = _rows(angular_velocity, "angular_velocity", count, 3, position.device)
        motion = cls.__new__(cls)
        start = _rows(position, "position", count, 3, position.device)
        travel, turn = (velocity, spin) if dt == 1.0 else (dt * velocity, dt * spin)
        motion._set(start, orientation, start + travel, path)
        motion.rotation = turn.contiguous()
        # Named before the positions that follow from them.
        motion._check({"linear_velocity": (velocity, *FINITE), "angular_velocity": (motion.rotation, *TURN)})
        return motion

    @classmethod
    def from_rotation(
        cls,
        position_t0: Tensor,
        orientation_t0: Tensor,
        position_t1: Tensor,
        rotation: Tensor,
        path: PathKind = "rigid",
    ) -> RigidMotion:
        """From where the origins go and how the bodies turn; made of another motion's rows, it is that one to the bit.

        Args:
            position_t0, position_t1: (N, 3), as for the constructor.
            orientation_t0: (N, 4), at t0.
            rotation: (N, 3) rotation vector of the whole step, radians, world frame.

        Example:
            >>> again = pgccd.RigidMotion.from_rotation(m.position_t0, m.orientation_t0, m.position_t1, m.rotation)
        """
        count = _body_count(position_t0, "position_t0")
        motion = cls.__new__(cls)
        motion._set(position_t0, orientation_t0, position_t1, path)
        motion.rotation = _rows(rotation, "rotation", count, 3, position_t0.device)
        motion._check({"rotation": (motion.rotation, *TURN)})
        return motion

    @classmethod
    def of_checked(
        cls,
        position_t0: Tensor,
        orientation_t0: Tensor,
        position_t1: Tensor,
        rotation: Tensor,
        path: PathKind = "rigid",
    ) -> RigidMotion:
        """As `from_rotation`, of columns that come from a motion already checked: nothing is looked at.

        Example:
            >>> part = pgccd.RigidMotion.of_checked(
            ...     *(c[rows] for c in (m.position_t0, m.orientation_t0, m.position_t1, m.rotation))
            ... )
        """
        motion = cls.__new__(cls)
        motion.path, motion._faults = path, Faults({}, device=position_t0.device)
        motion.position_t0, motion.orientation_t0 = position_t0, orientation_t0
        motion.position_t1, motion.rotation = position_t1, rotation
        return motion

    def _set(self, position_t0: Tensor, orientation_t0: Tensor, position_t1: Tensor, path: PathKind) -> None:
        if path not in ("rigid", "linear"):
            raise ValueError(f'path: expected "rigid" or "linear", got {path!r}')
        self.path: PathKind = path
        count, device = position_t0.shape[0], position_t0.device
        #: (N, 3), (N, 3), (N, 4) float64.
        self.position_t0 = _rows(position_t0, "position_t0", count, 3, device)
        self.position_t1 = _rows(position_t1, "position_t1", count, 3, device)
        self.orientation_t0 = _rows(orientation_t0, "orientation_t0", count, 4, device)

    @property
    def device(self) -> torch.device:
        return self.position_t0.device

    @property
    def body_count(self) -> int:
        return self.position_t0.shape[0]

    def at(self, t: Tensor | float) -> tuple[Tensor, Tensor]:
        """Poses on the path, by the arithmetic that detection uses.

        Args:
            t: times in [0, 1], broadcast against the bodies (N,): a number, one time a body (N,), or several times of
                all bodies, (T, 1), or of each, (T, N).

        Returns:
            Positions (..., N, 3) and orientations (..., N, 4), unit quaternions.

        Raises:
            ValueError: t: its shape, or a time outside of [0, 1]; or path: it is "linear", on which a body is not rigid
                between its end poses.

        Example:
            >>> position, orientation = motion.at(hits.first_toi(by="scene").clamp(max=1.0))
            >>> positions, orientations = motion.at(torch.linspace(0, 1, 30)[:, None])  # (30, N, 3), (30, N, 4)
        """
        if self.path == "linear":
            raise ValueError(
                'path: "linear" moves vertices, not poses: between t0 and t1 a body is not rigid; use `VertexMotion.at`'
            )
        time = broadcast_times(t, self.body_count, self.device)
        columns = (self.position_t0, self.position_t1, self.orientation_t0, self.rotation)
        rows = (column.expand(*time.shape, -1).reshape(-1, column.shape[1]) for column in columns)
        position_t0, position_t1, orientation_t0, rotation = rows
        position, orientation = ops.poses_at(position_t0, position_t1, orientation_t0, rotation, time.reshape(-1))
        return position.view(*time.shape, 3), orientation.view(*time.shape, 4)

    def _check(self, more: dict[str, tuple[Tensor, int, float]]) -> None:
        """Looks for faults in the poses, and in what else was given, which is named first."""
        self._faults = Faults(
            more
            | {
                "position_t0": (self.position_t0, *FINITE),
                "position_t1": (self.position_t1, *FINITE),
                "orientation_t0": (self.orientation_t0, *UNIT),
            }
        )

    def check(self) -> None:
        """Raises ValueError if a pose is not finite or a quaternion not unit, naming the first body."""
        self._faults.check()

    def first_faults(self) -> Tensor:
        """(F + 1,) int64: the first faulty body of each argument, or the number of bodies; and 1 if there is any, else
        0. Where the motion is."""
        return self._faults.first

    def raise_faults(self, first: Sequence[int]) -> None:
        """What `check` raises, given the values of `first_faults`."""
        self._faults.raise_from(first)


class VertexMotion:
    """Bodies given by their vertices at both ends of the step; each vertex moves on the straight line between.

    Args:
        x_t0, x_t1: (X, 3) world positions, scene length units: the vertices of body 0, in the order of its mesh, then
            those of body 1, and so on; X is the sum of the bodies' vertex counts. The mesh's own coordinates do not
            matter.

    Raises:
        TypeError, ValueError: naming the argument, and the first offending vertex.

    Example:
        >>> motion = pgccd.VertexMotion(torch.cat([cloth_t0, ball_t0]), torch.cat([cloth_t1, ball_t1]))
    """

    def __init__(self, x_t0: Tensor, x_t1: Tensor) -> None:
        count = _body_count(x_t0, "x_t0")
        #: (X, 3) float64.
        self.x_t0 = _rows(x_t0, "x_t0", count, 3, x_t0.device)
        self.x_t1 = _rows(x_t1, "x_t1", count, 3, x_t0.device)
        self._faults = Faults({"x_t0": (self.x_t0, *FINITE), "x_t1": (self.x_t1, *FINITE)}, row="vertex")

    @property
    def device(self) -> torch.device:
        return self.x_t0.device

    def at(self, t: Tensor | float) -> Tensor:
        """Vertices on the path: (..., X, 3), for times in [0, 1] that broadcast against the vertices (X,): a number,
        one time a vertex (X,), or (T, 1) or (T, X) for several.

        Raises:
            ValueError: t: its shape, or a time outside of [0, 1].

        Example:
            >>> frames = motion.at(torch.linspace(0, 1, 30)[:, None])  # (30, X, 3)
        """
        time = broadcast_times(t, self.x_t0.shape[0], self.device)[..., None]
        return (1.0 - time) * self.x_t0 + time * self.x_t1

    def check(self) -> None:
        """Raises ValueError if a position is not finite, naming the first vertex."""
        self._faults.check()

    def first_faults(self) -> Tensor:
        """(3,) int64: the first faulty vertex of each argument, or the number of vertices; and 1 if there is any, else
        0. Where the motion is."""
        return self._faults.first

    def raise_faults(self, first: Sequence[int]) -> None:
        """What `check` raises, given the values of `first_faults`."""
        self._faults.raise_from(first)


def _body_count(values: Tensor, name: str) -> int:
    if not isinstance(values, Tensor):
        raise TypeError(f"{name}: expected a tensor, got {type(values).__name__}")
    if values.dim() != 2:
        raise ValueError(f"{name}: expected shape (N, 3), got {tuple(values.shape)}")
    return values.shape[0]


def _rows(values: Tensor, name: str, count: int, width: int, device: torch.device) -> Tensor:
    if not isinstance(values, Tensor):
        raise TypeError(f"{name}: expected a tensor, got {type(values).__name__}")
    if values.dtype not in (torch.float32, torch.float64):
        raise TypeError(f"{name}: expected float32 or float64, got {values.dtype}")
    if values.shape != (count, width):
        raise ValueError(f"{name}: expected shape ({count}, {width}), got {tuple(values.shape)}")
    if values.device != device:
        raise ValueError(f"{name}: expected device {device}, got {values.device}")
    if values.dtype == torch.float64 and not values.requires_grad and values.is_contiguous():
        return values  # as it mostly is: converting it all the same takes a tenth of a call for two bodies
    return values.detach().to(torch.float64).contiguous()
