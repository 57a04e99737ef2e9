"""The operator that prepares a mesh, on CPUs only."""

import torch
from torch import Tensor

from pgccd.ops.library import operator, unknown_count


@operator
def prepare_mesh(
    vertices: Tensor, faces: Tensor, leaf_size: int
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor, Tensor]:
    """Topology and hierarchy of a mesh of vertices (V, 3) and elements (F, 3) int32, one at least, with leaves of at
    most `leaf_size` triangles: edges (E, 2) int32; triangles (F, 8) int32 in the order of the leaves, with the features
    that each represents; node_blocks (n, 9, 8) float32, node_links (n, 8, 4), leaf_points (p, 4, 8) and node_supports
    (n, 8, 24) int32, as in a mesh set.
    """
    blocks = unknown_count()

    def integers(*shape: int | torch.SymInt) -> Tensor:
        return faces.new_empty(shape, dtype=torch.int32)

    return (
        integers(unknown_count(), 2),
        integers(faces.shape[0], 8),
        faces.new_empty((blocks, 9, 8), dtype=torch.float32),
        integers(blocks, 8, 4),
        integers(unknown_count(), 4, 8),
        integers(blocks, 8, 24),
    )
