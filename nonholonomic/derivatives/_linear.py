"""The derivatives of a solve in one direction, and with respect to one combination of its outputs, as solves.

Neither needs the derivatives with respect to every number. `Tangents` maps tangents of the leaves to those of the
outputs, and `Cotangents` maps cotangents of the outputs to those of the leaves, each by one solve, whatever the number of
leaves. JAX's reverse mode turns the first into the second.
"""

import functools
from typing import Any, ClassVar, Self

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.core import ShapedArray
from jax.interpreters import ad
from jaxtyping import Array, Float

from ._batched_primitive import AbstractLinearSolve, Request, flat, solve_cells


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
