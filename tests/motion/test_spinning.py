"""Bodies that turn many times in a step, next to obstacles that they nearly or just touch."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from strategies import contacts
from support.candidates import found_contact
from support.shapes import bumpy, directions

import pgccd

TURNS = [30.0, 300.0, 1e4]


def wall(distance: float, normal: tuple[float, float, float]) -> pgccd.Mesh:
    """A large square of a few triangles, perpendicular to `normal`, at a distance from the origin."""
    n = np.array(normal) / np.linalg.norm(normal)
    e = np.linalg.svd(n[None])[2][1:]
    corners = np.array([[-3, -3], [4, -3], [4, 5], [-3, 5], [0.3, 0.2]]) @ e + distance * n
    return pgccd.Mesh(corners, [[0, 1, 4], [1, 2, 4], [2, 3, 4], [3, 0, 4]])


def spinning(
    mesh: pgccd.Mesh,
    obstacle: pgccd.Mesh,
    rotation: tuple[float, float, float],
    device: torch.device,
    travel: float = 0.0,
) -> tuple[pgccd.Scene, pgccd.RigidMotion]:
    """The mesh turns about the zero of its coordinates, which travels along -x; the obstacle's coordinates are used as
    given.
    """
    position = torch.zeros(2, 3, dtype=torch.float64, device=device)
    end = position.clone()
    end[0, 0] = -travel
    orientation = torch.tensor([[1.0, 0, 0, 0]] * 2, dtype=torch.float64, device=device)
    turn = torch.tensor([rotation, (0.0, 0.0, 0.0)], dtype=torch.float64, device=device)
    motion = pgccd.RigidMotion.from_rotation(position, orientation, end, turn)
    return pgccd.Scene([mesh, obstacle], device=device), motion


@pytest.mark.parametrize("angle", TURNS)
@pytest.mark.parametrize("gap", [0.01, 0.5])
@pytest.mark.parametrize("axis", [(0, 0, 1), (1, 0, 0), (1, 2, -1)])
def test_beside_a_wall(device: torch.device, angle: float, gap: float, axis: tuple[int, int, int]) -> None:
    """For any axis the wall stays out of reach: no contact, and none unresolved."""
    mesh = bumpy(np.random.default_rng(3), 1, 0.2)
    reach = float(mesh.vertices.norm(dim=1).max())
    unit = np.array(axis) / np.linalg.norm(axis)
    scene, motion = spinning(mesh, wall(reach * (1 + gap), (1, 0, 0)), tuple(angle * unit), device)
    found = pgccd.detect(scene, motion, "all", pairs=torch.tensor([[0, 1]], device=device))
    assert len(found) == 0 and found.stats.unresolved == 0


@pytest.mark.parametrize("angle", TURNS)
@pytest.mark.parametrize("gap", [0.002, 0.1])
def test_flat_side_to_the_wall(device: torch.device, angle: float, gap: float) -> None:
    """A square that turns in its own plane, close to a parallel wall: much closer than its corners' radius."""
    plate = pgccd.Mesh([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]], [[0, 1, 2], [0, 2, 3]])
    scene, motion = spinning(plate, wall(gap, (0, 0, 1)), (0.0, 0.0, angle), device)
    found = pgccd.detect(scene, motion, "all", pairs=torch.tensor([[0, 1]], device=device))
    assert len(found) == 0 and found.stats.unresolved == 0


@pytest.mark.parametrize("angle", TURNS)
@pytest.mark.parametrize("depth", [1e-5, 1e-2])
def test_tip_just_reaches_the_wall(device: torch.device, angle: float, depth: float) -> None:
    """A long spike, initially pointing away; its tip crosses the wall's plane by `depth` once per turn."""
    spike = pgccd.Mesh(
        [[0, 0, 0], [0.1, 0.02, 0.01], [0.1, -0.02, 0.01], [1, 0, 0]], [[0, 2, 1], [1, 2, 3], [0, 1, 3], [0, 3, 2]]
    )
    tip = spike.vertices[3].numpy()
    radius = math.hypot(tip[0], tip[1])
    start = math.atan2(tip[1], tip[0])
    scene, motion = spinning(spike, wall(radius - depth, (-1, 0, 0)), (0.0, 0.0, angle), device)
    found = pgccd.detect(scene, motion, "first", pairs=torch.tensor([[0, 1]], device=device))
    turned = math.pi - start - math.acos((radius - depth) / radius)
    assert len(found) == 1
    assert float(found.toi) <= turned / angle * (1 + 1e-12)
    assert float(found.toi) >= turned / angle - 2e-3 * math.sqrt(1e-6 / depth) / angle
    assert found.status.tolist() == [pgccd.Status.TOUCH]


