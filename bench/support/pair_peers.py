"""Other programs for the first toi of two moving meshes. A peer is given a pair in its own form (not timed); the call
returned answers with the toi, or None if it finds no collision.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from support import peers
from support.near_pairs import Pairs

FirstToi = Callable[[], float | None]
Prepare = Callable[[int], FirstToi]

_TIME_SAMPLES = 10


def available(pairs: Pairs, tolerance: float) -> dict[str, Prepare]:
    """The programs that can be used here, by name."""
    found: dict[str, Prepare] = {}
    ipctk = peers.load_ipctk()
    if ipctk is not None:
        found["ipctk LBVH + Tight-Inclusion"] = _ipctk(ipctk, pairs, tolerance)
    fcl = peers.load("fcl")
    if fcl is not None:
        advancement = fcl.ContinuousCollisionRequest(
            num_max_iterations=100,
            toc_err=tolerance,
            ccd_motion_type=fcl.CCDMotionType.CCDM_LINEAR,
            ccd_solver_type=fcl.CCDSolverType.CCDC_CONSERVATIVE_ADVANCEMENT,
        )
        samples = fcl.ContinuousCollisionRequest(
            num_max_iterations=_TIME_SAMPLES,
            ccd_motion_type=fcl.CCDMotionType.CCDM_LINEAR,
            ccd_solver_type=fcl.CCDSolverType.CCDC_NAIVE,
        )
        found["python-fcl conservative advancement"] = _fcl(fcl, pairs, advancement)
        found[f"python-fcl {_TIME_SAMPLES} time samples"] = _fcl(fcl, pairs, samples)
    return found


def _ipctk(ipctk: Any, pairs: Pairs, tolerance: float) -> Prepare:
    start, end = pairs.vertices()
    count = start.shape[2]
    faces = np.concatenate([pairs.mesh.faces.numpy(), pairs.mesh.faces.numpy() + count]).astype(np.int32)
    edges = np.concatenate([pairs.mesh.edges.numpy(), pairs.mesh.edges.numpy() + count]).astype(np.int32)
    # Without rescaling the question is the same: do they touch?
    narrow = ipctk.TightInclusionCCD(tolerance=tolerance, conservative_rescaling=1.0)
    patches = np.repeat(np.array([0, 1], dtype=np.int32), count)
    mesh = ipctk.CollisionMesh(np.asfortranarray(start[0].reshape(-1, 3)), edges, faces)
    mesh.can_collide = ipctk.make_vertex_patches_filter(patches)

    def prepare(row: int) -> FirstToi:
        ends = [np.asfortranarray(x[row].reshape(-1, 3)) for x in (start, end)]

        def first_toi() -> float | None:
            step = ipctk.compute_collision_free_stepsize(mesh, *ends, 0.0, ipctk.LBVH(), narrow)
            return step if step < 1.0 else None

        return first_toi

    return prepare


def _fcl(fcl: Any, pairs: Pairs, request: Any) -> Prepare:
    model = fcl.BVHModel()
    vertices, faces = pairs.mesh.vertices.numpy(), pairs.mesh.faces.numpy()
    model.beginModel(len(vertices), len(faces))
    model.addSubModel(vertices, faces)
    model.endModel()
    orientations = (pairs.orientation.numpy(), pairs.orientation_t1().numpy())
    positions = (pairs.position.numpy(), (pairs.position + pairs.velocity).numpy())

    def prepare(row: int) -> FirstToi:
        poses = [
            [fcl.Transform(q[row, side], x[row, side]) for q, x in zip(orientations, positions, strict=True)]
            for side in (0, 1)
        ]
        bodies = [fcl.CollisionObject(model, pose[0]) for pose in poses]

        def first_toi() -> float | None:
            answer = fcl.ContinuousCollisionResult()
            fcl.continuousCollide(bodies[0], poses[0][1], bodies[1], poses[1][1], request, answer)
            return answer.time_of_contact if answer.is_collide else None

        return first_toi

    return prepare
