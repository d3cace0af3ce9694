"""The warnings about friction laws: that they drive a top, or that their numbers are in another unit."""

import math
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from nonholonomic.compilation.xla_cpu import compiled_setup
from nonholonomic.geometry import Component
from nonholonomic.validation import UNTRACEABLE, largest, one_line

from .contact_load import ContactLoad, Slip

#: A coefficient of friction, and a slip speed [m/s], above which another unit is suspected.
GREATEST_MU, GREATEST_SLIP_SPEED = 5.0, 5.0

#: Slip speeds [m/s] and turning rates [rad/s] at which a law is tried.
SPEEDS, TURNINGS = (1e-3, 1e-2, 0.1, 1.0), (0.0, 100.0, -100.0)


def drive(law: Any) -> str | None:
    """The message about a law whose power is positive for one of some slips in eight directions; `None` if the law
    always brakes."""
    angle, speed, turning = (
        grid.ravel() for grid in np.meshgrid(np.arange(8) * math.pi / 4.0, SPEEDS, TURNINGS, indexing="ij")
    )
    x, y = speed * np.cos(angle), speed * np.sin(angle)
    zero, drilling = jnp.zeros(turning.shape), jnp.asarray(turning) if law.uses_spin else None
    try:
        with jax.ensure_compile_time_eval():
            power = np.asarray(_power(law, Slip(jnp.asarray(x), jnp.asarray(y), (zero, zero, drilling))))
    except jax.errors.JAXTypeError as error:
        raise ValueError(f"friction = {one_line(law)}: per_normal_force {UNTRACEABLE}") from error
    except NoLoad:
        raise ValueError(
            f"friction = {one_line(law)}: per_normal_force must return a tippe.friction.ContactLoad, as in "
            "ContactLoad(force=(x, y))"
        ) from None
    except Exception:
        # The first run reports what is wrong with such a law.
        return None
    if power.shape != x.shape or not np.any(power > 1e-12):
        return None
    index = int(np.nanargmax(power / speed))
    drills = f" and a turning of {turning[index]:g} rad/s" if law.uses_spin and turning[index] else ""
    return (
        f"friction = {one_line(law)} drives the top: at a slip of ({x[index]:.3g}, {y[index]:.3g}) m/s{drills} its power is "
        f"{power[index]:.3g} W per newton of normal force, but the power of friction is never positive. Is a sign wrong? A run "
        "whose energy grows ends as 'unresolved'. For a level belt, give Launch the velocity relative to it"
    )


class NoLoad(Exception):
    """A law that returns something else than a load."""


@compiled_setup
def _power(law: Any, slip: Slip) -> Component:
    load = law.per_normal_force(slip)
    if not isinstance(load, ContactLoad):
        raise NoLoad
    return load.power(slip)


def suspected_unit(mu: Any, slip_speed: Any = 0.0) -> str | None:
    """The suspicion that numbers of Coulomb's law are in another unit; `None` if they are not."""
    if (greatest := largest(mu)) > GREATEST_MU:
        return f"mu = {greatest:g} is large for a coefficient of friction: was it in %? {greatest:g} % are {greatest / 100.0:g}"
    if (greatest := largest(slip_speed)) > GREATEST_SLIP_SPEED:
        return f"slip_speed = {greatest:g} m/s is large: was it in mm/s? {greatest:g} mm/s are {greatest / 1e3:g} m/s"
    return None
