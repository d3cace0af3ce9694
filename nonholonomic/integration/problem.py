"""What is integrated."""

import abc
from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from .runge_kutta import Lanes, States, lesser


class AbstractProblem(eqx.Module):
    """What is integrated: a field, a function whose zero is the event, and a domain margin that ends the run.

    The leaves of a problem are scalars, or hold one number per cell in their last axis.
    """

    @property
    def leading(self) -> int | None:
        """How many components, from the first, are all that field, event function and domain margin depend on, and have a
        field of their own without the rest; `None` for all of them."""
        return None

    @property
    def direction_decides(self) -> bool:
        """Whether the direction of motion decides on which side of a zero of the event function or the domain margin a run
        starts.

        A run that starts beyond the event then waits for the next time the event function falls through zero; otherwise it
        ends at once.
        """
        return False

    @property
    def fits_one_kernel(self) -> bool:
        """Whether XLA can compile a loop over the field into a single kernel on a CPU (`xla_cpu.in_one_kernel`)."""
        return True

    @abc.abstractmethod
    def start(self) -> tuple[Float[Array, "components *cells"], Float[Array, "components *cells"]]:
        """State at the start of every cell, and the magnitudes by which its absolute errors are measured."""

    @abc.abstractmethod
    def field(self, time: Lanes, state: States) -> States:
        """Rate of change of the state, lane by lane; the state may come as a tuple of its components."""

    @abc.abstractmethod
    def event_function(self, state: States) -> Lanes | None:
        """A smooth function of order 1, positive before the event, negative after it; `None` if there is no event."""

    def crossing_along(self, state: States, rate: States) -> Lanes | None:
        """The event function where the field is known too: what `crossing` is, for problems to which that saves work."""
        return self.event_function(state)

    @abc.abstractmethod
    def domain_margin(self, time: Lanes, state: States) -> Lanes | None:
        """A function of order 1 that is positive while the model holds; `None` if it always does."""

    def margins(self, time: Lanes, state: States) -> tuple[Lanes, ...]:
        """The smooth functions of which `domain_margin` is the least; a step searches each of them for a missed double root."""
        domain_margin = self.domain_margin(time, state)
        return () if domain_margin is None else (domain_margin,)


class CoreProblem(AbstractProblem):
    """A problem with the first components of its state alone, on which the others do not act."""

    whole: AbstractProblem
    size: int = eqx.field(static=True)

    @property
    def direction_decides(self) -> bool:
        return self.whole.direction_decides

    @property
    def fits_one_kernel(self) -> bool:
        return self.whole.fits_one_kernel

    def start(self) -> tuple[Float[Array, "components *cells"], Float[Array, "components *cells"]]:
        state, scales = self.whole.start()
        return state[: self.size], scales[: self.size]

    def field(self, time: Lanes, state: States) -> States:
        # What the rates do not depend on, and those that are left out, the compiler drops.
        return self.whole.field(time, self._longer(state))[: self.size]

    def event_function(self, state: States) -> Lanes | None:
        return self.whole.event_function(self._longer(state))

    def domain_margin(self, time: Lanes, state: States) -> Lanes | None:
        return self.whole.domain_margin(time, self._longer(state))

    def margins(self, time: Lanes, state: States) -> tuple[Lanes, ...]:
        return self.whole.margins(time, self._longer(state))

    def _longer(self, state: States) -> States:
        missing = len(self.whole.start()[0]) - self.size
        return jnp.concatenate([state, jnp.zeros((missing, *state.shape[1:]))])


def least_margin(problem: AbstractProblem, side: Lanes, time: Lanes, state: States, rate: States) -> Lanes:
    """The least of the problem's event function, counted positive on the lane's side of the event, and its domain margin,
    where the field is known."""
    return lesser(problem.domain_margin(time, state), side_of(problem, side)(state, rate), side)


def side_of(problem: AbstractProblem, side: Lanes) -> Callable[[States, States], Lanes | None]:
    """The problem's event function by state and rate, counted positive on the lane's side of the event."""

    def crossing(state: States, rate: States) -> Lanes | None:
        found = problem.crossing_along(state, rate)
        return None if found is None else side * found

    return crossing


def crossing_time(problem: AbstractProblem, time: Lanes, state: States) -> Lanes:
    """When the event function vanishes, for a state close to that (`event_time`)."""
    return event_time(problem, problem.event_function, time, state)


def event_time(problem: AbstractProblem, function: Callable[[States], Lanes], time: Lanes, state: States) -> Lanes:
    """When a function of the state vanishes along a motion, for a state close to that, to third order in the distance.

    It gives the time of a located event its derivatives: `time` is held fixed, the state varies with the parameters, and
    the series t - g/g' - g'' g^2 / (2 g'^3) turns its variation into that of the time (implicit function theorem).
    """

    def slope(at: States) -> Lanes:
        return jax.jvp(function, (at,), (problem.field(time, at),))[1]

    first, second = jax.jvp(slope, (state,), (problem.field(time, state),))
    first = jnp.where(first == 0.0, 1.0, first)
    shift = function(state) / first
    return time - shift - 0.5 * second / first * shift * shift
