"""Margins of the traversal: features that only just touch are candidates.

Contacts are constructed (strategies.contacts): at the chosen time the given features are within the separation by their
exact positions, so they must be listed; others may be.
"""

from __future__ import annotations

import numpy as np
import pytest
import torch
from strategies import contacts
from strategies.contacts import Meetings
from support.candidates import BARELY, assert_touching, missed, missed_among
from support.cases import few_and_many
from support.shapes import Bodies, directions, tensors, turned

import pgccd

# Rounding of the poses passed in; the margins tested here are thousands of times as wide.


@few_and_many("count", 24, 60)
@pytest.mark.parametrize("turn", [(0.2, 0.2), (1.0, 0.7), (0.0, 1.0), (1.0, 0.0), (3.0, 2.0)])
def test_tips_graze_on_arcs(device: torch.device, turn: tuple[float, float], count: int) -> None:
    """Each tip's arc bulges towards the other; the chords stay apart."""
    meetings = contacts.tips(np.random.default_rng([1, int(10 * turn[0])]), count, turn, speed=0.1)
    assert_touching(meetings, BARELY)
    assert missed(meetings, device, BARELY) == []


def test_tips_graze_in_the_middle_of_the_only_segment(device: torch.device) -> None:
    """Where the deviation from the chord reaches its bound up to fourth order."""
    for turn in (0.15, 0.2, 0.25):
        meetings = contacts.tips(np.random.default_rng(2), 20, (turn, turn), time=np.linspace(0.49, 0.51, 20))
        assert_touching(meetings, BARELY)
        assert missed(meetings, device, BARELY) == []


@few_and_many("count", 24, 60)
def test_tips_graze_on_arcs_too_long_for_the_segments(device: torch.device, count: int) -> None:
    """40 radians and a small partner: chords deviate further than segments are designed for."""
    for sizes in ((1.0, 1.0), (1.0, 0.125)):
        meetings = contacts.tips(np.random.default_rng(3), count, (40.0, 3.0), sizes=sizes)
        assert_touching(meetings, BARELY)
        assert missed(meetings, device, BARELY) == []


@few_and_many("count", 24, 60)
@pytest.mark.parametrize("turn", [(0.0, 0.0), (1.0, 0.5), (9.0, 7.0)])
def test_tips_graze_at_the_horizon(device: torch.device, turn: tuple[float, float], count: int) -> None:
    """They touch at the horizon, not before: features must be at their positions at the horizon."""
    meetings = contacts.tips(np.random.default_rng(4), count, turn, speed=2.0)
    assert_touching(meetings, BARELY)
    assert missed(meetings, device, BARELY, horizon=meetings.time) == []


def tilting_plates(rng: np.random.Generator, n: int, turn: float, size: float, at_end: bool) -> Meetings:
    """A plate turns about an axis in its plane. When the step begins or ends, a corner of it touches the tip of a speck
    that stands upright on the plate, on the side the corner comes from or goes to.
    """
    meshes, place, orientation, rotation = [], [], [], []
    for _ in range(n):
        sheet, speck = contacts.plate(8), contacts.spindle(0.125 * size, 3, length=size)
        if rng.random() < 0.5:  # reversed, so that normals point the other way
            sheet = pgccd.Mesh(sheet.vertices, sheet.faces.flip(1))
        corner = int(rng.choice([4, 36, 44, 76]))  # midpoints of the sides
        side = 1.0 if rng.random() < 0.5 else -1.0
        pose = contacts.leading(directions(rng, 1)[0], rng.uniform(0, 6))
        normal = turned(pose[None], np.array([[side, 0.0, 0.0]]))[0]
        arm = turned(pose[None], sheet.vertices.numpy()[corner][None])[0]
        # The corner leaves the speck when the step begins, or reaches it when it ends.
        axis = np.cross(arm, -normal if not at_end else normal)
        meshes += [sheet, speck]
        place.append(((corner,), (0,)))
        orientation += [pose, contacts.leading(-normal, rng.uniform(0, 6))]
        rotation += [turn * axis / np.linalg.norm(axis), np.zeros(3)]
    return contacts.meet(
        meshes,
        place,
        [([1.0], [1.0])] * n,
        np.array(orientation),
        np.array(rotation),
        np.zeros((2 * n, 3)),
        np.full(n, 1.0 if at_end else 0.0),
        np.zeros((n, 3)),
    )


@pytest.mark.parametrize("at_end", [False, True])
@pytest.mark.parametrize("turn", [0.1, 1.0, 3.0])
def test_plates_tilt(device: torch.device, turn: float, at_end: bool) -> None:
    """A slab is fixed over a segment; the plate in it moves."""
    meetings = tilting_plates(np.random.default_rng([5, int(10 * turn)]), 30, turn, 2.0**-7, at_end)
    assert_touching(meetings, BARELY)
    assert missed(meetings, device, BARELY) == []


