"""`pgccd.resolve`: who stops, who does not, what is listed, and arguments."""

from __future__ import annotations

import sys
from contextlib import ExitStack
from typing import Any
from unittest import mock

import pytest
import torch
from support.deforming import crumpled, motion_of
from support.resolving import check_resolution
from support.shapes import tetrahedron
from torch import Tensor

import pgccd
from pgccd.resolution.listed import ListedSearch
from pgccd.resolution.search import ShortenedSearch
from pgccd.runtime.sizes import COUNT_ROWS

resolve_module = sys.modules["pgccd.resolution.resolve"]

CUBE = [[x, y, z] for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (-0.5, 0.5)]
FACES = [[0, 1, 3], [0, 3, 2], [4, 6, 7], [4, 7, 5], [0, 4, 5], [0, 5, 1], [2, 3, 7], [2, 7, 6], [0, 2, 6], [0, 6, 4]]
FACES += [[1, 5, 7], [1, 7, 3]]


def on_a_line(
    device: torch.device, x: list[float], velocity: list[float], **columns: Any
) -> tuple[pgccd.Scene, pgccd.RigidMotion]:
    """Cubes of edge 1 along x, which do not turn."""
    count = len(x)
    scene = pgccd.Scene([pgccd.Mesh(CUBE, FACES)], [0] * count, device, **columns)
    position, moved = torch.zeros(2, count, 3, dtype=torch.float64)
    position[:, 0], moved[:, 0] = torch.tensor(x, dtype=torch.float64), torch.tensor(velocity)
    orientation = torch.tensor([1.0, 0, 0, 0], dtype=torch.float64).repeat(count, 1)
    columns_of_motion = [column.to(device) for column in (position, orientation, moved, torch.zeros_like(moved))]
    return scene, pgccd.RigidMotion.from_velocity(*columns_of_motion, dt=1.0)


def lists(resolved: pgccd.Resolution[Any]) -> tuple[list[list[int]], list[list[int]]]:
    return resolved.touching_at_start.tolist(), resolved.unresolved.tolist()


def test_nobody_meets(device: torch.device) -> None:
    scene, motion = on_a_line(device, [0.0, 3.0], [1.0, 1.0])
    with mock.patch.object(resolve_module, "detect_moving", side_effect=AssertionError("nothing is shortened")):
        resolved = pgccd.resolve(scene, motion)
    assert resolved.fraction.tolist() == [1.0, 1.0] and resolved.stopped_by.tolist() == [-1, -1]
    assert lists(resolved) == ([], []) and resolved.rounds == 0
    for name, column in motion.columns().items():
        assert torch.equal(resolved.motion.columns()[name], column)


def test_two_bodies_stop_just_before_they_meet(device: torch.device) -> None:
    scene, motion = on_a_line(device, [0.0, 3.0], [2.0, -2.0])
    toi = float(pgccd.detect(scene, motion, nonzero_toi=True).toi[0])
    resolved = pgccd.resolve(scene, motion)
    assert toi == pytest.approx(0.5, abs=1e-6) and resolved.fraction.tolist() == [0.99 * toi] * 2
    assert resolved.stopped_by.tolist() == [1, 0] and lists(resolved) == ([], [])
    position, orientation = resolved.motion.at(1.0)
    assert position[:, 0].tolist() == pytest.approx([1.98 * toi, 3.0 - 1.98 * toi])
    assert torch.equal(orientation, motion.orientation_t0)


def test_one_that_follows_a_stopped_body_stops_too(device: torch.device) -> None:
    """It never comes near on whole paths: they are not among the pairs of the whole step."""
    scene, motion = on_a_line(device, [0.0, 2.0, 3.2], [1.6, 1.6, 0.0])
    whole = pgccd.detect(scene, motion)
    assert whole.pairs.tolist() == [[1, 2]]
    assert pgccd.broad.sweep(pgccd.MovingBodies.of(scene, motion)).tolist() == [[0, 2], [1, 2]]
    resolved = pgccd.resolve(scene, motion)
    assert resolved.stopped_by.tolist()[0] == 1 and lists(resolved) == ([], [])
    check_resolution(scene, motion, resolved, [True] * 3)
    assert float(resolved.motion.position_t1[1, 0] - resolved.motion.position_t1[0, 0]) > 1.0


