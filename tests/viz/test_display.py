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


def picture(path: Path) -> np.ndarray:
    """The colours (height, width, 3) of a PNG, and its compression, checked by another reader."""
    image = pytest.importorskip("matplotlib.image").imread(path)
    assert image.shape == (1200, 1600, 3)
    return image


def areas(image: np.ndarray) -> dict[str, int]:
    """Numbers of pixels of bodies of the first contact, of others, of floors, and of marks."""
    red, green, blue = np.moveaxis(image / np.maximum(image.max(axis=2, keepdims=True), 1e-6), 2, 0)
    dark, background = image.max(axis=2) < 0.15, image.min(axis=2) > 0.94
    first = ~dark & (blue < 0.3) & (green < 0.5)
    second = ~dark & (blue < 0.4) & (green > 0.7)
    blueish = ~background & (red < 0.8)
    pale = ~dark & (image.max(axis=2) < 0.6) & (red > 0.94) & (green > 0.94)  # marks behind a surface
    names = {"first": first, "second": second, "free": blueish, "marks": dark, "nothing": background, "pale": pale}
    return {name: int(found.sum()) for name, found in names.items()}


@pytest.mark.filterwarnings("error")
def test_png_shows_the_first_contact_and_its_mark(tmp_path: Path) -> None:
    scene, motion, hits = meeting()
    found = areas(picture(pgccd.show(scene, motion, hits, path=tmp_path / "scene.png")))
    assert found.pop("pale") < 300 and all(area > 300 for area in found.values()), found
    still = areas(picture(pgccd.show(scene, motion, path=tmp_path / "still.png")))
    assert still["free"] > 300 and still["first"] == still["second"] == still["marks"] == 0
    # All bodies are in the picture, which they fill.
    for name in ("scene", "still"):
        rows, columns = np.nonzero(picture(tmp_path / f"{name}.png").min(axis=2) < 0.9)
        wide, high = columns.max() - columns.min(), rows.max() - rows.min()
        assert columns.min() > 0 and columns.max() < 1599 and rows.min() > 0 and rows.max() < 1199
        assert wide > 1400 or high > 1050


def test_png_of_floors_deforming_bodies_and_steps(tmp_path: Path) -> None:
    plate, dice = pgccd.Mesh.box([6.0, 6.0, 0.1]), pgccd.Mesh.box([1.0, 1.0, 1.0])
    scene = pgccd.Scene([plate, dice], static=[True, False])
    x = torch.tensor([[0.0, 0, 0], [0.1, 0.2, 2.0]]).double()
    q = torch.tensor([[1.0, 0, 0, 0]] * 2).double()
    fall = torch.tensor([[0.0, 0, 0], [0, 0, 0.9]]).double()
    steps = [pgccd.RigidMotion(x - k * fall, q, x - (k + 1) * fall, q) for k in range(2)]
    hits = [pgccd.detect(scene, step) for step in steps]
    assert [len(found) for found in hits] == [0, 1]
    image = picture(pgccd.show(scene, steps, hits, path=tmp_path / "floor.png"))
    found = areas(image)
    assert found["second"] > 3000 and found["first"] == 0  # the floor keeps its colour
    corners = [p + dice.vertices for p in (x[1:], x[1:] - 1.8)]
    sheet = torch.tensor([[-3.0, -3, 0], [3, -3, 0], [3, 3, 0], [-3, 3, 0]]).double()
    mesh = pgccd.Mesh(sheet, [[0, 2, 1], [0, 3, 2]])  # seen from behind
    cloth = pgccd.Scene([mesh, dice])
    motion = pgccd.VertexMotion(*(torch.cat([sheet, corner]) for corner in corners))
    found = areas(picture(pgccd.show(cloth, motion, pgccd.detect(cloth, motion), path=tmp_path / "cloth.png")))
    assert found["nothing"] < 0.8 * 1600 * 1200 and found["second"] > 3000


def test_glb_without_trimesh_names_the_extra(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "trimesh", None)
    with pytest.raises(ImportError, match=r"^path: GLB files need trimesh: pip install 'pgccd\[mesh\]'$"):
        pgccd.show(*meeting(), path=tmp_path / "scene.glb")


