"""Scenes and motions from files and to files, as read by the command line."""

import difflib
import itertools
import json
import os
import tempfile
import zipfile
import zlib
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, suppress
from os import PathLike
from pathlib import Path
from typing import IO, Any

import numpy as np
import torch

from pgccd import arguments
from pgccd.geometry.mesh import Mesh
from pgccd.geometry.scene import OPTIONAL_COLUMNS, Scene
from pgccd.motion.of_scene import check_scene, check_step, check_trajectory
from pgccd.motion.paths import PATHS, PathKind, RigidMotion, VertexMotion
from pgccd.motion.trajectory import Trajectory
from pgccd.motion.windows import Frame, windows

__all__ = ["iterate_frames", "load_configurations", "load_motion", "load_names", "load_scene", "save_scene"]

_START = ("position_t0", "orientation_t0")
_END = ("position_t1", "orientation_t1")
_VELOCITY = ("linear_velocity", "angular_velocity", "dt")
_VERTICES = ("x_t0", "x_t1")
_WAYPOINTS = ("position", "orientation", "rotation", "margin", "path", "rounding")
# Optional entries of a motion in a file.
_DEFAULTS = {"path": "rigid", "rounding": np.finfo(np.float64).eps}
# The keys of each kind of motion: required ones, then others.
_KINDS = ((_VERTICES, ()), (_WAYPOINTS[:1], _WAYPOINTS[1:]), (_START, (*_END, *_VELOCITY, "rotation", "path")))
_SCENE = ("meshes", "mesh_index", "poses")
_OPTIONAL = (*OPTIONAL_COLUMNS, "self_collision", "exclude")
# Options of mesh files, one value per mesh.
_OF_MESHES: dict[str, Any] = {"origin": (0.0, 0.0, 0.0), "solid": False, "thickness": 0.0}
# Entries of a mesh's state that may be None, and are then not in a file.
_MAYBE = ("name", "unit", "source_vertex", "source_face")


def load_motion(
    path: str | PathLike[str], device: torch.device | str = "cpu"
) -> RigidMotion | VertexMotion | Trajectory:
    """A motion of N bodies from an npz file, world frame, scene length units.

    The file holds one of these:

    * position_t0 (N, 3) and orientation_t0 (N, 4), and either position_t1 and orientation_t1, or position_t1 and
      rotation (N, 3), or linear_velocity (N, 3), angular_velocity (N, 3) in radians, and dt: a `RigidMotion`. Positions
      are those of the meshes' origins, orientations unit quaternions (w, x, y, z), body to world.
    * position (T, N, 3) and orientation (T, N, 4): a `Trajectory` of rigid bodies; optionally rotation (T - 1, N, 3).
    * x_t0 and x_t1 (X, 3), vertices of all bodies: a `VertexMotion`; or position (T, X, 3) alone: a `Trajectory` of
      deforming bodies.

    A trajectory may have margin (T - 1, N), and rounding from its `state_dict`. Motions of rigid bodies and
    trajectories may have path, "rigid" or "linear".

    Args:
        path: of the file.
        device: of the motion.

    Raises:
        ValueError: the file cannot be read, a key is missing, unknown or belongs to another motion, or its values are
            not as the motion expects them.

    Example:
        >>> np.savez("poses.npz", position_t0=x0, orientation_t0=q0, position_t1=x1, orientation_t1=q1)
        >>> motion = pgccd.files.load_motion("poses.npz")
    """
    path, device = arguments.path(path, "path"), arguments.device(device)
    arrays = _arrays(path)
    _require_known(path, arrays, (*_START, *_END, *_VELOCITY, *_VERTICES, *_WAYPOINTS))
    required, others = next((kind for kind in _KINDS if any(name in arrays for name in kind[0])), _KINDS[-1])
    for name in arrays:
        if name not in (*required, *others):
            raise ValueError(f"{path} has {name!r} beside {required[0]!r}: expected only one of them")
    for name in required:
        if name not in arrays:
            raise ValueError(f"{path} has no {name!r}")
    kind = _path_kind(path, arrays.pop("path", None))
    columns = {name: _as_column(path, name, values).to(device) for name, values in arrays.items()}
    try:
        if required == _VERTICES:
            return VertexMotion(columns["x_t0"], columns["x_t1"])
        if "rounding" in columns:
            return Trajectory.from_state_dict({**dict.fromkeys(_WAYPOINTS), **columns, "path": kind})
        if required == _WAYPOINTS[:1]:
            rotation, margin = columns.get("rotation"), columns.get("margin")
            return Trajectory(columns["position"], columns.get("orientation"), kind, rotation=rotation, margin=margin)
    except (TypeError, ValueError, RuntimeError) as error:
        raise ValueError(f"{path}: {error}") from error
    by_velocity = any(name in columns for name in _VELOCITY)
    if by_velocity and (both := [name for name in (*_END, "rotation") if name in columns]):
        raise ValueError(f"{path} has {both[0]!r} beside velocities: expected only one of them")
    if "rotation" in columns and "orientation_t1" in columns:
        raise ValueError(f"{path} has 'orientation_t1' beside 'rotation': expected only one of them")
    for name in _VELOCITY if by_velocity else (_END[0], "rotation" if "rotation" in columns else _END[1]):
        if name not in columns:
            raise ValueError(f"{path} has no {name!r}")
    position, orientation = (columns[name] for name in _START)
    try:
        if by_velocity:
            velocity, spin, dt = (columns[name] for name in _VELOCITY)
            if dt.numel() != 1:
                raise ValueError(f"dt: expected one number, got shape {tuple(dt.shape)}")
            return RigidMotion.from_velocity(position, orientation, velocity, spin, dt.item(), kind)
        if "rotation" in columns:
            return RigidMotion.from_rotation(position, orientation, columns["position_t1"], columns["rotation"], kind)
        return RigidMotion(position, orientation, columns["position_t1"], columns["orientation_t1"], kind)
    except (TypeError, ValueError, RuntimeError) as error:
        raise ValueError(f"{path}: {error}") from error


