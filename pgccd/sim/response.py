"""Response of robots to a collision: stop and reverse (the simple response of Du, Liu & Suzumura 2017)."""

from torch import Tensor

from pgccd import ops
from pgccd.sim.model import RobotState


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
