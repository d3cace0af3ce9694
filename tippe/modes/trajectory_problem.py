"""Motion on one smooth contact with the path on the arena, the orientation about the axis and the work of friction."""

from typing import Any

import jax.numpy as jnp
from jaxtyping import Array, Float

from nonholonomic.geometry import carried, cross, dot, scale, sum_vectors
from nonholonomic.integration import AbstractProblem
from nonholonomic.xla_cpu import compiled_setup

from ..model.dynamics import Dynamics, stacked
from ..model.launch import Launch
from ..model.rigid_body import AbstractRigidBody
from ..model.rigid_dynamics import AbstractRigidDynamics
from ..model.scene import Scene
from ..model.state import parts
from ..model.stick_slip import ContactMode, StickSlip
from ..model.top import Top


class TrajectoryProblem(AbstractProblem):
    """Launches with their cyclic coordinates: the state, the arena's path, the spin angle and the work of friction.

    The coordinates of the arena's frame are followed by the three components of a unit vector c across the axis, which
    moves with the axis without rotation about it, c' = (e x e') x c. The body's first axis is c turned about e by the
    spin angle, so every integrated component changes as slowly as the axis.

    `rest` are spin angle and work at the start, `None` where both are 0.
    """

    dynamics: Dynamics | StickSlip | ContactMode | AbstractRigidDynamics
    axial: Float[Array, "..."]
    state: Float[Array, "components ..."]
    cyclic: Float[Array, "components ..."]
    scales: Float[Array, "components ..."]
    rest: Float[Array, "2 ..."] | None = None

    @classmethod
    def of(cls, scene: Scene[Top], launch: Launch, cells: int | None = None) -> "TrajectoryProblem":
        """The run of one launch, or the runs of some cells, whose numbers are scalars or one per cell."""
        return _problem(scene, launch, cells)

    @property
    def leading(self) -> int:
        return len(self.state)

    @property
    def up_to_path(self) -> int:
        """Number of components of state and path, counted from the first; those behind them are for rotation and work."""
        return len(self.state) + len(self.cyclic) - 3

    def start(self) -> tuple[Float[Array, "components ..."], Float[Array, "components ..."]]:
        rest = jnp.zeros((2, *self.state.shape[1:])) if self.rest is None else self.rest
        return jnp.concatenate([self.state, self.cyclic, rest]), self.scales

    def field(self, time: Float[Array, "..."], state: Float[Array, "components ..."]) -> Any:
        lean, cyclic = state[: len(self.state)], tuple(state[len(self.state) : -2])
        motion = self.dynamics.motion(lean)
        path, across = cyclic[:-3], cyclic[-3:]
        _, e, L, _ = parts(lean)
        path_rate = self.dynamics.frame.cyclic_rate(path, motion.velocity, motion.turning)
        if isinstance(self.dynamics, AbstractRigidDynamics):
            turns = sum_vectors(motion.rate[2:5], scale(-1.0, carried(e, motion.turning)))
            falls = -dot(turns, across)
        else:
            falls = -dot(cross(L, e), across) * self.dynamics.per_transverse
        across_rate = sum_vectors(scale(falls, e), carried(across, motion.turning))
        quadratures = (*path_rate, *across_rate, motion.spin_momentum / self.axial, motion.friction_power)
        return stacked((*motion.rate, *quadratures), state)

    def event_function(self, state: Float[Array, "components ..."]) -> None:
        return None

    def domain_margin(self, time: Float[Array, "..."], state: Float[Array, "components ..."]) -> Float[Array, "..."]:
        return self.dynamics.contact_margin(state[: len(self.state)])

    def margins(self, time: Float[Array, "..."], state: Float[Array, "components ..."]) -> tuple[Any, ...]:
        return self.dynamics.margins(state[: len(self.state)])


@compiled_setup
def _problem(scene: Scene[Top], launch: Launch, cells: int | None) -> TrajectoryProblem:
    size, weight = scene.body.size, scene.body.mass * scene.gravity
    sine, cosine = jnp.sin(launch.theta), jnp.cos(launch.theta)
    across = (cosine * jnp.cos(launch.azimuth), cosine * jnp.sin(launch.azimuth), -sine)
    cyclic = (*scene.start(launch)[1], *across)
    unit = jnp.ones(())
    extra = jnp.stack(jnp.broadcast_arrays(*[size] * (len(cyclic) - 3), unit, unit, unit, unit, weight * size))
    cyclic = jnp.stack(jnp.broadcast_arrays(*cyclic))
    rows = (scene.state(launch), cyclic, scene.scales(launch), extra)
    if cells is not None:
        rows = tuple(jnp.broadcast_to(row.reshape(len(row), -1), (len(row), cells)) for row in rows)
    # The equations of a rigid body give its spin itself in place of the angular momentum about the axis.
    axial = jnp.ones(()) if isinstance(scene.body, AbstractRigidBody) else scene.body.I3
    return TrajectoryProblem(scene.dynamics, axial, rows[0], rows[1], jnp.concatenate(rows[2:]))


def trajectory_problem(modules: tuple[Scene, Launch], cells: int | None) -> TrajectoryProblem:
    """The problem of a scene and a launch."""
    return TrajectoryProblem.of(*modules, cells)
