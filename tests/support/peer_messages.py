"""Messages between peers over any connection, in place of GPUs that write each other's memory."""

from __future__ import annotations

import torch
from torch import Tensor

from pgccd import ops
from pgccd.distributed import Comm
from pgccd.distributed.comm.peer_memory import RowsOfRanks


class OverConnection:
    """`PeerMessages` sent by a connection. Counts the calls."""

    def __init__(self, comm: Comm) -> None:
        self._comm, self.calls = comm, 0

    def gather(self, values: Tensor) -> Tensor:
        self.calls += 1
        return self._comm.all_gather(values)

    def lower(
        self,
        values: Tensor,
        sent: RowsOfRanks,
        received: RowsOfRanks,
        found: Tensor | None = None,
        anywhere: Tensor | None = None,
    ) -> None:
        self.calls += 1
        if found is not None and anywhere is not None:
            anywhere |= (self._comm.all_gather(found) != 0).any()
        padded = torch.cat([values, values.new_full((1,), torch.inf)])
        to_send, to_lower = (torch.where(rows < 0, len(values), rows) for rows in (sent.rows, received.rows))
        rows = ops.pack_rows([padded], to_send)
        arrived = self._comm.exchange(rows, list(sent.counts), list(received.counts)).wait()
        padded.scatter_reduce_(0, to_lower, arrived.view(values.dtype)[:, 0], "amin")
        values.copy_(padded[:-1])
