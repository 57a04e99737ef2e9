"""Problems for motion planners in the kinds of MotionBenchMaker: a Panda that reaches onto and under tables, between
bars, into shelves, boxes and cages. Random by seed; starts and goals are found by inverse kinematics.

The files that are written for each problem, a URDF of the arm and its obstacles and an SRDF with the pairs that are not
tested, are what planners read: all have the same geometry.
"""

from __future__ import annotations

import warnings
import xml.etree.ElementTree as ElementTree
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch

import pgccd
from pgccd.robots import MotionValidator, Obstacles, load_urdf

URDF, SRDF = "robots/panda_description/urdf/panda.urdf", "robots/panda_description/srdf/panda.srdf"
# Fingers do not move. They are as far from the middle as in VAMP's model of the arm (their joints end at 0.04), so that
# all planners have the same gripper.
OPEN = 0.065
READY = np.array([0.0, -0.785398, 0.0, -2.35619, 0.0, 1.5707, 0.785398])
# The tool is between the tips of the fingers, along the hand's z axis.
HAND, TOOL = "panda_hand", 0.1034
# Corners of the prism around a cylinder.
SECTIONS = 32
# Inverse kinematics: random starts, steps, and the largest error of a solution.
STARTS, STEPS, TOLERANCE = 64, 40, 1e-4
DOWN, AHEAD = np.array([0.0, 0.0, -1.0]), np.array([1.0, 0.0, 0.0])


@dataclass(frozen=True)
class Solid:
    """An upright box, or a cylinder about a vertical axis, which all planners know as a prism around it.

    Attributes:
        name: of the obstacle.
        size: (x, y, z) of a box; (radius, length) of a cylinder.
        position: of the centre.
        yaw: about z, radians.
    """

    name: str
    size: tuple[float, ...]
    position: tuple[float, float, float]
    yaw: float = 0.0

    @property
    def is_box(self) -> bool:
        """Whether it is a box."""
        return len(self.size) == 3

    def mesh(self) -> pgccd.Mesh:
        """The mesh, about its centre."""
        if self.is_box:
            return pgccd.Mesh.box(list(self.size))
        radius, length = self.size
        angle = 2.0 * np.pi * np.arange(SECTIONS) / SECTIONS
        around = radius / np.cos(np.pi / SECTIONS) * np.stack([np.cos(angle), np.sin(angle)], axis=1)
        vertices = [[*xy, z] for z in (-0.5 * length, 0.5 * length) for xy in around.tolist()]
        vertices += [[0.0, 0.0, -0.5 * length], [0.0, 0.0, 0.5 * length]]
        faces = []
        for k in range(SECTIONS):
            a, b, low, high = k, (k + 1) % SECTIONS, 2 * SECTIONS, 2 * SECTIONS + 1
            faces += [[a, b, b + SECTIONS], [a, b + SECTIONS, a + SECTIONS]]
            faces += [[low, b, a], [high, a + SECTIONS, b + SECTIONS]]
        return pgccd.Mesh(torch.tensor(vertices, dtype=torch.float64), torch.tensor(faces))


@dataclass(frozen=True)
class Problem:
    """A problem of a kind: the motion from start to goal (7,) among obstacles."""

    kind: str
    number: int
    solids: list[Solid]
    start: list[float]
    goal: list[float]

    def obstacles(self) -> Obstacles:
        """For `Robot.certify`."""
        return obstacles_of(self.solids)

    def described(self) -> dict[str, Any]:
        """As written to JSON."""
        return asdict(self)


@dataclass(frozen=True)
class Target:
    """Where the tool is to be, and in which direction the hand points; turns about that are free."""

    position: np.ndarray
    direction: np.ndarray


@dataclass(frozen=True)
class Layout:
    """Obstacles, and poses that are worth reaching, the best first."""

    solids: list[Solid]
    targets: list[Target]


def obstacles_of(solids: list[Solid]) -> Obstacles:
    """The obstacles, with names."""
    position = torch.tensor([solid.position for solid in solids], dtype=torch.float64)
    half = 0.5 * torch.tensor([solid.yaw for solid in solids], dtype=torch.float64)
    orientation = torch.zeros(len(solids), 4, dtype=torch.float64)
    orientation[:, 0], orientation[:, 3] = half.cos(), half.sin()
    return Obstacles([solid.mesh() for solid in solids], position, orientation, names=[solid.name for solid in solids])


