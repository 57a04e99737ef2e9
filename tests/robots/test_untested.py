"""Which pairs of links are never tested: those that the file format says, and no others."""

from __future__ import annotations

import importlib.util
import itertools
import warnings
from pathlib import Path

import numpy as np
import pytest
import torch

import pgccd
from pgccd.robots import Verdict

LINK = '<link name="{0}">{1}</link>'
BOX = '<collision><origin xyz="{} {} {}"/><geometry><box size="0.2 0.2 0.2"/></geometry></collision>'
JOINT = '<joint name="{1}" type="{2}"><parent link="{0}"/><child link="{1}"/><axis xyz="{3}"/>{4}</joint>'
LIMIT = '<limit lower="-3" upper="3"/>'


def urdf(folder: Path, chain: str) -> pgccd.robots.Robot:
    """A robot of words such as "base>upper:revolute": a link, its parent and joint. Links in upper case have no shape;
    of the others each is far from all.
    """
    pytest.importorskip("yourdfpy")
    words = [word.partition(":") for word in chain.split()]
    parents = [name.rpartition(">")[::2] for name, _, _ in words]
    links = []
    for k, (_, name) in enumerate(parents):
        links.append(LINK.format(name, "" if name.isupper() else BOX.format(10 * k, 0, 0)))
    joints = [
        JOINT.format(parent, name, kind, "1 0 0", LIMIT)
        for (parent, name), (_, _, kind) in zip(parents, words, strict=True)
        if parent
    ]
    path = folder / "robot.urdf"
    path.write_text(f'<robot name="r">{"".join(links + joints)}</robot>')
    return pgccd.robots.load_urdf(path)


URDF_CASES = {
    # A wall and a cart on the same root; the same with the base's three joints.
    "WORLD WORLD>wall:fixed WORLD>cart:prismatic": "",
    "WORLD WORLD>wall:fixed WORLD>X:prismatic X>Y:prismatic Y>base:revolute": "",
    # The root itself has a surface: it is a neighbour, what is fixed to it is not.
    "floor floor>wall:fixed floor>cart:prismatic": "cart-floor",
    "WORLD WORLD>table:fixed table>mount:fixed table>vase:fixed mount>arm:revolute": "arm-mount",
    # Over links without surfaces, through joints of all kinds.
    "base base>torso:revolute torso>MOUNT:fixed MOUNT>shoulder:revolute": "base-torso shoulder-torso",
    "base base>TURN:revolute TURN>upper:revolute upper>hand:revolute": "base-upper hand-upper",
    # Covers are joined to the neighbours of what they cover.
    "base base>upper:revolute upper>cover:fixed upper>fore:revolute fore>shell:fixed": (
        "base-cover base-upper cover-fore cover-shell cover-upper fore-shell fore-upper shell-upper"
    ),
    "WORLD WORLD>BASE:fixed BASE>inertia:fixed inertia>shoulder:revolute": "inertia-shoulder",
    # Two arms on one table.
    "table table>left:revolute table>right:revolute left>grip:revolute": "grip-left left-table right-table",
    # Fingers of one palm are no neighbours, nor are the legs of a body, or what is fixed to them.
    "base base>palm:revolute palm>left:prismatic palm>right:prismatic": "base-palm left-palm palm-right",
    "WORLD WORLD>X:prismatic X>trunk:fixed trunk>one:revolute trunk>HIP:revolute HIP>two:revolute two>foot:fixed": (
        "foot-trunk foot-two one-trunk trunk-two"
    ),
    # A camera on the ceiling is fixed to the root of the arm, and so is its stand.
    "WORLD WORLD>base:fixed WORLD>camera:fixed base>arm:revolute": "arm-base",
}


@pytest.mark.parametrize("chain", URDF_CASES)
def test_neighbours_of_urdf_links(chain: str, tmp_path: Path) -> None:
    robot = urdf(tmp_path, chain)
    pairs = {"-".join(sorted((a, b))): why for a, b, why in robot.untested}
    assert sorted(pair for pair, why in pairs.items() if why == "adjacent") == URDF_CASES[chain].split()
    assert set(pairs.values()) <= {"adjacent", "both fixed"}
    owner = [robot.link_names[k] for k in robot.body_link.tolist()]
    assert sorted("-".join(sorted((owner[i], owner[j]))) for i, j in robot.exclude.tolist()) == sorted(pairs)


