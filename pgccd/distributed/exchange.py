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
        device = self.rows.device
        counts = torch.tensor(self.received).to(device, non_blocking=True)
        ranks = torch.arange(len(self.received), device=device)
        return torch.repeat_interleave(ranks, counts, output_size=sum(self.received))

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
    # Not bincount, which waits for a device to learn the largest value.
    counts = destination.new_zeros(comm.size).scatter_add_(0, destination, torch.ones_like(destination))
    sent, received = torch.stack([counts, comm.exchange_counts(counts)]).tolist()
    return Route(comm, rows[order], sent, received)


def replace_rows(columns: Columns, removed: Tensor, added: Columns) -> Columns:
    """Columns without some of their rows and with others, by ascending id. Each is copied once; nothing waits.

    Args:
        columns: "id" (N,) int64 among them, ascending.
        removed: (L,) int64 rows, ascending.
        added: the same columns of A rows in any order.
    """
    id, count = columns["id"], len(columns["id"])
    if not len(removed) and not len(added["id"]):
        return columns
    added = take_rows(added, torch.argsort(added["id"]))
    removed_id, more = id[removed], torch.arange(len(added["id"]), device=id.device)
    # Where added rows come to be, and where the row after a removed one does.
    at = torch.searchsorted(id, added["id"]) - torch.searchsorted(removed_id, added["id"]) + more
    after = removed - torch.arange(len(removed), device=id.device) + torch.searchsorted(added["id"], removed_id)
    kept = count - len(removed)
    shift = torch.zeros(kept + len(more) + 1, dtype=torch.int64, device=id.device)
    shift.index_add_(0, after, torch.ones_like(after)).index_add_(0, at + 1, -torch.ones_like(at))
    source = torch.arange(kept + len(more), device=id.device) + shift.cumsum(0)[:-1]
    source = source.clamp_(max=max(0, count - 1))  # places of added rows may point past the end
    changed = {}
    for name, column in columns.items():
        changed[name] = column.index_select(0, source) if count else column.new_empty((len(more), *column.shape[1:]))
        changed[name][at] = added[name]
    return changed


def take_rows(columns: Mapping[str, Tensor], rows: Tensor) -> Columns:
    """The rows of all columns."""
    return {name: column[rows] for name, column in columns.items()}
