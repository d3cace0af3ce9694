"""The page with sliders, in a real browser without a network: it says what the tables say, and everything on it can be used."""

import json
import re
import time

import jax.numpy as jnp
import numpy as np
import pytest
from browser import complaints, needs_browser, open_browser, wait
from rigid import rattleback
from tops import rutstam_top

import tippe
from nonholonomic.runs.trajectory import TOLERANCE
from nonholonomic.views.pages import programs
from tippe.runs.model import TopModel
from tippe.runs.observables import AFTERWARDS
from tippe.runs.view import page_of_launch

pytestmark = needs_browser

#: How far times and end states in the browser may be from those of tables. They differ by round-off, which some runs magnify.
CLOSE = 1e-6

RANGES = {"theta": (0.02, 0.6), "spin": (60.0, 200.0), "mu": (0.05, 1.0)}


def hills(x, y):
    return x * x + 0.8 * y * y + 0.1 * jnp.sin(3.0 * x) * y * y


#: Scene, launch and horizon [s] of tops that hop on the plane, that stick, and that fly over an arena.
IN_MODES = {
    "hops": (
        tippe.Scene(rutstam_top(), friction=tippe.Viscous(0.3), contact="hybrid", restitution=0.1),
        tippe.Launch(1.5, 290.0),
        0.3,
    ),
    "sticking": (tippe.Scene(rutstam_top(), friction=tippe.SetValuedCoulomb(0.3)), tippe.Launch(0.35, 100.0), 2.0),
    "cylinder": (tippe.presets.classroom(tippe.Cylinder(0.3)), tippe.Launch(0.1, 199.0, eta=0.1), 3.0),
    "sticking and flying": (
        tippe.Scene(rutstam_top(), friction=tippe.SetValuedCoulomb(0.3), contact="hybrid", restitution=0.4),
        tippe.Launch(0.1, 280.0),
        3.0,
    ),
}

PLACED = {"place": (0.1, 0.05)}
ARENAS = {
    "plane": (tippe.Plane(), {}),
    "cylinder": (tippe.Cylinder(0.3), {"eta": 0.3}),
    "sphere": (tippe.Sphere(0.5), {"eta": 0.3}),
    "paraboloid": (tippe.Paraboloid(0.5), PLACED),
    "graph": (tippe.Graph(hills), PLACED),
}
LAWS = {"viscous": tippe.Viscous(0.3), "Coulomb": tippe.Coulomb(0.3, 0.02)}
#: Horizons [s] by which some launches have turned over, and some have not.
HORIZONS = {"viscous": 6.5, "Coulomb": 4.0}
CASES = [(arena, law) for arena in ARENAS for law in LAWS]
#: That of the ordinary run, in the turning frame.
SHORT = [("plane", "viscous")]


@pytest.fixture(scope="module")
def browser():
    with open_browser("700,500") as driver:
        yield driver


def launches_of(arena: str, law: str, seed: int) -> tuple[tippe.Scene, tippe.Launch, dict[str, np.ndarray]]:
    """A scene, a launch on it, and a grid of fifty random launches."""
    surface, place = ARENAS[arena]
    rng = np.random.default_rng(seed)
    counts = {"theta": 5, "spin": 5, "mu": 2}
    grid = {name: np.sort(rng.uniform(*ends, counts[name])) for name, ends in RANGES.items()}
    return tippe.Scene(rutstam_top(), surface, LAWS[law]), tippe.Launch(0.1, 155.0, **place), grid


def table_of(scene: tippe.Scene, launch: tippe.Launch, grid: dict[str, np.ndarray], t1: float) -> tippe.Table:
    place = {} if launch.place is None else {f"launch.place[{k}]": float(x) for k, x in enumerate(launch.place)}
    options = {"eta": float(launch.eta), "axes": place, "t1": t1, "tolerance": TOLERANCE, "progress": False}
    return tippe.inversion_table(scene, **grid, **options)


