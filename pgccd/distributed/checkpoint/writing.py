"""Writing of checkpoints by all ranks: each writes its own rows, in the background.

`torch.distributed.checkpoint` is not used: its metadata are pickles, which run code when read, and its files have no
hashes.
"""

from __future__ import annotations

import threading
from collections.abc import Mapping
from concurrent.futures import Future
from contextlib import nullcontext
from dataclasses import asdict
from pathlib import Path
from typing import Any

from pgccd.checkpoint import files
from pgccd.checkpoint.files import CheckpointError, Content
from pgccd.distributed.checkpoint.partition import partition_header
from pgccd.distributed.comm.exchange import Columns
from pgccd.distributed.comm.interface import Comm, Objects
from pgccd.distributed.guard import of_all_ranks
from pgccd.distributed.launch.agreement import on_first
from pgccd.distributed.partition.interface import Partition


def copies_of(tables: Mapping[str, Columns]) -> dict[str, Columns]:
    """Copies of all columns on the CPU."""
    return {
        table: {name: column.detach().to("cpu", copy=True) for name, column in columns.items()}
        for table, columns in tables.items()
    }


class CheckpointWriter:
    """Writes checkpoints to a folder. Every rank writes a file of its own rows in the background.

    Args:
        comm: between the ranks; all methods are called by all ranks.
        folder: shared by all ranks.
        kind: of the checkpoints: see `pgccd.checkpoint.files.Content`.
        keep: number of checkpoints to keep: the newest ones.

    Example:
        >>> writer = CheckpointWriter(comm, folder, "world")
        >>> writer.begin(10, {"box": [1.0, 2.0, 3.0]}, {"bodies": {"id": id, "position": position}}, partition)
        >>> writer.finish()
    """

    def __init__(self, comm: Comm, folder: Path, kind: str, keep: int = files.KEEP) -> None:
        self._comm, self._kind, self._keep = comm, kind, keep
        self._root = folder / files.FOLDER
        self._background: Objects | None = None
        self._writing: tuple[Future[Path], threading.Thread] | None = None

    def begin(
        self, steps_made: int, header: Mapping[str, Any], tables: Mapping[str, Columns], partition: Partition
    ) -> Path:
        """Starts to write; returns once the rows have been copied. Waits for the previous checkpoint first.

        Args:
            steps_made: number of steps before this checkpoint.
            header: everything else, as JSON; equal on all ranks.
            tables: this rank's rows, as columns by name; names, dtypes and row shapes are equal on all ranks.
            partition: of space; equal on all ranks.

        Returns:
            The folder of the checkpoint, which `finish` makes the newest one.

        Raises:
            CheckpointError: the previous one, or the folder of this one, could not be written.
        """
        self.finish()
        self._background = self._comm.background  # made here, not in the thread
        name = on_first(self._comm, lambda: files.make_folder(self._root, self._kind, steps_made))
        cut, shared = partition_header(partition)
        copies: dict[str, Columns] = {}
        not_copied = None
        try:
            copies = copies_of(tables)
            shared = {name: tensor.to("cpu", copy=True) for name, tensor in shared.items()}
        except Exception as failed:  # such as too little memory: `_write` tells the other ranks
            not_copied = self._problem(name, failed)
        content = Content(self._kind, steps_made, {**header, "partition": cut}, shared)
        done: Future[Path] = Future()

        def work() -> None:
            try:
                done.set_result(self._write(name, content, copies, not_copied))
            except BaseException as error:
                done.set_exception(error)

        thread = threading.Thread(target=work, name="pgccd-checkpoint", daemon=True)
        self._writing = done, thread
        thread.start()
        return self._root / name

    def finish(self) -> None:
        """Waits until the last checkpoint is complete, if one is being written.

        Raises:
            CheckpointError, RuntimeError: it could not be written; on all ranks.
        """
        writing, self._writing = self._writing, None
        if writing is None:
            return
        done, thread = writing
        with self._comm.guard.waiting("checkpoint", may_last=True) if self._comm.size > 1 else nullcontext():
            try:
                done.result()
            finally:
                if done.done():
                    # The thread still frees its copies of the rows. If Python exited meanwhile, it would end the thread
                    # in the middle of this, and C++ would end the process.
                    thread.join()

    def _write(self, name: str, content: Content, tables: Mapping[str, Columns], error: str | None) -> Path:
        own = None
        if error is None:
            try:
                own = files.write_tables(self._root / name, self._comm.rank, tables)
            except Exception as failed:  # of any kind: the other ranks wait for the outcome
                error = self._problem(name, failed)
        assert self._background is not None
        of_ranks = self._background.gather([None if own is None else asdict(own), error])
        if self._comm.rank == 0:
            error = next((str(text) for _, text in of_ranks if text is not None), None)
            if error is None:
                try:
                    rows = [files.file_entry(entry) for entry, _ in of_ranks]
                    files.publish(self._root, name, content, files.layout_of(tables), rows, self._keep)
                except Exception as failed:
                    error = self._problem(name, failed)
            if error is not None:
                files.discard(self._root, name)
        error = self._background.broadcast(error)
        if error is not None:
            raise of_all_ranks(CheckpointError(error))
        return self._root / name

    def _problem(self, name: str, error: Exception) -> str:
        """An error as the message of a CheckpointError, in one line."""
        if isinstance(error, CheckpointError):
            return str(error)
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        return f"{self._root / name} cannot be written: {reason}"
