"""Bounds of the translations that bring bodies apart, against exact ones of convex polyhedra and of their unions."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, field
from fractions import Fraction

import numpy as np
import pytest
import torch
from oracle.exit import Vector, exactly, exit_of, meeting, placed
from support.cases import mostly_slow
from support.deforming import crumpled, motion_of
from support.shapes import bumpy, directions, icosphere, tetrahedron, unit_quaternions

import pgccd

PAIR = torch.tensor([[0, 1]])
UPRIGHT = (1.0, 0.0, 0.0, 0.0)
AXES = np.eye(3)


def joined(*meshes: pgccd.Mesh, at: Sequence[Sequence[float]]) -> pgccd.Mesh:
    """Several pieces at these places as one mesh."""
    vertices = [mesh.vertices.numpy() + np.asarray(place) for mesh, place in zip(meshes, at, strict=True)]
    begin = np.cumsum([0, *(len(each) for each in vertices)])
    faces = [mesh.faces.numpy() + first for mesh, first in zip(meshes, begin, strict=False)]
    return pgccd.Mesh(np.concatenate(vertices), np.concatenate(faces))


def octahedron(size: float = 1.0) -> pgccd.Mesh:
    corners = size * np.concatenate([np.eye(3), -np.eye(3)])
    faces = [[x, y, z] for x, y, z in itertools.product((0, 3), (1, 4), (2, 5))]
    return pgccd.Mesh(corners, faces)


@dataclass
class Two:
    """Two rigid bodies, each of convex pieces (vertices, faces), at rest."""

    meshes: list[pgccd.Mesh]
    position: np.ndarray
    orientation: np.ndarray = field(default_factory=lambda: np.tile(UPRIGHT, (2, 1)))
    pieces: list[list[tuple[np.ndarray, np.ndarray]]] | None = None

    def scene(self, **columns: object) -> pgccd.Scene:
        return pgccd.Scene(self.meshes, **columns)  # type: ignore[arg-type]

    def motion(self) -> pgccd.RigidMotion:
        return pgccd.RigidMotion.at_rest(torch.tensor(self.position), torch.tensor(self.orientation))

    def found(self, direction: object, pairs: torch.Tensor | None = PAIR, **options: object) -> pgccd.ExitDistances:
        return pgccd.exit_distance(self.scene(), self.motion(), direction, pairs=pairs, **options)  # type: ignore[arg-type]

    def exactly(self, direction: torch.Tensor) -> Fraction:
        """The exit distance along the direction (3,) as it is."""
        hulls = self.pieces or [[(mesh.vertices.numpy(), mesh.faces.numpy())] for mesh in self.meshes]
        first, second = (
            [(placed(points, self.orientation[k], self.position[k]), faces) for points, faces in hulls[k]]
            for k in range(2)
        )
        return exit_of(meeting(*a, *b, vector(direction)) for a, b in itertools.product(first, second))


def vector(direction: torch.Tensor) -> Vector:
    return exactly(direction.cpu().numpy())[0]


def assert_encloses(found: pgccd.ExitDistances, true: Sequence[Fraction], within: float | None = None) -> None:
    """Asserts that the bounds enclose the true distances, and are at most `within` apart."""
    lower, upper = found.lower.tolist(), found.upper.tolist()
    assert len(true) == len(found)
    for low, exact, high in zip(lower, true, upper, strict=True):
        assert Fraction(low) <= exact <= Fraction(high), (low, float(exact), high)
        assert within is None or high - low <= within, (low, float(exact), high)


def boxes(rng: np.random.Generator, scale: float = 1.0) -> Two:
    sides = scale * rng.uniform(0.3, 2.0, (2, 3))
    position = np.zeros((2, 3))
    position[1] = rng.uniform(-0.5, 0.5, 3) * sides.sum(axis=0)
    return Two([pgccd.Mesh.box(each) for each in sides], position)


@pytest.mark.parametrize("seed", range(8))
def test_boxes_along_an_axis(seed: int) -> None:
    rng = np.random.default_rng(seed)
    two = boxes(rng)
    for axis in np.concatenate([AXES, -AXES]):
        found = two.found((rng.uniform(0.1, 9.0) * axis).tolist())
        assert found.direction[0].tolist() == axis.tolist()
        assert_encloses(found, [two.exactly(found.direction[0])], within=1.01e-6 * float(two.scene().radius.min()))
        assert float(found.upper) < two.exactly(found.direction[0]) + 1e-12


@pytest.mark.parametrize("scale", [1e-9, 1.0, 1e9])
@pytest.mark.parametrize("seed", range(6))
def test_boxes_along_any_direction(seed: int, scale: float) -> None:
    rng = np.random.default_rng(seed)
    two = boxes(rng, scale)
    for direction in directions(rng, 4):
        found = two.found(direction)
        assert_encloses(found, [two.exactly(found.direction[0])], within=5e-6 * float(two.scene().radius.min()))


CONVEX = {
    "tetrahedra": lambda rng: [tetrahedron(), tetrahedron(0.7)],
    "octahedra": lambda rng: [octahedron(), octahedron(0.4)],
    "box and tetrahedron": lambda rng: [pgccd.Mesh.box(rng.uniform(0.5, 2.0, 3)), tetrahedron()],
    "icosahedra": lambda rng: [pgccd.Mesh(*icosphere(0)), pgccd.Mesh(0.6 * icosphere(0)[0], icosphere(0)[1])],
}


@pytest.mark.parametrize("shapes", CONVEX)
@pytest.mark.parametrize("seed", mostly_slow(range(8), (0, 1)))
def test_convex_polyhedra_in_any_pose(shapes: str, seed: int) -> None:
    rng = np.random.default_rng(seed)
    meshes = CONVEX[shapes](rng)
    position = np.zeros((2, 3))
    position[1] = directions(rng, 1)[0] * rng.uniform(0.0, 0.6)
    two = Two(meshes, position, unit_quaternions(rng, 2))
    found = two.found(directions(rng, 1)[0])
    assert_encloses(found, [two.exactly(found.direction[0])], within=2e-5)


@pytest.mark.parametrize("offset", [1e3, 1e6])
@pytest.mark.parametrize("seed", range(4))
def test_far_from_the_origin(seed: int, offset: float) -> None:
    rng = np.random.default_rng(seed)
    two = boxes(rng)
    two.position += offset * directions(rng, 1)
    two.orientation = unit_quaternions(rng, 2)
    found = two.found(directions(rng, 1)[0])
    assert_encloses(found, [two.exactly(found.direction[0])], within=2e-5)


def with_a_gap() -> Two:
    """A fork: two prongs along x, and a body within the nearer one."""
    prong, base, small = pgccd.Mesh.box([1.0, 2.0, 1.0]), pgccd.Mesh.box([4.0, 0.5, 1.0]), pgccd.Mesh.box([0.3] * 3)
    at = [[0.0, 0.0, 0.0], [3.0, 0.0, 0.0], [1.5, -1.1, 0.0]]
    fork = joined(prong, prong, base, at=at)
    pieces = [(each.vertices.numpy() + at[k], each.faces.numpy()) for k, each in enumerate((prong, prong, base))]
    place = np.array([[0.0, 0, 0], [0.51, 0.2, 0.11]])
    return Two([fork, small], place, pieces=[pieces, [(small.vertices.numpy(), small.faces.numpy())]])


@pytest.mark.parametrize(
    ("direction", "true"), [([1.0, 0, 0], 3.14), ([-1.0, 0, 0], 1.16), ([0, 1.0, 0], 0.95), ([0.1, -1.0, 0], None)]
)
def test_the_last_way_out_counts(direction: list[float], true: float | None) -> None:
    """Along x the body leaves the first prong, is free, and passes through the second one."""
    two = with_a_gap()
    found = two.found(direction)
    exact = two.exactly(found.direction[0])
    assert true is None or float(exact) == pytest.approx(true)
    assert_encloses(found, [exact], within=1e-5)


def test_bodies_inside_others() -> None:
    """A stone in a box, which is hollow or a solid, and one in the cavity of a solid."""
    stone = pgccd.Mesh.box([0.2, 0.3, 0.25])
    box = pgccd.Mesh.box([2.0, 2.0, 2.0])
    position = np.array([[0.0, 0, 0], [0.123, 0.217, -0.31]])
    direction = [0.3, 0.2, 1.0]
    for room in (box, box.as_solid()):
        two = Two([room, stone], position)
        exact = two.exactly(two.found(direction).direction[0])
        assert_encloses(two.found(direction), [exact], within=1e-5)
        # By default pairs that touch: a solid is touched by what is inside of it.
        by_default = two.found(direction, pairs=None)
        assert by_default.pairs.tolist() == ([[0, 1]] if room.solid else [])
        assert by_default == two.found(direction)[: len(by_default)]
    inner = pgccd.Mesh.box([1.8, 1.8, 1.8])
    cavity = pgccd.Mesh(inner.vertices, inner.faces.flip(1))
    shell = joined(box, cavity, at=[[0.0] * 3] * 2).as_solid()
    assert len(Two([shell, stone], position).found(direction, pairs=None)) == 0
    found = Two([shell, stone], position).found(direction)
    assert_encloses(found, [Two([box, stone], position).exactly(found.direction[0])], within=1e-5)


def test_steps_back_reach_the_inside_of_a_solid() -> None:
    """Where steps back are long, the whole body is inside of the solid: it touches it."""
    room, stone = pgccd.Mesh.box([2.0, 2.0, 2.0]), pgccd.Mesh.box([0.01, 0.02, 0.03])
    position = np.array([[0.0, 0, 0], [0.123, 0.217, 0.0]])
    solid, hollow = (Two([mesh, stone], position).found([0, 0, 1.0], tolerance=0.1) for mesh in (room.as_solid(), room))
    assert float(solid.lower) == float(solid.upper) - 0.1 and float(hollow.lower) == 0.0


@pytest.mark.parametrize(("margins", "thickness", "separation"), [((0.1, 0.03), 0.0, 0.0), (None, 0.05, 0.02)])
@pytest.mark.parametrize("seed", range(4))
def test_margins_thickness_and_separation(
    seed: int, margins: tuple[float, float] | None, thickness: float, separation: float
) -> None:
    rng = np.random.default_rng(seed)
    two = boxes(rng)
    two.meshes[1] = two.meshes[1].thickened(thickness)
    scene = two.scene(margin=margins and torch.tensor(margins, dtype=torch.float64))
    found = pgccd.exit_distance(scene, two.motion(), [0.0, 0, 3.0], pairs=PAIR, min_separation=separation)
    further = sum((Fraction(m) for m in margins or ()), Fraction(thickness) + Fraction(separation))
    exact = two.exactly(found.direction[0]) + further
    assert_encloses(found, [exact], within=5e-6)


def test_several_pairs_are_each_their_own() -> None:
    """Rows of many pairs have the bits of a call of their own; pairs are repeated, and each has its direction."""
    rng = np.random.default_rng(1)
    meshes = [bumpy(rng, 1, size=s) for s in rng.uniform(0.5, 1.5, 6)]
    x, q = torch.tensor(0.8 * rng.normal(size=(6, 3))), torch.tensor(unit_quaternions(rng, 6))
    scene = pgccd.Scene(meshes, margin=torch.rand(6, dtype=torch.float64) * 0.1)
    motion = pgccd.RigidMotion(x, q, x + 1.0, q)
    pairs = torch.tensor([[4, 5], [0, 3], [0, 3], [1, 2], [0, 5], [4, 5]])
    towards = torch.tensor(directions(rng, 6))
    found = pgccd.exit_distance(scene, motion, towards, pairs=pairs)
    assert torch.equal(found.pairs, pairs) and (found.upper > 0.0).any()
    for k in range(6):
        assert pgccd.exit_distance(scene, motion, towards[k], pairs=pairs[k : k + 1]) == found[k : k + 1]
    touching = pgccd.exit_distance(scene, motion, towards[0])
    still = pgccd.RigidMotion.at_rest(x, q)
    assert torch.equal(touching.pairs, pgccd.collide(scene, still).pairs) and len(touching) > 2
    assert touching == pgccd.exit_distance(scene, still, towards[0], pairs=touching.pairs)


def test_filters_count_unless_pairs_are_given() -> None:
    scene = pgccd.Scene([pgccd.Mesh.box([1.0] * 3)], [0, 0, 0], exclude=[[0, 1]], world=[0, 0, 1])
    still = pgccd.RigidMotion.at_rest(torch.rand(3, 3), torch.tensor([UPRIGHT] * 3))
    assert len(pgccd.exit_distance(scene, still, [1, 0, 0])) == 0
    assert len(pgccd.exit_distance(scene, still, [1, 0, 0], pairs=torch.tensor([[0, 1], [0, 2]]))) == 2


def test_default_pairs_are_those_of_collide() -> None:
    """Within the separation; and of bodies that also touch themselves only pairs of two."""
    boxes = pgccd.Scene([pgccd.Mesh.box([1.0] * 3)], [0, 0])
    x = torch.tensor([[0.0, 0, 0], [1.05, 0.1, 0.2]])
    still = pgccd.RigidMotion.at_rest(x, torch.tensor([UPRIGHT] * 2))
    assert len(pgccd.exit_distance(boxes, still, [1, 0, 0])) == 0
    found = pgccd.exit_distance(boxes, still, [1, 0, 0], min_separation=0.1)
    assert_encloses(found, [1 + Fraction(0.1) - Fraction(float(x[1, 0]))], within=1e-5)
    meshes, ends = crumpled(2)
    scene, motion = pgccd.Scene(meshes, self_collision=True), motion_of(*ends, device=torch.device("cpu"))
    at_start = pgccd.VertexMotion(motion.x_t0, motion.x_t0)
    assert [0, 0] in pgccd.collide(scene, at_start).pairs.tolist()
    assert pgccd.exit_distance(scene, motion, [1, 0, 0]).pairs.tolist() == [[0, 1]]


@pytest.mark.parametrize("seed", range(4))
def test_apart_beyond_the_upper_bound_and_touching_at_the_lower_one(seed: int) -> None:
    """Of any shapes, by `collide` and `distance` of the translated bodies, rounded to float64."""
    rng = np.random.default_rng(seed)
    meshes = [bumpy(rng, 2), bumpy(rng, 1, size=0.6)]
    x, q = torch.tensor(0.3 * rng.normal(size=(2, 3))), torch.tensor(unit_quaternions(rng, 2))
    scene = pgccd.Scene(meshes)
    found = pgccd.exit_distance(scene, pgccd.RigidMotion.at_rest(x, q), directions(rng, 1)[0].tolist())
    assert len(found) == 1 and 0.0 < float(found.upper - found.lower) < 2e-5

    def moved(s: torch.Tensor) -> pgccd.RigidMotion:
        return pgccd.RigidMotion.at_rest(torch.cat([x[:1], x[1:] + s * found.direction]), q)

    for factor in (1.00001, 1.01, 1.3, 2.0, 10.0):
        assert float(pgccd.distance(scene, moved(factor * found.upper), pairs=PAIR).lower) > 0.0
    assert float(pgccd.distance(scene, moved(found.lower), pairs=PAIR).upper) == 0.0


@pytest.mark.parametrize("offset", [0.0, 1e6])
@pytest.mark.parametrize("seed", range(6))
def test_deforming_bodies(seed: int, offset: float) -> None:
    """Their shapes at the start are translated. Tetrahedra of any corners are convex."""
    rng = np.random.default_rng(seed)
    x = rng.normal(size=(2, 4, 3)) + offset * directions(rng, 1)
    faces = tetrahedron().faces.numpy()
    scene = pgccd.Scene([tetrahedron()], [0, 0])
    start = torch.tensor(x.reshape(-1, 3))
    motion = pgccd.VertexMotion(start, start.flip(0) + 3.0)
    found = pgccd.exit_distance(scene, motion, directions(rng, 1)[0], pairs=PAIR)
    hulls = [exactly(each) for each in x]
    true = exit_of([meeting(hulls[0], faces, hulls[1], faces, vector(found.direction[0]))])
    assert_encloses(found, [true], within=1e-4)


def test_deforming_bodies_of_different_meshes() -> None:
    rng = np.random.default_rng(2)
    meshes = [tetrahedron(), pgccd.Mesh.box([1.0, 1.2, 0.7]), octahedron()]
    place = 0.3 * rng.normal(size=(3, 3))
    x = torch.tensor(np.concatenate([mesh.vertices.numpy() + p for mesh, p in zip(meshes, place, strict=True)]))
    scene = pgccd.Scene(meshes, self_collision=True)
    found = pgccd.exit_distance(scene, pgccd.VertexMotion(x, x), [1.0, -2.0, 0.4])
    q = torch.tensor([UPRIGHT] * 3, dtype=torch.float64)
    rigid = pgccd.exit_distance(scene, pgccd.RigidMotion.at_rest(torch.tensor(place), q), [1.0, -2.0, 0.4])
    assert found.pairs.tolist() == rigid.pairs.tolist() == [[0, 1], [0, 2], [1, 2]]
    assert torch.allclose(found.upper, rigid.upper, atol=1e-9) and (found.upper - found.lower < 2e-5).all()


def test_rounding_of_translated_vertices_counts_as_touching() -> None:
    """A vertex lies in the plane of a face that slides over it: exactly, they touch until the end of the face. Rounding
    the translated vertices takes some of the faces off the vertex.
    """
    rng, count = np.random.default_rng(7), 60
    tip, blade = tetrahedron(), pgccd.Mesh([[0, 0, 0], [1, 0, 0], [0, 1, 0]], [[0, 1, 2]])
    # The plane x - y + z = 0 contains (1, 1, 0). The other body is on the side of -(1, -1, 1), but for its tip.
    away, along, across = np.array([1.0, -1.0, 1.0]), np.array([1.0, 1.0, 0.0]), np.array([1.0, 2.0, 1.0])
    starts, hulls = [], []
    for scale in rng.uniform(0.3, 3.0, count):
        sides = np.stack([-9.0 * along - 2.0 * across, along - 2.0 * across, 2.0 * across])
        sides = np.round(scale * sides * 2**20) / 2**20
        sides[:, 2] = sides[:, 1] - sides[:, 0]
        spread = np.array([[0, 0, 0], [0.2, 0.1, 0.3], [-0.2, 0.3, 0.1], [0.1, -0.3, 0.2]])
        starts += [spread - np.linalg.norm(spread, axis=1)[:, None] * away, sides]
        starts[-2][0] = 0.0
        hulls.append([exactly(each) for each in starts[-2:]])
    scene = pgccd.Scene([tip, blade], [0, 1] * count)
    x = torch.tensor(np.concatenate(starts))
    pairs = torch.arange(2 * count).view(-1, 2)
    found = pgccd.exit_distance(scene, pgccd.VertexMotion(x, x), along, pairs=pairs, tolerance=0.0)
    d = vector(found.direction[0])
    assert d[0] == d[1] and d[2] == 0
    true = [exit_of([meeting(a, tip.faces.numpy(), b, blade.faces.numpy(), d)]) for a, b in hulls]
    assert min(true) > 1
    assert_encloses(found, true)


@pytest.mark.parametrize("rise", [0.0, 5e-13])
def test_offsets_that_float64_rounds(rise: float) -> None:
    """A small box above a huge one: exactly, some are a little apart, and others touch until they slide off, or rise by
    less than what the rounded offset of both tells apart.
    """
    rng, count = np.random.default_rng(3), 40
    huge, small = pgccd.Mesh.box([2e6, 2e6, 2e6]), pgccd.Mesh.box([1.0, 1.0, 1.0])
    position = np.zeros((count, 2, 3))
    position[:, 0, :] = rng.uniform(-1.0, 1.0, (count, 3))
    position[:, 1, :] = [1e6 - 100.0, 0.2, 1e6 + 0.5]
    position[:, 1, 2] += position[:, 0, 2]
    gap = [Fraction(b[2]) - Fraction(a[2]) - Fraction(1e6 + 0.5) for a, b in position.tolist()]
    assert min(gap) < 0 < max(gap)
    scene = pgccd.Scene([huge, small], [0, 1] * count)
    q = torch.tensor([UPRIGHT], dtype=torch.float64).repeat(2 * count, 1)
    motion = pgccd.RigidMotion.at_rest(torch.tensor(position.reshape(-1, 3)), q)
    pairs = torch.arange(2 * count).view(-1, 2)
    found = pgccd.exit_distance(scene, motion, [1.0, 0.0, rise], pairs=pairs, tolerance=0.0)
    true = [Two([huge, small], each).exactly(found.direction[0]) for each in position]
    assert sum(1 < each < 99 for each in true) > (10 if rise else -1)
    assert_encloses(found, true)
    assert (found.lower > 1.0).sum() > 10
    assert (found.lower[torch.tensor([g > 0 for g in gap])] == 0.0).all()


@pytest.mark.parametrize("size", [1e-6, 1.0, 1e6])
def test_bodies_that_fill_their_spheres(size: float) -> None:
    """Corners of both spheres meet at the largest distance there is."""
    two = Two([octahedron(), octahedron(size)], np.zeros((2, 3)))
    found = two.found([0.0, 0.0, -5.0])
    assert Fraction(float(found.upper)) >= 1 + Fraction(size) == two.exactly(found.direction[0])
    assert float(found.upper) <= (1.0 + size) * (1.0 + 1e-9)
    for axis in (*AXES, *-AXES):
        beyond = Two(two.meshes, np.stack([0.0 * axis, -3.0 * axis]))
        found = beyond.found(axis)
        assert Fraction(float(found.upper)) >= 4 + Fraction(size) == beyond.exactly(found.direction[0])


def test_ways_of_many_faces_are_halved(monkeypatch: pytest.MonkeyPatch) -> None:
    """First to a place where few faces meet: the bounds are those of the whole way, to within rounding."""
    rng = np.random.default_rng(5)
    ball = bumpy(rng, 2)
    dumbbell = joined(ball, bumpy(rng, 2), at=[[0.0, 0, 0], [4.0, 0.3, 0]])
    scene = pgccd.Scene([ball, dumbbell, bumpy(rng, 2, size=0.5)], [1, 2, 0, 2, 0, 0])
    place = 0.3 * rng.normal(size=(6, 3))
    still = pgccd.RigidMotion.at_rest(torch.tensor(place), torch.tensor(unit_quaternions(rng, 6)))
    pairs = torch.tensor([[0, 1], [2, 3], [4, 5], [0, 2]]).repeat_interleave(4, dim=0)
    towards = torch.tensor(directions(rng, 16))
    found = pgccd.exit_distance(scene, still, towards, pairs=pairs)
    monkeypatch.setattr("pgccd.search.exit_distance._HALVINGS", 0)
    whole = pgccd.exit_distance(scene, still, towards, pairs=pairs)
    assert torch.allclose(found.upper, whole.upper, rtol=0.0, atol=1e-9)
    assert (found.upper - found.lower).max() < 1e-4 and found.upper.max() > 3.0
    # Steps back that are longer than what is known are not made.
    monkeypatch.undo()
    coarse = pgccd.exit_distance(scene, still, towards, pairs=pairs, tolerance=100.0)
    assert (coarse.lower > 0.9 * found.lower).all() and (coarse.lower <= whole.upper).all()


def test_aligned_boxes_only_touch() -> None:
    """No edge certainly passes through a face: the lower bound is 0, and the upper one still tight."""
    two = Two([pgccd.Mesh.box([1.0] * 3)] * 2, np.array([[0.0, 0, 0], [0.25, 0, 0]]))
    found = two.found([1, 0, 0])
    assert_encloses(found, [Fraction(3, 4)])
    assert float(found.lower) == 0.0 and float(found.upper) < 0.75 + 1e-12


@pytest.mark.parametrize("gap", [-1.0, 0.0, 1e-3, 0.5])
def test_bodies_that_are_apart(gap: float) -> None:
    """Beside one another; or the translated body is ahead of the other."""
    two = Two([pgccd.Mesh.box([1.0] * 3)] * 2, np.array([[0.0, 0, 0], [0.1, 0.2, 1.5]]))
    assert two.found([1, 0, 0]).upper.item() == two.found([1, 0, 0]).lower.item() == 0.0
    ahead = Two([pgccd.Mesh.box([1.0] * 3)] * 2, np.array([[0.0, 0, 0], [1.0 + gap, 0.2, 0.3]]))
    found = ahead.found([1, 0, 0])
    assert_encloses(found, [max(Fraction(0), Fraction(1) - Fraction(1.0 + gap))])
    back = ahead.found([-1, 0, 0])
    assert_encloses(back, [Fraction(1) + Fraction(1.0 + gap)], within=2e-6)


@pytest.mark.parametrize("length", [5e-324, 1e-300, 1.0, 1e300])
def test_directions_of_any_length(length: float) -> None:
    two = boxes(np.random.default_rng(0))
    found = two.found([0.0, length, length])
    assert found.direction[0].tolist() == pytest.approx([0.0, 0.5**0.5, 0.5**0.5], abs=1e-15)
    assert found == two.found(np.array([0.0, 1.0, 1.0])) == two.found(torch.tensor([[0.0, 2.0, 2.0]]))


def test_what_is_refused() -> None:
    two = boxes(np.random.default_rng(0))
    for direction in ([0, 0, 0], [float("nan"), 0, 1], [float("inf"), 0, 1]):
        with pytest.raises(ValueError, match="^direction: expected finite numbers, not all 0"):
            two.found(direction)
    with pytest.raises(ValueError, match="^direction: row 1: expected finite numbers, not all 0"):
        two.found([[1, 0, 0], [0, 0, 0]], pairs=PAIR.repeat(2, 1))
    with pytest.raises(ValueError, match=r"^direction: expected shape \(3,\) or \(1, 3\)"):
        two.found([[1, 0, 0], [1, 0, 0]])
    with pytest.raises(ValueError, match=r"^direction: expected shape \(3,\) unless pairs are given"):
        two.found([[1, 0, 0]], pairs=None)
    for shape in ((2,), (1, 1, 3), ()):
        with pytest.raises(ValueError, match="^direction: expected a vector"):
            two.found(torch.ones(shape))
    with pytest.raises(ValueError, match="^pairs: expected rows 0 <= i < j < 2"):
        two.found([1, 0, 0], pairs=torch.tensor([[1, 0]]))
    with pytest.raises(TypeError, match="^motion: "):
        pgccd.exit_distance(two.scene(), None, [1, 0, 0])  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="^motion: bodies .* beyond 1e"):
        two.found([1, 0, 0], min_separation=1e150)
    with pytest.raises(ValueError, match="^position_t0: requires grad"):
        start = torch.tensor(two.position, requires_grad=True)
        motion = pgccd.RigidMotion(start, torch.tensor(two.orientation), start, torch.tensor(two.orientation))
        pgccd.exit_distance(two.scene(), motion, [1, 0, 0])


def test_results_have_rows(device: torch.device) -> None:
    scene = pgccd.Scene([pgccd.Mesh.box([1.0] * 3)], [0, 0, 0], device=device)
    x = torch.tensor([[0.0, 0, 0], [0.3, 0.2, 0.1], [5.0, 0, 0]], device=device)
    still = pgccd.RigidMotion.at_rest(x, torch.tensor([UPRIGHT] * 3, device=device))
    found = pgccd.exit_distance(scene, still, [1, 0, 0])
    assert found.pairs.tolist() == [[0, 1]] and found.pairs.device.type == device.type
    assert repr(found) == f"ExitDistances(count=1, largest=0.699999..0.7, device={found.pairs.device})"
    assert repr(found[:0]) == f"ExitDistances(count=0, device={found.pairs.device})"
    assert pgccd.ExitDistances.from_state_dict(found.state_dict()) == found
    on_cpu = pgccd.exit_distance(scene.to("cpu"), still.to("cpu"), [1, 0, 0])
    assert on_cpu == found.to("cpu")
    none = torch.zeros(0, 2, dtype=torch.int64, device=device)
    assert len(pgccd.exit_distance(scene, still, torch.ones(0, 3, device=device), pairs=none)) == 0
    assert len(pgccd.exit_distance(scene[:0], still[:0], [1, 0, 0])) == 0
