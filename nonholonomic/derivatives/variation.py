"""First derivatives of event times along one or two tangents: the variations of the state are integrated along with it.

A problem and its variations are one problem with a longer state, and run through the same loop as the problem alone;
differentiating the loop as a whole costs several times as much. For many tangents see `_adjoint.py`.
"""

import operator
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from ..integration import AbstractProblem, Jumps, Outcome, crossing_time
from ..integration.scheduler import LaneScheduler

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

    def field(self, time: Float[Array, " lanes"], state: Float[Array, "components lanes"]) -> Any:
        point, *variations = self.parts(state)
        if not variations:
            return self.problem.field(time, point)
        return self._varied(lambda problem, point: problem.field(time, point), point, variations)

    def _varied(
        self, function: Callable[[AbstractProblem, Array], Array], point: Array, variations: list[Array]
    ) -> Array:
        """The value of a function of problem and state, and its change along every tangent."""

        def value(moving: Any, point: Float[Array, "components lanes"]) -> Float[Array, "components lanes"]:
            return function(eqx.combine(moving, self.problem), point)

        # Linearised once: the value is computed once, and the tangents share common subexpressions.
        values, change = jax.linearize(value, where_active(self.problem, self.tangents[0]), point)
        return jnp.concatenate(
            [values, *(change(*direction) for direction in zip(self.tangents, variations, strict=True))]
        )

    def event_function(self, state: Float[Array, "components lanes"]) -> Float[Array, " lanes"] | None:
        return self.problem.event_function(self.parts(state)[0]) if self.ends_on_event else None

    def domain_margin(self, time: Float[Array, " lanes"], state: Float[Array, "components lanes"]) -> Any:
        return self.problem.domain_margin(time, self.parts(state)[0])

    def lost_at_start(self, state: Float[Array, "components lanes"]) -> Any:
        return self.problem.lost_at_start(self.parts(state)[0])

    def exact_margin(self, time: Float[Array, " lanes"], state: Float[Array, "components lanes"]) -> Any:
        return self.problem.exact_margin(time, self.parts(state)[0])

    def margins(self, time: Float[Array, " lanes"], state: Float[Array, "components lanes"]) -> Any:
        return self.problem.margins(time, self.parts(state)[0])

    def jumps(self, time: Float[Array, " lanes"], state: Float[Array, "components lanes"]) -> Jumps | None:
        return self.problem.jumps(time, self.parts(state)[0])

    def across_jump(self, time: Float[Array, " lanes"], state: Float[Array, "components lanes"]) -> Any:
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
    ended, _ = LaneScheduler.of(variational, *options, n_blocks=1 + len(tangents), one_kernel=one_kernel).outcome()
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
