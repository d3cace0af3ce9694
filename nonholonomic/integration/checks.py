"""Checks of the arguments of a run: horizon, tolerance, times of output, solver and adjoint.

The `require_` functions check concrete arguments before anything compiles; `legal_run` checks traced ones. `TIGHTEST` is
the smallest relative tolerance.
"""

from collections.abc import Iterator
from typing import Any

import diffrax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Bool, Float

from ..parameters import numbers
from ..validation import Bound, legal, require_all, require_increasing, require_kind, require_scalars, shown

#: The least and the greatest relative tolerance: below this range, round-off would control the steps; above it, the
#: steps are hardly controlled.
TIGHTEST, LOOSEST = 1e-14, 1e-2


def tolerance_bound(tolerance: Any) -> Bound:
    """The legal range of the relative tolerance.

    **Example:**

    >>> from nonholonomic.integration.checks import tolerance_bound
    >>> tolerance_bound(1.0).require()
    Traceback (most recent call last):
    ValueError: tolerance = 1.0 must be at most 0.01
    """
    return Bound(tolerance, "tolerance", at_least=TIGHTEST, at_most=LOOSEST)


def run_bounds(t1: Any, tolerance: Any) -> Iterator[Bound]:
    """The ranges of the horizon [s] and of the tolerance.

    **Example:**

    >>> from nonholonomic.integration.checks import run_bounds
    >>> [bound.name for bound in run_bounds(t1=5.0, tolerance=1e-9)]
    ['t1', 'tolerance']
    """
    yield Bound(t1, "t1", above=0.0)
    yield tolerance_bound(tolerance)


def times_bounds(times: Any, t1: Any) -> Iterator[Bound]:
    """The range of the times of output [s]."""
    yield Bound(times, "times", at_least=0.0, at_most=t1)


def legal_run(
    others: Bool[Array, "..."] | bool,
    t1: Float[ArrayLike, "..."],
    tolerance: Float[ArrayLike, "..."],
    times: Any = None,
) -> tuple[Bool[Array, "..."], Float[Array, "..."], Float[Array, "..."]]:
    """Whether the traced numbers of a run are legal, and its horizon and tolerance. A run with illegal numbers might
    never end, so it gets the horizon 0, and the largest tolerance, which does not affect its batch.

    **Arguments:** `others`: whether all other numbers are legal. This function checks `t1`, `tolerance`, and the output
    `times` (times,), which must increase.

    **Returns:** whether the run is legal, its horizon and its tolerance.

    **Example:**

    >>> from nonholonomic.integration.checks import legal_run
    >>> legal, t1, tolerance = legal_run(True, t1=-1.0, tolerance=1e-9)
    >>> print(legal, t1, tolerance)
    False 0.0 0.01
    """
    is_legal = jnp.asarray(others) & legal(run_bounds(t1, tolerance))
    if times is not None:
        is_legal = jnp.all(is_legal & jnp.all(legal(times_bounds(times, t1)))) & jnp.all(jnp.diff(times) > 0.0)
    return is_legal, jnp.where(is_legal, t1, 0.0), jnp.where(is_legal, tolerance, LOOSEST)


def require_run(scene: Any, launch: Any, t1: Any, tolerance: Any, kinds: tuple[type, type], lists: str) -> None:
    """Raise `ValueError` unless scene and launch are of these kinds and have scalars only, the horizon is positive, and
    the tolerance is legal.

    **Arguments:** `lists`: the functions that accept lists instead of single numbers, for the message. The parameters
    of a function, such as that of a `Graph`, may be lists.

    **Example:**

    >>> from nonholonomic.integration import Settings
    >>> from nonholonomic.integration.checks import require_run
    >>> require_run(Settings(1e-9), Settings(1e-6), -1.0, 1e-9, (Settings, Settings), "jax.vmap takes lists")
    Traceback (most recent call last):
    ValueError: t1 = -1.0 ...
    """
    require_kind(scene, "scene", kinds[0])
    require_kind(launch, "launch", kinds[1], several=lists)
    require_all(run_bounds(t1, tolerance))
    values = numbers("scene", scene, functions=False) | numbers("launch", launch) | {"t1": t1, "tolerance": tolerance}
    require_scalars(values, lists)


def require_times(times: Any, t1: Any) -> None:
    """Raise `ValueError` unless the times of output are an increasing list within [0, t1].

    **Example:**

    >>> from nonholonomic.integration.checks import require_times
    >>> require_times(jnp.array([1.0, 6.0]), t1=5.0)
    Traceback (most recent call last):
    ValueError: times ...
    """
    if np.ndim(times) == 0 and not isinstance(times, str) and times is not None:
        raise ValueError(
            f"times = {shown(times)} must be a list of at least one number; np.linspace makes evenly spaced ones"
        )
    require_all(times_bounds(times, t1))
    require_increasing(times, "times")


def require_adaptive(solver: Any, others: str = "") -> None:
    """Raise `ValueError` unless the solver is `None` or a solver of Diffrax that estimates its errors and integrates a
    single field (others add a stiff part or noise). **Arguments:** `others`: further allowed solvers, for the message.

    **Example:**

    >>> import diffrax
    >>> from nonholonomic.integration.checks import require_adaptive
    >>> require_adaptive(diffrax.Tsit5())
    """
    structure = getattr(solver, "term_structure", None)
    adaptive = isinstance(solver, diffrax.AbstractAdaptiveSolver) and isinstance(structure, type)
    if solver is not None and not adaptive:
        raise ValueError(
            f"solver = {shown(solver)} must be an adaptive solver of Diffrax for ordinary differential equations, such as "
            f"Dopri8(){others}"
        )


def require_adjoint(adjoint: Any) -> None:
    """Raise `ValueError` unless this is `None` or an adjoint method of Diffrax.

    **Example:**

    >>> import diffrax
    >>> from nonholonomic.integration.checks import require_adjoint
    >>> require_adjoint(diffrax.DirectAdjoint())
    """
    if not isinstance(adjoint, diffrax.AbstractAdjoint | None):
        raise ValueError(
            f"adjoint = {shown(adjoint)} must be one of Diffrax, such as RecursiveCheckpointAdjoint(), or None"
        )
