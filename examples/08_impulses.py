"""
Impulses between five kinds of bodies
=====================================

Balls, boxes, rods, plates and cylinders fly between walls over a terrain, and bounce. An impulse needs mass, velocity
and spin of both partners, one of which may live on another rank. The program is the same on any number of ranks, and
its results are equal to the last bit:

.. code-block:: sh

    python examples/08_impulses.py cpu 20000
    torchrun --nproc-per-node 4 examples/08_impulses.py cpu 20000        # "cuda" for one GPU per rank

Without a launcher the program below runs on one rank, and then starts itself again on four ranks on this machine's CPU.
"""

import hashlib
import math
import os
import subprocess
import sys

import matplotlib.pyplot as plt
import torch

import pgccd
from pgccd import distributed

name = sys.argv[1] if len(sys.argv) > 1 else "cpu"
count = int(sys.argv[2]) if len(sys.argv) > 2 else 200
bounce, dt = 0.9, 0.1

# %%
# **Bodies.** Five kinds move, and start on a lattice with four layers. Terrain, walls and roof are static, and their
# mass is infinite.

side = math.ceil(math.sqrt(count / 4))
width = 1.6 * side
corners = torch.cartesian_prod(*[torch.arange(side + 3.0, dtype=torch.float64)] * 2)
height = -((5.0 * corners[:, 0] + 3.0 * corners[:, 1]) % 7.0) / 7.0
row = torch.arange(len(corners)).view(side + 3, side + 3)
a, b, c, d = (part.flatten() for part in (row[:-1, :-1], row[1:, :-1], row[:-1, 1:], row[1:, 1:]))
faces = torch.cat([torch.stack([a, b, c], dim=1), torch.stack([b, d, c], dim=1)])
terrain = pgccd.Mesh(torch.column_stack([1.6 * corners - 1.6, height]), faces)
ball, box, rod = pgccd.Mesh.icosphere(0.4, 1), pgccd.Mesh.box([0.7, 0.5, 0.4]), pgccd.Mesh.box([1.1, 0.2, 0.2])
plate, cylinder = pgccd.Mesh.box([0.8, 0.8, 0.1]), pgccd.Mesh.cylinder(0.25, 0.8, 12)
walls = [
    pgccd.Mesh.box(extents) for extents in ([0.5, width + 2, 10.0], [width + 2, 0.5, 10.0], [width + 2] * 2 + [0.5])
]
meshes, middle = [ball, box, rod, plate, cylinder, terrain, *walls], width / 2

