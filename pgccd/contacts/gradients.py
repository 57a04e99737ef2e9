"""Gradients of contacts to the motion, the margins and the separation that they were found with."""

from __future__ import annotations

import torch
from torch import Tensor

from pgccd.contacts.contacts import Contacts
from pgccd.contacts.derivatives import Corners, differentiate
from pgccd.contacts.kinds import EDGE, FACE, FEATURES, VERTEX, Kind, Status
from pgccd.geometry.mesh_set import MeshSet
from pgccd.geometry.scene import Scene
from pgccd.motion.differentiable import oriented, rows_of, turned, with_gradient_of
from pgccd.motion.paths import RigidMotion, VertexMotion


def add_gradients(
    found: Contacts, scene: Scene, motion: RigidMotion | VertexMotion, separation: Tensor | float
) -> None:
    """Gives the columns of contacts gradients to the motion, the margins of the scene and the separation.

    Args:
        found: contacts of the scene's bodies on this motion.
        scene, motion: with gradients.
        separation: min_separation, () if it requires grad.
    """
    position, velocity = corner_points(scene, motion, found.pairs, found.kind, found.features, found.toi)
    between = torch.zeros_like(found.toi) + separation
    if (thickness := scene._thickness) is not None:
        between = between + rows_of(thickness, found.pairs).sum(1)
    # Not where features touch at the start, or where the search did not reach a contact.
    sound = (found.toi > 0.0) & (found.status == Status.TOUCH) & (found.kind <= Kind.EE)
    corners = Corners(position, velocity.detach(), found.kind == Kind.EE, between)
    # A body inside of a solid has no normal.
    normal = torch.where(sound[:, None], found.normal, 0.0)
    differentiated = differentiate(corners, sound, found.coordinates, normal)
    for name in ("toi", "coordinates", "point", "normal"):
        setattr(found, name, with_gradient_of(getattr(found, name), getattr(differentiated, name), name))
    found._differentiable = differentiated.differentiable


def corner_points(
    scene: Scene, motion: RigidMotion | VertexMotion, bodies: Tensor, kind: Tensor, features: Tensor, toi: Tensor
) -> tuple[Tensor, Tensor]:
    """Positions at toi and velocities (K, 2, 3, 3) of the corners of features, see `Corners`; with gradients.

    Args:
        scene, motion: of the bodies.
        bodies: (K, 2) rows of the motion.
        kind, features, toi: columns of contacts.
    """
    mesh = scene.mesh_index[bodies].long()
    rows = _corner_rows(scene.meshes, mesh, *_feature_rows(scene.meshes, mesh, kind, features))
    if isinstance(motion, RigidMotion):
        position, velocity = _rigid_points(motion, bodies, scene.meshes.tensors[0][rows], toi[:, None, None, None])
    else:
        first_vertex = scene.meshes.offsets[:, 0].to(scene.device)[mesh]
        rows = rows + (scene.layout.vertex_begin[bodies] - first_vertex)[:, :, None]
        x_t0, x_t1 = rows_of(motion.x_t0, rows), rows_of(motion.x_t1, rows)
        velocity = x_t1 - x_t0
        position = x_t0 + toi[:, None, None, None] * velocity
    return position, velocity


def _rigid_points(motion: RigidMotion, pairs: Tensor, vertices: Tensor, time: Tensor) -> tuple[Tensor, Tensor]:
    """Positions and velocities (K, 2, 3, 3) of points of bodies (K, 2), in the coordinates of their meshes relative to
    the origin, at times (K, 1, 1, 1).
    """
    columns = (motion.position_t0, motion.position_t1, motion.orientation_t0, motion.rotation)
    start, end, orientation, rotation = (rows_of(column, pairs)[:, :, None] for column in columns)
    travel = end - start
    arm = oriented(vertices, orientation)
    if motion.path == "linear":
        turning = turned(arm, rotation) - arm
        return start + arm + time * (travel + turning), travel + turning
    arm = turned(arm, time * rotation)
    return start + time * travel + arm, travel + torch.linalg.cross(rotation.expand_as(arm), arm)


def _feature_rows(meshes: MeshSet, mesh: Tensor, kind: Tensor, features: Tensor) -> tuple[Tensor, Tensor]:
    """Of contacts of meshes (K, 2): VERTEX, FACE or EDGE (K, 2), and the row (K, 2) among these of all meshes; the
    first vertex where a body has no feature.
    """
    what = torch.tensor(FEATURES, device=kind.device)[kind.long()]
    return what, meshes.offsets.to(kind.device)[mesh, what] + features.long().clamp(min=0)


def _corner_rows(meshes: MeshSet, mesh: Tensor, what: Tensor, row: Tensor) -> Tensor:
    """(K, 2, 3) int64: the corners of features of meshes (K, 2), see `Corners`, as rows of the vertices of all meshes.

    Args:
        what, row: see `_feature_rows`.
    """
    _, faces, edges, *_ = meshes.tensors  # vertices of their mesh
    edges = edges if len(edges) else edges.new_zeros((1, 2))  # points have none
    of_face = faces[torch.where(what == FACE, row, 0)]
    of_edge = edges[torch.where(what == EDGE, row, 0)][:, [[0], [1]], [[0, 1, 0], [0, 0, 1]]]
    what, first = what[:, :, None], meshes.offsets[:, 0].to(mesh.device)[mesh][:, :, None]
    return torch.where(what == VERTEX, row[:, :, None], first + torch.where(what == FACE, of_face, of_edge))
