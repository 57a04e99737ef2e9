"""`CapturedWorld(resolve=True)` as replays of a graph: the bits of `pgccd.resolve` in one process, on any ranks."""

from __future__ import annotations

import functools
from typing import Any
from unittest import mock

import pytest
import torch
from support.graphs import graphs_on
from support.ranks import RankPool, on_several
from support.ranks import World as Ranks
from torch import Tensor

import pgccd
from distributed.world.test_loop import meshes
from pgccd.distributed import BalanceOptions, Bodies, CapturedWorld, Comm, World, WorldOptions, WorldStep
from pgccd.distributed.comm.interface import Alone
from pgccd.distributed.detection.replica_exchange import ReplicaExchange
from pgccd.distributed.world import resolve as resolve_module
from pgccd.distributed.world import world_graphs
from pgccd.resolution import listed
from pgccd.resolution.counts import SearchCounts
from pgccd.resolution.round_plan import RecentRounds

SIDE, STEPS, SPACING = 5, 16, 1.7
BOX = SIDE * SPACING
COUNT = SIDE**3
EXCLUDED = [[3, 1], [7, 100]]


@functools.cache
def start() -> dict[str, Tensor]:
    """Bodies on a lattice, apart; half of them turn about a point outside of them."""
    generator = torch.Generator().manual_seed(4)
    random = functools.partial(torch.randn, generator=generator, dtype=torch.float64)
    place = torch.cartesian_prod(*[torch.arange(SIDE, dtype=torch.float64)] * 3)
    return {
        "position": SPACING * (place + 0.5),
        "mesh_index": torch.randint(2, (COUNT,), generator=generator, dtype=torch.int32),
        "margin": 0.02 * torch.rand(COUNT, generator=generator, dtype=torch.float64),
        "static": torch.arange(COUNT) % 13 == 0,
        "q": torch.nn.functional.normalize(random((COUNT, 4))),
        "v": random((COUNT, 3)),
        "w": 2.0 * random((COUNT, 3)),
        "made": torch.zeros(COUNT, dtype=torch.float64),
    }


def motion(bodies: Bodies) -> pgccd.RigidMotion:
    at = bodies.payload
    speed = 0.5 * ((bodies.id + bodies.step) % 3).double()[:, None]
    return pgccd.RigidMotion.from_velocity(bodies.position, at["q"], speed * at["v"], speed * at["w"], dt=0.4)


def response(bodies: Bodies, shortened: pgccd.RigidMotion, fraction: Tensor) -> dict[str, Tensor]:
    """ "made" depends on every bit of the fractions."""
    position, orientation = shortened.at(1.0)
    outside = (position < 0.0) | (position > BOX)
    turns = (fraction < 1.0)[:, None] | outside
    velocity, spin = (torch.where(turns, -bodies.payload[name], bodies.payload[name]) for name in ("v", "w"))
    return {
        "position": position,
        "q": orientation,
        "v": velocity,
        "w": torch.where((fraction < 1.0)[:, None], spin, bodies.payload["w"]),
        "made": bodies.payload["made"] + fraction,
    }


def planned(bodies: Bodies) -> tuple[pgccd.RigidMotion, dict[str, Tensor]]:
    """Bodies steer a little in each step; the response finds the new courses."""
    steered = bodies.payload["v"] + 0.01 * torch.sin(bodies.position + bodies.step)
    payload = bodies.payload | {"v": steered}
    return motion(Bodies(bodies.id, bodies.position, bodies.mesh_index, payload, bodies.step)), {"v": steered}


def tally(bodies: Bodies, moved: pgccd.RigidMotion, answer: Tensor, pairs: Tensor, toi: Tensor) -> Tensor:
    """Number of bodies, contacts, sums of ids of contacts, of bodies that stop, and of bits of columns."""
    own, found = bodies.id >= 0, pairs[:, 0] >= 0
    bits = [bodies.position, bodies.payload["v"], moved.rotation]
    numbers = [
        own.sum(),
        found.sum(),
        pairs[found].sum(),
        (own & (answer < 1.0)).sum(),
        (found & (toi < 0.5)).sum(),
    ]
    numbers += [column[own].view(torch.int64).sum() for column in bits]
    return torch.stack(numbers)


def movable(bodies: Bodies) -> Tensor:
    return bodies.id % 7 != 0


def scene_alone() -> pgccd.Scene:
    at = start()
    return pgccd.Scene(
        meshes(), at["mesh_index"], margin=at["margin"], static=at["static"], exclude=torch.tensor(EXCLUDED)
    )


