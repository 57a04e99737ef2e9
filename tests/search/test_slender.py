"""Bodies that fill little of their SBV: the broad phase tests boxes too, and contacts are the same without these."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
from support.origins import recentred
from support.reports import detected
from support.same_bits import assert_same
from support.shapes import bumpy, directions, tensors, unit_quaternions

import pgccd

REPORTS = ["any", "first", "all", "earliest"]
ROD = pgccd.Mesh.box([20.0, 0.5, 0.4])


def rods(rng: np.random.Generator, count: int, spread: float, speed: float = 0.3) -> tuple[np.ndarray, ...]:
    """Poses and velocities."""
    position, velocity = spread * rng.uniform(-1, 1, (count, 3)), speed * rng.normal(size=(count, 3))
    return position, unit_quaternions(rng, count), velocity, 0.2 * rng.normal(size=(count, 3))


class Heap:
    """Rods, plates, rods about a far joint and a few other bodies."""

    def __init__(self, device: torch.device, count: int = 160, spread: float = 9.0, seed: int = 1) -> None:
        rng = np.random.default_rng(seed)
        joint = recentred(ROD, 12.0 * directions(rng, 1)[0])
        self.meshes = [ROD, pgccd.Mesh.box([4.0, 3.0, 0.1]), joint, bumpy(rng, 1)]
        self.index = torch.tensor(rng.integers(0, len(self.meshes), count))
        self.columns = tensors(*rods(rng, count, spread), device=device)
        self.margin = torch.tensor(rng.uniform(0.0, 0.1, count))
        self.static = torch.tensor(rng.uniform(size=count) < 0.2)
        self.device = device

    def scene(self, **columns: Any) -> pgccd.Scene:
        return pgccd.Scene(self.meshes, self.index, self.device, **columns)

    def motion(self, path: Any = "rigid") -> pgccd.RigidMotion:
        return pgccd.RigidMotion.from_velocity(*self.columns, dt=1.0, path=path)

    def deforming(self) -> pgccd.VertexMotion:
        """Every body as it is at both ends."""
        motion, scene = self.motion(), self.scene()
        vertices = [scene.meshes.meshes[k].vertices for k in self.index.tolist()]
        ends = []
        for time in (0.0, 1.0):
            position, orientation = (pose.cpu() for pose in motion.at(time))
            w, v = orientation[:, :1], orientation[:, 1:]
            placed = [
                x + 2 * torch.cross(v[k].expand_as(x), torch.cross(v[k].expand_as(x), x, dim=1) + w[k] * x, dim=1) + p
                for k, (x, p) in enumerate(zip(vertices, position, strict=True))
            ]
            ends.append(torch.cat(placed).to(self.device))
        return pgccd.VertexMotion(*ends)


def by_spheres(scene: pgccd.Scene, motion: Any, *options: Any, **named: Any) -> pgccd.Contacts:
    """The contacts found without boxes."""
    scene.meshes.has_boxes = False
    try:
        return detected(scene, motion, *options, **named)
    finally:
        scene.meshes.has_boxes = True


def check(scene: pgccd.Scene, motion: Any, *options: Any, fewer: float = 1.0, **named: Any) -> pgccd.Contacts:
    """Asserts equal contacts with and without boxes, and that these leave less than a part of the pairs."""
    found, expected = detected(scene, motion, *options, **named), by_spheres(scene, motion, *options, **named)
    assert_same(found, expected)
    assert len(found) > 0 and found.stats.pcs < fewer * expected.stats.pcs
    return found


@pytest.mark.parametrize("path", ["rigid", "linear"])
@pytest.mark.parametrize("report", REPORTS)
def test_same_contacts(device: torch.device, report: Any, path: Any) -> None:
    heap = Heap(device)
    motion = heap.motion(path)
    check(heap.scene(), motion, report, fewer=0.7)
    check(heap.scene(margin=heap.margin, static=heap.static), motion, report, 0.05, fewer=0.8)


@pytest.mark.parametrize("report", REPORTS)
def test_deforming_bodies(device: torch.device, report: Any) -> None:
    heap = Heap(device)
    motion = heap.deforming()
    check(heap.scene(), motion, report, fewer=0.7)
    check(heap.scene(margin=heap.margin, static=heap.static), motion, report, 0.05, fewer=0.8)


def sticks(device: torch.device, aspect: float, count: int = 400) -> tuple[pgccd.Scene, pgccd.RigidMotion]:
    rng = np.random.default_rng(0)
    spread = 0.6 * (4.0 * count * aspect) ** (1 / 3)
    poses = tensors(*rods(rng, count, spread, speed=1.0), device=device)
    scene = pgccd.Scene([pgccd.Mesh.box([aspect, 1.0, 1.0])], torch.zeros(count, dtype=torch.int32), device)
    return scene, pgccd.RigidMotion.from_velocity(*poses, dt=0.1)


@pytest.mark.parametrize("aspect", [5.0, 20.0, 100.0])
@pytest.mark.parametrize("deforming", [False, True])
def test_few_pairs_are_searched_in_vain(device: torch.device, aspect: float, deforming: bool) -> None:
    scene, motion = sticks(device, aspect)
    moved: Any = motion
    if deforming:
        x, ends = scene.meshes.meshes[0].vertices.to(device), []
        for time in (0.0, 1.0):
            position, q = motion.at(time)
            v = q[:, None, 1:].expand(-1, len(x), -1)
            placed = x + 2 * torch.cross(v, torch.cross(v, x.expand_as(v), dim=2) + q[:, None, :1] * x, dim=2)
            ends.append((placed + position[:, None]).reshape(-1, 3))
        moved = pgccd.VertexMotion(*ends)
    found = pgccd.collide(scene, moved)
    assert len(found) > 200 and found.stats.pcs <= 2 * len(found)
    assert by_spheres(scene, moved, "any").stats.pcs > 5 * len(found)


def test_meshes_that_fill_their_spheres_have_no_boxes() -> None:
    rng = np.random.default_rng(2)
    ball = pgccd.Mesh.icosphere(1.0, 2)
    for mesh in (ball, bumpy(rng, 2), pgccd.Mesh.box([1.0, 1.0, 1.0]), pgccd.Mesh.box([2.0, 1.0, 1.0])):
        scene = pgccd.Scene([mesh])
        assert not scene.meshes.has_boxes
        columns = tensors(*rods(rng, 1, 1.0))
        assert pgccd.MovingBodies.of(scene, pgccd.RigidMotion.from_velocity(*columns, dt=1.0)).boxes is None
    assert pgccd.Scene([ball, ROD]).meshes.has_boxes


def test_a_floor_under_round_bodies(device: torch.device) -> None:
    """The SBV of the floor contains all bodies, its box touches few of them."""
    rng = np.random.default_rng(3)
    count = 200
    position = rng.uniform([-40, -40, 0.9], [40, 40, 40], (count, 3))
    position[0] = [0.0, 0.0, -0.5]
    still = np.zeros((count, 3))
    columns = tensors(position, unit_quaternions(rng, count), -0.2 * rng.uniform(size=(count, 3)), still, device=device)
    columns[1][0] = torch.tensor([1.0, 0, 0, 0])
    columns[2][0] = 0.0
    index = torch.ones(count, dtype=torch.int32)
    index[0] = 0
    static = index == 0
    scene = pgccd.Scene([pgccd.Mesh.box([100.0, 100.0, 1.0]), bumpy(rng, 1)], index, device, static=static)
    found = check(scene, pgccd.RigidMotion.from_velocity(*columns, dt=1.0), "any", fewer=0.3)
    assert found.stats.pcs <= 3 * len(found)


def test_all_broad_phases_agree(device: torch.device) -> None:
    heap = Heap(device)
    scene = heap.scene(margin=heap.margin)
    for motion in (heap.motion(), heap.motion("linear"), heap.deforming()):
        bodies = pgccd.MovingBodies.of(scene, motion)
        pairs = pgccd.broad.sweep(bodies, 0.01)
        assert torch.equal(pgccd.broad.grid(bodies, 0.01), pairs) and torch.equal(pgccd.broad.lbvh(bodies, 0.01), pairs)
        if device.type == "cuda":
            on_host = pgccd.MovingBodies.of(scene.to("cpu"), motion.to("cpu"))
            assert torch.equal(pgccd.broad.sweep(on_host, 0.01), pairs.cpu())
            assert torch.equal(on_host.boxes, bodies.boxes.cpu())


def test_the_order_of_bodies_does_not_matter(device: torch.device) -> None:
    heap = Heap(device)
    scene, motion = heap.scene(margin=heap.margin), heap.motion()
    order = torch.randperm(len(heap.index), generator=torch.Generator().manual_seed(0))
    place = order.to(device)
    moved = pgccd.RigidMotion.from_velocity(*(column[place] for column in heap.columns), dt=1.0)
    shuffled = pgccd.Scene(heap.meshes, heap.index[order], heap.device, margin=heap.margin[order])
    found = place[pgccd.broad.find_pairs(pgccd.MovingBodies.of(shuffled, moved))].sort(dim=1).values
    found = found[torch.argsort(found[:, 0] * len(order) + found[:, 1])]
    assert torch.equal(found, pgccd.broad.find_pairs(pgccd.MovingBodies.of(scene, motion)))


def test_pairs_at_any_times(device: torch.device) -> None:
    """They contain those that meet at equal times, and those of bodies that stop on their way."""
    heap = Heap(device)
    scene, motion = heap.scene(), heap.motion()
    bodies = pgccd.MovingBodies.of(scene, motion)
    pairs = pgccd.broad.find_pairs_of_checked(bodies, 0.0, "grid", at_any_times=True)
    meeting, count = pgccd.broad.meeting_pairs(bodies, pairs, 0.0)
    assert torch.equal(meeting[: int(count)], pgccd.broad.find_pairs(bodies))
    known = {tuple(pair) for pair in pairs.tolist()}
    rng = np.random.default_rng(5)
    for _ in range(20):
        fraction = torch.tensor(rng.uniform(size=len(heap.index)), device=device)
        hits = pgccd.collide(scene, motion.shortened(fraction))
        assert {tuple(sorted(pair)) for pair in hits.pairs.tolist()} <= known
    scene.meshes.has_boxes = False
    spheres = pgccd.broad.find_pairs_of_checked(pgccd.MovingBodies.of(scene, motion), 0.0, "grid", at_any_times=True)
    assert len(pairs) < 0.8 * len(spheres)


def test_in_a_capacity_and_captured(device: torch.device) -> None:
    heap = Heap(device)
    scene, motion = heap.scene(margin=heap.margin), heap.motion()
    expected = pgccd.detect(scene, motion, "all")
    assert_same(pgccd.detect(scene, motion, "all", capacity=pgccd.Capacity.of(2_000).times(8.0)).trim(), expected)
    captured = pgccd.CapturedDetection(scene, motion, "all")
    for _ in range(2):
        assert_same(captured(motion).trim(), expected)


def test_resolve(device: torch.device) -> None:
    heap = Heap(device, spread=20.0)
    scene, motion = heap.scene(), heap.motion()
    found = pgccd.resolve(scene, motion)
    scene.meshes.has_boxes = False
    expected = pgccd.resolve(scene, motion)
    assert torch.equal(found.fraction, expected.fraction) and bool((found.fraction < 1.0).any())
