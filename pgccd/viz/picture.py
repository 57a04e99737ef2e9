"""A picture of a world: all robots, the colliding ones, and one collision from near by."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from pgccd.viz.raster import Camera, Canvas, rotation_matrices
from pgccd.viz.snapshot import Impact, Snapshot

_PAPER = (1.0, 1.0, 1.0)
_RESTING = np.array([0.50, 0.60, 0.72])
_COLLIDING = np.array([0.95, 0.36, 0.10])
_PARTNER = np.array([0.98, 0.76, 0.18])
_PANEL = (1000, 860)
# Beyond these numbers of triangles a robot is drawn by a part of them only, and robots by a part of them: each is then
# smaller than a few pixels.
_MOST_TRIANGLES = 16_000_000
_TRIANGLES_AT_ONCE = 2_000_000


def world_picture(path: str | Path, snapshot: Snapshot) -> Path:
    """Writes a PNG: the world, its colliding robots alone, and one collision with its contact point, normal and gap.

    Args:
        path: of the PNG.
        snapshot: from `Snapshot.of_step` or `Snapshot.of_state`.

    Returns:
        The path.

    Raises:
        ImportError: matplotlib is not installed.

    Example:
        >>> pgccd.viz.world_picture("world.png", pgccd.viz.Snapshot.of_step(world, step))
    """
    try:
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.figure import Figure
    except ImportError as error:
        raise ImportError("pictures are made by matplotlib: pip install matplotlib") from error
    figure = Figure(figsize=(16, 14.2), dpi=110, facecolor="white")
    FigureCanvasAgg(figure)
    grid = figure.add_gridspec(
        2, 2, left=0.012, right=0.988, top=0.905, bottom=0.05, wspace=0.02, hspace=0.09, height_ratios=(1.0, 0.86)
    )
    figure.text(0.015, 0.972, snapshot.caption[0] if snapshot.caption else "", size=17, weight="bold", va="center")
    figure.text(0.015, 0.945, "   ".join(snapshot.caption[1:]), size=12.5, color="0.25", va="center")
    everybody = np.ones(len(snapshot.kind), dtype=bool)
    count = int(snapshot.colliding.sum())
    _draw_world(figure.add_subplot(grid[0, 0]), snapshot, everybody, f"All {len(everybody):,} robots; colliding ones orange")
    _draw_world(
        figure.add_subplot(grid[0, 1]), snapshot, snapshot.colliding, f"The {count:,} that collide in this step, alone"
    )
    if snapshot.impact is None:
        axes = figure.add_subplot(grid[1, :])
        axes.text(0.5, 0.5, "No collision in this step", ha="center", va="center", size=16, color="0.4")
        axes.set_axis_off()
    else:
        _draw_impact(figure.add_subplot(grid[1, 0]), snapshot, snapshot.impact)
        lower = grid[1, 1].subgridspec(1, 2, wspace=0.16, width_ratios=(1.0, 1.0))
        _draw_contact(figure.add_subplot(lower[0, 0]), snapshot, snapshot.impact)
        _draw_gap(figure.add_subplot(lower[0, 1]), snapshot, snapshot.impact)
    path = Path(path)
    figure.savefig(path)
    return path


def _triangles(snapshot: Snapshot, rows: np.ndarray, stride: int) -> Any:
    """Triangles (T, 3, 3) of bodies and the row of each, in pieces."""
    for kind, mesh in enumerate(snapshot.meshes):
        faces = mesh.faces.numpy()[::stride]
        members = rows[snapshot.kind[rows] == kind]
        local = mesh.vertices.numpy()
        step = max(1, _TRIANGLES_AT_ONCE // len(faces))
        for begin in range(0, len(members), step):
            piece = members[begin : begin + step]
            turned = np.einsum("bij,vj->bvi", rotation_matrices(snapshot.orientation[piece]), local)
            placed = turned + snapshot.position[piece, None, :]
            yield placed[:, faces].reshape(-1, 3, 3), np.repeat(piece, len(faces))


def _draw_world(axes: Any, snapshot: Snapshot, shown: np.ndarray, title: str) -> None:
    half = snapshot.half_extent
    size = float(np.linalg.norm(half))
    camera = Camera(np.array([1.25, -2.3, 1.35]) * 2.2 * size, np.zeros(3), 1.86 * size, _PANEL)
    distance = float(np.linalg.norm(camera.eye))
    canvas = Canvas(camera, _PAPER, (distance - size, distance + size), haze=0.72)
    rows = np.flatnonzero(shown)
    faces_a_body = max(len(mesh.faces) for mesh in snapshot.meshes)
    stride = max(1, min(faces_a_body // 16, -(-len(rows) * faces_a_body // _MOST_TRIANGLES)))
    rows = rows[:: max(1, -(-len(rows) * (faces_a_body // stride) // _MOST_TRIANGLES))]
    shades = 0.86 + 0.14 * np.random.default_rng(0).random(len(snapshot.kind))
    for triangles, row in _triangles(snapshot, rows, stride):
        tint = shades[row, None] * np.where(snapshot.colliding[row, None], _COLLIDING, _RESTING)
        canvas.draw(triangles, tint)
    axes.imshow(canvas.image(), interpolation="antialiased")
    _draw_box(axes, camera, half)
    _finish(axes, title)


def _draw_box(axes: Any, camera: Camera, half: np.ndarray) -> None:
    corners = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]) * half
    pixels = camera.project(corners)
    hidden = int(np.argmax(pixels[:, 2]))
    for a in range(8):
        for axis in (1, 2, 4):
            if not a & axis:
                behind = hidden in (a, a | axis)
                line = pixels[[a, a | axis], :2].T
                style = {"color": "0.72", "lw": 0.8, "zorder": 0} if behind else {"color": "0.25", "lw": 1.1}
                axes.plot(*line, **style)


def _impact_canvas(snapshot: Snapshot, impact: Impact, camera: Camera, pixels_deep: float) -> Canvas:
    distance = float(np.linalg.norm(camera.eye - camera.target))
    canvas = Canvas(camera, _PAPER, (max(1e-3, distance - pixels_deep), distance + pixels_deep))
    for body, tint in enumerate((_COLLIDING, _PARTNER)):
        mesh = snapshot.meshes[impact.kinds[body]]
        turned = mesh.vertices.numpy() @ rotation_matrices(impact.orientation[body : body + 1])[0].T
        triangles = (turned + impact.position[body])[mesh.faces.numpy()]
        canvas.draw(triangles, np.broadcast_to(tint, (len(triangles), 3)))
    return canvas


def _side_view(snapshot: Snapshot, impact: Impact, target: np.ndarray, height: float, pixels: tuple[int, int]) -> Camera:
    """Across the contact normal, so that the gap is seen from the side, with i on the left."""
    across = impact.normal if np.any(impact.normal) else np.array([1.0, 0.0, 0.0])
    line = impact.position[1] - impact.position[0]
    up = line - (line @ across) * across
    if np.linalg.norm(up) < 1e-6 * np.linalg.norm(line):
        up = np.cross(across, np.eye(3)[int(np.argmin(np.abs(across)))])
    up = up / np.linalg.norm(up)
    view = np.cross(across, up)
    distance = 6.0 * max(mesh.radius for mesh in snapshot.meshes)
    return Camera(target + distance * view, target, height, pixels, (up[0], up[1], up[2]))


def _draw_impact(axes: Any, snapshot: Snapshot, impact: Impact) -> None:
    radius = max(mesh.radius for mesh in snapshot.meshes)
    pixels = (_PANEL[0], 740)
    camera = _side_view(snapshot, impact, impact.position.mean(axis=0), 3.4 * radius, pixels)
    axes.imshow(_impact_canvas(snapshot, impact, camera, 3.0 * radius).image(), interpolation="antialiased")
    point = camera.project(impact.point)
    for body, label in enumerate(impact.ids):
        centre = camera.project(impact.position[body])
        axes.text(centre[0], centre[1], f"robot {label}", size=11, ha="center", weight="bold", color="0.1")
    axes.plot(point[0], point[1], "o", mfc="none", mec="black", ms=17, mew=1.6)
    arrow = camera.project(impact.point + 0.45 * radius * impact.normal)
    axes.annotate("", arrow[:2], point[:2], arrowprops={"arrowstyle": "-|>", "lw": 1.8, "color": "black"})
    axes.text(arrow[0], arrow[1], "  normal", size=10, va="center")
    title = f"One of the collisions, at its time of impact {impact.toi:.6f}: {impact.feature}"
    _finish(axes, title)


def _draw_contact(axes: Any, snapshot: Snapshot, impact: Impact) -> None:
    radius = max(mesh.radius for mesh in snapshot.meshes)
    height = 0.24 * radius
    camera = _side_view(snapshot, impact, impact.point, height, (700, 760))
    axes.imshow(_impact_canvas(snapshot, impact, camera, 3.0 * radius).image(), interpolation="antialiased")
    point = camera.project(impact.point)
    axes.plot(point[0], point[1], "o", mfc="none", mec="black", ms=17, mew=1.6)
    _finish(axes, f"The contact point, {3.4 / 0.24:.0f} times larger")


def _draw_gap(axes: Any, snapshot: Snapshot, impact: Impact) -> None:
    radius = max(mesh.radius for mesh in snapshot.meshes)
    gap = impact.gap / radius
    axes.axhline(0.0, color="0.6", lw=0.8)
    before = impact.times <= impact.toi
    axes.plot(impact.times[before], gap[before], color=tuple(_COLLIDING), lw=2.2, label="up to the impact")
    axes.plot(impact.times[~before], gap[~before], color="0.65", lw=1.6, ls="--", label="if they went on")
    axes.axvline(impact.toi, color="black", lw=0.9, ls=":")
    axes.plot([impact.toi], [0.0], "o", mfc="none", mec="black", ms=11, mew=1.6)
    axes.set_xlim(0.0, 1.0)
    axes.set_xlabel("time in the step")
    axes.legend(frameon=False, loc="upper right", fontsize=10)
    axes.set_title("Gap of the two features along the normal, in radii", size=11, loc="left")
    axes.tick_params(labelsize=9)
    for side in ("top", "right"):
        axes.spines[side].set_visible(False)


def _finish(axes: Any, title: str) -> None:
    axes.set_title(title, size=12, loc="left")
    axes.set_axis_off()
