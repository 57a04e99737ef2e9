"""Moving rigid bodies as columns, to be sent and taken by rows, and the reverse."""

from __future__ import annotations

from typing import cast

from torch import Tensor

from pgccd import ops
from pgccd.detection.bodies import MovingBodies
from pgccd.distributed.comm.exchange import Columns
from pgccd.geometry.scene import OPTIONAL_COLUMNS, Scene
from pgccd.motion.paths import RigidMotion

_MOTION = ("position_t0", "orientation_t0", "position_t1", "rotation")


def columns_of(bodies: MovingBodies) -> Columns:
    """All that a scene and a motion say of each body."""
    columns = {name: getattr(bodies.motion, name) for name in _MOTION}
    columns |= {name: getattr(bodies.scene, name) for name in ("mesh_index", "radius", *OPTIONAL_COLUMNS)}
    return {name: column for name, column in columns.items() if column is not None}


def bodies_of(like: MovingBodies, columns: Columns) -> MovingBodies:
    """The reverse: bodies of the same meshes on paths of the same kind."""
    optional = {name: columns[name] for name in OPTIONAL_COLUMNS if name in columns}
    scene = Scene.of_checked(like.scene.meshes, columns["mesh_index"], **optional)
    scene.radius = columns["radius"]
    position_t0, orientation, position_t1, rotation = (columns[name] for name in _MOTION)
    path = cast(RigidMotion, like.motion).path
    return MovingBodies(scene, RigidMotion.of_checked(position_t0, orientation, position_t1, rotation, path))


def of_checked(scene: Scene, motion: RigidMotion) -> MovingBodies:
    """Of bodies whose owners have checked them."""
    pose = motion.position_t0, motion.orientation_t0, motion.position_t1, motion.rotation
    return MovingBodies(scene, RigidMotion.of_checked(*pose, motion.path))


def take_bodies(bodies: MovingBodies, ghosts: MovingBodies, rows: Tensor) -> Columns:
    """Columns of both: own bodies first."""
    own, more = columns_of(bodies), columns_of(ghosts)
    return dict(zip(own, ops.take_rows(list(own.values()), [more[name] for name in own], rows), strict=True))
