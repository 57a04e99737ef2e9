"""Whether paths of robots are free of contact between their waypoints."""

from __future__ import annotations

import copy
import math
from dataclasses import dataclass

import torch
from torch import Tensor

from pgccd import arguments
from pgccd.contacts.trajectories import time_along
from pgccd.geometry.scene import Scene
from pgccd.motion.of_scene import repeated
from pgccd.motion.paths import RigidMotion
from pgccd.motion.vectors import square_root
from pgccd.robots.certificate import Certificate, Verdict
from pgccd.robots.obstacles import Obstacles
from pgccd.robots.robot import LARGEST_VALUE, Robot
from pgccd.robots.stray import LONGEST_TURN, MOST_TURN, turns
from pgccd.search.detect import detect

# Bodies in one call.
_BODIES_AT_ONCE = 400_000
# A search of fewer steps takes hardly less time. Scenes of so many are kept.
_STEPS_AT_LEAST = 24
# The default resolution, in units of the robot's reach.
_RESOLUTION = 1e-3
# Parts of the resolution: the tolerance of contacts; and the margins aimed at when a step is split.
_TOLERANCE, _MARGIN = 0.125, 0.25
# A step is split into at most so many parts, and not if it is shorter than this part of its segment: then rounding
# decides.
_MOST_PARTS, _SHORTEST = 8, 2.0**-30
# Configurations in which a pair that comes near is looked at.
_WITNESSES = 16


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


@dataclass
class _Steps:
    """Parts of segments, K rows: environment, segment, and the part from `begin` to `end` of it in [0, 1]."""

    environment: Tensor
    segment: Tensor
    begin: Tensor
    end: Tensor

    @classmethod
    def at(cls, environment: Tensor, segment: Tensor, s: Tensor) -> _Steps:
        """Without a length, at times s (K,) of segments."""
        return cls(environment, segment, s, s)

    def __len__(self) -> int:
        return len(self.environment)

    def __getitem__(self, rows: Tensor | slice) -> _Steps:
        return _Steps(*(column[rows] for column in vars(self).values()))

    def followed_by(self, other: _Steps) -> _Steps:
        """Both, in the order of environments and times."""
        both = [torch.cat(columns) for columns in zip(vars(self).values(), vars(other).values(), strict=True)]
        order = torch.argsort(both[2], stable=True)
        order = order[torch.argsort(both[1][order], stable=True)]
        order = order[torch.argsort(both[0][order], stable=True)]
        return _Steps(*(column[order] for column in both))

    def rank(self) -> Tensor:
        """(K,): the number of each among those of its environment, of steps in order."""
        row = torch.arange(len(self), device=self.begin.device)
        begins = torch.ones_like(row, dtype=torch.bool)
        begins[1:] = self.environment[1:] != self.environment[:-1]
        return row - torch.cummax(torch.where(begins, row, 0), dim=0).values

    def split(self, parts: Tensor) -> _Steps:
        """Each in equal parts, as many as given (K,)."""
        row = torch.repeat_interleave(torch.arange(len(self), device=parts.device), parts)
        first = torch.cumsum(parts, 0) - parts
        number = torch.arange(len(row), device=parts.device) - first[row]
        begin, end, count = self.begin[row], self.end[row], parts[row].to(torch.float64)

        def edge(k: Tensor) -> Tensor:
            at = begin + (end - begin) * (k.to(torch.float64) / count)
            return torch.where(k == 0, begin, torch.where(k == parts[row], end, at))

        return _Steps(self.environment[row], self.segment[row], edge(number), edge(number + 1))


@dataclass
class _First:
    """When a contact of each of B environments is known: the segment (B,), -1 for one at the start, and the time within
    it (B,). Both are compared, since their sum is rounded.
    """

    segment: Tensor
    toi: Tensor

    def is_after(self, environment: Tensor, segment: Tensor, toi: Tensor) -> Tensor:
        """(K,) bool: whether it is after these times, of environments (K,)."""
        own, at = self.segment[environment], self.toi[environment]
        return (own > segment) | ((own == segment) & (at > toi))


@dataclass
class _Met:
    """The first contact of each of K steps: toi (K,) within the step, inf without one; both bodies (K, 2); the stray
    margins of both (K,), added; and the point (K, 3).
    """

    toi: Tensor
    bodies: Tensor
    margin: Tensor
    point: Tensor


