"""The search for first contacts in two parts: leaves that may meet first, then what may come before the contacts found.
On a GPU many body pairs are searched so, and crowded ones, of which the first part is a sample; on a CPU all, in
batches. It must report what a search for all contacts does.
"""

from __future__ import annotations

import functools
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from support.crowds import crowds
from support.deforming import Ends, crumpled, motion_of
from support.host_program import run_program
from support.reports import detected
from support.same_bits import assert_same, first_rows

import pgccd
from pgccd import narrow
from pgccd.runtime.sizes import sizes_of

# From this capacity on, a GPU searches in two parts.
MANY_PAIRS = 1 << 18

RADIUS = 1e-3  #: of a tip

CUBE_FACES = np.array(
    [[0, 1, 3], [0, 3, 2], [4, 6, 7], [4, 7, 5], [0, 4, 5], [0, 5, 1]]
    + [[2, 3, 7], [2, 7, 6], [0, 2, 6], [0, 6, 4], [1, 5, 7], [1, 7, 3]]
)

FIRST: list[narrow.Report] = [report for report in narrow.REPORTS if report != "all"]


def assert_parts_agree(
    scene: pgccd.Scene, motion: pgccd.RigidMotion | pgccd.VertexMotion, report: narrow.Report, separation: float
) -> pgccd.Contacts:
    """Detects with many and with few pairs of capacity, and as a crowded search."""
    whole = detected(scene, motion, report, separation)
    needed = whole.stats.needed
    assert needed is not None
    capacity = replace(needed.times(2.0), pairs=MANY_PAIRS, candidates=100_000, open=100_000, leaf_pairs=100_000)
    parts = detected(scene, motion, report, separation, capacity=capacity).trim()
    every = pgccd.detect(scene, motion, "all", separation)
    expected = every[first_rows(every, report)]
    if report == "any":
        assert torch.equal(parts.pairs, expected.pairs) and torch.equal(whole.pairs, expected.pairs)
    else:
        assert_same(parts, expected)
        assert_same(whole, expected)
    crowded = detected(scene, motion, report, separation, capacity=replace(capacity, crowded=True)).trim()
    assert torch.equal(crowded.pairs, parts.pairs)
    if report != "any":
        assert_same(crowded, parts)
    if scene.device.type == "cuda" and report == "first" and len(whole) > 20 and not sizes_of(needed).crowded:
        assert parts.stats.candidates < whole.stats.candidates
    return parts


@pytest.mark.parametrize("name", crowds())
@pytest.mark.parametrize("report", FIRST)
def test_rigid_bodies(device: torch.device, name: str, report: narrow.Report) -> None:
    crowd = crowds()[name]
    scene = pgccd.Scene(crowd.meshes, crowd.mesh_index, device=device, **crowd.filters)
    every_body = torch.arange(len(crowd.position))
    motion = crowd.motion(every_body).to(device)
    contacts = assert_parts_agree(scene, motion, report, crowd.min_separation)
    if report == "first":
        expected = crowd.detect("first")
        assert torch.equal(contacts.toi.cpu(), expected.toi) and torch.equal(contacts.pairs.cpu(), expected.pairs)


@pytest.mark.parametrize("turns", [0.3, 2.0, 40.0])
def test_spinning_bodies(device: torch.device, turns: float) -> None:
    """Many segments: a contact shortens the motion to fewer of them."""
    crowd = crowds()["faster than cells"]
    faster = replace(crowd, rotation=turns * crowd.rotation, position=0.6 * crowd.position)
    scene = pgccd.Scene(faster.meshes, faster.mesh_index, device=device)
    motion = faster.motion(torch.arange(len(faster.position))).to(device)
    assert len(assert_parts_agree(scene, motion, "first", 0.0)) > 20


@pytest.mark.parametrize("report", FIRST)
@pytest.mark.parametrize("self_collision", [False, True])
def test_deforming_bodies(device: torch.device, report: narrow.Report, self_collision: bool) -> None:
    shapes, ends = crumpled(6)
    scene = pgccd.Scene(shapes, device=device, self_collision=self_collision)
    assert assert_parts_agree(scene, motion_of(*ends, device=device), report, 0.01)


