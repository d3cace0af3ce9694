"""Inputs of the stroller: functions of time and motion that return the drive force and the steering torque.

An input is any function `(t, motion) -> (force, torque)`. Its arguments are arrays of any shape, with one number per
lane, so write it with `jax.numpy` and without `if`. Use an `equinox.Module` for parameters to sweep or differentiate.
"""

import contextlib
import dataclasses
import functools
import inspect
from collections.abc import Callable
from typing import Any, ClassVar, NamedTuple, TypeAlias

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.extend.core import ClosedJaxpr, jaxpr_as_fun
from jaxtyping import Array, Float, PyTree

from nonholonomic.compilation.components import Held, TooLarge, by_components, over_last_axis
from nonholonomic.compilation.tracing import TracedFunction, in_cells, is_elementary, jumps_of, warn_of_unclear
from nonholonomic.compilation.xla_cpu import with_constants_first
from nonholonomic.geometry import Vector
from nonholonomic.text import described, is_users, likely, name_of, shown
from nonholonomic.validation import Bounded, as_number, is_traced


class Motion(NamedTuple):
    """The parts of the stroller's state that an input can use.

    `position` [m] of the rear axle and `heading` [1], a unit vector, are tuples of components in the ground's axes, the
    third `None` on a plane; `steering` [rad], `speed` [m/s] of the rear axle, `front_speed` [m/s] at which the front
    wheel rolls, `yaw_rate` [rad/s] and `steering_rate` [rad/s], positive to the driver's left.

    **Example:**

    ```
    >>> import stroller
    >>> body = stroller.Stroller(mass=12.0, wheelbase=0.7, inertia=1.5, steering_inertia=0.05)
    >>> scene = stroller.Scene(body, friction=stroller.Damping(2.0, 1.0, 0.2, 0.05))
    >>> launch = stroller.Launch(place=(0.0, 0.0), heading=0.3, speed=2.0)
    >>> def cruise(t, motion):
    ...     return 5.0 * (2.0 - motion.speed), -motion.steering - 0.3 * motion.steering_rate
    ...
    >>> run = stroller.simulate(scene, launch, 1.0, cruise, times=[0.5, 1.0], tolerance=1e-6)
    >>> print(f"{run.speed[-1]:.2f} m/s")
    1.64 m/s

    ```
    """

    position: Vector
    heading: Vector
    steering: Float[Array, "..."]
    speed: Float[Array, "..."]
    front_speed: Float[Array, "..."]
    yaw_rate: Float[Array, "..."]
    steering_rate: Float[Array, "..."]

    def __getattr__(self, name: str) -> Any:
        if name.startswith("_"):
            raise AttributeError(name)
        hint = "; did you mean 'speed'?" if name in ("v", "velocity") else likely(name, self._fields) or "."
        raise AttributeError(f"the motion has no {name!r}{hint} It has {', '.join(self._fields)}")


Input: TypeAlias = Callable[[Float[Array, "..."], Motion], tuple[Float[Array, "..."], Float[Array, "..."]]]


class Steady(Bounded):
    """A constant drive force and steering torque.

    **Arguments:**

    - `force`: drive force [N] along the heading at the rear axle.
    - `torque`: torque [N m] of the frame on the fork, positive to the driver's left.

    **Example:**

    ```
    >>> import stroller
    >>> stroller.Steady(force=1.0, torque=0.1)
    Steady(force=1 N, torque=0.1 N m)

    ```
    """

    units: ClassVar[dict[str, str]] = {"force": "N", "torque": "N m"}

    force: Float[Array, "..."] = eqx.field(converter=as_number, default=0.0)
    torque: Float[Array, "..."] = eqx.field(converter=as_number, default=0.0)

    def __call__(self, t: Float[Array, "..."], motion: Motion) -> tuple[Float[Array, "..."], Float[Array, "..."]]:
        return self.force, self.torque


#: Description of an input for messages.
WANTED = "a function (t, motion) -> (drive force [N], steering torque [N m])"


@eqx.filter_jit
def at_start(scene: Any, launch: Any) -> tuple[Float[Array, ""], Motion]:
    """The arguments of an input at the start of a ride: time and motion."""
    state = scene.state(launch, True)
    return jnp.zeros(()), scene.dynamics.geometry(state).motion


