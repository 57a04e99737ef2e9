"""Broad phases alone, on swept spheres.

First beside other programs (CPU only, one thread): about one true pair a body. Every round has its own scene; all
contenders find its pairs in turn, and their answers are compared. pgccd answers with the sorted pairs of spheres that
meet. The peers' own volumes are boxes, or spheres around whole paths: what they find in excess is removed by a NumPy
test, whose time is given apart and not counted. Arrays are in each one's own form before the clock starts.

Then pgccd's own against one another, on scenes of several densities, sizes and shapes.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from support import broad_peers, results, timing
from support.scenes import MovingSpheres, clustered_spheres, random_spheres, spheres_on_a_huge_one

import pgccd

# Squared distances of about 4 are computed with errors of this order; pairs nearer to touching may be seen either way.
_ROUNDING = 1e-11
_OURS = ("sweep", "grid", "lbvh")
# These test spheres themselves.
_EXACT = (*(f"pgccd {name}" for name in _OURS), "Warp HashGrid")
# Ratios are to this one.
_REFERENCE = "pgccd grid"

_SCENES: dict[str, Callable[[int, int], MovingSpheres]] = {
    "standard": random_spheres,
    **{
        f"{pairs:g} pairs a body": lambda count, seed, pairs=pairs: random_spheres(count, seed, fraction=pairs / 4.0)
        for pairs in (0.25, 4.0, 16.0)
    },
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
    parser.add_argument("--warm-up", type=int, default=2)
    parser.add_argument("--threads", type=int, default=1, help="of the second part")
    arguments = parser.parse_args()

    torch.set_num_threads(1)
    ours = {f"pgccd {name}": _pgccd(name, arguments.device) for name in _OURS}
    contenders = ours if arguments.device != "cpu" else {**ours, **broad_peers.available()}
    content = measure(contenders, random_spheres, arguments)
    print(f"{arguments.bodies} swept spheres, {content['true_pairs_a_body']} true pairs a body")
    results.table(
        [
            row | {"ms": row["ms"]["median"], "exact_test_ms": (row["exact_test_ms"] or {}).get("median")}
            for row in content["rows"]
        ]
    )
    torch.set_num_threads(arguments.threads)
    scenes = []
    for name, make in _SCENES.items():
        measured = measure(ours, make, arguments)
        medians = {row["method"].removeprefix("pgccd "): row["ms"]["median"] for row in measured["rows"]}
        scenes.append({"scene": name, "pairs_a_body": measured["true_pairs_a_body"], "ms": medians})
    print()
    results.table([{"scene": row["scene"], "pairs/body": row["pairs_a_body"], **row["ms"]} for row in scenes])
    content |= {"bodies": arguments.bodies, "scenes": scenes, "scenes_threads": arguments.threads}
    results.write("broad_phase", arguments.device, content, arguments.out)


def measure(
    contenders: dict[str, broad_peers.Prepare], make: Callable[[int, int], MovingSpheres], arguments: Any
) -> dict[str, Any]:
    """Times of all contenders on one kind of scene, and what they missed of all that any of them found."""
    spent: dict[str, list[float]] = {name: [] for name in contenders}
    removing: dict[str, list[float]] = {name: [] for name in contenders}
    tally = {name: {"found": 0, "missed": 0, "borderline": 0} for name in contenders}
    true_pairs = 0
    for index in range(arguments.warm_up + arguments.rounds):
        scene = make(arguments.bodies, index)
        keys: dict[str, np.ndarray] = {}
        order = list(contenders)
        for name in order[index % len(order) :] + order[: index % len(order)]:
            find = contenders[name](scene)
            duration, read = timing.seconds(find, arguments.device)
            pairs = read()
            test_duration, meeting = timing.seconds(lambda scene=scene, pairs=pairs: scene.meet(pairs))
            tally[name]["found"] += len(pairs) if index >= arguments.warm_up else 0
            keys[name] = np.sort(pairs[meeting] @ np.array([arguments.bodies, 1]))
            if index >= arguments.warm_up:
                spent[name].append(duration)
                removing[name].append(test_duration)
        if index >= arguments.warm_up:
            everything = np.unique(np.concatenate(list(keys.values())))
            true_pairs += len(everything)
            for name, found in keys.items():
                absent = np.setdiff1d(everything, found, assume_unique=True)
                gap = scene.gap(np.stack(np.divmod(absent, arguments.bodies), axis=1))
                tally[name]["missed"] += int((gap < -_ROUNDING).sum())
                tally[name]["borderline"] += int((gap >= -_ROUNDING).sum())

    bodies = arguments.bodies * arguments.rounds
    rows = []
    for name in contenders:
        ratios = np.array(spent[name]) / np.array(spent[_REFERENCE])
        rows.append(
            {
                "method": name,
                "ms": timing.summary(spent[name]),
                "exact_test_ms": None if name in _EXACT else timing.summary(removing[name]),
                "pairs_a_body": timing.rounded(tally[name]["found"] / bodies),
                "missed": tally[name]["missed"],
                "missed_within_rounding": tally[name]["borderline"],
                "times_pgccd": timing.rounded(float(np.median(ratios))),
            }
        )
    return {"true_pairs_a_body": timing.rounded(true_pairs / bodies), "rows": rows}


def _pgccd(broad_phase: str, device: str) -> broad_peers.Prepare:
    # Any mesh will do: only its bounding sphere is looked at.
    tip = 3.0**-0.5
    corners = np.array([[tip, tip, tip], [tip, -tip, -tip], [-tip, tip, -tip], [-tip, -tip, tip]])
    faces = [[0, 1, 2], [0, 3, 1], [0, 2, 3], [1, 3, 2]]
    find_pairs = getattr(pgccd.broad, broad_phase)

    def prepare(scene: MovingSpheres) -> Callable[[], Any]:
        count = len(scene.position_t0)
        sizes, index = np.unique(np.broadcast_to(scene.radius, count), return_inverse=True)
        meshes = pgccd.MeshSet([pgccd.Mesh(size * corners, faces, origin="centroid") for size in sizes], device)
        upright = torch.tensor([[1.0, 0.0, 0.0, 0.0]], dtype=torch.float64, device=device).expand(count, 4)
        ends = [torch.from_numpy(position).to(device) for position in (scene.position_t0, scene.position_t1)]
        motion = pgccd.RigidMotion(ends[0], upright, ends[1], upright)
        bodies = pgccd.MovingBodies(pgccd.Scene(meshes, torch.from_numpy(index).to(device)), motion)

        def find() -> broad_peers.ReadPairs:
            pairs = find_pairs(bodies)
            return lambda: pairs.cpu().numpy()

        return find

    return prepare


if __name__ == "__main__":
    main()
