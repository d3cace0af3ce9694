"""Bodies of any shape and inertia: Kane and Levinson's rattleback, bodies of revolution as such bodies, and an odd one."""

import math

import jax.numpy as jnp
import numpy as np
from tops import random_states

import tippe

SHAPE = (0.2, 0.03, 0.02)
CENTRE = (0.0, 0.0, -0.01)
INERTIA = ((2e-4, -2e-5, 0.0), (-2e-5, 1.6e-3, 0.0), (0.0, 0.0, 1.7e-3))

#: Kane and Levinson tilt by half a degree about two axes: n = Ry(-0.5 deg) Rx(-0.5 deg) z in the body's axes.
HALF = math.radians(0.5)
TILT = math.acos(math.cos(HALF) ** 2)
AZIMUTH = math.atan2(-math.sin(HALF), math.sin(HALF) * math.cos(HALF))

#: A body with nothing special about it, and the same as a reference, under Coulomb friction.
ODD = (0.05, (0.025, 0.02, 0.028), (1e-3, -2e-3, 3e-3))
ODD_INERTIA = ((1.2e-5, 4e-7, -3e-7), (4e-7, 1.0e-5, 2e-7), (-3e-7, 2e-7, 8e-6))
LAW = tippe.Coulomb(0.3, 0.05)


def rattleback() -> tippe.Scene:
    return tippe.Scene(tippe.Ellipsoid(1.0, SHAPE, CENTRE, INERTIA), friction=tippe.NoSlip())


def as_ellipsoid(body: tippe.Top | tippe.SpheroidBody) -> tippe.Ellipsoid:
    """A body of revolution as one of any inertia."""
    if isinstance(body, tippe.Top):
        body = tippe.SpheroidBody(body.mass, body.radius, body.radius, body.I1, body.I3, body.offset)
    axes = (body.equatorial, body.equatorial, body.polar)
    return tippe.Ellipsoid(body.mass, axes, (0.0, 0.0, -body.offset), jnp.diag(jnp.array([body.I1, body.I1, body.I3])))


def egg() -> tippe.SpheroidBody:
    return tippe.SpheroidBody(0.05, 0.02, 0.028, 1.184e-5, 8e-6, 0.003)


def turned_anyhow(states):
    """States of a top with an x axis of the body, anywhere across the axis."""
    random, axis = np.random.default_rng(3), np.asarray(states[2:5]).T
    transverse = np.cross(axis, random.normal(size=axis.shape))
    return jnp.concatenate([states, (transverse / np.linalg.norm(transverse, axis=1, keepdims=True)).T])


def odd_scene(law: tippe.AbstractFriction, inertia=ODD_INERTIA) -> tippe.Scene:
    return tippe.Scene(tippe.Ellipsoid(*ODD, inertia), friction=law)


def any_states(count: int):
    """States with nothing special about them."""
    return turned_anyhow(random_states(tippe.Scene(egg()), count))
