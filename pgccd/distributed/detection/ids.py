"""Rows of bodies by their global ids."""

from __future__ import annotations

import torch
from torch import Tensor


def rows_of(ids: Tensor, wanted: Tensor) -> Tensor:
    """Rows of the wanted ids (...) among the ids (N,), which ascend; -1 for others."""
    if not len(ids):
        return torch.full_like(wanted, -1)
    row = torch.searchsorted(ids, wanted.contiguous()).clamp_(max=len(ids) - 1)
    return torch.where(ids[row] == wanted, row, -1)
