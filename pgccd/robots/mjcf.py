"""Robots from MJCF files, compiled by MuJoCo."""

from __future__ import annotations

from dataclasses import replace
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np

from pgccd import arguments
from pgccd.robots import shapes
from pgccd.robots.kinematics import Joint, Tree, turned
from pgccd.robots.readers import robot_of_file
from pgccd.robots.robot import Robot
from pgccd.robots.shapes import ThickSurface

_X = np.array([1.0, 0.0, 0.0])
_UPRIGHT = np.array([1.0, 0.0, 0.0, 0.0])


def load_mjcf(path: str | PathLike[str]) -> Robot:
    """A robot from an MJCF file: one body per MuJoCo body with geoms that may collide, its origin at its last joint.

    Boxes and meshes are taken as they are (MuJoCo itself takes the convex hulls of meshes). Cylinders and ellipsoids
    are polyhedra around them, at most 0.13 % and 0.8 % larger; spheres are exact to 1.3e-9 of their radius, capsules to
    rounding; height fields are solids with their base. Planes are infinite, whatever their size. They become squares of
    at least twice the robot's reach and distance; a configuration in which the robot may leave a square is invalid.

    The pairs of geoms of different bodies that MuJoCo tests are tested. Left out are bodies that are rigidly joined; a
    body and its parent, each with all that is rigidly joined to it, unless the parent is the world or the flag
    `filterparent` is disabled; and pairs that `contype` and `conaffinity` or elements `exclude` leave out. Pairs that
    elements `pair` name are tested in any case, unless no joint moves them. Bodies without geoms count as parents too.
    Geoms whose contype and conaffinity are zero are left out, unless a `pair` names them; all other geoms are tested
    against obstacles. See `Robot.untested`. A warning names pairs that are tested and touch in the model's initial
    configuration.

    A joint that an `equality` ties to another joint by a linear `polycoef` has no value of its own. Constraints that
    are not active, or that a flag disables, are left out. Tendons without an `equality` exert forces only, and are not
    read.

    Args:
        path: of the MJCF file.

    Raises:
        FileNotFoundError: it does not exist.
        ValueError: the file cannot be read; or, naming it, the file has a free or ball joint, an SDF geom, a mocap
            body, a flex, or a constraint that ties joints in another way, tendons, or bodies that move.
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
    follows = _followed_joints(mujoco, model, path)
    joints = [Joint("", "fixed", -1, np.zeros(3), _UPRIGHT, _X)]
    # For each body, its frame, and where the MuJoCo body's own frame is in it: joints may be elsewhere than that frame.
    frame, shift = [0], [np.zeros(3)]
    names: list[str] = []
    limits: list[tuple[float, float]] = []
    neutral: list[float] = []
    # A joint's value, from the initial one, is scale * q[coordinate] + offset.
    values: dict[int, tuple[int, float, float]] = {}
    for k in range(model.njnt):
        if k not in follows:
            initial = float(model.qpos0[model.jnt_qposadr[k]])
            values[k] = (len(neutral), 1.0, -initial)
            neutral.append(initial)
    for k in range(model.njnt):
        chain, at_joint = [], k
        while at_joint in follows:
            if at_joint in chain:
                raise ValueError(
                    f"path: {path}: joint {_name(model.joint(k))!r}: equality constraints tie it to itself"
                )
            chain.append(at_joint)
            at_joint = follows[at_joint][0]
        for each in reversed(chain):
            leader, constant, factor = follows[each]
            coordinate, scale, offset = values[leader]
            values[each] = (coordinate, factor * scale, constant + factor * offset)
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
            at = at + turned(_unit(turn), anchor - place)
            axis = model.jnt_axis[k] / np.linalg.norm(model.jnt_axis[k])
            what = "revolute" if revolute else "prismatic"
            joints.append(Joint(name, what, last, at, _unit(turn), axis, *values[k]))  # type: ignore[arg-type]
            last, at, turn, place = len(joints) - 1, np.zeros(3), _UPRIGHT, anchor
            if k in follows:
                continue
            names.append(name)
            low, high = model.jnt_range[k].tolist() if model.jnt_limited[k] else (-np.inf, np.inf)
            limits.append((low, high))
        frame.append(last)
        shift.append(-place)
    pairs = {frozenset(pair) for pair in zip(model.pair_geom1.tolist(), model.pair_geom2.tolist(), strict=True)}
    in_pairs = {geom for pair in pairs for geom in pair}
    surfaces: list[list[ThickSurface]] = [[] for _ in range(model.nbody)]
    for k in range(model.ngeom):
        bits = (int(model.geom_contype[k]), int(model.geom_conaffinity[k]))
        if any(bits) or k in in_pairs:
            body = int(model.geom_bodyid[k])
            placed = surface_of_geom(mujoco, model, k, path).placed(model.geom_pos[k], _unit(model.geom_quat[k]))
            # Geoms with the same filters are one body.
            group = (*bits, k) if k in in_pairs else bits
            surfaces[body].append(replace(placed.placed(shift[body], _UPRIGHT), group=group))
    labels = [model.body(body).name or f"body {body}" for body in range(model.nbody)]
    links = list(zip(labels, frame, surfaces, strict=True))
    weld = model.body_weldid.tolist()
    weld_parent = [weld[model.body_parentid[body]] for body in weld]
    filters_parents = not int(model.opt.disableflags) & int(mujoco.mjtDisableBit.mjDSBL_FILTERPARENT)
    excluded = {(signature >> 16, signature & 0xFFFF) for signature in model.exclude_signature.tolist()}

    def why_untested(i: int, of_i: tuple[int, ...], j: int, of_j: tuple[int, ...]) -> str | None:
        if frozenset((*of_i[2:], *of_j[2:])) in pairs:
            return None
        if weld[i] == weld[j]:
            return "adjacent"
        if filters_parents and weld[i] and weld[j] and (weld[i] == weld_parent[j] or weld[j] == weld_parent[i]):
            return "adjacent"
        meet = of_i[0] & of_j[1] or of_j[0] & of_i[1]
        return None if meet and (i, j) not in excluded else "file"

    return robot_of_file(path, neutral, model_name(model, path), Tree(joints), links, names, limits, why_untested)


def _followed_joints(mujoco: Any, model: Any, path: Path) -> dict[int, tuple[int, float, float]]:
    """For each joint that follows another: that joint, a constant and a factor, both for values relative to the initial
    ones.

    Raises:
        ValueError: a constraint is of another kind, or there is a flex.
    """
    if model.nflex:
        raise ValueError(f"path: {path}: flex {model.flex(0).name!r}: expected bodies that do not deform")
    for body in np.flatnonzero(model.body_mocapid >= 0).tolist():
        named = f"body {_name(model.body(body))!r}"
        raise ValueError(f"path: {path}: {named}: expected a body that joints move, or nothing, got mocap")
    kinds, found = mujoco.mjtEq, {}
    off = int(mujoco.mjtDisableBit.mjDSBL_EQUALITY) | int(mujoco.mjtDisableBit.mjDSBL_CONSTRAINT)
    is_off = bool(int(model.opt.disableflags) & off)
    for k in range(model.neq):
        if is_off or not model.eq_active0[k]:
            continue
        kind = kinds(int(model.eq_type[k]))
        one, other = int(model.eq_obj1id[k]), int(model.eq_obj2id[k])
        name = model.equality(k).name or f"number {k}"
        where = f"path: {path}: equality {name!r}"
        if kind == kinds.mjEQ_JOINT:
            constant, factor, *higher = model.eq_data[k, :5].tolist()
            of = f"{where} of joint {_name(model.joint(one))!r}"
            if other < 0 or any(higher):
                what = "another joint, by a polycoef of two terms"
                raise ValueError(f"{of}: expected {what}, got {model.eq_data[k, :5].tolist()}")
            if one in found:
                raise ValueError(f"{of}: another one ties it already")
            found[one] = (other, constant, factor)
            continue
        if kind in (kinds.mjEQ_CONNECT, kinds.mjEQ_WELD):
            is_of_sites = int(model.eq_objtype[k]) == int(mujoco.mjtObj.mjOBJ_SITE)
            bodies = [int(model.site_bodyid[each]) if is_of_sites else each for each in (one, other)]
            if not any(model.body_weldid[body] for body in bodies):
                continue  # both are fixed
        raise ValueError(f"{where}: expected one of joints, got {kind.name[5:].lower()}")
    return found


def _name(joint: Any) -> str:
    return joint.name or f"number {joint.id}"


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
