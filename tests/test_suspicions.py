"""What is legal and likely a mistake: the warnings, and what they say."""

import dataclasses
import functools
import importlib
import re
import subprocess
import sys
import threading
import warnings

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from never_run import LAUNCH, PRAM, RIDE, TOP, run_of_nothing
from tops import rutstam_top

import stroller
import tippe
from nonholonomic.runs.model import settings_for_lanes
from stroller.planning.problem import checked_problem

pytestmark = pytest.mark.oldest

SUSPECTED = {
    "rpm": (lambda: tippe.Launch(0.1, 1500.0), "was it in rpm? 1500 rpm are 157.1 rad/s"),
    "rpm of some": (
        lambda: tippe.Launch(0.1, [150.0, -1200.0]),
        "spin = 1200 rad/s is large: was it in rpm? 1200 rpm are 125.7 rad/s",
    ),
    "a speed in km/h": (
        lambda: stroller.Launch((0.0, 0.0), 0.0, [1.0, -90.0]),
        "speed = 90 m/s is large: was it in km/h? 90 km/h are 25 m/s",
    ),
    "a steering angle in degrees": (
        lambda: stroller.Launch((0.0, 0.0), 0.0, 1.0, steering=[0.1, -5.0]),
        "steering = 5 rad is large; angles are in radians: did you mean np.radians(5)?",
    ),
    "a limit of the steering in degrees": (
        lambda: stroller.Limits(steering=4.5),
        "steering = 4.5 rad is large; angles are in radians: did you mean np.radians(4.5)?",
    ),
    "a wheelbase in mm": (
        lambda: stroller.Stroller(mass=12.0, wheelbase=700.0, inertia=1e7, steering_inertia=0.05),
        "wheelbase = 700 m is large: was it in mm or cm? 700 mm are 0.7 m, 700 cm are 7 m",
    ),
    "gravity in cm/s^2": (
        lambda: tippe.Scene(rutstam_top(), friction=tippe.Viscous(0.3), gravity=981.0),
        "gravity = 981 m/s² is large: was it in cm/s²? 981 cm/s² are 9.81 m/s²",
    ),
    "gravity of a stroller in cm/s^2": (
        lambda: stroller.Scene(stroller.Stroller(12.0, 0.7, 1.5, 0.05), gravity=981.0),
        "gravity = 981 m/s² is large: was it in cm/s²? 981 cm/s² are 9.81 m/s²",
    ),
    "a mass in g": (
        lambda: tippe.Top.turned(0.021, mass=20.0, cut=0.0155, stem_radius=0.005, stem_length=0.013),
        "mass = 20 kg is unusual for a top: was it in g? Then mass=0.02, I1=",
    ),
    "friction in per cent": (
        lambda: tippe.Coulomb(27.0, 0.05),
        "mu = 27 is large: was it in %? 27 % are 0.27",
    ),
    "exact friction in per cent": (lambda: tippe.SetValuedCoulomb(27.0), "mu = 27 is large"),
    "wheelbases in mm": (lambda: stroller.Stroller(12.0, [700.0, 800.0], 1.5, 0.05), "was it in mm or cm? 800 mm are"),
    "a slip speed in mm/s": (
        lambda: tippe.Contensou(0.3, 1e-3, 50.0),
        "slip_speed = 50 m/s is large: was it in mm/s? 50 mm/s are 0.05 m/s",
    ),
    "two times in ms": (
        lambda: tippe.Recording(LAUNCH, [100.0, 200.0], [0.1, 0.2], 0.01),
        "samples are 100 s apart; times are in seconds: did you mean 1e-3 * times?",
    ),
    "a density in g/cm^3": (
        lambda: tippe.Top.turned(0.02, 0.7, cut=0.015, stem_radius=0.005, stem_length=0.012),
        "density = 0.7 kg/m^3 is less than that of balsa wood, 100 kg/m^3: was it in g/cm^3? 0.7 g/cm^3 are 700 kg/m^3"
        "; if it is the mass, pass mass=0.7",
    ),
    "a cylinder in mm": (
        lambda: tippe.Scene(rutstam_top(), tippe.Cylinder(300.0)),
        "surface.radius = 300 m is larger than a room: was it in mm?",
    ),
    "a torus in cm": (
        lambda: tippe.Scene(rutstam_top(), tippe.Torus(50.0, 20.0)),
        "surface.ring = 50 m is larger than a room: was it in cm?",
    ),
    "no friction": (
        lambda: tippe.inversion_time(tippe.Scene(rutstam_top()), LAUNCH, 1.0),
        "friction = Frictionless(): without friction no top turns over",
    ),
    "no friction in a table": (
        lambda: tippe.inversion_table(tippe.Scene(rutstam_top()), theta=[0.1], spin=155.0, t1=1.0),
        "friction = Frictionless(): without friction no top turns over",
    ),
    "whole degrees": (
        lambda: tippe.Launch(3, 155.0),
        "theta = 3 rad is large; angles are in radians: did you mean np.rad",
    ),
    "whole degrees of several": (lambda: tippe.Launch([2.0, 3.0], 155.0), "did you mean np.radians(3)?"),
    "a tilt in degrees": (lambda: tippe.Plane(1.5), "tilt = 1.5 rad is large; angles are in radians: did you mean"),
    "two degrees": (lambda: tippe.Launch(2.0, 155.0), "theta = 2 rad is large; angles are in radians: did you mean"),
    "degrees of the azimuth": (
        lambda: tippe.Launch(0.1, 155.0, azimuth=90.0),
        "azimuth = 90 rad is large; angles are in",
    ),
    "radians for degrees": (
        lambda: tippe.Launch.degrees(0.1, 1500.0),
        "theta = 0.1 deg is closer to upright than a hand can launch a top: was it in radians? 0.1 rad are 5.73 deg",
    ),
    "a velocity in cm/s": (
        lambda: tippe.Launch(0.1, 155.0, velocity=(0.0, -30.0)),
        "velocity = 30 m/s is large: was it in cm/s or mm/s? 30 cm/s are 0.3 m/s, 30 mm/s are 0.03 m/s",
    ),
    "a slip speed before mu": (
        lambda: tippe.Coulomb(0.05, 0.3),
        "slip_speed = 0.3 m/s > mu = 0.05: were they exchanged? usual slip speeds are 0.01 to 0.1 m/s",
    ),
    "a slip speed before the radius of contact": (
        lambda: tippe.Contensou(0.3, 0.05, 1e-3),
        "contact_radius = 0.05 m is large: was it in mm?",
    ),
    "a density for a mass": (
        lambda: tippe.Top.turned(0.02, mass=700.0, cut=0.015, stem_radius=0.005, stem_length=0.012),
        "mass = 700 kg is unusual for a top: was it a density? Top.turned takes density",
    ),
    "a horizon in ms": (
        lambda: tippe.inversion_time(TOP, LAUNCH, 8000.0),
        "t1 = 8000 s is long for a top; times are in seconds: did you mean t1=8?",
    ),
    "an error in degrees": (
        lambda: tippe.Recording(LAUNCH, [0.1, 0.2], [0.1, 0.2], 1.0),
        "error of theta = 1 rad is large; angles are in radians: did you mean np.radians(1)?",
    ),
    "degrees of a slope": (
        lambda: stroller.Plane(1.0),
        "tilt = 1 rad is large; angles are in radians: did you mean np.radians(1)?",
    ),
    "a goal in cm": (
        lambda: checked_problem(PRAM, RIDE, stroller.Goal((200.0, 1000.0), 0.0), 10.0),
        "goal: place = (200.0, 1000.0) is 1020 m from the launch, a mean speed of 102 m/s: was it in cm or mm?",
    ),
    "a grip in per cent": (lambda: stroller.Limits(grip=30.0), "grip = 30 is large: was it in %? 30 % are 0.3"),
    "a mass of a stroller in g": (
        lambda: stroller.Stroller(12000.0, 0.7, 1.5, 0.05),
        "mass = 12000, wheelbase = 0.7, inertia = 1.5 do not fit, as the inertia is usually mass wheelbase^2 / 4",
    ),
    "a wheelbase before the mass": (
        lambda: stroller.Stroller(0.7, 12.0, 1.5, 0.05),
        "were they exchanged, or not in kg",
    ),
    "rad/s of a launch in rpm": (
        lambda: tippe.inversion_time(TOP, tippe.Launch.degrees(6.0, 155.0), 1.0),
        "spin = 155 rpm is slow: this top needs about 735 rpm to turn over; was it in rad/s? 155 rad/s are 1480 rpm",
    ),
    "turns a second of a launch in rpm": (
        lambda: tippe.inversion_time(TOP, tippe.Launch.degrees(6.0, 20.0), 1.0),
        "was it in turns a second? 20 turns a second are 1200 rpm",
    ),
    "turns a second": (
        lambda: tippe.inversion_time(TOP, tippe.Launch(0.1, -20.0), 1.0),
        "spin = 20 rad/s is slow: this top needs about 76.9 rad/s to turn over; was it in turns a second? "
        "20 turns a second are 125.7 rad/s",
    ),
    "turns a second of a run": (
        lambda: tippe.simulate(TOP, tippe.Launch(0.1, 20.0), 1.0),
        "spin = 20 rad/s is slow: this top needs about 76.9 rad/s to turn over; was it in turns a second?",
    ),
    "turns a second in a table": (
        lambda: tippe.inversion_table(TOP, theta=[0.1, 0.2], spin=[15.0, 20.0], t1=1.0),
        "spin = 20 rad/s is slow: this top needs about 76.9 rad/s to turn over; was it in turns a second?",
    ),
    "turns a second of a top with a stem": (
        lambda: tippe.inversion_table(tippe.presets.classroom(), theta=0.1, spin=20.0, t1=1.0),
        "spin = 20 rad/s is slow: this top needs about 44.5 rad/s to turn over; was it in turns a second?",
    ),
    "exactly upright": (
        lambda: tippe.inversion_time(TOP, tippe.Launch(0.0, 155.0), 1.0),
        "theta = 0.0 is exactly upright, where a top stays forever",
    ),
    "some inverted already": (
        lambda: tippe.inversion_table(TOP, theta=[1.2, 2.0, 3.0], spin=155.0, t1=1.0),
        "theta = 3 rad is not below the angle to be reached, 2.985 rad: the top is inverted from the start; "
        "angles are in radians: did you mean np.radians(3)?",
    ),
    "some exactly upright": (
        lambda: tippe.inversion_table(TOP, theta=[0.0, 0.1], spin=155.0, t1=1.0),
        "theta = 0.0 is exactly upright, where a top stays forever",
    ),
}


