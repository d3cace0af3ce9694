"""The page of a run, opened in a real browser without a network, draws the bodies at their positions in the run."""

import contextlib
import time

import numpy as np
import pytest
from browser import complaints, needs_browser, open_browser, wait
from own_modes import Pendulum

import stroller
import tippe
from nonholonomic import simulate
from nonholonomic.views import COLOURS
from nonholonomic.views.pages import page, table_as_html
from nonholonomic.views.stage import css, curves_in

pytestmark = needs_browser

#: Poses are sent in single precision.
SINGLE = 2e-6


@pytest.fixture(scope="module")
def top(rutstam_scene):
    return tippe.simulate(rutstam_scene, tippe.Launch(0.3, 150.0), 0.5)


def ride_at(speed: float):
    scene = stroller.Scene(stroller.Stroller(12.0, 0.7, 1.5, 0.05), stroller.Plane(0.05))
    launch = stroller.Launch((0.0, 0.0), 1.2, speed, 0.2)
    return stroller.simulate(scene, launch, 1.0, times=np.linspace(0.0, 1.0, 21))


@pytest.fixture(scope="module")
def ride():
    return ride_at(2.0)


@pytest.fixture(scope="module")
def stages(top, ride):
    """A top in one view, and two rides overlaid in another, in other units."""
    return curves_in([*top.stages(), *ride.stages([ride_at(8.0)], overlaid=True, unit="km/h")], ("deg", "km/h"))


@pytest.fixture(scope="module")
def browser(stages, tmp_path_factory):
    with open_browser() as driver:
        path = tmp_path_factory.mktemp("page") / "runs.html"
        # Small pictures, as a processor has to draw them here.
        page(stages, "Both models", height=100, autoplay=False).save(path)
        driver.get(path.as_uri())
        wait(driver, "return !!window.player")
        yield driver


def set_speed(driver, factor: float) -> None:
    driver.execute_script(
        f"const s = document.getElementById('speed'); s.add(new Option('', '{factor}')); s.value = '{factor}'"
    )


def poses(driver, time_in_page: float, stage: int, bodies: int = 1) -> np.ndarray:
    """The matrices that take the first bodies to their places at a time, as the page's scene has them; it is drawn once."""
    script = f"player.seek({time_in_page!r}); return [...Array({bodies}).keys()].map((body) => player.matrix({stage}, 0, body))"
    return np.array(driver.execute_script(script)).reshape(bodies, 4, 4).swapaxes(1, 2)


def test_nothing_is_missing_without_a_network(browser):
    assert complaints(browser) == []
    assert browser.execute_script("return document.querySelectorAll('.scene canvas').length") >= 2
    assert browser.execute_script("return document.querySelectorAll('.strip').length") == 7


def test_the_top_is_where_the_run_is(browser, top):
    times = np.array([0.0, 0.1234, 0.3, 0.5])
    samples = top.at(times)
    for number, time_in_page in enumerate(times):
        (pose,) = poses(browser, float(time_in_page), 0)
        np.testing.assert_allclose(pose[:3, 3], samples.position[number], atol=SINGLE)
        # Between frames it is turned the short way, so its axis cuts a corner.
        np.testing.assert_allclose(pose[:3, 2], samples.axis[number], atol=2e-3)
        np.testing.assert_allclose(pose[:3, :3] @ pose[:3, :3].T, np.eye(3), atol=SINGLE)


def test_the_top_spins_as_fast_as_the_run(browser, top, stages):
    frames = np.asarray(stages[0].shows[0].times)
    value_before, value_after = frames[200], frames[201]
    turn = poses(browser, float(value_after), 0)[0, :3, :3] @ poses(browser, float(value_before), 0)[0, :3, :3].T
    angle = np.arccos((np.trace(turn) - 1.0) / 2.0)
    rate = np.array([turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]])
    rate *= angle / (2.0 * np.sin(angle) * (value_after - value_before))
    middle = top.at([(value_before + value_after) / 2.0])
    np.testing.assert_allclose(rate @ np.asarray(middle.axis)[0], middle.spin[0], rtol=1e-3)


