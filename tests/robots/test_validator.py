"""Motions of planners, one by one: the same verdicts in any order of calls, whatever was learned before."""

from __future__ import annotations

import math
import threading
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from oracle.arms import Arm, Part
from support.arms import UPRIGHT, beams, boxes, loaded, random_arm
from support.cases import mostly_slow

import pgccd
from pgccd.robots import MotionValidator, Obstacles, Verdict


def walks(rng: np.random.Generator, joints: int, count: int, size: float) -> list[tuple[list[float], list[float]]]:
    """Motions of planners: many short ones near one another, with jumps between."""
    made, here = [], rng.uniform(-1, 1, joints)
    for _ in range(count):
        if rng.random() < 0.05:
            here = rng.uniform(-1, 1, joints)
        there = here + rng.normal(size=joints) * size * 10.0 ** rng.uniform(-2, 0)
        made.append((here.tolist(), there.tolist()))
        here = there if rng.random() < 0.7 else here
    return made


@pytest.mark.parametrize("seed", mostly_slow(range(8), [0, 1]))
def test_nothing_learned_changes_a_verdict(seed: int, tmp_path: Path) -> None:
    rng = np.random.default_rng(seed)
    robot = loaded(random_arm(rng, 6) if seed % 2 else beams(5), tmp_path)
    obstacles, _, _ = boxes(rng, 5, 0.3 * robot.reach, 0.8 * robot.reach)
    motions = walks(rng, robot.joint_count, 400, 0.3)
    certified = robot.certify(torch.tensor(motions, dtype=torch.float64), obstacles)
    in_order, shuffled = robot.motion_validator(obstacles), robot.motion_validator(obstacles)
    fresh = shuffled.clone()
    saved = 0
    for k in (*rng.permutation(400).tolist(), *range(400)):
        assert shuffled(*motions[k]) == bool(certified.free[k])
    for k, motion in enumerate(motions):
        found, alone = in_order.check(*motion), fresh.clone().check(*motion)
        # Points of free motions are nan, which is no number's equal.
        assert found == alone or (math.isnan(found.point[0]) and replace(found, point=alone.point) == alone), k
        expected = certified.verdict[k] if certified.verdict[k] != Verdict.COLLISION else Verdict.NEAR
        assert found.verdict == expected and found.names == certified.names(k)
        toi = float(certified.toi[k])
        assert found.free_until == (1.0 if math.isinf(toi) else min(toi, math.nextafter(1.0, 0.0)))
    assert 20 < int(certified.free.sum()) < 400 or seed % 2
    del saved


def test_a_distance_that_hardly_suffices(tmp_path: Path) -> None:
    """A finger that turns on the spot and then reaches a wall: what was learned before is no longer true, and in no
    motion of any length a touch is missed.
    """
    rod = Part("revolute", UPRIGHT, UPRIGHT, (0, 0, 1), half=(0.5, 0.02, 0.02), at=(0.5, 0.0, 0.0))
    slide = Part("prismatic", UPRIGHT, UPRIGHT, (1, 0, 0))
    robot = loaded(Arm([slide, rod]), tmp_path)
    wall = Obstacles([pgccd.Mesh.box([0.2, 4.0, 4.0])], torch.tensor([[1.6, 0.0, 0.0]], dtype=torch.float64))
    rng = np.random.default_rng(3)
    for by_turn in (False, True):
        is_valid = robot.motion_validator(wall)
        for _ in range(40):
            near = 10.0 ** rng.uniform(-3.0, -1.0)
            # The tip of the finger, a corner of its box, is `near` in front of the wall, then as far behind it.
            free, touching = (math.acos((1.5 - gap) / 1.5) if by_turn else 0.0 for gap in (near, 0.0))
            for _ in range(6):
                move = 1e-3 * near * rng.normal()
                assert is_valid([0.5 - near, move], [0.5 - near + move, 0.0])
            assert not is_valid([0.5 - near, 0.0], [0.5 + 0.01 * near, 0.0])
            assert is_valid([0.4 - near, 0.3], [0.4 - near, 0.3 + near])
            del free, touching


def test_a_contact_at_the_goal(tmp_path: Path) -> None:
    """It leaves less than the whole motion, however late it is."""
    robot = loaded(Arm([Part("prismatic", UPRIGHT, UPRIGHT, (1, 0, 0), half=(0.5, 0.5, 0.5))]), tmp_path)
    wall = Obstacles([pgccd.Mesh.box([1.0, 4.0, 4.0])], torch.tensor([[2.0, 0.0, 0.0]], dtype=torch.float64))
    is_valid = robot.motion_validator(wall)
    for goal in np.nextafter(1.0, [0.0, 1.0, 2.0]).tolist():
        assert not is_valid([0.0], [goal]) and 0.99 < is_valid.last_valid([0.0], [goal]) < 1.0


