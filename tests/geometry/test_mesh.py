"""Meshes: bounds, edges, representatives and hierarchy, on any triangles."""

from __future__ import annotations

import itertools
import math
from fractions import Fraction

import numpy as np
import pytest
import strategies
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from oracle.mesh import sphere_bound, unique_edges, used_vertices
from support.hierarchies import WIDTH, Hierarchy, assert_encloses, prepared, walk
from support.shapes import bumpy

import pgccd
from pgccd import ops
from pgccd.geometry.mesh import LEAF_SIZE

MOST_DEPTH = 48


@given(strategies.extended_meshes())
@settings(max_examples=80)
def test_sphere_bound_and_edges(shape: strategies.TriMesh) -> None:
    mesh = pgccd.Mesh(shape.vertices, shape.faces)
    truth = sphere_bound(shape.vertices, shape.faces)
    size = max(np.abs(shape.vertices).max(), truth.radius)
    assert np.abs(mesh.centre.numpy() - truth.center).max() <= 1e-14 * size
    assert mesh.radius == pytest.approx(truth.radius, rel=1e-14, abs=1e-14 * size)
    # The radius encloses every used vertex, as stored.
    used = mesh.vertices[used_vertices(shape.faces)].tolist()
    offset = mesh.centre_offset.tolist()
    local = [[Fraction(c) - Fraction(o) for c, o in zip(p, offset, strict=True)] for p in used]
    assert max(sum(c * c for c in p) for p in local) <= Fraction(mesh.radius) ** 2
    assert max(sum(Fraction(c) ** 2 for c in p) for p in used) <= Fraction(mesh.reach) ** 2
    assert np.array_equal(mesh.vertices.numpy(), shape.vertices)
    centred = pgccd.Mesh(shape.vertices, shape.faces, "centroid")
    assert np.abs(centred.vertices.numpy() + centred.centre.numpy() - shape.vertices).max() <= 4e-16 * size
    assert (centred.radius, centred.reach, centred.centre_offset.any()) == (mesh.radius, centred.radius, False)
    assert np.array_equal(mesh.edges.numpy(), unique_edges(shape.faces))
    assert np.array_equal(mesh.faces.numpy(), shape.faces)


@given(strategies.extended_meshes())
@settings(max_examples=80)
def test_every_feature_is_represented_once(shape: strategies.TriMesh) -> None:
    mesh = pgccd.Mesh(shape.vertices, shape.faces)
    triangles, _, links = prepared(mesh)
    vertices, edges = [], []
    for row in triangles.tolist():
        corner, edge, face, represented = row[:3], row[3:6], row[6], row[7]
        assert corner == shape.faces[face].tolist()
        for k in range(3):
            assert mesh.edges[edge[k]].tolist() == sorted((corner[k], corner[(k + 1) % 3]))
            if represented >> k & 1:
                vertices.append(corner[k])
            if represented >> (3 + k) & 1:
                edges.append(edge[k])
        assert represented < 64
    assert sorted(vertices) == used_vertices(shape.faces).tolist()
    assert sorted(edges) == list(range(len(mesh.edges)))
    assert sorted(triangles[:, 6]) == list(range(len(shape.faces)))


@given(strategies.extended_meshes())
@settings(max_examples=60)
def test_hierarchy(shape: strategies.TriMesh) -> None:
    mesh = pgccd.Mesh(shape.vertices, shape.faces)
    triangles, blocks, links = prepared(mesh)
    nodes, depth = walk(links)
    leaves = sorted((first, count) for node, first, count in nodes if links[node // WIDTH, node % WIDTH, 1])
    assert all(1 <= count <= 8 for _, count in leaves)
    covered = [k for first, count in leaves for k in range(first, first + count)]
    assert covered == list(range(len(shape.faces))), "every triangle is in exactly one leaf"
    assert depth <= MOST_DEPTH
    assert np.isnan(blocks.transpose(0, 2, 1)[links[:, :, 1] < 0]).all(), "empty slots meet nothing"
    # Relative to the SBV centre.
    assert_encloses(blocks, links, triangles, (mesh.vertices - mesh.centre_offset).numpy())


@pytest.mark.parametrize("count", [3000])
def test_depth_is_bounded_where_areas_halve(count: int) -> None:
    # Each triangle is half as large as the one before: a cost-driven split alone would separate them one by one.
    size = 0.9 ** np.arange(count)[:, None, None] + 1e-12
    vertices = (np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]]) * size + size).reshape(-1, 3)
    mesh = pgccd.Mesh(vertices, np.arange(3 * count).reshape(-1, 3))
    assert walk(prepared(mesh)[2])[1] <= MOST_DEPTH