#: The lines of the calls above.
LINES = {line for call, _ in SUSPECTED.values() for *_, line in call.__code__.co_lines()}


@pytest.fixture
def nothing_runs(monkeypatch):
    """What would run says that it was asked to."""
    monkeypatch.setattr(importlib.import_module("tippe.runs.verbs"), "time_of_event", lambda *_: jnp.inf)
    monkeypatch.setattr(
        importlib.import_module("tippe.runs.verbs"), "simulate_launch", lambda *_: object.__new__(tippe.Trajectory)
    )
    monkeypatch.setattr(
        importlib.import_module("tippe.runs.verbs"), "compute_table", lambda *_, **__: table_of_times([5.0], [9])
    )


def table_of_times(times, steps):
    status = np.where(np.isfinite(times), "inverted", "failed")
    columns = {"time": np.array(times), "steps": np.array(steps), "status": status}
    return tippe.Table({"theta": np.ones(len(times))}, columns | {"end_time": np.arange(3.0, 3.0 + len(times))}, {}, {})


@pytest.mark.parametrize("name", SUSPECTED)
def test_what_is_legal_and_likely_a_mistake_is_warned_of(name, nothing_runs):
    call, message = SUSPECTED[name]
    with pytest.warns(UserWarning, match=re.escape(message)) as caught:
        call()
    # The warning points to the caller's line, one of those above.
    assert {warning.filename for warning in caught} == {__file__}
    assert {warning.lineno for warning in caught} <= LINES


