"""One run through stick and slip, with its path."""

from typing import Any, NamedTuple

import diffrax
import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from nonholonomic.integration import AbstractProblem, Followed, follow

from .onset import Onset
from .stick_slip import AT_REST, Change, Kind, StickSlip

#: Phases after which a run is given up.
MOST_PHASES = 2000


class StickSlipPath(NamedTuple):
    """A run: the paths of its phases, whether each rolls, and how it ended, as in `Followed`.

    `sticks` counts how often a slip has turned into rolling; `size` is that of the state without the rest that rides along.
    """

    both: StickSlip
    size: int
    parts: list[Followed]
    rolls: list[bool]
    guard_lost: bool
    failed: bool

    @property
    def times(self) -> Float[np.ndarray, " times"]:
        """The times of the steps [s]; those of the changes stand for the phase that begins."""
        whole = [part.times[:-1] for part in self.parts[:-1]]
        return np.concatenate([*whole, self.parts[-1].times])

    @property
    def states(self) -> Float[np.ndarray, "components times"]:
        """The states at these times."""
        whole = [part.states[:, :-1] for part in self.parts[:-1]]
        whole = [*whole, self.parts[-1].states]
        return np.concatenate(
            [self._carried(states, rolls) for states, rolls in zip(whole, self.rolls, strict=True)], axis=1
        )

    @property
    def accepted(self) -> int:
        """Steps that were accepted."""
        return sum(part.accepted for part in self.parts)

    @property
    def rejected(self) -> int:
        """Steps that were rejected."""
        return sum(part.rejected for part in self.parts)

    @property
    def sticks(self) -> int:
        """How often a slip has turned into rolling."""
        return sum(after and not before for before, after in zip(self.rolls[:-1], self.rolls[1:], strict=True))

    def at(self, times: Float[np.ndarray, " times"]) -> Float[np.ndarray, "components times"]:
        """States at the given times, by the dense output; times must lie within the run."""
        states = np.zeros((len(self.parts[0].states), len(times)))
        for part, rolls in zip(self.parts, self.rolls, strict=True):
            # What a later phase has to say about its own times is written over this.
            here = times >= part.times[0]
            if here.any():
                states[:, here] = self._carried(part.at(times[here]), rolls)
        return states

    def _carried(self, states: Float[np.ndarray, "components times"], rolls: bool) -> Float[np.ndarray, "..."]:
        """The velocity of a rolling top follows from the rest of its state."""
        if not rolls:
            return states
        own = self.both.rolling.carried_along(jnp.asarray(states[: self.size]))
        return np.concatenate([np.asarray(own), states[self.size :]])


class Stretch(AbstractProblem):
    """A run in one of its phases, from the given state of all that is integrated."""

    run: AbstractProblem
    whole: Float[Array, " components"]

    def start(self) -> tuple[Float[Array, " components"], Float[Array, " components"]]:
        return self.whole, self.run.start()[1]

    def field(self, time: Float[Array, ""], state: Float[Array, " components"]) -> Float[Array, " components"]:
        return self.run.field(time, state)

    def crossing(self, state: Float[Array, " components"]) -> None:
        return None

    def guard(self, time: Float[Array, ""], state: Float[Array, " components"]) -> Float[Array, ""] | None:
        return self.run.guard(time, state)


class Begun(eqx.Module):
    """The beginning of a slip, as a piece of a `Followed`: from `t0` to `t1` [s], the onset `wait` [s] after `t0`."""

    onset: Onset
    t0: Float[Array, ""]
    t1: Float[Array, ""]
    wait: Float[Array, ""]

    def evaluate(self, time: Float[Array, ""]) -> Float[Array, " components"]:
        """The state at a time."""
        return self.onset.at((time - self.t0 - self.wait) / (self.t1 - self.t0 - self.wait))


@eqx.filter_jit
def _next(
    stretch: Stretch, kind: Kind, size: int, state: Float[Array, " components"], left: Float[Array, ""]
) -> Change:
    """What follows a phase."""
    slipping = eqx.tree_at(lambda one: one.run.dynamics, stretch, kind.both.slipping)
    return kind.ended(state, size, lambda at: slipping.field(left, at), stretch.start()[1], left)


def _joined(begun: Begun, state: Float[Array, " components"], rest: Followed) -> Followed:
    """A slip with its beginning, which begins from the given state."""
    times = np.concatenate([[float(begun.t0)], rest.times])
    states = np.concatenate([np.asarray(state)[:, None], rest.states], axis=1)
    return rest._replace(times=times, states=states, pieces=[begun, *rest.pieces])


def follow_stick_slip(
    run: Any, t1: float, *, solver: diffrax.AbstractSolver, rtol: float, atol: float
) -> StickSlipPath:
    """One run, phase by phase, until `t1` or until contact is lost.

    **Arguments:**

    - `run`: a `trajectory.TrajectoryProblem` of a scene with `SetValuedCoulomb`.
    - `t1`, `solver`, `rtol`, `atol`: as for `integrate.follow`.

    **Returns:** a `StickSlipPath`.
    """
    both, size, time = run.dynamics, len(run.state), 0.0
    whole = run.start()[0]
    rolls = bool(both.slip_speed(run.state) <= AT_REST * both.speed)
    path = StickSlipPath(both, size, [], [], False, False)
    begun: tuple[Begun, Array] | None = None
    while True:
        kind = Kind(both, jnp.asarray(rtol, float), rolls)
        stretch = Stretch(eqx.tree_at(lambda one: one.dynamics, run, kind), whole)
        part = follow(stretch, t1, t0=time, solver=solver, rtol=rtol, atol=atol)
        last = jnp.asarray(part.states[:, -1])
        if begun is not None:
            part = _joined(*begun, part)
        # A start at rest that friction cannot hold does not roll.
        if part.times[-1] > part.times[0] or not part.guard_lost:
            path.parts.append(part)
            path.rolls.append(rolls)
        if not part.guard_lost:
            return path._replace(failed=part.failed)
        time = float(part.times[-1])
        change = _next(stretch, kind, size, last, jnp.asarray(t1 - time))
        if bool(change.lost):
            return path._replace(guard_lost=True)
        if len(path.parts) == MOST_PHASES or not bool(jnp.all(jnp.isfinite(change.state))):
            return path._replace(failed=True)
        whole, rolls, begun = change.state, bool(change.rolls), None
        if not rolls:
            end = min(time + float(change.elapsed), t1)
            begun = (Begun(change.onset, jnp.asarray(time), jnp.asarray(end), change.wait), last)
            time = end
