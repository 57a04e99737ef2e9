"""`World.step(..., resolve=True)`: the bits of `pgccd.resolve` on any number of ranks, and no two bodies overlap."""

from __future__ import annotations

import functools
import itertools
from typing import Any

import numpy as np
import pytest
import torch
from support.cases import few_and_many, mostly_slow
from support.random_scenes import random_scene
from support.ranks import RankPool
from support.resolving import check_boxes
from support.resolving_ranks import (
    HALF,
    Columns,
    Crowds,
    columns_of,
    movable_of,
    of_rank,
    require_equal,
    resolve_crowds,
    resolve_scenes,
)
from support.same_bits import difference

import pgccd
from pgccd.distributed import BalanceOptions, CapturedWorld, Comm, DisagreementError, WorldOptions
from pgccd.distributed import World as SharedWorld


@functools.cache
def alone(seed: int) -> tuple[Columns, Columns]:
    """The resolution of a random scene by one process, and its contacts."""
    made = random_scene(seed)
    options = {name: made.arguments[name] for name in ("min_separation", "tolerance", "initial")}
    scene, motion = made.scene(), made.motion()
    resolved = pgccd.resolve(scene, motion, movable_of(made), **options)
    if isinstance(motion, pgccd.Trajectory):
        return columns_of(resolved), {}
    hits = pgccd.detect(scene, motion, nonzero_toi=True, **options)
    return columns_of(resolved), {"pairs": hits.pairs, "toi": hits.toi}


@pytest.mark.parametrize(
    "size", [1, pytest.param(2, marks=pytest.mark.slow), 3, pytest.param(4, marks=pytest.mark.slow)]
)
@few_and_many("count", 24, 40)
def test_random_scenes(ranks: RankPool, size: int, count: int) -> None:
    answers = ranks.run(size, resolve_scenes, range(count), "cpu")
    seen = dict.fromkeys(("stopped", "touching_at_start", "unresolved", "rounds"), 0)
    for k, seed in enumerate(range(count)):
        whole, hits = alone(seed)
        for rank in answers:
            own, found, told = rank[k]
            scene = random_scene(seed)
            rows = scene.rows_of(own) if scene.kind.startswith("deforming") else None
            said = difference(found, of_rank(whole, own, rows))
            if hits:
                concerns = torch.isin(hits["pairs"], own).any(dim=1)
                said = said or difference(told, {name: column[concerns] for name, column in hits.items()})
            assert said is None, f"{scene}: {said}"
        seen["stopped"] += int((whole["fraction"] < 1.0).sum())
        seen["rounds"] += int(whole["rounds"] > 2)
        for name in ("touching_at_start", "unresolved"):
            seen[name] += len(whole[name])
    assert min(seen.values()) > 0 and seen["stopped"] > 50, seen


CROWDS, BODIES = 260, 8


@pytest.mark.parametrize(
    ("seed", "deforming"), mostly_slow(itertools.product(range(4), (False, True)), [(0, True), (1, False), (2, True)])
)
def test_crowds_do_not_overlap(ranks: RankPool, seed: int, deforming: bool) -> None:
    """2,080 crowds: equal to one process, whose result an independent test of overlaps looks at."""
    crowds = Crowds(seed, CROWDS, BODIES, deforming)
    resolved = pgccd.resolve(crowds.scene, crowds.motion, crowds.movable)
    require_equal(
        ranks.run(1 + seed, resolve_crowds, seed, CROWDS, BODIES, deforming), columns_of(resolved), 8 * deforming
    )
    fraction = resolved.fraction
    assert int(((fraction > 0.0) & (fraction < 1.0)).sum()) > CROWDS and resolved.rounds > 3
    listed = {tuple(pair) for p in (resolved.touching_at_start, resolved.unresolved) for pair in p.tolist()}
    free = [pair for pair in listed if not crowds.movable[list(pair)].all()]
    assert len(free) > 20
    if isinstance(crowds.motion, pgccd.RigidMotion):
        # Side by side, so that boxes of two crowds are never near.
        moved = crowds.motion.columns()
        aside = torch.tensor(crowds.crowd)[:, None] * torch.tensor([60.0, 0.0, 0.0], dtype=torch.float64)
        apart = pgccd.RigidMotion.from_rotation(
            moved["position_t0"] + aside, moved["orientation_t0"], moved["position_t1"] + aside, moved["rotation"]
        )
        listed |= set(itertools.combinations(torch.nonzero(crowds.scene.static)[:, 0].tolist(), 2))  # not tested
        assert check_boxes(HALF, apart, fraction, listed, times=7) > 1000
        return
    gaps, near = zip(*(crowds.gaps(fraction.numpy(), listed, t) for t in np.linspace(0.0, 1.0, 9)), strict=True)
    assert min(gaps) > 1e-9 and sum(near) > 1000
    # The check itself finds bodies that stop at their own toi while others go on.
    own = pgccd.detect(crowds.scene, crowds.motion, nonzero_toi=True).first_toi("body").clamp(max=1.0)
    assert crowds.gaps(torch.where(crowds.movable, own, 1.0).numpy(), listed, 1.0)[0] < 0.0


