"""Runs sampled at given times, as functions for `jit`, `vmap`, `grad`, `jvp` and their compositions."""

import diffrax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from nonholonomic.derivatives import SampledRun, sampled_run, sampled_run_by_diffrax
from nonholonomic.integration import Settings
from nonholonomic.integration.status import FAILED, LEFT_DOMAIN, Status

from ..model.contact_dynamics import LOSSES
from ..model.launch import Launch
from ..model.scene import Scene
from ..modes.trajectory_problem import TrajectoryProblem, trajectory_problem
from .energy import has_grown


def ended(
    run: TrajectoryProblem,
    scene: Scene,
    state: Float[Array, "components ..."],
    left_domain: Bool[Array, "..."],
    failed: Bool[Array, "..."],
    tolerance: float | Float[Array, ""],
) -> Int[Array, "..."]:
    """The `Status` of a run that has ended, as an integer: unresolved if the run has gained energy (`energy.py`)."""
    state = state[: run.leading]
    loss_codes = jnp.array([int(status) for status in LOSSES])[run.problem.dynamics.loss(state)]
    energy_grew = has_grown(scene, scene.energy(run.problem.states), scene.energy(state), tolerance)
    ended = jnp.where(energy_grew, int(Status.UNRESOLVED), jnp.where(left_domain, loss_codes, int(Status.COMPLETED)))
    return jnp.where(failed, int(Status.FAILED), ended)


def sampled(
    scene: Scene,
    launch: Launch,
    times: Float[Array, " times"],
    t1: Float[Array, ""],
    settings: Settings,
    adjoint: diffrax.AbstractAdjoint | None,
) -> SampledRun:
    """Simulate one launch inside a transformation and sample it; the `status` is a `Status` as a float.

    **Arguments:** as for `simulate`.
    """
    run = trajectory_problem((scene, launch))
    if adjoint is None:
        samples = sampled_run(trajectory_problem, (scene, launch), times, t1, settings)
    else:
        samples = sampled_run_by_diffrax(run, times, t1, settings, adjoint)
    codes = (samples.status == LEFT_DOMAIN, samples.status == FAILED)
    status = ended(run, scene, samples.end_state, *codes, settings.tolerance)
    return samples._replace(status=status)
