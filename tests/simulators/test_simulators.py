"""Scenes and frames of other simulators: poses, shapes and filters are theirs; what they tunnel through is found."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from oracle.boxes import axes_of
from support.rollouts import Rollout, rows_of
from support.shapes import unit_quaternions

import pgccd
from pgccd.cli import main

MODEL = """
<mujoco><option timestep="0.004"/><worldbody>
  <geom name="floor" type="plane" size="0 0 0.1"/>
  <geom name="unseen" type="sphere" size="1" contype="0" conaffinity="0"/>
  <body name="plate" pos="0 0 0.3"><geom name="plate" type="box" size="0.4 0.4 0.002"/></body>
  {}
</worldbody>{}</mujoco>
"""


def thickness_of(scene: pgccd.Scene) -> list[float]:
    """Of each body's mesh."""
    assert scene.margin is None
    return [scene.meshes.meshes[k].thickness for k in scene.mesh_index.tolist()]


def darts(rng: np.random.Generator, count: int) -> str:
    places = [(*rng.uniform(-0.25, 0.25, 2), 0.6 + 0.35 * k) for k in range(count)]
    body = '<body name="dart{}" pos="{:.6f} {:.6f} {:.6f}"><freejoint/><geom type="box" size="0.04 0.03 0.002"/></body>'
    return "\n".join(body.format(k, *place) for k, place in enumerate(places))


def mujoco_frames(
    mujoco: Any, simulator: pgccd.simulators.MuJoCo, model: Any, data: Any, steps: int
) -> Iterator[tuple[torch.Tensor, torch.Tensor]]:
    yield simulator.frame(data)
    for _ in range(steps):
        mujoco.mj_step(model, data)
        yield simulator.frame(data)


def test_mujoco_tunnels_and_the_audit_finds_all_of_it() -> None:
    mujoco = pytest.importorskip("mujoco")
    rng = np.random.default_rng(0)
    model = mujoco.MjModel.from_xml_string(MODEL.format(darts(rng, 8), ""))
    data = mujoco.MjData(model)
    for k in range(8):
        first = model.jnt_dofadr[model.body(f"dart{k}").jntadr[0]]
        data.qvel[first : first + 6] = [0, 0, -rng.uniform(10, 60), *rng.normal(0, 30, 3)]
    simulator = pgccd.simulators.MuJoCo(model)
    frames = list(mujoco_frames(mujoco, simulator, model, data, 100))
    found = pgccd.audit(simulator.scene, frames)
    position, orientation = (torch.stack(column).numpy() for column in zip(*frames, strict=True))
    boxes = np.flatnonzero(model.geom_type[simulator.geoms] == mujoco.mjtGeom.mjGEOM_BOX)
    rollout = Rollout(model.geom_size[simulator.geoms[boxes]], position[:, boxes], orientation[:, boxes])
    deep, any_at_all = ({(s, boxes[i], boxes[j]) for s, i, j in rows} for rows in rollout.overlapping_between(1e-3))
    rows = {row for row in rows_of(found.passages) if simulator.names[row[1]] != "floor"}
    assert len(deep) > 3 and deep <= rows <= any_at_all
    assert any(simulator.names[i] == "plate" for _, i, _ in rows)
    assert len(found.passages) > len(rows)  # through the plane


WALLS_AND_BARS = """
<mujoco><option timestep="0.01" gravity="0 0 0"/><worldbody>
  <geom name="wall0" type="box" size="0.5 0.5 0.001" pos="0 0 0"/>
  <geom name="wall1" type="box" size="0.5 0.5 0.002" pos="0 0 0.3" quat="0.96 0.28 0 0"/>
  <geom name="wall2" type="box" size="0.5 0.5 0.0005" pos="0 0.1 0.6" quat="0.96 0 -0.28 0"/>
  <geom name="post" type="box" size="0.01 0.01 0.1" pos="2.4 0.2 0"/>
  <geom name="far" type="box" size="0.01 0.01 0.1" pos="2.8 0.2 0"/>
  <body name="bar" pos="2 0 0"><joint type="hinge" axis="0 0 1"/>
    <geom name="bar" type="box" size="0.6 0.01 0.02" mass="100"/></body>
  <body name="dart" pos="0.05 0.02 1.2"><freejoint/><geom name="dart" type="box" size="0.04 0.03 0.01"/></body>
</worldbody></mujoco>"""


