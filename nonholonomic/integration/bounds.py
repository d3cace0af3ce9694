"""Bounds of a function over boxes of its arguments: interval arithmetic on traced operations (Moore, Kearfott and Cloud,
Introduction to Interval Analysis, SIAM, 2009).

The bounds hold up to round-off. They are those of natural interval extension: exact for a single operation, and too wide
where a variable occurs more than once, in proportion to the width of the box.
"""

import functools
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array

from ..compilation.programs import bound, called_program, read_program, traced


class Bounds(NamedTuple):
    """Lower and upper bounds of an array, element by element; of truth values, whether they must and may hold."""

    low: Array
    high: Array


class UnboundedError(Exception):
    """The function has an operation for which there is no rule."""


#: Operations that grow with every operand, and those that only move numbers.
GROWING = """
    add add_any and asinh atan broadcast_in_dim cbrt ceil clamp concatenate convert_element_type copy copy_p cumsum erf exp exp2
    expand_dims expm1 floor full iota log log1p log2 logistic max min optimization_barrier or pad reduce_and reduce_max
    reduce_min reduce_or reduce_sum reshape rev round sign sinh slice split squeeze stack stop_gradient tanh transpose unstack
"""

#: Operations that call another traced function.
CALLS = "closed_call core_call custom_jvp_call custom_vjp_call jit pjit"


def enclosing(function: Callable[..., Any], *shapes: Any) -> Callable[..., Any]:
    """The bounds of a function's results over boxes.

    **Arguments:** `function`: a function of arrays; `shapes`: their shapes and types, as for `jax.eval_shape`.

    **Returns:** a function of `Bounds`, one for each array, that returns `Bounds` in place of the results. It raises
    `UnboundedError` if the function has an operation that has no rule.

    **Example:**

    >>> from nonholonomic.integration.bounds import Bounds, enclosing
    >>> square = enclosing(lambda x: jnp.cos(x) + x * x, jnp.zeros(()))
    >>> print(*square(Bounds(jnp.asarray(-1.0), jnp.asarray(2.0))))
    -0.41614683654714235 5.0
    """
    program, shape = traced(function, *shapes)
    return lambda *boxes: jax.tree.unflatten(jax.tree.structure(shape), _enclosed(program, boxes))


def _enclosed(program: Any, boxes: Sequence[Bounds]) -> list[Bounds]:
    return read_program(program, boxes, _applied, known=lambda constant: Bounds(constant, constant))


def _applied(equation: Any, boxes: list[Bounds]) -> list[Bounds]:
    """The bounds of the results of an operation."""
    name = equation.primitive.name
    if name in CALLS.split():
        return _enclosed(called_program(equation), boxes)
    if name in GROWING.split():
        lows, highs = (
            (bound(equation, ends) for ends in zip(*boxes, strict=True)) if boxes else 2 * [bound(equation, [])]
        )
        return list(map(Bounds, lows, highs))
    if name == "mul" and equation.invars[0] is equation.invars[1]:
        return [_even(boxes[0], jnp.square)]
    if name == "integer_pow":
        return [_integer_power(equation.params["y"], *boxes)]
    if name not in RULES:
        raise UnboundedError(name)
    return [RULES[name](*boxes)]


def _hull(*corners: Array) -> Bounds:
    return Bounds(functools.reduce(jnp.minimum, corners), functools.reduce(jnp.maximum, corners))


def _product(a: Bounds, b: Bounds) -> Bounds:
    return _hull(a.low * b.low, a.low * b.high, a.high * b.low, a.high * b.high)


def _contains(box: Bounds, number: float = 0.0) -> Array:
    return (box.low <= number) & (box.high >= number)


def _everything_where(unknown: Array, box: Bounds) -> Bounds:
    return Bounds(jnp.where(unknown, -jnp.inf, box.low), jnp.where(unknown, jnp.inf, box.high))


def _quotient(a: Bounds, b: Bounds) -> Bounds:
    zero = _contains(b)
    low, high = jnp.where(zero, 1.0, b.low), jnp.where(zero, 1.0, b.high)
    return _everything_where(zero, _product(a, Bounds(1.0 / high, 1.0 / low)))


def _even(box: Bounds, function: Callable[[Array], Array]) -> Bounds:
    """Bounds of a function that is even and grows with the distance from zero."""
    nearest = jnp.where(_contains(box), 0.0, jnp.minimum(jnp.abs(box.low), jnp.abs(box.high)))
    return Bounds(function(nearest), function(jnp.maximum(jnp.abs(box.low), jnp.abs(box.high))))


