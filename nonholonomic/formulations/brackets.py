"""Lie brackets of vector fields, and the structure coefficients of a frame."""

from collections.abc import Callable

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from ..geometry import solve

Coordinates = Float[Array, " n"]
Frame = Callable[[Coordinates], Float[Array, "n n"]]


def lie_brackets(fields: Callable[[Coordinates], Float[Array, "n m"]], q: Coordinates) -> Float[Array, "n m m"]:
    """Lie brackets of vector fields: component i of [X_a, X_b] = (X_a.d) X_b - (X_b.d) X_a at [i, a, b].

    **Arguments:**

    - `fields`: function of the coordinates (n,) that returns m fields as the columns of an (n, m) array.
    - `q`: coordinates at which to evaluate, (n,).
    """
    derivatives = jnp.einsum("ibk,ka->iab", jax.jacfwd(fields)(q), fields(q))
    return derivatives - jnp.swapaxes(derivatives, 1, 2)


def structure_constants(frame: Frame, q: Coordinates) -> Float[Array, "n n n"]:
    """Structure coefficients of a frame, [E_a, E_b] = c^c_ab E_c, at [c, a, b].

    **Arguments:** as for `lie_brackets`, with as many fields as coordinates.
    """
    brackets = lie_brackets(frame, q)
    return solve(frame(q), brackets.reshape(q.size, -1)).reshape(brackets.shape)
