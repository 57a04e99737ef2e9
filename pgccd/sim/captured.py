"""Steps of the model as replays of one CUDA graph, so that the host is not what a GPU waits for.

A step is a transaction: it reads the state, and commits on the device if no capacity was exceeded, all collisions are
resolved and the poses are valid. Otherwise it changes nothing, and neither do the steps enqueued behind it, until the
host has read its record, made the step itself and captured a graph of more capacity or more rounds.
"""

from __future__ import annotations

import warnings
from collections import deque
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from pgccd import ops
from pgccd.detection import broad
from pgccd.detection.bodies import MovingBodies
from pgccd.detection.capacity import COUNT_ROWS, Counts
from pgccd.detection.memory import is_out_of_memory
from pgccd.detection.parts import find_part, search_seconds
from pgccd.runtime.events import record_event
from pgccd.runtime.graph import capture
from pgccd.runtime.stages import StageClock
from pgccd.sim.model import Model, RobotState
from pgccd.sim.partners import FIRST_CONTACTS, Partners
from pgccd.sim.resolution import OVERFLOWS, Attempt, OneRank
from pgccd.sim.step import Step, StepPlan, make_step
from pgccd.sim.tally import COUNTED, Tally, count_step, work_of_counts

# Of so many steps the one with the most rounds decides how many a graph has.
_RECENT_STEPS = 64
# A graph is worth capturing if so many steps follow.
_FEWEST_REPLAYS = 4


@dataclass
class CommittedStep:
    """A step that was committed on the device."""

    index: int  #: from 0
    rounds: int  #: of collision resolution
    seconds: float  #: on the device
    counts: NDArray[np.int64]  #: (1 + rounds, 21): `Counts` of the whole step and of each round
    counted: NDArray[np.int64]  #: (6,) by `count_step`

    @cached_property
    def record(self) -> dict[str, Any]:
        """Its line in steps.jsonl; the stage "respond" is all but detection."""
        secondary = self.counts[1:, COUNT_ROWS["contacts"]].sum(keepdims=True)
        tally = Tally.of(work_of_counts(self.counts[None, :1], secondary), self.counted[None])
        whole = Counts.of(self.counts[0].tolist())
        stages = {"broad": whole.seconds["broad"]} | search_seconds(whole)
        clock = StageClock.of(stages | {"respond": max(0.0, self.seconds - sum(stages.values()))}, self.seconds)
        return tally.record(self.index, self.rounds, clock)


class StepGraph:
    """One step as a CUDA graph, from a state in fixed memory to the next one.

    Args:
        model: the rules.
        state: of all robots; copied.
        index: number of the step to be made.
        broad_phase: as for `detect`.
        plan: of earlier steps: the graph's capacities.
        rounds: of collision resolution.
    """

    def __init__(
        self, model: Model, state: RobotState, index: int, broad_phase: broad.BroadPhase, plan: StepPlan, rounds: int
    ) -> None:
        self._model, self._scene = model, model.scene(state.id)
        self._broad_phase, self._plan, self.rounds = broad_phase, plan, rounds
        self.state = RobotState(**{name: column.clone() for name, column in state.columns.items()})
        self._index = torch.full((1,), index, dtype=torch.int64, device=model.device)
        # 1 once a step has not been committed: those behind it are not either.
        self._failed = torch.ones(1, dtype=torch.int64, device=model.device)
        self._is_overflow = torch.zeros(len(COUNT_ROWS), dtype=torch.int64, device=model.device)
        self._is_overflow[OVERFLOWS] = 1
        self._graph, self._record = capture(self._step, model.device)
        self._failed.zero_()
        pinned = model.device.type == "cuda"
        self._hosts = [torch.empty(self._record.shape, dtype=torch.int64, pin_memory=pinned) for _ in range(2)]
        self._replays = 0

    def load(self, state: RobotState, index: int) -> None:
        """Goes on from another state of the same robots."""
        for name, column in self.state.columns.items():
            column.copy_(getattr(state, name))
        self._index.fill_(index)
        self._failed.zero_()

    def _step(self) -> Tensor:
        """plan, detect, resolve, commit, count. Returns the record: whether it failed, changes of rounds, counts."""
        model, state = self._model, self.state
        planned = model.plan(state, self._index)
        bodies = MovingBodies(self._scene, model.motion(planned), wait=False)
        part = find_part(bodies, FIRST_CONTACTS, self._broad_phase, discard=self._failed, estimate=self._plan.pairs)
        partners = Partners(model, planned.moving_columns, None, part.pairs)
        attempt = Attempt([part], len(state), partners, self._plan.rounds, OneRank(), StageClock())
        changes = [attempt.begin()]
        more_changes, counts = attempt.make_rounds(self.rounds)
        changes.append(more_changes)
        searched = torch.stack([part.counts(), *counts])
        left = torch.cat(changes)[-1:]  # nonzero: the last round has changed a robot
        overflow = (searched * self._is_overflow).sum().reshape(1)
        failed = self._failed + left + overflow + bodies.first_faults()[-1:]
        self._failed.copy_(failed.clamp(max=1))
        plan = planned.velocity, planned.angular_velocity, planned.target, planned.stay_until
        ops.simulate_commit(list(state.columns.values()), plan, attempt.fraction, self._failed)
        counted = count_step(state, attempt.fraction, state.id, *part.first_contacts())
        self._index += 1 - self._failed
        return torch.cat([self._failed, *changes, searched.reshape(-1), counted])

    def replay(self) -> StepReplay:
        """Makes a step, if those before it were committed. Waits for nothing."""
        host = self._hosts[self._replays % len(self._hosts)]
        self._replays += 1
        began = record_event(timed=True)
        self._graph.replay()
        host.copy_(self._record, non_blocking=True)
        return StepReplay(self.rounds, host, began, record_event(timed=True))


