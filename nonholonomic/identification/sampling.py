"""Draw from a posterior by the no-U-turn sampler of BlackJAX (the extra `bayes`), with few runs of the model.

The sampler walks in a surrogate whose predictions are polynomials, fitted to runs in the region of the posterior. The
end of each walk is proposed to the posterior itself, and accepted with the probability min(1, p(new) q(old) / (p(old)
q(new))), where p is the posterior and q the surrogate. Because walks of the sampler satisfy detailed balance with
respect to q, the draws are from p, whatever q is (surrogate transitions: J. S. Liu, Monte Carlo Strategies in
Scientific Computing (2001), chapter 9; Christen and Fox, J. Comput. Graph. Stat. 14 (2005) 795). A bad surrogate lowers
the fraction of accepted proposals.

Event times need this method: they vary irregularly on the scale of a nutation period, so the slope at one point says
little about the next point, and walks that follow slopes take hundreds of steps.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from ..parameters import readable_unit
from ..progress import Progress, status_line
from ..validation import require_flag, require_package, require_whole
from .posterior import LogDensity
from .surrogate import Surrogate

#: Target fraction of accepted proposals, to which the length of the leaps is adapted (Hoffman and Gelman, J. Mach.
#: Learn. Res. 15 (2014) 1593), and the largest number of doublings of a walk.
ACCEPTED, DOUBLINGS = 0.8, 8

#: Number of draws of the surrogate in a walk, enough for its end to be independent of its start.
MOVES = 16

#: Powers of the surrogate for learning and for proposals: a surrogate that decreases faster than the posterior would
#: never propose points in the tails of the posterior, and a chain would never leave them.
LEARNING, PROPOSING = 0.35, 0.75

#: Learning ends when the polynomials predict the log density of a round's runs with this standard deviation, at which
#: nine tenths of the proposals are accepted; and the least and greatest number of rounds.
PREDICTED, LEAST, ROUNDS = 0.3, 2, 6


class Draws(NamedTuple):
    """Draws from a posterior.

    - `values`: name -> (chains, draws); `coordinates`: (chains, draws, unknowns).
    - `r_hat`, `ess`: name -> number: the potential scale reduction, which should be below 1.01, and the effective number of
      independent draws.
    - `units`: name -> unit, of the unknown errors.
    - `accepted`: fraction of accepted proposals; `runs`: number of parameter sets for which the model ran.

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

    @classmethod
    def of(
        cls, density: LogDensity, coordinates: Float[np.ndarray, "chains draws unknowns"], accepted: float, runs: int
    ) -> "Draws":
        """Draws at given coordinates, with diagnostics."""
        values = {name: np.asarray(value) for name, value in density.values(jnp.asarray(coordinates)).items()}
        draws = map(np.asarray, _diagnosed(coordinates))
        # For a single unknown, these are numbers instead of lists.
        draws_by_name = (dict(zip(density.names, numbers.reshape(-1).tolist(), strict=True)) for numbers in draws)
        return cls(values, coordinates, *draws_by_name, accepted=accepted, runs=runs, units=density.units)

    def __str__(self) -> str:
        width = max(map(len, self.values))
        chains, draws = next(iter(self.values.values())).shape
        lines = [f"{chains} chains of {draws} draws, {100.0 * self.accepted:.0f} % accepted, {self.runs} runs"]
        for name, value in self.values.items():
            low, middle, high = np.quantile(value, (0.025, 0.5, 0.975))
            quality = f"R-hat {self.r_hat[name]:.4f}, ESS {self.ess[name]:.0f}"
            unit = f" {readable_unit(self.units[name])}" if name in self.units else ""
            lines.append(f"  {name:{width}}  {middle:.6g}  ({low:.6g}, {high:.6g}){unit}  {quality}")
        return "\n".join(lines)


