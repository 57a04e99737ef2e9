"""The oracle of winding numbers, against solid angles, lattices and integers."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from support import solids
from support.solids import Surface

from oracle.intersection import as_integers, sign, volume
from oracle.winding import winding_numbers

TETRAHEDRON = np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]])


def solid_angles(points: np.ndarray, corners: np.ndarray) -> np.ndarray:
    """(P,) winding numbers as sums of solid angles (Van Oosterom & Strackee 1983), in floats."""
    a, b, c = (corners[None, :, k] - points[:, None] for k in range(3))
    la, lb, lc = (np.linalg.norm(x, axis=2) for x in (a, b, c))
    below = la * lb * lc + (a * b).sum(axis=2) * lc + (b * c).sum(axis=2) * la + (c * a).sum(axis=2) * lb
    return np.arctan2((a * np.cross(b, c)).sum(axis=2), below).sum(axis=1) / (2 * np.pi)


@pytest.mark.parametrize("surface", [solids.ball(2), solids.torus(), solids.joined(solids.ball(), solids.torus())])
def test_winding_numbers_against_solid_angles(surface: Surface) -> None:
    vertices, faces = surface
    points = np.random.default_rng(1).uniform(-2.6, 2.6, (2000, 3)) * [1, 1, 0.4]
    for turned, sense in ((faces, 1), (faces[:, ::-1], -1)):
        found = winding_numbers(points, vertices[turned])
        assert np.array_equal(found, np.rint(solid_angles(points, vertices[turned])))
        assert set(found) == {0, sense}


@pytest.mark.parametrize("shear", [np.eye(3), [[1, 2, 0], [0, 1, 0], [1, -1, 1]]], ids=["straight", "sheared"])
def test_rays_through_vertices_and_along_edges_and_faces(shear: Any) -> None:
    """Cubes on a lattice: from their midpoints and from empty lattice points rays meet vertices, edges and squares."""
    rng = np.random.default_rng(2)
    for _ in range(20):
        filled = rng.random((4, 4, 4)) < rng.uniform(0.2, 0.8)
        filled[0, 0, 0] = True
        vertices, faces = solids.voxels(filled)
        cube = np.argwhere(np.ones((6, 6, 6))) - 1
        truth = np.pad(filled, 1)[tuple((cube + 1).T)]
        # A point on the lattice is off the surface if the eight cubes around it are alike.
        around = np.stack([np.pad(filled, 2)[tuple((cube + 1 + s).T)] for s in np.argwhere(np.ones((2, 2, 2)))])
        alike = (around == around[0]).all(axis=0)
        points = np.concatenate([cube + 0.5, cube[alike]])
        expected = np.concatenate([truth, around[0][alike]])
        assert np.array_equal(winding_numbers(points @ np.array(shear), (vertices @ np.array(shear))[faces]), expected)


@pytest.mark.parametrize(("offset", "scale"), [(0.0, 1.0), (10.0, 1.0), (1e6, 1.0), (0.0, 1e-107), (0.0, 1e120)])
def test_undecided_signs_are_exact(offset: float, scale: float) -> None:
    """Points a few units of rounding off the faces of tetrahedra; and where products underflow or overflow."""
    rng = np.random.default_rng(5)
    faces = TETRAHEDRON
    near = 0
    for vertices in scale * rng.normal(size=(40, 4, 3)) + offset:
        middle = np.einsum("fk,fkd->fd", rng.dirichlet(np.full(3, 5.0), 4), vertices[faces])
        points = middle[:, None] + np.spacing(middle)[:, None] * rng.integers(-2, 3, (4, 20, 3))
        whole = as_integers(np.concatenate([vertices, points.reshape(-1, 3)]))
        corners = np.repeat(whole[:4][faces], 20, axis=0)
        side = sign(volume(*np.moveaxis(corners, 1, 0), whole[4:]))
        turn = sign(volume(*whole[:4, None]))[0]  # whether the faces face outwards
        off = side != 0
        found = winding_numbers(points.reshape(-1, 3)[off], vertices[faces])
        assert np.array_equal(found, np.where(side[off] == -turn, turn, 0))
        near += off.sum()
    assert near > 2000


def test_tiny_and_huge() -> None:
    for scale in (1e-30, 1e30):
        vertices, faces = solids.ball(1, scale)
        points = np.array([[0, 0, 0], [0.7, 0, 0], [1.01, 0, 0], [0, 0, -0.5], [0, 2, 0]]) * scale
        assert winding_numbers(points, vertices[faces]).tolist() == [1, 1, 0, 1, 0]
