"""The robot of the nanorobot model: a closed genus-0 mesh of 352 vertices and 700 triangles."""

import numpy as np

from pgccd.geometry.mesh import Mesh

RING_COUNT = 14
RING_SIZE = 25
VERTEX_COUNT = 2 + RING_COUNT * RING_SIZE  #: 352
FACE_COUNT = 2 * RING_COUNT * RING_SIZE  #: 700

_LIMB_COUNT = 5
# Coordinates are rounded to a grid much coarser than the differences between math libraries, so that the robot is the
# same on every machine.
_DECIMALS = 6


def robot_mesh() -> Mesh:
    """A round body with a head, five arms, five legs and a nozzle, SBV radius 1 (to 1e-6); always the same.

    The surface is star-shaped (one distance in every direction from an inner point), so it does not intersect itself.
    Its size, 352 vertices and 700 triangles, is that of the objects of Du, Liu & Suzumura 2017, section 5.

    Example:
        >>> pgccd.sim.robot_mesh()
        Mesh(vertices=352, faces=700, edges=1050, radius=1)
    """
    polar = np.pi * np.arange(1, RING_COUNT + 1) / (RING_COUNT + 1)
    azimuth = 2.0 * np.pi * np.arange(RING_SIZE) / RING_SIZE
    theta, phi = np.meshgrid(polar, azimuth, indexing="ij")
    directions = np.stack([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)], axis=-1)
    rings = _distance(theta, phi)[..., None] * directions
    top, bottom = _distance(np.array([0.0, np.pi]), np.zeros(2))
    vertices = np.concatenate([[[0.0, 0.0, top]], rings.reshape(-1, 3), [[0.0, 0.0, -bottom]]])
    faces = _faces()
    draft = Mesh(vertices, faces, origin="centroid")
    return Mesh(np.round(draft.vertices.numpy() / draft.radius, _DECIMALS), faces, origin="centroid")


def _distance(theta: np.ndarray, phi: np.ndarray) -> np.ndarray:
    """Distance of the surface from the inner point; theta from the head, phi around the body (radians)."""

    def bump(centre: float, width: float) -> np.ndarray:
        return np.exp(-(((theta - centre) / width) ** 2))

    def limbs(shift: float) -> np.ndarray:
        return np.maximum(0.0, np.cos(_LIMB_COUNT * (phi - shift)))

    body = 0.62 + 0.03 * np.cos(2.0 * theta)
    legs = 0.46 * bump(2.15, 0.26) * limbs(0.0)
    arms = 0.24 * bump(1.25, 0.22) * limbs(np.pi / _LIMB_COUNT)
    head = 0.30 * bump(0.0, 0.34)
    collar = -0.06 * bump(0.65, 0.16)
    nozzle = -0.20 * bump(np.pi, 0.45)
    return body + legs + arms + head + collar + nozzle


def _faces() -> np.ndarray:
    """(700, 3): two fans and the quadrilaterals between neighbouring rings, outward orientation."""
    column = np.arange(RING_SIZE)
    following = (column + 1) % RING_SIZE
    first = 1 + RING_SIZE * np.arange(RING_COUNT)[:, None]
    ring, beside = first + column, first + following
    upper, upper_beside, lower, lower_beside = ring[:-1], beside[:-1], ring[1:], beside[1:]
    top, bottom = np.zeros_like(column), np.full_like(column, VERTEX_COUNT - 1)
    parts = [
        np.stack([top, ring[0], beside[0]], axis=-1),
        np.stack([upper, lower, lower_beside], axis=-1).reshape(-1, 3),
        np.stack([upper, lower_beside, upper_beside], axis=-1).reshape(-1, 3),
        np.stack([bottom, beside[-1], ring[-1]], axis=-1),
    ]
    return np.concatenate(parts)
