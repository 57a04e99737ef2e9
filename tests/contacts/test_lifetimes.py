"""Results hold no inputs: neither the scene and its columns, nor its meshes, nor the motion."""

from __future__ import annotations

import gc
import weakref
from collections.abc import Callable
from typing import Any

import pytest
import torch

import pgccd
from pgccd.distributed import World


def inputs(device: torch.device) -> dict[str, Any]:
    """A scene with all optional columns, and motions of it; two of its three bodies collide."""
    mesh = pgccd.Mesh.box([1.0, 1.0, 1.0])
    index = torch.tensor([0, 0, 0], dtype=torch.int32)
    columns = {"group": torch.ones(3, dtype=torch.int64), "margin": torch.full((3,), 0.01)}
    scene = pgccd.Scene([mesh], index, device, world=torch.tensor([0, 0, 1]), exclude=[[0, 2]], **columns)
    x = torch.tensor([[0.0, 0, 0], [3.0, 0.1, 0.2], [0.0, 9, 0]], dtype=torch.float64, device=device)
    q = torch.tensor([[1.0, 0, 0, 0]] * 3, dtype=torch.float64, device=device)
    moved = x - torch.tensor([[0.0], [1.0], [0.0]], dtype=torch.float64, device=device) * x
    motion = pgccd.RigidMotion(x, q, moved, q.clone())
    trajectory = pgccd.Trajectory(
        torch.stack([x, moved, x]), torch.stack([q] * 3), margin=torch.full((2, 3), 0.01, device=device)
    )
    corners = torch.cat([mesh.vertices.to(device) + place for place in (x[0], x[1], x[2])])
    deforming = pgccd.VertexMotion(corners, torch.cat([mesh.vertices.to(device) + place for place in moved]))
    return {"scene": scene, "motion": motion, "trajectory": trajectory, "deforming": deforming}


def _captured(call: Any) -> Callable[[dict[str, Any]], Any]:
    """A result that has been read from a loop, which itself keeps the scene."""
    return lambda given: call(given["scene"], given["motion"])(given["motion"])


def _world(given: dict[str, Any]) -> World:
    return World.create(given["scene"], given["motion"].position_t0, (-1.0,) * 3, (10.0,) * 3)


ROOM = pgccd.Capacity.of(3)
CALLS: dict[str, Callable[[dict[str, Any]], Any]] = {
    "detect": lambda given: pgccd.detect(given["scene"], given["motion"]),
    "all": lambda given: pgccd.detect(given["scene"], given["motion"], "all"),
    "earliest": lambda given: pgccd.detect(given["scene"], given["motion"], "earliest"),
    "surface normals": lambda given: pgccd.detect(given["scene"], given["motion"], normals="surface"),
    "deforming": lambda given: pgccd.detect(given["scene"], given["deforming"]),
    "chunks": lambda given: pgccd.detect(given["scene"], given["motion"], memory_budget=1),
    "capacity": lambda given: pgccd.detect(given["scene"], given["motion"], capacity=ROOM),
    "capacity, deforming": lambda given: pgccd.detect(given["scene"], given["deforming"], capacity=ROOM),
    "trimmed": lambda given: pgccd.detect(given["scene"], given["motion"], capacity=ROOM).trim(),
    "captured": _captured(pgccd.CapturedDetection),
    "trajectory": lambda given: pgccd.detect(given["scene"], given["trajectory"]),
    "collide": lambda given: pgccd.collide(given["scene"], given["motion"]),
    "collide in a capacity": lambda given: pgccd.collide(given["scene"], given["motion"], capacity=ROOM),
    "collide, captured": _captured(pgccd.CapturedCollision),
    "collide along a trajectory": lambda given: pgccd.collide(given["scene"], given["trajectory"]),
    "approaching": lambda given: pgccd.approaching(
        given["scene"], given["motion"], pgccd.detect(given["scene"], given["motion"])
    ),
    "approach_rates": lambda given: pgccd.approach_rates(
        given["scene"], given["motion"], pgccd.detect(given["scene"], given["motion"])
    ),
    "distance": lambda given: pgccd.distance(given["scene"], given["motion"], cutoff=1.0),
    "distance along a trajectory": lambda given: pgccd.distance(given["scene"], given["trajectory"], cutoff=1.0),
    "enclosed": lambda given: pgccd.enclosed(given["scene"], given["motion"]),
    "resolve": lambda given: pgccd.resolve(given["scene"], given["motion"]),
    "resolve in a capacity": lambda given: pgccd.resolve(given["scene"], given["motion"], capacity=ROOM),
    "resolve a trajectory": lambda given: pgccd.resolve(given["scene"], given["trajectory"]),
    "audit": lambda given: pgccd.audit(given["scene"], given["trajectory"]),
    "World.step": lambda given: _world(given).step(given["motion"]),
    "World.collide": lambda given: _world(given).collide(given["motion"]),
}


