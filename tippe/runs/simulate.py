"""Simulate one launch of a top: a single run with its path, or a run inside a transformation."""

from typing import Any

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from nonholonomic.hybrid import BETWEEN, HybridOutcome, HybridPath, solve_hybrid_dense
from nonholonomic.integration import DenseSolution, Settings, explicit_tableau, follow
from nonholonomic.integration.checks import require_adaptive, require_adjoint, require_times
from nonholonomic.integration.status import FAILED, LEFT_DOMAIN, REACHED_END, Status
from nonholonomic.runs import sampled_if_legal
from nonholonomic.validation import as_number, is_traced, nan_unless, shown
from nonholonomic.xla_cpu import on_device

from ..modes.airborne import FLYING
from .flight_trajectory import HybridTrajectory
from .run_kind import if_balanced
from .trajectory import Trajectory, parts_of


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
    settings, scene = Settings(tolerance, solver), model.scene
    if times is not None:
        times = as_number(times)
        require_times(times, t1)
    if any(is_traced(leaf) for leaf in jax.tree.leaves((model, times, t1, tolerance))):
        return _traced(model, times, as_number(t1), settings, adjoint)
    if model.smooth:
        path = follow(model.problem(None, None), float(t1), settings)
    else:
        modes, first, state = model.modes(1, settings.tolerance, None, False)
        start = int(np.asarray(first)[0]), np.asarray(state)[:, 0]
        path = solve_hybrid_dense(modes, *start, float(t1), settings, counters=len(model.counters))
    if scene.contact == "hybrid":
        assert isinstance(path, HybridPath)
        return _with_flights(model, path, times, settings.tolerance)
    trajectory = _in_contact(model, path, settings.tolerance)
    if times is None:
        return trajectory
    times_reached = np.asarray(times)[np.asarray(times) <= float(trajectory.end_time)]
    if not times_reached.size:
        raise ValueError(
            f"times = {shown(times)} are all after the end of the run at {float(trajectory.end_time):.6g} s "
            f"({trajectory.status}): pass earlier times, or omit `times` to get those of the steps"
        )
    return trajectory.at(times_reached)


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


def _in_contact(model: Any, path: DenseSolution | HybridPath, tolerance: Any) -> Trajectory:
    """The run of a scene whose contact persists, along its path."""
    # NumPy slices these arrays, because JAX would compile each slice again for every number of steps.
    states = np.asarray(path.states)
    times, end = on_device(path.times, path.times[-1])
    counts = {"sticks": int(path.counts[0])} if isinstance(path, HybridPath) else {}
    lean = len(model.scene.state(model.launch))
    lean, cyclic, spin_angle, work = on_device(*parts_of(lean, states))
    status = _status(model, path, tolerance)
    start = model.scene.state(model.launch)
    trajectory = Trajectory(times, model.scene, lean, cyclic, spin_angle, work, status, end, {}, path, start)
    return if_balanced(trajectory.with_stats(path, **counts), tolerance)


def _with_flights(model: Any, path: HybridPath, times: Any, tolerance: Any) -> HybridTrajectory:
    """The run of a hybrid scene along its path, at given times or at those of its steps.

    A run whose energy does not balance the work of friction and impacts ends as "unresolved".
    """
    kind: Any = model.flights
    scene = model.scene
    parts, contact = kind.parts_of(path.at(path.times)), kind.touching(path.numbers(path.times))
    in_flight = BETWEEN if scene.flies_in_closed_form else FLYING
    segments = [segment for segment in path.segments if segment.number == in_flight and segment.end > segment.begin]
    hops = np.array([(segment.begin, segment.end) for segment in segments]).reshape(-1, 2)
    status, start = _status(model, path, tolerance), scene.state(model.launch)
    run = kind(path.times, scene, *parts, contact, status, path.end_time, dense=path, hops=hops, start=start)
    in_contact = sum(kind.work_in(segment) for segment in path.segments)
    counts = {"sticks": int(path.counts[1])} if scene.friction.set_valued else {}
    # The remaining work is that of the impacts.
    run = run.with_stats(path, impact_loss=float(in_contact - path.state[-1]), **counts)
    run = if_balanced(run, tolerance)
    return run if times is None else run.resampled(np.asarray(times)[np.asarray(times) <= run.end_time])


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
    is_legal, run, settings = sampled_if_legal(model, None, times, t1, settings, adjoint=adjoint)
    outcome = run.outcome
    status = jnp.where(is_legal, model.ended(outcome, settings.tolerance)[0], int(Status.ILLEGAL))
    rejected, start = outcome.rejected[0], scene.state(model.launch)
    stats = {"accepted": outcome.steps[0] - rejected, "rejected": rejected}
    stats |= {name: count[0] for name, count in zip(model.counters, outcome.counts, strict=True)}
    kind: Any = Trajectory
    if scene.contact == "hybrid":
        kind = model.flights
        parts = (*kind.parts_of(run.rows), kind.touching(run.mode))
    elif run.passive is None:
        parts = parts_of(len(start), run.rows)
    else:
        parts = (run.rows, run.passive[:-2], run.passive[-2], run.passive[-1])
    trajectory = kind(times, scene, *parts, status, outcome.end_time[0], stats, start=start)
    return eqx.tree_at(lambda run: (run.t, run.status), nan_unless(is_legal, trajectory), (times, status))
