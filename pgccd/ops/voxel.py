"""The voxel-based baseline, on the CPU."""

from collections.abc import Sequence

from torch import Tensor

from pgccd.ops import library


def voxels_touched(
    mesh_set: Sequence[Tensor],
    bodies: Sequence[Tensor],
    linear_path: bool,
    voxel_size: float,
    min_separation: float,
    tolerance: float,
) -> tuple[Tensor, Tensor]:
    """Coordinates (V, 3) int32 of the voxels that boxes of the sweeps of rigid bodies' triangles touch, ascending; and
    how many boxes each gets (V,) int64."""
    return library.operators.voxels_touched(
        list(mesh_set), list(bodies), linear_path, voxel_size, min_separation, tolerance
    )


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
    """Those boxes, packed (B, 32) uint8: of one voxel after another, in the order given."""
    settings = (linear_path, voxel_size, min_separation, tolerance)
    return library.operators.voxel_boxes(list(mesh_set), list(bodies), *settings, voxels, counts)


def voxel_pairs(boxes: Tensor, segments: Tensor, voxels: Tensor, first_segment: Tensor, voxel_size: float) -> Tensor:
    """Rows (body a, triangle a, body b, triangle b) (K, 4) int64, a < b, of boxes that overlap, each pair once.

    Args:
        boxes: (B, 32) uint8, packed.
        segments: (S, 3) int64: where the boxes of one voxel from one sender begin, how many they are, and what is added
            to the rows of their bodies.
        voxels: (V, 3) int32.
        first_segment: (V + 1,) int64: voxel k has the segments from the k-th of these to the next.
        voxel_size: length units.
    """
    return library.operators.voxel_pairs(boxes, segments, voxels, first_segment, voxel_size)
