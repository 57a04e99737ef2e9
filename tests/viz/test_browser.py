"""Pages in Chromium: bodies are drawn where motions have them; buttons, boxes and the slider do what they say."""

from __future__ import annotations

import re
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from support.steps import step_of

import pgccd
from pgccd import sim, viz
from pgccd.viz import content
from pgccd.viz.raster import placed

CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
FLAGS = ["--no-sandbox", "--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]
CORNERS = [[-1.0, -1, -1], [1, -1, -1], [-1, 1, -1], [1, 1, -1], [-1, -1, 1], [1, -1, 1], [-1, 1, 1], [1, 1, 1]]
QUADS = [[0, 2, 3, 1], [4, 5, 7, 6], [0, 1, 5, 4], [2, 6, 7, 3], [0, 4, 6, 2], [1, 3, 7, 5]]
CUBE = pgccd.Mesh(0.5 * np.array(CORNERS), [t for a, b, c, d in QUADS for t in ([a, b, c], [a, c, d])])
BACKGROUND = np.array([244, 246, 249])
FIRST, SECOND = "orange", "yellow"


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    playwright = pytest.importorskip("playwright.sync_api")
    if CHROMIUM is None:
        pytest.skip("no Chromium")
    with playwright.sync_playwright() as started:
        chromium = started.chromium.launch(executable_path=CHROMIUM, args=FLAGS)
        yield chromium
        chromium.close()


@pytest.fixture
def open_page(browser: Any, tmp_path: Path) -> Iterator[Callable[[viz.Page], Any]]:
    problems: list[str] = []
    tabs = []

    def opened(page: viz.Page) -> Any:
        tab = browser.new_page(viewport={"width": 1000, "height": 700})
        tabs.append(tab)
        tab.add_init_script("performance.now = () => 0")  # however slow the machine, all bodies are drawn
        tab.on("pageerror", lambda error: problems.append(str(error)))
        tab.on("request", lambda asked: None if asked.url.startswith("file:") else problems.append(asked.url))
        tab.goto(page.save(tmp_path / "page.html").as_uri())
        settled(tab)
        return tab

    yield opened
    for tab in tabs:
        tab.close()
    assert problems == []


def settled(tab: Any) -> None:
    """Waits until the page has been drawn."""
    tab.evaluate("new Promise(done => { redraw(); requestAnimationFrame(() => requestAnimationFrame(done)); })")


def set_time(tab: Any, time: float) -> None:
    tab.evaluate(f"element('time').value = {time}; element('time').oninput()")
    settled(tab)


def colour_at(tab: Any, point: Any) -> np.ndarray:
    """RGB of the page at a point of the world."""
    drawn = """point => {
      const [x, y] = project(point), pixel = new Uint8Array(4), k = canvas.width / canvas.clientWidth;
      gl.readPixels(Math.round(k * x), canvas.height - Math.round(k * y), 1, 1, gl.RGBA, gl.UNSIGNED_BYTE, pixel);
      return [...pixel.slice(0, 3)];
    }"""
    return np.array(tab.evaluate(drawn, np.asarray(point).tolist()))


def name_of(colour: np.ndarray) -> str:
    if np.abs(colour - BACKGROUND).max() <= 2:
        return "nothing"
    red, green, blue = colour / max(1, colour.max())
    if blue < 0.45:
        return FIRST if green < 0.6 else SECOND
    return "grey" if red < blue + 0.05 else "other"


def meeting(**columns: Any) -> tuple[pgccd.Scene, pgccd.RigidMotion, pgccd.Contacts]:
    x = torch.tensor([[0.0, 0, 0], [4.0, 0, 0], [0.0, 4, 0]]).double()
    q = torch.tensor([[1.0, 0, 0, 0]] * 3).double()
    turn = torch.tensor([[0.0, 0, 0], [0, 0, 4.0], [0, 0, 0]]).double()  # more than half a turn
    scene = pgccd.Scene([CUBE], [0, 0, 0], **columns)
    motion = pgccd.RigidMotion.from_velocity(x, q, torch.tensor([[0.0, 0, 0], [-4, 0, 0], [4, 0, 0]]), turn, 1.0)
    return scene, motion, pgccd.detect(scene, motion)


def test_bodies_are_drawn_where_the_motion_has_them(open_page: Callable[[viz.Page], Any]) -> None:
    scene, motion, _ = meeting()
    tab = open_page(viz.Page.of(scene, motion))
    tab.evaluate("document.querySelector('section').hidden = true")
    for time in (0.0, 0.4, 0.7):
        set_time(tab, time)
        assert tab.inner_text("#clock") == f"{time:.3f} of the step"
        position, orientation = (column.numpy() for column in motion.at(time))
        tops = np.array([[x, y, 0.5] for x in (-0.46, 0.46) for y in (-0.46, 0.46)])  # just inside of the upper corners
        for top in placed(tops, position, orientation).reshape(-1, 3):
            assert name_of(colour_at(tab, top)) != "nothing"
    set_time(tab, 0.0)
    assert name_of(colour_at(tab, [2.0, 2.0, 0.0])) == "nothing" == name_of(colour_at(tab, [4.0, 4.0, 0.0]))
    set_time(tab, 1.0)
    assert name_of(colour_at(tab, [4.0, 4.0, 0.0])) == "grey"  # body 2 has come


def test_next_collision_shows_two_colours_the_point_and_what_it_ticked(open_page: Callable[[viz.Page], Any]) -> None:
    scene, motion, hits = meeting()
    assert hits.pairs.tolist() == [[0, 1]]
    fraction = pgccd.resolve(scene, motion).fraction
    tab = open_page(viz.Page.of(scene, motion, hits, fraction=fraction))
    tab.evaluate("document.querySelector('section').style.left = '-400px'")
    set_time(tab, 1.0)
    stopped = motion.at(fraction)[0].numpy()
    assert name_of(colour_at(tab, stopped[1])) != "nothing" and np.abs(stopped[1] - stopped[0])[0] > 1.0
    tab.evaluate("element('next').click()")
    settled(tab)
    assert float(tab.input_value("#time")) == pytest.approx(float(hits.toi[0]), abs=1e-9)
    about = tab.inner_text("#about")
    assert about.startswith(f"Body 0 and body 1 touch at {float(hits.toi[0]):.6f} of the step (contact 1 of 1)")
    for name in ("pair", "whole"):
        assert tab.is_checked(f"#{name}") and tab.inner_text(f"#{name}-why") == "(ticked by Next collision)"
    assert "2 of 3 bodies" in tab.inner_text("#drawn")
    position = motion.at(float(hits.toi[0]))[0].numpy()
    tab.evaluate("element('marks').click()")
    settled(tab)
    assert [name_of(colour_at(tab, position[body])) for body in range(3)] == [FIRST, SECOND, "nothing"]
    without = colour_at(tab, hits.point[0])
    tab.evaluate("element('marks').click()")
    settled(tab)
    assert colour_at(tab, hits.point[0]).max() < 40 < without.max()  # the mark is dark
    tip = hits.point[0].numpy() + 0.1 * hits.normal[0].numpy()
    assert colour_at(tab, tip).max() < 40  # the arrow points from body 0 to body 1
    # A box that the user has ticked stays so.
    tab.evaluate("element('whole').click(); element('whole').click(); element('home').click()")
    settled(tab)
    assert not tab.is_checked("#pair") and tab.is_checked("#whole") and tab.inner_text("#about") == ""
    assert tab.inner_text("#pair-why") == ""


def test_contacts_are_told_by_names(open_page: Callable[[viz.Page], Any]) -> None:
    scene, motion, hits = meeting()
    tab = open_page(viz.Page.of(scene, motion, hits, names=["<i>cup</i> & lid", "table", "lamp"]))
    tab.evaluate("element('next').click()")
    assert tab.inner_text("#about").startswith("Body 0 (<i>cup</i> & lid) and body 1 (table) touch at ")


def test_play_moves_the_slider_and_stops(open_page: Callable[[viz.Page], Any]) -> None:
    tab = open_page(viz.Page.of(*meeting()))
    tab.click("#play")
    tab.wait_for_function("Number(element('time').value) > 0.02")
    assert tab.inner_text("#play") == "Pause"
    tab.click("#play")
    settled(tab)
    time = tab.input_value("#time")
    settled(tab)
    assert tab.input_value("#time") == time and tab.inner_text("#play") == "Play"
    tab.keyboard.press("Tab")
    tab.mouse.move(700, 400)
    tab.mouse.wheel(0, -300)
    settled(tab)


def test_controls_without_use_are_hidden(open_page: Callable[[viz.Page], Any]) -> None:
    scene, motion, hits = meeting()
    still = open_page(viz.Page.of(scene, pgccd.RigidMotion.at_rest(motion.position_t0, motion.orientation_t0)))
    names = ["timing", "play", "next", *(f"{name}-label" for name in ("alone", "pair", "whole", "marks", "margins"))]
    names.append("worlds-label")
    assert not any(still.is_visible(f"#{name}") for name in names) and still.is_visible("#home")
    scene, motion, hits = meeting(world=[0, 0, 1], margin=0.1)
    full = open_page(viz.Page.of(scene, motion, hits, fraction=1.0))
    assert all(full.is_visible(f"#{name}") for name in names)


def test_worlds_are_shown_one_by_one_or_together(
    open_page: Callable[[viz.Page], Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    scene, motion, hits = meeting(world=[1, 1, 0])
    tab = open_page(viz.Page.of(scene, motion, hits))
    tab.evaluate("document.querySelector('section').style.left = '-400px'")
    set_time(tab, 0.0)
    places = motion.at(0.0)[0].numpy()

    def drawn() -> list[bool]:
        settled(tab)
        return [name_of(colour_at(tab, place)) != "nothing" for place in places]

    assert tab.input_value("#world") == "1" and drawn() == [True, True, False]
    tab.select_option("#world", "0")
    assert drawn() == [False, False, True]
    tab.select_option("#world", "-1")
    assert drawn() == [True, True, True]
    # Worlds that the list has no room for are added to it.
    monkeypatch.setattr(content, "_MOST_CHOICES", 1)
    tab = open_page(viz.Page.of(scene, motion, hits))
    tab.evaluate("document.querySelector('section').style.left = '-400px'")
    set_time(tab, 0.0)
    assert tab.input_value("#world") == "1" and drawn() == [True, True, False]


@pytest.mark.parametrize("is_rigid", [True, False])
def test_trajectories_are_drawn_segment_by_segment(is_rigid: bool, open_page: Callable[[viz.Page], Any]) -> None:
    x = torch.tensor([[[0.0, 0, 0], [4, 0, 0]], [[0, 3, 0], [4, 0, 0]], [[4, 3, 0], [4, 2.5, 0]]]).double()
    q = torch.tensor([1.0, 0, 0, 0]).double().expand(3, 2, 4)
    trajectory = pgccd.Trajectory(x, q)
    if not is_rigid:
        trajectory = pgccd.Trajectory((x[:, :, None] + CUBE.vertices).reshape(3, -1, 3))
    scene = pgccd.Scene([CUBE], [0, 0])
    hits = pgccd.detect(scene, trajectory)
    assert hits.segment.tolist() == [1]
    tab = open_page(viz.Page.of(scene, trajectory, hits))
    tab.evaluate("document.querySelector('section').style.left = '-400px'")
    for time, place in ((0.0, [0, 0, 0]), (0.25, [0, 1.5, 0]), (0.5, [0, 3, 0]), (0.75, [2, 3, 0])):
        set_time(tab, time)
        assert name_of(colour_at(tab, place)) != "nothing"
        assert (name_of(colour_at(tab, [0, 0, 0])) == "nothing") == (time > 0.0)
        assert tab.inner_text("#clock") == f"waypoint {2 * time:.2f} of 0 to 2"
    tab.evaluate("element('next').click()")
    assert float(tab.input_value("#time")) == pytest.approx(float(hits.time[0]), abs=1e-9)
    assert f"touch at {float(hits.toi[0]):.6f} of segment 1" in tab.inner_text("#about")


def test_margins_are_shells_around_bodies(open_page: Callable[[viz.Page], Any]) -> None:
    scene, motion, hits = meeting(margin=[0.0, 0.0, 0.5])
    tab = open_page(viz.Page.of(scene, motion, hits))
    tab.evaluate("document.querySelector('section').style.left = '-400px'")
    set_time(tab, 0.0)
    beside, other = [0.0, 4.0, 0.76], [4.0, 0.0, 0.85]
    assert name_of(colour_at(tab, beside)) == name_of(colour_at(tab, other)) == "nothing"
    tab.evaluate("element('margins').click()")
    settled(tab)
    assert name_of(colour_at(tab, beside)) != "nothing"
    assert name_of(colour_at(tab, other)) == "nothing"  # it has none


def test_glass_and_pale_marks_show_what_is_inside(open_page: Callable[[viz.Page], Any]) -> None:
    """A ball that meets a shell from within."""
    scene = pgccd.Scene([pgccd.Mesh.icosphere(1.0, 3), pgccd.Mesh.icosphere(0.3, 2)])
    q, x = torch.tensor([[1.0, 0, 0, 0]] * 2).double(), torch.zeros(2, 3).double()
    motion = pgccd.RigidMotion(x, q, x + torch.tensor([[0.0, 0, 0], [0.8, 0.1, 0.1]]), q)
    hits = pgccd.detect(scene, motion)
    tab = open_page(viz.Page.of(scene, motion, hits))
    tab.click("#next")
    settled(tab)
    point = hits.point[0].numpy()
    tab.evaluate("([x, y]) => { camera.azimuth = Math.atan2(-y, -x); camera.elevation = 0; }", point[:2].tolist())
    settled(tab)
    hidden = colour_at(tab, point)  # behind the shell
    assert 45 < hidden.max() < 200 and hidden[0] > 1.3 * hidden[2]
    tab.check("#glass")
    settled(tab)
    assert colour_at(tab, point).max() < 40 and colour_at(tab, 0.6 * point + [0.0, 0.0, 0.2]).max() > 100


def test_large_pages_begin_with_some_bodies(open_page: Callable[[viz.Page], Any]) -> None:
    count = 400
    x = torch.cartesian_prod(*[torch.arange(8.0)] * 3)[:count].double() * 3.0
    q = torch.tensor([[1.0, 0, 0, 0]]).repeat(count, 1).double()
    scene = pgccd.Scene([pgccd.Mesh.icosphere(1.0, 4)], [0] * count)
    tab = open_page(viz.Page.of(scene, pgccd.RigidMotion(x, q, x, q)))
    tab.wait_for_function("share === 1 && !wanted")
    assert tab.evaluate("triangles") > 2e6 and tab.evaluate("FIRST_TRIANGLES") < 1e6 and tab.evaluate("frames") >= 2
    assert "400 of 400" in tab.inner_text("#drawn") and tab.inner_text("#slow") == ""


def test_slow_machines_leave_out_bodies_that_do_not_collide_and_say_so(open_page: Callable[[viz.Page], Any]) -> None:
    count = 64
    x = torch.zeros(count, 3).double()
    x[:, 0] = 3.0 * torch.arange(count)
    x[1, 0] = 2.0
    q = torch.tensor([[1.0, 0, 0, 0]]).double().repeat(count, 1)
    scene, end = pgccd.Scene([CUBE], [0] * count), x.clone()
    end[1, 0] = 0.5
    motion = pgccd.RigidMotion(x, q, end, q)
    tab = open_page(viz.Page.of(scene, motion, pgccd.detect(scene, motion)))
    assert "64 of 64 bodies" in tab.inner_text("#drawn") and tab.inner_text("#slow") == ""
    tab.evaluate("{ let now = 0; performance.now = () => now += 300; }")
    for _ in range(12):
        settled(tab)
    assert tab.inner_text("#drawn").split("zoom. ")[-1].startswith("2 of 64 bodies")
    text = " ".join(tab.inner_text("#slow").split())
    assert text == "Drawing is slow on this machine: 62 bodies that do not collide are left out."
    places = motion.at(0.0)[0].numpy()
    tab.evaluate("document.querySelector('section').style.left = '-400px'")
    set_time(tab, 0.0)
    assert all(name_of(colour_at(tab, place)) != "nothing" for place in places[:2])


def test_a_page_opens_at_the_first_contact_beside_its_panel(open_page: Callable[[viz.Page], Any]) -> None:
    scene, motion, hits = meeting()
    scene, motion = pgccd.Scene([CUBE], [0, 0]), motion[:2]
    tab = open_page(viz.Page.of(scene, motion, hits))
    toi = float(hits.toi[0])
    assert float(tab.input_value("#time")) == pytest.approx(toi, abs=1e-9) and tab.inner_text("#about") == ""
    panel = tab.evaluate("document.querySelector('section').getBoundingClientRect().right")
    for time in (toi, 0.0, 1.0):
        set_time(tab, time)
        for place in motion.at(time)[0].tolist():
            x, y = tab.evaluate("point => project(point)", place)
            assert panel < x < 1000 and 0 < y < 700 and name_of(colour_at(tab, place)) not in ("nothing", "grey")
    assert float(open_page(viz.Page.of(scene, motion)).input_value("#time")) == 0.0
    # On a narrow page there is no room beside the panel.
    tab.set_viewport_size({"width": 500, "height": 700})
    settled(tab)
    assert abs(tab.evaluate("project(data.centre)[0]") - 250) < 1


def stops(is_rigid: bool) -> tuple[pgccd.Scene, list[Any], list[pgccd.Contacts], list[torch.Tensor]]:
    """Cube 0 rests; cube 1 comes and stops halfway, then goes away; in the first step it would go on through cube 0."""
    x = torch.tensor([[0.0, 0, 0], [4.0, 0, 0]]).double()
    halfway = torch.tensor([[0.0, 0, 0], [2.0, 0, 0]]).double()
    q = torch.tensor([[1.0, 0, 0, 0]] * 2).double()
    ends = [(x, torch.zeros(2, 3).double()), (halfway, halfway + torch.tensor([[0.0, 0, 0], [0, 4, 0]]))]
    motions: list[Any] = [pgccd.RigidMotion(start, q, end, q) for start, end in ends]
    scene = pgccd.Scene([CUBE], [0, 0])
    if not is_rigid:
        corners = [[(at[:, None] + CUBE.vertices).reshape(-1, 3) for at in pair] for pair in ends]
        motions = [pgccd.VertexMotion(*pair) for pair in corners]
    hits = [pgccd.detect(scene, motion) for motion in motions]
    assert [len(found) for found in hits] == [1, 0]
    return scene, motions, hits, [torch.tensor([1.0, 0.5]), torch.tensor([1.0, 1.0])]


@pytest.mark.parametrize("is_rigid", [True, False])
def test_recorded_steps_are_drawn_with_their_stops(is_rigid: bool, open_page: Callable[[viz.Page], Any]) -> None:
    scene, motions, hits, fractions = stops(is_rigid)
    tab = open_page(viz.Page.of(scene, motions, hits, fraction=fractions))
    tab.evaluate("document.querySelector('section').style.left = '-400px'")
    assert float(tab.input_value("#time")) == pytest.approx(0.5 * float(hits[0].toi[0]), abs=1e-9)
    tab.evaluate("element('marks').click()")
    cases = [(0.0, [4, 0, 0], "0.000 of step 0"), (0.25, [3, 0, 0], "0.500 of step 0")]
    cases += [
        (0.499, [2, 0, 0], "0.998 of step 0"),
        (0.501, [2, 0, 0], "0.002 of step 1"),
        (1.0, [2, 4, 0], "1.000 of"),
    ]
    for time, place, clock in cases:
        set_time(tab, time)
        assert tab.inner_text("#clock").startswith(clock)
        red, green, _ = colour_at(tab, place)
        assert name_of(colour_at(tab, place)) in (FIRST, "other")
        # Strong in the step of the contact, pale in others.
        assert (green / red < 0.5) == (time < 0.5)
        assert name_of(colour_at(tab, [4 if place[0] == 3 else 3, 2, 0])) == "nothing"
    tab.evaluate("element('whole').click()")
    set_time(tab, 0.375)
    assert name_of(colour_at(tab, [1.0, 0, 0])) != "nothing" == name_of(colour_at(tab, [2.5, 0, 0]))
    tab.evaluate("element('next').click()")
    assert f"touch at {float(hits[0].toi[0]):.6f} of step 0" in tab.inner_text("#about")


def test_the_page_of_the_model_plays_until_it_is_touched(open_page: Callable[[viz.Page], Any]) -> None:
    model = sim.Model(sim.ModelConfig(robots=60, speed=0.25))
    state, steps = model.start(), []
    for index in range(12):
        steps.append(step_of(model, state, index))
        state = steps[-1].after
    tab = open_page(sim.page_of_steps(model, steps[-3:]))
    tab.wait_for_function("Number(element('time').value) > 0.01")
    assert tab.inner_text("#play") == "Pause" and re.fullmatch(r"0\.\d+ of step 9", tab.inner_text("#clock"))
    tab.click("#next")
    settled(tab)
    assert tab.inner_text("#play") == "Play" and re.search(r" of step (9|10|11) ", tab.inner_text("#about"))
    tab.click("#play")
    set_time(tab, 0.9)  # as if the slider was moved
    assert tab.inner_text("#play") == "Play" and tab.inner_text("#clock") == "0.700 of step 11"


def test_the_page_of_the_model_does_not_play_where_drawing_is_slow(browser: Any, tmp_path: Path) -> None:
    model = sim.Model(sim.ModelConfig(robots=60, speed=0.25))
    state = model.start()
    step = step_of(model, state, 0)
    tab = browser.new_page(viewport={"width": 1000, "height": 700})
    tab.add_init_script("{ let now = 0; performance.now = () => now += 300; }")
    tab.goto(sim.page_of_steps(model, [step]).save(tmp_path / "page.html").as_uri())
    for _ in range(4):
        settled(tab)
    assert tab.inner_text("#play") == "Play" and tab.input_value("#time") == "0"
    tab.close()


def test_a_floor_keeps_its_colour(open_page: Callable[[viz.Page], Any]) -> None:
    plate = pgccd.Mesh.box([20.0, 20.0, 0.1])
    scene = pgccd.Scene([plate, CUBE], static=[True, False])
    x = torch.tensor([[0.0, 0, 0], [0.1, 0.2, 2.0]]).double()
    q = torch.tensor([[1.0, 0, 0, 0]] * 2).double()
    motion = pgccd.RigidMotion(x, q, x - torch.tensor([[0, 0, 0], [0, 0, 1.8]]), q)
    hits = pgccd.detect(scene, motion)
    tab = open_page(viz.Page.of(scene, motion, hits))
    tab.evaluate("document.querySelector('section').style.left = '-400px'; element('marks').click()")
    settled(tab)
    places = [[5.0, -5.0, 0.05], motion.at(float(hits.toi[0]))[0][1].tolist()]
    assert name_of(colour_at(tab, places[0])) == "other" and name_of(colour_at(tab, places[1])) in (FIRST, SECOND)
    red, green, blue = colour_at(tab, places[0]).astype(float)
    assert max(red, green, blue) < 1.25 * min(red, green, blue)  # nearly grey
