"""Impacts of the top as a free body, with any friction, and the motion that slides on both spheres at once.

During an impact, the configuration is fixed and the contact load acts as in contact, where f and tau are the scene's
friction force and torque per unit normal force. With the normal impulse p in place of time, d(tangential impulse)/dp =
f and d(impulse of the torque)/dp = tau, and slip and angular velocity change with the impulses (Routh, Dynamics of a
System of Rigid Bodies, 1905, art. 198; Stronge, Impact Mechanics, ch. 4). This is the limit of a stiff contact with the
same law, so it needs no separate law: a stop of the slip, a reversal, and friction that depends on the speed all follow
from it. Newton's restitution e_N determines the end of the impact: the velocity along the normal is then e_N times the
speed of approach. With friction, Newton's rule may require more energy than there was (Stronge, section 3.3); the
impact then ends earlier, when the kinetic energy equals that before the impact.

Every impact ends. Strong friction can pull the sphere into the plane faster than the impulse pushes it out (a
jam), so the velocity along the normal is not monotone. But friction only dissipates energy, so the slip comes to an
end, and a contact that does not slip is pushed out, because the response to an impulse is positive definite. The same
holds with a torque, which also only dissipates energy: velocity and angular velocity of the contact respond to force
and torque by a positive definite matrix.
"""

import dataclasses
from collections.abc import Callable
from typing import NamedTuple, TypeVar

import diffrax
import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Bool, Float, Int

from nonholonomic.compilation.xla_cpu import greatest, least
from nonholonomic.geometry import Component, Vector, add, cross, dot, multiply, scale, subtract, sum_vectors
from nonholonomic.integration import AbstractProblem, Lanes, Outcome, Settings, States, solve_ensemble
from nonholonomic.integration.problem import LEFT_DOMAIN, MOST_STEPS

from ..friction import AbstractFriction, SetValuedCoulomb, Slip, length
from ..model.body import ContactGeometry, Number, Top
from ..model.dynamics import AbstractDynamics, Dynamics, angular_velocity, joined, parts
from ..model.scene import Scene
from ..model.stick_slip import StickSlip

# The top as a free body, and the spheres with which it can touch the plane.
#
# In contact the velocity and the height of the centre of mass follow from the axis; for a free body they are part of the
# state.

#: Two values of the same structure.
Tree = TypeVar("Tree")

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

    @classmethod
    def of(cls, body: Top, ball: Ball, state: States) -> "FreeBody":
        """A top that stands on a sphere, whose centre is at rest along the normal.

        **Arguments:** `state`: (8, ...), as in `tippe/model/dynamics.py`.
        """
        velocity, axis, momentum, _ = parts(state)
        height = ball.radius - ball.offset * axis[2]
        return cls((*velocity, -ball.offset * axis_rate(body, axis, momentum)[2]), height, axis, momentum)

    @property
    def contact_state(self) -> States:
        """The state (8, ...) of a top in contact; the omitted components follow from the contact."""
        return joined(self.velocity[:2], self.axis, self.momentum)

    def gap(self, ball: Ball) -> Float[Array, "..."]:
        """Distance [m] of a sphere from the plane."""
        return self.height + ball.offset * self.axis[2] - ball.radius

    def gap_rate(self, body: Top, ball: Ball) -> Float[Array, "..."]:
        """Rate of that distance [m/s]."""
        return self.velocity[2] + ball.offset * axis_rate(body, self.axis, self.momentum)[2]

    def energy(self, body: Top, gravity: Float[ArrayLike, "..."]) -> Float[Array, "..."]:
        """Kinetic energy plus weight times height above the plane [J]."""
        axial = dot(self.momentum, self.axis)
        transverse_square = dot(self.momentum, self.momentum) - axial**2
        rotation = transverse_square / (2.0 * body.I1) + axial**2 / (2.0 * body.I3)
        return body.mass * (0.5 * dot(self.velocity, self.velocity) + gravity * self.height) + rotation


def balls(body: Top) -> tuple[Ball, ...]:
    """The spheres of a top with which it can touch the plane: its own, and that of its stem if it has one."""
    main = Ball(body.offset, body.radius)
    return (main,) if body.stem is None else (main, Ball(body.stem.offset, body.stem.radius))


def own_and_other(body: Top, number: Int[Array, "..."]) -> tuple[Ball, Ball | None]:
    """The sphere of a top with the given number, in the order of `balls`; and the other sphere if there is one."""
    if body.stem is None:
        return balls(body)[0], None
    main, stem = balls(body)
    return select(number == 0, main, stem), select(number == 0, stem, main)