#: The final columns, and of each step two numbers. Tests give it to ranks, which would each compute it again.
PlainLoop = tuple[dict[str, Tensor], list[tuple[int, int]]]


@functools.cache
def plain_loop(steps: int, initial: str) -> PlainLoop:
    """In one process, by `pgccd.resolve`: the final columns, and contacts and rounds of each step."""
    now, scene, counts = dict(start()), scene_alone(), []
    for step in range(steps):
        payload = {name: now[name] for name in ("q", "v", "w", "made")}
        bodies = Bodies(torch.arange(COUNT), now["position"], now["mesh_index"], payload, torch.tensor([step]))
        moving = motion(bodies)
        options: Any = {"initial": initial}
        contacts = len(pgccd.detect(scene, moving, nonzero_toi=True, **options))
        resolved = pgccd.resolve(scene, moving, movable(bodies), **options)
        counts.append((contacts, resolved.rounds))
        now |= response(bodies, resolved.motion, resolved.fraction)
    return now, counts


def spread(comm: Comm, device: torch.device, initial: str, path: str = "rigid") -> World:
    mine = torch.arange(comm.rank, COUNT, comm.size)
    columns = {name: column[mine].to(device) for name, column in start().items()}
    balance = BalanceOptions("cost", start=0.0, goal=0.0, moving=0.0, deciding=0.0, every=7)
    options: Any = {"initial": initial, "path": path}
    return World.create(
        scene_alone()[mine].to(device),
        columns["position"],
        (0.0,) * 3,
        (BOX,) * 3,
        id=mine.to(device),
        exclude=EXCLUDED if comm.rank == 0 else None,
        payload={name: columns[name] for name in ("q", "v", "w", "made")},
        comm=comm,
        options=WorldOptions(balance=balance, **options),
    )


def require_columns(world: World, expected: dict[str, Tensor]) -> None:
    for name, column in {"position": world.position, **world.payload}.items():
        assert torch.equal(column.cpu(), expected[name][world.id.cpu()]), name


def follow(
    comm: Comm, alone: PlainLoop, initial: str, graph: bool, device: str, cramped: bool = False
) -> dict[str, int]:
    expected, counts = alone
    with graphs_on(device if graph else "none") as stack:
        if cramped:
            stack.without_room()
        world = spread(comm, torch.device(device), initial)
        loop = CapturedWorld(world, motion, response, graph, resolve=True, movable=movable)
        steps: list[WorldStep] = []
        for part in (len(counts) - 7, 1, 6):
            steps += loop.run(part)
            assert not steps[-1].replayed and world.steps_made == len(steps)
        assert [(step.contacts, step.rounds) for step in steps] == counts
        require_columns(world, expected)
    return {"replayed": sum(step.replayed for step in steps), "owned": len(world.id)}


@on_several
@pytest.mark.parametrize(("initial", "cramped"), [("report", False), ("assume_free", False), ("report", True)])
def test_same_bits_as_resolve_in_one_process(world: Ranks, initial: str, cramped: bool) -> None:
    seen = world(follow, plain_loop(STEPS, initial), initial, True, "cpu", cramped)
    assert sum(rank["owned"] for rank in seen) == COUNT
    assert cramped or seen[0]["replayed"] > STEPS // 2
    contacts, rounds = zip(*plain_loop(STEPS, initial)[1], strict=True)
    assert sum(contacts) > 200 and max(rounds) >= 3 and min(rounds) < max(rounds)


def ahead(comm: Comm, alone: PlainLoop) -> int:
    """As on GPUs, ghosts are sent in messages of fixed capacities, which have padding."""
    with mock.patch("pgccd.distributed.steps.rank.sends_ahead", lambda comm, *_: comm.size > 1):
        return follow(comm, alone, "report", False, "cpu")["replayed"]


def test_without_graphs(world: Ranks) -> None:
    expected = plain_loop(STEPS, "report")
    assert world(follow, expected, "report", False, "cpu")[0]["replayed"] == 0
    assert not any(world(ahead, expected))


@pytest.mark.parametrize("initial", ["report", "assume_free"])
def test_on_one_device(device: torch.device, initial: str) -> None:
    assert follow(Alone(), plain_loop(STEPS, initial), initial, True, str(device))["replayed"] > STEPS // 2