def test_the_stroller_and_its_wheels_are_where_the_ride_is(browser, ride):
    for number in (0, 10, 20):
        time_in_page = float(ride.t[number])
        frame, left, right, front = poses(browser, time_in_page, 1, 4)
        wheels = [left[:3, 3], right[:3, 3]]
        up = np.cross(frame[:3, 0], frame[:3, 1])
        np.testing.assert_allclose(frame[:3, 0], ride.direction[number], atol=SINGLE)
        np.testing.assert_allclose(frame[:3, 3], ride.position[number] + 0.14 * up, atol=SINGLE)
        np.testing.assert_allclose(sum(wheels) / 2.0, frame[:3, 3], atol=SINGLE)
        np.testing.assert_allclose(front[:3, 3] - frame[:3, 3], 0.7 * np.asarray(ride.direction[number]), atol=SINGLE)
        # The front wheel's axis has turned by the steering angle.
        roll = np.arctan2(-front[:3, 1] @ frame[:3, 0], front[:3, 1] @ frame[:3, 1])
        np.testing.assert_allclose(roll, ride.steering[number], atol=SINGLE)


def test_the_camera_keeps_all_runs_of_a_place_in_sight(browser):
    """They are 6 m apart in the end, and a vehicle is 0.7 m long."""
    for time_in_page in (0.0, 0.5, 1.0):
        browser.execute_script(f"player.seek({time_in_page!r})")
        camera, target, angle = browser.execute_script(
            "const { camera, controls } = player.stages[1];"
            "return [camera.position.toArray(), controls.target.toArray(), camera.fov]"
        )
        camera, target = np.array([camera, target])
        view_direction = (target - camera) / np.linalg.norm(target - camera)
        for run in (0, 1):
            matrix = browser.execute_script(f"return player.matrix(1, {run}, 0)")
            view_offset = np.array(matrix).reshape(4, 4)[3, :3] - camera
            assert view_offset @ view_direction / np.linalg.norm(view_offset) > np.cos(np.radians(angle / 2.0))


def test_a_narrow_picture_keeps_bodies_that_part_in_sight(browser):
    """On a phone, in whatever direction they part; where they are drawn, the picture reaches from -1 to 1."""
    places = browser.execute_script(
        "const stage = player.stages[1], { box, camera, THREE } = stage;"
        "box.style.width = '100px'; stage.fit(); player.seek(0);"
        "const places = [[40, 0], [0, 40], [28, 28], [28, -28]].map(([x, y]) => {"
        " const points = [[0, 0, 0], [x, y, 0]]; stage.look(points, true); stage.render(); camera.updateMatrixWorld();"
        " return points.map((point) => new THREE.Vector3(...point).project(camera)).map((at) => [at.x, at.y]); });"
        "box.style.width = ''; stage.fit(); player.seek(0); stage.reset(); stage.render(); return places"
    )
    assert np.max(np.abs(places)) < 0.97


CENTRES = """
return [...document.querySelectorAll('#controls button, #controls input, #controls select, .buttons button, .chip')]
  .map((one) => { one.scrollIntoView({ block: 'center' }); const box = one.getBoundingClientRect();
    const seen = document.elementFromPoint(box.x + box.width / 2, box.y + box.height / 2);
    return one === seen || one.contains(seen) || seen?.tagName || 'nothing'; })
"""


