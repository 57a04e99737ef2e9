"""Bodies that graze one another on arcs about their origins: no growth, deviation or rounding bound is too small."""

from __future__ import annotations

from dataclasses import replace
from fractions import Fraction

import numpy as np
import pytest
import torch
from strategies import contacts
from support.candidates import assert_touching, missed
from support.cases import few_and_many
from support.origins import STILL, about_z, all_contacts, moved_to, product, recentred, turn_of
from support.reports import detected
from support.shapes import Bodies, directions, tensors, tetrahedron, turned, unit_quaternions

import pgccd


def _grazing_spheres(
    reach: float, angle: float, when: float, gap: float, device: torch.device, path: str = "rigid"
) -> torch.Tensor:
    """Pairs found by the broad phase: a body on an arc of radius `reach` about the z axis, and one at rest at the first
    one's SBV position at time `when`, `gap` further from the axis.
    """
    turning = recentred(tetrahedron(), np.array([-reach, 0.0, 0.0]))
    resting = pgccd.Mesh(tetrahedron().vertices, tetrahedron().faces, "centroid")
    assert abs(turning.radius - 1.0) < 1e-12
    outward = np.array([np.cos(angle * when), np.sin(angle * when), 0.0])
    place = (reach + 2.0 + gap) * outward
    bodies = Bodies(
        [turning, resting],
        np.stack([np.zeros(3), place]),
        np.stack([STILL, STILL]),
        np.zeros((2, 3)),
        np.array([[0.0, 0.0, angle], [0.0, 0.0, 0.0]]),
    )
    moving = pgccd.MovingBodies.of(bodies.scene(device), bodies.motion(path, device))  # type: ignore[arg-type]
    found = [find(moving, tolerance=0.0) for find in (pgccd.broad.sweep, pgccd.broad.grid, pgccd.broad.lbvh)]
    assert torch.equal(found[0], found[1]) and torch.equal(found[0], found[2])
    return found[0]


@pytest.mark.parametrize("angle", [0.03, 0.1, 0.15])
@pytest.mark.parametrize("reach", [10.0, 1e3])
def test_swept_spheres_grow_by_the_sagitta(angle: float, reach: float, device: torch.device) -> None:
    """In the middle of the step the centre is angle^2 / 8 of the arc's radius (less angle^2 / 48 of that) from its
    chord, so a growth of 0.999 of it is too small.
    """
    sagitta = reach * 0.125 * angle**2
    assert len(_grazing_spheres(reach, angle, 0.5, -1e-6 * sagitta, device)) == 1
    assert len(_grazing_spheres(reach, angle, 0.5, 0.01 * sagitta, device)) == 0
    # On straight paths there is no deviation from the chord.
    assert len(_grazing_spheres(reach, angle, 0.5, -1e-6 * sagitta, device, "linear")) == 0


@pytest.mark.parametrize("reach", [10.0, 1e3])
def test_swept_spheres_grow_by_the_diameter_at_most(reach: float, device: torch.device) -> None:
    """After half a turn the centre is as far from its start and end as possible."""
    assert len(_grazing_spheres(reach, 2.0 * np.pi, 0.5, -1e-9, device)) == 1
    assert len(_grazing_spheres(reach, 2.0 * np.pi, 0.5, 1e-9, device)) == 0
    assert len(_grazing_spheres(reach, 40.0, np.pi / 40.0, -1e-9, device)) == 1


def test_swept_spheres_cover_the_rounding_of_positions(device: torch.device) -> None:
    """Where a position has no digits left for the centre's offset, centres are rounded by up to 2^-13."""
    rng = np.random.default_rng(2)
    count, place = 60, 2.0**40
    meshes, position, orientation = [], [], []
    for _ in range(count):
        size = rng.uniform(1.0, 1.001)
        offset = rng.uniform(0.2, 0.3)
        pair = [recentred(tetrahedron(size), np.array([-offset, 0.0, 0.0]))]
        distance = pair[0].radius + size * (1.0 + 2.0**-50) - 1e-7
        pair.append(
            recentred(tetrahedron(size), np.array([3.0 - float(pair[0].centre_offset[0]) - distance, 0.0, 0.0]))
        )
        meshes += pair
        position += [[place, 0.0, 0.0], [place + 3.0, 0.0, 0.0]]
        orientation += [STILL, STILL]
    scene = pgccd.Scene(meshes, device=device, world=torch.arange(count).repeat_interleave(2))
    x, q = tensors(np.array(position), np.array(orientation), device=device)
    moving = pgccd.MovingBodies.of(scene, pgccd.RigidMotion(x, q, x, q))
    rounded = moving.centre_t0[1::2, 0] - moving.centre_t0[::2, 0]
    assert float(rounded.max() - rounded.min()) > 1e-4
    for find in (pgccd.broad.sweep, pgccd.broad.grid, pgccd.broad.lbvh):
        assert find(moving)[:, 0].tolist() == list(range(0, 2 * count, 2))


