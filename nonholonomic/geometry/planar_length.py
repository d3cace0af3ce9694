"""The length of a vector in a plane, such as the sine of an angle from a pole, with its derivative where the length is 0.

At length 0 there is no gradient, only one-sided derivatives: the length grows in every direction. The forward
derivative is that of a step in the direction of the tangent, |tangent|. The reverse derivative is NaN, but 0 with
respect to numbers that do not move the vector.
"""

from typing import Any

import jax
import jax.numpy as jnp
from jax.core import ShapedArray
from jax.extend.core import Primitive
from jax.interpreters import ad, batching, mlir
from jaxtyping import Array, Float


@jax.custom_jvp
def planar_length(x: Float[Array, "..."], y: Float[Array, "..."]) -> Float[Array, "..."]:
    """sqrt(x^2 + y^2), without overflow.

    **Arguments:** `x`, `y`: of the same shape.

    **Example:** along t at the origin, and away from it.

    >>> import jax
    >>> from nonholonomic.geometry import planar_length
    >>> print(jax.jacfwd(lambda t: planar_length(3.0 * t, 4.0 * t))(0.0))
    5.0
    >>> print(jax.grad(planar_length)(0.0, 0.0), jax.grad(planar_length)(3.0, 4.0))
    nan 0.6
    """
    return jnp.hypot(x, y)


@planar_length.defjvp
def _change(primals: Any, tangents: Any) -> Any:
    length = planar_length(*primals)
    (x, y), (dx, dy) = jnp.broadcast_arrays(*primals), jnp.broadcast_arrays(*tangents)
    at_pole = length == 0.0
    divisor = jnp.where(at_pole, 1.0, length)
    return length, jnp.where(at_pole, _departure.bind(dx, dy), (x * dx + y * dy) / divisor)


#: The length of a tangent at the pole. This function is not linear, so it has no true transpose: reverse mode gives NaN
#: for every cotangent but 0.
_departure = Primitive("departure_from_pole")
_departure.def_impl(lambda dx, dy: jnp.hypot(dx, dy))
_departure.def_abstract_eval(lambda dx, dy: ShapedArray(dx.shape, dx.dtype))
mlir.register_lowering(_departure, mlir.lower_fun(lambda dx, dy: jnp.hypot(dx, dy), multiple_results=False))


def _second_change(primals: Any, tangents: Any) -> Any:
    return jax.jvp(planar_length, primals, tuple(ad.instantiate_zeros(tangent) for tangent in tangents))


def _taken_back(cotangent: Any, dx: Any, dy: Any) -> Any:
    if isinstance(cotangent, ad.Zero):
        return None, None
    doubt = jnp.where(cotangent == 0.0, 0.0, jnp.nan)
    return tuple(doubt if ad.is_undefined_primal(part) else None for part in (dx, dy))


ad.primitive_jvps[_departure] = _second_change
ad.primitive_transposes[_departure] = _taken_back
batching.defbroadcasting(_departure)
