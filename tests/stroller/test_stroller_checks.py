"""What the scene, the launch and the arguments of a ride may be."""

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import stroller
from stroller import Damping, ImplicitMidpoint, Launch, RollingResistance, Scene, Sphere, Spheroid, Steady, Stroller
from stroller.runs.model import checked_model

BODY = Stroller(mass=1.7, wheelbase=0.7, inertia=0.4, steering_inertia=0.05)
FULL = Scene(BODY, Spheroid(2.0, 1.1), Damping(0.3, 0.2, 0.1, 0.15), side="inside", fork="absolute")
LAUNCH = Launch((0.3, -0.6), 0.5, 1.5, 0.2, 0.1)


def push(t, motion):
    return 2.0 * jnp.cos(t) + 0.5 * motion.speed, 0.1 * jnp.sin(2.0 * t) - 0.2 * motion.steering


def test_illegal_numbers_in_a_batch_of_rides_give_nothing_that_looks_right():
    """Constructors do not see these numbers: the ride is illegal, and all its quantities are NaN."""

    def ride(mass, steering, latitude, damping, tolerance):
        scene = Scene(Stroller(mass, 0.7, 0.4, 0.05), Sphere(2.0), Damping(damping), side="inside")
        launch, options = Launch((0.3, latitude), 0.5, 1.5, steering), {"times": [0.0, 0.1], "tolerance": tolerance}
        return stroller.simulate(scene, launch, 0.1, push, **options)

    legal_values = (1.7, 0.2, -0.6, 0.3, 1e-9)
    columns = [legal_values]
    for column, values in ((0, (-1.7, np.nan)), (1, (np.pi / 2,)), (2, (2.0,)), (3, (-0.3,)), (4, (-1.0, np.nan))):
        columns += [
            tuple(value if i == column else number for i, number in enumerate(legal_values)) for value in values
        ]
    rides = jax.jit(jax.vmap(ride))(*jnp.array(columns).T)
    assert rides.stats.finished.tolist() == [True] + 7 * [False]
    assert rides.status.tolist() == ["completed"] + 7 * ["illegal"]
    assert jax.vmap(ride)(*jnp.array(columns).T[:, :0]).speed.shape == (0, 2)
    for quantity in (rides.position, rides.steering, rides.energy, rides.work, rides.normal_force, rides.load):
        assert np.all(np.isfinite(quantity[0]))
        assert np.all(np.isnan(quantity[1:]))


