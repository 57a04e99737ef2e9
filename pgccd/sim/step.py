"""One step of the world: plan, detect, settle, respond."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import Any

from torch import Tensor

from pgccd import broad
from pgccd.bodies import MovingBodies
from pgccd.contacts import Contacts
from pgccd.detect import detect
from pgccd.scene import Scene
from pgccd.sim.hashing import contacts_hash, state_hash
from pgccd.sim.response import FindContacts, Settlement, respond, settle
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
        settlement = settle(contacts.pairs, toi, len(before), partners(world, scene, before, pairs))
        after = respond(before, settlement.fraction)
    with clock.stage("hash"):
        tally = Tally(
            robots=len(after),
            pcs=contacts.stats.pcs,
            contacts=len(contacts),
            contacts_hash=contacts_hash(before.id[contacts.pairs], toi),
            state_hash=state_hash(after),
            stopped=int(settlement.stopped.sum()),
            secondary_contacts=settlement.secondary_contacts,
            touching_at_t0=int((toi == 0.0).sum()),
            candidates=contacts.stats.candidates,
            unresolved=contacts.stats.unresolved,
        )
    return Step(index, before, contacts, toi, settlement, after, tally.record(index, settlement.rounds, clock))


@dataclass
class Tally:
    """What is counted in a step. The tallies of parts of a world add up to that of the whole."""

    robots: int
    pcs: int
    contacts: int
    contacts_hash: int  #: modulo 2^64, as the next
    state_hash: int
    stopped: int
    secondary_contacts: int
    touching_at_t0: int
    candidates: int
    unresolved: int

    @classmethod
    def total(cls, parts: Sequence[Tally]) -> Tally:
        """Of the whole."""
        sums = {field.name: sum(getattr(part, field.name) for part in parts) for field in fields(cls)}
        for name in ("contacts_hash", "state_hash"):
            sums[name] %= 2**64
        return cls(**sums)

    def record(self, index: int, rounds: int, clock: StageClock) -> dict[str, Any]:
        """The line of steps.jsonl."""
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
            "stage_seconds": {stage: round(spent, 6) for stage, spent in clock.seconds.items()},
        }


def partners(world: World, scene: Scene, before: RobotState, pairs: Tensor) -> FindContacts:
    """What `settle` asks, answered for the potentially colliding pairs (P, 2) of a planned state's rows."""

    def find_contacts(changed: Tensor, fraction: Tensor) -> tuple[Tensor, Tensor]:
        # A slowed robot stays within the volume it was to sweep: it meets nobody but its partners in the PCS.
        concerned = pairs[changed[pairs].any(dim=1)]
        found = detect(scene, world.motion(before, fraction), report="first", nonzero_toi=True, pairs=concerned)
        return found.pairs, toi_of(found)

    return find_contacts


def toi_of(contacts: Contacts) -> Tensor:
    """(K,) float64: the column, which `detect(report="first")` always gives."""
    if contacts.toi is None:
        raise AssertionError("detect(report='first') gives a toi")
    return contacts.toi
