"""Deforming bodies and trajectories on any number of ranks: results equal to one process, and vertices migrate with
their bodies.
"""

from __future__ import annotations

import functools
from typing import Any

import numpy as np
import pytest
import torch
from support.ranks import World
from support.reports import detected, of_contacts, stepped
from support.same_bits import Result, columns_of, difference
from support.shapes import bumpy

import pgccd
from pgccd.distributed import BalanceOptions, Comm, WorldOptions
from pgccd.distributed import World as SharedWorld
from pgccd.distributed.halo.vertices import Vertices, vertex_counts
from pgccd.search.trajectories import TrajectoryContacts

REPORTS = ("first", "all", "any", "earliest")
COUNT, STEPS = 26, 3


@functools.cache
def meshes() -> pgccd.MeshSet:
    rng = np.random.default_rng(3)
    # The last one is larger than any rank's subdomain.
    return pgccd.MeshSet([bumpy(rng, 1), bumpy(rng, 0, size=0.5), bumpy(rng, 2, height=0.05, size=5.0)])


@functools.cache
def bodies() -> dict[str, torch.Tensor]:
    """Columns of bodies in the box [0, 8]^3; some crumple enough to touch themselves, one is static."""
    generator = torch.Generator().manual_seed(8)
    mesh_index = torch.randint(2, (COUNT,), generator=generator, dtype=torch.int32)
    mesh_index[-1] = 2
    static = torch.zeros(COUNT, dtype=torch.bool)
    static[-1] = True
    position = 8.0 * torch.rand((COUNT, 3), generator=generator, dtype=torch.float64)
    position[-1] = torch.tensor([4.0, 4.0, -3.5])
    margin = 0.05 * torch.rand(COUNT, generator=generator, dtype=torch.float64)
    return {
        "position": position,
        "mesh_index": mesh_index,
        "static": static,
        "margin": margin,
        "group": torch.randint(1, 4, (COUNT,), generator=generator),
        "self_collision": torch.arange(COUNT) % 3 == 0,
    }


@functools.cache
def frames(static: bool = True) -> torch.Tensor:
    """(STEPS + 1, X, 3): vertices of all bodies; those of the static one do not move."""
    columns = bodies()
    generator = torch.Generator().manual_seed(9)
    counts = vertex_counts(meshes(), columns["mesh_index"])
    local = torch.cat([meshes().meshes[int(index)].vertices for index in columns["mesh_index"]])
    velocity = 1.5 * torch.randn((COUNT, 3), generator=generator, dtype=torch.float64)
    velocity[-1] = 0.0
    still = torch.arange(COUNT).repeat_interleave(counts) == COUNT - 1
    made = []
    for step in range(STEPS + 1):
        noise = 0.3 * torch.randn(local.shape, generator=generator, dtype=torch.float64)
        centre = columns["position"] + step * velocity
        made.append(local + centre.repeat_interleave(counts, dim=0) + torch.where(still[:, None], 0.0, noise))
    return torch.stack(made)


@functools.cache
def scene() -> pgccd.Scene:
    columns = {name: column for name, column in bodies().items() if name not in ("position", "mesh_index")}
    return pgccd.Scene(meshes(), bodies()["mesh_index"], **columns)


IDS = 5 * torch.arange(COUNT) + 2


@functools.cache
def alone(report: str, step: int) -> pgccd.Contacts:
    return detected(scene(), pgccd.VertexMotion(frames()[step], frames()[step + 1]), report, 0.01)


def spread(
    comm: Comm, report: str, device: torch.device, owners: int = 0, policy: str = "none", partition: str = "cells"
) -> SharedWorld:
    """The bodies distributed over ranks at random; with random owners of cells, if `owners` is not 0."""
    generator = torch.Generator().manual_seed(4)
    mine = torch.nonzero(torch.randint(comm.size, (COUNT,), generator=generator) == comm.rank)[:, 0].flip(0)
    all_vertices = Vertices({"x": frames()[0]}, vertex_counts(meshes(), bodies()["mesh_index"]))
    options = WorldOptions(
        report=of_contacts(report),
        min_separation=0.01,
        partition=partition,
        cells=4,
        balance=BalanceOptions(policy, start=0.0, goal=0.0, moving=0.0, deciding=0.0),
    )
    world = SharedWorld.create(
        scene()[mine].to(device),
        bodies()["position"][mine].to(device),
        (0.0,) * 3,
        (8.0,) * 3,
        id=IDS[mine].to(device),
        payload={"tag": 3 * mine.to(device)},
        vertex_payload={name: column.to(device) for name, column in all_vertices.take(mine).columns.items()},
        comm=comm,
        options=options,
    )
    if owners:
        generator.manual_seed(owners)
        owner = torch.randint(comm.size, (world.partition.cell_count,), generator=generator).to(device)
        world.partition = world.partition.with_owner(owner)
        world.move(world.position)
    return world


def rows_of(world: SharedWorld) -> torch.Tensor:
    """Rows of `bodies` that this rank owns now."""
    return torch.searchsorted(IDS, world.id.cpu())


