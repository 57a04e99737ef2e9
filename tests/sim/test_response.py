"""Response of robots to collisions: they stop, reverse, and never overlap."""

from __future__ import annotations

from fractions import Fraction
from typing import Any

import numpy as np
import pytest
import torch
from support.resolution import plain_resolution, plain_step, resolve_given
from support.steps import step_of
from torch import Tensor

import pgccd
from pgccd import ops
from pgccd.sim import Model, ModelConfig, respond
from pgccd.sim.model import RobotState
from pgccd.viz.raster import placed


def two_robots(distance: float) -> tuple[Model, RobotState]:
    """Two robots that approach each other along x."""
    model = Model(ModelConfig(robots=2, speed=0.01))
    state = model.start()
    state.position = torch.tensor([[0.0, 0.0, 0.0], [distance, 0.0, 0.0]], dtype=torch.float64)
    state.orientation = torch.tensor([[1.0, 0.0, 0.0, 0.0]] * 2, dtype=torch.float64)
    state.velocity = torch.tensor([[1.0, 0.0, 0.0], [-1.0, 0.0, 0.0]], dtype=torch.float64)
    state.angular_velocity = torch.tensor([[0.1, 0.0, 0.0], [0.0, 0.0, 0.0]], dtype=torch.float64)
    return model, state


def test_a_robot_stops_just_before_its_toi_and_turns_round() -> None:
    model, state = two_robots(3.0)
    scene = model.scene(state.id)
    hits = pgccd.detect(scene, model.motion(state), nonzero_toi=True)
    assert len(hits) == 1 and hits.toi is not None and 0.0 < hits.toi[0] < 1.0

    resolved = plain_step(model, state).resolution
    assert resolved.fraction.tolist() == [0.99 * float(hits.toi[0])] * 2
    assert (resolved.rounds, resolved.secondary_contacts) == (1, 0)
    after = respond(state, resolved.fraction)
    assert torch.equal(after.velocity, -state.velocity)
    assert torch.equal(after.angular_velocity, -state.angular_velocity)
    assert torch.equal(after.position, state.position + resolved.fraction[:, None] * state.velocity)
    angle = 0.1 * float(resolved.fraction[0])
    assert after.orientation[0].tolist() == pytest.approx([np.cos(angle / 2), np.sin(angle / 2), 0.0, 0.0], abs=1e-15)
    # After reversing they are free.
    assert len(pgccd.detect(scene, model.motion(after), nonzero_toi=True)) == 0


NO_CONTACTS = torch.zeros((0, 2), dtype=torch.int64), torch.zeros(0, dtype=torch.float64)
RULES = pytest.mark.parametrize("resolve", [resolve_given, plain_resolution])


@RULES
def test_a_robot_stops_for_one_that_stopped_in_its_way(resolve: Any) -> None:
    asked = []

    def find(changed: Tensor, fraction: Tensor) -> tuple[Tensor, Tensor]:
        asked.append((changed.tolist(), fraction.tolist()))
        if len(asked) == 1:  # 2 hits 1, which no longer yields
            return torch.tensor([[1, 2]]), torch.tensor([0.5], dtype=torch.float64)
        return NO_CONTACTS

    resolved = resolve(torch.tensor([[0, 1]]), torch.tensor([0.4], dtype=torch.float64), 4, find)
    assert [changed for changed, _ in asked] == [[True, True, False, False], [False, True, True, False]]
    assert resolved.fraction.tolist() == pytest.approx([0.99 * 0.4, 0.99 * 0.4 * 0.99 * 0.5, 0.99 * 0.5, 1.0])
    assert resolved.stopped.tolist() == [True, True, True, False]
    assert (resolved.rounds, resolved.secondary_contacts) == (2, 1)


@RULES
def test_resolution_ends_even_where_contacts_never_cease(resolve: Any) -> None:
    always = torch.tensor([[0, 1], [1, 2]]), torch.tensor([0.9, 0.9], dtype=torch.float64)
    resolved = resolve(*always, 4, lambda *_: always)
    assert resolved.fraction.tolist() == [0.0, 0.0, 0.0, 1.0]
    assert resolved.rounds < 10


@RULES
def test_robots_that_could_hardly_move_stay(resolve: Any) -> None:
    touching = torch.tensor([1e-3, 0.5], dtype=torch.float64)
    resolved = resolve(torch.tensor([[0, 1], [2, 3]]), touching, 4, lambda *_: NO_CONTACTS)
    assert resolved.fraction.tolist() == [0.0, 0.0, 0.99 * 0.5, 0.99 * 0.5]


def pierces(edges: np.ndarray, triangles: np.ndarray) -> bool:
    """Does any segment (E, 2, 3) cross any triangle (T, 3, 3)? From signs of volumes, all against all."""

    def volume(a: np.ndarray, b: np.ndarray, c: np.ndarray, d: np.ndarray) -> np.ndarray:
        return np.einsum("...k,...k->...", np.cross(b - a, c - a), d - a)

    p, q = (edges[:, None, end] for end in range(2))
    a, b, c = (triangles[None, :, corner] for corner in range(3))
    apart = volume(a, b, c, p) * volume(a, b, c, q) > 0
    sides = [volume(p, q, a, b), volume(p, q, b, c), volume(p, q, c, a)]
    around = (np.sign(sides[0]) == np.sign(sides[1])) & (np.sign(sides[1]) == np.sign(sides[2]))
    return bool((~apart & around).any())


