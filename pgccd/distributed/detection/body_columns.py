"""Conversion of moving bodies to columns, which can be sent and indexed by rows, and back."""

from __future__ import annotations

from typing import cast

from torch import Tensor

from pgccd import ops
from pgccd.detection.bodies import MovingBodies
from pgccd.distributed.comm.exchange import Columns
from pgccd.distributed.halo.vertices import Vertices
from pgccd.geometry.scene import OPTIONAL_COLUMNS, Scene
from pgccd.motion.paths import RigidMotion, VertexMotion

_MOTION = ("position_t0", "orientation_t0", "position_t1", "rotation")


def columns_of(bodies: MovingBodies) -> Columns:
    """All per-body columns of a scene and a rigid motion; for deforming bodies, all except their vertices."""
    columns = {} if bodies.deforming else {name: getattr(bodies.motion, name) for name in _MOTION}
    columns |= {} if bodies.deforming else {"radius": bodies.radius}
    columns |= {name: getattr(bodies.scene, name) for name in ("mesh_index", *OPTIONAL_COLUMNS)}
    return {name: column for name, column in columns.items() if column is not None}


def bodies_of(like: MovingBodies, columns: Columns, vertices: Vertices | None = None) -> MovingBodies:
    """The inverse: bodies with the same meshes and kind of path, already validated by their owners.

    Args:
        like: bodies with these meshes and this kind of path.
        columns: as from `columns_of`.
        vertices: of bodies that deform.
    """
    optional = {name: columns[name] for name in OPTIONAL_COLUMNS if name in columns}
    scene = Scene._of_checked(like.scene.meshes, columns["mesh_index"], radius=columns.get("radius"), **optional)
    if vertices is not None:
        return MovingBodies.of(scene, VertexMotion._of_checked(**vertices.columns))
    position_t0, orientation, position_t1, rotation = (columns[name] for name in _MOTION)
    path = cast(RigidMotion, like.motion).path
    return MovingBodies.of(scene, RigidMotion._of_checked(position_t0, orientation, position_t1, rotation, path))


def of_checked(scene: Scene, motion: RigidMotion | VertexMotion) -> MovingBodies:
    """Moving bodies that their owners have validated."""
    if isinstance(motion, VertexMotion):
        return MovingBodies.of(scene, VertexMotion._of_checked(motion.x_t0, motion.x_t1))
    pose = motion.position_t0, motion.orientation_t0, motion.position_t1, motion.rotation
    return MovingBodies.of(scene, RigidMotion._of_checked(*pose, motion.path))


def take_bodies(bodies: MovingBodies, ghosts: MovingBodies, rows: Tensor) -> Columns:
    """Rows of the columns of both, numbered with own bodies first."""
    own, more = columns_of(bodies), columns_of(ghosts)
    return dict(zip(own, ops.take_rows(list(own.values()), [more[name] for name in own], rows), strict=True))
