"""What robots must not touch: bodies at rest."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from pgccd import arguments
from pgccd.geometry.mesh import Mesh
from pgccd.geometry.scene_columns import integer_column, margin_column, require_meshes
from pgccd.motion.validation import LARGEST_COORDINATE, UNIT_TOLERANCE


class Obstacles:
    """M bodies at rest, in one or more environments.

    Args:
        meshes: the meshes. Draw a workspace that robots are inside of with faces that face inwards.
        position: (M, 3) positions of the meshes' origins, world frame; or (B, M, 3), of each of B environments apart.
            Default: (0, 0, 0).
        orientation: (M, 4) or (B, M, 4) unit quaternions (w, x, y, z), body to world. Default: (1, 0, 0, 0).
        mesh_index: (M,) integers: mesh of each obstacle. Default: one obstacle a mesh.
        margin: thickness, a number or (M,): a sphere is a point with its radius as margin. Default: none.
        names: (M) different names, for `Robot.allow` and results. Default: "obstacle 0" and so on.

    Attributes:
        meshes: as given; those that are watertight and face outwards as solids, so that no robot is free inside.
        mesh_index: (M,) int64.
        position, orientation: (M, 3) and (M, 4), or (B, M, 3) and (B, M, 4), float64.
        margin: (M,) float64.
        names: (M) as given.
        environments: B, or None if the obstacles are the same in all environments.

    Raises:
        TypeError, ValueError: naming the argument. Poses of environments of their own that are invalid are found by
            `certify`: they say nothing about others.

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

    def _added_to(self, position: Tensor, orientation: Tensor, environment: Tensor) -> tuple[Tensor, Tensor]:
        """Poses (K, N, 3) and (K, N, 4) of a robot's bodies in K environments (K,), followed by those of the
        obstacles.
        """
        both = []
        for of_robot, own in ((position, self.position), (orientation, self.orientation)):
            own = own.to(of_robot.device)
            rows = own[environment] if own.dim() == 3 else own.expand(len(of_robot), *own.shape)
            both.append(torch.cat([of_robot, rows], dim=1))
        return both[0], both[1]

    def __repr__(self) -> str:
        return f"Obstacles(count={self.count}, environments={self.environments})"


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
