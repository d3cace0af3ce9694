"""A mode: its equations of motion, and its transition to the next mode, which may take time."""

import abc
from collections.abc import Callable
from typing import Any, ClassVar, Generic, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from ..integration import AbstractProblem
from ..integration.scheduler import Numbers


class TransitionPath(NamedTuple):
    """Path of a single run from one mode to the next, as successive stretches of motion in closed form.

    - `ends`: when each stretch ends [s], counted from the end of the mode; infinite for unused entries.
    - `motions`: for each stretch the argument of `AbstractBatchedMode.between`; the first axis of every leaf counts the
      stretches.
    - `shown`: number of default output times of each stretch.

    **Example:** a hop of 0.4 s in closed form, drawn with three points.

    >>> from nonholonomic.hybrid import TransitionPath
    >>> record = TransitionPath(jnp.array([[0.4]]), {"speed": jnp.array([[1.962]])}, jnp.array([[3]]))
    """

    ends: Float[Array, " stretches 1"]
    motions: Any
    shown: Int[Array, " stretches 1"]


class Transition(NamedTuple, Generic[Numbers]):
    """The result of a reset map, one number per cell.

    `status` is `RUNNING` where the motion continues in the mode numbered `mode`, otherwise the code for how it ended;
    `state` is the new state, `elapsed` [s] the duration of the transition, and `crossing_time` [s] the last time of the
    event during the transition, infinite if there was none. `counts` contains the counters, one per row. `record` is
    the path of a single run (`ensemble.py`); `None` for instantaneous transitions, or where no path is kept. `log_rates` is
    the sum of the logarithms of the rates of the event functions at the events during the transition; `None` if there
    are none.

    **Example:** the bounce of both balls at 5 m/s.

    >>> transition = modes[0].reset_map(jnp.array([[0.0, 0.0], [-5.0, -5.0]]), jnp.ones(2))
    >>> print(transition.state[1], transition.mode)
    [3. 4.] [0 0]
    """

    mode: Int[Numbers, " cells"]
    state: Float[Numbers, "components cells"]
    elapsed: Float[Numbers, " cells"]
    status: Int[Numbers, " cells"]
    crossing_time: Float[Numbers, " cells"]
    counts: Int[Numbers, "counters cells"]
    record: TransitionPath | None = None
    log_rates: Float[Numbers, " cells"] | None = None


class AbstractBatchedMode(eqx.Module):
    """One mode of a hybrid system. Its leaves are scalars, or hold one number per cell in their last axis.

    **Example:** the mode of the subpackage's example, at its start.

    >>> print(modes[0].problem(start).field(0.0, start)[1])
    [-9.81 -9.81]
    """

    @property
    def rare(self) -> bool:
        """Whether few runs enter the mode: its programs are compiled when a run enters it, not beforehand."""
        return False

    @abc.abstractmethod
    def problem(self, state: Float[Array, "components cells"]) -> AbstractProblem:
        """The motion in this mode from the given states; the mode ends where the problem's domain margin vanishes."""

    @abc.abstractmethod
    def reset_map(self, state: Float[Array, "components cells"], left: Float[Array, " cells"]) -> Transition:
        """Map the states at the end of the mode, where the domain margin vanishes, to the start of the next mode.

        **Arguments:**

        - `state`: the states at the end of the mode.
        - `left`: time [s] to the horizon.

        **Returns:** a `Transition`, which ends with `REACHED_END` where it would take longer than `left`.
        """

    def shown(self, state: Float[Array, "components times"]) -> Float[Array, "shown times"]:
        """Map mode states to output rows; every mode must return the same number of rows."""
        return state

    def between(self, motion: Any, passed: Float[Array, " times"]) -> Float[Array, "shown times"]:
        """The output rows of one stretch in `Transition.record`, at times [s] counted from its start."""
        raise NotImplementedError(f"{type(self).__name__} records stretches but does not say what they show")


