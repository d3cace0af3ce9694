"""Trace a user's functions to find the arguments on which they depend, and the operations of which they consist."""

import contextlib
import functools
import math
from collections.abc import Callable, Hashable, Iterator, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.extend.core import ClosedJaxpr, Jaxpr, Literal, jaxpr_as_fun
from jaxtyping import Array

from ..compilation.programs import bound, operations, read_program, traced
from ..validation import UNTRACEABLE, is_traced

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
        return [_product(*inputs, params["dimension_numbers"])]
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