def deforming(meetings: Meetings, growth: float = 0.0, device: torch.device | str = "cpu") -> pgccd.MovingBodies:
    """Bodies at rest as vertex streams in the world frame; at t1 the first of each pair is larger."""
    ends: list[list[np.ndarray]] = [[], []]
    for k, mesh in enumerate(meetings.bodies.meshes):
        x = mesh.vertices.numpy()
        for t in (0, 1):
            ends[t].append(x * (1.0 + growth * t * (1 - k % 2)) + meetings.bodies.position_t0[k])
    motion = pgccd.VertexMotion(*tensors(*(np.concatenate(e) for e in ends), device=device))
    return pgccd.MovingBodies.of(meetings.bodies.scene(device), motion)


SEPARATIONS = (0.0, 2.0**-10, 0.25, 1.0, 16.0)


@pytest.mark.parametrize("kind", ["tips", "face", "edges"])
@pytest.mark.parametrize("separation", SEPARATIONS)
def test_bodies_rest_exactly_at_the_separation(device: torch.device, kind: str, separation: float) -> None:
    rng = np.random.default_rng([6, int(1024 * separation)])
    for _ in range(12):
        meetings = contacts.resting(rng, kind, separation)
        assert_touching(meetings, separation)
        for path in ("rigid", "linear"):
            assert missed(meetings, device, separation, path=path) == []
        assert missed_among(meetings, deforming(meetings, device=device), separation) == []


@pytest.mark.parametrize("kind", ["tips", "face", "edges"])
def test_bodies_rest_exactly_at_separation_and_tolerance(device: torch.device, kind: str) -> None:
    """Contacts within separation plus tolerance may be reported by the narrow phase, so they must be candidates."""
    rng = np.random.default_rng(7)
    for separation, tolerance in ((0.0, 0.5), (0.5, 0.25), (0.25, 2.0)):
        meetings = contacts.resting(rng, kind, separation + tolerance)
        assert missed(meetings, device, separation, tolerance) == []
        assert missed_among(meetings, deforming(meetings, device=device), separation, tolerance) == []


@pytest.mark.parametrize("level", [1, 2, 3, 4])
def test_tips_of_cones_touch(device: torch.device, level: int) -> None:
    """Their spheres touch at the tips too, as do the nodes that contain them."""
    rng = np.random.default_rng([8, level])
    for width in (0.001, 0.01, 0.05, 0.2):
        meetings = contacts.tips(rng, 20, width=width, level=level)
        assert_touching(meetings, BARELY)
        assert missed(meetings, device, BARELY) == []


@pytest.mark.parametrize("inside_out", [False, True])
@pytest.mark.parametrize("separation", [0.0, 1.0])
def test_tip_of_a_cone_on_a_pyramid(device: torch.device, separation: float, inside_out: bool) -> None:
    """A flat pyramid fills its nodes' slabs up to its tip, where it touches the tip of a slender cone."""
    rng = np.random.default_rng(9)
    meshes, place, orientation = [], [], []
    n = 40
    along = directions(rng, n)
    for k in range(n):
        flat = contacts.spindle(float(rng.uniform(2.0, 8.0)), int(rng.integers(1, 4)))
        if inside_out:
            flat = pgccd.Mesh(flat.vertices, flat.faces.flip(1))
        slender = contacts.spindle(0.01, int(rng.integers(1, 4)))
        meshes += [flat, slender] if k % 2 else [slender, flat]
        place.append(((0,), (0,)))
        orientation += [contacts.leading(way * along[k], rng.uniform(0, 6)) for way in (1.0, -1.0)]
    still = np.zeros((2 * n, 3))
    meetings = contacts.meet(
        meshes, place, [([1.0], [1.0])] * n, np.array(orientation), still, still, np.zeros(n), separation * along
    )
    assert_touching(meetings, separation + BARELY)
    assert missed(meetings, device, separation + BARELY) == []


