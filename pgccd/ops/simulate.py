"""Operators of the nanorobot simulation: start, plan, response, hashes."""

from collections.abc import Sequence

from torch import Tensor

from pgccd.ops import library


def simulate_start(id: Tensor, integers: Sequence[int], scales: Sequence[float]) -> tuple[Tensor, ...]:
    """Initial position, orientation, velocity, angular velocity, target and stay of the robots `id` (N,)."""
    return library.operators.simulate_start(id, list(integers), list(scales))


def simulate_plan(
    state: Sequence[Tensor], step: Tensor, integers: Sequence[int], scales: Sequence[float]
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Velocity, angular velocity, target and stay of robots for step number `step` (1,) int64, below 2^32."""
    return library.operators.simulate_plan(list(state), step, list(integers), list(scales))


def simulate_respond(state: Sequence[Tensor], fraction: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Position, orientation, velocity and angular velocity of robots that moved by `fraction` (N,) of a step."""
    return library.operators.simulate_respond(list(state), fraction)


def simulate_commit(state: Sequence[Tensor], planned: Sequence[Tensor], fraction: Tensor, discard: Tensor) -> None:
    """Moves robots in place by `fraction` (N,) of a step, with the planned velocities, angular velocities, targets and
    stays; no effect if discard (1,) int64 is nonzero.
    """
    library.operators.simulate_commit(list(state), list(planned), fraction, discard)


def simulate_slow_all_down(
    first: Tensor, fraction: Tensor, changed: Tensor, changes: Tensor, approach: float, smallest: float
) -> None:
    """Slows down robots that are about to collide, in place. fraction (N,): the part of the step that each robot moves,
    lowered according to its first toi (N,), inf for none; changed (N,) uint8: set to 1 for robots whose fraction
    changed; first: reset to inf; changes (1,) int64: set to 1 if any changed.
    """
    library.operators.simulate_slow_all_down(first, fraction, changed, changes, approach, smallest)


def simulate_first_toi(first: Tensor, robots: Tensor | None, pairs: Tensor, toi: Tensor) -> None:
    """Lowers first (N,) in place to the toi (K,) of contacts of pairs (K, 2), which may be padded with -1. If robots
    (C,) is given, pairs index copies, and `robots` their rows in `first`.
    """
    library.operators.simulate_first_toi(first, robots, pairs, toi)


def simulate_affected_motion(
    own: Sequence[Tensor],
    ghosts: Sequence[Tensor],
    fraction: Tensor,
    changed: Tensor,
    pairs: Tensor,
    mesh_radius: Tensor,
    capacity: int,
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor]:
    """The pairs (capacity, 2), out of (P, 2) padded with -1, with a robot whose `changed` (N + G,) uint8 is 1; mesh,
    position at t0 and t1, radius, orientation and rotation of their robots, two rows per pair, each for `fraction` (N +
    G,) of its step; and counts (7,) as of `pairs_padded`. On a GPU the order is not specified, and the call does not
    synchronise; unused rows are not set.

    own, ghosts: the first five columns of a state; rows of ghosts follow those of own robots. mesh_radius (M,): the
    robot with id k has mesh k modulo M.
    """
    return library.operators.simulate_affected_motion(
        list(own), list(ghosts), fraction, changed, pairs, mesh_radius, capacity
    )


def simulate_tally(state: Sequence[Tensor], fraction: Tensor, id: Tensor, pairs: Tensor, toi: Tensor) -> Tensor:
    """(6,) int64 of a step: number of robots, hash of contacts, hash of states, number of robots that stopped, number
    of contacts at its start, hash of ids. state: columns after the step (N, ...), ids first; fraction (N,): the part of
    the step that each robot moved; pairs (K, 2): of the contacts, may be padded with -1, rows of the ids (H,).
    """
    return library.operators.simulate_tally([column.contiguous() for column in state], fraction, id, pairs, toi)


def simulate_hash(columns: Sequence[Tensor]) -> Tensor:
    """(1,) int64: sum modulo 2^64 of the rows' hashes; columns (N,) or (N, k), int64 or float64."""
    return library.operators.simulate_hash([column.contiguous() for column in columns])


def random_uniforms(id: Tensor, seed: int, step: int, stream: int) -> Tensor:
    """Random numbers (N, 4) in (0, 1) of the counters (id, step, stream): Philox4x32-10 (Salmon et al. 2011), key
    `seed` (any int64).
    """
    _check_counter_words(step=step, stream=stream)
    return library.operators.random_uniforms(id.contiguous(), seed, step, stream)


def _check_counter_words(**words: int) -> None:
    for name, word in words.items():
        if not 0 <= word < 2**32:
            raise ValueError(f"{name}: expected a value in [0, 2^32), got {word}")
