"""Deforming bodies that collide with themselves: against exact arithmetic over all feature pairs, and properties."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from strategies import TriMesh, meshes
from support.cases import few_and_many
from support.deforming import Ends, crumpled, motion_of, noisy
from support.reports import detected
from support.same_bits import COLUMNS, assert_same
from support.shapes import approaching, bumpy, tensors
from support.truth import (
    assert_linear_rows_close,
    assert_nothing_invented,
    assert_nothing_missed,
    rows_of,
    self_truth,
    without_crossings,
)

import pgccd
from pgccd import narrow


def own_hits(
    mesh: pgccd.Mesh, ends: Ends, device: torch.device, report: narrow.Report = "all", *args: Any, **options: Any
) -> pgccd.Contacts:
    scene = pgccd.Scene([mesh], device=device, self_collision=True)
    return detected(scene, motion_of(ends, device=device), report, *args, **options)


def assert_canonical(mesh: pgccd.Mesh, kinds: torch.Tensor, features: torch.Tensor) -> None:
    """Asserts only VF_AB, EF_AB, and EE with the smaller edge first; no duplicates, and no features that share a
    vertex.
    """
    rows = torch.cat([kinds.long()[:, None], features.long()], dim=1).cpu()
    assert len(torch.unique(rows, dim=0)) == len(rows), "listed twice"
    is_edges, is_crossing = rows[:, 0] == pgccd.Kind.EE, rows[:, 0] == pgccd.Kind.EF_AB
    assert bool((is_edges | is_crossing | (rows[:, 0] == pgccd.Kind.VF_AB)).all())
    assert bool((rows[:, 1] < rows[:, 2])[is_edges].all())
    faces, edges = mesh.faces.long(), mesh.edges.long()
    edge_rows, face_rows, crossings = rows[is_edges], rows[~is_edges & ~is_crossing], rows[is_crossing]
    assert not bool((edges[crossings[:, 1]][:, :, None] == faces[crossings[:, 2]][:, None]).any())
    assert not bool((edges[edge_rows[:, 1]][:, :, None] == edges[edge_rows[:, 2]][:, None]).any())
    assert not bool((face_rows[:, 1, None] == faces[face_rows[:, 2]]).any())


def check(mesh: pgccd.Mesh, ends: Ends, device: torch.device, separation: float = 0.0, tolerance: float = 1e-7) -> int:
    """Checks one body against brute force; returns the number of contacts."""
    hits = without_crossings(own_hits(mesh, ends, device, "all", separation, tolerance=tolerance))
    faces = mesh.faces.long().numpy()
    rows, truth = rows_of(hits, 0, 0), self_truth(ends, faces, separation)
    assert len(rows) == len(hits)
    assert_canonical(mesh, hits.kind, hits.features)
    assert_nothing_missed(rows, truth)
    size = max(float(np.ptp(x, axis=0).max()) for x in ends)
    assert_linear_rows_close(rows, [ends, ends], [faces, faces], separation + tolerance + 1e-13 * size)
    assert_nothing_invented(rows, truth)
    assert hits.stats.unresolved == sum(row.status == pgccd.Status.UNRESOLVED for row in rows.values())
    return len(truth.contacts)


def sheet(columns: int, rows: int) -> tuple[np.ndarray, np.ndarray]:
    """Vertices (v, 3) of a flat rectangle of unit cells in the plane z = 0, x and y from 0, and faces."""
    x, y = np.meshgrid(np.arange(columns + 1.0), np.arange(rows + 1.0))
    number = np.arange(x.size).reshape(x.shape)
    a, b, c, d = (k.ravel() for k in (number[:-1, :-1], number[:-1, 1:], number[1:, 1:], number[1:, :-1]))
    faces = np.concatenate([np.stack([a, b, c], axis=1), np.stack([a, c, d], axis=1)])
    return np.stack([x.ravel(), y.ravel(), 0.0 * x.ravel()], axis=1), faces


def rolled(vertices: np.ndarray, angle: float) -> np.ndarray:
    """A sheet bent about the y axis, by `angle` radians per unit of x."""
    x = vertices[:, 0]
    return np.stack([np.sin(angle * x) / angle, vertices[:, 1], (1.0 - np.cos(angle * x)) / angle], axis=1)


@pytest.mark.parametrize("bend", [0.1, 0.9])
def test_sheet_that_rolls_up(device: torch.device, bend: float) -> None:
    """Bent by more than a full turn, it passes through itself."""
    rng = np.random.default_rng(1)
    flat, faces = sheet(10, 5)
    ends = [noisy(rng, flat, 0.02), noisy(rng, rolled(flat, bend), 0.02)]
    found = check(pgccd.Mesh(flat, faces), ends, device)
    assert (found > 30) if bend > 2 * np.pi / 10 else (found == 0)


@pytest.mark.parametrize("depth", [0.0, 1e-9, 0.3])
def test_sheet_that_folds_onto_itself(device: torch.device, depth: float) -> None:
    """One half is folded onto the other, or through it by `depth`."""
    flat, faces = sheet(8, 3)
    folded = flat.copy()
    right = flat[:, 0] > 4
    folded[right, 0] = 8.0 - flat[right, 0]
    folded[right, 2] = -depth
    raised = flat.copy()
    raised[right, 0] = 8.0 - flat[right, 0] + 0.25
    raised[right, 2] = 1.0
    assert check(pgccd.Mesh(flat, faces), [raised, folded], device) > 100


def test_waves_through_one_another(device: torch.device) -> None:
    """A sheet with two layers that cross: nearly all nearby features touch."""
    rng = np.random.default_rng(2)
    flat, faces = sheet(12, 6)
    layer = np.where(flat[:, 0] < 6, 1.0, -1.0)[:, None] * np.array([[0.0, 0.0, 1.0]])
    under = flat - np.array([[1.0, 0.0, 0.0]]) * 6.3 * (flat[:, :1] >= 6)
    ends = [noisy(rng, under + layer, 0.2), noisy(rng, under - layer, 0.2)]
    assert check(pgccd.Mesh(flat, faces), ends, device) > 200


@pytest.mark.parametrize("shake", [0.05, 0.4])
@pytest.mark.parametrize("separation", [0.0, 0.03])
@few_and_many("seeds", 1, 2)
def test_blobs(device: torch.device, shake: float, separation: float, seeds: int) -> None:
    for seed in range(seeds):
        rng = np.random.default_rng([3, int(100 * shake), seed])
        mesh = bumpy(rng, 1)
        ends = [noisy(rng, mesh.vertices.numpy(), shake) for _ in range(2)]
        assert check(mesh, ends, device, separation) > (100 if shake > 0.1 else -1)


@few_and_many("subdivisions", 2, 3)
def test_deep_hierarchy(device: torch.device, subdivisions: int) -> None:
    """Many leaves, most of which never come near one another."""
    rng = np.random.default_rng(4)
    mesh = bumpy(rng, subdivisions, height=0.02)
    inside_out = mesh.vertices.numpy() * np.array([1.0, 1.0, -0.1])
    ends = [mesh.vertices.numpy(), noisy(rng, inside_out, 0.002)]
    assert check(mesh, ends, device) > 100


@pytest.mark.parametrize("scale", [1e-6, 1e6, 1e-25, 1e25])
@pytest.mark.parametrize("offset", [0.0, 1e6])
def test_scales_and_places(device: torch.device, scale: float, offset: float) -> None:
    rng = np.random.default_rng(5)
    mesh = bumpy(rng, 1)
    ends = [scale * (noisy(rng, mesh.vertices.numpy(), 0.35) + offset) for _ in range(2)]
    assert check(mesh, ends, device, tolerance=1e-7 * scale) > 20


def test_small_triangles_in_a_large_body(device: torch.device) -> None:
    """Two crumpled patches a thousand times smaller than their distance."""
    rng = np.random.default_rng(6)
    flat, faces = sheet(4, 4)
    patches = np.concatenate([1e-3 * flat, 1e-3 * flat + 3.0])
    mesh = pgccd.Mesh(patches, np.concatenate([faces, faces + len(flat)]))
    ends = [noisy(rng, patches, 1e-3) for _ in range(2)]
    assert check(mesh, ends, device, tolerance=1e-9) > 100


@few_and_many("subdivisions", 0, 1)
def test_shapes_that_collapse(device: torch.device, subdivisions: int) -> None:
    """Collapsed to a point at t1 or throughout: all feature pairs touch, and each is listed once."""
    mesh = bumpy(np.random.default_rng(7), subdivisions)
    vertices, faces, edges = (x.numpy() for x in (mesh.vertices, mesh.faces, mesh.edges))
    point = np.tile(vertices[:1], (len(vertices), 1))
    degree = np.bincount(edges.ravel(), minlength=len(vertices))
    edge_pairs = len(edges) * (len(edges) - 1) // 2 - int((degree * (degree - 1) // 2).sum())
    everything = len(vertices) * len(faces) - 3 * len(faces) + edge_pairs
    for start in (vertices, point):
        assert check(mesh, [start, point], device) == everything


@pytest.mark.parametrize("separation", [0.0, 0.02])
def test_degenerate_faces(device: torch.device, separation: float) -> None:
    """Flat faces, folded pairs, and vertices that coincide at one end."""
    rng = np.random.default_rng(8)
    for _ in range(3):
        flat, faces = sheet(4, 3)
        ends = [np.round(noisy(rng, flat, 0.7)) / 2 for _ in range(2)]
        assert check(pgccd.Mesh(flat + rng.normal(size=flat.shape), faces), ends, device, separation) > 50


@settings(max_examples=40)
@given(shape=meshes(), seed=st.integers(0, 2**32 - 1), shake=st.sampled_from([0.0, 0.01, 0.3]))
def test_any_mesh(shape: TriMesh, seed: int, shake: float) -> None:
    """Open, non-manifold, disconnected, duplicate faces: no duplicate candidates, and none that touches is missed."""
    rng = np.random.default_rng(seed)
    try:
        mesh = pgccd.Mesh(shape.vertices, shape.faces)
    except ValueError:  # all vertices in one point
        return
    chosen = rng.permutation(len(shape.faces))[:60]  # exact arithmetic is slow
    mesh = pgccd.Mesh(shape.vertices + 1e-9 * rng.normal(size=shape.vertices.shape), shape.faces[chosen])
    ends = [noisy(rng, shape.vertices, shake) for _ in range(2)]
    bodies = pgccd.MovingBodies.of(
        pgccd.Scene([mesh], self_collision=True), motion_of(ends, device=torch.device("cpu"))
    )
    found, _ = pgccd.traverse.find_candidates(bodies, torch.tensor([[0, 0]]))
    assert_canonical(mesh, found[:, 1], found[:, 2:])
    truth = self_truth(ends, shape.faces[chosen])
    assert truth.keys() <= {tuple(row) for row in found[:, 1:].tolist()}


@pytest.mark.parametrize("report", list(narrow.REPORTS))
def test_among_other_bodies(device: torch.device, report: narrow.Report) -> None:
    """Contacts between bodies, and each body's own contacts, are unaffected by the other bodies and by chunks."""
    shapes, ends = crumpled(6)
    chosen = [True, False, True, True, False, True]
    motion = motion_of(*ends, device=device)
    hits = detected(pgccd.Scene(shapes, device=device, self_collision=chosen), motion, report)
    apart = hits.pairs[:, 0] != hits.pairs[:, 1]
    assert bool(torch.equal(hits.pairs, torch.tensor(sorted(hits.pairs.tolist()), device=device)))
    without = detected(pgccd.Scene(shapes, device=device), motion, report)
    if report != "earliest":
        assert_same(hits[apart], without)
        for k in range(6):
            own = (hits.pairs == k).all(dim=1)
            if not chosen[k]:
                assert not bool(own.any())
                continue
            alone = own_hits(shapes[k], ends[k], device, report)
            assert len(alone) == int(own.sum()) > 0
            for column in COLUMNS[1:] if report != "any" else ():
                assert torch.equal(getattr(hits, column)[own], getattr(alone, column)), column
    for budget in (1, 4000, 10**7):
        scene = pgccd.Scene(shapes, device=device, self_collision=chosen)
        assert_same(detected(scene, motion, report, memory_budget=budget), hits)


