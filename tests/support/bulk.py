"""Many elementary queries through the library and the batch oracle, compared in both directions."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field, fields, replace
from fractions import Fraction

import numpy as np
import torch
from oracle import batch, distance
from oracle.batch_paths import StraightPaths
from oracle.families import EXACT, KNOWN, UNKNOWN, Family, Maker
from oracle.search import CLOSE, NO, YES, Decisions

import pgccd
from support.elementary import solve

DIGITS = {torch.float64: 53, torch.float32: 24}
# Allowed error of the distance at a toi, in units of the size's ulp.
ROUNDING = {torch.float64: 256, torch.float32: 16}
QUERIES = 4096  # per call: one family, tolerance, separation and scale
EXACT_QUERIES = 64
# Fractions that the batch oracle may leave undecided where features touch over intervals or only just; 2 % elsewhere.
# One in 16 calls of "passing" has a tolerance, and so a clearance, below its rounding.
UNDECIDED = {
    "near boundary": 0.03,
    "passing": 0.08,
    "grid, coplanar": 0.9,
    "grid, parallel": 0.25,
    "grid, degenerate": 0.15,
}


@dataclass
class Tally:
    """Outcome counts of queries.

    `near`: reported without touching, because the distance falls below the tolerance. `undecided`: passed on by the
    batch oracle to the exact one, or (on arcs) left undecided.
    """

    queries: int = 0
    true: int = 0
    missed: int = 0
    late: int = 0
    invented: int = 0
    misplaced: int = 0
    near: int = 0
    unresolved: int = 0
    undecided: int = 0
    seconds: float = 0.0
    examples: list[str] = field(default_factory=list)

    def add(self, other: Tally) -> None:
        """Adds all counts; keeps five examples."""
        for column in fields(self):
            setattr(self, column.name, getattr(self, column.name) + getattr(other, column.name))
        del self.examples[5:]

    def share(self, column: str) -> float:
        """Fraction of the queries counted in this column."""
        return float(getattr(self, column)) / max(self.queries, 1)

    def complaints(self, name: str) -> list[str]:
        """Contract violations, unresolved queries, and an undecided fraction above the usual; `name`: the family's."""
        faults = {what: getattr(self, what) for what in ("missed", "late", "invented", "misplaced")}
        found = [f"{name}: {count} {what}" for what, count in faults.items() if count]
        if self.unresolved:
            found.append(f"{name}: {self.unresolved} unresolved")
        if self.share("undecided") > UNDECIDED.get(name, 0.02) and self.queries > 1000:
            found.append(f"{name}: {100 * self.share('undecided'):.2f} % undecided")
        return found + self.examples


@dataclass(frozen=True)
class Answers:
    """The library's (n,) status, (n,) toi and (n, 2) coordinates; the distance (n,) allowed at a touch, and the
    distance (n,) between the two points given by the coordinates.
    """

    status: np.ndarray
    toi: np.ndarray
    coordinates: np.ndarray
    allowed: np.ndarray
    named: np.ndarray


def conditioning(x: np.ndarray, is_face: bool) -> np.ndarray:
    """Shift (n,) of a common normal's foot per unit of relative rounding error; points (n, 4, 3) at one time.

    Length of the features over the sine of the angle that spans their plane. Zero for features without a plane.
    """
    p, q, r, s = (x[:, k] for k in range(4))
    a, b = (r - q, s - q) if is_face else (q - p, s - r)
    lengths = [np.linalg.norm(e, axis=1) for e in (a, b, np.cross(a, b))]
    with np.errstate(all="ignore"):
        found = np.maximum(lengths[0], lengths[1]) * (lengths[0] * lengths[1] / lengths[2])
    return np.where(np.isfinite(found), found, 0.0)


def compare(
    truth: Decisions,
    answers: Answers,
    paths: batch.Paths,
    at_toi: np.ndarray,
    name: str,
    is_near: Callable[[int], bool] = lambda row: False,
) -> Tally:
    """The contract of elementary tests, query by query; `at_toi` (n, 4, 3): points at the reported toi, rounded.

    `is_near` decides exactly whether a touch that the batch oracle left undecided is within the allowed distance.
    """
    status, toi, true = answers.status, answers.toi, truth.status == YES
    reported, touch = status != pgccd.Status.FREE, status == pgccd.Status.TOUCH
    sensible = np.where(reported, (toi >= 0) & (toi <= 1), toi == np.inf)
    u, v = answers.coordinates.T
    on = (u >= 0) & (v >= 0) & ((u + v if paths.is_face else np.maximum(u, v)) <= 1 + 1e-6)
    too_far = touch & ~(batch.distance_at(paths, np.where(touch, toi, 0.0)) <= answers.allowed)
    too_far[too_far] = [not is_near(int(row)) for row in np.flatnonzero(too_far)]
    gap = np.linalg.norm(distance.gap_vector(at_toi, answers.coordinates, paths.is_face), axis=1)
    faults = {
        "missed": true & ~reported,
        "late": (true & reported & (toi > truth.toi_upper)) | ~sensible,
        "invented": too_far,
        "misplaced": touch & ~(on & (gap <= answers.named)),
    }
    examples = [
        f"{name}, row {k}: {what}; status {status[k]}, toi {toi[k].hex()}; {truth.name(int(k))}, first touch within "
        f"[{truth.toi_lower[k].hex()}, {truth.toi_upper[k].hex()}]"
        for what, rows in faults.items()
        for k in np.flatnonzero(rows)[:2]
    ]
    return Tally(
        queries=len(status),
        true=int(true.sum()),
        near=int((reported & (truth.status == NO)).sum()),
        unresolved=int((status == pgccd.Status.UNRESOLVED).sum()),
        examples=examples,
        **{what: int(rows.sum()) for what, rows in faults.items()},
    )