class _Furniture:
    """Solids in the frame of a piece of furniture, which stands at a place and is turned about z."""

    def __init__(self, at: np.ndarray, yaw: float) -> None:
        self.at, self.yaw, self.solids = at, yaw, list[Solid]()
        self._turn = np.array([[np.cos(yaw), -np.sin(yaw), 0.0], [np.sin(yaw), np.cos(yaw), 0.0], [0.0, 0.0, 1.0]])

    def add(self, name: str, size: tuple[float, ...], centre: tuple[float, float, float], yaw: float = 0.0) -> None:
        """A solid with its centre there."""
        x, y, z = self.placed(np.array(centre)).tolist()
        self.solids.append(Solid(f"{name}_{len(self.solids)}", size, (x, y, z), self.yaw + yaw))

    def placed(self, point: np.ndarray) -> np.ndarray:
        """In the frame of the robot."""
        return self.at + self._turn @ point

    def target(self, point: tuple[float, float, float], direction: np.ndarray) -> Target:
        """The tool at a point, along a direction, of this frame."""
        return Target(self.placed(np.array(point)), self._turn @ direction)


def _objects(
    furniture: _Furniture,
    rng: np.random.Generator,
    count: int,
    low: tuple[float, float],
    high: tuple[float, float],
    z: float,
    tallest: float,
) -> list[tuple[float, float, float]]:
    """Random boxes and cylinders that stand at height z within a rectangle, apart from each other: the middles of their
    tops.
    """
    found: list[tuple[float, float, float]] = []
    spots: list[tuple[np.ndarray, float]] = []
    for _ in range(20 * count):
        at = rng.uniform(low, high)
        height = float(rng.uniform(0.4, 1.0)) * tallest
        if rng.random() < 0.4:
            radius = float(rng.uniform(0.02, 0.045))
            size: tuple[float, ...] = (radius, height)
            wide, yaw = radius, 0.0
        else:
            x, y = rng.uniform(0.03, 0.1, 2).tolist()
            size, yaw = (x, y, height), float(rng.uniform(-np.pi, np.pi))
            wide = 0.5 * float(np.hypot(x, y))
        if any(np.linalg.norm(at - other) < wide + its + 0.01 for other, its in spots):
            continue
        furniture.add("object", size, (float(at[0]), float(at[1]), z + 0.5 * height), yaw)
        spots.append((at, wide))
        found.append((float(at[0]), float(at[1]), z + height))
        if len(found) == count:
            break
    return found


def _table(rng: np.random.Generator, top: float, thickness: float = 0.04) -> _Furniture:
    furniture = _Furniture(np.array([rng.uniform(0.72, 0.8), rng.uniform(-0.1, 0.1), 0.0]), rng.uniform(-0.2, 0.2))
    furniture.add("top", (0.8, 1.2, thickness), (0.0, 0.0, top - 0.5 * thickness))
    for x in (-0.35, 0.35):
        for y in (-0.55, 0.55):
            furniture.add("leg", (0.05, 0.05, 0.6), (x, y, top - thickness - 0.3))
    return furniture


def table_pick(rng: np.random.Generator) -> Layout:
    """Over a table with objects: the hand comes down at one of them."""
    top = float(rng.uniform(0.0, 0.2))
    table = _table(rng, top)
    objects = _objects(table, rng, 9, (-0.3, -0.45), (0.05, 0.45), top, 0.25)
    return Layout(table.solids, [table.target((x, y, height + 0.01), DOWN) for x, y, height in objects])


def table_under(rng: np.random.Generator) -> Layout:
    """Under a table, among objects."""
    top = float(rng.uniform(0.45, 0.6))
    table = _table(rng, top)
    floor = float(rng.uniform(0.0, 0.05))
    table.add("floor", (0.8, 1.2, 0.02), (0.0, 0.0, floor - 0.01))
    _objects(table, rng, 7, (-0.28, -0.4), (0.2, 0.4), floor, 0.2)
    places = rng.uniform((-0.3, -0.35, 0.15), (0.05, 0.35, top - 0.15), (20, 3))
    return Layout(table.solids, [table.target((x, y, z), AHEAD) for x, y, z in places.tolist()])


def table_bars(rng: np.random.Generator) -> Layout:
    """Between thin bars that stand on a table."""
    top = float(rng.uniform(0.0, 0.2))
    table = _table(rng, top)
    bars = rng.uniform((-0.35, -0.5), (0.1, 0.5), (12, 2)).tolist()
    for x, y in bars:
        wide, height = float(rng.uniform(0.01, 0.03)), float(rng.uniform(0.3, 0.5))
        table.add("bar", (wide, wide, height), (x, y, top + 0.5 * height))
    places = rng.uniform((-0.3, -0.45, top + 0.05), (0.05, 0.45, top + 0.2), (40, 3))
    return Layout(table.solids, [table.target((x, y, z), DOWN) for x, y, z in places.tolist()])


