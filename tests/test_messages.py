"""What is refused, and what the message says: the value, what is allowed, the likely mistake. Nothing here compiles a run."""

import dataclasses
import functools
import importlib
import re
import tomllib
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from tops import rutstam_top

import nonholonomic
import stroller
import tippe
from nonholonomic.identification import Draws, sample
from nonholonomic.integration import Settings
from nonholonomic.parameters import numbers
from nonholonomic.views import Page
from tippe.runs.launches import launches
from tippe.runs.table import warn_of_long_runs

pytestmark = pytest.mark.newest

TOP = tippe.Scene(rutstam_top(), friction=tippe.Viscous(0.3))
LAUNCH = tippe.Launch(0.1, 155.0)
PRAM = stroller.Scene(stroller.Stroller(12.0, 0.7, 1.5, 0.05))
RIDE = stroller.Launch((0.0, 0.0), 0.3, 2.0)


class Hill(eqx.Module):
    """A ground whose numbers are an array."""

    bends: jax.Array

    def __call__(self, x, y):
        return self.bends[0] * x * x + self.bends[1] * y * y


def batch(*shape):
    """A batch of runs that was never run."""
    return eqx.tree_at(lambda run: run.t, run_of_nothing(), jnp.zeros(shape))


def followed():
    """A run with a dense output, which is never asked."""
    return dataclasses.replace(run_of_nothing(), dense=object())


def run_of_nothing():
    nothing = jnp.zeros(3)
    states = jnp.tile(TOP.state(LAUNCH)[:, None], 3)
    return tippe.Trajectory(nothing, TOP, states, jnp.zeros((5, 3)), nothing, nothing, 0, nothing[0], {}, None)


