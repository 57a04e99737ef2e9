"""Segments and points, and with them spheres and capsules, in all that writes or reads meshes: scene files, states,
checkpoints, runs of simulators, and the command line.
"""

from __future__ import annotations

import io
import json
from pathlib import Path

import numpy as np
import pytest
import torch

import pgccd
from pgccd import files
from pgccd.cli import main
from pgccd.distributed import World
from pgccd.simulators.simulator import Simulator

X0 = torch.tensor([[0.0, 0, 0], [3, 0, 0], [0, 3, 0], [3, 3, 0]]).double()
X1 = torch.tensor([[1.5, 0, 0], [1.6, 0, 0], [0, 1.5, 0], [0, 2.0, 0]]).double()
Q = torch.tensor([[1.0, 0, 0, 0]] * 4).double()


def mixed() -> pgccd.Mesh:
    """Two triangles, two segments and a point."""
    vertices = np.random.default_rng(2).normal(size=(8, 3))
    faces, segments = [[0, 1, 2], [0, 2, 3]], [[3, 4], [4, 5]]
    return pgccd.Mesh(vertices, faces, "centroid", segments=segments, points=[6], thickness=0.05)


def scene() -> pgccd.Scene:
    return pgccd.Scene([pgccd.Mesh.sphere(0.4), pgccd.Mesh.capsule(0.2, 1.0), mixed()], [0, 1, 2, 0])


def require_same(found: pgccd.Mesh, expected: pgccd.Mesh) -> None:
    for name in ("triangle_count", "segment_count", "point_count", "thickness", "radius", "solid"):
        assert getattr(found, name) == getattr(expected, name), name
    for name in ("vertices", "faces", "edges", "origin"):
        assert torch.equal(getattr(found, name), getattr(expected, name)), name


def require_same_meshes(found: pgccd.Scene, expected: pgccd.Scene) -> None:
    for one, other in zip(found.meshes.meshes, expected.meshes.meshes, strict=True):
        require_same(one, other)


def test_states_of_meshes_and_scenes() -> None:
    for mesh in scene().meshes.meshes:
        file = io.BytesIO()
        torch.save(mesh.state_dict(), file)
        file.seek(0)
        require_same(pgccd.Mesh.from_state_dict(torch.load(file, weights_only=True)), mesh)
    require_same_meshes(pgccd.Scene.from_state_dict(scene().state_dict()), scene())


def test_saved_scenes(tmp_path: Path) -> None:
    motion = pgccd.RigidMotion(X0, Q, X1, Q)
    path = files.save_scene(tmp_path / "s.json", scene(), motion)
    again, moved = files.load_scene(path)
    require_same_meshes(again, scene())
    hits = pgccd.detect(scene(), motion)
    assert len(hits) >= 2 and pgccd.detect(again, moved) == hits


def test_scene_files_name_clouds_and_lines(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "wire.obj").write_text("v 0 0 0\nv 1 0 0\nv 1 1 0\nl 1 2 3\np 1\n")
    head = "ply\nformat ascii 1.0\nelement vertex 2\nproperty float x\nproperty float y\nproperty float z\n"
    (tmp_path / "cloud.ply").write_text(f"{head}end_header\n0 0 0\n0 0 1\n")
    content = {"meshes": ["wire.obj", "cloud.ply"], "mesh_index": [0, 1], "poses": "p.npz", "thickness": [0.1, 0.2]}
    (tmp_path / "s.json").write_text(json.dumps(content))
    start, end = np.array([[0.0, 0, 0], [5, 0, 0]]), np.array([[0.0, 0, 0], [0.5, 0, 0]])
    np.savez(tmp_path / "p.npz", position_t0=start, position_t1=end, orientation_t0=Q[:2], orientation_t1=Q[:2].numpy())
    made, motion = files.load_scene(tmp_path / "s.json")
    wire, cloud = made.meshes.meshes
    assert (wire.segment_count, wire.point_count, wire.thickness) == (2, 1, 0.1)
    assert (cloud.point_count, cloud.thickness) == (2, 0.2)
    toi = float(pgccd.detect(made, motion).toi[0])
    assert toi == pytest.approx((5.0 - 1.3) / 4.5, abs=1e-5)
    assert main(["detect", "--scene", str(tmp_path / "s.json"), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["contacts"][0]["toi"] == toi
    names = [str(tmp_path / name) for name in content["meshes"]]
    assert main(["info", *names]) == 0
    out = capsys.readouterr().out
    assert "wire.obj: 3 vertices, 2 segments, 1 points, SBV centre" in out and "2 vertices, 2 points, SBV" in out
    assert main(["info", *names, "--json"]) == 0
    wire_row, cloud_row = json.loads(capsys.readouterr().out)["meshes"]
    assert [wire_row[what] for what in ("vertices", "faces", "segments", "points")] == [3, 0, 2, 1]
    assert [cloud_row[what] for what in ("vertices", "faces", "segments", "points")] == [2, 0, 0, 2]


def test_runs_of_simulators(tmp_path: Path) -> None:
    simulator = Simulator()
    simulator.scene, simulator.names = scene(), ["ball", "rod", "rock", "other ball"]
    frames = [(X0, Q), (X1, Q), (X0, Q)]
    again, rollout = files.load_scene(simulator.save(tmp_path / "run.json", iter(frames)))
    require_same_meshes(again, scene())
    found, expected = pgccd.audit(again, rollout), pgccd.audit(scene(), frames)
    assert found.passages == expected.passages and len(found.touching.pairs) == 2
    assert torch.equal(found.touching.pairs, expected.touching.pairs)


def test_checkpoints(tmp_path: Path) -> None:
    made, motion = scene(), pgccd.RigidMotion(X0, Q, X1, Q)
    world = World.create(made, X0, (-4.0,) * 3, (4.0,) * 3)
    world.save(tmp_path)
    loaded = World.load(tmp_path, made.meshes.meshes)
    require_same_meshes(pgccd.Scene(loaded.meshes, loaded.mesh_index), made)
    hits = pgccd.detect(made, motion)
    for each in (world, loaded):
        found = each.step(motion)
        assert torch.equal(found.pairs, hits.pairs) and torch.equal(found.toi, hits.toi)
    # The same vertices as points alone are another mesh.
    points = [pgccd.Mesh.points(mesh.vertices, mesh.thickness) for mesh in made.meshes.meshes]
    with pytest.raises(ValueError, match="saved with others"):
        World.load(tmp_path, points)
