"""Tangents of problems, variations of the state along a run, and the rate at which runs diverge.

A problem and its variations are one problem with a longer state, and run through the same loop as the problem alone;
differentiating the loop as a whole costs several times as much. For many tangents see `adjoint.py`.
"""

import functools
import math
import operator
from collections.abc import Callable
from typing import Any, TypeAlias

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.interpreters import partial_eval
from jax.lax import stop_gradient
from jaxtyping import Array, Bool, Float, Int, PyTree

from ..compilation.tracing import dependent_outputs
from ..compilation.xla_cpu import traced_once
from ..integration import AbstractProblem, Jumps, Lanes, Outcome, Settings, States, crossing_time, solve_ensemble
from ..integration.problem import REACHED_END, RUNNING, AbstractDerivedProblem
from ..integration.scheduler import LaneScheduler
from ..terminal import Progress

# Tangents of problems.

#: A tree like the problem, with the rate at which each number moves in its place; `None` for numbers that do not move.
Tangent: TypeAlias = PyTree

Tangents: TypeAlias = tuple[Tangent, ...]

#: The horizon [s], the number of cells and the settings of an ensemble solve.
RunOptions: TypeAlias = tuple[Float[Array, "..."], Int[Array, ""], Settings]

#: From leaves and a number of cells, `None` for a single run, to a problem.
Build: TypeAlias = Callable[[tuple[Array, ...], int | None], PyTree]


def tangent_scale(number: Float[Array, "..."]) -> Float[Array, "..."]:
    """The scale of a number's tangent: its own size, or 1 where it is zero.

    **Example:**

    >>> from nonholonomic.derivatives import tangent_scale
    >>> print(tangent_scale(jnp.array([0.0, -3.0])))
    [1. 3.]
    """
    return stop_gradient(jnp.where(number == 0.0, 1.0, jnp.abs(number)))


def tangents_of(
    build: Callable[..., PyTree], numbers: tuple[Array, ...], tangents: list[tuple[Array, ...]]
) -> Tangents:
    """The tangents of a problem that is built from numbers.

    **Arguments:**

    - `build`: numbers -> problem.
    - `numbers`: the arguments of `build`, arrays.
    - `tangents`: each with the rates at which the numbers move.

    **Returns:** for each tangent the tangent of the problem, `None` for leaves that depend on no number.

    **Example:**

    >>> from nonholonomic.derivatives import tangents_of
    >>> tangents = tangents_of(Decays, (jnp.ones(2),), [(jnp.array([1.0, 0.0]),)])
    >>> print(tangents[0].rate)
    [1. 0.]
    """

    # A problem may also hold functions.
    built = traced_once(lambda *numbers: eqx.filter(build(*numbers), eqx.is_inexact_array), *numbers)
    structure = jax.tree.structure(jax.eval_shape(built, *numbers))
    moving = jax.tree.unflatten(structure, dependent_outputs(built, *numbers))
    changes = [jax.jvp(built, numbers, tangent)[1] for tangent in tangents]
    return tuple(eqx.filter(change, moving) for change in changes)


def where_active(problem: PyTree, direction: Tangent) -> PyTree:
    """The numbers of a problem that a tangent moves, `None` for the others."""
    return jax.tree.map(
        lambda rate, number: None if rate is None else number, direction, problem, is_leaf=lambda rate: rate is None
    )


def moving_leaves(
    problem: AbstractProblem, direction: Tangent, functions: Callable[[AbstractProblem, States], PyTree]
) -> PyTree:
    """The leaves that a tangent moves, as far as some functions of problem and states depend on them, as a tree of
    booleans."""
    arrays, static = eqx.partition(problem, eqx.is_array)
    leaves, structure = jax.tree.flatten(arrays)

    def values(*leaves: Array) -> PyTree:
        return functions(eqx.combine(jax.tree.unflatten(structure, leaves), static), problem.start()[0])

    closed = jax.make_jaxpr(values)(*leaves)
    is_used = partial_eval.dce_jaxpr(closed.jaxpr, [True] * len(closed.jaxpr.outvars))[1]
    return jax.tree.map(
        lambda rate, is_used: bool(is_used) and rate is not None,
        direction,
        jax.tree.unflatten(structure, is_used),
        is_leaf=lambda rate: rate is None,
    )


