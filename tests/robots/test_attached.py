"""Objects that a robot carries, compared with links of a file; and pairs that may touch."""

from __future__ import annotations

import itertools
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from oracle.arms import Arm, Part
from support.arms import UPRIGHT, attached_like, beams, boxes, loaded, random_arm, with_object
from support.cases import mostly_slow

import pgccd
from pgccd.robots import Certificate, Obstacles, Robot, Verdict
from robots.test_path_search import same

AT_ORIGIN = ([0.0, 0.0, 0.0], [1.0, 0.0, 0.0, 0.0])
CUBE = pgccd.Mesh.box([0.1, 0.1, 0.1])


def at(x: float, y: float = 0.0, z: float = 0.0) -> tuple[list[float], list[float]]:
    return [x, y, z], [1.0, 0.0, 0.0, 0.0]


def named(robot: Robot) -> set[frozenset[str]]:
    """The pairs of links whose bodies are excluded."""
    owner = [robot.link_names[k] for k in robot.body_link.tolist()]
    return {frozenset((owner[i], owner[j])) for i, j in robot.exclude.tolist()}


def moved(robot: Robot, q: torch.Tensor | None = None) -> torch.Tensor:
    """A rest (1, 2, J)."""
    q = torch.zeros(robot.joint_count, dtype=torch.float64) if q is None else q
    return q.expand(1, 2, -1).to(torch.float64)


def is_free(robot: Robot, obstacles: Obstacles | None = None) -> bool:
    return bool(robot.certify(moved(robot), obstacles).free[0])


def paths(rng: np.random.Generator, robot: Robot, count: int = 6, waypoints: int = 3) -> np.ndarray:
    start = rng.uniform(-1.2, 1.2, (count, 1, robot.joint_count))
    steps = rng.normal(size=(count, waypoints - 1, robot.joint_count)).cumsum(axis=1)
    return start + np.concatenate([np.zeros_like(start), steps], axis=1)


@pytest.mark.parametrize("seed", mostly_slow(range(8), [0, 1]))
def test_as_a_link_of_the_file(seed: int, tmp_path: Path) -> None:
    """Verdicts, times, links and bounds are those of a file in which the object is a fixed link, with an SRDF file that
    says the same of its pairs.
    """
    rng = np.random.default_rng(seed)
    arm = random_arm(rng, 6) if seed % 2 else beams(4)
    whole, carrier, pose = with_object(arm, rng)
    others = [f"link{k}" for k in range(len(arm.parts)) if k != carrier]
    touching = [name for name in others if rng.random() < 0.3]
    robot = attached_like(loaded(arm, tmp_path), whole, carrier, pose, touching)
    last = robot.link_names[-1]
    pair = f'<{{}} link1="{last}" link2="{{}}"/>'
    enabled = [pair.format("enable_collisions", name) for name in others if name not in touching]
    disabled = [pair.format("disable_collisions", name) for name in (*touching, f"link{carrier}")]
    (tmp_path / "whole.urdf").write_text(whole.urdf())
    (tmp_path / "whole.srdf").write_text(f'<robot name="arm">{"".join(enabled + disabled)}</robot>')
    expected = pgccd.robots.load_urdf(tmp_path / "whole.urdf", tmp_path / "whole.srdf")
    assert robot.link_names == expected.link_names and named(robot) == named(expected)
    assert robot.reach == pytest.approx(expected.reach, rel=1e-14)
    assert robot.moves.tolist() == expected.moves.tolist()
    q = torch.tensor(paths(rng, robot))
    for a, b in zip(robot.poses(q), expected.poses(q), strict=True):
        torch.testing.assert_close(a, b, rtol=0.0, atol=1e-14)
    margins = [each.trajectory(q[0]).margin for each in (robot, expected)]
    torch.testing.assert_close(*margins, rtol=1e-9, atol=1e-15)
    obstacles, _, _ = boxes(rng, 5, 0.4 * robot.reach, 0.9 * robot.reach)
    a, b = robot.certify(q, obstacles), expected.certify(q, obstacles)
    assert a.verdict.tolist() == b.verdict.tolist() and a.links.tolist() == b.links.tolist()
    torch.testing.assert_close(a.time, b.time, rtol=0.0, atol=1e-6)


