"""What calls of a captured detection read of earlier ones: always at the same call, they grow the capacity or raise."""

from __future__ import annotations

import re
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from support.capacities import DEVICES_AND_PARTS
from support.deforming import crumpled, motion_of
from support.reports import captured_loop, detected, trimmed
from support.shapes import bumpy, tensors, unit_quaternions

import pgccd
from pgccd.runtime.sizes import BufferSizes, Capacity
from pgccd.search import captured as captured_module

REPORTS = ("any", "first", "all", "earliest")
NAN = float("nan")


def at_spacing(spacing: float, device: torch.device) -> pgccd.RigidMotion:
    """27 bodies of radius 1 on a lattice; the smaller its spacing, the more of them collide."""
    rng = np.random.default_rng(3)
    place = np.stack(np.meshgrid(*[np.arange(3.0)] * 3), axis=-1).reshape(-1, 3)
    columns = tensors(spacing * place, unit_quaternions(rng, 27), *rng.normal(size=(2, 27, 3)), device=device)
    return pgccd.RigidMotion.from_velocity(*columns, dt=0.1)


def lattice(device: torch.device) -> pgccd.Scene:
    return pgccd.Scene([bumpy(np.random.default_rng(4), 1)], [0] * 27, device)


def needs(scene: pgccd.Scene, motion: pgccd.RigidMotion, report: Any) -> Capacity:
    needed = detected(scene, motion, report).stats.needed
    assert needed is not None
    return needed


@pytest.mark.parametrize("report", REPORTS)
@pytest.mark.parametrize(("device", "part"), DEVICES_AND_PARTS, indirect=["device"])
def test_capacity_grows_two_calls_later(device: torch.device, part: str, report: Any) -> None:
    scene, sparse, dense = lattice(device), at_spacing(3.0, device), at_spacing(1.9, device)
    expected, needed = detected(scene, dense, report), needs(scene, dense, report)
    if getattr(needed, part) == 0:
        pytest.skip("not needed by such bodies")
    if report == "earliest" and part != "pairs" and device.type == "cuda":
        pytest.skip("how much is skipped depends on the order of threads")
    less = getattr(needed, part) - 1 if part in ("pairs", "contacts") else getattr(needed, part) // 2
    if part == "open":  # of few candidates all are left open if they fit, else those that need it
        less = 1
    tight = replace(needed.times(1.5), **{part: less})
    captured = captured_loop(scene, sparse, report, capacity=tight)
    for _ in range(2):
        assert not bool(captured(sparse).overflow)
    for _ in range(2):
        hits = captured(dense)
        assert captured.capacity == tight and bool(hits.overflow) and bool(hits.may_collide("body").all())
        assert report == "any" or float(hits.first_toi()) == 0.0
    hits = captured(dense)
    grown = captured.capacity
    assert grown is not None and getattr(grown, part) >= getattr(needed, part)
    assert not bool(hits.overflow) and torch.equal(hits.trim().pairs, expected.pairs)
    # The record of the second overflow is read, too; the capacity suffices by now.
    for _ in range(3):
        assert not bool(captured(dense).overflow) and captured.capacity is grown


@pytest.mark.parametrize("report", REPORTS)
def test_a_loop_never_stands_still(device: torch.device, report: Any) -> None:
    """From capacities of zero, one stage after the other overflows."""
    scene, motion = lattice(device), at_spacing(1.9, device)
    captured = captured_loop(scene, motion, report, capacity=BufferSizes(0, 0))
    overflows = [bool(captured(motion).overflow) for _ in range(30)]
    assert overflows[0] and overflows[1] and not overflows[-1]
    assert overflows == sorted(overflows, reverse=True)
    if report in ("any", "all"):  # on a GPU the needs of the others depend on the order of threads
        again = captured_loop(scene, motion, report, capacity=BufferSizes(0, 0))
        assert [bool(again(motion).overflow) for _ in range(30)] == overflows
    assert torch.equal(trimmed(captured).pairs, detected(scene, motion, report).pairs)


