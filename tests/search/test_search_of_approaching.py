"""What `approaching` and normals of surfaces examine: not all contacts of a pair, nor all faces of each contact."""

from __future__ import annotations

import math
from typing import Any

import pytest
import torch
from support.calls import Given
from support.hard_scenes import hard_scene
from support.random_scenes import random_scene
from support.resting import KINDS, Kind, box, joined, sheet, sliding
from support.surfaces import surface_normals
from torch import Tensor

import pgccd
from pgccd.contacts.contacts import earliest_of_each
from pgccd.search import approaching as searched
from pgccd.search.approaching import Recession

CUBE = box((0.5, 0.5, 0.5))
WALL = box((0.5, 10, 3), (5, 0, 2.5))
ROOM = joined(box((10, 10, 0.5), (0, 0, -0.5)), WALL)
TILES = joined(sheet(8, 8.0), WALL)  # a hundred contacts before the wall


def same(found: pgccd.Contacts, expected: pgccd.Contacts) -> None:
    """Compares all columns."""
    for name, column in expected.columns.items():
        assert torch.equal(found.columns[name], column), name


def listed(scene: pgccd.Scene, motion: Any, every: pgccd.Contacts) -> pgccd.Contacts:
    """The first contact of each pair that approaches, from all contacts."""
    later = pgccd.approaching(scene, motion, every)
    _, owner = torch.unique(later.pairs, dim=0, return_inverse=True)
    return later[earliest_of_each(owner, len(later), *later._order)]


def take_small_steps(monkeypatch: pytest.MonkeyPatch) -> None:
    """As if there were very many contacts."""
    for name, value in (("_PAIRS", 1), ("_CANDIDATES", 100), ("_FEW_FACES", 0)):
        monkeypatch.setattr(searched, name, value)


# Trajectories, bodies that deform, self-collision, worlds, margins; resting, grazing and intersecting ones.
@pytest.mark.parametrize("seed", [0, 3, 9, 14, 21, 23, 37, 52])
def test_the_first_of_all_contacts_that_approach(seed: int, monkeypatch: pytest.MonkeyPatch) -> None:
    given = Given.of(random_scene(seed) if seed % 2 else hard_scene(seed))
    for more in ({}, {"normals": "surface"}):
        found = given.detect("all")
        pairs, number = torch.unique(found.pairs, dim=0, return_counts=True)
        pairs = pairs[number <= 40][:3]
        hits, every = (given.detect(report, pairs=pairs, **more) for report in ("first", "all"))
        expected = listed(given.bodies, given.motion, every)
        with monkeypatch.context() as patched:
            take_small_steps(patched)
            same(pgccd.approaching(given.bodies, given.motion, hits), expected)


@pytest.mark.parametrize("room", [ROOM, TILES])
@pytest.mark.parametrize("kind", KINDS)
def test_behind_what_rests(kind: Kind, room: pgccd.Mesh, monkeypatch: pytest.MonkeyPatch) -> None:
    scene, motion = sliding(kind, [CUBE, room], (0, 0, 0.5), (8.0, 0, 0))
    hits, every = (pgccd.detect(scene, motion, report) for report in ("first", "all"))  # type: ignore[call-overload]
    expected = listed(scene, motion, every)
    take_small_steps(monkeypatch)
    found = pgccd.approaching(scene, motion, hits)
    assert float(found.toi[0]) > 0.4
    same(found, expected)


def spheres(count: int, subdivisions: int) -> tuple[pgccd.Scene, pgccd.RigidMotion]:
    """Spheres that intersect, and turn."""
    random = torch.Generator().manual_seed(2)
    x, v, w = (torch.randn(count, 3, generator=random, dtype=torch.float64) for _ in range(3))
    q = torch.nn.functional.normalize(torch.randn(count, 4, generator=random, dtype=torch.float64))
    scene = pgccd.Scene([pgccd.Mesh.icosphere(1.0, subdivisions)], [0] * count)
    return scene, pgccd.RigidMotion.from_rotation(0.7 * x, q, 0.7 * x + v, 3.0 * w)


