"""Results, motions and scenes are values: they can be copied, pickled, moved to a device, and cut into rows."""

from __future__ import annotations

import copy
import pickle
from collections.abc import Callable
from dataclasses import asdict
from typing import Any

import numpy as np
import pytest
import torch
from support.reports import detected
from support.same_bits import COLUMNS, assert_same
from support.shapes import approaching

import pgccd
from pgccd.runtime.sizes import BufferSizes

COPIES = [copy.copy, copy.deepcopy, lambda value: pickle.loads(pickle.dumps(value))]


def step(device: torch.device | str = "cpu") -> tuple[pgccd.Scene, pgccd.RigidMotion]:
    b = approaching(np.random.default_rng(3), (1, 1, 0), (1.0, 1.0, 1.0), closeness=0.6)
    return b.scene(device), b.motion(device=device)


@pytest.mark.parametrize("copied", COPIES)
@pytest.mark.parametrize("report", ["any", "first", "all", "earliest"])
def test_results(copied: Callable[[Any], Any], report: Any, device: torch.device) -> None:
    scene, motion = step(device)
    hits = detected(scene, motion, report)
    assert len(hits) > 0
    assert_same(copied(hits), hits)
    capacity = hits.stats.needed.times(1.5)  # type: ignore[union-attr]
    padded = copied(detected(scene, motion, report, capacity=capacity))
    assert_same(padded.trim(), hits)
    assert {**asdict(padded.trim().stats), "seconds": 0, "waits": 0, "needed": 0, "scratch_bytes": 0} == {
        **asdict(hits.stats),
        "seconds": 0,
        "waits": 0,
        "needed": 0,
        "scratch_bytes": 0,
    }


@pytest.mark.parametrize("report", ["any", "first"])
def test_results_without_contacts_are_restored(report: Any, device: torch.device) -> None:
    scene, motion = step(device)
    hits = detected(pgccd.Scene(scene.meshes, [0, 0, 0], device, exclude=[[0, 1], [0, 2], [1, 2]]), motion, report)
    assert len(hits) == 0
    assert_same(type(hits).from_state_dict(hits.state_dict()), hits)


@pytest.mark.parametrize("copied", COPIES)
def test_what_overflowed_or_was_invalid(copied: Callable[[Any], Any], device: torch.device) -> None:
    scene, motion = step(device)
    with pytest.raises(pgccd.CapacityError, match="needs more: .*: 3 in 0") as caught:
        copied(pgccd.detect(scene, motion, capacity=BufferSizes(0, 0))).trim()
    again = copied(caught.value)
    assert str(again) == str(caught.value) and again.needed == caught.value.needed
    ends = torch.zeros((scene.layout.vertex_count, 3), dtype=torch.float64, device=device)
    deforming = pgccd.VertexMotion(ends, ends.clone())
    deforming.x_t1[5, 0] = torch.nan
    padded = copied(pgccd.detect(scene, deforming, capacity=pgccd.Capacity.of(9)))
    with pytest.raises(ValueError, match="^x_t1: vertex 5: expected"):
        padded.trim()
    deforming.x_t1[5, 0] = 1e40
    padded = copied(pgccd.detect(scene, deforming, capacity=pgccd.Capacity.of(9)))
    with pytest.raises(ValueError, match="^motion: body 0: expected an SBV radius"):
        padded.trim()


@pytest.mark.parametrize("copied", [*COPIES, lambda scene: scene.to(scene.device)])
def test_columns_that_are_fixed(copied: Callable[[Any], Any], device: torch.device) -> None:
    """A copy knows that they are as given, and whether they have been written to, before it was made or since."""
    mesh = pgccd.Mesh.box([1.0, 1.0, 1.0])
    x = torch.tensor([[0.0, 0, 0], [3, 0, 0], [6, 0, 0]], dtype=torch.float64, device=device)
    motion = pgccd.RigidMotion.from_velocity(x, torch.eye(4, device=device)[:1].expand(3, 4), -x, 0 * x, 1.0)
    for inference in (False, True):
        with torch.inference_mode(inference):
            exclude, colliding = torch.tensor([[0, 1]], device=device), torch.zeros(3, dtype=torch.bool, device=device)
            given: dict[str, torch.Tensor] = {"exclude": exclude, "self_collision": colliding}
            scene = pgccd.Scene([mesh], [0, 0, 0], device=device, **given)
            again = copied(copied(scene))
            assert pgccd.detect(again, motion).pairs.tolist() == [[0, 2], [1, 2]]
        for name in given:
            written = copied(copy.deepcopy(scene))
            with pytest.raises(ValueError, match=f"^{name}: it is fixed"):
                setattr(written, name, getattr(written, name).clone())
            getattr(written, name)[0] = 2
            for again in (lambda value: value, copied):
                with pytest.raises(ValueError, match=f"^{name}: it is fixed, but was written"):
                    pgccd.detect(again(written), motion)


