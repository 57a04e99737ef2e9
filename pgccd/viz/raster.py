"""A small z-buffer renderer in NumPy: shaded triangle meshes, many instances, no graphics library."""

from dataclasses import dataclass

import numpy as np

# Small triangles are drawn as grids of points at most a pixel apart, grouped by grid size; others pixel by pixel.
_FINEST_GRID = 32
_POINTS_AT_ONCE = 1 << 21
_DEPTH_LEVELS = float((1 << 24) - 1)  # exact in float32
_EMPTY = np.uint64(2**64 - 1)


@dataclass(frozen=True)
class Camera:
    """A pinhole camera at `eye` directed at `target`; `height` is the length seen at the target's distance."""

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
        camera: the view.
        background: colour, three numbers in [0, 1].
        depth_range: nearest and farthest depth to be drawn.
        window: column, row, radius and depth: within this circle of pixels nothing nearer is drawn.
    """

    def __init__(
        self,
        camera: Camera,
        background: tuple[float, float, float],
        depth_range: tuple[float, float],
        window: tuple[float, float, float, float] | None = None,
    ) -> None:
        self.window = window
        self.camera = camera
        self._background = np.asarray(background)
        self._near, self._far = depth_range
        self._nearest = np.full(camera.pixels[0] * camera.pixels[1], _EMPTY, dtype=np.uint64)
        direction = np.array([0.35, 0.75, 0.60]) @ camera.axes  # from behind the viewer's shoulder
        self._light = direction / np.linalg.norm(direction)

    def draw(
        self, vertices: np.ndarray, faces: np.ndarray, colours: np.ndarray, haze: np.ndarray | float = 0.0
    ) -> None:
        """Adds faces (T, 3), counter-clockwise seen from outside, of vertices (V, 3), in colours (T, 3) in [0, 1].

        haze: fraction of the background colour blended into the farthest points, 0 to 1; one value or (T,).
        """
        projected = self.camera.project(vertices).astype(np.float32)
        x, y, depth = (projected[faces, axis] for axis in range(3))
        left, right = _smallest(x), -_smallest(-x)
        top, bottom = _smallest(y), -_smallest(-y)
        width, height = self.camera.pixels
        # Rows count downwards, so faces that are counter-clockwise in the world have a negative area here.
        facing = (x[:, 1] - x[:, 0]) * (y[:, 2] - y[:, 0]) < (x[:, 2] - x[:, 0]) * (y[:, 1] - y[:, 0])
        inside = facing & (right >= 0.0) & (left < width) & (bottom >= 0.0) & (top < height)
        inside &= _smallest(depth) > self._near
        size = np.ceil(np.maximum(right - left, bottom - top)[inside])
        corners = projected[faces[inside]]

        a, b, c = np.moveaxis(vertices[faces[inside]], 1, 0)
        normals = np.cross(b - a, c - a)
        # Faces without area, which rounding turns to the camera, have no normal.
        size_of_normals = np.maximum(np.linalg.norm(normals, axis=1), 1e-300)
        shade = 0.45 + 0.55 * np.maximum(0.0, normals @ self._light) / size_of_normals
        distance = (corners[:, 0, 2] - self._near) / (self._far - self._near)
        veil = np.broadcast_to(haze, len(faces))[inside] * np.clip(distance, 0.0, 1.0)
        lit = ((1.0 - veil) * shade)[:, None] * colours[inside] + veil[:, None] * self._background
        paint = _pack_colours(lit)
        is_small = size <= _FINEST_GRID
        grids = np.where(is_small, 2 ** np.ceil(np.log2(np.maximum(size, 1.0))), 0.0).astype(np.int64)
        for grid in np.unique(grids[is_small]):
            self._splat(corners[grids == grid], paint[grids == grid], grid)
        for triangle in np.flatnonzero(~is_small):
            self._fill(corners[triangle], paint[triangle])

    def _splat(self, corners: np.ndarray, paint: np.ndarray, grid: int) -> None:
        u, v = (axis.ravel() / grid for axis in np.meshgrid(np.arange(grid + 1), np.arange(grid + 1)))
        weights = np.stack([1.0 - u - v, u, v], axis=-1)[u + v <= 1.0 + 1e-9]
        if grid == 1:
            weights = np.full((1, 3), 1.0 / 3.0)
        weights = weights.astype(np.float32)
        step = max(1, _POINTS_AT_ONCE // len(weights))
        for begin in range(0, len(corners), step):
            column, row, depth = np.moveaxis(weights @ corners[begin : begin + step], -1, 0)
            colour = np.broadcast_to(paint[begin : begin + step, None], column.shape)
            self._put(column.ravel(), row.ravel(), depth.ravel(), colour.ravel())

    def _fill(self, corners: np.ndarray, paint: np.uint64) -> None:
        """Draws the pixels of the picture whose centres are inside the triangle."""
        low = np.maximum(np.floor(corners[:, :2].min(axis=0)), 0.0)
        high = np.minimum(np.ceil(corners[:, :2].max(axis=0)), np.array(self.camera.pixels))
        column, row = (
            axis.ravel() + 0.5 for axis in np.meshgrid(*(np.arange(a, b) for a, b in zip(low, high, strict=True)))
        )
        (x0, y0), (x1, y1), (x2, y2) = corners[:, :2]
        double_area = (x1 - x0) * (y2 - y0) - (x2 - x0) * (y1 - y0)  # not 0, since the triangle faces the camera
        u = ((column - x0) * (y2 - y0) - (x2 - x0) * (row - y0)) / double_area
        v = ((x1 - x0) * (row - y0) - (column - x0) * (y1 - y0)) / double_area
        inside = (u >= 0.0) & (v >= 0.0) & (u + v <= 1.0)
        depth = corners[0, 2] + u * (corners[1, 2] - corners[0, 2]) + v * (corners[2, 2] - corners[0, 2])
        self._put(column[inside], row[inside], depth[inside], np.broadcast_to(paint, inside.sum()))

    def _put(self, column: np.ndarray, row: np.ndarray, depth: np.ndarray, paint: np.ndarray) -> None:
        width, height = self.camera.pixels
        seen = (column >= 0) & (column < width) & (row >= 0) & (row < height)
        if self.window is not None:
            middle, height_of_middle, radius, before = self.window
            is_within = (column - middle) ** 2 + (row - height_of_middle) ** 2 < radius**2
            seen &= ~(is_within & (depth < before))
        level = np.clip((depth[seen] - self._near) / (self._far - self._near), 0.0, 1.0) * _DEPTH_LEVELS
        key = (level.astype(np.uint64) << np.uint64(24)) | paint[seen]
        np.minimum.at(self._nearest, row[seen].astype(np.int64) * width + column[seen].astype(np.int64), key)

    def image(self) -> np.ndarray:
        """(height, width, 3) float32 in [0, 1]."""
        width, height = self.camera.pixels
        packed = self._nearest
        colours = np.stack([(packed >> np.uint64(shift)) & np.uint64(255) for shift in (16, 8, 0)], axis=-1) / 255.0
        colours[packed == _EMPTY] = self._background
        return colours.reshape(height, width, 3).astype(np.float32)


def _smallest(columns: np.ndarray) -> np.ndarray:
    """(T, 3) -> (T,): row minimum, much faster than min over a short axis."""
    return np.minimum(np.minimum(columns[:, 0], columns[:, 1]), columns[:, 2])


def _pack_colours(colours: np.ndarray) -> np.ndarray:
    levels = (np.clip(colours, 0.0, 1.0) * 255.0 + 0.5).astype(np.uint64)
    return (levels[:, 0] << np.uint64(16)) | (levels[:, 1] << np.uint64(8)) | levels[:, 2]


def placed(points: np.ndarray, position: np.ndarray, orientation: np.ndarray) -> np.ndarray:
    """(N, V, 3) world: points (V, 3) of a body in N poses, positions (N, 3) and quaternions (w, x, y, z) (N, 4)."""
    w, x, y, z = orientation.T
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.einsum("ijb,vj->bvi", np.array(rows), points) + position[:, None]
