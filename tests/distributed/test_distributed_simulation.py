"""The nanorobot world on ranks: the same log and the same state as one process, for any owners of robots and
cells, however often these change.
"""

from __future__ import annotations

import functools
from typing import Any
from unittest import mock

import pytest
import torch

from distributed.conftest import World
from pgccd import sim
from pgccd.detection.capacity import Capacity
from pgccd.distributed import BalanceOptions, Comm, Partition, share
from pgccd.sim.distributed import DistributedSimulation, starting_share
from pgccd.sim.distributed.runner import gather_state, gather_step
from pgccd.sim.resolution import RoundPlan

TIMES = ("seconds", "stage_seconds", "ranks")
# Fast robots in a small model, so that much happens in few steps.
WORLDS = {
    "random": {"robots": 240, "speed": 0.3, "spin": 0.5, "seed": 3},
    "skewed": {"robots": 300, "pattern": "skewed", "speed": 0.25, "seed": 5},
}


@functools.cache
def single_run(name: str, steps: int) -> tuple[list[dict[str, Any]], sim.Step]:
    """By one process."""
    model = sim.Model(sim.ModelConfig(**WORLDS[name]))
    state = model.start()
    scene, records = model.scene(state.id), []
    for index in range(steps):
        step = sim.make_step(model, scene, state, index)
        state = step.after
        records.append(without_times(step.record))
    return records, step


def without_times(record: dict[str, Any]) -> dict[str, Any]:
    return {name: value for name, value in record.items() if name not in TIMES}


def make_simulation(comm: Comm, name: str, policy: str, overlap: bool, device: str = "cpu") -> DistributedSimulation:
    model = sim.Model(sim.ModelConfig(**WORLDS[name]), device=device)
    upper = model.half_extent
    partition = Partition.uniform(tuple(-x for x in upper), upper, comm.size, cells=4, device=device)
    start = starting_share(comm, model, partition)
    return DistributedSimulation(comm, model, partition, start, BalanceOptions(policy), overlap)


class Cramped(RoundPlan):
    """Exceeds its capacity in one round of some steps."""

    def __init__(self) -> None:
        super().__init__()
        self.steps = 0

    def capacity(self, round: int) -> Capacity:
        self.steps += round == 0
        return Capacity(0, 0) if self.steps % 4 == 3 and round == 1 else super().capacity(round)


def follow(
    comm: Comm,
    name: str,
    policy: str,
    steps: int,
    random_owners: bool,
    overlap: bool,
    device: str = "cpu",
    ahead: bool = False,
) -> dict[str, int]:
    """Compares every step's log and the last step's columns with one process. With `ahead`, steps are begun early too,
    as they are on a GPU, and now and then a rank exceeds its capacity."""
    records, last = single_run(name, steps)
    simulation = make_simulation(comm, name, policy, overlap, device)
    simulation.begins_early |= ahead
    if ahead and comm.rank == comm.size - 1:
        simulation._rounds = Cramped()
    generator = torch.Generator().manual_seed(17)
    seen = {"moved cells": 0, "arrived": 0, "contacts": 0, "away": 0}
    for index in range(steps):
        if random_owners and index % 5 == 2:
            # As though balancing had gone mad. Until the next migration, ranks have robots that they should not have.
            owner = torch.randint(comm.size, (simulation.partition.cell_count,), generator=generator)
            simulation.partition = simulation.partition.with_owner(owner)
        more = index % 4 != 3 and index + 1 < steps
        made = simulation.step(index, more=more)
        found = without_times(made.record)
        if device != "cpu":  # a GPU looks at others on the way to the same contacts
            found["candidates"] = records[index]["candidates"]
        assert found == records[index]
        if index % 3 == 0:  # what has been found can be looked at while the next step goes on
            assert len(made.detection.contacts) == made.record["ranks"]["contacts"][comm.rank]
        ranks = made.record["ranks"]
        for part, whole in (("bodies", "robots"), ("pcs", "pcs"), ("contacts", "contacts")):
            assert len(ranks[part]) == comm.size and sum(ranks[part]) == made.record[whole]
        at_home = bool((simulation.partition.owner_of(simulation.state.position) == comm.rank).all())
        assert at_home or (more and simulation.begins_early)
        seen["away"] += not at_home
        seen["moved cells"] += ranks["moved_cells"]
        seen["arrived"] += sum(ranks["arrived"])
        seen["contacts"] += made.record["contacts"]
    simulation.verify()
    state = gather_state(comm, simulation.state)
    step = gather_step(comm, made, state)
    if comm.rank == 0:
        for column, expected in last.after.columns.items():
            assert torch.equal(step.after.columns[column].cpu(), expected), column
        for column, expected in last.before.columns.items():
            assert torch.equal(step.before.columns[column].cpu(), expected), column
        for column in ("pairs", "toi", "kind", "features", "coordinates", "point", "normal", "status"):
            assert torch.equal(getattr(step.contacts, column).cpu(), getattr(last.contacts, column)), column
        assert torch.equal(step.resolution.fraction.cpu(), last.resolution.fraction)
    return seen