def test_reports_agree(device: torch.device) -> None:
    shapes, ends = crumpled(1)
    everything = own_hits(shapes[0], ends[0], device)
    least = int(torch.nonzero(everything.toi == everything.toi.min())[0])
    for report in ("first", "earliest"):
        one = own_hits(shapes[0], ends[0], device, report)
        assert len(one) == 1
        for column in COLUMNS:
            assert torch.equal(getattr(one, column)[0], getattr(everything, column)[least]), column
    assert own_hits(shapes[0], ends[0], device, "any").pairs.tolist() == [[0, 0]]
    own = pgccd.Scene(shapes, device=device, self_collision=True)
    given = pgccd.detect(own, motion_of(ends[0], device=device), "all", pairs=torch.tensor([[0, 0]], device=device))
    assert_same(given, everything)


def test_threads(device: torch.device) -> None:
    mesh = bumpy(np.random.default_rng(10), 3)
    ends = [noisy(np.random.default_rng(seed), mesh.vertices.numpy(), 0.1) for seed in (11, 12)]
    before = torch.get_num_threads()
    try:
        results = []
        for threads in (1, 2, 3):
            torch.set_num_threads(threads)
            results.append(own_hits(mesh, ends, device))
    finally:
        torch.set_num_threads(before)
    assert len(results[0]) > 500
    assert_same(results[0], results[1])
    assert_same(results[0], results[2])


