"""Swept spheres by NVIDIA Warp's hash grid: count, scan, fill, with the exact test inside the kernel. (Needs warp-
lang.)
"""

# No postponed annotations here: Warp reads the kernels' argument types from them.
from collections.abc import Callable

import numpy as np
import warp as wp

from support.scenes import MovingSpheres

wp.config.log_level = wp.LOG_ERROR

# Centres are float32 in the grid, and a little further out are asked for, so that none is lost.
_SLACK = 1e-4


@wp.kernel
def _find(
    grid: wp.uint64,
    middle: wp.array(dtype=wp.vec3),
    start: wp.array(dtype=wp.vec3d),
    end: wp.array(dtype=wp.vec3d),
    reach: float,
    diameter: wp.float64,
    first: wp.array(dtype=wp.int32),
    fill: wp.bool,
    pairs: wp.array2d(dtype=wp.int32),
):
    i = wp.hash_grid_point_id(grid, wp.tid())
    query = wp.hash_grid_query(grid, middle[i], reach)
    j = int(0)  # noqa: UP018  (to Warp a bare literal is a constant)
    count = int(0)  # noqa: UP018
    while wp.hash_grid_query_next(query, j):
        if j > i:
            offset = start[j] - start[i]
            travel = (end[j] - end[i]) - offset
            length_squared = wp.dot(travel, travel)
            t = wp.float64(0.0)
            if length_squared > wp.float64(0.0):
                t = wp.clamp(-wp.dot(offset, travel) / length_squared, wp.float64(0.0), wp.float64(1.0))
            nearest = offset + t * travel
            if wp.dot(nearest, nearest) <= diameter * diameter:
                if fill:
                    pairs[first[i] + count, 0] = i
                    pairs[first[i] + count, 1] = j
                count += 1
    if not fill:
        first[i] = count


def prepare(scene: MovingSpheres) -> Callable[[], np.ndarray]:
    """Puts one scene into Warp's arrays; the returned call builds the grid and finds the pairs."""
    count = len(scene.position_t0)
    travel = scene.position_t1 - scene.position_t0
    middle = wp.array((scene.position_t0 + 0.5 * travel).astype(np.float32), dtype=wp.vec3, device="cpu")
    start = wp.array(scene.position_t0, dtype=wp.vec3d, device="cpu")
    end = wp.array(scene.position_t1, dtype=wp.vec3d, device="cpu")
    reach = 2.0 * scene.radius + float(np.linalg.norm(travel, axis=1).max()) + _SLACK
    edge = float((scene.position_t0.max(0) - scene.position_t0.min(0)).max())
    cells = int(np.ceil(edge / reach))
    grid = wp.HashGrid(cells, cells, cells, device="cpu")
    none = wp.empty((0, 2), dtype=wp.int32, device="cpu")

    def find() -> np.ndarray:
        grid.build(middle, reach)
        counts = wp.empty(count, dtype=wp.int32, device="cpu")
        first = wp.empty(count, dtype=wp.int32, device="cpu")
        shared = [grid.id, middle, start, end, reach, 2.0 * scene.radius]
        wp.launch(_find, dim=count, inputs=[*shared, counts, False, none], device="cpu")
        wp.utils.array_scan(counts, first, inclusive=False)
        total = int(first.numpy()[-1] + counts.numpy()[-1]) if count else 0
        pairs = wp.empty((total, 2), dtype=wp.int32, device="cpu")
        wp.launch(_find, dim=count, inputs=[*shared, first, True, pairs], device="cpu")
        return pairs.numpy()

    return find
