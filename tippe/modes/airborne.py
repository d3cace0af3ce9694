"""Contact lost and regained on any arena: the modes of sliding and of flight, with and without a stem.

In contact the state is that of `tippe/model/launch.py` with a `CarriedFrame`, 14 components. In flight it is, in the
surface's axes, the position of the centre of mass [m], its velocity [m/s], the axis, the angular momentum about it, the
number of the sphere that touched last, and a zero. A flight ends where the distance of the centre of a sphere from the
arena equals its radius again; then that sphere strikes the tangent plane there (`impact.py`). theta is measured from
the normal below the top's own sphere, whichever sphere touches. A single run whose path is kept has five more
components: the vector c of `problems.py`, which is expressed in the frame during contact and in the surface's
axes in flight; the rotation angle of the top about its axis [rad]; and the work of friction and impacts [J].
"""

import dataclasses
import functools
from typing import Any, NamedTuple

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from nonholonomic.compilation.xla_cpu import compiled_setup, greatest
from nonholonomic.geometry import (
    CarriedFrame,
    Component,
    Vector,
    add,
    dot,
    scale,
    stacked,
    subtract,
    sum_vectors,
    tangents,
)
from nonholonomic.hybrid import Transition
from nonholonomic.integration import AbstractPassive, AbstractProblem
from nonholonomic.integration.problem import CROSSED, FAILED, LEFT_DOMAIN, RUNNING, UNRESOLVED

from ..model.body import Top
from ..model.dynamics import Dynamics
from ..model.friction import SetValuedCoulomb
from ..model.launch import COS_THETA, joined, parts
from ..model.scene import Scene
from .impact import (
    CLOSING_SPEED,
    TOUCHING,
    Ball,
    FreeBody,
    axis_rate,
    balls,
    energy,
    gap_rate,
    resolve_coulomb_impact,
    resolve_impact,
    standing_on,
    still_parting,
)
from .problems import AbstractFlyingMode, InversionProblem, Quadratures, beyond_on_stem, c_rate

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


def flight_state(state: Float[Array, "components ..."]) -> FlightState:
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
    centre = centre_of(flying, ball)
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
    centre = centre_of(flying, ball)
    site, zero = scene.surface.ball_gap(centre, ball.radius, carried_frame(scene).side), jnp.zeros_like(flying.place[0])
    n = tuple(zero if part is None else part + zero for part in site.normal)
    return Below(site.foot, (*tangents(n), n), site.gap)


def centre_of(flying: FlightState, ball: Ball) -> Vector:
    """The centre of a sphere of a flying top."""
    x, y, z = sum_vectors(flying.place, scale(ball.offset, flying.axis))
    return x, y, z


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


def to_frame(vector: Vector, axes: tuple[Vector, Vector, Vector]) -> Vector:
    """Components of a vector in a frame."""
    return (dot(vector, axes[0]), dot(vector, axes[1]), dot(vector, axes[2]))


def from_frame(vector: Vector, axes: tuple[Vector, Vector, Vector]) -> Vector:
    """The vector with given components in a frame."""
    return sum_vectors(*(scale(part, axis) for part, axis in zip(vector, axes, strict=True)))


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
    frame = dataclasses.replace(carried_frame(scene), distance=ball.radius)
    return dataclasses.replace(standing_on(scene.dynamics, ball), frame=frame)