@given(strategies.extended_meshes(), st.integers(0, 2**32 - 1), st.sampled_from([1e-6, 1.0, 1e6]))
@settings(max_examples=40)
def test_refit_encloses_the_whole_step(shape: strategies.TriMesh, seed: int, scale: float) -> None:
    rng = np.random.default_rng(seed)
    mesh = pgccd.Mesh(shape.vertices, shape.faces)
    far = rng.choice([0.0, 1e3]) * scale
    ends = [scale * (shape.vertices + rng.normal(size=shape.vertices.shape)) + far for _ in range(2)]
    scene = pgccd.Scene([mesh])
    bodies = pgccd.MovingBodies.of(scene, pgccd.VertexMotion(*(torch.from_numpy(x) for x in ends)))
    triangles, _, links = prepared(mesh)
    centre_t0, centre_t1, radius = (t.numpy() for t in (bodies.position_t0, bodies.position_t1, bodies.radius))
    blocks = [t.numpy() for t in bodies.tensors[6:8]]
    assert np.array_equal(blocks[0][:, 3], blocks[1][:, 3], equal_nan=True), "one radius serves both ends"
    used = used_vertices(shape.faces)
    local = [x - c for x, c in zip(ends, (centre_t0, centre_t1), strict=True)]
    for x, centre in zip(ends, (centre_t0, centre_t1), strict=True):
        assert np.abs(sphere_bound(x, shape.faces).center - centre[0]).max() <= 1e-13 * np.abs(x).max()
    for t in (0.0, 0.3, 0.5, 1.0):
        s = np.longdouble(t)
        x = (1 - s) * local[0] + s * local[1]
        assert np.sqrt((x[used] ** 2).sum(axis=1)).max() <= radius[0]
        blend = (1 - s) * blocks[0].astype(np.longdouble) + s * blocks[1].astype(np.longdouble)
        blend[:, 3:] = blocks[0][:, 3:]  # one radius and one slab for both ends
        assert np.array_equal(blocks[0][:, 3:], blocks[1][:, 3:], equal_nan=True)
        assert_encloses(blend, links, triangles, x)


def test_set_offsets_and_padding() -> None:
    rng = np.random.default_rng(0)
    meshes = [bumpy(rng, 1), bumpy(rng, 0), bumpy(rng, 2)]
    joined = pgccd.MeshSet(meshes)
    vertices, faces, edges, triangles = joined.tensors[:4]
    for k, mesh in enumerate(meshes):
        low, high = joined.offsets[k].tolist(), joined.offsets[k + 1].tolist()
        assert torch.equal(vertices[low[0] : high[0]], mesh.vertices)
        assert torch.equal(faces[low[1] : high[1]], mesh.faces)
        assert torch.equal(edges[low[2] : high[2]], mesh.edges)
        assert torch.equal(joined.tensors[6][low[4] : high[4]], Hierarchy.of(mesh).leaf_points)
        assert joined.radius[k] == mesh.radius
    assert len(triangles) == sum(len(m.faces) for m in meshes)


