"""Margins: thickness of bodies, added to the separation of each pair."""

from __future__ import annotations

from fractions import Fraction

import numpy as np
import pytest
import torch
from support.origins import recentred
from support.reports import detected
from support.same_bits import assert_same
from support.shapes import bumpy, directions, height_field, tensors, tetrahedron, unit_quaternions

import pgccd


class Heap:
    """Bodies of a few kinds, some with origins at joints, in a box."""

    def __init__(self, device: torch.device, count: int = 60, seed: int = 4) -> None:
        rng = np.random.default_rng(seed)
        self.meshes = [bumpy(rng, 0), bumpy(rng, 1, size=0.5), recentred(bumpy(rng, 0), 2.0 * directions(rng, 1)[0])]
        self.index = torch.tensor(rng.integers(0, 3, count))
        self.columns = tensors(
            rng.uniform(0.0, 10.0, (count, 3)),
            unit_quaternions(rng, count),
            0.5 * rng.normal(size=(count, 3)),
            rng.normal(size=(count, 3)),
            device=device,
        )
        self.margin = torch.tensor(rng.uniform(0.0, 0.2, count))
        self.device = device

    def detect(
        self, report: str = "all", path: str = "rigid", margin: object = None, **options: object
    ) -> pgccd.Contacts:
        scene = pgccd.Scene(self.meshes, self.index, self.device, margin=margin)  # type: ignore[arg-type]
        motion = pgccd.RigidMotion.from_velocity(*self.columns, dt=1.0, path=path)  # type: ignore[arg-type]
        return detected(scene, motion, report, **options)


@pytest.mark.parametrize("path", ["rigid", "linear"])
@pytest.mark.parametrize("report", ["any", "first", "all", "earliest"])
def test_equal_margins_are_a_separation(report: str, path: str, device: torch.device) -> None:
    heap = Heap(device)
    kept = heap.detect(report, path, min_separation=0.25)
    assert_same(heap.detect(report, path, margin=0.125), kept)
    assert_same(heap.detect(report, path, margin=0.0625, min_separation=0.125), kept)
    assert_same(heap.detect(report, path, margin=torch.zeros(60)), heap.detect(report, path))
    assert report == "earliest" or len(kept) > len(heap.detect(report, path)) > 0


def above(a: float, b: float) -> float:
    """The sum, rounded up."""
    total = a + b
    return float(np.nextafter(total, np.inf)) if Fraction(total) < Fraction(a) + Fraction(b) else total


def test_every_pair_has_the_separation_of_its_margins(device: torch.device) -> None:
    heap = Heap(device)
    margin = heap.margin.tolist()
    hits = {r: heap.detect(r, margin=heap.margin, min_separation=0.01) for r in ("first", "all")}
    pairs = torch.combinations(torch.arange(60, device=device), 2)
    near = heap.detect("any", min_separation=1.01, pairs=pairs).pairs
    for report, found in hits.items():
        rows = 0
        for pair in near:
            separation = above(0.01, above(margin[pair[0]], margin[pair[1]]))
            truth = heap.detect(report, min_separation=separation, pairs=pair[None])
            mine = (found.pairs == pair).all(dim=1)
            for name in ("features", "kind", "toi", "point"):
                assert torch.equal(getattr(found, name)[mine], getattr(truth, name)), name
            rows += len(truth)
        assert rows == len(found) > 50


def test_ways_of_asking_agree(device: torch.device) -> None:
    heap = Heap(device, 120)
    hits = heap.detect(margin=heap.margin)
    for broad_phase in ("sweep", "grid", "lbvh"):
        assert_same(heap.detect(margin=heap.margin, broad_phase=broad_phase), hits)
    streamed = heap.detect(margin=heap.margin, memory_budget=1)
    assert streamed.stats.chunks > 5
    assert_same(streamed, hits)
    capacity = (hits.stats.needed or pgccd.Capacity.of(120).times(100.0)).times(1.5)
    assert_same(heap.detect(margin=heap.margin, capacity=capacity).trim(), hits)  # type: ignore[attr-defined]


def test_bodies_that_rest_within_their_margins(device: torch.device) -> None:
    """Tips at a distance just below the sum of two margins, far outside both SBVs."""
    corners = tetrahedron().vertices.numpy()
    tip = corners[0]
    orientation = np.array([[1.0, 0.0, 0.0, 0.0]] * 2)
    meshes = [tetrahedron(), pgccd.Mesh(-corners, tetrahedron().faces[:, [0, 2, 1]])]
    for gap, count in ((5.0 - 1e-9, 1), (5.0 + 1e-5, 0)):
        x, q = tensors(np.stack([np.zeros(3), (2.0 + gap) * tip]), orientation, device=device)
        scene = pgccd.Scene(meshes, device=device, margin=[2.0, 3.0])
        for motion in (
            pgccd.RigidMotion(x, q, x, q),
            pgccd.RigidMotion(x, q, x, q, "linear"),
            pgccd.VertexMotion(*[torch.cat([m.vertices.to(device) + p for m, p in zip(meshes, x, strict=True)])] * 2),
        ):
            for broad_phase in ("sweep", "grid", "lbvh"):
                hits = pgccd.detect(scene, motion, tolerance=0.0, broad_phase=broad_phase)  # type: ignore[arg-type]
                assert len(hits) == count
                assert count == 0 or float(hits.toi[0]) == 0.0


def test_a_body_that_folds_keeps_twice_its_margin_from_itself(device: torch.device) -> None:
    rng = np.random.default_rng(1)
    sheet = height_field(rng, 6, 4, height=0.1)
    start = torch.cat([sheet.vertices, sheet.vertices + torch.tensor([0.0, 0.0, 1.0])]).to(device)
    end = start.clone()
    end[:, 0] = (end[:, 0] - 3.0).abs()
    motion = pgccd.VertexMotion(start, end)
    margins = pgccd.Scene([sheet, sheet], device=device, self_collision=True, margin=[0.125, 0.0625])
    found = pgccd.detect(margins, motion, "all")
    own = found.pairs[:, 0] == found.pairs[:, 1]
    for body, separation in ((0, 0.25), (1, 0.125)):
        kept = pgccd.detect(pgccd.Scene([sheet, sheet], device=device, self_collision=True), motion, "all", separation)
        mine, theirs = (h.pairs[:, 0] + h.pairs[:, 1] == 2 * body for h in (found, kept))
        mine, theirs = mine & own, theirs & (kept.pairs[:, 0] == kept.pairs[:, 1])
        assert torch.equal(found.features[mine], kept.features[theirs])
        assert torch.equal(found.toi[mine], kept.toi[theirs])
    assert int(own.sum()) > 50
