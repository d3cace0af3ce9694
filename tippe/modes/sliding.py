"""Sliding as a mode of the motion, on one sphere or on both, and its transitions: to a flight, to the other sphere, or
to the end.

A single run whose path is kept has seven passive quadratures after its state: the position (x, y) of the centre of
mass [m], the vector c of `trajectory_problem.py`, the rotation angle of the top about its axis [rad], and the work of
friction and impacts [J].
"""

from typing import Any, ClassVar, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from nonholonomic.geometry import dot
from nonholonomic.hybrid import AbstractHoppingMode, Transition, TransitionPath
from nonholonomic.integration import CROSSED, FAILED, LEFT_DOMAIN, REACHED_END, RUNNING, UNRESOLVED, AbstractProblem
from nonholonomic.xla_cpu import compiled_setup, greatest, least

from ..model.dynamics import Dynamics
from ..model.scene import Scene
from ..model.state import COS_THETA, parts
from ..model.top import Top
from .flight import angle_reached, c_in_flight, cone, flown, fly
from .flying_mode import AbstractFlyingMode
from .free_body import (
    Ball,
    FreeBody,
    as_free_body,
    balls,
    contact_state,
    energy,
    gap,
    gap_rate,
    shown,
    standing_on,
    still_parting,
)
from .impact import CLOSING_SPEED, TOUCHING, resolve_impact
from .inversion_problem import InversionProblem
from .leaning import LeaningDynamics, at_rest
from .trajectory_problem import Quadratures

Cells = Float[Array, " cells"]

#: Most consecutive bounces before a run fails.
MOST_BOUNCES = 10_000

#: Number of components of a state, without the passive quadratures that may follow.
OWN = 8

#: Angle by which the axis turns between the default output times of a flight [rad].
SHOWN = 0.4


class Sliding(AbstractProblem):
    """Sliding until theta reaches an angle, a contact is lost or jams, or a sphere that does not touch the plane lands.

    `own` is the sphere that slides, and `other` the other sphere; `None` without a stem.
    """

    dynamics: Dynamics | LeaningDynamics
    own: Ball | None
    other: Ball | None
    cos_angle: Float[Array, "..."]
    states: Float[Array, "components cells"]
    scales: Float[Array, "components cells"]

    def start(self) -> tuple[Float[Array, "components cells"], Float[Array, "components cells"]]:
        return self.states, self.scales

    def field(self, time: Cells, state: Float[Array, "components cells"]) -> Float[Array, "components cells"]:
        return self.dynamics.field(state)

    def event_function(self, state: Float[Array, "components cells"]) -> Cells:
        return state[COS_THETA] - self.cos_angle

    def domain_margin(self, time: Cells, state: Float[Array, "components cells"]) -> Cells:
        return least(*self.margins(time, state))

    def margins(self, time: Cells, state: Float[Array, "components cells"]) -> tuple[Cells, ...]:
        margins = self.dynamics.margins(state)
        if self.own is None or self.other is None:
            return margins
        assert isinstance(self.dynamics, Dynamics)
        return (*margins, clearance(self.dynamics, self.own, self.other, state))


def clearance(dynamics: Dynamics, own: Ball, other: Ball, state: Float[Array, "components ..."]) -> Float[Array, "..."]:
    """Distance of the other sphere from the plane as a fraction of the radius of the touching sphere, plus the
    round-off allowed at lift-off.
    """
    _, e, L, _ = parts(state[:OWN])
    rate = (other.offset - own.offset) * dynamics.per_transverse * (L[0] * e[1] - L[1] * e[0])
    return height(own, other, state) / own.radius + still_parting(rate, dynamics.gravity, own.radius)


def height(own: Ball, other: Ball, state: Float[Array, "components ..."]) -> Float[Array, "..."]:
    """Distance [m] of the other sphere from the plane, for a top that stands on the sphere `own`."""
    return own.radius - other.radius + (other.offset - own.offset) * state[COS_THETA]


