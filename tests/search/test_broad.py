"""Broad phase against the exact set of pairs: none missed, and none invented beyond rounding."""

from __future__ import annotations

from typing import Any, get_args

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from oracle.broad import sphere_pairs
from support.broad_phases import agreed, check, scattered
from support.shapes import tensors, tetrahedron, unit_quaternions

import pgccd
from pgccd import ops


@pytest.mark.parametrize("count", [0, 1, 2, 3, 300, 1500])
def test_random(device: torch.device, count: int) -> None:
    rng = np.random.default_rng(count)
    start, end, radius = scattered(rng, count, 2.0 * count ** (1 / 3) + 0.1)
    pairs = check(start, end, radius, device=device)
    assert len(pairs) > 50 or count < 300


@pytest.mark.parametrize("scale", [1e-6, 1e-3, 1e3, 1e6, 1e-25, 1e25])
def test_scales(device: torch.device, scale: float) -> None:
    start, end, radius = scattered(np.random.default_rng(1), 200, 8.0)
    assert len(check(scale * start, scale * end, scale * radius, 0.1 * scale, device=device)) > 50


@pytest.mark.parametrize("far", [1e4, 1e8, 1e12])
def test_far_from_the_origin(device: torch.device, far: float) -> None:
    start, end, radius = scattered(np.random.default_rng(2), 300, 8.0)
    shift = far * np.array([1.0, -0.5, 0.25])
    assert len(check(start + shift, end + shift, radius, device=device)) > 50
    # With bodies at the origin too, so that the extent is huge relative to the bodies.
    both = [np.concatenate([x, x + shift]) for x in (start, end)]
    check(*both, np.tile(radius, 2), device=device)


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_one_huge_body_among_small_ones(device: torch.device, axis: int) -> None:
    rng = np.random.default_rng(3)
    start, end, radius = scattered(rng, 800, 20.0)
    start[400] = end[400] = 0.0
    radius[400] = 25.0
    start[:, axis] *= 0.01
    end[:, axis] *= 0.01
    pairs = check(start, end, radius, device=device)
    assert (pairs == 400).any(axis=1).sum() > 500


def test_fast_bodies_and_mixed_sizes(device: torch.device) -> None:
    rng = np.random.default_rng(4)
    start = rng.uniform(-10, 10, (400, 3))
    end = rng.uniform(-10, 10, (400, 3))
    check(start, end, 10.0 ** rng.uniform(-6, 0, 400), device=device)


def test_identical_and_still_bodies(device: torch.device) -> None:
    rng = np.random.default_rng(5)
    same = np.repeat(rng.normal(size=(1, 3)), 40, axis=0)
    assert len(check(same, same, np.full(40, 0.5), device=device)) == 40 * 39 // 2
    start = rng.uniform(-4, 4, (200, 3))
    assert len(check(start, start, np.full(200, 0.6), device=device)) > 100
    moved = same + rng.normal(size=3)
    assert len(check(same, moved, np.full(40, 1e-9), device=device)) == 40 * 39 // 2


def test_touching_counts(device: torch.device) -> None:
    # A row at exactly representable distances: neighbours touch exactly, and no longer one ulp further away.
    start = np.zeros((64, 3))
    start[:, 1] = 0.75 * np.arange(64)
    pairs = check(start, start, np.full(64, 0.375), device=device)
    assert pairs.tolist() == [[i, i + 1] for i in range(63)]
    wide = np.nextafter(0.375, 0)
    check(start, start, np.full(64, wide), device=device)
    assert len(check(start, start, np.full(64, 0.375 - 1e-9), device=device)) == 0
    assert len(check(start, start, np.full(64, 0.25), 0.25, device=device)) == 63
    # Passing at exactly that distance in the middle of the step, and at its very end.
    passing = np.array([[-1.0, 0, 0], [0, 0.75, 1.0]]), np.array([[1.0, 0, 0], [0, 0.75, -1.0]])
    assert len(check(*passing, [0.375, 0.375], device=device)) == 1
    arriving = np.array([[-1.0, 0, 0], [2.0, 0, 0]]), np.array([[0.0, 0, 0], [1.0, 0, 0]])
    assert len(check(*arriving, [0.5, 0.5], device=device)) == 1


