"""The Gloo tests over MPI: run by mpirun. Each rank writes a file on success."""

from __future__ import annotations

import sys
from pathlib import Path

import torch
from baselines import test_pcccd
from distributed.comm import test_exchange
from distributed.steps import test_rank
from distributed.world import test_motions, test_payload, test_population, test_resolve, test_world

from pgccd.distributed import MpiComm
from support.random_scenes import random_scene
from support.resolving_ranks import of_rank, resolve_scenes
from support.same_bits import difference

torch.set_num_threads(1)
comm = MpiComm()
for neighbours_above in (32, 0):
    test_exchange.send_about(comm, neighbours_above)
test_exchange.reduce_values(comm)
for neighbours_above in (0, 32):
    test_world.find(comm, "on corners of many cells", neighbours_above=neighbours_above)
test_motions.deform(comm, "all")
test_motions.follow(comm, "earliest", True)
test_pcccd.compare(comm, "on corners of many cells")
test_rank.follow(comm, "random", "cost", 12, True, True)
for seed, (own, found, _) in enumerate(resolve_scenes(comm, range(8), "cpu")):
    scene = random_scene(seed)
    rows = scene.rows_of(own) if scene.kind.startswith("deforming") else None
    said = difference(found, of_rank(test_resolve.alone(seed)[0], own, rows))
    assert said is None, f"{scene}: {said}"
test_payload.ask(comm, next(iter(test_payload.CROWDS)))
test_population.join_and_leave(comm)
comm.close()
Path(sys.argv[1], f"rank-{comm.rank}").touch()
