"""A run in which one rank fails in step 3.

Command line: kind of failure, device, timeout in seconds; and how many seconds a busy rank is busy.
"""

from __future__ import annotations

import ctypes
import os
import signal
import sys
import threading

import torch

from pgccd import sim
from pgccd.distributed import Cells, choose_device, connect, guard
from pgccd.sim import Simulation, starting_share

RANK, STEP = 1, 3
BUSY_SECONDS = 4 if len(sys.argv) < 5 else int(sys.argv[4])
guard.guard._GRACE_SECONDS = 2.0  # shortens the test


def main(fault: str, kind: str, timeout: float) -> None:
    with connect(kind, "nccl" if kind == "cuda" else "gloo", timeout=timeout) as comm:
        device = choose_device(kind)
        model = sim.Model(sim.ModelConfig(robots=64), device=device)
        upper = model.half_extent
        partition = Cells.uniform(tuple(-x for x in upper), upper, comm.size, cells=2, device=device)
        simulation = Simulation.create(comm, model, partition, starting_share(comm, model))
        for index in range(10):
            if comm.rank == RANK and index == STEP:
                if fault == "dies":
                    os.kill(os.getpid(), signal.SIGKILL)
                if fault == "hangs":
                    threading.Event().wait()
                if fault == "stops":
                    os.kill(os.getpid(), signal.SIGSTOP)
                if fault == "busy":  # holds the interpreter lock, so no other Python thread runs
                    ctypes.PyDLL(None).sleep(BUSY_SECONDS)
                if fault == "memory":
                    raise torch.OutOfMemoryError("tried to allocate more than there is")
            simulation.step(index)


main(sys.argv[1], sys.argv[2], float(sys.argv[3]))
