"""The data of pages: bodies and contacts are where motion and detection have them; sizes are as promised."""

from __future__ import annotations

import base64
import json
import re
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch

import pgccd
from pgccd import sim, viz
from pgccd.detection.capacity import sizes_of
from pgccd.viz import content
from pgccd.viz.raster import placed

IDENTITY = [1.0, 0.0, 0.0, 0.0]


def ball(subdivisions: int = 2, radius: float = 1.0, origin: Any = (0.0, 0.0, 0.0)) -> pgccd.Mesh:
    trimesh = pytest.importorskip("trimesh")
    made = trimesh.creation.icosphere(subdivisions=subdivisions, radius=radius)
    return pgccd.Mesh(made.vertices, made.faces, origin)


def data_of(page: viz.Page) -> dict[str, Any]:
    found = re.search(r'<script type="application/json" id="data">(.*?)</script>', page.html, re.DOTALL)
    assert found
    return json.loads(found[1])


def decoded(text: str, dtype: Any, *shape: int) -> np.ndarray:
    return np.frombuffer(base64.b64decode(text), dtype=dtype).reshape(*shape)


def vertices_at(data: dict[str, Any], segment: int, time: float) -> dict[int, np.ndarray]:
    """World vertices of each body on a page, by id, by the formulas of its shaders."""
    count = data["bodies"]["count"]
    ids = decoded(data["bodies"]["id"], np.uint32, count).tolist()
    fraction = np.ones(count)
    if "fraction" in data["bodies"]:
        fraction = decoded(data["bodies"]["fraction"], np.float32, count)
    segments, found = len(data["waypoints"]) - 1, []
    if "rigid" in data:
        row = 0
        for kind in data["rigid"]["kinds"]:
            vertices = decoded(kind["vertices"], np.float32, -1, 3).astype(float)
            paths = decoded(kind["paths"], np.float32, segments, kind["count"], 13).astype(float)[segment]
            for path in paths:
                x, q, v, spin = np.split(path, [3, 7, 10])
                times = (0.0, 1.0) if data["rigid"]["linear"] else (time * fraction[row],)
                ends = []
                for moment in times:
                    angle = moment * np.linalg.norm(spin)
                    axis = spin / (np.linalg.norm(spin) or 1.0)
                    turn = np.array([[np.cos(angle / 2), *(np.sin(angle / 2) * axis)]])
                    turned = placed(placed(vertices, np.zeros((1, 3)), q[None])[0], np.zeros((1, 3)), turn)[0]
                    ends.append(turned + x + moment * v)
                t = time * fraction[row]
                found.append(ends[0] if len(ends) == 1 else (1 - t) * ends[0] + t * ends[1])
                row += 1
    else:
        all_vertices = decoded(data["deforming"]["vertices"], np.float32, segments + 1, -1, 3).astype(float)
        mixed = (1 - time) * all_vertices[segment] + time * all_vertices[segment + 1]
        counts = decoded(data["deforming"]["vertex_counts"], np.uint32, count)
        found = np.split(mixed, np.cumsum(counts)[:-1])
    assert len(found) == count
    return {name: np.array(data["centre"]) + data["scale"] * v for name, v in zip(ids, found, strict=True)}


def rows_of(rng: np.random.Generator, count: int) -> tuple[torch.Tensor, ...]:
    q = torch.nn.functional.normalize(torch.from_numpy(rng.normal(size=(count, 4))), dim=1)
    return torch.from_numpy(rng.uniform(-5, 5, (count, 3))), q


@pytest.mark.parametrize("shift", [0.0, 1e7])
def test_rigid_bodies_are_where_the_motion_has_them(shift: float) -> None:
    rng = np.random.default_rng(0)
    scene = pgccd.Scene([ball(1), ball(1, 0.5, (0.0, 0.3, 2.0))], [0, 1, 0, 1, 0])
    x, q = rows_of(rng, 5)
    spin = torch.from_numpy(rng.normal(size=(5, 3)) * 3.0)  # more than half a turn, too
    motion = pgccd.RigidMotion.from_velocity(x + shift, q, torch.from_numpy(rng.normal(size=(5, 3))), spin, 1.0)
    data = data_of(viz.Page.of(scene, motion))
    for time in (0.0, 0.3, 1.0):
        position, orientation = motion.at(time)
        shown = vertices_at(data, 0, time)
        for body in range(5):
            local = scene.meshes.meshes[int(scene.mesh_index[body])].vertices.numpy()
            expected = placed(local, position[body, None].numpy(), orientation[body, None].numpy())[0]
            assert np.allclose(shown[body], expected, atol=1e-5)


