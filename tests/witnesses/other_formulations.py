"""Further formulations of a constrained mechanical system, beside those of `nonholonomic/systems/mechanics.py`.

- `Multipliers`: Hamilton's equations with Lagrange multipliers, the constrained port-Hamiltonian form;
- `ConstrainedConnection`: geodesics, with forces, of the constrained Levi-Civita connection;
- `ReducedBracket`: the reduced Poisson-like bracket of van der Schaft and Maschke;
- `Routhian`: a system with one cyclic coordinate eliminated.

The formulations use the data of a system in different ways, so their agreement checks all of them.
"""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float

from nonholonomic.geometry import solve
from nonholonomic.systems.mechanics import (
    AbstractFormulation,
    AbstractSystem,
    Coordinates,
    lie_brackets,
)
from nonholonomic.validation import as_number, is_traced, require, warn

Frame = Callable[[Coordinates], Float[Array, "n n"]]

#: Relative violation of the constraints above which a start gives a warning.
START_TOLERANCE = 1e-9


def structure_constants(frame: Frame, q: Coordinates) -> Float[Array, "n n n"]:
    """Structure coefficients of a frame, [E_a, E_b] = c^c_ab E_c, at [c, a, b].

    **Arguments:** as for `lie_brackets`, with as many fields as coordinates.
    """
    brackets = lie_brackets(frame, q)
    return solve(frame(q), brackets.reshape(q.size, -1)).reshape(brackets.shape)


def reduced_fields(system: AbstractSystem, q: Coordinates) -> Float[Array, "n r"]:
    """The frame's first fields, which span the velocities that the constraints allow."""
    return system.frame(q)[:, : system.freedom]


class Multipliers(AbstractFormulation):
    """Hamilton's equations with multipliers, q' = dH/dp, p' = -dH/dq + f + W^T lambda (`stroller.md`, section 6, F1).

    The state is (q, p). The multipliers keep W q' constant at its initial value, but the integrator's error makes it
    drift. The following two options remove the drift; neither changes an exact solution.

    **Arguments:**

    - `system`: the data, an `AbstractSystem`.
    - `baumgarte`: rate [1/s] at which a violation W q' decays, at least 0.
    - `project`: whether to take the velocity from the momentum after projecting it on the constraints.

    **Raises:** `ValueError` for a negative rate.
    """

    system: AbstractSystem
    baumgarte: Float[Array, ""] = eqx.field(converter=as_number, default=0.0)
    project: bool = eqx.field(static=True, default=False)

    def __check_init__(self):
        require(self.baumgarte, "baumgarte", at_least=0.0)

    def projected(self, q: Coordinates, p: Coordinates) -> Coordinates:
        """The momentum closest to p, in the kinetic metric, whose velocity obeys the constraints."""
        W = self.system.constraints(q)
        per_mass = solve(self.system.metric(q), jnp.column_stack([W.T, p]), positive=True)
        return p - W.T @ solve(W @ per_mass[:, :-1], W @ per_mass[:, -1], positive=True)

    def state(self, q: Coordinates, rate: Coordinates) -> Float[Array, " state"]:
        """The state (q, p), with p projected on the constraints; warns if a concrete velocity violates them."""
        violation = self.system.constraints(q) @ rate
        if not is_traced(violation) and violation.size:
            violation_ratio = float(jnp.max(jnp.abs(violation)) / jnp.maximum(jnp.max(jnp.abs(rate)), 1e-300))
            if violation_ratio > START_TOLERANCE:
                warn(
                    f"the velocity violates the constraints by a relative {violation_ratio:.1e} and is projected onto them"
                )
        return jnp.concatenate([q, self.projected(q, self.system.metric(q) @ rate)])

    def split(self, state: Float[Array, " state"]) -> tuple[Coordinates, Coordinates]:
        q, p = jnp.split(state, 2)
        if self.project:
            p = self.projected(q, p)
        return q, solve(self.system.metric(q), p, positive=True)

    def multipliers(self, t: Float[ArrayLike, ""], q: Coordinates, rate: Coordinates) -> Float[Array, " k"]:
        """Multipliers lambda, whose forces keep W q' from changing."""
        system = self.system
        W, bend = jax.jvp(system.constraints, (q,), (rate,))
        G, swell = jax.jvp(system.metric, (q,), (rate,))
        free = jax.grad(system.lagrangian)(q, rate) + system.force(t, q, rate) - swell @ rate
        per_mass = solve(G, jnp.column_stack([W.T, free]), positive=True)
        acceleration = bend @ rate + W @ per_mass[:, -1] + self.baumgarte * (W @ rate)
        return -solve(W @ per_mass[:, :-1], acceleration, positive=True)

    def field(self, t: Float[ArrayLike, ""], state: Float[Array, " state"], args=None) -> Float[Array, " state"]:
        q, rate = self.split(state)
        force = jax.grad(self.system.lagrangian)(q, rate) + self.system.force(t, q, rate)
        force = force + self.system.constraints(q).T @ self.multipliers(t, q, rate)
        return jnp.concatenate([rate, force])


