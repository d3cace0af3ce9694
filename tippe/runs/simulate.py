"""Simulate one launch of a top: a single run with its path, or a run inside a transformation."""

import dataclasses
from typing import Any

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from nonholonomic.compilation.xla_cpu import on_device
from nonholonomic.hybrid import BETWEEN, HybridOutcome, HybridPath, solve_hybrid_dense
from nonholonomic.integration import DenseSolution, Settings, explicit_tableau, follow
from nonholonomic.integration.checks import require_adaptive, require_adjoint, require_times
from nonholonomic.integration.status import FAILED, LEFT_DOMAIN, REACHED_END, Status
from nonholonomic.runs import sampled_if_legal
from nonholonomic.validation import as_number, is_traced, nan_unless, shown

from ..modes.airborne import FLYING
from .flight_trajectory import HybridTrajectory
from .run_kind import if_balanced
from .trajectory import Trajectory


def simulate_launch(
    model: Any,
    t1: Any,
    times: Any,
    tolerance: Any,
    solver: diffrax.AbstractSolver | None,
    adjoint: diffrax.AbstractAdjoint | None,
) -> Trajectory | HybridTrajectory:
    """The run of a `TopModel`. **Arguments:** as for `tippe.simulate`."""
    require_adaptive(solver)
    require_adjoint(adjoint)
    settings = Settings(tolerance, solver)
    if times is not None:
        times = as_number(times)
        require_times(times, t1)
    if is_traced((model, times, t1, tolerance)):
        return _traced(model, times, as_number(t1), settings, adjoint)
    if model.smooth:
        path = follow(model.problem(None, None), float(t1), settings)
    else:
        modes, first, state = model.modes(1, settings.tolerance, None, False)
        start = int(np.asarray(first)[0]), np.asarray(state)[:, 0]
        path = solve_hybrid_dense(modes, *start, float(t1), settings, counters=len(model.counters))
    run = _along(model, path, settings.tolerance)
    if times is None:
        return run
    times_reached = np.asarray(times)[np.asarray(times) <= float(run.end_time)]
    if not times_reached.size:
        raise ValueError(
            f"times = {shown(times)} are all after the end of the run at {float(run.end_time):.6g} s "
            f"({run.status}): pass earlier times, or omit `times` to get those of the steps"
        )
    return run.resampled(times_reached)


@eqx.filter_jit
def _ended(model: Any, outcome: HybridOutcome[Array], tolerance: Float[Array, ""]) -> Array:
    return model.ended(outcome, tolerance)[0]


def _status(model: Any, path: DenseSolution | HybridPath, tolerance: Any) -> str:
    """The word for how a single run has ended."""
    if isinstance(path, HybridPath):
        code, state, mode = path.status, path.state, path.mode
    else:
        code = FAILED if path.failed else LEFT_DOMAIN if path.left_domain else REACHED_END
        state, mode = np.asarray(path.states)[:, -1], 0
    one, none = np.ones(1), np.zeros(1, int)
    state, inf = np.asarray(state)[:, None], np.inf * one
    outcome = HybridOutcome(none + code, inf, one, state, none, none, none + mode, none[None])
    outcome = jax.tree.map(jnp.asarray, outcome)
    return Status(int(_ended(model, outcome, jnp.asarray(tolerance)))).word


def _along(model: Any, path: DenseSolution | HybridPath, tolerance: Any) -> Any:
    """The run along its path, at the times of its steps. A run whose energy does not balance the work of friction and
    impacts ends as "unresolved"."""
    scene, kind, times = model.scene, model.trajectories, path.times
    mode, counts = (path.numbers(times), path.counts) if isinstance(path, HybridPath) else (None, ())
    end = path.end_time if isinstance(path, HybridPath) and scene.contact == "hybrid" else on_device(times[-1])[0]
    status, start = _status(model, path, tolerance), scene.state(model.launch)
    run = kind(None, scene, None, None, None, None, status, end, dense=path, start=start, launch=model.launch)
    # NumPy slices the states, because JAX would compile each slice again for every number of steps.
    run = run.with_rows(times, np.asarray(path.states), mode)
    counted = {name: int(count) for name, count in zip(model.counters, counts, strict=True) if name == "sticks"}
    if scene.contact == "hybrid":
        assert isinstance(path, HybridPath)
        in_flight = BETWEEN if scene.flies_in_closed_form else FLYING
        segments = [segment for segment in path.segments if segment.number == in_flight and segment.end > segment.begin]
        hops = np.array([(segment.begin, segment.end) for segment in segments]).reshape(-1, 2)
        run = dataclasses.replace(run, hops=hops)
        # The remaining work is that of the impacts.
        in_contact = sum(kind.work_in(segment) for segment in path.segments)
        counted = {"impact_loss": float(in_contact - path.state[-1]), **counted}
    return if_balanced(run.with_stats(path, **counted), tolerance)


# Compiled as a whole even under a bare `vmap` or `grad`, which would otherwise dispatch each operation.
@eqx.filter_jit
def _traced(
    model: Any, times: Any, t1: Any, settings: Settings, adjoint: diffrax.AbstractAdjoint | None
) -> Trajectory | HybridTrajectory:
    """The run inside a transformation; NaN and the status "illegal" if a traced number is out of range."""
    if times is None:
        raise ValueError("times must be given inside jit, vmap and grad, where the number of steps is not known")
    scene = model.scene
    if not model.smooth:
        if adjoint is not None:
            name = "contact = 'hybrid'" if scene.contact == "hybrid" else "SetValuedCoulomb"
            raise ValueError(f"adjoint = {adjoint!r} must be omitted for {name}")
        explicit_tableau(settings.for_lanes)
    is_legal, run, settings = sampled_if_legal(model, times, t1, settings, adjoint=adjoint)
    outcome = run.outcome
    status = jnp.where(is_legal, model.ended(outcome, settings.tolerance)[0], int(Status.ILLEGAL))
    rejected, start = outcome.rejected[0], scene.state(model.launch)
    stats = {"accepted": outcome.steps[0] - rejected, "rejected": rejected}
    stats |= {name: count[0] for name, count in zip(model.counters, outcome.counts, strict=True)}
    kind, rows = model.trajectories, run.rows
    parts = kind.parts_of(rows, run.mode, len(start))
    if run.passive is not None:
        parts = {"states": rows, "cyclic": run.passive[:-2], "spin_angle": run.passive[-2], "work": run.passive[-1]}
    trajectory = kind(
        times,
        scene,
        **parts,
        status=status,
        end_time=outcome.end_time[0],
        stats=stats,
        start=start,
        launch=model.launch,
    )
    return eqx.tree_at(lambda run: (run.t, run.status), nan_unless(is_legal, trajectory), (times, status))
