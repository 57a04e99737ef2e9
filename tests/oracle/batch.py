"""Rigorous answers for very many queries at once: when two primitives first come within a separation.

The same kind of branch and bound over time as `search`, in plain float64 with error bounds added at the end instead of
outward-rounded operations, some fifty times as fast. Undecided queries are marked CLOSE, for the exact oracle. Over an
interval the four paths are parabolas (`batch_paths`) plus a remainder.

* Apart: n(s) is a direction that turns linearly, from a good one at the start of the interval to a good one at its
  end. The gap between a point of each primitive along n(s) is a cubic in s, nowhere below the least of its Bernstein
  coefficients, and |n(s)| is nowhere above the larger of its values at the ends.
* Within a separation: two points of the primitives are, at an end of the interval.
* Touching: the volume of the four points has certain and opposite signs at the ends, and all over the interval the
  inside conditions hold for certain: wherever the volume vanishes, the primitives touch.
"""

from __future__ import annotations

from fractions import Fraction

import numpy as np

from . import linear
from . import separation as separated
from .batch_paths import Paths, StraightPaths, U, Window, first_count
from .search import CLOSE, NO, YES, Decisions

CHUNK = 8192
MOST_INTERVALS = 48  # more open intervals: the query is left undecided
WIDE = 2.0**-20  # a wider bracket of the first touch is left to the exact oracle