def example_arguments(scene: Any, launch: Any) -> tuple[Float[Array, ""], Motion]:
    """Arguments of an input in a single ride, whose values do not matter, also for a launch of many cells."""
    return jax.tree.map(lambda part: jnp.zeros((), part.dtype), eqx.filter_eval_shape(at_start, scene, launch))


def check_input(controls: Any, scene: Any, launch: Any, jumps: object = None) -> None:
    """Raise `ValueError` unless an input can be called, traced by JAX, and is finite at the start of a run; warn of
    comparisons of the time whose jumps are unknown.

    **Arguments:**

    - `controls`: an input, or `None`.
    - `scene`, `launch`: scene and launch of the ride, with concrete or traced numbers.
    - `jumps`: times at which the input jumps, or `None`.
    """
    if controls is None:
        if jumps is not None:
            raise ValueError(f"jumps = {shown(jumps)} must be None without an input: the input is what jumps")
        return
    if not callable(controls):
        raise ValueError(f"input = {shown(controls)} must be {WANTED}, or None")
    t, motion = at_start(scene, launch)
    name = f"input = {name_of(controls)}"
    try:
        inspect.signature(controls).bind(t, motion)
    except TypeError as error:
        raise ValueError(f"{name} must be {WANTED}: {error}") from None
    try:
        result = jax.eval_shape(controls, t, motion)
        shapes = [np.shape(part) for part in result] if isinstance(result, tuple | list) else None
    except (TypeError, IndexError) as error:
        problem = "must return (drive force [N], steering torque [N m])"
        if isinstance(error, jax.errors.JAXTypeError):
            problem = "cannot be traced by JAX: write it with jax.numpy, and jnp.where in place of `if`"
        raise ValueError(f"{name} {problem} ({str(error).strip().splitlines()[0]})") from error
    if shapes != [(), ()]:
        got = described(result) if shapes is None else f"shapes {shapes}"
        raise ValueError(f"{name} must return one drive force [N] and one steering torque [N m], as a pair, not {got}")
    values = jax.tree.leaves(controls(t, motion))
    if not any(is_traced(part) for part in values) and not np.all(np.isfinite([float(part) for part in values])):
        numbers = ", ".join(f"{float(part):g}" for part in values)
        raise ValueError(f"{name} must be finite: at the start it gives ({numbers})")
    if jumps is None and is_searched(controls):
        remedy = ", or pass the times of the jumps as jumps=[...], which is [] if there are none"
        warn_of_unclear("input(t, motion)", controls, motion, remedy=remedy)


def as_jumps(jumps: Any) -> tuple[Array, ...]:
    """The times at which an input jumps, as a tuple of numbers; raises `ValueError` unless they are a list of times."""
    times = () if jumps is None else jumps
    if not isinstance(times, list | tuple) and getattr(times, "ndim", None) != 1:
        raise ValueError(f"jumps = {shown(jumps)} must be a list of times [s] at which the input jumps, or None")
    return tuple(map(as_number, times))


def is_searched(controls: object) -> bool:
    """Whether an input is a user's, so that its comparisons of the time are searched for jumps; those of plans are smooth."""
    if isinstance(controls, Held | PerRide):
        return is_searched(controls.function)
    return is_users(type(users_input(controls)))


def users_input(controls: object) -> object:
    """An input before it was traced."""
    return controls.program.function if isinstance(controls, Formula) else controls


def jump_times(
    controls: PyTree, jumps: tuple[Array, ...], t: Float[Array, ""], motion: Motion, cells: int | None
) -> Float[Array, "jumps *cells"] | None:
    """The times at which an input may jump: those given, and those of its comparisons of the time; `None` if there are none.

    **Arguments:** `controls`: an input as a module, with the cells in the last axis of its arrays if there are cells; `jumps`:
    given times, scalars or (cells,); `t`, `motion`: the types of its arguments, scalars.
    """
    arrays, static = eqx.partition(controls, eqx.is_inexact_array)
    shape, times = () if cells is None else (cells,), None
    if is_searched(controls):
        times = in_cells(lambda arrays: jumps_of(eqx.combine(arrays, static), t, motion)[0], arrays, shape)
    rows = [*(() if times is None else times), *(jnp.broadcast_to(time, shape) for time in jumps)]
    return jnp.stack(rows) if rows else None


def has_arrays(tree: PyTree) -> bool:
    """Whether some leaf is an array with axes."""
    return any(eqx.is_array(leaf) and leaf.ndim > 0 for leaf in jax.tree.leaves(tree))


