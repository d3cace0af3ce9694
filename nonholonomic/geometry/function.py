"""User functions for surfaces: convert them to modules with visible parameters, check them, and differentiate them."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import eval_jaxpr
from jaxtyping import Array, Float

from ..lanes.objects import Held
from ..per_run import gathered, parted, spread
from ..validation import UNTRACEABLE, as_number, is_traced, shown


class Plain(eqx.Module):
    """A function without parameters; the same function gives the same program."""

    function: Callable[..., Any] = eqx.field(static=True)

    def __call__(self, *at: Float[Array, "..."]) -> Float[Array, "..."]:
        # Users may compare, sort and look up numbers, or join them, which would mix lanes.
        return jnp.vectorize(lambda *numbers: jnp.asarray(self.function(*numbers)))(*at)


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
        program = jax.make_jaxpr(value)(*zeros)
    except jax.errors.JAXTypeError as error:
        raise ValueError(f"{name} = {shown(value)} {UNTRACEABLE}") from error
    except TypeError as error:
        raise ValueError(f"{name} = {shown(value)} must be a function of ({', '.join(arguments)}): {error}") from error
    # The parameters of a module may have one value per lane.
    shapes = {(), *(leaf.shape for leaf in jax.tree.leaves(value) if eqx.is_array(leaf))}
    results = program.out_avals
    if len(results) != 1 or results[0].shape not in shapes or not jnp.issubdtype(results[0].dtype, jnp.floating):
        names_of_results = ", ".join(map(str, results))
        raise ValueError(
            f"{name} = {shown(value)} must return one number for numbers {', '.join(arguments)}, not {names_of_results}"
        )
    if isinstance(value, eqx.Module):
        # If the parameters have one number per lane, so have the results.
        of_one_run = results[0].shape == () and (len(shapes) > 1 or not _takes_lanes(value, len(arguments)))
        return Held(parted(value)) if of_one_run and not isinstance(value, Held) else value
    if any(is_traced(constant) for constant in program.consts):
        return Closure(spread(program.consts), program.jaxpr)
    # Equinox warns of the arrays of a tree, such as JAX's partial functions, but not of those of its method.
    return Plain(value if jax.tree_util.all_leaves([value]) else value.__call__)


def _takes_lanes(function: Any, count: int) -> bool:
    """Whether a function of numbers, whose parameters are single numbers, takes one number per lane, too."""
    lanes = jax.ShapeDtypeStruct((2,), float)
    try:
        return jax.eval_shape(function, *(lanes,) * count).shape == lanes.shape
    except Exception:
        # Any error: the function is a user's.
        return False


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
