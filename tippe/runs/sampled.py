"""Runs sampled at given times, as functions for `jit`, `vmap`, `grad`, `jvp` and their compositions."""

from typing import NamedTuple

import diffrax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from nonholonomic.derivatives import sampled_run, sampled_run_by_diffrax
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
    lost = jnp.array([int(status) for status in LOSSES])[run.problem.dynamics.loss(state)]
    grown = has_grown(scene, scene.energy(run.problem.states), scene.energy(state), tolerance)
    ended = jnp.where(grown, int(Status.UNRESOLVED), jnp.where(left_domain, lost, int(Status.COMPLETED)))
    return jnp.where(failed, int(Status.FAILED), ended)


class SampledContact(NamedTuple):
    """The samples of a run: `states`, and `quadratures` (the other components of a `TrajectoryProblem`), are NaN after
    the end; `status` is a `Status` as a float."""

    states: Float[Array, "components times"]
    quadratures: Float[Array, "quadratures times"]
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
) -> SampledContact:
    """Simulate one launch inside a transformation and sample it.

    **Arguments:** as for `simulate`.
    """
    run = trajectory_problem((scene, launch))
    if adjoint is None:
        samples = sampled_run(trajectory_problem, (scene, launch), times, t1, settings)
    else:
        samples = sampled_run_by_diffrax(run, times, t1, settings, adjoint)
    codes = (samples.status == LEFT_DOMAIN, samples.status == FAILED)
    status = ended(run, scene, samples.end_state, *codes, settings.tolerance)
    assert samples.quadratures is not None
    return SampledContact(
        samples.states.T, samples.quadratures.T, samples.end_time, status, samples.accepted, samples.rejected
    )
