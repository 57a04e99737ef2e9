"""Checks of user input to a `World`."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from typing import Any

import torch
from torch import Tensor

from pgccd import arguments
from pgccd.checkpoint.files import rows_hash
from pgccd.distributed.comm.exchange import Columns, make_route
from pgccd.distributed.comm.interface import Comm
from pgccd.distributed.guard import of_all_ranks
from pgccd.distributed.halo.vertices import Vertices, vertex_counts
from pgccd.distributed.launch.agreement import together
from pgccd.geometry.mesh_set import MeshSet
from pgccd.geometry.scene import OPTIONAL_COLUMNS, Scene
from pgccd.motion.paths import RigidMotion, VertexMotion
from pgccd.motion.trajectory import Trajectory
from pgccd.motion.validation import LARGEST_COORDINATE
from pgccd.search.bodies import MovingBodies

#: Optional columns of scenes.
SCENE_COLUMNS = (*OPTIONAL_COLUMNS, "self_collision")
# All columns that detection reads.
_OF_SCENES = ("id", "mesh_index", *SCENE_COLUMNS)


def scene_of(meshes: MeshSet, columns: Columns) -> Scene:
    """The scene of bodies with these columns."""
    optional: dict[str, Any] = {name: columns[name] for name in SCENE_COLUMNS if name in columns}
    return Scene._of_checked(meshes, columns["mesh_index"], **optional)


def scene_columns(columns: Columns) -> Columns:
    """The columns that detection reads."""
    return {name: columns[name] for name in _OF_SCENES if name in columns}


def columns_to_send(id: Tensor, bodies: MovingBodies) -> Columns:
    """The columns of bodies in motion that other ranks need. Columns of vertices are sent separately.

    Args:
        id: (N,) int64.
        bodies: of these ids.
    """
    columns = {"id": id, **bodies.columns}
    columns.pop("radius", None)  # follows from the mesh
    return columns


def motion_facts(motion: Any, path: str, meshes: MeshSet, mesh_index: Tensor) -> dict[str, Any]:
    """Facts about the motion of bodies with these meshes (N,) that must be equal on all ranks.

    Args:
        path: of the world.

    Raises:
        TypeError, ValueError: it is no motion, or has another number of bodies or vertices, or another path.
    """
    arguments.instance(motion, "motion", RigidMotion, VertexMotion, Trajectory)
    motion._refuse_gradient()
    facts: dict[str, Any] = {"motion": type(motion).__name__}
    deforms = isinstance(motion, VertexMotion)
    if isinstance(motion, Trajectory):
        deforms, given = motion.orientation is None, motion.position.shape[1]
        facts |= {"motion.segment_count": motion.segment_count}
        for name in ("orientation", "margin"):
            facts[f"motion.{name}"] = "not given" if getattr(motion, name) is None else "given"
    else:
        given = motion.body_count if isinstance(motion, RigidMotion) else len(motion.x_t0)
    what, expected = "bodies", len(mesh_index)
    if deforms:
        what, expected = "vertices", int(vertex_counts(meshes, mesh_index).sum())
    if given != expected:
        raise ValueError(f"motion: has {given} {what}, this rank owns {expected}")
    if not isinstance(motion, VertexMotion) and not deforms and motion.path != path:
        raise ValueError(f"motion: its path is {motion.path!r}, the world's is {path!r}")
    if isinstance(motion, Trajectory):
        motion._margins(None, len(mesh_index))  # checks their number
    return facts


#: Of int64.
LARGEST_ID = 2**63 - 1


def ids_given(id: Tensor | None, count: int, device: torch.device) -> Tensor:
    """(count,) int64: the given ids, or 0 to count - 1."""
    if id is None:
        return torch.arange(count, device=device)
    if not isinstance(id, Tensor) or id.dtype != torch.int64 or id.shape != (count,):
        raise ValueError(f"id: expected ({count},) int64, got {getattr(id, 'shape', id)} {getattr(id, 'dtype', '')}")
    if count and int(id.min()) < 0:
        raise ValueError(f"id: expected numbers >= 0, got {int(id.min())}")
    return id.to(device)


def require_ids(ids: Tensor, device: torch.device) -> None:
    """Raises TypeError or ValueError unless these are int64 numbers on a device."""
    if not isinstance(ids, Tensor) or ids.dtype != torch.int64 or ids.layout != torch.strided:
        raise TypeError(f"ids: expected an int64 tensor, got {arguments.describe(ids)}")
    if ids.device != device:
        raise ValueError(f"ids: expected them on {device}, got {ids.device}")


def from_all_ranks(comm: Comm, values: Tensor) -> Tensor:
    """The int64 values (M,) of all ranks, one rank after the other."""
    everything = torch.arange(len(values), device=values.device).repeat(comm.size)
    destination = torch.arange(comm.size, device=values.device).repeat_interleave(len(values))
    return make_route(comm, everything, destination).forward({"values": values}).wait()["values"]


def unknown_ids(comm: Comm, own: Tensor, asked: Tensor) -> Tensor:
    """The ids among (M,), equal on all ranks, that no rank owns; `own` (N,) may be in any order."""
    if not len(asked):
        return asked
    return asked[comm.sum(torch.isin(asked, own).to(torch.int64)) == 0]


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


def require_different(comm: Comm, columns: Columns, vertices: Vertices | None) -> None:
    """Raises ValueError, on all ranks, if two ranks have the same bodies: all columns but ids and payload are equal."""
    of_scene = _on_host({name: columns[name] for name in columns if name != "id" and not name.startswith(".")})
    count = len(columns["id"])
    digest = rows_hash(of_scene, 0, 0) + (0 if vertices is None else rows_hash(_on_host(vertices.columns), 1, 0))
    mine = torch.tensor([count, digest % 2**63])
    first: dict[tuple[int, int], int] = {}
    for rank, (bodies, hash) in enumerate(comm.all_gather(mine).tolist()):
        other = first.setdefault((bodies, hash), rank)
        if bodies and other != rank:
            raise of_all_ranks(
                ValueError(
                    f"position: expected each body on one rank, but ranks {other} and {rank} passed the same ones "
                    f"({bodies}), without `id`: pass a share on each rank, or give different bodies different ids"
                )
            )


def _on_host(columns: Columns) -> Columns:
    return {name: column.cpu() for name, column in columns.items()}


def payload_asked(payload: Collection[str], columns: Columns) -> list[str]:
    """The names in `columns` of the payload that contacts are to carry, in the same order on all ranks.

    Args:
        payload: as for `World.step`.
        columns: of the world; names of the payload begin with ".".

    Raises:
        TypeError, ValueError: naming the argument.
    """
    is_list = isinstance(payload, Collection) and not isinstance(payload, (str, bytes, Tensor))
    if not is_list or not all(isinstance(name, str) for name in payload):
        given = arguments.describe(payload)
        raise TypeError(f'payload: expected names, such as ("velocity", "mass"), got {given}')
    known = {name.removeprefix("."): name for name in columns if name.startswith(".")} | {"position": "position"}
    for name in payload:
        if name not in known:
            raise ValueError(f"payload: expected some of {sorted(known)}, got {name!r}")
    return [known[name] for name in sorted(set(payload))]


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


def require_positions(position: Tensor) -> Tensor:
    """Positions (N, 3). Raises TypeError or ValueError if they are no positions, naming the first one that is not
    finite or too large.
    """
    position = arguments.real_tensor(position, "position")
    arguments.refuse_gradient(position, "position")
    if position.dim() != 2 or position.shape[1] != 3 or position.is_meta:
        raise ValueError(f"position: expected shape (N, 3), got {arguments.describe(position)}")
    wrong = torch.nonzero(~(position.abs() <= LARGEST_COORDINATE).all(dim=1))
    if len(wrong):
        row = int(wrong[0])
        expected = f"finite numbers up to {LARGEST_COORDINATE:g}"
        raise ValueError(f"position: row {row}: expected {expected}, got {position[row].tolist()}")
    return position
