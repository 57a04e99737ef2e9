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
from support.steps import step_of

import pgccd
from pgccd import sim, viz
from pgccd.runtime.sizes import sizes_of
from pgccd.viz import content
from pgccd.viz.animation import Marks, RigidPaths, animation_of
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
    segments, found = len(data["waypoints"]) - 1, []
    fraction = np.ones(count)
    if "fraction" in data["bodies"]:
        fraction = decoded(data["bodies"]["fraction"], np.float32, segments, count)[segment]
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
        ends = np.array(data["deforming"]["ends"])
        all_vertices = decoded(data["deforming"]["vertices"], np.float32, ends.max() + 1, -1, 3).astype(float)
        counts = decoded(data["deforming"]["vertex_counts"], np.uint32, count)
        t = time * np.repeat(fraction, counts)[:, None]
        start, end = ends[segment]
        mixed = (1 - t) * all_vertices[start] + t * all_vertices[end]
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
    motion = pgccd.RigidMotion(x, q, -x, q)
    whole = pgccd.detect(scene, motion)
    capacity = replace(sizes_of(pgccd.Capacity.of(30)), contacts=len(whole) - 2)
    padded = pgccd.detect(scene, motion, capacity=capacity)
    assert bool(padded.overflow) and (padded.toi == 0).all()
    page = viz.Page.of(scene, motion, padded)
    assert "incomplete" in page.notes[0] and page.notes[0][:20] in page.html
    contacts = data_of(page)["contacts"]
    tois = decoded(contacts["toi"], np.float64, contacts["count"])
    assert set(tois) <= set(whole.toi.tolist()) and tois.max() > 0.0
    pairs = viz.Page.of(scene, motion, pgccd.collide(scene, motion))
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


def test_page_of_the_model_is_self_contained_and_plays_all_robots() -> None:
    model = sim.Model(sim.ModelConfig(robots=150, speed=0.25))
    state, steps = model.start(), []
    for index in range(12):
        steps.append(step_of(model, state, index))
        state = steps[-1].after
    page = sim.page_of_steps(model, steps[8:], ["A <title>", "figures"])
    assert len(page.html) < 5e6 and page.left_out == []
    assert "A &lt;title&gt;" in page.html and "@" not in re.sub(r"@media|@keyframes", "", page.html.split("<script")[0])
    assert not re.search(r"(src|href)\s*=|https?://|@import", page.html)
    data = data_of(page)
    kind = data["rigid"]["kinds"][0]
    assert kind["count"] == data["bodies"]["count"] == data["bodies"]["of"] == 150
    assert data["step"] == 8 and len(data["waypoints"]) == 5 and data["playing"]
    stopped = torch.stack([step.resolution.stopped for step in steps[8:]]).numpy()
    ids, contacts = decoded(data["bodies"]["id"], np.uint32, 150), data["contacts"]
    assert np.array_equal(decoded(data["bodies"]["hit"], np.uint8, 4, 150), stopped[:, ids])
    states, colliding = decoded(data["bodies"]["state"], np.uint8, 150), int(stopped.any(axis=0).sum())
    assert (states[:colliding] == 2).all() and (states[colliding:] == 0).all() and colliding > 0
    names = ids[decoded(contacts["bodies"], np.int32, contacts["count"], 2)]
    segments = decoded(contacts["segment"], np.int32, contacts["count"])
    local = model.meshes.meshes[0].vertices.numpy()
    for segment, step in enumerate(steps[8:]):
        pairs = {tuple(row) for row in names[segments == segment].tolist()}
        assert pairs == {tuple(row) for row in step.before.id[step.contacts.pairs].tolist()}
        shown = vertices_at(data, segment, 1.0)  # where the bodies are after the step
        for row in range(0, 150, 10):
            pose = step.after.position[row, None].numpy(), step.after.orientation[row, None].numpy()
            assert np.allclose(shown[int(state.id[row])], placed(local, *pose)[0], atol=1e-4)
    with pytest.raises(ValueError, match="^steps: expected at least one step"):
        sim.page_of_steps(model, [])


