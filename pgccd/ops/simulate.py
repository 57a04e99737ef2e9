"""Operators of the nanorobot simulation: start, plan, response, hashes."""

from collections.abc import Sequence

from torch import Tensor

from pgccd.ops.library import float64, int64, on_contiguous, operator


@operator
def simulate_start(id: Tensor, integers: Sequence[int], scales: Sequence[float]) -> tuple[Tensor, ...]:
    """Initial position, orientation, velocity, angular velocity, target and stay of the robots `id` (N,)."""
    count = id.shape[0]
    poses = float64(id, count, 3), float64(id, count, 4), float64(id, count, 3), float64(id, count, 3)
    return *poses, int64(id, count), int64(id, count)


@operator
def simulate_plan(
    state: Sequence[Tensor], step: Tensor, integers: Sequence[int], scales: Sequence[float]
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Velocity, angular velocity, target and stay of robots for step number `step` (1,) int64, below 2^32."""
    count = state[0].shape[0]
    return float64(step, count, 3), float64(step, count, 3), int64(step, count), int64(step, count)


@operator
def simulate_respond(state: Sequence[Tensor], fraction: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Position, orientation, velocity and angular velocity of robots that moved by `fraction` (N,) of a step."""
    position, orientation, velocity, angular_velocity = (float64(fraction, len(fraction), k) for k in (3, 4, 3, 3))
    return position, orientation, velocity, angular_velocity


@operator
def simulate_commit(state: Sequence[Tensor], planned: Sequence[Tensor], fraction: Tensor, discard: Tensor) -> None:
    """Moves robots in place by `fraction` (N,) of a step, with the planned velocities, angular velocities, targets and
    stays; no effect if discard (1,) int64 is nonzero.
    """


@on_contiguous
@operator
def simulate_tally(state: Sequence[Tensor], fraction: Tensor, id: Tensor, pairs: Tensor, toi: Tensor) -> Tensor:
    """(6,) int64 of a step: number of robots, hash of contacts, hash of states, number of robots that stopped, number
    of contacts at its start, hash of ids. state: columns after the step (N, ...), ids first; fraction (N,): the part of
    the step that each robot moved; pairs (K, 2): of the contacts, may be padded with -1, rows of the ids (H,).
    """
    return int64(fraction, 6)


@on_contiguous
@operator
def simulate_hash(columns: Sequence[Tensor]) -> Tensor:
    """(1,) int64: sum modulo 2^64 of the rows' hashes; columns (N,) or (N, k), int64 or float64."""
    return int64(columns[0], 1)


def random_uniforms(id: Tensor, seed: int, step: int, stream: int) -> Tensor:
    """Random numbers (N, 4) in (0, 1) of the counters (id, step, stream): Philox4x32-10 (Salmon et al. 2011), key
    `seed` (any int64).
    """
    for name, word in (("step", step), ("stream", stream)):
        if not 0 <= word < 2**32:
            raise ValueError(f"{name}: expected a value in [0, 2^32), got {word}")
    return _random_uniforms(id.contiguous(), seed, step, stream)


@operator
def _random_uniforms(id: Tensor, seed: int, step: int, stream: int) -> Tensor:
    return float64(id, id.shape[0], 4)