# Before every mode, a single run checks outside of its programs whether the mode is over as it begins.
@compiled_setup
def gap_margin(scene: Scene[Top], flying: FlightState, ball: Ball, rounding: float = 0.0) -> Float[Array, "..."]:
    """Distance of a sphere from the arena as a fraction of R, plus the round-off allowed at lift-off.

    **Arguments:** `rounding`: an additional allowance.
    """
    body, ground = scene.body, landing_site(scene, flying, ball)
    rate = gap_rate(body, ball, flying_body(scene, flying, ground, ball))
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
    states: Float[Array, "components cells"]
    scales: Float[Array, "components cells"]
    acceleration: Vector
    strikes: Bool[Array, ""] | None = None
    # As for `InversionProblem`.
    stem_counts: Any = None

    @property
    def fast(self) -> tuple[bool, bool]:
        # A flight is smoother than the ground below, which may have waves.
        return self.scene.surface.is_wavy, False

    def start(self) -> tuple[Float[Array, "components cells"], Float[Array, "components cells"]]:
        return self.states, self.scales

    def field(self, time, state):
        flying, body = flight_state(state), self.scene.body
        e_dot = axis_rate(body, flying.axis, flying.momentum)
        return stacked((*flying.velocity, *self.acceleration, *e_dot, None, None, None, None, None), state)

    def event_function(self, state):
        value = cosine(self.scene, flight_state(state)) - self.cos_angle
        return beyond_on_stem(value, state[LAST_BALL] == 1.0, self.stem_counts)

    def domain_margin(self, time, state):
        return functools.reduce(jnp.minimum, self.margins(time, state))

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


class ArenaSlide(AbstractFlyingMode):
    """Sliding on the arena."""

    def problem(self, state: Float[Array, "components cells"]) -> AbstractProblem:
        dynamics = self.scene.dynamics
        assert isinstance(dynamics, Dynamics)
        problem = InversionProblem(dynamics, self.cos_angle, state[:OWN], self.scales[:OWN], flies=True)
        return self.extended(problem, Quadratures(self.scene.body.I3), state)

    def shown(self, state: Float[Array, "19 times"]) -> Float[Array, "21 times"]:
        return jnp.concatenate([state, jnp.zeros_like(state[:2])])

    def reset_map(self, state: Float[Array, "components cells"], left: Float[Array, " cells"]) -> Transition:
        """Fly if the contact is lost; end if it jams or the ball does not fit. Counts the flights."""
        ends, zero = self.scene.dynamics.loss(state[:OWN]) > 0, jnp.zeros_like(state[0])
        return Transition(
            mode=jnp.where(ends, SLIDING, FLYING),
            state=jnp.where(ends, state, lift_off(self.scene, state, self.with_quadratures)),
            elapsed=zero,
            status=jnp.where(ends, LEFT_DOMAIN, RUNNING),
            crossing_time=jnp.full_like(zero, jnp.inf),
            counts=(~ends).astype(int)[None],
        )


def lift_off(
    scene: Scene[Top], state: Float[Array, "components ..."], with_quadratures: bool, ball: Ball | None = None
) -> Float[Array, "components ..."]:
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


