"""Several ways to one number: a table, a single time, a batch of times under `jit`, a single run and a batch of runs with their
paths, and the same scene with `contact="hybrid"`. They share the equations, and little of the code around them."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from random_scenes import SMOOTH, Batch, batch

import tippe
from nonholonomic.parameters import with_numbers
from tippe.runs.cells import InversionRuns
from tippe.runs.run_kind import run_kind_of
from tippe.runs.time_error import errors_of, second_tolerance

ANGLE, TOLERANCE, T1 = 0.95 * np.pi, 1e-9, 8.0

#: Of runs with their path, whose frame does not turn with the top, so that they err more at the same tolerance.
OF_PATHS = second_tolerance(TOLERANCE)

#: Error bounds of a table by which another road may differ, which has an error of its own.
APART = 2.0


def table_of(scenes: Batch, count: int) -> dict[str, np.ndarray]:
    """What a table of these scenes has, with errors, and the status in words."""
    kind = run_kind_of(scenes.scene)
    runs = InversionRuns(kind, T1, ANGLE, "first", None, "ensemble", [])
    roots = {"scene": scenes.scene, "launch": scenes.launch}
    first, second = (
        runs.results(roots, scenes.columns, tolerance, count) for tolerance in (TOLERANCE, second_tolerance(TOLERANCE))
    )
    words = np.array(kind.words)[first["status"]]
    return first | errors_of(first, second, ("time",), kind.counts, (3, 6)) | {"word": words}


def scene_and_launch(scenes: Batch, cell: int) -> tuple[tippe.Scene, tippe.Launch]:
    """One of the scenes."""
    numbers = {name: jnp.asarray(values[cell]) for name, values in scenes.columns.items()}
    roots = with_numbers({"scene": scenes.scene, "launch": scenes.launch}, numbers)
    return roots["scene"], roots["launch"]


def batch_of_times(scenes: Batch) -> np.ndarray:
    """The times of all scenes by `jit` of `vmap`."""

    @jax.jit
    @jax.vmap
    def times(columns):
        roots = with_numbers({"scene": scenes.scene, "launch": scenes.launch}, columns)
        return tippe.inversion_time(roots["scene"], roots["launch"], T1, ANGLE, TOLERANCE)

    return np.asarray(times({name: jnp.asarray(values) for name, values in scenes.columns.items()}))


def batch_of_angles(scenes: Batch, ends: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Angle at a time of its own in each scene, end and code of the status of the runs, by `jit` of `vmap` of `simulate`."""

    @jax.jit
    @jax.vmap
    def angles(columns, end):
        roots = with_numbers({"scene": scenes.scene, "launch": scenes.launch}, columns)
        run = tippe.simulate(roots["scene"], roots["launch"], T1, end[None], OF_PATHS)
        return run.theta[0], run.end_time, run.status

    columns = {name: jnp.asarray(values) for name, values in scenes.columns.items()}
    return tuple(np.asarray(part) for part in angles(columns, jnp.asarray(ends)))


def compare_roads(kind: str, count: int, singles: int) -> int:
    """Compare the roads through random scenes of a kind; returns how many of them a table has an answer of, with an error."""
    scenes = batch(kind, count, seed=5)
    table = table_of(scenes, count)
    known = (table["status_error"] == 0) & (table["time_error"] < 1e-3) & (table["end_time_error"] < 1e-3)
    inverted = table["word"] == "inverted"
    doubt = APART * np.where(inverted, table["time_error"], 0.0)

    times = batch_of_times(scenes)
    assert (np.isfinite(times) == inverted)[known].all()
    agree = known & inverted
    assert (np.abs(times[agree] - table["time"][agree]) <= doubt[agree]).all()

    # Just before the run's end in the table, where each run still is.
    ends = table["end_time"] * (1.0 - 1e-6)
    theta, end, status = batch_of_angles(scenes, ends)
    lost = table["word"] == "contact_lost"
    stops = known & lost
    assert (status[stops] == 1).all()
    assert (np.abs(end - table["end_time"])[stops] <= APART * table["end_time_error"][stops]).all()
    # Near the end theta changes at a rate below the spin's.
    near = 1e-6 * T1 * 400.0 + APART * (table["end_theta_error"] + 400.0 * table["end_time_error"])
    assert (np.abs(theta - table["end_theta"])[known] <= near[known]).all()

    for cell in np.flatnonzero(known)[:singles]:
        scene, launch = scene_and_launch(scenes, cell)
        time = float(tippe.inversion_time(scene, launch, T1, ANGLE, TOLERANCE))
        assert np.isfinite(time) == inverted[cell]
        run = tippe.simulate(scene, launch, T1, tolerance=OF_PATHS)
        if not inverted[cell]:
            assert (run.status == "contact_lost") == lost[cell]
        if inverted[cell]:
            assert abs(time - table["time"][cell]) <= doubt[cell]
            rate = np.interp(time, run.t, run.theta_rate)
            assert abs(float(run.at([time]).theta[0]) - ANGLE) <= 1e-7 + APART * abs(rate) * table["time_error"][cell]
        if lost[cell]:
            assert abs(float(run.end_time) - table["end_time"][cell]) <= APART * table["end_time_error"][cell]
    return int(known.sum())


def test_all_roads_lead_to_the_same_answer():
    """The short form: 24 tops on the plane, of which two run by themselves as well."""
    assert compare_roads("plane-viscous-stop", 24, 2) > 20


@pytest.mark.slow
@pytest.mark.parametrize("kind", SMOOTH)
def test_all_roads_lead_to_the_same_answer_on_every_arena_and_under_every_law(kind):
    """600 scenes in all, by five roads each; eight of each kind run by themselves."""
    assert compare_roads(kind, 50, 8) > 40


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["plane-viscous-stop", "cylinder-viscous-stop", "sphere-viscous-stop"])
def test_a_top_that_keeps_contact_inverts_alike_whether_or_not_it_may_fly(kind):
    """150 scenes: the same status and time where no flight was on the way, from every azimuth and place."""
    scenes = batch(kind, 50, seed=5)
    scene = scenes.scene
    hybrid = tippe.Scene(scene.body, scene.surface, scene.friction, contact="hybrid")
    stops, flies = table_of(scenes, 50), table_of(scenes._replace(scene=hybrid), 50)
    kept = (stops["status_error"] == 0) & (flies["status_error"] == 0) & (stops["word"] != "contact_lost")
    kept &= flies["hops"] == 0
    assert kept.sum() > 20
    assert (stops["word"] == flies["word"])[kept].all()
    inverted = kept & (stops["word"] == "inverted")
    difference = np.abs(stops["time"][inverted] - flies["time"][inverted])
    assert (difference <= APART * (stops["time_error"] + flies["time_error"])[inverted]).all()
    # What lost its contact in one flies in the other.
    lost = (stops["word"] == "contact_lost") & (stops["status_error"] == 0)
    assert (flies["hops"] > 0)[lost & (flies["end_time"] > stops["end_time"])].all()
