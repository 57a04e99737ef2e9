"""Trajectories: all segments in one call, bitwise equal to one call per segment."""

from __future__ import annotations

from fractions import Fraction

import numpy as np
import pytest
import torch
from support.origins import recentred
from support.reports import detected
from support.shapes import bumpy, tensors, tetrahedron, unit_quaternions

import pgccd
from pgccd.search.trajectories import time_along

COLUMNS = ("toi", "kind", "features", "coordinates", "point", "normal", "status")


def walk(rng: np.random.Generator, bodies: int, waypoints: int, side: float) -> tuple[np.ndarray, np.ndarray]:
    """Positions (T, N, 3) and orientations (T, N, 4) of a random walk in a box."""
    start = rng.uniform(0.0, side, (1, bodies, 3))
    position = start + np.concatenate(
        [np.zeros((1, bodies, 3)), 0.4 * rng.normal(size=(waypoints - 1, bodies, 3)).cumsum(axis=0)]
    )
    orientation = unit_quaternions(rng, bodies)[None] + 0.3 * rng.normal(size=(waypoints, bodies, 4)).cumsum(axis=0)
    return position, orientation / np.linalg.norm(orientation, axis=2, keepdims=True)


def small_scene(
    device: torch.device, path: str = "rigid", waypoints: int = 9, **filters: object
) -> tuple[pgccd.Scene, pgccd.Trajectory]:
    rng = np.random.default_rng(6)
    meshes = [tetrahedron(0.6), recentred(tetrahedron(0.5), np.array([0.7, 0.0, 0.0])), bumpy(rng, 0, size=0.5)]
    columns = tensors(*walk(rng, 40, waypoints, 5.0), device=device)
    scene = pgccd.Scene(meshes, torch.arange(40) % 3, device, **filters)  # type: ignore[arg-type]
    return scene, pgccd.Trajectory(*columns, path=path)  # type: ignore[arg-type]


def filters_of(count: int) -> dict[str, torch.Tensor]:
    rng = np.random.default_rng(3)
    return {
        "group": torch.tensor(rng.integers(1, 8, count)),
        "world": torch.tensor(rng.integers(0, 2, count)),
        "static": torch.tensor(rng.integers(0, 4, count) == 0),
        "margin": torch.tensor(rng.uniform(0.0, 0.1, count)),
    }


def assert_same_rows(found: pgccd.TrajectoryContacts, singles: list[pgccd.Contacts]) -> None:
    """For report="all", or any other report within one segment."""
    segment = [np.full(len(hits), k) for k, hits in enumerate(singles)]
    assert found.segment.tolist() == np.concatenate(segment).tolist()
    for name in ("pairs", *COLUMNS):
        assert torch.equal(getattr(found, name), torch.cat([getattr(hits, name) for hits in singles])), name
    nearest = (found.segment + found.toi).cpu() / len(singles)
    assert bool(((found.time.cpu() <= nearest) & (found.time.cpu() >= nearest * (1.0 - 2.0**-51))).all())


@pytest.mark.parametrize("path", ["rigid", "linear"])
@pytest.mark.parametrize("filtered", [False, True])
@pytest.mark.parametrize("broad_phase", ["sweep", "grid", "lbvh"])
def test_one_call_finds_what_single_calls_find(
    path: str, filtered: bool, broad_phase: str, device: torch.device
) -> None:
    scene, trajectory = small_scene(device, path, **(filters_of(40) if filtered else {}))
    options = {"min_separation": 0.01, "broad_phase": broad_phase}
    singles = [
        pgccd.detect(scene, trajectory.segment(k), "all", **options)  # type: ignore[call-overload]
        for k in range(trajectory.segment_count)
    ]
    assert sum(map(len, singles)) > 30
    found = pgccd.detect(scene, trajectory, "all", **options)  # type: ignore[call-overload]
    assert_same_rows(found, singles)
    assert found.stats.bodies == 40 and found.stats.contacts == len(found)
    streamed = pgccd.detect(scene, trajectory, "all", memory_budget=1, **options)  # type: ignore[call-overload]
    assert_same_rows(streamed, singles)

    # The first of each pair, in the first segment in which it collides.
    first: dict[tuple[int, ...], tuple[object, ...]] = {}
    for k in range(trajectory.segment_count):
        hits = pgccd.detect(scene, trajectory.segment(k), **options)  # type: ignore[call-overload]
        for row, pair in enumerate(map(tuple, hits.pairs.tolist())):
            first.setdefault(pair, (k, *(getattr(hits, name)[row].tolist() for name in COLUMNS)))
    found = pgccd.detect(scene, trajectory, **options)  # type: ignore[call-overload]
    assert list(map(tuple, found.pairs.tolist())) == sorted(first)
    for row, pair in enumerate(sorted(first)):
        got = (int(found.segment[row]), *(getattr(found, name)[row].tolist() for name in COLUMNS))
        assert got == first[pair]
    colliding = pgccd.collide(scene, trajectory, **options)  # type: ignore[arg-type]
    assert torch.equal(colliding.pairs, found.pairs) and type(colliding) is pgccd.CollidingPairs

    # The earliest of all pairs.
    earliest = pgccd.detect(scene, trajectory, "earliest", **options)  # type: ignore[call-overload]
    segment = next(k for k, hits in enumerate(singles) if len(hits))
    single = pgccd.detect(scene, trajectory.segment(segment), "earliest", **options)  # type: ignore[call-overload]
    assert earliest.segment.tolist() == [segment]
    for name in ("pairs", *COLUMNS):
        assert torch.equal(getattr(earliest, name), getattr(single, name)), name

    # First times cover the whole trajectory.
    body = torch.full((40,), torch.inf, dtype=torch.float64)
    for pair, time in zip(found.pairs.tolist(), found.time.tolist(), strict=True):
        for k in pair:
            body[k] = min(float(body[k]), time)
    assert torch.equal(found.first_toi("body").cpu(), body)
    assert float(found.first_toi()) == float(earliest.time[0]) == float(body.min())
    assert found.first_toi("world").shape == (2 if filtered else 1,)


