"""Checks of links and joints in URDF files. Readers silently take too few or too many numbers, and leave out what they
do not know.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Sequence
from pathlib import Path
from xml.etree import ElementTree
from xml.etree.ElementTree import Element

import numpy as np

#: Numbers by element and attribute, how many, and whether the attribute may be missing.
_Numbers = Sequence[tuple[str, str, tuple[int, ...], bool]]
_PLACE: _Numbers = [("origin", "xyz", (3,), True), ("origin", "rpy", (3,), True)]
_SHAPES: dict[str, _Numbers] = {
    "box": [(".", "size", (3,), False)],
    "cylinder": [(".", "radius", (1,), False), (".", "length", (1,), False)],
    "sphere": [(".", "radius", (1,), False)],
    "mesh": [(".", "scale", (0, 1, 3), True)],
}
_LINK = ("collision",)
_JOINT_PARTS = ("origin", "parent", "child", "axis", "limit", "mimic")
_COLLISION = ("origin", "geometry")
# Elements that are left out: of looks, forces and other programs. Any other element may be misspelt geometry.
_OTHER_OF_ROBOT = ("frame", "gazebo", "material", "mujoco", "ros2_control", "sensor", "transmission")
_OTHER_OF_LINK = (
    *("visual", "inertial", "audio_source", "collision_checking", "contact", "gazebo", "gravity", "kinematic"),
    *("self_collision_checking", "self_filter", "sensor", "surface"),
)
_OTHER_OF_JOINT = ("calibration", "dynamics", "gazebo", "joint_properties", "safety_controller", "sensor")
_OTHER_OF_COLLISION = ("gazebo", "material", "max_contacts", "surface", "verbose")
# All attributes of the elements that are read. Those of limits that do not state the range occur in real files.
_ATTRIBUTES: dict[str, tuple[str, ...]] = {
    "origin": ("xyz", "rpy"),
    "parent": ("link",),
    "child": ("link",),
    "axis": ("xyz", "rpy"),
    "limit": (
        *("lower", "upper", "effort", "velocity", "acceleration", "deceleration", "jerk"),
        *("command_effort", "current", "gear_velocity", "twist"),
    ),
    "mimic": ("joint", "multiplier", "offset"),
    "box": ("size",),
    "cylinder": ("radius", "length"),
    "sphere": ("radius",),
    "mesh": ("filename", "scale"),
}
_JOINT: _Numbers = [
    *_PLACE,
    ("axis", "xyz", (3,), True),
    ("limit", "lower", (1,), True),
    ("limit", "upper", (1,), True),
    ("mimic", "multiplier", (1,), True),
    ("mimic", "offset", (1,), True),
]


def parsed_xml(path: Path, argument: str) -> Element:
    """The root of an XML file of which no element is a macro.

    Raises:
        ValueError: naming the argument.
    """
    data = path.read_bytes()
    try:
        root = ElementTree.fromstring(data)
    except ElementTree.ParseError as error:
        line, column = error.position
        # A parser meets the prefix before it meets its meaning, if it has one.
        if data.splitlines()[line - 1 : line] and data.splitlines()[line - 1][column:].startswith(b"<xacro:"):
            raise _macros(path, argument, f"line {line}") from error
        raise ValueError(f"{argument}: {path} cannot be read as XML: {error}") from error
    for element in root.iter():
        space, _, name = element.tag.rpartition("}")
        if "xacro" in space:
            raise _macros(path, argument, f"xacro:{name}")
    return root


def _macros(path: Path, argument: str, where: str) -> ValueError:
    return ValueError(
        f"{argument}: {path} has macros that are not expanded ({where}): run xacro, and load what it writes"
    )


def refuse_unknown(element: Element, known: Iterable[str], where: str) -> None:
    """Raises ValueError if an element contains an unknown one without a namespace.

    Elements with a namespace belong to other programs.
    """
    for part in element:
        if part.tag not in known and not part.tag.startswith("{"):
            expected = f"one of {', '.join(known)}" if known else "nothing within it"
            raise ValueError(
                f"{where}: unknown element {part.tag}: expected {expected}; those of other programs have a namespace"
            )


def check_elements(root: Element, path: Path) -> None:
    """Checks that all elements and attributes around joints and collision geometry are known.

    Raises:
        ValueError: naming link or joint and element.
    """
    if root.tag != "robot":
        raise ValueError(f"path: {path} is no URDF file: expected an element robot, got {root.tag}")
    refuse_unknown(root, ("link", "joint", *_OTHER_OF_ROBOT), f"path: {path}")
    for joint in root.findall("joint"):
        where = f"path: {path}: joint {joint.get('name')!r}"
        refuse_unknown(joint, (*_JOINT_PARTS, *_OTHER_OF_JOINT), where)
        _check_parts(joint, _JOINT_PARTS, where)
    for link in root.findall("link"):
        where = f"path: {path}: link {link.get('name')!r}"
        # Exporters write an origin that moves nothing.
        refuse_unknown(
            link, (*_LINK, *_OTHER_OF_LINK, *(["origin"] if _is_at_rest(link.find("origin")) else [])), where
        )
        for collision in link.findall("collision"):
            refuse_unknown(collision, (*_COLLISION, *_OTHER_OF_COLLISION), where)
            _check_parts(collision, _COLLISION, where)
            for geometry in collision.findall("geometry"):
                _check_parts(geometry, tuple(_SHAPES), where)


def _is_at_rest(origin: Element | None) -> bool:
    try:
        return origin is not None and not any(float(word) for value in origin.attrib.values() for word in value.split())
    except ValueError:
        return False


def _check_parts(element: Element, names: Sequence[str], where: str) -> None:
    """Checks that there is one of these parts, or equal ones, since readers take the first; with known attributes and
    nothing inside.
    """
    parts = [part for part in element if part.tag in names]
    for name, count in Counter(part.tag for part in parts).items():
        kinds = {ElementTree.tostring(part).strip() for part in parts if part.tag == name}
        if len(kinds) > 1:
            raise ValueError(f"{where}: expected one element {name}, got {count}")
    for part in parts:
        if part.tag == "geometry":
            continue
        refuse_unknown(part, (), f"{where}: {part.tag}")
        known = _ATTRIBUTES[part.tag]
        for attribute in part.attrib:
            if attribute not in known and not attribute.startswith("{"):
                expected = f"one of {', '.join(known)}"
                raise ValueError(f"{where}: {part.tag}: unknown attribute {attribute}: expected {expected}")


def keep_collisions(root: Element) -> None:
    """Removes all but links with their collision geometry, and joints: looks and masses may be wrong."""
    for kind, parts in (("robot", ("link", "joint")), ("link", _LINK), ("joint", _JOINT_PARTS)):
        for element in [root] if kind == "robot" else root.findall(kind):
            for part in list(element):
                if part.tag not in parts:
                    element.remove(part)


def check_urdf(root: Element, path: Path) -> None:
    """Checks names, shapes and numbers of collision geometry and joints.

    Raises:
        ValueError: naming link or joint and element.
    """
    if not root.get("name"):
        raise ValueError(f"path: {path}: the element robot has no name")
    for kind in ("link", "joint"):
        seen: set[str] = set()
        for number, element in enumerate(root.findall(kind)):
            name = element.get("name")
            if not name or name in seen:
                problem = f"{kind} {number} has no name" if not name else f"there are two {kind}s {name!r}"
                raise ValueError(f"path: {path}: {problem}")
            seen.add(name)
            where = f"path: {path}: {kind} {name!r}"
            if kind == "joint":
                _check_joint(element, where)
            for collision in element.findall("collision"):
                _check_collision(collision, where)


def _check_joint(joint: Element, where: str) -> None:
    for end in ("parent", "child"):
        found = joint.find(end)
        if found is None or not found.get("link"):
            raise ValueError(f"{where}: expected an element {end} with a link")
    _check_numbers(joint, _JOINT, where)


def _check_collision(collision: Element, where: str) -> None:
    _check_numbers(collision, _PLACE, where)
    geometry = collision.find("geometry")
    shapes = [] if geometry is None else list(geometry)
    if len(shapes) != 1 or shapes[0].tag not in _SHAPES:
        found = ", ".join(shape.tag for shape in shapes) or "nothing"
        raise ValueError(f"{where}: expected a collision geometry of one of {', '.join(_SHAPES)}; got {found}")
    _check_numbers(shapes[0], _SHAPES[shapes[0].tag], where)
    if shapes[0].tag == "mesh" and not shapes[0].get("filename"):
        raise ValueError(f"{where}: a mesh without a filename")


def _check_numbers(element: Element, wanted: _Numbers, where: str) -> None:
    for tag, attribute, counts, may_be_missing in wanted:
        found = element.find(tag)
        value = None if found is None else found.get(attribute)
        if value is None:
            if found is None or may_be_missing:
                continue
            raise ValueError(f"{where}: a {found.tag} without {attribute}")
        assert found is not None
        try:
            numbers = np.array([float(word) for word in value.split()])
        except ValueError:
            numbers = np.array([np.nan])
        if len(numbers) not in counts or not np.isfinite(numbers).all():
            expected = (
                "a finite number" if counts == (1,) else f"{' or '.join(str(n) for n in counts if n)} finite numbers"
            )
            raise ValueError(f"{where}: {found.tag}: {attribute}: expected {expected}, got {value!r}")
