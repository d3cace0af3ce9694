"""The steps of a ride, the states between them, found by repeating a step with another length, and zero crossings.

A state therefore has the accuracy of the integration, not of an interpolant. Only the field is compiled; the stages of
the steps are summed in NumPy.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import diffrax
import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from nonholonomic.compilation.xla_cpu import compiled_quickly
from nonholonomic.hybrid import HybridOutcome
from nonholonomic.integration import Settings, explicit_tableau, follow, sample
from nonholonomic.integration.status import REACHED_END
from nonholonomic.integration.zeros import few_trials

from ..model.dynamics import State
from ..model.input import Input
from ..model.launch import Launch
from ..model.ride import RideProblem
from ..model.scene import Scene


class Stats(NamedTuple):
    """Numbers of accepted and rejected steps, and whether the integration reached its end."""

    steps: Int[Array, ""]
    rejected: Int[Array, ""]
    finished: Bool[Array, ""]


class RideSpec(eqx.Module):
    """A ride and the options of its integration, in a form that can leave a transformation: its numbers are leaves and
    everything else is static."""

    numbers: Any
    static: Any = eqx.field(static=True)

    @classmethod
    def of(cls, model: Any, t1: Array, settings: Settings, grid: Float[Array, " steps"] | None) -> "RideSpec":
        """The specification of a ride.

        **Arguments:** `model`: the `RideModel`; `t1`: end [s]; `grid`: the ends of the steps [s] of a solver without an
        error estimate.
        """
        return cls(*eqx.partition((model, t1, settings, grid), eqx.is_array_like))

    @property
    def parts(self) -> tuple[Any, Array, Settings, Array | None]:
        """The arguments of `of`."""
        return eqx.combine(self.numbers, self.static)

    @property
    def settings(self) -> Settings:
        """The settings of the integration."""
        return self.parts[2]

    @property
    def scene(self) -> Scene:
        """The scene of the ride."""
        return self.parts[0].scene

    @property
    def launch(self) -> Launch:
        """The launch of the ride."""
        return self.parts[0].launch

    @property
    def input(self) -> Input | None:
        """The input of the ride."""
        return self.parts[0].input


def stats_of(outcome: HybridOutcome[Array]) -> Stats:
    """The statistics of a run of one cell."""
    accepted, rejected = outcome.steps[0] - outcome.rejected[0], outcome.rejected[0]
    return Stats(accepted.astype(int), rejected.astype(int), outcome.status[0] == REACHED_END)


Lanes = Float[np.ndarray, " lanes"]
States = Float[np.ndarray, "components lanes"]

#: Number of states in a call of a compiled function, always the same, so that it is compiled once.
WIDTH = 256


class Steps(NamedTuple):
    """The ends of a run's steps: times [s], beginning with 0, and states."""

    times: Float[np.ndarray, " steps"]
    states: Float[np.ndarray, "components steps"]

    def at(self, spec: RideSpec, times: Lanes) -> States:
        """The states at the given times [s]; NaN after the end of the run."""
        step = np.clip(np.searchsorted(self.times, times, side="right") - 1, 0, len(self.times) - 2)
        ends = np.where(times == self.times[step], step, step + 1)
        states = self.states[:, ends]
        is_inside = (times > self.times[step]) & (times < self.times[step + 1])
        if is_inside.any():
            states[:, is_inside] = self._between(spec, step[is_inside], times[is_inside] - self.times[step[is_inside]])
        states[:, times > self.times[-1]] = np.nan
        return states

    def _between(self, spec: RideSpec, step: Any, length: Lanes) -> States:
        """The states at given times [s] after the starts of some steps."""

        def field(times: Lanes, states: States) -> States:
            return in_blocks(lambda *arguments: _field(spec, *arguments), times, states)

        time, start, solver = self.times[step], self.states[:, step], spec.settings.for_steps_alone
        rates = [field(time, start)]
        if not isinstance(solver, diffrax.AbstractERK):
            # Use the cubic through states and rates at both ends; repeating an implicit step would be expensive.
            length_of_step, end = self.times[step + 1] - time, self.states[:, step + 1]
            part, change = length / length_of_step, end - start
            last = field(time + length_of_step, end)
            bend = (1.0 - part) * (length_of_step * rates[0] - change) - part * (length_of_step * last - change)
            return start + part * (change + (1.0 - part) * bend)
        tableau = explicit_tableau(solver)
        for fraction, row in zip(tableau.c, tableau.a_lower, strict=True):
            end = start + length * np.tensordot(row, np.stack(rates), 1)
            rates.append(field(time + fraction * length, end))
        return start + length * np.tensordot(tableau.b_sol, np.stack(rates), 1)


@eqx.filter_jit
def _field(spec: RideSpec, times: Float[Array, " lanes"], states: State) -> State:
    return spec.scene.dynamics.field(times, states, spec.input)


def in_blocks(function: Callable[..., Any], *columns: Any) -> Any:
    """A compiled function of any number of columns, `WIDTH` at a time; the last block is padded with its last column."""
    count = columns[0].shape[-1]
    results = []
    for first in range(0, count, WIDTH):
        lanes = np.minimum(np.arange(first, first + WIDTH), count - 1)
        results.append(np.asarray(function(*(column[..., lanes] for column in columns))))
    return np.concatenate(results, axis=-1)[..., :count]


def followed(spec: RideSpec) -> tuple[Steps, Stats]:
    """Run a ride outside of transformations, and keep its steps."""
    problem, (_, t1, settings, grid) = _problem(spec), spec.parts
    if grid is None:
        path = follow(problem, float(t1), settings, dense=False)
        return Steps(path.times, path.states), _counted(path.accepted, path.rejected, not path.failed)
    solution = _on_grid(problem, spec)
    ends = np.asarray(grid)
    mask = ends <= float(solution.end_time)
    steps = Steps(ends[mask], np.asarray(solution.states)[:, mask])
    return steps, _counted(int(solution.accepted), int(solution.rejected), bool(mask.all()))


def _counted(accepted: int, rejected: int, finished: bool) -> Stats:
    """Statistics as arrays: plain numbers would be constants of a program, and other values would compile another
    program."""
    return Stats(jnp.asarray(accepted), jnp.asarray(rejected), jnp.asarray(finished))


@eqx.filter_jit
def _problem(spec: RideSpec) -> RideProblem:
    return RideProblem.single(spec.scene, spec.launch, spec.input)


@compiled_quickly
def _on_grid(problem: RideProblem, spec: RideSpec) -> Any:
    """A ride with given steps, sampled at their ends."""
    _, t1, settings, grid = spec.parts
    return sample(problem, None, t1, settings, grid=grid)


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
    dynamics = spec.scene.dynamics
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
        shift = 0.5 * (fall * gap_after**2 - rise * gap_before**2) / (fall * gap_after + rise * gap_before)
        vertex = time[middle] + shift
    is_inside = (vertex > time[middle - 1]) & (vertex < time[middle + 1]) & (np.abs(vertex - time[middle]) > CLOSEST)
    return vertex[is_inside]
