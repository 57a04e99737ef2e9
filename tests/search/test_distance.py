"""Bounds of distances over a motion, against exact distances of poses and distances at sampled times."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from oracle.surfaces import boundary_distance
from support.cases import mostly_slow
from support.distances import Moving, assert_bounds_exactly, columns_of, least_distance
from support.same_bits import difference
from support.shapes import bumpy, directions, tetrahedron, unit_quaternions

import pgccd

PAIR = torch.tensor([[0, 1]])
UPRIGHT = [1.0, 0.0, 0.0, 0.0]


def at_rest(meshes: list[pgccd.Mesh], position: object, orientation: object = None, **more: object) -> Moving:
    place = np.asarray(position, dtype=np.float64)
    turn = np.tile(UPRIGHT, (len(meshes), 1)) if orientation is None else np.asarray(orientation)
    return Moving(meshes, place, turn, place, np.zeros_like(place), **more)  # type: ignore[arg-type]


def apart(
    rng: np.random.Generator, meshes: list[pgccd.Mesh], gap: float, turn: float = 0.0, travel: float = 0.0
) -> Moving:
    """Two bodies whose spheres are about `gap` apart at the start."""
    position = np.zeros((2, 3))
    position[1] = (meshes[0].radius + meshes[1].radius + gap) * directions(rng, 1)[0]
    end, rotation = position + travel * directions(rng, 2), turn * directions(rng, 2)
    return Moving(meshes, position, unit_quaternions(rng, 2), end, rotation)


def stick(length: float, width: float) -> pgccd.Mesh:
    return pgccd.Mesh.box([length, width, width])


@pytest.mark.parametrize("turn", [0.0, 1e-30])
@pytest.mark.parametrize("seed", range(6))
def test_poses_have_their_exact_distance(seed: int, turn: float) -> None:
    """A turn too small to matter is searched like any other."""
    rng = np.random.default_rng(seed)
    bodies = apart(rng, [bumpy(rng, 1), bumpy(rng, 0, size=0.3)], rng.uniform(-0.4, 2.0), turn)
    found = bodies.distance(tolerance=0.0 if turn else None)
    assert_bounds_exactly(found, bodies)
    assert found.converged.item() == (turn == 0.0) and (found.upper - found.lower).max() < 3e-12


def needles(rng: np.random.Generator) -> pgccd.Mesh:
    """Triangles of which some are needles, segments or points."""
    corners = rng.normal(size=(6, 3))
    corners = np.concatenate([corners, corners[:1] + 1e-9, 0.5 * (corners[:1] + corners[1:2])])
    return pgccd.Mesh(corners, [[0, 1, 2], [0, 6, 3], [0, 7, 1], [2, 3, 4], [3, 5, 4], [6, 7, 5]])


CASES = {
    "slender": lambda rng: apart(rng, [stick(10.0, 1e-3), stick(10.0, 1e-3)], -8.0),
    "degenerate": lambda rng: apart(rng, [needles(rng), needles(rng)], 0.5),
    "far away": lambda rng: apart(rng, [bumpy(rng, 1), bumpy(rng, 1)], 1e6),
    "of unequal sizes": lambda rng: apart(rng, [bumpy(rng, 1, size=1e4), bumpy(rng, 1, size=1e-3)], 0.0),
    "far from the world's origin": lambda rng: _shifted(apart(rng, [bumpy(rng, 1), bumpy(rng, 1)], 0.1), 2.0**20),
    "tiny": lambda rng: apart(rng, [bumpy(rng, 0, size=1e-20), bumpy(rng, 0, size=1e-20)], 1e-20),
}


def _shifted(bodies: Moving, by: float) -> Moving:
    bodies.start = bodies.end = bodies.start + by
    return bodies


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("case", CASES)
def test_unusual_bodies(case: str, seed: int) -> None:
    bodies = CASES[case](np.random.default_rng(seed))
    found = bodies.distance()
    assert_bounds_exactly(found, bodies)
    assert ((found.upper - found.lower) <= 1e-11 * (found.upper + max(mesh.radius for mesh in bodies.meshes))).all()


def test_points_are_where_the_upper_bound_is_attained() -> None:
    rng = np.random.default_rng(3)
    bodies = apart(rng, [bumpy(rng, 1), bumpy(rng, 1)], 0.2, turn=1.0, travel=0.5)
    found = bodies.distance()
    t = found.time.item()
    points = found.points[0].numpy()
    assert np.linalg.norm(points[1] - points[0]) == pytest.approx(found.upper.item(), abs=1e-11)
    for body in (0, 1):  # as a triangle that is one point
        single = np.repeat(points[body : body + 1], 3, axis=0)
        surface = bodies.vertices_at(body, t), bodies.meshes[body].faces.numpy()
        assert boundary_distance(*surface, single, np.array([[0, 1, 2]])) < 1e-12


@pytest.mark.parametrize("path", ["rigid", "linear"])
@pytest.mark.parametrize("turn", [0.0, 0.5, 3.0])
@pytest.mark.parametrize("seed", mostly_slow(range(4), [0]))
def test_moving_bodies(seed: int, turn: float, path: str) -> None:
    rng = np.random.default_rng(seed)
    meshes = [bumpy(rng, 0), bumpy(rng, 0, size=0.6)]
    meshes[1] = pgccd.Mesh(meshes[1].vertices, meshes[1].faces, origin=0.5 * directions(rng, 1)[0])
    bodies = apart(rng, meshes, 0.4, turn, travel=0.4)
    bodies.path = path
    truth = bodies.truth((0, 1))
    for tolerance in (1e-3, 1e-7):
        found = bodies.distance(tolerance=tolerance)
        lower, upper = found.lower.item(), found.upper.item()
        assert lower <= truth + 1e-13 and truth <= upper + 1e-7
        assert upper - lower <= tolerance and found.converged.item()
        t = found.time.item()
        at = [(bodies.vertices_at(b, t), bodies.meshes[b].faces.numpy()) for b in (0, 1)]
        assert boundary_distance(*at[0], *at[1]) <= upper


@pytest.mark.parametrize("side", [0, 1])
@pytest.mark.parametrize("gap", [2.0**-10, 8.0])
@pytest.mark.parametrize("nearest_at", [0.5, 0.37, 0.8])
def test_a_vertex_that_turns_past_another(nearest_at: float, gap: float, side: int) -> None:
    """A corner on an arc of radius 4 is nearest to a corner at rest at a known time."""
    wedge = [[4.0, 0, 0], [0.0, 0.5, 0.0], [0.0, -0.5, 0.1], [0.0, 0.0, 0.5]]
    faces = [[0, 1, 2], [0, 2, 3], [0, 3, 1], [1, 3, 2]]
    turning = pgccd.Mesh(wedge, faces, origin=[0.0, 0.0, 0.0])
    standing = pgccd.Mesh(-np.array(wedge), faces, origin=[0.0, 0.0, 0.0])
    for angle in (0.02, 0.5, 2.0):
        half = 0.5 * nearest_at * angle
        back = [math.cos(half), 0.0, 0.0, -math.sin(half)]
        place = np.array([[0.0, 0, 0], [8.0 + gap, 0, 0]])
        turn = np.array([[0.0, 0.0, angle], [0.0, 0.0, 0.0]])
        order = [side, 1 - side]
        meshes = [(turning, standing)[k] for k in order]
        bodies = Moving(meshes, place[order], np.array([back, UPRIGHT])[order], place[order], turn[order])
        for tolerance in (1e-4, 1e-8, 1e-12):
            found = bodies.distance(tolerance=tolerance)
            assert found.lower.item() <= gap * (1 + 1e-15) and found.upper.item() >= gap
            assert found.upper.item() - found.lower.item() <= tolerance + 3e-12
        assert found.time.item() == pytest.approx(nearest_at, abs=1e-3)


@pytest.mark.parametrize("nearest_at", [0.37, 0.8])
def test_a_vertex_whose_acceleration_changes(nearest_at: float) -> None:
    """A body turns and moves so that its corner is nearest to a corner at rest while it is far to the side of the axis:
    the acceleration along the gap changes in proportion to time.
    """
    wedge = np.array([[4.0, 0, 0], [0.0, 0.05, 0.0], [0.0, -0.05, 0.01], [0.0, 0.0, 0.05]])
    faces = [[0, 1, 2], [0, 2, 3], [0, 3, 1], [1, 3, 2]]
    meshes = [pgccd.Mesh(corners, faces, origin=[0.0, 0.0, 0.0]) for corners in (wedge, -wedge)]
    gap, angle, side = 8.0, -0.5, math.radians(70.0)
    half, speed = 0.5 * (side - nearest_at * angle), 4.0 * angle * math.sin(side)
    start = np.array([[0.0, 0, 0], [4.0 * math.cos(side) + speed * nearest_at + gap + 4.0, 4.0 * math.sin(side), 0.0]])
    end = start + [[speed, 0.0, 0.0], [0.0, 0.0, 0.0]]
    turn = np.array([[math.cos(half), 0.0, 0.0, math.sin(half)], UPRIGHT])
    bodies = Moving(meshes, start, turn, end, np.array([[0.0, 0.0, angle], [0.0, 0.0, 0.0]]))
    for tolerance in (1e-4, 1e-8, 1e-12):
        found = bodies.distance(tolerance=tolerance)
        assert found.lower.item() <= gap * (1 + 1e-15) and found.upper.item() >= gap
        assert found.upper.item() - found.lower.item() <= tolerance + 3e-12


def test_many_turns() -> None:
    rng = np.random.default_rng(1)
    bodies = apart(rng, [tetrahedron(), tetrahedron()], 0.3, turn=60.0)
    found = bodies.distance(tolerance=1e-4)
    truth = bodies.truth((0, 1), samples=1001)
    assert found.lower.item() <= truth <= found.upper.item() + 1e-3 and found.converged.item()


def test_a_search_that_does_not_end_says_so() -> None:
    rng = np.random.default_rng(1)
    bodies = apart(rng, [tetrahedron(), tetrahedron()], 0.3, turn=3e5)
    found = bodies.distance()
    assert not found.converged.item() and 0.0 <= found.lower.item() < found.upper.item() < math.inf
    assert found.lower.item() <= bodies.truth((0, 1), samples=301)


@pytest.mark.parametrize("path", ["rigid", "linear"])
def test_the_reach_of_a_fast_body_bounds_its_distance(path: str) -> None:
    """A corner of an octahedron passes one of another at the distance of their spheres, some 50,000 times."""
    corners = [[1.0, 0, 0], [-1.0, 0, 0], [0, 1.0, 0], [0, -1.0, 0], [0, 0, 1.0], [0, 0, -1.0]]
    octahedron = pgccd.Mesh(corners, [[x, y, z] for x in (0, 1) for y in (2, 3) for z in (4, 5)])
    place, turn = np.array([[0.0, 0, 0], [3.0, 0, 0]]), np.array([[0.0, 0, 3e5], [0.0, 0, 0]])
    found = Moving([octahedron] * 2, place, np.tile(UPRIGHT, (2, 1)), place, turn, path).distance()
    assert found.converged.item() and 1.0 - 1e-8 < found.lower.item() <= 1.0 <= found.upper.item() + 1e-9


def test_a_search_that_is_cut_off_has_a_coarse_lower_bound() -> None:
    """A sphere turns within another one: very many triangles are equally near at all times."""
    rest = np.zeros((2, 3))
    spheres = [pgccd.Mesh.icosphere(radius, 4) for radius in (1.0, 1.05)]
    bodies = Moving(spheres, rest, np.tile(UPRIGHT, (2, 1)), rest, np.array([[0.0, 0, 1.0], [0.0, 0, 0]]))
    found = bodies.distance(tolerance=0.0)
    assert not found.converged.item() and 0.005 < found.lower.item() <= 0.05 <= found.upper.item() + 1e-2


def test_many_triangles_that_are_equally_near() -> None:
    """Two cones turn about their apexes: each triangle of one is as near to each of the other."""
    around = np.linspace(0.0, 2 * np.pi, 256, endpoint=False)
    rim = np.stack([np.cos(around), np.sin(around), np.ones(256)], axis=1)
    corners = np.concatenate([np.zeros((1, 3)), rim])
    faces = [[0, 1 + k, 1 + (k + 1) % 256] for k in range(256)]
    cones = [pgccd.Mesh(z * corners, faces, origin=[0.0, 0.0, z]) for z in (-1.0, 1.0)]
    place, turn = np.array([[0.0, 0, 0], [0.0, 0, 2.001]]), np.array([[1.0, 0, 0], [0.0, 0.7, 0]])
    found = Moving(cones, place, np.tile(UPRIGHT, (2, 1)), place, turn).distance()
    assert found.converged.item() and found.lower.item() <= 0.001 + 1e-15 <= found.upper.item() + 1e-12


@pytest.mark.parametrize("seed", range(6))
def test_points_of_surfaces_that_intersect_are_one_point_of_both(seed: int) -> None:
    rng = np.random.default_rng(seed)
    box, other = pgccd.Mesh.box([1.0, 1.0, 1.0]), bumpy(rng, 1)
    place = np.array([[0.0, 0, 0], [1.6, 0.1, 0.2]])
    bodies = Moving([box, other], place, unit_quaternions(rng, 2), place, rng.normal(size=(2, 3)))
    bodies.end = place - np.array([[0.0, 0, 0], [2.0, 0, 0]])
    found = bodies.distance(tolerance=0.0)
    assert found.upper.item() == 0.0
    points, t = found.points[0].numpy(), found.time.item()
    assert np.abs(points[1] - points[0]).max() < 1e-14
    for body in (0, 1):  # as a triangle that is one point
        surface = bodies.vertices_at(body, t), bodies.meshes[body].faces.numpy()
        assert boundary_distance(*surface, points[[body] * 3], np.array([[0, 1, 2]])) < 1e-13


def test_surfaces_that_intersect_or_touch() -> None:
    box = pgccd.Mesh.box([1.0, 1.0, 1.0])
    rng = np.random.default_rng(0)
    place = np.array([[0.0, 0, 0], [0.6, 0.5, 0.3]])
    crossing = at_rest([box, box], place, unit_quaternions(rng, 2)).distance()
    assert crossing.lower.item() == crossing.upper.item() == 0.0 and crossing.converged.item()
    for offset in ([1.0, 0.0, 0.0], [1.0, 1.0, 0.2], [1.0, 1.0, 1.0]):  # faces, edges, corners
        touching = at_rest([box, box], [[0.0, 0, 0], offset]).distance()
        assert touching.lower.item() == 0.0 <= touching.upper.item() < 1e-12
    # One passes through the other.
    through = Moving(
        [box, box],
        np.array([[0.0, 0, 0], [-3.0, 0.2, 0.1]]),
        np.tile(UPRIGHT, (2, 1)),
        np.zeros((2, 3)),
        np.zeros((2, 3)),
    )
    through.end = np.array([[0.0, 0, 0], [3.0, 0.2, 0.1]])
    found = through.distance()
    assert found.lower.item() == 0.0 and found.upper.item() < 1e-6 and found.converged.item()


def test_a_body_inside_another_has_the_distance_of_surfaces() -> None:
    shell, inner = pgccd.Mesh.box([4.0, 4.0, 4.0]), pgccd.Mesh.box([1.0, 1.0, 1.0])
    found = at_rest([shell, inner], [[0.0, 0, 0], [0.5, 0, 0]]).distance()
    assert found.lower.item() <= 1.0 <= found.upper.item() and found.upper.item() - found.lower.item() < 1e-12


def test_margins_are_subtracted() -> None:
    rng = np.random.default_rng(5)
    bodies = apart(rng, [bumpy(rng, 1), bumpy(rng, 1)], 0.3, turn=0.5, travel=0.2)
    bare = bodies.distance()
    bodies.margin = np.array([0.125, 0.0625])
    thick = bodies.distance()
    for name in ("lower", "upper"):
        assert getattr(thick, name).item() == pytest.approx(getattr(bare, name).item() - 0.1875, abs=1e-6)
    bodies.margin = np.array([2.0, 2.0])
    touching = bodies.distance()
    assert touching.lower.item() == touching.upper.item() == 0.0 and not torch.isnan(touching.points).any()


@pytest.mark.parametrize("turn", [0.0, 0.5])
def test_small_bodies_with_large_margins(turn: float) -> None:
    """As spheres and capsules are: the default tolerance is that of the thickened bodies."""
    speck = pgccd.Mesh([[1e-10, 0, 0], [-1e-10, 1e-10, 0], [-1e-10, -1e-10, 0]], [[0, 1, 2]])
    place = np.array([[0.0, 0, 0], [3.0, 0, 0]])
    turns = np.array([[0.0, 0, turn], [0.0, turn, 0]])
    bodies = Moving([speck, speck], place, np.tile(UPRIGHT, (2, 1)), place, turns, margin=np.full(2, 0.5))
    found = bodies.distance()
    assert found.converged.item() and found.lower.item() <= 2.0 <= found.upper.item() + 1e-9
    assert found.upper.item() - found.lower.item() <= 1e-6
    same = bodies.distance(tolerance=1e-6 * (speck.radius + 0.5))
    assert torch.equal(found.lower, same.lower) and torch.equal(found.upper, same.upper)


@pytest.mark.parametrize("side", [0, 1])
def test_a_body_far_from_its_axis(side: int) -> None:
    """A box on an arc of radius 8 starts at about 1.0 from one of two boxes, and later passes the other one at 0.2."""
    box = pgccd.Mesh.box([0.1] * 3)
    swung = pgccd.Mesh(box.vertices + torch.tensor([8.0, 0, 0]), box.faces, origin=[0.0] * 3)
    places = torch.tensor([[9.1, 0.0, 0.0], [8.3 * math.cos(1.0), 8.3 * math.sin(1.0), 0.0]])
    both = torch.cat([box.vertices + place for place in places]), torch.cat([box.faces, box.faces + len(box.vertices)])
    meshes = [swung, pgccd.Mesh(*both, origin=[0.0] * 3)]
    turns = np.array([[0.0, 0, 2.0], [0.0, 0, 0]])
    order = [1, 0] if side else [0, 1]
    rest = np.zeros((2, 3))
    found = Moving([meshes[b] for b in order], rest, np.tile(UPRIGHT, (2, 1)), rest, turns[order]).distance()
    assert 0.15 < found.lower.item() <= found.upper.item() < 0.25


@pytest.mark.parametrize("part", [0.5, 0.9, 0.99, 0.999, 1.0, 1.01])
def test_the_upper_bound_is_infinite_exactly_where_the_lower_one_is_above_the_cutoff(part: float) -> None:
    """Also where the search has found points that are further apart than the cutoff."""
    for seed in range(10):
        rng = np.random.default_rng(seed)
        bodies = apart(rng, [bumpy(rng, 1), tetrahedron()], 0.5, turn=1.0, travel=0.3)
        cutoff = part * bodies.distance().upper.item()
        found = bodies.distance(cutoff=cutoff)
        is_beyond = found.lower.item() > cutoff
        assert is_beyond == (part < 1.0) and found.converged.item()
        assert found.upper.isinf().item() == found.time.isnan().item() == found.points.isnan().all().item() == is_beyond


def test_pairs_beyond_the_cutoff() -> None:
    box = pgccd.Mesh.box([1.0, 1.0, 1.0])
    bodies = at_rest([box, box, box, box], [[0.0, 0, 0], [1.5, 0, 0], [4.0, 0, 0], [0, 9.0, 0]])
    near = bodies.distance(pairs=None, cutoff=2.0)
    assert near.pairs.tolist() == [[0, 1], [1, 2]]
    assert torch.allclose(near.upper, torch.tensor([0.5, 1.5], dtype=torch.float64))
    given = bodies.distance(pairs=torch.tensor([[2, 3], [0, 1], [0, 1]]), cutoff=2.0)
    assert given.pairs.tolist() == [[2, 3], [0, 1], [0, 1]]
    assert (
        given.lower[0] > 2.0 and given.upper[0] == math.inf and given.time[0].isnan() and given.points[0].isnan().all()
    )
    assert given.converged.all() and given.upper[1] == given.upper[2] == near.upper[0]
    assert len(bodies.distance(pairs=None, cutoff=0.1)) == 0
    overlapping = at_rest([box, box, box], [[0.0, 0, 0], [0.5, 0.3, 0.2], [3.0, 0, 0]], margin=np.full(3, 0.1))
    assert overlapping.distance(pairs=None, cutoff=0.0).pairs.tolist() == [[0, 1]]
    assert bodies.distance(pairs=None, cutoff=100.0).pairs.tolist() == torch.combinations(torch.arange(4)).tolist()


def test_deforming_bodies() -> None:
    rng = np.random.default_rng(2)
    meshes = [bumpy(rng, 1), bumpy(rng, 0)]
    start = [meshes[0].vertices.numpy(), meshes[1].vertices.numpy() + [2.6, 0, 0]]
    end = [x + 0.4 * rng.normal(size=x.shape) + 0.3 * directions(rng, 1) for x in start]
    scene = pgccd.Scene(meshes, [0, 1])
    motion = pgccd.VertexMotion(*(torch.tensor(np.concatenate(x)) for x in (start, end)))
    found = pgccd.distance(scene, motion, pairs=PAIR)
    at = [lambda t, a=a, b=b: (1 - t) * a + t * b for a, b in zip(start, end, strict=True)]
    truth = least_distance(at, [mesh.faces.numpy() for mesh in meshes])
    assert found.lower.item() <= truth + 1e-13 and truth <= found.upper.item() + 1e-9
    assert found.converged.item() and truth > 0.01
    still = pgccd.distance(scene, pgccd.VertexMotion(motion.x_t0, motion.x_t0), pairs=PAIR)
    assert still.upper.item() == pytest.approx(
        boundary_distance(start[0], meshes[0].faces.numpy(), start[1], meshes[1].faces.numpy()), abs=1e-12
    )


def test_a_trajectory_has_the_least_of_its_segments() -> None:
    rng = np.random.default_rng(8)
    meshes = [bumpy(rng, 0) for _ in range(3)]
    place = np.stack(
        [np.array([[0.0, 0, 0], [3.0, 0, 0], [0, 4.0, 0]]) + 0.5 * rng.normal(size=(3, 3)) for _ in range(4)]
    )
    turn = np.stack([unit_quaternions(rng, 3) for _ in range(4)])
    path = pgccd.Trajectory(torch.tensor(place), torch.tensor(turn))
    scene = pgccd.Scene(meshes, [0, 1, 2])
    pairs = torch.tensor([[1, 2], [0, 1], [0, 2]])
    found = pgccd.distance(scene, path, pairs=pairs)
    parts = [pgccd.distance(scene, path.segment(k), pairs=pairs) for k in range(3)]
    for name in ("lower", "upper"):
        assert torch.equal(getattr(found, name), torch.stack([getattr(part, name) for part in parts]).amin(dim=0))
    for row in range(3):
        segment = int(torch.stack([part.upper[row] for part in parts]).argmin())
        assert found.time[row].item() == pytest.approx((segment + parts[segment].time[row].item()) / 3, abs=1e-15)
        assert torch.equal(found.points[row], parts[segment].points[row])
    near = pgccd.distance(scene, path, cutoff=float(found.upper.max()) + 0.1)
    assert torch.equal(near.upper, found.upper[[1, 2, 0]])


def test_a_trajectory_converges_though_a_segment_further_apart_does_not() -> None:
    rng = np.random.default_rng(1)
    place = torch.zeros(3, 2, 3, dtype=torch.float64)
    place[:, 1, 0] = torch.tensor([1.5, 40.0, 40.0])
    turn = torch.zeros(2, 2, 3, dtype=torch.float64)
    turn[1] = torch.tensor(3e5 * directions(rng, 2))
    upright = torch.tensor(UPRIGHT, dtype=torch.float64).expand(2, 4).contiguous()
    path = pgccd.Trajectory(place, upright, rotation=turn)
    scene = pgccd.Scene([tetrahedron()], [0, 0])
    second = pgccd.distance(scene, path.segment(1), pairs=PAIR)
    found = pgccd.distance(scene, path, pairs=PAIR)
    assert not second.converged.item() and second.lower.item() > found.upper.item() and found.converged.item()


def scene_of_many(rng: np.random.Generator, device: torch.device | str) -> tuple[pgccd.Scene, pgccd.RigidMotion]:
    meshes = [bumpy(rng, 0), bumpy(rng, 1, size=0.6), stick(3.0, 0.05)]
    meshes.append(pgccd.Mesh(meshes[1].vertices, meshes[1].faces, origin=[0.7, 0.1, 0.0]))
    count = 40
    columns = (
        rng.uniform(0.0, 8.0, (count, 3)),
        unit_quaternions(rng, count),
        rng.normal(size=(count, 3)),
        rng.normal(size=(count, 3)),
    )
    margin = torch.tensor(rng.uniform(0.0, 0.1, count))
    scene = pgccd.Scene(meshes, torch.tensor(rng.integers(0, len(meshes), count)), device, margin=margin)
    x, q, v, w = (torch.tensor(column, device=device) for column in columns)
    return scene, pgccd.RigidMotion.from_velocity(x, q, v, w, dt=1.0)


@pytest.mark.parametrize("tolerance", [None, 1e-2])
def test_bits_do_not_depend_on_device_threads_or_order(device: torch.device, tolerance: float | None) -> None:
    made = [scene_of_many(np.random.default_rng(4), where) for where in ("cpu", device)]
    expected = pgccd.distance(*made[0], cutoff=1.0, tolerance=tolerance)
    assert len(expected) > 100 and (expected.upper == 0.0).any() and (expected.lower > 0.0).any()
    found = pgccd.distance(*made[1], cutoff=1.0, tolerance=tolerance)
    assert difference(columns_of(found), columns_of(expected)) is None
    order = torch.randperm(len(expected), generator=torch.Generator().manual_seed(0))
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        some = pgccd.distance(*made[1], cutoff=1.0, tolerance=tolerance, pairs=found.pairs[order.to(device)])
    finally:
        torch.set_num_threads(threads)
    assert difference(columns_of(some), {name: x[order] for name, x in columns_of(expected).items()}) is None


def test_deforming_bodies_have_the_same_bits_on_every_device(device: torch.device) -> None:
    columns = []
    for where in ("cpu", device):
        rng = np.random.default_rng(6)
        meshes = [bumpy(rng, 1) for _ in range(4)]
        start = np.concatenate([mesh.vertices.numpy() + 1.5 * k for k, mesh in enumerate(meshes)])
        ends = (torch.tensor(x, device=where) for x in (start, start + 0.2 * rng.normal(size=start.shape)))
        scene = pgccd.Scene(meshes, [0, 1, 2, 3], where)
        columns.append(columns_of(pgccd.distance(scene, pgccd.VertexMotion(*ends), cutoff=9.0)))
    assert difference(columns[1], columns[0]) is None and len(columns[0]["pairs"]) == 6


def test_contacts_agree_with_distances() -> None:
    """A pair collides with a separation below the lower bound never, and with one above the upper bound always."""
    scene, motion = scene_of_many(np.random.default_rng(9), "cpu")
    found = pgccd.distance(scene, motion, cutoff=1.5)
    for separation in (0.05, 0.4, 1.0):
        hits = pgccd.collide(scene, motion, min_separation=separation, tolerance=0.0).pairs.tolist()
        below = {tuple(pair) for pair in found.pairs[found.lower > separation].tolist()}
        above = {tuple(pair) for pair in found.pairs[found.upper <= separation].tolist()}
        colliding = {tuple(pair) for pair in hits}
        assert above <= colliding and not below & colliding and above and below


def test_wrong_arguments() -> None:
    scene = pgccd.Scene([tetrahedron()], [0, 0])
    motion = pgccd.RigidMotion.at_rest(torch.tensor([[0.0, 0, 0], [3.0, 0, 0]]), torch.tensor([UPRIGHT, UPRIGHT]))
    with pytest.raises(ValueError, match="cutoff: expected a length, unless pairs are given"):
        pgccd.distance(scene, motion)
    for cutoff in (-1.0, math.nan, math.inf):
        with pytest.raises(ValueError, match="cutoff: expected"):
            pgccd.distance(scene, motion, cutoff=cutoff)
    with pytest.raises(ValueError, match="tolerance: expected"):
        pgccd.distance(scene, motion, cutoff=1.0, tolerance=-1.0)
    for rows in ([[1, 0]], [[0, 2]], [[1, 1]]):
        with pytest.raises(ValueError, match="pairs: expected rows"):
            pgccd.distance(scene, motion, pairs=torch.tensor(rows))
    with pytest.raises(TypeError, match="scene: expected a pgccd.Scene"):
        pgccd.distance(motion, motion, cutoff=1.0)  # type: ignore[arg-type]
    with pytest.raises(TypeError, match="motion: expected a pgccd.RigidMotion"):
        pgccd.distance(scene, scene, cutoff=1.0)  # type: ignore[arg-type]
    x = torch.zeros(2, 3, dtype=torch.float64, requires_grad=True)
    with pytest.raises(ValueError, match="grad"):
        pgccd.distance(scene, pgccd.RigidMotion.at_rest(x, torch.tensor([UPRIGHT, UPRIGHT])), cutoff=1.0)


def test_no_pairs() -> None:
    scene = pgccd.Scene([tetrahedron()], [0])
    alone = pgccd.RigidMotion.at_rest(torch.zeros(1, 3), torch.tensor([UPRIGHT]))
    found = pgccd.distance(scene, alone, cutoff=1.0)
    assert len(found) == 0 and found.points.shape == (0, 2, 3) and repr(found) == "Distances(count=0, device=cpu)"


def test_the_lower_bound_of_a_trajectory_is_the_least_of_all_segments() -> None:
    """Where the tolerance is coarse, that of the segment with the least upper bound may be larger."""
    differing = 0
    for seed in range(20):
        rng = np.random.default_rng(seed)
        place = torch.tensor(np.array([[0.0, 0, 0], [2.6, 0, 0]]) + 0.2 * rng.normal(size=(6, 2, 3)))
        path = pgccd.Trajectory(place, torch.tensor(np.stack([unit_quaternions(rng, 2) for _ in range(6)])))
        scene = pgccd.Scene([bumpy(rng, 1)], [0, 0])
        found = pgccd.distance(scene, path, pairs=PAIR, tolerance=0.4)
        parts = [pgccd.distance(scene, path.segment(k), pairs=PAIR, tolerance=0.4) for k in range(5)]
        lower, upper = (torch.stack([getattr(part, name)[0] for part in parts]) for name in ("lower", "upper"))
        assert found.lower.item() == lower.min() and found.upper.item() == upper.min()
        differing += bool(lower[upper.argmin()] > lower.min())
    assert differing > 0


def test_a_trajectory_whose_nearest_segment_does_not_converge_says_so() -> None:
    place = torch.zeros(3, 2, 3, dtype=torch.float64)
    place[:, 1, 0] = torch.tensor([2.5, 2.5, 2.5])
    turn = torch.zeros(2, 2, 3, dtype=torch.float64)
    turn[1] = torch.tensor(3e5 * directions(np.random.default_rng(1), 2))
    upright = torch.tensor(UPRIGHT, dtype=torch.float64).expand(2, 4).contiguous()
    path = pgccd.Trajectory(place, upright, rotation=turn)
    found = pgccd.distance(pgccd.Scene([tetrahedron()], [0, 0]), path, pairs=PAIR)
    assert not found.converged.item() and found.upper - found.lower > 1e-6


def test_convergence_is_that_of_the_smaller_body() -> None:
    """A small body turns so fast near a large one that the search does not end."""
    sheet = pgccd.Mesh([[-1e7, -1e7, 0.0], [1e7, -1e7, 0.0], [0.0, 1e7, 0.0]], [[0, 1, 2]])
    turn = np.array([[0.0, 0, 0], 3e5 * directions(np.random.default_rng(1), 1)[0]])
    place = np.array([[0.0, 0, 0], [0.0, 0, 1.3]])
    found = Moving([sheet, tetrahedron()], place, np.tile(UPRIGHT, (2, 1)), place, turn).distance()
    assert 1e-6 < found.upper.item() - found.lower.item() < 1.0 and not found.converged.item()


def test_least_distances_of_bodies_and_links(device: torch.device) -> None:
    """Those of all pairs of a body; of links without pairs of their own bodies."""
    rng = np.random.default_rng(7)
    cube = pgccd.Mesh.box([0.1, 0.1, 0.1])
    scene = pgccd.Scene([cube], [0] * 9, device)
    x = torch.tensor(np.concatenate([rng.uniform(-1, 1, (8, 3)), [[9.0, 9.0, 9.0]]]), device=device)
    upright = torch.tensor([[1.0, 0.0, 0.0, 0.0]], dtype=torch.float64, device=device).expand(9, 4)
    near = pgccd.distance(scene, pgccd.RigidMotion.at_rest(x, upright), cutoff=3.0)
    lower, upper = near.of_bodies(9)
    owner = torch.tensor([0, 0, 1, 2, 2, 2, 1, 3, 4])
    of_links = near.of_bodies(owner)
    for found, bound in ((lower, near.lower), (upper, near.upper)):
        for body in range(9):
            assert float(found[body]) == min(bound[(near.pairs == body).any(dim=1)].tolist(), default=math.inf)
    groups = owner.to(device)[near.pairs]
    for found, bound in zip(of_links, (near.lower, near.upper), strict=True):
        for link in range(5):
            rows = (groups == link).any(dim=1) & (groups[:, 0] != groups[:, 1])
            assert float(found[link]) == min(bound[rows].tolist(), default=math.inf)
    assert math.isinf(float(lower[8])) and bool((lower[:8] <= upper[:8]).all())
    assert [len(bound) for bound in near[:0].of_bodies(0)] == [0, 0]
    for wrong in (7, [0] * 7, [-1] * 9):
        with pytest.raises(ValueError, match="^owner: expected"):
            near.of_bodies(wrong)
    with pytest.raises(TypeError, match="^owner: expected integers"):
        near.of_bodies([0.5] * 9)  # type: ignore[list-item]
