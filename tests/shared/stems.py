"""Closed forms of a top with a stem on the plane (`tippe.md`, section 4; Leine and Glocker 2003)."""

import math

import tippe
from nonholonomic.geometry import dot
from tippe.modes.impact import FreeBody, balls


def first_contact(body: tippe.Top) -> float:
    """Angle theta [rad] at which sphere and stem touch the plane together, cos theta = (r2 - R) / (a2 - a).

    Below it a top stands on its sphere, above it on its stem.
    """
    return math.acos(float((body.stem.radius - body.radius) / (body.stem.offset - body.offset)))


def jellett(ball, free):
    """Jellett's quantity L.(R n - a e) [kg m^3/s] for one of the spheres: constant while no force acts on the other
    sphere."""
    return ball.radius * free.momentum[2] - ball.offset * dot(free.axis, free.momentum)


def free_body(ride: tippe.HybridTrajectory) -> FreeBody:
    """The top of a run as a free body, also in contact."""
    free, (distance, rate) = FreeBody.of(ride.scene.body, balls(ride.scene.body)[0], ride.states), ride.above
    return free._replace(velocity=(*free.velocity[:2], free.velocity[2] + rate), height=free.height + distance)
