"""One step of the model: plan, detect, resolve collisions, respond, count."""

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

from torch import Tensor

from pgccd.detection import broad
from pgccd.detection.bodies import MovingBodies
from pgccd.detection.contacts import Contacts
from pgccd.detection.memory import CapacityEstimate
from pgccd.detection.passes import contacts_of_step, find_pass, pairs_of_rounds
from pgccd.geometry.scene import Scene
from pgccd.resolution.round_plan import RoundPlan
from pgccd.resolution.rounds import Fractions, resolve_collisions
from pgccd.runtime.host_copy import HostCopy
from pgccd.runtime.stages import StageClock
from pgccd.sim.model import Model, RobotState
from pgccd.sim.partners import FIRST_CONTACTS, Partners
from pgccd.sim.response import respond
from pgccd.sim.tally import Tally, count_step


@dataclass
class StepPlan:
    """Capacity estimates of a simulation's steps. They change how often the work of a step is repeated on a GPU, never
    its result.

    Attributes:
        pairs: of the PCS and its contacts.
        rounds: of the rounds of resolution.
    """

    pairs: CapacityEstimate = field(default_factory=CapacityEstimate)
    rounds: RoundPlan = field(default_factory=RoundPlan)


@dataclass
class Step:
    """A step run eagerly. Expensive results are computed on access.

    Attributes:
        index: of the step, from 0.
        before: the robots as planned: poses at t0, velocities of the step.
        resolution: the part of the step that each robot moves.
        after: the robots after the step.
        find: computes `contacts`.
        make_record: computes `record`.
    """

    index: int
    before: RobotState
    resolution: Fractions
    after: RobotState
    find: Callable[[], Contacts]
    make_record: Callable[[], dict[str, Any]]

    @cached_property
    def contacts(self) -> Contacts:
        """Contacts of the whole step, as if no robot had stopped."""
        return self.find()

    @property
    def toi(self) -> Tensor:
        """(K,) float64 toi of `contacts`."""
        return self.contacts.toi

    @cached_property
    def record(self) -> dict[str, Any]:
        """Its line in steps.jsonl."""
        return self.make_record()


def make_step(
    model: Model,
    scene: Scene,
    state: RobotState,
    index: int,
    broad_phase: broad.BroadPhase = "auto",
    plan: StepPlan | None = None,
) -> Step:
    """Moves the robots by one step.

    Args:
        model: the rules.
        scene: `model.scene(state.id)`.
        state: of all robots, after step `index` - 1.
        index: number of the step, from 0.
        broad_phase: as for `detect`.
        plan: capacity estimates of this simulation; default: none.

    Raises:
        ValueError: the state is invalid.

    Example:
        >>> step = pgccd.sim.make_step(model, scene, model.start(), 0)
        >>> step.after, step.record["contacts"]
    """
    plan, clock = plan or StepPlan(), StageClock()
    with clock.stage("plan"):
        before = model.plan(state, index)
        motion = model.motion(before)
    with clock.stage("broad"):
        bodies = MovingBodies.of(scene, motion, wait=scene.device.type == "cpu")
        invalid_rows = HostCopy.start(bodies._first_invalid_rows())
        search_pass = find_pass(bodies, FIRST_CONTACTS, broad_phase, estimate=plan.pairs, at_any_times=True)
    after = before

    def summarise(fraction: Tensor) -> Tensor:
        nonlocal after
        with clock.stage("respond"):
            after = respond(before, fraction)
        with clock.stage("hash"):
            return count_step(after, fraction, before.id, *search_pass.first_contacts())

    partners = Partners(model, before.moving_columns, None, pairs_of_rounds([search_pass]))
    given = [search_pass], scene.body_count, partners, plan.rounds, summarise, clock
    resolved = resolve_collisions(*given, stopping_round=model.config.stopping_round)
    bodies._raise_invalid(invalid_rows.numpy().tolist())
    resolved.learn()
    clock.stop()

    def make_record() -> dict[str, Any]:
        return Tally.of(resolved.work, resolved.summaries).record(index, resolved.resolution.rounds, clock)

    def find() -> Contacts:
        found = contacts_of_step([search_pass])
        assert isinstance(found, Contacts)  # of report="first"
        return found

    return Step(index, before, resolved.resolution, after, find, make_record)