def select(condition: Bool[Array, "..."], first: Tree, second: Tree) -> Tree:
    """Each leaf of one tree where a condition holds, and of the other tree elsewhere."""
    return jax.tree.map(lambda a, b: jnp.where(condition, a, b), first, second)


def standing_on(dynamics: Dynamics | StickSlip, ball: Ball) -> Dynamics:
    """The equations of motion of a top that stands on another of its spheres: the same equations with the parameters of
    this sphere.
    """
    assert isinstance(dynamics, Dynamics)
    coupling = dynamics.mass * ball.offset * dynamics.per_transverse
    return dataclasses.replace(dynamics, meridian=ContactGeometry(ball.offset, ball.radius, coupling))


def axis_rate(body: Top, axis: Vector, momentum: Vector) -> Vector:
    """Rate of the axis e' = L x e / I1 [1/s]."""
    return scale(1.0 / body.I1, cross(momentum, axis))


def still_parting(rate: Number, gravity: Number, radius: Number, rounding: Lanes | float = 0.0) -> Number:
    """The round-off allowed for the distance of a sphere, as a fraction of R.

    The full allowance holds while the sphere lifts off. There is none when the sphere returns, because it would delay
    the landing.

    **Arguments:** `rate`: rate of the distance [m/s]; `rounding`: an allowance in addition to `ROUNDING`.
    """
    return (ROUNDING + rounding) * jnp.clip(1.0 + rate / (COMES_BACK * jnp.sqrt(gravity * radius)), 0.0, 1.0)


#: Relative tolerance of an impact's integration: impacts are rare, so this cost is small. A tenfold value changes
#: inversion times after hundreds of impacts by 1e-14.
TOLERANCE = 1e-12

#: An impact has failed if it takes this many times the normal impulse that would stop the sphere without friction.
LARGEST = 1e9

#: A rebound slower than this fraction of sqrt(g R) closes the contact. During the time T of the remaining bounces, the
#: sliding top gets the impulse that these bounces would give it, so the error is of the order of the square of this
#: value. On the plane, a tenfold value changes inversion times by a relative 3e-12 if a top bounces, and by 4e-11 if it
#: rocks from sphere to sphere with decreasing amplitude until it leans on both (`LeaningDynamics.stopped`); the value
#: itself causes an error of 3e-13. On other arenas, a tenfold value changes positions and axes after the last bounce by
#: 5e-13, and inversion times after 270 flights in a bowl by a relative 3e-13. Contact begins too early by T.
CLOSING_SPEED = 1e-5

#: Two spheres touch the arena together if neither is farther from it than this fraction of R. On the plane, ten times
#: or a tenth of this value does not change a time at all.
TOUCHING = 1e-9


class Approach(NamedTuple):
    """A sphere about to strike: vector from the centre of mass to the contact point [m], and velocity of that point
    [m/s].

    `response` is the symmetric matrix W with (change of that velocity) = W (impulse) [1/kg], as three columns. `axis`
    and `angular_velocity` are the axis and the angular velocity [rad/s] of the body.
    """

    arm: Vector
    velocity: Vector
    response: tuple[Vector, Vector, Vector]
    axis: Vector
    angular_velocity: Vector

    def change(self, impulse: Vector) -> Vector:
        """Change of the velocity of the contact point [m/s] by an impulse of the force [N s]."""
        return tuple(dot(column, impulse) for column in self.response)


class ContactImpulse(NamedTuple):
    """Impulses at the contact: of the force [N s], and of the torque [N m s], which vanishes under a law without torque."""

    force: Vector
    torque: Vector = (None, None, None)


