"""The nanorobot world: its start, its steps, its response to contacts."""

from collections.abc import Sequence

from torch import Tensor

from pgccd.ops import library


def simulate_start(id: Tensor, integers: Sequence[int], scales: Sequence[float]) -> tuple[Tensor, ...]:
    """Position, orientation, velocity, angular velocity, target and stay of the robots `id` (N,) at the start."""
    return library.operators.simulate_start(id, list(integers), list(scales))


def simulate_plan(
    state: Sequence[Tensor], step: Tensor, integers: Sequence[int], scales: Sequence[float]
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Velocity, angular velocity, target and stay of robots for step number `step` (1,) int64, below 2^32."""
    return library.operators.simulate_plan(list(state), step, list(integers), list(scales))


def simulate_respond(state: Sequence[Tensor], fraction: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Position, orientation, velocity and angular velocity of robots that made `fraction` (N,) of a step."""
    return library.operators.simulate_respond(list(state), fraction)


def simulate_commit(state: Sequence[Tensor], planned: Sequence[Tensor], fraction: Tensor, discard: Tensor) -> None:
    """Moves robots, in place, by `fraction` (N,) of a step with these velocities, angular velocities, targets and
    stays; nothing is written if discard (1,) int64 is nonzero."""
    library.operators.simulate_commit(list(state), list(planned), fraction, discard)


def simulate_slow_all_down(
    first: Tensor, fraction: Tensor, changed: Tensor, changes: Tensor, approach: float, smallest: float
) -> None:
    """Slows robots down that are about to collide, in place: fraction (N,) of the step that each makes, given the first
    toi (N,) in it, inf for none; changed (N,) uint8, 1 for those that change; first becomes infinite; changes (1,)
    int64 becomes 1 if any changes."""
    library.operators.simulate_slow_all_down(first, fraction, changed, changes, approach, smallest)


def simulate_first_toi(first: Tensor, robots: Tensor | None, pairs: Tensor, toi: Tensor) -> None:
    """Lowers first (N,), in place, to the toi (K,) of contacts of pairs (K, 2) of robots, which may be padded with -1;
    or of copies of robots: robots (C,) are the rows they are copies of."""
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
    """The pairs (P, 2), perhaps padded with -1, with a robot whose `changed` (N + G,) uint8 is 1: (capacity, 2);
    mesh, position at t0 and t1, radius, orientation and rotation of their robots, two rows a pair, of which each makes
    `fraction` (N + G,) of its step; and counts (7,) as of `pairs_padded`. On a GPU in any order, and nothing waits;
    rows after the last are not set.

    own, ghosts: the first five columns of a state; rows of ghosts follow own ones. mesh_radius (M,): the robot with id
    k has mesh k modulo M.
    """
    return library.operators.simulate_affected_motion(
        list(own), list(ghosts), fraction, changed, pairs, mesh_radius, capacity
    )


def simulate_tally(state: Sequence[Tensor], fraction: Tensor, id: Tensor, pairs: Tensor, toi: Tensor) -> Tensor:
    """(6,) int64 of a step: robots, hash of contacts, hash of states, robots that stopped, contacts at its start, hash
    of ids. state: columns after it (N, ...), ids first; fraction (N,) of it that each made; contacts are of pairs
    (K, 2), which may be padded with -1, of robots with these id (H,)."""
    return library.operators.simulate_tally([column.contiguous() for column in state], fraction, id, pairs, toi)


def simulate_hash(columns: Sequence[Tensor]) -> Tensor:
    """(1,) int64: the sum modulo 2^64 of the rows' hashes; columns (N,) or (N, k), int64 or float64."""
    return library.operators.simulate_hash([column.contiguous() for column in columns])


def random_uniforms(id: Tensor, seed: int, step: int, stream: int) -> Tensor:
    """Numbers (N, 4) in (0, 1) of the counters (id, step, stream): Philox4x32-10, key `seed` (any int64)."""
    _check_counter_words(step=step, stream=stream)
    return library.operators.random_uniforms(id.contiguous(), seed, step, stream)


def _check_counter_words(**words: int) -> None:
    for name, word in words.items():
        if not 0 <= word < 2**32:
            raise ValueError(f"{name}: expected a value in [0, 2^32), got {word}")