class Slide(AbstractFlyingMode, AbstractHoppingMode):
    """Sliding on the sphere numbered `number`, in the order of `free_body.balls`, up to an angle of theta.

    `number` is an array, so that one program serves both spheres. With `last`, a run continues through the angle. A
    single run whose path is kept records its flights.
    """

    most_hops: ClassVar[int] = MOST_BOUNCES

    number: Int[Array, ""]
    last: bool = eqx.field(static=True)

    def problem(self, state: Float[Array, "components cells"]) -> AbstractProblem:
        own, other = _own_and_other(balls(self.scene.body), self.number)
        dynamics = standing_on(self.scene.dynamics, own)
        problem = Sliding(dynamics, own, other, self.cos_angle, state[:OWN], self.scales[:OWN])
        return self.extended(problem, Quadratures(self.scene.body.I3, of_mass=True), state)

    def shown(self, state: Float[Array, "15 times"]) -> Float[Array, "17 times"]:
        own, _ = _own_and_other(balls(self.scene.body), self.number)
        return shown(self.scene.body, as_free_body(self.scene.body, own, state), state[OWN:])

    def between(self, motion: Any, passed: Float[Array, " times"]) -> Float[Array, "17 times"]:
        free, quadratures = motion
        later = flown(self.scene.body, self.scene.gravity, free, passed)
        return shown(self.scene.body, later, _carried(self.scene.body, free, quadratures, passed))

    def reset_map(self, state: Float[Array, "components cells"], left: Cells) -> Transition:
        """Fly, and bounce, until a sphere stays on the plane; or let the other sphere land if it touches the plane.

        Counts the flights.
        """

        def hop(carry: tuple[Air, Array, TransitionPath | None]) -> tuple[Air, Array, TransitionPath | None]:
            air, count, record = carry
            after, landed = self.hop(air, left)
            return landed, count + 1, _with_flight(self.scene.body, record, air, after)

        def under_way(carry: tuple[Air, Array, TransitionPath | None]) -> Array:
            return jnp.any(carry[0].open) & (carry[1] < MOST_BOUNCES)

        start = self.lost(state)
        record = _no_flights(start) if self.with_quadratures else None
        air, _, record = jax.lax.while_loop(under_way, hop, (start, jnp.zeros((), int), record))
        return self.closed(air)._replace(record=record)

    def lost(self, state: Float[Array, "components cells"]) -> "Air":
        start = lost_contact(self.scene, self.number, state)
        # A launch beyond the angle and without contact ends at once.
        beyond = start.open & (state[COS_THETA] <= self.cos_angle) & (not self.last)
        ended = start._replace(status=jnp.full_like(start.status, CROSSED), open=~beyond, crossing_time=start.elapsed)
        start = _where(beyond, ended, start)
        return start._replace(quadratures=state[OWN:]) if self.with_quadratures else start

    def hop(self, air: "Air", left: Cells) -> tuple["Air", "Air"]:
        """One flight of a top whose contact is open, and the impact at its end."""
        after, landed = take_flight(self.scene, air, self.cos_angle, left, self.last)
        if air.falls is not None:
            after, landed = _where(air.falls, air, after), air.falls | landed
        return after, _where(air.open, _where(landed, land(self.scene, after), after), air)

    def motion_in(self, air: "Air") -> tuple[FreeBody, Float[Array, "7 cells"] | None]:
        return air.free, air.quadratures

    def closed(self, air: "Air") -> Transition:
        """The transition for a top that has returned to the plane, or whose run has ended."""
        status, state = jnp.where(air.open, UNRESOLVED, air.status), contact_state(air.free)
        if air.quadratures is not None:
            state = jnp.concatenate([state, air.quadratures])
        counts = air.flights[None]
        return Transition(air.ball, state, air.elapsed, status, air.crossing_time, counts, log_rates=air.log_rates)


class Lean(AbstractFlyingMode):
    """Sliding on both spheres; numbered after the modes of the single spheres."""

    def problem(self, state: Float[Array, "components cells"]) -> AbstractProblem:
        problem = Sliding(leaning(self.scene), None, None, self.cos_angle, state[:OWN], self.scales[:OWN])
        return self.extended(problem, Quadratures(self.scene.body.I3, of_mass=True), state)

    def shown(self, state: Float[Array, "15 times"]) -> Float[Array, "17 times"]:
        return shown(self.scene.body, as_free_body(self.scene.body, balls(self.scene.body)[0], state), state[OWN:])

    def reset_map(self, state: Float[Array, "components cells"], left: Cells) -> Transition:
        """Slide on the sphere whose normal force has not vanished."""
        number = leaning(self.scene).heavier(state)
        own = contact_state(at_rest(self.scene.body, as_free_body(self.scene.body, balls(self.scene.body)[0], state)))
        state = jnp.concatenate([own, state[OWN:]])
        zero = jnp.zeros_like(state[0])
        running, none = jnp.full(zero.shape, RUNNING), jnp.zeros((1, *zero.shape), int)
        return Transition(number, state, zero, running, jnp.full_like(zero, jnp.inf), none)


