"""The nanorobot simulation on ranks: log and state equal to one process, for any owners of robots and cells, however
often these change.
"""

from __future__ import annotations

import functools
from typing import Any, NamedTuple
from unittest import mock

import pytest
import torch
from support.graphs import graphs_on
from support.ranks import World, on_three
from support.same_bits import assert_same
from support.steps import step_of

import pgccd
from pgccd import sim
from pgccd.distributed import BalanceOptions, Bisection, Cells, Comm, RankOptions
from pgccd.distributed.partition.cut import make_partition
from pgccd.distributed.partition.decomposition import Decomposition
from pgccd.resolution.round_plan import RoundPlan
from pgccd.runtime import transaction
from pgccd.runtime.sizes import BufferSizes, Capacity
from pgccd.sim import Simulation, Step, starting_share
from pgccd.sim.gathering import gather_sample

STEPS = 16
TIMES = ("seconds", "stage_seconds", "ranks")
# Fast robots in a small world, so that few steps suffice.
WORLDS = {
    "random": {"robots": 240, "speed": 0.3, "spin": 0.5, "seed": 3},
    "skewed": {"robots": 300, "pattern": "skewed", "speed": 0.25, "seed": 5},
}


class SingleRun(NamedTuple):
    """The records of a run of one process, and of its last step what ranks compare. Tests give it to ranks, which would
    each compute it again.
    """

    records: list[dict[str, Any]]
    before: sim.RobotState
    after: sim.RobotState
    contacts: pgccd.Contacts
    fraction: torch.Tensor


@functools.cache
def single_run(name: str, steps: int) -> SingleRun:
    """Of this process."""
    model = sim.Model(sim.ModelConfig(**WORLDS[name]))
    state = model.start()
    records = []
    for index in range(steps):
        step = step_of(model, state, index)
        state = step.after
        records.append(without_times(step.record))
    return SingleRun(records, step.before, step.after, step.contacts, step.resolution.fraction)


def without_times(record: dict[str, Any]) -> dict[str, Any]:
    return {name: value for name, value in record.items() if name not in TIMES}


def make_simulation(
    comm: Comm,
    name: str,
    policy: str,
    overlap: bool,
    device: str = "cpu",
    graph: bool | None = None,
    kind: str = "cells",
    axes: int = 3,
) -> Simulation:
    model = sim.Model(sim.ModelConfig(**WORLDS[name]), device=device)
    upper = model.half_extent
    partition = make_partition(kind, tuple(-x for x in upper), upper, comm.size, axes, 4, device)
    start = starting_share(comm, model)
    options = RankOptions(balance=BalanceOptions(policy, deciding=0.0), overlap=overlap)
    return Simulation.create(comm, model, partition, start, options, graph)


class Cramped(RoundPlan):
    """A plan whose capacity is exceeded in one round of some steps."""

    def __init__(self) -> None:
        super().__init__()
        self.steps = 0

    def capacity(self, round: int) -> Capacity:
        self.steps += round == 0
        return BufferSizes(0, 0) if self.steps % 4 == 3 and round == 1 else super().capacity(round)


