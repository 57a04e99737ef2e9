"""The partition of space at the start of a world."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch

from pgccd import arguments
from pgccd.distributed.partition.balance import BalanceOptions
from pgccd.distributed.partition.bisection import Bisection
from pgccd.distributed.partition.cells import Cells, check_cells
from pgccd.distributed.partition.interface import Partition, Point, Triple

#: Kinds of `make_partition`.
PARTITIONS = ("cells", "bisection")
#: Values of the option `partition`.
PARTITION_CHOICES = ("auto", *PARTITIONS)
#: Default arguments of `Cells.uniform` in a world.
DEFAULT_AXES, DEFAULT_CELLS = 3, 16


@dataclass(frozen=True)
class Cut:
    """How space is divided at the start. Fields as for `WorldOptions` and `World.create`."""

    partition: str
    lower: Point
    upper: Point
    axes: int
    cells: int | Triple

    def uniform(
        self, ranks: int, device: torch.device, balance: BalanceOptions, former: str | None = None
    ) -> Partition:
        """The uniform partition for this number of ranks.

        Args:
            ranks: their number.
            device: of the partition.
            balance: its policy.
            former: the kind in the checkpoint from which the world continues, if any.

        Raises:
            TypeError, ValueError: naming the field.
        """
        kind = self._kind(balance, former)
        return make_partition(kind, self.lower, self.upper, ranks, self.axes, self.cells, device)

    def cell_count(self, balance: BalanceOptions) -> int:
        """Number of cells of a subdomain in the uniform partition; 0 if it has none.

        Raises:
            TypeError, ValueError: naming the field.
        """
        return math.prod(check_cells(self.axes, self.cells)) if self._kind(balance, None) == "cells" else 0

    def _kind(self, balance: BalanceOptions, former: str | None) -> str:
        """For "auto", the kind in the checkpoint, or bisection, unless other options ask for cells."""
        arguments.choice(self.partition, "partition", PARTITION_CHOICES)
        if not isinstance(balance, BalanceOptions):
            raise TypeError(f"balance: expected BalanceOptions, got {arguments.describe(balance)}")
        needs_cells = balance.policy == "one-cell"
        if self.partition == "bisection" and needs_cells:
            raise ValueError('balance: "one-cell" moves cells, but partition "bisection" has none')
        if self.partition != "auto":
            return self.partition
        given = self.axes, self.cells
        are_default = all(isinstance(count, int) for count in given) and given == (DEFAULT_AXES, DEFAULT_CELLS)
        if needs_cells or not are_default:
            return "cells"
        return former if former in PARTITIONS else "bisection"


def make_partition(
    kind: str, lower: Point, upper: Point, ranks: int, axes: int, cells: int | Triple, device: torch.device
) -> Partition:
    """The initial partition of a world. `axes` and `cells` are those of `Cells.uniform`.

    Raises:
        ValueError: naming the argument.
    """
    arguments.choice(kind, "partition", PARTITIONS)
    check_cells(axes, cells)
    if kind == "bisection":
        return Bisection.uniform(lower, upper, ranks, device)
    return Cells.uniform(lower, upper, ranks, axes=axes, cells=cells, device=device)