class Fly(AbstractFlyingMode):
    """Flying over the arena."""

    def problem(self, state: Float[Array, "components cells"]) -> AbstractProblem:
        return self.extended(self.flight(state), QuadraturesInFlight(self.scene.body), state)

    def flight(self, state: Float[Array, "components cells"], strikes: Bool[Array, ""] | None = None) -> FlightProblem:
        """The motion in flight from given states. **Arguments:** `strikes`: as for `FlightProblem`."""
        velocity, momentum = self.scales[0], self.scales[7]
        one = jnp.ones_like(velocity)
        rows = [one * self.scene.body.radius] * 3 + [velocity] * 3 + [one] * 3 + [momentum] * 3 + [one] * 2
        acceleration = scale(-1.0 * self.scene.gravity, self.scene.surface.up)
        return FlightProblem(
            self.scene, self.cos_angle, state[:OWN], jnp.stack(rows), acceleration, strikes, self.stem_counts
        )

    def shown(self, state: Float[Array, "19 times"]) -> Float[Array, "21 times"]:
        flying = flight_state(state)
        ground = below(self.scene, flying)
        free = flying_body(self.scene, flying, ground)
        c_vector = to_frame(tuple(state[OWN + k] for k in range(3)), ground.axes)
        rate = gap_rate(self.scene.body, balls(self.scene.body)[0], free)
        rows = [jnp.stack(c_vector), state[OWN + 3 :], jnp.stack([ground.gap, rate])]
        return jnp.concatenate([in_contact(ground, free), *rows])

    def reset_map(self, state: Float[Array, "components cells"], left: Float[Array, " cells"]) -> Transition:
        """Strike the arena; rebound, or slide if the rebound would be slow. Counts the flights that begin."""
        scene, flying, ball = self.scene, flight_state(state), balls(self.scene.body)[0]
        ground = landing_site(scene, flying, ball)
        free, zero = flying_body(scene, flying, ground), jnp.zeros_like(state[0])
        speed = greatest(-gap_rate(scene.body, ball, free), 0.0)
        bounce = zero if scene.restitution is None else scene.restitution + zero
        rebounds = bounce * speed > CLOSING_SPEED * jnp.sqrt(scene.gravity * scene.body.radius)
        bounce = jnp.where(rebounds, bounce, 0.0)
        if isinstance(scene.friction, SetValuedCoulomb):
            body_after, fails = resolve_coulomb_impact(scene.body, scene.friction, ball, free, bounce)
        else:
            body_after, fails = resolve_impact(scene.body, scene.friction, ball, free, bounce)
        # If the landing was located slightly below the arena, the next flight would end where it begins.
        place_on_arena = sum_vectors(flying.place, scale(-ground.gap, ground.axes[2]))
        return Transition(
            mode=jnp.where(rebounds, FLYING, SLIDING),
            state=self.after_impact(state, place_on_arena, ground, free, body_after, rebounds),
            elapsed=zero,
            status=jnp.where(missed(scene, ground, ball), UNRESOLVED, jnp.where(fails, FAILED, RUNNING)),
            crossing_time=jnp.full_like(zero, jnp.inf),
            counts=rebounds.astype(int)[None],
        )

    def after_impact(
        self,
        state: Float[Array, "components cells"],
        place: Vector,
        ground: Below,
        body_before: FreeBody,
        body_after: FreeBody,
        flies: Bool[Array, " cells"],
    ) -> Float[Array, "components cells"]:
        """The state after an impact, including passive quadratures.

        **Arguments:** `state`: the state in flight before the impact; `place`: the centre of mass; `ground`: the arena
        below the sphere that strikes; `flies`: whether the top flies off, or else is in contact.
        """
        state_after = jnp.where(flies, in_flight(place, ground.axes, body_after), in_contact(ground, body_after))
        if not self.with_quadratures:
            return state_after
        c_vector = tuple(state[OWN + k] for k in range(3))
        c_vector = jnp.where(flies, jnp.stack(c_vector), jnp.stack(to_frame(c_vector, ground.axes)))
        energy_change = energy(self.scene.body, 0.0, body_after) - energy(self.scene.body, 0.0, body_before)
        spin_angle, work = state[OWN + 3 :]
        return jnp.concatenate([state_after, c_vector, jnp.stack([spin_angle, work + energy_change])])


def airborne_modes(
    scene: Scene[Top], problem: InversionProblem, tolerance: float, last: bool, with_quadratures: bool = False
) -> tuple[tuple[AbstractFlyingMode, ...], Int[Array, " cells"]]:
    """The modes of runs, and the index of the mode in which each starts. **Arguments:** as for `sliding.modes`."""
    arguments = (scene, problem.scales, problem.cos_angle, with_quadratures)
    return (ArenaSlide(*arguments), Fly(*arguments)), jnp.zeros(problem.states.shape[1:], int)


# Contact lost and regained on any arena by a top with a stem: sliding on either sphere, flights, and impacts of both
# spheres.
#
# States are those of a top without a stem. A top that slides on its stem has a separate frame, which moves with the stem's
# sphere: its origin is the foot below that sphere. On a curved arena, the two spheres have different feet with different
# normals, and each sphere strikes the tangent plane at its own foot. If a top comes to rest on both spheres, the run ends
# as `UNRESOLVED`, because the equations of leaning are those of the plane (`impact.py`).

