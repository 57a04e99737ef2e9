"""Whether paths of robots are free of contact between their waypoints."""

from __future__ import annotations

import torch
from torch import Tensor

from pgccd import arguments, ops
from pgccd.contacts.trajectories import time_along
from pgccd.motion.splines import Spline
from pgccd.robots.certificate import Certificate, Verdict, links_of, names_of
from pgccd.robots.joint_paths import JointPaths
from pgccd.robots.obstacles import Obstacles
from pgccd.robots.robot import Robot
from pgccd.robots.tables import scene_tables

#: The default resolution, in units of the robot's reach.
RESOLUTION = 1e-3


def certify(
    robot: Robot, q: Tensor | Spline, obstacles: Obstacles | None = None, *, resolution: float | None = None
) -> Certificate:
    """Whether paths in joint space are free of contact, of links with obstacles and with each other, also between
    waypoints. Joints move at constant rates from one waypoint to the next, or follow splines. Nothing is missed,
    rounding included: a path is `free` only if no two surfaces have a common point on it, and `time` is never late.

    Links do not move on arcs. A bound of how far they stray from arcs becomes the margin of each step. Steps that are
    not free with this margin are split, until they are free or a pair is certainly within `resolution` of each other.
    See docs/explanation/exactness.md, section 14.

    Obstacles may move: in each segment on the arc between two waypoints of their own (`Obstacles.motion`). They are not
    tested against each other. Links that no joint moves are not tested against obstacles at rest: a base may stand on a
    table. A link that is inside of a solid obstacle or a solid link (`Mesh.solid`: watertight meshes are solids)
    touches it; if the path starts like this, the verdict is START. Links inside of open surfaces touch nothing, see
    `Robot.hollow`. Limits of joints are not checked.

    Args:
        robot: the robot.
        q: (B, T, J) configurations, radians or length units: B paths of T waypoints, each in an environment of its own;
            or (T, J), one path. Or a spline of configurations (B, J), or (J,) for one path.
        obstacles: the same for all paths, or for each environment.
        resolution: length > 0: paths on which two surfaces come as near as this may be reported as not free (`NEAR`).
            Default: a thousandth of the robot's reach.

    Returns:
        Certificate, on the device of q: with the first time, the links and the point. Synchronises with a GPU.

    Raises:
        TypeError, ValueError: naming the argument; also if q or the obstacles' margin requires grad. Numbers that are
            not finite are no error: their environment gets the verdict `INVALID`.

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
        self.resolution = RESOLUTION * robot.reach if resolution is None else arguments.length(resolution, "resolution")
        if not self.resolution > 0.0:
            raise ValueError(f"resolution: expected a length > 0, got {resolution}")
        of_obstacles = _no_obstacles() if obstacles is None else obstacles.columns()
        self._on: dict[torch.device, tuple[list[Tensor], ...]] = {
            scene.device: (scene.meshes.tensors, scene_tables(scene, robot._tables), of_obstacles)
        }

    def paths(self, q: Tensor | Spline) -> JointPaths:
        """Paths. Their number, and their number of segments, must be those of the obstacles.

        Raises:
            TypeError, ValueError: they are something else.
        """
        paths = JointPaths.of(self.robot, q)
        given = None if self.obstacles is None else self.obstacles.environments
        if given not in (None, len(paths.control)):
            raise ValueError(f"q: expected {given} environments, as the obstacles have, got {len(paths.control)}")
        motion = None if self.obstacles is None else self.obstacles.motion
        if motion is not None and motion.segment_count != paths.segment_count:
            raise ValueError(
                f"q: expected {motion.segment_count + 1} waypoints, as the obstacles have, got "
                f"{paths.segment_count + 1}"
            )
        return paths

    def certify(self, q: Tensor | Spline) -> Certificate:
        """As `pgccd.robots.certify`."""
        robot, obstacles, paths = self.robot, self.obstacles, self.paths(q)
        motion, device = None if obstacles is None else obstacles.motion, paths.control.device
        mesh_set, bodies, of_obstacles = self._tensors_on(device)
        verdict, segment, toi, pair, point, counts = ops.certify_paths(
            mesh_set,
            robot._tables.on(device),
            bodies,
            of_obstacles,
            motion is not None,
            robot._room,
            paths.control,
            paths.degree,
            paths.error,
            self.resolution,
        )
        is_contact = (verdict == int(Verdict.COLLISION)) | (verdict == int(Verdict.NEAR))
        return Certificate(
            verdict=verdict,
            time=torch.where(is_contact, time_along(segment, toi, paths.segment_count), toi),
            segment=segment,
            toi=toi,
            links=links_of(pair, robot),
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
