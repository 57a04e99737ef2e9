"""Robots from MJCF files, compiled by MuJoCo."""

from __future__ import annotations

from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np

from pgccd import arguments
from pgccd.robots import shapes
from pgccd.robots.kinematics import Joint, Tree, turned
from pgccd.robots.links import adjacent_links
from pgccd.robots.robot import Robot, robot_of_file
from pgccd.robots.shapes import ThickSurface

_X = np.array([1.0, 0.0, 0.0])
_UPRIGHT = np.array([1.0, 0.0, 0.0, 0.0])


def load_mjcf(path: str | PathLike[str]) -> Robot:
    """A robot from an MJCF file: one body a MuJoCo body with geoms that may collide, its origin at its last joint.

    Boxes and meshes are taken as they are (MuJoCo itself takes the convex hulls of meshes). Cylinders and ellipsoids
    are polyhedra around them, at most 0.13 % and 0.8 % larger; spheres are exact to 1e-9 of their radius, capsules to
    rounding; height fields are solids with their base. Planes are infinite, whatever their size: in their place are
    squares of twice the robot's reach and distance at least, and a configuration in which the robot may leave them is
    invalid. Geoms with contype and
    conaffinity zero are left out, other values are not looked at. Not tested are pairs of bodies that are rigidly
    joined or joined by one joint, over bodies without geoms too, and those that elements `exclude` name; geoms of the
    world are tested against all bodies that move.

    Args:
        path: of the MJCF file.

    Raises:
        FileNotFoundError: it does not exist.
        ValueError: it cannot be read; or a joint is free or a ball, or a geom an SDF; naming it.
        ImportError: mujoco (extra `robots`) is not installed.

    Example:
        >>> robot = pgccd.robots.load_mjcf("arm.xml")
        >>> robot.link_names
        ['world', 'upper', 'lower']
    """
    path = arguments.path(path, "path")
    if not path.is_file():
        raise FileNotFoundError(f"path: {path}: no such file")
    mujoco, model = _compiled(path)
    joints = [Joint("", "fixed", -1, np.zeros(3), _UPRIGHT, _X)]
    # By body its frame, and where the body's own frame is in it: joints may be elsewhere than the body's frame.
    frame, shift = [0], [np.zeros(3)]
    names: list[str] = []
    limits: list[tuple[float, float]] = []
    for body in range(1, model.nbody):
        parent = int(model.body_parentid[body])
        at = model.body_pos[body] + shift[parent]
        turn, last, place = model.body_quat[body].copy(), frame[parent], np.zeros(3)
        first = int(model.body_jntadr[body])
        own = range(first, first + int(model.body_jntnum[body]))
        if not own:
            joints.append(Joint(model.body(body).name, "fixed", last, at, _unit(turn), _X))
            last = len(joints) - 1
        for k in own:
            joint = model.joint(k)
            kind = mujoco.mjtJoint(int(model.jnt_type[k]))
            name = joint.name or f"{model.body(body).name}.{k - first}"
            if kind not in (mujoco.mjtJoint.mjJNT_HINGE, mujoco.mjtJoint.mjJNT_SLIDE):
                what = f"a hinge or a slide, got {kind.name[6:].lower()}"
                fixed = ": the base of a robot is fixed; delete the joint" if kind == mujoco.mjtJoint.mjJNT_FREE else ""
                raise ValueError(f"path: {path}: joint {name!r}: expected {what}{fixed}")
            anchor = model.jnt_pos[k].copy()
            revolute = kind == mujoco.mjtJoint.mjJNT_HINGE
            offset = -float(model.qpos0[model.jnt_qposadr[k]])
            at = at + turned(_unit(turn), anchor - place)
            axis = model.jnt_axis[k] / np.linalg.norm(model.jnt_axis[k])
            what = "revolute" if revolute else "prismatic"
            joints.append(Joint(name, what, last, at, _unit(turn), axis, len(names), 1.0, offset))  # type: ignore[arg-type]
            last, at, turn, place = len(joints) - 1, np.zeros(3), _UPRIGHT, anchor
            names.append(name)
            low, high = model.jnt_range[k].tolist() if model.jnt_limited[k] else (-np.inf, np.inf)
            limits.append((low, high))
        frame.append(last)
        shift.append(-place)
    surfaces: list[list[ThickSurface]] = [[] for _ in range(model.nbody)]
    for k in range(model.ngeom):
        if model.geom_contype[k] or model.geom_conaffinity[k]:
            body = int(model.geom_bodyid[k])
            placed = surface_of_geom(mujoco, model, k, path).placed(model.geom_pos[k], _unit(model.geom_quat[k]))
            surfaces[body].append(placed.placed(shift[body], _UPRIGHT))
    labels = [model.body(body).name or f"body {body}" for body in range(model.nbody)]
    links = list(zip(labels, frame, surfaces, strict=True))
    tree = Tree(joints)
    # The world has no neighbours: its geoms are obstacles.
    excluded = adjacent_links(tree, [(f, bool(s) and body > 0) for body, (_, f, s) in enumerate(links)])
    for signature in model.exclude_signature.tolist():
        excluded.append((signature >> 16, signature & 0xFFFF))
    return robot_of_file(path, model_name(model, path), tree, links, names, limits, excluded)


