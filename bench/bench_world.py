"""Time of one step's detection in the standard nanorobot world, per stage, with the memory used (by the world's state,
poses and detection) and a lower bound of the time.

The world first runs until it has left the lattice of its start (`--steps-before`, or `--checkpoint`). Then
`detect(report="first")` is timed in successive steps: poses in device memory to contacts in device memory. The lower
bound is the time that any program needs for: reading every pose once, writing and reading every potentially colliding
pair, writing every contact, at the copy bandwidth measured in the same run; and the operations of the node tests and
candidates actually tested, roughly counted, at the rate of matrix products measured in the same run.

On a GPU further steps also run as a CUDA graph with sufficient capacity, and must find the same contacts.
"""

from __future__ import annotations

import argparse
import itertools
from functools import partial
from pathlib import Path
from typing import Any

import torch
from support import results, timing
from support.memory import PeakMemory
from support.scenes import MixedWorld

import pgccd
from pgccd import sim

# Rough counts from the sources: a node is placed at both ends (36 operations) and tested as moving spheres (24); a
# candidate culled by the first test takes a few hundred operations in double precision. Triangle tests at the leaves
# are not counted.
_OPERATIONS_A_NODE_TEST = 60
_OPERATIONS_A_CANDIDATE = 400
_BYTES_A_PAIR = 16
_BYTES_A_CONTACT = 16 + 8 + 1 + 8 + 16 + 24 + 24 + 1


def main() -> None:
    """Runs the benchmark."""
    arguments = parse_arguments()
    if arguments.threads:
        torch.set_num_threads(arguments.threads)
    rates = measure_rates(arguments.device)
    rows = []
    for robots in arguments.robots:
        rows.append(measure(robots, arguments, rates))
    results.table([flat(row) for row in rows])
    content = {
        "world": arguments.pattern,
        "steps_before": arguments.steps_before,
        "report": "first",
        "rates": rates,
        "rows": rows,
    }
    results.write("world", arguments.device, content, arguments.out)


def parse_arguments() -> argparse.Namespace:
    """The command line."""
    parser = results.parser(__doc__)
    parser.add_argument("--device", default="cpu", help="cpu or cuda")
    parser.add_argument("--robots", type=int, nargs="+", default=[1_000, 10_000, 100_000])
    parser.add_argument("--steps-before", type=int, default=40, help="steps made before the first is timed")
    parser.add_argument("--checkpoint", type=Path, help="folder of a run of `pgccd simulate` to go on from instead")
    parser.add_argument("--pattern", choices=sim.PATTERNS, default="random")
    parser.add_argument("--threads", type=int, help="CPU threads (default: torch's)")
    parser.add_argument("--rounds", type=int, default=20, help="steps timed")
    parser.add_argument("--warm-up", type=int, default=3)
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    if arguments.checkpoint:
        checkpoint = sim.load_checkpoint(arguments.checkpoint)
        arguments.robots = [checkpoint.config.robots]
        arguments.pattern = checkpoint.config.pattern
        arguments.steps_before = checkpoint.steps_made
    return arguments


def measure(robots: int, arguments: argparse.Namespace, rates: dict[str, float]) -> dict[str, Any]:
    """One world size: medians over the timed steps, and means of the counts."""
    with PeakMemory(arguments.device) as memory:
        world = start(robots, arguments)
        row = run(world, arguments, rates)
    row["graph_ms"] = as_graph(world, arguments) if torch.device(arguments.device).type == "cuda" else None
    return row | {"peak_bytes_a_robot": timing.rounded(memory.bytes / robots)}


def start(robots: int, arguments: argparse.Namespace) -> MixedWorld:
    """The world after it has left the lattice."""
    if arguments.checkpoint:
        return MixedWorld.from_checkpoint(sim.load_checkpoint(arguments.checkpoint), arguments.device)
    return MixedWorld(robots, arguments.steps_before, arguments.device, arguments.seed, arguments.pattern)


