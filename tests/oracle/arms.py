"""Arms of boxes and balls by matrices, and gaps of their shapes: an oracle by sampling."""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass
from xml.sax.saxutils import quoteattr

import numpy as np

# Edges whose unit directions have a smaller cross product count as parallel: the axes of faces then suffice.
_PARALLEL = 1e-9

#: A function of frames and half edges, such as `gaps`.
Measure = Callable[[np.ndarray, np.ndarray, np.ndarray, np.ndarray], np.ndarray]


@dataclass(frozen=True)
class Part:
    """A joint and the link that it moves: a box with these half edges, or a ball; neither: a link without a shape."""

    kind: str  #: "revolute", "prismatic" or "fixed"
    xyz: Sequence[float]
    rpy: Sequence[float]
    axis: Sequence[float]
    half: Sequence[float] | None = None
    radius: float | None = None
    at: Sequence[float] = (0.0, 0.0, 0.0)  #: of the shape's centre in the link
    mimic: tuple[int, float, float] | None = None  #: joint, multiplier, offset
    parent: int | None = None  #: part; default the one before; -1: the base


@dataclass(frozen=True)
class Arm:
    """Parts on a base without a shape."""

    parts: Sequence[Part]
    limit: float = 3.0

    def urdf(self) -> str:
        """The description as a URDF file."""
        text = ['<robot name="arm"><link name="base"/>']
        for k, part in enumerate(self.parts):
            parent = k - 1 if part.parent is None else part.parent
            shape = ""
            if part.half is not None:
                shape = f"<box size={_words(2 * np.array(part.half))}/>"
            if part.radius is not None:
                shape = f'<sphere radius="{part.radius!r}"/>'
            if shape:
                shape = f"<collision><origin xyz={_words(part.at)}/><geometry>{shape}</geometry></collision>"
            mimic = ""
            if part.mimic:
                of, factor, offset = part.mimic
                mimic = f'<mimic joint="joint{of}" multiplier="{factor!r}" offset="{offset!r}"/>'
            text += [
                f'<link name="link{k}">{shape}</link><joint name="joint{k}" type="{part.kind}">',
                f'<parent link="{"base" if parent < 0 else f"link{parent}"}"/><child link="link{k}"/>',
                f"<origin xyz={_words(part.xyz)} rpy={_words(part.rpy)}/><axis xyz={_words(part.axis)}/>",
                f'<limit lower="{-self.limit}" upper="{self.limit}" effort="1" velocity="1"/>{mimic}</joint>',
            ]
        return "\n".join([*text, "</robot>"])

    @property
    def coordinates(self) -> list[int]:
        """The parts that a configuration has a value for."""
        return [k for k, part in enumerate(self.parts) if part.kind != "fixed" and part.mimic is None]

    def frames(self, q: np.ndarray) -> np.ndarray:
        """Configurations (K, J) -> frames of the links (K, parts, 4, 4)."""
        value = np.zeros((len(q), len(self.parts)))
        value[:, self.coordinates] = q
        found: list[np.ndarray] = []
        for k, part in enumerate(self.parts):
            if part.mimic:
                of, factor, offset = part.mimic
                value[:, k] = factor * value[:, of] + offset
            parent = k - 1 if part.parent is None else part.parent
            frame = np.eye(4) if parent < 0 else found[parent]
            axis = np.array(part.axis) / np.linalg.norm(part.axis)
            move = np.tile(np.eye(4), (len(q), 1, 1))
            if part.kind == "revolute":
                move[:, :3, :3] = turns(axis, value[:, k])
            elif part.kind == "prismatic":
                move[:, :3, 3] = value[:, k, None] * axis
            found.append(frame @ origin(part.xyz, part.rpy) @ move)
        return np.stack(found, axis=1)

    def shapes(self, q: np.ndarray) -> np.ndarray:
        """Configurations (K, J) -> frames of the shapes (K, parts, 4, 4)."""
        at = np.array([origin(part.at, (0.0, 0.0, 0.0)) for part in self.parts])
        return self.frames(q) @ at

    def sizes(self) -> tuple[np.ndarray, np.ndarray]:
        """Half edges (parts, 3) and radii (parts,): shapes are boxes thickened by a radius; nan without a shape."""
        half = [part.half or ((0.0,) * 3 if part.radius else (np.nan,) * 3) for part in self.parts]
        return np.array(half), np.array([part.radius or 0.0 for part in self.parts])


def _words(values: Sequence[float] | np.ndarray) -> str:
    return quoteattr(" ".join(repr(float(value)) for value in values))


def turns(axis: np.ndarray, angle: np.ndarray) -> np.ndarray:
    """Rotations (K, 3, 3) about a unit axis (3,) by angles (K,): Rodrigues' formula."""
    x, y, z = axis
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + np.sin(angle)[:, None, None] * cross + (1 - np.cos(angle))[:, None, None] * (cross @ cross)


def origin(xyz: Sequence[float], rpy: Sequence[float]) -> np.ndarray:
    """(4, 4) of a URDF origin: turned about x, then y, then z, all fixed."""
    frame = np.eye(4)
    r, p, y = (turns(axis, np.array([angle]))[0] for axis, angle in zip(np.eye(3), rpy, strict=True))
    frame[:3, :3], frame[:3, 3] = y @ p @ r, xyz
    return frame


