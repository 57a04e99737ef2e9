"""Cost of the tests of starts: `initial="report"`, the default, against "assume_free", and with solids against without.

    python bench/bench_starts.py [--device cuda] [--rounds N]

Scenes: the standard world, in which nothing intersects; 10,000 boxes, few of which collide; a stack of boxes that
exactly touch; random spheres, of which many intersect; and a crumpled cloth tested against itself, which intersects
itself. Calls of all kinds alternate. As solids all meshes are that are closed.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
import torch
import trimesh
from support import results, timing
from support.scenes import MixedWorld

import pgccd

_ROBOTS = 10_000
_CALLS: dict[str, Callable[..., pgccd.Contacts | pgccd.CollidingPairs]] = {
    "collide": pgccd.collide,
    "first": partial(pgccd.detect, report="first"),
    "all": partial(pgccd.detect, report="all"),
}

Step = tuple[pgccd.Scene, pgccd.RigidMotion | pgccd.VertexMotion]


def main() -> None:
    """Runs the benchmark."""
    parser = results.parser(__doc__)
    parser.add_argument("--device", default="cpu", help="cpu or cuda")
    parser.add_argument("--threads", type=int, default=1, help="CPU threads")
    parser.add_argument("--rounds", type=int, default=15, help="calls timed of each kind")
    arguments = parser.parse_args()
    torch.set_num_threads(arguments.threads)
    rows = []
    for name, step in steps(arguments.device).items():
        for report, call in _CALLS.items():
            rows.append({"scene": name, "report": report, **measure(call, *step, arguments.rounds)})
    results.table(rows)
    results.write("starts", arguments.device, {"rows": rows}, arguments.out)


def steps(device: str) -> dict[str, Step]:
    """The scenes, with their motions."""
    world = MixedWorld(_ROBOTS, 40, device)
    random = torch.Generator().manual_seed(0)

    def uniform(*shape: int) -> torch.Tensor:
        return torch.rand(*shape, generator=random, dtype=torch.float64)

    def rigid(mesh: trimesh.Trimesh, position: torch.Tensor, velocity: torch.Tensor) -> Step:
        count = len(position)
        scene = pgccd.Scene([pgccd.Mesh.from_trimesh(mesh)], [0] * count, device)
        upright = torch.tensor([[1.0, 0.0, 0.0, 0.0]], dtype=torch.float64).repeat(count, 1)
        motion = pgccd.RigidMotion.from_velocity(position, upright, velocity, torch.zeros_like(velocity), dt=1.0)
        return scene, motion.to(device)

    lattice = torch.cartesian_prod(*[torch.arange(8.0, dtype=torch.float64)] * 3)
    spheres = trimesh.creation.icosphere(subdivisions=3)
    return {
        f"{_ROBOTS} robots": (world.scene, world.model.motion(next(iter(world)))),
        "10000 boxes": rigid(trimesh.creation.box(), 60.0 * uniform(10_000, 3), 0.5 * uniform(10_000, 3)),
        "stack of 512 touching boxes": rigid(trimesh.creation.box().subdivide(), lattice, -0.01 * uniform(512, 3)),
        "1000 intersecting spheres": rigid(spheres, 12.0 * uniform(1000, 3), 0.1 * uniform(1000, 3)),
        "cloth that intersects itself": cloth(device),
    }


def cloth(device: str, side: int = 60) -> Step:
    """A sheet rolled up, with random displacements."""
    random = np.random.default_rng(0)
    x, y = np.meshgrid(np.arange(side), np.arange(side), indexing="ij")
    rolled = np.stack([4.0 * np.sin(x / 3.0), 1.0 * y, 4.0 * np.cos(x / 3.0) + 0.02 * x], axis=-1).reshape(-1, 3)
    number = np.arange(side * side).reshape(side, side)
    corners = [number[:-1, :-1], number[1:, :-1], number[1:, 1:], number[:-1, 1:]]
    faces = [np.stack([corners[k].ravel() for k in face], axis=1) for face in ((0, 1, 2), (0, 2, 3))]
    start = rolled + 0.1 * random.normal(size=rolled.shape)
    end = start + 0.05 * random.normal(size=rolled.shape)
    scene = pgccd.Scene([pgccd.Mesh(rolled, np.concatenate(faces))], device=device, self_collision=True)
    return scene, pgccd.VertexMotion(torch.from_numpy(start), torch.from_numpy(end)).to(device)


def measure(
    call: Callable[..., pgccd.Contacts | pgccd.CollidingPairs],
    scene: pgccd.Scene,
    motion: pgccd.RigidMotion | pgccd.VertexMotion,
    rounds: int,
) -> dict[str, Any]:
    """Medians, and the medians of the ratios of successive calls."""
    solid = pgccd.Scene(
        [mesh.as_solid("auto") for mesh in scene.meshes.meshes],
        scene.mesh_index,
        self_collision=False if scene.self_collision is None else scene.self_collision,
    )
    kinds = {
        "plain": partial(call, scene, motion),
        "assume_free": partial(call, scene, motion, initial="assume_free"),
        "solids": partial(call, solid, motion),
    }
    for each in kinds.values():
        each()
    made = [{name: timing.seconds(each, scene.device) for name, each in kinds.items()} for _ in range(rounds)]
    seconds = {name: [one[name][0] for one in made] for name in kinds}
    figures: dict[str, Any] = {"ms": timing.summary(seconds["plain"])["median"], "contacts": len(made[0]["plain"][1])}
    for name in ("assume_free", "solids"):
        figures[f"{name}, ms"] = timing.summary(seconds[name])["median"]
        figures[f"{name}, contacts"] = len(made[0][name][1])
    figures["ratio"] = timing.rounded(float(np.median(np.divide(seconds["plain"], seconds["assume_free"]))))
    figures["solids, ratio"] = timing.rounded(float(np.median(np.divide(seconds["solids"], seconds["plain"]))))
    return figures


if __name__ == "__main__":
    main()
