"""When the stem first carries a top: closed form, normal forces, an independent program, derivatives."""

import dataclasses
import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from close import assert_close
from hop_reference import CASES, follow
from stems import first_contact

import tippe
from nonholonomic.hybrid import HybridOutcome
from nonholonomic.sweeps import Table
from tippe.runs.model import TopModel
from tippe.runs.observables import AFTERWARDS
from tippe.runs.view import motion, page_of_launch

LAUNCH, T1, TOLERANCE = tippe.Launch.degrees(theta=6, rpm=1500), 5.0, 1e-10

#: The wooden top, which touches with its stem, falls back to its sphere, hops, and stands on its stem from then on.
WOODEN = {"theta": float(LAUNCH.theta), "spin": float(LAUNCH.spin), "t1": T1, "tolerance": TOLERANCE}


def wooden_scene(restitution: float | None = None) -> tippe.Scene:
    top = tippe.presets.wooden()
    return tippe.Scene(top, friction=tippe.Coulomb(0.3, 0.05), contact="hybrid", restitution=restitution)


@pytest.fixture(scope="module")
def run() -> tippe.HybridTrajectory:
    return tippe.simulate(wooden_scene(), LAUNCH, T1, tolerance=TOLERANCE)


@pytest.fixture(scope="module")
def table() -> Table:
    """With and without bounces, the first and the last time."""
    axes = {"restitution": [0.0, 0.5]}
    return tippe.inversion_table(wooden_scene(0.1), **WOODEN, axes=axes, crossing="both", errors=True)


def test_the_angle_is_that_of_the_common_tangent_plane():
    top = tippe.presets.wooden()
    assert_close(top.stem_angle, first_contact(top), rtol=1e-15)
    assert np.isnan(tippe.presets.rutstam().stem_angle)
    # By the shape: the centre of the stem's end is 22 mm above that of the sphere.
    assert_close(math.cos(top.stem_angle), (0.005 - 0.020) / 0.022, rtol=1e-12)


def test_the_stem_carries_the_top_from_its_first_contact(run):
    """The first normal force of the stem, in a fine scan, and the angle at which both touch."""
    assert run.status == "completed"
    assert_close(run.stem_time, 3.01687, atol=1e-5)
    assert run.inversion_time == run.stem_time
    assert "turned over: the stem first carries it at 3.01687 s\n" in str(run)
    falls_back = run.t[(run.t > run.stem_time) & (run.contact == 0)][-1]
    fallen = run.at([0.0, falls_back])
    assert "carries it at 3.01687 s, but fell back\n" in str(fallen)
    assert_close(run.at([run.stem_time]).theta[0], first_contact(run.scene.body), atol=1e-8)
    scan = run.at(np.linspace(run.stem_time - 1e-3, run.stem_time + 1e-3, 2001))
    on_stem = (np.asarray(scan.contact) == 1) & (np.asarray(scan.normal_force) > 0.0)
    assert 0.0 <= scan.t[np.argmax(on_stem)] - run.stem_time <= 1.01e-6
    # Before, the sphere carried the top all the time.
    assert (run.contact[run.t < run.stem_time] == 0).all()


def test_a_page_says_what_a_run_says_of_its_end(run):
    model, fallen = TopModel(scene=run.scene, launch=LAUNCH), run.t[(run.t > run.stem_time) & (run.contact == 0)][-1]
    live, path = page_of_launch(model, None, T1), jnp.zeros((9, 1))
    values = jnp.array([slider.value for slider in live.sliders])
    for time, words in ((0.0, "fell back"), (fallen, "fell back"), (run.t[-1], "")):
        end = run.at([time])
        outcome = HybridOutcome(*[None] * len(HybridOutcome._fields))._replace(
            state=jnp.concatenate([end.states, path]), mode=end.contact.astype(int)
        )
        assert AFTERWARDS[int(live.motion.outcome(values, outcome))] == AFTERWARDS[int(end.afterwards)] == words


def test_the_trace_of_a_stem_that_bounces_is_no_zigzag(run):
    """It jumps from the sphere to the stem and back, but not in the flights between two contacts of the same one."""
    times, drawn = motion(run)
    trace, sphere = drawn.traces[0][0], run.at(times).contact
    far = np.linalg.norm(np.diff(trace, axis=0), axis=-1) > 0.5 * float(run.scene.body.radius)
    touching = sphere[sphere >= 0]
    assert 0 < far.sum() <= np.sum(np.diff(touching) != 0) < np.sum(np.diff(sphere) != 0)


def test_a_run_that_does_not_reach_its_stem_has_no_time(run):
    early = tippe.simulate(wooden_scene(), LAUNCH, 1.0, tolerance=TOLERANCE)
    assert early.stem_time == early.inversion_time == np.inf
    with pytest.raises(ValueError, match=r"no dense output: use tippe\.inversion_time"):
        _ = dataclasses.replace(run, dense=None).stem_time
    # As a run made inside a transformation, which does not know its impacts.
    assert "impacts" in str(run)
    inside = str(dataclasses.replace(run, dense=None, stats={"hops": 3}))
    assert inside.endswith("\n  3 flights")
    assert "impacts" not in inside