@given(st.integers(0, 2**32 - 1), st.integers(2, 12), st.sampled_from([0.0, 1.0, 0.5]))
@settings(max_examples=120)
def test_grids_where_touching_is_common(seed: int, count: int, separation: float) -> None:
    rng = np.random.default_rng(seed)
    scale = 2.0 ** rng.integers(-30, 30)
    start, end = (rng.integers(-4, 5, (count, 3)) * scale for _ in range(2))
    check(start, end, rng.integers(1, 4, count) * 0.5 * scale, separation * scale)


@given(
    st.integers(0, 2**32 - 1),
    st.integers(2, 30),
    st.tuples(*[st.booleans()] * 3),
    st.sampled_from([1, 2, 3, 2**31 - 1]),
)
@settings(max_examples=60)
def test_filters(seed: int, count: int, present: tuple[bool, ...], worlds: int) -> None:
    rng = np.random.default_rng(seed)
    start, end, radius = scattered(rng, count, 3.0)
    filters: dict[str, Any] = {}
    if present[0]:
        bits = rng.choice([0, 1, 2, 3, -1, -(2**63), 2**62], (2, count))
        filters |= {"group": bits[0], "mask": bits[1]}
    if present[1]:
        filters["world"] = rng.choice([0, 1, worlds // 2, worlds], count)
    if present[2]:
        filters["static"] = rng.random(count) < 0.5
    check(start, end, radius, **filters)


def test_scene_filters_and_separation(device: torch.device) -> None:
    rng = np.random.default_rng(6)
    count = 60
    start = rng.uniform(-3, 3, (count, 3))
    end = start + 0.2 * rng.normal(size=(count, 3))
    group, mask = rng.integers(1, 4, (2, count))
    world, static = rng.integers(0, 2, count), rng.random(count) < 0.3
    turn = unit_quaternions(rng, count)
    mesh = tetrahedron(0.7)
    scene = pgccd.Scene([mesh], [0] * count, device, group=group, mask=mask, world=world.tolist(), static=static)
    bodies = pgccd.MovingBodies.of(scene, pgccd.RigidMotion(*tensors(start, turn, end, turn, device=device)))
    radius = np.full(count, mesh.radius)
    filters: dict[str, Any] = {"group": group, "mask": mask, "world": world, "static": static}
    for separation in (0.0, 0.4):
        truth = sphere_pairs(start, end, radius, separation, **filters)
        assert len(truth) > 10
        for axis in ("auto", "x", "y", "z"):
            assert np.array_equal(pgccd.broad.sweep(bodies, separation, axis, tolerance=0.0).cpu().numpy(), truth)
        for broad_phase in pgccd.broad.BROAD_PHASES:
            found = pgccd.broad.find_pairs(bodies, separation, broad_phase, tolerance=0.0)
            assert np.array_equal(found.cpu().numpy(), truth)


@pytest.mark.parametrize("has_static", [False, True])
def test_pairs_found_elsewhere(device: torch.device, has_static: bool) -> None:
    """Pairs of two static bodies are left out, and those of two found elsewhere, but not those of one of each."""
    rng = np.random.default_rng(9)
    start, end, radius = scattered(rng, 80, 3.0)
    static = rng.random(80) < 0.5 if has_static else None
    elsewhere = rng.random(80) < 0.5
    turn = np.tile([1.0, 0.0, 0.0, 0.0], (80, 1))
    meshes = [tetrahedron(r) for r in radius.tolist()]
    scene = pgccd.Scene(meshes, range(80), device, static=static)
    bodies = pgccd.MovingBodies.of(scene, pgccd.RigidMotion(*tensors(start, turn, end, turn, device=device)))
    truth = pgccd.broad.find_pairs(bodies).cpu()
    kept = truth[~torch.as_tensor(elsewhere)[truth].all(dim=1)]
    assert 10 < len(kept) < len(truth) - 10
    marks = torch.as_tensor(elsewhere, device=device).to(torch.uint8)
    capacity = pgccd.Capacity.of(80).times(20.0)
    for broad_phase in get_args(pgccd.broad.BroadPhase):
        chosen = pgccd.broad.choose(bodies, broad_phase)
        found = pgccd.broad.find_pairs_of_checked(bodies, 0.0, chosen, in_other_search=marks)
        assert torch.equal(found.cpu(), kept), broad_phase
        given = bodies, 0.0, broad_phase, capacity, torch.zeros(1, dtype=torch.int64, device=device)
        padded, _ = pgccd.broad.find_pairs_padded(*given, in_other_search=marks)
        assert torch.equal(padded[: len(kept)].cpu(), kept) and bool((padded[len(kept) :] == -1).all()), broad_phase


@pytest.mark.parametrize("scale", [1e-25, 1.0, 1e25])
@pytest.mark.parametrize("step", [0.0, 0.3, 6.0])
def test_pairs_at_any_times(device: torch.device, step: float, scale: float) -> None:
    """Spheres that touch at two times are a pair; so is the PCS, which is found among these pairs."""
    rng = np.random.default_rng(7)
    start, end, radius = (scale * x for x in scattered(rng, 250, 8.0, step))
    swept = agreed(start, end, radius, device=device, at_any_times=True)
    pcs = agreed(start, end, radius, device=device)
    found = {tuple(pair) for pair in swept.tolist()}
    for times in rng.uniform(-0.2, 1.2, (20, 250, 1)).clip(0.0, 1.0):
        at = start + times * (end - start)
        distance = np.linalg.norm(at[:, None] - at, axis=2)
        touching = np.argwhere(np.triu(distance < radius[:, None] + radius, 1))
        assert {tuple(pair) for pair in touching.tolist()} <= found
    assert {tuple(pair) for pair in pcs.tolist()} <= found
    assert (len(pcs) == len(found)) == (step == 0.0) and len(pcs) > 100
    centres = tensors(start, end, radius, device=device)
    among = torch.cat([swept, torch.full((3, 2), -1)])[torch.randperm(len(swept) + 3)]
    for flipped in (among, among.flip(1)):  # the smaller row need not be first
        meeting, count = ops.meeting_pairs(flipped.to(device), centres, 0.0, 0.0)
        expected = flipped[[tuple(sorted(pair)) in {tuple(p) for p in pcs.tolist()} for pair in flipped.tolist()]]
        assert int(count) == len(pcs) and torch.equal(meeting[: int(count)].cpu(), expected)
        assert bool((meeting[int(count) :] == -1).all()) and len(meeting) == len(among)


def test_pairs_at_any_times_are_not_all_that_overlap() -> None:
    start = np.array([[0.0, 0, 0], [2.5, 0, 0], [2.5, 3.0, 0], [9.5, 0, 0]])
    end = start + np.array([[6.0, 0, 0], [6.0, 0, 0], [6.0, 0, 0], [6.0, 0, 0]])
    # One behind the other is found, in whatever order; side by side, or out of reach of the whole path, is not.
    assert agreed(start, end, np.ones(4), at_any_times=True).tolist() == [[0, 1], [1, 3]]
    assert agreed(start, end, np.ones(4), at_any_times=True, group=[1, 1, 1, 2], mask=[1, 1, 1, 2]).tolist() == [[0, 1]]


def test_group_alone_means_all_mask_bits() -> None:
    x = np.zeros((3, 3))
    assert agreed(x, x, np.ones(3), group=[1, 0, 2]).tolist() == [[0, 2]]
    assert agreed(x, x, np.ones(3), mask=[1, 0, 2]).tolist() == [[0, 2]]


@pytest.mark.slow
def test_many(device: torch.device) -> None:
    for seed in range(20):
        rng = np.random.default_rng(100 + seed)
        count = int(rng.integers(2_000, 20_000))
        start, end, radius = scattered(rng, count, 2.5 * count ** (1 / 3), float(10.0 ** rng.uniform(-3, 1)))
        check(start, end, radius * rng.choice([0.1, 1.0]), device=device)
