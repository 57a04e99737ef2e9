"""Narrow phase: from candidate feature pairs to contacts; and elementary tests of the caller's own points."""

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Literal, get_args

import torch
from torch import Tensor

from pgccd import arguments, ops
from pgccd.contacts.contacts import ContactRows, take_earliest
from pgccd.contacts.derivatives import Corners, differentiate
from pgccd.contacts.kinds import FEATURES, Kind, Status
from pgccd.motion.differentiable import any_differentiated, with_gradient_of
from pgccd.search.bodies import MovingBodies
from pgccd.search.checks import (
    check_pairs,
    check_separation,
    check_tensor,
    operator_tolerance,
    require,
    separation_value,
)

__all__ = ["ElementaryResult", "Kind", "Report", "SearchReport", "Status", "edge_edge", "find_contacts", "vertex_face"]

#: Which contacts of a pair `pgccd.detect` gives.
Report = Literal["first", "all", "earliest"]
#: Searches have one more report: "any", for the pairs of `pgccd.collide`.
SearchReport = Literal["any", "first", "all", "earliest"]
CONTACT_REPORTS = get_args(Report)
# Numbers of the enum Report in csrc/kernels/narrow/narrow.h. For "earliest", operators may leave out later contacts.
REPORTS: dict[str, int] = {"any": 0, "first": 1, "all": 2, "earliest": 3}

# Elementary tests have no radius that the tolerance could be relative to.
_ELEMENTARY_TOLERANCE = 1e-6


@dataclass(frozen=True, eq=False)
class ElementaryResult:
    """Results of elementary tests.

    Attributes:
        status: (n,) int8, see `Status`.
        toi: (n,) of the dtype of the points: not late, rounded down; inf when free.
        coordinates: (n, 2) of the dtype of the points: (u, v) of the face point f0 + u (f1 - f0) + v (f2 - f0), or of
            the edge points ea0 + u (ea1 - ea0) and eb0 + v (eb1 - eb0).
        significant_bits: (n,) int8: significand bits of the arithmetic that decided: 24 (float32), 53 (float64) or 106
            (pairs of float64).
    """

    status: Tensor
    toi: Tensor
    coordinates: Tensor
    significant_bits: Tensor
    # See `differentiable`; None if no input required grad.
    _differentiable: Tensor | None = field(default=None, repr=False)

    @property
    def differentiable(self) -> Tensor:
        """(n,) bool: as for `pgccd.Contacts`; False also where features do not touch."""
        return torch.zeros_like(self.status, dtype=torch.bool) if self._differentiable is None else self._differentiable


def vertex_face(
    points_t0: Tensor,
    points_t1: Tensor,
    min_separation: float | Tensor = 0.0,
    tolerance: float | None = 1e-6,
    nonzero_toi: bool = False,
) -> ElementaryResult:
    """Vertex against face, all four points on straight lines over the step. The points are taken as exact.

    A query is first tested in the precision of its points, then in higher precisions while rounding leaves it
    undecided. A near miss is reported as a contact only if the gap is less than about 10^-28 of the query's size.

    Args:
        points_t0, points_t1: (n, 4, 3) float32 or float64, positions of v, f0, f1, f2 at both ends, any one length
            unit. If they or min_separation require grad, so do toi and coordinates.
        min_separation: touching means a distance of at most this; a tensor () if it requires grad.
        tolerance: a contact comes within min_separation + tolerance (length). None: 1e-6.
        nonzero_toi: never return toi = 0 unless the pair starts within the separation (to rounding).

    Raises:
        TypeError, ValueError: naming the argument.

    Example:
        >>> hit = pgccd.narrow.vertex_face(x0, x1)
        >>> colliding = hit.status != pgccd.Status.FREE
    """
    return _solve(ops.vertex_face, points_t0, points_t1, min_separation, tolerance, nonzero_toi)


def edge_edge(
    points_t0: Tensor,
    points_t1: Tensor,
    min_separation: float | Tensor = 0.0,
    tolerance: float | None = 1e-6,
    nonzero_toi: bool = False,
) -> ElementaryResult:
    """Edge against edge, all four points on straight lines over the step; otherwise like `vertex_face`.

    Args:
        points_t0, points_t1: (n, 4, 3) float32 or float64, positions of ea0, ea1, eb0, eb1 at both ends, any one length
            unit.
        min_separation, tolerance, nonzero_toi: as for `vertex_face`.

    Raises:
        TypeError, ValueError: naming the argument.

    Example:
        >>> hit = pgccd.narrow.edge_edge(x0, x1, min_separation=1e-3)
    """
    return _solve(ops.edge_edge, points_t0, points_t1, min_separation, tolerance, nonzero_toi)


