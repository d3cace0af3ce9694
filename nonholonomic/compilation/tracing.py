"""Trace a user's functions: on which arguments they depend, of which operations they consist, and when they jump."""

import contextlib
import functools
import math
from collections.abc import Callable, Hashable, Iterator, Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.extend.core import ClosedJaxpr, Jaxpr, Literal, jaxpr_as_fun
from jaxtyping import Array, Float

from ..validation import UNTRACEABLE, is_traced, warn
from .xla_cpu import bound, called_program, operations, read_program, traced

# Trace a user's functions to find the arguments on which they depend, and the operations of which they consist.

#: Operations that XLA compiles into a single kernel on a CPU, forwards and backwards. A function with other operations,
#: such as LAPACK calls, scatters and sorts, is not compiled into a single kernel.
ELEMENTARY = """
    abs acos acosh add add_any and asin asinh atan atan2 atanh bessel_i0e bessel_i1e broadcast_in_dim cbrt ceil clamp
    concatenate convert_element_type copy copy_p cos cosh custom_jvp_call custom_vjp_call digamma div eq erf erf_inv erfc exp
    exp2 expand_dims expm1 floor full ge gt integer_pow iota is_finite jit le lgamma log log1p log2 logistic lt max min mul ne
    neg nextafter not one_minus_square optimization_barrier or pad pjit polynomial pow reduce_and reduce_max reduce_min
    reduce_or reduce_prod reduce_sum rem reshape rev round rsqrt select_and_n select_n sign sin sinh slice split sqrt square
    squeeze stack stop_gradient sub tan tanh transpose unstack xor zeros_like
"""

#: Products with at most this many terms are written as sums of products, which all of XLA's compilers accept.
MOST_TERMS = 1 << 12


def spelled_out(function: Callable[..., Any]) -> Callable[..., Any]:
    """The function with products of small matrices written as sums.

    For a product, XLA calls a library, which costs more than the product and does not fit a single kernel.
    """

    def evaluated(*args: Any) -> Any:
        closed, shape = jax.make_jaxpr(function, return_shape=True)(*args)
        return jax.tree.unflatten(jax.tree.structure(shape), read_program(closed, jax.tree.leaves(args), _spelled_out))

    return evaluated


def _spelled_out(equation: Any, inputs: list[Any]) -> Sequence[Any]:
    name, params = equation.primitive.name, equation.params
    if name == "dot_general":
        left, right = inputs
        return [_product(left, right, params["dimension_numbers"])]
    return read_program(params["jaxpr"], inputs, _spelled_out) if name in ("jit", "pjit") else bound(equation, inputs)


def _product(left: Array, right: Array, dimensions: Any) -> Array:
    """The sum over the contracted axes; batch axes come first, then those of the left and those of the right."""
    (sums, right_sums), (batch, right_batch) = dimensions
    free = [k for k in range(left.ndim) if k not in (*sums, *batch)]
    right_free = [k for k in range(right.ndim) if k not in (*right_sums, *right_batch)]
    terms = math.prod(left.shape) * math.prod(right.shape[k] for k in right_free)
    if terms > MOST_TERMS:
        return jax.lax.dot_general(left, right, dimensions)
    left_factor = jnp.transpose(left, (*batch, *free, *sums))
    right_factor = jnp.transpose(right, (*right_batch, *right_free, *right_sums))
    shape = [left.shape[k] for k in batch], [left.shape[k] for k in free], [right.shape[k] for k in right_free]
    contracted = [left.shape[k] for k in sums]
    left_factor = left_factor.reshape(*shape[0], *shape[1], *(1 for _ in shape[2]), *contracted)
    right_factor = right_factor.reshape(*shape[0], *(1 for _ in shape[1]), *shape[2], *contracted)
    products = left_factor * right_factor
    return jnp.sum(products, axis=tuple(range(-len(contracted), 0))) if contracted else products


def is_elementary(function: Callable[..., Any], *args: Any) -> bool:
    """Whether a function and its derivatives consist of operations that fit a single kernel."""

    def pulled_back(*args: Any) -> Any:
        values, pull = jax.vjp(function, *args)
        return pull(jax.tree.map(jnp.ones_like, values))

    try:
        program, _ = traced(pulled_back, *args)
    except ValueError:
        # A loop without a fixed number of iterations has no backward pass.
        return False
    return operations(program) <= set(ELEMENTARY.split())


