"""What runs do in the long term: Lyapunov exponents, bifurcation diagrams, and basins of attraction."""

import dataclasses
from collections.abc import Sequence
from concurrent.futures import Executor
from pathlib import Path
from typing import Any, NamedTuple

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, Shaped

from ..derivatives.variation import exponent_of, growth, in_stretches, orthonormalised
from ..hybrid import HybridOutcome, solve_hybrid
from ..hybrid.ensemble import Modes
from ..hybrid.saltation import with_variations
from ..integration import Outcome, Settings
from ..integration.problem import DEFAULT_MAX_STEPS, Status
from ..sweeps import Axis, Table, Variable
from ..terminal import status_line
from ..text import shown
from ..validation import Bound, explaining, require_outside, require_whole, warn
from .crossings import crossings
from .event import UNMEASURED, Event, modes_of
from .model import AbstractModel, AbstractSceneModel, check_horizon, check_run, model_of, settings_for_lanes
from .simulate import Samples, Solved, require_names
from .table import Options, table_of

# Lyapunov exponents: whether nearby runs diverge exponentially, and how fast.

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
    grows. Source: Benettin et al., Meccanica 15 (1980) 9; see `nonholonomic/derivatives/variation.py`. The tangent is
    rescaled at the ends of at least 32 intervals of time.

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
    - `sum`: of these exponents [1/s], with its error `sum_error`.
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
    21. If volumes keep their size, the sum is zero; a motion that does not come to rest has an exponent of zero.

    **Arguments:**

    - `system`, `start`, `input`, `jumps`: as for `event_time`.
    - `t1`: time [s] to follow the motion, positive.
    - `n`: number of exponents, by default as many as there are independent changes of the start.
    - `tolerance`, `solver`: as for `lyapunov_exponent`.

    **Returns:** a `LyapunovSpectrum`; its numbers are NaN if the run ends early. If resets take directions away, as when a body
    comes to rest, the last exponents are minus infinity. For scenes and for systems with constraints, exponents below -25 / t1
    are NaN, because round-off hides them; a shorter run has them.

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
    tangents, is_constrained = independent_directions(model)
    if n is not None:
        require_whole(n, "n", 1)
        if n > len(tangents):
            raise ValueError(f"n = {n} must be at most {len(tangents)}, the number of independent changes of the start")
        tangents = tangents[:n]
    logarithm, ended, (status,) = growth_of_model(model, tangents, t1, settings)
    # Directions that a reset takes away do not come back. The sum is averaged as the exponents are.
    logarithm = np.where(np.logical_or.accumulate(np.isneginf(logarithm)), -np.inf, logarithm)
    if is_constrained:
        is_hidden = np.cumsum(logarithm, axis=0).min(axis=0) < -MOST_DECAY
        logarithm = np.where(is_hidden & ~np.isneginf(logarithm), np.nan, logarithm)
    with np.errstate(invalid="ignore"):
        rates, errors = exponent_of(np.concatenate([logarithm[..., 0], logarithm.sum(axis=1)], axis=1), t1)
    if status != Status.COMPLETED:
        rates, errors = np.full((2, len(rates)), np.nan)
    times, running = means_until(logarithm[..., 0], ended.end_time, t1)
    # Directions that do not act on each other keep their order.
    order = np.argsort(-rates[:-1])
    total, error, end = float(rates[-1]), float(errors[-1]), float(ended.end_time[0])
    word, steps = Status(status).word, int(ended.steps[0])
    return LyapunovSpectrum(rates[order], errors[order], total, error, word, end, steps, times, running[:, order])


def means_until(
    logarithm: Float[np.ndarray, "stretches columns"], end_time: Float[np.ndarray, " columns"], t1: float
) -> tuple[Float[np.ndarray, " stretches"], Float[np.ndarray, "stretches columns"]]:
    """The ends of the stretches [s], and the mean growth [1/s] from the start to each of them."""
    times = t1 * np.arange(1, STRETCHES + 1) / STRETCHES
    elapsed = np.minimum(times[:, None], end_time)
    # A run of zero length has no growth.
    return times, np.cumsum(logarithm, axis=0) / np.where(elapsed > 0.0, elapsed, 1.0)


