"""Times at which a field jumps or has a kink: a step ends just before such a time, and the next begins just after it.

No stage of a step is ever evaluated at the time itself, so it does not matter on which side a comparison such as `t > 1`
is false there. The gap between the two sides is a few units of round-off wide, and the state moves across it along the
field of either side. If the time of the jump moves, so does the state after it: by the difference of the fields.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax.lax import stop_gradient
from jaxtyping import Array, Bool, Float

from .runge_kutta import Lanes, States

#: Distance of a step's end from a jump, relative to the time of the jump: more than the round-off of a sum of stages.
#: Jumps that are at most `CLUSTER` distances apart count as one.
GAP, CLUSTER = 64.0, 4.0

#: The least such distance [s], of a jump at time 0.
LEAST = 1e-30


class Jumps(NamedTuple):
    """Times [s] at which a field may jump, and distances [s] from them at which steps end, (jumps, *cells).

    **Example:** the field of a problem that jumps at 0.5 s, for all of its three cells.

    >>> from nonholonomic.integration import Jumps
    >>> class Halved(Decays):
    ...     def field(self, time, state):
    ...         return super().field(time, state) * jnp.where(time < 0.5, 1.0, 0.5)
    ...     def jumps(self, time, state):
    ...         return Jumps.at(jnp.full((1, *self.rate.shape), 0.5))
    >>> halved, _ = solve_ensemble(Halved(problem.rate), jnp.asarray(1.0), jnp.asarray(3), settings)
    >>> print(halved.crossing_time.round(6))  # (ln(2) / rate - 0.5) / 0.5 + 0.5, and before the jump ln(2) / rate
    [0.886294 0.346574 0.173287]
    """

    times: Float[Array, "jumps *cells"]
    gaps: Float[Array, "jumps *cells"]

    @classmethod
    def at(cls, times: Float[Array, "jumps *cells"], clock: Any = 0.0) -> "Jumps":
        """The jumps at these times, of which those that are not finite never come.

        **Arguments:** `clock`: the reading of the clock of `times` where the run begins.
        """
        is_finite = jnp.isfinite(times)
        size = jnp.where(is_finite, jnp.abs(stop_gradient(times)) * (GAP * jnp.finfo(times.dtype).eps), 0.0)
        return cls(jnp.where(is_finite, times - clock, jnp.inf), jnp.maximum(size, LEAST))

    @property
    def ahead(self) -> Float[Array, "jumps *cells"]:
        """The near sides of the jumps."""
        return stop_gradient(self.times) - self.gaps

    @property
    def past(self) -> Float[Array, "jumps *cells"]:
        """The far sides of the jumps."""
        return stop_gradient(self.times) + self.gaps

    def next(self, time: Lanes) -> Lanes:
        """The near side of the next jump after a time; infinite if there is none."""
        return _least(self.ahead, self.ahead > time)

    def begin(self, time: Lanes) -> Lanes:
        """The time itself, or the far side of a jump that is there."""
        is_there = jnp.abs(stop_gradient(self.times) - time) <= 2.0 * self.gaps
        return jnp.maximum(time, jnp.max(jnp.where(is_there, self.past, -jnp.inf), axis=0))

    def before(self, time: Lanes) -> Lanes:
        """The near side of the jump whose far side is this time; NaN if there is none."""
        least, most = time - (CLUSTER + 2.5) * self.gaps, time - 1.5 * self.gaps
        near = _least(self.ahead, (self.ahead > least) & (self.ahead < most))
        return jnp.where(jnp.isfinite(near), near, jnp.nan)

    def sides(self, time: Lanes) -> tuple[Bool[Array, " lanes"], Lanes, Lanes, Lanes]:
        """The jump whose near side is this time: a mask of the lanes that have one, its near side, its time, which is
        differentiable, and its far side; all three are the time itself where there is none."""
        distance = self.ahead - time
        is_near = jnp.abs(distance) <= 0.25 * self.gaps
        is_jump = jnp.any(is_near, axis=0)
        jump = jnp.sum(jnp.where(is_near, self.times, 0.0), axis=0) / jnp.maximum(jnp.sum(is_near, axis=0), 1)
        past = jnp.max(jnp.where(jnp.abs(distance) <= CLUSTER * self.gaps, self.past, -jnp.inf), axis=0)
        return is_jump, time, jnp.where(is_jump, jump, time), jnp.where(is_jump, past, time)


def _least(values: Float[Array, "jumps *cells"], mask: Bool[Array, "jumps *cells"]) -> Lanes:
    return jnp.min(jnp.where(mask, values, jnp.inf), axis=0)


def moved_across(
    jumps: Jumps, field: Callable[[Lanes, States], States], time: Lanes, state: States
) -> tuple[Lanes, States]:
    """Time and state just after the jump whose near side is this time; unchanged in lanes that have none.

    The state follows the field before the jump up to the jump, and then the field after it, each by a midpoint step.
    Therefore the result has first and second derivatives with respect to the time of the jump.
    """
    _, near, jump, far = jumps.sides(stop_gradient(time))
    first, second, none = jump - near, far - jump, jnp.zeros_like(near)
    # After the jump, every time is that of a point beyond it, because the state may contain a clock.
    times = jnp.stack([near, near + 0.5 * first, far, far - 0.5 * second])
    moves, looks = jnp.stack([none, none, first, none]), jnp.stack([none, 0.5 * first, second, 0.5 * second])

    def stage(carry: tuple[States, States], row: tuple[Lanes, Lanes, Lanes]) -> tuple[tuple[States, States], None]:
        (base, rate), (stage_time, move, look) = carry, row
        base = base + move * rate
        return (base, field(stage_time, base + look * rate)), None

    # A loop, so that the field is compiled once.
    (base, rate), _ = jax.lax.scan(stage, (state, jnp.zeros_like(state)), (times, moves, looks))
    return far, base + second * rate
