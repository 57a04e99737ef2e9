"""Incomplete results read as contact at the start of the step: after an overflow, and of invalid poses."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from support.capacities import DEVICES_AND_PARTS
from support.crowds import crowds
from support.deforming import crumpled, motion_of
from support.origins import recentred
from support.reports import detected
from support.shapes import bumpy, tensors, unit_quaternions

import pgccd
from pgccd.runtime.sizes import Capacity

REPORTS = ("any", "first", "all", "earliest")
GROUPINGS: tuple[Any, ...] = ("scene", "world", "body")
NAN, INF = float("nan"), float("inf")
WORLDS = 4


def crowd(device: torch.device) -> tuple[pgccd.Scene, pgccd.RigidMotion]:
    """Bodies of two worlds; many collide."""
    bodies = crowds()["faster than cells"]
    columns = (bodies.position, bodies.orientation, bodies.velocity, bodies.rotation)
    motion = pgccd.RigidMotion.from_velocity(*(column.to(device) for column in columns), dt=1.0)
    world = torch.arange(len(bodies.mesh_index)) % 2
    return pgccd.Scene(bodies.meshes, bodies.mesh_index, device, world=world), motion


def shells(device: torch.device) -> tuple[pgccd.Scene, pgccd.RigidMotion]:
    """A body of 5,120 triangles that moves against the inside of another."""
    rng = np.random.default_rng(2)
    meshes = [bumpy(rng, 4, height=0.02, size=size) for size in (1.0, 1.1)]
    x = torch.zeros(2, 3, dtype=torch.float64, device=device)
    q = torch.tensor([[1.0, 0.0, 0.0, 0.0]] * 2, dtype=torch.float64, device=device)
    moved = x.clone()
    moved[0, 0] = 0.15
    return pgccd.Scene(meshes, device=device), pgccd.RigidMotion(x, q, moved, q)


def worlds(device: torch.device, **columns: Any) -> tuple[pgccd.Scene, pgccd.RigidMotion]:
    """Twelve bodies in each of four worlds, in turn; in the last world nothing collides. One mesh is off centre."""
    rng = np.random.default_rng(7)
    count = 12 * WORLDS
    world = torch.arange(count) % WORLDS
    meshes = [bumpy(rng, 0), recentred(bumpy(rng, 0), np.array([0.5, 0.0, 0.0]))]
    spread = np.where(world.numpy() == WORLDS - 1, 100.0, 2.0)[:, None]
    place, velocity, spin = spread * rng.normal(size=(count, 3)), *rng.normal(size=(2, count, 3))
    scene = pgccd.Scene(meshes, torch.arange(count) % 3 % 2, device, world=world, **columns)
    given = tensors(place, unit_quaternions(rng, count), velocity, spin, device=device)
    return scene, pgccd.RigidMotion.from_velocity(*given, dt=1.0)


def assert_contact_at_once(hits: pgccd.PaddedContacts | pgccd.PaddedCollidingPairs) -> None:
    """For the scene, each world and each body."""
    assert bool(hits.overflow)
    for by in GROUPINGS:
        assert bool(hits.may_collide(by).all())
        if isinstance(hits, pgccd.PaddedContacts):
            assert bool((hits.first_toi(by) == 0.0).all())
    if isinstance(hits, pgccd.PaddedContacts):
        assert bool((hits.toi == 0.0).all())
    assert hits.may_collide().shape == () and hits.may_collide("body").shape == (hits.body_count,)
    worlds = 1 if hits.world is None else 1 + int(hits.world.max())
    assert hits.may_collide("world").shape == (worlds,)


@contextmanager
def unchecked() -> Iterator[None]:
    """Motions are made as on a GPU, which does not wait for their checks."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(torch.compiler, "is_compiling", lambda: True)
        yield


