"""One step of the model: plan, detect, resolve collisions, respond."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache, cached_property, partial
from typing import Any

import torch
from torch import Tensor

from pgccd.detection import broad
from pgccd.detection.bodies import MovingBodies
from pgccd.detection.capacity import Counts
from pgccd.detection.contacts import Contacts
from pgccd.detection.parts import Part, contacts_of_step, find_part, pairs_of_step, search_seconds
from pgccd.geometry.scene import Scene
from pgccd.runtime.host_copy import HostCopy
from pgccd.runtime.stages import StageClock
from pgccd.sim.model import Model, RobotState
from pgccd.sim.partners import FIRST_CONTACTS, Partners, toi_of
from pgccd.sim.response import Exchange, OneRank, Resolution, resolve_collisions, respond
from pgccd.sim.rounds import Meanwhile, Pace, goes_ahead, knows_rounds, resolve_ahead
from pgccd.sim.tally import WORK, Rows, Tally, count_step, work_of_counts, work_of_stats


@dataclass(frozen=True)
class Begun:
    """A step of which the first search goes on."""

    index: int
    state: RobotState  #: after the step before
    before: RobotState  #: as planned
    part: Part  #: the PCS
    faults: HostCopy  #: of the motion
    clock: StageClock


@dataclass
class Step:
    """A step that was made. What takes time to find out is found out when it is asked for: a GPU can have the next step
    before."""

    index: int  #: from 0
    before: RobotState  #: as planned: poses at t0, velocities of the step
    resolution: Resolution
    after: RobotState
    find: Callable[[], Contacts]  #: gives `contacts`
    make_record: Callable[[], dict[str, Any]]  #: returns `record`
    next: Begun | None = None  #: the next step, if it was begun early

    @cached_property
    def contacts(self) -> Contacts:
        """Of the whole step, as if no robot had stopped."""
        return self.find()

    @property
    def toi(self) -> Tensor:
        """(K,) float64, of these."""
        return toi_of(self.contacts)

    @cached_property
    def record(self) -> dict[str, Any]:
        """Its line in steps.jsonl."""
        return self.make_record()


def begin_step(
    model: Model,
    scene: Scene,
    state: RobotState,
    index: int,
    broad_phase: broad.BroadPhase = "auto",
    discard: Tensor | None = None,
) -> Begun:
    """Gives a GPU the first work of a step, mostly without waiting; elsewhere finds the PCS.

    Args:
        model, scene, state, index, broad_phase: as for `make_step`.
        discard: see `find_part`.
    """
    clock = StageClock()
    with clock.stage("plan"):
        before = model.plan(state, index)
        motion = model.motion(before)
    with clock.stage("broad"):
        bodies = MovingBodies(scene, motion, wait=scene.device.type == "cpu")
        faults = HostCopy(bodies.first_faults())
        part = find_part(bodies, FIRST_CONTACTS, broad_phase, discard=discard)
    if scene.device.type != "cpu":
        part.start()
    return Begun(index, state, before, part, faults, clock)


def make_step(
    model: Model,
    scene: Scene,
    state: RobotState,
    index: int,
    broad_phase: broad.BroadPhase = "auto",
    ahead: bool | None = None,
    begun: Begun | None = None,
    more: bool = False,
) -> Step:
    """Moves the robots by one step.

    Args:
        model: the rules.
        scene: `model.scene(state.id)`.
        state: of all robots, after step `index` - 1.
        index: number of the step, from 0.
        broad_phase: as for `detect`.
        ahead: whether the rounds of resolution are enqueued several at a time, without waiting for a GPU in each
            (default: if there is one). The result does not depend on it.
        begun: `next` of the step before, of which `state` came.
        more: whether the next step follows at once: then a GPU is given its first work before the host knows how this
            one ends.

    Raises:
        ValueError: the state is invalid.

    Example:
        >>> step = pgccd.sim.make_step(model, scene, model.start(), 0)
        >>> step.after, step.record["contacts"]
    """
    if begun is not None and begun.index == index and _follows(begun, state):
        begun.clock.restart()
    else:
        begun = begin_step(model, scene, state, index, broad_phase)
    before, clock = begun.before, begun.clock
    partners = Partners(model, before.moving_columns, None, begun.part.pairs)
    after, begun_next = before, None

    def conclude(pairs: Tensor, toi: Tensor, fraction: Tensor) -> Tensor:
        nonlocal after
        with clock.stage("respond"):
            after = respond(before, fraction)
        with clock.stage("hash"):
            return count_step(after, fraction, before.id, pairs, toi)

    def begin_next(discard: Tensor) -> None:
        nonlocal begun_next
        begun_next = begin_step(model, scene, after, index + 1, broad_phase, discard)

    pace = _pace_of(scene) if goes_ahead(ahead, scene.device) else None
    meanwhile = begin_next if more and _begins_early(scene) else None
    resolved = resolve_step([begun.part], scene.body_count, partners, pace, conclude, clock, meanwhile=meanwhile)
    begun.part.bodies.raise_faults(begun.faults.numpy().tolist())
    resolved.learn()
    clock.stop()

    def make_record() -> dict[str, Any]:
        return Tally.of(resolved.work, resolved.conclusions).record(index, resolved.resolution.rounds, clock)

    find = partial(contacts_of_step, [begun.part])
    following = begun_next if _follows(begun_next, after) else None
    return Step(index, before, resolved.resolution, after, find, make_record, following)


def _begins_early(scene: Scene) -> bool:
    """Whether a step is begun before the outcome of the one before is known."""
    return scene.device.type != "cpu"


def _follows(begun: Begun | None, state: RobotState) -> bool:
    """Whether a step was begun from that state, not from one that was put right later."""
    return begun is not None and begun.state is state


@dataclass
class ResolvedStep:
    """How a step ended."""

    resolution: Resolution  #: what robots make of the step
    work: Rows  #: (ranks, 6), see `WORK`
    conclusions: Rows  #: (ranks, k): the numbers that each rank concluded
    #: Takes note of what the step needed, the first time it is called; a GPU may be given more urgent work before.
    learn: Callable[[], None]


def resolve_step(
    parts: Sequence[Part],
    body_count: int,
    partners: Partners,
    pace: Pace | None,
    conclude: Callable[[Tensor, Tensor, Tensor], Tensor],
    clock: StageClock,
    exchange: Exchange | None = None,
    meanwhile: Meanwhile | None = None,
) -> ResolvedStep:
    """Finds the contacts of a step, and decides how much of it each robot makes.

    Args:
        parts: of the PCS, `FIRST_CONTACTS` being what is asked; as many on all ranks.
        body_count: number of robots held N.
        partners: pairs of robots that may meet.
        pace: of the last steps; None: the host reads the outcome of every round.
        conclude: what follows, given the pairs (K, 2) and toi (K,) of contacts, perhaps padded with pairs of -1 and toi
            inf, and fraction (N,): (k,) int64 numbers for all ranks. Perhaps called again with others.
        clock: stages are timed here.
        exchange: how ranks agree; default: there is one.
        meanwhile: what else can be begun while the host waits for the outcome, perhaps several times.
    """
    device = parts[0].bodies.device
    exchange = exchange or OneRank(parts[0].pairs.reshape(-1))
    # The first step waits for each round, and records the capacity that rounds need; so does one that exceeded it.
    if knows_rounds(pace):
        clock.add({"traverse": 0.0, "narrow": 0.0})  # stages are listed in the order of work
        rows = [part.start().rows for part in parts]
        given = _joined([part.in_step(pairs) for part, (pairs, *_) in zip(parts, rows, strict=True)])
        given_fraction = partial(conclude, given, _joined([columns[4] for columns in rows]))
        ahead = resolve_ahead(parts, body_count, partners.start_round, exchange, pace, given_fraction, clock, meanwhile)
        if ahead is not None:
            work = work_of_counts(ahead.counts, ahead.secondary_contacts)

            def learn() -> None:
                for part, numbers in zip(parts, ahead.counts[exchange.rank].tolist(), strict=True):
                    counts = Counts.of(numbers)
                    part.learn(counts)
                    clock.add(search_seconds(counts))

            return ResolvedStep(ahead.resolution, work, ahead.conclusions, cache(learn))
    contacts = contacts_of_step(parts)
    # The capacity for pairs may have been exceeded.
    partners.look_among(pairs_of_step(parts))
    clock.add(search_seconds(contacts.stats))
    with clock.stage("respond"):
        resolution = resolve_collisions(contacts.pairs, toi_of(contacts), body_count, partners, exchange)
    if pace is not None:
        pace.learn(len(partners.needed), lambda: partners.needed)
    counts = torch.tensor(work_of_stats(contacts.stats, resolution.secondary_contacts))
    counts = counts.to(device, non_blocking=True)
    concluded = conclude(contacts.pairs, toi_of(contacts), resolution.fraction)
    with clock.stage("gather"):
        numbers = exchange.gather(torch.cat([counts, concluded])).cpu().numpy()
    return ResolvedStep(resolution, numbers[:, : len(WORK)], numbers[:, len(WORK) :], lambda: None)


def _joined(columns: list[Tensor]) -> Tensor:
    return columns[0] if len(columns) == 1 else torch.cat(columns)


def _pace_of(scene: Scene) -> Pace:
    """The meshes remember it, as they do the capacity of a step."""
    pace = scene.meshes.experience.setdefault("settling", Pace())
    assert isinstance(pace, Pace)
    return pace