def gaps(a: np.ndarray, half_a: np.ndarray, b: np.ndarray, half_b: np.ndarray) -> np.ndarray:
    """(K,): the largest distance along one of 15 axes by which a plane separates boxes, at most their distance;
    negative: they overlap. Of a point and a box, their distance where it is positive.

    Args:
        a, b: (K, 4, 4) frames of the centres.
        half_a, half_b: (3,) half edges; zeros: a point.
    """
    if not half_a.any():
        a, b, half_a, half_b = b, a, half_b, half_a
    if not half_b.any():
        local = np.einsum("kji,kj->ki", a[:, :3, :3], b[:, :3, 3] - a[:, :3, 3])
        outside = np.abs(local) - half_a
        away = np.linalg.norm(np.maximum(outside, 0.0), axis=1)
        return np.where(away > 0.0, away, outside.max(axis=1))
    axes_a, axes_b = (np.swapaxes(frame[:, :3, :3], 1, 2) for frame in (a, b))
    edges = np.cross(axes_a[:, :, None], axes_b[:, None]).reshape(-1, 9, 3)
    length = np.linalg.norm(edges, axis=2, keepdims=True)
    is_axis = np.concatenate([np.ones((len(a), 6), dtype=bool), length[..., 0] > _PARALLEL], axis=1)
    axes = np.concatenate([axes_a, axes_b, edges / np.maximum(length, _PARALLEL)], axis=1)
    distance = np.abs(np.einsum("kac,kc->ka", axes, b[:, :3, 3] - a[:, :3, 3]))
    reach_a = np.abs(np.einsum("kac,kmc->kam", axes, axes_a)) @ half_a
    reach_b = np.abs(np.einsum("kac,kmc->kam", axes, axes_b)) @ half_b
    return np.where(is_axis, distance - reach_a - reach_b, -np.inf).max(axis=1)


def distances(a: np.ndarray, half_a: np.ndarray, b: np.ndarray, half_b: np.ndarray) -> np.ndarray:
    """(K,): the distance of boxes or points, as for `gaps`; 0: they overlap. That of corners from the other box, or of
    edges of both.
    """
    overlap = gaps(a, half_a, b, half_b)
    if not half_a.any() or not half_b.any():
        return np.maximum(overlap, 0.0)
    signs = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])
    ends = np.array([(i, j) for i in range(8) for j in range(i) if (signs[i] != signs[j]).sum() == 1])
    corners_a, corners_b = (
        np.einsum("kij,cj->kci", frame[:, :3, :3], signs * half) + frame[:, None, :3, 3]
        for frame, half in ((a, half_a), (b, half_b))
    )
    least = np.full(len(a), np.inf)
    for corners, frame, half in ((corners_a, b, half_b), (corners_b, a, half_a)):
        local = np.einsum("kji,kcj->kci", frame[:, :3, :3], corners - frame[:, None, :3, 3])
        away = np.linalg.norm(np.maximum(np.abs(local) - half, 0.0), axis=2)
        least = np.minimum(least, away.min(axis=1))
    p, q = corners_a[:, ends[:, 0], None], corners_b[:, None, ends[:, 0]]
    u, v = corners_a[:, ends[:, 1], None] - p, corners_b[:, None, ends[:, 1]] - q

    def dot(x: np.ndarray, y: np.ndarray) -> np.ndarray:
        return (x * y).sum(axis=-1)

    w, uu, vv, uv = p - q, dot(u, u), dot(v, v), dot(u, v)
    det = uu * vv - uv * uv
    s = np.clip(
        np.where(det > 1e-12 * uu * vv, uv * dot(v, w) - vv * dot(u, w), 0.0) / np.maximum(det, 1e-300), 0.0, 1.0
    )
    t = np.clip((uv * s + dot(v, w)) / vv, 0.0, 1.0)
    s = np.clip((uv * t - dot(u, w)) / uu, 0.0, 1.0)
    between = np.linalg.norm(w + s[..., None] * u - t[..., None] * v, axis=-1)
    return np.where(overlap <= 0.0, 0.0, np.minimum(least, between.min(axis=(1, 2))))


def least_gaps(
    arm: Arm,
    q: np.ndarray,
    boxes: np.ndarray,
    half: np.ndarray,
    untested: set[tuple[int, int]],
    measure: Measure = gaps,
    still: Collection[int] = (),
) -> np.ndarray:
    """(K,): the least gap of links with each other and with boxes, in configurations (K, J).

    Args:
        boxes: (M, 4, 4) frames.
        half: (M, 3) half edges.
        untested: pairs of parts.
        measure: `gaps` or `distances`.
        still: parts that are not measured against boxes.
    """
    shapes, (sizes, radii) = arm.shapes(q), arm.sizes()
    solid = [k for k in range(len(arm.parts)) if not np.isnan(sizes[k]).any()]
    pairs = [
        (shapes[:, k], sizes[k], shapes[:, other], sizes[other], radii[k] + radii[other])
        for k in solid
        for other in solid
        if other > k and (k, other) not in untested
    ]
    pairs += [
        (shapes[:, k], sizes[k], np.broadcast_to(frame, shapes[:, k].shape), edges, radii[k])
        for k in solid
        if k not in still
        for frame, edges in zip(boxes, half, strict=True)
    ]
    least = np.full(len(q), np.inf)
    # Balls around the shapes: where they are further apart than a gap that has been found, the shapes are.
    at_least = [
        np.linalg.norm(a[:, :3, 3] - b[:, :3, 3], axis=1) - np.linalg.norm(half_a) - np.linalg.norm(half_b) - radius
        for a, half_a, b, half_b, radius in pairs
    ]
    for pair in np.argsort([bound.sum() for bound in at_least]):
        a, half_a, b, half_b, radius = pairs[pair]
        near = np.flatnonzero(at_least[pair] <= least)
        if len(near):
            least[near] = np.minimum(least[near], measure(a[near], half_a, b[near], half_b) - radius)
    return least
