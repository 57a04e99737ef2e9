"""The effect of each design decision: the same steps of the standard world with one thing changed at a time.

    python bench/ablations.py [--device cuda] [--robots N]

Broad phases; reports; meshes and hierarchies shared by all instances against separate vertices and hierarchies per
body, rebuilt in each step, as in the paper's streams; elementary queries in float64 against float32; on a GPU, a
captured step against separate launches. Every variant of one question must find the same contacts. (One cell per step
against several: figure6.py.)
"""

from __future__ import annotations

import argparse
import itertools
from collections.abc import Callable
from functools import partial
from typing import Any, get_args

import torch
from support import results, timing
from support.scenes import MixedWorld
from torch import Tensor

import pgccd
from pgccd.search.broad import BroadPhase

_ROBOTS = {"cpu": 4_000, "cuda": 100_000}
# Limit for separate vertices per body: these take 17 kB per robot, hierarchies 30 kB.
_MOST_OWN = {"cpu": 4_000, "cuda": 100_000}


def main() -> None:
    """Runs the benchmark."""
    arguments = parse_arguments()
    device = arguments.device
    world = MixedWorld(arguments.robots or _ROBOTS[device], arguments.steps_before, device, arguments.seed)
    motions = [world.model.motion(state) for state in itertools.islice(world, 1 + arguments.rounds)]
    rows = [
        *compare("broad phase", broad_phases(world), motions, device),
        *compare("report", reports(world), motions, device),
        *compare("geometry", geometries(world, device), [with_path(motion, "linear") for motion in motions], device),
        *compare("launches", launches(world, motions), motions, device),
        *precisions(world, motions, device),
    ]
    results.table([flat(row) for row in rows])
    content = {"robots": len(world.state), "steps_before": arguments.steps_before, "rows": rows}
    results.write("ablations", device, content, arguments.out)


def parse_arguments() -> argparse.Namespace:
    """The command line."""
    parser = results.parser(__doc__)
    parser.add_argument("--device", choices=("cpu", "cuda"), default="cuda" if torch.cuda.is_available() else "cpu")
    parser.add_argument("--robots", type=int, help=f"default: {_ROBOTS}")
    parser.add_argument("--steps-before", type=int, default=40, help="steps made before the first is timed")
    parser.add_argument("--rounds", type=int, default=20, help="steps timed")
    parser.add_argument("--seed", type=int, default=0)
    return parser.parse_args()


Result = pgccd.Contacts | pgccd.CollidingPairs | pgccd.PaddedContacts
Variant = Callable[[pgccd.RigidMotion], Result]


def broad_phases(world: MixedWorld) -> dict[str, Variant]:
    """The broad phases."""

    def using(name: BroadPhase) -> Variant:
        return lambda motion: pgccd.detect(world.scene, motion, broad_phase=name)

    return {"grid": using("grid"), "sweep": using("sweep"), "lbvh": using("lbvh")}


def reports(world: MixedWorld) -> dict[str, Variant]:
    """The reports, and the colliding pairs alone."""

    def asking(report: pgccd.Report) -> Variant:
        return lambda motion: pgccd.detect(world.scene, motion, report)

    found = {report: asking(report) for report in get_args(pgccd.Report)}
    return found | {"collide": lambda motion: pgccd.collide(world.scene, motion)}


def geometries(world: MixedWorld, device: str) -> dict[str, Variant]:
    """Sources of vertices and hierarchies, on straight vertex paths."""
    found: dict[str, Variant] = {"shared by instances": lambda motion: pgccd.detect(world.scene, motion)}
    if len(world.state) > _MOST_OWN[device]:
        return found
    vertices = world.model.meshes.meshes[0].vertices.to(device)

    def own(motion: pgccd.RigidMotion) -> pgccd.Contacts:
        arcs = with_path(motion, "rigid")  # the same ends
        ends = [_placed(vertices, *arcs.at(time)) for time in (0.0, 1.0)]
        return pgccd.detect(world.scene, pgccd.VertexMotion(*ends))

    return found | {"of each body, rebuilt": own}


def _placed(vertices: Tensor, position: Tensor, orientation: Tensor) -> Tensor:
    """Vertices (V, 3) of one mesh at N poses: (N V, 3)."""
    return _placed_each(vertices[None].expand(len(position), -1, -1), position, orientation).reshape(-1, 3)


def _placed_each(points: Tensor, position: Tensor, orientation: Tensor) -> Tensor:
    """Points (N, V, 3), each row placed by its pose."""
    w, v = orientation[:, None, :1], orientation[:, None, 1:].expand_as(points)
    cross = torch.linalg.cross
    return position[:, None] + points + 2.0 * cross(v, cross(v, points) + w * points)


