"""Contact lost and regained on any arena: the modes of sliding and of flight, with and without a stem.

In contact the state is that of `tippe/model/dynamics.py` with a `CarriedFrame`, 14 components. In flight it is, in the
surface's axes, the position of the centre of mass [m], its velocity [m/s], the axis, the angular momentum about it, the
number of the sphere that touched last, and a zero. A flight ends where the distance of the centre of a sphere from the
arena equals its radius again; then that sphere strikes the tangent plane there (`impact.py`). theta is measured from
the normal below the top's own sphere, whichever sphere touches. A single run whose path is kept has five more
components: the vector c of `problems.py`, which is expressed in the frame during contact and in the surface's
axes in flight; the rotation angle of the top about its axis [rad]; and the work of friction and impacts [J].
"""

import dataclasses
from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from nonholonomic.compilation.xla_cpu import compiled_setup, least
from nonholonomic.geometry import CarriedFrame, Component, Vector
from nonholonomic.geometry.vector import add, dot, scale, stacked, subtract, sum_vectors, tangents
from nonholonomic.hybrid import Transition
from nonholonomic.integration import AbstractPassive, AbstractProblem, Components, Lanes, States
from nonholonomic.integration.problem import CROSSED, FAILED, LEFT_DOMAIN, RUNNING, UNRESOLVED

from ..model.body import Top
from ..model.dynamics import COS_THETA, Dynamics, Motion, from_frame, joined, parts, to_frame
from ..model.scene import Scene
from .impact import Ball, FreeBody, axis_rate, balls, own_and_other, standing_on, still_parting, strike
from .problems import STEM_COSINE, AbstractFlyingMode, InversionProblem, Quadratures, Started, c_rate

#: The mode numbers. The last two are those of a top with a stem: the stem slides; or a sphere is about to strike, and
#: the state is that of a flight.
SLIDING, FLYING, ON_STEM, STRIKING = range(4)

#: Number of components of a state, without the passive quadratures that may follow.
OWN = 14

#: The component of a state in flight with the number of the sphere that touched last, in the order of `balls`.
LAST_BALL = 12

#: Largest distance of a sphere from the arena at the end of its flight, as a fraction of its radius, and largest
#: difference of the normal there from that of the contact. Located landings are within 1e-9.
LANDED = 1e-6


class FlightState(NamedTuple):
    """The parts of a flight state, in the surface's axes."""

    place: Vector
    velocity: Vector
    axis: Vector
    momentum: Vector


def flight_state(state: Components) -> FlightState:
    """Split a flight state into its parts."""
    return FlightState(*(tuple(state[k + i] for i in range(3)) for k in range(0, 12, 3)))


class Below(NamedTuple):
    """The arena below a sphere of a flying top: the foot of its centre, the frame (t1, t2, n) there, and the gap [m]."""

    foot: Vector
    axes: tuple[Vector, Vector, Vector]
    gap: Component


def below(scene: Scene[Top], flying: FlightState, ball: Ball | None = None) -> Below:
    """The point of the arena nearest to the centre of a sphere, by default the top's own sphere, for which theta is
    measured."""
    frame, ball = carried_frame(scene), balls(scene.body)[0] if ball is None else ball
    centre = sum_vectors(flying.place, scale(ball.offset, flying.axis))
    foot = tuple(0.0 * centre[0] if part is None else part for part in scene.surface.nearest(centre))
    n = frame.normal(foot)
    difference = dot(tuple(subtract(a, b) for a, b in zip(centre, foot, strict=True)), n)
    return Below(foot, (*tangents(n), n), difference - ball.radius)


# A step evaluates it in several places, which share one trace.
@compiled_setup
def cosine(scene: Scene[Top], flying: FlightState, ball: Ball | None = None) -> Component:
    """cos(theta) of a flying top: the angle between its axis and the normal below a sphere, by default its own."""
    return dot(flying.axis, below(scene, flying, ball).axes[2])


