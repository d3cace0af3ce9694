"""Bounds of a function over boxes of its arguments: interval arithmetic on traced operations.

The bounds hold up to round-off. They are those of natural interval extension (Moore, Kearfott and Cloud, Introduction to
Interval Analysis, SIAM, 2009): exact for a single operation, and too wide where a variable occurs more than once, in proportion
to the width of the box.
"""

import functools
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Bool

from .xla_cpu import bound, called_program, read_program, traced


class Bounds(NamedTuple):
    """Lower and upper bounds of an array, element by element; of truth values, whether they must and may hold."""

    low: Array
    high: Array


class UnboundedError(Exception):
    """The function has an operation for which there is no rule."""


#: Operations that grow with every operand, and those that only move numbers.
GROWING = """
    add add_any and asinh atan broadcast_in_dim cbrt ceil clamp concatenate convert_element_type copy copy_p cummax cummin
    cumsum erf exp exp2 expand_dims expm1 floor full iota log log1p log2 logistic max min optimization_barrier or pad
    reduce_and reduce_max reduce_min reduce_or reduce_sum reshape rev round sign sinh slice split squeeze stack
    stop_gradient tanh transpose unstack
"""

#: Operations that call another traced function.
CALLS = "closed_call core_call custom_jvp_call custom_vjp_call jit pjit"

#: Comparisons; and operations that jump, from one whole number to another.
COMPARISONS, STEPPING = "eq ge gt le lt ne", "ceil convert_element_type floor round sign"


class Enclosure(NamedTuple):
    """The bounds of a function's results over boxes; and where in the boxes the function may jump: the truth values, of any
    shape, of the comparisons and roundings on the way that are not the same all over a box."""

    results: Any
    leaps: list[Bool[Array, "..."]]


def enclosing(function: Callable[..., Any], *shapes: Any, loose: bool = False) -> Callable[..., Enclosure]:
    """The bounds of a function's results over boxes.

    **Arguments:** `function`: a function of arrays; `shapes`: their shapes and types, as for `jax.eval_shape`; `loose`:
    whether an operation without a rule may have any result.

    **Returns:** a function of `Bounds`, one for each array, that returns an `Enclosure`, with `Bounds` in place of the
    results. It raises `UnboundedError` if the function has an operation that has no rule.

    **Example:**

    >>> from nonholonomic.compilation.bounds import Bounds, enclosing
    >>> square = enclosing(lambda x: jnp.cos(x) + x * x, jnp.zeros(()))
    >>> print(*square(Bounds(jnp.asarray(-1.0), jnp.asarray(2.0))).results)
    -0.41614683654714235 5.0
    """
    program, shape = traced(function, *shapes)

    def enclosed(*boxes: Bounds) -> Enclosure:
        leaps: list[Any] = []
        results = _enclosed(program, boxes, leaps, loose)
        return Enclosure(jax.tree.unflatten(jax.tree.structure(shape), results), leaps)

    return enclosed


def _enclosed(program: Any, boxes: Sequence[Bounds], leaps: list[Any], loose: bool) -> list[Bounds]:
    apply = functools.partial(_applied, leaps=leaps, loose=loose)
    return read_program(program, boxes, apply, known=_exactly)


def _exactly(number: ArrayLike) -> Bounds:
    """The bounds of a number that is known."""
    return Bounds(jnp.asarray(number), jnp.asarray(number))


def _applied(equation: Any, boxes: list[Bounds], leaps: list[Any], loose: bool) -> list[Bounds]:
    """The bounds of the results of an operation."""
    try:
        results = _bounded(equation, boxes, leaps, loose)
    except UnboundedError:
        if not loose:
            raise
        return [_anything(variable.aval) for variable in equation.outvars]
    name = equation.primitive.name
    if name == "atan2":
        leaps.append(_contains(boxes[0]) & (boxes[1].low <= 0.0))
    elif name == "rem":
        turns = _quotient(*boxes)
        leaps.append(jnp.trunc(turns.low) != jnp.trunc(turns.high))
    elif name in (*COMPARISONS.split(), *STEPPING.split()) and not jnp.issubdtype(boxes[0].low.dtype, bool):
        is_cast = name == "convert_element_type" and jnp.issubdtype(equation.params["new_dtype"], jnp.inexact)
        leaps += [] if is_cast else [box.low != box.high for box in results]
    return results


