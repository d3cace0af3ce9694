"""What is refused, and what the message says: the value, what is allowed, the likely mistake. Nothing here compiles a run."""

import re

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from never_run import LAUNCH, PRAM, RIDE, TOP, batch, followed, rides, run_of_nothing, small_table
from tops import rutstam_top

import nonholonomic
import stroller
import tippe
from nonholonomic.identification.posterior import as_free
from nonholonomic.identification.result import check_search
from nonholonomic.text import shown
from nonholonomic.views import Page

pytestmark = pytest.mark.oldest


class Skate(nonholonomic.AbstractSystem):
    """Its constraint is a list instead of a row."""

    dimension = 3

    def metric(self, q):
        return jnp.eye(3)

    def constraints(self, q):
        return jnp.array([jnp.sin(q[2]), -jnp.cos(q[2]), 0.0])


class Leaving(nonholonomic.AbstractMode):
    """Its reset leads to a mode that does not exist."""

    def field(self, t, y):
        return -jnp.ones(1)

    def margin(self, t, y):
        return y[0]

    def reset(self, t, y):
        return y + 1.0, 5


class Turning(nonholonomic.AbstractSystem):
    """A flywheel."""

    dimension = 1

    def metric(self, q):
        return jnp.eye(1)


class Nameless(nonholonomic.AbstractSystem):
    """A system without its number of coordinates."""

    def metric(self, q):
        return jnp.eye(1)