def test_controls_lie_under_nothing_and_nothing_overflows(browser, stages):
    """At 500 px, in the page itself and in the frame that a notebook and the gallery put it in."""
    for is_inside in (False, True):
        if is_inside:
            frame = page(stages, "Both models", height=100, autoplay=False)._repr_html_()
            browser.execute_script(
                "const box = document.createElement('div'); box.id = 'box'; box.innerHTML = arguments[0];"
                "document.body.prepend(box); scrollTo(0, 0)",
                frame.replace('loading="lazy"', ""),
            )
            browser.switch_to.frame(browser.find_element("css selector", "#box iframe"))
            wait(browser, "return !!window.player")
        centres = browser.execute_script(CENTRES)
        assert len(centres) > 15
        assert set(centres) == {True}
        assert browser.execute_script("return document.documentElement.scrollWidth <= innerWidth")
    browser.switch_to.default_content()
    browser.execute_script("document.getElementById('box').remove(); scrollTo(0, 0)")


def test_the_camera_never_goes_under_the_floor(browser):
    """Wherever it is put, it is drawn from over the tangent plane at the body, less the body's size."""
    bottom, size = browser.execute_script(
        "const s = player.stages[0], [x, y, z] = s.focus; s.camera.position.set(x, y - 0.05, z - 1); s.render();"
        "const away = s.camera.position.clone().sub(s.controls.target), n = s.runs[0].normal;"
        "const over = away.x * n[0] + away.y * n[1] + away.z * n[2]; s.reset(); s.render(); return [over, s.size]"
    )
    assert bottom > -size


def test_arrows_are_labelled_in_their_units_and_switched_off(browser, top):
    browser.execute_script("player.seek(0.3)")
    chip = browser.find_elements("css selector", "figure:first-child .chip")[2]
    assert chip.text == f"normal force {float(top.at([0.3]).normal_force[0]):.3g} N"
    label = (
        "return [...document.querySelectorAll('figure:first-child .force')]"
        ".filter((one) => one.style.display !== 'none').length"
    )
    frame_number = browser.execute_script(label)
    browser.execute_script("arguments[0].click()", chip)
    assert browser.execute_script(label) == frame_number - 1
    browser.execute_script("arguments[0].click()", chip)


def test_curves_and_arrows_tell_the_same_between_frames(browser, stages):
    """Both are on the straight line between frames; the nearer frame would be 0.4 % off, where the force swings fast."""
    show = stages[0].shows[0]
    force = next(curve.values for curve in show.curves if curve.name == "normal force")
    swing = int(np.argmax(np.abs(np.diff(force))))
    time_in_page = float(0.51 * show.times[swing] + 0.49 * show.times[swing + 1])
    expected = 0.51 * force[swing] + 0.49 * force[swing + 1]
    assert abs(expected - force[swing]) > 3e-3 * expected
    arrow, curve = browser.execute_script(
        f"player.seek({time_in_page!r});"
        "const strip = [...document.querySelectorAll('.strip')].find((one) => one.textContent.includes('normal force'));"
        "return [player.stages[0].runs[0].arrows[0].size, Number(strip.querySelector('.value span').textContent)]"
    )
    assert arrow == pytest.approx(expected, rel=1e-4)
    # The page rounds to four digits.
    assert curve == pytest.approx(expected, rel=5e-4)


def test_the_curves_of_several_runs_are_named_in_their_colours(browser, stages):
    names = "return [...document.querySelectorAll('.names span')].map((one) => [one.textContent, one.style.color])"
    shows = [show for stage in stages for show in stage.shows]
    colours = [f"rgb({show.colour >> 16}, {show.colour >> 8 & 255}, {show.colour & 255})" for show in shows]
    assert browser.execute_script(names) == [[show.name, colour] for show, colour in zip(shows, colours, strict=True)]
    # So are the numbers of the arrows.
    chips = (
        "[...document.querySelectorAll('figure:last-child .chip')].map((one) => [...one.querySelectorAll('span span')])"
    )
    numbers = browser.execute_script(
        f"player.seek(0.3); return {chips}.map((all) => all.map((one) => one.style.color))"
    )
    assert [numbers[-1], numbers[0]] == [colours[1:], []]