@few_and_many("count", 100, 300)
def test_rounding_in_the_local_frame(device: torch.device, count: int) -> None:
    """Tips at random places touch at zero distance: only the float32 margin covers them."""
    rng = np.random.default_rng(10)
    meetings = contacts.tips(rng, count, speed=0.5, sizes=(1.0, 0.7))
    assert_touching(meetings, 1e-15)
    assert missed(meetings, device, 1e-15) == []
    still = contacts.tips(rng, count, sizes=(1.0, 0.7))
    assert missed(still, device, 1e-15, path="linear") == []
    # The same shapes vertex by vertex, with bitwise equal tips.
    bodies, world = still.bodies, []
    for k, mesh in enumerate(bodies.meshes):
        quaternions = np.tile(bodies.orientation_t0[k], (len(mesh.vertices), 1))
        world.append(turned(quaternions, mesh.vertices.numpy()) + bodies.position_t0[k])
        if k % 2:
            world[k][0] = world[k - 1][0]
    x = np.concatenate(world)
    moved = pgccd.MovingBodies.of(bodies.scene(device), pgccd.VertexMotion(*tensors(x, x, device=device)))
    assert missed_among(still, moved, 0.0) == []
    # Vertices with ways of their own, on which the tips meet at the horizon.
    way = 0.05 * rng.normal(size=x.shape)
    moved = pgccd.MovingBodies.of(
        bodies.scene(device), pgccd.VertexMotion(*tensors(x - 5.0 * way, x + 3.0 * way, device=device))
    )
    assert missed_among(still, moved, 0.0, horizon=np.full(count, 0.625)) == []


@pytest.mark.parametrize("horizon", [0.25, 0.5, 0.75])
@pytest.mark.parametrize("growth", [1.0, 7.0])
def test_growing_bodies_touch_at_the_horizon(device: torch.device, horizon: float, growth: float) -> None:
    """Dyadic numbers: the growing tip reaches the other one exactly at the horizon."""
    rng = np.random.default_rng(11)
    for _ in range(20):
        meetings = contacts.resting(rng, "tips", growth * horizon)
        moved = deforming(meetings, growth, device)
        assert missed_among(meetings, moved, 0.0, horizon=np.array([horizon])) == []


@pytest.mark.parametrize("horizon", [0.25, 0.5, 0.75])
def test_travelling_bodies_touch_at_the_horizon(device: torch.device, horizon: float) -> None:
    rng = np.random.default_rng(12)
    for _ in range(20):
        meetings = contacts.resting(rng, "tips", 4.0 * horizon)
        way = meetings.bodies.position_t0[1] / np.linalg.norm(meetings.bodies.position_t0[1])
        start = [
            m.vertices.numpy() + x for m, x in zip(meetings.bodies.meshes, meetings.bodies.position_t0, strict=True)
        ]
        end = [start[0] + 4.0 * way, start[1]]
        motion = pgccd.VertexMotion(*tensors(np.concatenate(start), np.concatenate(end), device=device))
        moved = pgccd.MovingBodies.of(meetings.bodies.scene(device), motion)
        assert missed_among(meetings, moved, 0.0, horizon=np.array([horizon])) == []


@pytest.mark.parametrize("horizon", [0.25, 0.5, 0.75])
def test_bodies_that_shrink_as_they_travel_touch_at_the_horizon(device: torch.device, horizon: float) -> None:
    """At the end of the step the travelling body would be too short, were it where it is at the horizon."""
    rng = np.random.default_rng(13)
    for _ in range(20):
        meetings = contacts.resting(rng, "tips", 4.0 * horizon)
        place = meetings.bodies.position_t0
        way = place[1] / np.linalg.norm(place[1])
        start = [m.vertices.numpy() + x for m, x in zip(meetings.bodies.meshes, place, strict=True)]
        ahead = (start[0] - start[0].mean(axis=0)) @ way
        travel = 4.0 + 2.0**-30 + 0.5 * ahead.max()
        end = [start[0] + (travel - 0.5 * ahead)[:, None] * way, start[1]]
        motion = pgccd.VertexMotion(*tensors(np.concatenate(start), np.concatenate(end), device=device))
        moved = pgccd.MovingBodies.of(meetings.bodies.scene(device), motion)
        assert missed_among(meetings, moved, 0.0, horizon=np.array([horizon])) == []


def test_triangles_without_a_direction(device: torch.device) -> None:
    """A triangle whose squared normal underflows to zero still has a normal, which certifies nothing."""
    size = 2.0**-44
    speck = size * np.array([[0.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]])
    far = contacts.spindle(0.25, 1).vertices.numpy()
    faces = contacts.spindle(0.25, 1).faces.numpy()
    mesh = pgccd.Mesh(np.concatenate([far - [2.0, 0.0, 0.0], speck]), np.concatenate([faces, [[6, 7, 8]]]))
    wall = contacts.plate(4)
    distance = 0.125
    place = mesh.origin.numpy() - [distance, 0.0, 0.0]
    for way in (1.0, -1.0):
        bodies = Bodies(
            [mesh, wall],
            np.array([place, np.zeros(3)]) * [way, 1.0, 1.0],
            np.array([contacts.leading(np.array([way, 0.0, 0.0])), [1.0, 0.0, 0.0, 0.0]]),
            np.zeros((2, 3)),
            np.zeros((2, 3)),
        )
        meetings = Meetings(bodies, np.zeros(1), [((6,), (12,))])
        assert contacts.distance_at(meetings, 0) <= distance + BARELY
        assert missed(meetings, device, distance + BARELY) == []
