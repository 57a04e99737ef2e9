"""Robots: a kinematic tree with collision surfaces, as bodies of a scene."""

from __future__ import annotations

import copy
import math
from collections.abc import Iterable, Sequence
from itertools import combinations
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor

from pgccd import arguments, ops
from pgccd.geometry.mesh import Mesh
from pgccd.geometry.scene import Scene
from pgccd.motion.of_scene import repeated
from pgccd.motion.paths import RigidMotion
from pgccd.motion.splines import Spline
from pgccd.motion.trajectory import Trajectory
from pgccd.robots.attached import Attached
from pgccd.robots.joint_paths import JointPaths
from pgccd.robots.kinematics import Joint, Tree
from pgccd.robots.obstacles import Obstacles
from pgccd.robots.shapes import PLANE, ThickSurface, joined
from pgccd.robots.tables import MOST_TURN, ArmTables
from pgccd.robots.untested import LeftOut, WhyUntested, sorted_pairs
from pgccd.search.detect import collide

if TYPE_CHECKING:
    from pgccd.robots.certificate import Certificate
    from pgccd.robots.path_clearance import Clearance
    from pgccd.robots.validator import MotionValidator

#: Name, frame and surfaces, in the frame, of a link.
Link = tuple[str, int, Sequence[ThickSurface]]
# Configurations tested in one call.
_SAMPLES_AT_ONCE = 2000


