"""Reference collision resolution: every round detects among all robots, and rows are processed one by one."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from types import SimpleNamespace
from typing import Any, cast

import torch
from torch import Tensor

import pgccd
from pgccd.resolution.listed import ListedSearch
from pgccd.resolution.round_plan import RoundPlan
from pgccd.resolution.rounds import Found, Fractions, found_by, resolve_collisions
from pgccd.runtime.sizes import COUNT_ROWS, BufferSizes
from pgccd.runtime.stages import StageClock
from pgccd.search.passes import SearchPass
from pgccd.sim import Model, RobotState, contacts_hash, respond, state_hash
from pgccd.sim.simulation import FIRST_CONTACTS

#: Contacts of the robots that changed (N,) bool, each moving by its fraction (N,) of the step.
Find = Callable[[Tensor, Tensor], tuple[Tensor, Tensor]]


@dataclass
class PlainStep:
    """A step resolved by the reference."""

    resolution: Fractions
    contacts: pgccd.Contacts


def plain_step(model: Model, planned: RobotState) -> PlainStep:
    """Every round detects among all robots, and drops the pairs in which neither robot changed."""
    scene = model.scene(planned.id)
    contacts = pgccd.detect(scene, model.motion(planned), nonzero_toi=True)

    def find(changed: Tensor, fraction: Tensor) -> tuple[Tensor, Tensor]:
        found = pgccd.detect(scene, model.motion(planned, fraction), nonzero_toi=True)
        affected = changed[found.pairs].any(dim=1)
        return found.pairs[affected], found.toi[affected]

    assert contacts.toi is not None
    stopping_round = model.config.stopping_round
    return PlainStep(plain_resolution(contacts.pairs, contacts.toi, len(planned), find, stopping_round), contacts)


def plain_resolution(pairs: Tensor, toi: Tensor, count: int, find: Find, stopping_round: int = 4) -> Fractions:
    """The rule of `pgccd.resolution.rounds`, robot by robot."""
    fraction, rounds, secondary = [1.0] * count, 0, 0
    while True:
        changed = set()
        first: dict[int, float] = {}
        for pair, time in zip(pairs.tolist(), toi.tolist(), strict=True):
            for robot in pair:
                first[robot] = min(first.get(robot, torch.inf), time)
        for robot, time in first.items():
            if time <= 1.0 and fraction[robot] > 0.0:
                allowed = fraction[robot] * time * 0.99
                fraction[robot] = 0.0 if allowed < (0.01 if rounds < stopping_round else torch.inf) else allowed
                changed.add(robot)
        made = torch.tensor(fraction, dtype=torch.float64)
        if not changed:
            return Fractions(made, rounds, secondary)
        pairs, toi = find(torch.tensor([robot in changed for robot in range(count)]), made)
        rounds, secondary = rounds + 1, secondary + len(toi)


def resolve_given(pairs: Tensor, toi: Tensor, count: int, find: Find) -> Fractions:
    """Result of `resolve_collisions` for these contacts, and for those that `find` returns for later rounds."""

    class GivenPass:
        """Pairs with given contacts."""

        bodies = SimpleNamespace(device=pairs.device)

        def __init__(self) -> None:
            self.pairs = pairs

        def begin(self) -> None:
            pass

        def first_contacts(self) -> tuple[Tensor, Tensor]:
            return pairs, toi

        def counts(self) -> Tensor:
            return torch.zeros(len(COUNT_ROWS), dtype=torch.int64)

    class GivenRounds:
        """Rounds with given contacts."""

        waits = False

        def __init__(self, passes: list[SearchPass]) -> None:
            self.passes = passes

        def find_whole(self) -> list[Found]:
            return found_by(self.passes)

        def look_again(self) -> None:
            pass

        def find_round(
            self, changed: Tensor, fraction: Tensor, capacity: BufferSizes, first: Tensor
        ) -> tuple[list[Found], Tensor]:
            counts = torch.zeros(len(COUNT_ROWS), dtype=torch.int64)
            if not bool(changed.any()):
                return [], counts
            found, times = find(changed.bool(), fraction)
            counts[COUNT_ROWS["contacts"]] = len(times)
            return [Found(found, found, times)], counts

    rounds, nothing = GivenRounds(cast(list[SearchPass], [GivenPass()])), torch.zeros(1, dtype=torch.int64)
    return resolve_collisions(rounds, count, RoundPlan(), lambda _: nothing, StageClock()).resolution


def robot_rounds(
    model: Model, state: RobotState, search_pass: SearchPass, pairs: Tensor, kind: type[ListedSearch] = ListedSearch
) -> ListedSearch:
    """The rounds of a planned step of robots, searched among these pairs."""
    mesh_index, position, _, *more = search_pass.bodies.tensors
    own = [mesh_index, position, state.velocity, *more]
    options: dict[str, Any] = {"lists_contacts": False, "skips_equal": True, "by_velocity": True}
    return kind([search_pass], model.meshes, own, None, lambda: pairs, FIRST_CONTACTS, **options)


def plain_run(model: Model, steps: int) -> list[dict[str, Any]]:
    """Steps from the start: their log lines, without fields that depend on the number of ranks."""
    state, lines = model.start(), []
    for index in range(steps):
        planned = model.plan(state, index)
        made = plain_step(model, planned)
        state = respond(planned, made.resolution.fraction)
        lines.append(
            {
                "contacts": len(made.contacts),
                "contacts_hash": f"{contacts_hash(state.id[made.contacts.pairs], made.contacts.toi):016x}",
                "state_hash": f"{state_hash(state):016x}",
                "stopped": int(made.resolution.stopped.sum()),
                "resolution_rounds": made.resolution.rounds,
                "secondary_contacts": made.resolution.secondary_contacts,
            }
        )
    return lines