def sample(
    density: LogDensity,
    centre: Any,
    covariance: Any,
    *,
    chains: int = 4,
    warmup: int = 25,
    draws: int = 500,
    seed: int = 0,
    progress: bool = True,
) -> Draws:
    """Draw from a posterior, starting from the end of a fit.

    **Arguments:**

    - `density`: a `LogDensity`.
    - `centre`, `covariance`: (unknowns,), (unknowns, unknowns), the `coordinates` and `coordinate_covariance` of an
      `Identification`. Unknown errors, which are not among the unknowns of a fit, start from their first guess.
    - `chains`: number of chains, at least 2, because R-hat compares chains; `warmup`, `draws`: number of draws of each
      chain to discard and to keep, the latter at least 2. The chains start from draws of the surrogate.
    - `seed`: seed of the draws; `progress`: whether to show progress, on a terminal or in a notebook.

    **Returns:** `Draws`.

    **Raises:** `ValueError` for numbers out of range and a covariance that is not finite and positive; `ModuleNotFoundError`
    without BlackJAX.

    **Example:** the posterior of the subpackage's example.

    >>> from nonholonomic.identification import LogDensity, sample
    >>> density = LogDensity.of(Model(scene, data, jnp.arange(3)), data[0].measurements, free)
    >>> draws = sample(density, fit.coordinates, fit.coordinate_covariance, draws=200, progress=False)
    >>> print(f"{draws.values['scene.rate'].mean():.2f}")
    1.00
    """
    require_package("blackjax", "bayes", "sample")
    for name, value, lower in (("chains", chains, 2), ("warmup", warmup, 0), ("draws", draws, 2), ("seed", seed, 0)):
        require_whole(value, name, lower)
    require_flag(progress, "progress")
    random = np.random.default_rng(seed)
    samples, accepted = [], 0.0
    with Progress(warmup + draws, "step", shown=progress) as display:
        surrogate, walk, runs = learn(Surrogate.around(density, centre, covariance), chains, random)
        surrogate = surrogate.to_power(PROPOSING)
        coordinates, log_density = _with_ratio(surrogate, walk.points)
        display.begin()
        for step in range(warmup + draws):
            proposal = _walked(surrogate, _key(random), walk, jnp.asarray(False))
            proposed, proposed_log_density = _with_ratio(surrogate, proposal.points)
            accept = np.log(random.uniform(size=chains)) < proposed_log_density - log_density
            coordinates, log_density = (
                np.where(accept[:, None], proposed, coordinates),
                np.where(accept, proposed_log_density, log_density),
            )
            walk = walk._replace(points=jnp.where(accept[:, None], proposal.points, walk.points))
            if step >= warmup:
                accepted += float(np.mean(accept)) / draws
                samples.append(coordinates)
            display.advance(1)
    with status_line("diagnosing the draws", progress):
        return Draws.of(density, np.stack(samples, axis=1), accepted, runs + chains * (warmup + draws + 1))


class Walk(NamedTuple):
    """The positions of the chains in a surrogate, and the state of the adaptation of their leaps."""

    points: Float[Array, "chains unknowns"]
    adaptation: Any


