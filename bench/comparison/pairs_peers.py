"""Other programs for the first toi of two moving meshes. A peer prepares a pair in its own form (not timed); the
function returned gives the toi, or None without a collision.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from support import near_pairs, peers
from support.near_pairs import Pairs

from comparison.program import Program
from pgccd.motion.paths import PathKind

FirstToi = Callable[[], float | None]
Prepare = Callable[[int], FirstToi]

_TIME_SAMPLES = 10


@dataclass(frozen=True)
class PairsProgram:
    """A program ready to solve pairs."""

    program: Program
    path: PathKind  #: "rigid" or "linear"
    prepare: Prepare


def available(pairs: Pairs, tolerance: float) -> list[PairsProgram]:
    """The available programs."""
    found: list[PairsProgram] = []
    ipctk = peers.load_ipctk()
    if ipctk is not None:
        # Without rescaling the query is the same: do they touch?
        methods = {
            "Tight-Inclusion": ipctk.TightInclusionCCD(tolerance=tolerance, conservative_rescaling=1.0),
            "Additive CCD": ipctk.AdditiveCCD(),
        }
        for name, method in methods.items():
            program = Program(f"ipctk, LBVH + {name}", "ipctk", "toi; meshes on straight paths", "arcs; which features")
            found.append(PairsProgram(program, "linear", _ipctk(ipctk, pairs, method)))
    fcl = peers.load("fcl")
    if fcl is not None:
        linear = {"ccd_motion_type": fcl.CCDMotionType.CCDM_LINEAR}
        advancement = fcl.ContinuousCollisionRequest(
            num_max_iterations=100,
            toc_err=tolerance,
            ccd_solver_type=fcl.CCDSolverType.CCDC_CONSERVATIVE_ADVANCEMENT,
            **linear,
        )
        samples = fcl.ContinuousCollisionRequest(
            num_max_iterations=_TIME_SAMPLES, ccd_solver_type=fcl.CCDSolverType.CCDC_NAIVE, **linear
        )
        for name, request in (("conservative advancement", advancement), (f"{_TIME_SAMPLES} poses", samples)):
            program = Program(f"python-fcl, {name}", "python-fcl", "toi; meshes on arcs", "proof; features")
            found.append(PairsProgram(program, "rigid", _fcl(fcl, pairs, request)))
    coal = peers.load("coal")
    if coal is not None:
        program = Program(f"coal, {_TIME_SAMPLES} poses", "coal", "first pose in contact; meshes", "toi; between poses")
        found.append(PairsProgram(program, "rigid", _coal(coal, pairs)))
    return found


def _ipctk(ipctk: Any, pairs: Pairs, method: Any) -> Prepare:
    start, end = pairs.vertices()
    count = start.shape[2]
    faces = np.concatenate([pairs.mesh.faces.numpy(), pairs.mesh.faces.numpy() + count]).astype(np.int32)
    edges = np.concatenate([pairs.mesh.edges.numpy(), pairs.mesh.edges.numpy() + count]).astype(np.int32)
    patches = np.repeat(np.array([0, 1], dtype=np.int32), count)
    mesh = ipctk.CollisionMesh(np.asfortranarray(start[0].reshape(-1, 3)), edges, faces)
    mesh.can_collide = ipctk.make_vertex_patches_filter(patches)

    def prepare(row: int) -> FirstToi:
        ends = [np.asfortranarray(x[row].reshape(-1, 3)) for x in (start, end)]

        def first_toi() -> float | None:
            step = ipctk.compute_collision_free_stepsize(mesh, *ends, 0.0, ipctk.LBVH(), method)
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


def _coal(coal: Any, pairs: Pairs) -> Prepare:
    """It has no continuous test: poses along the step are tested one by one, as its users do."""
    model = coal.BVHModelOBBRSS()
    points, triangles = coal.StdVec_Vec3s(), coal.StdVec_Triangle()
    points.extend(pairs.mesh.vertices.numpy())
    triangles.extend(coal.Triangle(*face) for face in pairs.mesh.faces.tolist())
    model.beginModel(len(triangles), len(points))
    model.addSubModel(points, triangles)
    model.endModel()
    times = np.linspace(0.0, 1.0, _TIME_SAMPLES)
    request, result = coal.CollisionRequest(), coal.CollisionResult()
    axes = torch.eye(3, dtype=torch.float64)

    def prepare(row: int) -> FirstToi:
        motion = pairs[row : row + 1].motion("rigid")
        poses = []
        for time in times:
            position, orientation = motion.at(float(time))
            rotation = near_pairs.rotate(orientation, axes).transpose(1, 2).numpy()
            poses.append([coal.Transform3s(r, p) for r, p in zip(rotation, position.numpy(), strict=True)])

        def first_toi() -> float | None:
            for time, (first, second) in zip(times, poses, strict=True):
                result.clear()
                if coal.collide(model, first, model, second, request, result):
                    return float(time)
            return None

        return first_toi

    return prepare
