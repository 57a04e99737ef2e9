"""Scenes, motions and configurations of files: every column arrives, and what is missing or too much is named."""

from __future__ import annotations

import io
import json
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

import pgccd
from pgccd import files

RNG = np.random.default_rng(0)


def unit(*shape: int) -> np.ndarray:
    q = RNG.normal(size=(*shape, 4))
    return q / np.linalg.norm(q, axis=-1, keepdims=True)


X, Q, W = RNG.normal(size=(3, 2, 3)), unit(3, 2), RNG.normal(size=(2, 2, 3))
MARGIN = np.array([[0.1, 0.2], [0.3, 0.4]])
ENDS = {"position_t0": X[0], "orientation_t0": Q[0], "position_t1": X[1], "orientation_t1": Q[1]}
VELOCITIES = {
    **{"position_t0": X[0], "orientation_t0": Q[0]},
    **{"linear_velocity": W[0], "angular_velocity": W[1], "dt": np.array(0.1)},
}


def loaded(folder: Path, **columns: Any) -> Any:
    np.savez(folder / "motion.npz", **columns)
    return files.load_motion(folder / "motion.npz")


def same(one: pgccd.RigidMotion, other: pgccd.RigidMotion) -> bool:
    names = ("position_t0", "orientation_t0", "position_t1", "rotation")
    return all(torch.equal(getattr(one, name), getattr(other, name)) for name in names)


def test_every_column_of_a_motion_arrives(tmp_path: Path) -> None:
    x, q, w = (torch.tensor(values) for values in (X, Q, W))
    assert same(loaded(tmp_path, **ENDS), pgccd.RigidMotion(x[0], q[0], x[1], q[1]))
    assert same(loaded(tmp_path, **VELOCITIES), pgccd.RigidMotion.from_velocity(x[0], q[0], w[0], w[1], 0.1))
    motion = loaded(tmp_path, x_t0=X[0], x_t1=X[1])
    assert isinstance(motion, pgccd.VertexMotion)
    assert motion.x_t0.tolist() == X[0].tolist() and motion.x_t1.tolist() == X[1].tolist()
    # The same ends by a turn more: only the column says so.
    turns = np.stack([pgccd.Trajectory(x, q).segment(k).rotation.numpy() for k in (0, 1)])
    turns *= 1.0 + 2.0 * np.pi / np.linalg.norm(turns, axis=-1, keepdims=True)
    motion = loaded(tmp_path, position=X, orientation=Q, rotation=turns, margin=MARGIN)
    assert isinstance(motion, pgccd.Trajectory) and motion.margin is not None
    assert motion.margin.tolist() == MARGIN.tolist() and motion.position.tolist() == X.tolist()
    assert np.allclose(motion.segment(1).rotation.numpy(), turns[1], atol=1e-12)
    assert loaded(tmp_path, position=X, margin=MARGIN).margin.tolist() == MARGIN.tolist()


@pytest.mark.parametrize(
    ("columns", "message"),
    [
        ({**ENDS, "linear_velocity": W[0]}, "has 'position_t1' beside velocities: expected the one or the other"),
        ({**VELOCITIES, "orientation_t1": Q[1]}, "has 'orientation_t1' beside velocities"),
        (
            {"position": X, "orientation": Q, "x_t0": X[0]},
            "has 'position' beside 'x_t0': expected the one or the other",
        ),
        ({"position": X, "orientation": Q, "dt": np.array(0.1)}, "has 'dt' beside 'position'"),
        ({"x_t0": X[0]}, "has no 'x_t1'"),
        ({name: ENDS[name] for name in list(ENDS)[:3]}, "has no 'orientation_t1'"),
        ({name: VELOCITIES[name] for name in list(VELOCITIES)[:4]}, "has no 'dt'"),
        ({"orientation_t0": Q[0]}, "has no 'position_t0'"),
        ({**VELOCITIES, "dt": np.array([0.1, 0.2])}, r"dt: expected one number, got shape \(2,\)"),
        ({**ENDS, "position_t1": 1j * X[1]}, "position_t1: expected numbers, got complex128"),
        ({**ENDS, "position_t1": X[1] > 0}, "position_t1: expected numbers, got bool"),
        ({**ENDS, "position_t1": X[1, :1]}, "position"),
        ({**ENDS, "positon_t1": X[1]}, "has an unknown key 'positon_t1', perhaps for 'position_t1'; known are"),
    ],
)
def test_motions_that_are_not_one(columns: dict[str, Any], message: str, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=f"motion.npz.*{message}"):
        loaded(tmp_path, **columns)


