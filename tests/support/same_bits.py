"""Comparison of contacts in all columns, bit by bit."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

import pgccd
from pgccd.runtime.hashing import row_hash
from pgccd.search import narrow

COLUMNS = ("pairs", "toi", "kind", "features", "coordinates", "point", "normal", "status")


Result = pgccd.Contacts | pgccd.CollidingPairs


def columns_of(result: Result) -> dict[str, Tensor]:
    """The columns, on the CPU."""
    return {name: column.cpu() for name, column in result.columns.items()}


def bits(column: Tensor) -> Tensor:
    """The column, with floating-point numbers as integers: zeros of both signs differ."""
    if not column.is_floating_point():
        return column
    return column.view(torch.int64 if column.dtype == torch.float64 else torch.int32)


def difference(found: dict[str, Tensor], expected: dict[str, Tensor]) -> str | None:
    """The rows in which two sets of columns differ, in words; None if all bits are equal."""
    if found.keys() != expected.keys():
        return f"columns {sorted(found)}, expected {sorted(expected)}"
    said = []
    for name, column in expected.items():
        got = found[name]
        if got.shape != column.shape or got.dtype != column.dtype:
            return f"{name}: {got.dtype} {tuple(got.shape)}, expected {column.dtype} {tuple(column.shape)}"
        differs = (bits(got) != bits(column)).view(-1, column[:1].numel() or 1).any(dim=1)
        if differs.any():
            row = int(differs.nonzero()[0])
            keys = [key for key in ("pairs", "kind", "features", "toi") if key in expected and key != name]
            where = "".join(f", {key} {expected[key][row].tolist()}" for key in keys)
            said.append(
                f"{name}: {int(differs.sum())} of {len(differs)} rows, first {row}{where}: {got[row].tolist()}, "
                f"expected {column[row].tolist()}"
            )
    return "; ".join(said) or None


def first_rows(every: pgccd.Contacts, report: narrow.Report) -> torch.Tensor:
    """Rows of the first contact of each pair, or of the earliest one, among all."""
    assert every.toi is not None
    pairs, toi = every.pairs.cpu().numpy(), every.toi.cpu().numpy()
    # All contacts of a pair are sorted by kind and features.
    order = np.lexsort((np.arange(len(toi)), toi, pairs[:, 1], pairs[:, 0]))
    is_first = np.ones(len(order), bool)
    is_first[1:] = (np.diff(pairs[order], axis=0) != 0).any(axis=1)
    rows = np.sort(order[is_first])
    if report == "earliest":
        rows = rows[np.argmin(toi[rows])][None] if len(rows) else rows
    return torch.from_numpy(rows).to(every.pairs.device)


def contacts_hash(contacts: pgccd.Contacts, rows: Tensor) -> int:
    """Hash of all columns of some of the contacts, of any report but "any". Hashes of disjoint rows add up mod 2^64."""
    columns = [getattr(contacts, name)[rows] for name in COLUMNS]
    return row_hash([column if column.is_floating_point() else column.long() for column in columns])


def assert_same(found: Result, expected: Result) -> None:
    """Asserts equal bits in all columns."""
    said = difference(columns_of(found), columns_of(expected))
    assert said is None, said