def test_linear_paths_and_fractions() -> None:
    rng = np.random.default_rng(1)
    scene = pgccd.Scene([ball(1)], [0, 0])
    (x, q), (y, r) = rows_of(rng, 2), rows_of(rng, 2)
    linear = pgccd.RigidMotion(x, q, y, r, path="linear")
    arcs = pgccd.RigidMotion(x, q, y, r)
    shown = vertices_at(data_of(viz.Page.of(scene, linear)), 0, 0.4)
    local = scene.meshes.meshes[0].vertices.numpy()
    (start, end), turned = (arcs.at(t) for t in (0.0, 1.0)), arcs.at(torch.tensor([0.1, 0.4]).double())
    stopped = vertices_at(data_of(viz.Page.of(scene, arcs, fraction=torch.tensor([0.25, 1.0]))), 0, 0.4)
    for body in range(2):
        ends = [placed(local, p[body, None].numpy(), o[body, None].numpy())[0] for p, o in (start, end)]
        assert np.allclose(shown[body], 0.6 * ends[0] + 0.4 * ends[1], atol=1e-5)
        expected = placed(local, turned[0][body, None].numpy(), turned[1][body, None].numpy())[0]
        assert np.allclose(stopped[body], expected, atol=1e-5)


def test_trajectories_and_their_contacts() -> None:
    x = torch.tensor([[[0.0, 0, 0], [4.0, 0, 0]], [[0, 1, 0], [4, 1, 0]], [[0, 1, 0], [1, 1, 0]]]).double()
    turn = torch.tensor([[IDENTITY] * 2, [[0.6, 0, 0, 0.8]] * 2, [IDENTITY] * 2]).double()
    scene, trajectory = pgccd.Scene([ball(1)], [0, 0]), pgccd.Trajectory(x, turn)
    hits = pgccd.detect(scene, trajectory)
    assert len(hits) == 1 and int(hits.segment[0]) == 1
    data = data_of(viz.Page.of(scene, trajectory, hits))
    local = scene.meshes.meshes[0].vertices.numpy()
    for segment in range(2):
        position, orientation = trajectory.segment(segment).at(0.7)
        for body, shown in vertices_at(data, segment, 0.7).items():
            expected = placed(local, position[body, None].numpy(), orientation[body, None].numpy())[0]
            assert np.allclose(shown, expected, atol=1e-5)
    contacts = data["contacts"]
    assert contacts["count"] == 1 and decoded(contacts["segment"], np.int32, 1)[0] == 1
    for name, width, dtype in (("point", 3, np.float64), ("normal", 3, np.float32), ("toi", 1, np.float64)):
        given = getattr(hits, name).reshape(1, width).numpy()
        assert np.array_equal(decoded(contacts[name], dtype, 1, width), given.astype(dtype))
    place = np.array(data["centre"]) + data["scale"] * decoded(contacts["place"], np.float32, 3)
    assert np.allclose(place, hits.point[0], atol=1e-6)


def test_deforming_bodies_are_where_the_motion_has_them() -> None:
    rng = np.random.default_rng(2)
    scene = pgccd.Scene([ball(1), ball(0)], [1, 0, 1])
    count = scene.layout.vertex_count
    x = torch.from_numpy(rng.normal(size=(3, count, 3)))
    for motion, segments in ((pgccd.VertexMotion(x[0], x[1]), 1), (pgccd.Trajectory(x), 2)):
        data = data_of(viz.Page.of(scene, motion))
        faces = decoded(data["deforming"]["faces"], np.uint16, -1, 3)
        first, at = 0, 0
        for body in decoded(data["bodies"]["id"], np.uint32, 3):
            mesh = scene.meshes.meshes[int(scene.mesh_index[int(body)])]
            assert np.array_equal(faces[at : at + len(mesh.faces)], mesh.faces.numpy() + first)
            first, at = first + len(mesh.vertices), at + len(mesh.faces)
        for segment in range(segments):
            step = motion if segments == 1 else motion.segment(segment)
            shown = vertices_at(data, segment, 0.3)
            assert np.allclose(np.concatenate([shown[body] for body in range(3)]), step.at(0.3), atol=1e-5)


