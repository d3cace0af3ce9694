"""Variations of the state along a run: first derivatives of event times, and the rate at which runs diverge.

A problem and its variations are one problem with a longer state, and run through the same loop as the problem alone;
differentiating the loop as a whole costs several times as much. For many tangents see `adjoint.py`.
"""

import math
import operator
from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from ..integration import AbstractProblem, Jumps, Outcome, Settings, crossing_time, solve_ensemble
from ..integration.problem import REACHED_END, RUNNING
from ..integration.scheduler import LaneScheduler
from ..terminal import Progress

#: Number of tangents that are integrated together. Two together take 0.6 to 1.0 times as long as two in turn, and an
#: eighth longer to compile; four together take 1.1 times as long as two pairs.
GROUP = 2


def tangent_scale(number: Float[Array, "..."]) -> Float[Array, "..."]:
    """The scale of a number's tangent: its own size, or 1 where it is zero.

    **Example:**

    >>> from nonholonomic.derivatives import tangent_scale
    >>> print(tangent_scale(jnp.array([0.0, -3.0])))
    [1. 3.]
    """
    return jax.lax.stop_gradient(jnp.where(number == 0.0, 1.0, jnp.abs(number)))


class VariationalProblem(AbstractProblem):
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
    tangents: tuple[Any, ...]
    ends_on_event: bool = eqx.field(static=True)

    @property
    def direction_decides(self) -> bool:
        return self.problem.direction_decides

    @property
    def fits_one_kernel(self) -> bool:
        return self.problem.fits_one_kernel

    @property
    def fast(self) -> tuple[bool, bool]:
        return self.problem.fast

    def start(self) -> tuple[Float[Array, "components cells"], Float[Array, "components cells"]]:
        states, scales = self.problem.start()

        def variation(direction: Any) -> Float[Array, "components cells"]:
            change = eqx.filter_jvp(lambda problem: problem.start()[0], (self.problem,), (direction,))[1]
            return jnp.zeros_like(states) if change is None else change

        variations = [variation(direction) for direction in self.tangents]
        return jnp.concatenate([states, *variations]), jnp.concatenate([scales] * (1 + len(variations)))

    def field(self, time: Float[Array, "*lanes"], state: Float[Array, "components *lanes"]) -> Any:
        point, *variations = self.parts(state)
        if not variations:
            return self.problem.field(time, point)
        return self._varied(lambda problem, point: problem.field(time, point), point, variations)

    def _varied(
        self, function: Callable[[AbstractProblem, Array], Array], point: Array, variations: list[Array]
    ) -> Array:
        """The value of a function of problem and state, and its change along every tangent."""

        def value(moving: Any, point: Float[Array, "components *lanes"]) -> Float[Array, "components *lanes"]:
            return function(eqx.combine(moving, self.problem), point)

        # Linearised once: the value is computed once, and the tangents share common subexpressions.
        values, change = jax.linearize(value, where_active(self.problem, self.tangents[0]), point)
        return jnp.concatenate(
            [values, *(change(*direction) for direction in zip(self.tangents, variations, strict=True))]
        )

    def event_function(self, state: Float[Array, "components *lanes"]) -> Float[Array, "*lanes"] | None:
        return self.problem.event_function(self.parts(state)[0]) if self.ends_on_event else None

    def domain_margin(self, time: Float[Array, "*lanes"], state: Float[Array, "components *lanes"]) -> Any:
        return self.problem.domain_margin(time, self.parts(state)[0])

    def lost_at_start(self, state: Float[Array, "components *lanes"]) -> Any:
        return self.problem.lost_at_start(self.parts(state)[0])

    def exact_margin(self, time: Float[Array, "*lanes"], state: Float[Array, "components *lanes"]) -> Any:
        return self.problem.exact_margin(time, self.parts(state)[0])

    def margins(self, time: Float[Array, "*lanes"], state: Float[Array, "components *lanes"]) -> Any:
        return self.problem.margins(time, self.parts(state)[0])

    def jumps(self, time: Float[Array, "*lanes"], state: Float[Array, "components *lanes"]) -> Jumps | None:
        return self.problem.jumps(time, self.parts(state)[0])

    def across_jump(self, time: Float[Array, "*lanes"], state: Float[Array, "components *lanes"]) -> Any:
        point, *variations = self.parts(state)
        if not variations:
            return self.problem.across_jump(time, point)
        return self._varied(lambda problem, point: problem.across_jump(time, point), point, variations)

    def parts(self, state: Float[Array, "components ..."]) -> list[Float[Array, "components ..."]]:
        """The state and its variations."""
        return jnp.split(state, 1 + len(self.tangents)) if self.tangents else [state]