def test_nonzero_toi(device: torch.device) -> None:
    """Two layers that start further apart than the separation by less than the tolerance."""
    flat, faces = sheet(4, 2)
    layers, closer = (np.concatenate([flat, flat + [0.3, 0.1, z]]) for z in (1e-3, -1e-3))
    mesh = pgccd.Mesh(layers, np.concatenate([faces, faces + len(flat)]))
    near = own_hits(mesh, [layers, closer], device, "first", 0.9e-3, tolerance=1e-2)
    apart = own_hits(mesh, [layers, closer], device, "first", 0.9e-3, tolerance=1e-2, nonzero_toi=True)
    assert float(near.toi) == 0.0 < float(apart.toi)


@pytest.mark.parametrize("broad_phase", ["sweep", "grid", "lbvh"])
@pytest.mark.parametrize("count", [0, 1, 2, 40])
def test_pairs_of_the_broad_phase(device: torch.device, broad_phase: Any, count: int) -> None:
    rng = np.random.default_rng([13, count])
    mesh = bumpy(rng, 0)
    ends = [
        np.concatenate([mesh.vertices.numpy() + 3.0 * rng.normal(size=3) for _ in range(count)] or [np.empty((0, 3))])
        for _ in range(2)
    ]
    motion = pgccd.VertexMotion(*tensors(*ends, device=device))
    static, chosen = rng.random(count) < 0.3, rng.random(count) < 0.6

    def found(**filters: Any) -> list[list[int]]:
        moved = pgccd.MovingBodies.of(pgccd.Scene([mesh], [0] * count, device, **filters), motion)
        pairs = pgccd.broad.find_pairs(moved, 0.0, broad_phase)
        assert pairs.is_contiguous() and pairs.dtype == torch.int64
        return pairs.tolist()

    plain = found()
    assert len(plain) > 40 or count < 40
    for column in (chosen, torch.from_numpy(chosen).to(device), [bool(c) for c in chosen]):
        wanted = sorted(plain + [[k, k] for k in np.flatnonzero(chosen).tolist()])
        assert found(self_collision=torch.as_tensor(column)) == wanted
    assert found(self_collision=True) == sorted(plain + [[k, k] for k in range(count)])
    assert found(self_collision=False) == plain
    filters = {"static": static.tolist(), "group": [1] * count, "mask": [2] * count, "world": list(range(count))}
    own = [[k, k] for k in np.flatnonzero(~static).tolist()]
    assert found(**filters, self_collision=True) == own