def test_python_shows_a_warning_once_for_a_line():
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("default")
        for _ in range(3):
            tippe.Launch(0.1, 1600.0)
        assert len(caught) == 1
        # One from within a method points here, too.
        tippe.Launch.degrees(5.0, 20000.0)
    assert [warning.filename for warning in caught] == [__file__] * 2


@pytest.mark.filterwarnings("error")
def test_what_is_usual_is_not_suspected(nothing_runs):
    tippe.Launch(0.1, [-900.0, 900.0])
    tippe.Launch.degrees(0.5, 900.0, azimuth=360.0)
    tippe.Launch(2.5, 155.0)
    tippe.Launch(1.0, 155.0, azimuth=6.0 * np.pi)
    tippe.Launch([0.5, 1.0, 1.5, 2.0], 155.0)
    # A wall, and a slope of 60 degrees.
    stroller.Plane(np.pi / 2.0)
    tippe.Scene(rutstam_top(), tippe.Plane(-np.radians(60.0)), tippe.Viscous(0.3))
    # Balls of 20 kg/m^3, of a foam, and a football.
    for mass, radius in ((6.7e-4, 0.02), (0.0105, 0.05), (0.43, 0.11)):
        tippe.Top(mass, radius, 0.0, 0.4 * mass * radius**2, 0.4 * mass * radius**2)
    tippe.Launch(2.0, 0.0)
    tippe.Coulomb(0.1, 0.2)
    tippe.Coulomb(0.0, 0.3)
    # Samples that are missing may have any errors.
    tippe.Recording(LAUNCH, [0.1, 0.2], [0.1, np.nan], [0.01, np.inf])
    columns = {"value": [[0.1, np.nan]], "error": [[0.01, np.nan]]}
    tippe.Recording(LAUNCH, [0.1], **columns, quantity=("theta", "eta"))
    stroller.Stroller(5.0, 0.25, 0.1, 0.005)
    tippe.Scene(rutstam_top(), tippe.Cylinder(10.0))
    stroller.Launch((0.0, 0.0), 6.2, 1.0, steering=-1.5)
    assert tippe.inversion_time(TOP, LAUNCH, 1.0) == jnp.inf
    # So slow that no top turns over by as many turns a second, fast for turns a second, and among faster ones.
    for spin in (5.0, 60.0):
        tippe.inversion_time(TOP, tippe.Launch(0.1, spin), 1.0)
    tippe.inversion_table(TOP, theta=0.1, spin=[20.0, 155.0], t1=1.0)
    # A top of group I turns over at no spin.
    upright = tippe.Scene(tippe.Top(0.02, 0.02, 0.002, 2.1e-6, 3.2e-6), friction=tippe.Viscous(0.3))
    tippe.inversion_time(upright, tippe.Launch(0.1, 20.0), 1.0)
    # A push tips it.
    tippe.inversion_time(TOP, tippe.Launch(0.0, 155.0, velocity=(0.1, 0.0)), 1.0)


