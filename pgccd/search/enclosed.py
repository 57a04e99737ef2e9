"""Bodies wholly inside others."""

from __future__ import annotations

import copy
from fractions import Fraction

import numpy as np
import torch
from torch import Tensor

from pgccd.geometry.mesh import Mesh
from pgccd.geometry.scene import Scene
from pgccd.geometry.solids import opening, vertices_of_components, winding_numbers
from pgccd.motion.of_scene import at_start
from pgccd.motion.paths import RigidMotion, VertexMotion
from pgccd.motion.trajectory import Trajectory
from pgccd.search import broad
from pgccd.search.bodies import MovingBodies
from pgccd.search.detect import collide

# Rows at a time, to bound memory.
_ROWS = 1 << 16
# Error of a rigid body's point in the frame of another body, in units of the reach of each: see
# docs/explanation/exactness.md.
_POINT_ERROR = 2.0**-45


def enclosed(scene: Scene, motion: RigidMotion | VertexMotion | Trajectory) -> Tensor:
    """The bodies that are wholly inside another one at the start of a step.

    `detect` finds surfaces that meet. The surface of a body inside another one meets nothing, so that `detect` reports
    no contact of the two until the body leaves.

    A body is inside of another one if its surface is inside of the solid that the other one's surface bounds: all
    points that this surface winds about, whether its triangles face outwards or inwards. A cavity, bounded by triangles
    that face the other way, does not belong to the solid. Of a body in several pieces all must be inside. Pairs whose
    surfaces touch or intersect at the start are left out: `detect` reports them, at toi 0. Margins do not count; the
    scene's filters do.

    Args:
        scene: the bodies. The mesh of each must be watertight: each edge is shared by exactly two triangles, in
            opposite directions. It may be in several pieces. Bodies that are not watertight cannot be in this scene.
        motion: their paths, of which only the start counts; see `RigidMotion.at_rest`. Of a `Trajectory`, the first
            waypoint.

    Returns:
        (K, 2) int64 on the scene's device: rows (inner body, outer body), sorted. Synchronises with a GPU.

    Raises:
        ValueError, TypeError: naming the argument; also, naming body, mesh and edge, if a body is not watertight.

    Example:
        >>> pgccd.enclosed(scene, pgccd.RigidMotion.at_rest(x, q))
        tensor([], size=(0, 2), dtype=torch.int64)
    """
    still = _at_rest(motion)
    bodies = MovingBodies.of(scene, still)
    _require_watertight(scene)
    pairs = broad.find_pairs(bodies, tolerance=0.0).cpu().numpy()
    pairs = pairs[pairs[:, 0] != pairs[:, 1]]
    surfaces = _Surfaces(scene, still)
    rows = _near(surfaces, np.concatenate([pairs, pairs[:, ::-1]]))
    found = _decided(surfaces, scene, still, rows[~_meet(scene, still, rows)])
    return torch.from_numpy(found[np.lexsort((found[:, 1], found[:, 0]))]).to(scene.device)


def enclosed_pairs(scene: Scene, still: RigidMotion | VertexMotion, pairs: Tensor) -> Tensor:
    """(P,) bool: whether one body of each pair (P, 2) is wholly inside the other one. Surfaces that are not watertight
    have no inside.

    Args:
        scene, still: the bodies, at rest.
        pairs: of bodies whose surfaces do not meet.
    """
    rows = pairs.cpu().numpy()
    rows = np.concatenate([rows, rows[:, ::-1]])
    index = scene.mesh_index.cpu().numpy()
    meshes, number = np.unique(index[rows[:, 1]], return_inverse=True)
    closed = np.array([opening(scene.meshes.meshes[k].faces.numpy()) is None for k in meshes.tolist()], dtype=bool)
    rows = rows[closed[number] & (rows[:, 0] != rows[:, 1])]
    if len(rows):
        surfaces = _Surfaces(scene, still)
        rows = _decided(surfaces, scene, still, _near(surfaces, rows))
    of_pair = [scene.body_count, 1]
    inside = torch.from_numpy(np.sort(rows, axis=1) @ of_pair).to(pairs.device)
    return torch.isin(pairs[:, 0] * scene.body_count + pairs[:, 1], inside)


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


class _Surfaces:
    """The surfaces of bodies, each in a frame in which its vertices are exact: that of its mesh, or the world's for
    deforming bodies.
    """

    def __init__(self, scene: Scene, motion: RigidMotion | VertexMotion) -> None:
        self.meshes = scene.meshes.meshes
        #: (N,) mesh of each body.
        self.mesh = scene.mesh_index.cpu().numpy()
        #: (N,) number of its surface, the same for bodies whose vertices are the same in their frames.
        self.number = self.mesh if isinstance(motion, RigidMotion) else np.arange(scene.body_count)
        #: (N,) for a vertex of body k in the frame of body l, error[k] + error[l] bounds its error.
        self.error = np.zeros(scene.body_count)
        #: (N, 3) and (N, 4) of rigid bodies.
        self.poses: tuple[np.ndarray, np.ndarray] | None = None
        if isinstance(motion, VertexMotion):
            vertices, begin = motion.x_t0, scene.layout.vertex_begin
        else:
            vertices, begin = scene.meshes.tensors[0], scene.meshes.offsets[:-1, 0]
            self.error = _POINT_ERROR * np.array([mesh.reach for mesh in self.meshes])[self.mesh]
            self.poses = motion.position_t0.cpu().numpy(), motion.orientation_t0.cpu().numpy()
        self.vertices, self.begin = vertices.cpu().numpy(), begin.cpu().numpy()
        #: (surfaces, 3) lower and upper ends of boxes around the surfaces.
        self.low = np.minimum.reduceat(self.vertices, self.begin)
        self.high = np.maximum.reduceat(self.vertices, self.begin)
        #: (meshes, 6) vertices on the sides of a box around the mesh.
        self.extreme = np.stack([_extreme_vertices(mesh) for mesh in self.meshes])

    def corners(self, body: int) -> np.ndarray:
        """(F, 3, 3) corners of the body's triangles in its frame."""
        return self.vertices[self.begin[self.number[body]] + self.meshes[self.mesh[body]].faces.long().numpy()]

    def seen_from(self, outer: np.ndarray, inner: np.ndarray, vertex: np.ndarray, exactly: bool = False) -> np.ndarray:
        """(n, 3) vertices (n,) of inner bodies (n,) in the frames of outer ones (n,); if `exactly`, as fractions."""
        points = self.vertices[self.begin[self.number[inner]] + vertex]
        if self.poses is None:
            return points
        columns = [points, *(column[bodies] for bodies in (inner, outer) for column in self.poses)]
        if exactly:
            columns = [np.vectorize(Fraction, otypes=[object])(column) for column in columns]
        points, position, orientation, position_outer, orientation_outer = columns
        points = (_matrices(orientation) * points[:, None]).sum(axis=2) + (position - position_outer)
        return (_matrices(orientation_outer) * points[:, :, None]).sum(axis=1)