def test_the_one_that_stopped_a_body_last(device: torch.device) -> None:
    """1 is stopped by 2 first, in the first round by 0, which does not give way."""
    scene, motion = on_a_line(device, [0.0, 4.0, 5.5], [3.5, 1.0, 0.0])
    resolved = pgccd.resolve(scene, motion, [False, True, True])
    assert resolved.stopped_by.tolist() == [-1, 0, 1] and resolved.fraction[0] == 1.0
    assert lists(resolved)[1] == [[0, 1]]


def test_a_body_that_may_not_be_stopped(device: torch.device) -> None:
    scene, motion = on_a_line(device, [0.0, 3.0], [3.0, -3.0])
    movable = torch.tensor([False, True], device=device)
    resolved = pgccd.resolve(scene, motion, movable)
    # It runs over the other one, wherever that stops.
    assert resolved.fraction.tolist() == [1.0, 0.0] and resolved.stopped_by.tolist() == [-1, 0]
    assert lists(resolved) == ([], [[0, 1]])
    check_resolution(scene, motion, resolved, movable.tolist())
    # One that ends before it lets the other come near.
    scene, motion = on_a_line(device, [0.0, 3.0], [0.2, -3.0])
    resolved = pgccd.resolve(scene, motion, movable)
    assert resolved.fraction[0] == 1.0 and 0.55 < float(resolved.fraction[1]) < 0.6
    assert lists(resolved) == ([], [])
    # Two of them.
    resolved = pgccd.resolve(scene, motion, [False, False])
    assert resolved.fraction.tolist() == [1.0, 1.0] and lists(resolved) == ([], [[0, 1]]) and resolved.rounds == 0


def test_pairs_that_intersect_or_touch_at_the_start(device: torch.device) -> None:
    # 0 and 1 intersect, 2 and 3 touch, 4 is 1e-9 from 3, 5 is free.
    scene, motion = on_a_line(device, [0.0, 0.9, 4.0, 5.0, 6.000000001, 9.0], [-1.0, 1.0, -1.0, 0.0, 1.0, 0.5])
    resolved = pgccd.resolve(scene, motion)
    assert lists(resolved) == ([[0, 1], [2, 3]], [])
    assert resolved.fraction.tolist() == [0.0, 0.0, 0.0, 0.0, 1.0, 1.0]  # 4 is within the tolerance, and moves away
    assert resolved.stopped_by.tolist() == [1, 0, 3, 2, -1, -1]
    check_resolution(scene, motion, resolved, [True] * 6)
    # A body that may not be stopped moves on: both lists have the pair. One that rests on it does not.
    resolved = pgccd.resolve(scene, motion, [False, True, True, False, True, True])
    assert lists(resolved) == ([[0, 1], [2, 3]], [[0, 1]]) and resolved.fraction[:4].tolist() == [1.0, 0.0, 0.0, 1.0]


def test_surfaces_that_cross_without_touching_features(device: torch.device) -> None:
    scene, motion = on_a_line(device, [0.0, 0.25], [0.0, 0.0])
    for column in (motion.position_t0, motion.position_t1):
        column[1, 1:] += torch.tensor([0.2, 0.31], device=device)
    assert lists(pgccd.resolve(scene, motion)) == ([[0, 1]], [])
    assert lists(pgccd.resolve(scene, motion, initial="assume_free")) == ([], [])


def test_margins_separation_filters_and_worlds(device: torch.device) -> None:
    scene, motion = on_a_line(device, [0.0, 3.0], [2.0, -2.0], margin=[0.25, 0.0])
    for given, gap in (({}, 0.25), ({"min_separation": 0.5}, 0.75)):
        resolved = pgccd.resolve(scene, motion, **given)
        end = resolved.motion.position_t1
        assert gap < float(end[1, 0] - end[0, 0]) - 1.0 < gap + 0.03
    for columns in ({"world": [0, 1]}, {"static": [True, True]}, {"group": [1, 2], "mask": [1, 2]}):
        scene, motion = on_a_line(device, [0.0, 3.0], [2.0, -2.0], **columns)
        assert pgccd.resolve(scene, motion).fraction.tolist() == [1.0, 1.0]
    # A larger tolerance is a larger distance at which pairs may count as touching.
    scene, motion = on_a_line(device, [0.0, 3.0], [2.0, -2.0])
    assert 0.0 < float(pgccd.resolve(scene, motion, tolerance=0.1).fraction[0]) < 0.495


