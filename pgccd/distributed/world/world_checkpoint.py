"""Checkpoints of a `World`: bodies with all columns, vertices of deforming bodies, and the partition."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from dataclasses import replace
from os import PathLike
from pathlib import Path
from typing import Any

import torch

from pgccd import arguments
from pgccd.checkpoint.files import CheckpointError, checked_keep, whole_number
from pgccd.checkpoint.stored import Index, Stored, has_checkpoint
from pgccd.distributed.checkpoint.partition import load_partition, stored_kind
from pgccd.distributed.checkpoint.reading import load_share, open_stored
from pgccd.distributed.checkpoint.shared_folder import hold_together
from pgccd.distributed.checkpoint.writing import CheckpointWriter
from pgccd.distributed.comm.interface import Comm
from pgccd.distributed.guard import of_all_ranks
from pgccd.distributed.launch.agreement import on_first, require_agreement, together
from pgccd.distributed.partition.balance import BalanceOptions
from pgccd.distributed.partition.cut import Cut
from pgccd.distributed.partition.interface import Partition
from pgccd.distributed.world.input_checks import SCENE_COLUMNS
from pgccd.distributed.world.options import NewBodies
from pgccd.distributed.world.state import WorldState, state_given
from pgccd.geometry.digest import meshes_digest
from pgccd.geometry.mesh import Mesh
from pgccd.geometry.mesh_set import MeshSet
from pgccd.geometry.scene import Scene

KIND = "world"
_BODIES, _VERTICES, _COUNT = "bodies", "vertices", "vertex_count"
_EXCLUDE, _PAIR = "exclude", "pair"
_HEADER = "of_user"
_REQUIRED = ("id", "mesh_index", "position")
_KNOWN = (*_REQUIRED, *SCENE_COLUMNS, _COUNT)


class Saving:
    """A checkpoint that all ranks write in the background, while its folder stays locked.

    Args:
        writer: has begun to write it.
        lock: holds the folder.
    """

    def __init__(self, writer: CheckpointWriter, lock: ExitStack) -> None:
        self._writer, self._lock = writer, lock

    def finish(self) -> None:
        """Waits until it is complete, and releases the folder; raises as of `CheckpointWriter.finish`."""
        with self._lock:
            self._writer.finish()


def save_state(
    comm: Comm, folder: str | PathLike[str], state: WorldState, keep: int, header: Mapping[str, Any] | None, wait: bool
) -> tuple[Path, Saving]:
    """Starts to write a checkpoint, which becomes the newest one in a folder; see `World.save`. Returns its folder."""
    root = _folder_given(comm, folder)
    keep, plain, wait = together(comm, lambda: (checked_keep(keep), _plain(header), arguments.flag(wait, "wait")))
    require_agreement(comm, {"keep": keep, "header": plain, "wait": wait})
    tables = {_BODIES: state.columns}
    if state.vertices is not None:
        tables[_VERTICES] = state.vertices.columns
    if state.exclude is not None:
        tables[_EXCLUDE] = {_PAIR: state.exclude[comm.rank :: comm.size]}
    cut = {"partition": state.cut.partition, "axes": int(state.cut.axes), "cells": state.cut.cells}
    cut |= {"lower": [float(x) for x in state.cut.lower], "upper": [float(x) for x in state.cut.upper]}
    index = {"meshes": meshes_digest(state.meshes.meshes), "cut": cut, "next_id": state.next_id}
    index |= {} if plain is None else {_HEADER: json.loads(plain)}
    with ExitStack() as stack:
        stack.enter_context(hold_together(comm, root))
        writer = CheckpointWriter(comm, root, KIND, keep)
        written = writer.begin(state.steps_made, index, tables, state.partition)
        return written, Saving(writer, stack.pop_all())


def load_state(
    comm: Comm,
    folder: str | PathLike[str],
    meshes: Sequence[Mesh],
    device: torch.device | str,
    balance: BalanceOptions,
) -> WorldState:
    """An equal share of the bodies of a checkpoint, and its partition; see `World.load`."""
    root = _folder_given(comm, folder)
    if not on_first(comm, lambda: has_checkpoint(root)):  # same type on all ranks: callers may create a new world
        raise of_all_ranks(FileNotFoundError(f"folder: no checkpoint at {root}"))
    stored = open_stored(comm, lambda index: _stored(root, index))

    def prepare() -> tuple[MeshSet, Partition, int]:
        where = arguments.device(device)
        mesh_set = MeshSet(meshes, where)
        if meshes_digest(mesh_set.meshes) != stored.header.get("meshes"):
            raise ValueError(f"meshes: the world in {root} was saved with others")
        return mesh_set, _cut(stored).uniform(comm.size, where, balance, stored_kind(stored)), _next_id(stored)

    mesh_set, uniform, next_id = together(comm, prepare)
    partition = load_partition(comm, stored, uniform)
    ragged = (_COUNT, _VERTICES) if _VERTICES in stored.layout else None
    found = load_share(comm, stored, _BODIES, ragged)
    exclude = load_share(comm, stored, _EXCLUDE)[_EXCLUDE][_PAIR] if _EXCLUDE in stored.layout else None
    where = mesh_set.device
    columns = {name: column.to(where) for name, column in found[_BODIES].items()}
    of_vertices = {name: column.to(where) for name, column in found.get(_VERTICES, {}).items()}

    def check() -> tuple[WorldState, NewBodies]:
        given: dict[str, Any] = {name: columns[name] for name in SCENE_COLUMNS if name in columns}
        if "static" in given:
            given["static"] = given["static"].to(torch.bool)
        scene = Scene(mesh_set, columns["mesh_index"], **given)
        payload = {name[1:]: column for name, column in columns.items() if name.startswith(".")}
        of_each = {name[1:]: column for name, column in of_vertices.items()}
        bodies = NewBodies(scene, columns["position"], columns["id"], exclude, payload, of_each)
        return state_given(comm.size, bodies, _cut(stored), balance), bodies

    try:
        state, bodies = together(comm, check)
        state = state.with_ids(comm, are_given=True).with_excluded(comm, bodies, state.columns["id"])
    except (TypeError, ValueError) as error:
        raise CheckpointError(f"{stored.folder} is not the checkpoint of a world: {error}") from error
    if next_id < state.next_id:
        problem = f"there is an id {state.next_id - 1}, but the next one is {next_id}"
        raise of_all_ranks(CheckpointError(f"{stored.folder} is not the checkpoint of a world: {problem}"))
    header = stored.header.get(_HEADER)
    if not isinstance(header, dict | None):
        raise of_all_ranks(CheckpointError(f"{stored.folder} is not the checkpoint of a world: {_HEADER}"))
    return replace(state, partition=partition, steps_made=stored.steps_made, next_id=next_id, header=header)


def _plain(header: Mapping[str, Any] | None) -> str | None:
    """The header as JSON, which reads back as given."""
    if header is None:
        return None
    try:
        if isinstance(header, Mapping) and json.loads(text := json.dumps(dict(header), allow_nan=False)) == header:
            return text
    except (TypeError, ValueError):  # not plain, or not finite
        pass
    expected = "a dictionary of plain values (strings, finite numbers, bools, None, lists, dictionaries by string)"
    raise TypeError(f"header: expected {expected}, got {arguments.describe(header)}")


def _folder_given(comm: Comm, folder: str | PathLike[str]) -> Path:
    """The folder as a path; equal on all ranks."""
    path = together(comm, lambda: arguments.path(folder, "folder"))
    require_agreement(comm, {"folder": str(path)})
    return path


def _stored(folder: Path, index: Index | None) -> Stored:
    """The newest checkpoint, with an index that has all columns of a world."""
    stored = Stored(folder, KIND, index)
    names = stored.layout.get(_BODIES, {})
    missing = [name for name in _REQUIRED if name not in names]
    missing += [_PAIR] if _EXCLUDE in stored.layout and _PAIR not in stored.layout[_EXCLUDE] else []
    missing += [_COUNT] if _VERTICES in stored.layout and _COUNT not in names else []
    unknown = [name for name in names if name not in _KNOWN and not name.startswith(".")]
    if missing or unknown or not set(stored.layout) <= {_BODIES, _VERTICES, _EXCLUDE}:
        problem = f"without {missing}" if missing else f"with unknown columns {unknown} or tables"
        raise CheckpointError(f"{stored.folder} is not the checkpoint of a world: {problem}")
    return stored


def _next_id(stored: Stored) -> int:
    try:
        return whole_number(stored.header.get("next_id"))
    except ValueError as error:
        raise CheckpointError(f"{stored.folder} is not the checkpoint of a world: next_id: {error}") from error


def _cut(stored: Stored) -> Cut:
    content: Any = stored.header.get("cut")
    try:
        cells = content["cells"] if isinstance(content["cells"], int) else tuple(content["cells"])
        cut = Cut(content["partition"], tuple(content["lower"]), tuple(content["upper"]), content["axes"], cells)
        count = cut.cell_count(BalanceOptions("none"))
        if 8 * count > stored.shared_bytes():  # of each owner
            raise ValueError(f"cells: {count} in each subdomain, more than its table of owners can have")
        cut.uniform(1, torch.device("cpu"), BalanceOptions("none"))
    except (KeyError, TypeError, ValueError, OverflowError) as error:
        raise CheckpointError(f"{stored.folder} is not the checkpoint of a world: {error}") from error
    return cut
