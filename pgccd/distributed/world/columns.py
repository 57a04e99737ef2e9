"""What users bring to a `World`, checked."""

from __future__ import annotations

import torch
from torch import Tensor

from pgccd import arguments
from pgccd.distributed.comm.exchange import Columns, make_route
from pgccd.distributed.comm.interface import Comm
from pgccd.distributed.launch.agreement import together
from pgccd.motion.paths import RigidMotion, VertexMotion
from pgccd.motion.trajectory import Trajectory


def require_rows(motion: RigidMotion | VertexMotion | Trajectory, bodies: int, vertex_count: Tensor) -> None:
    """Raises ValueError unless a motion has so many bodies, or their vertices."""
    if isinstance(motion, RigidMotion):
        what, given, expected = "bodies", motion.body_count, bodies
    elif isinstance(motion, VertexMotion):
        what, given, expected = "vertices", len(motion.x_t0), int(vertex_count.sum())
    elif motion.orientation is None:
        what, given, expected = "vertices", motion.position.shape[1], int(vertex_count.sum())
    else:
        what, given, expected = "bodies", motion.position.shape[1], bodies
    if given != expected:
        raise ValueError(f"motion: has {given} {what}, this rank owns {expected}")


def ids_given(id: Tensor | None, count: int, device: torch.device) -> Tensor:
    """(count,) int64: the ids, or those from 0 on."""
    if id is None:
        return torch.arange(count, device=device)
    if not isinstance(id, Tensor) or id.dtype != torch.int64 or id.shape != (count,):
        raise ValueError(f"id: expected ({count},) int64, got {getattr(id, 'shape', id)} {getattr(id, 'dtype', '')}")
    if count and int(id.min()) < 0:
        raise ValueError("id: expected numbers >= 0")
    return id.to(device)


def payload_columns(payload: dict[str, Tensor], argument: str, count: int, device: torch.device) -> Columns:
    """The user's tensors, by names that cannot be those of other columns."""
    if not isinstance(payload, dict) or not all(isinstance(name, str) for name in payload):
        raise TypeError(f"{argument}: expected tensors by name, got {arguments.describe(payload)}")
    columns = {}
    for name in sorted(payload):  # in one order on all ranks
        values = payload[name]
        if isinstance(values, Tensor):
            arguments.refuse_gradient(values, f"{argument}[{name!r}]")
        if not isinstance(values, Tensor) or values.shape[:1] != (count,) or values.device != device:
            raise ValueError(f"{argument}[{name!r}]: expected a tensor ({count}, ...) on {device}")
        columns["." + name] = values.detach()
    return columns


def require_unique(comm: Comm, id: Tensor) -> None:
    """Each id goes to one rank that sees all like it."""
    rows = torch.arange(len(id), device=id.device)
    seen = make_route(comm, rows, id % comm.size).forward({"id": id}).wait()["id"].sort().values
    twice = seen[1:][seen[1:] == seen[:-1]]

    def check() -> None:
        if len(twice):
            raise ValueError(f"id: {int(twice[0])} is given to more than one body")

    together(comm, check)
