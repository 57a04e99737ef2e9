"""Contacts of a `World` carry the payload of both bodies, and loops of impulses have the same bits on any ranks."""

from __future__ import annotations

import functools
from typing import Any
from unittest import mock

import pytest
import torch
from support.crowds import crowds
from support.ranks import RankPool
from support.ranks import World as Ranks
from support.reports import of_contacts, stepped
from torch import Tensor

import pgccd
from distributed.world import test_motions
from pgccd.distributed import Alone, Comm, World, WorldOptions
from pgccd.distributed.comm.exchange import take_rows

REPORTS = ("first", "all", "any", "earliest")
# "third": the rank that tests a pair owns neither body.
CROWDS = ("met in a third rank's cell", "kept apart, filtered", "a terrain under all")
ASKED = ("velocity", "mass", "half", "odd", "tag", "none", "position")


@functools.cache
def columns_of(name: str) -> dict[str, Tensor]:
    """Payload of several types, by row of a crowd."""
    crowd = crowds()[name]
    count = len(crowd.position)
    rows = torch.arange(count)
    columns = {"orientation": crowd.orientation, "velocity": crowd.velocity, "rotation": crowd.rotation}
    columns |= {"mass": 1.0 + (rows % 5).double() / 3.0, "tag": 7 * rows, "half": rows.to(torch.bfloat16)}
    return columns | {"odd": (rows % 2 == 1)[:, None], "none": torch.zeros((count, 0))}


def spread(comm: Comm, name: str, report: str = "first") -> World:
    crowd = crowds()[name]
    mine = torch.arange(comm.rank, len(crowd.position), comm.size).flip(0)
    options = WorldOptions(report=of_contacts(report), min_separation=crowd.min_separation, nonzero_toi=True)
    return World.create(
        crowd.scene(mine),
        crowd.position[mine],
        (0.0,) * 3,
        (8.0,) * 3,
        id=10 * mine + 3,
        payload=take_rows(columns_of(name), mine),
        comm=comm,
        options=options,
    )


def moving(world: World, dt: float = 1.0) -> pgccd.RigidMotion:
    at = world.payload
    return pgccd.RigidMotion.from_velocity(world.position, at["orientation"], at["velocity"], at["rotation"], dt)


def ask(comm: Comm, name: str) -> tuple[int, int]:
    """Compares the payload of contacts with that of the bodies, for all reports; numbers of contacts, and of those
    whose bodies are on two ranks.
    """
    crowd, between = crowds()[name], 0
    expected = columns_of(name) | {"position": crowd.position}
    for report in REPORTS:
        world = spread(comm, name, report)
        for ahead in (False, True):  # as on GPUs, with capacities of the step before
            with mock.patch(
                "pgccd.distributed.steps.rank.sends_ahead", lambda comm, *_, on=ahead: on and comm.size > 1
            ):
                hits = stepped(world, moving(world), report, payload=ASKED)
            plain = stepped(world, moving(world), report)
            assert plain.payload == {}
            assert all(torch.equal(column, plain.columns[key]) for key, column in hits.columns.items())
            assert set(hits.payload) == set(ASKED)
            rows = torch.div(hits.pairs - 3, 10, rounding_mode="floor")
            for key, column in hits.payload.items():
                of_pairs = take_rows({key: expected[key]}, rows.reshape(-1))[key]
                assert column.dtype == expected[key].dtype and column.shape == (*rows.shape, *expected[key].shape[1:])
                assert torch.equal(column.flatten(), of_pairs.flatten()), key
        between += int((world.rows_of(hits.pairs) < 0).sum())
    return len(hits), between


@pytest.mark.parametrize("name", CROWDS)
def test_contacts_have_the_payload_of_both_bodies(world: Ranks, name: str) -> None:
    seen = world(ask, name)
    assert max(contacts for contacts, _ in seen) > 0
    assert len(seen) == 1 or sum(between for _, between in seen) > 0


def ask_deforming(comm: Comm, report: str) -> int:
    """The same, of deforming bodies, and of trajectories of these and of rigid ones."""
    world = test_motions.spread(comm, report, torch.device("cpu"))
    rows = test_motions.rows_of(world)
    frames = [test_motions.vertices_of(rows, step) for step in range(test_motions.STEPS + 1)]
    waves, frames_of_all = pgccd.VertexMotion(frames[0], frames[1]), pgccd.Trajectory(torch.stack(frames))
    found = 0
    for motion in (waves, frames_of_all, test_motions.turning(rows)):
        hits = stepped(world, motion, report, payload=["tag"])
        assert torch.equal(hits.payload["tag"], 3 * torch.searchsorted(test_motions.IDS, hits.pairs))
        found += len(hits)
    return found


