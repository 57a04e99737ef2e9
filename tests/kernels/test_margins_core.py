"""Rotations: a quaternion slightly off unit length is exactly the rotation of its direction."""

from __future__ import annotations

from dataclasses import replace
from typing import Literal

import numpy as np
import pytest
from strategies import contacts
from strategies.contacts import Meetings
from support.candidates import BARELY, assert_touching, found_contact, missed
from support.shapes import directions

import pgccd


def off_unit(meetings: Meetings, factor: float) -> Meetings:
    """The same for the oracle, which normalises: every second quaternion is too long or too short."""
    orientation = meetings.bodies.orientation_t0.copy()
    orientation[::2] *= factor
    return replace(meetings, bodies=replace(meetings.bodies, orientation_t0=orientation))


@pytest.mark.parametrize("factor", [1.0 - 9e-4, 1.0 + 9e-4])
@pytest.mark.parametrize("path", ["rigid", "linear"])
def test_quaternions_that_are_not_quite_unit(path: Literal["rigid", "linear"], factor: float) -> None:
    """Tips that meet head on are not reported late, and tips that stop short do not touch."""
    rng = np.random.default_rng(1)
    n = 20
    along = directions(rng, n)
    turn = 0.3 if path == "rigid" else 0.0
    axes = np.cross(along, directions(rng, n))
    velocity = np.zeros((n, 2, 3))
    velocity[:, 0] = along
    meetings = contacts.meet(
        [contacts.spindle() for _ in range(2 * n)],
        [((0,), (0,))] * n,
        [([1.0], [1.0])] * n,
        np.array([contacts.leading(way * d, rng.uniform(0, 6)) for d in along for way in (1.0, -1.0)]),
        np.repeat(turn * axes, 2, axis=0) * np.tile([[1.0], [0.0]], (n, 1)),
        velocity.reshape(-1, 3),
        rng.uniform(0.3, 0.9, n),
        np.zeros((n, 3)),
    )
    meetings = off_unit(meetings, factor)
    assert_touching(meetings, BARELY)
    assert missed(meetings, "cpu", BARELY, path=path) == []  # type: ignore[arg-type]
    moving = pgccd.MovingBodies.of(meetings.bodies.scene(), meetings.bodies.motion(path))
    for k in range(n):
        for key in meetings.touching(k):
            rows = found_contact(meetings, moving, k, key, BARELY, 1e-9)
            assert rows is not None and float(rows[4]) <= meetings.time[k], "missed or late"
            assert float(rows[4]) > meetings.time[k] - 1e-6, "early"
