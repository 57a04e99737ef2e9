"""Bundles of columns of equal length: results with a row for each contact, pair or path."""

from __future__ import annotations

import copy
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any, ClassVar, NoReturn, Self

import torch
from torch import Tensor

from pgccd import arguments

#: The dtype and the further sizes of a column.
Form = tuple[torch.dtype, tuple[int, ...]]


class Columns:
    """Base of dataclasses with columns. Equal (`==`) if all columns are, bit by bit."""

    _names: ClassVar[tuple[str, ...]] = ()
    # Attributes, or lists, that have columns of their own.
    _parts: ClassVar[tuple[str, ...]] = ()

    @property
    def columns(self) -> dict[str, Tensor]:
        """The columns, by name."""
        return {name: getattr(self, name) for name in self._names}

    def __eq__(self, other: object) -> bool:
        if type(other) is not type(self):
            return NotImplemented
        return have_equal_bits(self.columns, other.columns)

    __hash__ = None  # type: ignore[assignment]

    def to(self, device: torch.device | str) -> Self:
        """A copy on another device.

        Example:
            >>> hits = hits.to("cpu")
        """
        device = arguments.device(device)
        return self._with_parts(self._map(lambda column: column.to(device)), lambda part: part.to(device))

    def clone(self) -> Self:
        """A copy of all columns.

        Example:
            >>> copied = hits.clone()
        """
        return self._with_parts(self._map(Tensor.clone), copy.deepcopy)

    def _with_parts(self, copied: Self, change: Callable[[Any], Any]) -> Self:
        """`copied` with copies of `_parts`."""
        parts = {name: getattr(self, name) for name in self._parts}
        parts = {name: [*map(change, part)] if isinstance(part, list) else change(part) for name, part in parts.items()}
        return replace(copied, **parts) if parts else copied  # type: ignore[type-var]

    def _map(self, change: Callable[[Tensor], Tensor]) -> Self:
        columns: dict[str, Any] = {name: change(column) for name, column in self.columns.items()}
        return replace(self, **columns)  # type: ignore[type-var]


class Rows(Columns):
    """Base of dataclasses whose columns have a row each, of any number."""

    # By name of a column.
    _forms: ClassVar[Mapping[str, Form]] = {}

    def __len__(self) -> int:
        return len(getattr(self, self._names[0]))

    def __iter__(self) -> NoReturn:
        columns = "pairs.tolist()" if "pairs" in self._names else f"{self._names[0]}.tolist()"
        columns = f"zip(hits.{columns}, hits.toi.tolist())" if "toi" in self._names else f"hits.{columns}"
        raise TypeError(
            f"{type(self).__name__}: not iterable: loop over columns, such as {columns}, or over single rows, "
            "hits[k : k + 1]"
        )

    def __getitem__(self, rows: Tensor | slice | Sequence[int]) -> Self:
        """Some of the rows: a mask (K,), row numbers or a slice. `stats` and others remain those of the whole call.

        Example:
            >>> early = hits[hits.toi < 0.5]
        """
        if isinstance(rows, int) and not isinstance(rows, bool):
            raise TypeError(f"rows: expected a mask, row numbers or a slice, got {rows}: write hits[[{rows}]]")
        picked = arguments.rows(rows, "rows", len(self))
        return self._map(lambda column: column[picked])

    @classmethod
    def cat(cls, results: Sequence[Self]) -> Self:
        """The rows of several results of the same bodies, one after the other. Statistics are added up.

        Raises:
            TypeError, ValueError: no result is given; or, naming it, a result is not of this kind, or is of other
                bodies.

        Example:
            >>> both = pgccd.Contacts.cat([hits[:1], hits[1:]])
        """
        if not isinstance(results, Sequence) or not results:
            raise ValueError(f"results: expected at least one in a list, got {arguments.describe(results)}")
        for k, each in enumerate(results):
            if type(each) is not type(results[0]) or not isinstance(each, cls):
                raise TypeError(f"results[{k}]: expected {type(results[0]).__name__}, got {arguments.describe(each)}")
            if (device := getattr(each, cls._names[0]).device) != getattr(results[0], cls._names[0]).device:
                raise ValueError(f"results[{k}]: is on {device}, the first one is not")
        return results[0]._followed_by(results[1:])

    def state_dict(self) -> dict[str, Any]:
        """The columns as a dictionary of tensors, without gradients, for `torch.save` and `torch.load` with
        weights_only=True.

        Example:
            >>> torch.save(hits.state_dict(), "hits.pt")
        """
        return {name: column.detach() for name, column in self.columns.items()}

    @classmethod
    def from_state_dict(cls, state: dict[str, Any]) -> Self:
        """The result of a `state_dict`, on the device of its tensors.

        Args:
            state: from `state_dict`.

        Raises:
            TypeError, ValueError: naming the entry that is missing or invalid.

        Example:
            >>> again = pgccd.Contacts.from_state_dict(hits.state_dict())
        """
        return cls(**cls._columns_of(state))

    @classmethod
    def _columns_of(cls, state: Mapping[str, Any], *more: str) -> dict[str, Any]:
        """The columns of a `state_dict` with these further entries.

        Raises:
            TypeError, ValueError: naming the entry that is missing or invalid.
        """
        arguments.entries(state, (*cls._names, *more))
        count, device = None, None
        for name in cls._names:
            column, (dtype, width) = state[name], cls._forms[name]
            if not isinstance(column, Tensor) or column.dtype != dtype:
                raise TypeError(f"{name}: expected {dtype}, got {arguments.describe(column)}")
            device = column.device if device is None else device
            arguments.shape(column, name, ("K" if count is None else count, *width), device)
            count = len(column)
        return {name: state[name] for name in cls._names}

    def _followed_by(self, others: Sequence[Self]) -> Self:
        """`cat`, of results that have been checked."""
        columns: dict[str, Any] = {
            name: torch.cat([column, *(getattr(each, name) for each in others)])
            for name, column in self.columns.items()
        }
        return replace(self, **columns)  # type: ignore[type-var]


def have_equal_bits(first: Mapping[str, Tensor], second: Mapping[str, Tensor]) -> bool:
    """Whether two sets of columns are equal, bit by bit. Not all dtypes can be compared by value."""

    def bits(column: Tensor) -> Tensor:
        return column.detach().contiguous().flatten().view(torch.uint8)

    return first.keys() == second.keys() and all(
        column.shape == second[name].shape
        and column.dtype == second[name].dtype
        and column.device == second[name].device
        and torch.equal(bits(column), bits(second[name]))
        for name, column in first.items()
    )
