"""Paths between waypoints, compared with dense samples; and environments that say nothing about others."""

from __future__ import annotations

import math
from dataclasses import replace
from fractions import Fraction
from itertools import combinations
from pathlib import Path

import numpy as np
import pytest
import torch
from oracle.arms import Arm, Part, least_gaps
from support.arms import UPRIGHT, beams, boxes, loaded, part_of, random_arm, stray, untested
from support.cases import mostly_slow

import pgccd
from pgccd import ops
from pgccd.robots import Certificate, Obstacles, Robot, Verdict
from pgccd.robots.path_search import PathSearch

SAMPLES, PATHS = 2001, 6


def compare(arm: Arm, robot: Robot, q: np.ndarray, found: Certificate, frames: np.ndarray, half: np.ndarray) -> None:
    """Compares verdicts and times with samples of every segment: nothing missed, none late, none early."""
    resolution = 1e-3 * robot.reach
    segments, names = q.shape[1] - 1, untested(robot)
    static = [part_of(robot, k) for k in torch.nonzero(~robot.moves).flatten().tolist()]
    assert not static
    s = np.linspace(0.0, 1.0, SAMPLES)[:, None]
    for b in range(len(q)):
        way = [q[b, k] + s * (q[b, k + 1] - q[b, k]) for k in range(segments)]
        gap = np.stack([least_gaps(arm, each, frames, half, names) for each in way])  # (segments, SAMPLES)
        verdict, time = Verdict(int(found.verdict[b])), float(found.time[b])
        touching = np.argwhere(gap <= 0.0)
        if len(touching):
            k, n = touching[0]
            assert verdict != Verdict.FREE, b
            assert time <= (k + n / (SAMPLES - 1)) / segments, b
        if verdict == Verdict.START:
            assert gap[0, 0] <= 1e-9
        elif gap[0, 0] <= -1e-9:
            raise AssertionError(f"{b}: starts in contact")
        if verdict in (Verdict.COLLISION, Verdict.NEAR):
            # A pair comes as near as the resolution there.
            k, toi = int(found.segment[b]), float(found.toi[b])
            around = q[b, k] + np.clip([[toi - 1e-4], [toi], [toi + 1e-4]], 0, 1) * (q[b, k + 1] - q[b, k])
            near = least_gaps(arm, around, frames, half, names)
            assert near.min() <= resolution * 1.1 and near[0] >= -1e-3 * robot.reach, b
        if verdict == Verdict.COLLISION:
            assert gap.min() <= 1e-4 * robot.reach, b


@pytest.mark.parametrize("seed", mostly_slow(range(4), [0, 1]))
def test_nothing_is_missed_and_nothing_late(seed: int, tmp_path: Path) -> None:
    rng = np.random.default_rng(seed)
    arm = beams(5) if seed % 2 else random_arm(rng, 6)
    robot = loaded(arm, tmp_path)
    obstacles, frames, half = boxes(rng, 5, 0.4 * robot.reach, 0.9 * robot.reach)
    start = rng.uniform(-1.2, 1.2, (PATHS, 1, robot.joint_count))
    q = start + np.concatenate(
        [np.zeros_like(start), rng.normal(size=(PATHS, 2, robot.joint_count)).cumsum(axis=1)], axis=1
    )
    found = pgccd.robots.certify(robot, torch.tensor(q), obstacles)
    compare(arm, robot, q, found, frames, half)
    counts = [int((found.verdict == int(verdict)).sum()) for verdict in Verdict]
    assert counts[Verdict.INVALID] == 0 and counts[Verdict.NEAR] <= 3
    assert len(found) == PATHS and found.steps >= PATHS


def apex(tmp_path: Path, gap: float) -> tuple[Robot, torch.Tensor, Obstacles]:
    """A ball at the end of a rod of length 1 that swings by 0.01, and an obstacle that the ball comes as near as `gap`
    half-way; on the straight chord it would pass by 1.25e-5.
    """
    rod = Part("revolute", UPRIGHT, UPRIGHT, (0, 0, 1))
    end = Part("prismatic", (1.0, 0.0, 0.0), UPRIGHT, (1, 0, 0), radius=0.1)
    robot = loaded(Arm([rod, end]), tmp_path)
    q = torch.tensor([[[-0.005, 0.0], [0.005, 0.0]]], dtype=torch.float64)
    wall = pgccd.Mesh.box([0.2, 1.0, 1.0])
    return robot, q, Obstacles([wall], torch.tensor([[1.2 + gap, 0.0, 0.0]], dtype=torch.float64))


