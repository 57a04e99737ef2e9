"""Every shape of every reader against the simulator it is read for: shapes are placed at random, and where the
simulator reports penetration, so does `detect`; where it reports a gap larger than a reader's stated excess, not.

Left out are pairs of which one may be wholly inside the other, since surfaces then do not touch. Meshes are convex,
since simulators take their hulls.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from numpy.random import Generator
from support.shapes import unit_quaternions

import pgccd
from pgccd.robots import load_mjcf, load_urdf

Found = set[tuple[int, int]]
# By kind, in units of the largest half axis: how much larger a surface is at most, as docstrings say.
EXCESS = {"cylinder": 0.0013, "ellipsoid": 0.008}
LARGEST = 0.4
# PyBullet rounds the edges of its boxes with their margin, 0.001: a corner is so much further out here.
BULLET_EXCESS = EXCESS | {"box": 0.001 * (3.0**0.5 - 1.0) / LARGEST}
POSES = 10


class Tally:
    """Pairs of shapes that were compared, by kind."""

    def __init__(self, excess: Mapping[str, float] = EXCESS) -> None:
        self._excess = excess
        self.touching: Counter[str] = Counter()
        self.apart: Counter[str] = Counter()
        self.wrong: list[tuple[Any, ...]] = []

    def add(self, kinds: tuple[str, str], distance: float, found: bool, rounding: float, *, width: float) -> None:
        """Compares a pair.

        Args:
            distance: the simulator's.
            rounding: the error of it.
            width: of penetration with which one may be inside the other.
        """
        excess = LARGEST * sum(self._excess.get(kind, 0.0) for kind in kinds)
        touches, is_apart = -0.5 * width < distance < -rounding, distance > excess + rounding
        if touches or is_apart:
            (self.touching if touches else self.apart).update(kinds)
            if found != touches:
                self.wrong.append((*kinds, distance, found))

    def check(self, kinds: set[str], at_least: int) -> None:
        """All agree, and there were enough of each kind, both touching and apart."""
        assert self.wrong == []
        for kind in kinds:
            assert min(self.touching[kind], self.apart[kind]) >= at_least, (kind, self.touching, self.apart)


def touching(scene: pgccd.Scene, position: torch.Tensor, orientation: torch.Tensor) -> Found:
    pairs = pgccd.collide(scene, pgccd.RigidMotion.at_rest(position, orientation)).pairs
    return {(int(i), int(j)) for i, j in pairs.tolist()}


def hull(rng: Generator, spread: float = 0.3) -> tuple[np.ndarray, np.ndarray]:
    """The corners of a random convex polyhedron, and its triangles, counter-clockwise from outside."""
    spatial = pytest.importorskip("scipy.spatial")
    points = rng.normal(size=(12, 3)) * spread
    points = points[spatial.ConvexHull(points).vertices]
    found = spatial.ConvexHull(points)
    faces = found.simplices.copy()
    a, b, c = points[faces].transpose(1, 0, 2)
    inwards = np.einsum("fk,fk->f", np.cross(b - a, c - a), found.equations[:, :3]) < 0.0
    faces[inwards] = faces[inwards][:, ::-1]
    return points, faces


def width_of(points: np.ndarray) -> float:
    """The least width of a convex polyhedron across one of its faces."""
    normals = pytest.importorskip("scipy.spatial").ConvexHull(points).equations[:, :3]
    along = points @ normals.T
    return float(np.ptp(along, axis=0).min())


def mirrored_scale(rng: Generator) -> np.ndarray:
    return rng.uniform(0.5, 1.2, 3) * rng.choice([-1.0, 1.0], 3)


def quaternion(rng: Generator) -> np.ndarray:
    """w, x, y, z."""
    return unit_quaternions(rng, 1)[0]


def text(values: Any) -> str:
    return " ".join(repr(float(value)) for value in np.ravel(values))


def few_models_and_many(few: int, many: int) -> Callable[[Any], Any]:
    """Numbers of random models, and comparisons of each kind at least: all 200 in a slow run."""
    return pytest.mark.parametrize(
        ("models", "at_least"), [(few, 5), pytest.param(many, 200, marks=pytest.mark.slow)], ids=["few", "many"]
    )


MUJOCO_KINDS = {"box": 3, "sphere": 1, "capsule": 2, "cylinder": 2, "ellipsoid": 3, "mesh": 0}


def mujoco_text(rng: Generator) -> str:
    """Bodies on slides and hinges with a shape each, and a plane and a height field in the world."""

    def placed() -> str:
        return f'pos="{text(rng.normal(size=3) * 0.1)}" quat="{text(quaternion(rng))}"'

    axes = ("1 0 0", "0 1 0", "0 0 1")
    assets, bodies = [], []
    for number, (kind, count) in enumerate([*MUJOCO_KINDS.items(), ("mesh", 0)]):
        size = f'size="{text(rng.uniform(0.1, LARGEST, count))}"' if count else f'mesh="mesh{number}"'
        if kind == "mesh":
            points = hull(rng)[0] + rng.normal(size=3) * 0.2
            shift = f'refpos="{text(rng.normal(size=3) * 0.2)}" refquat="{text(quaternion(rng))}"'
            inertia = rng.choice(["convex", "exact", "legacy", "shell"])
            scale = text(mirrored_scale(rng))
            assets.append(
                f'<mesh name="mesh{number}" vertex="{text(points)}" scale="{scale}" inertia="{inertia}" {shift}/>'
            )
        joints = "".join(f'<joint type="slide" axis="{axis}"/>' for axis in axes)
        joints += "".join(
            f'<joint type="hinge" axis="{axis}" pos="{text(rng.normal(size=3) * 0.2)}"/>' for axis in axes
        )
        geom = f'<geom name="{number} {kind}" type="{kind}" {size} {placed()}/>'
        bodies.append(f'<body name="{number}" {placed()}>{joints}{geom}</body>')
    rows, columns = rng.integers(2, 5, 2)
    size = rng.uniform(0.5, 1.0, 4) * [1.0, 1.0, 0.5, 0.3]
    heights = f'nrow="{rows}" ncol="{columns}" elevation="{text(rng.uniform(size=rows * columns))}"'
    assets.append(f'<hfield name="field" size="{text(size)}" {heights}/>')
    plane = f'<geom name="- plane" type="plane" size="{rng.choice(["0 0 1", "0.1 0.2 1", "0 0.3 1"])}" {placed()}/>'
    field = f'<geom name="- hfield" type="hfield" hfield="field" {placed()}/>'
    return (
        f'<mujoco><compiler angle="radian"/><asset>{"".join(assets)}</asset>'
        f"<worldbody>{plane}{field}{''.join(bodies)}</worldbody></mujoco>"
    )


def is_in_field(model: Any, data: Any, geom: int, point: np.ndarray) -> bool:
    """Whether a point may be inside the solid of a height field."""
    number = int(model.geom_dataid[geom])
    x, y, z = data.geom_xmat[geom].reshape(3, 3).T @ (point - data.geom_xpos[geom])
    half_x, half_y, height, base = model.hfield_size[number]
    if abs(x) >= half_x or abs(y) >= half_y or z <= -base:
        return False
    rows, columns = int(model.hfield_nrow[number]), int(model.hfield_ncol[number])
    heights = model.hfield_data[model.hfield_adr[number] :][: rows * columns].reshape(rows, columns) * height
    column, row = int((x / half_x + 1.0) / 2.0 * (columns - 1)), int((y / half_y + 1.0) / 2.0 * (rows - 1))
    return bool(z < heights[row : row + 2, column : column + 2].max())


@few_models_and_many(3, 40)
def test_mujoco_and_mjcf(tmp_path: Path, models: int, at_least: int) -> None:
    mujoco = pytest.importorskip("mujoco")
    tallies, path = (Tally(), Tally()), tmp_path / "model.xml"
    for seed in range(models):
        rng = np.random.default_rng(seed)
        path.write_text(mujoco_text(rng))
        model = mujoco.MjModel.from_xml_path(str(path))
        data = mujoco.MjData(model)
        model.geom_margin[:] = 0.02  # contacts of planes and height fields are reported from there on
        kinds = [model.geom(geom).name.split()[1] for geom in range(model.ngeom)]
        widths = []
        for geom, kind in enumerate(kinds):
            size = model.geom_size[geom][: MUJOCO_KINDS.get(kind, 0)]
            if kind == "mesh":
                number = int(model.geom_dataid[geom])
                first = int(model.mesh_vertadr[number])
                widths.append(width_of(model.mesh_vert[first : first + int(model.mesh_vertnum[number])].astype(float)))
            elif kind == "capsule":
                widths.append(2.0 * size[0])
            else:
                widths.append(2.0 * size.min() if len(size) else np.inf)
        simulator, robot = pgccd.simulators.MuJoCo(model), load_mjcf(path)
        # The world's geoms are two bodies of the robot: the height field is before the plane.
        links = [robot.link_names[link] for link in robot.body_link.tolist()]
        assert links[:2] == ["world", "world"] and len(robot.meshes[1].faces) == 2
        geoms = [kinds.index("hfield"), kinds.index("plane"), *(int(link) + 2 for link in links[2:])]
        for _ in range(POSES):
            data.qpos[:] = rng.normal(size=model.nq) * 0.5
            mujoco.mj_forward(model, data)
            near: dict[tuple[int, int], float] = {}
            for pair, distance in zip(data.contact.geom.tolist(), data.contact.dist.tolist(), strict=True):
                key = (min(pair), max(pair))
                near[key] = min(near.get(key, np.inf), distance)
            found = touching(simulator.scene, *simulator.frame(data))
            of_robot = touching(robot.scene(), *robot.poses(torch.from_numpy(data.qpos.copy())))
            of_robot = {tuple(sorted((geoms[i], geoms[j]))) for i, j in of_robot}  # type: ignore[misc]
            for j in range(2, model.ngeom):
                for i in range(j):
                    if i >= 2:
                        distance = mujoco.mj_geomDistance(model, data, i, j, 1.0, np.zeros(6))
                    else:
                        distance = near.get((i, j), np.inf)
                        if kinds[i] == "hfield" and distance < 0.0 and is_in_field(model, data, i, data.geom_xpos[j]):
                            continue
                    width = min(widths[i], widths[j]) if kinds[i] != "hfield" else np.inf
                    for tally, pairs in zip(tallies, (found, of_robot), strict=True):
                        tally.add((kinds[i], kinds[j]), distance, (i, j) in pairs, 1e-5, width=width)
    for tally in tallies:
        tally.check({*MUJOCO_KINDS, "plane", "hfield"}, at_least)


@pytest.mark.parametrize(("elevation", "height", "touches"), [("1 0 0 1", 0.5, False), ("0 1 1 0", 0.9, True)])
def test_cells_of_height_fields_are_folded_as_in_mujoco(elevation: str, height: float, touches: bool) -> None:
    """A ball above a cell, in a valley or on a ridge between two corners; files begin with the last row."""
    mujoco = pytest.importorskip("mujoco")
    model = mujoco.MjModel.from_xml_string(
        f"""<mujoco><asset><hfield name="f" nrow="2" ncol="2" size="1 1 1 0.1" elevation="{elevation}"/></asset>
        <worldbody><geom type="hfield" hfield="f"/>
        <body pos="0 0 {height}"><freejoint/><geom size="0.2"/></body></worldbody></mujoco>"""
    )
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    simulator = pgccd.simulators.MuJoCo(model)
    assert bool(data.ncon) == touches == bool(touching(simulator.scene, *simulator.frame(data)))


BULLET_KINDS = ("box", "sphere", "capsule", "cylinder", "points", "points", "file", "file", "plane")


def add_to_bullet(bullet: Any, rng: Generator, kind: str, folder: Path) -> tuple[int, float]:
    """A body of a random shape, placed in its body and about its centre of mass; and its width."""

    def placed(what: str) -> dict[str, Any]:
        turn = quaternion(rng)[[1, 2, 3, 0]].tolist()
        return {f"{what}FramePosition": (rng.normal(size=3) * 0.1).tolist(), f"{what}FrameOrientation": turn}

    size, scale, width = rng.uniform(0.1, LARGEST, 3), mirrored_scale(rng), np.inf
    normal = rng.normal(size=3)
    points, faces = hull(rng)
    if kind == "file":
        # Only meshes of URDF files keep the names of their files.
        rows = [f"v {text(point)}" for point in points] + ["f {} {} {}".format(*face) for face in (faces + 1).tolist()]
        name = f"{rng.integers(1 << 40)}"
        (folder / f"{name}.obj").write_text("\n".join(rows))
        inertia = '<mass value="1"/><inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/>'
        origin = [f'<origin xyz="{text(o[:3])}" rpy="{text(o[3:])}"/>' for o in rng.normal(size=(2, 6)) * 0.2]
        mesh = f'<geometry><mesh filename="{name}.obj" scale="{text(scale)}"/></geometry>'
        link = f"<inertial>{origin[0]}{inertia}</inertial><collision>{origin[1]}{mesh}</collision>"
        (folder / f"{name}.urdf").write_text(f'<robot name="r"><link name="l">{link}</link></robot>')
        return bullet.loadURDF(str(folder / f"{name}.urdf")), width_of(points * scale)
    if kind == "box":
        what, width = {"shapeType": bullet.GEOM_BOX, "halfExtents": size.tolist()}, 2.0 * size.min()
    elif kind == "plane":
        what = {"shapeType": bullet.GEOM_PLANE, "planeNormal": (normal / np.linalg.norm(normal)).tolist()}
    elif kind == "points":
        what = {"shapeType": bullet.GEOM_MESH, "vertices": points.tolist(), "meshScale": scale.tolist()}
        width = width_of(points * scale)
    else:
        number = {"sphere": bullet.GEOM_SPHERE, "capsule": bullet.GEOM_CAPSULE, "cylinder": bullet.GEOM_CYLINDER}[kind]
        what = {"shapeType": number, "radius": size[0], "height": 2.0 * size[1]}
        width = 2.0 * (size[:2].min() if kind == "cylinder" else size[0])
    shape = bullet.createCollisionShape(**what, **placed("collision"))
    return bullet.createMultiBody(0.0 if kind == "plane" else 1.0, shape, **placed("baseInertial")), width


@few_models_and_many(3, 40)
def test_pybullet(tmp_path: Path, models: int, at_least: int) -> None:
    bullet = pytest.importorskip("pybullet")
    tally, client = Tally(BULLET_EXCESS), bullet.connect(bullet.DIRECT)
    try:
        for seed in range(models):
            rng = np.random.default_rng(seed)
            bullet.resetSimulation(physicsClientId=client)
            widths = [add_to_bullet(bullet, rng, kind, tmp_path)[1] for kind in BULLET_KINDS]
            simulator = pgccd.simulators.PyBullet(client)
            for _ in range(POSES):
                for body in range(len(BULLET_KINDS)):
                    turn = quaternion(rng)[[1, 2, 3, 0]].tolist()
                    bullet.resetBasePositionAndOrientation(body, (rng.normal(size=3) * 0.4).tolist(), turn)
                found = touching(simulator.scene, *simulator.frame())
                for j in range(len(BULLET_KINDS)):
                    for i in range(j):
                        near = [row[8] for row in bullet.getClosestPoints(i, j, 0.05)]
                        kinds, width = (BULLET_KINDS[i], BULLET_KINDS[j]), min(widths[i], widths[j])
                        tally.add(kinds, min(near, default=np.inf), (i, j) in found, 1e-5, width=width)
    finally:
        bullet.disconnect(client)
    tally.check(set(BULLET_KINDS), at_least)


URDF_KINDS = ("box", "sphere", "cylinder", "mesh", "mesh")


def urdf_text(rng: Generator, folder: Path) -> tuple[str, list[float]]:
    """Links on three slides and two hinges with a shape each; and their widths."""
    links, joints, widths = ['<link name="base"/>'], [], []
    inertia = '<mass value="1"/><inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/>'
    for number, kind in enumerate(URDF_KINDS):
        size, scale = rng.uniform(0.1, LARGEST, 3), mirrored_scale(rng)
        origin = [f'<origin xyz="{text(o[:3])}" rpy="{text(o[3:])}"/>' for o in rng.normal(size=(2, 6)) * 0.2]
        if kind == "mesh":
            points, faces = hull(rng)
            rows = [f"v {text(p)}" for p in points] + ["f {} {} {}".format(*face) for face in (faces + 1).tolist()]
            (folder / f"{number}.obj").write_text("\n".join(rows))
            shape, width = f'<mesh filename="{number}.obj" scale="{text(scale)}"/>', width_of(points * scale)
        elif kind == "box":
            shape, width = f'<box size="{text(2.0 * size)}"/>', 2.0 * size.min()
        else:
            length = f'length="{2.0 * size[1]}"' if kind == "cylinder" else ""
            shape, width = f'<{kind} radius="{size[0]}" {length}/>', 2.0 * size[: 1 + (kind == "cylinder")].min()
        widths.append(width)
        above = "base"
        for k, axis in enumerate(("1 0 0", "0 1 0", "0 0 1", "1 0 0", "0 1 0")):
            name = f"{number}" if k == 4 else f"{number} {k}"
            what = '"continuous"' if k > 2 else '"prismatic"'
            ends = f'<parent link="{above}"/><child link="{name}"/><axis xyz="{axis}"/>'
            limit = '<limit lower="-9" upper="9" effort="1" velocity="1"/>'
            joints.append(f'<joint name="to {name}" type={what}>{ends}{limit}</joint>')
            collision = f"<collision>{origin[0]}<geometry>{shape}</geometry></collision>" if k == 4 else ""
            links.append(f'<link name="{name}"><inertial>{inertia}</inertial>{collision}</link>')
            above = name
    # PyBullet breaks long lines.
    return '<robot name="r">' + "".join(links + joints).replace("><", ">\n<") + "</robot>", widths


@few_models_and_many(4, 80)
def test_urdf_against_pybullet(tmp_path: Path, models: int, at_least: int) -> None:
    bullet, _ = pytest.importorskip("pybullet"), pytest.importorskip("yourdfpy")
    tally, client = Tally(BULLET_EXCESS), bullet.connect(bullet.DIRECT)
    try:
        for seed in range(models):
            rng = np.random.default_rng(seed)
            folder = tmp_path / f"{seed}"  # it keeps files by name
            folder.mkdir()
            written, widths = urdf_text(rng, folder)
            (folder / "robot.urdf").write_text(written)
            robot = load_urdf(folder / "robot.urdf")
            body = bullet.loadURDF(
                str(folder / "robot.urdf"), useFixedBase=True, flags=bullet.URDF_USE_IMPLICIT_CYLINDER
            )
            number = {}
            for joint in range(bullet.getNumJoints(body)):
                row = bullet.getJointInfo(body, joint)
                number[row[1].decode()], number[row[12].decode()] = joint, joint
            links = [robot.link_names[link] for link in robot.body_link.tolist()]
            for _ in range(POSES):
                q = rng.normal(size=robot.joint_count) * 0.4
                for name, value in zip(robot.joint_names, q.tolist(), strict=True):
                    bullet.resetJointState(body, number[name], value)
                found = touching(robot.scene(), *robot.poses(torch.from_numpy(q)))
                for j, b in enumerate(links):
                    for i, a in enumerate(links[:j]):
                        kinds = (URDF_KINDS[int(a)], URDF_KINDS[int(b)])
                        near = [row[8] for row in bullet.getClosestPoints(body, body, 0.05, number[a], number[b])]
                        # Its hulls are thicker by 0.001; that is no property of the file.
                        distance = min(near, default=np.inf) + 0.001 * kinds.count("mesh")
                        width = min(widths[int(a)], widths[int(b)])
                        tally.add(kinds, distance, (i, j) in found, 1e-5, width=width)
            bullet.removeBody(body)
    finally:
        bullet.disconnect(client)
    tally.check(set(URDF_KINDS), at_least)


NEWTON_KINDS = ("box", "sphere", "capsule", "cylinder", "ellipsoid", "hull", "hull", "mesh", "plane", "rectangle")
RECTANGLE = np.array([0.6, 1.0])


def newton_model(newton: Any, warp: Any, rng: Generator) -> tuple[Any, list[float]]:
    """A model of all kinds of shapes with margins; and their widths."""
    builder, widths = newton.ModelBuilder(), []

    def placed(spread: float) -> Any:
        turn = warp.quat(*quaternion(rng)[[1, 2, 3, 0]].tolist())
        return warp.transform((rng.normal(size=3) * spread).tolist(), turn)

    for kind in NEWTON_KINDS:
        size, scale = rng.uniform(0.1, LARGEST, 3), mirrored_scale(rng)
        margin = float(rng.choice([0.0, 0.02]))
        given = {"xform": placed(0.1), "cfg": newton.ModelBuilder.ShapeConfig(margin=margin, gap=0.05)}
        width = 2.0 * size[: {"sphere": 1, "capsule": 1, "cylinder": 2}.get(kind, 3)].min()
        if kind in ("plane", "rectangle"):
            along = 2.0 * RECTANGLE if kind == "rectangle" else [0.0, 0.0]
            builder.add_shape_plane(None, width=float(along[0]), length=float(along[1]), **given)
            width = np.inf
        elif kind in ("hull", "mesh"):
            points, faces = hull(rng)
            scale = scale if kind == "hull" else np.abs(scale)  # its mirrored triangles face inwards
            width = width_of(points * scale)
            mesh = newton.Mesh(points.astype(np.float32), faces.ravel().astype(np.int32))
            add = builder.add_shape_convex_hull if kind == "hull" else builder.add_shape_mesh
            add(builder.add_body(), mesh=mesh, scale=scale.tolist(), **given)
        else:
            names = {"box": ("hx", "hy", "hz"), "sphere": ("radius",), "ellipsoid": ("rx", "ry", "rz")}
            sizes = dict(zip(names.get(kind, ("radius", "half_height")), size.tolist(), strict=False))
            getattr(builder, f"add_shape_{kind}")(builder.add_body(), **sizes, **given)
        widths.append(width)
    return builder.finalize(device="cpu"), widths


def is_beside(model: Any, simulator: Any, pose: tuple[torch.Tensor, torch.Tensor], i: int, rectangle: int) -> bool:
    """Whether shape i may reach beyond the sides of a rectangle, about which Newton takes it as infinite."""
    from pgccd.robots.kinematics import turned

    place = model.shape_transform.numpy().astype(np.float64)
    position, orientation = (column[i].double().numpy() for column in pose)
    centre = position + turned(orientation, place[i, :3]) - place[rectangle, :3]
    local = turned(place[rectangle, [6, 3, 4, 5]] * [1.0, -1.0, -1.0, -1.0], centre)
    radius = model.shape_collision_radius.numpy()[i] + model.shape_margin.numpy()[i]
    return bool((np.abs(local[:2]) + radius > RECTANGLE).any())


@pytest.mark.slow
@pytest.mark.timeout(900)
def test_newton() -> None:
    """Slow, since Newton compiles its collision pipeline."""
    newton, warp = pytest.importorskip("newton"), pytest.importorskip("warp")
    warp.config.quiet = True
    tally = Tally()
    for seed in range(40):
        rng = np.random.default_rng(seed)
        model, widths = newton_model(newton, warp, rng)
        simulator, state = pgccd.simulators.Newton(model), model.state()
        assert simulator.shapes.tolist() == list(range(len(NEWTON_KINDS)))
        pipeline = newton.CollisionPipeline(model, broad_phase="nxn", reduce_contacts=False, rigid_contact_max=20000)
        contacts = pipeline.contacts()
        distances = warp.zeros(contacts.rigid_contact_max, dtype=float, device="cpu")
        for _ in range(POSES):
            poses = state.body_q.numpy()
            poses[:, :3] = rng.normal(size=(len(poses), 3)) * 0.4
            poses[:, 3:] = unit_quaternions(rng, len(poses))
            state.body_q.assign(poses)
            pipeline.collide(state, contacts)
            newton.eval_rigid_contact_kinematics(model, state, contacts, out_distance=distances)
            count = int(contacts.rigid_contact_count.numpy()[0])
            columns = (contacts.rigid_contact_shape0, contacts.rigid_contact_shape1, distances)
            near: dict[tuple[int, int], float] = {}
            for a, b, distance in zip(*(column.numpy()[:count].tolist() for column in columns), strict=True):
                near[min(a, b), max(a, b)] = min(near.get((min(a, b), max(a, b)), np.inf), distance)
            pose = simulator.frame(state)
            found = touching(simulator.scene, *pose)
            for j, b in enumerate(NEWTON_KINDS[:-2] + NEWTON_KINDS[-2:]):
                for i, a in enumerate(NEWTON_KINDS[: min(j, len(NEWTON_KINDS) - 2)]):
                    distance = near.get((i, j), np.inf)
                    # It reports no contact of some triangle meshes that touch.
                    if distance == np.inf and "mesh" in (a, b):
                        continue
                    if b == "rectangle" and distance < 0.0 and is_beside(model, simulator, pose, i, j):
                        continue
                    tally.add((a, b), distance, (i, j) in found, 1e-4, width=min(widths[i], widths[j]))
    tally.check(set(NEWTON_KINDS), 60)


def test_distances_are_those_of_spheres_and_capsules() -> None:
    """MuJoCo computes them in closed form."""
    mujoco = pytest.importorskip("mujoco")
    rng = np.random.default_rng(12)
    sizes = [(0.1, 0.0), (0.3, 0.0), (0.1, 0.4), (0.2, 0.15)]  # radius, half of the segment
    bodies = "".join(
        f'<body><freejoint/><geom type="{"capsule" if half else "sphere"}" size="{radius} {half}"/></body>'
        for radius, half in sizes
    )
    model = mujoco.MjModel.from_xml_string(f"<mujoco><worldbody>{bodies}</worldbody></mujoco>")
    data = mujoco.MjData(model)
    meshes = [pgccd.Mesh.capsule(r, 2 * h) if h else pgccd.Mesh.sphere(r) for r, h in sizes]
    scene, pairs = pgccd.Scene(meshes), torch.combinations(torch.arange(len(sizes)))
    compared = touching = 0
    for _ in range(200):
        place, turn = rng.uniform(-0.6, 0.6, (len(sizes), 3)), unit_quaternions(rng, len(sizes))
        data.qpos[:] = np.concatenate([place, turn], axis=1).ravel()
        mujoco.mj_kinematics(model, data)
        still = pgccd.RigidMotion.at_rest(torch.tensor(place), torch.tensor(turn))
        found = pgccd.distance(scene, still, pairs=pairs)
        hits = {tuple(pair) for pair in pgccd.detect(scene, still).pairs.tolist()}
        for (i, j), lower, upper in zip(pairs.tolist(), found.lower.tolist(), found.upper.tolist(), strict=True):
            expected = mujoco.mj_geomDistance(model, data, i, j, 10.0, None)
            assert lower - 1e-9 <= max(expected, 0.0) <= upper + 1e-9
            assert upper - lower < 1e-6
            if abs(expected) > 1e-6:
                assert ((i, j) in hits) == (expected < 0.0)
                touching += expected < 0.0
            compared += 1
    assert compared == 1200 and touching > 100