def landing_site(scene: Scene[Top], flying: FlightState, ball: Ball) -> Below:
    """The point where a sphere lands: the nearest point of the arena at the time of landing. Before that time, only the
    sign of the gap is valid.
    """
    centre = sum_vectors(flying.place, scale(ball.offset, flying.axis))
    site, zero = scene.surface.ball_gap(centre, ball.radius, carried_frame(scene).side), jnp.zeros_like(flying.place[0])
    n = tuple(zero if part is None else part + zero for part in site.normal)
    return Below(site.foot, (*tangents(n), n), site.gap)


def missed(scene: Scene[Top], site: Below, ball: Ball) -> Bool[Array, "..."]:
    """Whether a flight has ended away from a contact of the sphere with the arena, so that no motion may continue from
    there.
    """
    n = carried_frame(scene).normal(site.foot)
    normal_change = tuple(subtract(a, b) for a, b in zip(n, site.axes[2], strict=True))
    # Written so that NaN is a miss.
    return ~((jnp.abs(site.gap) < LANDED * ball.radius) & (dot(normal_change, normal_change) < LANDED**2))


def carried_frame(scene: Scene[Top]) -> CarriedFrame:
    """The frame of a scene whose contact may be lost and regained."""
    assert isinstance(scene.frame, CarriedFrame)
    return scene.frame


def flying_body(scene: Scene[Top], flying: FlightState, ground: Below, ball: Ball | None = None) -> FreeBody:
    """A flying top as a free body above the tangent plane below one of its spheres, by default its own."""
    velocity, axis, momentum = (to_frame(part, ground.axes) for part in flying[1:])
    ball = balls(scene.body)[0] if ball is None else ball
    height = ball.radius + ground.gap - ball.offset * axis[2]
    return FreeBody(velocity, height, axis, momentum)


def in_contact(ground: Below, free: FreeBody) -> Float[Array, "14 ..."]:
    """The state of a top in contact, at the foot below it; in flight, the state that the top would have without the
    gap."""
    return joined(free.velocity[:2], free.axis, free.momentum, ground.foot, ground.axes[0])


def in_flight(place: Vector, axes: tuple[Vector, Vector, Vector], free: FreeBody) -> Float[Array, "14 ..."]:
    """The flight state of a body whose velocity, axis and momentum are expressed in a frame."""
    zero = jnp.zeros_like(place[0])
    return joined(place, *(from_frame(part, axes) for part in (free.velocity, free.axis, free.momentum)), (zero, zero))


def standing(scene: Scene[Top], ball: Ball) -> Dynamics:
    """The equations of motion of a top that stands on one of its spheres."""
    if scene.body.stem is None:
        return scene.dynamics
    frame = dataclasses.replace(carried_frame(scene), distance=ball.radius)
    return dataclasses.replace(standing_on(scene.dynamics, ball), frame=frame)


# Before every mode, a single run checks outside of its programs whether the mode is over as it begins.
@compiled_setup
def gap_margin(scene: Scene[Top], flying: FlightState, ball: Ball, rounding: float = 0.0) -> Float[Array, "..."]:
    """Distance of a sphere from the arena as a fraction of R, plus the round-off allowed at lift-off.

    **Arguments:** `rounding`: an additional allowance.
    """
    body, ground = scene.body, landing_site(scene, flying, ball)
    rate = flying_body(scene, flying, ground, ball).gap_rate(body, ball)
    distance = add(*(jnp.abs(part) for part in flying.place))
    rounding = rounding + 4.0 * jnp.finfo(distance.dtype).eps * distance / body.radius
    return ground.gap / body.radius + still_parting(rate, scene.gravity, body.radius, rounding)


