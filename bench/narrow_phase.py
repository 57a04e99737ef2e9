"""Elementary queries with known answers: misses, false positives and microseconds, one CPU thread, beside ipctk's
methods.

Reads a folder of public ground truth (Wang et al. 2021, Belgrod et al. 2023), in NumPy files:
  queries/NAME.{vf,ee}.npz  points (n, 8, 3): four points at t0, then at t1; collides (n,) bool
  scenes/NAME.npz           vertices_t0, vertices_t1, faces, edges; vf_pairs, ee_pairs and *_collides (all true ones)

Three sorts of rows come out. "queries": the given queries of one file. "exact list": the listed pairs of a scene,
nearly all of which collide. "candidates": every pair of a scene whose swept boxes overlap; almost all of them are
free, and any reported contact that the exact list does not contain is a false positive.

Peers see at most `--peer-sample` queries of each row, drawn at random. How times are taken: see
bench/support/elementary.py.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import torch
from support import peers, results, timing
from support.elementary import Ipctk, Pgccd, Queries, peers_of
from support.overlapping_boxes import Boxes, between, within

_MICRO = 1e6
# Candidates solved in one timed call.
_CALL = 1 << 18


def main() -> None:
    """Runs the benchmark."""
    parser = results.parser(__doc__)
    parser.add_argument("--data", type=Path, required=True, help="folder with queries/ and scenes/")
    parser.add_argument("--tolerance", type=float, default=1e-6)
    parser.add_argument("--peer-sample", type=int, default=20_000)
    parser.add_argument("--single-sample", type=int, default=20_000, help="queries timed one by one")
    parser.add_argument("--skip-candidates", action="store_true")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    ipctk = peers.load_ipctk()

    rows: list[dict[str, Any]] = []
    for path in sorted(arguments.data.glob("queries/*.npz")):
        name, kind = path.stem.rsplit(".", 1)
        data = np.load(path)
        rows += known(name, kind, "queries", data["points"], data["collides"], ipctk, arguments)
    for path in sorted(arguments.data.glob("scenes/*.npz")):
        scene = dict(np.load(path))
        for kind in ("vf", "ee"):
            points = gather(scene, kind, scene[f"{kind}_pairs"])
            rows += known(path.stem, kind, "exact list", points, scene[f"{kind}_collides"], ipctk, arguments)
            if not arguments.skip_candidates:
                rows += candidates(path.stem, kind, scene, ipctk, arguments)
    totals = total(rows)

    print(f"tolerance {arguments.tolerance}, one thread, microseconds a query")
    columns = ("set", "rows", "kind", "method", "asked", "true", "missed", "false_positives", "unresolved")
    results.table([{key: row.get(key) for key in (*columns, "colliding_us", "free_us", "mean_us")} for row in rows])
    print()
    results.table(totals)
    content = {"tolerance": arguments.tolerance, "totals": totals, "rows": rows}
    results.write("narrow_phase", "cpu", content, arguments.out)


def known(
    name: str, kind: str, rows: str, points: Queries, truth: np.ndarray, ipctk: Any | None, arguments: Any
) -> list[dict[str, Any]]:
    """pgccd and the peers on queries whose answers are known."""
    head = {"set": name, "rows": rows, "kind": kind}
    random = np.random.default_rng(0)
    solver = Pgccd(kind, arguments.tolerance)
    collides, unresolved, _ = solver.batch(points)
    out = [
        head
        | {"method": solver.name}
        | errors(collides, truth)
        | {
            "unresolved": unresolved,
            "colliding_us": microseconds(solver.mean_seconds(points[truth])),
            "free_us": microseconds(solver.mean_seconds(points[~truth])),
        }
    ]
    sample = random.permutation(len(points))[: arguments.single_sample]
    out[0] |= percentiles(solver.single_seconds(points[sample]), truth[sample])
    for peer in peers_of(ipctk, kind, arguments.tolerance):
        sample = random.permutation(len(points))[: arguments.peer_sample]
        out.append(head | ask_peer(peer, points[sample], truth[sample]))
    return out


def candidates(
    name: str, kind: str, scene: dict[str, np.ndarray], ipctk: Any | None, arguments: Any
) -> list[dict[str, Any]]:
    """pgccd on all pairs with overlapping boxes, the peers on a sample of them."""
    head = {"set": name, "rows": "candidates", "kind": kind}
    solver = Pgccd(kind, arguments.tolerance)
    exact = keys(scene[f"{kind}_pairs"][scene[f"{kind}_collides"]])
    random = np.random.default_rng(0)
    asked = missed = false_positives = unresolved = found_true = 0
    seconds = 0.0
    share = []
    solver.batch(np.ones((1000, 8, 3)))
    for pairs in in_calls(overlapping(scene, kind)):
        pairs = pairs[random.permutation(len(pairs))]
        points = gather(scene, kind, pairs)
        truth = np.isin(keys(pairs), exact)
        collides, spent_budget, spent = solver.batch(points)
        seconds += spent
        asked += len(pairs)
        found_true += int(truth.sum())
        missed += int((truth & ~collides).sum())
        false_positives += int((~truth & collides).sum())
        unresolved += spent_budget
        # An equal share of every call, cut to size at the end.
        share.append((pairs[: arguments.peer_sample], truth[: arguments.peer_sample]))
    if found_true != len(exact):
        raise AssertionError(f"{name}: {len(exact) - found_true} truly colliding pairs are not among the candidates")
    row = head | {"method": solver.name, "asked": asked, "true": found_true, "missed": missed}
    row |= {"false_positives": false_positives, "unresolved": unresolved}
    out = [row | {"mean_us": microseconds(seconds / asked)}]

    pairs, truth = (np.concatenate(column) for column in zip(*share, strict=True))
    sample = random.permutation(len(pairs))[: arguments.peer_sample]
    points, truth = gather(scene, kind, pairs[sample]), truth[sample]
    out[0]["free_us"] = microseconds(solver.mean_seconds(points[~truth]))
    out[0] |= percentiles(solver.single_seconds(points), truth)
    for peer in peers_of(ipctk, kind, arguments.tolerance):
        answer = head | ask_peer(peer, points, truth)
        out.append(answer)
    return out


def ask_peer(peer: Ipctk, points: Queries, truth: np.ndarray) -> dict[str, Any]:
    """A peer's errors and times."""
    answers = peer.ask(points)
    free = ~answers.collides
    free_seconds = peer.mean_seconds_free(points[free])
    # What it finds colliding is timed query by query.
    spent = float(answers.seconds[answers.collides].sum()) + (free_seconds or 0.0) * int(free.sum())
    return (
        {"method": peer.name}
        | errors(answers.collides, truth)
        | {
            "colliding_us": microseconds(answers.seconds[truth].mean() if truth.any() else None),
            "free_us": microseconds(free_seconds),
            "mean_us": microseconds(spent / len(points)),
        }
        | percentiles(answers.seconds, truth)
    )


