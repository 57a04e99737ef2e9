"""Features so small, slender or nearly parallel that normals and squared lengths lose their digits."""

from __future__ import annotations

from fractions import Fraction

import numpy as np
import pytest
import torch
from oracle import distance, rigid
from oracle.batch_paths import Turning
from support.bulk_arcs import FEATURES, solve_candidates
from support.cases import few_and_many

import pgccd

# Edges down to where the fourth power of their length underflows, and beyond.
EDGES = {
    torch.float32: [1e-3, 1e-8, 1e-10, 5.2e-11, 1e-12, 1e-20, 1e-25, 1e-38],
    torch.float64: [1e-20, 1e-60, 1e-77, 1e-79, 1e-80, 1e-100, 1e-140, 1e-160],
}


@pytest.mark.parametrize("dtype", list(EDGES))
@pytest.mark.parametrize("corner", [0, 1, 2])
def test_tiny_face_at_a_separation(device: torch.device, dtype: torch.dtype, corner: int) -> None:
    """A vertex descends on a needle whose short side is e: within 1/2 at t = 10/11."""
    sizes = EDGES[dtype]
    faces = [[(-e / 2, 0, 0), (0, 1, -1), (e / 2, 0, 0)] for e in sizes]
    start, end = (
        torch.tensor([[(0, 0, z), *f[corner:], *f[:corner]] for f in faces], dtype=dtype, device=device)
        for z in (1.0, 0.45)
    )
    hit = pgccd.narrow.vertex_face(start, end, min_separation=0.5)
    assert hit.status.tolist() == [pgccd.Status.TOUCH] * len(sizes)
    assert float(hit.toi.max()) <= 10 / 11 and float(hit.toi.min()) > 10 / 11 - 1e-5


@pytest.mark.parametrize("dtype", list(EDGES))
@pytest.mark.parametrize("order", [(0, 1, 2, 3), (2, 3, 0, 1), (1, 0, 3, 2)])
@pytest.mark.parametrize("separation", [0.0, 0.5])
def test_tiny_edge(device: torch.device, dtype: torch.dtype, order: tuple[int, ...], separation: float) -> None:
    """An edge of length e descends across one of length 2, to 1/8 below the separation."""
    sizes, z = EDGES[dtype], separation - 0.125
    start, end = (
        torch.tensor(
            [[(-e / 2, 0, h), (e / 2, 0, h), (0, -1, 0), (0, 1, 0)] for e in sizes], dtype=dtype, device=device
        )[:, list(order)]
        for h in (1.0, z)
    )
    hit = pgccd.narrow.edge_edge(start, end, min_separation=separation)
    toi = (1.0 - separation) / (1.0 - z)
    assert hit.status.tolist() == [pgccd.Status.TOUCH] * len(sizes)
    assert float(hit.toi.max()) <= toi and float(hit.toi.min()) > toi - 1e-5


@pytest.mark.parametrize("dtype", list(EDGES))
def test_tiny_features_that_pass(device: torch.device, dtype: torch.dtype) -> None:
    """As the edge above, but it stays just out of reach: no contact, and none unresolved."""
    sizes = EDGES[dtype]
    start, end = (
        torch.tensor(
            [[(-e / 2, 0, h), (e / 2, 0, h), (0, -1, 0), (0, 1, 0)] for e in sizes], dtype=dtype, device=device
        )
        for h in (1.0, 0.5 + 2e-3)
    )
    hit = pgccd.narrow.edge_edge(start, end, min_separation=0.5, tolerance=1e-3)
    assert hit.status.tolist() == [pgccd.Status.FREE] * len(sizes)


def nearly_parallel(rng: np.random.Generator, count: int, angle: float, kind: int) -> list[pgccd.Mesh]:
    """Two meshes of `count` triangles: the first edges of both (EE), or two sides of the second's triangles (VF_AB),
    make that angle with one direction.
    """
    along = rng.normal(size=3)
    along /= np.linalg.norm(along)
    aside = np.cross(along, rng.normal(size=3))
    aside /= np.linalg.norm(aside)
    corners = [rng.normal(size=(count, 3, 3)) for _ in range(2)]
    signs = np.where(np.arange(count) % 2 == 0, 1.0, -1.0)[:, None]
    length = rng.uniform(0.5, 1.5, (2, count, 1))
    corners[1][:, 1] = corners[1][:, 0] + length[0] * along
    tilted = length[1] * signs * (along + angle * aside)
    if kind == pgccd.Kind.EE:
        corners[0][:, 1] = corners[0][:, 0] + tilted
    else:
        corners[1][:, 2] = corners[1][:, 0] + tilted
    return [pgccd.Mesh(c.reshape(-1, 3), np.arange(3 * count).reshape(-1, 3)) for c in corners]


