"""Evaluate a user's functions, which are written for one run, in every lane.

Users write functions of small matrices. Mapped over lanes, these are arrays with a short last axis, which compilers do
not turn into vector instructions, and their zeros are multiplied like other numbers. Here each element of each array is
a separate number: zeros and ones disappear, and repeated expressions are computed once. A product of zero and a factor
that is not finite still makes a result NaN.
"""

import contextlib
import functools
import itertools
import math
import operator
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from ..text import AbstractHeld, is_array, is_numbers, is_users, joined, parted
from ..validation import is_traced
from .tracing import spelled_out
from .xla_cpu import bound, read_program, stored, traced

#: Operations on numbers, element by element.
BY_ELEMENT = """
    abs acos acosh add add_any and asin asinh atan atan2 atanh cbrt ceil clamp convert_element_type copy copy_p cos cosh
    digamma div eq erf erf_inv erfc exp exp2 expm1 floor ge gt integer_pow is_finite le lgamma log log1p log2 logistic lt max
    min mul ne neg nextafter not one_minus_square or polynomial pow rem round rsqrt select_n sign sin sinh sqrt square
    stop_gradient sub tan tanh xor
"""

#: Operations that are expensive enough to be computed once only; XLA would compute them again for each result.
COSTLY = """
    acos acosh asin asinh atan atan2 atanh cbrt cos cosh erf exp exp2 expm1 log log1p log2 logistic pow sin sinh tan tanh
"""

#: Operations whose result may not be finite although their operands are, apart from overflow in sums and products.
RISKY = """
    acos acosh asin atanh cosh digamma div erf_inv exp exp2 expm1 integer_pow lgamma log log1p log2 pow rem rsqrt sinh
    sqrt
"""

#: Operations whose result is not finite if an operand is not; for a quotient, if the dividend is not.
TRANSPARENT = """
    abs add add_any cbrt convert_element_type copy copy_p cos div log log1p log2 mul neg one_minus_square sin sinh sqrt square
    stop_gradient sub tan
"""

#: A function with more scalar operations than this is left in arrays: it would take long to compile.
MOST_OPERATIONS = 1500

#: Elements of an array: NumPy constants, or traced numbers, one for all lanes or one per lane.
Elements = Any


class TooLarge(Exception):
    """The function has unsupported operations, or too many operations."""


def by_components(function: Callable[..., Any], *shapes: Any) -> Callable[..., Any]:
    """Convert a function of numbers to a function of vectors of lanes.

    **Arguments:**

    - `function`: takes and returns scalars.
    - `shapes`: shapes of its arguments, as for `jax.eval_shape`.

    **Returns:** the function, whose arguments are scalars or have one number per lane. It raises `TooLarge` for a
    function that is faster with arrays.
    """

    def evaluated(*args: Any) -> Any:
        closed, shape = traced(function, *shapes)
        leaves, evaluation = [_elements(leaf) for leaf in jax.tree.leaves(args)], Evaluation()
        results = read_program(closed, leaves, evaluation.apply, _constants)
        numbers = evaluation.with_hidden([result.item() for result in results])
        return jax.tree.unflatten(jax.tree.structure(shape), [jnp.asarray(number) for number in numbers])

    return evaluated


def over_lanes(function: Callable[..., Any], numbers: tuple[Array, ...], parts: tuple[Array, ...]) -> Any:
    """A function of one run, evaluated in every lane.

    **Arguments:** `function`: a function of the numbers and of the components of the state, all scalars; `numbers`: each
    a scalar or one number per lane; `parts`: the components, one number per lane, or scalars for a single run.

    **Returns:** the results, scalars in place of which each lane has its own.
    """
    shapes = tuple(tuple(jax.ShapeDtypeStruct((), jnp.asarray(x).dtype) for x in xs) for xs in (numbers, parts))
    with contextlib.suppress(TooLarge):
        results = by_components(function, *shapes)(numbers, parts)
        return jax.tree.map(lambda result: jnp.broadcast_to(result, parts[0].shape), results)
    if parts[0].ndim == 0:
        return spelled_out(function)(numbers, parts)
    axes = tuple(0 if jnp.ndim(number) else None for number in numbers)
    return jax.vmap(spelled_out(function), in_axes=(axes, 0))(numbers, parts)


