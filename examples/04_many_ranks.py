"""
Many bodies on 1 and 4 ranks
============================

A thousand tumbling boxes in a loop of your own, distributed over ranks: processes with one GPU or some CPU cores each.
The same program runs on any number of ranks, and its results are equal to the last bit:

.. code-block:: sh

    python examples/04_many_ranks.py
    torchrun --nproc-per-node 4 examples/04_many_ranks.py        # add "cuda" for one GPU per rank

Without a launcher the program below runs on one rank, and then starts itself again on four ranks on this machine's CPU,
which talk through Gloo, so that you can compare the lines.
"""

import hashlib
import os
import subprocess
import sys
import tempfile

import matplotlib.pyplot as plt
import numpy as np
import torch

import pgccd
from pgccd import distributed

name = sys.argv[1] if len(sys.argv) > 1 else "cpu"
box = pgccd.Mesh.box([1.0, 0.6, 0.3])

# %%
# `distributed.connect` connects the ranks that were launched together; one process alone is one rank. Each rank passes
# any share of the bodies to `World.create`, which sends them to their owners: each rank owns a part of space. What a
# body carries besides its position is its payload. It migrates with the body.


def create_world(comm: distributed.Comm) -> distributed.World:
    torch.manual_seed(0)
    position = 1.5 * torch.cartesian_prod(*[torch.arange(10.0, dtype=torch.float64)] * 3)
    orientation = torch.nn.functional.normalize(torch.randn(1000, 4, dtype=torch.float64))
    velocity, spin = torch.randn(2, 1000, 3, dtype=torch.float64)
    share, device = torch.arange(1000)[comm.rank :: comm.size], distributed.choose_device(name)
    columns = {"orientation": orientation, "velocity": velocity, "spin": spin}
    return distributed.World.create(
        pgccd.Scene([box], torch.zeros_like(share), device),
        position[share].to(device),
        (0.0, 0.0, 0.0),
        (13.5, 13.5, 13.5),
        id=share.to(device),
        payload={key: column[share].to(device) for key, column in columns.items()},
        comm=comm,
    )


# %%
# The loop. With ``resolve=True`` `World.step` says how far each body of this rank can move such that no two meet,
# wherever they live; a body that would meet another stops before it, and turns round. `World.move` writes the new state
# and migrates bodies that have left this rank's part of space.

with distributed.connect(name) as comm:
    world = create_world(comm)
    for step in range(20):
        mine = world.payload  # of the bodies that this rank owns now
        motion = pgccd.RigidMotion.from_velocity(
            world.position, mine["orientation"], mine["velocity"], mine["spin"], dt=0.1
        )
        resolved = world.step(motion, resolve=True)
        position, orientation = resolved.motion.at(1.0)  # where the bodies are after the step
        stopped = resolved.fraction < 1.0
        sign = torch.where(stopped, -1.0, 1.0)[:, None]
        world.move(position, orientation=orientation, velocity=sign * mine["velocity"], spin=sign * mine["spin"])
        turned = int(comm.sum(stopped.sum()[None]))
        if comm.rank == 0 and step % 5 == 4:
            at = f"{comm.size} ranks, step {step:2d}, {resolved.rounds} rounds"
            print(f"{at}: {turned} bodies turn; rank 0 owns {len(world.id)}")

    # Every rank adds its rows to a table by id, so that all hold the positions of all bodies.
    position = world.position.new_zeros(1000, 3)
    position[world.id] = world.position
    owner = world.id.new_zeros(1000)
    owner[world.id] = comm.rank
    position, owner = comm.sum(position).cpu(), comm.sum(owner).cpu()
    rank, ranks = comm.rank, comm.size

# %%
# The hash covers every bit of all positions. It is the same on one rank and on four. The picture shows which of four
# ranks owns each body.

digest = hashlib.sha256(position.numpy().tobytes()).hexdigest()[:16]
if rank == 0:
    print(f"{ranks} ranks: positions {digest}")
if rank == 0 and len(sys.argv) > 2:
    np.save(sys.argv[2], owner)

if distributed.find_placement().launcher == "none" and name == "cpu":
    with tempfile.TemporaryDirectory() as folder:
        program = [sys.argv[0], "cpu", f"{folder}/owners.npy"]
        command = [sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc-per-node", "4", *program]
        one_thread = os.environ | {"OMP_NUM_THREADS": "1"}
        done = subprocess.run(command, env=one_thread, stdout=subprocess.PIPE, text=True, check=True)
        owner_of_four = np.load(f"{folder}/owners.npy")
    print(done.stdout)
    assert digest in done.stdout, "four ranks gave other positions than one"

    figure = plt.figure(figsize=(6.5, 5.5))
    axes = figure.add_subplot(projection="3d")
    axes.scatter(*position.T, c=owner_of_four, cmap="tab10", vmin=0, vmax=9, s=10)
    axes.set(xlabel="x", ylabel="y", zlabel="z", title="owner of each body on 4 ranks")
    plt.show()
