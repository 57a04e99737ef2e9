"""pgccd's broad phases on swept spheres: scenes of several densities, sizes and shapes. (Other programs: peers.py.)"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import torch
from comparison import broad_phases
from support import results
from support.scenes import MovingSpheres, clustered_spheres, random_spheres, spheres_on_a_huge_one

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
    arguments = parser.parse_args()
    torch.set_num_threads(arguments.threads)
    scenes = []
    for name, make in _SCENES.items():
        rows = broad_phases.measure(arguments.bodies, arguments.device, arguments.rounds, make, with_peers=False)
        medians = {row["program"].removeprefix("pgccd "): row["ms"]["median"] for row in rows}
        scenes.append({"scene": name, "pairs_a_body": rows[0]["pairs_a_body"], "ms": medians})
    results.table([{"scene": row["scene"], "pairs/body": row["pairs_a_body"], **row["ms"]} for row in scenes])
    content = {"bodies": arguments.bodies, "threads": arguments.threads, "scenes": scenes}
    results.write("broad_phase", arguments.device, content, arguments.out)


if __name__ == "__main__":
    main()
