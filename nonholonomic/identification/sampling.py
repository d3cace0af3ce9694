"""Draws from a posterior by the no-U-turn sampler of BlackJAX (the extra `bayes`)."""

import dataclasses
import math
from typing import Any, NamedTuple

import equinox as eqx
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

#: How often the ellipse is made rounder, and the least curvature that is believed in one go. Slopes that are a little wrong
#: make a direction look determined that the data hardly determine.
ROUNDS, LEAST = 2, 1e-2


class Draws(NamedTuple):
    """Draws from a posterior.

    - `values`: name -> (chains, draws); `coordinates`: (chains, draws, unknowns).
    - `r_hat`, `ess`: name -> number: the potential scale reduction, which should be below 1.01, and the effective number of
      independent draws.
    - `divergences`: how many trajectories left the region in which the density can be followed.
    - `leaps`: how many times the density was evaluated, by every chain.
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
    needs no adaptation but of the length of the leaps; all chains advance together. The leaps follow the slopes that the
    predictions have around the fit, so that each costs a run, and no derivative of it.

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

    steered = Steered.of(density, *_whole(density, centre, covariance))
    key, first = jax.random.split(jax.random.key(seed))
    points = DISPERSED * jax.random.normal(first, (chains, len(steered.centre)))
    begin, _, settled = dual_averaging_adaptation(ACCEPTED)
    kept, divergences, leaps = [], 0, 0
    with Progress(warmup + draws, "step", shown=progress) as shown:
        states = _begun(steered, points)
        # As arrays: a Python number in it would be compiled in.
        adaptation = jax.tree.map(np.asarray, begin(1.0 / len(steered.centre) ** 0.25))
        length = jnp.exp(adaptation.log_step_size)
        for step in range(warmup + draws):
            states, info = _advanced(steered, _keys(key, jnp.asarray(step), chains), states, jnp.asarray(length, float))
            leaps += int(np.max(info.num_integration_steps))
            if step == 0:
                shown.begin()
            if step < warmup:
                adaptation, length = _adapted(adaptation, info.acceptance_rate)
                length = settled(adaptation) if step == warmup - 1 else length
            else:
                divergences += int(np.sum(info.is_divergent))
                kept.append(np.asarray(states.position))
            shown.advance(1)
    coordinates = np.asarray(steered.at(jnp.asarray(np.stack(kept, axis=1))))
    values = {name: np.asarray(value) for name, value in density.values(jnp.asarray(coordinates)).items()}
    r_hat = blackjax.diagnostics.potential_scale_reduction(coordinates)
    ess = blackjax.diagnostics.effective_sample_size(coordinates)
    of = {"r_hat": np.asarray(r_hat).tolist(), "ess": np.asarray(ess).tolist()}
    named = {kind: dict(zip(density.names, numbers, strict=True)) for kind, numbers in of.items()}
    return Draws(values, coordinates, **named, divergences=divergences, leaps=leaps)


class Steered(eqx.Module):
    """A density in coordinates in which a fit's error ellipse is a sphere; its gradient costs no derivative of the model.

    The slopes of the predictions are those of secants over one standard error either way, found once; the rest of the density
    is differentiated exactly. With any field of force a leap keeps volumes and can be taken back, and leaps are accepted by
    the density itself: the draws are from it, whatever the slopes (Li et al., Comput. Stat. 34 (2019) 281).

    Where the data fix one combination far better than another, the ellipse is a thin ridge, and bent: along a loose direction
    the tight ones are moved with the square of the distance, which keeps volumes, too.

    - `centre`, `root`, `bend`: coordinates of the density are `centre` + `root` (point + `bend` point^2); column k of `bend` is
      0 but for directions tighter than k. The directions are sorted, the tightest first.
    - `middle`: (n,), predictions at the centre; `slopes`: (n, unknowns), their slopes by the point.
    """

    density: LogDensity
    centre: Float[Array, " unknowns"]
    root: Float[Array, "unknowns unknowns"]
    bend: Float[Array, "unknowns unknowns"]
    middle: Float[Array, " n"]
    slopes: Float[Array, "n unknowns"]

    @classmethod
    def of(
        cls, density: LogDensity, centre: Float[Array, " unknowns"], root: Float[Array, "unknowns unknowns"]
    ) -> "Steered":
        """The density around a fit, its ellipse made rounder: secants see further than the slopes at the fit."""
        count = len(centre)
        flat = cls(density, centre, root, jnp.zeros((count, count)), jnp.zeros(0), jnp.zeros((0, count)))
        found, _ = flat._seen()
        for _ in range(ROUNDS):
            found, curves = found._rounder()._seen()
            found, _ = found._bent(curves)._seen()
        return found

    @eqx.filter_jit
    def _rounder(self) -> "Steered":
        """The same with an ellipse as wide as the slopes say, along its own axes, not bent."""
        count = len(self.centre)
        # Directions that are flat or curved the other way are stretched, and looked at again.
        values, directions = jnp.linalg.eigh(-jax.hessian(self._straight)(jnp.zeros(count), 0.0))
        spread = self.root @ (directions / jnp.sqrt(jnp.clip(values, LEAST, 1.0 / LEAST)))
        axes, sizes, _ = jnp.linalg.svd(spread)
        return dataclasses.replace(self, root=(axes * sizes)[:, ::-1], bend=jnp.zeros((count, count)))

    @eqx.filter_jit
    def _bent(self, curves: Float[Array, "unknowns n"]) -> "Steered":
        """The same with the tight directions moved as far as the curved predictions pull them."""
        by_point, middle = jax.grad(self._straight), jnp.zeros(len(self.centre))
        pulls = jax.vmap(lambda curve: by_point(middle, curve) - by_point(middle, 0.0))(curves)
        return dataclasses.replace(self, bend=jnp.triu(pulls.T, 1))

    def _seen(self) -> tuple["Steered", Float[Array, "unknowns n"]]:
        """The same with the predictions and slopes of secants of length 1 either way, and how far these are curved."""
        count = len(self.centre)
        points = self.at(jnp.concatenate([jnp.zeros((1, count)), jnp.eye(count), -jnp.eye(count)]))
        found = _predicted(self.density, points)
        middle, ahead, behind = jnp.split(jnp.where(jnp.isfinite(found), found, found[0]), [1, 1 + count])
        seen = dataclasses.replace(self, middle=middle[0], slopes=0.5 * (ahead - behind).T)
        return seen, 0.5 * (ahead + behind) - middle

    def _straight(self, point: Float[Array, " unknowns"], off: Any) -> Float[Array, ""]:
        """The density if predictions were straight lines, moved by `off`."""
        return self.density.of_prediction(self.centre + self.root @ point, self.middle + off + self.slopes @ point)

    def at(self, point: Float[Array, "... unknowns"]) -> Float[Array, "... unknowns"]:
        """The coordinates of a point."""
        return self.centre + (point + point**2 @ self.bend.T) @ self.root.T

    def __call__(self, point: Float[Array, " unknowns"]) -> Float[Array, ""]:
        @jax.custom_jvp
        def predict(point: Float[Array, " unknowns"]) -> Float[Array, " n"]:
            return self.density.predict(self.at(point)[None])[0]

        @predict.defjvp
        def along(primals: Any, tangents: Any) -> Any:
            return predict(*primals), self.slopes @ tangents[0]

        return self.density.of_prediction(self.at(point), predict(point))


_predicted = eqx.filter_jit(LogDensity.predict)


@eqx.filter_jit
def _begun(steered: Steered, points: Float[Array, "chains unknowns"]) -> Any:
    """The states of chains at some points."""
    import blackjax

    return jax.vmap(lambda point: blackjax.nuts.init(point, steered))(points)


@eqx.filter_jit
def _advanced(steered: Steered, keys: Array, states: Any, length: Float[Array, ""]) -> Any:
    """The next states of all chains, and how they were found."""
    import blackjax

    kernel, inverse_mass = blackjax.nuts.build_kernel(), jnp.ones(len(steered.centre))
    return jax.vmap(lambda key, state: kernel(key, state, steered, length, inverse_mass))(keys, states)


@eqx.filter_jit
def _adapted(adaptation: Any, accepted: Float[Array, " chains"]) -> tuple[Any, Float[Array, ""]]:
    """What the acceptance of all chains makes of the leaps' length."""
    from blackjax.adaptation.step_size import dual_averaging_adaptation

    adaptation = dual_averaging_adaptation(ACCEPTED)[1](adaptation, jnp.mean(accepted))
    return adaptation, jnp.exp(adaptation.log_step_size)


_keys = eqx.filter_jit(lambda key, step, count: jax.random.split(jax.random.fold_in(key, step), count))


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
