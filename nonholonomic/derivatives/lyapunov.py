"""The largest Lyapunov exponent of a problem: the mean rate at which nearby runs diverge, by the variational equation.

A tangent w is integrated along with the state y' = f(y). It is kept at unit length while it follows the linearised
motion (Benettin et al., Meccanica 15 (1980) 9, with the renormalisation made continuous), and the logarithm removed by
the renormalisation is added up: w' = J w - g w, g = (w . J w) / (w . w), growth' = g, where J w is a Jacobian-vector
product of f. Tangents and lengths are those of the state in units of the problem's magnitudes.
"""

import math
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from ..integration import AbstractProblem, Jumps, Settings, solve_ensemble
from ..integration.status import REACHED_END, RUNNING
from ..progress import Progress


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

    def field(self, time: Float[Array, " lanes"], state: Float[Array, "all lanes"]) -> Float[Array, "all lanes"]:
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
        self, time: Float[Array, " lanes"], state: Float[Array, "all lanes"]
    ) -> Float[Array, " lanes"] | None:
        time = time if self.begin is None else time + self.begin
        return self.problem.domain_margin(time, state[: len(self.magnitudes)])

    def margins(
        self, time: Float[Array, " lanes"], state: Float[Array, "all lanes"]
    ) -> tuple[Float[Array, " lanes"], ...]:
        time = time if self.begin is None else time + self.begin
        return self.problem.margins(time, state[: len(self.magnitudes)])

    def jumps(self, time: Float[Array, " lanes"], state: Float[Array, "all lanes"]) -> Jumps | None:
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
    - `status`: how the run ended, a code of `integration/status.py`; `end_time` [s] and `state`: when and where it
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
