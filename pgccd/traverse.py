"""Traversal: from body pairs to candidate feature pairs, by the bounding volume test tree (BVTT)."""

from __future__ import annotations

import torch
from torch import Tensor

from pgccd import ops
from pgccd.bodies import MovingBodies
from pgccd.broad import check_separation


def bvtt(bodies: MovingBodies, pairs: Tensor, min_separation: float = 0.0) -> tuple[Tensor, Tensor]:
    """Feature pairs that may come within the separation during the step.

    Args:
        bodies: the scene in motion.
        pairs: (P, 2) int64 body pairs, i < j; P below 2^31.
        min_separation: length.

    Returns:
        candidates (C, 4) int32: row of `pairs`, kind (see `pgccd.Kind`), feature of i, feature of j. Every feature pair
        that touches is listed, and none twice (representative triangles, Curtis et al. 2008). The order is not specified.
        node_tests (1,) int64: how many node pairs were tested.

    Example:
        >>> candidates, node_tests = pgccd.traverse.bvtt(bodies, pgccd.broad.sweep(bodies))
    """
    pairs = check_pairs(pairs, bodies)
    separation = check_separation(min_separation)
    if bodies.deforming:
        return ops.traverse_deforming(bodies.mesh_set, bodies.tensors, pairs, separation)
    return ops.traverse_rigid(bodies.mesh_set, bodies.tensors, bodies.linear_path, pairs, separation)


def check_pairs(pairs: Tensor, bodies: MovingBodies) -> Tensor:
    """`pairs`, if it has the right dtype, shape and device."""
    if not isinstance(pairs, Tensor) or pairs.dtype != torch.int64:
        raise TypeError(f"pairs: expected an int64 tensor, got {getattr(pairs, 'dtype', type(pairs).__name__)}")
    if pairs.dim() != 2 or pairs.shape[1] != 2:
        raise ValueError(f"pairs: expected shape (P, 2), got {tuple(pairs.shape)}")
    if pairs.device != bodies.device:
        raise ValueError(f"pairs: expected device {bodies.device}, got {pairs.device}")
    return pairs.contiguous()
