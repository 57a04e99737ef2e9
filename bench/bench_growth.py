"""Growth of the time and memory of one step's detection (first contact of every pair) with the scene.

Scenes:
  standard  the standard nanorobot world after it has left the lattice, from a thousand robots to ten million
  density   robots at random places, free to overlap, with 0.25 to 16 potentially colliding pairs per body
  terrain   pebbles of 80 triangles that fall on one static mesh of a million triangles
  sizes     robots of sizes from 1 to 1/1000, uniform in their logarithm, at random places, about one pair per body
  fast      the standard world's robots, but each moves 2 radii and turns by 1.5 rad in the step

Every timed step has its own poses. Times are from poses in device memory to contacts in device memory, by device events
on a GPU. Stage times are host times; the host waits for the device only where it needs a number. "peak_bytes" is the
peak of one further step: scene, poses and the allocations of detection; "scratch_bytes" is the latter alone. (On a CPU
these are resident pages.)
"""

from __future__ import annotations

import argparse
import itertools
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import torch
from support import results, timing
from support.memory import PeakMemory, bytes_in_use
from support.random_bodies import RandomBodies, scaled_copies
from support.scenes import MixedWorld
from support.terrain import PebblesOnTerrain

import pgccd
from pgccd import sim

_PAIRS_A_BODY = (0.25, 1.0, 4.0, 16.0)
_SIZE_RATIO, _SIZES = 1000.0, 31
# Relative to the standard world's mean displacement, 0.1 radii, and largest turn, 0.1 rad.
_FASTER, _TURNING_FASTER = 20.0, 15.0
# Larger worlds make fewer steps before timing.
_LARGE = 2_000_000
# Minimum number of timed steps, however long they take.
_FEWEST = 5
_COUNTS = ("pcs", "node_tests", "candidates", "contacts")

Steps = tuple[pgccd.Scene, Iterator[pgccd.RigidMotion]]


@dataclass
class Case:
    """One row: generators of its scene and steps, and details to report."""

    scene: str
    bodies: int
    make: Callable[[], Steps]
    details: dict[str, Any] = field(default_factory=dict)


def main() -> None:
    """Runs the benchmark."""
    arguments = parse_arguments()
    rows: list[dict[str, Any]] = []
    try:
        for case in cases(arguments):
            rows.append(measure(case, arguments))
            print(f"{case.scene}, {case.bodies} bodies: {rows[-1]['ms']['median']} ms", flush=True)
    finally:  # keeps finished rows when a larger scene does not fit
        if rows:
            print()
            results.table([flat(row) for row in rows])
        if rows and (arguments.out or not arguments.quick):
            results.write("growth", arguments.device, {"report": "first", "rows": rows}, arguments.out)


def parse_arguments() -> argparse.Namespace:
    """The command line. Default sizes depend on the device."""
    parser = results.parser(__doc__)
    parser.add_argument("--device", default="cpu", help="cpu or cuda")
    parser.add_argument("--scenes", nargs="+", choices=_SCENES, default=list(_SCENES))
    parser.add_argument("--robots", type=int, nargs="+", help="of the standard world, one row each")
    parser.add_argument("--bodies", type=int, help="of all other scenes")
    parser.add_argument("--triangles", type=int, help="of the terrain")
    parser.add_argument("--rounds", type=int, help="steps timed (default 20)")
    parser.add_argument(
        "--row-seconds", type=float, default=60.0, help=f"a row makes no more steps after that, but at least {_FEWEST}"
    )
    parser.add_argument("--warm-up", type=int, default=3)
    parser.add_argument("--steps-before", type=int, help="of a world, before the first step timed (default 40)")
    parser.add_argument("--steps-before-large", type=int, default=3, help=f"with more than {_LARGE} robots")
    parser.add_argument("--threads", type=int, help="CPU threads (default: torch's)")
    parser.add_argument("--quick", action="store_true", help="small scenes, few rounds; writes only where --out says")
    arguments = parser.parse_args()
    on_gpu = torch.device(arguments.device).type == "cuda"
    defaults: dict[str, Any] = {
        "robots": [1_000, 10_000, 100_000] + [1_000_000, 10_000_000] * on_gpu,
        "bodies": 100_000 if on_gpu else 3_000,
        "triangles": 1_000_000,
        "rounds": 20,
        "steps_before": 40,
    }
    if arguments.quick:
        defaults = {"robots": [300, 1_000], "bodies": 1_000, "triangles": 5_000, "rounds": 5, "steps_before": 5}
    for name, value in defaults.items():
        if getattr(arguments, name) is None:
            setattr(arguments, name, value)
    if arguments.threads:
        torch.set_num_threads(arguments.threads)
    return arguments


def cases(arguments: argparse.Namespace) -> Iterator[Case]:
    """All requested rows."""
    for scene in arguments.scenes:
        yield from _SCENES[scene](arguments)


def standard(arguments: argparse.Namespace) -> Iterator[Case]:
    """The standard world for each number of robots."""
    for robots in arguments.robots:
        steps_before = arguments.steps_before_large if robots > _LARGE else arguments.steps_before

        def make(robots: int = robots, steps_before: int = steps_before) -> Steps:
            world = MixedWorld(robots, steps_before, arguments.device)
            return world.scene, (world.model.motion(state) for state in world)

        yield Case("standard", robots, make, {"steps_before": steps_before})


