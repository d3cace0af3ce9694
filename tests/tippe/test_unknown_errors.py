"""Recordings of angles, and recordings whose errors are unknown."""

import jax.numpy as jnp
import numpy as np
import pytest
from never_run import LAUNCH, density_of_a_film

import tippe
from nonholonomic.identification import Draws

pytestmark = pytest.mark.oldest

FILM = {"launch": LAUNCH, "times": [0.0, 0.1, 0.2]}


def test_a_recorded_angle_in_degrees_is_refused():
    with pytest.raises(
        ValueError, match=r"theta = 5\.7 at 0 s \(sample 1\) must be, .*between 0 and pi rad.*degrees\?"
    ):
        tippe.Recording(value=[5.7, np.nan, 6.1], error=None, **FILM)
    with pytest.raises(ValueError, match=r"theta = 4 at 0\.1 s \(sample 2\) must be, .*between 0 and pi rad"):
        tippe.Recording(value=[[0.0, 3.1], [0.0, 4.0], [0.0, 3.0]], error=0.01, quantity=("azimuth", "theta"), **FILM)
    # What the errors explain passes, and so do the columns that are no inclination.
    tippe.Recording(value=[3.2, -0.02, 3.0], error=0.05, **FILM)
    tippe.Recording(value=[3.9, np.nan, 3.0], error=0.2, **FILM)
    tippe.Recording(value=[57.0, 58.0, 60.0], error=0.2, quantity="spin", **FILM)


def test_unknown_errors_are_given_as_such_with_their_units():
    density, film = density_of_a_film()
    assert density.names == ("scene.friction.mu", "error[0]", "error[1]")
    assert density.units == {"scene.friction.mu": "s m-1", "error[0]": "rad", "error[1]": "rad"}
    guesses = np.asarray(film.measurements.error)[:2]
    values = density.values(jnp.array([np.log(0.2), np.log(2.0), 0.0]))
    np.testing.assert_allclose([values["error[0]"], values["error[1]"]], guesses * [2.0, 1.0], rtol=1e-12)
    # A fit has no coordinates of errors: they are the first guess.
    np.testing.assert_allclose(density.values(np.array([[np.log(0.2)]]))["error[0]"], guesses[:1], rtol=1e-12)
    with pytest.raises(
        ValueError, match=r"coordinates of shape \(2,\) must have 3 numbers .*: scene\.friction\.mu, error"
    ):
        density.values(jnp.zeros(2))


def test_draws_show_the_unit_of_an_error():
    draws = Draws(
        {"error[0]": np.ones((2, 3))},
        np.zeros((2, 3, 1)),
        {"error[0]": 1.0},
        {"error[0]": 6.0},
        1.0,
        9,
        {"error[0]": "rad"},
    )
    assert "error[0]  1  (1, 1) rad  R-hat" in str(draws)