class FlightProblem(AbstractProblem):
    """Flying until theta reaches an angle or a sphere is back at the arena.

    - `acceleration`: acceleration [m/s^2].
    - `strikes`: whether a sphere is already at the arena, so that the flight ends at once; `None` if it never is.
    """

    scene: Scene[Top]
    cos_angle: Float[Array, "..."]
    states: States
    scales: States
    acceleration: Vector
    strikes: Bool[Array, ""] | None = None

    @property
    def fast(self) -> tuple[bool, bool]:
        # A flight is smoother than the ground below, which may have waves.
        return self.scene.surface.is_wavy, False

    def start(self) -> tuple[States, States]:
        return self.states, self.scales

    def field(self, time, state):
        flying, body = flight_state(state), self.scene.body
        e_dot = axis_rate(body, flying.axis, flying.momentum)
        return stacked((*flying.velocity, *self.acceleration, *e_dot, None, None, None, None, None), state)

    def event_function(self, state):
        value = cosine(self.scene, flight_state(state)) - self.cos_angle
        # After a bounce of the stem, an event of the stem is past.
        has_bounced = (state[LAST_BALL] == 1.0) & (self.cos_angle == STEM_COSINE)
        return value if self.strikes is None else jnp.where(has_bounced, -1.0, value)

    def domain_margin(self, time, state):
        return least(*self.margins(time, state))

    def margins(self, time, state):
        flying = flight_state(state)
        margins = tuple(gap_margin(self.scene, flying, ball) for ball in balls(self.scene.body))
        return margins if self.strikes is None else tuple(jnp.where(self.strikes, -1.0, part) for part in margins)


class QuadraturesInFlight(AbstractPassive):
    """The passive quadratures of a flight: the vector c, the spin angle, and the work, which does not change."""

    body: Top

    def rates(self, problem, time, state, passive):
        flying = flight_state(state)
        e_dot = axis_rate(self.body, flying.axis, flying.momentum)
        spin = dot(flying.momentum, flying.axis) / self.body.I3
        c = tuple(passive[:3])
        rates = (*c_rate(c, flying.axis, dot(e_dot, c)), spin, None)
        return jnp.concatenate([problem.field(time, state), stacked(rates, passive)])


def lift_off(scene: Scene[Top], state: States, with_quadratures: bool, ball: Ball | None = None) -> States:
    """The flight state of a top that has lost contact, from its state in contact, including passive quadratures.

    **Arguments:** `ball`: the sphere that touched, by default the top's own.
    """
    body, frame, (u, e, L, place) = scene.body, carried_frame(scene), parts(state[:OWN])
    ball = balls(body)[0] if ball is None else ball
    # Step errors move the foot off the arena; a flight that began below the arena would end where it begins.
    place = (*scene.surface.onto(place[:3]), *place[3:])
    axes = frame.own_axes(place)
    velocity = (*u, -ball.offset * axis_rate(body, e, L)[2])
    centre = sum_vectors(place[:3], scale(ball.radius, axes[2]))
    s = sum_vectors(centre, scale(-ball.offset, from_frame(e, axes)))
    flight = in_flight(s, axes, FreeBody(velocity, jnp.zeros_like(state[0]), e, L))
    if not with_quadratures:
        return flight
    c_vector = from_frame(tuple(state[OWN + k] for k in range(3)), axes)
    return jnp.concatenate([flight, jnp.stack(c_vector), state[OWN + 3 :]])


def as_if_flying(scene: Scene[Top], state: States, above: tuple[Component, Component]) -> FlightState:
    """A top as if in flight, also in contact. **Arguments:** `state`: as in contact of its own sphere; `above`: the distance of
    this sphere from the arena [m], and its rate [m/s]."""
    main, (distance, rate) = balls(scene.body)[0], above
    # The flying top is treated as one whose own sphere is larger by the distance, so that this sphere touches.
    flying = flight_state(lift_off(scene, state, False, Ball(main.offset, main.radius + distance)))
    normal_velocity = scale(rate, carried_frame(scene).normal(parts(state).place[:3]))
    return flying._replace(velocity=sum_vectors(flying.velocity, normal_velocity))


