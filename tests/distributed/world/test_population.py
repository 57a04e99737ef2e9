"""Bodies that join and leave a `World` between steps: as a world made anew with the bodies that are there."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import pytest
import torch
from support.checkpoint_faults import plant
from support.crowds import crowds
from support.graphs import graphs_on
from support.ranks import RankPool, to_all
from support.ranks import World as Ranks
from torch import Tensor

import pgccd
from distributed.world import test_motions
from distributed.world.test_loop import BOX, COUNT, meshes, motion, response, start
from distributed.world.test_payload import BOX as MESH
from distributed.world.test_payload import columns_of, moving
from pgccd.distributed import Alone, BalanceOptions, CapturedWorld, CheckpointError, Comm, World, WorldOptions
from pgccd.distributed.comm.exchange import take_rows
from pgccd.distributed.halo.vertices import Vertices, vertex_counts
from pgccd.distributed.world.input_checks import LARGEST_ID

CROWD = "kept apart, filtered"
EAGER = BalanceOptions("cost", start=0.0, goal=0.0, moving=0.0, deciding=0.0)
#: Optional columns of three groups of bodies: rows 0 to 24, 25 to 44, and 45 to 59 of the crowd.
ENDS, GIVEN = (25, 45, 60), ((), ("group", "mask", "world"), ("static", "margin"))


def table() -> dict[str, Tensor]:
    """Columns of all bodies, with the default where their group has none."""
    crowd, generator = crowds()[CROWD], torch.Generator().manual_seed(1)
    rows = torch.arange(60)
    columns = crowd.filters | {"static": rows % 4 == 1, "margin": 0.3 * torch.rand(60, generator=generator).double()}
    defaults = {"group": -1, "mask": -1, "world": 0, "static": False, "margin": 0.0}
    group = torch.bucketize(rows, torch.tensor(ENDS), right=True)
    for number, names in enumerate(GIVEN):
        columns |= {name: torch.where(group == number, columns[name], defaults[name]) for name in names}
    return columns | {"position": crowd.position, "mesh_index": crowd.mesh_index}


def bodies(rows: Tensor, optional: tuple[str, ...]) -> dict[str, Any]:
    """Arguments of `create` and `add`, without ids."""
    columns = table()
    filters: dict[str, Any] = {name: columns[name][rows] for name in optional}
    scene = pgccd.Scene(crowds()[CROWD].meshes, columns["mesh_index"][rows], **filters)
    payload = take_rows(columns_of(CROWD), rows)
    return {"scene": scene, "position": columns["position"][rows], "payload": payload}


OPTIONS = WorldOptions(min_separation=0.2, nonzero_toi=True, balance=EAGER)


def world_of(comm: Comm, **given: Any) -> World:
    return World.create(**given, lower=(0.0,) * 3, upper=(8.0,) * 3, comm=comm, options=OPTIONS)


def share(comm: Comm, first: int, end: int) -> Tensor:
    """The rows that a rank passes; the last one of several passes none."""
    rows = torch.arange(first, end)
    return rows[rows % max(1, comm.size - 1) == comm.rank].flip(0)


def everything(world: World, columns: list[Tensor]) -> list[list[float]]:
    """Rows of all ranks, the same on each; contacts of two ranks once."""
    wide = [column.double().reshape(len(column), column[:1].numel()) for column in columns]
    return sorted({tuple(row) for row in sum(to_all(world.comm, torch.cat(wide, 1).tolist()), [])})  # type: ignore[type-var,return-value]


def same(world: World, other: World, numbers: Tensor) -> int:
    """Whether two worlds have the same bodies but for ids, and give the same contacts and positions in a step.

    Args:
        numbers: (60,): of each row of the crowd, its id in `world`; its id in the other is the row.

    Returns:
        The number of contacts.
    """
    found = []
    for each in (world, other):
        assert bool((each.partition.owner_of(each.position) == each.comm.rank).all())
        assert each.id.tolist() == sorted(each.id.tolist())
        row = (each.id[:, None] == numbers).nonzero()[:, 1] if each is world else each.id
        assert torch.equal(7 * row, each.payload["tag"])
        names = sorted(each.columns.keys() - {"id"})
        before = everything(each, [each.columns[name] for name in names])
        motion = moving(each, 0.5)
        hits = each.step(motion, payload=("mass", "velocity", "half", "tag"))
        assert (hits.pairs[:, 0] < hits.pairs[:, 1]).all()
        values = [column for name, column in hits.columns.items() if name != "pairs"]
        contacts = everything(each, [*values, *hits.payload.values()])
        free = torch.isinf(each.first_toi(hits))[:, None]
        each.move(motion.position_t1, velocity=torch.where(free, 1.0, -1.0) * each.payload["velocity"])
        found.append(
            (names, before, contacts, each.id_checksum.count, everything(each, [each.payload["tag"], each.position]))
        )
    assert found[0] == found[1]
    return len(found[0][2])


def join_and_leave(comm: Comm) -> list[int]:
    """Bodies join and leave between steps; numbers of contacts."""

    def anew(rows: Tensor, names: tuple[str, ...]) -> World:
        mine = rows[rows % comm.size == comm.rank]
        return world_of(comm, **bodies(mine, names), id=mine)

    numbers = torch.arange(60)
    mine = share(comm, 0, 25)
    world = world_of(comm, **bodies(mine, ()), id=mine)
    contacts = [same(world, anew(numbers[:25], ()), numbers)]
    # From here on all are put back to where they start, since `same` moves them.
    for first, end, names in zip(ENDS, (*ENDS[1:], 60), (GIVEN[1], GIVEN[2], ()), strict=True):
        world.move(table()["position"][world.id], velocity=columns_of(CROWD)["velocity"][world.id])
        mine = share(comm, first, end)
        if first < 60:
            assert torch.equal(world.add(**bodies(mine, names), id=mine), mine)
        else:
            # All ranks pass some of the ids, and each those of its own bodies at one side.
            world.remove(torch.tensor([0, 59, 30]))
            world.remove(world.id[world.position[:, 0] < 2.0])
        assert world.next_id == end
        there = numbers[:end] if first < 60 else torch.tensor(sorted(sum(to_all(comm, world.id.tolist()), [])))
        present = () if first < 25 else GIVEN[1] if first < 45 else (*GIVEN[1], *GIVEN[2])
        contacts.append(same(world, anew(there, present), numbers))
    assert 20 < len(there) < 55 and not {0, 59, 30} & set(there.tolist())
    # All leave; then they come again, with new ids.
    world.remove(torch.cat([there, there.flip(0)]) if comm.rank == 0 else there[:0])
    assert world.id_checksum.count == 0 and len(world.step(moving(world))) == 0 and world.next_id == 60
    rows = torch.arange(60 if comm.rank == 0 else 0)
    id = world.add(**bodies(rows, (*GIVEN[1], *GIVEN[2])))
    assert torch.equal(id, 60 + rows) and world.next_id == 120
    contacts.append(same(world, anew(numbers, (*GIVEN[1], *GIVEN[2])), 60 + numbers))
    return contacts


def test_bodies_join_and_leave(world: Ranks) -> None:
    seen = world(join_and_leave)
    assert min(seen[0]) > 1 and sum(seen[0]) > 30 and all(of_rank == seen[0] for of_rank in seen)


def deform(comm: Comm) -> int:
    """The same with deforming bodies, whose vertices come and go with them."""
    whole = test_motions.bodies()
    count = len(test_motions.IDS)
    of_all = Vertices({"x": test_motions.frames()[0]}, vertex_counts(test_motions.meshes(), whole["mesh_index"]))

    def given(rows: Tensor) -> dict[str, Any]:
        columns: dict[str, Any] = {"scene": test_motions.scene()[rows], "position": whole["position"][rows]}
        columns |= {"id": test_motions.IDS[rows], "payload": {"tag": 3 * rows}}
        return columns | {"vertex_payload": of_all.take(rows).columns}

    first, options = given(share(comm, 0, 15)), WorldOptions(min_separation=0.01, report="all")
    world = World.create(**first, lower=(0.0,) * 3, upper=(8.0,) * 3, comm=comm, options=options)
    world.remove(test_motions.IDS[[3, 8]])
    world.add(**given(share(comm, 15, count)))
    rows = test_motions.rows_of(world)
    kept = [row for row in range(count) if row not in (3, 8)]
    assert sorted(sum(to_all(comm, rows.tolist()), [])) == kept
    before, after = (test_motions.vertices_of(rows, step) for step in (0, 1))
    assert torch.equal(world.vertex_payload["x"], before)
    hits = world.step(pgccd.VertexMotion(before, after), payload=("tag",))
    every = test_motions.alone("all", 0)
    test_motions.require_equal(world, hits, every[torch.isin(every.pairs, torch.tensor(kept)).all(dim=1)], "all")
    return len(hits)


def test_deforming_bodies_join_and_leave(world: Ranks) -> None:
    assert world(deform)[0] > 0


def save_between(comm: Comm, folder: str) -> None:
    mine = share(comm, 0, 25)
    world = world_of(comm, **bodies(mine, ()), id=mine)
    mine = share(comm, 25, 45)
    world.add(**bodies(mine, GIVEN[1]), id=mine)
    world.remove(torch.tensor([44, 3]))
    world.save(folder)


def load_between(comm: Comm, folder: str) -> int:
    world = World.load(folder, crowds()[CROWD].meshes, comm=comm, options=OPTIONS)
    assert world.next_id == 45  # that of a body that was removed is not used again
    with pytest.raises(
        ValueError, match=r"id: expected new ids, from 45 on \(smaller ones may have been used\), got 44"
    ):
        world.add(**bodies(torch.tensor([44]), GIVEN[1]), id=torch.tensor([44]))
    mine = share(comm, 45, 60)
    world.add(**bodies(mine, GIVEN[2]), id=mine)
    rows = torch.tensor([row for row in range(60) if row not in (3, 44)])
    mine = rows[rows % comm.size == comm.rank]
    return same(world, world_of(comm, **bodies(mine, (*GIVEN[1], *GIVEN[2])), id=mine), torch.arange(60))


def test_checkpoints_know_which_ids_were_used(ranks: RankPool, tmp_path: Path) -> None:
    ranks.run(3, save_between, str(tmp_path))
    for size in (1, 2, 3):
        assert ranks.run(size, load_between, str(tmp_path))[0] > 3
    for wrong, problem in (
        (43, "there is an id 43, but the next one is 43"),
        (None, "next_id: expected numbers >= 0"),
        (-1, "next_id: expected numbers >= 0"),
    ):
        plant(tmp_path, lambda index, wrong=wrong: index["header"].update(next_id=wrong))
        with pytest.raises(CheckpointError, match=f"is not the checkpoint of a world: {problem}"):
            World.load(tmp_path, crowds()[CROWD].meshes)


def excluding(comm: Comm, folder: str) -> tuple[list[list[int]], list[int]]:
    """Pairs that are never tested, given by several ranks, before and after bodies join and leave: what the world
    excludes, and how many contacts remain, compared with one process, also of trajectories and after a checkpoint.
    """
    crowd, rows = crowds()[CROWD], torch.arange(60)
    generator = torch.Generator().manual_seed(3)
    pairs = torch.combinations(rows)[torch.randperm(1770, generator=generator)[:900]].flip(1)
    mine = rows[rows % comm.size == comm.rank]
    at_first, later = (
        each[comm.rank :: comm.size] for each in (pairs[(pairs < 40).all(1)], pairs[(pairs >= 40).any(1)])
    )
    q = torch.tensor([[1.0, 0, 0, 0]], dtype=torch.float64).repeat(60, 1)
    v = torch.randn((60, 3), generator=generator, dtype=torch.float64)
    scene = pgccd.Scene(crowd.meshes, crowd.mesh_index)
    first, new = mine[mine < 40], mine[mine >= 40]
    world = World.create(
        scene[first],
        crowd.position[first],
        (0.0,) * 3,
        (8.0,) * 3,
        id=first,
        exclude=at_first if len(at_first) and comm.rank != 1 else None,
        comm=comm,
    )
    if comm.size > 1:  # what rank 1 did not give
        none = pgccd.Scene(world.meshes, [])
        world.add(none, crowd.position[:0], exclude=at_first if comm.rank == 1 else None)
    world.add(scene[new], crowd.position[new], id=new, exclude=later)
    world.remove(torch.tensor([5, 41]))
    here = rows[(rows != 5) & (rows != 41)]
    kept = torch.searchsorted(here, pairs[torch.isin(pairs, here).all(1)])
    of_all = pgccd.Scene(crowd.meshes, crowd.mesh_index[here], exclude=kept)
    x, counts = crowd.position, []
    for again in (False, True):
        if again:
            world.save(folder)
            world = World.load(folder, crowd.meshes, comm=comm)
        assert world.exclude is not None and world.exclude.equal(here[of_all.exclude])
        own = world.id
        rigid, motion = (pgccd.RigidMotion(x[k], q[k], x[k] + v[k], q[k]) for k in (here, own))
        ways, trajectories = (torch.stack([x[k], x[k] + v[k], x[k] - v[k]]) for k in (here, own))
        turns, own_turns = (q[k].expand(3, -1, -1) for k in (here, own))
        resolved = pgccd.resolve(of_all, rigid)
        for expected, found in (
            (pgccd.detect(of_all, rigid), world.step(motion)),
            (
                pgccd.detect(of_all, pgccd.Trajectory(ways, turns)),
                world.step(pgccd.Trajectory(trajectories, own_turns)),
            ),
        ):
            of_ids = here[expected.pairs]
            concerns = torch.isin(of_ids, own).any(dim=1)
            assert found.pairs.equal(of_ids[concerns]) and found.toi.equal(expected.toi[concerns])
            counts.append(len(expected))
        stopped = world.step(motion, resolve=True)
        assert stopped.fraction.equal(resolved.fraction[torch.searchsorted(here, own)])
    return world.exclude.tolist(), counts


def test_pairs_are_excluded_on_any_number_of_ranks(ranks: RankPool, tmp_path: Path) -> None:
    expected = ranks.run(1, excluding, str(tmp_path / "1"))[0]
    assert min(expected[1]) > 5 and len(expected[0]) > 700
    for size in (2, 3):
        assert ranks.run(size, excluding, str(tmp_path / str(size))) == [expected] * size


def exclude_in_shares(comm: Comm) -> list[list[int]]:
    """Pairs excluded in the scenes of the shares, whose ids are no row numbers; and one of two shares."""
    scene = pgccd.Scene([MESH], [0, 0, 0], exclude=[[0, 2]])
    position = 3.0 * torch.eye(3) + 0.1 * comm.rank
    id, both = torch.tensor([7, 2, 4]) + 10 * comm.rank, [[12, 2]] if comm.size > 1 else None
    world = World.create(scene, position, (0.0,) * 3, (9.0,) * 3, id=id, exclude=both, comm=comm)
    first = world.add(scene, position + 1.0)[0]
    assert world.exclude is not None and [int(first), int(first) + 2] in world.exclude.tolist()
    return world.exclude.tolist()


def test_pairs_are_excluded_by_scenes_of_shares(ranks: RankPool) -> None:
    assert ranks.run(1, exclude_in_shares) == [[[4, 7], [8, 10]]]
    assert ranks.run(2, exclude_in_shares) == [[[2, 12], [4, 7], [14, 17], [18, 20], [21, 23]]] * 2


def run_captured(comm: Comm, graph: bool) -> tuple[list[list[float]], list[tuple[int, int]], int]:
    """Bodies join and leave between runs of a loop; its last state, counts of its steps, and number of replays."""
    columns = start()

    def given(first: int, end: int, also: tuple[str, ...] = ()) -> dict[str, Any]:
        rows = torch.arange(first, end)[comm.rank :: comm.size]
        optional: dict[str, Any] = {name: columns[name][rows] for name in also}
        scene = pgccd.Scene(meshes(), columns["mesh_index"][rows], **optional)
        payload = {name: columns[name][rows] for name in ("q", "v", "w", "free")}
        return {"scene": scene, "position": columns["position"][rows], "id": rows, "payload": payload}

    with graphs_on("cpu" if graph else "none"):
        options = WorldOptions(balance=BalanceOptions("none"), nonzero_toi=True)
        world = World.create(**given(0, 0), lower=(0.0,) * 3, upper=(BOX,) * 3, comm=comm, options=options)
        loop = CapturedWorld(world, motion, response, graph)
        steps = loop.run(6)  # a world without bodies
        world.add(**given(0, 30))
        steps += loop.run(9)
        world.add(**given(30, 80, ("margin",)))  # more columns, and more rows than spare ones
        steps += loop.run(9)
        world.add(**given(0, 0, ("margin",)), exclude=torch.combinations(torch.arange(80))[comm.rank :: comm.size])
        steps += loop.run(9)  # without contacts
        world.remove(torch.arange(10, 70))
        steps += loop.run(9)
        world.remove(world.id)
        steps += loop.run(6)
        world.add(**given(80, COUNT, ("static",)))
        steps += loop.run(9)
    rows = everything(world, [world.id, world.position, *world.payload.values()])
    return rows, [(step.pcs, step.contacts) for step in steps], sum(step.replayed for step in steps)


def test_captured_loops_go_on(ranks: RankPool) -> None:
    expected, counts, _ = ranks.run(1, run_captured, False)[0]
    assert len(expected) == 40 and sum(contacts for _, contacts in counts) > 50
    assert sum(contacts for _, contacts in counts[15:24]) > 9 and counts[24:33] == [(0, 0)] * 9
    for size in (1, 3):
        found, of_steps, replayed = ranks.run(size, run_captured, True)[0]
        assert found == expected and of_steps == counts and replayed > 12


def mistakes(comm: Comm) -> dict[str, str]:
    """The errors of this rank by what was wrong; those of wrong values are raised by the last rank's."""
    mine, last, said = share(comm, 0, 25), comm.rank == comm.size - 1, {}
    world = world_of(comm, **bodies(mine, ()), id=mine)
    former = everything(world, list(world.columns.values()))
    some = bodies(torch.tensor([30 + comm.rank]), ())
    right = some | {"id": torch.tensor([30 + comm.rank])}
    payload, damaged = right["payload"], pgccd.Scene(world.meshes, [0])
    damaged.mesh_index[0] = 9
    fewer = {name: payload[name] for name in payload if name != "mass"}
    wrong: dict[str, dict[str, Any]] = {
        "used": {"id": torch.tensor([7])},
        "id dtype": {"id": torch.tensor([7.0])},
        "position": {"position": some["position"][:, :2]},
        "dtype of position": {"position": some["position"].int()},
        "mesh": {"scene": damaged},
        "meshes": {"scene": pgccd.Scene([MESH])},
        "count": {"scene": pgccd.Scene(world.meshes, [0, 0])},
        "no scene": {"scene": None},
        "missing": {"payload": fewer},
        "unknown": {"payload": payload | {"weight": payload["mass"]}},
        "dtype": {"payload": payload | {"mass": payload["mass"].float()}},
        "shape": {"payload": payload | {"mass": payload["mass"][:, None]}},
        "rows": {"payload": payload | {"mass": payload["mass"][:0]}},
        "vertices": {"vertex_payload": {"x": torch.zeros(len(crowds()[CROWD].meshes[0].vertices), 3)}},
        "excluded": {"exclude": [[0, 99]]},
        "excluded twice": {"exclude": [[3, 3]]},
        "dtype of excluded": {"exclude": torch.zeros(1, 2)},
    }
    tries = {name: right | change if last else right for name, change in wrong.items()}
    tries["twice"] = right | {"id": torch.tensor([40])}
    tries["none"] = some | ({"id": torch.tensor([40])} if last else {})
    tries["static"] = right | ({"scene": pgccd.Scene(world.meshes, [0], static=[True])} if last else {})
    tries["all"] = bodies(torch.arange(30, 40), ())
    for name, given in tries.items():
        if comm.size > 1 or name not in ("twice", "none", "static", "all"):
            with pytest.raises((ValueError, TypeError)) as caught:
                world.add(**given)
            said[name] = str(caught.value)
    ids: Any
    for name, ids in (("unknown id", [3, 25]), ("ids", [[3]]), ("dtype of ids", [3.0]), ("list", 3)):
        tensor = ids if name == "list" else torch.tensor(ids)
        with pytest.raises((ValueError, TypeError)) as caught:
            world.remove(tensor if last else torch.tensor([4]))
        said[name] = str(caught.value)
    with pytest.raises(ValueError) as caught:  # noqa: PT011, PT012
        world.next_id = LARGEST_ID + 1
        world.add(**(some if last else bodies(mine[:0], ())))
    said["no more"] = str(caught.value)
    world.next_id = 25
    assert everything(world, list(world.columns.values())) == former
    return said