def test_only_what_is_said_is_left_out(tmp_path: Path) -> None:
    """The object is put into each of the links: one that is not named is tested, neighbours of the carrier included."""
    arm = beams(4)
    robot = loaded(arm, tmp_path)
    links = [f"link{k}" for k in range(4)]
    middle = torch.tensor([0.2, 0.0, 0.0], dtype=torch.float64)
    for carrier, inside in itertools.product(range(4), range(4)):
        # In the frame of the carrier: all beams are in a row.
        pose = (middle + torch.tensor([0.4 * (inside - carrier), 0.0, 0.0]), AT_ORIGIN[1])
        wrong = [name for name in links if name != f"link{inside}"]
        carrying = robot.attach(f"link{carrier}", CUBE, pose, wrong)
        assert carrying.link_names == ["base", *links, "attached"] and carrying.attached == ["attached"]
        found = carrying.certify(moved(robot))
        if carrier == inside:
            assert bool(found.free[0])
        else:
            assert found.verdict.tolist() == [int(Verdict.START)] and found.names(0) == (f"link{inside}", "attached")
        right = robot.attach(f"link{carrier}", CUBE, pose, {f"link{inside}"})
        assert is_free(right)
        said = {(a, b): why for a, b, why in right.untested}
        expected = {("link0", "link1"): "adjacent", ("link1", "link2"): "adjacent", ("link2", "link3"): "adjacent"}
        expected |= {(f"link{inside}", "attached"): "touching", (f"link{carrier}", "attached"): "attached"}
        assert said == expected and right.certify(moved(robot)).untested == right.untested
        assert named(right) == {frozenset(pair) for pair in expected}
        in_the_way = Obstacles([CUBE], robot.poses(torch.zeros(4))[0][inside][None] + middle)
        assert not is_free(right, in_the_way)
    assert robot.link_names == ["base", *links] and robot.attached == []


def test_an_object_meets_obstacles(tmp_path: Path) -> None:
    """Where the robot itself does not; by its name and that of the obstacle; with its own margin."""
    robot = loaded(beams(2), tmp_path)
    post = Obstacles([CUBE, CUBE], torch.tensor([[9.0, 0.0, 0.0], [0.2, 0.5, 0.0]]), names=["far", "post"])
    assert is_free(robot, post)
    carrying = robot.attach("link0", CUBE, at(0.2, 0.42), name="box")
    found = carrying.certify(moved(robot), post)
    assert found.verdict.tolist() == [int(Verdict.START)] and found.names(0) == ("box", "post")
    for margin, free in ((0.0, True), (0.09, True), (0.11, False)):
        assert is_free(robot.attach("link0", CUBE.thickened(margin), at(0.2, 0.3)), post) == free
    turned = [math.cos(math.pi / 8), 0.0, 0.0, math.sin(math.pi / 8)]  # by 45 degrees: its corner is ahead
    assert is_free(robot.attach("link0", CUBE, at(0.2, 0.39)), post)
    assert not is_free(robot.attach("link0", CUBE, ([0.2, 0.39, 0.0], turned)), post)
    # Watertight objects are solids, as links and obstacles are.
    large = pgccd.Mesh.box([0.4, 0.4, 0.4])
    assert carrying.meshes[-1].solid and not is_free(robot.attach("link0", large, at(0.2, 0.5)), post)
    # The origin of a mesh is where the pose puts it.
    shifted = pgccd.Mesh(CUBE.vertices + torch.tensor([0.0, 5.0, 0.0]), CUBE.faces, origin=[0.0, 5.0, 0.0])
    shifted.name = "part"
    held = robot.attach("link0", shifted, at(0.2, 0.42))
    assert held.attached == ["part"] and held.certify(moved(robot), post).names(0) == ("part", "post")
    torch.testing.assert_close(held.certify(moved(robot), post).point, found.point)


