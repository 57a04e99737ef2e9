"""Slabs up to a horizon: required thickness for a flat sheet that turns in the step.

On arcs, about an axis in its plane: the sheet's ends rise fastest.

On straight paths, turned by about pi about an axis k at a small angle to its normal n: halfway through, the paths
shrink the sheet. Up to a small horizon h its far end rises by up to 3 h |k.n| |k x n| times its distance from a node's
centre, measured along the mean of the slab's two normals, which themselves are only 2 h |k x n| apart.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Literal

import numpy as np
import pytest
import torch
from support.candidates import assert_all_there, candidates, moving
from support.cases import few_and_many
from support.shapes import Bodies, tetrahedron
from support.truth import linear_truth

import pgccd

TINY = 2e-4


def sheet(squares: int = 24) -> pgccd.Mesh:
    """Flat and narrow, from x = -1 to 1: its nodes form a row."""
    x = np.linspace(-1.0, 1.0, squares + 1)
    vertices = np.array([[a, b, 0.0] for a in x for b in (-0.02, 0.02)])
    corner = 2 * np.arange(squares)[:, None]
    return pgccd.Mesh(vertices, np.concatenate([corner + [0, 2, 1], corner + [1, 2, 3]]))


def turning(rng: np.random.Generator, other: pgccd.Mesh, leans: tuple[float, float] = (0.2, 0.8)) -> Bodies:
    """A sheet that turns over, about an axis at such an angle to its normal, and a body at rest, both at the origin."""
    lean = rng.uniform(*leans)
    axis = np.array([np.sin(lean), 0.0, np.cos(lean)])
    spin = np.stack([rng.uniform(0.9, 0.999) * np.pi * axis, np.zeros(3)])
    return Bodies([sheet(), other], np.zeros((2, 3)), np.tile([1.0, 0, 0, 0], (2, 1)), np.zeros((2, 3)), spin)


def sheet_ends(bodies: Bodies) -> tuple[np.ndarray, np.ndarray]:
    """The sheet's vertices (V, 3) at both ends of the step, float64."""
    start, spin = bodies.meshes[0].vertices.numpy(), bodies.rotation[0]
    angle = np.linalg.norm(spin)
    axis = spin / angle
    along = np.outer(start @ axis, axis)
    return start, along + np.cos(angle) * (start - along) + np.sin(angle) * np.cross(axis, start)


def moved(bodies: Bodies, where: np.ndarray) -> Bodies:
    return replace(bodies, position_t0=np.stack([np.zeros(3), where]))


@pytest.mark.parametrize("rises_most", [False, True])
@few_and_many("count", 10, 25)
def test_a_turning_sheet_meets_a_speck_before_the_horizon(device: torch.device, rises_most: bool, count: int) -> None:
    """Anywhere, or where the sheet rises most: at its ends, about an axis between the sheet and its normal."""
    rng = np.random.default_rng(1)
    for _ in range(count):
        bodies = turning(rng, tetrahedron(TINY), (0.7, 0.85) if rises_most else (0.2, 0.8))
        start, end = sheet_ends(bodies)
        until = rng.uniform(0.02, 0.2 if rises_most else 0.5)
        t = until * rng.uniform(0.9 if rises_most else 0.7, 0.95)
        vertex = rng.choice([0, 1, len(start) - 2, len(start) - 1]) if rises_most else rng.integers(len(start))
        bodies = moved(bodies, (1 - t) * start[vertex] + t * end[vertex] + 0.2 * TINY * rng.normal(size=3))
        rest = bodies.meshes[1].vertices.numpy() + bodies.position_t0[1]
        truth = linear_truth([[start, end], [rest, rest]], [m.faces.long().numpy() for m in bodies.meshes])
        assert any(c.toi_upper <= until for c in truth.contacts)
        assert_all_there(candidates(moving(bodies, device, "linear"), horizon=[until])[0], truth, until)


