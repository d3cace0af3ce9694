"""Runs sampled at given times, as functions for `jit`, `vmap`, `grad`, `jvp` and their compositions."""

from typing import NamedTuple

import diffrax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from nonholonomic.derivatives import sampled_run, sampled_run_by_diffrax
from nonholonomic.integration import FAILED, LEFT_DOMAIN, Settings, Status

from ..model.dynamics import LOSSES
from ..model.launch import Launch
from ..model.scene import Scene
from ..modes.trajectory_problem import TrajectoryProblem, trajectory_problem


def ended(
    run: TrajectoryProblem,
    state: Float[Array, "components ..."],
    left_domain: Bool[Array, "..."],
    failed: Bool[Array, "..."],
) -> Int[Array, "..."]:
    """The `Status` of a run that ended in some state, as an integer."""
    lost = jnp.array([int(status) for status in LOSSES])[run.dynamics.loss(state[: len(run.state)])]
    return jnp.where(left_domain, lost, jnp.where(failed, int(Status.FAILED), int(Status.COMPLETED)))


class Found(NamedTuple):
    """What is found of a run: `states`, and as `riding` what else a `TrajectoryProblem` carries, are NaN after the end;
    `status` is a `Status`, a float."""

    states: Float[Array, "components times"]
    riding: Float[Array, "riders times"]
    end_time: Float[Array, ""]
    status: Float[Array, ""]
    accepted: Float[Array, ""]
    rejected: Float[Array, ""]


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
    status = ended(run, found.end_state, found.status == LEFT_DOMAIN, found.status == FAILED)
    assert found.riding is not None
    return Found(found.states.T, found.riding.T, found.end_time, status, found.accepted, found.rejected)
