"""The top as a free body, and the spheres with which it can touch the plane.

In contact the velocity and the height of the centre of mass follow from the axis; for a free body they are part of the
state.
"""

import dataclasses
from typing import Any, NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float, Int

from nonholonomic.geometry import Vector, cross, dot, scale

from ..model.body import Round
from ..model.dynamics import Dynamics
from ..model.scene import Scene
from ..model.state import joined, parts
from ..model.stick_slip import StickSlip
from ..model.top import Top

#: Round-off allowed for a sphere that has just left the arena, as a fraction of R. A sphere that returns gets no
#: allowance, so ten times or a tenth of this value changes no landing.
ROUNDING = 1e-12

#: A sphere counts as returning if it sinks faster than this fraction of sqrt(g R). Before it reaches this speed, it
#: sinks by half the square of this fraction, in units of R.
COMES_BACK = 1e-8


class Ball(NamedTuple):
    """A sphere of the body: the distance of its centre from the centre of mass along e [m], and its radius [m]."""

    offset: Float[Array, "..."]
    radius: Float[Array, "..."]


class FreeBody(NamedTuple):
    """A top that touches nothing: velocity [m/s] and height [m] of its centre of mass, its axis, and its angular
    momentum about the centre of mass.

    Vectors are tuples of components along x, y and the plane's normal z.
    """

    velocity: Vector
    height: Float[Array, "..."]
    axis: Vector
    momentum: Vector


def balls(body: Top) -> tuple[Ball, ...]:
    """The spheres of a top with which it can touch the plane: its own, and that of its stem if it has one."""
    main = Ball(body.offset, body.radius)
    return (main,) if body.stem is None else (main, Ball(body.stem.offset, body.stem.radius))


def standing_on(dynamics: Dynamics | StickSlip, ball: Ball) -> Dynamics:
    """The equations of motion of a top that stands on another of its spheres: the same equations with the parameters of
    this sphere.
    """
    assert isinstance(dynamics, Dynamics)
    coupling = dynamics.mass * ball.offset * dynamics.per_transverse
    return dataclasses.replace(dynamics, meridian=Round(ball.offset, ball.radius, coupling))


def as_free_body(body: Top, ball: Ball, state: Float[Array, "components ..."]) -> FreeBody:
    """A top that stands on a sphere, as a free body: the sphere's centre is at rest along the normal.

    **Arguments:** `state`: (8, ...), as in `tippe/model/state.py`.
    """
    velocity, axis, momentum, _ = parts(state)
    height = ball.radius - ball.offset * axis[2]
    return FreeBody((*velocity, -ball.offset * axis_rate(body, axis, momentum)[2]), height, axis, momentum)


def contact_state(free: FreeBody) -> Float[Array, "components ..."]:
    """The state (8, ...) of a top in contact; the omitted components follow from the contact."""
    return joined(free.velocity[:2], free.axis, free.momentum)


def shown(body: Top, free: FreeBody, quadratures: Float[Array, "7 ..."]) -> Float[Array, "17 ..."]:
    """The output rows of a body that may fly.

    **Arguments:** `quadratures`: position (x, y) of the centre of mass [m], the vector c of `trajectory_problem.py`, spin
    angle [rad], work [J].

    **Returns:** the state as in contact; position (x, y) of the sphere's centre, c, spin angle, work; and the distance
    of the top's own sphere from the plane [m] with its rate [m/s].
    """
    main = balls(body)[0]
    place = [x + main.offset * e for x, e in zip(quadratures[:2], free.axis[:2], strict=True)]
    distance = (gap(main, free), gap_rate(body, main, free))
    rows = (*free.velocity[:2], *free.axis, *free.momentum, *place, *quadratures[2:], *distance)
    return jnp.stack(jnp.broadcast_arrays(*rows))


def axis_rate(body: Top, axis: Vector, momentum: Vector) -> Vector:
    """Rate of the axis e' = L x e / I1 [1/s]."""
    return scale(1.0 / body.I1, cross(momentum, axis))


def gap(ball: Ball, free: FreeBody) -> Float[Array, "..."]:
    """Distance [m] of a sphere from the plane."""
    return free.height + ball.offset * free.axis[2] - ball.radius


def gap_rate(body: Top, ball: Ball, free: FreeBody) -> Float[Array, "..."]:
    """Rate of that distance [m/s]."""
    return free.velocity[2] + ball.offset * axis_rate(body, free.axis, free.momentum)[2]


def still_parting(
    rate: Float[Array, "..."], gravity: Float[Array, "..."], radius: Float[Array, "..."], rounding: Any = 0.0
) -> Float[Array, "..."]:
    """The round-off allowed for the distance of a sphere, as a fraction of R.

    The full allowance holds while the sphere lifts off. There is none when the sphere returns, because it would delay
    the landing.

    **Arguments:** `rate`: rate of the distance [m/s]; `rounding`: an allowance in addition to `ROUNDING`.
    """
    return (ROUNDING + rounding) * jnp.clip(1.0 + rate / (COMES_BACK * jnp.sqrt(gravity * radius)), 0.0, 1.0)


def energy(body: Top, gravity: Float[ArrayLike, "..."], free: FreeBody) -> Float[Array, "..."]:
    """Kinetic energy plus weight times height above the plane [J]."""
    axial = dot(free.momentum, free.axis)
    transverse_square = dot(free.momentum, free.momentum) - axial**2
    rotation = transverse_square / (2.0 * body.I1) + axial**2 / (2.0 * body.I3)
    return body.mass * (0.5 * dot(free.velocity, free.velocity) + gravity * free.height) + rotation


def energy_in(
    scene: Scene[Top], state: Float[Array, "components ..."], number: Int[Array, "..."]
) -> tuple[Float[Array, "..."], Float[Array, "..."]]:
    """The least and the greatest energy [J] that a state at the end of a mode, or of a flight from there, may have.

    In flight, the state does not contain the speed of the sphere along the normal.

    **Arguments:** `number`: index of the mode in `sliding.py`; where both spheres touch, either determines the height.
    """
    main, stem = balls(scene.body)[0], balls(scene.body)[-1]
    contact_ball = Ball(
        *(jnp.where(number == 1, of_stem, of_main) for of_stem, of_main in zip(stem, main, strict=True))
    )
    free = as_free_body(scene.body, contact_ball, state)
    total = energy(scene.body, scene.gravity, free)
    return total - 0.5 * scene.body.mass * free.velocity[2] ** 2, total


def jellett(ball: Ball, free: FreeBody) -> Float[Array, "..."]:
    """Jellett's quantity L.(R n - a e) [kg m^3/s] for one of the spheres: constant while no force acts on the other
    sphere."""
    return ball.radius * free.momentum[2] - ball.offset * dot(free.axis, free.momentum)
