"""A scene in motion: what the stages work on."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from pgccd import ops
from pgccd.mesh import LARGEST_RADIUS, SMALLEST_RADIUS
from pgccd.motion import RigidMotion, VertexMotion
from pgccd.scene import Scene


class MovingBodies:
    """The bodies of `scene` during one step of `motion`, in the form the operators read.

    For deforming bodies this computes each body's bounds (refit of its hierarchy), once for all stages.

    Args:
        wait: raise for an invalid pose now. Otherwise `first_faults` tells, and nothing waits for a device; the stages
            then take `invalid`, or must not be called.

    Raises:
        ValueError: if scene and motion disagree in number or device, or a pose is invalid.

    Example:
        >>> bodies = pgccd.MovingBodies(scene, motion)
        >>> pairs = pgccd.broad.sweep(bodies)
    """

    def __init__(self, scene: Scene, motion: RigidMotion | VertexMotion, *, wait: bool = True) -> None:
        if scene.device != motion.device:
            raise ValueError(f"motion: is on {motion.device}, the scene on {scene.device}")
        self.scene = scene
        self.motion = motion
        #: True if vertices move on straight lines instead of arcs.
        self.linear_path = isinstance(motion, VertexMotion) or motion.path == "linear"
        #: True for explicit vertex streams.
        self.deforming = isinstance(motion, VertexMotion)
        #: Whether the poses are known to be valid.
        self.checked = wait
        if wait:
            motion.check()
        #: The operators' `bodies` argument; rows 1 to 3 are positions at t0 and t1 (N, 3), of the origins or of the SBV
        #: centres of bodies that deform, and SBV radius (N,).
        self.tensors = _deforming(scene, motion) if isinstance(motion, VertexMotion) else _rigid(scene, motion)
        if scene.margin is not None:
            self.tensors.append(scene.margin)
        if self.deforming or scene.meshes.is_centred:
            spheres = self.position_t0, self.position_t1, self.radius
        else:
            spheres = ops.moving_spheres(self.mesh_set, self.tensors, self.linear_path)
        #: (N, 3), (N, 3), (N,): at every time the body and its margin are within `reach` of the point as far along from
        #: `centre_t0` to `centre_t1`, its SBV centres at the two ends. What broad phases test.
        self.centre_t0, self.centre_t1, self.reach = spheres
        if scene.margin is not None:
            self.reach = (self.reach + scene.margin) * (1.0 + 2.0**-50)
        if wait and self.deforming:
            self.raise_faults(self.first_faults().tolist())

    def first_faults(self) -> Tensor:
        """(F,) int64: the first faulty row of each thing checked, or a number past the last one; and 1 if there is any
        such row, else 0."""
        faults = self.motion.first_faults()
        if not self.deforming:
            return faults
        # A body may shrink to a point.
        sound = (self.radius == 0.0) | ((self.radius >= SMALLEST_RADIUS) & (self.radius <= LARGEST_RADIUS))
        row = torch.arange(len(sound), device=sound.device)
        body = torch.where(sound, len(sound), row).min().reshape(1) if len(sound) else row.sum().reshape(1)
        return torch.cat([body, faults[:-1], torch.maximum(faults[-1:], (body < len(sound)).long())])

    def raise_faults(self, first: Sequence[int]) -> None:
        """Raises ValueError for the values of `first_faults`, if any names a row."""
        if not self.deforming:
            return self.motion.raise_faults(first)
        body, *of_motion = first
        self.motion.raise_faults(of_motion)
        if body < self.scene.body_count:
            raise ValueError(
                f"motion: body {body} has SBV radius {float(self.radius[body]):g}; "
                f"it must lie in [{SMALLEST_RADIUS:g}, {LARGEST_RADIUS:g}]"
            )

    @property
    def device(self) -> torch.device:
        return self.scene.device

    @property
    def mesh_set(self) -> list[Tensor]:
        """The operators' `mesh_set` argument."""
        return self.scene.meshes.tensors

    @property
    def position_t0(self) -> Tensor:
        return self.tensors[1]

    @property
    def position_t1(self) -> Tensor:
        return self.tensors[2]

    @property
    def radius(self) -> Tensor:
        return self.tensors[3]

    @property
    def self_colliding(self) -> Tensor:
        """(S,) int64, ascending: the bodies that are tested against themselves. None unless they deform: distances
        within a rigid body stay, and on straight paths it changes by an affine map, which joins nothing that is apart
        (but for the moment in the middle of exactly half a turn).
        """
        rows = self.scene.self_colliding
        return rows if self.deforming else rows[:0]


def _rigid(scene: Scene, motion: RigidMotion) -> list[Tensor]:
    if motion.body_count != scene.body_count:
        raise ValueError(f"motion: has {motion.body_count} bodies, the scene {scene.body_count}")
    return [
        scene.mesh_index,
        motion.position_t0,
        motion.position_t1,
        scene.radius,
        motion.orientation_t0,
        motion.rotation,
    ]


def _deforming(scene: Scene, motion: VertexMotion) -> list[Tensor]:
    layout = scene.layout
    if motion.x_t0.shape[0] != layout.vertex_count:
        expected = f"the scene's bodies have {layout.vertex_count}"
        raise ValueError(f"motion: x_t0 has {motion.x_t0.shape[0]} vertices, {expected}")
    vertices, begins = (motion.x_t0, motion.x_t1), (layout.vertex_begin, layout.block_begin)
    position_t0, position_t1, radius, blocks_t0, blocks_t1 = ops.refit(
        scene.meshes.tensors, scene.mesh_index, *vertices, *begins, layout.block_count
    )
    return [scene.mesh_index, position_t0, position_t1, radius, *vertices, blocks_t0, blocks_t1, *begins]