@pytest.mark.parametrize("depth", [1e-3, 1e-2])
def test_arc_that_bulges_into_the_circle(device: torch.device, depth: float) -> None:
    """The tip of a second, slowly turning body comes into reach of the spinning one only in the middle of its arc: both
    ends of the chord are out of reach.
    """
    needle = pgccd.Mesh([[1, 0, 0], [-1, 0, 0], [0, 0.01, 0.01], [0, 0.01, -0.01]], [[0, 1, 2], [0, 3, 1]])
    # Smaller than the needle: along a fixed direction the needle's circle recedes less than the tip's arc bulges.
    corners = 0.2 * np.array([[-1.0, 0, 0], [0.5, 0.1, 0.4], [0.5, 0.1, -0.4]])
    hook = pgccd.Mesh(corners, [[0, 1, 2]])
    tip = hook.vertices[0].numpy()
    arm = float(np.hypot(tip[0], tip[1]))
    half = 0.75
    start = math.pi - half - math.atan2(tip[1], tip[0])
    position = torch.tensor([[0, 0, 0], [arm + 1 - depth, 0, 0]], dtype=torch.float64, device=device)
    orientation = [[1.0, 0, 0, 0], [math.cos(start / 2), 0, 0, math.sin(start / 2)]]
    rotation = [[0.0, 0, 300.0], [0.0, 0, 2 * half]]
    columns = [torch.tensor(x, dtype=torch.float64, device=device) for x in (orientation, rotation)]
    motion = pgccd.RigidMotion.from_rotation(position, columns[0], position, columns[1])
    found = pgccd.detect(pgccd.Scene([needle, hook], device=device), motion, "first")
    assert len(found) == 1
    # The needle sweeps over the tip at the latest half a turn after the tip enters its circle.
    away = np.linspace(0.0, 0.5, 100_001)
    reach = np.sqrt(arm**2 + (arm + 1 - depth) ** 2 - 2 * arm * (arm + 1 - depth) * np.cos(2 * half * away))
    entry = 0.5 - float(away[reach < 1.0].max())
    assert entry - 1e-4 < float(found.toi) < entry + math.pi / 298


@pytest.mark.parametrize("separation", [0.0, 0.25])
def test_tip_comes_within_reach_after_many_turns(device: torch.device, separation: float) -> None:
    """A spike drifts towards a wall; from t = 1/2 its tip comes within the separation once per turn."""
    spike = pgccd.Mesh(
        [[0, 0, 0], [0.1, 0.02, 0.01], [0.1, -0.02, 0.01], [1, 0, 0]], [[0, 2, 1], [1, 2, 3], [0, 1, 3], [0, 3, 2]]
    )
    tip = spike.vertices[3].numpy()
    radius, start = math.hypot(tip[0], tip[1]), math.atan2(tip[1], tip[0])
    obstacle = wall(radius + separation + 5e-4, (-1, 0, 0))
    scene, motion = spinning(spike, obstacle, (0.0, 0.0, 300.0), device, travel=1e-3)
    found = pgccd.detect(scene, motion, "first", separation, pairs=torch.tensor([[0, 1]], device=device))
    nearest = (math.pi - start + 2 * math.pi * np.arange(100)) / 300.0
    first = float(nearest[nearest > 0.5].min())
    assert 0.5 - first + 2 * math.pi / 300.0 > 2e-3  # a turn earlier it is outside the tolerance too
    assert len(found) == 1 and found.status.tolist() == [pgccd.Status.TOUCH]
    assert first - 1e-4 < float(found.toi) <= first


@pytest.mark.parametrize("depth", [-1e-4, 1e-4])
def test_tip_at_a_separation(device: torch.device, depth: float) -> None:
    """A spinning spike keeps a distance of 1/4 from a wall, or falls just below it."""
    spike = pgccd.Mesh(
        [[0, 0, 0], [0.1, 0.02, 0.01], [0.1, -0.02, 0.01], [1, 0, 0]], [[0, 2, 1], [1, 2, 3], [0, 1, 3], [0, 3, 2]]
    )
    radius = float(spike.vertices[:, :2].norm(dim=1).max())
    scene, motion = spinning(spike, wall(radius + 0.25 - depth, (-1, 0, 0)), (0.0, 0.0, 300.0), device)
    found = pgccd.detect(scene, motion, "first", 0.25, pairs=torch.tensor([[0, 1]], device=device))
    assert len(found) == (1 if depth > 0 else 0) and found.stats.unresolved == 0


def flat_spinner(rng: np.random.Generator, n: int, height: float, separation: float) -> contacts.Meetings:
    """A plate `height` above its origin turns 200 times in its own plane; a tip descends to the separation at t = 1."""
    along = directions(rng, n)
    plate = pgccd.Mesh(
        contacts.plate(1).vertices + torch.tensor([height, 0.0, 0.0]), contacts.plate(1).faces, (0.0,) * 3
    )
    rotation, velocity = np.zeros((2 * n, 3)), np.zeros((2 * n, 3))
    rotation[::2] = 400.0 * math.pi * along
    velocity[1::2] = -along
    return contacts.meet(
        [plate, contacts.spindle(0.5, 1)] * n,
        [(tuple(plate.faces[0].tolist()), (0,))] * n,
        [([1 / 3] * 3, [1.0])] * n,
        np.array([contacts.leading(way * d, rng.uniform(0, 6)) for d in along for way in (1.0, -1.0)]),
        rotation,
        velocity,
        np.ones(n),
        separation * along,
    )


