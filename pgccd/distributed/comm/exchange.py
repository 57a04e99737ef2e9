"""Exchange of rows of columns between ranks: packed into bytes, so that one message per rank carries all columns of any
dtypes. torch.distributed and MPI send one tensor per message.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import torch
from torch import Tensor

from pgccd import ops
from pgccd.distributed.comm.interface import Comm, Pending
from pgccd.distributed.comm.neighbourhood import Neighbourhood

Columns = dict[str, Tensor]


def pack(columns: Mapping[str, Tensor], rows: Tensor) -> Tensor:
    """(K, bytes) uint8: the rows (K,) of all columns, concatenated in the order of the columns."""
    return ops.pack_rows(list(columns.values()), rows)


def unpack(packed: Tensor, like: Mapping[str, Tensor]) -> Columns:
    """The inverse of `pack`, for columns of the same names, dtypes and widths as `like`."""
    return dict(zip(like, ops.unpack_rows(packed, list(like.values())), strict=True))


@dataclass(frozen=True)
class Route:
    """The rows sent to each rank, agreed once and used for any number of exchanges."""

    neighbours: Neighbourhood
    rows: Tensor  #: (K,) int64: rows to send, ordered by destination
    sent: list[int]  #: number of rows sent to each destination, numbered as in `neighbours`
    received: list[int]  #: number of rows received from each

    @property
    def source(self) -> Tensor:
        """(R,) int64: number of the source of each received row."""
        device = self.rows.device
        counts = torch.tensor(self.received).to(device, non_blocking=True)
        ranks = torch.arange(len(self.received), device=device)
        return torch.repeat_interleave(ranks, counts, output_size=sum(self.received))

    def send(self, columns: Mapping[str, Tensor]) -> Pending[Tensor]:
        """Sends `rows` of the columns. The received rows are packed as by `pack`, ordered by source, then as sent."""
        return self.neighbours.exchange(pack(columns, self.rows), self.sent, self.received)

    def forward(self, columns: Mapping[str, Tensor]) -> Pending[Columns]:
        """Sends `rows` of the columns. The received rows are ordered by source, then as sent."""
        packed = self.send(columns)
        return Pending(lambda: unpack(packed.wait(), columns))

    def back(self, columns: Mapping[str, Tensor]) -> Pending[Columns]:
        """Sends one row back for each received row; they arrive in the order of `rows`."""
        everything = torch.arange(sum(self.received), device=self.rows.device)
        packed = self.neighbours.exchange(pack(columns, everything), self.received, self.sent)
        return Pending(lambda: unpack(packed.wait(), columns))


def make_route(among: Comm | Neighbourhood, rows: Tensor, destination: Tensor) -> Route:
    """A route that sends each of the rows (K,) to its destination (K,); a row may occur several times.

    Args:
        among: all ranks; or neighbours, by whose numbers destinations are given.
        rows, destination: int64.
    """
    neighbours = among if isinstance(among, Neighbourhood) else Neighbourhood(among)
    order = torch.argsort(destination, stable=True)
    # Not bincount, which synchronises to read the largest value.
    counts = destination.new_zeros(neighbours.size).scatter_add_(0, destination, torch.ones_like(destination))
    return Route(neighbours, rows[order], *neighbours.agree(counts))


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


def first_row(comm: Comm, order: Tensor, columns: Mapping[str, Tensor]) -> Columns:
    """The first by `order` of the rows of all ranks, each of which has one row or none; on all ranks. No rows if no
    rank has one.

    Args:
        comm: between the ranks.
        order: (1, k) or (0, k) int64, compared from left to right; differs between ranks.
        columns: (1, ...) or (0, ...).
    """
    last = torch.iinfo(torch.int64).max
    has_first = len(order) > 0
    for value in order[0].tolist() if has_first else [last] * order.shape[1]:
        mine = value if has_first else last
        has_first &= mine == int(comm.min(torch.tensor([mine])))
    rows = torch.zeros(int(has_first), dtype=torch.int64, device=order.device)
    packed = pack(columns, rows)
    width = packed.shape[1]
    # The sum of the row of one rank and of zeros.
    message = packed.new_zeros(8 * (1 + -(-width // 8)))
    if has_first:
        message[0], message[8 : 8 + width] = 1, packed[0]
    message = comm.sum(message.view(torch.int64)).view(torch.uint8)
    return unpack(message[8 : 8 + width].expand(int(message[0]), width).contiguous(), columns)
