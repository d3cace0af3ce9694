"""Solves with their own derivative rules: functions of scalars for `jit`, `vmap`, `grad`, `jvp` and their compositions.

A run is not differentiated operation by operation. A solve returns its primal together with the derivatives with
respect to some of the parameters (forward or adjoint), and JAX's rules combine these.

Solves are a JAX primitive, so that a batch under `vmap` is solved as one ensemble. `custom_vmap` also batches, but
computes all outputs as soon as one is used. The rule for unused outputs is JAX's `partial_eval.dce_rules`, as in its own
`scan`.
"""

import abc
import dataclasses
import functools
from collections.abc import Callable, Sequence
from typing import Any, ClassVar, Self, TypeAlias

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import ShapedArray
from jax.extend.core import Primitive
from jax.interpreters import ad, batching, mlir, partial_eval
from jaxtyping import Array, Bool, Float, PyTree

from ..compilation.xla_cpu import compiled_alone, compiled_for_one
from ..validation import is_traced

#: The primal output of a solve: arrays of floats, the cells along the first axis.
Primal: TypeAlias = PyTree

#: Numbers of a solve, each a scalar or an array.
Leaves: TypeAlias = tuple[Float[Array, "..."], ...]
Gradient = list[Float[Array, "cells ..."]]

#: JAX's PyTreeDef, which type checkers take for a variable.
Structure: TypeAlias = Any


class AbstractSolve(eqx.Module):
    """A function of leaves for some cells at once."""

    @abc.abstractmethod
    def solve(self, cells: int, *leaves: Float[Array, "..."]) -> Primal:
        """The primal in every cell; each leaf is a scalar or an array with one number per cell."""

    def for_parts(self, wanted: tuple[int, ...]) -> Self:
        """A solve that may replace outputs that are not wanted by `None`; by default it replaces none.

        **Arguments:** `wanted`: indices into the parts of the primal, or of the primal followed by its derivatives.
        """
        return self


class AbstractDifferentiableSolve(AbstractSolve):
    """A solve as a function of `leaves`; the first `movable` leaves are differentiable.

    **Example:** the solve of the subpackage's example, for two cells.

    >>> print(HalfLife().solve(2, jnp.array([1.0, 2.0])).round(6))
    [0.693147 0.346574]
    """

    #: Whether a batch is run as one ensemble; otherwise each run is separate, with a single cell.
    in_blocks: ClassVar[bool] = True

    movable: eqx.AbstractVar[int]

    @abc.abstractmethod
    def absent(self, value: Float[Array, "..."]) -> Bool[Array, "..."]:
        """Where an entry of the primal means "none", such as an infinite time: its derivative is 0 there."""

    @abc.abstractmethod
    def value_and_tangents(
        self, active: tuple[int, ...], nested: bool, cells: int, *leaves: Float[Array, "..."]
    ) -> tuple[Primal, list[Primal]]:
        """The primal and its derivative with respect to each active leaf, shaped like the primal with the leaf's own
        axes last; `None` for a part of the primal that is not differentiable.

        **Arguments:** `active`: the leaves with respect to which to differentiate; `nested`: whether the outputs will
        be differentiated again, in forward mode; `cells`, `leaves`: as for `solve`.
        """

    def prefers_adjoint(self, active: tuple[int, ...], leaves: Leaves) -> bool:
        """Whether `push_forward` and `pull_back` take the place of the derivatives with respect to every active leaf;
        by default they do not. **Arguments:** as for `value_and_tangents`, for a single run."""
        return False

    def differentiable(self, primal: Primal) -> Primal:
        """The primal with `None` for parts that are not differentiable."""
        return primal

    def push_forward(self, active: tuple[int, ...], cells: int, leaves: Leaves, tangents: Leaves) -> Primal:
        """The tangent of the primal along tangents of the active leaves, which may be the same for all cells."""
        raise NotImplementedError

    def pull_back(self, active: tuple[int, ...], cells: int, leaves: Leaves, cotangents: Primal) -> Gradient:
        """The cotangents of the active leaves in every cell, from those of the primal, `None` for parts without one.

        **Raises:** `ValueError` if there is no backward pass; then the derivatives with respect to every leaf take its place.
        """
        raise NotImplementedError


