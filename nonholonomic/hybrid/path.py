"""One hybrid run with its path: the modes of `ensemble.py`, each integrated by any solver of Diffrax."""

import dataclasses
from collections.abc import Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from ..compilation.compiled_programs import padded
from ..compilation.xla_cpu import compiled_quickly
from ..integration import AbstractProblem, DenseSolution, Outcome, Settings, follow
from ..integration.dense import PIECE_OF_MODE
from ..integration.status import FAILED, LEFT_DOMAIN, REACHED_END, UNRESOLVED
from .ensemble import Carry, after_reset, after_solve, at_start, host_rounds, resolution
from .mode import AbstractBatchedMode, Transition

#: The number of a segment between two modes.
BETWEEN = -1


class Segment(NamedTuple):
    """A segment of a run: from `begin` to `end` [s], in the mode numbered `number`, or `BETWEEN` two modes.

    `motion` is the `DenseSolution` in the mode, its times counted from `begin`, or one stretch of a `TransitionPath`;
    `shown` holds the default output times [s].

    **Example:** as for `solve_hybrid_dense`.

    >>> from nonholonomic.hybrid import solve_hybrid_dense
    >>> path = solve_hybrid_dense((Bounce(jnp.array([0.6])),), 0, start[:, 0], 0.4, settings, counters=1)
    >>> [(segment.begin, segment.end, segment.number) for segment in path.segments]
    [(0.0, 0.4, 0)]
    """

    begin: float
    end: float
    number: int
    mode: AbstractBatchedMode
    motion: Any
    shown: Float[np.ndarray, " times"]

    def at(self, times: Float[np.ndarray, " times"]) -> Float[np.ndarray, "shown times"]:
        """The output rows at times within the segment."""
        elapsed = np.maximum(times - self.begin, 0.0)
        if self.number == BETWEEN:
            return np.asarray(_between(self.mode, self.motion, jnp.asarray(np.minimum(elapsed, self.end - self.begin))))
        return np.asarray(_shown(self.mode, jnp.asarray(self.motion.at(np.minimum(elapsed, self.motion.times[-1])))))


class HybridPath(NamedTuple):
    """A hybrid run: its segments in order, how and when [s] it ended, its final state, and its cost.

    `status` is a code as in a `HybridOutcome`, and `mode` the index of the last mode; `counts` holds the counters.

    **Example:** as for `solve_hybrid_dense`.

    >>> from nonholonomic.hybrid import solve_hybrid_dense
    >>> path = solve_hybrid_dense((Bounce(jnp.array([0.6])),), 0, start[:, 0], 0.4, settings, counters=1)
    >>> path.failed, path.end_time, path.counts.tolist()
    (False, 0.4, [0])
    """

    segments: list[Segment]
    status: int
    end_time: float
    state: Float[np.ndarray, " components"]
    counts: Int[np.ndarray, " counters"]
    accepted: int
    rejected: int
    mode: int

    @property
    def left_domain(self) -> bool:
        """Whether the run ended where the model ceases to hold."""
        return self.status == LEFT_DOMAIN

    @property
    def failed(self) -> bool:
        """Whether the integration failed."""
        return self.status in (FAILED, UNRESOLVED)

    @property
    def mode_segments(self) -> list[Segment]:
        """The segments in modes, without those of zero length."""
        return [segment for segment in self.segments if segment.number != BETWEEN and segment.end > segment.begin]

    @property
    def times(self) -> Float[np.ndarray, " times"]:
        """The default output times [s]: the times of all steps."""
        return np.unique(
            np.minimum(np.concatenate([np.zeros(1), *(segment.shown for segment in self.segments)]), self.end_time)
        )

    @property
    def states(self) -> Float[np.ndarray, "shown times"]:
        """The output rows at these times."""
        return self.at(self.times)

    def numbers(self, times: Float[np.ndarray, " times"]) -> Int[np.ndarray, " times"]:
        """The indices of the modes at given times, or `BETWEEN`."""
        return np.array([segment.number for segment in self.segments])[self._where(times)]

    def at(self, times: Float[np.ndarray, " times"]) -> Float[np.ndarray, "shown times"]:
        """The output rows at the given times, which must lie within the run; at the end of a segment, before the reset."""
        if not len(times):
            return self.segments[0].at(np.zeros(1))[:, :0]
        segment_indices, by_segment = self._where(times), []
        for index in np.unique(segment_indices):
            indices = np.flatnonzero(segment_indices == index)
            # Padded to one length, so that one program serves all segments.
            by_segment.append((indices, self.segments[index].at(padded(times[indices], len(times)))[:, : indices.size]))
        output = np.empty((len(by_segment[0][1]), len(times)))
        for indices, values in by_segment:
            output[:, indices] = values
        return output

    def _where(self, times: Float[np.ndarray, " times"]) -> Int[np.ndarray, " times"]:
        begins, ends = np.array([(segment.begin, segment.end) for segment in self.segments]).T
        ends = np.maximum.accumulate(ends + resolution(begins, ends))
        return np.minimum(np.searchsorted(ends, times), len(ends) - 1)


@eqx.filter_jit
def _problem(mode: AbstractBatchedMode, state: Float[Array | np.ndarray, " components"]) -> AbstractProblem:
    """The motion in a mode of one cell, as a problem without an axis of cells."""
    mode_of_cell = jax.tree.map(lambda leaf: leaf[..., 0] if eqx.is_array(leaf) and leaf.ndim else leaf, mode)
    return mode_of_cell.problem(state)


@compiled_quickly
def _leave(mode: AbstractBatchedMode, state: Float[Array, " components"], left: Float[Array, ""]) -> Transition:
    return mode.reset_map(state[:, None], left[None])