def test_cloth_stops_before_it_meets_itself(device: torch.device) -> None:
    """A strip folds over; without the test against itself nothing stops it."""
    x, y = torch.meshgrid(torch.arange(9.0), torch.arange(3.0), indexing="ij")
    flat = torch.stack([x.reshape(-1), y.reshape(-1), torch.zeros(27)], dim=1).double()
    cell = [3 * i + j for i in range(8) for j in range(2)]
    faces = [f for c in cell for f in ([c, c + 3, c + 4], [c, c + 4, c + 1])]
    mesh, folded = pgccd.Mesh(flat, faces), flat.clone()
    folded[flat[:, 0] > 4.0] *= torch.tensor([-1.0, 1.0, 1.0])
    folded[flat[:, 0] > 4.0] += torch.tensor([8.0, 0.1, -0.2])  # ends below the other half
    start = flat.clone()
    start[flat[:, 0] > 4.0] *= torch.tensor([0.5, 1.0, 1.0])
    start[flat[:, 0] > 4.0, 2] += 3.0
    motion = pgccd.VertexMotion(start.to(device), folded.to(device))
    scene = pgccd.Scene([mesh], device=device, self_collision=True)
    resolved = pgccd.resolve(scene, motion)
    assert 0.0 < float(resolved.fraction[0]) < 1.0 and resolved.stopped_by.tolist() == [0]
    assert lists(resolved) == ([], [])
    check_resolution(scene, motion, resolved, [True])
    assert lists(pgccd.resolve(scene, motion, [False]))[1] == [[0, 0]]
    with pytest.warns(UserWarning, match="it has one body"):
        alone = pgccd.resolve(pgccd.Scene([mesh], device=device), motion)
    assert alone.fraction.tolist() == [1.0]


def test_bodies_that_deform_stop_as_a_whole(device: torch.device) -> None:
    meshes, ends = crumpled(5)
    apart = [[vertices + 3.0 * k for vertices in end] for k, end in enumerate(ends)]  # no two touch at the start
    for end in apart:
        end[1] = end[1] - end[1].mean(axis=0) + 4.0
    scene, motion = pgccd.Scene(meshes, device=device), motion_of(*apart, device=device)
    resolved = pgccd.resolve(scene, motion)
    assert int(((resolved.fraction > 0.0) & (resolved.fraction < 1.0)).sum()) >= 3
    check_resolution(scene, motion, resolved, [True] * 5)
    body = torch.repeat_interleave(torch.arange(5), torch.tensor([len(m.vertices) for m in meshes])).to(device)
    part = resolved.fraction[body][:, None]
    assert torch.allclose(resolved.motion.x_t1, motion.x_t0 + part * (motion.x_t1 - motion.x_t0), rtol=0, atol=1e-12)


def test_what_rounds_miss_is_not_promised(device: torch.device) -> None:
    """The test of the shortened motion does not rely on the rounds."""
    scene, motion = on_a_line(device, [0.0, 2.0, 3.2], [1.6, 1.6, 0.0])

    def find_nothing(search: Any, changed: Tensor, *_: Any) -> Any:
        return [], torch.zeros(len(COUNT_ROWS), dtype=torch.int64, device=changed.device)

    with ExitStack() as stack:
        for kind in (ShortenedSearch, ListedSearch):
            stack.enter_context(mock.patch.object(kind, "find_round", find_nothing))
        assert lists(pgccd.resolve(scene, motion)) == ([], [[0, 1]])
        padded = pgccd.resolve(scene, motion, capacity=pgccd.Capacity.of(10))
        assert lists(padded.trim()) == ([], [[0, 1]])


