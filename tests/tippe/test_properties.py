"""Properties over the whole legal range of scenes and launches (hypothesis)."""

import math

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import assert_close
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

import tippe
from nonholonomic.ensemble import compiled_march
from nonholonomic.lockstep import FAILED
from tippe.inversion import InversionProblem

#: Examples are drawn in batches of this many lanes, so that one compiled program runs them all.
LANES = 16
HORIZON = 0.5


@st.composite
def batches(draw, arena: str):
    """A scene and a launch with `LANES` numbers in every place, from grams to kilograms and from slow to 1e3 rad/s."""
    seed = draw(st.integers(0, 2**32 - 1))
    random = np.random.default_rng(seed)

    def between(low, high, log=False):
        return np.exp(random.uniform(np.log(low), np.log(high), LANES)) if log else random.uniform(low, high, LANES)

    mass, radius = between(1e-3, 10.0, log=True), between(2e-3, 0.3, log=True)
    I1 = mass * radius**2 * between(0.15, 0.8)
    I3 = I1 * between(0.3, 2.0)
    top = tippe.Top(mass, radius, radius * between(0.0, 0.9), I1, I3)
    surface = {
        "plane": lambda: tippe.Plane(),
        "cylinder": lambda: tippe.Cylinder(radius * between(1.05, 1e3, log=True)),
        "sphere": lambda: tippe.Sphere(radius * between(1.05, 1e3, log=True)),
    }[arena]()
    # Half of the lanes have no disc or no lever, and so Coulomb friction or no rolling resistance.
    disc, lever = (radius * between(0.0, 0.1) * random.integers(0, 2, LANES) for _ in range(2))
    sliding = tippe.Contensou(between(0.0, 1.0), disc, between(0.02, 1.0, log=True))
    friction = tippe.Rolling(lever, between(0.1, 10.0, log=True), sliding)
    scene = tippe.Scene(top, surface, friction, between(1.0, 30.0))
    spin = between(1.0, 1e3, log=True) * random.choice([-1.0, 1.0], LANES)
    eta = between(-1.5, 1.5) if arena != "plane" else np.zeros(LANES)
    return scene, tippe.Launch(between(0.0, math.pi), spin, eta, between(-math.pi, math.pi))


def ends(scene: tippe.Scene, launch: tippe.Launch, tolerance: float = 1e-9):
    """States where the runs end: at the horizon, or where contact is lost."""
    problem = InversionProblem.of(scene, launch, 2.0 * math.pi, LANES)
    # No angle has a cosine of 2: nothing but the loss of contact ends a run before the horizon.
    problem = InversionProblem(problem.dynamics, jnp.asarray(-2.0), problem.states, problem.scales)
    outcome, _ = compiled_march(
        problem,
        jnp.asarray(HORIZON),
        jnp.asarray(LANES),
        jnp.asarray(tolerance),
        jnp.asarray(0.1 * tolerance),
        solver=diffrax.Dopri8(),
        lanes=LANES,
        max_steps=200_000,
    )
    return outcome


def check_a_batch(scene: tippe.Scene, launch: tippe.Launch, plane: bool):
    """Finite or flagged; |e| = 1; energy never grows; Jellett's constant on the plane without torques."""
    outcome = ends(scene, launch)
    assert np.isfinite(outcome.state).all()
    assert (np.asarray(outcome.status) != FAILED).all()
    start, end = scene.state(launch), outcome.state
    turns = 1.0 + np.abs(np.asarray(launch.spin)) * HORIZON
    assert np.all(np.abs(np.linalg.norm(end[2:5], axis=0) - 1.0) < 1e-7 * turns)
    energy = (
        np.asarray(jax.vmap(type(scene).energy)(scene, start.T)),
        np.asarray(jax.vmap(type(scene).energy)(scene, end.T)),
    )
    size = np.asarray(scene.body.I3 * launch.spin**2 + scene.body.mass * scene.gravity * scene.body.radius)
    if not plane:
        size = size + np.asarray(scene.body.mass * scene.gravity * scene.surface.radius)
    assert np.all(energy[1] <= energy[0] + 1e-7 * size * turns)
    if plane:
        before, after = scene.jellett(start), scene.jellett(end)
        unit = np.asarray(scene.body.radius * scene.body.I3 * jnp.abs(launch.spin)) + 1e-300
        at_a_point = (scene.friction.resistance == 0.0) & (scene.friction.sliding.contact_radius == 0.0)
        assert np.all(np.where(at_a_point, np.abs(np.asarray(after - before)) / unit, 0.0) < 1e-6 * turns)


