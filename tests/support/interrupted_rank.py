"""Rank 1 is interrupted while its GPU waits for a message that rank 0 has not sent, and for one of NCCL after it.

python interrupted_rank.py SECONDS: rank 0 sends both after this time; then it waits for rank 1.
"""

from __future__ import annotations

import sys
import time
import warnings

import torch
import torch.distributed as dist

from pgccd.distributed import connect

warnings.filterwarnings("error", message="NCCL sends small messages")
with connect("cuda", "nccl", timeout=100.0) as comm:
    comm.reserve_peer_messages(64)
    peers = comm.peer_messages
    assert peers is not None
    values = torch.arange(8, device="cuda")
    peers.gather(values)
    torch.cuda.synchronize()
    comm.barrier()
    gathered = values.new_empty(len(values) * comm.size)
    if comm.rank == 1:
        peers.gather(values)
        dist.all_gather_into_tensor(gathered, values)
        raise KeyboardInterrupt
    time.sleep(float(sys.argv[1]))
    with comm.guard.waiting("message"):
        for name in ("second", "third"):
            peers.gather(values)
            dist.all_gather_into_tensor(gathered, values)
            torch.cuda.synchronize()
            sys.stdout.write(f"the {name} message has arrived\n")
            sys.stdout.flush()
