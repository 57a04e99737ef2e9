"""Messages that GPUs write to each other's memory: run by torchrun."""

from __future__ import annotations

import time
import warnings

import torch
from distributed.comm import test_peer_memory

from pgccd.distributed import connect
from pgccd.distributed.comm.peer_memory import PeerMemory

warnings.filterwarnings("error", message="NCCL sends small messages")
with connect("cuda", "nccl") as comm:
    comm.reserve_peer_messages(test_peer_memory.BYTES)
    assert isinstance(comm.peer_messages, PeerMemory)
    test_peer_memory.gather_many(comm, comm.peer_messages)
    test_peer_memory.lower_shared(comm, comm.peer_messages)
    # A rank that leaves earlier waits for the last message.
    time.sleep(2.0 * comm.rank)
    last = comm.peer_messages.gather(torch.tensor([5 + comm.rank], device="cuda"))
    ranks = comm.size
assert last.flatten().tolist() == list(range(5, 5 + ranks))
