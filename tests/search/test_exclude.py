"""Pairs of bodies that are never tested, and given pairs of trajectories."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import torch
from support.reports import captured_loop, detected, trimmed
from support.same_bits import assert_same
from support.shapes import bumpy, tensors, tetrahedron, unit_quaternions

import pgccd

COUNT = 40


def crowd(device: torch.device, **more: object) -> tuple[pgccd.Scene, pgccd.RigidMotion]:
    rng = np.random.default_rng(2)
    columns = tensors(
        rng.uniform(0.0, 5.0, (COUNT, 3)), unit_quaternions(rng, COUNT), *rng.normal(size=(2, COUNT, 3)), device=device
    )
    meshes = [bumpy(rng, 0), tetrahedron(0.7)]
    scene = pgccd.Scene(meshes, torch.arange(COUNT) % 2, device, **more)  # type: ignore[arg-type]
    return scene, pgccd.RigidMotion.from_velocity(*columns, dt=1.0)


def keys(pairs: torch.Tensor) -> torch.Tensor:
    low, high = pairs.sort(dim=1).values.unbind(1)
    return low * COUNT + high


@pytest.mark.parametrize("report", ["any", "first", "all", "earliest"])
@pytest.mark.parametrize("broad_phase", ["sweep", "grid", "lbvh"])
def test_excluded_pairs_are_never_reported(report: str, broad_phase: str, device: torch.device) -> None:
    scene, motion = crowd(device)
    options = {"broad_phase": broad_phase}
    everything = pgccd.detect(scene, motion, "first", **options)  # type: ignore[call-overload]
    # Every second colliding pair, the first ones among them, turned round, and some that never meet; one twice.
    often = torch.tensor([[39, 0]] * 2, device=device)
    exclude = torch.cat([everything.pairs[torch.argsort(everything.toi)][::2].flip(1), often])
    without, _ = crowd(device, exclude=exclude)
    found = detected(without, motion, report, **options)
    rest = detected(scene, motion, "any", **options).pairs
    rest = rest[~torch.isin(keys(rest), keys(exclude))]
    expected = detected(scene, motion, report, pairs=rest)
    assert_same(found, expected)
    assert 0 < len(rest) < len(everything)
    # In a given capacity, and captured.
    padded = detected(without, motion, report, capacity=pgccd.Capacity.of(4000), **options)
    assert_same(padded.trim(), expected)
    captured = captured_loop(without, motion, report)
    captured(motion)
    assert_same(trimmed(captured), expected)
    streamed = detected(without, motion, report, memory_budget=1, **options)
    assert_same(streamed, expected)


def test_excluded_pairs_of_trajectories(device: torch.device) -> None:
    scene, motion = crowd(device)
    x = torch.stack([motion.position_t0, motion.position_t1, motion.position_t0])
    trajectory = pgccd.Trajectory(x, motion.orientation_t0.expand(3, COUNT, 4))
    everything = pgccd.detect(scene, trajectory, "all")
    exclude = everything.pairs.unique(dim=0)[::2]
    without, _ = crowd(device, exclude=exclude)
    found = pgccd.detect(without, trajectory, "all")
    wanted = ~torch.isin(keys(everything.pairs), keys(exclude))
    assert_same(found, everything[wanted])
    assert set(found.segment.tolist()) == {0, 1}
    # The same pairs, given.
    pairs = everything.pairs.unique(dim=0)[1::2]
    for report in ("any", "first", "all", "earliest"):
        given = detected(scene, trajectory, report, pairs=pairs)
        assert_same(given, detected(without, trajectory, report))
    assert len(pgccd.detect(scene, trajectory, pairs=pairs[:0])) == 0
    # On a GPU wrong pairs end the process.
    for wrong in (pairs.flip(1), pairs + COUNT, pairs.flip(0)) if device.type == "cpu" else ():
        with pytest.raises(ValueError, match="^pairs: expected rows"):
            pgccd.detect(scene, trajectory, pairs=wrong)


def test_resolution_and_containment_follow_excluded_pairs() -> None:
    scene, motion = crowd(torch.device("cpu"))
    exclude = pgccd.detect(scene, motion).pairs
    free, _ = crowd(torch.device("cpu"), exclude=exclude)
    assert bool((pgccd.resolve(free, motion).fraction == 1.0).all())
    padded = pgccd.resolve(free, motion, capacity=pgccd.Capacity.of(4000))
    assert bool((padded.fraction == 1.0).all()) and not bool(padded.incomplete)
    assert not bool((pgccd.resolve(scene, motion).fraction == 1.0).all())
    nested = [pgccd.Mesh.box([2.0, 2.0, 2.0]), pgccd.Mesh.icosphere(0.2)]
    x, q = torch.zeros(2, 3), torch.tensor([[1.0, 0, 0, 0]]).repeat(2, 1)
    at_rest = pgccd.RigidMotion.at_rest(x, q)
    assert pgccd.enclosed(pgccd.Scene(nested), at_rest).tolist() == [[1, 0]]
    assert pgccd.enclosed(pgccd.Scene(nested, exclude=[[0, 1]]), at_rest).tolist() == []


def test_deforming_bodies_that_are_excluded() -> None:
    mesh = tetrahedron()
    x = torch.cat([mesh.vertices, mesh.vertices + 0.1, mesh.vertices + 0.2])
    motion = pgccd.VertexMotion(x, x)
    scene = pgccd.Scene([mesh], [0, 0, 0], exclude=[(1, 2), (0, 1)])
    assert pgccd.collide(scene, motion).pairs.tolist() == [[0, 2]]


def test_a_copy_keeps_them(device: torch.device) -> None:
    scene, motion = crowd(torch.device("cpu"), exclude=torch.combinations(torch.arange(COUNT)))
    assert len(pgccd.detect(scene, motion)) == 0
    assert len(pgccd.detect(scene.to(device), motion.to(device))) == 0


def test_files_name_them(tmp_path: Path) -> None:
    pytest.importorskip("trimesh").creation.box().export(tmp_path / "box.ply")
    x, q = np.zeros((2, 3, 3)), np.tile([1.0, 0, 0, 0], (2, 3, 1))
    np.savez(tmp_path / "poses.npz", position=x, orientation=q, rotation=np.zeros((1, 3, 3)), margin=np.ones((1, 3)))
    content = {"meshes": ["box.ply"], "mesh_index": [0, 0, 0], "poses": "poses.npz", "exclude": [[0, 1], [2, 1]]}
    (tmp_path / "scene.json").write_text(json.dumps(content))
    scene, trajectory = pgccd.files.load_scene(tmp_path / "scene.json")
    assert isinstance(trajectory, pgccd.Trajectory) and trajectory.margin is not None
    assert pgccd.collide(scene, trajectory).pairs.tolist() == [[0, 2]]


def test_what_cannot_be_excluded() -> None:
    mesh = tetrahedron()
    for exclude, error, message in [
        ([[0, 2]], ValueError, r"exclude: pair 0: expected two different bodies from 0 to 1, got \[0, 2\]"),
        ([[0, 1], [1, 1]], ValueError, "exclude: pair 1: .*self_collision"),
        ([[0, 1, 1]], ValueError, r"exclude: expected pairs of different bodies, shape \(E, 2\)"),
        ([[0.0, 1.0]], TypeError, "exclude: expected integers"),
        ("01", TypeError, "exclude: expected pairs"),
    ]:
        with pytest.raises(error, match="^" + message):
            pgccd.Scene([mesh, mesh], exclude=exclude)  # type: ignore[arg-type]
    scene = pgccd.Scene([mesh, mesh], exclude=[[0, 1]])
    assert scene.exclude is not None
    scene.exclude.zero_()
    x, q = torch.zeros(2, 3), torch.tensor([[1.0, 0, 0, 0]]).repeat(2, 1)
    with pytest.raises(ValueError, match="^exclude: it is fixed, but was written to"):
        pgccd.detect(scene, pgccd.RigidMotion.at_rest(x, q))
    scene = pgccd.Scene([mesh, mesh])
    with pytest.raises(ValueError, match="^exclude: it is fixed"):
        scene.exclude = torch.tensor([[0, 1]])
    assert len(pgccd.Scene([mesh, mesh], exclude=[]).exclude) == 0  # type: ignore[arg-type]
