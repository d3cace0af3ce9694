"""Evaluate a user's functions, which are written for one run, in every lane.

Users write functions of small matrices. Mapped over lanes, these are arrays with a short last axis, which compilers do
not turn into vector instructions, and their zeros are multiplied like other numbers. Here each element of each array is
a separate number: zeros and ones disappear, and repeated expressions are computed once. A product of zero and a factor
that is not finite still makes a result NaN.
"""

import abc
import contextlib
import dataclasses
import dis
import functools
import math
import operator
import sys
import sysconfig
from collections.abc import Callable, Hashable, Sequence
from types import CellType, CodeType, FunctionType, MethodType, SimpleNamespace
from typing import Any, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, PyTree

from ..text import OWN, is_array, is_numbers, is_users, joined, parted
from ..validation import is_traced
from .xla_cpu import Equation, Function, Program, bound, read_program, stored, traced

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

#: An element of an array; and all of them: in an `Evaluation` NumPy constants, or traced numbers for all lanes or one per lane.
Element = Any
Elements = np.ndarray


#: Elements, or an array of JAX.
Movable = TypeVar("Movable", Elements, Array)

#: For each factor of a product, some of its axes.
Axes = tuple[Sequence[int], Sequence[int]]


class TooLarge(Exception):
    """The function has unsupported operations, or too many operations."""


def by_components(function: Function, *shapes: PyTree) -> Function:
    """Convert a function of arrays that returns numbers to a function of lanes, number by number.

    **Arguments:**

    - `function`: takes arrays, and returns scalars.
    - `shapes`: shapes of its arguments, as for `jax.eval_shape`.

    **Returns:** the function, whose arguments have one more axis than these, of lanes, or are the same for all lanes. It
    raises `TooLarge` for a function that is faster with arrays.
    """

    def evaluated(*args: PyTree) -> PyTree:
        closed, shape = traced(function, *shapes)
        evaluation = Evaluation()
        results = evaluation.read(closed, list(map(_elements, jax.tree.leaves(args), jax.tree.leaves(shapes))))
        numbers = evaluation.with_hidden([result.item() for result in results])
        return jax.tree.unflatten(jax.tree.structure(shape), [jnp.asarray(number) for number in numbers])

    return evaluated


def _elements(array: Array, own: jax.ShapeDtypeStruct) -> Elements:
    """The elements of an array that may have lanes in its last axis, besides its own axes."""
    elements = np.empty(own.shape, object)
    if own.shape == ():
        elements[()] = array
        return elements
    flat = array.reshape(-1, *array.shape[len(own.shape) :])
    # The derivative of this operation joins all elements at once.
    rows = jax.lax.split(flat, (1,) * len(flat))
    for index, row in zip(np.ndindex(own.shape), rows, strict=True):
        elements[index] = row[0]
    return elements


def over_lanes(function: Function, *arguments: PyTree) -> PyTree:
    """A function of one run, evaluated in every lane.

    **Arguments:** `function`: a function of trees of scalars; `arguments`: the trees, with scalars or one number per lane.

    **Returns:** the results, with one number per lane, or scalars if no argument has lanes.
    """
    leaves, structure = jax.tree.flatten(arguments)
    kinds = jax.tree.unflatten(structure, [jax.ShapeDtypeStruct((), jnp.result_type(leaf)) for leaf in leaves])
    shape = np.broadcast_shapes(*map(jnp.shape, leaves))
    with contextlib.suppress(TooLarge):
        results = by_components(function, *kinds)(*arguments)
        return jax.tree.map(lambda result: jnp.broadcast_to(result, shape), results)

    def of_run(*numbers: Array) -> tuple[Array, ...]:
        results = spelled_out(function)(*jax.tree.unflatten(structure, numbers))
        return tuple(map(jnp.asarray, jax.tree.leaves(results)))

    structure_of_results = jax.tree.structure(jax.eval_shape(function, *kinds))
    return jax.tree.unflatten(structure_of_results, jnp.vectorize(of_run)(*leaves))


