"""The Lyapunov exponent of a run of any model: whether nearby runs diverge exponentially, and how fast."""

from typing import NamedTuple

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, Shaped

from ..derivatives import exponent_of, growth
from ..derivatives.variation import continued
from ..hybrid import AbstractBatchedMode, HybridOutcome, solve_hybrid
from ..hybrid.ensemble import at_start
from ..hybrid.saltation import VariationalMode, variational_start
from ..integration import Settings
from ..integration.problem import Status
from ..terminal import status_line
from ..validation import require_outside
from .event import modes_of
from .model import AbstractModel, check_run, model_of, settings_for_lanes

#: What to use instead of transformations, in the message.
INSTEAD = "a Python loop (for tops, tippe.lyapunov_exponent takes lists) in place of vmap"

#: Greatest number of runs in a text.
MOST_LINES = 24

#: Number of time intervals with recorded growth; half of them give the exponent and its scatter.
STRETCHES = 32


class LyapunovExponent(NamedTuple):
    """The largest Lyapunov exponent of a run, or of each of several.

    - `exponent`: mean rate [1/s] of exponential divergence in the second half of the run; NaN if the run ended early.
    - `error`: error of the exponent [1/s]; an exponent below twice its error does not indicate chaos.
    - `status`: "completed", or how the run ended early, such as "contact_lost", "jammed" or "failed".
    - `end_time`: time at which the run ended [s]; `steps`: numbers of accepted and rejected steps.
    - `times`: 32 times [s], (32,); `running`: the mean rate of divergence [1/s] from the start to each of these times,
      (32, ...).

    **Example:**

    ```
    >>> import tippe
    >>> top = tippe.Top(mass=0.02, radius=0.02, offset=0.006, I1=2.994e-6, I3=3.2e-6)
    >>> scene = tippe.Scene(top, friction=tippe.Viscous(0.3))
    >>> growth = tippe.lyapunov_exponent(scene, tippe.Launch(1e-3, [155.0, 120.0]), t1=4.0, tolerance=1e-6)
    >>> growth.running.shape
    (32, 2)
    >>> print(growth)
    largest Lyapunov exponents
      0: 1.199 +- 0.35 1/s, completed at 4 s
      1: 1.158 +- 0.35 1/s, completed at 4 s

    ```
    """

    exponent: Float[np.ndarray, "..."]
    error: Float[np.ndarray, "..."]
    status: Shaped[np.ndarray, "..."]
    end_time: Float[np.ndarray, "..."]
    steps: Int[np.ndarray, "..."]
    times: Float[np.ndarray, " stretches"]
    running: Float[np.ndarray, "stretches ..."]

    def __repr__(self) -> str:
        columns = map(np.ravel, (self.exponent, self.error, self.status, self.end_time))
        lines = [
            f"{value:.4g} +- {error:.2g} 1/s, {word} at {end:.6g} s"
            for value, error, word, end in zip(*columns, strict=True)
        ]
        if np.ndim(self.exponent) == 0:
            return f"largest Lyapunov exponent {lines[0]}"
        rest = [f"  and {len(lines) - MOST_LINES} more"] if len(lines) > MOST_LINES else []
        return "\n".join(
            ["largest Lyapunov exponents", *(f"  {k}: {line}" for k, line in enumerate(lines[:MOST_LINES])), *rest]
        )


@status_line("simulating")
def lyapunov_exponent(
    system: object,
    start: object,
    t1: float,
    tolerance: float = 1e-9,
    solver: diffrax.AbstractERK | None = None,
    input: object = None,
    jumps: object = None,
) -> LyapunovExponent:
    """The largest Lyapunov exponent of a run, by the variational equation, through resets by the saltation matrix.

    The exponent is positive if nearby runs diverge exponentially. In chaotic motion, the exponent stays positive as `t1`
    grows. Source: Benettin et al., Meccanica 15 (1980) 9; see `nonholonomic/derivatives/variation.py`. In a run with
    resets, the tangent is rescaled at the ends of 32 intervals of time.

    **Arguments:**

    - `system`, `start`, `input`, `jumps`: as for `event_time`.
    - `t1`: time [s] to follow the motion, positive.
    - `tolerance`: relative tolerance of the integration, in [1e-14, 1e-2].
    - `solver`: an explicit Runge-Kutta solver of Diffrax, by default `nonholonomic.integration.Oscillatory8()`.

    **Returns:** a `LyapunovExponent`: the mean rate of divergence in the second half of the run, and its error.

    **Raises:** `ValueError` for arguments outside these ranges, and inside transformations.

    **Example:** a saddle, with the exponent 2 / s.

    ```
    >>> import jax.numpy as jnp
    >>> import nonholonomic
    >>> class Saddle(nonholonomic.AbstractMode):
    ...     rate: float
    ...
    ...     def field(self, t, y):
    ...         return self.rate * jnp.array([y[0], -y[1]])
    >>> result = nonholonomic.lyapunov_exponent(nonholonomic.Hybrid([Saddle(2.0)]), [1e-3, 1.0], t1=4.0)
    >>> print(f"{result.exponent:.2f} / s, {result.status}")
    2.00 / s, completed

    ```
    """
    require_outside((system, start, t1, tolerance), "lyapunov_exponent", INSTEAD)
    model = model_of(system, start, None, input, jumps).without_event()
    check_run(model, t1, tolerance)
    return exponent_of_model(model, float(t1), settings_for_lanes(tolerance, solver), ())


