"""Every function of `nonholonomic` answers for every kind of model."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from close import assert_close
from models import CASES, NAMES

import nonholonomic
from nonholonomic.identification import sample
from nonholonomic.runs.model import model_of

QUIET = dict(progress=False, tolerance=1e-8)


@pytest.fixture(params=NAMES, scope="module")
def case(request):
    return CASES[request.param]


@pytest.fixture(scope="module")
def table(case):
    axes = {case.parameter: case.value * np.array([1.0 - 1e-3, 1.0, 1.0 + 1e-3])}
    options = dict(event=case.event, sensitivities=[case.parameter], errors=True, **QUIET)
    return nonholonomic.sweep(case.system, case.start, case.t1, axes=axes, **options)


#: Of these the ordinary run has the cheapest case; tops and mechanical systems have tests of their own.
of_own_modes = pytest.mark.parametrize(
    "case", [pytest.param(name, marks=() if name == "modes" else pytest.mark.slow) for name in CASES], indirect=True
)


@pytest.fixture(scope="module")
def samples(case):
    axes, times = {case.parameter: case.value * np.array([1.0, 1.01])}, np.linspace(0.1, 0.5, 5)
    options = dict(axes=axes, times=times, quantities=[case.quantity], **QUIET)
    return nonholonomic.sweep(case.system, case.start, 0.5, **options)


def test_the_time_of_an_event_is_that_of_a_table(case, table):
    time = nonholonomic.event_time(case.system, case.start, case.t1, event=case.event, tolerance=1e-8)
    assert set(table.status) == {"event"}
    assert_close(table.time[1], time, rtol=case.rtol)


def test_the_slopes_of_a_table_are_those_of_differences(case, table):
    axis = table[next(iter(table.coords))]
    slope = (table.time[2] - table.time[0]) / (axis[2] - axis[0])
    assert_close(table[f"time_by_{case.parameter}"][1], slope, rtol=1e-4)


def test_the_bounds_of_a_table_hold(case, table):
    exact = nonholonomic.event_time(case.system, case.start, case.t1, event=case.event, tolerance=1e-12)
    assert 0.0 < table.time_error[1] < 1e-5
    assert abs(table.time[1] - float(exact)) <= table.time_error[1]


@of_own_modes
def test_the_quantity_of_a_run_is_that_of_the_samples(case, samples):
    times = np.asarray(samples.coords["time"])
    run = nonholonomic.simulate(case.system, case.start, 0.5, times=times, tolerance=1e-8)
    assert samples[case.quantity].shape == (2, 5)
    assert_close(samples[case.quantity][0], run[case.quantity], rtol=1e-6, atol=1e-8)
    # Some of the same times among others.
    later = run.at([times[1], times[2], 0.35, 0.42, 0.45])
    assert_close(later[case.quantity][:2], run[case.quantity][1:3], rtol=1e-6, atol=1e-8)
    assert case.quantity in run.to_xarray()


@of_own_modes
def test_runs_in_transformations_have_quantities(case, samples):
    def last(scale):
        start = jax.tree.map(lambda x: x * scale, case.start)
        return nonholonomic.simulate(case.system, start, 0.5, times=jnp.array([0.3, 0.5]), tolerance=1e-8)[
            case.quantity
        ]

    assert_close(jax.jit(jax.vmap(last))(jnp.ones(2))[1, 1], samples[case.quantity][0, -1], rtol=1e-6, atol=1e-8)


@of_own_modes
def test_tables_are_scattered_and_resumed_and_limit_their_steps(case, table, tmp_path):
    def sweep(**more):
        axes = {case.parameter: case.value * np.array([1.0 - 1e-3, 1.0])}
        return nonholonomic.sweep(case.system, case.start, case.t1, axes=axes, event=case.event, **QUIET, **more)

    path = tmp_path / "times.h5"
    first, again = sweep(scattered=True, path=path), sweep(scattered=True, path=path)
    assert_close(first.time, table.time[:2], rtol=case.rtol)
    assert np.array_equal(first.time, again.time)
    assert set(sweep(max_steps=3).status) == {"failed"}


@of_own_modes
def test_the_last_crossing_is_that_after_which_the_event_function_stays_below_zero(case, table):
    time = nonholonomic.event_time(case.system, case.start, case.t1, case.event, 1e-8, crossing="last")
    if case.once:
        assert_close(time, table.time[1], rtol=1e-8)
    else:
        assert table.time[1] < time < case.t1


@of_own_modes
def test_parameters_are_found_in_recordings_and_times(case):
    # The bounds keep a ball from landing again and again without end.
    free = {case.parameter: nonholonomic.Free(1.01 * case.value, 0.5 * case.value, 2.0 * case.value)}
    times = np.linspace(0.05, 0.7, 14)
    value = np.asarray(nonholonomic.simulate(case.system, case.start, 0.7, times=times)[case.quantity])
    error = 1e-4 * max(np.ptp(value), 1e-3)
    data = nonholonomic.Recording(case.start, times, value, error=error, quantity=case.quantity)
    fit = nonholonomic.identify(case.system, data, free, starts=2, progress=False)
    assert_close(next(iter(fit.estimates.values())), case.value, rtol=1e-4)
    draws = sample(nonholonomic.log_density(case.system, data, free), draws=200, progress=False)
    name, value = next(iter(draws.values.items()))
    assert_close(
        np.quantile(value, [0.025, 0.975]), fit.interval(name), atol=0.3 * np.ptp(fit.interval(name)), rtol=0.0
    )
    time = float(nonholonomic.event_time(case.system, case.start, case.t1, event=case.event))
    data = nonholonomic.EventTimes(case.start, [time], error=1e-5, t1=case.t1, event=case.event)
    fit = nonholonomic.identify(case.system, data, free, starts=2, progress=False)
    assert_close(next(iter(fit.estimates.values())), case.value, rtol=1e-3)


@of_own_modes
def test_runs_have_a_lyapunov_exponent(case):
    result = nonholonomic.lyapunov_exponent(case.system, case.start, case.t1, tolerance=1e-7)
    assert np.isfinite(result.exponent)
    assert str(result.status) == "completed"
    spectrum = nonholonomic.lyapunov_spectrum(case.system, case.start, case.t1, n=1, tolerance=1e-7)
    assert_close(spectrum.exponents, result.exponent, rtol=1e-9)


@of_own_modes
def test_what_runs_settle_to(case):
    axes = {case.parameter: case.value * np.array([1.0, 1.01])}
    options = dict(axes=axes, quantities=[case.quantity], progress=False)
    table = nonholonomic.basins(case.system, case.start, case.t1, **options)
    assert set(table.attractor.tolist()) <= {0, 1, 2}
    assert (table[f"{case.quantity}_min"] <= table[f"{case.quantity}_max"]).all()
    diagram = nonholonomic.bifurcation(case.system, case.start, case.t1, case.event, 1, 0, **options)
    assert diagram[case.quantity].shape == (2, 1)


@of_own_modes
def test_runs_are_drawn_and_explored(case, tmp_path):
    path = tmp_path / "page.html"
    sliders = {case.parameter: (0.9 * case.value, 1.1 * case.value)}
    nonholonomic.explore(case.system, case.start, path, sliders=sliders, t1=0.5)
    assert "range" in path.read_text()
    nonholonomic.simulate(case.system, case.start, 0.5, tolerance=1e-7).view(path)
    assert "three" in path.read_text()


class EnergyBelow(eqx.Module):
    level: float

    def __call__(self, t, motion):
        return motion.energy - self.level


@pytest.mark.parametrize("name", ["top", "stroller"])
def test_the_parameters_of_an_event_have_names(name):
    model = model_of(CASES[name].system, CASES[name].start, EnergyBelow(0.04))
    full_name = model.full_name("axes", "event.level")
    assert model.full_name("sensitivities", "level") == full_name
    assert float(model.replaced({full_name: 0.05}).value(full_name)) == 0.05