def test_leaves_list_the_vertices_of_their_triangles() -> None:
    """Each vertex once, eight per row; the last one fills the row. Leaves of a strip have more than eight vertices."""
    strip = np.array([[k // 2, k % 2, 0.1 * k] for k in range(30)], dtype=float)
    faces = np.array([[k, k + 1, k + 2] for k in range(28)])
    lengths = set()
    for mesh in (bumpy(np.random.default_rng(0), 2), pgccd.Mesh(strip, faces, origin="centroid")):
        triangles, _, links, leaf_points, _ = Hierarchy.of(mesh)
        x = (mesh.vertices - mesh.centre_offset).float()
        for first, count, row, rows in links.view(-1, 4).tolist():
            if count <= 0:
                assert rows == 0
                continue
            points = leaf_points[row : row + rows]
            listed = points[:, 3].reshape(-1).tolist()
            used = sorted(set(triangles[first : first + count, :3].reshape(-1).tolist()))
            assert listed == used + [used[-1]] * (8 * rows - len(used)) and rows == -(-len(used) // 8)
            places = points[:, :3].transpose(1, 2).reshape(-1, 3).view(torch.float32)
            assert torch.equal(places, x[listed])
            lengths.add(rows)
    assert lengths == {1, 2}
    assert ops.refit.__doc__


@pytest.mark.parametrize("subdivisions", [2, 3, 4])
def test_blocks_are_mostly_full(subdivisions: int) -> None:
    """A block is tested as a whole. Blocks filled from their largest nodes alone, top down, leave two leaves each to
    many of the last ones: less than four nodes on average.
    """
    links = Hierarchy.of(bumpy(np.random.default_rng(0), subdivisions)).links.view(-1, 8, 4)
    below_the_root = links[1:, :, 1] >= 0
    assert below_the_root.sum(dim=1).float().mean() > 5.5


def smallest_radius(points: np.ndarray) -> float:
    """Of all spheres through two, three or four of the points that contain all of them."""
    best = math.inf
    for size in (2, 3, 4):
        for chosen in itertools.combinations(range(len(points)), size):
            first, others = points[chosen[0]], points[list(chosen[1:])] - points[chosen[0]]
            # The centre of the sphere in the plane or line that the points span.
            centre = np.linalg.lstsq(2.0 * others, (others**2).sum(axis=1), rcond=None)[0]
            radius = math.sqrt(centre @ centre)
            if radius < best and np.linalg.norm(points - first - centre, axis=1).max() <= radius * (1.0 + 1e-9):
                best = radius
    return best


def test_spheres_of_leaves_are_nearly_the_smallest() -> None:
    mesh = bumpy(np.random.default_rng(0), 2)
    _, blocks, links, leaf_points, _ = Hierarchy.of(mesh)
    radii = blocks[:, 3].reshape(-1)
    compared = 0
    for radius, (_, count, row, rows) in zip(radii.tolist(), links.view(-1, 4).tolist(), strict=True):
        if count <= 0:
            continue
        points = leaf_points[row : row + rows, :3].transpose(1, 2).reshape(-1, 3).view(torch.float32)
        smallest = smallest_radius(np.unique(points.double().numpy(), axis=0))
        assert smallest * (1.0 - 1e-6) <= radius <= smallest * 1.0011
        compared += 1
    assert compared > 40


@pytest.mark.parametrize("count", [100, 1000])
def test_triangles_at_one_place_and_far_apart(count: int) -> None:
    """No plane separates the middles of the first ones; nearly all others fall into one bin."""
    corner = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]])
    far = [corner + [4.0**k, 0.0, 0.0] for k in range(1, 40)]
    vertices = np.concatenate([*[corner] * count, *far])
    mesh = pgccd.Mesh(vertices, np.arange(len(vertices)).reshape(-1, 3))
    triangles, _, links, *_ = Hierarchy.of(mesh)
    links = links.view(-1, 4)
    leaves = links[links[:, 1] > 0]
    assert torch.equal(torch.sort(triangles[:, 6])[0], torch.arange(count + 39, dtype=torch.int32))
    assert int(leaves[:, 1].sum()) == count + 39 and int(leaves[:, 1].max()) <= LEAF_SIZE


def test_far_from_the_origin_keeps_digits() -> None:
    rng = np.random.default_rng(3)
    near = bumpy(rng, 1)
    shifted = near.vertices.numpy() + 2.0**27
    mesh = pgccd.Mesh(shifted, near.faces, "centroid")
    truth = sphere_bound(shifted, near.faces)
    # The centre has only the precision available at 2^27; everything else is exact relative to it.
    assert np.abs(mesh.centre.numpy() - truth.center).max() <= 2.0**-25
    assert mesh.radius == pytest.approx(truth.radius, abs=2.0**-24)
    assert np.array_equal(mesh.vertices.numpy() + mesh.centre.numpy(), shifted)


def test_input_types_agree() -> None:
    rng = np.random.default_rng(4)
    mesh = bumpy(rng, 1)
    twins = [
        pgccd.Mesh(mesh.vertices.tolist(), mesh.faces.tolist()),
        pgccd.Mesh(mesh.vertices, mesh.faces.to(torch.int64)),
        pgccd.Mesh(mesh.vertices.numpy(), mesh.faces.numpy().astype(np.uint32)),
    ]
    assert all(torch.equal(t.vertices, twins[0].vertices) and torch.equal(t.faces, mesh.faces) for t in twins)
    assert "faces=80" in repr(mesh)


def test_too_many_edges_are_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("pgccd.geometry.mesh._MOST_EDGES", 2)
    with pytest.raises(ValueError, match="^faces: the mesh has 3 edges; expected at most 2$"):
        pgccd.Mesh([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]], [[0, 1, 2]])
