"""Bodies that join and leave a `World` between steps."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from pgccd import arguments
from pgccd.distributed.comm.exchange import Columns, pack, replace_rows
from pgccd.distributed.comm.interface import Comm
from pgccd.distributed.detection.ids import rows_of
from pgccd.distributed.guard import of_all_ranks
from pgccd.distributed.halo.vertices import Vertices
from pgccd.distributed.launch.agreement import require_agreement, together
from pgccd.distributed.world.input_checks import from_all_ranks, require_ids, unknown_ids
from pgccd.distributed.world.options import NewBodies
from pgccd.distributed.world.state import WorldState, bodies_given
from pgccd.geometry.digest import meshes_digest

# Values and dtypes of optional columns of bodies for which none is given: those of `pgccd.Scene`.
_DEFAULTS: dict[str, tuple[float, torch.dtype]] = {
    "group": (-1, torch.int64),
    "mask": (-1, torch.int64),
    "world": (0, torch.int32),
    "static": (0, torch.uint8),
    "margin": (0.0, torch.float64),
    "self_collision": (False, torch.bool),
}


def with_more(comm: Comm, state: WorldState, bodies: NewBodies) -> tuple[WorldState, Tensor]:
    """A world with more bodies, on the ranks that passed them; see `World.add`.

    Args:
        comm: between the ranks.
        state: of the world.
        bodies: this rank's share of the new bodies.

    Returns:
        The state, and the ids of the new bodies of this rank, (M,) int64, in the order of `position`.

    Raises:
        TypeError, ValueError: naming the argument; on all ranks.
    """
    id = bodies.id

    def check() -> tuple[Columns, Vertices | None]:
        columns, vertices = bodies_given(bodies)
        meshes = bodies.scene.meshes
        if meshes is not state.meshes and meshes_digest(meshes.meshes) != meshes_digest(state.meshes.meshes):
            raise ValueError("scene: expected one with the meshes of this world, `World.meshes`")
        arguments.shape(columns["position"], "position", ("M", 3), state.columns["id"].device)
        if id is not None and len(id) and int(id.min()) < state.next_id:
            expected = f"new ids, from {state.next_id} on (smaller ones may have been used)"
            raise ValueError(f"id: expected {expected}, got {int(id.min())}")
        _require_payload(columns, state.columns, "payload")
        new_vertices, former_vertices = ({} if each is None else each.columns for each in (vertices, state.vertices))
        _require_payload(new_vertices, former_vertices, "vertex_payload")
        return columns, vertices

    columns, vertices = together(comm, check)
    optional = [name for name in _DEFAULTS if name in columns]
    require_agreement(comm, {"id": "not given" if id is None else "given", "optional columns": optional})
    new = replace(state, columns=columns, vertices=vertices).with_ids(comm, id is not None)
    former = _completed(state.columns, columns)
    added = {name: _completed(new.columns, state.columns)[name] for name in former}
    everything = torch.arange(len(added["id"]), device=added["id"].device)
    joined = _merged(former, everything[:0], added, everything)
    both = None
    if state.vertices is not None and new.vertices is not None:
        order = torch.argsort(torch.cat([former["id"], added["id"]]))
        both = Vertices.join(state.vertices, new.vertices).take(order)
    return replace(new, columns=joined, vertices=both).with_excluded(comm, bodies, added["id"]), added["id"]


def without(comm: Comm, state: WorldState, ids: Tensor) -> WorldState:
    """A world without some of its bodies; see `World.remove`.

    Args:
        comm: between the ranks.
        state: of the world.
        ids: (M,) int64 of any bodies.

    Raises:
        TypeError, ValueError: naming the argument; on all ranks.
    """
    own = state.columns["id"]

    def check() -> None:
        require_ids(ids, own.device)
        if ids.dim() != 1:
            raise ValueError(f"ids: expected shape (M,), got {tuple(ids.shape)}")

    together(comm, check)
    mine = rows_of(own, ids)
    # Usually few ids belong to bodies of other ranks; all ranks look for these.
    asked = from_all_ranks(comm, ids[mine < 0].unique())
    theirs = rows_of(own, asked)
    unknown = unknown_ids(comm, own, asked)
    if len(unknown):
        raise of_all_ranks(ValueError(f"ids: expected ids of bodies of this world, got {int(unknown.min())}"))
    removed = torch.cat([mine[mine >= 0], theirs[theirs >= 0]]).unique()
    kept = _merged(state.columns, removed, state.columns, removed[:0])
    vertices = state.vertices
    if vertices is not None:
        stays = torch.ones(len(own), dtype=torch.bool, device=own.device)
        stays[removed] = False
        vertices = vertices.take(torch.nonzero(stays)[:, 0])
    state = replace(state, columns=kept, vertices=vertices)
    if state.exclude is None:
        return state
    gone = from_all_ranks(comm, own[removed])
    return state.without_excluded(gone)


def _require_payload(new: Columns, former: Columns, argument: str) -> None:
    """Raises ValueError unless new bodies have the payload that a world has, of the same shapes and dtypes."""
    known, given = ([name for name in columns if name.startswith(".")] for columns in (former, new))
    if sorted(known) != sorted(given):
        expected, got = ([name[1:] for name in sorted(names)] for names in (known, given))
        raise ValueError(f"{argument}: expected tensors named {expected}, as this world has, got {got}")
    for name in known:
        if new[name].dtype != former[name].dtype or new[name].shape[1:] != former[name].shape[1:]:
            raise ValueError(f"{argument}[{name[1:]!r}]: expected {_kind(former[name])}, got {_kind(new[name])}")


def _kind(column: Tensor) -> str:
    """Shape and dtype of a column, for any number of rows."""
    return f"({', '.join(['M', *map(str, column.shape[1:])])}) {arguments.dtype_name(column.dtype)}"


def _completed(columns: Columns, like: Columns) -> Columns:
    """The columns, with default values for optional columns that only other bodies have."""
    id = columns["id"]
    missing = {name: _DEFAULTS[name] for name in _DEFAULTS if name in like and name not in columns}
    return columns | {
        name: torch.full((len(id),), value, dtype=dtype, device=id.device) for name, (value, dtype) in missing.items()
    }


def _merged(columns: Columns, removed: Tensor, more: Columns, rows: Tensor) -> Columns:
    """The columns without the rows `removed`, ascending, and with those of `more`, by ascending id."""
    id_first = {"id": columns["id"], **columns}
    changed = replace_rows(id_first, removed, pack({name: more[name] for name in id_first}, rows))
    return {name: changed[name] for name in columns}
