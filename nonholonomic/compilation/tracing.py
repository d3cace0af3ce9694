"""Read traced functions: on which arguments they depend, of which operations they consist, when they jump, and their bounds."""

import contextlib
import functools
from collections.abc import Callable, Hashable, Iterator, Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.extend.core import ClosedJaxpr, Jaxpr, Literal, Var, jaxpr_as_fun
from jaxtyping import Array, ArrayLike, Bool, Float, PyTree

from ..text import name_of
from ..validation import UNTRACEABLE, is_traced, warn
from .components import BY_ELEMENT, over_cells, spelled_out
from .xla_cpu import (
    Equation,
    Function,
    Program,
    bound,
    called_program,
    equations_in,
    programs_of,
    read_program,
    traced,
    with_constants_first,
)

#: Operations that XLA compiles into a single kernel on a CPU, forwards and backwards. A function with other operations,
#: such as LAPACK calls, scatters and sorts, is not compiled into a single kernel.
ELEMENTARY = f"""{BY_ELEMENT}
    bessel_i0e bessel_i1e broadcast_in_dim concatenate custom_jvp_call custom_vjp_call expand_dims full iota jit
    optimization_barrier pad pjit reduce_and reduce_max reduce_min reduce_or reduce_prod reduce_sum reshape rev select_and_n
    slice split squeeze stack tile transpose unstack zeros_like
"""

#: Operations that call another traced function.
CALLS = ("closed_call", "core_call", "custom_jvp_call", "custom_vjp_call", "jit", "pjit")


def is_elementary(function: Function, *args: PyTree) -> bool:
    """Whether a function and its derivatives consist of operations that fit a single kernel, with products of small matrices as
    sums."""

    def pulled_back(*args: PyTree) -> PyTree:
        values, pull = jax.vjp(spelled_out(function), *args)
        return pull(jax.tree.map(jnp.ones_like, values))

    try:
        program, _ = traced(pulled_back, *args)
    except ValueError:
        # A loop without a fixed number of iterations has no backward pass.
        return False
    return {equation.primitive.name for equation in equations_in(program)} <= set(ELEMENTARY.split())


def dependent_outputs(function: Function, *args: PyTree, on_first_alone: bool = False) -> list[bool]:
    """A mask of the function's results that depend on its arguments, or on the first one, a number, alone."""
    closed = jax.make_jaxpr(function)(*args)
    inputs = [k == 0 or not on_first_alone for k in range(len(closed.in_avals))]

    def reached(equation: Equation, inputs: list[bool]) -> Sequence[bool] | Program:
        inner = called_program(equation) if equation.primitive.name in CALLS else None
        return [any(inputs)] * len(equation.outvars) if inner is None else inner

    return read_program(closed, inputs, reached, lambda _: False)


@contextlib.contextmanager
def named_errors(function: str, arguments: str) -> Iterator[None]:
    """Raise errors in a user's function as `ValueError`s that name the function, such as "field(t, y)", and its arguments."""
    try:
        yield
    except jax.errors.JAXTypeError as error:
        raise ValueError(f"{function} {UNTRACEABLE}") from error
    except Exception as error:
        problem = f"{type(error).__name__}: {str(error).partition(chr(10))[0].rstrip('.')}"
        raise ValueError(f"{function} raised {problem}; its arguments are {arguments}") from error


def with_own_numbers(event: Function, *args: PyTree) -> Function:
    """The event itself or, if it closes over traced numbers (such as those of an enclosing `jax.grad`), a module that
    contains these numbers. An event without numbers of its own has `TracedFunction`s in place of its functions."""
    # A new function, because JAX would not look again at what one that it knows closes over.
    closed, shape = jax.make_jaxpr(lambda *args: event(*args), return_shape=True)(*args)
    if any(is_traced(const) for const in closed.consts):
        program = with_constants_first(closed)

        def evaluated(*args: PyTree) -> PyTree:
            results = jaxpr_as_fun(program)(*jax.tree.leaves(args))
            return jax.tree.unflatten(jax.tree.structure(shape), results)

        return eqx.Partial(TracedFunction(evaluated, program), list(closed.consts))
    if not all(callable(leaf) for leaf in jax.tree.leaves(event)):
        return event
    return jax.tree.map(lambda function: TracedFunction(function, closed), event)


