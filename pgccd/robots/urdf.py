"""Robots from URDF files, read by yourdfpy, and pairs of links that SRDF files exclude."""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence
from os import PathLike
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np

from pgccd import arguments
from pgccd.geometry.mesh import Mesh
from pgccd.robots import shapes
from pgccd.robots.kinematics import Joint, JointKind, Tree, quaternion_of
from pgccd.robots.links import adjacent_links
from pgccd.robots.readers import robot_of_file
from pgccd.robots.robot import Robot
from pgccd.robots.shapes import ThickSurface
from pgccd.robots.urdf_checks import check_elements, check_urdf, keep_collisions, parsed_xml, refuse_unknown

_KINDS: dict[str, JointKind] = {
    "fixed": "fixed",
    "revolute": "revolute",
    "continuous": "revolute",
    "prismatic": "prismatic",
}
# Elements of SRDF files: those that are read, and those that say nothing about pairs of links.
_PAIRS = ("disable_collisions", "enable_collisions", "disable_default_collisions")
_OTHER_OF_SRDF = (
    *("group", "group_state", "end_effector", "virtual_joint", "passive_joint", "joint_property"),
    *("link_sphere_approximation", "gripper", "handle", "contact", "rotor_params", "specificities"),
    *("group_tcps", "group_opw", "kinematics_plugin_config", "contact_managers_plugin_config", "calibration_config"),
)


def load_urdf(
    path: str | PathLike[str],
    srdf: str | PathLike[str] | None = None,
    *,
    packages: Mapping[str, str | PathLike[str]] | None = None,
    base_position: Sequence[float] = (0.0, 0.0, 0.0),
    base_orientation: Sequence[float] = (1.0, 0.0, 0.0, 0.0),
) -> Robot:
    """A robot from a URDF file: one body per link with collision geometry, its origin at the link's joint.

    Meshes and boxes are taken as they are, in metres. Lengths of mesh files that state a unit (Collada, 3MF) are
    converted; their up axis turns nothing, and a mirrored scale keeps the outside outside. Cylinders are prisms around
    the cylinder, at most 0.13 % thicker; spheres are exact to 1.3e-9 of their radius.

    Pairs of links are not tested if they are rigidly joined, if they are neighbours, or if the SRDF file disables them;
    see also `Robot.untested` and `Robot.excluding_sampled`. The neighbour of a link is the first link with geometry
    above its last moving joint, past links without geometry. Links that are rigidly joined have the same neighbours,
    with one exception: of the links that are fixed to the root, only that first link is a neighbour. A wall that is
    fixed to the same root as an arm is therefore tested against the arm. A warning names pairs that are tested and
    touch where all joints are 0 (or at the limit that is nearest to 0).

    Args:
        path: of the URDF file.
        srdf: an SRDF file, of which the elements disable_collisions, enable_collisions and disable_default_collisions
            are read.
        packages: folders by name, for files given as package://name/file or model://name/file. Default: the folder of
            that name, or the file, is looked for in all folders above the URDF file.
        base_position, base_orientation: pose of the root link in the world: (3,), and a unit quaternion (w, x, y, z).

    Raises:
        FileNotFoundError: a file does not exist.
        TypeError: naming the argument.
        ValueError: a file cannot be read, has macros of xacro, or has unknown elements or attributes in joints and
            collision geometry; or, naming link or joint, it is no tree of fixed, revolute, continuous and prismatic
            joints.
        ImportError: yourdfpy (extra `robots`) is not installed.

    Example:
        >>> robot = pgccd.robots.load_urdf("arm.urdf")
        >>> robot.joint_names
        ['shoulder', 'elbow']
    """
    path = arguments.path(path, "path")
    if not path.is_file():
        raise FileNotFoundError(f"path: {path}: no such file")
    description = _parsed(path)
    if packages is not None and not isinstance(packages, Mapping):
        raise TypeError(f"packages: expected a dict of folders by name, got {arguments.describe(packages)}")
    root, order = _ordered(description, path)
    joints = [
        Joint("", "fixed", -1, _three(base_position, "base_position"), _unit(base_orientation), np.array([1.0, 0, 0]))
    ]
    names: list[str] = []
    limits: list[tuple[float, float]] = []
    coordinates: dict[str, int] = {}
    for joint in order:
        if joint.type in _KINDS and joint.type != "fixed" and joint.mimic is None:
            coordinates[joint.name] = len(names)
            names.append(joint.name)
            limits.append(_limits(joint))
    frame = {root: 0}
    for joint in order:
        joints.append(_joint(joint, frame[joint.parent], coordinates, {each.name: each for each in order}, path))
        frame[joint.child] = len(joints) - 1
    links = []
    for link in description.links:
        surfaces = [_surface(link.name, each, path, packages or {}) for each in link.collisions]
        links.append((link.name, frame[link.name], surfaces))
    tree = Tree(joints)
    number = {link.name: index for index, link in enumerate(description.links)}
    adjacent = adjacent_links(tree, [(at, bool(surfaces)) for _, at, surfaces in links])
    why = dict.fromkeys(adjacent, "adjacent")
    if srdf is not None:
        disabled, enabled = _collisions(arguments.path(srdf, "srdf"), number)
        why = {pair: why.get(pair, "file") for pair in (why.keys() | disabled) - enabled}

    def why_untested(i: int, _: tuple[int, ...], j: int, __: tuple[int, ...]) -> str | None:
        return why.get((i, j))

    neutral = [min(max(0.0, low), high) for low, high in limits]
    return robot_of_file(path, neutral, description.name, tree, links, names, limits, why_untested)


