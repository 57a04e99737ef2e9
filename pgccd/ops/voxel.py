"""Operators of the voxel-based baseline, CPU only."""

from collections.abc import Sequence

import torch
from torch import Tensor

from pgccd.ops.library import int64, operator, unknown_count


@operator
def voxels_touched(
    mesh_set: Sequence[Tensor],
    bodies: Sequence[Tensor],
    linear_path: bool,
    voxel_size: float,
    min_separation: float,
    tolerance: float,
) -> tuple[Tensor, Tensor]:
    """Coordinates (V, 3) int32, ascending, of the voxels touched by the boxes of rigid bodies' swept triangles; and the
    number of boxes per voxel (V,) int64.
    """
    count = unknown_count()
    return bodies[0].new_empty((count, 3), dtype=torch.int32), int64(bodies[0], count)


@operator
def voxel_boxes(
    mesh_set: Sequence[Tensor],
    bodies: Sequence[Tensor],
    linear_path: bool,
    voxel_size: float,
    min_separation: float,
    tolerance: float,
    voxels: Tensor,
    counts: Tensor,
) -> Tensor:
    """These boxes, packed (B, 32) uint8, grouped by voxel in the given order."""
    return bodies[0].new_empty((unknown_count(), 32), dtype=torch.uint8)


@operator
def voxel_pairs(boxes: Tensor, segments: Tensor, voxels: Tensor, first_segment: Tensor, voxel_size: float) -> Tensor:
    """Rows (body a, triangle a, body b, triangle b) (K, 4) int64, a < b, of boxes that overlap, each pair once.

    Args:
        boxes: (B, 32) uint8, packed.
        segments: (S, 3) int64: for the boxes of one voxel from one sender, the first box, their number, and the offset
            added to the rows of their bodies.
        voxels: (V, 3) int32.
        first_segment: (V + 1,) int64: voxel k has the segments [first_segment[k], first_segment[k + 1]).
        voxel_size: length units.
    """
    return int64(boxes, unknown_count(), 4)