def _solve(
    test: Callable[[Tensor, Tensor, float, float, bool], tuple[Tensor, Tensor, Tensor, Tensor]],
    points_t0: Tensor,
    points_t1: Tensor,
    min_separation: float | Tensor,
    tolerance: float | None,
    nonzero_toi: bool,
) -> ElementaryResult:
    points_t0, points_t1 = _queries(points_t0, points_t1)
    tolerance = _ELEMENTARY_TOLERANCE if tolerance is None else arguments.length(tolerance, "tolerance")
    separation = separation_value(min_separation)
    nonzero_toi = arguments.flag(nonzero_toi, "nonzero_toi")
    found = ElementaryResult(*test(points_t0.detach(), points_t1.detach(), separation, tolerance, nonzero_toi))
    if not any_differentiated(points_t0, points_t1, min_separation):
        return found
    # By the corners of `Corners`.
    corners = [[0, 1, 0], [2, 2, 3]] if test is ops.edge_edge else [[0, 0, 0], [1, 2, 3]]
    start, end = (points.double()[:, corners] for points in (points_t0, points_t1))
    sound = (found.status == Status.TOUCH) & (found.toi > 0.0)
    time = torch.where(sound, found.toi.double(), 0.0)
    velocity = end - start
    at_toi = Corners(
        position=start + time[:, None, None, None] * velocity,
        velocity=velocity.detach(),
        on_edges=torch.full_like(sound, test is ops.edge_edge),
        separation=torch.zeros_like(time) + min_separation,
    )
    expressions = differentiate(at_toi, sound, found.coordinates.double(), None)
    return replace(
        found,
        toi=with_gradient_of(found.toi, expressions.toi, "toi"),
        coordinates=with_gradient_of(found.coordinates, expressions.coordinates, "coordinates"),
        _differentiable=expressions.differentiable,
    )


def check_report(report: SearchReport, collide: str = "pgccd.collide") -> None:
    """Raises TypeError or ValueError unless this is a report of contacts; `collide` is the call that finds pairs."""
    if isinstance(report, str) and report == "any":
        raise ValueError(f'report: "any" finds no contacts: call {collide} to find the pairs that collide')
    arguments.choice(report, "report", CONTACT_REPORTS)


def find_contacts(
    bodies: MovingBodies,
    pairs: Tensor,
    candidates: Tensor,
    report: SearchReport = "first",
    min_separation: float = 0.0,
    tolerance: float | None = None,
    nonzero_toi: bool = False,
) -> ContactRows:
    """Solves candidates and returns the contacts selected by `report`; see `pgccd.detect` for the options.

    Args:
        bodies, pairs: as for `pgccd.traverse.find_candidates`.
        candidates: (C, 4) int32, as returned by `find_candidates`.
        report: as for `pgccd.detect`; or "any": one contact of each pair that collides, not necessarily the first.
        min_separation, tolerance, nonzero_toi: as for `pgccd.detect`.

    Returns:
        Contacts in canonical order: index into `pairs` (K,), kind (K,), features (K, 2), status (K,), toi (K,),
        coordinates (K, 2), point (K, 3), normal (K, 3).

    Raises:
        TypeError, ValueError: naming the argument.

    Example:
        >>> rows = pgccd.narrow.find_contacts(bodies, pairs, candidates, report="all")
    """
    arguments.instance(bodies, "bodies", MovingBodies)
    pairs = check_pairs(pairs, bodies.scene, bodies.deforming)
    candidates = arguments.as_tensor(candidates, "candidates")
    bodies.check()
    check_tensor(candidates, "candidates", torch.int32, ("C", 4), bodies.device)
    require(
        _names_features(bodies, pairs, candidates),
        "candidates: a row refers to a missing pair, kind or feature",
        candidates,
    )
    arguments.choice(report, "report", REPORTS)
    rows = ops.narrow(
        bodies.operands,
        pairs,
        candidates.contiguous(),
        check_separation(min_separation),
        operator_tolerance(tolerance),
        arguments.flag(nonzero_toi, "nonzero_toi"),
        REPORTS[report],
    )
    return take_earliest(rows) if report == "earliest" else rows


def _names_features(bodies: MovingBodies, pairs: Tensor, candidates: Tensor) -> Tensor:
    """Mask of candidates with a valid pair, kind and features."""
    row, kind, *features = (column.long() for column in candidates.unbind(dim=1))
    known = (row >= 0) & (row < len(pairs)) & (kind >= 0) & (kind < len(FEATURES))
    offsets = bodies.scene.meshes.offsets.to(bodies.device)
    counts = offsets[1:] - offsets[:-1]  # vertices, faces, edges
    row, kind = torch.where(known, row, 0), torch.where(known, kind, 0)
    # The column of `counts` that bounds each body's feature index, by kind.
    column = torch.tensor(FEATURES, device=bodies.device)
    for side in (0, 1):
        mesh = bodies.scene.mesh_index[pairs[row, side]].long() if len(pairs) else row
        known = known & (features[side] >= 0) & (features[side] < counts[mesh, column[kind, side]])
    return known


def _queries(points_t0: Tensor, points_t1: Tensor) -> tuple[Tensor, Tensor]:
    points_t0, points_t1 = arguments.real_tensor(points_t0, "points_t0"), arguments.real_tensor(points_t1, "points_t1")
    for name, points in (("points_t0", points_t0), ("points_t1", points_t1)):
        arguments.shape(points, name, ("n", 4, 3))
    if points_t0.dtype != points_t1.dtype:
        raise TypeError(f"points_t1: expected dtype {points_t0.dtype}, got {points_t1.dtype}")
    arguments.shape(points_t1, "points_t1", points_t0.shape, points_t0.device)
    return points_t0.contiguous(), points_t1.contiguous()


def __dir__() -> list[str]:
    return sorted(__all__)
