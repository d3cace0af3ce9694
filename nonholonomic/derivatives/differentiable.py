"""Solves with their own derivative rules: functions of scalars for `jit`, `vmap`, `grad`, `jvp` and their compositions.

A run is not differentiated operation by operation. A solve returns its primal together with the derivatives with
respect to some of the parameters (forward or adjoint), and JAX's rules combine these. A batch under `vmap` is solved as
one ensemble.
"""

import abc
import functools
from collections.abc import Callable
from typing import Any, ClassVar, Self

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from ..integration import Settings
from ..validation import as_number, is_traced
from .adjoint import tangents_of
from .primitives import Request, Tangents, flat, product, push_forward, solve_one
from .variation import tangent_scale

#: The primal output of a solve: arrays of floats, the cells along the first axis.
Primal = Any


class AbstractDifferentiableSolve(eqx.Module):
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
    def solve(self, cells: int, *leaves: Float[Array, "..."]) -> Primal:
        """The primal in every cell; each leaf is a scalar or an array with one number per cell."""

    @abc.abstractmethod
    def value_and_tangents(
        self, active: tuple[int, ...], nested: bool, cells: int, *leaves: Float[Array, "..."]
    ) -> tuple[Primal, list[Primal]]:
        """The primal and its derivative with respect to each active leaf, shaped like the primal with the leaf's own
        axes last; `None` for a part of the primal that is not differentiable.

        **Arguments:** `active`: the leaves with respect to which to differentiate; `nested`: whether the outputs will
        be differentiated again, in forward mode; `cells`, `leaves`: as for `solve`.
        """

    def prefers_adjoint(self, active: tuple[int, ...], leaves: tuple[Float[Array, "..."], ...]) -> bool:
        """Whether `push_forward` and `pull_back` take the place of the derivatives with respect to every active leaf;
        by default they do not. **Arguments:** as for `value_and_tangents`, for a single run."""
        return False

    def differentiable(self, primal: Primal) -> Primal:
        """The primal with `None` for parts that are not differentiable."""
        return primal

    def push_forward(
        self,
        active: tuple[int, ...],
        cells: int,
        leaves: tuple[Float[Array, "..."], ...],
        tangents: tuple[Float[Array, "..."], ...],
    ) -> Primal:
        """The tangent of the primal along tangents of the active leaves, which may be the same for all cells."""
        raise NotImplementedError

    def pull_back(
        self, active: tuple[int, ...], cells: int, leaves: tuple[Float[Array, "..."], ...], cotangents: Primal
    ) -> list[Float[Array, "cells ..."]]:
        """The cotangents of the active leaves in every cell, from those of the primal, `None` for parts without one."""
        raise NotImplementedError

    def for_parts(self, wanted: tuple[int, ...]) -> Self:
        """A solve that may replace outputs that are not wanted by `None`; by default it replaces none.

        **Arguments:** `wanted`: indices into the parts of the primal, or of the primal followed by its derivatives.
        """
        return self


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
        return _of_one(Request(solve), *leaves)

    @functools.partial(primal.defjvp, symbolic_zeros=True)
    def variation(leaves, tangents):
        zero = jax.custom_derivatives.SymbolicZero
        active = tuple(i for i in range(solve.movable) if not isinstance(tangents[i], zero))
        if not active:
            value = primal(*leaves)
            return value, jax.tree.map(jnp.zeros_like, value)
        active_tangents = [tangents[i] for i in active]
        if solve.prefers_adjoint(active, leaves):
            value = primal(*leaves)
            linear_solve = Tangents(active, solve, flat(value)[1], _value_and_tangents)
            change = push_forward(linear_solve, leaves, active_tangents, value)
            return value, jax.tree.map(functools.partial(_where_present, solve), value, change)
        value, slopes = _value_and_tangents(solve, active)(*leaves)
        # Derivatives are `None` where the primal has an array that is not differentiated.
        return value, jax.tree.map(lambda part, *rates: _change(solve, part, rates, active_tangents), value, *slopes)

    return primal(*_canonical(leaves))


def _canonical(leaves: tuple[Any, ...]) -> list[Any]:
    """Convert the leaves for a function with its own rule inside `jit`: JAX rejects the NumPy arrays that `vmap` passes
    on.
    """
    return [jnp.array(leaf) if is_traced(leaf) else leaf for leaf in leaves]


def _where_present(solve: AbstractDifferentiableSolve, value: Array, change: Array | None) -> Any:
    """The tangent of an output, 0 where it is absent; a symbolic zero if the output is not differentiable."""
    if change is None:
        return jax.custom_derivatives.zero_from_primal(value, symbolic_zeros=True)
    return jnp.where(solve.absent(value), 0.0, change)