def with_path(motion: pgccd.RigidMotion, path: Any) -> pgccd.RigidMotion:
    """The same ends on another path."""
    columns = (motion.position_t0, motion.orientation_t0, motion.position_t1, motion.rotation)
    return pgccd.RigidMotion.from_rotation(*columns, path=path)


def launches(world: MixedWorld, motions: list[pgccd.RigidMotion]) -> dict[str, Variant]:
    """Graph replay against separate launches on a GPU. Neither waits for the counts."""
    if world.scene.device.type != "cuda":
        return {}
    needed = pgccd.detect(world.scene, motions[0]).stats.needed
    if needed is None:
        raise SystemExit("this world is streamed: a graph cannot hold it")
    capacity = needed.times(1.25)
    captured = pgccd.CapturedDetection(world.scene, motions[0], capacity=capacity)
    return {
        "launched one by one": lambda motion: pgccd.detect(world.scene, motion, capacity=capacity),
        "as a graph": captured,
    }


def compare(
    question: str, variants: dict[str, Variant], motions: list[pgccd.RigidMotion], device: str
) -> list[dict[str, Any]]:
    """One row per variant. The first motion is a warm-up. Variants alternate, so that disturbances affect all."""
    spent: dict[str, list[float]] = {name: [] for name in variants}
    for index, motion in enumerate(motions):
        seen = None
        for name, variant in variants.items():
            duration, hits = timing.seconds(partial(variant, motion), device)
            if isinstance(hits, pgccd.PaddedContacts):
                hits = hits.trim()
            pairs = hits.pairs.unique(dim=0)
            if name == "earliest":  # its one contact must be among those of the variants before
                is_right = seen is not None and all(pair in seen.tolist() for pair in pairs.tolist())
            else:
                is_right = seen is None or torch.equal(seen, pairs)
                seen = pairs
            if not is_right:
                raise SystemExit(f"{question}, {name}: other contacts than the variants before it")
            if index:
                spent[name].append(duration)
    return [{"question": question, "variant": name, "ms": timing.summary(times)} for name, times in spent.items()]


def precisions(world: MixedWorld, motions: list[pgccd.RigidMotion], device: str) -> list[dict[str, Any]]:
    """float64 against float32 on vertex-face queries: the candidates of all steps."""
    ends = [torch.cat(parts) for parts in zip(*(_queries(world, motion, device) for motion in motions), strict=True)]
    rows = []
    for dtype in (torch.float64, torch.float32):
        start, end = (each.to(dtype) for each in ends)
        times = [timing.seconds(partial(pgccd.narrow.vertex_face, start, end), device) for _ in range(8)]
        hits = int((times[0][1].status != pgccd.Status.FREE).sum())
        ms = timing.summary([duration for duration, _ in times[1:]])
        row = {"question": "elementary tests", "variant": str(dtype).removeprefix("torch."), "ms": ms}
        rows.append(row | {"queries": len(ends[0]), "contacts": hits})
    return rows


def _queries(world: MixedWorld, motion: pgccd.RigidMotion, device: str) -> list[Tensor]:
    """Points (n, 4, 3) at both ends, relative to the first body's position, where float32 has spare digits."""
    moving = pgccd.MovingBodies.of(world.scene, with_path(motion, "linear"))
    pairs = pgccd.broad.find_pairs(moving)
    candidates, _ = pgccd.traverse.find_candidates(moving, pairs)
    candidates = candidates[candidates[:, 1] == pgccd.Kind.VF_AB].long()
    mesh = world.model.meshes.meshes[0]
    corners = torch.cat([candidates[:, 2:3], mesh.faces.to(device).long()[candidates[:, 3]]], dim=1)
    bodies = pairs[candidates[:, 0]]
    owner = torch.cat([bodies[:, :1], bodies[:, 1:].expand(-1, 3)], dim=1)
    points = mesh.vertices.to(device)[corners].reshape(-1, 1, 3)
    ends = []
    for time in (0.0, 1.0):
        position, orientation = motion.at(time)
        shift = (position[owner] - position[bodies[:, :1]]).reshape(-1, 3)
        ends.append(_placed_each(points, shift, orientation[owner].reshape(-1, 4)).reshape(-1, 4, 3))
    return ends


def flat(row: dict[str, Any]) -> dict[str, Any]:
    """The row as table columns."""
    queries = {"queries": row.get("queries"), "contacts": row.get("contacts")}
    return {"question": row["question"], "variant": row["variant"], "ms": row["ms"]["median"], **queries}


if __name__ == "__main__":
    main()
