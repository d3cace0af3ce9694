"""A mechanical system as data: its metric, potential, constraints and forces, and how it strikes its surroundings."""

import abc
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float

from ..geometry import solve

Coordinates = Float[Array, " n"]


class AbstractSystem(eqx.Module):
    """A mechanical system with n coordinates and k linear constraints on its velocity.

    Subclass it, declare the numbers of your model as fields, set `dimension` to the number of coordinates, and write functions
    of one set of coordinates: the `metric`, and as needed `potential`, `constraints`, `force` and `frame`. The equations of
    motion follow; `nonholonomic.simulate`, `event_time`, `sweep` and `identify` run them. For a system that strikes something,
    write `margin` and `reset` as well.

    **Example:** a bead on a parabolic wire z = x^2 / 2, which oscillates in about 2 pi / sqrt(g).

    ```
    >>> import jax.numpy as jnp
    >>> import nonholonomic
    >>> class Bead(nonholonomic.AbstractSystem):
    ...     gravity: float = 9.81
    ...     dimension = 1
    ...
    ...     def metric(self, q):
    ...         return (1.0 + q[0] ** 2)[None, None]
    ...
    ...     def potential(self, q):
    ...         return 0.5 * self.gravity * q[0] ** 2
    >>> quarter = nonholonomic.event_time(Bead(), ([0.01], [0.0]), t1=5.0, event=lambda t, y: y[0])
    >>> print(f"{4.0 * quarter:.4f} s, small oscillations: {2.0 * jnp.pi / jnp.sqrt(9.81):.4f} s")
    2.0061 s, small oscillations: 2.0061 s

    ```
    """

    #: Names of the coordinates, such as ("x", "angle"), in tables and pictures, where their rates are "x_rate" and so on; by
    #: default "q0" and "rate0" and so on.
    names: ClassVar[tuple[str, ...] | None] = None

    @property
    @abc.abstractmethod
    def dimension(self) -> int:
        """Number n of coordinates."""

    @property
    def freedom(self) -> int:
        """Number n - k of independent velocities."""
        q = jax.ShapeDtypeStruct((self.dimension,), jnp.result_type(float))
        return self.dimension - jax.eval_shape(self.constraints, q).shape[0]

    @abc.abstractmethod
    def metric(self, q: Coordinates) -> Float[Array, "n n"]:
        """Kinetic metric G(q): the kinetic energy is q'.G q' / 2."""

    def potential(self, q: Coordinates) -> Float[Array, ""]:
        """Potential energy V(q); zero by default."""
        return jnp.zeros((), q.dtype)

    def constraints(self, q: Coordinates) -> Float[Array, "k n"]:
        """One-forms W(q), one per row, that vanish on every allowed velocity; none by default."""
        return jnp.zeros((0, q.size), q.dtype)

    def frame(self, q: Coordinates) -> Float[Array, "n n"]:
        """Frame fields E(q), one per column; W annihilates the first n - k. By default, the coordinate fields."""
        return jnp.eye(q.size, dtype=q.dtype)

    def force(self, t: Float[ArrayLike, ""], q: Coordinates, rate: Coordinates) -> Coordinates:
        """Generalised force f(t, q, q') in addition to that of the potential; zero by default."""
        return jnp.zeros_like(q)

    def margin(
        self, t: Float[ArrayLike, ""], q: Coordinates, rate: Coordinates
    ) -> Float[Array, "..."] | dict[str, Float[Array, ""]] | None:
        """A smooth function that is positive while the system moves freely and falls through zero where it strikes something,
        such as the distance from a wall; several in an array, (k,), or in a dict by name, of which the first to fall counts;
        `None`, the default, for a system that strikes nothing. An oscillation in time that is
        faster than the motion can be missed: let `force` contain it.
        """
        return None

    def reset(self, t: Float[ArrayLike, ""], q: Coordinates, rate: Coordinates) -> tuple[Any, ...] | None:
        """The coordinates and rates that follow when the margin has fallen to zero, `(q, rate)`, such as those after an
        `impact`; `None`, the default, if the run ends here. If there are several margins, write
        `reset(self, t, q, rate, exit)`: `exit` is the index of the margin that fell, or for a dict a dict that is true for its
        name and false for the others.

        The constraints hold after the reset, too: rates that violate them are projected onto them, orthogonally in the
        kinetic metric. The change is the impulse of the constraints, as if the reset happened without constraints and
        their impulse followed. For a mode of a `Hybrid`, `(q, rate, number)` also names the next mode by its index, and
        the constraints are those of the next mode.
        """
        return None

    def impact(
        self,
        t: Float[ArrayLike, ""],
        q: Coordinates,
        rate: Coordinates,
        restitution: Float[ArrayLike, ""] = 1.0,
        exit: Any = None,
    ) -> Coordinates:
        """The rates after an impact without friction on the surface where the margin is zero.

        The impulse acts along the gradient of the margin with respect to the coordinates; the constraints act at the same
        time, so that the rates obey them before and after. The rate of the margin changes its sign and is multiplied by
        the restitution (Newton's law of impact). With a restitution of 1, the energy is conserved.

        **Arguments:** `t`, `q`, `rate`: at the impact; `restitution`: usually in [0, 1]; `exit`: as for `reset`, for a system
        with several margins.

        **Returns:** the rates, for use in `reset`; NaN if the constraints hold the system against the impulse.

        **Example:** a bead on a wire that strikes a wall at x = 0 once per half-period, sqrt(m / k) pi.

        ```
        >>> import jax.numpy as jnp
        >>> import nonholonomic
        >>> class Bead(nonholonomic.AbstractSystem):
        ...     stiffness: float = 4.0
        ...     restitution: float = 0.5
        ...     dimension = 1
        ...
        ...     def metric(self, q):
        ...         return jnp.eye(1)
        ...
        ...     def potential(self, q):
        ...         return 0.5 * self.stiffness * q[0] ** 2
        ...
        ...     def margin(self, t, q, rate):
        ...         return q[0]
        ...
        ...     def reset(self, t, q, rate):
        ...         return q, self.impact(t, q, rate, self.restitution)
        >>> run = nonholonomic.simulate(Bead(), ([0.0], [1.0]), t1=4.0)
        >>> for time, rate in zip(run.resets["time"], run.resets["rate0_after"]):
        ...     print(f"{time:.6f} s: {rate:.6f}")
        1.570796 s: 0.500000
        3.141593 s: 0.250000

        ```
        """

        def margin(q: Coordinates) -> Float[Array, ""]:
            margin: Any = self.margin(t, q, rate)
            if isinstance(margin, dict):
                return sum((jnp.where(exit[name], value, 0.0) for name, value in margin.items()), jnp.zeros(()))
            return margin if exit is None else margin[exit]

        gradient = jax.grad(margin)(q)
        metric = with_constraints(self.metric(q), self.constraints(q))
        push = within_constraints(self, q, solve(metric, gradient, positive=True))
        return rate - (1.0 + restitution) * (gradient @ rate) / (gradient @ push) * push

    def lagrangian(self, q: Coordinates, rate: Coordinates) -> Float[Array, ""]:
        """The Lagrangian L(q, q') = q'.G q' / 2 - V."""
        return 0.5 * rate @ self.metric(q) @ rate - self.potential(q)

    def energy(self, q: Coordinates, rate: Coordinates) -> Float[Array, ""]:
        """Energy q'.dL/dq' - L; for a Lagrangian quadratic in q', kinetic plus potential energy."""
        return jax.grad(self.lagrangian, argnums=1)(q, rate) @ rate - self.lagrangian(q, rate)


