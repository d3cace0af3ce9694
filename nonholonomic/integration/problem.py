"""The interface of an initial value problem with an event and a domain."""

import abc
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from .jumps import Jumps, moved_across
from .runge_kutta import Lanes, States, lesser


class AbstractProblem(eqx.Module):
    """An initial value problem: a field, an event function, and a domain margin that ends the run where it vanishes.

    The leaves of a problem are scalars, or hold one number per cell in their last axis. Its functions receive one
    number per lane, or scalars for a single run.

    **Example:** the problem of the subpackage's example, at its start.

    >>> start, scales = problem.start()
    >>> print(problem.event_function(start), problem.field(0.0, start)[0])
    [0.5 0.5 0.5] [-1. -2. -4.]
    """

    @property
    def leading(self) -> int | None:
        """Number of leading components (the core state) that evolve independently of the rest; the event function and
        the domain margin depend only on these. `None` if all components are coupled.
        """
        return None

    @property
    def direction_decides(self) -> bool:
        """Whether a run may start at a zero of the event function or of the domain margin, so that the direction of
        motion decides on which side the run is. If true, a run that starts beyond the event continues until the event
        function next falls through zero; otherwise the run ends at once.
        """
        return False

    @property
    def fits_one_kernel(self) -> bool:
        """Whether XLA can compile a loop over the field into a single kernel on a CPU (`xla_cpu.in_one_kernel`)."""
        return True

    @property
    def fast(self) -> tuple[bool, bool]:
        """Whether the margins, and whether the event function, may change faster than the state, as a user's functions may:
        steps then resolve them where they are near zero (`watch.py`).
        """
        return False, False

    @abc.abstractmethod
    def start(self) -> tuple[Float[Array, "components *cells"], Float[Array, "components *cells"]]:
        """The initial state of every cell, and the magnitudes that scale its absolute errors."""

    @abc.abstractmethod
    def field(self, time: Lanes, state: States) -> States:
        """Rate of change of the state, lane by lane; the state may come as a tuple of its components."""

    @abc.abstractmethod
    def event_function(self, state: States) -> Lanes | None:
        """A smooth function of order 1, positive before the event, negative after it; `None` if there is no event."""

    def crossing_along(self, state: States, rate: States) -> Lanes | None:
        """The event function of a state whose rate is known: equal to `event_function`, for problems where the rate
        saves work.
        """
        return self.event_function(state)

    @abc.abstractmethod
    def domain_margin(self, time: Lanes, state: States) -> Lanes | None:
        """A function of order 1 that is positive while the model holds; `None` if the model always holds."""

    def lost_at_start(self, state: States) -> Bool[Array, "..."] | None:
        """A mask of the lanes whose model ceases to hold at the start, though their domain margin is positive by an
        allowance for round-off; `None` if the margin alone decides.
        """
        return None

    def exact_margin(self, time: Lanes, state: States) -> Lanes | None:
        """The domain margin without allowances. Runs that leave the domain go back to its zero; `None`, the default, if they
        end where the zero of the domain margin was located, up to a fraction of a step.
        """
        return None

    def margins(self, time: Lanes, state: States) -> tuple[Lanes, ...]:
        """The smooth functions of which `domain_margin` is the least; a step searches each of them for a missed double root."""
        domain_margin = self.domain_margin(time, state)
        return () if domain_margin is None else (domain_margin,)

    def jumps(self, time: Lanes, state: States) -> Jumps | None:
        """The times at which the field or a margin may jump, for a run that is in this state now; `None` if there are none.
        Steps end on them."""
        return None

    def across_jump(self, time: Lanes, state: States) -> States:
        """The state just after the jump whose near side is this time (`jumps.py`)."""
        jumps = self.jumps(time, state)
        return state if jumps is None else moved_across(jumps, self.field, time, state)[1]


