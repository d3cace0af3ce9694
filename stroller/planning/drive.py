"""The input of a plan: a force and a torque over time, and feedback that holds the planned speed and steering angle."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from nonholonomic.geometry import Vector, add, dot, scale, subtract, vector_of

from ..model.dynamics import Dynamics, padded
from ..model.input import Motion
from .inverse import actuation
from .spline import ORDER, evaluate, interpolate
from .transcription import drive_from, motion_at, windows

#: How fast feedback removes an error of the steering angle and of the speed [1/s].
STEERING_RATE, SPEED_RATE = 8.0, 4.0

#: Values of force and torque in an interval of the plan, and Runge-Kutta steps between them.
FINE, FINE_STEPS = 4, 2


class Drive(eqx.Module):
    """An input that follows a planned speed of the front wheel and a planned steering angle.

    Each is a uniform cubic B-spline over `duration` [s]. `force` [N], together with the part of the `weight` [N] (a vector in
    the ground's axes) that acts against the actual heading, and `torque` [N m] move the planned stroller exactly. Without
    that part, an error of the heading on a slope would change the speed, and grow. The gains pull speed [N s/m], angle
    [N m/rad] and rate [N m s/rad] back where rounding or a disturbance changes them, because a fork in reverse is unstable
    by itself. Nothing corrects the place: see `track`.
    """

    duration: Float[Array, ""]
    steering: Float[Array, " coefficients"]
    front_speed: Float[Array, " coefficients"]
    force: Float[Array, " fine"]
    torque: Float[Array, " fine"]
    weight: Vector
    speed_gain: Float[Array, ""]
    angle_gain: Float[Array, ""]
    rate_gain: Float[Array, ""]

    def reference(self, t: Float[Array, "..."]) -> tuple[Any, Any, Any, Any, Any]:
        """Planned steering angle [rad], its rate [rad/s], speed of the front wheel [m/s], force [N] without the weight's
        part, and torque [N m]."""
        part = jnp.asarray(t) / self.duration
        per_second = (len(self.steering) - ORDER + 1) / self.duration
        return (
            evaluate(self.steering, part),
            evaluate(self.steering, part, 1) * per_second,
            evaluate(self.front_speed, part),
            evaluate(self.force, part),
            evaluate(self.torque, part),
        )

    def climbing(self, motion: Motion) -> Any:
        """The force [N] that holds the stroller against its weight; `None` where the ground is level."""
        return dot(self.weight, motion.heading)

    def __call__(self, t: Float[Array, "..."], motion: Motion) -> tuple[Float[Array, "..."], Float[Array, "..."]]:
        angle, rate, speed, force, torque = self.reference(t)
        force = add(self.climbing(motion), force + self.speed_gain * (speed - motion.front_speed))
        torque = torque + self.angle_gain * (angle - motion.steering) + self.rate_gain * (rate - motion.steering_rate)
        return force, torque


@eqx.filter_jit
def _needed(dynamics: Dynamics, pose: Any, steering: Any, front_speed: Any, t1: Any) -> tuple[Any, Any, Any]:
    """Force, torque and pose of a drive from a pose, `FINE` times in every interval and at the end."""
    intervals = len(steering) - ORDER + 1
    duration, width = t1 / intervals, 1.0 / FINE

    def forces(pose, window, part):
        needed = actuation(dynamics, pose, motion_at(window, part, duration), False)
        return needed.force, needed.torque, pose

    def over_interval(pose, window):
        def over_part(pose, k):
            end = pose
            for step in range(FINE_STEPS):
                first = (k + step / FINE_STEPS) * width
                end = drive_from(dynamics, end, window, first, width / FINE_STEPS, duration)
            return end, forces(pose, window, k * width)

        return jax.lax.scan(over_part, pose, jnp.arange(FINE))

    rows = (windows(steering[:, None])[..., 0], windows(front_speed[:, None])[..., 0])
    end, values = jax.lax.scan(over_interval, pose, rows)
    last = forces(end, (rows[0][-1], rows[1][-1]), 1.0)
    return tuple(  # pyright: ignore[reportReturnType]
        jnp.concatenate([value.reshape(-1, *value.shape[2:]), final[None]])
        for value, final in zip(values, last, strict=True)
    )


def poses_along(dynamics: Dynamics, pose: Any, steering: np.ndarray, front_speed: np.ndarray, t1: float) -> np.ndarray:
    """The poses at the knots of a drive from a pose, (knots, components)."""
    return np.asarray(_needed(dynamics, pose, steering, front_speed, jnp.asarray(t1, dtype=float))[2])[::FINE]


def drive_along(dynamics: Dynamics, pose: Any, steering: np.ndarray, front_speed: np.ndarray, t1: float) -> Drive:
    """The input that gives a stroller, from a pose, the steering angle and the speed of two splines."""
    force, torque, poses = _needed(dynamics, pose, steering, front_speed, jnp.asarray(t1, dtype=float))
    body = dynamics.body
    weight = vector_of(scale(body.mass * dynamics.gravity, dynamics.up))
    force = subtract(force, dot(weight, padded(poses[:, dynamics.surface.axes :].T)))
    return Drive(
        duration=jnp.asarray(t1, dtype=float),
        steering=jnp.asarray(steering),
        front_speed=jnp.asarray(front_speed),
        force=jnp.asarray(interpolate(np.asarray(force))),
        torque=jnp.asarray(interpolate(np.asarray(torque))),
        weight=weight,
        speed_gain=SPEED_RATE * body.mass,
        angle_gain=STEERING_RATE**2 * body.steering_inertia,
        rate_gain=2.0 * STEERING_RATE * body.steering_inertia,
    )
