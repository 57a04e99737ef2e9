"""Start, motion and boundaries of worlds."""

from __future__ import annotations

import functools
import math

import pytest
import torch
from support.cases import checked_as
from support.steps import step_of

import pgccd
from pgccd import ops
from pgccd.sim import Model, ModelConfig, RobotState, robot_mesh
from pgccd.sim.model import lattice_cells


def drift(model: Model, steps: int) -> list[RobotState]:
    """The planned states of a world without collision response."""
    state, seen = model.start(), []
    for step in range(steps):
        state = model.plan(state, step)
        seen.append(state)
        position, orientation, _, _ = ops.simulate_respond(
            list(state.columns.values()), torch.ones(len(state)).double()
        )
        state = RobotState(**(state.columns | {"position": position, "orientation": orientation}))
    return seen


@pytest.mark.parametrize("robots", [1, 2, 7, 8, 9, 1000, 1729])
@pytest.mark.parametrize("pattern", ["random", "skewed"])
def test_no_volumes_overlap_at_the_start(robots: int, pattern: str) -> None:
    model = Model(ModelConfig(robots=robots, pattern=pattern, seed=robots))
    state = model.start()
    distance = torch.cdist(state.position, state.position) + torch.eye(robots) * 9.0
    assert distance.min() > 2.0 * model.radius
    assert (state.position.abs() + model.radius < torch.tensor(model.half_extent)).all()
    assert torch.allclose(state.orientation.norm(dim=1), torch.ones(robots, dtype=torch.float64), atol=1e-15)


def test_sbvs_fill_a_quarter_of_the_box() -> None:
    assert Model(ModelConfig(robots=8000)).describe()["sbv_volume_fraction"] == pytest.approx(0.25, abs=0.001)


@pytest.mark.parametrize("robots", [1, 5, 63, 64, 65, 10_000, 123_456, 10_000_000])
def test_lattices_are_near_cubic_and_large_enough(robots: int) -> None:
    cells = lattice_cells(robots)
    assert math.prod(cells) >= robots
    assert (cells[2] - 1) * cells[0] * cells[1] < robots
    assert max(cells) - min(cells) <= 2 or min(cells) > 0.9 * max(cells)


def test_a_part_of_the_robots_starts_as_in_the_whole() -> None:
    model = Model(ModelConfig(robots=1000, pattern="skewed"))
    some = torch.tensor([0, 3, 501, 999])
    whole, part = model.start(), model.start(some)
    for name, column in part.columns.items():
        assert torch.equal(column, whole.columns[name][some])


@pytest.mark.parametrize("pattern", ["random", "skewed"])
def test_steps_are_as_long_as_promised_and_end_inside(pattern: str) -> None:
    model = Model(ModelConfig(robots=500, pattern=pattern))
    reach = torch.tensor(model.half_extent) - model.radius
    lengths = []
    for state in drift(model, 120):
        assert ((state.position + state.velocity).abs() <= reach).all()
        lengths.append(state.velocity.norm(dim=1))
        assert state.angular_velocity.norm(dim=1).max() <= 0.1 + 1e-12
    moving = torch.cat(lengths) / model.radius
    assert moving.max() <= 0.15 + 1e-12
    if pattern == "random":
        assert moving.min() >= 0.05 - 1e-12
        assert moving.mean() == pytest.approx(0.1, abs=0.002)


def test_random_directions_are_uniform() -> None:
    state = Model(ModelConfig(robots=20_000)).start()
    heading = state.velocity / state.velocity.norm(dim=1, keepdim=True)
    assert heading.mean(dim=0).abs().max() < 0.02
    assert (heading.T @ heading / len(state) - torch.eye(3) / 3).abs().max() < 0.02


