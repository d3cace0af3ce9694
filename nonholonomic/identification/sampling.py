"""Draws from a posterior by the no-U-turn sampler of BlackJAX (the extra `bayes`), with few runs of the model.

Walks are taken in a surrogate whose predictions are polynomials, learned from runs where the posterior is. Where a walk ends is
proposed to the posterior itself, and accepted with the probability min(1, p(new) q(old) / (p(old) q(new))), p being the
posterior and q the surrogate. Because walks of the sampler satisfy detailed balance with respect to q, the draws are from p,
whatever q is like (surrogate transitions: J. S. Liu, Monte Carlo Strategies in Scientific Computing (2001), chapter 9; Christen
and Fox, J. Comput. Graph. Stat. 14 (2005) 795). A bad surrogate shows in the share of proposals that are accepted.

That is what event times ask for: they are rough on the scale of a nutation period, so slopes at a place say little of the next
one, and walks that follow them take hundreds of steps.
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

#: The share of accepted proposals that the length of the leaps is adapted to (Hoffman and Gelman, J. Mach. Learn. Res. 15
#: (2014) 1593), and how often a walk doubles at most.
ACCEPTED, DOUBLINGS = 0.8, 8

#: How many draws of the surrogate a walk consists of, so that its end has forgotten its beginning.
MOVES = 16

#: Powers of the surrogate in which it learns, and from which draws are proposed: a surrogate that falls off faster than the
#: posterior would never propose, and never leave, its tails.
LEARNING, PROPOSING = 0.35, 0.75

#: Learning ends with the round whose runs the polynomials foretold to this standard deviation of the log density, so that
#: nine tenths of the proposals would be accepted. Rounds are at least and at most so many.
FORETOLD, LEAST, ROUNDS = 0.3, 2, 6


class Draws(NamedTuple):
    """Draws from a posterior.

    - `values`: name -> (chains, draws); `coordinates`: (chains, draws, unknowns).
    - `r_hat`, `ess`: name -> number: the potential scale reduction, which should be below 1.01, and the effective number of
      independent draws.
    - `units`: name -> unit, of the unknown errors.
    - `accepted`: which share of the proposals was accepted; `runs`: how many sets of numbers the model was run for.
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
        """Draws at some coordinates, with their diagnostics."""
        from blackjax.diagnostics import effective_sample_size, potential_scale_reduction

        values = {name: np.asarray(value) for name, value in density.values(jnp.asarray(coordinates)).items()}
        draws = map(
            np.asarray, (measure(coordinates) for measure in (potential_scale_reduction, effective_sample_size))
        )
        # Of a single unknown they are numbers, not lists of one.
        named = (dict(zip(density.names, numbers.reshape(-1).tolist(), strict=True)) for numbers in draws)
        return cls(values, coordinates, *named, accepted=accepted, runs=runs, units=density.units)

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
    """Draw from a posterior, from where a fit has ended.

    **Arguments:**

    - `density`: a `LogDensity`.
    - `centre`, `covariance`: (unknowns,), (unknowns, unknowns), of a fit in its coordinates: `Identification.coordinates` and
      `coordinate_covariance`. Unknown errors, which are not among the unknowns of a fit, start from their first guess.
    - `chains`, `warmup`, `draws`: how many chains, at least 2, which R-hat compares; and draws of each, before those that are
      kept and of those, at least 2. The chains start from draws of the surrogate.
    - `seed`: of the draw; `progress`: whether to show it, on a terminal or in a notebook.

    **Returns:** `Draws`.

    **Raises:** `ValueError` for numbers out of range and a covariance that is not finite and positive; `ModuleNotFoundError`
    without BlackJAX.
    """
    require_package("blackjax", "bayes", "sample")
    for name, value, least in (("chains", chains, 2), ("warmup", warmup, 0), ("draws", draws, 2), ("seed", seed, 0)):
        require_whole(value, name, least)
    require_flag(progress, "progress")
    random = np.random.default_rng(seed)
    kept, accepted = [], 0.0
    with Progress(warmup + draws, "step", shown=progress) as shown:
        surrogate, walk, runs = learn(Surrogate.around(density, centre, covariance), chains, random)
        surrogate = surrogate.to_power(PROPOSING)
        at, log_density = _seen(surrogate, walk.points)
        shown.begin()
        for step in range(warmup + draws):
            ahead = _walked(surrogate, _key(random), walk, jnp.asarray(False))
            tried, proposed_log_density = _seen(surrogate, ahead.points)
            taken = np.log(random.uniform(size=chains)) < proposed_log_density - log_density
            at, log_density = np.where(taken[:, None], tried, at), np.where(taken, proposed_log_density, log_density)
            walk = walk._replace(points=jnp.where(taken[:, None], ahead.points, walk.points))
            if step >= warmup:
                accepted += float(np.mean(taken)) / draws
                kept.append(at)
            shown.advance(1)
    with status_line("diagnosing the draws", progress):
        return Draws.of(density, np.stack(kept, axis=1), accepted, runs + chains * (warmup + draws + 1))


