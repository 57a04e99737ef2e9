"""Ranks in process groups that the user has made: the default one, and one of some of the ranks."""

from __future__ import annotations

import sys

import torch
import torch.distributed as dist

from pgccd.distributed import DisagreementError, connect

dist.init_process_group("gloo")
rank = dist.get_rank()
with connect(timeout=60.0) as comm:
    assert comm.rank == rank and comm.size == 3 and comm.guard.hub is None or rank == 0
    assert comm.sum(torch.tensor([1])).item() == 3
    comm.barrier()
assert dist.is_initialized()  # it remains the user's
some = dist.new_group([0, 2], backend="gloo")
if rank != 1:
    with connect(group=some, timeout=60.0) as comm:
        assert comm.size == 2 and comm.rank == rank // 2
        assert comm.all_gather(torch.tensor([rank])).tolist() == [[0], [2]]
        _ = comm.background
        comm.barrier()
for arguments, error in (
    ({"group": "world"}, "group: expected a process group of this process, got str"),
    ({"transport": "nccl"}, "transport: the group has backend 'gloo', got 'nccl'; leave it out"),
    ({"settings": {"--steps": str(rank)}}, "--steps: rank 0 has '0', rank 1 has '1'"),
):
    try:
        connect(**arguments)  # type: ignore[arg-type]
    except (TypeError, ValueError, DisagreementError) as found:
        assert str(found) == error, found
    else:
        raise AssertionError(arguments)
dist.barrier()
dist.destroy_process_group()
sys.stdout.write(f"rank {rank} is done\n")