def test_skewed_robots_visit_corners_and_leave_again() -> None:
    model = Model(ModelConfig(robots=64, pattern="skewed", stay_steps=(10, 20)))
    corner_distance, first_target, left = [], None, torch.zeros(64, dtype=torch.bool)
    for state in drift(model, 400):
        first_target = state.target if first_target is None else first_target
        left |= state.target != first_target
        corner = torch.stack([(state.target >> axis & 1) * 2 - 1 for axis in range(3)], dim=1)
        aim = corner * (torch.tensor(model.half_extent) - model.radius)
        staying = state.stay_until >= 0
        corner_distance.append((aim - state.position).norm(dim=1)[staying])
    assert first_target is not None and set(first_target.tolist()) == set(range(8))
    assert left.float().mean() > 0.9
    assert torch.cat(corner_distance).median() < 0.4 * min(model.half_extent)


def test_kinds_are_dealt_out_in_turn() -> None:
    big = robot_mesh()
    small = pgccd.Mesh(0.5 * big.vertices, big.faces, "centroid")
    model = Model(ModelConfig(robots=9), [small, big])
    assert model.radius == big.radius
    assert model.scene(model.start().id).mesh_index.tolist() == [0, 1] * 4 + [0]
    expected = (5 * 0.125 + 4) / 9 * Model(ModelConfig(robots=9)).describe()["sbv_volume_fraction"]
    assert model.describe()["sbv_volume_fraction"] == pytest.approx(expected, rel=1e-5)


@pytest.mark.parametrize(
    ("wrong", "field"),
    [
        ({"robots": 0}, "robots"),
        ({"robots": 2**31}, "robots"),
        ({"pattern": "spiral"}, "pattern"),
        ({"seed": 2**63}, "seed"),
        ({"spacing": 2.0}, "spacing"),
        ({"spacing": math.nan}, "spacing"),
        ({"speed": -0.1}, "speed"),
        ({"speed": 1.0, "robots": 1}, "speed"),
        ({"spin": math.inf}, "spin"),
        ({"course_steps": 0.5}, "course_steps"),
        ({"stay_steps": (5, 4)}, "stay_steps"),
        ({"stopping_round": 0}, "stopping_round"),
    ],
)
def test_bad_configurations_name_the_field(wrong: dict, field: str) -> None:
    with pytest.raises(ValueError, match=f"^{field}: "):
        ModelConfig(**wrong)


@checked_as
def test_operators_have_consistent_fake_kernels(utilities: tuple[str, ...]) -> None:
    check = functools.partial(torch.library.opcheck, test_utils=utilities)
    model = Model(ModelConfig(robots=5, pattern="skewed"))
    state = model.start()
    columns = list(state.columns.values())
    half = torch.full((5,), 0.5, dtype=torch.float64)
    settings = (model._integers, model._scales)
    check(torch.ops.pgccd.simulate_start, (state.id, *settings))
    check(torch.ops.pgccd.simulate_plan, (columns, torch.tensor([3]), *settings))
    check(torch.ops.pgccd.simulate_respond, (columns, half))
    plan = [state.velocity, state.angular_velocity, state.target, state.stay_until]
    discard = torch.zeros(1, dtype=torch.int64)
    copies = [column.clone() for column in state.columns.values()]
    check(torch.ops.pgccd.simulate_commit, (copies, plan, half, discard))
    check(torch.ops.pgccd.random_uniforms, (state.id, 1, 2, 3))


def test_results_do_not_depend_on_the_number_of_threads() -> None:
    model = Model(ModelConfig(robots=300, seed=5))

    def hashes() -> list[tuple[str, str]]:
        state, found = model.start(), []
        for index in range(12):
            step = step_of(model, state, index)
            state = step.after
            found.append((step.record["contacts_hash"], step.record["state_hash"]))
        return found

    before = torch.get_num_threads()
    try:
        torch.set_num_threads(1)
        alone = hashes()
        torch.set_num_threads(4)
        assert hashes() == alone
    finally:
        torch.set_num_threads(before)
    assert len({contacts for contacts, _ in alone}) > 6  # the pairs have contacts