def test_a_base_does_not_drive_through_a_wall_on_its_root(tmp_path: Path) -> None:
    shape = '<collision><origin xyz="{} 0 0"/><geometry><box size="{}"/></geometry></collision>'
    wall, cart = (
        LINK.format(*each) for each in (("wall", shape.format(1, "0.1 2 2")), ("cart", shape.format(0, "0.4 1 1")))
    )
    joints = JOINT.format("WORLD", "wall", "fixed", "1 0 0", "") + JOINT.format(
        "WORLD", "cart", "prismatic", "1 0 0", LIMIT
    )
    pytest.importorskip("yourdfpy")
    (tmp_path / "robot.urdf").write_text(f'<robot name="r"><link name="WORLD"/>{wall}{cart}{joints}</robot>')
    robot = pgccd.robots.load_urdf(tmp_path / "robot.urdf")
    found = robot.certify(torch.tensor([[[0.0], [2.0]]]))
    assert found.verdict.tolist() == [int(Verdict.COLLISION)] and found.names(0) == ("wall", "cart")
    assert float(found.time) == pytest.approx(0.375, abs=1e-3)


def test_fingers_of_one_palm_meet(tmp_path: Path) -> None:
    """Links that are children of one moving link are tested against each other."""
    pytest.importorskip("yourdfpy")
    shape = '<collision><origin xyz="{} 0 0"/><geometry><box size="0.1 0.1 0.1"/></geometry></collision>'
    links = LINK.format("base", "") + LINK.format("palm", shape.format(0).replace("0 0", "0 9"))
    links += LINK.format("left", shape.format(-1)) + LINK.format("right", shape.format(1))
    joints = JOINT.format("base", "palm", "revolute", "0 0 1", LIMIT)
    joints += JOINT.format("palm", "left", "prismatic", "1 0 0", LIMIT)
    joints += JOINT.format("palm", "right", "prismatic", "-1 0 0", LIMIT)
    (tmp_path / "robot.urdf").write_text(f'<robot name="r">{links}{joints}</robot>')
    robots = {"urdf": pgccd.robots.load_urdf(tmp_path / "robot.urdf")}
    if importlib.util.find_spec("mujoco"):
        box = '<geom type="box" size=".05 .05 .05" pos="0 0 {}"/>'
        finger = '<body name="{}" pos="{} 0 0"><joint type="slide" axis="{} 0 0"/>' + box.format(0) + "</body>"
        inside = finger.format("left", -1, 1) + finger.format("right", 1, -1)
        palm = f'<body name="palm"><joint/>{box.format(9)}{inside}</body>'
        (tmp_path / "robot.xml").write_text(f"<mujoco><worldbody>{palm}</worldbody></mujoco>")
        robots["mjcf"] = pgccd.robots.load_mjcf(tmp_path / "robot.xml")
    q = torch.tensor([[[0.0, 0.0, 0.0], [0.5, 1.0, 1.0]]])
    for kind, robot in robots.items():
        found = robot.certify(q)
        assert found.verdict.tolist() == [int(Verdict.COLLISION)] and found.names(0) == ("left", "right"), kind
        assert float(found.time) == pytest.approx(0.95, abs=1e-3)


def test_srdf_files_disable_and_enable(tmp_path: Path) -> None:
    chain = "base base>one:revolute one>two:revolute two>three:revolute"
    urdf(tmp_path, chain)
    srdf = tmp_path / "robot.srdf"

    def pairs(text: str) -> dict[str, str]:
        srdf.write_text(f'<robot name="r">{text}</robot>')
        robot = pgccd.robots.load_urdf(tmp_path / "robot.urdf", srdf)
        return {f"{a}-{b}": why for a, b, why in robot.untested}

    joined = {"base-one": "adjacent", "one-two": "adjacent", "two-three": "adjacent"}
    assert pairs("") == joined
    assert pairs('<disable_collisions link1="three" link2="base"/>') == joined | {"base-three": "file"}
    assert pairs('<enable_collisions link1="two" link2="one"/>') == {k: v for k, v in joined.items() if k != "one-two"}
    default = '<disable_default_collisions link="three"/>'
    assert pairs(default) == joined | {"base-three": "file", "one-three": "file"}
    assert pairs(default + '<enable_collisions link1="three" link2="one"/>') == joined | {"base-three": "file"}
    for element in ('<enable_collisions link1="hand" link2="one"/>', '<disable_default_collisions link="hand"/>'):
        with pytest.raises(ValueError, match="^srdf: .*: the robot has no link 'hand'"):
            pairs(element)


