"""Rounds among a list of pairs: the operators, and equal bits with rounds that find their pairs anew."""

from __future__ import annotations

import functools
from fractions import Fraction
from typing import Any
from unittest import mock

import pytest
import torch
from support.cases import checked_as
from support.random_scenes import random_scene
from support.same_bits import difference
from torch import Tensor

import pgccd
from pgccd import ops
from pgccd.resolution import listed
from pgccd.resolution.listed import ListedSearch, is_short
from pgccd.resolution.search import shortened
from pgccd.runtime.sizes import COUNT_ROWS, EXACTLY
from pgccd.search.query import Query


def bodies_of(count: int, seed: int, margin: bool = False) -> tuple[pgccd.Scene, pgccd.RigidMotion]:
    """Boxes and rods that turn about corners, in a crowd."""
    generator = torch.Generator().manual_seed(seed)
    random = lambda *shape: torch.randn(*shape, generator=generator, dtype=torch.float64)  # noqa: E731
    meshes = [pgccd.Mesh.box([1.0, 1.0, 1.0]), pgccd.Mesh.box([4.0, 0.3, 0.3], origin=(2.0, 0.0, 0.0))]
    kinds = torch.randint(2, (count,), generator=generator)
    margins = random(count).abs() if margin else None
    x, q = 3.0 * random(count, 3), torch.nn.functional.normalize(random(count, 4))
    motion = pgccd.RigidMotion.from_rotation(x, q, x + random(count, 3), random(count, 3))
    return pgccd.Scene(meshes, kinds, margin=margins), motion


@pytest.mark.parametrize("by_velocity", [False, True])
@pytest.mark.parametrize("margin", [False, True])
def test_pairs_with_a_body_that_has_changed(device: torch.device, by_velocity: bool, margin: bool) -> None:
    """Their bodies move bit for bit as among all, ghosts too, in whatever order the pairs are found."""
    count, own_count = 5000, 4100
    scene, motion = bodies_of(count, 4, margin)
    motion.position_t1 = 1e-3 * motion.position_t1  # start + (end - start) are other bits
    generator = torch.Generator().manual_seed(2)
    pairs = torch.randint(count, (30_000, 2), generator=generator)
    pairs[::7] = -1
    changed = torch.rand(count, generator=generator) < 0.05
    fraction = 0.25 * torch.randint(0, 5, (count,), dtype=torch.float64, generator=generator)
    tensors = list(pgccd.MovingBodies.of(scene, motion).tensors)
    among_all: Any = shortened(scene, motion, fraction)
    position_t1, rotation = among_all.position_t1, among_all.rotation
    rests = fraction == 0.0
    for column in (2, 5) if not by_velocity else ():  # of an invalid step nothing moves
        tensors[column] = torch.where(rests[:, None], torch.nan, tensors[column])
    if by_velocity:
        tensors[2] = motion.position_t1 - motion.position_t0
        position_t1 = motion.position_t0 + fraction[:, None] * tensors[2]
        rotation = fraction[:, None] * motion.rotation
    has_changed = (pairs[:, 0] >= 0) & changed[pairs].any(dim=1)
    differ = fraction[pairs[:, 0]] != fraction[pairs[:, 1]]
    columns = [column.to(device) for column in tensors]
    own, ghosts = ([column[part] for column in columns] for part in (slice(0, own_count), slice(own_count, None)))
    marks, parts, rows = changed.to(device).view(torch.uint8), fraction.to(device), pairs.to(device)
    for skips_equal in (False, True):
        chosen = has_changed & differ if skips_equal else has_changed
        expected = sorted(pairs[chosen].tolist())
        assert len(expected) > 1500 and int((has_changed & ~differ).sum()) > 300
        for capacity in (30_000, len(expected), len(expected) - 1, 0):
            given = own, ghosts, parts, marks, rows, skips_equal, by_velocity
            found, moving, counts = ops.resolve_pairs(*given, capacity)
            written = min(len(expected), capacity)
            assert counts.tolist() == [len(expected), 0, 0, written, int(capacity < len(expected)), 0, 0]
            assert len(found) == capacity and all(len(column) == 2 * capacity for column in moving)
            found = found[:written].cpu()
            if capacity < len(expected):  # a subset
                assert all(pair in expected for pair in found[::50].tolist())
            else:
                assert sorted(found.tolist()) == expected
            at = found.reshape(-1)
            wanted = [tensors[0], motion.position_t0, position_t1, tensors[3], motion.orientation_t0, rotation]
            wanted += [scene.margin] if scene.margin is not None else []
            for column, of_all in zip(moving, wanted, strict=True):
                assert torch.equal(column[: 2 * written].cpu(), of_all[at])
    assert ops.resolve_pairs(own, ghosts, parts, marks, rows[:0], True, by_velocity, 5)[2].tolist() == [0] * 7
    with pytest.raises(RuntimeError, match=r"capacity: expected a number in \[0, 2\^31\), got -1"):
        ops.resolve_pairs(own, ghosts, parts, marks, rows, True, by_velocity, -1)
    with pytest.raises(RuntimeError, match="ghosts: expected 6 tensors, got 7|ghosts: expected 7 tensors, got 6"):
        other = ghosts[:6] if margin else [*ghosts, ghosts[3]]
        ops.resolve_pairs(own, other, parts, marks, rows, True, by_velocity, 5)


