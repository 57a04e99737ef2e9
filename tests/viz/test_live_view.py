"""Live views: what viser shows after an update."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
import torch

import pgccd
from pgccd import viz

CORNERS, FACES = [[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]], [[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]]


def scene() -> pgccd.Scene:
    return pgccd.Scene([pgccd.Mesh(CORNERS, FACES), pgccd.Mesh(CORNERS, FACES, "centroid")], [0, 1, 0])


def shown(view: viz.Live, name: str) -> Any:
    """What the browser shows under this name, or None."""
    return view.server.scene.get_handle_by_name(name)


@pytest.fixture
def view() -> Iterator[viz.Live]:
    pytest.importorskip("viser")
    view = viz.live(scene(), port=18080)
    yield view
    view.stop()


def test_rigid_bodies_and_contacts(view: viz.Live) -> None:
    x = torch.tensor([[0.0, 0, 0], [3.0, 0, 0], [9.0, 9, 9]]).double()
    q = torch.tensor([[1.0, 0, 0, 0]] * 3).double()
    motion = pgccd.RigidMotion(x, q, x - torch.tensor([[0, 0, 0], [2.5, 0, 0], [0, 0, 0]]), q)
    hits = pgccd.detect(scene(), motion)
    assert hits.pairs.tolist() == [[0, 1]] and view.address.startswith("http://127.0.0.1:")
    for padded in (False, True):
        view.update(*motion.at(0.5), pgccd.detect(scene(), motion, capacity=pgccd.Capacity.of(3)) if padded else hits)
        first, second = (shown(view, f"/mesh {mesh}") for mesh in range(2))
        assert np.allclose(first.batched_positions, x[[0, 2]]) and np.allclose(second.batched_positions, [[1.75, 0, 0]])
        assert np.allclose(first.batched_wxyzs, q[:2])
        assert first.batched_colors.tolist() == [[245, 102, 31], [133, 158, 189]]
        assert np.allclose(shown(view, "/points").points, hits.point)
        (line,) = shown(view, "/normals").points
        assert np.allclose((line[1] - line[0]) / np.linalg.norm(line[1] - line[0]), hits.normal[0], atol=1e-6)
    view.update(*motion.at(0.0))
    assert shown(view, "/points") is None and shown(view, "/mesh 1").batched_colors.tolist() == [[133, 158, 189]]


def test_deforming_bodies(view: viz.Live) -> None:
    x = torch.from_numpy(np.random.default_rng(0).normal(size=(12, 3)))
    for shift in (0.0, 1.0):
        view.update(x + shift)
        assert np.allclose(shown(view, "/body 1").vertices, x[4:8] + shift)


def test_bad_input_is_named(view: viz.Live, monkeypatch: pytest.MonkeyPatch) -> None:
    x, q = torch.zeros(3, 3).double(), torch.tensor([[1.0, 0, 0, 0]] * 3).double()
    for arguments, problem in (((x[:2], q), "position: "), ((x, q[:2]), "orientation: "), ((x,), "position: ")):
        with pytest.raises(ValueError, match=f"^{problem}"):
            view.update(*arguments)
    with pytest.raises(TypeError, match="^hits: expected the result of `pgccd.detect`"):
        view.update(x, q, x)  # type: ignore[arg-type]
    with pytest.raises(TypeError, match=r"^scene: expected a pgccd\.Scene"):
        viz.live(x)  # type: ignore[arg-type]
    monkeypatch.setitem(sys.modules, "viser", None)
    with pytest.raises(ImportError, match=r"^live views need viser: pip install 'pgccd\[live\]'$"):
        viz.live(scene())
