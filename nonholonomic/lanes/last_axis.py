"""Map a function over the last axis of its arguments, and keep this axis last.

`jax.vmap` moves the mapped axis to the front of products and of arrays that are joined. Where the axis counts lanes,
compilers vectorise only along the last axis, so this costs up to ten times as much for a function of medium size, such as
a network of a thousand weights.
"""

import functools
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array

from ..compilation.programs import bound, read_program, traced
from .components import BY_ELEMENT, TooLarge

#: Reductions, which name the axes that they remove.
REDUCTIONS = (
    "reduce_sum reduce_max reduce_min reduce_prod reduce_and reduce_or argmax argmin cumsum cumprod rev squeeze"
)


def over_last_axis(function: Callable[..., Any], *shapes: Any) -> Callable[..., Any]:
    """Map a function over the last axis.

    **Arguments:** `function`: function of arrays; `shapes`: shapes of its arguments, as for `jax.eval_shape`.

    **Returns:** the function, whose arguments have one more axis than these, or are the same for all members.

    **Raises:** `TooLarge` for operations that it does not know.
    """

    def mapped(*arguments: Any) -> Any:
        closed, shape = traced(function, *shapes)
        leaves, expected = jax.tree.leaves(arguments), jax.tree.leaves(shapes)
        size = next(leaf.shape[-1] for leaf, own in zip(leaves, expected, strict=True) if leaf.ndim > own.ndim)
        results = read_program(closed, leaves, functools.partial(_applied, size=size))
        outputs = [_with_axis(result, aval.ndim, size) for result, aval in zip(results, closed.out_avals, strict=True)]
        return jax.tree.unflatten(jax.tree.structure(shape), outputs)

    return mapped


def _with_axis(value: Any, ndim: int, size: int) -> Array:
    """A value with the mapped axis, which has `ndim` axes of its own."""
    value = jnp.asarray(value)
    return value if value.ndim > ndim else jnp.broadcast_to(value[..., None], (*value.shape, size))


def _applied(equation: Any, operands: list[Any], size: int) -> Sequence[Any]:
    """The results of an equation, with one more axis where an operand has one more."""
    own = [atom.aval.ndim for atom in equation.invars]
    if equation.primitive.name in ("jit", "pjit"):
        return read_program(equation.params["jaxpr"], operands, functools.partial(_applied, size=size))
    if not any(jnp.ndim(operand) > ndim for operand, ndim in zip(operands, own, strict=True)):
        return bound(equation, operands)
    wide = [_with_axis(operand, ndim, size) for operand, ndim in zip(operands, own, strict=True)]
    results = _mapped(equation, wide, own, size)
    return results if isinstance(results, list | tuple) else [results]


def _mapped(equation: Any, operands: list[Array], own: list[int], size: int) -> Any:
    """An operation on operands with one more axis than `own`."""
    name, params = equation.primitive.name, equation.params
    if name in BY_ELEMENT.split():
        # A scalar may meet an array.
        shape = (*equation.outvars[0].aval.shape, size)
        return equation.primitive.bind(*(jnp.broadcast_to(operand, shape) for operand in operands), **params)
    if name in REDUCTIONS.split() or name in ("concatenate", "split", "stack"):
        return equation.primitive.bind(*operands, **params)
    if name == "dot_general":
        return _product(operands[0], operands[1], params["dimension_numbers"])
    if name == "broadcast_in_dim":
        dimensions = (*params["broadcast_dimensions"], len(params["shape"]))
        return jax.lax.broadcast_in_dim(operands[0], (*params["shape"], size), dimensions)
    if name in ("reshape", "expand_dims"):
        return operands[0].reshape(*equation.outvars[0].aval.shape, size)
    if name == "transpose":
        return jnp.transpose(operands[0], (*params["permutation"], own[0]))
    if name == "slice":
        limits, strides = (*params["limit_indices"], size), params["strides"]
        return jax.lax.slice(
            operands[0], (*params["start_indices"], 0), limits, None if strides is None else (*strides, 1)
        )
    raise TooLarge(name)


def _product(left: Array, right: Array, dimensions: Any) -> Array:
    """The sum over the contracted axes; batch axes come first, then those of the left and those of the right."""
    (sums, right_sums), (batch, right_batch) = dimensions
    free = [k for k in range(left.ndim - 1) if k not in (*sums, *batch)]
    right_free = [k for k in range(right.ndim - 1) if k not in (*right_sums, *right_batch)]
    left = jnp.transpose(left, (*batch, *free, *sums, left.ndim - 1))
    right = jnp.transpose(right, (*right_batch, *right_free, *right_sums, right.ndim - 1))
    shape, middle = left.shape, len(batch) + len(free)
    left = left.reshape(*shape[:middle], *(1 for _ in right_free), *shape[middle:])
    shape = right.shape
    right = right.reshape(*shape[: len(batch)], *(1 for _ in free), *shape[len(batch) :])
    first = len(batch) + len(free) + len(right_free)
    return jnp.sum(left * right, axis=tuple(range(first, first + len(sums))))
