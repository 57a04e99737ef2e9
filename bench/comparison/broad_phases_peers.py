"""Other broad phases for swept spheres.

A peer prepares a scene in its own form and returns a function that finds the pairs (timed) and returns a function to
read them as an array (not timed). The caller removes excess pairs, whose boxes overlap but whose spheres do not meet.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
from support import peers
from support.scenes import MovingSpheres

from comparison.program import Program

ReadPairs = Callable[[], np.ndarray]
FindPairs = Callable[[], ReadPairs]
Prepare = Callable[[MovingSpheres], FindPairs]


def available(device: str) -> dict[Program, Prepare]:
    """The available broad phases; on a GPU only those that run there."""
    found: dict[Program, Prepare] = {}
    if peers.load("warp") is not None:
        from comparison import warp_spheres

        where = "GPU" if device == "cuda" else "CPU, 1 thread"
        program = Program(
            "Warp HashGrid", "warp-lang", "exact pairs (a kernel of ours)", "radii of several sizes", where
        )
        found[program] = lambda scene: _warp(warp_spheres.hash_grid(scene, device))
        program = Program("Warp Bvh", "warp-lang", "exact pairs (a kernel of ours)", device=where)
        found[program] = lambda scene: _warp(warp_spheres.bvh(scene, device))
    if device == "cuda":
        return found
    ipctk = peers.load_ipctk()
    if ipctk is not None:
        # BruteForce is quadratic and omitted.
        for name in ("LBVH", "HashGrid", "SpatialHash", "SweepAndPrune"):
            program = Program(f"ipctk {name}", "ipctk", "pairs of boxes", "radii of several sizes")
            found[program] = partial(_ipctk, ipctk, getattr(ipctk, name))
    spatial = peers.load("scipy.spatial")
    if spatial is not None:
        program = Program(
            "SciPy cKDTree", "scipy", "pairs of points within a distance", "motion; radii of several sizes"
        )
        found[program] = lambda scene: _kd_tree(spatial, scene)
    return found


def _kd_tree(spatial: Any, scene: MovingSpheres) -> Callable[[], ReadPairs]:
    def find() -> ReadPairs:
        # At mid-step, centres are further apart than their minimum by at most half of both paths.
        travel = scene.position_t1 - scene.position_t0
        reach = 2.0 * scene.radius + np.sqrt((travel * travel).sum(1).max())
        tree = spatial.cKDTree(scene.position_t0 + 0.5 * travel)
        pairs = tree.query_pairs(reach, output_type="ndarray")
        return lambda: pairs

    return find


def _ipctk(ipctk: Any, broad_phase: Any, scene: MovingSpheres) -> Callable[[], ReadPairs]:
    start, end = np.asfortranarray(scene.position_t0), np.asfortranarray(scene.position_t1)
    mesh = ipctk.CollisionMesh(start)

    def find() -> ReadPairs:
        candidates = ipctk.Candidates()
        candidates.build(mesh, start, end, scene.radius, broad_phase())

        def read() -> np.ndarray:
            rows = [(c.vertex0_id, c.vertex1_id) for c in candidates.vv_candidates]
            return np.sort(np.array(rows, dtype=np.int64).reshape(-1, 2), axis=1)

        return read

    return find


def _warp(find_pairs: Callable[[], Any]) -> FindPairs:
    def find() -> ReadPairs:
        pairs = find_pairs()
        return lambda: pairs.numpy().astype(np.int64)

    return find
