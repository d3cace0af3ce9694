"""Rides as problems."""

import dataclasses
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from nonholonomic.geometry import Plane
from nonholonomic.integration import AbstractProblem, Jumps
from nonholonomic.lanes.objects import Held
from nonholonomic.per_run import is_array, is_users, parted

from .dynamics import Dynamics, State
from .heading import Projected
from .input import Formula, Input, at_start, is_searched, jump_times
from .launch import Launch
from .per_ride import MOST_ELEMENTS, PerRide
from .scene import Scene

#: Reduced mass, relative to its largest value, below which the constraints count as having lost rank.
RANK_LOST = 1e-8

#: Largest pull on the ground, relative to the weight, that counts as round-off.
CONTACT_ROUND_OFF = 1e-12


class RideProblem(AbstractProblem):
    """One ride, or the rides of many cells. If `watched`, the event is that the ground would have to pull; if
    `guarded`, a ride ends when the constraints lose rank.
    """

    dynamics: Dynamics
    input: Input | None
    states: Float[Array, "components *cells"]
    scales: Float[Array, "components *cells"]
    press: Float[Array, "..."]
    watched: bool = eqx.field(static=True)
    guarded: bool = eqx.field(static=True)
    jump_times: Float[Array, "jumps *cells"] | None = None

    @property
    def fits_one_kernel(self) -> bool:
        return not isinstance(self.input, PerRide) or self.input.by_elements

    @classmethod
    def single(
        cls,
        scene: Scene,
        launch: Launch,
        controls: Input | None,
        jumps: tuple[Array, ...] = (),
        cells: int | None = None,
    ) -> "RideProblem":
        """The problem of one ride, which continues if contact or rank is lost. **Arguments:** `jumps`: times at which the
        input jumps, apart from those that its comparisons of the time show."""
        driven = controls is not None
        press = scene.body.mass * (scene.gravity + launch.speed**2 / scene.body.wheelbase + 1e-3)
        start = (scene.state(launch, driven), scene.scales(launch, driven))
        times = None
        if controls is not None and (jumps or is_searched(controls)):
            t, motion = eqx.filter_eval_shape(at_start, scene, launch)
            t, motion = jax.tree.map(lambda part: jnp.zeros((), part.dtype), (t, motion))
            times = jump_times(controls, jumps, t, motion, cells)
        return cls(scene.dynamics, controls, *start, press, False, False, times)

    @classmethod
    def of(
        cls,
        scene: Scene,
        launch: Launch,
        controls: Input | None,
        cells: int,
        watched: bool,
        jumps: tuple[Array, ...] = (),
    ) -> "RideProblem":
        """The problem of the given number of cells; every number is a scalar or one per cell."""

        def spread(states):
            return jnp.broadcast_to(states.reshape(states.shape[0], -1), (states.shape[0], cells))

        if isinstance(controls, Formula) and has_arrays(controls):
            t, motion = eqx.filter_eval_shape(at_start, scene, launch)
            of_one_ride = jax.tree.map(lambda part: jax.ShapeDtypeStruct((), part.dtype), (t, motion))
            controls = PerRide.of(controls, *of_one_ride).of_cells(cells)
        ride = cls.single(scene, launch, controls, jumps, cells)
        guarded, watched = (
            isinstance(ride.dynamics.heading, Projected),
            watched and not isinstance(scene.surface, Plane),
        )
        columns = {"states": spread(ride.states), "scales": spread(ride.scales)}
        return dataclasses.replace(ride, **columns, watched=watched, guarded=guarded)

    def start(self) -> tuple[Float[Array, "components *cells"], Float[Array, "components *cells"]]:
        return self.states, self.scales

    def field(self, time: Float[Array, "..."], state: State) -> Any:
        return self.dynamics.field(time, state, self.input)

    def event_function(self, state: State) -> Any:
        return self.dynamics.contact(state) / self.press + CONTACT_ROUND_OFF if self.watched else None

    def crossing_along(self, state: State, rate: State) -> Any:
        return self.dynamics.contact_along(state, rate) / self.press + CONTACT_ROUND_OFF if self.watched else None

    def domain_margin(self, time: Float[Array, "..."], state: State) -> Any:
        return self.dynamics.rank(state) / RANK_LOST - 1.0 if self.guarded else None

    def jumps(self, time: Float[Array, "..."], state: State) -> Jumps | None:
        return None if self.jump_times is None else Jumps.at(self.jump_times)


def as_module(controls: Input | None, scene: Scene, launch: Launch) -> Any:
    """An input as a module whose numbers are leaves, evaluated for single rides. A function, or a module with many numbers, is
    traced once, with scalar arguments."""
    if controls is None or isinstance(controls, Held | Formula):
        return controls
    if isinstance(controls, eqx.Module):
        if not (is_users(type(controls)) or has_arrays(controls)):
            return controls
        if numbers_in(controls) <= MOST_ELEMENTS:
            return Held(parted(controls))

    def motion(scene: Scene, launch: Launch) -> Any:
        return scene.dynamics.geometry(scene.state(launch, True)).motion

    single: Any = controls
    return Formula.of(single, jnp.zeros(()), eqx.filter_eval_shape(motion, scene, launch))


def numbers_in(tree: Any) -> int:
    """How many numbers a tree holds."""
    return sum(np.size(leaf) for leaf in jax.tree.leaves(tree) if is_array(leaf))


def has_arrays(tree: Any) -> bool:
    """Whether some leaf is an array with axes."""
    return any(eqx.is_array(leaf) and leaf.ndim > 0 for leaf in jax.tree.leaves(tree))