def _integer_power(power: int, box: Bounds) -> Bounds:
    if power < 0:
        return _quotient(Bounds(jnp.ones_like(box.low), jnp.ones_like(box.low)), _integer_power(-power, box))

    def raised(x: Array) -> Array:
        return jax.lax.integer_pow(x, power)

    return Bounds(raised(box.low), raised(box.high)) if power % 2 else _even(box, raised)


def _power(base: Bounds, exponent: Bounds) -> Bounds:
    safe = Bounds(jnp.where(base.low > 0.0, base.low, 1.0), jnp.where(base.low > 0.0, base.high, 1.0))
    corners = (x**y for x in safe for y in exponent)
    return _everything_where(~(base.low > 0.0), _hull(*corners))


def _cosine(box: Bounds) -> Bounds:
    turns = 2.0 * jnp.pi
    has_top = jnp.floor(box.high / turns) >= jnp.ceil(box.low / turns)
    has_bottom = jnp.floor(box.high / turns - 0.5) >= jnp.ceil(box.low / turns - 0.5)
    ends = _hull(jnp.cos(box.low), jnp.cos(box.high))
    return Bounds(jnp.where(has_bottom, -1.0, ends.low), jnp.where(has_top, 1.0, ends.high))


def _sine(box: Bounds) -> Bounds:
    return _cosine(Bounds(box.low - 0.5 * jnp.pi, box.high - 0.5 * jnp.pi))


def _tangent(box: Bounds) -> Bounds:
    has_pole = jnp.floor(box.high / jnp.pi - 0.5) >= jnp.ceil(box.low / jnp.pi - 0.5)
    return _everything_where(has_pole, Bounds(jnp.tan(box.low), jnp.tan(box.high)))


def _angle(y: Bounds, x: Bounds) -> Bounds:
    """Bounds of atan2, which jumps where y passes zero and x is negative."""
    ends = _hull(*(jnp.arctan2(a, b) for a in y for b in x))
    jumps = _contains(y) & (x.low <= 0.0)
    return Bounds(jnp.where(jumps, -jnp.pi, ends.low), jnp.where(jumps, jnp.pi, ends.high))


def _selected(which: Bounds, *cases: Bounds) -> Bounds:
    if len(cases) != 2 or which.low.dtype != bool:
        raise UnboundedError("select_n")
    either = _hull(*cases[0], *cases[1])
    known, (no, yes) = which.low == which.high, cases
    return Bounds(
        jnp.where(known, jnp.where(which.low, yes.low, no.low), either.low),
        jnp.where(known, jnp.where(which.low, yes.high, no.high), either.high),
    )


def _equal(a: Bounds, b: Bounds) -> Bounds:
    return Bounds((a.low == b.high) & (a.high == b.low), (a.low <= b.high) & (a.high >= b.low))


def _opposite(box: Bounds) -> Bounds:
    return Bounds(~box.high, ~box.low)


RULES: dict[str, Callable[..., Bounds]] = {
    "abs": lambda box: _even(box, jnp.abs),
    "acos": lambda box: Bounds(jnp.arccos(jnp.minimum(box.high, 1.0)), jnp.arccos(jnp.maximum(box.low, -1.0))),
    "asin": lambda box: Bounds(jnp.arcsin(jnp.maximum(box.low, -1.0)), jnp.arcsin(jnp.minimum(box.high, 1.0))),
    "atan2": _angle,
    "cos": _cosine,
    "cosh": lambda box: _even(box, jnp.cosh),
    "div": _quotient,
    "eq": _equal,
    "ge": lambda a, b: Bounds(a.low >= b.high, a.high >= b.low),
    "gt": lambda a, b: Bounds(a.low > b.high, a.high > b.low),
    "le": lambda a, b: Bounds(a.high <= b.low, a.low <= b.high),
    "lt": lambda a, b: Bounds(a.high < b.low, a.low < b.high),
    "mul": _product,
    "ne": lambda a, b: _opposite(_equal(a, b)),
    "neg": lambda box: Bounds(-box.high, -box.low),
    "not": _opposite,
    "one_minus_square": lambda box: RULES["sub"](Bounds(1.0, 1.0), _even(box, jnp.square)),
    "pow": _power,
    "rsqrt": lambda box: _everything_where(~(box.low > 0.0), Bounds(jax.lax.rsqrt(box.high), jax.lax.rsqrt(box.low))),
    "select_n": _selected,
    "sin": _sine,
    "sqrt": lambda box: Bounds(*(jnp.sqrt(jnp.maximum(end, 0.0)) for end in box)),
    "square": lambda box: _even(box, jnp.square),
    "sub": lambda a, b: Bounds(a.low - b.high, a.high - b.low),
    "tan": _tangent,
}
