"""Loops of a `World` as replays of a graph: bitwise equal to a plain loop in one process, on any number of ranks."""

from __future__ import annotations

import functools
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np
import pytest
import torch
from support.graphs import graphs_on
from support.ranks import RankPool, on_several
from support.ranks import World as Ranks
from support.shapes import bumpy
from torch import Tensor

import pgccd
from pgccd.distributed import (
    BalanceOptions,
    Bodies,
    CapturedWorld,
    Comm,
    World,
    WorldOptions,
    WorldStep,
)
from pgccd.distributed.comm.interface import Alone
from pgccd.distributed.detection import share
from pgccd.distributed.partition import rebalancing
from pgccd.distributed.partition.balance import BackOff, RankLoads
from pgccd.search.passes import find_pass

COUNT, STEPS, BOX = 120, 16, 5.5


@functools.cache
def meshes() -> pgccd.MeshSet:
    rng = np.random.default_rng(5)
    # One rotates about a point outside of it.
    beside = bumpy(rng, 1, size=0.5)
    return pgccd.MeshSet([bumpy(rng, 1, size=0.6), pgccd.Mesh(beside.vertices, beside.faces, origin=(0.4, 0.0, 0.1))])


@functools.cache
def start() -> dict[str, Tensor]:
    generator = torch.Generator().manual_seed(2)
    orientation = torch.randn((COUNT, 4), generator=generator, dtype=torch.float64)
    return {
        "position": BOX * torch.rand((COUNT, 3), generator=generator, dtype=torch.float64),
        "mesh_index": torch.randint(2, (COUNT,), generator=generator, dtype=torch.int32),
        "margin": 0.02 * torch.rand(COUNT, generator=generator, dtype=torch.float64),
        "static": torch.arange(COUNT) % 13 == 0,
        "q": torch.nn.functional.normalize(orientation),
        "v": torch.randn((COUNT, 3), generator=generator, dtype=torch.float64),
        "w": torch.randn((COUNT, 3), generator=generator, dtype=torch.float64),
        "free": torch.zeros(COUNT, dtype=torch.float64),
    }


def motion(bodies: Bodies) -> pgccd.RigidMotion:
    at = bodies.payload
    # The speed of each body changes from step to step, by arithmetic that is equal on all devices.
    speed = 0.1 * ((bodies.id + bodies.step) % 3).double()[:, None]
    return pgccd.RigidMotion.from_velocity(bodies.position, at["q"], speed * at["v"], at["w"], dt=0.2)


def response(bodies: Bodies, motion: pgccd.RigidMotion, first_toi: Tensor) -> dict[str, Tensor]:
    """Bodies pass through each other, since they overlap at the start; "free" depends on every bit of `first_toi`."""
    position, orientation = motion.at(1.0)
    outside = (position < 0.0) | (position > BOX)
    turns = (first_toi <= 1.0)[:, None] | outside
    velocity = torch.where(turns, -bodies.payload["v"], bodies.payload["v"])
    free = bodies.payload["free"] + first_toi.clamp(max=1.0)
    return {"position": position, "q": orientation, "v": velocity, "free": free}


def scene_alone() -> pgccd.Scene:
    at = start()
    return pgccd.Scene(meshes(), at["mesh_index"], margin=at["margin"], static=at["static"])


def spread(comm: Comm, device: torch.device, policy: str, partition: str) -> World:
    mine = torch.arange(comm.rank, COUNT, comm.size)
    columns = {name: column[mine].to(device) for name, column in start().items()}
    balance = BalanceOptions(policy, start=0.0, goal=0.0, moving=0.0, deciding=0.0, every=3)
    return World.create(
        scene_alone()[mine].to(device),
        columns["position"],
        (0.0,) * 3,
        (BOX,) * 3,
        id=3 * mine.to(device) + 1,
        payload={name: columns[name] for name in ("q", "v", "w", "free")},
        comm=comm,
        options=WorldOptions(partition=partition, cells=4, balance=balance, nonzero_toi=True, min_separation=1e-3),
    )


#: The final columns, and of each step two numbers. Tests give it to ranks, which would each compute it again.
PlainLoop = tuple[dict[str, Tensor], list[tuple[int, int]]]


@functools.cache
def plain_loop(steps: int) -> PlainLoop:
    """In one process, by `detect` alone: the final columns, and PCS and contacts of each step."""
    now, scene, counts = dict(start()), scene_alone(), []
    for step in range(steps):
        payload = {name: now[name] for name in ("q", "v", "w", "free")}
        ids = 3 * torch.arange(COUNT) + 1
        bodies = Bodies(ids, now["position"], now["mesh_index"], payload, torch.tensor([step]))
        moving = motion(bodies)
        hits = pgccd.detect(scene, moving, min_separation=1e-3, nonzero_toi=True)
        counts.append((hits.stats.pcs, len(hits)))
        now |= response(bodies, moving, hits.first_toi("body"))
    return now, counts


