"""The Lyapunov exponents of a run of any model: whether nearby runs diverge exponentially, and how fast."""

from typing import Any, NamedTuple

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, Shaped

from ..derivatives import exponent_of, growth
from ..derivatives.variation import in_stretches, orthonormalised
from ..hybrid import AbstractBatchedMode, HybridOutcome, solve_hybrid
from ..hybrid.saltation import variational_modes, variational_start
from ..integration import Outcome, Settings
from ..integration.problem import Status
from ..terminal import status_line
from ..validation import explaining, require_outside, require_whole
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


@explaining
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


class LyapunovSpectrum(NamedTuple):
    """The largest Lyapunov exponents of a run.

    - `exponents`: mean rates [1/s] in the second half of the run, (n,), the largest first: volumes of k dimensions grow at the
      sum of the first k. `errors`: their errors [1/s].
    - `sum`: of all exponents [1/s], with its error `sum_error`.
    - `status`, `end_time`, `steps`, `times`: as for `LyapunovExponent`; `running`: the mean rates from the start to each of
      the times, (32, n).

    **Example:** as for `lyapunov_spectrum`.

    >>> import numpy as np
    >>> import nonholonomic
    >>> pair, row = np.array([0.5, -1.5]), np.ones((32, 2))
    >>> spectrum = nonholonomic.LyapunovSpectrum(pair, 0.01 * row[0], -1.0, 0.02, "completed", 9.0, 100, row[:, 0], row)
    >>> print(spectrum)
    Lyapunov spectrum, completed at 9 s
      0.5 +- 0.01 1/s
      -1.5 +- 0.01 1/s
      sum -1 +- 0.02 1/s, dimension 1.33
    """

    exponents: Float[np.ndarray, " n"]
    errors: Float[np.ndarray, " n"]
    sum: float
    sum_error: float
    status: str
    end_time: float
    steps: int
    times: Float[np.ndarray, " stretches"]
    running: Float[np.ndarray, "stretches n"]

    @property
    def dimension(self) -> float:
        """The dimension of the attractor by Kaplan and Yorke: the number of exponents whose sum is still positive, and the
        share of the next; NaN if that needs more exponents."""
        sums = np.cumsum(self.exponents)
        (negative,) = np.nonzero(sums < 0.0)
        if not len(negative):
            return float("nan")
        count = negative[0]
        return float(count + (sums[count - 1] / -self.exponents[count] if count else 0.0))

    def __repr__(self) -> str:
        lines = [f"{rate:.4g} +- {error:.2g} 1/s" for rate, error in zip(self.exponents, self.errors, strict=True)]
        last = f"sum {self.sum:.4g} +- {self.sum_error:.2g} 1/s"
        dimension = f", dimension {self.dimension:.3g}" if np.isfinite(self.dimension) else ""
        heading = f"Lyapunov spectrum, {self.status} at {self.end_time:.6g} s"
        return "\n  ".join([heading, *lines, last + dimension])


@explaining
@status_line("simulating")
def lyapunov_spectrum(
    system: object,
    start: object,
    t1: float,
    n: int | None = None,
    tolerance: float = 1e-9,
    solver: diffrax.AbstractERK | None = None,
    input: object = None,
    jumps: object = None,
) -> LyapunovSpectrum:
    """The largest Lyapunov exponents of a run, through resets by the saltation matrix.

    Tangents are integrated with the run and orthonormalised again and again. Source: Benettin et al., Meccanica 15 (1980) 9 and
    21. Volumes that keep their size give a sum of zero, and motion without rest an exponent of zero.

    **Arguments:**

    - `system`, `start`, `input`, `jumps`: as for `event_time`.
    - `t1`: time [s] to follow the motion, positive.
    - `n`: number of exponents, by default as many as there are independent changes of the start.
    - `tolerance`, `solver`: as for `lyapunov_exponent`.

    **Returns:** a `LyapunovSpectrum`; its numbers are NaN if the run ends early. If resets take directions away, as when a body
    comes to rest, the last exponents are minus infinity.

    **Raises:** `ValueError` for arguments outside these ranges, and inside transformations.

    **Example:** Lorenz' system; the sum is that of the rates at which volumes shrink, -(10 + 1 + 8/3) / s.

    ```
    >>> import jax.numpy as jnp
    >>> import nonholonomic
    >>> class Lorenz(nonholonomic.AbstractMode):
    ...     drive: float
    ...
    ...     def field(self, t, y):
    ...         x, y, z = y
    ...         return jnp.array([10 * (y - x), x * (self.drive - z) - y, x * y - 8 / 3 * z])
    >>> system = nonholonomic.Hybrid([Lorenz(28.0)])
    >>> spectrum = nonholonomic.lyapunov_spectrum(system, [1.0, 1.0, 20.0], t1=50.0, tolerance=1e-6)
    >>> print(f"{spectrum.sum:.3f} / s")
    -13.667 / s

    ```
    """
    require_outside((system, start, t1, n, tolerance), "lyapunov_spectrum", "a Python loop in place of vmap")
    model = model_of(system, start, None, input, jumps).without_event()
    check_run(model, t1, tolerance)
    settings, t1 = settings_for_lanes(tolerance, solver), float(t1)
    tangents = independent_directions(model)
    if n is not None:
        require_whole(n, "n", 1)
        if n > len(tangents):
            raise ValueError(f"n = {n} must be at most {len(tangents)}, the number of independent changes of the start")
        tangents = tangents[:n]
    logarithm, ended = growth_of_model(model, tangents, t1, settings)
    (status,) = np.asarray(_ended(model, jax.tree.map(jnp.asarray, ended), settings.tolerance))
    # The sum is averaged as the exponents are.
    rates, errors = exponent_of(np.concatenate([logarithm[..., 0], logarithm.sum(axis=1)], axis=1), t1)
    if status != Status.COMPLETED:
        rates, errors = np.full((2, len(rates)), np.nan)
    times, end = t1 * np.arange(1, STRETCHES + 1) / STRETCHES, float(ended.end_time[0])
    elapsed = np.where(end > 0.0, np.minimum(times, end), 1.0)
    running = np.cumsum(logarithm[..., 0], axis=0) / elapsed[:, None]
    # Directions that do not act on each other keep their order.
    order = np.argsort(-rates[:-1])
    total, error = float(rates[-1]), float(errors[-1])
    word, steps = Status(status).word, int(ended.steps[0])
    return LyapunovSpectrum(rates[order], errors[order], total, error, word, end, steps, times, running[:, order])