def depends_on_first(function: Callable[..., Any], first: Any, *args: Any) -> bool:
    """Whether a function's results depend on its first argument, a number."""
    closed = jax.make_jaxpr(function)(first, *args)
    return any(_reached(closed, [k == 0 for k in range(len(closed.in_avals))]))


def dependent_outputs(function: Callable[..., Any], *args: Any) -> list[bool]:
    """A mask of the function's results that depend on its arguments."""
    closed = jax.make_jaxpr(function)(*args)
    return _reached(closed, [True] * len(closed.in_avals))


def _reached(program: Any, inputs: Sequence[bool]) -> list[bool]:
    """Which results depend on the inputs that are true in a mask."""

    def is_reached(equation: Any, operands: list[bool]) -> list[bool]:
        return [any(operands)] * len(equation.outvars)

    return read_program(program, inputs, is_reached, known=lambda _: False)


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


def with_own_numbers(event: Callable[..., Any], *args: Any) -> Callable[..., Any]:
    """The event itself or, if it closes over traced numbers (such as those of an enclosing `jax.grad`), a module that
    contains these numbers. An event without numbers of its own has `TracedFunction`s in place of its functions."""
    closed, shape = jax.make_jaxpr(event, return_shape=True)(*args)
    if any(is_traced(const) for const in closed.consts):
        # The constants become the first arguments.
        inputs = [*closed.jaxpr.constvars, *closed.jaxpr.invars]
        program = ClosedJaxpr(closed.jaxpr.replace(constvars=[], invars=inputs), ())

        def evaluated(*args: Any) -> Any:
            results = jaxpr_as_fun(program)(*jax.tree.leaves(args))
            return jax.tree.unflatten(jax.tree.structure(shape), results)

        return _WithConstants(list(closed.consts), TracedFunction(evaluated, program))
    if not all(callable(leaf) for leaf in jax.tree.leaves(event)):
        return event
    return jax.tree.map(lambda function: TracedFunction(function, closed), event)


class _WithConstants(eqx.Module):
    """A traced function with its constants as numbers."""

    consts: list[Array]
    function: "TracedFunction"

    def __call__(self, *args: Any) -> Any:
        return self.function(self.consts, *args)


class TracedFunction:
    """A function that equals every function that JAX traces to the same operations with the same constants.

    A program that is compiled for one of them serves all, such as for a lambda that is written anew for every call.

    **Arguments:** `program`: the traced function, or what calls it.
    """

    def __init__(self, function: Callable[..., Any], program: Any):
        functools.update_wrapper(self, function, updated=())
        self.function = function
        # Objects without a value of their own are compared by their address, so they must stay in memory.
        self.program = program
        self.key = _comparable(program)

    def __call__(self, *args: Any) -> Any:
        return self.function(*args)

    def __eq__(self, other: Any) -> bool:
        return isinstance(other, TracedFunction) and self.key == other.key

    def __hash__(self) -> int:
        return hash(self.key)

    def __reduce__(self) -> Any:
        # A program cannot be pickled, but the function may be.
        return _itself, (self.function,)


def _itself(function: Callable[..., Any]) -> Callable[..., Any]:
    return function


def _comparable(value: Any) -> Hashable:
    """A part of a program in a form that is equal for programs with the same operations and constants."""
    if isinstance(value, ClosedJaxpr) and value.jaxpr is not value:
        return _comparable(value.jaxpr), _comparable(value.consts)
    if isinstance(value, Jaxpr):
        numbers: dict[Any, int] = {}

        def named(variables: Sequence[Any]) -> tuple[Hashable, ...]:
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
    # Numbers by their bytes: 0.0 equals -0.0, and True equals 1.
    return (type(value), repr(value)) if isinstance(value, int | float) else value if _hashable(value) else id(value)


def _hashable(value: Any) -> bool:
    try:
        hash(value)
    except TypeError:
        return False
    return True


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


