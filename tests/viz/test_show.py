"""`pgccd.show`: files, notebooks, browsers, GLB; and what it refuses."""

from __future__ import annotations

import html
import os
import sys
import types
import webbrowser
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

import pgccd
from pgccd.viz import content
from pgccd.viz.raster import placed

# With a triangle without area.
CORNERS = [[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1], [0.5, 0, 0]]
FACES = [[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3], [0, 4, 1]]


def meeting() -> tuple[pgccd.Scene, pgccd.RigidMotion, pgccd.Contacts]:
    x = torch.tensor([[0.0, 0, 0], [3.0, 0, 0], [9.0, 9, 9]]).double()
    q = torch.nn.functional.normalize(torch.tensor([[1.0, 0, 0, 0], [1, 0.2, 0, 0], [1, 0, 0.5, 0]]).double(), dim=1)
    scene = pgccd.Scene([pgccd.Mesh(CORNERS, FACES, origin=[0.2, 0.1, 0.3])], [0, 0, 0])
    motion = pgccd.RigidMotion(x, q, x - torch.tensor([[0, 0, 0], [2.5, 0, 0], [0, 0, 0]]), q)
    return scene, motion, pgccd.detect(scene, motion)


@pytest.mark.filterwarnings("error")
def test_a_path_is_written_and_returned(tmp_path: Path) -> None:
    path = pgccd.show(*meeting(), path=tmp_path / "scene.html", title="A <title> with @DATA@")
    assert path == tmp_path / "scene.html"
    page = path.read_text()
    assert page.startswith("<!DOCTYPE html>") and "<h1>A &lt;title&gt; with @DATA@</h1>" in page
    assert pgccd.show(*meeting(), str(tmp_path / "again.html")).read_text().count("<title>3 bodies, 1 contact</title>")


def test_notebooks_get_an_object_that_displays_itself(monkeypatch: pytest.MonkeyPatch) -> None:
    fake: Any = types.ModuleType("IPython")
    fake.get_ipython = lambda: types.SimpleNamespace(kernel=object())
    monkeypatch.setitem(sys.modules, "IPython", fake)
    monkeypatch.setattr(webbrowser, "open", lambda _: pytest.fail("a browser was opened"))
    page = pgccd.show(*meeting())
    frame = page._repr_html_()
    assert frame.startswith('<iframe srcdoc="') and page.path is None
    assert html.unescape(frame.split('"')[1]) == page.html


