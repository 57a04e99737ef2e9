"""Gaps between convex bodies by separating axes, in plain NumPy."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Convex:
    """The hull of vertices (V, 3), with the directions (F, 3) of its face normals and (E, 3) of its edges."""

    vertices: np.ndarray
    normals: np.ndarray
    edges: np.ndarray

    @classmethod
    def of_mesh(cls, vertices: np.ndarray, faces: np.ndarray) -> Convex:
        """From the triangles of a convex mesh, or of a single triangle."""
        sides = vertices[np.roll(faces, -1, axis=1)] - vertices[faces]
        return cls(vertices, _directions(np.cross(sides[:, 0], sides[:, 1])), _directions(sides.reshape(-1, 3)))

    def placed(self, axes: np.ndarray, position: np.ndarray) -> Convex:
        """Turned such that `axes` (3, 3) has the body's axes as rows, then moved to `position` (3,)."""
        return Convex(self.vertices @ axes + position, self.normals @ axes, self.edges @ axes)


def _directions(vectors: np.ndarray) -> np.ndarray:
    """Different unit vectors, without their negatives and without null vectors."""
    length = np.linalg.norm(vectors, axis=1)
    unit = vectors[length > 1e-9] / length[length > 1e-9, None]
    largest = np.take_along_axis(unit, np.abs(unit).argmax(axis=1)[:, None], axis=1)
    return np.unique(np.round(unit * np.sign(largest), 12), axis=0)


def gap(a: Convex, b: Convex) -> float:
    """The largest gap along an axis that may separate them: positive if and only if they are disjoint. If some axis
    separates them, others are not tried.
    """
    between = b.vertices.mean(axis=0) - a.vertices.mean(axis=0)
    least = max(_along(a, b, _directions(between[None])), _along(a, b, np.concatenate([a.normals, b.normals])))
    if least > 0.0:
        return least
    return max(least, _along(a, b, _directions(np.cross(a.edges[:, None], b.edges[None]).reshape(-1, 3))))


def _along(a: Convex, b: Convex, axes: np.ndarray) -> float:
    if not len(axes):
        return -np.inf
    on_a, on_b = a.vertices @ axes.T, b.vertices @ axes.T
    return float(np.maximum(on_b.min(axis=0) - on_a.max(axis=0), on_a.min(axis=0) - on_b.max(axis=0)).max())
