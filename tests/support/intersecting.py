"""Pairs of triangles with integer corners, many of them nearly degenerate, as scenes; and what `detect` must report."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from oracle.intersection import crossings, have_common_point

import pgccd
from support.reports import detected
from support.same_bits import assert_same
from support.shapes import tensors

#: Corners have integer coordinates up to this magnitude. Triangles that have no common point are then further apart
#: than the default tolerance: 1 / |n| > 1e-6 radii for each n = a x b of two edges or differences.
SIDE = 32
EF_AB, EF_BA = 3, 4
# Quaternions of rotations of a cube onto itself, exact like their matrices.
_TURNS = np.array([[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0.5, 0.5, 0.5, 0.5], [0.5, -0.5, 0.5, 0.5]])
# Edges of one triangle as a mesh numbers them, in the order corner 0 to 1, 1 to 2, 2 to 0.
_EDGE = [0, 2, 1]
_APART = 1024  # of scenes

Pair = tuple[np.ndarray, np.ndarray]
Generator = np.random.Generator


def _random(rng: Generator, n: int, size: int) -> Pair:
    a, b = rng.integers(-size, size + 1, (2, n, 3, 3))
    return a, b


def _in_one_plane(rng: Generator, n: int, size: int) -> Pair:
    u, v = rng.integers(-3, 4, (2, n, 1, 1, 3))
    at = rng.integers(-max(1, size // 8), max(1, size // 8) + 1, (n, 2, 3, 2))
    x = at[..., :1] * u + at[..., 1:] * v
    return x[:, 0], x[:, 1]


def _in_parallel_planes(rng: Generator, n: int, size: int) -> Pair:
    a, b = _in_one_plane(rng, n, size)
    return a, b + rng.integers(-1, 2, (n, 1, 3))


def _with_a_common_corner(rng: Generator, n: int, size: int) -> Pair:
    a, b = _random(rng, n, size)
    b[:, 0] = a[:, 1]
    return a, b


def _with_a_common_edge(rng: Generator, n: int, size: int) -> Pair:
    a, b = _random(rng, n, size)
    b[:, 1:] = a[:, 1:]
    return a, b


def _slivers(rng: Generator, n: int, size: int) -> Pair:
    def sliver() -> np.ndarray:
        start, step = rng.integers(-size // 2, size // 2 + 1, (n, 3)), rng.integers(-4, 5, (n, 3))
        x = np.stack([start, start + step, start + rng.integers(2, 6, (n, 1)) * step], axis=1)
        return x + rng.integers(-1, 2, (n, 3, 3)) * (rng.random((n, 3, 1)) < 0.3)

    a, b = sliver(), sliver()
    return a, b + a[:, 1:2] - b[:, 1:2] + rng.integers(-1, 2, (n, 1, 3))


def _corner_on_the_face(rng: Generator, n: int, size: int) -> Pair:
    a, b = _random(rng, n, size // 4)
    weight = np.eye(3, dtype=int)[rng.integers(0, 3, (n, 4))].sum(axis=1)  # quarters: a corner, on an edge, or inside
    b[:, 0] = (weight[:, :, None] * a).sum(axis=1)
    return 4 * a, b


def _corner_in_the_plane(rng: Generator, n: int, size: int) -> Pair:
    a, b = _random(rng, n, size // 4)
    s, t = rng.integers(-1, 3, (2, n, 1))
    b[:, 0] = a[:, 0] + s * (a[:, 1] - a[:, 0]) + t * (a[:, 2] - a[:, 0])
    return a, b


def _edge_on_edge(rng: Generator, n: int, size: int) -> Pair:
    a, b = _random(rng, n, size // 3)
    b[:, 1] = a[:, 0] + a[:, 1] - b[:, 0]  # their midpoints are one
    return a, b


def _segments_and_points(rng: Generator, n: int, size: int) -> Pair:
    a, b = _random(rng, n, max(1, size // 8))
    a[:, 2] = a[:, 1]
    b[::3, 2] = b[::3, 0]
    b[::6, 1] = b[::6, 0]
    return a, b


FAMILIES: tuple[Callable[[Generator, int, int], Pair], ...] = (
    _in_one_plane,
    _in_parallel_planes,
    _with_a_common_corner,
    _with_a_common_edge,
    _slivers,
    _corner_on_the_face,
    _corner_in_the_plane,
    _edge_on_edge,
    _segments_and_points,
)


def integer_pairs(rng: Generator, n: int, side: int = SIDE, degenerate: bool = True) -> Pair:
    """About n pairs of triangles (n, 3, 3) int64 with coordinates up to `side`: half at random in boxes of several
    sizes, half of the families above. Without `degenerate`, none has all corners in one point.
    """
    sizes = [s for s in (2, 4, 8, side) if s <= side]
    parts = [_random(rng, n // (2 * len(sizes)), size) for size in sizes]
    each = n // (2 * len(FAMILIES))
    for family in FAMILIES:
        parts.append(family(rng, (each + 1) // 2, side))
        parts.append(family(rng, each // 2, 8))
    a, b = (np.concatenate([part[k] for part in parts]) for k in range(2))
    fits = (np.abs(a).max(axis=(1, 2)) <= side) & (np.abs(b).max(axis=(1, 2)) <= side)
    if not degenerate:
        fits &= np.ptp(a, axis=1).any(axis=1) & np.ptp(b, axis=1).any(axis=1)
    swap, order = rng.random(fits.sum()) < 0.5, rng.permutation(fits.sum())
    a, b = a[fits], b[fits]
    a, b = np.where(swap[:, None, None], b, a), np.where(swap[:, None, None], a, b)
    corners = rng.permuted(np.tile(np.arange(3), (2, len(a), 1)), axis=2)
    a, b = (np.take_along_axis(x, k[:, :, None], axis=1) for x, k in zip((a, b), corners, strict=True))
    return a[order], b[order]


def _cells(n: int) -> np.ndarray:
    side = int(np.ceil(n ** (1 / 3)))
    k = np.arange(n)
    return _APART * np.stack([k % side, k // side % side, k // side**2], axis=1)


def _interleaved(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return np.stack([a, b], axis=1).reshape(2 * len(a), *a.shape[1:])


def deforming_scene(
    rng: Generator, a: np.ndarray, b: np.ndarray, device: torch.device | str, moving: bool, **columns: Any
) -> tuple[pgccd.Scene, pgccd.VertexMotion]:
    """Bodies 2k and 2k + 1 are the triangles of pair k, in a world of their own; exact."""
    mesh = pgccd.Mesh([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]], [[0, 1, 2]])
    x = _interleaved(a, b) + np.repeat(_cells(len(a)), 2, axis=0)[:, None]
    end = x + rng.normal(size=x.shape) * SIDE / 4 if moving else x
    world = np.repeat(np.arange(len(a)), 2)
    scene = pgccd.Scene([mesh], [0] * len(x), device, world=torch.from_numpy(world).to(device), **columns)
    ends = tensors(x.reshape(-1, 3).astype(float), end.reshape(-1, 3).astype(float), device=device)
    return scene, pgccd.VertexMotion(*ends)


def rigid_scene(
    rng: Generator, a: np.ndarray, b: np.ndarray, device: torch.device | str, path: Any, **columns: Any
) -> tuple[pgccd.Scene, pgccd.RigidMotion]:
    """The same of rigid bodies, each with a mesh of its own, at exact poses. path: "rest", "linear" or "rigid"."""
    x = _interleaved(a, b)
    turn = rng.integers(0, len(_TURNS), len(x))
    shift = rng.integers(-SIDE, SIDE + 1, (len(x), 1, 3))
    back = np.array([_turned(q * [1, -1, -1, -1], np.eye(3)).T for q in _TURNS])
    points = np.einsum("nij,nkj->nki", back[turn], (x - shift).astype(float))
    meshes = [pgccd.Mesh(p, [[0, 1, 2]]) for p in points]
    position = shift[:, 0] + np.repeat(_cells(len(a)), 2, axis=0)
    world = torch.from_numpy(np.repeat(np.arange(len(a)), 2))
    scene = pgccd.Scene(meshes, device=device, world=world.to(device), **columns)
    start = tensors(position.astype(float), _TURNS[turn], device=device)
    if path == "rest":
        return scene, pgccd.RigidMotion.at_rest(*start)
    velocity = tensors(rng.normal(size=(len(x), 3)) * SIDE / 4, rng.normal(size=(len(x), 3)), device=device)
    return scene, pgccd.RigidMotion.from_velocity(*start, *velocity, dt=1.0, path=path)


def _turned(quaternion: np.ndarray, points: np.ndarray) -> np.ndarray:
    w, v = quaternion[0], quaternion[1:]
    return points + 2 * np.cross(v, np.cross(v, points) + w * points)


def expected_crossings(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Rows (pair, kind, feature of i, feature of j) of all edges that pass through a face, in canonical order."""
    pair, bit = np.nonzero(crossings(a, b))
    edge, of_b = np.array(_EDGE * 2)[bit], bit >= 3
    rows = np.stack([pair, np.where(of_b, EF_BA, EF_AB), np.where(of_b, 0, edge), np.where(of_b, edge, 0)], axis=1)
    return rows[np.lexsort(rows.T[::-1])]


