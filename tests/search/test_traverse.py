"""Traversal: every feature pair that touches is a candidate, without duplicates."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
import torch
from support.candidates import assert_all_there, candidates, moving
from support.cases import few_and_many, mostly_slow
from support.shapes import Bodies, approaching, on_the_surface, tensors, unit_quaternions
from support.truth import end_positions, linear_truth, rigid_truth

import pgccd


@pytest.mark.parametrize("turn", [0.0, 0.1, 1.0, 3.1, 9.0, 25.0])
@few_and_many("seeds", 1, 2)
def test_arcs(device: torch.device, turn: float, seeds: int) -> None:
    contacts = 0
    for seed in (1, 0)[:seeds]:
        rng = np.random.default_rng([seed, int(10 * turn)])
        bodies = approaching(rng, (0, 1) if turn < 5 else (0, 0), turn=turn, closeness=0.7)
        truth = rigid_truth(bodies)
        contacts += len(truth.contacts)
        assert_all_there(candidates(moving(bodies, device))[0], truth)
    assert contacts > 0


@pytest.mark.parametrize("turn", [0.5, 3.0, 7.0])
def test_horizon(device: torch.device, turn: float) -> None:
    bodies = approaching(np.random.default_rng([5, int(turn)]), (0, 1), turn=turn, closeness=0.7)
    moved, truth = moving(bodies, device), rigid_truth(bodies)
    times = sorted(float(c.toi_upper) for c in truth.contacts)
    everything = candidates(moved)[0]
    counts = []
    for until in (0.0, times[0], times[len(times) // 2], times[-1], 1.0):
        found = candidates(moved, horizon=[until])[0]
        assert_all_there(found, truth, until)
        counts.append(len(found))
    assert counts[0] < counts[-1] == len(everything)


@pytest.mark.parametrize("separation", [1e-9, 0.05, 0.5])
def test_separation(device: torch.device, separation: float) -> None:
    bodies = approaching(np.random.default_rng(7), (1, 0), turn=1.0, closeness=0.95)
    found = candidates(moving(bodies, device), min_separation=separation)[0]
    assert_all_there(found, rigid_truth(bodies, min_separation=separation))
    assert len(found) > len(candidates(moving(bodies, device))[0]) or separation < 1e-3


@pytest.mark.parametrize(
    ("turn", "ratio"),
    mostly_slow(itertools.product((0.0, 2.0), (1.0, 30.0, 1000.0)), [(2.0, 1.0), (0.0, 30.0), (2.0, 1000.0)]),
)
def test_mixed_sizes(device: torch.device, ratio: float, turn: float) -> None:
    bodies = on_the_surface(np.random.default_rng([1, int(ratio)]), ratio, turn)
    truth = rigid_truth(bodies)
    assert len(truth.contacts) > 0
    found = candidates(moving(bodies, device))[0]
    assert_all_there(found, truth)
    everything = (len(bodies.meshes[0].vertices) + len(bodies.meshes[0].edges)) * 20
    assert len(found) < everything / 2 or ratio == 1.0, "hardly anything is culled"


@pytest.mark.parametrize("scale", [1e-6, 1e6])
def test_scales(device: torch.device, scale: float) -> None:
    bodies = approaching(np.random.default_rng(8), sizes=(scale, scale), turn=1.0, closeness=0.8)
    assert_all_there(candidates(moving(bodies, device))[0], rigid_truth(bodies))


def test_far_from_the_origin(device: torch.device) -> None:
    bodies = approaching(np.random.default_rng(9), turn=1.0, closeness=0.8, offset=1e8)
    truth = rigid_truth(bodies)
    assert len(truth.contacts) > 0
    found = candidates(moving(bodies, device))[0]
    assert_all_there(found, truth)
    near = approaching(np.random.default_rng(9), turn=1.0, closeness=0.8)
    assert len(found) < 1.1 * len(candidates(moving(near, device))[0]) + 10


@pytest.mark.parametrize("turn", [0.0, 1.0, 3.0])
def test_linear_paths(device: torch.device, turn: float) -> None:
    bodies = approaching(np.random.default_rng([10, int(turn)]), turn=turn, closeness=0.8)
    ends = [end_positions(bodies, b) for b in (0, 1)]
    truth = linear_truth(ends, [m.faces.numpy() for m in bodies.meshes])
    assert len(truth.contacts) > 0
    assert_all_there(candidates(moving(bodies, device, "linear"))[0], truth)
    middle = 0.5 * (float(truth.toi_upper) + 1.0)
    assert_all_there(candidates(moving(bodies, device, "linear"), horizon=[middle])[0], truth, middle)


@pytest.mark.parametrize("shake", [0.0, 0.2, 1.0])
@few_and_many("seeds", 1, 2)
def test_deforming(device: torch.device, shake: float, seeds: int) -> None:
    for seed in range(seeds):
        rng = np.random.default_rng([11, int(10 * shake), seed])
        bodies = approaching(rng, turn=1.0, closeness=0.8, offset=100.0)
        ends = [end_positions(bodies, b) for b in (0, 1)]
        ends = [[x + shake * rng.normal(size=x.shape) for x in of_body] for of_body in ends]
        motion = pgccd.VertexMotion(*tensors(*(np.concatenate([e[t] for e in ends]) for t in (0, 1)), device=device))
        moved = pgccd.MovingBodies.of(bodies.scene(device), motion)
        truth = linear_truth(ends, [m.faces.numpy() for m in bodies.meshes])
        assert len(truth.contacts) > 0
        assert_all_there(candidates(moved)[0], truth)
        middle = 0.5 * (float(truth.toi_upper) + 1.0)
        assert_all_there(candidates(moved, horizon=[middle])[0], truth, middle)


def test_several_pairs_and_one_at_a_time(device: torch.device) -> None:
    rng = np.random.default_rng(12)
    bodies = approaching(rng, (1,) * 6, (1.0, 0.5, 2.0, 1.0, 1.0, 0.7), turn=2.0, closeness=0.7)
    moved = moving(bodies, device)
    pairs = torch.tensor([[i, j] for i in range(6) for j in range(i + 1, 6)], device=device)
    together = candidates(moved, pairs)
    for k, pair in enumerate(pairs):
        assert sorted(candidates(moved, pair[None])[0]) == sorted(together[k])
    order = torch.randperm(len(pairs), generator=torch.Generator().manual_seed(0)).to(device)
    shuffled = candidates(moved, pairs[order])
    assert all(sorted(shuffled[k]) == sorted(together[int(order[k])]) for k in range(len(pairs)))


def test_bodies_in_one_place(device: torch.device) -> None:
    # Two equal bodies in one place: all features touch at once.
    bodies = approaching(np.random.default_rng(14), (0, 0), closeness=0.0, turn=0.0)
    same = Bodies(
        [bodies.meshes[0]] * 2,
        np.zeros((2, 3)),
        unit_quaternions(np.random.default_rng(15), 1).repeat(2, 0),
        np.zeros((2, 3)),
        np.zeros((2, 3)),
    )
    found = candidates(moving(same, device))[0]
    faces, edges = bodies.meshes[0].faces.tolist(), bodies.meshes[0].edges.tolist()
    touching = {(pgccd.Kind.VF_AB, v, f) for f, face in enumerate(faces) for v in face}
    touching |= {(pgccd.Kind.VF_BA, f, v) for f, face in enumerate(faces) for v in face}
    touching |= {(pgccd.Kind.EE, a, b) for a, e in enumerate(edges) for b, f in enumerate(edges) if set(e) & set(f)}
    assert touching - set(found) == set()


def test_no_pairs(device: torch.device) -> None:
    bodies = approaching(np.random.default_rng(16))
    found, tests = pgccd.traverse.find_candidates(
        moving(bodies, device), torch.zeros((0, 2), dtype=torch.int64, device=device)
    )
    assert found.shape == (0, 4) and int(tests) == 0


@pytest.mark.slow
def test_many_arcs(device: torch.device) -> None:
    for seed in range(60):
        rng = np.random.default_rng([17, seed])
        sizes = (1.0, float(10.0 ** rng.uniform(-1, 1)))
        bodies = approaching(rng, turn=float(10.0 ** rng.uniform(-2, 1.5)), sizes=sizes)
        assert_all_there(candidates(moving(bodies, device))[0], rigid_truth(bodies))
