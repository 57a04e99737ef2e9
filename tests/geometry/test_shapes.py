"""Meshes of simple shapes."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
import torch

import pgccd
from pgccd.geometry.solids import opening


def volume(mesh: pgccd.Mesh) -> float:
    a, b, c = mesh.vertices[mesh.faces.long()].unbind(1)
    return float((a * torch.linalg.cross(b, c)).sum() / 6.0)


def require_closed(mesh: pgccd.Mesh) -> None:
    assert opening(mesh.faces.numpy()) is None
    assert len(mesh.vertices) - len(mesh.edges) + len(mesh.faces) == 2  # Euler's formula: one closed component
    assert mesh.origin.tolist() == [0.0, 0.0, 0.0]


def test_box() -> None:
    mesh = pgccd.Mesh.box([1.0, 2.0, 4.0])
    require_closed(mesh)
    assert volume(mesh) == pytest.approx(8.0)
    assert mesh.vertices.amin(0).tolist() == [-0.5, -1.0, -2.0] and mesh.vertices.amax(0).tolist() == [0.5, 1.0, 2.0]
    for extents in (np.array([1, 2, 4]), torch.tensor([1.0, 2.0, 4.0]), (1, 2, 4)):
        assert torch.equal(pgccd.Mesh.box(extents).vertices, mesh.vertices)


@pytest.mark.parametrize("subdivisions", range(5))
def test_sphere(subdivisions: int) -> None:
    mesh = pgccd.Mesh.icosphere(0.3, subdivisions)
    require_closed(mesh)
    assert len(mesh.faces) == 20 * 4**subdivisions
    assert torch.allclose(mesh.vertices.norm(dim=1), torch.tensor(0.3, dtype=torch.float64), rtol=1e-15)
    whole = 4.0 / 3.0 * math.pi * 0.3**3
    # The error of a subdivided surface falls by a factor of four a level; an icosahedron has 0.605 of the volume.
    assert 1.0 - 0.6 / 4**subdivisions < volume(mesh) / whole < 1.0
    if subdivisions == 3:  # as the documentation says
        depth = 1.0 - mesh.vertices[mesh.faces.long()].mean(1).norm(dim=1) / 0.3
        assert 0.004 < float(depth.max()) < 0.0065


@pytest.mark.parametrize("sections", [3, 4, 32])
def test_cylinder(sections: int) -> None:
    mesh = pgccd.Mesh.cylinder(0.5, 2.0, sections)
    require_closed(mesh)
    assert len(mesh.faces) == 4 * sections
    area = 0.5 * sections * 0.25 * math.sin(2.0 * math.pi / sections)
    assert volume(mesh) == pytest.approx(2.0 * area)
    assert mesh.vertices[:, 2].abs().unique().tolist() == [1.0]


@pytest.mark.parametrize(
    ("make", "name"),
    [
        (lambda: pgccd.Mesh.box(1.0), "extents"),
        (lambda: pgccd.Mesh.box([1.0, 2.0]), "extents"),
        (lambda: pgccd.Mesh.box([1.0, 0.0, 1.0]), r"extents\[1\]"),
        (lambda: pgccd.Mesh.box([1.0, 1.0, math.inf]), r"extents\[2\]"),
        (lambda: pgccd.Mesh.icosphere(-1.0), "radius"),
        (lambda: pgccd.Mesh.icosphere("1"), "radius"),  # type: ignore[arg-type]
        (lambda: pgccd.Mesh.icosphere(1.0, 9), "subdivisions"),
        (lambda: pgccd.Mesh.icosphere(1.0, 1.5), "subdivisions"),  # type: ignore[arg-type]
        (lambda: pgccd.Mesh.cylinder(math.nan, 1.0), "radius"),
        (lambda: pgccd.Mesh.cylinder(1.0, 0.0), "height"),
        (lambda: pgccd.Mesh.cylinder(1.0, 1.0, 2), "sections"),
    ],
)
def test_wrong_arguments_are_named(make: Any, name: str) -> None:
    with pytest.raises((TypeError, ValueError), match=f"^{name}: expected"):
        make()


def test_origins() -> None:
    joint = (0.0, 0.0, -0.5)
    for mesh in (
        pgccd.Mesh.box([0.2, 0.2, 1.0], origin=joint),
        pgccd.Mesh.cylinder(0.1, 1.0, origin=joint),
        pgccd.Mesh.icosphere(0.5, origin=joint),
    ):
        assert mesh.origin.tolist() == [0.0, 0.0, -0.5]
        assert float(mesh.vertices[:, 2].amin()) == pytest.approx(0.0, abs=0.01)