def crossings_of(hits: pgccd.Contacts) -> np.ndarray:
    """The same of contacts, which must have the pairs (2k, 2k + 1)."""
    rows = torch.cat([hits.pairs[:, :1] // 2, hits.kind[:, None].long(), hits.features.long()], dim=1).cpu().numpy()
    return rows[rows[:, 1] >= EF_AB]


def check_reports(
    a: np.ndarray, b: np.ndarray, scene: pgccd.Scene, motion: Any, is_at_rest: bool, **options: Any
) -> int:
    """Checks all reports of pairs of triangles against exact arithmetic; returns the number of pairs that meet."""
    meet = np.flatnonzero(have_common_point(a, b))

    def pairs_of(hits: pgccd.Contacts) -> np.ndarray:
        pairs = hits.pairs.cpu().numpy()
        assert (pairs[:, 0] % 2 == 0).all() and (pairs[:, 1] == pairs[:, 0] + 1).all()
        return pairs[:, 0] // 2

    colliding = pairs_of(detected(scene, motion, "any", **options))
    assert np.array_equal(colliding, meet) if is_at_rest else np.isin(meet, colliding).all()
    everything = pgccd.detect(scene, motion, "all", **options)
    assert np.array_equal(crossings_of(everything), expected_crossings(a, b))
    is_crossing = everything.kind >= EF_AB
    assert bool((everything.toi[is_crossing] == 0).all())
    assert bool((everything.status[is_crossing] == pgccd.Status.TOUCH).all())
    at_start = everything[everything.toi == 0]
    assert np.array_equal(np.unique(pairs_of(at_start)), meet)
    # "first" is the least row of each pair by toi, kind and features: rows of a pair are in order of the latter.
    first = pgccd.detect(scene, motion, "first", **options)
    assert np.array_equal(pairs_of(first), colliding)
    assert np.array_equal(pairs_of(first[first.toi == 0]), meet)
    order = torch.argsort(everything.toi, stable=True)
    order = order[torch.argsort(everything.pairs[order, 0], stable=True)]
    count = torch.unique_consecutive(everything.pairs[:, 0], return_counts=True)[1]
    least = order[count.cumsum(0) - count]
    assert_same(first, everything[least])
    earliest = pgccd.detect(scene, motion, "earliest", **options)
    assert len(earliest) == 1 and float(earliest.toi) == 0.0
    assert earliest.pairs.tolist() == at_start.pairs[:1].tolist()
    assert int(earliest.kind) == int(at_start.kind[0]) and torch.equal(earliest.features, at_start.features[:1])
    return len(meet)
