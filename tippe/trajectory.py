"""One run of a tippe top, with its path."""

from collections.abc import Callable, Iterator
from typing import Any

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float

from nonholonomic.geometry import dot
from nonholonomic.integration import follow
from nonholonomic.validation import Bound, all_bounds, as_number, is_traced, legal, nan_unless, require, require_all

from .inversion import ABSOLUTE, check_run, run_bounds
from .launch import Launch
from .phases.flight_trajectory import HybridTrajectory, simulate_hybrid
from .phases.stick_slip_path import follow_stick_slip
from .sampled import STATUS, TrajectoryProblem, ended, sampled, sampled_by_diffrax
from .scene import Scene
from .state import AXIS, MOMENTUM, PLACE


def _of_each_run(function: Callable[["Trajectory"], Array]) -> property:
    """A property of one run that is, for a batch of runs as `vmap` returns it, the property of each."""

    def get(self):
        mapped = function
        for _ in range(self.t.ndim - 1):
            mapped = eqx.filter_vmap(mapped)
        return mapped(self)

    return property(get, doc=function.__doc__)


class Trajectory(eqx.Module):
    """A run of a tippe top, or a batch of runs, with the batch first.

    Vectors are given in the fixed frame (x, y, z) as arrays (times, 3); `azimuth` and `slip` refer to the moving frame
    (t1, t2, n) at the place where the top is. `position` and `velocity` are those of the sphere's centre.

    `status` is "reached t1", "contact_lost", "failed" or "jammed"; inside a transformation it is a code 0, 1, 2, 3, or 4,
    "illegal", for numbers out of range, for which everything is NaN. The run ends at `end_time`. It is jammed where the
    equation for the normal force ceases to have a solution, because friction pulls the top into the arena as hard as the
    normal force pushes it out: strong friction, a large offset and a slip along the axis do that. `stats` holds accepted and
    rejected steps, the greatest drift of |e| and the greatest energy residual |E - E(0) - work of friction| [J]; with
    `SetValuedCoulomb` also `sticks`, how often a slip has turned into rolling.
    """

    t: Float[Array, " times"]
    scene: Scene
    states: Float[Array, "components times"]
    cyclic: Float[Array, "cyclic times"]
    spin_angle: Float[Array, " times"]
    work: Float[Array, " times"]
    status: Any
    end_time: Float[Array, ""]
    stats: dict[str, Any]
    dense: Any

    @_of_each_run
    def theta(self) -> Float[Array, " times"]:
        """Angle from the normal to the axis [rad]."""
        return self.scene.theta(self.states)

    @_of_each_run
    def eta(self) -> Float[Array, " times"]:
        """Angle of the place from the arena's lowest point [rad]; 0 on the plane."""
        return self.scene.surface.angle(tuple(self.states[PLACE]), tuple(self.cyclic))

    @_of_each_run
    def azimuth(self) -> Float[Array, " times"]:
        """Direction in which the axis leans [rad], from t1 towards t2, in (-pi, pi]."""
        axis = self.states[AXIS]
        return jnp.arctan2(axis[1], axis[0])

    @_of_each_run
    def spin(self) -> Float[Array, " times"]:
        """Angular velocity about the axis [rad/s]."""
        return self.scene.spin(self.states)

    @_of_each_run
    def axis(self) -> Float[Array, "times 3"]:
        """The unit vector e along the axis."""
        return self._fixed(tuple(self.states[AXIS]))

    @_of_each_run
    def angular_momentum(self) -> Float[Array, "times 3"]:
        """Angular momentum about the centre of mass [kg m^2/s]."""
        return self._fixed(tuple(self.states[MOMENTUM]))

    @_of_each_run
    def velocity(self) -> Float[Array, "times 3"]:
        """Velocity of the sphere's centre [m/s]."""
        V = self.scene.dynamics.motion(self.states).velocity
        return self._fixed((*V, jnp.zeros_like(V[0])))

    @_of_each_run
    def position(self) -> Float[Array, "times 3"]:
        """Position of the sphere's centre [m]; the plane is z = 0, the cylinder's axis x = z = 0."""
        foot = self.scene.surface.position(tuple(self.states[PLACE]), tuple(self.cyclic))
        normal = self.scene.surface.frame(tuple(self.states[PLACE]), tuple(self.cyclic))[2]
        return jnp.stack([q + self.scene.body.radius * n for q, n in zip(foot, normal, strict=True)], axis=-1)

    @_of_each_run
    def energy(self) -> Float[Array, " times"]:
        """Kinetic and potential energy [J]."""
        return self.scene.energy(self.states)

    @_of_each_run
    def jellett(self) -> Float[Array, " times"]:
        """Jellett's quantity [kg m^3/s]; constant on the plane where friction acts at a point."""
        return self.scene.jellett(self.states)

    @_of_each_run
    def normal_force(self) -> Float[Array, " times"]:
        """Normal force [N]."""
        return self.scene.normal_force(self.states)

    @_of_each_run
    def slip(self) -> Float[Array, "times 2"]:
        """Velocity of the contact point along the arena, in the moving frame [m/s]."""
        return self.scene.slip_velocity(self.states).T

    def at(self, times: Float[ArrayLike, " times"]) -> "Trajectory":
        """The same run at other times, from the dense output.

        **Arguments:** `times`: increasing, within [0, `end_time`] [s].

        **Raises:** `ValueError` for times outside the run, or if the run was made inside a transformation.
        """
        if self.dense is None:
            raise ValueError("a run made inside jit, vmap or grad has no dense output: hand `times` to simulate")
        times = np.asarray(times, dtype=float)
        require(times, "times", at_least=0.0, at_most=self.end_time, why="the run ends there")
        _check_increasing(times)
        return _cut(self, times, self.dense.at(times))

    def _fixed(self, vector: tuple[Array, Array, Array]) -> Float[Array, "times 3"]:
        frame = self.scene.surface.frame(tuple(self.states[PLACE]), tuple(self.cyclic))
        return jnp.stack([dot(vector, directions) for directions in zip(*frame, strict=True)], axis=-1)

    def __str__(self) -> str:
        if is_traced(self.t) or self.t.ndim > 1:
            return f"Trajectory of {self.t.shape} times"
        end = f"{float(self.end_time):.6g} s"
        ending = {"reached t1": f"ran to {end}", "contact_lost": f"lost contact at {end}", "jammed": f"jammed at {end}"}
        lines = [
            f"Trajectory of {len(self.t)} times, {ending.get(self.status, f'failed at {end}')}",
            f"  theta: {float(self.theta[0]):.6g} to {float(self.theta[-1]):.6g} rad",
        ]
        if "accepted" in self.stats:
            lines.append(f"  steps: {self.stats['accepted']} accepted, {self.stats['rejected']} rejected")
            lines.append(f"  drift of |e|: {self.stats['axis_drift']:.1e}")
            lines.append(f"  energy residual: {self.stats['energy_residual']:.1e} J of {float(self.energy[0]):.4g} J")
        return "\n".join(lines)

    def __repr__(self) -> str:
        return str(self)