def random_model(rng: np.random.Generator) -> str:
    """Bodies in a tree, all in one place: with and without joints and geoms, and all that filters geoms."""
    names = itertools.count()
    bodies: list[str] = []
    geoms: list[str] = []

    def geom() -> str:
        geoms.append(f"g{len(geoms)}")
        bits = [int(bit) for bit in (rng.integers(0, 4, 2) if rng.random() < 0.5 else (1, 1))]
        radius = 1.0 + 0.001 * len(geoms)
        at = " ".join(f"{x:.3f}" for x in rng.uniform(-0.3, 0.3, 3))
        filters = f'contype="{bits[0]}" conaffinity="{bits[1]}"'
        return f'<geom name="{geoms[-1]}" pos="{at}" size="{radius}" mass="1" {filters}/>'

    def body(depth: int) -> str:
        bodies.append(f"b{next(names)}")
        name = bodies[-1]
        inside = '<joint type="hinge" axis="0 0 1"/>' if rng.random() < 0.6 else ""
        inside += '<inertial pos="0 0 0" mass="1" diaginertia="1 1 1"/>'
        inside += "".join(geom() for _ in range(rng.integers(0, 3)))
        if depth < 4:
            inside += "".join(body(depth + 1) for _ in range(rng.choice([0, 1, 1, 2])))
        return f'<body name="{name}">{inside}</body>'

    world = "".join(geom() for _ in range(rng.integers(0, 3))) + "".join(body(0) for _ in range(rng.integers(1, 3)))
    contact = set()
    for kind, given in (("exclude", bodies), ("pair", geoms)):
        for _ in range(rng.integers(0, 3)):
            if len(given) > 1:
                one, other = rng.choice(given, 2, replace=False)
                what = "body" if kind == "exclude" else "geom"
                contact.add(f'<{kind} {what}1="{min(one, other)}" {what}2="{max(one, other)}"/>')
    flag = "disable" if rng.random() < 0.3 else "enable"
    return (
        f'<mujoco><option><flag filterparent="{flag}"/></option><worldbody>{world}</worldbody>'
        f"<contact>{''.join(sorted(contact))}</contact></mujoco>"
    )


def test_geoms_that_mujoco_tests(tmp_path: Path) -> None:
    """The pairs of geoms that MuJoCo finds in contact, all of them in one place."""
    mujoco = pytest.importorskip("mujoco")
    compared = 0
    for seed in range(150):
        path = tmp_path / "model.xml"
        path.write_text(random_model(np.random.default_rng(seed)))
        model = mujoco.MjModel.from_xml_path(str(path))
        data = mujoco.MjData(model)
        mujoco.mj_forward(model, data)
        contacts = {tuple(sorted(pair)) for pair in data.contact.geom.tolist()}
        body, weld = model.geom_bodyid, model.body_weldid
        # Of one body, and of bodies that do not move, no pairs are tested, even if a `pair` names them.
        expected = {(a, b) for a, b in contacts if body[a] != body[b] and (weld[body[a]] or weld[body[b]])}
        try:
            with warnings.catch_warnings(record=True) as said:
                warnings.simplefilter("always")
                robot = pgccd.robots.load_mjcf(path)
        except ValueError as error:
            assert "no collision surfaces" in str(error)
            assert not expected
            continue
        radii = [round(float(radius), 4) for radius in model.geom_size[:, 0]]
        geom = [radii.index(round(float(radius), 4)) for radius in (mesh.thickness for mesh in robot.meshes)]
        left_out = {tuple(sorted((geom[i], geom[j]))) for i, j in robot.exclude.tolist()}
        every = {tuple(sorted(pair)) for pair in itertools.combinations(geom, 2)}
        assert every - left_out == expected, seed
        assert bool(expected) == any("touch in the neutral configuration" in str(each.message) for each in said)
        compared += len(every)
    assert compared > 1500


def test_what_touches_by_design_is_named(tmp_path: Path) -> None:
    box = '<geom type="box" size="1 1 1"/>'
    mujoco_model = f"""<mujoco><worldbody><body name="base">{box}<body name="arm"><joint name="j" ref="0.5"/>
<inertial pos="0 0 0" mass="1" diaginertia="1 1 1"/><body name="hand"><joint name="k"/>{box}</body></body></body>
</worldbody></mujoco>"""
    pytest.importorskip("mujoco")
    path = tmp_path / "model.xml"
    path.write_text(mujoco_model)
    with pytest.warns(UserWarning, match=r"robot = robot.allow\(\[\('base', 'hand'\)\]\)"):
        robot = pgccd.robots.load_mjcf(path)
    assert robot.untested == [] and "untested pairs=0" in repr(robot)
    again = robot.allow([("base", "hand")])
    assert again.untested == [("base", "hand", "allowed")] and "untested pairs=1" in repr(again)
    assert robot.untested == []
    found = again.certify(torch.tensor([[[0.0, 0.0], [0.1, 0.0]]]))
    assert bool(found.free[0]) and "sampled" not in repr(found)
    sampled = robot.excluding_sampled(50)
    assert sampled.untested == [("base", "hand", "sampled")]
    found = sampled.certify(torch.tensor([[[0.0, 0.0], [0.1, 0.0]]]))
    assert found.untested == [("base", "hand", "sampled")] and "untested_sampled=1" in repr(found)


