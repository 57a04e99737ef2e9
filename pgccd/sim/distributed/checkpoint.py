"""Checkpoints of a run on many ranks, which any number of ranks can read: see `pgccd.sim.checkpoint`.

Every rank writes a file of its own robots, in the background while the next steps are made. Each reader takes an equal
share of the rows, whichever ranks wrote them.
"""

from __future__ import annotations

import threading
from concurrent.futures import Future
from contextlib import nullcontext
from pathlib import Path

import torch

from pgccd.distributed.comm.interface import Comm
from pgccd.distributed.guard import of_all_ranks
from pgccd.distributed.halo.migrate import id_range
from pgccd.distributed.launch.agreement import on_first, together
from pgccd.distributed.partition.cells import Cells
from pgccd.distributed.partition.interface import Partition
from pgccd.sim.checkpoint import StoredCheckpoint
from pgccd.sim.checkpoint_files import (
    FOLDER,
    CheckpointError,
    Header,
    Owners,
    make_folder,
    new_name,
    publish,
    write_robots,
)
from pgccd.sim.hashing import id_hash, state_hash
from pgccd.sim.model import RobotState


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
        self._root = folder / FOLDER
        self._background = comm.background
        self._writing: Future[None] | None = None

    def begin(self, header: Header, state: RobotState, partition: Partition) -> None:
        """Starts to write; returns once the robots have been copied. Waits for the checkpoint before, if need be.

        Raises:
            CheckpointError: that one, or the folder of this one, could not be written.
        """
        self.finish()
        name = on_first(self._comm, lambda: self._make_folder(header.steps_made))
        columns = {name: column.detach().to("cpu", copy=True) for name, column in state.columns.items()}
        owners = None
        if isinstance(partition, Cells):
            owners = Owners(partition.subdomains, partition.cells, partition.owner.to("cpu", copy=True))
        done: Future[None] = Future()

        def work() -> None:
            try:
                self._write(name, header, RobotState(**columns), owners)
                done.set_result(None)
            except BaseException as error:
                done.set_exception(error)

        self._writing = done
        threading.Thread(target=work, name="pgccd-checkpoint", daemon=True).start()

    def finish(self) -> None:
        """Waits until the last checkpoint is whole.

        Raises:
            CheckpointError, RuntimeError: it could not be written; on all ranks.
        """
        writing, self._writing = self._writing, None
        if writing is not None:
            with self._comm.guard.waiting("checkpoint") if self._comm.size > 1 else nullcontext():
                writing.result()

    def _make_folder(self, steps_made: int) -> str:
        name = new_name(steps_made)
        make_folder(self._root / name)
        return name

    def _write(self, name: str, header: Header, state: RobotState, owners: Owners | None) -> None:
        own, error = None, None
        try:
            own = write_robots(self._root / name, self._comm.rank, state)
        except CheckpointError as failed:
            error = str(failed)
        of_ranks = self._background.gather((own, error))
        if self._comm.rank == 0 and error is None:
            errors = [text for _, text in of_ranks if text is not None]
            error = errors[0] if errors else None
            if error is None:
                try:
                    publish(self._root, name, header, [entry for entry, _ in of_ranks if entry is not None], owners)
                except CheckpointError as failed:
                    error = str(failed)
        error = self._background.broadcast(error)
        if error is not None:
            raise of_all_ranks(CheckpointError(error))


def load_share(comm: Comm, stored: StoredCheckpoint) -> RobotState:
    """An equal share of the robots of a checkpoint, on the CPU; all ranks together get all of them, and have verified
    them.

    Raises:
        ValueError: it is damaged or cannot be read; on all ranks.
    """

    def read() -> RobotState:
        stored.verify(stored.files[comm.rank :: comm.size])
        return stored.rows(*id_range(comm, stored.robots))

    state = together(comm, read)
    hashes = [value - 2**64 if value >= 2**63 else value for value in (id_hash(state.id), state_hash(state))]
    ids, states = comm.sum(torch.tensor(hashes)).tolist()
    stored.require_hashes(ids, states)
    return state
