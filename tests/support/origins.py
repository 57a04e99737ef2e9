"""Bodies with arbitrary origins."""

from __future__ import annotations

import numpy as np
import torch

import pgccd
from support.shapes import Bodies, turned

STILL = np.array([1.0, 0.0, 0.0, 0.0])


def beam(breaks: np.ndarray, width: float) -> tuple[np.ndarray, np.ndarray]:
    """A closed square tube along x with rings of vertices at `breaks`, in its own coordinates."""
    half = 0.5 * width
    corners = half * np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]])
    rings = [np.column_stack([np.full(4, x), corners]) for x in breaks]
    faces = []
    for ring in range(len(breaks) - 1):
        for k in range(4):
            a, b = 4 * ring + k, 4 * ring + (k + 1) % 4
            faces += [(a, b, b + 4), (a, b + 4, a + 4)]
    last = 4 * (len(breaks) - 1)
    faces += [(0, 2, 1), (0, 3, 2), (last, last + 1, last + 2), (last, last + 2, last + 3)]
    return np.concatenate(rings), np.array(faces)[:, ::-1]


def about_z(angle: float) -> np.ndarray:
    return np.array([np.cos(angle / 2), 0.0, 0.0, np.sin(angle / 2)])


def recentred(mesh: pgccd.Mesh, origin: np.ndarray | list[float]) -> pgccd.Mesh:
    """The same triangles about another origin, given relative to the old one."""
    return pgccd.Mesh(mesh.vertices, mesh.faces, origin)


def moved_to(bodies: Bodies, origins: list[np.ndarray]) -> Bodies:
    """Each body with another origin (3,), relative to its old one, and its triangles unmoved at t = 1/2."""
    meshes = [recentred(mesh, origin) for mesh, origin in zip(bodies.meshes, origins, strict=True)]
    half_way = np.array([turn_of(0.5 * w) for w in bodies.rotation])
    orientation = np.array([product(h, q) for h, q in zip(half_way, bodies.orientation_t0, strict=True)])
    start = bodies.position_t0 + turned(orientation, np.array(origins))
    return Bodies(meshes, start, bodies.orientation_t0, bodies.velocity, bodies.rotation)


def turn_of(rotation: np.ndarray) -> np.ndarray:
    angle = float(np.linalg.norm(rotation))
    return np.concatenate([[np.cos(angle / 2)], np.sinc(angle / (2 * np.pi)) / 2 * rotation])


def product(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return np.concatenate([[a[0] * b[0] - a[1:] @ b[1:]], a[0] * b[1:] + b[0] * a[1:] + np.cross(a[1:], b[1:])])


def all_contacts(bodies: Bodies, device: torch.device, path: str = "rigid", **options: object) -> pgccd.Contacts:
    scene, motion = bodies.scene(device), bodies.motion(path, device)  # type: ignore[arg-type]
    return pgccd.detect(scene, motion, "all", **options)  # type: ignore[call-overload]
