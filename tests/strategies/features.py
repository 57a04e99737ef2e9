"""Elementary queries on a coarse grid, where coincident points, flat faces and exact touches are common."""

from __future__ import annotations

import numpy as np
from hypothesis import strategies as st


def _grid(extent: int) -> st.SearchStrategy[np.ndarray]:
    number = st.integers(-extent, extent)
    return st.lists(number, min_size=12, max_size=12).map(lambda c: np.array(c, dtype=np.float64).reshape(4, 3))


@st.composite
def feature_motions(draw: st.DrawFn, extent: int = 4) -> tuple[np.ndarray, np.ndarray]:
    """Points (4, 3) at t0 and at t1: small integers times a power of two."""
    factor = 2.0 ** draw(st.sampled_from([0, -3, 20, -40]))
    return draw(_grid(extent)) * factor, draw(_grid(extent)) * factor


@st.composite
def degenerate_features(draw: st.DrawFn, extent: int = 3) -> tuple[np.ndarray, np.ndarray]:
    """Degenerate queries: coincident points, all in one plane or line, or without motion."""
    start, end = draw(feature_motions(extent))
    kinds = draw(st.sets(st.sampled_from(["coincide", "plane", "line", "still", "together"]), min_size=1, max_size=2))
    if "coincide" in kinds:
        i, j = draw(st.integers(0, 3)), draw(st.integers(0, 3))
        start[i], end[i] = start[j], end[j]
    if "plane" in kinds or "line" in kinds:
        start[:, 2] = end[:, 2] = 0.0
    if "line" in kinds:
        start[:, 1] = end[:, 1] = 0.0
    if "still" in kinds:
        end = start.copy()
    if "together" in kinds:
        end = start + (end[0] - start[0])
    return start, end