def _anything(aval: Any) -> Bounds:
    if jnp.issubdtype(aval.dtype, jnp.floating):
        least, most = -jnp.inf, jnp.inf
    else:
        is_truth = jnp.issubdtype(aval.dtype, bool)
        least, most = (False, True) if is_truth else (jnp.iinfo(aval.dtype).min, jnp.iinfo(aval.dtype).max)
    return Bounds(jnp.full(aval.shape, least, aval.dtype), jnp.full(aval.shape, most, aval.dtype))


def _bounded(equation: Any, boxes: list[Bounds], leaps: list[Any], loose: bool) -> list[Bounds]:
    name, same = equation.primitive.name, len(boxes) == 2 and equation.invars[0] is equation.invars[1]
    if name in CALLS.split():
        return _enclosed(called_program(equation), boxes, leaps, loose)
    if name in GROWING.split():
        lows, highs = (
            (bound(equation, ends) for ends in zip(*boxes, strict=True)) if boxes else 2 * [bound(equation, [])]
        )
        return list(map(Bounds, lows, highs))
    if name == "mul" and same:
        return [_even(boxes[0], jnp.square)]
    if name in COMPARISONS.split() and same:
        # Asks whether this is a number.
        return [_exactly(jnp.full(boxes[0].low.shape, name in ("eq", "ge", "le")))]
    if name == "integer_pow":
        return [_integer_power(equation.params["y"], *boxes)]
    if name == "reduce_prod":
        return [_product_along(equation.params["axes"], *boxes)]
    if name == "dot_general":
        return [_contracted(equation, *boxes)]
    if name == "sort" and len(boxes) == 1:
        return [Bounds(*(bound(equation, [end])[0] for end in boxes[0]))]
    if name == "scan":
        return _repeated(equation, boxes, leaps, loose)
    if name not in RULES or (name in ("div", "rem") and jnp.issubdtype(boxes[0].low.dtype, jnp.integer)):
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
        return _quotient(_exactly(jnp.ones_like(box.low)), _integer_power(-power, box))

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


def _tangent(box: Bounds) -> Bounds:
    has_pole = jnp.floor(box.high / jnp.pi - 0.5) >= jnp.ceil(box.low / jnp.pi - 0.5)
    return _everything_where(has_pole, Bounds(jnp.tan(box.low), jnp.tan(box.high)))


def _angle(y: Bounds, x: Bounds) -> Bounds:
    """Bounds of atan2, which jumps where y passes zero and x is negative."""
    ends = _hull(*(jnp.arctan2(a, b) for a in y for b in x))
    jumps = _contains(y) & (x.low <= 0.0)
    return Bounds(jnp.where(jumps, -jnp.pi, ends.low), jnp.where(jumps, jnp.pi, ends.high))


def _selected(which: Bounds, *cases: Bounds) -> Bounds:
    known, either = which.low == which.high, _hull(*(end for case in cases for end in case))
    ends = (jax.lax.select_n(which.low, *case_ends) for case_ends in zip(*cases, strict=True))
    return Bounds(*(jnp.where(known, end, hull) for end, hull in zip(ends, either, strict=True)))


def _remainder(x: Bounds, divisor: Bounds) -> Bounds:
    """Bounds of the remainder with the sign of x, which jumps where the whole part of the quotient changes."""
    turns = _quotient(x, divisor)
    known = jnp.isfinite(turns.low) & (jnp.trunc(turns.low) == jnp.trunc(turns.high))
    ends = _hull(*(x_end - jnp.trunc(turns.low) * end for x_end in x for end in divisor))
    most = jnp.maximum(jnp.abs(divisor.low), jnp.abs(divisor.high))
    low, high = jnp.where(x.low < 0.0, -most, 0.0), jnp.where(x.high > 0.0, most, 0.0)
    return Bounds(jnp.where(known, ends.low, low), jnp.where(known, ends.high, high))


