"""Poses along a path, and first times."""

from __future__ import annotations

import mpmath
import numpy as np
import pytest
import torch
from oracle import rigid
from support.origins import recentred
from support.shapes import bumpy, height_field, tensors, tetrahedron, unit_quaternions

import pgccd


def random_motion(count: int, device: torch.device, turn: float = 1.0) -> pgccd.RigidMotion:
    rng = np.random.default_rng(5)
    x, v, w = (rng.normal(size=(count, 3)) for _ in range(3))
    columns = tensors(3.0 * x, unit_quaternions(rng, count), v, turn * w, device=device)
    return pgccd.RigidMotion.from_velocity(*columns, dt=1.0)


def turned(q: torch.Tensor, points: torch.Tensor) -> torch.Tensor:
    twice = 2.0 * torch.linalg.cross(q[..., 1:], points)
    return points + q[..., :1] * twice + torch.linalg.cross(q[..., 1:], twice)


@pytest.mark.parametrize("turn", [0.0, 1.0, 40.0])
def test_poses_are_those_of_the_path(turn: float, device: torch.device) -> None:
    motion = random_motion(7, device, turn)
    point = np.array([0.3, -0.7, 1.1])
    times = torch.tensor([0.0, 0.21, 0.5, 1.0], dtype=torch.float64, device=device)
    position, orientation = motion.at(times[:, None])
    assert position.shape == (4, 7, 3) and orientation.shape == (4, 7, 4)
    assert float((orientation.norm(dim=-1) - 1.0).abs().max()) < 1e-15
    placed = position + turned(orientation, torch.tensor(point, device=device).expand_as(position))
    for k, t in enumerate(times.tolist()):
        for body in range(7):
            columns = (motion.position_t0, motion.orientation_t0, motion.position_t1, motion.rotation)
            truth = rigid.position(point, *(c[body].cpu().numpy() for c in columns), t)
            errors = [abs(mpmath.mpf(a) - b) for a, b in zip(placed[k, body].tolist(), truth, strict=True)]
            assert max(errors) < 1e-13
    assert torch.equal(position[0], motion.position_t0) and torch.equal(position[3], motion.position_t1)


def test_times_broadcast_against_bodies(device: torch.device) -> None:
    motion = random_motion(5, device)
    times = torch.tensor([0.1, 0.2, 0.3, 0.4, 0.5], dtype=torch.float64, device=device)
    each, all_at = motion.at(times), motion.at(times[:, None])
    assert each[0].shape == (5, 3) and each[1].shape == (5, 4)
    for k, t in enumerate(times.tolist()):
        scalar = motion.at(t)
        for one, many, own in zip(scalar, all_at, each, strict=True):
            assert torch.equal(one, many[k]) and torch.equal(one[k], own[k])
    assert torch.equal(motion.at(times.expand(3, 5))[0][2], each[0])
    assert motion.at(torch.zeros(0, 1))[0].shape == (0, 5, 3)
    with pytest.raises(ValueError, match=r"^t: .*\(5,\).*got \(3,\); for T times of all, pass t\[:, None\]"):
        motion.at(torch.zeros(3))
    if device.type == "cpu":  # a GPU uses a device assertion
        with pytest.raises(ValueError, match="^t: expected times in"):
            motion.at(1.5)
    linear = pgccd.RigidMotion.from_rotation(
        motion.position_t0, motion.orientation_t0, motion.position_t1, motion.rotation, "linear"
    )
    with pytest.raises(ValueError, match="^path: "):
        linear.at(0.5)


def test_vertices_on_straight_paths(device: torch.device) -> None:
    x0, x1 = tensors(*np.random.default_rng(2).normal(size=(2, 9, 3)), device=device)
    motion = pgccd.VertexMotion(x0, x1)
    assert torch.equal(motion.at(0.25), 0.75 * x0 + 0.25 * x1)
    assert motion.at(torch.rand(4, 1)).shape == (4, 9, 3)
    with pytest.raises(ValueError, match="^t: "):
        motion.at(torch.zeros(4))


def heap(device: torch.device, worlds: bool = True, far: bool = False) -> tuple[pgccd.Scene, pgccd.RigidMotion]:
    rng = np.random.default_rng(9)
    count = 40
    meshes = [bumpy(rng, 0), recentred(bumpy(rng, 0), np.array([1.0, 0.0, 0.0]))]
    world = torch.tensor(rng.integers(0, 3, count)) + (torch.arange(count) == 7) * 3
    scene = pgccd.Scene(meshes, torch.arange(count) % 2, device, world=world if worlds else None)
    place = rng.uniform(0.0, 6.0, (count, 3)) + (100.0 * np.arange(count)[:, None] if far else 0.0)
    columns = tensors(place, unit_quaternions(rng, count), *rng.normal(size=(2, count, 3)), device=device)
    return scene, pgccd.RigidMotion.from_velocity(*columns, dt=1.0)