def vertices_of(rows: torch.Tensor, step: int) -> torch.Tensor:
    """Vertices of some of the bodies in a step's frame."""
    whole = Vertices({"x": frames()[step]}, vertex_counts(meshes(), bodies()["mesh_index"]))
    return whole.take(rows).columns["x"]


def require_equal(world: SharedWorld, found: Result, whole: Result, report: str) -> None:
    pairs = IDS[whole.pairs]
    affected = torch.isin(pairs, world.id.cpu()).any(dim=1)
    if report == "earliest":
        affected[:] = True
    expected = {name: column[affected] for name, column in (columns_of(whole) | {"pairs": pairs}).items()}
    said = difference(columns_of(found), expected)
    assert said is None, said


def deform_bisected(comm: Comm, report: str) -> dict[str, int]:
    return deform(comm, report, partition="bisection")


def deform(
    comm: Comm,
    report: str,
    device: torch.device = torch.device("cpu"),  # noqa: B008
    partition: str = "cells",
) -> dict[str, int]:
    """Follows the bodies for some steps, with two tables of owners."""
    seen = dict.fromkeys(("contacts", "with itself", "ghosts", "arrived"), 0)
    for owners, policy in ((0, "cost"), (5, "none")):
        if partition == "bisection":
            owners, policy = 0, "cost"
        world = spread(comm, report, device, owners, policy, partition)
        for step in range(STEPS):
            before = world.vertex_payload["x"]
            rows = rows_of(world)
            assert torch.equal(before.cpu(), vertices_of(rows, step))  # migrated with their bodies
            assert torch.equal(world.payload["tag"].cpu(), 3 * rows)
            after = vertices_of(rows, step + 1).to(device)
            found = stepped(world, pgccd.VertexMotion(before, after), report)
            whole = alone(report, step)
            require_equal(world, found, whole, report)
            assert world.found is not None
            assert int(comm.sum(torch.tensor([len(world.found.pairs)]))) == whole.stats.pcs
            if report == "first":
                first = torch.full((COUNT,), torch.inf, dtype=torch.float64)
                assert whole.toi is not None
                first.scatter_reduce_(0, whole.pairs.reshape(-1), whole.toi.repeat_interleave(2), "amin")
                assert torch.equal(world.first_toi(found).cpu(), first[rows])
            seen["contacts"] += len(whole)
            seen["with itself"] += int((whole.pairs[:, 0] == whole.pairs[:, 1]).sum())
            seen["ghosts"] += world.found.held.ghost_count
            had = set(world.id.tolist())
            begin = world._vertices.count.cumsum(0) - world._vertices.count  # type: ignore[union-attr]
            world.move(after[begin], x=after)  # positions are those of the first vertices
            seen["arrived"] += len(set(world.id.tolist()) - had)
    return seen


@pytest.mark.parametrize("report", REPORTS)
def test_deforming_bodies(world: World, report: str) -> None:
    seen = world(deform, report)
    assert seen[0]["contacts"] > 0
    if report in ("first", "all"):
        assert seen[0]["with itself"] > 0
    if len(seen) > 1:
        assert sum(rank["ghosts"] for rank in seen) > 0 and sum(rank["arrived"] for rank in seen) > 0


def turning(rows: torch.Tensor) -> pgccd.Trajectory:
    """A trajectory of some of the bodies, as rigid ones."""
    generator = torch.Generator().manual_seed(2)
    steps = torch.randn((5, COUNT, 3), generator=generator, dtype=torch.float64).cumsum(0)
    steps[:, -1] = 0.0
    orientation = torch.randn((5, COUNT, 4), generator=generator, dtype=torch.float64)
    orientation[:, -1] = torch.tensor([1.0, 0.0, 0.0, 0.0], dtype=torch.float64)
    orientation /= orientation.norm(dim=2, keepdim=True)
    margin = 0.1 * torch.rand((4, COUNT), generator=generator, dtype=torch.float64)
    return pgccd.Trajectory((bodies()["position"] + steps)[:, rows], orientation[:, rows], margin=margin[:, rows])


@functools.cache
def followed(report: Any, deforms: bool) -> TrajectoryContacts | pgccd.CollidingPairs:
    trajectory = pgccd.Trajectory(frames()) if deforms else turning(torch.arange(COUNT))
    return detected(scene(), trajectory, report, 0.01)


def follow(comm: Comm, report: str, deforms: bool, device: torch.device = torch.device("cpu")) -> int:  # noqa: B008
    whole = followed(report, deforms)
    for owners in (0, 7):
        world = spread(comm, report, device, owners)
        rows = rows_of(world)
        if deforms:
            mine = torch.stack([vertices_of(rows, step) for step in range(STEPS + 1)])
            trajectory = pgccd.Trajectory(mine.to(device))
        else:
            waypoints = turning(rows)
            assert waypoints.orientation is not None and waypoints.margin is not None
            columns = (waypoints.position, waypoints.orientation, waypoints.margin)
            x, q, margin = (column.to(device) for column in columns)
            trajectory = pgccd.Trajectory(x, q, margin=margin)
        found = stepped(world, trajectory, report)
        assert type(found) is (pgccd.CollidingPairs if report == "any" else TrajectoryContacts)
        require_equal(world, found, whole, report)
        if report == "first" and isinstance(whole, TrajectoryContacts):
            first = torch.full((COUNT,), torch.inf, dtype=torch.float64)
            first.scatter_reduce_(0, whole.pairs.reshape(-1), whole.time.repeat_interleave(2), "amin")
            assert torch.equal(world.first_toi(found).cpu(), first[rows])
    return len(whole)