class AbstractScalarReader(abc.ABC):
    """Reads traced programs number by number: an array is a NumPy array of its elements, which are of any kind.

    Operations that move elements cost nothing. Sums and products become operations on pairs of elements.
    """

    @abc.abstractmethod
    def constants(self, array: ArrayLike) -> Elements:
        """The elements of an array that is known."""

    @abc.abstractmethod
    def kind(self, equation: Equation) -> str:
        """The name of an operation that acts element by element. Raises an error for other operations."""

    @abc.abstractmethod
    def element(self, name: str, *numbers: Element, equation: Equation | None = None) -> Element:
        """The result of an operation, of this name, on single elements; some operations have parameters in `equation`."""

    def read(self, program: Program, arguments: Sequence[Elements]) -> list[Elements]:
        """The results of a program."""
        return read_program(program, arguments, self.apply, self.constants)

    def each(self, name: str, *values: Elements, equation: Equation | None = None) -> Elements:
        """Apply an operation element by element."""
        broadcast = np.broadcast_arrays(*values)
        results = np.empty(broadcast[0].shape, object)
        for index in np.ndindex(results.shape):
            results[index] = self.element(name, *(value[index] for value in broadcast), equation=equation)
        return results

    def apply(self, equation: Equation, inputs: list[Elements]) -> Sequence[Elements] | Program:
        """The results of an equation, or the program that it calls."""
        name, params = equation.primitive.name, equation.params
        if name == "optimization_barrier":
            return inputs
        if name in ("jit", "pjit"):
            return params["jaxpr"]
        if name in MOVES:
            return [MOVES[name](equation, *inputs)]
        if name == "iota":
            return [self.constants(np.indices(params["shape"])[params["dimension"]].astype(params["dtype"]))]
        if name == "split":
            return np.split(inputs[0], np.cumsum(params["sizes"])[:-1], axis=params["axis"])
        if name == "unstack":
            return rows_along(inputs[0], params["axis"])
        if name in REDUCTIONS:
            return [self.reduced(REDUCTIONS[name], inputs[0], params["axes"])]
        if name == "dot_general":
            left, right, summed = factors(inputs[0], inputs[1], params["dimension_numbers"])
            return [self.reduced("add", self.each("mul", left, right), summed)]
        return [self.each(self.kind(equation), *inputs, equation=equation)]

    def reduced(self, name: str, elements: Elements, axes: Sequence[int]) -> Elements:
        """Combine the elements along some axes, one by one."""
        kept = [size for k, size in enumerate(elements.shape) if k not in axes]
        if not elements.size:
            return self.constants(np.full(kept, {"mul": 1.0, "and": True, "or": False}.get(name, 0.0)))
        rows = np.moveaxis(elements, axes, range(-len(axes), 0)).reshape(*kept, -1)
        return functools.reduce(functools.partial(self.each, name), rows_along(rows, -1))


def rows_along(elements: Elements, axis: int) -> list[Elements]:
    """The arrays along an axis."""
    # The ellipsis keeps an array, even where a single element is left.
    return [np.moveaxis(elements, axis, 0)[k, ...] for k in range(elements.shape[axis])]