def learn(surrogate: Surrogate, chains: int, random: np.random.Generator) -> tuple[Surrogate, Walk, int]:
    """Fit a surrogate to runs at its own draws, in several rounds.

    The first runs are drawn from the fit's error ellipse.

    **Returns:** the surrogate, a `Walk` in it with adapted leaps, and the number of runs.
    """
    from blackjax.adaptation.step_size import dual_averaging_adaptation

    surrogate, density, runs = surrogate.to_power(LEARNING), surrogate.density, surrogate.runs_a_round
    adaptation_init = dual_averaging_adaptation(ACCEPTED)[0]
    points = random.normal(size=(runs, len(surrogate.centre)))
    points_drawn, pool = np.asarray(_at(surrogate, points)), []
    for turn in range(ROUNDS):
        selection = random.permutation(points_drawn)[:runs]
        predicted = np.asarray(_predicted(density, selection))
        exact = np.asarray(_log_density(density, selection, predicted))
        if (
            turn >= LEAST
            and np.std(exact - _log_density(density, selection, _surrogate_predicted(surrogate, selection))) < PREDICTED
        ):
            break
        pool.append((selection, predicted, exact))
        surrogate = surrogate.learned(*(np.concatenate(parts) for parts in zip(*pool, strict=True)))
        if turn > 0:
            surrogate, points = surrogate.recentred(points_drawn)
        # Convert to arrays, because a Python number would become a constant of the program.
        adaptation = jax.tree.map(np.asarray, adaptation_init(1.0 / len(surrogate.centre) ** 0.25))
        walk, path = Walk(jnp.asarray(points[-chains:]), adaptation), []
        for _ in range(-(-2 * runs // chains)):
            walk = _walked(surrogate, _key(random), walk, jnp.asarray(True))
            path.append(np.asarray(_at(surrogate, walk.points)))
        # Discard the first half as warm-up.
        points_drawn = np.concatenate(path[len(path) // 2 :])
    return surrogate, walk, runs * (1 + turn)


def _key(random: np.random.Generator) -> Array:
    """A key for JAX's random numbers."""
    return jax.random.key(int(random.integers(2**31)))


def _with_ratio(
    surrogate: Surrogate, points: Float[Array, "chains unknowns"]
) -> tuple[Float[np.ndarray, "chains unknowns"], Float[np.ndarray, " chains"]]:
    """The coordinates of some points, and the log ratio of the posterior to the surrogate's proposal density there."""
    density, coordinates = surrogate.density, np.asarray(_at(surrogate, points))
    exact = _log_density(density, coordinates, _predicted(density, coordinates))
    surrogate_value = _log_density(density, coordinates, _surrogate_predicted(surrogate, coordinates))
    return coordinates, np.asarray(exact - surrogate.power * surrogate_value)


# Compiled functions also accept NumPy arrays.
_predicted: Callable[..., Array] = eqx.filter_jit(LogDensity.predict)
_surrogate_predicted: Callable[..., Array] = eqx.filter_jit(Surrogate.predict)
_at: Callable[..., Array] = eqx.filter_jit(Surrogate.at)


@jax.jit
def _diagnosed(coordinates: Float[Array | np.ndarray, "chains draws unknowns"]) -> tuple[Array, Array]:
    """The potential scale reduction and the effective sample size of every unknown."""
    from blackjax.diagnostics import effective_sample_size, potential_scale_reduction

    return potential_scale_reduction(coordinates), effective_sample_size(coordinates)


@eqx.filter_jit
def _log_density(
    density: LogDensity,
    coordinates: Float[Array | np.ndarray, "rows unknowns"],
    predictions: Float[Array | np.ndarray, "rows n"],
) -> Float[Array, " rows"]:
    """The log density of every row, for given predictions."""
    of_row: Callable[..., Array] = density.of_prediction
    return jax.vmap(of_row)(coordinates, predictions)


@eqx.filter_jit
def _walked(surrogate: Surrogate, key: Array, walk: Walk, adapting: Bool[Array, ""]) -> Walk:
    """All chains after some draws; the leaps are adapted on the way, or keep their settled length."""
    import blackjax
    from blackjax.adaptation.step_size import dual_averaging_adaptation

    kernel, round_mass = blackjax.nuts.build_kernel(), jnp.ones(len(surrogate.centre))
    adapted = dual_averaging_adaptation(ACCEPTED)[1]

    def move(walk: Walk, key: Array) -> tuple[Walk, None]:
        state = walk.adaptation
        length = jnp.exp(jnp.where(adapting, state.log_step_size, state.log_step_size_avg))

        def step(key: Array, point: Float[Array, " unknowns"]) -> tuple[Array, Array]:
            initial = blackjax.nuts.init(point, surrogate)
            ended, info = kernel(key, initial, surrogate, length, round_mass, max_num_doublings=DOUBLINGS)
            return ended.position, info.acceptance_rate

        points, accepted = jax.vmap(step)(jax.random.split(key, len(walk.points)), walk.points)
        new = adapted(state, jnp.mean(accepted))
        return Walk(points, jax.tree.map(lambda new, old: jnp.where(adapting, new, old), new, state)), None

    return jax.lax.scan(move, walk, jax.random.split(key, MOVES))[0]
