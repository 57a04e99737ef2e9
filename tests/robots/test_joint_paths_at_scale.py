"""Certificates of random robots' paths against samples; see nightly.py."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from support import bulk_joints
from support.bulk import Tally

from pgccd.robots import Certificate, Robot


@pytest.mark.parametrize(("rounds", "paths"), [(3, 12), pytest.param(12, 40, marks=pytest.mark.slow)])
def test_nothing_is_missed_and_nothing_late(rounds: int, paths: int) -> None:
    tally = Tally()
    for name, each in bulk_joints.joint_paths_checked(10, range(rounds), paths):
        assert each.complaints(name) == []
        tally.add(each)
    assert tally.queries == rounds * paths * len(bulk_joints.FAMILIES)
    assert 0.1 < tally.share("true") < 0.9 and tally.share("near") < 0.05


def faulty(found: Certificate, fault: str) -> Certificate:
    if fault == "late":
        return replace(found, time=found.time + 2e-3)
    verdict = {"missed": torch.zeros_like(found.verdict), "invented": torch.full_like(found.verdict, 5)}[fault]
    return replace(found, verdict=verdict)


@pytest.mark.parametrize("fault", ["missed", "late", "invented"])
def test_faults_are_seen(fault: str, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    certify = Robot.certify
    monkeypatch.setattr(Robot, "certify", lambda *given: faulty(certify(*given), fault))
    tally = bulk_joints.check_robot(np.random.default_rng([3, 0, 3]), "attached", tmp_path, "attached", 12)
    assert getattr(tally, fault) > 0 and tally.complaints("attached")
