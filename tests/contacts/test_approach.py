"""Contacts that approach: nothing is left out that does, and what rests, slides or recedes hides nothing."""

from __future__ import annotations

import math
import weakref
from dataclasses import replace
from typing import Any

import pytest
import torch
from support.random_scenes import random_scene
from support.resting import KINDS, UPRIGHT, Kind, box, gap_of_boxes, joined, sheet, sliding
from support.same_bits import bits
from torch import Tensor

import pgccd
from pgccd.runtime.sizes import Capacity

CUBE = box((0.5, 0.5, 0.5))
FLOOR = box((10, 10, 0.5), (0, 0, -0.5))
ROOM = joined(FLOOR, box((0.5, 10, 3), (5, 0, 3)))  # the wall is met after 4
# Gap at rest, separation.
RESTS = [(0.0, 0.0), (1e-9, 0.0), (1e-4, 2e-4)]


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize(("gap", "separation"), RESTS)
def test_a_wall_of_the_floor_that_a_body_rests_on(
    kind: Kind, gap: float, separation: float, device: torch.device
) -> None:
    scene, motion = sliding(kind, [CUBE, ROOM], (0, 0, 0.5 + gap), (8.0, 0, 0), device)
    for report, options in (("first", {}), ("first", {"normals": "surface", "nonzero_toi": True}), ("all", {})):
        hits = pgccd.detect(scene, motion, report, separation, **options)  # type: ignore[call-overload]
        assert gap == 1e-9 or "normals" in options or float(hits.first_toi()) == 0.0
        ahead = pgccd.approaching(scene, motion, hits)
        assert abs(float(ahead.first_toi()) - (4.0 - separation) / 8.0) < 1e-6
        assert ahead.stats.contacts == len(ahead) <= len(hits)
        first = ahead.earliest()
        assert float(pgccd.approach_rates(scene, motion, first)) == pytest.approx(8.0, abs=1e-6)
        if report == "first":
            assert ahead.pairs.tolist() == [[0, 1]] and ahead == pgccd.approaching(scene, motion, ahead)
        if "normals" in options:
            assert (first.normal.cpu() == torch.tensor([1.0, 0, 0]).double()).all()


def test_only_the_pairs_that_rest_are_searched_again(device: torch.device) -> None:
    """Of many bodies those in the air, at rest, and sliding into a wall; the order of pairs is kept."""
    scene = pgccd.Scene([CUBE, ROOM], [0, 1, 0, 0, 0], static=[False, True, False, False, False], device=device)
    x = torch.tensor([[0.0, 0, 0.5], [0, 0, 0], [-3, 3, 2.0], [-3, -3, 0.5], [0, 5, 0.5]], device=device).double()
    v = torch.tensor([[8.0, 0, 0], [0, 0, 0], [0, 0, -2.0], [0.2, 0, 0], [0, 0, 1.0]], device=device).double()
    q = torch.tensor([UPRIGHT] * 5, device=device).double()
    motion = pgccd.RigidMotion.from_velocity(x, q, v, torch.zeros_like(x), 1.0)
    hits = pgccd.detect(scene, motion)
    assert hits.pairs.tolist() == [[0, 1], [1, 2], [1, 3], [1, 4]]
    ahead = pgccd.approaching(scene, motion, hits)
    assert ahead.pairs.tolist() == [[0, 1], [1, 2]]
    assert ahead.toi.tolist() == pytest.approx([0.5, 0.75], abs=1e-6)
    assert ahead[1:] == hits[1:2]
    assert pgccd.approaching(scene, motion, hits[2:]).pairs.tolist() == []
    assert ahead.first_toi("body").tolist()[2:] == [pytest.approx(0.75, abs=1e-6), math.inf, math.inf]


def test_along_a_trajectory(device: torch.device) -> None:
    """At rest in the first segment; the wall is in the second."""
    scene = pgccd.Scene([CUBE, ROOM], static=[False, True], device=device)
    x = torch.zeros(4, 2, 3, dtype=torch.float64)
    x[:, 0] = torch.tensor([[0.0, 0, 0.5], [2, 0, 0.5], [6, 0, 0.5], [6, 0, 0.4]])
    q = torch.tensor([UPRIGHT] * 2, dtype=torch.float64).expand(4, -1, -1).contiguous()
    trajectory = pgccd.Trajectory(x.to(device), q.to(device))
    hits = pgccd.detect(scene, trajectory)
    assert float(hits.first_toi()) == 0.0
    ahead = pgccd.approaching(scene, trajectory, hits)
    assert isinstance(ahead, pgccd.TrajectoryContacts)
    assert ahead.segment.tolist() == [1] and float(ahead.toi[0]) == pytest.approx(0.5, abs=1e-6)
    assert float(ahead.first_toi()) == pytest.approx(0.5, abs=1e-6)
    assert pgccd.approach_rates(scene, trajectory, ahead).tolist() == pytest.approx([4.0])
    every = pgccd.approaching(scene, trajectory, pgccd.detect(scene, trajectory, "all"))
    assert set(every.segment.tolist()) == {1, 2} and every.first_toi() == ahead.first_toi()


