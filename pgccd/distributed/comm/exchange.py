"""Exchange of rows of columns between ranks: packed into bytes, one message per rank."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import torch
from torch import Tensor

from pgccd import ops
from pgccd.distributed.comm.interface import Comm, Pending

Columns = dict[str, Tensor]


def pack(columns: Mapping[str, Tensor], rows: Tensor) -> Tensor:
    """(K, bytes) uint8: the rows (K,) of all columns, concatenated in the order of the columns."""
    return ops.pack_rows(list(columns.values()), rows)


def unpack(packed: Tensor, like: Mapping[str, Tensor]) -> Columns:
    """The inverse of `pack`, for columns of the same names, dtypes and widths as `like`."""
    return dict(zip(like, ops.unpack_rows(packed, list(like.values())), strict=True))


class Arrival:
    """Rows in transit."""

    def __init__(self, pending: Pending, like: Mapping[str, Tensor]) -> None:
        self._pending = pending
        self._like = like

    def wait(self) -> Columns:
        """The received rows, ordered by source rank, then as sent."""
        return unpack(self.wait_packed(), self._like)

    def wait_packed(self) -> Tensor:
        """The received rows as packed by `pack`: (R, bytes) uint8."""
        return self._pending.wait()


@dataclass(frozen=True)
class Route:
    """The rows sent to each rank, agreed once and used for any number of exchanges."""

    comm: Comm
    rows: Tensor  #: (K,) int64: rows to send, ordered by destination
    sent: list[int]  #: number of rows sent to each rank
    received: list[int]  #: number of rows received from each rank

    @property
    def source(self) -> Tensor:
        """(R,) int64: source rank of each received row."""
        device = self.rows.device
        counts = torch.tensor(self.received).to(device, non_blocking=True)
        ranks = torch.arange(len(self.received), device=device)
        return torch.repeat_interleave(ranks, counts, output_size=sum(self.received))

    def forward(self, columns: Mapping[str, Tensor]) -> Arrival:
        """Sends `rows` of the columns."""
        return Arrival(self.comm.exchange(pack(columns, self.rows), self.sent, self.received), columns)

    def back(self, columns: Mapping[str, Tensor]) -> Arrival:
        """Sends one row back for each received row; they arrive in the order of `rows`."""
        everything = torch.arange(sum(self.received), device=self.rows.device)
        return Arrival(self.comm.exchange(pack(columns, everything), self.received, self.sent), columns)


def make_route(comm: Comm, rows: Tensor, destination: Tensor) -> Route:
    """A route that sends each of the rows (K,) to its destination (K,); a row may occur several times."""
    order = torch.argsort(destination, stable=True)
    # Not bincount, which synchronises to read the largest value.
    counts = destination.new_zeros(comm.size).scatter_add_(0, destination, torch.ones_like(destination))
    sent, received = torch.stack([counts, comm.exchange_counts(counts)]).tolist()
    return Route(comm, rows[order], sent, received)


def replace_rows(columns: Mapping[str, Tensor], removed: Tensor, added: Tensor) -> Columns:
    """Removes rows and inserts others, in ascending order of id. Copies each row once; does not synchronise.

    Args:
        columns: the first column is the ids (N,) int64, ascending.
        removed: (L,) int64 rows, ascending.
        added: packed rows of the same columns, in any order.
    """
    if not len(removed) and not len(added):
        return dict(columns)
    return dict(zip(columns, ops.merge_rows(list(columns.values()), removed, added), strict=True))


def take_rows(columns: Mapping[str, Tensor], rows: Tensor) -> Columns:
    """The rows (K,) int64 of all columns."""
    return dict(zip(columns, ops.take_rows(list(columns.values()), [], rows), strict=True))
