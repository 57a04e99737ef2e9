"""Every pair is tested by exactly one rank, and every owner gets the contacts: results equal to one process."""

from __future__ import annotations

import functools
import re
from dataclasses import replace
from typing import Any
from unittest import mock

import pytest
import torch
from support.cases import mostly_slow
from support.crowds import crowds
from support.ranks import World, to_all
from support.reports import of_contacts, stepped
from support.same_bits import assert_same, contacts_hash

import pgccd
from pgccd.distributed import BalanceOptions, Cells, Comm, WorldOptions
from pgccd.distributed import World as SharedWorld
from pgccd.distributed.comm.exchange import take_rows

REPORTS = ("first", "all", "any", "earliest")


@functools.cache
def by_one_process(name: str) -> dict[str, pgccd.Contacts]:
    """The contacts of each report."""
    return {report: crowds()[name].detect(report) for report in REPORTS}


def share(
    comm: Comm, name: str, report: str, seed: int, overlap: bool, device: torch.device
) -> tuple[SharedWorld, torch.Tensor]:
    """A crowd's bodies distributed at random, with random owners of cells; and ids by row of the crowd."""
    crowd = crowds()[name]
    generator = torch.Generator().manual_seed(seed)
    count = len(crowd.position)
    ids = 10 * torch.arange(count) + 3  # global ids are not row numbers
    mine = torch.nonzero(torch.randint(comm.size, (count,), generator=generator) == comm.rank)[:, 0]
    columns = {"orientation": crowd.orientation, "velocity": crowd.velocity, "rotation": crowd.rotation}
    options = WorldOptions(
        report=of_contacts(report),
        min_separation=crowd.min_separation,
        axes=3 if comm.neighbours_above else 1,  # slabs, which are not all neighbours
        cells=4,
        balance=BalanceOptions("none"),
        overlap=overlap,
    )
    world = SharedWorld.create(
        crowd.scene(mine).to(device),
        crowd.position[mine].to(device),
        (0.0,) * 3,
        (8.0,) * 3,
        id=ids[mine].to(device),
        payload={name: column[mine].to(device) for name, column in columns.items()},
        comm=comm,
        options=options,
    )
    if seed:
        owner = torch.randint(comm.size, (world.partition.cell_count,), generator=generator).to(device)
        world.partition = world.partition.with_owner(owner)
        world.move(world.position)
    assert bool((world.partition.owner_of(world.position) == comm.rank).all())
    return world, ids


def find(
    comm: Comm,
    name: str,
    device: torch.device = torch.device("cpu"),  # noqa: B008
    neighbours_above: int = 32,
    expected: dict[str, pgccd.Contacts] | None = None,
) -> list[tuple[int, int]]:
    """Compares all reports with one process (with `expected`, if given), with cells of random owners, and once with the
    uniform ones; returns the numbers of pairs and ghosts of this rank, per assignment.
    """
    expected = expected or by_one_process(name)
    comm.neighbours_above, seen = neighbours_above, []
    for index, report in enumerate(REPORTS):
        whole = expected[report]
        seeds = (0, 1) if index == 0 else (1 + index,)
        for seed in seeds if comm.size > 1 else (0,):
            world, ids = share(comm, name, report, seed, seed % 2 == 1, device)
            mine = world.payload
            motion = pgccd.RigidMotion.from_velocity(
                world.position, mine["orientation"], mine["velocity"], mine["rotation"], dt=1.0
            )
            hits = stepped(world, motion, report)
            expected_pairs = ids[whole.pairs]
            affected = torch.isin(expected_pairs, world.id.cpu()).any(dim=1)
            if report == "earliest":
                affected[:] = True
            assert_same(hits, replace(whole, pairs=expected_pairs)[affected])
            # The ranks together tested every pair exactly once.
            assert int(comm.sum(torch.tensor([len(world.found.pairs)]))) == whole.stats.pcs
            ids_tested = world.found.held.id[world.found.pairs]
            everything = torch.cat([torch.tensor(rows).view(-1, 2) for rows in to_all(comm, ids_tested.tolist())])
            assert len(everything.unique(dim=0)) == whole.stats.pcs
            if report == "first":
                first = whole.first_toi("body")
                assert torch.equal(world.first_toi(hits).cpu(), first[torch.searchsorted(ids, world.id.cpu())])
            assert int(world.loads().sum()) == len(ids) + 8 * whole.stats.pcs
            owners = world.found.held.owner[world.found.pairs]
            seen.append((len(whole), int((owners != comm.rank).all(dim=1).sum())))
    return seen