def load_configurations(path: str | PathLike[str]) -> torch.Tensor:
    """Configurations of a robot, (T, J) float64, from an npz file that holds them as q.

    Args:
        path: of the file.

    Raises:
        ValueError: the file cannot be read, or holds something else.

    Example:
        >>> np.savez("path.npz", q=np.zeros((2, 6)))
        >>> pgccd.files.load_configurations("path.npz").shape
        torch.Size([2, 6])
    """
    path = arguments.path(path, "path")
    arrays = _arrays(path)
    if set(arrays) != {"q"}:
        raise ValueError(f"{path}: expected q (T, J), got {', '.join(sorted(arrays)) or 'nothing'}")
    q = _as_column(path, "q", arrays["q"])
    if q.dim() != 2:
        raise ValueError(f"{path}: q: expected shape (T, J), got {tuple(q.shape)}")
    return q


def load_scene(
    path: str | PathLike[str], device: torch.device | str = "cpu"
) -> tuple[Scene, RigidMotion | VertexMotion | Trajectory]:
    """A scene and its motion from a JSON file.

    The file holds {"meshes": [files], "mesh_index": [numbers], "poses": npz file as for `load_motion`}, with paths
    relative to it. Optional entries are "group", "mask", "world", "static", "self_collision", "margin" and "names",
    lists with one value per body; "exclude", a list of pairs of bodies that are never tested; and, as for `Mesh`, lists
    with one value per mesh: "origin", a point [x, y, z] or a name; "solid", true, false or "auto"; and "thickness", a
    length. In place of a list, "meshes" may be the npz file that `save_scene` writes, which holds "origin", "solid" and
    "thickness" too. Lengths of mesh files that state their unit are converted to metres.

    Args:
        path: of the file.
        device: of the scene and its motion.

    Raises:
        ValueError: a file cannot be read, a key is missing or unknown, or a value is not as `Scene` expects it.

    Example:
        >>> hits = pgccd.detect(*pgccd.files.load_scene("scene.json"))
    """
    scene, poses, _ = bodies_and_poses(path, device)
    return scene, load_motion(poses, scene.device)