class TracedFunction:
    """A function that equals every function that JAX traces to the same operations with the same constants.

    A program that is compiled for one of them serves all, such as for a lambda that is written anew for every call.

    **Arguments:** `program`: the traced function, or what calls it.
    """

    def __init__(self, function: Function, program: Program):
        functools.update_wrapper(self, function, updated=())
        self.function = function
        # Objects without a value of their own are compared by their address, so they must stay in memory.
        self.program = program
        self.key = _comparable(program)

    def __call__(self, *args: PyTree) -> PyTree:
        return self.function(*args)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, TracedFunction) and self.key == other.key

    def __hash__(self) -> int:
        return hash(self.key)

    def __reduce__(self) -> tuple[Function, tuple[Function]]:
        # A program cannot be pickled, but the function may be.
        return _itself, (self.function,)


class GivenFunction(TracedFunction):
    """A traced function of one result that stays as it was when it was traced, whatever it reads from elsewhere."""

    def __call__(self, *args: PyTree) -> PyTree:
        return jaxpr_as_fun(self.program)(*jax.tree.leaves(args))[0]

    def __repr__(self) -> str:
        return f"<function {getattr(self.function, '__name__', name_of(self.function))}>"


def _itself(function: Function) -> Function:
    return function


def _comparable(value: object) -> Hashable:
    """A part of a program in a form that is equal for programs with the same operations and constants."""
    if isinstance(value, ClosedJaxpr) and value.jaxpr is not value:
        return _comparable(value.jaxpr), _comparable(value.consts)
    if isinstance(value, Jaxpr):
        numbers: dict[Var, int] = {}

        def named(variables: Sequence[Var | Literal]) -> tuple[Hashable, ...]:
            return tuple(
                (str(variable.aval), _comparable(np.asarray(variable.val)))
                if isinstance(variable, Literal)
                else (str(variable.aval), numbers.setdefault(variable, len(numbers)))
                for variable in variables
            )

        inputs = named((*value.constvars, *value.invars))
        equations = tuple(
            (equation.primitive, named(equation.invars), named(equation.outvars), _comparable(equation.params))
            for equation in value.eqns
        )
        return inputs, equations, named(value.outvars), _comparable(getattr(value, "consts", ()))
    if isinstance(value, dict):
        return tuple((name, _comparable(value[name])) for name in sorted(value))
    if isinstance(value, tuple | list):
        return tuple(map(_comparable, value))
    if isinstance(value, jax.Array | np.ndarray | np.generic):
        return np.shape(value), str(value.dtype), np.asarray(value).tobytes()
    if isinstance(value, int | float):
        # 0.0 equals -0.0, and True equals 1.
        return type(value), repr(value)
    # A tuple with a list in it has a hash function, but no hash.
    with contextlib.suppress(TypeError):
        hash(value)
        return value
    return id(value)


# Find the times at which a user's function of time jumps or has a kink, by reading its jaxpr.
#
# A value is known, affine in the time, piecewise constant in the time, or something else. A comparison of two affine or known
# values holds up to a time that follows from them, whatever operations they consist of; so do `sign`, `abs`, `max`, `min` and
# `clip`, and the search among known numbers in `jnp.interp`. A comparison of something else that depends on the time cannot be
# solved, and is reported.


class Known(NamedTuple):
    """A value that does not depend on the arguments."""

    value: Any


class Affine(NamedTuple):
    """A value `slope * t + offset`; if `bent`, the value is a constant in some intervals that end at known times."""

    slope: Any
    offset: Any
    bent: bool = False


class Other(NamedTuple):
    """Any other value: whether it depends on the time other than by jumps that were found."""

    depends_on_time: bool


Kind = Known | Affine | Other