#: Changes of the start that are smaller than this, without their parts along others, are not independent of these.
INDEPENDENT = 1e-9


def independent_directions(model: AbstractModel) -> Float[Array, "directions components 1"]:
    """Independent generic changes of the start of one run, as many as there are."""
    first = model.direction(1)
    if model.smooth:
        magnitudes = model.problem(1, model.comparable).start()[1]
    else:
        modes, number, states = modes_of(model, 1, 1e-9, model.comparable)
        magnitudes = modes[int(np.asarray(number)[0])].problem(states).start()[1]
    count = len(first)
    changes = jnp.stack([first, *(model.direction(1, number) for number in range(1, count))])
    lengths, _ = orthonormalised(changes / magnitudes)
    return changes[np.exp(np.asarray(lengths)[:, 0]) > INDEPENDENT]


def exponent_of_model(model: AbstractModel, t1: float, settings: Settings, shape: tuple[int, ...]) -> LyapunovExponent:
    """The exponents of a model without an event. **Arguments:** `shape`: shape of the numbers of the model, () or (n,)."""
    cells = int(np.prod(shape, dtype=int))
    logarithm, ended = growth_of_model(model, model.direction(cells)[None], t1, settings)
    logarithm = logarithm[:, 0]
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


def growth_of_model(
    model: AbstractModel, tangents: Float[Array, "tangents components cells"], t1: float, settings: Settings
) -> tuple[Float[np.ndarray, "stretches tangents cells"], Outcome | HybridOutcome]:
    """The logarithms of the growth of tangents in the cells of a model, and how the runs have ended."""
    cells = tangents.shape[-1]
    if model.smooth:
        return growth(model.problem(cells, model.comparable), tangents, t1, STRETCHES, settings)
    modes, first, states = modes_of(model, cells, settings.tolerance, model.comparable)
    pairs = tuple((tuple(jax.tree.map(lambda _: None, mode) for mode in modes), change) for change in tangents)
    variational = variational_modes(modes, pairs, settings.tolerance, False)
    size, counters, blocks = len(states), len(model.counters) + 1, 1 + len(pairs)

    def advance(runs: Any, begin: float, duration: float) -> tuple[Array, Any, HybridOutcome]:
        mode, state = runs
        outcome = solve_hybrid(variational, mode, state, duration, cells, settings, counters=counters, n_blocks=blocks)
        logarithm, state = _rescaled(modes, jnp.asarray(outcome.mode), jnp.asarray(outcome.state), size)
        mode = np.minimum(outcome.mode, len(modes) - 1)
        return logarithm, (mode, np.asarray(state)), outcome._replace(state=outcome.state[:size])

    _, state = _rescaled(modes, jnp.asarray(first), variational_start(states, pairs), size)
    logarithm, ended = in_stretches(advance, (np.asarray(first), np.asarray(state)), t1, STRETCHES)
    return logarithm, ended._replace(counts=ended.counts[:-1])


@eqx.filter_jit
def _rescaled(
    modes: tuple[AbstractBatchedMode, ...],
    mode: Int[Array, " cells"],
    state: Float[Array, "all cells"],
    size: int,
) -> tuple[Float[Array, "tangents cells"], Float[Array, "all cells"]]:
    """The logarithms of the growth of tangents in units of the magnitudes of the mode, and the states with tangents of length 1
    and clocks at zero."""
    rows = state.reshape(-1, size + 1, state.shape[1])
    primal, clock, variations, shifts = rows[0, :-1], rows[0, -1], rows[1:, :-1], rows[1:, -1:]
    tangents, magnitudes = variations, jnp.ones_like(primal)
    for number, of_mode in enumerate(modes):
        problem = of_mode.problem(primal)
        # If the mode began later, the state has advanced less at the same time.
        moved = variations - problem.field(clock, primal) * shifts
        tangents = jnp.where(mode == number, moved, tangents)
        magnitudes = jnp.where(mode == number, problem.start()[1], magnitudes)
    logarithm, frame = orthonormalised(tangents / magnitudes)
    unit = jnp.concatenate([primal[None], frame * magnitudes])
    return logarithm, jnp.concatenate([unit, jnp.zeros_like(unit[:, :1])], axis=1).reshape(state.shape)
