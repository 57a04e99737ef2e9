"""Robots: poses, and paths that are free of contact."""

from collections.abc import Sequence

import torch
from torch import Tensor

from pgccd.ops.library import float64, int64, operator

#: joints (F, 3) int32: parent, kind (0 fixed, 1 revolute, 2 prismatic) and coordinate; places (F, 13) float64: position
#: (3), orientation (4), axis (3), scale, offset and distance from the parent; crossing (F, F) float64; body_frame (N,)
#: int32; body_reach (N,) float64.
Arm = Sequence[Tensor]


@operator
def arm_poses(arm: Arm, q: Tensor) -> tuple[Tensor, Tensor]:
    """World poses (K, N, 3) and (K, N, 4) of the bodies in configurations q (K, J)."""
    count, bodies = q.shape[0], arm[3].shape[0] - 1
    return float64(q, count, bodies, 3), float64(q, count, bodies, 4)


@operator
def arm_strays(arm: Arm, q0: Tensor, q1: Tensor) -> Tensor:
    """(K, N): how far points of bodies stray, at most, from the arcs between their poses in configurations q0 and q1
    (K, J), rounding of poses included; all joints of a chain turn by at most 1 rad, added.
    """
    return float64(q0, q0.shape[0], arm[3].shape[0] - 1)


@operator
def certify_paths(
    mesh_set: Sequence[Tensor],
    arm: Arm,
    bodies: Sequence[Tensor],
    obstacles: Sequence[Tensor],
    obstacles_move: bool,
    room: float,
    waypoints: Tensor,
    resolution: float,
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor, Tensor]:
    """Whether paths, waypoints (B, T, J), are free of contact: verdict (B,) int8 as `pgccd.robots.Verdict`; segment
    (B,) int64 and toi (B,) of the first contact; the bodies (B, 2) int32 that meet, -1 for none; the point (B, 3); and
    counts (B, 4) int64: of parts of segments, of body pairs over such parts, of node tests and of feature pairs.

    bodies: mesh_index (N + M,) int32, radius and margin (N + M,) of N bodies and M obstacles, pairs (P, 3) int32: two
    bodies, and the frame that carries both or -1. obstacles: position_t0, position_t1 (R, M, 3), orientation
    (R, M, 4), rotation (R, M, 3), error (M,); a row is a path, or, if they move, a segment; or there is one for all.
    """
    count = waypoints.shape[0]
    return (
        waypoints.new_empty((count,), dtype=torch.int8),
        int64(waypoints, count),
        float64(waypoints, count),
        waypoints.new_empty((count, 2), dtype=torch.int32),
        float64(waypoints, count, 3),
        int64(waypoints, count, 4),
    )