def lose_contacts(comm: Comm, alone: PlainLoop, device: str) -> tuple[list[bool], bool]:
    """The last rank loses contacts in a replay of step 9: whether this one's bodies stood still in the attempts at it,
    and whether it was repeated.
    """
    seen: list[bool] = []
    now = torch.zeros(1, dtype=torch.int64, device=device)
    loses = comm.rank == comm.size - 1

    class Losing(SearchCounts):
        def overflow(self) -> list[Tensor]:
            return [*super().overflow(), ((now == 9) & loses).to(torch.int64)]

    def noted(bodies: Bodies) -> pgccd.RigidMotion:
        nonlocal now
        now = bodies.step
        return motion(bodies)

    def answer(bodies: Bodies, shortened: pgccd.RigidMotion, fraction: Tensor) -> dict[str, Tensor]:
        if device == "cpu" and int(bodies.step) == 9:
            is_at_rest = torch.equal(shortened.position_t1, shortened.position_t0) and not shortened.rotation.any()
            seen.append(bool((fraction == 0.0).all()) and is_at_rest)
        return response(bodies, shortened, fraction)

    with graphs_on(device) as stack:
        stack.enter_context(mock.patch.object(world_graphs, "SearchCounts", Losing))
        world = spread(comm, torch.device(device), "report")
        steps = CapturedWorld(world, noted, answer, True, resolve=True, movable=movable).run(len(alone[1]))
        require_columns(world, alone[0])
    return seen, [step.replayed for step in steps].index(False, 1) == 9


def test_nothing_moves_in_a_step_that_is_incomplete(device: torch.device) -> None:
    """Contacts are lost in a replay: the response reads that no body moves, and the step is repeated."""
    seen, is_repeated = lose_contacts(Alone(), plain_loop(STEPS, "report"), str(device))
    assert is_repeated and (device.type != "cpu" or (seen[0] and not seen[-1]))


def test_nothing_moves_if_another_rank_is_incomplete(world: Ranks) -> None:
    for seen, _ in world(lose_contacts, plain_loop(STEPS, "report"), "cpu"):
        assert seen[0] and not seen[-1]


def send_one_row(comm: Comm, alone: PlainLoop) -> int:
    """Replays have room for one body in common with each rank; the number of steps that were repeated."""
    start_exchange = ReplicaExchange.start

    def cramped(share: Any, decomposition: Any, capacities: Any = None, peers: Any = None) -> ReplicaExchange:
        capacities = None if capacities is None else [min(each, 1) for each in capacities]
        return start_exchange(share, decomposition, capacities, peers)

    with graphs_on("cpu"), mock.patch.object(ReplicaExchange, "start", cramped):
        world = spread(comm, torch.device("cpu"), "report")
        steps = CapturedWorld(world, motion, response, True, resolve=True, movable=movable).run(len(alone[1]))
        require_columns(world, alone[0])
    return sum(not step.replayed for step in steps)


def test_bodies_in_common_that_do_not_fit(ranks: RankPool) -> None:
    assert ranks.run(3, send_one_row, plain_loop(9, "report"))[0] > 1


def test_more_rounds_than_were_captured(device: torch.device) -> None:
    """A step that needs more rounds than the graph has is repeated."""
    expected, counts = plain_loop(24, "report")  # some of which need two rounds
    with graphs_on(device) as stack:
        stack.enter_context(mock.patch.object(RecentRounds, "to_capture", 2))
        world = spread(Alone(), device, "report")
        steps = CapturedWorld(world, motion, response, True, resolve=True, movable=movable).run(len(counts))
        require_columns(world, expected)
    for step, (_, rounds) in zip(steps[1:-1], counts[1:-1], strict=True):
        assert step.replayed <= (rounds <= 2) and step.rounds == rounds
    assert any(step.replayed for step in steps)


@pytest.mark.parametrize("farthest", [6.0, 1e9])
def test_far_paths_run_eagerly(farthest: float) -> None:
    """Where far more pairs may meet at any two times than at equal times there is no graph: no list is made where
    bodies move far, and a long one is not made again.
    """
    lists: list[int] = []
    list_pairs = resolve_module.pairs_of_rounds

    def noted(passes: Any) -> Tensor:
        lists.append(len(passes))
        return list_pairs(passes)

    def far(bodies: Bodies) -> pgccd.RigidMotion:
        at = bodies.payload
        return pgccd.RigidMotion.from_velocity(bodies.position, at["q"], 30.0 * at["v"], at["w"], dt=1.0)

    def back(bodies: Bodies, _: pgccd.RigidMotion, fraction: Tensor) -> dict[str, Tensor]:
        return {"position": bodies.position, "made": bodies.payload["made"] + fraction}

    with graphs_on("cpu") as stack:
        stack.enter_context(mock.patch.object(listed, "_FARTHEST", farthest))
        stack.enter_context(mock.patch.object(resolve_module, "pairs_of_rounds", noted))
        world = spread(Alone(), torch.device("cpu"), "report")
        once = pgccd.resolve(
            scene_alone(), far(Bodies(world.id, world.position, world.mesh_index, world.payload, world.id))
        )
        loop = CapturedWorld(world, far, back, True, resolve=True)
        assert not any(step.replayed for step in loop.run(8)) and not loop.is_graph
        assert len(lists) == (1 if farthest > 6.0 else 0)
        assert torch.equal(world.payload["made"], sum([once.fraction] * 8, torch.zeros(COUNT, dtype=torch.float64)))


