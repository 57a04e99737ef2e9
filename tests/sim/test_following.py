"""Robots that run into others which stopped in their way, although they never come near at equal times of the step."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from support.following import FAST, follow_plainly, without_times
from support.graphs import graphs_on
from support.resolution import plain_step, robot_rounds
from support.steps import alone, step_of

import pgccd
from pgccd.resolution.round_plan import RoundPlan
from pgccd.resolution.rounds import Fractions, resolve_collisions
from pgccd.runtime.stages import StageClock
from pgccd.search.passes import SearchPass, find_pass, pairs_of_rounds
from pgccd.sim import Model, ModelConfig, RobotState, robot_mesh
from pgccd.sim.simulation import FIRST_CONTACTS
from pgccd.sim.step_graph import CommittedStep

ROWS = 60


def rows_of_three(seed: int, speed: float, gap: float, kinds: int) -> tuple[Model, RobotState]:
    """Rows far from each other: two robots in random orientations, one behind the other, run into a third at rest."""
    big = robot_mesh()
    meshes = [big, pgccd.Mesh(0.9 * big.vertices, big.faces, "centroid")][:kinds]
    model = Model(ModelConfig(robots=3 * ROWS, speed=0.1), meshes)
    state, generator = model.start(), torch.Generator().manual_seed(seed)
    along, away = torch.arange(3.0).double().repeat(ROWS), 20.0 * torch.arange(float(ROWS)).repeat_interleave(3)
    state.position = torch.stack([gap * along, away.double(), torch.zeros(3 * ROWS).double()], dim=1)
    state.orientation = torch.randn(3 * ROWS, 4, dtype=torch.float64, generator=generator)
    state.orientation /= state.orientation.norm(dim=1, keepdim=True)
    state.velocity = torch.zeros_like(state.position)
    state.velocity[:, 0] = torch.where(along < 2.0, speed, 0.0)
    state.angular_velocity = 0.2 * torch.randn(3 * ROWS, 3, dtype=torch.float64, generator=generator)
    return model, state


def resolved(model: Model, state: RobotState, search_pass: SearchPass, pairs: torch.Tensor) -> Fractions:
    rounds, nothing = robot_rounds(model, state, search_pass, pairs), torch.zeros(1, dtype=torch.int64)
    return resolve_collisions(rounds, len(state), RoundPlan(), lambda _: nothing, StageClock()).resolution


@pytest.mark.parametrize("kinds", [1, 2])
@pytest.mark.parametrize(("speed", "gap"), [(1.6, 2.1), (1.6, 2.2), (4.0, 3.0), (0.15, 2.01)])
def test_a_robot_that_follows_a_stopped_one(speed: float, gap: float, kinds: int) -> None:
    model, state = rows_of_three(int(10 * speed), speed, gap, kinds)
    scene, motion = model.scene(state.id), model.motion(state)
    search_pass = find_pass(pgccd.MovingBodies.of(scene, motion), FIRST_CONTACTS, at_any_times=True)
    assert torch.equal(search_pass.pairs, pgccd.broad.find_pairs(search_pass.bodies))
    plain = plain_step(model, state).resolution
    found = resolved(model, state, search_pass, pairs_of_rounds([search_pass]))
    assert torch.equal(found.fraction, plain.fraction)
    assert (found.rounds, found.secondary_contacts) == (plain.rounds, plain.secondary_contacts)
    # Paths of `resolve` are computed in another way, up to rounding.
    anew = pgccd.resolve(scene, motion, initial="assume_free")
    torch.testing.assert_close(found.fraction, anew.fraction, rtol=1e-9, atol=1e-9)
    followers = {(k, k + 1) for k in range(0, 3 * ROWS, 3)}
    assert followers <= {tuple(pair) for pair in pairs_of_rounds([search_pass]).tolist()}
    assert followers.isdisjoint(tuple(pair) for pair in search_pass.pairs.tolist())
    if speed > 1.0:  # the pairs at equal times do not suffice
        assert not torch.equal(resolved(model, state, search_pass, search_pass.pairs).fraction, plain.fraction)


@pytest.mark.parametrize("name", list(FAST))
def test_fast_robots(name: str) -> None:
    expected = follow_plainly(name)
    model = Model(ModelConfig(**FAST[name]))
    state, scene = model.start(), model.scene(model.start().id)
    for index, line in enumerate(expected):
        step = step_of(model, state, index)
        state = step.after
        assert {key: step.record[key] for key in line} == line
        pcs = pgccd.broad.find_pairs(pgccd.MovingBodies.of(scene, model.motion(step.before)))
        assert step.record["pcs"] == len(pcs)


@pytest.mark.parametrize("name", list(FAST))
def test_fast_robots_in_replays(device: torch.device, name: str) -> None:
    expected = follow_plainly(name)
    model = Model(ModelConfig(**FAST[name]), device=device)
    made: list[Any] = []
    with graphs_on(device):
        simulation = alone(model, graph=True)
        for index, line in enumerate(expected):
            made.append(simulation.step(index, more=len(expected) - 1 - index))
            assert {key: made[-1].record[key] for key in line} == line
    assert any(isinstance(step, CommittedStep) for step in made)
    assert all(without_times(step.record)["touching_at_t0"] == 0 for step in made)
