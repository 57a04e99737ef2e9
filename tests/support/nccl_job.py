"""The Gloo tests over NCCL: run by torchrun, with what to test ("scenes" or "robots"), the number of steps for which
worlds of robots are simulated, and "peers" if GPUs shall write small messages to each other's memory.
"""

from __future__ import annotations

import sys
import tempfile
import warnings

import torch
from distributed.comm import test_exchange
from distributed.steps import test_rank
from distributed.world import test_captured_resolving, test_loop, test_loops, test_motions, test_world

from pgccd.distributed import Alone, Comm, choose_device, connect
from support.crowds import crowds


def test_scenes(comm: Comm, device: torch.device) -> None:
    """Messages, detection, and worlds."""
    for neighbours_above in (32, 0):
        test_exchange.send_about(comm, neighbours_above, str(device))
    test_exchange.reduce_values(comm)
    for name in crowds():
        for neighbours_above in (0, 32):
            test_world.find(comm, name, device, neighbours_above)
    for report in ("first", "all"):
        test_motions.deform(comm, report, device)
        test_motions.follow(comm, report, False, device)
    for partition in ("cells", "bisection"):
        alone = test_loop.plain_loop(test_loop.STEPS)
        assert test_loop.follow(comm, alone, "cost", partition, True, str(device), False)["replayed"] > 6
    for initial in ("report", "assume_free"):
        alone = test_captured_resolving.plain_loop(test_captured_resolving.STEPS, initial)
        assert test_captured_resolving.follow(comm, alone, initial, True, str(device))["replayed"] > 6
    with tempfile.TemporaryDirectory() as folder:
        expected, _ = test_loops.follow(Alone(), test_loops.PAGE, folder)
        found, replayed = test_loops.follow(comm, test_loops.PAGE, comm.broadcast_object(folder), True, "cuda")
        comm.barrier()  # rank 0 removes the folder of all
    assert found == expected and replayed > 10


def test_robots(comm: Comm, device: torch.device, steps: int) -> None:
    """Worlds of robots."""
    assert test_rank.follow_not_captured(comm, test_rank.single_run("random", 12), str(device))["replayed"] == 0
    # With cells assigned at random, and a rank whose capacity overflows now and then.
    seen = test_rank.follow(
        comm, test_rank.single_run("random", steps), "random", "none", True, True, str(device), True
    )
    assert seen["contacts"] > 100 and seen["arrived"] > 20
    # With messages to all ranks, and between neighbours only, as for many ranks.
    for neighbours_above in (32, 0):
        comm.neighbours_above = neighbours_above
        alone = test_rank.single_run("skewed", steps)
        seen = test_rank.follow_bisected(comm, alone, "skewed", "cost", True, str(device))
        assert seen["contacts"] > 100


torch.set_num_threads(1)
warnings.filterwarnings("error", message="steps run without a CUDA graph")
what, steps, *peers = sys.argv[1:]
with connect("cuda", "nccl") as comm:
    device = choose_device("cuda")
    if what == "scenes":
        test_scenes(comm, device)
    else:
        test_robots(comm, device, int(steps))
    assert (comm.peer_messages is not None) == (peers == ["peers"])
