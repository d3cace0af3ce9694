"""Answers with their own derivatives: functions of scalars for `jit`, `vmap`, `grad`, `jvp` and their compositions.

A run is not differentiated operation by operation. A question finds its answer together with the answer's
slopes by some of the parameters (forwards or backwards), and JAX gets what it asks for from these.
A batch of answers, as `vmap` asks for, is found as the cells of one block.
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

from ..validation import is_traced
from ._batched_primitive import Request, find
from .slopes import tangents_of
from .variation import tangent_scale

#: An answer: arrays of floats, the cells along the first axis.
Answer = Any


class AbstractDifferentiableSolve(eqx.Module):
    """What is asked of a run, as a function of `leaves`, of which the first `movable` can be differentiated by."""

    #: Whether a batch is run as the cells of one block; otherwise each run is separate, with a single cell.
    in_blocks: ClassVar[bool] = True

    movable: eqx.AbstractVar[int]

    @abc.abstractmethod
    def absent(self, value: Float[Array, "..."]) -> Bool[Array, "..."]:
        """Where an entry of the answer means "none", such as an infinite time: its derivative is 0 there."""

    @abc.abstractmethod
    def answer(self, cells: int, *leaves: Float[Array, "..."]) -> Answer:
        """The answer in every cell; a number is a scalar or one per cell."""

    @abc.abstractmethod
    def with_slopes(
        self, active: tuple[int, ...], again: bool, cells: int, *leaves: Float[Array, "..."]
    ) -> tuple[Answer, list[Answer]]:
        """The answer, and its slope by each active leaf: shaped like the answer, with the leaf's own axes behind; a part of
        the answer that is not to be differentiated has `None` for its slope.

        **Arguments:** `active`: which leaves; `again`: whether what is found will be differentiated once more, forwards;
        `cells`, `leaves`: as for `answer`.
        """

    def for_parts(self, wanted: tuple[int, ...]) -> Self:
        """A question that may leave out (as `None`) all but some parts of what is found; by default it leaves out none.

        **Arguments:** `wanted`: numbers of parts of the answer, or of the answer and its slopes, one after the other.
        """
        return self


def differentiable_solve(question: AbstractDifferentiableSolve, *leaves: Float[Array, "..."]) -> Answer:
    """The answer for one run. Where it is absent its derivative is 0, whatever is done with it afterwards.

    **Arguments:** `leaves`: the numbers, as the question takes them for a single cell.

    **Returns:** the answer, without the axis of cells.
    """

    @jax.custom_jvp
    def found(*leaves):
        return _of_one(Request(question), *leaves)

    @functools.partial(found.defjvp, symbolic_zeros=True)
    def variation(leaves, tangents):
        zero = jax.custom_derivatives.SymbolicZero
        active = tuple(i for i in range(question.movable) if not isinstance(tangents[i], zero))
        if not active:
            answer = found(*leaves)
            return answer, jax.tree.map(jnp.zeros_like, answer)
        answer, slopes = _with_slopes(question, active)(*leaves)
        moved = [tangents[i] for i in active]
        # Slopes have `None` where the answer has an array that is not differentiated.
        return answer, jax.tree.map(lambda value, *by: _change(question, value, by, moved), answer, *slopes)

    return found(*_canonical(leaves))


def _canonical(leaves: tuple[Any, ...]) -> list[Any]:
    """Leaves that a function with a rule of its own takes inside `jit`: JAX refuses the NumPy arrays that `vmap` hands on."""
    return [jnp.array(leaf) if is_traced(leaf) else leaf for leaf in leaves]


def _change(question: AbstractDifferentiableSolve, value: Array, slopes: tuple[Any, ...], tangents: list[Array]) -> Any:
    if slopes[0] is None:
        return jax.custom_derivatives.zero_from_primal(value, symbolic_zeros=True)
    none = question.absent(value)

    def share(slope: Array, tangent: Array) -> Array:
        # Selected before and after, so that an infinite tangent or cotangent of an absent answer is dropped, not multiplied.
        kept = jnp.where(jnp.all(none), 0.0, tangent)
        product = slope * kept
        # Where the answer does not move, a cotangent that is not a number, such as that of theta at the pole, says nothing.
        product = jnp.where(slope == 0.0, 0.0, product).sum(axis=tuple(range(jnp.ndim(value), jnp.ndim(product))))
        return jnp.where(none, 0.0, product)

    return sum(share(slope, tangent) for slope, tangent in zip(slopes, tangents, strict=True))


def _with_slopes(
    question: AbstractDifferentiableSolve, active: tuple[int, ...]
) -> Callable[..., tuple[Answer, list[Answer]]]:
    """Answer and slopes of one run, which can be differentiated once more."""

    @jax.custom_jvp
    def found(*leaves):
        return _of_one(Request(question, active), *leaves)

    @found.defjvp
    def second_variation(leaves, tangents):
        # Differentiated operation by operation, which those of a block are not.
        return jax.jvp(functools.partial(_again, question, active), leaves, tangents)

    return found


# Compiled as a whole even outside of `jit`.
@eqx.filter_jit
def _again(question: AbstractDifferentiableSolve, active: tuple[int, ...], *leaves: Float[Array, "..."]) -> Any:
    """Answer and slopes of one run as operations that can be differentiated."""
    return _only(question.with_slopes(active, True, 1, *leaves))


def _of_one(request: Request, *leaves: Float[Array, "..."]) -> Any:
    """What is found of one run."""
    return find(request, *leaves) if request.question.in_blocks else _only(request.tree(1, *leaves))


def _only(results: Any) -> Any:
    return jax.tree.map(lambda result: result[0], results)


def tangents_by(
    build: Callable[[tuple[Array, ...], int | None], Any],
    active: tuple[int, ...],
    leaves: tuple[Array, ...],
    cells: int | None,
) -> tuple[Any, tuple[Any, ...], Callable[[list[Answer]], list[Answer]]]:
    """A problem and its directions along leaves, each of which changes a leaf in proportion to its own size.

    **Arguments:**

    - `build`: (leaves, cells) -> problem.
    - `active`, `leaves`: along which of the leaves. With `cells` they are scalars or one per cell; without, arrays of any
      shape, each of whose entries has a direction of its own.

    **Returns:** the problem; its directions; and a function that turns slopes along the directions (trees of arrays)
    into slopes by each leaf, the leaf's own axes behind (with `cells` there are none, and the cells come first).
    """

    def moved(*moving: Array) -> Any:
        every = list(leaves)
        for i, leaf in zip(active, moving, strict=True):
            every[i] = leaf
        return build(tuple(every), cells)

    point = tuple(leaves[i] for i in active)
    sizes = [tangent_scale(leaf) for leaf in point]
    zeros = tuple(jnp.zeros_like(size) for size in sizes)

    def along(k: int, tangent: Array) -> tuple[Array, ...]:
        return (*zeros[:k], tangent, *zeros[k + 1 :])

    if cells is not None:
        tangents = [along(k, size) for k, size in enumerate(sizes)]

        def gather(slopes: list[Answer]) -> list[Answer]:
            return [
                jax.tree.map(functools.partial(_by_cells, size), slope)
                for slope, size in zip(slopes, sizes, strict=True)
            ]
    else:
        entries = [(k, index) for k, size in enumerate(sizes) for index in np.ndindex(size.shape)]
        tangents = [along(k, zeros[k].at[index].set(sizes[k][index])) for k, index in entries]

        def gather(slopes: list[Answer]) -> list[Answer]:
            by_leaf = [
                [slope for (k, _), slope in zip(entries, slopes, strict=True) if k == i] for i in range(len(sizes))
            ]
            return [
                jax.tree.map(functools.partial(_by_entries, size), *some)
                for size, some in zip(sizes, by_leaf, strict=True)
            ]

    return moved(*point), tangents_of(moved, point, tangents), gather


def _by_entries(size: Array, *parts: Array) -> Array:
    """Slopes along the entries of a leaf, as slopes by the leaf, with its axes last."""
    return jnp.stack(parts, axis=-1).reshape(*parts[0].shape, *size.shape) / size


def _by_cells(size: Array, part: Array) -> Array:
    """Slopes along a leaf, as slopes by the leaf, which is one for all cells or one for each."""
    return part / size.reshape((-1,) + (1,) * (part.ndim - 1))
