"""Memory of each rank's GPU that the GPUs of all ranks write, for small messages within CUDA graphs.

A kernel writes its message into the memory of the other GPUs and waits for theirs. A message takes 4 us, with NCCL 16
us (two H100 linked by NVLink).
"""

from __future__ import annotations

import os
import weakref
from collections.abc import Sequence
from typing import NamedTuple, Protocol

import torch
from torch import Tensor

from pgccd import ops

# As in csrc/kernels/peers/peers.h.
_FLAG_BYTES = 256
# The smallest size of the largest message: graphs with slightly larger ones need no new memory.
_FEWEST_BYTES = 1 << 16
# The `stop` words, kept because kernels may still read them.
_words: list[Tensor] = []


class RowsOfRanks(NamedTuple):
    """Rows sent to each rank, or received from it."""

    rows: Tensor  #: (S,) int64, ordered by rank; -1 for padding
    counts: Sequence[int]  #: number of rows per rank


class PeerMessages(Protocol):
    """Small messages between all ranks. All ranks make the same calls, in the same order on one stream."""

    def gather(self, values: Tensor) -> Tensor:
        """values (k,) int64 -> (ranks, k): those of every rank."""
        ...

    def lower(
        self,
        values: Tensor,
        sent: RowsOfRanks,
        received: RowsOfRanks,
        found: Tensor | None = None,
        anywhere: Tensor | None = None,
    ) -> None:
        """Sends rows of values (N,) float64 >= 0, and lowers others to what arrives. Sets `anywhere` (1,) int64 to 1 if
        `found` (1,) int64 is nonzero on any rank.
        """
        ...


class PeerMemory:
    """The `PeerMessages` of GPUs that write each other's memory. Must exist as long as a graph with its messages.

    Args:
        memory: (size_of_memory(ranks, bytes),) uint8, zero, for messages of up to `bytes`.
        addresses: of the memory of each rank in this process.
        rank: this one.
    """

    def __init__(self, memory: Tensor, addresses: Sequence[int], rank: int) -> None:
        stop = torch.zeros(1, dtype=torch.int64, pin_memory=memory.is_cuda)
        _words.append(stop)
        self._where = memory, torch.tensor(addresses, device=memory.device), stop.data_ptr(), rank
        self._stop = weakref.finalize(self, _set_in, os.getpid(), stop)
        self.device = memory.device
        #: Size of the largest message between two ranks.
        self.bytes = (len(memory) // len(addresses) - _FLAG_BYTES) // 2

    def gather(self, values: Tensor) -> Tensor:
        return ops.peer_gather(values, *self._where)

    def lower(
        self,
        values: Tensor,
        sent: RowsOfRanks,
        received: RowsOfRanks,
        found: Tensor | None = None,
        anywhere: Tensor | None = None,
    ) -> None:
        ops.peer_minimum(values, sent.rows, sent.counts, received.rows, received.counts, found, anywhere, *self._where)

    def stop(self) -> None:
        """From now on kernels give up messages that have not arrived; then the rank sends none either. Also called at
        exit, where the process would wait for its GPU.
        """
        self._stop()


def _set_in(process: int, stop: Tensor) -> None:
    # A forked child, which inherits objects to finalise, shares pinned memory with its parent.
    if os.getpid() == process:
        stop.fill_(1)


def size_of(bytes: int) -> int:
    """The size of the largest message for which to reserve memory, given the largest one of a graph."""
    return max(_FEWEST_BYTES, 1 << (bytes - 1).bit_length())


def size_of_memory(ranks: int, bytes: int) -> int:
    """Bytes of memory on each rank, given the size of the largest message."""
    return ranks * (_FLAG_BYTES + 2 * bytes)
