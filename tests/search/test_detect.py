"""detect() on rigid arcs and straight paths: it reports true contacts, and its reports agree with one another."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
from support.cases import few_and_many
from support.reports import detected
from support.shapes import Bodies, approaching, on_the_surface
from support.truth import (
    assert_linear_rows_close,
    assert_nothing_missed,
    assert_rigid_pair_agrees,
    end_positions,
    linear_truth,
    rows_of,
)

import pgccd

COLUMNS = ("pairs", "toi", "kind", "features", "coordinates", "point", "normal", "status")


def same_bits(a: pgccd.Contacts, b: pgccd.Contacts) -> bool:
    """Are all columns equal?"""
    pairs = [(getattr(a, c), getattr(b, c)) for c in COLUMNS]
    return all((x is None and y is None) or torch.equal(x, y) for x, y in pairs)


def tolerance_of(bodies: Bodies, i: int = 0, j: int = 1) -> float:
    """The default: 1e-6 of the smaller SBV radius."""
    return 1e-6 * min(bodies.meshes[i].radius, bodies.meshes[j].radius)


def check_rigid(bodies: Bodies, device: torch.device, separation: float = 0.0) -> int:
    """Checks against brute force; returns the number of contacts."""
    hits = pgccd.detect(bodies.scene(device), bodies.motion(device=device), "all", separation)
    contacts = assert_rigid_pair_agrees(hits, bodies, separation=separation)
    assert hits.stats.unresolved == int((hits.status == pgccd.Status.UNRESOLVED).sum())
    assert hits.stats.unresolved <= len(hits) // 50
    return contacts


@pytest.mark.parametrize("turn", [0.05, 1.0, 3.0, 8.0])
@few_and_many("seeds", 1, 3)
def test_all_contacts_of_rigid_arcs(device: torch.device, turn: float, seeds: int) -> None:
    shapes = (0, 1) if turn < 5 else (0, 0)
    bodies = [approaching(np.random.default_rng([1, int(turn), seed]), shapes, turn=turn) for seed in range(seeds)]
    assert sum(check_rigid(b, device) for b in bodies) > 3 * seeds


@pytest.mark.parametrize("scale", [1e-6, 1e6])
def test_scales(device: torch.device, scale: float) -> None:
    assert check_rigid(approaching(np.random.default_rng(2), (0, 1), (scale, scale), closeness=0.7), device) > 0


def test_mixed_sizes_and_separation(device: torch.device) -> None:
    assert check_rigid(on_the_surface(np.random.default_rng(3), 100.0), device) > 0
    bodies = approaching(np.random.default_rng(4), (0, 0), closeness=0.6)
    counts = [check_rigid(bodies, device, separation) for separation in (0.0, 0.01, 0.3)]
    assert counts == sorted(counts) and counts[0] < counts[2]


@pytest.mark.parametrize("offset", [0.0, 1e8])
def test_all_contacts_of_straight_paths(device: torch.device, offset: float) -> None:
    for seed in range(2):
        bodies = approaching(np.random.default_rng([5, seed]), (0, 1), turn=1.5, closeness=0.8, offset=offset)
        # Relative to the first body, so that the positions given to the oracle are not rounded far from the origin.
        ends = [end_positions(bodies, b, seen_from=0) for b in (0, 1)]
        faces = [m.faces.long().numpy() for m in bodies.meshes]
        for separation in (0.0, 0.05):
            hits = pgccd.detect(bodies.scene(device), bodies.motion("linear", device), "all", separation)
            rows, truth = rows_of(hits), linear_truth(ends, faces, separation)
            assert len(truth.contacts) > 0
            assert_nothing_missed(rows, truth)
            assert_linear_rows_close(rows, ends, faces, separation + tolerance_of(bodies) + 1e-12)
            # False contacts are within rounding of the separation.
            assert_linear_rows_close({k: rows[k] for k in rows.keys() - truth.keys()}, ends, faces, separation + 1e-12)
            assert hits.stats.unresolved == sum(row.status == pgccd.Status.UNRESOLVED for row in rows.values())


def crowd(seed: int, count: int = 14, turn: float = 1.0) -> Bodies:
    """Bodies close enough together for dozens of pairs."""
    rng = np.random.default_rng([6, seed])
    return approaching(rng, (1,) * count, tuple(rng.uniform(0.5, 1.5, count)), turn=turn, closeness=0.8)


def first_of(hits: pgccd.Contacts) -> dict[tuple[int, int], tuple[Any, ...]]:
    """The first row of each pair by (toi, kind, features)."""
    best: dict[tuple[int, int], tuple[Any, ...]] = {}
    for row, pair in enumerate(map(tuple, hits.pairs.tolist())):
        key = (float(hits.toi[row]), int(hits.kind[row]), *hits.features[row].tolist(), row)
        best[pair] = min(best.get(pair, key), key)
    return best


def timed(hits: pgccd.Contacts) -> dict[tuple[int, ...], float]:
    """toi by (i, j, kind, features)."""
    columns = (hits.pairs, hits.kind[:, None], hits.features)
    keys = [tuple(row) for row in torch.cat([c.long() for c in columns], dim=1).tolist()]
    return dict(zip(keys, hits.toi.tolist(), strict=True))


@pytest.mark.parametrize("path", ["rigid", "linear"])
@pytest.mark.parametrize("separation", [0.0, 0.1])
@few_and_many("seeds", 2, 4)
def test_reports_agree(device: torch.device, path: Any, separation: float, seeds: int) -> None:
    for seed in range(seeds):
        bodies = crowd(seed)
        scene, motion = bodies.scene(device), bodies.motion(path, device)
        reports = {r: detected(scene, motion, r, separation) for r in ("all", "first", "any", "earliest")}
        everything, first = reports["all"], reports["first"]
        order = list(timed(everything))
        assert order == sorted(order) and len(order) == len(everything), "not in canonical order, or twice"
        best = first_of(everything)
        assert len(best) > 10
        assert first.pairs.tolist() == [list(p) for p in sorted(best)]
        rows = torch.tensor([best[p][-1] for p in sorted(best)], device=device)
        for column in COLUMNS:
            assert torch.equal(getattr(first, column), getattr(everything, column)[rows]), column
        assert torch.equal(reports["any"].pairs, first.pairs)
        assert not any(hasattr(reports["any"], c) for c in COLUMNS[1:])
        winner = min((value[:-1][0], pair, value) for pair, value in best.items())[2][-1]
        assert len(reports["earliest"]) == 1
        for column in COLUMNS:
            assert torch.equal(getattr(reports["earliest"], column)[0], getattr(everything, column)[winner]), column
        for report, hits in reports.items():
            stats = hits.stats
            assert (stats.bodies, stats.contacts) == (14, len(hits)) and stats.pcs >= len(first), report
            assert set(stats.seconds) == {"bounds", "broad", "traverse", "narrow"}


def test_ties_go_to_the_smallest(device: torch.device) -> None:
    # Equal cubes in a row that touch from the start: all toi are 0.
    trimesh = pytest.importorskip("trimesh")
    mesh = pgccd.Mesh.from_trimesh(trimesh.creation.box())
    count = 5
    start = np.arange(count)[:, None] * np.array([[1.0, 0.0, 0.0]])
    turn = np.tile([1.0, 0, 0, 0], (count, 1))
    bodies = Bodies([mesh] * count, start, turn, 0 * start, 0 * start)
    scene, motion = bodies.scene(device), bodies.motion(device=device)
    everything = pgccd.detect(scene, motion, "all")
    assert (everything.toi == 0).all()
    first = pgccd.detect(scene, motion, "first")
    assert first.pairs.tolist() == [[i, i + 1] for i in range(count - 1)]
    best = first_of(everything)
    assert [[int(k), *f] for k, f in zip(first.kind, first.features.tolist(), strict=True)] == [
        list(best[p][1:4]) for p in sorted(best)
    ]
    assert pgccd.detect(scene, motion, "earliest").pairs.tolist() == [[0, 1]]


def test_collision_free_fraction_of_the_step(device: torch.device) -> None:
    """A step cut off just before the earliest toi has no contact; one cut off after it has one."""
    for seed in range(4):
        bodies = crowd(seed, turn=0.3)
        apart, back = 3.0 * bodies.position_t0, -bodies.position_t0
        far = Bodies(bodies.meshes, apart, bodies.orientation_t0, back, bodies.rotation)
        hits = pgccd.detect(far.scene(device), far.motion(device=device), "earliest", tolerance=1e-9)
        if not len(hits) or float(hits.toi) == 0:
            continue
        for factor, expected in ((1 - 1e-9, 0), (1 + 1e-3, 1)):
            part = factor * float(hits.toi)
            cut = Bodies(far.meshes, far.position_t0, far.orientation_t0, part * far.velocity, part * far.rotation)
            again = pgccd.detect(cut.scene(device), cut.motion(device=device), "earliest", tolerance=1e-9)
            assert len(again) == expected or (expected == 0 and float(again.toi) > 1 - 1e-6)


@pytest.mark.parametrize(
    ("part", "path", "touches"), [(0.06, "rigid", True), (0.07, "rigid", False), (0.06, "linear", False)]
)
def test_only_a_start_within_a_sixteenth_of_the_tolerance_touches(
    part: float, path: Any, touches: bool, device: torch.device
) -> None:
    scene = pgccd.Scene([pgccd.Mesh.box([2.0, 2.0, 2.0])], [0, 0], device=device)
    # Both boxes rest; their faces are this part of the tolerance apart.
    position = torch.tensor([[0.0, 0.0, 0.0], [2.0 + 0.01 * part, 0.1, 0.1]], dtype=torch.float64, device=device)
    upright = torch.tensor([[1.0, 0.0, 0.0, 0.0]], device=device).repeat(2, 1)
    motion = pgccd.RigidMotion(position, upright, position, upright, path=path)
    assert pgccd.detect(scene, motion, tolerance=0.01).toi.tolist() == [0.0] * touches
    assert len(pgccd.detect(scene, motion, tolerance=0.01, nonzero_toi=True)) == 0


def test_nonzero_toi(device: torch.device) -> None:
    bodies = crowd(3, turn=0.5)
    scene, motion = bodies.scene(device), bodies.motion(device=device)
    plain = pgccd.detect(scene, motion, "all", 0.01, tolerance=0.2)
    moved = pgccd.detect(scene, motion, "all", 0.01, tolerance=0.2, nonzero_toi=True)
    exact = pgccd.detect(scene, motion, "all", 0.01, tolerance=1e-10)
    keys = [timed(hits) for hits in (plain, moved, exact)]
    starting = {key for key, toi in keys[2].items() if toi == 0}
    assert {key for key, toi in keys[1].items() if toi == 0} == starting
    assert starting <= {key for key, toi in keys[0].items() if toi == 0}
    assert sum(toi == 0 for toi in keys[0].values()) > len(starting), "the tolerance had no effect"
    assert set(keys[2]) <= set(keys[1])


@pytest.mark.parametrize("count", [0, 1])
def test_nothing_to_collide(device: torch.device, count: int) -> None:
    bodies = crowd(0, max(count, 1))
    scene = pgccd.Scene(bodies.meshes, list(range(count)), device)
    columns = [torch.tensor(c[:count], device=device) for c in (bodies.position_t0, bodies.orientation_t0)]
    motion = pgccd.RigidMotion(columns[0], columns[1], columns[0] + 1, columns[1])
    for report in ("any", "first", "all", "earliest"):
        hits = detected(scene, motion, report)
        assert len(hits) == 0 and hits.pairs.shape == (0, 2) and hits.pairs.dtype == torch.int64
        assert report == "any" or (hits.toi.shape, hits.features.shape) == ((0,), (0, 2))


def test_filtered_bodies_do_not_collide(device: torch.device) -> None:
    bodies = crowd(1)
    motion = bodies.motion(device=device)
    everything = pgccd.collide(bodies.scene(device), motion).pairs.tolist()
    world = torch.arange(14) % 3
    filtered = pgccd.Scene(bodies.meshes, device=device, world=world, static=world == 0)
    expected = [p for p in everything if p[0] % 3 == p[1] % 3 and p[0] % 3 != 0]
    assert 0 < len(expected) < len(everything)
    assert pgccd.collide(filtered, motion).pairs.tolist() == expected


@pytest.mark.slow
def test_many_rigid_pairs(device: torch.device) -> None:
    found = 0
    for seed in range(200):
        rng = np.random.default_rng([7, seed])
        turn = float(10.0 ** rng.uniform(-2, 1))
        sizes = (1.0, float(10.0 ** rng.uniform(-0.5, 0.5)))
        separation = float(rng.choice([0.0, 0.0, 0.02]))
        shapes = (0, 0) if turn > 3 else (0, 1)
        found += check_rigid(approaching(rng, shapes, sizes, turn=turn), device, separation)
    assert found > 2000