def crowd_in_motion(count: int) -> tuple[list[pgccd.Mesh], list[Ends]]:
    """Soft bodies that start apart and then move far into one another; and one far away from all."""
    shapes, ends = crumpled(count)
    rng = np.random.default_rng(6)
    places = 4.0 * np.stack(np.meshgrid(*3 * [np.arange(3)], indexing="ij"), -1).reshape(-1, 3)
    moved = []
    for (start, _), place in zip(ends, places, strict=False):
        at = start - start.mean(0) + place
        moved.append([at, at + rng.normal(0.0, 6.0, 3)])
    return [*shapes, shapes[0]], [*moved, [moved[0][0] + 1e3] * 2]


@pytest.mark.parametrize("report", ["first", "earliest"])
def test_one_body_against_itself_does_not_widen_the_search(report: narrow.Report) -> None:
    shapes, ends = crowd_in_motion(12)
    options: dict[str, Any] = {"report": report, "initial": "assume_free"}  # the body intersects itself at t = 0
    alone = pgccd.detect(pgccd.Scene(shapes[12:], self_collision=True), motion_of(ends[12], device="cpu"), **options)
    motion = motion_of(*ends, device="cpu")
    without = pgccd.detect(pgccd.Scene(shapes), motion, **options)
    with_self = pgccd.detect(pgccd.Scene(shapes, self_collision=torch.arange(13) == 12), motion, **options)
    assert len(without) > 0 and with_self.stats.candidates <= without.stats.candidates + alone.stats.candidates
    if report == "earliest":
        assert_same(with_self, without)


def test_the_earliest_contact_limits_the_search(device: torch.device) -> None:
    shapes, ends = crowd_in_motion(27)
    scene, motion = pgccd.Scene(shapes, device=device), motion_of(*ends, device=device)
    first = pgccd.detect(scene, motion, "first")
    earliest = assert_parts_agree(scene, motion, "earliest", 0.0)
    assert len(first) > 10 and len(earliest) == 1
    if device.type == "cpu":
        few = pgccd.detect(scene, motion, "earliest").stats
        assert few.candidates < first.stats.candidates / 10 and few.node_tests < first.stats.node_tests / 2


def test_the_earliest_is_not_the_likely_one(device: torch.device) -> None:
    """Two pairs of cubes: one is near earlier, the other touches earlier, by a part of 0.0005."""
    cube = pgccd.Mesh(np.array(list(np.ndindex(2, 2, 2))) * 2.0 - 1.0, CUBE_FACES)
    start = torch.tensor([[0.0, 0.0, 0.0], [22.0, 0.0, 0.0], [0.0, 9.0, 0.0], [11.995, 9.0, 0.0]]).double()
    velocity = torch.tensor([[0.0, 0.0, 0.0], [-200.0, 0.0, 0.0], [0.0, 0.0, 0.0], [-100.0, 0.0, 0.0]]).double()
    unit = torch.tensor([[1.0, 0.0, 0.0, 0.0]] * 4).double()
    scene = pgccd.Scene([cube], torch.zeros(4, dtype=torch.int32), device=device)
    motion = pgccd.RigidMotion.from_velocity(start, unit, velocity, torch.zeros(4, 3).double(), dt=1.0).to(device)
    earliest = assert_parts_agree(scene, motion, "earliest", 0.0)
    assert earliest.pairs.tolist() == [[2, 3]] and earliest.toi is not None
    assert float(earliest.toi) == pytest.approx(0.09995, rel=1e-4)


def joined(*parts: tuple[np.ndarray, np.ndarray]) -> pgccd.Mesh:
    """A mesh of several parts (vertices, faces)."""
    begin = np.cumsum([0] + [len(vertices) for vertices, _ in parts])
    faces = [faces + first for (_, faces), first in zip(parts, begin[:-1], strict=True)]
    return pgccd.Mesh(np.concatenate([vertices for vertices, _ in parts]), np.concatenate(faces))


