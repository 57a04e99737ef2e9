"""What a URDF file must say of its links and joints: readers take fewer numbers, or more, without a word."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
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
_KEPT = {
    "robot": ("link", "joint"),
    "link": ("collision",),
    "joint": ("origin", "parent", "child", "axis", "limit", "mimic"),
}
_JOINT: _Numbers = [
    *_PLACE,
    ("axis", "xyz", (3,), True),
    ("limit", "lower", (1,), True),
    ("limit", "upper", (1,), True),
    ("mimic", "multiplier", (1,), True),
    ("mimic", "offset", (1,), True),
]


def keep_collisions(root: Element) -> None:
    """Removes all but links with their collision geometry, and joints: looks and masses may be wrong."""
    for kind, parts in _KEPT.items():
        for element in [root] if kind == "robot" else root.findall(kind):
            for part in list(element):
                if part.tag not in parts:
                    element.remove(part)


def check_urdf(root: Element, path: Path) -> None:
    """Checks names, shapes and numbers of collision geometry and joints.

    Raises:
        ValueError: naming link or joint and element.
    """
    if root.tag != "robot":
        raise ValueError(f"path: {path} is no URDF file: expected an element robot, got {root.tag}")
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
