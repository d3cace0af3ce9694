"""`simulate`: its times, its solvers, its transformations and what it refuses."""

import dataclasses
import math

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from close import assert_close
from tops import rutstam_top

import tippe
from nonholonomic.integration import Settings, follow
from nonholonomic.integration.dense import PIECE
from tippe.modes.problems import trajectory_problem

LAUNCH = tippe.Launch(0.1, 155.0)


def test_a_run_prints_what_it_took(rutstam_scene):
    printed = str(tippe.simulate(rutstam_scene, LAUNCH, 1.0))
    for word in ("completed at 1 s", "accepted", "rejected", "drift of |e|", "energy residual"):
        assert word in printed


def test_given_times_and_dense_output_agree(rutstam_scene):
    times = np.linspace(0.0, 1.0, 11)
    run = tippe.simulate(rutstam_scene, LAUNCH, 1.0)
    sampled_run = tippe.simulate(rutstam_scene, LAUNCH, 1.0, times=times)
    assert_close(sampled_run.t, times)
    assert_close(sampled_run.theta, run.at(times).theta)
    assert (
        sampled_run.axis.shape
        == sampled_run.angular_momentum.shape
        == sampled_run.velocity.shape
        == sampled_run.position.shape
        == (11, 3)
    )
    assert sampled_run.slip.shape == (11, 2)
    assert_close(sampled_run.theta[0], 0.1, rtol=1e-12)
    assert_close(sampled_run.spin[0], 155.0, rtol=1e-12)
    assert_close(sampled_run.velocity[0], 0.0, atol=1e-15)
    with pytest.raises(ValueError, match=r"times = .* must be at most 1\.0 \(the run ends there\)"):
        run.at([0.5, 1.5])


def test_a_run_knows_its_inversion_time(rutstam_scene):
    """As another integrator in another frame finds it: to the errors of both at the same tolerance."""
    run = tippe.simulate(rutstam_scene, LAUNCH, 7.0)
    assert_close(run.inversion_time, tippe.inversion_time(rutstam_scene, LAUNCH, 7.0), rtol=1e-7)
    assert_close(run.at([run.inversion_time]).theta, 0.95 * np.pi, rtol=1e-12)
    # Whatever the times of output; and what has not inverted by the end has no time.
    assert tippe.simulate(rutstam_scene, LAUNCH, 7.0, times=[0.0, 1.0]).inversion_time == run.inversion_time
    assert np.isinf(tippe.simulate(rutstam_scene, LAUNCH, 1.0).inversion_time)
    assert tippe.simulate(rutstam_scene, tippe.Launch(3.1, 155.0), 1.0).inversion_time == 0.0
    with pytest.raises(ValueError, match=r"use tippe\.inversion_time there"):
        _ = dataclasses.replace(run, dense=None).inversion_time


def test_illegal_numbers_in_a_batch_of_runs_give_nothing_that_looks_right(rutstam_scene):
    """Numbers that constructors cannot look at: the status says it, and all else is not a number."""

    def run(mu, theta, t1, tolerance):
        scene = tippe.Scene(rutstam_top(), tippe.Plane(), tippe.Viscous(mu))
        return tippe.simulate(scene, tippe.Launch(theta, 155.0), t1, times=[0.0, 0.05], tolerance=tolerance)

    good = (0.3, 0.1, 0.05, 1e-9)
    bad = ((0, (-0.3, math.nan)), (1, (10.0, -0.1)), (2, (-0.05, 0.01, math.nan)), (3, (-1.0, 0.0, math.nan)))
    columns = [good]
    for column, values in bad:
        columns += [tuple(value if i == column else number for i, number in enumerate(good)) for value in values]
    runs = jax.jit(jax.vmap(run))(*jnp.array(columns).T)
    assert runs.status.tolist() == [0] + 10 * [4]
    assert jax.vmap(run)(*jnp.array(columns).T[:, :0]).theta.shape == (0, 2)
    single_run = tippe.simulate(rutstam_scene, LAUNCH, 0.05, times=[0.0, 0.05])
    assert_close(runs.theta[0], single_run.theta, rtol=1e-8)
    for quantity in (runs.theta, runs.energy, runs.position, runs.normal_force, runs.work, runs.end_time):
        assert np.all(np.isfinite(quantity[0]))
        assert np.all(np.isnan(quantity[1:]))


