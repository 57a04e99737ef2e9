"""Columns of motions and scenes that are written or replaced after validation; inputs that require gradients."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch
from support.shapes import Bodies, approaching, tensors

import pgccd
from pgccd.runtime.sizes import Capacity

NAN, INF = float("nan"), float("inf")
RIGID = {"position_t0": NAN, "position_t1": -INF, "orientation_t0": 0.1, "rotation": 1e7}
VERTICES = {"x_t0": INF, "x_t1": NAN}


def bodies() -> Bodies:
    return approaching(np.random.default_rng(0), (0, 0), closeness=0.7)


def rigid(device: torch.device | str = "cpu") -> tuple[pgccd.Scene, pgccd.RigidMotion]:
    b = bodies()
    return b.scene(device), b.motion(device=device)


def deforming(device: torch.device | str = "cpu") -> tuple[pgccd.Scene, pgccd.VertexMotion]:
    b = bodies()
    ends = [
        torch.cat([m.vertices + torch.from_numpy(p) for m, p in zip(b.meshes, position, strict=True)]).to(device)
        for position in (b.position_t0, b.position_t1)
    ]
    return b.scene(device), pgccd.VertexMotion(*ends)


def make(column: str, device: torch.device | str = "cpu") -> tuple[pgccd.Scene, Any]:
    return rigid(device) if column in RIGID else deforming(device)


@pytest.mark.parametrize("column", [*RIGID, *VERTICES])
def test_what_is_written_to_a_column_is_checked_at_use(device: torch.device, column: str) -> None:
    scene, motion = make(column, device)
    assert len(pgccd.detect(scene, motion)) == 1
    capacity = Capacity.of(100)
    former = getattr(motion, column)[1].clone()
    getattr(motion, column)[1, 2] = (RIGID | VERTICES)[column]
    for _ in range(2):
        with pytest.raises(ValueError, match=f"^{column}: (body|vertex) 1: expected"):
            pgccd.detect(scene, motion)
    hits = pgccd.detect(scene, motion, capacity=capacity)
    assert bool(hits.overflow)
    with pytest.raises(ValueError, match=f"^{column}: (body|vertex) 1: expected"):
        hits.trim()
    getattr(motion, column)[1] = former
    assert len(pgccd.detect(scene, motion)) == len(pgccd.detect(scene, motion, capacity=capacity).trim()) == 1


@pytest.mark.parametrize("column", [*RIGID, *VERTICES])
def test_memory_shared_with_numpy(column: str) -> None:
    scene, made = make(column)
    shared = {name: getattr(made, name).numpy().copy() for name in made.columns()}
    given = {name: torch.from_numpy(values) for name, values in shared.items()}
    motion = pgccd.VertexMotion(**given) if column in VERTICES else pgccd.RigidMotion.from_rotation(**given)
    assert len(pgccd.detect(scene, motion)) == 1
    shared[column][1, 2] = (RIGID | VERTICES)[column]
    with pytest.raises(ValueError, match=f"^{column}: (body|vertex) 1: expected"):
        pgccd.detect(scene, motion)


@pytest.mark.parametrize("column", [*RIGID, *VERTICES])
def test_columns_replaced_by_something_else(column: str) -> None:
    scene, motion = make(column)
    former = getattr(motion, column)
    more = torch.cat([former, former])
    other = [former.float(), former[:, :2], former[0], former.numpy(), None, former.half(), more, former.to("meta")]
    for value in other:
        with pytest.raises((TypeError, ValueError), match=f"^{column}: expected"):
            setattr(motion, column, value)
    assert getattr(motion, column) is former and len(pgccd.detect(scene, motion)) == 1
    setattr(motion, column, former.clone())
    assert len(pgccd.detect(scene, motion)) == 1
    setattr(motion, column, former.t().contiguous().t())  # not contiguous
    assert len(pgccd.detect(scene, motion)) == 1


def test_new_values_count(device: torch.device) -> None:
    scene, motion = rigid(device)
    motion.position_t1[1] += 100.0 * (motion.position_t0[1] - motion.position_t0[0])
    motion.position_t0[1] = motion.position_t1[1]
    assert len(pgccd.detect(scene, motion)) == 0


@pytest.mark.parametrize("column", [*RIGID, *VERTICES])
def test_stages_called_alone_check_too(column: str) -> None:
    scene, motion = make(column)
    moving = pgccd.MovingBodies.of(scene, motion)
    pairs = pgccd.broad.sweep(moving)
    candidates, _ = pgccd.traverse.find_candidates(moving, pairs)
    stages: list[Callable[[], Any]] = [
        lambda: pgccd.broad.sweep(moving),
        lambda: pgccd.broad.grid(moving),
        lambda: pgccd.broad.lbvh(moving),
        lambda: pgccd.traverse.find_candidates(moving, pairs),
        lambda: pgccd.narrow.find_contacts(moving, pairs, candidates),
    ]
    for stage in stages:
        stage()
    getattr(motion, column)[1, 2] = (RIGID | VERTICES)[column]
    for stage in stages:
        with pytest.raises(ValueError, match=f"^{column}: (body|vertex) 1: expected"):
            stage()


def test_columns_of_other_motions_are_checked_too() -> None:
    scene, motion = rigid()
    columns = (motion.position_t0, motion.orientation_t0, motion.position_t1, motion.rotation)
    same = pgccd.RigidMotion._of_checked(*columns)
    assert len(pgccd.detect(scene, same)) == len(pgccd.detect(scene, same[:], capacity=Capacity.of(9)).trim()) == 1
    bodies_of = pgccd.MovingBodies.of(scene, same)
    motion.orientation_t0.mul_(1.1)
    for use in (lambda: pgccd.detect(scene, same), lambda: pgccd.broad.sweep(bodies_of)):
        with pytest.raises(ValueError, match="^orientation_t0: body 0: expected a unit quaternion"):
            use()


@pytest.mark.parametrize("written_later", [False, True])
def test_an_orientation_that_is_not_kept(monkeypatch: pytest.MonkeyPatch, written_later: bool) -> None:
    """As on a GPU, whose checks are not awaited when the motion is made: the rotation that follows is no number."""
    scene, _ = rigid()
    b = bodies()
    bad = b.orientation_t0.copy()
    bad[1] *= 1.1
    given = tensors(b.position_t0, b.orientation_t0, b.position_t1, bad)
    with monkeypatch.context() as patch:
        patch.setattr(torch.compiler, "is_compiling", lambda: True)
        motion = pgccd.RigidMotion(*given)
    motion = motion._with(_given={"orientation_t1": given[3]})
    message = "^orientation_t1: body {}: expected a unit quaternion .* of norm 1.1"
    if written_later:
        given[3].copy_(given[1])
        message = r"^rotation: body {}: expected a turn .*, got \[nan, nan, nan\] .*\(it follows from orientation_t1\)"
    for _ in range(2):
        with pytest.raises(ValueError, match=message.format(1)):
            pgccd.detect(scene, motion)
    with pytest.raises(ValueError, match=message.format(0)):
        motion[1:].check()
    motion.position_t0[0, 0] = NAN
    found = pgccd.MovingBodies.of(scene, motion, wait=False)
    assert found._first_invalid_rows().tolist() == [0, 2, 2, 1, 2, 1] and found.radius.tolist() == [-INF, -INF]


def sizes() -> tuple[pgccd.Scene, pgccd.RigidMotion, list[pgccd.Mesh]]:
    """Two small bodies out of reach of each other, and a mesh large enough to make them touch."""
    b = bodies()
    small = pgccd.Mesh(1e-3 * b.meshes[0].vertices, b.meshes[0].faces)
    meshes = [small, b.meshes[0], pgccd.Mesh(10.0 * b.meshes[0].vertices, b.meshes[0].faces)]
    return pgccd.Scene(meshes, [0, 0]), b.motion(), meshes


def test_scene_follows_its_mesh_index() -> None:
    scene, motion, meshes = sizes()
    assert len(pgccd.detect(scene, motion)) == 0
    scene.mesh_index[:] = 1
    expected = pgccd.detect(pgccd.Scene(meshes, [1, 1]), motion)
    assert len(expected) == 1 and torch.equal(pgccd.detect(scene, motion).toi, expected.toi)
    scene.mesh_index = torch.tensor([2, 2], dtype=torch.int32)
    assert torch.equal(scene.radius, scene.meshes.radius[[2, 2]]) and scene.layout.vertex_count == 24
    with torch.inference_mode():
        inner = pgccd.Scene(meshes, [0, 0])
        assert len(pgccd.detect(inner, motion)) == 0
        inner.mesh_index[:] = 1
        assert len(pgccd.detect(inner, motion)) == 1
    scene.mesh_index[1] = 3
    with pytest.raises(ValueError, match=r"^mesh_index: body 1: expected a mesh from 0 to 2 .*, got 3"):
        pgccd.detect(scene, motion)


@pytest.mark.parametrize("name", ["mesh_index", "group", "mask", "world", "static"])
def test_scene_columns_replaced_by_something_else(name: str) -> None:
    b = bodies()
    zeros = torch.zeros(2, dtype=torch.int64)
    scene = pgccd.Scene(b.meshes, group=zeros, mask=zeros, world=zeros, static=zeros.bool())
    former = getattr(scene, name)
    for value in (former.double(), former[:1], former.tolist(), former[None], torch.zeros(4, dtype=former.dtype)[::2]):
        with pytest.raises((TypeError, ValueError), match=f"^{name}: expected"):
            setattr(scene, name, value)
    assert getattr(scene, name) is former
