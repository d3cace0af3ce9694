"""Contact lost and found on any arena by a top with a stem: sliding on either sphere, flights, and the blows of both.

States are those of `airborne.py`. A top that slides on its stem has a frame of its own, carried along by the stem's sphere: its
place is the foot below that. On a curved arena the feet of both spheres are apart and so are the normals there: each sphere
strikes the tangent plane at its own foot. A top that comes to rest on both ends there as `UNRESOLVED`, because the equations of
leaning are those of the plane (`leaning.py`).
"""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from nonholonomic.geometry import dot, scale, sum_vectors
from nonholonomic.integration import FAILED, GUARD_LOST, RUNNING, UNRESOLVED, AbstractProblem, Passage

from ..inversion import InversionProblem
from ..scene import Scene
from ..state import COS_THETA
from .airborne import (
    CLOSING_SPEED,
    FLYING,
    ON_STEM,
    OWN,
    SLIDING,
    Aloft,
    Contact,
    Fly,
    aloft,
    below,
    freed,
    in_contact,
    nearing,
    parted,
    seen,
    standing,
    unseen,
)
from .flying_phase import AbstractFlyingPhase
from .free_body import Ball, FreeBody, balls, energy, gap_rate
from .impact import strike

#: Two spheres are at the arena together if neither is farther from it than this fraction of R, as in `sliding.py`.
TOUCHING = 1e-9

#: How far the other sphere may be in the arena while it parts, as a fraction of R: where its landing was located a little late.
OVERLAP = 1e-11

#: Blows at one instant after which a run is given up.
MOST_BLOWS = 1000


class OneOfTwo(AbstractProblem):
    """Sliding on one of two spheres until theta reaches an angle, the contact ends, or the other sphere is at the arena.

    `contact` is the sliding; `own` and `other` are the spheres; `on_stem` says whether the stem is the one that slides.
    """

    scene: Scene
    contact: Contact
    own: Ball
    other: Ball
    on_stem: Bool[Array, ""]

    def start(self) -> tuple[Float[Array, "components cells"], Float[Array, "components cells"]]:
        return self.contact.start()

    def field(self, time: Any, state: Float[Array, "components cells"]) -> Float[Array, "components cells"]:
        return self.contact.field(time, state)

    def crossing(self, state: Float[Array, "components cells"]) -> Float[Array, " cells"]:
        # The angle from the normal below the top's own sphere; it is that of the state if that sphere slides.
        flying = aloft(parted(self.scene, state[:OWN], False, self.own))
        apart = dot(flying.axis, below(self.scene, flying, self.other).axes[2])
        return jnp.where(self.on_stem, apart, state[COS_THETA]) - self.contact.cos_angle

    def guard(self, time: Any, state: Float[Array, "components cells"]) -> Float[Array, " cells"]:
        return jnp.minimum(self.contact.guard(time, state), clearance(self.scene, self.own, self.other, state))


def clearance(scene: Scene, own: Ball, other: Ball, state: Float[Array, "components ..."]) -> Float[Array, "..."]:
    """Distance of the other sphere from the arena as a fraction of R, plus the round-off of a parting."""
    return nearing(scene, aloft(parted(scene, state[:OWN], False, own)), other, OVERLAP)