def test_a_step_that_needs_more_than_the_largest_capacity(device: torch.device) -> None:
    scene, motion = lattice(device), at_spacing(1.9, device)
    captured = pgccd.CapturedDetection(scene, motion, capacity=BufferSizes(0, 0))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(BufferSizes, "grown", lambda self, needed: self)
        for _ in range(2):
            assert bool(captured(motion).overflow)
        for _ in range(2):
            with pytest.raises(pgccd.CapacityError, match="^capacity: the step needs more: (pairs|overlaps)"):
                captured(motion)
        assert bool(captured(motion).overflow)  # the call before the last has no record
        with pytest.raises(pgccd.CapacityError):
            trimmed(captured)


def corrupt(motion: Any, column: str, row: int) -> torch.Tensor:
    """Makes a row invalid; returns a copy of the column."""
    values = getattr(motion, column)
    former = values.clone()
    values[row] = 2.0 if column.startswith("orientation") else NAN
    return former


@pytest.mark.parametrize("column", ["position_t0", "position_t1", "orientation_t0", "rotation"])
def test_an_invalid_pose_raises_two_calls_later(device: torch.device, column: str) -> None:
    scene, motion = lattice(device), at_spacing(1.9, device)
    expected = pgccd.detect(scene, motion)
    message = rf"^{column}: body 5: expected .* \(in the call before the last\)$"
    for wrong_calls in (1, 2, 3):
        captured = pgccd.CapturedDetection(scene, motion)
        captured.replay()
        former = corrupt(captured.motion, column, 5)
        hits = captured.replay()
        assert bool(hits.invalid) and float(hits.first_toi()) == 0.0
        outcomes = []
        for call in range(1, 7):
            if call == wrong_calls:
                getattr(captured.motion, column).copy_(former)
            try:
                hits = captured.replay()
            except ValueError as error:
                outcomes.append("raised")
                assert re.search(message, str(error))
            else:
                outcomes.append("invalid" if bool(hits.invalid) else "valid")
        # The third wrong call would be the one that raises for the first: it detects nothing.
        second = "raised" if wrong_calls > 1 else "valid"
        assert outcomes == ["invalid" if wrong_calls > 1 else "valid", "raised", second, *["valid"] * 3]
        assert torch.equal(trimmed(captured).toi, expected.toi)


def test_an_invalid_end_orientation(device: torch.device) -> None:
    """It is not a column: a GPU checks it when the motion is made, and leaves the result on the device."""
    scene, motion = lattice(device), at_spacing(1.9, device)
    captured = pgccd.CapturedDetection(scene, motion)
    end = motion.orientation_t0.clone()
    end[20] *= 1.1
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(torch.compiler, "is_compiling", lambda: True)
        wrong = pgccd.RigidMotion(motion.position_t0, motion.orientation_t0, motion.position_t1, end)
        valid = pgccd.RigidMotion(motion.position_t0, motion.orientation_t0, motion.position_t1, motion.orientation_t0)
    assert not bool(captured(valid).overflow)
    hits = captured(wrong)
    assert bool(hits.invalid) and bool(hits.may_collide("body").all()) and float(hits.first_toi()) == 0.0
    assert not bool(captured(valid).overflow)
    with pytest.raises(ValueError, match="^rotation: body 20: expected"):
        captured(valid)
    assert torch.equal(captured(valid).trim().toi, pgccd.detect(scene, valid).toi)
    first = pgccd.CapturedDetection(scene, wrong, capacity=captured.capacity).replay()
    assert bool(first.invalid) and float(first.first_toi()) == 0.0


def test_a_call_that_raises_loads_nothing(device: torch.device) -> None:
    scene, motion, other = lattice(device), at_spacing(1.9, device), at_spacing(3.0, device)
    captured = pgccd.CapturedDetection(scene, motion, capacity=needs(scene, motion, "first").times(1.5))
    corrupt(captured.motion, "position_t0", 3)
    captured.replay()
    captured(motion)
    with pytest.raises(ValueError, match="^position_t0: body 3"):
        captured(other)
    assert torch.equal(captured.motion.columns()["position_t0"], motion.position_t0)
    assert len(trimmed(captured)) > 0 and not bool(captured(other).overflow)


