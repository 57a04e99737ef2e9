"""Which waypoints of a long motion a page keeps: those of contacts, then those furthest from the paths without them."""

from __future__ import annotations

import heapq

import numpy as np
import torch

from pgccd import ops
from pgccd.viz.animation import Animation, Marks, RigidPaths
from pgccd.viz.raster import placed

# Numbers that are read, of all waypoints together.
_MOST_NUMBERS = 6_000_000


def chosen_waypoints(animation: Animation, marks: Marks, most: int) -> np.ndarray:
    """Ascending waypoints, `most` + 1 at most, 4 at least: the first, the last two, both ends of the segments of
    contacts (of the first contacts, if there are too many), and those that lie furthest from the straight paths between
    the others, if any lie off these paths.
    """
    segments = animation.segment_count
    touched = np.unique(marks.segment)
    added = np.where(np.diff(touched, prepend=-2) == 1, 1, 2)
    touched = touched[: int(np.searchsorted(np.cumsum(added), most - 2, side="right"))]
    kept = np.unique(np.concatenate([[0, segments - 1, segments], touched, touched + 1]))
    return _refined(_points(animation), kept, most + 1)


def needed_segments(marks: Marks) -> int:
    """Segments with which all contacts are kept."""
    touched = np.unique(marks.segment)
    return 2 + int(np.where(np.diff(touched, prepend=-2) == 1, 1, 2).sum())


def _points(animation: Animation) -> np.ndarray:
    """(S + 1, P, 3): points of some of the bodies, colliding ones first, at all waypoints."""
    paths, segments = animation.paths, animation.segment_count
    most = max(1, _MOST_NUMBERS // (3 * (segments + 1)))
    if not isinstance(paths, RigidPaths):
        moments = np.append(paths.ends[:, 0], paths.ends[-1, 1])
        vertices = np.arange(0, paths.position.shape[1], max(1, paths.position.shape[1] // most))
        return paths.position[moments][:, vertices]
    rows = np.argsort(~animation.colliding, kind="stable")[: max(1, most // 3)]
    radius = np.array([np.linalg.norm(shape.vertices, axis=1).max(initial=0.0) for shape in animation.shapes])
    position = np.concatenate([paths.start[:, rows], paths.end[-1:, rows]])
    orientation = np.concatenate([paths.orientation[:, rows], _last_orientation(paths, rows)])
    size = radius[animation.shape_index[rows]]
    points = []
    for axis in ([0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]):
        none = np.zeros_like(position).reshape(-1, 3)
        turned = placed(np.array([axis]), none, orientation.reshape(-1, 4)).reshape(position.shape)
        points.append(position + size[:, None] * turned)
    return np.concatenate(points, axis=1)


def _last_orientation(paths: RigidPaths, rows: np.ndarray) -> np.ndarray:
    columns = (paths.start, paths.end, paths.orientation, paths.rotation)
    start, end, turn, rotation = (torch.from_numpy(np.ascontiguousarray(column[-1, rows])) for column in columns)
    return ops.poses_at(start, end, turn, rotation, torch.ones(len(rows), dtype=torch.float64))[1].numpy()[None]


def _refined(points: np.ndarray, kept: np.ndarray, most: int) -> np.ndarray:
    """`kept` and further waypoints, each the one that lies furthest from the straight paths between those before."""
    found = set(kept.tolist())
    worst: list[tuple[float, int, int, int]] = []

    def look(begin: int, end: int) -> None:
        if end > begin + 1:
            time = (np.arange(begin + 1, end) - begin)[:, None, None] / (end - begin)
            straight = points[begin] + time * (points[end] - points[begin])
            off = ((points[begin + 1 : end] - straight) ** 2).sum(axis=2).max(axis=1, initial=0.0)
            at = int(off.argmax())
            if off[at] > 0.0:
                heapq.heappush(worst, (-float(off[at]), begin, begin + 1 + at, end))

    for begin, end in zip(kept[:-1].tolist(), kept[1:].tolist(), strict=True):
        look(begin, end)
    while worst and len(found) < most:
        _, begin, at, end = heapq.heappop(worst)
        found.add(at)
        look(begin, at)
        look(at, end)
    return np.array(sorted(found))