class SlideOnOne(AbstractFlyingPhase):
    """Sliding on the sphere numbered `number`, in the order of `free_body.balls`.

    The number is an array, so that one program serves both spheres.
    """

    number: Int[Array, ""]

    @property
    def spheres(self) -> tuple[Ball, Ball]:
        """The sphere that slides, and the other one."""
        return own_and_other(self.scene, self.number)

    def problem(self, state: Float[Array, "components cells"]) -> AbstractProblem:
        own, other = self.spheres
        contact = Contact(standing(self.scene, own), self.cos_angle, state, self.scales, self.axial)
        return OneOfTwo(self.scene, contact, own, other, self.number == 1)

    def shown(self, state: Float[Array, "19 times"]) -> Float[Array, "21 times"]:
        flight = Fly(self.scene, self.scales, self.cos_angle, self.rides)
        beside = flight.shown(parted(self.scene, state, True, self.spheres[0]))
        return jnp.where(self.number == 1, beside, jnp.concatenate([state, jnp.zeros_like(state[:2])]))

    def leave(self, state: Float[Array, "components cells"], left: Float[Array, " cells"]) -> Passage:
        """Fly where the contact is lost, let the other sphere strike where it is at the arena, end where the contact jams or the
        sphere does not fit. It counts the flights."""
        own, other = self.spheres
        dynamics, zero = standing(self.scene, own), jnp.zeros_like(state[0])
        lands = clearance(self.scene, own, other, state) <= dynamics.contact_margin(state[:OWN])
        ends = (dynamics.loss(state[:OWN]) > 0) & ~lands
        flies = parted(self.scene, state, self.rides, own)
        landed = after_landing(self.scene, flies, jnp.broadcast_to(1 - self.number, zero.shape), self.rides)
        number = jnp.where(self.number == 0, SLIDING, ON_STEM)
        status = jnp.where(ends, GUARD_LOST, RUNNING)
        phase = jnp.where(lands, landed.phase, jnp.where(ends, number, FLYING))
        return landed._replace(
            phase=phase,
            state=jnp.where(lands, landed.state, jnp.where(ends, state, flies)),
            status=jnp.where(lands, landed.status, status),
            counts=(phase == FLYING).astype(int)[None],
        )


class FlyBoth(Fly):
    """Flying over the arena, with two spheres that can land."""

    def leave(self, state: Float[Array, "components cells"], left: Float[Array, " cells"]) -> Passage:
        """Strike the arena with the sphere that is there. It counts the flights that begin."""
        main, stem = (nearing(self.scene, aloft(state), ball) for ball in balls(self.scene.body))
        return after_landing(self.scene, state, (stem < main).astype(int), self.rides)


class Blow(NamedTuple):
    """A top one of whose spheres is at the arena, between blows.

    - `flying`: the top; `ball`: the number of that sphere.
    - `strikes`: whether it is about to strike; else `rebounds` says whether the top flies off, and `rests` whether it is at rest
      on both spheres.
    - `fails`: where a blow could not be computed.
    """

    flying: Aloft
    ball: Int[Array, " cells"]
    strikes: Bool[Array, " cells"]
    rebounds: Bool[Array, " cells"]
    rests: Bool[Array, " cells"]
    fails: Bool[Array, " cells"]


def after_landing(
    scene: Scene, state: Float[Array, "components cells"], ball: Int[Array, " cells"], rides: bool
) -> Passage:
    """What follows where a sphere is at the arena: its blow, those of both spheres in turn while the blow of one throws the
    other into the arena, and a flight or sliding on the sphere that struck last. It counts the flights that begin.

    **Arguments:** `state`: of flight; `ball`: the number of the sphere.
    """
    body, flying, zero = scene.body, aloft(state), jnp.zeros_like(state[0])
    own, _ = own_and_other(scene, ball)
    ground, never = below(scene, flying, own), jnp.zeros(zero.shape, bool)
    # Where the landing was located a little below the arena, the next phase would end where it begins.
    lifted = flying._replace(place=moved(flying.place, -ground.gap, ground.axes[2]))
    first = Blow(lifted, ball, ~never, never, never, never)

    def under_way(carry: tuple[Blow, Array]) -> Array:
        return jnp.any(carry[0].strikes) & (carry[1] < MOST_BLOWS)

    def once_more(carry: tuple[Blow, Array]) -> tuple[Blow, Array]:
        was, count = carry
        return jax.tree.map(lambda new, old: jnp.where(was.strikes, new, old), struck(scene, was), was), count + 1

    last, _ = jax.lax.while_loop(under_way, once_more, (first, jnp.zeros((), int)))
    own, _ = own_and_other(scene, last.ball)
    ground = below(scene, last.flying, own)
    closed = in_contact(ground, freed(scene, last.flying, ground, own))
    whole = jnp.where(last.rebounds, jnp.stack([*sum(last.flying, ()), zero, zero]), closed)
    if rides:
        across = tuple(state[OWN + k] for k in range(3))
        across = jnp.where(last.rebounds, jnp.stack(across), jnp.stack(seen(across, ground.axes)))
        gained = kinetic(scene, last.flying) - kinetic(scene, flying)
        whole = jnp.concatenate([whole, across, state[OWN + 3 :].at[1].add(gained)])
    status = jnp.where(last.rests | last.strikes, UNRESOLVED, RUNNING)
    return Passage(
        phase=jnp.where(last.rebounds, FLYING, jnp.where(last.ball == 0, SLIDING, ON_STEM)),
        state=whole,
        elapsed=zero,
        status=jnp.where(last.fails, FAILED, status),
        crossing_time=jnp.full_like(zero, jnp.inf),
        counts=last.rebounds.astype(int)[None],
    )


