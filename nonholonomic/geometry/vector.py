"""Component vectors in which an exact zero costs nothing.

A vector is a tuple of components, each an array over the lanes, or `None` where the model says that the component
vanishes identically (no curvature on a plane, no force without friction). Sums skip `None` and products with `None` are
`None`, so one formula serves every scene and a scene evaluates only the terms it has.
"""

from typing import Any, TypeAlias

import jax
import jax.numpy as jnp

#: An array over the lanes, a number, or `None` where the component vanishes identically.
Component: TypeAlias = Any
Vector: TypeAlias = tuple[Component, Component, Component]


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


def stored(*components: Component) -> tuple[Component, ...]:
    """The same components, computed once where several results depend on them.

    XLA otherwise fuses every result with everything that leads to it and evaluates the common part again for each. A
    barrier alone does not prevent that; joining the components and then a barrier does.
    """
    present = [component for component in components if component is not None]
    if not present:
        return components
    joined = iter(jnp.unstack(jax.lax.optimization_barrier(jnp.stack(jnp.broadcast_arrays(*present)))))
    return tuple(None if component is None else next(joined) for component in components)
