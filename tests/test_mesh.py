"""Meshes: bounds, edges, representatives and hierarchy, on any triangles; and loading from files."""

from __future__ import annotations

import itertools
import math
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import strategies
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from oracle.mesh import sphere_bound, unique_edges, used_vertices
from support.shapes import bumpy

import pgccd
from pgccd import ops
from pgccd.geometry.mesh import LEAF_SIZE

# A mesh with all vertices in one point raises its own error.
SHAPES = strategies.meshes().filter(
    lambda shape: bool(np.ptp(shape.vertices[shape.faces].reshape(-1, 3), axis=0).any())
)
MOST_DEPTH = 48
WIDTH = 8


def prepared(mesh: pgccd.Mesh) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Triangles (F, 8), node blocks (n, 4, 8) and links (n, 8, 2), as the operators take them."""
    tensors = pgccd.MeshSet([mesh]).tensors
    return tensors[3].numpy(), tensors[4].numpy(), tensors[5].numpy()


def walk(links: np.ndarray) -> tuple[list[tuple[int, int, int]], int]:
    """(node, first triangle, triangle count) of every node, unordered, and the depth."""
    found, deepest = [], 0

    def visit(node: int, depth: int) -> tuple[int, int]:
        nonlocal deepest
        deepest = max(deepest, depth)
        first, count = links[node // WIDTH, node % WIDTH, :2].tolist()
        if count == 0:
            below = [
                visit(first * WIDTH + slot, depth + 1)
                for slot in range(WIDTH)
                if links[first, slot, 1] >= 0  # otherwise an empty slot
            ]
            assert first > node // WIDTH and below, "blocks of parents precede those of their children"
            first, count = min(b[0] for b in below), sum(b[1] for b in below)
        found.append((node, first, count))
        return first, count

    visit(0, 1)
    return found, deepest


def assert_encloses(blocks: np.ndarray, links: np.ndarray, triangles: np.ndarray, x: np.ndarray) -> None:
    """Asserts that each node's volume encloses its triangles' vertices, exactly up to this test's rounding."""
    for node, first, count in walk(links)[0]:
        volume = blocks[node // WIDTH, :, node % WIDTH].astype(np.longdouble)
        arms = x[triangles[first : first + count, :3]].reshape(-1, 3).astype(np.longdouble) - volume[:3]
        assert np.sqrt((arms**2).sum(axis=1)).max() <= volume[3] * np.longdouble(1 + 1e-17)
        if len(volume) > 4:  # also a slab about the same centre
            along = arms @ volume[4:7]
            assert along.min() >= volume[7] and along.max() <= volume[8]


@given(SHAPES)
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


@given(SHAPES)
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


@given(SHAPES)
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


@given(SHAPES, st.integers(0, 2**32 - 1), st.sampled_from([1e-6, 1.0, 1e6]))
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
        assert torch.equal(joined.tensors[6][low[4] : high[4]], mesh._leaf_points)
        assert joined.radius[k] == mesh.radius
    assert len(triangles) == sum(len(m.faces) for m in meshes)


def test_leaves_list_the_vertices_of_their_triangles() -> None:
    """Each vertex once, eight per row; the last one fills the row. Leaves of a strip have more than eight vertices."""
    strip = np.array([[k // 2, k % 2, 0.1 * k] for k in range(30)], dtype=float)
    faces = np.array([[k, k + 1, k + 2] for k in range(28)])
    lengths = set()
    for mesh in (bumpy(np.random.default_rng(0), 2), pgccd.Mesh(strip, faces, origin="centroid")):
        triangles = mesh._triangles.numpy()
        x = (mesh.vertices - mesh.centre_offset).float()
        for first, count, row, rows in mesh._node_links.view(-1, 4).tolist():
            if count <= 0:
                assert rows == 0
                continue
            points = mesh._leaf_points[row : row + rows]
            listed = points[:, 3].reshape(-1).tolist()
            used = sorted(set(triangles[first : first + count, :3].ravel().tolist()))
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
    links = bumpy(np.random.default_rng(0), subdivisions)._node_links.view(-1, 8, 4)
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
    radii = mesh._node_blocks[:, 3].reshape(-1)
    compared = 0
    for radius, (_, count, row, rows) in zip(radii.tolist(), mesh._node_links.view(-1, 4).tolist(), strict=True):
        if count <= 0:
            continue
        points = mesh._leaf_points[row : row + rows, :3].transpose(1, 2).reshape(-1, 3).view(torch.float32)
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
    links = mesh._node_links.view(-1, 4)
    leaves = links[links[:, 1] > 0]
    assert torch.equal(torch.sort(mesh._triangles[:, 6])[0], torch.arange(count + 39, dtype=torch.int32))
    assert int(leaves[:, 1].sum()) == count + 39 and int(leaves[:, 1].max()) <= LEAF_SIZE


@given(SHAPES, st.sampled_from(["ply", "stl", "obj", "off", "glb"]))
@settings(max_examples=40)
def test_load_any_file(tmp_path_factory: pytest.TempPathFactory, shape: strategies.TriMesh, suffix: str) -> None:
    trimesh = pytest.importorskip("trimesh")
    path = tmp_path_factory.mktemp("mesh") / f"shape.{suffix}"
    written = trimesh.Trimesh(shape.vertices, shape.faces, process=False)
    written.export(path)
    # stl files hold float32; equal corners are merged and faces degenerated by rounding are dropped.
    corners = shape.vertices.astype(np.float32)[shape.faces]
    is_whole = (corners != np.roll(corners, 1, axis=1)).any(axis=2).all(axis=1) | (suffix != "stl")
    if not is_whole.any():
        with pytest.raises(ValueError, match="three different corners"):
            pgccd.Mesh.load(path)
        return
    mesh = pgccd.Mesh.load(path, weld=suffix == "stl")
    direct = pgccd.Mesh(shape.vertices, shape.faces)

    def triangles(m: pgccd.Mesh) -> np.ndarray:
        corners = (m.vertices + m.origin).numpy()[m.faces.numpy()]
        return np.sort(np.array([c.ravel() for c in corners]).round(4), axis=0)

    if suffix == "stl":
        assert len(mesh.faces) == int(is_whole.sum())
        assert len(np.unique(mesh.vertices.numpy(), axis=0)) == len(mesh.vertices)
    else:
        assert len(mesh.faces) == len(direct.faces)
        assert np.abs(triangles(mesh) - triangles(direct)).max() < 2e-3
    if is_whole.all():
        assert mesh.radius == pytest.approx(direct.radius, rel=1e-3)


def test_stl_corners_are_joined(tmp_path: Path) -> None:
    trimesh = pytest.importorskip("trimesh")
    ball = trimesh.creation.icosphere(subdivisions=2)
    ball.export(tmp_path / "ball.stl")
    mesh = pgccd.Mesh.load(tmp_path / "ball.stl")
    assert (len(mesh.vertices), len(mesh.faces), len(mesh.edges)) == (162, 320, 480)
    assert pgccd.Mesh.load(str(tmp_path / "ball.stl")).radius == mesh.radius


def split_box(trimesh: Any) -> Any:
    """A box of 768 faces and 386 vertices, split wherever two faces meet, as at texture seams."""
    box = trimesh.creation.box()
    for _ in range(3):
        box = box.subdivide()
    box.unmerge_vertices()
    return box


@pytest.mark.parametrize("suffix", ["glb", "ply", "obj", "off", "stl"])
def test_vertices_split_at_seams_are_welded(tmp_path: Path, suffix: str) -> None:
    trimesh = pytest.importorskip("trimesh")
    box, path = split_box(trimesh), tmp_path / f"box.{suffix}"
    box.export(path)
    (one,) = pgccd.Mesh.load_all(path)
    for mesh in (pgccd.Mesh.load(path), pgccd.Mesh.from_trimesh(box), one):
        assert (len(mesh.vertices), len(mesh.faces), len(mesh.edges)) == (386, 768, 1152)
        assert (mesh.welded_vertices, mesh.dropped_faces) == (2304 - 386, 0)
        assert "welded_vertices=1918" in repr(mesh) and "dropped" not in repr(mesh)
        x = mesh.vertices
        moved = pgccd.VertexMotion(x, x + torch.tensor([0.5, 0.25, 0.0]))
        assert len(pgccd.detect(pgccd.Scene([mesh], self_collision=True), moved, report="all")) == 0
    as_it_is = pgccd.Mesh.load(path, weld=False)
    assert len(as_it_is.vertices) == 2304 and as_it_is.welded_vertices == 0 and "welded" not in repr(as_it_is)
    # The rows of the file, for programs that move its vertices.
    assert mesh.source_vertex is not None and mesh.source_face is not None
    given = torch.from_numpy(np.array(box.vertices))
    mesh = pgccd.Mesh.from_trimesh(box)
    assert torch.allclose(given[mesh.source_vertex], mesh.vertices + mesh.origin, atol=1e-15)
    assert torch.equal(mesh.source_face, torch.arange(768))
    assert bool((mesh.source_vertex[1:] > mesh.source_vertex[:-1]).all()), "the first of each, in the file's order"


def test_nothing_to_weld_changes_nothing() -> None:
    trimesh = pytest.importorskip("trimesh")
    ball = trimesh.creation.icosphere(subdivisions=2)
    mesh, plain = pgccd.Mesh.from_trimesh(ball), pgccd.Mesh(ball.vertices, ball.faces)
    assert torch.equal(mesh.vertices, plain.vertices) and torch.equal(mesh.faces, plain.faces)
    assert mesh.welded_vertices == 0 and torch.equal(mesh.source_vertex, torch.arange(162))


def test_negative_zero_and_faces_that_welding_flattens() -> None:
    trimesh = pytest.importorskip("trimesh")
    vertices = [[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [-0.0, 0, -0.0], [1, 0, 0]]
    mesh = pgccd.Mesh.from_trimesh(trimesh.Trimesh(vertices, [[0, 3, 1], [0, 1, 2], [3, 4, 2]], process=False))
    assert len(mesh.vertices) == 3 and mesh.faces.tolist() == [[0, 1, 2], [0, 1, 2]]
    assert (mesh.welded_vertices, mesh.dropped_faces) == (2, 1) and mesh.source_face.tolist() == [1, 2]
    assert "dropped_faces=1" in repr(mesh)
    with pytest.raises(ValueError, match="^mesh: .*three different corners"):
        pgccd.Mesh.from_trimesh(trimesh.Trimesh(vertices, [[0, 3, 1]], process=False))


def test_meshes_of_a_scene_one_by_one(tmp_path: Path) -> None:
    trimesh = pytest.importorskip("trimesh")
    place = trimesh.transformations.rotation_matrix(0.7, [1, 2, 3]) + 5.0 * np.eye(4, k=3)
    written = trimesh.Scene()
    written.add_geometry(trimesh.creation.box((1, 2, 3)), node_name="crate", transform=place)
    written.add_geometry(trimesh.creation.icosphere(subdivisions=1), node_name="ball")
    written.export(tmp_path / "scene.glb")
    meshes = {mesh.name: mesh for mesh in pgccd.Mesh.load_all(tmp_path / "scene.glb")}
    assert {name: len(mesh.faces) for name, mesh in meshes.items()} == {"crate": 12, "ball": 80}
    crate = meshes["crate"]
    corners = trimesh.transform_points(trimesh.creation.box((1, 2, 3)).vertices, place)
    found = (crate.vertices + crate.origin).numpy()
    assert np.abs(np.sort(found, axis=0) - np.sort(corners, axis=0)).max() < 1e-6
    joined = pgccd.Mesh.load(tmp_path / "scene.glb")
    assert len(joined.faces) == 92 and "'crate'" in repr(crate)

    text = "o left\nv 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\no right\nv 5 0 0\nv 6 0 0\nv 5 1 0\nf 4 5 6\n"
    (tmp_path / "two.obj").write_text(text)
    assert {mesh.name: float(mesh.centre[0]) > 2 for mesh in pgccd.Mesh.load_all(tmp_path / "two.obj")} == {
        "left": False,
        "right": True,
    }
    assert len(pgccd.Mesh.load(tmp_path / "two.obj").faces) == 2


def test_what_is_no_mesh_is_named(tmp_path: Path) -> None:
    trimesh = pytest.importorskip("trimesh")
    written = trimesh.Scene()
    written.add_geometry(trimesh.creation.box(), node_name="crate")
    written.add_geometry(trimesh.PointCloud(np.eye(3)), node_name="scan", geom_name="scan")
    written.export(tmp_path / "scan.glb")
    for load in (pgccd.Mesh.load, pgccd.Mesh.load_all):
        with pytest.raises(ValueError, match="^path: .*scan.glb.*a point cloud named 'scan'"):
            load(tmp_path / "scan.glb")
    with pytest.raises(ValueError, match="^mesh: .*a point cloud named 'scan'"):
        pgccd.Mesh.from_trimesh(written)
    with pytest.raises(ValueError, match="^mesh: .*lines"):
        pgccd.Mesh.from_trimesh(trimesh.load_path([[0, 0, 0], [1, 0, 0]]))


def test_from_trimesh_and_scene() -> None:
    trimesh = pytest.importorskip("trimesh")
    box = trimesh.creation.box()
    mesh = pgccd.Mesh.from_trimesh(box)
    assert len(mesh.faces) == 12 and mesh.radius == pytest.approx(3**0.5 / 2)
    scene = trimesh.Scene([box, trimesh.creation.icosphere(subdivisions=1)])
    assert len(pgccd.Mesh.from_trimesh(scene).faces) == 12 + 80


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
