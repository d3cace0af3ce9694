"""The error estimate of a table's times: against references, near the threshold, and as digits."""

import jax.numpy as jnp
import numpy as np
import pytest
from close import assert_close
from lagrange_top import inversion
from tops import rutstam_top

import tippe
from nonholonomic.integration import Settings, solve_ensemble
from nonholonomic.sweeps.digits import concise, concise_strings
from tippe import steady
from tippe.modes.inversion_problem import InversionProblem
from tippe.runs.cells import InversionRuns, run_kind_of
from tippe.runs.inversion import is_inverted
from tippe.runs.table import InversionJob
from tippe.runs.time_error import COARSER, time_error

SCENE = tippe.Scene(rutstam_top(), tippe.Plane(), tippe.Viscous(0.3))
ANGLE = np.pi - 0.1

#: Jellett's constant of launches from theta(0) = 0.1 over that of the threshold, and the times to pi - 0.1 (`tippe.md`, 8).
FACTORS = np.array([0.9, 0.95, 0.99, 1.0005, 1.001, 1.003, 1.005, 1.01, 1.02, 1.03, 1.05, 1.1, 1.2])
KNOWN = np.array([np.inf] * 3 + [21.78, 20.24, 16.62, 14.72, 12.30, 10.31, 9.39, 8.44, 7.49, 6.83])


def threshold_spins(factors):
    """Spins at which launches from theta(0) = 0.1 have these multiples of the threshold's Jellett constant."""
    body = SCENE.body
    _, threshold = steady.jellett_thresholds(SCENE)
    return factors * float(threshold / (body.I3 * (body.radius * np.cos(0.1) - body.offset)))


@pytest.fixture(scope="module")
def near_threshold() -> tippe.Table:
    return tippe.inversion_table(
        SCENE, theta=0.1, spin=threshold_spins(FACTORS), t1=40.0, angle=ANGLE, tolerance=1e-8, errors=True
    )


def reference(factor):
    """The time to `ANGLE` by Lagrange's equations, NumPy and SciPy."""
    body = SCENE.body
    numbers = {name: float(getattr(body, name)) for name in ("mass", "radius", "offset", "I1", "I3")}
    spin = float(threshold_spins(factor))
    status, time, _ = inversion(numbers | {"theta": 0.1, "spin": spin, "mu": 0.3}, 40.0, ANGLE, 1e-13)
    return status, time


def test_times_through_the_threshold(near_threshold):
    """The known times, growing as the logarithm of the distance; below the threshold the top never inverts."""
    assert near_threshold.status.tolist() == ["not_inverted"] * 3 + ["inverted"] * 10
    assert_close(near_threshold.time[3:], KNOWN[3:], atol=6e-3)
    assert (near_threshold.time_error[:3] == 0.0).all()


@pytest.mark.parametrize("factor", [1.01, 1.2])
def test_the_estimate_covers_the_error_near_the_threshold(near_threshold, factor):
    """Above the true error, below a hundred times of it (twenty is due)."""
    cell = int(np.flatnonzero(factor == FACTORS)[0])
    status, time = reference(factor)
    assert status == "inverted"
    error = abs(near_threshold.time[cell] - time)
    assert error < near_threshold.time_error[cell] < 100.0 * error


@pytest.mark.slow
def test_the_estimate_covers_the_error_in_every_cell_through_the_threshold(near_threshold):
    for factor, time, status, estimate in zip(
        FACTORS, near_threshold.time, near_threshold.status, near_threshold.time_error, strict=True
    ):
        known_status, known = reference(factor)
        assert known_status == status
        if status == "inverted":
            assert abs(time - known) < estimate < 100.0 * abs(time - known)


def test_digits_of_a_table(near_threshold):
    """As many as the error leaves; the status where there is no time."""
    texts = near_threshold.digits("time")
    assert texts.shape == near_threshold.shape
    assert texts[:3].tolist() == ["not_inverted"] * 3
    for text, time, error in zip(texts[3:], near_threshold.time[3:], near_threshold.time_error[3:], strict=True):
        number, digit = text.rstrip(")").split("(")
        unit = 10.0 ** -len(number.split(".")[1])
        assert abs(float(number) - time) <= 0.5 * unit * (1.0 + 1e-9)
        assert (int(digit) - 1) * unit < error <= int(digit) * unit
    # The nearer to the threshold, the greater the error.
    assert near_threshold.time_error[3] > near_threshold.time_error[-1]


