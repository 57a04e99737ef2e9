"""Order-independent hashes of contacts and states, so that runs can be compared by their logs alone."""

from torch import Tensor

from pgccd.runtime.hashing import row_hash
from pgccd.sim.model import RobotState


def hashed_columns(state: RobotState) -> list[Tensor]:
    """The columns included in the hash of a state."""
    return [state.id, state.position, state.orientation, state.velocity, state.angular_velocity]


def contacts_hash(pairs: Tensor, toi: Tensor) -> int:
    """Hash over (i, j, toi bits) of all contacts.

    Args:
        pairs: (K, 2) int64 global ids; the order within a pair does not matter.
        toi: (K,) float64.

    Returns:
        An integer in [0, 2^64); 0 without contacts. Hashes of disjoint sets of contacts add up modulo 2^64.

    Example:
        >>> f"{pgccd.sim.contacts_hash(hits.pairs, hits.toi):016x}"
    """
    return row_hash([pairs.amin(dim=1), pairs.amax(dim=1), toi])


def state_hash(state: RobotState) -> int:
    """Hash over (id, pose, velocity bits) of all robots, as `contacts_hash`.

    Example:
        >>> f"{pgccd.sim.state_hash(state):016x}"
    """
    return row_hash(hashed_columns(state))
