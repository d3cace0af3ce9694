"""Search for all minima of a likelihood, and draw from the posterior.

The exploration of the posterior (`exploration.py`) leaves a mixture of heavy-tailed distributions around all its minima. Each
chain begins at one of the weighted points of the exploration, proposes draws of the mixture, and accepts them by Metropolis
and Hastings' rule, so that its draws come from the posterior itself, whatever the mixture is. Because proposals do not depend
on the chains, the runs of all chains and draws are computed together; a mixture that misses a part of the posterior shows in
few accepted proposals, and in R-hat and ESS (Tierney, Ann. Stat. 22 (1994) 1701).
"""

import dataclasses
from concurrent.futures import ThreadPoolExecutor
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..parameters import ByName
from ..terminal import status_line
from ..text import readable_unit, shown
from ..validation import require_flag, require_package, require_whole, warn
from .conclusions import FitWarning
from .exploration import ROWS, Explorer, Mixture, Weighted, draw_errors
from .least_squares import BETWEEN, Minima, Refinement, refine
from .likelihood import Free, whole_periods
from .posterior import LogDensity, Problem, compile_slopes, deviances, predictions
from .recording import AbstractRecording

# The search for all minima of a likelihood, and the exploration of its surroundings.

#: Greatest number of steps by slopes before an exploration, where predictions may be a staircase.
FEW_STEPS = 6

#: Samples that are farther apart [s] may have times in milliseconds: if the best of this many candidates leaves less than this
#: part of the scatter. Events may be within this factor of a thousandth of their times.
SPARSE, FEW_CANDIDATES, EXPLAINED, UNIT_FACTOR = 1.0, 64, 0.25, 3.0

#: Number of minima that are refined to the end after an exploration.
LAST = 4

#: Points of the exploration that are better than all minima by more than this in -2 log likelihood are refined, too.
IMPROVED = 0.1


def search(
    explorer: Explorer, starts: int, max_steps: int, seed: int, progress: bool
) -> tuple[Explorer, Minima, Weighted]:
    """Compare candidates, refine the best, and explore the likelihood around all minima; or explore first, where steps by
    differences cost more. **Arguments:** as for `identify`.

    **Returns:** the explorer, which knows the unknowns that do not act; the minima; and the explored sample.

    **Raises:** `ValueError` if no candidate has a finite prediction, and for times in milliseconds.
    """
    problem, measurements = explorer.density.problem, explorer.density.measurements
    with ThreadPoolExecutor(1) as thread:
        # Compile the slopes while this thread compiles and computes the predictions.
        thread.submit(compile_slopes, problem)
        _refuse_milliseconds(explorer)
        pool = explorer.begin(seed)
    if not np.any(np.isfinite(pool.predictions)):
        raise ValueError(
            "no start led to finite predictions: simulate a run with the start values of `free` to see whether it fails; an "
            "event must happen before t1, and its function falls through zero"
        )
    acts = explorer.acting(pool)
    if not np.all(acts):
        names = ", ".join(name for name, has_effect in zip(problem.names, acts, strict=True) if not has_effect)
        warn(
            f"no prediction depends on {names}, so the data say nothing about it: fix it, or add other data", FitWarning
        )
    problem = eqx.tree_at(lambda problem: problem.acts, problem, acts)
    explorer = explorer._replace(density=eqx.tree_at(lambda density: density.problem, explorer.density, problem))
    recorded = bool(np.any(np.asarray(measurements.time) > 0.0))
    if recorded and problem.step is not None:
        # A step by differences takes as long as a round of the exploration, which also finds the minima.
        sample = explorer.explore(pool, None, progress)
        best = sample.pool.points[sample.pool.most_probable(starts)]
        last = np.arange(starts) < LAST
        return explorer, refine(problem, best, measurements, Refinement(max_steps, progress, rows=last)), sample
    steps = max_steps if recorded else min(max_steps, FEW_STEPS)
    minima = refine(problem, pool.candidates(starts), measurements, Refinement(steps, progress, in_parts=recorded))
    if recorded:
        between = Refinement(min(max_steps, BETWEEN), progress)
        around = refine(problem, minima.between(), minima.measurements, between)
        minima = minima.joined(around)
    # Along a direction without any slope, the likelihood has no end that an exploration could find.
    has_end = bool(np.all(np.isfinite(minima.covariance(minima.best))))
    sample = explorer.explore(pool, minima.components, progress) if has_end else Weighted.of(pool)
    return explorer, _improved(problem, minima, sample, max_steps, progress), sample


