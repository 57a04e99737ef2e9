"""Rigorous branch and bound over time: when two primitives on smooth paths come within a separation, and how close.

Of each of the four points the path is known by enclosures of x(m), x'(m), x''(m) and by a bound J >= |x'''| on [0, 1].
By Taylor's theorem x(m + s) = x + s x' + s^2 x'' / 2 + r with |r| <= J |s|^3 / 6. Along a fixed direction n the
distance of two convex sets is at least the least gap between a point of each, over |n|. The direction, here n + s n',
is approximated in floats: any direction gives a valid bound. Undecided intervals are split. All bounds are rounded
outward (`interval`).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from .distance import closest_coordinates, gap_vector
from .filters import FIRST, SECOND
from .interval import Interval, cross, dot, norm, up

Taylor = tuple[Interval, Interval, Interval]
NO, YES, CLOSE = 0, 1, 2
NAMES = ("no", "yes", "too close to call")
_AT_ONCE = 600
MOST_INTERVALS = 256  # kept per query, the earliest ones; a query that needs more can no longer be answered "no"


class Paths(Protocol):
    """n queries, each with four moving points in one frame (any, as long as all four share it)."""

    jerk: np.ndarray  # (n, 4): J
    is_face: bool

    def derivatives(self, query: np.ndarray, t: np.ndarray) -> tuple[Interval, Interval, Interval]:
        """Enclosures (k, 4, 3) of x, x', x'' of queries (k,) at exactly the times (k,)."""
        ...


@dataclass(frozen=True)
class Decisions:
    """Per query (n,): status NO, YES or CLOSE, and a bracket of the first time within the separation.

    Before `toi_lower` the primitives certainly stay apart; by `toi_upper` they certainly have come within the
    separation (inf unless YES). For NO both are inf.
    """

    status: np.ndarray
    toi_lower: np.ndarray
    toi_upper: np.ndarray

    def name(self, query: int) -> str:
        """'yes', 'no' or 'too close to call'."""
        return NAMES[int(self.status[query])]


def _guessed_directions(points: np.ndarray, is_face: bool) -> list[np.ndarray]:
    p, q, r, s = (points[:, k] for k in range(4))
    with np.errstate(all="ignore"):
        between = gap_vector(points, closest_coordinates(points, is_face), is_face)
        normal = np.cross(r - q, s - q) if is_face else np.cross(q - p, s - r)
        normal = np.where((normal * between).sum(axis=1, keepdims=True) < 0, -normal, normal)
        scaled = [d / np.linalg.norm(d, axis=1, keepdims=True) for d in (between, normal)]
    return [np.where(np.isfinite(d), d, 0.0) for d in scaled]


def _turning_directions(taylor: Taylor, half: np.ndarray, is_face: bool) -> list[tuple[np.ndarray, np.ndarray]]:
    # n(s) = n + s n' through the best directions at both ends, so that it follows a rotating face. (With a fixed one
    # the bound would be off by h |n'| times the size of the face, and some sqrt(1 / h) intervals would stay open.)
    x, v, c = (y.middle() for y in taylor)
    h = half[:, None, None]
    ends = [_guessed_directions(x + e * h * v + 0.5 * h * h * c, is_face) for e in (-1.0, 1.0)]
    found = []
    for back, ahead in zip(*ends, strict=True):
        with np.errstate(all="ignore"):
            ahead = np.where((back * ahead).sum(axis=1, keepdims=True) < 0, -ahead, ahead)
            found.append((0.5 * (ahead + back), (ahead - back) / (2.0 * half[:, None])))
    return found


def lower_bound(taylor: Taylor, jerk: np.ndarray, half: np.ndarray, is_face: bool) -> np.ndarray:
    """(k,): proven lower bound of the distance over [m - half, m + half]; negative if nothing is proven."""
    x, v, c = taylor
    best = np.full(len(half), -1.0)
    h = Interval(half)
    first, second = FIRST[is_face], SECOND[is_face]
    rest = (Interval(jerk[:, first].max(axis=1)) + jerk[:, second].max(axis=1)) * h * h.square() * up(np.array(1 / 6))
    for direction, turn in _turning_directions(taylor, half, is_face):
        n, m = direction[:, None], turn[:, None]
        # Coefficients (k, 4) of n(s) . x(s) in s, then their differences (k, first, second).
        powers = [dot(x, n), dot(v, n) + dot(x, m), dot(c, n) * 0.5 + dot(v, m), dot(c, m) * 0.5]
        g, g1, g2, g3 = (p[:, second][:, None, :] - p[:, first][:, :, None] for p in powers)
        e = h[:, None, None]
        change = e * g1.magnitude() + e.square() * np.maximum(-g2.lo, 0.0) + e * e.square() * g3.magnitude()
        gap = (g - change).lo.min(axis=(1, 2))
        # upper bound of |n(s)|^2, n and n' being nearly perpendicular
        along = dot(Interval(direction), turn).magnitude()
        square = norm(Interval(direction)).square() + h * along * 2.0 + (h * norm(Interval(turn))).square()
        proven = (Interval(gap) / square.sqrt() - rest).lo
        # A negative gap over |n| is only ever used as "nothing proven".
        best = np.where((gap > 0) & np.isfinite(proven), np.maximum(best, proven), best)
    return best