BAD = [
    (lambda: Stroller(0.0, 0.7, 0.4, 0.05), r"mass = 0\.0 must be greater than 0\.0"),
    (lambda: Stroller(1.7, -0.7, 0.4, 0.05), r"wheelbase = -0\.7 must be greater than 0\.0"),
    (lambda: Stroller(1.7, 0.7, 0.4, float("nan")), r"steering_inertia = nan must be finite"),
    (lambda: Stroller(1.7, 0.7, 0.4, 0.05, centre=0.8), r"centre = 0\.8 must be at most 0\.7"),
    (lambda: Stroller(1.7, 0.7, 0.1, 0.05, centre=0.5), r"inertia = 0\.1 must be at least 0\.425"),
    (lambda: Stroller(1.7, 0.7, 0.4, 0.05, steering_spring=-1.0), r"steering_spring = -1\.0 must be at least 0\.0"),
    (lambda: Damping(-0.1), r"rolling = -0\.1 must be at least 0\.0"),
    (lambda: RollingResistance(0.1, 0.0), r"speed = 0\.0 must be greater than 0\.0"),
    (lambda: Steady(force="much"), r"force = 'much' is not a number"),
    (lambda: Launch(0.3, 0.0, 1.0), r"place = 0\.3 must be a pair of numbers"),
    (lambda: Launch((0.0, 0.0), 0.0, np.inf), r"speed = inf must be finite"),
    (lambda: Scene("pram"), r"body = 'pram' must be a Stroller"),
    (lambda: Scene(BODY, surface=3.0), r"surface = 3\.0 must be a Surface"),
    (lambda: Scene(BODY, friction=0.1), r"friction = 0\.1 must be a Friction"),
    (lambda: Scene(BODY, gravity=-1.0), r"gravity = -1\.0 must be at least 0\.0"),
    (lambda: Scene(BODY, side="under"), r"side = 'under' must be one of 'outside', 'inside'"),
    (lambda: Scene(BODY, fork=1), r"fork = 1 must be one of 'relative', 'absolute'"),
    (lambda: Scene(BODY, heading="north"), r"heading = 'north' must be one of 'intrinsic', 'projected'"),
    (lambda: Scene(BODY, side="inside"), r"side = 'inside' must be 'outside' on a Plane"),
    (lambda: Scene(Stroller(1.7, 0.7, 0.9, 0.05, centre=0.3), Sphere(1.0)), r"centre = 0\.3 must be 0\.0 on curved"),
    (lambda: stroller.simulate(BODY, LAUNCH, 1.0), r"scene = .* must be a Scene"),
    (lambda: stroller.simulate(FULL, 1.0, 1.0), r"launch = 1\.0 must be a Launch"),
    (lambda: stroller.simulate(FULL, LAUNCH, 0.0), r"t1 = 0\.0 must be greater than 0\.0"),
    (lambda: stroller.simulate(FULL, LAUNCH, 1.0, times=[0.0, 2.0]), r"times = .* must be at most 1\.0"),
    (
        lambda: stroller.simulate(FULL, LAUNCH, 1.0, times=[0.5, 0.2]),
        r"times\[1\] = 0\.2 must be greater than times\[0\] = 0\.5",
    ),
    (
        lambda: stroller.simulate(FULL, LAUNCH, 1.0, adjoint="backwards"),
        r"adjoint = 'backwards' must be RecursiveCheckpointAdjoint\(\) or ForwardMode\(\) of Diffrax",
    ),
    # It repeats steps of other lengths on its way back.
    (
        lambda: stroller.simulate(FULL, LAUNCH, 1.0, adjoint=diffrax.DirectAdjoint()),
        r"adjoint = DirectAdjoint\(\) must be RecursiveCheckpointAdjoint",
    ),
    (lambda: stroller.simulate(FULL, LAUNCH, 1.0, times="soon"), r"times = 'soon' is not a number"),
    (lambda: stroller.simulate(FULL, LAUNCH, [1.0, 2.0]), r"t1 must be one number, not of shape \(2,\)"),
    (lambda: stroller.simulate(FULL, Launch((0.0, 0.1), 0.0, [1.0, 2.0]), 1.0), r"launch\.speed must be one number"),
    (lambda: stroller.simulate(FULL, LAUNCH, 1.0, tolerance=[1e-6, 1e-7]), r"tolerance must be one number, not of"),
    (lambda: stroller.simulate(FULL, LAUNCH, 1.0, tolerance=1e-300), r"tolerance = 1e-300 must be at least 1e-14"),
    (lambda: stroller.simulate(FULL, LAUNCH, 1.0, tolerance=0.9), r"tolerance = 0\.9 must be at most 0\.01"),
    *(
        (
            lambda n=n: stroller.simulate(FULL, LAUNCH, 1.0, max_steps=n),
            f"max_steps = {n} must be a whole number of at least 1",
        )
        for n in (0, -3, 2.5, True)
    ),
    *(
        (
            lambda solver=solver: stroller.simulate(FULL, LAUNCH, 1.0, solver=solver),
            "solver = .* must be an adaptive solver of Diff.*or an Impl",
        )
        for solver in (ImplicitMidpoint, diffrax.Euler(), diffrax.KenCarp4(), "dopri8")
    ),
    (lambda: stroller.simulate(FULL, LAUNCH, 1.0, times=0.5), r"times = .* must be a list"),
    (lambda: stroller.simulate(FULL, LAUNCH, 1.0, tolerance=0.0), r"tolerance = 0\.0 must be at least 1e-14"),
    (lambda: stroller.simulate(FULL, Launch((0.0, 1.6), 0.0, 1.0), 1.0), r"place\[1\] = 1\.6 must be at most 1\.57"),
    (
        lambda: stroller.simulate(FULL, Launch((0.0, 0.1), 0.0, 1.0, np.pi / 2), 1.0),
        r"steering = 1\.57\d* must differ from a right angle for speed = 1\.0:",
    ),
    (
        lambda: stroller.simulate(Scene(BODY, Sphere(1.0), heading="projected"), Launch((0.0, 0.0), 0.0, 1.0), 1.0),
        r"place\[1\] = 0\.0 must differ from 0 for heading = 'projected'",
    ),
    (lambda: ImplicitMidpoint(0.0), r"step_length = 0\.0 must be greater than 0\.0"),
    (
        lambda: jax.jit(lambda t1: stroller.simulate(FULL, LAUNCH, t1, solver=ImplicitMidpoint(0.1)).speed)(1.0),
        "t1 is traced and must be known for ImplicitMidpoint",
    ),
    # Known values are checked inside transformations, too.
    (lambda: jax.jit(lambda x: x * stroller.simulate(FULL, LAUNCH, -1.0).speed)(1.0), r"t1 = -1\.0 must be greater"),
]


class Hill(eqx.Module):
    """A ground whose numbers are an array."""

    bends: jax.Array

    def __call__(self, x, y):
        return self.bends[0] * x * x + self.bends[1] * y * y


def test_the_function_of_a_ground_may_hold_arrays():
    """Only the numbers of the scene itself must be scalars."""
    ground = stroller.Graph(Hill(jnp.array([0.05, 0.1])))
    checked_model(Scene(BODY, ground), Launch((0.1, 0.2), 0.3, 1.0), 1.0, None, 1e-6)
    with pytest.raises(ValueError, match=r"scene\.gravity must be one number, not of shape"):
        checked_model(Scene(BODY, ground, gravity=[9.8, 1.6]), Launch((0.1, 0.2), 0.3, 1.0), 1.0, None, 1e-6)


@pytest.mark.parametrize(("build", "message"), BAD)
def test_bad_input_is_refused_by_name(build, message):
    with pytest.raises(ValueError, match=message):
        build()