class Evaluation(AbstractScalarReader):
    """An evaluation of a function in lanes: the results so far, by operation and operands."""

    def __init__(self):
        self.computed: dict[Hashable, Element] = {}
        # Operands are identified by their address, so all of them must stay in memory.
        self.kept: list[Element] = []
        # By address: what may not be finite, what makes a result not finite, and what was multiplied by zero.
        self.risky: set[int] = set()
        self.sources: dict[int, Sequence[Element]] = {}
        self.dropped: list[Element] = []

    def constants(self, array: ArrayLike) -> Elements:
        # An array may be traced outside the function.
        constants: Any = array if is_traced(array) else np.asarray(array)
        elements = np.empty(np.shape(constants), object)
        for index in np.ndindex(elements.shape):
            elements[index] = constants[index]
        return elements

    def apply(self, equation: Equation, inputs: list[Elements]) -> Sequence[Elements] | Program:
        if equation.primitive.name == "dot_general":
            # The factors may be of different types, such as a matrix of whole numbers and a state.
            kind = equation.outvars[0].aval.dtype
            convert = np.frompyfunc(lambda number: number if number.dtype == kind else number.astype(kind), 1, 1)
            inputs = [convert(value) for value in inputs]
        return super().apply(equation, inputs)

    def kind(self, equation: Equation) -> str:
        if equation.primitive.name not in BY_ELEMENT.split():
            raise TooLarge(equation.primitive.name)
        return equation.primitive.name

    def element(self, name: str, *numbers: Element, equation: Equation | None = None) -> Element:
        simplified = _simplified(name, numbers)
        if simplified is not None:
            if name == "mul" and _is_constant(simplified):
                self.dropped += [number for number in numbers if id(number) in self.risky]
            return simplified
        if all(map(_is_constant, numbers)) and name in ("eq", "ne", "lt", "le", "gt", "ge"):
            return np.bool_(getattr(operator, name)(*numbers))
        # The operations of sums and products have no parameters.
        params = {} if equation is None or name in FUNCTIONS else equation.params
        if name == "convert_element_type" and _is_constant(numbers[0]):
            return np.dtype(params["new_dtype"]).type(numbers[0])
        keys = tuple((float(x), str(x.dtype)) if _is_constant(x) else id(x) for x in numbers)
        key = (name, str(params), keys)
        if key not in self.computed:
            if len(self.computed) > MOST_OPERATIONS:
                raise TooLarge(name)
            operands = jnp.broadcast_arrays(*numbers)
            self.kept += numbers
            if name in FUNCTIONS:
                result = FUNCTIONS[name](*operands)
            else:
                assert equation is not None
                result = equation.primitive.bind(*operands, **params)
            # Stored together with an operand, because XLA would recompute a result that is stored alone.
            result = stored(result, operands[0])[0] if name in COSTLY.split() else result
            if _is_risky(name, numbers, params) or any(id(number) in self.risky for number in numbers):
                self.risky.add(id(result))
            if name in TRANSPARENT.split():
                self.sources[id(result)] = numbers[:1] if name == "div" else numbers
            self.computed[key] = result
        return self.computed[key]

    def with_hidden(self, results: list[Array]) -> list[Array]:
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


def _is_constant(number: Element) -> bool:
    return isinstance(number, np.generic)


def _is_risky(name: str, operands: Sequence[Element], params: dict[str, Any]) -> bool:
    """Whether the result of an operation may not be finite though its operands are."""
    if name == "div" and _is_constant(operands[1]):
        return operands[1] == 0.0
    return params["y"] < 0 if name == "integer_pow" else name in RISKY.split()


def _simplified(name: str, operands: Sequence[Element]) -> Element | None:
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
ARITHMETIC = {"add": operator.add, "add_any": operator.add, "sub": operator.sub, "mul": operator.mul}
ARITHMETIC |= {"div": operator.truediv, "neg": operator.neg}

#: Operations on pairs of elements, which make up the sums, products and extremes of arrays.
FUNCTIONS = {"add": jax.lax.add, "mul": jax.lax.mul, "max": jax.lax.max, "min": jax.lax.min}
FUNCTIONS |= {"and": jax.lax.bitwise_and, "or": jax.lax.bitwise_or}
REDUCTIONS = {"reduce_sum": "add", "reduce_prod": "mul", "reduce_max": "max", "reduce_min": "min"}
REDUCTIONS |= {"reduce_and": "and", "reduce_or": "or"}


def _broadcast(equation: Equation, elements: Elements) -> Elements:
    shape, places = equation.params["shape"], equation.params["broadcast_dimensions"]
    inner = [1] * len(shape)
    for axis, place in enumerate(places):
        inner[place] = elements.shape[axis]
    return np.broadcast_to(elements.reshape(inner), shape)


def _padded(equation: Equation, elements: Elements, filling: Elements) -> Elements:
    result = np.full(equation.outvars[0].aval.shape, None, object)
    result.fill(filling.item())
    places, kept = [], []
    for (low, _, interior), size, length in zip(
        equation.params["padding_config"], elements.shape, result.shape, strict=True
    ):
        place = low + (1 + interior) * np.arange(size)
        kept.append(np.flatnonzero((place >= 0) & (place < length)))
        places.append(place[kept[-1]])
    result[np.ix_(*places)] = elements[np.ix_(*kept)]
    return result


def _sliced(equation: Equation, elements: Elements) -> Elements:
    params = equation.params
    steps = params["strides"] or (1,) * len(params["start_indices"])
    return elements[tuple(map(slice, params["start_indices"], params["limit_indices"], steps))]


def _reshaped(equation: Equation, elements: Elements) -> Elements:
    return elements.reshape(equation.outvars[0].aval.shape)