@pytest.mark.parametrize("count", [1, 129, 400_000, 3_000_001])
def test_any_number_of_pairs(device: torch.device, count: int) -> None:
    """A GPU divides them into tiles, whose size depends on their number."""
    scene, motion = bodies_of(3000, 4)
    own = [column.to(device) for column in pgccd.MovingBodies.of(scene, motion).tensors]
    generator = torch.Generator().manual_seed(count)
    pairs = torch.randint(3000, (count, 2), generator=generator)
    changed = torch.rand(3000, generator=generator) < 0.02
    expected = pairs[changed[pairs].any(dim=1)]
    rows = (own, [column[:0] for column in own], torch.ones(3000, dtype=torch.float64, device=device))
    marks, capacity = changed.to(device).view(torch.uint8), len(expected)
    found, _, counts = ops.resolve_pairs(*rows, marks, pairs.to(device), False, False, capacity)
    assert counts.tolist() == [capacity, 0, 0, capacity, 0, 0, 0]
    codes = torch.tensor([3000, 1])
    assert torch.equal((found.cpu() * codes).sum(dim=1).sort().values, (expected * codes).sum(dim=1).sort().values)


def test_slowing_all_down(device: torch.device) -> None:
    first = torch.tensor([0.5, torch.inf, 0.005, 1.0, 0.5, torch.inf], dtype=torch.float64, device=device)
    fraction = torch.tensor([0.5, 1.0, 1.0, 1.0, 0.0, 0.0], dtype=torch.float64, device=device)
    changed = torch.full((6,), 7, dtype=torch.uint8, device=device)
    reports = torch.zeros(4, dtype=torch.int64, device=device).split(1)
    ops.resolve_slow_down(first, fraction, changed, reports[1], 0.99, 0.01)
    made = [0.5 * 0.5 * 0.99, 1.0, 0.0, 0.99, 0.0, 0.0]
    assert fraction.tolist() == made and changed.tolist() == [1, 0, 1, 1, 0, 0] and bool((first == torch.inf).all())
    ops.resolve_slow_down(first, fraction, changed, reports[2], 0.99, 0.01)
    assert fraction.tolist() == made and not bool(changed.any())
    ops.resolve_slow_down(first[:0], fraction[:0], changed[:0], reports[3], 0.99, 0.01)
    assert torch.cat(reports).tolist() == [0, 1, 0, 0]
    first.fill_(0.9)
    ops.resolve_slow_down(first, fraction, changed, reports[3], 0.99, torch.inf)
    assert not bool(fraction.any()) and changed.tolist() == [1, 1, 0, 1, 0, 0]


def test_first_toi_of_padded_contacts(device: torch.device) -> None:
    first = torch.tensor([0.5, torch.inf, torch.inf, torch.inf], dtype=torch.float64, device=device)
    pairs = torch.tensor([[0, 1], [-1, 3], [-1, -1]], device=device)
    toi = torch.tensor([0.75, 0.25, torch.inf], dtype=torch.float64, device=device)
    ops.resolve_first_toi(first, pairs, toi)
    assert first.tolist() == [0.5, 0.75, torch.inf, 0.25]
    ops.resolve_first_toi(first, pairs[:0], toi[:0])
    assert first.tolist() == [0.5, 0.75, torch.inf, 0.25]