def tangents_by(
    build: Build, active: tuple[int, ...], leaves: tuple[Array, ...], cells: int | None
) -> tuple[PyTree, Tangents, Callable[[list[PyTree]], list[PyTree]]]:
    """Build a problem and its tangents along leaves, each scaled by the leaf's own size.

    **Arguments:**

    - `build`: (leaves, cells) -> problem.
    - `active`, `leaves`: the leaves to move, and all leaves, of any shape. With `cells`, a leaf is a scalar or has the
      cells in its last axis. Each entry of a leaf has its own tangent.

    **Returns:** the problem; its tangents; and a function that turns derivatives along the tangents (trees of arrays,
    with `cells` in the first axis) into derivatives with respect to each leaf, the leaf's own axes last.

    **Example:** the tangent of a problem moves its rate by its own size.

    >>> problem, tangents, gather = tangents_by(build, (0,), (jnp.array([1.0, 2.0]),), 2)
    >>> print(tangents[0].rate)
    [1. 2.]
    """

    rebuilt, point = by_active(build, active, leaves, cells)
    sizes = [tangent_scale(leaf) for leaf in point]
    zeros = tuple(jnp.zeros_like(size) for size in sizes)
    own_shapes = [size.shape if cells is None else size.shape[:-1] for size in sizes]
    entries = [(k, index) for k, shape in enumerate(own_shapes) for index in np.ndindex(shape)]

    def along(k: int, index: tuple[int, ...]) -> tuple[Array, ...]:
        return (*zeros[:k], zeros[k].at[index].set(sizes[k][index]), *zeros[k + 1 :])

    def gather(slopes: list[PyTree]) -> list[PyTree]:
        assert len(slopes) == len(entries)
        remaining = iter(slopes)

        def by_number(size: Array, part: Array) -> Array:
            # The size is a scalar or has one value per cell.
            return part / size.reshape((-1,) + (1,) * (part.ndim - 1) if size.ndim else ())

        def of_leaf(size: Array, shape: tuple[int, ...]) -> PyTree:
            parts = [jax.tree.map(functools.partial(by_number, size[k]), next(remaining)) for k in np.ndindex(shape)]
            return jax.tree.map(lambda *parts: jnp.stack(parts, axis=-1).reshape(*parts[0].shape, *shape), *parts)

        return [of_leaf(size, shape) for size, shape in zip(sizes, own_shapes, strict=True)]

    return rebuilt(*point), tangents_of(rebuilt, point, [along(*entry) for entry in entries]), gather


def by_active(
    build: Build, active: tuple[int, ...], leaves: tuple[Array, ...], cells: int | None
) -> tuple[Callable[..., PyTree], tuple[Float[Array, "..."], ...]]:
    """A problem as a function of its active leaves, and these leaves; with `cells`, they have the cells in the last axis.

    **Arguments:** as for `tangents_by`.
    """

    def rebuilt(*moving: Array) -> PyTree:
        arguments = list(leaves)
        for i, leaf in zip(active, moving, strict=True):
            arguments[i] = leaf
        return build(tuple(arguments), cells)

    return rebuilt, tuple(leaves[i] if cells is None else with_cells(leaves[i], cells) for i in active)


def with_cells(leaf: Float[Array, "..."], cells: int) -> Float[Array, "... cells"]:
    """A leaf with the cells in its last axis, from such a leaf or a scalar."""
    return jnp.broadcast_to(leaf, (*jnp.shape(leaf)[:-1], cells))


def tangent_along(
    build: Build, active: tuple[int, ...], leaves: tuple[Array, ...], tangents: tuple[Array, ...], cells: int
) -> tuple[PyTree, Tangent, Float[Array, " cells"]]:
    """Build a problem and its tangent in one direction of its leaves, which is scaled by the size of the leaves.

    **Arguments:** as for `tangents_by`; `tangents`: those of the active leaves.

    **Returns:** the problem, the tangent, and the size of the direction in every cell.
    """
    rebuilt, point = by_active(build, active, leaves, cells)
    directions = [with_cells(tangent, cells) for tangent in tangents]
    ratios = [jnp.abs(tangent) / tangent_scale(leaf) for tangent, leaf in zip(directions, point, strict=True)]
    size = functools.reduce(jnp.maximum, [jnp.max(ratio.reshape(-1, cells), axis=0) for ratio in ratios])
    scaled = tuple(jnp.where(size > 0.0, tangent / jnp.where(size > 0.0, size, 1.0), 0.0) for tangent in directions)
    return rebuilt(*point), tangents_of(rebuilt, point, [scaled])[0], size


# Variations of the state along a run.

