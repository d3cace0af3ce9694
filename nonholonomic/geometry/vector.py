"""Vectors in which an exact zero costs nothing, lengths in a plane, and small linear systems.

A vector is a tuple of three components, each an array over the lanes, or `None` where the model says that the component
vanishes identically (no curvature on a plane, no force without friction). Sums skip `None` and products with `None` are
`None`, so the same formula serves every scene, and each scene evaluates only its own terms.
"""

from typing import Any, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import ShapedArray
from jax.extend.core import Primitive
from jax.interpreters import ad, batching, mlir
from jaxtyping import Array, Float

from ..validation import as_number, is_traced

#: An array over the lanes, a number, or `None` where the component vanishes identically.
Component: TypeAlias = Any
Vector: TypeAlias = tuple[Component, ...]

#: Square of the sine of the angle to x below which a normal counts as along x.
ALONG = 1e-12


def none_if_zero(value: Component) -> Component:
    """A number as an array, or `None` if it is known to be zero everywhere, so that it costs nothing."""
    if value is None:
        return None
    number = as_number(value)
    # An empty list stays unchanged, so that the module rejects it.
    return None if not is_traced(number) and np.size(number) and np.all(np.asarray(number) == 0.0) else number


def add(*terms: Component) -> Component:
    """Sum of the terms that do not vanish identically; `None` if all do."""
    total = None
    for term in terms:
        if term is not None:
            total = term if total is None else total + term
    return total


def subtract(left: Component, right: Component) -> Component:
    """Difference `left - right` of two components."""
    return left if right is None else -right if left is None else left - right


def multiply(*factors: Component) -> Component:
    """Product of the factors; `None` if one vanishes identically."""
    product = None
    for factor in factors:
        if factor is None:
            return None
        product = factor if product is None else product * factor
    return product


def scale(factor: Component, vector: Vector) -> Vector:
    """The vector `factor * vector`."""
    return tuple(multiply(factor, component) for component in vector)


def dot(left: Vector, right: Vector) -> Component:
    """Scalar product of two vectors of the same length."""
    return add(*(multiply(a, b) for a, b in zip(left, right, strict=True)))


def cross(left: Vector, right: Vector) -> Vector:
    """Vector product of two vectors of three components."""
    (a1, a2, a3), (b1, b2, b3) = left, right
    return (
        subtract(multiply(a2, b3), multiply(a3, b2)),
        subtract(multiply(a3, b1), multiply(a1, b3)),
        subtract(multiply(a1, b2), multiply(a2, b1)),
    )


def rate_in_frame(vector: Vector, frame_rate: Vector) -> Vector:
    """Rate of the components of a fixed vector in a moving frame with t1' = o1 n, t2' = o2 n, n' = -(o1 t1 + o2 t2)."""
    along_normal = dot(frame_rate, vector[:2])
    return (multiply(frame_rate[0], vector[2]), multiply(frame_rate[1], vector[2]), subtract(None, along_normal))


def sum_vectors(*vectors: Vector) -> Vector:
    """Sum of vectors of the same length."""
    return tuple(add(*components) for components in zip(*vectors, strict=True))


def difference(left: Vector, right: Vector) -> Vector:
    """Difference `left - right` of two vectors of the same length."""
    return tuple(map(subtract, left, right))


def unit(vector: Vector) -> Vector:
    """The vector divided by its length."""
    return scale(1.0 / jnp.sqrt(dot(vector, vector)), vector)


def stacked(vector: Vector, example: Array | Vector) -> Float[Array, "components ..."]:
    """The components along axis 0, in the shape of the components of `example`, with zeros for those that vanish
    identically."""
    zero = jnp.zeros_like(example[0])
    return jnp.stack([zero if part is None else jnp.broadcast_to(part, zero.shape) for part in vector])


def tangents(normal: Vector) -> tuple[Vector, Vector]:
    """Two unit vectors across a unit normal n: t1, the projection of x (of y where n is along x), and t2 = n x t1."""
    nx, ny, nz = normal
    along_x = 1.0 - nx * nx < ALONG

    def projected(vector: Vector, is_used: Component) -> Vector:
        # Where the vector is not used, its length is replaced, so that its derivatives are finite, too.
        return scale(1.0 / jnp.sqrt(jnp.where(is_used, dot(vector, vector), 1.0)), vector)

    first = projected((1.0 - nx * nx, -nx * ny, -nx * nz), ~along_x)
    second = projected((-ny * nx, 1.0 - ny * ny, -ny * nz), along_x)
    t1 = tuple(jnp.where(along_x, b, a) for a, b in zip(first, second, strict=True))
    return t1, cross(normal, t1)


# Small linear systems in plain JAX operations.
#
# LAPACK, which `jnp.linalg.solve` calls on a CPU, costs more than the elimination itself for a few unknowns, and large
# batches of it inside one compiled program can deadlock on a machine with few cores.


def solve(matrix: Float[Array, "n n"], right: Float[Array, "n ..."], positive: bool = False) -> Float[Array, "n ..."]:
    """Solution X of A X = B by Gauss-Jordan elimination, unrolled.

    **Arguments:**

    - `matrix`: A, of a few rows.
    - `right`: B, a vector or the columns of a matrix.
    - `positive`: whether A is symmetric and positive definite, so that no pivoting is needed.
    """
    size = matrix.shape[0]
    if size == 0:
        return right
    rows = jnp.concatenate([matrix, right.reshape(size, -1)], axis=1)
    for k in range(size):
        if not positive and k < size - 1:
            pivot = k + jnp.argmax(jnp.abs(rows[k:, k]))
            rows = rows.at[jnp.stack([jnp.asarray(k), pivot])].set(rows[jnp.stack([pivot, jnp.asarray(k)])])
        row = rows[k] / rows[k, k]
        rows = jnp.where(jnp.arange(size)[:, None] == k, row, rows - jnp.outer(rows[:, k], row))
    return rows[:, size:].reshape(right.shape)


def inverse(matrix: Float[Array, "n n"]) -> Float[Array, "n n"]:
    """Inverse of a small matrix."""
    return solve(matrix, jnp.eye(matrix.shape[0], dtype=matrix.dtype))


# The length of a vector in a plane, such as the sine of an angle from a pole, with its derivative where the length is 0.
#
# At length 0 there is no gradient, only one-sided derivatives: the length grows in every direction. The forward
# derivative is that of a step in the direction of the tangent, |tangent|. The reverse derivative is NaN, but 0 with
# respect to numbers that do not move the vector.


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
def _change(primals: tuple[Array, Array], tangents: tuple[Array, Array]) -> tuple[Array, Array]:
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


def _taken_back(cotangent: Array | ad.Zero, dx: Array | ad.UndefinedPrimal, dy: Array | ad.UndefinedPrimal) -> Vector:
    if isinstance(cotangent, ad.Zero):
        return None, None
    doubt = jnp.where(cotangent == 0.0, 0.0, jnp.nan)
    return tuple(doubt if ad.is_undefined_primal(part) else None for part in (dx, dy))


ad.primitive_jvps[_departure] = lambda primals, tangents: jax.jvp(
    planar_length, primals, tuple(map(ad.instantiate_zeros, tangents))
)
ad.primitive_transposes[_departure] = _taken_back
batching.defbroadcasting(_departure)


def nearest_turn(angle: Float[Array, "..."], other: Float[Array, "..."]) -> Float[Array, "..."]:
    """An angle [rad] plus the whole turns that bring it nearest to another one."""
    return angle + 2.0 * jnp.pi * jnp.round((other - angle) / (2.0 * jnp.pi))