#: If some changes of the state are impossible, round-off towards them hides changes that have decayed by more than e to this
#: power.
MOST_DECAY = 25.0

#: Changes of the start that are smaller than this, without their parts along others, are not independent of these.
INDEPENDENT = 1e-9


def independent_directions(model: AbstractModel) -> tuple[Float[Array, "directions components 1"], bool]:
    """Independent generic changes of the start of one run, as many as there are; and whether other changes are impossible."""
    modes, number, states = modes_of(model, 1, 1e-9, model.comparable)
    magnitudes = modes[int(np.asarray(number)[0])].problem(states).start()[1]
    changes = jnp.stack([model.direction(1, number) for number in range(len(states))])
    lengths, _ = orthonormalised(changes / magnitudes)
    is_new = np.exp(np.asarray(lengths)[:, 0]) > INDEPENDENT
    return changes[is_new], bool(is_new.sum() < np.sum(np.asarray(magnitudes) < UNMEASURED))


def exponent_of_model(model: AbstractModel, t1: float, settings: Settings, shape: tuple[int, ...]) -> LyapunovExponent:
    """The exponents of a model without an event. **Arguments:** `shape`: shape of the numbers of the model, () or (n,)."""
    cells = int(np.prod(shape, dtype=int))
    logarithm, ended, status = growth_of_model(model, model.direction(cells)[None], t1, settings)
    exponent, error = exponent_of(logarithm[:, 0], t1)
    is_complete = status == Status.COMPLETED
    times, running = means_until(logarithm[:, 0], ended.end_time, t1)
    return LyapunovExponent(
        exponent=np.where(is_complete, exponent, np.nan).reshape(shape),
        error=np.where(is_complete, error, np.nan).reshape(shape),
        status=np.array([Status(code).word for code in status]).reshape(shape),
        end_time=np.asarray(ended.end_time).reshape(shape),
        steps=np.asarray(ended.steps).reshape(shape),
        times=times,
        running=running.reshape(STRETCHES, *shape),
    )


def growth_of_model(
    model: AbstractModel, tangents: Float[Array, "tangents components cells"], t1: float, settings: Settings
) -> tuple[Float[np.ndarray, "stretches tangents cells"], Outcome | HybridOutcome, Int[np.ndarray, " cells"]]:
    """The logarithms of the growth of tangents in the cells of a model, how the runs have ended, and their `Status`."""
    cells = tangents.shape[-1]
    if model.smooth:
        logarithm, ended = growth(model.problem(cells, model.comparable), tangents, t1, STRETCHES, settings)
    else:
        logarithm, ended = _through_modes(model, tangents, t1, settings)
    status = eqx.filter_jit(model.ended)(jax.tree.map(jnp.asarray, ended), settings.tolerance)
    return logarithm, ended, np.asarray(status)


def _through_modes(
    model: AbstractModel, tangents: Float[Array, "tangents components cells"], t1: float, settings: Settings
) -> tuple[Float[np.ndarray, "stretches tangents cells"], HybridOutcome]:
    """The growth and the outcome of a model with several modes or resets."""
    cells = tangents.shape[-1]
    modes, first, states = modes_of(model, cells, settings.tolerance, model.comparable)
    pairs = tuple((tuple(jax.tree.map(lambda _: None, mode) for mode in modes), change) for change in tangents)
    variational, start = with_variations(modes, states, pairs, settings.tolerance, False)
    size, counters, blocks = len(states), len(model.counters) + 1, 1 + len(pairs)

    def advance(runs: Any, begin: float, duration: float) -> tuple[Array, Any, HybridOutcome]:
        mode, state = runs
        outcome = solve_hybrid(variational, mode, state, duration, cells, settings, counters=counters, n_blocks=blocks)
        logarithm, state = _rescaled(modes, jnp.asarray(outcome.mode), jnp.asarray(outcome.state), size)
        mode = np.minimum(outcome.mode, len(modes) - 1)
        return logarithm, (mode, np.asarray(state)), outcome._replace(state=outcome.state[:size])

    _, state = _rescaled(modes, jnp.asarray(first), start, size)
    logarithm, ended = in_stretches(advance, (np.asarray(first), np.asarray(state)), t1, STRETCHES)
    return logarithm, ended._replace(counts=ended.counts[:-1])