def _polynomial(x: Bounds, *coefficients: Bounds) -> Bounds:
    value = _exactly(jnp.zeros_like(x.low))
    for part in reversed(coefficients):
        product = _product(value, x)
        value = Bounds(product.low + part.low, product.high + part.high)
    return value


def _product_along(axes: tuple[int, ...], box: Bounds) -> Bounds:
    for axis in sorted(axes, reverse=True):
        factors = [Bounds(*(jnp.take(end, k, axis) for end in box)) for k in range(box.low.shape[axis])]
        box = functools.reduce(_product, factors)
    return box


def _contracted(equation: Any, a: Bounds, b: Bounds) -> Bounds:
    """Bounds of a product of matrices, from the middle and the half width of each element."""

    def product(left: Array, right: Array) -> Array:
        return bound(equation, [left, right])[0]

    (middle, width), (other, other_width) = (((box.low + box.high) / 2.0, (box.high - box.low) / 2.0) for box in (a, b))
    reach = product(jnp.abs(middle), other_width) + product(width, jnp.abs(other)) + product(width, other_width)
    value = product(middle, other)
    return Bounds(value - reach, value + reach)


def _repeated(equation: Any, boxes: list[Bounds], leaps: list[Any], loose: bool) -> list[Bounds]:
    """Bounds of the results of a loop with a known number of rounds."""
    program, counts = equation.params["jaxpr"], equation.params
    fixed, carried = counts.get("num_consts", 0), counts.get("num_carry", 0)
    if "ft_in" in counts:  # jax 0.11 and later
        fixed, carried, _ = map(len, counts["ft_in"].unpack())
    constants, start, rows = boxes[:fixed], boxes[fixed : fixed + carried], boxes[fixed + carried :]

    def round_of(carry: list[Bounds], row: list[Bounds]) -> tuple[list[Bounds], tuple[list[Bounds], list[Any]]]:
        own: list[Any] = []
        results = _enclosed(program, [*constants, *carry, *row], own, loose)
        return results[:carried], (results[carried:], own)

    options = {"length": equation.params["length"], "reverse": equation.params["reverse"]}
    start = [Bounds(*map(jnp.asarray, box)) for box in start]
    ends, (stacked, own) = jax.lax.scan(round_of, start, rows, **options)
    leaps += [jnp.any(leap, axis=0) for leap in own]
    return [*ends, *stacked]


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
    "erfc": lambda box: Bounds(jax.lax.erfc(box.high), jax.lax.erfc(box.low)),
    "is_finite": lambda box: Bounds(jnp.isfinite(box.low) & jnp.isfinite(box.high), jnp.ones(box.low.shape, bool)),
    "neg": lambda box: Bounds(-box.high, -box.low),
    "not": _opposite,
    "one_minus_square": lambda box: RULES["sub"](_exactly(1.0), _even(box, jnp.square)),
    "polynomial": _polynomial,
    "pow": _power,
    "rem": _remainder,
    "rsqrt": lambda box: _everything_where(~(box.low > 0.0), Bounds(jax.lax.rsqrt(box.high), jax.lax.rsqrt(box.low))),
    "select_n": _selected,
    "sin": lambda box: _cosine(Bounds(box.low - 0.5 * jnp.pi, box.high - 0.5 * jnp.pi)),
    "sqrt": lambda box: Bounds(*(jnp.sqrt(jnp.maximum(end, 0.0)) for end in box)),
    "square": lambda box: _even(box, jnp.square),
    "sub": lambda a, b: Bounds(a.low - b.high, a.high - b.low),
    "tan": _tangent,
}
