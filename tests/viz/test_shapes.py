"""What is drawn of segments and points, alone and on pages, in pictures, models and live views."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

import pgccd
from pgccd import viz
from pgccd.geometry.solids import opening
from pgccd.viz.animation import VertexPaths, animation_of
from pgccd.viz.moment import vertices_at as drawn_at
from pgccd.viz.shapes import drawn
from viz.test_display import areas, picture
from viz.test_page import data_of, decoded, vertices_at

BALL, ROD = pgccd.Mesh.sphere(0.5), pgccd.Mesh.capsule(0.2, 1.0)
CORNERS = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1], [2, 2, 2]])
MIXED = pgccd.Mesh(CORNERS, [[0, 1, 2]], "centroid", segments=[[0, 3]], points=[4, 1], thickness=0.1)


def pose(*rows: list[float]) -> tuple[torch.Tensor, torch.Tensor]:
    x = torch.tensor(rows).double()
    return x, torch.tensor([[1.0, 0, 0, 0]] * len(rows)).double()


def volume(vertices: np.ndarray, faces: np.ndarray) -> float:
    a, b, c = vertices[faces].transpose(1, 0, 2)
    return float(np.einsum("ij,ij->i", a, np.cross(b, c)).sum() / 6.0)


def distance(points: np.ndarray, a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Of points (n, 3) from a segment."""
    along = b - a
    t = np.clip(((points - a) @ along) / (along @ along), 0.0, 1.0)
    return np.linalg.norm(points - a - t[:, None] * along, axis=1)


