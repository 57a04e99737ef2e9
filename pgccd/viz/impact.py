"""Close-up of one collision: the two bodies, a section through the contact, and the gap over the step."""

from typing import Any

import numpy as np

from pgccd.viz.raster import Camera, Canvas, placed
from pgccd.viz.shapes import drawn
from pgccd.viz.snapshot import Impact, Snapshot

PAPER = (1.0, 1.0, 1.0)
COLLIDING = np.array([0.96, 0.40, 0.12])
_PARTNER = np.array([0.98, 0.78, 0.22])
_PIXELS = (900, 800)


def _frame(impact: Impact) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Unit vectors along the normal, across it towards the bodies' centres, and towards the viewer."""
    along = impact.normal if np.any(impact.normal) else np.array([1.0, 0.0, 0.0])
    line = impact.position[1, 1] - impact.position[1, 0]
    across = line - (line @ along) * along
    if np.linalg.norm(across) < 1e-6 * np.linalg.norm(line):
        across = np.cross(along, np.eye(3)[int(np.argmin(np.abs(along)))])
    across = across / np.linalg.norm(across)
    return along, across, np.cross(along, across)


def _placed(snapshot: Snapshot, impact: Impact, body: int, moment: int) -> tuple[np.ndarray, np.ndarray]:
    """Vertices (V, 3), world frame, and faces (F, 3) of one of the two bodies at t0, toi or t1 (moment 0, 1, 2)."""
    shape = drawn(snapshot.meshes[impact.kinds[body]])
    vertices = placed(shape.vertices, impact.position[moment, body, None], impact.orientation[moment, body, None])
    return vertices[0], shape.faces


def _radius(snapshot: Snapshot) -> float:
    """That of the largest mesh as it is drawn."""
    return max(drawn(mesh).radius for mesh in snapshot.meshes)


def draw_impact(axes: Any, snapshot: Snapshot, impact: Impact) -> None:
    """Both bodies at the time of impact, seen across the contact normal."""
    radius = _radius(snapshot)
    along, across, view = _frame(impact)
    target = impact.position[1].mean(axis=0)
    distance = 6.0 * radius
    camera = Camera(target + distance * view, target, 3.6 * radius, _PIXELS, (across[0], across[1], across[2]))
    canvas = Canvas(camera, PAPER, (distance - 3.0 * radius, distance + 3.0 * radius))
    for body, tint in enumerate((COLLIDING, _PARTNER)):
        vertices, faces = _placed(snapshot, impact, body, moment=1)
        canvas.draw(vertices, faces, np.broadcast_to(tint, (len(faces), 3)))
    axes.imshow(canvas.image(), interpolation="antialiased")
    for body, label in enumerate(impact.ids):
        centre = camera.project(impact.position[1, body])
        axes.text(centre[0], centre[1], f"robot {label}", size=11, ha="center", weight="bold", color="0.1")
    ends = camera.project(impact.point + np.outer([-0.5 * radius, 0.0, 0.5 * radius], along))
    axes.plot(ends[1, 0], ends[1, 1], "o", mfc="none", mec="black", ms=15, mew=1.6)
    axes.annotate("", ends[2, :2], ends[1, :2], arrowprops={"arrowstyle": "-|>", "lw": 1.8, "color": "black"})
    title = f"One collision, at its time of impact {impact.toi:.6f}:\n{impact.feature}; arrow: normal"
    axes.set_title(title, size=12, loc="left")
    axes.set_axis_off()


def draw_section(axes: Any, snapshot: Snapshot, impact: Impact) -> None:
    """The bodies' outlines in the plane through the contact point and the normal, at t0, toi and t1."""
    from matplotlib.collections import LineCollection

    radius = _radius(snapshot)
    along, across, view = _frame(impact)
    styles: list[dict[str, Any]] = [
        {"lw": 1.0, "linestyles": "dotted", "alpha": 0.9},
        {"lw": 2.4},
        {"lw": 1.0, "linestyles": "dashed", "alpha": 0.9},
    ]
    for moment, (style, name) in enumerate(zip(styles, ("start", "impact", "end, if they went on"), strict=True)):
        for body, tint in enumerate((COLLIDING, 0.85 * _PARTNER)):
            vertices, faces = _placed(snapshot, impact, body, moment)
            local = (vertices - impact.point) @ np.stack([along, across, view], axis=1)
            segments = _plane_section(local[faces]) / radius
            axes.add_collection(LineCollection(list(segments), colors=[tuple(tint)], **style))
        axes.plot([], [], color="0.3", lw=style["lw"], ls=style.get("linestyles", "solid"), label=name)
    axes.plot(0.0, 0.0, "o", mfc="none", mec="black", ms=12, mew=1.6, zorder=5)
    axes.annotate("", (0.12, 0.0), (0.0, 0.0), arrowprops={"arrowstyle": "-|>", "lw": 1.6, "color": "black"}, zorder=5)
    axes.set_xlim(-0.42, 0.42)
    axes.set_ylim(-0.37, 0.37)
    axes.set_aspect("equal")
    axes.tick_params(labelsize=9)
    axes.legend(frameon=False, loc="upper center", bbox_to_anchor=(0.5, -0.05), ncols=3, fontsize=10)
    axes.set_title("Section through the contact point along the normal,\nin radii", size=12, loc="left")


def _plane_section(local: np.ndarray) -> np.ndarray:
    """Intersection of triangles (T, 3, 3) with the plane where the third coordinate is 0: segments (S, 2, 2)."""
    height = local[..., 2]
    cut = local[(height.min(axis=1) <= 0.0) & (height.max(axis=1) > 0.0)]
    ends = []
    for a, b in ((0, 1), (1, 2), (2, 0)):
        p, q = cut[:, a], cut[:, b]
        crosses = (p[:, 2] > 0.0) != (q[:, 2] > 0.0)
        share = np.where(crosses, p[:, 2] / np.where(crosses, p[:, 2] - q[:, 2], 1.0), np.nan)
        ends.append(p[:, :2] + share[:, None] * (q[:, :2] - p[:, :2]))
    points = np.stack(ends, axis=1)  # two of the three sides of each triangle cross the plane
    return points[~np.isnan(points[..., 0])].reshape(-1, 2, 2)


def draw_gap(axes: Any, snapshot: Snapshot, impact: Impact) -> None:
    """The gap between the two touching features along the normal, over the step."""
    radius = _radius(snapshot)
    gap = impact.gap / radius
    before = impact.times <= impact.toi
    axes.axhline(0.0, color="0.6", lw=0.8)
    axes.plot(impact.times[before], gap[before], color=tuple(COLLIDING), lw=2.4, label="up to the impact")
    axes.plot(impact.times[~before], gap[~before], color="0.6", lw=1.6, ls="--", label="if they went on")
    axes.axvline(impact.toi, color="black", lw=0.9, ls=":")
    axes.plot([impact.toi], [0.0], "o", mfc="none", mec="black", ms=12, mew=1.6)
    axes.set_xlim(0.0, 1.0)
    axes.set_xlabel("time in the step")
    axes.legend(frameon=False, loc="upper right", fontsize=10)
    axes.set_title("Gap of the two touching features along the normal,\nin radii", size=12, loc="left")
    axes.tick_params(labelsize=9)
    for side in ("top", "right"):
        axes.spines[side].set_visible(False)
