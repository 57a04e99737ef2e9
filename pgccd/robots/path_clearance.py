"""How near robots come to obstacles and to themselves along paths."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import ClassVar

import torch
from torch import Tensor

from pgccd import arguments, ops
from pgccd.contacts.contacts import earliest_of_each
from pgccd.contacts.rows import Form, Rows
from pgccd.contacts.trajectories import time_along
from pgccd.geometry.scene_columns import sum_of_margins
from pgccd.motion.of_scene import in_scene, repeated
from pgccd.motion.paths import RigidMotion
from pgccd.motion.splines import Spline
from pgccd.motion.vectors import norm
from pgccd.robots.certificate import links_of, names_in, names_of
from pgccd.robots.joint_paths import JointPaths
from pgccd.robots.obstacles import Obstacles
from pgccd.robots.path_search import RESOLUTION, PathSearch
from pgccd.robots.robot import Robot
from pgccd.robots.tables import MOST_TURN, scene_tables
from pgccd.search.distance import distance

# Parts of the tolerance: for the distances of arcs, and for how far links stray from arcs.
_OF_DISTANCES, _OF_STRAYS = 0.25, 0.0625
# The largest number of parts that a part of a segment is divided into, and the length below which it is not divided,
# since rounding then decides.
_MOST_PARTS, _SHORTEST = 8, 2.0**-24
# Of sums of lengths.
_ROUNDING = 2.0**-40
# Bodies of all parts measured in one call.
_ROWS_AT_ONCE = 1 << 18


@dataclass(frozen=True, eq=False, kw_only=True, repr=False)
class Clearance(Rows):
    """Bounds of the least distance along B paths, each in an environment of its own.

    Attributes:
        lower: (B,) float64 >= 0, length: no two surfaces that are tested are ever nearer than this.
        upper: (B,) float64, length: at `toi` two of them are at most this far apart; inf if none were found within the
            cutoff.
        segment: (B,) int64: the segment of that time; -1 if there is none.
        toi: (B,) float64 in [0, 1], within the segment; nan if there is none.
        time: (B,) float64 in [0, 1], along the path.
        links: (B, 2) int64: what is so near: a link, or -1 - k for obstacle k; the number of links if there is none.
        points: (B, 2, 3) float64, world frame: points of the two surfaces there, to within `upper` - `lower`; nan if
            there are none.
        link_names: names of the robot's links.
        obstacle_names: names of the obstacles.
        untested: `Robot.untested`: pairs that are not measured.

    Example:
        >>> near = robot.clearance(torch.zeros(1, 2, robot.joint_count), obstacles)
        >>> near.lower, near.names(0)
    """

    lower: Tensor
    upper: Tensor
    segment: Tensor
    toi: Tensor
    time: Tensor
    links: Tensor
    points: Tensor
    link_names: list[str] = field(default_factory=list)
    obstacle_names: list[str] = field(default_factory=list)
    untested: list[tuple[str, str, str]] = field(default_factory=list)

    _names: ClassVar[tuple[str, ...]] = ("lower", "upper", "segment", "toi", "time", "links", "points")
    _forms: ClassVar[Mapping[str, Form]] = {
        "lower": (torch.float64, ()),
        "upper": (torch.float64, ()),
        "segment": (torch.int64, ()),
        "toi": (torch.float64, ()),
        "time": (torch.float64, ()),
        "links": (torch.int64, (2,)),
        "points": (torch.float64, (2, 3)),
    }

    def names(self, environment: int) -> tuple[str, ...]:
        """The names of the two that are nearest in an environment; empty if all are further apart than the cutoff.

        Args:
            environment: from 0 to B - 1.

        Raises:
            IndexError: there is no such environment.

        Example:
            >>> robot.clearance(torch.zeros(1, 2, robot.joint_count), obstacles).names(0)
        """
        return names_in(self.links[environment], self.link_names, self.obstacle_names)

    def __repr__(self) -> str:
        if not len(self):
            return "Clearance(environments=0)"
        least = f"least={float(self.lower.min()):.6g}..{float(self.upper.min()):.6g}"
        return f"Clearance(environments={len(self)}, {least})"


def clearance(
    robot: Robot,
    q: Tensor | Spline,
    obstacles: Obstacles | None = None,
    *,
    cutoff: float | None = None,
    tolerance: float | None = None,
) -> Clearance:
    """How near links come to obstacles and to each other along paths in joint space, between waypoints too. Finds a
    certified lower bound and an upper bound of the least distance of surfaces, and where the upper bound is attained.

    Parts of paths are measured on arcs, with the same bounds as in `certify` of how far links stray from arcs. Parts
    that may have the least distance are divided until the bounds are close enough. Pairs that `certify` does not test
    (`Robot.untested`) are not measured either.

    Args:
        robot: the robot.
        q: paths, as for `certify`.
        obstacles: as for `certify`.
        cutoff: length >= 0: larger distances do not matter. If a path stays further away, by more than the tolerance,
            `lower` is the cutoff. Default: all distances matter.
        tolerance: length > 0: how close the bounds are. Default: a thousandth of the robot's reach. Parts of 2^-24 of a
            segment are not divided further; rounding then decides how close the bounds are.

    Returns:
        Clearance, on the device of q. Costs 50 to 100 times a `certify` that finds the path free. Synchronises with
        a GPU.

    Raises:
        TypeError, ValueError: naming the argument; also if a configuration has no pose.

    Example:
        >>> path = torch.tensor([[[0.0, 0.0], [0.3, 0.1]]])
        >>> near = pgccd.robots.clearance(robot, path, obstacles)
        >>> near.lower <= near.upper
        tensor([True])
    """
    search = PathSearch(robot, obstacles, None)
    limit = torch.inf if cutoff is None else arguments.length(cutoff, "cutoff")
    accuracy = RESOLUTION * robot.reach if tolerance is None else arguments.length(tolerance, "tolerance")
    if not accuracy > 0.0:
        raise ValueError(f"tolerance: expected a length > 0, got {tolerance}")
    paths = search.paths(q)
    paths.require_sound(robot)
    if obstacles is not None and obstacles.environments is not None:
        sound = obstacles._is_sound(len(paths.control))
        if not bool(sound.all()):
            raise ValueError(f"obstacles: environment {int((~sound).nonzero()[0])} has invalid poses")
    return _Search(robot, obstacles, paths, limit, accuracy).run()


class _Search:
    """Branch and bound over parts of segments of all paths."""

    def __init__(
        self, robot: Robot, obstacles: Obstacles | None, paths: JointPaths, cutoff: float, tolerance: float
    ) -> None:
        self.robot, self.obstacles, self.paths, self.tolerance = robot, obstacles, paths, tolerance
        self.device, count = paths.control.device, len(paths.control)
        self.scene = robot._scene(obstacles).to(self.device)
        self.segments = paths.segments().flatten(0, 1).contiguous()
        self.lower = torch.full((count,), torch.inf, dtype=torch.float64, device=self.device)
        # Two surfaces come nearer than `upper`; where `segment` is -1, none were found so near.
        self.upper = (self._spheres_at_start() + tolerance).clamp(max=cutoff)
        self.segment = torch.full((count,), -1, device=self.device)
        self.toi = torch.full_like(self.lower, torch.nan)
        self.pair = torch.full((count, 2), -1, device=self.device)
        self.points = torch.full((count, 2, 3), torch.nan, dtype=torch.float64, device=self.device)

    def run(self) -> Clearance:
        count, segments = len(self.paths.control), self.paths.segment_count
        row = torch.arange(count * segments, device=self.device)
        turns = self.paths.turns(self.robot)
        parts = (turns / torch.full_like(turns, 0.99 * MOST_TURN)).ceil().clamp(min=1.0).long().to(self.device)
        zero = torch.zeros(len(row), dtype=torch.float64, device=self.device)
        unfinished = _divided((row // segments, row % segments, zero, zero + 1.0), parts.flatten())
        while len(unfinished[0]):
            at_once = max(1, _ROWS_AT_ONCE // self.scene.body_count)
            measured = [self._measure(*some) for some in zip(*(c.split(at_once) for c in unfinished), strict=True)]
            lower, stray = (torch.cat(columns) for columns in zip(*measured, strict=True))
            path, _, begin, end = unfinished
            wanted = _OF_STRAYS * self.tolerance
            slack = torch.where(self.segment >= 0, self.tolerance, 0.0)
            is_near = lower < (self.upper - slack)[path]
            is_open = is_near & (stray > wanted) & (end - begin > _SHORTEST)
            self.lower.scatter_reduce_(0, path[~is_open], lower[~is_open], "amin")
            into = (stray / torch.full_like(stray, wanted)).sqrt().ceil().clamp(2.0, _MOST_PARTS).long()
            unfinished = _divided([column[is_open] for column in unfinished], into[is_open])
        is_found = self.segment >= 0
        time = time_along(self.segment.clamp(min=0), self.toi.nan_to_num(0.0), segments)
        return Clearance(
            lower=torch.minimum(self.lower, self.upper),
            upper=torch.where(is_found, self.upper, torch.inf),
            segment=self.segment,
            toi=self.toi,
            time=torch.where(is_found, time, torch.nan),
            links=links_of(self.pair, self.robot),
            points=self.points,
            **names_of(self.robot, self.obstacles),
        )

    def _arcs(self, path: Tensor, segment: Tensor, begin: Tensor, end: Tensor) -> list[Tensor]:
        """Arcs of all bodies over parts of segments (K,): as `ops.arm_arcs`, obstacles included."""
        control = self.segments[path * self.paths.segment_count + segment]
        arcs = list(ops.arm_arcs(self.robot._tables.on(self.device), control, self.paths.error, begin, end))
        if self.obstacles is None:
            return arcs
        others = self.obstacles._arcs(path, segment, begin, end)
        return [torch.cat(both, dim=1) for both in zip(arcs, others, strict=True)]

    def _spheres_at_start(self) -> Tensor:
        """(B,): an upper bound of the least distance at the start of each path, from spheres around the bodies."""
        path = torch.arange(len(self.paths.control), device=self.device)
        zero = torch.zeros_like(path, dtype=torch.float64)
        position = self._arcs(path, torch.zeros_like(path), zero, zero)[0]
        first, second, _ = scene_tables(self.scene.to("cpu"), self.robot._tables)[3].to(self.device).long().unbind(1)
        meshes = [*self.robot.meshes, *([] if self.obstacles is None else self.obstacles.meshes)]
        reach = torch.tensor([mesh.reach for mesh in meshes], dtype=torch.float64, device=self.device)
        reach = reach[self.scene.mesh_index.long()]
        apart = norm(position[:, first] - position[:, second]) + reach[first] + reach[second]
        return (1.0 + _ROUNDING) * torch.cat([apart, apart.new_full((len(apart), 1), torch.inf)], dim=1).amin(dim=1)

    def _measure(self, path: Tensor, segment: Tensor, begin: Tensor, end: Tensor) -> tuple[Tensor, Tensor]:
        """Lower bounds of the distance over parts of segments (K,), and bounds of how far bodies stray (K,). Keeps the
        nearest points that are found.
        """
        cutoff = float(self.upper[path].amax())
        if math.isinf(cutoff):  # no pairs are tested
            return self.upper[path], torch.zeros_like(begin)
        position_t0, position_t1, orientation, rotation, stray = self._arcs(path, segment, begin, end)
        arcs = (column.flatten(0, 1) for column in (position_t0, orientation, position_t1, rotation))
        copies, count = repeated(self.scene, len(path)), self.scene.body_count
        copies.margin = sum_of_margins(stray.reshape(-1), copies.margin)
        start, turned, goal, turn = arcs
        motion = RigidMotion.from_rotation(start, turned, goal, turn)
        found = distance(copies, motion, cutoff=cutoff, tolerance=_OF_DISTANCES * self.tolerance)
        part, pair = in_scene(found.pairs, count)
        lower = torch.full_like(begin, cutoff).scatter_reduce(0, part, found.lower, "amin")
        # Strays count twice: as margins they make bodies nearer on arcs, and bodies may be off their arcs by as much
        # again.
        upper = (found.upper + 2.0 * (stray[part, pair[:, 0]] + stray[part, pair[:, 1]])) * (1.0 + _ROUNDING)
        row = earliest_of_each(path[part], len(self.upper), upper)
        row = row[upper[row] < self.upper[path[part[row]]]]
        where = path[part[row]]
        self.upper[where], self.pair[where], self.points[where] = upper[row], pair[row], found.points[row]
        self.segment[where] = segment[part[row]]
        self.toi[where] = begin[part[row]] + found.time[row] * (end - begin)[part[row]]
        return lower, stray.amax(dim=1)


def _divided(parts: Sequence[Tensor], into: Tensor) -> list[Tensor]:
    """Parts of segments, (path, segment, begin, end) (K,) each, divided into `into` (K,) equal parts each."""
    path, segment, begin, end = (column.repeat_interleave(into) for column in parts)
    first = (into.cumsum(0) - into).repeat_interleave(into)
    number, count = torch.arange(len(path), device=path.device) - first, into.repeat_interleave(into)
    length = end - begin
    edges = [begin + length * (k.double() / count.double()) for k in (number, number + 1)]
    return [path, segment, edges[0], torch.where(number + 1 == count, end, edges[1])]