class ConstrainedConnection(AbstractFormulation):
    """Geodesics, with forces, of the constrained Levi-Civita connection (`stroller.md`, section 6, F3).

    With Q the metric projector on the forbidden directions, nabla^D = nabla + nabla Q is a connection on all of the
    configuration space whose geodesics that start within the constraints stay within them (Lewis; Vershik and Faddeev):
    no multiplier appears. The state is (q, q'). The Lagrangian must be kinetic minus potential energy.

    **Arguments:**

    - `system`: the data, an `AbstractSystem`.
    """

    system: AbstractSystem

    def state(self, q: Coordinates, rate: Coordinates) -> Float[Array, " state"]:
        return jnp.concatenate([q, rate])

    def split(self, state: Float[Array, " state"]) -> tuple[Coordinates, Coordinates]:
        q, rate = jnp.split(state, 2)
        return q, rate

    def forbidden(self, q: Coordinates) -> Float[Array, "n n"]:
        """Projector Q = G^-1 W^T (W G^-1 W^T)^-1 W on the directions orthogonal to the allowed ones."""
        W = self.system.constraints(q)
        vectors = solve(self.system.metric(q), W.T, positive=True)
        return vectors @ solve(W @ vectors, W, positive=True)

    def christoffel(self, q: Coordinates) -> Float[Array, "n n n"]:
        """Christoffel symbols Gamma^i_jk of the kinetic metric, at [i, j, k]."""
        slope = jax.jacfwd(self.system.metric)(q)
        christoffel = 0.5 * (slope + slope.swapaxes(1, 2) - jnp.moveaxis(slope, 2, 0))
        return solve(self.system.metric(q), christoffel.reshape(q.size, -1), positive=True).reshape(christoffel.shape)

    def connection(self, q: Coordinates) -> Float[Array, "n n n"]:
        """Coefficients Gamma^D i_jk = Gamma^i_jk + (nabla_j Q)^i_k of the constrained connection, at [i, j, k]."""
        gamma, Q, slope = self.christoffel(q), self.forbidden(q), jax.jacfwd(self.forbidden)(q)
        carried = jnp.einsum("ijl,lk->ijk", gamma, Q) - jnp.einsum("ljk,il->ijk", gamma, Q)
        return gamma + jnp.einsum("ikj->ijk", slope) + carried

    def coefficients(self, q: Coordinates) -> Float[Array, "r r r"]:
        """Coefficients of nabla^D_{X_a} X_b = Gamma^c_ab X_c in the fields that span the constraints, at [c, a, b]."""
        E, r = self.system.frame(q), self.system.freedom
        X = E[:, :r]
        slope = jax.jacfwd(lambda q: reduced_fields(self.system, q))(q)
        derivative = jnp.einsum("ibk,ka->iab", slope, X) + jnp.einsum("ijk,ja,kb->iab", self.connection(q), X, X)
        return solve(E, derivative.reshape(q.size, -1)).reshape(derivative.shape)[:r]

    def field(self, t: Float[ArrayLike, ""], state: Float[Array, " state"], args=None) -> Float[Array, " state"]:
        q, rate = self.split(state)
        force = self.system.force(t, q, rate) - jax.grad(self.system.potential)(q)
        push = solve(self.system.metric(q), force, positive=True)
        bend = jnp.einsum("ijk,j,k->i", self.connection(q), rate, rate)
        return jnp.concatenate([rate, push - self.forbidden(q) @ push - bend])