REFUSED = {
    "the other package's scene": (
        lambda: tippe.simulate(PRAM, LAUNCH, 1.0),
        "scene is a stroller.Scene and must be a tippe.Scene",
    ),
    "the other package's launch": (
        lambda: stroller.simulate(PRAM, LAUNCH, 1.0),
        "launch is a tippe.Launch and must be a stroller.Launch",
    ),
    "a number for a law": (
        lambda: tippe.Scene(rutstam_top(), friction=0.3),
        "friction = 0.3 must be a Friction law, such as tippe.Viscous(0.3)",
    ),
    "a number for a law of the pram": (
        lambda: stroller.Scene(PRAM.body, friction=0.1),
        "friction = 0.1 must be a Friction law, such as stroller.Damping(rolling=2.0)",
    ),
    "a number for a law of sliding": (
        lambda: tippe.Rolling(1e-4, 1.0, 0.3),
        "sliding = 0.3 must be a Friction law, such as tippe.Viscous(0.3)",
    ),
    "a number for an arena": (
        lambda: tippe.Scene(rutstam_top(), 0.3),
        "surface = 0.3 must be a Surface, such as tippe.Plane() or tippe.Cylinder(0.3)",
    ),
    "degrees": (
        lambda: tippe.Launch(5.0, 100.0),
        "theta = 5.0 must be at most 3.141592653589793; angles are in radians: did you mean np.radians(5.0)?",
    ),
    "degrees of the place": (lambda: tippe.Launch(0.1, 100.0, eta=90.0), "did you mean np.radians(90.0)?"),
    "degrees of the tilt": (lambda: tippe.Plane(10.0), "did you mean np.radians(10.0)?"),
    "degrees of the inversion": (
        lambda: tippe.inversion_time(TOP, LAUNCH, 1.0, 171.0),
        "did you mean np.radians(171.0)?",
    ),
    "a launch of three thetas and two spins": (
        lambda: tippe.Launch([0.1, 0.2, 0.3], [100.0, 150.0]),
        "Launch: theta of shape (3,), spin of shape (2,): the numbers of one object must be scalars or lists of equal length",
    ),
    "a ride of two speeds and three places": (
        lambda: stroller.Launch(([0.0, 1.0, 2.0], 0.0), 0.3, [1.0, 2.0]),
        "Launch: place[0] of shape (3,), speed of shape (2,)",
    ),
    "lists for a run": (
        lambda: tippe.simulate(TOP, tippe.Launch([0.1, 0.2], 155.0), 1.0),
        "launch.theta must be one number, not of shape (2,); jax.vmap(simulate) takes lists",
    ),
    "lists for a time": (
        lambda: tippe.inversion_time(TOP, tippe.Launch([0.1, 0.2], 155.0), 1.0),
        "launch.theta must be one number, not of shape (2,); inversion_table takes lists, and jax.vmap maps over them",
    ),
    "NumPy in a ground": (
        lambda: nonholonomic.Graph(lambda x, y: 0.1 * np.sin(np.asarray(x))),
        "cannot be traced by JAX: write it with jax.numpy in place of numpy",
    ),
    "a branch in a ground": (
        lambda: nonholonomic.Graph(lambda x, y: x if x > 0.0 else y),
        "jnp.where in place of `if`",
    ),
    "a table inside jit": (
        lambda: jax.jit(lambda mu: tippe.inversion_table(TOP, theta=0.1, spin=155.0, mu=mu, t1=1.0).time)(0.3),
        "inversion_table cannot be called inside jit, vmap or grad: use inversion_time there",
    ),
    "a table of known numbers inside jit": (
        lambda: jax.jit(lambda x: x * tippe.inversion_table(TOP, theta=0.1, spin=155.0, t1=1.0).time)(0.3),
        "inversion_table cannot be called inside jit, vmap or grad",
    ),
    "a table of runs inside vmap": (
        lambda: jax.vmap(lambda mu: tippe.trajectory_table(TOP, theta=0.1, spin=155.0, mu=mu, times=[0.1]).theta)(
            jnp.ones(2)
        ),
        "trajectory_table cannot be called inside jit, vmap or grad: use simulate with times= there",
    ),
    "a table of rides inside jit": (
        lambda: jax.jit(lambda t1: stroller.sweep(PRAM, RIDE, t1, axes={}).x)(1.0),
        "sweep cannot be called inside jit, vmap or grad: use simulate there",
    ),
    "a batch for a table": (
        lambda: batch(2, 51).to_table(),
        "this is a batch of runs, with t of shape (2, 51), and to_table takes",
    ),
    "a batch for a page": (lambda: batch(2, 51).view(), "and a picture takes one run: select one by jax.tree.map"),
    "a plot of a quantity": (
        lambda: run_of_nothing().plot("theta"),
        "others = 'theta' must be a list of runs, such as [run]",
    ),
    "a plot beside a number": (
        lambda: run_of_nothing().plot([0.3]),
        "others[0] = 0.3 must be a run of the same package",
    ),
    "a page that is no page": (lambda: run_of_nothing().view("x.txt"), "path = 'x.txt' must end in .html or .htm"),
    "a page without a path": (lambda: run_of_nothing().view(3), "path = 3 must be the path of a file"),
    "a table at a number": (lambda: small_table().plot("time", at=3), "at = 3 must be a dictionary, name of an axis"),
    "a table's cell": (
        lambda: small_table()[0],
        "table[0]: 0 must be the name of a variable or an axis: time, mu",
    ),
    "a list of names in a table": (
        lambda: small_table()[[]],
        "table[[]]: [] must be the name of a variable or an axis",
    ),
    "a table's file that is no path": (lambda: small_table().save(3), "path = 3 must be the path of a file"),
    "a table from no file": (lambda: tippe.Table.load(None), "path = None must be the path of a file"),
    "a run's file that is no path": (lambda: run_of_nothing().save(3), "path = 3 must be the path of a file"),
    "a page's file that is no path": (lambda: Page("").save(3), "path = 3 must be the path of a file"),
    "a sweep's file that is no path": (
        lambda: tippe.inversion_table(TOP, theta=0.1, spin=155.0, t1=1.0, path=3),
        "path = 3 must be the path of a file",
    ),
    "a recording from no file": (
        lambda: tippe.read_recording(3, {"time": ("t", "s"), "theta": ("theta", "rad")}, launch=LAUNCH),
        "path = 3 must be the path of a file",
    ),
    "sliders in a file that is no path": (
        lambda: tippe.explore(TOP, LAUNCH, 3),
        "path = 3 must be the path of a file",
    ),
    "sliders in a file that is no page": (
        lambda: stroller.explore(PRAM, RIDE, "x.txt"),
        "path = 'x.txt' must end in .html or .htm",
    ),
    "times that are no numbers": (lambda: followed().at("a"), "times = 'a' is not a number"),
    "no angle": (
        lambda: tippe.inversion_table(TOP, theta=0.1, spin=155.0, t1=1.0, angle=None),
        "angle = None is not a number",
    ),
    "a number too large for a float": (
        lambda: tippe.Launch(0.1, 10**400),
        "spin is an integer beyond 1.8e308 and must be finite",
    ),
    "a horizon too large for a float": (
        lambda: tippe.simulate(TOP, LAUNCH, 10**400),
        "t1 is an integer beyond 1.8e308 and must be finite",
    ),
    "an axis too large for a float": (
        lambda: tippe.inversion_table(TOP, theta=0.1, spin=[10**400], t1=1.0),
        "spin is an integer beyond 1.8e308 and must be finite",
    ),
    "bytes": (lambda: tippe.Viscous(b"1"), "mu = b'1' is not a number"),
    "an unknown variable to draw": (
        lambda: nonholonomic.sweeps.Table({"mu": np.ones(2)}, {"time": np.ones(2)}, {}, {}).plot("tme"),
        "variable = 'tme' must be a numeric variable of the table: time; did you mean 'time'?",
    ),
}


