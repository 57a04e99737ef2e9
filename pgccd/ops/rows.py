"""Rows of columns: tensors of any dtype and width with equal numbers of rows, processed as bytes.

Row number -1 stands for a row of zeros. Other row numbers must be in range: a CPU raises RuntimeError, on a GPU the
kernel asserts.
"""

from collections.abc import Sequence
from math import prod

import torch
from torch import Tensor

from pgccd.ops.library import on_contiguous, operator

Columns = Sequence[Tensor]


@on_contiguous
@operator
def pack_rows(columns: Columns, rows: Tensor) -> Tensor:
    """(K, bytes) uint8: the rows (K,) int64 of all columns side by side."""
    size = sum(prod(column.shape[1:]) * column.element_size() for column in columns)
    return rows.new_empty((rows.shape[0], size), dtype=torch.uint8)


@on_contiguous
@operator
def unpack_rows(packed: Tensor, like: Columns) -> list[Tensor]:
    """The inverse of `pack_rows`; dtypes and widths are those of `like`, which may have any number of rows."""
    return _of_length(like, packed.shape[0])


@on_contiguous
@operator
def take_rows(columns: Columns, more: Columns, rows: Tensor) -> list[Tensor]:
    """The rows (K,) int64 of all columns (N, ...), numbered as if `more` were appended to them. `more` has the same
    dtypes and widths and any number of rows, or is empty.
    """
    return _of_length(columns, rows.shape[0])


@operator
def commit_rows(columns: Columns, values: Columns, id: Tensor, discard: Tensor) -> None:
    """Overwrites the columns (N, ...) in place with `values` of equal dtypes and widths, in the rows with an `id` (N,)
    >= 0; none if `discard` (1,) int64 is not 0. No value may share memory with a column.
    """


@on_contiguous
@operator
def merge_rows(columns: Columns, removed: Tensor, packed: Tensor) -> list[Tensor]:
    """Removes the rows `removed` (L,) int64, ascending, and inserts rows `packed` (A, bytes) by `pack_rows`, in
    ascending order of id. columns[0]: the ids (N,) int64, ascending. Does not synchronise.

    Inserted rows may be in any order; their ids differ from those kept, but may equal removed ones.
    """
    return _of_length(columns, columns[0].shape[0] - removed.shape[0] + packed.shape[0])


def _of_length(columns: Columns, count: int) -> list[Tensor]:
    return [column.new_empty((count, *column.shape[1:])) for column in columns]