def _elements(number: Array) -> Elements:
    """A number in every lane as an array with a single element."""
    elements = np.empty((), object)
    elements[()] = number
    return elements


def _constants(array: Any) -> Elements:
    """The elements of an array that is known, or that is traced outside the function."""
    elements = np.empty(np.shape(array), object)
    constants_array = array if is_traced(array) else np.asarray(array)
    for index in np.ndindex(elements.shape):
        elements[index] = constants_array[index]
    return elements


class Evaluation:
    """An evaluation of a function: the results so far, by operation and operands."""

    def __init__(self):
        self.computed: dict[Any, Any] = {}
        # Operands are identified by their address, so all of them must stay in memory.
        self.kept: list[Any] = []
        # By address: what may not be finite, what makes a result not finite, and what was multiplied by zero.
        self.risky: set[int] = set()
        self.sources: dict[int, list[Any]] = {}
        self.dropped: list[Any] = []

    def apply(self, equation: Any, inputs: list[Elements]) -> list[Elements]:
        """The results of an equation."""
        name, params = equation.primitive.name, equation.params
        if name in ("jit", "pjit"):
            return read_program(params["jaxpr"], inputs, self.apply, _constants)
        if name in BY_ELEMENT.split():
            return [self._by_element(equation, inputs)]
        if name == "optimization_barrier":
            return inputs
        if name == "dot_general":
            left, right = inputs
            return [self._product(left, right, params["dimension_numbers"])]
        if name in ("reduce_sum", "reduce_max", "reduce_min"):
            return [self._reduced(name.removeprefix("reduce_").replace("sum", "add"), inputs[0], params["axes"])]
        if name == "split":
            return np.split(inputs[0], np.cumsum(params["sizes"])[:-1], axis=params["axis"])
        if name == "unstack":
            axis = params["axis"]
            # The ellipsis keeps an array, even where a single element is left.
            return [inputs[0][(slice(None),) * axis + (k, ...)] for k in range(inputs[0].shape[axis])]
        if name in MOVES:
            return [MOVES[name](equation, *inputs)]
        raise TooLarge(name)

    def _by_element(self, equation: Any, inputs: list[Elements]) -> Elements:
        shape = equation.outvars[0].aval.shape
        results, name = np.empty(shape, object), equation.primitive.name
        broadcast = [np.broadcast_to(value, shape) for value in inputs]
        for index in np.ndindex(shape):
            results[index] = self._number(name, [value[index] for value in broadcast], equation)
        return results

    def _number(self, name: str, operands: list[Any], equation: Any = None) -> Any:
        """A scalar operation: arithmetic, or the operation of an equation."""
        simplified = _simplified(name, operands)
        if simplified is not None:
            if name == "mul" and _is_constant(simplified):
                self.dropped += [operand for operand in operands if id(operand) in self.risky]
            return simplified
        if all(map(_is_constant, operands)) and name in ("eq", "ne", "lt", "le", "gt", "ge"):
            return np.bool_(getattr(operator, name)(*operands))
        if name == "convert_element_type" and _is_constant(operands[0]):
            return np.dtype(equation.params["new_dtype"]).type(operands[0])
        keys = tuple((float(x), str(x.dtype)) if _is_constant(x) else id(x) for x in operands)
        key = (name, "" if name in FUNCTIONS else str(equation.params), keys)
        if key not in self.computed:
            if len(self.computed) > MOST_OPERATIONS:
                raise TooLarge(name)
            shape = np.broadcast_shapes(*map(np.shape, operands))
            operands_of_shape = [jnp.broadcast_to(jnp.asarray(operand), shape) for operand in operands]
            self.kept += operands
            bind = (
                FUNCTIONS[name] if name in FUNCTIONS else functools.partial(equation.primitive.bind, **equation.params)
            )
            result = bind(*operands_of_shape)
            # Stored together with an operand, because XLA would recompute a result that is stored alone.
            result = stored(result, operands_of_shape[0])[0] if name in COSTLY.split() else result
            if _is_risky(name, operands, equation) or any(id(operand) in self.risky for operand in operands):
                self.risky.add(id(result))
            if name in TRANSPARENT.split():
                self.sources[id(result)] = operands[:1] if name == "div" else operands
            self.computed[key] = result
        return self.computed[key]

    def with_hidden(self, results: list[Any]) -> list[Any]:
        """The results. The first result is NaN where zero is multiplied by a factor that is not finite and no result
        shows this. Most such factors are also terms of a result, which is then not finite. The other factors, which are
        rare, are multiplied by zero and added to the first result.
        """
        visited, stack = set(), list(results)
        while stack:
            number = stack.pop()
            if id(number) not in visited:
                visited.add(id(number))
                stack += self.sources.get(id(number), [])
        factors = {id(factor): factor for factor in self.dropped if id(factor) not in visited}
        place = next((k for k, result in enumerate(results) if jnp.issubdtype(result.dtype, jnp.floating)), None)
        if not factors or place is None:
            return results
        total = functools.reduce(operator.add, factors.values())
        return [result + 0.0 * total if k == place else result for k, result in enumerate(results)]

    def _sum(self, terms: Iterator[Any], name: str = "add") -> Any:
        return functools.reduce(lambda total, term: self._number(name, [total, term]), terms)

    def _reduced(self, name: str, elements: Elements, axes: Sequence[int]) -> Elements:
        kept_axes = [k for k in range(elements.ndim) if k not in axes]
        rows = np.transpose(elements, (*kept_axes, *axes)).reshape(
            *(elements.shape[k] for k in kept_axes), math.prod(elements.shape[k] for k in axes)
        )
        results = np.empty(rows.shape[:-1], object)
        for index in np.ndindex(results.shape):
            results[index] = self._sum(iter(rows[index]), name) if rows.shape[-1] else np.float64(0.0)
        return results

    def _product(self, left: Elements, right: Elements, dimensions: Any) -> Elements:
        """The sum over the contracted axes; batch axes come first, then those of the left and those of the right."""
        (sums, right_sums), (batch, right_batch) = dimensions
        free = [k for k in range(left.ndim) if k not in (*sums, *batch)]
        right_free = [k for k in range(right.ndim) if k not in (*right_sums, *right_batch)]
        shapes = [[left.shape[k] for k in batch], [left.shape[k] for k in free], [right.shape[k] for k in right_free]]
        # There may be no elements: a system without constraints has empty arrays.
        count = math.prod(left.shape[k] for k in sums)
        rows = np.transpose(left, (*batch, *free, *sums)).reshape(*shapes[0], *shapes[1], count)
        columns = np.transpose(right, (*right_batch, *right_free, *right_sums)).reshape(*shapes[0], *shapes[2], count)
        results = np.empty([*shapes[0], *shapes[1], *shapes[2]], object)
        for lane, row, column in itertools.product(*(list(np.ndindex(*shape)) for shape in shapes)):
            pairs = zip(rows[(*lane, *row)], columns[(*lane, *column)], strict=True)
            terms = (self._number("mul", list(pair)) for pair in pairs)
            results[(*lane, *row, *column)] = self._sum(terms) if count else np.float64(0.0)
        return results