@pytest.mark.parametrize("display", [True, False])
def test_scripts_open_a_browser_or_say_where_the_page_is(
    display: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    opened: list[str] = []
    monkeypatch.setattr(webbrowser, "open", lambda address: opened.append(address) or True)
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.setattr(sys, "platform", "linux")
    if display:
        monkeypatch.setenv("DISPLAY", ":0")
    page = pgccd.show(*meeting())
    assert page.path is not None and page.path.read_text() == page.html and page.path.parent == tmp_path
    assert opened == ([page.path.as_uri()] if display else [])
    assert capsys.readouterr().err == ("" if display else f"pgccd.show: the page is {page.path}\n")


def test_what_is_left_out_is_said_in_a_warning(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(content, "_MOST_ROWS", 2)
    sentence = "2 of 3 bodies are on this page, all 2 that collide among them."
    with pytest.warns(UserWarning, match=f"^show: {sentence}$") as caught:
        path = pgccd.show(*meeting(), path=tmp_path / "scene.html")
    assert caught[0].filename == __file__ and f'<p class="left-out">{sentence}</p>' in path.read_text()


@pytest.mark.filterwarnings("error")
def test_glb_holds_the_bodies_at_the_first_contact(tmp_path: Path) -> None:
    trimesh = pytest.importorskip("trimesh")
    scene, motion, hits = meeting()
    loaded = trimesh.load(pgccd.show(scene, motion, hits, path=tmp_path / "scene.glb"))
    position, orientation = motion.at(float(hits.toi[0]))
    expected = placed(scene.meshes.meshes[0].vertices.numpy(), position.numpy(), orientation.numpy())
    colours = []
    for body in range(3):
        matrix, name = loaded.graph[f"body {body}"]
        found = trimesh.transform_points(loaded.geometry[name].vertices, matrix)
        assert np.abs(found[:, None] - expected[body]).max(axis=2).min(axis=0).max() < 1e-5
        colours.append(tuple(loaded.geometry[name].visual.material.baseColorFactor))
    assert len(set(colours)) == 3
    matrix, name = loaded.graph["contact 0"]
    mark = trimesh.transform_points(loaded.geometry[name].vertices, matrix)
    reach = (mark - hits.point[0].numpy()) @ hits.normal[0].numpy()
    assert reach.max() > 3 * -reach.min() > 0  # a ball around the point, and a line along the normal


def test_glb_of_deforming_bodies_and_linear_paths(tmp_path: Path) -> None:
    trimesh = pytest.importorskip("trimesh")
    scene, motion, _ = meeting()
    linear = pgccd.RigidMotion(
        motion.position_t0, motion.orientation_t0, motion.position_t1, motion.orientation_t0, "linear"
    )
    local = scene.meshes.meshes[0].vertices.numpy()
    ends = [placed(local, p.numpy(), q.numpy()).reshape(-1, 3) for p, q in (motion.at(0.0), motion.at(1.0))]
    vertices = pgccd.VertexMotion(*map(torch.from_numpy, ends))
    for number, same in enumerate((linear, vertices)):
        hits = pgccd.detect(scene, same)
        assert len(hits) == 1
        loaded = trimesh.load(pgccd.show(scene, same, hits, path=tmp_path / f"{number}.glb"))
        expected = vertices.at(float(hits.toi[0])).numpy()[len(local) : 2 * len(local)]
        matrix, name = loaded.graph["body 1"]
        found = trimesh.transform_points(loaded.geometry[name].vertices, matrix)
        assert np.abs(found[:, None] - expected).max(axis=2).min(axis=0).max() < 1e-5


def test_glb_without_trimesh_names_the_extra(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "trimesh", None)
    with pytest.raises(ImportError, match=r"^path: GLB files need trimesh: pip install 'pgccd\[mesh\]'$"):
        pgccd.show(*meeting(), path=tmp_path / "scene.glb")


def test_bad_input_is_named(tmp_path: Path) -> None:
    scene, motion, hits = meeting()
    still = motion.position_t0
    trajectory = pgccd.Trajectory(torch.stack([still] * 3), torch.stack([motion.orientation_t0] * 3))
    smaller = pgccd.Scene(scene.meshes, [0, 0])
    path: Any = tmp_path / "scene.html"
    (tmp_path / "folder.html").mkdir()
    cases: list[tuple[Any, dict[str, Any], type[Exception], str]] = [
        ((scene.meshes, motion), {}, TypeError, "scene: expected a pgccd.Scene, got MeshSet"),
        (
            (scene, still),
            {},
            TypeError,
            "motion: expected a RigidMotion, VertexMotion or Trajectory, got",
        ),
        ((smaller, motion), {}, ValueError, "motion: has 3 bodies, the scene 2"),
        ((scene, pgccd.VertexMotion(still, still)), {}, ValueError, "motion: has 3 vertices, the scene 15"),
        ((scene, motion, still), {}, TypeError, "hits: expected the result of `pgccd.detect`, got a float64 tensor"),
        ((smaller, motion[:2], hits[[0, 0]]), {}, AssertionError, ""),
        ((scene, trajectory, hits), {}, ValueError, "hits: are of one step, the motion is a Trajectory"),
        ((scene, motion, pgccd.detect(scene, trajectory)), {}, ValueError, "hits: are of a trajectory, the motion is"),
        ((scene, motion), {"fraction": 2.0}, ValueError, "fraction: expected"),
        ((scene, trajectory), {"fraction": 0.5}, ValueError, "fraction: expected a motion of one step, got a Traj"),
        ((scene, motion), {"title": 3}, TypeError, "title: expected a string, got 3"),
        ((scene, motion), {"path": 3}, TypeError, "path: expected a path, got 3"),
        (
            (scene, motion),
            {"path": tmp_path / "a.png"},
            ValueError,
            "path: expected a name that ends in .html, .htm or",
        ),
        ((scene, motion), {"path": tmp_path / "folder.html"}, IsADirectoryError, "path: .* is a folder"),
        ((scene, motion), {"path": tmp_path / "no" / "a.html"}, FileNotFoundError, "path: .* there is no folder"),
    ]
    for arguments, options, error, message in cases:
        if error is AssertionError:
            pgccd.show(*arguments, path=path)  # rows of hits may be chosen
            continue
        with pytest.raises(error, match=f"^{message}"):
            pgccd.show(*arguments, **({"path": path} | options))
    alone = pgccd.Scene(scene.meshes, [0])
    with pytest.raises(ValueError, match="^hits: has a contact of body 1, but the scene has 1 bodies"):
        pgccd.show(alone, motion[:1], hits, path=path)
    motion.position_t0[1, 1] = torch.nan
    with pytest.raises(ValueError, match="^position_t0: body 1: expected finite numbers"):
        pgccd.show(scene, motion, path=path)


def test_a_file_that_cannot_be_written_is_refused_before_the_work(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("pgccd.viz.page.animation_of", lambda *_: pytest.fail("the page was made"))
    with pytest.raises(OSError, match="^path: .* cannot be written"):
        pgccd.show(*meeting(), path="/proc/scene.html")
    kept = tmp_path / "kept.html"
    kept.write_text("kept")
    with pytest.raises(OSError):
        pgccd.show(*meeting(), path=kept / "scene.html")
    assert kept.read_text() == "kept" and os.listdir(tmp_path) == ["kept.html"]
