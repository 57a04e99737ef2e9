"""detect() on bodies that deform: explicit vertex streams against exact arithmetic, and against rigid bodies."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
import torch
from support.cases import mostly_slow
from support.shapes import Bodies, approaching, bumpy, tensors
from support.truth import (
    assert_linear_rows_close,
    assert_nothing_invented,
    assert_nothing_missed,
    end_positions,
    linear_truth,
    rows_of,
    without_crossings,
)

import pgccd

Ends = list[list[np.ndarray]]


def vertex_motion(ends: Ends, device: torch.device) -> pgccd.VertexMotion:
    """A motion from the ends (t0, t1) of each body."""
    return pgccd.VertexMotion(*tensors(*(np.concatenate([e[t] for e in ends]) for t in (0, 1)), device=device))


def check(
    meshes: list[pgccd.Mesh], ends: Ends, device: torch.device, separation: float = 0.0, tolerance: float = 1e-7
) -> int:
    """Checks two bodies against brute force; returns the number of contacts."""
    scene = pgccd.Scene(meshes, device=device)
    hits = pgccd.detect(scene, vertex_motion(ends, device), "all", separation, tolerance=tolerance)
    faces = [m.faces.long().numpy() for m in meshes]
    rows, truth = rows_of(without_crossings(hits)), linear_truth(ends, faces, separation)
    assert_nothing_missed(rows, truth)
    size = max(np.ptp(np.concatenate([a[t], b[t]])) for t in (0, 1) for a, b in [ends])
    assert_linear_rows_close(rows, ends, faces, separation + tolerance + 1e-13 * size)
    assert_nothing_invented(rows, truth)
    assert hits.stats.unresolved == sum(row.status == pgccd.Status.UNRESOLVED for row in rows.values())
    return len(truth.contacts)


def random_ends(rng: np.random.Generator, shake: float, offset: float = 0.0) -> tuple[Bodies, Ends]:
    bodies = approaching(rng, (0, 1), turn=1.0, closeness=0.8, offset=offset)
    ends = [end_positions(bodies, b) for b in (0, 1)]
    return bodies, [[x + shake * rng.normal(size=x.shape) for x in of_body] for of_body in ends]


@pytest.mark.parametrize(
    ("shake", "offset", "seed"),
    mostly_slow(
        itertools.product((0.0, 0.1, 0.5), (0.0, 1e8), (0, 1)),
        [(0.0, 1e8, 0), (0.1, 0.0, 0), (0.5, 0.0, 0), (0.5, 1e8, 0)],
    ),
)
def test_random(device: torch.device, shake: float, offset: float, seed: int) -> None:
    bodies, ends = random_ends(np.random.default_rng([1, int(10 * shake), seed]), shake, offset)
    assert check(bodies.meshes, ends, device) + check(bodies.meshes, ends, device, separation=0.05) > 5


@pytest.mark.parametrize("scale", mostly_slow([1e-6, 1e6, 1e-25, 1e25], [1e-25, 1e25]))
def test_scales(device: torch.device, scale: float) -> None:
    bodies, ends = random_ends(np.random.default_rng(2), 0.1)
    ends = [[scale * x for x in e] for e in ends]
    assert check(bodies.meshes, ends, device, tolerance=1e-7 * scale) > 5


@pytest.mark.parametrize("scale", [1e-45, 1e-36, 1e36, 1e45, 1e90])
def test_extreme_scales_are_refused(device: torch.device, scale: float) -> None:
    bodies, ends = random_ends(np.random.default_rng(2), 0.1)
    ends = [[scale * x for x in e] for e in ends]
    with pytest.raises(ValueError, match="motion: body 0: expected an SBV radius"):
        check(bodies.meshes, ends, device, tolerance=1e-7 * scale)


def test_sheet_that_folds_and_a_ball(device: torch.device) -> None:
    # A flat open sheet, exactly planar at t0; a body passes through it.
    n = 7
    x, y = np.meshgrid(np.linspace(-1.5, 1.5, n), np.linspace(-1.5, 1.5, n), indexing="ij")
    sheet = np.stack([x.ravel(), y.ravel(), 0 * x.ravel()], axis=1)
    index = np.arange(n * n).reshape(n, n)
    a, b, c, d = index[:-1, :-1].ravel(), index[1:, :-1].ravel(), index[1:, 1:].ravel(), index[:-1, 1:].ravel()
    faces = np.concatenate([np.stack([a, b, c], axis=1), np.stack([a, c, d], axis=1)])
    folded = sheet + np.stack([0 * sheet[:, 0], 0 * sheet[:, 0], 0.5 * np.abs(sheet[:, 0])], axis=1)
    ball = bumpy(np.random.default_rng(3), 1, size=0.7)
    over = ball.vertices.numpy() + np.array([0.1, 0.05, 1.5])
    meshes = [pgccd.Mesh(sheet, faces), ball]
    ends = [[sheet, folded], [over, over - np.array([0.0, 0.0, 2.0])]]
    assert check(meshes, ends, device) > 50


def test_shapes_that_collapse(device: torch.device) -> None:
    """A body that shrinks to a point, and one that is a point throughout, still have contacts."""
    rng = np.random.default_rng(4)
    still, moving = bumpy(rng, 0), bumpy(rng, 0)
    here = [np.round(1024 * still.vertices.numpy()) / 1024] * 2  # so that midpoints are exact
    on_surface = here[0][3]
    shrinks = [moving.vertices.numpy() + 3.0, np.tile(on_surface, (12, 1))]
    assert check([still, moving], [here, shrinks], device) > 10
    points = [np.tile(on_surface + 0.75, (12, 1)), np.tile(on_surface - 0.75, (12, 1))]
    assert check([still, moving], [here, points], device) > 10
    same_points = [np.tile(on_surface, (12, 1))] * 2
    assert check([moving, moving], [same_points, same_points], device) == 2 * 12 * 20 + 30 * 30


def test_agrees_with_rigid_bodies_on_straight_paths(device: torch.device) -> None:
    rng = np.random.default_rng(5)
    count = 8
    bodies = approaching(rng, (1,) * count, tuple(rng.uniform(0.5, 1.5, count)), turn=1.0, closeness=0.8)
    ends = [end_positions(bodies, b) for b in range(count)]
    scene = bodies.scene(device)
    rigid = pgccd.detect(scene, bodies.motion("linear", device), "all", tolerance=1e-7)
    deforming = pgccd.detect(scene, vertex_motion(ends, device), "all", tolerance=1e-7)
    tables = []
    for hits in (rigid, deforming):
        columns = torch.cat([hits.pairs, hits.kind[:, None].long(), hits.features.long()], dim=1).tolist()
        tables.append(dict(zip(map(tuple, columns), hits.toi.tolist(), strict=True)))
    assert len(tables[0]) > 200
    # The same sets, except for distances within rounding of the tolerance, which one side may miss.
    different = tables[0].keys() ^ tables[1].keys()
    assert len(different) <= len(tables[0]) // 500
    assert max(abs(tables[0][k] - tables[1][k]) for k in tables[0].keys() & tables[1].keys()) < 1e-6


def test_bodies_share_a_mesh_but_not_a_shape(device: torch.device) -> None:
    rng = np.random.default_rng(6)
    mesh = bumpy(rng, 0)
    shapes = [rng.normal(size=(12, 3)) for _ in range(4)]
    ends = [[s + 0.3 * k, s + 0.3 * rng.normal(size=3)] for k, s in enumerate(shapes)]
    scene = pgccd.Scene([mesh], [0] * 4, device)
    together = pgccd.detect(scene, vertex_motion(ends, device), "all", tolerance=1e-8)
    for i in range(4):
        for j in range(i + 1, 4):
            pair = pgccd.Scene([mesh, mesh], device=device)
            alone = pgccd.detect(pair, vertex_motion([ends[i], ends[j]], device), "all", tolerance=1e-8)
            assert rows_of(together, i, j) == rows_of(alone)
    assert len(together) > 100
    assert check([mesh, mesh], ends[:2], device) > 10


@pytest.mark.slow
def test_many(device: torch.device) -> None:
    for seed in range(100):
        rng = np.random.default_rng([7, seed])
        bodies, ends = random_ends(rng, float(rng.choice([0.0, 0.01, 0.3, 1.0])), float(rng.choice([0.0, 1e6])))
        check(bodies.meshes, ends, device, float(rng.choice([0.0, 0.01, 0.2])))


@pytest.mark.cuda
def test_bounds_have_the_bits_of_the_cpu() -> None:
    """Bodies of one block of nodes and of thousands, in one scene."""
    rng = np.random.default_rng(8)
    meshes = [pgccd.Mesh(np.eye(3), [[0, 1, 2]]), *(bumpy(rng, k) for k in (0, 3, 5))]
    index = rng.integers(0, 4, 50)
    ends = [[rng.normal(size=3) + rng.normal(size=meshes[k].vertices.shape) for _ in (0, 1)] for k in index]
    bounds = []
    for device in (torch.device("cpu"), torch.device("cuda")):
        scene = pgccd.Scene(meshes, torch.from_numpy(index).to(device), device)
        bounds.append(pgccd.MovingBodies.of(scene, vertex_motion(ends, device)).tensors)
    for on_cpu, on_gpu in zip(*bounds, strict=True):  # compared as bytes: empty slots hold NaN
        assert torch.equal(on_cpu.view(torch.uint8), on_gpu.cpu().view(torch.uint8))