class AbstractHoppingMode(AbstractBatchedMode):
    """A mode whose reset map is a succession of stretches of motion in closed form, each with a jump at its end.

    The reset map continues while `open` is true for the current stretch, for at most `most_hops` stretches; `elapsed`
    [s] of a stretch is the time since the end of the mode.

    **Example:** small hops of a ball, and the first of them.

    >>> from typing import NamedTuple
    >>> from nonholonomic.hybrid import AbstractHoppingMode
    >>> class Hop(NamedTuple):
    ...     speed: jax.Array
    ...     elapsed: jax.Array
    ...     open: jax.Array
    >>> class Hops(Bounce, AbstractHoppingMode):
    ...     most_hops = 100
    ...     def lost(self, state):
    ...         return Hop(-self.restitution * state[1], 0.0 * state[1], state[1] < -0.1)
    ...     def hop(self, stretch, left):
    ...         end = stretch._replace(elapsed=stretch.elapsed + 2.0 * stretch.speed / 9.81)
    ...         return end, Hop(self.restitution * stretch.speed, end.elapsed, stretch.speed > 0.1)
    ...     def closed(self, stretch):
    ...         return self.reset_map(jnp.stack([0.0 * stretch.speed, -stretch.speed]), stretch.elapsed)
    ...     def motion_in(self, stretch):
    ...         return stretch.speed
    >>> hops = Hops(jnp.array([0.6, 0.8]))
    >>> end, following = hops.hop(hops.lost(jnp.array([[0.0, 0.0], [-9.81, -9.81]])), jnp.ones(2))
    >>> print(end.elapsed, (following.speed / 9.81).round(2))
    [1.2 1.6] [0.36 0.64]
    """

    most_hops: ClassVar[int]

    @abc.abstractmethod
    def lost(self, state: Float[Array, "components cells"]) -> Any:
        """The first stretch of motion after the mode, which starts from the states at its end."""

    @abc.abstractmethod
    def hop(self, stretch: Any, left: Float[Array, " cells"]) -> tuple[Any, Any]:
        """Follow one stretch of motion; `left` [s] is the time from the end of the mode to the horizon.

        **Returns:** the stretch at its end, before the jump; and the next stretch, after the jump.
        """

    @abc.abstractmethod
    def closed(self, stretch: Any) -> Transition:
        """The transition that the last stretch leads to, without a record."""

    @abc.abstractmethod
    def motion_in(self, stretch: Any) -> Any:
        """The argument of `between` for a stretch that begins."""


def over_cells(function: Callable[..., Any], mode: AbstractBatchedMode) -> Callable[..., Any]:
    """Map a function of the mode of one run, and of more arguments, over cells, which are in the last axis of every
    array."""

    def cells_axis(leaf: Any) -> int | None:
        return -1 if eqx.is_array(leaf) and leaf.ndim else None

    def mapped(*arguments: Any) -> Any:
        return eqx.filter_vmap(function, in_axes=(cells_axis, *[-1] * len(arguments)), out_axes=-1)(mode, *arguments)

    return mapped


def mode_of_cells(mode: AbstractBatchedMode, cell: Int[Numbers, " selected"]) -> AbstractBatchedMode:
    """The mode of the cells with these indices."""
    numbers, static = eqx.partition(mode, eqx.is_array)
    return eqx.combine(jax.tree.map(lambda leaf: leaf if leaf.ndim == 0 else leaf[..., cell], numbers), static)


# Output rows of runs between two modes, at given times, for many cells at once.

#: A sample this much later than the last stretch of a transition, as a fraction of the horizon, still belongs to it.
ROUND_OFF = 1e-13


def reset_with_rows(
    mode: AbstractBatchedMode,
    state: Float[Array, "components cells"],
    left: Float[Array, " cells"],
    times: Float[Array, "times cells"],
    t1: Float[Array, " cells"],
    weights: Float[Array, "shown times cells"] | None = None,
) -> tuple[Transition, Array | None]:
    """The transition to the next mode, and the output rows on the way.

    **Arguments:** `state`, `left`: as for `AbstractBatchedMode.reset_map`; `times`: the times of the samples [s],
    counted from the end of the mode; `t1`: horizon [s]; `weights`: factors of the rows, if only a sum of them is needed.

    **Returns:** the `Transition`, and the rows, which are meaningless at times outside the transition, or with `weights`
    their weighted sum in every cell; `None` if the mode records no path.
    """
    if isinstance(mode, AbstractHoppingMode):
        return _hops_with_rows(mode, state, left, times, ROUND_OFF * t1, weights)
    transition = mode.reset_map(state, left)
    if transition.record is None:
        return transition, None
    rows = over_cells(_rows_of_path, mode)(transition.record, times)
    return transition, rows if weights is None else jnp.sum(weighted(weights, rows), axis=(0, 1))


