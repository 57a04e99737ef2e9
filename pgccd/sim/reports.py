"""Values of all ranks at the end of a step."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch

from pgccd.distributed.partition.balance import RankLoads, imbalance
from pgccd.sim.tally import COUNTED, WORK, Rows

#: Number of values of each rank besides those of `count_step`.
REPORTED = 4


@dataclass(frozen=True)
class Reports:
    """Values of all ranks, one row per rank."""

    work: Rows  #: (ranks, 6), see `WORK`
    counted: Rows  #: (ranks, 6) by `count_step`
    ghosts: Rows  #: (ranks,): number of ghosts
    arrived: Rows  #: (ranks,): number of robots that arrived from other ranks before the step
    stop: Rows  #: (ranks,): 0 or 1
    leaving: Rows  #: (ranks,): number of robots in cells of other ranks after it, if it was a replay

    @classmethod
    def of(cls, work: Rows, summaries: Rows) -> Reports:
        """`summaries`: (ranks, k): the values of each rank of `Simulation`, in this order."""
        counted, rest = summaries[:, :COUNTED], summaries[:, COUNTED:]
        return cls(work, counted, *rest.T)

    @property
    def robots(self) -> list[int]:
        """Number of robots of each rank."""
        return self.counted[:, 0].tolist()

    def worked(self, name: str) -> list[int]:
        """One of `WORK`, per rank."""
        return self.work[:, WORK.index(name)].tolist()

    @property
    def loads(self) -> RankLoads:
        """The ranks' loads, for balancing."""
        return RankLoads(self.robots, self.worked("pcs"), self.worked("contacts"), self.seconds())

    def seconds(self) -> list[float]:
        """Seconds that each rank spent in traversal and narrow phase."""
        return [1e-9 * spent for spent in self.worked("nanoseconds")]

    def record(self, moved_cells: int) -> dict[str, Any]:
        """The object `ranks` of the step's line in the log, by its name; nothing of a single rank."""
        if len(self.work) == 1:
            return {}
        ranks = {
            "bodies": self.robots,
            "ghosts": self.ghosts.tolist(),
            "pcs": self.worked("pcs"),
            "contacts": self.worked("contacts"),
            "arrived": self.arrived.tolist(),
            "busy_seconds": [round(seconds, 6) for seconds in self.seconds()],
            "moved_cells": moved_cells,
            "imbalance": round(imbalance(torch.tensor(self.worked("pcs"), dtype=torch.float64)), 4),
        }
        return {"ranks": ranks}
