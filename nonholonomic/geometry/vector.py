"""Component vectors in which an exact zero costs nothing.

A vector is a tuple of components, each an array over the lanes, or `None` where the model says that the component
vanishes identically (no curvature on a plane, no force without friction). Sums skip `None` and products with `None` are
`None`, so the same formula serves every scene, and each scene evaluates only its own terms.
"""

from collections.abc import Iterable
from typing import Any, TypeAlias

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..validation import as_number, is_traced

#: An array over the lanes, a number, or `None` where the component vanishes identically.
Component: TypeAlias = Any
Vector: TypeAlias = tuple[Component, Component, Component]

#: Square of the sine of the angle to x below which a normal counts as along x.
ALONG = 1e-12


def none_if_zero(value: Any) -> Any:
    """A number as an array, or `None` if it is known to be zero everywhere, so that it costs nothing."""
    if value is None:
        return None
    number = as_number(value)
    # An empty list stays unchanged, so that the module rejects it.
    return None if not is_traced(number) and np.size(number) and np.all(np.asarray(number) == 0.0) else number


def vector_of(components: Iterable[Component]) -> Vector:
    """Three components as a vector."""
    x, y, z = components
    return (x, y, z)


def add(*terms: Component) -> Component:
    """Sum of the terms that do not vanish identically; `None` if all do."""
    total = None
    for term in terms:
        if term is not None:
            total = term if total is None else total + term
    return total


def subtract(left: Component, right: Component) -> Component:
    """Difference `left - right` of two components."""
    if right is None:
        return left
    return -right if left is None else left - right


def multiply(*factors: Component) -> Component:
    """Product of the factors; `None` if one vanishes identically."""
    product = None
    for factor in factors:
        if factor is None:
            return None
        product = factor if product is None else product * factor
    return product


def scale(factor: Component, vector: tuple[Component, ...]) -> tuple[Component, ...]:
    """The vector `factor * vector`."""
    return tuple(multiply(factor, component) for component in vector)


def dot(left: tuple[Component, ...], right: tuple[Component, ...]) -> Component:
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


def sum_vectors(*vectors: tuple[Component, ...]) -> tuple[Component, ...]:
    """Sum of vectors of the same length."""
    return tuple(add(*components) for components in zip(*vectors, strict=True))


def stacked(vector: tuple[Component, ...], example: Float[Array, "components ..."]) -> Float[Array, "components ..."]:
    """The components along axis 0, in the shape of the components of `example`, with zeros for those that vanish
    identically."""
    zero = jnp.zeros_like(example[0])
    return jnp.stack([zero if part is None else jnp.broadcast_to(part, zero.shape) for part in vector])


def tangents(normal: Vector) -> tuple[Vector, Vector]:
    """Two unit vectors across a unit normal n: t1, the projection of x (of y where n is along x), and t2 = n x t1."""
    nx, ny, nz = normal
    along_x = 1.0 - nx * nx < ALONG
    first = _projected((1.0 - nx * nx, -nx * ny, -nx * nz), ~along_x)
    second = _projected((-ny * nx, 1.0 - ny * ny, -ny * nz), along_x)
    t1 = vector_of(jnp.where(along_x, b, a) for a, b in zip(first, second, strict=True))
    return t1, cross(normal, t1)


def _projected(vector: Vector, component: Component) -> Vector:
    """The vector at unit length; where it is not used, a finite vector with finite derivatives."""
    square = jnp.where(component, dot(vector, vector), 1.0)
    return scale(1.0 / jnp.sqrt(square), vector)
