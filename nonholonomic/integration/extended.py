"""Passive components: quantities that are integrated with a problem's state but do not act on it, such as a path, work
or a clock.
"""

import abc
from typing import Generic, TypeVar

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from .jumps import Jumps
from .problem import AbstractProblem
from .runge_kutta import Lanes, States

#: The kind of problem whose state is extended.
Core = TypeVar("Core", bound=AbstractProblem)


class AbstractPassive(eqx.Module):
    """Rates of passive components.

    **Example:** as for `ExtendedProblem`.

    >>> from nonholonomic.integration import AbstractPassive
    >>> class Area(AbstractPassive):
    ...     def rates(self, problem, time, state, passive):
    ...         return jnp.concatenate([problem.field(time, state), state])
    >>> print(Area().rates(problem, 0.0, jnp.ones((1, 3)), jnp.zeros((1, 3)))[1])
    [1. 1. 1.]
    """

    @abc.abstractmethod
    def rates(self, problem: AbstractProblem, time: Lanes, state: States, passive: States) -> States:
        """Rates of change of the problem's state, followed by those of the passive components. Both are computed
        together because they share work."""


class ExtendedProblem(AbstractProblem, Generic[Core]):
    """A problem with passive components after its state; event function and domain margin are those of the problem.

    - `passive`: the rates; `values`, `scales`: initial values, and the magnitudes that scale absolute errors.
    - `ends_on_event`: whether the problem's event is kept.

    **Example:** a decay and the area under it.

    >>> from nonholonomic.integration import AbstractPassive, ExtendedProblem
    >>> class Area(AbstractPassive):
    ...     def rates(self, problem, time, state, passive):
    ...         return jnp.concatenate([problem.field(time, state), state])
    >>> extended = ExtendedProblem(problem, Area(), jnp.zeros((1, 3)), jnp.ones((1, 3)))
    >>> print(extended.field(0.0, extended.start()[0]))
    [[-1. -2. -4.]
     [ 1.  1.  1.]]
    """

    problem: Core
    passive: AbstractPassive
    values: Float[Array, "passive *cells"]
    scales: Float[Array, "passive *cells"]
    ends_on_event: bool = eqx.field(static=True, default=True)

    @property
    def leading(self) -> int:
        return len(self.problem.start()[0])

    @property
    def direction_decides(self) -> bool:
        return self.problem.direction_decides

    @property
    def fits_one_kernel(self) -> bool:
        return self.problem.fits_one_kernel

    @property
    def fast(self) -> tuple[bool, bool]:
        return self.problem.fast

    def start(self) -> tuple[Float[Array, "components *cells"], Float[Array, "components *cells"]]:
        states, scales = self.problem.start()
        return jnp.concatenate([states, self.values]), jnp.concatenate([scales, self.scales])

    def field(self, time: Lanes, state: States) -> States:
        return self.passive.rates(self.problem, time, state[: self.leading], state[self.leading :])

    def event_function(self, state: States) -> Lanes | None:
        return self.problem.event_function(state[: self.leading]) if self.ends_on_event else None

    def domain_margin(self, time: Lanes, state: States) -> Lanes | None:
        return self.problem.domain_margin(time, state[: self.leading])

    def lost_at_start(self, state: States) -> Bool[Array, "..."] | None:
        return self.problem.lost_at_start(state[: self.leading])

    def exact_margin(self, time: Lanes, state: States) -> Lanes | None:
        return self.problem.exact_margin(time, state[: self.leading])

    def margins(self, time: Lanes, state: States) -> tuple[Lanes, ...]:
        return self.problem.margins(time, state[: self.leading])

    def jumps(self, time: Lanes, state: States) -> Jumps | None:
        return self.problem.jumps(time, state[: self.leading])
