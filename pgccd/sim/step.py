"""One step of the world: plan, detect, settle, respond."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import Any

import torch
from torch import Tensor

from pgccd import broad, ops
from pgccd.bodies import MovingBodies
from pgccd.contacts import Contacts
from pgccd.detect import detect
from pgccd.scene import Scene
from pgccd.sim.hashing import contacts_hash_of, state_hash_of
from pgccd.sim.response import Settlement, respond, settle
from pgccd.sim.world import RobotState, World
from pgccd.stages import StageClock


@dataclass
class Step:
    """A step that was made."""

    index: int  #: from 0
    before: RobotState  #: as planned: poses at t0, velocities of the step
    contacts: Contacts  #: of the whole step, had nobody stopped
    toi: Tensor  #: (K,) float64, its column
    settlement: Settlement
    after: RobotState
    record: dict[str, Any]  #: its line in steps.jsonl


def make_step(
    world: World, scene: Scene, state: RobotState, index: int, broad_phase: broad.BroadPhase = "auto"
) -> Step:
    """Moves the robots by one step.

    Args:
        world: the rules.
        scene: `world.scene(state.id)`.
        state: of all robots, after step `index` - 1.
        index: number of the step, from 0.
        broad_phase: as for `detect`.

    Example:
        >>> step = pgccd.sim.make_step(world, scene, world.start(), 0)
        >>> step.after, step.record["contacts"]
    """
    clock = StageClock()
    with clock.stage("plan"):
        before = world.plan(state, index)
        motion = world.motion(before)
    with clock.stage("broad"):
        pairs = broad.find_pairs(MovingBodies(scene, motion), broad_phase=broad_phase)
    # nonzero_toi: robots that part after a contact are free.
    contacts = detect(scene, motion, report="first", nonzero_toi=True, pairs=pairs)
    clock.add(contacts.stats.seconds)
    toi = toi_of(contacts)
    with clock.stage("respond"):
        settlement = settle(contacts.pairs, toi, len(before), Partners(world, before.moving_columns, None, pairs))
        after = respond(before, settlement.fraction)
    with clock.stage("hash"):
        counted = count_step(after, settlement.fraction, before.id[contacts.pairs], toi).tolist()
        host = len(pairs), len(contacts), settlement.secondary_contacts
        tally = Tally.of([*host, contacts.stats.candidates, contacts.stats.unresolved, *counted])
    return Step(index, before, contacts, toi, settlement, after, tally.record(index, settlement.rounds, clock))


@dataclass
class Tally:
    """What is counted in a step. The tallies of parts of a world add up to that of the whole."""

    # What the host knows first, then what `count_step` counts.
    pcs: int
    contacts: int
    secondary_contacts: int
    candidates: int
    unresolved: int
    robots: int
    contacts_hash: int  #: modulo 2^64, as the next
    state_hash: int
    stopped: int
    touching_at_t0: int

    @classmethod
    def of(cls, numbers: Sequence[int]) -> Tally:
        """Of its fields in their order; hashes may be signed."""
        return cls.total([cls(*numbers)])

    @classmethod
    def total(cls, parts: Sequence[Tally]) -> Tally:
        """Of the whole."""
        sums = {field.name: sum(getattr(part, field.name) for part in parts) for field in fields(cls)}
        for name in ("contacts_hash", "state_hash"):
            sums[name] %= 2**64
        return cls(**sums)

    def record(self, index: int, rounds: int, clock: StageClock) -> dict[str, Any]:
        """The line of steps.jsonl."""
        stage_seconds = {stage: round(spent, 6) for stage, spent in clock.seconds.items()}  # first: it may have to wait
        return {
            "step": index,
            "robots": self.robots,
            "pcs": self.pcs,
            "contacts": self.contacts,
            "contacts_hash": f"{self.contacts_hash:016x}",
            "state_hash": f"{self.state_hash:016x}",
            "stopped": self.stopped,
            "secondary_contacts": self.secondary_contacts,
            "settle_rounds": rounds,
            "touching_at_t0": self.touching_at_t0,
            "candidates": self.candidates,
            "unresolved": self.unresolved,
            "seconds": round(clock.total, 6),
            "stage_seconds": stage_seconds,
        }


def count_step(after: RobotState, fraction: Tensor, id_pairs: Tensor, toi: Tensor) -> Tensor:
    """(5,) int64, left on the device: robots, hash of the contacts, hash of the state, robots that stopped, contacts at
    t0.

    Args:
        after: the state after the step.
        fraction: (N,) of it that each of these robots made.
        id_pairs, toi: (K, 2) global ids and (K,) of the contacts of the whole step.
    """
    robots = torch.full((1,), len(after), dtype=torch.int64, device=toi.device)
    stopped, touching = (fraction < 1.0).sum().reshape(1), (toi == 0.0).sum().reshape(1)
    return torch.cat([robots, contacts_hash_of(id_pairs, toi), state_hash_of(after), stopped, touching])


class Partners:
    """What `settle` asks, answered for potentially colliding pairs.

    Args:
        world: the rules.
        own, ghosts: `moving_columns` of planned states; rows of ghosts follow own ones.
        pairs: (P, 2) int64 rows, the robot of smaller id first.
    """

    def __init__(self, world: World, own: dict[str, Tensor], ghosts: dict[str, Tensor] | None, pairs: Tensor) -> None:
        self._world, self._own, self._ghosts, self._pairs = world, own, ghosts, pairs

    def __call__(self, changed: Tensor, fraction: Tensor, anybody: Tensor) -> tuple[Tensor, Tensor] | None:
        # A slowed robot stays within the volume it was to sweep: it meets nobody but its partners in the PCS.
        concerned, found = ops.simulate_concerned_pairs(self._pairs, changed.view(torch.uint8))
        # Read together: on a GPU every look at a number waits for it.
        goes_on, count = torch.cat([anybody, found]).tolist()
        if not goes_on:
            return None
        if not count:
            return self._pairs[:0], fraction[:0]
        pairs = self._pairs[concerned[:count]]
        scene, motion = self._world.pair_motion(self._own, self._ghosts, fraction, pairs)
        copies = torch.arange(2 * count, device=pairs.device).view(count, 2)
        contacts = detect(scene, motion, report="first", nonzero_toi=True, pairs=copies)
        return pairs[contacts.pairs[:, 0] // 2], toi_of(contacts)


def toi_of(contacts: Contacts) -> Tensor:
    """(K,) float64: the column, which `detect(report="first")` always gives."""
    if contacts.toi is None:
        raise AssertionError("detect(report='first') gives a toi")
    return contacts.toi