@dataclass(frozen=True)
class StepReplay:
    """A step that a GPU was given. It must be read before the second one after it is enqueued."""

    rounds: int  #: made
    host: Tensor  #: the record, once `ended`
    began: torch.cuda.Event
    ended: torch.cuda.Event

    def read(self, index: int) -> CommittedStep | None:
        """Waits for the step; None: it was not committed."""
        self.ended.synchronize()
        numbers = self.host.numpy().copy()
        if numbers[0]:
            return None
        changes = numbers[1 : 2 + self.rounds]
        rounds = int(np.argmin(changes))
        counts = numbers[2 + self.rounds : -COUNTED].reshape(1 + self.rounds, len(COUNT_ROWS))
        return CommittedStep(index, rounds, 1e-3 * self.began.elapsed_time(self.ended), counts, numbers[-COUNTED:])


class StepMaker:
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
        self._model, self._broad_phase = model, broad_phase
        self._state, self._scene = state, model.scene(state.id)
        self._plan = StepPlan()
        self._wants_graph = model.device.type == "cuda" if graph is None else graph
        self._graph: StepGraph | None = None
        self._under_way: deque[StepReplay] = deque()
        self._rounds: deque[int] = deque(maxlen=_RECENT_STEPS)

    @property
    def state(self) -> RobotState:
        """After the last step, in memory of its own. No step may be under way: see `is_ahead`."""
        if self._graph is None:
            return self._state
        return RobotState(**{name: column.clone() for name, column in self._graph.state.columns.items()})

    @property
    def is_ahead(self) -> bool:
        """Whether a GPU has been given the next step already."""
        return bool(self._under_way)

    def step(self, index: int, more: int = 0) -> Step | CommittedStep:
        """Makes a step.

        Args:
            index: one more than that of the step before.
            more: how many follow before the state is asked for, or the whole outcome of a step. The last of them is not
                replayed.

        Raises:
            ValueError: the state is invalid.
        """
        if not more and not self._under_way:
            made = self._make(index)
            if self._graph is not None:
                self._graph.load(made.after, index + 1)
            return made
        if self._graph is None or (self._has_idle_rounds and not self._under_way):
            return self._make_and_capture(index, more)
        if not self._under_way:
            self._under_way.append(self._graph.replay())
        if more > 1 and len(self._under_way) < 2 and not self._has_idle_rounds:
            self._under_way.append(self._graph.replay())
        committed = self._under_way.popleft().read(index)
        if committed is None:
            self._under_way.clear()  # they have changed nothing
            return self._make_and_capture(index, more)
        self._rounds.append(committed.rounds)
        return committed

    @property
    def _has_idle_rounds(self) -> bool:
        """Whether the graph makes rounds that no recent step needed."""
        return self._graph is not None and len(self._rounds) == _RECENT_STEPS and max(self._rounds) < self._graph.rounds

    def _make(self, index: int) -> Step:
        """Launch by launch, and what that needed is learnt."""
        state = self.state
        made = make_step(self._model, self._scene, state, index, self._broad_phase, self._plan)
        self._state = made.after
        self._rounds.append(made.resolution.rounds)
        return made

    def _make_and_capture(self, index: int, more: int) -> Step:
        """A step launch by launch, and then a graph of what that taught, if enough steps follow."""
        made = self._make(index)
        self._graph = None
        if self._wants_graph and more >= _FEWEST_REPLAYS:
            self._capture(index + 1)
        return made

    def _capture(self, index: int) -> None:
        torch.cuda.empty_cache()  # a graph has memory of its own
        given = self._model, self._state, index, self._broad_phase, self._plan
        try:
            self._graph = StepGraph(*given, max(self._rounds))
        except RuntimeError as error:
            why = "too little memory" if is_out_of_memory(error) else str(error)
            warnings.warn(f"steps are launched kernel by kernel: no CUDA graph of them: {why}", stacklevel=2)
            self._wants_graph = False
