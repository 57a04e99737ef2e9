"""Closed surfaces, and the solids that they bound."""

from typing import Literal

import numpy as np

from pgccd import arguments

#: Whether the inside of a surface belongs to a body; "auto": if the surface is closed and faces outwards.
Solid = bool | Literal["auto"]


def opening(faces: np.ndarray) -> str | None:
    """Why a surface bounds no solid, or None if it is closed and consistently oriented: each edge is shared by exactly
    two triangles, in opposite directions.

    Args:
        faces: (F, 3) vertex indices.
    """
    if (faces[:, 1] == faces[:, 2]).any():
        return "the mesh has segments or points"
    edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]).astype(np.int64)
    base = int(edges.max()) + 1
    directed = edges[:, 0] * base + edges[:, 1]
    names, counts = np.unique(directed, return_counts=True)
    if (counts > 1).any():
        a, b = divmod(int(names[np.argmax(counts > 1)]), base)
        return f"more than one triangle passes from vertex {a} to vertex {b}"
    is_open = ~np.isin(edges[:, 1] * base + edges[:, 0], directed)
    if is_open.any():
        a, b = edges[np.argmax(is_open)].tolist()
        return f"no triangle passes from vertex {b} to vertex {a}"
    return None


def is_solid(solid: Solid, points: np.ndarray, faces: np.ndarray) -> bool:
    """Whether a mesh is a solid.

    Args:
        solid: as for `pgccd.Mesh`.
        points: (V, 3).
        faces: (F, 3).

    Raises:
        TypeError: `solid` is neither a bool nor "auto".
        ValueError: it is True, and the surface is not closed or not consistently oriented.
    """
    if isinstance(solid, str) and solid == "auto":
        return opening(faces) is None and has_volume(volumes(points[faces] - points[faces[0, 0]]))
    if not arguments.flag(solid, "solid", 'True, False or "auto"'):
        return False
    fault = opening(faces)
    if fault is not None:
        raise ValueError(f"solid: solid=True needs a closed, consistently oriented surface, but {fault}")
    return True


def volumes(corners: np.ndarray) -> np.ndarray:
    """(F,) six times the signed volumes of the tetrahedra of the origin and triangles with corners (F, 3, 3)."""
    return np.einsum("fk,fk->f", corners[:, 0], np.cross(corners[:, 1], corners[:, 2]))


def has_volume(of_faces: np.ndarray) -> bool:
    """Whether the sum of `volumes` is certainly > 0."""
    return float(of_faces.sum()) > 1e-12 * float(np.abs(of_faces).sum())


def vertices_of_components(faces: np.ndarray) -> np.ndarray:
    """(C,) the smallest vertex of each connected component of faces (F, 3); vertices in common connect faces."""
    label = np.arange(int(faces.max()) + 1)
    while True:
        least = label[faces].min(axis=1)
        lower = label.copy()
        np.minimum.at(lower, faces, least[:, None])
        lower = lower[lower]  # halves the length of chains
        if np.array_equal(lower, label):
            return np.unique(label[faces])
        label = lower
