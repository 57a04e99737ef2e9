"""Detection on one device: checks, bounds, single stages, padded stages, elementary tests."""

from collections.abc import Sequence

from torch import Tensor

from pgccd.detection.contacts import ContactRows
from pgccd.ops import library


def first_faults(columns: Sequence[Tensor], checks: Sequence[int], limits: Sequence[float]) -> Tensor:
    """(n + 1,): first faulty row of each column (rows, width), or its number of rows; then 1 if any row is faulty, else
    0.

    Checks: 0, magnitude of each number <= limit; 1, |length of the row - 1| <= limit; 2, length of the row <= limit.
    """
    return library.operators.first_faults(list(columns), list(checks), list(limits))


def rotations_between(orientation_t0: Tensor, orientation_t1: Tensor) -> Tensor:
    """Rotation vectors (N, 3) between two orientations (N, 4), radians, world frame."""
    return library.operators.rotations_between(orientation_t0.contiguous(), orientation_t1.contiguous())


def poses_at(
    position_t0: Tensor, position_t1: Tensor, orientation: Tensor, rotation: Tensor, time: Tensor
) -> tuple[Tensor, Tensor]:
    """Positions (M, 3) and unit quaternions (M, 4) of M rigid bodies on their arcs at times (M,)."""
    columns = (position_t0, position_t1, orientation, rotation, time)
    return library.operators.poses_at(*(column.contiguous() for column in columns))


def moving_spheres(
    mesh_set: Sequence[Tensor], bodies: Sequence[Tensor], linear_path: bool
) -> tuple[Tensor, Tensor, Tensor]:
    """SBV centres at t0 and t1 (N, 3), and the radius (N,) of the sphere moving straight between them that contains the
    rigid body throughout.
    """
    return library.operators.moving_spheres(list(mesh_set), list(bodies), linear_path)