@pytest.mark.parametrize("kind", [pgccd.Kind.VF_AB, pgccd.Kind.EE])
@pytest.mark.parametrize("angle", [1e-14, 9e-11, 1e-6, 1e-3])
@pytest.mark.parametrize("tolerance", [1e-10, 1e-6])
@few_and_many("count", 16, 40)
def test_nearly_parallel_on_arcs(device: torch.device, kind: int, angle: float, tolerance: float, count: int) -> None:
    """Touches lie within the tolerance, for arbitrarily small angles spanning the features' plane."""
    rng = np.random.default_rng([int(kind), int(-np.log10(angle))])
    meshes = nearly_parallel(rng, count, angle, kind)
    vertices = [m.vertices.numpy() for m in meshes]
    rows = np.arange(count)
    edge = np.array([k for k in range(len(meshes[0].edges)) if tuple(meshes[0].edges[k].tolist())[1] % 3 == 1])
    features = np.stack([rows * 3, rows] if kind == pgccd.Kind.VF_AB else [edge, edge], axis=1)
    first, second = (
        v[f] for v, f in zip(vertices, _corners(meshes, kind, features), strict=True)
    )  # (n, 1, 3) and (n, 3, 3), or (n, 2, 3) each
    # In their own frames they meet at t, at a random point of both, with the identity orientation at that time.
    t, weight = rng.uniform(0.1, 0.9, (count, 1)), rng.uniform(0.1, 0.4, (2, count, 1))
    on_first = first[:, 0] if kind == pgccd.Kind.VF_AB else first[:, 0] + weight[0] * (first[:, 1] - first[:, 0])
    on_second = second[:, 0] + weight[1] * (second[:, 1] - second[:, 0])
    if kind == pgccd.Kind.VF_AB:
        on_second = on_second + weight[0] * (second[:, 2] - second[:, 0])
    bodies = []
    for place in (on_first, on_second):
        spin = rng.normal(size=(count, 3))
        spin *= 0.7 / np.linalg.norm(spin, axis=1, keepdims=True)
        half = -0.5 * 0.7 * t
        quaternion = np.concatenate([np.cos(half), np.sin(half) * spin / 0.7], axis=1)
        velocity = rng.normal(size=(count, 3))
        bodies.append(Turning(-place - t * velocity, quaternion, -place + (1 - t) * velocity, spin))
    status, toi, _ = solve_candidates(meshes, (bodies[0], bodies[1]), kind, features, 0.0, tolerance, device)
    assert (status != pgccd.Status.UNRESOLVED).all()
    touched = np.flatnonzero(status == pgccd.Status.TOUCH)
    assert len(touched) > count // 20
    for k in touched:
        at = [
            rigid.position(x, b.position_t0[k], b.orientation_t0[k], b.position_t1[k], b.rotation[k], toi[k])
            for points, b in zip((first, second), bodies, strict=True)
            for x in points[k]
        ]
        assert distance.distance_high_precision(at, kind != pgccd.Kind.EE) <= tolerance


def _corners(meshes: list[pgccd.Mesh], kind: int, features: np.ndarray) -> list[np.ndarray]:
    """Vertex indices of the first and of the second feature."""
    table = {"vertex": lambda m: np.arange(len(m.vertices))[:, None], "face": lambda m: m.faces.numpy()}
    table["edge"] = lambda m: m.edges.numpy()
    return [table[what](m)[features[:, k]] for k, (m, what) in enumerate(zip(meshes, FEATURES[kind], strict=True))]


@pytest.mark.parametrize("dtype", list(EDGES))
@pytest.mark.parametrize("value", [float("nan"), float("inf"), -float("inf")])
def test_what_is_not_a_finite_number_is_never_free(device: torch.device, dtype: torch.dtype, value: float) -> None:
    """In any coordinate: the features are far apart otherwise, but that is no certificate."""
    apart = torch.tensor([[0, 0, 9], [1, 0, 9], [0, 0, 0], [0, 1, 0]], dtype=dtype, device=device)
    points = apart.repeat(24, 1, 1)
    ends = [points.clone(), points.clone()]
    for k in range(24):
        ends[k // 12][k, k % 12 // 3, k % 3] = value
    for test in (pgccd.narrow.vertex_face, pgccd.narrow.edge_edge):
        assert (test(points, points).status == pgccd.Status.FREE).all()
        assert (test(*ends).status != pgccd.Status.FREE).all()


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_starts_less_than_a_rounding_above_the_separation(device: torch.device, dtype: torch.dtype) -> None:
    """A vertex above a tilted face, whose exact distance, the root of an integer, is just above the separation in
    float64, moves away: free, although the rounded distance is often below the separation.
    """
    rng = np.random.default_rng(8)
    precise = 0
    for _ in range(300):
        a, b = rng.integers(-40, 41, (2, 3))
        normal = np.cross(a, b)
        squared = int(normal @ normal)
        separation = float(np.sqrt(squared))
        if squared == 0 or Fraction(separation) ** 2 >= squared:
            continue
        sides = rng.integers(3, 10, 2)
        start = np.array([normal + a + b, [0, 0, 0], sides[0] * a, sides[1] * b])
        end = start + np.array([normal, [0] * 3, [0] * 3, [0] * 3])
        points = (torch.tensor(x[None], dtype=dtype, device=device) for x in (start, end))
        hit = pgccd.narrow.vertex_face(*points, min_separation=separation, tolerance=1.0)
        assert int(hit.status) == pgccd.Status.FREE
        precise += int(hit.significant_bits) == 106
    assert precise > 50
