"""Sample many runs at given times, with the lanes that also locate event times.

Steps end on the requested times; between two samples the steps have even lengths. The state is recorded after each
iteration, and the samples of a period are stored together. Dense samples lie inside steps (`dense_samples.py`).
"""

import functools
from typing import Any, ClassVar, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from ..compilation.xla_cpu import written_in_place
from .dense_samples import DenseSampleRecorder
from .problem import AbstractProblem
from .runge_kutta import Lanes
from .sample_times import Collected, Read, Rows, SampleTimes, components
from .scheduler import AbstractRecorder, InLanes, LaneScheduler, Outcome
from .settings import Settings
from .status import FAILED, REACHED_END, RUNNING
from .step import LaneState, length_to_try, try_step, until_jump
from .tuned_pair import AbstractTunedPair

#: Largest factor by which a step is stretched to end on a sample: its error stays below the tolerance, because steps
#: are proposed with a margin of `step.SAFETY`.
STRETCH = 1.08


class Record(NamedTuple):
    """Record of a period: whether the last step was accepted and the number of the next sample, in every lane; after each
    iteration the states, and the numbers of the samples there, if any."""

    accepted: Bool[Array, " lanes"]
    sample: Int[Array, " lanes"]
    rows: Rows


class SampleRecorder(AbstractRecorder):
    """Lets steps end on the sample times of every cell, and collects the samples."""

    times: SampleTimes

    # As many iterations as fit the caches with their record.
    period: ClassVar[int] = 64

    def begin(self, in_lanes: InLanes, lane_state: LaneState, collected: Collected) -> Record:
        accepted = jnp.ones(collected.sample.shape, bool)
        return Record(accepted, collected.sample, self.times.empty_rows(self.period, lane_state))

    def has_room(self, record: Record, iteration: Int[Array, ""]) -> Bool[Array, ""]:
        return iteration < self.period

    def step(
        self, in_lanes: InLanes, lane_state: LaneState, record: Record, iteration: Int[Array, ""]
    ) -> tuple[LaneState, Record]:
        accepted, sample, rows = record
        new_lanes, _, is_sample = step_towards_sample(self.times, in_lanes, lane_state, accepted, sample)
        entry = Rows(new_lanes.state, jnp.where(is_sample, sample, len(self.times)))
        rows = jax.tree.map(functools.partial(written_in_place, at=iteration), rows, entry)
        return new_lanes, Record(new_lanes.time > lane_state.time, sample + is_sample, rows)

    def collect(self, collected: Collected, record: Record, ended: LaneState, refilled: LaneState) -> Collected:
        return self.times.collect(collected, record.rows, record.sample, ended, refilled)


def step_towards_sample(
    times: SampleTimes,
    in_lanes: InLanes,
    lane_state: LaneState,
    accepted: Bool[Array, " lanes"],
    sample: Int[Array, " lanes"],
) -> tuple[LaneState, Lanes, Bool[Array, " lanes"]]:
    """Try a step in every lane that does not pass its next sample.

    **Arguments:** `accepted`: whether the previous step was accepted; `sample`: the index of the next sample.

    **Returns:** the lanes after the step; the length that was tried [s]; and whether the step ended on the sample.
    """
    problem, control, atol = in_lanes
    next_time = times.time_of(sample, lane_state)
    control_to_target = control._replace(t1=jnp.minimum(next_time, control.t1))
    # Even lengths up to the sample or, if it comes first, to the jump.
    target = until_jump(problem, control_to_target, lane_state).t1
    even_length = _even(lane_state.length, target - lane_state.time, lane_state.bracketing)
    # The step after a rejected step is shorter on purpose, because it may have to end on a minimum of a margin.
    length = jnp.where(accepted, even_length, jnp.minimum(even_length, lane_state.length))
    lane_state = lane_state._replace(length=length)
    new_lanes = try_step(problem, control_to_target, atol, lane_state)
    at_target = (lane_state.status == RUNNING) & (new_lanes.status == REACHED_END)
    goes_on = at_target & (new_lanes.time < control.t1)
    status = jnp.where(new_lanes.steps < control.max_steps, RUNNING, FAILED)
    new_lanes = new_lanes._replace(status=jnp.where(goes_on, status, new_lanes.status))
    tried_length = length_to_try(until_jump(problem, control_to_target, lane_state), lane_state)
    return new_lanes, tried_length, at_target & (new_lanes.time >= next_time)


def solve_with_samples(
    problem: AbstractProblem,
    times: Float[Array, "times *cells"],
    t1: Float[Array, "..."],
    cells: Int[Array, ""],
    settings: Settings,
    *,
    n_blocks: int = 1,
    one_kernel: bool = False,
    read: Read = components,
    dense: bool = False,
) -> tuple[Outcome, Any]:
    """Run every cell from t = 0 to its event, to the end of the model's validity, or to `t1`, and sample it.

    **Arguments:** as for `LaneScheduler.of`, and

    - `times`: times of the samples [s], strictly increasing, at least 0; (times,) for all cells or (times, cells). Runs do not
      reach times after `t1`. Samples are not differentiable with respect to `times`, nor, if `dense`, to `t1`.
    - `read`: function of cells (lanes,) and states (rows, components, lanes) that returns the values to keep, a
      tree of arrays (rows, lanes, ...); by default the states themselves. Keeping less saves time and memory.
    - `dense`: whether to interpolate the samples inside steps of `Oscillatory8` or `Stabilized8`
      (`dense_samples.py`), which takes less time where there are more samples than steps. Otherwise steps end on
      the samples.

    **Returns:** the `Outcome`, without crossing times; and the kept values at the times, with the first axes (cells,
    times), NaN after the end of a run. By default, these are an array (cells, times, components).

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
    sample_times = SampleTimes.of(times, scheduler.capacity, read)
    solver, recorder = settings.for_lanes, SampleRecorder(sample_times)
    if dense and isinstance(solver, AbstractTunedPair):
        recorder = DenseSampleRecorder(sample_times, solver.middle)
    at_start = sample_times.at_start(scheduler.start().lane_state, scheduler.fresh.state)
    outcome, _, collected = scheduler.recorded(recorder, at_start)
    return outcome, collected.samples


def _even(length: Lanes, left: Lanes, bracketing: Array) -> Lanes:
    """The length of a step, changed a little if one or two steps then end on the next sample; NaN if the time of the sample
    is NaN, so that the run ends."""
    reach = STRETCH * length
    fitting = jnp.where(reach >= left, left, jnp.where(2.0 * reach >= left, 0.5 * left, jnp.minimum(length, left)))
    return jnp.where(bracketing, length, fitting)
