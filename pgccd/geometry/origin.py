"""The point of a mesh that poses refer to."""

from typing import Literal

import numpy as np
import numpy.typing as npt
from torch import Tensor

from pgccd import arguments
from pgccd.geometry.solids import has_volume, opening, volumes

#: A point (3,) in the coordinates of the vertices, or the name of such a point.
Origin = npt.ArrayLike | Tensor | Literal["centroid", "center_of_mass"]


def origin_point(origin: Origin, points: np.ndarray, faces: np.ndarray, centre: np.ndarray) -> np.ndarray:
    """The origin, (3,) in the coordinates of the points.

    Args:
        origin: as for `pgccd.Mesh`.
        points: (V, 3).
        faces: (F, 3).
        centre: (3,) the SBV centre.

    Raises:
        ValueError: `origin` is neither a finite point nor a known name, or the surface bounds no solid.
    """
    named = checked_origin(origin)
    if isinstance(named, str):
        return centre.copy() if named == "centroid" else _center_of_mass(points, faces, centre)
    return named


def checked_origin(origin: Origin) -> np.ndarray | str:
    """Validates `origin`: returns the point (3,) or the name.

    Raises:
        TypeError, ValueError: `origin` is neither a finite point nor a known name.
    """
    if isinstance(origin, str) and origin in ("centroid", "center_of_mass"):
        return origin
    return checked_point(origin, "origin", 'a point (3 numbers), "centroid" or "center_of_mass"')


def checked_point(value: npt.ArrayLike | Tensor, name: str, expected: str = "a point (3 numbers)") -> np.ndarray:
    """Validates a point: returns it, (3,).

    Raises:
        TypeError, ValueError: it is not a finite point, naming the argument.
    """
    point = arguments.real_numbers(value, name, expected).cpu().numpy().copy()
    if point.shape != (3,):
        raise ValueError(f"{name}: expected {expected}, got shape {point.shape}")
    if not np.isfinite(point).all():
        raise ValueError(f"{name}: expected {expected}, got {point.tolist()}")
    return point


def _center_of_mass(points: np.ndarray, faces: np.ndarray, centre: np.ndarray) -> np.ndarray:
    """Centre of mass of the solid bounded by the surface, as a sum over tetrahedra with apex `centre`."""
    fault = opening(faces)
    if fault is not None:
        advice = 'origin="center_of_mass" needs a closed, consistently oriented surface'
        raise ValueError(f"origin: {advice}, but {fault}")
    corners = points[faces] - centre
    of_faces = volumes(corners)
    if not (has_volume(of_faces) or has_volume(-of_faces)):
        raise ValueError('origin: origin="center_of_mass" needs a surface around a volume that is not zero')
    return np.asarray(centre + (of_faces[:, None] * corners.sum(axis=1)).sum(axis=0) / (4.0 * of_faces.sum()))
