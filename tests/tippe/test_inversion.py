"""`inversion_time` as a function: its transformations, its derivatives, its answers where there is no inversion."""

import dataclasses
import math

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from close import assert_close
from tops import rutstam_top

import tippe
from nonholonomic.integration import Settings, solve_ensemble
from nonholonomic.integration.problem import CROSSED
from tippe.modes.problems import InversionProblem


def time_of(mu=0.3, theta=0.1, spin=155.0, offset=0.006, tolerance=1e-11, crossing="first", t1=20.0):
    top = rutstam_top()
    top = tippe.Top(top.mass, top.radius, offset, top.I1, top.I3)
    scene = tippe.Scene(top, tippe.Plane(), tippe.Viscous(mu))
    return tippe.inversion_time(scene, tippe.Launch(theta, spin), t1, tolerance=tolerance, crossing=crossing)


def central_difference(function, point, steps):
    """Central differences with one Richardson step, for every step of a scan; the pair that agrees best is taken."""
    differences = [(function(point + h) - function(point - h)) / (2.0 * h) for h in steps]
    extrapolated = [(4.0 * fine - coarse) / 3.0 for coarse, fine in zip(differences[:-1], differences[1:], strict=True)]
    gaps = [abs(a - b) for a, b in zip(extrapolated[:-1], extrapolated[1:], strict=True)]
    return extrapolated[int(np.argmin(gaps)) + 1]


#: Numbers of the scene and launch, where they are and the first step of the scan.
NUMBERS = {"mu": (0.3, 4e-5), "theta": (0.1, 2e-5), "spin": (155.0, 4e-3), "offset": (0.006, 2e-7)}


def test_all_derivatives_agree_with_central_differences():
    """grad with respect to mu, theta, spin and offset: 1e-5 relative, of differences whose step was scanned."""
    points = tuple(jnp.asarray(point) for point, _ in NUMBERS.values())
    gradient = jax.grad(lambda numbers: time_of(*numbers))(points)
    for i, (point, step) in enumerate(NUMBERS.values()):

        def moved(value, i=i):
            numbers = list(points)
            numbers[i] = jnp.asarray(value)
            return float(time_of(*numbers))

        expected = central_difference(moved, point, [step / 2.0**k for k in range(5)])
        assert_close(gradient[i], expected, rtol=1e-5)


def test_transformations_agree():
    """jit, vmap, grad, jvp and hessian give one another's numbers."""
    mus = jnp.array([0.25, 0.3, 0.35])
    times = np.array([float(time_of(mu)) for mu in mus])
    assert_close(jax.jit(jax.vmap(time_of))(mus), times, rtol=1e-9)
    value, slope = jax.jvp(time_of, (0.3,), (1.0,))
    # With the tangent in step control the steps are others, and so is the error.
    assert_close(value, times[1], rtol=1e-8)
    slopes = jax.jit(jax.vmap(jax.grad(time_of)))(mus)
    assert_close(slopes[1], slope, rtol=1e-6)
    assert jax.vmap(time_of)(mus[:0]).shape == (0,)


@pytest.mark.parametrize("time", [tippe.inversion_time, tippe.extended_inversion_time])
def test_arrays_of_numpy_in_a_batch_inside_jit(time):
    """Measured launches are NumPy arrays, which `vmap` hands on as they are, and models are differentiated inside `jit`."""
    thetas = np.array([0.2, 0.3])

    def times(mu):
        scene = tippe.Scene(rutstam_top(), tippe.Plane(), tippe.Viscous(mu))
        return jax.vmap(lambda theta: time(scene, tippe.Launch(theta, 155.0), 8.0, tolerance=1e-6))(thetas)

    # The refusal comes while JAX traces.
    for function in (times, lambda mu: jax.jvp(times, (mu,), (jnp.ones(()),)), jax.jacrev(times)):
        assert all(part.shape == (2,) for part in jax.tree.leaves(jax.eval_shape(jax.jit(function), 0.3)))


def test_the_penalty_of_a_lost_contact_has_the_derivative_of_its_value():
    """The contact is lost earlier or later, at another theta. Second derivatives there are refused."""

    def time(mu, spin):
        scene = tippe.Scene(rutstam_top(), friction=tippe.Viscous(mu))
        return tippe.extended_inversion_time(scene, tippe.Launch(0.1, spin), 6.0, tolerance=1e-9)

    # One program for all derivatives.
    moved = jax.jit(lambda mu, spin, *rates: jax.jvp(time, (mu, spin), rates))
    value, by_mu = moved(0.3, 200.0, 1.0, 0.0)
    assert 6.0 < value < 12.0
    for slope, step in ((by_mu, (1e-4, 0.0)), (moved(0.3, 200.0, 0.0, 1.0)[1], (0.0, 0.1))):
        above, below = (moved(0.3 + sign * step[0], 200.0 + sign * step[1], 1.0, 0.0)[0] for sign in (1.0, -1.0))
        assert_close(slope, (above - below) / (2.0 * sum(step)), rtol=1e-4)


