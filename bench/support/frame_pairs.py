"""Two frames of a public simulation (Belgrod et al. 2023), and the true collisions between them, in NumPy files:

scenes/NAME.npz  vertices_t0, vertices_t1 (V, 3), faces (F, 3), edges (E, 2); vf_pairs, ee_pairs (k, 2) and
                 *_collides (k,): all truly colliding pairs, and some free ones
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

import pgccd


@dataclass
class FramePair:
    """One deforming mesh that collides with itself."""

    name: str
    arrays: dict[str, np.ndarray]

    def __post_init__(self) -> None:
        self.mesh = pgccd.Mesh(self.arrays["vertices_t0"], self.arrays["faces"])

    def scene(self, device: str) -> pgccd.Scene:
        """The mesh and the topology of its hierarchy, constant over a simulation."""
        return pgccd.Scene([self.mesh], device=device, self_collision=True)

    def motion(self, device: str) -> pgccd.VertexMotion:
        """Its vertices in both frames, in device memory."""
        return pgccd.VertexMotion(
            *(torch.from_numpy(self.arrays[f"vertices_{end}"]).to(device) for end in ("t0", "t1"))
        )

    def errors(self, hits: pgccd.Contacts) -> dict[str, int]:
        """Numbers of truly colliding pairs missing from contacts with report "all", of contacts not among them, and of
        edges that pass through faces at the start, which are not in the list.
        """
        # Scenes number edges differently from meshes.
        weights = np.array([len(self.arrays["vertices_t0"]), 1])
        both = (self.mesh.edges.long().numpy(), self.arrays["edges"])
        of_mesh, of_scene = (np.sort(edges, axis=1) @ weights for edges in both)
        edge_pairs = np.sort(np.searchsorted(of_mesh, of_scene)[self.arrays["ee_pairs"]], axis=1)
        face_pairs = self.arrays["vf_pairs"][self.arrays["vf_collides"]]
        true = np.concatenate(
            [_keys(pgccd.Kind.VF_AB, face_pairs), _keys(pgccd.Kind.EE, edge_pairs[self.arrays["ee_collides"]])]
        )
        kind = hits.kind.cpu().numpy()
        found, crosses = _keys(kind, hits.features.cpu().numpy()), kind == pgccd.Kind.EF_AB
        missed, extra = np.setdiff1d(true, found), np.setdiff1d(found[~crosses], true)
        return {"true": len(true), "missed": len(missed), "extra": len(extra), "crossings": int(crosses.sum())}


def load(data: Path) -> Iterator[FramePair]:
    """All frame pairs in the subfolder scenes/."""
    for path in sorted(data.glob("scenes/*.npz")):
        with np.load(path) as file:
            yield FramePair(path.stem, dict(file))


def _keys(kind: int | np.ndarray, features: np.ndarray) -> np.ndarray:
    """One int64 key (k,) per feature pair (k, 2)."""
    first, second = features.astype(np.int64).T
    return (np.int64(1) << 60) * kind + (first << 30) + second
