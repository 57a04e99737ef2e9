"""Scenes, motions and configurations of files: every column arrives, and what is missing or too much is named; what is
written is read again, bit by bit, or not there.
"""

from __future__ import annotations

import io
import json
import os
import zipfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from support.random_scenes import random_scene

import pgccd
from pgccd import files
from pgccd.motion import windows

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
        ({**ENDS, "linear_velocity": W[0]}, "has 'position_t1' beside velocities: expected only one of them"),
        ({**VELOCITIES, "orientation_t1": Q[1]}, "has 'orientation_t1' beside velocities"),
        (
            {"position": X, "orientation": Q, "x_t0": X[0]},
            "has 'position' beside 'x_t0': expected only one of them",
        ),
        ({"position": X, "orientation": Q, "dt": np.array(0.1)}, "has 'dt' beside 'position'"),
        ({"x_t0": X[0]}, "has no 'x_t1'"),
        ({name: ENDS[name] for name in list(ENDS)[:3]}, "has no 'orientation_t1'"),
        ({name: VELOCITIES[name] for name in list(VELOCITIES)[:4]}, "has no 'dt'"),
        ({"orientation_t0": Q[0]}, "has no 'position_t0'"),
        ({**VELOCITIES, "dt": np.array([0.1, 0.2])}, r"dt: expected one number, got shape \(2,\)"),
        ({**VELOCITIES, "rotation": W[0]}, "has 'rotation' beside velocities"),
        ({**ENDS, "rotation": W[0]}, "has 'orientation_t1' beside 'rotation': expected only one of them"),
        ({"position_t0": X[0], "orientation_t0": Q[0], "rotation": W[0]}, "has no 'position_t1'"),
        ({**ENDS, "path": np.array("bent")}, r"path: expected one of \['rigid', 'linear'\], got 'bent'"),
        ({**ENDS, "path": np.array([1.0, 2.0])}, r"path: expected one of .*, got \[1.0, 2.0\]"),
        ({"x_t0": X[0], "x_t1": X[1], "path": np.array("linear")}, "has 'path' beside 'x_t0'"),
        ({"position": X, "orientation": Q, "rounding": np.array(0.1)}, "rounding: expected one of"),
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
        **{"self_collision": [False, True], "solid": [False, "auto"]},
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
    assert [mesh.solid for mesh in made.meshes.meshes] == [False, True]
    assert made.self_collision is not None and made.self_collision.tolist() == [False, True]
    # The format states no unit: lengths are taken to be in metres.
    assert made.meshes.meshes[0].unit == 1.0
    for origin in ([[0.0, 0.0, 0.0]], "centroid"):
        with pytest.raises(ValueError, match="scene.json: origin: expected a list of 2 values, one per mesh, got"):
            load(origin=origin)
    # The number of bodies is the length of mesh_index: the error names it, whatever the motion is.
    moved = {"position_t0": X[0], "orientation_t0": Q[0], "position_t1": X[1], "orientation_t1": Q[1]}
    for columns in ({"position": X, "orientation": Q}, moved):
        np.savez(tmp_path / "poses.npz", **columns)
        wrong = {key: scene[key] for key in ("meshes", "poses")} | {"mesh_index": [1, 0, 0]}
        (tmp_path / "scene.json").write_text(json.dumps(wrong))
        message = "mesh_index: expected the meshes of 2 bodies, of which poses.npz has poses, got 3 values"
        with pytest.raises(ValueError, match=f"scene.json: {message}"):
            files.load_scene(tmp_path / "scene.json")
    for changed, message in (
        ({"solid": [True]}, "solid: expected a list of 2 values, one per mesh, got"),
        ({"solid": [True, 3]}, "solid: expected True, False or .auto., got 3"),
        ({"names": ["a"]}, "names: expected 2 strings, one per body, got 1"),
        ({"names": "ab"}, "names: expected a list of strings, one per body, got 'ab'"),
        ({"names": ["a", "\ud800"]}, "names: body 1: expected text, got .*surrogates not allowed"),
        ({"meshes": "box.ply"}, "meshes: expected a list of file names, or the name of an npz file, got 'box.ply'"),
        ({"meshes": "boxes.npz"}, "origin: not expected, since the meshes in boxes.npz have their own"),
    ):
        with pytest.raises(ValueError, match=f"scene.json: {message}"):
            load(**changed)
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


def same_state(one: Any, other: Any) -> bool:
    """Whether states are equal, bit by bit."""
    if isinstance(one, torch.Tensor):
        return one.dtype == other.dtype and one.numpy().tobytes() == other.numpy().tobytes()
    if isinstance(one, list):
        return len(one) == len(other) and all(map(same_state, one, other))
    if isinstance(one, dict):
        return one.keys() == other.keys() and all(same_state(one[name], other[name]) for name in one)
    return type(one) is type(other) and one == other