def test_incomplete_results_and_pairs_without_times() -> None:
    rng = np.random.default_rng(3)
    scene = pgccd.Scene([ball(1)], [0] * 30)
    x, q = rows_of(rng, 30)
    motion = pgccd.RigidMotion(x, q, x + 0.5, q)
    whole = pgccd.detect(scene, motion)
    capacity = replace(sizes_of(pgccd.Capacity.of(30)), contacts=len(whole) - 2)
    padded = pgccd.detect(scene, motion, capacity=capacity)
    assert bool(padded.overflow) and (padded.toi == 0).all()
    page = viz.Page.of(scene, motion, padded)
    assert "incomplete" in page.notes[0] and page.notes[0][:20] in page.html
    contacts = data_of(page)["contacts"]
    tois = decoded(contacts["toi"], np.float64, contacts["count"])
    assert set(tois) <= set(whole.toi.tolist())
    pairs = viz.Page.of(scene, motion, pgccd.detect(scene, motion, "any"))
    states = decoded(data_of(pairs)["bodies"]["state"], np.uint8, 30)
    assert (states == 2).sum() == len(whole.pairs.unique()) > 0 and data_of(pairs)["contacts"]["count"] == 0
    assert "no times" in pairs.notes[0]
    roomy = pgccd.detect(scene, motion, capacity=pgccd.Capacity.of(100_000))
    assert data_of(viz.Page.of(scene, motion, roomy)) == data_of(viz.Page.of(scene, motion, whole))


def test_edges_through_faces_are_at_the_start() -> None:
    trimesh = pytest.importorskip("trimesh")
    box = pgccd.Mesh.from_trimesh(trimesh.creation.box())
    x = torch.tensor([[0.0, 0, 0], [0.7, 0.6, 0.5]]).double()
    q = torch.nn.functional.normalize(torch.tensor([[1.0, 0, 0, 0], [1.0, 0.3, 0.2, 0.1]]).double(), dim=1)
    scene, motion = pgccd.Scene([box], [0, 0]), pgccd.RigidMotion(x, q, x + 1.0, q)
    hits = pgccd.detect(scene, motion, "all")
    assert (hits.kind >= pgccd.Kind.EF_AB).all() and len(hits) > 3
    contacts = data_of(viz.Page.of(scene, motion, hits))["contacts"]
    assert (decoded(contacts["toi"], np.float64, len(hits)) == 0).all()
    assert np.array_equal(decoded(contacts["kind"], np.int8, len(hits)), hits.kind)
    assert np.array_equal(decoded(contacts["point"], np.float64, len(hits), 3), hits.point)


def test_page_of_a_world_is_self_contained_and_holds_all_robots() -> None:
    model = sim.Model(sim.ModelConfig(robots=150, speed=0.25))
    state = model.start()
    scene = model.scene(state.id)
    for index in range(12):
        step = sim.make_step(model, scene, state, index)
        state = step.after
    snapshot = sim.snapshot_of_step(model, step, ["A <title>", "figures"])
    page = viz.Page.of_snapshot(snapshot)
    assert len(page.html) < 5e6 and page.left_out == []
    assert "A &lt;title&gt;" in page.html and "@" not in re.sub(r"@media|@keyframes", "", page.html.split("<script")[0])
    assert not re.search(r"(src|href)\s*=|https?://|@import", page.html)
    data = data_of(page)
    colliding, contacts = int(snapshot.colliding.sum()), data["contacts"]
    kind = data["rigid"]["kinds"][0]
    assert kind["count"] == data["bodies"]["count"] == data["bodies"]["of"] == 150
    states = decoded(data["bodies"]["state"], np.uint8, 150)
    assert (states[:colliding] == 2).all() and (states[colliding:] == 0).all() and colliding > 0
    pairs = decoded(contacts["bodies"], np.int32, contacts["count"], 2)
    names = decoded(data["bodies"]["id"], np.uint32, 150)[pairs]
    assert {tuple(row) for row in names.tolist()} == {
        tuple(row) for row in step.before.id[step.contacts.pairs].tolist()
    }
    shown = vertices_at(data, 0, 1.0)  # where the bodies are after the step
    local = snapshot.meshes[0].vertices.numpy()
    for row in range(0, 150, 10):
        expected = placed(local, snapshot.position[row, None], snapshot.orientation[row, None])[0]
        assert np.allclose(shown[int(snapshot.ids[row])], expected, atol=1e-4)