def overlapping_pairs(model: Model, state: RobotState) -> list[tuple[int, int]]:
    """Pairs whose surfaces cross, by brute force in numpy, from the poses only."""
    mesh = model.meshes.meshes[0]
    vertices = placed(mesh.vertices.numpy(), state.position.numpy(), state.orientation.numpy())
    faces, edges = mesh.faces.numpy(), mesh.edges.numpy()
    found = []
    distance = torch.cdist(state.position, state.position).numpy()
    for i, j in zip(*np.nonzero(np.triu(distance < 2.0 * model.radius, 1)), strict=True):
        low = np.maximum(vertices[i].min(axis=0), vertices[j].min(axis=0))
        high = np.minimum(vertices[i].max(axis=0), vertices[j].max(axis=0))

        def inside(points: np.ndarray, low: np.ndarray = low, high: np.ndarray = high) -> np.ndarray:
            return points[((points.max(axis=1) >= low) & (points.min(axis=1) <= high)).all(axis=1)]

        for a, b in ((i, j), (j, i)):
            if pierces(inside(vertices[a][edges]), inside(vertices[b][faces])):
                found.append((int(i), int(j)))
                break
    return found


@pytest.mark.parametrize("pattern", ["random", "skewed"])
def test_robots_never_overlap(pattern: str) -> None:
    # Fast robots in a small model: many contacts in few steps.
    model = Model(ModelConfig(robots=64, pattern=pattern, speed=0.25, spin=0.5, seed=3))
    state, contacts = model.start(), 0
    for index in range(60):
        step = step_of(model, state, index)
        state = step.after
        contacts += step.record["contacts"]
        assert step.record["touching_at_t0"] == 0
    assert contacts > 100
    assert overlapping_pairs(model, state) == []
    # The check itself detects an overlap.
    state.position[1] = state.position[0] + torch.tensor([0.5, 0.1, 0.0], dtype=torch.float64)
    assert (0, 1) in overlapping_pairs(model, state)


@pytest.mark.slow
def test_collisions_do_not_pile_up() -> None:
    model = Model(ModelConfig(robots=125, speed=0.25))
    state = model.start()
    stopped = []
    for index in range(160):
        step = step_of(model, state, index)
        state = step.after
        stopped.append(step.record["stopped"])
    early, late = np.mean(stopped[40:100]), np.mean(stopped[100:])
    assert early > 5
    assert late < 1.35 * early


def test_equal_fractions_follow_the_whole_path() -> None:
    """The ends of shortened paths are within the bound of docs/explanation/exactness.md, 12, of the whole path."""
    model = Model(ModelConfig(robots=500, seed=6))
    state = model.plan(model.start(), 0)
    fraction = torch.rand(500, dtype=torch.float64, generator=torch.Generator().manual_seed(3))
    whole, part = model.motion(state), model.motion(state, fraction)
    unit, largest = Fraction(1, 2**53), Fraction(0)
    for row, f in enumerate(map(Fraction, fraction.tolist())):
        start, end = ([Fraction(x) for x in column[row].tolist()] for column in (whole.position_t0, whole.position_t1))
        at_end = [Fraction(x) for x in part.position_t1[row].tolist()]
        for x, y, z, v in zip(start, end, at_end, map(Fraction, state.velocity[row].tolist()), strict=True):
            error, bound = abs(x + f * (y - x) - z), unit * (2 * abs(x) + 3 * abs(v))
            assert error <= bound
            largest = max(largest, error / bound)
        turns = (column[row].tolist() for column in (whole.rotation, part.rotation))
        assert all(abs(f * Fraction(w) - Fraction(r)) <= unit * abs(Fraction(w)) for w, r in zip(*turns, strict=True))
    assert largest > Fraction(1, 4)  # the bound is not far above what occurs


def test_a_step_is_committed_unless_it_is_to_be_discarded(device: torch.device) -> None:
    model = Model(ModelConfig(robots=300, seed=8), device=device)
    state = model.start()
    planned = model.plan(state, 3)
    fraction = torch.rand(300, dtype=torch.float64, generator=torch.Generator().manual_seed(1)).to(device)
    expected, before = respond(planned, fraction), {name: x.clone() for name, x in state.columns.items()}
    plan = planned.velocity, planned.angular_velocity, planned.target, planned.stay_until
    columns = list(state.columns.values())
    ops.simulate_commit(columns, plan, fraction, torch.tensor([1], device=device))
    assert all(torch.equal(getattr(state, name), column) for name, column in before.items())
    ops.simulate_commit(columns, plan, fraction, torch.tensor([0], device=device))
    assert all(torch.equal(getattr(state, name), column) for name, column in expected.columns.items())
    assert not torch.equal(state.position, before["position"])
    with pytest.raises(RuntimeError, match="planned: expected 4 tensors, got 3"):
        ops.simulate_commit(columns, plan[:3], fraction, torch.tensor([0], device=device))