def check_again(path: Path, scene: pgccd.Scene, motion: Any, names: list[str] | None = None) -> None:
    """Writes a scene and its motion; what is read must be the same."""
    assert files.save_scene(path, scene, motion, names) == path
    again, moved = files.load_scene(path)
    assert same_state(scene.state_dict(), again.state_dict()) and files.load_names(path) == names
    assert type(moved) is type(motion) and same_state(motion.state_dict(), moved.state_dict())
    assert pgccd.detect(again, moved) == pgccd.detect(scene, motion)
    assert sorted(file.name for file in path.parent.iterdir()) == ["s.json", "s.meshes.npz", "s.poses.npz"]


@pytest.mark.parametrize("seed", range(40))
@pytest.mark.filterwarnings("ignore::UserWarning")
def test_random_scenes_are_read_as_they_are_written(seed: int, tmp_path: Path) -> None:
    made = random_scene(seed)
    scene, motion = made.scene(), made.motion()
    check_again(tmp_path / "s.json", scene, motion, [f"body {k}" for k in range(scene.body_count)])
    if isinstance(motion, pgccd.Trajectory):
        found = pgccd.audit(*files.load_scene(tmp_path / "s.json"))
        expected = pgccd.audit(scene, motion)
        assert found.passages == expected.passages and found.enclosed == expected.enclosed
        assert torch.equal(found.touching.pairs, expected.touching.pairs)


def test_what_random_scenes_lack_is_written_too(tmp_path: Path) -> None:
    """Meshes of files, margins and bit sets at their limits, motions with all columns; gradients are left out."""
    pytest.importorskip("trimesh")
    (tmp_path / "in").mkdir()
    path = tmp_path / "in" / "part.obj"
    path.write_text("o lid\nv 0 0 0\nv 1 0 0.1\nv 0 1 0\nv 0 0 0\nv 0 0 1\nf 1 2 3\nf 4 2 5\nf 1 4 2\n")
    lid = pgccd.Mesh.load(path, [1e5, 0.1, 0.0], unit="mm")
    assert lid.welded_vertices == lid.dropped_faces == 1 and lid.unit == 1e-3
    odd = pgccd.Mesh.box([0.3, 0.2, 0.1], "centroid", solid=True)
    odd.name = "lid \0\N{SNOWMAN}"
    limits = {"group": [-(2**63), 2**63 - 1], "mask": [-1, 0], "margin": [1e149, 5e-324], "world": [2**29, 0]}
    scene = pgccd.Scene([odd, lid, odd], [2, 1], exclude=[[1, 0]], static=[True, False], self_collision=True, **limits)
    x, q, w = (torch.tensor(values) for values in (X, Q, W))
    spin = pgccd.Trajectory.from_velocity(x[0], q[0], w, 9.0 * w, 0.7, "linear", margin=torch.tensor(MARGIN))
    rounded = pgccd.Trajectory(x.float(), q[0].float(), rotation=9.0 * w.float())
    (tmp_path / "out").mkdir()
    for motion in (spin, rounded, pgccd.Trajectory(x, q, "linear"), pgccd.RigidMotion(x[0], q[0], x[1], q[1])):
        check_again(tmp_path / "out" / "s.json", scene, motion)
    thick = torch.tensor([0.1, 0.2], dtype=torch.float64, requires_grad=True)
    moved = pgccd.RigidMotion(x[0].clone().requires_grad_(), q[0], x[1], q[1])
    files.save_scene(tmp_path / "out" / "s.json", pgccd.Scene([odd, lid], margin=thick), moved)
    again, still = files.load_scene(tmp_path / "out" / "s.json")
    assert again.margin is not None and torch.equal(again.margin, thick) and not again.margin.requires_grad
    assert isinstance(still, pgccd.RigidMotion) and torch.equal(still.position_t0, moved.position_t0)
    empty = pgccd.Scene([odd], [], group=[], exclude=torch.zeros((0, 2), dtype=torch.int64))
    check_again(tmp_path / "out" / "s.json", empty, pgccd.RigidMotion.at_rest(x[0, :0], q[0, :0]), [])


def frames_of(path: str, count: int) -> tuple[pgccd.Scene, list[Any]]:
    """A scene and frames of two bodies: rigid, as float32 and as arrays, or deforming."""
    rng = np.random.default_rng(count)
    mesh = pgccd.Mesh.box([0.5, 0.4, 0.3])
    q = np.tile([1.0, 0.0, 0.0, 0.0], (2, 1))
    x = 0.3 * rng.normal(size=(count, 2, 3)) + np.array([[0.0, 0, 0], [1.0, 0, 0]])
    frames: list[Any] = [(each, q) for each in x]
    if path == "float32":
        frames = [(torch.tensor(each).float(), torch.tensor(q).float()) for each in x]
    if path == "vertices":
        frames = [(each[:, None] + mesh.vertices.numpy()).reshape(-1, 3) for each in x]
    return pgccd.Scene([mesh], [0, 0]), frames