def weighted(weights: Float[Array, "..."], values: Float[Array, "..."]) -> Float[Array, "..."]:
    """Values times their weights; a value without a weight may be anything."""
    return jnp.where(weights == 0.0, 0.0, weights * values)


def _rows_of_path(
    mode: AbstractBatchedMode, record: TransitionPath, times: Float[Array, " times"]
) -> Float[Array, "shown times"]:
    """The output rows of one cell; after the last stretch they are meaningless."""
    ends = record.ends
    stretch = jnp.minimum(jnp.searchsorted(jax.lax.stop_gradient(ends), jax.lax.stop_gradient(times)), len(ends) - 1)
    start_time = jnp.where(stretch > 0, ends[jnp.maximum(stretch - 1, 0)], 0.0)
    motions = jax.tree.map(lambda leaf: jnp.moveaxis(leaf[stretch], 0, -1), record.motions)
    return mode.between(motions, jnp.where(jnp.isfinite(start_time), times - start_time, 0.0))


class Hops(NamedTuple):
    """A succession of stretches: the current one, the number of stretches so far, the output rows or their weighted sum,
    and the index of the next sample in every cell."""

    stretch: Any
    count: Int[Array, ""]
    rows: Float[Array, "*shown_times cells"]
    sample: Int[Array, " cells"]


def _hops_with_rows(
    mode: AbstractHoppingMode,
    state: Float[Array, "components cells"],
    left: Float[Array, " cells"],
    times: Float[Array, "times cells"],
    slack: Float[Array, " cells"],
    weights: Float[Array, "shown times cells"] | None,
) -> tuple[Transition, Float[Array, "*shown_times cells"]]:
    """The stretches one by one, each with the samples inside it. No path is kept, whose length is not known."""
    cells = jnp.arange(len(left))

    def with_values(rows: Array, row: Int[Array, " cells"], values: Float[Array, "shown cells"]) -> Array:
        if weights is None:
            return rows.at[:, row, cells].set(values, mode="drop", unique_indices=True)
        factors = weights.at[:, row, cells].get(mode="fill", fill_value=0.0)
        return rows + jnp.sum(weighted(factors, values), axis=0)

    def hop(hops: Hops) -> Hops:
        stretch, count, rows, sample = hops
        end, following = mode.hop(stretch, left)
        motion = mode.motion_in(stretch)
        # Rounding may put the end of the last stretch before a sample at the end of the transition.
        reach = end.elapsed + jnp.where(following.open, 0.0, slack)

        def next_time(sample: Int[Array, " cells"]) -> Float[Array, " cells"]:
            time = times[jnp.minimum(sample, len(times) - 1), cells]
            return jnp.where(sample < len(times), time, jnp.inf)

        def is_inside(sample: Int[Array, " cells"]) -> Bool[Array, " cells"]:
            return stretch.open & (next_time(sample) <= reach)

        def filled(carry: tuple[Array, Array]) -> tuple[Array, Array]:
            rows, sample = carry
            inside = is_inside(sample)
            passed = jnp.where(inside, next_time(sample) - stretch.elapsed, 0.0)
            row = jnp.where(inside, sample, len(times))
            return with_values(rows, row, mode.between(motion, passed)), sample + inside

        rows, sample = jax.lax.while_loop(lambda carry: jnp.any(is_inside(carry[1])), filled, (rows, sample))
        return Hops(following, count + 1, rows, sample)

    def goes_on(hops: Hops) -> Bool[Array, ""]:
        return jnp.any(hops.stretch.open) & (hops.count < mode.most_hops)

    start = mode.lost(state)
    row = jax.eval_shape(mode.between, mode.motion_in(start), start.elapsed)
    rows = jnp.zeros((len(row), *times.shape) if weights is None else left.shape)
    hops = Hops(start, jnp.zeros((), int), rows, jnp.sum(times <= 0.0, axis=0))
    hops = jax.lax.while_loop(goes_on, hop, hops)
    return mode.closed(hops.stretch), hops.rows
