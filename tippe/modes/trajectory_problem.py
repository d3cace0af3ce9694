"""Motion on one smooth contact with the path on the arena, the orientation about the axis and the work of friction."""

from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from nonholonomic.compilation.xla_cpu import compiled_setup
from nonholonomic.geometry import Component, Tangent, Vector, cross, dot, rate_in_frame, scale, stacked, sum_vectors
from nonholonomic.integration import AbstractPassive, ExtendedProblem

from ..model.dynamics import Dynamics
from ..model.launch import Launch
from ..model.rigid_body import AbstractRigidBody
from ..model.scene import Scene
from ..model.state import parts
from .inversion_problem import InversionProblem

#: Launches with their passive quadratures, without an event.
TrajectoryProblem = ExtendedProblem[InversionProblem]

#: Number of the passive quadratures after the path.
BEHIND_PATH = 5


class Quadratures(AbstractPassive):
    """The passive quadratures of a top in contact: the arena's path, the vector c, the spin angle and the work of friction.

    c is a unit vector across the axis that moves with the axis without rotation about it. The body's first axis is c
    turned about e by the spin angle, so every integrated component changes as slowly as the axis.

    - `axial`: the moment of inertia about the axis [kg m^2].
    - `of_mass`: whether the path belongs to the centre of mass, along a level plane.
    """

    axial: Float[Array, "..."]
    of_mass: bool = eqx.field(static=True, default=False)

    def rates(
        self, problem: Any, time: Float[Array, "..."], state: Any, passive: Any
    ) -> Float[Array, "components ..."]:
        dynamics, (u, e, L, _) = problem.dynamics, parts(state)
        motion, (*path, c1, c2, c3, _, _) = dynamics.motion(state), passive
        c, frame_rate = (c1, c2, c3), (None, None) if self.of_mass else motion.frame_rate
        path_rate = u if self.of_mass else dynamics.frame.cyclic_rate(tuple(path), motion.velocity, frame_rate)
        # In a frame that turns, the components of the axis have another rate than the axis.
        if self.of_mass or not isinstance(dynamics, Dynamics):
            axial_rate = dot(sum_vectors(motion.rate[2:5], scale(-1.0, rate_in_frame(e, frame_rate))), c)
        else:
            axial_rate = dot(cross(L, e), c) * dynamics.per_transverse
        rates = (*path_rate, *c_rate(c, e, axial_rate, frame_rate), motion.spin_momentum / self.axial)
        return stacked((*motion.rate, *rates, motion.friction_power), state)


def c_rate(c: Vector, axis: Vector, axial_rate: Component, frame_rate: Tangent = (None, None)) -> tuple[Component, ...]:
    """c' = (e x e') x c = -(e'.c) e, with `axial_rate` = e'.c [1/s], in a frame that turns at a rate [rad/s]."""
    return sum_vectors(scale(-axial_rate, axis), rate_in_frame(c, frame_rate))


def trajectory_problem(modules: tuple[Scene, Launch], cells: int | None = None) -> TrajectoryProblem:
    """The run of one launch, or the runs of several cells; numbers are scalars or arrays with one number per cell."""
    return _problem(*modules, cells)


@compiled_setup
def _problem(scene: Scene, launch: Launch, cells: int | None) -> TrajectoryProblem:
    size, weight = scene.body.size, scene.body.mass * scene.gravity
    sine, cosine = jnp.sin(launch.theta), jnp.cos(launch.theta)
    perpendicular = (cosine * jnp.cos(launch.azimuth), cosine * jnp.sin(launch.azimuth), -sine)
    path, zero, unit = scene.start(launch)[1], jnp.zeros(()), jnp.ones(())
    values = (*path, *perpendicular, zero, zero)
    scales = (*[size] * len(path), unit, unit, unit, unit, weight * size)
    values, scales = (jnp.stack(jnp.broadcast_arrays(*rows)) for rows in (values, scales))
    rows = (scene.state(launch), scene.scales(launch), values, scales)
    if cells is not None:
        rows = tuple(jnp.broadcast_to(row.reshape(len(row), -1), (len(row), cells)) for row in rows)
    # The equations of a rigid body return the spin in place of the angular momentum about the axis.
    axial = jnp.ones(()) if isinstance(scene.body, AbstractRigidBody) else scene.body.I3
    problem = InversionProblem(scene.dynamics, None, rows[0], rows[1])
    return ExtendedProblem(problem, Quadratures(axial), rows[2], rows[3], ends_on_event=False)