#: Operations that move elements.
MOVES: dict[str, Callable[..., Elements]] = {
    "broadcast_in_dim": _broadcast,
    "concatenate": lambda equation, *parts: np.concatenate(parts, axis=equation.params["dimension"]),
    "expand_dims": _reshaped,
    "pad": _padded,
    "reshape": _reshaped,
    "rev": lambda equation, elements: np.flip(elements, equation.params["dimensions"]),
    "slice": _sliced,
    "squeeze": _reshaped,
    "stack": lambda equation, *parts: np.stack(parts, axis=equation.params["axis"]),
    "tile": lambda equation, elements: np.tile(elements, equation.params["reps"]),
    "transpose": lambda equation, elements: elements.transpose(equation.params["permutation"]),
}


# Products of small matrices as sums of products of their elements.

#: Products with at most this many terms are written as sums of products, which all of XLA's compilers accept.
MOST_TERMS = 1 << 12


def spelled_out(function: Function) -> Function:
    """The function with products of small matrices written as sums.

    For a product, XLA calls a library, which costs more than the product and does not fit a single kernel.
    """

    def evaluated(*args: PyTree) -> PyTree:
        closed, shape = jax.make_jaxpr(function, return_shape=True)(*args)
        return jax.tree.unflatten(jax.tree.structure(shape), read_program(closed, jax.tree.leaves(args), _spelled_out))

    return evaluated


def _spelled_out(equation: Equation, inputs: Sequence[ArrayLike]) -> Sequence[Array] | Program:
    name, params = equation.primitive.name, equation.params
    if name in ("jit", "pjit"):
        return params["jaxpr"]
    if name == "dot_general":
        (_, right_sums), (_, right_batch) = params["dimension_numbers"]
        left, right = map(jnp.asarray, inputs)
        columns = (size for k, size in enumerate(right.shape) if k not in (*right_sums, *right_batch))
        if left.size * math.prod(columns) <= MOST_TERMS:
            left, right, summed = factors(left, right, params["dimension_numbers"])
            return [jnp.sum(left * right, axis=summed)]
    return bound(equation, inputs)


def factors(
    left: Movable, right: Movable, dimensions: tuple[Axes, Axes], inner: int = 0
) -> tuple[Movable, Movable, tuple[int, ...]]:
    """Two arrays whose product, summed over the returned axes, is their sum over the contracted axes; batch axes come first,
    then those of the left and those of the right, and then `inner` axes that both arrays have at the end."""
    (sums, right_sums), (batch, right_batch) = dimensions
    free = [k for k in range(left.ndim - inner) if k not in (*sums, *batch)]
    right_free = [k for k in range(right.ndim - inner) if k not in (*right_sums, *right_batch)]
    left = left.transpose((*batch, *free, *sums, *range(left.ndim - inner, left.ndim)))
    right = right.transpose((*right_batch, *right_free, *right_sums, *range(right.ndim - inner, right.ndim)))
    first, middle = len(batch), len(batch) + len(free)
    left = left.reshape((*left.shape[:middle], *(1 for _ in right_free), *left.shape[middle:]))
    right = right.reshape((*right.shape[:first], *(1 for _ in free), *right.shape[first:]))
    end = middle + len(right_free)
    return left, right, tuple(range(end, end + len(sums)))


# Map a function over the last axis of its arguments, and keep this axis last.
#
# `jax.vmap` moves the mapped axis of a whole function to the front. Where the axis counts lanes, compilers vectorise only along
# the last axis, so this costs up to ten times as much for a function of medium size, such as a network of a thousand
# weights. Here each operation is mapped on its own, and XLA drops the transpositions between them.


def over_last_axis(function: Function, *shapes: PyTree) -> Function:
    """Map a function over the last axis.

    **Arguments:** `function`: function of arrays; `shapes`: shapes of its arguments, as for `jax.eval_shape`.

    **Returns:** the function, whose arguments have one more axis than these, or are the same for all members.
    """

    def mapped(*arguments: PyTree) -> PyTree:
        closed, shape = traced(function, *shapes)
        leaves, expected = jax.tree.leaves(arguments), jax.tree.leaves(shapes)
        size = next(leaf.shape[-1] for leaf, own in zip(leaves, expected, strict=True) if jnp.ndim(leaf) > own.ndim)
        results = map(_with_axis, read_program(closed, leaves, _applied), closed.out_avals)
        outputs = [jnp.broadcast_to(result, (*result.shape[:-1], size)) for result in results]
        return jax.tree.unflatten(jax.tree.structure(shape), outputs)

    return mapped