class Impact(AbstractProblem):
    """Impacts, with the normal impulse as the time; the state is the tangential impulse and, if the law has a torque,
    the impulse of the torque.

    The unit of impulses is the impulse that would stop the sphere without friction; impulses of a torque are in this
    unit times the sphere's radius. `gained` is the velocity along the normal [m/s] at which the impact ends.
    """

    body: Top
    friction: AbstractFriction
    approach: Approach
    radius: Float[Array, "..."]
    gained: Lanes

    @property
    def speed(self) -> Lanes:
        """Speed along the normal before the impact [m/s], positive because it is the unit of the impulses."""
        return greatest(jnp.abs(self.approach.velocity[2]), 1e-12)

    def impulse(self, normal: Lanes, state: Float[Array, "rows cells"]) -> ContactImpulse:
        """The impulses at a stage of the impact."""
        unit = self.speed / self.approach.response[2][2]
        force = (state[0] * unit, state[1] * unit, normal * unit)
        return ContactImpulse(force, tuple(row * unit * self.radius for row in state[2:]) or (None, None, None))

    def changes(self, impulse: ContactImpulse) -> tuple[Vector, Vector]:
        """Changes of the velocity of the contact point [m/s] and of the angular velocity [rad/s] by an impulse."""
        contact, (force, torque) = self.approach, impulse
        angular_change = angular_velocity(self.body, contact.axis, torque)
        velocity = sum_vectors(contact.change(force), cross(angular_change, contact.arm))
        whole_torque = sum_vectors(cross(contact.arm, force), torque)
        return velocity, angular_velocity(self.body, contact.axis, whole_torque)

    def start(self) -> tuple[Float[Array, "rows cells"], Float[Array, "rows cells"]]:
        x, y, _ = self.approach.velocity
        load = self.friction.per_normal_force(Slip(x, y, self.approach.angular_velocity))
        has_torque = load.torque != (None, None, None)
        zeros = jnp.zeros((5 if has_torque else 2, *self.gained.shape))
        return zeros, jnp.ones_like(zeros)

    def field(self, time: Lanes, state: Float[Array, "rows cells"]) -> Float[Array, "rows cells"]:
        contact, (velocity, w) = self.approach, self.changes(self.impulse(time, state))
        x, y, _ = sum_vectors(contact.velocity, velocity)
        load = self.friction.per_normal_force(Slip(x, y, sum_vectors(contact.angular_velocity, w)))
        torque = scale(1.0 / self.radius, load.torque) if len(state) > 2 else ()
        rows = [jnp.zeros_like(time) if component is None else component for component in (*load.force, *torque)]
        return jnp.stack(jnp.broadcast_arrays(*rows, time)[:-1])

    def domain_margin(self, time: Lanes, state: Float[Array, "rows cells"]) -> Lanes:
        impulse, response = self.impulse(time, state), self.approach.response
        change, angular_change = self.changes(impulse)
        missing = (self.gained - change[2]) / self.speed
        # In compression, the sphere still approaches; in restitution, the margin is the dissipated energy that need not
        # be returned.
        approaches = -(self.approach.velocity[2] + change[2]) / self.speed
        gain = add(
            dot(impulse.force, self.approach.velocity),
            multiply(0.5, dot(impulse.force, change)),
            dot(impulse.torque, self.approach.angular_velocity),
            multiply(0.5, dot(impulse.torque, angular_change)),
        )
        shortfall = -gain * response[2][2] / self.speed**2
        return least(missing, jnp.where(approaches > shortfall, approaches, shortfall))


def newton_step(margin: Callable[..., Lanes], point: tuple[Array, ...], rates: tuple[Array, ...]) -> Lanes:
    """One step of Newton's method to the zero of a margin along some rates, from its located zero.

    The search leaves an error of 1e-10, and this step leaves its square, which is round-off.
    """
    left, slope = jax.jvp(margin, point, rates)
    step = -left / jnp.where(slope == 0.0, 1.0, slope)
    return jnp.where(jnp.abs(step) < 1e-6, step, 0.0)


def approach(body: Top, ball: Ball, free: FreeBody) -> Approach:
    """Velocity, lever arm and response of a sphere of a free body at the plane.

    W = 1/m - [r]x J^-1 [r]x, r = a e - R n (`tippe.md`, section 3).
    """
    arm = (ball.offset * free.axis[0], ball.offset * free.axis[1], ball.offset * free.axis[2] - ball.radius)
    w = angular_velocity(body, free.axis, free.momentum)
    velocity = sum_vectors(free.velocity, cross(w, arm))
    zero, unit = jnp.zeros_like(arm[0]), jnp.ones_like(arm[0])

    def impulse_gain(impulse: Vector) -> Vector:
        angular_change = angular_velocity(body, free.axis, cross(arm, impulse))
        return sum_vectors(scale(1.0 / body.mass, impulse), cross(angular_change, arm))

    response = (impulse_gain((unit, zero, zero)), impulse_gain((zero, unit, zero)), impulse_gain((zero, zero, unit)))
    return Approach(arm, velocity, response, free.axis, w)


