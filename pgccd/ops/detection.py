"""Detection on one device: checks, bounds, single stages, padded stages, elementary tests."""

from collections.abc import Sequence

import torch
from torch import Tensor

from pgccd.ops.library import Bodies, float64, int64, on_contiguous, operator, operator_of_bodies, unknown_count

#: Columns of contacts: index into the pairs (K,), kind (K,), features (K, 2), status (K,), toi (K,), coordinates
#: (K, 2), point (K, 3), normal (K, 3).
ContactRows = tuple[Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor]
_Elementary = tuple[Tensor, Tensor, Tensor, Tensor]
#: Swept bodies: position_t0 (N, 3), position_t1 (N, 3), radius (N,); then group, mask, world, static, in_other_search
#: (N,) and boxes (N, 28), of `moving_boxes`. These may be None, or left out at the end. Pairs of two static bodies are
#: left out, and pairs of two bodies marked by in_other_search, uint8; and those whose boxes stay apart.
Swept = tuple[Tensor, Tensor, Tensor, *tuple[Tensor | None, ...]]


@operator
def first_invalid_rows(columns: Sequence[Tensor], checks: Sequence[int], limits: Sequence[float]) -> Tensor:
    """(n + 1,): first invalid row of each column (rows, width), or its number of rows; then 1 if any row is invalid,
    else 0.

    Checks: 0, magnitude of each number <= limit; 1, |length of the row - 1| <= limit; 2, length of the row <= limit;
    3, each number from 0 to the limit; 4, each number 0, or from 1e-30 to the limit.
    """
    return int64(columns[0], len(columns) + 1)


@operator
def sound_radii(
    of_meshes: Tensor,
    mesh_index: Tensor,
    given: Tensor | None,
    position_t0: Tensor,
    position_t1: Tensor,
    orientation: Tensor,
    rotation: Tensor,
    margin: Tensor | None,
) -> tuple[Tensor, Tensor]:
    """SBV radii (N,) of rigid bodies: `given` (N,), or those of their meshes, of_meshes (M,) by mesh_index (N,); -inf
    where a value is invalid. And as from `first_invalid_rows`: of position_t0, position_t1 (N, 3), orientation (N, 4),
    rotation (N, 3), mesh_index unless radii are given, and margin (N,) if there is one.
    """
    return torch.empty_like(position_t0[:, 0]), int64(position_t0, 5 + (given is None) + (margin is not None))


@operator
def rotations_between(orientation_t0: Tensor, orientation_t1: Tensor) -> Tensor:
    """Rotation vectors (N, 3) between two orientations (N, 4), radians, world frame; NaN where the second one is no
    unit quaternion.
    """
    return orientation_t0.new_empty((orientation_t0.shape[0], 3))


@operator
def poses_at(
    position_t0: Tensor, position_t1: Tensor, orientation: Tensor, rotation: Tensor, time: Tensor
) -> tuple[Tensor, Tensor]:
    """Positions (M, 3) and unit quaternions (M, 4) of M rigid bodies on their arcs at times (M,)."""
    return torch.empty_like(position_t0), torch.empty_like(orientation)


@on_contiguous
@operator
def shorten_arcs(position_t0: Tensor, position_t1: Tensor, rotation: Tensor, fraction: Tensor) -> tuple[Tensor, Tensor]:
    """Ends (N, 3) and rotation vectors (N, 3) of the first part, `fraction` (N,) in [0, 1], of N arcs: exactly those of
    the whole at 1, and of a body at rest at 0, whatever `position_t1` is.
    """
    return torch.empty_like(position_t0), torch.empty_like(rotation)


@operator
def moving_spheres(
    mesh_set: Sequence[Tensor], bodies: Sequence[Tensor], linear_path: bool
) -> tuple[Tensor, Tensor, Tensor]:
    """SBV centres at t0 and t1 (N, 3), and the radius (N,) of the sphere moving straight between them that contains the
    rigid body throughout.
    """
    return torch.empty_like(bodies[1]), torch.empty_like(bodies[1]), torch.empty_like(bodies[3])


@operator_of_bodies
def moving_boxes(bodies: Bodies) -> Tensor:
    """Boxes (N, 28) float32 around bodies at both ends of the step, see csrc/core/moving_box.h."""
    tensors = bodies[1]
    return tensors[1].new_empty((tensors[1].shape[0], 28), dtype=torch.float32)


@operator
def refit(
    mesh_set: Sequence[Tensor],
    mesh_index: Tensor,
    vertices_t0: Tensor,
    vertices_t1: Tensor,
    vertex_begin: Tensor,
    block_begin: Tensor,
    block_count: int,
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor, Tensor]:
    """Of deforming bodies: centres at t0 and t1 (N, 3), radius (N,), node blocks (Y, 9, 8) at t0 and t1, and vertices
    (X, 2, 4) relative to the centres at t0 and t1 (x, y, z, 0).
    """
    count = mesh_index.shape[0]
    blocks_t0, blocks_t1 = (vertices_t0.new_empty((block_count, 9, 8), dtype=torch.float32) for _ in range(2))
    return (
        float64(vertices_t0, count, 3),
        float64(vertices_t0, count, 3),
        float64(vertices_t0, count),
        blocks_t0,
        blocks_t1,
        vertices_t0.new_empty((vertices_t0.shape[0], 2, 4), dtype=torch.float32),
    )


@operator
def broad_pairs(
    swept: Swept, min_separation: float, tolerance: float, broad_phase: int, axis: int, at_any_times: bool = False
) -> Tensor:
    """Sorted pairs (P, 2) int64 of swept bodies that come within min_separation + tolerance; a negative tolerance is
    relative to the smaller radius of a pair. broad_phase: number in csrc/kernels/broad/broad.h; axis: of a sweep, -1
    for automatic. Neither affects the result. at_any_times: also pairs that may come so near with each body at a time
    of its own.
    """
    return int64(swept[0], unknown_count(), 2)