@pytest.mark.slow
def test_the_penalty_of_a_lost_contact_has_no_second_derivative():
    def time(mu):
        scene = tippe.Scene(rutstam_top(), friction=tippe.Viscous(mu))
        return tippe.extended_inversion_time(scene, tippe.Launch(0.1, 200.0), 6.0, tolerance=1e-9)

    assert np.isnan(jax.jit(jax.hessian(time))(0.3))


@pytest.mark.slow
def test_second_derivative():
    """jax.hessian against differences of the gradient."""
    slope = jax.jit(jax.grad(time_of))
    expected = central_difference(slope, 0.3, [2e-5, 1e-5, 5e-6, 2.5e-6])
    second = jax.jit(jax.hessian(time_of))
    assert_close(second(0.3), expected, rtol=1e-4)
    assert np.isnan(second(-0.3))


def test_no_inversion_is_infinite_with_derivative_zero():
    """Too little spin, too short a horizon, contact lost: infinite, and nothing is not a number."""
    for arguments in ({"spin": 40.0}, {"t1": 2.0}, {"spin": 190.0}):
        value, slope = jax.value_and_grad(lambda mu, kw=arguments: time_of(mu, **kw))(0.3)
        assert np.isinf(value)
        assert slope == 0.0


def test_a_guarded_loss_has_a_gradient_where_nothing_inverts():
    """The loss is 0 there and so is its gradient, although the cotangent that it sends back is not a number."""

    def loss(mu, spin):
        time = time_of(mu, spin=spin)
        return jnp.where(jnp.isfinite(time), (time - 5.0) ** 2, 0.0)

    for spin in (40.0, 190.0):
        assert jax.value_and_grad(loss)(0.3, spin) == (0.0, 0.0)
    time, slope = jax.value_and_grad(time_of)(0.3)
    value, gradient = jax.value_and_grad(loss)(0.3, 155.0)
    assert_close(value, (time - 5.0) ** 2, rtol=1e-12)
    assert_close(gradient, 2.0 * (time - 5.0) * slope, rtol=1e-12)


GOOD = {"mu": 0.3, "theta": 0.1, "offset": 0.006, "tolerance": 1e-11, "t1": 20.0}
#: The batches of the next tests share a program.
LANES = 9


def times_of(columns, crossing="first"):
    """The times of a batch in which each run has numbers of its own."""
    columns = {name: jnp.asarray(values) for name, values in columns.items()}
    return jax.vmap(lambda numbers: time_of(**numbers, crossing=crossing))(columns)


def test_illegal_numbers_inside_transformations_give_nothing_that_looks_right():
    """Numbers that constructors cannot look at: not a number, nor their derivatives; their neighbours stay right."""
    good = GOOD | {"tolerance": 1e-8}
    bad = {
        "mu": [-0.3, math.nan],
        "theta": [10.0, -0.1],
        "offset": [0.03],
        "tolerance": [math.nan],
        "t1": [-1.0, math.inf],
    }
    columns = {name: [good[name]] for name in good}
    for name, values in bad.items():
        for value in values:
            for other_name in columns:
                columns[other_name].append(value if other_name == name else good[other_name])
    assert len(columns["mu"]) == LANES
    times = times_of(columns)
    assert_close(times[0], time_of(), rtol=1e-6)
    assert np.all(np.isnan(times[1:]))
    for mu in (-0.3, math.nan):
        assert np.all(np.isnan(jax.value_and_grad(time_of)(mu)))

    def extended(mu):
        scene = tippe.Scene(rutstam_top(), tippe.Plane(), tippe.Viscous(mu))
        return tippe.extended_inversion_time(scene, tippe.Launch(0.1, 155.0), 0.1, tolerance=1e-6)

    assert np.all(np.isnan(jax.value_and_grad(extended)(-0.3)))


def test_a_run_that_fails_inside_a_transformation_is_not_a_number():
    """A spin that overflows is legal; a time that is infinite would say that the top does not invert."""
    assert np.isnan(jax.jit(lambda spin: time_of(spin=spin, tolerance=1e-8))(1e200))


@pytest.mark.filterwarnings("ignore:theta = 0.0 is exactly upright")
def test_a_top_exactly_upright_never_leaves():
    assert np.isinf(time_of(theta=0.0))