@pytest.mark.parametrize("size", [1, 3])
def test_mistakes_are_named_on_all_ranks(ranks: RankPool, size: int) -> None:
    names = "['half', 'mass', 'none', 'odd', 'orientation', 'rotation', 'tag', 'velocity']"
    expected = {
        "used": "id: expected new ids, from 25 on (smaller ones may have been used), got 7",
        "id dtype": "id: expected (1,) int64, got torch.Size([1]) torch.float32",
        "position": "position: expected shape (N, 3), got a float64 tensor of shape (1, 2)",
        "meshes": "scene: expected one with the meshes of this world, `World.meshes`",
        "count": "position: expected shape (2, 3), got (1, 3)",
        "no scene": "scene: expected a pgccd.Scene, got None",
        "dtype of position": "position: expected float32 or float64, got torch.int32",
        "mesh": "mesh_index: body 0: expected a mesh from 0 to ",
        "missing": f"payload: expected tensors named {names}, as this world has, got ['half', 'none', ",
        "unknown": f"payload: expected tensors named {names}, as this world has, got ['half', 'mass', ",
        "dtype": "payload['mass']: expected (M) float64, got (M) float32",
        "shape": "payload['mass']: expected (M) float64, got (M, 1) float64",
        "rows": "payload['mass']: expected a tensor (1, ...) on cpu, got a float64 tensor of shape (0,)",
        "vertices": "vertex_payload",
        "excluded": "exclude: expected ids of bodies of this world, got 99",
        "excluded twice": "exclude: pair 0: expected two different ids >= 0, got [3, 3]",
        "dtype of excluded": "exclude: expected integers, pairs of different bodies, shape (E, 2), got torch.float32",
        "twice": "id: 40 is given to more than one body",
        "none": "id: rank 0 has 'not given', rank 2 has 'given'",
        "static": "optional columns: rank 0 has [], rank 2 has ['static']",
        "all": "position: expected each body on one rank, but ranks 0 and 1 passed the same ones (10), without `id`: ",
        "unknown id": "ids: expected ids of bodies of this world, got 25",
        "ids": "ids: expected shape (M,), got (1, 1)",
        "dtype of ids": "ids: expected an int64 tensor, got a float32 tensor of shape (1,)",
        "list": "ids: expected an int64 tensor, got 3",
        "no more": f"id: 1 bodies, but no ids are left above {LARGEST_ID}",
    }
    for said in ranks.run(size, mistakes):
        for name, message in said.items():
            assert re.sub(r"^rank \d+: ", "", message).startswith(expected[name]), name


