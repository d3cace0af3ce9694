"""Inverse dynamics: the force and the torque that move the stroller with a given speed and steering angle.

Position and heading follow from the speed of the front wheel and the steering angle alone, on every ground; force and
torque enter the rates of the momentum P and of the fork linearly (`model/dynamics.py`), which determines them.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from nonholonomic.geometry import multiply, stacked

from ..model.dynamics import Dynamics, padded

Pose = Float[Array, "components ..."]


class Rates(NamedTuple):
    """Steering angle phi [rad], its two derivatives, and speed of the front wheel [m/s] and its derivative."""

    steering: Any
    steering_rate: Any
    steering_acceleration: Any
    front_speed: Any
    front_acceleration: Any


class Actuation(NamedTuple):
    """What a motion needs: force [N], torque [N m], speed of the rear axle [m/s], normal force [N] and, if asked for,
    the coefficient of friction of each loaded axle."""

    force: Any
    torque: Any
    speed: Any
    normal_force: Any
    grip: Any


def state_of(dynamics: Dynamics, pose: Pose, steering: Any, steering_rate: Any, front_speed: Any) -> Any:
    """The state (see `model/dynamics.py`) of a stroller without work components; the heading is intrinsic."""
    axes = dynamics.surface.axes
    heading = padded(pose[axes:])
    sine, cosine = jnp.sin(steering), jnp.cos(steering)
    momentum = front_speed * jnp.sqrt(dynamics.inertia(heading, 1.0, sine, cosine))
    fork_rate = steering_rate
    if dynamics.absolute is not None:
        fork_rate = fork_rate + front_speed * sine / dynamics.body.wheelbase
    return stacked((*pose, steering, momentum, fork_rate, sine, cosine), pose)


def no_input(t: Any, motion: Any) -> tuple[Any, Any]:
    """An input without force and torque."""
    return 0.0, 0.0


def pose_rate(dynamics: Dynamics, pose: Pose, steering: Any, front_speed: Any) -> Pose:
    """Rate of the position and the heading."""
    state = state_of(dynamics, pose, steering, 0.0, front_speed)
    return dynamics.field(jnp.zeros(()), state, no_input)[: len(pose)]


def actuation(dynamics: Dynamics, pose: Pose, rates: Rates, with_grip: bool) -> Actuation:
    """Force, torque and contact forces of a motion."""
    components = len(pose)
    state, body = state_of(dynamics, pose, *rates[:2], rates.front_speed), dynamics.body
    geometry = dynamics.geometry(state)
    coasting = dynamics.field(jnp.zeros(()), state, no_input)

    def momenta(pose, steering, steering_rate, front_speed):
        state = state_of(dynamics, pose, steering, steering_rate, front_speed)
        return state[components + 1], state[components + 2]

    changes = (coasting[:components], rates.steering_rate, rates.steering_acceleration, rates.front_acceleration)
    values = (pose, rates.steering, rates.steering_rate, rates.front_speed)
    _, (momentum_rate, fork_acceleration) = jax.jvp(momenta, values, changes)
    torque = body.steering_inertia * (fork_acceleration - coasting[components + 2])
    momentum_change = momentum_rate - coasting[components + 1]
    if dynamics.absolute is not None:
        momentum_change = momentum_change + geometry.gauge * geometry.sine / body.wheelbase * torque
    force = momentum_change / (geometry.gauge * geometry.cosine)
    grip = jnp.zeros(0)
    if with_grip:
        # `side_force` expects the work components.
        whole = jnp.concatenate([state, jnp.zeros(2 + dynamics.friction.dissipates)])
        sides = dynamics.side_force(jnp.zeros(()), whole, lambda t, motion: (force, torque))
        load = (geometry.normal_force, geometry.front_load)
        rear_load = load[0] if load[1] is None else load[0] - load[1]
        loads = [rear_load] if load[1] is None else [rear_load, load[1]]
        grip = jnp.stack([jnp.abs(side) / part for side, part in zip(sides, loads, strict=False)])
    normal_force = jnp.broadcast_to(multiply(1.0, geometry.normal_force), jnp.shape(rates.steering))
    return Actuation(force, torque, geometry.motion.speed, normal_force, grip)