def resolve_impact(
    body: Top, friction: AbstractFriction, ball: Ball, free: FreeBody, restitution: Lanes
) -> tuple[FreeBody, Bool[Array, " cells"]]:
    """The body after one of its spheres has struck the plane; unchanged if the sphere does not approach the plane.

    An impulse at the contact point leaves Jellett's quantity of that sphere unchanged; an impulse of a torque changes
    it. Under `SetValuedCoulomb`, the slip of a contact that sticks is zero up to round-off.

    **Arguments:**

    - `friction`: the scene's law.
    - `free`: the body before the impact.
    - `restitution`: Newton's coefficient e_N [1]; the rebound is slower if it would otherwise create energy.

    **Returns:** the body after the impact; and whether the impact could not be computed (`MOST_STEPS`, `LARGEST`).
    """
    contact = approach(body, ball, free)
    gained = (1.0 + restitution) * greatest(-contact.velocity[2], 0.0)
    impact = Impact(body, friction, contact, ball.radius, gained)
    if isinstance(friction, SetValuedCoulomb):
        impulse, status = _coulomb_impulse(impact, friction.mu)
    else:
        outcome = _solved(impact, absolute=1.0)
        time, state, status = outcome.end_time, outcome.state, outcome.status
        rates = impact.field(time, state)
        step = newton_step(impact.domain_margin, (time, state), (jnp.ones_like(time), rates))
        impulse = impact.impulse(time + step, state + step * rates)
    velocity = sum_vectors(free.velocity, scale(1.0 / body.mass, impulse.force))
    momentum = sum_vectors(free.momentum, cross(contact.arm, impulse.force), impulse.torque)
    return FreeBody(velocity, free.height, free.axis, momentum), status != LEFT_DOMAIN


def _solved(problem: "Impact | Skid", absolute: float) -> Outcome:
    """The end of an impact. **Arguments:** `absolute`: as for `Settings`."""
    settings = Settings(TOLERANCE, diffrax.Dopri5(), absolute=absolute, max_steps=MOST_STEPS)
    cells = jnp.asarray(problem.start()[0].shape[1])
    return solve_ensemble(problem, jnp.asarray(LARGEST), cells, settings, traced=True)[0]


class Strike(NamedTuple):
    """The effect of an impact on the sphere that strikes.

    - `free`: the body after the impact; `rebounds`: whether the sphere flies off, or else stays in contact.
    - `is_slow`: whether the impact is so slow that it may be the last; `fails`: whether it could not be computed.
    """

    free: FreeBody
    rebounds: Bool[Array, " cells"]
    is_slow: Bool[Array, " cells"]
    fails: Bool[Array, " cells"]

    def at_other(
        self, scene: Scene[Top], gap: Lanes, before: Lanes, after: Lanes, may_rest: Bool[Array, " cells"] | bool = True
    ) -> tuple[Bool[Array, " cells"], Bool[Array, " cells"]]:
        """Effect of the impact on the other sphere: whether it is thrown into the arena; and whether the top comes to rest on
        both. **Arguments:** `gap`: its distance from the arena [m], with its rates before and after the impact [m/s]."""
        touches, closing = gap < TOUCHING * scene.body.radius, closing_speed(scene)
        rests = touches & self.is_slow & (jnp.abs(before) <= closing) & may_rest
        return touches & ~rests & (after < -closing), rests


def closing_speed(scene: Scene[Top]) -> Float[Array, "..."]:
    """The speed [m/s] of a rebound below which the contact closes."""
    return CLOSING_SPEED * jnp.sqrt(scene.gravity * scene.body.radius)


def strike(scene: Scene[Top], ball: Ball, free: FreeBody) -> Strike:
    """The impact of a sphere of a free body on the plane; a slow rebound closes the contact."""
    speed = greatest(-free.gap_rate(scene.body, ball), 0.0)
    bounce = jnp.zeros_like(speed) + (0.0 if scene.restitution is None else scene.restitution)
    rebounds = bounce * speed > closing_speed(scene)
    free, fails = resolve_impact(scene.body, scene.friction, ball, free, jnp.where(rebounds, bounce, 0.0))
    return Strike(free, rebounds, ~rebounds & (speed <= closing_speed(scene)), fails)


# Impact under set-valued Coulomb friction: the slip may stop, and the contact then sticks or slips again.
#
# As above, the normal impulse p replaces time, and the contact's velocity changes by the constant matrix W. While
# the contact slips, the tangential impulse grows by -mu v / |v|, whose direction has no limit where a slip stops. With
# the slip distance s as the independent variable, ds = dp / |v|, nothing is singular: v' = |v| W_n - mu W_t v, and a slip
# that stops decays exponentially in s.
#
# After a stop, the tangential impulse per unit of p is the f with |f| <= mu that minimises f.W_tt f / 2 + f.W_tn: v then
# grows along -f if |f| = mu, and stays zero if |f| < mu. Because W_tt is positive definite, there is one such f, (W_tt +
# k) f = -W_tn with k >= 0: the solution after the stop is unique and straight, and lasts to the end of the impact. The
# normal velocity grows during this motion.

