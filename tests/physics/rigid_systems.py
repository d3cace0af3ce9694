"""Rolling bodies as users' mechanical systems: the benchmark bicycle, a disc, and a ball on a turntable."""

import jax
import jax.numpy as jnp
import numpy as np

from nonholonomic.systems.mechanics import AbstractSystem

GRAVITY = 9.81


def about_x(angle):
    c, s = jnp.cos(angle), jnp.sin(angle)
    return jnp.array([[1.0, 0.0, 0.0], [0.0, c, -s], [0.0, s, c]])


def about_z(angle):
    c, s = jnp.cos(angle), jnp.sin(angle)
    return jnp.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def about(axis, angle):
    """Rotation about a unit vector (Rodrigues)."""
    x, y, z = axis
    cross = jnp.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return jnp.eye(3) + jnp.sin(angle) * cross + (1.0 - jnp.cos(angle)) * cross @ cross


def body_rates(rotation, rotation_rate):
    """Angular velocity in the body's own axes, from R and R'."""
    turning = rotation.T @ rotation_rate
    return jnp.array([turning[2, 1], turning[0, 2], turning[1, 0]])


class RigidBodies(AbstractSystem):
    """Rigid bodies, each of which says its mass, its inertia in its own axes, and how it moves."""

    def bodies(self):
        """(mass, (3, 3) inertia) of each."""

    def velocities(self, q, rate):
        """(velocity of the centre of mass, angular velocity in its own axes) of each."""

    def slips(self, q, rate):
        """Velocities that must vanish."""

    def metric(self, q):
        jacobians = jax.jacfwd(self.velocities, argnums=1)(q, jnp.zeros_like(q))
        parts = zip(self.bodies(), jacobians, strict=True)
        return sum(mass * v.T @ v + w.T @ inertia @ w for (mass, inertia), (v, w) in parts)

    def constraints(self, q):
        return jax.jacfwd(self.slips, argnums=1)(q, jnp.zeros_like(q))


def in_plane(xx, yy, zz, xz):
    """An inertia given about forward, right and down (Meijaard), in the axes forward, down, left of the bicycle's parts."""
    return jnp.array([[xx, xz, 0.0], [xz, zz, 0.0], [0.0, 0.0, yy]])


def wheel(side, heading):
    """Inertia of a wheel about a diameter and about its axle."""
    return jnp.diag(jnp.array([side, side, heading]))


class Bicycle(RigidBodies):
    """The benchmark bicycle (Meijaard et al. 2007) in the coordinates of Basu-Mandal et al. (2007).

    q = (x, y, z, theta, psi, phi, psi_f, beta_r, beta_f): centre of the rear wheel, 3-1-3 Euler angles of the rear frame, whose
    third axis is the axle and whose first two point forward and down where psi = pi/2 and phi = pi; steering angle about the
    axis that points up; and rotation of each wheel relative to its frame.
    """

    rear_radius: float = 0.3
    front_radius: float = 0.35
    wheelbase: float = 1.02
    trail: float = 0.08
    tilt: float = np.pi / 10

    dimension = 9

    def bodies(self):
        return (
            (2.0, wheel(0.0603, 0.12)),
            (85.0, in_plane(9.2, 11.0, 2.8, 2.4)),
            (4.0, in_plane(0.05892, 0.06, 0.00708, -0.00756)),
            (3.0, wheel(0.1405, 0.28)),
        )

    def pose(self, q):
        """Centres of the four bodies; rotations of rear frame and fork."""
        rear = about_z(q[3]) @ about_x(q[4]) @ about_z(q[5])
        vertical = -jnp.array([jnp.sin(self.tilt), jnp.cos(self.tilt), 0.0])
        fork = rear @ about(vertical, q[6])
        # Seen from the rear wheel's centre, forward and down; the second point lies on the steer axis.
        on_axis = jnp.array([self.wheelbase + self.trail, self.rear_radius, 0.0])
        frame, handlebar = jnp.array([0.3, self.rear_radius - 0.9, 0.0]), jnp.array([0.9, self.rear_radius - 0.7, 0.0])
        front = jnp.array([self.wheelbase, self.rear_radius - self.front_radius, 0.0])

        def steered(point):
            return q[:3] + rear @ on_axis + fork @ (point - on_axis)

        return (q[:3], q[:3] + rear @ frame, steered(handlebar), steered(front)), (rear, fork)

    def velocities(self, q, rate):
        (_, (rear, fork)), (speeds, (rear_rate, fork_rate)) = jax.jvp(self.pose, (q,), (rate,))
        rear_turns, fork_turns = body_rates(rear, rear_rate), body_rates(fork, fork_rate)
        axle = jnp.array([0.0, 0.0, 1.0])
        spin = (rear_turns + rate[7] * axle, rear_turns, fork_turns, fork_turns + rate[8] * axle)
        return tuple(zip(speeds, spin, strict=True))

    def upward(self, rotation):
        """The unit vector in a wheel's plane that points up most."""
        axle, up = rotation[:, 2], jnp.array([0.0, 0.0, 1.0])
        slope_direction = up - axle[2] * axle
        return slope_direction / jnp.sqrt(slope_direction @ slope_direction)

    def slips(self, q, rate):
        (_, rotations), velocities = self.pose(q), self.velocities(q, rate)
        wheels = ((velocities[0], rotations[0], self.rear_radius), (velocities[3], rotations[1], self.front_radius))
        return jnp.concatenate(
            [speed - radius * jnp.cross(R @ spin, self.upward(R)) for (speed, spin), R, radius in wheels]
        )

    def heights(self, q):
        """Heights of the contact points of both wheels above the ground."""
        (rear, _, _, front), rotations = self.pose(q)
        pairs = ((rear, rotations[0], self.rear_radius), (front, rotations[1], self.front_radius))
        return jnp.stack([centre[2] - radius * self.upward(R)[2] for centre, R, radius in pairs])

    def potential(self, q):
        centres, _ = self.pose(q)
        return GRAVITY * sum(mass * centre[2] for (mass, _), centre in zip(self.bodies(), centres, strict=True))


