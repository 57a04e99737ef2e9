"""Bodies at one time as a PNG file."""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from pgccd.viz.animation import Animation
from pgccd.viz.moment import COLOURS, colours_at_first, first_moment, vertices_at
from pgccd.viz.raster import Camera, Canvas

_PIXELS = 1600, 1200
# Drawn at twice the size, for smooth edges.
_FINER = 2
_BACKGROUND = 0.957, 0.965, 0.976
# From the scene to the camera: where a page looks from at first.
_BACK = np.array([np.cos(0.42) * np.cos(-1.07), np.cos(0.42) * np.sin(-1.07), np.sin(0.42)])
_MARK, _FIRST_MARK = (0.65, 0.08, 0.20), (0.05, 0.05, 0.08)
# Length of an arrow at the target, relative to the height of the picture. A mark is drawn at this part of its distance
# from the camera, in the same size, so that no body is in front of it.
_ARROW, _NEARER = 0.09, 0.1
_TRIANGLES_AT_ONCE = 1_000_000
# Part of white in marks behind a surface; radius of the hole before a hidden contact, and what is left in front of the
# contact, relative to the height of the picture.
_PALE, _WINDOW, _LEFT = 0.5, 0.16, 0.002
# Surfaces this near to a contact, relative to its distance from the camera, touch there and hide nothing.
_NEAR = 1e-3


def write_png(path: Path, animation: Animation) -> Path:
    """Writes all bodies at the time of the first contact, or at the start if there is none, and the contacts of that
    time: points, and normals as arrows. The bodies of the first contact have two colours. Marks of contacts behind a
    surface are pale. Bodies that hide the first contact are cut open, unless only one of its two bodies hides it, from
    outside.
    """
    segment, time, at_time = first_moment(animation)
    bodies = vertices_at(animation, segment, time)
    corners = [np.stack([body.min(axis=0), body.max(axis=0)]) for body in bodies if len(body)] or [np.zeros((1, 3))]
    camera = _camera(np.concatenate(corners), bodies)
    distance = float(np.linalg.norm(camera.eye - camera.target))
    is_hidden = [_surfaces_before(animation, bodies, camera, animation.marks.point[row]).any() for row in at_time]
    window = None
    if len(at_time) and _is_enclosed(animation, bodies, camera, at_time[0]):
        column, row, depth = camera.project(animation.marks.point[at_time[0]])
        # In front of the contact a little of the bodies that touch is left.
        window = column, row, _WINDOW * camera.pixels[1], depth - _LEFT * camera.height
    canvas = Canvas(camera, _BACKGROUND, (0.5 * _NEARER * distance, 2.0 * distance), window)
    paints = COLOURS[colours_at_first(animation)]
    for vertices, faces, body in _joined(animation, bodies):
        both_sides = np.concatenate([faces, faces[:, ::-1]])
        canvas.draw(vertices, both_sides, paints[np.tile(body, 2)])
    canvas.window = None
    for number in reversed(range(len(at_time))):
        row = at_time[number]
        vertices, faces = _arrow(animation.marks.point[row], animation.marks.normal[row], _ARROW * camera.height)
        nearer = camera.eye + _NEARER * (vertices - camera.eye)
        colour = np.array(_MARK if number else _FIRST_MARK)
        if is_hidden[number] and not (number == 0 and window):
            colour = _PALE + (1.0 - _PALE) * colour
        canvas.draw(nearer, faces, np.tile(colour, (len(faces), 1)))
    width, height = _PIXELS
    image = canvas.image().reshape(height, _FINER, width, _FINER, 3).mean(axis=(1, 3))
    path.write_bytes(_png(np.round(255.0 * image).astype(np.uint8)))
    return path


def _surfaces_before(animation: Animation, bodies: list[np.ndarray], camera: Camera, point: np.ndarray) -> np.ndarray:
    """(N,): how many surfaces of each body are between a point and the camera."""
    ray, count = camera.eye - point, np.zeros(len(bodies), dtype=np.int64)
    for vertices, faces, body in _joined(animation, bodies):
        # Moeller & Trumbore 1997.
        a, b, c = np.moveaxis(vertices[faces], 1, 0)
        across = np.cross(ray, c - a)
        area = np.einsum("ij,ij->i", b - a, across)
        some = np.where(area == 0.0, 1.0, area)
        u = np.einsum("ij,ij->i", point - a, across) / some
        other = np.cross(point - a, b - a)
        v = other @ ray / some
        time = np.einsum("ij,ij->i", c - a, other) / some
        meets = (area != 0.0) & (u >= 0.0) & (v >= 0.0) & (u + v <= 1.0) & (time > _NEAR) & (time < 1.0)
        count += np.bincount(body[meets], minlength=len(bodies))
    return count


def _is_enclosed(animation: Animation, bodies: list[np.ndarray], camera: Camera, row: int) -> bool:
    """Whether a contact is behind a third body, or inside one of its two bodies, where the other one is."""
    point, (i, j) = animation.marks.point[row], animation.marks.bodies[row]
    count = _surfaces_before(animation, bodies, camera, point)
    count[[i, j]] = 0
    for outer, inner in ((i, j), (j, i)):
        if _is_closed(animation.shapes[animation.shape_index[outer]].faces):
            furthest = bodies[inner][np.argmax(((bodies[inner] - point) ** 2).sum(axis=1))]
            count[outer] = _surfaces_before(animation, bodies, camera, furthest)[outer] % 2
    return bool(count.any())


