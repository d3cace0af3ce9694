"""Closed forms of a top with a stem on the plane (`tippe.md`, section 4; Leine and Glocker 2003)."""

import math

import tippe


def first_contact(body: tippe.Top) -> float:
    """Angle theta [rad] at which sphere and stem touch the plane together, cos theta = (r2 - R) / (a2 - a).

    Below it a top stands on its sphere, above it on its stem.
    """
    return math.acos(float((body.stem.radius - body.radius) / (body.stem.offset - body.offset)))


def standing_spin(body: tippe.Top, gravity: float = 9.81) -> float:
    """Spin [rad/s] above which a top stands stably on its stem at theta = pi, for gamma = I1 / I3 < 1 + alpha2.

    omega^2 = m g a2 (1 + alpha2)^2 / (I3 (1 + alpha2 - gamma)), alpha2 = a2 / r2: the condition for a sphere (section 6) with
    the numbers of the stem, which may have alpha2 > 1.
    """
    ratio = 1.0 + float(body.stem.offset / body.stem.radius)
    square = float(body.mass * body.stem.offset / body.I3) * gravity * ratio**2
    return math.sqrt(square / (ratio - float(body.I1 / body.I3)))
