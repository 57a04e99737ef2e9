"""Contacts along a trajectory."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor

from pgccd.contacts.by_body import By
from pgccd.contacts.contacts import COLUMNS, Contacts


@dataclass(eq=False, kw_only=True, repr=False)
class TrajectoryContacts(Contacts):
    """Contacts along a trajectory.

    With report="all", sorted by segment, pair, kind and features. With "first" one row per pair: the one with the
    smallest segment, toi, kind and features.

    Attributes:
        segment: (K,) int64: from waypoint `segment` to the next.
        toi: (K,) float64 in [0, 1], within the segment.
        time: (K,) float64 in [0, 1] along the whole trajectory: (segment + toi) / (T - 1), rounded down.
        pairs, kind, features, coordinates, point, normal, status, stats, payload: as of `Contacts`.
    """

    segment: Tensor
    time: Tensor

    _names: ClassVar[tuple[str, ...]] = (*COLUMNS, "segment", "time")

    @property
    def _order(self) -> tuple[Tensor, ...]:
        return self.segment, self.toi

    def first_toi(self, by: By = "scene") -> Tensor:
        """The first `time` along the whole trajectory: in [0, 1], float64, inf without a contact.

        Args:
            by: "scene" (), "world" (W,) or "body" (N,): see `Contacts.first_toi`.

        Raises:
            ValueError: `by` is unknown or needs a scene; or these are the contacts of one of several ranks.
        """
        self._require_all_ranks()
        return self._first_time(self.time, by)


def time_along(segment: Tensor, toi: Tensor, segments: int) -> Tensor:
    """(K,) float64: times in [0, 1] along a trajectory of `segments` segments, from times within a segment. They are
    never later than the exact times, so both operations are corrected where they have rounded up.

    The divisor is a tensor, because torch divides by a Python number on CUDA by multiplying with its reciprocal, which
    rounds differently.
    """
    count = torch.full((), segments, dtype=torch.float64, device=toi.device)
    begin, zero = segment.to(torch.float64), torch.zeros((), dtype=torch.float64, device=toi.device)
    total = begin + toi
    # Exact, since `begin` is 0 or not less than `toi` (Dekker 1971): negative where the sum is too large.
    total = torch.where(toi - (total - begin) < 0.0, torch.nextafter(total, zero), total)
    time = total / count
    # The remainder is exact: products of 26 bits, by Veltkamp's splitting, and numbers of up to 27 bits.
    large = time * 134217729.0  # 2^27 + 1
    high = large - (large - time)
    remainder = (total - high * count) - (time - high) * count
    return torch.where(remainder < 0.0, torch.nextafter(time, zero), time)