@pytest.mark.parametrize("worlds", [False, True])
@pytest.mark.parametrize("far", [False, True], ids=["contacts", "nothing"])
def test_first_times(worlds: bool, far: bool, device: torch.device) -> None:
    scene, motion = heap(device, worlds, far)
    hits = pgccd.detect(scene, motion)
    assert (len(hits) == 0) == far
    body = [float("inf")] * 40
    for pair, toi in zip(hits.pairs.tolist(), hits.toi.tolist(), strict=True):
        for k in pair:
            body[k] = min(body[k], toi)
    of_world = [0] * 40 if scene.world is None else scene.world.tolist()
    world = [
        min([b for b, w in zip(body, of_world, strict=True) if w == k], default=float("inf"))
        for k in range(max(of_world) + 1)
    ]
    capacity = pgccd.Capacity.of(40).times(50.0)
    padded = pgccd.detect(scene, motion, capacity=capacity)
    for found in (
        hits,
        padded,
        padded.trim(),
        pgccd.detect(scene, motion, "all"),
        pgccd.detect(scene, motion, memory_budget=1),
    ):
        assert found.first_toi().shape == () and float(found.first_toi()) == min(body)
        assert found.first_toi("world").tolist() == world
        assert found.first_toi("body").tolist() == body
    assert float(pgccd.detect(scene, motion, "earliest").first_toi("scene")) == min(body)


def test_first_times_that_are_not_known(device: torch.device) -> None:
    scene, motion = heap(device)
    with pytest.raises(ValueError, match="^by: .*'rank'"):
        pgccd.detect(scene, motion).first_toi("rank")  # type: ignore[arg-type]


def test_first_times_of_no_bodies(device: torch.device) -> None:
    mesh = height_field(np.random.default_rng(0), 1, 1)
    scene = pgccd.Scene([mesh], torch.zeros(0, dtype=torch.int32), device)
    empty = [torch.zeros((0, width), dtype=torch.float64, device=device) for width in (3, 4, 3, 4)]
    hits = pgccd.detect(scene, pgccd.RigidMotion(*empty))
    assert float(hits.first_toi()) == float("inf")
    assert hits.first_toi("body").shape == (0,) and hits.first_toi("world").shape == (1,)


def test_worlds_written_later() -> None:
    scene = pgccd.Scene([tetrahedron()] * 2, world=[0, 0])
    x = torch.tensor([[0.0, 0, 0], [4.0, 0, 0]])
    q = torch.tensor([[1.0, 0, 0, 0]] * 2)
    motion = pgccd.RigidMotion(x, q, 0.1 * x, q)
    assert pgccd.detect(scene, motion).first_toi("world").shape == (1,)
    scene.world[:] = 3  # type: ignore[index]
    first = pgccd.detect(scene, motion).first_toi("world")
    assert first.isinf().tolist() == [True, True, True, False]


@pytest.mark.parametrize("padded", [False, True])
def test_the_earliest_contact_bounds_those_of_other_worlds_and_bodies(device: torch.device, padded: bool) -> None:
    """Two worlds, in both of which two bodies intersect."""
    mesh = pgccd.Mesh(torch.eye(4, 3).double(), [[0, 1, 2], [0, 3, 1], [1, 3, 2], [0, 2, 3]])
    scene = pgccd.Scene([mesh], [0] * 4, device, world=torch.tensor([0, 0, 1, 1], device=device))
    position = torch.zeros((4, 3), dtype=torch.float64, device=device)
    position[1::2] += 0.1
    motion = pgccd.RigidMotion.at_rest(position, torch.eye(4, device=device).double()[:1].repeat(4, 1))
    capacity = pgccd.Capacity.of(4) if padded else None
    every = pgccd.detect(scene, motion, capacity=capacity)  # type: ignore[call-overload]
    assert every.may_collide("world").all() and every.may_collide("body").all()
    hits = pgccd.detect(scene, motion, "earliest", capacity=capacity)  # type: ignore[call-overload]
    some = [hits] if padded else [hits, every.earliest(), hits[[0]]]
    for earliest in some:
        for by in ("scene", "world", "body"):
            assert bool(earliest.may_collide(by).all()) and not bool(earliest.first_toi(by).any())
    apart = pgccd.RigidMotion.at_rest(
        10.0 * torch.arange(12.0, device=device).double().view(4, 3), motion.orientation_t0
    )
    nothing = pgccd.detect(scene, apart, "earliest", capacity=capacity)  # type: ignore[call-overload]
    for by in ("scene", "world", "body"):
        assert not bool(nothing.may_collide(by).any()) and bool(nothing.first_toi(by).isinf().all())