def shards(rng: np.random.Generator, centre: float) -> tuple[np.ndarray, np.ndarray]:
    """Eight triangles across a path along x at y = centre, whose hull begins before most of them."""
    vertices = rng.uniform([0.55, -0.4, -0.4], [0.9, 0.4, 0.4], (24, 3)) + [0.0, centre, 0.0]
    return vertices, np.arange(24).reshape(8, 3)


def wall(x: float, centre: float) -> tuple[np.ndarray, np.ndarray]:
    """A fan of eight triangles in the plane of x, around y = centre."""
    angle = np.arange(8) * np.pi / 4
    rim = np.column_stack([np.full(8, x), centre + 0.1 * np.cos(angle), 0.1 * np.sin(angle)])
    k = np.arange(8)
    return np.concatenate([rim, [[x, centre, 0.0]]]), np.column_stack([k, (k + 1) % 8, np.full(8, 8)])


def tip(centre: float) -> tuple[np.ndarray, np.ndarray]:
    """An octahedron of eight triangles at y = centre."""
    axes = RADIUS * np.concatenate([np.eye(3), -np.eye(3)]) + [0.0, centre, 0.0]
    ends = np.array([[x, y, z] for x in (0, 3) for y in (1, 4) for z in (2, 5)])
    return axes, ends


def with_a_likely_pair(
    scene: pgccd.Scene, motion: pgccd.RigidMotion, toi: float
) -> tuple[pgccd.Scene, pgccd.RigidMotion]:
    """Two more bodies before them, plates deep within each other's spheres, that touch at `toi`."""
    plate = pgccd.Mesh((np.array(list(np.ndindex(2, 2, 2))) * 2.0 - 1.0) * [0.05, 5.0, 5.0], CUBE_FACES)
    far = torch.tensor([[100.0, 0.0, 0.0], [100.101, 0.0, 0.0]], dtype=torch.float64, device=scene.device)
    closer = torch.tensor([[0.001 / toi, 0.0, 0.0], [0.0, 0.0, 0.0]], dtype=torch.float64, device=scene.device)
    columns = (motion.position_t0, motion.position_t1, motion.orientation_t0)
    start, end, unit = (
        torch.cat([more, column]) for column, more in zip(columns, (far, far + closer, columns[2]), strict=True)
    )
    meshes = [*scene.meshes.meshes, plate]
    joined_scene = pgccd.Scene(meshes, [2, 2, *scene.mesh_index.tolist()], device=scene.device)
    return joined_scene, pgccd.RigidMotion(start, unit, end, unit)


def test_later_leaves_meet_just_before(device: torch.device) -> None:
    """Two tips move along x: one among shards, the other against a wall that it touches just before the first contact
    with the shards. Often the leaf of the shards begins before the wall.
    """
    rng = np.random.default_rng(4)
    at, unit = torch.zeros(2, 3, dtype=torch.float64), torch.tensor([[1.0, 0.0, 0.0, 0.0]] * 2).double()
    motion = pgccd.RigidMotion(at, unit, torch.tensor([[1.0, 0.0, 0.0], [0.0, 0.0, 0.0]]).double(), unit).to(device)
    tips, checked = joined(tip(-2.0), tip(2.0)), 0
    for _ in range(40):
        among = shards(rng, -2.0)
        alone = pgccd.detect(pgccd.Scene([tips, joined(among, wall(1.5, 2.0))], device=device), motion, "all")
        if len(alone) == 0:
            continue
        touched = float(alone.toi.min())  # type: ignore[union-attr]
        front = RADIUS + 0.9997 * touched
        scene = pgccd.Scene([tips, joined(among, wall(front, 2.0))], device=device)
        for report in ("first", "earliest"):
            first = assert_parts_agree(scene, motion, report, 0.0)
            assert first.toi is not None and 0.9995 * touched < float(first.toi) < 0.9998 * touched
        # Two others touch a little later, and are searched before: these leaves then begin at a part of that time.
        assert_parts_agree(*with_a_likely_pair(scene, motion, 1.002 * touched), "earliest", 0.0)
        checked += 1
    assert checked > 20


