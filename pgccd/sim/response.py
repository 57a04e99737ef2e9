"""What robots do about a collision: the simple response of Du, Liu & Suzumura 2017, section 5."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from pgccd import ops
from pgccd.sim.world import RobotState


def first_collisions(pairs: Tensor, toi: Tensor, body_count: int) -> Tensor:
    """The first toi of each body.

    Args:
        pairs: (K, 2) int64 body rows.
        toi: (K,) float64 in [0, 1]. Pairs that touch at t0 already (toi = 0) do not count: stopping them, step after step, would
            hold them together for ever.
        body_count: number of bodies N.

    Returns:
        (N,) float64; inf for bodies that do not collide.

    Example:
        >>> toi = pgccd.sim.first_collisions(hits.pairs, hits.toi, scene.body_count)
    """
    later = torch.where(toi > 0.0, toi, torch.inf)
    first = torch.full((body_count,), torch.inf, dtype=torch.float64, device=toi.device)
    return first.scatter_reduce_(0, pairs.reshape(-1), later.repeat_interleave(2), "amin")


def respond(state: RobotState, toi: Tensor) -> RobotState:
    """The state after the step: a robot stops at its first toi and its velocities turn round; without one it moves on to t1.

    A stopped robot is not tested again against the rest of the step of the others, so a few may overlap afterwards; they
    are reported with toi = 0 and drift through each other.

    Args:
        state: as planned, before the step.
        toi: (N,) float64, first collisions; > 1 for none.

    Example:
        >>> state = pgccd.sim.respond(state, toi)
    """
    position, orientation, velocity, angular_velocity = ops.simulate_respond(list(state.columns.values()), toi)
    return replace(
        state, position=position, orientation=orientation, velocity=velocity, angular_velocity=angular_velocity
    )