def load_names(path: str | PathLike[str]) -> list[str] | None:
    """The names of the N bodies in a JSON file as for `load_scene`, (N,) strings; None if it has no names.

    Args:
        path: of the file.

    Raises:
        ValueError: the file cannot be read, a key is missing or unknown, or there are not as many names as bodies.

    Example:
        >>> pgccd.files.load_names(pgccd.files.save_scene("two.json", scene, motion, ["cup", "table"]))
        ['cup', 'table']
    """
    path = arguments.path(path, "path")
    return _names_of(path, _content(path))


def save_scene(
    path: str | PathLike[str],
    scene: Scene,
    motion: RigidMotion | VertexMotion | Trajectory | Iterable[Frame],
    names: Sequence[str] | None = None,
) -> Path:
    """Writes a scene and its motion to files that `load_scene`, `pgccd audit`, `pgccd detect` and `pgccd view` read.

    For the path scene.json it writes three files: scene.json with the columns of the scene, which may be edited;
    scene.meshes.npz with the meshes; and scene.poses.npz with the motion, as for `load_motion`. Files of these names
    are replaced. The scene and motion that are read again, their contacts and audits are the same, bit by bit;
    gradients are not stored. If the call fails or is interrupted, there is no scene.json, or the former one.

    Args:
        path: of the JSON file.
        scene: the bodies.
        motion: their motion; or any iterable of frames, as for `pgccd.audit`: pairs of positions (N, 3) and
            orientations (N, 4), or vertices (X, 3) of deforming bodies, world frame, scene length units. Frames are
            written one after the other, so that a rollout may be larger than memory.
        names: (N,) of the bodies, for people: the command line prints them. Default: none.

    Returns:
        The path.

    Raises:
        TypeError, ValueError: naming the argument, and the frame; the path does not end in .json.
        OSError: a file cannot be written.

    Example:
        >>> pgccd.files.save_scene("saved.json", scene, [(x0, q0), (x1, q1)], names=["cup", "table"])
        PosixPath('saved.json')
        >>> found = pgccd.audit(*pgccd.files.load_scene("saved.json"))
    """
    path = arguments.path(path, "path")
    if path.suffix != ".json":
        raise ValueError(f"path: expected a name that ends in .json, got {path}")
    arguments.instance(scene, "scene", Scene)
    if path.is_dir():
        raise IsADirectoryError(f"path: {path} is a folder: expected the name of a file")
    scene = scene._detached()
    check_scene(scene)
    _ = scene.world_count  # which checks them
    state = scene.state_dict()
    content: dict[str, Any] = {"meshes": f"{path.stem}.meshes.npz", "mesh_index": state["mesh_index"].tolist()}
    content["poses"] = f"{path.stem}.poses.npz"
    if scene.static is not None:
        state["static"] = scene.static.bool()
    content |= {name: state[name].tolist() for name in _OPTIONAL if state[name] is not None}
    if names is not None:
        content["names"] = arguments.body_names(names, scene.body_count)
    try:
        folder = tempfile.TemporaryDirectory(prefix=f".{path.name}.", dir=path.parent)
    except OSError as error:
        raise type(error)(f"path: {path} cannot be written: {error.strerror or error}") from error
    with folder as made:
        finished = [Path(made, name) for name in (content["meshes"], content["poses"], path.name)]
        _save_meshes(finished[0], state["meshes"])
        _save_motion(finished[1], scene, motion)
        entries = (f"{json.dumps(key)}: {json.dumps(value)}" for key, value in content.items())
        finished[2].write_text("{" + ",\n ".join(entries) + "}\n")
        path.unlink(missing_ok=True)  # first: what it names is complete as long as it exists
        for file in finished:
            os.replace(file, path.with_name(file.name))
    return path


def _save_meshes(path: Path, states: Sequence[Mapping[str, Any]]) -> None:
    arrays = {f"{k}.{name}": array for k, state in enumerate(states) for name, array in _stored(state).items()}
    np.savez(path, **arrays)  # type: ignore[arg-type]


def _save_motion(path: Path, scene: Scene, motion: RigidMotion | VertexMotion | Trajectory | Iterable[Frame]) -> None:
    if isinstance(motion, (RigidMotion, VertexMotion)):
        motion = motion._detached()
        check_step(scene, motion)
    elif isinstance(motion, Trajectory):
        check_trajectory(scene, motion)
        motion._margins(None, scene.body_count)
    else:
        _save_frames(path, scene, motion)
        return
    arrays = _stored(motion.state_dict())
    said = {name: values for name, values in arrays.items() if values.ndim or values != _DEFAULTS[name]}
    np.savez(path, **said)  # type: ignore[arg-type]