def follow(
    comm: Comm,
    alone: SingleRun,
    name: str,
    policy: str,
    random_owners: bool,
    overlap: bool,
    device: str = "cpu",
    graph: bool = False,
    kind: str = "cells",
    axes: int = 3,
) -> dict[str, int]:
    """Compares the log of every step and the columns of the last step with one process. With `graph`, steps are
    replayed, and some ranks overflow in some steps.
    """
    records, steps = alone.records, len(alone.records)
    simulation = make_simulation(comm, name, policy, overlap, device, graph, kind, axes)
    if graph and comm.rank == comm.size - 1:
        simulation._plan = Cramped()
    generator = torch.Generator().manual_seed(17)
    seen = dict.fromkeys(("moved cells", "arrived", "contacts", "away", "replayed"), 0)
    run = STEPS // 2 if graph else 5  # every run-th step is eager, with access to its details
    for index in range(steps):
        if random_owners and index % run == 2 and not simulation.is_ahead:
            # Assign random owners. Until the next migration, ranks hold robots they do not own.
            owner = torch.randint(comm.size, (simulation.partition.cell_count,), generator=generator)
            simulation.partition = simulation.partition.with_owner(owner)
        more = min(steps, (index // run + 1) * run) - index - 1
        made = simulation.step(index, more=more)
        found = without_times(made.record)
        if device != "cpu":  # a GPU tests other candidates on the way to the same contacts
            found["candidates"] = records[index]["candidates"]
        assert found == records[index]
        assert ("ranks" in made.record) == (comm.size > 1)
        ranks = made.record.get("ranks", {"moved_cells": 0, "arrived": []})
        for part, whole in (("bodies", "robots"), ("pcs", "pcs"), ("contacts", "contacts")) if comm.size > 1 else ():
            assert len(ranks[part]) == comm.size and sum(ranks[part]) == made.record[whole]
        if isinstance(made, Step):
            if comm.size > 1:
                assert len(made.contacts) == ranks["contacts"][comm.rank]
            assert bool((simulation.partition.owner_of(simulation.state.position) == comm.rank).all())
        else:
            assert graph and more > 0
            seen["replayed"] += 1
            seen["away"] += int(made.reports.leaving.sum())
        seen["moved cells"] += ranks["moved_cells"]
        seen["arrived"] += sum(ranks["arrived"])
        seen["contacts"] += made.record["contacts"]
    simulation.verify()
    assert isinstance(made, Step)
    _, [step] = gather_sample(comm, simulation.state, [made])
    if comm.rank == 0:
        for column, expected in alone.after.columns.items():
            assert torch.equal(step.after.columns[column].cpu(), expected), column
        for column, expected in alone.before.columns.items():
            assert torch.equal(step.before.columns[column].cpu(), expected), column
        assert_same(step.contacts, alone.contacts)
        assert torch.equal(step.resolution.fraction.cpu(), alone.fraction)
    return seen


def follow_replayed(
    comm: Comm, alone: SingleRun, name: str, policy: str, random_owners: bool, padding: str = "usual"
) -> dict[str, int]:
    """The same with replays of a graph and messages of fixed size, as on GPUs."""
    with graphs_on("cpu") as stack:
        stack.replays_with_away(0.5)
        if padding == "none":
            stack.without_room()
        seen = follow(comm, alone, name, policy, random_owners, True, graph=True)
        assert stack.rounds is not None
        return seen | {"skipped": stack.rounds.skipped}


def follow_not_captured(comm: Comm, alone: SingleRun, device: str = "cpu") -> dict[str, int]:
    """The same where the last rank cannot capture a graph: all ranks go on without."""
    with graphs_on(device) as stack:
        capture = transaction.capture

        def fail(*given: Any) -> Any:
            made = capture(*given)
            if comm.rank == comm.size - 1:
                raise RuntimeError("no memory")
            return made

        stack.enter_context(mock.patch.object(transaction, "capture", fail))
        why = "no memory" if comm.rank == comm.size - 1 else "another rank"
        with pytest.warns(UserWarning, match=f"without a CUDA graph: {why}"):
            return follow(comm, alone, "random", "none", False, True, device, graph=True)


def fail_before_messages(comm: Comm) -> str:
    """The last rank fails to capture a graph before it has sent the step's messages. Returns the error of this rank."""
    with graphs_on("cpu") as stack:
        capture = transaction.capture

        def fail(*given: Any) -> Any:
            if comm.rank == comm.size - 1:
                raise RuntimeError("no memory")
            return capture(*given)

        stack.enter_context(mock.patch.object(transaction, "capture", fail))
        simulation = make_simulation(comm, "random", "none", True, graph=True)
        try:
            for index in range(8):
                simulation.step(index, more=7 - index)
        except Exception as error:
            return str(error)
    return ""


def follow_neighbours(comm: Comm, alone: SingleRun, name: str, policy: str, graph: bool, kind: str) -> int:
    """With messages between neighbours only, as for many ranks. If no policy assigns the cells, no ranks are neighbours
    at first. Returns the number of times that the neighbours of ranks were extended.
    """
    comm.neighbours_above = 0
    extended = 0
    extend = Decomposition.extend

    def noted(self: Decomposition, ranks: torch.Tensor) -> None:
        nonlocal extended
        extend(self, ranks)
        extended += 1
        assert self.neighbours.size == len(self.neighbours.ranks) + 1

    with graphs_on("cpu" if graph else "none") as stack:
        stack.replays_with_away(0.5)
        stack.enter_context(mock.patch.object(Decomposition, "extend", noted))
        if policy == "none":
            for partition in (Cells, Bisection):
                stack.enter_context(mock.patch.object(partition, "neighbours", lambda _, rank: [rank]))
        axes, random_owners = 1 if kind == "cells" else 3, kind == "cells" and policy == "none"
        seen = follow(comm, alone, name, policy, random_owners, True, "cpu", graph, kind, axes)
        assert seen["contacts"] > 100 and (seen["replayed"] > 3) == graph
    return extended


def follow_bisected(
    comm: Comm, alone: SingleRun, name: str, policy: str, replayed: bool = False, device: str = "cpu"
) -> dict[str, int]:
    """The same with bisection, as replays or not."""
    with graphs_on(device if replayed else "none") as stack:
        stack.replays_with_away(0.5)
        return follow(comm, alone, name, policy, False, True, device, replayed, "bisection")


@on_three
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
    seen = world(follow, single_run(name, STEPS), name, policy, random_owners, overlap)
    assert seen[0]["contacts"] > 100
    if len(seen) > 1:
        assert seen[0]["arrived"] > 20
        if policy != "none":
            assert seen[0]["moved cells"] > 0


@on_three
@pytest.mark.parametrize("padding", ["usual", "none"])
@pytest.mark.parametrize(("name", "policy"), [("random", "none"), ("random", "cost"), ("skewed", "one-cell")])
def test_same_bits_as_replays(world: World, name: str, policy: str, padding: str) -> None:
    """Steps in which one rank needs more rounds or capacity are repeated by all ranks."""
    alone = single_run(name, STEPS)
    seen = world(follow_replayed, alone, name, policy, policy == "none", padding)
    assert seen[0]["replayed"] > 2 or (padding == "none" and len(seen) > 1)
    # Without messages of peers a rank does not know whether others need a round.
    assert all((rank["skipped"] > 0) == (len(seen) == 1) for rank in seen)
    if len(seen) > 1 and padding == "usual":
        assert seen[0]["arrived"] > 20
        assert sum(rank["away"] for rank in seen) > 0


def test_a_rank_that_cannot_capture_a_graph(ranks: World) -> None:
    seen = ranks.run(3, follow_not_captured, single_run("random", 12))
    assert seen[0]["replayed"] == 0 and seen[0]["contacts"] > 20


def test_a_rank_that_fails_before_its_messages_ends_the_step(ranks: World) -> None:
    """The others wait for them; nothing else could tell these why."""
    errors = ranks.run(3, fail_before_messages)
    assert errors[-1] == "no memory" and all(errors)


@pytest.mark.cuda
@pytest.mark.parametrize(("name", "policy"), [("random", "none"), ("random", "cost"), ("skewed", "one-cell")])
def test_same_bits_on_a_gpu_that_ranks_share(world: World, name: str, policy: str) -> None:
    world(follow, single_run(name, STEPS), name, policy, policy == "none", True, "cuda")


@pytest.mark.slow
@pytest.mark.parametrize("name", list(WORLDS))
@pytest.mark.parametrize("policy", ["cost", "measured", "one-cell", "none"])
def test_same_bits_for_two_hundred_steps(world: World, name: str, policy: str) -> None:
    """If no policy assigns the cells, they are assigned at random; and graphs are used as on GPUs."""
    if policy == "none":
        world(follow_replayed, single_run(name, 200), name, policy, True)
    else:
        world(follow, single_run(name, 200), name, policy, False, True)


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
    """Imbalance of the potentially colliding pairs per step, starting with all cells on rank 0."""
    simulation = make_simulation(comm, "random", "cost", True)
    simulation.partition = simulation.partition.with_owner(torch.zeros_like(simulation.partition.owner))
    return [simulation.step(index).record["ranks"]["imbalance"] for index in range(12)]


def test_balance_spreads_what_one_rank_had(ranks: World) -> None:
    imbalances = ranks.run(4, crowd_together)[0]
    assert imbalances[0] == 4.0
    assert imbalances[-1] < 1.6  # 64 cells for 240 robots allow no better balance


@pytest.mark.parametrize("size", [pytest.param(2, marks=pytest.mark.slow), 4])
@pytest.mark.parametrize(
    ("kind", "graph"),
    [
        ("cells", False),
        pytest.param("cells", True, marks=pytest.mark.slow),
        pytest.param("bisection", False, marks=pytest.mark.slow),
        ("bisection", True),
    ],
)
@pytest.mark.parametrize(
    ("name", "policy"), [pytest.param("random", "none", marks=pytest.mark.slow), ("skewed", "cost")]
)
def test_same_bits_with_neighbours_only(
    ranks: World, name: str, policy: str, kind: str, graph: bool, size: int
) -> None:
    extended = ranks.run(size, follow_neighbours, single_run(name, STEPS), name, policy, graph, kind)
    assert extended[0] > 0 or policy != "none"
