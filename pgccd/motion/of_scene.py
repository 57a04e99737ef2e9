"""Motions of the bodies of a scene: checks that a motion fits a scene, and the segments of a trajectory as one step."""

from __future__ import annotations

import torch
from torch import Tensor

from pgccd.geometry.scene import OPTIONAL_COLUMNS, Scene
from pgccd.geometry.scene_columns import mesh_expected
from pgccd.motion.paths import RigidMotion, VertexMotion
from pgccd.motion.trajectory import Trajectory
from pgccd.motion.validation import MARGIN, Check, Checked, Validation, first_invalid_rows

_MOST_ROWS = 2**31


def scene_columns(scene: Scene) -> list[Checked]:
    """The columns of a scene whose values are validated at each use."""
    columns = []
    if scene._given_radius is None:
        count = len(scene.meshes)
        columns = [Checked("mesh_index", scene.mesh_index, Check("range", count - 1.0, mesh_expected(count)), "body")]
    if scene.margin is not None:
        columns.append(Checked("margin", scene.margin, MARGIN, "body"))
    return columns


def check_scene(scene: Scene) -> None:
    """Raises ValueError if a value of a column of a scene is invalid. Synchronises with a GPU."""
    scene._refuse()
    if columns := scene_columns(scene):
        Validation(columns).raise_from(first_invalid_rows(columns).tolist())


def check_bodies(scene: Scene, motion: RigidMotion | VertexMotion) -> None:
    """Raises ValueError if a motion is on another device, or has another number of bodies."""
    if scene.device != motion.device:
        raise ValueError(f"motion: is on {motion.device}, the scene on {scene.device}")
    if isinstance(motion, RigidMotion):
        if motion.body_count != scene.body_count:
            raise ValueError(f"motion: has {motion.body_count} bodies, the scene {scene.body_count}")
    elif len(motion.x_t0) != scene.layout.vertex_count:
        expected = f"the scene's bodies have {scene.layout.vertex_count}"
        raise ValueError(f"motion: x_t0 has {len(motion.x_t0)} vertices, {expected}")


def at_start(motion: RigidMotion | VertexMotion) -> RigidMotion | VertexMotion:
    """The bodies at rest where a motion starts."""
    if isinstance(motion, RigidMotion):
        return RigidMotion.at_rest(motion.position_t0, motion.orientation_t0)
    return VertexMotion(motion.x_t0, motion.x_t0)


def check_step(scene: Scene, motion: RigidMotion | VertexMotion) -> None:
    """Raises ValueError if a motion is not of these bodies, or a value is invalid. Synchronises with a GPU."""
    check_bodies(scene, motion)
    check_scene(scene)
    motion.check()


def check_trajectory(scene: Scene, trajectory: Trajectory) -> None:
    """Raises ValueError if a trajectory is on another device, or has another number of bodies."""
    if scene.device != trajectory.device:
        raise ValueError(f"motion: is on {trajectory.device}, the scene on {scene.device}")
    rows, expected, what = trajectory.position.shape[1], scene.body_count, "bodies"
    if trajectory.orientation is None:
        expected, what = scene.layout.vertex_count, "vertices"
    if rows != expected:
        raise ValueError(f"motion: has {rows} {what}, the scene {expected}")


def segments_as_step(
    scene: Scene, trajectory: Trajectory, pairs: Tensor | None
) -> tuple[Scene, RigidMotion | VertexMotion, Tensor | None]:
    """All segments of a trajectory as one step of a scene with one copy of each body per segment, and the checked pairs
    (P, 2) of the scene in each of them, (S P, 2).
    """
    steps = trajectory.steps()
    segments, count = trajectory.segment_count, scene.body_count
    check_scene(scene._detached())
    check_trajectory(scene, trajectory)
    copies = repeated(scene, segments)
    copies.margin = trajectory._margins(copies.margin, count)
    if pairs is None:
        return copies, steps, None
    first_body = torch.arange(segments, device=scene.device)[:, None, None] * count
    return copies, steps, (pairs + first_body).reshape(-1, 2)


def in_scene(pairs: Tensor, count: int) -> tuple[Tensor, Tensor]:
    """The segments (K,), and the pairs (K, 2) in the scene, of pairs (K, 2) of the copies of `count` bodies."""
    segment = torch.div(pairs[:, 0], max(1, count), rounding_mode="floor")
    return segment, pairs - segment[:, None] * count


def repeated(scene: Scene, times: int) -> Scene:
    """A scene with `times` copies of all bodies, each copy in worlds of its own."""
    if scene.body_count * times >= _MOST_ROWS or scene.world_count * times >= _MOST_ROWS:
        raise ValueError(
            f"motion: {times} segments of {scene.body_count} bodies in {scene.world_count} worlds are too many for one "
            "call: more than 2^31 - 1"
        )
    columns = {name: getattr(scene, name) for name in OPTIONAL_COLUMNS}
    columns = {name: column.repeat(times) for name, column in columns.items() if column is not None}
    world = (
        torch.zeros(scene.body_count, dtype=torch.int32, device=scene.device) if scene.world is None else scene.world
    )
    first = torch.arange(times, dtype=torch.int32, device=scene.device) * max(1, scene.world_count)
    columns["world"] = (first[:, None] + world).reshape(-1)
    own = None if scene.self_collision is None else scene.self_collision.repeat(times)
    fixed = {"self_collision": own, "exclude": scene.exclude}
    many = Scene._of_checked(scene.meshes, scene.mesh_index.repeat(times), **columns, **fixed)
    many._capacity_estimates = scene._capacity_estimates
    many._exclude_period = scene.body_count
    return many
