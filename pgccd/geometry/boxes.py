"""Boxes around meshes that fill little of their SBV: rods, beams, plates."""

import math

import numpy as np

from pgccd.geometry.elements import used

# A mesh has a box if, in random poses, the boxes of two such bodies meet this much more rarely than their SBVs.
_FEWEST_SPHERES = 4.0
# The first boxes tried are at most about this much larger than the best one.
_ROUGHLY = 2.0
# Number of turns of a box that are tried about each of its axes, within a quarter of a revolution.
_TURNS = 16
# So many points choose the axes of a mesh well enough.
_MANY = 1 << 14
# More than the rounding of projections, in SBV radii.
_ROUNDING = 1e-12


def elongated_box(points: np.ndarray, faces: np.ndarray, radius: float) -> np.ndarray | None:
    """A box around the used vertices of a mesh, or None if the mesh fills much of its SBV.

    Args:
        points: (V, 3) float64, relative to the SBV centre.
        faces: (F, 3) integers.
        radius: of the SBV.

    Returns:
        (4, 3) float64: the centre of the box, and half of its edges, the longest first; or None.
    """
    everything = np.ascontiguousarray(used(points, faces).T) / radius
    # The axes are chosen by a part of a large mesh.
    x = np.ascontiguousarray(everything[:, :: 1 + everything.shape[1] // _MANY])
    faces = faces[:: 1 + len(faces) // _MANY]
    spheres = 32.0 / 3.0 * math.pi  # the volume in which the centre of a second SBV is if both overlap
    tried = [np.eye(3), _principal_axes(_covariance_of_points(x))]
    best = min(tried, key=lambda axes: _volume_of_meeting(x, axes))
    if spheres < _FEWEST_SPHERES / _ROUGHLY * _volume_of_meeting(x, best):
        return None
    of_surface = _principal_axes(_covariance(points / radius, faces))
    best = min((best, of_surface), key=lambda axes: _volume_of_meeting(x, axes))
    turned = [best, *(_turned(best, k, n) for k in range(3) for n in range(1, _TURNS))]
    best = min(turned, key=lambda axes: _volume_of_meeting(x, axes))
    if spheres < _FEWEST_SPHERES * _volume_of_meeting(x, best):
        return None
    if x.shape != everything.shape and spheres < _FEWEST_SPHERES * _volume_of_meeting(everything, best):
        return None
    lower, upper = _bounds(everything, best)
    half = (0.5 * (upper - lower) * (1.0 + _ROUNDING) + _ROUNDING)[:, None] * best
    longest_first = np.argsort(-(upper - lower), kind="stable")
    return radius * np.vstack([0.5 * (lower + upper) @ best, half[longest_first]])


def _bounds(x: np.ndarray, axes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Of points (3, V) along three axes, the rows of a matrix."""
    along = axes @ x
    return along.min(axis=1), along.max(axis=1)


def _volume_of_meeting(x: np.ndarray, axes: np.ndarray) -> float:
    """The volume in which the centre of a second box of this size is if both meet, the mean over all its orientations:
    2 V + S M / (2 pi), with volume V, surface S, and integral of mean curvature M (kinematic formula of Blaschke).
    """
    lower, upper = _bounds(x, axes)
    a, b, c = (0.5 * (upper - lower)).tolist()
    return 16.0 * a * b * c + 8.0 * (a * b + b * c + c * a) * (a + b + c)


def _principal_axes(covariance: np.ndarray) -> np.ndarray:
    return np.ascontiguousarray(np.linalg.eigh(covariance)[1].T)


def _covariance_of_points(x: np.ndarray) -> np.ndarray:
    mean = x.mean(axis=1)
    return x @ x.T / x.shape[1] - np.outer(mean, mean)


def _covariance(points: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Of the surface, whatever its tessellation."""
    corners = points[faces]
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    if not area.sum() > 0.0:
        return _covariance_of_points(corners.reshape(-1, 3).T)
    weight = area / area.sum()
    total = corners.sum(axis=1)
    mean = weight @ total / 3.0
    second = np.einsum("f,fci,fcj->ij", weight, corners, corners) + np.einsum("f,fi,fj->ij", weight, total, total)
    return second / 12.0 - np.outer(mean, mean)


def _turned(axes: np.ndarray, about: int, turn: int) -> np.ndarray:
    angle = 0.5 * math.pi * turn / _TURNS
    turned = axes.copy()
    first, second = axes[(about + 1) % 3], axes[(about + 2) % 3]
    turned[(about + 1) % 3] = math.cos(angle) * first + math.sin(angle) * second
    turned[(about + 2) % 3] = math.cos(angle) * second - math.sin(angle) * first
    return turned