#: Operations that move elements or change nothing: applied to slope and offset alike.
LINEAR = ["broadcast_in_dim", "reshape", "squeeze", "expand_dims", "slice", "transpose", "rev", "reduce_sum", "neg"]
LINEAR += ["copy", "copy_p", "stop_gradient", "optimization_barrier", "tile"]
COMPARISONS = ["gt", "ge", "lt", "le", "eq", "ne", "lt_to", "le_to"]
KINKS = ["max", "min", "abs", "sign", "clamp"]
STAIRS = ["floor", "ceil", "round"]

#: Traced functions that are smooth, whatever their operations, or whose jumps have no effect: one of JAX, the splines of plans,
#: and the masses for the directions that constraints forbid.
SMOOTH = ["sinc", "spline_of_a_plan", "with_constraints"]


def jumps_of(function: Function, t: PyTree, *others: PyTree) -> tuple[Float[Array, " jumps"], tuple[str, ...]]:
    """The times at which a function of time and of other arguments may jump or have a kink.

    **Arguments:** the function, and examples of its arguments; the numbers that it closes over may be traced.

    **Returns:** the times, differentiable with respect to these numbers; not finite where there is no such time; and the
    names of the comparisons whose times cannot be found.

    **Example:**

    >>> from nonholonomic.compilation.tracing import jumps_of
    >>> times, unclear = jumps_of(lambda t: jnp.where((t > 1.0) & (2.0 * t < 3.0), jnp.clip(t, 0.0, 5.0), 0.0), 0.0)
    >>> print(times, unclear)
    [1.  1.5 0.  5. ] ()
    """
    closed = jax.make_jaxpr(function)(t, *others)
    reader = _Reader([], {})
    rest = [Other(False)] * (len(closed.jaxpr.invars) - 1)
    reader.read(closed, [Affine(1.0, 0.0), *rest])
    times = [jnp.ravel(jnp.asarray(time, float)) for time in reader.times]
    return jnp.concatenate([jnp.zeros(0), *times]), tuple(reader.unclear)


def in_cells(
    times_of: Callable[[PyTree], Float[Array, " jumps"]], numbers: PyTree, shape: tuple[int, ...]
) -> Float[Array, "jumps *cells"] | None:
    """Times that follow from the numbers of a run, for all cells; `None` if there are no times.

    **Arguments:** `numbers`: a tree of arrays, each with the cells in its last axis, or scalars for all cells; `shape`: that
    of the cells, () for a single run.
    """
    is_mapped = shape != () and any(jnp.ndim(leaf) for leaf in jax.tree.leaves(numbers))
    times = over_cells(times_of, numbers)() if is_mapped else times_of(numbers)
    rows = [jnp.broadcast_to(time, shape) for time in times]
    return jnp.stack(rows) if rows else None


def warn_of_unclear(name: str, function: Function, *others: PyTree, remedy: str = "") -> None:
    """Warn if a function of time compares something whose times are unknown. **Arguments:** `name`: the function, such as
    "input(t, motion)"; `others`: examples of its arguments after the time; `remedy`: what else the user can do."""
    unclear: list[str] = []

    def times(*others: PyTree) -> Array:
        times, names = jumps_of(function, jnp.zeros(()), *others)
        unclear.extend(names)
        return times

    jax.eval_shape(times, *others)
    if unclear:
        warn(
            f"{name} compares ({', '.join(unclear)}) a quantity that depends on the time, and may jump at times that are "
            f"unknown: a short pulse can be missed. Compare t itself with numbers, such as t > 1.0, which are found{remedy}"
        )


