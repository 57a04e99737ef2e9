"""The columns of a motion, validated at each use: a user may modify or replace them at any time."""

import copy
from collections.abc import Mapping, Sequence
from typing import TypeVar

import torch
from torch import Tensor

from pgccd import arguments
from pgccd.arguments import real_rows
from pgccd.motion.faults import Checked, Faults, columns_checked, first_faults, joined

_Self = TypeVar("_Self", bound="MovingColumns")


class MovingColumns:
    """Base of rigid and deforming motions: named float64 columns of equal length on one device."""

    # Names of the columns that detection reads, and the meaning of a row.
    _names: tuple[str, ...] = ()
    _row = "body"
    #: `checks` and `limits` of these columns, for `ops.detect_rigid`.
    checks: tuple[list[int], list[float]] = ([], [])
    # Arguments that are not stored as a column, and their faults.
    _given: Mapping[str, Tensor] = {}
    _given_faults: Tensor | None = None
    # For a column, the argument that it is computed from.
    _sources: Mapping[str, str] = {}
    #: Whether the columns come from a validated motion and are not checked again.
    _is_trusted: bool = False
    # Cached `_first_faults` of such columns.
    _no_faults: Tensor | None = None
    # Columns whose types and shapes have been checked.
    _sound: Mapping[str, Tensor] = {}

    @property
    def device(self) -> torch.device:
        """The device of the columns."""
        return getattr(self, self._names[0]).device

    def columns(self) -> dict[str, Tensor]:
        """The current columns that detection reads.

        Raises:
            TypeError, ValueError: a column was replaced by one of another type, shape or device.
        """
        columns = {name: getattr(self, name) for name in self._names}
        if self._is_trusted or all(
            name in self._sound and self._sound[name] is column and not column.requires_grad
            for name, column in columns.items()
        ):
            return columns
        given, count, device = dict(columns), None, None
        for name, column in given.items():
            columns[name] = real_rows(column, name, count, 4 if name.startswith("orientation") else 3, device)
            if column.dtype != torch.float64:
                raise TypeError(f"{name}: expected float64, got {column.dtype}")
            count, device = column.shape[0], column.device
        if all(columns[name] is column for name, column in given.items()):
            self._sound = given
        return columns

    def _first_faults(self, columns: Mapping[str, Tensor] | None = None, more: Sequence[Checked] = ()) -> Tensor:
        """(F + 1,) int64 on the motion's device: the first faulty row of each argument, or the number of rows; then 1
        if any row is faulty, else 0. Computed at each call.

        Args:
            columns: as returned by `columns()`. Default: the current ones.
            more: columns of the scene, checked after those of the motion.
        """
        if not self._is_trusted:
            columns = self.columns() if columns is None else columns
            return joined(self._given_faults, first_faults([*self._checked(columns), *more]))
        if more:
            return first_faults(more)
        if self._no_faults is None:
            self._no_faults = torch.zeros(1, dtype=torch.int64, device=self.device)
        return self._no_faults

    @property
    def faults(self) -> Faults:
        """The meaning of the values of `_first_faults`."""
        if self._is_trusted:
            return Faults([])
        columns = {name: getattr(self, name) for name in self._names}
        return Faults([*self._checked(self._given), *self._checked(columns)])

    def _checked(self, columns: Mapping[str, Tensor]) -> list[Checked]:
        return columns_checked(columns, self._row, self._sources)

    @property
    def _has_verdict(self) -> bool:
        """Whether `_first_faults` is known, or includes faults that are not in the columns."""
        return self._is_trusted or self._given_faults is not None

    @property
    def _first_given_fault(self) -> Tensor | None:
        """(1,) int64 on the device: the first row that is faulty in an argument not stored as a column, or the number
        of rows; None if all were valid.
        """
        return None if self._given_faults is None else self._given_faults[:-1].min().reshape(1)

    def check(self) -> None:
        """Raises ValueError naming the first row with a number that is not finite or too large, or a quaternion that is
        not unit.
        """
        self._raise_faults(self._first_faults().tolist())

    def _raise_faults(self, first: Sequence[int]) -> None:
        """Raises ValueError if the values of `_first_faults` include a faulty row."""
        if first[-1]:
            self.faults.raise_from(first)

    def _check_given(self) -> None:
        """Raises ValueError if an argument that is not stored as a column was invalid. May synchronise with a GPU."""
        if self._given_faults is not None:
            self.check()
            self._given, self._given_faults = {}, None

    def to(self: _Self, device: torch.device | str) -> _Self:
        """A copy on another device.

        Example:
            >>> motion = motion.to("cpu")
        """
        device = arguments.device(device)
        moved = copy.copy(self)
        for name in (*self._names, "_given_faults", "_no_faults"):
            column = getattr(self, name)
            if column is not None:
                setattr(moved, name, column.to(device))
        moved._given = {name: column.to(device) for name, column in self._given.items()}
        return moved

    def _check_early(
        self, origins: Mapping[str, Tensor] | None = None, given: Mapping[str, Tensor] | None = None
    ) -> None:
        """Checks values on a CPU; on a GPU the check is deferred.

        Args:
            origins: arguments from which columns are computed; errors name these first.
            given: arguments that are not stored as columns; checked now.
        """
        given = given or {}
        if self.device.type != "cpu" or torch.compiler.is_compiling():
            if given:
                self._given, self._given_faults = given, first_faults(self._checked(given))
            return
        columns = self._checked({**given, **self.columns()})
        first = first_faults(columns).tolist()
        if not first[-1]:
            return
        if origins:
            of_origins = columns_checked(origins, self._row)
            Faults(of_origins).raise_from(first_faults(of_origins).tolist())
        Faults(columns).raise_from(first)
