"""Rigorous decisions for vertices, faces and edges of rigid bodies that move on arcs.

Path of a point with body coordinates r: x(t) = p0 + t (p1 - p0) + exp(t [w]x) R(q0) r over t in [0, 1], with a rotation
vector w in the world frame and q0 = (w, x, y, z) normalised. Everything is enclosed in outward-rounded intervals.
"""

from __future__ import annotations

from dataclasses import dataclass
from fractions import Fraction
from typing import Any

import mpmath
import numpy as np
from numpy.typing import ArrayLike

from .interval import Interval, cross, norm, sinc_cosc
from .search import Decisions, first_within, least_distance


@dataclass(frozen=True)
class BodyMotion:
    """One pose path, or n: position (…, 3) at both ends, orientation (…, 4) at t0, rotation vector (…, 3), world
    frame.
    """

    position_t0: np.ndarray
    orientation_t0: np.ndarray
    position_t1: np.ndarray
    rotation: Interval

    @staticmethod
    def from_rotation(p0: ArrayLike, q0: ArrayLike, p1: ArrayLike, rotation: ArrayLike) -> BodyMotion:
        """With the rotation vector itself (exactly these doubles), so that more than half a turn is possible."""
        arrays = [np.asarray(x, dtype=np.float64) for x in (p0, q0, p1, rotation)]
        return BodyMotion(arrays[0], arrays[1], arrays[2], Interval(arrays[3]))

    @staticmethod
    def from_orientations(p0: ArrayLike, q0: ArrayLike, p1: ArrayLike, q1: ArrayLike) -> BodyMotion:
        """The shorter rotation from one orientation to the other, with an enclosed exact rotation vector."""
        a, b = np.asarray(q0, dtype=np.float64), np.asarray(q1, dtype=np.float64)
        return BodyMotion(np.asarray(p0, dtype=np.float64), a, np.asarray(p1, dtype=np.float64), rotation_between(a, b))


def rotation_between(q0: np.ndarray, q1: np.ndarray) -> Interval:
    """(…, 3): rotation vector w, |w| <= pi, with exp([w]x) R(q0) = R(q1); quaternions (…, 4), normalised here.

    At exactly half a turn both ways are equally short; then the scalar part of q1 q0* is zero and the sign of its
    vector part, as given, is taken.
    """
    a, b = np.broadcast_arrays(q0, q1)
    flat = [_rotation_vector(x, y) for x, y in zip(a.reshape(-1, 4).tolist(), b.reshape(-1, 4).tolist(), strict=True)]
    bounds = np.array(flat, dtype=np.float64).reshape(*a.shape[:-1], 3, 2)
    return Interval(bounds[..., 0], bounds[..., 1])


def _rotation_vector(q0: list[float], q1: list[float]) -> list[tuple[float, float]]:
    # Products of doubles of like scale are exact at this precision, so the sign of the scalar part is too.
    with mpmath.workprec(400):
        w0, x0, y0, z0 = (mpmath.mpf(c) for c in q0)
        w1, x1, y1, z1 = (mpmath.mpf(c) for c in q1)
        scalar = w1 * w0 + x1 * x0 + y1 * y0 + z1 * z0  # of q1 conj(q0)
        vector = [
            -w1 * x0 + x1 * w0 - y1 * z0 + z1 * y0,
            -w1 * y0 + x1 * z0 + y1 * w0 - z1 * x0,
            -w1 * z0 - x1 * y0 + y1 * x0 + z1 * w0,
        ]
        if scalar < 0:
            scalar, vector = -scalar, [-c for c in vector]
        length = mpmath.sqrt(sum(c * c for c in vector))
        factor = 2 * mpmath.atan2(length, scalar) / length if length else mpmath.mpf(0)
        # Accurate to some hundred digits beyond a double, so the neighbours of the rounded value enclose it.
        values = [float(c * factor) for c in vector]
    return [(float(np.nextafter(c, -np.inf)), float(np.nextafter(c, np.inf))) if c else (0.0, 0.0) for c in values]


