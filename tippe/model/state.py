"""The state of a top in contact, and its parts by name.

In the arena's moving frame (t1, t2, n): velocity (u1, u2) of the centre of mass along the arena [m/s], axis (e1, e2,
e3) [1], angular momentum (L1, L2, L3) about the centre of mass [kg m^2/s], then the arena's place. The components are
along axis 0.
"""

from typing import Any, NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float

from nonholonomic.geometry import Component, Tangent, Vector, dot, planar_length, scale, sum_vectors

#: Indices of the parts in a state.
VELOCITY, AXIS, MOMENTUM, PLACE = slice(0, 2), slice(2, 5), slice(5, 8), slice(8, None)

#: Index of the component of the axis along n, cos(theta).
COS_THETA = 4


class Parts(NamedTuple):
    """The parts of a state."""

    velocity: Tangent
    axis: Vector
    momentum: Vector
    place: tuple[Component, ...]


def parts(state: Float[Array, "components ..."]) -> Parts:
    """Split a state into its parts."""
    u1, u2, e1, e2, e3, L1, L2, L3, *place = (state[k] for k in range(len(state)))
    return Parts((u1, u2), (e1, e2, e3), (L1, L2, L3), tuple(place))


def joined(*vectors: tuple[Component, ...]) -> Float[Array, "components ..."]:
    """The state made of its parts, in order; a component is a scalar or has one number per lane."""
    return jnp.stack(jnp.broadcast_arrays(*(component for part in vectors for component in part)))


def inclination(axis: Vector) -> Float[Array, "..."]:
    """The angle theta [rad] from the arena's normal to the axis, in [0, pi]."""
    return jnp.arctan2(planar_length(axis[0], axis[1]), axis[2])


def angular_velocity(body: Any, axis: Vector, momentum: Vector) -> Vector:
    """w = L / I1 + (1 / I3 - 1 / I1) (L.e) e [rad/s].

    **Arguments:** `body`: a body with the moments of inertia `I1` and `I3` [kg m^2].
    """
    factor = (1.0 / body.I3 - 1.0 / body.I1) * dot(momentum, axis)
    return sum_vectors(scale(1.0 / body.I1, momentum), scale(factor, axis))
