"""A small z-buffer renderer in numpy: shaded triangle meshes, many instances, no graphics library."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

# Triangles are drawn as grids of points about a pixel apart, in classes of equal grids.
_FINEST_GRID = 512
_POINTS_AT_ONCE = 1 << 21
_DEPTH_LEVELS = (1 << 32) - 1
_EMPTY = np.uint64(2**64 - 1)


@dataclass(frozen=True)
class Camera:
    """A pinhole camera at `eye` that looks at `target`; `height` is the length seen at the target's distance."""

    eye: np.ndarray
    target: np.ndarray
    height: float
    pixels: tuple[int, int]  #: width, height
    up: tuple[float, float, float] = (0.0, 0.0, 1.0)

    @property
    def axes(self) -> np.ndarray:
        """(3, 3): right, up and backward, as rows."""
        backward = self.eye - self.target
        backward = backward / np.linalg.norm(backward)
        right = np.cross(self.up, backward)
        right = right / np.linalg.norm(right)
        return np.stack([right, np.cross(backward, right), backward])

    def project(self, points: np.ndarray) -> np.ndarray:
        """(..., 3) world -> (..., 3): pixel column, pixel row, depth."""
        local = (points - self.eye) @ self.axes.T
        depth = -local[..., 2]
        focal = np.linalg.norm(self.eye - self.target) * self.pixels[1] / self.height
        scale = focal / np.maximum(depth, 1e-9)
        column = 0.5 * self.pixels[0] + scale * local[..., 0]
        row = 0.5 * self.pixels[1] - scale * local[..., 1]
        return np.stack([column, row, depth], axis=-1)


class Canvas:
    """An image under construction: per pixel the nearest colour.

    Args:
        camera: what is seen.
        background: colour, three numbers in [0, 1].
        haze: how much of the background the farthest point takes on, 0 to 1.
        depth_range: nearest and farthest depth to be drawn.
    """

    def __init__(
        self,
        camera: Camera,
        background: tuple[float, float, float],
        depth_range: tuple[float, float],
        haze: float = 0.0,
    ) -> None:
        self.camera = camera
        self._background = np.asarray(background)
        self._near, self._far = depth_range
        self._haze = haze
        self._nearest = np.full(camera.pixels[0] * camera.pixels[1], _EMPTY, dtype=np.uint64)
        direction = np.array([0.35, 0.75, 0.60]) @ camera.axes  # over the viewer's shoulder
        self._light = direction / np.linalg.norm(direction)

    def draw(self, triangles: np.ndarray, colours: np.ndarray) -> None:
        """Adds triangles (T, 3, 3), counter-clockwise seen from outside, of colours (T, 3) in [0, 1]."""
        normals = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
        area = np.linalg.norm(normals, axis=1)
        facing = np.einsum("tk,tk->t", normals, self.camera.eye - triangles[:, 0]) > 0.0
        corners = self.camera.project(triangles)
        width, height = self.camera.pixels
        low, high = corners.min(axis=1), corners.max(axis=1)
        inside = (high[:, :2] >= 0.0).all(axis=1) & (low[:, 0] < width) & (low[:, 1] < height)
        inside &= (low[:, 2] > self._near) & facing & (area > 0.0)
        corners, normals, colours = corners[inside], normals[inside] / area[inside, None], colours[inside]

        shade = 0.32 + 0.68 * np.maximum(0.0, normals @ self._light)
        haze = self._haze * np.clip((corners[..., 2].mean(axis=1) - self._near) / (self._far - self._near), 0.0, 1.0)
        lit = (1.0 - haze[:, None]) * shade[:, None] * colours + haze[:, None] * self._background
        paint = _pack_colours(lit)
        size = np.ceil((high[inside, :2] - low[inside, :2]).max(axis=1))
        grid = 1
        while grid <= _FINEST_GRID and len(size):
            chosen = (size <= grid) & (size > grid // 2) if grid < _FINEST_GRID else size > grid // 2
            self._splat(corners[chosen], paint[chosen], grid)
            grid *= 2

    def _splat(self, corners: np.ndarray, paint: np.ndarray, grid: int) -> None:
        u, v = (axis.ravel() / grid for axis in np.meshgrid(np.arange(grid + 1), np.arange(grid + 1)))
        weights = np.stack([1.0 - u - v, u, v], axis=-1)[u + v <= 1.0 + 1e-9]
        if grid == 1:
            weights = np.full((1, 3), 1.0 / 3.0)
        width, height = self.camera.pixels
        step = max(1, _POINTS_AT_ONCE // len(weights))
        for begin in range(0, len(corners), step):
            points = np.einsum("pk,tkd->tpd", weights, corners[begin : begin + step])
            column, row = points[..., 0].astype(np.int64), points[..., 1].astype(np.int64)
            seen = (points[..., 0] >= 0) & (column < width) & (points[..., 1] >= 0) & (row < height)
            depth = (points[..., 2] - self._near) / (self._far - self._near)
            level = (np.clip(depth, 0.0, 1.0) * _DEPTH_LEVELS).astype(np.uint64)
            key = (level << np.uint64(32)) | paint[begin : begin + step, None]
            np.minimum.at(self._nearest, (row * width + column)[seen], key[seen])

    def image(self) -> np.ndarray:
        """(height, width, 3) float32 in [0, 1]."""
        width, height = self.camera.pixels
        packed = self._nearest
        colours = np.stack([(packed >> np.uint64(shift)) & np.uint64(255) for shift in (16, 8, 0)], axis=-1) / 255.0
        colours[packed == _EMPTY] = self._background
        return colours.reshape(height, width, 3).astype(np.float32)


def _pack_colours(colours: np.ndarray) -> np.ndarray:
    levels = (np.clip(colours, 0.0, 1.0) * 255.0 + 0.5).astype(np.uint64)
    return (levels[:, 0] << np.uint64(16)) | (levels[:, 1] << np.uint64(8)) | levels[:, 2]


def rotation_matrices(orientation: np.ndarray) -> np.ndarray:
    """(N, 4) unit quaternions (w, x, y, z) -> (N, 3, 3)."""
    w, x, y, z = orientation.T
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.moveaxis(np.array(rows), -1, 0)
