"""Pairs of bodies that touch at a chosen time and place and go no deeper: grazing, resting, tip to tip.

Random bodies almost never graze. Here the time and place of contact are chosen first and the poses follow from them, so
that the features named are `gap` apart at that time, to rounding. The exact distance of the rounded poses is computed
from the result (`distance_at`). All generators take a NumPy generator.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import dataclass
from fractions import Fraction

import mpmath
import numpy as np
from oracle import rigid
from oracle.distance import squared_distance_exact
from support.shapes import Bodies, directions

import pgccd

from .motions import product

Key = tuple[int, int, int]
IDENTITY = np.array([1.0, 0.0, 0.0, 0.0])
X = np.array([1.0, 0.0, 0.0])


@dataclass(frozen=True)
class Meetings:
    """n pairs of bodies that touch at time[k]; pair k is bodies 2 k and 2 k + 1.

    `place` (n, 2) gives the vertices of each mesh that touch: one vertex, an edge, or a face.
    """

    bodies: Bodies
    time: np.ndarray
    place: list[tuple[tuple[int, ...], tuple[int, ...]]]

    def __len__(self) -> int:
        return len(self.time)

    @property
    def pairs(self) -> np.ndarray:
        """Body pairs (n, 2) int64."""
        return np.arange(2 * len(self)).reshape(-1, 2)

    def touching(self, k: int) -> set[Key]:
        """Feature pairs (kind, feature of the first, of the second) that contain the place of contact of pair k."""
        first, second = self.bodies.meshes[2 * k : 2 * k + 2]
        return features_around(first, self.place[k][0], second, self.place[k][1])


def features_around(a: pgccd.Mesh, of_a: Sequence[int], b: pgccd.Mesh, of_b: Sequence[int]) -> set[Key]:
    """Feature pairs whose first feature has all vertices `of_a` and second all `of_b`."""

    def having(rows: np.ndarray, wanted: Sequence[int]) -> list[int]:
        return np.flatnonzero((rows[:, :, None] == np.array(wanted)).any(axis=1).all(axis=1)).tolist()

    found = set[Key]()
    if len(of_a) == 1:
        found |= {(pgccd.Kind.VF_AB, of_a[0], f) for f in having(b.faces.numpy(), of_b)}
    if len(of_b) == 1:
        found |= {(pgccd.Kind.VF_BA, f, of_b[0]) for f in having(a.faces.numpy(), of_a)}
    edges = having(b.edges.numpy(), of_b)
    return found | {(pgccd.Kind.EE, e, f) for e in having(a.edges.numpy(), of_a) for f in edges}


# Meshes with dyadic vertex coordinates and the body frame's origin at exactly zero.


@functools.cache
def spindle(width: float = 0.125, level: int = 3, length: float = 1.0) -> pgccd.Mesh:
    """Two four-sided cones base to base along the x axis, of 8 (2^level - 1) faces: vertex 0 is the tip at +length,
    vertex 1 that at -length.
    """
    count = 2**level - 1  # square rings of vertices between the tips
    corners = np.array([[1.0, 0.0], [0.0, 1.0], [-1.0, 0.0], [0.0, -1.0]])
    vertices = [np.array([[length, 0.0, 0.0], [-length, 0.0, 0.0]])]
    faces = []
    for k in range(count):
        s = (k + 1) / (count + 1)
        vertices.append(
            np.column_stack([np.full(4, length * (1.0 - 2.0 * s)), 2.0 * width * min(s, 1.0 - s) * corners])
        )
    for side in range(4):
        following, last = (side + 1) % 4, 2 + 4 * (count - 1)
        faces += [[0, 2 + side, 2 + following], [1, last + following, last + side]]
        for ring in range(2, last, 4):
            a, b, c, d = ring + side, ring + 4 + side, ring + 4 + following, ring + following
            faces += [[a, b, c], [a, c, d]]
    return pgccd.Mesh(np.concatenate(vertices), np.array(faces))


@functools.cache
def plate(cells: int = 4, half: float = 1.0) -> pgccd.Mesh:
    """A flat square in the plane x = 0, of 2 cells^2 faces; `cells` a power of two."""
    steps = half * (2.0 * np.arange(cells + 1) / cells - 1.0)
    vertices = np.array([[0.0, y, z] for y in steps for z in steps])
    a = (np.arange(cells)[:, None] * (cells + 1) + np.arange(cells)).ravel()
    b, c, d = a + 1, a + cells + 2, a + cells + 1
    return pgccd.Mesh(vertices, np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)]))


@functools.cache
def wedge(width: float = 0.25) -> pgccd.Mesh:
    """A rhombic bar: edge (0, 1) protrudes at x = 1 from z = -1 to 1, another edge at x = -1."""
    ridges = [[x, 0.0, z] for x in (1.0, -1.0) for z in (-1.0, 1.0)]
    sides = [[0.0, y, z] for y in (width, -width) for z in (-1.0, 0.0, 1.0)]
    faces = []
    for ridge in (0, 2):
        for side in (4, 7):
            three = [[ridge, side, side + 1], [ridge + 1, side + 1, side + 2], [ridge, side + 1, ridge + 1]]
            outward = (ridge == 0) == (side == 7)
            faces += three if outward else [face[::-1] for face in three]
    return pgccd.Mesh(np.array(ridges + sides), np.array(faces))


# Placement.


def exponential(rotation: np.ndarray) -> np.ndarray:
    """Quaternion (4,) of a rotation vector (3,)."""
    angle = float(np.linalg.norm(rotation))
    if angle == 0.0:
        return IDENTITY
    return np.concatenate([[np.cos(angle / 2)], np.sin(angle / 2) / angle * rotation])


def leading(direction: np.ndarray, roll: float = 0.0) -> np.ndarray:
    """Quaternion (4,) that turns the x axis into a unit direction, after a roll about it."""
    half = X + direction
    if np.linalg.norm(half) < 1e-3:
        swing = np.array([0.0, 0.0, 1.0, 0.0])
    else:
        half /= np.linalg.norm(half)
        swing = np.concatenate([[X @ half], np.cross(X, half)])
    q = product(swing, exponential(roll * X))
    return q / np.linalg.norm(q)


def meet(
    meshes: list[pgccd.Mesh],
    place: list[tuple[tuple[int, ...], tuple[int, ...]]],
    weights: list[tuple[Sequence[float], Sequence[float]]],
    orientation: np.ndarray,
    rotation: np.ndarray,
    velocity: np.ndarray,
    time: np.ndarray,
    gap: np.ndarray,
    centre: np.ndarray | None = None,
) -> Meetings:
    """Bodies (2 n) whose second contact point lies at the first plus `gap` (n, 3) at `time`.

    Args:
        orientation: (2 n, 4) at the time of contact.
        rotation: (2 n, 3) rotation vectors of the whole step.
        velocity: (2 n, 3) of the centres.
        weights: of each place's vertices; they define the two contact points.
        centre: (n, 3) of the first bodies at the time of contact, default the origin.
    """
    n = len(time)
    turn = np.array([exponential(-time[k // 2] * rotation[k]) for k in range(2 * n)])
    start = np.array([product(t, q) for t, q in zip(turn, orientation, strict=True)])
    start /= np.linalg.norm(start, axis=1, keepdims=True)
    position = np.zeros((2 * n, 3))
    for k in range(n):
        points = []
        for side in (0, 1):
            body = 2 * k + side
            x = meshes[body].vertices.numpy()[list(place[k][side])]
            point = (np.array(weights[k][side])[:, None] * x).sum(axis=0)
            arm = rigid.position(point, np.zeros(3), start[body], np.zeros(3), rotation[body], float(time[k]), 30)
            points.append(np.array([float(c) for c in arm]))
        here = np.zeros(3) if centre is None else centre[k]
        position[2 * k] = here - time[k] * velocity[2 * k]
        position[2 * k + 1] = here + points[0] + gap[k] - points[1] - time[k] * velocity[2 * k + 1]
    return Meetings(Bodies(meshes, position, start, velocity, rotation), time, place)


def distance_at(meetings: Meetings, k: int, t: float | None = None) -> mpmath.mpf:
    """Distance of the two places of pair k at its time of contact, on the arcs, to 50 digits: between two points, a
    point and an edge's line, two edges' lines, or a point and a face's plane.
    """
    bodies = meetings.bodies
    when = meetings.time[k] if t is None else t
    with mpmath.workdps(50):
        sides = []
        for side in (0, 1):
            body = 2 * k + side
            vertices = bodies.meshes[body].vertices.numpy()
            pose = [c[body] for c in (bodies.position_t0, bodies.orientation_t0, bodies.position_t1, bodies.rotation)]
            sides.append([rigid.position(vertices[v], *pose, float(when), 50) for v in meetings.place[k][side]])
        return mpmath.sqrt(_squared(*sides))


def _squared(first: list[list[mpmath.mpf]], second: list[list[mpmath.mpf]]) -> mpmath.mpf:
    def minus(a: list[mpmath.mpf], b: list[mpmath.mpf]) -> list[mpmath.mpf]:
        return [x - y for x, y in zip(a, b, strict=True)]

    def dot(a: list[mpmath.mpf], b: list[mpmath.mpf]) -> mpmath.mpf:
        return mpmath.fsum(x * y for x, y in zip(a, b, strict=True))

    def cross(a: list[mpmath.mpf], b: list[mpmath.mpf]) -> list[mpmath.mpf]:
        return [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]

    if len(first) > len(second):
        first, second = second, first
    between = minus(second[0], first[0])
    if (len(first), len(second)) == (1, 1):
        return dot(between, between)
    edge = minus(second[1], second[0])
    if (len(first), len(second)) == (1, 2):
        away = cross(edge, between)
        return dot(away, away) / dot(edge, edge)
    other = minus(second[2], second[0]) if len(first) == 1 else minus(first[1], first[0])
    normal = cross(edge, other)
    return dot(normal, between) ** 2 / dot(normal, normal)


def least_separation(distance: mpmath.mpf) -> float:
    """The least float64 not below a distance: with it as separation, features that far apart just touch."""
    found = float(distance)
    return found if mpmath.mpf(found) >= distance else float(np.nextafter(found, np.inf))


def separation_at(start: np.ndarray, end: np.ndarray, t: float, is_face: bool) -> float:
    """The same for an elementary query (4, 3) on straight paths, at time t, exactly."""
    square = squared_distance_exact(start, end, Fraction(t), is_face)
    found = float(np.sqrt(float(square)))
    for _ in range(4):  # the root is off by one ulp at most
        found = float(np.nextafter(found, 0.0))
    while Fraction(found) ** 2 < square:
        found = float(np.nextafter(found, np.inf))
    return found


# Scenes.


def _sideways(rng: np.random.Generator, along: np.ndarray) -> np.ndarray:
    """(n, 3) unit vectors perpendicular to unit vectors (n, 3)."""
    side = np.cross(along, directions(rng, len(along)))
    return side / np.linalg.norm(side, axis=1, keepdims=True)


def tips(
    rng: np.random.Generator,
    n: int,
    turn: tuple[float, float] = (0.0, 0.0),
    speed: float = 0.0,
    gap: float = 0.0,
    time: np.ndarray | None = None,
    width: float = 0.03125,
    sizes: tuple[float, float] = (1.0, 1.0),
    level: int = 3,
) -> Meetings:
    """Spindles that meet tip to tip with collinear axes; at that moment the tips have no velocity along the line.

    Args:
        turn: angles of the two over the step, about axes perpendicular to their own: each tip's arc bulges towards the
            other.
        speed: of the second body, perpendicular to the line.
        gap: between the tips at the contact.
        time: (n,); default: random, inside the step.
    """
    along = directions(rng, n)
    when = rng.uniform(0.05, 0.95, n) if time is None else time
    meshes = [spindle(width * s, level, length=s) for _ in range(n) for s in sizes]
    orientation = np.array([leading(d * way, rng.uniform(0, 6)) for d in along for way in (1.0, -1.0)])
    axes = np.stack([_sideways(rng, along), _sideways(rng, along)], axis=1)
    rotation = (axes * np.array(turn)[None, :, None]).reshape(-1, 3)
    velocity = np.zeros((n, 2, 3))
    velocity[:, 1] = speed * _sideways(rng, along)
    ends = [((0,), (0,))] * n
    return meet(
        meshes, list(ends), [([1.0], [1.0])] * n, orientation, rotation, velocity.reshape(-1, 3), when, gap * along
    )


def resting(rng: np.random.Generator, kind: str, separation: float) -> Meetings:
    """One pair at rest exactly `separation` (0 or dyadic) apart along a coordinate axis, with exact coordinates: two
    tips ("tips"), a tip above a face ("face"), or two crossed edges ("edges").
    """
    order = rng.permutation(3)
    axes = np.eye(3)[order] * rng.choice([-1.0, 1.0], (3, 1))
    if np.linalg.det(axes) < 0:
        axes[2] *= -1.0
    width, level = float(2.0 ** -rng.integers(2, 6)), int(rng.integers(1, 5))

    def posed(mesh: pgccd.Mesh, basis: np.ndarray) -> pgccd.Mesh:
        return pgccd.Mesh(mesh.vertices.numpy() @ basis, mesh.faces)

    flip = np.diag([-1.0, -1.0, 1.0])
    place: tuple[tuple[int, ...], tuple[int, ...]] = ((0,), (0,))
    offset = np.array([2.0 + separation, 0.0, 0.0])
    if kind == "edges":
        crossed = np.array([[-1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, 1.0, 0.0]])
        pair, place = [posed(wedge(width), axes), posed(wedge(width), crossed @ axes)], ((0, 1), (0, 1))
    elif kind == "face":
        pair, place = [posed(spindle(width, level), axes), posed(plate(), flip @ axes)], ((0,), (6, 7, 12))
        offset = np.array([1.0 + separation, -0.375, 0.125])
    else:
        pair = [posed(spindle(width, level), axes), posed(spindle(width, level), flip @ axes)]
    start = np.stack([np.zeros(3), offset @ axes])
    still = np.zeros((2, 3))
    return Meetings(Bodies(pair, start, np.tile(IDENTITY, (2, 1)), still, still), np.zeros(1), [place])


def lattice(count: int, pitch: float = 1.0) -> Bodies:
    """count^3 equal cubes of edge `pitch` at rest, each in full contact with its neighbours: all toi tie."""
    corners = np.array([[x, y, z] for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (-0.5, 0.5)]) * pitch
    quads = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    mesh = pgccd.Mesh(corners, np.array([f for a, b, c, d in quads for f in ((a, b, c), (a, c, d))]))
    grid = np.stack(np.meshgrid(*[np.arange(float(count))] * 3, indexing="ij"), axis=-1).reshape(-1, 3) * pitch
    still = np.zeros_like(grid)
    return Bodies([mesh] * len(grid), grid, np.tile(IDENTITY, (len(grid), 1)), still, still)