def test_a_table_says_which_horizon_was_too_long(monkeypatch):
    table = table_of_times([1.0, np.inf, 2.0], [10, 2_000_000, 30])
    monkeypatch.setattr(importlib.import_module("tippe.runs.verbs"), "compute_table", lambda *_: table)
    with pytest.warns(
        UserWarning, match=r"1 of 3 runs have failed: t1 = 100000 s is too long: the run needs more than 2 000 000"
    ):
        tippe.inversion_table(TOP, theta=[0.1, 0.2, 0.3], spin=155.0, t1=1e5)


@pytest.fixture
def programs_of_its_own():
    """No compiled program from before, and none for later: a limit that a test sets is compiled into the programs."""
    jax.clear_caches()
    yield
    jax.clear_caches()


@pytest.mark.slow
@pytest.mark.usefixtures("programs_of_its_own")
def test_a_time_that_takes_too_many_steps_is_an_error_that_says_how_many(monkeypatch):
    module = importlib.import_module("tippe.runs.verbs")
    monkeypatch.setattr(module, "settings_for_lanes", functools.partial(settings_for_lanes, max_steps=40))
    message = (
        r"t1 = 100000 s is too long: the run needs more than 40 steps, which reached only 0\.\d+ s; take a shorter t1"
    )
    with pytest.warns(UserWarning, match="long for a top"), pytest.raises(ValueError, match=message):
        tippe.inversion_time(TOP, LAUNCH, 1e5, tolerance=1e-6)


def test_a_run_that_lost_contact_says_what_flies_on():
    run = dataclasses.replace(run_of_nothing(), status="contact_lost")
    assert "contact_lost at 0 s" in str(run)
    assert "to continue through the flight, use a Scene with contact='hybrid'" in str(run)


def test_copies_in_our_threads_repeat_no_warning():
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        thread = threading.Thread(target=tippe.Launch, args=(0.1, 1500.0))
        thread.start()
        thread.join()


def test_a_command_line_shows_a_warning_once_and_as_one_line():
    """Also if it comes from several modules, each with a registry of its own."""
    program = (
        "import warnings; from nonholonomic.command_line import run_and_exit; "
        "place = (UserWarning, 'module.py', 1, 'module'); "
        "run_and_exit(lambda: [warnings.warn_explicit(f'too {k % 2}', *place, {}) for k in range(4)] and 0, 'tippe')"
    )
    process = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert process.stderr == "python -m tippe: warning: too 0\npython -m tippe: warning: too 1\n"
