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
    #: The operators' arguments min_separation and tolerance.
    lengths: tuple[float, float] = field(init=False, repr=False, compare=False)
    #: Whether surfaces that intersect at t = 0 are reported: the operators' argument of that name.
    tests_start: bool = field(init=False, repr=False, compare=False)
    #: The operators' argument of that name: `QueryOptions` of csrc/bind/padded_ops.h. A list: torch takes 3 us more for
    #: a named tuple.
    options: list[int] = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        arguments.choice(self.report, "report", narrow.REPORTS)
        self.lengths = check_separation(self.min_separation), operator_tolerance(self.tolerance)
        nonzero_toi, self.tests_start = arguments.flag(self.nonzero_toi, "nonzero_toi"), tests_start(self.initial)
        self.options = [nonzero_toi, self.tests_start, narrow.REPORTS[self.report]]
