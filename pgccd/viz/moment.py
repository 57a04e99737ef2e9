"""Bodies at one time: where they are and which colours they have, for pictures and models."""

from __future__ import annotations

import numpy as np
import torch

from pgccd import ops
from pgccd.viz.animation import Animation, Marks, RigidPaths
from pgccd.viz.raster import placed

#: Colours of bodies, red, green and blue in [0, 1], by the numbers of `colours_at`. The same as on pages.
COLOURS = np.array(
    [
        (0.52, 0.62, 0.74),
        (0.62, 0.62, 0.60),
        (0.84, 0.57, 0.41),
        (0.96, 0.40, 0.12),
        (0.98, 0.78, 0.22),
        (0.67, 0.59, 0.53),
    ]
)
_FREE, _STATIC, _COLLIDING, _FIRST, _SECOND, _FAINT = range(6)
# A body this much larger than a body that it touches would fill the picture with the colour of contacts.
_LARGE = 4.0
_ALL = slice(None)


def faint_bodies(marks: Marks, static: np.ndarray, radius: np.ndarray) -> np.ndarray:
    """(N,) bool: bodies that keep their colour in a contact, so that other bodies stand out on them: static ones, such
    as floors, and those much larger than a body that they touch.

    Args:
        marks: contacts.
        static: (N,) bool.
        radius: (N,) of the bodies.
    """
    faint = static.copy()
    i, j = marks.bodies.T
    faint[i[radius[i] > _LARGE * radius[j]]] = True
    faint[j[radius[j] > _LARGE * radius[i]]] = True
    return faint


def first_moment(animation: Animation) -> tuple[int, float, np.ndarray]:
    """Segment and time in it of the first contact, or 0 and 0 without one; and the rows of the contacts then."""
    marks = animation.marks
    if not len(marks):
        return 0, 0.0, np.zeros(0, dtype=np.int64)
    first = np.lexsort((marks.toi, marks.segment))[0]
    segment, time = int(marks.segment[first]), float(marks.toi[first])
    return segment, time, np.flatnonzero((marks.segment == segment) & (marks.toi == time))


def colours_at_first(animation: Animation) -> np.ndarray:
    """(N,) rows of `COLOURS` at the first contact, whose two bodies have two colours."""
    _, _, rows = first_moment(animation)
    colours = np.where(animation.static, _STATIC, _FREE)
    colours[animation.colliding] = _COLLIDING
    if len(rows):
        i, j = animation.marks.bodies[rows[0]]
        colours[j], colours[i] = _SECOND, _FIRST
    radius = np.array([np.linalg.norm(shape.vertices, axis=1).max(initial=0.0) for shape in animation.shapes])
    faint = faint_bodies(animation.marks, animation.static, radius[animation.shape_index])
    colours[faint & animation.colliding] = _FAINT
    return colours


def poses_at(
    paths: RigidPaths, segment: int | slice, time: float, rows: np.ndarray | slice = _ALL
) -> tuple[np.ndarray, np.ndarray]:
    """Positions (N, 3) and orientations (N, 4) of bodies that move on arcs; for many segments, one segment after the
    other.
    """
    columns = (column[segment][..., rows, :] for column in (paths.start, paths.end, paths.orientation, paths.rotation))
    flat = (torch.from_numpy(np.ascontiguousarray(column.reshape(-1, column.shape[-1]))) for column in columns)
    start, end, turn, rotation = flat
    position, orientation = ops.poses_at(start, end, turn, rotation, torch.full_like(start[:, 0], time))
    return position.numpy(), orientation.numpy()


def vertices_at(animation: Animation, segment: int, time: float) -> list[np.ndarray]:
    """Vertices of each body, (V, 3) each, world frame."""
    paths, found = animation.paths, []
    if isinstance(paths, RigidPaths):
        moments = (0.0, 1.0) if paths.is_linear else (time,)
        ends = [poses_at(paths, segment, moment) for moment in moments]
        for body, shape in enumerate(animation.shape_index.tolist()):
            drawn = animation.shapes[shape]
            at_ends = [placed(drawn.vertices, x[body, None], q[body, None])[0] for x, q in ends]
            mixed = (1.0 - time) * at_ends[0] + time * at_ends[-1]
            found.append(drawn.moved(mixed[None, : drawn.vertex_count])[0] if paths.is_linear else mixed)
        return found
    first, last = paths.ends[segment]
    position = (1.0 - time) * paths.position[first] + time * paths.position[last]
    for body, shape in enumerate(animation.shape_index.tolist()):
        drawn = animation.shapes[shape]
        found.append(drawn.moved(position[None, paths.begin[body] :][:, : drawn.vertex_count])[0])
    return found
