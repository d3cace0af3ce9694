"""Checks of arguments, made on concrete numbers before anything compiles; traced numbers pass through."""

from typing import Any

import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Float


def as_number(value: Any) -> Float[Array, "..."]:
    """Convert to a floating-point array of the default precision; what is no number is left for `require`."""
    try:
        if isinstance(value, str):
            raise TypeError
        return jnp.asarray(value, dtype=float)
    except (TypeError, ValueError):
        return value


def is_traced(value: Any) -> bool:
    """Whether the value is known only while JAX runs a transformation."""
    return isinstance(value, Tracer)


def shown(value: Any) -> str:
    """The value as it reads best in a message: a plain number where it is one."""
    array = np.asarray(value)
    return repr(array.item()) if array.ndim == 0 and array.dtype != object else repr(value)


def _first(numbers: np.ndarray, holds: np.ndarray) -> str:
    """The first number for which the condition does not hold."""
    return shown(numbers[~holds].ravel()[0]) if numbers.ndim else shown(numbers)


def require(
    value: Any,
    name: str,
    *,
    above: Any = None,
    at_least: Any = None,
    below: Any = None,
    at_most: Any = None,
    why: str = "",
) -> None:
    """Raise `ValueError` unless every number in `value` is finite and within the bounds.

    **Arguments:**

    - `value`: a number or an array of numbers; a traced value or traced bounds pass unchecked.
    - `name`: what to call it in the message.
    - `above`, `at_least`, `below`, `at_most`: bounds, each a number.
    - `why`: a remark to append to the message.

    **Raises:** `ValueError` that names the argument, its value and what is allowed.
    """
    if is_traced(value):
        return
    # NumPy would make a number of these.
    if value is None or isinstance(value, str):
        raise ValueError(f"{name} = {value!r} is not a number")
    # A pytree rebuilt by a JAX transformation may hold placeholders; they never reach here through a constructor.
    try:
        numbers = np.asarray(value, dtype=float)
    except (TypeError, ValueError):
        raise ValueError(f"{name} = {value!r} is not a number") from None
    remark = f" ({why})" if why else ""
    finite = np.isfinite(numbers)
    if not np.all(finite):
        raise ValueError(f"{name} = {_first(numbers, finite)} must be finite{remark}")
    bounds = (
        (above, np.greater, "greater than"),
        (at_least, np.greater_equal, "at least"),
        (below, np.less, "less than"),
        (at_most, np.less_equal, "at most"),
    )
    for bound, holds, words in bounds:
        if bound is None or is_traced(bound):
            continue
        numbers, limits = np.broadcast_arrays(numbers, np.asarray(bound, dtype=float))
        allowed = holds(numbers, limits)
        if not np.all(allowed):
            told = f"{name} = {_first(numbers, allowed)} must be {words} {_first(limits, allowed)}"
            raise ValueError(told + remark)