@pytest.mark.parametrize("name", list(crowds()))
def test_same_bits_as_one_process(world: World, name: str) -> None:
    seen = world(find, name, torch.device("cpu"), 32, by_one_process(name))
    if name not in ("one body", "no bodies"):
        assert max(contacts for contacts, _ in seen[0]) > 0, "nothing collides: nothing was tested"
    if name == "met in a third rank's cell" and len(seen) == 4:
        assert any(strangers for rank in seen for _, strangers in rank)


#: Crowds whose bodies reach further than to neighbours, or have none.
FAR = ("met in a third rank's cell", "faster than cells", "larger than subdomains", "no bodies")


@pytest.mark.parametrize("name", mostly_slow(crowds(), FAR))
def test_same_bits_with_neighbours_only(ranks: World, name: str) -> None:
    """Bodies that reach further than to neighbours extend these."""
    ranks.run(4, find, name, torch.device("cpu"), 0, by_one_process(name))


def tumble(comm: Comm, policy: str) -> list[str]:
    """A user loop over several steps, whose bodies migrate; returns a hash of all results per step."""
    crowd = crowds()["kept apart, filtered"]
    mine = torch.arange(comm.rank, len(crowd.position), comm.size).flip(0)  # not sorted
    columns = {"orientation": crowd.orientation, "velocity": crowd.velocity, "rotation": crowd.rotation}
    balance = BalanceOptions(policy, every=2, start=0.0, goal=0.0, moving=0.0, deciding=0.0)
    world = SharedWorld.create(
        pgccd.Scene(crowd.meshes, crowd.mesh_index[mine]),
        crowd.position[mine],
        (0.0,) * 3,
        (8.0,) * 3,
        id=mine,
        payload={**take_rows(columns, mine), "tag": 7 * mine},
        comm=comm,
        options=WorldOptions(nonzero_toi=True, cells=4, balance=balance),
    )
    seen, owners = [], set()
    for _ in range(8):
        payload = world.payload
        motion = pgccd.RigidMotion.from_velocity(
            world.position, payload["orientation"], payload["velocity"], payload["rotation"], dt=0.2
        )
        hits = world.step(motion)
        toi = world.first_toi(hits)
        assert torch.equal(payload["tag"], 7 * world.id)
        free = torch.isinf(toi)[:, None]
        # A contact is told to the owners of both bodies.
        rows = contacts_hash(hits, torch.isin(hits.pairs[:, 0], world.id))
        rows += pgccd.sim.contacts_hash(torch.stack([world.id, world.id], dim=1), toi)
        signed = (rows + 2**63) % 2**64 - 2**63
        seen.append(f"{int(comm.sum(torch.tensor([signed]))) % 2**64:016x}")
        owners.add(tuple(world.partition.owner.tolist()))
        # Bodies pass through each other: only results are compared.
        world.move(motion.position_t1, velocity=torch.where(free, payload["velocity"], -payload["velocity"]))
    assert comm.size == 1 or policy == "none" or len(owners) > 1
    return seen


def tumble_ahead(comm: Comm, policy: str) -> list[str]:
    """The same with padded messages of ghosts, as on GPUs."""
    with mock.patch("pgccd.distributed.steps.rank.sends_ahead", lambda comm, *_: comm.size > 1):
        return tumble(comm, policy)


@pytest.mark.parametrize("policy", ["cost", "measured", "none"])
def test_loops_of_one_s_own_come_out_alike(ranks: World, policy: str) -> None:
    alone = ranks.run(1, tumble, policy)[0]
    assert len(set(alone)) > 4
    assert ranks.run(3, tumble, policy)[0] == alone
    assert ranks.run(4, tumble_ahead, policy)[0] == alone


def leave_alone(comm: Comm) -> None:
    """A world without payload, ids, or bodies on some ranks; and errors for invalid input."""
    mesh = crowds()["one body"].meshes[0]
    count = 5 if comm.rank == 0 else 0
    position = 2.0 * torch.arange(3.0 * count, dtype=torch.float64).view(count, 3)
    world = SharedWorld.create(pgccd.Scene([mesh], [0] * count), position, (0.0,) * 3, (8.0,) * 3, comm=comm)
    assert int(comm.sum(torch.tensor([len(world.id)]))) == 5
    with pytest.raises(TypeError, match="^motion: expected a pgccd.RigidMotion, VertexMotion or Trajectory, got "):
        world.step(mesh.vertices)  # type: ignore[arg-type]
    still = torch.zeros((len(world.id) + 1, 3), dtype=torch.float64)
    upright = torch.tensor([[1.0, 0.0, 0.0, 0.0]], dtype=torch.float64).expand(len(still), 4)
    with pytest.raises(ValueError, match="^motion: has .* bodies"):
        world.step(pgccd.RigidMotion(still, upright, still, upright))
    linear = pgccd.RigidMotion(still[1:], upright[1:], still[1:], upright[1:], path="linear")
    with pytest.raises(ValueError, match="^motion: its path is 'linear'"):
        world.step(linear)
    with pytest.raises(ValueError, match="^mood: not a payload"):
        world.move(world.position, mood=still)
    with pytest.raises(ValueError, match="^position: expected"):
        world.move(still)