@pytest.mark.parametrize("centred", [True, False])
def test_the_bound_knows_the_object(centred: bool, tmp_path: Path) -> None:
    """A ball at the end of a rod touches where its path bulges out of the chord, by the way of its own frame or by its
    distance from the frame.
    """
    rod = Part("revolute", UPRIGHT, UPRIGHT, (0, 0, 1), half=(0.01, 0.01, 0.01))
    robot = loaded(Arm([rod]), tmp_path)
    ball = pgccd.Mesh.box([0.2, 0.02, 0.02])
    if not centred:
        ball = pgccd.Mesh(ball.vertices + torch.tensor([1.0, 0.0, 0.0]), ball.faces)
    carrying = robot.attach("link0", ball, at(1.0 if centred else 0.0))
    assert carrying.reach == pytest.approx(1.1, rel=1e-3)
    q = torch.tensor([[[-0.3], [0.3]]], dtype=torch.float64)
    wall = pgccd.Mesh.box([0.2, 0.01, 1.0])
    corner = math.hypot(1.1, 0.01)
    for gap, verdict in ((-1e-5, Verdict.COLLISION), (1e-3, Verdict.FREE)):
        obstacles = Obstacles([wall], torch.tensor([[0.1 + corner + gap, 0.0, 0.0]], dtype=torch.float64))
        assert carrying.certify(q, obstacles, resolution=1e-6).verdict.tolist() == [int(verdict)]
    margin = carrying.trajectory(q[0]).margin if centred else torch.tensor([[0.0, 1.0]])  # a turn alone is an arc
    assert margin is not None and float(margin[0, 1]) > 0.3**2 * 0.4 > float(margin[0, 0]) * 10


def test_planes_are_as_wide_as_the_object_needs(tmp_path: Path) -> None:
    pytest.importorskip("mujoco")
    path = tmp_path / "model.xml"
    body = '<body name="b" pos="0 0 2"><joint type="slide" axis="0 0 1" range="-3 3"/><geom size="0.2"/></body>'
    path.write_text(f'<mujoco><worldbody><geom type="plane" size="1 1 1"/>{body}</worldbody></mujoco>')
    robot = pgccd.robots.load_mjcf(path)
    assert float(robot.meshes[0].vertices.abs().max()) == pytest.approx(1e4)
    q = torch.tensor([[[0.0], [-1.5]]], dtype=torch.float64)
    assert robot.certify(q).free.tolist() == [True]
    for x in (50.0, 15_000.0):
        carrying = robot.attach("b", CUBE, at(x, 0.0, -1.0), name="weight")
        found = carrying.certify(q)
        assert found.verdict.tolist() == [int(Verdict.COLLISION)] and found.names(0) == ("world", "weight")
        assert float(found.time[0]) == pytest.approx(0.95 / 1.5, abs=2e-2 * max(1.0, x / 1e4))
        assert float(carrying.meshes[0].vertices.abs().max()) >= 2 * carrying.reach > 2 * x
        assert torch.equal(carrying.detach("weight").meshes[0].vertices, robot.meshes[0].vertices)


def test_rules_of_mujoco_say_nothing_of_objects(tmp_path: Path) -> None:
    """Bodies and parents, contype and conaffinity, and welds."""
    pytest.importorskip("mujoco")
    path = tmp_path / "model.xml"
    geom = '<geom type="box" size=".1 .1 .1" contype="{}" conaffinity="{}"/>'
    child = f'<body name="child" pos="1 0 0"><joint axis="0 0 1"/>{geom.format(1, 2)}<body name="welded" pos="1 0 0">'
    child += geom.format(4, 4) + "</body></body>"
    body = f'<body name="parent" pos="0 0 5"><joint axis="0 1 0"/>{geom.format(1, 1)}{child}</body>'
    path.write_text(f"<mujoco><worldbody>{geom.format(1, 1)}{body}</worldbody></mujoco>")
    robot = pgccd.robots.load_mjcf(path)
    for k, name in enumerate(robot.link_names):
        if name != "world":
            carrying = robot.attach(name, CUBE, at(0.0))
            assert named(carrying) == named(robot) | {frozenset((name, "attached"))}
            assert len(carrying.exclude) == len(robot.exclude) + 1 and int(carrying.body_link[k]) == k
    welded = robot.attach("child", CUBE, at(1.0), name="box").certify(moved(robot))
    assert welded.verdict.tolist() == [int(Verdict.START)] and welded.names(0) == ("welded", "box")


def state(robot: Robot) -> dict[str, Any]:
    plain = {
        name: getattr(robot, name) for name in ("name", "joint_names", "link_names", "untested", "reach", "attached")
    }
    tensors = {name: getattr(robot, name).tolist() for name in ("lower", "upper", "body_link", "moves", "exclude")}
    return (
        plain
        | tensors
        | {
            "repr": repr(robot),
            "frames": robot._frames,
            "extents": [mesh.reach for mesh in robot.meshes],
            "room": robot._room,
        }
    )