@eqx.filter_jit
def _shown(mode: AbstractBatchedMode, states: Float[Array, "components times"]) -> Float[Array, "shown times"]:
    return mode.shown(states)


@eqx.filter_jit
def _between(mode: AbstractBatchedMode, motion: Any, elapsed: Float[Array, " times"]) -> Float[Array, "shown times"]:
    return mode.between(motion, elapsed)


def solve_hybrid_dense(
    modes: tuple[AbstractBatchedMode, ...],
    number: int,
    state: Float[Array | np.ndarray, " components"],
    t1: float,
    settings: Settings,
    *,
    counters: int,
) -> HybridPath:
    """Integrate one run through its modes to `t1`, to an event during a transition, or to where the model ends.

    **Arguments:**

    - `modes`: as for `solve_hybrid`, for one cell; each mode must begin with a positive margin. The path includes the
      transitions that the modes record.
    - `number`, `state`: initial mode and state.
    - `t1`: horizon [s].
    - `settings`: as for `follow`; `max_steps` limits the steps of the whole run.
    - `counters`: number of counters, the rows of `Transition.counts`.

    **Returns:** a `HybridPath`.

    **Example:** a ball that rises in closed form, recorded as a transition, and falls from 0.722438 s on.

    >>> from nonholonomic.hybrid import TransitionPath, solve_hybrid_dense
    >>> class Rise(Bounce):
    ...     def reset_map(self, state, left):
    ...         rise = -self.restitution * state[1] / 9.81
    ...         apex = jnp.stack([0.5 * 9.81 * rise**2, 0.0 * rise])
    ...         record = TransitionPath(rise[None], rise[None], jnp.full((1, 1), 3))
    ...         return super().reset_map(state, left)._replace(state=apex, elapsed=rise, record=record)
    ...     def between(self, rise, passed):
    ...         return 9.81 * jnp.stack([rise * passed - 0.5 * passed**2, rise - passed])
    >>> path = solve_hybrid_dense((Rise(jnp.array([0.6])),), 0, start[:, 0], 1.0, settings, counters=1)
    >>> times = np.array([0.6, 0.8])
    >>> print(path.at(times)[0].round(5), path.numbers(times))
    [0.28647 0.33049] [-1  0]
    """

    def solve(numbers: Sequence[int], carry: Carry, active: Bool[np.ndarray, "1"]) -> Carry:
        if not active[0]:
            return carry
        (runs, segments), (number,), mode, start_time = carry, numbers, modes[numbers[0]], float(carry[0].end_time[0])
        mode_settings = dataclasses.replace(settings, max_steps=settings.max_steps - int(runs.steps[0]))
        problem = _problem(mode, jnp.asarray(runs.state[:, 0]))
        path = follow(problem, t1 - start_time, mode_settings, piece=PIECE_OF_MODE)
        end = start_time + float(path.times[-1])
        segment = Segment(start_time, end, number, mode, path, start_time + path.times[1:])
        return after_solve(np, runs, _outcome(path), np.full(1, t1)), [*segments, segment]

    def reset(numbers: Sequence[int], carry: Carry, lost: Bool[np.ndarray, "1"]) -> Carry:
        if not lost[0]:
            return carry
        (runs, segments), mode, start_time = carry, modes[numbers[0]], float(carry[0].end_time[0])
        transition = _leave(mode, jnp.asarray(runs.state[:, 0]), jnp.asarray(t1 - start_time))
        segments = segments + _way(mode, transition, start_time)
        # NumPy slices these arrays, because JAX would compile every slice.
        transition = jax.tree.map(np.asarray, transition._replace(record=None))
        return after_reset(np, runs, transition, np.full(1, t1)), segments

    start = at_start(np, np.full(1, number), np.asarray(state)[:, None], 1, counters)
    runs, segments = host_rounds((start, []), [(mode,) for mode in range(len(modes))], solve, reset)
    end_time, status, steps, rejected = (
        values[0].item() for values in (runs.end_time, runs.status, runs.steps, runs.rejected)
    )
    if not (np.isfinite(runs.state).all() and np.isfinite(end_time)):
        end_time = segments[-1].end
    ending = (runs.state[:, 0], runs.counts[:, 0], steps - rejected, rejected, runs.mode[0].item())
    return HybridPath(segments, status, end_time, *ending)


def _outcome(path: DenseSolution) -> Outcome[np.ndarray]:
    """How the motion in a mode ended, as for an ensemble of one cell."""
    status = FAILED if path.failed else LEFT_DOMAIN if path.left_domain else REACHED_END
    no_crossing, steps = np.full(1, np.inf), path.accepted + path.rejected
    ending = (np.asarray(path.times[-1:]), np.asarray(path.states[:, -1:]))
    return Outcome(np.full(1, status), no_crossing, no_crossing, *ending, np.full(1, steps), np.full(1, path.rejected))


def _way(mode: AbstractBatchedMode, transition: Transition, start: float) -> list[Segment]:
    """The segments of a transition that begins at a time [s]."""
    if transition.record is None:
        return []
    ends = np.asarray(transition.record.ends)[:, 0]
    ends, segments = start + ends[np.isfinite(ends)], []
    motions, parts = jax.tree.map(np.asarray, (transition.record.motions, transition.record.shown))
    for index, end in enumerate(ends):
        start = float(ends[index - 1]) if index else start
        motion = jax.tree.map(lambda leaf, index=index: leaf[index].copy(), motions)
        output_times = start + (end - start) * np.linspace(0.0, 1.0, int(parts[index, 0]) + 1)[1:]
        segments.append(Segment(start, float(end), BETWEEN, mode, motion, output_times))
    return segments
