"""The no-U-turn samplers of BlackJAX and NumPyro on the density itself, for a comparison with
`nonholonomic.identification.sample`."""

import math
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from nonholonomic.identification import Draws, LogDensity

#: Greatest number of doublings of a walk.
DEEPEST = 6


class InPoints(eqx.Module):
    """A density as a function of points, which are coordinates in units of a fit's errors along its principal directions."""

    density: LogDensity
    centre: Float[Array, " unknowns"]
    root: Float[Array, "unknowns unknowns"]

    def at(self, point: Float[Array, "... unknowns"]) -> Float[Array, "... unknowns"]:
        """The coordinates of points."""
        return self.centre + point @ self.root.T

    def __call__(self, point: Float[Array, " unknowns"]) -> Float[Array, ""]:
        return self.density(self.at(point))


def plain(library: str, density: LogDensity, fit: Any, warmup: int, draws: int) -> tuple[Draws, int]:
    """Draws by the no-U-turn sampler of a library with the gradient of the density, and the number of leaps for these
    draws."""
    root = np.linalg.cholesky(fit.coordinate_covariance)
    in_points = InPoints(density, jnp.asarray(fit.coordinates), jnp.asarray(root))
    starts = jnp.asarray(np.random.default_rng(0).normal(size=(4, len(root))))
    points, leaps = BY[library](in_points, starts, warmup, draws)
    return Draws.of(density, np.asarray(in_points.at(jnp.asarray(points))), math.nan, leaps), leaps


def by_numpyro(density: InPoints, starts: Any, warmup: int, draws: int) -> tuple[np.ndarray, int]:
    """Points (chains, draws, unknowns) by NumPyro, and their number of leaps over all chains."""
    from numpyro.infer import MCMC, NUTS

    chains = {"num_chains": len(starts), "chain_method": "vectorized", "progress_bar": False}
    kernel = NUTS(potential_fn=lambda point: -density(point), dense_mass=True, max_tree_depth=DEEPEST)
    run = MCMC(kernel, num_warmup=warmup, num_samples=draws, **chains)
    run.run(jax.random.key(1), init_params=starts, extra_fields=("num_steps",))
    steps = np.asarray(run.get_extra_fields(group_by_chain=True)["num_steps"])
    return np.asarray(run.get_samples(group_by_chain=True)), int(np.sum(steps))


def by_blackjax(density: InPoints, starts: Any, warmup: int, draws: int) -> tuple[np.ndarray, int]:
    """The same by BlackJAX."""
    import blackjax

    def chain(key: Any, start: Any) -> tuple[Array, Array]:
        adaptation = blackjax.window_adaptation(
            blackjax.nuts, density, is_mass_matrix_diagonal=False, max_num_doublings=DEEPEST
        )
        first, second = jax.random.split(key)
        (state, parameters), _ = adaptation.run(first, start, warmup)
        step = blackjax.nuts(density, **parameters).step

        def advance(state: Any, key: Any) -> Any:
            state, info = step(key, state)
            return state, (state.position, info.num_integration_steps)

        return jax.lax.scan(advance, state, jax.random.split(second, draws))[1]

    points, steps = jax.jit(jax.vmap(chain))(jax.random.split(jax.random.key(1), len(starts)), starts)
    return np.asarray(points), int(np.sum(steps))


BY = {"numpyro": by_numpyro, "blackjax": by_blackjax}