def recorded(is_rigid: bool) -> tuple[pgccd.Scene, list[Any], list[Any], list[torch.Tensor]]:
    """Steps of a loop, each of which begins where bodies have been stopped in the one before."""
    rng, mesh = np.random.default_rng(7), ball(1)
    scene = pgccd.Scene([mesh], [0, 0, 0])
    x = torch.tensor([[0.0, 0, 0], [3.0, 0, 0], [0, 5.0, 0]]).double()
    q = torch.tensor([IDENTITY] * 3).double()
    motions: list[Any] = []
    for _ in range(4):
        v = torch.from_numpy(rng.normal(size=(3, 3))) - 0.5 * x
        if is_rigid:
            motions.append(pgccd.RigidMotion.from_velocity(x, q, v, torch.from_numpy(rng.normal(size=(3, 3))), 1.0))
        else:
            vertices = [(column[:, None] + mesh.vertices).reshape(-1, 3) for column in (x, x + v)]
            motions.append(pgccd.VertexMotion(*vertices))
        found = pgccd.detect(scene, motions[-1])
        fraction = pgccd.resolve(scene, motions[-1]).fraction
        if is_rigid:
            x, q = motions[-1].at(fraction)
        else:
            x = x + fraction[:, None] * v
    hits = [pgccd.detect(scene, motion) for motion in motions]
    assert sum(map(len, hits)) > 1 and len(found) == len(hits[-1])
    return scene, motions, hits, [pgccd.resolve(scene, motion).fraction for motion in motions]


@pytest.mark.parametrize("is_rigid", [True, False])
def test_recorded_steps_are_shown_one_after_another(is_rigid: bool) -> None:
    scene, motions, hits, fractions = recorded(is_rigid)
    given: Any = [None if len(found) == 0 else found for found in hits]
    page = viz.Page.of(scene, motions, given, fraction=fractions)
    data = data_of(page)
    count = sum(map(len, hits))
    assert page.title == f"3 bodies, 4 steps, {count} contact{'s' * (count > 1)}" and data["step"] == 0
    assert decoded(data["contacts"]["segment"], np.int32, count).tolist() == [
        segment for segment, found in enumerate(hits) for _ in found.toi
    ]
    tois = torch.cat([found.toi.sort().values for found in hits])
    assert np.array_equal(decoded(data["contacts"]["toi"], np.float64, count), tois)
    ids = decoded(data["bodies"]["id"], np.uint32, 3)
    hit = decoded(data["bodies"]["hit"], np.uint8, 4, 3)
    local = scene.meshes.meshes[0].vertices.numpy()
    for segment, (motion, fraction) in enumerate(zip(motions, fractions, strict=True)):
        assert set(ids[hit[segment] > 0].tolist()) == set(hits[segment].pairs.flatten().tolist())
        for time in (0.0, 0.7, 1.0):
            shown = vertices_at(data, segment, time)
            if is_rigid:
                position, orientation = (column.numpy() for column in motion.at(time * fraction))
                expected = placed(local, position, orientation)
            else:
                t = time * fraction.repeat_interleave(len(local))[:, None]
                expected = ((1 - t) * motion.x_t0 + t * motion.x_t1).view(3, -1, 3).numpy()
            for body in range(3):
                assert np.allclose(shown[body], expected[body], atol=1e-5)
    whole = data_of(viz.Page.of(scene, motions, fraction=0.5))
    assert (decoded(whole["bodies"]["fraction"], np.float32, 4, 3) == 0.5).all() and whole["contacts"]["count"] == 0
    table = data_of(viz.Page.of(scene, motions, given, fraction=torch.stack(fractions)))
    assert table == data


def test_steps_of_a_trajectory_are_that_trajectory() -> None:
    rng, scene = np.random.default_rng(8), pgccd.Scene([ball(1), ball(0)], [0, 1, 0])
    (x, q), (y, r), (z, p) = (rows_of(rng, 3) for _ in range(3))
    vertices = torch.from_numpy(rng.normal(size=(4, scene.layout.vertex_count, 3)))
    for trajectory in (pgccd.Trajectory(torch.stack([x, y, z]), torch.stack([q, r, p])), pgccd.Trajectory(vertices)):
        steps: list[Any] = [trajectory.segment(k) for k in range(trajectory.segment_count)]
        whole, listed = data_of(viz.Page.of(scene, trajectory)), data_of(viz.Page.of(scene, steps))
        assert whole | {"step": 0} == listed


