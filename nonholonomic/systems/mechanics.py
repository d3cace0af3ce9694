"""Equations of motion of a constrained mechanical system, derived from its data alone; JAX computes every derivative.

The data of a system are its metric G(t, q), potential V(t, q), constraint one-forms W(t, q) with W q' = d(t, q), frame E(q),
and the generalised force f(t, q, q') of drives and friction. From them follow

- `Lagrange`: Lagrange's equations with multipliers, in coordinates and velocities;
- `Hamel`: Poincare's equations in the quasi-velocities of the frame; with constraints, Hamel's equations.

Each formulation takes a single state (n,); use `jax.vmap` for many. The models of the vehicles are faster and do not use the
formulations. `tests/witnesses/other_formulations.py` has further formulations, with which the tests compare these.

At the end of the file are the rules by which a run may start.
"""

import abc
import functools
import inspect
from collections.abc import Callable, Sequence
from types import ModuleType
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Bool, Float

from ..compilation.tracing import dependent_outputs
from ..geometry import solve

# A mode as equations of motion.

State = Float[Array, " components"]
Number = Float[ArrayLike, ""]

#: What the `margin` of a mode returns, and its `reset`.
Margin = Float[Array, "..."] | dict[str, Float[Array, ""]] | None
Reset = tuple[State, Any] | None


@jax.tree_util.register_pytree_node_class
class Exit(dict[str, Bool[Array, ""]]):
    """Which margin of a dict has fallen, by name. To compare it with a number or a name would be false without a word."""

    def __eq__(self, other: object) -> bool:
        name = next(iter(self))
        raise ValueError(f"exit == {other}: exit is a dict that is true for the margin that fell; write exit[{name!r}]")

    def tree_flatten(self) -> tuple[tuple[Array, ...], tuple[str, ...]]:
        return tuple(self.values()), tuple(self)

    @classmethod
    def tree_unflatten(cls, names: tuple[str, ...], has_fallen: Sequence[Array]) -> "Exit":
        return cls(zip(names, has_fallen, strict=True))


def exit_of(margin: Any, number: ArrayLike) -> tuple[Any, ...]:
    """The further argument of a reset after the margin of this index has fallen, if there are several: the index, or an
    `Exit`."""
    if isinstance(margin, dict):
        return (Exit((name, jnp.asarray(number) == k) for k, name in enumerate(margin)),)
    return () if jnp.ndim(margin) == 0 else (jnp.asarray(number),)


class AbstractMode(eqx.Module):
    """A mode of a hybrid system: its equations of motion, its end, and the next mode. Subclass it, declare the
    parameters of your model as attributes, and write functions of a single time and a single state with `jax.numpy`.
    A class attribute such as `names = ("height", "velocity")` names the components of the state.
    You can sweep, fit and differentiate every attribute that is a float or an array. A mode that never ends needs only
    the method `field`.

    **Example:** a ball that falls and bounces.

    ```
    >>> import jax.numpy as jnp
    >>> import nonholonomic
    >>> class Ball(nonholonomic.AbstractMode):
    ...     gravity: float = 9.81
    ...     restitution: float = 0.8
    ...
    ...     def field(self, t, y):
    ...         return jnp.array([y[1], -self.gravity])
    ...
    ...     def margin(self, t, y):
    ...         return y[0]
    ...
    ...     def reset(self, t, y):
    ...         return jnp.array([0.0, -self.restitution * y[1]]), 0
    >>> ball = nonholonomic.Hybrid([Ball()], event=lambda t, y: y[1])
    >>> time = nonholonomic.event_time(ball, jnp.array([1.0, 0.0]), t1=5.0)
    >>> print(f"highest again after {time:.4f} s")
    highest again after 0.8127 s

    ```
    """

    #: Names of the components of the state, such as ("height", "velocity"), in tables and pictures; by default "y0", "y1"
    #: and so on. One mode of a `Hybrid` is enough.
    names: ClassVar[tuple[str, ...] | None] = None

    @abc.abstractmethod
    def field(self, t: Float[Array, ""], y: State) -> State:
        """Rate of change of the state.

        **Arguments:** `t`: time [s]; `y`: state, (components,).

        **Returns:** the rate, (components,).
        """

    def margin(self, t: Float[Array, ""], y: State) -> Margin:
        """A smooth function that is positive while the mode holds and falls through zero where it ends; or several such
        functions, of which the first to fall ends the mode.

        The function may change faster than the motion, as the height above a vibrating table or above waves: no zero is
        missed, unless the function contains an operation without bounds, such as a loop.

        **Arguments:** as for `field`.

        **Returns:** a number; several in an array, (k,), or in a dict by name; or `None`, the default, for a mode that never
        ends.
        """
        return None

    def reset(self, t: Float[Array, ""], y: State) -> Reset:
        """The state and mode that follow when the margin has fallen to zero.

        The margin of the next state may be zero if it then rises, as for a ball that has just bounced.

        **Arguments:** as for `field`, at the end of the mode. If there are several margins, write `reset(self, t, y, exit)`:
        `exit` is the index of the margin that fell in the array, a traced whole number, or for a dict a dict that is true for
        the name of the margin that fell and false for the others. Of margins that fall at the same time, the first one counts,
        and the others follow at once.

        **Returns:** the next state, (components,), and the index of the next mode in `Hybrid.modes`, a whole number
        that may depend on the state; or `None`, the default, if the run ends here.
        """
        return None


