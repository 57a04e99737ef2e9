"""Exchange of the boxes of swept triangles: sent to the ranks of the voxels that they touch."""

from dataclasses import dataclass

import torch
from torch import Tensor

from pgccd import ops
from pgccd.baselines.voxel_directory import VoxelDirectory, first_rows, voxel_keys
from pgccd.distributed.comm.exchange import make_route
from pgccd.distributed.comm.interface import Comm
from pgccd.runtime.stages import StageClock
from pgccd.search.bodies import MovingBodies


@dataclass(frozen=True)
class VoxelContents:
    """The non-empty voxels of one rank and their boxes, as input of `ops.voxel_pairs`."""

    boxes: Tensor  #: (B, 32) uint8, packed
    segments: Tensor  #: (S, 3) int64: first box, number of boxes, first body of the sender
    voxels: Tensor  #: (V, 3) int32, ascending
    first_segment: Tensor  #: (V + 1,) int64

    @property
    def counts(self) -> Tensor:
        """(V,) int64: number of boxes of each voxel."""
        ends = torch.cat([self.segments.new_zeros(1), self.segments[:, 1].cumsum(0)])[self.first_segment]
        return ends[1:] - ends[:-1]


def send_boxes(
    comm: Comm,
    directory: VoxelDirectory,
    bodies: MovingBodies,
    first_body: Tensor,
    voxel_size: float,
    settings: tuple[float, float],
    clock: StageClock,
) -> tuple[VoxelContents, int]:
    """Sends the box of each swept triangle to all voxels that it touches. Returns the contents of this rank's voxels,
    and the number of boxes that this rank sent.

    Args:
        comm: between the ranks.
        directory: of the voxels' ranks.
        bodies: the moving bodies of this rank.
        first_body: (ranks,) int64: number of the first body of each rank, over all ranks.
        voxel_size: length units.
        settings: separation and tolerance, as for the operators.
        clock: records stage times.
    """
    given = (bodies.mesh_set, bodies.tensors, bodies.linear_path, voxel_size, *settings)
    with clock.stage("contribute"):
        voxels, counts = ops.voxels_touched(*given)
    with clock.stage("locate"):
        rank = directory.locate(voxel_keys(voxels))
        order = torch.argsort(rank, stable=True)
        rank, voxels, counts = rank[order], voxels[order], counts[order]
    with clock.stage("contribute"):
        boxes = ops.voxel_boxes(*given, voxels, counts)
    with clock.stage("exchange"):
        route = make_route(comm, torch.arange(len(rank)), rank)  # voxels are already sorted by rank
        boxes_to = torch.zeros(comm.size, dtype=torch.int64).index_add_(0, rank, counts)
        boxes_from = comm.exchange_counts(boxes_to)
        headers = route.forward({"voxels": voxels, "counts": counts})
        arriving = comm.exchange(boxes, boxes_to.tolist(), boxes_from.tolist())
        received_headers, received = headers.wait(), arriving.wait()
        contents = _by_voxel(received, received_headers["voxels"], received_headers["counts"], first_body[route.source])
    return contents, len(boxes)


def _by_voxel(boxes: Tensor, voxels: Tensor, counts: Tensor, first_body: Tensor) -> VoxelContents:
    """Groups segments (S,) of boxes, one per sender and voxel, by voxel."""
    segments = torch.stack([counts.cumsum(0) - counts, counts, first_body], dim=1)
    keys = voxel_keys(voxels)
    order = torch.argsort(keys, stable=True)
    first = first_rows(keys[order])
    return VoxelContents(
        boxes, segments[order], voxels[order][first], torch.cat([first, first.new_tensor([len(keys)])])
    )
