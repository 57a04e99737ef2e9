"""Grains beside triangles 10^8 to 7 10^10 times as large: in double precision such a triangle's coordinates leave a
distance uncertain by more than a tolerance of the grain's size.
"""

from __future__ import annotations

from dataclasses import replace
from fractions import Fraction
from typing import Literal

import numpy as np
import pytest
import torch
from oracle.intersection import have_common_point
from strategies import contacts
from strategies.contacts import Meetings
from support.candidates import found_contact
from support.cases import few_and_many
from support.shapes import Bodies, tensors, turned, unit_quaternions

import pgccd

Path = Literal["rigid", "linear"]
KINDS = pytest.mark.parametrize("kind", ["face", "edges"])
SIZES = pytest.mark.parametrize("size", [2.0**27, 2.0**36])
TURNS = pytest.mark.parametrize("turn", [0.0, 1.0, 30.0])
PATHS = pytest.mark.parametrize("path", ["rigid", "linear"])


def ground(kind: str, size: float) -> pgccd.Mesh:
    """A triangle with the origin on its face ("face") or on its edge (0, 1) ("edges")."""
    corners = [[-1.0, -1.0, 0.0], [1.0, -1.0, 0.0], [0.0, 2.0, 0.0]]
    if kind == "edges":
        corners = [[-1.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, -1.0, 0.0]]
    return pgccd.Mesh(size * np.array(corners), [[0, 1, 2]], (0.0, 0.0, 0.0))


def grains(
    rng: np.random.Generator,
    n: int,
    kind: str,
    size: float,
    turn: float = 0.0,
    gap: float = 0.0,
    speed: float = 0.0,
    time: float = 0.5,
    scale: float = 1.0,
) -> Meetings:
    """Triangles at rest, every second one with axes of its own, and grains of about unit size: at `time` a grain's tip
    or edge is `gap` away from the triangle's face or edge. It is further away at all other times if the grain turns
    (by `turn` in the step) but does not approach. All lengths are multiplied by `scale`.
    """
    orientation, towards = np.empty((2 * n, 4)), np.empty((n, 3))
    for k in range(n):
        orientation[2 * k] = unit_quaternions(rng, 1)[0] if k % 2 else contacts.IDENTITY
        axes = turned(np.tile(orientation[2 * k], (3, 1)), np.eye(3))
        towards[k] = axes[2] if kind == "face" else axes[1]
        # Edges cross at an angle of at least half a radian.
        across = turned(contacts.leading(-towards[k])[None], np.array([[0.0, 0.0, 1.0]]))[0]
        angle = np.arctan2(np.cross(across, axes[0]) @ -towards[k], across @ axes[0])
        orientation[2 * k + 1] = contacts.leading(-towards[k], angle + rng.uniform(0.5, 2.5))
    rotation, velocity = np.zeros((2 * n, 3)), np.zeros((2 * n, 3))
    rotation[1::2] = turn * turned(orientation[1::2], np.tile([0.0, 0.0, 1.0], (n, 1)))
    velocity[1::2] = -scale * speed * towards
    grain = contacts.spindle(0.5, 1) if kind == "face" else contacts.wedge()
    return contacts.meet(
        [ground(kind, scale * size), pgccd.Mesh(scale * grain.vertices.numpy(), grain.faces)] * n,
        [((0, 1, 2), (0,)) if kind == "face" else ((0, 1), (0, 1))] * n,
        [([1 / 3] * 3, [1.0]) if kind == "face" else ([0.5, 0.5], [0.5, 0.5])] * n,
        orientation,
        rotation,
        velocity,
        np.full(n, time),
        scale * gap * towards,
        scale * rng.normal(size=(n, 3)),
    )


def exchanged(meetings: Meetings) -> Meetings:
    """With the bodies of each pair exchanged."""
    b = meetings.bodies
    order = meetings.pairs[:, ::-1].ravel()
    columns = (c[order] for c in (b.position_t0, b.orientation_t0, b.velocity, b.rotation))
    bodies = Bodies([b.meshes[k] for k in order], *columns)
    return replace(meetings, bodies=bodies, place=[(second, first) for first, second in meetings.place])


def first_contacts(meetings: Meetings, path: Path, device: torch.device) -> pgccd.Contacts:
    """With the default tolerance, by the whole pipeline."""
    bodies = meetings.bodies
    world = torch.arange(len(meetings)).repeat_interleave(2)
    scene = pgccd.Scene(bodies.meshes, device=device, world=world)
    return pgccd.detect(scene, bodies.motion(path, device), "first")


