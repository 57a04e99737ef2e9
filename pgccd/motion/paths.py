"""Motions: the paths of the bodies of a scene during one step, with time normalised to [0, 1]."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import Any, Literal, get_args

import torch
from torch import Tensor

from pgccd import arguments, ops
from pgccd.motion.differentiable import any_differentiated, pose_at, rotation_between, with_gradient_of
from pgccd.motion.moving_columns import MovingColumns
from pgccd.motion.times import broadcast_times, fractions_of
from pgccd.motion.validation import checks_of

# Columns of a motion may require grad, for `pgccd.detect`.
_rows = partial(arguments.real_rows, with_gradient=True)

PathKind = Literal["rigid", "linear"]
PATHS = get_args(PathKind)


class RigidMotion(MovingColumns):
    """Rigid bodies: the mesh's origin moves on a straight line, and the body rotates about it at a constant rate.

    A point v of the mesh (in the coordinates given to `Mesh`) is at x(t) = position(t) + R(t) (v - origin), with R(t) =
    exp(t [w]x) R0. The world-frame rotation vector w = log(R1 R0^T) turns the shorter way; at exactly half a turn,
    about the vector part of q1 * conj(q0). Within some 1e-15 rad of half a turn rounding decides the direction: use
    `from_rotation` there. With `path="linear"` every vertex moves on the straight line between its two end positions
    instead (the two vertex streams of Du, Liu & Suzumura 2017).

    Args:
        position_t0, position_t1: (N, 3) positions of the meshes' origins at the two ends of the step, world frame,
            scene length units.
        orientation_t0, orientation_t1: (N, 4) unit quaternions (w, x, y, z), body to world.
        path: "rigid" or "linear".

    float32 input is widened to float64 exactly. All tensors are on one device. float64 input is shared, not copied, so
    later writes to it change the motion. Columns may be replaced by others of the same shape and device. Values are
    checked at construction on a CPU, and at each use. Inputs may require grad: see docs/how-to/gradients.md.

    Attributes:
        position_t0, position_t1: (N, 3) float64.
        orientation_t0: (N, 4) float64, at t0.
        rotation: (N, 3) float64 rotation vector of the whole step, radians, world frame.
        path: "rigid" or "linear".

    Raises:
        TypeError, ValueError: naming the argument, and the first offending body.

    Example:
        >>> motion = pgccd.RigidMotion(position, orientation, position + dt * velocity, orientation)
    """

    _names = ("position_t0", "position_t1", "orientation_t0", "rotation")
    _checks = checks_of(_names)
    _options = ("path",)
    position_t0: Tensor
    position_t1: Tensor
    orientation_t0: Tensor
    rotation: Tensor
    path: PathKind

    def __setattr__(self, name: str, value: Any) -> None:
        if name == "path":
            arguments.choice(value, "path", PATHS)
        super().__setattr__(name, value)

    def __init__(
        self,
        position_t0: Tensor,
        orientation_t0: Tensor,
        position_t1: Tensor,
        orientation_t1: Tensor,
        path: PathKind = "rigid",
    ) -> None:
        start = _start(position_t0, orientation_t0, position_t1, path)
        orientation_t0 = start["orientation_t0"]
        orientation_t1 = _rows(orientation_t1, "orientation_t1", len(orientation_t0), 4, orientation_t0.device)
        if any_differentiated(orientation_t0, orientation_t1):
            expression = rotation_between(orientation_t0, orientation_t1)
            orientation_t1 = orientation_t1.detach()
            value = ops.rotations_between(orientation_t0.detach(), orientation_t1)
            rotation = with_gradient_of(value, expression, "rotation")
        else:
            rotation = ops.rotations_between(orientation_t0, orientation_t1)
        # An invalid orientation makes the rotation NaN.
        given = {"orientation_t1": orientation_t1}
        start |= {"rotation": rotation, "_sources": {"rotation": "orientation_t1"}}
        if orientation_t1.device.type != "cpu":
            start["_given"] = given
        for name, value in start.items():
            object.__setattr__(self, name, value)
        self._check_early(given)

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
        """From velocities; a body may rotate by more than half a turn in a step.

        Args:
            position, orientation: (N, 3) and (N, 4), at t0.
            linear_velocity: (N, 3), length units per time unit.
            angular_velocity: (N, 3), world frame, radians per time unit.
            dt: duration of the step, time units.
            path: "rigid", certified arcs, or "linear": as for the constructor.

        Raises:
            TypeError, ValueError: naming the argument, and the body with an invalid value.

        Example:
            >>> motion = pgccd.RigidMotion.from_velocity(x, q, v, omega, dt=1e-3)
        """
        start = _rows(position, "position", None, 3, None)
        count, device = start.shape[0], start.device
        orientation = _rows(orientation, "orientation", count, 4, device)
        velocity = _rows(linear_velocity, "linear_velocity", count, 3, device)
        spin = _rows(angular_velocity, "angular_velocity", count, 3, device)
        dt = arguments.number(dt, "dt", "a finite duration >= 0")
        if not 0 <= dt < float("inf"):
            raise ValueError(f"dt: expected a finite duration >= 0, got {dt}")
        travel, turn = (velocity, spin) if dt == 1.0 else (dt * velocity, dt * spin)
        sources = {
            "position_t0": "position",
            "orientation_t0": "orientation",
            "position_t1": "linear_velocity",
            "rotation": "angular_velocity",
        }
        made = _start(start, orientation, start + travel, path)
        made["_is_of_float32"] = arguments.is_float32(position)
        motion = cls._made_of(**made, rotation=turn.contiguous(), _sources=sources)
        origins = {"position": start, "orientation": motion.orientation_t0}
        return motion._check_early(origins | {"linear_velocity": velocity, "angular_velocity": motion.rotation})

    @classmethod
    def at_rest(cls, position: Tensor, orientation: Tensor) -> RigidMotion:
        """Bodies that do not move. Contacts of such a step are those at its start, with toi 0.

        Args:
            position, orientation: (N, 3) and (N, 4), as for the constructor.

        Raises:
            TypeError, ValueError: naming the argument, and the body with an invalid value.

        Example:
            >>> touching = pgccd.collide(scene, pgccd.RigidMotion.at_rest(x, q)).pairs
        """
        start = _rows(position, "position", None, 3, None)
        orientation = _rows(orientation, "orientation", start.shape[0], 4, start.device)
        made = _start(start, orientation, start, "rigid")
        made["_is_of_float32"] = arguments.is_float32(position)
        sources = {"position_t0": "position", "position_t1": "position", "orientation_t0": "orientation"}
        # Zero by definition, not by cancellation.
        motion = cls._made_of(**made, rotation=torch.zeros_like(start), _sources=sources)
        return motion._check_early({"position": start, "orientation": motion.orientation_t0})

    @classmethod
    def from_rotation(
        cls,
        position_t0: Tensor,
        orientation_t0: Tensor,
        position_t1: Tensor,
        rotation: Tensor,
        path: PathKind = "rigid",
    ) -> RigidMotion:
        """From positions and rotation vectors. Rows of another motion give the same paths, bit by bit.

        Args:
            position_t0, position_t1: (N, 3), as for the constructor.
            orientation_t0: (N, 4), at t0.
            rotation: (N, 3) rotation vector of the whole step, radians, world frame.
            path: "rigid" or "linear": as for the constructor.

        Raises:
            TypeError, ValueError: naming the argument, and the body with an invalid value.

        Example:
            >>> again = pgccd.RigidMotion.from_rotation(m.position_t0, m.orientation_t0, m.position_t1, m.rotation)
        """
        start = _start(position_t0, orientation_t0, position_t1, path)
        position_t0 = start["position_t0"]
        rotation = _rows(rotation, "rotation", position_t0.shape[0], 3, position_t0.device)
        return cls._made_of(**start, rotation=rotation)._check_early()

    @classmethod
    def _of_checked(
        cls,
        position_t0: Tensor,
        orientation_t0: Tensor,
        position_t1: Tensor,
        rotation: Tensor,
        path: PathKind = "rigid",
    ) -> RigidMotion:
        """As `from_rotation`, from columns of a validated motion. They are checked only where they are read.

        Example:
            >>> part = pgccd.RigidMotion._of_checked(
            ...     *(c[rows] for c in (m.position_t0, m.orientation_t0, m.position_t1, m.rotation))
            ... )
        """
        ends = {"position_t0": position_t0, "position_t1": position_t1}
        return cls._made_of(**ends, orientation_t0=orientation_t0, rotation=rotation, path=path)

    @classmethod
    def _of_state(cls, **columns: Any) -> RigidMotion:
        return cls.from_rotation(**columns)

    @property
    def body_count(self) -> int:
        """Number of bodies N."""
        return self.position_t0.shape[0]

    def at(self, t: Tensor | float) -> tuple[Tensor, Tensor]:
        """Poses on the path, by the same arithmetic as detection.

        Args:
            t: times in [0, 1], broadcast against the bodies (N,): a number, one time per body (N,), T times for all
                bodies (T, 1), or T times per body (T, N).

        Returns:
            Positions (..., N, 3) and orientations (..., N, 4), unit quaternions.

        Raises:
            ValueError: `t` has the wrong shape or is outside of [0, 1]; or the path is "linear", on which a body is not
                rigid between its end poses.

        Example:
            >>> position, orientation = motion.at(hits.first_toi(by="scene").clamp(max=1.0))
            >>> positions, orientations = motion.at(torch.linspace(0, 1, 30)[:, None])  # (30, N, 3), (30, N, 4)
        """
        if self.path == "linear":
            raise ValueError(
                'path: "linear" moves vertices, not poses: between t0 and t1 a body is not rigid; use `VertexMotion.at`'
            )
        time = broadcast_times(t, self.body_count, self.device, with_gradient=True)
        columns = (self.position_t0, self.position_t1, self.orientation_t0, self.rotation)
        rows = (column.detach().expand(*time.shape, -1).reshape(-1, column.shape[1]).contiguous() for column in columns)
        position_t0, position_t1, orientation_t0, rotation = rows
        position, orientation = ops.poses_at(
            position_t0, position_t1, orientation_t0, rotation, time.detach().reshape(-1).contiguous()
        )
        position, orientation = position.view(*time.shape, 3), orientation.view(*time.shape, 4)
        if not any_differentiated(time, *columns):
            return position, orientation
        expressions = pose_at(*columns, time)
        return tuple(  # type: ignore[return-value]
            with_gradient_of(value, expression, f"RigidMotion.at: {name}")
            for name, value, expression in zip(
                ("position", "orientation"), (position, orientation), expressions, strict=True
            )
        )

    def shortened(self, fraction: Tensor | float) -> RigidMotion:
        """The motion along the first part of each path, x(fraction t), over the same step. position_t1 is rounded to
        float64, and the rotation vector is multiplied by the fraction. With fraction 1 a path keeps its bits. With
        fraction 0 the body is at rest, even if the end of its path is invalid. With path="linear" vertices move
        straight to the pose at that fraction of the arc.

        Args:
            fraction: in [0, 1], a number or one per body (N,).

        Raises:
            ValueError: `fraction` has the wrong shape or is outside of [0, 1].

        Example:
            >>> half = motion.shortened(0.5)
        """
        part = fractions_of(fraction, self.body_count, self.device)
        columns = self.position_t0, self.position_t1, self.rotation
        if any_differentiated(*columns):
            end = _point_at(part[:, None], self.position_t0, self.position_t1)
            turn = _point_at(part[:, None], torch.zeros_like(self.rotation), self.rotation)
        else:
            end, turn = ops.shorten_arcs(*columns, part)
        return self._with(position_t1=end, rotation=turn)

    def __getitem__(self, rows: Tensor | slice | Sequence[int]) -> RigidMotion:
        """The motion of some bodies: a mask (N,), row numbers or a slice.

        Example:
            >>> part = motion[:10]
        """
        return self._rows(rows, self.body_count)

    def __repr__(self) -> str:
        return f"RigidMotion(bodies={self.body_count}, path={self.path!r}, device={self.device})"


class VertexMotion(MovingColumns):
    """Bodies given by their vertices at both ends of the step; each vertex moves on a straight line.

    Args:
        x_t0, x_t1: (X, 3) world positions, scene length units: the vertices of body 0, in the order of its mesh, then
            those of body 1, and so on; X is the sum of the bodies' vertex counts. The coordinates of the mesh are not
            used. float64 input is shared, not copied. Values are checked at construction on a CPU, and at each use.

    Attributes:
        x_t0, x_t1: (X, 3) float64.

    Raises:
        TypeError, ValueError: naming the argument, and the first offending vertex.

    Example:
        >>> motion = pgccd.VertexMotion(torch.cat([cloth_t0, ball_t0]), torch.cat([cloth_t1, ball_t1]))
    """

    _names, _row = ("x_t0", "x_t1"), "vertex"
    _checks = checks_of(_names)

    x_t0: Tensor
    x_t1: Tensor

    def __init__(self, x_t0: Tensor, x_t1: Tensor) -> None:
        x_t0 = _rows(x_t0, "x_t0", None, 3, None)
        object.__setattr__(self, "x_t0", x_t0)
        object.__setattr__(self, "x_t1", _rows(x_t1, "x_t1", x_t0.shape[0], 3, x_t0.device))
        self._check_early()

    @classmethod
    def _of_checked(cls, x_t0: Tensor, x_t1: Tensor) -> VertexMotion:
        """From columns of a validated motion. They are checked only where they are read.

        Example:
            >>> part = pgccd.VertexMotion._of_checked(cloth_t0[:8], cloth_t1[:8])
        """
        return cls._made_of(x_t0=x_t0, x_t1=x_t1)

    def at(self, t: Tensor | float) -> Tensor:
        """Vertices on the path: (..., X, 3), for times in [0, 1] that broadcast against the vertices (X,): a number,
        one time per vertex (X,), or T times (T, 1) or (T, X).

        Raises:
            ValueError: `t` has the wrong shape or is outside of [0, 1].

        Example:
            >>> frames = motion.at(torch.linspace(0, 1, 30)[:, None])  # (30, X, 3)
        """
        time = broadcast_times(t, self.x_t0.shape[0], self.device, with_gradient=True)[..., None]
        return (1.0 - time) * self.x_t0 + time * self.x_t1

    def shortened(self, fraction: Tensor | float) -> VertexMotion:
        """The motion along the first part of each path, x(fraction t), over the same step. x_t1 is rounded to float64.
        With fraction 1 a path keeps its bits. With fraction 0 the vertex is at rest, even if x_t1 is invalid.

        Args:
            fraction: in [0, 1], a number or one per vertex (X,). With equal fractions for all its vertices, a body
                takes the shapes that it has on its path.

        Raises:
            ValueError: `fraction` has the wrong shape or is outside of [0, 1].

        Example:
            >>> half = pgccd.VertexMotion(cloth_t0, cloth_t1).shortened(0.5)
        """
        part = fractions_of(fraction, len(self.x_t0), self.device)[:, None]
        return self._with(x_t1=_point_at(part, self.x_t0, self.x_t1))

    def __repr__(self) -> str:
        return f"VertexMotion(vertices={self.x_t0.shape[0]}, device={self.device})"


def _start(position_t0: Tensor, orientation_t0: Tensor, position_t1: Tensor, path: PathKind) -> dict[str, Any]:
    """The attributes of a rigid motion except its rotation, checked."""
    is_of_float32 = arguments.is_float32(position_t0) or arguments.is_float32(position_t1)
    position_t0 = _rows(position_t0, "position_t0", None, 3, None)
    count, device = position_t0.shape[0], position_t0.device
    arguments.choice(path, "path", PATHS)
    return {
        "position_t0": position_t0,
        "orientation_t0": _rows(orientation_t0, "orientation_t0", count, 4, device),
        "position_t1": _rows(position_t1, "position_t1", count, 3, device),
        "path": path,
        "_is_of_float32": is_of_float32,
    }


def _point_at(fraction: Tensor, start: Tensor, end: Tensor) -> Tensor:
    """Points on straight paths: `start` at fraction 0, whatever `end` is, and `end` at fraction 1, bit by bit."""
    between = torch.where(fraction == 1.0, end, start + fraction * (end - start))
    return torch.where(fraction == 0.0, start, between)
