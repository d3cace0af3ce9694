"""Solves of a batch as a JAX primitive, with derivatives in one direction and of one combination of outputs.

`custom_vmap` also batches, but computes all outputs as soon as one is used. The rule for unused outputs is JAX's
`partial_eval.dce_rules`, as in its own `scan`.
"""

import abc
import dataclasses
import functools
from typing import Any, ClassVar, Self

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import ShapedArray
from jax.extend.core import Primitive
from jax.interpreters import ad, batching, mlir, partial_eval
from jaxtyping import Array, Float

from ..compilation.xla_cpu import compiled_alone, compiled_for_one


class AbstractLinearSolve(eqx.Module):
    """A solve whose last arguments are tangents or cotangents: the outputs are linear functions of them."""

    #: The leaves that are differentiated.
    active: eqx.AbstractVar[tuple[int, ...]]

    #: The cost for one member of a batch of the last arguments, in units of the cost of the derivatives with respect to a
    #: number.
    cost: eqx.AbstractClassVar[int]

    @property
    @abc.abstractmethod
    def linear(self) -> int:
        """The number of the last arguments."""

    @abc.abstractmethod
    def from_slopes(self, selection: Any, *arguments: Float[Array, "..."]) -> list[Array]:
        """The selected outputs for a single cell, from the derivatives with respect to every number."""

    def over_cells(self, selection: Any, batch_flags: tuple[bool, ...], *arguments: Float[Array, "..."]) -> list[Array]:
        """`from_slopes` for some cells."""
        if not any(batch_flags):
            return [part[None] for part in self.from_slopes(selection, *arguments)]
        axes = tuple(0 if flag else None for flag in batch_flags)
        return jax.vmap(functools.partial(self.from_slopes, selection), axes)(*arguments)

    def prefers_slopes(self, arguments: Any, axes: Any, cells: int, batch_flags: tuple[bool, ...], size: int) -> bool:
        """Whether a batch has the same runs for all members, which cost more than the derivatives with respect to every
        number."""
        sizes = [arguments[k].size // (cells if batch_flags[k] else 1) for k in self.active]
        return all(axis is None for axis in axes[: -self.linear]) and sum(sizes) <= size * self.cost


# Compared by identity: JAX hashes the request, and its fields may not be hashable.
@dataclasses.dataclass(frozen=True, eq=False)
class Request:
    """Which outputs of a differentiable solve to compute for a number of cells.

    - `solve`: an `AbstractDifferentiableSolve`.
    - `active`: indices of the leaves with respect to which to differentiate, as for `value_and_tangents`; `None` for
      the primal alone.
    - `selection`: indices of the parts of the output tree to compute, all if `None`; parts that are `None` count.
    """

    solve: Any
    active: tuple[int, ...] | None = None
    selection: tuple[int, ...] | None = None

    def tree(self, cells: int, *leaves: Float[Array, "..."]) -> Any:
        """The primal of some cells, with its derivatives if there are active leaves; a tree of arrays, the cells first."""
        if self.active is None:
            return self.solve.solve(cells, *leaves)
        return self.solve.value_and_tangents(self.active, False, cells, *leaves)

    def parts(self, cells: int, *leaves: Float[Array, "..."]) -> list[Array]:
        """The selected parts that are not `None`."""
        # The trace that gave the shapes of a single cell serves again: of derivatives through flights, it is half of the wait.
        tree = _compiled_tree(self.solve, self.active, *leaves) if cells == 1 else self.tree(cells, *leaves)
        parts = flat(tree)[0]
        selected = parts if self.selection is None else [parts[k] for k in self.selection]
        return [part for part in selected if part is not None]


def solve_one(request: Request, *leaves: Float[Array, "..."]) -> Any:
    """The outputs for a single cell, without the axis of cells; under `vmap` the batch is solved as one ensemble.

    **Arguments:** `request`: a request for all parts; `leaves`: numbers of a single cell.
    """
    # Without the weak type of Python's numbers, with which everything would be traced and compiled once more.
    leaves = tuple(jnp.asarray(leaf, jnp.result_type(leaf)) for leaf in leaves)
    typed = (jax.ShapeDtypeStruct(leaf.shape, leaf.dtype) for leaf in leaves)
    shapes, structure = flat(jax.eval_shape(functools.partial(_compiled_tree, request.solve, request.active), *typed))
    present = [k for k, shape in enumerate(shapes) if shape is not None]
    kinds = tuple(ShapedArray(shapes[k].shape[1:], shapes[k].dtype) for k in present)
    request = dataclasses.replace(request, selection=tuple(present))
    outputs = iter(solve_cells.bind(*leaves, request=request, cells=1, batch_flags=(False,) * len(leaves), kinds=kinds))
    return jax.tree.unflatten(structure, [None if shape is None else next(outputs)[0] for shape in shapes])


@eqx.filter_jit
def _compiled_tree(solve: Any, active: tuple[int, ...] | None, *leaves: Float[Array, "..."]) -> Any:
    """The outputs for a single cell, traced once for equal solves: for the shapes, and as a part of a program."""
    return Request(solve, active).tree(1, *leaves)


def _parts(
    solve: Any, active: tuple[int, ...] | None, selection: tuple[int, ...], cells: int, leaves: list[Array]
) -> list[Array]:
    """`Request.parts` as one program, which serves all equal solves, whatever the values of the leaves.

    Otherwise, outside `jit`, each operation would be a separate program, and every call would compile its loops again.
    """
    return Request(solve, active, selection).parts(cells, *leaves)


#: One run is not worth the optimisations (`compiled_for_one`), of which a hybrid scene would also need three times the memory;
#: 256 runs at once take 2.5 times as long without them.
_parts_of_one = compiled_for_one(_parts)
_parts_of_many = compiled_alone(_parts)


def flat(tree: Any) -> tuple[list[Any], Any]:
    """The parts of a tree and its structure, in which `None` counts as a part."""
    return jax.tree.flatten(tree, is_leaf=lambda part: part is None)


#: The parts that a `Request` wants of a number of cells. `batch_flags` marks the leaves that have a value per cell; `kinds`
#: holds the shapes and dtypes of the parts of one cell.
solve_cells = Primitive("solve_cells")
solve_cells.multiple_results = True


@solve_cells.def_impl
def _run(*leaves: Array, request: Request, cells: int, batch_flags: Any, kinds: Any) -> list[Array]:
    # Python numbers would become part of the program.
    arrays = [leaf if isinstance(leaf, jax.Array) else jax.device_put(np.asarray(leaf)) for leaf in leaves]
    compiled = _parts_of_one if cells == 1 else _parts_of_many
    return compiled(request.solve, request.active, request.selection, cells, arrays)


@solve_cells.def_abstract_eval
def _shaped(
    *leaves: Any, request: Request, cells: int, batch_flags: Any, kinds: tuple[ShapedArray, ...]
) -> list[ShapedArray]:
    return [ShapedArray((cells, *kind.shape), kind.dtype) for kind in kinds]


def _traced(*leaves: Array, request: Request, cells: int, batch_flags: Any, kinds: Any) -> list[Array]:
    return request.parts(cells, *leaves)


mlir.register_lowering(solve_cells, mlir.lower_fun(_traced, multiple_results=True))


def _batched(
    leaves: tuple[Array, ...], axes: Any, *, request: Request, cells: int, batch_flags: tuple[bool, ...], kinds: Any
) -> tuple[list[Array], list[int]]:
    """Merge a batch of ensembles into one ensemble."""
    size = next(leaf.shape[axis] for leaf, axis in zip(leaves, axes, strict=True) if axis is not None)
    if size == 0:
        return [jnp.zeros((0, cells, *kind.shape), kind.dtype) for kind in kinds], [0] * len(kinds)
    if isinstance(request.solve, AbstractLinearSolve) and request.solve.prefers_slopes(
        leaves, axes, cells, batch_flags, size
    ):
        of_one = functools.partial(request.solve.over_cells, request.selection, batch_flags)
        return jax.vmap(of_one, axes)(*leaves), [0] * len(kinds)

    def joined(leaf: Array, has_batch: bool, axis: Any) -> Array:
        if axis is None:
            return jnp.tile(leaf, (size,) + (1,) * (leaf.ndim - 1)) if has_batch else leaf
        leaf = jnp.moveaxis(leaf, axis, 0)
        return leaf.reshape(size * cells, *leaf.shape[2:]) if has_batch else jnp.repeat(leaf, cells, axis=0)

    merged_flags = tuple(flag or axis is not None for flag, axis in zip(batch_flags, axes, strict=True))
    merged_leaves = map(joined, leaves, batch_flags, axes)
    outputs = solve_cells.bind(
        *merged_leaves, request=request, cells=size * cells, batch_flags=merged_flags, kinds=kinds
    )
    return [part.reshape(size, cells, *part.shape[1:]) for part in outputs], [0] * len(outputs)


batching.primitive_batchers[solve_cells] = _batched


def _only_read(use: list[bool], *arguments: Any) -> tuple[list[bool], Any]:
    """The operation restricted to the parts that are used."""
    # Since JAX 0.12, a list of inputs comes before the equation.
    equation = arguments[-1]
    if not any(use):
        return [False] * len(equation.invars), None
    request, kinds = equation.params["request"], equation.params["kinds"]
    selection = tuple(k for k, is_used in zip(request.selection, use, strict=True) if is_used)
    used_request = Request(request.solve.for_parts(selection), request.active, selection)
    used_kinds = tuple(kind for kind, is_used in zip(kinds, use, strict=True) if is_used)
    outputs = [variable for variable, is_used in zip(equation.outvars, use, strict=True) if is_used]
    new = equation.replace(outvars=outputs, params={**equation.params, "request": used_request, "kinds": used_kinds})
    return [True] * len(equation.invars), new


partial_eval.dce_rules[solve_cells] = _only_read


# The derivatives of a solve in one direction, and with respect to one combination of its outputs, as solves.
#
# Neither needs the derivatives with respect to every number. `Tangents` maps tangents of the leaves to those of the
# outputs, and `Cotangents` maps cotangents of the outputs to those of the leaves, each by one solve, whatever the number of
# leaves. JAX's reverse mode turns the first into the second.


class Tangents(AbstractLinearSolve):
    """The tangents of a solve's outputs, as a solve whose last arguments are the tangents of the active leaves.

    - `active`: the leaves that have a tangent; `of`: the `AbstractDifferentiableSolve`.
    - `structure`: the structure of the primal, in which `None` counts as a part.
    - `differentiated`: function of `of` and `active` that returns a function of a single cell's leaves, whose results are
      the primal and its derivatives with respect to the active leaves.
    """

    active: tuple[int, ...] = eqx.field(static=True)
    of: Any
    structure: Any = eqx.field(static=True)
    differentiated: Any = eqx.field(static=True)

    cost: ClassVar[int] = 2

    @property
    def linear(self) -> int:
        return len(self.active)

    def solve(self, cells: int, *arguments: Float[Array, "..."]) -> Any:
        return self.of.push_forward(self.active, cells, arguments[: -self.linear], arguments[-self.linear :])

    def slopes(self, leaves: tuple[Float[Array, "..."], ...]) -> list[Any]:
        """The derivatives of a single cell's outputs with respect to the active leaves."""
        return self.differentiated(self.of, self.active)(*leaves)[1]

    def for_parts(self, wanted: tuple[int, ...]) -> Self:
        return type(self)(self.active, self.of.for_parts(wanted), self.structure, self.differentiated)

    def from_slopes(self, selection: Any, *arguments: Float[Array, "..."]) -> list[Array]:
        leaves, tangents = arguments[: -self.linear], arguments[-self.linear :]
        slopes, zero = [flat(slope)[0] for slope in self.slopes(leaves)], jnp.zeros(())
        return [
            sum((product(slope[k], tangent) for slope, tangent in zip(slopes, tangents, strict=True)), zero)
            for k in selection
        ]


class Cotangents(AbstractLinearSolve):
    """The cotangents of a solve's active leaves, as a solve whose last arguments are cotangents of its outputs.

    - `tangents`: the solve for the tangents of the outputs; `parts`: the indices of the outputs that have a cotangent.
    """

    active: tuple[int, ...] = eqx.field(static=True)
    tangents: Tangents
    parts: tuple[int, ...] = eqx.field(static=True)

    cost: ClassVar[int] = 4

    @property
    def linear(self) -> int:
        return len(self.parts)

    def solve(self, cells: int, *arguments: Float[Array, "..."]) -> list[Array]:
        leaves, cotangents = arguments[: -self.linear], dict(zip(self.parts, arguments[-self.linear :], strict=True))
        structure = self.tangents.structure
        by_part = jax.tree.unflatten(structure, [cotangents.get(k) for k in range(structure.num_leaves)])
        return self.tangents.of.pull_back(self.active, cells, leaves, by_part)

    def for_parts(self, wanted: tuple[int, ...]) -> Self:
        return self

    def from_slopes(self, selection: Any, *arguments: Float[Array, "..."]) -> list[Array]:
        leaves, cotangents = arguments[: -self.linear], arguments[-self.linear :]
        slopes, zero = [flat(slope)[0] for slope in self.tangents.slopes(leaves)], jnp.zeros(())

        def share(slope: Array, cotangent: Array) -> Array:
            return product(jnp.moveaxis(slope, range(cotangent.ndim), range(-cotangent.ndim, 0)), cotangent)

        return [
            sum(
                (share(slopes[k][part], cotangent) for part, cotangent in zip(self.parts, cotangents, strict=True)),
                zero,
            )
            for k in selection
        ]


def product(slope: Float[Array, "..."], tangent: Float[Array, "..."]) -> Float[Array, "..."]:
    """A derivative, the axes of the leaf last, times a tangent of the leaf. Where the derivative is zero, a tangent that
    is not finite, such as that of an angle at a pole, has no effect."""
    terms = jnp.where(slope == 0.0, 0.0, slope * tangent)
    return terms.sum(axis=tuple(range(slope.ndim - jnp.ndim(tangent), slope.ndim)))


def push_forward(tangents: Tangents, leaves: Any, directions: Any, primal: Any) -> Any:
    """The tangents of a single cell's outputs: a tree like the primal, with `None` for outputs that have no derivative."""
    parts = flat(tangents.of.differentiable(primal))[0]
    present = tuple(k for k, part in enumerate(parts) if part is not None)
    outputs = solve_cells.bind(
        *leaves,
        *directions,
        request=Request(tangents, None, present),
        cells=1,
        batch_flags=(False,) * (len(leaves) + len(directions)),
        kinds=tuple(ShapedArray(jnp.shape(parts[k]), parts[k].dtype) for k in present),
    )
    changes = dict(zip(present, (output[0] for output in outputs), strict=True))
    return jax.tree.unflatten(tangents.structure, [changes.get(k) for k in range(len(parts))])


def _jvp(primals: Any, tangents: Any, *, request: Request, cells: int, batch_flags: Any, kinds: Any) -> Any:
    """The outputs of a linear solve and their tangents. Those along the leaves are second derivatives, which are taken
    operation by operation."""
    solve, linear = request.solve, request.solve.linear
    bind = functools.partial(solve_cells.bind, request=request, cells=cells, batch_flags=batch_flags, kinds=kinds)
    changes = tuple(ad.instantiate_zeros(tangent) for tangent in tangents)
    if all(type(tangent) is ad.Zero for tangent in tangents[:-linear]):
        return bind(*primals), bind(*primals[:-linear], *changes[-linear:])
    of_cells = functools.partial(solve.over_cells, request.selection, batch_flags)
    return bind(*primals), jax.jvp(of_cells, tuple(primals), changes)[1]


def _transposed(
    cotangents: Any, *arguments: Any, request: Request, cells: int, batch_flags: Any, kinds: Any
) -> list[Any]:
    """The cotangents of the leaves' tangents, from those of the outputs."""
    tangents = request.solve
    assert isinstance(tangents, Tangents)
    assert request.selection is not None
    linear, leaves = tangents.linear, arguments[: -tangents.linear]
    avals = [part.aval if ad.is_undefined_primal(part) else jax.typeof(part) for part in arguments[len(leaves) :]]
    flags = batch_flags[len(leaves) :]
    present = {k: part for k, part in zip(request.selection, cotangents, strict=True) if type(part) is not ad.Zero}
    if not present:
        return [None] * len(leaves) + [ad.Zero(aval) for aval in avals]
    outputs = solve_cells.bind(
        *leaves,
        *present.values(),
        request=Request(Cotangents(tangents.active, tangents, tuple(present)), None, tuple(range(linear))),
        cells=cells,
        batch_flags=(*batch_flags[: len(leaves)], *(True for _ in present)),
        kinds=tuple(ShapedArray(aval.shape[flag:], aval.dtype) for aval, flag in zip(avals, flags, strict=True)),
    )
    # A tangent that all cells share has the sum of their cotangents.
    shares = [output if flag else output.sum(axis=0) for output, flag in zip(outputs, flags, strict=True)]
    return [None] * len(leaves) + shares


ad.primitive_jvps[solve_cells] = _jvp
ad.primitive_transposes[solve_cells] = _transposed
