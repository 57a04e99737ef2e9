"""Single steps of the simulation in one process."""

from __future__ import annotations

from pgccd import sim
from pgccd.distributed import Alone


def alone(model: sim.Model, state: sim.RobotState | None = None, graph: bool = False) -> sim.Simulation:
    """A simulation of all robots in this process, from a state or the start."""
    return sim.Simulation.create(Alone(), model, None, state, graph=graph)


def step_of(model: sim.Model, state: sim.RobotState, index: int) -> sim.Step:
    """A step of all robots from a state, run eagerly."""
    made = alone(model, state).step(index)
    assert isinstance(made, sim.Step)
    return made
