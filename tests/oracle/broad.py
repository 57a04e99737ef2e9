"""Exact broad phase: every pair of moving spheres (centre on a straight line, radius fixed) that comes within reach."""

from __future__ import annotations

from fractions import Fraction

import numpy as np
from numpy.typing import ArrayLike

U = 2.0**-53
TINY = 1e-200


def spheres_meet(
    centers_t0: ArrayLike, centers_t1: ArrayLike, radius_first: float, radius_second: float, separation: float = 0.0
) -> bool:
    """Exactly: do two spheres, centres (2, 3) at both ends, come within `separation` at some t in [0, 1] (touching
    counts)?
    """
    start, end = np.asarray(centers_t0, dtype=np.float64).tolist(), np.asarray(centers_t1, dtype=np.float64).tolist()
    w0 = [Fraction(b) - Fraction(a) for a, b in zip(*start, strict=True)]
    step = [Fraction(b) - Fraction(a) - w for a, b, w in zip(*end, w0, strict=True)]
    reach = Fraction(float(radius_first)) + Fraction(float(radius_second)) + Fraction(float(separation))
    # |w0 + t step|^2 = a t^2 + 2 b t + c
    a = sum((s * s for s in step), Fraction(0))
    b = sum((w * s for w, s in zip(w0, step, strict=True)), Fraction(0))
    c = sum((w * w for w in w0), Fraction(0))
    square = reach * reach
    if c <= square or a + 2 * b + c <= square:
        return True
    return 0 < -b < a and a * c - b * b <= square * a  # minimum c - b^2 / a inside the step


def sphere_pairs(
    centers_t0: ArrayLike,
    centers_t1: ArrayLike,
    radius: ArrayLike,
    separation: float = 0.0,
    group: ArrayLike | None = None,
    mask: ArrayLike | None = None,
    world: ArrayLike | None = None,
    static: ArrayLike | None = None,
) -> np.ndarray:
    """(k, 2) int64, i < j, in lexicographic order: all allowed pairs that come within the sum of radii + separation.

    centers (n, 3), radius (n,); group, mask, world (n,) integers, static (n,) bool. A pair is allowed iff
    group_i & mask_j and group_j & mask_i, the worlds are the same, and not both are static.
    """
    start = np.asarray(centers_t0, dtype=np.float64).reshape(-1, 3)
    end = np.asarray(centers_t1, dtype=np.float64).reshape(-1, 3)
    size = np.asarray(radius, dtype=np.float64).reshape(-1)
    count = len(start)
    if len(end) != count or len(size) != count:
        raise ValueError("centres at both ends and radii must be equally many")
    # Boxes rounded outward: two roundings on each side, and the whole separation on one sphere of each pair.
    lower = np.nextafter(np.minimum(start, end) - size[:, None], -np.inf)
    upper = np.nextafter(np.maximum(start, end) + size[:, None], np.inf)
    reach_lower = np.nextafter(lower - separation, -np.inf)
    reach_upper = np.nextafter(upper + separation, np.inf)
    found = []
    rows = max(1, 4_000_000 // max(count, 1))
    for first in range(0, count, rows):
        i = np.arange(first, min(first + rows, count))
        near = np.arange(count)[None, :] > i[:, None]
        for axis in range(3):
            near &= lower[i, None, axis] <= reach_upper[None, :, axis]
            near &= upper[i, None, axis] >= reach_lower[None, :, axis]
        a, b = np.nonzero(near)
        found.append(np.stack([a + first, b], axis=1))
    pairs = np.concatenate(found) if found else np.zeros((0, 2), dtype=np.int64)
    pairs = pairs[_allowed(pairs, group, mask, world, static)]
    inside, outside = _decide_in_floats(start, end, size, separation, pairs)
    for k in np.flatnonzero(~(inside | outside)):
        i, j = pairs[k]
        inside[k] = spheres_meet(start[[i, j]], end[[i, j]], size[i], size[j], separation)
    return pairs[inside].astype(np.int64)


def _allowed(
    pairs: np.ndarray,
    group: ArrayLike | None,
    mask: ArrayLike | None,
    world: ArrayLike | None,
    static: ArrayLike | None,
) -> np.ndarray:
    i, j = pairs[:, 0], pairs[:, 1]
    allowed = np.ones(len(pairs), dtype=bool)
    if (group is None) != (mask is None):
        raise ValueError("group and mask go together")
    if group is not None and mask is not None:
        g, m = np.asarray(group), np.asarray(mask)
        allowed &= ((g[i] & m[j]) != 0) & ((g[j] & m[i]) != 0)
    if world is not None:
        allowed &= np.asarray(world)[i] == np.asarray(world)[j]
    if static is not None:
        allowed &= ~(np.asarray(static, dtype=bool)[i] & np.asarray(static, dtype=bool)[j])
    return allowed


def _decide_in_floats(
    start: np.ndarray, end: np.ndarray, size: np.ndarray, separation: float, pairs: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """(certainly inside, certainly outside) per pair; neither if rounding could matter.

    At any time s in [0, 1] the relative centre w(s) = (1 - s) w0 + s w1 gives |w(s)| >= the least distance, and along
    any direction n the least distance is >= min(n.w0, n.w1) / |n|. The best s and n = w(s) are approximated in floats.
    """
    i, j = pairs[:, 0], pairs[:, 1]
    with np.errstate(all="ignore"):
        w0, w1 = start[j] - start[i], end[j] - end[i]
        step = w1 - w0
        s = np.clip(-(w0 * step).sum(axis=1) / (step * step).sum(axis=1), 0.0, 1.0)
        s = np.where(np.isfinite(s), s, 0.0)[:, None]
        n = (1 - s) * w0 + s * w1
        # Each component of n is off by at most 4 u (|w0| + |w1|), each norm by 4 u of itself and each sum of radii by
        # 2 u.
        slack = 16 * U * (np.linalg.norm(w0, axis=1) + np.linalg.norm(w1, axis=1)) + TINY
        reach = size[i] + size[j] + separation
        norm = np.linalg.norm(n, axis=1)
        inside = norm + slack < reach * (1 - 16 * U)
        along = np.minimum((n * w0).sum(axis=1), (n * w1).sum(axis=1))
        outside = along - slack * norm > reach * norm * (1 + 16 * U) + TINY
        safe = (np.maximum(np.abs(w0).max(axis=1), np.abs(w1).max(axis=1)) < 1e60) & (norm > 1e-60)
    return inside & safe, outside & safe
