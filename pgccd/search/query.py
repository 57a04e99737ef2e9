"""Options of a detection step."""

from dataclasses import dataclass, field

from pgccd import arguments
from pgccd.search import narrow
from pgccd.search.checks import Initial, check_separation, operator_tolerance, tests_start


@dataclass
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
    #: The operators' arguments min_separation, tolerance and nonzero_toi.
    settings: tuple[float, float, bool] = field(init=False, repr=False, compare=False)
    #: Whether surfaces that intersect at t = 0 are reported: the operators' argument of that name.
    tests_start: bool = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        arguments.choice(self.report, "report", narrow.REPORTS)
        separation = check_separation(self.min_separation)
        tolerance = operator_tolerance(self.tolerance)
        self.settings = separation, tolerance, arguments.flag(self.nonzero_toi, "nonzero_toi")
        self.tests_start = tests_start(self.initial)
