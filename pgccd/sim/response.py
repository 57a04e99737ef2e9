"""Response of robots to a collision: stop and reverse (the simple response of Du, Liu & Suzumura 2017)."""

import torch
from torch import Tensor

from pgccd import ops
from pgccd.sim.model import RobotState


def first_collisions(pairs: Tensor, toi: Tensor, body_count: int) -> Tensor:
    """The first toi of each body.

    Args:
        pairs: (K, 2) int64 body rows.
        toi: (K,) float64 in [0, 1].
        body_count: number of bodies N.

    Returns:
        (N,) float64; inf without a contact.

    Example:
        >>> toi = pgccd.sim.first_collisions(hits.pairs, hits.toi, scene.body_count)
    """
    first = torch.full((body_count,), torch.inf, dtype=torch.float64, device=toi.device)
    return first.scatter_reduce_(0, pairs.reshape(-1), toi[:, None].expand(-1, 2).reshape(-1), "amin")


def respond(state: RobotState, fraction: Tensor) -> RobotState:
    """The state after each robot moved by `fraction` of the step; robots with a fraction below 1 reverse.

    Args:
        state: as planned, before the step.
        fraction: (N,) float64 in [0, 1].

    Example:
        >>> state = pgccd.sim.respond(state, resolved.fraction)
    """
    moved = ops.simulate_respond(list(state.columns.values()), fraction)
    return RobotState(state.id, *moved, state.target, state.stay_until)
