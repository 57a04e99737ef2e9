"""Bodies change hands: whoever's centre has come to a cell of another rank moves there, with everything it has."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import torch
from torch import Tensor

from pgccd.distributed.comm import Comm
from pgccd.distributed.exchange import Columns, make_route, merge_columns, merged_rows, take_rows
from pgccd.distributed.partition import Partition
from pgccd.sim.hashing import id_hash

# Ids made at a time.
_BLOCK = 1 << 22


def migrate(comm: Comm, partition: Partition, columns: Mapping[str, Tensor], position: Tensor) -> tuple[Columns, int]:
    """Sends every body to the owner of the cell that holds its centre.

    Args:
        comm: between the ranks.
        partition: the same on all of them.
        columns: of this rank's bodies, "id" (N,) int64 among them, ascending. Any dtypes and widths, alike on all
            ranks.
        position: (N, 3) centres.

    Returns:
        The columns of the bodies this rank owns now, by ascending id; and how many came from others.

    Example:
        >>> columns, arrived = migrate(comm, partition, {"id": id, "position": x, "mood": mood}, x)
    """
    owner = partition.owner_of(position)
    leaves = owner != comm.rank
    leaving, staying = torch.nonzero(leaves)[:, 0], torch.nonzero(~leaves)[:, 0]
    arrived = make_route(comm, leaving, owner[leaving]).forward(columns).wait()
    kept = take_rows(columns, staying)
    rows = merged_rows(kept["id"], arrived["id"])
    return merge_columns(kept, arrived, rows), len(arrived["id"])


@dataclass(frozen=True)
class Census:
    """How many bodies there are, and an order-independent hash of their ids: what migration must conserve."""

    count: int
    ids: int  #: modulo 2^64

    @classmethod
    def of(cls, id: Tensor) -> Census:
        """Of one rank's bodies (N,) int64."""
        return cls(len(id), id_hash(id))

    @classmethod
    def of_range(cls, count: int) -> Census:
        """Of the ids 0 to count - 1."""
        begins = range(0, count, _BLOCK)
        return cls.total([cls.of(torch.arange(begin, min(count, begin + _BLOCK))) for begin in begins])

    @classmethod
    def total(cls, parts: list[Census]) -> Census:
        """Of all ranks' bodies."""
        return cls(sum(part.count for part in parts), sum(part.ids for part in parts) % 2**64)

    def require(self, expected: Census) -> None:
        """
        Raises:
            RuntimeError: bodies were lost or doubled on the way between ranks.
        """
        if self != expected:
            raise RuntimeError(
                f"migration: expected {expected.count} bodies with id hash {expected.ids:016x}, "
                f"there are {self.count} with {self.ids:016x}"
            )