#: An empty list for a number, by what it would be the number of.
EMPTY = {
    "mass": lambda: tippe.Top([], 0.02, 0.006, 3e-6, 3.2e-6),
    "radius": lambda: tippe.Top(0.02, [[]], 0.006, 3e-6, 3.2e-6),
    "semi_axes[1]": lambda: tippe.Ellipsoid(1.0, (0.2, [], 0.02), (0.0, 0.0, -0.01), np.eye(3)),
    "polar": lambda: tippe.Spheroid(0.3, []),
    "tilt": lambda: tippe.Plane([]),
    "mu": lambda: tippe.Viscous([]),
    "slip_speed": lambda: tippe.Coulomb(0.3, []),
    "theta": lambda: tippe.Launch.degrees([], 100.0),
    "place[0]": lambda: tippe.Launch(0.1, 155.0, place=([], 0.0)),
    "restitution": lambda: tippe.Scene(rutstam_top(), contact="hybrid", restitution=[]),
    "wheelbase": lambda: stroller.Stroller(12.0, [], 1.5, 0.05),
    "heading": lambda: stroller.Launch((0.0, 0.0), [], 2.0),
    "front": lambda: stroller.Damping(2.0, []),
    "force": lambda: stroller.Steady([]),
}


@pytest.mark.parametrize("name", EMPTY)
def test_an_empty_list_is_no_number(name):
    with pytest.raises(ValueError, match=re.escape(f"{name} = [] must be a number, not an empty list")):
        EMPTY[name]()


@pytest.mark.parametrize("name", REFUSED)
def test_a_message_names_the_argument_its_value_and_the_likely_fix(name):
    call, message = REFUSED[name]
    with pytest.raises(ValueError, match=re.escape(message)):
        call()


def test_a_page_that_cannot_be_written_is_refused_before_it_is_drawn(monkeypatch):
    monkeypatch.setattr("tippe.Trajectory.stages", lambda *_: pytest.fail("it was drawn"))
    with pytest.raises(OSError, match=r"path = /proc/x\.html: nothing can be written there"):
        run_of_nothing().view("/proc/x.html")


def test_an_unknown_quantity_of_a_run_is_answered_by_a_likely_one():
    with pytest.raises(
        AttributeError, match=r"the run has no 'thetadot'; did you mean 'theta'\? It has theta, eta, azimuth"
    ):
        _ = run_of_nothing().thetadot
    assert not hasattr(run_of_nothing(), "_repr_png_")
    with pytest.raises(AttributeError, match=r"did you mean 'theta'\?"):
        _ = run_of_nothing().tetha


def test_an_error_within_a_quantity_of_a_run_is_not_hidden():
    """Python asks for an attribute again where a property raises the error of a missing one."""
    with pytest.raises(AttributeError, match="'str' object has no attribute"):
        _ = eqx.tree_at(lambda run: run.scene, run_of_nothing(), "no scene").theta


def test_what_the_function_of_a_ground_holds_may_be_lists_in_tables_too():
    scene = tippe.Scene(rutstam_top(), tippe.Graph(Hill(jnp.array([0.05, 0.1]))), tippe.Viscous(0.3))
    _, grid, _ = launches(scene, {"theta": 0.1, "spin": [100.0, 120.0]}, None, 1.0, 1e-9)
    assert [axis.name for axis in grid] == ["spin"]
    with pytest.raises(ValueError, match=r"scene\.gravity must be one number, not of shape"):
        launches(eqx.tree_at(lambda s: s.gravity, scene, jnp.ones(2)), {"theta": 0.1, "spin": 1.0}, None, 1.0, 1e-9)


