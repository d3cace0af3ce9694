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
from nonholonomic.integration.zeros import all_crossings

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
    def model(self) -> Any:
        """The `RideModel`."""
        return self.parts[0]

    @property
    def settings(self) -> Settings:
        """The settings of the integration."""
        return self.parts[2]

    @property
    def scene(self) -> Scene:
        """The scene of the ride."""
        return self.model.scene

    @property
    def launch(self) -> Launch:
        """The launch of the ride."""
        return self.model.launch

    @property
    def input(self) -> Input | None:
        """The input of the ride."""
        return self.model.input


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
    return RideProblem.single(spec.scene, spec.launch, spec.input, spec.model.jumps)


@compiled_quickly
def _on_grid(problem: RideProblem, spec: RideSpec) -> Any:
    """A ride with given steps, sampled at their ends."""
    _, t1, settings, grid = spec.parts
    return sample(problem, None, t1, settings, grid=grid)


#: Quantities that can be watched: the normal force [N], the cosine of the steering angle, and the relative reduced
#: mass.
WATCHED = ("normal_force", "steering_cosine", "rank")


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
    value = watched(spec, steps.states, name) - level
    return all_crossings(lambda times: watched(spec, steps.at(spec, times), name) - level, steps.times, value)