def differentiable_solve(solve: AbstractDifferentiableSolve, *leaves: Float[Array, "..."]) -> Primal:
    """Solve for one member. Where there is no event the derivative is zero, whatever the cotangent.

    **Arguments:** `leaves`: the numbers of a single cell, in the order of the solve.

    **Returns:** the primal, without the axis of cells.

    **Example:**

    >>> print(f"{jax.jvp(half_life, (2.0,), (1.0,))[1]:.6f}")
    -0.173287
    """

    @jax.custom_jvp
    def primal(*leaves):
        return _of_one(solve, solve.in_blocks, leaves)

    @functools.partial(primal.defjvp, symbolic_zeros=True)
    def variation(leaves, tangents):
        zero = jax.custom_derivatives.SymbolicZero
        active = tuple(i for i in range(solve.movable) if not isinstance(tangents[i], zero))
        if not active:
            value = primal(*leaves)
            return value, jax.tree.map(jnp.zeros_like, value)
        active_tangents = [tangents[i] for i in active]
        # Derivatives are `None` where the primal has an array that is not differentiated.
        if solve.prefers_adjoint(active, leaves):
            value = primal(*leaves)
            change = _pushed_forward(LinearSolve(solve, active, flat(value)[1]), leaves, active_tangents, value)
            return value, jax.tree.map(lambda part, change: _change(solve, part, [change], None), value, change)
        value, slopes = _value_and_tangents(solve, active)(*leaves)
        return value, jax.tree.map(lambda part, *rates: _change(solve, part, rates, active_tangents), value, *slopes)

    # JAX rejects the NumPy arrays that `vmap` passes on to a function with its own rule inside `jit`.
    return primal(*[jnp.array(leaf) if is_traced(leaf) else leaf for leaf in leaves])


def _change(
    solve: AbstractDifferentiableSolve, value: Array, slopes: Sequence[Array | None], tangents: list[Array] | None
) -> Array:
    """The tangent of an output, 0 where it is absent; a symbolic zero if the output is not differentiable.

    **Arguments:** `slopes`: the derivatives with respect to the active leaves, and their `tangents`; or the tangent of the
    output alone.
    """
    present = [slope for slope in slopes if slope is not None]
    if not present:
        return jax.custom_derivatives.zero_from_primal(value, symbolic_zeros=True)
    is_absent = solve.absent(value)
    if tangents is None:
        return jnp.where(is_absent, 0.0, present[0])

    def share(slope: Array, tangent: Array) -> Array:
        # Selected before and after, so that an infinite tangent or cotangent of an absent output is dropped, not
        # multiplied.
        factor = jnp.where(jnp.all(is_absent), 0.0, tangent)
        return jnp.where(is_absent, 0.0, product(slope, factor))

    return sum((share(*pair) for pair in zip(present, tangents, strict=True)), jnp.zeros(()))


class ValueAndTangents(AbstractSolve):
    """The primal of a solve, with its derivatives with respect to the `active` leaves."""

    of: AbstractDifferentiableSolve
    active: tuple[int, ...] = eqx.field(static=True)

    def solve(self, cells: int, *leaves: Float[Array, "..."]) -> tuple[Primal, list[Primal]]:
        return self.of.value_and_tangents(self.active, False, cells, *leaves)

    def for_parts(self, wanted: tuple[int, ...]) -> Self:
        return dataclasses.replace(self, of=self.of.for_parts(wanted))


def _value_and_tangents(
    solve: AbstractDifferentiableSolve, active: tuple[int, ...]
) -> Callable[..., tuple[Primal, list[Primal]]]:
    """Primal and derivatives of one run, which can be differentiated once more."""

    @jax.custom_jvp
    def primal(*leaves):
        return _of_one(ValueAndTangents(solve, active), solve.in_blocks, leaves)

    @primal.defjvp
    def second_variation(leaves, tangents):
        # Differentiated operation by operation; the ensemble solve does not allow this.
        return jax.jvp(functools.partial(_nested, solve, active), leaves, tangents)

    return primal


# Compiled as a whole even outside of `jit`.
@eqx.filter_jit
def _nested(solve: AbstractDifferentiableSolve, active: tuple[int, ...], *leaves: Float[Array, "..."]) -> PyTree:
    """Primal and derivatives of one run as differentiable operations."""
    return _only(solve.value_and_tangents(active, True, 1, *leaves))


def _only(results: PyTree) -> PyTree:
    return jax.tree.map(lambda result: result[0], results)


# The primitive: parts of the outputs of a solve for a number of cells.


