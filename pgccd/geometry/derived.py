"""Values derived from a column that may be written at any time."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor


@dataclass
class Derived:
    """A value derived from a column, with what is needed to see that the column has changed: on a CPU a copy of it,
    since memory shared with NumPy may be written without torch; on a GPU, which must not be waited for, torch's counter
    of writes.
    """

    column: Tensor
    value: Any
    seen: Tensor | int | None = None

    def __post_init__(self) -> None:
        if not torch.compiler.is_compiling():
            self.seen = self.column.clone() if self.column.device.type == "cpu" else _version(self.column)

    def is_of(self, column: Tensor) -> bool:
        """Whether the value was derived from the present values of this column."""
        if torch.compiler.is_compiling():  # values are not available
            return self.column is column
        if isinstance(self.seen, Tensor):
            alike = self.seen.device == column.device and self.seen.dtype == column.dtype
            return alike and torch.equal(self.seen, column)
        return self.column is column and self.seen == _version(column) is not None


def _version(column: Tensor) -> int | None:
    """Counter of in-place writes to the column; None where torch does not track it."""
    return None if torch.compiler.is_compiling() or column.is_inference() else column._version