def test_walls_and_spinning_bars_of_mujoco() -> None:
    """A dart goes through three walls in one step; a bar sweeps over a post within its reach, not over one beyond."""
    mujoco = pytest.importorskip("mujoco")
    model = mujoco.MjModel.from_xml_string(WALLS_AND_BARS)
    data = mujoco.MjData(model)
    dart, bar = (int(model.jnt_dofadr[model.body(name).jntadr[0]]) for name in ("dart", "bar"))
    data.qvel[dart : dart + 3], data.qvel[bar] = [0.0, 0.0, -200.0], 150.0
    simulator = pgccd.simulators.MuJoCo(model)
    frames = list(mujoco_frames(mujoco, simulator, model, data, 1))
    found = pgccd.audit(simulator.scene, frames)
    assert len(found.touching) == len(found.enclosed) == 0
    passed = {tuple(simulator.names[k] for k in pair) for pair in found.passages.pairs.tolist()}
    assert {tuple(sorted(pair)) for pair in passed} == {
        ("dart", "wall0"),
        ("dart", "wall1"),
        ("dart", "wall2"),
        ("bar", "post"),
    }
    position, orientation = (torch.stack(column).numpy() for column in zip(*frames, strict=True))
    deep, any_at_all = Rollout(model.geom_size[simulator.geoms], position, orientation).overlapping_between(1e-4, 4000)
    assert deep == rows_of(found.passages) == any_at_all


def test_poses_of_mujoco_are_those_after_the_step() -> None:
    mujoco = pytest.importorskip("mujoco")
    capsule = '<geom type="capsule" size="0.1 0.2" pos="0.3 0 0.1" quat="0.5 0.5 -0.5 0.5"/>'
    turned = f'<body pos="1 2 3"><freejoint/>{capsule}</body>'
    model = mujoco.MjModel.from_xml_string(MODEL.format(turned, ""))
    data = mujoco.MjData(model)
    data.qvel[:] = [1.0, 2.0, 3.0, 4.0, 5.0, 6.0]
    simulator = pgccd.simulators.MuJoCo(model)
    assert len(simulator.geoms) == simulator.scene.body_count == len(simulator.names) == 3
    assert thickness_of(simulator.scene) == [0.0, 0.0, 0.1]
    assert simulator.scene.static is not None and simulator.scene.static.tolist() == [1, 1, 0]
    mujoco.mj_step(model, data)
    before = data.geom_xpos.copy()
    position, orientation = simulator.frame(data)
    assert np.abs(before - data.geom_xpos).max() > 1e-3
    mujoco.mj_forward(model, data)
    np.testing.assert_allclose(position.numpy(), data.geom_xpos[simulator.geoms], atol=1e-15)
    matrices = axes_of(orientation.numpy()).transpose(0, 2, 1)
    np.testing.assert_allclose(matrices.reshape(-1, 9), data.geom_xmat[simulator.geoms], atol=1e-14)


