"""One step of the world: plan, detect, settle, respond."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from pgccd import broad
from pgccd.bodies import MovingBodies
from pgccd.contacts import Contacts
from pgccd.detect import detect
from pgccd.scene import Scene
from pgccd.sim.hashing import contacts_hash, state_hash
from pgccd.sim.response import Settlement, respond, settle
from pgccd.sim.world import RobotState, World


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
    seconds: dict[str, float] = {}
    start = time.perf_counter()
    with _timed(seconds, "plan"):
        before = world.plan(state, index)
        motion = world.motion(before)
    with _timed(seconds, "broad"):
        pairs = broad.find_pairs(MovingBodies(scene, motion), broad_phase=broad_phase)
    # nonzero_toi: robots that part after a contact are free.
    contacts = detect(scene, motion, report="first", nonzero_toi=True, pairs=pairs)
    for stage, spent in contacts.stats.seconds.items():
        seconds[stage] = seconds.get(stage, 0.0) + spent
    toi = _column(contacts)

    def find_contacts(changed: Tensor, fraction: Tensor) -> tuple[Tensor, Tensor]:
        # A slowed robot stays within the volume it was to sweep: it meets nobody but its partners in the PCS.
        concerned = pairs[changed[pairs].any(dim=1)]
        found = detect(scene, world.motion(before, fraction), report="first", nonzero_toi=True, pairs=concerned)
        return found.pairs, _column(found)

    with _timed(seconds, "respond"):
        settlement = settle(contacts.pairs, toi, len(before), find_contacts)
        after = respond(before, settlement.fraction)
        stopped, touching = int(settlement.stopped.sum()), int((toi == 0.0).sum())
    with _timed(seconds, "hash"):
        hashes = contacts_hash(before.id[contacts.pairs], toi), state_hash(after)
    record = {
        "step": index,
        "robots": len(after),
        "pcs": contacts.stats.pcs,
        "contacts": len(contacts),
        "contacts_hash": f"{hashes[0]:016x}",
        "state_hash": f"{hashes[1]:016x}",
        "stopped": stopped,
        "secondary_contacts": settlement.secondary_contacts,
        "settle_rounds": settlement.rounds,
        "touching_at_t0": touching,
        "candidates": contacts.stats.candidates,
        "unresolved": contacts.stats.unresolved,
        "seconds": round(time.perf_counter() - start, 6),
        "stage_seconds": {stage: round(spent, 6) for stage, spent in seconds.items()},
    }
    return Step(index, before, contacts, toi, settlement, after, record)


def _column(contacts: Contacts) -> Tensor:
    if contacts.toi is None:
        raise AssertionError("detect(report='first') gives a toi")
    return contacts.toi


@contextmanager
def _timed(seconds: dict[str, float], stage: str) -> Iterator[None]:
    start = time.perf_counter()
    yield
    # Work still queued on a GPU belongs to the stage that queued it; all stages but the first wait for results anyway.
    if torch.cuda.is_initialized():
        torch.cuda.current_stream().synchronize()
    seconds[stage] = seconds.get(stage, 0.0) + time.perf_counter() - start