def rotate(q: np.ndarray, r: Interval) -> Interval:
    """R(q / |q|) r, enclosed: r + 2 / |q|^2 (s (u x r) + u x (u x r)) with q = (s, u)."""
    quaternion = Interval(q)
    s, u = quaternion[..., 0], quaternion[..., 1:]
    size = s.square() + u[..., 0].square() + u[..., 1].square() + u[..., 2].square()
    once = cross(u, r)
    return r + (once * s[..., None] + cross(u, once)) * 2.0 / size[..., None]


def turn(arm: Interval, spin: Interval, t: Interval) -> tuple[Interval, Interval, Interval]:
    """exp(t [w]x) arm and its first two derivatives; arm, spin = w (…, 3), t (…).

    Rodrigues: exp(t [w]x) r = r + t sinc(t |w|) w x r + t^2 cosc(t |w|) w x (w x r).
    """
    sinc, cosc = sinc_cosc(norm(spin) * t)
    once = cross(spin, arm)
    turned = arm + once * (sinc * t)[..., None] + cross(spin, once) * (cosc * t.square())[..., None]
    rate = cross(spin, turned)
    return turned, rate, cross(spin, rate)


def jerk_bound(arm: Interval, spin: Interval) -> np.ndarray:
    """(…): |x'''| = |w|^2 |w x x| at all times, since the rotation about w keeps the angle to w."""
    return (norm(spin).square() * norm(cross(spin, arm))).hi


class RigidPaths:
    """Four points (n, 4, 3) each, the first ones in the body frame of A and the rest in that of B, in world axes
    relative to the moving origin of A, which preserves precision far from the world's origin.
    """

    def __init__(self, points: np.ndarray, first: BodyMotion, second: BodyMotion, is_face: bool) -> None:
        self.is_face = is_face
        of_first = np.array([True, not is_face, False, False])[:, None]

        def choose(a: Any, b: Any) -> Interval:  # (n, 4, …) from the value of each body, (…) or (n, …)
            a, b = Interval.of(a), Interval.of(b)
            bounds = [np.where(of_first, x[..., None, :], y[..., None, :]) for x, y in ((a.lo, b.lo), (a.hi, b.hi))]
            return Interval(*(np.broadcast_to(x, (len(points), 4, x.shape[-1])) for x in bounds))

        self.spin = choose(first.rotation, second.rotation)
        orientation = choose(first.orientation_t0, second.orientation_t0).lo
        self.arm = rotate(orientation, Interval(points))
        offset, step = relative_path(first, second)
        self.offset, self.step = choose(np.zeros(3), offset), choose(np.zeros(3), step)
        self.jerk = jerk_bound(self.arm, self.spin)

    def derivatives(self, query: np.ndarray, t: np.ndarray) -> tuple[Interval, Interval, Interval]:
        """Enclosures (k, 4, 3) of positions, velocities and accelerations of queries (k,) at the times (k,)."""
        time = Interval(t)[:, None]
        turned, rate, bend = turn(self.arm[query], self.spin[query], time)
        step = self.step[query]
        return self.offset[query] + step * time[..., None] + turned, step + rate, bend


def relative_path(first: BodyMotion, second: BodyMotion) -> tuple[Interval, Interval]:
    """Origin of the second body relative to that of the first: at t = 0, and its straight displacement until t = 1."""
    offset = Interval(second.position_t0) - first.position_t0
    return offset, (Interval(second.position_t1) - first.position_t1) - offset


def vertex_face(
    points: np.ndarray, first: BodyMotion, second: BodyMotion, separation: float = 0.0, width: float = 1e-9
) -> Decisions:
    """Points (n, 4, 3) in the order v, f0, f1, f2: v in the frame of `first`, the face in that of `second`.

    Each motion is one for all or (n, …). With separation 0, "yes" needs a transversal crossing; touches without one
    (grazing, resting, degenerate features) are "too close to call". Never wrong.
    """
    return first_within(RigidPaths(points, first, second, True), separation, width)