def _is_constant(number: Any) -> bool:
    return isinstance(number, np.generic)


def _is_risky(name: str, operands: list[Any], equation: Any) -> bool:
    """Whether the result of an operation may not be finite though its operands are."""
    if name == "div" and _is_constant(operands[1]):
        return operands[1] == 0.0
    if name == "integer_pow":
        return equation.params["y"] < 0
    return name in RISKY.split()


def _simplified(name: str, operands: list[Any]) -> Any:
    """The result of an operation that needs no computation; otherwise `None`."""
    if name == "select_n" and _is_constant(operands[0]):
        return operands[1 + int(operands[0])]
    if name in ("copy", "copy_p", "stop_gradient") and _is_constant(operands[0]):
        return operands[0]
    if name not in ARITHMETIC or not all(np.issubdtype(operand.dtype, np.floating) for operand in operands):
        return None
    if all(map(_is_constant, operands)):
        with np.errstate(all="ignore"):
            return operands[0].dtype.type(ARITHMETIC[name](*operands))
    if name == "neg":
        return None
    left, right = ((float(operand) if _is_constant(operand) else None) for operand in operands)
    if name in ("add", "add_any"):
        return operands[1] if left == 0.0 else operands[0] if right == 0.0 else None
    if name == "sub":
        return operands[0] if right == 0.0 else None
    if name == "mul":
        # The zeros of a matrix (`Evaluation.with_hidden`).
        if 0.0 in (left, right):
            return operands[0].dtype.type(0.0)
        return operands[1] if left == 1.0 else operands[0] if right == 1.0 else None
    return operands[0] if right == 1.0 else None