def test_detached(tmp_path: Path) -> None:
    """Everything is as before, what was left out on request included."""
    rng = np.random.default_rng(4)
    asked = [("link0", "link3"), ("link0", "link2"), ("link1", "post"), ("link3", "post")]
    robot = loaded(beams(4), tmp_path).allow(asked)
    assert {(a, b) for a, b, why in robot.untested if why == "allowed"} == set(asked)
    assert {frozenset(pair) for pair in asked[:2]} < named(robot) and len(robot.exclude) == 5
    obstacles, _, _ = boxes(rng, 3, 0.5, 1.2)
    obstacles = Obstacles(obstacles.meshes, obstacles.position, obstacles.orientation, names=["one", "post", "two"])
    q = torch.tensor(paths(rng, robot, 10))
    before = robot.certify(q, obstacles)
    carrying = robot.attach("link2", CUBE, at(0.5), ["link0"], name="a").allow([("a", "post"), ("link3", "a")])
    both = carrying.attach("link1", CUBE, at(0.2, 0.3), ["a"], name="b")
    assert [both.attached, carrying.attached, robot.attached] == [["a", "b"], ["a"], []]
    assert "attached=['a', 'b']" in repr(both) and "attached" not in repr(robot)
    assert set(both.untested) - set(robot.untested) == {
        *(("link0", "a", "touching"), ("link2", "a", "attached"), ("link3", "a", "allowed"), ("a", "post", "allowed")),
        *(("link1", "b", "attached"), ("a", "b", "touching")),
    }
    assert state(both.detach("b")) == state(carrying)
    without_a = both.detach("a")
    assert state(without_a) == state(robot.attach("link1", CUBE, at(0.2, 0.3), name="b"))
    for other in (without_a.detach("b"), both.detach("b").detach("a")):
        assert state(other) == state(robot)
        again = other.certify(q, obstacles)
        for row in range(len(q)):
            same(again[row : row + 1], before, row)
    assert both.certify(q, obstacles).verdict.tolist() != before.verdict.tolist()
    again = without_a.attach("link2", CUBE, at(0.5), name="a")
    assert not {("link0", "a"), ("link3", "a"), ("a", "post"), ("a", "b")} & {(a, b) for a, b, _ in again.untested}


def test_objects_on_objects(tmp_path: Path) -> None:
    """An object is a link to others: it is where it is, and left out only with the one that carries it."""
    robot = loaded(beams(3), tmp_path)
    box = robot.attach("link2", CUBE, ([0.5, 0.0, 0.0], [math.sqrt(0.5), 0.0, 0.0, math.sqrt(0.5)]), name="box")
    lid = box.attach("box", CUBE, at(0.1), name="lid")
    position, orientation = lid.poses(torch.zeros(3))
    np.testing.assert_allclose(position[-2:].numpy(), [[1.3, 0.0, 0.0], [1.3, 0.1, 0.0]], atol=1e-15)
    np.testing.assert_allclose(orientation[-1].numpy(), [math.sqrt(0.5), 0.0, 0.0, math.sqrt(0.5)], atol=1e-15)
    assert lid.untested[-2:] == [("link2", "box", "attached"), ("box", "lid", "attached")]
    with pytest.raises(ValueError, match=r"^name: 'box' carries \['lid'\]: detach these first"):
        lid.detach("box")
    assert state(lid.detach("lid")) == state(box)
    inside = box.attach("box", CUBE, at(0.0, 0.3), name="lid").certify(moved(robot))  # within link2
    assert inside.verdict.tolist() == [int(Verdict.START)] and inside.names(0) == ("link2", "lid")
    assert is_free(box.attach("box", CUBE, at(0.0, 0.3), ["link2"]))


