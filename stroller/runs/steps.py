"""The steps of a run, and the states between them, found by repeating a step with another length.

A state therefore has the accuracy of the integration, not of an interpolant. Only the field is compiled; the stages of
the steps are summed in NumPy.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import diffrax
import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from nonholonomic.integration import explicit_tableau, follow, sample
from nonholonomic.xla_cpu import compiled_quickly

from ..model.dynamics import State
from ..model.ride import RideProblem
from .ride import RideSpec, Stats

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

        time, start, solver = self.times[step], self.states[:, step], spec.ride.settings.for_steps_alone
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
    ride = spec.ride
    return ride.scene.dynamics.field(times, states, ride.input)


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
    ride = spec.ride
    problem = _problem(spec)
    if ride.grid is None:
        path = follow(problem, float(ride.t1), ride.settings, dense=False)
        return Steps(path.times, path.states), _counted(path.accepted, path.rejected, not path.failed)
    solution = _on_grid(problem, spec)
    ends = np.asarray(ride.grid)
    mask = ends <= float(solution.end_time)
    steps = Steps(ends[mask], np.asarray(solution.states)[:, mask])
    return steps, _counted(int(solution.accepted), int(solution.rejected), bool(mask.all()))


def _counted(accepted: int, rejected: int, finished: bool) -> Stats:
    """Statistics as arrays: plain numbers would be constants of a program, and other values would compile another
    program."""
    return Stats(jnp.asarray(accepted), jnp.asarray(rejected), jnp.asarray(finished))


@eqx.filter_jit
def _problem(spec: RideSpec) -> RideProblem:
    ride = spec.ride
    return RideProblem.single(ride.scene, ride.launch, ride.input)


@compiled_quickly
def _on_grid(problem: RideProblem, spec: RideSpec) -> Any:
    """A ride with given steps, sampled at their ends."""
    ride = spec.ride
    return sample(problem, None, ride.t1, ride.settings, grid=ride.grid)
