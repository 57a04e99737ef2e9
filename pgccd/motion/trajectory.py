"""Trajectories: paths through many waypoints."""

import torch
from torch import Tensor

from pgccd import arguments
from pgccd.motion.paths import PATHS, PathKind, RigidMotion, VertexMotion
from pgccd.motion.validation import columns_checked, first_invalid_rows


class Trajectory:
    """Paths through T waypoints: T - 1 segments, each a step like `RigidMotion` or `VertexMotion`.

    Two waypoints of a robot's link do not follow the path of its joint. Between them the link's origin moves on a
    straight line, while a link whose joint is elsewhere swings on an arc, so contacts of the true path may be missed.
    Give so many waypoints that the deviation is small, and bodies a margin (see `Scene`) of at least the deviation; or
    put the mesh's origin at the joint, if the joint itself moves on a straight line.

    Args:
        position: (T, N, 3) positions of the meshes' origins, world frame, scene length units; or, without
            `orientation`, vertices (T, X, 3) of deforming bodies, in the order of `VertexMotion`.
        orientation: (T, N, 4) unit quaternions (w, x, y, z), body to world. Between waypoints bodies rotate the shorter
            way.
        path: "rigid" or "linear", as for `RigidMotion`.

    float32 input is widened to float64 exactly. Construction synchronises with a GPU once.

    Attributes:
        position: (T, N, 3) float64.
        orientation: (T, N, 4) float64, or None for deforming bodies.
        path: "rigid" or "linear".

    Raises:
        TypeError, ValueError: naming the argument, and the first offending waypoint and body or vertex.

    Example:
        >>> trajectory = pgccd.Trajectory(torch.stack([x0, x1]), torch.stack([q0, q1]))  # (T, N, 3), (T, N, 4)
        >>> hits = pgccd.detect(scene, trajectory)
        >>> hits.segment, hits.toi, hits.time
    """

    def __init__(self, position: Tensor, orientation: Tensor | None = None, path: PathKind = "rigid") -> None:
        arguments.choice(path, "path", PATHS)
        self.path: PathKind = path
        self.position = position
        self.orientation = orientation
        self._check(slice(0, None))

    def _check(self, waypoints: slice) -> None:
        """Raises TypeError or ValueError naming the column, and the first invalid row of these waypoints."""
        self.position = _waypoints(self.position, "position", 3, None)
        columns, row = {"position": self.position[waypoints]}, "vertex"
        if self.orientation is not None:
            self.orientation, row = _waypoints(self.orientation, "orientation", 4, self.position), "body"
            columns["orientation"] = self.orientation[waypoints]
        count = self.position.shape[1]
        checked = columns_checked({name: column.flatten(0, 1) for name, column in columns.items()}, row)
        for column, invalid in zip(checked, first_invalid_rows(checked).tolist(), strict=False):
            if invalid < len(column.values):
                column.row = f"waypoint {waypoints.start + invalid // count}, {row}"
                raise ValueError(column.problem(invalid, invalid % count))

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
        bitwise.

        Raises:
            IndexError: the index is out of range.
            TypeError, ValueError: a column has been replaced or written, and is invalid there.

        Example:
            >>> trajectory = pgccd.Trajectory(torch.stack([x0, x1]), torch.stack([q0, q1]))
            >>> position, orientation = trajectory.segment(0).at(0.5)
        """
        if not 0 <= index < self.segment_count:
            raise IndexError(f"index: expected a segment in [0, {self.segment_count}), got {index}")
        self._check(slice(index, index + 2))
        return self._motion(slice(index, index + 1))

    def steps(self) -> RigidMotion | VertexMotion:
        """All segments as one step: the bodies of segment k follow those of segment k - 1.

        Raises:
            TypeError, ValueError: a column has been replaced or written, and is invalid.
        """
        self._check(slice(0, None))
        return self._motion(slice(0, self.segment_count))

    def _motion(self, segments: slice) -> RigidMotion | VertexMotion:
        ends = slice(segments.start + 1, segments.stop + 1)
        start, end = (self.position[rows].reshape(-1, 3) for rows in (segments, ends))
        if self.orientation is None:
            return VertexMotion(start, end)
        turn = (self.orientation[rows].reshape(-1, 4) for rows in (segments, ends))
        return RigidMotion(start, next(turn), end, next(turn), self.path)


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
