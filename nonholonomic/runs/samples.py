"""Quantities of many runs at given times, in lanes."""

from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from ..compilation.xla_cpu import compiled_alone
from ..hybrid import HybridOutcome, HybridSamples, solve_hybrid_with_samples
from ..integration import Outcome, Settings, solve_with_samples
from ..sweeps import Axis, Variable, axis
from .event import modes_of, problem_of
from .model import AbstractModel, Names, Start

#: Tables with at least this many samples interpolate them inside steps. Runs often take about as many steps; tables of
#: runs with many more steps take up to a sixth longer, those with fewer up to two thirds less time.
DENSE = 1000


class Samples(NamedTuple):
    """The samples in a table: the times [s], and the names of the quantities."""

    times: Float[np.ndarray, " times"]
    names: tuple[str, ...]

    def variables(self, model: AbstractModel) -> dict[str, Variable]:
        """The variables of the table with the quantities."""
        variables = {}
        for name in self.names:
            unit, long_name, components, *_ = model.quantities[name]
            dims = ("time",) if components is None else ("time", components)
            variables[name] = Variable(unit, np.float64, inner=dims, long_name=long_name)
        return variables

    def inner(self, model: AbstractModel) -> list[Axis]:
        """The dimensions of these variables."""
        dims = dict.fromkeys(model.quantities[name].components for name in self.names)
        vectors = [Axis(dim, dim, "1", np.array(model.components[dim])) for dim in dims if dim is not None]
        return [axis("time", "time", "s", self.times, "time"), *vectors]


def solve_samples(
    cells: AbstractModel, samples: Samples, t1: float, size: int, count: int, settings: Settings
) -> tuple[Int[Array, " cells"], dict[str, Array]]:
    """The `Status` of all cells, of which only the first `count` are run, and the variables of the table."""
    names, times = samples.names, jnp.asarray(samples.times, float)
    horizon = (jnp.asarray(t1, float), jnp.asarray(count), settings)
    if cells.smooth:
        outcome, status, values = _followed(problem_of(cells, size, names), cells, names, times, *horizon)
        values |= {"end_time": outcome.end_time, "steps": outcome.steps, "rejected": outcome.rejected}
    else:
        start, counters = modes_of(cells, size, settings.tolerance, names), len(cells.counters)
        run, _ = solve_hybrid_with_samples(*start, times, *horizon, counters=counters)
        status, values = _read_samples(cells, names, times, run, settings.tolerance)
    return status, jax.tree.map(np.asarray, values)


# Compiled on its own, not inside other transformed functions; otherwise it does not get the compiler's options.
@compiled_alone
def _followed(
    problem: Any,
    cells: AbstractModel,
    names: tuple[str, ...],
    times: Float[Array, " times"],
    t1: Float[Array, ""],
    count: Int[Array, ""],
    settings: Settings,
) -> tuple[Outcome, Int[Array, " cells"], dict[str, Float[Array, "cells times ..."]]]:
    """The outcome of the runs, their `Status`, and the named quantities at the samples."""
    options: Any = {"one_kernel": True, "read": _reader(cells, names), "dense": len(times) >= DENSE}
    outcome, samples = solve_with_samples(problem, times, t1, count, settings, **options)
    return outcome, cells.ended(outcome, settings.tolerance), samples


def _own_axis(leaf: Any) -> int | None:
    return 0 if eqx.is_array(leaf) and leaf.ndim else None


def _reader(
    model: AbstractModel, names: tuple[str, ...]
) -> Callable[[Int[Array, " lanes"], Float[Array, "rows components lanes"]], dict[str, Array]]:
    """A function that computes the named quantities of some cells from their states."""

    def read_lane(model: AbstractModel, states: Float[Array, "rows components"]) -> dict[str, Array]:
        return model.read(names, jnp.full(len(states), jnp.nan), states.T, None)

    def reader(cell: Int[Array, " lanes"], states: Float[Array, "rows components lanes"]) -> dict[str, Array]:
        of_lanes = jax.tree.map(lambda leaf: leaf if _own_axis(leaf) is None else leaf[cell], model)
        return eqx.filter_vmap(read_lane, in_axes=(_own_axis, -1), out_axes=1)(of_lanes, states)

    return reader


def modes_of_run(modules: tuple[AbstractModel, Names], tolerance: Array, cells: int) -> Start:
    """The modes of some runs, as `hybrid_samples` builds them."""
    model, names = modules
    return modes_of(model, cells, tolerance, names)


def mode_at(number: Float[Array, "..."]) -> Int[Array, "..."]:
    """The index of the mode at each sample, -1 between two modes and after the end."""
    return jnp.where(jnp.isnan(number), -1, number).astype(int)


def outcome_of(samples: HybridSamples) -> HybridOutcome[Array]:
    """How sampled runs, with the cells along the first axis, have ended."""
    codes = (samples.status, samples.steps, samples.rejected, samples.end_mode)
    status, steps, rejected, mode = (code.astype(int) for code in codes)
    ending = (jnp.full_like(samples.end_time, jnp.inf), samples.end_time, samples.end_state.T)
    return HybridOutcome(status, *ending, steps, rejected, mode, samples.counts.astype(int).T)


@eqx.filter_jit
def _read_samples(
    cells: AbstractModel,
    names: tuple[str, ...],
    times: Float[Array, " times"],
    samples: HybridSamples,
    tolerance: Float[Array, ""],
) -> tuple[Int[Array, " cells"], dict[str, Array]]:
    """The `Status` of runs of several modes, and the variables of the table."""

    def of_cell(model: AbstractModel, rows: Array, number: Array, end_time: Array) -> dict[str, Array]:
        values = model.read(names, times, rows, mode_at(number))
        is_reached = times <= end_time
        return {
            name: jnp.where(is_reached.reshape(-1, *(1,) * (value.ndim - 1)), value, jnp.nan)
            for name, value in values.items()
        }

    outcome = outcome_of(samples)
    axes = (_own_axis, 0, 0, 0)
    values = eqx.filter_vmap(of_cell, in_axes=axes)(cells, samples.shown, samples.number, samples.end_time)
    ending = {"end_time": outcome.end_time, "steps": outcome.steps, "rejected": outcome.rejected}
    return cells.ended(outcome, tolerance), values | ending | dict(zip(cells.counters, outcome.counts, strict=True))
