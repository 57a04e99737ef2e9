"""Time of a step of a user's own loop with `pgccd.distributed.World`: as replays of one CUDA graph per rank
(`CapturedWorld`), and with separate launches. Robots of 700 triangles fly straight and turn; all move until just before
the first contact of the scene, and those that would touch soon then fly back. Both must end in the same state.

    python bench/world_loop.py
    torchrun --nproc-per-node 2 bench/world_loop.py --device cuda
"""

from __future__ import annotations

import argparse
import functools
import time
from typing import Any

import torch
from support import results
from torch import Tensor

import pgccd
from pgccd import distributed, sim
from pgccd.distributed.comm.interface import Comm
from pgccd.runtime.hashing import row_hash


def main() -> None:
    """Runs the benchmark."""
    parser = results.parser(__doc__)
    parser.add_argument("--device", default="cuda")
    parser.add_argument("--robots", type=int, nargs="+", default=[10_000, 100_000, 1_000_000])
    parser.add_argument("--steps", type=int, default=100, help="steps timed")
    arguments = parser.parse_args()
    with distributed.connect(arguments.device) as comm:
        device = distributed.choose_device(arguments.device)
        ways = (True, False) if device.type == "cuda" else (False,)
        rows = [measure(comm, device, robots, graph, arguments) for robots in arguments.robots for graph in ways]
        if comm.rank == 0:
            if len({(row["robots"], row["state_hash"]) for row in rows}) > len(arguments.robots):
                raise SystemExit("the graph's steps differ")
            results.table(rows)
            results.write("world_loop", device.type, {"rows": rows}, arguments.out)


def motion(bodies: distributed.Bodies) -> pgccd.RigidMotion:
    """Motion of robots that move by about 0.1 radii and turn by about 0.1 rad."""
    at = bodies.payload
    return pgccd.RigidMotion.from_velocity(bodies.position, at["orientation"], at["velocity"], at["spin"], dt=1.0)


def response(comm: Comm, bodies: distributed.Bodies, motion: pgccd.RigidMotion, first_toi: Tensor) -> dict[str, Tensor]:
    """Moves all robots until just before the first contact of the scene, and reverses those that would touch soon."""
    fraction = comm.min(torch.cat([0.9 * first_toi, first_toi.new_ones(1)]).amin()[None])
    position, orientation = motion.at(fraction)
    sign = torch.where(first_toi < 2.0 * fraction, -1.0, 1.0)[:, None]
    turned = {name: sign * bodies.payload[name] for name in ("velocity", "spin")}
    return {"position": position, "orientation": orientation, **turned}


def measure(
    comm: Comm, device: torch.device, robots: int, graph: bool, arguments: argparse.Namespace
) -> dict[str, Any]:
    """One row."""
    model = sim.Model(sim.ModelConfig(robots=robots), device=device)
    planned = model.plan(model.start(torch.arange(comm.rank, robots, comm.size, device=device)), 0)
    payload = {"orientation": planned.orientation, "velocity": planned.velocity, "spin": planned.angular_velocity}
    x, y, z = model.half_extent
    box = (-x, -y, -z), (x, y, z)
    scene, options = model.scene(planned.id), distributed.WorldOptions(nonzero_toi=True)
    world = distributed.World.create(
        scene, planned.position, *box, id=planned.id, payload=payload, comm=comm, options=options
    )
    loop = distributed.CapturedWorld(world, motion, functools.partial(response, comm), graph)
    loop.run(20)
    comm.barrier()
    start = time.perf_counter()
    steps = loop.run(arguments.steps)
    comm.barrier()
    seconds = time.perf_counter() - start
    state = [world.id, *(column.contiguous() for column in (world.position, world.payload["orientation"]))]
    hashes = comm.gather_objects(row_hash(state))
    return {
        "ranks": comm.size,
        "robots": robots,
        "graph": graph,
        "step_ms": round(1e3 * seconds / len(steps), 3),
        "replayed": sum(step.replayed for step in steps),
        "contacts": sum(step.contacts for step in steps),
        "state_hash": sum(hashes) % 2**64,
    }


if __name__ == "__main__":
    main()