def _refuse_milliseconds(explorer: Explorer) -> None:
    """Raise `ValueError` if the times of the data seem to be in milliseconds: if the events happen at a thousandth of their
    times, or if the samples are far apart and some candidate explains them at a thousandth of their times, where the motion
    has hardly begun if they are in seconds.
    """
    problem, measurements = explorer.density.problem, explorer.density.measurements
    data = getattr(problem.model, "recorded", ())
    if not data:
        return
    recorded = [isinstance(source, AbstractRecording) for source in data]
    is_sample = np.repeat(recorded, [len(source.seen) for source in data])
    value, error, series = map(np.asarray, (measurements.value, measurements.error, measurements.series))
    points = explorer.region.points(FEW_CANDIDATES, 0)
    is_event = ~is_sample & ~np.asarray(measurements.censored)
    if np.any(is_event):
        ratio = np.median(value[is_event] / predictions(problem, points[:1])[0, is_event])
        if 1e3 / UNIT_FACTOR < ratio < 1e3 * UNIT_FACTOR:
            raise ValueError(
                f"time: the events are measured {ratio:.0f} times later than at the start values; times are in seconds: did "
                "you mean 1e-3 * time? Otherwise start closer"
            )
    recordings = [source for source in data if isinstance(source, AbstractRecording)]
    if min((np.median(np.diff(source.times)) for source in recordings if len(source.times) > 2), default=0.0) < SPARSE:
        return
    shorter = tuple(
        dataclasses.replace(source, times=1e-3 * source.times, t0=1e-3 * source.t0) if is_recorded else source
        for source, is_recorded in zip(data, recorded, strict=True)
    )
    model = problem.model.with_recorded(shorter)
    off = predictions(eqx.tree_at(lambda problem: problem.model, problem, model), points) - value
    off = off - whole_periods(np, off, np.asarray(measurements.period))
    least = np.min(np.sum((off / error)[:, is_sample] ** 2, axis=1))
    parts = [(value / error)[is_sample & (series == number)] for number in np.unique(series[is_sample])]
    if least < EXPLAINED * sum(part.size * np.var(part) for part in parts):
        raise ValueError(
            "times: the model explains the samples at 1e-3 * times; times are in seconds: did you mean 1e-3 * times? "
            "Otherwise start closer"
        )


def _improved(problem: Problem, minima: Minima, sample: Weighted, max_steps: int, progress: bool) -> Minima:
    """The minima, the best of them refined to the end; from the best points of the exploration if these are better."""
    rows, pool = len(minima.starts), sample.pool
    order = pool.most_probable(rows)
    best = pool.points[order]
    deviance = deviances(problem, best, pool.predictions[order], minima.measurements)
    if np.min(deviance) < np.min(minima.deviance) - IMPROVED:
        few = Refinement(min(max_steps, FEW_STEPS), progress, rows=np.arange(rows) < LAST)
        later = refine(problem, best, minima.measurements, few)
        return later if np.min(later.deviance) < np.min(minima.deviance) else minima
    if minima.converged[minima.best]:
        return minima
    last = np.isin(np.arange(rows), np.argsort(minima.deviance)[:LAST])
    later = refine(problem, minima.coordinates, minima.measurements, Refinement(max_steps, progress, rows=last))
    return later._replace(starts=minima.starts, converged=minima.converged | later.converged)


