"""Impact under set-valued Coulomb friction: the slip may stop, and the contact then sticks or slips again.

As in `impact.py` the normal impulse p replaces time, and the contact's velocity changes by the constant matrix W. While
the contact slips, the tangential impulse grows by -mu v / |v|, whose direction has no limit where a slip stops. With
the slip distance s as the independent variable, ds = dp / |v|, nothing is singular: v' = |v| W_n - mu W_t v, and a slip
that stops decays exponentially in s.

After a stop, the tangential impulse per unit of p is the f with |f| <= mu that minimises f.W_tt f / 2 + f.W_tn: v then
grows along -f if |f| = mu, and stays zero if |f| < mu. Because W_tt is positive definite, there is one such f, (W_tt +
k) f = -W_tn with k >= 0: the solution after the stop is unique and straight, and lasts to the end of the impact. The
normal velocity grows during this motion.
"""

import diffrax
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from nonholonomic.compilation.xla_cpu import greatest, least
from nonholonomic.geometry import Vector, dot, scale, sum_vectors, vector_of
from nonholonomic.integration import AbstractProblem, Settings, traced_solve_ensemble
from nonholonomic.integration.settings import MOST_STEPS
from nonholonomic.integration.status import LEFT_DOMAIN

from ..model.friction import SetValuedCoulomb, length
from ..model.top import Top
from .free_body import Ball, FreeBody
from .impact import LARGEST, TOLERANCE, ContactImpulse, Impact, apply_impulse, approach

Cells = Float[Array, " cells"]

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
    pace: Cells

    def velocity(self, state: Float[Array, "3 cells"]) -> Vector:
        """Velocity of the contact point [m/s]."""
        contact, impulse = self.impact.approach, self.impact.impulse(state[2], state[:2])
        changes = tuple(dot(column, impulse.force) for column in contact.response)
        return sum_vectors(contact.velocity, changes)

    def start(self) -> tuple[Float[Array, "3 cells"], Float[Array, "3 cells"]]:
        zeros = jnp.zeros((3, *self.pace.shape))
        return zeros, jnp.ones_like(zeros)

    def field(self, time: Cells, state: Float[Array, "3 cells"]) -> Float[Array, "3 cells"]:
        v1, v2, _ = self.velocity(state)
        return jnp.stack([-self.mu * v1, -self.mu * v2, length(v1, v2)]) / self.pace

    def event_function(self, state: Float[Array, "3 cells"]) -> None:
        return None

    def domain_margin(self, time: Cells, state: Float[Array, "3 cells"]) -> Cells:
        return least(self.impact.domain_margin(state[2], state[:2]), self.slip_left(state))

    def slip_left(self, state: Float[Array, "3 cells"]) -> Cells:
        """Slip speed above the threshold at which a slip has stopped, as a fraction of the speed of arrival."""
        return length(*self.velocity(state)[:2]) / self.pace - STOPS


def resolve_coulomb_impact(
    body: Top, friction: SetValuedCoulomb, ball: Ball, free: FreeBody, restitution: Cells
) -> tuple[FreeBody, Bool[Array, " cells"]]:
    """The body after one of its spheres has struck the plane; if the contact sticks, its slip is zero up to round-off.

    **Arguments, returns:** as for `resolve_impact`; this is its limit for a slip speed of 0.
    """
    contact = approach(body, ball, free)
    impact = Impact(body, friction, contact, ball.radius, (1.0 + restitution) * greatest(-contact.velocity[2], 0.0))
    pace = greatest(length(*contact.velocity[:2]), impact.speed)
    skid = Skid(impact, friction.mu, pace)
    settings = Settings(TOLERANCE, diffrax.Dopri5(), absolute=0.1, max_steps=MOST_STEPS)
    outcome, _ = traced_solve_ensemble(skid, jnp.asarray(LARGEST), jnp.asarray(pace.shape[0]), settings)
    stops = skid.slip_left(outcome.state) <= STOPS
    rates = skid.field(outcome.end_time, outcome.state)
    # An impact that ends while it slips is corrected by one step of Newton's method, as in `Impact.ended`.
    left, slope = jax.jvp(lambda point: impact.domain_margin(point[2], point[:2]), (outcome.state,), (rates,))
    step = -left / jnp.where(slope == 0.0, 1.0, slope)
    step = jnp.where(jnp.abs(step) < 1e-6, step, 0.0)
    state = jnp.where(stops, outcome.state, outcome.state + step * rates)
    impulse = impact.impulse(state[2], state[:2])
    remaining_impulse = _remaining_impulse(impact, friction.mu, impulse.force)
    force = vector_of(jnp.where(stops, a + b, a) for a, b in zip(impulse.force, remaining_impulse, strict=True))
    return apply_impulse(body, contact, free, ContactImpulse(force, None)), outcome.status != LEFT_DOMAIN


