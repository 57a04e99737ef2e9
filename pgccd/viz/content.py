"""What fits into a page of bounded size: bodies, waypoints, meshes and contacts, as the JSON that `page.html` reads.

Lengths are in page units: world coordinates less `centre`, divided by `scale`, so that float32 holds them.
"""

from __future__ import annotations

import base64
import json
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from pgccd.viz.animation import Animation, Marks, RigidPaths, VertexPaths, thinned_paths
from pgccd.viz.moment import faint_bodies, poses_at
from pgccd.viz.raster import placed
from pgccd.viz.simplify import level_within, simplified, stored_bytes
from pgccd.viz.waypoints import chosen_waypoints, needed_segments

# Bytes before their encoding as text, which adds a third: the page stays below 5 MB.
_MOST_BYTES = 3_550_000
_MOST_ROWS = 36_000  # of a rigid body in a segment
_ROW_BYTES, _BODY_BYTES, _CONTACT_BYTES = 52, 21, 79
_MOST_CONTACTS = 2_000
_MOST_LETTERS = 80  # of a name
# Bits of a body's state.
STATIC, COLLIDING, FAINT = 1, 2, 4
_MOST_CHOICES = 1_000  # worlds in the list of the page; those of contacts are added to it
# Long trajectories lose waypoints before bodies or triangles, down to this number of segments.
_LEAST_SEGMENTS = 20
# Bodies that are drawn, if there are so many, before waypoints of contacts.
_LEAST_BODIES = 200
# If less is left for a mesh, it is not simplified further; bodies are left out instead.
_LEAST_MESH_BYTES = 2_000


@dataclass
class _Drawn:
    """The part of an animation that is on the page: rows of bodies, and meshes by number."""

    rows: np.ndarray
    mesh_of: np.ndarray  # (rows,)
    meshes: list[tuple[np.ndarray, np.ndarray]]  # vertices ((W,) V, 3) and faces (F, 3)


def page_content(animation: Animation) -> tuple[dict[str, Any], list[str]]:
    """The data of a page, and what is left out, in sentences."""
    notes: list[str] = []
    marks = animation.marks
    order = np.lexsort((marks.toi, marks.segment))
    if len(order) > _MOST_CONTACTS:
        notes.append(f"The first {_MOST_CONTACTS:,} of {len(order):,} contacts are on this page.")
    marks = marks[order[:_MOST_CONTACTS]]
    animation, marks, waypoints = _thinned(animation, marks, notes)
    names = _names(animation, marks)
    drawn = _drawn(animation, marks, len(json.dumps(names)), notes)
    marks = _between_drawn(animation, marks, drawn, notes)
    centre, scale = _frame(animation, drawn)
    data = {
        "centre": centre.tolist(),
        "scale": scale,
        "waypoints": waypoints.tolist(),
        "step": animation.first_step,
        "bodies": _body_columns(animation, marks, drawn, scale) | {"names": names},
        "contacts": _contact_columns(marks, waypoints, centre, scale),
        "box": None if animation.box is None else ((animation.box - centre) / scale).tolist(),
    }
    paths = animation.paths
    if isinstance(paths, RigidPaths):
        data["rigid"] = _rigid(paths, drawn, centre, scale)
    else:
        data["deforming"] = _deforming(paths, drawn, centre, scale)
    return data, notes


def _thinned(animation: Animation, marks: Marks, notes: list[str]) -> tuple[Animation, Marks, np.ndarray]:
    """The animation with fewer waypoints, if it is long; its contacts, by number of segment left; and the waypoints."""
    paths, segments = animation.paths, animation.segment_count
    if isinstance(paths, RigidPaths):
        count = paths.start.shape[1]
        fitting = _MOST_ROWS // max(1, count)
        # If there are many bodies, some that do not collide make room for contacts.
        crowded = _MOST_ROWS // max(1, int(animation.colliding.sum()), min(count, _LEAST_BODIES))
        fitting = max(fitting, min(crowded, needed_segments(marks)))
    else:
        moments, size, _ = paths.position.shape
        fitting = int(0.8 * _MOST_BYTES * segments / (12 * max(1, size) * moments)) - 1
    most = max(fitting, _LEAST_SEGMENTS)
    if segments <= most:
        return animation, marks, np.arange(segments + 1)
    waypoints = chosen_waypoints(animation, marks, most)
    place = np.searchsorted(waypoints, marks.segment)
    is_whole = (waypoints[np.minimum(place, len(waypoints) - 2)] == marks.segment) & np.isin(
        marks.segment + 1, waypoints
    )
    kept, between = f"{len(waypoints):,} of {segments + 1:,} waypoints", "between"
    if animation.first_step is not None:
        kept, between = f"{len(waypoints) - 1:,} of {segments:,} steps", "in"
    notes.append(f"{kept} are on this page: {between} those left out, paths are approximate.")
    if not is_whole.all():
        notes.append(f"{int((~is_whole).sum()):,} contacts in these parts are left out.")
    marks = marks[is_whole]
    marks.segment = place[is_whole]
    fraction = animation.fraction
    if fraction is not None:
        fraction = np.where(np.diff(waypoints)[:, None] > 1, 1.0, fraction[waypoints[:-1]])
    hit = np.logical_or.reduceat(animation.hit, waypoints[:-1], axis=0)
    return replace(animation, paths=thinned_paths(paths, waypoints), hit=hit, fraction=fraction), marks, waypoints


