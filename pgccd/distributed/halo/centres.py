"""Swept spheres of held bodies."""

from __future__ import annotations

from torch import Tensor

from pgccd.detection.bodies import MovingBodies

#: SBV centres at t0 and t1 (N, 3) of bodies, and their reach (N,) about the straight path between these.
Centres = tuple[Tensor, Tensor, Tensor]


def centres_of(bodies: MovingBodies) -> Centres:
    """The swept spheres of moving bodies."""
    return bodies.centre_t0, bodies.centre_t1, bodies.reach