class _Reader(NamedTuple):
    """The times found so far, and the comparisons whose times cannot be found, as the keys of a dictionary."""

    times: list[Array]
    unclear: dict[str, None]

    def read(self, program: Program, inputs: Sequence[Kind]) -> list[Kind]:
        """The kinds of the results of a program."""
        return read_program(program, inputs, self.apply, Known)

    def apply(self, equation: Equation, inputs: list[Any]) -> Sequence[Kind] | Program:
        """The kinds of the results of an equation, or the program that it calls."""
        name, parameters, count = equation.primitive.name, equation.params, len(equation.outvars)
        values = [kind.value for kind in inputs if isinstance(kind, Known)]
        if len(values) == len(inputs):
            return list(map(Known, bound(equation, values)))
        depends = any(map(_depends, inputs))
        if parameters.get("name") in SMOOTH:
            return [Other(depends)] * count
        if parameters.get("name") == "searchsorted" and isinstance(inputs[0], Known):
            return [self.compared(name, [Known(jnp.ravel(inputs[0].value)), inputs[1]])]
        if name == "cond":
            branches = [self.read(branch, inputs[1:]) for branch in parameters["branches"]]
            return [Other(any(map(_depends, (inputs[0], *kinds)))) for kinds in zip(*branches, strict=True)]
        if name in ("while", "scan"):
            inner_equations = [inner for program in programs_of(equation) for inner in equations_in(program)]
            comparisons = (inner for inner in inner_equations if inner.primitive.name in COMPARISONS)
            if depends and any(jnp.issubdtype(inner.invars[0].aval.dtype, jnp.inexact) for inner in comparisons):
                self.unclear[name] = None
            return [Other(depends)] * count
        if (inner := called_program(equation)) is not None:
            return inner
        if not depends:
            return [Other(False)] * count
        is_real = jnp.issubdtype(equation.invars[0].aval.dtype, jnp.inexact)
        if name in COMPARISONS or (name == "sign" and is_real):
            return [self.compared(name, inputs) if is_real else Other(False)]
        is_index = name == "convert_element_type" and not jnp.issubdtype(parameters["new_dtype"], jnp.inexact)
        if (name in STAIRS or is_index) and is_real:
            # Its steps are known, but not how many there are.
            self.unclear["int" if is_index else name] = None
            return [Other(False)]
        if name in KINKS and is_real:
            pairs = [inputs[:2], inputs[1:]] if name == "clamp" else [inputs]
            for pair in pairs:
                self.solve(pair)
            moving = [kind for kind in inputs if not isinstance(kind, Known)]
            is_bent = name != "abs" and len(moving) == 1 and isinstance(moving[0], Affine)
            return [moving[0]._replace(bent=True) if is_bent else Other(True)]
        return [_affine(name, equation, inputs) or Other(True)] * count

    def compared(self, name: str, inputs: Sequence[Kind]) -> Other:
        """A comparison, which is constant between its jumps."""
        # Where two values are equal at an instant only, nothing jumps.
        if not self.solve(inputs) and name not in ("eq", "ne"):
            self.unclear[name] = None
        return Other(False)

    def solve(self, inputs: Sequence[Any]) -> bool:
        """Whether the time at which two values are equal, or one is 0, can be found; the time is added to the others."""
        left, right = [*inputs, Known(0.0)][:2]
        if any(isinstance(kind, Other) for kind in (left, right)):
            return not (_depends(left) or _depends(right))
        if all(isinstance(kind, Affine) for kind in (left, right)) and (left.bent or right.bent):
            return False
        (a, b), (c, d) = map(_parts, (left, right))
        slope, is_moving = jnp.subtract(a, c), jnp.subtract(a, c) != 0.0
        self.times.append(jnp.where(is_moving, jnp.subtract(d, b) / jnp.where(is_moving, slope, 1.0), jnp.inf))
        return True


def _affine(name: str, equation: Equation, inputs: Sequence[Any]) -> Affine | None:
    """The result of an operation that keeps values affine."""
    if name in LINEAR and len(inputs) == 1:
        bind, parameters = equation.primitive.bind, equation.params
        shape = equation.invars[0].aval.shape
        if not isinstance(inputs[0], Affine):
            return None
        slope, offset = (
            bind(jnp.broadcast_to(jnp.asarray(part, float), shape), **parameters) for part in inputs[0][:2]
        )
        return Affine(slope, offset, inputs[0].bent)
    if name == "convert_element_type":
        is_real = jnp.issubdtype(equation.params["new_dtype"], jnp.inexact)
        return inputs[0] if is_real and isinstance(inputs[0], Affine) else None
    if name not in ("add", "add_any", "sub", "mul", "div") or any(isinstance(kind, Other) for kind in inputs):
        return None
    (a, b), (c, d) = map(_parts, inputs)
    is_first, is_second = (isinstance(kind, Affine) for kind in inputs)
    bent = any(isinstance(kind, Affine) and kind.bent for kind in inputs)
    if (is_second and (is_first or name == "div")) and (bent or name in ("mul", "div")):
        return None
    if name == "mul":
        return Affine(a * d, b * d, bent) if is_first else Affine(b * c, b * d, bent)
    if name == "div":
        return Affine(a / d, b / d, bent)
    return Affine(a - c, b - d, bent) if name == "sub" else Affine(a + c, b + d, bent)


