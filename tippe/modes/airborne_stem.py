"""Contact lost and regained on any arena by a top with a stem: sliding on either sphere, flights, and impacts of both
spheres.

States are those of `airborne.py`. A top that slides on its stem has a separate frame, which moves with the stem's
sphere: its origin is the foot below that sphere. On a curved arena, the two spheres have different feet with different
normals, and each sphere strikes the tangent plane at its own foot. If a top comes to rest on both spheres, the run ends
as `UNRESOLVED`, because the equations of leaning are those of the plane (`leaning.py`).
"""

import functools
from typing import Any, NamedTuple

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from nonholonomic.compilation.xla_cpu import compiled_setup, greatest
from nonholonomic.geometry import scale, sum_vectors, vector_of
from nonholonomic.hybrid import Transition
from nonholonomic.integration import AbstractProblem
from nonholonomic.integration.status import CROSSED, FAILED, LEFT_DOMAIN, RUNNING, UNRESOLVED

from ..model.scene import Scene
from ..model.state import COS_THETA
from ..model.top import Top
from .airborne import (
    FLYING,
    LAST_BALL,
    ON_STEM,
    OWN,
    SLIDING,
    STRIKING,
    Below,
    FlightState,
    Fly,
    QuadraturesInFlight,
    flying_body,
    cosine,
    flight_state,
    from_frame,
    gap_margin,
    landing_site,
    lift_off,
    missed,
    standing,
)
from .flying_mode import AbstractFlyingMode
from .free_body import Ball, FreeBody, balls, gap_rate
from .impact import CLOSING_SPEED, TOUCHING, resolve_impact
from .inversion_problem import InversionProblem, beyond_on_stem
from .trajectory_problem import Quadratures

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
        flying = flying._replace(place=vector_of(sum_vectors(flying.place, scale(-ground.gap, ground.axes[2]))))
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
