"""How fast two bodies approach each other where they touch."""

from __future__ import annotations

import torch
from torch import Tensor

from pgccd.detection.contacts import Contacts
from pgccd.detection.narrow import Kind
from pgccd.geometry.scene import Scene
from pgccd.motion.paths import RigidMotion, VertexMotion
from pgccd.motion.rotation import rotated
from pgccd.motion.trajectory import Trajectory


def closing_rates(scene: Scene, trajectory: Trajectory, found: Contacts, segment: Tensor) -> Tensor:
    """(K,) float64 lengths per segment, >= 0: the rate at which the gap closes along the normal at toi.

    Args:
        found: K contacts of vertices with faces and of edges. Where the gap is zero at toi up to rounding the side of
            the normal is undefined; but if toi > 0 the gap has closed, so that the sign is known.
        segment: (K,).
    """
    steps, pairs = trajectory.steps(), found.pairs
    body = segment[:, None] * scene.body_count + pairs
    if isinstance(steps, RigidMotion) and steps.path == "rigid":
        # Of the points of each body on the line along the normal all have the same speed along it.
        travel = steps.position_t1[body] - steps.position_t0[body]
        arm = found.point[:, None] - (steps.position_t0[body] + found.toi[:, None, None] * travel)
        velocity = travel + _cross(steps.rotation[body], arm)
    else:
        rows, weights = _corners(scene, scene.mesh_index[pairs].long(), found)
        u, v, w = (weights[..., None] * _paths(scene, steps, segment, pairs, rows)).unbind(dim=2)
        velocity = u + v + w
    x, y, z = (found.normal * (velocity[:, 0] - velocity[:, 1])).unbind(dim=1)
    rate = x + y + z
    return torch.where(found.toi > 0.0, rate.abs(), rate.clamp(min=0.0))


def _paths(scene: Scene, steps: RigidMotion | VertexMotion, segment: Tensor, pairs: Tensor, rows: Tensor) -> Tensor:
    """(K, 2, 3, 3): by how much vertices move in a segment, on straight paths.

    Args:
        steps: the bodies of all segments.
        segment, pairs: (K,) and (K, 2).
        rows: (K, 2, 3) vertices of their meshes.
    """
    if isinstance(steps, VertexMotion):
        first = segment[:, None] * scene.layout.vertex_count + scene.layout.vertex_begin[pairs]
        which = first[..., None] + rows
        return steps.x_t1[which] - steps.x_t0[which]
    mesh = scene.mesh_index[pairs].long()
    own = scene.meshes.tensors[0][scene.meshes.offsets.to(scene.device)[mesh, 0][..., None] + rows]
    body = (segment[:, None] * scene.body_count + pairs)[..., None].expand(rows.shape).reshape(-1)
    turn = steps.rotation[body]
    before, after = (
        _turned(rotated(steps.orientation_t0[body], by), own.reshape(-1, 3)) for by in (torch.zeros_like(turn), turn)
    )
    return (after - before + (steps.position_t1[body] - steps.position_t0[body])).view(own.shape)


def _turned(orientation: Tensor, vectors: Tensor) -> Tensor:
    """Vectors (K, 3) turned by unit quaternions (K, 4)."""
    twice = 2.0 * _cross(orientation[:, 1:], vectors)
    return vectors + orientation[:, :1] * twice + _cross(orientation[:, 1:], twice)


def _cross(a: Tensor, b: Tensor) -> Tensor:
    # Not torch's, which may round differently on another device.
    x, y, z = a.unbind(dim=-1)
    u, v, w = b.unbind(dim=-1)
    return torch.stack([y * w - z * v, z * u - x * w, x * v - y * u], dim=-1)


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
