"""The narrow phase on many random and adversarial queries against the batch oracle; see nightly.py."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
import pytest
import torch
from oracle import families
from oracle.arcs import PLANS
from support import bulk, bulk_arcs
from support.bulk import Tally

import pgccd

DTYPES = pytest.mark.parametrize("dtype", [torch.float64, torch.float32], ids=["float64", "float32"])


def assert_all_well(checks: Iterable[tuple[str, Tally]], names: Iterable[str], least: int) -> None:
    tallies: dict[str, Tally] = {name: Tally() for name in names}
    for name, tally in checks:
        tallies[name].add(tally)
    assert [line for name, tally in tallies.items() for line in tally.complaints(name)] == []
    assert sum(tally.queries for tally in tallies.values()) >= least
    for name, tally in tallies.items():
        assert tally.true > 0 or name == "short", f"{name}: nothing touches"


@DTYPES
@pytest.mark.parametrize(
    ("rounds", "share", "least"), [(1, 4, 35_000), pytest.param(2, 2, 150_000, marks=pytest.mark.slow)]
)
def test_straight_paths(dtype: torch.dtype, device: torch.device, rounds: int, share: int, least: int) -> None:
    if not bulk.accepts(dtype):
        pytest.skip(f"the elementary tests do not take {dtype}")
    assert_all_well(bulk.straight(1, range(rounds), dtype, device, share=share), bulk.straight_families(), least)


@pytest.mark.parametrize(("share", "least"), [(32, 1_700), pytest.param(16, 3_500, marks=pytest.mark.slow)])
def test_arcs(device: torch.device, share: int, least: int) -> None:
    assert_all_well(bulk_arcs.arcs_checked(1, range(1), device, share=share), PLANS, least)


@pytest.mark.slow
@pytest.mark.timeout(3600)
@DTYPES
def test_straight_paths_at_length(dtype: torch.dtype, device: torch.device) -> None:
    if not bulk.accepts(dtype):
        pytest.skip(f"the elementary tests do not take {dtype}")
    assert_all_well(bulk.straight(2, range(10), dtype, device), bulk.straight_families(), 1_500_000)


@pytest.mark.slow
@pytest.mark.timeout(3600)
def test_arcs_at_length(device: torch.device) -> None:
    assert_all_well(bulk_arcs.arcs_checked(2, range(2), device), PLANS, 100_000)


def broken(fault: str, status: np.ndarray, toi: np.ndarray, coordinates: np.ndarray) -> tuple[np.ndarray, ...]:
    """Results with one contact in ten falsified."""
    some = (status == pgccd.Status.TOUCH) & (np.arange(len(status)) % 10 == 0)
    if fault == "missed":
        status, toi = np.where(some, pgccd.Status.FREE, status), np.where(some, np.inf, toi)
    elif fault == "late":
        toi = np.where(some, np.minimum(toi + 1e-6, 1.0), toi)
    elif fault == "invented":
        toi = np.where(some, np.maximum(toi - 0.1, 0.0), toi)
    else:
        coordinates = np.where(some[:, None], coordinates[:, ::-1], coordinates)
    return status, toi, coordinates


@pytest.mark.parametrize("path", ["straight", "arcs"])
@pytest.mark.parametrize("fault", ["missed", "late", "invented", "misplaced"])
def test_every_fault_is_seen(fault: str, path: str, monkeypatch: pytest.MonkeyPatch) -> None:
    module, solve = (bulk, "solve") if path == "straight" else (bulk_arcs, "solve_candidates")
    true = getattr(module, solve)
    monkeypatch.setattr(module, solve, lambda *given, **named: broken(fault, *true(*given, **named)))
    rng = np.random.default_rng(3)
    if path == "straight":
        crossing = families.crossing(rng, 500, True, 53)
        unknown = families.UNKNOWN["random"](rng, 2000, True, 53)
        tally = Tally()
        for family in (crossing, unknown):
            tally.add(bulk.check_straight(family, True, 1e-9, torch.float64, "cpu", "broken"))
    else:
        tally = bulk_arcs.check_arcs(rng, PLANS["meeting"], pgccd.Kind.VF_BA, 500, "cpu", "broken")
    assert getattr(tally, fault) > 20
    assert any(fault in line for line in tally.complaints("broken"))