def test_linear_paths_run_eagerly() -> None:
    world = spread(Alone(), torch.device("cpu"), "report", "linear")
    with pytest.raises(ValueError, match="^graph: resolved steps on linear paths cannot be replayed"):
        CapturedWorld(world, motion, response, True, resolve=True)

    def straight(bodies: Bodies) -> pgccd.RigidMotion:
        end, q = bodies.position + bodies.payload["v"], bodies.payload["q"]
        return pgccd.RigidMotion(bodies.position, q, end, q, path="linear")

    def go(bodies: Bodies, shortened: pgccd.RigidMotion, _: Tensor) -> dict[str, Tensor]:
        return {"position": shortened.position_t1}

    assert not any(step.replayed for step in CapturedWorld(world, straight, go, resolve=True).run(6))


@functools.cache
def steered_loop(steps: int) -> tuple[dict[str, Tensor], list[list[int]]]:
    """As `plain_loop`, of bodies that steer: the final columns, and what is tallied in each step."""
    now, scene, tallied = dict(start()), scene_alone(), []
    for step in range(steps):
        payload = {name: now[name] for name in ("q", "v", "w", "made")}
        bodies = Bodies(torch.arange(COUNT), now["position"], now["mesh_index"], payload, torch.tensor([step]))
        moving, changed = planned(bodies)
        hits = pgccd.detect(scene, moving, nonzero_toi=True)
        resolved = pgccd.resolve(scene, moving)
        now |= changed
        bodies = Bodies(bodies.id, bodies.position, bodies.mesh_index, payload | changed, bodies.step)
        now |= response(bodies, resolved.motion, resolved.fraction)
        after = Bodies(bodies.id, now["position"], bodies.mesh_index, {"v": now["v"]}, bodies.step)
        tallied.append(tally(after, resolved.motion, resolved.fraction, hits.pairs, hits.toi).tolist())
    return now, tallied


def steer(comm: Comm, alone: tuple[dict[str, Tensor], list[list[int]]], graph: bool) -> list[bool]:
    expected, tallied = alone
    with graphs_on("cpu" if graph else "none"):
        world = spread(comm, torch.device("cpu"), "report")
        steps = CapturedWorld(world, planned, response, graph, resolve=True, tally=tally).run(14)
        require_columns(world, expected)
    assert [list(step.tally) for step in steps] == tallied
    return [step.replayed for step in steps]


def test_payload_of_the_motion_and_tallies(world: Ranks) -> None:
    assert not any(world(steer, steered_loop(14), False)[0])
    assert sum(world(steer, steered_loop(14), True)[0]) > 6


def test_what_functions_of_a_step_return_is_checked() -> None:
    world = spread(Alone(), torch.device("cpu"), "report")
    still = lambda bodies: pgccd.RigidMotion.at_rest(bodies.position, bodies.payload["q"])  # noqa: E731
    position = {"position": world.position}
    wrong: list[tuple[dict[str, Any], str]] = [
        (
            {"motion": lambda bodies: (still(bodies), {"u": bodies.position})},
            "motion: 'u' is not a payload of this",
        ),
        ({"motion": lambda bodies: (still(bodies), {"v": bodies.id})}, r"motion: 'v': expected \(125, 3\) float64"),
        ({"motion": lambda bodies: (still(bodies), 1)}, "motion: expected a pgccd.RigidMotion"),
        ({"tally": lambda *_: torch.zeros(2)}, r"tally: expected an int64 tensor \(k,\) to be returned"),
        ({"tally": lambda *_: torch.zeros((), dtype=torch.int64)}, r"tally: expected an int64 tensor \(k,\)"),
    ]
    for functions, message in wrong:
        given: dict[str, Any] = {"motion": still, "response": lambda *_: position} | functions
        with pytest.raises((TypeError, ValueError), match=f"^{message}"):
            CapturedWorld(world, **given).run(1)
    with pytest.raises(TypeError, match="^tally: expected a function, got"):
        CapturedWorld(world, still, lambda *_: position, tally=1)  # type: ignore[arg-type]