@KINDS
@SIZES
@TURNS
@PATHS
@pytest.mark.parametrize("scale", [1.0, 1e-4])
def test_ten_tolerances_away_is_free(
    kind: str, size: float, turn: float, path: Path, scale: float, device: torch.device
) -> None:
    """The nearest point comes to ten tolerances, neither to one nor to the noise of the triangle's coordinates."""
    time = 1.0 if path == "linear" else 0.5  # on a chord the ends are nearest
    meetings = grains(np.random.default_rng(1), 6, kind, size, turn, 1.2e-5, time=time, scale=scale)
    for pairs in (meetings, exchanged(meetings)):
        assert len(first_contacts(pairs, path, device)) == 0


@KINDS
@SIZES
@TURNS
@PATHS
def test_contacts_come_within_the_tolerance(
    kind: str, size: float, turn: float, path: Path, device: torch.device
) -> None:
    """A grain that approaches is met before it passes, within a tolerance of its own size."""
    speed, time = 4.0, 0.5
    if path == "linear" and turn > 0.0:
        turn, time = 1.0, 1.0
    meetings = grains(np.random.default_rng(2), 6, kind, size, turn, speed=speed, time=time)
    tolerance = 1e-6 * meetings.bodies.meshes[1].radius
    for pairs in (meetings, exchanged(meetings)):
        hits = first_contacts(pairs, path, device)
        assert hits.status.tolist() == [pgccd.Status.TOUCH] * 6
        early = speed * (time - hits.toi)
        assert float(early.min()) >= -1e-14 and float(early.max()) <= tolerance


@KINDS
@SIZES
@TURNS
@few_and_many("count", 8, 20)
def test_contacts_at_exactly_the_separation(kind: str, size: float, turn: float, count: int) -> None:
    """Grains that just come within it are found, not late; those that do not turn are free at a separation smaller by
    2 10^-27 of the triangle's size.
    """
    meetings = grains(np.random.default_rng(3), count, kind, size, turn, 0.25)
    for k in range(len(meetings)):
        distance = contacts.distance_at(meetings, k)
        least, less = contacts.least_separation(distance), float(np.nextafter(float(distance - 2e-27 * size), 0.0))
        (key,) = meetings.touching(k)
        for path in PATHS.args[1] if turn == 0.0 else ["rigid"]:
            moving = pgccd.MovingBodies.of(meetings.bodies.scene(), meetings.bodies.motion(path))
            rows = found_contact(meetings, moving, k, key, least)
            assert rows is not None and float(rows[4]) <= meetings.time[k], f"pair {k} is missed or late"
            if turn == 0.0:
                assert found_contact(meetings, moving, k, key, less) is None, f"pair {k} is free"


def nearly_unit(rng: np.random.Generator) -> np.ndarray:
    """Integers (4,) whose squares have a sum next to 2^12: divided by 2^6, a quaternion of rational rotation."""
    while True:
        q = rng.integers(-60, 61, 4)
        if 0 < abs(int(q @ q) - 2**12) < 5:
            return q


def integer_rotation(q: np.ndarray) -> np.ndarray:
    """The rotation matrix times |q|^2, as Python integers."""
    w, x, y, z = (int(c) for c in q)
    rows = [
        [w * w + x * x - y * y - z * z, 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), w * w - x * x + y * y - z * z, 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), w * w - x * x - y * y + z * z],
    ]
    return np.array(rows, dtype=object)