def test_budgets(tmp_path: Path) -> None:
    robot = loaded(beams(5), tmp_path)
    obstacles, _, _ = boxes(np.random.default_rng(2), 5, 0.4, 1.2)
    is_valid = robot.motion_validator(obstacles)
    rng = np.random.default_rng(3)
    start = [0.0] * 5
    goals = [(2.0 * rng.normal(size=5)).tolist() for _ in range(20)]
    goal = next(each for each in goals if is_valid.check(start, each, budget=8).verdict == Verdict.UNDECIDED)
    whole = is_valid.check(start, goal)
    undecided = is_valid.check(start, goal, budget=1)
    assert undecided.verdict == Verdict.UNDECIDED and undecided.free_until == 0.0 and undecided.names == ()
    verdicts = [is_valid.check(start, goal, budget=2**k).verdict for k in range(16)]
    assert verdicts[-1] == whole.verdict and set(verdicts) == {Verdict.UNDECIDED, whole.verdict}
    assert verdicts == sorted(verdicts, key=lambda v: v != Verdict.UNDECIDED)
    for budget in (0, -1, 1.5):
        with pytest.raises((TypeError, ValueError), match="^budget: expected a number of pairs > 0"):
            is_valid.check(start, goal, budget=budget)  # type: ignore[arg-type]


def test_states(tmp_path: Path) -> None:
    rng = np.random.default_rng(4)
    robot = loaded(beams(4), tmp_path)
    obstacles, _, _ = boxes(rng, 4, 0.3, 0.9)
    q = torch.tensor(rng.uniform(-1.5, 1.5, (300, 4)))
    is_valid = robot.motion_validator(obstacles)
    certified = robot.certify(q[:, None].expand(-1, 2, -1), obstacles)
    states = is_valid.check_states(q)
    assert states.tolist() == (certified.verdict != int(Verdict.START)).tolist() and 0 < int(states.sum()) < 300
    assert bool(is_valid.check_states(q[0].tolist())) == bool(states[0])
    assert is_valid.check_states([[math.nan] * 4, [1e9] * 4, q[int(states.long().argmax())].tolist()]).tolist() == [
        False,
        False,
        True,
    ]
    assert is_valid.check_states(torch.zeros(0, 4)).shape == (0,)
    with pytest.raises(ValueError, match=r"^q: expected configurations \(K, 4\), got shape \(3,\)"):
        is_valid.check_states([0.0, 1.0, 2.0])


def test_one_thread(tmp_path: Path) -> None:
    robot = loaded(beams(3), tmp_path)
    is_valid = robot.motion_validator()
    assert is_valid([0.0] * 3, [0.1] * 3)
    raised: list[str] = []
    free: list[bool] = []

    def in_another(validator: MotionValidator) -> None:
        try:
            free.append(validator([0.0] * 3, [0.1] * 3))
        except RuntimeError as error:
            raised.append(str(error))

    for validator in (is_valid, is_valid.clone()):
        thread = threading.Thread(target=in_another, args=[validator])
        thread.start()
        thread.join()
    assert free == [True] and raised == [
        "a motion validator is used by one thread: clone() makes another one for another thread"
    ]


def test_arguments(tmp_path: Path) -> None:
    robot = loaded(beams(2), tmp_path)
    is_valid = robot.motion_validator()
    zero = [0.0, 0.0]
    for start in (zero, (0, 0), np.zeros(2), torch.zeros(2), torch.zeros(2, dtype=torch.float64), np.zeros(2, "f4")):
        assert is_valid(start, zero) and is_valid.last_valid(zero, start) == 1.0  # type: ignore[arg-type]
    for given, error in (([0.0], ValueError), ("ab", TypeError), ([0.0, "1"], TypeError), (None, TypeError)):
        with pytest.raises(error, match="^goal: "):
            is_valid(zero, given)  # type: ignore[arg-type]
    assert is_valid.check([math.nan, 0.0], zero).verdict == Verdict.INVALID


def test_planners_of_ompl(tmp_path: Path) -> None:
    """A path of RRT-Connect, every motion of which was certified, is free."""
    base = pytest.importorskip("ompl.base")
    geometric = pytest.importorskip("ompl.geometric")
    from pgccd.robots import ompl

    rng = np.random.default_rng(6)
    robot = loaded(beams(4), tmp_path)
    obstacles, _, _ = boxes(rng, 3, 0.5, 1.2)
    space, bounds = base.RealVectorStateSpace(4), base.RealVectorBounds(4)
    bounds.setLow(-2.0)
    bounds.setHigh(2.0)
    space.setBounds(bounds)
    setup = geometric.SimpleSetup(space)
    validator = ompl.use(setup.getSpaceInformation(), robot, obstacles)
    ends = torch.tensor(rng.uniform(-1, 1, (40, 4)))
    ends = ends[validator.check_states(ends)][:2]
    states = []
    for end in ends.tolist():
        state = space.allocState()
        for k, value in enumerate(end):
            state[k] = value
        states.append(state)
    setup.setStartAndGoalStates(*states)
    setup.setPlanner(geometric.RRTConnect(setup.getSpaceInformation()))
    setup.solve(20.0)
    assert setup.haveExactSolutionPath()
    path = setup.getSolutionPath()
    q = torch.tensor([ompl.values_of(path.getState(k), 4) for k in range(path.getStateCount())], dtype=torch.float64)
    assert torch.allclose(q[[0, -1]], ends) and bool(robot.certify(q[None], obstacles).free[0])
    outside = space.allocState()
    for k in range(4):
        outside[k] = 2.5
    assert not setup.getSpaceInformation().isValid(outside)
    with pytest.raises(ValueError, match="^space_information: expected a space of 3 dimensions"):
        ompl.use(setup.getSpaceInformation(), loaded(beams(3), tmp_path))