def random_rests(count: int, seed: int) -> tuple[pgccd.Scene, pgccd.RigidMotion, Tensor]:
    """Boxes that rest on larger ones, in any direction, and slide, lift off, sink, turn and tumble; half edges."""
    random = torch.Generator().manual_seed(seed)

    def normal(*shape: int) -> Tensor:
        return torch.randn(*shape, generator=random, dtype=torch.float64)

    def one_of(*values: float) -> Tensor:
        return torch.tensor(values, dtype=torch.float64)[torch.randint(len(values), (count,), generator=random)]

    halves = torch.tensor([[0.5, 0.4, 0.3], [2.0, 2.0, 0.5]], dtype=torch.float64)
    frame = torch.nn.functional.normalize(normal(count, 4))
    frame[: count // 2] = torch.tensor(UPRIGHT).double()
    yaw = one_of(0.0, 0.3, 1.2)
    own = torch.stack([torch.cos(yaw / 2), 0 * yaw, 0 * yaw, torch.sin(yaw / 2)], 1)
    offset = 1.4 * (2 * torch.rand(count, 3, generator=random, dtype=torch.float64) - 1)
    offset[:, 2] = 0.8 + one_of(0.0, 0.0, 1e-9, 1e-7, 3e-7)
    kind = torch.arange(count) % 6
    v, w = normal(count, 3), torch.zeros(count, 3, dtype=torch.float64)
    v[:, 2] = torch.where(kind == 1, v[:, 2].abs(), torch.where(kind == 2, -v[:, 2].abs() * one_of(1e-7, 1e-3, 1), 0.0))
    w[:, 2] = torch.where(kind == 3, 3 * normal(count), 0.0)
    tumbling = (kind == 4)[:, None]
    scale = one_of(1e-6, 1e-3, 1.0, 3.0)[:, None]
    w, v = torch.where(tumbling, scale * normal(count, 3), w), torch.where(tumbling, scale * v.abs(), v)
    free = (kind == 5)[:, None]
    w, v = torch.where(free, 3 * normal(count, 3), w), torch.where(free, normal(count, 3), v)
    turn = _matrices(frame)
    offset, v, w = ((turn @ each[:, :, None])[:, :, 0] for each in (offset, v, w))
    centre, drift = normal(count, 3), normal(count, 3)
    below = one_of(0.0, 0.0, 1e-6, 0.1)[:, None] * normal(count, 3)

    def pairs(one: Tensor, other: Tensor) -> Tensor:
        return torch.stack([one, other], 1).flatten(0, 1)

    scene = pgccd.Scene(
        [box(tuple(half.tolist())) for half in halves],  # type: ignore[arg-type]
        [0, 1] * count,
        world=torch.arange(count).repeat_interleave(2),
    )
    q = pairs(_product(frame, own), frame)
    motion = pgccd.RigidMotion.from_velocity(
        pairs(centre + offset, centre), q, pairs(v + drift, drift), pairs(w, below), 1.0
    )
    return scene, motion, halves


@pytest.mark.parametrize("seed", range(2))
def test_nothing_that_approaches_is_left_out(seed: int) -> None:
    """Until the first contact that approaches, boxes are nowhere deeper in one another than the slack."""
    count, samples = 60, 61
    scene, motion, halves = random_rests(count, seed)
    times = torch.linspace(0.0, 1.0, samples, dtype=torch.float64)
    position, orientation = motion.at(times[:, None])
    rotations = _matrices(orientation.flatten(0, 1)).view(-1, 2, 3, 3)
    gap = gap_of_boxes(rotations, position.view(-1, 2, 3), halves).view(samples, count)
    slack = 1e-6 * float(scene.meshes.radius[0])
    for report in ("first", "all"):
        hits = pgccd.detect(scene, motion, report)  # type: ignore[call-overload]
        ahead = pgccd.approaching(scene, motion, hits)
        until = ahead.first_toi("body")[::2]
        before = times[:, None] <= until
        assert torch.where(before, gap, 1.0).min() > -2.0 * slack
        # Most of those that never are deeper have none.
        rests = (gap.amin(0) > -1e-9) & torch.isin(torch.arange(count), hits.pairs[:, 0] // 2)
        assert int(rests.sum()) > 8 and float((until[rests] == math.inf).double().mean()) > 0.3


def pendulum(start: float, rate: float, lift: float, device: torch.device) -> tuple[pgccd.Scene, pgccd.RigidMotion]:
    """A tip, on a sheet at z = 0, on a circle of radius 1: `start` radians past its lowest point, or for rate < 0 past
    its highest.
    """
    radius = -1.0 if rate > 0.0 else 1.0
    tip = torch.tensor([[0.0, 0, 0], [0.02, 0.0, 0.3], [-0.01, 0.02, 0.3], [-0.01, -0.02, 0.3]], dtype=torch.float64)
    turn = _matrices(torch.tensor([[math.cos(start / 2), 0.0, -math.sin(start / 2), 0.0]], dtype=torch.float64))[0]
    # So that the tip is at the lowest (highest) point of its circle at start 0, and on the sheet at t = 0.
    mesh = pgccd.Mesh(tip @ turn + torch.tensor([0.0, 0, radius]), [[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]])
    place = (
        torch.tensor([0.13, 0.21, 0.0], dtype=torch.float64)
        - torch.tensor([0.0, 0, radius], dtype=torch.float64) @ turn.T
    )
    scene = pgccd.Scene([mesh, sheet(4, 3.0)], static=[False, True], device=device)
    x = torch.stack([place, torch.zeros(3).double()])
    q = torch.tensor([[math.cos(start / 2), 0.0, -math.sin(start / 2), 0.0], UPRIGHT], dtype=torch.float64)
    v = torch.tensor([[0.0, 0, lift], [0, 0, 0]], dtype=torch.float64)
    w = torch.tensor([[0.0, -abs(rate), 0], [0, 0, 0]], dtype=torch.float64)
    return scene, pgccd.RigidMotion.from_velocity(*(c.to(device) for c in (x, q, v, w)), dt=1.0)


def test_what_comes_back_later_is_kept(device: torch.device) -> None:
    """A tip that recedes at first, comes round in a circle, and is 0.3 lower then; its row is at t = 0."""
    scene, motion = pendulum(0.1, 2 * math.pi, -0.3, device)
    hits = pgccd.detect(scene, motion)
    assert hits.toi.tolist() == [0.0] and float(pgccd.approach_rates(scene, motion, hits)) < -0.2
    assert pgccd.approaching(scene, motion, hits).toi.tolist() == [0.0]
    # As high as it was, it is left out.
    scene, motion = pendulum(0.1, 0.5, 0.0, device)
    hits = pgccd.detect(scene, motion)
    assert hits.toi.tolist() == [0.0] and len(pgccd.approaching(scene, motion, hits)) == 0


def test_curved_paths_whose_rate_is_zero(device: torch.device) -> None:
    """At the lowest point of its circle a tip leaves the sheet, at the highest one it goes through."""
    for rate, count in ((1.0, 0), (-1.0, 1)):
        scene, motion = pendulum(0.0, rate, 0.0, device)
        hits = pgccd.detect(scene, motion)
        assert hits.toi.tolist() == [0.0] and pgccd.approach_rates(scene, motion, hits).tolist() == pytest.approx(
            [0.0], abs=1e-12
        )
        assert len(pgccd.approaching(scene, motion, hits)) == count


def test_what_passes_between_the_ends_of_windows(device: torch.device) -> None:
    """Sixteen turns: after each the tip is where it was, and in between it is below the sheet."""
    scene, motion = pendulum(0.0, -32 * math.pi, 0.0, device)
    assert pgccd.approaching(scene, motion, pgccd.detect(scene, motion)).toi.tolist() == [0.0]


def test_the_slack_on_curved_paths(device: torch.device) -> None:
    """The middle of the first of 16 windows is the lowest point of a tip's circle."""
    angle = 0.1
    scene, motion = pendulum(-angle, 32 * angle, 0.0, device)
    hits = pgccd.detect(scene, motion)
    depth = 1.0 - math.cos(angle)
    assert hits.toi.tolist() == [0.0]
    assert (
        len(pgccd.approaching(scene, motion, hits, depth - 1e-5)) == 1
        and len(pgccd.approaching(scene, motion, hits, depth + 1e-5)) == 0
    )


def test_a_tip_that_turns_and_sinks(device: torch.device) -> None:
    """Lowest midway: its body sinks while it turns up, so that the tip is above the floor again at the end."""
    angle, sinks = 0.566, 1.5
    corners = torch.tensor([[0.0, -10.0, 0.0], [0.1, 0.0, -0.1], [-0.1, 0.0, -0.1], [0.0, 0.0, 0.1]])
    needle = pgccd.Mesh(corners.double(), torch.tensor([[0, 1, 2], [0, 2, 3], [0, 3, 1], [1, 3, 2]]))
    scene = pgccd.Scene([needle, pgccd.Mesh.box([30.0, 1.0, 30.0])], [0, 1], device=device)
    start = torch.tensor([[0.0, 10.0, 0.0], [0.0, -0.5, 0.0]], dtype=torch.float64)
    down, turn = torch.zeros(2, 2, 3, dtype=torch.float64)
    down[0, 1], turn[0, 2] = -sinks, angle
    upright = torch.tensor([[1.0, 0.0, 0.0, 0.0]] * 2, dtype=torch.float64)
    motion = pgccd.RigidMotion.from_rotation(start, upright, start + down, turn).to(device)
    hits = pgccd.detect(scene, motion)
    assert hits.toi.tolist() == [0.0]
    lowest = math.asin(sinks / (10.0 * angle)) / angle
    depth = sinks * lowest - 10.0 * (1.0 - math.cos(angle * lowest))
    assert [len(pgccd.approaching(scene, motion, hits, part * depth)) for part in (0.6, 0.99, 1.02)] == [1, 1, 0]


def test_the_end_of_curved_paths(device: torch.device) -> None:
    """A tip sinks on its circle until the end of the step, no longer; or until just before."""
    scene, motion = pendulum(0.0, -0.5, 0.0, device)
    hits = pgccd.detect(scene, motion)
    depth = 1.0 - math.cos(0.5)
    assert hits.toi.tolist() == [0.0]
    assert (
        len(pgccd.approaching(scene, motion, hits, (1.0 - 1e-6) * depth)) == 1
        and len(pgccd.approaching(scene, motion, hits, (1.0 + 1e-6) * depth)) == 0
    )
    # Lowest in the middle of the last of 16 windows; at the end it is higher by 1.3e-4.
    angle = 0.5
    scene, motion = pendulum(-angle, angle * 32.0 / 31.0, 0.0, device)
    hits = pgccd.detect(scene, motion)
    depth = 1.0 - math.cos(angle)
    assert hits.toi.tolist() == [0.0]
    assert (
        len(pgccd.approaching(scene, motion, hits, depth - 1e-5)) == 1
        and len(pgccd.approaching(scene, motion, hits, depth + 1e-5)) == 0
    )


def test_flat_surfaces_that_pass_through_one_another() -> None:
    """Nothing around the contacts says on which side they are, only that they are apart at toi, or were before."""
    for turned_over in (False, True):
        for travel in (1.0, -1.0):
            meshes = [sheet(3, 1.0, turned_over), sheet(4, 3.0)]
            scene, motion = sliding("rigid", meshes, (0.1, 0.2, -1e-4 * travel), (0.1, 0, travel))
            hits = pgccd.detect(scene, motion)
            assert len(hits) == 1 and float(hits.toi) > 0.0
            assert len(pgccd.approaching(scene, motion, hits)) == 1
        # Apart at toi by less than the slack: in the opposite direction they stay that near.
        scene, motion = sliding("rigid", meshes, (0.1, 0.2, 1e-6), (0.1, 0, -1e-3))
        hits = pgccd.detect(scene, motion, min_separation=2e-6)
        assert hits.toi.tolist() == [0.0] and len(pgccd.approaching(scene, motion, hits, 1e-5)) == 1


def test_the_slack(device: torch.device) -> None:
    for gap in (0.4, 0.0):
        scene, motion = sliding("rigid", [CUBE, FLOOR], (0, 0, 0.5 + gap), (1.0, 0, -1e-3), device)
        hits = pgccd.detect(scene, motion, min_separation=2.0 * gap)
        assert (
            len(pgccd.approaching(scene, motion, hits, (1.0 + 1e-6) * 1e-3)) == 0
            and len(pgccd.approaching(scene, motion, hits, (1.0 - 1e-6) * 1e-3)) == 1
        )
    assert len(pgccd.approaching(scene, motion, pgccd.detect(scene, motion, tolerance=1.01e-3))) == 0
    # Nothing is certain to the last bit.
    scene, motion = sliding("rigid", [CUBE, FLOOR], (0, 0, 0.5), (1.0, 0, 0.0), device)
    hits = pgccd.detect(scene, motion)
    assert (
        len(pgccd.approaching(scene, motion, hits, 0.0)) == 1
        and len(pgccd.approaching(scene, motion, hits, 1e-11)) == 0
    )
    with pytest.raises(ValueError, match="slack: expected"):
        pgccd.approaching(scene, motion, hits, -1.0)


def test_from_where_a_sheet_is_left() -> None:
    """A cube on a sheet recedes from the side that it is on, and only from there."""
    for turned_over in (False, True):
        for z in (0.5, -0.5):
            for travel in (1.0, -1.0):
                floor = sheet(4, 3.0, turned_over)
                scene, motion = sliding("rigid", [CUBE, floor], (0.1, 0.2, z), (0.3, 0, travel))
                count = len(pgccd.approaching(scene, motion, pgccd.detect(scene, motion)))
                assert count == (travel * z < 0.0), (turned_over, z, travel)


@pytest.mark.parametrize("kind", KINDS)
def test_rates_of_vertices_and_edges(kind: Kind, device: torch.device) -> None:
    for start, travel, rate in (((0, 0, 0.7), (0.3, 0.1, -0.5), 0.5), ((1.6, 0.2, -0.3), (-2.0, 0.3, 0), 2.0)):
        scene, motion = sliding(kind, [CUBE, box((1.0, 1.0, 1.0), (0, 0, -1))], start, travel, device)  # type: ignore[arg-type]
        hits = pgccd.detect(scene, motion, "all")
        assert len(hits) and pgccd.approach_rates(scene, motion, hits).cpu().max() == pytest.approx(rate, abs=1e-12)
        assert pgccd.approach_rates(scene, motion, hits).dtype == torch.float64


def test_rates_of_a_body_that_turns(device: torch.device) -> None:
    """A rod about its end: the rate is that of the tip."""
    rod = pgccd.Mesh([[0.0, 0, 0], [2, 0, 0], [0, 0.1, 0], [0, 0, 0.1]], [[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]])
    scene = pgccd.Scene([rod, sheet(4, 4.0)], device=device)
    x = torch.tensor([[0.0, 0, 0.5], [0, 0, 0]], device=device).double()
    q = torch.tensor([UPRIGHT] * 2, device=device).double()
    w = torch.tensor([[0.0, 0.7, 0], [0, 0, 0]], device=device).double()
    motion = pgccd.RigidMotion.from_velocity(x, q, torch.zeros_like(x), w, 1.0)
    hits = pgccd.detect(scene, motion)
    assert pgccd.approach_rates(scene, motion, hits).tolist() == pytest.approx(
        [0.7 * 2.0 * math.cos(math.asin(0.25))], rel=1e-6
    )


def test_rates_are_those_of_the_distance() -> None:
    """Of bodies that turn, at points inside faces and edges: against differences of the distance of both features."""
    generator = torch.Generator().manual_seed(4)
    count = 300

    def normal(width: int) -> Tensor:
        return torch.randn((2 * count, width), generator=generator, dtype=torch.float64)

    x, v, w = normal(3), 0.3 * normal(3), 2.0 * normal(3)
    q = torch.nn.functional.normalize(normal(4), dim=1)
    x[1::2] = x[::2] + 2.0 * torch.nn.functional.normalize(normal(3)[1::2], dim=1)
    v[1::2] += x[::2] - x[1::2]
    mesh = box((0.5, 0.6, 0.7))
    scene = pgccd.Scene([mesh], [0] * (2 * count), world=torch.arange(count).repeat_interleave(2))
    motion = pgccd.RigidMotion.from_velocity(x, q, v, w, 1.0)
    hits = pgccd.detect(scene, motion, min_separation=0.1, tolerance=1e-10)
    u, s = hits.coordinates.unbind(1)
    inside = (torch.minimum(u, s) > 0.01) & (torch.where(hits.kind == pgccd.Kind.EE, torch.maximum(u, s), u + s) < 0.99)
    hits = hits[inside & (hits.toi > 1e-4) & (hits.toi < 1.0 - 1e-4)]
    times = hits.toi.repeat_interleave(2) + torch.tensor([[-1e-5], [1e-5]], dtype=torch.float64)
    position, orientation = motion[hits.pairs.flatten()].at(times)
    corners = mesh.vertices @ _matrices(orientation).transpose(2, 3) + position[:, :, None]
    before, after = _distances(mesh, hits, corners.view(2, len(hits), 2, -1, 3))
    torch.testing.assert_close(pgccd.approach_rates(scene, motion, hits), (before - after) / 2e-5, rtol=1e-4, atol=1e-4)
    assert all(int((hits.kind == kind).sum()) > 10 for kind in (pgccd.Kind.VF_AB, pgccd.Kind.VF_BA, pgccd.Kind.EE))


def _distances(mesh: pgccd.Mesh, hits: pgccd.Contacts, corners: Tensor) -> Tensor:
    """(T, K): of the planes of faces from vertices, or of the lines of two edges; corners (T, K, 2, V, 3)."""
    found = torch.zeros(corners.shape[:2], dtype=torch.float64)
    every = torch.arange(len(hits))
    for kind in (pgccd.Kind.VF_AB, pgccd.Kind.VF_BA, pgccd.Kind.EE):
        rows = every[hits.kind == kind][:, None]
        one, other = hits.features[rows[:, 0]].long().unbind(1)
        if kind == pgccd.Kind.EE:
            a, b = corners[:, rows, 0, mesh.edges[one].long()].unbind(2)
            c, d = corners[:, rows, 1, mesh.edges[other].long()].unbind(2)
            across, between = torch.linalg.cross(b - a, d - c), c - a
        else:
            side, face, vertex = (1, other, one) if kind == pgccd.Kind.VF_AB else (0, one, other)
            a, b, c = corners[:, rows, side, mesh.faces[face].long()].unbind(2)
            across, between = torch.linalg.cross(b - a, c - a), corners[:, rows[:, 0], 1 - side, vertex] - a
        found[:, rows[:, 0]] = (across * between).sum(2).abs() / across.norm(dim=2)
    return found


def test_rates_have_gradients(device: torch.device) -> None:
    scene = pgccd.Scene([pgccd.Mesh.icosphere(0.5, 1), CUBE], device=device)
    x = torch.tensor([[0.0, 0, 2.0], [0.1, 0.07, 0]], device=device).double()
    q = torch.tensor([UPRIGHT, (0.8, 0.6, 0.0, 0.0)], device=device).double()

    def rate(v: Tensor, w: Tensor) -> Tensor:
        motion = pgccd.RigidMotion.from_velocity(x, q, v, w, 1.0)
        return pgccd.approach_rates(scene, motion, pgccd.detect(scene, motion, tolerance=1e-12))

    v = torch.tensor([[0.1, 0.2, -2.0], [0, 0, 0.3]], device=device).double().requires_grad_()
    w = torch.tensor([[0.3, 0.2, 0.1], [0.2, -0.3, 0.3]], device=device).double().requires_grad_()
    assert len(rate(v, w)) == 1
    assert torch.autograd.gradcheck(rate, (v, w), eps=1e-4, atol=1e-5, nondet_tol=0.0)
    motion = pgccd.RigidMotion.from_velocity(x, q, v, w, 1.0)
    hits = pgccd.approaching(scene, motion, pgccd.detect(scene, motion))
    assert hits.differentiable.tolist() == [True] and hits.toi.requires_grad


def test_gradients_of_contacts_behind_a_resting_one(device: torch.device) -> None:
    room = joined(FLOOR, box((0.5, 10, 3), (5, 0, 2)))
    scene, motion = sliding("rigid", [CUBE, room], (0, 0, 0.5), (8.0, 0, 0), device)
    assert isinstance(motion, pgccd.RigidMotion)
    end = motion.position_t1.clone().requires_grad_()
    path = pgccd.RigidMotion.from_rotation(motion.position_t0, motion.orientation_t0, end, motion.rotation)
    pgccd.approaching(scene, path, pgccd.detect(scene, path)).first_toi().backward()
    assert end.grad is not None and float(end.grad[0, 0]) == pytest.approx(-4.0 / 64.0, rel=1e-6)


def test_gradients_of_contacts_behind_a_resting_one_along_a_trajectory(device: torch.device) -> None:
    """The wall is met in the second of three segments; in the third the cube is in it."""
    scene = pgccd.Scene([CUBE, joined(FLOOR, box((0.5, 10, 3), (5, 0, 2)))], static=[False, True], device=device)
    x = torch.zeros(4, 2, 3, dtype=torch.float64)
    x[:, 0] = torch.tensor([[0.0, 0, 0.5], [2, 0, 0.5], [6, 0, 0.5], [7, 0, 0.5]])
    position = x.to(device).requires_grad_()
    q = torch.tensor([UPRIGHT] * 2, dtype=torch.float64, device=device).expand(4, -1, -1).contiguous()
    trajectory = pgccd.Trajectory(position, q)
    ahead = pgccd.approaching(scene, trajectory, pgccd.detect(scene, trajectory))
    assert ahead.segment.tolist() == [1] and ahead.differentiable.tolist() == [True]
    ahead.toi.sum().backward()
    # toi = (4 - a) / (b - a) of the positions a and b of the cube; of the wall the opposite.
    expected = torch.zeros_like(x)
    expected[1, 0, 0], expected[2, 0, 0] = -2.0 / 16.0, -2.0 / 16.0
    expected[:, 1] = -expected[:, 0]
    assert position.grad is not None and torch.allclose(position.grad.cpu(), expected, rtol=1e-6, atol=1e-12)


def test_intersections_stay_in(device: torch.device) -> None:
    """Whatever the slack."""
    scene, motion = sliding("rigid", [CUBE, FLOOR], (0, 0, 0.4), (0, 0, 0.2), device)
    hits = pgccd.detect(scene, motion)
    assert len(pgccd.approaching(scene, motion, hits)) == 1
    hits = pgccd.detect(scene, motion, "all")
    is_crossing = hits.kind >= pgccd.Kind.EF_AB
    assert pgccd.approach_rates(scene, motion, hits).isfinite().all() and is_crossing.any() and not is_crossing.all()
    assert pgccd.approaching(scene, motion, hits, 10.0) == hits[is_crossing]


def test_what_is_unresolved_stays_in(device: torch.device) -> None:
    scene, motion = sliding("rigid", [CUBE, FLOOR], (0, 0, 0.5), (0, 0, 0.2), device)
    hits = pgccd.detect(scene, motion, "all")
    hits.status[1::2] = pgccd.Status.UNRESOLVED
    assert len(hits) > 2 and pgccd.approaching(scene, motion, hits, 10.0) == hits[1::2]


def test_refusals() -> None:
    scene, motion = sliding("rigid", [CUBE, FLOOR], (0, 0, 0.5), (1.0, 0, 0))
    assert isinstance(motion, pgccd.RigidMotion)
    hits = pgccd.detect(scene, motion)
    with pytest.raises(ValueError, match=r'report: "earliest" leaves out'):
        pgccd.approaching(scene, motion, pgccd.detect(scene, motion, "earliest"))
    rates = pgccd.approach_rates(scene, motion, hits)
    without: list[Any] = [pgccd.Contacts.from_state_dict(hits.state_dict())]
    without.append(pgccd.detect(scene, motion, capacity=Capacity.of(4, 100)).trim())
    for contacts in without:
        assert torch.equal(pgccd.approach_rates(scene, motion, contacts), rates)
        with pytest.raises(ValueError, match="^hits: expected contacts of `detect` without a capacity"):
            pgccd.approaching(scene, motion, contacts)
    in_capacity: Any = pgccd.detect(scene, motion, capacity=Capacity.of(4, 100))
    ways: list[Any] = [pgccd.approach_rates, pgccd.approaching]
    for ask in ways:
        for padded in (
            in_capacity,
            pgccd.CapturedDetection(scene, motion).replay(),
            pgccd.collide(scene, motion),
        ):
            with pytest.raises(TypeError, match="^hits: expected pgccd.Contacts, got "):
                ask(scene, motion, padded)
        for wrong, named in (
            ((None, motion, hits), "scene: expected a pgccd.Scene"),
            ((scene, 3, hits), "motion: expected the motion of the step|motion: expected a pgccd.RigidMotion"),
            (
                (scene, pgccd.Trajectory(torch.zeros(2, 2, 3), torch.tensor(UPRIGHT).expand(2, 2, 4)), hits),
                "motion: exp",
            ),
        ):
            with pytest.raises(TypeError, match=f"^({named})"):
                ask(*wrong)
        with pytest.raises(ValueError, match="^hits: have body 1, the scene 1 bodies"):
            ask(pgccd.Scene([CUBE]), motion, hits)
        with pytest.raises(ValueError, match="^motion: has 1 bodies, the scene 2"):
            ask(scene, motion[:1], hits)
    with pytest.raises(ValueError, match="^normals: expected \"features\" for captured steps, got 'surface'"):
        pgccd.CapturedDetection(scene, motion, normals="surface")
    with pytest.raises(TypeError, match="^colour: expected one of "):
        pgccd.CapturedDetection(scene, motion, colour=1)  # type: ignore[call-overload]
    of_rank = replace(hits, _is_of_rank=True)
    for ask in ways:
        with pytest.raises(ValueError, match="^hits: are the contacts of one of several ranks"):
            ask(scene, motion, of_rank)
    with pytest.raises(TypeError, match="normals"):
        pgccd.distributed.WorldOptions(normals="surface")  # type: ignore[call-arg]
    for name, instead in (
        ("approach", r"call pgccd.approach_rates\("),
        ("approaching", r"call pgccd.approaching\("),
        ("scene", "results keep `body_count` and `world` alone"),
    ):
        with pytest.raises(AttributeError, match=rf"Contacts has no '{name}' any more: {instead}"):
            getattr(hits, name)


@pytest.mark.parametrize("kind", KINDS)
def test_another_motion_is_refused(kind: Kind) -> None:
    """What it says of the rest of the step is not about these contacts."""
    scene, motion = sliding(kind, [CUBE, ROOM], (0, 0, 0.5), (8.0, 0, 0))
    hits = pgccd.detect(scene, motion, "all")
    _, other = sliding(kind, [CUBE, ROOM], (0, 0, 0.501), (8.0, 0, 0))
    ways: list[Any] = [pgccd.approach_rates, pgccd.approaching]
    for ask in ways:
        assert len(ask(scene, motion, hits)) > 0
        with pytest.raises(ValueError, match="^motion: contact 0 is 0.0005 from where its features are at toi"):
            ask(scene, other, hits)


def test_contacts_keep_neither_scene_data_nor_motion() -> None:
    """One contact of many bodies is small."""
    count = 2_000
    scene = pgccd.Scene([CUBE], [0] * count)
    x = torch.zeros(count, 3, dtype=torch.float64)
    x[:, 0] = 3.0 * torch.arange(count)
    x[1] = x[0] + 0.5
    motion = pgccd.RigidMotion.at_rest(x, torch.tensor([UPRIGHT] * count))
    hits = pgccd.detect(scene, motion)
    held = weakref.ref(motion)
    del motion
    assert len(hits) == 1 and held() is None


@pytest.mark.cuda
def test_same_on_a_gpu() -> None:
    scene, motion, _ = random_rests(90, 7)
    found = []
    for device in ("cpu", "cuda"):
        columns = (motion.position_t0, motion.orientation_t0, motion.position_t1, motion.rotation)
        path = pgccd.RigidMotion.from_rotation(*(c.to(device) for c in columns))
        there = scene.to(device)
        found.append(pgccd.approaching(there, path, pgccd.detect(there, path)).to("cpu"))
    assert len(found[0]) > 10 and found[0] == found[1]


def _matrices(q: Tensor) -> Tensor:
    w, x, y, z = q.unbind(-1)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return torch.stack([torch.stack(row, -1) for row in rows], -2)


def _product(a: Tensor, b: Tensor) -> Tensor:
    (w, u), (s, v) = ((q[:, :1], q[:, 1:]) for q in (a, b))
    scalar = w * s - (u * v).sum(1, keepdim=True)
    return torch.cat([scalar, w * v + s * u + torch.linalg.cross(u, v)], 1)


@pytest.mark.parametrize("kind", ["rigid", "linear", "deforming"])
def test_the_rate_of_edges_in_faces(kind: str, device: torch.device) -> None:
    """Of bodies that intersect at t = 0: the velocities of their points at the contact, along the normal."""
    generator = torch.Generator().manual_seed(3)
    x, v, w = (torch.randn(6, 3, generator=generator, dtype=torch.float64).to(device) for _ in range(3))
    q = torch.tensor([UPRIGHT] * 6, dtype=torch.float64, device=device)
    scene = pgccd.Scene([box((0.9, 0.7, 1.1))], [0] * 6, device=device)
    motion: Any = pgccd.RigidMotion.from_velocity(x, q, v, w, 1.0, path="linear" if kind == "linear" else "rigid")
    turned = pgccd.RigidMotion.from_velocity(0 * x, q, 0 * x, w, 1.0).at(1.0)[1]
    matrices = matrices_of(turned)  # upright at t = 0
    if kind == "deforming":
        vertices = scene.meshes.meshes[0].vertices.to(device)
        end = x[:, None] + v[:, None] + vertices @ matrices.mT
        motion = pgccd.VertexMotion((x[:, None] + vertices).flatten(0, 1), end.flatten(0, 1))
    hits = pgccd.detect(scene, motion, "all")
    hits = hits[hits.kind >= pgccd.Kind.EF_AB]
    assert len(hits) > 20 and set(hits.kind.tolist()) == {3, 4}
    arm = hits.point[:, None] - x[hits.pairs]
    if kind == "rigid":
        velocity = v[hits.pairs] + torch.linalg.cross(w[hits.pairs], arm)
    else:
        velocity = v[hits.pairs] + (matrices[hits.pairs] @ arm[..., None])[..., 0] - arm
    expected = -(hits.normal * (velocity[:, 1] - velocity[:, 0])).sum(1)
    assert torch.allclose(pgccd.approach_rates(scene, motion, hits), expected, rtol=0.0, atol=1e-9)


def matrices_of(quaternion: Tensor) -> Tensor:
    """(N, 3, 3), of unit quaternions (N, 4)."""
    axes = torch.eye(3, dtype=torch.float64, device=quaternion.device)
    scalar, vector = quaternion[:, None, :1], quaternion[:, None, 1:].expand(-1, 3, -1)
    twice = 2.0 * torch.linalg.cross(vector, axes.expand_as(vector))
    return (axes + scalar * twice + torch.linalg.cross(vector, twice)).mT


@pytest.mark.parametrize("seed", range(24))
def test_rates_have_the_same_bits_on_every_device(seed: int, device: torch.device) -> None:
    chosen = random_scene(seed)
    rates = []
    for each in (torch.device("cpu"), device):
        scene, motion = chosen.scene(each), chosen.motion(each)
        rates.append(pgccd.approach_rates(scene, motion, pgccd.detect(scene, motion, "all")).cpu())
    assert torch.equal(*(bits(rate) for rate in rates))
