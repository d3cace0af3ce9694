"""One small case of every kind of model: what it runs, its event, and a parameter and a quantity to ask for."""

from typing import Any, NamedTuple

import jax.numpy as jnp
from own_modes import Ball, Sleigh

import stroller
from nonholonomic import Hybrid


class Case(NamedTuple):
    """A system, its start, its horizon and an event; the end of a parameter's name with its value; a quantity."""

    system: Any
    start: Any
    t1: float
    event: Any
    parameter: str
    value: float
    quantity: str


CART = stroller.Stroller(mass=12.0, wheelbase=0.7, inertia=1.5, steering_inertia=0.05)
BOWL = stroller.Scene(CART, stroller.Spheroid(6.0, 3.0), stroller.Damping(2.0, 1.0, 0.2, 0.05), side="inside")
RIDE = stroller.Launch((0.0, -0.8), 0.3, 2.0)

CASES = {
    "stroller": Case(BOWL, RIDE, 2.5, lambda t, motion: motion.speed - 1.0, "rolling", 2.0, "speed"),
    "modes": Case(Hybrid([Ball()]), [1.0, 0.0, 0.0], 1.0, lambda t, y: 0.3 - y[0], "restitution", 0.8, "y0"),
    "mechanics": Case(
        Sleigh(), ([0.0, 0.0, 0.0], jnp.array([0.5, 0.0, 2.0])), 2.0, lambda t, y: 1.0 - y[2], "ahead", 0.3, "q2"
    ),
}
