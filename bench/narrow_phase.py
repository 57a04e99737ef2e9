"""Elementary queries with known results: misses, false positives and microseconds, one CPU thread, compared with
ipctk's methods.

Reads a folder of public ground truth (Wang et al. 2021, Belgrod et al. 2023), in NumPy files:
  queries/NAME.{vf,ee}.npz  points (n, 8, 3): four points at t0, then at t1; collides (n,) bool
  scenes/NAME.npz           vertices_t0, vertices_t1, faces, edges; vf_pairs, ee_pairs and *_collides (all true ones)

Three kinds of rows are written. "queries": the given queries of one file. "exact list": the listed pairs of a scene,
nearly all of which collide. "candidates": every pair of a scene whose swept boxes overlap; almost all of them are free,
and any reported contact that the exact list does not contain is a false positive.

"pgccd float32" takes the points rounded to float32. Its reference is the float64 result on the rounded points, which
are exact in float64: "missed" counts float64 touches that float32 reports as free, and "true" may differ from the row
above.

"settled_by_bits" is the share of queries that each arithmetic settled: 24 significant bits (float32), 53 (float64) or
106 (pairs of float64). "slowest" is the slowest of the queries timed individually, given by its row in the file, or by
its feature indices if it has no row.

Peers get at most `--peer-sample` random queries of each row. Timing method: see bench/support/elementary.py.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import torch
from support import peers, results
from support.elementary import SIGNIFICANT_BITS, Ipctk, Pgccd, Queries, peers_of, pgccd_methods
from support.elementary_rows import Tally, errors, microseconds, percentiles, slowest, slowest_of_all, total
from support.overlapping_boxes import Boxes, between, within

# Candidates per timed call.
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
    counts = ("method", "asked", "true", "missed", "false_positives")
    times = ("colliding_us", "free_us", "mean_us")
    columns = ("set", "rows", "kind", *counts, "unresolved", *times, "p99_over_p50")
    results.table([flat(row, columns) for row in rows])
    print()
    results.table([flat(row, ("rows", *counts, *times)) for row in totals])
    print()
    worst = slowest_of_all(rows)
    results.table(worst)
    content = {"tolerance": arguments.tolerance, "slowest": worst, "totals": totals, "rows": rows}
    results.write("narrow_phase", "cpu", content, arguments.out)


def flat(row: dict[str, Any], columns: tuple[str, ...]) -> dict[str, Any]:
    """Selected columns of a row, with nested parts flattened."""
    settled = row.get("settled_by_bits", {})
    shares = {f"{bits} bits": settled.get(str(bits)) for bits in SIGNIFICANT_BITS}
    return {key: row.get(key) for key in columns} | shares | {"slowest_us": row.get("slowest", {}).get("us")}


def known(
    name: str, kind: str, rows: str, points: Queries, truth: np.ndarray, ipctk: Any | None, arguments: Any
) -> list[dict[str, Any]]:
    """Rows of pgccd and the peers on queries with known results."""
    head = {"set": name, "rows": rows, "kind": kind}
    random = np.random.default_rng(0)
    sample = random.permutation(len(points))[: arguments.single_sample]
    out = []
    for solver in pgccd_methods(kind, arguments.tolerance):
        right = solver.truth(points, truth)
        tally = Tally()
        tally.add(solver.batch(points), right)
        means = {
            "colliding_us": microseconds(solver.mean_seconds(points[right])),
            "free_us": microseconds(solver.mean_seconds(points[~right])),
        }
        single = one_by_one(solver, points[sample], right[sample], sample)
        out.append(head | {"method": solver.name} | tally.row() | means | single)
    for peer in peers_of(ipctk, kind, arguments.tolerance):
        sample = random.permutation(len(points))[: arguments.peer_sample]
        out.append(head | ask_peer(peer, points[sample], truth[sample]))
    return out


def candidates(
    name: str, kind: str, scene: dict[str, np.ndarray], ipctk: Any | None, arguments: Any
) -> list[dict[str, Any]]:
    """Rows of pgccd on all pairs with overlapping boxes, and of the peers on a sample."""
    head = {"set": name, "rows": "candidates", "kind": kind}
    solvers = pgccd_methods(kind, arguments.tolerance)
    tallies = [Tally() for _ in solvers]
    exact = keys(scene[f"{kind}_pairs"][scene[f"{kind}_collides"]])
    random = np.random.default_rng(0)
    share = []
    for solver in solvers:
        solver.batch(np.ones((1000, 8, 3)))
    for pairs in in_calls(overlapping(scene, kind)):
        pairs = pairs[random.permutation(len(pairs))]
        points = gather(scene, kind, pairs)
        truth = np.isin(keys(pairs), exact)
        for solver, tally in zip(solvers, tallies, strict=True):
            tally.add(solver.batch(points), solver.truth(points, truth))
        # An equal share of every call, trimmed at the end.
        share.append((pairs[: arguments.peer_sample], truth[: arguments.peer_sample]))
    if tallies[0].true != len(exact):
        raise AssertionError(
            f"{name}: {len(exact) - tallies[0].true} truly colliding pairs are not among the candidates"
        )

    pairs, truth = (np.concatenate(column) for column in zip(*share, strict=True))
    sample = random.permutation(len(pairs))[: arguments.peer_sample]
    pairs, truth = pairs[sample], truth[sample]
    points = gather(scene, kind, pairs)
    out = []
    for solver, tally in zip(solvers, tallies, strict=True):
        right = solver.truth(points, truth)
        means = {"mean_us": tally.mean_us, "free_us": microseconds(solver.mean_seconds(points[~right]))}
        out.append(head | {"method": solver.name} | tally.row() | means | one_by_one(solver, points, right, pairs))
    for peer in peers_of(ipctk, kind, arguments.tolerance):
        out.append(head | ask_peer(peer, points, truth))
    return out


def one_by_one(solver: Pgccd, points: Queries, truth: np.ndarray, names: np.ndarray) -> dict[str, Any]:
    """Times of single queries: percentiles and the slowest."""
    seconds = solver.single_seconds(points)
    return percentiles(seconds, truth) | {"slowest": slowest(seconds, solver.batch(points), names)}


def ask_peer(peer: Ipctk, points: Queries, truth: np.ndarray) -> dict[str, Any]:
    """A peer's errors and times."""
    answers = peer.ask(points)
    free = ~answers.collides
    free_seconds = peer.mean_seconds_free(points[free])
    # Colliding queries are timed one by one.
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


def overlapping(scene: dict[str, np.ndarray], kind: str) -> Iterator[np.ndarray]:
    """Candidate pairs (p, 2) of a scene, in chunks."""
    ends = scene["vertices_t0"], scene["vertices_t1"]
    if kind == "ee":
        yield from within(Boxes.swept(*ends, scene["edges"]))
    else:
        vertices = np.arange(len(ends[0]))[:, None]
        yield from between(Boxes.swept(*ends, vertices), Boxes.swept(*ends, scene["faces"]))


def in_calls(pieces: Iterator[np.ndarray]) -> Iterator[np.ndarray]:
    """The same pairs regrouped in chunks of at most, and mostly, `_CALL`."""
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
    """One int64 key (p,) per pair. Edge pairs are unordered."""
    return pairs[:, 0].astype(np.int64) * (1 << 32) + pairs[:, 1]


if __name__ == "__main__":
    main()
