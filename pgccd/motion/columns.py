"""The columns of a motion, validated at each use: a user may modify or replace them at any time."""

import copy
from collections.abc import Mapping, Sequence
from typing import Any, TypeVar

import torch
from torch import Tensor

from pgccd import arguments
from pgccd.arguments import real_rows
from pgccd.motion.differentiable import any_differentiated
from pgccd.motion.validation import Checked, Validation, columns_checked, first_invalid_rows, joined

_Self = TypeVar("_Self", bound="MovingColumns")


class MovingColumns:
    """Base of rigid and deforming motions: named float64 columns of equal length on one device."""

    # Names of the columns that detection reads, and the meaning of a row.
    _names: tuple[str, ...] = ()
    _row = "body"
    #: `checks` and `limits` of these columns, for `ops.detect_rigid`.
    _checks: tuple[list[int], list[float]] = ([], [])
    # Arguments that are not stored as a column, and their `first_invalid_rows`.
    _given: Mapping[str, Tensor] = {}
    _given_invalid_rows: Tensor | None = None
    # For a column, the argument that it is computed from.
    _sources: Mapping[str, str] = {}
    #: Whether the columns come from a validated motion and are not checked again.
    _is_trusted: bool = False
    # Cached `_first_invalid_rows` of such columns.
    _no_invalid_rows: Tensor | None = None
    # Columns whose types and shapes have been checked.
    _sound: Mapping[str, Tensor] = {}

    @property
    def device(self) -> torch.device:
        """The device of the columns."""
        return getattr(self, self._names[0]).device

    def columns(self) -> dict[str, Tensor]:
        """The current columns that detection reads.

        Raises:
            TypeError, ValueError: a column was replaced by one of another type, shape or device, or requires grad.
        """
        columns = {name: getattr(self, name) for name in self._names}
        if self._is_trusted or all(
            name in self._sound and self._sound[name] is column and not column.requires_grad
            for name, column in columns.items()
        ):
            return columns
        self._refuse_gradient()
        given, count, device = dict(columns), None, None
        for name, column in given.items():
            columns[name] = real_rows(column, name, count, 4 if name.startswith("orientation") else 3, device)
            if column.dtype != torch.float64:
                raise TypeError(f"{name}: expected float64, got {column.dtype}")
            count, device = column.shape[0], column.device
        if all(columns[name] is column for name, column in given.items()):
            self._sound = given
        return columns

    @property
    def _is_differentiated(self) -> bool:
        """Whether a column requires grad while gradients are enabled."""
        return any_differentiated(*(getattr(self, name) for name in self._names))

    def _refuse_gradient(self) -> None:
        """Raises ValueError naming the first argument that requires grad while gradients are enabled."""
        for name in self._names:
            column = getattr(self, name)
            if isinstance(column, Tensor):
                arguments.refuse_gradient(column, self._sources.get(name, name))

    def _detached(self: _Self) -> _Self:
        """The motion without gradients; itself if it has none."""
        if not self._is_differentiated:
            return self
        plain = copy.copy(self)
        for name in self._names:
            setattr(plain, name, getattr(self, name).detach())
        return plain

    def _first_invalid_rows(self, columns: Mapping[str, Tensor] | None = None, more: Sequence[Checked] = ()) -> Tensor:
        """(F + 1,) int64 on the motion's device: the first invalid row of each argument, or the number of rows; then 1
        if any row is invalid, else 0. Computed at each call.

        Args:
            columns: as returned by `columns()`. Default: the current ones.
            more: columns of the scene, checked after those of the motion.
        """
        if not self._is_trusted:
            columns = self.columns() if columns is None else columns
            return joined(self._given_invalid_rows, first_invalid_rows([*self._checked(columns), *more]))
        if more:
            return first_invalid_rows(more)
        if self._no_invalid_rows is None:
            self._no_invalid_rows = torch.zeros(1, dtype=torch.int64, device=self.device)
        return self._no_invalid_rows

    @property
    def _validation(self) -> Validation:
        """The meaning of the values of `_first_invalid_rows`."""
        if self._is_trusted:
            return Validation([])
        columns = {name: getattr(self, name) for name in self._names}
        return Validation([*self._checked(self._given), *self._checked(columns)])

    def _checked(self, columns: Mapping[str, Tensor]) -> list[Checked]:
        return columns_checked(columns, self._row, self._sources)

    @property
    def _has_verdict(self) -> bool:
        """Whether `_first_invalid_rows` is known, or includes arguments that are not columns."""
        return self._is_trusted or self._given_invalid_rows is not None

    @property
    def _first_invalid_given(self) -> Tensor | None:
        """(1,) int64 on the device: the first row that is invalid in an argument not stored as a column, or the number
        of rows; None if all were valid.
        """
        return None if self._given_invalid_rows is None else self._given_invalid_rows[:-1].min().reshape(1)

    def check(self) -> None:
        """Raises ValueError naming the first row with a number that is not finite or too large, or a quaternion that is
        not unit.
        """
        self._raise_invalid(self._first_invalid_rows().tolist())

    def _raise_invalid(self, first: Sequence[int]) -> None:
        """Raises ValueError if the values of `_first_invalid_rows` include an invalid row."""
        if first[-1]:
            self._validation.raise_from(first)

    def _check_given(self) -> None:
        """Raises ValueError if an argument that is not stored as a column was invalid. May synchronise with a GPU."""
        if self._given_invalid_rows is not None:
            self.check()
            self._given, self._given_invalid_rows = {}, None

    def to(self: _Self, device: torch.device | str) -> _Self:
        """A copy on another device.

        Example:
            >>> motion = motion.to("cpu")
        """
        device = arguments.device(device)
        moved = copy.copy(self)
        for name in (*self._names, "_given_invalid_rows", "_no_invalid_rows"):
            column = getattr(self, name)
            if column is not None:
                setattr(moved, name, column.to(device))
        moved._given = {name: column.to(device) for name, column in self._given.items()}
        return moved

    def state_dict(self) -> dict[str, Any]:
        """The motion as a dictionary of tensors and names, without gradients, for `torch.save` and `torch.load` with
        weights_only=True.

        Raises:
            TypeError, ValueError: the motion is invalid.

        Example:
            >>> torch.save(motion.state_dict(), "motion.pt")
        """
        self._check_given()
        return dict(self._detached().columns())

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
                self._given, self._given_invalid_rows = given, first_invalid_rows(self._checked(given))
            return
        columns = self._checked({**given, **self._detached().columns()})
        first = first_invalid_rows(columns).tolist()
        if not first[-1]:
            return
        if origins:
            of_origins = columns_checked({name: column.detach() for name, column in origins.items()}, self._row)
            Validation(of_origins).raise_from(first_invalid_rows(of_origins).tolist())
        Validation(columns).raise_from(first)
