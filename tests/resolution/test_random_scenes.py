"""`pgccd.resolve` on random scenes of every kind: the plain rule, and what it promises, tested independently."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
from support.random_scenes import RandomScene, random_scene
from support.resolving import check_boxes, check_resolution, plain_resolve
from support.shapes import unit_quaternions

import pgccd

BOX = np.array(list(np.ndindex(2, 2, 2))) - 0.5
FACES = [[0, 1, 3], [0, 3, 2], [4, 6, 7], [4, 7, 5], [0, 4, 5], [0, 5, 1], [2, 3, 7], [2, 7, 6], [0, 2, 6], [0, 6, 4]]
FACES += [[1, 5, 7], [1, 7, 3]]
_OPTIONS = ("min_separation", "tolerance", "initial")


def scenes(count: int, begin: int = 0) -> list[RandomScene]:
    """Scenes whose motion is one step."""
    made = (random_scene(seed) for seed in range(begin, begin + 3 * count))
    return [scene for scene in made if "trajectory" not in scene.kind][:count]


def options_of(made: RandomScene) -> dict[str, Any]:
    options = {name: made.arguments[name] for name in _OPTIONS}
    # Of the scenes many intersect at the start.
    return options | {"initial": "report"}


def resolve_and_check(made: RandomScene, device: torch.device) -> pgccd.Resolution[Any]:
    scene, motion, options = made.scene(device), made.motion(device), options_of(made)
    rng = np.random.default_rng(made.seed)
    movable = (rng.uniform(size=scene.body_count) < rng.choice([0.5, 1.0])).tolist()
    resolved = pgccd.resolve(scene, motion, movable, **options)
    expected = plain_resolve(scene, motion, movable, **options)
    assert resolved.fraction.tolist() == expected.fraction, made
    assert resolved.stopped_by.tolist() == expected.stopped_by, made
    assert resolved.rounds == expected.rounds, made
    check_resolution(scene, motion, resolved, movable, **options)
    return resolved


def test_random_scenes(device: torch.device) -> None:
    made = [(scene.kind, resolve_and_check(scene, device)) for scene in scenes(112)]
    assert {kind for kind, _ in made} == {"rigid", "posed", "linear", "deforming"}
    stopped = sum(int(((r.fraction > 0.0) & (r.fraction < 1.0)).any()) for _, r in made)
    listed = [sum(len(getattr(r, name)) > 0 for _, r in made) for name in ("touching_at_start", "unresolved")]
    assert stopped > 12 and min(listed) > 8 and max(r.rounds for _, r in made) > 3, (stopped, listed)


@pytest.mark.slow
def test_many_random_scenes(device: torch.device) -> None:
    for made in scenes(600, begin=1000):
        resolve_and_check(made, device)


def boxes(seed: int, count: int, spacing: float, device: torch.device) -> tuple[pgccd.Scene, pgccd.RigidMotion]:
    """Turning boxes near points of a lattice."""
    rng = np.random.default_rng(seed)
    half = np.array([0.5, 0.3, 0.15])
    scene = pgccd.Scene([pgccd.Mesh(2.0 * half * BOX, FACES)], torch.zeros(count, dtype=torch.int32), device=device)
    side = int(np.ceil(count ** (1 / 3)))
    place = spacing * (np.stack(np.unravel_index(np.arange(count), (side,) * 3), axis=1) + rng.uniform(size=(count, 3)))
    poses = place, unit_quaternions(rng, count), rng.normal(size=(count, 3)), 2.0 * rng.normal(size=(count, 3))
    columns = [torch.tensor(column, device=device) for column in poses]
    return scene, pgccd.RigidMotion.from_velocity(*columns, dt=1.0)


@pytest.mark.parametrize(("seed", "spacing"), [(0, 1.2), (1, 0.8), (2, 2.0)])
def test_boxes_do_not_overlap_by_separating_axes(seed: int, spacing: float, device: torch.device) -> None:
    half = np.array([0.5, 0.3, 0.15])
    scene, motion = boxes(seed, 125, spacing, device)
    movable = torch.rand(125, generator=torch.Generator().manual_seed(seed)) < 0.9
    for may_move in (None, movable):
        resolved = pgccd.resolve(scene, motion, may_move)
        listed = {tuple(pair) for p in (resolved.touching_at_start, resolved.unresolved) for pair in p.tolist()}
        assert check_boxes(half, motion, resolved.fraction, listed) > 1000
        assert (may_move is None) == (len(resolved.unresolved) == 0)
        assert int((resolved.fraction < 1.0).sum()) > 30
    if spacing < 1.0:
        assert len(resolved.touching_at_start) > 30
        return
    # The check itself finds boxes that stop at their own toi while others go on.
    own = pgccd.detect(scene, motion, nonzero_toi=True).first_toi("body").clamp(max=1.0)
    with pytest.raises(AssertionError, match="at "):
        check_boxes(half, motion, own, {tuple(p) for p in resolved.touching_at_start.tolist()})


def test_worlds_do_not_depend_on_one_another(device: torch.device) -> None:
    """Interleaved worlds, which leave the order of the bodies of each as it is, give the bits of each one alone."""
    alone = [boxes(seed, 64, 1.0, device) for seed in (3, 4)]
    rows = torch.stack([torch.arange(64), torch.arange(64) + 64], dim=1).reshape(-1)
    columns = [torch.cat([getattr(m, name) for _, m in alone])[rows] for name in alone[0][1].columns()]
    motion = pgccd.RigidMotion.from_rotation(columns[0], columns[2], columns[1], columns[3])
    scene = pgccd.Scene(
        alone[0][0].meshes, torch.zeros(128, dtype=torch.int32, device=device), world=torch.arange(128) % 2
    )
    together = pgccd.resolve(scene, motion)
    for world, (one_scene, one_motion) in enumerate(alone):
        one = pgccd.resolve(one_scene, one_motion)
        assert torch.equal(together.fraction[world::2], one.fraction)
        assert torch.equal(together.stopped_by[world::2] // 2, one.stopped_by)
        for name in ("touching_at_start", "unresolved"):
            pairs = getattr(together, name)
            assert torch.equal(pairs[pairs[:, 0] % 2 == world] // 2, getattr(one, name))
    # The order of all bodies only decides which one of a pair is named first, which moves a toi by its rounding.
    order = torch.randperm(128, generator=torch.Generator().manual_seed(0)).to(device)
    shuffled = pgccd.resolve(pgccd.Scene(scene.meshes, scene.mesh_index, world=scene.world[order]), motion[order])
    assert torch.allclose(shuffled.fraction, together.fraction[order], atol=1e-6)
