"""Memory of each rank's GPU that the GPUs of all ranks write, for small messages within CUDA graphs.

A kernel writes its message into the memory of the other GPUs and waits for theirs; so a message takes 4 us, and one of
NCCL 16 us (two H100 linked by NVLink).
"""

from __future__ import annotations

import os
import socket
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple, Protocol

import torch
import torch.distributed as dist
from torch import Tensor

from pgccd import ops
from pgccd.runtime.environment import environment

# As in csrc/kernels/peers/peers.h.
_FLAG_BYTES, _MOST_RANKS = 256, 16
# The smallest size of the largest message: graphs with slightly larger ones need no new memory.
_FEWEST_BYTES = 1 << 16
_SETTING = "PGCCD_PEER_MEMORY"
# Torch's own setting, for tests.
_MAY_SHARE_GPU = "TORCH_SYMM_MEM_ALLOW_OVERLAPPING_DEVICES"
_WITHOUT_MULTICAST = {"TORCH_SYMM_MEM_DISABLE_MULTICAST": "1"}  # not needed
_BOOT_ID = Path("/proc/sys/kernel/random/boot_id")


class RowsOfRanks(NamedTuple):
    """Rows sent to each rank, or received from it."""

    rows: Tensor  #: (S,) int64, ordered by rank; -1 for padding
    counts: Sequence[int]  #: number of rows per rank


class PeerMessages(Protocol):
    """Small messages between all ranks. All ranks make the same calls, in the same order on one stream."""

    def gather(self, values: Tensor) -> Tensor:
        """values (k,) int64 -> (ranks, k): those of every rank."""
        ...

    def lower(self, values: Tensor, sent: RowsOfRanks, received: RowsOfRanks) -> None:
        """Sends rows of values (N,) float64 >= 0, and lowers others to what arrives."""
        ...


class PeerMemory:
    """The `PeerMessages` of GPUs that write each other's memory. Must exist as long as a graph with its messages.

    Args:
        memory: (ranks * (256 + 2 * bytes),) uint8, zero, for messages of up to `bytes`.
        addresses: of the memory of each rank in this process.
        rank: this one.
        kept: what the addresses depend on.
    """

    def __init__(self, memory: Tensor, addresses: Sequence[int], rank: int, kept: Any = None) -> None:
        self._where = memory, torch.tensor(addresses, device=memory.device), rank
        self._kept = kept
        #: Size of the largest message between two ranks.
        self.bytes = (len(memory) // len(addresses) - _FLAG_BYTES) // 2

    def gather(self, values: Tensor) -> Tensor:
        return ops.peer_gather(values, *self._where)

    def lower(self, values: Tensor, sent: RowsOfRanks, received: RowsOfRanks) -> None:
        ops.peer_minimum(values, sent.rows, sent.counts, received.rows, received.counts, *self._where)


#: A host and a GPU.
Place = tuple[str, str]


def place_of_gpu() -> Place | None:
    """The host and the GPU of this rank; None if other GPUs shall not write its memory."""
    if os.environ.get(_SETTING) != "1" or not _BOOT_ID.exists():
        return None
    device = torch.cuda.current_device()
    may_share = os.environ.get(_MAY_SHARE_GPU) == "1"
    gpu = f"rank {dist.get_rank()}" if may_share else str(torch.cuda.get_device_properties(device).uuid)
    return f"{socket.gethostname()} {_BOOT_ID.read_text().strip()}", gpu


def are_peers(places: Sequence[Place | None]) -> bool:
    """Whether the ranks, given the `place_of_gpu` of each, are on one host and have a GPU each."""
    if len(places) > _MOST_RANKS or None in places:
        return False
    hosts, gpus = zip(*(place for place in places if place is not None), strict=True)
    return len(set(hosts)) == 1 and len(set(gpus)) == len(gpus)


def size_of(bytes: int) -> int:
    """The size of the largest message for which to reserve memory, given the largest one of a graph."""
    return max(_FEWEST_BYTES, 1 << (bytes - 1).bit_length())


def map_peer_memory(group: dist.ProcessGroup, bytes: int) -> PeerMemory:
    """Reserves memory for messages of up to `bytes` between two ranks of the group. All ranks call it, and must
    exchange a message before they use it.

    Raises:
        RuntimeError: a GPU cannot access the memory of another one.
    """
    import torch.distributed._symmetric_memory as symmetric_memory

    size = dist.get_world_size(group) * (_FLAG_BYTES + 2 * bytes)
    with environment(_WITHOUT_MULTICAST):
        memory = symmetric_memory.empty(size, dtype=torch.uint8, device=torch.device("cuda")).zero_()
        handle = symmetric_memory.rendezvous(memory, group)
    torch.cuda.synchronize()
    return PeerMemory(memory, handle.buffer_ptrs, handle.rank, handle)