def test_bad_input_is_named(tmp_path: Path) -> None:
    scene, motion, hits = meeting()
    still = motion.position_t0
    trajectory = pgccd.Trajectory(torch.stack([still] * 3), torch.stack([motion.orientation_t0] * 3))
    smaller, worlds = pgccd.Scene(scene.meshes, [0, 0]), pgccd.Scene(scene.meshes, [0, 0, 0], world=[0, 0, 1])
    vertices = pgccd.VertexMotion(*torch.zeros(2, 15, 3).double())
    linear = pgccd.RigidMotion(still, motion.orientation_t0, still, motion.orientation_t0, "linear")
    path: Any = tmp_path / "scene.html"
    (tmp_path / "folder.html").mkdir()
    cases: list[tuple[Any, dict[str, Any], type[Exception], str]] = [
        ((scene.meshes, motion), {}, TypeError, "scene: expected a pgccd.Scene, got MeshSet"),
        (
            (scene, still),
            {},
            TypeError,
            "motion: expected a RigidMotion, VertexMotion or Trajectory, or a list of steps, got a float64 tensor",
        ),
        ((smaller, motion), {}, ValueError, "motion: has 3 bodies, the scene 2"),
        ((scene, pgccd.VertexMotion(still, still)), {}, ValueError, "motion: has 3 vertices, the scene 15"),
        ((scene, motion, still), {}, TypeError, "hits: expected the result of `pgccd.detect`, got a float64 tensor"),
        ((smaller, motion[:2], hits[[0, 0]]), {}, AssertionError, ""),
        ((scene, trajectory, hits), {}, ValueError, "hits: are of one step, the motion is a Trajectory"),
        ((scene, motion, pgccd.detect(scene, trajectory)), {}, ValueError, "hits: are of a trajectory, the motion is"),
        ((scene, motion), {"fraction": 2.0}, ValueError, "fraction: expected"),
        ((scene, trajectory), {"fraction": 0.5}, ValueError, "fraction: expected a motion of one step, or a list"),
        ((scene, motion), {"title": 3}, TypeError, "title: expected a string, got 3"),
        ((scene, motion), {"path": 3}, TypeError, "path: expected a path, got 3"),
        (
            (scene, motion),
            {"path": tmp_path / "a.jpg"},
            ValueError,
            r"path: expected a name that ends in .html, .htm, .png or .glb, got .*a\.jpg",
        ),
        ((scene, []), {}, ValueError, "motion: expected at least one step, got an empty list"),
        (
            (scene, [motion, trajectory]),
            {},
            TypeError,
            r"motion\[1\]: expected a RigidMotion or VertexMotion, got Traj",
        ),
        ((scene, [motion, vertices]), {}, ValueError, r"motion\[1\]: expected a motion like the first \(RigidMotion, "),
        ((scene, [motion, linear]), {}, ValueError, r"motion\[1\]: expected .* got RigidMotion, path 'linear'"),
        ((scene, [motion, motion[:2]]), {}, ValueError, r"motion\[1\]: has 2 bodies, the scene 3"),
        ((scene, [motion] * 2, hits), {}, TypeError, "hits: expected a list with one entry a step, got Contacts"),
        ((scene, [motion] * 2, [hits]), {}, ValueError, "hits: expected one entry for each of the 2 steps, got 1"),
        ((scene, [motion] * 2, [None, still]), {}, TypeError, r"hits\[1\]: expected the result of `pgccd.detect`"),
        ((scene, [motion] * 2), {"fraction": still[:, 0]}, TypeError, "fraction: expected a list with one entry a st"),
        ((scene, [motion] * 2), {"fraction": [0.5]}, ValueError, "fraction: expected one entry for each of the 2"),
        ((scene, motion), {"world": 0}, ValueError, r"world: the scene has no worlds \(`Scene.world`\), got 0"),
        ((worlds, motion), {"world": 7}, ValueError, "world: no body of the scene is in world 7"),
        ((worlds, motion), {"world": "a"}, TypeError, "world: expected an integer, got 'a'"),
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


def test_png_cuts_open_what_encloses_the_first_contact(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A ball that meets a shell from within; then a ball behind a wall. From outside nothing is cut."""
    shell, small = pgccd.Mesh.icosphere(1.0, 3), pgccd.Mesh.icosphere(0.3, 2)
    q = torch.tensor([[1.0, 0, 0, 0]] * 3).double()
    imread = pytest.importorskip("matplotlib.image").imread
    monkeypatch.setattr("pgccd.viz.png._PIXELS", (400, 300))

    def found(start: list[list[float]], end: list[list[float]], meshes: list[pgccd.Mesh]) -> dict[str, int]:
        scene, count = pgccd.Scene(meshes), len(meshes)
        motion = pgccd.RigidMotion(torch.tensor(start).double(), q[:count], torch.tensor(end).double(), q[:count])
        hits = pgccd.detect(scene, motion)
        assert len(hits) == 1
        image = imread(pgccd.show(scene, motion, hits, path=tmp_path / "cut.png"))
        return {name: 16 * area for name, area in areas(image).items()}

    inside = found([[0.0, 0, 0], [0.0, 0, 0]], [[0.0, 0, 0], [0.8, 0.1, 0.1]], [shell, small])
    assert inside["second"] > 10_000 and inside["marks"] > 300
    # From the camera's side: the small ball hides the contact, whose mark is pale.
    towards = [0.43, -0.8, 0.4]
    start = [[0.0, 0, 0], [1.6 * x for x in towards]]
    outside = found(start, [[0.0, 0, 0], towards], [shell, small])
    assert outside["second"] > 10_000 and outside["marks"] < 100 < 300 < outside["pale"]
    # Two balls behind a wall.
    wall = pgccd.Mesh.box([4.0, 0.1, 4.0])
    start, end = [[0.0, 0, 0], [1.0, 0, 0], [0.6, -1.2, 0.6]], [[0.0, 0, 0], [0.3, 0, 0], [0.6, -1.2, 0.6]]
    behind = found(start, end, [small, small, wall])
    assert behind["second"] > 3000 and behind["free"] > 100_000 and behind["marks"] > 300
