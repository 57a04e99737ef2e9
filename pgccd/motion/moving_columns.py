"""The columns of a motion: types and shapes are checked when columns are given, values wherever they are read."""

from collections.abc import Mapping, Sequence
from typing import Any, TypeVar

import torch
from torch import Tensor

from pgccd import arguments, ops
from pgccd.arguments import real_rows
from pgccd.motion.differentiable import any_differentiated
from pgccd.motion.validation import Checked, Validation, columns_checked, first_invalid_rows

_Self = TypeVar("_Self", bound="MovingColumns")


class MovingColumns:
    """Base of rigid and deforming motions: named float64 columns of equal length on one device. They may be written to,
    or replaced by others of the same shape and device. Operators check the values that they read.
    """

    # Names of the columns that detection reads, and the meaning of a row.
    _names: tuple[str, ...] = ()
    _row = "body"
    #: `checks` and `limits` of these columns, for `ops.first_invalid_rows`.
    _checks: tuple[list[int], list[float]] = ([], [])
    # For a column, the argument that it is computed from; and those arguments, which errors name first.
    _sources: Mapping[str, str] = {}
    _given: Mapping[str, Tensor] = {}
    # What a `state_dict` has in addition to the columns.
    _options: tuple[str, ...] = ()
    # Whether a position was given in float32, which may have rounded it.
    _is_of_float32 = False

    def __setattr__(self, name: str, value: Any) -> None:
        if name in self._names:
            former = getattr(self, name)
            if not isinstance(value, Tensor) or value.dtype != former.dtype:
                raise TypeError(f"{name}: expected a float64 tensor, got {arguments.describe(value)}")
            value = real_rows(value, name, former.shape[0], former.shape[1], former.device, with_gradient=True)
        super().__setattr__(name, value)

    @classmethod
    def _made_of(cls: type[_Self], **attributes: Any) -> _Self:
        """From columns that have been checked, or come from other motions."""
        motion = cls.__new__(cls)
        for name, value in attributes.items():
            object.__setattr__(motion, name, value)
        return motion

    def _with(self: _Self, **attributes: Any) -> _Self:
        """A copy with other columns, of any number of rows."""
        return self._made_of(**{**self.__dict__, **attributes})

    @property
    def device(self) -> torch.device:
        """The device of the columns."""
        return getattr(self, self._names[0]).device

    def _values(self) -> list[Tensor]:
        """The columns."""
        return [getattr(self, name) for name in self._names]

    def columns(self) -> dict[str, Tensor]:
        """The current columns that detection reads.

        Raises:
            ValueError: a column requires grad.
        """
        return dict(zip(self._names, self._plain(), strict=True))

    def _plain(self) -> list[Tensor]:
        """As `columns`, without names."""
        values = self._values()
        for place, column in enumerate(values):
            if column.requires_grad:
                name = self._names[place]
                arguments.refuse_gradient(column, self._sources.get(name, name))
                values[place] = column.detach()
        return values

    def _refuse_gradient(self) -> None:
        """Raises ValueError naming the first argument that requires grad while gradients are enabled."""
        self._plain()

    def _detached(self: _Self) -> _Self:
        """The motion without gradients; itself if it has none."""
        if not any_differentiated(*self._values()):
            return self
        return self._with(**{name: getattr(self, name).detach() for name in self._names})

    def _checked(self) -> list[Checked]:
        """The columns, with the meaning of their checks."""
        columns = dict(zip(self._names, self._values(), strict=True))
        return columns_checked(columns, self._row, self._sources, self._given)

    def check(self) -> None:
        """Raises ValueError naming the first row with a number that is not finite or too large, or a quaternion that is
        not unit.
        """
        first = ops.first_invalid_rows(self._plain(), *self._checks).tolist()
        if first[-1]:
            Validation(self._checked()).raise_from(first)

    def to(self: _Self, device: torch.device | str) -> _Self:
        """A copy on another device.

        Example:
            >>> motion = motion.to("cpu")
        """
        device = arguments.device(device)
        given = {name: column.to(device) for name, column in self._given.items()}
        return self._with(**{name: getattr(self, name).to(device) for name in self._names}, _given=given)

    def _rows(self: _Self, rows: Tensor | slice | Sequence[int], count: int) -> _Self:
        """Some of `count` rows."""
        picked = arguments.rows(rows, "rows", count)
        given = {name: column[picked] for name, column in self._given.items()}
        return self._with(**{name: getattr(self, name)[picked].contiguous() for name in self._names}, _given=given)

    def state_dict(self) -> dict[str, Any]:
        """The motion as a dictionary of tensors and names, without gradients, for `torch.save` and `torch.load` with
        weights_only=True.

        Example:
            >>> torch.save(motion.state_dict(), "motion.pt")
        """
        return {**self._detached().columns(), **{name: getattr(self, name) for name in self._options}}

    @classmethod
    def from_state_dict(cls: type[_Self], state: dict[str, Any]) -> _Self:
        """The motion of a `state_dict`, bit by bit, on the device of its tensors.

        Args:
            state: from `state_dict`.

        Raises:
            TypeError, ValueError: naming the entry that is missing or invalid.

        Example:
            >>> again = pgccd.RigidMotion.from_state_dict(motion.state_dict())
        """
        arguments.entries(state, (*cls._names, *cls._options))
        return cls._of_state(**state)

    @classmethod
    def _of_state(cls: type[_Self], **columns: Any) -> _Self:
        return cls(**columns)

    def _check_early(self: _Self, origins: Mapping[str, Tensor] | None = None) -> _Self:
        """The motion, with its values checked now on a CPU; a GPU is not waited for.

        Args:
            origins: arguments from which columns are computed; errors name these first.
        """
        if self.device.type != "cpu" or torch.compiler.is_compiling():
            return self
        columns = [column.detach() if column.requires_grad else column for column in self._values()]
        first = ops.first_invalid_rows(columns, *self._checks).tolist()
        if first[-1]:
            if origins:
                checked = columns_checked({name: column.detach() for name, column in origins.items()}, self._row)
                Validation(checked).raise_from(first_invalid_rows(checked).tolist())
            Validation(self._checked()).raise_from(first)
        return self