def test_mistakes_are_named(world: World) -> None:
    world(leave_alone)


def disagree(comm: Comm) -> list[str]:
    """All ranks raise the same error, whichever rank it comes from."""
    mesh = crowds()["one body"].meshes[0]
    scene, damaged = pgccd.Scene([mesh]), pgccd.Scene([mesh])
    damaged.mesh_index[0] = 1
    odd = comm.rank == 1
    position = torch.zeros((1, 3), dtype=torch.float64)
    messages = []
    right = {"scene": scene, "position": position, "lower": (0.0,) * 3, "upper": (8.0,) * 3, "comm": comm}
    for arguments in (
        {"options": WorldOptions(min_separation=0.1 if odd else 0)},
        {"payload": {"mood": position} if odd else {}},
        {"options": WorldOptions(cells=3 if odd else 4)},
        {"id": torch.tensor([7])},
        {"position": position[:, :2] if odd else position},
        {"scene": damaged if odd else scene},
        {"options": WorldOptions(broad_phase="grid" if odd else "sweep")},
        {"scene": pgccd.Scene([mesh], margin=0.1 if odd else None)},
    ):
        with pytest.raises(ValueError) as caught:
            SharedWorld.create(**(right | arguments))
        messages.append(str(caught.value))
    # Equal values of other types.
    corner = torch.full((3,), 8.0) if odd else (8,) * 3
    alike: Any = WorldOptions(cells=[4] * 3 if odd else (4, 4, 4))  # type: ignore[arg-type]
    SharedWorld.create(scene, position + comm.rank, (0,) * 3, corner, comm=comm, options=alike)
    with pytest.raises(ValueError, match="^meshes: rank 0 has .*, rank 1 has"):
        other = pgccd.Scene([pgccd.Mesh(mesh.vertices * 2.0, mesh.faces)])
        SharedWorld.create(**(right | {"scene": other if odd else scene}))
    return messages


def test_ranks_that_disagree_fail_together(ranks: World) -> None:
    messages = ranks.run(3, disagree)
    assert messages[0] == messages[2]
    beginnings = [
        "min_separation: rank 0 has 0, rank 1 has 0.1",
        "payload['mood']: rank 0 has nothing, rank 1 has ('float64', (3,))",
        "cells: rank 0 has 4, rank 1 has 3",
        "rank 1: id: 7 is given",
        "rank 1: position",
        "rank 1: mesh_index: body 0: expected a mesh",
        "broad_phase: rank 0 has 'sweep', rank 1 has 'grid'",
        "margin: rank 0 has nothing, rank 1 has ('float64', ())",
    ]
    for message, beginning in zip(messages[0], beginnings, strict=True):
        assert message.startswith(beginning), message
    assert messages[1][:3] == messages[0][:3] and messages[1][4].startswith("position: ")


def move_differently(comm: Comm) -> str:
    mesh, still = crowds()["one body"].meshes[0], torch.full((1, 3), 1.0 + 5.0 * comm.rank).double()
    upright = torch.tensor([[1.0, 0.0, 0.0, 0.0]]).double()
    world = SharedWorld.create(pgccd.Scene([mesh]), still, (0.0,) * 3, (8.0,) * 3, comm=comm)
    motion: Any = pgccd.RigidMotion(still, upright, still, upright)
    if comm.rank == 1:
        motion = pgccd.Trajectory(still.expand(3, 1, 3), upright.expand(3, 1, 4))
    with pytest.raises(ValueError) as caught:
        world.step(motion)
    return str(caught.value)


def test_motions_of_different_kinds_on_ranks(ranks: World) -> None:
    assert ranks.run(2, move_differently) == ["motion: rank 0 has 'RigidMotion', rank 1 has 'Trajectory'"] * 2