@pytest.mark.parametrize("name", CALLS)
def test_results_hold_no_inputs(name: str, device: torch.device) -> None:
    given = inputs(device)
    scene = given["scene"]
    watched: dict[str, Any] = dict(given) | {"meshes": scene.meshes, "mesh": scene.meshes.meshes[0]}
    for key in ("mesh_index", "group", "margin", "exclude"):
        watched[key] = getattr(scene, key)
    # Resolutions of arcs share what they do not shorten, and a trajectory its segments.
    if not name.startswith(("resolve", "audit")):
        for motion in ("motion", "trajectory", "deforming"):
            names = ("position", "orientation", "x_t0", "x_t1", "position_t0", "position_t1", "rotation")
            columns = {each: getattr(given[motion], each, None) for each in names}
            watched |= {f"{motion}.{each}": column for each, column in columns.items() if column is not None}
    alive = {key: weakref.ref(value) for key, value in watched.items()}
    found = CALLS[name](given)
    del given, scene, watched
    columns = column = value = None  # noqa: F841
    gc.collect()
    assert [key for key, reference in alive.items() if reference() is not None] == [], name
    assert found is not None


def test_robots_hold_no_inputs(tmp_path: Any) -> None:
    """A certificate keeps names of links alone."""
    (tmp_path / "arm.urdf").write_text(
        '<robot name="arm"><link name="base"><collision><geometry><box size="1 1 1"/></geometry></collision></link>'
        '<link name="hand"><collision><geometry><box size="0.2 0.2 2"/></geometry></collision></link>'
        '<joint name="turn" type="revolute"><parent link="base"/><child link="hand"/><origin xyz="0 0 2"/>'
        '<axis xyz="1 0 0"/><limit lower="-1" upper="1" effort="1" velocity="1"/></joint></robot>'
    )
    robot = pgccd.robots.load_urdf(tmp_path / "arm.urdf")
    obstacles = pgccd.robots.Obstacles([pgccd.Mesh.box([1.0, 1.0, 1.0])])
    path = torch.tensor([[[0.0], [0.5]]])
    found = robot.certify(path, obstacles)
    alive = {"robot": weakref.ref(robot), "obstacles": weakref.ref(obstacles), "path": weakref.ref(path)}
    del robot, obstacles, path
    gc.collect()
    assert [key for key, reference in alive.items() if reference() is not None] == []
    assert len(found) == 1


def test_the_size_of_a_result_is_that_of_its_rows(device: torch.device) -> None:
    """A contact of 5,000 bodies is stored in a few kilobytes; with worlds, in those besides."""
    count = 5000
    scene = pgccd.Scene([pgccd.Mesh.box([1.0, 1.0, 1.0])], [0] * count, device)
    place = 5.0 * torch.arange(count, dtype=torch.float64, device=device)[:, None] * torch.ones(3, device=device)
    upright = torch.tensor([[1.0, 0, 0, 0]], dtype=torch.float64, device=device).repeat(count, 1)
    moved = place.clone()
    moved[0] = place[1] - 0.2
    hits = pgccd.detect(scene, pgccd.RigidMotion(place, upright, moved, upright))
    assert len(hits) == 1 and hits.body_count == count
    assert stored_bytes(hits) < 2000
    in_worlds = pgccd.Scene(scene.meshes, scene.mesh_index, world=torch.zeros(count, dtype=torch.int32))
    hits = pgccd.detect(in_worlds, pgccd.RigidMotion(place, upright, moved, upright))
    assert hits.world is not None and stored_bytes(hits) < 2000 + 3 * 4 * count
    assert hits.first_toi("world").shape == (1,)


def stored_bytes(result: Any) -> int:
    """Bytes of the tensors that an object refers to, directly or not."""
    seen: set[int] = set()
    storages: dict[int, int] = {}
    ahead = [result]
    while ahead:
        each = ahead.pop()
        if id(each) in seen or isinstance(each, type):
            continue
        seen.add(id(each))
        if isinstance(each, torch.Tensor):
            storage = each.untyped_storage()
            storages[storage.data_ptr()] = storage.nbytes()
        elif isinstance(each, (list, tuple)):
            ahead += each
        elif isinstance(each, dict):
            ahead += each.values()
        elif hasattr(each, "__dict__"):
            ahead += vars(each).values()
    return sum(storages.values())