body = torch.arange(count)
lattice = 1.6 * torch.stack([body % side, body // side % side, body // side**2], dim=1) + 0.8
fixed = [[0.0, 0.0, 0.0], [-0.3, middle, 4.0], [width + 0.3, middle, 4.0]]
fixed += [[middle, -0.3, 4.0], [middle, width + 0.3, 4.0], [middle, middle, 6.8]]
position = torch.cat([lattice.double(), torch.tensor(fixed, dtype=torch.float64)])
mesh_index = torch.cat([body % 5, torch.tensor([5, 6, 6, 7, 7, 8])])
static = mesh_index >= 5

torch.manual_seed(0)
state = torch.randn(len(position), 10, dtype=torch.float64)
state[static] = torch.tensor([1.0] + [0.0] * 9, dtype=torch.float64)
mass = torch.tensor([1.0, 1.5, 0.5, 0.7, 1.2] + [torch.inf] * 4, dtype=torch.float64)[mesh_index]
columns = {"orientation": torch.nn.functional.normalize(state[:, :4]), "velocity": state[:, 4:7], "spin": state[:, 7:]}
columns |= {"mass": mass, "inertia": 0.06 * mass}

# %%
# **The impulse.** The payload that `World.step` is asked for comes with the contacts: ``hits.payload[name]`` has the
# values of both bodies, ``(K, 2, ...)`` in the order of ``hits.pairs``. A contact between bodies of two ranks is
# returned on both, with the same bits, so both compute the same impulse. Products are added by written-out sums, since
# a library may add in another order if there are more contacts.


def dot(a: torch.Tensor, b: torch.Tensor) -> torch.Tensor:
    return a[..., 0] * b[..., 0] + a[..., 1] * b[..., 1] + a[..., 2] * b[..., 2]


def cross(a: torch.Tensor, b: torch.Tensor) -> torch.Tensor:
    return a[..., [1, 2, 0]] * b[..., [2, 0, 1]] - a[..., [2, 0, 1]] * b[..., [1, 2, 0]]


NEEDED = ("position", "velocity", "spin", "mass", "inertia")


def changes(hits: pgccd.Contacts) -> torch.Tensor:
    """(K, 2, 6): what each contact adds to velocity and spin of its bodies."""
    x, v, w, m, inertia = (hits.payload[name] for name in NEEDED)
    n = hits.normal[:, None]  # from the first body to the second
    lever = cross(hits.point[:, None] - (x + dt * hits.toi[:, None, None] * v), n)
    speed = dot(v, n) + dot(w, lever)  # (K, 2), of the points that touch
    ease = 1.0 / m + dot(lever, lever) / inertia
    impulse = (1.0 + bounce) * (speed[:, 0] - speed[:, 1]).clamp(min=0.0) / (ease[:, 0] + ease[:, 1])
    push = torch.stack([-impulse, impulse], dim=1)[..., None]
    return torch.cat([push * n / m[..., None], push * lever / inertia[..., None]], dim=2)


# %%
# **The loop.** With ``resolve=True`` each body moves by the fraction of its path that `pgccd.resolve` gives, so that no
# two bodies ever overlap. `World.sum_per_body` adds up the contacts of each body, in their order. A body between
# several others takes the mean of what they add.

with distributed.connect(name) as comm:
    share, device = torch.arange(comm.rank, len(position), comm.size), distributed.choose_device(name)
    world = distributed.World.create(
        pgccd.Scene(meshes, mesh_index[share], device, static=static[share]),
        position[share].to(device),
        (0.0, 0.0, 0.0),
        (width, width, 6.4),
        id=share.to(device),
        payload={key: column[share].to(device) for key, column in columns.items()},
        comm=comm,
    )
    met = []
    for step in range(20):
        mine = world.payload  # of the bodies that this rank owns now
        motion = pgccd.RigidMotion.from_velocity(
            world.position, mine["orientation"], mine["velocity"], mine["spin"], dt
        )
        resolved = world.step(motion, payload=NEEDED, resolve=True)
        hits = resolved.hits
        each = changes(hits)
        pushes = torch.cat([each, (each != 0.0).any(dim=2, keepdim=True)], dim=2)
        total = world.sum_per_body(hits, pushes)
        velocity, spin = (total[:, :6] / total[:, 6:].clamp(min=1.0)).split(3, dim=1)
        at, orientation = resolved.motion.at(1.0)
        world.move(at, orientation=orientation, velocity=mine["velocity"] + velocity, spin=mine["spin"] + spin)
        met.append(int(comm.sum((total[:, 6] > 0.0).sum()[None])))
        if comm.rank == 0 and step % 5 == 4:
            print(f"{comm.size} ranks, step {step:2d}: {met[-1]} bodies bounce; rank 0 owns {len(world.id)}")

    rest = world.step(pgccd.RigidMotion.at_rest(world.position, world.payload["orientation"]))
    assert not comm.any(len(rest) > 0), f"these touch after the last step: {rest.pairs.tolist()}"
    # Every rank adds its rows to a table by id, so that all hold all bodies.
    table = torch.zeros(len(position), 6, dtype=torch.float64, device=device)
    table[world.id] = torch.cat([world.position, world.payload["velocity"]], dim=1)
    table, rank, ranks = comm.sum(table).cpu(), comm.rank, comm.size

# %%
# The hash covers every bit of all positions and velocities. It is the same on one rank and on four.

digest = hashlib.sha256(table.numpy().tobytes()).hexdigest()[:16]
if rank == 0:
    print(f"{ranks} ranks, {count} bodies: positions and velocities {digest}")

if distributed.find_placement().launcher == "none" and name == "cpu":
    launch = [sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc-per-node", "4"]
    command = [*launch, sys.argv[0], "cpu", str(count)]
    done = subprocess.run(
        command, env=os.environ | {"OMP_NUM_THREADS": "1"}, capture_output=True, text=True, check=True
    )
    print(done.stdout)
    assert digest in done.stdout, "four ranks gave other results than one"

    figure, (left, right) = plt.subplots(1, 2, figsize=(11.0, 4.2), layout="constrained")
    left.bar(range(len(met)), met, color="tab:orange")
    left.set(xlabel="step", ylabel="bodies that bounce")
    x, _, z = table[:count, :3].T
    right.plot(1.6 * corners[:, 0] - 1.6, height, ",", color="grey")
    right.scatter(x, z, c=mesh_index[:count], cmap="tab10", vmin=0, vmax=9, s=14)
    right.set(xlabel="x", ylabel="z", title="the five kinds from the side", aspect="equal")
    plt.show()
