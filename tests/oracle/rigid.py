"""Rigorous decisions for vertices, faces and edges of rigid bodies that move on arcs.

Path of a point with body coordinates r: x(t) = p0 + t (p1 - p0) + exp(t [w]x) R(q0) r over t in [0, 1], with a rotation
vector w in the world frame and q0 = (w, x, y, z) normalised. Everything is enclosed in outward-rounded intervals.
"""

from __future__ import annotations

from dataclasses import dataclass
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
        """The shorter way from one orientation to the other, as the exact rotation vector enclosed."""
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
        # Good to some hundred digits beyond a double, so the neighbours of the rounded value enclose it.
        values = [float(c * factor) for c in vector]
    return [(float(np.nextafter(c, -np.inf)), float(np.nextafter(c, np.inf))) if c else (0.0, 0.0) for c in values]


def rotate(q: np.ndarray, r: Interval) -> Interval:
    """R(q / |q|) r, enclosed: r + 2 / |q|^2 (s (u x r) + u x (u x r)) with q = (s, u)."""
    quaternion = Interval(q)
    s, u = quaternion[..., 0], quaternion[..., 1:]
    size = s.square() + u[..., 0].square() + u[..., 1].square() + u[..., 2].square()
    once = cross(u, r)
    return r + (once * s[..., None] + cross(u, once)) * 2.0 / size[..., None]


class RigidPaths:
    """Four points (n, 4, 3) each, the first ones in the body frame of A and the others in that of B, in world axes
    relative to the moving origin of A, a frame in which nothing far from the world's origin loses digits."""

    def __init__(self, points: np.ndarray, first: BodyMotion, second: BodyMotion, is_face: bool) -> None:
        self.is_face = is_face
        count = len(points)
        owner = [first, second, second, second] if is_face else [first, first, second, second]

        def stack(of: Any) -> Interval:
            lo = [np.broadcast_to(of(body).lo, (count, of(body).lo.shape[-1])) for body in owner]
            hi = [np.broadcast_to(of(body).hi, (count, of(body).hi.shape[-1])) for body in owner]
            return Interval(np.stack(lo, axis=1), np.stack(hi, axis=1))

        self.spin = stack(lambda body: body.rotation)
        orientation = stack(lambda body: Interval(body.orientation_t0)).lo
        self.arm = rotate(orientation, Interval(np.asarray(points, dtype=np.float64)))
        origin, end = Interval(first.position_t0), Interval(first.position_t1)
        self.offset = stack(lambda body: Interval(body.position_t0) - origin)
        step = Interval(second.position_t1) - second.position_t0 - (end - origin)
        still = Interval(np.zeros(3))
        self.step = stack(lambda body: still if body is first else step)
        if first is second:
            raise ValueError("give each body its own motion")
        for k, body in enumerate(owner):  # the first body's own offset is exactly zero
            if body is first:
                self.offset.lo[:, k] = self.offset.hi[:, k] = 0.0
        self.angle = norm(self.spin)
        # |x'''| = |w|^2 |w x R r|, the same at all times: the turn about w keeps the angle to w.
        self.jerk = (self.angle.square() * norm(cross(self.spin, self.arm))).hi

    def derivatives(self, query: np.ndarray, t: np.ndarray) -> tuple[Interval, Interval, Interval]:
        """Enclosures (k, 4, 3) of positions, velocities and accelerations of queries (k,) at the times (k,)."""
        time = Interval(t)[:, None]
        spin, arm, step = self.spin[query], self.arm[query], self.step[query]
        sinc, cosc = sinc_cosc(self.angle[query] * time)
        once = cross(spin, arm)
        # Rodrigues: exp(t [w]x) r = r + t sinc(t |w|) w x r + t^2 cosc(t |w|) w x (w x r)
        turned = arm + once * (sinc * time)[..., None] + cross(spin, once) * (cosc * time.square())[..., None]
        rate = cross(spin, turned)
        return self.offset[query] + step * time[..., None] + turned, step + rate, cross(spin, rate)


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
    """(lower, upper, time), each (n,): proven bracket of the least distance over [t_from, t_to]."""
    return least_distance(RigidPaths(points, first, second, is_face), t_from, t_to, width)


def position(
    point: ArrayLike, p0: ArrayLike, q0: ArrayLike, p1: ArrayLike, rotation: ArrayLike, t: float, digits: int = 40
) -> list[mpmath.mpf]:
    """Position of one body point at one time to about `digits` digits, from the matrix exponential's own definition."""
    with mpmath.workdps(digits):
        w, x, y, z = (mpmath.mpf(float(c)) for c in np.asarray(q0))
        n = w * w + x * x + y * y + z * z
        turn = mpmath.matrix(
            [
                [w * w + x * x - y * y - z * z, 2 * (x * y - w * z), 2 * (x * z + w * y)],
                [2 * (x * y + w * z), w * w - x * x + y * y - z * z, 2 * (y * z - w * x)],
                [2 * (x * z - w * y), 2 * (y * z + w * x), w * w - x * x - y * y + z * z],
            ]
        )
        a, b, c = (mpmath.mpf(float(v)) * mpmath.mpf(t) for v in np.asarray(rotation))
        spin = mpmath.expm(mpmath.matrix([[0, -c, b], [c, 0, -a], [-b, a, 0]]))
        turned = spin * (turn / n) * mpmath.matrix([mpmath.mpf(float(v)) for v in np.asarray(point)])
        ends = zip(np.asarray(p0).tolist(), np.asarray(p1).tolist(), strict=True)
        return [mpmath.mpf(s) + t * (mpmath.mpf(e) - mpmath.mpf(s)) + turned[k] for k, (s, e) in enumerate(ends)]
