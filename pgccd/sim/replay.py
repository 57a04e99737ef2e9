"""Steps of a simulation as replays of a graph."""

from collections import deque

from torch import Tensor

from pgccd.detection import broad
from pgccd.detection.bodies import MovingBodies
from pgccd.detection.passes import find_pass, pairs_of_rounds
from pgccd.resolution.rounds import OneRank
from pgccd.runtime.replayed_steps import GRAPH_SLACK, ReplayedSteps
from pgccd.sim.captured import CommittedStep, Searches, StepGraph
from pgccd.sim.model import Model, RobotState
from pgccd.sim.partners import FIRST_CONTACTS, Partners
from pgccd.sim.step import Step, StepPlan, make_step

# A graph has more rounds of collision resolution than any recent step took: the step that needs one more is repeated,
# and another graph captured, which takes as long as several hundred superfluous rounds.
_RECENT_STEPS, _SPARE_ROUNDS = 512, 1
# Steps from which the usual number of rounds is taken: fewer, since it grows in the first hundred steps.
_USUAL_STEPS = 16


class RecentRounds:
    """Numbers of rounds of collision resolution in recent steps: a graph has more than any of them took."""

    def __init__(self) -> None:
        self._rounds: deque[int] = deque(maxlen=_RECENT_STEPS)

    def note(self, rounds: int) -> None:
        """Records the rounds of a step."""
        self._rounds.append(rounds)

    @property
    def to_capture(self) -> int:
        """Rounds of a graph."""
        return max(self._rounds) + _SPARE_ROUNDS

    @property
    def usual(self) -> int:
        """Rounds that three of four recent steps needed. A conditional part of a graph costs a third as much as a
        superfluous round.
        """
        recent = sorted(list(self._rounds)[-_USUAL_STEPS:])
        return recent[len(recent) // 4]

    def need_fewer_than(self, rounds: int) -> bool:
        """Whether a graph with so many rounds has more than needed."""
        return len(self._rounds) == _RECENT_STEPS and self.to_capture < rounds


class StepMaker(ReplayedSteps[Step, CommittedStep, StepGraph]):
    """Runs the steps of a simulation in one process; on a GPU consecutive steps are replays of a graph.

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
        self._plan, self._recent = StepPlan(), RecentRounds()

    @property
    def state(self) -> RobotState:
        """A copy of the state after the last step. No step may be enqueued: see `is_ahead`."""
        if self._graph is not None:
            self._take(self._graph)
        return self._state

    def step(self, index: int, more: int = 0) -> Step | CommittedStep:
        """Runs a step.

        Args:
            index: one more than in the previous step.
            more: number of steps that follow before the state or the details of a step are read. The last of these is
                not replayed.

        Raises:
            ValueError: the state is invalid.
        """
        return self._advance(index, more)

    def _run_eagerly(self, index: int) -> Step:
        made = make_step(self._model, self._scene, self._state, index, self._broad_phase, self._plan)
        self._state = made.after
        return made

    def _make_graph(self, index: int) -> StepGraph:
        return make_step_graph(
            self._model,
            self._state,
            index,
            self._broad_phase,
            self._plan,
            self._recent.to_capture,
            self._recent.usual,
        )

    def _note(self, step: Step | CommittedStep) -> None:
        self._recent.note(step.rounds if isinstance(step, CommittedStep) else step.resolution.rounds)

    def _is_oversized(self, graph: StepGraph) -> bool:
        return self._recent.need_fewer_than(graph.rounds)

    @property
    def _columns(self) -> dict[str, Tensor]:
        return self._state.columns

    @_columns.setter
    def _columns(self, columns: dict[str, Tensor]) -> None:
        self._state = RobotState(**columns)


def make_step_graph(
    model: Model,
    state: RobotState,
    index: int,
    broad_phase: broad.BroadPhase,
    plan: StepPlan,
    rounds: int,
    usual_rounds: int = 0,
) -> StepGraph:
    """The graph of a step of all robots on one rank, to be captured; arguments as for `StepGraph`."""
    scene = model.scene(state.id)

    def search(planned: RobotState, discard: Tensor) -> Searches:
        bodies = MovingBodies.of(scene, model.motion(planned), wait=False)
        given = None, discard, None, plan.pairs, GRAPH_SLACK
        search_pass = find_pass(bodies, FIRST_CONTACTS, broad_phase, *given, at_any_times=True)
        partners = Partners(model, planned.moving_columns, None, pairs_of_rounds([search_pass]))
        return Searches([search_pass], partners, planned.id, OneRank(), [bodies._first_invalid_rows()[-1:]])

    return StepGraph(model, state, index, search, plan.rounds, rounds, usual_rounds)
