"""Margins of the narrow phase on rigid bodies, candidate by candidate: contacts exactly at the limit of being reported,
their positions, and which of several equal ones is the first.
"""

from __future__ import annotations

import numpy as np
import pytest
import torch
from strategies import contacts
from strategies.contacts import Meetings
from strategies.motions import product
from support.candidates import found_contact
from support.cases import few_and_many
from support.shapes import Bodies, directions, turned, unit_quaternions

import pgccd


def specks(rng: np.random.Generator, n: int, turns: int, size: float, reach: float) -> Meetings:
    """Bodies of unit size in one place, with a tiny triangle each, far from their centres. At the end of the step,
    after `turns` whole turns, a corner of one triangle is nearest to the other, above its middle; at the start it was
    further away by about the triangles' size. The bodies turn about points `reach` away.
    """
    frame = contacts.spindle(0.5, 1)
    tip = np.array([[0.0, 0.0, 0.0], [0.25, -1.0, -0.5], [-0.5, -1.0, 0.25]]) * size + [1.5, 0.0, 0.0]
    flat = np.array([[-1.0, 0.0, -1.0], [2.0, 0.0, -1.0], [-1.0, 0.0, 2.0]]) * size + [1.5, 0.0, 0.0]
    meshes = [
        pgccd.Mesh(
            np.concatenate([frame.vertices.numpy(), x]) + [reach, 0.0, 0.0],
            np.concatenate([frame.faces.numpy(), [[6, 7, 8]]]),
        )
        for x in (tip, flat)
    ]
    orientation = np.repeat(unit_quaternions(rng, n), 2, axis=0)
    normal = turned(orientation[::2], np.tile([0.0, 1.0, 0.0], (n, 1)))
    rotation = 2 * np.pi * turns * directions(rng, 2 * n) + 1e-3 * size * rng.normal(size=(2 * n, 3))
    velocity = np.zeros((n, 2, 3))
    velocity[:, 0] = size * normal
    return contacts.meet(
        meshes * n,
        [((6,), (6, 7, 8))] * n,
        [([1.0], [1 / 3, 1 / 3, 1 / 3])] * n,
        orientation,
        rotation,
        velocity.reshape(-1, 3),
        np.ones(n),
        0.25 * size * normal,
    )


@few_and_many("count", 12, 30)
@pytest.mark.parametrize("reach", [0.0, 1e3])
@pytest.mark.parametrize("turns", [0, 1000, 100_000])
def test_tiny_features_far_from_their_origins(turns: int, reach: float, count: int) -> None:
    """Their precision is that of their distance from the origin and of the angle."""
    size = (1e-5 if turns else 1e-9) * max(1.0, reach)
    meetings = specks(np.random.default_rng([9, turns]), count, turns, size, reach)
    moving = pgccd.MovingBodies.of(meetings.bodies.scene(), meetings.bodies.motion("linear"))
    for k in range(len(meetings)):
        (key,) = meetings.touching(k)
        least = contacts.least_separation(contacts.distance_at(meetings, k))
        assert found_contact(meetings, moving, k, key, least) is not None, f"pair {k} is missed"


@pytest.mark.parametrize("turn", [(0.5, 0.5), (2.0, 0.0), (0.0, 2.0), (9.0, 5.0)])
def test_tips_graze_on_arcs(turn: tuple[float, float]) -> None:
    """They touch when they are nearest, at exactly the separation."""
    meetings = contacts.tips(np.random.default_rng(10), 12, turn, gap=2.0**-6)
    moving = pgccd.MovingBodies.of(meetings.bodies.scene(), meetings.bodies.motion())
    for k in range(len(meetings)):
        least = contacts.least_separation(contacts.distance_at(meetings, k))
        for key in meetings.touching(k):
            rows = found_contact(meetings, moving, k, key, least)
            assert rows is not None and float(rows[4]) <= meetings.time[k], f"pair {k}, {key}"


def bulging(rng: np.random.Generator, n: int, which: int, size: float = 1e-3) -> Meetings:
    """Crossed edges, one of which turns about an axis parallel to it and meets the other head on, so fast that they
    touch in the middle of the first time window: there the arc deviates from its chord by the maximum that is allowed
    for.
    """
    turn = 0.2
    window = np.sqrt(2.0 * size) / turn  # over it, a gap of that size is four deviations
    speed = 6.0 * (turn * window) ** 2 / 8.0 / window
    along = directions(rng, n)
    orientation = []
    for d in along:
        first = contacts.leading(d, rng.uniform(0, 6))
        # The second faces the first and lies across it: half a turn about the bisector of y and z.
        orientation += [first, product(first, np.array([0.0, 0.0, 0.5**0.5, 0.5**0.5]))]
    rotation = np.zeros((n, 2, 3))
    for k in range(n):
        own = orientation[2 * k + which]
        rotation[k, which] = turn * turned(own[None], np.array([[0.0, 0.0, 1.0]]))[0]
    velocity = np.zeros((n, 2, 3))
    velocity[:, 0] = speed * along
    return contacts.meet(
        [contacts.wedge(0.25) for _ in range(2 * n)],
        [((0, 1), (0, 1))] * n,
        [([0.5, 0.5], [0.5, 0.5])] * n,
        np.array(orientation),
        rotation.reshape(-1, 3),
        velocity.reshape(-1, 3),
        np.full(n, 0.5 * window),
        np.zeros((n, 3)),
    )