def test_the_bound_is_needed(tmp_path: Path) -> None:
    """A ball that touches only where its path bulges out of the chord is found; with a bound of 0.999 of its size, or
    none, it would be missed.
    """
    robot, q, obstacles = apex(tmp_path, -1e-9)
    found = robot.certify(q, obstacles, resolution=1e-7)
    assert found.verdict.tolist() == [int(Verdict.COLLISION)] and abs(float(found.toi[0]) - 0.5) < 0.02
    assert found.names(0) == ("link1", "obstacle 0")


def test_paths_that_come_near(tmp_path: Path) -> None:
    """Free where the gap exceeds the resolution, in words otherwise."""
    robot, q, obstacles = apex(tmp_path, 2e-6)
    assert robot.certify(q, obstacles, resolution=1e-6).free.tolist() == [True]
    found = robot.certify(q, obstacles, resolution=5e-6)
    assert found.verdict.tolist() in ([int(Verdict.NEAR)], [int(Verdict.FREE)])
    found = robot.certify(q, obstacles, resolution=1e-2)
    assert found.verdict.tolist() == [int(Verdict.NEAR)] and 0.0 <= float(found.time[0]) < 1.0
    robot, q, obstacles = apex(tmp_path, -1e-3)
    assert robot.certify(q, obstacles).verdict.tolist() == [int(Verdict.START)]
    assert robot.certify(q, obstacles).names(0) == ("link1", "obstacle 0")


def same(one: Certificate, other: Certificate, row: int) -> None:
    """Whether the only row of `one` is a row of `other`, bit by bit."""
    for name in ("verdict", "time", "segment", "toi", "links", "point"):
        a, b = getattr(one, name)[0].cpu(), getattr(other, name)[row].cpu()
        assert torch.equal(a, b) or (bool(a.isnan().all()) and bool(b.isnan().all())), (name, row)


def test_environments_say_nothing_about_others(tmp_path: Path, device: torch.device) -> None:
    rng = np.random.default_rng(3)
    robot = loaded(beams(4), tmp_path)
    count = 25
    q = torch.tensor(rng.uniform(-0.6, 0.6, (count, 1, 4)) + 0.35 * rng.normal(size=(count, 4, 4)).cumsum(axis=1))
    position = torch.tensor(rng.normal(size=(count, 3, 3)))
    position *= 1.1 / position.norm(dim=2, keepdim=True)
    orientation = torch.tensor([1.0, 0, 0, 0], dtype=torch.float64).expand(count, 3, 4).clone()
    meshes = [pgccd.Mesh.box([0.3, 0.2, 0.4]), pgccd.Mesh.icosphere(0.2, 1), pgccd.Mesh.box([0.1, 0.6, 0.1])]
    whole = robot.certify(q.to(device), Obstacles(meshes, position, orientation))
    for b in range(count):
        obstacles = Obstacles(meshes, position[b], orientation[b])
        same(robot.certify(q[b : b + 1], obstacles), whole, b)
    assert {Verdict.FREE, Verdict.COLLISION} <= {Verdict(v) for v in whole.verdict.tolist()}
    # Invalid and intersecting ones among them change nothing.
    position[3], q[5, 2, 1], q[7, 1, 0], orientation[9, 1] = torch.nan, torch.nan, torch.inf, 0.0
    position[11, 0] = 0.0
    again = robot.certify(q.to(device), Obstacles(meshes, position, orientation))
    for b in (3, 5, 7, 9):
        assert int(again.verdict[b]) == Verdict.INVALID and not bool(again.free[b])
        assert float(again.time[b]) == 0.0 and int(again.segment[b]) == -1 and again.names(b) == ()
    assert int(again.verdict[11]) == Verdict.START and again.names(11)[1] == "obstacle 0"
    for b in set(range(count)) - {3, 5, 7, 9, 11}:
        same(again_row(again, b), whole, b)