def test_chips_can_be_read_and_touched(browser):
    """Pressed or not, the colours of runs and names have a contrast of 4.5 to 1 on them; they and menus are 24 pixels high."""
    chips = (
        "const hide = document.querySelectorAll('figure:last-child .chip'); hide[0].click();"
        "const told = [...hide].map((one) => { const { color, backgroundColor, opacity } = getComputedStyle(one);"
        " return [color, backgroundColor, opacity, one.getAttribute('aria-pressed')]; }); hide[0].click();"
        "return [told, [...document.querySelectorAll('#view button, #view select')].map((one) => one.offsetHeight)]"
    )
    told, heights = browser.execute_script(chips)
    assert {pressed for *_, pressed in told} == {"true", "false"}
    for colour, background, opacity, _ in told:
        assert opacity == "1"
        texts = [colour, *(f"{c >> 16}, {c >> 8 & 255}, {c & 255}" for c in COLOURS)]
        assert min(contrast(text, background) for text in texts) > 4.5
    assert min(heights) >= 24


def test_pictures_have_names_for_screen_readers(browser, stages):
    names = browser.execute_script(
        "return ['.scene > canvas', '.strip canvas'].map((kind) => [...document.querySelectorAll(kind)]"
        ".map((one) => [one.getAttribute('role'), one.getAttribute('aria-label')]))"
    )
    assert {role for kind in names for role, _ in kind} == {"img"}
    scenes, curves = ([label for _, label in kind] for kind in names)
    assert [stage.title in label for stage, label in zip(stages, scenes, strict=True)] == [True, True]
    assert curves[0].startswith("curve of inclination θ [deg] over time")
    assert len(set(curves)) == 7


def test_keys_move_time_and_a_click_on_a_curve_seeks(browser):
    from selenium.webdriver import ActionChains, Keys

    set_speed(browser, 0.5)
    browser.execute_script("document.activeElement.blur(); player.seek(0.2)")
    ActionChains(browser).send_keys(Keys.ARROW_RIGHT).perform()
    assert browser.execute_script("return player.time()") == pytest.approx(0.22)
    ActionChains(browser).send_keys(Keys.END).perform()
    assert browser.execute_script("return player.time()") == 1.0
    canvas = browser.find_element("css selector", ".strip canvas")
    browser.execute_script("arguments[0].scrollIntoView({ block: 'center' })", canvas)
    ActionChains(browser).move_to_element(canvas).click().perform()
    # The middle of the canvas, whose axis begins at 66 and ends 4 pixels before its edge.
    width = canvas.size["width"]
    assert browser.execute_script("return player.time()") == pytest.approx((width / 2 - 66) / (width - 70), abs=0.01)


@pytest.mark.parametrize(
    ("unit", "values", "ends", "ticks"),
    [
        # A body at the ground is at 0 m, and not at -1.15e-10 m.
        ("m", [1.0, -1.15e-10, 0.5], (0.0, 1.0), ["0", "0.5", "1.0"]),
        ("deg", [0.271, 172.0], (0.0, 180.0), ["0", "45", "90", "135", "180"]),
        ("N", [0.113, 0.208], (0.1, 0.208), ["0.10", "0.15", "0.20"]),
        ("J", [-7.0e-6, 1.1e-6], (-7.0e-6, 1.1e-6), ["-5e-6", "0"]),
    ],
)
def test_the_numbers_at_a_curve_are_round(browser, unit, values, ends, ticks):
    script = (
        f"const curve = {{ name: 'a', unit: '{unit}', factor: 1, values: {values} }};"
        "const run = { times: [0, 1, 2], colour: 'red', curves: [curve], marks: [] };"
        "const { low, high, ticks } = new views.Strips(document.createElement('div'), () => [run], () => 0).strips[0];"
        "return [[low, high], ticks.map(([, text]) => text)]"
    )
    (low_and_high, texts) = browser.execute_script(script)
    assert low_and_high == pytest.approx(ends)
    assert texts == ticks