def test_large_meshes_are_simplified_within_the_size_promised() -> None:
    rng = np.random.default_rng(4)
    n = 600
    grid = np.stack(np.meshgrid(np.arange(n), np.arange(n), indexing="ij"), axis=-1).reshape(-1, 2) / n
    a = (np.arange(n - 1)[:, None] * n + np.arange(n - 1)).ravel()
    faces = np.concatenate([np.stack([a, a + n, a + 1], 1), np.stack([a + 1, a + n, a + n + 1], 1)])
    soup = rng.uniform(size=(len(grid), 1))  # heights
    mesh = pgccd.Mesh(np.concatenate([grid, 0.05 * soup], axis=1), faces)
    small = ball(1, 0.05)
    scene = pgccd.Scene([mesh, small], [0, 1])
    x = torch.tensor([[0.0, 0, 0], [0.5, 0.5, 0.3]]).double()
    q = torch.tensor([IDENTITY] * 2).double()
    motion = pgccd.RigidMotion(x, q, x - torch.tensor([[0, 0, 0], [0, 0, 0.3]]), q)
    hits = pgccd.detect(scene, motion)
    page = viz.Page.of(scene, motion, hits)
    assert 2e6 < len(page.html) < 5e6
    (note,) = page.left_out
    found = re.fullmatch(
        r"Mesh 0 is drawn with ([\d,]+) of its 717,602 triangles: vertices moved by up to (\S+)\.", note
    )
    assert found and int(found[1].replace(",", "")) > 50_000 and float(found[2]) < 0.02
    kinds = data_of(page)["rigid"]["kinds"]
    vertices = data_of(page)["scale"] * decoded(kinds[0]["vertices"], np.float32, -1, 3).astype(float)
    assert np.isclose(vertices, mesh.vertices[0].numpy(), atol=1e-6).any() and len(vertices) < len(mesh.vertices)
    # The features of the contact are drawn as they are.
    corners = {0: [int(hits.features[0, 0])], 1: mesh.faces[int(hits.features[0, 0])].tolist()}[int(hits.kind[0])]
    for corner in mesh.vertices[corners].numpy():
        assert np.linalg.norm(vertices - corner, axis=1).min() < 1e-6
    assert decoded(kinds[1]["vertices"], np.float32, -1, 3).shape == tuple(small.vertices.shape)


def test_large_scenes_keep_the_bodies_that_collide() -> None:
    rng, count = np.random.default_rng(5), 60_000
    x = torch.from_numpy(rng.uniform(-60, 60, (count, 3)))
    q = torch.tensor([IDENTITY]).double().repeat(count, 1)
    scene, motion = pgccd.Scene([ball(0, 0.3)], [0] * count), pgccd.RigidMotion(x, q, x + 0.5, q)
    hits = pgccd.detect(scene, motion)
    colliding = set(hits.pairs.unique().tolist())
    assert 100 < len(colliding) < content._MOST_ROWS
    page = viz.Page.of(scene, motion, hits)
    data = data_of(page)
    assert len(page.html) < 5e6 and data["bodies"]["count"] == content._MOST_ROWS
    ids = decoded(data["bodies"]["id"], np.uint32, content._MOST_ROWS).tolist()
    assert colliding <= set(ids)
    assert f"36,000 of 60,000 bodies are on this page, all {len(colliding):,} that collide among them." in page.left_out


def test_long_trajectories_keep_the_segments_with_contacts() -> None:
    waypoints, count = 3000, 40
    time = torch.linspace(0, 1, waypoints).double()
    x = torch.zeros(waypoints, count, 3).double()
    x[:, :, 0] = 3.0 * torch.arange(count)
    x[:, 1, 0] += 5.0 * torch.sin(3.0 * time)  # meets its neighbour
    x[:, 0, 2] = 5.0 * time
    q = torch.zeros(waypoints, count, 4).double()
    q[..., 0], q[..., 3] = torch.cos(2.0 * time)[:, None], torch.sin(2.0 * time)[:, None]
    scene, trajectory = pgccd.Scene([ball(1)], [0] * count), pgccd.Trajectory(x, q)
    hits = pgccd.detect(scene, trajectory)
    assert len(hits) > 0
    page = viz.Page.of(scene, trajectory, hits)
    assert len(page.html) < 5e6 and "waypoints are on this page" in page.left_out[0]
    data = data_of(page)
    kept = data["waypoints"]
    assert kept[0] == 0 and kept[-1] == waypoints - 1 and len(kept) <= 902 and kept == sorted(set(kept))
    segments = decoded(data["contacts"]["segment"], np.int32, len(hits)).tolist()
    local = scene.meshes.meshes[0].vertices.numpy()
    for number, segment in enumerate(segments):
        row = int(hits.segment.sort().values[number])
        assert (kept[segment], kept[segment + 1]) == (row, row + 1)
        position, orientation = trajectory.segment(row).at(0.5)
        expected = placed(local, position[1:2].numpy(), orientation[1:2].numpy())[0]
        assert np.allclose(vertices_at(data, segment, 0.5)[1], expected, atol=1e-4)
    # A merged segment ends where the next one begins.
    merged = next(k for k in range(len(kept) - 2) if kept[k + 1] > kept[k] + 1)
    assert np.allclose(vertices_at(data, merged, 1.0)[7], vertices_at(data, merged + 1, 0.0)[7], atol=1e-4)


