"""Orientations and rigid poses, at scales from 1e-6 to 1e6."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from hypothesis import strategies as st

ROOT_HALF = 0.5**0.5
# Identity, quarter and half turns about axes, and their negatives, which are the same orientations.
SPECIAL = [
    (1.0, 0.0, 0.0, 0.0),
    (-1.0, 0.0, 0.0, 0.0),
    (0.0, 1.0, 0.0, 0.0),
    (0.0, 0.0, 0.0, -1.0),
    (ROOT_HALF, 0.0, ROOT_HALF, 0.0),
    (-ROOT_HALF, 0.0, 0.0, ROOT_HALF),
]


@dataclass(frozen=True)
class Pose:
    """position (3,), orientation (4,) as (w, x, y, z)."""

    position: np.ndarray
    orientation: np.ndarray


@dataclass(frozen=True)
class PoseMotion:
    """Both ends of a step, and the rotation vector (3,) in the world frame from the first to the second."""

    start: Pose
    end: Pose
    rotation: np.ndarray


@st.composite
def unit_quaternions(draw: st.DrawFn) -> np.ndarray:
    """Quaternion (4,) float64 of unit length up to rounding; special ones included."""
    if draw(st.booleans()):
        return np.array(draw(st.sampled_from(SPECIAL)))
    q = np.array(draw(st.tuples(*[st.floats(-1.0, 1.0)] * 4).filter(lambda c: sum(x * x for x in c) > 0.01)))
    return q / np.linalg.norm(q)


def _vectors(size: float) -> st.SearchStrategy[np.ndarray]:
    return st.tuples(*[st.floats(-size, size, allow_subnormal=False)] * 3).map(np.array)


def scales() -> st.SearchStrategy[float]:
    """Powers of ten from 1e-6 to 1e6."""
    return st.integers(-6, 6).map(lambda k: 10.0**k)


@st.composite
def poses(draw: st.DrawFn, scale: float | None = None) -> Pose:
    """A pose whose position is of the order of `scale` (any of `scales()` when not given)."""
    size = draw(scales()) if scale is None else scale
    return Pose(draw(_vectors(size)), draw(unit_quaternions()))


def product(p: np.ndarray, q: np.ndarray) -> np.ndarray:
    """Quaternion product p q, (4,) each."""
    w, v = p[0], p[1:]
    return np.concatenate([[w * q[0] - v @ q[1:]], w * q[1:] + q[0] * v + np.cross(v, q[1:])])


@st.composite
def pose_motions(
    draw: st.DrawFn, scale: float | None = None, travel: float | None = None, most_turn: float = 3.0
) -> PoseMotion:
    """A step from a pose at `scale`, by up to `travel` (default: the scale), turning by less than `most_turn` about
    each axis.
    """
    size = draw(scales()) if scale is None else scale
    start = draw(poses(size))
    rotation = draw(st.sampled_from([0.0, 1e-9, 0.1, 1.0])) * draw(_vectors(most_turn))
    angle = float(np.linalg.norm(rotation))
    axis = rotation / angle if angle > 0 else np.zeros(3)
    turn = np.concatenate([[np.cos(angle / 2)], np.sin(angle / 2) * axis])
    q = product(turn, start.orientation)
    end = Pose(start.position + draw(_vectors(size if travel is None else travel)), q / np.linalg.norm(q))
    return PoseMotion(start, end, rotation)
