"""Pictures: they are not empty, and show the right surfaces."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from support.steps import step_of

from pgccd import sim, viz
from pgccd.sim.pictures import shown_steps, write_pictures
from pgccd.viz.raster import Camera, Canvas


@pytest.fixture(scope="module")
def snapshot() -> viz.Snapshot:
    model = sim.Model(sim.ModelConfig(robots=150, speed=0.25))
    state = model.start()
    for index in range(12):
        step = step_of(model, state, index)
        state = step.after
    return sim.snapshot_of_step(model, step, ["A <title>", "figures"])


def test_canvas_draws_the_nearer_of_two_triangles_where_it_is() -> None:
    camera = Camera(np.array([0.0, 0.0, 10.0]), np.zeros(3), 4.0, (80, 80), up=(0.0, 1.0, 0.0))
    square = np.array([[-1.0, -1.0, 0.0], [1.0, -1.0, 0.0], [1.0, 1.0, 0.0], [-1.0, 1.0, 0.0]])
    faces = np.array([[0, 1, 2], [0, 2, 3]])
    for scale in (1.0, 0.5):
        canvas = Canvas(camera, (0.0, 0.0, 0.0), (5.0, 15.0))
        canvas.draw(scale * square + [0.0, 0.0, 1.0], faces, np.tile([1.0, 0.0, 0.0], (2, 1)))
        canvas.draw(scale * square, faces, np.tile([0.0, 1.0, 0.0], (2, 1)))  # behind the first
        canvas.draw(
            scale * square + [0.0, 0.0, 2.0], faces[:, ::-1], np.tile([0.0, 0.0, 1.0], (2, 1))
        )  # seen from behind
        image = canvas.image()
        assert image[40, 40, 0] > 0.3 and image[40, 40, 1:].max() == 0.0
        assert image[2, 2].max() == 0.0
        side = 80 * 2 * scale / 4.0 * 10.0 / 9.0
        assert (side - 2) ** 2 < (image[..., 0] > 0).sum() < (side + 2) ** 2


@pytest.mark.filterwarnings("error")
def test_triangles_without_area_give_no_warnings() -> None:
    camera = Camera(np.array([0.0, 0.0, 10.0]), np.zeros(3), 4.0, (80, 80), up=(0.0, 1.0, 0.0))
    canvas = Canvas(camera, (0.0, 0.0, 0.0), (5.0, 15.0))
    # Points on a line, whose projections are off it by rounding; and equal points.
    along = np.array([[0.1, 0.7, 0.3]]) * np.linspace(0.0, 1.0, 1000)[:, None] + [0.3, -0.9, 0.1]
    faces = np.random.default_rng(0).integers(0, 1000, (3000, 3))
    canvas.draw(along, faces, np.ones((3000, 3)))
    assert np.isfinite(canvas.image()).all()


def test_impact_closes_its_gap_at_the_time_of_impact(snapshot: viz.Snapshot) -> None:
    impact = snapshot.impact
    assert impact is not None
    assert abs(np.interp(impact.toi, impact.times, impact.gap)) < 1e-3
    assert impact.gap[0] > 1e-3
    assert (impact.gap[impact.times < impact.toi - 0.01] > 0).all()
    assert np.linalg.norm(impact.normal) == pytest.approx(1.0)


def test_picture_is_written_and_shows_the_colliding_robots(snapshot: viz.Snapshot, tmp_path: Path) -> None:
    image_module = pytest.importorskip("matplotlib.image")
    path = viz.world_picture(tmp_path / "world.png", snapshot)
    image = image_module.imread(path)[..., :3]
    assert image.shape[0] > 1000 and image.shape[1] > 1000
    orange = (image[..., 0] > 0.5) & (image[..., 0] > 1.8 * image[..., 2])
    grey_blue = (image[..., 2] > 1.1 * image[..., 0]) & (image[..., 2] > 0.3)
    assert orange.mean() > 0.005
    assert grey_blue.mean() > 0.02


def test_a_world_between_steps_has_pictures_too(tmp_path: Path) -> None:
    model = sim.Model(sim.ModelConfig(robots=3))
    still = sim.snapshot_of_state(model, model.start())
    pytest.importorskip("matplotlib")
    assert viz.world_picture(tmp_path / "world.png", still).stat().st_size > 10_000


@pytest.mark.parametrize("steps", [0, 1, 9])
def test_a_run_is_played_from_its_last_steps(steps: int, tmp_path: Path) -> None:
    pytest.importorskip("matplotlib")
    config = sim.ModelConfig(robots=60, speed=0.25)
    keep = shown_steps(config)
    run = sim.run(config, steps, tmp_path, keep_steps=keep)
    shown = range(max(0, steps - keep), steps)
    assert keep == 6 and [step.index for step in run.last_steps] == list(shown)
    page = write_pictures(run, tmp_path)["page"].read_text()
    assert f'"step":{shown[0] if steps else "null"},' in page and f'"playing":{str(steps > 0).lower()}' in page
    assert ("Plays steps 3 to 8; the numbers are those of step 8" in page) == (steps == 9)
    assert ("<p>Plays step 0</p>" in page) == (steps == 1)


def test_larger_worlds_play_fewer_steps() -> None:
    assert [shown_steps(sim.ModelConfig(robots=n)) for n in (1, 10_000, 20_000, 30_001, 10**6)] == [6, 6, 3, 1, 1]


def test_pictures_replace_links(tmp_path: Path) -> None:
    run = sim.run(sim.ModelConfig(robots=8), 1, tmp_path / "run")
    precious = tmp_path / "precious"
    precious.write_text("precious")
    for name in ("world.html", "world.png"):
        (tmp_path / "run" / name).symlink_to(precious)
    write_pictures(run, tmp_path / "run")
    assert precious.read_text() == "precious" and (tmp_path / "run" / "world.png").stat().st_size > 1000