def test_every_curve_has_an_axis_of_time(browser):
    """Round numbers and their unit, below the plot and inside the canvas; more of them where there is room."""
    told = browser.execute_script(
        "const told = []; const { fillText } = CanvasRenderingContext2D.prototype;"
        "CanvasRenderingContext2D.prototype.fillText = function (text, x, y) {"
        " told.push([this.canvas, text, y]); fillText.call(this, text, x, y); };"
        "player.seek(0.3); CanvasRenderingContext2D.prototype.fillText = fillText;"
        "return [...document.querySelectorAll('.strip canvas')].filter((one) => one.checkVisibility()).map((canvas) =>"
        " told.filter(([owner]) => owner === canvas).map(([, text, y]) => [text, canvas.height - y]))"
    )
    for texts in told:
        heights = [height for text, height in texts if text == "time [s]"]
        assert len(heights) == 1
        assert 5.0 < heights[0] < 15.0
        assert [text for text, height in texts if height == heights[0]][1:] == ["0", "0.2", "0.4", "0.6", "0.8", "1.0"]
    numbers = "return [130, 400].map((width) => views.Strips.prototype.times.call({ duration: 8.1 }, width).map(([at]) => at))"
    assert browser.execute_script(numbers) == [[0, 5], [0, 2, 4, 6, 8]]


def test_runs_of_one_colour_have_other_dashes(browser):
    """In the legend and in the curves: a flat curve is all of its colour, or has gaps."""
    dashes, counts = browser.execute_script(
        "const runs = ['red', 'blue', 'red', 'red'].map((colour, k) => ({ times: [0, 1], name: `run ${k}`, colour, marks: [],"
        " curves: [{ name: 'a', unit: 'm', factor: 1, values: [k, k] }] }));"
        "runs.forEach((run, k) => { run.dashes = views.dashesOf(runs, k); });"
        "const box = document.createElement('div'); document.body.append(box);"
        "const strips = new views.Strips(box, () => runs, () => 0), [strip] = strips.strips; strips.draw(0);"
        "const { passed, x0, x1 } = strip;"
        "const count = (canvas, y, x, width) => canvas.getContext('2d').getImageData(x, y, width, 1).data"
        ".filter((_, k) => k % 4 === 3).reduce((sum, alpha) => sum + (alpha > 128), 0) / width;"
        "const legend = [...box.querySelectorAll('.sample')].map((one) => count(one, 2, 0, one.width));"
        "const curves = runs.map((_, k) => count(passed, Math.floor(strip.y(k)), Math.ceil(x0), Math.floor(x1 - x0)));"
        "box.remove(); return [runs.map((run) => run.dashes), [legend, curves]]"
    )
    assert dashes[:2] == [[], []]
    assert len({tuple(one) for one in dashes[1:]}) == 3
    for parts in counts:
        assert parts[:2] == [1.0, 1.0]
        assert all(0.3 < part < 0.8 for part in parts[2:])


def test_tables_fit_on_a_phone(browser):
    rows = [["theta(0)", *(f"mu = {0.1 * k:.1f}" for k in range(1, 6))], ["18 deg", *["not in time"] * 5]]
    widths = browser.execute_script(
        "const box = document.createElement('div'); box.style.width = '374px'; box.innerHTML = arguments[0];"
        "document.body.append(box); const { scrollWidth, clientWidth } = box.firstChild; box.remove();"
        "return [scrollWidth, clientWidth]",
        table_as_html(rows, 1),
    )
    assert widths[0] <= widths[1]