class PathSearch:
    """The search of `certify`, with the scene of a robot and its obstacles."""

    def __init__(self, robot: Robot, obstacles: Obstacles | None, resolution: float | None) -> None:
        if not isinstance(robot, Robot):
            raise TypeError(f"robot: expected a pgccd.robots.Robot, got {arguments.describe(robot)}")
        self._scene = robot.scene(obstacles)
        if self._scene.margin is not None:
            arguments.refuse_gradient(self._scene.margin, "margin")
        self.robot, self.obstacles = robot, obstacles
        self.resolution = (
            _RESOLUTION * robot.reach if resolution is None else arguments.length(resolution, "resolution")
        )
        if not self.resolution > 0.0:
            raise ValueError(f"resolution: expected a length > 0, got {resolution}")
        self._steps = self._searches = 0
        # By device and number of steps: scenes of so many, made once, since planners ask for one motion at a time.
        self._copies: dict[tuple[torch.device, int], Scene] = {}

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
        self._steps = self._searches = 0
        scene = self._scene if self._scene.device == q.device else self._scene.to(q.device)
        found = Certificate._without_contact(len(q), robot, obstacles, q.device)
        valid = (robot._magnitudes(q) <= LARGEST_VALUE).flatten(1).all(dim=1) & ~robot._may_leave(q).any(dim=1)
        valid &= (self._turns(q[:, 1:] - q[:, :-1]) <= LONGEST_TURN).all(dim=1)
        if obstacles is not None:
            valid &= obstacles._is_sound(len(q)).to(q.device)
        found.verdict[~valid] = int(Verdict.INVALID)
        found.time[~valid] = found.toi[~valid] = 0.0
        steps = self._first_steps(q, valid)
        first = _First(torch.full_like(found.segment, q.shape[1]), torch.full_like(found.toi, torch.inf))
        width = 0
        while len(steps):
            now = torch.ones_like(steps.begin, dtype=torch.bool) if width == 0 else steps.rank() < width
            chosen, rest = steps[now], steps[~now]
            met = self._met(scene, q, chosen, _TOLERANCE * self.resolution)
            if width == 0:
                at_start = (chosen.segment == 0) & (chosen.begin == 0.0) & (met.toi == 0.0)
                first.segment[self._find_starts(scene, q, chosen.environment[at_start], found)] = -1
            steps = rest.followed_by(self._decide(chosen, met, found, first))
            steps = steps[first.is_after(steps.environment, steps.segment, steps.begin)]
            width = max(4, _STEPS_AT_LEAST // len(q), 2 * width)
        rows = torch.nonzero(found.verdict == int(Verdict.NEAR)).flatten()
        found.time[rows] = time_along(found.segment[rows], found.toi[rows], q.shape[1] - 1)
        self._find_witnesses(scene, q, rows, found)
        found.steps, found.searches = self._steps, self._searches
        return found

    def _find_starts(self, scene: Scene, q: Tensor, rows: Tensor, found: Certificate) -> Tensor:
        """Marks the paths, of these environments, that start with a contact; returns them."""
        if not len(rows):
            return rows
        zero = torch.zeros_like(rows)
        met = self._at_rest(scene, q[rows, 0], _Steps.at(rows, zero, zero.to(torch.float64)))
        touches = met.toi < torch.inf
        rows = rows[touches]
        found.verdict[rows] = int(Verdict.START)
        found.time[rows] = found.toi[rows] = 0.0
        found.segment[rows] = 0
        found.links[rows], found.point[rows] = self._links(met.bodies[touches]), met.point[touches]
        return rows

    def _first_steps(self, q: Tensor, wanted: Tensor) -> _Steps:
        """The segments of the wanted environments, in so many parts that links turn little in each."""
        rows = torch.nonzero(wanted).flatten()
        segments = q.shape[1] - 1
        environment = rows.repeat_interleave(segments)
        segment = torch.arange(segments, device=q.device).repeat(len(rows))
        turn = self._turns(q[environment, segment + 1] - q[environment, segment])
        parts = (turn / torch.full_like(turn, 0.99 * MOST_TURN)).ceil().clamp(min=1.0).long()
        whole = _Steps(environment, segment, torch.zeros_like(turn), torch.ones_like(turn))
        return whole.split(parts)

    def _turns(self, step: Tensor) -> Tensor:
        """(...,): by how much links turn at most in steps (..., J), see `turns`."""
        found = turns(self.robot._chains_on(step.device), step.reshape(math.prod(step.shape[:-1]), step.shape[-1]))
        return found.view(step.shape[:-1])

    def _decide(self, steps: _Steps, met: _Met, found: Certificate, first: _First) -> _Steps:
        """Records the contacts of steps that are decided, and returns parts of those that are neither that nor free."""
        rows = torch.nonzero(met.toi < torch.inf).flatten()
        steps, met = steps[rows], _Met(*(column[rows] for column in vars(met).values()))
        length = steps.end - steps.begin
        # Rounded down: never late. What is before has been certified.
        at = (steps.begin + met.toi * length) * (1.0 - 2.0**-50)
        at = torch.where(met.toi > 0.0, torch.maximum(at, steps.begin), steps.begin)
        left = steps.end - at
        near = 2.0 * met.margin + _TOLERANCE * self.resolution <= self.resolution
        near |= length <= _SHORTEST
        self._record(steps[near], at[near], met, near, found, first)
        rows = torch.nonzero(~near).flatten()
        if not len(rows):
            return steps[rows]
        share = (left / length)[rows]
        ratio = met.margin[rows] / torch.full_like(share, _MARGIN * self.resolution)
        parts = (square_root(ratio) * share).ceil().clamp(min=2.0, max=float(_MOST_PARTS)).long()
        open_steps = steps[rows]
        return _Steps(open_steps.environment, open_steps.segment, at[rows], open_steps.end).split(parts)

    def _record(self, steps: _Steps, at: Tensor, met: _Met, rows: Tensor, found: Certificate, first: _First) -> None:
        """Records the first of contacts in each environment, if none before it is known. Steps are in order."""
        earlier = torch.nonzero(first.is_after(steps.environment, steps.segment, at)).flatten()
        row = torch.full_like(first.segment, len(at))
        row.scatter_reduce_(0, steps.environment[earlier], earlier, "amin")
        chosen = row[row < len(at)]
        b = steps.environment[chosen]
        first.segment[b], first.toi[b] = steps.segment[chosen], at[chosen]
        found.verdict[b] = int(Verdict.NEAR)
        found.segment[b], found.toi[b] = steps.segment[chosen], at[chosen]
        found.links[b], found.point[b] = self._links(met.bodies[rows][chosen]), met.point[rows][chosen]

    def _find_witnesses(self, scene: Scene, q: Tensor, rows: Tensor, found: Certificate) -> None:
        """Looks for configurations behind the contacts of these environments in which surfaces touch."""
        if not len(rows):
            return
        # Denser near the contact: up to the end of the segment, and of the next one.
        ahead = torch.tensor([0.0, *(2.0**-k for k in range(_WITNESSES - 3, -1, -1))], dtype=torch.float64)
        ahead = ahead.to(q.device)
        environment = rows.repeat_interleave(len(ahead) + 1)
        segment, toi = found.segment[rows], found.toi[rows]
        s = toi[:, None] + (1.0 - toi[:, None]) * ahead
        s = torch.cat([s, torch.ones_like(s[:, :1])], dim=1)
        segment = segment[:, None].expand_as(s).clone()
        segment[:, -1] = (segment[:, -1] + 1).clamp(max=q.shape[1] - 2)
        when = _Steps.at(environment, segment.reshape(-1), s.reshape(-1))
        met = self._at_rest(scene, _between(q, environment, when.segment, when.begin), when)
        touches = (met.toi < torch.inf).view(len(rows), -1).any(dim=1)
        found.verdict[rows[touches]] = int(Verdict.COLLISION)

    def _at_rest(self, scene: Scene, q: Tensor, when: _Steps) -> _Met:
        """The contacts in K configurations (K, J), with no tolerance, and obstacles where they are then."""
        zero = torch.zeros(len(q), dtype=torch.int64, device=q.device)
        row = torch.arange(len(q), device=q.device)
        still = _Steps(row, zero, torch.zeros_like(q[:, 0]), torch.zeros_like(q[:, 0]))
        return self._met(scene, q[:, None].expand(-1, 2, -1), still, 0.0, when)

    def _met(self, scene: Scene, q: Tensor, steps: _Steps, tolerance: float, when: _Steps | None = None) -> _Met:
        """The first contact of each step; `when`: the times of the obstacles, for configurations at rest."""
        self._steps += len(steps)
        at_once = max(1, _BODIES_AT_ONCE // scene.body_count)
        parts = []
        for begin in range(0, len(steps), at_once):
            some = steps[slice(begin, begin + at_once)]
            own = some if when is None else when[slice(begin, begin + at_once)]
            parts.append(self._met_at_once(scene, q, some, own, tolerance, when is not None))
        if len(parts) == 1:
            return parts[0]
        return _Met(*(torch.cat(columns) for columns in zip(*(vars(part).values() for part in parts), strict=True)))

    def _met_at_once(self, scene: Scene, q: Tensor, steps: _Steps, when: _Steps, tolerance: float, rests: bool) -> _Met:
        robot, obstacles, count, bodies = self.robot, self.obstacles, len(steps), scene.body_count
        q0, q1 = (_between(q, steps.environment, steps.segment, s) for s in (steps.begin, steps.end))
        if rests:
            start = end = robot._tree.forward(q0)
        else:
            start, end = robot._tree.forward(torch.cat([q0, q1])).split(count)
        # Configurations between waypoints are rounded in units of the waypoints, even near zero.
        way = (q[steps.environment, steps.segment + k].abs() for k in (0, 1))
        stray = robot._stray(start, None if rests else end, torch.maximum(*way))
        of_obstacles = stray.new_zeros(0) if obstacles is None else obstacles._error.to(q.device)
        stray = torch.cat([stray, of_obstacles.expand(count, -1)], dim=1).reshape(-1)
        poses = []
        for of_frames, s in ((start, when.begin), (end, when.end)):
            x, r = robot._of_bodies(of_frames)
            if obstacles is not None:
                x, r = obstacles._added_to(x, r, when.environment, when.segment, s)
            poses += [x.reshape(-1, 3), r.reshape(-1, 4)]
        motion = RigidMotion.at_rest(*poses[:2]) if rests else RigidMotion(poses[0], poses[1], poses[2], poses[3])
        if obstacles is not None and obstacles.motion is not None and not rests:
            # That of the part, not the shorter way between both ends.
            of_robot = motion.rotation.view(count, bodies, 3)[:, : robot.body_count]
            rotation = torch.cat([of_robot, obstacles._rotation(when.segment, when.end - when.begin)], dim=1)
            motion = RigidMotion.from_rotation(poses[0], poses[1], poses[2], rotation.reshape(-1, 3))
        many = copy.copy(self._copied(scene, count))
        assert many.margin is not None
        above = torch.nextafter(many.margin + stray, torch.full_like(stray, torch.inf))
        many.margin = torch.where(stray == 0.0, many.margin, above)
        self._searches += 1
        # Few bodies a world: a sweep sorts all worlds at once.
        hits = detect(many, motion, "first", tolerance=tolerance, broad_phase="sweep")
        step = torch.div(hits.pairs[:, 0], bodies, rounding_mode="floor")
        toi = torch.full((count,), torch.inf, dtype=torch.float64, device=q.device)
        toi.scatter_reduce_(0, step, hits.toi, "amin")
        row = torch.arange(len(step), device=q.device)
        is_first = hits.toi == toi[step]
        first = torch.full((count,), len(row), dtype=torch.int64, device=q.device)
        first.scatter_reduce_(0, step[is_first], row[is_first], "amin")
        met = first < len(row)
        chosen = first[met]
        pair = torch.full((count, 2), -1, dtype=torch.int64, device=q.device)
        pair[met] = hits.pairs[chosen] - step[chosen, None] * bodies
        margin = torch.zeros_like(toi)
        margin[met] = stray[hits.pairs[chosen, 0]] + stray[hits.pairs[chosen, 1]]
        point = torch.full((count, 3), torch.nan, dtype=torch.float64, device=q.device)
        point[met] = hits.point[chosen]
        return _Met(toi, pair, margin, point)

    def _copied(self, scene: Scene, count: int) -> Scene:
        """`repeated`; of few copies made once."""
        if count > _STEPS_AT_LEAST:
            return repeated(scene, count)
        if (scene.device, count) not in self._copies:
            self._copies[scene.device, count] = repeated(scene, count)
        return self._copies[scene.device, count]

    def _links(self, bodies: Tensor) -> Tensor:
        """(K, 2): the link of each body, or -1 - k for obstacle k."""
        own = self.robot.body_count
        link = self.robot.body_link.to(bodies.device)
        return torch.where(bodies < own, link[bodies.clamp(max=own - 1)], own - 1 - bodies)


def _between(q: Tensor, environment: Tensor, segment: Tensor, s: Tensor) -> Tensor:
    """(K, J): configurations at times s (K,) of segments."""
    begin, end = q[environment, segment], q[environment, segment + 1]
    s = s[:, None]
    return torch.where(s == 1.0, end, begin + s * (end - begin))
