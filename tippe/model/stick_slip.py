"""Stick and slip under exact Coulomb friction: both kinds of motion, their ends, and the motion that follows.

Within the friction cone, rolling is the only motion near zero slip, and a slip reaches zero in finite time. There the
direction of the slip has no limit, and steps shrink with the slip speed. Therefore an impulse stops the slip when the
remaining sliding distance, v^2 / (2 |v'|), is `LEFT` times the tolerance in units of R. Friction would have given the
same impulse in the remaining time, so the error of the state is of the order of this distance, and proportional to the
tolerance. Rolling ends where mu N = |F_t|; there a separate step begins the slip, with an estimated
error within the tolerance (`tests/physics/test_stick_slip.py`).
"""

import dataclasses
import functools
from collections.abc import Callable
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int
from numpy.polynomial import Polynomial, legendre

from nonholonomic.compilation.xla_cpu import greatest
from nonholonomic.geometry import AbstractFrame, Vector, solve
from nonholonomic.integration import Components, Lanes, States
from nonholonomic.integration.dense import halved

from ..friction import Frictionless, Slip, length
from .body import Number
from .dynamics import FITS, AbstractContactDynamics, Dynamics, Motion, RollingDynamics
from .rigid import RigidRolling, RigidSlipping

#: The rates of states.
Field = Callable[[States], States]

#: Slip velocities at the stages of a step.
Slips = Float[Array, "2 stages ..."]

# The onset of a slip: an implicit step from a contact at rest to a slipping contact, of the length that the tolerance
# allows.
#
# Let G be the force that rolling requires beyond the friction cone. The slip velocity v changes as v' = M G, where M is
# the contact's inverse mass along the arena. Where rolling leaves the cone, G = 0, and so is the slip's acceleration;
# both grow in proportion to the time t since then. Of all solutions that begin there, only one is smooth: v = c t^2 d +
# O(t^3), with d against the force of rolling and
#
# c = -m' / (2 (d . P_t + mu P_n)),   m = mu N - |F_t| of rolling, P the impulse that gives the contact the velocity d.
#
# A deviation of the slip's direction decays as exp(k / t), faster than any power, so an explicit method cannot begin
# there. A collocation method can: it needs only the state at t = 0, and the polynomial of the smooth solution satisfies
# the equations at all nodes. This module takes one step of Radau IIA (Hairer and Wanner, Solving ODEs II, section IV.5).
# It solves the equations by Newton's method in the slip velocity, which alone is stiff, and by iteration in the other
# components. If the force of rolling is beyond the cone from the start, the slip begins as v = b t d + O(t^2), where d is
# the direction in which the slip grows against friction, nearly opposite to the force of rolling. The same step applies.

#: Stages of the step. In powers of the step's length, the error of the step is of order `STAGES` + 1, and the estimate
#: of the error of order `STAGES`.
STAGES = 6

#: Length of the first trial over tolerance^(1 / STAGES), in units of the shorter of sqrt(R / g) and the time for a
#: radian. It does not affect the error: a step with too large an estimate is repeated with a shorter length.
FIRST = 5.0

#: Estimates below this are round-off: where a slip of 1e-7 m/s begins, its direction has only nine correct digits.
#: Below it, the step's length still follows the tolerance; steps with an estimate of 1e-11 had errors of 1e-13.
LEAST_ERROR = 1e-10

#: Trials of the length, and iterations for each; if they are not enough, the run fails (none of 256 tops that slip and
#: stick for 4 s in a sphere).
TRIALS, ITERATIONS = 10, 10