def test_a_run_is_replaced_while_the_page_is_open(browser, top):
    """As a live simulation does it: other times, poses and curves in the same stage."""
    value_before = browser.execute_script("return player.duration()")
    browser.execute_script(
        "const run = player.stages[0].fact.shows[0];"
        "window.kept = { times: run.times, bodies: run.bodies.map((one) => ({ ...one })) };"
        "player.setRun(0, 0, { times: new Float64Array([0, 2]), bodies: [{ position: new Float32Array([0, 0, 0, 1, 2, 3]),"
        "turning: new Float32Array([0, 0, 0, 1, 0, 0, 0, 1]) }] })"
    )
    assert browser.execute_script("return player.duration()") == 2.0
    (pose,) = poses(browser, 1.0, 0)
    np.testing.assert_allclose(pose[:3, 3], [0.5, 1.0, 1.5], atol=SINGLE)
    browser.execute_script("player.setRun(0, 0, window.kept)")
    assert browser.execute_script("return player.duration()") == value_before


def test_the_slider_sets_the_time(browser):
    browser.execute_script(
        "const s = document.getElementById('slider'); s.value = 0.4; s.dispatchEvent(new Event('input'));"
    )
    assert browser.execute_script("return player.time()") == pytest.approx(0.4)
    assert browser.find_element("id", "clock").text.startswith("0.400 s")


def test_play_runs_to_the_end_and_pause_stops(browser):
    # So slow that a busy machine does not reach the end in the minute that it is given.
    set_speed(browser, 0.01)
    browser.execute_script("player.seek(0.2); document.getElementById('play').click()")
    wait(browser, "return player.time() > 0.21")
    browser.execute_script("document.getElementById('play').click()")
    stop_time = browser.execute_script("return player.time()")
    assert stop_time < 1.0
    time.sleep(0.3)
    assert browser.execute_script("return [player.time(), player.playing()]") == [stop_time, False]
    set_speed(browser, 1)
    browser.execute_script("player.seek(0.95); player.play(true)")
    wait(browser, "return !player.playing()")
    assert browser.execute_script("return player.time()") == 1.0


@contextlib.contextmanager
def opened(driver, html, path, width=500):
    """A page in a window of its own, of a width in pixels."""
    first = driver.current_window_handle
    html.save(path)
    driver.switch_to.new_window("tab")
    screen = {"width": width, "height": 500, "deviceScaleFactor": 1, "mobile": False}
    driver.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", screen)
    try:
        yield driver
    finally:
        driver.close()
        driver.switch_to.window(first)


def luminance(colour: str) -> float:
    """The relative luminance of a colour, as WCAG 2 defines it."""
    parts = [int(part) / 255.0 for part in colour.removeprefix("rgb(").removesuffix(")").split(",")]
    linear = [part / 12.92 if part <= 0.03928 else ((part + 0.055) / 1.055) ** 2.4 for part in parts]
    return float(np.dot(linear, (0.2126, 0.7152, 0.0722)))


def contrast(first: str, second: str) -> float:
    low, high = sorted((luminance(first), luminance(second)))
    return (high + 0.05) / (low + 0.05)


def test_stages_with_equal_rides_are_told_apart(browser, stages, tmp_path):
    """In the legend of the curves, by their titles; and three stages leave no gap in two columns."""
    two = stages[1]._replace(shows=tuple(s._replace(name=f"ride {k}") for k, s in enumerate(stages[1].shows)))
    parts = [stages[0], two._replace(title="plane"), two._replace(title="slope")]
    html = page(parts, "Three stages", height=100, autoplay=False)
    with opened(browser, html, tmp_path / "three.html", 1000):
        browser.get((tmp_path / "three.html").as_uri())
        wait(browser, "return !!window.player")
        names = browser.execute_script(
            "return [...document.querySelectorAll('.names span')].map((one) => one.textContent)"
        )
        assert names == [stages[0].shows[0].name, "plane, ride 0", "plane, ride 1", "slope, ride 0", "slope, ride 1"]
        edges = browser.execute_script(
            "return [...document.querySelectorAll('.scene, #stages')]"
            ".map((one) => Math.round(one.getBoundingClientRect().right))"
        )
        assert edges[3] == edges[0]
        assert edges[1] < edges[2] == edges[0]
        # Forces and names are written where they hide no other one, dark enough to be read on white and on the ground.
        labels = browser.execute_script(
            "player.seek(0.02); return [...document.querySelectorAll('figure:last-child .labels span')]"
            ".filter((one) => one.style.display !== 'none').map((one) => {"
            "const { x, y, width, height } = one.getBoundingClientRect(), style = getComputedStyle(one);"
            "return [x, y, x + width, y + height, style.color, style.backgroundColor, one.className]; })"
        )
        assert len(labels) > 3
        for k, (x0, y0, x1, y1, *_) in enumerate(labels):
            for a0, b0, a1, b1, *_ in labels[:k]:
                assert x1 <= a0 or a1 <= x0 or y1 <= b0 + 1 or b1 <= y0 + 1
        for *_, colour, background, kind in labels:
            assert contrast(colour, background if kind == "name" else "rgb(217, 221, 226)") > 4.5