def answers(browser, page_run, values: np.ndarray) -> np.ndarray:
    """Status, time of the event, end and final angle of runs in the browser; `values`: of the sliders, (runs, sliders)."""
    browser.get("about:blank")
    script = f"""{programs(page_run)}
        const asks = integrator(live.answer), at = live.answer.runs, text = (x) => Number.isFinite(x) ? x : String(x);
        return {json.dumps(values.tolist())}.map((values) => {{
          const run = asks.run(values), cosine = run[at.state + 4];
          return [...asks.read("outcome", values), run[at.end_time], Math.acos(Math.max(-1, Math.min(1, cosine)))].map(text);
        }})"""
    return np.array(browser.execute_script(script), dtype=float).T


@pytest.mark.parametrize(
    ("arena", "law"), [pytest.param(*case, marks=() if case in SHORT else pytest.mark.slow) for case in CASES]
)
def test_the_browser_says_what_the_table_says(browser, arena, law):
    scene, launch, grid = launches_of(arena, law, CASES.index((arena, law)))
    page_run = page_of_launch(TopModel(scene=scene, launch=launch), RANGES, HORIZONS[law])
    table = table_of(scene, launch, grid, HORIZONS[law])
    theta, mu, spin = (values.ravel() for values in np.meshgrid(grid["theta"], grid["mu"], grid["spin"], indexing="ij"))
    status, time, end, angle = answers(browser, page_run, np.stack([theta, spin, mu], axis=-1))
    assert [tippe.Status(int(code)).word for code in status] == list(np.ravel(table.status))
    np.testing.assert_allclose(time, np.ravel(table.time), rtol=CLOSE)
    np.testing.assert_allclose(end, np.ravel(table.end_time), rtol=CLOSE)
    np.testing.assert_allclose(angle, np.ravel(table.end_theta), atol=CLOSE)
    # Several ways to end, or little would be compared.
    assert len(set(status)) > 1


@pytest.mark.slow
def test_the_browser_says_when_rattlebacks_reverse(browser):
    """The times of `reversal_table`, for both senses; the words are those of reversals, and a spin of 0 is not allowed."""
    page_run = page_of_launch(TopModel(scene=rattleback(), launch=tippe.Launch(0.02, -5.0)), None, 4.0)
    assert [slider.path for slider in page_run.sliders] == ["launch.theta", "launch.spin"]
    grid = {"theta": np.linspace(0.005, 0.06, 4), "spin": np.array([-8.0, -6.0, -3.0, 3.0])}
    table = tippe.reversal_table(rattleback(), **grid, t1=4.0, tolerance=TOLERANCE, progress=False)
    values = np.stack([part.ravel() for part in np.meshgrid(*grid.values(), indexing="ij")], axis=-1)
    status, time, end, _ = answers(browser, page_run, values)
    words = {int(code): word for code, word in browser.execute_script("return live.facts.words").items()}
    assert [words[int(code)] for code in status] == list(np.ravel(table.status))
    np.testing.assert_allclose(time, np.ravel(table.time), rtol=CLOSE)
    np.testing.assert_allclose(end, np.ravel(table.end_time), rtol=CLOSE)
    assert set(np.ravel(table.status)) == {"reversed", "not_reversed", "contact_lost"}
    assert page_run.allowed(jnp.array([0.02, 1.0]))
    assert not page_run.allowed(jnp.array([0.02, 0.0]))


@pytest.fixture(scope="module")
def page(browser, rutstam_scene, tmp_path_factory):
    """The page of Rutstam's top, with two sliders, opened from disk."""
    path = tmp_path_factory.mktemp("page") / "top.html"
    sliders = {"theta": (0.05, 0.5), "spin": (60.0, 200.0)}
    page = tippe.explore(rutstam_scene, tippe.Launch(0.1, 155.0), path, sliders, t1=7.0, unit=("deg", "rpm"))
    browser.get_log("browser")
    browser.get_log("performance")
    browser.get(path.as_uri())
    wait(browser, "return !!(window.live && live.ready)")
    return page


def reset(browser):
    browser.execute_script("document.getElementById('reset').click()")
    wait(browser, "return live.values()[0] === 0.1 && live.values()[1] === 155")


def test_a_run_has_the_page_of_its_scene(rutstam_scene):
    launch, sliders = tippe.Launch(0.1, 155.0), {"theta": (0.05, 0.5), "spin": (60.0, 200.0)}
    run = tippe.simulate(rutstam_scene, launch, 1.0, tolerance=1e-6)
    assert run.explore(sliders=sliders).html == tippe.explore(rutstam_scene, launch, sliders=sliders, t1=1.0).html
    with pytest.raises(ValueError, match="'offse' must be one of"):
        run.explore(sliders={"offse": (0.0, 1.0)})


