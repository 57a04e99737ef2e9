"""The built-in robot: the properties its mesh is documented to have."""

from __future__ import annotations

from collections import Counter

import torch

from pgccd.sim import robot_mesh
from pgccd.sim.nanorobot import FACE_COUNT, VERTEX_COUNT


def test_has_the_size_of_the_paper() -> None:
    robot = robot_mesh()
    assert (len(robot.vertices), len(robot.faces)) == (VERTEX_COUNT, FACE_COUNT) == (352, 700)
    assert abs(robot.radius - 1.0) < 1e-6


def test_is_a_closed_oriented_surface_of_genus_zero() -> None:
    robot = robot_mesh()
    directed = Counter()
    for a, b, c in robot.faces.tolist():
        directed.update([(a, b), (b, c), (c, a)])
    assert set(directed.values()) == {1}
    assert all((b, a) in directed for a, b in directed)
    assert set(robot.faces.unique().tolist()) == set(range(VERTEX_COUNT))
    assert VERTEX_COUNT - len(robot.edges) + FACE_COUNT == 2  # connected: every vertex is reached below
    reached, front = {0}, [0]
    neighbours = {v: [b for a, b in directed if a == v] for v in range(VERTEX_COUNT)}
    while front:
        fresh = [n for n in neighbours[front.pop()] if n not in reached]
        reached.update(fresh)
        front.extend(fresh)
    assert len(reached) == VERTEX_COUNT


def test_faces_look_outwards_and_have_area() -> None:
    robot = robot_mesh()
    a, b, c = robot.vertices[robot.faces.long()].unbind(1)
    volumes = torch.linalg.det(torch.stack([a, b, c], dim=1))
    # The origin may lie slightly off the inner point: most faces, and the total volume, must be oriented outwards.
    assert volumes.sum() > 0
    assert (torch.linalg.cross(b - a, c - a).norm(dim=1) > 1e-4).all()


def test_is_the_same_every_time() -> None:
    assert torch.equal(robot_mesh().vertices, robot_mesh().vertices)
