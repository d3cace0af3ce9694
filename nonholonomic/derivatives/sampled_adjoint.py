"""The derivatives of a sum over the samples of a run with respect to any number of parameters, by one backward pass.

The run is repeated, with steps that also suit a tangent, and its steps are recorded (`_adjoint.py`). The backward pass
adds the cotangent of each sample where it passes the sample's time. Neither the cost nor the memory depends on the number
of parameters, apart from the field's own share.
"""

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from ..compilation.xla_cpu import written_in_place
from ..integration import AbstractProblem, Lanes, LaneState, Settings, States
from ..integration.sample_times import SampleTimes, components
from ..integration.samples import step_towards_sample
from ..integration.scheduler import InLanes
from ..integration.status import FAILED, LEFT_DOMAIN, REACHED_END
from ._adjoint import StepRecorder, solve_with_adjoint, without_probe
from .periods import StepRecord
from .slopes import moving_leaves, shares_of, tangents_of, time_of_zero
from .variation import VariationalProblem, tangent_scale


class SampledCotangents(NamedTuple):
    """The cotangents of the samples, of the time at which a run leaves the domain, and of the state at the horizon."""

    states: Float[Array, "cells times components"]
    end_time: Float[Array, " cells"]
    end_state: Float[Array, "components cells"]

    @classmethod
    def of(
        cls,
        problem: AbstractProblem,
        times: int,
        core: Float[Array, "cells times components"] | None,
        quadratures: Float[Array, "cells times quadratures"] | None,
        end_time: Float[Array, " cells"] | None,
    ) -> "SampledCotangents":
        """The cotangents of a problem's core components, quadratures and end time, zero where they are `None`."""
        components, cells = problem.start()[0].shape
        leading = components if problem.leading is None else problem.leading
        states = [
            jnp.zeros((cells, times, size)) if part is None else part
            for part, size in ((core, leading), (quadratures, components - leading))
        ]
        end_time = jnp.zeros(cells) if end_time is None else end_time
        return cls(jnp.concatenate(states, axis=-1), end_time, jnp.zeros((components, cells)))


class SampledStepRecord(NamedTuple):
    """The steps of a period; whether the last step was accepted, and the index of the next sample, in every lane."""

    accepted: Bool[Array, " lanes"]
    sample: Int[Array, " lanes"]
    steps: StepRecord


class SampledStepRecorder(StepRecorder):
    """Records steps that end on the samples; the cotangents of the samples enter where the steps end."""

    times: SampleTimes
    cotangents: SampledCotangents

    def begin(self, in_lanes: InLanes, lane_state: LaneState, collected: None) -> SampledStepRecord:
        steps = super().begin(in_lanes, lane_state, collected)
        sample = self.times.after(lane_state.time, lane_state)
        samples, fixed = jnp.zeros(steps.length.shape, sample.dtype), jnp.zeros(steps.state.shape, bool)
        return SampledStepRecord(jnp.ones(sample.shape, bool), sample, steps._replace(sample=samples, fixed=fixed))

    def step(
        self, in_lanes: InLanes, lane_state: LaneState, record: SampledStepRecord, iteration: Int[Array, ""]
    ) -> tuple[LaneState, SampledStepRecord]:
        accepted, sample, steps = record
        next_state, length, is_sample = step_towards_sample(self.times, in_lanes, lane_state, accepted, sample)
        has_moved, state = next_state.time > lane_state.time, without_probe(lane_state).state
        entry = StepRecord(
            lane_state.time,
            state,
            jnp.where(has_moved, length, 0.0),
            jnp.where(is_sample, sample, len(self.times)),
            next_state.state[len(state) :] == 0.0,
        )
        steps = jax.tree.map(functools.partial(written_in_place, at=iteration), steps, entry)
        return next_state, SampledStepRecord(has_moved, sample + is_sample, steps)

    def steps(self, record: SampledStepRecord) -> StepRecord:
        return record.steps

    def arriving(self, lane_state: LaneState, steps: StepRecord) -> Float[Array, "iterations components lanes"]:
        assert steps.fixed is not None
        rows = self.cotangents.states.at[self._cell(lane_state), steps.sample].get(mode="fill", fill_value=0.0)
        # Where the derivative is zero, a NaN cotangent, such as that of theta at the pole, has no effect.
        return jnp.where(steps.fixed, 0.0, jnp.moveaxis(rows, -1, 1))

    def share_of_end(self, lane_state: LaneState) -> tuple[Lanes, States]:
        cell, has_left = self._cell(lane_state), (lane_state.status == LEFT_DOMAIN) & (lane_state.time > 0.0)
        at_end = jnp.where(lane_state.status == REACHED_END, self.cotangents.end_state[:, cell], 0.0)
        return jnp.where(has_left, self.cotangents.end_time[cell], 0.0), at_end

    def _cell(self, lane_state: LaneState) -> Int[Array, " lanes"]:
        return jnp.minimum(lane_state.cell, len(self.cotangents.end_time) - 1)