# A mechanical system as data: its metric, potential, constraints and forces, and how it strikes its surroundings.

Coordinates = Float[Array, " n"]

#: The input of a run, a function of time, coordinates and rates: u(t, q, q') -> (ports,).
Input = Callable[[Number, Coordinates, Coordinates], ArrayLike]


class AbstractSystem(eqx.Module):
    """A mechanical system with n coordinates and k linear constraints on its velocity.

    Subclass it, declare the numbers of your model as fields, set `dimension` to the number of coordinates, and write functions
    of one set of coordinates: the `metric`, and as needed `potential`, `constraints`, `drift`, `force` and `frame`. The
    equations of motion follow; `nonholonomic.simulate`, `event_time`, `sweep` and `identify` run them. For a system that
    strikes something, write `margin` and `reset` as well.

    Where `metric`, `potential`, `constraints`, `drift` or `lagrangian` depends on time, write the time as the first argument
    and call it `t`, as in `metric(self, t, q)`. Runs of a system with such a function or with a drift, unless as a mode of a
    `Hybrid`, also have the quantities `energy` and `support_power`, the power that moving supports put in. With the drift d,
    the multipliers lambda and the Lagrangian L, this power is lambda.d - dL/dt, and the energy changes by it and by the power
    of the `force`.

    A system with ports, `input(self, q)`, is driven by the `input=` of a run, a function u(t, q, rate) that returns a number
    for each port. Such a run also has these quantities, and `input_power`, which changes the energy too. Close over a long
    table, as in `lambda t, q, rate: jnp.interp(t, times, values)`: every number in an array of an `equinox.Module` is a
    parameter of its own, and thousands of them take minutes to compile.

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
    def dimension(self) -> int:
        """Number n of coordinates."""
        raise ValueError(f"{type(self).__name__} has no dimension: write `dimension = 1`, its number of coordinates")

    @property
    def freedom(self) -> int:
        """Number n - k of independent velocities."""
        q = jax.ShapeDtypeStruct((self.dimension,), jnp.result_type(float))
        return self.dimension - jax.eval_shape(at_time(self, 0.0).constraints, q).shape[0]

    @abc.abstractmethod
    def metric(self, q: Coordinates) -> Float[Array, "n n"]:
        """Kinetic metric G(q): the kinetic energy is q'.G q' / 2."""

    def potential(self, q: Coordinates) -> Float[Array, ""]:
        """Potential energy V(q); zero by default."""
        return jnp.zeros((), q.dtype)

    def constraints(self, q: Coordinates) -> Float[Array, "k n"]:
        """One-forms W(q), one per row, whose products with an allowed velocity are the `drift`, by default zero; no rows by
        default.

        Where they depend on a number of the system, the start has to change with it: the derivative by the number alone is
        that of runs that leave the constraints.
        """
        return jnp.zeros((0, q.size), q.dtype)

    def drift(self, q: Coordinates) -> Float[Array, " k"]:
        """Right-hand side d(q) of the constraints W q' = d, such as the velocity of a turning table under a ball; zero by
        default. It must be continuous in time.

        Where it depends on a number of the system, the start has to change with it, as for `constraints`.
        """
        return jnp.zeros(self.constraints(q).shape[0], q.dtype)

    def frame(self, q: Coordinates) -> Float[Array, "n n"]:
        """Frame fields E(q), one per column; W annihilates the first n - k. By default, the coordinate fields. A system with
        a drift or functions of time cannot have another frame.
        """
        return jnp.eye(q.size, dtype=q.dtype)

    def force(self, t: Number, q: Coordinates, rate: Coordinates) -> Coordinates:
        """Generalised force f(t, q, q') in addition to that of the potential; zero by default."""
        return jnp.zeros_like(q)

    def input(self, q: Coordinates) -> Float[Array, "n ports"]:
        """Ports B(q), one per column: the `input` u of a run adds the generalised force B u and the power u.(B^T q'); no ports
        by default.
        """
        return jnp.zeros((q.size, 0), q.dtype)

    def margin(self, t: Number, q: Coordinates, rate: Coordinates) -> Margin:
        """A smooth function that is positive while the system moves freely and falls through zero where it strikes something,
        such as the distance from a wall; several in an array, (k,), or in a dict by name, of which the first to fall counts;
        `None`, the default, for a system that strikes nothing. The function may change faster than the motion, as for
        `AbstractMode.margin`.
        """
        return None

    def reset(self, t: Number, q: Coordinates, rate: Coordinates) -> tuple[Any, ...] | None:
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
        self, t: Number, q: Coordinates, rate: Coordinates, restitution: Number = 1.0, exit: Any = None
    ) -> Coordinates:
        """The rates after an impact without friction on the surface where the margin is zero.

        The impulse acts along the gradient of the margin with respect to the coordinates; the constraints act at the same
        time, so that the rates obey them before and after. The rate of the margin, which includes the motion of an obstacle
        if the margin depends on time, changes its sign and is multiplied by the restitution (Newton's law of impact). With a
        restitution of 1 and obstacles at rest, the energy is conserved.

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

        def margin(q: Coordinates, t: Number = t) -> Float[Array, ""]:
            margin: Any = self.margin(t, q, rate)
            if isinstance(margin, dict):
                return sum((jnp.where(exit[name], value, 0.0) for name, value in margin.items()), jnp.zeros(()))
            return margin if exit is None else margin[exit]

        now = at_time(self, t)
        gradient = jax.grad(margin)(q)
        metric = with_constraints(now.metric(q), now.constraints(q))
        push = within_constraints(now, q, solve(metric, gradient, positive=True), is_impulse=True)
        approach = gradient @ rate
        if any(dependent_outputs(lambda t: margin(q, t), t)):
            approach += jax.grad(margin, argnums=1)(q, jnp.asarray(t, float))
        return rate - (1.0 + restitution) * approach / (gradient @ push) * push

    def lagrangian(self, q: Coordinates, rate: Coordinates) -> Float[Array, ""]:
        """The Lagrangian L(q, q') = q'.G q' / 2 - V. One of your own may have terms linear in the rates."""
        return 0.5 * rate @ self.metric(q) @ rate - self.potential(q)

    def energy(self, q: Coordinates, rate: Coordinates) -> Float[Array, ""]:
        """Energy q'.dL/dq' - L; for a Lagrangian quadratic in q', kinetic plus potential energy. If a function depends on time,
        read the quantity `energy` of a run.
        """
        return jax.grad(self.lagrangian, argnums=1)(q, rate) @ rate - self.lagrangian(q, rate)


#: The functions of a system that may have the time as a further first argument, and all its functions, with their arguments.
TIMED = dict.fromkeys(("metric", "potential", "constraints", "drift"), "q") | {"lagrangian": "q, rate"}
ARGUMENTS = TIMED | {"frame": "q", "input": "q"} | dict.fromkeys(("force", "margin", "reset"), "t, q, rate")


def is_own(system: object, name: str) -> bool:
    """Whether a system has its own function of this name; a number of this name is none."""
    method = vars(system).get(name, getattr(type(system), name))
    return callable(method) and method is not getattr(AbstractSystem, name)


def takes_time(system: object, name: str) -> bool:
    """Whether a method in `TIMED` has the time as its first argument."""
    return is_own(system, name) and next(iter(inspect.signature(getattr(system, name)).parameters), "") == "t"


def written(system: object, name: str) -> str:
    """A method and its arguments."""
    return f"{name}({'t, ' * (name in TIMED and takes_time(system, name))}{ARGUMENTS[name]})"


def is_driven(system: object) -> bool:
    """Whether this is a mechanical system with a drift or functions of time, apart from its force."""
    is_mechanical = isinstance(system, AbstractSystem)
    return is_mechanical and (is_own(system, "drift") or any(takes_time(system, name) for name in TIMED))


class SystemAtTime:
    """A system at one time [s], whose functions are those of the coordinates and rates alone."""

    def __init__(self, system: AbstractSystem, time: Number):
        self.system, self.time = system, time

    def __getattr__(self, name: str) -> Callable[..., Array]:
        if name in TIMED and is_own(self.system, name):
            function = getattr(self.system, name)
            return functools.partial(function, self.time) if takes_time(self.system, name) else function
        # Any other function of a system, such as the energy, calls those at the time.
        return getattr(AbstractSystem, name).__get__(self)


def at_time(system: AbstractSystem, t: Number) -> AbstractSystem | SystemAtTime:
    """A system whose functions are those of the coordinates and rates alone: the system itself if none depends on time."""
    return SystemAtTime(system, t) if any(takes_time(system, name) for name in TIMED) else system


def within_constraints(
    system: AbstractSystem | SystemAtTime, q: Coordinates, rate: Coordinates, is_impulse: bool = False
) -> Coordinates:
    """The rates closest to some rates, in the kinetic metric, that the constraints allow.

    **Arguments:** `system`: at a time; `is_impulse`: whether the rates are a change, on which the drift has no effect.
    """
    W = system.constraints(q)
    if not W.shape[0]:
        return rate
    per_impulse = solve(with_constraints(system.metric(q), W), W.T, positive=True)
    excess = W @ rate if is_impulse else W @ rate - system.drift(q)
    return rate - per_impulse @ solve(W @ per_impulse, excess, positive=True)


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


def lie_brackets(fields: Callable[[Coordinates], Float[Array, "n m"]], q: Coordinates) -> Float[Array, "n m m"]:
    """Lie brackets of vector fields: component i of [X_a, X_b] = (X_a.d) X_b - (X_b.d) X_a at [i, a, b].

    **Arguments:**

    - `fields`: function of the coordinates (n,) that returns m fields as the columns of an (n, m) array.
    - `q`: coordinates at which to evaluate, (n,).
    """
    derivatives = jnp.einsum("ibk,ka->iab", jax.jacfwd(fields)(q), fields(q))
    return derivatives - jnp.swapaxes(derivatives, 1, 2)


class AbstractFormulation(AbstractMode):
    """Equations of motion of a system, as a first-order field of their own state; a mode of a hybrid system.

    **Arguments:**

    - `system`: the data, an `AbstractSystem`.
    - `input`: a function u(t, q, q') -> (ports,) that acts through the ports of the system, or `None`, the default.
    """

    system: AbstractSystem
    input: Input | None = eqx.field(default=None, kw_only=True)

    @abc.abstractmethod
    def state(self, q: Coordinates, rate: Coordinates) -> Float[Array, " state"]:
        """The state for coordinates and velocity, each (n,); the velocity must obey the constraints."""

    @abc.abstractmethod
    def split(self, state: Float[Array, " state"]) -> tuple[Coordinates, Coordinates]:
        """Coordinates and velocity, each (n,), of a state."""

    def input_force(self, t: Number, q: Coordinates, rate: Coordinates) -> Coordinates:
        """The generalised force of the input."""
        if self.input is None:
            return jnp.zeros_like(q)
        return self.system.input(q) @ jnp.atleast_1d(jnp.asarray(self.input(t, q, rate)))

    def force(self, t: Number, q: Coordinates, rate: Coordinates) -> Coordinates:
        """The generalised force of the system and of the input."""
        return self.system.force(t, q, rate) + self.input_force(t, q, rate)

    def acceleration(self, t: Number, q: Coordinates, rate: Coordinates) -> Coordinates:
        """Second derivative of the coordinates, by the chain rule through this formulation's state."""
        state = self.state(q, rate)
        return jax.jvp(self.split, (state,), (self.field(jnp.asarray(t), state),))[1][1]

    def margin(self, t: Number, y: State) -> Margin:
        return self.system.margin(t, *self.split(y))

    def reset(self, t: Number, y: State, *exit: Any) -> tuple[Any, ...] | None:
        """The state after a reset, and the index of the next mode if the system names it."""
        system: Any = self.system
        following = system.reset(t, *self.split(y), *exit)
        return None if following is None else (self.state(*following[:2]), *following[2:])

    def entered(self, t: Number, y: State) -> State:
        """The state after a reset to this mode, with rates that obey the constraints."""
        q, rate = self.split(y)
        return self.state(q, within_constraints(at_time(self.system, t), q, rate))


def components_of(mode: object, y: State) -> State:
    """A state in the user's components, which are coordinates and their rates for a mechanical system."""
    return jnp.concatenate(mode.split(y)) if isinstance(mode, AbstractFormulation) else y


class Hamel(AbstractFormulation):
    """Poincare's equations in quasi-velocities u, q' = E u (`stroller.md`, section 6, F2).

    With l(q, u) = L(q, E u) and p = dl/du, p_i' = E_i(l) + c^k_ji u^j p_k + E_i.f. Constraints remove the equations and
    the quasi-velocities of the frame's last fields, but not their momenta, which carry the nonholonomic terms (Hamel).
    The Lagrangian may have terms linear in the velocity, as that of a Routhian has. The state is (q, u).

    **Arguments:** as for `AbstractFormulation`.
    """

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

    def field(self, t: Number, y: State, args=None) -> State:
        system, free = self.system, self.system.freedom
        q, u = self.quasi_velocity(y)
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
        forces = E.T @ (jax.grad(lagrangian)(q, u) + self.force(t, q, rate)) + gyroscopic - swell
        return jnp.concatenate([rate, solve(inertia, forces[:free], positive=True)])


class Lagrange(AbstractFormulation):
    """Lagrange's equations with multipliers, G q'' + G' q' = dL/dq + f + W^T lambda, with W q'' + W' q' = d'.

    The primes of G, W and the drift d are derivatives along the motion, which includes the passing of time. With a Lagrangian
    of its own, a system has the Hessian of L in place of G, and the derivative of dL/dq' at constant rates in place of G' q'.
    The state is (q, q'), so one linear system with the metric is solved for the force and the rows of W together. The metric
    may be singular if it is positive for the allowed rates, as with parts without mass. Source: `stroller.md`, section 6, F1.

    **Arguments:** as for `AbstractFormulation`.
    """

    def state(self, q: Coordinates, rate: Coordinates) -> Float[Array, " state"]:
        return jnp.concatenate([q, rate])

    def split(self, state: Float[Array, " state"]) -> tuple[Coordinates, Coordinates]:
        q, rate = jnp.split(state, 2)
        return q, rate

    def field(self, t: Number, y: State, args=None) -> State:
        q, rate = self.split(y)
        return jnp.concatenate([rate, self.acceleration(t, q, rate)])

    def acceleration(self, t: Number, q: Coordinates, rate: Coordinates) -> Coordinates:
        system, has_drift, has_lagrangian = self.system, is_own(self.system, "drift"), is_own(self.system, "lagrangian")

        def seen(q: Coordinates, t: ArrayLike = t) -> tuple[Array, Array, Array | None]:
            now = at_time(system, t)
            W = now.constraints(q)
            inertia = jax.grad(now.lagrangian, argnums=1)(q, rate) if has_lagrangian else now.metric(q)
            return W, inertia, now.drift(q) if has_drift else None

        now = at_time(system, t)
        times = () if now is system else (jnp.asarray(t, float),)
        (W, G, _), (bend, swell, pull) = jax.jvp(seen, (q, *times), (rate, *map(jnp.ones_like, times)))
        free = jax.grad(now.lagrangian)(q, rate) + self.force(t, q, rate)
        free -= swell if has_lagrangian else swell @ rate
        G = jax.hessian(now.lagrangian, argnums=1)(q, rate) if has_lagrangian else G
        # The masses may jump in time without an effect on the motion: as a traced function, they are known for it.
        mass = with_constraints(G, W) if now is system else jax.jit(with_constraints)(G, W)
        per_mass = solve(mass, jnp.column_stack([W.T, free]), positive=True)
        by_constraints, unconstrained = per_mass[:, :-1], per_mass[:, -1]
        per_multiplier, excess = W @ by_constraints, bend @ rate + W @ unconstrained
        excess = excess if pull is None else excess - pull
        return unconstrained - by_constraints @ solve(per_multiplier, excess, positive=True)


def formulation_of(system: AbstractSystem, input: Input | None = None) -> AbstractFormulation:
    """The equations of motion for a mechanical system and its input.

    If the system has its own frame, or no constraints and its own Lagrangian (which may have terms linear in the velocities),
    the equations are in quasi-velocities, which obey the constraints exactly; otherwise, and with a drift or functions of time,
    they use Lagrange multipliers.
    """
    is_free = is_own(system, "lagrangian") and system.freedom == system.dimension
    is_hamel = (is_own(system, "frame") or is_free) and not is_driven(system)
    return Hamel(system, input=input) if is_hamel else Lagrange(system, input=input)


def energy_balance(
    system: AbstractSystem, input: Input | None, t: Number, q: Coordinates, rate: Coordinates
) -> tuple[Float[Array, ""], Float[Array, ""], Float[Array, ""]]:
    """The energy E, the power lambda.d - dL/dt that moving supports put in, and the power of the input.

    The power of the supports is dE/dt - f.q': from d/dt(dL/dq') = dL/dq + f + W^T lambda and E = q'.dL/dq' - L follows
    dE/dt = q'.f + lambda.W q' - dL/dt, and the constraints are W q' = d.
    """
    equations = Lagrange(system, input=input)
    point = (jnp.asarray(t, float), q, rate)
    direction = (np.ones(()), rate, equations.acceleration(t, q, rate))
    energy, change = jax.jvp(lambda t, q, rate: at_time(system, t).energy(q, rate), point, direction)
    powers = [jnp.sum(force(t, q, rate) * rate) for force in (equations.force, equations.input_force)]
    return energy, change - powers[0], powers[1]


# Whether runs of a user's system may start: rules for concrete and traced numbers, and their messages.

#: How far the margin may be below zero at the start, in units of the greatest component of the start or, if that is less
#: than 1, of 1; and the largest relative violation of the constraints. In single precision, both are greater.
OUTSIDE = VIOLATION = 1e-9

#: Round-off of the rules in units of the precision of a number of size 1.
ROUND_OFF = 64.0

#: The rules in the order in which the first broken one is reported.
RULES = ("start", "finite", "symmetry", "rank", "metric", "constraints", "frame", "margin")

#: What the rules compare, by name; for several cells, the cells are along the first axis.
Parts = dict[str, Any]


def parts_of_system(system: AbstractSystem, q: Coordinates, rate: Coordinates) -> Parts:
    """What the rules compare of a mechanical system at time 0: its metric, constraints, drift and frame."""
    now = at_time(system, 0.0)
    metric = jax.hessian(now.lagrangian, argnums=1)(q, rate) if is_own(system, "lagrangian") else now.metric(q)
    W = now.constraints(q)
    parts = {"metric": metric, "constraints": W}
    if is_own(system, "drift"):
        parts["drift"] = now.drift(q)
    elif W.shape[0] and system.freedom and isinstance(formulation_of(system), Hamel):
        parts["frame"] = W @ system.frame(q)[:, : system.freedom]
    return parts


@np.errstate(all="ignore")
def rooms(parts: Parts, xp: ModuleType) -> Parts:
    """The room that each rule leaves: name of a rule in `RULES` -> a number below zero, or NaN, where the start breaks it.

    **Arguments:** `parts`: those of one start or of many; `xp`: `numpy` or `jax.numpy`. For a few starts, NumPy saves the
    time to compile.
    """
    y = parts["y"]
    round_off = ROUND_OFF * float(jnp.finfo(y.dtype).eps)
    exact = max(VIOLATION, round_off)
    left = {"start": 0.0 * xp.sum(y, axis=-1)}
    if "margin" in parts:
        left["margin"] = parts["margin"] + max(OUTSIDE, round_off) * xp.maximum(1.0, _greatest(xp, y, 1))
    if "metric" not in parts:
        return left
    G, W, n = parts["metric"], parts["constraints"], parts["metric"].shape[-1]
    left["finite"] = 0.0 * (xp.sum(G, axis=(-1, -2)) + xp.sum(W, axis=(-1, -2)))
    # In units in which each coordinate with a mass has a mass of 1, the rules do not depend on the user's units.
    # Pages and components know no primitive for a diagonal.
    identity = xp.eye(n, dtype=G.dtype)
    unit = xp.sqrt(xp.abs(xp.sum(G * identity, axis=-1)))
    unit = xp.where(unit > 0.0, unit, 1.0)
    scaled = G / (unit[..., :, None] * unit[..., None, :])
    left["symmetry"] = exact - _greatest(xp, scaled - scaled.swapaxes(-1, -2), 2)
    # Projectors on the allowed directions and on the others, by orthonormal rows: batches of LAPACK inside a compiled program
    # can deadlock.
    allowed, others = xp.broadcast_to(identity, G.shape), xp.zeros_like(G)
    independent = xp.ones_like(left["finite"])
    for k in range(W.shape[-2]):
        row = _unit(xp, W[..., k, :] / unit)
        part = _projected(allowed, row)
        independent = xp.minimum(independent, xp.sqrt(xp.sum(part * part, axis=-1)))
        # The second projection removes the round-off of the first.
        part = _unit(xp, _projected(allowed, _unit(xp, part)))
        square = part[..., :, None] * part[..., None, :]
        allowed, others = allowed - square, others + square
    if W.shape[-2]:
        rate, greatest = parts["y"][..., n:], _greatest(xp, W, 2)
        left["rank"] = independent - round_off ** (2.0 / 3.0)
        violation = _projected(W, rate)
        if "drift" in parts:
            left["finite"] = left["finite"] + 0.0 * xp.sum(parts["drift"], axis=-1)
            violation = violation - parts["drift"]
        left["constraints"] = exact * greatest * _greatest(xp, rate, 1) - _greatest(xp, violation, 1)
        if "frame" in parts:
            left["frame"] = exact * greatest - _greatest(xp, parts["frame"], 2)
    left["metric"] = _least_pivot(xp, allowed @ scaled @ allowed + others) - n * round_off
    return left


def _greatest(xp: ModuleType, values: Array, axes: int) -> Array:
    """The greatest magnitude along the last axes."""
    return xp.max(xp.abs(values), axis=tuple(range(-axes, 0)), initial=0.0)


def _projected(matrix: Array, vector: Array) -> Array:
    return (matrix @ vector[..., None])[..., 0]


def _unit(xp: ModuleType, vector: Array) -> Array:
    return vector / xp.sqrt(xp.sum(vector * vector, axis=-1))[..., None]


def _least_pivot(xp: ModuleType, matrix: Array) -> Array:
    """The least pivot of a symmetric matrix, which is positive if and only if the matrix is positive definite."""
    least = matrix[..., 0, 0]
    while matrix.shape[-1] > 1:
        pivot, column = matrix[..., 0, 0], matrix[..., 1:, 0]
        matrix = matrix[..., 1:, 1:] - column[..., :, None] * (column / pivot[..., None])[..., None, :]
        least = xp.minimum(least, matrix[..., 0, 0])
    return least


def problem_of_start(parts: Parts, rule: str, named: Callable[[str], str]) -> str:
    """What is wrong with a start that breaks a rule. **Arguments:** `named`: writes a function with its arguments."""
    if rule == "start":
        return f"start = {parts['y']} must be finite"
    if rule == "margin":
        return f"start: the margin of the first mode is {parts['margin']:.4g}, below zero; start where the margin is positive"
    W, G = parts["constraints"], parts["metric"]
    n, k = len(G), len(W)
    if rule == "finite":
        name = next(name for name in ("metric", "constraints", "drift") if not np.isfinite(parts[name]).all())
        return f"{named(name)} = {parts[name].tolist()} at the start must be finite"
    if rule == "symmetry":
        return f"{named('metric')} = {G.tolist()} at the start must be symmetric"
    if rule == "constraints":
        rate, right = parts["y"][n:], named("drift") if "drift" in parts else "0"
        error = np.max(np.abs(W @ rate - parts.get("drift", 0.0)))
        return f"start: rate = {rate} violates the constraints by {error:.3g}; {named('constraints')} @ rate must be {right}"
    if rule == "frame":
        return (
            f"{named('frame')}: the constraints must annihilate its first {n - k} columns, and do so only up to "
            f"{np.max(np.abs(parts['frame'])):.3g}; leave it out to run with Lagrange multipliers"
        )
    lengths = np.linalg.norm(W, axis=1, keepdims=True)
    spanned = np.linalg.svd(W / np.where(lengths > 0.0, lengths, 1.0)) if k else (None, np.zeros(0), np.eye(n))
    if rule == "rank":
        return (
            f"{named('constraints')} has {k} rows of rank {(spanned[1] > VIOLATION).sum()} at the start, and its rows must be "
            "independent: leave out those that follow from the others"
        )
    allowed = spanned[2][k:]
    least = np.linalg.eigvalsh(allowed @ G @ allowed.T)[0]
    return (
        f"{named('metric')} must be positive for all rates that the constraints allow, and its least eigenvalue for them is "
        f"{least:.4g} at the start: a mass or a moment of inertia may be zero or negative, or the coordinates singular there"
    )