def follow_ahead(comm: Comm, name: str, policy: str, steps: int, random_owners: bool) -> dict[str, int]:
    """The same as it is done on GPUs: steps begun early, and ghosts sent without waiting for their number."""
    with mock.patch.object(share, "_sends_ahead", lambda comm, _: comm.size > 1):
        return follow(comm, name, policy, steps, random_owners, True, "cpu", True)


@pytest.mark.parametrize(
    ("name", "policy", "random_owners", "overlap"),
    [
        ("random", "cost", False, True),
        ("skewed", "one-cell", False, False),
        ("skewed", "measured", False, True),
        ("random", "none", True, True),
    ],
    ids=["cost", "one cell", "measured", "random owners"],
)
def test_same_bits_as_one_process(world: World, name: str, policy: str, random_owners: bool, overlap: bool) -> None:
    seen = world(follow, name, policy, 24, random_owners, overlap)
    assert seen[0]["contacts"] > 100
    if len(seen) > 1:
        assert seen[0]["arrived"] > 20
        if policy != "none":
            assert seen[0]["moved cells"] > 0


@pytest.mark.parametrize(("name", "policy"), [("random", "none"), ("random", "cost"), ("skewed", "one-cell")])
def test_same_bits_with_rounds_made_ahead(world: World, name: str, policy: str) -> None:
    """Now and then one rank alone exceeds its capacity, and all must make the rounds again."""
    seen = world(follow_ahead, name, policy, 24, policy == "none")
    if len(seen) > 1:
        assert seen[0]["arrived"] > 20
        if policy == "none":  # by the others, cells are about to change hands in almost every step of so few robots
            assert sum(rank["away"] for rank in seen) > 0


@pytest.mark.cuda
@pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device")
@pytest.mark.parametrize(("name", "policy"), [("random", "none"), ("random", "cost"), ("skewed", "one-cell")])
def test_same_bits_on_a_gpu_that_ranks_share(world: World, name: str, policy: str) -> None:
    world(follow, name, policy, 24, policy == "none", True, "cuda")


@pytest.mark.slow
@pytest.mark.parametrize("name", list(WORLDS))
@pytest.mark.parametrize("policy", ["cost", "measured", "one-cell", "none"])
def test_same_bits_for_two_hundred_steps(world: World, name: str, policy: str) -> None:
    """Where no policy shares the cells out, chance does; and all is done as on GPUs."""
    if policy == "none":
        world(follow_ahead, name, policy, 200, True)
    else:
        world(follow, name, policy, 200, False, True)


def begin_early(comm: Comm) -> None:
    simulation = make_simulation(comm, "random", "none", True)
    simulation.begins_early = True
    begun: list[int] = []
    begin = simulation._begin

    def watched(index: int, *more: Any) -> Any:
        begun.append(index)
        return begin(index, *more)

    records, _ = single_run("random", 8)
    with mock.patch.object(simulation, "_begin", watched):
        for index in range(4):
            made = simulation.step(index, more=index < 3)
            # Only what is said to come is begun early; again if the outcome was not yet settled.
            assert begun == sorted(begun) and begun[-1] == min(index + 1, 3)
            assert without_times(made.record) == records[index]
        simulation.step(4, more=True)
        # Another step than was begun, as after going back to a state kept before.
        before = simulation.state
        simulation.step(5, more=True)
        simulation.state = before
        del begun[:]
        assert without_times(simulation.step(5, more=True).record) == records[5]
        assert begun[0] == 5 and set(begun[1:]) == {6}
        del begun[1:]
        # Cells that have been given to others meanwhile.
        simulation.partition = simulation.partition.with_owner(simulation.partition.owner.flip(0))
        assert without_times(simulation.step(6).record) == records[6]
        assert begun == [5, 6]
        assert without_times(simulation.step(7).record) == records[7]


def test_a_step_begun_before_it_is_asked_for(world: World) -> None:
    world(begin_early)


def lose_one(comm: Comm) -> None:
    simulation = make_simulation(comm, "random", "none", True)
    simulation.step(0)
    if comm.rank == comm.size - 1:
        kept = torch.arange(len(simulation.state) - 1)
        simulation.state = sim.RobotState(**{name: column[kept] for name, column in simulation.state.columns.items()})
    with pytest.raises(RuntimeError, match="migration: expected 240 bodies .* there are 239"):
        simulation.verify()
    with pytest.raises(RuntimeError, match="migration: expected 240 bodies"):
        simulation.step(1)


def test_a_lost_robot_is_noticed_in_the_next_step(world: World) -> None:
    world(lose_one)


def crowd_together(comm: Comm) -> list[float]:
    """Imbalance of the potentially colliding pairs, step by step, from an assignment that gives rank 0 all."""
    simulation = make_simulation(comm, "random", "cost", True)
    simulation.partition = simulation.partition.with_owner(torch.zeros_like(simulation.partition.owner))
    return [simulation.step(index).record["ranks"]["imbalance"] for index in range(12)]


def test_balance_spreads_what_one_rank_had(ranks: World) -> None:
    imbalances = ranks.run(4, crowd_together)[0]
    assert imbalances[0] == 4.0
    assert imbalances[-1] < 1.6  # 64 cells for 240 robots: no better can be expected of so few
