"""Traversal: from body pairs to candidate feature pairs, by the bounding volume test tree (BVTT)."""

from __future__ import annotations

import torch
from torch import Tensor

from pgccd import arguments, ops
from pgccd.bodies import MovingBodies
from pgccd.broad import check_separation, operator_tolerance, require_bodies


def bvtt(
    bodies: MovingBodies,
    pairs: Tensor,
    min_separation: float = 0.0,
    tolerance: float | None = None,
    horizon: Tensor | None = None,
    leading: bool = False,
) -> tuple[Tensor, Tensor]:
    """Feature pairs that may come within min_separation + tolerance during the step.

    Args:
        bodies: the scene in motion.
        pairs: (P, 2) int64 body pairs, i < j, or (i, i) where the body collides with itself; P below 2^31.
        min_separation: length.
        tolerance: length; default 1e-6 of the smaller SBV radius of each pair.
        horizon: (P,) float64 in [0, 1]: latest time searched in each pair. Default: the whole step.
        leading: follow only the nodes that overlap most, down to one pair of leaves: few candidates, likely early
            contacts.

    Returns:
        candidates (C, 4) int32: row of `pairs`, kind (see `pgccd.Kind`), feature of i, feature of j. Unless
        `leading`, every feature pair that may touch is listed, and none twice (representative triangles, Curtis et
        al. 2008). Of a pair (i, i) they are of kind VF_AB, or EE with the smaller edge first. The order of rows is not
        specified.
        node_tests (1,) int64: how many node pairs were tested.

    Example:
        >>> candidates, node_tests = pgccd.traverse.bvtt(bodies, pgccd.broad.sweep(bodies))
    """
    require_bodies(bodies)
    pairs = check_pairs(pairs, bodies)
    bodies.check()
    if horizon is not None:
        _check_horizon(horizon, pairs)
    settings = (check_separation(min_separation), operator_tolerance(tolerance))
    rest = (pairs, horizon, *settings, arguments.flag(leading, "leading"))
    if bodies.deforming:
        return ops.traverse_deforming(bodies.mesh_set, bodies.tensors, *rest)
    return ops.traverse_rigid(bodies.mesh_set, bodies.tensors, bodies.linear_path, *rest)


def _check_horizon(horizon: Tensor, pairs: Tensor) -> None:
    if not isinstance(horizon, Tensor) or horizon.shape != pairs.shape[:1] or horizon.dtype != torch.float64:
        expected = f"a float64 tensor of shape ({len(pairs)},)"
        raise ValueError(f"horizon: expected {expected}, got {arguments.describe(horizon)}")
    if horizon.device != pairs.device:
        raise ValueError(f"horizon: expected device {pairs.device}, got {horizon.device}")
    arguments.refuse_gradient(horizon, "horizon")
    require((horizon >= 0.0) & (horizon <= 1.0), "horizon: expected times in [0, 1]")


def check_pairs(pairs: Tensor, bodies: MovingBodies, ascending: bool = False) -> Tensor:
    """`pairs`, if it has the right dtype, shape and device, and names bodies of the scene.

    Args:
        ascending: whether rows must be sorted, and no two of them alike.
    """
    if not isinstance(pairs, Tensor) or pairs.dtype != torch.int64:
        raise TypeError(f"pairs: expected an int64 tensor, got {arguments.describe(pairs)}")
    if pairs.dim() != 2 or pairs.shape[1] != 2:
        raise ValueError(f"pairs: expected shape (P, 2), got {tuple(pairs.shape)}")
    if pairs.device != bodies.device:
        raise ValueError(f"pairs: expected device {bodies.device}, got {pairs.device}")
    count = bodies.scene.body_count
    i, j = pairs.unbind(dim=1)
    in_order = (i >= 0) & (i < j) & (j < count)
    expected = f"pairs: expected rows 0 <= i < j < {count}"
    own = bodies.scene.self_collision
    if own is not None and len(bodies.self_colliding):
        in_order |= (i == j) & (i >= 0) & (j < count) & own[i.clamp(0, count - 1)]
        expected += ", or (i, i) of a body that collides with itself"
    require(in_order, expected)
    if ascending:
        rises = (i[1:] > i[:-1]) | ((i[1:] == i[:-1]) & (j[1:] > j[:-1]))
        require(rises, "pairs: expected rows sorted by i, then j, each once (torch.unique(pairs, dim=0) makes them so)")
    return pairs.contiguous()


def require(valid: Tensor, message: str) -> None:
    """Raises ValueError unless all of `valid` is true.

    On a GPU the assertion is asynchronous: it does not stall the stream.
    """
    if valid.device.type != "cpu" or torch.compiler.is_compiling():
        torch._assert_async(valid.all(), message)
    elif not bool(valid.all()):
        raise ValueError(message)