def _change(solve: AbstractDifferentiableSolve, value: Array, slopes: tuple[Any, ...], tangents: list[Array]) -> Any:
    if slopes[0] is None:
        return jax.custom_derivatives.zero_from_primal(value, symbolic_zeros=True)
    is_absent = solve.absent(value)

    def share(slope: Array, tangent: Array) -> Array:
        # Selected before and after, so that an infinite tangent or cotangent of an absent output is dropped, not
        # multiplied.
        factor = jnp.where(jnp.all(is_absent), 0.0, tangent)
        return jnp.where(is_absent, 0.0, product(slope, factor))

    return sum(share(slope, tangent) for slope, tangent in zip(slopes, tangents, strict=True))


def _value_and_tangents(
    solve: AbstractDifferentiableSolve, active: tuple[int, ...]
) -> Callable[..., tuple[Primal, list[Primal]]]:
    """Primal and derivatives of one run, which can be differentiated once more."""

    @jax.custom_jvp
    def primal(*leaves):
        return _of_one(Request(solve, active), *leaves)

    @primal.defjvp
    def second_variation(leaves, tangents):
        # Differentiated operation by operation; the ensemble solve does not allow this.
        return jax.jvp(functools.partial(_nested, solve, active), leaves, tangents)

    return primal


# Compiled as a whole even outside of `jit`.
@eqx.filter_jit
def _nested(solve: AbstractDifferentiableSolve, active: tuple[int, ...], *leaves: Float[Array, "..."]) -> Any:
    """Primal and derivatives of one run as differentiable operations."""
    return _only(solve.value_and_tangents(active, True, 1, *leaves))


def _of_one(request: Request, *leaves: Float[Array, "..."]) -> Any:
    """The outputs for one run."""
    return solve_one(request, *leaves) if request.solve.in_blocks else _only(request.tree(1, *leaves))


def _only(results: Any) -> Any:
    return jax.tree.map(lambda result: result[0], results)


def tangents_by(
    build: Callable[[tuple[Array, ...], int | None], Any],
    active: tuple[int, ...],
    leaves: tuple[Array, ...],
    cells: int | None,
) -> tuple[Any, tuple[Any, ...], Callable[[list[Primal]], list[Primal]]]:
    """Build a problem and its tangents along leaves, each scaled by the leaf's own size.

    **Arguments:**

    - `build`: (leaves, cells) -> problem.
    - `active`, `leaves`: the leaves to move, and all leaves, of any shape. With `cells`, a leaf is a scalar or has the
      cells in its last axis. Each entry of a leaf has its own tangent.

    **Returns:** the problem; its tangents; and a function that turns derivatives along the tangents (trees of arrays,
    with `cells` in the first axis) into derivatives with respect to each leaf, the leaf's own axes last.

    **Example:** the tangent of a problem moves its rate by its own size.

    >>> problem, tangents, gather = tangents_by(build, (0,), (jnp.array([1.0, 2.0]),), 2)
    >>> print(tangents[0].rate)
    [1. 2.]
    """

    rebuilt, point = by_active(build, active, leaves, cells)
    sizes = [tangent_scale(leaf) for leaf in point]
    zeros = tuple(jnp.zeros_like(size) for size in sizes)
    own_shapes = [size.shape if cells is None else size.shape[:-1] for size in sizes]
    entries = [(k, index) for k, shape in enumerate(own_shapes) for index in np.ndindex(shape)]

    def along(k: int, index: tuple[int, ...]) -> tuple[Array, ...]:
        return (*zeros[:k], zeros[k].at[index].set(sizes[k][index]), *zeros[k + 1 :])

    def gather(slopes: list[Primal]) -> list[Primal]:
        by_entry = [
            jax.tree.map(functools.partial(_by_size, sizes[k][index]), slope)
            for (k, index), slope in zip(entries, slopes, strict=True)
        ]

        def of_leaf(k: int, shape: tuple[int, ...]) -> Primal:
            parts = [slope for (leaf, _), slope in zip(entries, by_entry, strict=True) if leaf == k]
            return jax.tree.map(lambda *parts: jnp.stack(parts, axis=-1).reshape(*parts[0].shape, *shape), *parts)

        return [of_leaf(k, shape) for k, shape in enumerate(own_shapes)]

    return rebuilt(*point), tangents_of(rebuilt, point, [along(*entry) for entry in entries]), gather


def _by_size(size: Array, part: Array) -> Array:
    """Convert a derivative along a number to one with respect to it; the number is a scalar or has one value per cell."""
    return part / size.reshape((-1,) + (1,) * (part.ndim - 1) if size.ndim else ())


def by_active(
    build: Callable[[tuple[Array, ...], int | None], Any],
    active: tuple[int, ...],
    leaves: tuple[Array, ...],
    cells: int | None,
) -> tuple[Callable[..., Any], tuple[Float[Array, "..."], ...]]:
    """A problem as a function of its active leaves, and these leaves; with `cells`, they have the cells in the last axis.

    **Arguments:** as for `tangents_by`.
    """

    def rebuilt(*moving: Array) -> Any:
        arguments = list(leaves)
        for i, leaf in zip(active, moving, strict=True):
            arguments[i] = leaf
        return build(tuple(arguments), cells)

    return rebuilt, tuple(leaves[i] if cells is None else over_cells(leaves[i], cells) for i in active)


