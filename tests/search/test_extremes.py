"""Bodies of zero size, at tiny and huge distances; and contacts within the tolerance, for found and given pairs."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
from oracle.broad import sphere_pairs
from support.broad_phases import agreed, scattered
from support.hierarchies import Hierarchy
from support.shapes import bumpy, tensors, tetrahedron

import pgccd

OCTAHEDRON = (
    [[1.0, 0, 0], [-1.0, 0, 0], [0, 1.0, 0], [0, -1.0, 0], [0, 0, 1.0], [0, 0, -1.0]],
    [[0, 2, 4], [2, 1, 4], [1, 3, 4], [3, 0, 4], [2, 0, 5], [1, 2, 5], [3, 1, 5], [0, 3, 5]],
)


def found(hits: pgccd.Contacts) -> list[list[int]]:
    return hits.pairs.tolist()


@pytest.mark.parametrize("exponent", [0, -60, -126, -127, -130, -149, -150, -300, -450])
def test_points_that_cross(device: torch.device, exponent: int) -> None:
    """Two bodies, each collapsed to a point."""
    size = 2.0**exponent
    mesh = bumpy(np.random.default_rng(0), 0)  # more than one leaf
    at = {t: np.repeat([[x * size, 0.0, 0.0], [0.0, 0.0, 0.0]], 12, axis=0) for t, x in ((0, -1.0), (1, 1.0))}
    scene = pgccd.Scene([mesh, mesh], device=device)
    motion = pgccd.VertexMotion(*tensors(at[0], at[1], device=device))
    bodies = pgccd.MovingBodies.of(scene, motion)
    assert bodies.radius.tolist() == [0.0, 0.0]
    for broad_phase in ("sweep", "grid", "lbvh"):
        assert found(pgccd.collide(scene, motion, broad_phase=broad_phase)) == [[0, 1]]
    candidates, _ = pgccd.traverse.find_candidates(bodies, torch.tensor([[0, 1]], device=device))
    # All vertex-face and edge-edge pairs; and edge-face pairs where the bodies' distance is within rounding at t = 0.
    kinds = candidates[:, 1]
    assert int((kinds <= pgccd.Kind.EE).sum()) == 2 * 12 * 20 + 30**2
    assert int((kinds > pgccd.Kind.EE).sum()) in (0, 2 * 30 * 20)


@pytest.mark.parametrize("far", [1e6, 1e30, 1e38, 1e39, 1e42, 1e45, 1e100, 1e149])
def test_a_body_from_far_away(device: torch.device, far: float) -> None:
    """It flies through another in the middle of the step."""
    scene = pgccd.Scene([tetrahedron(), tetrahedron()], device=device)
    turn = np.tile([1.0, 0, 0, 0], (2, 1))
    start, end = np.zeros((2, 3)), np.zeros((2, 3))
    start[0, 0], end[0, 0] = -far, far
    motion = pgccd.RigidMotion(*tensors(start, turn, end, turn, device=device))
    bodies = pgccd.MovingBodies.of(scene, motion)
    pairs = torch.tensor([[0, 1]], device=device)
    assert torch.equal(pgccd.broad.find_pairs(bodies), pairs)
    candidates, _ = pgccd.traverse.find_candidates(bodies, pairs)
    assert len(candidates) > 0


def test_lengths_are_named() -> None:
    scene = pgccd.Scene([tetrahedron(), tetrahedron()])
    turn = np.tile([1.0, 0, 0, 0], (2, 1))
    motion = pgccd.RigidMotion(*tensors(np.zeros((2, 3)), turn, np.zeros((2, 3)), turn))
    for option in ("min_separation", "tolerance"):
        for value in (float("nan"), float("inf"), -1.0, 1e151):
            with pytest.raises(ValueError, match=f"^{option}: "):
                pgccd.detect(scene, motion, **{option: value})


@pytest.mark.parametrize("tolerance", [0.25, -0.25])
@pytest.mark.parametrize("separation", [0.0, 0.1])
def test_broad_phases_keep_the_tolerance(device: torch.device, separation: float, tolerance: float) -> None:
    start, end, radius = scattered(np.random.default_rng(21), 300, 12.0)
    if tolerance < 0.0:  # relative to the smaller radius: equal radii make it one length
        radius = np.full(300, 0.8)
    length = tolerance if tolerance >= 0.0 else -tolerance * 0.8
    pairs = agreed(start, end, radius, separation, tolerance=tolerance, device=device)
    assert np.array_equal(pairs.numpy(), sphere_pairs(start, end, radius, separation + length))
    assert len(pairs) > len(agreed(start, end, radius, separation, device=device)) > 50


@pytest.mark.parametrize("separation", [0.0, 0.125])
@pytest.mark.parametrize("tolerance", [None, 0.0, 1e-3, 0.25])
def test_given_pairs_change_nothing(device: torch.device, separation: float, tolerance: float | None) -> None:
    """Corners of two bodies pass each other within the tolerance where their spheres are nearest."""
    mesh = pgccd.Mesh(np.array(OCTAHEDRON[0]), OCTAHEDRON[1])
    scene = pgccd.Scene([mesh, mesh], device=device)
    turn = np.tile([1.0, 0, 0, 0], (2, 1))
    pairs = torch.tensor([[0, 1]], device=device)
    length = 1e-6 * mesh.radius if tolerance is None else tolerance
    options: dict[str, Any] = {"min_separation": separation, "tolerance": tolerance}
    touching = []
    for part in (0.0, 0.03, 0.05, 0.5, 1.0, 2.0):
        gap = 2.0 + separation + part * length
        start, end = (np.array([[0.0, y, 0.0], [gap, 0.0, 0.0]]) for y in (-0.5, 0.5))
        motion = pgccd.RigidMotion(*tensors(start, turn, end, turn, device=device))
        given = pgccd.detect(scene, motion, "all", pairs=pairs, **options)
        for broad_phase in ("sweep", "grid", "lbvh"):
            own = pgccd.detect(scene, motion, "all", broad_phase=broad_phase, **options)  # type: ignore[arg-type]
            assert torch.equal(own.pairs, given.pairs) and torch.equal(own.toi, given.toi), (part, broad_phase)
        touching.append(len(given) > 0)
    assert touching[:3] == [True] * 3 and touching[-1] == (tolerance == 0.0)


def pairs_that_turn_in_place(size: float, count: int) -> list[list[int]]:
    """The colliding ones among pairs of tetrahedra whose leaves' spheres are concentric, except for rounding."""
    rng = np.random.default_rng(3)
    corners = np.array([[1, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]]) / 3**0.5 + 0.001 * rng.normal(size=(4, 3))
    mesh = pgccd.Mesh(size * corners, [[0, 2, 1], [0, 1, 3], [1, 2, 3], [0, 3, 2]], origin="centroid")
    centre = Hierarchy.of(mesh).blocks[0, :3, 0].double().expand(count, 3)  # of the only leaf
    turn, change = torch.from_numpy(rng.normal(size=(2, count, 4)))
    start = torch.nn.functional.normalize(turn)
    end = torch.nn.functional.normalize(start + 0.1 * change)

    def rotated(quaternion: torch.Tensor) -> torch.Tensor:
        w, axis = quaternion[:, :1], quaternion[:, 1:]
        return centre + 2.0 * torch.linalg.cross(axis, torch.linalg.cross(axis, centre) + w * centre)

    position, identity = torch.zeros_like(centre), torch.tensor([1.0, 0, 0, 0], dtype=torch.float64).expand(count, 4)
    position = torch.stack([position, centre - (rotated(start) + rotated(end)) / 2], dim=1).view(-1, 3)
    poses = [torch.stack([identity, other], dim=1).view(-1, 4) for other in (start, end)]
    scene = pgccd.Scene([mesh], torch.zeros(2 * count, dtype=torch.int32))
    motion = pgccd.RigidMotion(position, poses[0], position, poses[1])
    return found(pgccd.collide(scene, motion, pairs=torch.arange(2 * count).view(count, 2)))


def test_large_bodies_without_subnormal_numbers() -> None:
    """Poses that map large bodies to the local frame are near the smallest normal numbers."""
    expected = pairs_that_turn_in_place(1.0, 2_000)
    if not torch.set_flush_denormal(True):
        pytest.skip("this processor cannot flush subnormal numbers")
    try:
        assert pairs_that_turn_in_place(2.0**98, 2_000) == expected
    finally:
        torch.set_flush_denormal(False)
    assert len(expected) > 1_000