def bookshelf(
    rng: np.random.Generator, width: float, bays: int, levels: int, spacing: float, board: float, depth: float
) -> Layout:
    """Into compartments of a bookshelf, among books and cylinders, with the hand horizontal."""
    shelf = _Furniture(np.array([rng.uniform(0.6, 0.68), rng.uniform(-0.15, 0.15), 0.0]), rng.uniform(-0.25, 0.25))
    low, height = float(rng.uniform(0.0, 0.1)), levels * (spacing + board) + board
    shelf.add("back", (board, width, height), (0.5 * (depth + board), 0.0, low + 0.5 * height))
    inner = (width - (bays + 1) * board) / bays
    for k in range(bays + 1):
        y = -0.5 * (width - board) + k * (inner + board)
        shelf.add("side", (depth, board, height), (0.0, y, low + 0.5 * height))
    targets = []
    for level in range(levels + 1):
        z = low + level * (spacing + board) + 0.5 * board
        for k in range(bays):
            y = -0.5 * width + board + 0.5 * inner + k * (inner + board)
            shelf.add("board", (depth, inner, board), (0.0, y, z))
            if level == levels:
                continue
            bottom = z + 0.5 * board
            side, half = 0.5 * inner - 0.05, 0.5 * depth - 0.06
            count = max(1, round(4.0 * inner))
            _objects(shelf, rng, count, (0.0, y - side), (half, y + side), bottom, 0.75 * spacing)
            for _ in range(4):
                x, away = float(rng.uniform(-0.5 * depth, 0.1 * depth)), float(rng.uniform(-side, side))
                up = float(rng.uniform(0.25, 0.7)) * spacing
                targets.append(shelf.target((x, y + away, bottom + up), AHEAD))
    order = rng.permutation(len(targets))
    return Layout(shelf.solids, [targets[k] for k in order])


def box(rng: np.random.Generator) -> Layout:
    """Down into an open box with thin walls, among objects."""
    furniture = _Furniture(np.array([rng.uniform(0.5, 0.6), rng.uniform(-0.2, 0.2), 0.0]), rng.uniform(-0.6, 0.6))
    x, y, z = (float(length) for length in rng.uniform((0.3, 0.4, 0.2), (0.4, 0.55, 0.3)))
    bottom, wall = float(rng.uniform(-0.05, 0.15)), float(rng.uniform(0.005, 0.015))
    furniture.add("bottom", (x, y, wall), (0.0, 0.0, bottom - 0.5 * wall))
    for sign in (-1.0, 1.0):
        furniture.add("wall", (wall, y, z), (0.5 * sign * (x - wall), 0.0, bottom + 0.5 * z))
        furniture.add("wall", (x - 2.0 * wall, wall, z), (0.0, 0.5 * sign * (y - wall), bottom + 0.5 * z))
    corner = (0.5 * x - 0.06, 0.5 * y - 0.06)
    objects = _objects(furniture, rng, 5, (-corner[0], -corner[1]), corner, bottom, 0.15)
    targets = [furniture.target((a, b, height + 0.01), DOWN) for a, b, height in objects]
    places = rng.uniform((-corner[0], -corner[1], bottom + 0.03), (*corner, bottom + 0.15), (10, 3)).tolist()
    return Layout(furniture.solids, targets + [furniture.target((a, b, c), DOWN) for a, b, c in places])