@pytest.mark.parametrize("report", REPORTS)
@pytest.mark.parametrize(("device", "part"), DEVICES_AND_PARTS, indirect=["device"])
def test_overflow(device: torch.device, part: str, report: Any) -> None:
    scene, motion = crowd(device)
    if part == "tasks":  # the launches for small bodies leave none behind
        scene, motion = shells(device)
    expected = detected(scene, motion, report, broad_phase="grid")
    needed = expected.stats.needed
    assert needed is not None and len(expected) > 0
    if getattr(needed, part) == 0 and report != "all":
        pytest.skip("not needed for this report")
    sizes = {0}
    if report != "earliest":  # how much is skipped depends on the order of threads
        sizes.add(getattr(needed, part) - 1 if part in ("pairs", "contacts") else getattr(needed, part) // 2)
    for size in sizes:  # all rows of contacts may be used: then there is no padding
        tight = replace(needed.times(1.5), **{part: size})
        hits = detected(scene, motion, report, broad_phase="grid", capacity=tight)
        assert_contact_at_once(hits)
        assert not bool(hits.invalid)
        assert bool((hits.pairs[min(int(hits.count), len(hits.pairs)) :] == -1).all())
        with pytest.raises(pgccd.CapacityError, match=part):
            hits.trim()


@pytest.mark.parametrize("report", REPORTS)
def test_complete_results_read_as_found(device: torch.device, report: Any) -> None:
    """Also where no row is left for padding, or there are no rows at all."""
    scene, motion = worlds(device)
    expected = detected(scene, motion, report)
    assert expected.stats.needed is not None
    capacity = expected.stats.needed.times(1.5)
    exact = replace(capacity, contacts=expected.stats.needed.contacts)
    for given in (capacity,) if report == "earliest" else (capacity, exact):
        hits = detected(scene, motion, report, capacity=given)
        assert not bool(hits.overflow) and not bool(hits.invalid)
        for by in GROUPINGS:
            assert torch.equal(hits.may_collide(by), expected.may_collide(by))
            if report != "any":
                assert torch.equal(hits.first_toi(by), expected.first_toi(by))
                assert torch.equal(hits.may_collide(by), hits.first_toi(by) <= 1.0)
        seen = torch.bincount(expected.pairs.view(-1), minlength=scene.body_count) > 0
        if report == "earliest":  # others may have contacts as early
            seen = torch.ones_like(seen)
        assert bool(hits.may_collide()) and bool(hits.may_collide("world")[-1]) == (report == "earliest")
        assert torch.equal(hits.may_collide("body"), seen)
    apart = motion[scene.world == WORLDS - 1]
    alone = pgccd.Scene(scene.meshes, scene.mesh_index[scene.world == WORLDS - 1])
    nothing = detected(alone, apart, report, capacity=replace(capacity, contacts=0))
    assert not bool(nothing.overflow) and not bool(nothing.may_collide("body").any())
    assert report == "any" or bool(nothing.first_toi("body").isinf().all())


def test_groupings_are_checked(device: torch.device) -> None:
    scene, motion = worlds(device)
    for hits in (pgccd.detect(scene, motion), pgccd.detect(scene, motion, capacity=Capacity.of(50))):
        with pytest.raises(ValueError, match=r"^by: .*'rank'"):
            hits.may_collide("rank")  # type: ignore[arg-type]
        hits._bodies = None  # type: ignore[assignment]
        assert hits.may_collide().shape == ()
        with pytest.raises(ValueError, match=r"^by: 'body' needs the result of `pgccd.detect`"):
            hits.may_collide("body")


INVALID = {"position_t0": NAN, "position_t1": -INF, "orientation_t0": 0.1, "rotation": 1e7, "orientation_t1": 2.0}


@pytest.mark.parametrize("report", REPORTS)
@pytest.mark.parametrize("column", INVALID)
def test_an_invalid_pose_concerns_its_world(device: torch.device, column: str, report: Any) -> None:
    capacity = Capacity.of(1000)
    for broad_phase, body in (("sweep", 0), ("grid", 21), ("lbvh", 12 * WORLDS - 3)):
        scene, motion = worlds(device, margin=0.01 if broad_phase == "grid" else None)
        if column == "orientation_t1":  # no column: the rotation that follows from it is none
            start, end = (motion.position_t0, motion.orientation_t0, motion.position_t1), motion.orientation_t0.clone()
            motion = pgccd.RigidMotion(*start, end)
        true = detected(scene, motion, report, broad_phase=broad_phase)
        if column == "orientation_t1":
            end[body] *= INVALID[column]
            with unchecked():
                motion = pgccd.RigidMotion(*start, end)
        else:
            getattr(motion, column)[body] = INVALID[column]
        hits = detected(scene, motion, report, broad_phase=broad_phase, capacity=capacity)
        assert bool(hits.overflow) and bool(hits.invalid)
        assert scene.world is not None
        of_world = torch.arange(WORLDS, device=device) == body % WORLDS
        of_body = scene.world == body % WORLDS
        assert bool(hits.may_collide())
        if report != "any":
            assert float(hits.first_toi()) == 0.0 and bool((hits.toi == 0.0).all())
        if report == "earliest":  # only the first contact of the scene is known
            assert bool(hits.may_collide("world")[of_world].all()) and bool(hits.may_collide("body")[of_body].all())
            assert not bool(hits.first_toi("world")[of_world].any() | hits.first_toi("body")[of_body].any())
            continue
        for by, concerned in (("world", of_world), ("body", of_body)):
            assert torch.equal(hits.may_collide(by), concerned | true.may_collide(by))  # type: ignore[arg-type]
            if report != "any":
                expected = true.first_toi(by).masked_fill(concerned, 0.0)  # type: ignore[arg-type]
                assert torch.equal(hits.first_toi(by), expected)  # type: ignore[arg-type]
        assert int(hits.count) > 0 and not bool(hits.may_collide("world")[-1])
        with pytest.raises(ValueError, match=f"^({column}|rotation): body {body}: expected"):
            hits.trim()


def test_invalid_poses_of_several_worlds(device: torch.device) -> None:
    scene, motion = worlds(device)
    true = pgccd.detect(scene, motion)
    motion.position_t0[0] = NAN
    motion.rotation[5] = INF
    motion.position_t1[8] = 1e151
    hits = pgccd.detect(scene, motion, capacity=Capacity.of(1000))
    assert torch.equal(hits.first_toi("world")[2:], true.first_toi("world")[2:])
    assert hits.first_toi("world")[:2].tolist() == [0.0, 0.0]
    motion.position_t0.fill_(NAN)
    assert_contact_at_once(pgccd.detect(scene, motion, capacity=Capacity.of(1000)))


def test_overflow_and_an_invalid_pose(device: torch.device) -> None:
    scene, motion = worlds(device)
    motion.position_t0[0] = NAN
    assert_contact_at_once(pgccd.detect(scene, motion, capacity=replace(Capacity.of(1000), contacts=1)))
    assert_contact_at_once(pgccd.detect(scene, motion, capacity=replace(Capacity.of(1000), pairs=1)))


@pytest.mark.parametrize("report", REPORTS)
def test_one_world(device: torch.device, report: Any) -> None:
    scene, motion = worlds(device)
    scene = pgccd.Scene(scene.meshes, scene.mesh_index)
    motion.position_t0[3] = NAN
    assert_contact_at_once(detected(scene, motion, report, capacity=Capacity.of(1000)))


@pytest.mark.parametrize("report", REPORTS)
def test_invalid_input_that_concerns_every_world(device: torch.device, report: Any) -> None:
    """Where pairs are given."""
    scene, motion = worlds(device)
    pairs = pgccd.broad.sweep(pgccd.MovingBodies.of(scene, motion))
    motion.position_t0[0] = NAN
    assert_contact_at_once(detected(scene, motion, report, pairs=pairs, capacity=Capacity.of(1000)))


@pytest.mark.parametrize("report", REPORTS)
@pytest.mark.parametrize("own", [False, True], ids=["", "self-collision"])
def test_deforming_bodies(device: torch.device, own: bool, report: Any) -> None:
    shapes, ends = crumpled(3)
    scene = pgccd.Scene(shapes, device=device, self_collision=own, world=[0, 1, 1])
    motion = motion_of(*ends, device=device)
    needed = detected(scene, motion, report).stats.needed
    assert needed is not None
    capacity = replace(needed.times(2.0), candidates=100_000)
    assert not bool(detected(scene, motion, report, capacity=capacity).overflow)
    if own:
        assert_contact_at_once(detected(scene, motion, report, capacity=replace(capacity, contacts=0)))
    # The last two make a radius that is too large or too small.
    for column, value in (("x_t0", NAN), ("x_t1", INF), ("x_t1", 1e149), ("x_t0", None)):
        former = getattr(motion, column).clone()
        if value is None:
            count = len(shapes[0].vertices)
            for each in (motion.x_t0, motion.x_t1):
                each[:count] = 1e-40 * torch.rand(count, 3, dtype=torch.float64).to(device)
        else:
            getattr(motion, column)[2, 1] = value
        hits = detected(scene, motion, report, capacity=capacity)
        assert_contact_at_once(hits)
        assert bool(hits.invalid)
        with pytest.raises(ValueError, match=f"^({column}: vertex 2|motion: body 0: expected an SBV radius)"):
            hits.trim()
        getattr(motion, column).copy_(former)


@pytest.mark.parametrize("report", REPORTS)
def test_trajectories(device: torch.device, report: Any) -> None:
    scene, motion = worlds(device)
    place = torch.stack([motion.position_t0, motion.position_t1, motion.position_t0])
    hits = detected(scene, pgccd.Trajectory(place, motion.orientation_t0.expand(3, -1, -1)), report)
    assert hits.may_collide().shape == () and bool(hits.may_collide())
    if report == "earliest":  # others may have contacts as early
        assert bool(hits.may_collide("world").all()) and bool(hits.may_collide("body").all())
        return
    assert not bool(hits.may_collide("world")[-1])
    assert torch.equal(hits.may_collide("body").nonzero()[:, 0], hits.pairs.unique())


@pytest.mark.slow
def test_compile(device: torch.device) -> None:
    scene, motion = worlds(device)
    capacity = Capacity.of(1000)
    expected = pgccd.detect(scene, motion).first_toi("world")

    @torch.compile(fullgraph=True, backend="aot_eager")
    def step(*columns: torch.Tensor) -> tuple[torch.Tensor, ...]:
        hits = pgccd.detect(scene, pgccd.RigidMotion.from_rotation(*columns), capacity=capacity)
        assert hits.toi is not None
        return hits.toi.min(), hits.first_toi("world"), hits.may_collide("body"), hits.invalid

    columns = [motion.position_t0, motion.orientation_t0, motion.position_t1, motion.rotation]
    least, first, collides, invalid = step(*columns)
    assert torch.equal(first, expected) and not bool(invalid)
    assert float(least) == float(first.min()) and bool(collides.any()) and not bool(collides.all())
    columns[0] = columns[0].clone()
    columns[0][1] = NAN
    least, first, collides, invalid = step(*columns)
    expected[1] = 0.0
    assert torch.equal(first, expected) and bool(invalid) and float(least) == 0.0
    assert bool(collides[1::WORLDS].all()) and not bool(collides[WORLDS - 1 :: WORLDS].any())