class Formula(eqx.Module):
    """An input module made from a function. The arrays in the function are leaves, `held`, and its operations are compared one
    by one; `program` also has the function itself.

    If you define the same function again, as in a notebook's cell, it is not compiled again.
    """

    held: tuple[Array, ...]
    program: TracedFunction = eqx.field(static=True)

    @classmethod
    def of(cls, controls: Input, t: Float[Array, ""], motion: Motion) -> "Formula":
        """The formula of a function, with arguments such as these."""
        closed = jax.make_jaxpr(lambda *arguments: tuple(map(as_number, controls(*arguments))))(t, motion)
        return cls(tuple(closed.consts), TracedFunction(controls, with_constants_first(closed)))

    def __call__(self, t: Float[Array, "..."], motion: Motion) -> tuple[Float[Array, "..."], Float[Array, "..."]]:
        leaves = jnp.broadcast_arrays(*jax.tree.leaves((t, motion)))
        run = functools.partial(jaxpr_as_fun(self.program.program), *self.held)
        for _ in range(leaves[0].ndim):
            run = jax.vmap(run)
        return tuple(run(*leaves))

    def of_cells(self, cells: int, t: Float[Array, ""], motion: Motion) -> "PerRide":
        """The input for a number of rides, with arguments such as these. A number or an array of the function may be one for
        all rides, or have the rides in its first axis."""
        of_one, of_all, program = [], [], self.program.program
        assert isinstance(program, ClosedJaxpr)
        for part, own in zip(self.held, program.in_avals, strict=False):
            differs = part.ndim > own.ndim
            of_one.append(part[0] if differs else part)
            spreads = eqx.is_inexact_array(part) and part.ndim
            shared = jnp.broadcast_to(part[..., None], (*part.shape, cells)) if spreads else part
            of_all.append(jnp.moveaxis(part, 0, -1) if differs else shared)
        by_elements = PerRide.of(dataclasses.replace(self, held=tuple(of_one)), t, motion).by_elements
        return PerRide(dataclasses.replace(self, held=tuple(of_all)), by_elements)


# Inputs that are written for a single ride, for many rides at once.

#: Inputs with more numbers than this stay in arrays: element by element they would take long to compile.
MOST_ELEMENTS = 256


class PerRide(eqx.Module):
    """An input that is evaluated ride by ride. For many rides, its arrays, such as the knots of a spline or the weights of a
    network, have the rides in the last axis; its scalars have one value per ride or one for all.

    - `by_elements`: whether every number of an array is a vector of rides; larger inputs stay in arrays.
    """

    function: Any
    by_elements: bool = eqx.field(static=True)

    @classmethod
    def of(cls, controls: PyTree, t: Float[Array, ""], motion: Motion) -> "PerRide":
        """The input of a single ride, with arguments such as these."""
        arrays, static = eqx.partition(controls, eqx.is_inexact_array)
        if sum(leaf.size for leaf in jax.tree.leaves(arrays)) > MOST_ELEMENTS:
            return cls(controls, False)

        def of_ride(arrays: PyTree[Array], moving: Any) -> Any:
            return eqx.combine(arrays, static)(*moving)

        example = (arrays, (t, motion))
        with contextlib.suppress(TooLarge):
            jax.eval_shape(by_components(of_ride, *example), *example)
            return cls(controls, is_elementary(of_ride, *example))
        return cls(controls, False)

    def __call__(self, t: Float[Array, "..."], motion: Motion) -> tuple[Float[Array, "..."], Float[Array, "..."]]:
        shape = np.broadcast_shapes(*map(jnp.shape, jax.tree.leaves((t, motion))))
        if shape == ():
            return self.function(t, motion)
        moving = jax.tree.map(lambda part: jnp.broadcast_to(part, shape), (t, motion))
        arrays, static = eqx.partition(self.function, eqx.is_inexact_array)

        def of_ride(arrays: PyTree[Array], moving: Any) -> Any:
            return tuple(eqx.combine(arrays, static)(*moving))

        own = jax.tree.map(lambda part: jax.ShapeDtypeStruct(part.shape[:-1], part.dtype), (arrays, moving))
        over_rides = by_components if self.by_elements else over_last_axis
        results = over_rides(of_ride, *own)(arrays, moving)
        return jax.tree.map(lambda part: jnp.broadcast_to(part, shape), results)