def set_partitions(comm: Comm) -> list[str]:
    mesh, position = crowds()["one body"].meshes[0], torch.zeros((0, 3)).double()
    options, said = WorldOptions(partition="cells"), []
    world = SharedWorld.create(pgccd.Scene([mesh], []), position, (0.0,) * 3, (8.0,) * 3, comm=comm, options=options)
    former = world.partition
    owners = torch.full_like(former.owner, comm.rank)
    other = Cells.uniform((0.0,) * 3, (8.0,) * 3, comm.size + 1)
    for partition in (former.with_owner(owners), other, former.owner):
        with pytest.raises((ValueError, TypeError)) as caught:
            world.partition = partition
        said.append(str(caught.value))
    assert world.partition is former
    return said


def test_a_partition_that_ranks_cannot_share(ranks: World) -> None:
    for rank, said in enumerate(ranks.run(2, set_partitions)):
        assert re.fullmatch(r"partition: rank 0 has .*, rank 1 has .*", said[0])
        assert said[1].endswith("partition: expected one for 2 ranks, got one for 3"), rank
        assert "partition: expected Cells or a Bisection" in said[2]


def options_of(**wrong: Any) -> WorldOptions:
    return WorldOptions(**wrong)


def written_to(**columns: Any) -> pgccd.Scene:
    """A scene with columns of values that were valid once."""
    scene = pgccd.Scene(crowds()["one body"].meshes[:1], [0, 0], world=[0, 0], margin=0.1)
    for name, value in columns.items():
        getattr(scene, name)[1] = value
    return scene


WRONG: dict[str, dict[str, Any]] = {
    "report: expected one of": {"options": options_of(report="bogus")},
    "broad_phase: expected one of": {"options": options_of(broad_phase="bogus")},
    "path: expected one of": {"options": options_of(path="bogus")},
    "min_separation: expected a finite length": {"options": options_of(min_separation=float("nan"))},
    "tolerance: expected a finite length": {"options": options_of(tolerance=-1.0)},
    "nonzero_toi: expected True or False": {"options": options_of(nonzero_toi="yes")},
    "overlap: expected True or False": {"options": options_of(overlap="x")},
    "balance: expected BalanceOptions": {"options": options_of(balance="cost")},
    "partition: expected one of": {"options": options_of(partition="bogus")},
    "options: expected WorldOptions, got dict": {"options": {"report": "all"}},
    "scene: expected a pgccd.Scene, got list": {"scene": crowds()["one body"].meshes},
    "mesh_index: body 1: expected a mesh": {"scene": written_to(mesh_index=1)},
    "margin: body 1: expected a finite length": {"scene": written_to(margin=-1.0)},
    "world: body 1: expected an id": {"scene": written_to(world=-1)},
    "position: expected shape (2, 3), got (3, 3)": {"position": torch.zeros((3, 3))},
    "position: row 1: expected finite numbers up to 1e+150, got [0.0, nan, 0.0]": {
        "position": torch.tensor([[0.0, 0.0, 0.0], [0.0, torch.nan, 0.0]]).double()
    },
    "position: row 0: expected finite numbers": {"position": torch.full((2, 3), 1e200, dtype=torch.float64)},
    "payload['s']: expected a dense tensor": {"payload": {"s": torch.eye(2).to_sparse()}},
    "payload['position']: this name is reserved": {"payload": {"position": torch.zeros(2)}},
    "vertex_payload['a']: payload has a tensor of this name": {
        "payload": {"a": torch.zeros(2)},
        "vertex_payload": {"a": torch.zeros(2 * len(crowds()["one body"].meshes[0].vertices))},
    },
    "upper: expected a box with volume above (0.0, 0.0, 0.0), 1e-150 long": {"upper": (1e-310, 1.0, 1.0)},
}


def refuse(comm: Comm) -> list[str]:
    scene = pgccd.Scene(crowds()["one body"].meshes[:1], [0, 0])
    position = torch.zeros((2, 3)).double()
    messages = []
    for wrong in WRONG.values():
        given = {"scene": scene, "position": position, "lower": (0.0,) * 3, "upper": (8.0,) * 3, "comm": comm}
        with pytest.raises((TypeError, ValueError)) as caught:
            SharedWorld.create(**(given | wrong))
        messages.append(str(caught.value))
    return messages


def test_wrong_arguments_are_named_at_once(ranks: World) -> None:
    for messages in ranks.run(2, refuse):
        for message, beginning in zip(messages, WRONG, strict=True):
            assert message.startswith(beginning), message
