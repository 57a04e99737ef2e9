"""The proof that contacts recede, row by row: against the least distance of the features, which an oracle brackets."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
import torch
from oracle import rigid, separation
from support.resting import KINDS, UPRIGHT, Kind, box, sheet, sliding
from support.surfaces import contacts_at
from torch import Tensor

import pgccd
from pgccd import ops
from pgccd.contacts.operands import operands
from pgccd.search.approaching import Recession

_SEPARATION = 0.7


def triangles(count: int, rng: np.random.Generator) -> list[pgccd.Mesh]:
    return [pgccd.Mesh(rng.normal(size=(3, 3)), [[0, 1, 2]]) for _ in range(count)]


def columns(count: int, rng: np.random.Generator) -> list[Tensor]:
    """Positions, orientations, and how they change, of pairs of bodies near each other."""
    x, v, w = rng.normal(size=(3, 2 * count, 3))
    x[1::2] = x[::2] + 1.2 * rng.normal(size=(count, 3))
    v *= np.repeat(rng.choice([0.1, 1.0], count), 2)[:, None]
    w *= np.repeat(rng.choice([0.0, 1e-3, 0.3, 3.0], count), 2)[:, None]
    q = rng.normal(size=(2 * count, 4))
    q /= np.linalg.norm(q, axis=1, keepdims=True)
    return [torch.from_numpy(each) for each in (x, q, v, w)]


def least_distances(scene: pgccd.Scene, motion: Any, hits: pgccd.Contacts) -> tuple[np.ndarray, np.ndarray]:
    """(K,) each: a proven bracket of the least distance of the features over the step."""
    low, high = np.empty(len(hits)), np.empty(len(hits))
    for kind in (pgccd.Kind.VF_AB, pgccd.Kind.VF_BA, pgccd.Kind.EE):
        rows = torch.nonzero(hits.kind == kind)[:, 0]
        of = hits.pairs[rows].flip(1) if kind == pgccd.Kind.VF_BA else hits.pairs[rows]
        numbers = hits.features[rows].flip(1) if kind == pgccd.Kind.VF_BA else hits.features[rows]
        meshes = [[scene.meshes.meshes[int(scene.mesh_index[body])] for body in side] for side in of.T]
        corners = []
        for a, b, (m, n) in zip(*meshes, numbers.tolist(), strict=True):
            one = a.edges[m].tolist() if kind == pgccd.Kind.EE else [m]
            other = b.edges[n].tolist() if kind == pgccd.Kind.EE else b.faces[n].tolist()
            corners.append(torch.cat([a.vertices[one], b.vertices[other]]))
        points, is_face = torch.stack(corners).numpy(), kind != pgccd.Kind.EE
        if motion.path == "rigid":
            given = (motion.position_t0, motion.orientation_t0, motion.position_t1, motion.rotation)
            bodies = [rigid.BodyMotion.from_rotation(*(c[of[:, k]].numpy() for c in given)) for k in (0, 1)]
            lower, upper, _ = rigid.closest_approach(points, *bodies, is_face)
        else:
            of_corner = of[:, [0, 1, 1, 1] if is_face else [0, 0, 1, 1]]
            turning = pgccd.RigidMotion.from_rotation(
                motion.position_t0, motion.orientation_t0, motion.position_t1, motion.rotation
            )
            ends = []
            for time in (0.0, 1.0):
                position, orientation = (each[of_corner].numpy() for each in turning.at(time))
                s, u = orientation[..., :1], orientation[..., 1:]
                ends.append(position + points + 2 * (s * np.cross(u, points) + np.cross(u, np.cross(u, points))))
            lower, upper, _ = separation.closest_approach(*ends, is_face)
        low[rows.numpy()], high[rows.numpy()] = lower, upper
    return low, high


@pytest.mark.parametrize("path", ["rigid", "linear"])
@pytest.mark.parametrize("seed", range(2))
def test_features_that_recede_come_no_closer(path: pgccd.PathKind, seed: int, device: torch.device) -> None:
    """Of single triangles, near each other at the start; and most of those that come no closer are found."""
    rng, count = np.random.default_rng([seed, 17]), 120
    scene = pgccd.Scene(triangles(2 * count, rng), world=torch.arange(count).repeat_interleave(2), device=device)
    x, q, v, w = (column.to(device) for column in columns(count, rng))
    motion = pgccd.RigidMotion.from_rotation(x, q, x + v, w, path=path)
    hits = pgccd.detect(scene, motion, "all", _SEPARATION)
    hits = hits[(hits.kind <= pgccd.Kind.EE) & (hits.toi == 0.0)]
    there = operands(scene, motion, hits.pairs, hits)
    lower, upper = least_distances(scene.to("cpu"), motion.to("cpu"), hits.to("cpu"))
    still = pgccd.RigidMotion.at_rest(x, q)
    gap, _ = least_distances(scene.to("cpu"), still.to("cpu"), hits.to("cpu"))
    # Features count as near as the surfaces that they are on.
    surfaces = torch.full((len(scene.mesh_index) // 2,), torch.inf, dtype=torch.float64)
    pair = hits.pairs[:, 0].cpu() // 2
    apart = surfaces.scatter_reduce(0, pair, torch.from_numpy(gap), "amin")[pair].numpy()
    found = 0
    for slack in (0.0, 1e-3, 0.1, 0.3):
        slacks = torch.full_like(scene.radius, slack)
        certain = ops.certainly_recede(*there, hits.status, slacks).bool().cpu().numpy()
        assert (upper[certain] >= apart[certain] - slack - 1e-9).all()
        stays = lower >= gap - 0.9 * slack
        found += int((certain & stays).sum())
        assert not certain.any() if slack == 0.0 else certain[stays].mean() > 0.6
    assert len(hits) > 200 and found > 250


@pytest.mark.parametrize("kind", KINDS)
def test_the_least_slack_on_a_slope(kind: Kind) -> None:
    """Far from the origin of the bodies, sinking along a slope: the slack that suffices is the depth, and no less."""
    turn = (0.7, 0.1, -0.6, 0.37416573867739417)
    far = pgccd.Mesh(box((0.5, 0.5, 0.5)).vertices + torch.tensor([300.0, -200.0, 0.0]).double(), box((1, 1, 1)).faces)
    depth = 1e-3
    floor = sheet(2, 400.0)
    scene, motion = sliding(kind, [far, floor], (0.0, 0.0, 0.5), (1.0, 0.3, -depth), orientation=turn)
    hits = pgccd.detect(scene, motion, "all", 1e-9)
    # Vertices of bodies that deform are rounded, so that surfaces may intersect at the start.
    hits = hits[hits.kind <= pgccd.Kind.EE]
    assert len(hits) > 3 and (hits.toi == 0.0).all()
    low, high = 0.0, 2.0 * depth
    for _ in range(60):
        middle = 0.5 * (low + high)
        is_certain = Recession.of(scene, motion, middle).is_certain(hits, hits.pairs)
        low, high = (low, middle) if bool(is_certain.all()) else (middle, high)
    # Rounding of the whole scene counts, though distances from the slope are small.
    assert 1e-12 < high - depth < 1e-9


def test_the_smaller_slack_of_two_bodies_counts(device: torch.device) -> None:
    scene, motion = sliding("rigid", [box((0.5, 0.5, 0.5)), sheet(2, 3.0)], (0, 0, 0.5), (0.0, 0, -1e-3), device)
    hits = pgccd.detect(scene, motion)
    given = operands(scene, motion, hits.pairs, hits)
    for slacks, expected in (([2e-3, 2e-3], 1), ([5e-4, 2e-3], 0), ([2e-3, 5e-4], 0)):
        slack = torch.tensor(slacks, dtype=torch.float64, device=device)
        assert ops.certainly_recede(*given, hits.status, slack).tolist() == [expected]


@pytest.mark.parametrize("direction", range(4))
def test_every_face_around_a_vertex(direction: int) -> None:
    """A blunt tip that stands on a sheet, and tilts: faces on one side rise, those on the other pass through it."""
    rim = torch.tensor([[2.0, 2.0, 1.0], [-2.0, 2.0, 1.0], [-2.0, -2.0, 1.0], [2.0, -2.0, 1.0]])
    tip = pgccd.Mesh(torch.cat([torch.zeros(1, 3), rim]).double(), [[0, 1 + (k + 1) % 4, 1 + k] for k in range(4)])
    scene, motion = sliding("rigid", [tip, sheet(2, 9.0)], (0.5, 0.7, 0.0), (0.0, 0.0, 0.0))
    assert isinstance(motion, pgccd.RigidMotion)
    turn = torch.zeros_like(motion.rotation)
    for angle, stays in ((0.01, 1), (0.9, 0)):
        turn[0, direction % 2] = angle * (1 - 2 * (direction // 2))
        tilting = pgccd.RigidMotion.from_rotation(motion.position_t0, motion.orientation_t0, motion.position_t1, turn)
        hits = pgccd.detect(scene, tilting, "all")
        hits = hits[(hits.kind == pgccd.Kind.VF_AB) & (hits.toi == 0.0)]
        given = operands(scene, tilting, hits.pairs, hits)
        assert hits.features[:, 0].tolist() == [0]
        assert ops.certainly_recede(*given, hits.status, torch.full_like(scene.radius, 1e-6)).tolist() == [stays]


def _certain(
    meshes: list[pgccd.Mesh],
    moving: int,
    position: tuple[float, float, float],
    travel: tuple[float, float, float],
    angle: float,
    slack: float,
) -> tuple[pgccd.Contacts, list[int]]:
    """All contacts of two bodies of which one moves, and turns about the x axis, upright at the middle of the step."""
    position_t0, rotation = torch.zeros(2, 2, 3, dtype=torch.float64)
    orientation = torch.tensor([UPRIGHT, UPRIGHT], dtype=torch.float64)
    position_t0[moving], rotation[moving, 0] = torch.tensor(position, dtype=torch.float64), angle
    orientation[moving, 0], orientation[moving, 1] = math.cos(0.25 * angle), -math.sin(0.25 * angle)
    position_t1 = position_t0.clone()
    position_t1[moving] += torch.tensor(travel, dtype=torch.float64)
    scene = pgccd.Scene(meshes, static=[body != moving for body in (0, 1)])
    motion = pgccd.RigidMotion.from_rotation(position_t0, orientation, position_t1, rotation)
    hits = pgccd.detect(scene, motion, "all")
    given = operands(scene, motion, hits.pairs, hits)
    return hits, ops.certainly_recede(*given, hits.status, torch.full_like(scene.radius, slack)).tolist()


def test_flat_surfaces_that_slide_and_rise() -> None:
    """They lie in one plane when they meet, and no side of it is where the moving one came from: it may pass through
    the plane.
    """
    moving = pgccd.Mesh([[0, 0, 0], [-1, 0.2, 0], [-1, 1, 0]], [[0, 1, 2]])
    resting = pgccd.Mesh([[0.5, -3, 0], [0.5, 3, 0], [5, 0, 0]], [[0, 2, 1]])
    for slack in (1e-6, 1e-3):
        hits, certain = _certain([moving, resting], 0, (0.0, 0.0, 0.0), (1.0, 0.0, 0.0), 0.4, slack)
        at_vertex = hits.kind == pgccd.Kind.VF_AB
        assert at_vertex.sum() == 1 and abs(float(hits.toi[at_vertex]) - 0.5) < 1e-9
        assert not certain[at_vertex.tolist().index(True)]


@pytest.mark.parametrize("moving", [0, 1])
def test_a_tip_that_swings_through_its_lowest_point(moving: int) -> None:
    """Above a sheet that it touches at both ends of the step: the slack that suffices is the depth between."""
    tip = pgccd.Mesh(
        [[0, 0, -1], [-0.1, -0.1, -0.9], [0.1, -0.1, -0.9], [0, 0.1, -0.9]],
        [[0, 2, 1], [0, 3, 2], [0, 1, 3], [1, 2, 3]],
    )
    meshes = [tip, sheet(2, 3.0)] if moving == 0 else [sheet(2, 3.0), tip]
    angle = 0.2
    height = math.cos(0.5 * angle)
    for part, expected in ((0.6, 0), (0.99, 0), (1.01, 1)):
        hits, certain = _certain(meshes, moving, (0.3, 0.4, height), (0.0, 0.0, 0.0), angle, part * (1.0 - height))
        assert len(hits) == 1 and float(hits.toi[0]) == 0.0
        assert certain == [expected]


def test_rows_that_name_no_features(device: torch.device) -> None:
    """They are not read through: NaN, their own normal, and not certain."""
    scene, motion = sliding("rigid", [box((0.5, 0.5, 0.5)), sheet(2, 3.0)], (0, 0, 0.5), (0.0, 0, 1.0), device)
    hits = pgccd.detect(scene, motion, "all")
    slack = torch.full_like(scene.radius, 1e-6)
    for motion_of in (motion, _of_vertices(scene, motion)):
        for name, value in (
            ("kind", 5),
            ("kind", -1),
            ("features", 10**6),
            ("features", -1),
            ("pairs", 1 << 40),
            ("pairs", -1),
        ):
            changed = {name: column.clone() for name, column in hits.columns.items()}
            changed[name][0] = value
            bodies = changed.pop("pairs")
            wrong = contacts_at(bodies, **{k: c for k, c in changed.items() if k != "status"})
            given = operands(scene, motion_of, bodies, wrong)
            rate, _, away, _ = ops.closing_rates(*given)
            assert rate.isnan().tolist() == away.isnan().tolist() == [True] + [False] * (len(hits) - 1)
            assert torch.equal(ops.surface_normals(*given)[0], hits.normal[0])
            assert ops.certainly_recede(*given, hits.status, slack).tolist() == [0] + [1] * (len(hits) - 1)


def _of_vertices(scene: pgccd.Scene, motion: Any) -> pgccd.VertexMotion:
    ends = (motion.position_t0, motion.position_t1)
    bodies = [scene.meshes.meshes[k].vertices.to(scene.device) for k in scene.mesh_index.tolist()]
    return pgccd.VertexMotion(*(torch.cat([v + x for v, x in zip(bodies, end, strict=True)]) for end in ends))
