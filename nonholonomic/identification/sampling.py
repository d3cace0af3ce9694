"""Draws from a posterior by the no-U-turn sampler of BlackJAX (the extra `bayes`)."""

import math
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..progress import Progress
from .posterior import LogDensity

#: The share of accepted proposals that the length of the leaps is adapted to (Hoffman and Gelman, J. Mach. Learn. Res. 15
#: (2014) 1593).
ACCEPTED = 0.8

#: How far the chains start from one another, in standard errors of the fit.
DISPERSED = 1.5


class Draws(NamedTuple):
    """Draws from a posterior.

    - `values`: name -> (chains, draws); `coordinates`: (chains, draws, unknowns).
    - `r_hat`, `ess`: name -> number: the potential scale reduction, which should be below 1.01, and the effective number of
      independent draws.
    - `divergences`: how many trajectories left the region in which the density can be followed.
    - `leaps`: how many times the density and its gradient were evaluated, by every chain.
    """

    values: dict[str, Float[np.ndarray, "chains draws"]]
    coordinates: Float[np.ndarray, "chains draws unknowns"]
    r_hat: dict[str, float]
    ess: dict[str, float]
    divergences: int
    leaps: int

    def __str__(self) -> str:
        width = max(map(len, self.values))
        chains, draws = next(iter(self.values.values())).shape
        lines = [f"{chains} chains of {draws} draws, {self.divergences} divergences, {self.leaps} leaps"]
        for name, value in self.values.items():
            low, middle, high = np.quantile(value, (0.025, 0.5, 0.975))
            quality = f"R-hat {self.r_hat[name]:.4f}, ESS {self.ess[name]:.0f}"
            lines.append(f"  {name:{width}}  {middle:.6g}  ({low:.6g}, {high:.6g})  {quality}")
        return "\n".join(lines)


def sample(
    density: LogDensity,
    centre: Any,
    covariance: Any,
    *,
    chains: int = 4,
    warmup: int = 100,
    draws: int = 250,
    seed: int = 0,
    progress: bool = True,
) -> Draws:
    """Draw from a posterior, from where a fit has ended.

    The coordinates are measured in the fit's standard errors along its own directions, so that the density is nearly round and
    needs no adaptation but of the length of the leaps; all chains advance together.

    **Arguments:**

    - `density`: a `LogDensity`.
    - `centre`, `covariance`: (unknowns,), (unknowns, unknowns), of a fit in its coordinates: `Identification.coordinates` and
      `coordinate_covariance`. Unknown errors, which are not among the unknowns of a fit, start from their first guess.
    - `chains`, `warmup`, `draws`: how many chains, and steps of each before those that are kept.
    - `seed`: of the draw; `progress`: whether to show it, on a terminal or in a notebook.

    **Returns:** `Draws`.

    **Raises:** `ValueError` for a covariance that is not finite and positive; `ImportError` without BlackJAX.
    """
    import blackjax
    from blackjax.adaptation.step_size import dual_averaging_adaptation

    centre, root = _whole(density, centre, covariance)
    kernel = blackjax.nuts.build_kernel()
    inverse_mass = jnp.ones(len(centre))

    def round_density(point: Float[Array, " unknowns"]) -> Float[Array, ""]:
        return density(centre + root @ point)

    @jax.jit
    def advance(keys: Array, states: Any, length: Float[Array, ""]) -> Any:
        return jax.vmap(lambda key, state: kernel(key, state, round_density, length, inverse_mass))(keys, states)

    key, first = jax.random.split(jax.random.key(seed))
    points = DISPERSED * jax.random.normal(first, (chains, len(centre)))
    adapt, update, settled = dual_averaging_adaptation(ACCEPTED)
    kept, divergences, leaps = [], 0, 0
    with Progress(warmup + draws, "step", shown=progress) as shown:
        states = jax.jit(jax.vmap(lambda point: blackjax.nuts.init(point, round_density)))(points)
        adaptation = adapt(1.0 / len(centre) ** 0.25)
        length = jnp.exp(adaptation.log_step_size)
        for step in range(warmup + draws):
            key, this = jax.random.split(key)
            states, info = advance(jax.random.split(this, chains), states, length)
            leaps += int(jnp.max(info.num_integration_steps))
            if step == 0:
                shown.begin()
            if step < warmup:
                adaptation = update(adaptation, jnp.mean(info.acceptance_rate))
                length = jnp.exp(adaptation.log_step_size) if step < warmup - 1 else settled(adaptation)
            else:
                divergences += int(jnp.sum(info.is_divergent))
                kept.append(np.asarray(states.position))
            shown.advance(1)
    coordinates = np.asarray(centre) + np.stack(kept, axis=1) @ np.asarray(root).T
    values = {name: np.asarray(value) for name, value in density.values(jnp.asarray(coordinates)).items()}
    r_hat = blackjax.diagnostics.potential_scale_reduction(coordinates)
    ess = blackjax.diagnostics.effective_sample_size(coordinates)
    of = {"r_hat": np.asarray(r_hat).tolist(), "ess": np.asarray(ess).tolist()}
    named = {kind: dict(zip(density.names, numbers, strict=True)) for kind, numbers in of.items()}
    return Draws(values, coordinates, **named, divergences=divergences, leaps=leaps)


def _whole(density: LogDensity, centre: Any, covariance: Any) -> tuple[Array, Array]:
    """Where the density is centred, and a root of its covariance; an unknown error of n values has the variance 1 / 2n."""
    covariance = np.asarray(covariance, float)
    numbers = len(density.problem.free)
    if covariance.shape != (numbers, numbers) or not np.all(np.isfinite(covariance)):
        raise ValueError(
            f"covariance must be finite and of shape {(numbers, numbers)}: the data do not determine all numbers"
        )
    series, open_ = np.asarray(density.measurements.series), np.asarray(density.measurements.estimated)
    sizes = [math.sqrt(0.5 / np.sum(open_ & (series == one))) for one in density.open_series]
    root = np.zeros((numbers + len(sizes),) * 2)
    root[:numbers, :numbers] = np.linalg.cholesky(covariance)
    root[numbers:, numbers:] = np.diag(sizes)
    return jnp.concatenate([jnp.asarray(centre, float), jnp.zeros(len(sizes))]), jnp.asarray(root)
