"""Scenes and motions from files, as read by the command line."""

import difflib
import itertools
import json
import zipfile
import zlib
from collections.abc import Iterable, Iterator, Sequence
from contextlib import ExitStack
from os import PathLike
from pathlib import Path
from typing import IO, Any

import numpy as np
import torch

from pgccd import arguments
from pgccd.geometry.mesh import Mesh
from pgccd.geometry.scene import OPTIONAL_COLUMNS, Scene
from pgccd.motion.paths import RigidMotion, VertexMotion
from pgccd.motion.trajectory import Trajectory

__all__ = ["iterate_frames", "load_configurations", "load_motion", "load_scene"]

_START = ("position_t0", "orientation_t0")
_END = ("position_t1", "orientation_t1")
_VELOCITY = ("linear_velocity", "angular_velocity", "dt")
_VERTICES = ("x_t0", "x_t1")
_WAYPOINTS = ("position", "orientation", "rotation", "margin")
# The keys of each kind of motion: required ones, then others.
_KINDS = ((_VERTICES, ()), (_WAYPOINTS[:1], _WAYPOINTS[1:]), (_START, (*_END, *_VELOCITY)))
_SCENE = ("meshes", "mesh_index", "poses")
_OPTIONAL = (*OPTIONAL_COLUMNS, "exclude")


def load_motion(
    path: str | PathLike[str], device: torch.device | str = "cpu"
) -> RigidMotion | VertexMotion | Trajectory:
    """A motion of N bodies from an npz file, world frame, scene length units.

    The file holds one of these:

    * position_t0 (N, 3) and orientation_t0 (N, 4), and either position_t1 and orientation_t1, or linear_velocity
      (N, 3), angular_velocity (N, 3) in radians, and dt: a `RigidMotion`. Positions are those of the meshes' origins,
      orientations unit quaternions (w, x, y, z), body to world.
    * position (T, N, 3) and orientation (T, N, 4): a `Trajectory` of rigid bodies; optionally rotation (T - 1, N, 3).
    * x_t0 and x_t1 (X, 3), vertices of all bodies: a `VertexMotion`; or position (T, X, 3) alone: a `Trajectory` of
      deforming bodies. With either, optionally margin (T - 1, N).

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
            raise ValueError(f"{path} has {name!r} beside {required[0]!r}: expected the one or the other")
    for name in required:
        if name not in arrays:
            raise ValueError(f"{path} has no {name!r}")
    columns = {name: _as_column(path, name, values).to(device) for name, values in arrays.items()}
    try:
        if required == _VERTICES:
            return VertexMotion(columns["x_t0"], columns["x_t1"])
        if required == _WAYPOINTS[:1]:
            rotation, margin = columns.get("rotation"), columns.get("margin")
            return Trajectory(columns["position"], columns.get("orientation"), rotation=rotation, margin=margin)
    except (TypeError, ValueError, RuntimeError) as error:
        raise ValueError(f"{path}: {error}") from error
    by_velocity = any(name in columns for name in _VELOCITY)
    if by_velocity and (both := [name for name in _END if name in columns]):
        raise ValueError(f"{path} has {both[0]!r} beside velocities: expected the one or the other")
    for name in _VELOCITY if by_velocity else _END:
        if name not in columns:
            raise ValueError(f"{path} has no {name!r}")
    position, orientation = (columns[name] for name in _START)
    try:
        if by_velocity:
            velocity, spin, dt = (columns[name] for name in _VELOCITY)
            if dt.numel() != 1:
                raise ValueError(f"dt: expected one number, got shape {tuple(dt.shape)}")
            return RigidMotion.from_velocity(position, orientation, velocity, spin, dt.item())
        position_t1, orientation_t1 = (columns[name] for name in _END)
        return RigidMotion(position, orientation, position_t1, orientation_t1)
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

    The file holds {"meshes": [files], "mesh_index": [numbers], "poses": npz file as for `load_motion`}, paths relative
    to it; and optionally "group", "mask", "world", "static" and "margin", lists with one value per body; "exclude", a
    list of pairs of bodies that are never tested; and "origin", a list with one value per mesh: a point [x, y, z] or a
    name, as for `Mesh`.

    Args:
        path: of the file.
        device: of the scene and its motion.

    Raises:
        ValueError: a file cannot be read, a key is missing or unknown, or a value is not as `Scene` expects it.

    Example:
        >>> hits = pgccd.detect(*pgccd.files.load_scene("scene.json"))
    """
    scene, poses = bodies_and_poses(path, device)
    return scene, load_motion(poses, scene.device)


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
            names = {name.removesuffix(".npy") for name in archive.namelist()}
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
                raise ValueError(f"{path}: position and orientation: expected as many frames in both")
            frame = tuple(_as_column(path, name, row).to(device) for name, row in zip(names, rows, strict=True))
            yield frame if len(frame) == 2 else frame[0]


def _rows_of(path: Path, name: str, file: IO[bytes]) -> Iterator[np.ndarray]:
    """The rows of an array in a .npy file, one after the other."""
    try:
        version = np.lib.format.read_magic(file)
        reading = np.lib.format.read_array_header_1_0 if version[0] == 1 else np.lib.format.read_array_header_2_0
        shape, is_transposed, dtype = reading(file)
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


def bodies_and_poses(path: str | PathLike[str], device: torch.device | str = "cpu") -> tuple[Scene, Path]:
    """The scene of a JSON file as for `load_scene`, and the npz file that it names."""
    path, device = arguments.path(path, "path"), arguments.device(device)
    try:
        content: Any = json.loads(path.read_text())
    except (OSError, ValueError) as error:
        raise ValueError(f"{path} cannot be read as JSON: {error}") from error
    if not isinstance(content, dict):
        raise ValueError(f"{path}: expected an object with {', '.join(_SCENE)}, got {type(content).__name__}")
    _require_known(path, content, (*_SCENE, *_OPTIONAL, "origin"))
    for key in _SCENE:
        if key not in content:
            raise ValueError(f"{path} has no {key!r}")
    names = content["meshes"]
    if not isinstance(names, list) or not all(isinstance(name, str) for name in names):
        raise ValueError(f"{path}: meshes: expected a list of file names, got {names!r}")
    if not isinstance(content["poses"], str):
        raise ValueError(f"{path}: poses: expected the name of an npz file, got {content['poses']!r}")
    optional = {key: content[key] for key in _OPTIONAL if key in content}
    origins = content.get("origin", [(0.0, 0.0, 0.0)] * len(names))
    if not isinstance(origins, list) or len(origins) != len(names):
        raise ValueError(f"{path}: origin: expected a list of {len(names)} values, one a mesh, got {origins!r}")
    try:
        meshes = [Mesh.load(path.parent / name, origin, unit="m") for name, origin in zip(names, origins, strict=True)]
        scene = Scene(meshes, content["mesh_index"], device, **optional)
    except (OSError, TypeError, ValueError) as error:
        raise ValueError(f"{path}: {error}") from error
    return scene, path.parent / content["poses"]


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


def _as_column(path: str | PathLike[str], name: str, values: np.ndarray) -> torch.Tensor:
    if values.dtype.kind not in "fiu":
        raise ValueError(f"{path}: {name}: expected numbers, got {values.dtype}")
    return torch.from_numpy(values.astype(np.float64))


def __dir__() -> list[str]:
    return sorted(__all__)
