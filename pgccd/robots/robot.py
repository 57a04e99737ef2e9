"""Robots: a kinematic tree with collision surfaces, as bodies of a scene."""

from __future__ import annotations

import copy
import math
import warnings
from collections.abc import Callable, Iterable, Sequence
from itertools import combinations
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import Tensor

from pgccd import arguments
from pgccd.geometry.mesh import Mesh
from pgccd.geometry.scene import Scene
from pgccd.motion.of_scene import repeated
from pgccd.motion.paths import RigidMotion
from pgccd.motion.trajectory import Trajectory
from pgccd.robots.kinematics import Joint, Poses, Tree
from pgccd.robots.obstacles import Obstacles
from pgccd.robots.shapes import PLANE, ThickSurface, joined
from pgccd.robots.stray import LONGEST_TURN, MOST_TURN, Chains, pose_error, stray_bound, turns
from pgccd.search.detect import collide

if TYPE_CHECKING:
    from pgccd.robots.certificate import Certificate
    from pgccd.robots.validator import MotionValidator

#: Larger values of joints, radians or length units, have no poses.
LARGEST_VALUE = 1e6
#: The reason why surfaces of links i and j, of the groups that the reader gave them, are never tested, or None.
WhyUntested = Callable[[int, tuple[int, ...], int, tuple[int, ...]], str | None]
# Configurations tested in one call.
_SAMPLES_AT_ONCE = 2000


