"""Checkpoints of a run on many ranks, by torch.distributed.checkpoint; any number of ranks reads them.

A column of all robots is one tensor of which every rank writes its rows; each reader takes an equal share of them,
whichever ranks wrote them. Writing goes on in the background while the next steps are made. Robots are written to a
folder with a temporary name; a pointer file, replaced last and at once, names the whole one.
"""

from __future__ import annotations

import json
import os
import shutil
import threading
import warnings
from collections.abc import Iterator, Sequence
from concurrent.futures import Future
from contextlib import contextmanager, nullcontext
from dataclasses import asdict, dataclass, fields
from pathlib import Path

import torch
from torch import Tensor

from pgccd.distributed.comm.interface import Comm
from pgccd.distributed.partition import Partition
from pgccd.sim.files import CHECKPOINT_FOLDER
from pgccd.sim.model import ModelConfig, RobotState

POINTER = "newest.json"
_OWNERS = "owners.json"
_FORMAT = 1


@dataclass
class Header:
    """A run between two steps, without its robots."""

    config: ModelConfig
    steps_made: int
    steps_wanted: int
    meshes: str  #: their `meshes_digest`


@dataclass
class _Owners:
    """The owner of each cell, in plain numbers."""

    subdomains: Sequence[int]
    cells: Sequence[int]
    owner: Sequence[int]


class Checkpoints:
    """Writes the checkpoints of a run.

    Args:
        comm: between the ranks; all of them make and use one together.
        folder: of the run, seen by all ranks.

    Example:
        >>> checkpoints = Checkpoints(comm, folder)
        >>> checkpoints.begin(Header(config, 10, 20, digest), state, partition)
        >>> checkpoints.finish()
    """

    def __init__(self, comm: Comm, folder: Path) -> None:
        self._comm = comm
        self._root = folder / CHECKPOINT_FOLDER
        self._group = None if comm.size == 1 else comm.checkpoint_group
        for leftover in self._root.glob("*.unfinished") if comm.rank == 0 else ():
            shutil.rmtree(leftover)  # of a run that was killed while writing
        self._writing: Future[None] | None = None

    def begin(self, header: Header, state: RobotState, partition: Partition) -> None:
        """Starts to write; returns once the robots have been copied. Waits for the checkpoint before, if need be."""
        self.finish()
        counts = self._comm.all_gather(torch.tensor([len(state)]))[:, 0].tolist()
        begin, total = sum(counts[: self._comm.rank]), sum(counts)
        columns = {name: column.detach().to("cpu", copy=True) for name, column in state.columns.items()}
        owner = _Owners(partition.subdomains, partition.cells, partition.owner.tolist())
        done: Future[None] = Future()

        def work() -> None:
            try:
                self._write(header, columns, begin, total, owner)
                done.set_result(None)
            except BaseException as error:
                done.set_exception(error)

        self._writing = done
        threading.Thread(target=work, name="pgccd-checkpoint", daemon=True).start()

    def finish(self) -> None:
        """Waits until the last checkpoint is whole.

        Raises:
            OSError, RuntimeError: it could not be written.
        """
        writing, self._writing = self._writing, None
        if writing is not None:
            with self._comm.guard.waiting("checkpoint") if self._comm.size > 1 else nullcontext():
                writing.result()

    def _write(self, header: Header, columns: dict[str, Tensor], begin: int, total: int, owners: _Owners) -> None:
        # Importing it takes as long as half of torch, which runs that write no checkpoint need not wait for.
        from pgccd.sim.distributed.row_planners import SaveRows, dcp

        name = f"step-{header.steps_made:09d}"
        unfinished = self._root / f"{name}.unfinished"
        writer, planner = dcp.FileSystemWriter(unfinished), SaveRows(begin, total)
        with _without_group_warning():
            dcp.save(
                dict(columns),
                storage_writer=writer,
                planner=planner,
                process_group=self._group,
                no_dist=self._group is None,
            )
        if self._comm.rank != 0:
            return
        # The coordinator comes here once all ranks have written.
        (unfinished / _OWNERS).write_text(json.dumps(asdict(owners)))
        final = self._root / name
        if final.exists():  # by a run that was interrupted later, and came to the same state
            shutil.rmtree(final)
        os.replace(unfinished, final)
        content = {"format": _FORMAT, "folder": name, "robots": total} | asdict(header)
        pointer = self._root / POINTER
        temporary = pointer.with_suffix(".unfinished")
        with open(temporary, "w") as file:
            json.dump(content, file)
            file.flush()
            os.fsync(file.fileno())
        os.replace(temporary, pointer)
        for other in self._root.glob("step-*"):
            if other != final:
                shutil.rmtree(other, ignore_errors=True)