def test_long_runs_are_joined_where_nothing_happens() -> None:
    scene, count = pgccd.Scene([ball(1)], [0, 0]), 40_000
    q = torch.tensor([IDENTITY] * 2).double()
    places = torch.zeros(count + 1, 2, 3).double()
    places[:, 0, 0], places[:, 1, 1] = torch.arange(count + 1) * 0.5, 5.0
    # Columns of one step, seen as many: making so many motions takes longer than the page.
    half = [torch.tensor([0.5, 1.0]).double()] * count
    animation = animation_of(scene, [pgccd.RigidMotion(places[0], q, places[1], q)] * 2, None, half[:2])
    paths = animation.paths
    assert isinstance(paths, RigidPaths)
    start = places[:-1].numpy()
    turn, spin = (np.repeat(column[:1], count, axis=0) for column in (paths.orientation, paths.rotation))
    step = np.array([[1.0, 0, 0], [0, 0, 0]])  # body 0 moves half of its path
    long = replace(
        animation,
        paths=RigidPaths(start, start + step, turn, spin),
        hit=np.zeros((count, 2), dtype=bool),
        fraction=np.stack([column.numpy() for column in half]),
    )
    page = viz.Page(long)
    data, kept = data_of(page), data_of(page)["waypoints"]
    assert page.left_out == [
        f"{len(kept) - 1:,} of 40,000 steps are on this page: in those left out, paths are approximate."
    ]
    assert kept[-2:] == [count - 1, count]  # the last step has no next one to end at
    for segment in (0, 1, len(kept) - 3, len(kept) - 2):
        middle = vertices_at(data, segment, 1.0)[0].mean(axis=0)
        assert np.allclose(middle, places[kept[segment + 1], 0], atol=1e-2)


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


def test_contacts_come_before_bodies_that_do_not_collide() -> None:
    """Random walks with more contacts than evenly spaced waypoints; what is left out collides with nothing."""
    bodies, waypoints, rng = 600, 301, np.random.default_rng(6)
    steps = 0.03 * rng.normal(size=(waypoints, bodies, 3))
    x = torch.tensor(rng.uniform(0.0, 1.0, (1, bodies, 3)) * [40.0, 40.0, 16.0] + steps.cumsum(axis=0))
    q = torch.tensor(IDENTITY).double().expand(waypoints, bodies, 4)
    scene, trajectory = pgccd.Scene([ball(1, 0.5)], [0] * bodies), pgccd.Trajectory(x, q)
    hits = pgccd.detect(scene, trajectory)
    needed = 2 * len(hits.segment.unique())
    assert needed > content._MOST_ROWS // bodies and len(hits.pairs.unique()) < content._MOST_ROWS // needed
    page = viz.Page.of(scene, trajectory, hits)
    data = data_of(page)
    assert data["contacts"]["count"] == len(hits) and len(page.html) < 5e6
    count = data["bodies"]["count"]
    assert content._LEAST_BODIES <= count < bodies and len(page.left_out) == 2
    assert page.left_out[1].startswith(f"{count} of 600 bodies are on this page, all ")


def test_waypoints_are_kept_where_paths_bend() -> None:
    """A path of five straight parts, and a turn in one of them."""
    waypoints, kinks = 5001, [0, 700, 1900, 2000, 4400, 5000]
    places = np.interp(np.arange(waypoints), kinks, [0.0, 3.0, 1.0, 6.0, 6.5, -2.0])
    x = torch.zeros(waypoints, 10, 3).double()
    x[:, 0, 1] = torch.from_numpy(places)
    q = torch.tensor(IDENTITY).double().repeat(waypoints, 10, 1)
    scene = pgccd.Scene([ball(1)], [0] * 10)
    kept = data_of(viz.Page.of(scene, pgccd.Trajectory(x, q)))["waypoints"]
    assert set(kinks) <= set(kept) and len(kept) < 3600
    assert content.chosen_waypoints(animation_of(scene, pgccd.Trajectory(x, q)), Marks.none(), 6).tolist() == sorted(
        {*kinks, 4999}
    )
    angle = torch.linspace(0.0, 2.0, 601).double()
    q[700:1301, 0, 0], q[700:1301, 0, 3] = torch.cos(angle), torch.sin(angle)
    q[1301:] = q[1300]
    turning = content.chosen_waypoints(animation_of(scene, pgccd.Trajectory(x, q)), Marks.none(), 30)
    assert ((turning > 700) & (turning < 1300)).sum() >= 10


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


def test_one_world_of_many() -> None:
    rng, scene = np.random.default_rng(9), pgccd.Scene([ball(1), ball(0)], [0, 1, 0, 1, 1], world=[0, 2, 2, 0, 2])
    x, q = rows_of(rng, 5)
    rigid = pgccd.RigidMotion(x, q, -x, q)
    vertices = torch.from_numpy(rng.normal(size=(2, scene.layout.vertex_count, 3)))
    for motion in (rigid, pgccd.VertexMotion(*vertices)):
        hits = pgccd.detect(scene, motion)
        page = viz.Page.of(scene, motion, hits, fraction=0.5, world=2)
        data, whole = data_of(page), data_of(viz.Page.of(scene, motion, hits, fraction=0.5))
        shown, everything = vertices_at(data, 0, 0.6), vertices_at(whole, 0, 0.6)
        assert sorted(shown) == [1, 2, 4] and "world" not in data["bodies"] and page.title.startswith("3 bodies")
        assert all(np.allclose(shown[body], everything[body], atol=1e-5) for body in shown)
        of_world = torch.tensor([0, 2, 2, 0, 2])[hits.pairs[:, 0]] == 2
        number = data["contacts"]["count"]
        assert 0 < number == int(of_world.sum()) < len(hits)
        names = decoded(data["bodies"]["id"], np.uint32, 3)[decoded(data["contacts"]["bodies"], np.int32, number, 2)]
        order = hits.toi[of_world].argsort(stable=True)
        assert names.tolist() == hits.pairs[of_world][order].tolist()


