"""Rounds of settling made several at a time: the same bits as when each is waited for."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode

import pgccd
from pgccd.capacity import Capacity
from pgccd.sim import World, WorldConfig, make_step, robot_mesh
from pgccd.sim import step as step_module
from pgccd.sim.response import OneRank, settle
from pgccd.sim.rounds import Pace, settle_ahead
from pgccd.sim.step import Partners, settle_step, toi_of

FAST: dict[str, Any] = {"robots": 150, "speed": 0.3, "spin": 0.5}


def follow(config: WorldConfig, steps: int, ahead: bool, meshes: list[pgccd.Mesh] | None = None) -> list[Any]:
    """Every step's line of the log without its times, and the columns at the end."""
    world = World(config, meshes)
    state = world.start()
    scene, records = world.scene(state.id), []
    for index in range(steps):
        step = make_step(world, scene, state, index, ahead=ahead)
        state = step.after
        records.append({name: value for name, value in step.record.items() if "seconds" not in name})
    return [*records, {name: column.tolist() for name, column in state.columns.items()}]


@settings(max_examples=6)
@given(st.integers(0, 999), st.sampled_from(["random", "skewed"]), st.integers(1, 2))
def test_same_bits(seed: int, pattern: str, kinds: int) -> None:
    big = robot_mesh()
    meshes = [big, pgccd.Mesh(0.7 * big.vertices, big.faces)][:kinds]
    config = WorldConfig(pattern=pattern, seed=seed, **FAST)
    assert follow(config, 12, True, meshes) == follow(config, 12, False, meshes)


def a_step(seed: int, speed: float = 0.3, robots: int = 150) -> tuple[pgccd.Contacts, int, Any]:
    """Contacts of a step, number of robots, and how to make the partners anew."""
    world = World(WorldConfig(robots=robots, speed=speed, seed=seed))
    state, scene = world.start(), world.scene(world.start().id)
    for index in range(8):  # until they have left the lattice
        state = make_step(world, scene, state, index).after
    state = world.plan(state, 8)
    pairs = pgccd.broad.find_pairs(pgccd.MovingBodies(scene, world.motion(state)))
    contacts = pgccd.detect(scene, world.motion(state), nonzero_toi=True, pairs=pairs)
    return contacts, len(state), lambda: Partners(world, state.moving_columns, None, pairs)


def many_rounds() -> tuple[pgccd.Contacts, int, Any]:
    """A step that takes several."""
    for seed in range(40):
        made = a_step(seed)
        if settle(made[0].pairs, toi_of(made[0]), made[1], made[2]()).rounds >= 3:
            return made
    raise AssertionError("no step takes three rounds")


class Gathers(OneRank):
    """Counts what the host waits for."""

    def __init__(self, contacts: pgccd.Contacts) -> None:
        super().__init__(contacts.pairs.reshape(-1))
        self.count = 0

    def gather(self, values: Tensor) -> Tensor:
        self.count += 1
        return super().gather(values)


