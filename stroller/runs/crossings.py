"""Find the times at which a quantity was zero during a run. To find a time within a step, the step is repeated with
other lengths."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from nonholonomic.integration.zeros import few_trials

from ..model.dynamics import State
from .ride import RideSpec
from .steps import Lanes, States, Steps, in_blocks

#: Quantities that can be watched: the normal force [N], the cosine of the steering angle, and the relative reduced
#: mass.
WATCHED = ("normal_force", "steering_cosine", "rank")

#: Number of parts into which a step is divided, to check the sign at their ends, if there may be a crossing.
PARTS = 8

#: Number of rounds in which checks are added where the quantity is nearest to zero, to detect two crossings close
#: together.
CLOSER_LOOKS = 3

#: Checks closer together than this [s] give no new information.
CLOSEST = 1e-14


def watched(spec: RideSpec, states: States, name: str) -> Lanes:
    """A quantity in `WATCHED` at the given states."""
    return in_blocks(lambda state: _watched(spec, state), states)[WATCHED.index(name)]


@eqx.filter_jit
def _watched(spec: RideSpec, states: State) -> Float[Array, "watched lanes"]:
    dynamics = spec.ride.scene.dynamics
    quantities = (dynamics.contact(states), dynamics.geometry(states).cosine, dynamics.rank(states))
    return jnp.stack(jnp.broadcast_arrays(*quantities))


def crossings(spec: RideSpec, steps: Steps, name: str, level: float) -> Float[np.ndarray, " times"]:
    """Times [s] at which a watched quantity passes a level, in either direction, in increasing order."""
    time, value = steps.times, watched(spec, steps.states, name) - level
    indices = np.flatnonzero(_may_cross(value))
    if indices.size == 0:
        return np.zeros(0)

    def quantity(times: Lanes) -> Lanes:
        """The quantity minus the level; NaN counts as beyond the level."""
        value = watched(spec, steps.at(spec, times), name) - level
        return np.where(np.isfinite(value), value, -np.inf)

    parts = np.arange(1, PARTS) / PARTS
    new = (time[indices] + parts[:, None] * (time[indices + 1] - time[indices])).ravel()
    for _ in range(1 + CLOSER_LOOKS):
        time, value = np.concatenate([time, new]), np.concatenate([value, quantity(new)])
        order = np.argsort(time, kind="stable")
        time, value = time[order], value[order]
        new = _nearest(time, value)
        if new.size == 0:
            break
    changes = np.flatnonzero((value[:-1] > 0.0) != (value[1:] > 0.0))
    return few_trials(quantity, time[changes], time[changes + 1], value[changes], value[changes + 1])


def _may_cross(value: Float[np.ndarray, " steps"]) -> Bool[np.ndarray, " gaps"]:
    """Steps in which a quantity may be zero: its sign changes, or it changes by more than its size, there or in a
    neighbour."""
    with np.errstate(invalid="ignore"):
        change = np.abs(np.diff(value))
        max_change = np.max([change, np.append(change[1:], 0.0), np.insert(change[:-1], 0, 0.0)], axis=0)
        is_small = np.minimum(np.abs(value[:-1]), np.abs(value[1:])) < max_change
    return is_small | ((value[:-1] > 0.0) != (value[1:] > 0.0))


def _nearest(time: Float[np.ndarray, " looks"], value: Float[np.ndarray, " looks"]) -> Float[np.ndarray, " new"]:
    """The times at which a quantity is nearest to zero between checks of equal sign: the vertices of parabolas."""
    distance = np.abs(value)
    is_minimum = (distance[1:-1] < distance[:-2]) & (distance[1:-1] <= distance[2:])
    is_minimum &= (value[1:-1] > 0.0) == (value[:-2] > 0.0)
    is_minimum &= (value[1:-1] > 0.0) == (value[2:] > 0.0)
    middle = np.flatnonzero(is_minimum) + 1
    gap_before, gap_after = time[middle] - time[middle - 1], time[middle + 1] - time[middle]
    with np.errstate(all="ignore"):
        fall = (distance[middle - 1] - distance[middle]) / gap_before
        rise = (distance[middle + 1] - distance[middle]) / gap_after
        vertex = time[middle] + 0.5 * (fall * gap_after**2 - rise * gap_before**2) / (
            fall * gap_after + rise * gap_before
        )
    is_inside = (vertex > time[middle - 1]) & (vertex < time[middle + 1]) & (np.abs(vertex - time[middle]) > CLOSEST)
    return vertex[is_inside]
