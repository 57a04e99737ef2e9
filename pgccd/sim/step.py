"""One step of the world: plan, detect, settle, respond."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import Any

import torch
from torch import Tensor

from pgccd import broad, ops
from pgccd.bodies import MovingBodies
from pgccd.capacity import Capacity
from pgccd.contacts import Contacts
from pgccd.detect import detect, find_contacts
from pgccd.memory import memory_limit
from pgccd.query import Query
from pgccd.scene import Scene
from pgccd.sim.hashing import contacts_hash_of, state_hash_of
from pgccd.sim.response import Exchange, OneRank, Settlement, respond, settle
from pgccd.sim.rounds import Pace, goes_ahead, settle_ahead
from pgccd.sim.world import RobotState, World
from pgccd.stages import StageClock
from pgccd.within import contacts_within

# What is asked of the whole step, and in every round of settling. nonzero_toi: robots that part after a contact are
# free.
_FIRST_CONTACTS = Query("first", 0.0, None, True)


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
    world: World,
    scene: Scene,
    state: RobotState,
    index: int,
    broad_phase: broad.BroadPhase = "auto",
    ahead: bool | None = None,
) -> Step:
    """Moves the robots by one step.

    Args:
        world: the rules.
        scene: `world.scene(state.id)`.
        state: of all robots, after step `index` - 1.
        index: number of the step, from 0.
        broad_phase: as for `detect`.
        ahead: whether the rounds of settling are made several at a time, without waiting for a GPU in each (default: if
            there is one). The result does not depend on it.

    Example:
        >>> step = pgccd.sim.make_step(world, scene, world.start(), 0)
        >>> step.after, step.record["contacts"]
    """
    clock = StageClock()
    with clock.stage("plan"):
        before = world.plan(state, index)
        motion = world.motion(before)
    with clock.stage("broad"):
        bodies = MovingBodies(scene, motion)
        pairs = broad.find_pairs(bodies, broad_phase=broad_phase)
    contacts = find_contacts(bodies, _FIRST_CONTACTS, pairs=pairs)
    clock.add(contacts.stats.seconds)
    toi = toi_of(contacts)
    with clock.stage("respond"):
        partners = Partners(world, before.moving_columns, None, pairs)
        pace = _pace_of(scene) if goes_ahead(ahead, scene.device) else None
        settlement = settle_step(contacts, len(before), partners, pace)
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


def settle_step(
    contacts: Contacts, body_count: int, partners: Partners, pace: Pace | None, exchange: Exchange | None = None
) -> Settlement:
    """Decides how much of a step each robot makes.

    Args:
        contacts: of the whole step.
        body_count: number of robots N.
        partners: who may meet whom.
        pace: of the last step; None: the host looks at the outcome of every round.
        exchange: how ranks agree; default: there is one.
    """
    pairs, toi = contacts.pairs, toi_of(contacts)
    exchange = exchange or OneRank(pairs.reshape(-1))
    # The first step waits for each round, and tells what room rounds need; so does one that did not find enough.
    if pace is not None and pace.rounds is not None:
        settled = settle_ahead(pairs, toi, body_count, partners.start_round, exchange, pace)
        if settled is not None:
            return settled
    settled = settle(pairs, toi, body_count, partners, exchange)
    if pace is not None:
        pace.learn(partners.needed)
    return settled


class Partners:
    """What settling asks, answered for potentially colliding pairs.

    Args:
        world: the rules.
        own, ghosts: `moving_columns` of planned states; rows of ghosts follow own ones.
        pairs: (P, 2) int64 rows, the robot of smaller id first.
    """

    def __init__(self, world: World, own: dict[str, Tensor], ghosts: dict[str, Tensor] | None, pairs: Tensor) -> None:
        self._world, self._pairs = world, pairs
        self._own = list(own.values())
        self._ghosts = [column[:0] if ghosts is None else ghosts[name] for name, column in own.items()]
        #: Room that each round needed, where rounds were waited for.
        self.needed: list[Capacity] = []
        self._copies = self._copies_of(0)
        self._no_faults = pairs.new_empty(0)

    def __call__(self, changed: Tensor, fraction: Tensor, anybody: Tensor) -> tuple[Tensor, Tensor] | None:
        """See `FindContacts`."""
        # A slowed robot stays within the volume it was to sweep: it meets nobody but its partners in the PCS.
        pairs, counts = ops.simulate_concerned_pairs(self._pairs, changed.view(torch.uint8), len(self._pairs))
        # Read together: on a GPU every look at a number waits for it.
        goes_on, count, *_ = torch.cat([anybody, counts]).tolist()
        if not goes_on:
            return None
        if not count:
            self.needed.append(Capacity(0, 0))
            return pairs[:0], fraction[:0]
        pairs = pairs[:count]
        scene, motion = self._world.pair_motion(self._own, self._ghosts, fraction, pairs)
        # nonzero_toi: as for the whole step.
        contacts = detect(scene, motion, report="first", nonzero_toi=True, pairs=self._copies_of(count))
        self.needed.append(contacts.stats.needed or Capacity.guess(2 * count, count))
        return pairs[contacts.pairs[:, 0] // 2], toi_of(contacts)

    def start_round(self, changed: Tensor, fraction: Tensor, room: Capacity, first: Tensor) -> Tensor:
        """See `StartRound`."""
        if room.bytes > memory_limit(None, room.bytes, fraction.device):
            room = Capacity(0, 0)  # which does not suffice: the rounds are waited for, then, and searched in pieces
        if room.pairs > len(self._copies):
            self._copies = self._copies_of(room.pairs)
        pairs, pair_counts = ops.simulate_concerned_pairs(self._pairs, changed, room.pairs)
        bodies = self._world.pair_bodies(self._own, self._ghosts, fraction, pairs)
        copies, meshes = self._copies[: room.pairs], self._world.meshes.tensors
        rows, counts = contacts_within(
            meshes, bodies, False, copies, pair_counts, self._no_faults, _FIRST_CONTACTS, room
        )
        ops.simulate_first_toi(first, pairs.view(-1), rows[0], rows[4])
        return counts

    def _copies_of(self, count: int) -> Tensor:
        """The two robots of each pair among their copies."""
        return torch.arange(2 * count, device=self._pairs.device).view(count, 2)


def _pace_of(scene: Scene) -> Pace:
    """The meshes remember it, as they do what room a step needs."""
    pace = scene.meshes.experience.setdefault("settling", Pace())
    assert isinstance(pace, Pace)
    return pace


def toi_of(contacts: Contacts) -> Tensor:
    """(K,) float64: the column, which `detect(report="first")` always gives."""
    if contacts.toi is None:
        raise AssertionError("detect(report='first') gives a toi")
    return contacts.toi