def slopes_by_variations(
    problem: AbstractProblem, tangents: tuple[Any, ...], ends_on_event: bool, *options: Any, one_kernel: bool
) -> tuple[Outcome, list[Float[Array, " cells"]]]:
    """Run every cell with its variations, and differentiate the time of the event at its end.

    **Arguments:**

    - `problem`, `tangents`: as for `VariationalProblem`.
    - `ends_on_event`: whether runs end on the event; otherwise they end at the horizon, which then counts as the
      event's time.
    - `options`, `one_kernel`: horizon, number of cells and settings, as for `LaneScheduler.of`.

    **Returns:** the `Outcome`, without crossing times, and for each tangent the derivative of the event's time.
    """
    variational = VariationalProblem(problem, tangents, ends_on_event)
    # The variations take part in step-size control: the state alone may be at rest while its tangent is not, and the
    # steps would become too long for the tangent.
    ended = LaneScheduler.of(variational, *options, n_blocks=1 + len(tangents), one_kernel=one_kernel).solve()[0]
    state, *variations = variational.parts(ended.state)

    def event_time(problem: AbstractProblem, state: Float[Array, "components cells"]) -> Float[Array, " cells"]:
        return crossing_time(problem, ended.end_time, state)

    slopes = [
        eqx.filter_jvp(event_time, (problem, state), direction)[1]
        for direction in zip(tangents, variations, strict=True)
    ]
    return ended._replace(state=state), slopes


def in_groups(run: Callable[..., tuple[Any, list[Any]]], tangents: tuple[Any, ...]) -> tuple[Any, list[Any]]:
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


def where_active(problem: Any, direction: Any) -> Any:
    """The numbers of a problem that a tangent moves, `None` for the others."""

    def moved(rate: Any, number: Any) -> Any:
        return None if rate is None else number

    return jax.tree.map(moved, direction, problem, is_leaf=lambda rate: rate is None)


# The largest Lyapunov exponent of a problem: the mean rate at which nearby runs diverge, by the variational equation.
#
# A tangent w is integrated along with the state y' = f(y). It is kept at unit length while it follows the linearised
# motion (Benettin et al., Meccanica 15 (1980) 9, with the renormalisation made continuous), and the logarithm removed by
# the renormalisation is added up: w' = J w - g w, g = (w . J w) / (w . w), growth' = g, where J w is a Jacobian-vector
# product of f. Tangents and lengths are those of the state in units of the problem's magnitudes.


class VariedProblem(AbstractProblem):
    """A problem without its event, extended by a tangent and the logarithm of its growth.

    **Arguments:**

    - `problem`: a problem; only its field and its domain margin are used.
    - `states`: the problem's state, the tangent and the growth of every cell.
    - `magnitudes`: magnitudes of the problem's own components.
    - `begin`: the time of the problem [s] at the start.
    """

    problem: AbstractProblem
    states: Float[Array, "twice_components_and_one cells"]
    magnitudes: Float[Array, "components cells"]
    begin: Float[Array, ""] | None = None

    @property
    def fast(self) -> tuple[bool, bool]:
        return self.problem.fast

    def start(self) -> tuple[Float[Array, "all cells"], Float[Array, "all cells"]]:
        unit_scales = jnp.ones((self.states.shape[0] - len(self.magnitudes), *self.states.shape[1:]))
        return self.states, jnp.concatenate([self.magnitudes, unit_scales])

    def field(self, time: Float[Array, "*lanes"], state: Float[Array, "all lanes"]) -> Float[Array, "all lanes"]:
        size = len(self.magnitudes)
        time = time if self.begin is None else time + self.begin
        y, w = state[:size], state[size:-1]
        rate, carried = jax.jvp(lambda point: self.problem.field(time, point), (y,), (w * self.magnitudes,))
        carried = carried / self.magnitudes
        growth = jnp.sum(w * carried, axis=0) / jnp.sum(w * w, axis=0)
        return jnp.concatenate([rate, carried - growth * w, growth[None]])

    def event_function(self, state: Float[Array, "all lanes"]) -> None:
        return None

    def domain_margin(
        self, time: Float[Array, "*lanes"], state: Float[Array, "all lanes"]
    ) -> Float[Array, "*lanes"] | None:
        time = time if self.begin is None else time + self.begin
        return self.problem.domain_margin(time, state[: len(self.magnitudes)])

    def margins(
        self, time: Float[Array, "*lanes"], state: Float[Array, "all lanes"]
    ) -> tuple[Float[Array, "*lanes"], ...]:
        time = time if self.begin is None else time + self.begin
        return self.problem.margins(time, state[: len(self.magnitudes)])

    def jumps(self, time: Float[Array, "*lanes"], state: Float[Array, "all lanes"]) -> Jumps | None:
        begin = 0.0 if self.begin is None else self.begin
        jumps = self.problem.jumps(time + begin, state[: len(self.magnitudes)])
        return None if jumps is None else jumps._replace(times=jumps.times - begin)