@pytest.mark.parametrize("kind", ["arrays", "float32", "vertices"])
@pytest.mark.parametrize(("count", "rows"), [(2, 1), (11, 1), (11, 7), (101, 1 << 16)])
def test_frames_are_written_one_after_the_other(
    kind: str, count: int, rows: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """In windows of any number of bodies, from memory that is overwritten."""
    monkeypatch.setattr(windows, "_ROWS", rows)
    scene, frames = frames_of(kind, count)
    path = files.save_scene(tmp_path / "run.json", scene, iter(frames))
    again, rollout = files.load_scene(path)
    assert isinstance(rollout, pgccd.Trajectory) and rollout.position.shape[0] == count
    given = [torch.as_tensor(each[0] if isinstance(each, tuple) else each).double() for each in frames]
    assert torch.equal(rollout.position, torch.stack(given)) and (rollout.orientation is None) == (kind == "vertices")
    streamed = pgccd.audit(again, files.iterate_frames(tmp_path / "run.poses.npz"))
    expected = pgccd.audit(scene, frames)
    assert streamed.frames == count and streamed.passages == expected.passages == pgccd.audit(again, rollout).passages
    assert torch.equal(streamed.touching.last, expected.touching.last)
    assert count < 101 or len(expected.passages) > 0


def test_trajectories_without_turns_are_frames_too(tmp_path: Path) -> None:
    """Also those of float32, whose rounding is stored."""
    x, q = (torch.tensor(column) for column in (X, Q))
    for position, orientation in ((x, q), (x.float(), q.float()), (x.float(), None)):
        scene = pgccd.Scene([pgccd.Mesh.box([1.0, 1.0, 1.0])], [0, 0])
        if orientation is None:
            scene, position = pgccd.Scene([pgccd.Mesh(X[:, 0], [[0, 1, 2]])]), position[:, :1].expand(3, 3, 3)
        files.save_scene(tmp_path / "run.json", scene, pgccd.Trajectory(position, orientation))
        frames = list(files.iterate_frames(tmp_path / "run.poses.npz"))
        given = [frame[0] if isinstance(frame, tuple) else frame for frame in frames]
        assert torch.equal(torch.stack(given), position.double())


def test_memory_is_that_of_a_window(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(windows, "_ROWS", 10)
    scene, (frame, *_) = frames_of("arrays", 2)
    bytes_written = []

    def run() -> Iterator[Any]:
        for _ in range(2000):
            bytes_written.append(sum(file.stat().st_size for file in tmp_path.rglob("position.npy")))
            yield frame

    files.save_scene(tmp_path / "run.json", scene, run())
    waiting = 48 * np.arange(2000) - np.array(bytes_written)
    assert waiting.max() < 48 * 10 + io.DEFAULT_BUFFER_SIZE * 2
    with zipfile.ZipFile(tmp_path / "run.poses.npz") as archive:
        assert all(entry.compress_type == zipfile.ZIP_STORED for entry in archive.infolist())


class Stop(BaseException):
    """A program that is interrupted."""


@pytest.mark.parametrize("error", [Stop(), ValueError("trajectories of the simulator"), OSError(28, "No space left")])
@pytest.mark.parametrize("is_new", [False, True])
def test_writing_that_fails_leaves_what_was_there(error: BaseException, is_new: bool, tmp_path: Path) -> None:
    scene, frames = frames_of("arrays", 5)
    path = tmp_path / "run.json"
    if not is_new:
        files.save_scene(path, scene, frames, ["a", "b"])
    before = {file.name: file.read_bytes() for file in tmp_path.iterdir()}

    def run() -> Iterator[Any]:
        yield from frames
        raise error

    with pytest.raises(type(error)) as raised:
        files.save_scene(path, scene, run())
    assert raised.value is error
    assert {file.name: file.read_bytes() for file in tmp_path.iterdir()} == before


@pytest.mark.parametrize("moved", [0, 1, 2])
def test_files_of_two_scenes_are_not_read_as_one(moved: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The program ends after the first files have their names."""
    scene, frames = frames_of("arrays", 5)
    path, replace, left = files.save_scene(tmp_path / "run.json", scene, frames), os.replace, [None] * moved

    def replace_few(old: Path, new: Path) -> None:
        if not left:
            raise Stop
        left.pop()
        replace(old, new)

    monkeypatch.setattr(os, "replace", replace_few)
    with pytest.raises(Stop):
        files.save_scene(path, scene, frames[1:])
    with pytest.raises(ValueError, match=r"run.json cannot be read as JSON: .*No such file"):
        files.load_scene(path)


def test_scenes_that_cannot_be_written(tmp_path: Path) -> None:
    scene, frames = frames_of("arrays", 3)
    (x, q), path = frames[0], tmp_path / "run.json"
    nan = x * [[1.0], [np.nan]]
    still = pgccd.RigidMotion.at_rest(torch.tensor(x), torch.tensor(q))
    deep = torch.tensor([[0.1], [0.2]], dtype=torch.float64)
    vertices = torch.zeros((3, 16, 3), dtype=torch.float64)
    wrong_world, named = pgccd.Scene([pgccd.Mesh.box([1.0, 1.0, 1.0])], world=[0]), pgccd.Mesh.box([1.0, 1.0, 1.0])
    assert wrong_world.world is not None
    wrong_world.world[0], named.name = -1, "ends in NUL\0"
    cases: list[tuple[type[Exception], str, Callable[[], Any]]] = [
        (TypeError, "path: expected a path, got 3", lambda: files.save_scene(3, scene, frames)),  # type: ignore
        (ValueError, "path: expected a name that ends in .json", lambda: files.save_scene("run.npz", scene, frames)),
        (IsADirectoryError, "path: .* is a folder", lambda: files.save_scene(tmp_path / "d.json", scene, frames)),
        (FileNotFoundError, "path: .*run.json cannot be", lambda: files.save_scene(path / "run.json", scene, frames)),
        (TypeError, "scene: expected a pgccd.Scene, got list", lambda: files.save_scene(path, frames, scene)),  # type: ignore
        (TypeError, "motion: expected .*frames: pairs", lambda: files.save_scene(path, scene, 3)),  # type: ignore
        (ValueError, "motion: expected at least two frames", lambda: files.save_scene(path, scene, frames[:1])),
        (
            ValueError,
            r"motion: frame 1: position: expected",
            lambda: files.save_scene(path, scene, [(x, q), (x[0], q)]),
        ),
        (
            ValueError,
            "motion: counted from frame 0: position: waypoint 1, body 1",
            lambda: files.save_scene(path, scene, [(x, q), (nan, q)]),
        ),
        (ValueError, "motion: has 1 bodies, the scene 2", lambda: files.save_scene(path, scene, still[:1])),
        (
            ValueError,
            r"margin: expected shape \(2, 2\), as the scene has 2 bodies",
            lambda: files.save_scene(path, scene, pgccd.Trajectory(vertices, margin=deep)),
        ),
        (TypeError, "names: expected a list of strings", lambda: files.save_scene(path, scene, frames, "ab")),
        (TypeError, "names: expected a list of strings", lambda: files.save_scene(path, scene, frames, [1, 2])),  # type: ignore
        (ValueError, "names: expected 2 strings, .* got 1", lambda: files.save_scene(path, scene, frames, ["a"])),
        (ValueError, "world: body 0: expected", lambda: files.save_scene(path, wrong_world, still[:1])),
        (
            ValueError,
            "scene: name of a mesh: expected text that does not end in NUL",
            lambda: files.save_scene(path, pgccd.Scene([named]), still[:1]),
        ),
    ]
    (tmp_path / "d.json").mkdir()
    for kind, message, call in cases:
        with pytest.raises(kind, match=f"^{message}"):
            call()
    assert [file.name for file in tmp_path.iterdir()] == ["d.json"]


def test_files_of_meshes_that_are_not_one(tmp_path: Path) -> None:
    scene, frames = frames_of("arrays", 2)
    path = files.save_scene(tmp_path / "run.json", scene, frames)
    with np.load(tmp_path / "run.meshes.npz") as archive:
        arrays = {name: archive[name] for name in archive.files}
    whole = (tmp_path / "run.meshes.npz").read_bytes()
    for changed, message in (
        ({"0.faces": None}, "mesh 0: state: has no entry 'faces'"),
        ({"0.colour": np.zeros(3)}, "mesh 0: state: expected entries .*, got 'colour'"),
        ({"0.faces": arrays["0.faces"] + 1}, "mesh 0: faces: face .*, but there are 8 vertices"),
        ({"0.solid": np.array(3)}, "mesh 0: solid: expected True or False, got 3"),
        ({"2.name": np.array("x")}, "has no '1.vertices'"),
        ({"0.name": np.array([{}], dtype=object)}, "cannot be read as an npz file"),
    ):
        given = {name: array for name, array in (arrays | changed).items() if array is not None}
        np.savez(tmp_path / "run.meshes.npz", **given)
        with pytest.raises(ValueError, match=rf"run.json: .*run.meshes.npz:? {message}"):
            files.load_scene(path)
    for damaged in (whole[:-50], whole[:600] + bytes([whole[600] ^ 1]) + whole[601:]):
        (tmp_path / "run.meshes.npz").write_bytes(damaged)
        with pytest.raises(ValueError, match=r"run.meshes.npz cannot be read as an npz file"):
            files.load_scene(path)