@pytest.mark.parametrize("package", ["tippe", "stroller"])
def test_import_star_hands_out_the_public_names_and_rebinds_no_package(package):
    names = {}
    exec(f"import {package}\nfrom {package} import *", names)
    assert names[package] is __import__(package)
    modules = {name for name, value in names.items() if type(value) is type(np) and name != package}
    assert modules <= {"steady"}
    assert {"Scene", "Launch", "simulate"} <= set(names)


FILM = {"launch": LAUNCH, "times": [0.0, 0.1, 0.2]}


def test_a_recorded_angle_in_degrees_is_refused():
    with pytest.raises(ValueError, match=r"theta = 5\.7 must be at most 3\.44.*did you mean np\.radians\(5\.7\)"):
        tippe.Recording(value=[5.7, np.nan, 6.1], error=None, **FILM)
    with pytest.raises(ValueError, match=r"theta = 4\.0 must be at most 3\.44"):
        tippe.Recording(value=[[0.0, 3.1], [0.0, 4.0], [0.0, 3.0]], error=0.01, quantity=("azimuth", "theta"), **FILM)
    # What the errors explain passes, and so do the columns that are no inclination.
    tippe.Recording(value=[3.2, -0.02, 3.0], error=0.05, **FILM)
    tippe.Recording(value=[3.9, np.nan, 3.0], error=0.2, **FILM)
    tippe.Recording(value=[57.0, 58.0, 60.0], error=0.2, quantity="spin", **FILM)


def density_of_a_film():
    """The posterior of friction from a film of theta and azimuth whose errors are unknown."""
    random, times = np.random.default_rng(0), np.linspace(0.0, 0.5, 12)
    value = np.column_stack([0.1 + 0.0175 * random.normal(size=12), np.zeros(12)])
    film = tippe.Recording(LAUNCH, times, value, None, ("theta", "azimuth"))
    return tippe.log_density(TOP, film, {"mu": 0.3}), film


def test_unknown_errors_are_given_as_such_with_their_units():
    density, film = density_of_a_film()
    assert density.names == ("scene.friction.mu", "error[0]", "error[1]")
    assert density.units == {"error[0]": "rad", "error[1]": "rad"}
    guesses = np.asarray(film.measurements.error)[:2]
    values = density.values(jnp.array([np.log(0.2), np.log(2.0), 0.0]))
    np.testing.assert_allclose([values["error[0]"], values["error[1]"]], guesses * [2.0, 1.0], rtol=1e-12)
    # A fit has no coordinates of errors: they are the first guess.
    np.testing.assert_allclose(density.values(np.array([[np.log(0.2)]]))["error[0]"], guesses[:1], rtol=1e-12)
    with pytest.raises(
        ValueError, match=r"coordinates of shape \(2,\) must have 3 numbers .*: scene\.friction\.mu, error"
    ):
        density.values(jnp.zeros(2))


def test_draws_show_the_unit_of_an_error():
    draws = Draws(
        {"error[0]": np.ones((2, 3))},
        np.zeros((2, 3, 1)),
        {"error[0]": 1.0},
        {"error[0]": 6.0},
        1.0,
        9,
        {"error[0]": "rad"},
    )
    assert "error[0]  1  (1, 1) rad  R-hat" in str(draws)


SUSPECTED = {
    "rpm": (lambda: tippe.Launch(0.1, 1500.0), "was it in rpm? 1500 rpm are 157.1 rad/s"),
    "rpm of some": (lambda: tippe.Launch(0.1, [150.0, -1200.0]), "spin = 1200 rad/s is 1.15e+04 revolutions a minute"),
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
    "exactly upright": (
        lambda: tippe.inversion_time(TOP, tippe.Launch(0.0, 155.0), 1.0),
        "theta = 0.0 is exactly upright, where a top stays forever",
    ),
    "some exactly upright": (
        lambda: tippe.inversion_table(TOP, theta=[0.0, 0.1], spin=155.0, t1=1.0),
        "theta = 0.0 is exactly upright, where a top stays forever",
    ),
}


@pytest.fixture
def nothing_runs(monkeypatch):
    """What would run says that it was asked to."""
    monkeypatch.setattr(
        importlib.import_module("tippe.runs.inversion_time"), "differentiable_solve", lambda *_: jnp.inf
    )
    monkeypatch.setattr(
        importlib.import_module("tippe.runs.table"), "sweep", lambda *_, **__: table_of_times([5.0], [9])
    )


