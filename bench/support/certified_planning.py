"""OMPL's RRT-Connect with certified motions, and the same motions by discrete tests of pinocchio and coal."""

from __future__ import annotations

import time
from typing import Any

import numpy as np
import pinocchio  # noqa: F401  without it there is nothing to compare
import torch
from torch import Tensor

from pgccd.robots import MotionValidator, Verdict, ompl
from support.planner_process import (
    Discrete,
    UnsolvedError,
    discrete_checker,
    ompl_plan,
    ompl_seeded,
    ompl_setup,
    ompl_state,
)
from support.planning_problems import Arm
from support.touched_paths import FINE, Judge, tested_pairs

# Motions of each problem that are checked again, at most.
MOTIONS = 200

Edge = tuple[list[float], list[float]]


class Timed:
    """A validator that counts its calls and their time, and keeps the motions."""

    def __init__(self, validator: MotionValidator) -> None:
        self._validator = validator
        self.seconds, self.states, self.motions = 0.0, 0, list[Edge]()

    def __call__(self, start: list[float], goal: list[float]) -> bool:
        """As of `MotionValidator`."""
        begin = time.perf_counter()
        found = self._validator(start, goal)
        self.seconds += time.perf_counter() - begin
        self.motions.append((start, goal))
        return found

    def check_states(self, q: list[float]) -> Tensor:
        """As of `MotionValidator`."""
        begin = time.perf_counter()
        found = self._validator.check_states(q)
        self.seconds += time.perf_counter() - begin
        self.states += 1
        return found


def measure(
    arm: Arm, judges: list[Judge], described: list[dict[str, Any]], seconds: float
) -> tuple[list[dict[str, Any]], dict[str, Any]]:
    """Rows as of the planners' processes, and times of plans and of motions.

    Raises:
        RuntimeError: pinocchio and coal test other pairs of links than certificates do.
    """
    ompl_seeded(1)
    rows, plans, shares, counts, spent = [], [], [], [], []
    compared: list[dict[str, Any]] = []
    for judge, row in zip(judges, described, strict=True):
        problem = judge.problem
        if Discrete(row["path"]).pairs() != tested_pairs(judge):
            raise RuntimeError(f"{problem.kind} {problem.number}: not the same pairs are tested")
        validator = arm.robot.motion_validator(problem.obstacles())
        timed = Timed(validator.clone())
        setup = ompl_setup(arm.low, arm.high)
        information = setup.getSpaceInformation()
        checker = ompl.StatesWithoutContact(information, timed)  # type: ignore[arg-type]
        motions = ompl.CertifiedMotions(information, timed)  # type: ignore[arg-type]
        setup.setStateValidityChecker(checker)
        information.setMotionValidator(motions)
        found: dict[str, Any] = {"kind": problem.kind, "number": problem.number, "paths": [], "failed": None}
        begin = time.perf_counter()
        try:
            paths = ompl_plan(setup, row, seconds)
        except UnsolvedError as error:
            found["failed"] = str(error)
        else:
            whole = time.perf_counter() - begin
            plans.append(whole)
            shares.append(timed.seconds / whole)
            counts.append(len(timed.motions))
            spent.append(timed.seconds / max(1, len(timed.motions)))
            found["paths"] = [{"name": name, "q": q.tolist(), "seconds": took} for name, (q, took) in paths.items()]
        rows.append(found)
        rng = np.random.default_rng(problem.number)
        some = rng.permutation(len(timed.motions))[:MOTIONS].tolist()
        compared += motions_again(judge, arm, row["path"], [timed.motions[k] for k in some])
    summary = {
        "plans": len(plans),
        "plan and simplification, ms": 1e3 * float(np.median(plans)),
        "share of certificates": float(np.median(shares)),
        "motions a plan": float(np.median(counts)),
        "us of pgccd a motion": 1e6 * float(np.median(spent)),
    }
    return rows, summary | both(compared)


def motions_again(judge: Judge, arm: Arm, path: str, edges: list[Edge]) -> list[dict[str, Any]]:
    """Each motion by OMPL's discrete validator at its default resolution, and by a certificate."""
    discrete, is_valid = Discrete(path), judge.robot.motion_validator(judge.obstacles)
    setup = ompl_setup(arm.low, arm.high)
    information = setup.getSpaceInformation()
    checker = discrete_checker(information, discrete)
    setup.setStateValidityChecker(checker)
    information.setup()
    found = []
    for start, goal in edges:
        states = [ompl_state(information, q) for q in (start, goal)]
        calls, inside = discrete.calls, discrete.seconds
        begin = time.perf_counter()
        valid = information.checkMotion(*states)
        middle = time.perf_counter()
        free = is_valid(start, goal)
        end = time.perf_counter()
        row = {"valid": bool(valid), "free": free, "samples": discrete.calls - calls, "certificate": end - middle}
        row |= {"discrete": middle - begin, "coal": discrete.seconds - inside, "collides": False}
        if valid and not free:
            q = torch.tensor([[start, goal]], dtype=torch.float64)
            exact = judge.robot.certify(q, judge.obstacles, resolution=FINE)
            row["collides"] = int(exact.verdict[0]) == Verdict.COLLISION
        found.append(row)
    return found


def both(compared: list[dict[str, Any]]) -> dict[str, Any]:
    """Times of the motions that are free, and of those that are not; and where the verdicts differ."""
    summary: dict[str, Any] = {"motions": len(compared)}
    for name, free in (("free", True), ("not free", False)):
        some = [row for row in compared if row["free"] is free]
        columns = {key: 1e6 * np.array([row[key] for row in some]) for key in ("discrete", "coal", "certificate")}
        summary[name] = {
            "motions": len(some),
            "samples, mean": float(np.mean([row["samples"] for row in some])),
            "discrete, us, mean and median": _mean_and_median(columns["discrete"]),
            "of that pinocchio and coal": _mean_and_median(columns["coal"]),
            "certificate, us, mean and median": _mean_and_median(columns["certificate"]),
        }
    summary["valid by samples, not free"] = sum(row["valid"] and not row["free"] for row in compared)
    summary["of these in contact"] = sum(row["collides"] for row in compared)
    summary["free, not valid by samples"] = sum(row["free"] and not row["valid"] for row in compared)
    return summary


def _mean_and_median(values: np.ndarray) -> list[float]:
    return [round(float(values.mean()), 1), round(float(np.median(values)), 1)]