def density(arguments: argparse.Namespace) -> Iterator[Case]:
    """Robots for each number of pairs per body."""
    for pairs in _PAIRS_A_BODY:

        def make(pairs: float = pairs) -> Steps:
            bodies = RandomBodies([sim.robot_mesh()], arguments.bodies, pairs, arguments.device)
            return bodies.scene, bodies.motions()

        yield Case(f"density {pairs:g}", arguments.bodies, make, {"pairs_a_body_wanted": pairs})


def terrain(arguments: argparse.Namespace) -> Iterator[Case]:
    """Pebbles on a large mesh."""
    details: dict[str, Any] = {}

    def make() -> Steps:
        pebbles = PebblesOnTerrain(arguments.triangles, arguments.bodies, arguments.device)
        details["terrain_triangles"] = pebbles.triangle_count
        return pebbles.scene, pebbles.motions()

    yield Case("terrain", arguments.bodies + 1, make, details)


def sizes(arguments: argparse.Namespace) -> Iterator[Case]:
    """Robots of very different sizes."""

    def make() -> Steps:
        meshes = scaled_copies(sim.robot_mesh(), _SIZE_RATIO, _SIZES)
        bodies = RandomBodies(meshes, arguments.bodies, 1.0, arguments.device)
        return bodies.scene, bodies.motions()

    yield Case("sizes 1:1000", arguments.bodies, make, {"size_ratio": _SIZE_RATIO, "sizes": _SIZES})


def fast(arguments: argparse.Namespace) -> Iterator[Case]:
    """Long steps from the standard world's states."""

    def make() -> Steps:
        world = MixedWorld(arguments.bodies, arguments.steps_before, arguments.device)
        return world.scene, (faster(state) for state in world)

    yield Case("fast", arguments.bodies, make, {"steps_before": arguments.steps_before})


_SCENES: dict[str, Callable[[argparse.Namespace], Iterator[Case]]] = {
    "standard": standard,
    "density": density,
    "terrain": terrain,
    "sizes": sizes,
    "fast": fast,
}


def faster(state: sim.RobotState) -> pgccd.RigidMotion:
    """The planned step, longer and with more rotation."""
    velocity, spin = _FASTER * state.velocity, _TURNING_FASTER * state.angular_velocity
    return pgccd.RigidMotion.from_velocity(state.position, state.orientation, velocity, spin, dt=1.0)


def measure(case: Case, arguments: argparse.Namespace) -> dict[str, Any]:
    """One row: medians over the timed steps, means of the counts, and memory."""
    device = arguments.device
    bytes_at_first = bytes_in_use(device)
    scene, motions = case.make()
    spent: list[float] = []
    done: list[pgccd.Stats] = []
    begin = time.perf_counter()
    for index, motion in enumerate(itertools.islice(motions, arguments.warm_up + arguments.rounds)):
        duration, hits = timing.seconds(partial(pgccd.detect, scene, motion, "first"), device)
        if index >= arguments.warm_up:
            spent.append(duration)
            done.append(hits.stats)
        if len(done) >= _FEWEST and time.perf_counter() - begin > arguments.row_seconds:
            break
    del motion, hits
    motion = next(motions)
    with PeakMemory(device) as memory:
        pgccd.detect(scene, motion, report="first")
    peak_bytes = memory.bytes_before - bytes_at_first + memory.bytes
    stages = {stage: [stats.seconds[stage] for stats in done] for stage in done[0].seconds}
    mean = {name: sum(getattr(stats, name) for stats in done) / len(done) for name in _COUNTS}
    return {
        "scene": case.scene,
        "bodies": case.bodies,
        **case.details,
        "broad_phase": ", ".join(sorted({stats.broad_phase for stats in done})),
        "ms": timing.summary(spent),
        "stage_ms": {stage: timing.summary(parts)["median"] for stage, parts in stages.items()},
        **{f"{name}_a_body": timing.rounded(mean[name] / case.bodies) for name in _COUNTS},
        "unresolved": sum(stats.unresolved for stats in done),
        "waits": timing.rounded(sum(stats.waits for stats in done) / len(done)),
        "chunks": timing.rounded(sum(stats.chunks for stats in done) / len(done)),
        "peak_bytes": peak_bytes,
        "peak_bytes_a_body": timing.rounded(peak_bytes / case.bodies),
        "scratch_bytes": memory.bytes,
    }


def flat(row: dict[str, Any]) -> dict[str, Any]:
    """The row as table columns."""
    return {
        "scene": row["scene"],
        "bodies": row["bodies"],
        "ms": row["ms"]["median"],
        **{f"{stage} ms": part for stage, part in row["stage_ms"].items()},
        "pcs/body": row["pcs_a_body"],
        "candidates/body": row["candidates_a_body"],
        "contacts/body": row["contacts_a_body"],
        "peak bytes": row["peak_bytes"],
        "bytes/body": row["peak_bytes_a_body"],
        "waits": row["waits"],
        "chunks": row["chunks"],
        "broad phase": row["broad_phase"],
    }


if __name__ == "__main__":
    main()
