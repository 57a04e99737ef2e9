"""Rounds of collision resolution: equal to the plain rule, for any number of rounds per enqueue and any capacity."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any
from unittest import mock

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from support.resolution import PlainStep, plain_run, plain_step, robot_rounds
from support.steps import step_of
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode

import pgccd
from pgccd.resolution import listed
from pgccd.resolution.listed import ListedSearch
from pgccd.resolution.round_plan import RoundPlan
from pgccd.resolution.rounds import Found, OneRank, ResolvedStep, resolve_collisions
from pgccd.runtime.sizes import COUNT_ROWS, BufferSizes, Capacity
from pgccd.runtime.stages import StageClock
from pgccd.search.passes import SearchPass
from pgccd.sim import Fractions, Model, ModelConfig, RobotState, robot_mesh
from pgccd.sim.simulation import FIRST_CONTACTS
from pgccd.sim.tally import WORK

pipeline_module = sys.modules["pgccd.search.detect"]
FAST: dict[str, Any] = {"robots": 150, "speed": 0.3, "spin": 0.5}
WORLDS = st.integers(0, 999), st.sampled_from(["random", "skewed"]), st.integers(1, 2)


@settings(max_examples=2)
@given(*WORLDS)
def test_same_bits(seed: int, pattern: str, kinds: int) -> None:
    same_bits(seed, pattern, kinds)


@pytest.mark.slow
@settings(max_examples=20)
@given(*WORLDS)
def test_same_bits_of_many_worlds(seed: int, pattern: str, kinds: int) -> None:
    same_bits(seed, pattern, kinds)


@pytest.mark.parametrize("stopping_round", [1, 2])
def test_same_bits_where_robots_stop_earlier(stopping_round: int) -> None:
    rounds = same_bits(3, "random", 1, stopping_round)
    assert max(rounds) > stopping_round  # those that collide with robots that stopped


def same_bits(seed: int, pattern: str, kinds: int, stopping_round: int = 4) -> list[int]:
    big = robot_mesh()
    meshes = [big, pgccd.Mesh(0.7 * big.vertices, big.faces, "centroid")][:kinds]
    model = Model(ModelConfig(pattern=pattern, seed=seed, stopping_round=stopping_round, **FAST), meshes)
    state = model.start()
    lines = plain_run(model, 12)
    for index, expected in enumerate(lines):
        step = step_of(model, state, index)
        state = step.after
        assert {name: step.record[name] for name in expected} == expected
    return [line["resolution_rounds"] for line in lines]


def test_an_invalid_state(device: torch.device) -> None:
    model = Model(ModelConfig(**FAST), device=device)
    state = model.start()
    for index in range(3):
        state = step_of(model, state, index).after
    state.position = state.position.clone()
    state.position[17, 1] = torch.nan
    with pytest.raises(ValueError, match="position(_t0)?: body 17"):
        step_of(model, state, 3)


class TwoAlike(OneRank):
    """An exchange between two ranks where the other rank does the same as this one. Counts host waits."""

    ranks = 2

    def __init__(self) -> None:
        self.waits = 0

    def gather(self, values: Tensor) -> Tensor:
        self.waits += 1
        return values.expand(2, -1)


class PlannedStep:
    """A planned step, not yet resolved.

    Args:
        model, state: the world and its robots as planned.
    """

    def __init__(self, model: Model, state: RobotState) -> None:
        self.model, self.state = model, state
        self.bodies = pgccd.MovingBodies.of(model.scene(state.id), model.motion(state))
        self.pairs = pgccd.broad.find_pairs(self.bodies)
        self.expected: PlainStep = plain_step(model, state)

    @property
    def rounds(self) -> int:
        """Number of rounds the step takes."""
        return self.expected.resolution.rounds

    def search_pass(self) -> SearchPass:
        return SearchPass(FIRST_CONTACTS, self.bodies, self.pairs)

    def resolve(
        self,
        plan: RoundPlan | None = None,
        exchange: OneRank | None = None,
        kind: type[ListedSearch] = ListedSearch,
        search_pass: SearchPass | None = None,
    ) -> ResolvedStep:
        rounds = robot_rounds(self.model, self.state, search_pass or self.search_pass(), self.pairs, kind)
        given = rounds, len(self.state), plan or RoundPlan(), self.summarise, StageClock()
        resolved = resolve_collisions(*given, exchange)
        found, expected = resolved.resolution, self.expected.resolution
        assert (found.rounds, found.secondary_contacts) == (expected.rounds, expected.secondary_contacts)
        assert torch.equal(found.fraction, expected.fraction)
        ranks = exchange.ranks if exchange else 1
        assert resolved.summaries.tolist() == [self.summarise(expected.fraction).tolist()] * ranks
        assert resolved.counts.work[:, WORK.index("contacts")].tolist() == [len(self.expected.contacts)] * ranks
        return resolved

    @staticmethod
    def summarise(fraction: Tensor) -> Tensor:
        return (fraction < 1.0).sum().reshape(1)


def planned_step(seed: int, speed: float = 0.3, robots: int = 150) -> PlannedStep:
    model = Model(ModelConfig(robots=robots, speed=speed, seed=seed))
    state = model.start()
    for index in range(8):  # until the robots have left the lattice
        state = step_of(model, state, index).after
    return PlannedStep(model, model.plan(state, 8))


def many_rounds() -> PlannedStep:
    """A step that takes at least three rounds."""
    for seed in range(40):
        made = planned_step(seed)
        if made.rounds >= 3:
            return made
    raise AssertionError("no step takes three rounds")


def plan_after(rounds: int, plan: RoundPlan | None = None) -> RoundPlan:
    """The plan of a simulation whose last step took this number of rounds."""
    plan = plan or RoundPlan()
    plan.learn(rounds, lambda: [Capacity.of(400, 200)] * rounds)
    return plan


@contextmanager
def counted_calls(method: str) -> Iterator[list[None]]:
    """A context with a list that has one entry per call of this method of `ListedSearch`."""
    calls: list[None] = []
    unchanged = getattr(ListedSearch, method)

    def counted(*given: Any) -> Any:
        calls.append(None)
        return unchanged(*given)

    with mock.patch.object(ListedSearch, method, counted):
        yield calls


def test_wherever_a_batch_ends() -> None:
    step = many_rounds()
    for rounds in range(step.rounds + 3):
        plan, exchange = plan_after(rounds), TwoAlike()
        step.resolve(plan, exchange)
        assert plan.rounds_to_enqueue == max(rounds, step.rounds)
        assert exchange.waits == 1 + max(0, -(-(step.rounds - rounds) // 2))


def test_a_step_of_which_nothing_is_known() -> None:
    step = many_rounds()
    plan = RoundPlan()
    step.resolve(plan, TwoAlike())
    assert plan.rounds_to_enqueue == step.rounds


def test_one_rank_on_the_cpu_makes_the_rounds_it_needs() -> None:
    step = many_rounds()
    with counted_calls("find_round") as calls:
        step.resolve(plan_after(9))
    assert len(calls) == step.rounds


def test_too_little_capacity_in_a_round() -> None:
    """As on a GPU: the round and those before it are repeated with a larger capacity."""
    step = many_rounds()
    for lacking in range(step.rounds):
        calls: list[Capacity] = []

        class Tight(ListedSearch):
            def find_round(
                self, changed: Tensor, fraction: Tensor, capacity: BufferSizes, first: Tensor, calls: Any = calls
            ) -> tuple[list[Found], Tensor]:
                calls.append(capacity)
                lowered = first.clone()
                found, counts = super().find_round(changed, fraction, capacity, lowered)
                if counts[COUNT_ROWS["pairs"]] > capacity.pairs:
                    counts[COUNT_ROWS["pairs_overflow"]] = 1
                else:
                    first.copy_(lowered)
                return found, counts

        plan = RoundPlan()
        plenty, none = Capacity.of(400, 200), BufferSizes(0, 0)
        capacities = [none if round == lacking else plenty for round in range(step.rounds)]
        plan._capacities, plan._recent = capacities, plan._recent.__class__([step.rounds])
        step.resolve(plan, TwoAlike(), Tight)
        assert len(calls) == 2 * step.rounds and calls[lacking].pairs == 0 < calls[step.rounds + lacking].pairs
        # The plan has recorded what each round needed.
        assert all(plan.capacity(round).pairs > 0 for round in range(step.rounds))


@pytest.mark.parametrize("exchange", [None, TwoAlike()])
def test_too_little_capacity_for_the_whole_step(exchange: OneRank | None, monkeypatch: pytest.MonkeyPatch) -> None:
    step = many_rounds()
    for lacking in (1, 0):
        search_pass = step.search_pass()
        with monkeypatch.context() as patch:
            patch.setattr(pipeline_module, "EXACTLY", BufferSizes(0, len(step.expected.contacts) - lacking))
            counts = search_pass.start().read()
        assert counts.overflow == bool(lacking)
        step.resolve(plan_after(step.rounds), exchange, search_pass=search_pass)


def test_rounds_that_do_not_fit_into_memory(monkeypatch: pytest.MonkeyPatch) -> None:
    step = many_rounds()
    for limit in (10_000, 1000, 1):
        monkeypatch.setattr(listed, "memory_limit", lambda *_, limit=limit: limit)
        with counted_calls("_search") as pieces:
            step.resolve()
        most = -(-BufferSizes(pairs=len(step.pairs), contacts=0).bytes // limit)
        assert len(pieces) == step.rounds * min(len(step.pairs), most) > step.rounds


def test_no_robot_collides() -> None:
    step = planned_step(0, speed=0.0)
    assert len(step.expected.contacts) == 0
    plan = RoundPlan()
    for _ in range(2):
        exchange = TwoAlike()
        found = step.resolve(plan, exchange).resolution
        assert (found.rounds, found.secondary_contacts, exchange.waits) == (0, 0, 1)
        assert bool((found.fraction == 1.0).all()) and plan.rounds_to_enqueue == 0


def test_every_robot_collides() -> None:
    """All fly through the middle in one step, at slightly different times."""
    tips = torch.tensor([[1.0, 0, 0], [0, 1, 0], [-1, 0, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1]], dtype=torch.float64)
    faces = [[k, (k + 1) % 4, 4] for k in range(4)] + [[(k + 1) % 4, k, 5] for k in range(4)]
    octahedron = pgccd.Mesh(tips, torch.tensor(faces, dtype=torch.int32), "centroid")
    model, random = Model(ModelConfig(robots=64, speed=0.05), [octahedron]), torch.Generator().manual_seed(1)
    state = model.start()
    state.velocity = 10.0 * state.velocity - state.position * (
        1.5 + 0.5 * torch.rand(64, 1, dtype=torch.float64, generator=random)
    )
    step = PlannedStep(model, state)
    assert len(step.expected.contacts.pairs.unique()) == len(state)
    assert step.rounds >= 2 and step.expected.resolution.secondary_contacts > 0
    plan = RoundPlan()
    for exchange in (None, TwoAlike(), TwoAlike()):
        step.resolve(plan, exchange)


class Calls(TorchDispatchMode):
    """Counts operators that launch GPU work, and reads of their results."""

    def __init__(self) -> None:
        super().__init__()
        self.calls = self.waits = 0

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        name = func.name()
        self.calls += not name.startswith(("aten::view", "aten::slice", "aten::detach"))
        self.waits += name in ("aten::_local_scalar_dense", "aten::nonzero", "aten::_to_copy", "aten::masked_select")
        return func(*args, **(kwargs or {}))


class Unread(ListedSearch):
    """Does not read the number of pairs, as on a GPU."""

    def _count(self, look: Any, capacity: BufferSizes, pairs: Tensor) -> int:
        return len(pairs)


def test_a_round_is_few_operators_and_no_wait() -> None:
    step = many_rounds()
    calls = []
    for rounds in (8, 9):
        search_pass, plan, exchange = step.search_pass(), plan_after(rounds), TwoAlike()
        search_pass.start()
        listed_search = robot_rounds(step.model, step.state, search_pass, step.pairs, Unread)
        listed_search._copies_of(len(step.pairs))
        given = listed_search, len(step.state), plan, step.summarise, StageClock()
        with Calls() as watch:
            found = resolve_collisions(*given, exchange).resolution
        assert same(found, step.expected.resolution)
        calls.append(watch.calls)
        assert watch.waits == 0  # the only read is that of the gathered counts
    assert calls[1] - calls[0] == 3


def same(found: Fractions, expected: Fractions) -> bool:
    return found.rounds == expected.rounds and torch.equal(found.fraction, expected.fraction)
