"""Solves with their own derivative rules: functions of scalars for `jit`, `vmap`, `grad`, `jvp` and their compositions.

A run is not differentiated operation by operation. A solve returns its primal together with the derivatives with
respect to some of the parameters (forward or adjoint), and JAX's rules combine these. A batch under `vmap` is solved as
one ensemble.
"""

import abc
import functools
import math
from collections.abc import Callable
from typing import Any, ClassVar, Self

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from ..validation import is_traced
from ._batched_primitive import Request, flat, solve_one
from ._linear import Tangents, product, push_forward
from .slopes import tangents_of
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

    #: With more numbers than this, `push_forward` and `pull_back` take the place of the derivatives with respect to every
    #: number.
    most_slopes: ClassVar[float] = math.inf

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
        if sum(tangent.size for tangent in active_tangents) > solve.most_slopes:
            value = primal(*leaves)
            linear_solve = Tangents(solve, active, flat(value)[1], _value_and_tangents)
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
    - `active`, `leaves`: the leaves to move, and all leaves. With `cells`, a leaf is a scalar or an array with one
      number per cell. Without `cells`, a leaf is an array of any shape, and each entry has its own tangent.

    **Returns:** the problem; its tangents; and a function that turns derivatives along the tangents (trees of arrays)
    into derivatives with respect to each leaf, the leaf's own axes last (with `cells` there are none, and the cells
    come first).

    **Example:** the tangent of a problem moves its rate by its own size.

    >>> problem, tangents, gather = tangents_by(build, (0,), (jnp.array([1.0, 2.0]),), 2)
    >>> print(tangents[0].rate)
    [1. 2.]
    """

    def rebuilt(*moving: Array) -> Any:
        arguments = list(leaves)
        for i, leaf in zip(active, moving, strict=True):
            arguments[i] = leaf
        return build(tuple(arguments), cells)

    point = tuple(leaves[i] for i in active)
    sizes = [tangent_scale(leaf) for leaf in point]
    zeros = tuple(jnp.zeros_like(size) for size in sizes)

    def along(k: int, tangent: Array) -> tuple[Array, ...]:
        return (*zeros[:k], tangent, *zeros[k + 1 :])

    if cells is not None:
        tangents = [along(k, size) for k, size in enumerate(sizes)]

        def gather(slopes: list[Primal]) -> list[Primal]:
            return [
                jax.tree.map(functools.partial(_by_cells, size), slope)
                for slope, size in zip(slopes, sizes, strict=True)
            ]
    else:
        entries = [(k, index) for k, size in enumerate(sizes) for index in np.ndindex(size.shape)]
        tangents = [along(k, zeros[k].at[index].set(sizes[k][index])) for k, index in entries]

        def gather(slopes: list[Primal]) -> list[Primal]:
            by_leaf = [
                [slope for (k, _), slope in zip(entries, slopes, strict=True) if k == i] for i in range(len(sizes))
            ]
            return [
                jax.tree.map(functools.partial(_by_entries, size), *entries_of_leaf)
                for size, entries_of_leaf in zip(sizes, by_leaf, strict=True)
            ]

    return rebuilt(*point), tangents_of(rebuilt, point, tangents), gather


def by_active(
    build: Callable[[tuple[Array, ...], int | None], Any],
    active: tuple[int, ...],
    leaves: tuple[Array, ...],
    cells: int,
) -> tuple[Callable[..., Any], tuple[Float[Array, "... cells"], ...]]:
    """A problem as a function of its active leaves, and these leaves with one value per cell, the cells last.

    **Arguments:** as for `tangents_by`.
    """

    def rebuilt(*moving: Array) -> Any:
        arguments = list(leaves)
        for i, leaf in zip(active, moving, strict=True):
            arguments[i] = leaf
        return build(tuple(arguments), cells)

    return rebuilt, tuple(jnp.broadcast_to(leaves[i], (cells,)) for i in active)


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
    directions = [jnp.broadcast_to(tangent, (cells,)) for tangent in tangents]
    ratios = [jnp.abs(tangent) / tangent_scale(leaf) for tangent, leaf in zip(directions, point, strict=True)]
    size = functools.reduce(jnp.maximum, ratios)
    scaled = tuple(jnp.where(size > 0.0, tangent / jnp.where(size > 0.0, size, 1.0), 0.0) for tangent in directions)
    return rebuilt(*point), tangents_of(rebuilt, point, [scaled])[0], size


def _by_entries(size: Array, *parts: Array) -> Array:
    """Convert derivatives along the entries of a leaf to derivatives with respect to the leaf, whose axes come last."""
    return jnp.stack(parts, axis=-1).reshape(*parts[0].shape, *size.shape) / size


def _by_cells(size: Array, part: Array) -> Array:
    """Convert derivatives along a leaf to derivatives with respect to it; the leaf has one number for all cells or one
    per cell."""
    return part / size.reshape((-1,) + (1,) * (part.ndim - 1))