@pytest.mark.parametrize("with_pairs", [False, True])
@pytest.mark.parametrize("option", ["", '<option><flag filterparent="disable"/></option>'])
def test_filters_are_those_of_mujoco(option: str, with_pairs: bool) -> None:
    mujoco = pytest.importorskip("mujoco")
    hinge = '<joint type="hinge" axis="0 0 1"/>'
    cube = '<geom name="{}" type="box" size="0.5 0.5 0.5" {}/>'
    parts = f"""
    <body name="a" pos="0 0 2"><freejoint/>{cube.format("a", "")}{cube.format("a2", "")}
      <body name="b" pos="0.1 0 0">{hinge}{cube.format("b", "")}
        <body name="rigid" pos="0 0.1 0">{cube.format("rigid", "")}</body>
        <body name="c" pos="0 0 0.1">{hinge}{cube.format("c", "")}</body></body></body>
    <body name="d" pos="0.05 0 2"><freejoint/>{cube.format("d", 'contype="2" conaffinity="4"')}</body>
    <body name="e" pos="0 0.05 2"><freejoint/>{cube.format("e", 'contype="4" conaffinity="1"')}</body>
    <body name="f" pos="0 0.03 2" mocap="true">{cube.format("f", "")}</body>
    <body name="g" pos="0 0.03 2.1">{cube.format("g", "")}</body>"""
    parts += (
        '<body name="h" pos="0.02 0.03 2"><freejoint/><geom name="h" size="0.5" contype="0" conaffinity="0"/></body>'
    )
    pairs = '<pair geom1="h" geom2="c"/><pair geom1="c" geom2="a"/><pair geom1="d" geom2="e"/>' if with_pairs else ""
    text = MODEL.format(parts, f'<contact><exclude body1="c" body2="a"/>{pairs}</contact>{option}')
    model = mujoco.MjModel.from_xml_string(text)
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    theirs = {tuple(sorted(pair)) for pair in data.contact.geom[: data.ncon].tolist()}
    simulator = pgccd.simulators.MuJoCo(model)
    colliding = pgccd.collide(simulator.scene, pgccd.RigidMotion.at_rest(*simulator.frame(data))).pairs
    ours = {tuple(simulator.geoms[pair].tolist()) for pair in colliding.numpy()}
    assert ours == theirs and len(ours) > 5


def check_saved(
    path: Path, simulator: Any, frames: list[tuple[torch.Tensor, torch.Tensor]], capsys: pytest.CaptureFixture[str]
) -> None:
    """A run that is saved as it is made gives the same audit, with names, from its files."""
    assert simulator.save(path, iter(frames)) == path
    scene, rollout = pgccd.files.load_scene(path)
    found, expected = pgccd.audit(scene, rollout), pgccd.audit(simulator.scene, frames)
    assert found.passages == expected.passages and found.enclosed == expected.enclosed
    assert found.touching.pairs.tolist() == expected.touching.pairs.tolist()
    assert pgccd.files.load_names(path) == simulator.names
    capsys.readouterr()  # what simulators print
    assert main(["audit", "--scene", str(path), "--json"]) == 0
    rows = json.loads(capsys.readouterr().out)["passages"]
    pairs = expected.passages.pairs.tolist()
    assert len(rows) > 0 and [row["names"] for row in rows] == [[simulator.names[k] for k in pair] for pair in pairs]


