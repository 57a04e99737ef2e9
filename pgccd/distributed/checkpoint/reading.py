"""Reading of checkpoints by any number of ranks, written by any number of ranks."""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeVar

import torch

from pgccd.checkpoint.stored import Index, Stored
from pgccd.distributed.comm.exchange import Columns
from pgccd.distributed.comm.interface import Comm
from pgccd.distributed.halo.migrate import id_range
from pgccd.distributed.launch.agreement import on_first, together

S = TypeVar("S", bound=Stored)


def open_stored(comm: Comm, read: Callable[[Index | None], S]) -> S:
    """A checkpoint whose index rank 0 has read, on all ranks.

    Args:
        comm: between the ranks.
        read: reads the checkpoint, given its `Stored.index` or None.

    Raises:
        ValueError, FileNotFoundError: as `read` on rank 0; a ValueError on the others.
    """
    name, content = on_first(comm, lambda: read(None).index)
    return together(comm, lambda: read((name, content)))


def load_share(comm: Comm, stored: Stored, table: str, ragged: tuple[str, str] | None = None) -> dict[str, Columns]:
    """An equal share of the rows of a table, on the CPU. All ranks together verify and read all files; each reads only
    its own rows.

    Args:
        comm: between the ranks.
        stored: the checkpoint, equal on all ranks.
        table: the table to read.
        ragged: a column (N,) int64 of this table, and the name of another table: the column holds the number of rows of
            the other table that belong to each row, in the same order.

    Returns:
        The columns of the table and of the ragged one, by table name.

    Raises:
        ValueError: the checkpoint is damaged or cannot be read; on all ranks.
    """

    def read() -> tuple[dict[str, Columns], list[int]]:
        begin, end = id_range(comm, stored.row_count(table))
        columns, total = stored.rows(table, begin, end)
        found, hashes = {table: columns}, [total]
        if ragged is not None:
            counts, other = ragged
            first = stored.first_of(table, begin, counts, other)
            found[other], total = stored.rows(other, first, first + int(columns[counts].sum()))
            hashes.append(total)
        return found, hashes

    together(comm, lambda: stored.verify(stored.files[comm.rank :: comm.size]))
    found, hashes = together(comm, read)
    signed = [value - 2**64 if value >= 2**63 else value for value in hashes]
    totals = comm.sum(torch.tensor(signed)).tolist()

    def compare() -> None:
        for name, total in zip(found, totals, strict=True):
            stored.require_hash(name, total)

    together(comm, compare)
    return found