#: Number of tangents that are integrated together. Two together take 0.6 to 1.0 times as long as two in turn, and an
#: eighth longer to compile; four together take 1.1 times as long as two pairs.
GROUP = 2


class VariationalProblem(AbstractDerivedProblem):
    """A problem whose state is followed by its first variations along several tangents.

    A tangent has the structure of the problem, with the rate at which each number moves in place of the number; `None`
    for a number that no tangent moves. A variation's absolute tolerance is that of the state, so a tangent should move
    a number by about its own size (`tangent_scale`).

    **Arguments:** `ends_on_event`: whether runs end on the event of the problem, or continue to their horizon.

    **Example:** the state and its variation with respect to the rate, two components.

    >>> from nonholonomic.derivatives import VariationalProblem
    >>> varied = VariationalProblem(Decays(jnp.ones(3)), (Decays(jnp.ones(3)),), True)
    >>> varied.start()[0].shape
    (2, 3)
    """

    problem: AbstractProblem
    tangents: Tangents
    ends_on_event: bool = eqx.field(static=True)

    def start(self) -> tuple[Float[Array, "components cells"], Float[Array, "components cells"]]:
        states, scales = self.problem.start()

        def variation(direction: Tangent) -> Float[Array, "components cells"]:
            change = eqx.filter_jvp(lambda problem: problem.start()[0], (self.problem,), (direction,))[1]
            return jnp.zeros_like(states) if change is None else change

        variations = [variation(direction) for direction in self.tangents]
        return jnp.concatenate([states, *variations]), jnp.concatenate([scales] * (1 + len(variations)))

    def field(self, time: Lanes, state: States | tuple[Lanes, ...]) -> States:
        if not self.tangents:
            return self.problem.field(time, state)
        point, *variations = self.parts(jnp.asarray(state))
        return self._varied(lambda problem, point: problem.field(time, point), point, variations)

    def _varied(
        self, function: Callable[[AbstractProblem, Array], Array], point: Array, variations: list[Array]
    ) -> Array:
        """The value of a function of problem and state, and its change along every tangent."""

        def value(moving: PyTree, point: States) -> States:
            return function(eqx.combine(moving, self.problem), point)

        # Linearised once: the value is computed once, and the tangents share common subexpressions.
        values, change = jax.linearize(value, where_active(self.problem, self.tangents[0]), point)
        return jnp.concatenate(
            [values, *(change(*direction) for direction in zip(self.tangents, variations, strict=True))]
        )

    def across_jump(self, time: Lanes, state: States) -> States:
        point, *variations = self.parts(state)
        if not variations:
            return self.problem.across_jump(time, point)
        return self._varied(lambda problem, point: problem.across_jump(time, point), point, variations)

    def parts(self, state: States) -> list[Float[Array, "inner *lanes"]]:
        """The state and its variations."""
        return jnp.split(state, 1 + len(self.tangents)) if self.tangents else [state]


def delay(function: Callable[[States], Lanes | None], state: States, rates: States) -> Lanes:
    """A number that is zero, and whose variation is that of the time at which a function of the state vanishes
    (implicit function theorem)."""
    value, rate = jax.jvp(function, (state,), (rates,))
    return -(value - stop_gradient(value)) / stop_gradient(jnp.where(rate == 0.0, jnp.inf, rate))


def slopes_by_variations(
    problem: AbstractProblem, tangents: Tangents, ends_on_event: bool, options: RunOptions, one_kernel: bool
) -> tuple[Outcome, list[Float[Array, " cells"]]]:
    """Run every cell with its variations, and differentiate the time of the event at its end.

    **Arguments:**

    - `problem`, `tangents`: as for `VariationalProblem`.
    - `ends_on_event`: whether runs end on the event; otherwise they end at the horizon, which then counts as the
      event's time.
    - `one_kernel`: as for `LaneScheduler.of`.

    **Returns:** the `Outcome`, without crossing times, and for each tangent the derivative of the event's time.
    """

    def run(group: Tangents) -> tuple[Outcome, list[Float[Array, " cells"]]]:
        variational = VariationalProblem(problem, group, ends_on_event)
        # The variations take part in step-size control: the state alone may be at rest while its tangent is not, and the
        # steps would become too long for the tangent.
        blocks = 1 + len(group)
        ended = LaneScheduler.of(variational, *options, n_blocks=blocks, one_kernel=one_kernel).solve()[0]
        return slopes_at_event(variational, ended)

    return in_groups(run, tangents)