class CoreProblem(AbstractProblem):
    """The core state of a problem: the leading components, on which the others do not act.

    **Arguments:**

    - `whole`: the problem.
    - `size`: number of leading components.

    **Example:**

    >>> from nonholonomic.integration import CoreProblem
    >>> CoreProblem(problem, size=1).start()[0].shape
    (1, 3)
    """

    whole: AbstractProblem
    size: int = eqx.field(static=True)

    @property
    def direction_decides(self) -> bool:
        return self.whole.direction_decides

    @property
    def fits_one_kernel(self) -> bool:
        return self.whole.fits_one_kernel

    @property
    def fast(self) -> tuple[bool, bool]:
        return self.whole.fast

    def start(self) -> tuple[Float[Array, "components *cells"], Float[Array, "components *cells"]]:
        state, scales = self.whole.start()
        return state[: self.size], scales[: self.size]

    def field(self, time: Lanes, state: States) -> States:
        # The compiler drops the omitted components and everything that only they depend on.
        return self.whole.field(time, self._longer(state))[: self.size]

    def event_function(self, state: States) -> Lanes | None:
        return self.whole.event_function(self._longer(state))

    def domain_margin(self, time: Lanes, state: States) -> Lanes | None:
        return self.whole.domain_margin(time, self._longer(state))

    def lost_at_start(self, state: States) -> Bool[Array, "..."] | None:
        return self.whole.lost_at_start(self._longer(state))

    def exact_margin(self, time: Lanes, state: States) -> Lanes | None:
        return self.whole.exact_margin(time, self._longer(state))

    def margins(self, time: Lanes, state: States) -> tuple[Lanes, ...]:
        return self.whole.margins(time, self._longer(state))

    def jumps(self, time: Lanes, state: States) -> Jumps | None:
        return self.whole.jumps(time, self._longer(state))

    def _longer(self, state: States) -> States:
        state = jnp.stack(state) if isinstance(state, tuple) else state
        missing = len(self.whole.start()[0]) - self.size
        return jnp.concatenate([state, jnp.zeros((missing, *state.shape[1:]))])


def margin_at_start(problem: AbstractProblem, time: Lanes, state: States) -> Lanes | None:
    """The domain margin at the start, at most 0 where the model ceases to hold at once."""
    margin, lost = problem.domain_margin(time, state), problem.lost_at_start(state)
    return margin if margin is None or lost is None else jnp.where(lost, jnp.minimum(margin, 0.0), margin)


def least_margin(problem: AbstractProblem, side: Lanes, time: Lanes, state: States, rate: States) -> Lanes:
    """The lesser of the domain margin and the event function, if the field is known. The event function has the sign
    that makes it positive on the lane's side of the event.
    """
    return lesser(problem.domain_margin(time, state), side_of(problem, side)(state, rate), side)


def side_of(problem: AbstractProblem, side: Lanes) -> Callable[[States, States], Lanes | None]:
    """The event function of state and rate, with the sign that makes it positive on the lane's side of the event."""

    def crossing(state: States, rate: States) -> Lanes | None:
        value = problem.crossing_along(state, rate)
        return None if value is None else side * value

    return crossing


def crossing_time(problem: AbstractProblem, time: Lanes, state: States) -> Lanes:
    """Time [s] at which the event function vanishes, for a state close to the event.

    The time is differentiable with respect to the numbers of the problem and the state (implicit function theorem).

    **Arguments:**

    - `problem`: a problem with an event.
    - `time`, `state`: time and state close to the event, (cells,) and (components, cells).

    **Returns:** the times, (cells,), to third order in the distance.

    **Example:** a state that is 1e-4 s before the event.

    >>> from nonholonomic.integration import crossing_time
    >>> print(f"{crossing_time(Decays(jnp.asarray(2.0)), 0.3465, jnp.exp(jnp.array([-0.693]))):.8f}")
    0.34657359
    """
    return event_time(problem, problem.event_function, time, state)


def event_time(problem: AbstractProblem, function: Callable[[States], Any], time: Lanes, state: States) -> Lanes:
    """Time at which a function of the state vanishes along a motion, for a state close to the zero, to third order in
    the distance.

    This gives the time of a located event its derivatives: `time` is held fixed, the state varies with the parameters,
    and the series t - g/g' - g'' g^2 / (2 g'^3) turns its variation into that of the time (implicit function theorem).
    """

    def slope(point: States) -> Lanes:
        return jax.jvp(function, (point,), (problem.field(time, point),))[1]

    first, second = jax.jvp(slope, (state,), (problem.field(time, state),))
    first = jnp.where(first == 0.0, 1.0, first)
    shift = function(state) / first
    return time_at_jump(problem, time, state, time - shift - 0.5 * second / first * shift * shift)


def time_at_jump(problem: AbstractProblem, time: Lanes, state: States, otherwise: Lanes) -> Lanes:
    """The time of the jump whose far side is this time, which is that of an event whose function jumps through zero; elsewhere
    the other time."""
    jumps = problem.jumps(time, state)
    if jumps is None:
        return otherwise
    near = jumps.before(time)
    is_jump, _, jump, _ = jumps.sides(jnp.where(jnp.isfinite(near), near, time))
    return jnp.where(is_jump, jump, otherwise)
