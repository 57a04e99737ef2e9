"""A thousand tumbling boxes on several ranks, in a user's own loop. Results are bitwise equal for any number of ranks:

python examples/04_many_ranks.py
torchrun --nproc-per-node 2 examples/04_many_ranks.py        (add "cuda" for one GPU per rank)
"""

import sys

import torch
import trimesh

import pgccd
from pgccd import distributed

with distributed.connect(sys.argv[1] if len(sys.argv) > 1 else "cpu") as comm:
    device = distributed.choose_device(sys.argv[1] if len(sys.argv) > 1 else "cpu")
    box = pgccd.Mesh.from_trimesh(trimesh.creation.box((1.0, 0.6, 0.3)).subdivide())

    torch.manual_seed(0)
    position = 1.5 * torch.cartesian_prod(*[torch.arange(10.0, dtype=torch.float64)] * 3)
    orientation = torch.nn.functional.normalize(torch.randn(1000, 4, dtype=torch.float64))
    velocity, spin = torch.randn(2, 1000, 3, dtype=torch.float64)

    # Each rank starts with every size-th body; World.create migrates them to their owners.
    share = torch.arange(comm.rank, 1000, comm.size)
    world = distributed.World.create(
        [box],
        (0.0, 0.0, 0.0),
        (13.5, 13.5, 13.5),
        position[share].to(device),
        id=share,
        payload={
            "orientation": orientation[share].to(device),
            "velocity": velocity[share].to(device),
            "spin": spin[share].to(device),
        },
        comm=comm,
        nonzero_toi=True,
    )
    dt, time = 0.1, 0.0
    for step in range(20):
        mine = world.payload  # of the bodies that this rank now owns
        motion = pgccd.RigidMotion.from_velocity(
            world.position, mine["orientation"], mine["velocity"], mine["spin"], dt
        )
        first = world.first_toi(world.step(motion))
        # As in 02_simulation_loop.py, all bodies move by the same fraction of the step, here the least of all ranks.
        fraction = comm.min(torch.cat([0.9 * first, first.new_ones(1)]).amin()[None])
        position, orientation = motion.at(fraction)
        sign = torch.where(first < 2.0 * fraction, -1.0, 1.0)[:, None]
        world.move(position, orientation=orientation, velocity=sign * mine["velocity"], spin=sign * mine["spin"])
        time += dt * float(fraction)
        turned = int(comm.sum((sign < 0.0).sum()[None]))
        if comm.rank == 0:
            print(f"step {step:2d}: {turned} bodies turn; time {time:.4f}; rank 0 owns {len(world.id)}")