def test_configurations(tmp_path: Path) -> None:
    path = tmp_path / "path.npz"
    np.savez(path, q=X[0])
    assert files.load_configurations(path).tolist() == X[0].tolist()
    for columns, message in (
        ({"q": X}, r"q: expected shape \(T, J\), got \(3, 2, 3\)"),
        ({"q": X[0], "dt": X[0]}, r"expected q \(T, J\), got dt, q"),
        ({}, r"expected q \(T, J\), got nothing"),
        ({"q": np.array([["a"]])}, "q: expected numbers"),
    ):
        np.savez(path, **columns)  # type: ignore[arg-type]
        with pytest.raises(ValueError, match=f"path.npz: {message}"):
            files.load_configurations(path)


def test_every_entry_of_a_scene_arrives(tmp_path: Path) -> None:
    trimesh = pytest.importorskip("trimesh")
    trimesh.creation.box([1.0, 2.0, 3.0]).export(tmp_path / "box.ply")
    np.savez(tmp_path / "poses.npz", position=X, orientation=Q)
    scene = {
        **{"meshes": ["box.ply", "box.ply"], "mesh_index": [1, 0], "poses": "poses.npz"},
        **{"group": [3, 4], "mask": [5, 6], "world": [0, 1], "static": [True, False], "margin": [0.1, 0.2]},
        **{"exclude": [[0, 1]], "origin": ["centroid", [0.5, 0.0, 0.25]]},
    }

    def load(**changed: Any) -> tuple[pgccd.Scene, Any]:
        (tmp_path / "scene.json").write_text(json.dumps(scene | changed))
        return files.load_scene(tmp_path / "scene.json")

    made, motion = load()
    assert motion.position.tolist() == X.tolist()
    for name in ("mesh_index", "group", "mask", "world", "static", "margin", "exclude"):
        assert getattr(made, name).tolist() == scene[name], name
    assert made.meshes.meshes[1].origin.tolist() == [0.5, 0.0, 0.25]
    assert np.allclose(made.meshes.meshes[0].origin, 0.0)
    # The format states no unit: lengths are taken to be in metres.
    assert made.meshes.meshes[0].unit == 1.0
    for origin in ([[0.0, 0.0, 0.0]], "centroid"):
        with pytest.raises(ValueError, match="scene.json: origin: expected a list of 2 values, one a mesh, got"):
            load(origin=origin)
    with pytest.raises(ValueError, match="scene.json has no 'poses'"):
        (tmp_path / "scene.json").write_text(json.dumps({k: v for k, v in scene.items() if k != "poses"}))
        files.load_scene(tmp_path / "scene.json")


def test_only_frames_are_iterated(tmp_path: Path) -> None:
    """Files with rotations or margins are trajectories: read as frames they would lose these."""
    path = tmp_path / "rollout.npz"
    for more in ({"margin": MARGIN}, {"rotation": W}):
        np.savez(path, position=X, orientation=Q, **more)
        assert files.frame_columns(path) is None
        with pytest.raises(ValueError, match=r"rollout.npz: expected position \(T, N, 3\) and orientation"):
            files.iterate_frames(path)


@pytest.mark.parametrize("kept", [0, 48, 100, 143])
def test_frames_that_are_not_there(kept: int, tmp_path: Path) -> None:
    """An array that declares more rows than it holds, in an archive that is whole."""
    whole = io.BytesIO()
    np.save(whole, X)
    content = whole.getvalue()
    with zipfile.ZipFile(tmp_path / "rollout.npz", "w") as archive:
        archive.writestr("position.npy", content[: len(content) - X.nbytes + kept])
    frames = files.iterate_frames(tmp_path / "rollout.npz")
    for frame in X[: kept // 48]:
        found = next(frames)
        assert isinstance(found, torch.Tensor) and found.tolist() == frame.tolist()
    with pytest.raises(ValueError, match=f"position: expected 3 frames, but the file ends in frame {kept // 48}"):
        next(frames)
