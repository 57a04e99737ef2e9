"""Where bodies are that a rank holds."""

from __future__ import annotations

from torch import Tensor

from pgccd.detection.bodies import MovingBodies

#: SBV centres at t0 and t1 (N, 3) of bodies, and how far they reach from the way between these (N,).
Centres = tuple[Tensor, Tensor, Tensor]


def centres_of(bodies: MovingBodies) -> Centres:
    """Of moving bodies."""
    return bodies.centre_t0, bodies.centre_t1, bodies.reach