#: A slip has stopped when its speed is this fraction of the sphere's speed of arrival. The error of the impulse is at
#: most this fraction. Integration errors, a tenth of the tolerance, must be smaller.
STOPS = 1e-11

#: Newton iterations for the force after a stop. They converge from one side, in about six iterations.
ITERATIONS = 30


class Skid(AbstractProblem):
    """The slipping part of impacts: tangential and normal impulse as the state, the slip distance as the time.

    - `impact`: the impacts, which define the units of the impulses; `pace`: the speed of arrival of the sphere [m/s].
    """

    impact: Impact
    mu: Float[Array, "..."]
    pace: Lanes

    def velocity(self, state: Float[Array, "3 cells"]) -> Vector:
        """Velocity of the contact point [m/s]."""
        contact, impulse = self.impact.approach, self.impact.impulse(state[2], state[:2])
        return sum_vectors(contact.velocity, contact.change(impulse.force))

    def start(self) -> tuple[Float[Array, "3 cells"], Float[Array, "3 cells"]]:
        zeros = jnp.zeros((3, *self.pace.shape))
        return zeros, jnp.ones_like(zeros)

    def field(self, time: Lanes, state: Float[Array, "3 cells"]) -> Float[Array, "3 cells"]:
        v1, v2, _ = self.velocity(state)
        return jnp.stack([-self.mu * v1, -self.mu * v2, length(v1, v2)]) / self.pace

    def domain_margin(self, time: Lanes, state: Float[Array, "3 cells"]) -> Lanes:
        return least(self.impact.domain_margin(state[2], state[:2]), self.slip_left(state))

    def slip_left(self, state: Float[Array, "3 cells"]) -> Lanes:
        """Slip speed above the threshold at which a slip has stopped, as a fraction of the speed of arrival."""
        return length(*self.velocity(state)[:2]) / self.pace - STOPS


def _coulomb_impulse(impact: Impact, mu: Float[Array, "..."]) -> tuple[ContactImpulse, Int[Array, " cells"]]:
    """The impulse of an impact under set-valued friction, the limit for a slip speed of 0, and the status of its
    slipping part."""
    pace = greatest(length(*impact.approach.velocity[:2]), impact.speed)
    skid = Skid(impact, mu, pace)
    outcome = _solved(skid, absolute=0.1)
    stops = skid.slip_left(outcome.state) <= STOPS
    rates = skid.field(outcome.end_time, outcome.state)
    # An impact that ends while it slips is corrected.
    step = newton_step(lambda point: impact.domain_margin(point[2], point[:2]), (outcome.state,), (rates,))
    state = jnp.where(stops, outcome.state, outcome.state + step * rates)
    impulse = impact.impulse(state[2], state[:2])
    remaining_impulse = _remaining_impulse(impact, mu, impulse.force)
    force = tuple(jnp.where(stops, a + b, a) for a, b in zip(impulse.force, remaining_impulse, strict=True))
    return ContactImpulse(force), outcome.status


def _remaining_impulse(impact: Impact, mu: Float[Array, "..."], impulse: Vector) -> Vector:
    """The impulse [N s] from the stop of the slip to the end of the impact."""
    contact = impact.approach
    W = contact.response
    a, b, c = W[0][0], W[0][1], W[1][1]
    f1, f2 = sticking_force((a, b, c), (W[0][2], W[1][2]), mu)

    # Where the contact sticks, the impulse first removes the remaining slip.
    v1, v2, _ = sum_vectors(contact.velocity, contact.change(impulse))
    sticks, determinant = f1 * f1 + f2 * f2 < mu * mu, a * c - b * b
    stopping_impulse = (
        jnp.where(sticks, (b * v2 - c * v1) / determinant, 0.0),
        jnp.where(sticks, (b * v1 - a * v2) / determinant, 0.0),
    )
    impulse = sum_vectors(impulse, (*stopping_impulse, None))
    velocity, impulse_direction = sum_vectors(contact.velocity, contact.change(impulse)), (f1, f2, jnp.ones_like(f1))
    # The impact ends as in `Impact.domain_margin`: the normal velocity is linear in the impulse, and the energy is
    # quadratic.
    gains = contact.change(impulse_direction)
    normal_impulse = greatest((contact.velocity[2] + impact.gained - velocity[2]) / gains[2], 0.0)
    compressed = greatest(-velocity[2], 0.0) / gains[2]
    power, stiff = dot(impulse_direction, velocity), dot(impulse_direction, gains)
    gain = least(dot(impulse, contact.velocity) + 0.5 * dot(impulse, contact.change(impulse)), 0.0)
    restored = (-power + jnp.sqrt(power * power - 2.0 * gain * stiff)) / stiff
    return sum_vectors(
        scale(least(normal_impulse, greatest(compressed, restored)), impulse_direction), (*stopping_impulse, None)
    )


