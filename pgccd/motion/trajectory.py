"""Trajectories: paths through many waypoints."""

from __future__ import annotations

import copy
import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor

from pgccd import arguments
from pgccd.arguments import real_rows
from pgccd.geometry.scene_columns import sum_of_margins
from pgccd.motion.paths import PATHS, PathKind, RigidMotion, VertexMotion
from pgccd.motion.rotation import rotated
from pgccd.motion.splines import Spline
from pgccd.motion.validation import MARGIN, Checked, check_of, columns_checked, first_invalid_rows
from pgccd.motion.vectors import norm

# How far an orientation may be from where the rotation before it leads, in units in the last place of the coarser of
# both, for each radian of the rotation and one more.
_ROUNDING = 64.0
# Units in the last place of what may be given.
_UNITS = (torch.finfo(torch.float64).eps, torch.finfo(torch.float32).eps)
# Of lengths of vectors.
_SUM_ROUNDING = 1.0 + 2.0**-40
_MOST_WAYPOINTS = 1_000_000
_NO_ROTATION = "rotation: expected an orientation beside it; vertices of deforming bodies do not turn"
_COLUMNS = ("position", "orientation", "rotation", "margin")


class Trajectory:
    """Paths through T waypoints: T - 1 segments, each a step like `RigidMotion` or `VertexMotion`.

    A robot's link between two waypoints does not follow the path that its joint makes. Between waypoints the link's
    origin moves on a straight line, but a link whose joint is elsewhere swings on an arc, so contacts of the true path
    may be missed. Give a margin of at least the deviation (`margin`, or the margin of the scene), and enough waypoints
    to keep it small. Or put the mesh's origin at the joint, if the joint itself moves on a straight line.
    `pgccd.robots` does all of this for arms.

    Args:
        position: (T, N, 3) positions of the meshes' origins, world frame, scene length units; or, without
            `orientation`, vertices (T, X, 3) of deforming bodies, in the order of `VertexMotion`.
        orientation: (T, N, 4) unit quaternions (w, x, y, z), body to world. Without `rotation`, bodies rotate the
            shorter way between waypoints. With it, those of the first waypoint (N, 4) suffice: the others follow.
        path: "rigid" or "linear", as for `RigidMotion`.
        rotation: (T - 1, N, 3) rotation vectors of the segments, radians, world frame, as for
            `RigidMotion.from_rotation`; turns may be longer than half a revolution. Orientation k + 1 must be
            exp(rotation k) orientation k, up to the rounding of float64, or of float32 if either is given as float32.
        margin: (T - 1, N) lengths: thickness of each body in each segment, added to the margin in the scene (`Scene`).
            If the true path never strays from the tested one by more than this, no contact of the true path is missed.

    float32 input is widened to float64 exactly. Construction synchronises with a GPU once, and once more with
    `rotation` or `margin`.

    Attributes:
        position: (T, N, 3) float64.
        orientation: (T, N, 4) float64, or None for deforming bodies.
        rotation: (T - 1, N, 3) float64, or None if bodies rotate the shorter way.
        margin: (T - 1, N) float64, or None.
        path: "rigid" or "linear".

    Raises:
        TypeError, ValueError: naming the argument, and the first offending waypoint or segment, and body or vertex.

    Example:
        >>> trajectory = pgccd.Trajectory(torch.stack([x0, x1]), torch.stack([q0, q1]))  # (T, N, 3), (T, N, 4)
        >>> hits = pgccd.detect(scene, trajectory)
        >>> hits.segment, hits.toi, hits.time
    """

    def __init__(
        self,
        position: Tensor,
        orientation: Tensor | None = None,
        path: PathKind = "rigid",
        *,
        rotation: Tensor | None = None,
        margin: Tensor | None = None,
    ) -> None:
        arguments.choice(path, "path", PATHS)
        self.path: PathKind = path
        self.position, self.rotation, self.margin = position, rotation, margin
        self._is_of_float32 = arguments.is_float32(position)
        if rotation is not None and orientation is None:
            raise ValueError(_NO_ROTATION)
        if rotation is not None and isinstance(orientation, Tensor) and orientation.dim() == 2:
            self.position = _waypoints(position, "position", 3, None)
            self._note_rounding(orientation, rotation)
            self.rotation = rotation = _of_segments(rotation, "rotation", (self.position.shape[1], 3), self.position)
            arguments.refuse_gradient(rotation, "rotation")  # nor that of the orientations that follow
            count = self.position.shape[1]
            _raise_invalid(columns_checked({"rotation": rotation.flatten(0, 1)}, "body"), "segment", 0, count)
            orientation = _turned(orientation, rotation)
        self.orientation = orientation
        self._check(slice(0, None))

    # The coarser unit in the last place of orientations and rotations as given.
    _unit = _UNITS[0]
    # Whether positions were given in float32, which may have rounded them.
    _is_of_float32 = False

    @classmethod
    def from_velocity(
        cls,
        position: Tensor,
        orientation: Tensor,
        linear_velocity: Tensor,
        angular_velocity: Tensor,
        dt: Tensor | float,
        path: PathKind = "rigid",
        *,
        margin: Tensor | None = None,
    ) -> Trajectory:
        """From a start and the velocities in each segment; a body may rotate by more than half a turn in one.

        Args:
            position, orientation: (N, 3) and (N, 4), at the first waypoint.
            linear_velocity: (T - 1, N, 3), length units per time unit.
            angular_velocity: (T - 1, N, 3), world frame, radians per time unit.
            dt: durations of the segments, time units: a number, or one per segment (T - 1,).
            path, margin: as for the constructor.

        Raises:
            TypeError, ValueError: naming the argument, and the first offending segment and body.

        Example:
            >>> spin = pgccd.Trajectory.from_velocity(x, q, v.expand(8, 2, 3), omega.expand(8, 2, 3), dt=0.1)
            >>> spin.position.shape, spin.rotation.shape
            (torch.Size([9, 2, 3]), torch.Size([8, 2, 3]))
        """
        start = real_rows(position, "position", None, 3, None)
        turned = real_rows(orientation, "orientation", len(start), 4, start.device)
        rates = (("linear_velocity", linear_velocity), ("angular_velocity", angular_velocity))
        for name, values in rates:
            if isinstance(values, Tensor):
                arguments.refuse_gradient(values, name)
        velocity, spin = (_of_segments(values, name, (len(start), 3), start) for name, values in rates)
        if len(spin) != len(velocity):
            expected = f"shape {tuple(velocity.shape)}, as of linear_velocity"
            raise ValueError(f"angular_velocity: expected {expected}, got {tuple(spin.shape)}")
        for (name, _), values in zip(rates, (velocity, spin), strict=True):
            finite = Checked(name, values.flatten(0, 1), check_of("position"), "body")  # whatever the turns
            _raise_invalid([finite], "segment", 0, len(start))
        duration = arguments.real_numbers(dt, "dt", "finite durations >= 0").to(start.device)
        if duration.shape not in ((), (len(velocity),)):
            raise ValueError(f"dt: expected a number or shape ({len(velocity)},), got {tuple(duration.shape)}")
        if not bool(((duration >= 0.0) & (duration < torch.inf)).all()):
            raise ValueError(f"dt: expected finite durations >= 0, got {duration.tolist()}")
        duration = duration.expand(len(velocity))[:, None, None]
        positions = [start]
        for travel in duration * velocity:
            positions.append(positions[-1] + travel)
        position, rotation = torch.stack(positions), duration * spin
        _raise_invalid(columns_checked({"position": start}, "body"), "waypoint", 0, len(start))
        reached = Checked("linear_velocity", position[1:].flatten(0, 1), check_of("position"), "body")
        _raise_invalid([reached], "position after segment", 0, len(start))
        turn = Checked("angular_velocity", rotation.flatten(0, 1), check_of("rotation"), "body")
        _raise_invalid([turn], "segment", 0, len(start))
        return cls(position, turned, path, rotation=rotation, margin=margin)

    @classmethod
    def from_spline(
        cls,
        position: Spline,
        orientation: Tensor | None = None,
        *,
        stray: float,
        rotation: Tensor | None = None,
        vertex_counts: Sequence[int] | None = None,
    ) -> Trajectory:
        """From splines of positions. There are enough waypoints that straight lines between them are within `stray` of
        the curves. That distance is the margin, so that no contact of the curves is missed.

        Each of the S segments of the spline becomes `segment_count / S` segments of equal duration.

        Args:
            position: of the meshes' origins (N, 3), world frame, length units; or, without `orientation`, of the
                vertices (X, 3) of deforming bodies.
            orientation: (S + 1, N, 4) unit quaternions (w, x, y, z) at the breakpoints, between which bodies rotate at
                constant rates, the shorter way; or (N, 4) at the first one.
            stray: length > 0.
            rotation: (S, N, 3) as for the constructor; without it, an orientation (N, 4) stays constant.
            vertex_counts: (N,) numbers of vertices of deforming bodies. Default: one body.

        Raises:
            TypeError, ValueError: naming the argument; or more than a million waypoints would be needed.

        Example:
            >>> curve = pgccd.Spline(torch.tensor([[[0.0, 0, 0]], [[0.0, 1, 0]], [[1.0, 1, 0]]]), degree=2)
            >>> path = pgccd.Trajectory.from_spline(curve, torch.tensor([[1.0, 0, 0, 0]]), stray=0.01)
            >>> path.segment_count, bool((path.margin < 0.011).all())
            (6, True)
        """
        arguments.instance(position, "position", Spline)
        if position.control.dim() != 3 or position.control.shape[2] != 3:
            raise ValueError(f"position: expected a spline of values (N, 3), got {position}")
        wanted = arguments.length(stray, "stray")
        if not wanted > 0.0:
            raise ValueError(f"stray: expected a length > 0, got {stray}")
        off = norm(position._divided(1)[1])
        parts = max(1, math.ceil(math.sqrt(float(off.max()) / wanted)))
        if parts * position.segment_count > _MOST_WAYPOINTS:
            raise ValueError(f"stray: expected a larger length than {stray}, which needs {parts} parts of each segment")
        values, off = position._divided(parts)
        margin = norm(off) * _SUM_ROUNDING
        if orientation is None:
            if rotation is not None:
                raise ValueError(_NO_ROTATION)
            sizes = [margin.shape[1]] if vertex_counts is None else list(vertex_counts)
            if sum(sizes) != margin.shape[1] or min(sizes) < 1:
                raise ValueError(f"vertex_counts: expected numbers of {margin.shape[1]} vertices, got {sizes}")
            return cls(values, margin=torch.stack([part.amax(dim=1) for part in margin.split(sizes, dim=1)], dim=1))
        if rotation is None and isinstance(orientation, Tensor) and orientation.dim() == 2:
            orientation = orientation.expand(position.segment_count + 1, -1, -1)
        ends = cls(values[::parts], orientation, rotation=rotation)
        ends._refuse_gradient()
        assert ends.orientation is not None
        steps = ends.steps()
        times = torch.tensor([k / parts for k in range(parts)], dtype=torch.float64, device=ends.device)
        assert isinstance(steps, RigidMotion)
        turned = steps.at(times[:, None])[1].view(parts, position.segment_count, -1, 4).transpose(0, 1).flatten(0, 1)
        part = (
            None
            if ends.rotation is None
            else (ends.rotation / torch.full_like(ends.rotation, parts)).repeat_interleave(parts, dim=0)
        )
        return cls(values, torch.cat([turned, ends.orientation[-1:]]), rotation=part, margin=margin)

    def _note_rounding(self, *columns: Tensor | None) -> None:
        given = [column.dtype for column in columns if isinstance(column, Tensor) and column.is_floating_point()]
        self._unit = max(self._unit, *(torch.finfo(dtype).eps for dtype in given), 0.0)

    def _check(self, waypoints: slice) -> None:
        """Raises TypeError or ValueError naming the column, and the first invalid row of these waypoints."""
        self.position = _waypoints(self.position, "position", 3, None)
        columns, row = {"position": self.position[waypoints]}, "vertex"
        if self.orientation is not None:
            self._note_rounding(self.orientation, self.rotation)
            self.orientation, row = _waypoints(self.orientation, "orientation", 4, self.position), "body"
            columns["orientation"] = self.orientation[waypoints]
        count = self.position.shape[1]
        checked = columns_checked({name: column.flatten(0, 1) for name, column in columns.items()}, row)
        _raise_invalid(checked, "waypoint", waypoints.start, count)
        segments = slice(waypoints.start, None if waypoints.stop is None else waypoints.stop - 1)
        if self.rotation is not None:
            self.rotation = _of_segments(self.rotation, "rotation", (count, 3), self.position, self.segment_count)
            rotation = self.rotation[segments].flatten(0, 1)
            _raise_invalid(columns_checked({"rotation": rotation}, row), "segment", segments.start, count)
            self._check_turns(columns["orientation"], self.rotation[segments], segments.start)
        if self.margin is not None:
            # Of deforming bodies the number of bodies is known to the scene alone.
            bodies = count if self.orientation is not None else None
            self.margin = _of_segments(self.margin, "margin", (bodies,), self.position, self.segment_count)
            margin = self.margin[segments]
            _raise_invalid(
                [Checked("margin", margin.reshape(-1), MARGIN, "body")], "segment", segments.start, margin.shape[1]
            )

    def _check_turns(self, orientation: Tensor, rotation: Tensor, first: int) -> None:
        """Raises ValueError unless each rotation leads from one orientation to the next."""
        orientation, rotation = orientation.detach(), rotation.detach()
        turned = rotated(orientation[:-1].reshape(-1, 4), rotation.reshape(-1, 3))
        reached = orientation[1:].reshape(-1, 4)
        reached = reached / norm(reached)[:, None]
        off = torch.minimum(norm(turned - reached), norm(turned + reached))
        allowed = _ROUNDING * self._unit * (1.0 + norm(rotation.reshape(-1, 3)))
        wrong = off > allowed
        if bool(wrong.any()):
            row = int(wrong.long().argmax())
            segment, body = row // orientation.shape[1], row % orientation.shape[1]
            raise ValueError(
                f"rotation: segment {first + segment}, body {body}: expected a rotation vector that leads to the "
                f"orientation of waypoint {first + segment + 1} within {float(allowed[row]):.2g} of a unit quaternion, "
                f"got one that leads {float(off[row]):.3g} away; if only the first waypoint's orientation (N, 4) is "
                "given, the others follow"
            )

    @property
    def device(self) -> torch.device:
        """The device of the waypoints."""
        return self.position.device

    @property
    def segment_count(self) -> int:
        """T - 1."""
        return self.position.shape[0] - 1

    def segment(self, index: int) -> RigidMotion | VertexMotion:
        """The step from waypoint `index` to the next. `detect` returns the same contacts for it as for this segment,
        bit by bit, if `margin[index]` is added to the margin of the scene.

        Raises:
            IndexError: the index is out of range.
            TypeError, ValueError: the index is no integer; or a column has been replaced or written, and is invalid
                there.

        Example:
            >>> trajectory = pgccd.Trajectory(torch.stack([x0, x1]), torch.stack([q0, q1]))
            >>> position, orientation = trajectory.segment(0).at(0.5)
        """
        expected = f"a segment in [0, {self.segment_count})"
        if not isinstance(index, (int, np.integer)) or isinstance(index, bool):
            raise TypeError(f"index: expected {expected}, got {arguments.describe(index)}")
        if not 0 <= index < self.segment_count:
            raise IndexError(f"index: expected {expected}, got {arguments.describe(index)}")
        index = int(index)
        self._check(slice(index, index + 2))
        return self._motion(slice(index, index + 1))

    def steps(self) -> RigidMotion | VertexMotion:
        """All segments as one step: the bodies of segment k follow those of segment k - 1. Without `margin`.

        Raises:
            TypeError, ValueError: a column has been replaced or written, and is invalid.
        """
        self._check(slice(0, None))
        return self._motion(slice(0, self.segment_count))

    def to(self, device: torch.device | str) -> Trajectory:
        """A copy on another device.

        Raises:
            TypeError, ValueError: `device` names no device.

        Example:
            >>> trajectory = pgccd.Trajectory(torch.stack([x0, x1]), torch.stack([q0, q1])).to("cpu")
        """
        device = arguments.device(device)
        moved = copy.copy(self)
        for name in _COLUMNS:
            column = getattr(self, name)
            setattr(moved, name, None if column is None else column.to(device))
        return moved

    def __getitem__(self, rows: Tensor | slice | Sequence[int]) -> Trajectory:
        """The trajectory of some rigid bodies, through all waypoints: a mask (N,), row numbers or a slice; as
        `Scene[rows]`.

        Raises:
            TypeError, ValueError, IndexError: naming the argument; or the bodies deform: index their vertices.

        Example:
            >>> part = pgccd.Trajectory(torch.stack([x0, x1]), torch.stack([q0, q1]))[:1]
        """
        if self.orientation is None:
            raise TypeError("rows: expected a trajectory of rigid bodies; vertices of deforming ones are in `position`")
        picked = arguments.rows(rows, "rows", self.position.shape[1])
        part = copy.copy(self)
        for name in _COLUMNS:
            column = getattr(self, name)
            setattr(part, name, None if column is None else column[:, picked].contiguous())
        return part

    def state_dict(self) -> dict[str, Any]:
        """The trajectory as a dictionary of tensors, names and numbers, without gradients, for `torch.save` and
        `torch.load` with weights_only=True.

        Raises:
            TypeError, ValueError: a column has been replaced or written, and is invalid.

        Example:
            >>> trajectory = pgccd.Trajectory(torch.stack([x0, x1]), torch.stack([q0, q1]))
            >>> torch.save(trajectory.state_dict(), "trajectory.pt")
        """
        self._check(slice(0, None))
        columns = {name: getattr(self, name) for name in _COLUMNS}
        plain = {name: None if column is None else column.detach() for name, column in columns.items()}
        return {**plain, "path": self.path, "rounding": self._unit}

    @classmethod
    def from_state_dict(cls, state: dict[str, Any]) -> Trajectory:
        """The trajectory of a `state_dict`, bit by bit, on the device of its tensors.

        Args:
            state: from `state_dict`.

        Raises:
            TypeError, ValueError: naming the entry that is missing or invalid.

        Example:
            >>> trajectory = pgccd.Trajectory(torch.stack([x0, x1]), torch.stack([q0, q1]))
            >>> again = pgccd.Trajectory.from_state_dict(trajectory.state_dict())
        """
        arguments.entries(state, (*_COLUMNS, "path", "rounding"))
        arguments.choice(state["path"], "path", PATHS)
        unit = arguments.number(state["rounding"], "rounding")
        if unit not in _UNITS:
            raise ValueError(f"rounding: expected one of {_UNITS}, got {unit}")
        if state["rotation"] is not None and state["orientation"] is None:
            raise ValueError("rotation: expected an orientation beside it")
        made = cls.__new__(cls)
        for name in _COLUMNS:
            setattr(made, name, state[name])
        made.path, made._unit = state["path"], unit
        made._check(slice(0, None))
        return made

    def __repr__(self) -> str:
        what = "vertices" if self.orientation is None else "bodies"
        size = f"waypoints={self.position.shape[0]}, {what}={self.position.shape[1]}"
        return f"Trajectory({size}, path={self.path!r}, device={self.device})"

    def _refuse_gradient(self) -> None:
        """Raises ValueError naming the first column that requires grad while gradients are enabled."""
        for name in _COLUMNS:
            column = getattr(self, name)
            if isinstance(column, Tensor):
                arguments.refuse_gradient(column, name)

    def _part(self, first: int, last: int) -> Trajectory:
        """From waypoint `first` to waypoint `last`, sharing memory; nothing is checked."""
        part = copy.copy(self)
        for name, end in (("position", last + 1), ("orientation", last + 1), ("rotation", last), ("margin", last)):
            column = getattr(self, name)
            setattr(part, name, None if column is None else column[first:end])
        return part

    def _margins(self, of_scene: Tensor | None, bodies: int) -> Tensor | None:
        """(S N,) margins of the bodies in all segments: sums of the trajectory's and of the scene's (S N,), if any,
        rounded up.

        Raises:
            ValueError: the margins are of another number of bodies.
        """
        if self.margin is None:
            return of_scene
        if self.margin.shape[1] != bodies:
            expected = f"shape ({self.segment_count}, {bodies}), as the scene has {bodies} bodies"
            raise ValueError(f"margin: expected {expected}, got {tuple(self.margin.shape)}")
        return sum_of_margins(self.margin.reshape(-1), of_scene)

    def _stopped(
        self, position: Tensor, orientation: Tensor | None, rotation: Tensor | None, margin: Tensor | None
    ) -> Trajectory:
        """This trajectory with other columns, as accurate as the given ones."""
        made = copy.copy(self)
        made.position, made.orientation, made.rotation, made.margin = position, orientation, rotation, margin
        made._check(slice(0, None))
        return made

    def _motion(self, segments: slice) -> RigidMotion | VertexMotion:
        ends = slice(segments.start + 1, segments.stop + 1)
        start, end = (self.position[rows].reshape(-1, 3) for rows in (segments, ends))
        if self.orientation is None:
            return VertexMotion(start, end)
        if self.rotation is not None:
            first = self.orientation[segments].reshape(-1, 4)
            return RigidMotion.from_rotation(start, first, end, self.rotation[segments].reshape(-1, 3), self.path)
        turn = (self.orientation[rows].reshape(-1, 4) for rows in (segments, ends))
        return RigidMotion(start, next(turn), end, next(turn), self.path)