def _parsed(path: Path) -> Any:
    try:
        import yourdfpy
    except ImportError as error:
        raise ImportError(f"yourdfpy reads URDF files: pip install 'pgccd[robots]' ({error})") from error
    root = parsed_xml(path, "path")
    check_elements(root, path)
    keep_collisions(root)
    check_urdf(root, path)  # yourdfpy repairs broken files silently
    try:
        file = io.BytesIO(ElementTree.tostring(root))
        return yourdfpy.URDF.load(file, build_scene_graph=False, load_meshes=False).robot
    except Exception as error:
        raise ValueError(f"path: {path} cannot be read as URDF: {error}") from error


def _ordered(description: Any, path: Path) -> tuple[str, list[Any]]:
    """The root link, and the joints with parents first.

    Raises:
        ValueError: links and joints are no tree.
    """
    links = {link.name for link in description.links}
    if not links:
        raise ValueError(f"path: {path}: it has no links")
    by_child: dict[str, Any] = {}
    for joint in description.joints:
        for end in (joint.parent, joint.child):
            if end not in links:
                raise ValueError(f"path: {path}: joint {joint.name!r}: there is no link {end!r}")
        if joint.child in by_child:
            raise ValueError(f"path: {path}: link {joint.child!r} is the child of two joints")
        by_child[joint.child] = joint
    roots = sorted(links - set(by_child))
    if len(roots) != 1:
        raise ValueError(f"path: {path}: expected one link without a parent, got {roots}")
    order, reached = [], {roots[0]}
    waiting = list(description.joints)
    while waiting:
        ready = [joint for joint in waiting if joint.parent in reached]
        if not ready:
            raise ValueError(f"path: {path}: joint {waiting[0].name!r} is part of a loop")
        # In the order of the file as far as parents allow.
        order.append(ready[0])
        reached.add(ready[0].child)
        waiting.remove(ready[0])
    return roots[0], order


def _joint(joint: Any, parent: int, coordinates: Mapping[str, int], by_name: Mapping[str, Any], path: Path) -> Joint:
    where = f"path: {path}: joint {joint.name!r}"
    if joint.type not in _KINDS:
        raise ValueError(f"{where}: expected a fixed, revolute, continuous or prismatic joint, got {joint.type!r}")
    origin = np.eye(4) if joint.origin is None else np.asarray(joint.origin, dtype=np.float64)
    axis = np.array([1.0, 0.0, 0.0]) if joint.axis is None else np.asarray(joint.axis, dtype=np.float64)
    length = float(np.linalg.norm(axis))
    kind = _KINDS[joint.type]
    if not (np.isfinite(origin).all() and np.isfinite(axis).all() and (length > 0.0 or kind == "fixed")):
        raise ValueError(f"{where}: expected a finite origin and an axis other than zero, got {axis.tolist()}")
    coordinate, scale, offset = -1, 1.0, 0.0
    if kind != "fixed":
        of, seen = joint, set()
        while of.mimic is not None:  # the one it follows may follow another
            factor = 1.0 if of.mimic.multiplier is None else of.mimic.multiplier
            offset += scale * (of.mimic.offset or 0.0)
            scale *= factor
            seen.add(of.name)
            if of.mimic.joint not in by_name or of.mimic.joint in seen or by_name[of.mimic.joint].type == "fixed":
                raise ValueError(f"{where}: there is no joint {of.mimic.joint!r} to mimic")
            of = by_name[of.mimic.joint]
        coordinate = coordinates[of.name]
    axis = axis / length if length > 0.0 else np.array([1.0, 0.0, 0.0])
    return Joint(
        joint.name, kind, parent, origin[:3, 3], quaternion_of(origin[:3, :3]), axis, coordinate, scale, offset
    )


