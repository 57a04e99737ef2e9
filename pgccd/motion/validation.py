"""Validation of the numbers in the columns of motions and scenes. `ops.first_invalid_rows` finds invalid numbers;
errors name the column and the row, and give the value.
"""

import math
import weakref
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import Any

import torch
from torch import Tensor

from pgccd import arguments, ops
from pgccd.geometry.mesh import LARGEST_RADIUS, SMALLEST_RADIUS

# Maximum deviation of a quaternion from unit length; smaller deviations are normalised.
UNIT_TOLERANCE = 1e-3
# Squares of larger coordinates overflow.
LARGEST_COORDINATE = arguments.LONGEST
# Error bounds of sine and cosine are proven up to this angle.
LARGEST_TURN = 1e6
_NO_VALUES = torch.empty(0)
# The operator's numbers (enum RowCheck of csrc/kernels/bounds/validation.h).
CHECK_NUMBERS = {"magnitude": 0, "unit_length": 1, "length": 2, "range": 3, "size": 4}


@dataclass
class Check:
    """A condition on the rows of a column.

    Args:
        kind: a key of `CHECK_NUMBERS`.
        limit: see `ops.first_invalid_rows`.
        expected: the condition in words.
    """

    kind: str
    limit: float
    expected: str

    def is_invalid(self, row: Sequence[float]) -> bool:
        """Whether the values of a row violate the condition."""
        length = math.hypot(*row)
        if self.kind == "unit_length":
            return not abs(length - 1.0) <= self.limit
        if self.kind == "length":
            return not length <= self.limit
        if self.kind == "size":
            return not all(value == 0.0 or SMALLEST_RADIUS <= value <= self.limit for value in row)
        least = 0.0 if self.kind == "range" else -self.limit
        return not all(least <= value <= self.limit for value in row)

    def found(self, values: Tensor) -> str:
        """The values of an invalid row in words; empty if they have been overwritten by valid ones since."""
        given = values.tolist()
        row = given if isinstance(given, list) else [given]
        if not self.is_invalid(row):
            return ""
        length = math.hypot(*row)
        of = {"unit_length": f" of norm {length:.6g}", "length": f" of length {length:.6g}"}.get(self.kind, "")
        return f", got {given}{of}"


_FINITE = Check("magnitude", LARGEST_COORDINATE, f"finite numbers up to {LARGEST_COORDINATE:g}")
_UNIT = Check("unit_length", UNIT_TOLERANCE, "a unit quaternion (w, x, y, z)")
_TURN = Check("length", LARGEST_TURN, f"a turn of at most {LARGEST_TURN:g} radians in the step")
MARGIN = Check("range", LARGEST_COORDINATE, arguments.LENGTH)
# Of a body that deforms; it may shrink to a point.
RADIUS = Check("size", LARGEST_RADIUS, f"an SBV radius of 0, or from {SMALLEST_RADIUS:g} to {LARGEST_RADIUS:g}")
# By name of a column of a motion.
_CHECKS = {
    "orientation": _UNIT,
    "orientation_t0": _UNIT,
    "orientation_t1": _UNIT,
    "rotation": _TURN,
    "angular_velocity": _TURN,
}


@dataclass
class Checked:
    """A column whose rows are checked, and how errors name them.

    Args:
        values: (rows, ...).
        check: of each row.
        row: the meaning of a row, "body" or "vertex".
        source: the argument that the column is computed from.
        origin: that argument with its own check, if known; errors then name it.
    """

    name: str
    values: Tensor
    check: Check
    row: str
    source: str | None = None
    origin: "Checked | None" = None

    def __len__(self) -> int:
        return len(self.values)

    def problem(self, index: int, number: int | None = None, later: bool = False) -> str:
        """What is wrong with a row. Its number in the error is `number`, by default its index. With `later` its values
        are left out, since they may have changed.
        """
        if self.origin is not None and self.origin.check.is_invalid(self.origin.values[index].tolist()):
            return self.origin.problem(index, number, later)
        follows = "" if self.source is None else f" (it follows from {self.source})"
        found = "" if later else self.check.found(self.values[index])
        where = f"{self.row} {index if number is None else number}"
        return f"{self.name}: {where}: expected {self.check.expected}{found}{follows}"