@pytest.mark.slow
@pytest.mark.parametrize(
    "options",
    [{"adjoint": diffrax.ForwardMode()}, pytest.param({"solver": diffrax.Kvaerno3()}, marks=pytest.mark.slow)],
    ids=str,
)
def test_a_run_without_contact_at_its_start_ends_there(options):
    """On the ceiling of a cylinder, whoever integrates; nothing looks right of a run by an illegal number, nor its slopes."""

    def run(mu, eta):
        scene = tippe.Scene(rutstam_top(), tippe.Cylinder(0.3), tippe.Viscous(mu))
        return tippe.simulate(scene, tippe.Launch(0.1, 155.0, eta=eta), 0.1, [0.0, 0.1], 1e-6, **options)

    runs = jax.jit(jax.vmap(run))(jnp.array([0.3, 0.3]), jnp.array([0.0, 3.0]))
    assert runs.status.tolist() == [0, 1]
    assert_close(runs.end_time, [0.1, 0.0])
    assert np.isfinite(runs.theta).tolist() == [[True, True], [True, False]]
    if "solver" not in options:
        slope = jax.jit(jax.jacfwd(lambda mu: run(mu, 0.0).theta[-1]))
        assert np.isfinite(slope(0.3))
        assert np.isnan(slope(-0.3))


def test_more_steps_than_a_piece_holds(rutstam_scene):
    """A long run is made of pieces; the seams are not seen."""
    run = tippe.simulate(rutstam_scene, LAUNCH, 8.0, tolerance=3e-14)
    assert run.stats["accepted"] > 4096
    assert_close(run.jellett, run.jellett[0], rtol=1e-10)
    assert np.all(np.diff(run.t) > 0.0)
    assert_close(run.t[-1], 8.0)


def test_a_run_of_too_many_steps_fails(rutstam_scene):
    """It says so and ends where it is, rather than go on for ever."""
    path = follow(trajectory_problem((rutstam_scene, LAUNCH)), 1e6, Settings(3e-14, max_steps=3000))
    assert path.failed
    assert not path.left_domain
    assert 3000 <= path.accepted + path.rejected < 3000 + PIECE
    assert np.isfinite(path.states).all()
    assert 0.0 < path.times[-1] < 100.0


@pytest.mark.slow
@pytest.mark.parametrize(("solver", "tolerance"), [(diffrax.Tsit5(), 1e-9), (diffrax.Kvaerno5(), 1e-7)])
def test_other_solvers_agree(rutstam_scene, solver, tolerance):
    expected = tippe.simulate(rutstam_scene, LAUNCH, 0.3, times=[0.3], tolerance=1e-11)
    run = tippe.simulate(rutstam_scene, LAUNCH, 0.3, times=[0.3], tolerance=tolerance, solver=solver)
    assert_close(run.axis, expected.axis, atol=1e3 * tolerance)


@pytest.mark.slow
def test_the_derivative_of_a_trajectory(rutstam_scene):
    """Reverse and forward mode, and forward mode by Diffrax, against a central difference."""

    def theta(mu, adjoint=None):
        scene = tippe.Scene(rutstam_top(), tippe.Plane(), tippe.Viscous(mu))
        return tippe.simulate(scene, LAUNCH, 0.5, times=[0.25, 0.5], tolerance=1e-11, adjoint=adjoint).theta[-1]

    reverse = jax.grad(theta)(0.3)
    forward = jax.jacfwd(lambda mu: theta(mu, diffrax.ForwardMode()))(0.3)
    assert_close(forward, reverse, rtol=1e-7)
    assert_close(jax.jacfwd(theta)(0.3), reverse, rtol=1e-12)
    steps = [4e-4, 2e-4, 1e-4]
    differences = [(theta(0.3 + h) - theta(0.3 - h)) / (2.0 * h) for h in steps]
    assert_close((4.0 * differences[2] - differences[1]) / 3.0, reverse, rtol=1e-7)