@pytest.mark.parametrize(("count", "each"), [(1, 0.93), (100, 0.93), (101, 0.84), (2_001, 0.6), (20_001, 0.31)])
def test_points_are_balls(count: int, each: float) -> None:
    cloud = pgccd.Mesh.points(3.0 * np.random.default_rng(5).normal(size=(count, 3)), 0.1, "centroid")
    shape = drawn(cloud)
    assert np.array_equal(shape.vertices[:count], cloud.vertices) and shape.triangle_count == 0
    around = shape.vertices[count:].reshape(count, -1, 3) - cloud.vertices.numpy()[:, None]
    assert np.allclose(np.linalg.norm(around, axis=2), 0.1)
    one = shape.faces[: len(shape.faces) // count]
    assert opening(one) is None
    exact = 4.0 / 3.0 * np.pi * 0.1**3
    assert each * exact < volume(shape.vertices, shape.faces) / count < exact
    assert np.linalg.norm(shape.vertices - cloud.centre_offset.numpy(), axis=1).max() <= shape.radius * (1 + 1e-12)
    assert np.linalg.norm(shape.vertices, axis=1).max() <= shape.reach * (1 + 1e-12)


@pytest.mark.parametrize(("count", "each"), [(1, 0.93), (101, 0.8), (2_001, 0.6)])
def test_segments_are_capsules(count: int, each: float) -> None:
    ends = np.random.default_rng(5).normal(size=(2 * count, 3))
    wires = pgccd.Mesh.segments(ends, np.arange(2 * count).reshape(-1, 2), 0.1)
    shape = drawn(wires)
    assert opening(shape.faces) is None
    around = shape.vertices[2 * count :].reshape(count, -1, 3)
    for segment in range(0, count, 97):
        a, b = ends[2 * segment : 2 * segment + 2]
        assert np.allclose(distance(around[segment], a, b), 0.1)
    lengths = np.linalg.norm(ends[1::2] - ends[::2], axis=1)
    exact = (np.pi * 0.1**2 * lengths + 4.0 / 3.0 * np.pi * 0.1**3).sum()
    assert each * exact < volume(shape.vertices, shape.faces) < exact


def test_triangles_stay_and_thin_elements_are_seen() -> None:
    box = pgccd.Mesh.box([1.0, 1.0, 1.0]).thickened(0.2)
    assert drawn(box).vertices is not None and np.array_equal(drawn(box).faces, box.faces)
    assert np.array_equal(drawn(box).vertices, box.vertices)
    shape = drawn(MIXED)
    assert shape.triangle_count == 1 and shape.faces[0].tolist() == [0, 1, 2]
    assert np.array_equal(shape.vertices[:5], MIXED.vertices)
    thin = pgccd.Mesh.segments(CORNERS, [[0, 1], [3, 4]])
    assert drawn(thin).thickness == pytest.approx(0.005 * thin.radius)


def test_capsules_turn_with_their_segments() -> None:
    """By any angle, also along the direction across which they were, and through a length of 0."""
    wire = pgccd.Mesh.segments([[0.0, 0, 0], [0, 0, 1.0]], [[0, 1]], 0.1)
    shape = drawn(wire)
    far = np.array([[0, 0, 1.0], [1.0, 0, 0], [0, 1.0, 0], [0, 0, 0], [0, -2.0, 0], [0, 0, -1.0], [1.0, 1.0, 1.0]])
    positions = np.stack([np.zeros_like(far), far], axis=1)
    found = shape.moved(positions)
    assert np.array_equal(found[:, :2], positions)
    for moment, end in enumerate(far):
        if end.any():
            assert np.allclose(distance(found[moment, 2:], np.zeros(3), end), 0.1)
            exact = np.pi * 0.01 * np.linalg.norm(end) + 4.0 / 3.0 * np.pi * 0.001
            assert 0.9 * exact < volume(found[moment], shape.faces) < exact
    # Halfway between two near moments it is nearly as thick: rings do not twist.
    angles = np.linspace(0.0, 2.0 * np.pi, 25)
    turning = np.stack([np.zeros((25, 3)), np.stack([np.sin(angles), 0 * angles, np.cos(angles)], axis=1)], axis=1)
    found = shape.moved(turning)
    halfway = 0.5 * (found[1:] + found[:-1])
    assert min(volume(each, shape.faces) for each in halfway) > 0.9 * volume(found[0], shape.faces)


def test_pages_show_spheres_and_capsules() -> None:
    scene = pgccd.Scene([BALL, ROD, MIXED], [0, 1, 2, 0], margin=[0.0, 0.05, 0.05, 0.0])
    x, q = pose([0, 0, 0], [3, 0, 0], [0, 4, 0], [6, 0, 0])
    motion = pgccd.RigidMotion(x, q, x + torch.tensor([[1.0, 0, 0], [0, 0, 0], [0, 0, 0], [-3.0, 0, 0]]), q)
    hits = pgccd.detect(scene, motion)
    assert hits.pairs.tolist() == [[1, 3]]
    page = viz.Page.of(scene, motion, hits)
    assert page.left_out == []
    data = data_of(page)
    shown = vertices_at(data, 0, 0.0)
    for body, mesh in enumerate((BALL, ROD, MIXED, BALL)):
        assert np.allclose(shown[body], x[body].numpy() + drawn(mesh).vertices, atol=1e-5)
    faces = sum(len(decoded(kind["faces"], np.uint16, -1)) for kind in data["rigid"]["kinds"]) // 3
    assert faces == sum(len(drawn(mesh).faces) for mesh in (BALL, ROD, MIXED))
    # Margins go beyond what is drawn; the triangles of the mixed mesh are drawn without its thickness.
    ids = decoded(data["bodies"]["id"], np.uint32, 4)
    margins = data["scale"] * decoded(data["bodies"]["margin"], np.float32, 4)
    assert np.allclose(margins[np.argsort(ids)], [0.0, 0.05, 0.15, 0.0], atol=1e-6)
    # Bodies are as large as they are drawn.
    radii = data["scale"] * decoded(data["bodies"]["radius"], np.float32, 4)[np.argsort(ids)]
    assert np.allclose(radii[[0, 3]], 3**0.5 * 0.5, rtol=0.05)
    assert (
        "margin"
        not in data_of(viz.Page.of(pgccd.Scene([BALL], [0, 0]), pgccd.RigidMotion(x[:2], q[:2], x[:2], q[:2])))[
            "bodies"
        ]
    )


@pytest.mark.parametrize("mesh", [BALL, ROD, MIXED], ids=["ball", "rod", "mixed"])
def test_pages_of_deforming_bodies_follow_them(mesh: pgccd.Mesh) -> None:
    scene = pgccd.Scene([mesh, pgccd.Mesh.box([1.0, 1.0, 1.0])], [1, 0, 0], world=[0, 0, 1])
    count = scene.layout.vertex_count
    positions = torch.from_numpy(np.random.default_rng(5).normal(size=(3, count, 3)))
    animation = animation_of(scene, pgccd.Trajectory(positions))
    assert isinstance(animation.paths, VertexPaths)
    own, size = positions[:, 8:], len(mesh.vertices)
    pieces = np.split(animation.paths.position, animation.paths.begin[1:], axis=1)
    assert np.array_equal(pieces[0], positions[:, :8])
    for body in range(2):
        assert np.array_equal(pieces[1 + body], drawn(mesh).moved(own[:, size * body : size * (body + 1)].numpy()))
    # Pictures have the bodies as they are at their time, not between the ends.
    middle = (0.25 * positions[0] + 0.75 * positions[1]).numpy()
    assert np.allclose(drawn_at(animation, 0, 0.75)[1], drawn(mesh).moved(middle[None, 8 : 8 + size])[0])
    shown = vertices_at(data_of(viz.Page.of(scene, pgccd.Trajectory(positions))), 0, 0.0)
    assert all(np.allclose(shown[k], drawn_at(animation, 0, 0.0)[k], atol=1e-5) for k in range(3))
    alone = vertices_at(data_of(viz.Page.of(scene, pgccd.Trajectory(positions), world=1)), 1, 1.0)
    assert np.allclose(alone[2], drawn(mesh).moved(own[:, size:].numpy())[2], atol=1e-5)


def test_large_clouds_are_simplified_on_pages() -> None:
    cloud = pgccd.Mesh.points(np.random.default_rng(5).normal(size=(60_000, 3)), 0.01)
    scene = pgccd.Scene([cloud, BALL])
    x, q = pose([0, 0, 0], [0, 0, 9.0])
    motion = pgccd.RigidMotion(x, q, *pose([0, 0, 0], [0, 0, 0]))
    hits = pgccd.detect(scene, motion)
    page = viz.Page.of(scene, motion, hits)
    assert len(hits) == 1 and 4e6 < len(page.html) < 5e6
    said = re.fullmatch(r"Mesh 0 is drawn with ([0-9,]+) of its 60,000 segments and points\.", page.left_out[0])
    assert said is not None and 15_000 < int(said[1].replace(",", "")) < 25_000
    # The balls that are left are whole, and that of the contact is among them.
    kind = max(data_of(page)["rigid"]["kinds"], key=lambda kind: len(kind["vertices"]))
    vertices = data_of(page)["scale"] * decoded(kind["vertices"], np.float32, -1, 6, 3)
    middles = vertices.mean(axis=1)
    assert np.allclose(np.linalg.norm(vertices - middles[:, None], axis=2), 0.01, rtol=1e-2)
    a, b = hits.features[0].tolist()
    assert b == 0 and np.linalg.norm(middles - cloud.vertices[a].numpy(), axis=1).min() < 1e-4
    faces = decoded(kind["faces"], np.uint32 if kind["index_bytes"] == 4 else np.uint16, -1, 8, 3)
    assert (faces // 6 == np.arange(len(middles))[:, None, None]).all()


def test_segments_and_points_of_a_mesh_are_left_out_together() -> None:
    mesh = pgccd.Mesh(CORNERS, segments=[[0, 1], [1, 2], [2, 3]], points=[3, 4], thickness=0.1)
    shape = drawn(mesh)
    assert [shape.corners(face).tolist() for face in range(5)] == [[0, 1], [1, 2], [2, 3], [3], [4]]
    assert [drawn(MIXED).corners(face).tolist() for face in range(4)] == [[0, 1, 2], [0, 3], [4], [1]]
    rows, faces = shape.some(5, np.zeros(0, dtype=np.int64))
    assert np.array_equal(shape.vertices[rows][faces], shape.vertices[shape.faces])
    for first, distances in (([0], [(0, 1)]), ([4], [(4, 4)]), ([2], [(1, 2), (2, 3)])):
        rows, faces = shape.some(len(distances), np.array(first))
        assert opening(faces) is None and np.array_equal(np.unique(faces), np.arange(len(rows)))
        ends = [(CORNERS[a], CORNERS[b] + 1e-12) for a, b in distances]
        nearest = np.min([distance(shape.vertices[rows], a, b) for a, b in ends], axis=0)
        assert nearest.max() < 0.1 + 1e-6


def test_pictures_of_linear_paths_are_those_of_their_time() -> None:
    x, q = pose([0, 0, 0])
    turned = torch.tensor([[0.0, 1.0, 0, 0]]).double()
    for length, end in ((1.0, q), (0.75**0.5, torch.tensor([[0.75**0.5, 0.5, 0, 0]]).double()), (0.0, turned)):
        animation = animation_of(pgccd.Scene([ROD]), pgccd.RigidMotion(x, q, x, end, "linear"))
        (found,) = drawn_at(animation, 0, 0.5)
        a, b = found[:2]
        assert np.allclose(distance(found[2:], a, b + 1e-12), 0.2, atol=1e-6)
        assert np.linalg.norm(b - a) == pytest.approx(length, abs=1e-6)


@pytest.mark.filterwarnings("error")
def test_pictures_show_them_at_their_size(tmp_path: Path) -> None:
    scene = pgccd.Scene([BALL])
    x, q = pose([0, 0, 0])
    still = pgccd.RigidMotion(x, q, x, q)
    image = picture(pgccd.show(scene, still, path=tmp_path / "ball.png"))
    rows, columns = np.nonzero(image.min(axis=2) < 0.9)
    wide, high = np.ptp(columns) + 1, np.ptp(rows) + 1
    assert high > 1000 and abs(wide - high) < 0.03 * high
    assert areas(image)["free"] == pytest.approx(np.pi / 4 * wide * high, rel=0.04)
    both = pgccd.Scene([BALL, ROD], [0, 1])
    x, q = pose([0, 0, 0], [2.0, 0, 0])
    motion = pgccd.RigidMotion(x, q, *pose([0, 0, 0], [0.5, 0, 0]))
    found = areas(picture(pgccd.show(both, motion, pgccd.detect(both, motion), path=tmp_path / "both.png")))
    assert found["first"] > 100_000 and found["second"] > 50_000 and found["pale"] > 300


def test_models_hold_them(tmp_path: Path) -> None:
    trimesh: Any = pytest.importorskip("trimesh")
    scene = pgccd.Scene([BALL, ROD])
    x, q = pose([0, 0, 0], [2.0, 0, 0])
    for number, motion in enumerate(
        (
            pgccd.RigidMotion(x, q, x, q),
            pgccd.VertexMotion(*[torch.tensor([[0.0, 0, 0], [2, 0, 0.5], [2, 0, -0.5]])] * 2),
        )
    ):
        loaded = trimesh.load(pgccd.show(scene, motion, path=tmp_path / f"{number}.glb"))
        for body, (mesh, size) in enumerate(((BALL, [1.0, 1.0, 1.0]), (ROD, [0.4, 0.4, 1.4]))):
            matrix, name = loaded.graph[f"body {body}"]
            part = loaded.geometry[name]
            assert len(part.faces) == len(drawn(mesh).faces)
            corners = trimesh.transform_points(part.vertices, matrix)
            assert np.allclose(np.ptp(corners, axis=0), size, rtol=0.03)
            assert np.allclose(corners.mean(axis=0), [2.0 * body, 0, 0], atol=1e-2)


def test_live_views_show_them() -> None:
    pytest.importorskip("viser")
    scene = pgccd.Scene([BALL, ROD])
    view = viz.live(scene, port=18090)
    try:
        view.update(*pose([0, 0, 0], [2.0, 0, 0]))
        handle = view.server.scene.get_handle_by_name("/mesh 1")
        assert np.allclose(handle.vertices, drawn(ROD).vertices) and len(handle.faces) == len(drawn(ROD).faces)
        position = np.linalg.norm(view.server.initial_camera.position - view.server.initial_camera.look_at)
        assert position > 2.0
        vertices = torch.tensor([[0.0, 0, 0], [1.0, 0, 0], [3.0, 0, 0]]).double()
        hits = pgccd.detect(
            scene, pgccd.VertexMotion(vertices, vertices - torch.tensor([[-1.0, 0, 0], [0] * 3, [0] * 3]))
        )
        view.update(vertices, hits=hits)
        shown = view.server.scene.get_handle_by_name("/body 1").vertices
        assert np.allclose(shown, drawn(ROD).moved(vertices[None, 1:].numpy())[0], atol=1e-6)
        (line,) = view.server.scene.get_handle_by_name("/normals").points
        assert np.linalg.norm(line[1] - line[0]) == pytest.approx(0.25, rel=1e-3)
    finally:
        view.stop()


def test_pictures_of_worlds_show_them(tmp_path: Path) -> None:
    image_module = pytest.importorskip("matplotlib.image")
    x, q = pose([0, 0, 0], [0.7, 0, 0], [-2.0, 1.0, 1.0], [2.0, -2.0, 0])
    moments = torch.stack([x[:2] - torch.tensor([[0.5, 0, 0], [0, 0, 0]]), x[:2], x[:2] + 0.1]).numpy()
    impact = viz.Impact(
        (0, 1), (0, 1), 0.5, "vertex 0 on edge 0", np.array([0.5, 0, 0]), np.array([1.0, 0, 0]), moments,
        np.broadcast_to(q[:2].numpy(), (3, 2, 4)), np.linspace(0.0, 1.0, 5), np.linspace(0.5, -0.5, 5),
    )  # fmt: skip
    colliding = np.array([True, True, False, False])
    kind, ids = np.array([0, 1, 0, 1]), np.arange(4)
    snapshot = viz.Snapshot(
        [BALL, ROD], kind, ids, x.numpy(), q.numpy(), colliding, np.full(3, 3.0), ["Balls and rods"], impact
    )
    image = image_module.imread(viz.world_picture(tmp_path / "world.png", snapshot))[..., :3]
    upper, lower = image[: len(image) // 2], image[len(image) // 2 :]
    for part, least in ((upper, 0.005), (lower, 0.02)):
        orange = (part[..., 0] > 0.5) & (part[..., 0] > 1.8 * part[..., 2])
        assert orange.mean() > least
