"""Rides as problems, their specifications, and runs inside transformations."""

import dataclasses
from typing import Any, NamedTuple

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from nonholonomic.derivatives import SampledRun, sampled_run, sampled_run_by_diffrax
from nonholonomic.geometry import Plane
from nonholonomic.integration import AbstractProblem, Settings
from nonholonomic.integration.status import REACHED_END

from ..model.dynamics import Dynamics, State
from ..model.heading import Projected
from ..model.input import Formula, Input, at_start
from ..model.launch import Launch
from ..model.per_ride import PerRide
from ..model.scene import Scene

#: Reduced mass, relative to its largest value, below which the constraints count as having lost rank.
RANK_LOST = 1e-8

#: The coefficient of friction [1] that no tyre exceeds on a dry road: 0.7 to 1.0 is usual, and 1.8 is that of racing slicks
#: (Milliken and Milliken, Race Car Vehicle Dynamics (1995), chapter 2).
MOST_GRIP = 1.8

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

    @property
    def fits_one_kernel(self) -> bool:
        return not isinstance(self.input, PerRide) or self.input.by_elements

    @classmethod
    def single(cls, scene: Scene, launch: Launch, controls: Input | None) -> "RideProblem":
        """The problem of one ride, which continues if contact or rank is lost."""
        driven = controls is not None
        press = scene.body.mass * (scene.gravity + launch.speed**2 / scene.body.wheelbase + 1e-3)
        start = (scene.state(launch, driven), scene.scales(launch, driven))
        return cls(scene.dynamics, controls, *start, press, False, False)

    @classmethod
    def of(cls, scene: Scene, launch: Launch, controls: Input | None, cells: int, watched: bool) -> "RideProblem":
        """The problem of the given number of cells; every number is a scalar or one per cell."""

        def spread(states):
            return jnp.broadcast_to(states.reshape(states.shape[0], -1), (states.shape[0], cells))

        ride = cls.single(scene, launch, controls)
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


class Stats(NamedTuple):
    """Numbers of accepted and rejected steps, and whether the integration reached its end."""

    steps: Int[Array, ""]
    rejected: Int[Array, ""]
    finished: Bool[Array, ""]


class Ride(NamedTuple):
    """A ride and the options of its integration. `t1`: end [s]; `grid`: the ends of the steps [s] of a solver without
    an error estimate."""

    scene: Scene
    launch: Launch
    input: Input | None
    t1: Float[Array, ""]
    settings: Settings
    grid: Float[Array, " steps"] | None


class RideSpec(eqx.Module):
    """A `Ride` that can leave a transformation: its numbers are leaves and everything else is static."""

    numbers: Any
    static: Any = eqx.field(static=True)

    @classmethod
    def of(cls, ride: Ride) -> "RideSpec":
        """The specification of a ride."""
        return cls(*eqx.partition(ride, eqx.is_array_like))

    @property
    def ride(self) -> Ride:
        """The ride."""
        return eqx.combine(self.numbers, self.static)


def as_module(controls: Input | None, scene: Scene, launch: Launch) -> Any:
    """An input as a module whose numbers are leaves. A function, or a module with arrays, is traced once, with scalar
    arguments, because it is written for a single ride."""
    if controls is None or (isinstance(controls, eqx.Module) and not has_arrays(controls)):
        return controls

    def motion(scene: Scene, launch: Launch) -> Any:
        return scene.dynamics.geometry(scene.state(launch, True)).motion

    single: Any = controls
    return Formula.of(single, jnp.zeros(()), eqx.filter_eval_shape(motion, scene, launch))


def has_arrays(tree: Any) -> bool:
    """Whether some leaf is an array with axes."""
    return any(eqx.is_array(leaf) and leaf.ndim > 0 for leaf in jax.tree.leaves(tree))


def ride_problem(modules: tuple[Scene, Launch, Input | None], cells: int | None) -> RideProblem:
    """The problem of scene, launch and input, whose numbers are scalars or one per cell."""
    return RideProblem.single(*modules) if cells is None else RideProblem.of(*modules, cells, False)


def traced_ride(
    ride: Ride, times: Float[Array, " times"], adjoint: diffrax.AbstractAdjoint | None
) -> tuple[State, Stats]:
    """The states of a ride at `times`, and its statistics, inside a transformation."""
    modules, arguments = (ride.scene, ride.launch, ride.input), (times, ride.t1, ride.settings)
    if adjoint is None:
        if isinstance(ride.input, Formula) and not has_arrays(modules[:2]):
            t, motion = eqx.filter_eval_shape(at_start, ride.scene, ride.launch)
            modules = (ride.scene, ride.launch, PerRide.of(ride.input, t, motion))
        sampled = sampled_run(
            ride_problem, modules, *arguments, ride.grid, arrays_in_lanes=isinstance(modules[2], PerRide)
        )
    else:
        arguments = (*arguments, adjoint, ride.grid)
        sampled = sampled_run_by_diffrax(ride_problem(modules, None), *arguments)
    return sampled.states.T, stats_of(sampled)


def stats_of(sampled: SampledRun) -> Stats:
    """The statistics of a run."""
    counts = (jax.lax.stop_gradient(part) for part in (sampled.accepted, sampled.rejected, sampled.status))
    accepted, rejected, status = counts
    return Stats(accepted.astype(int), rejected.astype(int), status == REACHED_END)