def swept_box(taylor: Taylor, jerk: np.ndarray, half: np.ndarray) -> Interval:
    """(k, p, 3): boxes that contain the paths of points over [m - half, m + half]; jerk (k, p)."""
    x, v, c = taylor
    h = Interval(half)[:, None, None]
    rest = (Interval(jerk)[:, :, None] * h * h.square() * up(np.array(1 / 6))).hi
    bend = Interval(np.zeros_like(h.hi), (h.square() * 0.5).hi)
    return x + v * Interval(-h.hi, h.hi) + c * bend + Interval(-rest, rest)


def upper_bound(x: Interval, is_face: bool) -> np.ndarray:
    """(k,): proven upper bound of the distance at the time of x: that of two points of the primitives."""
    coordinates = closest_coordinates(0.5 * (x.lo + x.hi), is_face)
    return norm(gap_vector(x, Interval(coordinates), is_face)).hi


def _volume(x: Interval, is_face: bool) -> Interval:
    p, q, r, s = (x[:, k] for k in range(4))
    return dot(p - q, cross(r - q, s - q)) if is_face else dot(r - p, cross(q - p, s - r))


def _crosses(paths: Paths, query: np.ndarray, a: np.ndarray, b: np.ndarray, taylor: Taylor) -> np.ndarray:
    """(k,) bool: certain that the primitives touch at some time in [a, b].

    The volume of the four points has certain and opposite signs at a and b, so it vanishes between (it is
    continuous); and all over [a, b] the inside conditions hold strictly, so that wherever it vanishes the primitives
    touch.
    """
    ends = [_volume(paths.derivatives(query, t)[0], paths.is_face) for t in (a, b)]
    opposite = ((ends[0].hi < 0) & (ends[1].lo > 0)) | ((ends[0].lo > 0) & (ends[1].hi < 0))
    box = swept_box(taylor, paths.jerk[query], _midpoints(a, b)[1])
    p, q, r, s = (box[:, k] for k in range(4))
    if paths.is_face:
        n = cross(r - q, s - q)
        sides = [dot(cross(f - e, p - e), n) for e, f in ((q, r), (r, s), (s, q))]
    else:
        n = cross(q - p, s - r)
        sides = [dot(cross(s - r, p - r), n), -dot(cross(s - r, q - r), n)]
        sides += [-dot(cross(q - p, r - p), n), dot(cross(q - p, s - p), n)]
    return opposite & np.all([side.lo > 0 for side in sides], axis=0)