def _with_axis(value: ArrayLike, own: jax.ShapeDtypeStruct) -> Array:
    """A value with the mapped axis; of length 1 if the value is the same for all members."""
    value = jnp.asarray(value)
    return value if value.ndim > own.ndim else value[..., None]


def _applied(equation: Equation, operands: list[Array]) -> Sequence[Array] | Program:
    """The results of an equation, with one more axis where an operand has one more."""
    kinds = [atom.aval for atom in equation.invars]
    axes = [-1 if jnp.ndim(operand) > kind.ndim else None for operand, kind in zip(operands, kinds, strict=True)]
    if equation.primitive.name in ("jit", "pjit") or set(axes) <= {None}:
        return _spelled_out(equation, operands)
    if equation.primitive.name == "dot_general":
        left, right = map(_with_axis, operands, kinds)
        left, right, summed = factors(left, right, equation.params["dimension_numbers"], inner=1)
        return [jnp.sum(left * right, axis=summed)]
    return jax.vmap(lambda *operands: bound(equation, operands), in_axes=axes, out_axes=-1)(*operands)


def over_cells(function: Function, tree: PyTree) -> Function:
    """Map a function of a tree of one run, such as a problem or a mode, and of more arguments, over cells, which are in the
    last axis of every array."""

    def mapped(*arguments: PyTree) -> PyTree:
        axes = (lambda leaf: -1 if eqx.is_array(leaf) and leaf.ndim else None, *[-1] * len(arguments))
        return eqx.filter_vmap(function, in_axes=axes, out_axes=-1)(tree, *arguments)

    return mapped


# Users' objects, such as laws and surfaces, whose methods are written for a single run and evaluated in every lane.


def method_over_lanes(method: Function) -> Function:
    """A user's method, written for a single run, that also accepts arguments with one number per lane.

    Single numbers are passed on as they are, with the object's arrays whole. For arrays of numbers, the method is mapped over
    them and over the numbers of the object, each of which is a scalar or has one value per lane.
    """

    @functools.wraps(method)
    def mapped(self: eqx.Module, *arguments: PyTree) -> PyTree:
        own = [leaf for leaf in jax.tree.leaves(self, is_leaf=is_numbers) if is_numbers(leaf)]
        if all(jnp.ndim(leaf) == 0 for leaf in jax.tree.leaves((own, arguments))):
            return method(joined(self), *arguments)
        arrays, static = eqx.partition((self, arguments), is_array)

        def of_run(arrays: PyTree) -> PyTree:
            whole, arguments = joined(eqx.combine(arrays, static))
            return jax.tree.map(jnp.asarray, method(whole, *arguments))

        return over_lanes(of_run, arrays)

    return mapped


def map_methods(kind: type, names: Sequence[str]) -> None:
    """Map the named methods over lanes where a user's class defines them; its `bounds` see whole arrays."""
    for name in names if is_users(kind) else ():
        if name in vars(kind):
            setattr(kind, name, method_over_lanes(getattr(kind, name)))
    if is_users(kind) and "bounds" in vars(kind):
        bounds = kind.bounds
        kind.bounds = functools.wraps(bounds)(lambda self: bounds(joined(self)))


def held(value: Any, evaluate: Function) -> Any:
    """A user's object with `Numbers` in place of its arrays if these hold the numbers of a single run. Arrays with one
    number per lane stay as they are, and so do these packages' own objects. If the methods of a user's class read other
    numbers from elsewhere than before, all compiled programs are cleared.

    **Arguments:** `evaluate`: evaluates the object for single numbers; if a result is an array, the object has one number
    per lane.
    """
    kind: Any = type(value)
    if not is_users(kind):
        return value
    # JAX knows programs by the class, which reads other numbers than before if these attributes differ.
    before, kind.__outside__ = vars(kind).get("__outside__"), outside(kind, set())
    if before not in (None, kind.__outside__):
        jax.clear_caches()
    if not any(is_array(leaf) and leaf.ndim for leaf in jax.tree.leaves(value)):
        return value
    try:
        results = jax.eval_shape(lambda: evaluate(value))
    except (TypeError, ValueError, jax.errors.JAXTypeError):
        # The checks of the object say what is wrong with it.
        return value
    return parted(value) if all(result.shape == () for result in jax.tree.leaves(results)) else value