def test_couplings(tmp_path: Path) -> None:
    """A linear one is a joint that follows; a follower may be followed; the rest is refused by name."""
    mujoco = pytest.importorskip("mujoco")
    body = '<body name="b{0}" pos="{0} 0 0"><joint name="j{0}" axis="0 1 0" ref="0.{0}"/>{1}</body>'
    bodies = "".join(body.format(k, '<geom size="0.1 0.1 0.1" type="box"/>') for k in range(4))
    path = tmp_path / "model.xml"

    def load(equality: str, more: str = "") -> pgccd.robots.Robot:
        world = f"<worldbody>{bodies}</worldbody><equality>{equality}</equality>"
        path.write_text(f'<mujoco><compiler angle="radian"/>{world}{more}</mujoco>')
        return pgccd.robots.load_mjcf(path)

    joint = '<joint name="tie{0}" joint1="j{0}" joint2="j{1}" polycoef="{2}"/>'
    robot = load(joint.format(0, 2, "0.02 -1 0 0 0") + joint.format(2, 3, "0.1 0.5 0 0 0"))
    assert robot.joint_names == ["j1", "j3"]
    model = mujoco.MjModel.from_xml_path(str(path))
    data = mujoco.MjData(model)
    q1, q3 = 0.3, -0.4
    q2 = 0.2 + 0.1 + 0.5 * (q3 - 0.3)
    data.qpos[:] = [0.0 + 0.02 - (q2 - 0.2), q1, q2, q3]
    mujoco.mj_forward(model, data)
    assert np.abs(data.efc_pos[: model.neq]).max() < 1e-12  # the constraints hold there
    x, r = robot.poses(torch.tensor([q1, q3]))
    assert np.allclose(x.numpy(), data.xpos[1:], atol=1e-12)
    turn = (r.numpy() * data.xquat[1:]).sum(axis=1)
    assert np.allclose(np.abs(turn), 1.0, atol=1e-12)
    assert load(joint.format(0, 2, "0 1 0 0 0").replace("joint ", 'joint active="false" ')).joint_count == 4
    for flag in ("equality", "constraint"):
        disabled = f'<option><flag {flag}="disable"/></option>'
        assert load(joint.format(0, 2, "0 1 0 0 0"), disabled).joint_count == 4
    with pytest.raises(ValueError, match="body 'hand': expected a body that joints move, or nothing, got mocap"):
        load("", '<worldbody><body name="hand" mocap="true"><geom size="1"/></body></worldbody>')
    for equality, message in [
        (
            joint.format(0, 2, "0 1 0.5 0 0"),
            "equality 'tie0' of joint 'j0': expected another joint, by a polycoef of two",
        ),
        ('<joint name="lock" joint1="j1"/>', "equality 'lock' of joint 'j1': expected another joint"),
        (
            joint.format(0, 2, "0 1 0 0 0") + joint.format(0, 3, "0 1 0 0 0").replace("tie0", "again"),
            "equality 'again' of joint 'j0': another one ties it",
        ),
        (
            joint.format(0, 2, "0 1 0 0 0") + joint.format(2, 0, "0 1 0 0 0"),
            "joint 'j0': equality constraints tie it to itself",
        ),
        (
            '<connect name="loop" body1="b0" body2="b2" anchor="0 0 0"/>',
            "equality 'loop': expected one of joints, got connect",
        ),
        ('<weld name="loop" body1="b0"/>', "equality 'loop': expected one of joints, got weld"),
    ]:
        with pytest.raises(ValueError, match="^path: .*model.xml: " + message):
            load(equality)
    tendon = '<tendon><fixed name="{}"><joint joint="j0" coef="1"/></fixed></tendon>'
    assert load("", tendon.format("pull")).joint_count == 4
    with pytest.raises(ValueError, match="equality 'rope': expected one of joints, got tendon"):
        load('<tendon name="rope" tendon1="pull"/>', tendon.format("pull"))