def motion_on_stem(scene: Scene[Top], state: States, above: tuple[Component, Component]) -> Motion:
    """The motion on the stem of a top whose stem touches the arena; the first tangent is the projection of that of `state`.

    **Arguments:** as for `as_if_flying`.
    """
    stem = balls(scene.body)[1]
    if scene.flies_in_closed_form:
        return standing_on(scene.dynamics, stem).motion(state)
    flying = as_if_flying(scene, state, above)
    ground = below(scene, flying, stem)
    ground = ground._replace(axes=carried_frame(scene).own_axes((*ground.foot, *parts(state).place[3:])))
    return standing(scene, stem).motion(in_contact(ground, flying_body(scene, flying, ground, stem)))


# The modes. A top that slides on its stem has a separate frame, which moves with the stem's sphere: its origin is the foot
# below that sphere. On a curved arena, the two spheres have different feet with different normals, and each sphere strikes the
# tangent plane at its own foot. If a top comes to rest on both spheres, the run ends as `UNRESOLVED`, because the equations of
# leaning are those of the plane (`impact.py`).

#: Largest overlap of the other sphere with the arena while it lifts off, as a fraction of R: its landing may be located
#: slightly late.
OVERLAP = 1e-11


class OneOfTwo(InversionProblem):
    """Sliding on one of two spheres until theta reaches an angle, the contact ends, or the other sphere is at the
    arena.

    `contact_ball` and `other_ball` are the spheres; `on_stem`: whether the first is that of the stem.
    """

    scene: Scene[Top] = eqx.field(kw_only=True)
    contact_ball: Ball = eqx.field(kw_only=True)
    other_ball: Ball = eqx.field(kw_only=True)
    on_stem: Bool[Array, ""] = eqx.field(kw_only=True)

    def event_function(self, state: States) -> Lanes:
        # theta is measured from the normal below the top's own sphere; if this sphere slides, the state contains
        # cos(theta).
        cosine_of_theta = _cosine_beside(self.scene, self.contact_ball, self.other_ball, state)
        return jnp.where(self.on_stem, cosine_of_theta, state[COS_THETA]) - self.cos_angle

    def margins(self, time: Lanes, state: States) -> tuple[Lanes, ...]:
        return (*super().margins(time, state), clearance(self.scene, self.contact_ball, self.other_ball, state))


@compiled_setup
def _cosine_beside(scene: Scene[Top], contact_ball: Ball, other_ball: Ball, state: States) -> Float[Array, "..."]:
    """The cosine of the angle between the axis and the normal below the other sphere, while a sphere slides."""
    return cosine(scene, flight_state(lift_off(scene, state, False, contact_ball)), other_ball)


@compiled_setup
def clearance(scene: Scene[Top], contact_ball: Ball, other_ball: Ball, state: States) -> Float[Array, "..."]:
    """Distance of the other sphere from the arena as a fraction of R, plus the round-off allowed at lift-off."""
    return gap_margin(scene, flight_state(lift_off(scene, state[:OWN], False, contact_ball)), other_ball, OVERLAP)