def cage(rng: np.random.Generator) -> Layout:
    """Through the bars of a cage."""
    furniture = _Furniture(np.array([rng.uniform(0.5, 0.6), rng.uniform(-0.15, 0.15), 0.0]), rng.uniform(-0.7, 0.7))
    wide, bar = float(rng.uniform(0.4, 0.5)), float(rng.uniform(0.015, 0.03))
    low, half = float(rng.uniform(0.05, 0.2)), 0.5 * wide
    for z in (low, low + wide):
        for sign in (-1.0, 1.0):
            furniture.add("bar", (wide, bar, bar), (0.0, sign * half, z))
            furniture.add("bar", (bar, wide, bar), (sign * half, 0.0, z))
    for sign in (-1.0, 1.0):
        for other in (-1.0, 1.0):
            furniture.add("bar", (bar, bar, wide), (sign * half, other * half, low + half))
        # One bar more in each face but the front.
        furniture.add("bar", (bar, bar, wide), (float(rng.uniform(-0.5, 0.5)) * half, sign * half, low + half))
    furniture.add("bar", (bar, bar, wide), (half, float(rng.uniform(-0.5, 0.5)) * half, low + half))
    furniture.add("bar", (wide, bar, bar), (0.0, float(rng.uniform(-0.5, 0.5)) * half, low + wide))
    furniture.add("bottom", (wide, wide, 0.01), (0.0, 0.0, low - 0.005))
    targets = []
    for _ in range(40):
        a, b, c = rng.uniform(-0.5, 0.5, 3) * wide * 0.6
        direction = np.array([1.0, rng.uniform(-0.5, 0.5), rng.uniform(-1.0, 0.2)])
        targets.append(furniture.target((a, b, low + half + c), direction / np.linalg.norm(direction)))
    return Layout(furniture.solids, targets)


KINDS: dict[str, Callable[[np.random.Generator], Layout]] = {
    "table pick": table_pick,
    "table under": table_under,
    "table bars": table_bars,
    "bookshelf small": partial(bookshelf, width=0.8, bays=1, levels=3, spacing=0.3, board=0.02, depth=0.3),
    "bookshelf tall": partial(bookshelf, width=0.7, bays=2, levels=3, spacing=0.32, board=0.02, depth=0.35),
    "bookshelf thin": partial(bookshelf, width=0.9, bays=3, levels=3, spacing=0.28, board=0.006, depth=0.3),
    "box": box,
    "cage": cage,
}


class Arm:
    """The Panda of example-robot-data, whose fingers do not move.

    Args:
        data: the folder of example-robot-data.
        folder: for the files that are written.
    """

    def __init__(self, data: Path, folder: Path) -> None:
        folder.mkdir(parents=True, exist_ok=True)
        self.folder, tree = folder, ElementTree.parse(data / URDF)
        root = tree.getroot()
        for link in root.iter("link"):
            for part in [part for part in link if part.tag != "collision"]:
                link.remove(part)
            for mesh in link.iter("mesh"):
                mesh.set("filename", mesh.get("filename", "").replace("package://example-robot-data", str(data)))
        for joint in root.findall("joint"):
            if joint.get("type") == "prismatic":
                side, origin = 1.0 if joint.get("name", "").endswith("1") else -1.0, joint.find("origin")
                assert origin is not None
                origin.set("xyz", f"0 {side * OPEN} 0.0584")
                joint.set("type", "fixed")
                for part in [part for part in joint if part.tag not in ("origin", "parent", "child")]:
                    joint.remove(part)
        self._arm = ElementTree.tostring(root, encoding="unicode")
        (folder / "arm.urdf").write_text(self._arm)
        with warnings.catch_warnings():
            # Where all joints are 0, beyond a limit, links touch.
            warnings.simplefilter("ignore", UserWarning)
            self.robot = load_urdf(folder / "arm.urdf", data / SRDF).excluding_sampled(300)
        owner = self.robot.body_link.tolist()
        self._hand = owner.index(self.robot.link_names.index(HAND))
        self.low, self.high = self.robot.lower.numpy(), self.robot.upper.numpy()

    def write(self, problem: Problem) -> Path:
        """Writes `problem`'s URDF and SRDF, and the meshes of cylinders: the path without an ending."""
        path = self.folder / f"{problem.kind.replace(' ', '_')}_{problem.number}"
        root = ElementTree.fromstring(self._arm)
        for solid in problem.solids:
            link = ElementTree.SubElement(root, "link", name=solid.name)
            geometry = ElementTree.SubElement(ElementTree.SubElement(link, "collision"), "geometry")
            if solid.is_box:
                ElementTree.SubElement(geometry, "box", size=" ".join(map(repr, solid.size)))
            else:
                file = path.with_name(f"{path.name}_{solid.name}.obj")
                mesh = solid.mesh()
                lines = [f"v {x!r} {y!r} {z!r}" for x, y, z in mesh.vertices.tolist()]
                file.write_text("\n".join([*lines, *(f"f {a} {b} {c}" for a, b, c in (mesh.faces + 1).tolist())]))
                ElementTree.SubElement(geometry, "mesh", filename=str(file.resolve()))
            joint = ElementTree.SubElement(root, "joint", name=f"{solid.name}_joint", type="fixed")
            ElementTree.SubElement(joint, "parent", link="panda_link0")
            ElementTree.SubElement(joint, "child", link=solid.name)
            place = " ".join(map(repr, solid.position))
            ElementTree.SubElement(joint, "origin", xyz=place, rpy=f"0 0 {solid.yaw!r}")
        path.with_suffix(".urdf").write_text(ElementTree.tostring(root, encoding="unicode"))
        path.with_suffix(".srdf").write_text(self._srdf([solid.name for solid in problem.solids]))
        return path

    def _srdf(self, obstacles: list[str]) -> str:
        """The pairs of links that the certificate does not test, and those of obstacles with what does not move."""
        still = ["panda_link0", *obstacles]
        pairs = [(one, other) for one, other, _ in self.robot.untested]
        pairs += [(one, other) for k, one in enumerate(still) for other in still[k + 1 :]]
        lines = [f'<disable_collisions link1="{one}" link2="{other}" reason="Never"/>' for one, other in pairs]
        group = '<group name="arm"><chain base_link="panda_link0" tip_link="panda_hand_tcp"/></group>'
        return "\n".join(['<robot name="panda">', group, *lines, "</robot>"])

    def reaching(self, target: Target, rng: np.random.Generator) -> torch.Tensor:
        """(n, 7) configurations within the limits, with the tool there: damped least squares from random ones."""
        q = rng.uniform(self.low, self.high, (STARTS, 7))
        step = 1e-6
        nudge = np.concatenate([np.zeros((1, 7)), step * np.eye(7)])
        for _ in range(STEPS):
            at = self._error((q[:, None] + nudge).reshape(-1, 7), target).reshape(STARTS, 8, 6)
            error, jacobian = at[:, 0], ((at[:, 1:] - at[:, :1]) / step).transpose(0, 2, 1)
            across = jacobian.transpose(0, 2, 1)
            damped = jacobian @ across + 1e-6 * np.eye(6)
            move = (across @ np.linalg.solve(damped, error[..., None]))[..., 0]
            length = np.abs(move).max(axis=1, keepdims=True)
            q = np.clip(q - move * np.minimum(1.0, 0.3 / np.maximum(length, 1e-12)), self.low, self.high)
        found = q[np.linalg.norm(self._error(q, target), axis=1) < TOLERANCE]
        return torch.from_numpy(found)

    def _error(self, q: np.ndarray, target: Target) -> np.ndarray:
        """(n, 6): how far the tool is away, and how far its direction is off."""
        position, orientation = (column[:, self._hand].numpy() for column in self.robot.poses(torch.from_numpy(q)))
        w, x, y, z = orientation.T
        along = np.stack([2.0 * (x * z + w * y), 2.0 * (y * z - w * x), 1.0 - 2.0 * (x * x + y * y)], axis=1)
        return np.concatenate([position + TOOL * along - target.position, along - target.direction], axis=1)