#: Number of proposals for each draw.
MOVES = 2

#: Options of the search: range, refined candidates, and their steps.
SPREAD, STARTS, STEPS = 2.0, 16, 60

#: Draws are from a posterior only if at least this fraction of the proposals is accepted, and if every unknown has at least
#: this many effective draws for each chain.
LEAST_ACCEPTED, LEAST_ESS = 0.02, 50.0

#: Draws are far less probable than the start if its log density exceeds their median by more than this and 1 for each unknown;
#: the most probable point exceeds the median of a normal distribution by about 0.5 for each unknown.
FAR_BELOW = 10.0


class Draws(NamedTuple):
    """Draws from a posterior.

    - `values`: name -> (chains, draws), where the end of a name is enough; `coordinates`: (chains, draws, unknowns).
    - `r_hat`, `ess`: name -> number: the potential scale reduction, which should be below 1.01, and the effective number of
      independent draws.
    - `units`: name -> unit, of the unknown errors.
    - `accepted`: fraction of accepted proposals; `runs`: number of parameter sets for which the model ran.
    - `flaws`: why the draws are not from the posterior, in words; empty if they are, as `good` says. `concerns`: what else to
      check.

    **Example:** as for `sample`.

    >>> from nonholonomic.identification import Draws
    >>> Draws._fields[:3]
    ('values', 'coordinates', 'r_hat')
    """

    values: dict[str, Float[np.ndarray, "chains draws"]]
    coordinates: Float[np.ndarray, "chains draws unknowns"]
    r_hat: dict[str, float]
    ess: dict[str, float]
    accepted: float
    runs: int
    units: dict[str, str]
    flaws: tuple[str, ...] = ()
    concerns: tuple[str, ...] = ()

    @property
    def good(self) -> bool:
        """Whether the draws can be used as those of a posterior."""
        return not self.flaws

    @classmethod
    def of(
        cls,
        density: LogDensity,
        coordinates: Float[np.ndarray, "chains draws unknowns"],
        accepted: float,
        runs: int,
        excess: float = 0.0,
    ) -> "Draws":
        """Draws at given coordinates, with diagnostics. **Arguments:** `excess`: of the log density at the start over the
        median of the draws."""
        values = ByName((name, np.asarray(value)) for name, value in density.values(jnp.asarray(coordinates)).items())
        draws = map(np.asarray, _diagnosed(coordinates))
        # For a single unknown, these are numbers instead of lists.
        draws_by_name = (ByName(zip(density.names, numbers.reshape(-1).tolist(), strict=True)) for numbers in draws)
        r_hat, ess = draws_by_name
        flaws, concerns = _judged(ess, len(coordinates), accepted), ()
        if excess > FAR_BELOW + len(ess):
            concerns = (
                f"the start is more probable than the draws, by a factor of exp({excess:.4g}): the search missed its "
                "surroundings; start closer, state priors or bounds, or pass the coordinates of a fit",
            )
        return cls(values, coordinates, r_hat, ess, accepted, runs, density.units, flaws, concerns)

    def __str__(self) -> str:
        width = max(map(len, self.values))
        chains, draws = next(iter(self.values.values())).shape
        lines = [f"{chains} chains of {draws} draws, {100.0 * self.accepted:.0f} % accepted, {self.runs} runs"]
        for name, value in self.values.items():
            low, middle, high = np.quantile(value, (0.025, 0.5, 0.975))
            interval = f"{middle:.6g}  ({low:.6g}, {high:.6g})" if self.good else "no interval"
            quality = f"R-hat {self.r_hat[name]:.4f}, ESS {self.ess[name]:.0f}"
            unit = f" {readable_unit(self.units[name])}" if name in self.units else ""
            lines.append(f"  {name:{width}}  {interval}{unit}  {quality}")
        lines += [f"  NO POSTERIOR: {flaw}" for flaw in self.flaws] + [f"  BUT {concern}" for concern in self.concerns]
        return "\n".join(lines)