def _known(family: Family) -> Decisions:
    return Decisions(np.where(np.isinf(family.toi), NO, np.where(family.toi >= 0, YES, CLOSE)), family.toi, family.toi)


def check_straight(
    family: Family, is_face: bool, tolerance: float, dtype: torch.dtype, device: torch.device | str, name: str
) -> Tally:
    """One call's worth of queries on straight paths. Truths invalidated by rounding to `dtype` are recomputed."""
    began = time.perf_counter()
    given = family.points_t0, family.points_t1
    start, end = (x.astype(np.float32).astype(np.float64) if dtype == torch.float32 else x for x in given)
    known = ~np.isnan(family.toi)
    known &= ((start == given[0]) & (end == given[1])).all(axis=(1, 2))
    truth, undecided = _known(family), 0
    rows = np.flatnonzero(~known)
    if len(rows):
        found, asked = batch.decide_straight(start[rows], end[rows], is_face, family.separation)
        undecided = int(asked.sum())
        columns = [truth.status.copy(), truth.toi_lower.copy(), truth.toi_upper.copy()]
        for column, value in zip(columns, (found.status, found.toi_lower, found.toi_upper), strict=True):
            column[rows] = value
        truth = Decisions(*columns)
    status, toi, coordinates = solve(start, end, is_face, family.separation, tolerance, device=device, dtype=dtype)
    unit = 2.0 ** -DIGITS[dtype]
    rounding = ROUNDING[dtype] * unit * np.maximum(np.ptp(start, axis=1).max(axis=1), np.ptp(end, axis=1).max(axis=1))
    t = np.where(status == pgccd.Status.FREE, 0.0, toi.astype(np.float64))[:, None, None]
    at_toi = (1 - t) * (start - start[:, :1]) + t * (end - end[:, :1])
    allowed = family.separation + tolerance + rounding
    named = allowed + 64 * unit * conditioning(at_toi, is_face)
    answers = Answers(status, toi.astype(np.float64), coordinates, allowed, named)

    def is_near(row: int) -> bool:
        square = distance.squared_distance_exact(start[row], end[row], Fraction(float(answers.toi[row])), is_face)
        return square <= Fraction(float(answers.allowed[row])) ** 2

    tally = compare(truth, answers, StraightPaths(start, end, is_face), at_toi, name, is_near)
    tally.undecided, tally.seconds = undecided, time.perf_counter() - began
    return tally


def _scaled(rng: np.random.Generator, family: Family, dtype: torch.dtype) -> tuple[Family, float, str]:
    """The queries scaled to around 1e-12, 1 or 1e8, or a mixture; with a tolerance of 1e-3 to 1e-14 of the size."""
    kind = rng.choice(["1", "1e-12", "1e8", "mixed"], p=[0.5, 0.2, 0.2, 0.1])
    tolerance = 10.0 ** -rng.uniform(3, 14 if dtype == torch.float64 else 7)
    if kind == "mixed" and family.separation == 0.0:
        scale = 2.0 ** rng.integers(-40, 28, (len(family.toi), 1, 1))
        one = 2.0**-20
    else:
        one = {"1e-12": 2.0**-40, "1e8": 2.0**27}.get(kind, 1.0)
        scale = np.array(one)
    if family.tolerance is not None:
        tolerance = family.tolerance
    scaled = Family(family.points_t0 * scale, family.points_t1 * scale, family.toi, family.separation * one)
    return scaled, tolerance * one, f"scale {kind}, separation {scaled.separation:.3g}, tolerance {tolerance * one:.3g}"


def straight_families() -> dict[str, tuple[Maker, int]]:
    """Maker and number of queries per call, by name."""
    known = {maker.__name__.replace("_", " "): (maker, QUERIES) for maker in KNOWN}
    return known | {n: (m, QUERIES) for n, m in UNKNOWN.items()} | {n: (m, EXACT_QUERIES) for n, m in EXACT.items()}


def accepts(dtype: torch.dtype) -> bool:
    """Do the elementary tests accept points of this type?"""
    none = torch.zeros((0, 4, 3), dtype=dtype)
    try:
        pgccd.narrow.vertex_face(none, none)
    except TypeError:
        return False
    return True


def straight(
    seed: int,
    rounds: Iterable[int],
    dtype: torch.dtype = torch.float64,
    device: torch.device | str = "cpu",
    share: int = 1,
) -> Iterator[tuple[str, Tally]]:
    """All families once per round, faces and edges in turn; each call has 1 / `share` of its queries."""
    for turn in rounds:
        for number, (name, (maker, count)) in enumerate(straight_families().items()):
            for is_face in (True, False):
                rng = np.random.default_rng([seed, turn, number, is_face])
                family = maker(rng, max(count // share, 1), is_face, DIGITS[dtype])
                if name in UNKNOWN and family.tolerance is None and rng.random() < 0.5:
                    family = replace(family, separation=10.0 ** -rng.uniform(0.5, 4))
                family, tolerance, settings = _scaled(rng, family, dtype)
                label = f"{name}, seed [{seed}, {turn}, {number}, {int(is_face)}], {settings}"
                yield name, check_straight(family, is_face, tolerance, dtype, device, label)
