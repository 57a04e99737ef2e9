"""URDF, SRDF and MJCF files: shapes, exclusions, and what is refused."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from oracle.arms import Arm, Part
from support.arms import UPRIGHT, beams, loaded

import pgccd
from pgccd.robots import Obstacles, Robot, Verdict, shapes

UPRIGHT_TURN = torch.tensor([[1.0, 0, 0, 0]], dtype=torch.float64)


def mjcf(tmp_path: Path, body: str, more: str = "", assets: str = "") -> Robot:
    pytest.importorskip("mujoco")
    path = tmp_path / "robot.xml"
    text = f'<mujoco><compiler angle="radian"/><asset>{assets}</asset><worldbody>{body}</worldbody>{more}</mujoco>'
    path.write_text(text)
    return pgccd.robots.load_mjcf(path)


SLIDER = '<body name="s" pos="0 0 5"><joint name="fall" type="slide" axis="0 0 -1"/>{}</body>'


def fall(robot: Robot, obstacle: pgccd.Mesh, margin: float, at: tuple[float, ...] = (0.0, 0.0, 0.0)) -> float:
    """The part of a fall by 5 until a robot of one link meets an obstacle."""
    obstacles = Obstacles([obstacle], torch.tensor([at], dtype=torch.float64), margin=margin)
    scene, path = robot.scene(obstacles), robot.trajectory(torch.tensor([[0.0], [5.0]]), obstacles)
    return float(pgccd.detect(scene, path, tolerance=1e-12).toi[0])


POINT = shapes.sphere(1.0)
DOT = pgccd.Mesh(1e-12 * np.array([[1.0, 0, 0], [-1, 1, 0], [-1, -1, 0]]), [[0, 1, 2]])


def test_spheres_and_capsules_are_exact(tmp_path: Path) -> None:
    for across in (0.0, 0.1, 0.25):
        ball = mjcf(tmp_path, SLIDER.format('<geom type="sphere" size="0.2"/>'))
        assert ball.meshes[0].thickness == 0.2 and len(ball.meshes[0].faces) == 1
        expected = (5.0 - (0.3**2 - across**2) ** 0.5) / 5.0
        assert abs(fall(ball, DOT, 0.1, (across, 0, 0)) - expected) < 1e-9
        # Along x, its end at 0.5.
        capsule = mjcf(tmp_path, SLIDER.format('<geom type="capsule" size="0.2" fromto="-0.5 0 0 0.5 0 0"/>'))
        assert abs(fall(capsule, DOT, 0.1, (0.5 + across, 0, 0)) - expected) < 1e-9
        assert abs(fall(capsule, DOT, 0.1, (0.3, across, 0)) - expected) < 1e-9


def test_other_shapes_contain_what_they_stand_for(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    directions = rng.normal(size=(500, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    for kind, size, support in [
        ("cylinder", "0.2 0.3", lambda d: 0.2 * np.hypot(d[:, 0], d[:, 1]) + 0.3 * np.abs(d[:, 2])),
        ("ellipsoid", "0.1 0.2 0.3", lambda d: np.linalg.norm(d * [0.1, 0.2, 0.3], axis=1)),
        ("box", "0.1 0.2 0.3", lambda d: np.abs(d) @ [0.1, 0.2, 0.3]),
    ]:
        robot = mjcf(tmp_path, SLIDER.format(f'<geom type="{kind}" size="{size}"/>'))
        reach = (directions @ robot.meshes[0].vertices.numpy().T).max(axis=1)
        assert (reach >= support(directions) * (1 - 1e-12)).all(), kind
        assert (reach <= support(directions) * 1.009).all(), kind


def test_planes_height_fields_and_meshes(tmp_path: Path) -> None:
    ball = '<geom type="sphere" size="0.2"/>'
    floor = mjcf(tmp_path, '<geom type="plane" size="0 0 1" pos="0 0 0.5"/>' + SLIDER.format(ball))
    assert floor.link_names == ["world", "s"] and floor.moves.tolist() == [False, True]
    assert floor.reach == pytest.approx(5.0 + 1.0 + 0.2, rel=1e-6)  # without limits it slides by 1
    found = floor.certify(torch.tensor([[[0.0], [5.0]], [[0.0], [4.0]]]))
    assert found.free.tolist() == [False, True] and found.names(0) == ("world", "s")
    assert abs(float(found.time[0]) - 4.3 / 5.0) < 1e-3 * floor.reach
    assets = '<hfield name="h" nrow="2" ncol="3" size="1 2 0.5 0.1" elevation="0 0 0 1 1 1"/>'
    field = mjcf(tmp_path, '<geom type="hfield" hfield="h"/>' + SLIDER.format(ball), assets=assets)
    corners = field.meshes[0].vertices + field.meshes[0].origin
    assert corners.min(dim=0).values.tolist() == [-1.0, -2.0, -0.1]
    assert corners.max(dim=0).values.tolist() == [1.0, 2.0, 0.5]
    tetra = "0 0 0  1 0 0  0 1 0  0 0 1"
    mesh = mjcf(tmp_path, SLIDER.format('<geom type="mesh" mesh="m"/>'), assets=f'<mesh name="m" vertex="{tetra}"/>')
    position, orientation = mesh.poses(torch.zeros(1, dtype=torch.float64))
    assert len(mesh.meshes[0].faces) == 4 and position.tolist() == [[0.0, 0.0, 5.0]]
    corners = mesh.meshes[0].vertices.numpy()
    expected = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]])
    assert np.allclose(corners[np.lexsort(corners.round(4).T)], expected[np.lexsort(expected.T)], atol=1e-6)


def test_robots_beside_planes_are_invalid(tmp_path: Path) -> None:
    """Planes are infinite whatever their size, and do not count for the reach; where a robot may leave the square in
    place of one, nothing is called free.
    """
    rail = '<body name="s" pos="3 0 1"><joint type="slide" axis="1 0 0"/><geom type="sphere" size="0.2"/></body>'
    floor = '<geom type="plane" size="1 2 1" pos="{} 0 -1"/><geom type="box" size="1 1 0.1" pos="0 5 0"/>'
    for at, half in ((0.0, 1e4), (2e4, 2.0 * (2e4 + 6.2))):
        robot = mjcf(tmp_path, floor.format(at) + rail)
        assert [len(mesh.faces) for mesh in robot.meshes] == [12, 2, 1] and 5.0 < robot.reach < 6.2
        wide = float((robot.meshes[1].vertices[:, 1] + robot.meshes[1].origin[1]).abs().max())
        assert wide == pytest.approx(half, rel=1e-3)
        heights = robot.meshes[1].vertices[:, 2] + robot.meshes[1].origin[2]
        np.testing.assert_allclose(heights.numpy(), -1.0, atol=1e-9)
        room = wide - at - robot.reach
        within, beyond = (torch.tensor([[0.0], [room * share]], dtype=torch.float64) for share in (0.999, 1.001))
        assert robot.certify(torch.stack([within, beyond])).verdict.tolist() == [Verdict.FREE, Verdict.INVALID]
        robot.trajectory(within)
        with pytest.raises(ValueError, match=r"q: waypoint 1: expected joints that slide by at most .* infinite plane"):
            robot.trajectory(beyond)
        assert robot.poses(within)[0].isfinite().all() and robot.poses(beyond)[0][1].isnan().all()
    sinking = SLIDER.format('<geom type="sphere" size="0.2" pos="0 -90 0"/>')
    tilted = mjcf(tmp_path, '<geom type="plane" size="0.1 0.1 1" quat="0.8 0.6 0 0"/>' + sinking)
    assert tilted.certify(torch.tensor([[[0.0], [400.0]], [[0.0], [300.0]]])).free.tolist() == [False, True]


def test_bodies_of_links(tmp_path: Path) -> None:
    """One body a link and thickness; geoms that do not collide are left out."""
    geoms = '<geom type="sphere" size="0.2"/><geom type="capsule" size="0.2 0.3"/><geom type="sphere" size="0.1"/>'
    geoms += '<geom type="box" size="1 1 1"/><geom type="box" size="9 9 9" contype="0" conaffinity="0"/>'
    robot = mjcf(tmp_path, SLIDER.format(geoms))
    assert robot.body_link.tolist() == [1, 1, 1] and [mesh.thickness for mesh in robot.meshes] == [0.0, 0.1, 0.2]
    assert [len(mesh.faces) for mesh in robot.meshes] == [12, 1, 2]
    assert robot.exclude.tolist() == [[0, 1], [0, 2], [1, 2]]


def test_joined_links_are_not_tested(tmp_path: Path) -> None:
    """Neighbours, over links without shapes too, and rigidly joined ones."""
    box = {"half": (0.1, 0.1, 0.1)}
    turn = {"kind": "revolute", "xyz": (0.1, 0, 0), "rpy": UPRIGHT, "axis": (0, 0, 1)}
    fixed = turn | {"kind": "fixed"}
    parts = [Part(**turn, **box), Part(**turn), Part(**turn, **box), Part(**fixed, **box), Part(**turn, **box)]  # type: ignore[arg-type]
    robot = loaded(Arm(parts), tmp_path)
    names = [robot.link_names[k] for k in robot.body_link.tolist()]
    assert names == ["link0", "link2", "link3", "link4"]
    assert robot.exclude.tolist() == [[0, 1], [0, 2], [1, 2], [1, 3], [2, 3]]
    other = robot.allow([("link4", "link0")])
    assert other.exclude.tolist() == [[0, 1], [0, 2], [0, 3], [1, 2], [1, 3], [2, 3]] and len(robot.exclude) == 5
    with pytest.raises(ValueError, match="^pairs: expected a name of a link, such as 'base', in .'hand', 'tool'.$"):
        robot.allow([("hand", "tool")])
    with pytest.raises(ValueError, match="^pairs: expected two different names, got .'link0', 'link0'.$"):
        robot.allow([("link0", "link0")])
    for pairs in ("link0", ("link0", "link2"), [("link0",)], [["link0", "link2", "link3"]], [0, 1], [(0, 1)], 5, None):
        with pytest.raises(TypeError, match="^pairs: expected pairs of names, such as .*, got "):
            robot.allow(pairs)  # type: ignore[arg-type]


def test_files_exclude_pairs(tmp_path: Path) -> None:
    arm = beams(4)
    robot = loaded(arm, tmp_path)
    assert robot.exclude.tolist() == [[0, 1], [1, 2], [2, 3]]
    srdf = tmp_path / "arm.srdf"
    srdf.write_text('<robot name="arm"><disable_collisions link1="link3" link2="link0" reason="Never"/></robot>')
    assert [0, 3] in pgccd.robots.load_urdf(tmp_path / "arm.urdf", srdf).exclude.tolist()
    srdf.write_text('<robot name="arm"><disable_collisions link1="hand" link2="link0"/></robot>')
    with pytest.raises(ValueError, match="^srdf: .*: disable_collisions: the robot has no link 'hand'"):
        pgccd.robots.load_urdf(tmp_path / "arm.urdf", srdf)
    geom = '<joint type="hinge" axis="0 0 1"/><geom type="sphere" size="0.1"/>'
    nested = f'<body name="a">{geom}<body name="b">{geom}<body name="c">{geom}</body></body></body>'
    exclude = '<contact><exclude body1="a" body2="c"/></contact>'
    assert mjcf(tmp_path, nested).exclude.tolist() == [[0, 1], [1, 2]]
    assert mjcf(tmp_path, nested, exclude).exclude.tolist() == [[0, 1], [0, 2], [1, 2]]


def test_samples_exclude_what_always_collides(tmp_path: Path) -> None:
    """Short links that overlap with the one after the next by design."""
    ball = Part("revolute", (0.07, 0, 0), UPRIGHT, (0, 1, 0), radius=0.1)
    robot = loaded(Arm([ball] * 4), tmp_path)
    assert not bool(robot.certify(torch.zeros(1, 2, 4)).free[0])
    sampled = robot.excluding_sampled(200)
    assert {(0, 2), (1, 3)} <= {tuple(pair) for pair in sampled.exclude.tolist()}
    assert torch.equal(sampled.exclude, robot.excluding_sampled(200).exclude)
    long = loaded(beams(4), tmp_path)
    assert torch.equal(long.excluding_sampled(200).exclude, long.exclude)
    for given, message in [
        ((0,), "samples: expected"),
        ((9, 1.5), "share: expected a number in"),
        ((9, 0.5, -1), "seed"),
    ]:
        with pytest.raises(ValueError, match="^" + message):
            long.excluding_sampled(*given)
    free = mjcf(tmp_path, SLIDER.format('<geom type="sphere" size="0.2"/>'))
    with pytest.raises(ValueError, match="^samples: joint 'fall' has no limits"):
        free.excluding_sampled()


def test_meshes_of_files(tmp_path: Path) -> None:
    trimesh = pytest.importorskip("trimesh")
    pytest.importorskip("yourdfpy")
    (tmp_path / "robot" / "meshes").mkdir(parents=True)
    (tmp_path / "robot" / "urdf").mkdir()
    trimesh.creation.box((1, 2, 3)).export(tmp_path / "robot" / "meshes" / "box.stl")
    urdf = tmp_path / "robot" / "urdf" / "one.urdf"
    text = '<robot name="one"><link name="a"><collision><geometry><mesh filename="{}" scale="1 0.5 1"/></geometry>'
    text += "</collision></link></robot>"
    for name in (
        "package://robot/meshes/box.stl",
        "model://robot/meshes/box.stl",
        "../meshes/box.stl",
        f"file://{tmp_path}/robot/meshes/box.stl",
    ):
        urdf.write_text(text.format(name))
        assert pgccd.robots.load_urdf(urdf).meshes[0].vertices.max(dim=0).values.tolist() == [0.5, 0.5, 1.5]
    urdf.write_text(text.format("package://other/meshes/box.stl"))
    elsewhere = pgccd.robots.load_urdf(urdf, packages={"other": tmp_path / "robot"})
    assert elsewhere.body_count == 1 and elsewhere.joint_count == 0
    urdf.write_text(text.format("package://other/meshes/ball.stl"))
    with pytest.raises(ValueError, match="^path: .*link 'a': package://other/meshes/ball.stl is in no folder above"):
        pgccd.robots.load_urdf(urdf)
    urdf.write_text(text.format("../meshes/ball.stl"))
    with pytest.raises(FileNotFoundError, match="link 'a'"):
        pgccd.robots.load_urdf(urdf)


JOINT = '<joint name="j" type="{}"><parent link="a"/><child link="{}"/><axis xyz="{}"/>{}</joint>'


def test_what_urdf_files_cannot_be(tmp_path: Path) -> None:
    pytest.importorskip("yourdfpy")
    links = '<link name="a"><collision><geometry><sphere radius="1"/></geometry></collision></link><link name="b"/>'
    fixed = JOINT.format("fixed", "b", "0 0 1", "")
    path = tmp_path / "bad.urdf"
    for body, message in [
        ("", "it has no links"),
        (links, "expected one link without a parent, got \\['a', 'b'\\]"),
        (links + JOINT.format("revolute", "c", "0 0 1", ""), "joint 'j': there is no link 'c'"),
        (
            links + JOINT.format("floating", "b", "0 0 1", ""),
            "joint 'j': expected a fixed, revolute, .* got 'floating'",
        ),
        (links + JOINT.format("revolute", "b", "0 0 0", ""), "joint 'j': expected a finite origin and an axis"),
        (links + JOINT.format("revolute", "b", "0 0 1", '<mimic joint="k"/>'), "joint 'j': there is no joint 'k' to"),
        (links + JOINT.format("revolute", "a", "0 0 1", ""), "joint 'j' is part of a loop"),
        (links + fixed + fixed.replace('"j"', '"k"'), "link 'b' is the child of two joints"),
    ]:
        path.write_text(f'<robot name="bad">{body}</robot>')
        with pytest.raises(ValueError, match=f"^path: .*bad.urdf: ({message})"):
            pgccd.robots.load_urdf(path)
    # What is of no use here is not looked at.
    looks = (
        '<visual><origin xyz="0 0, 1"/></visual><inertial><mass value="one"/></inertial></link><gazebo><box/></gazebo>'
    )
    path.write_text('<robot name="good">' + links.split('<link name="b"/>')[0].replace("</link>", looks) + "</robot>")
    assert pgccd.robots.load_urdf(path).body_count == 1
    path.write_text("<robot><link")
    with pytest.raises(ValueError, match="^path: .* cannot be read as XML: "):
        pgccd.robots.load_urdf(path)
    path.write_text('<robot name="bare"><link name="a"/></robot>')
    with pytest.raises(ValueError, match="^path: .*bad.urdf: robot 'bare' has no collision surfaces"):
        pgccd.robots.load_urdf(path)
    with pytest.raises(FileNotFoundError, match="^path: "):
        pgccd.robots.load_urdf(tmp_path / "none.urdf")
    path.write_text(f'<robot name="one">{links + fixed}</robot>')
    with pytest.raises(ValueError, match="^srdf: .*bad.urdf is a URDF file"):
        pgccd.robots.load_urdf(path, path)
    for wrong, message in [
        ({"packages": [tmp_path]}, "packages: expected a dict of folders by name, got list"),
        ({"base_position": [0, 0, "x"]}, r"base_position: expected numbers, got \[0, 0, 'x'\]"),
        ({"base_orientation": None}, "base_orientation: expected numbers, got None"),
    ]:
        with pytest.raises(TypeError, match=f"^{message}"):
            pgccd.robots.load_urdf(path, **wrong)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ('<robot name="r">', '<robot name="r" />', "cannot be read as XML"),
        (' name="r"', "", ": the element robot has no name"),
        ('link name="a"', "link", ": link 0 has no name"),
        ('<link name="b"/>', '<link name="a"/>', ": there are two links 'a'"),
        ('joint name="j"', "joint", ": joint 0 has no name"),
        ('parent link="a"', "parent", ": joint 'j': expected an element parent with a link"),
        ('<child link="b"/>', "", ": joint 'j': expected an element child with a link"),
        ('size="1 2 3"', 'size="1 2"', ": link 'a': box: size: expected 3 finite numbers, got '1 2'"),
        ('size="1 2 3"', "", ": link 'a': a box without size"),
        ('<box size="1 2 3"/>', "", ": link 'a': expected a collision geometry of one of box, .*; got nothing"),
        ('<box size="1 2 3"/>', '<capsule radius="1" length="2"/>', ": link 'a': expected .*; got capsule"),
        ('<box size="1 2 3"/>', "<mesh/>", ": link 'a': a mesh without a filename"),
        ('<box size="1 2 3"/>', '<mesh filename="a" scale="1 1 1 1"/>', ": link 'a': mesh: scale: expected 1 or 3 fin"),
        ('<box size="1 2 3"/>', '<sphere radius="nan"/>', ": link 'a': sphere: radius: expected a finite number, got"),
        ('xyz="0 0 0"', 'xyz="0 0 0 1"', ": link 'a': origin: xyz: expected 3 finite numbers, got '0 0 0 1'"),
        ('rpy="0 0 0"', 'rpy="0 0"', ": joint 'j': origin: rpy: expected 3 finite numbers"),
        ('axis xyz="0 0 1"', 'axis xyz="0 0 0 1"', ": joint 'j': axis: xyz: expected 3 finite numbers"),
        ('lower="-1"', 'lower="nan"', ": joint 'j': limit: lower: expected a finite number, got 'nan'"),
        ("robot", "sdf", " is no URDF file: expected an element robot, got sdf"),
        ('<link name="a">', '<deformable name="a">', "cannot be read as XML"),
    ],
)
def test_numbers_and_names_of_urdf_files(tmp_path: Path, old: str, new: str, message: str) -> None:
    """Of these, readers take the first or the last numbers, or fail without a name."""
    pytest.importorskip("yourdfpy")
    text = (
        '<robot name="r"><link name="a"><collision><origin xyz="0 0 0"/><geometry><box size="1 2 3"/></geometry>'
        '</collision></link><link name="b"/><joint name="j" type="revolute"><parent link="a"/><child link="b"/>'
        '<origin rpy="0 0 0"/><axis xyz="0 0 1"/><limit lower="-1" upper="1" effort="1" velocity="1"/></joint></robot>'
    )
    path = tmp_path / "one.urdf"
    path.write_text(text)
    assert pgccd.robots.load_urdf(path).joint_count == 1
    path.write_text(text.replace(old, new))
    with pytest.raises(ValueError, match=f"^path: .*one.urdf ?{message}"):
        pgccd.robots.load_urdf(path)


SPELT = (
    '<robot name="r" xmlns:drake="http://drake.mit.edu"><link name="a"><collision><origin xyz="0 0 0"/><geometry>'
    '<box size="1 2 3"/></geometry></collision></link><link name="b"/><joint name="j" type="revolute">'
    '<parent link="a"/><child link="b"/><origin rpy="0 0 0"/><axis xyz="0 0 1"/><limit lower="-1" upper="1"/></joint>'
    '<joint name="k" type="revolute"><parent link="b"/><child link="c"/><mimic joint="j"/></joint><link name="c"/>'
    "</robot>"
)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ('<link name="b"/>', '<link name="b"/><lnk name="b"/>', "unknown element lnk: expected one of link, joint,"),
        ("</robot>", '<loop_joint name="l"/></robot>', "unknown element loop_joint"),
        ("</robot>", '<deformable name="l"/></robot>', "unknown element deformable"),
        ("</link>", "<colision/></link>", "link 'a': unknown element colision: expected one of collision,"),
        ("</link>", '<origin xyz="0 0 1"/></link>', "link 'a': unknown element origin"),
        ("mimic", "mimick", "joint 'k': unknown element mimick: expected one of origin, parent, child, axis,"),
        ("<axis ", "<axes ", "joint 'j': unknown element axes"),
        ('<origin xyz="0 0 0"/>', '<orign xyz="0 0 1"/>', "link 'a': unknown element orign: expected one of origin, "),
        ("</collision>", "<geomtry><box/></geomtry></collision>", "link 'a': unknown element geomtry"),
        (
            'xyz="0 0 0"/>',
            "><xyz>0 0 1</xyz></origin>",
            "link 'a': origin: unknown element xyz: expected nothing within",
        ),
        ('xyz="0 0 0"', 'xzy="0 0 1"', "link 'a': origin: unknown attribute xzy: expected one of xyz, rpy"),
        ('rpy="0 0 0"', 'quat_xyzw="0 0 1 0"', "joint 'j': origin: unknown attribute quat_xyzw"),
        ('axis xyz="0 0 1"', 'axis xzy="0 0 1"', "joint 'j': axis: unknown attribute xzy"),
        ('lower="-1"', 'lowr="-1"', "joint 'j': limit: unknown attribute lowr: expected one of lower, upper, "),
        ('mimic joint="j"', 'mimic joint="j" factor="2"', "joint 'k': mimic: unknown attribute factor"),
        ('<box size="1 2 3"/>', '<mesh filename="a" scal="2"/>', "link 'a': mesh: unknown attribute scal"),
        ("</collision>", '<origin xyz="0 0 1"/></collision>', "link 'a': expected one element origin, got 2"),
        (
            "<collision>",
            '<collision><geometry><box size="9 9 9"/></geometry>',
            "link 'a': expected one element geometry",
        ),
        ("</joint>", '<axis xyz="1 0 0"/></joint>', "joint 'j': expected one element axis, got 2"),
        ("<box ", "<drake:capsule ", "link 'a': expected a collision geometry of one of box, .*capsule"),
    ],
)
def test_what_is_misspelt_in_urdf_files(tmp_path: Path, old: str, new: str, message: str) -> None:
    """What readers leave out without a word, and what moves when they do."""
    pytest.importorskip("yourdfpy")
    path = tmp_path / "one.urdf"
    path.write_text(SPELT.replace(old, new, 1))
    with pytest.raises(ValueError, match=f"^path: .*one.urdf: {message}"):
        pgccd.robots.load_urdf(path)


def test_what_urdf_files_may_have_besides(tmp_path: Path) -> None:
    """As files of public packages have it: without a meaning for geometry and motion, or twice the same."""
    pytest.importorskip("yourdfpy")
    path = tmp_path / "one.urdf"
    path.write_text(SPELT)
    expected = pgccd.robots.load_urdf(path)
    for old, new in (
        ("</robot>", '<gazebo/><material name="m"/><transmission/><ros2_control/><sensor/><mujoco/><!-- c --></robot>'),
        ("</robot>", '<drake:collision_filter_group name="g"/><!-- <xacro:if value="1"/> --></robot>'),
        ("</link>", "<visual><colision/></visual><inertial/><contact/><self_filter/></link>"),
        ("</link>", '<origin xyz="0 0 0" rpy="0 -0 0"/></link>'),
        ("</collision>", "<drake:proximity_properties/><verbose/><material/><surface/></collision>"),
        ("</joint>", '<calibration/><dynamics/><safety_controller/><axis xyz="0 0 1"/></joint>'),
    ):
        assert old in SPELT
        path.write_text(SPELT.replace(old, new, 1))
        robot = pgccd.robots.load_urdf(path)
        assert robot.joint_names == expected.joint_names
        assert torch.equal(robot.meshes[0].vertices, expected.meshes[0].vertices)


@pytest.mark.parametrize("declared", ["", ' xmlns:xacro="http://www.ros.org/wiki/xacro"'])
def test_macros_are_not_expanded(tmp_path: Path, declared: str) -> None:
    pytest.importorskip("yourdfpy")
    path, srdf = tmp_path / "one.urdf", tmp_path / "one.srdf"
    srdf.write_text(f'<robot name="r"{declared}>\n <xacro:include filename="pairs"/></robot>')
    path.write_text(SPELT)
    for named, load in (
        ("path", lambda: pgccd.robots.load_urdf(srdf)),
        ("srdf", lambda: pgccd.robots.load_urdf(path, srdf)),
    ):
        with pytest.raises(
            ValueError, match=rf"^{named}: .*one.srdf has macros .* \((line 2|xacro:include)\): run xacro"
        ):
            load()


def test_what_is_misspelt_in_srdf_files(tmp_path: Path) -> None:
    pytest.importorskip("yourdfpy")
    path, srdf = tmp_path / "one.urdf", tmp_path / "one.srdf"
    path.write_text(SPELT)
    for text, message in (
        (
            '<robot name="r"><enable_colisions link1="a" link2="b"/></robot>',
            ": unknown element enable_colisions: expected",
        ),
        ('<robot name="r"><disable_collision link1="a" link2="b"/></robot>', ": unknown element disable_collision:"),
        (
            '<sdf><disable_collisions link1="a" link2="b"/></sdf>',
            " is no SRDF file: expected an element robot, got sdf",
        ),
    ):
        srdf.write_text(text)
        with pytest.raises(ValueError, match=f"^srdf: .*one.srdf{message}"):
            pgccd.robots.load_urdf(path, srdf)
    srdf.write_text('<robot name="r"><group name="g"/><passive_joint name="j"/><end_effector/><gripper/></robot>')
    assert pgccd.robots.load_urdf(path, srdf).joint_names == ["j"]


def test_what_mjcf_files_cannot_be(tmp_path: Path) -> None:
    sphere = '<geom type="sphere" size="0.2"/>'
    for kind in ("free", "ball"):
        with pytest.raises(ValueError, match=f"^path: .*joint 'j': expected a hinge or a slide, got {kind}"):
            mjcf(tmp_path, f'<body><joint name="j" type="{kind}"/>{sphere}</body>')
    with pytest.raises(ValueError, match="^path: .* cannot be read as MJCF"):
        mjcf(tmp_path, "<body><geom/></body>")
    with pytest.raises(ValueError, match="^path: [^\n]*$"):
        mjcf(tmp_path, "<body><geoms/></body>")
    with pytest.raises(FileNotFoundError, match="^path: "):
        pgccd.robots.load_mjcf(tmp_path / "none.xml")


def test_readers_are_named_where_they_are_missing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(__import__("sys").modules, "yourdfpy", None)
    monkeypatch.setitem(__import__("sys").modules, "mujoco", None)
    (tmp_path / "a.urdf").write_text("<robot/>")
    for load, reader in ((pgccd.robots.load_urdf, "yourdfpy"), (pgccd.robots.load_mjcf, "mujoco")):
        with pytest.raises(ImportError, match=rf"^{reader} reads .*pip install 'pgccd\[robots\]'"):
            load(tmp_path / "a.urdf")


def test_links_of_lines_or_points_are_refused(tmp_path: Path) -> None:
    """Between them a link would have nothing that could touch."""
    pytest.importorskip("yourdfpy")
    (tmp_path / "wire.obj").write_text("v 0 0 0\nv 1 0 0\nv 1 1 0\nl 1 2 3\np 3\n")
    text = '<robot name="r"><link name="a"><collision><geometry><mesh filename="wire.obj"/></geometry>'
    (tmp_path / "r.urdf").write_text(f"{text}</collision></link></robot>")
    with pytest.raises(ValueError, match="link .a.: expected a file of triangles, got Mesh.*segments=2, points=1"):
        pgccd.robots.load_urdf(tmp_path / "r.urdf")