def _dot(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def _cross(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return np.stack([a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]])


def _length(a: np.ndarray) -> np.ndarray:
    return np.sqrt(_dot(a, a))


def _foot(p: np.ndarray, a: np.ndarray, b: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    # From p to the nearest point of the segment a b; its squared length; and its part perpendicular to the segment if
    # the point is inside, which stays perpendicular however short it is.
    e = b - a
    square = _dot(e, e)
    s = _dot(p - a, e) / square
    s = np.minimum(np.maximum(np.where(s == s, s, 0.0), 0.0), 1.0)
    away = (a - p) + s * e
    upright = away - (_dot(away, e) / square) * e
    return away, _dot(away, away), np.where((s > 0) & (s < 1), upright, away)


def _normal(x: np.ndarray, is_face: bool) -> np.ndarray:
    p, q, r, s = x
    return _cross(r - q, s - q) if is_face else _cross(q - p, s - r)


def nearest(x: np.ndarray, is_face: bool) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(3, k) each, for points (4, 3, k): the gap from the first primitive to the second near their nearest points,
    which always connects two of their points; a direction close to it; and their common normal, oriented likewise.
    """
    p, q, r, s = x
    with np.errstate(all="ignore"):
        normal = _normal(x, is_face)
        square = _dot(normal, normal)
        if is_face:
            segments = ((p, q, r, 1.0), (p, r, s, 1.0), (p, s, q, 1.0))
            e, f, g = r - q, s - q, p - q
            u, v = _dot(_cross(g, f), normal) / square, _dot(_cross(e, g), normal) / square
            inside = (u > 0) & (v > 0) & (u + v < 1)
            between = (q - p) + u * e + v * f
        else:
            segments = ((p, r, s, 1.0), (q, r, s, 1.0), (r, p, q, -1.0), (s, p, q, -1.0))
            e, f, g = q - p, s - r, r - p
            u, v = _dot(_cross(g, f), normal) / square, _dot(_cross(g, e), normal) / square
            inside = (u > 0) & (u < 1) & (v > 0) & (v < 1)
            between = g + v * f - u * e
        gap, towards, least = between, between, np.where(inside, _dot(between, between), np.inf)
        for point, a, b, sign in segments:
            away, squared, upright = _foot(point, a, b)
            closer = squared < least
            least = np.where(closer, squared, least)
            gap, towards = np.where(closer, sign * away, gap), np.where(closer, sign * upright, towards)
    return gap, towards, np.where(_dot(normal, gap) < 0, -normal, normal)


def apart_by(w: Window, directions: list[tuple[np.ndarray, np.ndarray]], is_face: bool) -> np.ndarray:
    """(k,): proven lower bound of the distance over the window, minus infinity if nothing is proven; by pairs of
    directions (3, k) at the start and at the end.
    """
    best = np.full(w.rounding.shape, -np.inf)
    count = first_count(is_face)
    c = w.control
    for pair in directions:
        n = []
        for d in pair:
            with np.errstate(over="ignore"):
                length = _length(d)
            usable = (length > 1e-100) & (length < 1e100)  # otherwise the square may overflow or underflow
            n.append(np.where(usable, d, 0.0) / np.where(usable, length, 1.0))
        n[1] = np.where(_dot(n[0], n[1]) < 0, -n[1], n[1])
        # (control, point, k) along each end's direction
        g, h = (c[:, :, 0] * d[0] + c[:, :, 1] * d[1] + c[:, :, 2] * d[2] for d in n)
        cubic = np.stack([g[0], (2.0 * g[1] + h[0]) / 3.0, (g[2] + 2.0 * h[1]) / 3.0, h[2]])
        gap = (cubic[:, count:].min(axis=1) - cubic[:, :count].max(axis=1)).min(axis=0)
        # Unit vectors up to 4 u; errors of two points.
        proven = (gap - 2.0 * w.rounding) * (1 - 16 * U) - w.rest.sum(axis=0) * (1 + 16 * U)
        best = np.where(gap > 0, np.maximum(best, proven), best)
    return best


def _spread(a: np.ndarray, b: np.ndarray, da: np.ndarray, db: np.ndarray) -> np.ndarray:
    # |a' x b' - fl(a x b)| at most, for |a' - a| <= da and |b' - b| <= db.
    la, lb = _length(a), _length(b)
    return (da * lb + la * db + da * db + 8 * U * la * lb) * (1 + 64 * U)


def changes_side(w: Window, is_face: bool) -> np.ndarray:
    """(k,) bool: certain that the four points' volume has opposite signs at the two ends of the window."""
    noise = 2.0 * (w.rounding + w.rest.max(axis=0))  # of a difference of two points
    signs = []
    for p, q, r, s in (w.control[0], w.control[2]):
        a, b, away = (r - q, s - q, q - p) if is_face else (q - p, s - r, r - p)
        normal, spread = _cross(a, b), _spread(a, b, noise, noise)
        length = _length(away)
        error = (length + noise) * spread + _length(normal) * (noise + 8 * U * length)
        volume = _dot(away, normal)
        signs.append(np.where(np.abs(volume) > error * (1 + 64 * U), np.sign(volume), 0.0))
    return signs[0] * signs[1] < 0


def stays_inside(w: Window, is_face: bool) -> np.ndarray:
    """(k,) bool: certain that all over the window, wherever the volume vanishes, the primitives touch."""
    c = w.control
    # The path of each point stays in the hull of its control points, this far from the middle one.
    strays = np.maximum(*(np.sqrt(((x - c[1]) ** 2).sum(axis=1)) for x in (c[0], c[2])))
    strays = (strays + w.rounding + w.rest.max(axis=0)) * (1 + 64 * U)
    p, q, r, s = zip(c[1], strays, strict=True)

    def side(a: tuple, b: tuple, o: tuple) -> tuple[np.ndarray, np.ndarray]:  # (a - o) x (b - o), and its spread
        e, f = a[0] - o[0], b[0] - o[0]
        return _cross(e, f), _spread(e, f, a[1] + o[1], b[1] + o[1])

    if is_face:
        normal, turned = side(r, s, q)
        sides = [side(r, p, q), side(s, p, r), side(q, p, s)]
    else:
        e, f = q[0] - p[0], s[0] - r[0]
        normal, turned = _cross(e, f), _spread(e, f, q[1] + p[1], s[1] + r[1])
        sides = [side(s, p, r), side(q, s, r), side(r, q, p), side(q, s, p)]
    length = _length(normal)
    certain = np.ones(len(length), dtype=bool)
    for area, off in sides:
        size = _length(area)
        spread = size * turned + off * (length + turned) + 8 * U * size * length
        certain &= _dot(area, normal) > spread * (1 + 64 * U)
    return certain


def _look(paths: Paths, query: np.ndarray, a: np.ndarray, b: np.ndarray, separation: np.ndarray) -> list[np.ndarray]:
    """For each interval: whether it is proven free, by when (a, b or never) it is proven within, and two cut points."""
    is_face = paths.is_face
    w = paths.over(query, a, b)
    keep = separation[query]
    (start, *before), (end, *after) = (nearest(w.control[k], is_face) for k in (0, 2))
    free = apart_by(w, list(zip(before, after, strict=True)), is_face) > keep
    slack = 2.0 * w.rounding + w.rest.sum(axis=0)
    gaps = [_length(start), _length(end)]
    within = [(gap + slack) * (1 + 16 * U) <= keep for gap in gaps]
    by = np.where(within[0], a, np.where(within[1], b, np.inf))
    rows = np.flatnonzero((keep == 0) & ~free)
    for certain in (changes_side, stays_inside):
        part = Window(w.control[..., rows], w.rest[:, rows], w.rounding[rows])
        rows = rows[certain(part, is_face)]
    by[rows] = np.minimum(by[rows], b[rows])
    # If it is known to come within, a narrow interval about the likely time; else not exactly the middle: a touch at t
    # = 1/2, for example, would always be at an end, where no sign is certain.
    share = gaps[0] - keep
    rest = np.where(keep > 0, keep - gaps[1], gaps[1])
    with np.errstate(all="ignore"):
        at = share / (share + rest)
    known = np.isfinite(by) & (at > 0.05) & (at < 0.95)
    cuts = [np.where(known, at + d, 0.4765) for d in (-0.03, 0.03)]
    return [free, by, a + cuts[0] * (b - a), a + cuts[1] * (b - a)]


def _rank(query: np.ndarray) -> np.ndarray:
    # Index of each entry among those of the same query; entries of a query are adjacent.
    start = np.flatnonzero(np.diff(query, prepend=-1))
    return np.arange(len(query)) - np.repeat(start, np.diff(start, append=len(query)))


def first_within(
    paths: Paths,
    separation: np.ndarray | float = 0.0,
    until: np.ndarray | float = 1.0,
    width: float = 2.0**-36,
    levels: int = 44,
) -> Decisions:
    """Decides every query over [0, until], and brackets the first time to `width` where rounding allows it."""
    count = len(paths)
    keep = np.broadcast_to(np.asarray(separation, dtype=np.float64), count) * paths.scale
    status = np.full(count, CLOSE)
    lower, upper = np.zeros(count), np.full(count, np.inf)
    query, a = np.arange(count), np.zeros(count)
    b = np.broadcast_to(np.asarray(until, dtype=np.float64), count).copy()
    settled = np.zeros(count, dtype=bool)
    for _ in range(levels):
        parts = [
            _look(paths, query[k : k + CHUNK], a[k : k + CHUNK], b[k : k + CHUNK], keep)
            for k in range(0, len(query), CHUNK)
        ]
        free, by, cut, after = (np.concatenate(column) for column in zip(*parts, strict=True))
        np.minimum.at(upper, query, by)
        open_ = ~free & (a < upper[query])
        query, a, b, cut, after = (x[open_] for x in (query, a, b, cut, after))
        earliest = np.full(count, np.inf)
        np.minimum.at(earliest, query, a)
        lower = np.where(settled, lower, np.minimum(earliest, upper))
        status[np.isfinite(upper)] = YES
        status[~settled & np.isinf(lower)] = NO
        settled |= (upper <= lower + width) | np.isinf(lower)
        # Undecided: too many open intervals, or one without a double inside.
        settled[query[(_rank(query) >= MOST_INTERVALS) | (cut <= a) | (cut >= b)]] = True
        stay = ~settled[query]
        query, a, b, cut, after = (x[stay] for x in (query, a, b, cut, after))
        if not len(query):
            break
        # [a, cut], [cut, after] and [after, b], without the second where it is empty.
        query = np.repeat(query, 3)
        a, b = np.stack([a, cut, after], axis=1).ravel(), np.stack([cut, after, b], axis=1).ravel()
        some = a < b
        query, a, b = query[some], a[some], b[some]
    return Decisions(status, np.where(status == NO, np.inf, lower), upper)


def distance_at(paths: Paths, t: np.ndarray) -> np.ndarray:
    """(n,): proven upper bound of the distance at times t (n,), in the given units."""
    found = np.empty(len(paths))
    for k in range(0, len(paths), CHUNK):
        query = np.arange(k, min(k + CHUNK, len(paths)))
        w = paths.over(query, t[query], t[query])
        gap = _length(nearest(w.control[1], paths.is_face)[0])
        found[query] = (gap + 2.0 * w.rounding) * (1 + 16 * U)
    return found / paths.scale


def decide_straight(
    start: np.ndarray, end: np.ndarray, is_face: bool, separation: float = 0.0
) -> tuple[Decisions, np.ndarray]:
    """Every query on straight paths, points (n, 4, 3) at both ends, exactly; and which (n,) needed the exact oracle."""
    found = first_within(StraightPaths(start, end, is_face), separation)
    with np.errstate(invalid="ignore"):
        asked = (found.status == CLOSE) | ((found.status == YES) & (found.toi_upper - found.toi_lower > WIDE))
    for k in np.flatnonzero(asked):
        if separation:
            hit = separated.within_many(start[k : k + 1], end[k : k + 1], separation, is_face)[0]
        else:
            hit = (linear.vertex_face if is_face else linear.edge_edge)(start[k], end[k])
        found.status[k] = NO if hit is None else YES
        found.toi_lower[k] = np.inf if hit is None else -_not_below(-hit.toi_lower)
        found.toi_upper[k] = np.inf if hit is None else _not_below(hit.toi_upper)
    return found, asked


def _not_below(x: Fraction) -> float:
    near = float(x)
    return near if Fraction(near) >= x else float(np.nextafter(near, np.inf))
