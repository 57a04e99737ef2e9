"""Which body stopped which."""

import torch
from torch import Tensor

_NOBODY = torch.iinfo(torch.int64).max


class StoppedBy:
    """For each body, the body whose contact lowered its fraction last; the smallest id of several at equal times.

    Args:
        body_count: number of bodies N.
        device: of the bodies.
    """

    def __init__(self, body_count: int, device: torch.device) -> None:
        #: (N,) int64: id; -1 for bodies that nothing stopped, its own for a body stopped by itself. Of several ranks
        #: that hold a body, those that did not find its contact have a larger number than any id.
        self.id = torch.full((body_count,), -1, dtype=torch.int64, device=device)
        # Those of the contacts of the current round; _NOBODY: none. The last row belongs to padding.
        self._next = torch.full((body_count + 1,), _NOBODY, dtype=torch.int64, device=device)

    def clear(self) -> None:
        """Nothing has been stopped."""
        self.id.fill_(-1)
        self._next.fill_(_NOBODY)

    def find(self, rows: Tensor, id: Tensor, toi: Tensor, first: Tensor) -> None:
        """Looks for the first contact of each body among those of a round.

        Args:
            rows, id, toi: (K, 2), (K, 2) and (K,) of the contacts; the rows of others' bodies and padding are -1.
            first: (N,) the first toi of each body, in this round.
        """
        count = len(self.id)
        toi_of_row = torch.cat([first, first.new_full((1,), -torch.inf)])
        for body, other in zip(rows.unbind(1), id.flip(1).unbind(1), strict=True):
            row = torch.where(body < 0, count, body)
            is_first = toi_of_row[row] == toi
            self._next.scatter_reduce_(0, torch.where(is_first, row, count), other, "amin")
        self._next[count:].fill_(_NOBODY)  # assigning a number copies it from the host, which a graph cannot

    def note(self, changed: Tensor) -> None:
        """Ends a round, which slowed down the bodies marked by (N,) uint8."""
        torch.where(changed != 0, self._next[:-1], self.id, out=self.id)
        self._next.fill_(_NOBODY)
