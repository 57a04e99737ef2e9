"""Rounds of collision resolution enqueued several at a time: the same bits as when each is waited for."""

from __future__ import annotations

import sys
from typing import Any

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode

import pgccd
from pgccd.detection.capacity import COUNT_ROWS, Capacity
from pgccd.detection.parts import Part
from pgccd.detection.pipeline import find_contacts
from pgccd.runtime.stages import StageClock
from pgccd.sim import Model, ModelConfig, RobotState, make_step, robot_mesh
from pgccd.sim import partners as partners_module
from pgccd.sim.partners import FIRST_CONTACTS, Partners, toi_of
from pgccd.sim.response import OneRank, Resolution, resolve_collisions
from pgccd.sim.rounds import Ahead, Pace, resolve_ahead
from pgccd.sim.step import ResolvedStep, resolve_step
from pgccd.sim.tally import WORK

detect_module = sys.modules["pgccd.detection.pipeline"]
step_module = sys.modules["pgccd.sim.step"]
FAST: dict[str, Any] = {"robots": 150, "speed": 0.3, "spin": 0.5}


def follow(config: ModelConfig, steps: int, ahead: bool, meshes: list[pgccd.Mesh] | None = None) -> list[Any]:
    """Every step's line of the log without its times, and the columns at the end."""
    model = Model(config, meshes)
    state = model.start()
    scene, records = model.scene(state.id), []
    for index in range(steps):
        step = make_step(model, scene, state, index, ahead=ahead)
        state = step.after
        records.append({name: value for name, value in step.record.items() if "seconds" not in name})
    return [*records, {name: column.tolist() for name, column in state.columns.items()}]


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


def same_bits(seed: int, pattern: str, kinds: int) -> None:
    big = robot_mesh()
    meshes = [big, pgccd.Mesh(0.7 * big.vertices, big.faces, "centroid")][:kinds]
    config = ModelConfig(pattern=pattern, seed=seed, **FAST)
    assert follow(config, 12, True, meshes) == follow(config, 12, False, meshes)


