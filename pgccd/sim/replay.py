"""Steps of a simulation as replays of a graph, made launch by launch where a graph does not do."""

from __future__ import annotations

import warnings
from abc import ABC, abstractmethod
from collections import deque
from typing import Generic, Protocol, TypeVar

import torch
from torch import Tensor

from pgccd.detection import broad
from pgccd.detection.bodies import MovingBodies
from pgccd.detection.memory import is_out_of_memory
from pgccd.detection.parts import find_part
from pgccd.sim.captured import GRAPH_SLACK, CommittedStep, Searches, StepGraph, StepReplay
from pgccd.sim.model import Model, RobotState
from pgccd.sim.partners import FIRST_CONTACTS, Partners
from pgccd.sim.resolution import OneRank, Resolution
from pgccd.sim.step import Step, StepPlan, make_step

# Of so many steps the one with the most rounds decides how many a graph has.
_RECENT_STEPS = 64
# A graph is worth capturing if so many steps follow.
_FEWEST_REPLAYS = 4


class MadeStep(Protocol):
    """A step made launch by launch."""

    @property
    def resolution(self) -> Resolution: ...


M = TypeVar("M", bound=MadeStep)


class ReplayedSteps(ABC, Generic[M]):
    """Makes steps that follow one another. The first is made launch by launch, and a graph of what it needed captured;
    the next ones are replays of that, of which two at most are enqueued at a time. A step that the graph could not make
    is made launch by launch, and a larger graph captured. On many ranks all come to the same decisions, since these
    follow from what all have been told.

    Args:
        wants_graph: whether steps are replayed.
    """

    def __init__(self, wants_graph: bool) -> None:
        self._wants_graph = wants_graph
        self._graph: StepGraph | None = None
        self._under_way: deque[StepReplay] = deque()
        self._rounds: deque[int] = deque(maxlen=_RECENT_STEPS)
        # Whether the next step is one that a graph is not made for.
        self._must_launch = False

    @abstractmethod
    def _launch(self, index: int) -> M:
        """Makes a step launch by launch, and goes on from the state it ends in."""

    @abstractmethod
    def _capture(self, index: int, rounds: int) -> StepGraph:
        """A graph of the next step, in the capacities that the last one needed and somewhat more."""

    @abstractmethod
    def _load(self, graph: StepGraph, index: int) -> bool:
        """Lets the graph go on from the state. False: it does not fit."""

    @abstractmethod
    def _take(self, graph: StepGraph) -> None:
        """Goes on from the graph's state."""

    def _read(self, replay: StepReplay, index: int) -> CommittedStep | None:
        """Waits for a step; None: it was not committed."""
        return replay.read(index)

    def _needs_launch(self, step: CommittedStep) -> bool:
        """Whether the step after this one must be made launch by launch."""
        return False

    def _is_settled(self) -> bool:
        """Whether the next step is likely to need what the last one needed, so that a graph of it will do."""
        return True

    def _is_captured(self, captured: bool) -> bool:
        """Whether all ranks could capture a graph, given whether this one could."""
        return captured

    @property
    def is_ahead(self) -> bool:
        """Whether a GPU has been given the next step already."""
        return bool(self._under_way)

    def _advance(self, index: int, more: int) -> M | CommittedStep:
        """Makes a step.

        Args:
            index: one more than that of the step before.
            more: how many follow before the state is asked for, or the whole outcome of a step. The last of them is not
                replayed.
        """
        if not self._under_way:
            renew = self._graph is None or self._has_idle_rounds
            if renew or not more or self._must_launch:
                return self._launch_and_load(index, more, renew and more > 0)
            assert self._graph is not None
            self._under_way.append(self._graph.replay())
        assert self._graph is not None
        if more > 1 and len(self._under_way) < 2 and not (self._has_idle_rounds or self._must_launch):
            self._under_way.append(self._graph.replay())
        committed = self._read(self._under_way.popleft(), index)
        if committed is None:
            self._under_way.clear()  # they have changed nothing
            return self._launch_and_load(index, more, renew=True)
        self._rounds.append(committed.rounds)
        self._must_launch = self._needs_launch(committed)
        return committed

    @property
    def _has_idle_rounds(self) -> bool:
        """Whether the graph makes rounds that no recent step needed."""
        return self._graph is not None and len(self._rounds) == _RECENT_STEPS and max(self._rounds) < self._graph.rounds

    def _launch_and_load(self, index: int, more: int, renew: bool) -> M:
        """A step launch by launch. After it the graph goes on; or there is a new one, if enough steps follow."""
        if self._graph is not None:
            self._take(self._graph)
        made = self._launch(index)
        self._rounds.append(made.resolution.rounds)
        self._must_launch = False
        if self._graph is not None and (renew or not self._load(self._graph, index + 1)):
            self._graph = None
        if self._graph is None and self._wants_graph and more >= _FEWEST_REPLAYS and self._is_settled():
            self._graph = self._try_to_capture(index + 1)
        return made

    def _try_to_capture(self, index: int) -> StepGraph | None:
        if torch.cuda.is_initialized():
            torch.cuda.empty_cache()  # a graph has memory of its own
        graph, why = None, "another rank could not capture it"
        try:
            graph = self._capture(index, max(self._rounds))
        except RuntimeError as error:
            why = "too little memory" if is_out_of_memory(error) else str(error)
        if self._is_captured(graph is not None):
            return graph
        warnings.warn(f"steps are launched kernel by kernel: no CUDA graph of them: {why}", stacklevel=2)
        self._wants_graph = False
        return None


