"""What robots must not touch: bodies at rest, or that move on the clock of a path."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from pgccd import arguments
from pgccd.geometry.mesh import Mesh
from pgccd.geometry.scene_columns import integer_column, margin_column, require_meshes
from pgccd.motion.paths import RigidMotion
from pgccd.motion.trajectory import Trajectory
from pgccd.motion.validation import LARGEST_COORDINATE, UNIT_TOLERANCE
from pgccd.motion.vectors import norm

# Error of a pose between waypoints, in units of coordinates, and of the reach for each radian and one more.
_POSE_ERROR = 2.0**-46


class Obstacles:
    """M bodies in one or more environments, at rest or moving while the joints do.

    Args:
        meshes: the meshes. The faces of a workspace that robots are inside of must face inwards.
        position: (M, 3) positions of the meshes' origins, world frame; or (B, M, 3), for each of B environments.
            Default: (0, 0, 0).
        orientation: (M, 4) or (B, M, 4) unit quaternions (w, x, y, z), body to world. Default: (1, 0, 0, 0).
        mesh_index: (M,) integers: mesh of each obstacle. Default: one obstacle per mesh.
        margin: thickness, a number or (M,): a sphere is a point with its radius as margin. Default: none.
        motion: a trajectory of the M obstacles, in place of `position` and `orientation`, in all environments. It has
            as many waypoints as the paths of joint values, and each of its segments takes place during the same segment
            of the path. Only rigid bodies on rigid paths, without margins.
        names: (M) different names, for `Robot.allow` and results. Default: "obstacle 0" and so on.

    Attributes:
        meshes: as given, but those that are watertight and face outwards are solids, so that no robot is free inside.
        mesh_index: (M,) int64.
        position, orientation: (M, 3) and (M, 4), or (B, M, 3) and (B, M, 4), float64; with `motion`, at its start.
        motion: as given, or None.
        moves: (M,) bool: whether the obstacle moves.
        margin: (M,) float64.
        names: (M) as given.
        environments: B, or None if the obstacles are the same in all environments.

    Raises:
        TypeError, ValueError: naming the argument. Invalid poses in one of B environments are no error here: `certify`
            gives that environment the verdict `INVALID`.

    Example:
        >>> plate = pgccd.Mesh.box([1.0, 1.0, 0.1])
        >>> table = pgccd.robots.Obstacles([plate], torch.tensor([[0.5, 0.0, -0.1]]), names=["table"])
    """

    def __init__(
        self,
        meshes: Sequence[Mesh],
        position: Tensor | None = None,
        orientation: Tensor | None = None,
        *,
        mesh_index: Tensor | Sequence[int] | None = None,
        margin: Tensor | Sequence[float] | float | None = None,
        motion: Trajectory | None = None,
        names: Sequence[str] | None = None,
    ) -> None:
        if isinstance(meshes, (Mesh, str)) or not isinstance(meshes, Sequence):
            raise TypeError(f"meshes: expected a list of meshes, got {arguments.describe(meshes)}")
        if not meshes:
            raise ValueError("meshes: expected one mesh or more, got none: leave out the obstacles if there are none")
        for index, mesh in enumerate(meshes):
            arguments.instance(mesh, f"meshes[{index}]", Mesh)
        self.meshes = [mesh if mesh.solid else mesh.as_solid("auto") for mesh in meshes]
        cpu = torch.device("cpu")
        given = list(range(len(meshes))) if mesh_index is None else mesh_index
        self.mesh_index = integer_column(given, "mesh_index", None, cpu)
        require_meshes(self.mesh_index, len(meshes))
        count = len(self.mesh_index)
        self.margin = margin_column(0.0 if margin is None else margin, count, cpu)
        self.names = [f"obstacle {k}" for k in range(count)] if names is None else _names(names, count)
        self.motion, self.moves = motion, torch.zeros(count, dtype=torch.bool)
        # (M,): how far points are at most from their exact places, by rounding.
        self._error = torch.zeros(count, dtype=torch.float64)
        if motion is not None:
            if position is not None or orientation is not None:
                raise ValueError("motion: expected it without position and orientation, which it has")
            self._prepare(motion, count)
            position, orientation = self._segments[0][0], self._segments[2][0]
        upright = torch.tensor([1.0, 0.0, 0.0, 0.0], dtype=torch.float64)
        self.position = _poses(torch.zeros(count, 3) if position is None else position, "position", count, 3)
        self.orientation = _poses(
            upright.expand(count, 4) if orientation is None else orientation, "orientation", count, 4
        )
        batches = {len(column) for column in (self.position, self.orientation) if column.dim() == 3}
        if len(batches) > 1:
            raise ValueError(f"orientation: expected as many environments as position, got {sorted(batches)}")
        self.environments = batches.pop() if batches else None
        if self.environments is None and not bool(self._is_sound(1)[0]):
            raise ValueError("position, orientation: expected finite numbers and unit quaternions (w, x, y, z)")

    def _prepare(self, motion: Trajectory, count: int) -> None:
        """The columns of moving obstacles, by segment."""
        arguments.instance(motion, "motion", Trajectory)
        if motion.orientation is None or motion.path != "rigid" or motion.margin is not None:
            raise ValueError("motion: expected rigid bodies on rigid paths, without margins")
        if motion.position.shape[1] != count:
            raise ValueError(f"motion: expected {count} bodies, one of each obstacle, got {motion.position.shape[1]}")
        motion._refuse_gradient()
        steps = motion.to("cpu").steps()
        assert isinstance(steps, RigidMotion)
        columns = (steps.position_t0, steps.position_t1, steps.orientation_t0, steps.rotation)
        # By segment both positions, the orientation at the first one, and the rotation: (T - 1, M, ...).
        self._segments = [column.clone().view(motion.segment_count, count, -1) for column in columns]
        begin, end, turned, rotation = self._segments
        still = (begin == end).all(dim=-1) & (begin == begin[0]).all(dim=-1)
        still &= (rotation == 0.0).all(dim=-1) & (turned == turned[0]).all(dim=-1)
        self.moves = ~still.all(dim=0)
        reach = torch.tensor([mesh.reach for mesh in self.meshes], dtype=torch.float64)[self.mesh_index]
        size = torch.maximum(begin.abs(), end.abs()).sum(dim=-1).amax(dim=0)
        self._error = _POSE_ERROR * (size + (1.0 + norm(rotation).amax(dim=0)) * reach)

    @property
    def count(self) -> int:
        """M, the number of obstacles."""
        return len(self.mesh_index)

    def _is_sound(self, environments: int) -> Tensor:
        """(B,) bool: the environments whose poses are valid."""
        at = (self.position.abs() <= LARGEST_COORDINATE).all(dim=-1).all(dim=-1)
        w, x, y, z = self.orientation.unbind(-1)
        length = (w * w + x * x + y * y + z * z).sqrt()
        turn = ((length - 1.0).abs() <= UNIT_TOLERANCE).all(dim=-1)
        return (at & turn).expand(environments)

    def columns(self) -> list[Tensor]:
        """The operators' argument `obstacles`: of each environment, or of each segment of `motion`."""
        if self.motion is not None:
            return [*self._segments, self._error]
        rows = 1 if self.environments is None else self.environments
        position, orientation = (
            column.expand(rows, *column.shape[-2:]).contiguous() for column in (self.position, self.orientation)
        )
        return [position, position, orientation, torch.zeros_like(position), self._error]

    def _arcs(self, paths: Tensor, segments: Tensor, begin: Tensor, end: Tensor) -> tuple[Tensor, ...]:
        """Arcs over parts of segments, from times `begin` to `end` (K,) of segments (K,) of paths (K,): position_t0,
        position_t1 (K, M, 3), orientation (K, M, 4), rotation (K, M, 3), and by how much points are beside them (K, M).
        """
        device = begin.device
        x0, x1, r, rotation, error = (column.to(device) for column in self.columns())
        error = error.expand(len(begin), -1)
        if self.motion is None:
            rows = paths if self.environments is not None else torch.zeros_like(paths)
            return x0[rows], x1[rows], r[rows], rotation[rows], error
        start, turned, goal, turn = (column[segments].flatten(0, 1) for column in (x0, r, x1, rotation))
        steps = RigidMotion.from_rotation(start, turned, goal, turn)
        times = (time.repeat_interleave(self.count) for time in (begin, end))
        (x0, r), (x1, _) = (steps.at(time) for time in times)
        part = (end - begin)[:, None, None] * rotation[segments]
        shape = (len(begin), self.count, -1)
        return x0.reshape(shape), x1.reshape(shape), r.reshape(shape), part, error

    def __repr__(self) -> str:
        moving = "" if self.motion is None else f", moving={int(self.moves.sum())}"
        return f"Obstacles(count={self.count}, environments={self.environments}{moving})"


def _names(names: Sequence[str], count: int) -> list[str]:
    if isinstance(names, str) or not isinstance(names, Sequence):
        raise TypeError(f"names: expected a list of names, got {arguments.describe(names)}")
    for index, name in enumerate(names):
        arguments.instance(name, f"names[{index}]", str)
        if not name or name in names[:index]:
            raise ValueError(f"names[{index}]: expected a name that no obstacle before it has, got {name!r}")
    if len(names) != count:
        raise ValueError(f"names: expected {count}, one of each obstacle, got {len(names)}")
    return list(names)


def _poses(values: Tensor, name: str, count: int, width: int) -> Tensor:
    values = arguments.real_tensor(values, name)
    arguments.refuse_gradient(values, name)
    if values.dim() not in (2, 3) or values.shape[-2:] != (count, width):
        expected = f"({count}, {width}) or (B, {count}, {width}), a row for each entry of mesh_index or else each mesh"
        raise ValueError(f"{name}: expected shape {expected}; got {tuple(values.shape)}")
    return values.detach().to(torch.float64).cpu().contiguous()
