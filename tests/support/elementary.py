"""Elementary queries through the library and through the oracle, compared in both directions."""

from __future__ import annotations

from fractions import Fraction

import numpy as np
import torch
from oracle import distance, linear, separation
from oracle.linear import Hit

import pgccd

UNIT = {torch.float32: Fraction(1, 2**24), torch.float64: Fraction(1, 2**53)}


def solve(
    start: np.ndarray,
    end: np.ndarray,
    is_face: bool,
    min_separation: float = 0.0,
    tolerance: float = 1e-6,
    nonzero_toi: bool = False,
    device: torch.device | str = "cpu",
    dtype: torch.dtype = torch.float64,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Status, toi and coordinates for points (n, 4, 3) at both ends that are exact in `dtype`."""
    points = [torch.tensor(x, dtype=dtype, device=device) for x in (start, end)]
    test = pgccd.narrow.vertex_face if is_face else pgccd.narrow.edge_edge
    found = test(*points, min_separation, tolerance, nonzero_toi)
    return found.status.cpu().numpy(), found.toi.double().cpu().numpy(), found.coordinates.double().cpu().numpy()


def truth(start: np.ndarray, end: np.ndarray, is_face: bool, min_separation: float = 0.0) -> list[Hit | None]:
    """First touch of each query, exactly; None if the features do not touch."""
    if min_separation:
        return separation.within_many(start, end, min_separation, is_face)
    return (linear.vertex_face_many if is_face else linear.edge_edge_many)(start, end)


def rounding(start: np.ndarray, end: np.ndarray, dtype: torch.dtype = torch.float64) -> Fraction:
    """Allowed error of the distance at a toi of that precision for one query (4, 3): some units of its size's ulp."""
    units = 256 if dtype == torch.float64 else 16
    return units * UNIT[dtype] * Fraction(float(max(np.ptp(start, axis=0).max(), np.ptp(end, axis=0).max())))


def check(
    start: np.ndarray,
    end: np.ndarray,
    is_face: bool,
    min_separation: float = 0.0,
    tolerance: float = 1e-6,
    nonzero_toi: bool = False,
    most_unresolved: float = 0.02,
    device: torch.device | str = "cpu",
    dtype: torch.dtype = torch.float64,
) -> int:
    """Checks the contract of elementary tests query by query. Returns the number of true contacts."""
    status, toi, coordinates = solve(start, end, is_face, min_separation, tolerance, nonzero_toi, device, dtype)
    assert set(status.tolist()) <= {pgccd.Status.FREE, pgccd.Status.TOUCH, pgccd.Status.UNRESOLVED}
    assert np.isinf(toi[status == pgccd.Status.FREE]).all()
    assert ((toi >= 0) & (toi <= 1))[status != pgccd.Status.FREE].all()
    hits = truth(start, end, is_face, min_separation)
    for k, hit in enumerate(hits):
        if hit is not None:
            assert status[k] != pgccd.Status.FREE, f"query {k}: missed"
            assert Fraction(toi[k]) <= hit.toi_upper, f"query {k}: late"
    reach = Fraction(min_separation) + Fraction(tolerance)
    for k in np.flatnonzero(status == pgccd.Status.TOUCH):
        allowed = reach + rounding(start[k], end[k], dtype)
        square = distance.squared_distance_exact(start[k], end[k], Fraction(toi[k]), is_face)
        assert square <= allowed * allowed, f"query {k}: reported at a distance of {float(square) ** 0.5}"
        _check_coordinates(start[k], end[k], toi[k], coordinates[k], is_face, float(allowed), UNIT[dtype], f"query {k}")
    assert (status == pgccd.Status.UNRESOLVED).sum() <= most_unresolved * len(status), "too many unresolved"
    return sum(hit is not None for hit in hits)


def _check_coordinates(
    start: np.ndarray,
    end: np.ndarray,
    toi: float,
    at: np.ndarray,
    is_face: bool,
    allowed: float,
    unit: Fraction,
    name: str,
) -> None:
    u, v = at
    assert u >= 0 and v >= 0 and (u + v if is_face else max(u, v)) <= 1 + 4 * unit, f"{name}: coordinates {at}"
    x = (1 - toi) * (start - start[0]) + toi * (end - end[0])
    gap = np.linalg.norm(distance.gap_vector(x[None], at[None], is_face))
    assert gap <= allowed * (1 + 1e-9), f"{name}: the coordinates name points {gap} apart"
