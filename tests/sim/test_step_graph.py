"""Steps as replays of one graph: the same log as of eager steps, whatever fails."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any
from unittest import mock

import pytest
import torch
from support.capacities import ON_GPU
from support.graphs import graphs_on
from support.steps import alone, step_of

from pgccd.distributed import Alone
from pgccd.distributed.detection.options import PassEstimates
from pgccd.resolution import round_plan
from pgccd.resolution.round_plan import RecentRounds, RoundPlan
from pgccd.runtime import replayed_steps, transaction
from pgccd.runtime.sizes import BufferSizes
from pgccd.search import detect as pipeline
from pgccd.sim import CommittedStep, Model, ModelConfig, RobotState, Simulation, Step
from pgccd.sim import simulation as simulation_module
from pgccd.sim.step_graph import StepGraph

FAST: dict[str, Any] = {"robots": 150, "speed": 0.3, "spin": 0.5, "seed": 3}
STEPS = 40


@pytest.fixture
def graphs(device: torch.device, monkeypatch: pytest.MonkeyPatch) -> Iterator[list[StepGraph]]:
    """The captured graphs; replaced by a substitute on a CPU."""
    made: list[StepGraph] = []

    class Watched(StepGraph):
        def capture(self) -> Watched:
            made.append(super().capture())
            return self

    monkeypatch.setattr(simulation_module, "StepGraph", Watched)
    with graphs_on(device):
        yield made


def without_times(record: dict[str, Any]) -> dict[str, Any]:
    # A GPU tests other feature pairs on the way to the same contacts.
    return {name: value for name, value in record.items() if "seconds" not in name and name != "candidates"}


def run_eagerly(model: Model, steps: int) -> tuple[list[dict[str, Any]], RobotState]:
    simulation = alone(model)
    records = [without_times(simulation.step(index).record) for index in range(steps)]
    return records, simulation.state


def graph_of(model: Model, state: RobotState, index: int, rounds: int) -> StepGraph:
    """The graph of a step from this state, with so many rounds."""
    simulation = alone(model, state, graph=True)
    simulation.step(index)  # its sizes are learned
    simulation.state, simulation._recent = state, RecentRounds()
    simulation._recent.note(rounds - 1)
    return simulation._make_graph(index).capture()


def without_padding(graph: StepGraph, count: int) -> RobotState:
    return graph.state.map(lambda column: column[:count])


def same(found: RobotState, expected: RobotState) -> bool:
    return all(torch.equal(getattr(found, name), column) for name, column in expected.columns.items())


@pytest.mark.parametrize("pattern", ["random", "skewed"])
def test_same_steps(device: torch.device, graphs: list[StepGraph], pattern: str) -> None:
    model = Model(ModelConfig(pattern=pattern, **FAST), device=device)
    expected, last = run_eagerly(model, STEPS)
    simulation = alone(model, graph=True)
    kinds = []
    for index in range(STEPS):
        # In step 19 the state is read, as for a checkpoint.
        more = (19 if index < 20 else STEPS - 1) - index
        made = simulation.step(index, more=more)
        kinds.append(type(made))
        assert without_times(made.record) == expected[index]
        assert made.record["stage_seconds"].keys() >= {"broad", "traverse", "narrow", "respond"}
        assert simulation.is_ahead <= (more > 1)
    assert same(simulation.state, last)
    assert kinds[0] is kinds[19] is kinds[-1] is Step and kinds.count(CommittedStep) > STEPS // 2
    # Steps that need more rounds run eagerly, and a graph with more rounds is captured.
    rounds = [graph.rounds for graph in graphs]
    assert rounds == sorted(rounds) and rounds[-1] <= 1 + max(record["resolution_rounds"] for record in expected)
    assert len(graphs) > 1


def test_a_graph_goes_on_from_a_checkpoint(device: torch.device, graphs: list[StepGraph]) -> None:
    model = Model(ModelConfig(**FAST | {"speed": 0.0, "spin": 0.0}), device=device)
    simulation = alone(model, graph=True)
    kinds = [type(simulation.step(index, more=(9 if index < 10 else 19) - index)) for index in range(20)]
    assert kinds == [Step, *[CommittedStep] * 8, Step] + [CommittedStep] * 9 + [Step] and len(graphs) == 1


def test_a_step_that_fails_changes_nothing(device: torch.device, graphs: list[StepGraph]) -> None:
    """Steps enqueued after it change nothing either."""
    model = Model(ModelConfig(**FAST), device=device)
    state, index = model.start(), 0
    while True:
        before, made = state, step_of(model, state, index)
        state = made.after
        if made.resolution.rounds > 1:
            break
        index += 1
    graph = graph_of(model, before, index, made.resolution.rounds - 1)
    for _ in range(2):
        assert graph.replay().read(index) is None
        assert same(without_padding(graph, len(state)), before)
    enough = graph_of(model, before, index, made.resolution.rounds)
    committed = enough.replay().read(index)
    assert committed is not None and committed.rounds == made.resolution.rounds
    assert same(without_padding(enough, len(state)), state)
    assert without_times(committed.record) == without_times(made.record)
    # It continues from there; so does the failed one once its state is loaded.
    following = step_of(model, state, index + 1)
    graph.load(state.columns, index + 1)
    for each in (graph, enough):
        committed = each.replay().read(index + 1)
        assert (committed is not None) == (following.resolution.rounds <= each.rounds)
        assert same(without_padding(each, len(state)), state if committed is None else following.after)


@pytest.mark.parametrize("lacking", ["round", "step"])
@pytest.mark.parametrize("device", ON_GPU, indirect=True)
def test_too_little_capacity(
    device: torch.device, graphs: list[StepGraph], lacking: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    model = Model(ModelConfig(**FAST | {"robots": 20_000}), device=device)
    expected, last = run_eagerly(model, 12)
    simulation = Simulation.create(Alone(), model)
    graph_of_step = Simulation._graph_of

    def make_tight(simulation: Simulation, *arguments: Any) -> StepGraph:
        if not graphs:
            little = BufferSizes(10, 10)
            if lacking == "step":
                simulation._rank.estimates = PassEstimates()
                simulation._rank.estimates.own.learn(20_000, little)
            else:
                simulation._plan = RoundPlan()
                simulation._plan._capacities = [little]
        return graph_of_step(simulation, *arguments)

    monkeypatch.setattr(Simulation, "_graph_of", make_tight)
    kinds = []
    for index in range(12):
        made = simulation.step(index, more=11 - index)
        kinds.append(type(made))
        assert without_times(made.record) == expected[index]
    assert kinds[1] is Step and CommittedStep in kinds and len(graphs) > 1 and same(simulation.state, last)


@pytest.mark.parametrize("device", ON_GPU, indirect=True)
def test_a_graph_uses_more_memory_than_eager_steps_may(
    device: torch.device, graphs: list[StepGraph], monkeypatch: pytest.MonkeyPatch
) -> None:
    model = Model(ModelConfig(**FAST), device=device)
    expected, last = run_eagerly(model, 12)
    monkeypatch.setattr(pipeline, "memory_limit", lambda budget, *_: budget or 1)
    simulation = Simulation.create(Alone(), model)
    made = [simulation.step(index, more=11 - index) for index in range(12)]
    assert [without_times(step.record) for step in made] == expected and same(simulation.state, last)
    assert sum(type(step) is CommittedStep for step in made) > 6


def test_an_invalid_state(device: torch.device, graphs: list[StepGraph]) -> None:
    model = Model(ModelConfig(**FAST), device=device)
    simulation = alone(model, graph=True)
    for index in range(3):
        simulation.step(index, more=100)
    while simulation.is_ahead:
        index += 1
        simulation.step(index, more=1)
    graphs[-1].state.position[17, 1] = torch.nan
    with pytest.raises(ValueError, match="position(_t0)?: body 17"):
        simulation.step(index + 1, more=100)


def test_rounds_that_no_recent_step_needed(
    device: torch.device, graphs: list[StepGraph], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(round_plan, "_STEPS_OF_GRAPH", 6)
    model = Model(ModelConfig(**FAST | {"speed": 0.02, "spin": 0.0}), device=device)
    expected, last = run_eagerly(model, STEPS)
    simulation = alone(model, graph=True)
    simulation._recent.note(3)  # as if there had been more rounds
    for index in range(STEPS):
        assert without_times(simulation.step(index, more=STEPS - 1 - index).record) == expected[index]
    most = max(record["resolution_rounds"] for record in expected)
    assert most < 3 and [graph.rounds for graph in graphs][0] == 4 and graphs[-1].rounds <= most + 1
    assert same(simulation.state, last)


def test_without_a_graph(device: torch.device, graphs: list[StepGraph]) -> None:
    """If no graph is wanted, or none can be captured, with one warning."""
    model = Model(ModelConfig(**FAST), device=device)
    expected, _ = run_eagerly(model, 8)
    plain = alone(model)

    def fail(*_: Any) -> Any:
        raise RuntimeError("operation not permitted")

    assert [without_times(plain.step(index, more=7 - index).record) for index in range(8)] == expected
    simulation = alone(model, graph=True)
    # Not by monkeypatch, which would be undone after `graphs`, and restore its replacement.
    with (
        mock.patch.object(transaction, "capture", fail),
        pytest.warns(UserWarning, match="steps run without a CUDA graph: operation not permitted") as warned,
    ):
        assert [without_times(simulation.step(index, more=7 - index).record) for index in range(8)] == expected
    assert len(warned) == 1 and graphs == []


def test_no_room_for_an_eager_step_beside_the_graph(device: torch.device, graphs: list[StepGraph]) -> None:
    model = Model(ModelConfig(**FAST), device=device)
    expected, _ = run_eagerly(model, 8)
    simulation = alone(model, graph=True)
    with (
        mock.patch.object(replayed_steps, "has_room", lambda _: False),
        pytest.warns(UserWarning, match="steps run without a CUDA graph: too little memory") as warned,
    ):
        made = [simulation.step(index, more=7 - index) for index in range(8)]
    assert [without_times(step.record) for step in made] == expected
    assert len(warned) == 1 and len(graphs) == 1 and not any(isinstance(step, CommittedStep) for step in made)


def test_a_replay_tells_that_it_was_asked_to_stop(device: torch.device, graphs: list[StepGraph]) -> None:
    model = Model(ModelConfig(**FAST), device=device)
    simulation = alone(model, graph=True)
    made = [simulation.step(index, stop=index == 4, more=11 - index) for index in range(8)]
    assert isinstance(made[-1], CommittedStep) and [step.stop_requested for step in made][:4] == [False] * 4
    assert made[-1].stop_requested and "ranks" not in made[-1].record