def simulate(
    scene: Scene,
    launch: Launch,
    t1: float,
    times: Any = None,
    tolerance: float = 1e-9,
    solver: diffrax.AbstractSolver | None = None,
    adjoint: diffrax.AbstractAdjoint | None = None,
) -> Trajectory | HybridTrajectory:
    """Run one launch until `t1`, or until contact is lost or jams; through flights and impacts if its contact is "hybrid".

    Inside a transformation (`jit`, `vmap`, `grad`) `times` must be given; entries after the end of the run are then
    NaN, and `status` and `end_time` say so. A batch, as `vmap` makes it, runs as the cells of one block, as tables do.

    **Arguments:**

    - `scene`, `launch`: every number a scalar.
    - `t1`: horizon [s].
    - `times`: times of the result [s], increasing, within [0, t1]; by default those of the accepted steps. Outside of
      transformations those after the end of the run are left out, and `Trajectory.at` gives others.
    - `tolerance`: relative tolerance; absolute tolerances are `tolerance`/10 in units of `Scene.scales`.
    - `solver`: any solver of Diffrax, `Dopri8()` by default.
    - `adjoint`: by default the derivatives are the package's own, forward and reverse, at the cost of about one run for each
      parameter; with one of Diffrax's, such as `RecursiveCheckpointAdjoint()`, Diffrax integrates a traced run, which pays if a
      loss is differentiated by many parameters.

    **Returns:** a `Trajectory`, for a hybrid scene a `HybridTrajectory`.

    **Raises:** `ValueError` for arguments out of range, and for a hybrid scene inside a transformation.
    """
    check_run(scene, launch, t1, tolerance)
    solver = diffrax.Dopri8() if solver is None else solver
    if not isinstance(solver, diffrax.AbstractSolver):
        raise ValueError(f"solver = {solver!r} must be a solver of Diffrax, such as Dopri8()")
    if times is not None:
        times = as_number(times)
        require_all(times_bounds(times, t1))
        _check_increasing(times)
    if scene.contact == "hybrid":
        if any(is_traced(leaf) for leaf in jax.tree.leaves((scene, launch, times, t1))):
            raise ValueError("contact = 'hybrid' must be 'stop' inside jit, vmap and grad")
        return simulate_hybrid(scene, launch, float(t1), times, tolerance, solver)
    if any(is_traced(leaf) for leaf in jax.tree.leaves((scene, launch, times, t1, tolerance))):
        return _legal_or_nan(scene, launch, times, as_number(t1), as_number(tolerance), solver, adjoint)
    run = TrajectoryProblem.of(scene, launch)
    through = follow_stick_slip if scene.friction.set_valued else follow
    followed = through(run, float(t1), solver=solver, rtol=tolerance, atol=ABSOLUTE * tolerance)
    trajectory = _as_trajectory(scene, run, followed)
    if times is None:
        return trajectory
    return trajectory.at(np.asarray(times)[np.asarray(times) <= float(trajectory.end_time)])