def double(comm: Comm, vertices: bool) -> str:
    """All ranks pass all bodies, without ids."""
    scene, x = pgccd.Scene([MESH], [0, 0]), {"x": MESH.vertices.repeat(2, 1)}
    given: dict[str, Any] = {"position": 3.0 * torch.eye(3)[:2], "lower": (0.0,) * 3, "upper": (9.0,) * 3, "comm": comm}
    with pytest.raises(ValueError) as caught:
        World.create(scene, **given, vertex_payload=x if vertices else None)
    # Different bodies in one place: of another world, or of other vertices.
    apart = pgccd.Scene([MESH], [0, 0], world=[comm.rank, comm.rank])
    for world in (World.create(apart, **given), World.create(scene, **given, vertex_payload={"x": x["x"] + comm.rank})):
        assert world.id_checksum.count == 2 * comm.size
    return str(caught.value)


@pytest.mark.parametrize("vertices", [False, True])
def test_all_bodies_on_every_rank_are_refused(ranks: RankPool, vertices: bool) -> None:
    for said in ranks.run(3, double, vertices):
        assert said.startswith("position: expected each body on one rank, but ranks 0 and 1 passed the same ones (2)")


def test_one_rank_may_pass_the_same_twice() -> None:
    scene = pgccd.Scene([MESH], [0, 0])
    world = World.create(scene, torch.zeros(2, 3), (0.0,) * 3, (9.0,) * 3)
    assert world.add(scene, torch.zeros(2, 3)).tolist() == [2, 3]
    assert world.add(scene[:0], torch.zeros(0, 3)).tolist() == []
    assert Alone().size == 1 and world.id_checksum.count == 4
