"""Operators of the rounds in which collisions are resolved."""

from collections.abc import Sequence

from torch import Tensor

from pgccd.ops.library import float64, int64, operator


@operator
def resolve_slow_down(
    first: Tensor, fraction: Tensor, changed: Tensor, changes: Tensor, approach: float, smallest: float
) -> None:
    """Slows down bodies that are about to collide, in place. fraction (N,): the part of its path that each body moves,
    lowered according to its first toi (N,), inf for none; changed (N,) uint8: set to 1 for bodies whose fraction
    changed; first: reset to inf; changes (1,) int64: set to 1 if any changed.
    """


@operator
def resolve_first_toi(first: Tensor, pairs: Tensor, toi: Tensor) -> None:
    """Lowers first (N,) in place to the toi (K,) of contacts of pairs (K, 2); negative rows name no body."""


@operator
def resolve_pairs(
    own: Sequence[Tensor],
    ghosts: Sequence[Tensor],
    fraction: Tensor,
    changed: Tensor,
    pairs: Tensor,
    skips_equal: bool,
    by_velocity: bool,
    capacity: int,
) -> tuple[Tensor, list[Tensor], Tensor]:
    """The pairs (capacity, 2), out of (P, 2) padded with -1, with a body whose `changed` (N + G,) uint8 is 1; the
    bodies of these pairs, two rows per pair, each on its `fraction` (N + G,) of its path; and counts (7,) as of
    `pairs_padded`. On a GPU the order is not specified, and the call does not synchronise; unused rows are not set.

    own, ghosts: `bodies` of rigid bodies, margins included if there are any; rows of ghosts follow those of own bodies.
    skips_equal: leaves out pairs of two equal fractions. by_velocity: position_t1 has displacements, and a body ends at
    position_t0 + fraction * displacement; else at position_t0 + fraction * (position_t1 - position_t0), exactly at its
    ends for 0 and 1.
    """
    count = 2 * capacity
    poses = [float64(fraction, count, 3), float64(fraction, count, 3), float64(fraction, count)]
    turns = [float64(fraction, count, 4), float64(fraction, count, 3)]
    margin = [float64(fraction, count)] if len(own) == 7 else []
    mesh_index = own[0].new_empty((count,))
    return int64(pairs, capacity, 2), [mesh_index, *poses, *turns, *margin], int64(pairs, 7)
