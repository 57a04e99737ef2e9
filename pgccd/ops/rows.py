"""Rows of columns: tensors of any dtype and width with equal numbers of rows, processed as bytes.

Row number -1 stands for a row of zeros. Other row numbers must be in range: a CPU raises RuntimeError, on a GPU the
kernel asserts.
"""

from collections.abc import Sequence

from torch import Tensor

from pgccd.ops import library

Columns = Sequence[Tensor]


def pack_rows(columns: Columns, rows: Tensor) -> Tensor:
    """(K, bytes) uint8: the rows (K,) int64 of all columns side by side."""
    return library.operators.pack_rows(_contiguous(columns), rows.contiguous())


def unpack_rows(packed: Tensor, like: Columns) -> list[Tensor]:
    """The inverse of `pack_rows`; dtypes and widths are those of `like`, which may have any number of rows."""
    return library.operators.unpack_rows(packed.contiguous(), list(like))


def take_rows(columns: Columns, more: Columns, rows: Tensor) -> list[Tensor]:
    """The rows (K,) int64 of all columns (N, ...), numbered as if `more` were appended to them. `more` has the same
    dtypes and widths and any number of rows, or is empty.
    """
    return library.operators.take_rows(_contiguous(columns), _contiguous(more), rows.contiguous())


def merge_rows(columns: Columns, removed: Tensor, packed: Tensor) -> list[Tensor]:
    """Removes the rows `removed` (L,) int64, ascending, and inserts rows `packed` (A, bytes) by `pack_rows`, in
    ascending order of id. columns[0]: the ids (N,) int64, ascending. Does not synchronise.

    Inserted rows may be in any order; their ids differ from those kept, but may equal removed ones.
    """
    return library.operators.merge_rows(_contiguous(columns), removed.contiguous(), packed.contiguous())


def _contiguous(columns: Columns) -> list[Tensor]:
    return [column.contiguous() for column in columns]
