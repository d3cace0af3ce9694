"""Lagrange's equations with multipliers, in coordinates and velocities: the form in which users' own systems are
run."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float

from ..geometry import solve
from .brackets import Coordinates
from .formulation import AbstractVelocityFormulation
from .system import AbstractSystem, with_constraints


class Lagrange(AbstractVelocityFormulation):
    """Lagrange's equations with multipliers, G q'' + G' q' = dL/dq + f + W^T lambda, with W q'' + W' q' = 0.

    The multipliers are those of `Multipliers`, but the state is (q, q'), so one linear system with the metric is solved
    for the force and the rows of W together. The metric may be singular if it is positive for the allowed rates, as with
    parts without mass. The Lagrangian must be kinetic minus potential energy. Source:
    `stroller.md`, section 6, F1.

    **Arguments:**

    - `system`: the data, an `AbstractSystem`.
    """

    system: AbstractSystem

    def field(self, t: Float[ArrayLike, ""], state: Float[Array, " state"], args=None) -> Float[Array, " state"]:
        q, rate = self.split(state)
        return jnp.concatenate([rate, self.acceleration(t, q, rate)])

    def acceleration(self, t: Float[ArrayLike, ""], q: Coordinates, rate: Coordinates) -> Coordinates:
        system = self.system

        def seen(q: Coordinates) -> tuple[Array, Array]:
            return system.constraints(q), system.metric(q)

        (W, G), (bend, swell) = jax.jvp(seen, (q,), (rate,))
        free = jax.grad(system.lagrangian)(q, rate) + system.force(t, q, rate) - swell @ rate
        per_mass = solve(with_constraints(G, W), jnp.column_stack([W.T, free]), positive=True)
        by_constraints, unconstrained = per_mass[:, :-1], per_mass[:, -1]
        multipliers = solve(W @ by_constraints, bend @ rate + W @ unconstrained, positive=True)
        return unconstrained - by_constraints @ multipliers
