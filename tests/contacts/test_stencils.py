"""`Contacts.stencils`: weighted sums of vertices are the gaps of contacts."""

from __future__ import annotations

import numpy as np
import pytest
import torch

import pgccd
from pgccd.contacts.contacts import ContactColumns

SEPARATION = 0.05


def scene_of(device: torch.device | str = "cpu", is_thick: bool = False) -> pgccd.Scene:
    """Meshes of triangles, segments and points; some with a thickness, and bodies with margins, if `is_thick`."""
    meshes = [pgccd.Mesh.icosphere(0.5, 1), pgccd.Mesh.box([0.9, 0.7, 0.5])]
    meshes += [pgccd.Mesh.segments([[-0.5, 0, 0], [0.5, 0, 0], [0.5, 0.5, 0]], [[0, 1], [1, 2]])]
    meshes += [pgccd.Mesh.points([[-0.3, 0, 0.0], [0.4, 0.1, 0], [0.0, 0.3, 0.2]])]
    margin = None
    if is_thick:
        meshes = [mesh.thickened(0.02 * k) for k, mesh in enumerate(meshes)]
        margin = torch.linspace(0.0, 0.03, 8)
    return pgccd.Scene(meshes, [0, 1, 2, 3, 3, 2, 1, 0], device, self_collision=True, margin=margin)


def motion_of(scene: pgccd.Scene, seed: int, waypoints: int = 2) -> list[torch.Tensor]:
    """Vertices at times: bodies apart at first, then anywhere."""
    rng, mesh_index = np.random.default_rng(seed), scene.mesh_index.tolist()
    vertices = [scene.meshes.meshes[k].vertices.numpy() for k in mesh_index]
    places = 2.0 * np.stack(np.unravel_index(np.arange(len(vertices)), (2, 2, 2)), axis=1)
    found = [np.concatenate([v + p for v, p in zip(vertices, places, strict=True)])]
    for _ in range(waypoints - 1):
        moved = places + rng.normal(size=places.shape)
        bent = [v + 0.1 * rng.normal(size=v.shape) + p for v, p in zip(vertices, moved, strict=True)]
        found.append(np.concatenate(bent))
    return [torch.from_numpy(each).to(scene.device) for each in found]


def check(scene: pgccd.Scene, hits: ContactColumns, start: torch.Tensor, end: torch.Tensor) -> set[int]:
    """`start` and `end`: (X, 3), or of each contact (K, X, 3). The kinds of the contacts."""
    vertices, weights = hits.stencils(scene)
    assert vertices.shape == weights.shape == (len(hits.toi), 4) and vertices.dtype == torch.int64
    is_row = hits.pairs[:, 0] >= 0
    assert (weights[~is_row] == 0.0).all() and (vertices[~is_row] == 0).all()
    rows = torch.arange(len(vertices), device=vertices.device)[:, None]
    ends = [each[vertices] if each.dim() == 2 else each[rows, vertices] for each in (start, end)]
    x = ends[0] + hits.toi.clamp(max=1.0)[:, None, None] * (ends[1] - ends[0])
    gap = (weights[..., None] * x).sum(dim=1)
    # Features are apart by the thickness of their meshes and the margins of both bodies besides.
    thickness = torch.tensor([mesh.thickness for mesh in scene.meshes.meshes], device=scene.device)
    thick = thickness[scene.mesh_index.long()] + (0.0 if scene.margin is None else scene.margin)
    wanted = SEPARATION + thick[hits.pairs.clamp(min=0)].sum(dim=1)
    off = (gap - wanted[:, None] * hits.normal).norm(dim=1)
    assert (off[is_row] < 1e-5).all()
    # The two sides of a stencil are of the bodies of the pair.
    begin, sides = scene.layout.vertex_begin, (weights < -1e-9, weights > 1e-9)
    body = torch.searchsorted(begin, vertices, right=True) - 1
    for side, has_side in enumerate(sides):
        assert (body == hits.pairs[:, side, None])[has_side & is_row[:, None]].all()
    return set(hits.kind[is_row].tolist())


@pytest.mark.parametrize("is_thick", [False, True])
def test_weighted_sums_are_gaps_of_features(is_thick: bool, device: torch.device) -> None:
    scene, kinds = scene_of(device, is_thick), set()
    for seed in range(20):
        start, end = motion_of(scene, seed)
        motion = pgccd.VertexMotion(start, end)
        hits = pgccd.detect(scene, motion, "all", min_separation=SEPARATION)
        hits = hits[hits.toi > 0.0]
        kinds |= check(scene, hits, start, end)
        padded = pgccd.detect(scene, motion, min_separation=SEPARATION, capacity=pgccd.Capacity.of(scene.body_count))
        check(scene, padded, start, end)
    assert kinds == {pgccd.Kind.VF_AB, pgccd.Kind.VF_BA, pgccd.Kind.EE}


def test_of_trajectories(device: torch.device) -> None:
    scene = scene_of(device)
    x = torch.stack(motion_of(scene, 3, 4))
    hits = pgccd.detect(scene, pgccd.Trajectory(x), min_separation=SEPARATION)
    hits = hits[(hits.toi > 0.0) & (hits.segment == 0)]
    assert len(hits) > 0
    check(scene, hits, x[0], x[1])


def test_contacts_without_a_stencil() -> None:
    """Edges through faces at the start, and a body inside of a solid."""
    box, small = pgccd.Mesh.box([1.0, 1.0, 1.0], solid=True), pgccd.Mesh.box([0.2, 0.2, 0.2])
    ball = pgccd.Mesh.icosphere(0.6, 1)
    x = torch.cat([box.vertices, ball.vertices + 0.4, small.vertices])
    hits = pgccd.detect(scene := pgccd.Scene([box, ball, small]), pgccd.VertexMotion(x, x), "all")
    vertices, weights = hits.stencils(scene)
    none = (hits.kind != pgccd.Kind.EE) & (hits.kind != pgccd.Kind.VF_AB) & (hits.kind != pgccd.Kind.VF_BA)
    assert {pgccd.Kind.INSIDE, pgccd.Kind.EF_AB, pgccd.Kind.EF_BA} == set(hits.kind[none].tolist())
    assert (weights[none] == 0.0).all() and (vertices[none] == 0).all()


def test_other_scenes_are_refused() -> None:
    scene = scene_of()
    start, end = motion_of(scene, 0)
    hits = pgccd.detect(scene, pgccd.VertexMotion(start, end), min_separation=SEPARATION)
    with pytest.raises(ValueError, match=r"^scene: has 1 bodies, the contacts are of 8$"):
        hits.stencils(pgccd.Scene([pgccd.Mesh.box([1.0, 1.0, 1.0])]))
    with pytest.raises(TypeError, match=r"^scene: expected a pgccd.Scene, got None"):
        hits.stencils(None)  # type: ignore[arg-type]