def samples_pulled_back(
    build: Callable[..., AbstractProblem],
    point: tuple[Float[Array, "... cells"], ...],
    cotangents: SampledCotangents,
    times: Float[Array, "times *cells"],
    t1: Float[Array, "..."],
    settings: Settings,
    rates: list[Float[Array, "... cells"]] | None = None,
) -> list[Float[Array, "... cells"]]:
    """The cotangents of a problem's numbers from those of its samples.

    **Arguments:**

    - `build`: numbers -> problem; `point`: the numbers, with the cells last.
    - `cotangents`: those of the samples, 0 after the end of a run, and of the end.
    - `times`, `t1`, `settings`: as for `solve_with_samples`.
    - `rates`: a tangent of the numbers, which the steps must suit; by default one that moves every number.

    **Returns:** the cotangents, in the shapes of the numbers; NaN in cells that fail with the steps that suit the tangent.
    """
    problem, cells = build(*point), point[0].shape[-1]
    probe = tangents_of(build, point, [tuple(mixture(point) if rates is None else rates)])[0]
    moving = moving_leaves(problem, probe, _field_and_margin)
    outcome, by_start, by_number = solve_with_adjoint(
        VariationalProblem(problem, (), False),
        VariationalProblem(moving, (), False),
        probe,
        t1,
        jnp.asarray(cells),
        settings,
        measured=_end,
        recorder=SampledStepRecorder(SampleTimes.of(times, cells, components), cotangents),
        one_kernel=True,
    )
    sample_times = jnp.broadcast_to(times if times.ndim == 2 else times[:, None], (len(times), cells)).T
    is_moved = VariationalProblem(problem, (probe,), False).start()[0][len(by_start) :] != 0.0
    initial = jnp.where((sample_times <= 0.0)[..., None] & is_moved.T[:, None], cotangents.states, 0.0)
    is_lost = jnp.any(jnp.any(cotangents.states != 0.0, axis=-1) & (sample_times > outcome.end_time[:, None]), axis=1)
    is_lost |= jnp.any(cotangents.end_state != 0.0, axis=0)
    by_start = by_start + jnp.sum(initial, axis=1).T

    def numbers_and_start(*point: Float[Array, "... cells"]) -> Any:
        problem = build(*point)
        return eqx.filter(problem, moving), problem.start()[0]

    by_point = jax.vjp(numbers_and_start, *point)[1]((by_number.problem, by_start))
    return [jnp.where(is_lost & (outcome.status == FAILED), jnp.nan, part) for part in by_point]


def mixture(point: tuple[Float[Array, "... cells"], ...]) -> list[Float[Array, "... cells"]]:
    """A direction that moves every number by a share of its own size."""
    counts = [number[..., 0].size for number in point]
    shares = np.split(shares_of(sum(counts)), np.cumsum(counts)[:-1])
    return [
        jnp.asarray(share).reshape(*number.shape[:-1], 1) * tangent_scale(number)
        for share, number in zip(shares, point, strict=True)
    ]


def _field_and_margin(problem: AbstractProblem, states: States) -> Any:
    time = jnp.zeros_like(states[0])
    return problem.field(time, states), problem.domain_margin(time, states), problem.jumps(time, states)


def _end(variational: VariationalProblem, lane_state: LaneState) -> tuple[Lanes, States]:
    """The time at which a run leaves the domain, and the state at the end."""
    problem, time = variational.problem, lane_state.time
    if problem.domain_margin(time, lane_state.state) is None:
        return jnp.zeros_like(time), lane_state.state
    end_time = time_of_zero(problem, lambda state: problem.domain_margin(time, state), time, lane_state.state)
    return end_time, lane_state.state


def is_reversible(problem: AbstractProblem) -> bool:
    """Whether the field of a single run has a backward pass; a loop without a fixed number of iterations has none."""
    arrays, static = eqx.partition(problem, eqx.is_inexact_array)

    def pulled_back(arrays: Any, state: States) -> Any:
        def field(arrays: Any, state: States) -> States:
            return eqx.combine(arrays, static).field(jnp.zeros_like(state[0]), state)

        rates, pull = jax.vjp(field, arrays, state)
        return pull(jnp.ones_like(rates))

    try:
        jax.eval_shape(pulled_back, arrays, problem.start()[0])
    except ValueError:
        return False
    return True