def test_rigid_bodies_are_not_tested_against_themselves(device: torch.device) -> None:
    bodies = approaching(np.random.default_rng(14), (1, 1), closeness=0.6)
    scene = pgccd.Scene(bodies.meshes, device=device, self_collision=True)
    for path in ("rigid", "linear"):
        motion = bodies.motion(path, device)
        assert pgccd.broad.sweep(pgccd.MovingBodies.of(scene, motion)).tolist() == [[0, 1]]
        assert_same(pgccd.detect(scene, motion, "all"), pgccd.detect(bodies.scene(device), motion, "all"))


@pytest.mark.cuda
def test_cuda_gives_the_bits_of_the_cpu() -> None:
    shapes, ends = crumpled(5)
    large = bumpy(np.random.default_rng(15), 5)
    large_ends = [noisy(np.random.default_rng(seed), large.vertices.numpy(), 0.01) for seed in (16, 17)]
    for some, some_ends in ((shapes, ends), ([large], [large_ends])):
        for report in narrow.REPORTS:
            for separation in (0.0, 0.02):
                one, other = (
                    detected(
                        pgccd.Scene(some, device=device, self_collision=True),
                        motion_of(*some_ends, device=torch.device(device)),
                        report,
                        separation,
                    )
                    for device in ("cpu", "cuda")
                )
                assert_same(one, other)
                # How many are searched for one contact of each pair depends on the device.
                assert one.stats.candidates == other.stats.candidates or report != "all"


@pytest.mark.slow
def test_many(device: torch.device) -> None:
    for seed in range(60):
        rng = np.random.default_rng([18, seed])
        mesh = bumpy(rng, int(rng.integers(0, 2)))
        shake = float(rng.choice([0.01, 0.1, 0.5]))
        ends = [noisy(rng, mesh.vertices.numpy(), shake) for _ in range(2)]
        check(mesh, ends, device, float(rng.choice([0.0, 0.01, 0.1])))
