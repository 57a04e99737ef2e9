"""Poses of links, compared with matrices and with MuJoCo."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
import torch
from oracle.arms import Arm, Part
from support.arms import UPRIGHT, beams, loaded, pose_error, random_arm

import pgccd
from pgccd.robots.kinematics import quaternion_of

HINGE = """<robot name="hinge"><link name="base"/><link name="arm"><collision><origin xyz=".5 0 0"/>
<geometry><box size="1 .1 .1"/></geometry></collision></link><joint name="turn" type="continuous"><parent link="base"/>
<child link="arm"/><axis xyz="0 0 1"/></joint></robot>"""


def matrices(orientation: torch.Tensor) -> np.ndarray:
    w, x, y, z = orientation.numpy().reshape(-1, 4).T
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.moveaxis(np.array(rows), 2, 0).reshape(*orientation.shape[:-1], 3, 3)


@pytest.mark.parametrize("seed", range(12))
def test_poses_are_products_of_matrices(seed: int, tmp_path: Path) -> None:
    rng = np.random.default_rng(seed)
    arm = random_arm(rng, 8)
    robot = loaded(arm, tmp_path)
    assert robot.joint_names == [f"joint{k}" for k in arm.coordinates]
    q = rng.uniform(-3.0, 3.0, (5, 7, robot.joint_count))
    position, orientation = robot.poses(torch.tensor(q))
    parts = [int(robot.link_names[link].removeprefix("link")) for link in robot.body_link.tolist()]
    expected = arm.frames(q.reshape(-1, robot.joint_count))[:, parts].reshape(5, 7, len(parts), 4, 4)
    assert np.allclose(position.numpy(), expected[..., :3, 3], atol=1e-13)
    assert np.allclose(matrices(orientation), expected[..., :3, :3], atol=1e-13)
    assert robot.reach >= np.linalg.norm(position.numpy(), axis=-1).max() - 0.4


def test_a_base_may_stand_anywhere(tmp_path: Path) -> None:
    robot = loaded(beams(), tmp_path)
    turned = (0.5**0.5, 0.0, 0.0, 0.5**0.5)
    other = pgccd.robots.load_urdf(tmp_path / "arm.urdf", base_position=(1.0, 2.0, 3.0), base_orientation=turned)
    q = torch.rand(3, 4, dtype=torch.float64)
    x, y = robot.poses(q)[0], other.poses(q)[0]
    expected = torch.stack([1.0 - x[..., 1], 2.0 + x[..., 0], 3.0 + x[..., 2]], dim=-1)
    assert torch.allclose(y, expected, atol=1e-14)


def test_quaternions_of_matrices() -> None:
    rng = np.random.default_rng(0)
    q = rng.normal(size=(200, 4)) * 10.0 ** rng.uniform(-8, 0, (200, 4))
    q /= np.linalg.norm(q, axis=1, keepdims=True)
    for each, matrix in zip(q, matrices(torch.tensor(q)), strict=True):
        found = quaternion_of(matrix)
        assert min(np.abs(found - each).max(), np.abs(found + each).max()) < 1e-14


MJCF = """<mujoco model="two"><compiler angle="radian"/><worldbody>
<body name="a" pos="0.1 0 1" quat="0.8 0.6 0 0">
 <joint name="turn" type="hinge" axis="0 0 1" pos="0.1 0.2 0" ref="0.3"/>
 <joint name="tilt" type="hinge" axis="1 1 0" pos="0 0.1 0.05" range="-1 1"/>
 <geom type="box" size="0.1 0.2 0.3" pos="0.1 0 0.2"/>
 <body name="b" pos="0.5 0 0" quat="0.5 0.5 0.5 0.5"><joint name="slide" type="slide" axis="0 1 1"/>
  <geom type="box" size="0.1 0.1 0.1" pos="0 0.3 0" quat="0.8 0 0.6 0"/>
  <body name="c" pos="0 0.2 0.3"><geom type="box" size="0.05 0.05 0.1"/>
   <body name="d" pos="0 0 0.3"><joint type="hinge" axis="0 1 0" pos="0.3 0 0"/>
    <geom type="box" size="0.02 0.2 0.1"/></body>
  </body></body></body></worldbody></mujoco>"""


def test_poses_are_those_of_mujoco(tmp_path: Path) -> None:
    mujoco = pytest.importorskip("mujoco")
    (tmp_path / "two.xml").write_text(MJCF)
    robot = pgccd.robots.load_mjcf(tmp_path / "two.xml")
    assert robot.name == "two" and robot.joint_names == ["turn", "tilt", "slide", "d.0"]
    assert robot.lower.tolist() == [-np.inf, -1.0, -np.inf, -np.inf]
    model = mujoco.MjModel.from_xml_path(str(tmp_path / "two.xml"))
    data, rng = mujoco.MjData(model), np.random.default_rng(0)
    for _ in range(20):
        q = rng.uniform(-2.0, 2.0, 4)
        data.qpos[:] = q
        mujoco.mj_kinematics(model, data)
        position, orientation = robot.poses(torch.tensor(q))
        for k, mesh in enumerate(robot.meshes):
            corners = mesh.vertices.numpy() @ matrices(orientation)[k].T + position[k].numpy()
            signs = np.array(np.meshgrid([-1, 1], [-1, 1], [-1, 1], indexing="ij")).reshape(3, -1).T
            expected = signs * model.geom_size[k] @ data.geom_xmat[k].reshape(3, 3).T + data.geom_xpos[k]
            assert np.allclose(np.sort(corners, axis=0), np.sort(expected, axis=0), atol=1e-12)
    # Origins are at the joints: "d" turns about its own.
    still, turned = (robot.poses(torch.tensor([0.0, 0.0, 0.0, angle]))[0][3] for angle in (0.0, 2.0))
    assert torch.equal(still, turned)


def test_bits_do_not_depend_on_the_device(tmp_path: Path, device: torch.device) -> None:
    robot = loaded(random_arm(np.random.default_rng(1), 7), tmp_path)
    q = torch.rand(50, robot.joint_count, dtype=torch.float64)
    for a, b in zip(robot.poses(q), robot.poses(q.to(device)), strict=True):
        assert torch.equal(a, b.cpu())


def test_what_configurations_cannot_be(tmp_path: Path) -> None:
    robot = loaded(Arm([Part("revolute", UPRIGHT, UPRIGHT, (0, 0, 1), radius=0.1)]), tmp_path)
    with pytest.raises(ValueError, match=r"^q: expected shape \(..., 1\), got \(2,\)"):
        robot.poses(torch.zeros(2))
    with pytest.raises(TypeError, match="^q: expected float32 or float64"):
        robot.poses(torch.zeros(1, dtype=torch.int64))


def test_gradients_of_poses(tmp_path: Path) -> None:
    """Those of differences, through contacts of a trajectory too; the bits do not depend on them."""
    rng = np.random.default_rng(2)
    robot = loaded(random_arm(rng, 6), tmp_path)
    q = torch.tensor(rng.uniform(-1.0, 1.0, (2, robot.joint_count)), requires_grad=True)
    assert torch.autograd.gradcheck(robot.poses, (q,), eps=1e-6, atol=1e-7)
    for found, expected in zip(robot.poses(q), robot.poses(q.detach()), strict=True):
        assert found.requires_grad and torch.equal(found, expected) and not expected.requires_grad
    with pytest.raises(NotImplementedError, match="^orientation: has first derivatives only"):
        torch.autograd.grad(robot.poses(q)[1].sum(), q, create_graph=True)

    robot = loaded(beams(2), tmp_path)
    wall = pgccd.robots.Obstacles([pgccd.Mesh.box([0.2, 2.0, 2.0])], torch.tensor([[0.85, 0.0, 0.1]]))
    scene = robot.scene(wall)

    def toi(q: torch.Tensor) -> torch.Tensor:
        x, r = robot.poses(q)
        still = torch.tensor([[0.85, 0.0, 0.1]], dtype=torch.float64).expand(2, 1, 3)
        upright = torch.tensor([[1.0, 0.0, 0.0, 0.0]], dtype=torch.float64).expand(2, 1, 4)
        path = pgccd.Trajectory(torch.cat([x, still], 1), torch.cat([r, upright], 1))
        return pgccd.detect(scene, path, tolerance=1e-12).first_toi()

    q = torch.tensor([[0.9, 0.8], [0.1, 0.2]], dtype=torch.float64, requires_grad=True)
    assert 0.0 < float(toi(q.detach())) < 1.0
    assert torch.autograd.gradcheck(toi, (q,), eps=1e-6, atol=1e-6)


@pytest.mark.parametrize("seed", range(5))
def test_few_configurations_have_the_poses_of_many(seed: int, tmp_path: Path) -> None:
    """Few are computed in NumPy, many in torch: to the bit the same."""
    rng = np.random.default_rng(seed)
    robot = loaded(random_arm(rng, 6), tmp_path)
    q = torch.tensor(rng.uniform(-3.0, 3.0, (100, robot.joint_count)))
    for many, few in zip(robot.poses(q), robot.poses(q[:7]), strict=True):
        assert torch.equal(many[:7], few)


def test_long_turns_are_split_into_equal_parts(tmp_path: Path) -> None:
    """A hinge that turns by 3.9 rad between two waypoints goes the long way round, through a post at 2 rad."""
    (tmp_path / "hinge.urdf").write_text(HINGE)
    robot = pgccd.robots.load_urdf(tmp_path / "hinge.urdf")
    at = torch.tensor([[0.8 * math.cos(2.0), 0.8 * math.sin(2.0), 0.0]], dtype=torch.float64)
    post = pgccd.robots.Obstacles([pgccd.Mesh.box([0.05, 0.05, 1.0])], at)
    q = torch.tensor([[0.0], [3.9], [3.9]], dtype=torch.float64)
    path = robot.trajectory(q, post)
    assert path.segment_count == 8
    hits = pgccd.detect(robot.scene(post), path)
    certified = robot.certify(q[None], post)
    assert len(hits) and 0.5 * 1.8 / 3.9 < float(hits.time.min()) <= 0.5 * 2.0 / 3.9
    assert abs(float(hits.time.min()) - float(certified.time[0])) < 0.02
    with pytest.raises(ValueError, match="^q: segment 0: expected turns of at most 10000 rad"):
        robot.trajectory(torch.tensor([[0.0], [10_001.0]]))
    is_valid = robot.motion_validator(post)
    assert is_valid.last_valid([0.0], [1.0]) == 1.0 and is_valid([0.0], [1.0])
    assert is_valid.last_valid([2.0], [1.0]) == 0.0
    assert 1.8 / 3.9 < is_valid.last_valid([0.0], [3.9]) <= 2.0 / 3.9 and not is_valid([0.0], [3.9])
    # Between waypoints, near zero too, configurations are rounded as the waypoints are.
    margin = robot.trajectory(torch.tensor([[-4000.0], [4000.0]])).margin
    rounding = pose_error(robot, np.array([[4000.0]]))
    assert margin is not None and (margin.numpy() >= rounding).all()