def test_the_page_needs_no_network_and_complains_of_nothing(browser, page):
    assert len(page.html) < 2.5e6
    assert complaints(browser) == []
    events = [json.loads(entry["message"])["message"] for entry in browser.get_log("performance")]
    requests = [event["params"]["request"]["url"] for event in events if event["method"] == "Network.requestWillBeSent"]
    assert requests
    assert [url for url in requests if not url.startswith(("file:", "data:", "blob:"))] == []


def test_it_shows_the_time_of_the_launch_and_the_run(browser, page, rutstam_scene):
    run = tippe.simulate(rutstam_scene, tippe.Launch(0.1, 155.0), 7.0, times=[0.0, 2.0, 7.0])
    time = float(tippe.inversion_time(rutstam_scene, tippe.Launch(0.1, 155.0), 7.0))
    assert f"{time:.3f} s" in browser.find_element("id", "result").text
    assert "inverted" in browser.find_element("id", "result").text
    # L.(R n - a e), not the angular momentum.
    assert (
        f"Jellett's quantity\n{float(run.jellett[0]):.4g}".replace("e-0", "e-")
        in browser.find_element("id", "result").text
    )
    assert "kg m³/s" in browser.find_element("id", "result").text
    script = "return live.moves.trajectory(live.values(), 'frame').read([0, 2, 7]).map((row) => [...row])"
    rows = np.array(browser.execute_script(script))
    np.testing.assert_allclose(rows[:, 3:6], run.position, atol=CLOSE)
    theta, energy, jellett, force = rows[:, -5:-1].T
    np.testing.assert_allclose(theta, run.theta, atol=3e-6)
    np.testing.assert_allclose(energy, run.energy, rtol=CLOSE)
    np.testing.assert_allclose(jellett, run.jellett, rtol=CLOSE)
    np.testing.assert_allclose(force, run.normal_force, rtol=3e-6)
    np.testing.assert_allclose(np.linalg.norm(rows[:, 6:10], axis=1), 1.0, atol=1e-15)


def test_angles_and_spins_have_their_familiar_units(browser, page):
    """Like the launches that teachers describe: degrees, and revolutions per minute; in one unit, on the map, too."""
    browser.execute_script("live.set([0.209440, 157.0796])")
    texts = "return [...document.querySelectorAll('#knobs output')].map((one) => one.textContent)"
    labels = browser.execute_script(texts)
    assert labels == ["12.0 deg", "1500 rpm"]
    chips = browser.execute_script("return [...document.querySelectorAll('.chip')].map((one) => one.textContent)")
    assert any(re.fullmatch("angular velocity [0-9]+ rpm", chip) for chip in chips)
    browser.execute_script(
        "window.told = []; const { fillText } = CanvasRenderingContext2D.prototype;"
        "CanvasRenderingContext2D.prototype.fillText = function (...text) { told.push(text[0]); fillText.apply(this, text); };"
        "live.map.update(live.values())"
    )
    wait(browser, "return told.includes('spin [rpm]') || told.some((text) => / \\[rpm\\]/.test(text))")
    assert {"2.86", "28.6"} <= set(browser.execute_script("return told"))


def test_its_curves_have_the_unit_that_was_asked_for(browser, page, rutstam_scene):
    reset(browser)
    run = tippe.simulate(rutstam_scene, tippe.Launch(0.1, 155.0), 7.0, times=[0.0, 4.0])
    label, value = browser.execute_script(
        "player.seek(4); const head = document.querySelector('.strip .head');"
        "return [head.firstChild.textContent, head.querySelector('.value span').textContent]"
    )
    assert label == "inclination θ [deg]"
    assert float(value) == pytest.approx(float(np.degrees(run.theta[1])), rel=2e-3)


