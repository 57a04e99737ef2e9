"""Margins of the bounds: nodes completely filled by their vertices, in exact arithmetic or nearly so."""

from __future__ import annotations

from fractions import Fraction

import numpy as np
import pytest
import torch
from strategies import contacts
from support.cases import few_and_many
from support.hierarchies import assert_encloses, prepared
from support.shapes import bumpy, directions, tensors, turned, unit_quaternions

import pgccd


def refitted(
    mesh: pgccd.Mesh, ends: list[np.ndarray]
) -> tuple[pgccd.MovingBodies, list[np.ndarray], list[np.ndarray], tuple[np.ndarray, np.ndarray]]:
    """A deforming body, its node blocks at both ends, its vertices at both ends relative to its centre, triangles and
    links.
    """
    bodies = pgccd.MovingBodies.of(pgccd.Scene([mesh]), pgccd.VertexMotion(*tensors(*ends)))
    centres = (bodies.position_t0.numpy(), bodies.position_t1.numpy())
    triangles, _, links = prepared(mesh)
    blocks = [t.numpy() for t in bodies.tensors[6:8]]
    return bodies, blocks, [x - c for x, c in zip(ends, centres, strict=True)], (triangles, links)


def assert_refit_encloses(mesh: pgccd.Mesh, ends: list[np.ndarray]) -> None:
    """Asserts enclosure at both ends, and so by convexity between them."""
    _, blocks, local, (triangles, links) = refitted(mesh, ends)
    for block, x in zip(blocks, local, strict=True):
        assert_encloses(block, links, triangles, x)


def test_vertices_are_rounded_once(device: torch.device) -> None:
    """Of deforming bodies, culling reads differences from their centres, in float32; of unused vertices too."""
    rng = np.random.default_rng(4)
    meshes = [bumpy(rng, level) for level in (0, 2, 1)]
    meshes.append(pgccd.Mesh(np.vstack([meshes[0].vertices, [[9.0, 9.0, 9.0]]]), meshes[0].faces))
    scene = pgccd.Scene(meshes, [3, 1, 0, 1, 2], device=device)
    counts = [len(meshes[k].vertices) for k in scene.mesh_index.tolist()]
    ends = [1e3 * rng.normal(size=(5, 3)).repeat(counts, axis=0) + rng.normal(size=(sum(counts), 3)) for _ in range(2)]
    bodies = pgccd.MovingBodies.of(scene, pgccd.VertexMotion(*tensors(*ends, device=device)))
    body = np.repeat(np.arange(5), counts)
    for end, (x, centre) in enumerate(zip(ends, (bodies.position_t0, bodies.position_t1), strict=True)):
        expected = (x - centre.cpu().numpy()[body]).astype(np.float32)
        local = bodies.tensors[-1][:, end].cpu().numpy()
        assert np.array_equal(local[:, :3], expected) and not local[:, 3].any()


def pointing(rng: np.random.Generator, mesh: pgccd.Mesh, along: np.ndarray) -> np.ndarray:
    """Vertices with the x axis turned to a direction, and rolled about it."""
    q = contacts.leading(along / np.linalg.norm(along), rng.uniform(0, 6))
    return turned(np.tile(q, (len(mesh.vertices), 1)), mesh.vertices.numpy())


@pytest.mark.parametrize("level", [4, 5, 6])
def test_refit_of_slender_spindles(level: int) -> None:
    """Along an axis, or a diagonal of their box: each kind of bound of a large node is attained."""
    rng = np.random.default_rng([1, level])
    for along in ([1.0, 0, 0], [0, 1.0, 0], [1.0, 1.0, 1.0], [1.0, -1.0, 1.0], *directions(rng, 6)):
        for width in (1e-4, 0.01):
            mesh = contacts.spindle(width, level)
            x = pointing(rng, mesh, np.array(along))
            assert_refit_encloses(mesh, [x, x])
            assert_refit_encloses(mesh, [x, 1.5 * x + rng.normal(size=3)])
            flipped = pgccd.Mesh(mesh.vertices, mesh.faces.flip(1))
            assert_refit_encloses(flipped, [x, x])


def boxes(cells: int) -> pgccd.Mesh:
    """A cube with `cells` squares per side: its corners are those of its box."""
    sheet = contacts.plate(cells)
    face, count = sheet.vertices.numpy() + [1.0, 0.0, 0.0], len(sheet.vertices)
    turns = [np.eye(3)[list(order)] * way for order in ((0, 1, 2), (1, 2, 0), (2, 0, 1)) for way in (1.0, -1.0)]
    faces = np.concatenate([sheet.faces.numpy() + k * count for k in range(6)])
    return pgccd.Mesh(np.concatenate([face @ turn for turn in turns]), faces)


