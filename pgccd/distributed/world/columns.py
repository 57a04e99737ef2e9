"""Checks of user input to a `World`."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor

from pgccd import arguments
from pgccd.detection.bodies import MovingBodies
from pgccd.distributed.comm.exchange import Columns, make_route
from pgccd.distributed.comm.interface import Comm
from pgccd.distributed.halo.vertices import vertex_counts
from pgccd.distributed.launch.agreement import together
from pgccd.geometry.mesh import MeshSet
from pgccd.geometry.scene import OPTIONAL_COLUMNS, Scene
from pgccd.motion.paths import RigidMotion, VertexMotion
from pgccd.motion.trajectory import Trajectory
from pgccd.motion.validation import LARGEST_COORDINATE

# Optional columns of scenes.
_OPTIONAL = (*OPTIONAL_COLUMNS, "self_collision")
#: All columns that detection reads.
_OF_SCENES = ("id", "mesh_index", *_OPTIONAL)


def scene_of(meshes: MeshSet, columns: Columns) -> Scene:
    """The scene of bodies with these columns."""
    optional: dict[str, Any] = {name: columns[name] for name in _OPTIONAL if name in columns}
    return Scene._of_checked(meshes, columns["mesh_index"], **optional)


def scene_columns(columns: Columns) -> Columns:
    """The columns that detection reads."""
    return {name: columns[name] for name in _OF_SCENES if name in columns}


def columns_to_send(id: Tensor, bodies: MovingBodies) -> Columns:
    """The columns of bodies in motion that other ranks need; those of vertices are sent apart.

    Args:
        id: (N,) int64.
        bodies: of these ids.
    """
    columns = {"id": id, **bodies.columns}
    columns.pop("radius", None)  # follows from the mesh
    return columns


def require_rows(motion: RigidMotion | VertexMotion | Trajectory, meshes: MeshSet, mesh_index: Tensor) -> None:
    """Raises ValueError unless the motion has as many rows as there are bodies of these meshes (N,), or vertices of
    these.
    """
    deforms = isinstance(motion, VertexMotion) or (isinstance(motion, Trajectory) and motion.orientation is None)
    what, expected = "bodies", len(mesh_index)
    if deforms:
        what, expected = "vertices", int(vertex_counts(meshes, mesh_index).sum())
    if isinstance(motion, Trajectory):
        given = motion.position.shape[1]
    else:
        given = motion.body_count if isinstance(motion, RigidMotion) else len(motion.x_t0)
    if given != expected:
        raise ValueError(f"motion: has {given} {what}, this rank owns {expected}")


def ids_given(id: Tensor | None, count: int, device: torch.device) -> Tensor:
    """(count,) int64: the given ids, or 0 to count - 1."""
    if id is None:
        return torch.arange(count, device=device)
    if not isinstance(id, Tensor) or id.dtype != torch.int64 or id.shape != (count,):
        raise ValueError(f"id: expected ({count},) int64, got {getattr(id, 'shape', id)} {getattr(id, 'dtype', '')}")
    if count and int(id.min()) < 0:
        raise ValueError(f"id: expected numbers >= 0, got {int(id.min())}")
    return id.to(device)


# Names of arguments of `World.move`.
_RESERVED = ("position", "self")


def payload_columns(payload: dict[str, Tensor], argument: str, count: int, device: torch.device) -> Columns:
    """The user's tensors under names that differ from those of other columns."""
    if not isinstance(payload, dict) or not all(isinstance(name, str) for name in payload):
        raise TypeError(f"{argument}: expected tensors by name, got {arguments.describe(payload)}")
    columns = {}
    for name in sorted(payload):  # in the same order on all ranks
        values = payload[name]
        if isinstance(values, Tensor):
            arguments.refuse_gradient(values, f"{argument}[{name!r}]")
        if not isinstance(values, Tensor) or values.shape[:1] != (count,) or values.device != device:
            expected = f"a tensor ({count}, ...) on {device}"
            where = f" on {values.device}" if isinstance(values, Tensor) else ""
            raise ValueError(f"{argument}[{name!r}]: expected {expected}, got {arguments.describe(values)}{where}")
        if values.layout != torch.strided or values.is_quantized:
            raise ValueError(f"{argument}[{name!r}]: expected a dense tensor, not a sparse or quantized one")
        if name in _RESERVED:
            raise ValueError(f"{argument}[{name!r}]: this name is reserved")
        columns["." + name] = values.detach()
    return columns


def require_unique(comm: Comm, id: Tensor) -> None:
    """Raises ValueError unless ids are unique: all equal ids are sent to the same rank and compared there."""
    rows = torch.arange(len(id), device=id.device)
    seen = make_route(comm, rows, id % comm.size).forward({"id": id}).wait()["id"].sort().values
    twice = seen[1:][seen[1:] == seen[:-1]]

    def check() -> None:
        if len(twice):
            raise ValueError(f"id: {int(twice[0])} is given to more than one body")

    together(comm, check)


def new_values(new: Mapping[str, Tensor], columns: Columns, vertices: Columns) -> tuple[Columns, Columns]:
    """New columns from the arguments of `World.move`, validated.

    Args:
        new: "position", and values of the payload, by name.
        columns, vertices: current columns of the world; names of the payload begin with ".".

    Returns:
        New columns of bodies and of vertices.

    Raises:
        TypeError, ValueError: naming the argument.
    """
    of_bodies: Columns = {}
    of_vertices: Columns = {}
    for name, values in new.items():
        key = name if name == "position" else "." + name
        former = columns.get(key, vertices.get(key))
        if former is None:
            known = sorted(name[1:] for name in (*columns, *vertices) if name.startswith("."))
            raise ValueError(f"{name}: not a payload of this world, which has {known}")
        if not isinstance(values, Tensor) or values.layout != torch.strided:
            raise TypeError(f"{name}: expected a dense tensor, got {arguments.describe(values)}")
        arguments.refuse_gradient(values, name)
        if values.shape != former.shape or values.dtype != former.dtype or values.device != former.device:
            expected = f"{tuple(former.shape)} {former.dtype} on {former.device}"
            raise ValueError(f"{name}: expected {expected}, got {tuple(values.shape)} {values.dtype}")
        (of_bodies if key in columns else of_vertices)[key] = values.detach().contiguous()
    require_positions(new["position"])
    return of_bodies, of_vertices


def require_positions(position: Tensor) -> None:
    """Raises ValueError naming the first of positions (N, 3) that is not finite, or too large."""
    wrong = torch.nonzero(~(position.abs() <= LARGEST_COORDINATE).all(dim=1))
    if len(wrong):
        row = int(wrong[0])
        expected = f"finite numbers up to {LARGEST_COORDINATE:g}"
        raise ValueError(f"position: row {row}: expected {expected}, got {position[row].tolist()}")
