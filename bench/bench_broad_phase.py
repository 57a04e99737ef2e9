"""Broad phase alone: swept spheres, about one true pair a body, one CPU thread, beside other programs on the same
scenes.

Every round has its own scene; all contenders find its pairs in turn, and their answers are compared. pgccd answers
with the sorted pairs of spheres that meet. The peers' own volumes are boxes, or spheres around whole paths: what they
find in excess is removed by a NumPy test, whose time is given apart and not counted. Arrays are in each one's own
form before the clock starts.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from support import broad_peers, results, timing
from support.scenes import MovingSpheres, random_spheres

import pgccd

# Squared distances of about 4 are computed with errors of this order; pairs nearer to touching may be seen either way.
_ROUNDING = 1e-11
# These test spheres themselves.
_EXACT = ("pgccd sweep", "Warp HashGrid")


def main() -> None:
    """Runs the benchmark."""
    parser = results.parser(__doc__)
    parser.add_argument("--bodies", type=int, default=100_000)
    parser.add_argument("--rounds", type=int, default=22, help="timed scenes")
    parser.add_argument("--warm-up", type=int, default=2)
    arguments = parser.parse_args()
    torch.set_num_threads(1)

    contenders = {"pgccd sweep": _pgccd(), **broad_peers.available()}
    spent: dict[str, list[float]] = {name: [] for name in contenders}
    removing: dict[str, list[float]] = {name: [] for name in contenders}
    tally = {name: {"found": 0, "missed": 0, "borderline": 0} for name in contenders}
    true_pairs = 0
    for index in range(arguments.warm_up + arguments.rounds):
        scene = random_spheres(arguments.bodies, seed=index)
        keys: dict[str, np.ndarray] = {}
        order = list(contenders)
        for name in order[index % len(order) :] + order[: index % len(order)]:
            find = contenders[name](scene)
            duration, read = timing.seconds(find)
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
        milliseconds = timing.summary(spent[name])
        rows.append(
            {
                "method": name,
                "ms": milliseconds,
                "exact_test_ms": None if name in _EXACT else timing.summary(removing[name]),
                "pairs_a_body": timing.rounded(tally[name]["found"] / bodies),
                "missed": tally[name]["missed"],
                "missed_within_rounding": tally[name]["borderline"],
                "times_pgccd": timing.rounded(float(np.median(np.array(spent[name]) / np.array(spent["pgccd sweep"])))),
            }
        )
    true_a_body = timing.rounded(true_pairs / bodies)
    print(f"{arguments.bodies} swept spheres, {true_a_body} true pairs a body, one thread")
    results.table(
        [row | {"ms": row["ms"]["median"], "exact_test_ms": (row["exact_test_ms"] or {}).get("median")} for row in rows]
    )
    content = {"bodies": arguments.bodies, "true_pairs_a_body": true_a_body, "rows": rows}
    results.write("broad_phase", "cpu", content, arguments.out)


def _pgccd() -> broad_peers.Prepare:
    # Any mesh will do: only its bounding sphere, of radius 1, is looked at.
    tip = 3.0**-0.5
    mesh = pgccd.Mesh(
        [[tip, tip, tip], [tip, -tip, -tip], [-tip, tip, -tip], [-tip, -tip, tip]],
        [[0, 1, 2], [0, 3, 1], [0, 2, 3], [1, 3, 2]],
    )
    meshes = pgccd.MeshSet([mesh])

    def prepare(scene: MovingSpheres) -> Callable[[], Any]:
        count = len(scene.position_t0)
        upright = torch.tensor([[1.0, 0.0, 0.0, 0.0]], dtype=torch.float64).expand(count, 4)
        ends = [torch.from_numpy(position) for position in (scene.position_t0, scene.position_t1)]
        motion = pgccd.RigidMotion(ends[0], upright, ends[1], upright)
        bodies = pgccd.MovingBodies(pgccd.Scene(meshes, torch.zeros(count, dtype=torch.int32)), motion)

        def find() -> broad_peers.ReadPairs:
            pairs = pgccd.broad.sweep(bodies)
            return pairs.numpy

        return find

    return prepare


if __name__ == "__main__":
    main()