def sticking_force(
    matrix: tuple[Lanes, Lanes, Lanes], coupling: tuple[Lanes, Lanes], mu: Float[Array, "..."]
) -> tuple[Lanes, Lanes]:
    """The f with |f| <= mu that minimises f.A f / 2 + f.b, for A = (A11, A12, A22) positive definite.

    (A + k) f = -b, and 1 / |f| grows with k and is concave, so Newton's method finds |f| = mu from k = 0 on.
    """
    a, b, c = matrix

    def solved(k: Lanes, right: tuple[Lanes, Lanes]) -> tuple[Lanes, Lanes]:
        determinant = (a + k) * (c + k) - b * b
        x, y = right
        return ((c + k) * x - b * y) / determinant, ((a + k) * y - b * x) / determinant

    def force(k: Lanes) -> tuple[Lanes, Lanes]:
        return solved(k, (-coupling[0], -coupling[1]))

    free = length(*force(jnp.zeros_like(a)))
    is_beyond = (free > mu) & (mu > 0.0)
    normal_impulse = jnp.where(is_beyond, mu, 1.0)

    def newton(_: int, k: Lanes) -> Lanes:
        f1, f2 = force(k)
        size = jnp.where(is_beyond, length(f1, f2), 1.0)
        g1, g2 = solved(k, (f1, f2))
        slope = jnp.where(is_beyond, (f1 * g1 + f2 * g2) / size**3, 1.0)
        return k + jnp.where(is_beyond, (1.0 / normal_impulse - 1.0 / size) / slope, 0.0)

    f1, f2 = force(jax.lax.fori_loop(0, ITERATIONS, newton, jnp.zeros_like(a)))
    return jnp.where(mu > 0.0, f1, 0.0), jnp.where(mu > 0.0, f2, 0.0)


# Leaning: the top slides on its sphere and on its stem at once.
#
# Both spheres touch the plane at one angle theta only, so the axis turns about the normal at some rate W, e' = W n x e,
# and the centre of mass stays at its height h = R_j - a_j c, c = cos theta. With L = A e + I1 W n and the momenta p = L.n
# and b = L.e,
#
#     A = (b - c p) / (1 - c^2),   I1 W = p - c A,   w = s e + W n,   s = A / I1 + (1 / I3 - 1 / I1) b,
#
# and the slip of sphere j is v_j = u + (s R_j + W a_j) n x e. With the friction f_j per unit normal force, each from its
# own slip, the vertical force on the centre of mass and the torque that raises the axis vanish if
#
#     N_0 + N_1 = m g,   N_0 m_0 + N_1 m_1 = -A W (1 - c^2),   m_j = a_j (1 - c^2) + h f_j.e - tau_j.(n x e),
#
# with tau_j the torque per unit normal force of a law that has one. Then m u' = N_0 f_0 + N_1 f_1, and with
# t_j = f_j.(n x e) the momenta change by p' = sum N_j (a_j t_j + tau_j.n) and b' = sum N_j (R_j t_j + tau_j.e).
#
# The slips differ only across the direction of leaning. So m_1 - m_0 is (a_1 - a_0) (1 - c^2) without friction and with
# viscous friction; Coulomb's law can make it vanish if mu h is more than (a_1 - a_0) sin theta. One of the two normal
# forces vanishes before that.

#: The number of this contact mode, next to those of the spheres, 0 and 1.
BOTH = 2

#: A contact ends when its normal force is below minus this fraction of the weight. A top that begins to roll on its
#: sphere presses its stem less and less, but never lifts it; without this margin, errors of a nearly zero force would
#: determine the step lengths. Ending the contact late changes velocities by the square of this value: ten times or a
#: tenth of it changes an inversion time by 4e-16.
HOLDS = 1e-8