def sample(
    density: LogDensity,
    centre: Any = None,
    covariance: Any = None,
    *,
    chains: int = 4,
    warmup: int = 25,
    draws: int = 500,
    seed: int = 0,
    progress: bool = True,
) -> Draws:
    """Draw from a posterior, with all its minima.

    **Arguments:**

    - `density`: a `LogDensity`.
    - `centre`, `covariance`: (unknowns,), (unknowns, unknowns), the `coordinates` and `coordinate_covariance` of an
      `Identification`, which make the search faster; `None` without a fit.
    - `chains`: number of chains, at least 2, because R-hat compares chains; `warmup`, `draws`: number of draws of each
      chain that are discarded and kept; `seed`.
    - `progress`: whether to show progress, on a terminal or in a notebook.

    **Returns:** `Draws`. If hardly a proposal was accepted, or if an unknown has an ESS below 50 for each chain, these are not
    draws from the posterior: `draws.good` is false, `draws.flaws` says why, and a `FitWarning` is given, also for draws that
    are far less probable than the start.

    **Raises:** `ValueError` for arguments out of range, and `ModuleNotFoundError` without BlackJAX, whose diagnostics it uses.

    **Example:** the rate of the subpackage's example.

    >>> from nonholonomic.identification import sample
    >>> draws = sample(LogDensity.of(decay, measured, free), draws=200, progress=False)
    >>> print(f"{draws.values['rate'].mean():.2f}")
    1.00
    """
    require_package("blackjax", "bayes", "sample")
    for name, value, lower in (("chains", chains, 2), ("warmup", warmup, 0), ("draws", draws, 2), ("seed", seed, 0)):
        require_whole(value, name, lower)
    require_flag(progress, "progress")
    known = None if centre is None else _component(density, centre, covariance)
    with status_line("sampling", progress):
        sizes = (chains, MOVES * warmup, draws)
        coordinates, accepted, runs, excess = drawn(density, known, sizes, seed, progress)
    with status_line("diagnosing the draws", progress):
        posterior = Draws.of(density, coordinates, accepted, runs, excess)
    if words := (*(f"these are no draws from the posterior: {flaw}" for flaw in posterior.flaws), *posterior.concerns):
        warn("; ".join(words), FitWarning)
    return posterior


def _judged(ess: dict[str, float], chains: int, accepted: float) -> tuple[str, ...]:
    """Why draws are not from a posterior, in words."""
    name, least = min(ess.items(), key=lambda item: item[1] if item[1] > 0.0 else 0.0)
    flaws = []
    if accepted < LEAST_ACCEPTED:
        flaws.append(
            f"only {100.0 * accepted:.2g} % of the proposals were accepted: start closer, or state priors or bounds that "
            "contain the truth"
        )
    # The ESS of chains that never move is not a number.
    if not least >= LEAST_ESS * chains:
        flaws.append(
            f"the ESS of {name} is {least:.0f}, below {LEAST_ESS:.0f} for each of {chains} chains: ask for more draws"
        )
    return tuple(flaws)


