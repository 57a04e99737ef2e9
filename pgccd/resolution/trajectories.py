"""Resolution of trajectories: segment by segment; a body that is stopped stays where it is."""

from __future__ import annotations

import copy
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, ClassVar

import torch
from torch import Tensor

from pgccd.contacts.rows import Columns
from pgccd.geometry.scene import Scene
from pgccd.geometry.scene_columns import sum_of_margins
from pgccd.motion.paths import RigidMotion, VertexMotion
from pgccd.motion.rotation import rotated
from pgccd.motion.trajectory import Trajectory
from pgccd.resolution.results import Resolution
from pgccd.resolution.search import body_of_vertex


@dataclass(frozen=True, eq=False)
class TrajectoryResolution(Columns):
    """How far each of N bodies follows its trajectory of S segments such that none meets another.

    Each segment is resolved like a step, from where the bodies are at its start. A body that is stopped stays where it
    is, and its later waypoints are void. It may still stop other bodies.

    Attributes:
        motion: where the bodies go. A body that turns and is stopped within a segment follows its path in that segment,
            up to the rounding of the orientation at which it stops. It keeps the margin of that segment.
        segments: S motions: the same paths as they were tested. Nothing touches on them except the pairs in
            `touching_at_start` and `unresolved`.
        fraction: (S, N) float64 in [0, 1], the part of each segment that each body moves: 1 until the body is stopped,
            less than 1 in that segment, and 0 after it.
        stopped_by: (N,) int64, index of the body whose contact stopped this one, as for `Resolution`; -1 for none.
        touching_at_start: (P, 2) int64 pairs i <= j, sorted, that touch at the beginning of the first segment.
        unresolved: (U, 2) int64 pairs i <= j, sorted: other pairs that are not proven free in some segment. In each
            pair a body may not be stopped, or a margin is larger than in the segment before, or a waypoint is not
            exactly where the segment before it ends (by the rounding of `rotation`, 1e-7 rad if it is float32).
        rounds: number of detections in rounds, over all segments.
    """

    motion: Trajectory
    segments: list[RigidMotion | VertexMotion]
    fraction: Tensor
    stopped_by: Tensor
    touching_at_start: Tensor
    unresolved: Tensor
    rounds: int

    _names: ClassVar[tuple[str, ...]] = ("fraction", "stopped_by", "touching_at_start", "unresolved")
    _parts: ClassVar[tuple[str, ...]] = ("motion", "segments")

    # Motions are not compared.
    __eq__ = object.__eq__
    __hash__ = object.__hash__  # type: ignore[assignment]

    def __repr__(self) -> str:
        segments, bodies = self.fraction.shape
        return f"TrajectoryResolution(bodies={bodies}, segments={segments}, rounds={self.rounds})"


def resolve_segments(
    scene: Scene,
    trajectory: Trajectory,
    resolve: Callable[[Scene, RigidMotion | VertexMotion], Resolution[Any]],
) -> TrajectoryResolution:
    """Resolves the segments of a trajectory of the bodies of a scene one by one, each by `resolve`, which is given the
    scene with the margins of that segment.
    """
    count, device = scene.body_count, scene.device
    body = torch.arange(count, device=device) if trajectory.orientation is not None else body_of_vertex(scene)
    stopped = torch.zeros(count, dtype=torch.bool, device=device)
    by = torch.full((count,), -1, dtype=torch.int64, device=device)
    waypoints = [tuple(pose[0] for pose in (trajectory.position, trajectory.orientation) if pose is not None)]
    made: list[Resolution[Any]] = []
    fractions, margins = list[Tensor](), list[Tensor]()
    trajectory._margins(None, count)  # checks their number
    for segment in range(trajectory.segment_count):
        step = _held(trajectory.segment(segment), waypoints[-1], stopped[body][:, None])
        if trajectory.margin is not None:
            margin = trajectory.margin[segment]
            margins.append(torch.where(stopped, margins[-1], margin) if margins else margin)
        resolved = resolve(_thickened(scene, margins[-1]) if margins else scene, step)
        made.append(resolved)
        fractions.append(resolved.fraction.masked_fill(stopped, 0.0))
        newly = ~stopped & (resolved.fraction < 1.0)
        by, stopped = torch.where(newly, resolved.stopped_by, by), stopped | newly
        given = (pose[segment + 1] for pose in (trajectory.position, trajectory.orientation) if pose is not None)
        ends, rows = _end(resolved.motion), stopped[body][:, None]
        waypoints.append(tuple(torch.where(rows, end, pose) for end, pose in zip(ends, given, strict=True)))
    touching = made[0].touching_at_start
    unresolved = [part.unresolved for part in made]
    # Bodies that touch later although they were not stopped apart: one of them may not be stopped, or a margin has
    # grown.
    unresolved += [_without(part.touching_at_start, touching) for part in made[1:]]
    position, *orientation = (torch.stack(column) for column in zip(*waypoints, strict=True))
    rotation = None if trajectory.rotation is None else torch.stack([part.motion.rotation for part in made])
    return TrajectoryResolution(
        trajectory._stopped(
            position, orientation[0] if orientation else None, rotation, torch.stack(margins) if margins else None
        ),
        [part.motion for part in made],
        torch.stack(fractions),
        by,
        touching,
        torch.cat(unresolved).unique(dim=0),
        sum(part.rounds for part in made),
    )


def _thickened(scene: Scene, margin: Tensor) -> Scene:
    """The scene with more margin (N,) of each body."""
    estimates = scene._capacity_estimates  # the copy shares them
    thick = copy.copy(scene)
    thick.margin, thick._capacity_estimates = sum_of_margins(margin, scene.margin), estimates
    return thick


def _held(step: RigidMotion | VertexMotion, now: tuple[Tensor, ...], stopped: Tensor) -> RigidMotion | VertexMotion:
    """The step, in which the marked rows (K, 1) stay where they are `now`."""
    if isinstance(step, VertexMotion):
        return VertexMotion(*(torch.where(stopped, now[0], x) for x in (step.x_t0, step.x_t1)))
    position, orientation = now
    return RigidMotion.from_rotation(
        torch.where(stopped, position, step.position_t0),
        torch.where(stopped, orientation, step.orientation_t0),
        torch.where(stopped, position, step.position_t1),
        torch.where(stopped, 0.0, step.rotation),
        step.path,
    )


def _end(step: RigidMotion | VertexMotion) -> tuple[Tensor, ...]:
    """The poses, or vertices, at the end."""
    if isinstance(step, VertexMotion):
        return (step.x_t1,)
    at_rest = (step.rotation == 0.0).all(dim=1, keepdim=True)
    turned = rotated(step.orientation_t0, step.rotation)
    return step.position_t1, torch.where(at_rest, step.orientation_t0, turned)


def _without(pairs: Tensor, others: Tensor) -> Tensor:
    """The pairs (P, 2) that are not among the others (Q, 2)."""
    _, key = torch.cat([pairs, others]).unique(dim=0, return_inverse=True)
    return pairs[~torch.isin(key[: len(pairs)], key[len(pairs) :])]