def run(world: MixedWorld, arguments: argparse.Namespace, rates: dict[str, float]) -> dict[str, Any]:
    """`measure` without memory and graph."""
    device, robots = arguments.device, len(world.state)
    spent: list[float] = []
    stages: dict[str, list[float]] = {}
    counts: dict[str, list[int]] = {}
    for index, state in enumerate(itertools.islice(world, arguments.warm_up + arguments.rounds)):
        motion = world.model.motion(state)
        duration, hits = timing.seconds(partial(pgccd.detect, world.scene, motion, "first"), device)
        if index < arguments.warm_up:
            continue
        spent.append(duration)
        for stage, part in hits.stats.seconds.items():
            stages.setdefault(stage, []).append(part)
        for name in ("pcs", "node_tests", "candidates", "contacts", "unresolved"):
            counts.setdefault(name, []).append(getattr(hits.stats, name))
    mean = {name: sum(values) / len(values) for name, values in counts.items()}
    state_bytes = sum(column.nbytes for column in state.columns.values()) / robots
    tensors = (motion.position_t0, motion.position_t1, motion.orientation_t0, motion.rotation, world.scene.mesh_index)
    pose_bytes = sum(tensor.nbytes for tensor in tensors) / robots
    moved = robots * pose_bytes + mean["pcs"] * 2 * _BYTES_A_PAIR + mean["contacts"] * _BYTES_A_CONTACT
    operations = mean["node_tests"] * _OPERATIONS_A_NODE_TEST + mean["candidates"] * _OPERATIONS_A_CANDIDATE
    return {
        "robots": robots,
        "ms": timing.summary(spent),
        "stage_ms": {stage: timing.summary(values)["median"] for stage, values in stages.items()},
        "pcs_a_body": timing.rounded(mean["pcs"] / robots),
        "node_tests_a_body": timing.rounded(mean["node_tests"] / robots),
        "candidates_a_body": timing.rounded(mean["candidates"] / robots),
        "contacts_a_body": timing.rounded(mean["contacts"] / robots),
        "unresolved": int(sum(counts["unresolved"])),
        "state_bytes_a_robot": state_bytes,
        "pose_bytes_a_robot": pose_bytes,
        "floor_ms": {
            "bytes": timing.rounded(moved / rates["copy_bytes_a_second"] * 1e3),
            "operations": timing.rounded(operations / rates["operations_a_second"] * 1e3),
        },
    }


def as_graph(world: MixedWorld, arguments: argparse.Namespace) -> dict[str, float]:
    """Milliseconds per step as a graph."""
    device, spent = arguments.device, []
    captured: pgccd.CapturedDetection | None = None
    for state in itertools.islice(world, 1 + arguments.rounds):
        motion = world.model.motion(state)
        hits = pgccd.detect(world.scene, motion, report="first")
        if captured is None:
            if hits.stats.needed is None:
                raise SystemExit("this world is streamed: a graph cannot hold it")
            capacity = hits.stats.needed.times(1.25)
            captured = pgccd.CapturedDetection(world.scene, motion, capacity=capacity)
        captured.load(motion)
        seconds, padded = timing.seconds(captured.replay, device)
        spent.append(seconds)
        found = padded.trim()  # raises on overflow
        assert found.toi is not None and hits.toi is not None
        if not (torch.equal(found.pairs, hits.pairs) and torch.equal(found.toi, hits.toi)):
            raise SystemExit("the graph's contacts differ")
    return timing.summary(spent[1:])


def measure_rates(device: str) -> dict[str, float]:
    """Copy bandwidth (reads plus writes) and operations per second of a float32 matrix product."""
    source = torch.ones(1 << 26, dtype=torch.float32, device=device)
    target = torch.empty_like(source)
    copies = [timing.seconds(lambda: target.copy_(source), device)[0] for _ in range(12)][2:]
    size = 2048 if device == "cpu" else 8192
    matrix = torch.rand((size, size), device=device)
    products = [timing.seconds(lambda: torch.mm(matrix, matrix), device)[0] for _ in range(12)][2:]
    return {
        "copy_bytes_a_second": timing.rounded(2 * source.nbytes / sorted(copies)[len(copies) // 2]),
        "operations_a_second": timing.rounded(2.0 * size**3 / sorted(products)[len(products) // 2]),
    }


def flat(row: dict[str, Any]) -> dict[str, Any]:
    """The row as table columns."""
    return {
        "robots": row["robots"],
        "ms": row["ms"]["median"],
        "as graph ms": row["graph_ms"]["median"] if row["graph_ms"] else None,
        **{f"{stage} ms": part for stage, part in row["stage_ms"].items()},
        "pcs/body": row["pcs_a_body"],
        "contacts/body": row["contacts_a_body"],
        "candidates/body": row["candidates_a_body"],
        "bytes/robot": row["state_bytes_a_robot"],
        "peak bytes/robot": row["peak_bytes_a_robot"],
        "floor ms (bytes)": row["floor_ms"]["bytes"],
        "floor ms (operations)": row["floor_ms"]["operations"],
    }


if __name__ == "__main__":
    main()
