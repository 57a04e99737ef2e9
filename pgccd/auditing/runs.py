"""Runs of consecutive frames."""

from __future__ import annotations

from dataclasses import dataclass, field

import torch
from torch import Tensor


@dataclass
class Runs:
    """Runs of frames at which pairs touch, found window by window. Memory is proportional to the number of runs.

    Runs are rows (R, 4): pair i and j, first and last frame.
    """

    _closed: list[Tensor] = field(default_factory=list)  # end before the frames that are added next
    _open: Tensor | None = None

    def add(self, pairs: Tensor, frame: Tensor, first: int) -> None:
        """Adds pairs (K, 2) that touch at frames (K,), none of which lies before frame `first` or an earlier call's."""
        rows = torch.cat([pairs, frame[:, None], frame[:, None]], dim=1)
        if self._open is not None:
            is_over = self._open[:, 3] < first - 1
            self._closed.append(self._open[is_over])
            rows = torch.cat([self._open[~is_over], rows])
        self._open = _merged(rows)

    def conclude(self, device: torch.device) -> tuple[Tensor, Tensor, Tensor]:
        """Pairs (R, 2), first and last frames (R,), sorted."""
        none = torch.zeros((0, 4), dtype=torch.int64, device=device)
        rows = torch.cat([*self._closed, none if self._open is None else self._open])
        rows = torch.unique(rows, dim=0) if len(rows) else rows
        return rows[:, :2].contiguous(), rows[:, 2].contiguous(), rows[:, 3].contiguous()


def _merged(rows: Tensor) -> Tensor:
    """Runs (R, 4) with those of a pair joined that overlap or follow one another. None lies within another one."""
    if not len(rows):
        return rows
    rows = torch.unique(rows, dim=0)
    follows = (rows[1:, :2] == rows[:-1, :2]).all(dim=1) & (rows[1:, 2] <= rows[:-1, 3] + 1)
    begins = torch.cat([torch.ones_like(follows[:1]), ~follows]) if len(rows) > 1 else follows.new_ones(1)
    ends = torch.cat([begins[1:], begins.new_ones(1)])
    return torch.cat([rows[begins, :3], rows[ends, 3:]], dim=1)