def motion(bodies: Any) -> pgccd.RigidMotion:
    at = bodies.payload
    return pgccd.RigidMotion.from_velocity(bodies.position, at["q"], 0.5 * at["v"], at["w"], dt=0.5)


def response(bodies: Any, shortened: pgccd.RigidMotion, fraction: torch.Tensor) -> dict[str, torch.Tensor]:
    """Boxes turn round where they are stopped."""
    position, q = shortened.at(1.0)
    sign = torch.where(fraction < 1.0, -1.0, 1.0)[:, None]
    return {"position": position, "q": q, **{name: sign * bodies.payload[name] for name in ("v", "w")}}


def movable(bodies: Any) -> torch.Tensor:
    return bodies.id % 7 != 0


def walk(comm: Comm, device: str, captured: bool) -> list[Any]:
    """Steps in which boxes migrate and space is rebalanced: the bodies at the end, and the ids of those that stopped in
    each step.
    """
    crowd = Crowds(9, 1, 40, deforming=False)
    start = crowd.motion.columns()
    columns = {"q": start["orientation_t0"], "v": start["position_t1"] - start["position_t0"], "w": start["rotation"]}
    mine = torch.arange(40)[comm.rank :: comm.size]
    options = WorldOptions(
        report="first" if captured else "all",  # a resolution does not depend on it
        balance=BalanceOptions("cost", start=0.0, goal=0.0, moving=0.0, deciding=0.0),
    )
    world: Any = SharedWorld.create(
        pgccd.Scene(crowd.scene.meshes, [0] * len(mine)).to(device),
        start["position_t0"][mine].to(device),
        (0.0,) * 3,
        (4.0,) * 3,
        id=mine.to(device),
        payload={name: column[mine].to(device) for name, column in columns.items()},
        comm=comm,
        options=options,
    )
    stopped = []
    if captured:
        loop = CapturedWorld(world, motion, response, resolve=True, movable=movable)
        assert not any(step.replayed for step in loop.run(4))
    for _ in range(0 if captured else 4):
        resolved = world.step(motion(world), resolve=True, movable=movable(world))
        assert torch.equal(resolved.fraction < 1.0, resolved.stopped_by >= 0)
        stopped.append(world.id[resolved.fraction < 1.0].tolist())
        world.move(**response(world, resolved.motion, resolved.fraction))
    assert world.steps_made == 4
    return [world.id.cpu(), world.position.cpu(), world.payload["q"].cpu(), stopped]


def test_loops(ranks: RankPool) -> None:
    expected = ranks.run(1, walk, "cpu", False)[0]
    stopped = {body for ids in expected[3] for body in ids}
    assert sum(map(len, expected[3])) > 30 and not any(body % 7 == 0 for body in stopped)
    for size, captured in ((1, True), (2, True), (4, False)):
        answers = ranks.run(size, walk, "cpu", captured)
        id = torch.cat([answer[0] for answer in answers])
        for column in (1, 2):
            assert torch.equal(torch.cat([answer[column] for answer in answers])[id.argsort()], expected[column])
        for step, ids in enumerate([] if captured else expected[3]):
            assert sorted(i for answer in answers for i in answer[3][step]) == ids


def one_box_a_rank(comm: Comm) -> tuple[Any, pgccd.RigidMotion]:
    """A world of boxes at rest."""
    x = torch.tensor([[3.0 * comm.rank, 0.0, 0.0]], dtype=torch.float64)
    scene = pgccd.Scene([pgccd.Mesh.box([1.0] * 3)])
    world = SharedWorld.create(scene, x, (-1.0,) * 3, (4.0, 1.0, 1.0), comm=comm)
    upright = torch.tensor([[1.0, 0, 0, 0]], dtype=torch.float64).expand(len(world.id), 4)
    return world, pgccd.RigidMotion.at_rest(world.position, upright)


