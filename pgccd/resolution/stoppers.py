"""Which body stopped which."""

import torch
from torch import Tensor

_NOBODY = torch.iinfo(torch.int64).max


class Stoppers:
    """For each body, the one whose contact lowered its fraction last; of several at equal times the smallest index.

    Args:
        body_count: number of bodies N.
        device: of the bodies.
    """

    def __init__(self, body_count: int, device: torch.device) -> None:
        #: (N,) int64: -1 for bodies that nothing stopped, i for a body stopped by itself.
        self.by = torch.full((body_count,), -1, dtype=torch.int64, device=device)
        # Those of the contacts of the current round; _NOBODY: none. The last row belongs to padding.
        self._next = torch.full((body_count + 1,), _NOBODY, dtype=torch.int64, device=device)

    def clear(self) -> None:
        """Nothing has been stopped."""
        self.by.fill_(-1)
        self._next.fill_(_NOBODY)

    def find(self, pairs: Tensor, toi: Tensor, first: Tensor) -> None:
        """Looks for the first contact of each body among those of a round.

        Args:
            pairs, toi: (K, 2) and (K,) of the contacts; padding has pairs of -1.
            first: (N,) the first toi of each body, in this round.
        """
        for body, other in (pairs.unbind(1), pairs.flip(1).unbind(1)):
            self.find_of(body, other, toi, first)

    def find_of(self, body: Tensor, other: Tensor, toi: Tensor, first: Tensor) -> None:
        """The same for one body of each contact.

        Args:
            body, other: (K,) its row, -1 for none; and the index of the other body, which may be counted differently.
            toi, first: as for `find`.
        """
        count = len(self.by)
        row = torch.where(body < 0, count, body)
        is_first = torch.cat([first, first.new_full((1,), -torch.inf)])[row] == toi
        self._next.scatter_reduce_(0, torch.where(is_first, row, count), other, "amin")
        self._next[count:].fill_(_NOBODY)  # assigning a number copies it from the host, which a graph cannot

    def note(self, changed: Tensor) -> None:
        """Ends a round, which slowed down the bodies marked by (N,) uint8."""
        torch.where(changed != 0, self._next[:-1], self.by, out=self.by)
        self._next.fill_(_NOBODY)
