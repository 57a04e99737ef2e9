"""As `bulk`, for joint paths: random robots among boxes, certified, against samples of every segment."""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path

import numpy as np
import torch
from oracle.arms import Arm, Part, least_gaps

import pgccd
from pgccd.robots import Certificate, Verdict
from support.arms import UPRIGHT, attached_like, beams, boxes, loaded, part_of, random_arm, untested, with_object
from support.bulk import Tally

SAMPLES, SEGMENTS = 2001, 2
# Samples at first, and between those of them that lie near a contact.
STRIDES = (100, 20, 4, 1)
# A gap counts as a contact only below this length, and as none only above it: the oracle rounds.
ROUNDING = 1e-9


def thin(rng: np.random.Generator) -> Arm:
    """One to nine sheets and needles on joints of all kinds, and one that follows another."""
    made = []
    for k in range(int(rng.integers(1, 10))):
        half = rng.uniform(0.05, 0.2, 3)
        half[rng.permutation(3)[: rng.integers(1, 3)]] = 10.0 ** rng.uniform(-5, -2)
        kind = "prismatic" if k and rng.random() < 0.3 else "revolute"
        mimic = (0, float(rng.uniform(-2, 2)), 0.1) if k > 1 and kind == "revolute" and rng.random() < 0.2 else None
        xyz = tuple(rng.uniform(-0.3, 0.3, 3)) if k else UPRIGHT
        made.append(Part(kind, xyz, UPRIGHT, tuple(rng.normal(size=3)), half=tuple(half), mimic=mimic))
    return Arm(made)


FAMILIES: dict[str, Callable[[np.random.Generator], Arm]] = {
    "beams": lambda rng: beams(int(rng.integers(1, 8))),
    "any joints": lambda rng: random_arm(rng, int(rng.integers(1, 10))),
    "thin links": thin,
    "attached": lambda rng: random_arm(rng, 6),
    "curves": lambda rng: random_arm(rng, 5),
}


def speed(arm: Arm, control: np.ndarray, reach: float) -> np.ndarray:
    """(K,): a bound of how fast two points of an arm come nearer, on segments with control points (K, D + 1, J)."""
    rates = (control.shape[1] - 1) * np.abs(np.diff(control, axis=1)).max(axis=1)
    total = np.zeros(len(control))
    for column, k in enumerate(arm.coordinates):
        factor = 1.0 + sum(abs(part.mimic[1]) for part in arm.parts if part.mimic and part.mimic[0] == k)
        kinds = {part.kind for j, part in enumerate(arm.parts) if j == k or (part.mimic and part.mimic[0] == k)}
        total += rates[:, column] * factor * (2.0 * reach if "revolute" in kinds else 2.0)
    return total