@pytest.mark.parametrize("copied", COPIES)
def test_scenes_meshes_and_motions(copied: Callable[[Any], Any]) -> None:
    scene, motion = step()
    expected = pgccd.detect(scene, motion, "all")
    assert_same(pgccd.detect(copied(scene), copied(motion), "all"), expected)
    meshes = [copied(mesh) for mesh in scene.meshes.meshes]
    assert_same(pgccd.detect(pgccd.Scene(meshes), motion, "all"), expected)
    trusted = pgccd.RigidMotion._of_checked(
        motion.position_t0, motion.orientation_t0, motion.position_t1, motion.rotation
    )
    assert_same(pgccd.detect(scene, copied(trusted), "all"), expected)
    own = copied(motion)
    own.position_t0[0, 0] = torch.nan
    with pytest.raises(ValueError, match="^position_t0: body 0"):
        pgccd.detect(scene, own)


@pytest.mark.parametrize("copied", COPIES)
def test_approach_of_copies(copied: Callable[[Any], Any]) -> None:
    """Contacts take along what they were found with, also from columns that had been written before."""
    scene, motion = step()
    for path in (motion, trajectory(motion)):
        motion.position_t0.add_(0.0)
        hits = pgccd.detect(scene, path)
        again = copied(hits)
        assert len(hits) and torch.equal(
            pgccd.approach_rates(scene, path, again), pgccd.approach_rates(scene, path, hits)
        )
        assert_same(pgccd.approaching(scene, path, again), pgccd.approaching(scene, path, hits))


@pytest.mark.parametrize("copied", COPIES)
def test_trajectories_and_exclusions(copied: Callable[[Any], Any], device: torch.device) -> None:
    scene, motion = step(device)
    path = trajectory(motion)
    hits = pgccd.detect(scene, path, "all")
    assert_same(pgccd.detect(copied(scene), copied(path), "all"), hits)
    assert_same(pgccd.detect(scene.to(device), path.to("cpu").to(device), "all"), hits)
    without = pgccd.Scene(scene.meshes, exclude=[[1, 0]], device=device)
    some = pgccd.detect(without, path, "all")
    assert 0 < len(some) < len(hits)
    for same in (copied(without), without.to(device), pgccd.Scene.from_state_dict(without.state_dict(), device)):
        assert_same(pgccd.detect(same, path, "all"), some)
    part = path[[2, 0]]
    assert part.position.shape == (3, 2, 3) and part.margin is not None and part.margin.shape == (2, 2)
    assert_same(
        pgccd.detect(pgccd.Scene(scene.meshes, [0, 1], device=device), path[:2], "all"), hits[hits.pairs[:, 1] < 2]
    )
    with pytest.raises(IndexError, match="^rows: expected numbers of 3 rows"):
        path[[3]]
    with pytest.raises(TypeError, match="^rows: expected a trajectory of rigid bodies"):
        pgccd.Trajectory(path.position)[:1]


def trajectory(motion: pgccd.RigidMotion) -> pgccd.Trajectory:
    """The motion, and back, with rotations and margins."""
    ways = torch.stack([motion.position_t0, motion.position_t1, motion.position_t0])
    turns = torch.stack([motion.rotation, -motion.rotation])
    margin = torch.full((2, len(motion.rotation)), 0.01, dtype=torch.float64, device=motion.device)
    return pgccd.Trajectory(ways, motion.orientation_t0, rotation=turns, margin=margin)


