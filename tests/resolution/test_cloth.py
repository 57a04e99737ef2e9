"""The draping sheet of the examples never intersects the ball or itself: by a test of its own, in NumPy."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from support.cases import few_and_many
from support.documents import ROOT, run_document

import pgccd
from pgccd import distributed


def crossings(x: np.ndarray, edges: np.ndarray, faces: np.ndarray) -> int:
    """How many edges pass through triangles without a common vertex. Bounding boxes first, then signed volumes."""
    low_e, high_e = x[edges].min(axis=1), x[edges].max(axis=1)
    low_f, high_f = x[faces].min(axis=1), x[faces].max(axis=1)
    order, found = np.argsort(low_f[:, 0]), 0
    begins = low_f[order, 0]
    widest = (high_f - low_f)[:, 0].max()
    for k, (p, q) in enumerate(edges):
        near = order[
            np.searchsorted(begins, low_e[k, 0] - widest) : np.searchsorted(begins, high_e[k, 0], side="right")
        ]
        near = near[((low_f[near] <= high_e[k]) & (high_f[near] >= low_e[k])).all(axis=1)]
        near = near[((faces[near] != p) & (faces[near] != q)).all(axis=1)]
        a, b, c = np.moveaxis(x[faces[near]], 1, 0)

        def volume(u: np.ndarray, v: np.ndarray, w: np.ndarray, z: np.ndarray) -> np.ndarray:
            return np.asarray(np.einsum("ij,ij->i", np.cross(v - u, w - u), z - u))

        ends = volume(a, b, c, x[p]) * volume(a, b, c, x[q]) < 0.0
        start, sides = np.broadcast_to(x[p], a.shape), ((a, b), (b, c), (c, a))
        signs = np.stack([np.sign(volume(start, u, v, x[q])) for u, v in sides])
        found += int((ends & (np.abs(signs.sum(axis=0)) == 3)).sum())
    return found


def test_the_test_sees_crossings() -> None:
    x = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0.2, 0.2, -1], [0.2, 0.2, 1], [2.0, 2.0, 1]])
    faces = np.array([[0, 1, 2]])
    assert crossings(x, np.array([[3, 4]]), faces) == 1
    assert crossings(x, np.array([[3, 5], [0, 4], [4, 5]]), faces) == 0


@few_and_many("every", 40, 1)
def test_the_sheet_never_intersects(every: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("MPLBACKEND", "agg")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("pgccd.viz.display._is_in_notebook", lambda: True)
    names = run_document(ROOT / "examples" / "13_cloth_that_drapes.py")
    frames, sheet, ball = names["frames"], names["sheet"], names["ball"]
    count = len(sheet.vertices)
    edges = torch.cat([sheet.edges, ball.edges + count]).numpy()
    faces = torch.cat([sheet.faces, ball.faces + count]).numpy()
    for k in range(every - 1, len(frames) - 1, every):
        for share in (0.0, 0.5, 1.0)[: 3 if every == 1 else 2]:
            x = (1.0 - share) * frames[k] + share * frames[k + 1]
            assert crossings(x.numpy(), edges, faces) == 0, (k, share)
    # Of a sheet that is turned upside down through the ball, the test finds crossings, and `resolve` stops it.
    start, end = frames[-2].clone(), frames[-1].clone()
    end[:count, 2] = 2.0 * float(end[:count, 2].mean()) - end[:count, 2]
    assert crossings(end.numpy(), edges, faces) > 100
    assert float(pgccd.resolve(names["scene"], pgccd.VertexMotion(start, end)).fraction[0]) < 1.0


@pytest.mark.parametrize("is_moving", [True, False])
def test_a_deforming_body_that_cannot_move_is_named(is_moving: bool) -> None:
    """It rests on another one, which stops all of it."""
    sheet, ball = pgccd.Mesh([[-1.0, -1, 0.5], [1, -1, 0.5], [0, 1, 0.5]], [[0, 1, 2]]), pgccd.Mesh.icosphere(0.5, 2)
    x = torch.cat([sheet.vertices, ball.vertices])
    moved = x.clone()
    if is_moving:
        moved[0, 2] -= 0.1
    scene = pgccd.Scene([sheet, ball], static=[False, True])
    motion = pgccd.VertexMotion(x, moved)
    if not is_moving:
        resolved = pgccd.resolve(scene, motion, min_separation=1e-3)
    else:
        with pytest.warns(UserWarning, match=r"^resolve: body 0 deforms and has fraction 0: .*how-to/cloth"):
            resolved = pgccd.resolve(scene, motion, min_separation=1e-3)
        options, id = distributed.WorldOptions(min_separation=1e-3), torch.tensor([3, 7])
        world = distributed.World.create(scene, torch.zeros(2, 3), [-2.0] * 3, [2.0] * 3, id=id, options=options)
        with pytest.warns(UserWarning, match="^resolve: body 3 deforms and has fraction 0: ") as warned:
            world.step(motion, resolve=True)
        assert [each.filename for each in warned] == [__file__]
    assert float(resolved.fraction[0]) == 0.0