def exponent_of_model(model: AbstractModel, t1: float, settings: Settings, shape: tuple[int, ...]) -> LyapunovExponent:
    """The exponents of a model without an event. **Arguments:** `shape`: shape of the numbers of the model, () or (n,)."""
    cells = int(np.prod(shape, dtype=int))
    direction = model.direction(cells)
    if model.smooth:
        logarithm, ended = growth(model.problem(cells, model.comparable), direction, t1, STRETCHES, settings)
    else:
        logarithm, ended = _through_modes(model, direction, t1, cells, settings)
    status = np.asarray(_ended(model, jax.tree.map(jnp.asarray, ended), settings.tolerance))
    exponent, error = exponent_of(logarithm, t1)
    is_complete = status == Status.COMPLETED
    times = t1 * np.arange(1, STRETCHES + 1) / STRETCHES
    elapsed = np.minimum(times[:, None], ended.end_time)
    # A run of zero length has no divergence.
    running = np.cumsum(logarithm, axis=0) / np.where(elapsed > 0.0, elapsed, 1.0)
    return LyapunovExponent(
        exponent=np.where(is_complete, exponent, np.nan).reshape(shape),
        error=np.where(is_complete, error, np.nan).reshape(shape),
        status=np.array([Status(code).word for code in status]).reshape(shape),
        end_time=np.asarray(ended.end_time).reshape(shape),
        steps=np.asarray(ended.steps).reshape(shape),
        times=times,
        running=running.reshape(STRETCHES, *shape),
    )


_ended = eqx.filter_jit(lambda model, outcome, tolerance: model.ended(outcome, tolerance))


def _through_modes(
    model: AbstractModel, direction: Float[Array, "components cells"], t1: float, cells: int, settings: Settings
) -> tuple[Float[np.ndarray, "stretches cells"], HybridOutcome[np.ndarray]]:
    """The logarithm of the growth of a tangent through the modes of a model, and how the runs have ended."""
    modes, first, states = modes_of(model, cells, settings.tolerance, model.comparable)
    tangent = (tuple(jax.tree.map(lambda _: None, mode) for mode in modes), jnp.asarray(direction))
    variational = tuple(
        VariationalMode(mode, (still,), settings.tolerance, False)
        for mode, still in zip(modes, tangent[0], strict=True)
    )
    state, mode, size = np.asarray(variational_start(states, (tangent,))), np.asarray(first), len(states)
    state = np.asarray(_rescaled(modes, jnp.asarray(mode), jnp.asarray(state), size)[1])
    stretch, count = t1 / STRETCHES, len(model.counters)
    logarithms, ending = [], at_start(mode, state[:size], cells, count)
    for _ in range(STRETCHES):
        outcome = solve_hybrid(variational, mode, state, stretch, cells, settings, counters=count + 1, n_blocks=2)
        rescaled = _rescaled(modes, jnp.asarray(outcome.mode), jnp.asarray(outcome.state), size)
        logarithm, state = map(np.asarray, rescaled)
        mode, counts = np.minimum(outcome.mode, len(modes) - 1), ending.counts + outcome.counts[:-1]
        outcome = outcome._replace(crossing_time=ending.crossing_time, state=outcome.state[:size], counts=counts)
        alive, ending = continued(ending, outcome)
        logarithms.append(np.where(alive, logarithm, 0.0))
    return np.stack(logarithms), ending


@eqx.filter_jit
def _rescaled(
    modes: tuple[AbstractBatchedMode, ...],
    mode: Int[Array, " cells"],
    state: Float[Array, "twice_components_and_clock cells"],
    size: int,
) -> tuple[Float[Array, " cells"], Float[Array, "twice_components_and_clock cells"]]:
    """The logarithm of the length of each tangent in units of the magnitudes of the mode, and the states with tangents of
    length 1 and clocks at zero."""
    primal, variation, shift = state[:size], state[size + 1 : -1], state[-1]
    logarithm, unit = jnp.full(state.shape[1], jnp.nan), variation
    for number, of_mode in enumerate(modes):
        problem = of_mode.problem(primal)
        magnitudes = problem.start()[1]
        # If the mode began later, the state has advanced less at the same time.
        tangent = (variation - problem.field(state[size], primal) * shift) / magnitudes
        length = jnp.linalg.norm(tangent, axis=0)
        unit = jnp.where(mode == number, tangent / length * magnitudes, unit)
        logarithm = jnp.where(mode == number, jnp.log(length), logarithm)
    zero = jnp.zeros_like(shift)[None]
    return logarithm, jnp.concatenate([primal, zero, unit, zero])