def test_wherever_a_batch_ends() -> None:
    contacts, count, partners = many_rounds()
    expected = settle(contacts.pairs, toi_of(contacts), count, partners())
    for rounds in range(expected.rounds + 3):
        pace, exchange = Pace(), Gathers(contacts)
        pace.learn([Capacity.guess(400, 200)] * rounds)
        found = settle_ahead(contacts.pairs, toi_of(contacts), count, partners().start_round, exchange, pace)
        assert found is not None and torch.equal(found.fraction, expected.fraction)
        assert (found.rounds, found.secondary_contacts) == (expected.rounds, expected.secondary_contacts)
        assert pace.rounds == expected.rounds
        assert exchange.count == 1 + max(0, -(-(expected.rounds - rounds) // 2))


@pytest.mark.parametrize("room", [Capacity(0, 0), Capacity(1000, 0)], ids=["pairs", "contacts"])
def test_too_little_room_in_a_round(room: Capacity) -> None:
    contacts, count, partners = many_rounds()
    expected = settle(contacts.pairs, toi_of(contacts), count, partners())
    short = []
    for lacking in range(expected.rounds):

        class Tight(Pace):
            def room(self, round: int, lacking: int = lacking) -> Capacity:
                return room if round == lacking else super().room(round)

        pace, given_contacts = Tight(), (contacts.pairs, toi_of(contacts), count)
        pace.learn([Capacity(0, 0)] * expected.rounds)
        asked = partners()
        short.append(settle_ahead(*given_contacts, asked.start_round, OneRank(contacts.pairs), pace) is None)
        found = settle_step(contacts, count, asked, pace)
        assert torch.equal(found.fraction, expected.fraction)
        assert (found.rounds, found.secondary_contacts) == (expected.rounds, expected.secondary_contacts)
        # What each round needed has been learnt.
        assert pace.rounds == expected.rounds and len(asked.needed) == (expected.rounds if short[-1] else 0)
    # A round may find no contact, and the last one does not.
    assert any(short) and (room.pairs > 0 or all(short))


def test_more_memory_than_there_is(monkeypatch: pytest.MonkeyPatch) -> None:
    contacts, count, partners = many_rounds()
    monkeypatch.setattr(step_module, "memory_limit", lambda *_: 1000)
    pace = Pace()
    pace.learn([Capacity(0, 0)])
    arguments = contacts.pairs, toi_of(contacts), count, partners().start_round, OneRank(contacts.pairs), pace
    assert settle_ahead(*arguments) is None


def test_nobody_collides() -> None:
    contacts, count, partners = a_step(0, speed=0.0)
    assert len(contacts) == 0
    pace = Pace()
    for _ in range(2):  # the first step waits for each round, the second for all together
        exchange = Gathers(contacts)
        found = settle_step(contacts, count, partners(), pace, exchange)
        assert (found.rounds, found.secondary_contacts, exchange.count) == (0, 0, 1)
        assert bool((found.fraction == 1.0).all()) and pace.rounds == 0


def test_everybody_collides() -> None:
    """All fly through the middle in one step, not quite at the same time."""
    tips = torch.tensor([[1.0, 0, 0], [0, 1, 0], [-1, 0, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1]], dtype=torch.float64)
    faces = [[k, (k + 1) % 4, 4] for k in range(4)] + [[(k + 1) % 4, k, 5] for k in range(4)]
    octahedron = pgccd.Mesh(tips, torch.tensor(faces, dtype=torch.int32))
    world, random = World(WorldConfig(robots=64, speed=0.05), [octahedron]), torch.Generator().manual_seed(1)
    state = world.start()
    state.velocity = 10.0 * state.velocity - state.position * (
        1.5 + 0.5 * torch.rand(64, 1, dtype=torch.float64, generator=random)
    )
    scene, motion = world.scene(state.id), world.motion(state)
    pairs = pgccd.broad.find_pairs(pgccd.MovingBodies(scene, motion))
    contacts = pgccd.detect(scene, motion, nonzero_toi=True, pairs=pairs)
    assert len(contacts.pairs.unique()) == len(state)

    def partners() -> Partners:
        return Partners(world, state.moving_columns, None, pairs)

    pace = Pace()
    expected = settle_step(contacts, len(state), partners(), pace)
    found = settle_ahead(
        contacts.pairs, toi_of(contacts), len(state), partners().start_round, OneRank(contacts.pairs), pace
    )
    assert found is not None and torch.equal(found.fraction, expected.fraction)
    assert (found.rounds, found.secondary_contacts) == (expected.rounds, expected.secondary_contacts)
    assert expected.rounds >= 2 and expected.secondary_contacts > 0


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
    contacts, count, partners = many_rounds()
    calls = []
    for rounds in (8, 9):
        pace = Pace()
        pace.learn([Capacity(0, 0)] * rounds)
        with Calls() as watch:
            settle_ahead(contacts.pairs, toi_of(contacts), count, partners().start_round, OneRank(contacts.pairs), pace)
        calls.append(watch.calls)
        assert watch.waits == 0  # the one look is that of the numbers gathered
    assert calls[1] - calls[0] == 5