@pytest.mark.parametrize("turn", [1.0, 2.5, 6.0, 15.0, 200.0])
def test_a_sheet_on_arcs_meets_a_speck_before_the_horizon(device: torch.device, turn: float) -> None:
    """The sheet turns about an axis in its plane: up to a horizon its ends rise by up to the horizon's part of the
    turn, however large the whole turn is. The earliest contact of the scene is searched up to a contact of another
    pair.
    """
    plate = pgccd.Mesh([[-1, -1, 0], [1, -1, 0], [-1, 1, 0], [1, 1, 0]], [[0, 1, 2], [1, 3, 2]])
    speck, found = tetrahedron(TINY), 0
    for until in np.geomspace(0.2, 0.9, 5) / max(turn, 1.0):
        for part in (0.2, 0.9, 0.99):
            t = part * until
            place = 0.98 * np.array([np.cos(turn * t), 0.0, -np.sin(turn * t)])
            positions = np.array([[0.0, 0.0, 0.0], place, [100.0, 0.0, 0.0], [100.0, 0.0, 0.01]])
            velocities = np.zeros((4, 3))
            # The speck comes from the side; the plates touch at the horizon.
            positions[1, 1], velocities[1, 1] = -0.2 * part, 0.2 / until
            velocities[3, 2] = -0.01 / until
            spins = np.zeros((4, 3))
            spins[0, 1] = turn
            meshes = [sheet(), speck, plate, plate]
            bodies = Bodies(meshes, positions, np.tile([1.0, 0, 0, 0], (4, 1)), velocities, spins)
            scene, motion = bodies.scene(device), bodies.motion("rigid", device)
            every, earliest = (pgccd.detect(scene, motion, report) for report in ("all", "earliest"))
            assert torch.equal(earliest.toi[0], every.toi.min())
            if every.toi.min() >= until or every.pairs[every.toi.argmin()].tolist() != [0, 1]:
                continue
            found += 1
            horizon = torch.tensor([until], dtype=torch.float64, device=device)
            pair = torch.tensor([[0, 1]], device=device)
            rows, _ = pgccd.traverse.find_candidates(pgccd.MovingBodies.of(scene, motion), pair, horizon=horizon)
            assert len(rows) > 0
    assert found >= 10


def with_floor(speck: np.ndarray, height: float) -> pgccd.Mesh:
    """A speck, and a floor below the sheet's other end: the search for a likely first contact starts with the floor."""
    tetra = tetrahedron(TINY)
    corners = np.array([[x, y, height] for x in (-1.2, -0.2) for y in (-0.4, 0.4)])
    vertices = np.concatenate([tetra.vertices.numpy() + speck, corners])
    # Far below, so that speck and floor are in different leaves.
    cellar = np.array([[0.01 * k, 0.0, -3.0 - 0.1 * k] for k in range(3)])
    faces = np.concatenate([tetra.faces.numpy(), [[4, 5, 6], [5, 7, 6]], np.tile([[8, 9, 10]], (8, 1))])
    return pgccd.Mesh(np.concatenate([vertices, cellar]), faces)


@pytest.mark.parametrize("report", ["first", "earliest"])
def test_the_first_contact_is_not_the_likely_one(device: torch.device, report: Literal["first", "earliest"]) -> None:
    rng = np.random.default_rng(3)
    before = 0
    for _ in range(40):
        bodies = turning(rng, tetrahedron(TINY))
        start, end = sheet_ends(bodies)
        late = rng.uniform(0.1, 0.3)
        early, vertex = late * rng.uniform(0.7, 0.95), rng.integers(26, len(start))
        mesh = with_floor((1 - early) * start[vertex] + early * end[vertex], late * (end[0, 2] - start[0, 2]))
        bodies = replace(bodies, meshes=[bodies.meshes[0], mesh])
        scene, motion = bodies.scene(device), bodies.motion("linear", device)
        every, first = (pgccd.detect(scene, motion, r) for r in ("all", report))
        assert torch.equal(first.toi[0], every.toi.min())
        before += bool(((every.toi > first.toi[0]) & (every.toi < 0.5)).any())
    assert before > 15
