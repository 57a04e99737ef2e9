"""Checks that traversal and narrow phase find features that touch."""

from __future__ import annotations

from typing import Literal

import numpy as np
import torch
from oracle.detect import Detection
from strategies import contacts
from strategies.contacts import Meetings

import pgccd
from support.shapes import Bodies

BARELY = 1e-12
Key = tuple[int, int, int]


def missed(
    meetings: Meetings,
    device: torch.device,
    separation: float,
    tolerance: float = 0.0,
    path: Literal["rigid", "linear"] = "rigid",
    horizon: np.ndarray | None = None,
) -> list[int]:
    """Pairs with touching features that are missing from the candidates."""
    bodies = pgccd.MovingBodies.of(meetings.bodies.scene(device), meetings.bodies.motion(path, device))
    return missed_among(meetings, bodies, separation, tolerance, horizon)


def missed_among(
    meetings: Meetings,
    bodies: pgccd.MovingBodies,
    separation: float,
    tolerance: float = 0.0,
    horizon: np.ndarray | None = None,
) -> list[int]:
    """As `missed`, for bodies in any motion."""
    pairs = torch.tensor(meetings.pairs, device=bodies.device)
    until = None if horizon is None else torch.tensor(horizon, device=bodies.device)
    found, _ = pgccd.traverse.find_candidates(bodies, pairs, separation, tolerance, until)
    rows: list[set[tuple[int, ...]]] = [set() for _ in range(len(meetings))]
    for row in found.tolist():
        rows[row[0]].add(tuple(row[1:]))
    return [k for k in range(len(meetings)) if meetings.touching(k) - rows[k]]


def assert_touching(meetings: Meetings, separation: float) -> None:
    """Asserts, in exact arithmetic, that features touch at the chosen times."""
    assert all(contacts.distance_at(meetings, k) <= separation for k in range(len(meetings)))
    assert all(meetings.touching(k) for k in range(len(meetings)))


def found_contact(
    meetings: Meetings,
    moving: pgccd.MovingBodies,
    k: int,
    key: tuple[int, int, int],
    min_separation: float,
    tolerance: float | None = 0.0,
) -> tuple[torch.Tensor, ...] | None:
    """Result of the narrow phase for one feature pair: None, or the columns of its contact."""
    pairs = torch.tensor(meetings.pairs[k : k + 1])
    candidate = torch.tensor([[0, *key]], dtype=torch.int32)
    rows = pgccd.narrow.find_contacts(moving, pairs, candidate, "all", min_separation, tolerance=tolerance)
    return rows if len(rows[0]) else None


def candidates(
    bodies: pgccd.MovingBodies,
    pairs: torch.Tensor | None = None,
    min_separation: float = 0.0,
    horizon: list[float] | None = None,
) -> list[list[Key]]:
    """(kind, feature of i, feature of j) of each pair; fails on duplicates."""
    if pairs is None:
        pairs = torch.tensor([[0, 1]], device=bodies.device)
    until = None if horizon is None else torch.tensor(horizon, dtype=torch.float64, device=bodies.device)
    found, node_tests = pgccd.traverse.find_candidates(bodies, pairs, min_separation, horizon=until)
    assert found.dtype == torch.int32 and node_tests.shape == (1,)
    rows = [tuple(row) for row in found.tolist()]
    assert len(set(rows)) == len(rows), "a candidate is listed twice"
    return [[row[1:] for row in rows if row[0] == k] for k in range(len(pairs))]


def assert_all_there(found: list[Key], truth: Detection, until: float = 1.0) -> None:
    touching = {(c.kind, c.feature_a, c.feature_b) for c in truth.contacts if c.toi_upper <= until}
    assert touching - set(found) == set(), "missed"


def moving(bodies: Bodies, device: torch.device, path: str = "rigid") -> pgccd.MovingBodies:
    return pgccd.MovingBodies.of(bodies.scene(device), bodies.motion(path, device))