def probed(problem: AbstractProblem) -> VariedProblem:
    """A run and a generic tangent, for derivatives that do not take part in step-size control. The generic tangent does
    take part, so that the steps suit tangents even where the state is at rest.
    """
    start, magnitudes = problem.start()
    direction = jnp.cos(1.0 + jnp.arange(len(start)))
    direction = jnp.broadcast_to(direction.reshape(-1, *(1,) * (start.ndim - 1)), start.shape)
    unit = direction / jnp.linalg.norm(direction, axis=0)
    states = jnp.concatenate([start, unit, jnp.zeros((1, *start.shape[1:]))])
    return VariedProblem(problem, states, magnitudes)


class Growth(NamedTuple):
    """Growth of a tangent in every cell, in equal intervals of time.

    - `logarithm`: logarithm of the growth in each interval.
    - `status`: how the run ended, a code of `integration/problem.py`; `end_time` [s] and `state`: when and where it
      ended; `steps`: number of accepted and rejected steps.
    """

    logarithm: Float[np.ndarray, "stretches cells"]
    status: Int[np.ndarray, " cells"]
    end_time: Float[np.ndarray, " cells"]
    state: Float[np.ndarray, "components cells"]
    steps: Int[np.ndarray, " cells"]


def growth(
    problem: AbstractProblem, tangents: Float[Array, "components cells"], t1: float, stretches: int, settings: Settings
) -> Growth:
    """Integrate every cell of a problem together with a tangent.

    **Arguments:**

    - `problem`: as for `solve_ensemble`.
    - `tangents`: tangents in the problem's own units.
    - `t1`: horizon [s].
    - `stretches`: number of time intervals; the growth is returned for each.
    - `settings`: their solver must be an explicit Runge-Kutta solver of Diffrax.

    **Returns:** the `Growth`; nothing grows in a cell after its run has ended.

    **Example:** neighbouring runs of a decay approach each other.

    >>> from nonholonomic.derivatives import growth
    >>> result = growth(Decays(jnp.array([1.0, 2.0])), jnp.ones((1, 2)), 8.0, 2, settings)
    >>> print(result.logarithm.round(6))
    [[-4. -8.]
     [-4. -8.]]
    """
    start, magnitudes = problem.start()
    size, cells = start.shape
    stretch, direction = jnp.asarray(t1 / stretches), tangents / magnitudes
    logarithms, end_time, status = [], np.zeros(cells), np.full(cells, RUNNING)
    steps, state = np.zeros(cells, int), np.asarray(start)
    with Progress(stretches, "stretch") as display:
        for number in range(stretches):
            unit = direction / jnp.linalg.norm(direction, axis=0)
            states = jnp.concatenate([start, unit, jnp.zeros((1, cells))])
            variational = VariedProblem(problem, states, magnitudes, number * stretch)
            outcome, _ = solve_ensemble(variational, stretch, jnp.asarray(cells), settings)
            alive = (status == RUNNING) | (status == REACHED_END)
            logarithms.append(np.where(alive, outcome.state[-1], 0.0))
            end_time += np.where(alive, outcome.end_time, 0.0)
            steps += np.where(alive, outcome.steps, 0)
            status = np.where(alive, outcome.status, status)
            start, direction = outcome.state[:size], outcome.state[size:-1]
            state = np.where(alive, start, state)
            # The first interval compiles.
            if number == 0:
                display.begin(1)
            else:
                display.advance(1)
    return Growth(np.stack(logarithms), status, end_time, state, steps)


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

    **Arguments:** `logarithm`: as in `Growth`, with a multiple of 8 intervals; `t1`: duration [s] of all intervals.

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