def test_the_rest_of_the_table_is_that_without_errors(near_threshold):
    plain = tippe.inversion_table(SCENE, theta=0.1, spin=threshold_spins(FACTORS), t1=40.0, angle=ANGLE, tolerance=1e-8)
    assert list(plain.variables) == [name for name in near_threshold.variables if name != "time_error"]
    for name, values in plain.variables.items():
        assert (values == near_threshold.variables[name]).all()
    with pytest.raises(ValueError, match="the table has no 'time_error'"):
        plain.digits("time")
    with pytest.raises(ValueError, match="the table has no 'weight'"):
        near_threshold.digits("weight")


def test_a_cell_on_which_the_runs_disagree_is_in_doubt():
    """A horizon between the two runs' times of one cell: the fine one has just not inverted, or just has."""
    arguments = {"theta": 0.1, "spin": [100.0, 110.0], "t1": 20.0, "tolerance": 1e-8}
    fine = tippe.inversion_table(SCENE, **arguments)
    coarse = tippe.inversion_table(SCENE, **arguments | {"tolerance": 1e-8 * COARSER})
    middle = 0.5 * float(fine.time[0] + coarse.time[0])
    assert abs(fine.time[0] - coarse.time[0]) > 1e-8
    table = tippe.inversion_table(SCENE, **arguments | {"t1": middle}, errors=True)
    assert np.isinf(table.time_error[0])
    assert table.digits()[0] == table.status[0] + "?"
    assert np.isfinite(table.time_error[1])
    assert_close(table.time[1], fine.time[1], rtol=1e-12)


def test_estimate_of_two_runs():
    """Twice the difference; nothing to doubt where both have no time; everything where they disagree."""
    time, coarse = np.array([5.0, np.inf, 5.0, np.inf, 0.0]), np.array([5.25, np.inf, np.inf, np.inf, 0.0])
    found = time_error(time, coarse, np.array([True, True, False, False, True]))
    assert found.tolist() == [0.5, 0.0, np.inf, np.inf, 0.0]


CONCISE = [
    (5.0114234, 3e-5, "5.01142(3)"),
    (5.0114234, 3.01e-5, "5.01142(4)"),
    (5.0114234, 9.9e-5, "5.0114(1)"),
    (12.996, 0.02, "13.00(2)"),
    (123.4, 20.0, "120(20)"),
    (5.0, 7.0, "5(7)"),
    (5.4, 0.95, "5(1)"),
    (0.0, 0.0, "0.0"),
    (-0.0123, 1e-3, "-0.012(1)"),
]


@pytest.mark.parametrize(("value", "error", "text"), CONCISE)
def test_concise_notation(value, error, text):
    assert concise(value, error) == text


def test_a_cell_that_fails_is_in_doubt():
    """A field that is no number fails in both runs, and nothing is known of its time."""
    table = tippe.inversion_table(SCENE, theta=0.1, spin=[1e200, 100.0], t1=0.1, errors=True)
    assert np.isinf(table.time_error[0])
    assert table.digits().tolist() == ["failed?", "not_inverted"]


def test_agreement_on_no_answer_is_no_agreement(monkeypatch):
    """Two runs that both failed, or both were given up, do not make it certain that there is no time."""
    scene = tippe.Scene(rutstam_top(), tippe.Plane(), tippe.Viscous(0.3), contact="hybrid")
    words = run_kind_of(scene).words

    def results(runs, *_):
        times = {name: np.full(len(words), np.inf) for name in runs.times}
        return times | {"status": np.arange(len(words), dtype=np.int8)}

    monkeypatch.setattr(InversionRuns, "results", results)
    runs = InversionRuns(run_kind_of(scene), 1.0, ANGLE, "both", None, "ensemble", [])
    found = InversionJob(runs, {"scene": scene}, 1e-9, errors=True)({}, len(words))
    for name in ("first_time", "last_time"):
        doubtful = np.isinf(found[f"{name}_error"])
        assert {word for word, doubt in zip(words, doubtful, strict=True) if doubt} == {"failed", "unresolved"}
    assert concise_strings(found["last_time"], found["last_time_error"], np.array(words))[-1] == "unresolved?"


def test_the_file_keeps_the_errors(tmp_path):
    """A table with errors resumes as itself, and not as one without."""
    arguments = {"theta": [0.1, 0.2], "spin": 155.0, "t1": 8.0, "path": tmp_path / "table.h5"}
    table = tippe.inversion_table(SCENE, **arguments, errors=True)
    assert (tippe.Table.load(arguments["path"]).digits() == table.digits()).all()
    with pytest.raises(ValueError, match="errors"):
        tippe.inversion_table(SCENE, **arguments)


# Statistics over random scenes