def test_a_slider_simulates_anew(browser, page, rutstam_scene):
    reset(browser)
    browser.execute_script(
        "const s = document.querySelector('input[name=spin]'); s.value = 250; s.dispatchEvent(new Event('input'))"
    )
    wait(browser, "return live.outcome.status === 'not_inverted' || live.outcome.value > 6")
    theta, spin = browser.execute_script("return live.values()")
    assert (theta, spin) == pytest.approx((0.1, 95.0))
    time = float(tippe.inversion_time(rutstam_scene, tippe.Launch(theta, spin), 7.0))
    told = "return document.querySelector('#result strong').textContent"
    assert (browser.execute_script(told) == "not within 7 s") == (time > 7.0)
    shown_time = browser.execute_script("return Number.isFinite(live.outcome.value) ? live.outcome.value : 1e300")
    assert shown_time == pytest.approx(min(time, 1e300), rel=CLOSE)
    # The drawn top is that of the new run.
    matrix = browser.execute_script("player.seek(1.0); return player.matrix(0, 0, 0)")
    run = tippe.simulate(rutstam_scene, tippe.Launch(theta, spin), 1.0, times=[1.0])
    np.testing.assert_allclose(np.array(matrix).reshape(4, 4)[3, :3], run.position[0], atol=1e-4)


def test_a_page_says_that_a_top_fell_back(browser, page):
    """A run of which the program that draws it says so."""
    reset(browser)
    texts = "return [document.querySelector('#result .word').textContent, player.stages[0].fact.shows[0].marks[0][1]]"
    assert browser.execute_script(texts)[0] == "inverted"
    for index, after in enumerate(AFTERWARDS):
        word, mark = browser.execute_script(
            f"const {{ outcome }} = live.motion; live.motion.outcome = () => [{index}]; live.simulate(400);"
            f" live.motion.outcome = outcome; {texts}"
        )
        assert word == ", but ".join(filter(None, ("inverted", after)))
        assert re.fullmatch(r"turned over at 5\.\d+ s" + (f", {after}" if after else ""), mark)


def test_a_page_that_was_hidden_keeps_its_many_frames(browser, page):
    """A browser calls back for a frame only once the page is shown, after the simulation with many frames."""
    reset(browser)
    browser.execute_script(
        "const ask = requestAnimationFrame, forget = cancelAnimationFrame; let held = new Map();"
        "window.requestAnimationFrame = (act) => { held.set(held.size + 1, act); return held.size; };"
        "window.cancelAnimationFrame = (number) => held.delete(number);"
        "window.shown = () => { Object.assign(window, { requestAnimationFrame: ask, cancelAnimationFrame: forget });"
        " held.forEach((act) => act()); };"
        "live.set([0.2, 155])"
    )
    wait(browser, "return player.stages[0].fact.shows[0].times.length > 500 && live.values()[0] === 0.2")
    time.sleep(0.3)
    assert browser.execute_script("shown(); return player.stages[0].fact.shows[0].times.length") > 500


def test_the_address_holds_the_sliders(browser, page):
    reset(browser)
    browser.execute_script("live.set([0.25, 120])")
    wait(browser, "return location.hash.includes('0.25')")
    link = browser.current_url
    assert link.endswith("#theta=0.25&spin=120")
    browser.get("about:blank")
    browser.get(link)
    wait(browser, "return !!(window.live && live.ready)")
    assert browser.execute_script("return live.values()") == [0.25, 120]
    browser.execute_script("location.hash = '#theta=0.3'")
    wait(browser, "return live.values()[0] === 0.3")
    assert browser.execute_script("return live.values()[1]") == 155
    # A whole name, the end of a name, and an end that two names have.
    browser.execute_script("live.facts.sliders[1].name = 'whole.name'; location.hash = '#launch.theta=0.2&spin=110'")
    wait(browser, "return live.values()[0] === 0.2 && live.values()[1] === 110")
    browser.execute_script(
        "window.paths = live.facts.sliders.map((one, k) => { const { path } = one; one.path = `${k}.x`; return path; });"
        "location.hash = '#x=0.3&whole.name=120'"
    )
    wait(browser, "return live.values()[1] === 120")
    assert browser.execute_script("return live.values()[0]") == 0.1
    browser.execute_script(
        "live.facts.sliders.forEach((one, k) => { one.path = paths[k]; }); live.facts.sliders[1].name = 'spin'"
    )