def test_a_loop_goes_on_and_nothing_ever_touches(device: torch.device) -> None:
    torch.manual_seed(1)
    scene = pgccd.Scene([tetrahedron()], [0] * 27, device)
    x = 2.2 * torch.cartesian_prod(*[torch.arange(3.0, dtype=torch.float64)] * 3).to(device)
    q = torch.nn.functional.normalize(torch.randn(27, 4, dtype=torch.float64), dim=1).to(device)
    v, w = (torch.randn(27, 3, dtype=torch.float64).to(device) for _ in range(2))
    stopped, moved = 0, 0.0
    for _ in range(15):
        motion = pgccd.RigidMotion.from_velocity(x, q, v, w, dt=0.4)
        resolved = pgccd.resolve(scene, motion)
        assert lists(resolved) == ([], [])
        x, q = resolved.motion.at(1.0)
        assert len(pgccd.detect(scene, pgccd.RigidMotion.at_rest(x, q), nonzero_toi=True)) == 0
        turns = (resolved.fraction < 1.0)[:, None]
        v, w = torch.where(turns, -v, v), torch.where(turns, -w, w)
        stopped += int(turns.sum())
        moved += float(resolved.fraction.mean()) / 15
    assert stopped > 30 and moved > 0.5


def test_half_turns_and_more(device: torch.device) -> None:
    """Arcs are shortened by their rotation vectors, not by their end poses."""
    scene, motion = on_a_line(device, [0.0, 1.15], [0.0, 0.0])
    motion.rotation[0, 2] = 9.0
    resolved = pgccd.resolve(scene, motion)
    toi = float(pgccd.detect(scene, motion, nonzero_toi=True).toi[0])
    assert float(resolved.motion.rotation[0, 2]) == 9.0 * (0.99 * toi) and lists(resolved) == ([], [])
    check_resolution(scene, motion, resolved, [True] * 2)


def test_no_bodies(device: torch.device) -> None:
    scene, motion = on_a_line(device, [], [])
    resolved = pgccd.resolve(scene, motion, torch.zeros(0, dtype=torch.bool))
    assert resolved.fraction.shape == (0,) and lists(resolved) == ([], [])
    assert lists(pgccd.resolve(scene, motion, capacity=pgccd.Capacity.of(1)).trim()) == ([], [])


WRONG: list[tuple[dict[str, Any], type[Exception], str]] = [
    ({"movable": [True]}, ValueError, r"movable: expected shape \(2,\), got \(1,\)"),
    ({"movable": torch.ones(2, 1, dtype=torch.bool)}, ValueError, r"movable: expected bool, shape \(N,\)"),
    ({"movable": torch.ones(2)}, TypeError, "movable: expected bool, got torch.float32"),
    ({"movable": [1, 0]}, TypeError, "movable: expected bool, got torch.int64"),
    ({"movable": True}, ValueError, "movable: expected bool"),
    ({"scene": None}, TypeError, "scene: expected a pgccd.Scene, got None"),
    ({"motion": None}, TypeError, "motion: expected a pgccd.RigidMotion or VertexMotion"),
    ({"min_separation": -1.0}, ValueError, "min_separation: expected a finite length"),
    ({"tolerance": -1.0}, ValueError, "tolerance: expected a finite length"),
    ({"initial": "free"}, ValueError, "initial: expected"),
    ({"broad_phase": "tree"}, ValueError, "broad_phase: expected"),
    ({"rounds": 3}, ValueError, "rounds: can only be given with a capacity"),
    ({"rounds": 0, "capacity": pgccd.Capacity.of(2)}, ValueError, "rounds: expected a number of rounds >= 1, got 0"),
    ({"rounds": 1001, "capacity": pgccd.Capacity.of(2)}, ValueError, "rounds: expected at most 1000, got 1001"),
    ({"capacity": 5}, TypeError, "capacity: expected a pgccd.Capacity"),
]


@pytest.mark.parametrize(("wrong", "kind", "message"), WRONG, ids=lambda value: str(value)[:30])
def test_arguments(wrong: dict[str, Any], kind: type[Exception], message: str) -> None:
    scene, motion = on_a_line(torch.device("cpu"), [0.0, 3.0], [2.0, -2.0])
    with pytest.raises(kind, match=message):
        pgccd.resolve(**({"scene": scene, "motion": motion} | wrong))


def test_an_invalid_pose_is_named(device: torch.device) -> None:
    scene, motion = on_a_line(device, [0.0, 3.0], [2.0, -2.0])
    motion.position_t1[1, 0] = torch.nan
    with pytest.raises(ValueError, match="position_t1: body 1: expected finite"):
        pgccd.resolve(scene, motion)
    motion.position_t1.requires_grad_()
    with pytest.raises(ValueError, match="^linear_velocity: requires grad"):
        pgccd.resolve(scene, motion)