class Robot:
    """An arm, or any robot on a fixed base: links joined by revolute and prismatic joints, in a tree. Made by
    `load_urdf` and `load_mjcf`.

    A link is one body, whose mesh has its origin at the link's joint. A link with spheres or capsules of several radii
    has one body for each radius, because the radius is the thickness of the mesh. Links without collision surfaces have
    no body. Infinite planes are bodies of their own: squares that no part of the robot can leave within the limits. An
    object that the robot carries (`attach`) is also a link, the last one, with its mesh's origin.

    Attributes:
        name: of the robot, as in the file.
        joint_names: (J) the names of the joints that a configuration has a value for, in its order. Joints that mimic
            another joint have no value.
        lower, upper: (J,) float64 limits, radians or length units; infinite where there are none.
        link_names: names of all links, attached objects included.
        attached: names of the attached objects.
        body_link: (N,) int64: the link of each body.
        meshes: (N) `Mesh` of each body.
        moves: (N,) bool: whether joints move the body.
        exclude: (E, 2) int64: pairs of bodies that are never tested.
        untested: for each pair of links whose bodies are never tested against each other, both names and the reason:
            "both fixed" (no joint moves them), "adjacent" (joined; see the reader of the file), "file" (the file
            excludes the pair), "sampled" (`excluding_sampled`), "attached" (an object and the link that carries it),
            "touching" (an object and a link in `touching` of `attach`), "allowed" (`allow`). If this holds for only
            some of the bodies of the links, the reason ends in ", in part". Also pairs of a link and an obstacle:
            "allowed".
        reach: length: no point of the robot is further from its base, in any configuration within the limits. Prismatic
            joints without limits count within 1 length unit of 0; infinite planes do not count.

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
        links: Sequence[Link],
        joint_names: Sequence[str],
        limits: Sequence[tuple[float, float]],
        why_untested: WhyUntested,
        attached: Sequence[Attached] = (),
    ) -> None:
        """
        Args:
            tree: the joints.
            links: name, frame and surfaces, in the frame, of each.
            joint_names, limits: of each entry of a configuration.
            why_untested: the reason why surfaces of two links are never tested, or None; of links that joints move.
            attached: objects, of which those that carry others come first.
        """
        self.name, self.joint_names = name, list(joint_names)
        self.lower, self.upper = torch.tensor(limits, dtype=torch.float64).reshape(-1, 2).unbind(1)
        self._of_file, self._attached = (tree, links, why_untested), list(attached)
        self.attached = [each.name for each in attached]
        for each in attached:
            frame = next(frame for link, frame, _ in links if link == each.link)
            tree = Tree([*tree.joints, each.joint(frame)])
            links = [*links, (each.name, len(tree.joints) - 1, [each.surface])]
        self.link_names = [link for link, _, _ in links]
        if len(set(self.link_names)) < len(links):  # they are told apart by their names
            raise ValueError(f"links have equal names: {sorted(self.link_names)}")
        self._tree, self._links = tree, links
        lengths = {frame: self._length(tree.chains[frame]) for _, frame, _ in links}
        all_surfaces = [(lengths[frame], surface) for _, frame, surfaces in links for surface in surfaces]
        self.reach = max((length + each.reach for length, each in all_surfaces if not each.infinite), default=PLANE)
        away = [length + float(np.linalg.norm(each.centre)) for length, each in all_surfaces if each.infinite]
        # Half the side of the squares in place of infinite planes, and how far all joints together may slide before a
        # body may be beside a square.
        slides = sum(self._slide(joint) for joint in tree.joints)
        half = max(PLANE, 2.0 * (self.reach + slides + max(away, default=0.0)))
        self._room = half - self.reach - max(away) if away else np.inf
        meshes, owners, frames, groups = [], [], [], []
        for number, (link, frame, surfaces) in enumerate(links):
            for kind in sorted({(each.infinite, each.thickness, each.group) for each in surfaces}):
                alike = [each for each in surfaces if (each.infinite, each.thickness, each.group) == kind]
                surface = joined([each.widened(half) if each.infinite else each for each in alike])
                try:
                    meshes.append(surface.mesh(link))
                except ValueError as error:
                    raise ValueError(f"link {link!r}: {error}") from error
                owners.append(number)
                frames.append(frame)
                groups.append(kind[2])
        if not meshes:
            raise ValueError(f"robot {name!r} has no collision surfaces")
        self.meshes = meshes
        self.body_link = torch.tensor(owners)
        self._frames = frames
        self._tables = ArmTables(tree, frames, [mesh.reach for mesh in meshes])
        chains = [tree.chains[frame] for frame in frames]
        self.moves = torch.tensor([any(tree.joints[k].kind != "fixed" for k in chain) for chain in chains])
        self._groups = groups
        self._left_out = LeftOut()
        self._why_untested = self._reasons()

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

    def _reasons(self) -> dict[tuple[int, int], str]:
        """For each pair of bodies (i, j), i < j, that is never tested, the reason; "" for two bodies of one link."""
        of_file, links_of_file = self._of_file[2], len(self._of_file[1])
        owner, moves, found = self.body_link.tolist(), self.moves.tolist(), {}
        for i, j in combinations(range(self.body_count), 2):
            a, b = owner[i], owner[j]
            reason = self._left_out.links.get(frozenset((self.link_names[a], self.link_names[b])))
            if not (moves[i] or moves[j]):
                reason = "both fixed"
            elif b < links_of_file:  # the file says nothing of attached objects
                reason = of_file(a, self._groups[i], b, self._groups[j]) or reason
            if a == b or reason is not None:
                found[i, j] = reason or ""
        return found

    @property
    def exclude(self) -> Tensor:
        return sorted_pairs(self._why_untested)

    @property
    def hollow(self) -> list[str]:
        """Names of links with a body that is no solid, because its surface is open. What is inside of such a body
        touches nothing until it meets the surface.

        Example:
            >>> robot.hollow
            []
        """
        return list(dict.fromkeys(mesh.name or "" for mesh in self.meshes if mesh.triangle_count and not mesh.solid))

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
        return found + [(link, obstacle, "allowed") for link, obstacle in self._left_out.with_obstacles]

    def attach(
        self,
        link: str,
        mesh: Mesh,
        pose: tuple[Tensor | Sequence[float], Tensor | Sequence[float]],
        touching: Iterable[str] = (),
        *,
        name: str | None = None,
    ) -> Robot:
        """A robot that carries an object, fixed to one of its links.

        The object is a link of its own, the last one, with one body. It is tested against all obstacles, and against
        all links, neighbours included, except the link that carries it and those in `touching`; `untested` lists these
        pairs. If the object lies on a table, pass the object and the table to `allow`.

        Args:
            link: the name of a link that joints move, or of an attached object.
            mesh: the object. It is a solid if it is watertight and faces outwards.
            pose: position (3,) and orientation (4,), a unit quaternion (w, x, y, z), of the mesh's origin in the link's
                frame, length units. For a URDF file, that is the frame of the link; for an MJCF file, the frame of the
                MuJoCo body, moved to the body's last joint, as in `poses`.
            touching: names of links and attached objects that the object may touch, such as the fingers.
            name: of the object. Default: the name of the mesh, else "attached".

        Raises:
            TypeError, ValueError: naming the argument: a link is unknown, `link` does not move, or the name is taken.

        Example:
            >>> block = pgccd.Mesh.box([0.05, 0.05, 0.05])
            >>> carrying = robot.attach("upper", block, ([0.6, 0.0, 0.0], [1.0, 0.0, 0.0, 0.0]), name="block")
            >>> carrying.untested[-1]
            ('upper', 'block', 'attached')
        """
        number = self._link(link, "link")
        if all(self._tree.joints[k].kind == "fixed" for k in self._tree.chains[self._links[number][1]]):
            raise ValueError(f"link: expected a link that joints move, got {link!r}: what is fixed is an obstacle")
        if isinstance(touching, str) or not isinstance(touching, Iterable):
            raise TypeError(f"touching: expected a list of names of links, got {arguments.describe(touching)}")
        touched = [self.link_names[self._link(each, "touching")] for each in touching]
        if name is None:
            name = (mesh.name if isinstance(mesh, Mesh) else None) or "attached"
        arguments.instance(name, "name", str)
        if not name or name in self.link_names:
            raise ValueError(f"name: expected a name that no link has, got {name!r}")
        reasons = {frozenset((each, name)): "touching" for each in touched} | {frozenset((link, name)): "attached"}
        objects = [*self._attached, Attached.of(name, link, mesh, pose)]
        return self._carrying(objects, self._left_out + LeftOut(reasons))

    def detach(self, name: str) -> Robot:
        """A robot without this attached object, and without the untested pairs of the object.

        Args:
            name: of the object.

        Raises:
            ValueError: there is no such attached object, or it carries another one.

        Example:
            >>> block = pgccd.Mesh.box([0.05, 0.05, 0.05])
            >>> carrying = robot.attach("upper", block, ([0.6, 0.0, 0.0], [1.0, 0.0, 0.0, 0.0]), name="block")
            >>> carrying.detach("block").link_names == robot.link_names
            True
        """
        if name not in self.attached:
            raise ValueError(f"name: expected an attached object, one of {self.attached}, got {name!r}")
        others = [each for each in self._attached if each.name != name]
        if carried := [each.name for each in others if each.link == name]:
            raise ValueError(f"name: {name!r} carries {carried}: detach these first")
        return self._carrying(others, self._left_out.without(name))

    def _carrying(self, objects: Sequence[Attached], left_out: LeftOut) -> Robot:
        """The robot of the file with these objects, without tests of these pairs."""
        tree, links, why_untested = self._of_file
        limits = list(zip(self.lower.tolist(), self.upper.tolist(), strict=True))
        other = Robot(self.name, tree, links, self.joint_names, limits, why_untested, objects)
        return other._leaving_out(left_out)

    def allow(self, pairs: Iterable[tuple[str, str]]) -> Robot:
        """A robot that does not test these pairs either, such as an attached object and the table that it is lifted
        from. `untested` lists them.

        Args:
            pairs: of names: of two links, attached objects included, or of a link and an obstacle. A name of no link is
                an obstacle's: later calls with obstacles raise an error if none of them has that name.

        Raises:
            TypeError, ValueError: these are no pairs of two different names, or neither name is of a link.

        Example:
            >>> lifting = robot.allow([("upper", "table")])
            >>> lifting.untested[-1]
            ('upper', 'table', 'allowed')
        """
        return self._leaving_out(LeftOut.allowed(pairs, self.link_names))

    def _leaving_out(self, pairs: LeftOut) -> Robot:
        """A robot that does not test these pairs either."""
        other = copy.copy(self)
        other._left_out = self._left_out + pairs
        other._why_untested = other._reasons()
        return other

    def _link(self, name: str, argument: str) -> int:
        if name not in self.link_names:
            raise ValueError(f"{argument}: expected names of links, such as {self.link_names[0]!r}, got {name!r}")
        return self.link_names.index(name)

    def excluding_sampled(self, samples: int = 1000, share: float = 0.95, seed: int = 0) -> Robot:
        """A robot that does not test pairs of links that collide in nearly all random configurations, because their
        surfaces overlap by design. Pairs that never collide in the samples stay tested.

        Args:
            samples: number of configurations, uniform within the limits; for revolute joints without limits, within -pi
                to pi.
            share: pairs are left out if they collide in at least this part of the samples.
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
            many = repeated(self._scene(None), len(some))
            x, r = self.poses(some)
            at_rest = RigidMotion.at_rest(x.flatten(0, 1), r.flatten(0, 1))
            pairs = collide(many, at_rest).pairs
            # Each pair of links counts once for a configuration, even if the links have several bodies.
            sample = pairs[:, 0] // self.body_count
            of_links = owner[pairs % self.body_count].sort(dim=1).values
            once = torch.unique((sample * count + of_links[:, 0]) * count + of_links[:, 1])
            times += torch.bincount(once % (count * count), minlength=count * count)
        always = torch.nonzero(times >= share * samples).flatten().tolist()
        names = [(self.link_names[key // count], self.link_names[key % count]) for key in always]
        return self._leaving_out(LeftOut({frozenset(pair): "sampled" for pair in names}))

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
            infinite plane. If q requires grad, so do the poses; a `pgccd.Trajectory` of them has contacts with
            gradients.

        Raises:
            TypeError, ValueError: q has another type or shape.

        Example:
            >>> position, orientation = robot.poses(torch.zeros(robot.joint_count))
        """
        q = self._configurations(q, "q")
        x, r = self._tables.poses(q.reshape(math.prod(q.shape[:-1]), self.joint_count))
        shape = (*q.shape[:-1], self.body_count)
        if np.isfinite(self._room):
            x = torch.where(self._may_leave(q).reshape(-1, 1, 1), torch.nan, x)
        return x.reshape(*shape, 3), r.reshape(*shape, 4)

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
        """The robot's bodies, followed by the obstacles. Bodies that do not move are not tested against each other; nor
        are obstacles.

        Args:
            obstacles: the obstacles, if any.

        Raises:
            TypeError: `obstacles` are something else.
            ValueError: no obstacle has a name that was given to `allow`, or an obstacle has the name of a link.

        Example:
            >>> scene = robot.scene(obstacles)
            >>> pgccd.show(scene, robot.trajectory(torch.zeros(2, robot.joint_count), obstacles))
        """
        if obstacles is not None and not isinstance(obstacles, Obstacles):
            raise TypeError(f"obstacles: expected pgccd.robots.Obstacles, got {arguments.describe(obstacles)}")
        self._left_out.check_obstacles([] if obstacles is None else obstacles.names, self.link_names)
        return self._scene(obstacles)

    def _scene(self, obstacles: Obstacles | None) -> Scene:
        """As `scene`, for obstacles with checked names, or none."""
        exclude = set(self._why_untested)
        meshes, static = list(self.meshes), ~self.moves
        margin = torch.zeros(len(meshes), dtype=torch.float64)
        if obstacles is not None:
            first = len(meshes)
            meshes += obstacles.meshes
            index = torch.cat([torch.arange(first), first + obstacles.mesh_index])
            margin = torch.cat([margin, obstacles.margin])
            static = torch.cat([static, ~obstacles.moves])
            for link, name in self._left_out.with_obstacles:
                other = self.body_count + obstacles.names.index(name)
                exclude |= {(k, other) for k, own in enumerate(self.body_link.tolist()) if self.link_names[own] == link}
        else:
            index = torch.arange(len(meshes))
        scene = Scene(meshes, index, static=static, margin=margin, exclude=sorted_pairs(exclude))
        if obstacles is not None and bool(obstacles.moves.any()):
            # Obstacles are not tested against each other.
            is_robot = (torch.arange(len(index)) < self.body_count).long()
            scene.group, scene.mask = 2 - is_robot, 1 + 2 * is_robot
        return scene

    def trajectory(self, q: Tensor | Spline, obstacles: Obstacles | None = None) -> Trajectory:
        """The path through configurations, for `pgccd.detect` with `scene`. Its margins bound how far links stray from
        arcs. A contact may be due to these margins; `certify` makes them as small as needed.

        If a link turns by more than 0.99 rad in a segment, all joints added, every segment is split into the same
        number of equal parts. Times along the whole path do not change, and each of the S segments of `q` becomes
        `segment_count / S` segments.

        Args:
            q: (T, J) configurations of the waypoints, between which joints move at constant rates; or a spline of
                configurations (J,).
            obstacles: as for `scene`; the same in all environments.

        Raises:
            TypeError, ValueError: q has another type or shape or requires grad, or a joint has a value larger than 1e6;
                or the robot may leave the square in place of an infinite plane; or a link turns by more than 1e4
                radians in a segment, all joints added.

        Example:
            >>> path = robot.trajectory(torch.linspace(0, 1, 20)[:, None].expand(20, robot.joint_count))
        """
        if not isinstance(q, Spline):
            q = self._configurations(q, "q")
            if q.dim() != 2 or len(q) < 2:
                raise ValueError(f"q: expected shape (T, {self.joint_count}) with T >= 2, got {tuple(q.shape)}")
            q = q[None]
        paths = JointPaths.of(self, q)
        if len(paths.control) != 1:
            raise ValueError(f"q: expected a spline of values ({self.joint_count},), got {len(paths.control)} paths")
        paths.require_sound(self)
        most = float(paths.turns(self).max())
        parts = max(1, math.ceil(most / (0.99 * MOST_TURN)))  # less, for the rounding of what is between
        device, count = paths.control.device, paths.segment_count
        s = torch.tensor([k / parts for k in range(parts + 1)], dtype=torch.float64, device=device)
        begin, end = (torch.cat([s[k : k + parts].repeat(count), s[-1:]]) for k in (0, 1))
        of_parts = paths.segments()[0].repeat_interleave(parts, dim=0)
        # And the pose at the end, where nothing strays.
        control = torch.cat([of_parts, of_parts[-1:]])
        x, _, r, _, margin = ops.arm_arcs(self._tables.on(device), control.contiguous(), paths.error, begin, end)
        margin = margin[:-1]
        if obstacles is not None:
            if obstacles.environments is not None or obstacles.motion is not None:
                raise ValueError(f"obstacles: expected obstacles with one pose each, got {obstacles}")
            x, r = (
                torch.cat([own, of_all.to(own.device).expand(len(own), -1, -1)], dim=1)
                for own, of_all in ((x, obstacles.position), (r, obstacles.orientation))
            )
            margin = torch.cat([margin, margin.new_zeros(len(margin), obstacles.count)], dim=1)
        return Trajectory(x, r, margin=margin)

    def clearance(
        self,
        q: Tensor | Spline,
        obstacles: Obstacles | None = None,
        *,
        cutoff: float | None = None,
        tolerance: float | None = None,
    ) -> Clearance:
        """How near links come to obstacles and to each other along paths, between waypoints too.

        Args:
            q, obstacles, cutoff, tolerance: as for `pgccd.robots.clearance`.

        Raises:
            TypeError, ValueError: naming the argument.

        Example:
            >>> robot.clearance(torch.zeros(1, 2, robot.joint_count), obstacles)
        """
        from pgccd.robots.path_clearance import clearance

        return clearance(self, q, obstacles, cutoff=cutoff, tolerance=tolerance)

    def certify(
        self, q: Tensor | Spline, obstacles: Obstacles | None = None, *, resolution: float | None = None
    ) -> Certificate:
        """Whether paths are free of contact, between waypoints too.

        Args:
            q, obstacles, resolution: as for `pgccd.robots.certify`.

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
        """A function of two configurations for planners such as OMPL and MoveIt: whether the straight motion in joint
        space between them is certainly free of contact. False has several reasons, which `certify` distinguishes, also
        that links touch at the start or that a value is not finite.

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
        attached = f", attached={self.attached}" if self.attached else ""
        hollow = f", hollow={self.hollow}" if self.hollow else ""
        return f"Robot({self.name!r}, {counts}{attached}, untested pairs={len(self.untested)}{hollow})"
