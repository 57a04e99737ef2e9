"""Every colliding vertex-face and edge-edge pair of public simulation frame pairs, self-collisions included.

Reads a folder of public ground truth (Belgrod et al. 2023), in NumPy files:
  scenes/NAME.npz  vertices_t0, vertices_t1 (V, 3), faces (F, 3), edges (E, 2); vf_pairs, ee_pairs (k, 2) and
                   *_collides (k,): all truly colliding pairs, and some others

Each scene is one body that deforms and collides with itself. Vertices are in device memory before the clock starts,
contacts are there when it stops. The mesh and the shape of its hierarchy, which last for all frames of a simulation,
are made before. What is found is compared with the list: any other contact is a false positive.

Without --data nothing is measured.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

import numpy as np
import torch
from support import results, timing

import pgccd

# "all": a toi for every colliding pair; "earliest": the one toi of the whole step.
_REPORTS: tuple[pgccd.narrow.Report, ...] = ("all", "earliest")


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
    rows = []
    for path in sorted(arguments.data.glob("scenes/*.npz")):
        with np.load(path) as file:
            frames = dict(file)
        rows += [measure(path.stem, frames, report, arguments) for report in _REPORTS]
    results.table([flat(row) for row in rows])
    content = {"tolerance": arguments.tolerance, "min_separation": arguments.min_separation, "rows": rows}
    results.write("frame_pairs", arguments.device, content, arguments.out)


def measure(
    name: str, frames: dict[str, np.ndarray], report: pgccd.narrow.Report, arguments: argparse.Namespace
) -> dict[str, Any]:
    """Times and counts of one frame pair."""
    mesh = pgccd.Mesh(frames["vertices_t0"], frames["faces"])
    scene = pgccd.Scene([mesh], device=arguments.device, self_collision=True)
    ends = [torch.from_numpy(frames[f"vertices_{end}"]).to(scene.device) for end in ("t0", "t1")]
    options = {"tolerance": arguments.tolerance}

    def detect() -> pgccd.Contacts:
        return pgccd.detect(scene, pgccd.VertexMotion(*ends), report, arguments.min_separation, **options)

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
        "scene": name,
        "report": report,
        "vertices": len(mesh.vertices),
        "edges": len(mesh.edges),
        "faces": len(mesh.faces),
        "ms": timing.summary(spent),
        "stage_ms": {stage: timing.summary(values)["median"] for stage, values in stages.items()},
        **counts,
        "unresolved": hits.stats.unresolved,
        "earliest_toi": float(hits.toi.min()) if len(hits) else None,
        **(errors(mesh, frames, hits) if report == "all" and arguments.min_separation == 0.0 else {}),
    }


def errors(mesh: pgccd.Mesh, frames: dict[str, np.ndarray], hits: pgccd.Contacts) -> dict[str, int]:
    """What is missing of the truly colliding pairs, and what was found beside them."""
    # Scenes number edges otherwise than meshes do.
    weights = np.array([len(frames["vertices_t0"]), 1])
    of_mesh, of_scene = (np.sort(edges, axis=1) @ weights for edges in (mesh.edges.long().numpy(), frames["edges"]))
    edge_pairs = np.sort(np.searchsorted(of_mesh, of_scene)[frames["ee_pairs"]], axis=1)[frames["ee_collides"]]
    face_pairs = frames["vf_pairs"][frames["vf_collides"]]
    true = np.concatenate([keys(pgccd.VF_AB, face_pairs), keys(pgccd.EE, edge_pairs)])
    found = keys(hits.kind.cpu().numpy(), hits.features.cpu().numpy())
    return {
        "true": len(true),
        "missed": len(np.setdiff1d(true, found)),
        "false_positives": len(np.setdiff1d(found, true)),
    }


def keys(kind: int | np.ndarray, features: np.ndarray) -> np.ndarray:
    """(k,) int64, one number a feature pair (k, 2)."""
    first, second = features.astype(np.int64).T
    return (np.int64(1) << 60) * kind + (first << 30) + second


def flat(row: dict[str, Any]) -> dict[str, Any]:
    """A row of the table."""
    counts = ("pcs", "node_tests", "candidates", "contacts", "unresolved", "true", "missed", "false_positives")
    return {
        "scene": row["scene"],
        "report": row["report"],
        "ms": row["ms"]["median"],
        **{f"{stage} ms": part for stage, part in row["stage_ms"].items()},
        **{count: row.get(count) for count in counts},
    }


if __name__ == "__main__":
    main()