TIMES = """
#include <cstdio>
#include <random>
#include "kernels/traverse/leaf_separation.h"

using namespace pgccd::separation_detail;

std::mt19937 engine(1);
float uniform(float from, float to) { return std::uniform_real_distribution<float>(from, to)(engine); }

int main() {
  long late = 0, early = 0;
  for (int round = 0; round < 2000000; ++round) {
    const float threshold = round % 2 ? uniform(0.0f, 0.1f) : 0.0f;
    const float from = threshold + uniform(1e-6f, 1.0f), to = threshold - uniform(0.0f, 1.0f);
    if (!(from > threshold)) continue;
    const long double exact = ((long double)from - threshold) / ((long double)from - to);
    const float part = part_above(from, to, threshold);
    late += part > exact || part > 1.0f;
    early += part < exact * (1.0L - 1e-6L);
    const int segments = 1 + round % 64, k = 1 + round / 64 % segments;
    const long double time = (k - 1 + (long double)part) / segments;
    late += time_in_step(k, part, segments) > time;
    early += time_in_step(k, part, segments) < time * (1.0L - 1e-6L);
  }
  if (part_above(1.0f, NAN, 0.5f) != 0.0f || part_above(0.5f, 0.5f, 0.5f) != 0.0f) return 3;
  std::printf("%ld late, %ld early\\n", late, early);
  return late > 0 ? 1 : early > 0 ? 2 : 0;
}
"""


def test_leaves_do_not_meet_before_their_time(tmp_path: Path) -> None:
    run_program(TIMES, tmp_path)


@functools.cache
def many_at_the_start(
    depth: float, separation: float, device: torch.device
) -> tuple[pgccd.Scene, pgccd.RigidMotion, pgccd.Contacts]:
    """Spheres of which thousands of features touch at t = 0, or stay a little apart; and all contacts."""
    sphere = pgccd.Mesh.icosphere(1.0)
    start = torch.tensor([[0.0, 0.0, 0.0], [2.0 - depth, 0.05, 0.02], [-0.5, 0.1, -1.8]], dtype=torch.float64)
    unit = torch.tensor([[1.0, 0.0, 0.0, 0.0]] * 3, dtype=torch.float64)
    step = torch.tensor([[0.02, 0.0, 0.0], [0.0, 0.01, 0.0], [0.0, 0.0, 0.0]], dtype=torch.float64)
    scene = pgccd.Scene([sphere], [0, 0, 0], device=device)
    motion = pgccd.RigidMotion(start, unit, start + step, unit).to(device)
    return scene, motion, pgccd.detect(scene, motion, "all", separation)


@pytest.mark.parametrize("separation", [0.0, 0.3, 1.0])
@pytest.mark.parametrize("depth", [-0.01, 0.0, 0.4])
@pytest.mark.parametrize("report", FIRST)
def test_one_contact_of_many_at_the_start(
    report: narrow.SearchReport, depth: float, separation: float, device: torch.device
) -> None:
    """It is the first one, found by few of the features."""
    scene, motion, every = many_at_the_start(depth, separation, device)
    found = detected(scene, motion, report, separation)
    expected = every[first_rows(every, report)]
    assert torch.equal(found.pairs, expected.pairs)
    if isinstance(found, pgccd.Contacts):
        assert_same(found, expected)
    if separation == 0.0:
        return
    assert every.stats.candidates > 10_000
    # A GPU searches all at once what fits, and in parts from then on; in a graph as well.
    capacity = pgccd.Capacity.of(3)
    for _ in range(4):
        hits = detected(scene, motion, report, separation, capacity=capacity)
        if not bool(hits.overflow):
            break
        with pytest.raises(pgccd.CapacityError) as raised:
            hits.trim()
        capacity = raised.value.larger
    within = hits.trim()
    assert torch.equal(within.pairs, expected.pairs)
    if isinstance(within, pgccd.Contacts):
        assert_same(within, expected)
    assert within.stats.candidates < every.stats.candidates / 3


