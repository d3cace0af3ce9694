"""Equations of motion of a constrained mechanical system, derived from its data alone; JAX computes every derivative.

The data of a system are its metric G(q), potential V(q), constraint one-forms W(q) with W q' = 0, frame E(q), and the
generalised force f(t, q, q') of drives and friction. From them follow

- `Lagrange`: Lagrange's equations with multipliers, in coordinates and velocities;
- `Hamel`: Poincare's equations in the quasi-velocities of the frame; with constraints, Hamel's equations.

Each formulation takes a single state (n,); use `jax.vmap` for many. The models of the vehicles are faster and do not use the
formulations. `tests/witnesses/other_formulations.py` has further formulations, with which the tests compare these.
"""

import abc
from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float

from ..geometry import solve
from .system import AbstractSystem, Coordinates, with_constraints, within_constraints


def lie_brackets(fields: Callable[[Coordinates], Float[Array, "n m"]], q: Coordinates) -> Float[Array, "n m m"]:
    """Lie brackets of vector fields: component i of [X_a, X_b] = (X_a.d) X_b - (X_b.d) X_a at [i, a, b].

    **Arguments:**

    - `fields`: function of the coordinates (n,) that returns m fields as the columns of an (n, m) array.
    - `q`: coordinates at which to evaluate, (n,).
    """
    derivatives = jnp.einsum("ibk,ka->iab", jax.jacfwd(fields)(q), fields(q))
    return derivatives - jnp.swapaxes(derivatives, 1, 2)


class AbstractFormulation(eqx.Module):
    """Equations of motion of a system, as a first-order field of their own state.

    **Arguments:**

    - `system`: the data, an `AbstractSystem`.
    """

    system: eqx.AbstractVar[AbstractSystem]

    @abc.abstractmethod
    def state(self, q: Coordinates, rate: Coordinates) -> Float[Array, " state"]:
        """The state for coordinates and velocity, each (n,); the velocity must obey the constraints."""

    @abc.abstractmethod
    def split(self, state: Float[Array, " state"]) -> tuple[Coordinates, Coordinates]:
        """Coordinates and velocity, each (n,), of a state."""

    @abc.abstractmethod
    def field(self, t: Float[ArrayLike, ""], state: Float[Array, " state"], args=None) -> Float[Array, " state"]:
        """Rate of change of the state, with the signature of a Diffrax vector field."""

    def acceleration(self, t: Float[ArrayLike, ""], q: Coordinates, rate: Coordinates) -> Coordinates:
        """Second derivative of the coordinates, by the chain rule through this formulation's state."""
        state = self.state(q, rate)
        _, (_, acceleration) = jax.jvp(self.split, (state,), (self.field(t, state),))
        return acceleration

    def energy(self, state: Float[Array, " state"]) -> Float[Array, ""]:
        """Energy at a state."""
        return self.system.energy(*self.split(state))


class Hamel(AbstractFormulation):
    """Poincare's equations in quasi-velocities u, q' = E u (`stroller.md`, section 6, F2).

    With l(q, u) = L(q, E u) and p = dl/du, p_i' = E_i(l) + c^k_ji u^j p_k + E_i.f. Constraints remove the equations and
    the quasi-velocities of the frame's last fields, but not their momenta, which carry the nonholonomic terms (Hamel).
    The Lagrangian may have terms linear in the velocity, as that of a Routhian has. The state is (q, u).

    **Arguments:**

    - `system`: the data, an `AbstractSystem`.
    """

    system: AbstractSystem

    def state(self, q: Coordinates, rate: Coordinates) -> Float[Array, " state"]:
        rate = within_constraints(self.system, q, rate)
        return jnp.concatenate([q, solve(self.system.frame(q), rate)[: self.system.freedom]])

    def quasi_velocity(self, state: Float[Array, " state"]) -> tuple[Coordinates, Coordinates]:
        """Coordinates and all n quasi-velocities; those that the constraints forbid are 0."""
        n = self.system.dimension
        return state[:n], jnp.concatenate([state[n:], jnp.zeros(n - self.system.freedom, state.dtype)])

    def split(self, state: Float[Array, " state"]) -> tuple[Coordinates, Coordinates]:
        q, u = self.quasi_velocity(state)
        return q, self.system.frame(q) @ u

    def field(self, t: Float[ArrayLike, ""], state: Float[Array, " state"], args=None) -> Float[Array, " state"]:
        system, free = self.system, self.system.freedom
        q, u = self.quasi_velocity(state)
        E = system.frame(q)
        rate = E @ u

        def lagrangian(q, u):
            return system.lagrangian(q, system.frame(q) @ u)

        momentum = jax.grad(lagrangian, argnums=1)
        swell = jax.jvp(lambda q: momentum(q, u), (q,), (rate,))[1]
        inertia = jax.jacfwd(momentum, argnums=1)(q, u)[:free, :free]
        # c^k_ji p_k is the bracket [E_j, E_i] paired with dL/dq', of which p_k is the part along E_k.
        gradient = jax.grad(system.lagrangian, argnums=1)(q, rate)
        gyroscopic = jnp.einsum("kji,j,k->i", lie_brackets(system.frame, q), u, gradient)
        forces = E.T @ (jax.grad(lagrangian)(q, u) + system.force(t, q, rate)) + gyroscopic - swell
        return jnp.concatenate([rate, solve(inertia, forces[:free], positive=True)])


class AbstractVelocityFormulation(AbstractFormulation):
    """Equations of motion whose state is (q, q')."""

    def state(self, q: Coordinates, rate: Coordinates) -> Float[Array, " state"]:
        return jnp.concatenate([q, rate])

    def split(self, state: Float[Array, " state"]) -> tuple[Coordinates, Coordinates]:
        q, rate = jnp.split(state, 2)
        return q, rate


class Lagrange(AbstractVelocityFormulation):
    """Lagrange's equations with multipliers, G q'' + G' q' = dL/dq + f + W^T lambda, with W q'' + W' q' = 0.

    The state is (q, q'), so one linear system with the metric is solved
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
