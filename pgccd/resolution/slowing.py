"""The rule of resolution: by how much a body in contact is slowed down."""

import torch
from torch import Tensor

from pgccd import ops

# A body moves by this fraction of its toi: at the toi itself it may be within the tolerance of contact, which the next
# step would report again.
_APPROACH = 0.99
# A body that could only move by less than this part of its step does not move. Otherwise the gap between bodies
# pressed together (by a wall or a crowd) would shrink by the same factor in every step, until rounding closed it.
_SMALLEST_PART = 0.01
#: From this round on a colliding body does not move at all, which ends the iteration quickly.
STOPPING_ROUND = 4


class SlowedBodies:
    """The part of the step that each body moves, lowered from round to round.

    Args:
        body_count: number of bodies N.
        device: of the bodies.
        fixed: (N,) bool: bodies that move by their whole step, whatever they meet; default: none.
        stopping_round: from this round on a colliding body does not move at all.
    """

    def __init__(
        self,
        body_count: int,
        device: torch.device,
        fixed: Tensor | None = None,
        stopping_round: int = STOPPING_ROUND,
    ) -> None:
        #: (N,) float64: the part of the step that each body moves.
        self.fraction = torch.ones(body_count, dtype=torch.float64, device=device)
        #: (N,) float64: the first toi in the round, relative to that part; inf for none. Lowered by the search.
        self.first = torch.full_like(self.fraction, torch.inf)
        #: (N,) uint8: bodies that the last round slowed down.
        self.changed = torch.ones(body_count, dtype=torch.uint8, device=device)
        self._fixed, self._stopping_round = fixed, stopping_round

    def slow_down(self, round: int, change: Tensor) -> None:
        """Slows down the bodies that have a `first` toi, which is reset, and sets `change` (1,) int64 to nonzero if
        there are any.

        Args:
            round: 0 after the search of the whole step. Every round slows at least one body, and from the stopping
                round on stops it at t0, so rounds end.
        """
        if self._fixed is not None:
            self.first.masked_fill_(self._fixed, torch.inf)
        smallest = _SMALLEST_PART if round < self._stopping_round else torch.inf
        ops.resolve_slow_down(self.first, self.fraction, self.changed, change, _APPROACH, smallest)
