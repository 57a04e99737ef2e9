"""Thickness of meshes: that of a scene's margins, bit by bit, in every call."""

from __future__ import annotations

from dataclasses import replace
from fractions import Fraction

import numpy as np
import pytest
import torch
from support import calls
from support.calls import Given
from support.random_scenes import RandomScene, random_scene
from support.same_bits import difference
from support.shapes import tensors

import pgccd
from pgccd.geometry.digest import meshes_digest

CALLS = [name for name in calls.CALLS if name not in ("certify", "gradients")]
BOX = pgccd.Mesh.box([1.0, 1.0, 1.0])


def both(seed: int) -> tuple[RandomScene, RandomScene]:
    """A random scene with thick meshes, and with the same margins."""
    scene = random_scene(seed)
    unit = min(mesh.radius for mesh in scene.meshes)
    thickness = [0.0, *(unit * np.random.default_rng([seed, 8]).uniform(0.01, 0.3, len(scene.meshes) - 1)).tolist()]
    meshes = [mesh.thickened(0.0) for mesh in scene.meshes]
    filters = {name: column for name, column in scene.filters.items() if name != "margin"}
    thick = [mesh.thickened(each) for mesh, each in zip(meshes, thickness, strict=True)]
    margin = torch.tensor(thickness, dtype=torch.float64)[scene.mesh_index.long()]
    return replace(scene, meshes=thick, filters=filters), replace(
        scene, meshes=meshes, filters=filters | {"margin": margin}
    )


@pytest.mark.parametrize("seed", range(8))
def test_as_margins(seed: int, device: torch.device) -> None:
    thick, wide = both(seed)
    made = 0
    for name in CALLS:
        if not calls.CALLS[name][1](Given.of(thick, str(device))):
            continue
        found, expected = (calls.made(name, Given.of(scene, str(device))) for scene in (thick, wide))
        assert type(found) is type(expected)
        if isinstance(found, str):
            assert found == expected
            continue
        assert difference(found, expected) is None, name
        made += 1
    assert made > 5


def test_it_is_added_to_margins(device: torch.device) -> None:
    """Written or replaced, of bodies whose mesh changes: the sum, rounded up."""
    x, q = tensors([[0.0, 0, 0], [1.35, 0, 0]], [[1.0, 0, 0, 0]] * 2, device=device)
    still = pgccd.RigidMotion.at_rest(x, q)
    scene = pgccd.Scene([BOX, BOX.thickened(0.1)], [0, 1], device, margin=[0.2, 0.0])
    assert not len(pgccd.detect(scene, still, tolerance=0.0))
    assert scene.margin is not None
    scene.margin[1] = 0.06
    assert len(pgccd.detect(scene, still, tolerance=0.0)) == 1
    scene.margin = None
    scene.mesh_index[0] = 1
    assert not len(pgccd.detect(scene, still, tolerance=0.0))
    assert len(pgccd.detect(scene, still, min_separation=0.16, tolerance=0.0)) == 1
    rng = np.random.default_rng(1)
    for thickness, margin in rng.uniform(0.01, 1.0, (50, 2)).tolist():
        bodies = pgccd.MovingBodies.of(pgccd.Scene([BOX.thickened(thickness)], [0, 0], device, margin=margin), still)
        assert Fraction(float(bodies.tensors[-1][0])) >= Fraction(thickness) + Fraction(margin)


def test_gradients_of_margins_remain(device: torch.device) -> None:
    x, q = tensors([[0.0, 0, 0], [3.0, 0, 0]], [[1.0, 0, 0, 0]] * 2, device=device)
    end = x + tensors([[0.0, 0, 0], [-2.5, 0, 0]], device=device)[0]
    margin = torch.tensor([0.1, 0.2], dtype=torch.float64, device=device, requires_grad=True)
    tois = []
    for mesh, given in ((BOX.thickened(0.25), margin), (BOX, margin + 0.25)):
        hits = pgccd.detect(pgccd.Scene([mesh, mesh], device=device, margin=given), pgccd.RigidMotion(x, q, end, q))
        (gradient,) = torch.autograd.grad(hits.toi.sum(), margin)
        tois.append([float(hits.toi[0].detach()), *gradient.tolist()])
    assert tois[0] == pytest.approx(tois[1]) and tois[0][1:] == pytest.approx([-0.4, -0.4])


def test_enclosed_takes_no_thickness(device: torch.device) -> None:
    x, q = tensors([[0.0, 0, 0], [0.1, 0, 0]], [[1.0, 0, 0, 0]] * 2, device=device)
    scene = pgccd.Scene([BOX, pgccd.Mesh.box([0.1] * 3).thickened(2.0)], device=device)
    assert pgccd.enclosed(scene, pgccd.RigidMotion.at_rest(x, q)).tolist() == [[1, 0]]


def test_meshes_with_thickness() -> None:
    thick = pgccd.Mesh(BOX.vertices, BOX.faces, thickness=0.25)
    assert thick.thickness == BOX.thickened(0.25).thickness == 0.25 and BOX.thickness == 0.0
    assert "thickness=0.25" in repr(thick) and "thickness" not in repr(BOX)
    assert pgccd.Mesh.from_state_dict(thick.state_dict()).thickness == 0.25
    old = BOX.state_dict()
    del old["thickness"]
    assert pgccd.Mesh.from_state_dict(old).thickness == 0.0
    digests = {meshes_digest([each]) for each in (BOX, thick, BOX.thickened(0.5), BOX.as_solid(), thick.as_solid())}
    assert len(digests) == 5 and meshes_digest([BOX.thickened(0.0)]) == meshes_digest([BOX])
    assert thick.as_solid().thickness == 0.25 and BOX.as_solid().thickened(1.0).solid
    for wrong in (-1.0, float("nan"), 1e31, float("inf")):
        with pytest.raises(ValueError, match="thickness: expected"):
            BOX.thickened(wrong)
    with pytest.raises(TypeError, match="thickness: expected"):
        pgccd.Mesh(BOX.vertices, BOX.faces, thickness="thick")  # type: ignore[arg-type]
    with pytest.raises(TypeError, match="thickness: expected"):
        pgccd.Mesh.from_state_dict(thick.state_dict() | {"thickness": None})