def _turned(orientation: Tensor, rotation: Tensor) -> Tensor:
    """(T, N, 4): the orientations to which rotations (T - 1, N, 3) lead from the first ones (N, 4)."""
    turned = [real_rows(orientation, "orientation", rotation.shape[1], 4, rotation.device)]
    for step in rotation:
        turned.append(rotated(turned[-1], step))
    return torch.stack(turned)


def _raise_invalid(columns: list[Checked], what: str, first: int, count: int) -> None:
    """Raises ValueError for the first invalid row of columns, of which `count` rows follow each other in each waypoint
    or segment (`what`), counted from `first`.
    """
    for column, invalid in zip(columns, first_invalid_rows(columns).tolist(), strict=False):
        if invalid < len(column.values):
            column.row = f"{what} {first + invalid // count}, {column.row}"
            raise ValueError(column.problem(invalid, invalid % count))


def _waypoints(values: Tensor, name: str, width: int, like: Tensor | None) -> Tensor:
    values = arguments.real_tensor(values, name)
    if values.dim() != 3 or values.shape[2] != width or values.shape[0] < 2:
        hint = "; bodies of all environments stand in one dimension, see Scene(world=...)" if values.dim() > 3 else ""
        raise ValueError(f"{name}: expected shape (T, N, {width}) with T >= 2, got {tuple(values.shape)}{hint}")
    if like is not None and values.shape[:2] != like.shape[:2]:
        shape = (*like.shape[:2], width)
        raise ValueError(f"{name}: expected shape {shape}, as of position, got {tuple(values.shape)}")
    if like is not None and values.device != like.device:
        raise ValueError(f"{name}: expected device {like.device}, got {values.device}")
    values = values if arguments.is_differentiated(values) else values.detach()
    return values.to(torch.float64).contiguous()


def _of_segments(
    values: Tensor, name: str, row: tuple[int | None, ...], like: Tensor, count: int | None = None
) -> Tensor:
    """The values as float64 (segments, *row), for `count` segments if given; None in a row is any number."""
    values = arguments.real_tensor(values, name)
    of_any = ["N" if size is None else size for size in row]
    shape = ["T - 1" if count is None else count, *of_any]
    fits = values.dim() == len(shape) and values.shape[0] > 0
    if not fits or any(isinstance(n, int) and n != size for n, size in zip(shape, values.shape, strict=True)):
        raise ValueError(f"{name}: expected shape ({', '.join(map(str, shape))}), got {tuple(values.shape)}")
    if values.device != like.device:
        raise ValueError(f"{name}: expected device {like.device}, got {values.device}")
    values = values if arguments.is_differentiated(values) else values.detach()
    return values.to(torch.float64).contiguous()