#: Largest overlap of the other sphere with the arena while it lifts off, as a fraction of R: its landing may be located
#: slightly late.
OVERLAP = 1e-11


class OneOfTwo(InversionProblem):
    """Sliding on one of two spheres until theta reaches an angle, the contact ends, or the other sphere is at the
    arena.

    `contact_ball` and `other_ball` are the spheres; `on_stem` is true if the stem slides.
    """

    scene: Scene[Top] = eqx.field(kw_only=True)
    contact_ball: Ball = eqx.field(kw_only=True)
    other_ball: Ball = eqx.field(kw_only=True)
    on_stem: Bool[Array, ""] = eqx.field(kw_only=True)

    def event_function(self, state: Float[Array, "components cells"]) -> Float[Array, " cells"]:
        # theta is measured from the normal below the top's own sphere; if this sphere slides, the state contains
        # cos(theta).
        cosine_of_theta = _cosine_beside(self.scene, self.contact_ball, self.other_ball, state)
        value = jnp.where(self.on_stem, cosine_of_theta, state[COS_THETA]) - self.cos_angle
        return beyond_on_stem(value, self.on_stem, self.stem_counts)

    def domain_margin(self, time: Any, state: Float[Array, "components cells"]) -> Float[Array, " cells"]:
        return functools.reduce(jnp.minimum, self.margins(time, state))

    def margins(self, time: Any, state: Float[Array, "components cells"]) -> tuple[Float[Array, " cells"], ...]:
        return (*super().margins(time, state), clearance(self.scene, self.contact_ball, self.other_ball, state))


@compiled_setup
def _cosine_beside(
    scene: Scene[Top], contact_ball: Ball, other_ball: Ball, state: Float[Array, "components ..."]
) -> Float[Array, "..."]:
    """The cosine of the angle between the axis and the normal below the other sphere, while a sphere slides."""
    return cosine(scene, flight_state(lift_off(scene, state, False, contact_ball)), other_ball)


@compiled_setup
def clearance(
    scene: Scene[Top], contact_ball: Ball, other_ball: Ball, state: Float[Array, "components ..."]
) -> Float[Array, "..."]:
    """Distance of the other sphere from the arena as a fraction of R, plus the round-off allowed at lift-off."""
    return gap_margin(scene, flight_state(lift_off(scene, state[:OWN], False, contact_ball)), other_ball, OVERLAP)


class SlideOnOne(AbstractFlyingMode):
    """Sliding on the sphere numbered `number`, in the order of `free_body.balls`.

    The number is an array, so that one program serves both spheres.
    """

    number: Int[Array, ""]

    @property
    def spheres(self) -> tuple[Ball, Ball]:
        """The sphere that slides, and the other sphere."""
        return own_and_other(self.scene, self.number)

    def problem(self, state: Float[Array, "components cells"]) -> AbstractProblem:
        contact_ball, other_ball = self.spheres
        contact = (standing(self.scene, contact_ball), self.cos_angle, state[:OWN], self.scales[:OWN])
        problem = OneOfTwo(
            *contact,
            scene=self.scene,
            contact_ball=contact_ball,
            other_ball=other_ball,
            on_stem=self.number == 1,
            stem_counts=self.stem_counts,
            flies=True,
        )
        return self.extended(problem, Quadratures(self.scene.body.I3), state)

    def shown(self, state: Float[Array, "19 times"]) -> Float[Array, "21 times"]:
        flight = Fly(self.scene, self.scales, self.cos_angle, self.with_quadratures)
        output_on_stem = flight.shown(lift_off(self.scene, state, True, self.spheres[0]))
        return jnp.where(self.number == 1, output_on_stem, jnp.concatenate([state, jnp.zeros_like(state[:2])]))

    def reset_map(self, state: Float[Array, "components cells"], left: Float[Array, " cells"]) -> Transition:
        """Fly if the contact is lost, strike with the other sphere if it is at the arena, and end if the contact jams
        or the sphere does not fit. Counts the flights.
        """
        contact_ball, other_ball = self.spheres
        dynamics, zero = standing(self.scene, contact_ball), jnp.zeros_like(state[0])
        lands = clearance(self.scene, contact_ball, other_ball, state) <= dynamics.contact_margin(state[:OWN])
        ends = (dynamics.loss(state[:OWN]) > 0) & ~lands
        flight = lift_off(self.scene, state, self.with_quadratures, contact_ball).at[LAST_BALL].set(self.number)
        return Transition(
            mode=jnp.where(ends, jnp.where(self.number == 0, SLIDING, ON_STEM), jnp.where(lands, STRIKING, FLYING)),
            state=jnp.where(ends, state, flight),
            elapsed=zero,
            status=jnp.where(ends, LEFT_DOMAIN, RUNNING),
            crossing_time=jnp.full_like(zero, jnp.inf),
            counts=(~ends & ~lands).astype(int)[None],
        )