def table_of_times(times, steps):
    status = np.where(np.isfinite(times), "inverted", "failed")
    columns = {"time": np.array(times), "steps": np.array(steps), "status": status}
    return tippe.Table({"theta": np.ones(len(times))}, columns | {"end_time": np.arange(3.0, 3.0 + len(times))}, {}, {})


@pytest.mark.parametrize("name", SUSPECTED)
def test_what_is_legal_and_likely_a_mistake_is_warned_of(name, nothing_runs):
    call, message = SUSPECTED[name]
    with pytest.warns(UserWarning, match=re.escape(message)):
        call()


def test_what_is_usual_is_not_suspected(nothing_runs):
    tippe.Launch(0.1, [-900.0, 900.0])
    tippe.Scene(rutstam_top(), tippe.Cylinder(10.0))
    assert tippe.inversion_time(TOP, LAUNCH, 1.0) == jnp.inf
    # A push tips it.
    tippe.inversion_time(TOP, tippe.Launch(0.0, 155.0, velocity=(0.1, 0.0)), 1.0)


def test_a_table_says_which_horizon_was_too_long():
    with pytest.warns(
        UserWarning, match=r"1 of 3 runs have failed: t1 = 100000 s is too long: the run needs more than 2 000 000"
    ):
        warn_of_long_runs(table_of_times([1.0, np.inf, 2.0], [10, 2_000_000, 30]), 1e5, 2_000_000)


@pytest.fixture
def programs_of_its_own():
    """No compiled program from before, and none for later: a limit that a test sets is compiled into the programs."""
    jax.clear_caches()
    yield
    jax.clear_caches()


@pytest.mark.usefixtures("programs_of_its_own")
def test_a_time_that_takes_too_many_steps_is_an_error_that_says_how_many(monkeypatch):
    for module in ("tippe.runs.inversion_time", "tippe.runs.cells"):
        monkeypatch.setattr(importlib.import_module(module), "Settings", functools.partial(Settings, max_steps=40))
    message = (
        r"t1 = 100000 s is too long: the run needs more than 40 steps, which reached only 0\.\d+ s; take a shorter t1"
    )
    with pytest.raises(ValueError, match=message):
        tippe.inversion_time(TOP, LAUNCH, 1e5, tolerance=1e-6)


def test_a_run_that_lost_contact_says_what_flies_on():
    lost = dataclasses.replace(run_of_nothing(), status="contact_lost")
    assert "lost contact at 0 s" in str(lost)
    assert "to continue through the flight, use a Scene with contact='hybrid'" in str(lost)


def small_table():
    return tippe.Table({"mu": np.ones(2)}, {"time": np.ones(2)}, {}, {})


OPTIONAL = {
    "to_xarray of a table": (lambda: small_table().to_xarray(), "xarray", "xarray"),
    "to_xarray in pieces": (lambda: small_table().to_xarray("auto"), "dask", "xarray"),
    "to_xarray of a run": (lambda: run_of_nothing().to_xarray(), "xarray", "xarray"),
    "to_dataframe": (lambda: small_table().to_dataframe(), "pandas", "pandas"),
    "plot of a table": (lambda: small_table().plot(), "matplotlib", "plot"),
    "a portrait": (lambda: run_of_nothing().portrait(), "matplotlib", "plot"),
    "a plot of a run": (lambda: run_of_nothing().plot(), "matplotlib", "plot"),
    "an animation": (lambda: run_of_nothing().animate("a.gif"), "matplotlib", "plot"),
    "a page": (lambda: run_of_nothing().view(), "jupyter_threejs_sage", "view"),
    "draws": (lambda: sample(density_of_a_film()[0], None, None), "blackjax", "bayes"),
}


@pytest.mark.parametrize("name", OPTIONAL)
def test_an_optional_package_is_looked_for_before_the_work_begins(name, monkeypatch):
    call, package, extra = OPTIONAL[name]
    original = nonholonomic.validation.find_spec
    monkeypatch.setattr(
        "nonholonomic.validation.find_spec", lambda module: None if module == package else original(module)
    )
    monkeypatch.setattr("tippe.Trajectory.to_table", lambda *_: pytest.fail("it was read off"))
    monkeypatch.setattr("tippe.Trajectory.stages", lambda *_: pytest.fail("it was drawn"))
    with pytest.raises(ModuleNotFoundError, match=rf"needs {package}: pip install 'nonholonomic\[{extra}\]'"):
        call()
    extras = tomllib.loads((Path(__file__).parents[1] / "pyproject.toml").read_text())["project"][
        "optional-dependencies"
    ]
    assert any(module.replace("-", "_").startswith(package) for module in extras[extra])
    assert extra in re.findall(r"\w+", extras["all"][0])