class Held(eqx.Module):
    """A user's module that is a function of numbers, written for a single run, as a function of numbers or of lanes.

    This object has the module's attributes, too. `function` is the module with `Numbers` in place of its arrays: each number
    is a leaf.
    """

    function: Function

    @method_over_lanes
    def __call__(self, *arguments: PyTree) -> PyTree:
        return self.function(*arguments)

    @property
    def whole(self) -> PyTree:
        """The module with its arrays."""
        return joined(self.function)

    def __repr__(self) -> str:
        return repr(self.whole)

    def __getattr__(self, name: str) -> Any:
        if name.startswith("_") or name == "function":
            raise AttributeError(name)
        return getattr(self.whole, name)


# What users' functions read from elsewhere, which JAX does not notice if it changes.


def outside(value: Any, seen: set[int]) -> Hashable:
    """What a user's functions and classes read from elsewhere: numbers, texts and arrays of their module, of closures, defaults
    and class attributes. If one of them changes, other programs are needed.

    **Arguments:** `value`: a function, a class, a module of Equinox, a container of such, or anything else; `seen`: what was
    read before.
    """
    if isinstance(value, int | float | complex | str):
        return type(value), value
    if isinstance(value, np.ndarray | jax.Array) and not is_traced(value):
        array = np.asarray(value)
        return array.shape, array.dtype.str, array.tobytes() if array.dtype != object else id(value)
    if id(value) in seen:
        return None
    seen.add(id(value))
    # Of properties, class methods and Equinox's methods.
    inner = [getattr(value, name, None) for name in ("__func__", "fget", "method", "__wrapped__")]
    parts: list[Any] = [part for part in inner if isinstance(part, FunctionType)]
    if isinstance(value, dict | list | tuple):
        parts = list(value.values() if isinstance(value, dict) else value)
    elif isinstance(value, functools.partial):
        parts = [value.func, value.args, value.keywords]
    elif isinstance(value, MethodType):
        parts = [value.__func__, value.__self__]
    elif isinstance(value, eqx.Module):
        parts = [type(value), *functions_in([getattr(value, field.name, None) for field in dataclasses.fields(value)])]
    elif isinstance(value, SimpleNamespace) or not _is_library(getattr(value, "__module__", None)):
        if isinstance(value, type):
            named = vars(value).items()
            parts = [*value.__bases__, *(part for name, part in named if name == "__call__" or name[:2] != "__")]
        elif isinstance(value, FunctionType):
            known, cells = value.__globals__, [cell for cell in value.__closure__ or () if cell != CellType()]
            parts = [known[name] for name in globals_in(value.__code__) if name in known]
            parts += [*(cell.cell_contents for cell in cells), value.__defaults__]
        elif hasattr(value, "__dict__"):
            parts += [type(value), *vars(value).values()]
    return tuple(outside(part, seen) for part in parts)


def functions_in(tree: PyTree) -> tuple[Callable[..., Any] | eqx.Module, ...]:
    """The functions and the modules of a tree, without its numbers."""
    leaves = jax.tree.leaves(tree, is_leaf=lambda leaf: isinstance(leaf, eqx.Module))
    return tuple(leaf for leaf in leaves if callable(leaf) or isinstance(leaf, eqx.Module))


@functools.lru_cache(maxsize=1024)
def globals_in(code: CodeType) -> tuple[str, ...]:
    """The names that a function and the functions inside it look up in their module, in alphabetical order; an attribute of
    the same name is none of them."""
    inner = (name for constant in code.co_consts if isinstance(constant, CodeType) for name in globals_in(constant))
    own = (part.argval for part in dis.get_instructions(code) if part.opname in ("LOAD_GLOBAL", "LOAD_NAME"))
    return tuple(sorted({*inner, *own}))


@functools.lru_cache
def _is_library(module: str | None) -> bool:
    """Whether a module is installed, or part of Python or of these packages, and so does not change."""
    name = module or "builtins"
    file = getattr(sys.modules.get(name), "__file__", None) or ""
    is_installed = "site-packages" in file or file.startswith(sysconfig.get_path("stdlib"))
    return is_installed or name in sys.builtin_module_names or name.partition(".")[0] in OWN
