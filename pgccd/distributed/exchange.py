"""Rows of columns on their way between ranks: packed into bytes, one message to each rank."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from math import prod

import torch
from torch import Tensor

from pgccd.distributed.comm import Comm, Pending

Columns = dict[str, Tensor]


def pack(columns: Mapping[str, Tensor], rows: Tensor) -> Tensor:
    """(K, bytes) uint8: the rows (K,) of all columns side by side."""
    parts = []
    for column in columns.values():
        chosen = column[rows].contiguous()
        parts.append(chosen.view(len(rows), prod(column.shape[1:])).view(torch.uint8))
    return torch.cat(parts, dim=1)


def unpack(packed: Tensor, like: Mapping[str, Tensor]) -> Columns:
    """The reverse of `pack`, for columns of the same names, dtypes and widths as `like`."""
    columns, begin = {}, 0
    for name, column in like.items():
        width = prod(column.shape[1:]) * column.element_size()
        shape = (len(packed), *column.shape[1:])
        part = packed[:, begin : begin + width].clone(memory_format=torch.contiguous_format)
        columns[name] = part.view(column.dtype).view(shape) if width else column.new_empty(shape)
        begin += width
    return columns


class Arrival:
    """Rows under way."""

    def __init__(self, pending: Pending, like: Mapping[str, Tensor]) -> None:
        self._pending = pending
        self._like = like

    def wait(self) -> Columns:
        """The rows received: by source, in the order in which each source sent them."""
        return unpack(self._pending.wait(), self._like)


@dataclass(frozen=True)
class Route:
    """Who sends which rows to whom, agreed once for any number of exchanges."""

    comm: Comm
    rows: Tensor  #: (K,) int64 rows sent, by destination
    sent: list[int]  #: how many to each rank
    received: list[int]  #: how many from each rank

    @property
    def source(self) -> Tensor:
        """(R,) int64: where each row received came from."""
        counts = torch.tensor(self.received)
        return torch.repeat_interleave(torch.arange(len(counts)), counts).to(self.rows.device)

    def forward(self, columns: Mapping[str, Tensor]) -> Arrival:
        """Sends `rows` of the columns."""
        return Arrival(self.comm.exchange(pack(columns, self.rows), self.sent, self.received), columns)

    def back(self, columns: Mapping[str, Tensor]) -> Arrival:
        """Sends a row for each row received to where that came from; they arrive in the order of `rows`."""
        everything = torch.arange(sum(self.received), device=self.rows.device)
        return Arrival(self.comm.exchange(pack(columns, everything), self.received, self.sent), columns)


def make_route(comm: Comm, rows: Tensor, destination: Tensor) -> Route:
    """A route that takes each of the rows (K,) to its destination (K,); a row may go to several."""
    order = torch.argsort(destination, stable=True)
    counts = torch.bincount(destination, minlength=comm.size)
    sent, received = torch.stack([counts, comm.exchange_counts(counts)]).tolist()
    return Route(comm, rows[order], sent, received)


def merged_rows(id: Tensor, more: Tensor) -> tuple[Tensor, Tensor]:
    """Where rows go when columns with ids (N,), ascending, and (M,), in any order, are merged into ascending order.

    Cheaper than sorting when the second ones are few.
    """
    order = torch.argsort(more)
    at = torch.searchsorted(id, more[order]) + torch.arange(len(more), device=more.device)
    is_first = torch.ones(len(id) + len(more), dtype=torch.bool, device=id.device)
    is_first[at] = False
    row_of_more = torch.empty_like(at)
    row_of_more[order] = at
    return torch.nonzero(is_first)[:, 0], row_of_more


def merge_columns(first: Columns, second: Columns, rows: tuple[Tensor, Tensor]) -> Columns:
    """Both, at the rows that `merged_rows` says."""
    merged = {}
    for name, column in first.items():
        merged[name] = column.new_empty((len(rows[0]) + len(rows[1]), *column.shape[1:]))
        merged[name][rows[0]] = column
        merged[name][rows[1]] = second[name]
    return merged


def take_rows(columns: Mapping[str, Tensor], rows: Tensor) -> Columns:
    """The rows of all columns."""
    return {name: column[rows] for name, column in columns.items()}