# Compared by identity: JAX hashes the request, and its fields may not be hashable.
@dataclasses.dataclass(frozen=True, eq=False)
class Request:
    """Which outputs of a solve to compute for a number of cells.

    - `selection`: indices of the parts of the outputs; parts that are `None` count.
    - `batch_flags`: whether each leaf has a value per cell.
    - `kinds`: the shapes and dtypes of the selected parts of one cell.
    """

    solve: AbstractSolve
    selection: tuple[int, ...]
    cells: int
    batch_flags: tuple[bool, ...]
    kinds: tuple[ShapedArray, ...]

    @classmethod
    def of_one(cls, solve: AbstractSolve, parts: dict[int, Array | jax.ShapeDtypeStruct], leaves: Leaves) -> "Request":
        """A request for a single cell. **Arguments:** `parts`: the wanted parts, for their shapes and dtypes."""
        kinds = tuple(ShapedArray(jnp.shape(part), part.dtype) for part in parts.values())
        return cls(solve, tuple(parts), 1, (False,) * len(leaves), kinds)


solve_cells = Primitive("solve_cells")
solve_cells.multiple_results = True


def _of_one(solve: AbstractSolve, in_blocks: bool, leaves: Sequence[Float[Array, "..."]]) -> PyTree:
    """The outputs for a single cell, without the axis of cells; under `vmap` the batch is solved as one ensemble if it is
    run in blocks."""
    if not in_blocks:
        return _only(solve.solve(1, *leaves))
    # Without the weak type of Python's numbers, with which everything would be traced and compiled once more.
    leaves = tuple(jnp.asarray(leaf, jnp.result_type(leaf)) for leaf in leaves)
    typed = (jax.ShapeDtypeStruct(leaf.shape, leaf.dtype) for leaf in leaves)
    shapes, structure = flat(jax.eval_shape(lambda *leaves: _only(_compiled_solve(solve, *leaves)), *typed))
    present = {k: shape for k, shape in enumerate(shapes) if shape is not None}
    parts = iter(solve_cells.bind(*leaves, request=Request.of_one(solve, present, leaves)))
    return jax.tree.unflatten(structure, [None if shape is None else next(parts)[0] for shape in shapes])


@eqx.filter_jit
def _compiled_solve(solve: AbstractSolve, *leaves: Float[Array, "..."]) -> PyTree:
    """The outputs for a single cell, traced once for equal solves: for the shapes, and as a part of a program."""
    return solve.solve(1, *leaves)


def _parts(solve: AbstractSolve, selection: tuple[int, ...], cells: int, leaves: Sequence[Array]) -> list[Array]:
    """The selected parts, as one program that serves all equal solves, whatever the values of the leaves.

    Otherwise, outside `jit`, each operation would be a separate program, and every call would compile its loops again.
    """
    # The trace that gave the shapes of a single cell serves again: of derivatives through flights, it is half of the wait.
    parts = flat(_compiled_solve(solve, *leaves) if cells == 1 else solve.solve(cells, *leaves))[0]
    return [parts[k] for k in selection]


#: One run is not worth the optimisations (`compiled_for_one`), of which a hybrid scene would also need three times the memory;
#: 256 runs at once take 2.5 times as long without them.
_parts_of_one = compiled_for_one(_parts)
_parts_of_many = compiled_alone(_parts)


def flat(tree: PyTree) -> tuple[list[Any], Structure]:
    """The parts of a tree and its structure, in which `None` counts as a part."""
    return jax.tree.flatten(tree, is_leaf=lambda part: part is None)


@solve_cells.def_impl
def _run(*leaves: Array, request: Request) -> list[Array]:
    # Python numbers would become part of the program.
    arrays = [leaf if isinstance(leaf, jax.Array) else jax.device_put(np.asarray(leaf)) for leaf in leaves]
    compiled = _parts_of_one if request.cells == 1 else _parts_of_many
    return compiled(request.solve, request.selection, request.cells, arrays)


solve_cells.def_abstract_eval(
    lambda *leaves, request: [ShapedArray((request.cells, *kind.shape), kind.dtype) for kind in request.kinds]
)


