"""The error estimate of a table's times: against references, near the threshold, and as digits."""

import numpy as np
import pytest
from close import assert_close
from lagrange_top import inversion
from random_scenes import IN_PHASES, SMOOTH, batch
from tops import rutstam_top

import tippe
from nonholonomic.integration import Settings
from nonholonomic.runs.table import WORDS, TableJob
from nonholonomic.sweeps.table import (
    FINER,
    SAFETY,
    SAFETY_OF_HISTORIES,
    concise,
    error_bound,
    errors_of,
    other_tolerances,
)
from tippe import steady
from tippe.runs.model import INVERSIONS, TopModel

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


@pytest.mark.parametrize("factor", [1.01, pytest.param(1.2, marks=pytest.mark.slow)])
def test_the_estimate_covers_the_error_near_the_threshold(near_threshold, factor):
    """Above the true error, below thirty times of it (five is due)."""
    cell = int(np.flatnonzero(factor == FACTORS)[0])
    status, time = reference(factor)
    assert status == "inverted"
    error = abs(near_threshold.time[cell] - time)
    assert error < near_threshold.time_error[cell] < 30.0 * error


@pytest.mark.slow
def test_the_estimate_covers_the_error_in_every_cell_through_the_threshold(near_threshold):
    for factor, time, status, estimate in zip(
        FACTORS, near_threshold.time, near_threshold.status, near_threshold.time_error, strict=True
    ):
        known_status, known_times = reference(factor)
        assert known_status == status
        if status == "inverted":
            assert abs(time - known_times) < estimate < 30.0 * abs(time - known_times)


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
    table_without_errors = tippe.inversion_table(
        SCENE, theta=0.1, spin=threshold_spins(FACTORS), t1=40.0, angle=ANGLE, tolerance=1e-8
    )
    assert list(table_without_errors.variables) == [
        name for name in near_threshold.variables if not name.endswith("_error")
    ]
    for name, values in table_without_errors.variables.items():
        assert (values == near_threshold.variables[name]).all()
    with pytest.raises(ValueError, match="the table has no 'time_error'"):
        table_without_errors.digits("time")
    with pytest.raises(ValueError, match="the table has no 'weight'"):
        near_threshold.digits("weight")


def test_a_cell_on_which_the_runs_disagree_is_in_doubt():
    """A horizon between the two runs' times of one cell: the fine one has just not inverted, or just has."""
    arguments = {"theta": 0.1, "spin": [100.0, 110.0], "t1": 20.0, "tolerance": 1e-6}
    first = tippe.inversion_table(SCENE, **arguments)
    second = tippe.inversion_table(SCENE, **arguments | {"tolerance": 1e-6 / FINER})
    middle = 0.5 * float(first.time[0] + second.time[0])
    assert abs(first.time[0] - second.time[0]) > 1e-8
    table = tippe.inversion_table(SCENE, **arguments | {"t1": middle}, errors=True)
    assert np.isinf([table.time_error[0], table.end_time_error[0], table.end_theta_error[0]]).all()
    assert table.status_error.tolist() == [1, 0]
    assert table.digits()[0] == table.status[0] + "?"
    assert np.isfinite(table.time_error[1])
    assert_close(table.time[1], first.time[1], rtol=1e-12)


def test_bound_of_two_runs():
    """A multiple of the difference, greater after different histories; nothing to doubt where both have no time; everything
    where they disagree; and no number is known better than to its round-off. A third run counts, and the bound is greater if
    it differs from the second as much as from the first."""
    time, second = np.array([5.0, 5.0, np.inf, 5.0, np.inf, 0.0]), np.array([5.25, 5.25, np.inf, np.inf, np.inf, 0.0])
    agree, same = np.array([True, True, True, True, False, True]), np.array([True, False, True, True, True, True])
    expected = [0.25 * SAFETY, 0.25 * SAFETY_OF_HISTORIES, 0.0, np.inf, np.inf, 0.0]
    assert error_bound(np.stack([time, second]), agree, same).tolist() == expected
    third = np.array([[5.0] * 5, [5.25, 5.0, 5.01, 5.25, 5.0], [5.25, 5.0, 5.25, 5.0, np.inf]])
    yes = np.ones(5, bool)
    ratio = [SAFETY, 0.0, SAFETY_OF_HISTORIES, SAFETY_OF_HISTORIES]
    assert error_bound(third, yes, yes).tolist() == [*np.maximum(0.25 * np.array(ratio), 5e-14), np.inf]


@pytest.mark.parametrize(
    ("tolerance", "others"),
    [
        (1e-9, [1e-11, 1e-13]),
        (1e-11, [1e-13, 1e-14]),
        (1e-12, [1e-14]),
        (3e-13, [3e-11]),
        (1e-14, [1e-12]),
        (1e-2, [1e-4, 1e-6]),
    ],
)
def test_the_other_tolerances_can_be_integrated_with(tolerance, others):
    assert other_tolerances(tolerance) == pytest.approx(others, rel=1e-12)
    assert min(other_tolerances(tolerance)) >= 1e-14


