"""Traversal: from body pairs to candidate feature pairs, by the bounding volume test tree (BVTT)."""

import torch
from torch import Tensor

from pgccd import arguments, ops
from pgccd.search.bodies import MovingBodies
from pgccd.search.checks import (
    Initial,
    check_pairs,
    check_separation,
    check_tensor,
    operator_tolerance,
    require,
    tests_start,
)

__all__ = ["find_candidates"]


def find_candidates(
    bodies: MovingBodies,
    pairs: Tensor,
    min_separation: float = 0.0,
    tolerance: float | None = None,
    horizon: Tensor | None = None,
    initial: Initial = "report",
) -> tuple[Tensor, Tensor]:
    """Feature pairs that may come within min_separation + tolerance during the step, and edges and faces that may pass
    through one another at t = 0.

    Args:
        bodies: the scene in motion.
        pairs: (P, 2) int64 body pairs, i < j, or (i, i) for a body tested against itself; P below 2^31.
        min_separation: length.
        tolerance: length; default 1e-6 of the smaller SBV radius of each pair.
        horizon: (P,) float64 in [0, 1]: end of the time searched for each pair. Default: the whole step.
        initial: as for `pgccd.detect`.

    Returns:
        The candidates, (C, 4) int32: index into `pairs`, kind (see `pgccd.Kind`), feature of i, feature of j. Every
        feature pair that may touch is listed exactly once (representative triangles, Curtis et al. 2008). The
        candidates of a pair (i, i) are of kind VF_AB, EE with the smaller edge first, or EF_AB. The order of rows is
        not specified. The second result is the number of node pairs tested below the roots, (1,) int64.

    Raises:
        TypeError, ValueError: naming the argument.

    Example:
        >>> candidates, node_tests = pgccd.traverse.find_candidates(bodies, pgccd.broad.sweep(bodies))
    """
    arguments.instance(bodies, "bodies", MovingBodies)
    pairs = check_pairs(pairs, bodies.scene, bodies.deforming)
    bodies.check()
    if horizon is not None:
        check_tensor(horizon, "horizon", torch.float64, pairs.shape[:1], pairs.device)
        arguments.refuse_gradient(horizon, "horizon")
        require((horizon >= 0.0) & (horizon <= 1.0), "horizon: expected times in [0, 1]", horizon)
    return ops.traverse(
        bodies.operands,
        pairs,
        horizon,
        check_separation(min_separation),
        operator_tolerance(tolerance),
        tests_start(initial),
    )


def __dir__() -> list[str]:
    return sorted(__all__)
