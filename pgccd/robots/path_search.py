"""Whether paths of robots are free of contact between their waypoints."""

from __future__ import annotations

import torch
from torch import Tensor

from pgccd import arguments, ops
from pgccd.contacts.trajectories import time_along
from pgccd.robots.certificate import Certificate, Verdict, names_of
from pgccd.robots.obstacles import Obstacles
from pgccd.robots.robot import Robot
from pgccd.robots.tables import scene_tables

# The default resolution, in units of the robot's reach.
_RESOLUTION = 1e-3


def certify(
    robot: Robot, q: Tensor, obstacles: Obstacles | None = None, *, resolution: float | None = None
) -> Certificate:
    """Whether paths in joint space are free of contact, of links with obstacles and with each other, at every time
    between waypoints. Joints move at constant rates from one waypoint to the next. Nothing is missed, rounding
    included: a path is `free` only if no two surfaces have a common point on it, and `time` is never late.

    Links do not move on arcs. The bound of how far they stray from them is given as margin, and steps that do not clear
    with it are split: until they clear, or a pair is certainly within `resolution` of each other. See
    docs/explanation/exactness.md, section 14.

    Obstacles may move: in each segment on the arc between two waypoints of their own (`Obstacles.motion`). They are not
    tested against each other. Links that no joint moves are not tested against obstacles at rest: a base may stand on a
    table. A link inside of an obstacle, or of another link, that is a solid (`Mesh.solid`: watertight meshes are)
    touches it: the verdict is START if the path starts so. Links inside of surfaces that are open touch nothing, see
    `Robot.hollow`. Limits of joints are not checked.

    Args:
        robot: the robot.
        q: (B, T, J) configurations, radians or length units: B paths of T waypoints, in environments of their own.
        obstacles: the same for all paths, or of each environment.
        resolution: length > 0: paths on which two surfaces come as near as this may be reported as not free (`NEAR`).
            Default: a thousandth of the robot's reach.

    Returns:
        Certificate, on the device of q: with the first time, the links and the point. Synchronises with a GPU.

    Raises:
        TypeError, ValueError: naming the argument; also if q or the obstacles' margin requires grad. Numbers that are
            not finite are the verdict `INVALID` of their environment alone.

    Example:
        >>> result = pgccd.robots.certify(robot, torch.tensor([[[0.0, 0.0], [1.0, 0.5], [2.0, 0.0]]]), obstacles)
        >>> result.verdict, result.time
    """
    return PathSearch(robot, obstacles, resolution).certify(q)


class PathSearch:
    """The search of `certify`, with the tables of a robot and its obstacles."""

    def __init__(self, robot: Robot, obstacles: Obstacles | None, resolution: float | None) -> None:
        if not isinstance(robot, Robot):
            raise TypeError(f"robot: expected a pgccd.robots.Robot, got {arguments.describe(robot)}")
        scene = robot.scene(obstacles)
        if scene.margin is not None:
            arguments.refuse_gradient(scene.margin, "margin")
        self.robot, self.obstacles = robot, obstacles
        self.resolution = (
            _RESOLUTION * robot.reach if resolution is None else arguments.length(resolution, "resolution")
        )
        if not self.resolution > 0.0:
            raise ValueError(f"resolution: expected a length > 0, got {resolution}")
        of_obstacles = _no_obstacles() if obstacles is None else obstacles.columns()
        self._on: dict[torch.device, tuple[list[Tensor], ...]] = {
            scene.device: (scene.meshes.tensors, scene_tables(scene, robot._tables), of_obstacles)
        }

    def certify(self, q: Tensor) -> Certificate:
        """As `pgccd.robots.certify`."""
        robot, obstacles = self.robot, self.obstacles
        q = robot._configurations(q, "q")
        arguments.refuse_gradient(q, "q")
        if q.dim() != 3 or q.shape[1] < 2:
            raise ValueError(f"q: expected shape (B, T, {robot.joint_count}) with T >= 2, got {tuple(q.shape)}")
        given = None if obstacles is None else obstacles.environments
        if given not in (None, len(q)):
            raise ValueError(f"q: expected {given} environments, as the obstacles have, got {len(q)}")
        motion = None if obstacles is None else obstacles.motion
        if motion is not None and motion.segment_count != q.shape[1] - 1:
            raise ValueError(
                f"q: expected {motion.segment_count + 1} waypoints, as the obstacles have, got {q.shape[1]}"
            )
        mesh_set, bodies, of_obstacles = self._tensors_on(q.device)
        verdict, segment, toi, pair, point, counts = ops.certify_paths(
            mesh_set,
            robot._tables.on(q.device),
            bodies,
            of_obstacles,
            motion is not None,
            robot._room,
            q,
            self.resolution,
        )
        is_contact = (verdict == int(Verdict.COLLISION)) | (verdict == int(Verdict.NEAR))
        own, link = robot.body_count, robot.body_link.to(q.device)
        links = torch.where(pair < own, link[pair.clamp(0, own - 1).long()], own - 1 - pair)
        return Certificate(
            verdict=verdict,
            time=torch.where(is_contact, time_along(segment, toi, q.shape[1] - 1), toi),
            segment=segment,
            toi=toi,
            links=torch.where(pair < 0, len(robot.link_names), links),
            point=point,
            steps=int(counts[:, 1].sum()),
            **names_of(robot, obstacles),
        )

    def _tensors_on(self, device: torch.device) -> tuple[list[Tensor], ...]:
        """Meshes, bodies and obstacles; made once, since planners ask for one motion at a time."""
        if device not in self._on:
            lists = ([tensor.to(device) for tensor in tensors] for tensors in next(iter(self._on.values())))
            self._on[device] = tuple(lists)
        return self._on[device]


def _no_obstacles() -> list[Tensor]:
    """As `Obstacles.columns`."""
    widths = (3, 3, 4, 3)
    return [torch.zeros((1, 0, width), dtype=torch.float64) for width in widths] + [torch.zeros(0, dtype=torch.float64)]
