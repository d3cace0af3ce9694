"""Films of tops with several modes: the runs of all rows are lanes of one program."""

import numpy as np
import pytest
from close import assert_close
from tops import rutstam_top

import tippe


@pytest.mark.parametrize(
    ("law", "options", "launch", "t1", "counter"),
    [
        pytest.param(tippe.Viscous, {"contact": "hybrid"}, (0.1, 180.0), 6.0, "hops", id="hops"),
        pytest.param(tippe.SetValuedCoulomb, {}, (0.35, 100.0), 0.4, "sticks", id="sticks", marks=pytest.mark.slow),
    ],
)
def test_rows_of_a_film_are_the_runs_one_by_one_and_illegal_rows_have_no_prediction(law, options, launch, t1, counter):
    theta, spin = launch
    clock = np.linspace(0.2 * t1, t1, 8)
    scene = tippe.Scene(rutstam_top(), friction=law(0.3), **options)
    film = tippe.Recording(tippe.Launch(theta, spin), clock, np.ones(8), 0.02, "theta", t0=0.05)
    model = tippe.log_density(scene, film, {"mu": 0.3, "launch.spin": spin}, tolerance=1e-9).problem.model
    rows = {"scene.friction.mu": [0.3, 0.31, -1.0, np.nan], "launch.spin": [spin, 1.02 * spin, spin, spin]}
    predictions = model(rows)
    assert predictions.shape == (4, 8)
    assert np.all(np.isnan(predictions[2:]))
    count = 0
    for mu, spin, row in zip(rows["scene.friction.mu"][:2], rows["launch.spin"][:2], predictions, strict=False):
        top = tippe.Scene(rutstam_top(), friction=law(mu), **options)
        run = tippe.simulate(top, tippe.Launch(theta, spin), t1, tolerance=1e-9)
        count += len(run.hops) if counter == "hops" else run.stats["sticks"]
        assert_close(row, run.at(clock - 0.05).theta, atol=1e-5)
    assert count > 0