def test_devices(device: torch.device) -> None:
    scene, motion = step()
    expected = pgccd.detect(scene, motion, "all")
    ends = torch.cat([mesh.vertices for mesh in scene.meshes.meshes])
    moved = pgccd.VertexMotion(ends, ends + 0.5).to(device)
    assert scene.radius is not None and moved.x_t0.device.type == device.type
    there = pgccd.detect(scene.to(device), motion.to(device), "all")
    assert there.pairs.device.type == device.type
    assert_same(there.to("cpu"), expected)
    back = scene.to(device).to("cpu")
    assert torch.equal(back.radius, scene.radius) and back.device.type == "cpu"
    assert_same(pgccd.detect(back, motion.to("cpu"), "all"), expected)


def test_rows(device: torch.device) -> None:
    scene, motion = step(device)
    hits = pgccd.detect(scene, motion, "all")
    count = len(hits)
    assert count > 3
    numbers = torch.arange(1, 3, device=device)
    mask = torch.zeros(count, dtype=torch.bool, device=device)
    mask[1:3] = True
    for rows in (slice(1, 3), numbers, mask, [1, 2]):
        part = hits[rows]
        assert len(part) == 2 and part.stats is hits.stats
        for name in COLUMNS:
            assert torch.equal(getattr(part, name), getattr(hits, name)[1:3])
    assert len(pgccd.collide(scene, motion)[:1]) == 1 and len(hits[[]]) == 0
    with pytest.raises(TypeError, match="^rows: expected a mask, row numbers or a slice, got 1"):
        hits[1]  # type: ignore[index]
    with pytest.raises(IndexError, match="^rows: expected numbers of 3 rows, got 3 to 3"):
        motion[[3]]
    pairs = pgccd.detect(pgccd.Scene(scene.meshes, scene.mesh_index[:2]), motion[:2], "all")
    assert_same(pairs, hits[(hits.pairs[:, 1] < 2)])
    trusted = pgccd.RigidMotion._of_checked(
        motion.position_t0, motion.orientation_t0, motion.position_t1, motion.rotation
    )
    assert trusted[:2].body_count == 2


def test_words() -> None:
    scene, motion = step()
    ends = torch.zeros(4, 3)
    hits = pgccd.detect(scene, motion, capacity=pgccd.Capacity.of(3))
    found = [repr(each) for each in (scene, scene.meshes, motion, pgccd.VertexMotion(ends, ends), hits)]
    assert repr(trajectory(motion)) == "Trajectory(waypoints=3, bodies=3, path='rigid', device=cpu)"
    assert (
        repr(pgccd.Trajectory(torch.zeros(2, 7, 3))) == "Trajectory(waypoints=2, vertices=7, path='rigid', device=cpu)"
    )
    assert found == [
        "Scene(bodies=3, meshes=3, device=cpu)",
        "MeshSet(meshes=3, device=cpu)",
        "RigidMotion(bodies=3, path='rigid', device=cpu)",
        "VertexMotion(vertices=4, device=cpu)",
        f"PaddedContacts(capacity={hits.capacity.contacts}, device=cpu)",
    ]
    assert repr(BufferSizes(1, 2)).startswith("Capacity(pairs=1, contacts=2, overlaps=0")


def test_orientations_turn() -> None:
    rng = torch.Generator().manual_seed(0)
    orientation = torch.nn.functional.normalize(torch.randn(50, 4, generator=rng, dtype=torch.float64))
    turn = torch.randn(50, 3, generator=rng, dtype=torch.float64)
    turn[0], turn[1] = 0.0, 1e-9
    turned = pgccd.integrate_orientation(orientation, turn)
    zero = torch.zeros(50, 3, dtype=torch.float64)
    # The constructor takes the shorter way; these turn by less than half a turn.
    near = torch.linalg.vector_norm(turn, dim=1) < 3.0
    again = pgccd.RigidMotion(zero, orientation, zero, turned).rotation
    assert near.sum() > 40 and torch.allclose(again[near], turn[near], atol=1e-14)
    assert torch.allclose(turned.norm(dim=1), torch.ones(50, dtype=torch.float64), atol=1e-15)
    # Two half turns make the whole one; float32 stays float32.
    half = pgccd.integrate_orientation(pgccd.integrate_orientation(orientation, 0.5 * turn), 0.5 * turn)
    assert torch.allclose(half, turned, atol=1e-14)
    single = pgccd.integrate_orientation(orientation.float(), turn.float())
    assert single.dtype == torch.float32 and torch.allclose(single.double(), turned, atol=1e-6)
    assert pgccd.integrate_orientation(torch.zeros(0, 4), torch.zeros(0, 3)).shape == (0, 4)
