"""Try one step in every lane: step-size control, events, and the new status of each lane.

When a step ends beyond an event, the lane locates the event: it repeats the step from the same start with other
lengths, until the step ends on the event. The time of the event therefore has the accuracy of the method.
"""

import functools
from typing import NamedTuple

import diffrax
import jax
import jax.numpy as jnp
from jax.lax import stop_gradient
from jaxtyping import Array, Float

from ..compilation.xla_cpu import stored
from .events import Bracket, Path, missed_double_root, missed_loss, refine, watched
from .problem import CROSSED, FAILED, LEFT_DOMAIN, REACHED_END, RUNNING, AbstractProblem, crossing_time
from .runge_kutta import (
    Integers,
    Lanes,
    Mask,
    Stages,
    States,
    Step,
    explicit_step,
    inverse_root,
    memory_for_stages,
    scaled_error,
    stages_to_look,
    watched_places,
)

#: Steps are not cut below this fraction of the horizon, or of the time so far and a second, because of a fast function, whose
#: minimum may be zero.
SHORTEST_CUT = 1e-9

#: Step-size control as in Diffrax's I controller with its defaults.
SAFETY, SHRINK, GROW = 0.9, 0.2, 10.0


class Control(NamedTuple):
    """Options of the steps.

    `tableau` and `order` are the method's; `rtol` is the relative tolerance; `t1` the horizon [s], one for all or one
    per lane; a lane that needs more than `max_steps` has failed; `nonterminal` is true for a nonterminal event; `n_blocks` is
    the number of equal blocks of the state, such as a state and its variations: the block with the largest error
    controls the step.
    """

    tableau: diffrax.ButcherTableau
    order: int
    rtol: Float[Array, ""]
    t1: Float[Array, "..."]
    max_steps: int
    nonterminal: bool
    n_blocks: int


class LaneState(NamedTuple):
    """The state of the lanes.

    - `cell`: which cell of the problem a lane runs; `status`: a code of `problem.py`.
    - `time` [s], `state`, `rate`: where the lane is, and the field there.
    - `length`: length of the next step [s], unless the horizon is nearer.
    - `side`: 1 before the event, -1 beyond it; `margin`: the least of the margins and of `side` times the event
      function.
    - `margins`: the margins of the problem, `None` if there are none.
    - `first_crossing`, `crossing_time`: times of the first and the last event passed [s], infinite if there was none.
    - `bracketing`: whether the lane is locating an event; `bracket`: the current bracket.
    - `steps`: number of all steps; `rejected`: number of steps that step-size control rejected; `extremes`: the
      shortest length that it asked for after a rejection, the time of that, and the longest step, all [s].
    - `stages`: memory for the stages of the next step (`explicit_step`); `None` outside of a loop over steps.

    **Example:**

    >>> from nonholonomic.integration import LaneState
    >>> LaneState._fields[:5]
    ('cell', 'status', 'time', 'state', 'rate')
    """

    cell: Integers
    status: Integers
    time: Lanes
    state: States
    rate: States
    length: Lanes
    side: Lanes
    margin: Lanes
    margins: Float[Array, "margins *lanes"] | None
    first_crossing: Lanes
    crossing_time: Lanes
    bracketing: Mask
    bracket: Bracket
    steps: Integers
    rejected: Integers
    extremes: Float[Array, "3 *lanes"]
    stages: Stages | None = None


def length_to_try(problem: AbstractProblem, control: Control, lane_state: LaneState) -> Lanes:
    """Length of each lane's next step [s]: the last one before a jump or the horizon ends exactly there, even where round-off
    would miss it.
    """
    left = until_jump(problem, control, lane_state).t1 - lane_state.time
    return jnp.where(~lane_state.bracketing & (lane_state.length >= left * (1.0 - 1e-12)), left, lane_state.length)


