"""Sliding as a mode of the motion, on one sphere or on both, and its transitions: to a flight, to the other sphere, or
to the end.

A single run whose path is kept has seven passive quadratures after its state: the position (x, y) of the centre of
mass [m], the vector c of `problems.py`, the rotation angle of the top about its axis [rad], and the work of
friction and impacts [J].
"""

from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from nonholonomic.compilation.xla_cpu import compiled_setup, least
from nonholonomic.hybrid import AbstractHoppingMode, Transition, TransitionPath
from nonholonomic.integration import AbstractProblem
from nonholonomic.integration.problem import CROSSED, RUNNING, UNRESOLVED

from ..model.body import Top
from ..model.dynamics import COS_THETA, Dynamics
from ..model.scene import Scene
from .flight import (
    OWN,
    Air,
    Cells,
    clearance,
    cone,
    flown,
    height,
    land,
    lost_contact,
    own_and_other,
    quadratures_after,
    select,
    stem_takes_over,
    take_flight,
)
from .impact import Ball, FreeBody, LeaningDynamics, as_free_body, at_rest, balls, contact_state, shown, standing_on
from .problems import AbstractFlyingMode, InversionProblem, Quadratures, beyond_on_stem

#: Most consecutive bounces before a run fails.
MOST_BOUNCES = 10_000

#: Angle by which the axis turns between the default output times of a flight [rad].
SHOWN = 0.4


class SlidingOnOne(InversionProblem):
    """Sliding on one of two spheres until theta reaches an angle, the contact is lost or jams, or the other sphere
    lands.
    """

    contact_ball: Ball = eqx.field(kw_only=True)
    other_ball: Ball = eqx.field(kw_only=True)
    on_stem: Bool[Array, ""] = eqx.field(kw_only=True)

    def event_function(self, state: Float[Array, "components cells"]) -> Cells:
        return beyond_on_stem(super().event_function(state), self.on_stem, self.stem_counts)

    def domain_margin(self, time: Cells, state: Float[Array, "components cells"]) -> Cells:
        return least(*self.margins(time, state))

    def margins(self, time: Cells, state: Float[Array, "components cells"]) -> tuple[Cells, ...]:
        assert isinstance(self.dynamics, Dynamics)
        return (*super().margins(time, state), clearance(self.dynamics, self.contact_ball, self.other_ball, state))


class Slide(AbstractFlyingMode, AbstractHoppingMode):
    """Sliding on the sphere numbered `number`, in the order of `free_body.balls`, up to an angle of theta.

    `number` is an array, so that one program serves both spheres. With `last`, a run continues through the angle. A
    single run whose path is kept records its flights.
    """

    most_hops: ClassVar[int] = MOST_BOUNCES

    number: Int[Array, ""]
    last: bool = eqx.field(static=True)

    def problem(self, state: Float[Array, "components cells"]) -> AbstractProblem:
        contact_ball, other_ball = own_and_other(balls(self.scene.body), self.number)
        contact = (standing_on(self.scene.dynamics, contact_ball), self.cos_angle, state[:OWN], self.scales[:OWN])
        problem = (
            InversionProblem(*contact, flies=True)
            if other_ball is None
            else SlidingOnOne(
                *contact,
                contact_ball=contact_ball,
                other_ball=other_ball,
                on_stem=self.number == 1,
                stem_counts=self.stem_counts,
                flies=True,
            )
        )
        return self.extended(problem, Quadratures(self.scene.body.I3, of_mass=True), state)

    def shown(self, state: Float[Array, "15 times"]) -> Float[Array, "17 times"]:
        contact_ball, _ = own_and_other(balls(self.scene.body), self.number)
        return shown(self.scene.body, as_free_body(self.scene.body, contact_ball, state), state[OWN:])

    def between(self, motion: Any, passed: Float[Array, " times"]) -> Float[Array, "17 times"]:
        free, quadratures = motion
        free_after = flown(self.scene.body, self.scene.gravity, free, passed)
        return shown(self.scene.body, free_after, quadratures_after(self.scene.body, free, quadratures, passed))

    def reset_map(self, state: Float[Array, "components cells"], left: Cells) -> Transition:
        """Fly, and bounce, until a sphere stays on the plane; or let the other sphere land if it touches the plane.

        Counts the flights.
        """

        def hop(carry: tuple[Air, Array, TransitionPath | None]) -> tuple[Air, Array, TransitionPath | None]:
            air, count, record = carry
            air_after, air_landed = self.hop(air, left)
            return air_landed, count + 1, _with_flight(self.scene.body, record, air, air_after)

        def under_way(carry: tuple[Air, Array, TransitionPath | None]) -> Array:
            return jnp.any(carry[0].open) & (carry[1] < MOST_BOUNCES)

        start = self.lost(state)
        record = _no_flights(start) if self.with_quadratures else None
        air, _, record = jax.lax.while_loop(under_way, hop, (start, jnp.zeros((), int), record))
        return self.closed(air)._replace(record=record)

    def lost(self, state: Float[Array, "components cells"]) -> Air:
        start = lost_contact(self.scene, self.number, state)
        # A launch beyond the angle and without contact ends at once.
        is_beyond = start.open & (state[COS_THETA] <= self.cos_angle) & (not self.last)
        ended = start._replace(
            status=jnp.full_like(start.status, CROSSED), open=~is_beyond, crossing_time=start.elapsed
        )
        start = select(is_beyond, ended, start)
        return start._replace(quadratures=state[OWN:]) if self.with_quadratures else start

    def hop(self, air: Air, left: Cells) -> tuple[Air, Air]:
        """One flight of a top whose contact is open, and the impact at its end."""
        air_after, has_landed = take_flight(self.scene, air, self.cos_angle, left, self.last)
        if air.falls is None:
            air_landed = land(self.scene, air_after)
        else:
            air_after, has_landed = select(air.falls, air, air_after), air.falls | has_landed
            air_landed = land(self.scene, air_after)
            if self.stem_counts is not None:
                air_landed = stem_takes_over(air, air_after.ball == 1, air_landed, self.stem_counts, self.last)
        return air_after, select(air.open, select(has_landed, air_landed, air_after), air)

    def motion_in(self, air: Air) -> tuple[FreeBody, Float[Array, "7 cells"] | None]:
        return air.free, air.quadratures

    def closed(self, air: Air) -> Transition:
        """The transition for a top that has returned to the plane, or whose run has ended."""
        status, state = jnp.where(air.open, UNRESOLVED, air.status), contact_state(air.free)
        if air.quadratures is not None:
            state = jnp.concatenate([state, air.quadratures])
        counts = air.flights[None]
        return Transition(air.ball, state, air.elapsed, status, air.crossing_time, counts, log_rates=air.log_rates)