def test_links_without_surfaces_carry(tmp_path: Path) -> None:
    """A tool frame without a surface; what touches it is the hand, which is to be named."""
    hand = Part("revolute", UPRIGHT, UPRIGHT, (0, 0, 1), half=(0.1, 0.1, 0.1))
    robot = loaded(Arm([hand, Part("fixed", (0.1, 0.0, 0.0), UPRIGHT, (1, 0, 0))]), tmp_path)
    assert not is_free(robot.attach("link1", CUBE, at(0.05)))
    carrying = robot.attach("link1", CUBE, at(0.05), ["link0"])
    assert is_free(carrying) and carrying.untested == [("link0", "attached", "touching")]


def test_many_at_once_and_one_by_one(tmp_path: Path) -> None:
    """Environments with obstacles of their own, and the function for planners."""
    rng = np.random.default_rng(5)
    bare = loaded(beams(3), tmp_path)
    large = pgccd.Mesh.box([0.3, 0.4, 0.3])
    robot = bare.attach("link2", large, at(0.6), name="box").allow([("box", "table"), ("link2", "table")])
    meshes, count = [pgccd.Mesh.box([0.3, 0.2, 0.4]), pgccd.Mesh.box([0.5, 0.5, 0.2])], 16
    position = torch.tensor(rng.normal(size=(count, 2, 3)))
    position *= 1.0 / position.norm(dim=2, keepdim=True)
    q = torch.tensor(paths(rng, robot, count, 2))
    whole = robot.certify(q, Obstacles(meshes, position, names=["post", "table"]))
    differs = 0
    for b in range(count):
        own = Obstacles(meshes, position[b], names=["post", "table"])
        same(robot.certify(q[b : b + 1], own), whole, b)
        free = bool(whole.free[b])
        assert robot.motion_validator(own)(*q[b]) == free
        differs += free != bare.motion_validator(own)(*q[b])
    assert differs >= 2 and 2 <= int(whole.free.sum()) <= count - 2
    alone = torch.zeros(0, 2, 3)
    assert len(robot.certify(alone, Obstacles(meshes, names=["post", "table"]))) == 0


def test_samples_know_the_object(tmp_path: Path) -> None:
    robot = loaded(beams(3), tmp_path)
    carrying = robot.attach("link2", CUBE, at(0.0), name="box").allow([("box", "table")])
    sampled = carrying.excluding_sampled(50)
    assert set(sampled.untested) - set(carrying.untested) == {("link1", "box", "sampled")}
    assert state(carrying.detach("box")) == state(sampled.detach("box"))
    assert ("link1", "box", "sampled") in sampled.attach("link0", CUBE, at(0.2, 1.0)).untested


def on_a_table(tmp_path: Path) -> tuple[Robot, Obstacles, torch.Tensor]:
    """A slide that lifts a hand with a box from a table with a post, the way up, and the obstacles."""
    hand = Part("prismatic", (0.0, 0.0, 0.3), UPRIGHT, (0, 0, 1), half=(0.1, 0.1, 0.1))
    robot = loaded(Arm([hand]), tmp_path).attach("link0", CUBE, at(0.0, 0.0, -0.15), name="box")
    meshes = [pgccd.Mesh.box([2.0, 2.0, 0.2]), CUBE]
    places = torch.tensor([[0.0, 0.0, 0.0], [0.0, 0.0, 0.75]], dtype=torch.float64)
    q = torch.tensor([[[0.0], [0.1]], [[0.0], [0.4]], [[0.0], [-0.15]]], dtype=torch.float64)
    return robot, Obstacles(meshes, places, names=["table", "post"]), q


