"""Argument and result of a friction law: the motion at the contact, and force and torque per unit normal force."""

from typing import NamedTuple

from jaxtyping import Array, Float

from nonholonomic.geometry import Component, Vector, add, dot


class Slip(NamedTuple):
    """The motion of the body at the contact, in the moving frame (t1, t2, n).

    - `x`, `y`: velocity of the material contact point along the arena [m/s].
    - `turning`: angular velocity of the body [rad/s]; its component along n, the drilling, is `None` unless the law
      `uses_spin`.
    """

    x: Float[Array, "..."]
    y: Float[Array, "..."]
    turning: Vector = (None, None, None)


class ContactLoad(NamedTuple):
    """The effect of friction at the contact per unit normal force, in the moving frame.

    - `force`: the tangential force [1].
    - `torque`: the torque about the contact point [m].

    A component is `None` where it vanishes identically.
    """

    force: tuple[Component, Component]
    torque: Vector = (None, None, None)

    def power(self, slip: Slip) -> Component:
        """Power per unit normal force, f.v_s + tau.w [m/s] (`tippe.md`, section 2)."""
        return add(dot(self.force, (slip.x, slip.y)), dot(self.torque, slip.turning))