def follow(
    comm: Comm, alone: PlainLoop, policy: str, partition: str, graph: bool, device: str, cramped: bool
) -> dict[str, int]:
    expected, counts = alone
    with graphs_on(device if graph else "none") as stack:
        if cramped:
            stack.without_room()
        stack.replays_with_away(0.5)
        world = spread(comm, torch.device(device), policy, partition)
        loop = CapturedWorld(world, motion, response, graph)
        steps: list[WorldStep] = []
        for part in (STEPS - 8, 1, 7):
            steps += loop.run(part)
            assert not steps[-1].replayed and world.steps_made == len(steps)
            assert bool((world.partition.owner_of(world.position) == comm.rank).all())
        assert [(step.pcs, step.contacts) for step in steps] == counts
        rows = torch.div(world.id.cpu() - 1, 3, rounding_mode="floor")
        for name, column in {"position": world.position, **world.payload}.items():
            assert torch.equal(column.cpu(), expected[name][rows]), name
    return {"replayed": sum(step.replayed for step in steps), "owned": len(world.id)}


@on_several
@pytest.mark.parametrize(
    ("policy", "partition", "cramped"),
    [("none", "cells", False), ("cost", "bisection", False), ("cost", "cells", True)],
)
def test_same_bits_as_a_plain_loop(world: Ranks, policy: str, partition: str, cramped: bool) -> None:
    seen = world(follow, plain_loop(STEPS), policy, partition, True, "cpu", cramped)
    assert sum(rank["owned"] for rank in seen) == COUNT
    assert cramped or seen[0]["replayed"] > 6
    assert sum(contacts for _, contacts in plain_loop(STEPS)[1]) > 50


def test_without_graphs(world: Ranks) -> None:
    assert world(follow, plain_loop(STEPS), "cost", "cells", False, "cpu", False)[0]["replayed"] == 0


def test_on_one_device(device: torch.device) -> None:
    assert follow(Alone(), plain_loop(STEPS), "none", "cells", True, str(device), False)["replayed"] > 9


def save_and_load(comm: Comm, alone: PlainLoop, folder: str, device: str = "cpu") -> int:
    """Saves and loads between two parts of a loop; returns the number of replayed steps after it."""
    expected, counts = alone
    with graphs_on(device):
        world = spread(comm, torch.device(device), "cost", "cells")
        steps = CapturedWorld(world, motion, response, True).run(7)
        world.save(folder)
        world = World.load(folder, meshes().meshes, comm=comm, device=device, options=world.options)
        assert world.id.device.type == torch.device(device).type
        after = CapturedWorld(world, motion, response, True).run(len(counts) - 7)
        assert [(step.pcs, step.contacts) for step in steps + after] == counts
        rows = torch.div(world.id.cpu() - 1, 3, rounding_mode="floor")
        for name, column in {"position": world.position, **world.payload}.items():
            assert torch.equal(column.cpu(), expected[name][rows]), name
    return sum(step.replayed for step in after)


def test_a_loop_goes_on_from_a_checkpoint(ranks: RankPool, device: torch.device, tmp_path: Path) -> None:
    assert save_and_load(Alone(), plain_loop(STEPS), str(tmp_path), str(device)) > 5
    assert ranks.run(3, save_and_load, plain_loop(STEPS), str(tmp_path))[0] > 0


def start_empty(comm: Comm) -> int:
    """All bodies start on the last rank, and stay there."""
    with graphs_on("cpu"):
        count = 12 if comm.rank == comm.size - 1 else 0
        columns = {name: column[:count] for name, column in start().items()}
        position = torch.tensor([BOX, BOX, BOX]) - 0.1 * columns["position"]
        world = World.create(
            scene_alone()[:count],
            position,
            (0.0,) * 3,
            (BOX,) * 3,
            id=torch.arange(count),
            payload={name: columns[name] for name in ("q", "v", "w", "free")},
            comm=comm,
            options=WorldOptions(balance=BalanceOptions("none")),
        )

        def rest(bodies: Bodies, _: pgccd.RigidMotion, first_toi: Tensor) -> dict[str, Tensor]:
            return {"position": bodies.position}

        return sum(step.replayed for step in CapturedWorld(world, motion, rest, True).run(12))


def test_ranks_without_bodies(world: Ranks) -> None:
    assert world(start_empty)[0] > 5