def test_few_contacts_are_listed_and_tested(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of bodies that intersect the contacts until the first edge in a face are enough."""
    scene, motion = spheres(8, 2)
    every = len(pgccd.detect(scene, motion, "all", 0.06))
    hits = pgccd.detect(scene, motion, "first", 0.06)
    counts = {"listed": 0, "tested": 0}
    list_until, is_certain = searched._Search._until, Recession.is_certain

    def count_listed(*given: Any) -> Any:
        found = list_until(*given)
        counts["listed"] += len(found[0])
        return found

    def count_tested(self: Recession, contacts: pgccd.Contacts, bodies: Tensor) -> Tensor:
        counts["tested"] += len(contacts)
        return is_certain(self, contacts, bodies)

    monkeypatch.setattr(searched._Search, "_until", count_listed)
    monkeypatch.setattr(Recession, "is_certain", count_tested)
    found = pgccd.approaching(scene, motion, hits)
    assert len(found) == len(hits) == 28 and (found.toi == 0.0).all() and found != hits
    assert every > 50_000 and 0 < counts["listed"] < every / 10 and 28 < counts["tested"] < every / 50


def cone(sectors: int, up: float, has_lid: bool = True) -> pgccd.Mesh:
    """With its tip at the origin."""
    angle = torch.arange(sectors, dtype=torch.float64) * (2.0 * math.pi / sectors)
    rim = torch.stack([angle.cos(), angle.sin(), torch.full_like(angle, up)], 1)
    vertices = torch.cat([torch.tensor([[0.0, 0, 0], [0, 0, up]], dtype=torch.float64), rim])
    k, zero = torch.arange(sectors), torch.zeros(sectors, dtype=torch.int64)
    faces = torch.stack([zero, 2 + (k + 1) % sectors, 2 + k], 1)
    if has_lid:
        faces = torch.cat([faces, torch.stack([zero + 1, 2 + k, 2 + (k + 1) % sectors], 1)])
    return pgccd.Mesh(vertices, faces if up > 0.0 else faces.flip(1))


def tips(meshes: list[pgccd.Mesh], turn: float = 0.0) -> tuple[pgccd.Scene, pgccd.RigidMotion]:
    """Tips that meet halfway."""
    x = torch.tensor([[0.0, 0, 0.5], [0, 0, 0]], dtype=torch.float64)
    upright = torch.tensor([[1.0, 0, 0, 0]] * 2, dtype=torch.float64)
    v, w = (torch.tensor([[0.0, 0, each], [0, 0, 0]], dtype=torch.float64) for each in (-1.0, turn))
    return pgccd.Scene(meshes), pgccd.RigidMotion.from_velocity(x, upright, v, w, 1.0)


@pytest.mark.parametrize("has_lid", [True, False])
@pytest.mark.parametrize("turn", [0.0, 0.4])
def test_normals_of_contacts_with_the_same_surfaces(has_lid: bool, turn: float) -> None:
    """They are those that each contact has alone; of stars too, of whose sides nothing but the features tells."""
    star = cone(4, 1.0, has_lid)
    vertices = star.vertices.clone()
    vertices[2::2, 2] = -0.3
    for meshes in ([cone(7, 1.0, has_lid), cone(5, -1.0, has_lid)], [pgccd.Mesh(vertices, star.faces), star]):
        scene, motion = tips(meshes, turn)
        if meshes[1] is star:
            motion = pgccd.RigidMotion.at_rest(torch.zeros_like(motion.position_t0), motion.orientation_t0)
        hits = pgccd.detect(scene, motion, "all")
        together = surface_normals(scene, motion, hits)
        alone = [surface_normals(scene, motion, hits[k : k + 1]) for k in range(len(hits))]
        assert len(hits) > 30 and torch.equal(together, torch.cat(alone))