@checked_as
def test_operators_have_consistent_fake_kernels(utilities: tuple[str, ...]) -> None:
    check = functools.partial(torch.library.opcheck, test_utils=utilities)
    scene, motion = bodies_of(5, 1)
    own = pgccd.MovingBodies.of(scene, motion).tensors
    half = torch.full((5,), 0.5, dtype=torch.float64)
    # All rows: those past the last pair are undefined.
    pairs, changed = torch.tensor([[0, 1], [1, 4], [-1, -1]]), torch.ones(5, dtype=torch.uint8)
    none = [column[:0] for column in own]
    check(torch.ops.pgccd.resolve_pairs, (own, none, half, changed, pairs, False, False, 2))
    none_yet = torch.zeros(1, dtype=torch.int64)
    check(torch.ops.pgccd.resolve_slow_down, (half.clone(), half, changed, none_yet, 0.99, 0.01))
    check(torch.ops.pgccd.resolve_first_toi, (half, pairs[:2], half[:2]))


def columns_of(resolved: Any) -> dict[str, Tensor]:
    columns = {name: getattr(resolved, name) for name in ("fraction", "stopped_by", "touching_at_start", "unresolved")}
    return columns | {"position_t1": resolved.motion.position_t1, "rotation": resolved.motion.rotation}


@pytest.mark.parametrize("travel", [0.1, 1.0, 5.0, 40.0])
def test_same_bits_with_and_without_a_list(device: torch.device, travel: float) -> None:
    """Travel in radii; boxes and rods that turn about corners, with margins, some of them static or excluded."""
    made = dict.fromkeys(("stopped", "rounds"), 0)
    for seed in range(3):
        scene, motion = bodies_of(60, seed, margin=True)
        motion.position_t1 = motion.position_t0 + travel * (motion.position_t1 - motion.position_t0)
        columns = {"static": torch.arange(60) % 7 == 0, "exclude": torch.tensor([[0, 1], [2, 40]])}
        scene = pgccd.Scene(scene.meshes.meshes, scene.mesh_index, device, margin=0.05 * scene.margin, **columns)
        motion = motion.to(device)
        found = []
        for most in (10**9, 0):
            with mock.patch.object(listed, "_LONGEST", most):
                pgccd.resolve(scene, motion)  # on a GPU the next one knows how long the list is
                found.append(pgccd.resolve(scene, motion))
        assert found[0].rounds == found[1].rounds
        assert difference(*map(columns_of, found)) is None
        made["stopped"] += int((found[0].fraction < 1.0).sum())
        made["rounds"] += found[0].rounds
    assert made["stopped"] > 30 and made["rounds"] > 3, made


def test_long_lists_are_not_searched() -> None:
    """A list is used up to four times the PCS, as counted in the step."""
    scene, motion = bodies_of(300, 1)
    start, step = 5.0 * motion.position_t0, motion.position_t1 - motion.position_t0
    for travel, expected in ((0.5, True), (200.0, False)):
        motion.position_t0, motion.position_t1 = start, start + travel * step
        with mock.patch.object(listed.ListedSearch, "_search", autospec=True, side_effect=AssertionError) as searched:
            if expected:
                with pytest.raises(AssertionError):
                    pgccd.resolve(scene, motion)
            else:
                assert pgccd.resolve(scene, motion).rounds > 0
        assert searched.called == expected
    assert is_short(4, 1) and not is_short(5, 1) and is_short(4, 0)


