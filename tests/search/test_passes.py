"""A step searched in passes: the contacts of the whole, for any order of rows and any capacity."""

from __future__ import annotations

import sys
from dataclasses import replace
from typing import Any

import pytest
import torch
from support.capacities import ON_GPU
from support.crowds import crowds
from support.same_bits import assert_same

import pgccd
from pgccd.runtime.sizes import BufferSizes, Capacity
from pgccd.search.detect import detect_moving
from pgccd.search.memory import CapacityEstimate, estimate_of
from pgccd.search.padded import counts_of_given
from pgccd.search.passes import SearchPass, contacts_of_step, find_pass, pairs_of_rounds
from pgccd.search.query import Query

passes_module = sys.modules["pgccd.search.passes"]


class Divided:
    """A step, its contacts, and two passes of it; the second has the bodies in another order, with some missing.

    Args:
        padded: whether rows of -1 follow the pairs, so that only the device has their number.
        estimates: of the passes of an earlier step.
    """

    def __init__(
        self,
        device: torch.device,
        report: Any,
        padded: bool,
        estimates: tuple[CapacityEstimate, CapacityEstimate] | None = None,
    ) -> None:
        crowd = crowds()["faster than cells"]
        self.query = Query(report, 0.01, None, False)

        def moving(rows: torch.Tensor) -> pgccd.MovingBodies:
            motion = crowd.motion(rows)
            pose = (motion.position_t0, motion.orientation_t0, motion.position_t1, motion.rotation)
            scene = pgccd.Scene(crowd.meshes, crowd.mesh_index[rows], device)
            return pgccd.MovingBodies.of(scene, pgccd.RigidMotion._of_checked(*(x.to(device) for x in pose), "rigid"))

        count = len(crowd.position)
        bodies = moving(torch.arange(count))
        self.pairs = pgccd.broad.find_pairs(bodies, 0.01)
        self.expected = detect_moving(bodies, self.query, pairs=self.pairs)
        turn = torch.rand(len(self.pairs), generator=torch.Generator().manual_seed(1)).to(device) < 0.5
        first, second = self.pairs[turn], self.pairs[~turn]
        rows = second.unique().flip(0)
        place = torch.zeros(count, dtype=torch.int64, device=device)
        place[rows] = torch.arange(len(rows), device=device)
        self.estimates = estimates or (CapacityEstimate(), CapacityEstimate())
        self.passes = [self._pass(bodies, first, padded, None, self.estimates[0])]
        self.passes.append(self._pass(moving(rows.cpu()), place[second], padded, rows, self.estimates[1]))

    def _pass(
        self,
        bodies: pgccd.MovingBodies,
        pairs: torch.Tensor,
        padded: bool,
        rows: torch.Tensor | None,
        estimate: CapacityEstimate,
    ) -> SearchPass:
        counts = None
        if padded:
            counts = counts_of_given(pairs, torch.tensor([len(pairs)], device=pairs.device))
            pairs = torch.cat([pairs, pairs.new_full((7, 2), -1)])
        return SearchPass(self.query, bodies, pairs, counts, rows, estimate=estimate)

    def check(self) -> None:
        found = contacts_of_step(self.passes)
        assert len(self.expected) > 5 and found.stats.pcs == self.expected.stats.pcs
        assert found.stats.contacts == len(found) == len(self.expected)
        order = torch.argsort(found.pairs[:, 0] * 10**6 + found.pairs[:, 1], stable=True)
        assert_same(found[order], self.expected)
        pairs = pairs_of_rounds(self.passes)
        assert torch.equal(pairs[pairs[:, 0] >= 0].unique(dim=0), self.pairs)


@pytest.mark.parametrize("padded", [False, True])
@pytest.mark.parametrize("report", ["any", "first", "all"])
def test_same_contacts(device: torch.device, report: Any, padded: bool) -> None:
    Divided(device, report, padded).check()
    begun = Divided(device, report, padded)
    for search_pass in begun.passes:
        search_pass.begin()
    begun.check()
    started = Divided(device, report, padded)
    searches = [search_pass.start() for search_pass in started.passes]
    for search_pass, search in zip(started.passes, searches, strict=True):
        search_pass.learn(search.read())
    started.check()
    assert all(each.start() is search for each, search in zip(started.passes, searches, strict=True))


