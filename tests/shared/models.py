"""One small case of every kind of model: what it runs, its event, and a parameter and a quantity to ask for."""

from typing import Any, NamedTuple

import jax.numpy as jnp
import pytest
from own_modes import Ball, Bumper, Sleigh, Turntable
from tops import rutstam_top

import stroller
import tippe
from nonholonomic import Hybrid


class Case(NamedTuple):
    """A system, its start, its horizon and an event; the end of a parameter's name with its value; a quantity.

    `rtol`: how closely programs that choose their own steps agree; `once`: whether the event function has one zero only.
    """

    system: Any
    start: Any
    t1: float
    event: Any
    parameter: str
    value: float
    quantity: str
    rtol: float = 1e-9
    once: bool = True


CART = stroller.Stroller(mass=12.0, wheelbase=0.7, inertia=1.5, steering_inertia=0.05)
BOWL = stroller.Scene(CART, stroller.Spheroid(6.0, 3.0), stroller.Damping(2.0, 1.0, 0.2, 0.05), side="inside")
RIDE = stroller.Launch((0.0, -0.8), 0.3, 2.0)

TOP, ROCKER = (
    rutstam_top(),
    tippe.Ellipsoid(
        1.0, (0.2, 0.03, 0.02), (0.0, 0.0, -0.01), [[2e-4, -2e-5, 0.0], [-2e-5, 1.6e-3, 0.0], [0.0, 0.0, 1.7e-3]]
    ),
)


def loses_energy(t: Any, motion: Any) -> Any:
    """Friction has taken 2.5 % of the energy: an event that, unlike an angle, does not follow the nutation."""
    return motion.energy - 0.0402


#: Kinds of tops whose programs take long to compile.
OF_MODES = {
    # It hops for the first time at 0.126 s, and reaches the event after four hops.
    "hopping top": Case(
        tippe.Scene(TOP, friction=tippe.Viscous(0.3), contact="hybrid", restitution=0.1),
        tippe.Launch(1.5, 290.0),
        0.3,
        lambda t, motion: motion.energy - 0.047,
        "mu",
        0.3,
        "theta",
    ),
    "sticking top": Case(
        tippe.Scene(TOP, friction=tippe.SetValuedCoulomb(0.3)),
        tippe.Launch(0.35, 100.0),
        1.0,
        lambda t, motion: motion.theta - 0.345,
        "mu",
        0.3,
        "theta",
    ),
    "rattleback": Case(
        tippe.Scene(ROCKER, friction=tippe.NoSlip()),
        tippe.Launch(0.01, -5.0),
        4.0,
        lambda t, motion: -motion.normal_spin,
        "mass",
        1.0,
        "theta",
        # Rocking multiplies differences, and moves the spin to and fro around its reversal.
        rtol=5e-8,
        once=False,
    ),
}

CASES = {
    "top": Case(
        tippe.Scene(TOP, friction=tippe.Viscous(0.3)), tippe.Launch(0.2, 155.0), 1.0, loses_energy, "mu", 0.3, "theta"
    ),
    "stroller": Case(BOWL, RIDE, 2.5, lambda t, motion: motion.speed - 1.0, "rolling", 2.0, "speed"),
    "modes": Case(Hybrid([Ball()]), [1.0, 0.0, 0.0], 1.0, lambda t, y: 0.3 - y[0], "restitution", 0.8, "y0"),
    "mechanics": Case(
        Sleigh(), ([0.0, 0.0, 0.0], jnp.array([0.5, 0.0, 2.0])), 2.0, lambda t, y: 1.0 - y[2], "ahead", 0.3, "q2"
    ),
}

#: The union of the last two, whose parts the others test.
IMPACTS = {
    "impacts": Case(
        Bumper(), ([0.0, 0.0, 0.0], jnp.array([3.0, 0.0, 0.5])), 1.5, lambda t, y: y[0] - 0.4, "restitution", 0.7, "x"
    )
}

#: A mechanical system whose constraints have a drift.
SUPPORTS = {
    "turntable": Case(
        Turntable(drag=0.3), Turntable().start(0.3, 0.1, 0.2, -0.1), 2.0, lambda t, y: 0.45 - y[0], "drag", 0.3, "x"
    )
}

CASES |= OF_MODES | IMPACTS | SUPPORTS

#: The cases of the ordinary run: others have tests of their own, or take long to compile.
ORDINARY = ("top", "modes", "mechanics")


#: The names of all cases, for a parametrization.
NAMES = [pytest.param(name, marks=() if name in ORDINARY else pytest.mark.slow) for name in CASES]
