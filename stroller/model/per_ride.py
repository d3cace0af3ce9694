"""Inputs that are written for a single ride, for many rides at once."""

import contextlib
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from nonholonomic.lanes.components import TooLarge, by_components
from nonholonomic.lanes.last_axis import over_last_axis
from nonholonomic.lanes.tracing import is_elementary, spelled_out

from .input import Motion

#: Inputs with more numbers than this stay in arrays: element by element they would take long to compile.
MOST_ELEMENTS = 256


class PerRide(eqx.Module):
    """An input that is evaluated ride by ride. For many rides, its arrays, such as the knots of a spline or the weights of a
    network, have the rides in the last axis; its scalars have one value per ride or one for all.

    - `by_elements`: whether every number of an array is a vector of rides; larger inputs stay in arrays.
    """

    input: Any
    by_elements: bool = eqx.field(static=True)

    @classmethod
    def of(cls, controls: Any, t: Any, motion: Any) -> "PerRide":
        """The input of a single ride, with arguments of these types."""
        sizes = [leaf.size for leaf in jax.tree.leaves(controls) if eqx.is_inexact_array(leaf)]
        if sum(sizes) > MOST_ELEMENTS:
            return cls(controls, False)
        arrays, static = eqx.partition(controls, eqx.is_inexact_array)

        def of_ride(arrays: Any, moving: Any) -> Any:
            return spelled_out(lambda *parts: eqx.combine(parts[0], static)(*parts[1]))(arrays, moving)

        moving = jax.tree.map(lambda shape: jnp.zeros(shape.shape), (t, motion))
        many = jax.tree.map(lambda leaf: leaf[..., None], (arrays, moving))
        with contextlib.suppress(TooLarge):
            jax.eval_shape(lambda parts: cls(eqx.combine(parts[0], static), True)(*parts[1]), many)
            return cls(controls, is_elementary(of_ride, arrays, moving))
        return cls(controls, False)

    def of_cells(self, cells: int) -> "PerRide":
        """The same input for a number of rides."""

        def spread(leaf: Any) -> Any:
            is_array = eqx.is_inexact_array(leaf) and leaf.ndim
            return jnp.broadcast_to(leaf[..., None], (*leaf.shape, cells)) if is_array else leaf

        return PerRide(jax.tree.map(spread, self.input), self.by_elements)

    def __call__(self, t: Float[Array, "..."], motion: Motion) -> tuple[Float[Array, "..."], Float[Array, "..."]]:
        moving, structure = jax.tree.flatten((t, motion))
        moving = jnp.broadcast_arrays(*moving)
        if moving[0].ndim == 0:
            return self.input(t, motion)
        arrays, static = eqx.partition(self.input, eqx.is_inexact_array)
        numbers, of_numbers = jax.tree.flatten(arrays)

        def of_ride(numbers: list[Array], moving: list[Array]) -> Any:
            controls = eqx.combine(jax.tree.unflatten(of_numbers, numbers), static)
            return tuple(controls(*jax.tree.unflatten(structure, moving)))

        shapes = [number.shape[:-1] for number in numbers]
        if self.by_elements:
            return _by_elements(of_ride, numbers, shapes, moving)
        own = jax.tree.map(lambda part: jax.ShapeDtypeStruct(part.shape[:-1], part.dtype), (numbers, moving))
        with contextlib.suppress(TooLarge):
            return over_last_axis(of_ride, *own)(numbers, moving)
        axes = [-1 if number.ndim else None for number in numbers]
        return jax.vmap(of_ride, in_axes=(axes, 0))(numbers, moving)


def _by_elements(of_ride: Any, numbers: list[Array], shapes: list[tuple[int, ...]], moving: list[Array]) -> Any:
    """The input with every number of an array as a vector of rides."""

    def of_elements(elements: list[list[Array]], moving: list[Array]) -> Any:
        return of_ride([jnp.stack(part).reshape(shape) for part, shape in zip(elements, shapes, strict=True)], moving)

    elements = [[number] if number.ndim == 0 else _rows(number) for number in numbers]
    scalars = jax.tree.map(lambda part: jax.ShapeDtypeStruct((), part.dtype), (elements, moving))
    results = by_components(of_elements, *scalars)(elements, moving)
    return jax.tree.map(lambda part: jnp.broadcast_to(part, moving[0].shape), results)


def _rows(number: Float[Array, "... rides"]) -> list[Float[Array, " rides"]]:
    """The elements of an array in all rides, by an operation whose derivative joins all elements at once."""
    flat = number.reshape(-1, number.shape[-1])
    return [row[0] for row in jax.lax.split(flat, (1,) * len(flat))]
