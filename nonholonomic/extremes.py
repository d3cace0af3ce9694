"""The least and the greatest of some numbers, with a derivative that holds however XLA rounds.

JAX differentiates `minimum`, `maximum` and `clip` by asking which number equals the result. Where XLA computes that number
again and rounds it differently, none does, and the derivative is 0.
"""

import functools

import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float


def least(*numbers: Float[ArrayLike, "..."]) -> Float[Array, "..."]:
    """The least of some numbers, with the derivative of that one; what is not a number stays so.

    **Example:**

    >>> import jax
    >>> jax.grad(lambda x: least(2.0 * x, 1.0))(0.3).item()
    2.0
    """
    return functools.reduce(lambda one, other: jnp.where((one < other) | jnp.isnan(one), one, other), numbers)


def greatest(*numbers: Float[ArrayLike, "..."]) -> Float[Array, "..."]:
    """The greatest of some numbers, with the derivative of that one; what is not a number stays so.

    **Example:**

    >>> import jax
    >>> jax.grad(lambda x: greatest(2.0 * x, 0.0))(0.3).item()
    2.0
    """
    return functools.reduce(lambda one, other: jnp.where((one > other) | jnp.isnan(one), one, other), numbers)