def _midpoints(a: np.ndarray, b: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    middle = 0.5 * (a + b)
    return middle, up(np.maximum(b - middle, middle - a))


def _split(
    query: np.ndarray, a: np.ndarray, b: np.ndarray, levels: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray, int]:
    """Halves intervals, few ones several times, at most `levels` times, since numpy takes as long for few as for some
    hundred; and says how often.
    """
    times = 1
    while times < min(levels, 4) and len(query) << (times + 1) <= _AT_ONCE:
        times += 1
    for _ in range(times):
        # Not in the middle: a touch at t = 1/2, for example, would always be at an end, where no sign is certain.
        at = a + 0.4765 * (b - a)
        query, a, b = np.repeat(query, 2), np.stack([a, at], axis=1).ravel(), np.stack([at, b], axis=1).ravel()
    return query, a, b, times


def _rank(query: np.ndarray) -> np.ndarray:
    # Index of each entry among those of the same query; entries of a query are adjacent.
    start = np.flatnonzero(np.diff(query, prepend=-1))
    return np.arange(len(query)) - np.repeat(start, np.diff(start, append=len(query)))


def first_within(paths: Paths, separation: float, width: float = 1e-9, levels: int = 48) -> Decisions:
    """Decides every query, and brackets the first time to `width` where rounding allows it."""
    count = len(paths.jerk)
    status = np.full(count, CLOSE)
    lower, upper = np.zeros(count), np.full(count, np.inf)
    cut_at = np.full(count, np.inf)  # start of the first interval that was dropped without an answer
    settled = np.zeros(count, dtype=bool)  # and so removed from the list
    query, a, b = np.arange(count), np.zeros(count), np.ones(count)
    level = 0
    while True:
        middle, half = _midpoints(a, b)
        taylor = paths.derivatives(query, middle)
        keep = ~(lower_bound(taylor, paths.jerk[query], half, paths.is_face) > separation)
        query, a, b, middle = query[keep], a[keep], b[keep], middle[keep]
        taylor = taylor[0][keep], taylor[1][keep], taylor[2][keep]
        certain = upper_bound(taylor[0], paths.is_face) <= separation
        np.minimum.at(upper, query[certain], middle[certain])
        if separation == 0.0:
            certain = _crosses(paths, query, a, b, taylor)
            np.minimum.at(upper, query[certain], b[certain])
        keep = a < upper[query]
        query, a, b = query[keep], a[keep], b[keep]
        excess = _rank(query) >= MOST_INTERVALS
        np.minimum.at(cut_at, query[excess], a[excess])
        query, a, b = query[~excess], a[~excess], b[~excess]
        earliest = cut_at.copy()
        np.minimum.at(earliest, query, a)
        lower = np.where(settled, lower, np.minimum(earliest, upper))
        status[np.isfinite(upper)] = YES
        status[~settled & np.isinf(upper) & np.isinf(earliest)] = NO
        settled |= (upper <= lower + width) | ~np.isin(np.arange(count), query)
        keep = ~settled[query]
        query, a, b = query[keep], a[keep], b[keep]
        if not len(query) or level == levels:
            break
        query, a, b, times = _split(query, a, b, levels - level)
        level += times
    return Decisions(status, np.where(status == NO, np.inf, lower), upper)


def least_distance(
    paths: Paths, t_from: float = 0.0, t_to: float = 1.0, width: float = 1e-10, levels: int = 48
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(lower, upper, time), each (n,): bracket of the least distance over [t_from, t_to], and a time with <= upper.

    `width`, the intended width of the bracket, is relative to the largest coordinate of the query in its own frame.
    """
    count = len(paths.jerk)
    best, at = np.full(count, np.inf), np.full(count, t_from)
    query, a, b = np.arange(count), np.full(count, float(t_from)), np.full(count, float(t_to))
    scale = np.zeros(count)
    for t in (a, b):
        x = paths.derivatives(query, t)[0]
        value = upper_bound(x, paths.is_face)
        best, at = np.minimum(best, value), np.where(value < best, t, at)
        scale = np.maximum(scale, x.magnitude().max(axis=(1, 2)))
    goal = max(width, 2.0**-46) * scale  # rounding allows no better
    lower, settled = np.zeros(count), np.zeros(count, dtype=bool)
    dropped = np.full(count, np.inf)  # least bound of the intervals dropped for their number
    level = 0
    while True:
        middle, half = _midpoints(a, b)
        taylor = paths.derivatives(query, middle)
        bound = np.maximum(lower_bound(taylor, paths.jerk[query], half, paths.is_face), 0.0)
        value = upper_bound(taylor[0], paths.is_face)
        order = np.argsort(-value, kind="stable")  # the smallest value of a query is written last
        better = order[value[order] < best[query[order]]]
        best[query[better]], at[query[better]] = value[better], middle[better]
        # Discarded bounds were above the earlier `best`, hence above the present one.
        least = np.minimum(best, dropped)
        np.minimum.at(least, query, bound)
        lower = np.where(settled, lower, np.maximum(lower, least))
        settled |= best <= lower + goal
        keep = (bound < best[query]) & ~settled[query]
        query, a, b, bound = query[keep], a[keep], b[keep], bound[keep]
        if not len(query) or level == levels:
            break
        order = np.lexsort((bound, query))
        excess = order[_rank(query[order]) >= MOST_INTERVALS]
        np.minimum.at(dropped, query[excess], bound[excess])
        query, a, b = (np.delete(y, excess) for y in (query, a, b))
        query, a, b, times = _split(query, a, b, levels - level)
        level += times
    return lower, best, at
