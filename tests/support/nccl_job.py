"""The Gloo tests over NCCL: run by torchrun, with the number of steps for which a world of robots is simulated."""

from __future__ import annotations

import sys
import warnings

import torch
from distributed import test_captured_world, test_detection, test_distributed_simulation, test_exchange, test_motions

from pgccd.distributed import choose_device, connect
from support.crowds import crowds

torch.set_num_threads(1)
warnings.filterwarnings("error", message="steps run without a CUDA graph")
with connect("cuda", "nccl") as comm:
    device = choose_device("cuda")
    for neighbours_above in (32, 0):
        test_exchange.send_about(comm, neighbours_above, str(device))
    test_exchange.reduce_values(comm)
    for name in crowds():
        for neighbours_above in (0, 32):
            test_detection.find(comm, name, device, neighbours_above)
    for report in ("first", "all"):
        test_motions.deform(comm, report, device)
        test_motions.follow(comm, report, False, device)
    for partition in ("cells", "bisection"):
        assert test_captured_world.follow(comm, "cost", partition, True, str(device), False)["replayed"] > 6
    assert test_distributed_simulation.follow_not_captured(comm, str(device))["replayed"] == 0
    # With cells assigned at random, and a rank whose capacity overflows now and then.
    seen = test_distributed_simulation.follow(comm, "random", "none", int(sys.argv[1]), True, True, str(device), True)
    assert seen["contacts"] > 100 and seen["arrived"] > 20
    seen = test_distributed_simulation.follow_bisected(comm, "skewed", "cost", int(sys.argv[1]), True, str(device))
    assert seen["contacts"] > 100
    # With messages between neighbours only, as for many ranks.
    comm.neighbours_above = 0
    seen = test_distributed_simulation.follow_bisected(comm, "skewed", "cost", int(sys.argv[1]), True, str(device))
    assert seen["contacts"] > 100
