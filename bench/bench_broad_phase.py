"""pgccd's broad phases on swept spheres: scenes of several densities, sizes and shapes. (Other programs: peers.py.)

With --aspect, instead: rods of these ratios of length to thickness, at equal density, with and without their boxes.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import torch
import trimesh
from comparison import broad_phases
from support import results, timing
from support.scenes import MovingSpheres, clustered_spheres, random_spheres, spheres_on_a_huge_one

import pgccd

_SCENES: dict[str, Callable[[int, int], MovingSpheres]] = {
    "standard": random_spheres,
    **{f"{pairs:g} pairs a body": partial(random_spheres, fraction=pairs / 4.0) for pairs in (0.25, 4.0, 16.0)},
    "sizes 1:10": lambda count, seed: random_spheres(count, seed, size_ratio=10.0),
    "sizes 1:1000": lambda count, seed: random_spheres(count, seed, size_ratio=1000.0),
    "pebbles on a huge body": spheres_on_a_huge_one,
    "clusters": clustered_spheres,
    "fast": lambda count, seed: random_spheres(count, seed, speed=4.0),
}


def main() -> None:
    """Runs the benchmark."""
    parser = results.parser(__doc__)
    parser.add_argument("--device", default="cpu", help="cpu or cuda")
    parser.add_argument("--bodies", type=int, default=100_000)
    parser.add_argument("--rounds", type=int, default=22, help="timed scenes")
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--aspect", type=float, nargs="+", help="of rods, length by thickness")
    parser.add_argument("--report", choices=["any", "first", "all"], default="first", help="of the rods")
    arguments = parser.parse_args()
    torch.set_num_threads(arguments.threads)
    if arguments.aspect:
        rows = [measure_rods(aspect, arguments) for aspect in arguments.aspect]
        results.table(rows)
        content = {"bodies": arguments.bodies, "threads": arguments.threads, "report": arguments.report, "rods": rows}
        results.write("broad_phase_rods", arguments.device, content, arguments.out)
        return
    scenes = []
    for name, make in _SCENES.items():
        rows = broad_phases.measure(arguments.bodies, arguments.device, arguments.rounds, make, with_peers=False)
        medians = {row["program"].removeprefix("pgccd "): row["ms"]["median"] for row in rows}
        scenes.append({"scene": name, "pairs_a_body": rows[0]["pairs_a_body"], "ms": medians})
    results.table([{"scene": row["scene"], "pairs/body": row["pairs_a_body"], **row["ms"]} for row in scenes])
    content = {"bodies": arguments.bodies, "threads": arguments.threads, "scenes": scenes}
    results.write("broad_phase", arguments.device, content, arguments.out)


def find_pairs(scene: pgccd.Scene, motion: pgccd.RigidMotion) -> torch.Tensor:
    """Volumes of bodies, and the PCS."""
    return pgccd.broad.find_pairs(pgccd.MovingBodies.of(scene, motion))


def measure_rods(aspect: float, arguments: Any) -> dict[str, Any]:
    """Pairs and medians of one kind of rods of 192 triangles, in any orientation."""
    count, random = arguments.bodies, torch.Generator().manual_seed(0)

    def normal(*shape: int) -> torch.Tensor:
        return torch.randn(*shape, generator=random, dtype=torch.float64)

    box = trimesh.creation.box((aspect, 1.0, 1.0)).subdivide().subdivide()
    scene = pgccd.Scene([pgccd.Mesh.from_trimesh(box)], [0] * count, arguments.device)
    side = 1.2 * (4.0 * aspect * count) ** (1.0 / 3.0)
    position = side * torch.rand(count, 3, generator=random, dtype=torch.float64)
    orientation = torch.nn.functional.normalize(normal(count, 4))
    motion = pgccd.RigidMotion.from_velocity(position, orientation, normal(count, 3), 0.2 * normal(count, 3), dt=0.1)
    motion = motion.to(arguments.device)
    has_boxes, row = scene.meshes.has_boxes, {"aspect": aspect, "colliding": 0}
    for name in ("boxes", "spheres"):
        scene.meshes.has_boxes = has_boxes and name == "boxes"
        detect: partial[pgccd.Contacts | pgccd.CollidingPairs] = partial(pgccd.collide, scene, motion)
        if arguments.report != "any":
            detect = partial(pgccd.detect, scene, motion, arguments.report)
        find = partial(find_pairs, scene, motion)
        broad, step = (
            [timing.seconds(work, scene.device)[0] for _ in range(arguments.rounds)] for work in (find, detect)
        )
        row["colliding"] = len(pgccd.collide(scene, motion))
        row[f"{name}, pairs"] = len(find())
        row[f"{name}, broad phase, ms"] = timing.summary(broad)["median"]
        row[f"{name}, step, ms"] = timing.summary(step)["median"]
    return row


if __name__ == "__main__":
    main()