def again_row(found: Certificate, b: int) -> Certificate:
    columns = {
        name: getattr(found, name)[b : b + 1] for name in ("verdict", "time", "segment", "toi", "links", "point")
    }
    return Certificate(**columns, link_names=found.link_names)


def test_threads_change_nothing(tmp_path: Path) -> None:
    rng = np.random.default_rng(5)
    robot = loaded(beams(4), tmp_path)
    obstacles, _, _ = boxes(rng, 3, 0.5, 1.2)
    q = torch.tensor(rng.uniform(-1, 1, (40, 5, 4)))
    threads, found = torch.get_num_threads(), []
    for count in (1, 3):
        torch.set_num_threads(count)
        found.append(robot.certify(q, obstacles))
    torch.set_num_threads(threads)
    for b in range(40):
        same(again_row(found[1], b), found[0], b)


def test_a_validator_of_motions(tmp_path: Path) -> None:
    rng = np.random.default_rng(6)
    robot = loaded(beams(4), tmp_path)
    obstacles, _, _ = boxes(rng, 3, 0.5, 1.2)
    is_valid = robot.motion_validator(obstacles)
    ends = rng.uniform(-1, 1, (20, 2, 4))
    free = robot.certify(torch.tensor(ends), obstacles).free.tolist()
    assert [is_valid(a.tolist(), torch.tensor(b)) for a, b in ends] == free
    assert 0 < sum(free) < 20
    assert is_valid([float("nan")] * 4, [0.0] * 4) is False
    with pytest.raises(ValueError, match=r"^goal: expected shape \(4,\)"):
        is_valid([0.0] * 4, [0.0] * 3)
    mesh = pgccd.Mesh.box([0.1, 0.1, 0.1])
    with pytest.raises(ValueError, match="^obstacles: expected obstacles of one environment, .* got 3 environments"):
        robot.motion_validator(Obstacles([mesh], torch.full((3, 1, 3), 5.0)))
    assert robot.motion_validator(Obstacles([mesh], torch.full((1, 1, 3), 5.0)))([0.0] * 4, [0.1] * 4)


def test_near_only_within_the_resolution(tmp_path: Path) -> None:
    """A wall that the margins of a long step reach at its very end, where they are 0.1, is not near."""
    robot, _, _ = apex(tmp_path, 0.0)
    q = torch.tensor([[[-0.45, 0.0], [0.45, 0.0]]], dtype=torch.float64)
    margin = robot.trajectory(q[0]).margin
    assert margin is not None and float(margin[0, 0]) > 0.1
    wall = pgccd.Mesh.box([4.0, 0.2, 4.0])
    for part in (-0.4, 0.0, 0.4, 0.8):
        y = np.sin(0.45) + 0.2 + float(margin[0, 0]) + part * 0.125e-3
        obstacles = Obstacles([wall], torch.tensor([[0.0, y, 0.0]], dtype=torch.float64))
        assert bool(robot.certify(q, obstacles, resolution=1e-3).free[0]), part


def test_rounding_between_far_waypoints(tmp_path: Path) -> None:
    """Configurations near zero on the way between large ones are as inexact as these: margins are made for that."""
    robot = loaded(Arm([Part("prismatic", UPRIGHT, UPRIGHT, (1, 0, 0), radius=0.1)]), tmp_path)
    q = np.array([[-987654.3210123], [987645.678912]])
    first, last = (Fraction(x) for x in q.flatten().tolist())
    for s in np.linspace(0.5 - 1e-5, 0.5 + 1e-5, 101).tolist():
        exact = first + Fraction(s) * (last - first)
        error = abs(float(exact - Fraction(float(q[0, 0] + s * (q[1, 0] - q[0, 0])))))
        margin = float(stray(robot, q[:1], q[1:], s, s)[0, 0])
        assert error <= 5.0 * 2.0**-53 * 987654.33 and margin > 128.0 * 2.0**-53 * 3.0 * 987654.32


