"""Paths of very many queries at once, for `batch`: float64 with error bounds, arrays (point, axis, query).

Everything is scaled to about unit size by a power of two, query by query. Error model: u = 2^-53 for each of + - * /
and the square root; sine and cosine of numpy are taken to be within 4 units in the last place. Coordinates lie between
1e-60 and 1e60 or are zero, so that nothing overflows and underflow is covered by the bounds.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np

U = 2.0**-53


@dataclass(frozen=True)
class Window:
    """The four points of k queries over an interval of time each, middle and half width (k,).

    `control` (3, 4, 3, k): control points of a parabola in Bernstein form for each path. The true path of a point of
    the first (second) primitive deviates from it by at most `rest[0]` (`rest[1]`) (k,); `rounding` (k,) bounds the
    error of every computed control point, and that of its projection on a unit vector.
    """

    control: np.ndarray
    rest: np.ndarray
    rounding: np.ndarray


class Paths(Protocol):
    """n queries; all internal lengths are the given ones times `scale` (n,)."""

    is_face: bool
    scale: np.ndarray

    def __len__(self) -> int: ...

    def over(self, query: np.ndarray, a: np.ndarray, b: np.ndarray) -> Window:
        """Queries (k,) over [a, b] (k,)."""
        ...


def first_count(is_face: bool) -> int:
    """Number of the four points that belong to the first primitive."""
    return 1 if is_face else 2


def _inverse_power(size: np.ndarray) -> np.ndarray:
    # 2^-e with size in [2^(e-1), 2^e); 1 for 0
    return np.where(size > 0, np.ldexp(1.0, -np.frexp(size)[1]), 1.0)


def _norm(x: np.ndarray, axis: int) -> np.ndarray:
    return np.sqrt((x * x).sum(axis=axis))


class StraightPaths:
    """Points (n, 4, 3) on straight lines, relative to the second point as it moves along."""

    def __init__(self, points_t0: np.ndarray, points_t1: np.ndarray, is_face: bool) -> None:
        self.is_face = is_face
        # Differences of doubles: relative error u each.
        ends = [np.ascontiguousarray(np.moveaxis(x - x[:, 1:2], 0, 2)) for x in (points_t0, points_t1)]
        self.scale = _inverse_power(np.abs(ends).max(axis=(0, 1, 2), initial=0.0))
        self.start, self.end = (x * self.scale for x in ends)
        size = np.maximum(*(_norm(x, 1).max(axis=0) for x in (self.start, self.end)))
        # Interpolation: difference u, 1 - t, two products and a sum, 6 u per coordinate and so of the length. Its
        # projection: 3 products and 2 sums, and the few operations of `batch` on them: 16 u of the length.
        self.rounding = 32 * U * size

    def __len__(self) -> int:
        return self.start.shape[2]

    def over(self, query: np.ndarray, a: np.ndarray, b: np.ndarray) -> Window:
        """See Paths."""
        start, end = self.start[:, :, query], self.end[:, :, query]
        control = np.empty((3, *start.shape))
        control[0] = (1.0 - a) * start + a * end
        control[2] = (1.0 - b) * start + b * end
        control[1] = 0.5 * (control[0] + control[2])
        return Window(control, np.zeros((2, len(query))), self.rounding[query])


@dataclass(frozen=True)
class Turning:
    """n bodies over a step: position (n, 3) at both ends, unit-to-rounding orientation (n, 4) at t0, rotation vector
    (n, 3) of the step, world frame. The orientation is normalised, everything else is exact.
    """

    position_t0: np.ndarray
    orientation_t0: np.ndarray
    position_t1: np.ndarray
    rotation: np.ndarray


class ArcPaths:
    """Points (n, 4, 3) in the frames of two bodies that move rigidly, relative to the centre of the first.

    x(t) = offset + t step + along + cos(angle t) across + sin(angle t) (axis x across): the part of the arm along the
    axis of rotation is constant, the rest rotates.
    """

    def __init__(self, points: np.ndarray, first: Turning, second: Turning, is_face: bool) -> None:
        self.is_face = is_face
        count = first_count(is_face)
        offset = (second.position_t0 - first.position_t0).T
        step = (second.position_t1 - first.position_t1).T - offset
        along, across, side, angles = [], [], [], []
        for k in range(4):
            body = first if k < count else second
            angle = _norm(body.rotation, 1)
            with np.errstate(all="ignore"):
                axis = np.where(angle > 0, body.rotation.T / angle, 0.0)
            arm = _rotated(body.orientation_t0.T, points[:, k].T)
            parallel = axis * (axis * arm).sum(axis=0)
            along.append(parallel if k < count else parallel + offset)
            across.append(arm - parallel)
            side.append(np.cross(axis, across[-1], axis=0))
            angles.append(angle)
        still = np.zeros_like(step)
        self.angle = np.array(angles)[:, None]
        self.step = np.array([still if k < count else step for k in range(4)])
        parts = np.array([along, across, side])
        reach = np.abs(parts).max(axis=(0, 1, 2))
        self.scale = _inverse_power(np.maximum(reach, np.abs(offset + step).max(axis=0)))
        self.along, self.across, self.side = parts * self.scale
        self.step = self.step * self.scale
        self.radius = _norm(self.across, 1) * (1 + 64 * U)
        self.jerk = self.angle[:, 0] ** 3 * self.radius * (1 + 64 * U)
        arm = _norm(np.moveaxis(points, 0, 2), 1).max(axis=0) * self.scale
        # Quaternion product and norm 24 u of the arm per coordinate, axis 4 u, parts 16 u, sine and cosine 8 u and
        # their products, and the angle's own 8 u times the angle; then the interpolation and projection as on straight
        # lines.
        turned = self.angle.max(axis=0)[0]
        ways = [np.sqrt((x * x).sum(axis=0)) * self.scale for x in (offset, offset + step)]
        self.rounding = U * ((192 + 16 * turned) * arm + 64 * np.maximum(*ways))
        self.turned = turned

    def __len__(self) -> int:
        return self.step.shape[2]

    def over(self, query: np.ndarray, a: np.ndarray, b: np.ndarray) -> Window:
        """See Paths. The parabola is the Taylor polynomial in the middle; the remainder is bounded by the third
        derivative.
        """
        # A relative error u of these moves the points by u times their path, which the rounding covers.
        middle, half = 0.5 * (a + b), 0.5 * (b - a)
        angle, step = self.angle[:, :, query], self.step[:, :, query]
        across, side = self.across[:, :, query], self.side[:, :, query]
        sine, cosine = np.sin(angle * middle), np.cos(angle * middle)
        x = cosine * across + sine * side
        bend = (angle * half) ** 2 * x  # minus half^2 x''
        rate = half * step + (angle * half) * (cosine * side - sine * across)
        x += self.along[:, :, query] + middle * step
        control = np.stack([x - rate - 0.5 * bend, x + 0.5 * bend, x + rate - 0.5 * bend])
        rest = self.jerk[:, query] * half**3 * ((1 + 16 * U) / 6)
        count = first_count(self.is_face)
        both = np.stack([rest[:count].max(axis=0), rest[count:].max(axis=0)])
        return Window(control, both, self.rounding[query] * (1 + self.turned[query] * half) ** 2)


def _rotated(q: np.ndarray, r: np.ndarray) -> np.ndarray:
    """(3, n): R(q / |q|) r for quaternions (4, n) and vectors (3, n)."""
    s, u = q[0], q[1:]
    once = np.cross(u, r, axis=0)
    return r + (s * once + np.cross(u, once, axis=0)) * (2.0 / (q * q).sum(axis=0))
