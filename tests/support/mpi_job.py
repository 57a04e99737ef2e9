"""The Gloo tests over MPI: run by mpirun. Each rank writes a file on success."""

from __future__ import annotations

import sys
from pathlib import Path

import torch
from distributed import test_detection, test_distributed_simulation, test_exchange, test_motions, test_pcccd

from pgccd.distributed import MpiComm

torch.set_num_threads(1)
comm = MpiComm()
for neighbours_above in (32, 0):
    test_exchange.send_about(comm, neighbours_above)
test_exchange.reduce_values(comm)
for neighbours_above in (0, 32):
    test_detection.find(comm, "on corners of many cells", neighbours_above=neighbours_above)
test_motions.deform(comm, "all")
test_motions.follow(comm, "earliest", True)
test_pcccd.compare(comm, "on corners of many cells")
test_distributed_simulation.follow(comm, "random", "cost", 12, True, True)
comm.close()
Path(sys.argv[1], f"rank-{comm.rank}").touch()