def test_a_top_that_starts_beyond_the_angle_is_inverted_at_once():
    assert time_of(theta=3.1) == 0.0


@pytest.mark.parametrize(
    "solver",
    [
        diffrax.Tsit5(),
        *(pytest.param(solver, marks=pytest.mark.slow) for solver in (diffrax.Dopri5(), diffrax.Bosh3())),
    ],
)
def test_other_solvers_agree(solver):
    scene = tippe.Scene(rutstam_top(), tippe.Plane(), tippe.Viscous(0.3))
    launch = tippe.Launch(0.1, 155.0)
    tolerance = 1e-7 if isinstance(solver, diffrax.Bosh3) else 1e-10
    value = tippe.inversion_time(scene, launch, 10.0, tolerance=tolerance, solver=solver)
    assert_close(value, time_of(), rtol=30.0 * tolerance * 100.0)


@pytest.mark.slow
def test_first_and_last_crossing_in_the_cylinder():
    """Down the wall theta swings past the angle and back; the last up-crossing is that of the trajectory."""
    scene = tippe.Scene(rutstam_top(), tippe.Cylinder(0.3), tippe.Viscous(0.3))
    launch = tippe.Launch(0.3, 78.125, eta=math.pi / 2.0)
    run = tippe.simulate(scene, launch, 15.0, tolerance=1e-10)
    angle = 0.95 * math.pi
    fine = np.linspace(0.0, 15.0, 60001)
    is_beyond = np.asarray(run.at(fine).theta) >= angle
    ups = fine[1:][is_beyond[1:] & ~is_beyond[:-1]]
    first = tippe.inversion_time(scene, launch, 15.0)
    last = tippe.inversion_time(scene, launch, 15.0, crossing="last")
    assert len(ups) > 5
    assert 0.0 <= ups[0] - first < 2.6e-4
    assert 0.0 <= ups[-1] - last < 2.6e-4
    assert_close(run.at([float(first), float(last)]).theta, angle, atol=1e-7)


BAD = [
    ({"t1": -1.0}, "t1 = -1.0 must be greater than 0"),
    ({"t1": math.nan}, "t1 = nan must be finite"),
    ({"angle": 4.0}, "angle = 4.0 must be at most pi rad"),
    ({"tolerance": 0.0}, "tolerance = 0.0 must be at least 1e-14"),
    ({"crossing": "second"}, "crossing = 'second' must be 'first' or 'last'"),
    ({"solver": diffrax.Kvaerno5()}, "must be an explicit Runge-Kutta solver"),
]


@pytest.mark.parametrize(("arguments", "message"), BAD)
def test_bad_arguments_are_named(rutstam_scene, arguments, message):
    with pytest.raises(ValueError, match=message.replace("(", r"\(")):
        tippe.inversion_time(rutstam_scene, tippe.Launch(0.1, 155.0), **({"t1": 10.0} | arguments))


def test_arrays_are_refused_with_a_hint(rutstam_scene):
    with pytest.raises(
        ValueError, match=r"launch.theta must be one number, not of shape \(2,\); inversion_table takes"
    ):
        tippe.inversion_time(rutstam_scene, tippe.Launch([0.1, 0.2], 155.0), 10.0)


def test_a_batch_keeps_every_horizon():
    """vmap over t1: each cell has its own, for the first crossing and for the last."""
    horizons = np.where(np.arange(LANES) % 2 == 0, 3.0, 20.0)
    columns = {name: np.full(LANES, number) for name, number in GOOD.items()} | {"t1": horizons}
    for crossing in ("first", "last"):
        times = np.asarray(times_of(columns, crossing))
        assert np.isinf(times[0::2]).all()
        assert_close(times[1::2], time_of(), rtol=1e-9)


def test_a_launch_exactly_on_the_angle():
    """It has reached the angle; for the last crossing the way onwards counts."""
    scene = tippe.Scene(rutstam_top(), tippe.Plane(), tippe.Viscous(0.3))
    launch = tippe.Launch(2.5, 100.0)
    assert tippe.inversion_time(scene, launch, 1.0, angle=2.5) == 0.0
    last = tippe.inversion_time(scene, launch, 1.0, angle=2.5, crossing="last")
    assert np.isinf(last) or 0.0 <= last < 1.0


@pytest.mark.filterwarnings("ignore:spin = .* was it in rpm")
def test_a_field_that_is_no_number_fails_at_once():
    table = tippe.inversion_table(
        tippe.Scene(rutstam_top(), tippe.Plane(), tippe.Viscous(0.3)), theta=0.1, spin=[1e200, 100.0], t1=0.1
    )
    assert table.status.tolist() == ["failed", "not_inverted"]
    assert table.steps[0] < 100


