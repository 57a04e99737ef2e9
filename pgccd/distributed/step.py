"""One step of the nanorobot world on many ranks: plan, halo, detect, settle, respond, balance, migrate."""

from __future__ import annotations

from dataclasses import astuple, dataclass, fields
from typing import Any

import torch
from torch import Tensor

from pgccd.broad import BroadPhase
from pgccd.distributed.balance import BalanceOptions, CellLoads, imbalance, rebalance
from pgccd.distributed.comm import Comm
from pgccd.distributed.detection import Detection, Options, detect_distributed
from pgccd.distributed.exchange import Columns, take_rows
from pgccd.distributed.migrate import Census, migrate
from pgccd.distributed.partition import Partition
from pgccd.motion import RigidMotion
from pgccd.scene import Scene
from pgccd.sim.hashing import contacts_hash, state_hash
from pgccd.sim.response import Settlement, respond, settle
from pgccd.sim.step import Tally, partners, toi_of
from pgccd.sim.world import RobotState, World
from pgccd.stages import StageClock

# Robots made at a time at the start of a world.
_BLOCK_ROBOTS = 1 << 20


@dataclass
class RankStep:
    """What one rank knows of a step that was made."""

    index: int  #: from 0
    detection: Detection
    before: RobotState  #: of the robots held, as planned
    settlement: Settlement  #: of the robots held
    record: dict[str, Any]  #: of the whole world: the line in steps.jsonl, the same on all ranks but for the times


@dataclass
class _Report:
    """What a rank tells all others after a step, beside its tally."""

    held: int
    arrived: int
    busy: int  #: nanoseconds at work, not waiting for others