def newest_header(folder: Path) -> Header | None:
    """Of the newest whole checkpoint in a run's folder; None if there is none.

    Raises:
        ValueError: it cannot be read.
    """
    path = folder / CHECKPOINT_FOLDER / POINTER
    if not path.is_file():
        return None
    try:
        content = json.loads(path.read_text())
        if content["format"] != _FORMAT:
            raise ValueError(f"its format is {content['format']}, this version reads {_FORMAT}")
        config = content["config"] | {"stay_steps": tuple(content["config"]["stay_steps"])}
        return Header(ModelConfig(**config), content["steps_made"], content["steps_wanted"], content["meshes"])
    except (KeyError, TypeError, ValueError) as error:
        raise ValueError(f"{path} is not a checkpoint of a simulation: {error}") from error


def read_owners(folder: Path, partition: Partition) -> list[int] | None:
    """The owner of each cell when the newest checkpoint was made, so that loads stay even; None if space was cut in
    another way then.

    Raises:
        ValueError: it cannot be read.
    """
    root = folder / CHECKPOINT_FOLDER
    try:
        path = root / json.loads((root / POINTER).read_text())["folder"] / _OWNERS
        if not path.is_file():
            return None
        owners = _Owners(**json.loads(path.read_text()))
    except (KeyError, TypeError, ValueError) as error:
        raise ValueError(f"{root} does not contain the owners of cells: {error}") from error
    same = (*owners.subdomains, *owners.cells) == (*partition.subdomains, *partition.cells)
    return list(owners.owner) if same else None


def load_share(comm: Comm, folder: Path) -> RobotState:
    """An equal share of the robots of the newest checkpoint, on the CPU; all ranks together get all of them.

    Raises:
        ValueError: it cannot be read.
    """
    from pgccd.sim.distributed.row_planners import LoadRows, dcp

    root = folder / CHECKPOINT_FOLDER
    try:
        content = json.loads((root / POINTER).read_text())
        total = content["robots"]
        begin, end = total * comm.rank // comm.size, total * (comm.rank + 1) // comm.size
        columns = _empty_columns(end - begin)
        # Every rank reads for itself: what is there is whole, and nothing need be agreed.
        reader = dcp.FileSystemReader(root / content["folder"])
        with _without_group_warning():
            dcp.load(dict(columns), storage_reader=reader, planner=LoadRows(begin), no_dist=True)
    except Exception as error:
        raise ValueError(f"{root} holds no checkpoint that can be read: {error}") from error
    return RobotState(**columns)


@contextmanager
def _without_group_warning() -> Iterator[None]:
    """It is on purpose that one process writes or reads by itself."""
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "torch.distributed is disabled", UserWarning)
        yield


def _empty_columns(count: int) -> dict[str, Tensor]:
    widths = {"id": 0, "position": 3, "orientation": 4, "velocity": 3, "angular_velocity": 3}
    columns = {}
    for name in (field.name for field in fields(RobotState)):
        width = widths.get(name, 0)
        shape, dtype = ((count, width), torch.float64) if width else ((count,), torch.int64)
        columns[name] = torch.empty(shape, dtype=dtype)
    return columns