#: Where m_1 - m_0 is less than this fraction of its value without friction, rigid-body mechanics does not determine the
#: motion. Used for a status only.
INDEFINITE = 1e-6


class LeaningMotion(NamedTuple):
    """The equations of motion evaluated at one state: the rate of the state of `tippe/model/dynamics.py`, and both
    normal forces [N].

    `friction_power` [W] is that of both contacts, `None` without friction; `spin`: as in `Motion`; `definiteness` is m_1 -
    m_0 as a fraction of its value without friction.
    """

    rate: tuple[Component, ...]
    normal_forces: tuple[Float[Array, "..."], Float[Array, "..."]]
    friction_power: Component
    spin: Float[Array, "..."]
    definiteness: Float[Array, "..."]


class LeaningDynamics(AbstractDynamics):
    """The equations of motion of a top with a stem while both of its spheres touch the plane.

    The state has the layout of `tippe/model/dynamics.py`. Its cos theta is constant to the bit; the part of L along
    n x e, which would change theta and is round-off, is integrated but not used.
    """

    body: Top
    friction: AbstractFriction
    gravity: Float[Array, "..."]

    @classmethod
    def of(cls, scene: Scene[Top]) -> "LeaningDynamics":
        """The equations for the top of a scene."""
        return cls(scene.body, scene.friction, scene.gravity)

    def motion(self, state: States) -> LeaningMotion:
        """Evaluate the equations of motion.

        **Arguments:**

        - `state`: (8, ...), with the axis at the angle at which both spheres touch.

        **Returns:** a `LeaningMotion`; `rate` is (m/s^2, 1/s, N m).
        """
        spheres, m, I1, I3 = balls(self.body), self.body.mass, self.body.I1, self.body.I3
        u, e, L, _ = parts(state)
        c, p, b = e[2], L[2], dot(e, L)
        perpendicular = (-e[1], e[0])
        sine2 = dot(perpendicular, perpendicular)
        axial_rate = (b - c * p) / sine2
        precession = (p - c * axial_rate) / I1
        rolling = axial_rate / I1 + (1.0 / I3 - 1.0 / I1) * b

        w = (rolling * e[0], rolling * e[1], rolling * c + precession)
        velocities = [sum_vectors(u, scale(rolling * R + precession * a, perpendicular)) for a, R in spheres]
        slips = [Slip(x, y, w) for x, y in velocities]
        loads = [self.friction.per_normal_force(slip) for slip in slips]
        height = spheres[0].radius - spheres[0].offset * c
        m_0, m_1 = (
            subtract(
                add(ball.offset * sine2, multiply(height, dot(load.force, e[:2]))), dot(perpendicular, load.torque[:2])
            )
            for ball, load in zip(spheres, loads, strict=True)
        )
        N_1 = -(axial_rate * precession * sine2 + self.weight * m_0) / (m_1 - m_0)
        normal = (self.weight - N_1, N_1)

        u_dot = scale(1.0 / m, sum_vectors(*(scale(N, load.force) for N, load in zip(normal, loads, strict=True))))
        pulls = [dot(perpendicular, load.force) for load in loads]
        triples = list(zip(spheres, pulls, loads, strict=True))
        p_dot = dot(normal, tuple(add(multiply(ball.offset, t), load.torque[2]) for ball, t, load in triples))
        b_dot = dot(normal, tuple(add(multiply(ball.radius, t), dot(load.torque, e)) for ball, t, load in triples))
        # L turns with the axis, including its part across; so b changes by its own rate alone.
        growth = multiply(1.0 / sine2, subtract(b_dot, multiply(c, p_dot)))
        L_dot = sum_vectors(scale(growth, e[:2]), (-precession * L[1], precession * L[0]))
        rate = (*u_dot, *scale(precession, perpendicular), None, *L_dot, p_dot)
        power = dot(normal, tuple(load.power(slip) for load, slip in zip(loads, slips, strict=True)))
        stiff = (m_1 - m_0) / ((spheres[1].offset - spheres[0].offset) * sine2)
        return LeaningMotion(rate, normal, power, b / I3, stiff)

    def margins(self, state: States) -> tuple[Float[Array, "..."], ...]:
        """Both normal forces as fractions of the weight, plus `HOLDS`."""
        return tuple(force / self.weight + HOLDS for force in self.motion(state).normal_forces)

    def heavier(self, state: States) -> Int[Array, "..."]:
        """The number of the sphere with the greater normal force: contact remains there when the other force vanishes."""
        N_0, N_1 = self.motion(state).normal_forces
        return (N_1 > N_0).astype(int)

    def stopped(self, free: FreeBody) -> tuple[FreeBody, Bool[Array, "..."]]:
        """The end of rocking: the total effect of all remaining impacts on a top whose spheres are both at the plane.

        The top rocks from sphere to sphere with decreasing amplitude, and infinitely many impacts take a finite time T.
        In addition to the impulses of leaning for T, sphere j gets the impulse P_j (f_j, 1), and P_j tau_j if the law
        has a torque. Together, these stop both speeds along the normal, g + G P = 0. During T, both slips change only
        by the order of the speeds g, so the error is of the order of their square.

        **Returns:** the body after these impulses, before `at_rest`; and whether their friction dissipates energy. One
        P_j is negative: during T, the load of this sphere is reduced. If the friction of this sphere adds energy now,
        it dissipates energy after the impact of the other sphere (det G > 0).
        """
        spheres, zero = balls(self.body), jnp.zeros_like(free.height)
        w = angular_velocity(self.body, free.axis, free.momentum)
        forces, torques, gains = [], [], []
        for ball in spheres:
            contact = approach(self.body, ball, free)
            x, y, _ = contact.velocity
            slip = Slip(x, y, w)
            load = self.friction.per_normal_force(slip)
            forces.append(tuple(zero if part is None else part for part in (*load.force, 1.0 + zero)))
            torques.append(sum_vectors(cross(contact.arm, forces[-1]), load.torque))
            gains.append(zero if (power := load.power(slip)) is None else power)
        speeds = [free.gap_rate(self.body, ball) for ball in spheres]
        rates = [axis_rate(self.body, free.axis, turn)[2] for turn in torques]
        (G_00, G_01), (G_10, G_11) = ([1.0 / self.body.mass + ball.offset * rate for rate in rates] for ball in spheres)
        determinant = G_00 * G_11 - G_01 * G_10
        per = 1.0 / jnp.where(determinant == 0.0, 1.0, determinant)
        impulses = (per * (G_01 * speeds[1] - G_11 * speeds[0]), per * (G_10 * speeds[0] - G_00 * speeds[1]))
        total = sum_vectors(*(scale(P, force) for P, force in zip(impulses, forces, strict=True)))
        velocity = sum_vectors(free.velocity, scale(1.0 / self.body.mass, total))
        momentum = sum_vectors(free.momentum, *(scale(P, turn) for P, turn in zip(impulses, torques, strict=True)))
        return FreeBody(velocity, free.height, free.axis, momentum), dot(impulses, tuple(gains)) <= 0.0

    def settled(self, free: FreeBody) -> tuple[FreeBody, Int[Array, "..."], Bool[Array, "..."]]:
        """The contacts of a top whose spheres are both at rest at the plane. The normal forces must not be negative,
        and the force on a sphere that leaves the plane is zero. If m_1 - m_0 is positive, there is a single solution:
        the top stands on both spheres if this takes two positive forces, otherwise on the sphere with the positive
        force.

        **Returns:** the body, exactly at rest along the normal (`at_rest`); `BOTH`, or the number of the sphere on
        which it stands; and whether this is the only solution.
        """
        free = self.at_rest(free)
        state = free.contact_state
        number = jnp.where(self.contact_margin(state) > 0.0, BOTH, self.heavier(state))
        return free, number, self.motion(state).definiteness > INDEFINITE

    def at_rest(self, free: FreeBody) -> FreeBody:
        """A body whose spheres are both at the plane, with its remaining speeds along the normal removed.

        theta becomes the angle at which both spheres touch. L loses its component along n x e, the only one that changes
        theta; impulses along the normal at both spheres would have this effect. L.n, L.e, Jellett's quantity of either
        sphere and the slip do not change; the energy decreases by the energy of the removed motion.
        """
        main, stem = balls(self.body)
        e, L = free.axis, free.momentum
        c = jnp.broadcast_to((stem.radius - main.radius) / (stem.offset - main.offset), e[2].shape)
        square = e[0] ** 2 + e[1] ** 2
        # The length of e is unchanged.
        factor = jnp.sqrt((square + e[2] ** 2 - c**2) / square)
        perpendicular = (-e[1], e[0])
        L = (*sum_vectors(L[:2], scale(-dot(perpendicular, L[:2]) / square, perpendicular)), L[2])
        velocity = (free.velocity[0], free.velocity[1], jnp.zeros_like(c))
        return FreeBody(velocity, main.radius - main.offset * c, (*scale(factor, e[:2]), c), L)
