"""The public API as users write it. This module runs, passes mypy (`make lint`) and pyright, and uses nothing else."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
from pathlib import Path
from typing import assert_type

import pytest
import torch

import pgccd
from pgccd import distributed

Corners = list[list[int]]
CORNERS: Corners = [[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]]
FACES: Corners = [[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]]


def two_bodies() -> tuple[pgccd.Scene, pgccd.RigidMotion]:
    mesh = pgccd.Mesh(CORNERS, FACES)
    scene = pgccd.Scene([mesh], mesh_index=[0, 0])
    start = torch.tensor([[0.0, 0.0, 0.0], [3.0, 0.0, 0.0]])
    end = torch.tensor([[0.0, 0.0, 0.0], [0.2, 0.0, 0.0]])
    upright = torch.tensor([[1.0, 0.0, 0.0, 0.0]]).repeat(2, 1)
    return scene, pgccd.RigidMotion(start, upright, end, upright)


def waypoints() -> pgccd.Trajectory:
    _, motion = two_bodies()
    position = torch.stack([motion.position_t0, motion.position_t1, motion.position_t0])
    return pgccd.Trajectory(position, motion.orientation_t0.repeat(3, 1, 1))


def test_contacts() -> None:
    scene, motion = two_bodies()
    hits = pgccd.detect(scene, motion)
    assert_type(hits, pgccd.Contacts)
    early = hits[hits.toi < 0.5]
    assert_type(early, pgccd.Contacts)
    assert len(hits) == 1 and len(early) == 0 and float(hits.toi.min()) > 0.7
    for (i, j), toi, kind, point in zip(
        hits.pairs.tolist(), hits.toi.tolist(), hits.kind.tolist(), hits.point, strict=True
    ):
        assert (i, j) == (0, 1) and toi < 1.0 and point.shape == (3,)
        assert kind in pgccd.Kind.names() and pgccd.Kind.names()[kind] == "VF_AB"
    edges = hits[hits.kind == pgccd.Kind.EE]
    unresolved = hits[hits.status == pgccd.Status.UNRESOLVED]
    assert len(edges) == len(unresolved) == 0
    moved = torch.where(hits.may_collide("body")[:, None], motion.position_t0, motion.position_t1)
    assert bool((moved == motion.position_t0).all()) and hits.normal.shape == hits.point.shape
    assert hits.body_count == 2 and hits.world is None and hits.stats.seconds["narrow"] >= 0.0


@pytest.mark.parametrize("name", ["first", "all", "earliest"])
def test_arguments_in_variables(name: pgccd.Report) -> None:
    scene, motion = two_bodies()
    found = pgccd.detect(scene, motion, name)
    assert_type(found, pgccd.Contacts)
    assert bool(found.may_collide()) and found.pairs.tolist()[0] == [0, 1] and float(found.first_toi()) > 0.0
    path: pgccd.RigidMotion | pgccd.Trajectory = waypoints() if name == "all" else motion
    assert isinstance(pgccd.detect(scene, path, name), pgccd.TrajectoryContacts) == (name == "all")
    assert_type(pgccd.collide(scene, path), pgccd.CollidingPairs)
    room = pgccd.Capacity.of(2) if name == "all" else None
    in_room = pgccd.detect(scene, motion, name, capacity=room)
    contacts = in_room.trim() if isinstance(in_room, pgccd.PaddedContacts) else in_room
    assert_type(contacts, pgccd.Contacts)
    assert contacts == found


def test_colliding_pairs() -> None:
    scene, motion = two_bodies()
    colliding = pgccd.collide(scene, motion)
    assert_type(colliding, pgccd.CollidingPairs)
    assert colliding.pairs.tolist() == [[0, 1]] and len(colliding[:0]) == 0 and colliding == colliding.clone()
    assert colliding.may_collide("body").tolist() == [True, True] and colliding.stats.contacts == 1
    assert repr(colliding) == "CollidingPairs(count=1, pcs=1, device=cpu)"
    with pytest.raises(AttributeError, match="'CollidingPairs' object has no attribute 'first_toi'"):
        colliding.first_toi()  # type: ignore[attr-defined]
    with pytest.raises(ValueError, match='^report: "any" finds no contacts: call pgccd.collide to find the pairs'):
        pgccd.detect(scene, motion, "any")  # type: ignore[call-overload]
    with pytest.raises(TypeError, match="nonzero_toi"):
        pgccd.collide(scene, motion, nonzero_toi=True)  # type: ignore[call-overload]
    with pytest.raises(TypeError, match=r"^CollidingPairs: not iterable: .* such as hits.pairs.tolist\(\)"):
        list(colliding)


def test_capacities() -> None:
    scene, motion = two_bodies()
    needed = pgccd.detect(scene, motion).stats.needed
    assert needed is not None
    padded = pgccd.detect(scene, motion, capacity=needed.times(1.5))
    assert_type(padded, pgccd.PaddedContacts)
    assert_type(padded.trim(), pgccd.Contacts)
    assert float(padded.toi.min()) == float(padded.first_toi()) and int(padded.count) == 1
    pairs = pgccd.collide(scene, motion, capacity=pgccd.Capacity.of(scene.body_count))
    assert_type(pairs, pgccd.PaddedCollidingPairs)
    assert_type(pairs.trim(), pgccd.CollidingPairs)
    assert bool(pairs.may_collide()) and len(pairs.trim()) == 1
    with pytest.raises(
        TypeError, match=r"^Capacity: make it by Capacity.of\(body_count\), or take it from Stats.needed"
    ):
        pgccd.Capacity(100)  # type: ignore[arg-type]
    with pytest.raises(
        TypeError, match="^capacity: expected a pgccd.Capacity, got 100: see Capacity.of and Stats.needed"
    ):
        pgccd.detect(scene, motion, capacity=100)  # type: ignore[call-overload]


def test_a_capacity_that_is_too_small_grows() -> None:
    scene, _ = two_bodies()
    scene = pgccd.Scene(scene.meshes, torch.zeros(4096, dtype=torch.int32))
    still = pgccd.RigidMotion.at_rest(torch.zeros(4096, 3), torch.tensor([[1.0, 0.0, 0.0, 0.0]]).repeat(4096, 1))
    pairs, capacity = torch.combinations(torch.arange(4096))[:6000], pgccd.Capacity.of(0)
    found: list[pgccd.Contacts] = []
    for _ in range(4):
        try:
            found.append(pgccd.detect(scene, still, pairs=pairs, capacity=capacity).trim())
        except pgccd.CapacityError as error:
            capacity = error.larger
    assert 0 < len(found) < 4 and all(len(hits) == 6000 for hits in found)


def test_trajectories() -> None:
    scene, _ = two_bodies()
    hits = pgccd.detect(scene, waypoints(), "all")
    assert_type(hits, pgccd.TrajectoryContacts)
    late = hits[hits.segment == 1]
    assert_type(late, pgccd.TrajectoryContacts)
    assert len(hits) > len(late) and float(hits.first_toi()) == float(hits.time.min())
    assert_type(pgccd.collide(scene, waypoints()), pgccd.CollidingPairs)


def test_captured_detection() -> None:
    scene, motion = two_bodies()
    captured = pgccd.CapturedDetection(scene, motion)
    for _ in range(3):
        hits = captured(motion)
        assert_type(hits, pgccd.PaddedContacts)
        fraction = hits.first_toi().clamp(max=1.0)
        position, _ = motion.at(0.9 * fraction)
        assert position.shape == (2, 3) and hits.toi.shape[0] >= 1
    assert_type(captured.contacts(), pgccd.Contacts)
    pairs = pgccd.CapturedCollision(scene, motion)
    assert_type(pairs.replay(), pgccd.PaddedCollidingPairs)
    assert_type(pairs.pairs(), pgccd.CollidingPairs)
    assert bool(pairs(motion).may_collide()) and pairs.pairs() == pgccd.collide(scene, motion)
    with pytest.raises(ValueError, match='^report: "any" finds no contacts: call pgccd.CapturedCollision to find'):
        pgccd.CapturedDetection(scene, motion, "any")  # type: ignore[arg-type]


def test_world() -> None:
    scene, motion = two_bodies()
    comm = distributed.Alone()
    world = distributed.World.create(
        scene,
        motion.position_t0,
        (-1.0, -1.0, -1.0),
        (4.0, 2.0, 2.0),
        payload={"orientation": motion.orientation_t0, "velocity": motion.position_t1 - motion.position_t0},
        comm=comm,
        options=distributed.WorldOptions(min_separation=1e-3),
    )
    for _ in range(4):
        mine = world.payload
        spin = torch.zeros_like(mine["velocity"])
        step = pgccd.RigidMotion.from_velocity(world.position, mine["orientation"], mine["velocity"], spin, dt=0.5)
        hits = world.step(step)
        assert_type(hits, pgccd.Contacts)
        first = world.first_toi(hits)
        fraction = comm.min(torch.cat([0.9 * first, first.new_ones(1)]).amin()[None])
        position, orientation = step.at(fraction)
        sign = torch.where(first < 1.0, -1.0, 1.0)[:, None]
        world.move(position, orientation=orientation, velocity=sign * mine["velocity"])
        assert len(hits) == 0 or float(hits.toi.min()) > 0.0
    assert_type(world.step(waypoints()), pgccd.TrajectoryContacts)


def test_world_of_pairs() -> None:
    scene, motion = two_bodies()
    box = (-1.0, -1.0, -1.0), (4.0, 2.0, 2.0)
    world = distributed.World.create(scene, motion.position_t0, *box)
    assert_type(world.collide(motion), pgccd.CollidingPairs)
    assert world.collide(motion).pairs.tolist() == world.collide(waypoints()).pairs.tolist() == [[0, 1]]
    with pytest.raises(ValueError, match='^report: "any" finds no contacts: call World.collide to find the pairs'):
        options = distributed.WorldOptions(report="any")  # type: ignore[arg-type]
        distributed.World.create(scene, motion.position_t0, *box, options=options)


def test_worlds_are_made_by_create() -> None:
    scene, motion = two_bodies()
    with pytest.raises(TypeError, match=r"^World: make it by World.create\(scene, position, lower, upper, ...\) or "):
        distributed.World(scene.meshes.meshes)  # type: ignore[arg-type]
    with pytest.raises(ValueError, match=r"^report: expected one of \['first', 'all', 'earliest'\], got 'some'$"):
        options = distributed.WorldOptions(report="some")  # type: ignore[arg-type]
        distributed.World.create(scene, motion.position_t0, (0.0, 0.0, 0.0), (1.0, 1.0, 1.0), options=options)


def test_stages() -> None:
    scene, motion = two_bodies()
    bodies = pgccd.MovingBodies.of(scene, motion)
    pairs = pgccd.broad.find_pairs(bodies)
    candidates, node_tests = pgccd.traverse.find_candidates(bodies, pairs)
    pair, *_, toi, _, _, normal = pgccd.narrow.find_contacts(bodies, pairs, candidates, report="all")
    assert len(pair) == len(toi) == len(normal) >= 1 and node_tests.shape == (1,)


def test_pyright() -> None:
    """pyright, where it is installed, finds nothing to say about this module."""
    program = next((found for name in ("pyright", "basedpyright") if (found := _installed(name))), None)
    if program is None:
        pytest.skip("pyright is not installed")
    root = Path(__file__).resolve().parents[1]
    done = subprocess.run(
        [program, "--outputjson", "--pythonpath", sys.executable, "--level", "error", __file__],
        cwd=root,
        capture_output=True,
        text=True,
        check=False,
    )
    problems = json.loads(done.stdout)["generalDiagnostics"]
    assert [f"{each['range']['start']['line'] + 1}: {each['message']}" for each in problems] == []


def _installed(name: str) -> str | None:
    """The path of a program beside Python, or on the path."""
    return shutil.which(name, path=str(Path(sys.executable).parent)) or shutil.which(name)
