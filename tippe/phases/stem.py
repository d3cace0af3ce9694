"""Closed forms of a top with a stem on the plane (`tippe.md`, section 4; Leine and Glocker 2003)."""

import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float

from ..top import Stem, Top


def stem_of(body: Top) -> Stem:
    """The stem of a top.

    **Raises:** `ValueError` if it has none.
    """
    if body.stem is None:
        raise ValueError("stem = None must be a Stem")
    return body.stem


def first_contact(body: Top) -> Float[Array, "..."]:
    """Angle theta [rad] at which sphere and stem touch the plane together, cos theta = (r2 - R) / (a2 - a).

    Below it a top stands on its sphere, above it on its stem.
    """
    stem = stem_of(body)
    return jnp.arccos((stem.radius - body.radius) / (stem.offset - body.offset))


def standing_spin(body: Top, gravity: Float[ArrayLike, "..."] = 9.81) -> Float[Array, "..."]:
    """Spin [rad/s] above which a top stands stably on its stem at theta = pi.

    With alpha2 = a2 / r2 and gamma = I1 / I3: omega^2 = m g a2 (1 + alpha2)^2 / (I3 (1 + alpha2 - gamma)); infinite if
    gamma is 1 + alpha2 or more. It is the condition for a sphere (section 6) with the numbers of the stem, which may have
    alpha2 > 1.
    """
    stem = stem_of(body)
    alpha, gamma = stem.offset / stem.radius, body.I1 / body.I3
    excess = 1.0 + alpha - gamma
    square = body.mass * gravity * stem.offset * (1.0 + alpha) ** 2 / (body.I3 * jnp.where(excess > 0.0, excess, 1.0))
    return jnp.where(excess > 0.0, jnp.sqrt(square), jnp.inf)