#: Operations that move elements or change nothing: applied to slope and offset alike.
LINEAR = ["broadcast_in_dim", "reshape", "squeeze", "expand_dims", "slice", "transpose", "rev", "reduce_sum", "neg"]
LINEAR += ["copy", "copy_p", "stop_gradient", "optimization_barrier"]
COMPARISONS = ["gt", "ge", "lt", "le", "eq", "ne", "lt_to", "le_to"]
KINKS = ["max", "min", "abs", "sign", "clamp"]
STAIRS = ["floor", "ceil", "round"]

#: Functions of JAX that are smooth, whatever their operations.
SMOOTH = ["sinc"]


def jumps_of(function: Callable[..., Any], t: Any, *others: Any) -> tuple[Float[Array, " jumps"], tuple[str, ...]]:
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
    times_of: Callable[[Any], Float[Array, " jumps"]], numbers: Any, shape: tuple[int, ...]
) -> Float[Array, "jumps *cells"] | None:
    """Times that follow from the numbers of a run, for all cells; `None` if there are no times.

    **Arguments:** `numbers`: a tree of arrays, each with the cells in its last axis, or scalars for all cells; `shape`: that
    of the cells, () for a single run.
    """
    axes = jax.tree.map(lambda leaf: -1 if jnp.ndim(leaf) else None, numbers)
    is_mapped = shape != () and any(jnp.ndim(leaf) for leaf in jax.tree.leaves(numbers))
    times = jax.vmap(times_of, in_axes=(axes,), out_axes=-1)(numbers) if is_mapped else times_of(numbers)
    rows = [jnp.broadcast_to(time, shape) for time in times]
    return jnp.stack(rows) if rows else None


def warn_of_unclear(name: str, function: Callable[..., Any], *others: Any, remedy: str = "") -> None:
    """Warn if a function of time compares something whose times are unknown. **Arguments:** `name`: the function, such as
    "input(t, motion)"; `others`: examples of its arguments after the time; `remedy`: what else the user can do."""
    unclear: list[str] = []

    def times(*others: Any) -> Array:
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

    times: list[Any]
    unclear: dict[str, None]

    def read(self, program: Any, inputs: Sequence[Any]) -> list[Any]:
        """The kinds of the results of a program."""
        return read_program(program, inputs, self.apply, Known)

    def apply(self, equation: Any, inputs: list[Any]) -> list[Any]:
        """The kinds of the results of an equation."""
        name, parameters, count = equation.primitive.name, equation.params, len(equation.outvars)
        if all(isinstance(kind, Known) for kind in inputs):
            return list(map(Known, bound(equation, [kind.value for kind in inputs])))
        depends = any(map(_depends, inputs))
        if parameters.get("name") in SMOOTH:
            return [Other(depends)] * count
        if parameters.get("name") == "searchsorted" and isinstance(inputs[0], Known):
            return [self.compared(name, [Known(jnp.ravel(inputs[0].value)), inputs[1]])]
        if name == "cond":
            branches = [self.read(branch, inputs[1:]) for branch in parameters["branches"]]
            return [Other(any(map(_depends, (inputs[0], *kinds)))) for kinds in zip(*branches, strict=True)]
        if name in ("while", "scan"):
            if depends and any(_compares(part) for part in parameters.values()):
                self.unclear[name] = None
            return [Other(depends)] * count
        if (inner := called_program(equation)) is not None:
            return self.read(inner, inputs)
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

    def compared(self, name: str, inputs: Sequence[Any]) -> Other:
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


def _affine(name: str, equation: Any, inputs: Sequence[Any]) -> Affine | None:
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


def _depends(kind: Any) -> bool:
    """Whether a value depends on the time other than by jumps that were found."""
    return isinstance(kind, Affine) or (isinstance(kind, Other) and kind.depends_on_time)


def _compares(part: Any) -> bool:
    """Whether a jaxpr compares real numbers."""
    jaxpr = getattr(part, "jaxpr", part)
    return hasattr(jaxpr, "eqns") and any(
        (equation.primitive.name in COMPARISONS and jnp.issubdtype(equation.invars[0].aval.dtype, jnp.inexact))
        or any(_compares(inner) for inner in equation.params.values())
        for equation in jaxpr.eqns
    )
