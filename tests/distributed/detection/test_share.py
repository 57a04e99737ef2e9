"""Own pairs found without synchronising, in any capacity: steps bitwise equal to one process."""

from __future__ import annotations

import functools
import gc
import weakref
from dataclasses import replace
from typing import Any
from unittest import mock

import pytest
from support.ranks import World
from support.steps import step_of

from pgccd import sim
from pgccd.distributed import Cells, Comm
from pgccd.runtime.sizes import EXACTLY, Capacity
from pgccd.search import passes as passes_module
from pgccd.search.passes import SearchPass
from pgccd.sim import Simulation, starting_share

CONFIG = sim.ModelConfig(robots=150, speed=0.3, spin=0.5, seed=3)
STEPS = 14
PLENTY = Capacity.of(600)
CAPACITIES = {
    "plenty": PLENTY,
    "none": EXACTLY,
    "pairs": replace(PLENTY, pairs=4),
    "contacts": replace(PLENTY, contacts=1),
    "too much memory": None,
}


def without_times(record: dict[str, Any]) -> dict[str, Any]:
    return {name: value for name, value in record.items() if "seconds" not in name and name != "ranks"}


@functools.cache
def by_one_process() -> list[dict[str, Any]]:
    model = sim.Model(CONFIG)
    state, records = model.start(), []
    for index in range(STEPS):
        step = step_of(model, state, index)
        state = step.after
        records.append(without_times(step.record))
    return records


def by_ranks(comm: Comm, capacity: str) -> tuple[list[dict[str, Any]], int, int]:
    """The records; how often own pairs were found again; and how many own passes overflowed."""
    model = sim.Model(CONFIG)
    half = model.half_extent
    partition = Cells.uniform(tuple(-x for x in half), half, comm.size, cells=2)
    renewed = searched = 0

    class Watched(SearchPass):
        def __init__(self, *given: Any, **more: Any) -> None:
            super().__init__(*given, **more)
            find_pairs = self.find_pairs

            def renew() -> Any:
                nonlocal renewed
                renewed += 1
                return find_pairs()

            self.find_pairs = find_pairs and renew

        def find(self) -> Any:
            nonlocal searched
            former = self.pairs
            found = super().find()
            searched += self.rows is None and self.pairs is not former
            return found

    patches = {
        "_looks_ahead": lambda _: True,
        "expected_capacity": lambda *_, slack: CAPACITIES[capacity],
        "SearchPass": Watched,
    }
    with mock.patch.multiple(passes_module, **patches):
        simulation = Simulation.create(comm, model, partition, starting_share(comm, model))
        made = [simulation.step(index) for index in range(STEPS)]
    records = [without_times(step.record) for step in made]
    for step in made:
        found = step.share
        assert len(found.pairs) == step.record["ranks"]["pcs"][comm.rank] and bool((found.pairs >= 0).all())
    return records, renewed, searched


@pytest.mark.parametrize("capacity", list(CAPACITIES))
def test_same_steps(ranks: World, capacity: str) -> None:
    expected = by_one_process()
    assert sum(step["contacts"] for step in expected) > 20
    for records, renewed, searched in ranks.run(3, by_ranks, capacity):
        assert records == expected
        assert (renewed > 1) == (capacity in ("none", "pairs"))
        if capacity == "plenty":
            assert searched == STEPS


def leave_no_garbage(comm: Comm) -> None:
    model = sim.Model(CONFIG)
    half = model.half_extent
    partition = Cells.uniform(tuple(-x for x in half), half, comm.size, cells=2)
    simulation = Simulation.create(comm, model, partition, starting_share(comm, model))
    made: list[weakref.ref[SearchPass]] = []

    class Watched(SearchPass):
        def __post_init__(self) -> None:
            super().__post_init__()
            made.append(weakref.ref(self))

    patches = {"_looks_ahead": lambda _: True, "expected_capacity": lambda *_, slack: PLENTY, "SearchPass": Watched}
    gc.collect()
    gc.disable()
    try:
        with mock.patch.multiple(passes_module, **patches):
            step = simulation.step(0)
            assert len(made) == 2 and all(each() is not None for each in made)
            del step
        assert all(each() is None for each in made)
    finally:
        gc.enable()


def test_the_memory_of_a_step_is_freed_without_garbage_collection(ranks: World) -> None:
    ranks.run(2, leave_no_garbage)