def _exact_point(position: np.ndarray, quaternion: np.ndarray, point: np.ndarray) -> np.ndarray:
    """Position of a body point, as Fractions."""
    p, q, r = ([Fraction(float(c)) for c in row] for row in (position, quaternion, point))
    w, u = q[0], q[1:]
    size = w * w + sum(c * c for c in u)

    def cross(a: list[Fraction], b: list[Fraction]) -> list[Fraction]:
        return [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]

    once = cross(u, r)
    twice = cross(u, once)
    return np.array([p[k] + r[k] + 2 * (w * once[k] + twice[k]) / size for k in range(3)], dtype=object)


def test_swept_spheres_cover_the_rounding_of_centres(device: torch.device) -> None:
    """Spheres that touch by their exact centres; the computed centres are three ulps of their distance from the origin
    further apart.
    """
    rng = np.random.default_rng(6)
    link = recentred(tetrahedron(), -1e9 * directions(rng, 1)[0])
    ball = pgccd.Mesh(tetrahedron().vertices, tetrahedron().faces, "centroid")
    touching = link.radius + ball.radius
    tried, zero = unit_quaternions(rng, 400), np.zeros(3)
    x, q = tensors(np.zeros((400, 3)), tried)
    computed = pgccd.MovingBodies.of(
        pgccd.Scene([link], torch.zeros(400).long()), pgccd.RigidMotion(x, q, x, q)
    ).centre_t0
    position, orientation = [], []
    for at, centre in zip(tried, computed.numpy(), strict=True):
        exact = _exact_point(zero, at, link.centre_offset.numpy())
        error = np.array([float(Fraction(float(c)) - e) for c, e in zip(centre, exact, strict=True)])
        if np.linalg.norm(error) < 3.0 * 2.0**-53 * 1e9:
            continue
        back = error / np.linalg.norm(error)
        place = np.array([float(e - Fraction(touching * b)) for e, b in zip(exact, back, strict=True)])
        gap = sum((Fraction(float(p)) - e) ** 2 for p, e in zip(place, exact, strict=True))
        if gap <= Fraction(touching) ** 2:
            position += [zero, place]
            orientation += [at, STILL]
    assert len(position) > 10
    kinds = torch.arange(len(position)) % 2
    scene = pgccd.Scene([link, ball], kinds, device=device, world=torch.arange(len(position)) // 2)
    x, q = tensors(np.array(position), np.array(orientation), device=device)
    moving = pgccd.MovingBodies.of(scene, pgccd.RigidMotion(x, q, x, q))
    for find in (pgccd.broad.sweep, pgccd.broad.grid, pgccd.broad.lbvh):
        assert len(find(moving, tolerance=0.0)) == len(position) // 2, "missed"


@few_and_many("count", 50, 120)
@pytest.mark.parametrize("reach", [1e6, 1e9, 9e11])
@pytest.mark.parametrize("along", [False, True], ids=["resting", "screw"])
def test_nothing_is_missed_however_far_origins_are(reach: float, along: bool, device: torch.device, count: int) -> None:
    """Opposite tips at a distance below the separation by no more than the rounding of coordinates."""
    rng = np.random.default_rng([int(reach) % 1000, along])
    separation = 1e-3
    tip = tetrahedron().vertices.numpy()[0]
    meshes, position, orientation, rotation = [], [], [], []
    while len(meshes) < 2 * count:
        q = unit_quaternions(rng, 1)
        towards = turned(q, tip[None])[0]
        flip = np.cross(towards, directions(rng, 1)[0])
        flip /= np.linalg.norm(flip)
        orientations = np.stack([q[0], product(np.concatenate([[0.0], flip]), q[0])])
        away = np.stack([tip, tip]) if along else directions(rng, 2)
        pair = [recentred(tetrahedron(), reach * u) for u in away]
        tips = np.array([mesh.vertices.numpy()[0] for mesh in pair])
        first = -turned(orientations[:1], tips[:1])[0]
        here = _exact_point(first, orientations[0], tips[0])
        there = _exact_point(np.zeros(3), orientations[1], tips[1])
        second = np.array(
            [float(h + Fraction(separation * t) - o) for h, t, o in zip(here, towards, there, strict=True)]
        )
        gap = _exact_point(second, orientations[1], tips[1]) - here
        short = separation - float(sum(c * c for c in gap)) ** 0.5
        if not 0.0 < short < 4.0 * np.spacing(reach):
            continue
        meshes += pair
        position += [first, second]
        orientation += [*orientations]
        rotation += [towards, towards] if along else [np.zeros(3)] * 2
    x, q, w = tensors(np.array(position), np.array(orientation), np.array(rotation), device=device)
    world = torch.arange(count).repeat_interleave(2)
    scene = pgccd.Scene(meshes, device=device, world=world)
    motion = pgccd.RigidMotion.from_rotation(x, q, x, w)
    for report in ("any", "first"):
        hits = detected(scene, motion, report, separation, tolerance=0.0)
        assert hits.pairs[:, 0].tolist() == list(range(0, 2 * count, 2)), "missed"
    assert (hits.toi == 0.0).all()


@pytest.mark.parametrize("turn", [0.2, 1.0, 6.0, 20.0, 40.0])
def test_segments_of_a_fast_spin_follow_the_arc_about_the_origin(turn: float, device: torch.device) -> None:
    """Tips that pass within the separation half-way along one of the 64 segments, where the tip is furthest from its
    chord. The arc is so large that deviations computed from the body's own radius are far too small.
    """
    reach, separation = 1e5, 1e-2
    tip = tetrahedron().vertices.numpy()[0]
    outward = np.array([1.0, 0.0, 0.0])
    axis = np.cross(tip, outward)
    angle = np.arccos(tip @ outward)
    turned_tip = turn_of(angle * axis / np.linalg.norm(axis))  # puts the tip on the x axis
    corners = turned(np.tile(turned_tip, (4, 1)), tetrahedron().vertices.numpy())
    link = pgccd.Mesh(corners + [reach, 0.0, 0.0], tetrahedron().faces)
    other = pgccd.Mesh(corners * [-1.0, -1.0, 1.0], tetrahedron().faces, "centroid")
    for when in [(k + 0.5) / 64 for k in (1, 3, 6, 9)] + [0.5] * (turn < 2.0 * np.pi):
        at = turn * when
        direction = turned(about_z(at)[None], outward[None])[0]
        bodies = Bodies(
            [link, other],
            np.stack([np.zeros(3), (reach + 2.0 + separation - 1e-6) * direction]),
            np.stack([STILL, about_z(at)]),
            np.zeros((2, 3)),
            np.array([[0.0, 0.0, turn], [0.0, 0.0, 0.0]]),
        )
        hits = all_contacts(bodies, device, min_separation=separation, tolerance=0.0)
        found = hits.toi[(hits.toi - when).abs() < 1e-3]
        assert len(found), "missed"


@pytest.mark.parametrize("reach", [10.0, 1e3, 1e5])
def test_tips_graze_where_large_arcs_have_used_up_their_deviation(reach: float, device: torch.device) -> None:
    """Spindles that turn about points `reach` behind them, but travel back equally fast: near t = 1/2 their tips only
    bulge towards each other, by just less than a single segment's chord may deviate.
    """
    turn = np.sqrt(0.0798 / (reach + 1.0))
    meetings = contacts.tips(np.random.default_rng(5), 30, (turn, turn), time=np.full(30, 0.5))
    behind = [-reach * mesh.vertices.numpy()[0] for mesh in meetings.bodies.meshes]
    bodies = moved_to(meetings.bodies, behind)
    half_way = [product(turn_of(0.5 * w), q) for w, q in zip(bodies.rotation, bodies.orientation_t0, strict=True)]
    back = np.cross(bodies.rotation, turned(np.array(half_way), np.array(behind)))
    start, velocity = bodies.position_t0 - 0.5 * back, bodies.velocity + back
    meetings = replace(meetings, bodies=replace(bodies, position_t0=start, velocity=velocity))
    barely = 1e-14 * max(reach, 100.0)
    assert_touching(meetings, barely)
    assert missed(meetings, device, barely) == []
