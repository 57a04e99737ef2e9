"""Bodies lost, duplicated or exchanged between ranks are detected."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import pytest
import torch
from support.shapes import tetrahedron
from torch import Tensor

import pgccd
from pgccd import sim
from pgccd.distributed import Alone, Cells, World
from pgccd.distributed.comm.exchange import Columns, take_rows
from pgccd.distributed.halo import migrate
from pgccd.distributed.halo.migrate import IdChecksum
from pgccd.distributed.world import world as world_module
from pgccd.sim import Simulation, starting_share

COUNT = 12


def small_world() -> World:
    """A world on one rank."""
    position = torch.rand((COUNT, 3), dtype=torch.float64, generator=torch.Generator().manual_seed(1))
    return World.create(pgccd.Scene([tetrahedron(0.1)], [0] * COUNT), position, (0.0, 0.0, 0.0), (1.0, 1.0, 1.0))


def losing(rows: Tensor) -> Callable[..., migrate.Moved]:
    """A migration that keeps only these rows."""

    def lossy(decomposition: Any, columns: Columns, *rest: Any, **more: Any) -> migrate.Moved:
        moved = migrate.migrate(decomposition, columns, *rest, **more)
        return replace(moved, columns={name: column[rows] for name, column in moved.columns.items()})

    return lossy


EVERY = torch.arange(COUNT)
FAULTS = {
    "lost": EVERY[:-1],
    "all lost": EVERY[:0],
    "doubled": torch.cat([EVERY, EVERY[-1:]]),
    "one lost, another doubled": torch.cat([EVERY[1:], EVERY[-1:]]).sort().values,
}


@pytest.mark.parametrize("fault", FAULTS)
def test_a_world_notices(monkeypatch: pytest.MonkeyPatch, fault: str) -> None:
    world = small_world()
    world.move(world.position)
    monkeypatch.setattr(world_module, "migrate", losing(FAULTS[fault]))
    with pytest.raises(RuntimeError, match="bodies with id hash"):
        world.move(world.position)


def test_a_count_is_not_enough_and_neither_is_a_hash() -> None:
    expected = IdChecksum.of(EVERY)
    for wrong in (IdChecksum(expected.count, expected.ids + 1), IdChecksum(expected.count + 1, expected.ids)):
        with pytest.raises(RuntimeError, match=f"expected {COUNT} bodies"):
            wrong.require(expected)


def test_a_body_with_another_id(monkeypatch: pytest.MonkeyPatch) -> None:
    world = small_world()

    def renaming(decomposition: Any, columns: Columns, *rest: Any, **more: Any) -> migrate.Moved:
        changed = {**columns, "id": torch.cat([columns["id"][:-1], columns["id"][-1:] + 1])}
        return migrate.Moved(changed, 0, None)

    monkeypatch.setattr(world_module, "migrate", renaming)
    with pytest.raises(RuntimeError, match="bodies with id hash"):
        world.move(world.position)


def test_a_simulation_notices() -> None:
    """Robots missing or duplicated at the start of a step."""
    world = sim.Model(sim.ModelConfig(robots=40, seed=1))
    upper = world.half_extent
    for rows in (torch.arange(39), torch.cat([torch.arange(40), torch.tensor([39])])):
        comm = Alone()
        partition = Cells.uniform(tuple(-x for x in upper), upper, 1, cells=2)
        simulation = Simulation.create(comm, world, partition, starting_share(comm, world))
        simulation.step(0)
        simulation.state = sim.RobotState(**take_rows(simulation.state.columns, rows))
        with pytest.raises(RuntimeError, match="expected 40 bodies"):
            simulation.step(1)