def errors(collides: np.ndarray, truth: np.ndarray) -> dict[str, int]:
    """Counts of wrong answers."""
    return {
        "asked": len(truth),
        "true": int(truth.sum()),
        "missed": int((truth & ~collides).sum()),
        "false_positives": int((~truth & collides).sum()),
    }


def percentiles(seconds: np.ndarray, truth: np.ndarray) -> dict[str, list[float]]:
    """Median and 99th percentile, in microseconds, of single colliding and free queries."""
    return {
        f"{sort}_single_us_p50_p99": [timing.rounded(x) for x in np.percentile(seconds[chosen] * _MICRO, [50, 99])]
        for sort, chosen in (("colliding", truth), ("free", ~truth))
        if chosen.any()
    }


def total(rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Sums and means, weighted by the number of queries, over files: one row for each sort and method."""
    sums: dict[tuple[str, str], dict[str, float]] = {}
    for row in rows:
        entry = sums.setdefault((row["rows"], row["method"]), {})
        free = row["asked"] - row["true"]
        for key in ("asked", "true", "missed", "false_positives"):
            entry[key] = entry.get(key, 0) + row[key]
        for key, weight in (("colliding_us", row["true"]), ("free_us", free), ("mean_us", row["asked"])):
            if row.get(key) is not None:
                entry[key] = entry.get(key, 0.0) + weight * row[key]
                entry[key + "_weight"] = entry.get(key + "_weight", 0) + weight
    out = []
    for (sort, method), entry in sums.items():
        means = {
            key: timing.rounded(entry[key] / entry[key + "_weight"]) if entry.get(key + "_weight") else None
            for key in ("colliding_us", "free_us", "mean_us")
        }
        counts = {key: int(entry[key]) for key in ("asked", "true", "missed", "false_positives")}
        out.append({"rows": sort, "method": method} | counts | means)
    return out


def overlapping(scene: dict[str, np.ndarray], kind: str) -> Iterator[np.ndarray]:
    """Candidate pairs (p, 2) of a scene, in pieces."""
    ends = scene["vertices_t0"], scene["vertices_t1"]
    if kind == "ee":
        yield from within(Boxes.swept(*ends, scene["edges"]))
    else:
        vertices = np.arange(len(ends[0]))[:, None]
        yield from between(Boxes.swept(*ends, vertices), Boxes.swept(*ends, scene["faces"]))


def in_calls(pieces: Iterator[np.ndarray]) -> Iterator[np.ndarray]:
    """The same pairs in pieces of at most, and mostly, `_CALL`."""
    waiting: list[np.ndarray] = []
    for piece in pieces:
        waiting.append(piece)
        if sum(map(len, waiting)) >= _CALL:
            joined = np.concatenate(waiting)
            whole = len(joined) // _CALL * _CALL
            yield from (joined[k : k + _CALL] for k in range(0, whole, _CALL))
            waiting = [joined[whole:]]
    if sum(map(len, waiting)):
        yield np.concatenate(waiting)


def gather(scene: dict[str, np.ndarray], kind: str, pairs: np.ndarray) -> Queries:
    """Points (p, 8, 3) of pairs."""
    if kind == "vf":
        corners = np.concatenate([pairs[:, :1], scene["faces"][pairs[:, 1]]], axis=1)
    else:
        corners = np.concatenate([scene["edges"][pairs[:, 0]], scene["edges"][pairs[:, 1]]], axis=1)
    return np.concatenate([scene["vertices_t0"][corners], scene["vertices_t1"][corners]], axis=1)


def keys(pairs: np.ndarray) -> np.ndarray:
    """(p,) int64, one number a pair. Edge pairs are meant without order."""
    return pairs[:, 0].astype(np.int64) * (1 << 32) + pairs[:, 1]


def microseconds(seconds: float | None) -> float | None:
    """Rounded; None stays None."""
    return None if seconds is None else timing.rounded(seconds * _MICRO)


if __name__ == "__main__":
    main()
