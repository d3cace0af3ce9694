"""Settings of the integration; `DEFAULT_MAX_STEPS` limits the steps of a run, and `MOST_STEPS` those of a short run."""

from typing import Any, Self

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from ..validation import as_number, is_traced, shown
from ..warning import warn
from .oscillatory import Oscillatory8
from .tuned_pair import AbstractTunedPair

#: The absolute tolerance as a fraction of the relative one, in units of a problem's own magnitudes.
ABSOLUTE = 0.1

#: Default limit of the steps of a run.
DEFAULT_MAX_STEPS = 2_000_000

#: Greatest number of steps of runs that should be short: an impact, parameters tried by a fit, a run of the slow
#: reference. A run that needs more steps fails.
MOST_STEPS = 100_000


#: Least tolerance in single precision: below it, round-off would control the steps, and derivatives are often NaN.
TIGHTEST_IN_SINGLE = 1e-5


def as_tolerance(value: Any) -> Float[Array, ""]:
    """Convert a tolerance to a number; in single precision to one of at least `TIGHTEST_IN_SINGLE`, with a warning."""
    tolerance = as_number(value)
    if not isinstance(tolerance, jax.Array) or tolerance.dtype != jnp.float32:
        return tolerance
    is_finer = (tolerance > 0.0) & (tolerance < 0.99 * TIGHTEST_IN_SINGLE)
    if not is_traced(is_finer) and is_finer.any():
        warn(
            f"tolerance = {float(jnp.min(tolerance)):.3g} is finer than single precision resolves, and "
            f"{TIGHTEST_IN_SINGLE:g} takes its place; leave out JAX_ENABLE_X64=0 for double precision"
        )
    return jnp.where(is_finer, TIGHTEST_IN_SINGLE, tolerance)


class Settings(eqx.Module):
    """Settings of the integration, for every kind of result.

    **Arguments:**

    - `tolerance`: relative tolerance; in single precision at least 1e-5.
    - `solver`: a solver of Diffrax, which must be an explicit Runge-Kutta solver for ensembles; `None` for
      `Oscillatory8` in ensembles and `Dopri8` in single runs, which need its dense output.
    - `absolute`: absolute tolerance as a fraction of the relative one, in units of the problem's magnitudes.
    - `max_steps`: a run that needs more steps fails.
    - `lanes`: number of cells that advance together; by default as many as suit the machine (`lanes_for`).

    **Example:**

    >>> from nonholonomic.integration import Settings
    >>> type(Settings(1e-9).for_lanes).__name__, type(Settings(1e-9).for_single_runs).__name__
    ('Oscillatory8', 'Dopri8')
    """

    tolerance: Float[Array, ""] = eqx.field(converter=as_tolerance)
    solver: diffrax.AbstractSolver | None = None
    absolute: float = eqx.field(static=True, default=ABSOLUTE)
    max_steps: int = eqx.field(static=True, default=DEFAULT_MAX_STEPS)
    lanes: int | None = eqx.field(static=True, default=None)

    @property
    def for_lanes(self) -> diffrax.AbstractSolver:
        """The solver of ensembles."""
        return Oscillatory8() if self.solver is None else self.solver

    @property
    def for_single_runs(self) -> diffrax.AbstractSolver:
        """The solver for integration by Diffrax that locates events, and interpolates states, within steps.

        **Raises:** `ValueError` for a solver whose dense output is less accurate than its steps.
        """
        if isinstance(self.solver, AbstractTunedPair):
            raise ValueError(
                f"solver = {shown(self.solver)} is for tables and batches, and a single run must have a dense output as "
                "accurate as its steps: leave solver out, or pass diffrax.Dopri8()"
            )
        return self.for_steps_alone

    @property
    def for_steps_alone(self) -> diffrax.AbstractSolver:
        """The solver for integration by Diffrax with steps that end on all requested times."""
        return diffrax.Dopri8() if self.solver is None else self.solver

    def with_tolerance(self, tolerance: Float[Array, ""] | None) -> Self:
        """The same settings with another tolerance, or without a tolerance if the caller stores it."""
        return eqx.tree_at(lambda settings: settings.tolerance, self, tolerance, is_leaf=lambda leaf: leaf is None)

    def lanes_of(self, cells: int) -> int:
        """Number of a problem's cells that advance together."""
        return lanes_for(cells) if self.lanes is None else self.lanes


def lanes_for(cells: int) -> int:
    """Number of lanes for a number of cells.

    On a CPU, compilers write 64 lanes out as eight vectors; more lanes become loops, and fewer, or a number that is not a
    power of 2, are partly computed one by one. This matters more than the caches: also with variations, 64 lanes are
    the fastest. An accelerator needs tens of thousands of lanes.
    """
    max_lanes = 64 if jax.default_backend() == "cpu" else 32768
    return min(max_lanes, 1 << (cells - 1).bit_length())
