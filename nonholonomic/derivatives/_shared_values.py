"""Rewrite functions so that a value with several uses is computed only once.

XLA fuses every result of a function over many lanes with all operations that lead to it, and recomputes shared values
for each result. For the derivatives of a field, where nearly everything is shared, this multiplies the work. Here a
function is split into its operations, and values with several uses are stored: in levels, each joined into one array
followed by a barrier, as in `xla_cpu.stored`.
"""

from collections import Counter
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax.extend.core import Literal

from ..xla_cpu import stored

#: A value is stored if recomputing it for every use would cost at least this many more operations.
WORTH_STORING = 2

#: Operations that compute nothing.
FREE = ("broadcast_in_dim", "convert_element_type", "copy", "neg", "reshape", "squeeze")

#: Calls, whose operations count as the caller's own.
CALLS = ("closed_call", "custom_jvp_call", "custom_vjp_call", "jit", "pjit")


class Operation(NamedTuple):
    """One operation, and the indices of its input and output values."""

    equation: Any
    inputs: tuple[int, ...]
    outputs: tuple[int, ...]


class Stack(NamedTuple):
    """An array kept as its parts, and the equation that would join them."""

    parts: list[Any]
    equation: Any


class Listing:
    """The operations of a function: equal operations are listed once; barriers, and stacks that are split again, are
    omitted.

    - `operations`: in an order in which they can be evaluated.
    - `given`: index of a value -> the array, for values that are not the result of an operation.
    - `kinds`: shape and dtype of every value.
    """

    def __init__(self) -> None:
        self.operations: list[Operation] = []
        self.given: dict[int, Any] = {}
        self.kinds: list[Any] = []
        self._known: dict[Any, Any] = {}

    def enter(self, value: Any, key: Any = None) -> int:
        """The index of an input value; values with the same key are equal."""
        key = ("given", id(value)) if key is None else key
        if key not in self._known:
            self._known[key] = self._new(jnp.shape(value), jnp.result_type(value))
            self.given[self._known[key]] = value
        return self._known[key]

    def follow(self, jaxpr: Any, constants: list[Any], arguments: list[Any]) -> list[Any]:
        """List a function's operations.

        **Returns:** for each result the index of a value, or a `Stack`.
        """
        seen = dict(zip([*jaxpr.constvars, *jaxpr.invars], [*constants, *arguments], strict=True))

        def read(variable: Any) -> Any:
            if isinstance(variable, Literal):
                return self.enter(variable.val, ("literal", str(variable.val), str(variable.aval)))
            return seen[variable]

        for equation in jaxpr.eqns:
            inputs, name = [read(variable) for variable in equation.invars], equation.primitive.name
            if name in CALLS:
                inner = equation.params["jaxpr" if "jaxpr" in equation.params else "call_jaxpr"]
                outputs = self.follow(inner.jaxpr, [self.enter(atom) for atom in inner.consts], inputs)
            elif name == "optimization_barrier":
                outputs = inputs
            elif name == "stack" and equation.params["axis"] == 0:
                outputs = [Stack(inputs, equation)]
            elif name == "unstack" and equation.params["axis"] == 0 and isinstance(inputs[0], Stack):
                outputs = inputs[0].parts
            else:
                outputs = self._listed(equation, [self.joined(atom) for atom in inputs])
            seen.update(zip(equation.outvars, outputs, strict=True))
        return [read(variable) for variable in jaxpr.outvars]

    def joined(self, value: Any) -> int:
        """The index of a value; a stack is joined first."""
        if not isinstance(value, Stack):
            return value
        return self._listed(value.equation, [self.joined(part) for part in value.parts])[0]

    def _listed(self, equation: Any, inputs: list[int]) -> list[int]:
        name = equation.primitive.name
        commutes = name in ("add", "add_any", "mul")
        key = (name, *(sorted(inputs) if commutes else inputs), str(equation.params))
        if key not in self._known:
            outputs = tuple(self._new(variable.aval.shape, variable.aval.dtype) for variable in equation.outvars)
            self.operations.append(Operation(equation, tuple(inputs), outputs))
            self._known[key] = outputs
        return list(self._known[key])

    def _new(self, shape: tuple[int, ...], dtype: Any) -> int:
        self.kinds.append((shape, dtype))
        return len(self.kinds) - 1


def sharing_values(function: Callable[..., Any]) -> Callable[..., Any]:
    """Rewrite a function so that values with several uses are computed once.

    **Arguments:**

    - `function`: of trees of arrays, made of operations that act lane by lane, on arrays (lanes,) and scalars.
    """

    def evaluated(*arguments: Any) -> Any:
        closed, shape = jax.make_jaxpr(function, return_shape=True)(*arguments)
        listing = Listing()
        constants = [listing.enter(atom) for atom in closed.consts]
        results = listing.follow(closed.jaxpr, constants, [listing.enter(atom) for atom in jax.tree.leaves(arguments)])
        values = _evaluated(listing, [listing.joined(atom) for atom in results])
        return jax.tree.unflatten(jax.tree.structure(shape), values)

    return evaluated


def _evaluated(listing: Listing, results: list[int]) -> list[Any]:
    """The values with the given indices, computed level by level."""
    operations = _needed(listing.operations, results)
    uses = Counter([*results, *(value for operation in operations for value in set(operation.inputs))])
    #: For every value: the cost of recomputing it, and the number of levels of stored values that must precede it.
    costs: Counter[int] = Counter()
    depths: Counter[int] = Counter()
    levels: list[tuple[list[Operation], list[int]]] = [([], [])]
    for operation in operations:
        cost = sum(costs[value] for value in operation.inputs) + (operation.equation.primitive.name not in FREE)
        depth = max((depths[value] for value in operation.inputs), default=0)
        levels += [([], []) for _ in range(depth + 1 - len(levels))]
        levels[depth][0].append(operation)
        for value in operation.outputs:
            if len(listing.kinds[value][0]) == 1 and cost * (uses[value] - 1) >= WORTH_STORING:
                levels[depth][1].append(value)
                depths[value] = depth + 1
            else:
                costs[value], depths[value] = cost, depth
    values = dict(listing.given)
    for done, kept in levels:
        for operation in done:
            primitive = operation.equation.primitive
            result = primitive.bind(*(values[value] for value in operation.inputs), **operation.equation.params)
            values.update(zip(operation.outputs, result if primitive.multiple_results else [result], strict=True))
        # Only arrays of the same kind can be joined.
        for kind in dict.fromkeys(listing.kinds[value] for value in kept):
            alike = [value for value in kept if listing.kinds[value] == kind]
            values.update(zip(alike, stored(*(values[value] for value in alike)), strict=True))
    return [values[number] for number in results]


def _needed(operations: list[Operation], results: list[int]) -> list[Operation]:
    """The operations that some values depend on."""
    needed, kept = set(results), []
    for operation in reversed(operations):
        if not needed.isdisjoint(operation.outputs):
            needed.update(operation.inputs)
            kept.append(operation)
    return kept[::-1]
