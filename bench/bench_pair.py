"""Exact first toi of two near bodies of 700 triangles each, one CPU thread, beside other programs on the same pairs.

The pairs come from the standard world in full swing: bodies whose spheres meet, half of them with meshes that stay
apart and half with meshes that collide (the mixture is by choice; in the world about one in twenty collides). Every
pair is timed once by every contender, in turn, after warm-up. pgccd is timed twice: `detect` on one pair a call,
where the calls through Python are most of the time, and `detect` on all pairs in one call.

Who misses: on rigid paths pgccd's answer is compared with python-fcl, which moves bodies in the same way. ipctk knows
straight paths only and is compared with pgccd on those.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from support import near_pairs, pair_peers, results, timing

import pgccd

# Tois further apart than this part of the step are counted as different.
_DIFFERENT_TOI = 1e-3


def main() -> None:
    """Runs the benchmark."""
    parser = results.parser(__doc__)
    parser.add_argument("--free", type=int, default=200, help="pairs that stay apart")
    parser.add_argument("--colliding", type=int, default=200, help="pairs that collide")
    parser.add_argument("--warm-up", type=int, default=5, help="pairs of each sort that are not counted")
    parser.add_argument("--tolerance", type=float, default=1e-6, help="in SBV radii, for all contenders")
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    skipped = arguments.warm_up
    pairs = near_pairs.collect(arguments.free + skipped, arguments.colliding + skipped, arguments.seed)
    tolerance = arguments.tolerance * pairs.mesh.radius
    # Warm-up pairs first, then both sorts mixed.
    free, colliding = (
        torch.arange(arguments.free + skipped),
        arguments.free + skipped + torch.arange(arguments.colliding + skipped),
    )
    measured = torch.cat([free[skipped:], colliding[skipped:]])
    measured = measured[torch.randperm(len(measured), generator=torch.Generator().manual_seed(arguments.seed))]
    pairs = pairs[torch.cat([free[:skipped], colliding[:skipped], measured])]

    contenders = {
        "pgccd, one pair a call": _pgccd(pairs, "rigid", tolerance),
        "pgccd straight paths, one pair a call": _pgccd(pairs, "linear", tolerance),
        **pair_peers.available(pairs, tolerance),
    }
    answers, spent = _run(contenders, len(pairs), 2 * skipped)
    counted = pairs[2 * skipped :]
    exact = {"rigid": answers["pgccd, one pair a call"], "linear": answers["pgccd straight paths, one pair a call"]}
    hit = np.isfinite(exact["rigid"])

    rows = [_together(counted, path, tolerance, hit) for path in ("rigid", "linear")]
    for name, toi in answers.items():
        path = "linear" if "ipctk" in name or "straight" in name else "rigid"
        row = _row(name, path, spent[name], hit)
        if not name.startswith("pgccd"):
            row |= _compare(toi, exact[path])
        rows.append(row)
    reference = spent["pgccd, one pair a call"]
    for row in rows:
        if row["method"] in spent:
            row["times_pgccd"] = timing.rounded(float(np.median(spent[row["method"]] / reference)))

    keys = ("method", "path", "ms", "free_ms", "colliding_ms", "missed", "invented", "other_toi", "later_toi")
    print(f"{len(counted)} pairs, {int(hit.sum())} of them collide, {len(pairs.mesh.faces)} triangles each, one thread")
    results.table([{key: _median(row.get(key)) for key in keys} for row in rows])
    content = {
        "pairs": len(counted),
        "colliding": int(hit.sum()),
        "triangles": len(pairs.mesh.faces),
        "tolerance": tolerance,
        "rows": rows,
    }
    results.write("pair", "cpu", content, arguments.out)


def _run(
    contenders: dict[str, pair_peers.Prepare], count: int, warm_up: int
) -> tuple[dict[str, np.ndarray], dict[str, np.ndarray]]:
    """Tois (inf: no collision) and seconds of all contenders on all pairs but the first `warm_up`."""
    answers = {name: np.full(count, np.inf) for name in contenders}
    spent = {name: np.zeros(count) for name in contenders}
    names = list(contenders)
    for pair in range(count):
        shift = pair % len(names)
        for name in names[shift:] + names[:shift]:
            spent[name][pair], toi = timing.seconds(contenders[name](pair))
            answers[name][pair] = np.inf if toi is None else toi
    return tuple({name: values[warm_up:] for name, values in columns.items()} for columns in (answers, spent))


def _pgccd(pairs: near_pairs.Pairs, path: str, tolerance: float) -> pair_peers.Prepare:
    scene = pairs[:1].scene()

    def prepare(row: int) -> pair_peers.FirstToi:
        motion = pairs[row : row + 1].motion(path)

        def first_toi() -> float | None:
            hits = pgccd.detect(scene, motion, report="first", tolerance=tolerance)
            return float(hits.toi[0]) if len(hits) else None

        return first_toi

    return prepare


def _together(pairs: near_pairs.Pairs, path: str, tolerance: float, hit: np.ndarray) -> dict[str, Any]:
    """All pairs in one call, its time divided by their number; free and colliding ones also apart."""
    spent: dict[str, list[float]] = {}
    random = torch.Generator().manual_seed(0)
    sorts = {"ms": torch.arange(len(pairs)), "free_ms": torch.from_numpy(np.flatnonzero(~hit))}
    sorts["colliding_ms"] = torch.from_numpy(np.flatnonzero(hit))
    for index in range(23):
        for sort, rows in sorts.items():
            if len(rows) == 0:
                continue
            shuffled = pairs[rows[torch.randperm(len(rows), generator=random)]]
            scene, motion = shuffled.scene(), shuffled.motion(path)
            duration, _ = timing.seconds(
                lambda scene=scene, motion=motion: pgccd.detect(scene, motion, report="first", tolerance=tolerance)
            )
            if index >= 3:
                spent.setdefault(sort, []).append(duration / len(rows))
    name = "pgccd, all pairs in one call" if path == "rigid" else "pgccd straight paths, all pairs in one call"
    return {"method": name, "path": path} | {sort: timing.summary(part) for sort, part in spent.items()}


def _row(name: str, path: str, spent: np.ndarray, hit: np.ndarray) -> dict[str, Any]:
    row: dict[str, Any] = {"method": name, "path": path, "ms": timing.summary(list(spent))}
    for sort, chosen in (("free_ms", ~hit), ("colliding_ms", hit)):
        if chosen.any():
            row[sort] = timing.summary(list(spent[chosen]))
    return row


def _compare(toi: np.ndarray, exact: np.ndarray) -> dict[str, int]:
    """How a peer's answers differ from pgccd's on the same paths."""
    both = np.isfinite(toi) & np.isfinite(exact)
    difference = toi[both] - exact[both]
    return {
        "missed": int((np.isfinite(exact) & ~np.isfinite(toi)).sum()),
        "invented": int((np.isfinite(toi) & ~np.isfinite(exact)).sum()),
        "other_toi": int((np.abs(difference) > _DIFFERENT_TOI).sum()),
        "later_toi": int((difference > _DIFFERENT_TOI).sum()),
    }


def _median(value: Any) -> Any:
    return value["median"] if isinstance(value, dict) else value


if __name__ == "__main__":
    main()
