"""Same input, same bits: for any number of threads, chunks, order of other bodies, or repetition."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
import torch
from support.reports import detected
from support.same_bits import COLUMNS, assert_same
from support.shapes import Bodies, approaching, tensors

import pgccd
from pgccd import narrow

REPORTS = list(narrow.REPORTS)


@pytest.fixture(autouse=True)
def restore_threads() -> Iterator[None]:
    before = torch.get_num_threads()
    yield
    torch.set_num_threads(before)


def crowd(count: int = 25) -> Bodies:
    rng = np.random.default_rng(1)
    return approaching(rng, (1,) * count, tuple(rng.uniform(0.3, 1.5, count)), turn=1.5)


def motions(bodies: Bodies, device: torch.device) -> dict[str, Any]:
    """A motion of each kind."""
    rng = np.random.default_rng(2)
    ends = [
        np.concatenate([m.vertices.numpy() + p for m, p in zip(bodies.meshes, x, strict=True)])
        for x in (bodies.position_t0, bodies.position_t1)
    ]
    ends[1] += 0.05 * rng.normal(size=ends[1].shape)
    return {
        "rigid": bodies.motion("rigid", device),
        "linear": bodies.motion("linear", device),
        "deforming": pgccd.VertexMotion(*tensors(*ends, device=device)),
    }


@pytest.mark.parametrize("report", REPORTS)
@pytest.mark.parametrize("kind", ["rigid", "linear", "deforming"])
def test_threads_chunks_and_repetition(device: torch.device, kind: str, report: Any) -> None:
    bodies = crowd()
    scene, motion = bodies.scene(device), motions(bodies, device)[kind]
    torch.set_num_threads(1)
    reference = detected(scene, motion, report)
    assert len(reference) > (0 if report == "earliest" else 20)
    for threads in (1, 2, 3):
        torch.set_num_threads(threads)
        assert_same(detected(scene, motion, report), reference)
    chunks = set()
    for budget in (1, 40_000, 300_000, 10**8):
        hits = detected(scene, motion, report, memory_budget=budget)
        assert_same(hits, reference)
        chunks.add(hits.stats.chunks)
    assert max(chunks) == reference.stats.pcs and min(chunks) == 1
    assert reference.stats.pcs > 30


def test_stages_do_not_depend_on_threads(device: torch.device) -> None:
    bodies = crowd()
    moved = pgccd.MovingBodies.of(bodies.scene(device), bodies.motion(device=device))
    found = []
    for threads in (1, 2, 3):
        torch.set_num_threads(threads)
        pairs = pgccd.broad.sweep(moved, 0.1)
        candidates, _ = pgccd.traverse.find_candidates(moved, pairs)
        order = sorted(map(tuple, candidates.tolist()))
        found.append((pairs, order))
    assert all(torch.equal(found[0][0], pairs) and found[0][1] == order for pairs, order in found)
    shuffled = candidates[torch.randperm(len(candidates), device=candidates.device)]
    for report in REPORTS:
        rows = [pgccd.narrow.find_contacts(moved, pairs, c, report) for c in (candidates, shuffled)]
        if report == "any":  # which contact is found first depends on the order of work
            assert torch.equal(rows[0][0], rows[1][0])
        else:
            assert all(torch.equal(a, b) for a, b in zip(*rows, strict=True))


def test_bodies_that_are_elsewhere_change_nothing(device: torch.device) -> None:
    bodies = crowd(12)
    reference = pgccd.detect(bodies.scene(device), bodies.motion(device=device), "all")
    rng = np.random.default_rng(3)
    others = 20
    chosen = rng.integers(0, 12, others)
    far = Bodies(
        bodies.meshes + [bodies.meshes[k] for k in chosen],
        np.concatenate([bodies.position_t0, 1e4 * rng.normal(size=(others, 3))]),
        np.concatenate([bodies.orientation_t0, bodies.orientation_t0[chosen]]),
        np.concatenate([bodies.velocity, rng.normal(size=(others, 3))]),
        np.concatenate([bodies.rotation, bodies.rotation[chosen]]),
    )
    hits = pgccd.detect(far.scene(device), far.motion(device=device), "all")
    mine = (hits.pairs < 12).all(dim=1)
    for column in COLUMNS:
        assert torch.equal(getattr(hits, column)[mine], getattr(reference, column)), column


def test_one_mesh_shared_or_copied(device: torch.device) -> None:
    bodies = crowd(10)
    same = Bodies(
        [bodies.meshes[0]] * 10,
        *(getattr(bodies, c) for c in ("position_t0", "orientation_t0", "velocity", "rotation")),
    )
    motion = same.motion(device=device)
    copied = pgccd.detect(same.scene(device), motion, "all")
    shared = pgccd.detect(pgccd.Scene([bodies.meshes[0]], [0] * 10, device), motion, "all")
    assert len(shared) > 50
    assert_same(copied, shared)


def test_order_of_a_pair_keeps_the_contacts(device: torch.device) -> None:
    """Exchanging two bodies exchanges the features' columns; times agree to rounding."""
    bodies = crowd(2)
    turned = Bodies(
        bodies.meshes[::-1],
        *(getattr(bodies, c)[::-1].copy() for c in ("position_t0", "orientation_t0", "velocity", "rotation")),
    )
    one, other = (pgccd.detect(b.scene(device), b.motion(device=device), "all") for b in (bodies, turned))
    kinds = (pgccd.Kind.VF_AB, pgccd.Kind.VF_BA, pgccd.Kind.EE, pgccd.Kind.EF_AB, pgccd.Kind.EF_BA)
    exchanged = dict(
        zip(kinds, (pgccd.Kind.VF_BA, pgccd.Kind.VF_AB, pgccd.Kind.EE, pgccd.Kind.EF_BA, pgccd.Kind.EF_AB), strict=True)
    )
    tables: list[dict[tuple[int, ...], float]] = [{}, {}]
    for hits, table in zip((one, other), tables, strict=True):
        for kind, (a, b), toi in zip(hits.kind.tolist(), hits.features.tolist(), hits.toi.tolist(), strict=True):
            table[(kind, a, b) if hits is one else (exchanged[kind], b, a)] = toi
    assert len(tables[0]) > 10 and tables[0].keys() == tables[1].keys()
    assert max(abs(tables[0][key] - tables[1][key]) for key in tables[0]) < 1e-6


@pytest.mark.cuda
def test_cuda_gives_the_bits_of_the_cpu() -> None:
    bodies = crowd(100)
    results = []
    for device in (torch.device("cpu"), torch.device("cuda")):
        kinds = motions(bodies, device)
        results.append(
            [
                detected(bodies.scene(device), motion, report, separation)
                for motion in kinds.values()
                for report in REPORTS
                for separation in (0.0, 0.05)
            ]
        )
    for on_cpu, on_gpu in zip(*results, strict=True):
        assert_same(on_cpu, on_gpu)
