"""Time of a whole step of the nanorobot simulation on one GPU: as replays of one CUDA graph, and with separate
launches; on an idle host, and on one whose cores are all busy with other processes.

"wall" is the time between steps on the host, "device" the time between events on the stream, as in `steps.jsonl`. Both
must end in the same state. The time of a step that overflowed the graph's capacity includes repeating it and capturing
a larger graph.
"""

from __future__ import annotations

import argparse
import multiprocessing
import os
import time
from collections.abc import Iterator
from contextlib import contextmanager
from multiprocessing.synchronize import Event
from typing import Any

import torch
from support import results, timing

from pgccd import distributed, sim
from pgccd.sim.step_graph import CommittedStep


def main() -> None:
    """Runs the benchmark."""
    parser = results.parser(__doc__)
    parser.add_argument("--robots", type=int, nargs="+", default=[10_000, 100_000, 1_000_000])
    parser.add_argument("--pattern", choices=sim.PATTERNS, default="random")
    parser.add_argument("--steps-before", type=int, default=24, help="steps made before the first is timed")
    parser.add_argument("--rounds", type=int, default=60, help="steps timed")
    arguments = parser.parse_args()
    rows = []
    for busy in (False, True):
        with busy_host() if busy else idle_host():
            for robots in arguments.robots:
                ways = [measure(robots, graph, busy, arguments) for graph in (True, False)]
                if ways[0]["state_hash"] != ways[1]["state_hash"]:
                    raise SystemExit("the graph's steps differ")
                rows += ways
    results.table(rows)
    results.write("steps", "cuda", {"pattern": arguments.pattern, "rows": rows}, arguments.out)


def measure(robots: int, graph: bool, busy: bool, arguments: argparse.Namespace) -> dict[str, Any]:
    """One row."""
    model = sim.Model(sim.ModelConfig(robots=robots, pattern=arguments.pattern), device="cuda")
    simulation = sim.Simulation.create(distributed.Alone(), model, graph=graph)
    begin, end = arguments.steps_before, arguments.steps_before + arguments.rounds
    for index in range(begin):
        simulation.step(index, more=end - index)
    torch.cuda.synchronize()
    wall, device, committed = [], [], 0
    for index in range(begin, end):
        start = time.perf_counter()
        made = simulation.step(index, more=end - index)
        record = made.record
        wall.append(time.perf_counter() - start)
        device.append(record["seconds"])
        committed += isinstance(made, CommittedStep)
    return {
        "robots": robots,
        "graph": graph,
        "host": "busy" if busy else "idle",
        "wall_ms": timing.summary(wall)["mean"],
        "device_ms": timing.summary(device)["median"],
        "replayed": committed,
        "steps": arguments.rounds,
        "state_hash": record["state_hash"],
    }


def keep_busy(stop: Event) -> None:
    """Keeps one core busy."""
    while not stop.is_set():
        sum(range(100_000))


@contextmanager
def busy_host() -> Iterator[None]:
    """Starts one busy process per core."""
    context = multiprocessing.get_context("spawn")
    stop = context.Event()
    processes = [context.Process(target=keep_busy, args=(stop,), daemon=True) for _ in range(os.cpu_count() or 1)]
    for process in processes:
        process.start()
    try:
        yield
    finally:
        stop.set()
        for process in processes:
            process.join()


@contextmanager
def idle_host() -> Iterator[None]:
    """No other load."""
    yield


if __name__ == "__main__":
    main()