class ArenaSlide(AbstractFlyingMode):
    """Sliding on the sphere numbered `number`, in the order of `balls`.

    The number is an array, so that one program serves both spheres.
    """

    number: Int[Array, ""]

    def problem(self, state: States) -> AbstractProblem:
        contact_ball, other_ball = own_and_other(self.scene.body, self.number)
        cos_angle = self.cos_angle_for(self.number == 1)
        contact = (standing(self.scene, contact_ball), cos_angle, state[:OWN], self.scales[:OWN])
        problem = InversionProblem(*contact, flies=True)
        if other_ball is not None:
            spheres = {"contact_ball": contact_ball, "other_ball": other_ball, "on_stem": self.number == 1}
            problem = OneOfTwo(*contact, flies=True, scene=self.scene, **spheres)
        return self.extended(problem, Quadratures(), state)

    def shown(self, state: Float[Array, "19 times"]) -> Float[Array, "21 times"]:
        contact_ball, other_ball = own_and_other(self.scene.body, self.number)
        rows = jnp.concatenate([state, jnp.zeros_like(state[:2])])
        if other_ball is None:
            return rows
        flight = Fly(self.scene, self.scales, self.cos_angle, self.with_quadratures)
        return jnp.where(self.number == 1, flight.shown(lift_off(self.scene, state, True, contact_ball)), rows)

    def reset_map(self, state: States, left: Lanes) -> Transition:
        """Fly if the contact is lost, strike with the other sphere if it is at the arena, and end if the contact jams
        or the sphere does not fit. Counts the flights.
        """
        contact_ball, other_ball = own_and_other(self.scene.body, self.number)
        dynamics, zero = standing(self.scene, contact_ball), jnp.zeros_like(state[0])
        ends, lands = dynamics.loss(state[:OWN]) > 0, jnp.zeros(zero.shape, bool)
        flight = lift_off(self.scene, state, self.with_quadratures, contact_ball)
        if other_ball is not None:
            lands = clearance(self.scene, contact_ball, other_ball, state) <= dynamics.contact_margin(state[:OWN])
            ends &= ~lands
            flight = flight.at[LAST_BALL].set(self.number)
        return Transition(
            mode=jnp.where(ends, jnp.where(self.number == 0, SLIDING, ON_STEM), jnp.where(lands, STRIKING, FLYING)),
            state=jnp.where(ends, state, flight),
            elapsed=zero,
            status=jnp.where(ends, LEFT_DOMAIN, RUNNING),
            crossing_time=jnp.full_like(zero, jnp.inf),
            counts=(~ends & ~lands).astype(int)[None],
        )