def test_a_table_has_the_times_of_its_runs(run, table):
    assert list(table.status) == ["inverted", "inverted"]
    assert_close(table.stem_time, run.stem_time, rtol=1e-8)
    assert (table.stem_time_error < 1e-6).all()
    assert (table.stem_time_error > 0.0).all()
    # The restitution does not matter before the first contact.
    np.testing.assert_array_equal(table.first_time, table.stem_time)
    assert table.label("stem_time") == "time at which the stem first carries the top [s]"
    # For good: afterwards the sphere does not touch.
    fell_back = run.t[run.contact == 0].max()
    assert table.stem_time[0] < fell_back
    assert_close(table.last_time[0], fell_back, rtol=1e-8)
    assert (table.last_time > table.stem_time).all()


def test_a_top_that_comes_to_lie_on_stem_and_sphere_has_not_turned_over_for_good():
    """Slower, it falls over, rocks, and comes to rest on both: its stem carries it first, but its sphere still touches."""
    slow = WOODEN | {"spin": 75.0, "t1": 9.0}
    table = tippe.inversion_table(
        wooden_scene(0.1), **slow, axes={"restitution": [0.0, 0.5]}, crossing="both", errors=True
    )
    assert_close(table.end_theta, first_contact(tippe.presets.wooden()), atol=1e-8)
    assert (table.first_time < 9.0).all()
    assert np.isinf(table.last_time).all()


@pytest.mark.slow
def test_an_angle_is_another_event(run, table):
    """The files of earlier versions contain these times; such a table also has the time of the stem."""
    axes = {"restitution": [0.0, 0.5]}
    by_angle = tippe.inversion_table(wooden_scene(0.1), **WOODEN, axes=axes, angle=0.95 * np.pi)
    assert list(by_angle.status) == ["inverted", "inverted"]
    np.testing.assert_array_equal(by_angle.stem_time, table.stem_time)
    assert_close(by_angle.end_theta, 0.95 * np.pi, atol=1e-7)
    assert_close(by_angle.time[0], 4.5069, atol=1e-3)


def test_a_top_that_starts_on_its_stem_has_turned_over():
    with pytest.warns(
        UserWarning, match=r"the angle at which the stem touches a level plane, 2.321 rad: the top stands on"
    ):
        table = tippe.inversion_table(
            wooden_scene(0.1), **WOODEN | {"theta": 2.4}, axes={"restitution": [0.0, 0.5]}, crossing="both"
        )
    assert list(table.first_time) == list(table.stem_time) == [0.0, 0.0]


def test_what_is_refused():
    arguments = {"theta": 0.1, "spin": 200.0, "t1": 1.0}
    with pytest.raises(
        ValueError, match=r"crossing = 'last' has no derivatives for the contact of a stem: give an angle"
    ):
        tippe.inversion_table(wooden_scene(), **arguments, crossing="last", sensitivities=["mu"])
    with pytest.raises(ValueError, match="crossing = 'last' has no derivatives for the contact of a stem"):
        jax.grad(lambda t: tippe.inversion_time(wooden_scene(), tippe.Launch(t, 200.0), 1.0, crossing="last"))(0.1)


@pytest.mark.slow
def test_slopes_of_the_time():
    """Against central differences, whose steps were scanned: nutation makes the time wavy. By bounces, there are none."""
    arguments = {"theta": float(LAUNCH.theta), "spin": 199.0, "t1": T1, "progress": False}
    axes = {"restitution": [0.0, 0.5]}
    slopes = tippe.inversion_table(
        wooden_scene(0.1), **arguments, axes=axes, tolerance=1e-11, sensitivities=["mu"]
    ).time_by_mu
    step = 3e-7
    mus = [0.3 - step, 0.3 + step]
    times = tippe.inversion_table(wooden_scene(0.1), **arguments, axes=axes, mu=mus, tolerance=1e-12).time
    assert_close(slopes, (times[1] - times[0]) / (2.0 * step), rtol=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize("number", [number for number, case in enumerate(CASES) if case.stem_radius])
def test_an_independent_program_sees_the_same_contact(number):
    from test_hops import scene_of

    case = CASES[number]
    contacts = follow(case)[4]
    expected = next((time for time, ball in contacts if ball >= 1), np.inf)
    table = tippe.inversion_table(scene_of(case), theta=case.theta, spin=[case.spin], t1=case.t1, tolerance=1e-11)
    assert_close(table.stem_time[0], expected, rtol=1e-8)


@pytest.mark.slow
@pytest.mark.parametrize("restitution", [0.0, 0.5])
def test_in_a_cylinder(restitution):
    """There the stem touches at another angle, between those of a leaning along and across the cylinder."""
    top, radius = tippe.presets.wooden(), 0.3
    scene = tippe.Scene(
        top, tippe.Cylinder(radius), tippe.Coulomb(0.3, 0.05), contact="hybrid", restitution=restitution
    )
    run = tippe.simulate(scene, LAUNCH, 4.0, tolerance=TOLERANCE)
    assert_close(tippe.inversion_time(scene, LAUNCH, 4.0, tolerance=TOLERANCE), run.stem_time, rtol=1e-8)
    # Across, the centres of both spheres and the cylinder's axis form a triangle.
    far, near, length = radius - 0.020, radius - 0.005, 0.022
    across = np.pi - math.acos((far**2 + length**2 - near**2) / (2.0 * far * length))
    assert across < run.at([run.stem_time]).theta[0] < first_contact(top)
    last = tippe.inversion_time(scene, LAUNCH, 4.0, tolerance=TOLERANCE, crossing="last")
    assert last > run.t[run.contact == 0].max() - 1e-8