def test_values_of_joints_that_are_too_large(tmp_path: Path) -> None:
    """Also of a joint that mimics another by a large factor: invalid in its environment alone."""
    hinge = Part("revolute", UPRIGHT, UPRIGHT, (0, 0, 1), half=(0.1, 0.1, 0.1))
    geared = Part("revolute", (1.0, 0, 0), UPRIGHT, (0, 0, 1), half=(0.1, 0.1, 0.1), mimic=(0, 1e5, 0.0))
    robot = loaded(Arm([hinge, geared]), tmp_path)
    q = torch.zeros(3, 2, 1, dtype=torch.float64)
    q[1], q[2] = 11.0, 9.0
    found = robot.certify(q)
    assert found.verdict.tolist() == [Verdict.FREE, Verdict.INVALID, Verdict.FREE]
    same(robot.certify(q[2:]), found, 2)
    with pytest.raises(ValueError, match=r"^q: waypoint 0: expected joint values of at most 1e\+06, got \[11\.0\]"):
        robot.trajectory(q[1])


def test_turns_that_are_too_long(tmp_path: Path) -> None:
    """The first parts of a segment are as many as its radians: too many are invalid in their environment alone."""
    hinge = Part("revolute", UPRIGHT, UPRIGHT, (0, 0, 1), half=(0.1, 0.1, 0.1))
    robot = loaded(Arm([hinge]), tmp_path)
    q = torch.zeros(4, 3, 1, dtype=torch.float64)
    q[1, 2], q[2, 1:], q[3, 1], q[3, 2] = 1e4, 9.9e3, -6e3, 6e3
    found = robot.certify(q)
    assert found.verdict.tolist() == [Verdict.FREE, Verdict.INVALID, Verdict.FREE, Verdict.INVALID]
    assert found.time[found.verdict == Verdict.INVALID].tolist() == [0.0, 0.0]
    same(robot.certify(q[2:3]), found, 2)


def test_links_that_turn_far_between_waypoints(tmp_path: Path) -> None:
    """The longer way round is searched, not the shorter one between the same poses, and the whole of several turns."""
    beam = Part("revolute", UPRIGHT, UPRIGHT, (0, 0, 1), half=(0.5, 0.05, 0.05), at=(0.5, 0.0, 0.0))
    robot = loaded(Arm([beam]), tmp_path)
    post, way, within = pgccd.Mesh.box([0.05, 0.05, 1.0]), [], []
    for turn in (*np.linspace(2.0, 4.0, 21), 5.9, 6.5, 7.9, 9.5, 12.6, 15.5):
        for sign in (1.0, -1.0):
            way.append([[0.0], [sign * turn]])
            # A post in the middle of the way, or of its first turn.
            within.append(sign * min(0.5 * turn, math.pi))
    at = torch.tensor([[[0.8 * math.cos(angle), 0.8 * math.sin(angle), 0.0]] for angle in within])
    found = robot.certify(torch.tensor(way), Obstacles([post], at))
    assert found.verdict.tolist() == [int(Verdict.COLLISION)] * len(way)
    for (_, (end,)), angle, time in zip(way, within, found.time.tolist(), strict=True):
        # The beam's side and the post's corner are ahead of both centres.
        assert 0.0 < (angle - time * end) * math.copysign(1.0, end) < 0.15


def test_links_turn_little_in_every_span(tmp_path: Path) -> None:
    """The proof of the bound is for links that turn by at most one radian in a part of a segment, the turns of all
    joints added. Free paths are searched in no other parts than those that follow from it.
    """
    for seed in range(6):
        rng = np.random.default_rng(seed)
        robot = loaded(random_arm(rng, 6), tmp_path)
        search = PathSearch(robot.allow(combinations(robot.link_names, 2)), None, None)
        q = torch.tensor(rng.normal(size=(4, 4, robot.joint_count)) * 10.0 ** rng.uniform(-1, 1, (4, 1, 1)))
        mesh_set, bodies, obstacles = search._tensors_on(q.device)
        arm = robot._tables.on(q.device)
        *_, counts = ops.certify_paths(mesh_set, arm, bodies, obstacles, False, robot._room, q, 1, 0.0, 1e-3)
        joints = robot._tree.joints
        turn = np.zeros((4, 3))
        for frame in robot._frames:
            chain = [joints[k] for k in robot._tree.chains[frame] if joints[k].kind == "revolute"]
            steps = [abs(joint.scale) * q.diff(dim=1)[..., joint.coordinate].abs().numpy() for joint in chain]
            turn = np.maximum(turn, sum(steps, np.zeros((4, 3))))
        assert turn.max() > 4.0 and counts[:, 0].tolist() == np.ceil(turn / 0.99).clip(1.0).sum(axis=1).tolist()