def test_the_map_fills_and_a_click_sets_the_sliders(browser, page, rutstam_scene):
    reset(browser)
    wait(browser, "return live.map.results().filter(Boolean).length > 60")
    cell = "const k = 37, cell = live.map.at(live.map.cells[k]); return [cell, live.map.results()[k]]"
    (theta, spin), (status, time) = browser.execute_script(cell)
    table = tippe.inversion_table(rutstam_scene, theta=theta, spin=spin, t1=7.0, tolerance=TOLERANCE, progress=False)
    assert tippe.Status(status).word == table.status
    assert time is None or time == pytest.approx(float(table.time), rel=CLOSE)
    # Cells without a time are hatched, and their status is named.
    wait(browser, "return document.getElementById('legend').textContent.includes('not within 7 s')")
    colours = browser.execute_script(
        """const { cells, results } = live.map, canvas = document.querySelector('#map canvas');
        const { x, y } = cells.find((_, k) => results()[k] && !Number.isFinite(results()[k][1]));
        const { clientWidth, clientHeight } = canvas, [w, h] = [clientWidth - 50, clientHeight - 40];
        const ratio = canvas.width / clientWidth, place = [48 + (x / 40) * w, 2 + h - ((y + 1) / 30) * h, w / 40, h / 30];
        const { data } = canvas.getContext('2d').getImageData(...place.map((length) => ratio * length));
        return new Set(new Uint32Array(data.buffer)).size"""
    )
    assert colours > 1
    browser.execute_script(
        """const canvas = document.querySelector('#map canvas'), frame = canvas.getBoundingClientRect();
        const [clientX, clientY] = [frame.left + 0.8 * frame.width, frame.top + 0.2 * frame.height];
        const at = { bubbles: true, pointerId: 1, clientX, clientY };
        canvas.setPointerCapture = () => {};
        canvas.dispatchEvent(new PointerEvent('pointerdown', at))"""
    )
    theta, spin = browser.execute_script("return live.values()")
    assert 0.35 < theta < 0.5
    assert 150.0 < spin < 200.0


CONTROLS = """
return [...document.querySelectorAll('#explore button, #explore input, #explore select, #map canvas, #controls button')]
  .map((one) => { one.scrollIntoView({ block: 'center' }); const box = one.getBoundingClientRect();
    return one === document.elementFromPoint(box.x + box.width / 2, box.y + box.height / 2); })
"""


def fingers(browser, kind, *points):
    """Send one event of a touch screen, at places [px] of the window."""
    points = [{"x": float(x), "y": float(y)} for x, y in points]
    browser.execute_cdp_cmd("Input.dispatchTouchEvent", {"type": kind, "touchPoints": points})


def test_fingers_move_a_slider_and_the_point_on_the_map(browser, page):
    """By events of a touch screen, which the browser would take for scrolling if the page let it."""
    reset(browser)
    box_of = """const element = document.querySelector(arguments[0]); element.scrollIntoView({ block: 'center' });
        const box = element.getBoundingClientRect(); return [box.x, box.y, box.width, box.height]"""
    browser.execute_cdp_cmd("Emulation.setTouchEmulationEnabled", {"enabled": True})
    try:
        x, y, width, height = browser.execute_script(box_of, "input[name=spin]")
        start = (x + (155.0 - 60.0) / 140.0 * width, y + height / 2.0)
        fingers(browser, "touchStart", start)
        for k in range(1, 6):
            fingers(browser, "touchMove", (start[0] - 0.06 * k * width, start[1]))
        fingers(browser, "touchEnd")
        assert browser.execute_script("return live.values()[1]") == pytest.approx(155.0 - 0.3 * 140.0, abs=5.0)
        x, y, width, height = browser.execute_script(box_of, "#map canvas")
        fingers(browser, "touchStart", (x + 0.5 * width, y + 0.5 * height))
        fingers(browser, "touchMove", (x + 0.7 * width, y + 0.35 * height))
        fingers(browser, "touchMove", (x + 0.8 * width, y + 0.2 * height))
        fingers(browser, "touchEnd")
        theta, spin = browser.execute_script("return live.values()")
        assert 0.35 < theta < 0.5
        assert 150.0 < spin < 200.0
    finally:
        browser.execute_cdp_cmd("Emulation.setTouchEmulationEnabled", {"enabled": False})