def disagree(comm: Comm) -> list[str]:
    """Errors of runs with different arguments on the last rank."""
    world, last, errors = spread(comm, torch.device("cpu"), "none", "cells"), comm.rank == comm.size - 1, []
    with graphs_on("cpu"):
        for graph, steps in ((last, 3), (False, 3 + last)):
            with pytest.raises(ValueError) as raised:
                CapturedWorld(world, motion, response, graph).run(steps)
            errors.append(str(raised.value))
    return errors


def test_arguments_that_differ_between_ranks_are_named(ranks: RankPool) -> None:
    expected = ["graph: rank 0 has False, rank 2 has True", "steps: rank 0 has 3, rank 2 has 4"]
    assert ranks.run(3, disagree) == [expected] * 3


def test_there_are_no_graphs_on_a_cpu() -> None:
    world = spread(Alone(), torch.device("cpu"), "none", "cells")
    with pytest.raises(ValueError, match="^graph: steps on a cpu device cannot be replayed"):
        CapturedWorld(world, motion, response, True).run(9)


def decisions(comm: Comm, graph: bool) -> tuple[list[int], int]:
    """Steps after which space is redistributed, and number of replays."""
    made: list[int] = []
    rebalanced = rebalancing.rebalanced
    with graphs_on("cpu" if graph else "none") as stack:
        world = spread(comm, torch.device("cpu"), "cost", "bisection")

        def noted(*arguments: Any) -> Any:
            made.append(world.steps_made)
            return rebalanced(*arguments)

        stack.enter_context(mock.patch.object(rebalancing, "rebalanced", noted))
        stack.enter_context(mock.patch.object(RankLoads, "are_level", lambda *_: False))
        stack.enter_context(mock.patch.object(BackOff, "is_over", lambda *_: True))
        stack.replays_with_away(0.0)
        steps = CapturedWorld(world, motion, response, graph).run(STEPS)
    return made, sum(step.replayed for step in steps)


def test_space_is_redistributed_between_replays(ranks: RankPool) -> None:
    expected, _ = ranks.run(2, decisions, False)[0]
    found, replayed = ranks.run(2, decisions, True)[0]
    assert expected == list(range(3, STEPS + 1, 3)) and replayed > STEPS // 3
    assert found == expected[1:]  # the first two replays are enqueued before one is read


def exchange_columns(bodies: Bodies, motion: pgccd.RigidMotion, first_toi: Tensor) -> dict[str, Tensor]:
    """Returns columns of the state under other names."""
    new = response(bodies, motion, first_toi)
    return new | {"v": bodies.payload["w"], "w": bodies.payload["v"], "last": bodies.position}


def test_columns_of_the_state_under_other_names(device: torch.device) -> None:
    found = []
    for graph in (False, True):
        with graphs_on(device if graph else "none"):
            start_columns = {name: start()[name].to(device) for name in ("q", "v", "w", "free", "position")}
            position = start_columns.pop("position")
            payload = start_columns | {"last": position}
            scene, options = pgccd.Scene(meshes(), [0] * COUNT).to(device), WorldOptions(nonzero_toi=True)
            world = World.create(scene, position, (0.0,) * 3, (BOX,) * 3, payload=payload, options=options)
            steps = CapturedWorld(world, motion, exchange_columns, graph).run(12)
            assert any(step.replayed for step in steps) == graph
            found.append({"position": world.position, **world.payload})
    for name, column in found[0].items():
        assert torch.equal(column, found[1][name]), name


@pytest.mark.parametrize("graph", [False, True])
def test_columns_that_are_not_contiguous(device: torch.device, graph: bool) -> None:
    def strided(bodies: Bodies, motion: pgccd.RigidMotion, first_toi: Tensor) -> dict[str, Tensor]:
        new = response(bodies, motion, first_toi)
        return {name: torch.stack([column, column], dim=1)[:, 0] for name, column in new.items()}

    expected, _ = plain_loop(9)
    with graphs_on(device if graph else "none"):
        world = spread(Alone(), device, "none", "cells")
        steps = CapturedWorld(world, motion, strided, graph).run(9)
    assert any(step.replayed for step in steps) == graph
    for name, column in {"position": world.position, **world.payload}.items():
        assert torch.equal(column.cpu(), expected[name]), name


def test_a_step_of_invalid_poses_is_an_error(device: torch.device) -> None:
    """Detected by the graph; the step repeated eagerly names the body."""
    with graphs_on(device):
        world = spread(Alone(), device, "none", "cells")

        def break_later(bodies: Bodies, motion: pgccd.RigidMotion, first_toi: Tensor) -> dict[str, Tensor]:
            new = response(bodies, motion, first_toi)
            new["q"] = torch.where((bodies.id == 7)[:, None] & (bodies.step == 6), 2.0 * new["q"], new["q"])
            return new

        loop = CapturedWorld(world, motion, break_later, True)
        with pytest.raises(ValueError, match="orientation(_t0)?: body 2"):
            loop.run(20)
        # On a CPU poses are checked at construction: here in the step enqueued ahead.
        assert world.steps_made == (7 if device.type == "cuda" else 6)


