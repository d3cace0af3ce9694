"""When a quantity was zero during a run: found within a step by repeating that step with other lengths.

So a time has the accuracy of the integration and not that of an interpolation. Only the field is compiled, and only if
there is something to find; the stages of the steps are summed in NumPy.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import diffrax
import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from nonholonomic.integration import explicit_tableau, few_trials

from .dynamics import Dynamics, State
from .input import Input
from .scene import Scene

Lanes = Float[np.ndarray, " lanes"]
States = Float[np.ndarray, "components lanes"]

#: How many states the field is given at once, so that it is compiled once.
WIDTH = 256

#: Parts into which a step is divided, to look at the sign at their ends, if there may be a crossing.
PARTS = 8

#: How many times looks are added where the quantity is nearest to zero, so that two crossings close together are seen.
CLOSER_LOOKS = 3

#: Looks closer together than this [s] would show nothing new.
CLOSEST = 1e-14


class Watch(NamedTuple):
    """What is followed from one step of the integration to the next; unused entries are infinite or NaN.

    Times [s] and states (steps, components), and the normal force [N], the cosine of the steering angle and the relative
    reduced mass there.
    """

    time: Float[Array, " steps"]
    state: Float[Array, "steps components"]
    normal_force: Float[Array, " steps"]
    steering_cosine: Float[Array, " steps"]
    rank: Float[Array, " steps"]


def watched(dynamics: Dynamics, state: State) -> tuple[Float[Array, "..."], Float[Array, "..."], Float[Array, "..."]]:
    """Normal force [N], cosine of the steering angle, and relative reduced mass at a state."""
    return dynamics.contact(state), dynamics.geometry(state).cosine, dynamics.rank(state)


class Recipe(eqx.Module):
    """What made a run: scene, input, and the solver if it is an explicit Runge-Kutta method.

    Its numbers are leaves and everything else is static, so that a run can leave a transformation whatever its input is.
    """

    numbers: Any
    rest: Any = eqx.field(static=True)

    @classmethod
    def of(cls, scene: Scene, controls: Input | None, solver: diffrax.AbstractSolver) -> "Recipe":
        """The recipe of a run."""
        explicit = solver if isinstance(solver, diffrax.AbstractERK) else None
        return cls(*eqx.partition((scene, controls, explicit), eqx.is_array_like))

    @property
    def parts(self) -> tuple[Scene, Input | None, diffrax.AbstractERK | None]:
        """Scene, input and solver."""
        return eqx.combine(self.numbers, self.rest)


@eqx.filter_jit
def _field(recipe: Recipe, times: Float[Array, " lanes"], states: State) -> State:
    scene, controls, _ = recipe.parts
    return scene.dynamics.field(times, states, controls)


@eqx.filter_jit
def _watched(recipe: Recipe, states: State) -> Float[Array, "watched lanes"]:
    return jnp.stack(jnp.broadcast_arrays(*watched(recipe.parts[0].dynamics, states)))


def _in_blocks(function: Callable[..., Any], *columns: Any) -> Any:
    """A compiled function of any number of columns, `WIDTH` at a time; the last block is padded with its last column."""
    count = columns[0].shape[-1]
    found = []
    for first in range(0, count, WIDTH):
        lanes = np.minimum(np.arange(first, first + WIDTH), count - 1)
        found.append(np.asarray(function(*(column[..., lanes] for column in columns))))
    return np.concatenate(found, axis=-1)[..., :count]


class Between(NamedTuple):
    """A watched quantity, less a level, at any time of a run: its steps, times (steps,) and states (components, steps)."""

    recipe: Recipe
    times: Float[np.ndarray, " steps"]
    states: States
    name: str
    level: float

    def at(self, times: Lanes) -> Lanes:
        """The quantity at the given times; NaN counts as beyond the level."""
        which = np.clip(np.searchsorted(self.times, times, side="right") - 1, 0, len(self.times) - 2)
        found = _in_blocks(lambda at: _watched(self.recipe, at), self._states(which, times - self.times[which]))
        value = found[Watch._fields.index(self.name) - 2] - self.level
        return np.where(np.isfinite(value), value, -np.inf)

    def _states(self, which: Any, length: Lanes) -> States:
        """The states some time [s] after the starts of some steps."""

        def field(times: Lanes, states: States) -> States:
            return _in_blocks(lambda *at: _field(self.recipe, *at), times, states)

        time, start, solver = self.times[which], self.states[:, which], self.recipe.parts[2]
        rates = [field(time, start)]
        if solver is None:
            # The cubic through states and rates at both ends; an implicit step cannot be repeated so cheaply.
            whole, end = self.times[which + 1] - time, self.states[:, which + 1]
            part, change = length / whole, end - start
            last = field(time + whole, end)
            bend = (1.0 - part) * (whole * rates[0] - change) - part * (whole * last - change)
            return start + part * (change + (1.0 - part) * bend)
        tableau = explicit_tableau(solver)
        for fraction, row in zip(tableau.c, tableau.a_lower, strict=True):
            end = start + length * np.tensordot(row, np.stack(rates), 1)
            rates.append(field(time + fraction * length, end))
        return start + length * np.tensordot(tableau.b_sol, np.stack(rates), 1)


def crossings(recipe: Recipe, watch: Watch, name: str, level: float) -> Float[np.ndarray, " times"]:
    """Times [s] at which a watched quantity passes a level, in either direction, in increasing order."""
    time, value = np.asarray(watch.time), np.asarray(getattr(watch, name)) - level
    used = np.isfinite(time)
    time, value = time[used], value[used]
    which = np.flatnonzero(_may_cross(value))
    if which.size == 0:
        return np.zeros(0)
    quantity = Between(recipe, time, np.asarray(watch.state).T[:, used], name, level)
    parts = np.arange(1, PARTS) / PARTS
    new = (time[which] + parts[:, None] * (time[which + 1] - time[which])).ravel()
    for _ in range(1 + CLOSER_LOOKS):
        time, value = np.concatenate([time, new]), np.concatenate([value, quantity.at(new)])
        order = np.argsort(time, kind="stable")
        time, value = time[order], value[order]
        new = _nearest(time, value)
        if new.size == 0:
            break
    found = np.flatnonzero((value[:-1] > 0.0) != (value[1:] > 0.0))
    return few_trials(quantity.at, time[found], time[found + 1], value[found], value[found + 1])


def _may_cross(value: Float[np.ndarray, " steps"]) -> Bool[np.ndarray, " gaps"]:
    """Steps in which a quantity may be zero: it changes sign, or it or a neighbour changes by more than its size."""
    with np.errstate(invalid="ignore"):
        change = np.abs(np.diff(value))
        largest = np.max([change, np.append(change[1:], 0.0), np.insert(change[:-1], 0, 0.0)], axis=0)
        small = np.minimum(np.abs(value[:-1]), np.abs(value[1:])) < largest
    return small | ((value[:-1] > 0.0) != (value[1:] > 0.0))


def _nearest(time: Float[np.ndarray, " looks"], value: Float[np.ndarray, " looks"]) -> Float[np.ndarray, " new"]:
    """Where a quantity is nearest to zero between looks that show no change of sign: the vertices of parabolas."""
    distance = np.abs(value)
    least = (distance[1:-1] < distance[:-2]) & (distance[1:-1] <= distance[2:])
    least &= (value[1:-1] > 0.0) == (value[:-2] > 0.0)
    least &= (value[1:-1] > 0.0) == (value[2:] > 0.0)
    middle = np.flatnonzero(least) + 1
    before, after = time[middle] - time[middle - 1], time[middle + 1] - time[middle]
    with np.errstate(all="ignore"):
        fall = (distance[middle - 1] - distance[middle]) / before
        rise = (distance[middle + 1] - distance[middle]) / after
        vertex = time[middle] + 0.5 * (fall * after**2 - rise * before**2) / (fall * after + rise * before)
    inside = (vertex > time[middle - 1]) & (vertex < time[middle + 1]) & (np.abs(vertex - time[middle]) > CLOSEST)
    return vertex[inside]