def test_tiny_features_far_from_the_origins_of_bodies_at_rest() -> None:
    """Integer coordinates: a tip above a triangle, a million times their size from the origin of both bodies. Rotations
    of that distance are inexact in every precision, by more than the features' own size adds to the noise.
    """
    rng = np.random.default_rng(4)
    for k in range(60):
        turns = [nearly_unit(rng) for _ in range(2)]
        sizes = [int(q @ q) for q in turns]
        unit = sizes[0] * sizes[1]
        far = np.array([int(c) for c in rng.integers(-(2**20), 2**20, 3)], dtype=object)
        features = ([[-1, -1, 0], [2, -1, 0], [-1, 2, 0]], [[0, 0, 1], [1, 0, 3], [0, 1, 3]])
        meshes = []
        for q, size, corners in zip(turns, sizes, features, strict=True):
            points = [(far + np.array(corner, dtype=object)) * (unit // size) for corner in corners]
            own = [integer_rotation(q).T @ point for point in points]  # world coordinates: times `unit`
            meshes.append(pgccd.Mesh(np.array(own, dtype=np.float64), [[0, 1, 2]], (0.0, 0.0, 0.0)))
        still = np.zeros((2, 3))
        bodies = Bodies(meshes, still, np.array(turns) / 64.0, still, still)
        meetings = Meetings(bodies, np.zeros(1), [((0, 1, 2), (0,))])
        assert abs(contacts.distance_at(meetings, 0) - unit) < 1e-30  # in 50 digits; exactly so
        moving = pgccd.MovingBodies.of(bodies.scene(), bodies.motion("linear"))
        key = (pgccd.Kind.VF_BA, 0, 0)
        assert found_contact(meetings, moving, 0, key, float(unit)) is not None, f"pair {k} is missed"
        assert found_contact(meetings, moving, 0, key, float(np.nextafter(unit, 0.0))) is None, f"pair {k} is free"


def exactly_placed(offsets: np.ndarray, position: np.ndarray, orientation: np.ndarray) -> np.ndarray:
    """(V, 3) vertices in the world, as fractions, of a body whose vertices have these offsets from its origin."""
    w, x, y, z = (Fraction(c) for c in orientation.tolist())
    rows = [
        [w * w + x * x - y * y - z * z, 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), w * w - x * x + y * y - z * z, 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), w * w - x * x - y * y + z * z],
    ]
    matrix = np.array(rows, dtype=object) / (w * w + x * x + y * y + z * z)
    fractions = np.vectorize(Fraction, otypes=[object])
    return fractions(offsets) @ matrix.T + fractions(position)


@pytest.mark.parametrize(
    ("size", "grain_size", "origin"), [(6.4e6, 1e-4, 0.0), (1.0, 1.0, 2.0**39)], ids=["large face", "far origin"]
)
def test_starts_that_cross_by_less_than_rounding(
    device: torch.device, size: float, grain_size: float, origin: float
) -> None:
    """A corner on either side of a face, by far less than the rounding of the points in double: where it is through,
    only the edges from it meet the face.
    """
    rng = np.random.default_rng([7, int(origin)])
    found, expected = [], []
    for _ in range(80):
        surfaces = [size * rng.normal(size=(3, 3)), grain_size * rng.normal(size=(3, 3))]
        if origin:
            surfaces = [np.round(x * 2.0**12) / 2.0**12 for x in surfaces]  # exact offsets from the origin
        meshes = [pgccd.Mesh(x, [[0, 1, 2]], origin=(origin, 0.0, 0.0)) for x in surfaces]
        offsets = [x - np.array([origin, 0.0, 0.0]) for x in surfaces]
        q, position = unit_quaternions(rng, 2), np.zeros((2, 3))
        face, grain = (exactly_placed(offsets[k], position[k], q[k]) for k in (0, 1))
        weights = np.array([Fraction(float(c)) for c in rng.dirichlet([3.0, 3.0, 3.0])])
        normal = np.cross(*(face[1:] - face[0]).astype(float))
        heights = (grain[1:] - grain[0]).astype(float) @ normal
        if heights[0] * heights[1] <= 0:
            continue
        away = np.sign(heights[0]) * normal / np.linalg.norm(normal)
        depth = rng.choice([-1.0, 1.0]) * 10.0 ** rng.uniform(-17, -15) * max(size, origin)
        position[1] = (weights @ face / weights.sum() - grain[0]).astype(float) - depth * away
        placed = np.concatenate([exactly_placed(offsets[k], position[k], q[k]) for k in (0, 1)])
        whole = int(np.lcm.reduce([c.denominator for c in placed.ravel()]))
        corners = np.array([[int(c * whole) for c in x] for x in placed], dtype=object)
        expected.append(bool(have_common_point(corners[None, :3], corners[None, 3:])[0]))
        motion = pgccd.RigidMotion.at_rest(*tensors(position, q, device=device))
        found.append(len(pgccd.collide(pgccd.Scene(meshes, device=device), motion, tolerance=0.0)) > 0)
    assert 10 < sum(expected) < len(expected) - 10
    assert found == expected
