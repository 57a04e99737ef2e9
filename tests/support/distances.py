"""Distances of moving bodies by sampling their paths."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from fractions import Fraction

import numpy as np
import torch
from oracle.surfaces import boundary_distance, squared_distance_exact
from torch import Tensor

import pgccd

VerticesAt = Callable[[float], np.ndarray]


@dataclass
class Moving:
    """Rigid bodies, each on its path: positions (N, 3) at both ends, orientations (N, 4), rotation vectors (N, 3)."""

    meshes: list[pgccd.Mesh]
    start: np.ndarray
    orientation: np.ndarray
    end: np.ndarray
    rotation: np.ndarray
    path: str = "rigid"
    margin: np.ndarray | None = None

    def scene(self, device: torch.device | str = "cpu") -> pgccd.Scene:
        margin = None if self.margin is None else torch.tensor(self.margin)
        return pgccd.Scene(self.meshes, torch.arange(len(self.meshes)), device, margin=margin)

    def motion(self, device: torch.device | str = "cpu") -> pgccd.RigidMotion:
        columns = (self.start, self.orientation, self.end, self.rotation)
        return pgccd.RigidMotion.from_rotation(*(torch.tensor(x, device=device) for x in columns), self.path)  # type: ignore[arg-type]

    def distance(self, device: torch.device | str = "cpu", **options: object) -> pgccd.Distances:
        options.setdefault("pairs", torch.combinations(torch.arange(len(self.meshes), device=device)))
        return pgccd.distance(self.scene(device), self.motion(device), **options)  # type: ignore[arg-type]

    def vertices_at(self, body: int, t: float) -> np.ndarray:
        """(V, 3) by Rodrigues' formula."""
        q, w = self.orientation[body], self.rotation[body]
        placed = turned(q / np.linalg.norm(q), self.meshes[body].vertices.numpy())
        position = (1 - t) * self.start[body] + t * self.end[body]
        if self.path == "linear":
            return position + (1 - t) * placed + t * _rotated(w, placed)
        return position + _rotated(t * w, placed)

    def truth(self, pair: Sequence[int], samples: int = 33) -> float:
        """The least distance of a pair at many times, without margins; of surfaces that do not pass through."""
        return least_distance(
            [lambda t, body=body: self.vertices_at(body, t) for body in pair],
            [self.meshes[body].faces.numpy() for body in pair],
            samples,
        )


def turned(q: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Points (n, 3) turned by a unit quaternion (4,)."""
    v = np.broadcast_to(q[1:], points.shape)
    return points + 2 * np.cross(v, np.cross(v, points) + q[0] * points)


def _rotated(w: np.ndarray, points: np.ndarray) -> np.ndarray:
    angle = float(np.linalg.norm(w))
    if angle == 0.0:
        return points
    axis = np.broadcast_to(w / angle, points.shape)
    side = np.cross(axis, points)
    return points + np.sin(angle) * side + 2 * np.sin(angle / 2) ** 2 * np.cross(axis, side)


def least_distance(at: Sequence[VerticesAt], faces: Sequence[np.ndarray], samples: int = 33) -> float:
    """The least distance at many times, refined about the best one."""

    def distance_at(t: float) -> float:
        return boundary_distance(at[0](t), faces[0], at[1](t), faces[1])

    times = np.linspace(0.0, 1.0, samples)
    values = np.array([distance_at(t) for t in times])
    best = float(values.min())
    middle, step = float(times[values.argmin()]), 1.0 / (samples - 1)
    for _ in range(14):
        near = np.clip(middle + step * np.linspace(-1, 1, 5), 0.0, 1.0)
        found = [distance_at(t) for t in near]
        middle, step = float(near[int(np.argmin(found))]), step / 2
        best = min(best, min(found))
    return best


def exact_vertices(mesh: pgccd.Mesh, position: np.ndarray, orientation: np.ndarray) -> np.ndarray:
    """(V, 3) of a body at rest, as fractions: a quaternion of any length names a rotation."""
    w, x, y, z = (Fraction(float(c)) for c in orientation)
    rows = [
        [w * w + x * x - y * y - z * z, 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), w * w - x * x + y * y - z * z, 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), w * w - x * x - y * y + z * z],
    ]
    turn = np.array(rows, dtype=object) / (w * w + x * x + y * y + z * z)
    as_fractions = np.vectorize(Fraction, otypes=[object])
    return as_fractions(mesh.vertices.numpy()) @ turn.T + as_fractions(position)


def assert_bounds_exactly(found: pgccd.Distances, bodies: Moving) -> None:
    """Asserts that the bounds of bodies at rest, without margins, enclose the exact distances."""
    for row, (i, j) in enumerate(found.pairs.tolist()):
        x, y = (exact_vertices(bodies.meshes[b], bodies.start[b], bodies.orientation[b]) for b in (i, j))
        squared = squared_distance_exact(x, bodies.meshes[i].faces.numpy(), y, bodies.meshes[j].faces.numpy())
        lower, upper = Fraction(found.lower[row].item()), Fraction(found.upper[row].item())
        assert lower * lower <= squared <= upper * upper, (i, j, float(lower), float(squared) ** 0.5, float(upper))


def columns_of(found: pgccd.Distances) -> dict[str, Tensor]:
    """The columns, on the CPU."""
    return {name: column.cpu() for name, column in vars(found).items()}