class Disc(RigidBodies):
    """A thin disc that rolls on the plane: q = (x, y) of its contact, heading, lean from the vertical, and rotation."""

    radius: float = 0.4

    dimension = 5

    def bodies(self):
        return ((1.0, self.radius**2 * jnp.diag(jnp.array([0.25, 0.25, 0.5]))),)

    def pose(self, q):
        rotation = about_z(q[2]) @ about_x(0.5 * jnp.pi - q[3])
        return jnp.array([q[0], q[1], 0.0]) + self.radius * rotation[:, 1], rotation

    def velocities(self, q, rate):
        (_, rotation), (speed, rotation_rate) = jax.jvp(self.pose, (q,), (rate,))
        return ((speed, body_rates(rotation, rotation_rate) + rate[4] * jnp.array([0.0, 0.0, 1.0])),)

    def slips(self, q, rate):
        ((speed, spin),), (_, rotation) = self.velocities(q, rate), self.pose(q)
        return (speed - self.radius * jnp.cross(rotation @ spin, rotation[:, 1]))[:2]

    def potential(self, q):
        return GRAVITY * self.pose(q)[0][2]


class BallOnTurntable(RigidBodies):
    """A solid ball on a level turntable that is too heavy for the ball to slow it.

    q = (x, y) of the ball, its three rotations about x, y and z, and the table's angle.
    """

    radius: float = 0.1

    dimension = 6

    def bodies(self):
        return ((1.0, 0.4 * self.radius**2 * jnp.eye(3)), (0.0, 1e13 * jnp.eye(3)))

    def rotation(self, q):
        return about_x(q[2]) @ about(jnp.array([0.0, 1.0, 0.0]), q[3]) @ about_z(q[4])

    def velocities(self, q, rate):
        rotation, rotation_rate = jax.jvp(self.rotation, (q,), (rate,))
        zero, up = jnp.zeros(3), jnp.array([0.0, 0.0, 1.0])
        return ((jnp.array([rate[0], rate[1], 0.0]), body_rates(rotation, rotation_rate)), (zero, rate[5] * up))

    def slips(self, q, rate):
        (speed, spin), (_, table) = self.velocities(q, rate)
        up = jnp.array([0.0, 0.0, 1.0])
        contact_velocity = jnp.cross(table, jnp.array([q[0], q[1], 0.0]))
        return (speed - self.radius * jnp.cross(self.rotation(q) @ spin, up) - contact_velocity)[:2]
