"""Rollouts of any length as trajectories of a few segments at a time."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from typing import Any, TypeAlias

import torch
from torch import Tensor

from pgccd import arguments
from pgccd.arguments import real_rows
from pgccd.geometry.scene import Scene
from pgccd.motion.paths import PathKind
from pgccd.motion.trajectory import Trajectory

#: Positions (N, 3) and orientations (N, 4) of rigid bodies; or vertices (X, 3) of deforming ones.
Frame: TypeAlias = tuple[Tensor, Tensor] | Tensor

# Number of bodies, or of vertices of deforming bodies, in all segments of a window.
_ROWS = 1 << 16


def windows(scene: Scene, trajectory: Trajectory | Iterable[Frame], path: PathKind) -> Iterator[Trajectory]:
    """Trajectories of at most some 10^5 rows; each begins with the last frame of the one before.

    Raises:
        TypeError, ValueError: naming the argument, and the frame.
    """
    if isinstance(trajectory, Trajectory):
        trajectory._check(slice(0, None))
        rows, what = scene.body_count, "bodies"
        if trajectory.orientation is None:
            rows, what = scene.layout.vertex_count, "vertices"
        if trajectory.position.shape[1] != rows:
            raise ValueError(f"trajectory: has {trajectory.position.shape[1]} {what}, the scene {rows}")
        if trajectory.device != scene.device:
            raise ValueError(f"trajectory: is on {trajectory.device}, the scene on {scene.device}")
        size = max(1, _ROWS // max(1, trajectory.position.shape[1]))
        for first in range(0, trajectory.segment_count, size):
            yield trajectory._part(first, min(first + size, trajectory.segment_count))
        return
    if isinstance(trajectory, (Tensor, str, dict)) or not isinstance(trajectory, Iterable):
        expected = "a pgccd.Trajectory, or frames: pairs of position (N, 3) and orientation (N, 4), or vertices (X, 3)"
        raise TypeError(f"trajectory: expected {expected}, got {arguments.describe(trajectory)}")
    first, frames = 0, list[list[Tensor]]()
    for number, frame in enumerate(trajectory):
        frames.append(_columns(scene, frame, number, frames[0] if frames else None))
        if len(frames) > max(1, _ROWS // max(1, len(frames[0][0]))):
            yield _joined(frames, first, path)
            first, frames = number, frames[-1:]
    if first == 0 and len(frames) < 2:
        raise ValueError(f"trajectory: expected at least two frames, got {len(frames)}")
    if len(frames) > 1:
        yield _joined(frames, first, path)


_POSE = ["position", "orientation"]


def _columns(scene: Scene, frame: Any, number: int, like: Sequence[Tensor] | None) -> list[Tensor]:
    """A copy of a frame, since simulators write the next one to the same memory."""
    given, names = ([frame], ["vertices"]) if not isinstance(frame, (tuple, list)) else (frame, _POSE)
    if len(given) != len(names):
        raise ValueError(
            f"trajectory: frame {number}: expected a position (N, 3) and an orientation (N, 4), got {len(given)} values"
        )
    if like is not None and len(given) != len(like):
        kinds = {1: "vertices (X, 3)", 2: "a position and an orientation"}
        raise ValueError(f"trajectory: frame {number}: expected {kinds[len(like)]}, as before, got {kinds[len(given)]}")
    count = scene.body_count if len(given) == 2 else scene.layout.vertex_count
    columns = []
    for name, width, values in zip(names, (3, 4), given, strict=False):
        if not isinstance(values, Tensor):
            values = arguments.real_numbers(values, f"trajectory: frame {number}: {name}", "numbers").to(scene.device)
        checked = real_rows(values, f"trajectory: frame {number}: {name}", count, width, scene.device)
        columns.append(checked.clone() if checked.data_ptr() == values.data_ptr() else checked)
    return columns


def _joined(frames: list[list[Tensor]], first: int, path: PathKind) -> Trajectory:
    try:
        position, *orientation = (torch.stack(column) for column in zip(*frames, strict=True))
        return Trajectory(position, orientation[0] if orientation else None, path)
    except ValueError as error:
        raise ValueError(f"trajectory: counted from frame {first}: {error}") from error