@pytest.mark.parametrize("report", ["first", "earliest"])
def test_one_vertex_touches_faces_of_many_leaves(report: narrow.Report, device: torch.device) -> None:
    """The smallest vertex of a box is near all faces of a sphere, in more leaves than one batch."""
    start = torch.tensor([[0.0, 0.0, 0.0], [1.3, 0.0, 0.0]], dtype=torch.float64)
    unit = torch.tensor([[1.0, 0.0, 0.0, 0.0]] * 2, dtype=torch.float64)
    scene = pgccd.Scene([pgccd.Mesh.box([0.1, 0.1, 0.1]), pgccd.Mesh.icosphere(1.0)], device=device)
    motion = pgccd.RigidMotion(start, unit, start, unit).to(device)
    found, every = (detected(scene, motion, each, 3.0) for each in (report, "all"))
    assert_same(found, every[first_rows(every, report)])
    assert found.features.tolist() == [[0, 0]] and len(every) > 10_000


@pytest.mark.parametrize("threads", [1, 3])
def test_many_bodies_that_intersect(threads: int, device: torch.device) -> None:
    """Any contact, and the earliest of the scene, need a small part of the leaves near one another."""
    random = np.random.default_rng(3)
    start = torch.from_numpy(random.uniform(0.0, 4.0, (40, 3)))
    unit = torch.tensor([[1.0, 0.0, 0.0, 0.0]] * 40, dtype=torch.float64)
    scene = pgccd.Scene([pgccd.Mesh.icosphere(1.0)], [0] * 40, device=device)
    step = torch.from_numpy(random.normal(0.0, 0.05, (40, 3)))
    motion = pgccd.RigidMotion(start, unit, start + step, unit).to(device)
    before = torch.get_num_threads()
    torch.set_num_threads(threads)
    try:
        found = {report: detected(scene, motion, report) for report in narrow.REPORTS}
    finally:
        torch.set_num_threads(before)
    every = found["all"]
    for report in FIRST:
        expected = every[first_rows(every, report)]
        assert torch.equal(found[report].pairs, expected.pairs)
        if report != "any":
            assert_same(found[report], expected)
    assert len(found["any"]) > 100
    if device.type == "cpu":
        assert found["any"].stats.node_tests < found["first"].stats.node_tests / 2
        assert found["earliest"].stats.node_tests < found["first"].stats.node_tests / 10


@pytest.mark.parametrize("end", [-3.0, 79.0])
def test_the_only_contact_comes_after_many_leaves(end: float, device: torch.device) -> None:
    """Forty clouds of small triangles are among one another from the start, and none touches; tips at an end do."""
    random = np.random.default_rng(8)

    def clouds() -> tuple[np.ndarray, np.ndarray]:
        centres = random.uniform(0.0, 1.0, (40, 8, 1, 3)) + 2.0 * np.arange(40)[:, None, None, None] * [1.0, 0.0, 0.0]
        corners = centres + random.normal(0.0, 1e-4, (40, 8, 3, 3))
        return corners.reshape(-1, 3), np.arange(40 * 8 * 3).reshape(-1, 3)

    at_end = [end, 0.5, 0.5]
    shapes = [joined(clouds(), (part[0] + at_end, part[1])) for part in (tip(0.0), wall(2.0 * RADIUS, 0.0))]
    scene = pgccd.Scene(shapes, device=device)
    at, unit = torch.zeros(2, 3, dtype=torch.float64), torch.tensor([[1.0, 0.0, 0.0, 0.0]] * 2).double()
    motion = pgccd.RigidMotion(at, unit, torch.tensor([[2.0 * RADIUS, 0.0, 0.0], [0.0] * 3]).double(), unit).to(device)
    first = assert_parts_agree(scene, motion, "first", 0.0)
    assert first.toi.tolist() == pytest.approx([0.5], abs=1e-3)
    assert assert_parts_agree(scene, motion, "any", 0.0).pairs.tolist() == [[0, 1]]
