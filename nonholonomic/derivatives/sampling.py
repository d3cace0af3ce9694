"""Samples of a run as a differentiable solve: its leaves, and how they are assembled into a problem."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from ..integration import Settings
from ..validation import as_number
from .differentiable import AbstractDifferentiableSolve, differentiable_solve


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