def _stored(state: Mapping[str, Any]) -> dict[str, np.ndarray]:
    """The entries of a state that are not None."""
    arrays = {}
    for name, value in state.items():
        if value is not None:
            arrays[name] = value.cpu().numpy() if isinstance(value, torch.Tensor) else np.asarray(value)
            if isinstance(value, str) and arrays[name].item() != value:
                raise ValueError(f"scene: {name} of a mesh: expected text that does not end in NUL, got {value!r}")
    return arrays


def _save_frames(path: Path, scene: Scene, frames: Iterable[Frame]) -> None:
    """Writes an npz file of frames, by way of arrays in files beside it, since the number of frames is not known before
    the last one.
    """
    count, shapes = 0, dict[str, tuple[int, ...]]()
    with ExitStack() as opened:
        files: dict[str, IO[bytes]] = {}
        for part in _windows(scene, frames):
            known = min(count, 1)  # a window begins with the last frame of the one before
            for name, column in (("position", part.position), ("orientation", part.orientation)):
                if column is None:
                    continue
                if name not in files:
                    files[name] = opened.enter_context(path.with_name(f"{name}.npy").open("wb"))
                    shapes[name] = tuple(column.shape[1:])
                    _write_header(files[name], 0, shapes[name])
                files[name].write(column[known:].cpu().numpy().tobytes())
            count += len(part.position) - known
        for name, file in files.items():
            file.seek(0)
            _write_header(file, count, shapes[name])
    with zipfile.ZipFile(path, "w") as archive:
        for name in shapes:
            archive.write(path.with_name(f"{name}.npy"), f"{name}.npy")


def _write_header(file: IO[bytes], count: int, shape: tuple[int, ...]) -> None:
    """Writes the header of an array of so many rows; its size does not depend on their number."""
    header = {"descr": "<f8", "fortran_order": False, "shape": (count, *shape)}
    np.lib.format.write_array_header_1_0(file, header)


def _windows(scene: Scene, frames: Iterable[Frame]) -> Iterator[Trajectory]:
    """As `windows`; errors name the argument `motion`."""
    try:
        yield from windows(scene, frames, "rigid")
    except (TypeError, ValueError) as error:
        if not str(error).startswith("trajectory: "):  # of the program that makes the frames
            raise
        raise type(error)(f"motion: {str(error).removeprefix('trajectory: ')}") from error


def iterate_frames(
    path: str | PathLike[str], device: torch.device | str = "cpu"
) -> Iterator[tuple[torch.Tensor, torch.Tensor] | torch.Tensor]:
    """The frames of a rollout from an npz file, one after the other, so that the file may be larger than memory.

    Args:
        path: of a file with position (T, N, 3) and orientation (T, N, 4), or position (T, X, 3) alone, as for
            `load_motion`; without rotation and margin.
        device: of the frames.

    Returns:
        An iterator over positions (N, 3) and orientations (N, 4), or over vertices (X, 3), float64.

    Raises:
        ValueError: the file cannot be read, or is another motion; while iterating also if it ends early.

    Example:
        >>> np.savez("rollout.npz", position=np.stack([x0, x1]), orientation=np.stack([q0, q1]))
        >>> pgccd.audit(scene, pgccd.files.iterate_frames("rollout.npz"))
        Audit(frames=2, passages=0, touching=1, enclosed=0)
    """
    path, device = arguments.path(path, "path"), arguments.device(device)
    names = frame_columns(path)
    if names is None:
        raise ValueError(f"{path}: expected position (T, N, 3) and orientation (T, N, 4), or position (T, X, 3) alone")
    return _frames(path, names, device)