@pytest.mark.slow
def test_a_hop_is_no_reason_for_a_lesser_error():
    """A top that flies: 6e-9 s off at the default tolerance, by the same top at 1e-13; the bound says so, and so do those of
    the end and the number of flights."""
    scene = tippe.Scene(rutstam_top(), tippe.Plane(), tippe.Viscous(0.3), contact="hybrid")
    table = tippe.inversion_table(scene, theta=0.1, spin=155.0, t1=8.0, errors=True)
    error = abs(float(table.time) - 5.96933253895)
    assert 1e-9 < error < float(table.time_error) < 30.0 * error
    assert_close(table.end_time_error, table.time_error, rtol=1e-3)
    assert 0.0 < float(table.end_theta_error) < 1e-7
    assert (table.hops_error, table.status_error) == (0, 0)


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
    words = WORDS

    def results(runs, *_):
        ends = {"end_time": np.ones(len(words)), "end_theta": np.ones(len(words)), "hops": np.zeros(len(words), int)}
        times = {name: np.full(len(words), np.inf) for name in runs.times}
        return times | ends | {"status": np.arange(len(words), dtype=np.int8)}

    monkeypatch.setattr(TableJob, "_results", results)
    model = TopModel.timed(scene, tippe.Launch(0.1, 100.0), ANGLE)
    outcome = TableJob(model, INVERSIONS, 1.0, "both", Settings(1e-9), errors=True)({}, len(words))
    for name in ("first_time", "last_time"):
        is_doubtful = np.isinf(outcome[f"{name}_error"])
        assert {word for word, doubt in zip(words, is_doubtful, strict=True) if doubt} == {"failed", "unresolved"}
    last = words.index("unresolved")
    assert concise(outcome["last_time"][last], outcome["last_time_error"][last], words[last]) == "unresolved?"


def test_the_file_keeps_the_errors(tmp_path):
    """A table with errors resumes as itself, and not as one without."""
    arguments = {"theta": [0.1, 0.2], "spin": 155.0, "t1": 8.0, "path": tmp_path / "table.h5"}
    table = tippe.inversion_table(SCENE, **arguments, errors=True)
    assert (tippe.Table.load(arguments["path"]).digits() == table.digits()).all()
    with pytest.raises(ValueError, match="errors"):
        tippe.inversion_table(SCENE, **arguments)


# Statistics over random scenes


def runs_of(kind, count, tolerances):
    """The variables of random scenes of a kind (`random_scenes.py`) at each tolerance, and how many things are counted."""
    scene, launch, columns = batch(kind, count)
    model = TopModel.timed(scene, launch, 0.95 * np.pi)

    def results(tolerance):
        return TableJob(model, INVERSIONS, 8.0, "first", Settings(tolerance))(columns, count)

    return {tolerance: results(tolerance) for tolerance in tolerances}, tuple(model.counters)


def judged(first, *others, true, counts):
    """How many times a table with errors has, how many err by more than the bound, for how many the bound is more than 30
    times the error, and how many cells have a wrong status of which nothing is said."""
    bounds = errors_of([first, *others], dict.fromkeys(("time", "end_time", "end_theta"), 0.0), counts, (3, 6))
    finite = np.isfinite(first["time"]) & np.isfinite(true["time"]) & np.isfinite(bounds["time_error"])
    bound = bounds["time_error"][finite]
    error = np.abs(first["time"][finite] - true["time"][finite])
    # The reference has its own round-off.
    error = np.maximum(error - 1e-13 * true["time"][finite], 0.0)
    is_unseen = (first["status"] != true["status"]) & (bounds["status_error"] == 0)
    return np.array([finite.sum(), (error > bound).sum(), (bound > 30.0 * (error + 1e-13)).sum(), is_unseen.sum()])


@pytest.mark.slow
def test_the_bound_holds_in_random_scenes():
    """The short form of the study below: 200 tops on the plane, of which fifty invert."""
    runs, counts = runs_of("plane-viscous-stop", 200, (1e-8, 1e-10, 1e-12, 1e-13))
    *of_table, true = runs.values()
    cells, below_bound, far_above, is_unseen = judged(*of_table, true=true, counts=counts)
    assert cells > 30
    assert (below_bound, is_unseen) == (0, 0)
    assert far_above <= 0.1 * cells


@pytest.mark.slow
def test_the_bound_holds_in_random_scenes_of_all_kinds():
    """4500 scenes on eight arenas under five laws, against a run that is none of the table's, at 1e-13 or 1e-14."""
    tolerances = [10.0**-k for k in range(6, 15)]
    total = {tolerance: np.zeros(4, int) for tolerance in tolerances[:-4]}
    for kind in (*SMOOTH, *IN_PHASES):
        runs, counts = runs_of(kind, 300, tolerances)
        for k, tolerance in enumerate(tolerances[:-4]):
            of_table = [runs[tolerances[j]] for j in (k, k + 2, k + 4)]
            true = runs[tolerances[-1 if k + 4 == len(tolerances) - 2 else -2]]
            total[tolerance] += judged(*of_table, true=true, counts=counts)
    for tolerance, (cells, below_bound, far_above, is_unseen) in total.items():
        print(f"{tolerance:.0e}: {cells} times, {below_bound} below, {far_above} far above, {is_unseen} unseen")
        assert cells > 1000
        assert below_bound <= 0.003 * cells
        assert far_above <= 0.1 * cells
        assert is_unseen <= 0.003 * cells