class FlyBoth(Fly):
    """Flying over the arena, with two spheres that can land; or the instant before an impact, if it `strikes`.

    `strikes` is an array, so that one program serves both. With `last`, a run continues through the event.
    """

    strikes: Bool[Array, ""]
    last: bool = eqx.field(static=True)

    def problem(self, state: Float[Array, "components cells"]) -> AbstractProblem:
        return self.extended(self.flight(state, self.strikes), QuadraturesInFlight(self.scene.body), state)

    def reset_map(self, state: Float[Array, "components cells"], left: Float[Array, " cells"]) -> Transition:
        """The impact of the sphere that touches the arena, after which the top rebounds, or slides on that sphere if
        the rebound would be slow.

        If the impact throws the other sphere into the arena, the other sphere strikes next. Counts the flights that
        begin.
        """
        scene, flying, zero = self.scene, flight_state(state), jnp.zeros_like(state[0])
        main, stem = (gap_margin(scene, flying, ball) for ball in balls(scene.body))
        number = (stem < main).astype(int)
        contact_ball, other_ball = own_and_other(scene, number)
        ground = landing_site(scene, flying, contact_ball)
        misses = missed(scene, ground, contact_ball)
        # If the landing was located slightly below the arena, the next mode would end where it begins.
        flying = flying._replace(place=sum_vectors(flying.place, scale(-ground.gap, ground.axes[2])))
        ground = ground._replace(gap=zero)
        free = flying_body(scene, flying, ground, contact_ball)
        impact = resolve_arena_impact(scene, flying, ground, free, contact_ball, other_ball)
        flies = impact.rebounds | impact.throws
        slides = jnp.where(number == 0, SLIDING, ON_STEM)
        state_after = self.after_impact(state, flying.place, ground, free, impact.free, flies)
        status = jnp.where(misses | impact.rests, UNRESOLVED, jnp.where(impact.fails, FAILED, RUNNING))
        takes_over = jnp.zeros(zero.shape, bool)
        if self.stem_counts is not None:
            takes_over = (state[LAST_BALL] == 0.0) & ((number == 1) | impact.rests) & ~misses & (self.stem_counts > 0.0)
        return Transition(
            mode=jnp.where(impact.throws, STRIKING, jnp.where(impact.rebounds, FLYING, slides)),
            state=jnp.where(flies, state_after.at[LAST_BALL].set(number), state_after),
            elapsed=zero,
            status=status if self.last else jnp.where(takes_over, CROSSED, status),
            crossing_time=jnp.where(takes_over, 0.0, jnp.inf),
            counts=(impact.rebounds & ~impact.throws).astype(int)[None],
        )