def test_what_may_touch_an_obstacle(tmp_path: Path) -> None:
    """The pair that is named, and no other: neither another obstacle nor another link."""
    robot, obstacles, q = on_a_table(tmp_path)
    found = robot.certify(q, obstacles)
    assert found.verdict.tolist() == [int(Verdict.START)] * 3 and found.names(0) == ("box", "table")
    for pair in (("box", "table"), ["table", "box"]):
        lifting = robot.allow([pair])  # type: ignore[list-item]
        assert lifting.untested == [("link0", "box", "attached"), ("box", "table", "allowed")]
        found = lifting.certify(q, obstacles)
        assert found.verdict.tolist() == [int(v) for v in (Verdict.FREE, Verdict.COLLISION, Verdict.COLLISION)]
        assert found.names(1) == ("link0", "post") and found.names(2) == ("link0", "table")
        assert found.untested == lifting.untested and "untested pairs=2" in repr(lifting)
        hits = pgccd.detect(lifting.scene(obstacles), lifting.trajectory(q[0], obstacles))
        assert len(hits) == 0 and len(pgccd.detect(robot.scene(obstacles), robot.trajectory(q[0], obstacles))) == 1
    for pair in (("box", "post"), ("link0", "table")):
        assert robot.allow([pair]).certify(q, obstacles).verdict.tolist() == [int(Verdict.START)] * 3
    # The obstacles may be in another order, and share a mesh.
    again = Obstacles(
        [obstacles.meshes[1], obstacles.meshes[0]],
        torch.tensor([[5.0, 5.0, 5.0], [0.0, 0.0, 0.75], [0.0, 0.0, 0.0]], dtype=torch.float64),
        mesh_index=[0, 0, 1],
        names=["far", "post", "table"],
    )
    for row in range(3):
        other = lifting.certify(q, again)[row : row + 1]
        assert other.names(0) == found.names(row) and torch.equal(other.time[0], found.time[row])
    assert robot.allow([]).untested == robot.untested
    assert lifting.allow([("box", "table")]).untested == lifting.untested


def test_names_that_are_unknown(tmp_path: Path) -> None:
    robot, obstacles, q = on_a_table(tmp_path)
    tabel = robot.allow([("box", "tabel")])
    message = r"^obstacles: expected one named 'tabel', which `allow` names with 'box', got \['table', 'post'\]"
    calls = [
        lambda given: tabel.certify(q, given),
        lambda given: tabel.scene(given),
        lambda given: tabel.motion_validator(given),
        lambda given: pgccd.robots.certify(tabel, q, given),
    ]
    for call in calls:
        with pytest.raises(ValueError, match=message):
            call(obstacles)
        with pytest.raises(ValueError, match="^obstacles: expected one named 'tabel', .* got none"):
            call(None)
    with pytest.raises(ValueError, match="^obstacles: names: 'box' is the name of a link of the robot"):
        robot.certify(q, Obstacles([CUBE], names=["box"]))
    with pytest.raises(ValueError, match="^pairs: expected a name of a link, such as 'base', in .'tabel', 'post'.$"):
        robot.allow([("box", "table"), ("tabel", "post")])
    for names, error, message in [
        (["a"], ValueError, "names: expected 2, one of each obstacle, got 1"),
        (["a", "a"], ValueError, r"names\[1\]: expected a name that no obstacle before it has, got 'a'"),
        (["a", ""], ValueError, r"names\[1\]: expected a name"),
        (["a", 1], TypeError, r"names\[1\]: expected"),
        ("ab", TypeError, "names: expected a list of names, got"),
        (5, TypeError, "names: expected a list of names, got"),
    ]:
        with pytest.raises(error, match="^" + message):
            Obstacles([CUBE, CUBE], names=names)  # type: ignore[arg-type]
    assert Obstacles([CUBE], torch.zeros(2, 3), mesh_index=[0, 0]).names == ["obstacle 0", "obstacle 1"]


