"""How a simulation is distributed over ranks."""

from __future__ import annotations

from dataclasses import dataclass, field

from pgccd.distributed.comm.interface import Comm
from pgccd.distributed.partition.balance import BalanceOptions
from pgccd.distributed.partition.cut import DEFAULT_AXES, DEFAULT_CELLS, Cut
from pgccd.distributed.partition.interface import Partition, Triple
from pgccd.sim.model import Model


@dataclass(frozen=True)
class RankOptions:
    """Options of the distribution over ranks. No result depends on them.

    Attributes:
        partition: "cells" or "bisection". "auto": that of the checkpoint, or bisection; but cells if `axes` or `cells`
            is not the default or the policy moves single cells.
        axes: number of axes that are cut: 1 (slabs), 2 or 3.
        cells: number in each subdomain: m means m x m in X-Y.
        balance: options of load balancing.
        overlap: whether pairs of own bodies are tested while ghosts are sent.
    """

    partition: str = "auto"
    axes: int = DEFAULT_AXES
    cells: int | Triple = DEFAULT_CELLS
    balance: BalanceOptions = field(default_factory=BalanceOptions)
    overlap: bool = True

    def cut(self, comm: Comm, model: Model, former: str | None = None) -> Partition:
        """The partition of space at the start.

        Args:
            comm: between the ranks.
            model: the rules.
            former: the kind of partition of the checkpoint, if there is one.
        """
        x, y, z = model.half_extent
        cut = Cut(self.partition, (-x, -y, -z), (x, y, z), self.axes, self.cells)
        return cut.uniform(comm.size, model.device, self.balance, former)