@dataclass
class _WeaklyChecked(Checked):
    """A column that may be gone when an error is to name a row of it. It does not hold the values."""

    rows: int = 0
    column: weakref.ref[Tensor] | None = None

    @classmethod
    def of(cls, checked: Checked) -> "_WeaklyChecked":
        # In a compiled graph there are no values to state.
        column = None if torch.compiler.is_compiling() else weakref.ref(checked.values)
        origin = None if checked.origin is None else cls.of(checked.origin)
        given = checked.name, _NO_VALUES, checked.check, checked.row, checked.source, origin
        return cls(*given, len(checked.values), column)

    def __getstate__(self) -> dict[str, Any]:
        return self.__dict__ | {"column": None}

    def __len__(self) -> int:
        return self.rows

    def problem(self, index: int, number: int | None = None, later: bool = False) -> str:
        values = None if self.column is None else self.column()
        origin = None
        if isinstance(self.origin, _WeaklyChecked) and self.origin.column is not None:
            given = self.origin.column()
            origin = None if given is None else replace(_plain(self.origin), values=given)
        whole = replace(_plain(self), values=self.values if values is None else values, origin=origin)
        return whole.problem(index, number, later or values is None)


def _plain(weak: _WeaklyChecked) -> Checked:
    return Checked(weak.name, weak.values, weak.check, weak.row, weak.source)


def check_of(name: str) -> Check:
    """The check of a column of a motion, by its name."""
    return _CHECKS.get(name, _FINITE)


def checks_of(names: Iterable[str]) -> tuple[list[int], list[float]]:
    """The `checks` and `limits` of `ops.first_invalid_rows` for columns of these names."""
    checks = [check_of(name) for name in names]
    return [CHECK_NUMBERS[check.kind] for check in checks], [check.limit for check in checks]


def columns_checked(
    columns: Mapping[str, Tensor],
    row: str,
    sources: Mapping[str, str] = MappingProxyType({}),
    given: Mapping[str, Tensor] = MappingProxyType({}),
) -> list[Checked]:
    """The columns of a motion, by name, with their checks.

    Args:
        sources: for a column, the argument that it is computed from.
        given: such arguments.
    """
    checked = []
    for name, values in columns.items():
        source = sources.get(name)
        origin = None
        if source is not None and source in given:
            origin = Checked(source, given[source], check_of(source), row)
        checked.append(Checked(name, values, check_of(name), row, source, origin))
    return checked


def first_invalid_rows(columns: Sequence[Checked]) -> Tensor:
    """(F + 1,) int64 on the columns' device: the first invalid row of each of the F columns, or the number of rows;
    then 1 if any row is invalid, else 0. Does not synchronise.
    """
    values = [each.values.detach() if each.values.requires_grad else each.values for each in columns]
    values = [column.to(torch.float64) for column in values]
    values = [column[:, None] if column.dim() == 1 else column for column in values]
    checks = [CHECK_NUMBERS[each.check.kind] for each in columns]
    return ops.first_invalid_rows(values, checks, [each.check.limit for each in columns])


@dataclass
class Validation:
    """The meaning of the values of `first_invalid_rows`.

    Args:
        columns: those checked, in order.
    """

    columns: list[Checked]

    def weakly(self) -> "Validation":
        """The same, for results: it does not keep the columns alive, and states their values only while something else
        does.
        """
        return replace(self, columns=[_WeaklyChecked.of(column) for column in self.columns])

    def raise_from(self, first: Sequence[int], later: bool = False) -> None:
        """Raises ValueError for the first invalid row, if there is one.

        Args:
            first: values of `first_invalid_rows`.
            later: whether columns may hold other values by now; the message then states no values.
        """
        for column, index in zip(self.columns, first, strict=False):
            if index < len(column):
                raise ValueError(column.problem(index, later=later))
