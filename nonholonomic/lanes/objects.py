"""Users' objects, such as laws and surfaces, whose methods are written for a single run and evaluated in every lane."""

import contextlib
import functools
from collections.abc import Callable, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from ..per_run import AbstractHeld, is_array, is_numbers, is_users, joined, parted
from .components import TooLarge, by_components


def method_over_lanes(method: Callable[..., Any]) -> Callable[..., Any]:
    """A user's method, written for a single run, that also accepts arguments with one number per lane.

    Single numbers are passed on as they are, with the object's arrays whole. For arrays of numbers, the method is mapped over
    them and over the numbers of the object, each of which is a scalar or has one value per lane.
    """

    @functools.wraps(method)
    def mapped(self: Any, *arguments: Any) -> Any:
        own = [leaf for leaf in jax.tree.leaves(self, is_leaf=is_numbers) if is_numbers(leaf)]
        if all(jnp.ndim(leaf) == 0 for leaf in jax.tree.leaves((own, arguments))):
            return method(joined(self), *arguments)
        arrays, static = eqx.partition((self, arguments), is_array)
        leaves, structure = jax.tree.flatten(arrays)

        def of_run(*numbers: Array) -> Any:
            whole, arguments = joined(eqx.combine(jax.tree.unflatten(structure, numbers), static))
            return jax.tree.map(jnp.asarray, method(whole, *arguments))

        kinds = [jax.ShapeDtypeStruct((), jnp.result_type(leaf)) for leaf in leaves]
        shape = np.broadcast_shapes(*map(jnp.shape, leaves))
        with contextlib.suppress(TooLarge):
            results = by_components(of_run, *kinds)(*leaves)
            return jax.tree.map(lambda result: jnp.broadcast_to(result, shape), results)
        structure_of_results = jax.tree.structure(jax.eval_shape(of_run, *kinds))
        results = jnp.vectorize(lambda *numbers: tuple(jax.tree.leaves(of_run(*numbers))))(*leaves)
        return jax.tree.unflatten(structure_of_results, results)

    return mapped


def map_methods(kind: type, names: Sequence[str]) -> None:
    """Map the named methods over lanes where a user's class defines them; its `bounds` see whole arrays."""
    for name in names if is_users(kind) else ():
        if name in vars(kind):
            setattr(kind, name, method_over_lanes(getattr(kind, name)))
    if is_users(kind) and "bounds" in vars(kind):
        bounds = kind.bounds
        kind.bounds = functools.wraps(bounds)(lambda self: bounds(joined(self)))


def held(value: Any, evaluate: Callable[[Any], Any]) -> Any:
    """A user's object with `Numbers` in place of its arrays if these hold the numbers of a single run. Arrays with one
    number per lane stay as they are, and so do these packages' own objects.

    **Arguments:** `evaluate`: evaluates the object for single numbers; if a result is an array, the object has one number
    per lane.
    """
    if not is_users(type(value)) or not any(is_array(leaf) and leaf.ndim for leaf in jax.tree.leaves(value)):
        return value
    try:
        results = jax.eval_shape(lambda: evaluate(value))
    except (TypeError, ValueError, jax.errors.JAXTypeError):
        # The checks of the object say what is wrong with it.
        return value
    return parted(value) if all(result.shape == () for result in jax.tree.leaves(results)) else value


class Held(AbstractHeld):
    """A user's module that is a function of numbers, written for a single run, as a function of numbers or of lanes.

    `function` is the module with `Numbers` in place of its arrays: each number is a leaf.
    """

    function: Any

    @method_over_lanes
    def __call__(self, *arguments: Any) -> Any:
        return self.function(*arguments)
