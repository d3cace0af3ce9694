"""The page with sliders of a ride, in a real browser: its rides end where those of the tables end."""

import json

import jax.numpy as jnp
import numpy as np
import pytest
from browser import complaints, needs_browser, open_browser, wait

import stroller
from nonholonomic.runs.trajectory import TOLERANCE
from nonholonomic.views.pages import programs
from stroller.runs.model import RideModel
from stroller.runs.view import default_ranges, page_of_ride

pytestmark = needs_browser

CLOSE = 1e-6
RANGES = {"speed": (0.5, 3.0), "launch.steering": (-0.5, 0.5)}


def cruise(t, motion):
    """Keeps 2 m/s, and swings the fork."""
    return 5.0 * (2.0 - motion.speed), 0.2 * jnp.sin(3.0 * t) - motion.steering - 0.3 * motion.steering_rate


GROUNDS = {
    "plane": (stroller.Plane(0.05), (0.0, 0.0), cruise),
    "spheroid": (stroller.Spheroid(5.0, 4.0), (0.0, 0.9), None),
}


def scene_on(ground) -> stroller.Scene:
    body = stroller.Stroller(mass=12.0, wheelbase=0.7, inertia=1.5, steering_inertia=0.05)
    return stroller.Scene(body, ground, stroller.Damping(2.0, 1.0, 0.2, 0.05))


@pytest.fixture(scope="module")
def browser():
    with open_browser("700,500") as driver:
        yield driver


@pytest.mark.parametrize("name", [pytest.param("plane", marks=pytest.mark.slow), "spheroid"])
def test_ten_rides_end_where_those_of_the_table_end(browser, name):
    ground, place, controls = GROUNDS[name]
    scene, launch = scene_on(ground), stroller.Launch(place=place, heading=0.3, speed=2.0)
    rng = np.random.default_rng(len(name))
    axes = {"launch.speed": np.sort(rng.uniform(0.5, 3.0, 5)), "launch.steering": np.sort(rng.uniform(-0.5, 0.5, 2))}
    options = {"input": controls, "tolerance": TOLERANCE, "progress": False}
    table = stroller.sweep(scene, launch, 2.0, axes=axes, **options)
    live_page_run, _ = page_of_ride(RideModel.of(scene, launch, controls), RANGES, 2.0)
    runs = np.stack([part.ravel() for part in np.meshgrid(*axes.values(), indexing="ij")], axis=-1)
    browser.get("about:blank")
    script = f"""{programs(live_page_run)}
        const asks = integrator(live.answer), moves = integrator(live.motion), text = (x) => Number.isFinite(x) ? x : String(x);
        return {json.dumps(runs.tolist())}.map((values) => {{
          asks.run(values);
          const run = moves.trajectory(values, "frame"), [begin, end] = run.read([0, run.end]);
          const row = [...asks.read("outcome", values), run.end, ...begin.slice(3, 6), ...end.slice(3, 6)];
          return [...row, ...end.slice(-5, -1)].map(text);
        }})"""
    rows = np.array(browser.execute_script(script), dtype=float)
    code, distance, end_time = rows[:, :3].T
    assert [stroller.Status(int(number)).word for number in code] == list(np.ravel(table.status))
    np.testing.assert_allclose(end_time, 2.0)
    speed, steering, energy, _ = rows[:, 9:].T
    np.testing.assert_allclose(speed, np.ravel(table.end_speed), atol=CLOSE)
    np.testing.assert_allclose(steering, np.ravel(table.end_steering), atol=CLOSE)
    np.testing.assert_allclose(energy, np.ravel(table.energy), rtol=CLOSE)
    # The drawn axle is a wheel's radius, 0.14 m, above the ground.
    position = np.stack([np.ravel(table[axis]) for axis in "xyz"], axis=-1)
    normal = {"plane": np.array([-np.sin(0.05), 0.0, np.cos(0.05)]), "spheroid": None}[name]
    if normal is None:
        outwards = position / np.array([25.0, 25.0, 16.0])
        normal = outwards / np.linalg.norm(outwards, axis=-1, keepdims=True)
    np.testing.assert_allclose(rows[:, 6:9], position + 0.14 * normal, atol=CLOSE)
    start = np.asarray(stroller.simulate(scene, launch, 0.1, times=[0.0]).position[0]) if name == "plane" else None
    if start is not None:
        np.testing.assert_allclose(distance, np.linalg.norm(position - start, axis=-1), atol=CLOSE)


def test_a_ride_has_the_page_of_its_scene():
    scene, launch = scene_on(stroller.Plane()), stroller.Launch(place=(0.0, 0.0), heading=0.3, speed=2.0)
    ride = stroller.simulate(scene, launch, 2.0)
    assert ride.explore(sliders=RANGES).html == stroller.explore(scene, launch, sliders=RANGES, t1=2.0).html


@pytest.mark.slow
def test_the_page_opens_and_rides_anew(browser, tmp_path):
    launch = stroller.Launch(place=(0.0, 0.0), heading=0.3, speed=2.0)
    path = tmp_path / "ride.html"
    page = stroller.explore(scene_on(stroller.Plane()), launch, path, RANGES, t1=2.0)
    assert len(page.html) < 2.5e6
    browser.get_log("browser")
    browser.get(path.as_uri())
    wait(browser, "return !!(window.live && live.ready)")
    value_before = browser.execute_script("return live.outcome.value")
    # A distance is no time to mark.
    assert browser.execute_script("return player.stages[0].fact.shows[0].marks") == []
    browser.execute_script("live.set([1.0, 0.0])")
    wait(browser, f"return live.outcome.value < {value_before!r}")
    assert complaints(browser) == []


@pytest.mark.parametrize(
    ("sliders", "message"),
    [
        ({"steering": (-0.5, 0.5)}, "could be"),
        ({"wheelbase": (0.5, 0.9)}, "changes the drawn arena or body"),
        ({"speed": (3.0, 4.0)}, "must contain the parameter's own value, 2"),
    ],
)
def test_what_is_no_slider_is_refused(sliders, message):
    launch = stroller.Launch(place=(0.0, 0.0), heading=0.3, speed=2.0)
    with pytest.raises(ValueError, match=message):
        stroller.explore(scene_on(stroller.Plane()), launch, sliders=sliders)


def test_the_default_sliders_stay_within_a_turn():
    """A launch refuses angles beyond 2 pi."""
    launch = stroller.Launch((0.0, 0.0), 6.2, 1.0)
    assert default_ranges(scene_on(stroller.Plane()), launch)["launch.heading"] == (6.2 - np.pi, 2.0 * np.pi)
