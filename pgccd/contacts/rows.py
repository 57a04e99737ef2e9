"""Bundles of columns of equal length: results with a row for each contact, pair or path."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any, ClassVar, NoReturn, Self

import torch
from torch import Tensor

from pgccd import arguments

#: Of a column its dtype and further sizes.
Form = tuple[torch.dtype, tuple[int, ...]]


class Columns:
    """Base of dataclasses with columns."""

    _names: ClassVar[tuple[str, ...]] = ()

    @property
    def columns(self) -> dict[str, Tensor]:
        """The columns, by name."""
        return {name: getattr(self, name) for name in self._names}


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

    def to(self, device: torch.device | str) -> Self:
        """A copy on another device.

        Example:
            >>> hits = hits.to("cpu")
        """
        device = arguments.device(device)
        return self._map(lambda column: column.to(device))

    def clone(self) -> Self:
        """A copy of all columns.

        Example:
            >>> copied = hits.clone()
        """
        return self._map(Tensor.clone)

    def state_dict(self) -> dict[str, Any]:
        """The columns as a dictionary of tensors, without gradients, for `torch.save` and `torch.load` with
        weights_only=True.

        Example:
            >>> torch.save(hits.state_dict(), "hits.pt")
        """
        return {name: column.detach() for name, column in self.columns.items()}

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

    def _map(self, change: Callable[[Tensor], Tensor]) -> Self:
        columns: dict[str, Any] = {name: change(column) for name, column in self.columns.items()}
        return replace(self, **columns)  # type: ignore[type-var]
