"""Users' own systems with closed forms, which several tests share."""

import equinox as eqx
import jax.numpy as jnp

from nonholonomic import AbstractMode, AbstractSystem

GRAVITY = 9.81


class Ball(AbstractMode):
    """A ball that falls and bounces: height [m], velocity [m/s], number of bounces."""

    restitution: float = 0.8
    gravity: float = GRAVITY

    def field(self, t, y):
        return jnp.array([y[1], -self.gravity, 0.0])

    def margin(self, t, y):
        return y[0]

    def reset(self, t, y):
        return jnp.array([0.0, -self.restitution * y[1], y[2] + 1.0]), 0


class Stick(AbstractMode):
    """A block at rest on a belt: place and velocity; it slips where the spring pulls more than friction holds."""

    grip: float = 1.0
    belt: float = 0.5

    def field(self, t, y):
        return jnp.array([self.belt, 0.0])

    def margin(self, t, y):
        return self.grip - y[0]

    def reset(self, t, y):
        return y, 1


class Slip(AbstractMode):
    """It slips back under the spring x'' = -x + friction, until its velocity is that of the belt again."""

    friction: float = 1.0
    belt: float = 0.5

    def field(self, t, y):
        return jnp.array([y[1], self.friction - y[0]])

    def margin(self, t, y):
        return self.belt - y[1]

    def reset(self, t, y):
        return jnp.array([y[0], self.belt]), 0


class Bounces(eqx.Module):
    """An event: so many bounces. The count jumps over zero."""

    count: float

    def __call__(self, t, y):
        return self.count - 0.5 - y[2]


def bounce(height, restitution, gravity, number):
    """When a ball dropped from a height strikes the ground for the n-th time [s]."""
    speed = jnp.sqrt(2.0 * gravity * height)
    return speed / gravity * (1.0 + 2.0 * sum(restitution**k for k in range(1, number)))


class Sleigh(AbstractSystem):
    """Chaplygin's sleigh: a blade at (x, y) under the heading q[2], the centre of mass a distance ahead of it."""

    mass: float = 1.7
    inertia: float = 0.4
    ahead: float = 0.3

    dimension = 3

    def metric(self, q):
        c, s, lever = jnp.cos(q[2]), jnp.sin(q[2]), self.mass * self.ahead
        turning = self.inertia + lever * self.ahead
        return jnp.array([[self.mass, 0.0, -lever * s], [0.0, self.mass, lever * c], [-lever * s, lever * c, turning]])

    def constraints(self, q):
        return jnp.array([[-jnp.sin(q[2]), jnp.cos(q[2]), 0.0]])


def final_turn(sleigh, rate):
    """By how much a sleigh turns that starts with its blade at rest and turns at a rate [rad/s].

    With J = I + m a^2 and v' = a omega^2, J omega' = -m a v omega, the energy m v^2 + J omega^2 is constant: omega =
    W sech(k t), v = sqrt(J / m) W tanh(k t) with k = a W sqrt(m / J), and the turn is W pi / (2 k).
    """
    turning = sleigh.inertia + sleigh.mass * sleigh.ahead**2
    return jnp.pi / (2.0 * sleigh.ahead) * jnp.sqrt(turning / sleigh.mass) * jnp.sign(rate)


class Bumper(Sleigh):
    """Chaplygin's sleigh with a bumper ahead of its blade that strikes a wall at x = wall."""

    wall: float = 1.0
    bumper: float = 0.2
    restitution: float = 0.7

    names = ("x", "y", "heading")

    def margin(self, t, q, rate):
        return self.wall - q[0] - self.bumper * jnp.cos(q[2])

    def reset(self, t, q, rate):
        return q, self.impact(t, q, rate, self.restitution)


def after_impact(sleigh, heading, speed, time):
    """Heading, forward velocity and turn rate of a `Bumper` at a time after its impact, if it starts straight from (0, 0).

    With the turn rate w and J = I + m a^2, the kinetic energy is (m v^2 + J w^2) / 2, and the impulse of the wall changes
    (m v, J w) along (-cos(heading), b sin(heading)), the slopes of the bumper's distance. Afterwards v' = a w^2 and
    J w' = -m a v w, hence v = V tanh(k t), w = W sech(k t) with V = W sqrt(J / m) and k = a W sqrt(m / J).
    """
    m, a, b = sleigh.mass, sleigh.ahead, sleigh.bumper
    c, s, turning = jnp.cos(heading), jnp.sin(heading), sleigh.inertia + m * a**2
    impact = (sleigh.wall - b * c) / (speed * c)
    impulse = (1.0 + sleigh.restitution) * speed * c / (c**2 / m + (b * s) ** 2 / turning)
    v, w = speed - impulse * c / m, impulse * b * s / turning
    top = jnp.sqrt(m / turning * v**2 + w**2)
    k = a * top * jnp.sqrt(m / turning)
    phase = jnp.arctanh(v / (top * jnp.sqrt(turning / m)))
    later = phase + k * (time - impact)
    turn = 2.0 * top / k * (jnp.arctan(jnp.tanh(later / 2.0)) - jnp.arctan(jnp.tanh(phase / 2.0)))
    return jnp.stack([heading + turn, top * jnp.sqrt(turning / m) * jnp.tanh(later), top / jnp.cosh(later)])


class Turntable(AbstractSystem):
    """A ball that rolls without slipping on a table that turns at a rate about the origin; q[2] and q[3] are its rotations
    about the axes of the plane."""

    turn: float = 1.3
    mass: float = 2.0
    radius: float = 0.1
    drag: float = 0.0
    dimension = 4

    names = ("x", "y", "about_x", "about_y")

    def metric(self, q):
        inertia = 0.4 * self.mass * self.radius**2
        return jnp.diag(jnp.array([self.mass, self.mass, inertia, inertia]))

    def constraints(self, q):
        return jnp.array([[1.0, 0.0, 0.0, -self.radius], [0.0, 1.0, self.radius, 0.0]])

    def drift(self, q):
        return self.turn * jnp.array([-q[1], q[0]])

    def force(self, t, q, rate):
        return -self.drag * jnp.array([rate[0], rate[1], 0.0, 0.0])

    def start(self, x, y, x_rate, y_rate):
        """Coordinates and rates of a ball that rolls."""
        about_x, about_y = self.turn * x - y_rate, x_rate + self.turn * y
        rate = jnp.array([x_rate, y_rate, about_x / self.radius, about_y / self.radius])
        return jnp.array([x, y, 0.0, 0.0]), rate


class Pendulum(AbstractSystem):
    """A mass on a rod, by its angle."""

    length: float = 1.0
    dimension = 1

    def metric(self, q):
        return jnp.array([[self.length**2]])

    def potential(self, q):
        return -GRAVITY * self.length * jnp.cos(q[0])