def struck(scene: Scene, was: Blow) -> Blow:
    """A top after the blow of one sphere, on the tangent plane at its foot; slow rebounds are none.

    The other sphere strikes next if it is at the arena too and the blow has thrown it there. The top rests on both if neither
    of them is fast.
    """
    body, flying, (own, other) = scene.body, was.flying, own_and_other(scene, was.ball)
    ground, closing = below(scene, flying, own), CLOSING_SPEED * jnp.sqrt(scene.gravity * scene.body.radius)
    free = freed(scene, flying, ground, own)
    speed = jnp.maximum(-gap_rate(body, own, free), 0.0)
    bounce = jnp.zeros_like(speed) if scene.restitution is None else scene.restitution + 0.0 * speed
    rebounds = bounce * speed > closing
    after, fails = strike(body, scene.friction, own, free, jnp.where(rebounds, bounce, 0.0))
    thrown = flying._replace(
        velocity=unseen(after.velocity, ground.axes), momentum=unseen(after.momentum, ground.axes)
    )
    beside = below(scene, flying, other)
    before, now = (gap_rate(body, other, freed(scene, one, beside, other)) for one in (flying, thrown))
    touches = beside.gap < TOUCHING * body.radius
    rests = touches & ~rebounds & (speed <= closing) & (jnp.abs(before) <= closing)
    strikes = touches & ~rests & ~fails & (now < -closing)
    return Blow(thrown, jnp.where(strikes, 1 - was.ball, was.ball), strikes, rebounds & ~strikes, rests, fails)


def kinetic(scene: Scene, flying: Aloft) -> Float[Array, "..."]:
    """Kinetic energy [J]."""
    return energy(scene.body, 0.0, FreeBody(flying.velocity, flying.place[2], flying.axis, flying.momentum))


def moved(place: Any, by: Float[Array, "..."], along: Any) -> Any:
    """A place moved by a length [m] along a unit vector."""
    return tuple(sum_vectors(place, scale(by, along)))


def own_and_other(scene: Scene, number: Int[Array, "..."]) -> tuple[Ball, Ball]:
    """The sphere of a top with a number, and the other one."""
    main, stem = balls(scene.body)
    own = Ball(*(jnp.where(number == 0, a, b) for a, b in zip(main, stem, strict=True)))
    return own, Ball(*(jnp.where(number == 0, b, a) for a, b in zip(main, stem, strict=True)))


def phases(
    scene: Scene, problem: InversionProblem, tolerance: float, last: bool, rides: bool = False
) -> tuple[tuple[AbstractFlyingPhase, ...], Int[Array, " cells"]]:
    """The phases of runs, and the number of that in which each starts. **Arguments:** as for those of `sliding.py`.

    A launch in which the stem would be in the arena starts on the stem: its place and its theta are those of the stem's foot.
    """
    given, (main, stem) = (scene, problem.scales, problem.cos_angle, rides), balls(scene.body)
    flies = aloft(parted(scene, problem.states[:OWN], False, main))
    first = jnp.where(below(scene, flies, stem).gap < 0.0, ON_STEM, SLIDING)
    return (SlideOnOne(*given, jnp.asarray(0)), FlyBoth(*given), SlideOnOne(*given, jnp.asarray(1))), first