def _order(animation: Animation) -> np.ndarray:
    """Rows of bodies: colliding ones first; then, with worlds, the other bodies of their worlds; else the others in
    random order, so that any prefix is a random sample.
    """
    count, colliding = len(animation.shape_index), animation.colliding
    order = np.random.default_rng(0).permutation(count)
    if animation.world is not None:
        collides = np.zeros(int(animation.world.max(initial=0)) + 1, dtype=bool)
        collides[animation.world[colliding]] = True
        order = np.lexsort((animation.world, ~collides[animation.world]))
    return order[np.argsort(~colliding[order], kind="stable")]


def _names(animation: Animation, marks: Marks) -> dict[int, str]:
    """Names of the bodies of contacts, by number."""
    if animation.names is None:
        return {}
    ids = np.unique(animation.ids[marks.bodies]).tolist()
    return {
        body: name if len(name := animation.names[body]) <= _MOST_LETTERS else f"{name[:_MOST_LETTERS]}…"
        for body in ids
    }


def _drawn(animation: Animation, marks: Marks, name_bytes: int, notes: list[str]) -> _Drawn:
    paths, order, colliding = animation.paths, _order(animation), animation.colliding
    budget, segments = _MOST_BYTES - _CONTACT_BYTES * len(marks) - name_bytes, animation.segment_count
    own = _BODY_BYTES + _step_bytes(animation) * segments
    if isinstance(paths, RigidPaths):
        order = order[: max(1, _MOST_ROWS // segments)]
        budget -= (own + _ROW_BYTES * segments) * len(order)
        own = 0
        names, first = np.unique(animation.shape_index[order], return_index=True)
        meshes = names[np.argsort(first)]  # in the order of the first body
        waypoints, pieces = 0, [(animation.shapes[k].vertices, animation.shapes[k].faces) for k in meshes]
    else:
        meshes, waypoints = order, len(paths.position)
        counts = np.array([len(shape.vertices) for shape in animation.shapes], dtype=np.int64)
        pieces = []
        for body in order:
            shape = animation.shape_index[body]
            first = paths.begin[body]
            pieces.append((paths.position[:, first : first + counts[shape]], animation.shapes[shape].faces))
    costs = np.array([stored_bytes(vertices.shape[-2], len(faces), waypoints) for vertices, faces in pieces])
    least = np.minimum(costs, _LEAST_MESH_BYTES * max(1, waypoints)) + own
    kept = max(1, int((np.cumsum(least) <= budget).sum()))
    pieces, meshes = pieces[:kept], meshes[:kept]
    allowed = level_within(costs[:kept], budget - own * kept)
    touching = _touching_vertices(animation, marks)
    simple = []
    for number in np.flatnonzero(costs[:kept] > allowed):
        vertices, faces = pieces[number]
        name = int(meshes[number])
        shape = animation.shapes[name if isinstance(paths, RigidPaths) else animation.shape_index[name]]
        if not shape.triangle_count:
            every = len(shape.segments) + len(shape.points)
            count = max(1, int(every * allowed / (costs[number] - stored_bytes(shape.vertex_count, 0, waypoints))))
            rows, fewer = shape.some(min(count, every), touching.get(name, _NONE))
            simple.append((name, f"{min(count, every):,} of its {every:,} segments and points."))
        else:
            first_vertices = vertices if vertices.ndim == 2 else vertices[0]
            rows, fewer, moved = simplified(first_vertices, faces, allowed, waypoints, touching.get(name, _NONE))
            kept_of = f"{len(fewer):,} of its {len(faces):,} triangles"
            simple.append((name, f"{kept_of}: vertices moved by up to {moved:.2g}."))
        pieces[number] = vertices[..., rows, :], fewer
    what = "Mesh" if isinstance(paths, RigidPaths) else "Body"
    for name, said in simple[:3]:
        notes.append(f"{what} {name} is drawn with {said}")
    if len(simple) > 3:
        notes.append(f"So are {len(simple) - 3:,} others.")
    place = {int(name): number for number, name in enumerate(meshes)}
    keys = animation.shape_index[order] if isinstance(paths, RigidPaths) else order
    mesh_of = np.array([place.get(int(key), -1) for key in keys], dtype=np.int64)
    order, mesh_of = order[mesh_of >= 0], mesh_of[mesh_of >= 0]
    if len(order) < len(animation.shape_index):
        hit = int(colliding.sum())
        left = int(colliding[order].sum())
        those = f"{left:,} of the {hit:,} that collide" if left < hit else f"all {hit:,} that collide"
        notes.append(
            f"{len(order):,} of {len(animation.shape_index):,} bodies are on this page"
            + (f", {those} among them." if hit else ".")
        )
    by_mesh = np.lexsort((~colliding[order], mesh_of))
    return _Drawn(order[by_mesh], mesh_of[by_mesh], pieces)


_NONE = np.zeros(0, dtype=np.int64)


def _touching_vertices(animation: Animation, marks: Marks) -> dict[int, np.ndarray]:
    """Vertices of the faces and vertices that touch, by number of mesh or, of deforming bodies, of body."""
    found: dict[int, list[np.ndarray]] = {}
    for side in range(2):
        is_face, is_vertex = marks.kind == 1 - side, marks.kind == side  # VF_AB is 0, VF_BA 1
        is_face |= marks.kind == 4 - side  # EF_AB is 3, EF_BA 4
        is_vertex |= (marks.kind == 5) & (marks.features[:, side] >= 0)  # INSIDE
        for row in np.flatnonzero(is_face | is_vertex):
            body, feature = int(marks.bodies[row, side]), int(marks.features[row, side])
            shape = int(animation.shape_index[body])
            name = shape if isinstance(animation.paths, RigidPaths) else body
            of_face = animation.shapes[shape].corners(feature) if is_face[row] else np.array([feature])
            found.setdefault(name, []).append(of_face.astype(np.int64))
    return {name: np.unique(np.concatenate(vertices)) for name, vertices in found.items()}


def _between_drawn(animation: Animation, marks: Marks, drawn: _Drawn, notes: list[str]) -> Marks:
    """The contacts whose two bodies are drawn, with rows of the drawn bodies."""
    place = np.full(len(animation.shape_index), -1)
    place[drawn.rows] = np.arange(len(drawn.rows))
    bodies = place[marks.bodies]
    shown = (bodies >= 0).all(axis=1)
    if not shown.all():
        notes.append(f"{int((~shown).sum()):,} contacts of bodies that are not are left out.")
    marks = marks[shown]
    marks.bodies = bodies[shown]
    return marks


def _frame(animation: Animation, drawn: _Drawn) -> tuple[np.ndarray, float]:
    """Centre (3,) and half the diagonal of a box around all bodies, world frame."""
    paths, boxes = animation.paths, [np.zeros((0, 3))]
    if isinstance(paths, RigidPaths):
        # Of the boxes of meshes at the ends and in the middle of segments.
        for number, (vertices, _) in enumerate(drawn.meshes):
            rows = drawn.rows[drawn.mesh_of == number]
            low, high = (vertices.min(axis=0), vertices.max(axis=0)) if len(vertices) else np.zeros((2, 3))
            corners = np.stack(np.meshgrid(*np.stack([low, high], axis=1)), axis=-1).reshape(-1, 3)
            for time in (0.0, 0.5, 1.0):
                boxes.append(placed(corners, *poses_at(paths, slice(None), time, rows)).reshape(-1, 3))
    else:
        boxes += [vertices.reshape(-1, 3) for vertices, _ in drawn.meshes]
    if animation.box is not None:
        boxes.append(animation.box)
    points = np.concatenate(boxes)
    if len(points) == 0:
        return np.zeros(3), 1.0
    bottom, top = points.min(axis=0), points.max(axis=0)
    return 0.5 * (bottom + top), float(np.linalg.norm(0.5 * (top - bottom))) or 1.0


def _rigid(paths: RigidPaths, drawn: _Drawn, centre: np.ndarray, scale: float) -> dict[str, Any]:
    start, end = (paths.start - centre) / scale, (paths.end - centre) / scale
    columns = [start, paths.orientation, end - start, paths.rotation]
    rows = np.concatenate([column[:, drawn.rows] for column in columns], axis=2)
    kinds = []
    for number, (vertices, faces) in enumerate(drawn.meshes):
        members = drawn.mesh_of == number
        kind = {"count": int(members.sum()), "paths": encoded(rows[:, members], np.float32)}
        kinds.append(kind | _mesh(vertices / scale, faces))
    return {"kinds": kinds, "linear": paths.is_linear}


def _deforming(paths: VertexPaths, drawn: _Drawn, centre: np.ndarray, scale: float) -> dict[str, Any]:
    pieces = [drawn.meshes[number] for number in drawn.mesh_of]
    counts = [vertices.shape[1] for vertices, _ in pieces]
    begin = np.cumsum([0, *counts])[:-1]
    vertices = np.concatenate([vertices for vertices, _ in pieces], axis=1)
    faces = np.concatenate([first + faces for first, (_, faces) in zip(begin, pieces, strict=True)])
    made = _mesh((vertices - centre) / scale, faces)
    return made | {"vertex_counts": encoded(counts, np.uint32), "ends": paths.ends.tolist()}


def _mesh(vertices: np.ndarray, faces: np.ndarray) -> dict[str, Any]:
    dtype = np.uint16 if vertices.shape[-2] <= 1 << 16 else np.uint32
    return {
        "vertices": encoded(vertices, np.float32),
        "faces": encoded(faces, dtype),
        "index_bytes": np.dtype(dtype).itemsize,
    }


def _step_bytes(animation: Animation) -> int:
    """Bytes of a body in a segment, besides its path."""
    return (1 if animation.segment_count > 1 else 0) + (4 if animation.fraction is not None else 0)


def _body_columns(animation: Animation, marks: Marks, drawn: _Drawn, scale: float) -> dict[str, Any]:
    """The columns of bodies; `marks` are contacts by row of the bodies drawn."""
    rows = drawn.rows
    # The radius about the centre of the bounding box, of deforming bodies at the first waypoint.
    radii = []
    for vertices, _ in drawn.meshes:
        at_start = vertices if vertices.ndim == 2 else vertices[0]
        size = np.ptp(at_start, axis=0) if len(at_start) else np.zeros(3)
        radii.append(0.5 * float(np.linalg.norm(size)))
    radius = np.array(radii)[drawn.mesh_of] if radii else np.zeros(0)
    colliding = animation.colliding[rows]
    faint = faint_bodies(marks, animation.static[rows], radius)
    state = STATIC * animation.static[rows] + COLLIDING * colliding + FAINT * (faint & colliding)
    columns: dict[str, Any] = {
        "count": len(rows),
        "of": len(animation.shape_index),
        "id": encoded(animation.ids[rows], np.uint32),
        "state": encoded(state, np.uint8),
        "radius": encoded(radius / scale, np.float32),
    }
    if animation.segment_count > 1:
        columns["hit"] = encoded(animation.hit[:, rows], np.uint8)
    if animation.fraction is not None:
        columns["fraction"] = encoded(animation.fraction[:, rows], np.float32)
    if animation.world is not None:
        columns["world"] = encoded(animation.world[rows], np.int32)
        columns["worlds"] = np.unique(animation.world[rows])[:_MOST_CHOICES].tolist()
    if animation.margin is not None:
        columns["margin"] = encoded(animation.margin[rows] / scale, np.float32)
    return columns


def _contact_columns(marks: Marks, waypoints: np.ndarray, centre: np.ndarray, scale: float) -> dict[str, Any]:
    return {
        "count": len(marks),
        "bodies": encoded(marks.bodies, np.int32),
        "segment": encoded(marks.segment, np.int32),
        "toi": encoded(marks.toi, np.float64),
        "place": encoded((marks.point - centre) / scale, np.float32),
        "point": encoded(marks.point, np.float64),
        "normal": encoded(marks.normal, np.float32),
        "kind": encoded(marks.kind, np.int8),
        "features": encoded(marks.features, np.int32),
        "unresolved": encoded(marks.unresolved, np.uint8),
    }


def encoded(values: Any, dtype: Any) -> str:
    """The bytes of an array as base64."""
    return base64.b64encode(np.ascontiguousarray(values, dtype=dtype).tobytes()).decode("ascii")
