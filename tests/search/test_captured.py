"""Detection captured once and replayed: the contacts of `detect`."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from support.capacities import ON_GPU
from support.crowds import crowds
from support.reports import captured_loop, detected, trimmed
from support.same_bits import assert_same

import pgccd
from pgccd.runtime.graph import capture
from pgccd.runtime.sizes import BufferSizes

REPORTS = ["any", "first", "all", "earliest"]


def crowd(device: torch.device) -> tuple[pgccd.Scene, list[pgccd.RigidMotion]]:
    """A scene and three steps of motion."""
    given = crowds()["faster than cells"]
    rows = torch.arange(len(given.position))
    motion = given.motion(rows)
    scene = pgccd.Scene(given.meshes, given.mesh_index, device)
    motions = []
    for share in (1.0, 0.5, 1.3):
        pose = (
            motion.position_t0,
            motion.orientation_t0,
            motion.position_t0 + share * (motion.position_t1 - motion.position_t0),
        )
        motions.append(pgccd.RigidMotion.from_rotation(*(x.to(device) for x in (*pose, motion.rotation))))
    return scene, motions


@pytest.mark.parametrize("report", REPORTS)
def test_same_contacts(device: torch.device, report: Any) -> None:
    scene, motions = crowd(device)
    captured = captured_loop(scene, motions[0], report, 0.01, nonzero_toi=True)
    assert captured.is_graph == (device.type == "cuda")
    kept = []
    for motion in [*motions, motions[0]]:
        expected = detected(scene, motion, report, 0.01, nonzero_toi=True)
        hits = captured(motion)
        assert len(expected) > 0 and not bool(hits.overflow)
        assert_same(hits.trim(), expected)
        kept.append((trimmed(captured), expected))
    for found, expected in kept:  # in their own memory
        assert_same(found, expected)


def test_deforming_bodies(device: torch.device) -> None:
    scene, motions = crowd(device)
    vertices = [scene.meshes.meshes[mesh].vertices.to(device) for mesh in scene.mesh_index.tolist()]

    def deforming(motion: pgccd.RigidMotion) -> pgccd.VertexMotion:
        ends = []
        for position in (motion.position_t0, motion.position_t1):
            ends.append(torch.cat([v + p for v, p in zip(vertices, position, strict=True)]))
        return pgccd.VertexMotion(*ends)

    captured = pgccd.CapturedDetection(scene, deforming(motions[0]))
    for motion in motions:
        expected = pgccd.detect(scene, deforming(motion))
        assert len(expected) > 0
        captured(deforming(motion))
        assert_same(trimmed(captured), expected)


def test_capacity_grows(device: torch.device) -> None:
    scene, motions = crowd(device)
    expected = pgccd.detect(scene, motions[2], "all")
    captured = pgccd.CapturedDetection(scene, motions[0], "all", capacity=BufferSizes(4, 3))
    hits = captured(motions[2])
    assert bool(hits.overflow)
    with pytest.raises(pgccd.CapacityError):
        hits.trim()
    assert_same(trimmed(captured), expected)
    assert captured.capacity.contacts >= len(expected) and not bool(captured.replay().overflow)


def test_a_motion_that_kernels_write_to(device: torch.device) -> None:
    scene, motions = crowd(device)
    captured = pgccd.CapturedDetection(scene, motions[1])
    captured.motion.position_t1.copy_(motions[0].position_t1)
    captured.replay()
    assert_same(trimmed(captured), pgccd.detect(scene, motions[0]))
    captured.motion.position_t0[5, 0] = torch.nan
    if device.type == "cpu":
        with pytest.raises(ValueError, match="position_t0: body 5"):
            captured.replay().trim()
    else:
        assert bool(captured.replay().overflow)
        with pytest.raises(ValueError, match="position_t0: body 5"):
            trimmed(captured)


def test_bad_arguments(device: torch.device) -> None:
    scene, motions = crowd(device)
    with pytest.raises(TypeError, match="^motion: expected a pgccd.RigidMotion or VertexMotion"):
        pgccd.CapturedDetection(scene, "there")  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="^report"):
        pgccd.CapturedDetection(scene, motions[0], "some")  # type: ignore[arg-type]
    captured = pgccd.CapturedDetection(scene, motions[0])
    with pytest.raises(ValueError, match=r"^motion: position_t0: expected \(\d+, 3\) on "):
        captured.load(motions[0][:3])
    x = torch.zeros(6, 3, device=device)
    with pytest.raises(TypeError, match="^motion: expected a RigidMotion"):
        captured.load(pgccd.VertexMotion(x, x))
    pose = motions[0].position_t0, motions[0].orientation_t0, motions[0].position_t1, motions[0].rotation
    with pytest.raises(ValueError, match="^motion: expected path 'rigid' as captured, got 'linear'"):
        captured.load(pgccd.RigidMotion.from_rotation(*pose, path="linear"))
    assert "CapturedDetection(bodies=" in repr(captured)


@pytest.mark.parametrize("t", [0, 0.25, 1.0])
@pytest.mark.parametrize("device", ON_GPU, indirect=True)
def test_poses_at_a_number_can_be_captured(device: torch.device, t: float) -> None:
    motion = crowd(device)[1][0]
    graph, found = capture(lambda: motion.at(t), device)
    graph.replay()
    for of_graph, expected in zip(found, motion.at(torch.tensor(t, dtype=torch.float64)), strict=True):
        assert torch.equal(of_graph, expected)