def test_descent_to_exactly_the_separation() -> None:
    """The distance from the plane in which a plate spins has the rounding error of its height above the origin."""
    meetings = flat_spinner(np.random.default_rng(4), 40, 64.0, 2.0**-6)
    moving = pgccd.MovingBodies.of(meetings.bodies.scene(), meetings.bodies.motion())
    for k in range(len(meetings)):
        (key,) = meetings.touching(k)
        least = contacts.least_separation(contacts.distance_at(meetings, k))
        assert found_contact(meetings, moving, k, key, least) is not None, f"pair {k} is missed"


@pytest.mark.parametrize("turn", [0.25, 0.5, 1.0])
def test_arc_that_touches_in_the_middle_of_a_window(device: torch.device, turn: float) -> None:
    """The tip of a pendulum meets the plane in which a plate spins. When the plate's turns are cleared, the window ends
    where the pendulum's arc may deviate from its chord by a quarter of the gap: at half of it the tip is further from
    the chord than anywhere else, by the whole bound up to fourth order, and touches.
    """
    window, radius = 0.2, 1.0
    gap = (turn * window) ** 2 * radius / 2.0
    speed, half = 1.5 * gap / window, 0.5 * window
    plate = pgccd.Mesh([[-3, -2, 0], [3, -2, 0], [0, 4, 0]], [[0, 1, 2]], (0.0, 0.0, 0.0))
    pendulum = pgccd.Mesh([[0, 0, -radius], [0.01, 0, 0], [-0.01, 0, 0]], [[0, 1, 2]], (0.0, 0.0, 0.0))
    start = -0.5 * turn * half
    position = torch.tensor([[0, 0, 0], [0, 0, radius + speed * half]], dtype=torch.float64, device=device)
    end = position.clone()
    end[1, 2] -= speed
    orientation = [[1.0, 0, 0, 0], [math.cos(start), math.sin(start), 0, 0]]
    columns = [torch.tensor(x, dtype=torch.float64, device=device) for x in (orientation, [[0, 0, 3e5], [turn, 0, 0]])]
    motion = pgccd.RigidMotion.from_rotation(position, columns[0], end, columns[1])
    found = pgccd.detect(pgccd.Scene([plate, pendulum], device=device), motion, "first", tolerance=1e-9)
    assert len(found) == 1 and found.features.tolist() == [[0, 0]]
    assert half * (1 - 1e-4) < float(found.toi) <= half * (1 + 1e-12)


@pytest.mark.parametrize("half", [0.75, 1.5, 1.95])
def test_arc_of_an_edge_that_ends_on_the_axis(device: torch.device, half: float) -> None:
    """As the tip that bulges into the circle: the other end of its edge does not move, and does not bound the arc."""
    depth, arm = 0.01, 0.2
    needle = pgccd.Mesh([[1, 0, 0], [-1, 0, 0], [0, 0.01, 0.01], [0, 0.01, -0.01]], [[0, 1, 2], [0, 3, 1]])
    hook = pgccd.Mesh([[-arm, 0, 2e-4], [0, 0, -1], [0.01, 0, -1]], [[0, 1, 2]], (0.0, 0.0, 0.0))
    position = torch.tensor([[0, 0, 0], [arm + 1 - depth, 0, 0]], dtype=torch.float64, device=device)
    orientation = [[1.0, 0, 0, 0], [math.cos(half / 2), 0, 0, -math.sin(half / 2)]]
    rotation = [[0.0, 0, 300.0], [0.0, 0, 2 * half]]
    columns = [torch.tensor(x, dtype=torch.float64, device=device) for x in (orientation, rotation)]
    motion = pgccd.RigidMotion.from_rotation(position, columns[0], position, columns[1])
    moving = pgccd.MovingBodies.of(pgccd.Scene([needle, hook], device=device), motion)
    edges = [int((mesh.edges == torch.tensor([0, 1])).all(dim=1).nonzero()) for mesh in (needle, hook)]
    candidate = torch.tensor([[0, pgccd.Kind.EE, *edges]], dtype=torch.int32, device=device)
    rows = pgccd.narrow.find_contacts(moving, torch.tensor([[0, 1]], device=device), candidate, "all")
    assert len(rows[0]) == 1
    away = np.linspace(0.0, 0.5, 100_001)
    reach = np.sqrt(arm**2 + (arm + 1 - depth) ** 2 - 2 * arm * (arm + 1 - depth) * np.cos(2 * half * away))
    entry = 0.5 - float(away[reach < 1.0].max())
    assert entry - 1e-4 < float(rows[4]) < entry + math.pi / 290