def test_a_phone_in_portrait_shows_all_controls(browser, page):
    screen = {"width": 400, "height": 800, "deviceScaleFactor": 1, "mobile": True}
    browser.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", screen)
    try:
        assert browser.execute_script("return document.documentElement.scrollWidth <= innerWidth")
        assert browser.execute_script(
            "const { scrollWidth, clientWidth } = document.querySelector('figcaption'); return scrollWidth <= clientWidth"
        )
        uncovered = browser.execute_script(CONTROLS)
        assert len(uncovered) > 6
        assert all(uncovered)
        # Without scrolling, a viewer sees the picture and moves the sliders; no text needs more than its line.
        low = browser.execute_script(
            "return [...document.querySelectorAll('#knobs input')].map((one) => one.getBoundingClientRect().bottom)"
        )
        assert max(low) < 800
        lines = browser.execute_script("return document.getElementById('clock').getClientRects()[0].height")
        assert lines < 30
    finally:
        browser.execute_cdp_cmd("Emulation.clearDeviceMetricsOverride", {})


def test_sliders_have_names(browser, page):
    """As a screen reader says them: without their values, which it says besides."""
    knobs = browser.find_elements("css selector", "#knobs input")
    assert [knob.accessible_name for knob in knobs][:2] == ["θ(0)", "spin ω₃(0)"]
    assert all(knob.accessible_name for knob in browser.find_elements("css selector", "input, select, button"))
    # The names of the curves take one line beside their values.
    assert browser.execute_script(
        "return [...document.querySelectorAll('.strip .head')].every((one) => one.clientHeight < 30)"
    )


def test_keys_play_and_reset(browser, page):
    from selenium.webdriver.common.keys import Keys

    reset(browser)
    browser.execute_script("player.play(false); player.seek(0.5); live.set([0.4, 100])")
    body = browser.find_element("tag name", "body")
    body.send_keys(" ")
    wait(browser, "return player.time() > 0.51")
    body.send_keys(" ")
    wait(browser, "return !player.playing()")
    body.send_keys("r")
    wait(browser, "return live.values()[0] === 0.1")
    # A menu with the focus takes the letter itself.
    browser.execute_script("live.set([0.4, 100])")
    browser.find_element("id", "across").send_keys("r")
    assert browser.execute_script("return live.values()") == [0.4, 100.0]
    body.send_keys("r")
    slider = browser.find_element("css selector", "input[name=theta]")
    slider.send_keys(Keys.ARROW_RIGHT)
    assert browser.execute_script("return live.values()[0]") == pytest.approx(0.1 + 0.45 / 1000, abs=0.45 / 1000)
    # The arrows move the run on the map by a cell, not the time.
    reset(browser)
    browser.execute_script("player.play(false); player.seek(0.5)")
    browser.find_element("css selector", "#map canvas").send_keys(Keys.ARROW_RIGHT + Keys.ARROW_DOWN)
    assert browser.execute_script("return live.values()") == pytest.approx([0.1 + 0.45 / 40, 155.0 - 140.0 / 30])
    assert browser.execute_script("return player.time()") == 0.5
    # The page marks when the top turned over.
    wait(browser, "return live.outcome.value > 0")
    marks = browser.execute_script("return player.stages[0].fact.shows[0].marks")
    value = browser.execute_script("return live.outcome.value")
    assert [[time, words] for time, words in marks] == [[value, f"turned over at {value:.3g} s"]]


def test_labels_are_text(browser, page):
    """A quantity may be called what HTML would read as a mark."""
    reset(browser)
    texts = browser.execute_script(
        "const { answer, summaries } = live.facts, curve = live.curves[summaries[0]], kept = [answer.label, curve.name];"
        "answer.label = 'time <b>t</b>'; curve.name = '<i>q</i>';"
        "live.simulate(300); live.map.update(live.values(), true);"
        "const texts = ['result', 'legend'].map((id) => document.getElementById(id));"
        "const marks = texts.map((one) => one.querySelectorAll('b').length), words = texts.map((one) => one.textContent);"
        "[answer.label, curve.name] = kept; live.simulate(300); return [marks, words]"
    )
    assert texts[0] == [0, 0]
    assert "time <b>t</b>" in texts[1][0]
    assert "<i>q</i>" in texts[1][0]