def stem_top():
    return dataclasses.replace(rutstam_top(), stem=tippe.Stem(0.005, 0.022))


def axes_of(scene, axes):
    _, grid, _ = launches(scene, {"theta": 0.1, "spin": 155.0, "mu": None}, axes, 1.0, 1e-9)
    return {axis.name: axis.number for axis in grid}


def test_an_axis_may_be_named_by_its_end():
    stemmed = tippe.Scene(stem_top(), tippe.Cylinder(0.3), tippe.Coulomb(0.3, 0.01), contact="hybrid")
    assert axes_of(stemmed, {"mu": [0.1, 0.2], "slip_speed": [0.1, 0.2], "restitution": [0.1, 0.2]}) == {
        "mu": "scene.friction.mu",
        "slip_speed": "scene.friction.slip_speed",
        "restitution": "scene.restitution",
    }
    assert axes_of(TOP, {"offset": [0.005, 0.006], "tilt": [0.0, 0.1]}) == {
        "offset": "scene.body.offset",
        "tilt": "scene.surface.tilt",
    }
    assert axes_of(TOP, {"velocity[0]": [0.0, 0.1]}) == {"velocity_t1": "launch.velocity[0]"}
    assert list(axes_of(stemmed, {"stem.offset": [0.022, 0.023]}).values()) == ["scene.body.stem.offset"]


@pytest.mark.parametrize(
    ("axes", "message"),
    [
        ({"ofset": [0.005]}, "unknown axis 'ofset': the numbers that can be varied are .*; did you mean 'offset'"),
        ({"offset": [0.02, 0.021]}, "axes: 'offset' could be scene.body.offset or scene.body.stem.offset"),
        ({"body.mass": [0.02], "mass": [0.02]}, "axes: 'scene.body.mass' is named twice"),
        ({"theta": [0.1]}, "axes: 'launch.theta' has its own argument"),
    ],
)
def test_an_axis_whose_name_means_nothing_or_too_much_is_refused(axes, message):
    with pytest.raises(ValueError, match=message):
        axes_of(tippe.Scene(stem_top(), friction=tippe.Viscous(0.3), contact="hybrid"), axes)


def test_only_what_can_be_varied_is_suggested():
    with pytest.raises(ValueError, match="unknown axis") as refused:
        axes_of(TOP, {"colour": [1.0]})
    suggested = re.findall(r"[\w.\[\]]+", str(refused.value).partition("varied are ")[2])
    assert "scene.surface.tilt" in suggested
    for name in suggested:
        if name not in ("launch.theta", "launch.spin", "launch.eta", "launch.place[2]"):
            assert axes_of(TOP, {name: [1e-3]}) if "body" not in name else name in numbers("scene", TOP)
    with pytest.raises(ValueError, match="unknown axis 'colour'") as refused:
        stroller.sweep(PRAM, RIDE, 1.0, axes={"colour": [1.0]})
    names = re.findall(r"[\w.\[\]]+", str(refused.value).partition("varied are ")[2])
    assert {"scene.body.centre", "launch.place[1]", "launch.speed"} <= set(names)
    assert not {"scene.side", "scene.fork"} & set(names)


def test_the_axes_of_rides_may_be_named_by_their_ends_too(monkeypatch):
    table = importlib.import_module("stroller.runs.table")
    monkeypatch.setattr(table, "computed", lambda job, grid, *_, **__: [axis.number for axis in grid])
    assert stroller.sweep(PRAM, RIDE, 1.0, axes={"speed": [1.0, 2.0], "place[1]": [0.0, 1.0], "wheelbase": [0.6]}) == [
        "launch.speed",
        "launch.place[1]",
        "scene.body.wheelbase",
    ]
    sprung = dataclasses.replace(PRAM, friction=stroller.Damping(1.0))
    with pytest.raises(ValueError, match=r"axes: 'steering' could be scene\.friction\.steering or launch\.steering"):
        stroller.sweep(sprung, RIDE, 1.0, axes={"steering": [0.1]})
