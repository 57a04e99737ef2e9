"""Options of a detection step."""

from dataclasses import dataclass

from pgccd import arguments
from pgccd.search import narrow
from pgccd.search.checks import Initial, check_separation, operator_tolerance, tests_start


@dataclass(frozen=True)
class Query:
    """The options of `pgccd.detect` that its stages share.

    Raises:
        TypeError, ValueError: naming the option.
    """

    report: narrow.SearchReport
    min_separation: float
    tolerance: float | None
    nonzero_toi: bool
    initial: Initial = "report"

    def __post_init__(self) -> None:
        arguments.choice(self.report, "report", narrow.REPORTS)
        check_separation(self.min_separation)
        operator_tolerance(self.tolerance)
        arguments.flag(self.nonzero_toi, "nonzero_toi")
        tests_start(self.initial)

    @property
    def settings(self) -> tuple[float, float, bool]:
        """The operators' arguments min_separation, tolerance and nonzero_toi."""
        return self.min_separation, operator_tolerance(self.tolerance), self.nonzero_toi

    @property
    def tests_start(self) -> bool:
        """Whether surfaces that intersect at t = 0 are reported: the operators' argument of that name."""
        return tests_start(self.initial)