def refit(
    mesh_set: Sequence[Tensor],
    mesh_index: Tensor,
    vertices_t0: Tensor,
    vertices_t1: Tensor,
    vertex_begin: Tensor,
    block_begin: Tensor,
    block_count: int,
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    """Centres at t0 and t1 (N, 3), radius (N,), and node blocks (Y, 9, 8) at t0 and t1 of deforming bodies."""
    return library.operators.refit(
        list(mesh_set), mesh_index, vertices_t0, vertices_t1, vertex_begin, block_begin, block_count
    )


def broad_pairs(
    position_t0: Tensor,
    position_t1: Tensor,
    radius: Tensor,
    group: Tensor | None,
    mask: Tensor | None,
    world: Tensor | None,
    is_static: Tensor | None,
    min_separation: float,
    tolerance: float,
    broad_phase: int,
    axis: int = -1,
) -> Tensor:
    """Sorted pairs (P, 2) int64 of swept spheres that come within min_separation + tolerance; a negative tolerance is
    relative to the smaller radius of a pair. broad_phase: number in csrc/kernels/broad/broad_phase.h; axis: of a sweep,
    -1 for automatic. Neither affects the result.
    """
    columns = position_t0, position_t1, radius, group, mask, world, is_static
    return library.operators.broad_pairs(*columns, min_separation, tolerance, broad_phase, axis)


def swept_boxes(
    position_t0: Tensor, position_t1: Tensor, radius: Tensor, min_separation: float, tolerance: float
) -> tuple[Tensor, Tensor]:
    """Lower and upper corners (N, 3) of the boxes of swept spheres, grown by half of separation and tolerance. The
    boxes of every pair found by `broad_pairs` overlap.
    """
    return library.operators.swept_boxes(position_t0, position_t1, radius, min_separation, tolerance)


def traverse_rigid(
    mesh_set: Sequence[Tensor],
    bodies: Sequence[Tensor],
    linear_path: bool,
    pairs: Tensor,
    horizon: Tensor | None,
    min_separation: float,
    tolerance: float,
) -> tuple[Tensor, Tensor]:
    """Candidates (C, 4) int32 of rigid body pairs, and the number of node tests (1,)."""
    return library.operators.traverse_rigid(
        list(mesh_set), list(bodies), linear_path, pairs, horizon, min_separation, tolerance
    )


def traverse_deforming(mesh_set: Sequence[Tensor], bodies: Sequence[Tensor], *rest: object) -> tuple[Tensor, Tensor]:
    """As `traverse_rigid`, for deforming bodies, whose paths are linear."""
    return library.operators.traverse_deforming(list(mesh_set), list(bodies), *rest)


def narrow_rigid(
    mesh_set: Sequence[Tensor],
    bodies: Sequence[Tensor],
    linear_path: bool,
    pairs: Tensor,
    candidates: Tensor,
    min_separation: float,
    tolerance: float,
    nonzero_toi: bool,
    report: int,
) -> ContactRows:
    """Contact rows of the candidates of rigid body pairs."""
    return library.operators.narrow_rigid(
        list(mesh_set), list(bodies), linear_path, pairs, candidates, min_separation, tolerance, nonzero_toi, report
    )


def narrow_deforming(mesh_set: Sequence[Tensor], bodies: Sequence[Tensor], *rest: object) -> ContactRows:
    """As `narrow_rigid`, for deforming bodies, whose paths are linear."""
    return library.operators.narrow_deforming(list(mesh_set), list(bodies), *rest)


def pairs_padded(
    position_t0: Tensor,
    position_t1: Tensor,
    radius: Tensor,
    group: Tensor | None,
    mask: Tensor | None,
    world: Tensor | None,
    is_static: Tensor | None,
    is_invalid: Tensor | None,
    min_separation: float,
    tolerance: float,
    broad_phase: int,
    capacity: Sequence[int],
) -> tuple[Tensor, Tensor]:
    """Pairs padded with -1, and counts (7,): see `pgccd.detection.capacity`. Does not synchronise."""
    columns = position_t0, position_t1, radius, group, mask, world, is_static, is_invalid
    return library.operators.pairs_padded(*columns, min_separation, tolerance, broad_phase, list(capacity))


def detect_rigid(
    mesh_set: list[Tensor], bodies: list[Tensor], linear_path: bool, spheres: list[Tensor], *rest: object
) -> tuple[Tensor, ...]:
    """`pairs_padded` for the spheres [position_t0, position_t1, radius], then `contacts_padded_rigid` for the pairs
    found. If `spheres` is empty, the bodies' own spheres are used.

    `rest`: group, mask, world, is_static; faults as from `first_faults`, or None to check the bodies' poses; checks and
    limits of these, as for `first_faults`, in the order position_t0, position_t1, orientation, rotation;
    min_separation, tolerance, nonzero_toi, report, broad_phase, capacity of the pairs, capacity.
    """
    return library.operators.detect_rigid(mesh_set, bodies, linear_path, spheres, *rest)


def contacts_padded_rigid(
    mesh_set: Sequence[Tensor], bodies: Sequence[Tensor], linear_path: bool, *rest: object
) -> tuple[Tensor, ...]:
    """As `contacts_padded_deforming`, for rigid bodies."""
    return library.operators.contacts_padded_rigid(list(mesh_set), list(bodies), linear_path, *rest)


def contacts_padded_deforming(
    mesh_set: Sequence[Tensor], bodies: Sequence[Tensor], *rest: object
) -> tuple[Tensor, ...]:
    """Padded contact rows, body pairs in the first column; and all counts (21,) followed by the faults. Does not
    synchronise.

    `rest`: pairs, pair_counts, faults, min_separation, tolerance, nonzero_toi, report, capacity.
    """
    return library.operators.contacts_padded_deforming(list(mesh_set), list(bodies), *rest)


def lower_first_toi_rigid(
    first: Tensor,
    owners: Tensor,
    mesh_set: Sequence[Tensor],
    bodies: Sequence[Tensor],
    linear_path: bool,
    *rest: object,
) -> Tensor:
    """Lowers first (N,) float64 at the rows owners (P, 2) int64 of each pair (P, 2) to the pair's first toi. Returns
    all counts (21,). Does not synchronise.

    `rest`: pairs, pair_counts, min_separation, tolerance, nonzero_toi, capacity (6,).
    """
    return library.operators.lower_first_toi_rigid(first, owners, list(mesh_set), list(bodies), linear_path, *rest)


def vertex_face(
    points_t0: Tensor, points_t1: Tensor, min_separation: float, tolerance: float, nonzero_toi: bool
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Status (n,), toi (n,), coordinates (n, 2), significant bits (n,) of vertex-face queries (n, 4, 3), f32 or f64."""
    return library.operators.vertex_face(points_t0, points_t1, min_separation, tolerance, nonzero_toi)


def edge_edge(
    points_t0: Tensor, points_t1: Tensor, min_separation: float, tolerance: float, nonzero_toi: bool
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Status (n,), toi (n,), coordinates (n, 2), significant bits (n,) of edge-edge queries (n, 4, 3), f32 or f64."""
    return library.operators.edge_edge(points_t0, points_t1, min_separation, tolerance, nonzero_toi)
