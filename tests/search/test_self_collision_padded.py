"""Self-collision in a fixed capacity: self pairs use capacity too, without a host wait."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from support.deforming import Ends, crumpled, motion_of
from support.reports import detected
from support.same_bits import assert_same

import pgccd
from pgccd import narrow
from pgccd.runtime.sizes import Capacity
from pgccd.search.memory import CapacityEstimate


def crumpled_capacity(device: torch.device) -> tuple[pgccd.Scene, list[Ends], pgccd.Capacity]:
    """A scene whose bodies collide with themselves, and the capacity for all contacts of its step."""
    shapes, ends = crumpled(2)
    scene = pgccd.Scene(shapes, device=device, self_collision=True)
    needed = pgccd.detect(scene, motion_of(*ends, device=device), "all").stats.needed
    assert needed is not None
    return scene, ends, replace(needed.times(2.0), candidates=100_000)


@pytest.mark.parametrize("report", list(narrow.REPORTS))
def test_in_a_fixed_capacity(device: torch.device, report: narrow.Report) -> None:
    shapes, ends = crumpled(4)
    scene = pgccd.Scene(shapes, device=device, self_collision=[False, True, True, True])
    motion = motion_of(*ends, device=device)
    expected = detected(scene, motion, report)
    needed = expected.stats.needed
    assert needed is not None and needed.pairs == expected.stats.pcs > 3
    # A CPU that bounds its search by a first guess has fewer candidates.
    capacity = replace(needed.times(1.5), candidates=100_000)
    for broad_phase in ("sweep", "grid", "lbvh"):
        hits = detected(scene, motion, report, broad_phase=broad_phase, capacity=capacity)
        assert not bool(hits.overflow)
        assert hits.trim().stats.pcs == needed.pairs
        assert_same(hits.trim(), expected)
    # Just enough, one too few, fewer than the self-colliding bodies, and none.
    for pairs in (needed.pairs, needed.pairs - 1, 2, 0):
        hits = detected(scene, motion, report, capacity=replace(capacity, pairs=pairs))
        assert bool(hits.overflow) == (pairs < needed.pairs)
        if pairs < needed.pairs:
            with pytest.raises(pgccd.CapacityError, match=f"pairs: .* in {pairs}"):
                hits.trim()


def test_invalid_vertices(device: torch.device) -> None:
    scene, ends, capacity = crumpled_capacity(device)
    ends[1][1][3, 2] = np.nan
    with pytest.MonkeyPatch.context() as patch:  # a CPU would report it at once
        patch.setattr(torch.compiler, "is_compiling", lambda: True)
        motion = motion_of(*ends, device=device)
    hits = pgccd.detect(scene, motion, capacity=capacity)
    assert bool(hits.overflow) and int(hits.count) == 0
    with pytest.raises(ValueError, match="^x_t1: vertex 45"):
        hits.trim()


@pytest.mark.slow
def test_compile_the_whole_step(device: torch.device) -> None:
    scene, ends, capacity = crumpled_capacity(device)
    start, end = (x.to(device) for x in (motion_of(*ends, device=device).x_t0, motion_of(*ends, device=device).x_t1))
    expected = pgccd.detect(scene, pgccd.VertexMotion(start, end))

    @torch.compile(fullgraph=True, backend="aot_eager")
    def step(x_t0: torch.Tensor, x_t1: torch.Tensor) -> tuple[torch.Tensor, ...]:
        hits = pgccd.detect(scene, pgccd.VertexMotion(x_t0, x_t1), capacity=capacity)
        return hits.pairs, hits.count, hits.overflow

    pairs, count, overflow = step(start, end)
    assert int(count) == len(expected) and not bool(overflow)
    assert torch.equal(pairs[: len(expected)], expected.pairs)


@pytest.mark.cuda
def test_capture_in_a_graph() -> None:
    scene, ends, capacity = crumpled_capacity(torch.device("cuda"))
    motion = motion_of(*ends, device=torch.device("cuda"))
    start, end = motion.x_t0.clone(), motion.x_t1.clone()
    torch.cuda.set_sync_debug_mode("error")  # no host wait, no copy to the host
    try:
        pgccd.detect(scene, pgccd.VertexMotion(start, end), "all", capacity=capacity)
    finally:
        torch.cuda.set_sync_debug_mode("default")
    stream = torch.cuda.Stream()
    stream.wait_stream(torch.cuda.current_stream())
    with torch.cuda.stream(stream):
        pgccd.detect(scene, pgccd.VertexMotion(start, end), "all", capacity=capacity)
    torch.cuda.current_stream().wait_stream(stream)
    graph = torch.cuda.CUDAGraph()
    with torch.cuda.graph(graph):
        hits = pgccd.detect(scene, pgccd.VertexMotion(start, end), "all", capacity=capacity)
    for shift in (0.0, 0.01, -0.02):
        end.copy_(motion.x_t1 + shift * motion.x_t1.sin())
        graph.replay()
        expected = pgccd.detect(scene, pgccd.VertexMotion(start.clone(), end.clone()), "all")
        assert len(expected) > 0
        assert_same(hits.trim(), expected)


def test_capacity_expected_of_a_first_step(device: torch.device) -> None:
    """More for self-colliding bodies, and more launches even after a step without them."""
    shapes, _ = crumpled(2)
    meshes = pgccd.MeshSet(shapes, device)
    plain, own = (pgccd.Scene(meshes, self_collision=wanted) for wanted in (False, True))
    estimate = CapacityEstimate()
    assert estimate.capacity(own, None).candidates > estimate.capacity(plain, None).candidates
    estimate.learn(2, Capacity.of(2))
    assert estimate.capacity(own, None).launches > estimate.capacity(plain, None).launches