@pytest.mark.parametrize(
    ("far", "travel", "turn"), [(1e9, 1.0, 20.0), (0.0, 1e9, 20.0), (0.0, 1e-3, 4e5)], ids=["far", "fast", "spinning"]
)
def test_spheres_contain_bodies_that_are_stopped(far: float, travel: float, turn: float) -> None:
    """Exactly: the origin and the turn of a shortened path are rounded, which far from the origin of the world, and of
    bodies that spin, is more than the rounding of boxes and spheres lets in.
    """
    scene, motion = bodies_of(200, 3)
    start = 1e-3 * motion.position_t0 + far * torch.tensor([0.03, -1.0, 0.5], dtype=torch.float64)
    rotation = turn * torch.nn.functional.normalize(motion.rotation)
    end = start + travel * (motion.position_t1 - motion.position_t0)
    motion = pgccd.RigidMotion.from_rotation(start, motion.orientation_t0, end, rotation)
    bodies = pgccd.MovingBodies.of(scene, motion)
    grown = bodies.stoppable()
    assert bodies.boxes is not None and grown.boxes is not None
    fraction = 0.99 * torch.rand(200, dtype=torch.float64, generator=torch.Generator().manual_seed(1))
    ends: Any = shortened(scene, motion, fraction)
    least = Fraction(10**9)
    for row, f in enumerate(map(Fraction, fraction.tolist())):
        start, end, at = (
            [Fraction(x) for x in column[row].tolist()]
            for column in (motion.position_t0, motion.position_t1, ends.position_t1)
        )
        stray = sum(abs(x + f * (y - x) - z) for x, y, z in zip(start, end, at, strict=True))
        turned = sum(
            abs(f * Fraction(w) - Fraction(r))
            for w, r in zip(motion.rotation[row].tolist(), ends.rotation[row].tolist(), strict=True)
        )
        reach = Fraction(float(bodies.reach[row]))
        arm = reach + Fraction(float((bodies.centre_t0 - motion.position_t0)[row].norm()))
        growth = Fraction(float(grown.reach[row])) - reach
        assert stray + turned * arm <= growth
        furthest = max(map(abs, start + end))
        rotation = sum(abs(Fraction(w)) for w in motion.rotation[row].tolist())
        offset = sum(map(abs, map(Fraction, (bodies.centre_t0 - motion.position_t0)[row].tolist())))
        proven = Fraction(32, 2**53) * furthest + Fraction(4, 2**53) * rotation * (reach + offset)
        # As in docs/explanation/exactness.md.
        assert 1 - Fraction(1, 2**30) < growth / proven < 1 + Fraction(1, 100)
        unit, before = (Fraction(x) for x in bodies.boxes[row, :2].tolist())
        of_box = unit * (Fraction(float(grown.boxes[row, 1])) - before)
        assert proven <= of_box
        rounded_up = float((before + growth / unit) * (1 + Fraction(1, 2**22)))
        assert float(grown.boxes[row, 1]) == pytest.approx(rounded_up, rel=2.0**-22)
        least = min(least, growth / (stray + turned * arm)) if stray else least
    assert least < 64  # the bound is not far above what occurs


def test_bodies_about_their_origins_need_no_growth() -> None:
    motion = pgccd.RigidMotion.at_rest(torch.ones(2, 3), torch.eye(4)[[0, 0]])
    origins: tuple[Any, ...] = ("centroid", (20.0, 0.0, 0.0))
    for origin in origins:
        mesh = pgccd.Mesh.box([40.0, 1.0, 1.0], origin=origin)
        bodies = pgccd.MovingBodies.of(pgccd.Scene([mesh], [0, 0]), motion)
        assert (bodies.stoppable() is bodies) == (origin == "centroid")


def test_lists_are_searched_in_parts_and_found_again(monkeypatch: pytest.MonkeyPatch) -> None:
    scene, motion = bodies_of(60, 2)
    bodies = pgccd.MovingBodies.of(scene, motion)
    every, lengths = torch.combinations(torch.arange(60)), [1000, 1770]
    query = Query("first", 0.0, None, nonzero_toi=True)
    search = ListedSearch([], scene.meshes, bodies.tensors, None, lambda: every[: lengths.pop(0)], query)
    changed, fraction = torch.ones(60, dtype=torch.uint8), torch.full((60,), 0.9, dtype=torch.float64)

    def contacts(limit: int) -> dict[str, Tensor]:
        monkeypatch.setattr(listed, "memory_limit", lambda *_: limit)
        found, counts = search.find_round(changed, fraction, EXACTLY, fraction)
        columns = {name: torch.cat([getattr(part, name) for part in found]) for name in ("rows", "id", "toi")}
        assert int(counts[COUNT_ROWS["contacts"]]) == len(columns["toi"])
        return columns

    some = contacts(1 << 30)
    assert difference(contacts(100), some) is None  # in parts
    search.look_again()
    more = contacts(1 << 30)
    count = len(some["toi"])
    assert 20 < count < len(more["toi"]) and lengths == []
    assert difference({name: column[:count] for name, column in more.items()}, some) is None


@pytest.mark.parametrize("seed", range(12))
def test_random_scenes_with_and_without_a_list(device: torch.device, seed: int) -> None:
    made = random_scene(seed)
    scene, motion = made.scene().to(device), made.motion()
    if not isinstance(motion, pgccd.RigidMotion):
        pytest.skip("rounds search lists of rigid bodies")
    found = []
    for most in (10**9, 0):
        with mock.patch.object(listed, "_LONGEST", most):
            found.append(pgccd.resolve(scene, motion.to(device)))
    assert difference(*map(columns_of, found)) is None