def within_constraints(system: AbstractSystem, q: Coordinates, rate: Coordinates) -> Coordinates:
    """The rates closest to some rates, in the kinetic metric, that the constraints allow."""
    W = system.constraints(q)
    if not W.shape[0]:
        return rate
    per_impulse = solve(with_constraints(system.metric(q), W), W.T, positive=True)
    return rate - per_impulse @ solve(W @ per_impulse, W @ rate, positive=True)


def with_constraints(metric: Float[Array, "n n"], W: Float[Array, "k n"]) -> Float[Array, "n n"]:
    """The metric plus a mass for each forbidden direction, G + W^T S W.

    Allowed motions do not feel these masses: they only change the multipliers. If parts have no mass, G is singular, and this
    sum is positive definite where G is positive for the allowed rates. A constraint adds to each coordinate at most the mass
    that it has, so that none is lost beside a large one, like a ball's beside that of the turntable it rolls on.
    """
    if not W.shape[0]:
        return metric
    diagonal = jnp.sum(metric * np.eye(len(metric)), axis=1)
    squares = W * W
    has_mass = (squares > 0.0) & (diagonal > 0.0)
    least = jnp.min(jnp.where(has_mass, diagonal / jnp.where(has_mass, squares, 1.0), jnp.inf), axis=1)
    # None of the coordinates in the constraint has a mass: any will do.
    masses = jnp.where(least < jnp.inf, least, jnp.sum(diagonal) / jnp.sum(squares, axis=1))
    return metric + W.T @ (jax.lax.stop_gradient(masses)[:, None] * W)