def test_what_cannot_be_attached(tmp_path: Path) -> None:
    arm = Arm([Part("fixed", UPRIGHT, UPRIGHT, (0, 0, 1), half=(0.1,) * 3), *beams(2).parts])
    robot = loaded(arm, tmp_path).attach("link2", CUBE, at(0.2), name="box")
    pose = "pose: expected a position .3,. and an orientation .4,., a unit quaternion"
    cases: list[tuple[tuple[Any, ...], dict[str, Any], type[Exception], str]] = [
        (("hand", CUBE, at(0)), {}, ValueError, "link: expected names of links, such as 'base', got 'hand'"),
        ((3, CUBE, at(0)), {}, ValueError, "link: expected names of links, such as 'base', got 3"),
        (("base", CUBE, at(0)), {}, ValueError, "link: expected a link that joints move, got 'base': what is fixed"),
        (("link0", CUBE, at(0)), {}, ValueError, "link: expected a link that joints move, got 'link0'"),
        (("link2", CUBE.vertices, at(0)), {}, TypeError, "mesh: expected"),
        (("link2", CUBE, at(0), ["hand"]), {}, ValueError, "touching: expected names of links, .* got 'hand'"),
        (
            ("link2", CUBE, at(0), ["table", "link1"]),
            {},
            ValueError,
            "touching: expected names of links, .* got 'table'",
        ),
        (("link2", CUBE, at(0), "link1"), {}, TypeError, "touching: expected a list of names of links, got"),
        (("link2", CUBE, at(0)), {"name": "link1"}, ValueError, "name: expected a name that no link has, got 'link1'"),
        (("link2", CUBE, at(0)), {"name": "box"}, ValueError, "name: expected a name that no link has, got 'box'"),
        (("link2", CUBE, at(0)), {"name": ""}, ValueError, "name: expected a name"),
        (("link2", CUBE, at(0)), {"name": 3}, TypeError, "name: expected"),
        (("link2", CUBE, [0.0, 0.0, 0.0]), {}, TypeError, pose),
        (("link2", CUBE, torch.zeros(2, 4)), {}, TypeError, pose),
        (("link2", CUBE, ([0.0, 0.0], [1.0, 0.0, 0.0, 0.0])), {}, ValueError, pose),
        (("link2", CUBE, ([0.0, 0.0, 0.0], [1.0, 0.0, 0.0])), {}, ValueError, pose),
        (("link2", CUBE, ([0.0, 0.0, 0.0], [1.0, 1.0, 0.0, 0.0])), {}, ValueError, pose),
        (("link2", CUBE, ([0.0, math.nan, 0.0], [1.0, 0.0, 0.0, 0.0])), {}, ValueError, pose),
        (("link2", CUBE, ("abc", [1.0, 0.0, 0.0, 0.0])), {}, TypeError, pose),
        (("link2", CUBE, (torch.zeros(3, requires_grad=True), [1.0, 0, 0, 0])), {}, ValueError, "pose: requires grad"),
    ]
    for given, more, error, message in cases:
        with pytest.raises(error, match="^" + message):
            robot.attach(*given, **more)
    for name in ("link2", "lid", None):
        with pytest.raises(ValueError, match=r"^name: expected an attached object, one of \['box'\], got"):
            robot.detach(name)  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="^name: expected a name that no link has, got 'attached'"):
        robot.attach("link2", CUBE, at(0.2)).attach("link1", CUBE, at(0.2))
    # What is given may be changed afterwards.
    position = np.array([0.5, 0.0, 0.0])
    carrying = robot.detach("box").attach("link2", CUBE, (position, np.array([1.0, 0.0, 0.0, 0.0])))
    before = carrying.allow([]).poses(torch.zeros(2))[0]
    position[0] = 9.0
    assert torch.equal(carrying.attach("link1", CUBE, at(0.0), name="b").detach("b").poses(torch.zeros(2))[0], before)


def test_certificates_have_names_of_obstacles(tmp_path: Path) -> None:
    robot, obstacles, q = on_a_table(tmp_path)
    found = robot.certify(q, obstacles)
    assert Certificate.from_state_dict(found.state_dict(), robot, obstacles).names(0) == ("box", "table")
    assert Certificate.from_state_dict(found.state_dict(), robot).names(0) == ("box", "obstacle 0")
    assert found[:1].names(0) == ("box", "table")
    alone = robot.certify(q)
    assert Certificate.cat([alone, found]).names(3) == Certificate.cat([found, alone]).names(0) == ("box", "table")
    others = robot.certify(q, Obstacles(obstacles.meshes, obstacles.position, names=["post", "table"]))
    for pair in ([found, others], [others, found]):
        with pytest.raises(ValueError, match=r"^results\[\d\]: is of obstacles with other names than"):
            Certificate.cat(pair)
    with pytest.raises(ValueError, match=r"^results\[1\]: is of another robot"):
        Certificate.cat([found, robot.allow([("box", "table")]).certify(q, obstacles)])


def test_links_with_equal_names(tmp_path: Path) -> None:
    """Pairs are told apart by names, so these must differ."""
    pytest.importorskip("mujoco")
    path = tmp_path / "model.xml"
    bodies = '<body name="body 2"><joint/><geom size="0.1"/></body><body pos="1 0 0"><joint/><geom size="0.1"/></body>'
    path.write_text(f"<mujoco><worldbody>{bodies}</worldbody></mujoco>")
    with pytest.raises(
        ValueError, match=r"^path: .*model.xml: links have equal names: \['body 2', 'body 2', 'world'\]"
    ):
        pgccd.robots.load_mjcf(path)
