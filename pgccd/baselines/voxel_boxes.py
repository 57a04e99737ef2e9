"""Boxes of triangles' sweeps on their way to the ranks of the voxels that they touch."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from pgccd import ops
from pgccd.baselines.voxel_directory import VoxelDirectory, run_starts, voxel_keys
from pgccd.detection.bodies import MovingBodies
from pgccd.distributed.comm.exchange import make_route
from pgccd.distributed.comm.interface import Comm
from pgccd.runtime.stages import StageClock


@dataclass(frozen=True)
class VoxelContents:
    """The voxels of one rank that have boxes, and these; as `ops.voxel_pairs` takes them."""

    boxes: Tensor  #: (B, 32) uint8, packed
    segments: Tensor  #: (S, 3) int64: first box, number of boxes, first body of their sender
    voxels: Tensor  #: (V, 3) int32, ascending
    first_segment: Tensor  #: (V + 1,) int64

    @property
    def counts(self) -> Tensor:
        """(V,) int64: boxes of each voxel."""
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
    """Sends the box of each triangle's sweep to all voxels that it touches; returns what this rank's voxels have been
    sent, and how many boxes this rank sent.

    Args:
        comm: between the ranks.
        directory: where voxels live.
        bodies: of this rank, in motion.
        first_body: (ranks,) int64: numbers all bodies of all ranks.
        voxel_size: length units.
        settings: separation and tolerance, as for the operators.
        clock: stages are timed here.
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
        route = make_route(comm, torch.arange(len(rank)), rank)  # of voxels, which are in its order already
        boxes_to = torch.zeros(comm.size, dtype=torch.int64).index_add_(0, rank, counts)
        boxes_from = comm.exchange_counts(boxes_to)
        headers = route.forward({"voxels": voxels, "counts": counts})
        arriving = comm.exchange(boxes, boxes_to.tolist(), boxes_from.tolist())
        received_headers, received = headers.wait(), arriving.wait()
        contents = _by_voxel(received, received_headers["voxels"], received_headers["counts"], first_body[route.source])
    return contents, len(boxes)


def _by_voxel(boxes: Tensor, voxels: Tensor, counts: Tensor, first_body: Tensor) -> VoxelContents:
    """Groups segments (S,) of boxes, one for each sender and voxel, by voxel."""
    segments = torch.stack([counts.cumsum(0) - counts, counts, first_body], dim=1)
    keys = voxel_keys(voxels)
    order = torch.argsort(keys, stable=True)
    keys = keys[order]
    is_first = run_starts(keys)
    first_segment = torch.cat([is_first.nonzero()[:, 0], keys.new_tensor([len(keys)])])
    return VoxelContents(boxes, segments[order], voxels[order][is_first], first_segment)