@pytest.mark.parametrize("deforms", [False, True], ids=["rigid", "deforming"])
@pytest.mark.parametrize("report", REPORTS)
def test_trajectories(world: World, report: str, deforms: bool) -> None:
    assert world(follow, report, deforms)[0] > 0


def mistakes(comm: Comm) -> list[str]:
    """Errors for motions and payloads that do not match."""
    world = spread(comm, "first", torch.device("cpu"))
    x = world.vertex_payload["x"]
    said = []
    wrong: list[Any] = [
        pgccd.VertexMotion(x[:-1], x[:-1]),
        pgccd.Trajectory(torch.stack([x[:-1]] * 2)),
        pgccd.Trajectory(torch.stack([x] * (2 + comm.rank))),
        pgccd.Trajectory(torch.stack([x] * 2), margin=torch.zeros(1, len(world.id)) if comm.rank else None),
        x,
    ]
    for motion in wrong:
        with pytest.raises((ValueError, TypeError)) as caught:
            world.step(motion)
        said.append(str(caught.value))
    for payload in ({"x": x[:-1]}, {"y": x}):
        with pytest.raises(ValueError) as caught:  # noqa: PT011
            world.move(world.position, **payload)
        said.append(str(caught.value))
    assert torch.equal(world.vertex_payload["x"], x)
    return said


def largest_id(comm: Comm) -> list[str]:
    scene = pgccd.Scene([pgccd.Mesh(((0.0, 0.0, 0.0), (1.0, 0.0, 0.0), (0.0, 1.0, 0.0)), ((0, 1, 2),))])
    position = torch.zeros((1, 3), dtype=torch.float64)
    upright = torch.tensor([[1.0, 0.0, 0.0, 0.0]], dtype=torch.float64)
    said = []
    for id in (2**63 - 1, 2**62 - 1):
        mine = torch.tensor([id - comm.rank])
        world = SharedWorld.create(scene, position + 3.0 * comm.rank, (0.0,) * 3, (8.0,) * 3, id=mine, comm=comm)
        count = len(world.id)
        steps = pgccd.Trajectory(world.position.expand(2, count, 3), upright.expand(2, count, 4))
        with pytest.raises(ValueError) as caught:
            world.step(steps)
        said.append(str(caught.value))
    return said


def test_ids_too_large_for_segments_are_named(ranks: World) -> None:
    for said in ranks.run(2, largest_id):  # type: ignore[attr-defined]
        for message, id in zip(said, (2**63 - 1, 2**62 - 1), strict=True):
            assert message == f"motion: 1 segments are too many for ids up to {id} and worlds up to 0"


def test_mistakes_are_named(ranks: World) -> None:
    for said in ranks.run(2, mistakes):  # type: ignore[attr-defined]
        assert "motion: has" in said[0] and "vertices, this rank owns" in said[0]
        assert "vertices, this rank owns" in said[1]
        assert said[2] == "motion.segment_count: rank 0 has 1, rank 1 has 2"
        assert said[3] == "motion.margin: rank 0 has 'not given', rank 1 has 'given'"
        assert said[4].startswith("motion: expected a pgccd.RigidMotion, VertexMotion or Trajectory")
        assert said[5].startswith("x: expected (") and said[6].startswith("y: not a payload of this world")


def look_at_all(comm: Comm) -> bool:
    """Whether contacts of one of several ranks refuse to tell of the scene."""
    mine = torch.arange(comm.rank, 40, comm.size)
    position = torch.rand((40, 3), dtype=torch.float64, generator=torch.Generator().manual_seed(2))[mine]
    mesh = pgccd.Mesh(0.2 * torch.eye(4, 3).double(), [[0, 1, 2], [0, 3, 1], [1, 3, 2], [0, 2, 3]])
    scene = pgccd.Scene([mesh], [0] * len(mine))
    world = SharedWorld.create(scene, position, (0.0,) * 3, (1.0,) * 3, id=mine, comm=comm)
    turn = torch.eye(4).double()[:1].repeat(len(world.id), 1)
    hits = world.step(pgccd.RigidMotion.at_rest(world.position, turn))
    assert world.first_toi(hits).shape == (len(world.id),)
    refused = []
    for some in (hits, hits[: len(hits) // 2]):
        for ask in (some.may_collide, some.first_toi):
            try:
                ask()
            except ValueError as error:
                refused.append("this rank's bodies alone" in str(error))
    assert not any(refused) or (len(refused) == 4 and all(refused))
    return bool(refused)


@pytest.mark.parametrize("size", [1, 2])
def test_contacts_of_a_rank_say_nothing_of_the_scene(ranks: World, size: int) -> None:
    assert ranks.run(size, look_at_all) == [size > 1] * size  # type: ignore[attr-defined]