def test_contacts_read_the_record_of_the_last_call_only(device: torch.device) -> None:
    scene, motion = lattice(device), at_spacing(1.9, device)
    captured = pgccd.CapturedDetection(scene, motion)
    captured.replay()
    former = corrupt(captured.motion, "position_t0", 5)
    captured.replay()
    for _ in range(2):
        with pytest.raises(ValueError, match="^position_t0: body 5: expected [^(]*$"):
            trimmed(captured)
    captured.motion.columns()["position_t0"].copy_(former)
    for _ in range(3):  # that call was read
        assert not bool(captured.replay().overflow) and len(trimmed(captured))
    corrupt(captured.motion, "position_t0", 5)
    captured.replay()
    captured.motion.columns()["position_t0"].copy_(former)
    captured.replay()
    assert len(trimmed(captured)) and len(trimmed(captured))
    with pytest.raises(ValueError, match="^position_t0: body 5"):  # that call was not
        captured.replay()


def test_deforming_bodies(device: torch.device) -> None:
    """Values of a message could be those of a later call: it states none."""
    shapes, ends = crumpled(2)
    scene = pgccd.Scene(shapes, device=device, self_collision=True)
    motion = motion_of(*ends, device=device)
    captured = pgccd.CapturedDetection(scene, motion)
    assert not bool(captured(motion).overflow)
    captured.motion.columns()["x_t1"][2, 1] = NAN
    assert float(captured.replay().first_toi("body").max()) == 0.0
    former = motion.x_t1.clone()
    motion.x_t1[2, 1] = 1e149
    assert float(captured(motion).first_toi("body").max()) == 0.0
    motion.x_t1.copy_(former)
    with pytest.raises(ValueError, match=r"^x_t1: vertex 2: expected .*\(in the call before the last\)$"):
        captured(motion)
    with pytest.raises(ValueError, match=r"^motion: body 0: expected an SBV radius of 0, or from "):
        captured(motion)
    assert not bool(captured(motion).overflow)


class Recorded:
    """A graph whose replay repeats the work."""

    def __init__(self, work: Any) -> None:
        self.replay = work


def test_captured_again_when_inputs_are_replaced(device: torch.device) -> None:
    """A graph reads the memory that it was captured with."""
    scene = pgccd.Scene([bumpy(np.random.default_rng(4), 1, size=s) for s in (1.0, 1.3)], [0] * 27, device, margin=0.0)
    motion, captures = at_spacing(2.2, device), 0

    def capture(work: Any, _: torch.device) -> tuple[Any, Any]:
        nonlocal captures
        captures += 1
        return real(work, device) if device.type == "cuda" else (Recorded(work), work())

    with pytest.MonkeyPatch.context() as patch:
        real = captured_module.capture
        patch.setattr(captured_module, "capture", capture)
        patch.setattr(pgccd.CapturedDetection, "is_graph", True)
        if device.type == "cpu":
            patch.setattr(torch.cuda, "synchronize", lambda _: None)
        captured = pgccd.CapturedDetection(scene, motion, capacity=Capacity.of(1000))
        seen = set()

        def check(expected_captures: int) -> None:
            hits = captured.replay()
            assert captures == expected_captures
            if device.type == "cuda":
                assert torch.equal(hits.trim().pairs, pgccd.detect(scene, captured.motion).pairs)
            seen.add(len(pgccd.detect(scene, captured.motion)))

        check(1)
        check(1)
        scene.margin = torch.full((27,), 0.05, dtype=torch.float64, device=device)
        check(2)
        scene.margin.fill_(0.1)
        check(2)
        scene.mesh_index[::2] = 1
        check(3)
        captured.motion.position_t1 = at_spacing(2.5, device).position_t1  # type: ignore[union-attr]
        check(4)
        captured(motion)
        check(4)
        assert captures == 4 and len(seen) >= 4
