"""Memory of the nanorobot simulation on one GPU: bytes a robot, and the largest worlds.

    python bench/world_memory.py [--robots N ...] [--steps N]

"allocated" and "reserved" are the peaks of torch's allocator over all steps, the first one included.
"""

from __future__ import annotations

import gc
import time
from typing import Any

import torch
from support import results

from pgccd import distributed, sim

TRIANGLES = 700


def main() -> None:
    """Runs the benchmark."""
    parser = results.parser(__doc__)
    parser.add_argument("--robots", type=int, nargs="+", default=[1_000_000, 10_000_000, 50_000_000, 100_000_000])
    parser.add_argument("--pattern", choices=sim.PATTERNS, default="random")
    parser.add_argument("--steps", type=int, default=12)
    arguments = parser.parse_args()
    rows = [measure(robots, graph, arguments) for robots in arguments.robots for graph in (False, True)]
    results.table(rows)
    results.write("world_memory", "cuda", {"pattern": arguments.pattern, "rows": rows}, arguments.out)


def measure(robots: int, graph: bool, arguments: Any) -> dict[str, Any]:
    """One row; without figures if the world is too large."""
    row: dict[str, Any] = {"robots": robots, "graph": graph, "triangles": TRIANGLES * robots}
    gc.collect()
    torch.cuda.empty_cache()
    torch.cuda.reset_peak_memory_stats()
    try:
        model = sim.Model(sim.ModelConfig(robots=robots, pattern=arguments.pattern), device="cuda")
        simulation = sim.Simulation.create(distributed.Alone(), model, graph=graph)
        milliseconds = []
        for index in range(arguments.steps):
            torch.cuda.synchronize()
            begin = time.perf_counter()
            made = simulation.step(index, more=2 * arguments.steps - index)
            torch.cuda.synchronize()
            milliseconds.append(1e3 * (time.perf_counter() - begin))
    except RuntimeError as error:
        if "out of memory" not in str(error):
            raise
        return row | {"steps": "out of memory"}
    row |= {"steps": arguments.steps, "least_ms": min(milliseconds[1:]), "last_ms": milliseconds[-1]}
    row |= {"allocated_bytes_a_robot": torch.cuda.max_memory_allocated() / robots}
    row |= {"reserved_bytes_a_robot": torch.cuda.max_memory_reserved() / robots}
    return row | {"state_hash": made.record["state_hash"]}


if __name__ == "__main__":
    main()
