"""Feedback that keeps a ride on its plan."""

from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from scipy.interpolate import CubicSpline

from nonholonomic.geometry import AbstractSurface, add, cross, dot, scale
from nonholonomic.validation import require_kind

from ..model.dynamics import padded
from ..model.input import Motion
from ..model.scene import Scene
from .drive import FINE, Drive
from .goal import MOST_STEERING
from .result import Plan
from .spline import ORDER, evaluate, interpolate

#: Length [wheelbases] over which an error across the way decays, and the rate [1/s] at which an error along it does.
REACH, CATCHING_UP = 2.0, 0.8

#: Speed [wheelbases/s] below which the correction of the heading fades out: it changes its sign in reverse.
SLOW = 0.1


class Tracker(eqx.Module):
    """An input that follows a plan and corrects errors of place and heading; `track` returns it.

    - `drive`: the input of the plan; `pose`: splines of the planned position and heading in the ground's axes;
    - `across` [1/m^2], `turning` [1/m], `along` [1/s]: stiffness k and dampings d and c of the shaped energy;
    - `least_steering`, `most_steering` [rad]: bounds of the steering angle;
    - `slow` [m/s]: speed below which the damping d fades out.
    """

    drive: Drive
    pose: Float[Array, "fine components"]
    surface: AbstractSurface
    wheelbase: Float[Array, ""]
    across: Float[Array, ""]
    turning: Float[Array, ""]
    along: Float[Array, ""]
    least_steering: Float[Array, ""]
    most_steering: Float[Array, ""]
    slow: Float[Array, ""]
    side: float = eqx.field(static=True)

    def errors(self, t: Float[Array, "..."], motion: Motion) -> tuple[Any, Any, Any, Any]:
        """The planned stroller as seen from this one: distances [m] ahead and to the left, and the sine and the cosine of
        the angle to the left at which it heads."""
        pose = evaluate(self.pose, jnp.asarray(t) / self.drive.duration)
        components = jnp.moveaxis(pose, -1, 0)
        axes = self.surface.axes
        heading, target = padded(components[axes:]), padded(components[:axes])
        left = scale(self.side, cross(self.surface.normal(motion.position), motion.heading))
        away = tuple(None if a is None else a - b for a, b in zip(target, motion.position, strict=True))
        away = (away[0], away[1], away[2])
        return dot(away, motion.heading), dot(away, left), dot(heading, left), dot(heading, motion.heading)

    def storage(self, t: Float[Array, "..."], motion: Motion) -> Float[Array, "..."]:
        """The shaped energy of the errors of place and heading [m^2]: (x^2 + y^2) / 2 + (1 - cos(angle)) / stiffness."""
        ahead, left, _, cosine = self.errors(t, motion)
        return 0.5 * (ahead**2 + left**2) + (1.0 - cosine) / self.across

    def __call__(self, t: Float[Array, "..."], motion: Motion) -> tuple[Float[Array, "..."], Float[Array, "..."]]:
        angle, rate, front_speed, force, torque = self.drive.reference(t)
        ahead, left, sine, cosine = self.errors(t, motion)
        speed = front_speed * jnp.cos(angle)
        turn = self.across * left + self.turning * jnp.tanh(speed / self.slow) * sine
        steering = jnp.arctan(jnp.tan(angle) + self.wheelbase * turn)
        steering = jnp.clip(steering, self.least_steering, self.most_steering)
        wanted = (speed * cosine + self.along * ahead) / jnp.cos(steering)
        drive = self.drive
        force = add(drive.climbing(motion), force + drive.speed_gain * (wanted - motion.front_speed))
        torque = (
            torque + drive.angle_gain * (steering - motion.steering) + drive.rate_gain * (rate - motion.steering_rate)
        )
        return force, torque


def track(scene: Scene, plan: Plan) -> Tracker:
    """Feedback that keeps a ride on its plan under disturbances.

    The errors x (ahead), y (to the left) and theta (heading) of the planned stroller, as seen from this one, are a
    port-Hamiltonian system with the shaped energy H = (x^2 + y^2) / 2 + (1 - cos theta) / k. With the speed
    v = v_d cos theta + c x and the yaw rate Omega = Omega_d + v_d k y + d |v_d| sin theta, it has the power balance
    dH/dt = -c x^2 - (d / k) |v_d| sin^2 theta: the springs store energy, and the injected damping takes it out (Kanayama et
    al., IEEE Int. Conf. Robotics and Automation (1990) 384; van der Schaft, L2-Gain and Passivity Techniques in Nonlinear
    Control (2017), chapter 7). The drive force and the steering torque hold that speed and the steering angle
    arctan(l Omega / v), by springs and dampers of their own. On curved ground, the errors are those in the tangent plane.

    **Arguments:**

    - `scene`: the `Scene` that is driven, with the ground of the plan.
    - `plan`: a `Plan`.

    **Returns:** an input for `simulate`: an `equinox.Module` with the gains as numbers, and with `storage(t, motion)`, the
    shaped energy.

    **Raises:** `ValueError` if an argument is of the wrong kind, or the scene has another kind of ground.

    **Example:**

    ```
    >>> import stroller
    >>> body = stroller.Stroller(mass=5.0, wheelbase=0.25, inertia=0.1, steering_inertia=0.005)
    >>> scene = stroller.Scene(body, friction=stroller.Damping(2.0, 0.5, 0.1, 0.05))
    >>> gap = [stroller.Box((1.1, 0.3), (0.5, 0.25)), stroller.Box((2.7, 0.3), (0.5, 0.25))]
    >>> start, goal = stroller.Launch((0.0, 1.0), 0.0, 0.0), stroller.Goal((3.0, 1.2), heading=0.0)
    >>> plan = stroller.plan(scene, start, goal, 12.0, obstacles=gap, limits=stroller.Limits(steering=1.0))
    >>> elsewhere = stroller.Launch((0.05, 0.92), 0.1, 0.0)
    >>> run = stroller.simulate(scene, elsewhere, 12.0, stroller.track(scene, plan), times=[6.0, 12.0], tolerance=1e-6)
    >>> print(f"{run.place[-1, 0]:.1f} m, {run.place[-1, 1]:.1f} m")
    3.0 m, 1.2 m

    ```
    """
    require_kind(scene, "scene", Scene)
    require_kind(plan, "plan", Plan, ", as stroller.plan returns it")
    planned_on = type(plan.problem.scene.surface)
    if not isinstance(scene.surface, planned_on):
        raise ValueError(
            f"scene: its ground is a {type(scene.surface).__name__} and must be a {planned_on.__name__}, as in the plan"
        )
    run, axes = plan.run, scene.surface.axes
    nodes = FINE * (len(plan.input.steering) - ORDER + 1) + 1
    poses = CubicSpline(np.asarray(run.t), np.asarray(run.state[:, : 2 * axes]))(np.linspace(0.0, plan.t1, nodes))
    length = scene.body.wheelbase
    low, high = plan.problem.limits.ranges().get("steering", (-MOST_STEERING, MOST_STEERING))
    return Tracker(
        drive=plan.input,
        pose=jnp.asarray(interpolate(poses)),
        surface=scene.surface,
        wheelbase=length,
        across=1.0 / (REACH * length) ** 2,
        turning=2.0 / (REACH * length),
        along=jnp.asarray(CATCHING_UP),
        least_steering=jnp.asarray(low),
        most_steering=jnp.asarray(high),
        slow=SLOW * length,
        side=scene.dynamics.side,
    )
