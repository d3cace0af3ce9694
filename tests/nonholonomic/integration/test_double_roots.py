"""Margins that fall below zero and return between the places of a step at which they are known."""

import jax.numpy as jnp
import numpy as np
from close import assert_close

from nonholonomic.integration import Oscillatory8, explicit_tableau
from nonholonomic.integration.events import missed_loss
from nonholonomic.integration.runge_kutta import stages_to_look, watched_places

PLACES = watched_places(explicit_tableau(Oscillatory8()), stages_to_look(Oscillatory8.tableau.c))


def found(*margins):
    """Where the margins, functions of the place, may fall below zero in a single lane."""
    margin_values = jnp.asarray([[[margin(place)] for margin in margins] for place in PLACES])
    return float(missed_loss(PLACES, margin_values, jnp.ones(1, bool))[0])


def dip(place, depth=0.003):
    """A parabola that falls below zero at a place."""
    return lambda x: (x - place) ** 2 - depth


def test_a_dip_between_two_known_places_is_found():
    for start, end in zip(PLACES[:-1], PLACES[1:], strict=True):
        middle = 0.5 * (start + end)
        assert min(dip(middle)(place) for place in PLACES) > 0.0
        assert_close(found(dip(middle)), middle, atol=1e-12)


def test_a_margin_that_stays_positive_is_left_alone():
    assert found(lambda x: 1.01 - x) == 2.0
    assert found(lambda x: 0.01 + x) == 2.0
    assert found(dip(0.35, -0.1)) == 2.0
    assert found(np.cos) == 2.0


def test_a_lesser_margin_without_a_dip_hides_none():
    assert_close(found(lambda x: 1.001 - x, dip(0.35)), 0.35, atol=1e-12)


def test_of_two_dips_the_step_ends_at_the_first():
    assert_close(found(dip(0.9), dip(0.35)), 0.35, atol=1e-12)