def try_step(problem: AbstractProblem, control: Control, atol: States, lane_state: LaneState) -> LaneState:
    """Try a step in every lane and update the lanes.

    **Arguments:**

    - `problem`: the problem; every leaf is a scalar or has one number per lane.
    - `control`: the method and its tolerances.
    - `atol`: absolute tolerances, (components, lanes).
    - `lane_state`: the lanes; those that have ended do not change.

    **Returns:** the lanes after the step.
    """
    return after_step(problem, control, atol, lane_state, *trial_step(problem, control, lane_state))


def until_jump(problem: AbstractProblem, control: Control, lane_state: LaneState) -> Control:
    """The control with the near side of the next jump as the horizon of each lane, if the jump comes first."""
    jumps = problem.jumps(lane_state.time, lane_state.state)
    return control if jumps is None else control._replace(t1=jnp.minimum(control.t1, jumps.next(lane_state.time)))


def past_jump(
    problem: AbstractProblem, control: Control, near: Control, lane_state: LaneState, new_lanes: LaneState
) -> LaneState:
    """Move the lanes whose step ended on the near side of a jump to the far side, where margins or the event function
    may be negative. **Arguments:** `near`: as from `until_jump`; `lane_state`, `new_lanes`: before and after the step."""
    jumps = problem.jumps(new_lanes.time, new_lanes.state)
    if jumps is None:
        return new_lanes
    is_jump, _, far = jumps.sides(new_lanes.time)
    landed = is_jump & (lane_state.status == RUNNING) & (new_lanes.status == REACHED_END) & (near.t1 <= new_lanes.time)

    def moved() -> tuple[States, States, Lanes, Float[Array, "margins *lanes"] | None]:
        state = problem.across_jump(new_lanes.time, new_lanes.state)
        rate, margins = problem.field(far, state), problem.margins(far, state)
        margin = stop_gradient(problem.least_margin(new_lanes.side, far, state, rate))
        of_far_side = (state, rate, margin, stop_gradient(jnp.stack(margins)) if margins else None)
        return jax.tree.map(lambda new, old: jnp.where(landed, new, old), of_far_side, of_near_side)

    of_near_side = (new_lanes.state, new_lanes.rate, new_lanes.margin, new_lanes.margins)
    state, rate, margin, margins = jax.lax.cond(jnp.any(landed), moved, lambda: of_near_side)
    time, hit = jnp.where(landed, far, new_lanes.time), landed & (margin <= 0.0)
    lanes = new_lanes._replace(status=jnp.where(landed, RUNNING, new_lanes.status))
    status, side, first, latest_crossing = _classify(problem, control, lanes, time, state, margins, hit)
    failed = landed & ~hit & (new_lanes.steps >= control.max_steps)
    status = jnp.where(landed & ~hit & (time >= control.t1), REACHED_END, jnp.where(failed, FAILED, status))
    return new_lanes._replace(
        status=status,
        time=time,
        state=state,
        rate=rate,
        side=side,
        margin=jnp.where(hit, jnp.abs(margin), margin),
        margins=margins,
        first_crossing=first,
        crossing_time=latest_crossing,
    )


def trial_step(problem: AbstractProblem, control: Control, lane_state: LaneState) -> tuple[Lanes, Step]:
    """The length of each lane's next step [s], and the step."""
    tried_length = length_to_try(problem, control, lane_state)
    crossing = functools.partial(problem.crossing_on, lane_state.side)
    start = (lane_state.time, lane_state.state, lane_state.rate, tried_length, lane_state.margins)
    stages = memory_for_stages(control.tableau, lane_state.state) if lane_state.stages is None else lane_state.stages
    looks = looks_of(problem, control.tableau, lane_state)
    return tried_length, explicit_step(control.tableau, problem.field, problem.margins, crossing, *start, stages, looks)


def looks_of(problem: AbstractProblem, tableau: diffrax.ButcherTableau, lane_state: LaneState) -> list[int]:
    """The stages at which slow margins and a slow event function are evaluated; `watched` looks at the fast ones."""
    fast_margins, fast_event = problem.fast
    return [] if fast_event and (fast_margins or lane_state.margins is None) else stages_to_look(tableau.c)