REFUSED = {
    "the other package's scene": (
        lambda: tippe.simulate(PRAM, LAUNCH, 1.0),
        "scene is a stroller.Scene and must be a tippe.Scene",
    ),
    "the other package's launch": (
        lambda: stroller.simulate(PRAM, LAUNCH, 1.0),
        "launch is a tippe.Launch and must be a stroller.Launch",
    ),
    "the other package's data": (
        lambda: nonholonomic.identify(TOP, stroller.Recording(RIDE, [1.0], [2.0], 0.1, "speed"), {"mu": 0.3}),
        "data: the scene of a stroller.Recording is a tippe.Scene and must be a stroller.Scene",
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
        "theta = 5.0 must be at most pi rad; angles are in radians: did you mean np.radians(5.0)?",
    ),
    "a law for a number": (
        lambda: nonholonomic.identify(
            tippe.Scene(rutstam_top(), friction=tippe.Coulomb(0.3, 0.05)),
            tippe.Recording(LAUNCH, [0.1, 0.2], [0.1, 0.1], 0.01),
            {"friction": 0.3},
        ),
        "t0; did you mean 'friction.mu' or 'friction.slip_speed'?",
    ),
    "more than half a turn in degrees": (
        lambda: tippe.Recording(LAUNCH, [0.1, 0.2], np.radians([6.0, 200.0]), 0.01),
        "theta = 200 deg at 0.2 s (sample 2) must be, with room for its errors, between 0 and 180 deg",
    ),
    "a decimal comma": (lambda: tippe.Launch("6,5", 155.0), "theta = '6,5' is not a number: did you mean 6.5?"),
    "numbers as texts": (
        lambda: tippe.inversion_table(TOP, theta=["3", "6"], spin=155.0, t1=1.0),
        "theta = ['3', '6'] is not a number, or a list of numbers",
    ),
    "a law as the surface": (lambda: tippe.Scene(TOP.body, tippe.Viscous(0.3)), "pass a law by its name, friction="),
    "a number as a text": (lambda: tippe.simulate(TOP, LAUNCH, "8"), "t1 = '8' is not a number: did you mean 8?"),
    "degrees of a box": (
        lambda: stroller.Box((1.0, 0.3), (0.5, 0.25), 45.0),
        "angle = 45.0 must be within [-2 pi, 2 pi]; angles are in radians: did you mean np.radians(45)?",
    ),
    "a launch for the scene of a table": (
        lambda: tippe.inversion_table(LAUNCH, TOP, t1=1.0),
        "scene = Launch(theta=0.1 rad, spin=155 rad/s, eta=0 rad, azimuth=0 rad) must be a Scene",
    ),
    "a field of another size than the start": (
        lambda: nonholonomic.simulate(nonholonomic.Hybrid([Leaving()]), [1.0, 2.0], 1.0),
        "modes[0].field(t, y) must return an array of shape (2,), like the start, not an array of shape (1,); "
        "pass a start of 1 number, or return 2 numbers",
    ),
    "a number for a list of coordinates": (
        lambda: nonholonomic.simulate(Turning(), (0.1, 0.0), 1.0),
        "start: q must be of shape (1,), not (): write [0.1]",
    ),
    "a class for a system": (lambda: nonholonomic.simulate(Turning, ([0.1], [0.0]), 1.0), "did you mean Turning(...)?"),
    "a function for a system": (
        lambda: nonholonomic.simulate(lambda t, y: -y, [1.0], 1.0),
        "wrap modes in nonholonomic.Hybrid([...]), and a function in a mode, as its field",
    ),
    "no dimension": (
        lambda: nonholonomic.simulate(Nameless(), ([1.0], [0.0]), t1=1.0),
        "Nameless has no dimension: write `dimension = 1`, its number of coordinates",
    ),
    "degrees of the place": (lambda: tippe.Launch(0.1, 100.0, eta=90.0), "did you mean np.radians(90.0)?"),
    "degrees of the tilt": (lambda: tippe.Plane(10.0), "did you mean np.radians(10.0)?"),
    "degrees of the inversion": (
        lambda: tippe.inversion_time(TOP, LAUNCH, 1.0, 171.0),
        "did you mean np.radians(171.0)?",
    ),
    "a list of launches in a table": (
        lambda: tippe.inversion_table(TOP, [LAUNCH, LAUNCH], t1=1.0),
        "launch must be one Launch, not a list of 2; scattered=True takes lists of their numbers, by name",
    ),
    "a launch of three thetas and two spins": (
        lambda: tippe.Launch([0.1, 0.2, 0.3], [100.0, 150.0]),
        "Launch: theta of shape (3,), spin of shape (2,): the numbers of one object must be scalars or lists of equal length; "
        "for a table of all combinations, leave single numbers here and pass it axes={'theta': [0.1, 0.2, 0.3], 'spin': "
        "[100, 150]}, in SI units",
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
    "arrays of JAX in a tuple": (
        lambda: tippe.Launch(0.1, 155.0, place=(jnp.array(1.5), 2.0, 3.0, 4.0)),
        "place = (1.5, 2.0, 3.0, 4.0) must be (x, y), (mu, eta) or (x, y, z)",
    ),
    "a place of three numbers on a ground": (
        lambda: TOP.check_start(tippe.Launch(0.1, 155.0, place=(1.0,) * 4)),
        "place = (1.0, 1.0, 1.0, 1.0) must be",
    ),
    "a prior of arrays": (
        lambda: as_free({"mu": tippe.Free(0.3, prior=(jnp.array(0.3), 0.1, np.float64(2.0)))}),
        "prior of mu = (0.3, 0.1, 2.0) must be a mean and a standard deviation",
    ),
    "a number of NumPy": (
        lambda: stroller.sweep(PRAM, RIDE, 1.0, axes=np.float64(1.0)),
        "axes = 1.0 must be a dictionary",
    ),
    "a function's name": (
        lambda: nonholonomic.Graph(lambda x, y: x if x > 0.0 else y),
        "height = <lambda> cannot be traced by JAX",
    ),
    "a class for a law": (
        lambda: tippe.Scene(rutstam_top(), friction=tippe.Viscous),
        "friction = Viscous must be a Friction law, such as tippe.Viscous(0.3) or tippe.Coulomb(mu=0.3, slip_speed=0.01); "
        "did you mean Viscous(...)?",
    ),
    "a list of launches for a run": (
        lambda: tippe.simulate(TOP, [LAUNCH, LAUNCH], 1.0),
        "launch must be one Launch, not a list of 2; jax.vmap(simulate) takes lists, and so does trajectory_table",
    ),
    "a list of launches for a ride": (
        lambda: stroller.simulate(PRAM, (RIDE, RIDE), 1.0),
        "launch must be one Launch, not a list of 2; axes of sweep take lists",
    ),
    "a list of launches for a recording": (
        lambda: tippe.Recording([LAUNCH], [0.1], [0.1], 0.01),
        "launch must be one Launch, not a list of 1; identify takes a list of recordings",
    ),
    "a recording of a top without its quantity": (
        lambda: nonholonomic.identify(TOP, nonholonomic.Recording(LAUNCH, [0.1, 0.2], [0.1, 0.1], 0.01), {"mu": 0.3}),
        "quantity: 'y0' (the default) must be one of theta, eta",
    ),
    "a list of launches for event times": (
        lambda: nonholonomic.EventTimes([LAUNCH, LAUNCH], [1.0, 2.0], 0.1, t1=5.0),
        "launch must be one launch, not a list of 2: make an EventTimes of each, and pass identify a list of them",
    ),
    "launches of several numbers": (
        lambda: tippe.InversionTimes([LAUNCH, tippe.Launch([0.1, 0.2], 100.0)], [1.0, 2.0], 0.1, t1=5.0),
        "launch: theta must be one number in each of the list, not of shape (2,)",
    ),
    "launches of several places": (
        lambda: tippe.InversionTimes([LAUNCH, tippe.Launch(0.1, 9.0, place=(0.0, 0.0))], [1.0, 2.0], 0.1, t1=5.0),
        "launch: place must have the same number of coordinates in all, not none, 2",
    ),
    "more launches than times": (
        lambda: tippe.InversionTimes([LAUNCH] * 3, [1.0, 2.0], 0.1, t1=5.0),
        "launch.theta must be one number or one for each of the 2 times, not of shape (3,)",
    ),
    "no launches": (
        lambda: tippe.InversionTimes([], [1.0, 2.0], 0.1, t1=5.0),
        "launch = [] must be a Launch or a list of launches",
    ),
    "a stroller larger than its sphere": (
        lambda: stroller.Scene(PRAM.body, stroller.Sphere(0.3), side="inside"),
        "surface radius = 0.3 must be at least 0.35 (half the wheelbase, as both axles touch the surface)",
    ),
    "a stroller larger than its spheroid": (
        lambda: stroller.Scene(PRAM.body, stroller.Spheroid(0.3, 0.2)),
        "greater semi-axis of the surface = 0.3 must be at least 0.35",
    ),
    "a stroller larger than its torus": (
        lambda: stroller.Scene(PRAM.body, stroller.Torus(0.15, 0.1)),
        "surface ring + tube = 0.25 must be at least 0.35",
    ),
    "a heading in a goal's place": (
        lambda: stroller.plan(PRAM, RIDE, stroller.Goal((1, 2, 3.0), 0.0), 10.0),
        "goal: place = (1.0, 2.0, 3.0): distance from the surface = 3.0 must be at most",
    ),
    "the fix of a heading in a goal's place": (
        lambda: stroller.plan(PRAM, RIDE, stroller.Goal((1, 2, 3.0), 0.0), 10.0),
        "(x, y, z), z the height, of a point on the surface up to round-off); a heading is an argument of its own, heading=",
    ),
    "a column for a place": (
        lambda: stroller.Launch(np.zeros((2, 1)), 0.0, 1.0),
        "place is an array of shape (2, 1) and must be a pair of numbers: flatten it",
    ),
    "three speeds for a limit": (
        lambda: stroller.Limits(speed=(1, 2, 3)),
        "speed = (1.0, 2.0, 3.0) must be one positive number, such as 1 for (-1, 1), or a pair (lowest, highest)",
    ),
    "an input that returns the force alone": (
        lambda: stroller.simulate(PRAM, RIDE, 1.0, lambda t, motion: motion.speed),
        "must return one drive force [N] and one steering torque [N m], as a pair, not a number of type float64",
    ),
    "times beyond the end": (
        lambda: stroller.simulate(PRAM, RIDE, 10.0, times=(0, 20)),
        "times = 20.0 must be at most 10.0 (the run is from 0 to t1)",
    ),
    "one constraint that is no row": (
        lambda: nonholonomic.simulate(Skate(), ([0.0] * 3, [0.0] * 3), 1.0),
        "of shape (k, 3), a row for each constraint, such as jnp.array([[...]]) for one, not (3,)",
    ),
    "a reset to no mode": (
        lambda: nonholonomic.simulate(nonholonomic.Hybrid([Leaving()]), [1.0], 1.0),
        "modes[0].reset(t, y) returned mode 5; there is 1 mode (0)",
    ),
    "a reset to none of three modes": (
        lambda: nonholonomic.simulate(nonholonomic.Hybrid([Leaving()] * 3), [1.0], 1.0),
        "modes[0].reset(t, y) returned mode 5; there are 3 modes (0 to 2)",
    ),
    "a table called CSV": (
        lambda: small_table().save("x.csv"),
        "path = 'x.csv' must end in .h5: the file is in HDF5; for a CSV or Excel file, use to_dataframe().to_csv or .to_excel",
    ),
    "a run called a picture": (lambda: run_of_nothing().save("x.PNG"), "path = 'x.PNG' must end in .h5"),
    "a sweep called CSV": (
        lambda: tippe.inversion_table(TOP, theta=0.1, spin=155.0, t1=1.0, path="x.csv"),
        "path = 'x.csv' must end in .h5: the file is in HDF5; for a CSV",
    ),
    "a page called a picture": (lambda: Page("").save("x.png"), "path = 'x.png' must end in .html or .htm"),
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
    "a plot of a number": (
        lambda: run_of_nothing().plot(3.0),
        "others = 3.0 must be a list of runs, such as [run]",
    ),
    "a plot beside a number": (
        lambda: run_of_nothing().plot([0.3]),
        "others[0] = 0.3 must be a run of the same package",
    ),
    "a picture of a run of the other package": (
        lambda: run_of_nothing().plot(others=[rides()]),
        "others[0] = 2 runs of 51 times must be a run of the same package",
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
        lambda: tippe.inversion_table(TOP, theta=0.1, spin=155.0, t1=1.0, angle="171 deg"),
        "angle = '171 deg' is not a number",
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
    "a beginning and an end for a horizon": (
        lambda: tippe.simulate(TOP, LAUNCH, (0, 8)),
        "t1 = (0, 8) must be one number, the end of the run [s], which starts at t = 0: did you mean t1=8?",
    ),
    "two horizons": (
        lambda: tippe.simulate(TOP, LAUNCH, (1.0, 8.0)),
        "t1 must be one number, not of shape (2,); jax.vmap(simulate) takes lists",
    ),
    "a beginning and an end of a ride": (
        lambda: stroller.simulate(PRAM, RIDE, np.array([0.0, 8.0])),
        "t1 = [0, 8] must be one number, the end of the run [s], which starts at t = 0: did you mean t1=8.0?",
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


#: Functions that check their arguments before anything compiles, and legal arguments.
CHECKED = {
    "Top": (tippe.Top, {"mass": 0.02, "radius": 0.02, "offset": 0.006, "I1": 3e-6, "I3": 3.2e-6, "stem": None}),
    "Scene": (tippe.Scene, {"body": TOP.body, "surface": TOP.surface, "friction": TOP.friction, "restitution": None}),
    "Launch": (tippe.Launch, {"theta": 0.1, "spin": 1.0, "place": None, "velocity": None, "angular_velocity": None}),
    "degrees": (tippe.Launch.degrees, {"theta": 6.0, "rpm": 1500.0}),
    "Coulomb": (tippe.Coulomb, {"mu": 0.3, "slip_speed": 0.01}),
    "Torus": (tippe.Torus, {"ring": 1.0, "tube": 0.3}),
    "Graph": (nonholonomic.Graph, {"height": lambda x, y: 0.0 * x}),
    "InversionTimes": (
        tippe.InversionTimes,
        {"launch": LAUNCH, "time": [5.0], "error": 0.1, "t1": 8.0, "until": None, "angle": 2.9, "student": None},
    ),
    "Recording": (
        tippe.Recording,
        {"launch": LAUNCH, "times": [0.1, 0.2], "value": [0.1, 0.2], "error": 0.1, "quantity": "theta", "t0": 0.0},
    ),
    "Stroller": (stroller.Stroller, {"mass": 12.0, "wheelbase": 0.7, "inertia": 1.5, "steering_inertia": 0.05}),
    "scene of a stroller": (
        stroller.Scene,
        {"body": PRAM.body, "surface": PRAM.surface, "side": None, "fork": "relative"},
    ),
    "launch of a stroller": (stroller.Launch, {"place": (0.0, 0.0), "heading": 0.3, "speed": 1.0}),
    "Hybrid": (nonholonomic.Hybrid, {"modes": [], "event": None}),
    "as_free": (as_free, {"free": {"mu": tippe.Free(0.3)}}),
    "check_search": (check_search, {"starts": 1, "spread": 2.0, "seed": 0, "max_steps": 9, "progress": False}),
    "plot": (small_table().plot, {"variable": "time", "at": None, "x": None, "label": None, "unit": None}),
    "plot of a run": (
        lambda **options: run_of_nothing().plot("t", **options),
        {"others": (), "unit": None, "label": None},
    ),
}

#: What may be passed by mistake.
MISTAKES = [
    [jnp.array(1.5)],
    (jnp.array(1.5),) * 4,
    {"a": jnp.array(1.5)},
    jnp.array([1.0, 2.0]),
    jnp.array(-3.0),
    jnp.array(jnp.nan),
    np.float64(-1.0),
    [jnp.array(1.0), "x"],
    np.array(["a"]),
    jnp.ones((1, 2)),
    tippe.Viscous(0.3),
]


@pytest.mark.parametrize("name", CHECKED)
@pytest.mark.filterwarnings("ignore::UserWarning")
def test_whatever_is_passed_by_mistake_is_refused_in_words(name):
    """Whatever is not legal raises a `ValueError`, and no message shows an array of JAX or the address of an object."""
    call, arguments = CHECKED[name]
    messages = []
    for argument in arguments:
        for mistake in MISTAKES:
            try:
                call(**(arguments | {argument: mistake}))
            except ValueError as error:
                messages.append(str(error))
    assert len(messages) > len(arguments)
    assert [text for text in messages if "Array(" in text or "dtype=" in text or "object at 0x" in text] == []


#: Values as messages show them, with the text.
SHOWN = [
    (jnp.array(1.5), "1.5"),
    ([jnp.array(1.5), np.float64(2.0)], "[1.5, 2.0]"),
    ((1.5,), "(1.5,)"),
    ({"a": (jnp.array([0.1, 0.2]), None)}, "{'a': ([0.1, 0.2], None)}"),
    (list(range(20)), "[0, 1, ..., 19, 20 in all]"),
    (np.array(["x"]), "['x']"),
    ([[1, 2], [3]], "[[1, 2], [3]]"),
    (tippe.Viscous(0.3), "Viscous(mu=0.3 s/m)"),
    (run_of_nothing, "run_of_nothing"),
    ("a word", "'a word'"),
    (1.0 + 2.0j, "(1+2j)"),
]


@pytest.mark.parametrize(("value", "text"), SHOWN)
def test_a_message_shows_numbers_and_no_arrays(value, text):
    assert shown(value) == text


def test_a_message_shows_a_traced_number_as_traced():
    texts = []
    jax.jit(lambda x: texts.append(shown((x, 1.0))) or x)(0.3)
    assert texts == ["(traced float64[], 1.0)"]


#: Calls with other arguments than those of the constructor, and the message.
CALLED = {
    "Coulomb's law without its slip speed": (
        lambda: tippe.Coulomb(0.3),
        "Coulomb takes mu, slip_speed; missing a required argument: 'slip_speed'; usual slip speeds are 0.01 to 0.1 m/s, "
        "as in slip_speed=0.05",
    ),
    "Contensou's law without its slip speed": (
        lambda: tippe.Contensou(0.3, 1e-3),
        "missing a required argument: 'slip_speed'; usual slip speeds are 0.01 to 0.1 m/s, as in slip_speed=0.05",
    ),
    "a spin for revolutions a minute": (
        lambda: tippe.Launch.degrees(theta=6, spin=20),
        "missing a required argument: 'rpm'; Launch takes spin in rad/s, Launch.degrees takes rpm: 20 turns a second are "
        "spin=125.7 or rpm=1200",
    ),
    "revolutions a minute for a spin": (
        lambda: tippe.Launch(theta=0.1, rpm=1200),
        "rpm = 1200 is not among them; Launch takes spin in rad/s, Launch.degrees takes rpm",
    ),
    "revolutions a minute for a table": (
        lambda: tippe.inversion_table(TOP, theta=0.1, rpm=1500, t1=1.0),
        "rpm = 1500 is not among them; Launch takes spin in rad/s, Launch.degrees takes rpm",
    ),
    "a spin for a page": (
        lambda: tippe.explore(TOP, LAUNCH, spin=155.0),
        "explore takes scene, launch, path, sliders, t1, unit, label; spin = 155.0 is not among them; a launch has it: "
        "launch=tippe.Launch(theta, spin), or launch=tippe.Launch.degrees(theta, rpm)",
    ),
    "units of a launch": (
        lambda: tippe.Launch(6.0, 30.0, units="degrees"),
        "units = 'degrees' is not among them; Launch.degrees(theta=6, rpm=1800) takes degrees",
    ),
    "friction of a table": (
        lambda: tippe.inversion_table(TOP, theta=0.1, spin=155.0, friction=[0.1, 0.2], t1=1.0),
        "friction = [0.1, 0.2] is not among them; a scene has the law; mu takes coefficients",
    ),
    "a height for a place": (
        lambda: tippe.Launch(0.1, 155.0, height=0.01),
        "a launch touches the arena; place= states",
    ),
    "a mass for an axis": (
        lambda: stroller.sweep(PRAM, RIDE, 1.0, mass=[12.0]),
        "sweep takes scene, launch, t1,",
    ),
    "an end without its name": (
        lambda: nonholonomic.simulate(Turning(), ([0.1], [0.0])),
        "simulate takes system, start, t1, times, tolerance, solver, adjoint, input, jumps; missing a required argument: 't1'",
    ),
    "an end by another name": (
        lambda: stroller.simulate(PRAM, RIDE, t=1.0),
        "t = 1.0 is not among them",
    ),
    "no standard error": (
        lambda: tippe.Recording(LAUNCH, [0.1], [0.1]),
        "Recording takes launch, times, value, error, quantity, t0, student, side; missing a required argument: 'error'",
    ),
    "a diameter for a radius": (
        lambda: tippe.Top.turned(diameter=0.04, mass=0.02, stem_radius=0.005),
        "diameter = 0.04 is not among them; the radius is half the diameter",
    ),
    "no moments of inertia": (
        lambda: tippe.Top(0.02, 0.02),
        "Top takes mass, radius, offset, I1, I3, stem; missing a required argument: 'offset'; Top.turned computes",
    ),
    "a letter less": (
        lambda: tippe.Cylinder(radus=0.3),
        "radus = 0.3 is not among them; did you mean 'radius'",
    ),
    "a number too many": (lambda: tippe.Viscous(0.3, 0.01), "Viscous takes mu; too many positional arguments"),
}


@pytest.mark.parametrize("name", CALLED)
def test_a_constructor_names_the_arguments_that_it_takes(name):
    call, message = CALLED[name]
    with pytest.raises(TypeError, match=re.escape(message)):
        call()


def test_an_error_within_a_constructor_is_not_taken_for_one_of_its_arguments():
    class Own(tippe.AbstractFriction):
        mu: float

        def __check_init__(self):
            raise TypeError("from within")

        def per_normal_force(self, slip):
            raise NotImplementedError

    with pytest.raises(TypeError, match="from within"):
        Own(0.3)


@pytest.mark.parametrize("name", REFUSED)
def test_a_message_names_the_argument_its_value_and_the_likely_fix(name):
    call, message = REFUSED[name]
    with pytest.raises(ValueError, match=re.escape(message)):
        call()


def test_a_fit_knows_which_numbers_of_the_launch_are_held_fixed():
    data = tippe.Recording(LAUNCH, [0.1, 0.2], [0.1, 0.1], 0.01)
    assert tippe.log_density(TOP, data, {"mu": 0.3}).problem.model.fixed == ("launch.theta", "launch.spin", "t0")
    free = {"mu": 0.3, "launch.spin": 155.0, "t0": 0.0}
    assert tippe.log_density(TOP, data, free).problem.model.fixed == ("launch.theta",)


def test_a_page_that_cannot_be_written_is_refused_before_it_is_drawn(monkeypatch):
    monkeypatch.setattr("tippe.Trajectory.stages", lambda *_: pytest.fail("it was drawn"))
    with pytest.raises(OSError, match=r"path = /proc/x\.html: nothing can be written there"):
        run_of_nothing().view("/proc/x.html")


def test_an_unknown_quantity_of_a_run_is_answered_by_a_likely_one():
    with pytest.raises(
        AttributeError, match=r"the run has no 'thetadot'; did you mean 'theta'\? It has t, theta, eta, azimuth"
    ):
        _ = run_of_nothing().thetadot
    with pytest.raises(AttributeError, match="the run has no 'times'; did you mean 't'"):
        _ = run_of_nothing().times
    assert not hasattr(run_of_nothing(), "_repr_png_")
    with pytest.raises(AttributeError, match=r"did you mean 'theta'\?"):
        _ = run_of_nothing().tetha


def test_an_unknown_quantity_of_an_inputs_motion_is_answered_by_a_likely_one():
    for wrong, likely in {"v": "speed", "stering": "steering"}.items():
        known = "It has position, heading, steering, speed, front_speed, yaw_rate, steering_rate"
        with pytest.raises(AttributeError, match=f"the motion has no '{wrong}'; did you mean '{likely}'\\? {known}"):
            stroller.simulate(PRAM, RIDE, 1.0, lambda t, motion, wrong=wrong: (getattr(motion, wrong), 0.0))


def test_an_error_within_a_quantity_of_a_run_is_not_hidden():
    """Python asks for an attribute again where a property raises the error of a missing one."""
    with pytest.raises(AttributeError, match="'str' object has no attribute"):
        _ = eqx.tree_at(lambda run: run.scene.body, run_of_nothing(), "no body").energy


@pytest.mark.parametrize("package", ["tippe", "stroller"])
def test_import_star_hands_out_the_public_names_and_rebinds_no_package(package):
    names = {}
    exec(f"import {package}\nfrom {package} import *", names)
    assert names[package] is __import__(package)
    modules = {name for name, value in names.items() if type(value) is type(np) and name != package}
    assert modules <= {"steady"}
    assert {"Scene", "Launch", "simulate"} <= set(names)
