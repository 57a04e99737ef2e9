"""Scenes that are hard to balance: a large mesh under many small ones, and sizes over many octaves."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
from support.cases import mostly_slow
from support.same_bits import assert_same
from support.shapes import Bodies, bumpy, directions, height_field, turned, unit_quaternions
from support.truth import assert_rigid_pair_agrees

import pgccd


class Crowd:
    """Bodies that share a few meshes."""

    def __init__(self, kinds: list[pgccd.Mesh], kind: np.ndarray, columns: list[np.ndarray], **filters: Any) -> None:
        self.bodies = Bodies([kinds[k] for k in kind], *columns)
        self._kinds, self._kind, self._filters = kinds, kind, filters

    def detect(self, device: torch.device | str, report: Any = "first", **options: Any) -> pgccd.Contacts:
        scene = pgccd.Scene(self._kinds, self._kind, device, **self._filters)
        return pgccd.detect(scene, self.bodies.motion(device=device), report, **options)


def pebbles_on_terrain(pebbles: int, terrain_body: int) -> Crowd:
    """Body `terrain_body` is a static mesh of 4,224 faces; the rest fall from just above it."""
    rng = np.random.default_rng(20)
    terrain = height_field(rng, 48, 44)
    count = 1 + pebbles
    kind = rng.integers(1, 4, count)
    position = np.concatenate([rng.uniform(0, 1, (count, 2)) * [48, 44], rng.uniform(0.4, 0.8, (count, 1))], axis=1)
    velocity = [0.0, 0.0, -0.15] + 0.05 * rng.normal(size=(count, 3))
    orientation, spin = unit_quaternions(rng, count), 0.1 * directions(rng, count)
    kind[terrain_body], position[terrain_body] = 0, 0.0
    velocity[terrain_body], spin[terrain_body], orientation[terrain_body] = 0.0, 0.0, [1.0, 0.0, 0.0, 0.0]
    kinds = [terrain, *(bumpy(rng, 1, size=0.5) for _ in range(3))]
    static = np.arange(count) == terrain_body
    return Crowd(kinds, kind, [position, orientation, velocity, spin], static=torch.from_numpy(static))


def sizes_over_octaves(large: int, small: int) -> Crowd:
    """Bodies of sizes from 1 to 1/1000; all but the first `large` pass a corner of one of these in the step."""
    rng = np.random.default_rng(21)
    scales = np.geomspace(1e-3, 1.0, 16)
    kinds = [bumpy(rng, 1, size=scale) for scale in scales]
    count = large + small
    kind = np.concatenate([rng.integers(12, 16, large), rng.integers(0, 16, small)])
    radius = scales[kind][:, None]
    position, orientation = rng.uniform(-3, 3, (count, 3)), unit_quaternions(rng, count)
    velocity, spin = 0.1 * radius * directions(rng, count), 1e-3 * directions(rng, count)
    for body in range(large, count):
        host = rng.integers(large)
        corners = kinds[kind[host]].vertices.numpy()
        corner = position[host] + turned(orientation[[host]], corners[[rng.integers(len(corners))]])[0]
        relative = 2.0 * radius[body] * directions(rng, 1)[0]
        velocity[body] = velocity[host] + relative
        position[body] = corner + 0.5 * radius[body] * directions(rng, 1)[0] - rng.uniform(0.2, 0.8) * relative
        spin[body] = 0.3 * directions(rng, 1)[0]
    return Crowd(kinds, kind, [position, orientation, velocity, spin])


def plates(stacks: int) -> Crowd:
    """Uneven plates in stacks of two that touch nearly everywhere during the step."""
    rng = np.random.default_rng(22)
    kinds = [height_field(rng, 40, 36) for _ in range(3)]
    count = 2 * stacks
    position = np.zeros((count, 3))
    position[:, 0] = 60.0 * (np.arange(count) // 2)
    position[1::2, 2] = 1.1
    velocity, spin = np.zeros((count, 3)), 0.003 * directions(rng, count)
    velocity[1::2, 2] = -1.5
    orientation = np.tile([1.0, 0.0, 0.0, 0.0], (count, 1))
    return Crowd(kinds, rng.integers(0, 3, count), [position, orientation, velocity, spin])


def dust(count: int) -> Crowd:
    """Small meshes spread over a box, each with about five neighbours."""
    rng = np.random.default_rng(23)
    kinds = [bumpy(rng, 0, size=0.5), bumpy(rng, 1, size=0.5)]
    position = rng.uniform(0, 1, (count, 3)) * (count / 1.4) ** (1 / 3)
    velocity, spin = 0.2 * directions(rng, count), 0.5 * directions(rng, count)
    return Crowd(kinds, rng.integers(0, 2, count), [position, unit_quaternions(rng, count), velocity, spin])


def assert_same_on_every_way(crowd: Crowd, device: torch.device) -> pgccd.Contacts:
    """Asserts first contacts equal to those of the CPU, pair by pair, for any device, broad phase and chunks."""
    found = crowd.detect(device, "all")
    reference = crowd.detect("cpu", memory_budget=1, broad_phase="sweep")
    assert reference.stats.chunks == reference.stats.pcs > 100
    for broad_phase in ("sweep", "grid", "lbvh"):
        for budget in (None, 100_000):
            hits = crowd.detect(device, broad_phase=broad_phase, memory_budget=budget)
            assert hits.stats.pcs == reference.stats.pcs
            assert_same(hits, reference)
    # The earliest of all contacts of each pair.
    pairs, row = found.pairs.cpu().unique(dim=0, return_inverse=True)
    first = torch.full((len(pairs),), torch.inf, dtype=torch.float64).scatter_reduce(0, row, found.toi.cpu(), "amin")
    assert torch.equal(pairs, reference.pairs) and torch.equal(first, reference.toi)
    return found


@pytest.mark.parametrize("terrain_body", mostly_slow([0, 150], [150]))
def test_pebbles_on_a_terrain(device: torch.device, terrain_body: int) -> None:
    crowd = pebbles_on_terrain(300, terrain_body)
    found = assert_same_on_every_way(crowd, device)
    with_terrain = found.pairs[(found.pairs == terrain_body).any(dim=1)].unique(dim=0)
    touching = set(with_terrain.sum(dim=1).sub(terrain_body).tolist())
    assert 40 < len(touching) < 260
    others = [body for body in range(301) if body != terrain_body]
    chosen = [[b for b in others if (b in touching) == wanted][:12:4] for wanted in (True, False)]
    contacts = 0
    for body in chosen[0] + chosen[1]:
        contacts += assert_rigid_pair_agrees(found, crowd.bodies, *sorted((body, terrain_body)))
    assert contacts > 3


def test_sizes_from_one_to_a_thousand(device: torch.device) -> None:
    crowd = sizes_over_octaves(12, 160)
    found = assert_same_on_every_way(crowd, device)
    radius = np.array([mesh.radius for mesh in crowd.bodies.meshes])
    pairs = found.pairs.unique(dim=0).tolist()
    ratio = {(i, j): max(radius[i], radius[j]) / min(radius[i], radius[j]) for i, j in pairs}
    assert max(ratio.values()) > 300 and len(pairs) > 60
    extreme = sorted(ratio, key=lambda pair: ratio[pair])
    contacts = 0
    for i, j in extreme[:1] + extreme[-1:]:
        contacts += assert_rigid_pair_agrees(found, crowd.bodies, i, j)
    assert contacts > 3


def test_more_pairs_than_threads(device: torch.device) -> None:
    """No pair is lost when threads fetch pairs dynamically."""
    count = 20_000 if device.type == "cuda" else 2_000
    crowd = dust(count)
    found, reference = crowd.detect(device), crowd.detect("cpu", memory_budget=1 << 22)
    assert found.stats.pcs == reference.stats.pcs > 4 * count and len(found) > 0.9 * count
    assert_same(found, reference)


def test_more_contacts_than_threads(device: torch.device) -> None:
    """Nearly all candidates of a pair touch, most of them later than the first."""
    crowd = plates(8)
    found, first = crowd.detect(device, "all"), crowd.detect(device)
    assert len(found) > 70_000 and len(first) == 8
    for pair, toi in zip(first.pairs, first.toi, strict=True):
        assert toi == found.toi[(found.pairs == pair).all(dim=1)].min()
    reference = crowd.detect("cpu")
    assert_same(first, reference)