def after_step(
    problem: AbstractProblem, control: Control, atol: States, lane_state: LaneState, tried_length: Lanes, trial: Step
) -> LaneState:
    """Update each lane after a trial step, and move it across a jump on which the step ended.

    **Arguments:** as for `try_step`; `tried_length` contains the lengths of the steps [s], and `trial` their results.

    **Returns:** the lanes after the step.
    """
    near = until_jump(problem, control, lane_state)
    new_lanes = before_jump(problem, near, atol, lane_state, tried_length, trial)
    return past_jump(problem, control, near, lane_state, new_lanes)


def before_jump(
    problem: AbstractProblem, control: Control, atol: States, lane_state: LaneState, tried_length: Lanes, trial: Step
) -> LaneState:
    """The lanes after a trial step, on the near side of a jump. **Arguments:** as for `after_step`; `control`: as from
    `until_jump`."""
    running = lane_state.status == RUNNING
    free = running & ~lane_state.bracketing
    error = scaled_error(
        *stop_gradient((trial.error, lane_state.state, trial.state)), control.rtol, atol, control.n_blocks
    )
    # An event is located where the margin is round-off. Stored jointly, behind a barrier, the margin is computed once;
    # otherwise the compiler would fuse it into several kernels with different round-off, and only some of them would
    # detect the event.
    error, margin = stored(error, stop_gradient(trial.margin))
    is_known = jnp.isfinite(error)
    # A step to a state that is not finite counts as one with a huge error.
    error = jnp.where(is_known & ~jnp.isnan(margin), error, jnp.inf)
    accurate = error <= 1.0
    # Negative inside the step: end the step there and check again, so that the first of several events is located.
    fast_margins, fast_event = problem.fast
    start = (lane_state.state, lane_state.rate)
    negative = trial.first_negative
    if not fast_event:
        event = missed_double_root(problem.event_function, lane_state.side, start, trial, tried_length)
        negative = jnp.minimum(negative, stop_gradient(event))
    if not fast_margins:
        places = watched_places(control.tableau, looks_of(problem, control.tableau, lane_state))
        negative = jnp.minimum(negative, missed_loss(places, stop_gradient(trial.margins), free & accurate))
    longest = None
    if fast_margins or fast_event:
        path = Path.of(lane_state.time, tried_length, start, trial.middle, (trial.state, trial.rate))
        checked = free & accurate
        may_cut = checked & (tried_length > SHORTEST_CUT * jnp.minimum(control.t1, lane_state.time + 1.0))
        place, longest = watched(problem, lane_state.side, path, checked, may_cut)
        negative = jnp.minimum(negative, place)
    crosses_inside = accurate & (negative < 1.0)
    is_beyond = accurate & ~crosses_inside & (margin <= 0.0)
    forward = free & accurate & ~crosses_inside & ~is_beyond

    bracket, guess, is_located = refine(
        lane_state.bracketing, lane_state.bracket, lane_state.margin, margin, tried_length
    )
    # A step that starts within round-off before an event is cut again and again, until it is round-off too: the event is
    # there.
    eps = jnp.finfo(lane_state.time.dtype).eps
    at_start = free & crosses_inside & (tried_length * negative <= 8.0 * eps * jnp.maximum(lane_state.time, 1e-3))
    hit = (running & is_located) | at_start
    bracketing = (lane_state.bracketing | (free & is_beyond)) & ~hit
    moved = forward | hit
    time = jnp.where(moved, lane_state.time + tried_length, lane_state.time)

    factor = SAFETY * inverse_root(jnp.maximum(error, 1e-30), control.order)
    length = tried_length * jnp.where(accurate, jnp.clip(factor, 1.0, GROW), jnp.clip(factor, SHRINK, SAFETY))
    least, place, longest_step = lane_state.extremes
    is_shorter = free & is_known & ~accurate & (length < least)
    least, place = (jnp.where(is_shorter, *pair) for pair in ((length, least), (lane_state.time, place)))
    longest_step = jnp.where(forward, jnp.maximum(longest_step, tried_length), longest_step)
    length = length if longest is None else jnp.where(accurate, jnp.minimum(length, longest), length)
    length = jnp.where(crosses_inside, tried_length * negative, length)
    length = jnp.where(bracketing, guess, jnp.where(hit, bracket.stride, length))
    margins = None if trial.margins is None else stop_gradient(trial.margins[-1])
    status, side, first, latest_crossing = _classify(problem, control, lane_state, time, trial.state, margins, hit)
    ended = running & (status == RUNNING) & moved & (time >= control.t1)
    steps = lane_state.steps + running
    # Written so that a NaN length counts as stuck.
    shortest = 8.0 * eps * jnp.maximum(time, 1e-3)
    stuck = free & ~forward & ~bracketing & ~hit & ~(length > shortest)
    stuck |= forward & (time == lane_state.time) & (tried_length > 0.0)
    failed = running & (status == RUNNING) & ~ended & (stuck | (steps >= control.max_steps))
    status = jnp.where(failed, FAILED, jnp.where(ended, REACHED_END, status))
    return LaneState(
        cell=lane_state.cell,
        status=status,
        time=jnp.where(ended, control.t1, time),
        state=jnp.where(moved, trial.state, lane_state.state),
        rate=jnp.where(moved, trial.rate, lane_state.rate),
        length=length,
        side=side,
        # Just past a crossing the margin is round-off of either sign.
        margin=jnp.where(hit, jnp.abs(margin), jnp.where(forward, margin, lane_state.margin)),
        margins=jax.tree.map(functools.partial(jnp.where, moved), margins, lane_state.margins),
        first_crossing=first,
        crossing_time=latest_crossing,
        bracketing=bracketing,
        bracket=bracket,
        steps=steps,
        rejected=lane_state.rejected + (free & ~forward & ~is_beyond),
        extremes=stop_gradient(jnp.stack((least, place, longest_step))),
        stages=None if lane_state.stages is None else trial.stages,
    )