def test_numbers_that_do_not_fit_together_are_refused_in_the_page(browser, rutstam_scene):
    page_run = page_of_launch(
        TopModel(scene=rutstam_scene, launch=tippe.Launch(0.1, 155.0)), {"theta": (0.05, 0.5)}, 7.0
    )
    browser.get("about:blank")
    script = f"{programs(page_run)} return [[0.3], [-0.3], [4.0]].map((values) => Boolean(live.allowed(values, [])[0]))"
    assert browser.execute_script(script) == [True, False, False]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"sliders": {"spinn": (1.0, 2.0)}}, "sliders: 'spinn'"),
        ({"sliders": {"theta": (0.5, 0.2)}}, r"sliders\['theta'\] = \(0.5, 0.2\) must be two numbers"),
        ({"sliders": {"theta": (0.2, 0.5)}}, "must contain the parameter's own value, 0.1"),
        ({"sliders": {"theta": (5, 20)}}, r"angles are in radians: did you mean np.radians\(\(5, 20\)\)\?"),
        ({"sliders": {"theta": (0.05, 4.0)}}, "theta"),
        ({"sliders": {"radius": (0.01, 0.03)}}, "drawn"),
        ({"sliders": {}}, "must be a dictionary"),
        ({"t1": 0.0}, "t1"),
    ],
)
def test_what_is_no_slider_is_refused(rutstam_scene, change, message):
    with pytest.raises(ValueError, match=message):
        tippe.explore(rutstam_scene, tippe.Launch(0.1, 155.0), **change)


def test_a_page_without_the_shape_of_a_stem_refuses_its_offset():
    launch = tippe.Launch(0.1, 155.0)
    with pytest.raises(ValueError, match="offset changes the drawn arena or body"):
        tippe.explore(tippe.presets.classroom(), launch, sliders={"body.offset": (0.001, 0.002)})


@pytest.mark.slow
def test_in_the_browser_the_wooden_top_hops_and_climbs_onto_its_stem(browser):
    """As `simulate` has it: through flights, impacts and changes of contact, to the end on its stem."""
    scene, launch = tippe.presets.classroom(), tippe.Launch.degrees(theta=6, rpm=1900)
    page_run, times = (
        page_of_launch(TopModel(scene=scene, launch=launch), None, 4.0),
        np.array([0.0, 0.5, 2.6, 2.78, 2.85, 4.0]),
    )
    run = tippe.simulate(scene, launch, 4.0, tolerance=1e-10)
    browser.get("about:blank")
    (status, time), end, hops, rows = browser.execute_script(
        f"""{programs(page_run)}
        const values = live.facts.sliders.map((slider) => slider.value), asks = integrator(live.answer);
        const moves = integrator(live.motion);
        asks.run(values);
        const outcome = asks.read("outcome", values), run = moves.trajectory(values, "frame");
        return [outcome, run.end, moves.run(values)[live.motion.runs.counts],
          run.read({times.tolist()}).map((row) => [...row])]"""
    )
    assert (tippe.Status(status).word, end) == ("inverted", 4.0)
    assert time == pytest.approx(run.inversion_time, rel=CLOSE)
    assert hops == len(run.hops) >= 3
    samples, rows = run.at(times), np.array(rows)
    np.testing.assert_allclose(rows[:, 3:6], samples.position, atol=CLOSE)
    # The normal force acts where the trace of the contact ends.
    np.testing.assert_array_equal(rows[:, 19:22], rows[:, 10:13])
    theta, energy, _, force = rows[:, -5:-1].T
    np.testing.assert_allclose(theta, samples.theta, atol=5e-6)
    np.testing.assert_allclose(energy, samples.energy, rtol=CLOSE)
    np.testing.assert_allclose(force, samples.normal_force, atol=1e-5 * float(samples.normal_force[0]))