@pytest.mark.parametrize("report", ["first", "any", "earliest"])
def test_payload_of_deforming_bodies_and_trajectories(ranks: RankPool, report: str) -> None:
    for size in (1, 3):
        assert sum(ranks.run(size, ask_deforming, report)) > 0


BOX = pgccd.Mesh.box([1.0, 0.6, 0.3])
COUNT, STEPS = 60, 8


def dot(a: Tensor, b: Tensor) -> Tensor:
    return a[:, 0] * b[:, 0] + a[:, 1] * b[:, 1] + a[:, 2] * b[:, 2]


def impulses(hits: pgccd.Contacts) -> Tensor:
    """(K, 2, 3): changes of velocity of both bodies, which keep momentum and energy."""
    (v_i, v_j), (m_i, m_j) = (hits.payload[name].unbind(1) for name in ("velocity", "mass"))
    closing = dot(v_i - v_j, hits.normal).clamp(min=0.0)
    along = (2.0 * m_i * m_j / (m_i + m_j) * closing)[:, None] * hits.normal
    return torch.stack([-along / m_i[:, None], along / m_j[:, None]], dim=1)


def start_of_loop() -> dict[str, Tensor]:
    generator = torch.Generator().manual_seed(6)
    state = torch.randn((COUNT, 10), generator=generator, dtype=torch.float64)
    grid = 1.3 * torch.cartesian_prod(torch.arange(5.0), torch.arange(4.0), torch.arange(3.0)).double()
    orientation = torch.nn.functional.normalize(state[:, :4])
    columns = {"position": grid, "orientation": orientation, "velocity": state[:, 4:7], "rotation": state[:, 7:]}
    return columns | {"mass": 0.5 + torch.rand(COUNT, generator=generator, dtype=torch.float64)}


def bounce(comm: Comm) -> dict[int, list[float]]:
    """A loop of impulses; the last position and velocity of this rank's bodies, by id."""
    mine = torch.arange(comm.rank, COUNT, comm.size)
    columns = take_rows(start_of_loop(), mine)
    position = columns.pop("position")
    scene, options = pgccd.Scene([BOX], [0] * len(mine)), WorldOptions(nonzero_toi=True)
    box = (0.0,) * 3, (6.5, 5.2, 3.9)
    world = World.create(scene, position, *box, id=mine, payload=columns, comm=comm, options=options)
    for _ in range(STEPS):
        motion = moving(world, 0.2)
        hits = world.step(motion, payload=("velocity", "mass"))
        velocity = world.payload["velocity"] + world.sum_per_body(hits, impulses(hits))
        position, orientation = motion.at(1.0)  # through each other: only the bits matter here
        world.move(position, orientation=orientation, velocity=velocity)
    rows = torch.cat([world.position, world.payload["velocity"]], dim=1)
    return dict(zip(world.id.tolist(), rows.tolist(), strict=True))


def test_a_loop_of_impulses(world: Ranks) -> None:
    """Equal to a loop in one process by `detect`, with sums over rows of the whole scene."""
    now = start_of_loop()
    momentum = (now["mass"][:, None] * now["velocity"]).sum(0)
    scene, contacts = pgccd.Scene([BOX], [0] * COUNT), 0
    for _ in range(STEPS):
        poses = now["position"], now["orientation"], now["velocity"], now["rotation"]
        motion = pgccd.RigidMotion.from_velocity(*poses, dt=0.2)
        hits = pgccd.detect(scene, motion, nonzero_toi=True)
        hits.payload = {name: now[name][hits.pairs] for name in ("velocity", "mass")}
        change = torch.zeros(COUNT, 3, dtype=torch.float64)
        for pair, both in zip(hits.pairs.tolist(), impulses(hits), strict=True):
            for body, of_body in zip(pair, both, strict=True):
                change[body] += of_body
        now["velocity"] = now["velocity"] + change
        now["position"], now["orientation"] = motion.at(1.0)
        contacts += len(hits)
    assert contacts > 60
    assert torch.allclose((now["mass"][:, None] * now["velocity"]).sum(0), momentum)
    expected = torch.cat([now["position"], now["velocity"]], dim=1)
    found = {id: row for of_rank in world(bounce) for id, row in of_rank.items()}
    assert [found[id] for id in range(COUNT)] == expected.tolist()


