"""`pgccd audit`, and rollouts read frame by frame."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import torch
from support.rollouts import planted, rows_of, tumbling

import pgccd
from pgccd import files
from pgccd.cli import main


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Files of a rollout: meshes, a scene, and poses."""
    trimesh = pytest.importorskip("trimesh")
    rollout, _ = planted(np.random.default_rng(4), 3, 6, passing=1.0)
    for k, half in enumerate(rollout.half):
        trimesh.creation.box(2.0 * half).export(tmp_path / f"{k}.ply")
    np.savez(tmp_path / "rollout.npz", position=rollout.position, orientation=rollout.orientation)
    names = [f"{k}.ply" for k in range(6)]
    scene = {"meshes": names, "mesh_index": list(range(6)), "poses": "rollout.npz", "static": [True] * 3 + [False] * 3}
    (tmp_path / "scene.json").write_text(json.dumps(scene))
    return tmp_path


def test_audit_of_files(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    scene, motion = files.load_scene(folder / "scene.json")
    assert isinstance(motion, pgccd.Trajectory)
    rows = rows_of(pgccd.audit(scene, motion).passages)
    assert len(rows) > 0
    page = folder / "passages.html"
    assert main(["audit", "--scene", str(folder / "scene.json"), "--page", str(page)]) == 0
    *lines, last = capsys.readouterr().out.splitlines()
    assert last == f"bodies=6 frames=6 passages={len(rows)} touching=0 enclosed=0 page={page}"
    assert len(lines) == len(rows) and all("measure=" in line and "approach=" in line for line in lines)
    assert page.stat().st_size > 10_000
    meshes = [str(folder / f"{k}.ply") for k in range(6)]
    assert main(["audit", *meshes, "--motion", str(folder / "rollout.npz"), "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert {(row["segment"], *row["pair"]) for row in found["passages"]} == rows and found["frames"] == 6
    assert found["touching"] == {"pairs": [], "first": [], "last": []} and found["enclosed"] == []


def test_rotations_and_margins_are_read_as_trajectories(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with np.load(folder / "rollout.npz") as archive:
        columns = {name: archive[name] for name in archive.files}
    columns["margin"] = np.full((5, 6), 0.01)
    np.savez(folder / "rollout.npz", **columns)
    assert main(["audit", "--scene", str(folder / "scene.json"), "--quiet"]) == 0
    assert "frames=6 passages=" in capsys.readouterr().out
    # Nothing passes: no page.
    page = folder / "none.html"
    still = {name: column[:1].repeat(3, axis=0) for name, column in columns.items() if name != "margin"}
    np.savez(folder / "rollout.npz", **still)
    assert main(["audit", "--scene", str(folder / "scene.json"), "--page", str(page)]) == 0
    assert "no passages" in capsys.readouterr().err and not page.exists()


def test_mistakes(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    one = {"position_t0": np.zeros((6, 3)), "orientation_t0": np.eye(4)[:1].repeat(6, axis=0)}
    step = one | {"position_t1": np.zeros((6, 3)), "orientation_t1": one["orientation_t0"]}
    bad = {"position": np.zeros((3, 6, 3)), "orientation": np.zeros((3, 6, 4))}
    few = {"position": np.zeros((3, 5, 3)), "orientation": np.eye(4)[:1].repeat(15, axis=0).reshape(3, 5, 4)}
    for columns, message in (
        (few, "scene.json: mesh_index: expected the meshes of 5 bodies, of which rollout.npz has poses, got 6 values"),
        (step, "argument --scene: expected a trajectory: position"),
        (bad, "argument --scene: trajectory: counted from frame 0: orientation: waypoint 0, body 0"),
    ):
        np.savez(folder / "rollout.npz", **columns)
        assert main(["audit", "--scene", str(folder / "scene.json")]) == 2
        error = capsys.readouterr().err
        assert error.startswith("pgccd audit: error: ") and message in error and error.count("\n") == 1
    for option in ("--min-separation", "--tolerance"):
        assert main(["audit", "--scene", str(folder / "scene.json"), option, "-1"]) == 2
        assert f"argument {option}: expected" in capsys.readouterr().err


@pytest.mark.parametrize("save", [np.savez, np.savez_compressed])
@pytest.mark.parametrize("dtype", [np.float64, np.float32, np.int64])
def test_frames_are_those_of_the_file(save: object, dtype: type, tmp_path: Path) -> None:
    rollout = tumbling(np.random.default_rng(0), 4, 5, 2.0)
    position, path = (9.0 * rollout.position).astype(dtype), tmp_path / "rollout.npz"
    save(path, position=position, orientation=rollout.orientation)  # type: ignore[operator]
    frames = list(files.iterate_frames(path))
    assert len(frames) == 5
    for frame, x, q in zip(frames, position, rollout.orientation, strict=True):
        assert isinstance(frame, tuple) and all(column.dtype == torch.float64 for column in frame)
        assert frame[0].tolist() == x.astype(np.float64).tolist() and frame[1].tolist() == q.tolist()
    save(path, position=position)  # type: ignore[operator]
    vertices = list(files.iterate_frames(path))
    assert all(isinstance(frame, torch.Tensor) for frame in vertices) and len(vertices) == 5


def test_files_that_are_not_rollouts(tmp_path: Path) -> None:
    path = tmp_path / "rollout.npz"
    x, q = np.zeros((4, 2, 3)), np.zeros((4, 2, 4))
    for columns, message in (
        ({"position": x, "orientation": q, "margin": q[1:, :, 0]}, r"expected position \(T, N, 3\) and orientation"),
        (
            {"position": x[0], "orientation": q},
            r"position: expected an array \(T, N, width\) in C order, got .*\(2, 3\)",
        ),
        ({"position": np.asfortranarray(x), "orientation": q}, "in Fortran order"),
        ({"position": x.astype(object), "orientation": q}, "expected an array"),
        ({"position": 1j * x, "orientation": q}, "position: expected numbers, got complex128"),
        ({"position": x[:3], "orientation": q}, "expected the same number of frames in both"),
    ):
        np.savez(path, **columns)  # type: ignore[arg-type]
        with pytest.raises(ValueError, match=message):
            list(files.iterate_frames(path))
    np.savez(path, position=x, orientation=q)
    content = path.read_bytes()
    path.write_bytes(content[: len(content) // 2])
    with pytest.raises(ValueError, match="cannot be read as an npz file"):
        files.iterate_frames(path)
    with pytest.raises(ValueError, match="cannot be read as an npz file"):
        files.iterate_frames(tmp_path / "none.npz")
    np.savez(path, position=np.ones((4, 200, 3)), orientation=np.ones((4, 200, 4)))
    content = bytearray(path.read_bytes())
    content[4000] ^= 255  # a bit of a row, against the sum of the archive
    path.write_bytes(content)
    with pytest.raises(ValueError, match="position: frame . cannot be read"):
        list(files.iterate_frames(path))
