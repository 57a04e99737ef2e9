"""Distances of bodies over a step."""

from torch import Tensor

from pgccd.ops.library import Bodies, float64, operator_of_bodies


@operator_of_bodies
def distances(bodies: Bodies, pairs: Tensor, cutoff: float, tolerance: float) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Lower and upper bounds (P,) of the least distance of body pairs (P, 2) over the step, and the time (P,) and
    points (P, 2, 3) of the upper bound. For pairs that are certainly further apart than the cutoff, the upper bound is
    infinite, and time and points are NaN. A negative tolerance is relative to the smaller radius of each pair.
    """
    count = pairs.shape[0]
    return float64(pairs, count), float64(pairs, count), float64(pairs, count), float64(pairs, count, 2, 3)