def test_too_little_capacity(device: torch.device, monkeypatch: pytest.MonkeyPatch) -> None:
    divided = Divided(device, "first", padded=True)
    with monkeypatch.context() as patch:
        little = BufferSizes(0, 1)
        patch.setattr(sys.modules["pgccd.search.detect"], "EXACTLY", little)
        patch.setattr(CapacityEstimate, "capacity", lambda *_: little)
        counts = [search_pass.start().read() for search_pass in divided.passes]
    assert all(each.overflow for each in counts)
    divided.passes[0].learn(counts[0])  # calling learn is optional
    divided.check()


@pytest.mark.parametrize("device", ON_GPU, indirect=True)
def test_a_pass_gets_the_capacity_that_it_needed(device: torch.device) -> None:
    estimates = None
    for _ in range(2):
        divided = Divided(device, "all", True, estimates)
        divided.check()
        estimates = divided.estimates
        needed = [search_pass.find().stats.needed for search_pass in divided.passes]
    for search_pass, each in zip(divided.passes, needed, strict=True):
        assert each is not None
        capacity = search_pass.start().capacity
        for name in ("leaf_pairs", "candidates", "contacts"):
            assert getattr(each, name) <= getattr(capacity, name) <= 2 * getattr(each, name) + 2 * 4096


def test_what_is_learnt_of_steps() -> None:
    """In proportion to pairs where they are given, otherwise to bodies."""
    divided = Divided(torch.device("cpu"), "first", padded=False)
    scene, query, pairs = divided.passes[0].bodies.scene, divided.query, divided.pairs
    needed = replace(Capacity.of(100_000), launches=9)
    of_bodies, of_pairs = CapacityEstimate(), CapacityEstimate()
    assert of_bodies.capacity(scene, None) == Capacity.of(scene.body_count)
    of_bodies.learn(scene.body_count, needed)
    of_pairs.learn(len(pairs), replace(needed, launches=10))
    of_bodies.learn(0, BufferSizes(0, 0))  # zero bodies change nothing
    assert of_bodies.capacity(scene, None) == needed.times(1.25)
    assert of_bodies.capacity(scene, None, slack=2.0) == needed.times(2.0)
    half = pairs[: len(pairs) // 2]
    assert of_pairs.capacity(scene, half).candidates == needed.times(1.25 * len(half) / len(pairs)).candidates
    # A scene has an estimate per report, and per octave of the number of given pairs.
    assert estimate_of(scene, query, None) is estimate_of(scene, query, None)
    assert estimate_of(scene, query, pairs) is not estimate_of(scene, query, None)
    assert estimate_of(scene, query, half) is not estimate_of(scene, query, pairs)
    assert estimate_of(scene, replace(query, report="all"), None) is not estimate_of(scene, query, None)


@pytest.mark.parametrize("capacity", ["enough", "too little"])
def test_pairs_found_in_a_fixed_capacity(device: torch.device, capacity: str, monkeypatch: pytest.MonkeyPatch) -> None:
    whole = Divided(device, "first", False)
    bodies = whole.passes[0].bodies
    capacity = Capacity.of(bodies.scene.body_count).times(4.0) if capacity == "enough" else BufferSizes(3, 1)
    monkeypatch.setattr(passes_module, "_looks_ahead", lambda _: True)
    monkeypatch.setattr(passes_module, "expected_capacity", lambda *_, slack: capacity)

    def even(pairs: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Pairs whose first body is in an even row, compacted to the front."""
        chosen = (pairs[:, 0] % 2 == 0) & (pairs[:, 0] >= 0)
        kept = torch.full_like(pairs, -1)
        kept[: int(chosen.sum())] = pairs[chosen]
        return kept, chosen.sum().reshape(1)

    for select in (None, even):
        for flag in (None, 0, 1):
            discard = None if flag is None else torch.tensor([flag], device=device)
            search_pass = find_pass(bodies, whole.query, select=select, discard=discard)
            search_pass.start()
            if flag == 1:  # no pairs, so nothing to search
                assert bool((search_pass.pairs < 0).all()) and search_pass.start().read().pairs_written == 0
                continue
            found = search_pass.find()
            expected = whole.expected.pairs
            expected = expected if select is None else expected[expected[:, 0] % 2 == 0]
            assert len(expected) > 2 and torch.equal(found.pairs, expected)
