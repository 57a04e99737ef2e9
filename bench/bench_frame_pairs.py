"""Every colliding vertex-face and edge-edge pair of public simulation frame pairs, self-collisions included.

Reads a folder of public ground truth; see bench/support/frame_pairs.py for its format. Each scene is one deforming body
that collides with itself. Times are from vertices in device memory to contacts in device memory. The mesh and the
topology of its hierarchy, which are constant over a simulation, are not timed. Contacts are compared with the list:
those not in it are "extra", false positives. Edges that pass through faces at the start, which the list does not hold,
are counted apart ("crossings"); with initial="assume_free" they are not looked for.

Without --data it does nothing.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

import torch
from support import frame_pairs, results, timing

import pgccd
from pgccd.search.checks import Initial

# "all": a toi for every colliding pair; "earliest": the first toi of the whole step.
_REPORTS: tuple[pgccd.narrow.Report, ...] = ("all", "earliest")
_INITIAL: tuple[Initial, ...] = ("report", "assume_free")


def main() -> None:
    """Runs the benchmark."""
    parser = results.parser(__doc__)
    parser.add_argument("--data", type=Path, help="folder with scenes/")
    parser.add_argument("--device", default="cpu", help="cpu or cuda")
    parser.add_argument("--tolerance", type=float, default=1e-6)
    parser.add_argument("--min-separation", type=float, default=0.0)
    parser.add_argument("--rounds", type=int, default=20, help="calls timed")
    parser.add_argument("--warm-up", type=int, default=3)
    parser.add_argument("--threads", type=int, help="CPU threads (default: torch's)")
    arguments = parser.parse_args()
    if arguments.threads:
        torch.set_num_threads(arguments.threads)
    if arguments.data is None:
        print("--data names no folder: nothing to measure")
        return
    rows = [
        measure(pair, report, initial, arguments)
        for pair in frame_pairs.load(arguments.data)
        for report in _REPORTS
        for initial in _INITIAL
    ]
    results.table([flat(row) for row in rows])
    content = {"tolerance": arguments.tolerance, "min_separation": arguments.min_separation, "rows": rows}
    results.write("frame_pairs", arguments.device, content, arguments.out)


def measure(
    pair: frame_pairs.FramePair, report: pgccd.narrow.Report, initial: Initial, arguments: argparse.Namespace
) -> dict[str, Any]:
    """Times and counts of one frame pair."""
    scene, motion, mesh = pair.scene(arguments.device), pair.motion(arguments.device), pair.mesh
    options = {"tolerance": arguments.tolerance, "min_separation": arguments.min_separation, "initial": initial}

    def detect() -> pgccd.Contacts:
        return pgccd.detect(scene, motion, report, **options)

    spent: list[float] = []
    stages: dict[str, list[float]] = {}
    for index in range(arguments.warm_up + arguments.rounds):
        duration, hits = timing.seconds(detect, scene.device)
        if index < arguments.warm_up:
            continue
        spent.append(duration)
        for stage, part in hits.stats.seconds.items():
            stages.setdefault(stage, []).append(part)
    counts = {count: getattr(hits.stats, count) for count in ("pcs", "node_tests", "candidates", "contacts")}
    return {
        "scene": pair.name,
        "report": report,
        "initial": initial,
        "vertices": len(mesh.vertices),
        "edges": len(mesh.edges),
        "faces": len(mesh.faces),
        "ms": timing.summary(spent),
        "stage_ms": {stage: timing.summary(values)["median"] for stage, values in stages.items()},
        "graph_ms": as_graph(pair, report, options, arguments.rounds) if scene.device.type == "cuda" else None,
        **counts,
        "unresolved": hits.stats.unresolved,
        "earliest_toi": float(hits.toi.min()) if len(hits) else None,
        **(pair.errors(hits) if report == "all" and arguments.min_separation == 0.0 else {}),
    }


def as_graph(
    pair: frame_pairs.FramePair, report: pgccd.narrow.Report, options: dict[str, Any], rounds: int
) -> dict[str, Any]:
    """Milliseconds as a CUDA graph, copies of the vertices included; it must find the contacts of `detect`."""
    scene, motion = pair.scene("cuda"), pair.motion("cuda")
    expected = pgccd.detect(scene, motion, report, **options)
    captured = pgccd.CapturedDetection(scene, motion, report, **options)
    spent = [timing.seconds(lambda: captured(motion), scene.device)[0] for _ in range(1 + rounds)][1:]
    found = captured.contacts()
    assert isinstance(expected, pgccd.Contacts) and isinstance(found, pgccd.Contacts)
    if not (torch.equal(found.features, expected.features) and torch.equal(found.toi, expected.toi)):
        raise SystemExit(f"{pair.name}: the graph's contacts differ")
    return timing.summary(spent)


def flat(row: dict[str, Any]) -> dict[str, Any]:
    """The row as table columns."""
    counts = ("pcs", "node_tests", "candidates", "contacts", "unresolved", "true", "missed", "extra", "crossings")
    return {
        "scene": row["scene"],
        "report": row["report"],
        "initial": row["initial"],
        "ms": row["ms"]["median"],
        "as graph ms": row["graph_ms"]["median"] if row["graph_ms"] else None,
        **{f"{stage} ms": part for stage, part in row["stage_ms"].items()},
        **{count: row.get(count) for count in counts},
    }


if __name__ == "__main__":
    main()