def first_touches(control: np.ndarray, gap: Callable[[np.ndarray], np.ndarray], rate: np.ndarray) -> np.ndarray:
    """(B, 2): of paths (B, K, D + 1, J), the first touch among samples, as a fraction of the path (inf: none), and the
    gap at the start. Samples are left out where coarser ones and `rate` (B, K) prove that nothing touches.
    """
    count, segments = control.shape[:2]
    curves = control.reshape(count * segments, *control.shape[2:])

    def gaps_at(row: np.ndarray, sample: np.ndarray) -> np.ndarray:
        s, points = (sample / (SAMPLES - 1))[:, None], np.moveaxis(curves[row], 1, 0)
        while len(points) > 1:
            points = (1.0 - s) * points[:-1] + s * points[1:]
        return gap(points[0])

    first = np.full(count * segments, np.inf)
    row = np.repeat(np.arange(count * segments), (SAMPLES - 1) // STRIDES[0])
    begin = np.tile(np.arange(0, SAMPLES - 1, STRIDES[0]), count * segments)
    at_begin, at_end = gaps_at(row, begin), gaps_at(row, begin + STRIDES[0])
    start = at_begin[begin == 0][::segments]
    for stride, next_stride in zip(STRIDES, (*STRIDES[1:], 0), strict=True):
        for at, where in ((at_begin, begin), (at_end, begin + stride)):
            np.minimum.at(first, row[at <= -ROUNDING], where[at <= -ROUNDING] / (SAMPLES - 1))
        if next_stride:
            # Between two samples the gap is at least their mean less the way of half an interval.
            near = 0.5 * (at_begin + at_end) - 0.5 * rate.reshape(-1)[row] * stride / (SAMPLES - 1) <= 1e-6
            near &= begin < first[row] * (SAMPLES - 1)
            parts = stride // next_stride
            row = np.repeat(row[near], parts)
            begin = (begin[near][:, None] + next_stride * np.arange(parts)).reshape(-1)
            inner = gaps_at(row, begin).reshape(-1, parts)
            at_end = np.concatenate([inner[:, 1:], at_end[near][:, None]], axis=1).reshape(-1)
            at_begin = inner.reshape(-1)
    whole = ((np.arange(segments) + first.reshape(count, segments)) / segments).min(axis=1)
    return np.stack([whole, start], axis=1)


def check_robot(rng: np.random.Generator, family: str, folder: Path, name: str, paths: int) -> Tally:
    """One random robot, whose paths are certified in one call."""
    began = time.perf_counter()
    arm = FAMILIES[family](rng)
    robot = loaded(arm, folder)
    if family == "attached":
        arm, carrier, pose = with_object(arm, rng)
        robot = attached_like(robot, arm, carrier, pose, [])
    reach = robot.reach
    obstacles, frames, half = boxes(rng, int(rng.integers(1, 7)), 0.3 * reach, 0.9 * reach)
    degree = int(rng.integers(2, 6)) if family == "curves" else 1
    steps = 10.0 ** rng.uniform(-1.5, 0.0) * rng.normal(size=(paths, SEGMENTS * degree + 1, robot.joint_count))
    joined = rng.uniform(-1.2, 1.2, (paths, 1, robot.joint_count)) + steps.cumsum(axis=1)
    control = np.stack([joined[:, k * degree : (k + 1) * degree + 1] for k in range(SEGMENTS)], axis=1)
    q = torch.tensor(joined)
    found = robot.certify(pgccd.Spline(q.movedim(1, 0), degree) if degree > 1 else q, obstacles)

    # The slider adds to what a point can reach; obstacles stand still.
    travel = np.abs(joined).max() * sum(abs((part.mimic or (0, 1.0, 0))[1]) for part in arm.parts)
    rate = np.stack([speed(arm, control[b], reach + travel) for b in range(paths)])
    names = untested(robot)
    # What no joint moves may stand on an obstacle.
    still = [part_of(robot, body) for body in torch.nonzero(~robot.moves).flatten().tolist()]
    truth = first_touches(control, lambda q: least_gaps(arm, q, frames, half, names, still=still), rate)
    return tally_of(found, truth, name, time.perf_counter() - began)


def tally_of(found: Certificate, truth: np.ndarray, name: str, seconds: float) -> Tally:
    """Counts verdicts; `near` are those that samples do not confirm."""
    tally = Tally(queries=len(truth), seconds=seconds)
    for b, (first, start) in enumerate(truth):
        verdict, at = Verdict(int(found.verdict[b])), float(found.time[b])
        touches = bool(np.isfinite(first))
        missed, late = touches and verdict == Verdict.FREE, touches and verdict != Verdict.FREE and at > first
        invented = verdict in (Verdict.INVALID, Verdict.UNDECIDED)
        invented |= start > ROUNDING if verdict == Verdict.START else start < -ROUNDING
        tally.true += int(touches)
        tally.missed += int(missed)
        tally.late += int(late)
        tally.invented += int(invented)
        tally.near += int(not touches and verdict in (Verdict.COLLISION, Verdict.NEAR))
        if missed or late or invented:
            tally.examples.append(f"{name}, path {b}: {verdict.name} at {at}, samples: {first}, start {start}")
    return tally


def joint_paths_checked(seed: int, rounds: Iterable[int], paths: int = 40) -> Iterator[tuple[str, Tally]]:
    """All families once per round, with so many paths each."""
    with tempfile.TemporaryDirectory() as folder:
        for turn in rounds:
            for number, family in enumerate(FAMILIES):
                rng = np.random.default_rng([seed, turn, number])
                name = f"{family}, seed [{seed}, {turn}, {number}]"
                yield family, check_robot(rng, family, Path(folder), name, paths)
