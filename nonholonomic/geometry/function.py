"""User functions for surfaces: convert them to modules with visible parameters, check them, and differentiate them."""

import math
from collections.abc import Callable, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import eval_jaxpr
from jaxtyping import Array, Float

from ..validation import UNTRACEABLE, as_number, is_traced, shown


class Plain(eqx.Module):
    """A function without parameters; the same function gives the same program."""

    function: Callable[..., Any] = eqx.field(static=True)

    def __call__(self, *at: Float[Array, "..."]) -> Float[Array, "..."]:
        return self.function(*at)


class Closure(eqx.Module):
    """A function whose leaves are the traced numbers that it closes over. It was traced with single numbers; since
    then, each may have become one number per lane."""

    numbers: tuple[Any, ...]
    # JAX's Jaxpr; equal only if it is the same object.
    program: Any = eqx.field(static=True)

    def __call__(self, *at: Float[Array, "..."]) -> Float[Array, "..."]:
        shapes, count = tuple(constant.aval.shape for constant in self.program.constvars), len(self.numbers)

        def value(*scalars: Float[Array, ""]) -> Float[Array, ""]:
            return eval_jaxpr(self.program, gathered(scalars[:count], shapes), *scalars[count:])[0]

        return jnp.vectorize(value)(*self.numbers, *at)


class Numbers(eqx.Module):
    """An array as separate numbers, each a leaf, and its shape."""

    numbers: tuple[Any, ...]
    shape: tuple[int, ...] = eqx.field(static=True)

    @property
    def array(self) -> Array:
        """The array."""
        return gathered(self.numbers, [self.shape])[0]


class Held(eqx.Module):
    """A function that is a module with arrays. Each number of these arrays is a leaf, as in a `Closure`.

    `function` is the module with `Numbers` in place of its arrays. This object has the attributes of the module, too.
    """

    function: eqx.Module

    @classmethod
    def of(cls, function: eqx.Module) -> "Held":
        """Convert a module whose arrays hold the numbers of a single function, not one number per lane."""

        def parted(leaf: Any) -> Any:
            return Numbers(spread([leaf]), leaf.shape) if eqx.is_array(leaf) and leaf.ndim else leaf

        return cls(jax.tree.map(parted, function))

    def __call__(self, *at: Float[Array, "..."]) -> Float[Array, "..."]:
        scalars, structure = jax.tree.flatten(self)

        def value(*numbers: Float[Array, ""]) -> Float[Array, ""]:
            return jax.tree.unflatten(structure, numbers[: len(scalars)]).whole(*numbers[len(scalars) :])

        return jnp.vectorize(value)(*scalars, *at)

    @property
    def whole(self) -> Any:
        """The module with its arrays."""

        def joined(leaf: Any) -> Any:
            return leaf.array if isinstance(leaf, Numbers) else leaf

        return jax.tree.map(joined, self.function, is_leaf=lambda leaf: isinstance(leaf, Numbers))

    def __repr__(self) -> str:
        return repr(self.whole)

    def __getattr__(self, name: str) -> Any:
        if name.startswith("_") or name == "function":
            raise AttributeError(name)
        return getattr(self.whole, name)


def spread(arrays: Sequence[Array]) -> tuple[Array, ...]:
    """The numbers of arrays, one by one."""
    return tuple(number for array in arrays for number in (jnp.unstack(array.ravel()) if array.ndim else (array,)))


def gathered(numbers: Sequence[Array], shapes: Sequence[tuple[int, ...]]) -> list[Array]:
    """The arrays with the given shapes, from their `spread` numbers."""
    arrays, first = [], 0
    for shape in shapes:
        end = first + math.prod(shape)
        arrays.append(jnp.stack(numbers[first:end]).reshape(shape) if shape else numbers[first])
        first = end
    return arrays


def as_function(value: Any, name: str, arguments: tuple[str, ...]) -> eqx.Module:
    """Convert a function of lengths [m] to a module whose parameters are arrays.

    **Raises:** `ValueError` unless the function returns one number for numbers.
    """
    if not callable(value):
        raise ValueError(f"{name} = {shown(value)} must be a function of ({', '.join(arguments)})")
    if isinstance(value, eqx.Module):
        value = jax.tree.map(lambda leaf: as_number(leaf) if isinstance(leaf, float | np.ndarray) else leaf, value)
    zeros = (jnp.zeros(()),) * len(arguments)
    try:
        traced = jax.make_jaxpr(value)(*zeros)
    except jax.errors.JAXTypeError as error:
        raise ValueError(f"{name} = {shown(value)} {UNTRACEABLE}") from error
    except TypeError as error:
        raise ValueError(f"{name} = {shown(value)} must be a function of ({', '.join(arguments)}): {error}") from error
    # The parameters of a module may have one value per lane.
    shapes = {(), *(leaf.shape for leaf in jax.tree.leaves(value) if eqx.is_array(leaf))}
    results = traced.out_avals
    if len(results) != 1 or results[0].shape not in shapes or not jnp.issubdtype(results[0].dtype, jnp.floating):
        names_of_results = ", ".join(map(str, results))
        raise ValueError(
            f"{name} = {shown(value)} must return one number for numbers {', '.join(arguments)}, not {names_of_results}"
        )
    if isinstance(value, eqx.Module):
        # If the parameters have one number per lane, so have the results.
        arrays = results[0].shape == () and len(shapes) > 1 and not isinstance(value, Held)
        return Held.of(value) if arrays else value
    closes_over = any(is_traced(constant) for constant in traced.consts)
    return Closure(spread(traced.consts), traced.jaxpr) if closes_over else Plain(value)


def partials(function: Callable[..., Any], at: tuple[Any, ...]) -> tuple[Float[Array, "..."], ...]:
    """Partial derivatives of a function of several numbers, each a number or an array over lanes."""

    def along(k: int) -> Float[Array, "..."]:
        return jax.jvp(
            lambda coordinate: function(*at[:k], coordinate, *at[k + 1 :]), (at[k],), (jnp.ones_like(at[k]),)
        )[1]

    return tuple(along(k) for k in range(len(at)))


def second_derivative(
    function: Callable[..., Any], at: tuple[Any, ...], a: tuple[Any, ...], b: tuple[Any, ...]
) -> Float[Array, "..."]:
    """Second derivative of a function of several numbers along two vectors, each component a number or an array over lanes."""
    size, numbers = len(at), tuple(jnp.broadcast_arrays(*at, *a, *b))
    place, first, second = numbers[:size], numbers[size : 2 * size], numbers[2 * size :]
    return jax.jvp(lambda *point: jax.jvp(function, point, first)[1], place, second)[1]