def _is_closed(faces: np.ndarray) -> bool:
    """Whether each edge belongs to two faces."""
    edges = np.sort(np.concatenate([faces[:, :2], faces[:, 1:], faces[:, ::2]]), axis=1)
    return bool((np.unique(edges, axis=0, return_counts=True)[1] == 2).all())


def _camera(corners: np.ndarray, bodies: list[np.ndarray]) -> Camera:
    """A camera that sees all bodies, whose bounding boxes have these corners (C, 3)."""
    low, high = corners.min(axis=0), corners.max(axis=0)
    target, radius = 0.5 * (low + high), float(np.linalg.norm(0.5 * (high - low))) or 1.0
    pixels = _FINER * _PIXELS[0], _FINER * _PIXELS[1]
    camera = Camera(target + 3.0 * radius * _BACK, target, 2.0 * radius, pixels)
    # In the picture the bodies take less room than their ball: the camera moves sideways, and the picture shrinks.
    right, up, _ = camera.axes
    flat = [camera.project(body)[:, :2] for body in bodies if len(body)]
    if flat:
        first = np.min([points.min(axis=0) for points in flat], axis=0)  # column and row
        last = np.max([points.max(axis=0) for points in flat], axis=0)
        unit = camera.height / pixels[1]
        column, row = 0.5 * (first + last) - 0.5 * np.array(pixels)
        target = target + unit * (column * right - row * up)
        size = last - first
        camera = Camera(
            target + 3.0 * radius * _BACK,
            target,
            1.1 * unit * max(size[1], size[0] * pixels[1] / pixels[0], 1.0),
            pixels,
        )
    return camera


def _joined(animation: Animation, bodies: list[np.ndarray]) -> Iterator[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """Vertices (V, 3), faces (T, 3) and the body row (T,) of each face, of many bodies at a time."""
    begin, triangles = 0, 0
    for end, shape in enumerate(animation.shape_index.tolist(), 1):
        triangles += len(animation.shapes[shape].faces)
        if triangles >= _TRIANGLES_AT_ONCE or end == len(bodies):
            rows = range(begin, end)
            of_rows = [animation.shapes[animation.shape_index[row]].faces for row in rows]
            first = np.cumsum([0, *(len(bodies[row]) for row in rows)])
            faces = [k + faces for k, faces in zip(first, of_rows, strict=False)]
            body = np.repeat(np.arange(begin, end), [len(faces) for faces in of_rows])
            yield np.concatenate(bodies[begin:end]), np.concatenate(faces), body
            begin, triangles = end, 0


def _arrow(point: np.ndarray, normal: np.ndarray, length: float) -> tuple[np.ndarray, np.ndarray]:
    """Vertices and faces of a ball at a point and, unless the normal is zero, an arrow along it."""
    axis = normal if normal.any() else np.array([0.0, 0.0, 1.0])
    across = np.cross(axis, np.eye(3)[int(np.argmin(np.abs(axis)))])
    across = across / np.linalg.norm(across)
    frame = np.stack([across, np.cross(axis, across), axis])
    angles = np.linspace(0.0, 2.0 * np.pi, 24, endpoint=False)
    polar = np.linspace(np.pi, 0.0, 9)
    profiles = [[(0.13 * np.sin(angle), 0.13 * np.cos(angle)) for angle in polar]]
    if normal.any():
        profiles.append([(0.0, 0.0), (0.035, 0.0), (0.035, 0.7), (0.1, 0.7), (0.0, 1.0)])
    vertices: list[np.ndarray] = []
    faces: list[np.ndarray] = []
    for profile in profiles:
        first, ring = sum(len(rings) for rings in vertices), np.arange(24)
        radius, height = np.array(profile).T
        rings = np.stack(
            np.broadcast_arrays(radius[:, None] * np.cos(angles), radius[:, None] * np.sin(angles), height[:, None]),
            axis=-1,
        )
        vertices.append(rings.reshape(-1, 3))
        for level in range(len(profile) - 1):
            a, b = first + 24 * level + ring, first + 24 * level + (ring + 1) % 24
            faces += [np.stack([a, b, b + 24], axis=1), np.stack([a, b + 24, a + 24], axis=1)]
    return point + length * np.concatenate(vertices) @ frame, np.concatenate(faces)


def _png(image: np.ndarray) -> bytes:
    """The file of an image (height, width, 3) uint8: see RFC 2083."""

    def chunk(name: bytes, content: bytes) -> bytes:
        return struct.pack(">I", len(content)) + name + content + struct.pack(">I", zlib.crc32(name + content))

    height, width, _ = image.shape
    rows = np.concatenate([np.zeros((height, 1), np.uint8), image.reshape(height, -1)], axis=1)  # 0: no filter
    header = struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    parts = chunk(b"IHDR", header), chunk(b"IDAT", zlib.compress(rows.tobytes(), 6)), chunk(b"IEND", b"")
    return b"\x89PNG\r\n\x1a\n" + b"".join(parts)