def test_curves_and_their_numbers_can_be_read():
    assert all(contrast(f"{c >> 16}, {c >> 8 & 255}, {c & 255}", "255, 255, 255") > 4.5 for c in COLOURS)
    assert len({css(colour) for colour in COLOURS}) == 6


#: A browser without WebGL.
FLAT = """
const get = HTMLCanvasElement.prototype.getContext;
HTMLCanvasElement.prototype.getContext = function (kind, ...rest) {
  return /webgl/.test(kind) ? null : get.call(this, kind, ...rest);
};
"""


def test_a_browser_without_webgl_says_so_and_shows_the_curves(browser, stages, tmp_path):
    with opened(browser, page(stages, "No picture", autoplay=False), tmp_path / "flat.html"):
        script = browser.execute_cdp_cmd("Page.addScriptToEvaluateOnNewDocument", {"source": FLAT})
        browser.get((tmp_path / "flat.html").as_uri())
        browser.execute_cdp_cmd("Page.removeScriptToEvaluateOnNewDocument", script)
        wait(browser, "return !!window.player")
        assert browser.execute_script(
            "player.seek(0.25); return [...document.querySelectorAll('.scene')]"
            ".every((one) => /needs WebGL.*[^.]\\)\\. Open/.test(one.textContent))"
        )
        values = browser.execute_script(
            "return [...document.querySelectorAll('.strip .value')].map((one) => one.textContent)"
        )
        assert len(values) == 7
        assert all(values)
        browser.get_log("browser")


def test_the_first_curve_is_large_and_checks_are_folded_away(browser):
    strips = browser.execute_script(
        "return [...document.querySelectorAll('.strip')].map((one) => [one.querySelector('.head span').textContent,"
        "parseFloat(getComputedStyle(one).fontSize), one.checkVisibility()])"
    )
    assert strips[0] == ["inclination θ [deg]", 18, True]
    assert {size for _, size, _ in strips[1:]} == {14}
    hidden = sorted(label.partition(" [")[0] for label, _, is_shown in strips if not is_shown)
    assert hidden == ["Jellett's quantity", "energy"]
    browser.execute_script("document.querySelector('summary').click()")
    wait(browser, "return [...document.querySelectorAll('.strip')].every((one) => one.checkVisibility())")
    browser.execute_script("document.querySelector('summary').click()")


def test_marks_of_a_run_are_drawn_in_its_curves(browser, top):
    """In its colour, in the column of their time."""
    browser.execute_script("player.seek(0); player.setRun(0, 0, { marks: [[0.25, 'turned over at 0.25 s']] })")
    count = """
const pen = document.querySelector('.strip canvas').getContext('2d'), { width, height } = pen.canvas;
const ratio = devicePixelRatio || 1, left = 66 * ratio, x = Math.round(left + 0.25 * (width - 4 * ratio - left));
const data = pen.getImageData(x - 1, 0, 3, height).data;
let red = 0;
for (let k = 0; k < data.length; k += 4) red += data[k] > 150 && data[k + 1] < 150 && data[k + 3] > 100;
return red;
"""
    marked = browser.execute_script(count)
    # The words stand below the curve, where they cover nothing.
    told = browser.execute_script(
        "const told = document.querySelector('.told'), above = told.previousSibling;"
        "return [told.textContent, told.getBoundingClientRect().top >= above.getBoundingClientRect().bottom]"
    )
    assert told == ["turned over at 0.25 s", True]
    browser.execute_script("player.setRun(0, 0, { marks: [] })")
    assert marked > browser.execute_script(count) + 20