@pytest.mark.parametrize("pattern", ["random", "skewed"])
def test_steps_begun_before_the_outcome_of_the_last_is_known(
    device: torch.device, pattern: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    steps, discard, config = 40, 0, ModelConfig(pattern=pattern, seed=3, **FAST)
    expected = follow(config, steps, True)
    monkeypatch.setattr(step_module, "_begins_early", lambda _: True)
    begin_step, begun = step_module.begin_step, []

    def watched(*arguments: Any) -> Any:
        begun.append(arguments[3])
        return begin_step(*arguments)

    monkeypatch.setattr(step_module, "begin_step", watched)
    model = Model(config, device=device)
    state, following = model.start(), None
    scene = model.scene(state.id)
    for index in range(steps):
        more = index % 5 != 4
        step = make_step(model, scene, state, index, ahead=True, begun=following, more=more)
        assert more or step.next is None
        for name, value in step.record.items():
            # A GPU looks at other feature pairs on the way to the same contacts.
            if "seconds" not in name and (name != "candidates" or device.type == "cpu"):
                assert value == expected[index][name]
        discard += begun.count(index + 1) - (step.next is not None)
        state, following = step.after, step.next
        if index == 21:  # another state, though the same to the bit
            state = RobotState(**state.columns)
    assert {name: column.tolist() for name, column in state.columns.items()} == expected[-1]
    # Steps 0, 22 and those after every fifth were begun when they were made; others before; some were discarded.
    assert discard > 0 and begun.count(0) == begun.count(25) == 1 and begun.count(22) >= 2


def test_an_invalid_state(device: torch.device) -> None:
    model = Model(ModelConfig(**FAST), device=device)
    state, scene = model.start(), model.scene(model.start().id)
    for index in range(3):
        state = make_step(model, scene, state, index).after
    state.position = state.position.clone()
    state.position[17, 1] = torch.nan
    with pytest.raises(ValueError, match="position(_t0)?: body 17"):
        make_step(model, scene, state, 3)


class AStep:
    """A step about to be made.

    Args:
        model, state: the world and its robots as planned.
    """

    def __init__(self, model: Model, state: RobotState) -> None:
        self.model, self.state, self.count = model, state, len(state)
        self.bodies = pgccd.MovingBodies(model.scene(state.id), model.motion(state))
        self.pairs = pgccd.broad.find_pairs(self.bodies)
        self.contacts = find_contacts(self.bodies, FIRST_CONTACTS, pairs=self.pairs)

    def parts(self) -> list[Part]:
        return [Part("all", FIRST_CONTACTS, self.bodies, self.pairs)]

    def partners(self) -> Partners:
        return Partners(self.model, self.state.moving_columns, None, self.pairs)

    def expected(self) -> Resolution:
        return resolve_collisions(self.contacts.pairs, toi_of(self.contacts), self.count, self.partners())

    def ahead(self, pace: Pace, exchange: OneRank | None = None, partners: Partners | None = None) -> Ahead | None:
        start_round, exchange = (partners or self.partners()).start_round, exchange or OneRank(self.pairs[:, 0])
        return resolve_ahead(self.parts(), self.count, start_round, exchange, pace, self.conclude, StageClock())

    def resolved(self, pace: Pace, partners: Partners | None = None, exchange: OneRank | None = None) -> ResolvedStep:
        partners = partners or self.partners()

        def conclude(pairs: Tensor, toi: Tensor, fraction: Tensor) -> Tensor:
            return self.conclude(fraction)

        return resolve_step(self.parts(), self.count, partners, pace, conclude, StageClock(), exchange)

    @staticmethod
    def conclude(fraction: Tensor) -> Tensor:
        return (fraction < 1.0).sum().reshape(1)


def same(found: Resolution, expected: Resolution) -> bool:
    assert (found.rounds, found.secondary_contacts) == (expected.rounds, expected.secondary_contacts)
    return torch.equal(found.fraction, expected.fraction)


def a_step(seed: int, speed: float = 0.3, robots: int = 150) -> AStep:
    model = Model(ModelConfig(robots=robots, speed=speed, seed=seed))
    state, scene = model.start(), model.scene(model.start().id)
    for index in range(8):  # until they have left the lattice
        state = make_step(model, scene, state, index).after
    return AStep(model, model.plan(state, 8))


def many_rounds() -> AStep:
    """A step that takes several."""
    for seed in range(40):
        made = a_step(seed)
        if made.expected().rounds >= 3:
            return made
    raise AssertionError("no step takes three rounds")


def paced(rounds: int, needed: Capacity = Capacity(0, 0), pace: Pace | None = None) -> Pace:  # noqa: B008
    """After a step of so many rounds."""
    pace = pace or Pace()
    pace.learn(rounds, lambda: [needed] * rounds)
    return pace


class Gathers(OneRank):
    """Counts what the host waits for."""

    def __init__(self, pairs: Tensor) -> None:
        super().__init__(pairs.reshape(-1))
        self.count = 0

    def gather(self, values: Tensor) -> Tensor:
        self.count += 1
        return super().gather(values)


def test_wherever_a_batch_ends() -> None:
    step = many_rounds()
    expected = step.expected()
    for rounds in range(expected.rounds + 3):
        pace, exchange = paced(rounds, Capacity.guess(400, 200)), Gathers(step.pairs)
        found = step.ahead(pace, exchange)
        assert found is not None and same(found.resolution, expected)
        assert found.conclusions.tolist() == [step.conclude(expected.fraction).tolist()]
        assert found.counts[:, :, COUNT_ROWS["contacts"]].tolist() == [[len(step.contacts)]]
        assert pace.rounds == max(rounds, expected.rounds)
        assert exchange.count == 1 + max(0, -(-(expected.rounds - rounds) // 2))


def test_too_little_room_in_a_round() -> None:
    step = many_rounds()
    expected = step.expected()
    short = []
    for lacking in range(expected.rounds):

        class Tight(Pace):
            def capacity(self, round: int, lacking: int = lacking) -> Capacity:
                return Capacity(0, 0) if round == lacking else super().capacity(round)

        pace = paced(expected.rounds, pace=Tight())
        asked = step.partners()
        short.append(step.ahead(pace, partners=asked) is None)
        found = step.resolved(pace, asked)
        assert same(found.resolution, expected)
        # What each round needed has been learnt.
        assert pace.rounds == expected.rounds and len(asked.needed) == (expected.rounds if short[-1] else 0)
    assert all(short)


def test_too_little_room_for_the_whole_step(monkeypatch: pytest.MonkeyPatch) -> None:
    step = many_rounds()
    expected = step.expected()
    monkeypatch.setattr(detect_module, "EXACTLY", Capacity(0, len(step.contacts) - 1))
    pace = paced(expected.rounds)
    assert step.ahead(pace) is None
    monkeypatch.setattr(detect_module, "EXACTLY", Capacity(0, len(step.contacts)))
    found = step.ahead(pace)
    assert found is not None and same(found.resolution, expected)


def test_more_memory_than_there_is(monkeypatch: pytest.MonkeyPatch) -> None:
    step = many_rounds()
    monkeypatch.setattr(partners_module, "memory_limit", lambda *_: 1000)
    pace = paced(1)
    assert step.ahead(pace) is None


def test_nobody_collides() -> None:
    step = a_step(0, speed=0.0)
    assert len(step.contacts) == 0
    pace = Pace()
    for waits in (2, 1):  # the first step waits for each round and at its end, the second for all together
        exchange = Gathers(step.pairs)
        found = step.resolved(pace, exchange=exchange).resolution
        assert (found.rounds, found.secondary_contacts, exchange.count) == (0, 0, waits)
        assert bool((found.fraction == 1.0).all()) and pace.rounds == 0


def test_everybody_collides() -> None:
    """All fly through the middle in one step, not quite at the same time."""
    tips = torch.tensor([[1.0, 0, 0], [0, 1, 0], [-1, 0, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1]], dtype=torch.float64)
    faces = [[k, (k + 1) % 4, 4] for k in range(4)] + [[(k + 1) % 4, k, 5] for k in range(4)]
    octahedron = pgccd.Mesh(tips, torch.tensor(faces, dtype=torch.int32), "centroid")
    model, random = Model(ModelConfig(robots=64, speed=0.05), [octahedron]), torch.Generator().manual_seed(1)
    state = model.start()
    state.velocity = 10.0 * state.velocity - state.position * (
        1.5 + 0.5 * torch.rand(64, 1, dtype=torch.float64, generator=random)
    )
    step = AStep(model, state)
    assert len(step.contacts.pairs.unique()) == len(state)
    pace = Pace()
    first, second = (step.resolved(pace) for _ in range(2))
    assert same(second.resolution, first.resolution) and second.conclusions.tolist() == first.conclusions.tolist()
    contacts = WORK.index("contacts")
    assert second.work[0, contacts] == first.work[0, contacts] == len(step.contacts)
    assert first.resolution.rounds >= 2 and first.resolution.secondary_contacts > 0


class Calls(TorchDispatchMode):
    """Operators that take a GPU's time, and looks at what it has computed."""

    def __init__(self) -> None:
        super().__init__()
        self.calls = self.waits = 0

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        name = func.name()
        self.calls += not name.startswith(("aten::view", "aten::slice", "aten::detach"))
        self.waits += name in ("aten::_local_scalar_dense", "aten::nonzero", "aten::_to_copy", "aten::masked_select")
        return func(*args, **(kwargs or {}))


def test_a_round_is_few_operators_and_no_wait() -> None:
    step = many_rounds()
    calls = []
    for rounds in (8, 9):
        pace = paced(rounds)
        with Calls() as watch:
            step.ahead(pace)
        calls.append(watch.calls)
        assert watch.waits == 0  # the one look is that of the numbers gathered
    assert calls[1] - calls[0] == 3