def _classify(
    problem: AbstractProblem,
    control: Control,
    lane_state: LaneState,
    time: Lanes,
    state: States,
    margins: Float[Array, "margins *lanes"] | None,
    hit: Mask,
) -> tuple[Integers, Lanes, Lanes, Lanes]:
    """Status, side, first and latest crossing time of the lanes at this time, where `hit` marks the lanes in which an event
    was located."""
    crossing = problem.event_function(state)
    # The located event belongs to the lesser of the margins and the event function, whose sign may be round-off.
    by_margin = hit
    if crossing is not None:
        by_margin = hit & (False if margins is None else jnp.min(margins, axis=0) <= lane_state.side * crossing)
    crossed = hit & ~by_margin
    if not control.nonterminal:
        status = jnp.where(hit, jnp.where(by_margin, LEFT_DOMAIN, CROSSED), lane_state.status)
        if not problem.direction_decides:
            return status, lane_state.side, lane_state.first_crossing, lane_state.crossing_time
        # A run that started beyond the event is now before the event.
        returns = crossed & (lane_state.side < 0.0)
        status, side = jnp.where(returns, lane_state.status, status), jnp.where(returns, 1.0, lane_state.side)
        return status, side, lane_state.first_crossing, lane_state.crossing_time
    # Only a crossing from positive to negative is the event; the return does not count.
    counts = crossed & (lane_state.side > 0.0)
    time_of_crossing = crossing_time(problem, time, state)
    first = jnp.where(counts & jnp.isinf(lane_state.first_crossing), time_of_crossing, lane_state.first_crossing)
    latest_crossing = jnp.where(counts, time_of_crossing, lane_state.crossing_time)
    status = jnp.where(by_margin, LEFT_DOMAIN, lane_state.status)
    return status, jnp.where(crossed, -lane_state.side, lane_state.side), first, latest_crossing
