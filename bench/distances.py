"""The time of `pgccd.distance`, beside coal for bodies at rest and beside `pgccd.detect` for moving ones; and its
values beside those of coal.

    python bench/distances.py [--pairs N] [--rounds N]

Pairs of bumpy tori of 344, 720 and 5,120 triangles in random directions, at centres up to two diameters apart. Times
are processor time of one thread, of all pairs in one call or one after the other, measured in turn.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from support import near_pairs, peers, results, timing
from support.near_pairs import Pairs

import pgccd

# Segments around the torus and its tube, by number of triangles.
MESHES = {344: (43, 4), 720: (36, 10), 5120: (80, 32)}
TOLERANCE = 1e-6
# Times of a motion at which coal is asked, which must not be nearer than the lower bound.
_SAMPLES = 21


def main() -> None:
    """Runs the benchmark."""
    arguments = parse_arguments()
    torch.set_num_threads(1)
    coal = peers.load("coal")
    if coal is None:
        raise SystemExit("coal is required: pip install -r bench/requirements-peers.txt")
    rows = [measure(coal, faces, arguments) for faces in MESHES]
    results.table(rows)
    content = {"pairs": arguments.pairs, "rounds": arguments.rounds, "tolerance": TOLERANCE, "rows": rows}
    results.write("distances", "cpu", content, arguments.out)


def parse_arguments() -> argparse.Namespace:
    """The command line."""
    parser = results.parser(__doc__)
    parser.add_argument("--pairs", type=int, default=200)
    parser.add_argument("--rounds", type=int, default=10, help="timed rounds")
    parser.add_argument("--seed", type=int, default=0)
    return parser.parse_args()


def measure(coal: Any, faces: int, arguments: argparse.Namespace) -> dict[str, Any]:
    """The row of one mesh."""
    pairs = random_pairs(torus(*MESHES[faces]), arguments.pairs, arguments.seed)
    scene, pair, motion = pairs.scene(), torch.arange(2 * len(pairs)).view(-1, 2), pairs.motion("rigid")
    rest = pgccd.RigidMotion.at_rest(motion.position_t0, motion.orientation_t0)
    single = [(pairs[k : k + 1].scene(), rest[2 * k : 2 * k + 2]) for k in range(len(pairs))]
    own = pair[:1]
    beside = Coal(coal, pairs.mesh)
    poses = beside.poses(rest.position_t0, rest.orientation_t0)

    def at_rest() -> pgccd.Distances:
        return pgccd.distance(scene, rest, pairs=pair, tolerance=TOLERANCE)

    def one_by_one() -> list[pgccd.Distances]:
        return [pgccd.distance(alone, still, pairs=own, tolerance=TOLERANCE) for alone, still in single]

    def moving() -> pgccd.Distances:
        return pgccd.distance(scene, motion, pairs=pair, tolerance=TOLERANCE)

    works: dict[str, Callable[[], Any]] = {
        "coal": lambda: beside.distances(poses),
        "at rest": at_rest,
        "one by one": one_by_one,
        "moving": moving,
        "detect": lambda: pgccd.detect(scene, motion, pairs=pair, tolerance=TOLERANCE),
    }
    spent: dict[str, list[float]] = {name: [] for name in works}
    for turn in range(1 + arguments.rounds):
        for name, work in works.items():
            begin = time.process_time()
            work()
            if turn > 0:
                spent[name].append(time.process_time() - begin)
    row: dict[str, Any] = {"triangles": faces}
    row |= {f"{name}, us a pair": timing.rounded(1e6 * np.median(t) / len(pairs)) for name, t in spent.items()}
    ratios = {"coal / at rest": ("coal", "at rest"), "coal / one by one": ("coal", "one by one")}
    ratios |= {"moving / detect": ("moving", "detect")}
    row |= {
        name: timing.rounded(float(np.median(np.array(spent[a]) / np.array(spent[b]))))
        for name, (a, b) in ratios.items()
    }
    return row | compared(beside, at_rest(), moving(), beside.distances(poses), motion)


def compared(
    beside: Coal, still: pgccd.Distances, moved: pgccd.Distances, of_coal: np.ndarray, motion: pgccd.RigidMotion
) -> dict[str, Any]:
    """Values beside those of coal, where coal says that the surfaces are apart."""
    apart = of_coal > 0.0
    lower, upper = still.lower.numpy()[apart], still.upper.numpy()[apart]
    least = np.full(len(of_coal), np.inf)
    for t in np.linspace(0.0, 1.0, _SAMPLES):
        least = np.minimum(least, beside.distances(beside.poses(*motion.at(float(t)))))
    sampled = least > 0.0
    return {
        "apart": int(apart.sum()),
        "most below lower": float((lower - of_coal[apart]).max()),
        "largest difference": float(np.abs(of_coal[apart] - upper).max()),
        "intersect": int((still.upper.numpy()[~apart] == 0.0).sum()),
        "not converged": int((~still.converged).sum() + (~moved.converged).sum()),
        "moving, apart": int(sampled.sum()),
        "moving, most below lower": float((moved.lower.numpy() - least)[sampled].max()),
    }


def torus(around: int, tube: int) -> pgccd.Mesh:
    """A torus with bumps, of 2 around tube triangles, within about 1 of its centre."""
    u, v = np.meshgrid(np.arange(around), np.arange(tube), indexing="ij")
    a, b = 2.0 * np.pi * u / around, 2.0 * np.pi * v / tube
    thickness = 0.3 + 0.05 * np.sin(3.0 * a + b)
    far = 0.65 + thickness * np.cos(b)
    vertices = np.stack([far * np.cos(a), far * np.sin(a), thickness * np.sin(b)], axis=-1).reshape(-1, 3)

    def row(i: np.ndarray, j: np.ndarray) -> np.ndarray:
        return (i % around) * tube + j % tube

    p, q, r, s = row(u, v), row(u + 1, v), row(u + 1, v + 1), row(u, v + 1)
    faces = np.concatenate([np.stack([p, q, r], axis=-1), np.stack([p, r, s], axis=-1)]).reshape(-1, 3)
    return pgccd.Mesh(vertices, faces)


def random_pairs(mesh: pgccd.Mesh, count: int, seed: int) -> Pairs:
    """Bodies whose centres are 1 to 4 radii apart, which move by up to half a radius and turn by up to a radian."""
    random = torch.Generator().manual_seed(seed)

    def normal(width: int) -> torch.Tensor:
        drawn = torch.randn((count, 2, width), generator=random, dtype=torch.float64)
        return drawn / torch.linalg.vector_norm(drawn, dim=-1, keepdim=True)

    def uniform(low: float, high: float) -> torch.Tensor:
        return low + (high - low) * torch.rand((count, 2, 1), generator=random, dtype=torch.float64)

    offset = normal(3)[:, :1] * uniform(1.0, 4.0)[:, :1]
    position = torch.cat([-0.5 * offset, 0.5 * offset], dim=1)
    return Pairs(mesh, position, normal(4), normal(3) * uniform(0.0, 0.5), normal(3) * uniform(0.0, 1.0))


class Coal:
    """Distances of coal, of pairs of one mesh."""

    def __init__(self, coal: Any, mesh: pgccd.Mesh) -> None:
        self.coal = coal
        points, triangles = coal.StdVec_Vec3s(), coal.StdVec_Triangle()
        points.extend(mesh.vertices.numpy())
        triangles.extend(coal.Triangle(*face) for face in mesh.faces.tolist())
        self.model = coal.BVHModelOBBRSS()
        self.model.beginModel(len(triangles), len(points))
        self.model.addSubModel(points, triangles)
        self.model.endModel()
        self.request, self.result = coal.DistanceRequest(), coal.DistanceResult()

    def poses(self, position: torch.Tensor, orientation: torch.Tensor) -> list[Any]:
        """Of bodies (N, 3) and (N, 4)."""
        rotation = near_pairs.rotate(orientation, torch.eye(3, dtype=torch.float64)).transpose(1, 2).numpy()
        return [self.coal.Transform3s(r, x) for r, x in zip(rotation, position.numpy(), strict=True)]

    def distances(self, poses: list[Any]) -> np.ndarray:
        """(P,) of bodies 2 p and 2 p + 1, at most 0 if they intersect."""
        found = []
        for first, second in zip(poses[::2], poses[1::2], strict=True):
            self.result.clear()
            found.append(self.coal.distance(self.model, first, self.model, second, self.request, self.result))
        return np.array(found)


if __name__ == "__main__":
    main()