def problems(arm: Arm, count: int) -> Iterator[Problem]:
    """`count` problems of each kind: the arm reaches from near its usual posture into the scene, or, every second one,
    from one place of the scene to another. Both ends are free and further than the resolution from contact; problems
    that the straight motion solves are left out.
    """
    for kind, layout_of in KINDS.items():
        seed, number = 0, 0
        while number < count:
            rng = np.random.default_rng([list(KINDS).index(kind), seed])
            seed += 1
            layout = layout_of(rng)
            ends = _ends(arm, layout, number % 2 == 1, rng)
            if ends is not None:
                yield Problem(kind, number, layout.solids, *ends)
                number += 1


def _ends(
    arm: Arm, layout: Layout, is_within: bool, rng: np.random.Generator
) -> tuple[list[float], list[float]] | None:
    """Start and goal, or None if none were found."""
    is_valid = arm.robot.motion_validator(obstacles_of(layout.solids))
    ends: list[list[float]] = []
    if not is_within:
        near = np.clip(READY + rng.uniform(-0.3, 0.3, (20, 7)), arm.low, arm.high)
        ends = _free(is_valid, torch.from_numpy(near))[:1]
        if not ends:
            return None
    for target in layout.targets[:20]:
        for q in _free(is_valid, arm.reaching(target, rng))[:1]:
            if not ends or not is_valid(ends[0], q):
                ends.append(q)
        if len(ends) == 2:
            return ends[0], ends[1]
    return None


def _free(is_valid: MotionValidator, q: torch.Tensor) -> list[list[float]]:
    """Those of configurations (n, 7) without contact, nor within the resolution of one."""
    if len(q) == 0:
        return []
    return [each for each in q[is_valid.check_states(q)].tolist() if is_valid(each, each)]