def frame_columns(path: Path) -> tuple[str, ...] | None:
    """The columns of a file that `iterate_frames` can read; None if it holds another motion.

    Raises:
        ValueError: it is no npz file.
    """
    try:
        with zipfile.ZipFile(path) as archive:
            names = {name.removesuffix(".npy") for name in archive.namelist()} - {"rounding"}  # that of rotations
    except (OSError, zipfile.BadZipFile) as error:
        raise ValueError(f"{path} cannot be read as an npz file: {error}") from error
    return next((kind for kind in (("position", "orientation"), ("position",)) if names == set(kind)), None)


def _frames(
    path: Path, names: tuple[str, ...], device: torch.device
) -> Iterator[tuple[torch.Tensor, torch.Tensor] | torch.Tensor]:
    with zipfile.ZipFile(path) as archive, ExitStack() as files:
        columns = [_rows_of(path, name, files.enter_context(archive.open(f"{name}.npy"))) for name in names]
        for rows in itertools.zip_longest(*columns):
            if any(row is None for row in rows):
                raise ValueError(f"{path}: position and orientation: expected the same number of frames in both")
            frame = tuple(_as_column(path, name, row).to(device) for name, row in zip(names, rows, strict=True))
            yield frame if len(frame) == 2 else frame[0]


def _rows_of(path: Path, name: str, file: IO[bytes]) -> Iterator[np.ndarray]:
    """The rows of an array in a .npy file, one after the other."""
    try:
        shape, is_transposed, dtype = _header_of(file)
    except (OSError, ValueError, zipfile.BadZipFile) as error:
        raise ValueError(f"{path}: {name}: cannot be read as an array: {error}") from error
    if len(shape) != 3 or is_transposed or dtype.hasobject:
        order = " in Fortran order" if is_transposed else ""
        raise ValueError(f"{path}: {name}: expected an array (T, N, width) in C order, got {dtype} {shape}{order}")
    size = dtype.itemsize * shape[1] * shape[2]
    for number in range(shape[0]):
        try:
            content = file.read(size)
        except (OSError, EOFError, zipfile.BadZipFile, zlib.error) as error:
            raise ValueError(f"{path}: {name}: frame {number} cannot be read: {error}") from error
        if len(content) < size:
            raise ValueError(f"{path}: {name}: expected {shape[0]} frames, but the file ends in frame {number}")
        yield np.frombuffer(content, dtype).reshape(shape[1:])


def _header_of(file: IO[bytes]) -> tuple[tuple[int, ...], bool, np.dtype[Any]]:
    """Shape, Fortran order and type of the array in a .npy file."""
    version = np.lib.format.read_magic(file)
    reading = np.lib.format.read_array_header_1_0 if version[0] == 1 else np.lib.format.read_array_header_2_0
    return reading(file)


def bodies_and_poses(
    path: str | PathLike[str], device: torch.device | str = "cpu"
) -> tuple[Scene, Path, list[str] | None]:
    """The scene of a JSON file as for `load_scene`, the npz file that it names, and the names of its bodies, if any."""
    path, device = arguments.path(path, "path"), arguments.device(device)
    content = _content(path)
    if not isinstance(content["poses"], str):
        raise ValueError(f"{path}: poses: expected the name of an npz file, got {content['poses']!r}")
    names = _names_of(path, content)
    optional = {key: content[key] for key in _OPTIONAL if key in content}
    try:
        scene = Scene(_meshes_of(path, content), content["mesh_index"], device, **optional)
    except (OSError, TypeError, ValueError) as error:
        raise ValueError(f"{path}: {error}") from error
    poses = path.parent / content["poses"]
    posed = _posed_bodies(poses)
    if posed is not None and posed != scene.body_count:
        what = f"{posed} bodies, of which {content['poses']} has poses"
        raise ValueError(f"{path}: mesh_index: expected the meshes of {what}, got {scene.body_count} values")
    return scene, poses, names


def _posed_bodies(path: Path) -> int | None:
    """The number of bodies whose orientations an npz file has. None: it has none, or `load_motion` refuses it."""
    with suppress(OSError, KeyError, ValueError, IndexError, zipfile.BadZipFile), zipfile.ZipFile(path) as archive:
        names = (f"{name}.npy" for name in ("orientation", "orientation_t0"))
        name = next((name for name in names if name in archive.namelist()), None)
        if name is not None:
            with archive.open(name) as file:
                return _header_of(file)[0][-2]
    return None


