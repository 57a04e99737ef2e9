"""How fast two bodies approach each other where they touch."""

from __future__ import annotations

import torch
from torch import Tensor

from pgccd.detection.contacts import Contacts
from pgccd.detection.narrow import Kind
from pgccd.geometry.scene import Scene
from pgccd.motion.paths import RigidMotion
from pgccd.motion.rotation import integrate_orientation
from pgccd.motion.trajectory import Trajectory


def closing_rates(scene: Scene, trajectory: Trajectory, found: Contacts, segment: Tensor) -> Tensor:
    """(K,) float64 lengths per segment, >= 0: the rate at which the gap closes along the normal at toi.

    Args:
        found: K contacts of vertices with faces and of edges, with toi > 0. Where the gap is zero at toi up to rounding
            the side of the normal is undefined; but the gap has closed, so that the sign is known.
        segment: (K,).
    """
    steps, pairs = trajectory.steps(), found.pairs
    body = segment[:, None] * scene.body_count + pairs
    if isinstance(steps, RigidMotion) and steps.path == "rigid":
        # Of the points of each body on the line along the normal all have the same speed along it.
        travel = steps.position_t1[body] - steps.position_t0[body]
        arm = found.point[:, None] - (steps.position_t0[body] + found.toi[:, None, None] * travel)
        velocity = travel + torch.linalg.cross(steps.rotation[body], arm)
        return _speed_along(found.normal, velocity[:, 0] - velocity[:, 1])
    mesh = scene.mesh_index[pairs].long()
    rows, weights = _corners(scene, mesh, found)
    if isinstance(steps, RigidMotion):
        own = scene.meshes.tensors[0][scene.meshes.offsets.to(scene.device)[mesh, 0][..., None] + rows]
        start = steps.orientation_t0[body].reshape(-1, 4)
        end = integrate_orientation(start, steps.rotation[body].reshape(-1, 3))
        before, after = (_turned(q.view(*body.shape, 1, 4), own) for q in (start, end))
        moved = after - before + (steps.position_t1[body] - steps.position_t0[body])[:, :, None]
    else:
        first = segment[:, None] * scene.layout.vertex_count + scene.layout.vertex_begin[pairs]
        moved = (steps.x_t1 - steps.x_t0)[first[..., None] + rows]
    velocity = (weights[..., None] * moved).sum(dim=2)
    return _speed_along(found.normal, velocity[:, 0] - velocity[:, 1])


def _turned(orientation: Tensor, vectors: Tensor) -> Tensor:
    """Vectors (..., 3) turned by quaternions (..., 4), of any length."""
    orientation = orientation / orientation.norm(dim=-1, keepdim=True)
    w, axis = orientation[..., :1], orientation[..., 1:].expand_as(vectors)
    return vectors + 2.0 * torch.linalg.cross(axis, torch.linalg.cross(axis, vectors) + w * vectors)


def _speed_along(normal: Tensor, velocity: Tensor) -> Tensor:
    return (normal * velocity).sum(dim=1).abs()


def _corners(scene: Scene, mesh: Tensor, found: Contacts) -> tuple[Tensor, Tensor]:
    """The vertices of the features that touch, rows of their meshes (K, 2, 3), and their weights (K, 2, 3)."""
    offsets, (_, faces, edges, *_) = scene.meshes.offsets.to(scene.device), scene.meshes.tensors
    side = torch.arange(2, device=scene.device)
    is_edge = (found.kind == Kind.EE)[:, None].expand(-1, 2)
    is_face = ~is_edge & (found.kind[:, None] != side)  # VF_AB: the face is the second one's
    features = found.features.long()
    of_face = faces[torch.where(is_face, offsets[mesh, 1] + features, 0)].long()
    of_edge = edges[torch.where(is_edge, offsets[mesh, 2] + features, 0)].long()
    rows = torch.where(is_edge[..., None], of_edge[..., [0, 1, 1]], features[..., None])
    rows = torch.where(is_face[..., None], of_face, rows)
    u, v = found.coordinates.unbind(dim=1)
    zero = torch.zeros_like(u)
    face = torch.stack([1.0 - u - v, u, v], dim=1)[:, None].expand(-1, 2, -1)
    ends = torch.stack([1.0 - found.coordinates, found.coordinates, zero[:, None].expand(-1, 2)], dim=2)
    single = torch.stack([zero + 1.0, zero, zero], dim=1)[:, None].expand(-1, 2, -1)
    weights = torch.where(is_edge[..., None], ends, torch.where(is_face[..., None], face, single))
    return rows, weights