class ArenaImpact(NamedTuple):
    """The result of an impact.

    - `free`: the top after it, above the tangent plane.
    - `rebounds`: whether the top flies off; `throws`: whether the other sphere is thrown into the arena; `rests`:
      whether the top is at rest on both spheres; `fails`: whether the computation of the impact failed.
    """

    free: FreeBody
    rebounds: Bool[Array, " cells"]
    throws: Bool[Array, " cells"]
    rests: Bool[Array, " cells"]
    fails: Bool[Array, " cells"]


def resolve_arena_impact(
    scene: Scene[Top], flying: FlightState, ground: Below, free: FreeBody, contact_ball: Ball, other_ball: Ball
) -> ArenaImpact:
    """The impact of one sphere on the tangent plane at its foot; a slow rebound closes the contact.

    **Arguments:** `flying`: the top, whose sphere `contact_ball` is at the arena; `ground`: the arena below this sphere;
    `free`: the top above this ground; `other_ball`: the other sphere.
    """
    body, closing = scene.body, CLOSING_SPEED * jnp.sqrt(scene.gravity * scene.body.radius)
    speed = greatest(-gap_rate(body, contact_ball, free), 0.0)
    bounce = jnp.zeros_like(speed) if scene.restitution is None else scene.restitution
    rebounds = bounce * speed > closing
    state_after, fails = resolve_impact(body, scene.friction, contact_ball, free, jnp.where(rebounds, bounce, 0.0))
    flying_after = flying._replace(
        velocity=from_frame(state_after.velocity, ground.axes), momentum=from_frame(state_after.momentum, ground.axes)
    )
    site = landing_site(scene, flying, other_ball)
    rate_before, rate_after = (
        gap_rate(body, other_ball, flying_body(scene, motion, site, other_ball)) for motion in (flying, flying_after)
    )
    touches = site.gap < TOUCHING * body.radius
    rests = touches & ~rebounds & (speed <= closing) & (jnp.abs(rate_before) <= closing)
    return ArenaImpact(state_after, rebounds, touches & ~rests & (rate_after < -closing), rests, fails)


def own_and_other(scene: Scene[Top], number: Int[Array, "..."]) -> tuple[Ball, Ball]:
    """The sphere of a top with the given number, and the other sphere."""
    main, stem = balls(scene.body)
    contact_ball = Ball(*(jnp.where(number == 0, a, b) for a, b in zip(main, stem, strict=True)))
    return contact_ball, Ball(*(jnp.where(number == 0, b, a) for a, b in zip(main, stem, strict=True)))


def modes_with_stem(
    scene: Scene[Top], problem: InversionProblem, tolerance: float, last: bool, with_quadratures: bool = False
) -> tuple[tuple[AbstractFlyingMode, ...], Int[Array, " cells"]]:
    """The modes of runs, and the index of the mode in which each starts. **Arguments:** as for `sliding.modes`.

    If the stem would be in the arena at launch, the top starts on the stem: place and theta then refer to the stem's
    foot.
    """
    arguments = (scene, problem.scales, problem.cos_angle, with_quadratures)
    event = {"stem_counts": problem.stem_counts}
    slides = [SlideOnOne(*arguments, jnp.asarray(number), **event) for number in (0, 1)]
    flies, strikes = (FlyBoth(*arguments, jnp.asarray(strikes), last, **event) for strikes in (False, True))
    return (slides[0], flies, slides[1], strikes), _first_mode(scene, problem.states)


@compiled_setup
def _first_mode(scene: Scene[Top], states: Float[Array, "components cells"]) -> Int[Array, " cells"]:
    """The index of the mode in which each run starts."""
    main, stem = balls(scene.body)
    flying = flight_state(lift_off(scene, states[:OWN], False, main))
    return jnp.where(landing_site(scene, flying, stem).gap < 0.0, ON_STEM, SLIDING)