def _radau() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The nodes in (0, 1], the coefficients of the integrals up to `x` (coefficients of x, stage), and the row of the
    highest Legendre coefficient."""
    # The roots are real, but since NumPy 2.5 their type is complex.
    nodes = (np.sort(legendre.legroots([0.0] * (STAGES - 1) + [-1.0, 1.0]).real) + 1.0) / 2.0
    nodes[-1] = 1.0
    integrals = []
    for k in range(STAGES):
        other_nodes = np.delete(nodes, k)
        basis = Polynomial.fromroots(other_nodes) / np.prod(nodes[k] - other_nodes)
        integrals.append(basis.integ().coef)
    highest = np.linalg.inv(legendre.legvander(2.0 * nodes - 1.0, STAGES - 1))[-1]
    return nodes, np.stack(integrals, axis=1), highest


NODES, INTEGRALS, HIGHEST = _radau()
WEIGHTS = np.vander(NODES, STAGES + 1, increasing=True) @ INTEGRALS


class Onset(eqx.Module):
    """The beginning of a slip.

    - `start`: the state at the onset, (components, ...); `length`: its duration [s].
    - `rates`: rates of the state at the step's stages, (components, stages, ...).
    - `converged`: whether the step reached the tolerance.
    """

    start: States
    length: Float[Array, "..."]
    rates: Float[Array, "components stages ..."]
    converged: Bool[Array, "..."]

    def at(self, fraction: Float[Array, "..."]) -> States:
        """The state after a fraction of the step."""
        powers = jnp.stack([fraction**k for k in range(STAGES + 1)])
        return self.start + self.length * jnp.einsum("ps,p...,cs...->c...", INTEGRALS, powers, self.rates)

    def falls_to_zero(self, event: Callable[[States], Number], first: Number) -> Number:
        """The fraction of the step, after `first`, at which a function of the state falls to zero; 1 if it does not fall
        so far."""
        bracket = halved(lambda part: event(self.at(part)) > 0.0, first, jnp.ones_like(first))
        fraction = jax.lax.stop_gradient(bracket[1])
        # Bisection has no derivative, so the implicit function theorem supplies it.
        missing, rise = jax.jvp(lambda part: event(self.at(part)), (fraction,), (jnp.ones_like(fraction),))
        is_inside = (fraction < 1.0) & (rise != 0.0)
        shift = (missing - jax.lax.stop_gradient(missing)) / jax.lax.stop_gradient(jnp.where(is_inside, rise, 1.0))
        return fraction - jnp.where(is_inside, shift, 0.0)

    @property
    def end(self) -> States:
        """The state at the end of the step, NaN if the step did not converge."""
        state = self.start + self.length * jnp.einsum("s,cs...->c...", WEIGHTS[-1], self.rates)
        return jnp.where(self.converged, state, jnp.nan)


def slip_onset(
    stick_slip: "StickSlip", field: Field, state: States, size: int, scales: States, longest: Lanes, tolerance: Lanes
) -> Onset:
    """Compute the beginning of a slip from a contact at rest.

    **Arguments:**

    - `stick_slip`: the equations with slip and without.
    - `field`: rate of the slipping state, including other integrated components.
    - `state`: a state at rest, (components, ...); the equations use the first `size` components; `scales`: their
      magnitudes.
    - `longest`: longest duration [s]; `tolerance`: tolerance for the estimated error, relative to the magnitudes.

    **Returns:** an `Onset`.
    """
    core_state, slipping, rolling = state[:size], stick_slip.slipping, stick_slip.rolling
    rolling_rate = rolling.field(core_state)
    contact = _Contact.of(stick_slip, core_state, rolling_rate)
    rolling_rate = jnp.concatenate([rolling_rate, jnp.zeros_like(state[size:])])
    scales = scales.reshape(scales.shape[:1] + (1,) * (state.ndim - scales.ndim) + scales.shape[1:])

    def iterated(duration, times):
        """Slip velocities and rates at the stages, in one loop, so that the equations are compiled once."""

        def newton(_, carry):
            v, states, _, _ = carry
            slipping_state = rolling.with_slip(states[:size], Slip(v[0], v[1]))
            rates = field(jnp.concatenate([slipping_state, states[size:]]))
            states = state[:, None] + duration * jnp.einsum("js,cs...->cj...", WEIGHTS, rates)
            slip = slipping.motion(states[:size]).slip
            change = contact.correction(duration, v, jnp.stack([slip.x, slip.y]) - v)
            return v + change, states, change, rates

        # The force of rolling must have changed accordingly, or Newton's first correction would stop the slip.
        rolling_states = state[:, None] + times * rolling_rate[:, None]
        # The slip velocity in the limit of small times.
        v = contact.direction[:, None] * (contact.rise[0] + contact.rise[1] * times) * times
        return jax.lax.fori_loop(0, ITERATIONS, newton, (v, rolling_states, v, jnp.zeros_like(rolling_states)))

    def shorten(carry):
        trial, duration, converged, _ = carry
        times = duration * NODES.reshape((-1,) + (1,) * (state.ndim - 1))
        _, states, change, rates = iterated(duration, times)
        residual = jnp.max(length(*change), axis=0) / stick_slip.speed
        highest = duration * jnp.abs(jnp.einsum("s,cs...->c...", HIGHEST, rates))
        # The scales of a launch that is upright up to round-off are nearly zero.
        sizes = jnp.maximum(scales, jnp.max(jnp.abs(states), axis=1))
        error = jnp.maximum(jnp.max((highest / sizes)[:size], axis=0), residual)
        # The contact must persist, or this step would miss a loss of contact.
        lost = jnp.min(slipping.contact_margin(states[:size]), axis=0) <= 0.0
        error = jnp.where(jnp.isfinite(error) & ~lost, error, jnp.inf)
        converged = error <= jnp.maximum(tolerance, LEAST_ERROR)
        factor = jnp.clip(0.8 * (tolerance / error) ** (1.0 / STAGES), 0.4, 0.8)
        return trial + 1, jnp.where(converged, duration, factor * duration), converged, rates

    duration = jnp.minimum(FIRST * tolerance ** (1.0 / STAGES) * contact.unit, longest)
    rates = jnp.zeros((*state.shape[:1], STAGES, *state.shape[1:]))
    _, duration, converged, rates = jax.lax.while_loop(
        lambda carry: (carry[0] < TRIALS) & ~jnp.all(carry[2]),
        shorten,
        (0, duration, jnp.zeros(duration.shape, bool), rates),
    )
    return Onset(state, duration, rates, converged)


class _Contact(eqx.Module):
    """The quantities that decide how a contact at rest begins to slip.

    - `direction`: against the force of rolling; `rise`: the slip's acceleration [m/s^2] and half its rate [m/s^3] at
      the start.
    - `inverse_mass`: M [1/kg] as (M11, M12, M22); `load_change`: n, the change of N by the force along the arena.
    - `mu`; `free_load`: N without a force along the arena [N]; `unit`: unit of time [s].
    """

    direction: Float[Array, "2 ..."]
    rise: tuple[Float[Array, "..."], Float[Array, "..."]]
    inverse_mass: tuple[Float[Array, "..."], Float[Array, "..."], Float[Array, "..."]]
    load_change: Float[Array, "2 ..."]
    mu: Float[Array, "..."]
    free_load: Float[Array, "..."]
    unit: Float[Array, "..."]

    @classmethod
    def of(cls, stick_slip: "StickSlip", state: States, rate: States) -> "_Contact":
        rolling, mu, weight = stick_slip.rolling, stick_slip.mu, stick_slip.weight
        grip, grip_rate = jax.jvp(lambda point: rolling.grip(point, mu), (state,), (rate,))
        F1, F2, N = rolling.evaluate(state)[1]
        force = length(F1, F2)
        force = jnp.where(force > 0.0, force, 1.0)
        d = jnp.stack([-F1 / force, -F2 / force])

        # The impulses that give the contact unit velocities: P_t = M^-1 v and P_n = -n . P_t.
        (a, b, f), (_, c, h) = rolling.unit_impulse(state, 0), rolling.unit_impulse(state, 1)
        determinant = a * c - b * b
        load_change = jnp.stack([b * h - c * f, b * f - a * h]) / determinant
        yields = d[0] * (a * d[0] + b * d[1] + mu * f) + d[1] * (b * d[0] + c * d[1] + mu * h)
        rise = (greatest(-grip, 0.0) * weight / yields, greatest(-grip_rate, 0.0) * weight / (2.0 * yields))
        spin = jnp.sqrt(sum(x * x for x in rolling.rotation(state)[0]))
        unit = 1.0 / jnp.maximum(spin, stick_slip.speed / rolling.body.size)
        inverse_mass = (c / determinant, -b / determinant, a / determinant)
        return cls(d, rise, inverse_mass, load_change, mu, N + load_change[0] * F1 + load_change[1] * F2, unit)

    def correction(self, duration: Number, v: Slips, missing: Slips) -> Slips:
        """Newton's correction of the slip velocities; only the slip's direction makes the equations stiff.

        With F = -mu N d along the arena and N = N0 - n . F, so that N = N0 / (1 - mu n . d), a turn of d by eta changes
        the acceleration by -eta mu N M (1 - mu d n^T)^-1 d', with d' across d. Beyond the cone, this N is not that of
        rolling.
        """
        size = length(v[0], v[1])
        size = jnp.where(size > 0.0, size, 1.0)
        unit = v / size
        normal = jnp.stack([-unit[1], unit[0]])
        n, (M11, M12, M22) = self.load_change, self.inverse_mass
        painleve_factor = 1.0 - self.mu * (n[0] * unit[0] + n[1] * unit[1])
        share = self.mu * (n[0] * normal[0] + n[1] * normal[1]) / painleve_factor
        x, y = self.mu * self.free_load / painleve_factor * (normal + share * unit)
        pull = jnp.stack([M11 * x + M12 * y, M12 * x + M22 * y])
        # For each pair of stages: normal_j . pull_k, times the weight of stage k in stage j.
        matrix = duration * jnp.einsum("jk,ij...,ik...->jk...", WEIGHTS, normal, pull)
        matrix = matrix + jnp.eye(STAGES).reshape((STAGES, STAGES) + (1,) * (size.ndim - 1)) * size
        # These matrices need no pivots.
        solved = functools.partial(solve, positive=True)
        for _ in range(size.ndim - 1):
            solved = jax.vmap(solved, -1, -1)
        turn = solved(matrix, normal[0] * missing[0] + normal[1] * missing[1])
        change = missing - duration * jnp.einsum("js,is...->ij...", WEIGHTS, pull * turn)
        # The force depends only on the slip's direction, and where a slip begins, v is much smaller than the change of
        # v by a small turn of the force. So the new direction is the turned direction, not the direction of the
        # corrected v, and v is never reversed.
        new_direction = unit + turn * normal
        new_size = greatest(size + change[0] * unit[0] + change[1] * unit[1], 0.2 * size)
        return new_size / length(new_direction[0], new_direction[1]) * new_direction - v


#: The remaining sliding distance at which a slip is stopped, over the tolerance and the radius. The error of the state
#: is at most a tenth of the tolerance. The impulse comes too early by the speed over the deceleration: 8e-8 s at a
#: tolerance of 1e-11.
LEFT = 0.1

#: Slip speed, in units of sqrt(g R), below which a state counts as rolling; rounding errors leave a smaller speed. No
#: run depends on it; where a slip begins, the forces of both kinds of motion are equal in the limit.
AT_REST = 1e-10

#: Round-off allowed in the grip of rolling: a top that stands upright needs no grip. It delays a slip by this value
#: over the rate of the grip, about 1e-14 s.
ROUNDING = 1e-13


class StickSlip(AbstractContactDynamics):
    """The equations of motion of a scene with `SetValuedCoulomb`, in place of `Dynamics`.

    A state whose contact is at rest rolls; any other state slips.

    - `slipping`: the equations of motion under the full force; `rolling`: the equations without slip.
    - `mu`: coefficient of friction [1].
    """

    slipping: Dynamics | RigidSlipping
    rolling: RollingDynamics | RigidRolling
    mu: Float[Array, "..."]

    @property
    def weight(self) -> Float[Array, "..."]:
        return self.slipping.weight

    @property
    def frame(self) -> AbstractFrame:
        """The frame of the body on the arena."""
        return self.slipping.frame

    @property
    def speed(self) -> Float[Array, "..."]:
        """The speed sqrt(g R) [m/s]."""
        return jnp.sqrt(self.slipping.gravity * self.rolling.body.size)

    def motion(self, state: Components) -> Motion:
        """Evaluate the equations of motion for the state's kind of motion.

        **Arguments:**

        - `state`: (8 + the arena's place, ...) as `tippe/model/dynamics.py` states it.

        **Returns:** a `Motion`.
        """
        slips = self.slip_speed(state) > AT_REST * self.speed
        kinds = (self.slipping.motion(state), self.rolling.motion(state))
        return jax.tree.map(lambda slipping, rolling: jnp.where(slips, slipping, rolling), *kinds)

    def loss(self, state: States) -> Int[Array, "..."]:
        """How a contact with zero margin has ended: a code in `LOSSES`. Only a slipping contact can jam."""
        return self.slipping.loss(state)

    def slip_speed(self, state: Components) -> Float[Array, "..."]:
        """Speed of the contact point along the arena [m/s]."""
        slip = self.slipping.motion(state).slip
        return length(slip.x, slip.y)

    def rests(self, state: States) -> Bool[Array, "..."]:
        """Whether the contact is at rest."""
        return self.slip_speed(state) <= AT_REST * self.speed

    def rotation(self, state: Components) -> tuple[Vector, Vector]:
        return self.slipping.rotation(state)

    def stopped(self, state: States) -> States:
        """The state after the impulse that stops the slip, with the body's axes at unit length.

        Step errors change this length, so the slip after the impulse would be as large as these errors; but
        where a slip begins, its direction tolerates only rounding errors.
        """
        zero = jnp.zeros_like(state[0])
        return self.rolling.with_slip(self.rolling.with_unit_axes(state), Slip(zero, zero))

    def grip_left(self, state: States) -> Float[Array, "..."]:
        """The reserve of a rolling top before it slips, as a fraction of the weight."""
        return self.rolling.grip(state, self.mu) + ROUNDING


class Change(NamedTuple):
    """The transition at the end of a mode.

    - `state`: the state that follows, and whether it `rolls`; `lost`: whether the contact is lost instead.
    - `onset`: the beginning of the slip if the top does not roll; it starts `wait` [s] after the mode has ended.
    - `elapsed`: time until the motion continues [s].
    """

    state: States
    rolls: Bool[Array, "..."]
    lost: Bool[Array, "..."]
    onset: Onset
    wait: Float[Array, "..."]
    elapsed: Float[Array, "..."]


class ContactMode(StickSlip):
    """One of the two kinds of motion of a `StickSlip`; its contact margin falls to zero at its end.

    - `tolerance`: relative tolerance of the integration; `rolls`: whether the top rolls or slips.
    """

    tolerance: Float[Array, ""]
    rolls: bool = eqx.field(static=True)

    def motion(self, state: Components) -> Motion:
        """The equations of motion of this kind."""
        return (self.rolling if self.rolls else self.slipping).motion(state)

    def margins(self, state: States) -> tuple[Float[Array, "..."], ...]:
        """Positive while this kind of motion lasts. Rolling leaves the friction cone before the normal force
        vanishes."""
        if self.rolls:
            grip, room = self.grip_left(state), self.rolling.motion(state).room
            return (grip,) if room is None else (grip, room - FITS)
        return (*self.slipping.margins(state), self.slip_left(state))

    def slip_left(self, state: States) -> Float[Array, "..."]:
        """Excess of the slip speed over the speed at which a slip ends, in units of sqrt(g R). A slip that grows does
        not end."""
        speed, change = self._slowing(state)
        way = LEFT * self.tolerance * self.rolling.body.size
        return (speed - jnp.sqrt(2.0 * way * greatest(-change, 0.0))) / self.speed

    def _slowing(self, state: States) -> tuple[Float[Array, "..."], Float[Array, "..."]]:
        """The slip's speed [m/s] and its rate."""
        return jax.jvp(self.slip_speed, (state,), (self.slipping.field(state),))

    def ended(self, state: States, size: int, slipping: Field, scales: States, left: Float[Array, "..."]) -> Change:
        """The change that follows the end of this kind of motion.

        **Arguments:**

        - `state`: (components, ...), at zero margin; the equations use the first `size` components.
        - `slipping`: rate of the whole state during slip; `scales`: its magnitudes.
        - `left`: time [s] to the horizon; the beginning of a slip is not longer.
        """
        core_state, quadratures = state[:size], state[size:]
        stopped_state = self.stopped(core_state)
        zero = jnp.zeros_like(core_state[0])
        if self.rolls:
            sticks = zero > 0.0
            # The mode ended because of the grip or the room, or there was no contact to begin with, as after an impact.
            # The contact separates if the arena would have to pull without a force along it: unless the contact jams, the
            # normal force has the same sign for the ending roll, for the following slip and without friction.
            room = self.rolling.motion(core_state).room
            frictionless = dataclasses.replace(self.slipping, friction=Frictionless())
            lost = frictionless.motion(stopped_state).normal_force <= 0.0
            if (unloaded := self.unloaded(core_state, scales[:size])) is not None:
                lost |= unloaded
            lost = lost if room is None else lost | (room - FITS <= self.grip_left(core_state))
            wait = zero
        else:
            sticks = self.rolling.grip(stopped_state, self.mu) >= 0.0
            lost = self.slipping.contact_margin(core_state) <= self.slip_left(core_state)
            # A slip that reverses continues through zero, which it reaches in its remaining time. A slip along which the
            # force of rolling pulls does not reverse: it begins anew.
            speed, change = self._slowing(core_state)
            slip, (F1, F2, _) = self.slipping.motion(core_state).slip, self.rolling.evaluate(stopped_state)[1]
            reverses = (change < 0.0) & (slip.x * F1 + slip.y * F2 > 0.0)
            wait = jnp.where(reverses & ~sticks & ~lost, -speed / jnp.where(reverses, change, 1.0), 0.0)
            wait = jnp.minimum(wait, left)
            stopped_state = stopped_state + wait * self.rolling.field(
                stopped_state + 0.5 * wait * self.rolling.field(stopped_state)
            )
            quadratures = quadratures + wait * slipping(state)[size:]
            # Until then, the force of rolling may have returned into the friction cone.
            sticks = self.rolling.grip(stopped_state, self.mu) >= 0.0
        new_state = jnp.concatenate([stopped_state, quadratures])
        slips = ~(sticks | lost)
        max_duration = jnp.where(slips, left - wait, 0.0)
        onset = slip_onset(self, slipping, new_state, size, scales, max_duration, self.tolerance)
        state_after = jnp.where(slips, onset.end, jnp.where(lost, state, new_state))
        return Change(state_after, sticks, lost, onset, wait, wait + jnp.where(slips, onset.length, 0.0))