def wrong_arguments(comm: Comm) -> None:
    world, still = one_box_a_rank(comm)
    count = len(world.id)
    assert count == 1
    for given, kind, message in (
        ({"resolve": 1}, TypeError, "resolve: expected"),
        ({"movable": [True]}, ValueError, "movable: can only be given with resolve=True"),
        ({"resolve": True, "movable": [True, True]}, ValueError, r"movable: expected shape \(1,\), got \(2,\)"),
        ({"resolve": True, "movable": [1]}, TypeError, "movable: expected bool"),
    ):
        with pytest.raises(kind, match=message):
            world.step(still, **given)
    for given, kind, message in (
        ({"movable": movable}, ValueError, "movable: can only be given with resolve=True"),
        ({"movable": [True], "resolve": True}, TypeError, "movable: expected a function, got"),
        ({"resolve": 1}, TypeError, "resolve: expected"),
    ):
        with pytest.raises(kind, match=message):
            CapturedWorld(world, motion, response, **given)


def test_arguments(ranks: RankPool) -> None:
    ranks.run(2, wrong_arguments)


def disagreements(comm: Comm) -> None:
    world, still = one_box_a_rank(comm)
    with pytest.raises(DisagreementError, match="resolve: rank 0 has True, rank 1 has False"):
        world.step(still, resolve=comm.rank == 0)
    with pytest.raises(DisagreementError, match="resolve: rank 0 has False, rank 1 has True"):
        CapturedWorld(world, motion, response, resolve=comm.rank == 1).run(1)
    count = 2 + comm.rank
    path = pgccd.Trajectory(still.position_t0.expand(count, 1, 3), still.orientation_t0.expand(count, 1, 4))
    with pytest.raises(DisagreementError, match="motion.segment_count: rank 0 has 1, rank 1 has 2"):
        world.step(path, resolve=True)
    path = pgccd.Trajectory(still.position_t0.expand(2, 1, 3), still.orientation_t0.expand(2, 1, 4))
    thick = pgccd.Trajectory(path.position, path.orientation, margin=torch.zeros(1, 1))
    for resolve in (True, False):
        with pytest.raises(DisagreementError, match="motion.margin: rank 0 has 'not given', rank 1 has 'given'"):
            world.step(thick if comm.rank else path, resolve=resolve)


def test_ranks_resolve_together(ranks: RankPool) -> None:
    ranks.run(2, disagreements)


def mistakes_of_one_rank(comm: Comm) -> list[list[str]]:
    """What all ranks raise if the last one is wrong; the world goes on."""
    world, still = one_box_a_rank(comm)
    last, said = comm.rank == comm.size - 1, []
    linear = pgccd.RigidMotion(
        *[still.columns()[name] for name in ("position_t0", "orientation_t0")] * 2, path="linear"
    )
    path = pgccd.Trajectory(still.position_t0.expand(2, 1, 3), still.orientation_t0.expand(2, 1, 4))
    wrong: list[tuple[Any, Any]] = [
        (still[:0], None),
        (linear, None),
        (path.position, None),
        (pgccd.Trajectory(path.position, path.orientation, "linear"), None),
        (pgccd.Trajectory(path.position.expand(2, 2, 3), path.orientation.expand(2, 2, 4)), None),
        (pgccd.Trajectory(path.position[:, :0]), None),
        (still, [True, True]),
        (still, "yes"),
        (path, [1.0]),
    ]
    for motion, movable in wrong:
        right = path if isinstance(motion, pgccd.Trajectory) else still
        of_step: list[dict[str, Any]] = [{"resolve": True, "movable": movable}] + [{}] * (movable is None)
        for options in of_step:
            with pytest.raises((TypeError, ValueError)) as caught:
                world.step(motion if last else right, **(options if last else {"resolve": "resolve" in options}))
            said.append(str(caught.value))
    assert len(world.step(still)) == 0 and world.steps_made == 1
    return said


def test_mistakes_of_one_rank_are_named_on_all(ranks: RankPool) -> None:
    names = [*["motion"] * 12, *["movable"] * 3]
    for said in ranks.run(2, mistakes_of_one_rank):
        assert [text.removeprefix("rank 1: ").split(":")[0] for text in said] == names, said


def no_bodies(comm: Comm) -> list[int]:
    none = torch.zeros((0, 3), dtype=torch.float64)
    scene = pgccd.Scene([pgccd.Mesh.box([1.0] * 3)], [])
    world = SharedWorld.create(scene, none, (0.0,) * 3, (1.0,) * 3, comm=comm)
    resolved = world.step(pgccd.RigidMotion.at_rest(none, torch.zeros(0, 4)), resolve=True)
    return [len(resolved.fraction), len(resolved.touching_at_start), len(resolved.unresolved), resolved.rounds]


def test_no_bodies(ranks: RankPool) -> None:
    assert ranks.run(2, no_bodies) == [[0, 0, 0, 0]] * 2