def test_positions_beyond_the_limit_are_errors(device: torch.device) -> None:
    """In replays, too."""
    with graphs_on(device):
        world = spread(Alone(), device, "none", "cells")

        def leave(bodies: Bodies, motion: pgccd.RigidMotion, first_toi: Tensor) -> dict[str, Tensor]:
            new = response(bodies, motion, first_toi)
            far = (bodies.id == 7)[:, None] & (bodies.step == 6)
            return new | {"position": torch.where(far, 2e150, new["position"])}

        with pytest.raises(ValueError, match=r"^position: row 2: expected finite numbers up to 1e\+150, got "):
            CapturedWorld(world, motion, leave, True).run(20)
        assert bool((world.position.abs() < 1e150).all())


def test_what_functions_return_is_checked() -> None:
    world = spread(Alone(), torch.device("cpu"), "none", "cells")
    where: Any
    for where, returned, problem in (
        ("motion", None, r"motion: expected a pgccd.RigidMotion, or \(motion, new values"),
        ("response", {"q": world.payload["q"]}, '"position" among them'),
        ("response", {"position": world.position[1:]}, "position: expected"),
        ("response", {"position": world.position, "speed": world.position}, "speed: not a payload"),
    ):
        functions = {"motion": motion, "response": response} | {where: lambda *_, found=returned: found}
        with pytest.raises((TypeError, ValueError), match=problem):
            CapturedWorld(world, **functions).run(1)
    reports: tuple[Any, ...] = ("all", "earliest")
    for report in reports:
        options = WorldOptions(report=report)
        other = World.create(scene_alone(), world.position, (0.0,) * 3, (BOX,) * 3, options=options)
        with pytest.raises(ValueError, match="world: expected one with report"):
            CapturedWorld(other, motion, response)


_PAIRS = 60


def follow_off_centre(comm: Comm, broad_phase: str) -> list[tuple[int, int, bool]]:
    """PCS, contacts and whether each step was replayed, of meshes whose SBV centre is not their origin. On two ranks, a
    pair of rank 0 reaches the part of rank 1, which sends no ghosts; so padding is beside them.
    """
    mesh = pgccd.Mesh(torch.eye(4, 3).double() + 0.1, [[0, 1, 2], [0, 3, 1], [1, 3, 2], [0, 2, 3]])
    assert not pgccd.MeshSet([mesh]).is_centred
    mine = torch.arange(2 * _PAIRS if comm.rank == 0 else 0)
    # Each pair is in a world of its own, with another height.
    height = 0.5 + 0.03 * (7 * (mine // 2) % _PAIRS)
    position = torch.stack([2.0 + 1.6 * (mine % 2), height + 0.1 * (mine % 2), height], dim=1).double()

    def approach(bodies: Bodies) -> pgccd.RigidMotion:
        turn = torch.eye(4).double()[:1].repeat(len(bodies.id), 1)
        velocity = torch.where(bodies.id % 2 == 0, 2.0, -1.0)[:, None] * turn[:, :3]
        return pgccd.RigidMotion.from_velocity(bodies.position, turn, velocity, 0.0 * velocity, dt=1.0)

    def stay(bodies: Bodies, _motion: pgccd.RigidMotion, _first: Tensor) -> dict[str, Tensor]:
        return {"position": bodies.position}

    def search(bodies: Any, *arguments: Any, **more: Any) -> Any:
        assert not bodies.reach.isnan().any()
        return find_pass(bodies, *arguments, **more)

    with graphs_on("cpu"), mock.patch.object(share, "find_pass", search):
        scene, chosen = pgccd.Scene([mesh], 0 * mine, world=mine // 2), {"broad_phase": broad_phase}
        options = WorldOptions(balance=BalanceOptions("none"), **chosen)  # type: ignore[arg-type]
        box = (0.0,) * 3, (8.0, 4.0, 4.0)
        world = World.create(scene, position, *box, id=mine, comm=comm, options=options)
        steps = CapturedWorld(world, approach, stay, True).run(6)
        return [(step.pcs, step.contacts, step.replayed) for step in steps]


@pytest.mark.parametrize("broad_phase", ["sweep", "grid", "lbvh"])
def test_padding_beside_bodies_at_the_boundary_hides_none(ranks: RankPool, broad_phase: str) -> None:
    for size in (1, 2):
        steps = ranks.run(size, follow_off_centre, broad_phase)[0]
        assert [step[:2] for step in steps] == [(_PAIRS, _PAIRS)] * 6 and sum(step[2] for step in steps) >= 3
