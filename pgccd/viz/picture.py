"""A picture of a world: all robots, the colliding ones, and a close-up of one collision."""

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from pgccd.viz.impact import COLLIDING, PAPER, draw_gap, draw_impact, draw_section
from pgccd.viz.raster import Camera, Canvas, placed
from pgccd.viz.shapes import Shape, drawn
from pgccd.viz.simplify import simplified, stored_bytes
from pgccd.viz.snapshot import Snapshot

_RESTING = np.array([0.52, 0.62, 0.74])
_PANEL = (1000, 900)
# Robots are drawn with triangles of about six square pixels, and with at least this many. If the robots have more
# triangles in all than this limit, only some robots are drawn.
_FEWEST_TRIANGLES = 24
_MOST_TRIANGLES = 16_000_000
_TRIANGLES_AT_ONCE = 2_000_000


def world_picture(path: str | Path, snapshot: Snapshot) -> Path:
    """Writes a PNG: the world, its colliding robots alone, and one collision with its contact point, section and gap.

    Args:
        path: of the PNG.
        snapshot: such as from `pgccd.sim.snapshot_of_step`.

    Returns:
        The path.

    Raises:
        ImportError: matplotlib is not installed.

    Example:
        >>> pgccd.viz.world_picture("model.png", pgccd.sim.snapshot_of_step(model, step))
    """
    try:
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.figure import Figure
    except ImportError as error:
        raise ImportError("pictures need matplotlib: pip install matplotlib") from error
    figure = Figure(figsize=(16, 14.0), dpi=110, facecolor="white")
    FigureCanvasAgg(figure)
    upper = figure.add_gridspec(1, 2, left=0.012, right=0.988, top=0.905, bottom=0.405, wspace=0.02)
    lower = figure.add_gridspec(1, 3, left=0.012, right=0.985, top=0.365, bottom=0.05, wspace=0.13)
    figure.text(0.015, 0.975, snapshot.caption[0] if snapshot.caption else "", size=18, weight="bold", va="center")
    figure.text(0.015, 0.947, "     ".join(snapshot.caption[1:]), size=13, color="0.25", va="center")
    every_robot = np.ones(len(snapshot.kind), dtype=bool)
    count = int(snapshot.colliding.sum())
    title = f"{len(every_robot):,} robots, the {count:,} that collide in this step in orange"
    _draw_world(figure.add_subplot(upper[0, 0]), snapshot, every_robot, title)
    _draw_world(figure.add_subplot(upper[0, 1]), snapshot, snapshot.colliding, "The colliding ones alone")
    if snapshot.impact is None:
        axes = figure.add_subplot(lower[0, :])
        axes.text(0.5, 0.5, "No collision in this step", ha="center", va="center", size=16, color="0.4")
        axes.set_axis_off()
    else:
        draw_impact(figure.add_subplot(lower[0, 0]), snapshot, snapshot.impact)
        draw_section(figure.add_subplot(lower[0, 1]), snapshot, snapshot.impact)
        draw_gap(figure.add_subplot(lower[0, 2]), snapshot, snapshot.impact)
    path = Path(path)
    figure.savefig(path, pil_kwargs={"compress_level": 1})  # the most takes a third of a second for a fifth less
    return path


def _coarse(shape: Shape, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Vertices (V, 3) and about `count` faces (F, 3) of a shape, all of them if there are fewer."""
    vertices, faces = shape.vertices, shape.faces
    if len(faces) <= count:
        return vertices, faces
    size = stored_bytes(count // 2, count)
    rows, left, _ = simplified(vertices, faces, size, 0, np.zeros(0, dtype=np.int64))
    if len(left) < count // 4:  # of a thin mesh, whose sides have been merged
        return vertices, faces[:: len(faces) // count]
    return vertices[rows], left


def _placed(
    snapshot: Snapshot, rows: np.ndarray, surfaces: Sequence[tuple[np.ndarray, np.ndarray]]
) -> Iterator[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """Vertices (V, 3), faces (T, 3) and the body row (T,) of each face, for many bodies, in chunks."""
    for kind, (local, faces) in enumerate(surfaces):
        members = rows[snapshot.kind[rows] == kind]
        step = max(1, _TRIANGLES_AT_ONCE // len(faces))
        for begin in range(0, len(members), step):
            piece = members[begin : begin + step]
            vertices = placed(local, snapshot.position[piece], snapshot.orientation[piece]).reshape(-1, 3)
            first = len(local) * np.arange(len(piece))[:, None, None]
            yield vertices, (first + faces).reshape(-1, 3), np.repeat(piece, len(faces))


def _draw_world(axes: Any, snapshot: Snapshot, shown: np.ndarray, title: str) -> None:
    half = snapshot.half_extent
    size = float(np.linalg.norm(half))
    camera = Camera(np.array([1.25, -2.3, 1.35]) * 2.2 * size, np.zeros(3), 1.76 * size, _PANEL)
    distance = float(np.linalg.norm(camera.eye))
    canvas = Canvas(camera, PAPER, (distance - size, distance + size))
    rows = np.flatnonzero(shown)
    shapes = [drawn(mesh) for mesh in snapshot.meshes]
    across = [2.0 * shape.radius * _PANEL[1] / camera.height for shape in shapes]
    surfaces = [
        _coarse(shape, max(_FEWEST_TRIANGLES, int(0.25 * pixels**2)))
        for shape, pixels in zip(shapes, across, strict=True)
    ]
    part = max(1, -(-len(rows) * max(len(faces) for _, faces in surfaces) // _MOST_TRIANGLES))
    rows = rows[::part]
    shades = 0.86 + 0.14 * np.random.default_rng(0).random(len(snapshot.kind))
    for vertices, faces, row in _placed(snapshot, rows, surfaces):
        hit = snapshot.colliding[row]
        haze = np.where(hit, 0.35, 0.72)  # colliding robots stay visible at a distance
        canvas.draw(vertices, faces, shades[row, None] * np.where(hit[:, None], COLLIDING, _RESTING), haze)
    axes.imshow(canvas.image(), interpolation="antialiased")
    _draw_box(axes, camera, half)
    axes.set_title(title if part == 1 else f"{title}; one in {part} is drawn", size=13, loc="left")
    axes.set_axis_off()


def _draw_box(axes: Any, camera: Camera, half: np.ndarray) -> None:
    corners = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]) * half
    pixels = camera.project(corners)
    hidden = int(np.argmax(pixels[:, 2]))
    for a in range(8):
        for axis in (1, 2, 4):
            if not a & axis:
                behind = hidden in (a, a | axis)
                axes.plot(*pixels[[a, a | axis], :2].T, color="0.25", lw=1.0, alpha=0.2 if behind else 0.9)
