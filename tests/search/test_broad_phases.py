"""Scenes that are hard for one broad phase or another: all must find the same, true pairs."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from support.broad_phases import agreed, check, scattered
from support.shapes import tensors, tetrahedron, unit_quaternions

import pgccd

Arrays = tuple[np.ndarray, np.ndarray, np.ndarray]


def stirred(rng: np.random.Generator, start: np.ndarray, radius: np.ndarray, step: float = 0.1) -> Arrays:
    """Centres at both ends, with steps in proportion to the radii, and the radii."""
    return start, start + step * radius[:, None] * rng.normal(size=start.shape), radius


@pytest.mark.parametrize("ratio", [10.0, 1e3, 1e6])
@pytest.mark.parametrize("spread", [3.0, 20.0])
def test_sizes_over_many_octaves(device: torch.device, ratio: float, spread: float) -> None:
    rng = np.random.default_rng(10)
    radius = ratio ** rng.uniform(-1, 0, 700)
    # Half of the small spheres crowd around large ones; otherwise few would meet.
    start = spread * rng.uniform(-1, 1, (700, 3))
    start[350:] = start[:350] + radius[:350, None] * rng.normal(size=(350, 3))
    assert len(check(*stirred(rng, start, radius), 0.001, device=device)) > 200


@pytest.mark.parametrize("seed", range(6))
def test_bodies_as_small_as_the_cells_of_the_lowest_level(device: torch.device, seed: int) -> None:
    """A millionth of the mean size: their boxes are one to three cells long, and the level must tell two from three."""
    rng = np.random.default_rng([14, seed])
    few, many = int(rng.integers(2, 20)), 150
    radius = np.concatenate([np.ones(few), np.full(many, 2.0 ** rng.uniform(-22, -17))])
    start = 5.0 * rng.normal(size=(few + many, 3))
    start[few:] = 3.0 * rng.normal(size=3) + 6.0 * radius[-1] * rng.uniform(-1, 1, (many, 3))
    # Some do not move, so that their boxes are equal cubes.
    step = rng.choice([0.0, 1.0, 4.0])
    assert len(check(*stirred(rng, start, radius, step), device=device)) > 50


@pytest.mark.parametrize("extent", [0.0, 1e-9, 0.01])
def test_all_in_one_place(device: torch.device, extent: float) -> None:
    rng = np.random.default_rng(11)
    start = 3.0 + extent * rng.uniform(-1, 1, (150, 3))
    assert len(check(*stirred(rng, start, np.full(150, 0.5)), device=device)) == 150 * 149 // 2
    tiny = check(*stirred(rng, start, np.full(150, 1e-12)), device=device)
    assert len(tiny) == (150 * 149 // 2 if extent == 0.0 else 0) or extent == 1e-9


@pytest.mark.parametrize("far", [1e8, 1e15, 1e30])
@pytest.mark.parametrize("outliers", [1, 100])
def test_outliers(device: torch.device, far: float, outliers: int) -> None:
    rng = np.random.default_rng(12)
    start, end, radius = scattered(rng, 600, 12.0)
    chosen = rng.permutation(600)[:outliers]
    shift = far * rng.choice([-1.0, 0.3, 1.0], (outliers, 3))
    start[chosen] += shift
    end[chosen] += shift
    assert len(check(start, end, radius, device=device)) > 50


def test_one_body_flies_through_everything(device: torch.device) -> None:
    rng = np.random.default_rng(13)
    start, end, radius = scattered(rng, 600, 10.0)
    start[7], end[7], radius[7] = [-1e6, -1.2e6, 1e6], [1e6, 1.2e6, -1e6], 0.5
    assert (check(start, end, radius, device=device) == 7).any()


@pytest.mark.parametrize("thin", [1e-6, 0.05])
def test_long_capsules(device: torch.device, thin: float) -> None:
    rng = np.random.default_rng(14)
    start = rng.uniform(-10, 10, (300, 3))
    parallel = start + [30.0, 0.0, 0.0]
    check(start, parallel, np.full(300, thin), device=device)
    check(start, parallel + rng.normal(size=(300, 3)), np.full(300, thin), device=device)
    assert len(check(start, rng.uniform(-10, 10, (300, 3)), np.full(300, 0.2), device=device)) > 50


@pytest.mark.parametrize("spacing", [1.0, 1.5, 1024.0, float(2**20)])
def test_lattices(device: torch.device, spacing: float) -> None:
    """Spacings at which cells of a hashed grid might collide."""
    steps = np.arange(8.0)
    start = spacing * np.stack(np.meshgrid(steps, steps, steps), axis=-1).reshape(-1, 3)
    pairs = check(start, start, np.full(512, 0.5), device=device)
    assert len(pairs) == (3 * 7 * 64 if spacing == 1.0 else 0)


@pytest.mark.parametrize("axes", [(0,), (1,), (2,), (0, 1), (1, 2)])
def test_flat_scenes(device: torch.device, axes: tuple[int, ...]) -> None:
    rng = np.random.default_rng(15)
    start = np.zeros((500, 3))
    start[:, axes] = 500 ** (1 / len(axes)) * rng.uniform(-1, 1, (500, len(axes)))
    assert len(check(*stirred(rng, start, np.full(500, 0.7)), device=device)) > 200


def test_many_worlds_in_one_place(device: torch.device) -> None:
    rng = np.random.default_rng(16)
    start, end, radius = scattered(rng, 800, 3.0)
    world = rng.integers(0, 100, 800)
    pairs = check(start, end, radius, world=world, device=device)
    assert len(pairs) > 100 and (world[pairs[:, 0]] == world[pairs[:, 1]]).all()


def test_more_pairs_than_expected(device: torch.device) -> None:
    """Rows far longer than average, and more pairs than the initial buffers hold."""
    rng = np.random.default_rng(17)
    start = rng.uniform(-0.5, 0.5, (2500, 3))
    start[:, 0] += 4.0 * (np.arange(2500) % 2)
    found = agreed(*stirred(rng, start, np.full(2500, 1.0), 0.01), device=device)
    assert len(found) == 2 * (1250 * 1249 // 2)
    assert torch.equal(found[:, 0], found[:, 0].sort().values)


@st.composite
def scenes(draw: st.DrawFn) -> tuple[Arrays, float, dict[str, Any]]:
    """Clusters of any size and distance, sizes and speeds over wide ranges, and filters."""
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    count = draw(st.integers(0, 60))
    clusters = draw(st.integers(1, 4))
    distance, size_range, speed = (10.0 ** draw(st.integers(low, high)) for low, high in ((-3, 9), (0, 6), (-6, 4)))
    centre = distance * rng.normal(size=(clusters, 3))[rng.integers(0, clusters, count)]
    radius = size_range ** rng.uniform(-1, 0, count)
    start = centre + draw(st.sampled_from([0.0, 0.1, 1.0, 5.0])) * rng.normal(size=(count, 3))
    filters: dict[str, Any] = {}
    if draw(st.booleans()):
        filters["world"] = rng.integers(0, draw(st.sampled_from([1, 2, 2**31])), count)
    if draw(st.booleans()):
        filters["static"] = rng.random(count) < 0.5
    return stirred(rng, start, radius, speed), draw(st.sampled_from([0.0, 0.01, 1.0])), filters


@given(scenes())
@settings(max_examples=200)
def test_random_scenes(scene: tuple[Arrays, float, dict[str, Any]]) -> None:
    arrays, separation, filters = scene
    check(*arrays, separation, **filters)


@pytest.mark.slow
@pytest.mark.parametrize("count", [30_000, 200_000])
def test_the_same_pairs_in_large_scenes(device: torch.device, count: int) -> None:
    rng = np.random.default_rng(count)
    for spread, ratio in ((1.3, 1.0), (0.6, 100.0), (0.9, 1.0)):
        start = spread * count ** (1 / 3) * rng.uniform(-1, 1, (count, 3))
        assert len(agreed(*stirred(rng, start, ratio ** rng.uniform(-1, 0, count)), device=device)) > count // 10


def test_threads_do_not_matter() -> None:
    rng = np.random.default_rng(18)
    start = 40.0 * rng.uniform(-1, 1, (20_000, 3))
    scene = stirred(rng, start, 10.0 ** rng.uniform(-1, 0, 20_000))
    threads = torch.get_num_threads()
    found = []
    try:
        for number in (1, 2, 5):
            torch.set_num_threads(number)
            found.append(agreed(*scene))
    finally:
        torch.set_num_threads(threads)
    assert all(torch.equal(found[0], pairs) for pairs in found) and len(found[0]) > 1000


def test_auto_chooses_by_number_and_sizes(device: torch.device) -> None:
    rng = np.random.default_rng(19)

    def bodies(count: int, *sizes: float) -> pgccd.MovingBodies:
        start, turn = rng.uniform(-3, 3, (count, 3)), unit_quaternions(rng, 1).repeat(count, axis=0)
        index = torch.arange(count) % len(sizes)
        scene = pgccd.Scene([tetrahedron(size) for size in sizes], index, device)
        return pgccd.MovingBodies.of(scene, pgccd.RigidMotion(*tensors(start, turn, start, turn, device=device)))

    mixed = tuple(2.0**k for k in range(10))
    assert pgccd.broad.choose(bodies(100, 1.0)) == pgccd.broad.choose(bodies(100, *mixed)) == "sweep"
    assert pgccd.broad.choose(bodies(5_000, 1.0)) == pgccd.broad.choose(bodies(5_000, 1.0, 1000.0)) == "grid"
    on_cpu = device.type == "cpu"
    assert pgccd.broad.choose(bodies(5_000, *mixed)) == ("sweep" if on_cpu else "grid")
    assert pgccd.broad.choose(bodies(200_000, *mixed)) == ("lbvh" if on_cpu else "grid")
    crowd = bodies(20, 1.0)
    still = crowd.position_t0, torch.tensor([[1.0, 0.0, 0.0, 0.0]], device=device).repeat(20, 1)
    motion = pgccd.RigidMotion.at_rest(*still)
    for named in ("sweep", "grid", "lbvh"):
        assert pgccd.broad.choose(crowd, named) == named
        hits = pgccd.detect(crowd.scene, motion, broad_phase=named)
        assert hits.stats.broad_phase == named and hits.stats.pcs > 0
    assert pgccd.detect(crowd.scene, motion).stats.broad_phase == "sweep"
    pairs = pgccd.broad.find_pairs(crowd)
    assert pgccd.detect(crowd.scene, motion, pairs=pairs).stats.broad_phase == "given"


@pytest.mark.parametrize("worlds", [1, 3])
@pytest.mark.parametrize("present", [0, 1, 40, 900])
def test_rows_without_a_body(device: torch.device, worlds: int, present: int) -> None:
    """Padding: a radius below zero. It is never found, and many such rows in one place cost no time."""
    rng = np.random.default_rng(21)
    start, end, radius = scattered(rng, 900, 5.0)
    world = rng.integers(0, worlds, 900) if worlds > 1 else None
    rows = np.sort(rng.permutation(900)[:present])
    filters = {} if world is None else {"world": world[rows]}
    expected = rows[check(start[rows], end[rows], radius[rows], device=device, **filters)]
    absent = np.setdiff1d(np.arange(900), rows)
    radius[absent] = -np.inf
    for place in (None, 0.0, 3.0):
        if place is not None:
            start[absent] = end[absent] = place
        for tolerance in (0.0, -1e-6):
            options = {"tolerance": tolerance, "device": device, "world": world}
            assert np.array_equal(agreed(start, end, radius, **options).numpy(), expected.reshape(-1, 2))
