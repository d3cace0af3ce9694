"""Friction at the contact point, per unit normal force. A new law is one new class."""

import abc
from typing import ClassVar, NamedTuple

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from nonholonomic.validation import as_number, require
from nonholonomic.vector import Component


class Slip(NamedTuple):
    """Velocity of the material contact point along the arena, in the moving frame [m/s]."""

    x: Float[Array, "..."]
    y: Float[Array, "..."]


class ContactLoad(NamedTuple):
    """What friction does at the contact per unit normal force: the tangential force [1] in the moving frame."""

    force: tuple[Component, Component]


class AbstractFriction(eqx.Module):
    """A friction law whose force is proportional to the normal force; `units` has the units of its numbers."""

    units: ClassVar[dict[str, str]] = {}

    #: Whether the force of a contact at rest is whatever keeps it there, within limits.
    set_valued: ClassVar[bool] = False

    @abc.abstractmethod
    def per_normal_force(self, slip: Slip) -> ContactLoad:
        """The load per unit normal force.

        **Arguments:**

        - `slip`: slip velocity [m/s].

        **Returns:** a `ContactLoad`; a component is `None` where it vanishes identically.
        """


class Frictionless(AbstractFriction):
    """No friction: the arena pushes along its normal only."""

    def per_normal_force(self, slip: Slip) -> ContactLoad:
        return ContactLoad(force=(None, None))


class Viscous(AbstractFriction):
    """Viscous sliding friction, F = -mu N v_s (Rutstam 2012, eq. 1.1).

    **Arguments:**

    - `mu`: coefficient [s/m], at least 0.
    """

    units: ClassVar[dict[str, str]] = {"mu": "s m-1"}

    mu: Float[Array, "..."] = eqx.field(converter=as_number)

    def __check_init__(self):
        require(self.mu, "mu", at_least=0.0)

    def per_normal_force(self, slip: Slip) -> ContactLoad:
        return ContactLoad(force=(-self.mu * slip.x, -self.mu * slip.y))


class Coulomb(AbstractFriction):
    """Regularised Coulomb friction, F = -mu N v_s / sqrt(v_s^2 + slip_speed^2) (`tippe.md`, section 3).

    The regularisation creeps: below the slip speed the law is viscous with the coefficient mu / slip_speed, and a top
    that would stick and roll under exact Coulomb friction may still turn over, in a time that grows as 1 / slip_speed.
    Cohen's top (Am. J. Phys. 45 (1977) 12) takes 1.8, 5.9 and 50 s at 0.1, 0.01 and 0.001 m/s, and never turns over under
    `SetValuedCoulomb`, the limit. Quote a result only together with its slip speed. The number of explicit steps grows as
    1 / slip_speed too; from 1e-4 m/s down an implicit solver is cheaper (`benchmarks/hard/sticking.py`).

    **Arguments:**

    - `mu`: coefficient of friction [1], at least 0.
    - `slip_speed`: speed [m/s] at which the force reaches 71 % of its limit, positive.
    """

    units: ClassVar[dict[str, str]] = {"mu": "1", "slip_speed": "m s-1"}

    mu: Float[Array, "..."] = eqx.field(converter=as_number)
    slip_speed: Float[Array, "..."] = eqx.field(converter=as_number)

    def __check_init__(self):
        require(self.mu, "mu", at_least=0.0)
        require(self.slip_speed, "slip_speed", above=0.0)

    def per_normal_force(self, slip: Slip) -> ContactLoad:
        speed = jnp.sqrt(slip.x * slip.x + slip.y * slip.y + self.slip_speed * self.slip_speed)
        factor = -self.mu / speed
        return ContactLoad(force=(factor * slip.x, factor * slip.y))


class SetValuedCoulomb(AbstractFriction):
    """Coulomb friction as it stands, without a slip speed: F = -mu N v_s / |v_s| while the contact slips, and any force
    along the arena up to mu N while it does not (`tippe.md`, section 3).

    The run is made of phases. In a slip the force has its full size; a slip that stops turns into rolling, with the
    equations of `rolling.py`, if the force which that takes is within the friction cone; and the top slips again as soon
    as it is not. While it rolls the energy is constant.

    **Arguments:**

    - `mu`: coefficient of friction [1], at least 0.
    """

    units: ClassVar[dict[str, str]] = {"mu": "1"}
    set_valued: ClassVar[bool] = True

    mu: Float[Array, "..."] = eqx.field(converter=as_number)

    def __check_init__(self):
        require(self.mu, "mu", at_least=0.0)

    def per_normal_force(self, slip: Slip) -> ContactLoad:
        """The load of a contact that slips; where it does not, the law alone says nothing, and the load is 0."""
        speed = length(slip.x, slip.y)
        factor = -self.mu / jnp.where(speed > 0.0, speed, 1.0)
        return ContactLoad(force=(factor * slip.x, factor * slip.y))


def length(x: Float[Array, "..."], y: Float[Array, "..."]) -> Float[Array, "..."]:
    """Length of a vector of two components, its derivative 0 where it vanishes."""
    square = x * x + y * y
    moving = square > 0.0
    return jnp.where(moving, jnp.sqrt(jnp.where(moving, square, 1.0)), 0.0)