def _remaining_impulse(impact: Impact, mu: Float[Array, "..."], impulse: Vector) -> Vector:
    """The impulse [N s] from the stop of the slip to the end of the impact."""
    contact = impact.approach
    W = contact.response
    a, b, c = W[0][0], W[0][1], W[1][1]
    f1, f2 = sticking_force((a, b, c), (W[0][2], W[1][2]), mu)

    def change(force: Vector) -> Vector:
        return tuple(dot(column, force) for column in W)

    # Where the contact sticks, the impulse first removes the remaining slip.
    v1, v2, _ = sum_vectors(contact.velocity, change(impulse))
    sticks, determinant = f1 * f1 + f2 * f2 < mu * mu, a * c - b * b
    stopping_impulse = (
        jnp.where(sticks, (b * v2 - c * v1) / determinant, 0.0),
        jnp.where(sticks, (b * v1 - a * v2) / determinant, 0.0),
    )
    impulse = sum_vectors(impulse, (*stopping_impulse, None))
    velocity, impulse_direction = sum_vectors(contact.velocity, change(impulse)), (f1, f2, jnp.ones_like(f1))
    # The impact ends as in `Impact.domain_margin`: the normal velocity is linear in the impulse, and the energy is
    # quadratic.
    gains = change(impulse_direction)
    normal_impulse = greatest((contact.velocity[2] + impact.gained - velocity[2]) / gains[2], 0.0)
    compressed = greatest(-velocity[2], 0.0) / gains[2]
    power, stiff = dot(impulse_direction, velocity), dot(impulse_direction, gains)
    gain = least(dot(impulse, contact.velocity) + 0.5 * dot(impulse, change(impulse)), 0.0)
    restored = (-power + jnp.sqrt(power * power - 2.0 * gain * stiff)) / stiff
    return sum_vectors(
        scale(least(normal_impulse, greatest(compressed, restored)), impulse_direction), (*stopping_impulse, None)
    )


def sticking_force(
    matrix: tuple[Cells, Cells, Cells], coupling: tuple[Cells, Cells], mu: Float[Array, "..."]
) -> tuple[Cells, Cells]:
    """The f with |f| <= mu that minimises f.A f / 2 + f.b, for A = (A11, A12, A22) positive definite.

    (A + k) f = -b, and 1 / |f| grows with k and is concave, so Newton's method finds |f| = mu from k = 0 on.
    """
    a, b, c = matrix

    def solved(k: Cells, right: tuple[Cells, Cells]) -> tuple[Cells, Cells]:
        determinant = (a + k) * (c + k) - b * b
        x, y = right
        return ((c + k) * x - b * y) / determinant, ((a + k) * y - b * x) / determinant

    def force(k: Cells) -> tuple[Cells, Cells]:
        return solved(k, (-coupling[0], -coupling[1]))

    free = length(*force(jnp.zeros_like(a)))
    is_beyond = (free > mu) & (mu > 0.0)
    normal_impulse = jnp.where(is_beyond, mu, 1.0)

    def newton(_: int, k: Cells) -> Cells:
        f1, f2 = force(k)
        size = jnp.where(is_beyond, length(f1, f2), 1.0)
        g1, g2 = solved(k, (f1, f2))
        slope = jnp.where(is_beyond, (f1 * g1 + f2 * g2) / size**3, 1.0)
        return k + jnp.where(is_beyond, (1.0 / normal_impulse - 1.0 / size) / slope, 0.0)

    f1, f2 = force(jax.lax.fori_loop(0, ITERATIONS, newton, jnp.zeros_like(a)))
    return jnp.where(mu > 0.0, f1, 0.0), jnp.where(mu > 0.0, f2, 0.0)