def test_a_thousand_bodies_through_64_waypoints(device: torch.device) -> None:
    rng = np.random.default_rng(1)
    columns = tensors(*walk(rng, 1000, 64, 40.0), device=device)
    scene = pgccd.Scene([tetrahedron(0.5)], torch.zeros(1000, dtype=torch.int32), device)
    trajectory = pgccd.Trajectory(*columns)
    found = pgccd.detect(scene, trajectory, "all")
    assert_same_rows(found, [pgccd.detect(scene, trajectory.segment(k), "all") for k in range(63)])
    assert len(found) > 500


def test_vertices_and_self_collision(device: torch.device) -> None:
    rng = np.random.default_rng(2)
    mesh = bumpy(rng, 0)
    frames = mesh.vertices.numpy().repeat(3, 0).reshape(-1, 3)
    frames = np.concatenate([mesh.vertices.numpy() + [1.5 * k, 0, 0] for k in range(3)])
    frames = frames[None] + np.concatenate(
        [np.zeros((1, *frames.shape)), 0.25 * rng.normal(size=(5, *frames.shape)).cumsum(axis=0)]
    )
    scene = pgccd.Scene([mesh], [0, 0, 0], device, self_collision=[True, False, True])
    trajectory = pgccd.Trajectory(torch.tensor(frames, device=device))
    singles = [pgccd.detect(scene, trajectory.segment(k), "all") for k in range(5)]
    found = pgccd.detect(scene, trajectory, "all")
    assert_same_rows(found, singles)
    own = found.pairs[:, 0] == found.pairs[:, 1]
    assert 0 < int(own.sum()) < len(found)
    assert set(found.pairs[own][:, 0].tolist()) == {0, 2}


def test_nothing_to_find(device: torch.device) -> None:
    x = torch.zeros(4, 2, 3, dtype=torch.float64, device=device)
    x[:, 1] = 9.0
    q = torch.tensor([1.0, 0.0, 0.0, 0.0], device=device).expand(4, 2, 4)
    for count in (2, 0):
        scene = pgccd.Scene([tetrahedron()], torch.zeros(count, dtype=torch.int32), device)
        trajectory = pgccd.Trajectory(x[:, :count], q[:, :count])
        for report in ("any", "first", "all", "earliest"):
            hits = detected(scene, trajectory, report)
            assert len(hits) == 0
            if report != "any":
                assert hits.time.shape == (0,) and float(hits.first_toi()) == float("inf")
                assert hits.first_toi("body").tolist() == [float("inf")] * count


def test_what_a_trajectory_cannot_be() -> None:
    x, q = torch.zeros(3, 2, 3), torch.tensor([1.0, 0.0, 0.0, 0.0]).repeat(3, 2, 1)
    far, zero = x.clone(), q.clone()
    far[1, 1, 2] = float("nan")
    zero[2, 0] = 0.0
    cases = [
        ((x[:1], q[:1]), "position: expected shape .* with T >= 2"),
        ((x[0], q), "position: expected shape"),
        ((x, q[:, :1]), r"orientation: expected shape \(3, 2, 4\), as of position"),
        ((far, q), "position: waypoint 1, body 1: expected finite"),
        ((x, zero), "orientation: waypoint 2, body 0: expected a unit quaternion"),
        ((far,), "position: waypoint 1, vertex 1: expected finite"),
        ((x, q, "straight"), "path: "),
    ]
    for arguments, message in cases:
        with pytest.raises(ValueError, match="^" + message):
            pgccd.Trajectory(*arguments)  # type: ignore[arg-type]
    with pytest.raises(TypeError, match="^position: "):
        pgccd.Trajectory(x.int(), q)
    scene, trajectory = pgccd.Scene([tetrahedron()] * 3), pgccd.Trajectory(x, q)
    with pytest.raises(ValueError, match="^motion: has 2 bodies, the scene 3"):
        pgccd.detect(scene, trajectory)
    with pytest.raises(ValueError, match="^motion: has 2 vertices, the scene 12"):
        pgccd.detect(scene, pgccd.Trajectory(x))
    two = pgccd.Scene([tetrahedron()] * 2)
    with pytest.raises(ValueError, match="^capacity: cannot be given"):
        pgccd.detect(two, trajectory, capacity=pgccd.Capacity.of(10))  # type: ignore[call-overload]
    with pytest.raises(IndexError, match="^index: "):
        trajectory.segment(2)


def test_times_along_a_trajectory_are_never_late(device: torch.device) -> None:
    rng = np.random.default_rng(3)
    for count in (1, 3, 7, 3000, 2**20 + 1):
        segment = rng.integers(0, count, 3000)
        toi = np.where(rng.random(3000) < 0.1, rng.integers(0, 2, 3000), rng.random(3000) ** 9)
        time = time_along(*tensors(segment, toi, device=device), count)
        for s, t, found in zip(segment.tolist(), toi.tolist(), time.tolist(), strict=True):
            exact = (s + Fraction(t)) / count
            assert 0 <= exact - Fraction(found) <= exact * Fraction(2) ** -51, (count, s, t)