@pytest.mark.parametrize(
    "kind", [pytest.param(kind, marks=() if kind == "hops" else pytest.mark.slow) for kind in IN_MODES]
)
def test_in_the_browser_tops_hop_stick_and_fly_over_arenas_as_runs_do(browser, kind):
    scene, launch, t1 = IN_MODES[kind]
    page_run, times = page_of_launch(TopModel(scene=scene, launch=launch), None, t1), np.linspace(0.0, 0.9 * t1, 7)
    run = tippe.simulate(scene, launch, t1, tolerance=1e-9)
    browser.get("about:blank")
    counts, rows = browser.execute_script(
        f"""{programs(page_run)}
        const values = live.facts.sliders.map((slider) => slider.value), moves = integrator(live.motion);
        const run = moves.trajectory(values, "frame"), at = live.motion.runs.counts;
        return [moves.run(values).slice(at, at + {len(TopModel(scene=scene, launch=launch).counters)}),
          run.read({times.tolist()}).map((row) => [...row])]"""
    )
    samples, rows = run.at(times), np.array(rows)
    np.testing.assert_allclose(rows[:, 3:6], samples.position, atol=CLOSE)
    np.testing.assert_allclose(rows[:, -5], samples.theta, atol=5e-6)
    np.testing.assert_allclose(rows[:, -4], samples.energy, rtol=CLOSE)
    assert counts[-1] == (run.stats["sticks"] if scene.friction.set_valued else len(run.hops)) > 0


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["wooden", "bouncing"])
def test_the_browser_flies_as_the_table_does(browser, kind):
    if kind == "wooden":
        scene, launch, mu, t1 = tippe.presets.classroom(), tippe.Launch(0.1, 199.0), (0.05, 0.8), 2.5
    else:
        scene = tippe.Scene(rutstam_top(), friction=tippe.Viscous(0.3), contact="hybrid", restitution=0.6)
        launch, mu, t1 = tippe.Launch(0.1, 199.0), (0.1, 1.0), 5.0
    ranges = {"theta": (0.03, 0.6), "spin": (100.0, 280.0), "mu": mu}
    rng, counts = np.random.default_rng(3), {"theta": 5, "spin": 5, "mu": 2}
    grid = {name: np.sort(rng.uniform(*ends, counts[name])) for name, ends in ranges.items()}
    table = table_of(scene, launch, grid, t1)
    theta, mu, spin = (values.ravel() for values in np.meshgrid(grid["theta"], grid["mu"], grid["spin"], indexing="ij"))
    runs = json.dumps(np.stack([theta, spin, mu], axis=-1).tolist())
    browser.get("about:blank")
    script = f"""{programs(page_of_launch(TopModel(scene=scene, launch=launch), ranges, t1))}
        const asks = integrator(live.answer), at = live.answer.runs, text = (x) => Number.isFinite(x) ? x : String(x);
        return {runs}.map((values) => {{
          const runs = asks.run(values);
          return [...asks.read("outcome", values), runs[at.end_time], runs[at.counts]].map(text);
        }})"""
    status, time, end, hops = np.array(browser.execute_script(script), dtype=float).T
    assert [tippe.Status(int(code)).word for code in status] == list(np.ravel(table.status))
    # Through hundreds of bounces even round-off grows: where tables depend on the tolerance as much, no digit is certain.
    fine_table = tippe.inversion_table(scene, **grid, t1=t1, tolerance=0.1 * TOLERANCE, progress=False)
    for in_page, *in_tables in ((time, table.time, fine_table.time), (end, table.end_time, fine_table.end_time)):
        finite = np.isfinite(in_page)
        in_page, at_tolerance, with_less = (np.ravel(values)[finite] for values in (in_page, *in_tables))
        is_certain = np.abs(with_less - at_tolerance) < 1e-3 * at_tolerance
        assert np.mean(is_certain) > 0.8
        np.testing.assert_allclose(in_page[is_certain], at_tolerance[is_certain], rtol=CLOSE)
    assert np.max(hops) > 10
    assert len(set(status)) > 1


@pytest.mark.slow
def test_a_run_takes_at_most_thirty_milliseconds(browser, page):
    """The fastest of some: other programs, and the map's workers, share the processor."""
    reset(browser)
    script = """return [...Array(21)].map((_, k) => {
        const begin = performance.now();
        live.asks.run([0.1 + k / 100, 155]);
        return performance.now() - begin;
    })"""
    assert min(browser.execute_script(script)) < 30.0