@operator
def meeting_pairs(pairs: Tensor, swept: Swept, min_separation: float, tolerance: float) -> tuple[Tensor, Tensor]:
    """Selects from pairs (P, 2) of bodies, found at any times, which may contain rows of -1, those that `broad_pairs`
    finds otherwise: (P, 2) in the same order, padded with -1 after the first `found` (1,) rows. Does not synchronise.
    """
    return int64(pairs, pairs.shape[0], 2), int64(pairs, 1)


@operator_of_bodies
def traverse(
    bodies: Bodies,
    pairs: Tensor,
    horizon: Tensor | None,
    min_separation: float,
    tolerance: float,
    tests_start: bool,
) -> tuple[Tensor, Tensor]:
    """Candidates (C, 4) int32 of body pairs, and the number of node tests (1,)."""
    return pairs.new_empty((unknown_count(), 4), dtype=torch.int32), int64(pairs, 1)


@operator_of_bodies
def narrow(
    bodies: Bodies,
    pairs: Tensor,
    candidates: Tensor,
    min_separation: float,
    tolerance: float,
    nonzero_toi: bool,
    report: int,
) -> ContactRows:
    """Contact rows of the candidates of body pairs."""
    return _contact_rows(pairs, unknown_count())


@operator
def pairs_padded(
    swept: Swept,
    is_invalid: Tensor | None,
    min_separation: float,
    tolerance: float,
    broad_phase: int,
    capacity: Sequence[int],
    at_any_times: bool = False,
) -> tuple[Tensor, Tensor]:
    """The pairs of `broad_pairs` padded with -1, and counts (7,): see `pgccd.runtime.sizes`. If is_invalid (1,) is
    nonzero there are none. Does not synchronise.
    """
    return int64(swept[0], capacity[0], 2), int64(swept[0], 7)


@operator_of_bodies
def contacts_padded(
    bodies: Bodies,
    pairs: Tensor,
    pair_counts: Tensor,
    invalid_rows: Tensor,
    min_separation: float,
    tolerance: float,
    options: Sequence[int],
    capacity: Sequence[int],
) -> tuple[Tensor, ...]:
    """Padded contact rows, body pairs in the first column; and all counts (22,) followed by invalid_rows. options: as
    of `pgccd.search.query.Query`. Does not synchronise.
    """
    return _found(pairs, invalid_rows.shape[0], capacity)


@operator
def detect_rigid(
    mesh_set: Sequence[Tensor],
    bodies: Sequence[Tensor],
    linear_path: bool,
    swept: Swept,
    invalid_rows: Tensor,
    searches_sound: bool,
    min_separation: float,
    tolerance: float,
    options: Sequence[int],
    broad_phase: int,
    pair_capacity: Sequence[int],
    capacity: Sequence[int],
) -> tuple[Tensor, ...]:
    """`pairs_padded`, then `contacts_padded` for the pairs found. invalid_rows: as from `sound_radii`. If a row is
    invalid there are no pairs; with `searches_sound`, the pairs of all bodies whose sphere has a radius >= 0.
    """
    return _found(bodies[1], invalid_rows.shape[0], capacity)


@operator
def lower_first_toi_rigid(
    first: Tensor,
    owners: Tensor,
    mesh_set: Sequence[Tensor],
    bodies: Sequence[Tensor],
    linear_path: bool,
    pairs: Tensor,
    pair_counts: Tensor,
    min_separation: float,
    tolerance: float,
    nonzero_toi: bool,
    capacity: Sequence[int],
) -> Tensor:
    """Lowers first (N,) float64 at the rows owners (P, 2) int64 of each pair (P, 2) to the pair's first toi. Returns
    all counts (22,). Does not synchronise. capacity: (7,), without contacts.
    """
    return int64(owners, 22)


@operator
def vertex_face(
    points_t0: Tensor, points_t1: Tensor, min_separation: float, tolerance: float, nonzero_toi: bool
) -> _Elementary:
    """Status (n,), toi (n,), coordinates (n, 2), significant bits (n,) of vertex-face queries (n, 4, 3), f32 or f64."""
    count = points_t0.shape[0]
    status, significant_bits = (points_t0.new_empty((count,), dtype=torch.int8) for _ in range(2))
    return status, points_t0.new_empty((count,)), points_t0.new_empty((count, 2)), significant_bits


@operator
def edge_edge(
    points_t0: Tensor, points_t1: Tensor, min_separation: float, tolerance: float, nonzero_toi: bool
) -> _Elementary:
    """As `vertex_face`, of edge-edge queries."""
    return vertex_face.__wrapped__(points_t0, points_t1, min_separation, tolerance, nonzero_toi)  # type: ignore[attr-defined]


def _contact_rows(like: Tensor, count: int | torch.SymInt) -> ContactRows:
    pair, features = (like.new_empty((count, *width), dtype=torch.int32) for width in ((), (2,)))
    kind, status = (like.new_empty((count,), dtype=torch.int8) for _ in range(2))
    return pair, kind, features, status, float64(like, count), *(float64(like, count, width) for width in (2, 3, 3))  # type: ignore[return-value]


def _found(like: Tensor, invalid_row_count: int, capacity: Sequence[int]) -> tuple[Tensor, ...]:
    count = capacity[-1] if capacity[-1] >= 0 else unknown_count()  # -1: as many rows as found
    return int64(like, count, 2), *_contact_rows(like, count)[1:], int64(like, 22 + invalid_row_count)
