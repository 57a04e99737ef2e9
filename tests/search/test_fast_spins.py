"""Bodies that turn many times in a step: the contacts of all feature pairs, found by testing few of them."""

from __future__ import annotations

import itertools
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
import torch
from strategies import contacts
from support.candidates import assert_touching, missed
from support.cases import few_and_many, mostly_slow
from support.host_program import run_program
from support.origins import moved_to
from support.reports import detected
from support.same_bits import columns_of, difference, first_rows
from support.shapes import bumpy, tensors, unit_quaternions

import pgccd
from pgccd.runtime.sizes import sizes_of
from pgccd.search import narrow

COLUMNS = ("pair", "kind", "features", "status", "toi", "coordinates", "point", "normal")


@dataclass
class Spinning:
    """Bodies that turn about origins at a distance from them, most through each other's way."""

    mesh: pgccd.Mesh
    scene: pgccd.Scene
    motion: pgccd.RigidMotion
    pairs: torch.Tensor

    @staticmethod
    def of(turn: float, arm: float, device: torch.device, subdivisions: int = 0, seed: int = 2) -> Spinning:
        rng, count = np.random.default_rng([seed, int(arm)]), 6
        mesh = bumpy(rng, subdivisions)
        mesh = pgccd.Mesh(mesh.vertices.numpy() + [arm, 0.0, 0.0], mesh.faces)
        position = (1.2 + 0.5 * arm) * rng.uniform(-1.0, 1.0, (count, 3))
        rotation = rng.normal(size=(count, 3))
        rotation *= turn * rng.uniform(0.5, 1.0, (count, 1)) / np.linalg.norm(rotation, axis=1, keepdims=True)
        moved = position + 0.1 * rng.normal(size=(count, 3))
        x0, q, x1, w = tensors(position, unit_quaternions(rng, count), moved, rotation, device=device)
        scene = pgccd.Scene([mesh], torch.zeros(count, dtype=torch.int64), device=device)
        pairs = torch.combinations(torch.arange(count, device=device))
        return Spinning(mesh, scene, pgccd.RigidMotion.from_rotation(x0, q, x1, w), pairs)

    @property
    def bodies(self) -> pgccd.MovingBodies:
        return pgccd.MovingBodies.of(self.scene, self.motion)

    def every_candidate(self) -> torch.Tensor:
        vertices, edges, faces = len(self.mesh.vertices), len(self.mesh.edges), len(self.mesh.faces)
        kinds = pgccd.Kind
        rows = []
        for kind, first, second in (
            (kinds.VF_AB, vertices, faces),
            (kinds.VF_BA, faces, vertices),
            (kinds.EE, edges, edges),
        ):
            features = torch.cartesian_prod(torch.arange(first), torch.arange(second))
            rows.append(torch.cat([torch.full((len(features), 1), int(kind)), features], dim=1))
        every, count = torch.cat(rows), len(self.pairs)
        pair = torch.arange(count).repeat_interleave(len(every))[:, None]
        return torch.cat([pair, every.repeat(count, 1)], dim=1).to(torch.int32).to(self.scene.device)

    def candidates(self) -> tuple[torch.Tensor, int]:
        found, node_tests = pgccd.traverse.find_candidates(self.bodies, self.pairs, initial="assume_free")
        return found, int(node_tests)


@pytest.mark.parametrize(
    ("turn", "arm"),
    mostly_slow(itertools.product((30.0, 90.0, 400.0), (0.0, 3.0, 20.0)), [(30.0, 20.0), (90.0, 3.0), (400.0, 0.0)]),
)
def test_contacts_are_those_of_all_feature_pairs(device: torch.device, turn: float, arm: float) -> None:
    spinning = Spinning.of(turn, arm, device)
    found = spinning.candidates()[0]
    rows: list[dict[str, torch.Tensor]] = []
    for candidates in (found, spinning.every_candidate()):
        result = narrow.find_contacts(spinning.bodies, spinning.pairs, candidates, "all")
        rows.append(dict(zip(COLUMNS, result, strict=True)))
    assert len(rows[0]["toi"]) > 50 and difference(*rows) is None


