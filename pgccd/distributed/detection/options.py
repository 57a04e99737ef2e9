"""Options of detection on many ranks, and what it learns from step to step."""

from __future__ import annotations

from dataclasses import dataclass, field

from pgccd import arguments
from pgccd.distributed.detection.excluded import Excluded
from pgccd.distributed.partition.balance import BalanceOptions
from pgccd.distributed.partition.cut import DEFAULT_AXES, DEFAULT_CELLS, Cut
from pgccd.distributed.partition.interface import Point, Triple
from pgccd.search import broad, narrow
from pgccd.search.checks import Initial, check_separation, operator_tolerance
from pgccd.search.memory import CapacityEstimate
from pgccd.search.query import Query


@dataclass(frozen=True)
class RankOptions:
    """How the work is distributed over ranks. No result depends on it.

    Attributes:
        partition: of space at the start: "cells" (`Cells.uniform`) or "bisection" (`Bisection.uniform`). "auto": as in
            the checkpoint, else bisection; but cells if `axes` or `cells` is not the default or the policy of `balance`
            is "one-cell".
        axes, cells: as for `Cells.uniform`.
        balance: options of load balancing.
        overlap: whether pairs of own bodies are tested while ghosts are sent.
        broad_phase: as for `pgccd.detect`.

    Example:
        >>> options = pgccd.distributed.RankOptions(balance=pgccd.distributed.BalanceOptions("none"))
    """

    partition: str = "auto"
    axes: int = DEFAULT_AXES
    cells: int | Triple = DEFAULT_CELLS
    balance: BalanceOptions = field(default_factory=BalanceOptions)
    overlap: bool = True
    broad_phase: broad.BroadPhase = "auto"

    def _cut(self, lower: Point, upper: Point) -> Cut:
        """The partition of a box at the start."""
        return Cut(self.partition, lower, upper, self.axes, self.cells)


@dataclass(frozen=True)
class SearchOptions:
    """Options of `pgccd.detect`, and how to run it."""

    report: narrow.SearchReport = "first"
    min_separation: float = 0.0
    tolerance: float | None = None
    nonzero_toi: bool = False
    broad_phase: broad.BroadPhase = "auto"
    #: Whether pairs of own bodies are searched while ghosts are sent. The result does not depend on it.
    overlap: bool = True
    initial: Initial = "report"
    #: Whether passes have the pairs for rounds of resolution: `SearchPass.swept_pairs`.
    at_any_times: bool = False
    #: Pairs that are never tested, equal on all ranks.
    excluded: Excluded | None = None

    def check(self) -> None:
        """Raises TypeError or ValueError, naming the option, if one is invalid."""
        narrow.check_report(self.report, "World.collide")
        _ = self.query  # checks its own
        arguments.choice(self.broad_phase, "broad_phase", broad.BROAD_PHASES)
        arguments.flag(self.overlap, "overlap")

    @property
    def query(self) -> Query:
        """The options of each pass."""
        # Ties are broken by the order of ids, which is not the order of rows.
        report: narrow.SearchReport = "first" if self.report == "earliest" else self.report
        return Query(report, self.min_separation, self.tolerance, self.nonzero_toi, self.initial)

    @property
    def distances(self) -> tuple[float, float]:
        """min_separation and tolerance, as the operators take them."""
        return check_separation(self.min_separation), operator_tolerance(self.tolerance)


@dataclass
class PassEstimates:
    """Capacity estimates of the passes; owned by a simulation or `World`."""

    own: CapacityEstimate = field(default_factory=CapacityEstimate)
    with_ghosts: CapacityEstimate = field(default_factory=CapacityEstimate)