FLOAT32 = """
import numpy as np, tippe
mass, radius = 0.02, 0.02
top = tippe.Top(mass, radius, 0.006, 131 / 350 * mass * radius**2, 0.4 * mass * radius**2)
scene = tippe.Scene(top, tippe.Plane(), tippe.Viscous(0.3))
table = tippe.inversion_table(scene, theta=[0.3, 0.4], spin=[155.0, 160.0], t1=8.0, tolerance=1e-5)
print(",".join(str(time) for time in table.time.ravel()))
"""


def test_float32_works_at_its_own_tolerance():
    """JAX_ENABLE_X64=0: the same times to a hundredth, which is what the tolerance leaves."""
    import os
    import subprocess
    import sys

    process = subprocess.run(
        [sys.executable, "-c", FLOAT32],
        env=os.environ | {"JAX_ENABLE_X64": "0"},
        capture_output=True,
        text=True,
        check=True,
        timeout=120,
    )
    scene = tippe.Scene(rutstam_top(), tippe.Plane(), tippe.Viscous(0.3))
    expected = tippe.inversion_table(scene, theta=[0.3, 0.4], spin=[155.0, 160.0], t1=8.0)
    assert_close([float(time) for time in process.stdout.split(",")], expected.time.ravel(), rtol=2e-2)


@pytest.mark.slow
def test_a_frame_that_turns_with_the_top_saves_digits_and_changes_none(rutstam_scene):
    """Tops on the plane under a law with torques too, slow and fast, by equations at rest and by those of the tables."""
    disc = tippe.Contensou(np.array([0.3, 0.3, 0.1, 0.5]), np.array([0.0, 1e-3, 2e-3, 0.0]), 0.2)
    launch = tippe.Launch(np.array([0.1, 0.4, 0.2, 1.0]), np.array([150.0, -180.0, 200.0, 40.0]), azimuth=1.0)

    def problems(law):
        scene = eqx.tree_at(lambda node: node.friction, rutstam_scene, law)
        tables = dataclasses.replace(InversionProblem.of(scene, launch, jnp.pi, 4), cos_angle=jnp.asarray(-2.0))
        return tables, dataclasses.replace(tables, dynamics=scene.dynamics)

    def ends(problem, tolerance):
        outcome, _ = solve_ensemble(problem, jnp.asarray(2.0), jnp.asarray(4), Settings(tolerance))
        assert (outcome.status != CROSSED).all()
        state = np.asarray(outcome.state)
        u, e, L = np.vstack([state[:2], 0.0 * state[:1]]), state[2:5], state[5:]
        return np.stack([e[2], (L * e).sum(0), L[2], (u * e).sum(0), (u * L).sum(0), (u * u).sum(0)])

    for law in (disc, rutstam_scene.friction):
        tables, at_rest = problems(law)
        exact = ends(at_rest, 1e-13)
        sizes = np.abs(exact).max(axis=1, keepdims=True)
        assert_close(ends(tables, 1e-13) / sizes, exact / sizes, atol=1e-9)
    # The fast ones under viscous friction, where nothing but the turning limits the steps.
    bad_arguments = {
        name: np.abs((ends(problem, 1e-8) - exact) / sizes).max(axis=0)[:3]
        for name, problem in (("turning", tables), ("rest", at_rest))
    }
    assert (2.0 * bad_arguments["turning"] < bad_arguments["rest"]).all(), bad_arguments
    # The frame has turned: only what has no direction is the same.
    turned_rates, fixed_rates = (
        problem.dynamics.field(tables.states + 0.1 * tables.scales) for problem in (tables, at_rest)
    )
    assert not np.allclose(turned_rates[2], fixed_rates[2])


def test_the_frame_of_a_top_that_cannot_invert_is_at_rest():
    """Its axis soon stands beside L, and both would be moved: 2.5 times the steps. Tops of both kinds share a block."""
    upright, inverting = tippe.Top(0.02, 0.02, 0.002, 2.1e-6, 3.2e-6), rutstam_top()
    states = jax.tree.map(lambda a, b: jnp.stack([a, b]), upright, inverting)
    turns = tippe.Scene(states, tippe.Plane(), tippe.Viscous(0.3)).turning_dynamics.turns
    assert turns[0] == 0.0 < turns[1]
    assert tippe.Scene(upright, tippe.Plane(0.1), tippe.Viscous(0.3)).turning_dynamics.turns is None
