"""As `bulk`, for rigid arcs: many body pairs of two meshes, with one candidate each, through the narrow phase."""

from __future__ import annotations

import time
from collections.abc import Iterable, Iterator

import numpy as np
import torch
from oracle import arcs, distance, rigid
from oracle.batch_paths import ArcPaths, Turning, first_count
from oracle.search import CLOSE

import pgccd
from support.bulk import Answers, Tally, compare, conditioning

QUERIES = 2048
FACES = 200
UNIT = 2.0**-53


def soup(rng: np.random.Generator, size: float) -> pgccd.Mesh:
    """Random triangles, a quarter of them slivers with aspect ratios up to thousands."""
    middle = rng.normal(size=(FACES, 1, 3))
    corners = middle + 0.7 * rng.normal(size=(FACES, 3, 3))
    # A quarter get their last corner close to the edge between the first two.
    thin, width = corners[::4], 10.0 ** -rng.uniform(1, 3.5, (len(corners[::4]), 1))
    along = rng.random((len(thin), 1)) * (thin[:, 1] - thin[:, 0])
    corners[::4, 2] = thin[:, 0] + along + width * rng.normal(size=(len(thin), 3))
    return pgccd.Mesh(size * corners.reshape(-1, 3), np.arange(3 * FACES).reshape(-1, 3))


def _corners(mesh: pgccd.Mesh, feature: np.ndarray, what: str) -> np.ndarray:
    vertices = mesh.vertices.numpy()
    if what == "vertex":
        return vertices[feature][:, None]
    return vertices[(mesh.faces if what == "face" else mesh.edges).numpy()[feature]]


# Of the first and the second primitive; VF_BA lists body i's face first, the oracle j's vertex.
FEATURES = {
    pgccd.Kind.VF_AB: ("vertex", "face"),
    pgccd.Kind.VF_BA: ("face", "vertex"),
    pgccd.Kind.EE: ("edge", "edge"),
}


def solve_candidates(
    meshes: list[pgccd.Mesh],
    bodies: tuple[Turning, Turning],
    kind: int,
    features: np.ndarray,
    separation: float,
    tolerance: float,
    device: torch.device | str,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Status, toi and coordinates (n, ...); body pair k is bodies 2 k and 2 k + 1."""
    n = len(features)
    columns = [
        np.stack(both, axis=1).reshape(2 * n, -1)
        for both in zip(*((b.position_t0, b.orientation_t0, b.position_t1, b.rotation) for b in bodies), strict=True)
    ]
    position, orientation, end, rotation = (torch.from_numpy(c).to(device) for c in columns)
    motion = pgccd.RigidMotion.from_velocity(position, orientation, 0.0 * position, rotation, dt=1.0)
    motion.position_t1 = end  # exactly these bits
    scene = pgccd.Scene(meshes, torch.arange(2, dtype=torch.int32).repeat(n), device=device)
    moving = pgccd.MovingBodies.of(scene, motion)
    pairs = torch.arange(2 * n, device=device).view(n, 2)
    rows = np.column_stack([np.arange(n), np.full(n, int(kind)), features]).astype(np.int32)
    found = pgccd.narrow.find_contacts(moving, pairs, torch.from_numpy(rows).to(device), "all", separation, tolerance)
    pair, _, _, its_status, its_toi, its_coordinates, *_ = (c.cpu().numpy() for c in found)
    status, toi, coordinates = np.full(n, pgccd.Status.FREE), np.full(n, np.inf), np.zeros((n, 2))
    status[pair], toi[pair], coordinates[pair] = its_status, its_toi, its_coordinates
    return status, toi, coordinates


def check_arcs(
    rng: np.random.Generator, plan: arcs.Plan, kind: int, count: int, device: torch.device | str, name: str
) -> Tally:
    """One call's worth of queries."""
    began = time.perf_counter()
    size = float(rng.choice([1.0, 2.0**-40, 2.0**27], p=[0.6, 0.2, 0.2]))
    separation = size * 10.0 ** -rng.uniform(1, 4) if rng.random() < 0.4 else 0.0
    tolerance = size * 10.0 ** -rng.uniform(3, 13)
    meshes = [soup(rng, size), soup(rng, size)]
    counts = {"vertex": 3 * FACES, "face": FACES, "edge": len(meshes[0].edges)}
    what = FEATURES[kind]
    features = np.stack([rng.integers(0, counts[w], count) for w in what], axis=1)
    parts = [_corners(m, features[:, k], what[k]) for k, m in enumerate(meshes)]
    swapped, is_face = kind == pgccd.Kind.VF_BA, kind != pgccd.Kind.EE
    points = np.concatenate(parts[::-1] if swapped else parts, axis=1)
    clearance = separation + tolerance * float(rng.choice([-0.01, 1.1, 2.0, 10.0]))
    first, second = arcs.motions(rng, plan, points, is_face, size, clearance)
    truth, _ = arcs.decide(points, first, second, is_face, separation)
    bodies = (second, first) if swapped else (first, second)
    status, toi, coordinates = solve_candidates(meshes, bodies, kind, features, separation, tolerance, device)
    paths = ArcPaths(points, first, second, is_face)
    centres = [np.abs(second.position_t0 - first.position_t0), np.abs(second.position_t1 - first.position_t1)]
    turned = np.maximum(*(np.linalg.norm(b.rotation, axis=1) for b in bodies))
    radius = max(m.radius for m in meshes)
    rounding = UNIT * ((8192 + 256 * turned) * radius + 1024 * np.max(centres, axis=(0, 2)))
    t = np.where(status == pgccd.Status.FREE, 0.0, toi)
    at_toi = np.moveaxis(paths.over(np.arange(count), t, t).control[1] / paths.scale, 2, 0)
    label = (
        f"{name}, {pgccd.Kind.names()[kind]}, size {size:.3g}, separation {separation:.3g}, tolerance {tolerance:.3g}"
    )
    allowed = separation + tolerance + rounding + 64 * UNIT * conditioning(at_toi, is_face)

    def is_near(row: int) -> bool:
        owners = [first] * first_count(is_face) + [second] * (4 - first_count(is_face))
        at = [
            rigid.position(x, b.position_t0[row], b.orientation_t0[row], b.position_t1[row], b.rotation[row], toi[row])
            for x, b in zip(points[row], owners, strict=True)
        ]
        return bool(distance.distance_high_precision(at, is_face) <= allowed[row])

    tally = compare(truth, Answers(status, toi, coordinates, allowed, allowed), paths, at_toi, label, is_near)
    tally.undecided, tally.seconds = int((truth.status == CLOSE).sum()), time.perf_counter() - began
    return tally


def arcs_checked(
    seed: int, rounds: Iterable[int], device: torch.device | str = "cpu", share: int = 1
) -> Iterator[tuple[str, Tally]]:
    """All plans once per round with each kind of feature pair; each call has 1 / `share` of its queries."""
    for turn in rounds:
        for number, (name, plan) in enumerate(arcs.PLANS.items()):
            for kind in FEATURES:
                rng = np.random.default_rng([seed, turn, number, int(kind)])
                label = f"{name}, seed [{seed}, {turn}, {number}, {int(kind)}]"
                yield name, check_arcs(rng, plan, kind, max(QUERIES // share, 1), device, label)