@pytest.mark.parametrize("which", [0, 1])
def test_arcs_are_not_late(which: int) -> None:
    """At the time when the arc deviates from its chord by the window's maximum."""
    meetings = bulging(np.random.default_rng(11), 12, which)
    moving = pgccd.MovingBodies.of(meetings.bodies.scene(), meetings.bodies.motion())
    for k in range(len(meetings)):
        (key,) = meetings.touching(k)
        assert key[0] == pgccd.Kind.EE
        assert contacts.distance_at(meetings, k) <= 1e-12
        rows = found_contact(meetings, moving, k, key, 1e-12)
        assert rows is not None and float(rows[4]) <= meetings.time[k], f"pair {k}: late"


def test_contacts_come_within_the_tolerance() -> None:
    """On arcs, coming within the tolerance is a contact; by default it is relative to the smaller body."""
    rng = np.random.default_rng(12)
    for apart, tolerance, expected in ((0.5, 0.4, False), (0.5, 16.0, True), (2e-5, None, False), (2e-9, None, True)):
        meetings = contacts.tips(rng, 4, gap=apart, sizes=(1.0, 1024.0))
        moving = pgccd.MovingBodies.of(meetings.bodies.scene(), meetings.bodies.motion())
        for k in range(4):
            key = min(meetings.touching(k))
            assert (found_contact(meetings, moving, k, key, 0.0, tolerance) is not None) == expected, (apart, tolerance)


# Positions of contacts.


def swapped(meetings: Meetings) -> Meetings:
    """The pairs with their bodies exchanged."""
    b = meetings.bodies
    order = meetings.pairs[:, ::-1].ravel()
    columns = (c[order] for c in (b.position_t0, b.orientation_t0, b.velocity, b.rotation))
    bodies = Bodies([b.meshes[k] for k in order], *columns)
    return Meetings(bodies, meetings.time, [(second, first) for first, second in meetings.place])


@pytest.mark.parametrize("kind", ["face", "edges"])
@pytest.mark.parametrize("is_swapped", [False, True])
def test_normals_of_bodies_in_touch(kind: str, is_swapped: bool) -> None:
    """Without a gap, the normal still points from the first body to the second."""
    rng = np.random.default_rng(13)
    for _ in range(12):
        meetings = contacts.resting(rng, kind, 0.0)
        if is_swapped:
            meetings = swapped(meetings)
        (key,) = meetings.touching(0)
        assert key[0] == (pgccd.Kind.EE if kind == "edges" else (pgccd.Kind.VF_BA if is_swapped else pgccd.Kind.VF_AB))
        for path in ("rigid", "linear"):
            moving = pgccd.MovingBodies.of(meetings.bodies.scene(), meetings.bodies.motion(path))  # type: ignore[arg-type]
            rows = found_contact(meetings, moving, 0, key, 0.0)
            assert rows is not None
            between = meetings.bodies.position_t0[1] - meetings.bodies.position_t0[0]
            axis = int(np.argmax(np.abs(between)))
            assert np.array_equal(rows[7].numpy()[0], np.sign(between[axis]) * np.eye(3)[axis])


@pytest.mark.parametrize("is_swapped", [False, True])
def test_normals_where_rounding_makes_the_gap(is_swapped: bool) -> None:
    """A gap of a few roundings has no direction; the normal is taken from the features."""
    rng = np.random.default_rng(14)
    n = 60
    along, weights = directions(rng, n), np.full(3, 1 / 3)
    orientation = np.array([contacts.leading(way * d, rng.uniform(0, 6)) for d in along for way in (1.0, -1.0)])
    still = np.zeros((2 * n, 3))
    meetings = contacts.meet(
        [contacts.spindle(0.25, 2), contacts.plate(4)] * n,
        [((0,), (6, 7, 12))] * n,
        [([1.0], weights)] * n,
        orientation,
        still,
        still,
        np.zeros(n),
        np.zeros((n, 3)),
    )
    if is_swapped:
        meetings, along = swapped(meetings), -along
    moving = pgccd.MovingBodies.of(meetings.bodies.scene(), meetings.bodies.motion())
    for k in range(n):
        (key,) = meetings.touching(k)
        rows = found_contact(meetings, moving, k, key, 1e-14)
        assert rows is not None and rows[7].numpy()[0] @ along[k] > 0.999999, f"pair {k}"


def test_ties_in_a_lattice() -> None:
    """Cubes in full contact: among equally early contacts the first in order is reported."""
    bodies = contacts.lattice(3)
    scene, motion = bodies.scene(), bodies.motion()
    every, first = (pgccd.detect(scene, motion, report) for report in ("all", "first"))
    assert (every.toi == 0).all() and len(first) >= 54
    order = torch.cat([every.pairs, every.kind[:, None].long(), every.features.long()], dim=1).tolist()
    assert order == sorted(order)
    expected: dict[tuple[int, int], list[int]] = {}
    for i, j, *row in order:
        expected.setdefault((i, j), row)
    reported = torch.cat([first.kind[:, None].long(), first.features.long()], dim=1).tolist()
    assert dict(zip(map(tuple, first.pairs.tolist()), reported, strict=True)) == expected