def _batched(leaves: Leaves, axes: Sequence[int | None], *, request: Request) -> tuple[list[Array], list[int]]:
    """Merge a batch of ensembles into one ensemble."""
    solve, cells, flags, kinds = request.solve, request.cells, request.batch_flags, request.kinds
    size = next(leaf.shape[axis] for leaf, axis in zip(leaves, axes, strict=True) if axis is not None)
    if size == 0:
        return [jnp.zeros((0, cells, *kind.shape), kind.dtype) for kind in kinds], [0] * len(kinds)
    if isinstance(solve, LinearSolve) and all(axis is None for axis in axes[: -solve.linear]):
        # All members have the same runs, which may cost more than the derivatives with respect to every number.
        sizes = [leaves[k].size // (cells if flags[k] else 1) for k in solve.active]
        if sum(sizes) <= size * (TANGENT_COST if solve.parts is None else COTANGENT_COST):
            return jax.vmap(functools.partial(solve.from_slopes, request), axes)(*leaves), [0] * len(kinds)

    def joined(leaf: Array, has_batch: bool, axis: int | None) -> Array:
        if axis is None:
            return jnp.tile(leaf, (size,) + (1,) * (leaf.ndim - 1)) if has_batch else leaf
        leaf = jnp.moveaxis(leaf, axis, 0)
        return leaf.reshape(size * cells, *leaf.shape[2:]) if has_batch else jnp.repeat(leaf, cells, axis=0)

    merged_flags = tuple(flag or axis is not None for flag, axis in zip(flags, axes, strict=True))
    merged = dataclasses.replace(request, cells=size * cells, batch_flags=merged_flags)
    outputs = solve_cells.bind(*map(joined, leaves, flags, axes), request=merged)
    return [part.reshape(size, cells, *part.shape[1:]) for part in outputs], [0] * len(outputs)


def _only_read(use: list[bool], *arguments: Any) -> tuple[list[bool], Any]:
    """The operation restricted to the parts that are used."""
    # Since JAX 0.12, a list of inputs comes before the equation.
    equation = arguments[-1]
    if not any(use):
        return [False] * len(equation.invars), None
    request, used = equation.params["request"], [k for k, is_used in enumerate(use) if is_used]
    selection, kinds = (tuple(items[k] for k in used) for items in (request.selection, request.kinds))
    solve = request.solve.for_parts(selection)
    new_request = dataclasses.replace(request, solve=solve, selection=selection, kinds=kinds)
    outputs = [equation.outvars[k] for k in used]
    return [True] * len(equation.invars), equation.replace(outvars=outputs, params={"request": new_request})


# The derivatives of a solve in one direction, and with respect to one combination of its outputs, as a solve.
#
# Neither needs the derivatives with respect to every number: one solve maps tangents of the leaves to those of the outputs,
# or cotangents of the outputs to those of the leaves, whatever the number of leaves. JAX's reverse mode turns the first
# into the second.

#: The costs of a tangent and of a cotangent, in units of the cost of the derivatives with respect to a number.
TANGENT_COST, COTANGENT_COST = 2, 4


class LinearSolve(AbstractSolve):
    """The tangents of a solve's outputs, as a solve whose last arguments are the tangents of the active leaves; or the
    cotangents of the active leaves, as a solve whose last arguments are cotangents of the outputs.

    - `active`: the leaves that are differentiated; `structure`: the structure of the primal.
    - `parts`: the indices of the outputs that have a cotangent; `None` for tangents.
    """

    of: AbstractDifferentiableSolve
    active: tuple[int, ...] = eqx.field(static=True)
    structure: Structure = eqx.field(static=True)
    parts: tuple[int, ...] | None = eqx.field(static=True, default=None)

    @property
    def linear(self) -> int:
        """The number of the last arguments, of which the outputs are linear functions."""
        return len(self.active if self.parts is None else self.parts)

    def solve(self, cells: int, *arguments: Float[Array, "..."]) -> Primal:
        leaves, last = arguments[: -self.linear], arguments[-self.linear :]
        if self.parts is None:
            return self.of.push_forward(self.active, cells, leaves, last)
        by_part = self.by_part(last)
        try:
            return self.of.pull_back(self.active, cells, leaves, by_part)
        except ValueError:
            # A loop without a fixed number of iterations has no backward pass.
            slopes = self.of.value_and_tangents(self.active, False, cells, *leaves)[1]
            return [jax.vmap(contracted)(slope, by_part) for slope in slopes]

    def by_part(self, cotangents: Leaves) -> Primal:
        """The cotangents in a tree like the primal, with `None` for parts without one."""
        of_parts = dict(zip(self.parts or (), cotangents, strict=True))
        return jax.tree.unflatten(self.structure, [of_parts.get(k) for k in range(self.structure.num_leaves)])

    def for_parts(self, wanted: tuple[int, ...]) -> Self:
        return dataclasses.replace(self, of=self.of.for_parts(wanted)) if self.parts is None else self

    def from_slopes(self, request: Request, *arguments: Float[Array, "..."]) -> list[Array]:
        """The outputs of a request, from the derivatives with respect to every number."""

        def of_cell(*arguments: Float[Array, "..."]) -> list[Array]:
            leaves, last = arguments[: -self.linear], arguments[-self.linear :]
            slopes = _value_and_tangents(self.of, self.active)(*leaves)[1]
            if self.parts is not None:
                return [contracted(slopes[k], self.by_part(last)) for k in request.selection]
            pairs = [(flat(slope)[0], tangent) for slope, tangent in zip(slopes, last, strict=True)]
            return [sum((product(slope[k], by) for slope, by in pairs), jnp.zeros(())) for k in request.selection]

        if not any(request.batch_flags):
            return [part[None] for part in of_cell(*arguments)]
        return jax.vmap(of_cell, tuple(0 if flag else None for flag in request.batch_flags))(*arguments)


def contracted(slope: Primal, cotangents: Primal) -> Float[Array, "..."]:
    """The derivative of a sum over the primal of a cell, from the derivative of the primal, the axes of the leaf last, and its
    cotangents."""
    pairs = zip(flat(slope)[0], flat(cotangents)[0], strict=True)
    present = [(part, by) for part, by in pairs if part is not None and by is not None]
    own_last = [(jnp.moveaxis(part, range(by.ndim), range(-by.ndim, 0)), by) for part, by in present]
    return sum((product(*pair) for pair in own_last), jnp.zeros(()))


def product(slope: Float[Array, "..."], tangent: Float[Array, "..."]) -> Float[Array, "..."]:
    """A derivative, the axes of the leaf last, times a tangent of the leaf. Where the derivative is zero, a tangent that
    is not finite, such as that of an angle at a pole, has no effect."""
    terms = jnp.where(slope == 0.0, 0.0, slope * tangent)
    return terms.sum(axis=tuple(range(slope.ndim - jnp.ndim(tangent), slope.ndim)))


def _pushed_forward(tangents: LinearSolve, leaves: Leaves, directions: Sequence[Array], primal: Primal) -> Primal:
    """The tangents of a single cell's outputs: a tree like the primal, with `None` for outputs that have no derivative."""
    parts = flat(tangents.of.differentiable(primal))[0]
    present = {k: part for k, part in enumerate(parts) if part is not None}
    arguments = (*leaves, *directions)
    outputs = solve_cells.bind(*arguments, request=Request.of_one(tangents, present, arguments))
    changes = dict(zip(present, (output[0] for output in outputs), strict=True))
    return jax.tree.unflatten(tangents.structure, [changes.get(k) for k in range(len(parts))])


def _jvp(
    primals: tuple[Array, ...], tangents: tuple[Array | ad.Zero, ...], *, request: Request
) -> tuple[list[Array], list[Array]]:
    """The outputs of a linear solve and their tangents. Those along the leaves are second derivatives, which are taken
    operation by operation."""
    solve, changes = request.solve, tuple(ad.instantiate_zeros(tangent) for tangent in tangents)
    assert isinstance(solve, LinearSolve)
    outputs = solve_cells.bind(*primals, request=request)
    if all(type(tangent) is ad.Zero for tangent in tangents[: -solve.linear]):
        return outputs, solve_cells.bind(*primals[: -solve.linear], *changes[-solve.linear :], request=request)
    return outputs, jax.jvp(functools.partial(solve.from_slopes, request), primals, changes)[1]


def _transposed(
    cotangents: Sequence[Array | ad.Zero], *arguments: Array | ad.UndefinedPrimal, request: Request
) -> Sequence[Array | ad.Zero | None]:
    """The cotangents of the leaves' tangents, from those of the outputs."""
    tangents = request.solve
    assert isinstance(tangents, LinearSolve)
    leaves, directions = arguments[: -tangents.linear], arguments[-tangents.linear :]
    avals = [part.aval if ad.is_undefined_primal(part) else jax.typeof(part) for part in directions]
    flags = request.batch_flags[len(leaves) :]
    present = {k: part for k, part in zip(request.selection, cotangents, strict=True) if type(part) is not ad.Zero}
    if not present:
        return [None] * len(leaves) + [ad.Zero(aval) for aval in avals]
    pulled_back = Request(
        dataclasses.replace(tangents, parts=tuple(present)),
        tuple(range(tangents.linear)),
        request.cells,
        (*request.batch_flags[: len(leaves)], *(True for _ in present)),
        tuple(ShapedArray(aval.shape[flag:], aval.dtype) for aval, flag in zip(avals, flags, strict=True)),
    )
    outputs = solve_cells.bind(*leaves, *present.values(), request=pulled_back)
    # A tangent that all cells share has the sum of their cotangents.
    shares = [output if flag else output.sum(axis=0) for output, flag in zip(outputs, flags, strict=True)]
    return [None] * len(leaves) + shares


mlir.register_lowering(
    solve_cells,
    mlir.lower_fun(
        lambda *leaves, request: _parts(request.solve, request.selection, request.cells, leaves), multiple_results=True
    ),
)
batching.primitive_batchers[solve_cells] = _batched
partial_eval.dce_rules[solve_cells] = _only_read
ad.primitive_jvps[solve_cells] = _jvp
ad.primitive_transposes[solve_cells] = _transposed
