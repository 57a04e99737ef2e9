"""Gaps between equal oriented boxes, by separating axes."""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

# Edges whose unit directions have a smaller cross product count as parallel: the axes of faces then suffice.
_PARALLEL = 1e-9


def axes_of(orientation: np.ndarray) -> np.ndarray:
    """Unit quaternions (w, x, y, z) (N, 4) -> (N, 3, 3): the axes of each box, as rows."""
    w, x, y, z = orientation.T
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)],
        [2 * (x * y - w * z), 1 - 2 * (x * x + z * z), 2 * (y * z + w * x)],
        [2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.moveaxis(np.array(rows), 2, 0)


def near_gaps(position: np.ndarray, orientation: np.ndarray, half: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Pairs (P, 2), i < j, of boxes no further apart than their diagonals, and their gaps (P,): the largest distance
    along one of 15 axes by which a plane separates the two. Negative: they overlap, by that much.

    Args:
        position: (N, 3) centres.
        orientation: (N, 4) unit quaternions (w, x, y, z).
        half: (3,) half the edges.
    """
    pairs = cKDTree(position).query_pairs(2.0 * float(np.linalg.norm(half)), output_type="ndarray").reshape(-1, 2)
    ends = [(position[rows], axes_of(orientation)[rows], np.tile(half, (len(rows), 1))) for rows in pairs.T]
    return pairs, gaps(ends[0], ends[1])


Boxes = tuple[np.ndarray, np.ndarray, np.ndarray]


def gaps(first: Boxes, second: Boxes) -> np.ndarray:
    """(P,): as of `near_gaps`, of boxes of any sizes: centres (P, 3), axes (P, 3, 3) as rows, and half edges (P, 3)."""
    (x, a, _), (y, b, _) = first, second
    edges = np.cross(a[:, :, None], b[:, None]).reshape(-1, 9, 3)
    length = np.linalg.norm(edges, axis=2, keepdims=True)
    is_axis = np.concatenate([np.ones((len(x), 6), dtype=bool), length[..., 0] > _PARALLEL], axis=1)
    candidates = np.concatenate([a, b, edges / np.maximum(length, _PARALLEL)], axis=1)  # (pairs, 15, 3)
    distance = np.abs(np.einsum("pkc,pc->pk", candidates, y - x))
    reach = sum(
        np.einsum("pkm,pm->pk", np.abs(np.einsum("pkc,pmc->pkm", candidates, s)), h) for _, s, h in (first, second)
    )
    return np.where(is_axis, distance - reach, -np.inf).max(axis=1)


def least_gap(position: np.ndarray, orientation: np.ndarray, half: np.ndarray) -> float:
    """The smallest of `near_gaps`; inf if there are none."""
    _, gaps = near_gaps(position, orientation, half)
    return float(gaps.min(initial=np.inf))
