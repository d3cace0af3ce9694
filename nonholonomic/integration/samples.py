"""Sample many runs at given times, with the lanes that also locate event times.

Steps end on the requested times, so a sample has the accuracy of the method; between two samples the steps have even
lengths. The loop works in periods: a period records the state after each iteration, and then stores its samples
together.
"""

import functools
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from ..xla_cpu import written_in_place
from .problem import AbstractProblem
from .runge_kutta import Lanes
from .scheduler import LaneScheduler, Outcome, Progress
from .settings import Settings
from .status import FAILED, REACHED_END, RUNNING
from .step import LaneState, try_step

#: Iterations per period: as many as fit the caches with their record.
PERIOD = 64

#: Largest factor by which a step is stretched to end on a sample: its error stays below the tolerance, because steps
#: are proposed with a margin of `step.SAFETY`.
STRETCH = 1.08

Samples = Float[Array, "cells times components"]


class Reached(NamedTuple):
    """Record of a period: the state after each iteration, and the number of the sample there, if any."""

    state: Float[Array, "iterations components lanes"]
    sample: Int[Array, "iterations lanes"]


class Sampling(NamedTuple):
    """Progress of an ensemble solve with samples: `sample` is the number of the next sample in every lane."""

    progress: Progress
    sample: Int[Array, " lanes"]
    outcome: Outcome
    samples: Samples


def solve_with_samples(
    problem: AbstractProblem,
    times: Float[Array, "times *cells"],
    t1: Float[Array, "..."],
    cells: Int[Array, ""],
    settings: Settings,
    *,
    n_blocks: int = 1,
    one_kernel: bool = False,
) -> tuple[Outcome, Samples]:
    """Run every cell from t = 0 to its event, to the end of the model's validity, or to `t1`, and sample it.

    **Arguments:** as for `LaneScheduler.of`, and

    - `times`: of the samples [s], increasing, from 0 or later; (times,) for all cells or (times, cells). Those after
      `t1` are not reached.

    **Returns:** the `Outcome`, without crossing times; and the states at the times, (cells, times, components), NaN
    after the end of a run.

    **Example:**

    >>> from nonholonomic.integration import solve_with_samples
    >>> times = jnp.array([0.1, 0.3])
    >>> _, states = solve_with_samples(problem, times, jnp.asarray(5.0), jnp.asarray(3), settings)
    >>> print(states[..., 0].round(6))
    [[0.904837 0.740818]
     [0.818731 0.548812]
     [0.67032       nan]]
    """
    scheduler = LaneScheduler.of(problem, t1, cells, settings, n_blocks=n_blocks, one_kernel=one_kernel)
    count, starts = times.shape[0], scheduler.fresh.state
    of_cell = jnp.broadcast_to(times.reshape(count, -1), (count, scheduler.capacity)).T
    first = jnp.sum(of_cell <= 0.0, axis=1)
    own_times = times.ndim == 2

    def period(run: Sampling) -> Sampling:
        cell = jnp.minimum(run.progress.lane_state.cell, scheduler.capacity - 1)
        lane_times = of_cell[cell].T if own_times else times
        progress, sample, record = _recorded(scheduler, lane_times, run.progress, run.sample)
        outcome = scheduler.store(run.outcome, progress.lane_state)
        refilled = scheduler.refill(progress)
        fresh = refilled.lane_state.cell != progress.lane_state.cell
        begin = first[jnp.minimum(refilled.lane_state.cell, scheduler.capacity - 1)]
        rows = jnp.moveaxis(record.state, 1, -1)
        samples = run.samples.at[cell[None], record.sample].set(rows, mode="drop", unique_indices=True)
        return Sampling(refilled, jnp.where(fresh, begin, sample), outcome, samples)

    progress = scheduler.start()
    at_start = jnp.where(of_cell[..., None] <= 0.0, starts.T[:, None], jnp.nan)
    run = Sampling(
        progress, first[jnp.minimum(progress.lane_state.cell, scheduler.capacity - 1)], scheduler.empty(), at_start
    )
    run = jax.lax.while_loop(lambda run: scheduler.unfinished(run.progress), period, run)
    return scheduler.store(run.outcome, run.progress.lane_state), run.samples


def _recorded(
    scheduler: LaneScheduler, times: Float[Array, "times ..."], progress: Progress, sample: Int[Array, " lanes"]
) -> tuple[Progress, Int[Array, " lanes"], Reached]:
    """Advance the lanes by a period and record their samples."""
    problem, control, atol = scheduler.in_lanes(progress.lane_state)
    count = times.shape[0]
    horizon = jnp.broadcast_to(control.t1, progress.lane_state.time.shape)

    def going(carry: Any) -> Any:
        lane_state, _, _, _, idle, iteration = carry
        return scheduler.goes_on(lane_state, idle, progress.loaded) & (iteration < PERIOD)

    def step(carry: Any) -> Any:
        lane_state, accepted, sample, record, idle, iteration = carry
        idle = idle + scheduler.idle(lane_state)
        next_time = _next_time(times, sample)
        stop = jnp.where(sample < count, jnp.minimum(next_time, horizon), horizon)
        even = _even(lane_state.length, stop - lane_state.time, lane_state.bracketing)
        # After a step that was not accepted the next one is shorter on purpose: it may have to end on a minimum of a margin.
        length = jnp.where(accepted, even, jnp.minimum(even, lane_state.length))
        lane_state = lane_state._replace(length=length)
        after = try_step(problem, control._replace(t1=stop), atol, lane_state)
        reached = (lane_state.status == RUNNING) & (after.status == REACHED_END)
        is_sample = reached & (sample < count) & (after.time >= next_time)
        goes_on = reached & (after.time < horizon)
        status = jnp.where(after.steps < control.max_steps, RUNNING, FAILED)
        after = after._replace(status=jnp.where(goes_on, status, after.status))
        sampled = Reached(after.state, jnp.where(is_sample, sample, count))
        record = jax.tree.map(functools.partial(written_in_place, at=iteration), record, sampled)
        return after, after.time > lane_state.time, sample + is_sample, record, idle, iteration + 1

    def loop(start: tuple[LaneState, Int[Array, " lanes"]]) -> Any:
        lane_state, sample = start
        empty = Reached(
            jnp.zeros((PERIOD, *lane_state.state.shape), lane_state.state.dtype),
            jnp.full((PERIOD, *sample.shape), count),
        )
        accepted = jnp.ones(sample.shape, bool)
        return jax.lax.while_loop(
            going, step, (lane_state, accepted, sample, empty, jnp.zeros((), int), jnp.zeros((), int))
        )

    lane_state, _, sample, record, _, iterations = scheduler.in_kernel(loop)((progress.lane_state, sample))
    return Progress(lane_state, progress.loaded, progress.iterations + iterations), sample, record


def _next_time(times: Float[Array, "times ..."], sample: Int[Array, " lanes"]) -> Lanes:
    """The time of the next sample in every lane."""
    inside = jnp.minimum(sample, times.shape[0] - 1)
    return times[inside] if times.ndim == 1 else jnp.take_along_axis(times, inside[None], axis=0)[0]


def _even(length: Lanes, left: Lanes, bracketing: Array) -> Lanes:
    """The length of a step, changed a little if one or two steps then end on the next sample."""
    reach = STRETCH * length
    fitting = jnp.where(reach >= left, left, jnp.where(2.0 * reach >= left, 0.5 * left, length))
    return jnp.where(bracketing, length, fitting)