@pytest.mark.parametrize(
    ("turn", "arm"),
    mostly_slow(itertools.product((90.0, 2000.0), (0.0, 3.0, 20.0)), [(90.0, 3.0), (90.0, 20.0), (2000.0, 0.0)]),
)
def test_one_contact_of_each_pair_is_the_first_of_all(device: torch.device, turn: float, arm: float) -> None:
    """Also where the first is found long after the part of the step that is searched at first."""
    spinning = Spinning.of(turn, arm, device)
    every = pgccd.detect(spinning.scene, spinning.motion, "all", initial="assume_free")
    hits = pgccd.detect(spinning.scene, spinning.motion, "first", initial="assume_free")
    expected = {name: column[first_rows(every, "first").cpu()] for name, column in columns_of(every).items()}
    assert len(hits) > 0 and difference(columns_of(hits), expected) is None
    touching = pgccd.collide(spinning.scene, spinning.motion, initial="assume_free")
    assert torch.equal(touching.pairs, hits.pairs)
    earliest = pgccd.detect(spinning.scene, spinning.motion, "earliest", initial="assume_free")
    assert earliest.toi.tolist() == [float(hits.toi.min())] * len(earliest) != []


def test_candidates_do_not_become_all_feature_pairs(device: torch.device) -> None:
    """In many turns more and more features meet: candidates are few for each of them."""
    for arm in (3.0, 20.0):
        for turn in (30.0, 100.0, 500.0):
            spinning = Spinning.of(turn, arm, device, subdivisions=1)
            found, node_tests = spinning.candidates()
            meeting = len(pgccd.detect(spinning.scene, spinning.motion, "all", initial="assume_free"))
            assert meeting <= len(found) <= 3 * meeting + 1000
            assert node_tests < 20_000


@pytest.mark.parametrize("report", ["any", "first"])
def test_early_contacts_end_the_search(report: narrow.Report) -> None:
    """Bodies that meet in the first turn, and then turn up to a thousand times."""
    counts = []
    for turn in (100.0, 10_000.0):
        spinning = Spinning.of(turn, 3.0, torch.device("cpu"))
        pairs = pgccd.collide(spinning.scene, spinning.motion).pairs
        hits = detected(spinning.scene, spinning.motion, report, pairs=pairs)
        assert len(hits) == len(pairs) > 5
        counts.append((hits.stats.candidates, hits.stats.node_tests))
    (candidates, node_tests), (candidates_later, node_tests_later) = counts
    assert candidates_later < 2 * candidates + 100 and node_tests_later < 2 * node_tests + 100


def on_one_circle(count: int, device: torch.device) -> tuple[pgccd.Scene, pgccd.RigidMotion]:
    """Bodies far from their origins, on one circle, at different speeds: they meet at all times of the step."""
    rng = np.random.default_rng(5)
    mesh = bumpy(rng)
    mesh = pgccd.Mesh(mesh.vertices.numpy() + [200.0, 0.0, 0.0], mesh.faces)
    angle, turn = rng.uniform(0.0, 2.0 * np.pi, count), rng.uniform(40.0, 90.0, count) * rng.choice([-1.0, 1.0], count)
    zero = np.zeros(count)
    q = np.column_stack([np.cos(angle / 2.0), zero, zero, np.sin(angle / 2.0)])
    position = np.column_stack([zero, zero, rng.uniform(-1.0, 1.0, count)])
    x0, q, x1, w = tensors(position, q, position, np.column_stack([zero, zero, turn]), device=device)
    scene = pgccd.Scene([mesh], torch.zeros(count, dtype=torch.int64), device=device)
    return scene, pgccd.RigidMotion.from_rotation(x0, q, x1, w)