class Fly(AbstractFlyingMode):
    """Flying over the arena, until a sphere lands; or, for a top with a stem, the instant before an impact, if it
    `strikes`.

    `strikes` is an array, so that one program serves both; `None` without a stem. With `last`, a run continues through
    the event.
    """

    strikes: Bool[Array, ""] | None = None
    last: bool = eqx.field(static=True, default=False)

    def problem(self, state: States) -> AbstractProblem:
        velocity, momentum = self.scales[0], self.scales[7]
        one = jnp.ones_like(velocity)
        rows = [one * self.scene.body.radius] * 3 + [velocity] * 3 + [one] * 3 + [momentum] * 3 + [one] * 2
        acceleration = scale(-1.0 * self.scene.gravity, self.scene.surface.up)
        start = (state[:OWN], jnp.stack(rows))
        flight = FlightProblem(self.scene, self.cos_angle, *start, acceleration, self.strikes)
        return self.extended(flight, QuadraturesInFlight(self.scene.body), state)

    def shown(self, state: Float[Array, "19 times"]) -> Float[Array, "21 times"]:
        flying = flight_state(state)
        ground = below(self.scene, flying)
        free = flying_body(self.scene, flying, ground)
        c_vector = to_frame(tuple(state[OWN + k] for k in range(3)), ground.axes)
        rate = free.gap_rate(self.scene.body, balls(self.scene.body)[0])
        rows = [jnp.stack(c_vector), state[OWN + 3 :], jnp.stack([ground.gap, rate])]
        return jnp.concatenate([in_contact(ground, free), *rows])

    def reset_map(self, state: States, left: Lanes) -> Transition:
        """The impact of the sphere that touches the arena, after which the top rebounds, or slides on that sphere if
        the rebound would be slow.

        If the impact throws the other sphere into the arena, the other sphere strikes next. Counts the flights that
        begin.
        """
        scene, flying, zero = self.scene, flight_state(state), jnp.zeros_like(state[0])
        number, no = jnp.zeros(zero.shape, int), jnp.zeros(zero.shape, bool)
        if scene.body.stem is not None:
            main, stem = (gap_margin(scene, flying, ball) for ball in balls(scene.body))
            number = (stem < main).astype(int)
        contact_ball, other_ball = own_and_other(scene.body, number)
        ground = landing_site(scene, flying, contact_ball)
        misses = missed(scene, ground, contact_ball)
        # If the landing was located slightly below the arena, the next mode would end where it begins.
        flying = flying._replace(place=sum_vectors(flying.place, scale(-ground.gap, ground.axes[2])))
        ground = ground._replace(gap=zero)
        free = flying_body(scene, flying, ground, contact_ball)
        blow = strike(scene, contact_ball, free)
        throws = rests = takes_over = no
        if other_ball is not None:
            velocity, momentum = (from_frame(part, ground.axes) for part in (blow.free.velocity, blow.free.momentum))
            after, site = flying._replace(velocity=velocity, momentum=momentum), landing_site(scene, flying, other_ball)
            bodies = (flying_body(scene, motion, site, other_ball) for motion in (flying, after))
            throws, rests = blow.at_other(scene, site.gap, *(part.gap_rate(scene.body, other_ball) for part in bodies))
            takes_over = (state[LAST_BALL] == 0.0) & ((number == 1) | rests) & ~misses & self.awaits_stem
        flies = blow.rebounds | throws
        state_after = jnp.where(flies, in_flight(flying.place, ground.axes, blow.free), in_contact(ground, blow.free))
        if self.with_quadratures:
            c_vector, (spin_angle, work) = tuple(state[OWN + k] for k in range(3)), state[OWN + 3 :]
            c_vector = jnp.where(flies, jnp.stack(c_vector), jnp.stack(to_frame(c_vector, ground.axes)))
            work = work + (blow.free.energy(scene.body, 0.0) - free.energy(scene.body, 0.0))
            state_after = jnp.concatenate([state_after, c_vector, jnp.stack([spin_angle, work])])
        if other_ball is not None:
            state_after = jnp.where(flies, state_after.at[LAST_BALL].set(number), state_after)
        status = jnp.where(misses | rests, UNRESOLVED, jnp.where(blow.fails, FAILED, RUNNING))
        slides = jnp.where(number == 0, SLIDING, ON_STEM)
        return Transition(
            mode=jnp.where(throws, STRIKING, jnp.where(blow.rebounds, FLYING, slides)),
            state=state_after,
            elapsed=zero,
            status=status if self.last else jnp.where(takes_over, CROSSED, status),
            crossing_time=jnp.where(takes_over, 0.0, jnp.inf),
            counts=(blow.rebounds & ~throws).astype(int)[None],
        )


def airborne_modes(scene: Scene[Top], problem: InversionProblem, last: bool, with_quadratures: bool = False) -> Started:
    """The modes of runs, and the index of the mode in which each starts. **Arguments:** as for `hopping_modes`.

    If the stem would be in the arena at launch, the top starts on the stem: place and theta then refer to the stem's
    foot.
    """
    arguments = (scene, problem.scales, problem.cos_angle, with_quadratures)
    if scene.body.stem is None:
        return (ArenaSlide(*arguments, jnp.asarray(0)), Fly(*arguments)), jnp.zeros(problem.states.shape[1:], int)
    slides = [ArenaSlide(*arguments, jnp.asarray(number)) for number in (0, 1)]
    flies, strikes = (Fly(*arguments, jnp.asarray(strikes), last) for strikes in (False, True))
    return (slides[0], flies, slides[1], strikes), _first_mode(scene, problem.states)


@compiled_setup
def _first_mode(scene: Scene[Top], states: States) -> Int[Array, " cells"]:
    """The index of the mode in which each run starts."""
    main, stem = balls(scene.body)
    flying = flight_state(lift_off(scene, states[:OWN], False, main))
    return jnp.where(landing_site(scene, flying, stem).gap < 0.0, ON_STEM, SLIDING)