class Walk(NamedTuple):
    """Where the chains are in a surrogate, and the state of the adaptation of their leaps."""

    points: Float[Array, "chains unknowns"]
    adaptation: Any


def learn(surrogate: Surrogate, chains: int, random: np.random.Generator) -> tuple[Surrogate, Walk, int]:
    """Let a surrogate learn from runs where its own draws are.

    The first runs are drawn from the fit's error ellipse.

    **Returns:** the surrogate, a `Walk` in it whose leaps suit it, and how many runs it took.
    """
    from blackjax.adaptation.step_size import dual_averaging_adaptation

    surrogate, density, runs = surrogate.to_power(LEARNING), surrogate.density, surrogate.runs_a_round
    begin = dual_averaging_adaptation(ACCEPTED)[0]
    points = random.normal(size=(runs, len(surrogate.centre)))
    drawn, pool = np.asarray(surrogate.at(jnp.asarray(points))), []
    for turn in range(ROUNDS):
        chosen = random.permutation(drawn)[:runs]
        predicted = np.asarray(_predicted(density, chosen))
        true = np.asarray(_log_density(density, chosen, predicted))
        if turn >= LEAST and np.std(true - _log_density(density, chosen, _foretold(surrogate, chosen))) < FORETOLD:
            break
        pool.append((chosen, predicted, true))
        surrogate = surrogate.learned(*(np.concatenate(parts) for parts in zip(*pool, strict=True)))
        if turn > 0:
            surrogate, points = surrogate.among(drawn)
        # As arrays: a Python number in it would be compiled in.
        adaptation = jax.tree.map(np.asarray, begin(1.0 / len(surrogate.centre) ** 0.25))
        walk, path = Walk(jnp.asarray(points[-chains:]), adaptation), []
        for _ in range(-(-2 * runs // chains)):
            walk = _walked(surrogate, _key(random), walk, jnp.asarray(True))
            path.append(np.asarray(surrogate.at(walk.points)))
        # The first half is on its way.
        drawn = np.concatenate(path[len(path) // 2 :])
    return surrogate, walk, runs * (1 + turn)


def _key(random: np.random.Generator) -> Array:
    """A key for JAX's random numbers."""
    return jax.random.key(int(random.integers(2**31)))


def _seen(
    surrogate: Surrogate, points: Float[Array, "chains unknowns"]
) -> tuple[Float[np.ndarray, "chains unknowns"], Float[np.ndarray, " chains"]]:
    """The coordinates of some points, and there the log of the posterior over what the surrogate proposes from."""
    density, coordinates = surrogate.density, np.asarray(surrogate.at(points))
    true = _log_density(density, coordinates, _predicted(density, coordinates))
    foretold = _log_density(density, coordinates, _foretold(surrogate, coordinates))
    return coordinates, np.asarray(true - surrogate.power * foretold)


# Compiled functions take NumPy's arrays too.
_predicted: Callable[..., Array] = eqx.filter_jit(LogDensity.predict)
_foretold: Callable[..., Array] = eqx.filter_jit(Surrogate.predict)


@eqx.filter_jit
def _log_density(
    density: LogDensity,
    coordinates: Float[Array | np.ndarray, "rows unknowns"],
    predictions: Float[Array | np.ndarray, "rows n"],
) -> Float[Array, " rows"]:
    """The log density of every row, given what is predicted there."""
    of_row: Callable[..., Array] = density.of_prediction
    return jax.vmap(of_row)(coordinates, predictions)


@eqx.filter_jit
def _walked(surrogate: Surrogate, key: Array, walk: Walk, adapting: Bool[Array, ""]) -> Walk:
    """Where all chains are some draws later; with leaps that are adapted on the way, or as they have settled."""
    import blackjax
    from blackjax.adaptation.step_size import dual_averaging_adaptation

    kernel, round_mass = blackjax.nuts.build_kernel(), jnp.ones(len(surrogate.centre))
    adapted = dual_averaging_adaptation(ACCEPTED)[1]

    def move(walk: Walk, key: Array) -> tuple[Walk, None]:
        state = walk.adaptation
        length = jnp.exp(jnp.where(adapting, state.log_step_size, state.log_step_size_avg))

        def step(key: Array, point: Float[Array, " unknowns"]) -> tuple[Array, Array]:
            begun = blackjax.nuts.init(point, surrogate)
            ended, info = kernel(key, begun, surrogate, length, round_mass, max_num_doublings=DOUBLINGS)
            return ended.position, info.acceptance_rate

        points, accepted = jax.vmap(step)(jax.random.split(key, len(walk.points)), walk.points)
        new = adapted(state, jnp.mean(accepted))
        return Walk(points, jax.tree.map(lambda new, old: jnp.where(adapting, new, old), new, state)), None

    return jax.lax.scan(move, walk, jax.random.split(key, MOVES))[0]
