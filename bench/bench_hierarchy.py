"""Time to prepare a mesh on one CPU thread: its edges, its hierarchy, and the whole `pgccd.Mesh`, per element;
and the memory of a scene with this mesh.

    python bench/bench_hierarchy.py [--rounds N]

Meshes: the robot of the simulation, terrains of more and more triangles, and clouds of points.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from support import results, timing

import pgccd
from pgccd import ops
from pgccd.geometry.mesh import LEAF_SIZE
from pgccd.sim.nanorobot import robot_mesh

_TERRAINS = (50, 200, 1000)  # cells along each side, of two triangles
_CLOUDS = (10_000, 1_000_000)


def main() -> None:
    """Runs the benchmark."""
    parser = results.parser(__doc__)
    parser.add_argument("--rounds", type=int, default=20, help="calls timed of each mesh; the largest fewer")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    meshes = {"robot": robot_mesh()} | {f"terrain {side} x {side}": terrain(side) for side in _TERRAINS}
    meshes |= {f"cloud of {count} points": cloud(count) for count in _CLOUDS}
    rows = [measure(name, mesh, arguments.rounds) for name, mesh in meshes.items()]
    results.table(rows)
    results.write("hierarchy", "cpu", {"rows": rows}, arguments.out)


def terrain(side: int) -> pgccd.Mesh:
    """Hills over a square grid."""
    x, y = np.meshgrid(np.arange(side + 1.0), np.arange(side + 1.0))
    vertices = np.stack([x, y, 3.0 * np.sin(0.1 * x) + 3.0 * np.cos(0.13 * y)], axis=-1).reshape(-1, 3)
    number = np.arange(len(vertices)).reshape(side + 1, side + 1)
    corners = [number[:-1, :-1], number[:-1, 1:], number[1:, 1:], number[1:, :-1]]
    faces = [[corners[0], corners[1], corners[2]], [corners[0], corners[2], corners[3]]]
    return pgccd.Mesh(vertices, np.stack([np.stack(f, axis=-1) for f in faces]).reshape(-1, 3))


def cloud(count: int) -> pgccd.Mesh:
    """Points of a depth camera: of a wavy surface, with noise, in no order."""
    random = np.random.default_rng(0)
    x, y = random.uniform(-1.0, 1.0, (2, count))
    noise = 1e-3 * random.normal(size=(count, 3))
    return pgccd.Mesh.points(np.stack([x, y, 0.1 * np.sin(5.0 * x) * np.cos(3.0 * y)], axis=1) + noise, 1e-3)


def measure(name: str, mesh: pgccd.Mesh, rounds: int) -> dict[str, Any]:
    """One row: microseconds per element, the median."""
    count, vertices = len(mesh.faces), mesh.vertices - mesh.centre_offset
    works = {
        "edges and hierarchy": lambda: ops.prepare_mesh(vertices, mesh.faces, LEAF_SIZE),
        "pgccd.Mesh": lambda: pgccd.Mesh._of_elements(vertices.numpy(), mesh.faces.numpy()),
    }
    tensors = pgccd.MeshSet([mesh]).tensors
    row: dict[str, Any] = {"mesh": name, "elements": count}
    row["bytes an element"] = timing.rounded(sum(each.numel() * each.element_size() for each in tensors) / count)
    for work, call in works.items():
        call()
        spent = [timing.seconds(call)[0] for _ in range(max(3, min(rounds, 2_000_000 // count)))]
        row[f"{work}, us an element"] = timing.summary(spent, 1e6 / count)["median"]
    return row


if __name__ == "__main__":
    main()
