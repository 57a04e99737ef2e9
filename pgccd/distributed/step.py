"""One step of the nanorobot world on many ranks: plan, halo, detect, settle, respond, balance, migrate."""

from __future__ import annotations

from dataclasses import astuple, dataclass, fields
from typing import Any

import torch
from torch import Tensor

from pgccd.broad import BroadPhase
from pgccd.distributed.balance import BalanceOptions, CellLoads, RankLoads, imbalance, rebalance
from pgccd.distributed.comm import Comm
from pgccd.distributed.detection import Detection, Options, detect_distributed
from pgccd.distributed.exchange import Columns, take_rows
from pgccd.distributed.migrate import Census, Leaving, migrate
from pgccd.distributed.partition import Partition
from pgccd.motion import RigidMotion
from pgccd.scene import Scene
from pgccd.sim.hashing import id_hash_of
from pgccd.sim.response import Settlement, respond
from pgccd.sim.rounds import Pace, goes_ahead
from pgccd.sim.step import Partners, Tally, count_step, settle_step, toi_of
from pgccd.sim.world import RobotState, World
from pgccd.stages import StageClock

# Robots made at a time at the start of a world.
_BLOCK_ROBOTS = 1 << 20
# Up to so many ranks, each tells all how many robots leave it for whom together with its tally; with more, those
# concerned alone.
_TELLS_MOVES = 64


@dataclass
class RankStep:
    """What one rank knows of a step that was made."""

    index: int  #: from 0
    detection: Detection
    before: RobotState  #: of the robots owned, as planned
    settlement: Settlement  #: of the robots held
    record: dict[str, Any]  #: of the whole world: the line in steps.jsonl, the same on all ranks but for the times


@dataclass
class _Report:
    """What a rank tells all others after a step."""

    tally: Tally
    held: int
    arrived: int
    busy: int  #: nanoseconds at work, not waiting for others
    census: Census  #: of its robots before the step
    moves: list[int]  #: how many robots leave it for each rank; empty if that is told later


