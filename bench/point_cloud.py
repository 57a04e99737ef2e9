"""A cloud of points against bodies that move among them: time and contacts as the cloud grows.

    python bench/point_cloud.py [--device cuda] [--threads N] [--rounds N]

A static cloud of a wavy surface of the size of 40 x 40 bodies; 1,000 icospheres of 320 triangles, boxes and capsules
that pass over it and in part dip into it. As the cloud gets denser, a body meets more points; the spheres of the points
shrink so that they still cover the surface.
"""

from __future__ import annotations

from functools import partial
from typing import Any

import numpy as np
import torch
from support import results, timing

import pgccd

_POINTS = (10_000, 100_000, 1_000_000)
_BODIES = 1_000


def main() -> None:
    """Runs the benchmark."""
    parser = results.parser(__doc__)
    parser.add_argument("--device", default="cpu", help="cpu or cuda")
    parser.add_argument("--threads", type=int, default=1, help="CPU threads")
    parser.add_argument("--rounds", type=int, default=10, help="calls timed of each kind")
    arguments = parser.parse_args()
    torch.set_num_threads(arguments.threads)
    rows = [measure(count, arguments.device, arguments.rounds) for count in _POINTS]
    results.table(rows)
    results.write("point_cloud", arguments.device, {"rows": rows}, arguments.out)


def measure(count: int, device: str, rounds: int) -> dict[str, Any]:
    """One row: medians."""
    random = np.random.default_rng(0)
    side = 40.0
    x, y = random.uniform(0.0, side, (2, count))
    surface = np.stack([x, y, np.sin(x) * np.cos(y)], axis=1)
    shapes = [
        pgccd.Mesh.icosphere(0.4, 2),
        pgccd.Mesh.box([0.5, 0.5, 0.5]),
        pgccd.Mesh.capsule(0.2, 0.5),
    ]
    seconds, cloud = timing.seconds(lambda: pgccd.Mesh.points(surface, side / count**0.5))
    index = [0, *(1 + np.arange(_BODIES) % 3).tolist()]
    static = torch.arange(1 + _BODIES, device=device) == 0
    scene = pgccd.Scene([cloud, *shapes], index, device, static=static)
    place = np.column_stack([random.uniform(0.0, side, (_BODIES, 2)), random.uniform(1.5, 4.0, _BODIES)])
    start = torch.tensor(np.concatenate([np.zeros((1, 3)), place]), device=device)
    velocity = torch.tensor(random.normal(size=(1 + _BODIES, 3)) * [0.5, 0.5, 1.0], device=device)
    spin = torch.tensor(random.normal(size=(1 + _BODIES, 3)), device=device)
    velocity[0] = spin[0] = 0.0
    upright = torch.tensor([[1.0, 0.0, 0.0, 0.0]], dtype=torch.float64, device=device).expand(1 + _BODIES, 4)
    motion = pgccd.RigidMotion.from_velocity(start, upright, velocity, spin, dt=1.0)
    row: dict[str, Any] = {"points": count, "mesh, s": timing.rounded(seconds)}
    for report in ("first", "all"):
        found = pgccd.detect(scene, motion, report)
        call = partial(pgccd.detect, scene, motion, report)
        spent = [timing.seconds(call, device)[0] for _ in range(rounds)]
        row |= {f"{report}, ms": timing.summary(spent)["median"], f"{report}, contacts": len(found)}
    return row


if __name__ == "__main__":
    main()
