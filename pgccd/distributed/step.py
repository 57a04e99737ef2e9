"""One step of the nanorobot world on many ranks: plan, halo, detect, settle, respond, balance, migrate."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import astuple, dataclass
from functools import cached_property
from typing import Any

import torch
from torch import Tensor

from pgccd.broad import BroadPhase
from pgccd.distributed.balance import BalanceOptions, CellLoads, RankLoads, imbalance, rebalance
from pgccd.distributed.comm import Comm
from pgccd.distributed.detection import Detection
from pgccd.distributed.exchange import Columns, take_rows
from pgccd.distributed.migrate import Census, Leaving, migrate
from pgccd.distributed.partition import Partition
from pgccd.distributed.share import Options, Share, find_share
from pgccd.motion import RigidMotion
from pgccd.parts import Part, contacts_of_step
from pgccd.scene import Scene
from pgccd.sim.partners import Partners
from pgccd.sim.response import Settlement, respond
from pgccd.sim.rounds import Pace, goes_ahead, knows_rounds
from pgccd.sim.step import Settled, settle_step
from pgccd.sim.tally import COUNTED, Tally, Work, count_step
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
    before: RobotState  #: of the robots owned, as planned
    settlement: Settlement  #: of the robots held
    wished: bool  #: whether any rank was given a wish
    find: Callable[[], Detection]  #: gives `detection`
    tell: Callable[[], dict[str, Any]]  #: gives `record`

    @cached_property
    def detection(self) -> Detection:
        """Of the whole step."""
        return self.find()

    @cached_property
    def record(self) -> dict[str, Any]:
        """Of the whole world: the line in steps.jsonl, the same on all ranks but for the times."""
        return self.tell()


@dataclass
class _Report:
    """What a rank tells all others after a step."""

    tally: Tally
    held: int
    arrived: int
    wish: int
    busy: int  #: nanoseconds of traversing and solving
    moves: list[int]  #: how many robots leave it for each rank; empty if that is told later

    @classmethod
    def of(cls, work: Work, told: list[int]) -> _Report:
        """`told`: what a rank concluded."""
        counted, (held, arrived, wish, *moves) = told[:COUNTED], told[COUNTED:]
        return cls(Tally.of(work, counted), held, arrived, wish, work.nanoseconds, moves)


class Fleet:
    """A world's robots, spread over ranks.

    Args:
        comm: between the ranks.
        world: the rules, the same on all ranks, on this rank's device.
        partition: the same on all ranks.
        state: of any share of the robots; all ranks together have each robot once.
        balance: how cells change hands.
        broad_phase, overlap: see `Options`.
        ahead: see `pgccd.sim.make_step`; the same on all ranks. Default: on a GPU, and with other ranks.

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
        self.options = Options("first", nonzero_toi=True, broad_phase=broad_phase, overlap=overlap)
        # The fleet's own, so that all ranks know the same number of rounds.
        self._pace = Pace() if goes_ahead(ahead, world.device, comm.size) else None
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

    def step(self, index: int, wish: bool = False) -> RankStep:
        """Moves the robots by one step, the `index`-th from 0.

        Args:
            index: the same on all ranks.
            wish: to stop, say: all are told whether any rank has it.
        """
        comm, clock = self.comm, StageClock()
        comm.guard.activity = f"step {index}"
        with clock.stage("plan"):
            planned = self.world.plan(self.state, index)
        own = planned.moving_columns
        begin = Part.start if knows_rounds(self._pace) else Part.begin
        share = find_share(comm, self.partition, own, self._build, self.options, clock, begin)
        with clock.stage("halo"):
            exchange = share.exchange(self.partition)
            partners = Partners(self.world, own, share.held.ghosts, share.pairs)
        after: RobotState = planned
        leaving: Leaving | None = None

        def conclude(pairs: Tensor, toi: Tensor, fraction: Tensor) -> Tensor:
            nonlocal after, leaving
            fraction = fraction[: len(planned)]
            with clock.stage("respond"):
                after = respond(planned, fraction)
            with clock.stage("hash"):
                counted = count_step(after, fraction, share.held.id, pairs, toi)
                leaving = Leaving(comm, self.partition, after.position)
                moves = [leaving.counts] if comm.size <= _TELLS_MOVES else []
                return torch.cat([counted, self._told_by_host(share, wish), *moves])

        settled = settle_step(share.parts, len(share.held), partners, self._pace, conclude, clock, exchange)
        reports = [_Report.of(*told) for told in zip(settled.work, settled.told, strict=True)]
        tallies = [report.tally for report in reports]
        Census.total([Census(tally.robots, tally.id_hash) for tally in tallies]).require(self._expected)
        moved_cells = self._balance(index, share, settled, planned, reports, clock)
        with clock.stage("migrate"):
            moves = [report.moves for report in reports]
            known = None
            if leaving is not None and moved_cells == 0 and all(moves):
                known = leaving, moves[comm.rank], [row[comm.rank] for row in moves]
            self._migrate(after, known)
        settled.learn()
        clock.stop()

        def tell() -> dict[str, Any]:
            record = Tally.total(tallies).record(index, settled.settlement.rounds, clock)
            return record | {"ranks": _told_of_ranks(reports, moved_cells)}

        def find() -> Detection:
            return Detection(share, contacts_of_step(share.parts))

        wished = any(report.wish for report in reports)
        return RankStep(index, planned, settled.settlement, wished, find, tell)

    def _told_by_host(self, share: Share, wish: bool) -> Tensor:
        return torch.tensor([len(share.held), self._arrived, int(wish)]).to(self.world.device, non_blocking=True)

    def _build(self, columns: Columns) -> tuple[Scene, RigidMotion]:
        pose = (columns["position"], columns["orientation"], columns["velocity"], columns["angular_velocity"])
        return self.world.scene(columns["id"]), RigidMotion.from_velocity(*pose, dt=1.0)

    def _balance(
        self,
        index: int,
        share: Share,
        settled: Settled,
        planned: RobotState,
        reports: list[_Report],
        clock: StageClock,
    ) -> int:
        """Shares the cells out anew; returns how many moved."""
        if not self.balance.applies(index + 1, self.comm.size):
            return 0
        with clock.stage("balance"):
            tallies = [report.tally for report in reports]
            robots, pcs, contacts = (
                [getattr(tally, name) for tally in tallies] for name in ("robots", "pcs", "contacts")
            )
            seconds = [1e-9 * report.busy for report in reports]
            if RankLoads(robots, pcs, contacts, seconds).are_level(self.balance):
                return 0
            settled.learn()  # so that contacts need not be waited for
            loads = cell_loads(self.partition, planned.position, Detection(share, contacts_of_step(share.parts)))
            total = CellLoads.unstacked(self.comm.sum(loads.stacked()))
            former = self.partition
            self.partition = rebalance(former, total, self.balance, torch.tensor(seconds, dtype=torch.float64))
            return int((self.partition.owner != former.owner).sum())

    def _migrate(self, state: RobotState, known: tuple[Leaving, list[int], list[int]] | None = None) -> None:
        """Hands robots over; the state's ids ascend."""
        columns, self._arrived = migrate(self.comm, self.partition, state.columns, state.position, known)
        self.state = RobotState(**columns)


def _told_of_ranks(reports: list[_Report], moved_cells: int) -> dict[str, Any]:
    tallies = [report.tally for report in reports]
    return {
        "bodies": [part.robots for part in tallies],
        "ghosts": [report.held - report.tally.robots for report in reports],
        "pcs": [part.pcs for part in tallies],
        "contacts": [part.contacts for part in tallies],
        "arrived": [report.arrived for report in reports],
        "busy_seconds": [round(1e-9 * report.busy, 6) for report in reports],
        "moved_cells": moved_cells,
        "imbalance": round(imbalance(torch.tensor([float(part.pcs) for part in tallies])), 4),
    }


def cell_loads(partition: Partition, position: Tensor, found: Detection) -> CellLoads:
    """What one rank saw in each cell."""
    cells = [partition.cell_of(position), *found.cells(partition)]
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