def test_sums_are_made_in_the_order_of_contacts() -> None:
    scene, position, id = pgccd.Scene([BOX], [0] * 4), torch.zeros(4, 3).double(), torch.tensor([2, 3, 5, 7])
    world = World.create(scene, position, (0.0,) * 3, (9.0,) * 3, id=id)
    hits = world.step(pgccd.RigidMotion.at_rest(world.position, torch.eye(4).double()[:1].repeat(4, 1)))
    assert hits.pairs.tolist() == [[2, 3], [2, 5], [2, 7], [3, 5], [3, 7], [5, 7]]
    values = torch.zeros(6, 2, dtype=torch.float64)
    values[:3, 0] = torch.tensor([1e16, 1.0, -1e16])  # in any other order the sum is not 0
    values[3:, 1] = 1.0
    assert world.sum_per_body(hits, values).tolist() == [0.0, 0.0, 1.0, 2.0]
    assert world.sum_per_body(hits[:0], values[:0, :, None, None]).shape == (4, 1, 1)
    wrong: Any
    for wrong, error, problem in (
        (values[:5], ValueError, r"values: expected \(6, 2, ...\) on cpu, got \(5, 2\) on cpu"),
        (values.long(), TypeError, "values: expected a tensor of floating-point numbers, got a int64 tensor"),
        ([1.0], TypeError, "values: expected a tensor of floating-point numbers, got list"),
        (values.to(torch.float8_e5m2), TypeError, "values: expected a tensor of floating-point numbers, got a float8"),
        (values.to_sparse(), TypeError, "values: expected a tensor of floating-point numbers, got "),
    ):
        with pytest.raises(error, match=f"^{problem}"):
            world.sum_per_body(hits, wrong)
    with pytest.raises(TypeError, match="^hits: expected pgccd.Contacts, got a float64 tensor"):
        world.sum_per_body(values, values)  # type: ignore[arg-type]


def test_rows_of_ids() -> None:
    scene, position, id = pgccd.Scene([BOX], [0] * 3), 3.0 * torch.eye(3), torch.tensor([7, 2, 4])
    world = World.create(scene, position, (0.0,) * 3, (9.0,) * 3, id=id)
    assert world.rows_of(torch.tensor([[2, 4], [7, 3], [8, -1]])).tolist() == [[0, 1], [2, -1], [-1, -1]]
    assert world.rows_of(torch.tensor(4)).tolist() == 1
    world.remove(world.id)
    assert world.rows_of(torch.tensor([2])).tolist() == [-1]
    wrong: Any
    for wrong in ([2], torch.tensor([2.0]), torch.tensor([2], dtype=torch.int32)):
        with pytest.raises(TypeError, match="^ids: expected an int64 tensor, got "):
            world.rows_of(wrong)


def test_payload_follows_its_contacts() -> None:
    """Selected, copied and compared with them."""
    world = spread(Alone(), CROWDS[1])
    hits, plain = (world.step(moving(world), payload=names) for names in (ASKED, ()))
    assert len(hits) > 3 and hits == hits.clone() == hits.to("cpu") and hits != plain and plain != hits
    assert torch.equal(hits[[2, 1]].payload["mass"], hits.payload["mass"][[2, 1]])
    row = int(hits.toi.argmin())
    assert torch.equal(hits.earliest().payload["velocity"], hits.payload["velocity"][row : row + 1])
    other = hits.clone()
    other.payload["half"][0, 1] += 1
    assert other != hits


def mistakes(comm: Comm) -> list[str]:
    world, last, said = spread(comm, CROWDS[1]), comm.rank == comm.size - 1, []
    motion = moving(world)
    asked: Any
    for asked in ("mass", 3, ("mass", "weight"), ["mass"] if last else ["tag"], ["weight"] if last else []):
        with pytest.raises((TypeError, ValueError)) as caught:
            world.step(motion, payload=asked)
        said.append(str(caught.value))
    # Names may change from step to step, and stand in any order.
    for asked in (("mass",), ("tag", "mass") if last else ("mass", "tag"), ()):
        assert sorted(world.step(motion, payload=asked).payload) == sorted(asked)
    with pytest.raises(ValueError) as caught:  # noqa: PT011
        world.step(motion, payload=("mass",) if last else ())
    return [*said, str(caught.value)]


def test_mistakes_are_named_on_all_ranks(ranks: RankPool) -> None:
    names = "expected some of ['half', 'mass', 'none', 'odd', 'orientation', 'position', 'rotation', 'tag', 'velocity']"
    for of_rank in ranks.run(3, mistakes):
        assert of_rank[0] == """payload: expected names, such as ("velocity", "mass"), got 'mass'"""
        assert of_rank[1] == """payload: expected names, such as ("velocity", "mass"), got 3"""
        assert of_rank[2] == f"payload: {names}, got 'weight'"
        assert of_rank[3] == "payload: rank 0 has ['.tag'], rank 2 has ['.mass']"
        assert of_rank[4].endswith(f"payload: {names}, got 'weight'")
        assert of_rank[5] == "payload: rank 0 has [], rank 2 has ['.mass']"
