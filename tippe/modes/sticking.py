"""Stick and slip under set-valued Coulomb friction, with and without flights."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float, Int

from nonholonomic.compilation.xla_cpu import compiled_setup
from nonholonomic.hybrid import AbstractBatchedMode, Transition, TransitionPath
from nonholonomic.integration import AbstractProblem, ExtendedProblem, Lanes, States
from nonholonomic.integration.problem import CROSSED, LEFT_DOMAIN, REACHED_END, RUNNING

from ..model.body import Number, Top
from ..model.dynamics import COS_THETA, PLACE, AbstractDynamics, parts
from ..model.rigid import AbstractRigidBody
from ..model.scene import Scene
from ..model.stick_slip import ContactMode, Onset, StickSlip
from . import airborne
from .impact import FreeBody, balls, select
from .problems import InversionProblem, Quadratures

# Runs with stick and slip: the cells of a table, and a single run with its path. With flights, the flight is as in
# `airborne.py`, with its states and passive quadratures, over any arena, the level plane included.

#: The numbers of the two modes without flights.
SLIPPING, ROLLING = range(2)

#: The numbers of the same modes with flights; flying has the same number as in `airborne.py`.
TOUCH_SLIPPING, TOUCH_ROLLING = airborne.SLIDING, 2


class StickSlipMode(AbstractBatchedMode):
    """Slipping or rolling until theta reaches an angle; with `last`, the last crossing counts.

    The equations of motion have the first `size` components. For a single run whose path is kept, `passive` quadratures
    follow. Without an angle, a run ends when the spin about the normal reverses; `spin` is the initial spin. Where the
    contact is lost, the top flies in a `scene` that is given; otherwise the run ends.
    """

    kind: ContactMode
    # An array, or `None`.
    cos_angle: Any
    scales: States
    last: bool = eqx.field(static=True)
    size: int = eqx.field(static=True)
    passive: Quadratures | None = None
    spin: Float[Array, "..."] | None = None
    scene: Scene[Top] | None = None

    def problem(self, state: States) -> AbstractProblem:
        return self._under(self.kind, state)

    def shown(self, state: Float[Array, "components times"]) -> Float[Array, "shown times"]:
        return self._with_distance(self.carried_along(state) if self.kind.rolls else state)

    def between(self, motion: tuple[Onset, Array], passed: Float[Array, " times"]) -> Float[Array, "shown times"]:
        onset, wait = motion
        return self._with_distance(onset.at((passed - wait) / jnp.where(onset.length > 0.0, onset.length, 1.0)))

    def _with_distance(self, rows: Float[Array, "components times"]) -> Float[Array, "shown times"]:
        """The output rows of states in contact: with flights, the distance from the arena and its rate are 0."""
        return rows if self.scene is None else jnp.concatenate([rows, jnp.zeros_like(rows[:2])])

    def carried_along(self, state: States) -> States:
        """The state of a rolling top, whose velocity follows from the other components."""
        return jnp.concatenate([self.kind.rolling.carried_along(state[: self.size]), state[self.size :]])

    def reset_map(self, state: States, left: Lanes) -> Transition:
        """Stick, slip, or fly where the contact is lost; without flights, the run ends there. Counts flights, and changes
        from slip to rolling."""
        slipping = self._under(self.kind.slipping, state)
        change = self.kind.ended(state, self.size, lambda point: slipping.field(left, point), self.scales, left)
        onset, length = change.onset, change.onset.length
        wait_fraction = -change.wait / jnp.where(length > 0.0, length, 1.0)
        is_falling = (self._event(state) > 0.0) & (self._event(change.state) <= 0.0)
        if self.spin is None:
            crosses = is_falling & ~change.rolls & ~change.lost
            rows = slice(COS_THETA, COS_THETA + 1)
            cosine = Onset(onset.start[rows], length, onset.rates[rows], onset.converged)
            fraction = cosine.falls_to_zero(lambda part: part[0] - self.cos_angle, wait_fraction)
        else:
            # The impulse that stops a slip changes the spin, too.
            crosses = is_falling & ~change.lost
            fraction = onset.falls_to_zero(self._event, wait_fraction)
        # Only a launch beyond the event, from which the top slips at once, reaches this point beyond the event.
        is_beyond = (self._event(state) <= 0.0) & (not self.last)
        crossing = jnp.where(is_beyond, 0.0, change.wait + fraction * length)
        crosses |= is_beyond
        ends = crosses & (not self.last)
        record = None
        if self.passive is not None:
            # The beginning of a slip, if there is one.
            end = jnp.where(change.rolls | change.lost, jnp.inf, change.elapsed)[None]
            record = TransitionPath(
                end, jax.tree.map(lambda leaf: leaf[None], (onset, change.wait)), jnp.ones(end.shape, int)
            )
        status = jnp.where(change.elapsed >= left, REACHED_END, RUNNING)
        status = jnp.where(change.lost, LEFT_DOMAIN, jnp.where(ends, CROSSED, status))
        state_after = jnp.where(is_beyond, state, jnp.where(ends, onset.at(fraction), change.state))
        rolls = jnp.where(is_beyond | change.lost, self.kind.rolls, change.rolls)
        mode = jnp.where(rolls, ROLLING, SLIPPING)
        counts = [change.rolls & ~change.lost & ~is_beyond & (not self.kind.rolls)]
        if self.scene is not None:
            lost_state = self.carried_along(state_after) if self.kind.rolls else state_after
            flies = (status == LEFT_DOMAIN) & (self.kind.loss(lost_state[: airborne.OWN]) == 0)
            mode = jnp.where(flies, airborne.FLYING, jnp.where(rolls, TOUCH_ROLLING, TOUCH_SLIPPING))
            flight = airborne.lift_off(self.scene, lost_state, self.passive is not None)
            state_after, status = jnp.where(flies, flight, state_after), jnp.where(flies, RUNNING, status)
            counts = [flies, *counts]
        return Transition(
            mode=mode,
            state=state_after,
            elapsed=jnp.where(ends, crossing, change.elapsed),
            status=status,
            crossing_time=jnp.where(crosses, crossing, jnp.inf),
            counts=jnp.stack(counts).astype(int),
            record=record,
        )

    def _event(self, state: States) -> Lanes:
        """The function whose fall to zero ends a run."""
        if self.spin is None:
            return state[COS_THETA] - self.cos_angle
        return self.kind.normal_spin(state[: self.size]) / self.spin

    def _under(self, equations: AbstractDynamics, state: States) -> AbstractProblem:
        """The motion from some states under given equations."""
        size = self.size
        problem = InversionProblem(equations, self.cos_angle, state[:size], self.scales[:size], self.spin)
        if self.passive is None:
            return problem
        return ExtendedProblem(problem, self.passive, state[size:], self.scales[size:], ends_on_event=False)


class Land(airborne.Fly):
    """Flying over the arena, to a contact that slips or rolls."""

    def reset_map(self, state: States, left: Lanes) -> Transition:
        """Strike the arena; then rebound, or continue to slip or roll."""
        transition, stick_slip = super().reset_map(state, left), self.scene.dynamics
        assert isinstance(stick_slip, StickSlip)
        mode = jnp.where(stick_slip.rests(transition.state[: airborne.OWN]), TOUCH_ROLLING, TOUCH_SLIPPING)
        counts = jnp.concatenate([transition.counts, jnp.zeros_like(transition.counts)])
        return transition._replace(
            mode=jnp.where(transition.mode == airborne.FLYING, airborne.FLYING, mode), counts=counts
        )


def stick_slip_modes(
    scene: Scene, problem: InversionProblem, tolerance: ArrayLike, last: bool, with_quadratures: bool = False
) -> tuple[tuple[AbstractBatchedMode, ...], Int[Array, " cells"]]:
    """The modes of runs, and the index of the mode in which each starts. **Arguments:** `tolerance`: as for `ContactMode`;
    the others as for `hopping_modes`."""
    stick_slip, passive = problem.dynamics, Quadratures() if with_quadratures else None
    assert isinstance(stick_slip, StickSlip)
    x_axis = 3 * isinstance(scene.body, AbstractRigidBody)
    size, flies = PLACE.start + len(stick_slip.frame.lengths) + x_axis, scene.contact == "hybrid"
    laws = (stick_slip.slipping, stick_slip.rolling, stick_slip.mu, jnp.asarray(tolerance, float))
    options = (problem.cos_angle, problem.scales, last, size, passive, problem.spin, scene if flies else None)
    slips, rolls = (StickSlipMode(ContactMode(*laws, rolls=rolls), *options) for rolls in (False, True))
    rests = compiled_setup(stick_slip.rests)(problem.states[:size])
    if not flies:
        return (slips, rolls), jnp.where(rests, ROLLING, SLIPPING)
    land = Land(scene, problem.scales, problem.cos_angle, with_quadratures)
    return (slips, land, rolls), jnp.where(rests, TOUCH_ROLLING, TOUCH_SLIPPING)


# Convert the final states of runs over any arena to states in contact, and compute their energy and why a contact
# ended.


def energy_in(scene: Scene, state: States, mode: Int[Array, " cells"]) -> tuple[Lanes, Lanes]:
    """The least and the greatest energy [J] that a state at the end of a mode, or of a flight in closed form from there,
    may have. **Arguments:** `mode`: the index of the mode."""
    if scene.flies_in_closed_form:
        # Where both spheres touch, either determines the height. The state has no speed of the sphere along the normal, which a
        # flight may give it.
        free = FreeBody.of(scene.body, select(mode == 1, balls(scene.body)[-1], balls(scene.body)[0]), state)
        total = free.energy(scene.body, scene.gravity)
        return total - 0.5 * scene.body.mass * free.velocity[2] ** 2, total
    energy_above, flies = 0.0, scene.contact == "hybrid"
    if flies:
        state, distance, rate = above_the_ground(scene, state, mode)
        energy_above = lifted(scene, state, distance, rate)
    if scene.friction.set_valued:
        rolls = mode == (TOUCH_ROLLING if flies else ROLLING)
        state = jnp.where(rolls, scene.dynamics.rolling.carried_along(state), state)
    total = scene.energy(state) + energy_above
    return total, total


def lifted(scene: Scene[Top], state: States, distance: ArrayLike, rate: ArrayLike) -> Number:
    """Difference [J] between the energy of a flying top and that of the same state in contact; `distance` [m] is that
    of its sphere from the ground, and `rate` [m/s] the rate of this distance."""
    _, e, L, place = parts(state)
    # In contact the velocity along n is that of the centre of mass about the sphere's centre.
    moment = -scene.body.offset * (L[0] * e[1] - L[1] * e[0]) / scene.body.I1
    potential = scene.gravity * distance * scene.frame.vertical(place)[2]
    return scene.body.mass * (potential + 0.5 * ((moment + rate) ** 2 - moment**2))


def above_the_ground(scene: Scene[Top], state: States, mode: Int[Array, " cells"]) -> tuple[States, Lanes, Lanes]:
    """States of runs, in the layout for sliding on the top's own sphere; and the distance [m] of this sphere from the
    ground with its rate [m/s]. States of other modes refer to the foot below this sphere.
    """
    flies, flight = mode == airborne.FLYING, state[: airborne.OWN]
    if scene.body.stem is not None:
        on_stem = airborne.lift_off(scene, flight, False, balls(scene.body)[1])
        flies, flight = mode != airborne.SLIDING, jnp.where(mode == airborne.ON_STEM, on_stem, flight)
    flying = airborne.flight_state(flight)
    ground = airborne.below(scene, flying)
    free = airborne.flying_body(scene, flying, ground)
    rate = free.gap_rate(scene.body, balls(scene.body)[0])
    contact = jnp.where(flies, airborne.in_contact(ground, free), state[: airborne.OWN])
    return contact, jnp.where(flies, ground.gap, 0.0), jnp.where(flies, rate, 0.0)


def loss(scene: Scene, state: States) -> Int[Array, "..."]:
    """Why a contact ended: a code in `LOSSES` (`tippe/model/dynamics.py`)."""
    dynamics = scene.dynamics
    if not scene.has_stem:
        return dynamics.loss(state)
    # The domain margin of the touching sphere has vanished.
    stem = airborne.standing(scene, balls(scene.body)[1])
    on_stem = jnp.abs(stem.contact_margin(state)) < jnp.abs(dynamics.contact_margin(state))
    return jnp.where(on_stem, stem.loss(state), dynamics.loss(state))