@eqx.filter_jit
def _rescaled(
    modes: Modes, mode: Int[Array, " cells"], state: Float[Array, "all cells"], size: int
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
    # Runs are compared at the same time: what a clock differs by is round-off, which would outlast all that decays.
    tangents = jnp.where(magnitudes < UNMEASURED, tangents, 0.0)
    logarithm, frame = orthonormalised(tangents / magnitudes)
    unit = jnp.concatenate([primal[None], frame * magnitudes])
    return logarithm, jnp.concatenate([unit, jnp.zeros_like(unit[:, :1])], axis=1).reshape(state.shape)


# Bifurcation diagrams and basins of attraction.


@explaining
def bifurcation(
    system: object,
    start: object,
    t1: float,
    event: Event = None,
    count: int = 100,
    skip: int = 300,
    *,
    axes: dict[str, object],
    **options: Any,
) -> Table:
    """The last returns of runs to a section over one number: a bifurcation diagram, which `plot` draws as points.

    **Arguments:**

    - `system`, `start`, `t1`, `event`, `count`, `skip`: as for `crossings`; runs should settle in the returns that are left
      out. `options`: further arguments of `crossings`.
    - `axes`: full name of one parameter -> values.

    **Returns:** a `Table` as that of `crossings`, over the number and the axis `crossing`.

    **Raises:** as `crossings`, and `ValueError` for several axes. A warning counts the runs that ended early.

    **Example:** the logistic map, once a second: one value, and beyond 3 two.

    ```
    >>> import jax.numpy as jnp
    >>> import nonholonomic
    >>> class Logistic(nonholonomic.AbstractMode):
    ...     rate: float
    ...
    ...     def field(self, t, y):
    ...         return jnp.array([0.0, 1.0])
    ...
    ...     def margin(self, t, y):
    ...         return 1.0 - y[1]
    ...
    ...     def reset(self, t, y):
    ...         return jnp.array([self.rate * y[0] * (1.0 - y[0]), 0.0]), 0
    >>> def middle(t, y):
    ...     return 0.5 - y[1]
    >>> system = nonholonomic.Hybrid([Logistic(2.8)])
    >>> axes = {"rate": [2.8, 3.2]}
    >>> diagram = nonholonomic.bifurcation(system, [0.4, 0.0], 500.0, middle, 4, axes=axes, progress=False)
    >>> print(diagram.y0.round(4))
    [[0.6429 0.6429 0.6429 0.6429]
     [0.513  0.7995 0.513  0.7995]]

    ```
    """
    if not isinstance(axes, dict) or len(axes) != 1:
        raise ValueError(f"axes = {shown(axes)} must name one parameter and its values; crossings takes several")
    table = crossings(system, start, t1, event, count, skip, axes=axes, **options)
    words = np.ravel(table.status).tolist()
    early = [word for word in words if word not in (Status.EVENT.word, Status.COMPLETED.word, Status.ILLEGAL.word)]
    if early:
        warn(f"{len(early)} of {len(words)} runs ended early ({', '.join(dict.fromkeys(early))}): returns are missing")
    return table


#: What is known of each quantity, as the ends of the names of variables.
KINDS = ("min", "max", "change", "range")


class Ranges(Samples):
    """The ranges of quantities in the last quarter of runs, how they change from the quarter before, and in whole runs."""

    has_kernel = False

    def variables(self, model: AbstractModel) -> dict[str, Variable]:
        """The variables of the table with the ranges."""
        return {
            f"{name}_{kind}": variable._replace(inner=(), long_name=f"{word} {variable.long_name}")
            for name, variable in super().variables(model).items()
            for kind, word in zip(KINDS, ("least", "greatest", "change of", "range of"), strict=True)
        }

    def inner(self, model: AbstractModel) -> list[Axis]:
        """These variables have no further dimensions."""
        return []

    def solve(self, cells: AbstractModel, t1: float, size: int, count: int, settings: Settings) -> Solved:
        """The `Status` of all cells, of which only the first `count` are run, and the variables of the table."""
        status, values = super().solve(cells, t1, size, count, settings)
        for name in self.names:
            quarters = jnp.stack(jnp.split(jnp.asarray(values.pop(name)), 4, axis=1))
            least, greatest = jnp.min(quarters, axis=2), jnp.max(quarters, axis=2)
            change = jnp.maximum(jnp.abs(least[3] - least[2]), jnp.abs(greatest[3] - greatest[2]))
            parts = (least[3], greatest[3], change, jnp.max(greatest, axis=0) - jnp.min(least, axis=0))
            values |= {f"{name}_{kind}": part for kind, part in zip(KINDS, parts, strict=True)}
        return status, jax.tree.map(np.asarray, values)


#: Number of samples in each quarter of a run.
SAMPLED = 250

#: Differences below this, in units of the tolerance and of the quantity, may be errors of the integration.
ERRORS = 10.0


@explaining
def basins(
    system: object,
    start: object,
    t1: float,
    *,
    axes: dict[str, object],
    quantities: Sequence[str] | None = None,
    resolution: float = 0.05,
    scattered: bool = False,
    max_steps: int = DEFAULT_MAX_STEPS,
    tolerance: float = 1e-6,
    solver: diffrax.AbstractERK | None = None,
    path: str | Path | None = None,
    progress: bool = True,
    executor: Executor | None = None,
    input: object = None,
    jumps: object = None,
) -> Table:
    """Basins of attraction: which attractor the run of each cell reaches. The attractors are found, not given.

    Two runs have the same attractor if their quantities have the same least and greatest values in the last quarter of the run,
    or if other runs lead from one to the other. A run has settled if these are as in the quarter before. For other ways see
    G. Datseris and A. Wagemakers, Chaos 32 (2022) 023104.

    **Arguments:**

    - `system`, `start`, `axes`, `input`, `jumps`, `scattered`, `max_steps`, `tolerance`, `solver`, `path`, `progress`,
      `executor`: as for `sweep`; axes are often components of the start, such as `"start[0]"`.
    - `t1`: horizon [s]; runs should settle in the first half of it.
    - `quantities`: names of scalar quantities that tell attractors apart and stay within bounds, by default all components of
      your own system. Leave out an angle that grows.
    - `resolution`: difference below which values are the same, as a fraction of the range of the quantity: in a usual run, or
      over the attractors if that is more.

    **Returns:** a `Table` with `attractor`: 1 for that of most cells, 2 for the next and so on, 0 where a run has not
    settled by `t1`, and -1 where it ended before, as `status` says ("unresolved" where it came to rest by ever shorter
    bounces); for each quantity, such as `y0`, its least and greatest values in the last quarter of the run as `y0_min` and
    `y0_max`, their greatest change from the quarter before as `y0_change`, and the range of the whole run as `y0_range`;
    `status`, `end_time`, `steps`, `rejected`. `plot("attractor")` draws a map.

    **Raises:** as `sweep`.

    **Example:** a ball in two valleys, which finds the nearer one from these starts.

    ```
    >>> import jax.numpy as jnp
    >>> import nonholonomic
    >>> class Valleys(nonholonomic.AbstractMode):
    ...     damping: float
    ...
    ...     def field(self, t, y):
    ...         return jnp.array([y[1], y[0] - y[0] ** 3 - self.damping * y[1]])
    >>> system = nonholonomic.Hybrid([Valleys(1.0)])
    >>> axes = {"start[0]": [-1.2, -0.4, 0.3, 0.8, 1.1]}
    >>> table = nonholonomic.basins(system, [0.0, 0.0], t1=60.0, axes=axes, progress=False)
    >>> print(table.attractor, table.y0_min.round(3))
    [2 2 1 1 1] [-1. -1.  1.  1.  1.]

    ```
    """
    require_outside((system, start, t1, axes, input), "basins", "simulate")
    Bound(resolution, "resolution", above=0.0, below=1.0).require()
    model = model_of(system, start, None, input, jumps).without_event()
    check_horizon(t1, tolerance)
    is_scene = isinstance(model, AbstractSceneModel)
    if quantities is None and is_scene:
        raise ValueError(
            "quantities = None: name quantities of the scene that tell attractors apart, such as ['theta']"
        )
    names = model.names if quantities is None else quantities
    require_names(model.quantities, names)
    vectors = [name for name in names if model.quantities[name].components is not None]
    if vectors or not names:
        wrong = f": {vectors[0]!r} is a vector" if vectors else " = []"
        raise ValueError(f"quantities{wrong}; name scalar quantities")
    # Times in the golden ratio do not keep step with a drive.
    shares = np.sort(np.arange(SAMPLED) * 0.6180339887498949 % 1.0)
    times = 0.25 * float(t1) * (np.arange(4)[:, None] + shares).ravel()
    options = Options(tolerance, solver, max_steps, scattered, False, (), path, progress, executor)
    table = table_of(model, axes, t1, options, samples=Ranges(times, tuple(names)), timed=False)
    return dataclasses.replace(
        table,
        variables={"attractor": attractors_of(table, tuple(names), resolution, tolerance), **table.variables},
        units=table.units | {"attractor": "1"},
        long_names=table.long_names | {"attractor": "attractor (0: not settled, -1: run ended early)"},
    )


def attractors_of(table: Table, names: tuple[str, ...], resolution: float, tolerance: float) -> Int[np.ndarray, "..."]:
    """The number of the attractor of each cell."""
    # SciPy's trees are imported only here.
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components
    from scipy.spatial import KDTree

    completed = table.status == Status.COMPLETED.word
    has_settled = np.array(completed)
    rows: list[Float[np.ndarray, " cells"]] = []
    for name in names:
        least, greatest, change, whole = (np.asarray(table[f"{name}_{kind}"]) for kind in KINDS)
        if not completed.any():
            break
        low, high = np.quantile(least[completed], 0.01), np.quantile(greatest[completed], 0.99)
        # Errors of the integration are no differences, and all runs of a quantity that does not change have one value.
        errors = ERRORS * tolerance * max(abs(low), abs(high))
        step = max(resolution * (max(high - low, np.median(whole[completed])) or 1.0), errors)
        has_settled &= change <= step
        rows += [part / step for part in (least, greatest)]
    number = np.where(completed, 0, -1)
    if not has_settled.any():
        return number
    places = np.round(np.stack([row[has_settled] for row in rows], axis=-1))
    places, place = np.unique(places, axis=0, return_inverse=True)
    pairs = KDTree(places).query_pairs(1.5, p=np.inf, output_type="ndarray")
    near = coo_array((np.ones(len(pairs)), pairs.T), shape=(len(places), len(places)))
    _, group = connected_components(near, directed=False)
    groups = group[place.ravel()]
    by_size = np.argsort(-np.bincount(groups), kind="stable")
    number[has_settled] = 1 + np.argsort(by_size)[groups]
    return number
