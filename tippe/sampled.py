"""Runs sampled at given times, as functions for `jit`, `vmap`, `grad`, `jvp` and their compositions."""

from typing import Any, NamedTuple

import diffrax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from nonholonomic.derivatives import sampled_run, sampled_run_by_diffrax
from nonholonomic.geometry import carried, cross, dot, scale, sum_vectors
from nonholonomic.integration import FAILED, GUARD_LOST, AbstractProblem, Settings
from nonholonomic.xla_cpu import compiled_setup

from .dynamics import LOSSES, Dynamics, stacked
from .launch import Launch
from .phases import Kind, StickSlip
from .scene import Scene
from .state import parts


class TrajectoryProblem(AbstractProblem):
    """Launches with their cyclic coordinates: the state, the arena's path, the spin angle and the work of friction.

    Behind the coordinates of the arena's frame stand the three components of a unit vector c across the axis that turns with
    it and not about it, c' = (e x e') x c. The body's first axis is c turned about e by the spin angle: like this all that is
    integrated changes as slowly as the axis does.

    `rest` are spin angle and work at the start, `None` where both are 0.
    """

    dynamics: Dynamics | StickSlip | Kind
    axial: Float[Array, "..."]
    state: Float[Array, "components ..."]
    cyclic: Float[Array, "components ..."]
    scales: Float[Array, "components ..."]
    rest: Float[Array, "2 ..."] | None = None

    @classmethod
    def of(cls, scene: Scene, launch: Launch, cells: int | None = None) -> "TrajectoryProblem":
        """The run of one launch, or the runs of some cells, whose numbers are scalars or one per cell."""
        return _problem(scene, launch, cells)

    @property
    def leading(self) -> int:
        return len(self.state)

    @property
    def up_to_path(self) -> int:
        """How many components, from the first, state and path have; what is behind them is for rotation and work."""
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
        falls = -dot(cross(L, e), across) * self.dynamics.per_transverse
        across_rate = sum_vectors(scale(falls, e), carried(across, motion.turning))
        riding = (*path_rate, *across_rate, motion.spin_momentum / self.axial, motion.friction_power)
        return stacked((*motion.rate, *riding), state)

    def crossing(self, state: Float[Array, "components ..."]) -> None:
        return None

    def guard(self, time: Float[Array, "..."], state: Float[Array, "components ..."]) -> Float[Array, "..."]:
        return self.dynamics.contact_margin(state[: len(self.state)])


@compiled_setup
def _problem(scene: Scene, launch: Launch, cells: int | None) -> TrajectoryProblem:
    size, weight = scene.body.size, scene.body.mass * scene.gravity
    sine, cosine = jnp.sin(launch.theta), jnp.cos(launch.theta)
    across = (cosine * jnp.cos(launch.azimuth), cosine * jnp.sin(launch.azimuth), -sine)
    cyclic = (*scene.start(launch)[1], *across)
    one = jnp.ones(())
    extra = jnp.stack(jnp.broadcast_arrays(*[size] * (len(cyclic) - 3), one, one, one, one, weight * size))
    cyclic = jnp.stack(jnp.broadcast_arrays(*cyclic))
    rows = (scene.state(launch), cyclic, scene.scales(launch), extra)
    if cells is not None:
        rows = tuple(jnp.broadcast_to(row.reshape(len(row), -1), (len(row), cells)) for row in rows)
    return TrajectoryProblem(scene.dynamics, scene.body.I3, rows[0], rows[1], jnp.concatenate(rows[2:]))


#: How a run can end; inside a transformation the index stands for the word.
STATUS = ("reached t1", "contact_lost", "failed", "jammed", "illegal", "does_not_fit", "unresolved")


def ended(
    run: TrajectoryProblem,
    state: Float[Array, "components ..."],
    guard_lost: Bool[Array, "..."],
    failed: Bool[Array, "..."],
) -> Int[Array, "..."]:
    """The code in `STATUS` of a run that ended in some state."""
    codes = jnp.asarray([STATUS.index(word) for word in LOSSES])
    lost = codes[run.dynamics.loss(state[: len(run.state)])]
    return jnp.where(guard_lost, lost, jnp.where(failed, STATUS.index("failed"), STATUS.index("reached t1")))


class Found(NamedTuple):
    """What is found of a run: `states`, and as `riding` what else a `TrajectoryProblem` carries, are NaN after the end;
    `status` is a code in `STATUS`, a float."""

    states: Float[Array, "components times"]
    riding: Float[Array, "riders times"]
    end_time: Float[Array, ""]
    status: Float[Array, ""]
    accepted: Float[Array, ""]
    rejected: Float[Array, ""]


def trajectory_problem(modules: tuple[Scene, Launch], cells: int | None) -> TrajectoryProblem:
    """The problem of a scene and a launch."""
    return TrajectoryProblem.of(*modules, cells)


def sampled(
    scene: Scene,
    launch: Launch,
    times: Float[Array, " times"],
    t1: Float[Array, ""],
    settings: Settings,
    adjoint: diffrax.AbstractAdjoint | None,
) -> Found:
    """Run one launch inside a transformation and sample it.

    **Arguments:** as for `simulate`.
    """
    run = TrajectoryProblem.of(scene, launch)
    if adjoint is None:
        found = sampled_run(trajectory_problem, (scene, launch), times, t1, settings)
    else:
        found = sampled_run_by_diffrax(run, times, t1, settings, adjoint)
    status = ended(run, found.end_state, found.status == GUARD_LOST, found.status == FAILED)
    return Found(found.states.T, found.riding.T, found.end_time, status, found.accepted, found.rejected)