def random_scenes(random, count, surface, law):
    """Scenes and launches as in `make_inversion_reference.py`, one number per cell."""
    mass, R = random.uniform(0.005, 0.05, count), random.uniform(0.015, 0.03, count)
    a, I3 = R * random.uniform(0.1, 0.35, count), mass * R * R * random.uniform(0.3, 0.45, count)
    I1, theta, mu = (
        I3 * random.uniform(0.9, 1.1, count),
        random.uniform(0.05, 0.5, count),
        random.uniform(0.1, 0.5, count),
    )
    alpha, gamma = a / R, I1 / I3
    threshold = R * np.sqrt(mass * 9.81 * a * I3 * (1 + alpha) ** 4 / np.maximum(1 + alpha - gamma, 1e-3))
    spin = threshold / (I3 * (R * np.cos(theta) - a)) * random.uniform(0.5, 3.0, count)
    arena = {"plane": tippe.Plane, "cylinder": tippe.Cylinder, "sphere": tippe.Sphere}[surface]
    arena = arena() if surface == "plane" else arena(R * random.uniform(5.0, 30.0, count))
    friction = tippe.Viscous(mu) if law == "viscous" else tippe.Coulomb(mu, random.uniform(0.02, 0.2, count))
    eta = np.zeros(count) if surface == "plane" else random.uniform(-1.0, 1.0, count)
    launch = tippe.Launch(theta, np.minimum(spin, 400.0), eta, random.uniform(-np.pi, np.pi, count))
    return tippe.Scene(tippe.Top(mass, R, a, I1, I3), arena, friction), launch


def times(scene, launch, tolerance, crossing, t1=12.0):
    """Times and codes of every cell at one tolerance."""
    cells = launch.theta.size
    problem = InversionProblem.of(scene, launch, 0.95 * np.pi, cells)
    given = (problem, jnp.asarray(t1), jnp.asarray(cells), Settings(tolerance))
    outcome, _ = solve_ensemble(*given, passes=crossing == "last")
    inverted = np.asarray(is_inverted(outcome, problem, crossing == "last"))
    return np.where(inverted, outcome.crossing_time, np.inf), np.where(inverted, -1, outcome.status)


KINDS = [
    ("plane", "viscous"),
    ("plane", "Coulomb"),
    ("cylinder", "viscous"),
    ("cylinder", "Coulomb"),
    ("sphere", "viscous"),
]


@pytest.mark.slow
@pytest.mark.parametrize("crossing", ["first", "last"])
def test_the_estimate_over_random_scenes(crossing):
    """Of about 500 times, against 1e-13: how many errors exceed the estimate, and how many are below a hundredth of it.

    Measured: 0.4 % and 2.1 % at 1e-10, 2.6 % and 2.5 % at 1e-9, 2.3 % and 8.9 % at 1e-8, 3.3 % and 33 % at 1e-7 (first
    crossings; the last ones are much alike). Some of the first kind are short excursions past the angle over which both runs
    step: then the error is that of a whole nutation.
    """
    found = {}
    for number, (surface, law) in enumerate(KINDS):
        scene, launch = random_scenes(np.random.default_rng((7, number)), 400, surface, law)
        true, true_status = times(scene, launch, 1e-13, crossing)
        runs = {tolerance: times(scene, launch, tolerance, crossing) for tolerance in (1e-10, 1e-9, 1e-8, 1e-7, 1e-6)}
        for tolerance in (1e-10, 1e-9, 1e-8, 1e-7):
            (time, status), (coarse, coarse_status) = runs[tolerance], runs[tolerance * COARSER]
            estimate = time_error(time, coarse, status == coarse_status)
            inverted = np.isfinite(time) & np.isfinite(true)
            error = np.abs(np.where(inverted, time, 0.0) - np.where(inverted, true, 0.0))
            both = inverted & np.isfinite(estimate)
            below, far_above = both & (error > estimate), both & (estimate > 100.0 * error)
            unseen = (status != true_status) & np.isfinite(estimate)
            counts = np.array([both.sum(), below.sum(), far_above.sum(), unseen.sum()])
            found[tolerance] = found.get(tolerance, 0) + counts
    most = {1e-10: (0.015, 0.04), 1e-9: (0.04, 0.05), 1e-8: (0.06, 0.12), 1e-7: (0.06, 0.45)}
    for tolerance, (cells, below, far_above, unseen) in found.items():
        assert cells > 400
        assert below <= most[tolerance][0] * cells
        assert far_above <= most[tolerance][1] * cells
        assert unseen <= 0.005 * cells
