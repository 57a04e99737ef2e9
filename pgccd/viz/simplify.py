"""Coarser versions of meshes too large for a page."""

import numpy as np

# Bytes of a coordinate triple.
_POINT = 12
_MOST_SHORT = 1 << 16
_ATTEMPTS = 8


def stored_bytes(vertices: int, faces: int, waypoints: int = 0) -> int:
    """Bytes of a mesh; if it deforms, with its vertices at so many waypoints, and joined with others."""
    is_short = waypoints == 0 and vertices <= _MOST_SHORT
    return _POINT * vertices * max(1, waypoints) + faces * (6 if is_short else 12)


def level_within(costs: np.ndarray, budget: float) -> float:
    """The largest L such that the sum of min(cost, L) is within the budget; inf if the sum of all costs is."""
    ordered = np.sort(costs)
    left = float(budget)
    for done, cost in enumerate(ordered.tolist()):
        share = left / (len(ordered) - done)
        if cost > share:
            return share
        left -= cost
    return np.inf


def simplified(
    vertices: np.ndarray, faces: np.ndarray, allowed: float, waypoints: int, keep: np.ndarray
) -> tuple[np.ndarray, np.ndarray, float]:
    """Merges vertices that share a cell of the finest grid with which the mesh fits into `allowed` bytes.

    Args:
        vertices: (V, 3).
        faces: (F, 3).
        allowed, waypoints: see `stored_bytes`.
        keep: row numbers of vertices that are not merged, if these take no more than half of the bytes.

    Returns:
        The rows of `vertices` that are left, faces (f, 3) of these rows, and the longest distance that a vertex was
        moved.
    """
    lower = vertices.min(axis=0)
    extent = float((vertices.max(axis=0) - lower).max()) or 1.0
    place = (vertices - lower) / extent
    if stored_bytes(len(keep), 0, waypoints) > 0.5 * allowed:
        keep = keep[:0]
    cells, best = 64.0, 1
    tried = set()
    for _ in range(_ATTEMPTS):
        count = max(1, int(cells))
        if count in tried:
            break
        tried.add(count)
        rows, _, left = _clustered(place, faces, count, keep)
        size = stored_bytes(len(rows), len(left), waypoints)
        if size <= allowed:
            best = max(best, count)
        if 0.85 * allowed <= size <= allowed or (size <= allowed and count >= _MOST_SHORT):
            break
        # A surface has about cells^2 vertices.
        cells = min(count * (0.95 * allowed / max(size, 1)) ** 0.5, _MOST_SHORT)
    rows, moved, left = _clustered(place, faces, best, keep)
    return rows, left, moved * extent


def _clustered(
    place: np.ndarray, faces: np.ndarray, cells: int, keep: np.ndarray
) -> tuple[np.ndarray, float, np.ndarray]:
    """The vertices (rows) that stand for the used cells of a grid, the largest distance of a vertex from the one that
    stands for it, and the faces between them. place: (V, 3) in [0, 1].
    """
    cell = np.minimum((place * cells).astype(np.int64), cells - 1)
    key = (cell[:, 0] * cells + cell[:, 1]) * cells + cell[:, 2]
    key[keep] = cells**3 + np.arange(len(keep))
    _, first, cluster = np.unique(key, return_index=True, return_inverse=True)
    cornered = cluster.reshape(-1)[faces]
    a, b, c = cornered.T
    cornered = cornered[(a != b) & (b != c) & (c != a)]
    moved = float(np.sqrt(((place - place[first[cluster.reshape(-1)]]) ** 2).sum(axis=1).max()))
    used, compact = np.unique(cornered, return_inverse=True)
    return first[used], moved, compact.reshape(-1, 3)
