"""Robots: poses, and paths that are free of contact."""

from collections.abc import Sequence

import torch
from torch import Tensor

from pgccd.ops.library import float64, int64, operator

#: joints (F, 3) int32: parent, kind (0 fixed, 1 revolute, 2 prismatic) and coordinate; places (F, 13) float64: position
#: (3), orientation (4), axis (3), scale, offset and distance from the parent; crossing (F, F) float64; chain_begin
#: (N + 1,) int32 and chain (., ) int32: the frames from the base to that of each body; body_reach (N,) float64.
Arm = Sequence[Tensor]


@operator
def arm_poses(arm: Arm, q: Tensor) -> tuple[Tensor, Tensor]:
    """World poses (K, N, 3) and (K, N, 4) of the bodies in configurations q (K, J)."""
    count, bodies = q.shape[0], arm[3].shape[0] - 1
    return float64(q, count, bodies, 3), float64(q, count, bodies, 4)


@operator
def arm_arcs(
    arm: Arm, control: Tensor, error: float, begin: Tensor, end: Tensor
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    """Arcs of bodies between their poses at times `begin` and `end` (K,) of segments, whose joint values are Bernstein
    polynomials with control points (K, D + 1, J), up to `error`: position_t0, position_t1 (K, N, 3), orientation
    (K, N, 4), rotation (K, N, 3), and stray (K, N): how far points of the bodies are from the arcs, at most, rounding
    included. Joints of a chain turn by at most 1 rad between, added. If both times are equal: the error of the poses.
    """
    count, bodies = control.shape[0], arm[3].shape[0] - 1
    columns = [float64(control, count, bodies, width) for width in (3, 3, 4, 3)]
    return columns[0], columns[1], columns[2], columns[3], float64(control, count, bodies)


@operator
def certify_paths(
    mesh_set: Sequence[Tensor],
    arm: Arm,
    bodies: Sequence[Tensor],
    obstacles: Sequence[Tensor],
    obstacles_move: bool,
    room: float,
    control: Tensor,
    degree: int,
    error: float,
    resolution: float,
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor, Tensor]:
    """Whether paths are free of contact. Their segments are Bernstein polynomials with control points (B, S degree + 1,
    J), up to `error`; of degree 1 with waypoints (B, T, J). Returns verdict (B,) int8 as `pgccd.robots.Verdict`;
    segment (B,) int64 and toi (B,) of the first contact; the bodies (B, 2) int32 that meet, -1 for none; the point (B,
    3); and counts (B, 4) int64: of parts of segments, of body pairs over such parts, of node tests and of feature
    pairs.

    bodies: mesh_index (N + M,) int32, radius and margin (N + M,) of N bodies and M obstacles, pairs (P, 3) int32: two
    bodies, and the number of frames that both their chains begin with. obstacles: position_t0, position_t1 (R, M, 3),
    orientation (R, M, 4), rotation (R, M, 3), error (M,); a row is a path, or, if they move, a segment; or there is one
    for all.
    """
    count = control.shape[0]
    return (
        control.new_empty((count,), dtype=torch.int8),
        int64(control, count),
        float64(control, count),
        control.new_empty((count, 2), dtype=torch.int32),
        float64(control, count, 3),
        int64(control, count, 4),
    )