def test_refit_of_cubes() -> None:
    """The farthest vertices are at the box's corners."""
    mesh = boxes(4)
    x = mesh.vertices.numpy()
    assert_refit_encloses(mesh, [x, x])
    assert_refit_encloses(mesh, [x, x * [1.0, 2.0, 3.0]])


def test_refit_at_random() -> None:
    rng = np.random.default_rng(2)
    for _ in range(12):
        mesh = bumpy(rng, 3)
        ends = [mesh.vertices.numpy() + rng.normal(size=3) for _ in (0, 1)]
        assert_refit_encloses(mesh, [ends[0], 2.0 * ends[1]])


@few_and_many("count", 400, 1500)
def test_refit_of_single_triangles(count: int) -> None:
    """Flat and tiny slabs, whose bounds consist almost only of rounding."""
    rng = np.random.default_rng(3)
    for _ in range(count):
        corners = rng.normal(size=(3, 3))
        mesh = pgccd.Mesh(corners, [[0, 1, 2]])
        assert_refit_encloses(mesh, [corners, corners])


def test_radius_of_bodies_that_deform() -> None:
    """The radius encloses every vertex at both ends exactly."""
    rng = np.random.default_rng(4)
    mesh = bumpy(rng, 0)
    for _ in range(100):
        ends = [rng.normal(size=mesh.vertices.shape) for _ in (0, 1)]
        bodies, _, _, _ = refitted(mesh, ends)
        square = Fraction(float(bodies.radius[0])) ** 2
        for x, centre in zip(ends, (bodies.position_t0, bodies.position_t1), strict=True):
            c = [Fraction(v) for v in centre[0].tolist()]
            assert max(sum((Fraction(v) - w) ** 2 for v, w in zip(p, c, strict=True)) for p in x.tolist()) <= square


def test_centres_are_summed_in_chunks() -> None:
    """In one order on all devices and for any number of threads: 256 faces at a time, then these sums."""
    rng = np.random.default_rng(5)
    mesh = bumpy(rng, 3)
    x = rng.normal(size=mesh.vertices.shape) * 10.0 ** rng.uniform(-8, 8, mesh.vertices.shape)
    bodies, _, _, _ = refitted(mesh, [x, x])
    faces = mesh.faces.long().numpy()
    total = np.zeros(3)
    for begin in range(0, len(faces), 256):
        chunk = np.zeros(3)
        for corner in x[faces[begin : begin + 256]].reshape(-1, 3):
            chunk = chunk + corner
        total = total + chunk
    assert len(faces) > 1000
    assert np.array_equal(bodies.position_t0.numpy()[0], (1.0 / (3.0 * len(faces))) * total)


def test_hierarchy_of_meshes() -> None:
    rng = np.random.default_rng(6)
    for _ in range(12):
        turn = unit_quaternions(rng, 1)
        for mesh in (bumpy(rng, 2), contacts.spindle(0.1, 4), contacts.plate(8)):
            x = turned(np.repeat(turn, len(mesh.vertices), axis=0), mesh.vertices.numpy())
            posed = pgccd.Mesh(x, mesh.faces, "centroid")
            triangles, blocks, links = prepared(posed)
            assert_encloses(blocks, links, triangles, posed.vertices.numpy())


@few_and_many("count", 800, 3000)
def test_hierarchy_of_single_triangles(count: int) -> None:
    rng = np.random.default_rng(7)
    for _ in range(count):
        mesh = pgccd.Mesh(rng.normal(size=(3, 3)), [[0, 1, 2]], "centroid")
        triangles, blocks, links = prepared(mesh)
        assert_encloses(blocks, links, triangles, mesh.vertices.numpy())


def test_radius_of_a_mesh() -> None:
    """The radius encloses every vertex exactly, as stored."""
    rng = np.random.default_rng(8)
    for _ in range(200):
        mesh = pgccd.Mesh(torch.from_numpy(rng.normal(size=(4, 3))), [[0, 1, 2], [1, 2, 3]], "centroid")
        square = Fraction(mesh.radius) ** 2
        assert max(sum(Fraction(c) ** 2 for c in p) for p in mesh.vertices.tolist()) <= square
