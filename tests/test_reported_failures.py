"""Scenes of public reports that other libraries miss a continuous collision or return a wrong result, rebuilt from the
reports' texts: docs/explanation/reported_failures.md.
"""

from __future__ import annotations

import math
from fractions import Fraction

import numpy as np
import pytest
import torch
from support.reports import detected

import pgccd

STILL = [1.0, 0.0, 0.0, 0.0]


def box(size: tuple[float, float, float], centre: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> pgccd.Mesh:
    corners = np.array([[x, y, z] for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (-0.5, 0.5)])
    faces = [[0, 1, 3], [0, 3, 2], [4, 6, 7], [4, 7, 5], [0, 4, 5], [0, 5, 1]]
    faces += [[2, 3, 7], [2, 7, 6], [0, 2, 6], [0, 6, 4], [1, 5, 7], [1, 7, 3]]
    return pgccd.Mesh(torch.from_numpy(corners * size + centre), torch.tensor(faces))


def cone(radius: float, height: float, sides: int = 32) -> pgccd.Mesh:
    """A cone along z, its base at -height / 2, with a corner of the base at -x."""
    angle = math.pi + 2.0 * math.pi * np.arange(sides) / sides
    rim = np.stack([radius * np.cos(angle), radius * np.sin(angle), np.full(sides, -0.5 * height)], axis=1)
    rim[0] = [-radius, 0.0, -0.5 * height]
    vertices = np.concatenate([rim, [[0.0, 0.0, 0.5 * height], [0.0, 0.0, -0.5 * height]]])
    k = np.arange(sides)
    following = (k + 1) % sides
    faces = [np.stack([k, following, np.full(sides, sides)], axis=1)]
    faces += [np.stack([following, k, np.full(sides, sides + 1)], axis=1)]
    return pgccd.Mesh(torch.from_numpy(vertices), torch.from_numpy(np.concatenate(faces)))


def quads(*corners: list[list[float]]) -> pgccd.Mesh:
    """A mesh of quads, each given by its four corners in order."""
    faces = [[4 * k + a for a in triangle] for k in range(len(corners)) for triangle in ([0, 1, 2], [0, 2, 3])]
    return pgccd.Mesh(torch.tensor(corners, dtype=torch.float64).reshape(-1, 3), torch.tensor(faces))


def thread(radius: float, depth: float, pitch: float, turns: int, sides: int, rows: int) -> pgccd.Mesh:
    """A tube about z with a helical ridge."""
    angle, along = np.meshgrid(np.arange(sides), np.arange(turns * rows + 1))
    phase = (along / rows - angle / sides) % 1.0
    r = radius + depth * (1.0 - 2.0 * np.abs(phase - 0.5))
    turn = 2.0 * math.pi * angle / sides
    vertices = np.stack([r * np.cos(turn), r * np.sin(turn), pitch * along / rows], axis=2).reshape(-1, 3)
    a = (sides * along + angle)[:-1]
    b = (sides * along + (angle + 1) % sides)[:-1]
    faces = np.concatenate([np.stack([a, b, b + sides], axis=2), np.stack([a, b + sides, a + sides], axis=2)])
    return pgccd.Mesh(torch.from_numpy(vertices), torch.from_numpy(faces.reshape(-1, 3)))


def detect(
    meshes: list[pgccd.Mesh],
    start: list[list[float]],
    end: list[list[float]],
    device: torch.device,
    report: str = "first",
    separation: float = 0.0,
    rotation: list[list[float]] | None = None,
) -> pgccd.Contacts:
    count = len(meshes)
    columns = [start, [STILL] * count, end, rotation or [[0.0] * 3] * count]
    tensors = [torch.tensor(column, dtype=torch.float64, device=device) for column in columns]
    motion = pgccd.RigidMotion.from_rotation(*tensors)
    return detected(pgccd.Scene(meshes, device=device), motion, report, separation)


def require_toi(hits: pgccd.Contacts, expected: Fraction, speed: float) -> None:
    """Asserts that toi is not late, and early by no more than the tolerance."""
    assert len(hits) == 1
    assert 0 <= expected - Fraction(float(hits.toi[0])) <= 3e-6 / speed


@pytest.mark.parametrize("moving", ["first", "second", "both"])
def test_fcl_555_two_boxes_moving_towards_each_other(moving: str, device: torch.device) -> None:
    """Meshes away from their origins."""
    meshes = [box((2.0, 2.0, 2.0), (0.0, 0.0, 4.0)), box((2.0, 2.0, 2.0), (0.0, 0.0, -4.0))]
    end = [[0.0, 0.0, -8.0 if moving != "second" else 0.0], [0.0, 0.0, 8.0 if moving != "first" else 0.0]]
    speed = abs(end[0][2] - end[1][2])
    require_toi(detect(meshes, [[0.0] * 3] * 2, end, device), Fraction(6) / Fraction(speed), speed)


def test_python_fcl_11_a_box_that_passes_a_cone(device: torch.device) -> None:
    """The report's reference answer, 0.4316, is late too."""
    hits = detect(
        [box((1.0, 2.0, 3.0)), cone(1.0, 3.0)], [[-10.0, 0.0, 0.0], [0.0] * 3], [[10.0, 0.0, 0.0], [0.0] * 3], device
    )
    require_toi(hits, Fraction(17, 40), 20.0)


def test_physx_505_a_wall_behind_a_grazed_edge(device: torch.device) -> None:
    """A ball, modelled as a speck with its radius as separation, grazes the edge of one surface of a mesh before it
    hits another surface of the same mesh.
    """
    level = [[-4.0, 0.0, -2.0], [0.0, 0.0, -2.0], [0.0, 0.0, 2.0], [-4.0, 0.0, 2.0]]
    wall = [[1.0, -2.0, -2.0], [1.0, 2.0, -2.0], [1.0, 2.0, 2.0], [1.0, -2.0, 2.0]]
    start, way, radius = np.array([-0.78131, 0.3092001, 0.0]), np.array([4.0, -0.3, 0.0]), 0.25
    speck = box((1e-9, 1e-9, 1e-9))
    a, b, c = way @ way, start @ way, start @ start - radius**2
    grazing, at_wall = (-b - math.sqrt(b * b - a * c)) / a, (1.0 - radius - start[0]) / way[0]
    for surfaces in ([level, wall], [wall, level], [wall]):
        meshes = [speck, quads(*surfaces)]
        given = ([start.tolist(), [0.0] * 3], [(start + way).tolist(), [0.0] * 3], device)
        first = detect(meshes, *given, separation=radius)
        expected = grazing if len(surfaces) == 2 else at_wall
        assert len(first) == 1 and expected - 1e-4 < float(first.toi[0]) <= expected
        every = detect(meshes, *given, report="all", separation=radius)
        assert bool(((every.toi <= at_wall) & (every.toi > at_wall - 1e-6)).any()), "the wall is not among them"


def test_physx_509_contact_points_lie_on_both_bodies(device: torch.device) -> None:
    """A box slides over a corner, 2e-5 above it at the end, without touching. With a separation of 1e-4 it touches, at
    points on both surfaces, not at its centre.
    """
    slider = box((0.9, 1.42552, 1.0))
    wall = [[7.0, 2.0, -0.5], [7.0, 3.0, -0.5], [7.0, 3.0, 0.5], [7.0, 2.0, 0.5]]
    level = [[3.0, 3.0, -0.5], [7.0, 3.0, -0.5], [7.0, 3.0, 0.5], [3.0, 3.0, 0.5]]
    start = np.array([6.559144, 3.712804, 0.0])
    end = start + 0.02 * np.array([20.42682, -0.0011445, 0.0])
    given = ([slider, quads(wall, level)], [start.tolist(), [0.0] * 3], [end.tolist(), [0.0] * 3], device)
    assert len(detect(*given, report="all")) == 0
    hits = detect(*given, report="all", separation=1e-4)
    assert len(hits) > 0
    assert torch.allclose(hits.point[:, 1].cpu(), torch.tensor(3.0).double(), atol=1e-4)
    assert bool((hits.point[:, 0] <= 7.0 + 1e-9).all()) and bool((hits.point[:, 2].abs() <= 0.5 + 1e-9).all())
    first = detect(*given, separation=1e-4)
    assert torch.allclose(first.normal.cpu(), torch.tensor([[0.0, -1.0, 0.0]]).double(), atol=1e-6)


def test_isaaclab_5020_boxes_without_margin_on_meshes(device: torch.device) -> None:
    """Boxes that fall through a box, a mesh and a height field in one step, with a margin of 0."""
    rng = np.random.default_rng(0)
    x, y = (k.ravel() for k in np.meshgrid(np.arange(9.0) - 4.0, np.arange(9.0) - 4.0))
    height = 0.2 * rng.random(81)
    a = (9 * np.arange(8)[:, None] + np.arange(8)).ravel()
    faces = np.concatenate([np.stack([a, a + 1, a + 10], axis=1), np.stack([a, a + 10, a + 9], axis=1)])
    field = pgccd.Mesh(torch.from_numpy(np.stack([x, y, height], axis=1)), torch.from_numpy(faces))
    for ground in (
        box((8.0, 8.0, 0.01), (0.0, 0.0, 0.195)),
        quads([[-4, -4, 0.2], [4, -4, 0.2], [4, 4, 0.2], [-4, 4, 0.2]]),
        field,
    ):
        falling = box((0.5, 0.5, 0.5))
        hits = detect([falling, ground], [[0.3, 0.4, 3.0], [0.0] * 3], [[0.3, 0.4, -3.0], [0.0] * 3], device)
        highest = Fraction(float(ground.vertices[:, 2].max()))
        at_highest = (Fraction(11, 4) - highest) / 6
        if ground is not field:
            require_toi(hits, at_highest, 6.0)
        assert at_highest - 1e-6 <= Fraction(float(hits.toi[0])) <= Fraction(11, 24)


def test_newton_3188_a_nut_pushed_through_the_thread_of_its_bolt(device: torch.device) -> None:
    """One pitch along the axis: start and end are clear of the bolt. When screwed on, the nut stays clear."""
    pitch, sides, rows = 0.3, 32, 8
    bolt, nut = thread(1.0, 0.2, pitch, 6, sides, rows), thread(1.03, 0.2, pitch, 2, sides, rows)
    start = [[0.0] * 3, [0.0, 0.0, 2.0 * pitch]]
    pushed = [[0.0] * 3, [0.0, 0.0, pitch]]
    assert len(detect([bolt, nut], start, start, device, "any")) == 0
    assert len(detect([bolt, nut], pushed, pushed, device, "any")) == 0
    hits = detect([bolt, nut], start, pushed, device)
    assert len(hits) == 1 and 0.0 < float(hits.toi[0]) < 0.5
    turn = [[0.0] * 3, [0.0, 0.0, -2.0 * math.pi]]
    assert len(detect([bolt, nut], start, pushed, device, "any", rotation=turn)) == 0
    assert len(detect([bolt, nut], start, pushed, device, "any", rotation=[[0.0] * 3, [0.0, 0.0, 2.0 * math.pi]])) == 1