def edge_edge(
    points: np.ndarray, first: BodyMotion, second: BodyMotion, separation: float = 0.0, width: float = 1e-9
) -> Decisions:
    """Points (n, 4, 3) in the order ea0, ea1, eb0, eb1: edge a in the frame of `first`, b in that of `second`."""
    return first_within(RigidPaths(points, first, second, False), separation, width)


def closest_approach(
    points: np.ndarray,
    first: BodyMotion,
    second: BodyMotion,
    is_face: bool,
    t_from: float = 0.0,
    t_to: float = 1.0,
    width: float = 1e-10,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(lower, upper, time), each (n,): proven bracket of the least distance over [t_from, t_to].

    `width`, the intended width of the bracket, is relative to the largest coordinate relative to the origin of the
    first body.
    """
    return least_distance(RigidPaths(points, first, second, is_face), t_from, t_to, width)


def position(
    point: ArrayLike, p0: ArrayLike, q0: ArrayLike, p1: ArrayLike, rotation: ArrayLike, t: float, digits: int = 40
) -> list[mpmath.mpf]:
    """Position of one body point at one time to about `digits` digits, from the matrix exponential's own definition."""
    with mpmath.workdps(digits):
        w, x, y, z = (mpmath.mpf(float(c)) for c in np.asarray(q0))
        n = w * w + x * x + y * y + z * z
        turn = [
            [w * w + x * x - y * y - z * z, 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), w * w - x * x + y * y - z * z, 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), w * w - x * x - y * y + z * z],
        ]
        arm = [each / n for each in _times(turn, [mpmath.mpf(float(v)) for v in np.asarray(point)])]
        turned = _times(_exponential(np.asarray(rotation, dtype=np.float64).tolist(), float(t)), arm)
        ends = zip(np.asarray(p0).tolist(), np.asarray(p1).tolist(), strict=True)
        return [mpmath.mpf(s) + t * (mpmath.mpf(e) - mpmath.mpf(s)) + turned[k] for k, (s, e) in enumerate(ends)]


def _times(matrix: list[list[mpmath.mpf]], vector: list[mpmath.mpf]) -> list[mpmath.mpf]:
    return [a * vector[0] + b * vector[1] + c * vector[2] for a, b, c in matrix]


def _exponential(rotation: list[float], t: float) -> list[list[mpmath.mpf]]:
    """exp(t [w]x), to the working precision: the power series of a 2^-k part, squared k times. In integers, which are
    twenty times as fast as `mpmath.expm`.
    """
    exact = [Fraction(value) * Fraction(t) for value in rotation]
    squarings = max(0, int(max(map(abs, exact))).bit_length()) + 8
    bits = mpmath.mp.prec + squarings + 32  # each squaring doubles the error
    a, b, c = (int(value * 2 ** (bits - squarings)) for value in exact)
    one = 1 << bits
    result = term = [one, 0, 0, 0, one, 0, 0, 0, one]
    for k in range(1, bits):
        term = [each // k for each in _product(term, [0, -c, b, c, 0, -a, -b, a, 0], bits)]
        if not any(term):
            break
        result = [x + y for x, y in zip(result, term, strict=True)]
    for _ in range(squarings):
        result = _product(result, result, bits)
    scaled = [mpmath.ldexp(mpmath.mpf(each), -bits) for each in result]
    return [scaled[:3], scaled[3:6], scaled[6:]]


def _product(x: list[int], y: list[int], bits: int) -> list[int]:
    """Of 3 x 3 matrices of integers that stand for their 2^-bits part."""
    a, b, c, d, e, f, g, h, i = y
    rows = (x[0:3], x[3:6], x[6:9])
    return [(p * u + q * v + r * w) >> bits for p, q, r in rows for u, v, w in ((a, d, g), (b, e, h), (c, f, i))]