class StepMaker(ReplayedSteps[Step]):
    """Makes the steps of a simulation in one process, on a GPU as replays of a graph where several follow one another.

    Args:
        model: the rules.
        state: of all robots.
        broad_phase: as for `detect`.
        graph: whether steps are replayed. Default: on a GPU.

    Example:
        >>> steps = pgccd.sim.StepMaker(model, model.start())
        >>> steps.step(0, more=1).record["contacts"]
    """

    def __init__(
        self, model: Model, state: RobotState, broad_phase: broad.BroadPhase = "auto", graph: bool | None = None
    ) -> None:
        super().__init__(model.device.type == "cuda" if graph is None else graph)
        self._model, self._broad_phase = model, broad_phase
        self._state, self._scene = state, model.scene(state.id)
        self._plan = StepPlan()

    @property
    def state(self) -> RobotState:
        """After the last step, in memory of its own. No step may be under way: see `is_ahead`."""
        if self._graph is not None:
            self._take(self._graph)
        return self._state

    def step(self, index: int, more: int = 0) -> Step | CommittedStep:
        """Makes a step.

        Args:
            index: one more than that of the step before.
            more: how many follow before the state is asked for, or the whole outcome of a step. The last of them is not
                replayed.

        Raises:
            ValueError: the state is invalid.
        """
        return self._advance(index, more)

    def _launch(self, index: int) -> Step:
        made = make_step(self._model, self._scene, self._state, index, self._broad_phase, self._plan)
        self._state = made.after
        return made

    def _capture(self, index: int, rounds: int) -> StepGraph:
        return capture_step(self._model, self._state, index, self._broad_phase, self._plan, rounds)

    def _load(self, graph: StepGraph, index: int) -> bool:
        graph.load(self._state, index)
        return True

    def _take(self, graph: StepGraph) -> None:
        self._state = RobotState(**{name: column.clone() for name, column in graph.state.columns.items()})


def capture_step(
    model: Model, state: RobotState, index: int, broad_phase: broad.BroadPhase, plan: StepPlan, rounds: int
) -> StepGraph:
    """The graph of a step of all robots in one process; arguments as for `StepGraph`."""
    scene = model.scene(state.id)

    def search(planned: RobotState, discard: Tensor) -> Searches:
        bodies = MovingBodies(scene, model.motion(planned), wait=False)
        part = find_part(bodies, FIRST_CONTACTS, broad_phase, discard=discard, estimate=plan.pairs, slack=GRAPH_SLACK)
        partners = Partners(model, planned.moving_columns, None, part.pairs)
        return Searches([part], partners, planned.id, OneRank(), bodies.first_faults()[-1:])

    return StepGraph(model, state, index, search, plan.rounds, rounds)
