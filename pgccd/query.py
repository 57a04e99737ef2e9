"""What is asked of a step."""

from __future__ import annotations

from dataclasses import dataclass

from pgccd import broad, narrow


@dataclass(frozen=True)
class Query:
    """The options of `pgccd.detect` that its stages share.

    Raises:
        ValueError: naming the option.
    """

    report: narrow.Report
    min_separation: float
    tolerance: float | None
    nonzero_toi: bool

    def __post_init__(self) -> None:
        if self.report not in narrow.REPORTS:
            raise ValueError(f"report: expected one of {list(narrow.REPORTS)}, got {self.report!r}")
        broad.check_separation(self.min_separation)
        broad.operator_tolerance(self.tolerance)