def test_saved_runs_of_mujoco(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    mujoco = pytest.importorskip("mujoco")
    model = mujoco.MjModel.from_xml_string(WALLS_AND_BARS)
    data = mujoco.MjData(model)
    dart, bar = (int(model.jnt_dofadr[model.body(name).jntadr[0]]) for name in ("dart", "bar"))
    data.qvel[dart : dart + 3], data.qvel[bar] = [0.0, 0.0, -200.0], 150.0
    simulator = pgccd.simulators.MuJoCo(model)
    check_saved(tmp_path / "run.json", simulator, list(mujoco_frames(mujoco, simulator, model, data, 3)), capsys)
    again, scene = pgccd.files.load_scene(tmp_path / "run.json")[0], simulator.scene
    for name in ("group", "mask", "static"):
        assert torch.equal(getattr(again, name), getattr(scene, name)), name
    assert [mesh.solid for mesh in again.meshes.meshes] == [mesh.solid for mesh in scene.meshes.meshes] != [False] * 7
    with pytest.raises(ValueError, match="^motion: expected at least two frames, got 1"):
        simulator.save(tmp_path / "run.json", [simulator.frame(data)])


def test_errors_of_mujoco() -> None:
    mujoco = pytest.importorskip("mujoco")
    empty = mujoco.MjModel.from_xml_string("<mujoco><worldbody/></mujoco>")
    with pytest.raises(ValueError, match="model: it has no collision shapes"):
        pgccd.simulators.MuJoCo(empty)


@pytest.mark.slow  # Warp compiles kernels
def test_newton(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    newton, warp = pytest.importorskip("newton"), pytest.importorskip("warp")
    warp.config.quiet = True
    rng = np.random.default_rng(1)
    builder = newton.ModelBuilder()
    half = [0.05, 0.04, 0.01]
    builder.add_shape_box(-1, hx=1.0, hy=1.0, hz=0.002, xform=warp.transform((0, 0, 0.5), warp.quat_identity()))
    for k, q in enumerate(unit_quaternions(rng, 5)):
        body = builder.add_body(
            xform=warp.transform((0.3 * k - 0.75, 0.0, 1.5), warp.quat(*q[1:].tolist(), float(q[0])))
        )
        offset = warp.transform((0.1, 0.0, 0.0), warp.quat_identity())
        builder.add_shape_box(body, hx=half[0], hy=half[1], hz=half[2], xform=offset)
    builder.add_shape_sphere(body, radius=0.07, xform=offset)
    builder.add_ground_plane()
    model = builder.finalize(device="cpu")
    simulator, state = pgccd.simulators.Newton(model), model.state()
    scene = simulator.scene
    assert scene.body_count == 8 and scene.exclude is not None and scene.exclude.tolist() == [[5, 6]]
    assert scene.static is not None and scene.static.tolist() == [1, 0, 0, 0, 0, 0, 0, 1]
    assert thickness_of(scene) == pytest.approx([0.0] * 6 + [0.07, 0.0])

    def frames() -> Iterator[tuple[torch.Tensor, torch.Tensor]]:
        poses = state.body_q.numpy()
        for _ in range(6):
            yield simulator.frame(state)
            poses[:, 2] -= 0.4  # 1.5, 1.1, 0.7, 0.3, ...: through the plate, then into the ground
            state.body_q.assign(poses)

    found = pgccd.audit(scene, frames())
    # Centres of boxes and of the sphere are at the offset, which turns with the body.
    assert {row for row in rows_of(found.passages) if row[1] == 0} == {(2, 0, k) for k in range(1, 7)}
    worst = found.passages[found.passages.segment == 2]
    q = torch.tensor(model.state().body_q.numpy()[:, 3:]).double()
    axes = axes_of(q[:, [3, 0, 1, 2]].numpy())  # rows: the body's axes in the world
    bottom = [1.5 - 0.8 + 0.1 * a[0, 2] - float(np.abs(a[:, 2]) @ half) for a in axes]
    bottom.append(1.5 - 0.8 + 0.1 * axes[4][0, 2] - 0.07)
    expected = [(z - 0.502) / 0.4 for z in bottom]
    np.testing.assert_allclose(worst.toi[worst.pairs[:, 0] == 0].numpy(), expected, atol=1e-4)
    state = model.state()
    check_saved(tmp_path / "run.json", simulator, [tuple(c.clone() for c in frame) for frame in frames()], capsys)  # type: ignore[misc]
    position, _ = simulator.frame(model.state())
    assert position.dtype == torch.float32 and position[-1].tolist() == [0.0, 0.0, 0.0]


def test_worlds_of_newton() -> None:
    newton, warp = pytest.importorskip("newton"), pytest.importorskip("warp")
    warp.config.quiet = True
    one = newton.ModelBuilder()
    one.add_shape_sphere(one.add_body(), radius=0.5)
    many = newton.ModelBuilder()
    many.add_ground_plane()
    for _ in range(3):
        many.add_world(one)
    simulator = pgccd.simulators.Newton(many.finalize(device="cpu"))
    assert simulator.scene.world is not None and simulator.scene.world.tolist() == [0, 0, 1, 1, 2, 2]
    assert simulator.shapes.tolist() == [0, 1, 0, 2, 0, 3]


@pytest.fixture
def client() -> Iterator[tuple[Any, int]]:
    bullet = pytest.importorskip("pybullet")
    number = bullet.connect(bullet.DIRECT)
    yield bullet, number
    bullet.disconnect(number)


def test_pybullet_tunnels_and_the_audit_finds_it(
    client: tuple[Any, int], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    bullet, number = client
    half = np.array([[1.0, 1.0, 0.002]] + [[0.05, 0.04, 0.002]] * 4)
    for k, h in enumerate(half):
        shape = bullet.createCollisionShape(bullet.GEOM_BOX, halfExtents=h.tolist())
        body = bullet.createMultiBody(
            min(k, 1), shape, basePosition=[0.3 * k - 0.6, 0.0, 0.5 + 0.6 * min(k, 1) + 0.13 * k]
        )
        if k:
            bullet.resetBaseVelocity(body, [0.0, 0.0, -60.0], [1.0, 2.0, 3.0])
    simulator = pgccd.simulators.PyBullet(number)
    assert simulator.links == [(k, -1) for k in range(5)]
    frames = []
    for _ in range(30):
        frames.append(simulator.frame())
        bullet.stepSimulation()
    found = pgccd.audit(simulator.scene, frames)
    position, orientation = (torch.stack(column).numpy() for column in zip(*frames, strict=True))
    deep, any_at_all = Rollout(half, position, orientation).overlapping_between(1e-3)
    assert len(deep) > 1 and deep <= rows_of(found.passages) <= any_at_all
    check_saved(tmp_path / "run.json", simulator, frames, capsys)


def slack_of_boxes(bullet: Any, simulator: pgccd.simulators.PyBullet) -> np.ndarray:
    """(N, 2, 3): how far PyBullet's bounding boxes reach beyond the surfaces, below and above."""
    scene, slack = simulator.scene, []
    margin = thickness_of(scene)
    for body, (position, orientation) in enumerate(zip(*simulator.frame(), strict=True)):
        mesh, thick = scene.meshes.meshes[int(scene.mesh_index[body])], float(margin[body])
        points = mesh.vertices.numpy() @ axes_of(orientation.numpy()[None])[0] + position.numpy()
        lower, upper = bullet.getAABB(*simulator.links[body])
        slack.append([points.min(axis=0) - thick - lower, upper - points.max(axis=0) - thick])
    return np.array(slack)


def test_shapes_of_pybullet_are_where_its_boxes_say(client: tuple[Any, int]) -> None:
    bullet, number = client
    at = {"collisionFramePosition": [0.3, 0.1, 0.0], "collisionFrameOrientation": [0.5, 0.5, -0.5, 0.5]}
    shapes = [
        bullet.createCollisionShape(bullet.GEOM_BOX, halfExtents=[0.1, 0.2, 0.3], **at),
        bullet.createCollisionShape(bullet.GEOM_SPHERE, radius=0.2, **at),
        bullet.createCollisionShape(bullet.GEOM_CAPSULE, radius=0.1, height=0.6, **at),
        bullet.createCollisionShape(bullet.GEOM_CYLINDER, radius=0.1, height=0.6, **at),
    ]
    q = unit_quaternions(np.random.default_rng(2), len(shapes))[:, [1, 2, 3, 0]]
    for k, shape in enumerate(shapes):
        inertial = {"baseInertialFramePosition": [0.5, 0.0, 0.2], "baseInertialFrameOrientation": [0.0, 0.6, 0.0, 0.8]}
        bullet.createMultiBody(1.0, shape, basePosition=[k, 0, 1], baseOrientation=q[k].tolist(), **inertial)
    slack = slack_of_boxes(bullet, pgccd.simulators.PyBullet(number))
    # Its boxes are those of boxes about the shapes, so too large; but their centres are those of the shapes.
    np.testing.assert_allclose(slack[:, 0], slack[:, 1], atol=1e-6)
    assert slack.min() > -1e-6 and slack.max() < 0.2


def test_hulls_of_pybullet(client: tuple[Any, int]) -> None:
    bullet, number = client
    pytest.importorskip("scipy")
    corners = [[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [0.2, 0.2, 0.2]]
    shape = bullet.createCollisionShape(
        bullet.GEOM_MESH, vertices=corners, meshScale=[2.0, 1.0, 1.0], collisionFramePosition=[0.3, 0.1, 0.0]
    )
    bullet.createMultiBody(1.0, shape, basePosition=[1, 2, 3])
    simulator = pgccd.simulators.PyBullet(number)
    slack = slack_of_boxes(bullet, simulator)
    assert slack.min() > -1e-6 and slack.max() < 0.05
    assert len(simulator.scene.meshes.meshes[0].faces) == 4
    assert thickness_of(simulator.scene) == [1e-3]
    # Bodies inside of it are found: the hull is closed.
    peg = bullet.createCollisionShape(bullet.GEOM_BOX, halfExtents=[0.01, 0.01, 0.01])
    bullet.createMultiBody(1.0, peg, basePosition=[1.6, 2.3, 3.2])
    simulator = pgccd.simulators.PyBullet(number)
    inside = pgccd.enclosed(simulator.scene, pgccd.RigidMotion.at_rest(*simulator.frame()))
    assert inside.tolist() == [[1, 0]]


@pytest.mark.parametrize(("unit", "metres"), [(None, 1.0), (0.01, 0.01), (0.0254, 0.0254)])
def test_collada_files_of_pybullet(client: tuple[Any, int], tmp_path: Path, unit: float | None, metres: float) -> None:
    """As PyBullet reads them: in metres, and the axis that is up stays as it is."""
    bullet, number = client
    trimesh = pytest.importorskip("trimesh")
    pytest.importorskip("collada")
    dae = trimesh.creation.box((1.0, 2.0, 3.0)).export(file_type="dae").decode()
    asset = "<up_axis>Y_UP</up_axis>" + (f'<unit name="one" meter="{unit}"/>' if unit else "")
    dae = re.sub("(?s)<asset>.*</asset>", f"<asset>{asset}</asset>", dae)
    (tmp_path / "box.dae").write_text(dae)
    mesh = '<collision><geometry><mesh filename="box.dae" scale="1 1 2"/></geometry></collision>'
    (tmp_path / "box.urdf").write_text(f'<robot name="r"><link name="a">{mesh}</link></robot>')
    bullet.loadURDF(str(tmp_path / "box.urdf"), useFixedBase=True, physicsClientId=number)
    simulator = pgccd.simulators.PyBullet(number)
    wide = np.ptp(simulator.scene.meshes.meshes[0].vertices.numpy(), axis=0)
    np.testing.assert_allclose(wide, metres * np.array([1.0, 2.0, 6.0]), rtol=1e-6)
    slack = slack_of_boxes(bullet, simulator)
    assert slack.min() > -1e-6 and slack.max() < 0.002


def test_links_and_errors_of_pybullet(client: tuple[Any, int]) -> None:
    bullet, number = client
    with pytest.raises(ValueError, match="model: it has no collision shapes"):
        pgccd.simulators.PyBullet(number)
    box = bullet.createCollisionShape(bullet.GEOM_BOX, halfExtents=[0.1, 0.1, 0.1])
    link: dict[str, list[Any]] = {
        "linkMasses": [1.0],
        "linkCollisionShapeIndices": [box],
        "linkVisualShapeIndices": [-1],
    }
    link |= {"linkPositions": [[0.5, 0.0, 0.0]], "linkOrientations": [[0, 0, 0, 1]], "linkParentIndices": [0]}
    link |= {"linkInertialFramePositions": [[0, 0, 0]], "linkInertialFrameOrientations": [[0, 0, 0, 1]]}
    link |= {"linkJointTypes": [bullet.JOINT_REVOLUTE], "linkJointAxis": [[0, 0, 1]]}
    body = bullet.createMultiBody(0.0, box, basePosition=[0, 0, 1], **link)
    simulator = pgccd.simulators.PyBullet(number)
    assert simulator.links == [(body, -1), (body, 0)]
    assert simulator.scene.exclude is not None and simulator.scene.exclude.tolist() == [[0, 1]]
    assert simulator.scene.static is not None and simulator.scene.static.tolist() == [0, 0]
    bullet.resetJointState(body, 0, np.pi / 2)
    position, orientation = simulator.frame()
    np.testing.assert_allclose(position.numpy(), [[0, 0, 1], [0.5, 0.0, 1.0]], atol=1e-7)
    np.testing.assert_allclose(np.abs(orientation[1].numpy()), [0.5**0.5, 0, 0, 0.5**0.5], atol=1e-7)
    triangles = bullet.createCollisionShape(
        bullet.GEOM_MESH, vertices=[[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]], indices=[0, 1, 2, 0, 1, 3]
    )
    bullet.createMultiBody(0.0, triangles)
    with pytest.raises(ValueError, match="body 1, .*: expected a box, sphere"):
        pgccd.simulators.PyBullet(number)
    bullet.removeBody(1)
    bullet.createMultiBody(0.0, -1, basePosition=[1, 2, 3])  # no shape at all
    assert pgccd.simulators.PyBullet(number).links == [(body, -1), (body, 0)]
    field = bullet.createCollisionShape(
        bullet.GEOM_HEIGHTFIELD, heightfieldData=[0.0] * 4, numHeightfieldRows=2, numHeightfieldColumns=2
    )
    bullet.createMultiBody(0.0, field)
    with pytest.raises(ValueError, match="body 2, .*: expected a shape that PyBullet returns, .* height field"):
        pgccd.simulators.PyBullet(number)


def test_bodies_beside_planes_are_errors(client: tuple[Any, int]) -> None:
    """Squares in place of infinite planes are wide enough for the scene, and a body that leaves one is named."""
    mujoco, (bullet, number) = pytest.importorskip("mujoco"), client
    ball = '<body name="ball" pos="{} 0 0"><freejoint/><geom name="ball" size="1"/></body>'
    for at, half in ((0.0, 1e4), (5e4, 4.0 * (5e4 + 1.0))):
        model = mujoco.MjModel.from_xml_string(MODEL.replace("0 0 0.1", "1 1 1", 1).format(ball.format(at), ""))
        simulator, data = pgccd.simulators.MuJoCo(model), mujoco.MjData(model)
        assert float(simulator.scene.meshes.meshes[0].vertices.abs().max()) == pytest.approx(half, rel=1e-8)
        data.qpos[:3] = 0.7 * half, 0.7 * half, -2.0 * half  # within the circle, and how far below does not matter
        simulator.frame(data)
        data.qpos[:3] = 0.0, half - 0.999, 0.0
        with pytest.raises(ValueError, match=r"position: expected bodies within .* plane 'floor', got 'ball' at"):
            simulator.frame(data)
    wall = bullet.createCollisionShape(bullet.GEOM_PLANE, planeNormal=[3.0, 4.0, 0.0])
    bullet.createMultiBody(0.0, wall, basePosition=[0.0, 0.0, 2.0], baseOrientation=[0.0, 0.0, 1.0, 0.0])
    body = bullet.createMultiBody(1.0, bullet.createCollisionShape(bullet.GEOM_SPHERE, radius=1.0))
    of_bullet = pgccd.simulators.PyBullet(number)
    bullet.resetBasePositionAndOrientation(body, [3e5, 4e5, 0.0], [0, 0, 0, 1])  # along the normal
    of_bullet.frame()
    for away in ([4e4, -3e4, 0.0], [0.0, 0.0, 1.1e4], [float("nan"), 0.0, 0.0]):
        bullet.resetBasePositionAndOrientation(body, away, [0, 0, 0, 1])
        with pytest.raises(ValueError, match="position: expected bodies within"):
            of_bullet.frame()


def test_planes_and_margins_of_newton() -> None:
    newton, warp = pytest.importorskip("newton"), pytest.importorskip("warp")
    warp.config.quiet = True
    builder = newton.ModelBuilder()
    cfg = newton.ModelBuilder.ShapeConfig(margin=0.25)
    builder.add_shape_plane(width=3.0, length=5.0, cfg=cfg)
    builder.add_shape_plane((1.0, 0.0, 0.0, -2.0), width=0.0, length=0.0)
    builder.add_shape_sphere(builder.add_body(), radius=0.5, cfg=cfg)
    mesh = newton.Mesh(np.eye(4, 3, dtype=np.float32), np.array([0, 1, 2, 1, 0, 3, 2, 1, 3, 0, 2, 3], dtype=np.int32))
    builder.add_shape_convex_hull(builder.add_body(), mesh=mesh, scale=(-1.0, 2.0, 3.0))
    model = builder.finalize(device="cpu")
    simulator, state = pgccd.simulators.Newton(model), model.state()
    scene = simulator.scene
    assert thickness_of(scene) == [0.25, 0.0, 0.75, 0.0]
    corners = [mesh.vertices + mesh.origin for mesh in scene.meshes.meshes]
    assert corners[0].abs().max(dim=0).values.tolist() == [1.5, 2.5, 0.0]
    np.testing.assert_allclose(corners[1][:, 0].numpy(), 2.0, atol=1e-2)
    assert corners[1][:, 1:].abs().max().item() == pytest.approx(1e4, rel=1e-3)
    # A mirrored mesh keeps its outside, so its volume its sign.
    volumes = []
    for vertices, faces in ((np.eye(4, 3), mesh.indices.reshape(-1, 3)), (corners[3], scene.meshes.meshes[3].faces)):
        a, b, c = np.asarray(vertices)[np.asarray(faces)].transpose(1, 0, 2)
        volumes.append((a * np.cross(b, c)).sum() / 6.0)
    assert volumes[1] == pytest.approx(6.0 * volumes[0], rel=1e-6)
    poses = state.body_q.numpy()
    poses[0, :3] = 0.0, 2e4, 0.0
    state.body_q.assign(poses)
    with pytest.raises(ValueError, match="position: expected bodies within"):
        simulator.frame(state)
    builder.add_shape_plane(width=3.0, length=0.0)
    with pytest.raises(ValueError, match=r"width and length or with neither, got \[3.0, 0.0\]"):
        pgccd.simulators.Newton(builder.finalize(device="cpu"))


def test_guarded_steps_of_mujoco_tunnel_nothing() -> None:
    """The function on the page about audits."""
    mujoco = pytest.importorskip("mujoco")
    text = (Path(__file__).resolve().parents[2] / "docs" / "how-to" / "audit.md").read_text()
    names: dict[str, Any] = {"mujoco": mujoco, "np": np, "pgccd": pgccd}
    exec(re.findall(r"```py\n(def guarded_step.*?)```", text, re.DOTALL)[0], names)
    found = []
    for guard in (False, True):
        rng = np.random.default_rng(0)
        margins = '<default><geom margin="0.005"/></default><worldbody>'
        model = mujoco.MjModel.from_xml_string(MODEL.replace("<worldbody>", margins).format(darts(rng, 4), ""))
        data = mujoco.MjData(model)
        for k in range(4):
            first = model.jnt_dofadr[model.body(f"dart{k}").jntadr[0]]
            data.qvel[first : first + 6] = [0, 0, -rng.uniform(10, 60), *rng.normal(0, 30, 3)]
        simulator, frames = pgccd.simulators.MuJoCo(model), []
        while data.time < 0.2:
            frames.append(simulator.frame(data))
            if guard:
                names["guarded_step"](model, data, simulator, 0.004)
            else:
                mujoco.mj_step(model, data)
        found.append(pgccd.audit(simulator.scene, frames))
    assert len(found[0].passages) > 2 and len(found[1].passages) == 0
    assert found[0].frames < found[1].frames < 4 * found[0].frames