class Fleet:
    """A world's robots, spread over ranks.

    Args:
        comm: between the ranks.
        world: the rules, the same on all ranks, on this rank's device.
        partition: the same on all ranks.
        state: of any share of the robots; all ranks together have each robot once.
        balance: how cells change hands.
        broad_phase, overlap: see `Options`.
        ahead: see `pgccd.sim.make_step`; the same on all ranks.

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
        ahead: bool | None = None,
    ) -> None:
        self.comm, self.world, self.partition = comm, world, partition
        self.balance = balance or BalanceOptions()
        # nonzero_toi: robots that part after a contact are free.
        self.options = Options("first", nonzero_toi=True, broad_phase=broad_phase, overlap=overlap, agree=True)
        # The fleet's own, so that all ranks know the same number of rounds.
        self._pace = Pace() if goes_ahead(ahead, world.device) else None
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
        comm, clock = self.comm, StageClock()
        comm.guard.activity = f"step {index}"
        with clock.stage("plan"):
            ids = id_hash_of(self.state.id)
            planned = self.world.plan(self.state, index)
        own = planned.moving_columns
        found = detect_distributed(comm, self.partition, own, self._build, self.options, clock)
        held, toi = found.held, toi_of(found.contacts)
        with clock.stage("respond"):
            partners = Partners(self.world, own, held.ghosts, found.pairs)
            settlement = settle_step(found.contacts, len(held), partners, self._pace, found.exchange)
            fraction = settlement.fraction[: len(planned)]
            after = respond(planned, fraction)
        with clock.stage("hash"):
            counted = count_step(after, fraction, held.id[found.contacts.pairs], toi)
            leaving = Leaving(comm, self.partition, after.position)
        with clock.stage("gather"):
            reports = self._tell(found, settlement, clock, torch.cat([counted, ids]), leaving)
        tallies = [report.tally for report in reports]
        Census.total([report.census for report in reports]).require(self._expected)
        moved_cells = self._balance(index, found, planned, reports, clock)
        with clock.stage("migrate"):
            moves = [report.moves for report in reports]
            known = None
            if moved_cells == 0 and all(moves):
                known = leaving, moves[comm.rank], [row[comm.rank] for row in moves]
            self._migrate(after, known)
        record = Tally.total(tallies).record(index, settlement.rounds, clock)
        record["ranks"] = {
            "bodies": [part.robots for part in tallies],
            "ghosts": [report.held - report.tally.robots for report in reports],
            "pcs": [part.pcs for part in tallies],
            "contacts": [part.contacts for part in tallies],
            "arrived": [report.arrived for report in reports],
            "busy_seconds": [round(1e-9 * report.busy, 6) for report in reports],
            "moved_cells": moved_cells,
            "imbalance": round(imbalance(torch.tensor([float(part.pcs) for part in tallies])), 4),
        }
        return RankStep(index, found, planned, settlement, record)

    def _build(self, columns: Columns) -> tuple[Scene, RigidMotion]:
        pose = (columns["position"], columns["orientation"], columns["velocity"], columns["angular_velocity"])
        return self.world.scene(columns["id"]), RigidMotion.from_velocity(*pose, dt=1.0)

    def _tell(
        self, found: Detection, settlement: Settlement, clock: StageClock, counted: Tensor, leaving: Leaving
    ) -> list[_Report]:
        """What all ranks have to report, in one all-gather; numbers that the device counted are read only then."""
        contacts, comm = found.contacts, self.comm
        stats, tally_size = contacts.stats, len(fields(Tally))
        tally = [len(found.pairs), len(contacts), settlement.secondary_contacts, stats.candidates, stats.unresolved]
        rest = [len(found.held), self._arrived, int(1e9 * clock.work)]
        host = torch.tensor([*rest, *tally]).to(counted.device, non_blocking=True)
        moves = [leaving.counts] if comm.size <= _TELLS_MOVES else []
        reports = []
        for row in comm.all_gather(torch.cat([host, counted, *moves])).tolist():
            held, arrived, busy = row[:3]
            told, (ids, *moved) = Tally.of(row[3 : 3 + tally_size]), row[3 + tally_size :]
            reports.append(_Report(told, held, arrived, busy, Census(told.robots, ids % 2**64), moved))
        return reports

    def _balance(
        self, index: int, found: Detection, planned: RobotState, reports: list[_Report], clock: StageClock
    ) -> int:
        """Shares the cells out anew; returns how many moved."""
        if not self.balance.applies(index + 1, self.comm.size):
            return 0
        with clock.stage("balance"):
            tallies = [report.tally for report in reports]
            counts = torch.tensor([[tally.robots, tally.pcs, tally.contacts] for tally in tallies])
            seconds = torch.tensor([1e-9 * report.busy for report in reports], dtype=torch.float64)
            if RankLoads(counts[:, 0], counts[:, 1], counts[:, 2], seconds).are_level(self.balance):
                return 0
            loads = cell_loads(self.partition, planned.position, found)
            total = CellLoads.unstacked(self.comm.sum(loads.stacked()))
            former = self.partition
            self.partition = rebalance(former, total, self.balance, seconds)
            return int((self.partition.owner != former.owner).sum())

    def _migrate(self, state: RobotState, known: tuple[Leaving, list[int], list[int]] | None = None) -> None:
        """Hands robots over; the state's ids ascend."""
        columns, self._arrived = migrate(self.comm, self.partition, state.columns, state.position, known)
        self.state = RobotState(**columns)


def cell_loads(partition: Partition, position: Tensor, found: Detection) -> CellLoads:
    """What one rank saw in each cell."""
    cells = [partition.cell_of(position)]
    cells += [found.reference_cells(partition, pairs) for pairs in (found.pairs, found.contacts.pairs)]
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
