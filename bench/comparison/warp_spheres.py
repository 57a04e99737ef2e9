"""Swept spheres by NVIDIA Warp's hash grid and bounding volume hierarchy: count, scan, fill, with the exact test in the
kernel. (Needs warp-lang.)
"""

# No postponed annotations here: Warp reads kernel argument types from annotations.
from collections.abc import Callable

import numpy as np
import warp as wp
from support.scenes import MovingSpheres

wp.config.log_level = wp.LOG_ERROR

# The grid and the hierarchy use float32: queries are enlarged slightly so that no pair is lost.
_SLACK = 1e-4


@wp.func
def _meet(
    i: int, j: int, start: wp.array(dtype=wp.vec3d), end: wp.array(dtype=wp.vec3d), radius: wp.array(dtype=wp.float64)
):
    offset = start[j] - start[i]
    travel = (end[j] - end[i]) - offset
    length_squared = wp.dot(travel, travel)
    t = wp.float64(0.0)
    if length_squared > wp.float64(0.0):
        t = wp.clamp(-wp.dot(offset, travel) / length_squared, wp.float64(0.0), wp.float64(1.0))
    nearest = offset + t * travel
    both = radius[i] + radius[j]
    return wp.dot(nearest, nearest) <= both * both


@wp.kernel
def _find_in_grid(
    grid: wp.uint64,
    middle: wp.array(dtype=wp.vec3),
    reach: float,
    start: wp.array(dtype=wp.vec3d),
    end: wp.array(dtype=wp.vec3d),
    radius: wp.array(dtype=wp.float64),
    first: wp.array(dtype=wp.int32),
    fill: wp.bool,
    pairs: wp.array2d(dtype=wp.int32),
):
    i = wp.hash_grid_point_id(grid, wp.tid())
    query = wp.hash_grid_query(grid, middle[i], reach)
    j = int(0)  # noqa: UP018  (to Warp a bare literal is a constant)
    count = int(0)  # noqa: UP018
    while wp.hash_grid_query_next(query, j):
        if j > i and _meet(i, j, start, end, radius):
            if fill:
                pairs[first[i] + count, 0] = i
                pairs[first[i] + count, 1] = j
            count += 1
    if not fill:
        first[i] = count


@wp.kernel
def _find_in_hierarchy(
    hierarchy: wp.uint64,
    lower: wp.array(dtype=wp.vec3),
    upper: wp.array(dtype=wp.vec3),
    start: wp.array(dtype=wp.vec3d),
    end: wp.array(dtype=wp.vec3d),
    radius: wp.array(dtype=wp.float64),
    first: wp.array(dtype=wp.int32),
    fill: wp.bool,
    pairs: wp.array2d(dtype=wp.int32),
):
    i = wp.tid()
    query = wp.bvh_query_aabb(hierarchy, lower[i], upper[i])
    j = int(0)  # noqa: UP018
    count = int(0)  # noqa: UP018
    while wp.bvh_query_next(query, j):
        if j > i and _meet(i, j, start, end, radius):
            if fill:
                pairs[first[i] + count, 0] = i
                pairs[first[i] + count, 1] = j
            count += 1
    if not fill:
        first[i] = count


class _Spheres:
    """A scene in Warp arrays."""

    def __init__(self, scene: MovingSpheres, device: str) -> None:
        self.device = device
        self.count = len(scene.position_t0)
        self.columns = [
            wp.array(scene.position_t0, dtype=wp.vec3d, device=device),
            wp.array(scene.position_t1, dtype=wp.vec3d, device=device),
            wp.array(np.broadcast_to(scene.radius, self.count), dtype=wp.float64, device=device),
        ]

    def find(self, kernel: wp.Kernel, volumes: list[object]) -> wp.array:
        """Pairs (P, 2) that meet."""
        first = wp.empty(self.count, dtype=wp.int32, device=self.device)
        counts = wp.empty(self.count, dtype=wp.int32, device=self.device)
        none = wp.empty((0, 2), dtype=wp.int32, device=self.device)
        wp.launch(kernel, self.count, inputs=[*volumes, *self.columns, counts, False, none], device=self.device)
        wp.utils.array_scan(counts, first, inclusive=False)
        total = int(first[-1:].numpy()[0] + counts[-1:].numpy()[0])
        pairs = wp.empty((total, 2), dtype=wp.int32, device=self.device)
        wp.launch(kernel, self.count, inputs=[*volumes, *self.columns, first, True, pairs], device=self.device)
        wp.synchronize_device(self.device)
        return pairs


def hash_grid(scene: MovingSpheres, device: str) -> Callable[[], wp.array]:
    """Returns a function that builds the grid of the paths' midpoints and finds the pairs."""
    spheres = _Spheres(scene, device)
    travel = scene.position_t1 - scene.position_t0
    middle = wp.array((scene.position_t0 + 0.5 * travel).astype(np.float32), dtype=wp.vec3, device=device)
    reach = 2.0 * float(np.max(scene.radius)) + float(np.linalg.norm(travel, axis=1).max()) + _SLACK
    edge = float((scene.position_t0.max(0) - scene.position_t0.min(0)).max())
    cells = int(np.ceil(edge / reach))
    grid = wp.HashGrid(cells, cells, cells, device=device)

    def find() -> wp.array:
        grid.build(middle, reach)
        return spheres.find(_find_in_grid, [grid.id, middle, reach])

    return find


def bvh(scene: MovingSpheres, device: str) -> Callable[[], wp.array]:
    """Returns a function that builds a hierarchy of the paths' boxes and finds the pairs."""
    spheres = _Spheres(scene, device)
    radius = np.broadcast_to(scene.radius, spheres.count)[:, None] + _SLACK
    ends = (scene.position_t0, scene.position_t1)
    lower = wp.array((np.minimum(*ends) - radius).astype(np.float32), dtype=wp.vec3, device=device)
    upper = wp.array((np.maximum(*ends) + radius).astype(np.float32), dtype=wp.vec3, device=device)

    def find() -> wp.array:
        hierarchy = wp.Bvh(lower, upper)
        return spheres.find(_find_in_hierarchy, [hierarchy.id, lower, upper])

    return find