def test_arrays_and_gradients(tmp_path: Path) -> None:
    """Arrays of NumPy are taken; what requires grad is refused where no gradient is computed."""
    robot = loaded(beams(2), tmp_path)
    q = torch.zeros(1, 2, 2, dtype=torch.float64)
    mesh, at = pgccd.Mesh.box([1.0, 1.0, 1.0]), np.full((1, 3), 5.0)
    same(robot.certify(q.numpy(), Obstacles([mesh], at)), robot.certify(q, Obstacles([mesh], torch.tensor(at))), 0)  # type: ignore[arg-type]
    # One path, and lists.
    for given in (q[0], q.tolist(), q[0].tolist()):
        same(robot.certify(given), robot.certify(q), 0)  # type: ignore[arg-type]
        assert len(robot.clearance(given, Obstacles([mesh], at)).lower) == 1  # type: ignore[arg-type]
    wanting = q.clone().requires_grad_()
    calls = {
        "q": [lambda: robot.certify(wanting), lambda: robot.trajectory(wanting[0])],
        "position": [lambda: Obstacles([mesh], torch.tensor(at, requires_grad=True))],
        "margin": [lambda: robot.certify(q, Obstacles([mesh], margin=torch.tensor(0.1, requires_grad=True)))],
        "start": [lambda: robot.motion_validator()(wanting[0, 0], q[0, 0])],
    }
    for name, each in calls.items():
        for call in each:
            with pytest.raises(ValueError, match=f"^{name}: requires grad"):
                call()
            with torch.no_grad():
                call()


def test_links_meet_each_other(tmp_path: Path) -> None:
    """A chain that folds back onto itself, and large steps, which are split before they are tested."""
    flat = Arm([replace(part, axis=(0.0, 0.0, 1.0)) for part in beams(4).parts])
    robot = loaded(flat, tmp_path)
    q = torch.zeros(1, 2, 4, dtype=torch.float64)
    q[0, 1, 1:] = 1.65
    found = robot.certify(q)
    assert found.verdict.tolist() == [int(Verdict.COLLISION)]
    assert found.names(0) == ("link0", "link3") and found.steps > 3
    assert bool(robot.allow([found.names(0)]).certify(q).free[0])


def test_scene_and_trajectory_are_those_of_the_certificate(tmp_path: Path) -> None:
    """What `detect` finds with the margins is never later than a contact, and free where it finds nothing."""
    rng = np.random.default_rng(8)
    arm = beams(4)
    robot = loaded(arm, tmp_path)
    obstacles, frames, half = boxes(rng, 4, 0.4, 1.3)
    for _ in range(6):
        q = rng.uniform(-1, 1, 4) + np.linspace(0, 1, 12)[:, None] * rng.uniform(-1, 1, 4)
        hits = pgccd.detect(robot.scene(obstacles), robot.trajectory(torch.tensor(q), obstacles))
        found = robot.certify(torch.tensor(q)[None], obstacles)
        if len(hits) == 0:
            assert bool(found.free[0])
        else:
            assert float(hits.first_toi()) <= float(found.time[0]) + 1e-3