def _parts(kind: Known | Affine) -> tuple[Any, Any]:
    """Slope and offset of a known or affine value."""
    return kind[:2] if isinstance(kind, Affine) else (0.0, kind.value)


def _depends(kind: Kind) -> bool:
    """Whether a value depends on the time other than by jumps that were found."""
    return isinstance(kind, Affine) or (isinstance(kind, Other) and kind.depends_on_time)


# Bounds of a function over boxes of its arguments: interval arithmetic on traced operations.
#
# The bounds hold up to round-off. They are those of natural interval extension (Moore, Kearfott and Cloud, Introduction to
# Interval Analysis, SIAM, 2009): exact for a single operation, and too wide where a variable occurs more than once, in
# proportion to the width of the box.


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
    stop_gradient tanh tile transpose unstack
"""

#: Other operations that grow (+) or fall (-) with each operand.
MONOTONE = {"sub": "+-", "ge": "+-", "gt": "+-", "le": "-+", "lt": "-+", "neg": "-", "not": "-", "erfc": "-"}

#: Operations that jump, from one whole number to another.
STEPPING = ["ceil", "convert_element_type", "floor", "round", "sign"]


class Enclosure(NamedTuple):
    """The bounds of a function's results over boxes; and where in the boxes the function may jump: the truth values, of any
    shape, of the comparisons and roundings on the way that are not the same all over a box."""

    results: PyTree
    leaps: list[Bool[Array, "..."]]


def enclosing(function: Function, *shapes: PyTree, loose: bool = False) -> Callable[..., Enclosure]:
    """The bounds of a function's results over boxes.

    **Arguments:** `function`: a function of arrays; `shapes`: their shapes and types, as for `jax.eval_shape`; `loose`:
    whether an operation without a rule may have any result.

    **Returns:** a function of `Bounds`, one for each array, that returns an `Enclosure`, with `Bounds` in place of the
    results. It raises `UnboundedError` if the function has an operation that has no rule.

    **Example:**

    >>> from nonholonomic.compilation.tracing import Bounds, enclosing
    >>> square = enclosing(lambda x: jnp.cos(x) + x * x, jnp.zeros(()))
    >>> print(*square(Bounds(jnp.asarray(-1.0), jnp.asarray(2.0))).results)
    -0.41614683654714235 5.0
    """
    program, shape = traced(function, *shapes)

    def enclosed(*boxes: Bounds) -> Enclosure:
        leaps: list[Array] = []
        results = _enclosed(program, boxes, leaps, loose)
        return Enclosure(jax.tree.unflatten(jax.tree.structure(shape), results), leaps)

    return enclosed


def _enclosed(program: Program, boxes: Sequence[Bounds], leaps: list[Array], loose: bool) -> list[Bounds]:
    apply = functools.partial(_applied, leaps=leaps, loose=loose)
    return read_program(program, boxes, apply, known=_exactly)


def _exactly(number: ArrayLike) -> Bounds:
    """The bounds of a number that is known."""
    return Bounds(jnp.asarray(number), jnp.asarray(number))


def _applied(equation: Equation, boxes: list[Bounds], leaps: list[Array], loose: bool) -> Sequence[Bounds] | Program:
    """The bounds of the results of an operation, or the program that it calls."""
    name, same = equation.primitive.name, len(boxes) == 2 and equation.invars[0] is equation.invars[1]
    if name in CALLS and (program := called_program(equation)) is not None:
        return program
    if name == "scan":
        return _repeated(equation, boxes, leaps, loose)
    if name in COMPARISONS and same:
        # Asks whether this is a number.
        results = [_exactly(jnp.full(boxes[0].low.shape, name in ("eq", "ge", "le")))]
    elif name in GROWING.split() or name in MONOTONE:
        signs = MONOTONE.get(name, "+" * len(boxes))
        ends = [box if sign == "+" else box[::-1] for sign, box in zip(signs, boxes, strict=True)]
        lows, highs = map(functools.partial(bound, equation), zip(*ends, strict=True) if ends else ([], []))
        results = list(map(Bounds, lows, highs))
    elif name == "mul" and same:
        results = [_even(boxes[0], jnp.square)]
    elif name in RULES and not (name in ("div", "rem") and jnp.issubdtype(boxes[0].low.dtype, jnp.integer)):
        results = [RULES[name](*boxes)]
    elif name in RULES_WITH_PARAMETERS and (name != "sort" or len(boxes) == 1):
        results = [RULES_WITH_PARAMETERS[name](equation, *boxes)]
    elif loose:
        # Anything.
        kinds = [(variable.aval.shape, variable.aval.dtype) for variable in equation.outvars]
        return [Bounds(*(jnp.full(shape, end, kind) for end in _range(kind))) for shape, kind in kinds]
    else:
        raise UnboundedError(name)
    if name == "atan2":
        leaps.append(_contains_zero(boxes[0]) & (boxes[1].low <= 0.0))
    elif name == "rem":
        turns = _quotient(*boxes)
        leaps.append(jnp.trunc(turns.low) != jnp.trunc(turns.high))
    elif name in (*COMPARISONS, *STEPPING) and not jnp.issubdtype(boxes[0].low.dtype, bool):
        is_cast = name == "convert_element_type" and jnp.issubdtype(equation.params["new_dtype"], jnp.inexact)
        leaps += [] if is_cast else [box.low != box.high for box in results]
    return results


def _range(kind: np.dtype) -> tuple[Any, Any]:
    """The least and the greatest number of a type."""
    if jnp.issubdtype(kind, jnp.floating):
        return -jnp.inf, jnp.inf
    return (False, True) if jnp.issubdtype(kind, bool) else (jnp.iinfo(kind).min, jnp.iinfo(kind).max)


def _hull(*corners: Array) -> Bounds:
    return Bounds(functools.reduce(jnp.minimum, corners), functools.reduce(jnp.maximum, corners))


def _product(a: Bounds, b: Bounds) -> Bounds:
    return _hull(a.low * b.low, a.low * b.high, a.high * b.low, a.high * b.high)


def _contains_zero(box: Bounds) -> Array:
    return (box.low <= 0.0) & (box.high >= 0.0)


def _everything_where(unknown: Array, box: Bounds) -> Bounds:
    return Bounds(jnp.where(unknown, -jnp.inf, box.low), jnp.where(unknown, jnp.inf, box.high))


def _quotient(a: Bounds, b: Bounds) -> Bounds:
    zero = _contains_zero(b)
    low, high = jnp.where(zero, 1.0, b.low), jnp.where(zero, 1.0, b.high)
    return _everything_where(zero, _product(a, Bounds(1.0 / high, 1.0 / low)))


def _even(box: Bounds, function: Callable[[Array], Array]) -> Bounds:
    """Bounds of a function that is even and grows with the distance from zero."""
    nearest = jnp.where(_contains_zero(box), jnp.zeros_like(box.low), jnp.minimum(jnp.abs(box.low), jnp.abs(box.high)))
    return Bounds(function(nearest), function(jnp.maximum(jnp.abs(box.low), jnp.abs(box.high))))


def _integer_power(equation: Equation, box: Bounds) -> Bounds:
    power = equation.params["y"]
    raised = functools.partial(jax.lax.integer_pow, y=abs(power))
    result = Bounds(raised(box.low), raised(box.high)) if power % 2 else _even(box, raised)
    return result if power >= 0 else _quotient(_exactly(jnp.ones_like(box.low)), result)


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
    jumps = _contains_zero(y) & (x.low <= 0.0)
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


def _product_along(equation: Equation, box: Bounds) -> Bounds:
    for axis in sorted(equation.params["axes"], reverse=True):
        factors = [Bounds(*(jnp.take(end, k, axis) for end in box)) for k in range(box.low.shape[axis])]
        box = functools.reduce(_product, factors)
    return box


def _contracted(equation: Equation, a: Bounds, b: Bounds) -> Bounds:
    """Bounds of a product of matrices, from the middle and the half width of each element."""

    def product(left: Array, right: Array) -> Array:
        return bound(equation, [left, right])[0]

    (middle, width), (other, other_width) = (((box.low + box.high) / 2.0, (box.high - box.low) / 2.0) for box in (a, b))
    reach = product(jnp.abs(middle), other_width) + product(width, jnp.abs(other)) + product(width, other_width)
    value = product(middle, other)
    return Bounds(value - reach, value + reach)


def _repeated(equation: Equation, boxes: list[Bounds], leaps: list[Array], loose: bool) -> list[Bounds]:
    """Bounds of the results of a loop with a known number of rounds."""
    program, counts = equation.params["jaxpr"], equation.params
    fixed, carried = counts.get("num_consts", 0), counts.get("num_carry", 0)
    if "ft_in" in counts:  # jax 0.11 and later
        fixed, carried, _ = map(len, counts["ft_in"].unpack())
    constants, start, rows = boxes[:fixed], boxes[fixed : fixed + carried], boxes[fixed + carried :]

    def round_of(carry: list[Bounds], row: list[Bounds]) -> tuple[list[Bounds], tuple[list[Bounds], list[Array]]]:
        own: list[Array] = []
        results = _enclosed(program, [*constants, *carry, *row], own, loose)
        return results[:carried], (results[carried:], own)

    options = {"length": equation.params["length"], "reverse": equation.params["reverse"]}
    start = [Bounds(*map(jnp.asarray, box)) for box in start]
    ends, (stacked, own) = jax.lax.scan(round_of, start, rows, **options)
    leaps += [jnp.any(leap, axis=0) for leap in own]
    return [*ends, *stacked]


def _equal(a: Bounds, b: Bounds) -> Bounds:
    return Bounds((a.low == b.high) & (a.high == b.low), (a.low <= b.high) & (a.high >= b.low))


RULES: dict[str, Callable[..., Bounds]] = {
    "abs": lambda box: _even(box, jnp.abs),
    "acos": lambda box: Bounds(jnp.arccos(jnp.minimum(box.high, 1.0)), jnp.arccos(jnp.maximum(box.low, -1.0))),
    "asin": lambda box: Bounds(jnp.arcsin(jnp.maximum(box.low, -1.0)), jnp.arcsin(jnp.minimum(box.high, 1.0))),
    "atan2": _angle,
    "cos": _cosine,
    "cosh": lambda box: _even(box, jnp.cosh),
    "div": _quotient,
    "eq": _equal,
    "mul": _product,
    "ne": lambda a, b: Bounds(*(~end for end in reversed(_equal(a, b)))),
    "is_finite": lambda box: Bounds(jnp.isfinite(box.low) & jnp.isfinite(box.high), jnp.ones(box.low.shape, bool)),
    "one_minus_square": lambda box: Bounds(*(1.0 - end for end in reversed(_even(box, jnp.square)))),
    "polynomial": _polynomial,
    "pow": _power,
    "rem": _remainder,
    "rsqrt": lambda box: _everything_where(~(box.low > 0.0), Bounds(jax.lax.rsqrt(box.high), jax.lax.rsqrt(box.low))),
    "select_n": _selected,
    "sin": lambda box: _cosine(Bounds(box.low - 0.5 * jnp.pi, box.high - 0.5 * jnp.pi)),
    "sqrt": lambda box: Bounds(*(jnp.sqrt(jnp.maximum(end, 0.0)) for end in box)),
    "square": lambda box: _even(box, jnp.square),
    "tan": _tangent,
}

#: The same for operations with parameters, which are those of the equation.
RULES_WITH_PARAMETERS: dict[str, Callable[..., Bounds]] = {
    "dot_general": _contracted,
    "integer_pow": _integer_power,
    "reduce_prod": _product_along,
    "sort": lambda equation, box: Bounds(*(bound(equation, [end])[0] for end in box)),
}
