"""A closed form of a top with a stem on the plane (`tippe.md`, section 4; Leine and Glocker 2003)."""

import math

import tippe


def first_contact(body: tippe.Top) -> float:
    """Angle theta [rad] at which sphere and stem touch the plane together, cos theta = (r2 - R) / (a2 - a).

    Below it a top stands on its sphere, above it on its stem.
    """
    return math.acos(float((body.stem.radius - body.radius) / (body.stem.offset - body.offset)))