def model_name(model: Any, path: Path) -> str:
    """The name of a compiled model, else that of its file."""
    return bytes(model.names).split(b"\0", 1)[0].decode() or path.stem


def _compiled(path: Path) -> tuple[Any, Any]:
    try:
        import mujoco
    except ImportError as error:
        raise ImportError(f"mujoco reads MJCF files: pip install 'pgccd[robots]' ({error})") from error
    try:
        return mujoco, mujoco.MjModel.from_xml_path(str(path))
    except ValueError as error:
        raise ValueError(f"path: {path} cannot be read as MJCF: {' '.join(str(error).split())}") from error


def surface_of_geom(mujoco: Any, model: Any, k: int, path: Path) -> ThickSurface:
    """The surface of a geom in its frame."""
    kinds, size = mujoco.mjtGeom, model.geom_size[k].astype(np.float64)
    kind = kinds(int(model.geom_type[k]))
    data = int(model.geom_dataid[k])
    if kind == kinds.mjGEOM_BOX:
        return shapes.box(2.0 * size)
    if kind == kinds.mjGEOM_SPHERE:
        return shapes.sphere(float(size[0]))
    if kind == kinds.mjGEOM_CAPSULE:
        return shapes.capsule(float(size[0]), float(size[1]))
    if kind == kinds.mjGEOM_CYLINDER:
        return shapes.cylinder(float(size[0]), float(size[1]))
    if kind == kinds.mjGEOM_ELLIPSOID:
        return shapes.ellipsoid(size)
    if kind == kinds.mjGEOM_PLANE:
        return shapes.infinite_plane()  # its size is that of its picture
    if kind == kinds.mjGEOM_MESH:
        vertex, face = int(model.mesh_vertadr[data]), int(model.mesh_faceadr[data])
        vertices = model.mesh_vert[vertex : vertex + int(model.mesh_vertnum[data])].astype(np.float64)
        faces = model.mesh_face[face : face + int(model.mesh_facenum[data])].astype(np.int64)
        return ThickSurface(vertices, faces)
    if kind == kinds.mjGEOM_HFIELD:
        rows, columns = int(model.hfield_nrow[data]), int(model.hfield_ncol[data])
        begin, (x, y, height, base) = int(model.hfield_adr[data]), model.hfield_size[data].tolist()
        heights = model.hfield_data[begin : begin + rows * columns].reshape(rows, columns).astype(np.float64)
        return shapes.height_field(heights * height, x, y, base)
    name = model.geom(k).name or f"number {k}"
    raise ValueError(f"path: {path}: geom {name!r}: expected a shape of known surface, got {kind.name[7:].lower()}")


def _unit(q: np.ndarray) -> np.ndarray:
    return q / np.linalg.norm(q)