@pytest.mark.parametrize("waypoints", [2, 400])
def test_large_deforming_scenes_stay_within_the_size_promised(waypoints: int) -> None:
    rng = np.random.default_rng(6)
    bodies = 300 if waypoints == 2 else 2
    scene = pgccd.Scene([ball(4)], [0] * bodies)
    base = np.concatenate([scene.meshes.meshes[0].vertices.numpy() + 3.0 * k for k in range(bodies)])
    drift = rng.normal(size=(waypoints, 1, 3)) * 0.01
    x = torch.from_numpy(base + drift.cumsum(axis=0))
    page = viz.Page.of(scene, pgccd.Trajectory(x))
    assert 1e6 < len(page.html) < 5e6 and page.left_out
    data = data_of(page)
    assert data["bodies"]["count"] == bodies
    for body, vertices in vertices_at(data, 0, 0.0).items():  # of those drawn, all are vertices of the body
        nearest = np.abs(vertices[:5, None] - base[body * 2562 : (body + 1) * 2562] - drift[0]).max(axis=2).min(axis=1)
        assert (nearest < 1e-3).all()


def test_worlds_margins_and_static_bodies() -> None:
    x = torch.tensor([[0.0, 0, 0], [0.5, 0, 0], [0, 0, 0], [9.0, 0, 0]]).double()
    q = torch.tensor([IDENTITY] * 4).double()
    scene = pgccd.Scene([ball(0)], [0] * 4, world=[0, 1, 1, 0], margin=[0.0, 0.1, 0, 0], static=[False] * 3 + [True])
    motion = pgccd.RigidMotion.at_rest(x, q)
    hits = pgccd.detect(scene, motion)
    data = data_of(viz.Page.of(scene, motion, hits))
    order = decoded(data["bodies"]["id"], np.uint32, 4)
    assert hits.pairs.tolist() == [[1, 2]] and data["bodies"]["worlds"] == [0, 1] and not data["moving"]
    assert decoded(data["bodies"]["world"], np.int32, 4).tolist() == [[0, 1, 1, 0][k] for k in order]
    margins = data["scale"] * decoded(data["bodies"]["margin"], np.float32, 4)
    assert np.allclose(margins, np.array([0.0, 0.1, 0, 0])[order])
    assert decoded(data["bodies"]["state"], np.uint8, 4).tolist() == [[0, 2, 2, 1][k] for k in order]


@pytest.mark.filterwarnings("error")
def test_extreme_sizes_and_triangles_without_area() -> None:
    flat = pgccd.Mesh([[0, 0, 0], [1, 0, 0], [2, 0, 0], [0, 1, 0]], [[0, 1, 2], [0, 1, 3]])
    q = torch.tensor([IDENTITY] * 2).double()
    for scale in (1e-20, 1.0, 1e20):
        mesh = pgccd.Mesh(scale * flat.vertices, flat.faces)
        x = scale * torch.tensor([[0.0, 0, 0], [0, 0, 1]]).double()
        data = data_of(viz.Page.of(pgccd.Scene([mesh], [0, 0]), pgccd.RigidMotion(x, q, x, q)))
        assert all(np.isfinite(v).all() and np.abs(v).max() < 4 * scale for v in vertices_at(data, 0, 1.0).values())
    none = pgccd.Scene([flat], [])
    assert data_of(viz.Page.of(none, pgccd.RigidMotion(*[torch.zeros(0, k).double() for k in (3, 4, 3, 4)])))
