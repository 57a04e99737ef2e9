"""Detection in a fixed capacity: the same contacts, no host waits, and overflow is reported."""

from __future__ import annotations

from dataclasses import fields, replace
from typing import Any

import numpy as np
import pytest
import torch
from support.capacities import DEVICES_AND_PARTS
from support.crowds import crowds
from support.reports import detected
from support.same_bits import assert_same
from support.shapes import approaching, bumpy

import pgccd
from pgccd.runtime.sizes import BufferSizes, Capacity, Counts
from pgccd.search.detect import _detect_in_capacity as detect_at_once
from pgccd.search.memory import CapacityEstimate
from pgccd.search.padded import counts_of_given, lower_first_toi
from pgccd.search.query import Query

REPORTS = ("any", "first", "all", "earliest")


def crowd(device: torch.device, name: str = "faster than cells") -> tuple[pgccd.Scene, pgccd.RigidMotion]:
    bodies = crowds()[name]
    columns = (bodies.position, bodies.orientation, bodies.velocity, bodies.rotation)
    motion = pgccd.RigidMotion.from_velocity(*(column.to(device) for column in columns), dt=1.0)
    return pgccd.Scene(bodies.meshes, bodies.mesh_index, device), motion


def shells(device: torch.device) -> tuple[pgccd.Scene, pgccd.RigidMotion]:
    """A body of 5,120 triangles that moves against the inside of another."""
    rng = np.random.default_rng(2)
    meshes = [bumpy(rng, 4, height=0.02, size=size) for size in (1.0, 1.1)]
    position, velocity = torch.zeros(2, 3, dtype=torch.float64), torch.zeros(2, 3, dtype=torch.float64)
    velocity[0, 0] = 0.15
    unit = torch.tensor([[1.0, 0.0, 0.0, 0.0]] * 2, dtype=torch.float64)
    motion = pgccd.RigidMotion.from_velocity(position, unit, velocity, torch.zeros_like(velocity), dt=1.0)
    return pgccd.Scene(meshes, device=device), motion.to(device)


def capacity_for(scene: pgccd.Scene, motion: Any, *arguments: Any, **options: Any) -> tuple[pgccd.Contacts, Capacity]:
    found = detected(scene, motion, *arguments, **options)
    assert found.stats.needed is not None
    return found, found.stats.needed.times(1.5)


@pytest.mark.parametrize("report", REPORTS)
def test_same_contacts_in_a_fixed_capacity(device: torch.device, report: Any) -> None:
    scene, motion = crowd(device)
    for broad_phase in ("sweep", "grid", "lbvh"):
        expected, capacity = capacity_for(scene, motion, report, 0.01, broad_phase=broad_phase)
        assert len(expected) > 0
        hits = detected(scene, motion, report, 0.01, broad_phase=broad_phase, capacity=capacity)
        assert int(hits.count) == len(expected) and not bool(hits.overflow)
        trimmed = hits.trim()
        assert_same(trimmed, expected)
        for name in ("pcs", "contacts", "unresolved", "broad_phase"):
            assert getattr(trimmed.stats, name) == getattr(expected.stats, name), name
        assert set(trimmed.stats.seconds) >= {"broad", "traverse", "narrow"}
        assert all(spent >= 0.0 for spent in trimmed.stats.seconds.values())


def test_padding(device: torch.device) -> None:
    scene, motion = crowd(device)
    expected, capacity = capacity_for(scene, motion, "all")
    hits = pgccd.detect(scene, motion, "all", capacity=capacity)
    count = len(expected)
    assert len(hits.pairs) == capacity.contacts > count
    assert torch.equal(hits.pairs[:count], expected.pairs) and torch.equal(hits.toi[:count], expected.toi)
    padding = {"pairs": -1, "features": -1, "toi": torch.inf, "kind": 0, "status": pgccd.Status.FREE, "coordinates": 0}
    for column, value in (padding | {"point": 0, "normal": 0}).items():
        assert bool((getattr(hits, column)[count:] == value).all()), column
    assert torch.equal(hits.toi.min(), expected.toi.min())