def drawn(
    density: LogDensity, known: Mixture | None, sizes: tuple[int, int, int], seed: int, progress: bool
) -> tuple[Float[np.ndarray, "chains draws unknowns"], float, int, float]:
    """Coordinates of draws, the fraction of accepted proposals, the number of runs, and the excess of the log density at the
    start over the median of the draws.

    **Arguments:** `known`: a component around a fit, or `None`; `sizes`: numbers of chains, of steps before the first
    draw, and of draws; the others as for `sample`.
    """
    chains, discarded, draws = sizes
    explorer, random = explorer_of(density, seed), np.random.default_rng(seed)
    explorer, minima, explored = search(explorer, STARTS, STEPS, seed, progress)
    components = minima.components
    if known is not None:
        components = known if components is None else components.joined(known, 0.5)
    proposal = explorer.proposal(explored.pool, components)
    steps = discarded + MOVES * draws
    first = explored.pool.points[random.choice(explored.runs, chains, p=explored.weights)]
    start = np.asarray(density.start)[None, : len(density.problem.names)]
    points = np.concatenate([first, proposal.draw(chains * steps, random)])
    predictions, log_density = _runs(explorer, np.concatenate([points, start]))
    order = random.permutation(np.arange(chains, len(points))).reshape(steps, chains)
    path, accepted = _chains(order, log_density[:-1] - proposal.log_density(points), chains, random)
    kept = path[discarded + MOVES - 1 :: MOVES].T.reshape(-1)
    errors = draw_errors(density.measurements, predictions[kept], random)
    coordinates = np.concatenate([points[kept], errors], axis=1).reshape(chains, draws, -1)
    excess = float(log_density[-1] - np.median(log_density[kept]))
    return coordinates, accepted, explored.runs + len(points), excess


def explorer_of(density: LogDensity, seed: int) -> Explorer:
    """An explorer of a posterior, in the region around its start."""
    free = {}
    for name, unknown in density.problem.free:
        prior = density.priors.get(name)
        gaussian = None if prior is None or callable(prior) else (float(prior[0]), float(prior[1]))
        start, lower, upper = (float(number) for number in (unknown.start, unknown.lower, unknown.upper))
        free[name] = Free(start, lower, upper, gaussian)
    return Explorer.of(density, free, SPREAD, seed)


def _component(density: LogDensity, centre: Any, covariance: Any) -> Mixture:
    """A component around a fit.

    **Raises:** `ValueError` for arrays of another shape, and for a covariance that is not finite.
    """
    numbers, covariance = len(density.problem.names), np.asarray(covariance, float)
    if covariance.shape != (numbers, numbers) or not np.all(np.isfinite(covariance)):
        raise ValueError(
            f"covariance must be finite and of shape {(numbers, numbers)}: the data do not determine all numbers"
        )
    if np.shape(centre) != (numbers,):
        raise ValueError(f"centre = {shown(centre)} must be of shape {(numbers,)}")
    return Mixture(np.ones(1), np.asarray(centre, float)[None], np.linalg.cholesky(covariance)[None])


def _runs(explorer: Explorer, points: Float[np.ndarray, "n unknowns"]) -> tuple[np.ndarray, np.ndarray]:
    """Predictions and log densities of all points, in batches."""
    parts = [explorer.evaluated(points[first : first + ROWS]) for first in range(0, len(points), ROWS)]
    return np.concatenate([part[0] for part in parts]), np.concatenate([part[3] for part in parts])


def _chains(
    order: np.ndarray, ratios: Float[np.ndarray, " points"], chains: int, random: np.random.Generator
) -> tuple[np.ndarray, float]:
    """The index of the point of every chain after each step, (steps, chains), and the fraction of accepted proposals.

    The first points are those at which the chains begin.
    """
    state, path, accepted = np.arange(chains), np.empty(order.shape, int), 0.0
    ratios = np.where(np.isfinite(ratios), ratios, -np.inf)
    for step, proposed in enumerate(order):
        accept = np.log(random.uniform(size=chains)) < ratios[proposed] - ratios[state]
        state = np.where(accept, proposed, state)
        path[step] = state
        accepted += float(np.mean(accept)) / len(order)
    return path, accepted


@jax.jit
def _diagnosed(coordinates: Float[Array | np.ndarray, "chains draws unknowns"]) -> tuple[Array, Array]:
    """The potential scale reduction and the effective sample size of every unknown."""
    from blackjax.diagnostics import effective_sample_size, potential_scale_reduction

    return potential_scale_reduction(coordinates), effective_sample_size(coordinates)