class Robot:
    """An arm, or any robot on a fixed base: links joined by revolute and prismatic joints, in a tree. Made by
    `load_urdf` and `load_mjcf`.

    A link is one body, whose mesh has its origin at the link's joint; one with spheres or capsules of several radii is
    one body a radius, since the radius is the body's margin. Links without collision surfaces have no body. Infinite
    planes are bodies of their own: squares that no part of the robot can leave within the limits.

    Attributes:
        name: of the robot, as in the file.
        joint_names: (J) the names of the joints that a configuration has a value for, in its order. Joints that mimic
            another have none.
        lower, upper: (J,) float64 limits, radians or length units; infinite where there are none.
        link_names: names of all links.
        body_link: (N,) int64: the link of each body.
        meshes: (N) `Mesh` of each body.
        margin: (N,) float64, thickness of each body.
        moves: (N,) bool: whether joints move the body.
        exclude: (E, 2) int64: pairs of bodies that are never tested.
        untested: why: the names of two links, and a reason, of each pair of links whose bodies are never tested against
            each other: "both fixed" (no joint moves them), "adjacent" (joined; see the reader of the file), "file" (the
            file excludes the pair), "sampled" (`excluding_sampled`), "asked" (`excluding`). Where that holds for some
            of the bodies only, the reason ends in ", in part".
        reach: length: no point of the robot is further from its base, in any configuration within the limits; of
            prismatic joints without limits within 1 length unit of 0. Without infinite planes.

    Example:
        >>> robot = pgccd.robots.load_urdf("arm.urdf")
        >>> result = robot.certify(torch.tensor([[[0.0, 0.0], [1.0, 0.5]]]), obstacles)  # (B, T, J)
        >>> result.free
        tensor([True])
    """

    def __init__(
        self,
        name: str,
        tree: Tree,
        links: Sequence[tuple[str, int, Sequence[ThickSurface]]],
        joint_names: Sequence[str],
        limits: Sequence[tuple[float, float]],
        why_untested: WhyUntested,
    ) -> None:
        """
        Args:
            tree: the joints.
            links: name, frame and surfaces, in the frame, of each.
            joint_names, limits: of each entry of a configuration.
            why_untested: the reason why surfaces of two links are never tested, or None; of links that joints move.
        """
        self.name, self.joint_names = name, list(joint_names)
        self.lower, self.upper = torch.tensor(limits, dtype=torch.float64).reshape(-1, 2).unbind(1)
        self.link_names = [link for link, _, _ in links]
        self._tree = tree
        lengths = {frame: self._length(tree.chains[frame]) for _, frame, _ in links}
        all_surfaces = [(lengths[frame], surface) for _, frame, surfaces in links for surface in surfaces]
        self.reach = max((length + each.reach for length, each in all_surfaces if not each.infinite), default=PLANE)
        away = [length + float(np.linalg.norm(each.centre)) for length, each in all_surfaces if each.infinite]
        # Half the side of the squares in place of infinite planes, and by how much all joints together may slide before
        # a body may be beside one.
        slides = sum(self._slide(joint) for joint in tree.joints)
        half = max(PLANE, 2.0 * (self.reach + slides + max(away, default=0.0)))
        self._room = half - self.reach - max(away) if away else np.inf
        meshes, owners, frames, margins, groups = [], [], [], [], []
        for number, (link, frame, surfaces) in enumerate(links):
            for kind in sorted({(each.infinite, each.thickness, each.group) for each in surfaces}):
                alike = [each for each in surfaces if (each.infinite, each.thickness, each.group) == kind]
                surface = joined([each.widened(half) if each.infinite else each for each in alike])
                try:
                    mesh = Mesh(surface.vertices, surface.faces, solid="auto")
                except ValueError as error:
                    raise ValueError(f"link {link!r}: {error}") from error
                mesh.name = link
                meshes.append(mesh)
                owners.append(number)
                frames.append(frame)
                margins.append(kind[1])
                groups.append(kind[2])
        if not meshes:
            raise ValueError(f"robot {name!r} has no collision surfaces")
        self.meshes = meshes
        self.body_link = torch.tensor(owners)
        self.margin = torch.tensor(margins, dtype=torch.float64)
        self._frames = frames
        self._extents = [mesh.reach for mesh in meshes]
        self._chains: dict[torch.device, Chains] = {}
        chains = [tree.chains[frame] for frame in frames]
        self.moves = torch.tensor([any(tree.joints[k].kind != "fixed" for k in chain) for chain in chains])
        moves = self.moves.tolist()
        self._why_untested: dict[tuple[int, int], str] = {}
        for i, j in combinations(range(len(meshes)), 2):
            reason = why_untested(owners[i], groups[i], owners[j], groups[j]) if moves[i] or moves[j] else "both fixed"
            if owners[i] == owners[j] or reason is not None:
                self._why_untested[i, j] = reason or ""

    @property
    def joint_count(self) -> int:
        """J: the number of entries of a configuration."""
        return len(self.joint_names)

    @property
    def body_count(self) -> int:
        """N: the number of bodies."""
        return len(self.meshes)

    def _length(self, chain: Sequence[int]) -> float:
        return sum(self._tree.distances[k] + self._slide(self._tree.joints[k]) for k in chain[1:])

    def _slide(self, joint: Joint) -> float:
        """How far a prismatic joint slides at most; zero for others."""
        if joint.kind != "prismatic":
            return 0.0
        ends = (float(self.lower[joint.coordinate]), float(self.upper[joint.coordinate]))
        return max(abs(joint.scale * (q if np.isfinite(q) else 1.0) + joint.offset) for q in ends)

    def _may_leave(self, q: Tensor) -> Tensor:
        """(...): whether in configurations (..., J) a body may be beside the square in place of an infinite plane."""
        slides = torch.zeros(q.shape[:-1], dtype=q.dtype, device=q.device)
        for joint in self._tree.joints:
            if joint.kind == "prismatic":
                slides = slides + (joint.scale * q[..., joint.coordinate] + joint.offset).abs()
        return slides > self._room

    @property
    def exclude(self) -> Tensor:
        return torch.tensor(sorted(self._why_untested), dtype=torch.int64).reshape(-1, 2)

    @property
    def untested(self) -> list[tuple[str, str, str]]:
        owner = self.body_link.tolist()
        reasons: dict[tuple[int, int], set[str | None]] = {}
        for i, j in combinations(range(self.body_count), 2):
            if owner[i] != owner[j]:
                reasons.setdefault((owner[i], owner[j]), set()).add(self._why_untested.get((i, j)))
        found = []
        for (a, b), why in reasons.items():
            said = sorted(reason for reason in why if reason is not None)
            if said:
                found.append((self.link_names[a], self.link_names[b], said[0] + (", in part" if None in why else "")))
        return found

    def excluding(self, links: Iterable[tuple[str, str]]) -> Robot:
        """A robot of which these pairs of links are not tested either.

        Args:
            links: pairs of names.

        Raises:
            TypeError, ValueError: these are no pairs of names, or a link is unknown.

        Example:
            >>> gripper = robot.excluding([("base", "tool")])
        """
        expected = "links: expected pairs of names, such as [('base', 'tool')]"
        if not isinstance(links, Iterable):
            raise TypeError(f"{expected}, got {arguments.describe(links)}")
        given = list(links)
        for pair in given:
            if isinstance(pair, str) or not isinstance(pair, Sequence) or len(pair) != 2:
                raise TypeError(f"{expected}, got {given!r}")
        return self._excluding([(self._link(a), self._link(b)) for a, b in given], "asked")

    def _excluding(self, links: Iterable[tuple[int, int]], reason: str) -> Robot:
        left_out = {frozenset(pair) for pair in links}
        owner = self.body_link.tolist()
        pairs = combinations(range(self.body_count), 2)
        added = {(i, j): reason for i, j in pairs if frozenset((owner[i], owner[j])) in left_out}
        other = copy.copy(self)
        other._why_untested = added | self._why_untested
        return other

    def _link(self, name: str) -> int:
        if name not in self.link_names:
            raise ValueError(f"links: expected names of links, such as {self.link_names[0]!r}, got {name!r}")
        return self.link_names.index(name)

    def excluding_sampled(self, samples: int = 1000, share: float = 0.95, seed: int = 0) -> Robot:
        """A robot of which pairs of links are not tested that collide in nearly all random configurations, since their
        surfaces overlap by design. Pairs that never collide in the samples stay tested.

        Args:
            samples: number of configurations, uniform within the limits; joints that turn without limits by up to pi.
            share: pairs are left out if they collide in at least this part of them.
            seed: of the random numbers.

        Raises:
            ValueError: naming the argument; or a prismatic joint has no limits.

        Example:
            >>> robot = robot.excluding_sampled()
        """
        samples = arguments.integer(samples, "samples", 1, "a number of configurations > 0")
        share = arguments.number(share, "share", "a number in (0, 1]")
        if not 0.0 < share <= 1.0:
            raise ValueError(f"share: expected a number in (0, 1], got {share}")
        generator = torch.Generator().manual_seed(arguments.integer(seed, "seed", 0, "an integer >= 0"))
        low, high = self._sampling_limits()
        q = low + (high - low) * torch.rand((samples, self.joint_count), generator=generator, dtype=torch.float64)
        owner, count = self.body_link, len(self.link_names)
        times = torch.zeros(count * count, dtype=torch.int64)
        for some in q.split(_SAMPLES_AT_ONCE):
            many = repeated(self.scene(), len(some))
            x, r = self.poses(some)
            at_rest = RigidMotion.at_rest(x.flatten(0, 1), r.flatten(0, 1))
            pairs = collide(many, at_rest).pairs
            # Each pair of links once a configuration, although they may be several bodies.
            sample = pairs[:, 0] // self.body_count
            of_links = owner[pairs % self.body_count].sort(dim=1).values
            once = torch.unique((sample * count + of_links[:, 0]) * count + of_links[:, 1])
            times += torch.bincount(once % (count * count), minlength=count * count)
        always = torch.nonzero(times >= share * samples).flatten().tolist()
        return self._excluding([(key // count, key % count) for key in always], "sampled")

    def _sampling_limits(self) -> tuple[Tensor, Tensor]:
        low, high = self.lower.clone(), self.upper.clone()
        for joint in self._tree.joints:
            k = joint.coordinate
            if k < 0 or (np.isfinite(float(low[k])) and np.isfinite(float(high[k]))):
                continue
            if joint.kind == "prismatic":
                raise ValueError(f"samples: joint {joint.name!r} has no limits: set `lower` and `upper` of the robot")
            low[k], high[k] = -torch.pi, torch.pi
        return low, high

    def poses(self, q: Tensor) -> tuple[Tensor, Tensor]:
        """Poses of the bodies: forward kinematics.

        Args:
            q: (..., J) configurations, radians or length units, float32 or float64.

        Returns:
            Positions (..., N, 3) and orientations (..., N, 4), unit quaternions (w, x, y, z), body to world; nan where
            the value of a joint is not finite or larger than 1e6, or the robot may leave the square in place of an
            infinite plane. If q requires grad, then so do they; a
            `pgccd.Trajectory` of them has contacts with gradients.

        Raises:
            TypeError, ValueError: q has another type or shape.

        Example:
            >>> position, orientation = robot.poses(torch.zeros(robot.joint_count))
        """
        q = self._configurations(q, "q")
        found = self._tree.forward(q.reshape(math.prod(q.shape[:-1]), self.joint_count))
        shape = (*q.shape[:-1], self.body_count)
        x, r = self._of_bodies(found)
        if np.isfinite(self._room):
            x = torch.where(self._may_leave(q).reshape(-1, 1, 1), torch.nan, x)
        return x.reshape(*shape, 3), r.reshape(*shape, 4)

    def _of_bodies(self, poses: Poses) -> tuple[Tensor, Tensor]:
        """(K, N, 3) and (K, N, 4)."""
        x, r = (of[self._frames].transpose(0, 1) for of in (poses.position, poses.orientation))
        return x, r

    def _configurations(self, q: Tensor, name: str) -> Tensor:
        q = arguments.real_tensor(q, name)
        if q.dim() < 1 or q.shape[-1] != self.joint_count:
            raise ValueError(f"{name}: expected shape (..., {self.joint_count}), got {tuple(q.shape)}")
        return (q if arguments.is_differentiated(q) else q.detach()).to(torch.float64).contiguous()

    def _magnitudes(self, q: Tensor) -> Tensor:
        """(..., n): of the entries of configurations (..., J) and of what joints make of them; nan if not finite."""
        columns = [q.abs()]
        for joint in self._tree.joints:
            if joint.kind != "fixed":
                columns.append(q[..., joint.coordinate, None].abs() * abs(joint.scale) + abs(joint.offset))
        return torch.cat(columns, dim=-1)

    def scene(self, obstacles: Obstacles | None = None) -> Scene:
        """The robot's bodies, then those of the obstacles, which do not move. Bodies that do not move are not tested
        against each other.

        Args:
            obstacles: the obstacles, if any.

        Raises:
            TypeError: they are something else.

        Example:
            >>> scene = robot.scene(obstacles)
            >>> pgccd.show(scene, robot.trajectory(torch.zeros(2, robot.joint_count), obstacles))
        """
        if obstacles is not None and not isinstance(obstacles, Obstacles):
            raise TypeError(f"obstacles: expected pgccd.robots.Obstacles, got {arguments.describe(obstacles)}")
        meshes, margin, static = list(self.meshes), self.margin, ~self.moves
        if obstacles is not None:
            first = len(meshes)
            meshes += obstacles.meshes
            index = torch.cat([torch.arange(first), first + obstacles.mesh_index])
            margin = torch.cat([margin, obstacles.margin])
            static = torch.cat([static, torch.ones(obstacles.count, dtype=torch.bool)])
        else:
            index = torch.arange(len(meshes))
        return Scene(meshes, index, static=static, margin=margin, exclude=self.exclude)

    def trajectory(self, q: Tensor, obstacles: Obstacles | None = None) -> Trajectory:
        """The path through configurations, for `pgccd.detect` with `scene`: with margins within which links stray from
        arcs while joints move at constant rates. A contact of it may be due to these margins; `certify` makes them as
        small as needed.

        If a link turns by more than 0.99 rad between two waypoints, all joints added, every segment is split into the
        same number of equal parts: times along the whole path stay what they are, and a segment of `q` becomes
        `segment_count / (T - 1)` segments.

        Args:
            q: (T, J) configurations of the waypoints.
            obstacles: as for `scene`; the same in all environments.

        Raises:
            TypeError, ValueError: q has another type or shape or requires grad, or a joint has a value larger than 1e6;
                or the robot may leave the square in place of an infinite plane; or a link turns by more than 1e4
                radians between two waypoints, all joints added.

        Example:
            >>> path = robot.trajectory(torch.linspace(0, 1, 20)[:, None].expand(20, robot.joint_count))
        """
        q = self._configurations(q, "q")
        if q.dim() != 2 or len(q) < 2:
            raise ValueError(f"q: expected shape (T, {self.joint_count}) with T >= 2, got {tuple(q.shape)}")
        arguments.refuse_gradient(q, "q")
        allowed = (self._magnitudes(q) <= LARGEST_VALUE).all(dim=-1)
        if not bool(allowed.all()):
            waypoint = int((~allowed).long().argmax())
            expected = f"joint values of at most {LARGEST_VALUE:g}"
            raise ValueError(f"q: waypoint {waypoint}: expected {expected}, got {q[waypoint].tolist()}")
        leaves = self._may_leave(q)
        if bool(leaves.any()):
            waypoint = int(leaves.long().argmax())
            expected = f"joints that slide by at most {self._room:g}, added, since the robot has an infinite plane"
            raise ValueError(f"q: waypoint {waypoint}: expected {expected}, got {q[waypoint].tolist()}")
        turn = turns(self._chains_on(q.device), q[1:] - q[:-1])
        if not bool((turn <= LONGEST_TURN).all()):
            segment = int((~(turn <= LONGEST_TURN)).long().argmax())
            expected = f"turns of at most {LONGEST_TURN:g} rad, all joints added"
            raise ValueError(f"q: segment {segment}: expected {expected}, got {float(turn[segment]):.3g}")
        parts = max(1, math.ceil(float(turn.max()) / (0.99 * MOST_TURN)))  # less, for the rounding of what is between
        size = torch.maximum(q[:-1].abs(), q[1:].abs())  # rounding of what is between grows with both ends
        s = q.new_tensor([k / parts for k in range(parts)])[:, None]  # torch divides otherwise on a GPU
        q = torch.cat([(q[:-1, None] + s * (q[1:] - q[:-1])[:, None]).flatten(0, 1), q[-1:]])
        poses = self._tree.forward(q)
        before, after = (
            Poses(*(column[:, rows] for column in vars(poses).values())) for rows in (slice(None, -1), slice(1, None))
        )
        margin = self._stray(before, after, size.repeat_interleave(parts, dim=0))
        x, r = self._of_bodies(poses)
        if obstacles is not None:
            if obstacles.environments is not None:
                expected = "obstacles with one pose each"
                raise ValueError(f"obstacles: expected {expected}, got {obstacles.environments} environments")
            x, r = obstacles._added_to(x, r, torch.zeros(len(q), dtype=torch.int64))
            margin = torch.cat([margin, margin.new_zeros(len(margin), obstacles.count)], dim=1)
        return Trajectory(x, r, margin=margin)

    def _stray(self, start: Poses, end: Poses | None, q: Tensor) -> Tensor:
        """(K, N): how far the bodies stray from the arcs that are tested, rounding included; without an end they are at
        rest. q: (K, J) magnitudes.
        """
        chains = self._chains_on(q.device)
        error = pose_error(chains, q)
        return error if end is None else stray_bound(chains, start, end) + error

    def _chains_on(self, device: torch.device) -> Chains:
        if device not in self._chains:
            self._chains[device] = Chains(self._tree, self._frames, self._extents, device)
        return self._chains[device]

    def certify(self, q: Tensor, obstacles: Obstacles | None = None, *, resolution: float | None = None) -> Certificate:
        """Whether paths are free of contact, between waypoints too.

        Args:
            q: (B, T, J) configurations.
            obstacles, resolution: as for `pgccd.robots.certify`.

        Raises:
            TypeError, ValueError: naming the argument.

        Example:
            >>> robot.certify(torch.zeros(1, 2, robot.joint_count)).free
            tensor([True])
        """
        from pgccd.robots.path_search import certify

        return certify(self, q, obstacles, resolution=resolution)

    def motion_validator(
        self, obstacles: Obstacles | None = None, *, resolution: float | None = None
    ) -> MotionValidator:
        """A function of two configurations that says whether the straight motion in joint space between them is
        certainly free of contact, as planners such as OMPL and MoveIt ask. False has several reasons, which `certify`
        tells apart: also that links touch at the start, or that a value is not finite.

        Args:
            obstacles, resolution: as for `pgccd.robots.certify`.

        Raises:
            TypeError, ValueError: naming the argument; also when the function is called.

        Example:
            >>> is_valid = robot.motion_validator(obstacles)
            >>> is_valid([0.0, 0.0], [0.3, 0.1])
            True
            >>> is_valid.last_valid([0.0, 0.0], [0.3, 0.1])
            1.0
        """
        from pgccd.robots.validator import MotionValidator

        return MotionValidator(self, obstacles, resolution)

    def __repr__(self) -> str:
        counts = f"joints={self.joint_count}, links={len(self.link_names)}, bodies={self.body_count}"
        return f"Robot({self.name!r}, {counts}, untested pairs={len(self.untested)})"


def robot_of_file(path: Path, neutral: Sequence[float], *parts: Any) -> Robot:
    """A robot of these parts, as `Robot` takes them, from a file. Warns of pairs of links that are tested and touch in
    the `neutral` configuration (J,).

    Raises:
        ValueError: naming the file.
    """
    try:
        robot = Robot(*parts)
    except ValueError as error:
        raise ValueError(f"path: {path}: {error}") from error
    if robot.body_count < 2:
        return robot
    x, r = robot.poses(torch.tensor(neutral, dtype=torch.float64).reshape(-1))
    touching = robot.body_link[collide(robot.scene(), RigidMotion.at_rest(x, r)).pairs]
    if len(touching):
        links = torch.unique(touching.sort(dim=1).values, dim=0).tolist()
        pairs = [(robot.link_names[a], robot.link_names[b]) for a, b in links]
        warnings.warn(
            f"{path}: links touch in the neutral configuration, so that no path through it is free. If their surfaces "
            f"overlap by design: robot = robot.excluding({pairs})",
            stacklevel=3,
        )
    return robot