class Fleet:
    """A world's robots, spread over ranks.

    Args:
        comm: between the ranks.
        world: the rules, the same on all ranks, on this rank's device.
        partition: the same on all ranks.
        state: of any share of the robots; all ranks together have each robot once.
        balance: how cells change hands.
        broad_phase, overlap: see `Options`.

    Example:
        >>> fleet = Fleet(comm, world, partition, starting_share(comm, world, partition))
        >>> fleet.step(0).record["contacts"]
    """

    def __init__(
        self,
        comm: Comm,
        world: World,
        partition: Partition,
        state: RobotState,
        balance: BalanceOptions | None = None,
        overlap: bool = True,
        broad_phase: BroadPhase = "auto",
    ) -> None:
        self.comm, self.world, self.partition = comm, world, partition
        self.balance = balance or BalanceOptions()
        # nonzero_toi: robots that part after a contact are free.
        self.options = Options("first", nonzero_toi=True, broad_phase=broad_phase, overlap=overlap)
        self._expected = Census.of_range(world.config.robots)
        self._migrate(RobotState(**take_rows(state.columns, torch.argsort(state.id))))
        self.verify()

    def verify(self) -> None:
        """Checks that every robot is on exactly one rank.

        Raises:
            RuntimeError: some are lost or doubled.
        """
        parts = self.comm.gather_objects(astuple(Census.of(self.state.id)))
        Census.total([Census(*part) for part in parts]).require(self._expected)

    def step(self, index: int) -> RankStep:
        """Moves the robots by one step, the `index`-th from 0."""
        guard, clock = self.comm.guard, StageClock()
        guard.activity = f"step {index}"
        world = self.world
        census = Census.of(self.state.id)
        with clock.stage("plan"):
            planned = world.plan(self.state, index)
        found = detect_distributed(self.comm, self.partition, planned.columns, self._build, self.options, clock)
        held, before, toi = found.held, RobotState(**found.held.columns), toi_of(found.contacts)
        with clock.stage("respond"):
            find_contacts = partners(world, found.scene, before, found.pairs)
            settlement = settle(found.contacts.pairs, toi, len(before), find_contacts, held)
            after = respond(planned, settlement.fraction[held.own].contiguous())
        with clock.stage("hash"):
            tally = Tally(
                robots=len(after),
                pcs=len(found.pairs),
                contacts=len(found.contacts),
                contacts_hash=contacts_hash(before.id[found.contacts.pairs], toi),
                state_hash=state_hash(after),
                stopped=int(settlement.stopped[held.own].sum()),
                secondary_contacts=settlement.secondary_contacts,
                touching_at_t0=int((toi == 0.0).sum()),
                candidates=found.contacts.stats.candidates,
                unresolved=found.contacts.stats.unresolved,
            )
        report = _Report(len(held), self._arrived, int(1e9 * clock.work))
        with clock.stage("gather"):
            tallies, reports, censuses = self._tell(tally, report, census)
        Census.total(censuses).require(self._expected)
        moved_cells = self._balance(index, found, planned, reports, clock)
        with clock.stage("migrate"):
            self._migrate(after)
        record = Tally.total(tallies).record(index, settlement.rounds, clock)
        record["ranks"] = {
            "bodies": [part.robots for part in tallies],
            "ghosts": [report.held - part.robots for part, report in zip(tallies, reports, strict=True)],
            "pcs": [part.pcs for part in tallies],
            "contacts": [part.contacts for part in tallies],
            "arrived": [report.arrived for report in reports],
            "busy_seconds": [round(1e-9 * report.busy, 6) for report in reports],
            "moved_cells": moved_cells,
            "imbalance": round(imbalance(torch.tensor([float(part.pcs) for part in tallies])), 4),
        }
        return RankStep(index, found, before, settlement, record)

    def _build(self, columns: Columns) -> tuple[Scene, RigidMotion]:
        state = RobotState(**columns)
        return self.world.scene(state.id), self.world.motion(state)

    def _tell(self, tally: Tally, report: _Report, census: Census) -> tuple[list[Tally], list[_Report], list[Census]]:
        """Those of all ranks, in one all-gather."""
        own = [*astuple(tally), *astuple(report), *astuple(census)]
        signed = [value - 2**64 if value >= 2**63 else value for value in own]
        rows = self.comm.all_gather(torch.tensor(signed)).tolist()
        tallies, reports, censuses = [], [], []
        first, second = len(fields(Tally)), len(fields(Tally)) + len(fields(_Report))
        for row in rows:
            tallies.append(Tally(*row[:first]))
            tallies[-1].contacts_hash %= 2**64
            tallies[-1].state_hash %= 2**64
            reports.append(_Report(*row[first:second]))
            censuses.append(Census(row[second], row[second + 1] % 2**64))
        return tallies, reports, censuses

    def _balance(
        self, index: int, found: Detection, planned: RobotState, reports: list[_Report], clock: StageClock
    ) -> int:
        """Shares the cells out anew; returns how many moved."""
        if not self.balance.applies(index + 1, self.comm.size):
            return 0
        with clock.stage("balance"):
            loads = cell_loads(self.partition, planned.position, found)
            total = CellLoads.unstacked(self.comm.sum(loads.stacked()))
            seconds = torch.tensor([1e-9 * report.busy for report in reports], dtype=torch.float64)
            former = self.partition
            self.partition = rebalance(former, total, self.balance, seconds)
            return int((self.partition.owner != former.owner).sum())

    def _migrate(self, state: RobotState) -> None:
        """Hands robots over; the state's ids ascend."""
        columns, self._arrived = migrate(self.comm, self.partition, state.columns, state.position)
        self.state = RobotState(**columns)


def cell_loads(partition: Partition, position: Tensor, found: Detection) -> CellLoads:
    """What one rank saw in each cell."""
    pair_key = found.pairs[:, 0] * len(found.held) + found.pairs[:, 1]
    contact_key = found.contacts.pairs[:, 0] * len(found.held) + found.contacts.pairs[:, 1]
    contact_cell = found.cell[torch.searchsorted(pair_key, contact_key)] if len(pair_key) else found.cell
    cells = (partition.cell_of(position), found.cell, contact_cell)
    return CellLoads(*(torch.bincount(cell, minlength=partition.cell_count) for cell in cells))


def starting_share(comm: Comm, world: World, partition: Partition) -> RobotState:
    """The robots that start in this rank's cells."""
    parts = []
    for begin in range(0, world.config.robots, _BLOCK_ROBOTS):
        end = min(world.config.robots, begin + _BLOCK_ROBOTS)
        block = world.start(torch.arange(begin, end, device=world.device))
        here = torch.nonzero(partition.owner_of(block.position) == comm.rank)[:, 0]
        parts.append(take_rows(block.columns, here))
    return RobotState(**{name: torch.cat([part[name] for part in parts]) for name in parts[0]})