def test_what_cannot_be_certified(tmp_path: Path) -> None:
    robot = loaded(beams(2), tmp_path)
    q = torch.zeros(1, 2, 2)
    table = Obstacles([pgccd.Mesh.box([1.0, 1.0, 1.0])], torch.full((3, 1, 3), 5.0))
    cases = [
        (
            (robot, q[0, 0]),
            {},
            ValueError,
            r"q: expected waypoints \(T, 2\) or \(B, T, 2\) with T >= 2, got shape \(2,\)",
        ),
        ((robot, q[:, :1]), {}, ValueError, r"q: expected waypoints \(T, 2\) or \(B, T, 2\) with T >= 2"),
        ((robot, "q"), {}, TypeError, "q: expected waypoints"),
        ((robot, q, table), {}, ValueError, "q: expected 3 environments, as the obstacles have, got 1"),
        ((robot, q), {"resolution": 0.0}, ValueError, "resolution: expected a length > 0"),
        ((robot, q, q), {}, TypeError, "obstacles: expected pgccd.robots.Obstacles"),
        ((q, q), {}, TypeError, "robot: expected a pgccd.robots.Robot"),
    ]
    for arguments, more, error, message in cases:
        with pytest.raises(error, match="^" + message):
            pgccd.robots.certify(*arguments, **more)  # type: ignore[arg-type]
    mesh = pgccd.Mesh.box([1.0, 1.0, 1.0])
    for given, message in [
        (([mesh], torch.zeros(2, 3)), r"position: expected shape \(1, 3\) or \(B, 1, 3\)"),
        (([mesh], torch.zeros(2, 3)), "position: .* a row for each entry of mesh_index or else each mesh; got"),
        (([],), "meshes: expected one mesh or more, got none"),
        (([mesh], torch.full((1, 3), torch.nan)), "position, orientation: expected finite"),
        (([mesh], torch.zeros(2, 1, 3), torch.ones(3, 1, 4)), "orientation: expected as many environments"),
    ]:
        with pytest.raises(ValueError, match="^" + message):
            Obstacles(*given)  # type: ignore[arg-type]
    assert len(robot.certify(torch.zeros(0, 3, 2))) == 0


@pytest.mark.slow
@pytest.mark.timeout(600)
def test_a_thousand_paths_of_64_waypoints(tmp_path: Path, device: torch.device) -> None:
    rng = np.random.default_rng(9)
    robot = loaded(beams(6), tmp_path)
    obstacles, _, _ = boxes(rng, 4, 0.8, 2.0)
    ends = rng.uniform(-1.2, 1.2, (2, 1000, 1, 6))
    q = torch.tensor(ends[0] + np.linspace(0.0, 1.0, 64)[:, None] * (ends[1] - ends[0]), device=device)
    found = robot.certify(q, obstacles)
    counts = [int((found.verdict == int(verdict)).sum()) for verdict in Verdict]
    assert counts[Verdict.FREE] > 300 and counts[Verdict.COLLISION] > 10 and counts[Verdict.INVALID] == 0
    for b in range(0, 1000, 50):
        same(robot.certify(q[b : b + 1], obstacles), found, b)


def test_robots_without_joints(tmp_path: Path) -> None:
    """A path of theirs is a rest: there are no numbers to ask for."""
    pytest.importorskip("yourdfpy")
    path = tmp_path / "block.urdf"
    box = '<collision><geometry><box size="1 1 1"/></geometry></collision>'
    path.write_text(f'<robot name="block"><link name="a">{box}</link></robot>')
    robot = pgccd.robots.load_urdf(path)
    obstacles = pgccd.robots.Obstacles([pgccd.Mesh.box([1.0, 1.0, 1.0])], torch.tensor([[3.0, 0.0, 0.0]]))
    for environments in (0, 2):
        found = robot.certify(torch.zeros(environments, 3, 0), obstacles)
        assert found.verdict.tolist() == [Verdict.FREE] * environments
    trajectory = robot.trajectory(torch.zeros(3, 0), obstacles)
    assert not len(pgccd.detect(robot.scene(obstacles), trajectory))


def test_rows_of_certificates(tmp_path: Path) -> None:
    robot = loaded(beams(2), tmp_path)
    obstacles, _, _ = boxes(np.random.default_rng(3), 3, 0.4, 1.5)
    q = torch.tensor(np.random.default_rng(4).uniform(-2.0, 2.0, (12, 3, 2)))
    found = robot.certify(q, obstacles)
    again = pgccd.robots.Certificate.from_state_dict(found.state_dict(), robot)
    blocked = found[~found.free]
    assert 0 < len(blocked) < 12 and blocked.link_names == again.link_names == robot.link_names
    for name, column in found.columns.items():
        assert torch.equal(getattr(again, name).nan_to_num(9), column.nan_to_num(9)), name
        assert torch.equal(getattr(blocked, name).nan_to_num(9), column[~found.free].nan_to_num(9)), name
    with pytest.raises(TypeError, match="^verdict: expected torch.int8"):
        pgccd.robots.Certificate.from_state_dict(found.state_dict() | {"verdict": found.verdict.long()}, robot)