def test_deforming_bodies_and_given_pairs(device: torch.device) -> None:
    bodies = approaching(np.random.default_rng(5), (0, 1, 0), (1.0, 1.0, 1.0), closeness=0.7)
    scene = bodies.scene(device)
    x = torch.cat([m.vertices + torch.from_numpy(p) for m, p in zip(bodies.meshes, bodies.position_t0, strict=True)])
    moving = pgccd.VertexMotion(x.to(device), (x + 0.3 * torch.randn(3, dtype=torch.float64)).to(device))
    pairs = torch.tensor([[0, 2], [1, 2]], device=device)
    for motion, given in ((moving, None), (moving, pairs), (bodies.motion(device=device), pairs)):
        expected, capacity = capacity_for(scene, motion, "all", 0.1, pairs=given)
        assert_same(pgccd.detect(scene, motion, "all", 0.1, pairs=given, capacity=capacity).trim(), expected)
    nothing = pgccd.detect(scene, moving, pairs=pairs[:0], capacity=capacity)
    assert int(nothing.count) == 0 and not bool(nothing.overflow) and len(nothing.trim()) == 0


@pytest.mark.parametrize(("device", "part"), DEVICES_AND_PARTS, indirect=["device"])
def test_too_little_capacity_is_reported(device: torch.device, part: str) -> None:
    # The launches for small bodies leave no tasks behind.
    scene, motion = shells(device) if part == "tasks" else crowd(device)
    expected, capacity = capacity_for(scene, motion, "all", broad_phase="grid")
    needed = expected.stats.needed
    assert needed is not None and getattr(needed, part) > 1
    tight = replace(capacity, **{part: getattr(needed, part) // 2})
    hits = pgccd.detect(scene, motion, "all", broad_phase="grid", capacity=tight)
    assert bool(hits.overflow)
    with pytest.raises(pgccd.CapacityError, match=part) as error:
        hits.trim()
    # Growing reaches a sufficient capacity in a few steps.
    for _ in range(6):
        more = error.value.larger
        hits = pgccd.detect(scene, motion, "all", broad_phase="grid", capacity=more)
        if not bool(hits.overflow):
            break
        with pytest.raises(pgccd.CapacityError) as error:
            hits.trim()
    assert_same(hits.trim(), expected)


def test_no_capacity_at_all(device: torch.device) -> None:
    scene, motion = crowd(device)
    hits = pgccd.detect(scene, motion, capacity=BufferSizes(0, 0))
    assert bool(hits.overflow) and len(hits.pairs) == 0
    with pytest.raises(pgccd.CapacityError, match="in 0"):
        hits.trim()


def test_a_body_with_many_partners(device: torch.device) -> None:
    bodies = crowds()["a terrain under all"]
    scene, motion = crowd(device, "a terrain under all")
    many = torch.cat([torch.arange(len(bodies.mesh_index)), *[torch.arange(1, len(bodies.mesh_index))] * 2])
    columns = columns_of(motion)
    motion = pgccd.RigidMotion.from_rotation(*(column[many.to(device)] for column in columns))
    scene = pgccd.Scene(bodies.meshes, bodies.mesh_index[many], device)
    assert int(torch.bincount(pgccd.broad.find_pairs(pgccd.MovingBodies.of(scene, motion))[:, 0]).max()) > 32
    expected, capacity = capacity_for(scene, motion)
    assert_same(pgccd.detect(scene, motion, capacity=capacity).trim(), expected)
    if device.type == "cuda":
        assert capacity.long_rows
        assert bool(pgccd.detect(scene, motion, capacity=replace(capacity, long_rows=False)).overflow)


def test_invalid_poses_are_reported_later(device: torch.device) -> None:
    scene, motion = crowd(device)
    capacity = Capacity.of(scene.body_count)
    for broad_phase in ("sweep", "grid", "lbvh"):
        columns = columns_of(motion)
        columns[2] = columns[2].clone()
        columns[2][3, 1] = torch.nan
        with pytest.MonkeyPatch.context() as patch:  # a CPU would report it at once
            patch.setattr(torch.compiler, "is_compiling", lambda: True)
            wrong = pgccd.RigidMotion.from_rotation(*columns)
        hits = pgccd.detect(scene, wrong, broad_phase=broad_phase, capacity=capacity)
        assert bool(hits.overflow) and bool(hits.invalid)
        with pytest.raises(ValueError, match="position_t1: body 3"):
            hits.trim()


def columns_of(motion: pgccd.RigidMotion) -> list[torch.Tensor]:
    return [motion.position_t0, motion.orientation_t0, motion.position_t1, motion.rotation]


@pytest.mark.slow
def test_compile_the_whole_step(device: torch.device) -> None:
    scene, motion = crowd(device)
    expected, capacity = capacity_for(scene, motion)

    @torch.compile(fullgraph=True, backend="aot_eager")
    def step(*columns: torch.Tensor) -> tuple[torch.Tensor, ...]:
        hits = pgccd.detect(scene, pgccd.RigidMotion.from_rotation(*columns), capacity=capacity)
        assert hits.toi is not None
        return hits.pairs, hits.toi.clamp(max=1.0), hits.count, hits.overflow

    pairs, toi, count, overflow = step(*columns_of(motion))
    assert int(count) == len(expected) and not bool(overflow)
    assert torch.equal(pairs[: len(expected)], expected.pairs)
    assert torch.equal(toi[: len(expected)], expected.toi) and bool((toi[len(expected) :] == 1.0).all())
    columns = columns_of(motion)
    columns[0] = columns[0] * torch.nan
    assert bool(step(*columns)[3])


@pytest.mark.cuda
@pytest.mark.parametrize("report", REPORTS)
@pytest.mark.parametrize("broad_phase", ["sweep", "grid", "lbvh"])
def test_capture_in_a_graph(report: Any, broad_phase: Any) -> None:
    scene, motion = crowd(torch.device("cuda"))
    _, capacity = capacity_for(scene, motion, report, broad_phase=broad_phase)
    columns = [column.clone() for column in columns_of(motion)]

    def step() -> pgccd.PaddedContacts:
        moved = pgccd.RigidMotion.from_rotation(*columns)
        return detected(scene, moved, report, broad_phase=broad_phase, capacity=capacity)

    stream = torch.cuda.Stream()
    stream.wait_stream(torch.cuda.current_stream())
    with torch.cuda.stream(stream):
        step()
    torch.cuda.current_stream().wait_stream(stream)
    graph = torch.cuda.CUDAGraph()
    with torch.cuda.graph(graph):
        hits = step()
    contacts = set()
    for shift in (0.0, 0.01, -0.02):
        columns[2].copy_(motion.position_t1 + shift * motion.position_t1.sin())
        graph.replay()
        moved = pgccd.RigidMotion.from_rotation(*(column.clone() for column in columns))
        expected = detected(scene, moved, report, broad_phase=broad_phase)
        assert_same(hits.trim(), expected)
        contacts.add(len(expected))
    assert max(contacts) > 0


@pytest.mark.cuda
def test_one_wait_a_step() -> None:
    scene, motion = crowd(torch.device("cuda"))
    for report in REPORTS:
        detected(scene, motion, report)
        assert detected(scene, motion, report).stats.waits == 1
    # In a fixed capacity there is no wait, and no copy to the host.
    capacity = Capacity.of(scene.body_count)
    torch.cuda.set_sync_debug_mode("error")
    try:
        pgccd.detect(scene, motion, capacity=capacity)
    finally:
        torch.cuda.set_sync_debug_mode("default")


@pytest.mark.parametrize("report", REPORTS)
def test_capacity_grows_until_a_step_fits(device: torch.device, report: Any) -> None:
    scene, motion = crowd(device)
    expected = detected(scene, motion, report, broad_phase="grid")
    query = Query(report, 0.0, None, False)
    for names in (("pairs", "contacts"), tuple(field.name for field in fields(BufferSizes) if field.type == "int")):
        assert expected.stats.needed is not None
        # As if the last step had needed almost no capacity.
        little = replace(expected.stats.needed, **dict.fromkeys(names, 0))
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(CapacityEstimate, "capacity", lambda *_, little=little: little)
            found = detect_at_once(pgccd.MovingBodies.of(scene, motion, wait=False), query, "grid", None, None)
        assert found is not None and found.stats.waits > 1
        assert (found.stats.scratch_bytes > 0) == (device.type == "cuda")
        assert_same(found, expected)
    # The need is remembered; with a budget too small for it the step is streamed.
    bodies = pgccd.MovingBodies.of(scene, motion, wait=False)
    again = detect_at_once(bodies, query, "grid", None, None)
    assert again is not None and again.stats.waits == 1
    assert detect_at_once(bodies, query, "grid", None, 1000) is None
    assert_same(detected(scene, motion, report, broad_phase="grid", memory_budget=1000), expected)


def test_first_toi_alone(device: torch.device) -> None:
    scene, motion = crowd(device)
    bodies, query = pgccd.MovingBodies.of(scene, motion), Query("first", 0.01, None, True)
    pairs = pgccd.broad.sweep(bodies, 0.01)
    options = {"nonzero_toi": True, "initial": "assume_free"}
    hits, capacity = capacity_for(scene, motion, "first", 0.01, **options, pairs=pairs)
    assert 0 < len(hits) < len(pairs)
    assert hits.toi is not None
    expected = torch.full((scene.body_count,), torch.inf, dtype=torch.float64, device=device)
    expected.scatter_reduce_(0, hits.pairs.view(-1), hits.toi.repeat_interleave(2), "amin")
    expected[0] = 0.0  # from an earlier call
    padded = torch.cat([pairs, pairs.new_full((3, 2), -1)])
    count = torch.tensor([len(pairs)], device=device)

    def lowered(capacity: Capacity, given: torch.Tensor = padded, count: torch.Tensor = count) -> torch.Tensor:
        nonlocal seen
        first = torch.full_like(expected, torch.inf)
        first[0] = 0.0
        asked = bodies.mesh_set, bodies.tensors, False, given, counts_of_given(given, count)
        seen = Counts.of(lower_first_toi(first, given, *asked, query, capacity).tolist())
        return first

    seen: Counts
    for given in (capacity, replace(capacity, contacts=0)):  # no capacity for contacts
        assert torch.equal(lowered(given), expected)
        assert seen.contacts == len(hits) and not seen.overflow and seen.pairs_written == len(pairs)
        assert seen.broad_began <= seen.traverse_began <= seen.traverse_ended <= seen.narrow_ended
    # Pairs past the count are not read.
    for given in (padded, padded[:0]):
        first = lowered(capacity, given, torch.zeros_like(count))
        assert first.tolist() == [0.0, *[torch.inf] * (scene.body_count - 1)]
        assert seen.contacts == 0 and not seen.overflow
    if device.type == "cuda":  # a CPU allocates on demand
        for name in ("leaf_pairs", "candidates", "open"):
            lowered(replace(capacity, **{name: 1}))
            assert seen.overflow, name


def test_capacities_for_like_needs_are_mostly_of_one_size() -> None:
    capacities = set()
    for pairs in range(100_000, 103_000, 100):
        capacity = BufferSizes(pairs=pairs, contacts=pairs // 20).times(1.25)
        assert 1.25 * pairs + 4096 <= capacity.pairs <= 1.125 * (1.25 * pairs + 4097)
        capacities.add(capacity.pairs)
    assert len(capacities) <= 2
