"""A run of which one rank goes wrong in step 3, in the way named on the command line."""

from __future__ import annotations

import os
import signal
import sys
import threading

import torch

from pgccd import sim
from pgccd.distributed import Fleet, Partition, connect, guard, starting_share

RANK, STEP = 1, 3
# So that the test need not wait long.
guard._SILENCE_SECONDS, guard._GRACE_SECONDS = 2.5, 2.0


def main(fault: str) -> None:
    with connect(timeout=4.0) as comm:
        world = sim.World(sim.WorldConfig(robots=64))
        upper = world.half_extent
        partition = Partition.uniform(tuple(-x for x in upper), upper, comm.size, cells=2)
        fleet = Fleet(comm, world, partition, starting_share(comm, world, partition))
        for index in range(10):
            if comm.rank == RANK and index == STEP:
                if fault == "dies":
                    os.kill(os.getpid(), signal.SIGKILL)
                if fault == "hangs":
                    threading.Event().wait()
                if fault == "memory":
                    raise torch.OutOfMemoryError("tried to allocate more than there is")
            fleet.step(index)


main(sys.argv[1])