def test_in_the_dark_the_page_is_dark_and_its_texts_are_read(browser):
    features = [{"name": "prefers-color-scheme", "value": "dark"}]
    browser.execute_cdp_cmd("Emulation.setEmulatedMedia", {"features": features})
    filters = browser.execute_script(
        "return ['html', '.scene', '.strip'].map((one) => getComputedStyle(document.querySelector(one)).filter)"
    )
    browser.execute_cdp_cmd("Emulation.setEmulatedMedia", {"features": []})
    assert filters == ["invert(0.9) hue-rotate(180deg)", "invert(1) hue-rotate(180deg)", "none"]


def test_the_plane_of_an_own_system_fills_the_picture(browser, tmp_path):
    """With all labels in the picture, none over another, also in a narrow one."""
    run = simulate(Pendulum(), ([1.0], [0.0]), 1.0)
    for width in (400, 1000):
        with opened(browser, page(run.stages(), "Own", height=300, autoplay=False), tmp_path / "own.html", width):
            browser.get((tmp_path / "own.html").as_uri())
            wait(browser, "return !!window.player")
            corners, labels = browser.execute_script(
                "const [{ camera, fact, THREE, labels, box }] = player.stages, inside = box.getBoundingClientRect();"
                "const { x, y, width, height } = inside, { vertices } = fact.arena.mesh;"
                "const corners = [0, 3, 6, 9].map((k) => new THREE.Vector3().fromArray(vertices, k).project(camera));"
                "return [corners.map((at) => [at.x, at.y]), [...labels.children].map((one) => one.getBoundingClientRect())"
                ".map((one) => [one.left - x, one.right - x, one.top - y, one.bottom - y])"
                ".map(([a, b, c, d]) => [a / width, b / width, c / height, d / height])]"
            )
            spans = np.ptp(np.array(corners), axis=0)
            assert np.max(np.abs(corners)) < 0.9
            assert spans[0] > 1.2 or spans[1] > 1.3
            assert len(labels) > 6
            assert np.min(labels) > 0.0
            assert np.max(labels) < 1.0
            for k, (left, right, top, bottom) in enumerate(labels):
                for a, b, c, d in labels[:k]:
                    # The boxes of texts are larger than their letters.
                    assert min(right - a, b - left) < 0.02 or min(bottom - c, d - top) < 0.02


def test_traces_of_several_runs_have_their_colours(browser, stages):
    colours = browser.execute_script(
        "return player.stages[1].runs.map(({ traces }) => `#${traces[0].line.material.color.getHexString()}`)"
    )
    assert colours == [css(show.colour) for show in stages[1].shows]
    assert stages[1].shows[0].traces[0].colour != stages[1].shows[0].colour


def test_a_page_asks_for_nothing_from_elsewhere(browser, stages, tmp_path):
    """Whatever a title or a label contains."""
    assert "default-src 'none'" in browser.execute_script("return document.querySelector('meta[http-equiv]').content")
    assert (
        browser.execute_async_script(
            "const done = arguments[0]; fetch('https://example.org').then(() => done('loaded'), (error) => done(error.name))"
        )
        == "TypeError"
    )
    assert any("Content Security Policy" in entry["message"] for entry in browser.get_log("browser"))


def test_a_title_may_contain_the_marks_of_the_page():
    html = page([], "Runs of Box[VIEW] and [BELOW]", below="<p>text</p>").html
    assert html.count("Runs of Box[VIEW] and [BELOW]") == 2
    assert html.count("<p>text</p>") == 1
