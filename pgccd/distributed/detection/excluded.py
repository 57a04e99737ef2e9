"""Pairs of bodies of a `World` that are never tested, by global ids. Every rank holds all of them."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from pgccd.distributed.detection.ids import rows_of
from pgccd.search.broad import select_rows


@dataclass(frozen=True, eq=False)
class Excluded:
    """A set of pairs of ids.

    Attributes:
        pairs: (E, 2) int64, i < j, sorted, each once; E > 0.
        ids: (U,) int64: those that occur, ascending.
        keys: (E,) int64, ascending: numbers of the pairs, by the places of both ids.
        period: ids of a segment, where those of copies of bodies follow one another (`Segments`); 0 without copies.
    """

    pairs: Tensor
    ids: Tensor
    keys: Tensor
    period: int = 0

    @classmethod
    def of(cls, pairs: Tensor | None) -> Excluded | None:
        """The set of pairs (E, 2); None if there is none."""
        if pairs is None or not len(pairs):
            return None
        ids = pairs.unique()
        low, high = torch.searchsorted(ids, pairs).unbind(1)
        return cls(pairs, ids, low * len(ids) + high)

    def in_segments(self, period: int) -> Excluded:
        """The same pairs in each segment of so many ids."""
        return replace(self, period=period)

    def leave_out(self, id: Tensor, pairs: Tensor) -> tuple[Tensor, Tensor]:
        """Selects the pairs that are not in the set, see `select_rows`.

        Args:
            id: (N,) int64: global ids of the rows.
            pairs: (P, 2) int64 rows; -1 for no pair.
        """
        of = torch.cat([id, id.new_full((1,), -1)])[pairs]
        of = of.remainder(self.period) if self.period else of
        of = torch.stack([of.amin(dim=1), of.amax(dim=1)], dim=1)
        place = rows_of(self.ids, of)
        key = place[:, 0] * len(self.ids) + place[:, 1]
        is_excluded = (place >= 0).all(dim=1) & (rows_of(self.keys, key) >= 0)
        return select_rows(pairs, ~is_excluded & (pairs[:, 0] >= 0))
