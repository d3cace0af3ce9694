"""What is read off a run costs a compilation for some numbers of times, not for every run."""

import logging

import numpy as np
from close import assert_close

import tippe


def test_another_launch_compiles_next_to_nothing(rutstam_scene, caplog):
    """Every run has another number of steps; the first one compiles for all that are alike."""
    for theta in (0.1, 0.11, 0.12):
        caplog.clear()
        with caplog.at_level(logging.DEBUG, "jax._src.dispatch"):
            run = tippe.simulate(rutstam_scene, tippe.Launch(theta, 155.0), 1.0)
            assert np.isfinite(run.theta).all()
            str(run), run.position, run.slip
    assert sum("Finished XLA compilation" in message for message in caplog.messages) < 3
    assert run.theta.shape == run.t.shape


def test_padding_changes_nothing(rutstam_scene):
    """Three times and all that surround them: the same numbers."""
    times = np.linspace(0.0, 1.0, 7)
    run = tippe.simulate(rutstam_scene, tippe.Launch(0.1, 155.0), 1.0)
    first_run, full_run = run.at(times[:3]), run.at(times)
    for name in ("theta", "energy", "position", "axis", "slip", "normal_force"):
        assert_close(getattr(first_run, name), getattr(full_run, name)[:3], rtol=1e-14, atol=1e-16)