FEW = settings(max_examples=4, deadline=None, derandomize=True, suppress_health_check=list(HealthCheck))
MANY = settings(max_examples=180, deadline=None, suppress_health_check=list(HealthCheck))


@pytest.mark.parametrize("arena", ["plane", "cylinder", "sphere"])
def test_finite_or_flagged_and_energy_never_grows(arena):
    @FEW
    @given(batch=batches(arena))
    def check(batch):
        check_a_batch(*batch, plane=arena == "plane")

    check()


@pytest.mark.slow
@pytest.mark.parametrize("arena", ["plane", "cylinder", "sphere"])
def test_finite_or_flagged_in_many_examples(arena):
    """180 batches of 16 launches for each arena."""

    @MANY
    @given(batch=batches(arena))
    def check(batch):
        check_a_batch(*batch, plane=arena == "plane")

    check()


def test_scaling_laws():
    """Lengths by k, times by sqrt(k), masses by q: the same motion, to a fraction of the tolerance.

    Not to round-off: Hairer's choice of the first step, which Diffrax makes too, depends on the unit of time.
    """
    length, mass = 4.0, 8.0
    time = math.sqrt(length)
    small = {"mass": 0.02, "radius": 0.02, "offset": 0.006, "I1": 3e-6, "I3": 3.2e-6}
    units = {"mass": mass, "radius": length, "offset": length, "I1": mass * length**2, "I3": mass * length**2}
    large = {name: value * units[name] for name, value in small.items()}
    for arena, grown in ((tippe.Plane(), tippe.Plane()), (tippe.Cylinder(0.3), tippe.Cylinder(0.3 * length))):
        near = tippe.Scene(tippe.Top(**small), arena, tippe.Viscous(0.3))
        far = tippe.Scene(tippe.Top(**large), grown, tippe.Viscous(0.3 * time / length))
        launches = [tippe.Launch(0.1, 155.0, 0.2), tippe.Launch(0.1, 155.0 / time, 0.2)]
        times = [
            float(tippe.inversion_time(near, launches[0], 10.0)),
            float(tippe.inversion_time(far, launches[1], 10.0 * time)) / time,
        ]
        assert_close(times[1], times[0], rtol=5e-10)


def test_symmetries_of_the_arena():
    """The plane turned by any angle, and the cylinder reflected, give the same times."""
    top = tippe.Top(0.02, 0.02, 0.006, 3e-6, 3.2e-6)
    plane = tippe.Scene(top, tippe.Plane(), tippe.Viscous(0.3))
    times = [float(tippe.inversion_time(plane, tippe.Launch(0.1, 155.0, azimuth=a), 10.0)) for a in (0.0, 1.0, 2.5)]
    assert_close(times, times[0], rtol=1e-7)
    cylinder = tippe.Scene(top, tippe.Cylinder(0.3), tippe.Viscous(0.3))

    def time_of(spin, eta, azimuth):
        return float(tippe.inversion_time(cylinder, tippe.Launch(0.1, spin, eta, azimuth), 10.0))

    straight = time_of(155.0, 0.4, 0.7)
    # Reflection x -> -x turns eta, the axis' x component and every spin about; y -> -y the axis' y component and the spin.
    assert_close(time_of(-155.0, -0.4, math.pi - 0.7), straight, rtol=1e-7)
    assert_close(time_of(-155.0, 0.4, -0.7), straight, rtol=1e-7)