class LeaningProblem(InversionProblem):
    """Sliding on both spheres until theta reaches an angle or one of the contacts ends.

    The stem carries a part of the top, so its first event has happened; the sphere still touches, so, with `last`, that
    event has not.
    """

    last: bool = eqx.field(static=True, default=False, kw_only=True)

    def event_function(self, state: Float[Array, "components cells"]) -> Cells:
        return beyond_on_stem(super().event_function(state), jnp.asarray(not self.last), self.stem_counts)


class Lean(AbstractFlyingMode):
    """Sliding on both spheres; numbered after the modes of the single spheres. `last`: as for `Slide`."""

    last: bool = eqx.field(static=True)

    @property
    def rare(self) -> bool:
        # Few tops come to rest on both spheres.
        return True

    def problem(self, state: Float[Array, "components cells"]) -> AbstractProblem:
        dynamics: Any = LeaningDynamics.of(self.scene)
        contact = (dynamics, self.cos_angle, state[:OWN], self.scales[:OWN])
        problem = LeaningProblem(*contact, stem_counts=self.stem_counts, last=self.last)
        return self.extended(problem, Quadratures(self.scene.body.I3, of_mass=True), state)

    def shown(self, state: Float[Array, "15 times"]) -> Float[Array, "17 times"]:
        return shown(self.scene.body, as_free_body(self.scene.body, balls(self.scene.body)[0], state), state[OWN:])

    def reset_map(self, state: Float[Array, "components cells"], left: Cells) -> Transition:
        """Slide on the sphere whose normal force has not vanished."""
        number = LeaningDynamics.of(self.scene).heavier(state)
        state_at_rest = contact_state(
            at_rest(self.scene.body, as_free_body(self.scene.body, balls(self.scene.body)[0], state))
        )
        state = jnp.concatenate([state_at_rest, state[OWN:]])
        zero = jnp.zeros_like(state[0])
        running, zeros = jnp.full(zero.shape, RUNNING), jnp.zeros((1, *zero.shape), int)
        leaves_sphere = jnp.zeros(zero.shape, bool)
        if self.last and self.stem_counts is not None:
            leaves_sphere = (number == 1) & (self.stem_counts > 0.0)
        return Transition(number, state, zero, running, jnp.where(leaves_sphere, 0.0, jnp.inf), zeros)


def hopping_modes(
    scene: Scene[Top], problem: InversionProblem, tolerance: float, last: bool, with_quadratures: bool = False
) -> tuple[tuple[AbstractFlyingMode, ...], Int[Array, " cells"]]:
    """The modes of runs, sliding on each sphere and on both if there are two; and the index of the mode in which each
    starts.

    **Arguments:**

    - `scene`: a scene with `contact="hybrid"`; `problem`: the problem of its launches, which stand on their lower
      sphere.
    - `tolerance`: unused by these modes; `last`: whether the last crossing counts; `with_quadratures`: as for
      `AbstractFlyingMode`.
    """
    spheres, arguments = balls(scene.body), (scene, problem.scales, problem.cos_angle, with_quadratures)
    event = {"stem_counts": problem.stem_counts}
    slides = tuple(Slide(*arguments, jnp.asarray(number), last, **event) for number in range(len(spheres)))
    if len(spheres) == 1:
        return slides, jnp.zeros(problem.states.shape[1:], int)
    return (*slides, Lean(*arguments, last, **event)), _first_mode(scene.body, problem.states)


@compiled_setup
def _first_mode(body: Top, states: Float[Array, "components cells"]) -> Int[Array, " cells"]:
    """The number of the lower of the two spheres."""
    main, stem = balls(body)
    return (height(main, stem, states) < 0.0).astype(int)


def _no_flights(start: Air) -> TransitionPath:
    """An empty record for the flights of a single run."""

    def room(leaf: Array) -> Array:
        return jnp.zeros((MOST_BOUNCES, *leaf.shape), leaf.dtype)

    motions = jax.tree.map(room, (start.free, start.quadratures))
    return TransitionPath(jnp.inf + room(start.elapsed), motions, room(start.flights))


def _with_flight(body: Top, record: TransitionPath | None, air_before: Air, air_after: Air) -> TransitionPath | None:
    """The record of a single run, if there is one, with the flight between two states added, if there was one."""
    if record is None:
        return None
    place, has_flown = air_before.flights[0], air_after.flights > air_before.flights
    angle = cone(body, air_before.free).rate * (air_after.elapsed - air_before.elapsed)
    new = TransitionPath(
        jnp.where(has_flown, air_after.elapsed, jnp.inf),
        (air_before.free, air_before.quadratures),
        1 + (angle / SHOWN).astype(int),
    )
    return jax.tree.map(lambda leaves, leaf: leaves.at[place].set(leaf), record, new)