def test_a_page_is_as_large_as_its_bodies_at_all_times() -> None:
    # A thin rod, hinged at its end, turns by 180 degrees about z.
    rod = pgccd.Mesh(0.5 * np.array([[2.0, 0, 0], [2, 0.1, 0], [0, 0, 0.1], [0, 0, 0]]), [[0, 1, 2], [0, 2, 3]])
    x, q = torch.tensor([[1.0, 1, 1]]).double(), torch.tensor([IDENTITY]).double()
    spin = torch.tensor([[0.0, 0, np.pi]]).double()
    data = data_of(viz.Page.of(pgccd.Scene([rod]), pgccd.RigidMotion.from_velocity(x, q, torch.zeros(1, 3), spin, 1.0)))
    times = [vertices_at(data, 0, t)[0] for t in (0.0, 0.5, 1.0)]
    seen = np.concatenate(times)
    low, high = seen.min(axis=0), seen.max(axis=0)
    assert np.allclose(data["centre"], 0.5 * (low + high), atol=0.03)
    assert data["scale"] == pytest.approx(0.5 * np.linalg.norm(high - low), rel=0.03)


@pytest.mark.parametrize("floor", ["static", "large", "small"])
def test_floors_keep_their_colour(floor: str) -> None:
    size = 2.0 if floor == "small" else 40.0
    plate, dice = pgccd.Mesh.box([size, size, 0.1]), pgccd.Mesh.box([1.0, 1.0, 1.0])
    scene = pgccd.Scene([plate, dice], static=[floor == "static", False])
    x = torch.tensor([[0.0, 0, 0], [0.1, 0.2, 2.0]]).double()
    q = torch.tensor([IDENTITY] * 2).double()
    motion = pgccd.RigidMotion(x, q, x - torch.tensor([[0, 0, 0], [0, 0, 1.8]]), q)
    data = data_of(viz.Page.of(scene, motion, pgccd.detect(scene, motion)))
    ids, states = decoded(data["bodies"]["id"], np.uint32, 2), decoded(data["bodies"]["state"], np.uint8, 2)
    assert dict(zip(ids.tolist(), states.tolist(), strict=True)) == {
        0: {"static": 7, "large": 6, "small": 2}[floor],
        1: 2,
    }


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


def test_names_of_the_bodies_of_contacts() -> None:
    """Whatever they hold, within the limits of a page, and of the world that is shown."""
    x = torch.tensor([[0.0, 0, 0], [3.0, 0, 0], [0, 0, 50.0], [0, 0, 0], [3.0, 0, 0]], dtype=torch.float64)
    q = torch.tensor([IDENTITY] * 5, dtype=torch.float64)
    scene = pgccd.Scene([pgccd.Mesh.box([1.0, 1.0, 1.0])], [0] * 5, world=[0, 0, 0, 1, 1])
    motion = pgccd.RigidMotion(x, q, x + torch.tensor([[0.0], [-1.0], [0.0], [0.0], [-1.0]]) * x[1], q)
    hits = pgccd.detect(scene, motion)
    names = ["</script><b>", "\N{SNOWMAN}" * 300, "far", "d", "e"]
    page = viz.Page.of(scene, motion, hits, names=names)
    assert page.html.count("</script>") == viz.Page.of(scene, motion, hits).html.count("</script>")
    expected = {"0": names[0], "1": names[1][:80] + "…", "3": "d", "4": "e"}
    assert data_of(page)["bodies"]["names"] == expected and data_of(viz.Page.of(scene, motion))["bodies"]["names"] == {}
    shown = data_of(viz.Page.of(scene, motion, hits, names=names, world=1))
    assert shown["bodies"]["names"] == {"3": "d", "4": "e"}
    with pytest.raises(ValueError, match="^names: expected 5 strings, one per body, got 1"):
        pgccd.show(scene, motion, hits, names=["a"])
