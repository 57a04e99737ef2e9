"""Rows of columns: tensors of any dtype and width with as many rows each, of which only the bytes matter.

A row of -1 is zeros. Other row numbers must be those of rows: a CPU raises RuntimeError, a GPU's launch fails.
"""

from collections.abc import Sequence

from torch import Tensor

from pgccd.ops import library

Columns = Sequence[Tensor]


def pack_rows(columns: Columns, rows: Tensor) -> Tensor:
    """(K, bytes) uint8: the rows (K,) int64 of all columns side by side."""
    return library.operators.pack_rows(_contiguous(columns), rows.contiguous())


def unpack_rows(packed: Tensor, like: Columns) -> list[Tensor]:
    """The reverse of `pack_rows`, for columns of the same dtypes and widths as `like`, which may have any rows."""
    return library.operators.unpack_rows(packed.contiguous(), list(like))


def take_rows(columns: Columns, more: Columns, rows: Tensor) -> list[Tensor]:
    """The rows (K,) int64 of all columns (N, ...), as if those of `more` followed: the same in dtype and width, with
    any number of rows; or none at all."""
    return library.operators.take_rows(_contiguous(columns), _contiguous(more), rows.contiguous())


def merge_rows(columns: Columns, removed: Tensor, packed: Tensor) -> list[Tensor]:
    """Columns without the rows `removed` (L,) int64, ascending, and with those `packed` (A, bytes) as by `pack_rows`,
    by ascending id. columns[0]: the ids (N,) int64, ascending. Waits for nothing on a GPU.

    Rows added come in any order; their ids are distinct from those kept, but may be among those removed.
    """
    return library.operators.merge_rows(_contiguous(columns), removed.contiguous(), packed.contiguous())


def _contiguous(columns: Columns) -> list[Tensor]:
    return [column.contiguous() for column in columns]
