"""Bodies that rest on, slide over and run into others."""

from __future__ import annotations

from typing import Literal

import numpy as np
import torch
from torch import Tensor

import pgccd

Kind = Literal["rigid", "linear", "deforming"]
KINDS: tuple[Kind, ...] = ("rigid", "linear", "deforming")
UPRIGHT = (1.0, 0.0, 0.0, 0.0)
_CORNERS = torch.tensor([[x, y, z] for x in (-1.0, 1.0) for y in (-1.0, 1.0) for z in (-1.0, 1.0)]).double()
_FACES = torch.tensor(
    [[0, 1, 3], [0, 3, 2], [4, 6, 7], [4, 7, 5], [0, 4, 5], [0, 5, 1]]
    + [[2, 3, 7], [2, 7, 6], [0, 2, 6], [0, 6, 4], [1, 5, 7], [1, 7, 3]]
)


def box(half: tuple[float, float, float], centre: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> pgccd.Mesh:
    """Half edges, and the centre in the coordinates of the mesh; its origin is theirs."""
    return pgccd.Mesh(_CORNERS * _double(half) + _double(centre), _FACES)


def joined(*meshes: pgccd.Mesh) -> pgccd.Mesh:
    """One mesh of several pieces."""
    first = np.cumsum([0, *(len(mesh.vertices) for mesh in meshes)])
    faces = [mesh.faces.long() + int(begin) for mesh, begin in zip(meshes, first[:-1], strict=True)]
    return pgccd.Mesh(torch.cat([mesh.vertices for mesh in meshes]), torch.cat(faces))


def sheet(side: int, half: float, turned_over: bool = False) -> pgccd.Mesh:
    """A flat square of 2 side^2 triangles at z = 0, with diagonals in both directions."""
    line = torch.linspace(-half, half, side + 1, dtype=torch.float64)
    x, y = torch.meshgrid(line, line, indexing="ij")
    corner = torch.arange((side + 1) ** 2).view(side + 1, side + 1)
    faces = []
    for k in range(side):
        for m in range(side):
            a, b, c, d = corner[k, m], corner[k + 1, m], corner[k + 1, m + 1], corner[k, m + 1]
            faces += [[a, b, c], [a, c, d]] if (k + m) % 2 else [[a, b, d], [b, c, d]]
    triangles = torch.tensor([[int(v) for v in face] for face in faces])
    points = torch.stack([x, y, torch.zeros_like(x)], 2).view(-1, 3)
    return pgccd.Mesh(points, triangles.flip(1) if turned_over else triangles)


def sliding(
    kind: Kind,
    meshes: list[pgccd.Mesh],
    start: tuple[float, float, float],
    travel: tuple[float, float, float],
    device: torch.device | str = "cpu",
    orientation: tuple[float, ...] = UPRIGHT,
) -> tuple[pgccd.Scene, pgccd.RigidMotion | pgccd.VertexMotion]:
    """The first mesh moves straight over the others, which rest at the origin; all are turned about it by the
    quaternion.
    """
    turn = _matrix(torch.tensor(orientation, dtype=torch.float64))
    position = torch.zeros(len(meshes), 3, dtype=torch.float64)
    change = torch.zeros_like(position)
    position[0], change[0] = turn @ _double(start), turn @ _double(travel)
    scene = pgccd.Scene(meshes, static=[False] + [True] * (len(meshes) - 1), device=device)
    if kind == "deforming":
        ends = [
            torch.cat([mesh.vertices @ turn.T + place for mesh, place in zip(meshes, places, strict=True)]).to(device)
            for places in (position, position + change)
        ]
        return scene, pgccd.VertexMotion(*ends)
    quaternions = torch.tensor([orientation] * len(meshes), dtype=torch.float64)
    columns = (x.to(device) for x in (position, quaternions, position + change, torch.zeros_like(position)))
    return scene, pgccd.RigidMotion.from_rotation(*columns, path=kind)


def _double(values: tuple[float, ...]) -> Tensor:
    return torch.tensor(values, dtype=torch.float64)


def _matrix(q: Tensor) -> Tensor:
    w, x, y, z = q.tolist()
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return torch.tensor(rows, dtype=torch.float64)


def gap_of_boxes(rotations: Tensor, centres: Tensor, halves: Tensor) -> Tensor:
    """(n,): the largest gap along 15 axes of pairs of boxes, > 0 if they are apart, else minus the least depth.

    Args:
        rotations: (n, 2, 3, 3).
        centres: (n, 2, 3).
        halves: (2, 3).
    """
    one, other = rotations.unbind(1)
    crossed = torch.linalg.cross(one[:, :, :, None].expand(-1, -1, 3, 3), other[:, :, None].expand(-1, -1, 3, 3), dim=1)
    length = crossed.norm(dim=1, keepdim=True)
    crossed = torch.where(length > 1e-9, crossed / length.clamp(min=1e-9), one[:, :, :1, None])
    axes = torch.cat([one, other, crossed.flatten(2)], 2).transpose(1, 2)  # (n, 15, 3)
    reach = sum((axes @ rotations[:, k]).abs() @ halves[k] for k in (0, 1))
    apart = (axes @ (centres[:, 1] - centres[:, 0])[:, :, None])[:, :, 0].abs()
    return (apart - reach).amax(1)