def modes(
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
    slides = tuple(Slide(*arguments, jnp.asarray(number), last) for number in range(len(spheres)))
    if len(spheres) == 1:
        return slides, jnp.zeros(problem.states.shape[1:], int)
    return (*slides, Lean(*arguments)), _first_mode(scene.body, problem.states)


@compiled_setup
def _first_mode(body: Top, states: Float[Array, "components cells"]) -> Int[Array, " cells"]:
    """The number of the lower of the two spheres."""
    main, stem = balls(body)
    return (height(main, stem, states) < 0.0).astype(int)


def leaning(scene: Scene[Top]) -> LeaningDynamics:
    """The equations of motion of a scene's top on both of its spheres."""
    return LeaningDynamics(scene.body, scene.friction, scene.gravity)


class Air(NamedTuple):
    """A top that may be in the air.

    - `free`, `elapsed` [s]: the body and the time since the contact was lost.
    - `ball`: the sphere that touched last; `rising`: whether it left with a speed; `falls`: whether the other sphere is
      about to strike the plane without a flight; `None` for a top without a stem. Once the contact is closed, `ball` is
      the index of the mode.
    - `status`: `RUNNING`, or how the run ended, `LEFT_DOMAIN` if it has jammed; `crossing_time` [s] of the event,
      infinite if there was none.
    - `flights`: number of flights so far; `open`: whether there is no contact and the run continues.
    - `log_rates`: logarithms of the rates at the landings, as in `Transition`.
    - `quadratures`: the passive quadratures of a single run.
    """

    free: FreeBody
    elapsed: Cells
    ball: Int[Array, " cells"]
    rising: Bool[Array, " cells"]
    falls: Bool[Array, " cells"] | None
    status: Int[Array, " cells"]
    crossing_time: Cells
    flights: Int[Array, " cells"]
    open: Bool[Array, " cells"]
    log_rates: Cells
    quadratures: Float[Array, "7 cells"] | None = None


def lost_contact(scene: Scene[Top], number: Int[Array, ""], state: Float[Array, "components cells"]) -> Air:
    """The top at the end of sliding on the sphere with the given number: its contact is lost or jams, or the other
    sphere is at the plane.
    """
    own, other = _own_and_other(balls(scene.body), number)
    zero = jnp.zeros_like(state[0])
    dynamics = standing_on(scene.dynamics, own)
    falls, ball, jams = None, jnp.broadcast_to(number, zero.shape), dynamics.loss(state) > 0
    if other is not None:
        falls = clearance(dynamics, own, other, state) <= dynamics.contact_margin(state)
        ball, jams = jnp.where(falls, 1 - number, number), jams & ~falls
    return Air(
        free=as_free_body(scene.body, own, state),
        elapsed=zero,
        ball=ball,
        rising=jnp.zeros(zero.shape, bool),
        falls=falls,
        status=jnp.where(jams, LEFT_DOMAIN, RUNNING),
        crossing_time=jnp.full_like(zero, jnp.inf),
        flights=jnp.zeros(zero.shape, int),
        open=~jams,
        log_rates=zero,
    )


def take_flight(
    scene: Scene[Top], air: Air, cos_angle: Float[Array, "..."], left: Cells, last: bool
) -> tuple[Air, Bool[Array, " cells"]]:
    """One flight, until a sphere reaches the plane, theta reaches the angle (unless `last`), or the time since the loss
    of contact reaches `left` [s].

    **Returns:** the top at the end of the flight; and whether a sphere has reached the plane.
    """
    body, gravity = scene.body, scene.gravity
    flight = fly(body, gravity, balls(body), air.free, air.ball, air.rising, greatest(left - air.elapsed, 0.0))
    reached = angle_reached(body, air.free, cos_angle, flight.duration, last)
    crosses = jnp.isfinite(reached) & (not last)
    duration = jnp.where(crosses, reached, flight.duration)
    landed = flight.landed & ~crosses & ~flight.lost
    status = jnp.where(crosses, CROSSED, jnp.where(flight.landed, air.status, REACHED_END))
    after = Air(
        free=flown(body, gravity, air.free, duration),
        elapsed=air.elapsed + duration,
        ball=jnp.where(landed, flight.ball, air.ball),
        rising=air.rising,
        falls=air.falls,
        status=jnp.where(flight.lost, FAILED, status),
        crossing_time=jnp.where(jnp.isfinite(reached), air.elapsed + reached, air.crossing_time),
        flights=air.flights + 1,
        open=landed,
        log_rates=air.log_rates + jnp.where(landed, flight.log_rate, 0.0),
        quadratures=None if air.quadratures is None else _carried(body, air.free, air.quadratures, duration),
    )
    return after, landed


def land(scene: Scene[Top], air: Air) -> Air:
    """The impact of the sphere that has reached the plane; a slow rebound closes the contact."""
    body, spheres = scene.body, balls(scene.body)
    own, other = _own_and_other(spheres, air.ball)
    speed = greatest(-gap_rate(body, own, air.free), 0.0)
    restitution = (
        jnp.zeros_like(speed) if scene.restitution is None else jnp.broadcast_to(scene.restitution, speed.shape)
    )
    closing = CLOSING_SPEED * jnp.sqrt(scene.gravity * body.radius)
    rebounds = restitution * speed > closing
    free, fails = resolve_impact(body, scene.friction, own, air.free, jnp.where(rebounds, restitution, 0.0))
    struck = air._replace(free=free, rising=rebounds, open=rebounds, status=jnp.where(fails, FAILED, air.status))
    if other is not None:
        struck = _with_other(scene, air, struck, other, (speed <= closing) & ~rebounds, closing)
    if air.quadratures is not None:
        gained = energy(body, scene.gravity, struck.free) - energy(body, scene.gravity, air.free)
        *others, work = air.quadratures
        struck = struck._replace(quadratures=jnp.stack([*others, work + gained]))
    return struck._replace(open=struck.open & ~fails)


def _with_other(
    scene: Scene[Top], air: Air, struck: Air, other: Ball, slow: Bool[Array, " cells"], closing: Cells
) -> Air:
    """Effect of an impact on the other sphere if that is at the plane: it also strikes, or the top comes to rest on
    both.

    **Arguments:** `air`: the top before the impact; `struck`: the top after the impact; `slow`: mask of the impacts
    that are so slow that they may be the last.
    """
    touches = gap(other, air.free) < TOUCHING * scene.body.radius
    falls = touches & (gap_rate(scene.body, other, struck.free) < -closing)
    stopped, takes = leaning(scene).stopped(air.free)
    rests = touches & slow & (jnp.abs(gap_rate(scene.body, other, air.free)) <= closing) & takes
    free, number, definite = leaning(scene).settled(stopped)
    falls &= ~rests
    return struck._replace(
        free=_where(rests, free, struck.free),
        ball=jnp.where(rests, number, jnp.where(falls, 1 - air.ball, air.ball)),
        falls=falls,
        status=jnp.where(rests & ~definite & (struck.status == RUNNING), UNRESOLVED, struck.status),
        open=struck.open | falls,
    )


def _carried(
    body: Top, free: FreeBody, quadratures: Float[Array, "7 ..."], time: Float[Array, "..."]
) -> Float[Array, "7 ..."]:
    """The passive quadratures after some time [s] in flight."""
    x, y, *across, angle, work = quadratures
    u1, u2, _ = free.velocity
    spin_rate = dot(free.axis, free.momentum) / body.I3
    across = c_in_flight(body, free, tuple(across), time)
    return jnp.stack([x + u1 * time, y + u2 * time, *across, angle + spin_rate * time, work + 0.0 * time])


def _no_flights(start: Air) -> TransitionPath:
    """An empty record for the flights of a single run."""

    def room(leaf: Array) -> Array:
        return jnp.zeros((MOST_BOUNCES, *leaf.shape), leaf.dtype)

    motions = jax.tree.map(room, (start.free, start.quadratures))
    return TransitionPath(jnp.inf + room(start.elapsed), motions, room(start.flights))


def _with_flight(body: Top, record: TransitionPath | None, before: Air, after: Air) -> TransitionPath | None:
    """The record of a single run, if there is one, with the flight between two states added, if there was one."""
    if record is None:
        return None
    place, flew = before.flights[0], after.flights > before.flights
    turned = cone(body, before.free).rate * (after.elapsed - before.elapsed)
    new = TransitionPath(
        jnp.where(flew, after.elapsed, jnp.inf), (before.free, before.quadratures), 1 + (turned / SHOWN).astype(int)
    )
    return jax.tree.map(lambda kept, leaf: kept.at[place].set(leaf), record, new)


def _where(condition: Bool[Array, " cells"], this: Any, that: Any) -> Any:
    """Each leaf of one tree where a condition holds, and of the other tree elsewhere."""
    return jax.tree.map(lambda a, b: jnp.where(condition, a, b), this, that)


def _own_and_other(spheres: tuple[Ball, ...], number: Int[Array, "..."]) -> tuple[Ball, Ball | None]:
    """The numbered sphere, and the other if there is one."""
    if len(spheres) == 1:
        return spheres[0], None
    main, stem = spheres
    return _where(number == 0, main, stem), _where(number == 0, stem, main)