def slopes_at_event(variational: VariationalProblem, ended: Outcome) -> tuple[Outcome, list[Float[Array, " cells"]]]:
    """The result of `slopes_by_variations`, from that of runs with their variations."""
    state, *variations = variational.parts(ended.state)

    def event_time(problem: AbstractProblem, state: Float[Array, "components cells"]) -> Float[Array, " cells"]:
        return crossing_time(problem, ended.end_time, state)

    slopes = [
        eqx.filter_jvp(event_time, (variational.problem, state), direction)[1]
        for direction in zip(variational.tangents, variations, strict=True)
    ]
    return ended._replace(state=state), slopes


def in_groups(run: Callable[..., tuple[PyTree, list[PyTree]]], tangents: Tangents) -> tuple[PyTree, list[PyTree]]:
    """Apply `run` to many tangents, a few at a time, with one program.

    **Arguments:**

    - `run`: a tuple of one or two tangents -> a result that does not depend on them, and a derivative for each.
    - `tangents`: any number of them.

    **Returns:** the result, and the derivatives.

    **Example:**

    >>> from nonholonomic.derivatives import in_groups
    >>> tangents = tuple(jnp.array([1.0, 2.0, 3.0]))
    >>> result, slopes = in_groups(lambda group: (jnp.zeros(()), [2.0 * tangent for tangent in group]), tangents)
    >>> [float(slope) for slope in slopes]
    [2.0, 4.0, 6.0]
    """
    if len(tangents) <= GROUP:
        return run(tangents)
    # The last group is padded with zero tangents.
    empty = -len(tangents) % GROUP
    padded = [*tangents, *[jax.tree.map(jnp.zeros_like, tangents[0])] * empty]
    stacks = [jax.tree.map(lambda *rates: jnp.stack(rates), *padded[k::GROUP]) for k in range(GROUP)]
    results, slopes = jax.lax.map(lambda group: run(tuple(group)), stacks)
    groups = range(len(padded) // GROUP)
    tangent_slopes = [jax.tree.map(operator.itemgetter(group), slope) for group in groups for slope in slopes]
    return jax.tree.map(lambda leaf: leaf[0], results), tangent_slopes[: len(tangents)]


# Lyapunov exponents of a problem: the mean rates at which nearby runs diverge, by the variational equation.
#
# Tangents w are integrated along with the state y' = f(y): w' = J w, where J w is a Jacobian-vector product of f. After each of
# many intervals of time they are orthonormalised, and the logarithms of the lengths that this removes are added up (Benettin et
# al., Meccanica 15 (1980) 9). Tangents and lengths are those of the state in units of the problem's magnitudes.


class VariedProblem(AbstractDerivedProblem):
    """A problem without its event, extended by a tangent of length 1, w' = J w - g w with g = (w . J w) / (w . w), and the
    logarithm of its growth, the integral of g.

    **Arguments:**

    - `problem`: a problem.
    - `states`: the problem's state, the tangent and the growth of every cell.
    """

    problem: AbstractProblem
    states: Float[Array, "twice_components_and_one *cells"]

    ends_on_event = False

    def start(self) -> tuple[Float[Array, "all *cells"], Float[Array, "all *cells"]]:
        magnitudes = self.problem.start()[1]
        unit_scales = jnp.ones((len(self.states) - len(magnitudes), *self.states.shape[1:]))
        return self.states, jnp.concatenate([magnitudes, unit_scales])

    def field(self, time: Lanes, state: States) -> States:
        magnitudes = self.problem.start()[1]
        y, w = self.inner(state), state[len(magnitudes) : -1]
        rate, carried = jax.jvp(lambda point: self.problem.field(time, point), (y,), (w * magnitudes,))
        carried = carried / magnitudes
        growth = jnp.sum(w * carried, axis=0) / jnp.sum(w * w, axis=0)
        return jnp.concatenate([rate, carried - growth * w, growth[None]])


def probed(problem: AbstractProblem) -> VariedProblem:
    """A run and a generic tangent, for derivatives that do not take part in step-size control. The generic tangent does
    take part, so that the steps suit tangents even where the state is at rest. It keeps its length: one that decays would
    soon be smaller than its tolerance.
    """
    start, _ = problem.start()
    direction = jnp.cos(1.0 + jnp.arange(len(start)))
    direction = jnp.broadcast_to(direction.reshape(-1, *(1,) * (start.ndim - 1)), start.shape)
    unit = direction / jnp.linalg.norm(direction, axis=0)
    return VariedProblem(problem, jnp.concatenate([start, unit, jnp.zeros((1, *start.shape[1:]))]))


class FramedProblem(AbstractDerivedProblem):
    """A problem without its event, extended by tangents.

    **Arguments:**

    - `problem`: a problem.
    - `states`: the problem's state and the tangents of every cell, in turn.
    - `begin`: the time of the problem [s] at the start.
    """

    problem: AbstractProblem
    states: Float[Array, "all *cells"]
    begin: Float[Array, ""]

    ends_on_event = False

    def start(self) -> tuple[Float[Array, "all *cells"], Float[Array, "all *cells"]]:
        magnitudes = self.problem.start()[1]
        return self.states, jnp.concatenate([magnitudes] * (len(self.states) // len(magnitudes)))

    def field(self, time: Lanes, state: States) -> States:
        time, size = self.clock(time), len(self.problem.start()[0])
        point, *tangents = jnp.split(jnp.asarray(state), len(state) // size)
        rate, carried = jax.linearize(lambda point: self.problem.field(time, point), point)
        return jnp.concatenate([rate, *map(carried, tangents)])

    def clock(self, time: Lanes) -> Lanes:
        return time + self.begin

    def jumps(self, time: Lanes, state: States) -> Jumps | None:
        jumps = super().jumps(time, state)
        return None if jumps is None else jumps._replace(times=jumps.times - self.begin)


#: Tangents are orthonormalised before one grows or shrinks by more than e to this power: so much of their digits is lost.
MOST_GROWTH = 15.0

#: The most intervals in a stretch; in an interval of this few steps, only a reset can change lengths by so much.
MOST_INTERVALS, FEW_STEPS = 4096, 6

#: A part of a tangent below this is round-off.
LOST = 1e-14


def orthonormalised(
    tangents: Float[Array, "tangents components cells"],
) -> tuple[Float[Array, "tangents cells"], Float[Array, "tangents components cells"]]:
    """The logarithms of the lengths of tangents, each without its part along those before it, and these parts at length 1.

    A part that is only round-off of its tangent has the length zero.
    """
    frame, factors = jnp.linalg.qr(jnp.moveaxis(tangents, -1, 0).mT)
    lengths = jnp.abs(jnp.diagonal(factors, axis1=-2, axis2=-1)).T
    lengths = jnp.where(lengths > LOST * jnp.linalg.norm(tangents, axis=1), lengths, 0.0)
    return jnp.log(lengths), jnp.moveaxis(frame.mT, 0, -1)


def continued(before: PyTree, after: PyTree) -> tuple[Bool[np.ndarray, " cells"], PyTree]:
    """The runs that had not ended before, and how all runs have ended.

    **Arguments:** `before`, `after`: the outcomes of the runs, and of their continuations for another interval of time.
    """
    alive = np.isin(before.status, (RUNNING, REACHED_END))
    sums = {"end_time", "steps", "rejected", "counts"} & set(after._fields)
    added = {name: getattr(before, name) + getattr(after, name) for name in sums}
    return alive, jax.tree.map(lambda new, old: np.where(alive, new, old), after._replace(**added), before)


def in_stretches(
    advance: Callable[[PyTree, float, float], tuple[Float[Array, "tangents cells"], PyTree, Any]],
    state: PyTree,
    t1: float,
    stretches: int,
) -> tuple[Float[np.ndarray, "stretches tangents cells"], Any]:
    """The growth of tangents in equal stretches of time, and how the runs have ended.

    **Arguments:** `advance`: (runs with tangents of length 1, time [s], duration [s]) -> the logarithms of the growth of the
    tangents, the runs with tangents of length 1, and the outcome; `state`: the runs at the start.
    """
    logarithms: list[Float[np.ndarray, "tangents cells"]] = []
    ending: Any = None
    intervals = 1
    with Progress(stretches, "stretch") as display:
        while (number := len(logarithms)) < stretches:
            runs, ended, total = state, ending, np.zeros(())
            duration = t1 / (stretches * intervals)
            for interval in range(intervals):
                begin = number * t1 / stretches + interval * duration
                logarithm, runs, outcome = advance(runs, begin, duration)
                alive, ended = (np.True_, outcome) if ended is None else continued(ended, outcome)
                logarithm = np.where(alive, logarithm, 0.0)
                total = total + logarithm
                is_coarse = alive & (outcome.steps > FEW_STEPS) & (np.abs(logarithm) > MOST_GROWTH)
                if is_coarse.any() and intervals < MOST_INTERVALS:
                    intervals *= 2
                    break
            else:
                logarithms.append(total)
                state, ending = runs, ended
                # The first stretch compiles.
                if number == 0:
                    display.begin(1)
                else:
                    display.advance(1)
    return np.stack(logarithms), ending


def growth(
    problem: AbstractProblem,
    tangents: Float[Array, "tangents components cells"],
    t1: float,
    stretches: int,
    settings: Settings,
) -> tuple[Float[np.ndarray, "stretches tangents cells"], Outcome]:
    """Integrate every cell of a problem together with tangents.

    **Arguments:**

    - `problem`: as for `solve_ensemble`.
    - `tangents`: tangents in the problem's own units.
    - `t1`: horizon [s].
    - `stretches`: number of time intervals; the growth is returned for each.
    - `settings`: their solver must be an explicit Runge-Kutta solver of Diffrax.

    **Returns:** the logarithm of the growth of each tangent in each interval, without its part along the tangents before it, 0
    after a run has ended; and the `Outcome`.

    **Example:** neighbouring runs of a decay approach each other.

    >>> from nonholonomic.derivatives import growth
    >>> logarithm, outcome = growth(Decays(jnp.array([1.0, 2.0])), jnp.ones((1, 1, 2)), 8.0, 2, settings)
    >>> print(logarithm[:, 0].round(6))
    [[-4. -8.]
     [-4. -8.]]
    """
    start, magnitudes = problem.start()
    size, cells = start.shape

    def advance(
        states: Array, begin: float, duration: float
    ) -> tuple[Float[Array, "tangents cells"], Float[Array, "all cells"], Outcome]:
        framed = FramedProblem(problem, states, jnp.asarray(begin))
        outcome, _ = solve_ensemble(framed, jnp.asarray(duration), jnp.asarray(cells), settings)
        logarithm, states = _with_unit_tangents(jnp.asarray(outcome.state), magnitudes)
        return logarithm, states, outcome._replace(state=outcome.state[:size])

    _, states = _with_unit_tangents(jnp.concatenate([start, *tangents]), magnitudes)
    return in_stretches(advance, states, t1, stretches)


@jax.jit
def _with_unit_tangents(
    states: Float[Array, "all cells"], magnitudes: Float[Array, "components cells"]
) -> tuple[Float[Array, "tangents cells"], Float[Array, "all cells"]]:
    """The logarithms of the growth of tangents, and states with tangents of length 1."""
    point, *tangents = jnp.split(states, len(states) // len(magnitudes))
    logarithm, frame = orthonormalised(jnp.stack(tangents) / magnitudes)
    return logarithm, jnp.concatenate([point, *(frame * magnitudes)])


def exponent_of(
    logarithm: Float[np.ndarray, "stretches cells"], t1: float
) -> tuple[Float[np.ndarray, " cells"], Float[np.ndarray, " cells"]]:
    """Estimate the exponent and its error from the growth.

    The first half of the run is left out: there the tangent still turns towards the direction of fastest growth. The
    error has two parts. The first is the largest scatter of the intervals in the second half, in groups of 1, 2 and 4,
    and in the last three quarters, because chaotic motion lingers near orderly motion (Flyvbjerg and Petersen, J. Chem.
    Phys. 91 (1989) 461). The second is ln 2 over half the duration of the run, for the linear divergence of orderly
    motion. An exponent below twice its error is no sign of chaos. Where the motion stays near orderly motion for a long
    time, the error is up to four times too small (`tests/tippe/test_lyapunov.py`).

    **Arguments:** `logarithm`: as from `growth`, with a multiple of 8 intervals; `t1`: duration [s] of all intervals.

    **Returns:** exponent and error [1/s].

    **Example:** growth by a factor of e per second.

    >>> import numpy as np
    >>> from nonholonomic.derivatives import exponent_of
    >>> exponent, error = exponent_of(np.ones((16, 1)), t1=16.0)
    >>> print(exponent, error.round(3))
    [1.] [0.087]
    """
    count = logarithm.shape[0]
    rates = logarithm / (t1 / count)
    half, quarter = count // 2, count // 4
    exponent = np.mean(rates[half:], axis=0)
    scatter = np.zeros_like(exponent)
    for first, group in ((half, 1), (half, 2), (half, 4), (quarter, quarter)):
        means = np.mean(rates[first:].reshape((count - first) // group, group, -1), axis=1)
        scatter = np.maximum(scatter, np.std(means, axis=0, ddof=1) / math.sqrt(half // group))
    return exponent, np.hypot(scatter, math.log(2.0) / (0.5 * t1))