def _limits(joint: Any) -> tuple[float, float]:
    if joint.type == "continuous" or joint.limit is None:
        return -np.inf, np.inf
    lower, upper = joint.limit.lower, joint.limit.upper
    return (0.0 if lower is None else lower, 0.0 if upper is None else upper)


def _surface(link: str, collision: Any, path: Path, packages: Mapping[str, str | PathLike[str]]) -> ThickSurface:
    geometry = collision.geometry
    try:
        if geometry.box is not None:
            surface = shapes.box(np.asarray(geometry.box.size, dtype=np.float64))
        elif geometry.cylinder is not None:
            surface = shapes.cylinder(geometry.cylinder.radius, geometry.cylinder.length / 2.0)
        elif geometry.sphere is not None:
            surface = shapes.sphere(arguments.length(geometry.sphere.radius, "radius"))
        else:
            file = _file(geometry.mesh.filename, path, packages)
            mesh = Mesh.load(file, unit="m")
            scale = np.ones(3) if geometry.mesh.scale is None else np.asarray(geometry.mesh.scale) * np.ones(3)
            surface = shapes.of_file(mesh, scale)
    except (OSError, ValueError) as error:
        raise type(error)(f"path: {path}: link {link!r}: {error}") from error
    if collision.origin is None:
        return surface
    origin = np.asarray(collision.origin, dtype=np.float64)
    return surface.placed(origin[:3, 3], quaternion_of(origin[:3, :3]))


def _file(name: str, path: Path, packages: Mapping[str, str | PathLike[str]]) -> Path:
    """The mesh file of that name in a URDF file."""
    if name.startswith("file://"):
        return Path(name.removeprefix("file://"))
    if not name.startswith(("package://", "model://")):
        return path.parent / name
    package, _, rest = name.partition("://")[2].partition("/")
    if package in packages:
        return Path(packages[package]) / rest
    for folder in path.resolve().parents:
        for candidate in (folder / package / rest, folder / rest):
            if candidate.is_file():
                return candidate
    raise ValueError(f"{name} is in no folder above {path.parent}: pass packages={{{package!r}: folder}}")


def _collisions(path: Path, number: Mapping[str, int]) -> tuple[set[tuple[int, int]], set[tuple[int, int]]]:
    """The pairs of links (i, j), i < j, that an SRDF file disables, and those that it enables."""
    if not path.is_file():
        raise FileNotFoundError(f"srdf: {path}: no such file")
    root = parsed_xml(path, "srdf")
    if root.tag != "robot":
        raise ValueError(f"srdf: {path} is no SRDF file: expected an element robot, got {root.tag}")
    if root.find("link") is not None:
        raise ValueError(f"srdf: {path} is a URDF file: it has links of its own")
    refuse_unknown(root, (*_PAIRS, *_OTHER_OF_SRDF), f"srdf: {path}")

    def links_of(element: ElementTree.Element, *names: str) -> list[int]:
        links = [element.get(name) or "" for name in names]
        for link in links:
            if link not in number:
                raise ValueError(f"srdf: {path}: {element.tag}: the robot has no link {link!r}")
        return [number[link] for link in links]

    def pairs(tag: str) -> set[tuple[int, int]]:
        found = (links_of(element, "link1", "link2") for element in root.iter(tag))
        return {(min(links), max(links)) for links in found}

    enabled, disabled = pairs("enable_collisions"), pairs("disable_collisions")
    for element in root.iter("disable_default_collisions"):
        (link,) = links_of(element, "link")
        disabled |= {(min(link, other), max(link, other)) for other in number.values() if other != link} - enabled
    return disabled, enabled - disabled


def _numbers(values: Sequence[float], name: str) -> np.ndarray:
    try:
        return np.array([float(value) for value in values])
    except (TypeError, ValueError) as error:
        raise TypeError(f"{name}: expected numbers, got {values!r}") from error


def _three(values: Sequence[float], name: str) -> np.ndarray:
    found = _numbers(values, name)
    if found.shape != (3,) or not np.isfinite(found).all():
        raise ValueError(f"{name}: expected three finite numbers, got {values}")
    return found


def _unit(values: Sequence[float]) -> np.ndarray:
    found = _numbers(values, "base_orientation")
    if found.shape != (4,) or not abs(np.linalg.norm(found) - 1.0) < 1e-3:
        raise ValueError(f"base_orientation: expected a unit quaternion (w, x, y, z), got {values}")
    return found / np.linalg.norm(found)