class ReducedBracket(AbstractFormulation):
    """The reduced bracket of van der Schaft and Maschke (1994) (`stroller.md`, section 6, F4).

    With X = (X_1, ...) the allowed fields, p = G X u, and H(q, p~) = p~.(X^T G X)^-1 p~ / 2 + V,
    q' = X dH/dp~ and p~' = -X^T dH/dq - p.[X_a, X_b] dH/dp~ + X^T f. The state is (q, p~), p~ = X^T p. The
    Lagrangian must be kinetic minus potential energy.

    **Arguments:**

    - `system`: the data, an `AbstractSystem`.
    """

    system: AbstractSystem

    def state(self, q: Coordinates, rate: Coordinates) -> Float[Array, " state"]:
        return jnp.concatenate([q, reduced_fields(self.system, q).T @ self.system.metric(q) @ rate])

    def hamiltonian(self, q: Coordinates, momentum: Float[Array, " r"]) -> Float[Array, ""]:
        """Energy as a function of the coordinates and the reduced momentum p~."""
        X = reduced_fields(self.system, q)
        inertia = X.T @ self.system.metric(q) @ X
        return 0.5 * momentum @ solve(inertia, momentum, positive=True) + self.system.potential(q)

    def split(self, state: Float[Array, " state"]) -> tuple[Coordinates, Coordinates]:
        q, momentum = state[: self.system.dimension], state[self.system.dimension :]
        return q, reduced_fields(self.system, q) @ jax.grad(self.hamiltonian, argnums=1)(q, momentum)

    def field(self, t: Float[ArrayLike, ""], state: Float[Array, " state"], args=None) -> Float[Array, " state"]:
        system, n = self.system, self.system.dimension
        q, momentum = state[:n], state[n:]
        slope, u = jax.grad(self.hamiltonian, argnums=(0, 1))(q, momentum)
        X = reduced_fields(system, q)
        rate = X @ u
        brackets = lie_brackets(lambda q: reduced_fields(system, q), q)
        bracket = -jnp.einsum("i,iab->ab", system.metric(q) @ rate, brackets)
        return jnp.concatenate([rate, X.T @ (system.force(t, q, rate) - slope) + bracket @ u])


class Routhian(AbstractSystem):
    """A system with one cyclic coordinate eliminated, at a given momentum, R = L - beta psi'.

    The coordinate is cyclic if neither metric, potential, force, margin nor reset depends on it, and neither force nor
    impulse has a component along it. The reduced Lagrangian has terms linear in the velocity, which `Hamel` accepts.

    **Arguments:**

    - `full`: the unconstrained system to reduce.
    - `cyclic`: index of the cyclic coordinate.
    - `momentum`: its constant momentum beta.
    """

    full: AbstractSystem
    cyclic: int = eqx.field(static=True)
    momentum: Float[Array, ""] = eqx.field(converter=as_number)

    def __check_init__(self):
        require(self.momentum, "momentum")

    @property
    def dimension(self) -> int:
        return self.full.dimension - 1

    def complete(self, q: Coordinates, rate: Coordinates) -> tuple[Coordinates, Coordinates]:
        """All coordinates and velocities, with the cyclic coordinate at 0 and its velocity from the momentum."""
        q = jnp.insert(q, self.cyclic, 0.0)
        rate = jnp.insert(rate, self.cyclic, 0.0)
        row = self.full.metric(q)[self.cyclic]
        return q, rate.at[self.cyclic].set((self.momentum - row @ rate) / row[self.cyclic])

    def metric(self, q: Coordinates) -> Float[Array, "m m"]:
        full_metric = self.full.metric(jnp.insert(q, self.cyclic, 0.0))
        free = np.delete(np.arange(len(full_metric)), self.cyclic)
        column = full_metric[free, self.cyclic]
        return full_metric[np.ix_(free, free)] - jnp.outer(column, column) / full_metric[self.cyclic, self.cyclic]

    def lagrangian(self, q: Coordinates, rate: Coordinates) -> Float[Array, ""]:
        q, rate = self.complete(q, rate)
        return self.full.lagrangian(q, rate) - self.momentum * rate[self.cyclic]

    def force(self, t: Float[ArrayLike, ""], q: Coordinates, rate: Coordinates) -> Coordinates:
        return jnp.delete(self.full.force(t, *self.complete(q, rate)), self.cyclic)

    def margin(self, t: Float[ArrayLike, ""], q: Coordinates, rate: Coordinates) -> Any:
        return self.full.margin(t, *self.complete(q, rate))

    def reset(self, t: Float[ArrayLike, ""], q: Coordinates, rate: Coordinates, *exit: Any) -> tuple[Any, ...] | None:
        full: Any = self.full
        following = full.reset(t, *self.complete(q, rate), *exit)
        if following is None:
            return None
        q, rate, *number = following
        return jnp.delete(q, self.cyclic), jnp.delete(rate, self.cyclic), *number