def _matrices(quaternions: np.ndarray) -> np.ndarray:
    """(n, 3, 3) rotations by quaternions (n, 4), which are normalised."""
    w, x, y, z = quaternions.T
    rows = [
        [w * w + x * x - y * y - z * z, 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), w * w - x * x + y * y - z * z, 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), w * w - x * x - y * y + z * z],
    ]
    return (np.array(rows) / (w * w + x * x + y * y + z * z)).transpose(2, 0, 1)


def _in_boxes(surfaces: _Surfaces, rows: np.ndarray) -> np.ndarray:
    """The rows (inner, outer) of which some vertices of the inner body are in the box around the outer one."""
    for k in range(surfaces.extreme.shape[1]):
        inner, outer = rows.T
        x = surfaces.seen_from(outer, inner, surfaces.extreme[surfaces.mesh[inner], k])
        error, number = (surfaces.error[inner] + surfaces.error[outer])[:, None], surfaces.number[outer]
        rows = rows[((surfaces.low[number] - error <= x) & (x <= surfaces.high[number] + error)).all(axis=1)]
    return rows


def _near(surfaces: _Surfaces, rows: np.ndarray) -> np.ndarray:
    """As `_in_boxes`, in bounded memory."""
    return np.concatenate([_in_boxes(surfaces, part) for part in np.array_split(rows, 1 + len(rows) // _ROWS)])


def _decided(surfaces: _Surfaces, scene: Scene, still: RigidMotion | VertexMotion, rows: np.ndarray) -> np.ndarray:
    """The rows (inner, outer), of bodies that do not meet, whose outer surface winds about the whole inner one."""
    # Closer to a surface than the error of their points: these few are decided exactly.
    is_near = _meet(scene, still, rows, surfaces.error)
    return np.concatenate([_inside(surfaces, rows[~is_near]), _inside(surfaces, rows[is_near], exactly=True)])


def _extreme_vertices(mesh: Mesh) -> np.ndarray:
    used = np.unique(mesh.faces.numpy())
    x = mesh.vertices.numpy()[used]
    return used[np.concatenate([x.argmin(axis=0), x.argmax(axis=0)])]


def _meet(
    scene: Scene, still: RigidMotion | VertexMotion, rows: np.ndarray, margin: np.ndarray | None = None
) -> np.ndarray:
    """(n,) bool: whether the surfaces of the bodies in rows (n, 2), thickened by a margin (N,), meet."""
    if not len(rows):
        return np.zeros(0, dtype=bool)
    thick = copy.copy(scene)
    thick.meshes = scene.meshes._surfaces
    thick._capacity_estimates = {}
    thick.margin = None if margin is None else torch.from_numpy(margin).to(scene.device)
    ascending = np.sort(rows, axis=1)
    pairs = torch.from_numpy(np.unique(ascending, axis=0)).to(scene.device)
    meeting = collide(thick, still, tolerance=0.0, pairs=pairs).pairs.cpu().numpy()
    of_pair = [scene.body_count, 1]
    return np.isin(ascending @ of_pair, meeting @ of_pair)


def _inside(surfaces: _Surfaces, rows: np.ndarray, exactly: bool = False) -> np.ndarray:
    """The rows (inner, outer), of bodies that do not meet, whose outer surface winds about the whole inner one."""
    if not len(rows):
        return rows
    # A connected surface that does not meet another one is on one side of it.
    mesh_of_row = surfaces.mesh[rows[:, 0]]
    vertices = {mesh: vertices_of_components(surfaces.meshes[mesh].faces.numpy()) for mesh in np.unique(mesh_of_row)}
    of_row = [vertices[mesh] for mesh in mesh_of_row]
    row = np.repeat(np.arange(len(rows)), [len(v) for v in of_row])
    inner, outer = rows[row].T
    x = surfaces.seen_from(outer, inner, np.concatenate(of_row), exactly)
    is_inside = np.ones(len(rows), dtype=bool)
    for number in np.unique(surfaces.number[outer]):
        its = np.flatnonzero(surfaces.number[outer] == number)
        winding = winding_numbers(x[its], surfaces.corners(outer[its[0]]))
        is_inside[row[its[winding == 0]]] = False
    return rows[is_inside]
