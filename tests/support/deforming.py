"""Random deforming bodies, and comparison of their contacts."""

from __future__ import annotations

import numpy as np
import torch

import pgccd
from support.shapes import approaching, tensors

#: Vertices of a body at t0 and at t1.
Ends = list[np.ndarray]


def motion_of(*bodies: Ends, device: torch.device) -> pgccd.VertexMotion:
    """Motion of the bodies, concatenated."""
    return pgccd.VertexMotion(*tensors(*(np.concatenate([e[t] for e in bodies]) for t in (0, 1)), device=device))


def noisy(rng: np.random.Generator, vertices: np.ndarray, size: float) -> np.ndarray:
    """The vertices with normally distributed noise added."""
    return vertices + size * rng.normal(size=vertices.shape)


def crumpled(count: int, seed: int = 9) -> tuple[list[pgccd.Mesh], list[Ends]]:
    """Strongly deforming bodies that meet one another."""
    rng = np.random.default_rng(seed)
    bodies = approaching(rng, (1,) * count, tuple(rng.uniform(0.5, 1.5, count)), closeness=0.9)
    ends = [
        [noisy(rng, m.vertices.numpy() + x[k], 0.4) for x in (bodies.position_t0, bodies.position_t1)]
        for k, m in enumerate(bodies.meshes)
    ]
    return bodies.meshes, ends