#: Operations that are applied to constants immediately.
ARITHMETIC = {
    "add": operator.add,
    "add_any": operator.add,
    "sub": operator.sub,
    "mul": operator.mul,
    "div": operator.truediv,
    "neg": operator.neg,
}

#: Operations that make up sums and products.
FUNCTIONS = {"add": jax.lax.add, "mul": jax.lax.mul, "max": jax.lax.max, "min": jax.lax.min}


def _broadcast(equation: Any, elements: Elements, *dynamic: Any) -> Elements:
    shape, places = equation.params["shape"], equation.params["broadcast_dimensions"]
    inner = [1] * len(shape)
    for axis, place in enumerate(places):
        inner[place] = elements.shape[axis]
    return np.broadcast_to(elements.reshape(inner), shape)


def _padded(equation: Any, elements: Elements, filling: Elements) -> Elements:
    widths = equation.params["padding_config"]
    if any(interior for _, _, interior in widths) or any(width < 0 for width in np.ravel(widths)):
        raise TooLarge("pad")
    result = np.full(equation.outvars[0].aval.shape, None, object)
    result.fill(filling.item())
    result[tuple(slice(low, low + size) for (low, _, _), size in zip(widths, elements.shape, strict=True))] = elements
    return result


def _sliced(equation: Any, elements: Elements) -> Elements:
    params = equation.params
    steps = params["strides"] or (1,) * elements.ndim
    return elements[tuple(map(slice, params["start_indices"], params["limit_indices"], steps))]


def _reshaped(equation: Any, elements: Elements) -> Elements:
    return elements.reshape(equation.outvars[0].aval.shape)


def _counted(equation: Any) -> Elements:
    params = equation.params
    indices = np.arange(params["shape"][params["dimension"]]).astype(params["dtype"])
    axes = [1] * len(params["shape"])
    axes[params["dimension"]] = -1
    return _constants(np.broadcast_to(indices.reshape(axes), params["shape"]))


#: Operations that move numbers.
MOVES: dict[str, Callable[..., Elements]] = {
    "broadcast_in_dim": _broadcast,
    "concatenate": lambda equation, *parts: np.concatenate(parts, axis=equation.params["dimension"]),
    "expand_dims": _reshaped,
    "iota": _counted,
    "pad": _padded,
    "reshape": _reshaped,
    "rev": lambda equation, elements: np.flip(elements, equation.params["dimensions"]),
    "slice": _sliced,
    "squeeze": _reshaped,
    "stack": lambda equation, *parts: np.stack(parts, axis=equation.params["axis"]),
    "transpose": lambda equation, elements: np.transpose(elements, equation.params["permutation"]),
}


# Map a function over the last axis of its arguments, and keep this axis last.
#
# `jax.vmap` moves the mapped axis to the front of products and of arrays that are joined. Where the axis counts lanes,
# compilers vectorise only along the last axis, so this costs up to ten times as much for a function of medium size, such as
# a network of a thousand weights.

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


# Users' objects, such as laws and surfaces, whose methods are written for a single run and evaluated in every lane.


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