def _content(path: Path) -> dict[str, Any]:
    """The content of a JSON file as for `load_scene`, its keys checked."""
    try:
        content: Any = json.loads(path.read_text())
    except (OSError, ValueError) as error:
        raise ValueError(f"{path} cannot be read as JSON: {error}") from error
    if not isinstance(content, dict):
        raise ValueError(f"{path}: expected an object with {', '.join(_SCENE)}, got {type(content).__name__}")
    _require_known(path, content, (*_SCENE, *_OPTIONAL, *_OF_MESHES, "names"))
    for key in _SCENE:
        if key not in content:
            raise ValueError(f"{path} has no {key!r}")
    return content


def _names_of(path: Path, content: Mapping[str, Any]) -> list[str] | None:
    if "names" not in content:
        return None
    bodies = content["mesh_index"]
    try:
        return arguments.body_names(content["names"], len(bodies) if isinstance(bodies, list) else 0)
    except (TypeError, ValueError) as error:
        raise ValueError(f"{path}: {error}") from error


def _meshes_of(path: Path, content: Mapping[str, Any]) -> list[Mesh]:
    """The meshes that a JSON file names."""
    files = content["meshes"]
    if isinstance(files, str) and files.endswith(".npz"):
        for key in _OF_MESHES:
            if key in content:
                raise ValueError(f"{key}: not expected, since the meshes in {files} have their own")
        return _load_meshes(path.parent / files)
    if not isinstance(files, list) or not all(isinstance(name, str) for name in files):
        raise ValueError(f"meshes: expected a list of file names, or the name of an npz file, got {files!r}")
    columns = []
    for key, default in _OF_MESHES.items():
        values = content.get(key, [default] * len(files))
        if not isinstance(values, list) or len(values) != len(files):
            raise ValueError(f"{key}: expected a list of {len(files)} values, one per mesh, got {values!r}")
        columns.append(values)
    of_files = zip(files, *columns, strict=True)
    return [
        Mesh.load(path.parent / name, origin, unit="m", solid=solid).thickened(thickness)
        for name, origin, solid, thickness in of_files
    ]


def _load_meshes(path: Path) -> list[Mesh]:
    """The meshes of an npz file of `save_scene`."""
    states: dict[str, dict[str, Any]] = {}
    for key, values in _arrays(path).items():
        number, _, name = key.partition(".")
        states.setdefault(number, {})[name] = values
    meshes = []
    for number in map(str, range(len(states))):
        if number not in states:
            raise ValueError(f"{path} has no '{number}.vertices'")
        try:
            state = {name: torch.from_numpy(v) if v.ndim else v.item() for name, v in states[number].items()}
            meshes.append(Mesh.from_state_dict({**dict.fromkeys(_MAYBE), **state}))
        except (TypeError, ValueError) as error:
            raise ValueError(f"{path}: mesh {number}: {error}") from error
    return meshes


def _arrays(path: str | PathLike[str]) -> dict[str, np.ndarray]:
    """All arrays of an npz file."""
    try:
        with np.load(path) as archive:
            return {name: archive[name] for name in archive.files}
    except Exception as error:
        raise ValueError(f"{path} cannot be read as an npz file: {error}") from error


def _require_known(path: str | PathLike[str], given: Iterable[str], known: Sequence[str]) -> None:
    for key in given:
        if key not in known:
            likely = difflib.get_close_matches(key, known, n=1)
            hint = f", perhaps for {likely[0]!r}" if likely else ""
            raise ValueError(f"{path} has an unknown key {key!r}{hint}; known are {', '.join(known)}")


def _path_kind(path: Path, values: np.ndarray | None) -> PathKind:
    kind: Any = _DEFAULTS["path"] if values is None else values.tolist()
    if kind not in PATHS:
        raise ValueError(f"{path}: path: expected one of {list(PATHS)}, got {kind!r}")
    return kind


def _as_column(path: str | PathLike[str], name: str, values: np.ndarray) -> torch.Tensor:
    if values.dtype.kind not in "fiu":
        raise ValueError(f"{path}: {name}: expected numbers, got {values.dtype}")
    return torch.from_numpy(values.astype(np.float64))


def __dir__() -> list[str]:
    return sorted(__all__)