def test_a_batch_of_runs_says_which_lost_contact():
    scene = tippe.Scene(rutstam_top(), tippe.Plane(), tippe.Coulomb(0.3, 0.05))
    launches = tippe.Launch(jnp.full(2, 0.1), jnp.array([100.0, 155.0]), jnp.zeros(2), jnp.zeros(2))
    times = np.linspace(0.0, 1.0, 21)
    runs = jax.vmap(lambda launch: tippe.simulate(scene, launch, 1.0, times=times))(launches)
    assert runs.status.tolist() == [0, 1]
    assert_close(runs.end_time[0], 1.0)
    # tippe.md, section 3: Coulomb, 0.05 m/s, 155 rad/s loses contact at 0.79 s.
    assert_close(runs.end_time[1], 0.79, atol=6e-3)
    assert_close(runs.end_time[1], tippe.simulate(scene, tippe.Launch(0.1, 155.0), 1.0).end_time, rtol=1e-8)
    assert np.isfinite(runs.theta[0]).all()
    single_run = tippe.simulate(scene, tippe.Launch(0.1, 100.0), 1.0, times=times)
    assert_close(runs.theta[0], single_run.theta, rtol=1e-7)
    assert_close(runs.position[0], single_run.position, atol=1e-8)
    assert not np.isfinite(runs.theta[1][times > runs.end_time[1]]).any()
    assert "contact_lost at 0.79" in str(jax.tree.map(lambda leaf: leaf[1], runs))


def test_a_ceiling_start_has_no_contact(rutstam_scene):
    scene = tippe.Scene(rutstam_top(), tippe.Cylinder(0.3), tippe.Viscous(0.3))
    run = tippe.simulate(scene, tippe.Launch(0.1, 100.0, eta=3.0), 1.0)
    assert run.status == "contact_lost"
    assert run.end_time == 0.0


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"t1": -1.0}, "t1 = -1.0 must be greater than 0"),
        ({"times": [0.5, 2.0]}, "times = .* must be at most 1.0"),
        ({"times": [0.5, 0.4]}, r"times\[1\] = 0.4 must be greater than times\[0\] = 0.5: times must increase"),
        ({"times": []}, r"times = \[\] must be a list of at least one number"),
        ({"solver": "Dopri8"}, "solver = 'Dopri8' must be an adaptive solver of Diffrax"),
        ({"solver": diffrax.Euler()}, r"solver = Euler\(\) must be an adaptive solver of Diffrax"),
        (
            {"solver": diffrax.KenCarp4()},
            r"solver = KenCarp4\(.* must be an adaptive .* for ordinary differential equations",
        ),
        ({"adjoint": "backwards"}, "adjoint = 'backwards' must be RecursiveCheckpointAdjoint"),
        ({"launch": 3}, "launch = 3 must be a Launch"),
        ({"tolerance": math.nan}, "tolerance = nan must be finite"),
    ],
)
def test_bad_arguments_are_named(rutstam_scene, arguments, message):
    with pytest.raises(ValueError, match=message):
        tippe.simulate(**({"scene": rutstam_scene, "launch": LAUNCH, "t1": 1.0} | arguments))


def test_times_are_needed_inside_a_transformation(rutstam_scene):
    with pytest.raises(ValueError, match="times must be given inside jit"):
        jax.jit(lambda theta: tippe.simulate(rutstam_scene, tippe.Launch(theta, 155.0), 1.0).theta)(0.1)
