"""Bodies wholly inside others."""

from __future__ import annotations

import copy

import torch
from torch import Tensor

from pgccd.contacts.contacts import CollidingPairs, Contacts
from pgccd.geometry.mesh_set import PIECE_BEGIN, MeshSet
from pgccd.geometry.scene import Scene
from pgccd.geometry.solids import opening
from pgccd.motion.of_scene import at_start
from pgccd.motion.paths import RigidMotion, VertexMotion
from pgccd.motion.trajectory import Trajectory
from pgccd.search import broad
from pgccd.search.bodies import MovingBodies
from pgccd.search.detect import detect_moving
from pgccd.search.narrow import SearchReport
from pgccd.search.query import Query


def enclosed(scene: Scene, motion: RigidMotion | VertexMotion | Trajectory) -> Tensor:
    """The bodies that are wholly inside another one at the start of a step.

    `detect` finds surfaces that meet. The surface of a body inside another one meets nothing, so `detect` reports no
    contact of the two until the body leaves.

    A body is inside of another one if its surface is inside of the solid that the surface of the other body bounds. The
    solid is all points that the bounding surface winds about, whether its triangles face outwards or inwards. A cavity,
    bounded by triangles that face the other way, does not belong to the solid. If a body has several pieces, all must
    be inside. Pairs whose surfaces touch or intersect at the start are left out: `detect` reports them, at toi 0.
    Margins do not count; the scene's filters apply.

    Args:
        scene: the bodies. The mesh of each must be watertight: each edge is shared by exactly two triangles, in
            opposite directions. It may be in several pieces.
        motion: their paths, of which only the start counts; see `RigidMotion.at_rest`. With a `Trajectory`, the first
            waypoint.

    Returns:
        (K, 2) int64 on the scene's device: rows (inner body, outer body), sorted. Synchronises with a GPU.

    Raises:
        ValueError, TypeError: naming the argument; if a body is not watertight, naming body, mesh and edge.

    Example:
        >>> pgccd.enclosed(scene, pgccd.RigidMotion.at_rest(x, q))
        tensor([], size=(0, 2), dtype=torch.int64)
    """
    still = _at_rest(motion)
    bodies = MovingBodies.of(scene, still)
    _require_watertight(scene)
    pairs = broad.find_pairs(bodies, tolerance=0.0)
    return _enclosed_rows(scene, still, pairs[pairs[:, 0] != pairs[:, 1]])


def enclosed_pairs(scene: Scene, still: RigidMotion | VertexMotion, pairs: Tensor) -> Tensor:
    """(P,) bool: whether one body of each pair (P, 2) is wholly inside the other one. Surfaces that are not watertight
    have no inside.

    Args:
        scene, still: the bodies, at rest.
        pairs: of bodies whose surfaces do not meet.
    """
    rows = _enclosed_rows(scene, still, torch.unique(pairs[pairs[:, 0] != pairs[:, 1]], dim=0)).sort(dim=1).values
    keys, of_rows = (each[:, 0] * scene.body_count + each[:, 1] for each in (pairs, rows))
    return torch.isin(keys, of_rows)


def _at_rest(motion: RigidMotion | VertexMotion | Trajectory) -> RigidMotion | VertexMotion:
    if isinstance(motion, (Trajectory, RigidMotion, VertexMotion)):
        motion._refuse_gradient()
    if isinstance(motion, Trajectory):
        motion = motion.segment(0)
    return at_start(motion) if isinstance(motion, (RigidMotion, VertexMotion)) else motion


def _require_watertight(scene: Scene) -> None:
    index = scene.mesh_index.cpu()
    for number in torch.unique(index).tolist():
        mesh = scene.meshes.meshes[number]
        fault = opening(mesh.faces.numpy())
        if fault is not None:
            body = int(torch.nonzero(index == number)[0])
            name = "" if mesh.name is None else f" ({mesh.name!r})"
            raise ValueError(f"scene: body {body}: expected a watertight mesh, but in mesh {number}{name} {fault}")


def _enclosed_rows(scene: Scene, still: RigidMotion | VertexMotion, pairs: Tensor) -> Tensor:
    """(K, 2) int64, sorted: rows (inner body, outer body), of those of the sorted pairs (P, 2) whose surfaces do not
    meet and of which one body is wholly inside the other one.
    """
    closed = scene.meshes._closed
    if not closed.has_solids:
        return pairs[:0]
    meeting = _contacts(scene, scene.meshes._bare, still, pairs, "any").pairs
    keys, of_meeting = (each[:, 0] * scene.body_count + each[:, 1] for each in (pairs, meeting))
    pairs = pairs[~torch.isin(keys, of_meeting)]
    # As surfaces do not meet, these are the pieces of bodies that are inside.
    hits = _contacts(scene, closed, still, pairs, "all")
    assert isinstance(hits, Contacts)
    is_second = hits.features[:, :1] < 0
    rows, pieces = torch.unique(torch.where(is_second, hits.pairs.flip(1), hits.pairs), dim=0, return_counts=True)
    return rows[pieces == closed.tensors[PIECE_BEGIN].diff()[scene.mesh_index[rows[:, 0]].long()]]


def _contacts(
    scene: Scene, meshes: MeshSet, still: RigidMotion | VertexMotion, pairs: Tensor, report: SearchReport
) -> Contacts | CollidingPairs:
    """The contacts of pairs of bodies at rest without their margins."""
    bare = copy.copy(scene)
    bare.meshes, bare.margin = meshes, None
    bare._capacity_estimates = {}
    return detect_moving(MovingBodies.of(bare, still), Query(report, 0.0, 0.0, False), pairs=pairs)
