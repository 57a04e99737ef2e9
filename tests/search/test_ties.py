"""Contacts of equal toi: the first of a pair is the least row of all its contacts, in every column, for any order of
candidates and on any device.
"""

from __future__ import annotations

import numpy as np
import pytest
import torch
from strategies.lattice import Meetings, meetings
from support.same_bits import COLUMNS, bits

import pgccd

PATHS = ("vertices", "rigid", "linear")


def least_rows(found: pgccd.Contacts) -> list[torch.Tensor]:
    """The row with the least (toi, kind, features) of each pair."""
    keys = (found.features[:, 1], found.features[:, 0], found.kind, found.toi, found.pairs[:, 1], found.pairs[:, 0])
    order = torch.from_numpy(np.lexsort([key.cpu().numpy() for key in keys]).copy())
    pairs = found.pairs.cpu()[order]
    is_first = torch.ones(len(pairs), dtype=torch.bool)
    is_first[1:] = (pairs[1:] != pairs[:-1]).any(dim=1)
    return [getattr(found, name).cpu()[order[is_first]] for name in COLUMNS]


def columns(found: pgccd.Contacts) -> list[torch.Tensor]:
    """All columns, on the CPU."""
    return [getattr(found, name).cpu() for name in COLUMNS]


def are_equal(a: list[torch.Tensor], b: list[torch.Tensor]) -> bool:
    """Are all columns bitwise equal?"""
    return all(torch.equal(bits(x), bits(y)) for x, y in zip(a, b, strict=True))


def test_smallest_case(device: torch.device) -> None:
    """A vertex and a face, and several edges, touch at times that only higher precision distinguishes."""
    d = np.array([-4 / 7, 1.0, 5 / 7])
    scene = meetings(np.random.default_rng(0), 1)
    still = np.zeros(3)
    scene = Meetings(scene.meshes, np.stack([still, 3 * d]), np.stack([still, 3 * d - 2.2 * d]), np.zeros((2, 3)))
    motion = scene.motion("vertices", device)
    every = pgccd.detect(scene.scene(device), motion, "all")
    assert int((every.toi == every.toi.min()).sum()) > 1
    first = pgccd.detect(scene.scene(device), motion, "first")
    assert are_equal(columns(first), least_rows(every))


@pytest.mark.parametrize("path", PATHS)
@pytest.mark.parametrize("tolerance", [None, 0.0])
@pytest.mark.parametrize("separation", [0.0, 0.125])
@pytest.mark.parametrize("subdivisions", [0, 1])
def test_first_is_the_least_of_all(
    device: torch.device, path: str, tolerance: float | None, separation: float, subdivisions: int
) -> None:
    rng = np.random.default_rng([PATHS.index(path), subdivisions, int(separation > 0)])
    crowd = meetings(rng, 150 if subdivisions else 400, subdivisions, turning=path != "vertices")
    scene, motion = crowd.scene(device), crowd.motion(path, device)
    every = pgccd.detect(scene, motion, "all", separation, tolerance=tolerance)
    first = pgccd.detect(scene, motion, "first", separation, tolerance=tolerance)
    expected = least_rows(every)
    tied = every.toi[:, None] == every.toi[None, :] if len(every) < 2000 else None
    assert tied is None or int(tied.sum()) > 2 * len(every), "hardly any ties"
    assert are_equal(columns(first), expected)
    earliest = pgccd.detect(scene, motion, "earliest", separation, tolerance=tolerance)
    at = int(torch.argmin(expected[1]))
    assert are_equal(columns(earliest), [c[at : at + 1] for c in expected])


@pytest.mark.parametrize("path", PATHS)
def test_order_of_candidates(device: torch.device, path: str) -> None:
    crowd = meetings(np.random.default_rng(5), 100, 0, turning=path != "vertices")
    bodies = pgccd.MovingBodies.of(crowd.scene(device), crowd.motion(path, device))
    pairs = pgccd.broad.sweep(bodies)
    candidates, _ = pgccd.traverse.find_candidates(bodies, pairs)
    canonical = torch.from_numpy(np.lexsort(candidates.cpu().numpy().T[::-1]).copy()).to(device)
    candidates = candidates[canonical]
    expected = [c.cpu() for c in pgccd.narrow.find_contacts(bodies, pairs, candidates)]
    rng = np.random.default_rng(6)
    for order in (np.arange(len(candidates))[::-1], *(rng.permutation(len(candidates)) for _ in range(4))):
        shuffled = candidates[torch.from_numpy(order.copy()).to(device)]
        found = [c.cpu() for c in pgccd.narrow.find_contacts(bodies, pairs, shuffled)]
        assert are_equal(found, expected)


@pytest.mark.cuda
@pytest.mark.parametrize("path", PATHS)
@pytest.mark.parametrize("report", ["first", "all", "earliest"])
def test_devices_agree(path: str, report: str) -> None:
    for subdivisions in (0, 1):
        crowd = meetings(np.random.default_rng(8), 200, subdivisions, turning=path != "vertices")
        found = [
            columns(pgccd.detect(crowd.scene(device), crowd.motion(path, device), report))
            for device in ("cpu", "cuda", "cuda")
        ]
        assert are_equal(found[0], found[1]) and are_equal(found[0], found[2])