def over_cells(leaf: Float[Array, "..."], cells: int) -> Float[Array, "... cells"]:
    """A leaf with the cells in its last axis, from such a leaf or a scalar."""
    return jnp.broadcast_to(leaf, (*jnp.shape(leaf)[:-1], cells))


def tangent_along(
    build: Callable[[tuple[Array, ...], int | None], Any],
    active: tuple[int, ...],
    leaves: tuple[Array, ...],
    tangents: tuple[Array, ...],
    cells: int,
) -> tuple[Any, Any, Float[Array, " cells"]]:
    """Build a problem and its tangent in one direction of its leaves, which is scaled by the size of the leaves.

    **Arguments:** as for `tangents_by`; `tangents`: those of the active leaves.

    **Returns:** the problem, the tangent, and the size of the direction in every cell.
    """
    rebuilt, point = by_active(build, active, leaves, cells)
    directions = [over_cells(tangent, cells) for tangent in tangents]
    ratios = [jnp.abs(tangent) / tangent_scale(leaf) for tangent, leaf in zip(directions, point, strict=True)]
    size = functools.reduce(jnp.maximum, [jnp.max(ratio.reshape(-1, cells), axis=0) for ratio in ratios])
    scaled = tuple(jnp.where(size > 0.0, tangent / jnp.where(size > 0.0, size, 1.0), 0.0) for tangent in directions)
    return rebuilt(*point), tangents_of(rebuilt, point, [scaled])[0], size


# Samples of a run as a differentiable solve: its leaves, and how they are assembled into a problem.


class ProblemSpec(eqx.Module):
    """How to build a problem from numbers and how to integrate it, except for the tolerance."""

    build: Callable[..., Any] = eqx.field(static=True)
    # JAX's PyTreeDef, which type checkers take for a variable.
    structure: Any = eqx.field(static=True)
    rest: Any
    settings: Settings
    grid: Float[Array, " steps"] | None
    # The numbers of axes of the modules' numbers, without an axis of cells.
    axes: tuple[int, ...] = eqx.field(static=True)

    def built(self, numbers: tuple[Array, ...], *extra: Any) -> Any:
        """Build the problem from the modules, with their numbers replaced, and from the extra arguments of `build`."""
        return self.build(eqx.combine(jax.tree.unflatten(self.structure, numbers), self.rest), *extra)


class AbstractSampling(AbstractDifferentiableSolve):
    """Samples of a run. The leaves are the modules' numbers, the times, the horizon, the tolerance and the arrays of
    the spec. `spec` is the rest of the spec, and `places` the positions of the arrays in it.
    """

    spec: eqx.AbstractVar[ProblemSpec]
    places: eqx.AbstractVar[Any]

    def absent(self, value: Float[Array, "..."]) -> Bool[Array, "..."]:
        return jnp.isnan(value)

    def _sorted(self, leaves: tuple[Array, ...]) -> tuple[tuple[Array, ...], tuple[Array, Array, Array], ProblemSpec]:
        """Split the leaves into the modules' numbers; times, horizon and tolerance; and the whole spec."""
        numbers, (times, t1, tolerance, *arrays_of_spec) = leaves[: self.movable], leaves[self.movable :]
        return numbers, (times, t1, tolerance), eqx.combine(self.spec, jax.tree.unflatten(self.places, arrays_of_spec))


def solve_for_samples(
    sampling: Callable[[int, ProblemSpec, Any], AbstractSampling],
    build: Callable[..., Any],
    modules: Any,
    times: Float[Array, " times"],
    t1: Float[Array, ""],
    settings: Settings,
    grid: Float[Array, " steps"] | None = None,
) -> Any:
    """Solve for the samples of a run.

    **Arguments:** `sampling`: a function that returns the solve, given its first three fields; `build`: a function that
    returns the problem, given the modules and extra arguments of the solve (the function is compared by identity);
    other arguments as for `sampled_run`.
    """
    numbers, static = eqx.partition(modules, eqx.is_inexact_array)
    leaves, structure = jax.tree.flatten(numbers)
    # Arrays, such as those of the solver, may be traced, so they belong to the leaves.
    arrays, spec = eqx.partition(
        ProblemSpec(build, structure, static, settings.with_tolerance(None), grid, tuple(map(jnp.ndim, leaves))),
        eqx.is_array,
    )
    arrays_of_spec, places = jax.tree.flatten(arrays)
    return differentiable_solve(
        sampling(len(leaves), spec, places), *leaves, times, as_number(t1), settings.tolerance, *arrays_of_spec
    )