def test_a_shorter_search_of_one_pair_leaves_the_others_alone(device: torch.device) -> None:
    """Pairs that turn fast keep two poses each, also once they are searched until their first contact only: there the
    time divided by its segments is longer than they ask for.
    """
    scene, motion = on_one_circle(16, device)
    expected = pgccd.detect(*on_one_circle(16, torch.device("cpu")), "first", initial="assume_free")
    assert len(expected) == len(pgccd.collide(scene, motion).pairs) > 60
    assert int(((expected.toi > 0.01) & (expected.toi < 0.05)).sum()) > 20
    capacity = sizes_of(pgccd.detect(scene, motion, "first", initial="assume_free").stats.needed).times(2.0)
    for crowded in (False, True):
        given = replace(capacity, crowded=crowded, poses=100_000, candidates=1 << 23, leaf_pairs=1 << 22, open=1 << 22)
        found = pgccd.detect(scene, motion, "first", initial="assume_free", capacity=given).trim()
        assert difference(columns_of(found), columns_of(expected)) is None


def test_a_shorter_motion_that_turns_fast_still_does(tmp_path: Path) -> None:
    """Its number of segments is bounded by its turn, and by what the search has memory for from below."""
    program = """
#include <cstdio>
#include "kernels/traverse/rigid_sweep.h"

using namespace pgccd;

int main() {
  const MeshOffsets offsets[2] = {};
  const int32_t mesh_index[2] = {0, 0};
  const double position[6] = {0.0, 0.0, 0.0, 0.0, 0.0, 1.0}, radius[2] = {100.0, 0.01};
  const double orientation[8] = {1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0};
  const double rotation[6] = {0.0, 0.0, 90.0, 0.0, 0.0, 60.0};
  RigidBodies bodies{};
  bodies.meshes.offsets = offsets;
  bodies.mesh_index = mesh_index;
  bodies.centres = {position, position, radius, 2};
  bodies.orientation = orientation;
  bodies.rotation = rotation;
  SweepSettings settings{};
  settings.divides_time = true;
  for (double until = 1.0; until > 1e-6; until *= 0.9) {
    const RigidSweep sweep(bodies, 0, 1, settings, until), kept(bodies, 0, 1, settings, until, kStoredSegments + 1);
    if (!kept.turns_fast() || kept.segment_count < sweep.segment_count) return 1;
    std::printf("%d", sweep.turns_fast());
  }
}
"""
    assert set(run_program(program, tmp_path)) == {"0", "1"}


def test_poses_of_many_segments_are_not_kept(device: torch.device) -> None:
    """On a device the memory of a pair does not grow with its turn."""
    spinning = Spinning.of(1000.0, 3.0, device)
    hits = pgccd.detect(spinning.scene, spinning.motion, "first")
    assert hits.stats.needed.poses == 0


@few_and_many("count", 20, 60)
@pytest.mark.parametrize("turn", [(90.0, 3.0), (400.0, 300.0), (3000.0, 1.0)])
def test_tips_graze_within_spans_of_many_segments(device: torch.device, turn: tuple[float, float], count: int) -> None:
    """Each tip's arc bulges towards the other, in the middle of a span too."""
    for sizes in ((1.0, 1.0), (1.0, 0.125)):
        meetings = contacts.tips(np.random.default_rng(6), count, turn, sizes=sizes)
        assert_touching(meetings, 1e-11)
        assert missed(meetings, device, 1e-11) == []


def test_spindles_on_large_arcs_graze(device: torch.device) -> None:
    """About points far behind them: arcs, and how far they stray from chords, are large for the size of the bodies."""
    for turn in (40.0, 50.0, 60.0, 75.0, 90.0):
        meetings = contacts.tips(np.random.default_rng(7), 20, (turn, turn), time=np.full(20, 0.5))
        behind = [-30.0 * mesh.vertices.numpy()[0] for mesh in meetings.bodies.meshes]
        meetings = replace(meetings, bodies=moved_to(meetings.bodies, behind))
        assert_touching(meetings, 1e-11)
        assert missed(meetings, device, 1e-11) == []
