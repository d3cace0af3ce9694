"""Films of tops that hop: the runs of all rows are lanes of one program."""

import numpy as np
from close import assert_close
from tops import rutstam_top

import tippe


def test_rows_of_a_film_are_the_runs_one_by_one_and_illegal_rows_have_no_prediction():
    scene = tippe.Scene(rutstam_top(), friction=tippe.Viscous(0.3), contact="hybrid")
    clock = np.linspace(1.0, 6.0, 8)
    film = tippe.Recording(tippe.Launch(0.1, 180.0), clock, np.ones(8), 0.02, "theta", t0=0.05)
    model = tippe.log_density(scene, film, {"mu": 0.3, "launch.spin": 180.0}, tolerance=1e-9).problem.model
    rows = {"scene.friction.mu": [0.3, 0.31, -1.0, np.nan], "launch.spin": [180.0, 185.0, 180.0, 180.0]}
    predictions = model(rows)
    assert predictions.shape == (4, 8)
    assert np.all(np.isnan(predictions[2:]))
    hops = 0
    for mu, spin, row in zip(rows["scene.friction.mu"][:2], rows["launch.spin"][:2], predictions, strict=False):
        top = tippe.Scene(rutstam_top(), friction=tippe.Viscous(mu), contact="hybrid")
        run = tippe.simulate(top, tippe.Launch(0.1, spin), 5.95, tolerance=1e-9)
        hops += len(run.hops)
        assert_close(row, run.at(clock - 0.05).theta, atol=1e-5)
    assert hops > 0