def _check_increasing(times: Any) -> None:
    if np.ndim(times) != 1 or np.shape(times)[0] == 0:
        raise ValueError(f"times must be a non-empty list, not of shape {np.shape(times)}")
    if not is_traced(times) and np.any(np.diff(times) <= 0.0):
        raise ValueError("times must increase")


def times_bounds(times: Any, t1: Any) -> Iterator[Bound]:
    """The range of the times of output [s]."""
    yield Bound(times, "times", at_least=0.0, at_most=t1)


# Compiled as a whole even under a bare `vmap` or `grad`, which would otherwise dispatch each operation.
@eqx.filter_jit
def _legal_or_nan(scene: Scene, launch: Launch, times: Any, t1: Any, tolerance: Any, *options: Any) -> Trajectory:
    """What `_traced` gives, or NaN and the status "illegal" where a traced number is out of range."""
    if times is None:
        # It raises the error that says so.
        return _traced(scene, launch, times, t1, tolerance, *options)
    bounds = (*all_bounds(scene), *all_bounds(launch), *run_bounds(t1, tolerance), *times_bounds(times, t1))
    may = jnp.all(legal(bounds)) & jnp.all(jnp.diff(times) > 0.0)
    # A run of illegal numbers might never reach its end, so it is given the horizon 0.
    found = _traced(scene, launch, times, jnp.where(may, t1, 0.0), tolerance, *options)
    status = jnp.where(may, found.status, STATUS.index("illegal"))
    return eqx.tree_at(lambda one: (one.t, one.status), nan_unless(may, found), (times, status))


def _traced(
    scene: Scene,
    launch: Launch,
    times: Any,
    t1: Any,
    tolerance: float,
    solver: diffrax.AbstractSolver,
    adjoint: diffrax.AbstractAdjoint | None,
) -> Trajectory:
    if scene.friction.set_valued:
        raise ValueError(
            f"friction = {type(scene.friction).__name__} must be a law without phases inside jit, vmap and grad"
        )
    if times is None:
        raise ValueError("times must be given inside jit, vmap and grad, where the number of steps is not known")
    run = TrajectoryProblem.of(scene, launch)
    if adjoint is None:
        found = sampled(scene, launch, times, t1, tolerance, solver)
    else:
        found = sampled_by_diffrax(run, times, as_number(t1), tolerance, solver, adjoint)
    status = found.status.astype(int)
    stats = {"accepted": found.steps.astype(int), "rejected": found.rejected.astype(int)}
    return Trajectory(times, scene, *_parts(run, found.states.T), status, found.end_time, stats, None)


def _parts(run: TrajectoryProblem, states: Float[Array, "components times"]) -> tuple[Any, Any, Any, Any]:
    """State, cyclic coordinates, spin angle and work."""
    lean = len(run.state)
    return states[:lean], states[lean:-2], states[-2], states[-1]


def _as_trajectory(scene: Scene, run: TrajectoryProblem, followed: Any) -> Trajectory:
    lean, cyclic, spin_angle, work = _parts(run, jnp.asarray(followed.states))
    status = STATUS[
        int(
            ended(
                run, jnp.asarray(followed.states[:, -1]), jnp.asarray(followed.guard_lost), jnp.asarray(followed.failed)
            )
        )
    ]
    energy = scene.energy(lean)
    stats = {
        "accepted": followed.accepted,
        "rejected": followed.rejected,
        "axis_drift": float(jnp.max(jnp.abs(jnp.sqrt(jnp.sum(lean[AXIS] ** 2, axis=0)) - 1.0))),
        "energy_residual": float(jnp.max(jnp.abs(energy - energy[0] - work))),
    }
    if scene.friction.set_valued:
        stats["sticks"] = followed.sticks
    times = jnp.asarray(followed.times)
    return Trajectory(times, scene, lean, cyclic, spin_angle, work, status, times[-1], stats, followed)


def _cut(trajectory: Trajectory, times: Any, states: Any) -> Trajectory:
    run_size = trajectory.states.shape[0]
    return eqx.tree_at(
        lambda one: (one.t, one.states, one.cyclic, one.spin_angle, one.work),
        trajectory,
        (
            jnp.asarray(times),
            *(jnp.asarray(part) for part in (states[:run_size], states[run_size:-2], states[-2], states[-1])),
        ),
    )
