"""The stroller in coordinates, as data for the formulations of `nonholonomic/systems/mechanics.py`.

The coordinates are q = (x, y, theta, phi) on a plane and (eta, mu, psi, phi), reduced latitude first as in the paper,
on a sphere or spheroid, where psi is the paper's theta if the heading is projected. Unlike the P-form, these equations
are singular at the poles. They have the form of the paper, and are an independent check of the P-form (`stroller.md`,
sections 2 to 4 and 6).
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from nonholonomic.geometry import AbstractQuadric, Plane, add, inverse, multiply, subtract
from nonholonomic.systems.mechanics import AbstractSystem, Coordinates
from stroller.friction import WheelMotion
from stroller.model.input import Input, Motion
from stroller.model.scene import FORKS, Scene, State


class Chart(AbstractSystem):
    """A scene in coordinates: metric, potential, constraints, frame and forces.

    The constraints are those of the rear axle, w1 = lat, and of the front wheel, w2 = -sin(phi) long + cos(phi) lat + l
    cos(phi) yaw. The first field of the frame is motion at a fixed steering angle and unit speed of the front wheel;
    the second field is steering.

    **Arguments:**

    - `scene`: a `Scene`.
    - `input`: as for `simulate`.
    """

    scene: Scene
    input: Input | None = None

    @property
    def dimension(self) -> int:
        return 4

    @property
    def quadric(self) -> AbstractQuadric | None:
        """The sphere or spheroid; `None` on a plane."""
        return self.scene.surface if isinstance(self.scene.surface, AbstractQuadric) else None

    def ground_metric(self, q: Coordinates) -> Float[Array, " 2"]:
        """Squares of the scale factors of the first two coordinates [m^2 or 1]."""
        if self.quadric is None:
            return jnp.ones(2)
        equatorial, polar = self.quadric.semi_axes
        sine, cosine = jnp.sin(q[0]), jnp.cos(q[0])
        return jnp.array([(equatorial * sine) ** 2 + (polar * cosine) ** 2, (equatorial * cosine) ** 2])

    def forms(self, q: Coordinates) -> Float[Array, "3 4"]:
        """The one-forms long, lat and yaw, one per row: the rear axle's rolling, its slip to the left, and its turn to
        the left."""
        zero, unit = jnp.zeros(()), jnp.ones(())
        sine, cosine = jnp.sin(q[2]), jnp.cos(q[2])
        if self.quadric is None:
            return jnp.array([[cosine, sine, zero, zero], [-sine, cosine, zero, zero], [zero, zero, unit, zero]])
        equatorial, _ = self.quadric.semi_axes
        if self.scene.heading == "projected":
            # The pull-back of cos(theta) dx + sin(theta) dy and its like by x = A cos(eta) cos(mu), y = ... sin(mu).
            inwards, radial = -equatorial * jnp.sin(q[0]), equatorial * jnp.cos(q[0])
            sine, cosine = jnp.sin(q[2] - q[1]), jnp.cos(q[2] - q[1])
            longitudinal = [inwards * cosine, radial * sine, zero, zero]
            lateral = [-inwards * sine, radial * cosine, zero, zero]
            return jnp.array([longitudinal, lateral, [zero, zero, unit, zero]])
        h_eta, h_mu = jnp.sqrt(self.ground_metric(q))
        connection = equatorial * jnp.sin(q[0]) / h_eta
        side = self.scene.dynamics.side
        lateral = [side * h_eta * cosine, -side * h_mu * sine, zero, zero]
        return jnp.array(
            [[h_eta * sine, h_mu * cosine, zero, zero], lateral, [zero, side * connection, side * unit, zero]]
        )

    def metric(self, q: Coordinates) -> Float[Array, "4 4"]:
        body, absolute = self.scene.body, FORKS[self.scene.fork]
        _, lateral, yaw = self.forms(q)
        fork = jnp.zeros(4).at[3].set(1.0) + (0.0 if absolute is None else absolute * yaw)
        G = body.mass * jnp.diag(jnp.concatenate([self.ground_metric(q), jnp.zeros(2)]))
        G = G + body.inertia * jnp.outer(yaw, yaw) + body.steering_inertia * jnp.outer(fork, fork)
        if body.centre is not None:
            # The centre of mass also moves sideways at b Omega; the inertia is about the axle and includes m b^2.
            coupling = jnp.outer(lateral, yaw)
            G = G + body.mass * body.centre * (coupling + coupling.T)
        return G

    def potential(self, q: Coordinates) -> Float[Array, ""]:
        scene = self.scene
        if self.quadric is None:
            slope = scene.surface.up[0]
            centre_x = add(q[0], multiply(scene.body.centre, jnp.cos(q[2])))
            height = multiply(centre_x, slope)
        else:
            height = self.quadric.semi_axes[1] * (1.0 + jnp.sin(q[0]))
        weight = multiply(scene.body.mass * scene.gravity, height)
        spring = multiply(0.5, scene.body.steering_spring, q[3], q[3])
        return add(jnp.zeros(()), weight, spring)

    def constraints(self, q: Coordinates) -> Float[Array, "2 4"]:
        longitudinal, lateral, yaw = self.forms(q)
        sine, cosine = jnp.sin(q[3]), jnp.cos(q[3])
        return jnp.stack([lateral, -sine * longitudinal + cosine * lateral + self.scene.body.wheelbase * cosine * yaw])

    def frame(self, q: Coordinates) -> Float[Array, "4 4"]:
        sine, cosine, length = jnp.sin(q[3]), jnp.cos(q[3]), self.scene.body.wheelbase
        forms = self.forms(q)
        # Long and lat do not depend on the turn of the heading, and only steering changes phi.
        block = inverse(forms[:2, :2])
        level = jnp.concatenate([block, -forms[2:, :2] @ block / forms[2, 2], jnp.zeros((1, 2))])
        (longitudinal, lateral), steering = level.T, jnp.zeros(4).at[3].set(1.0)
        yaw = jnp.zeros(4).at[2].set(1.0 / forms[2, 2])
        forward, turning = cosine * longitudinal + sine / length * yaw, cosine * yaw - length * sine * longitudinal
        return jnp.stack([forward, steering, lateral, turning], 1)

    def wheel_motion(self, q: Coordinates, rate: Coordinates) -> tuple[Float[Array, "4 4"], WheelMotion]:
        """The one-forms of rear-wheel speed, front-wheel speed, yaw and steering rate, a row each, and their values."""
        body, (longitudinal, lateral, yaw) = self.scene.body, self.forms(q)
        sine, cosine = jnp.sin(q[3]), jnp.cos(q[3])
        front = cosine * longitudinal + sine * lateral + body.wheelbase * sine * yaw
        rows = jnp.stack([longitudinal, front, yaw, jnp.zeros(4).at[3].set(1.0)])
        load = self.normal_force(q, rate)
        front_load = None if body.centre is None else load * body.centre / body.wheelbase
        v, w, yaw_rate, steering_rate = rows @ rate
        return rows, WheelMotion(v, w, yaw_rate, steering_rate, subtract(load, front_load), front_load)

    def normal_force(self, q: Coordinates, rate: Coordinates) -> Float[Array, ""]:
        """Normal force [N], from the principal curvatures A c / h_eta^3 and c / (A h_eta) of a spheroid."""
        scene = self.scene
        weight = scene.body.mass * scene.gravity
        if self.quadric is None:
            return multiply(weight, scene.surface.up[2])
        equatorial, polar = self.quadric.semi_axes
        squares = self.ground_metric(q)
        h_eta = jnp.sqrt(squares[0])
        curvatures = jnp.array([equatorial * polar / h_eta**3, polar / (equatorial * h_eta)])
        bend = scene.body.mass * jnp.sum(curvatures * squares * rate[:2] ** 2)
        return scene.dynamics.side * (weight * equatorial * jnp.sin(q[0]) / h_eta - bend)

    def motion(self, q: Coordinates, wheels: WheelMotion) -> Motion:
        """The motion for an input."""
        place = (q[0], q[1]) if self.quadric is None else (q[1], q[0])
        return Motion(*self.scene.dynamics.pose(place, q[2]), q[3], *wheels[:4])

    def force(self, t: Float[Array, ""], q: Coordinates, rate: Coordinates) -> Coordinates:
        rows, wheels = self.wheel_motion(q, rate)
        drive, torque = (None, None) if self.input is None else self.input(t, self.motion(q, wheels))
        drag = self.scene.friction.drag(wheels)
        loads = (add(drive, drag.rear), drag.front, drag.yaw, add(torque, drag.steering))
        return sum((load * row for load, row in zip(loads, rows, strict=True) if load is not None), jnp.zeros(4))


def coordinates(scene: Scene, state: State) -> Coordinates:
    """Coordinates q of a state (components,) of the P-form."""
    position, heading, rest = scene.dynamics.unpack(state)
    place = scene.surface.place_at(position)
    first = place if isinstance(scene.surface, Plane) else place[::-1]
    return jnp.stack([*first, scene.dynamics.angle(position, heading), rest[0]])


def coordinates_and_rates(
    scene: Scene, t, state: State, controls: Input | None = None
) -> tuple[Coordinates, Coordinates]:
    """Coordinates and velocity (q, q') of a state (components,) of the P-form at a time [s]."""
    rate = scene.dynamics.field(t, state, controls)
    return jax.jvp(lambda state: coordinates(scene, state), (state,), (rate,))
