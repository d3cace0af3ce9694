"""One run of a tippe top, with its path."""

from typing import Any

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from nonholonomic.geometry import scale, sum_vectors
from nonholonomic.hybrid import HybridPath, solve_hybrid_dense
from nonholonomic.integration import DenseSolution, Settings, explicit_tableau, follow
from nonholonomic.integration.checks import legal_run, require_adaptive, require_adjoint, require_times
from nonholonomic.integration.status import Status
from nonholonomic.progress import status_line
from nonholonomic.validation import (
    all_bounds,
    as_number,
    is_traced,
    legal,
    nan_unless,
    shown,
)
from nonholonomic.xla_cpu import on_device

from ..model.friction import length
from ..model.launch import Launch
from ..model.scene import Scene
from ..modes.sticking import contact_modes
from ..modes.trajectory_problem import TrajectoryProblem, trajectory_problem
from .airborne_trajectory import sampled_airborne, simulate_airborne
from .checks import check_run
from .energy import if_balanced, why_unbalanced
from .flight_trajectory import HybridTrajectory, sampled_hybrid, simulate_hybrid
from .observables import AbstractTrajectory, of_each_run
from .sampled import ended, sampled


class Trajectory(AbstractTrajectory):
    """A run of a tippe top, or a batch of runs, with the batch first.

    Vectors are given in the fixed frame (x, y, z) as arrays (times, 3); `azimuth` and `slip` refer to the moving frame
    (t1, t2, n) at the place where the top is. `position` and `velocity` are those of the sphere's centre, or of the
    centre of mass for other bodies; `contact` is the contact point, and `normal` the arena's normal there. `rotation`
    (times, 3, 3) rotates the body's axes to the fixed frame, and `angular_velocity` is its rate.

    - `status`: the word of a `Status`; inside a transformation, its integer. The run ends at `end_time`.
      "does_not_fit": a curvature of the arena reaches that of the top's sphere, which would then touch at other points,
      too. "jammed": the equation for the normal force has no solution, because friction pulls the top into the arena as
      strongly as the normal force pushes it out; this needs strong friction, a large offset and a slip along the axis.
      "unresolved": the energy grows, or does not balance, by more than 1e4 times the tolerance, relative to the energy.
      For numbers out of range, `status` is `Status.ILLEGAL`, and all results are NaN.
    - `stats`: accepted and rejected steps, the greatest drift of |e| and the greatest energy residual
      |E - E(0) - work of friction| [J]; with `SetValuedCoulomb`, also `sticks`, the number of changes from slip to
      rolling.

    **Example:**

    ```
    >>> import tippe
    >>> top = tippe.Top(mass=0.02, radius=0.02, offset=0.006, I1=2.994e-6, I3=3.2e-6)
    >>> scene = tippe.Scene(top, friction=tippe.Viscous(0.3))
    >>> run = tippe.simulate(scene, tippe.Launch(0.1, 155.0), t1=1.0, tolerance=1e-6)
    >>> later = run.at([0.25, 0.5])
    >>> later.position.shape, later.axis.shape
    ((2, 3), (2, 3))
    >>> data = run.to_table()
    >>> data.units["normal_force"], data.label("theta")
    ('N', 'inclination θ [rad]')

    ```
    """

    t: Float[Array, " times"]
    scene: Scene
    states: Float[Array, "components times"]
    cyclic: Float[Array, "cyclic times"]
    spin_angle: Float[Array, " times"]
    work: Float[Array, " times"]
    # The end of the run; not needed where only the times are read, as in a page.
    status: Any = None
    end_time: Any = None
    stats: dict[str, Any] = eqx.field(default_factory=dict)
    dense: Any = None

    @property
    def above(self) -> tuple[None, None]:
        """`None`: the contact persists, so there is no distance from the arena."""
        return None, None

    @of_each_run
    def energy(self) -> Float[Array, " times"]:
        """Kinetic and potential energy [J]."""
        return self.scene.energy(self.states)

    @of_each_run
    def normal_force(self) -> Float[Array, " times"]:
        """Normal force [N]."""
        return self.scene.normal_force(self.states)

    @of_each_run
    def reaction(self) -> Float[Array, "times 3"]:
        """Force of the arena on the body [N]: normal force and friction."""
        motion = self.scene.dynamics.motion(self.states)
        f1, f2 = motion.friction.force
        return self._fixed(scale(motion.normal_force, (f1, f2, 1.0)))

    @of_each_run
    def grip(self) -> Float[Array, " times"]:
        """Friction over normal force [1]: the least coefficient of friction that the contact needs."""
        motion = self.scene.dynamics.motion(self.states)
        f1, f2 = (jnp.zeros_like(self.t) if part is None else part for part in motion.friction.force)
        return length(f1, f2)

    @of_each_run
    def normal_spin(self) -> Float[Array, " times"]:
        """Angular velocity about the arena's normal [rad/s]."""
        return self.scene.angular_velocity(self.states)[2]

    @of_each_run
    def contact(self) -> Float[Array, "times 3"]:
        """The point at which the top touches the arena [m]."""
        frame, places = self.scene.frame, (self._place, self._path)
        foot = sum_vectors(frame.position(*places), scale(-frame.distance, frame.axes(*places)[2]))
        return jnp.stack(foot, axis=-1)

    @of_each_run
    def slip(self) -> Float[Array, "times 2"]:
        """Velocity of the contact point along the arena, in the moving frame [m/s]."""
        return self.scene.slip_velocity(self.states).T

    def __str__(self) -> str:
        unresolved = isinstance(self.status, str) and self.status == Status.UNRESOLVED.word
        return super().__str__() + (f"\n  unresolved: {why_unbalanced(self)}" if unresolved else "")

    def resampled(self, times: Float[np.ndarray, " times"]) -> "Trajectory":
        """The same run at other times, without checking them."""
        arrays = on_device(times, *parts_of(len(self.states), self.dense.at(times)))
        return eqx.tree_at(lambda run: (run.t, run.states, run.cyclic, run.spin_angle, run.work), self, arrays)


@status_line("simulating")
def simulate(
    scene: Scene,
    launch: Launch,
    t1: float | Float[Array, ""],
    times: Any = None,
    tolerance: float | Float[Array, ""] = 1e-9,
    solver: diffrax.AbstractSolver | None = None,
    adjoint: diffrax.AbstractAdjoint | None = None,
) -> Trajectory | HybridTrajectory:
    """Simulate one launch until `t1`, or until contact is lost or jams; with `contact="hybrid"`, through flights and
    impacts.

    Inside a transformation (`jit`, `vmap`, `grad`) `times` must be given; entries after the end of the run (see
    `status` and `end_time`) are then NaN. A batch from `vmap` is solved as one ensemble, like the cells of a table. If
    a program under `jit` does not use path, rotation or work, they are not integrated.

    **Arguments:**

    - `scene`, `launch`: all their numbers must be scalars.
    - `t1`: horizon [s].
    - `times`: times of the result [s], increasing, within [0, t1]; by default those of the accepted steps. Outside
      transformations, times after the end of the run are omitted; `Trajectory.at` returns the run at other times.
    - `tolerance`: relative tolerance, in [1e-14, 1e-2]; absolute tolerances are `tolerance`/10 in units of `Scene.scales`.
    - `solver`: any adaptive solver of Diffrax for ordinary differential equations; by default `Dopri8()`; inside
      transformations without an `adjoint`, `nonholonomic.integration.Oscillatory8()`.
    - `adjoint`: an adjoint method of Diffrax, such as `RecursiveCheckpointAdjoint()`, with which Diffrax integrates a
      traced run. This is cheaper for a loss function with many parameters, but can miss a loss of contact shorter than
      a step. By default, this package computes forward and reverse derivatives, at the cost of about one run for each
      parameter.

    **Returns:** a `Trajectory`, or a `HybridTrajectory` for a hybrid scene.

    **Raises:** `ValueError` for arguments out of range, and for times that are all after the end of the run. Inside a
    transformation, also for a law with several modes (`SetValuedCoulomb`). For a hybrid scene inside a transformation,
    also for an `adjoint`, for a solver that is not an explicit Runge-Kutta method, for derivatives with respect to
    `times`, and for second derivatives.

    **Example:**

    ```
    >>> import tippe
    >>> top = tippe.Top(mass=0.02, radius=0.02, offset=0.006, I1=2.994e-6, I3=3.2e-6)
    >>> scene = tippe.Scene(top, friction=tippe.Viscous(0.3))
    >>> run = tippe.simulate(scene, tippe.Launch(0.1, 155.0), t1=1.0, tolerance=1e-6)
    >>> print(f"{run.theta[-1]:.3f} rad, {run.spin[-1]:.1f} rad/s, {run.status}")
    0.025 rad, 154.0 rad/s, completed

    ```
    """
    check_run(scene, launch, t1, tolerance, "jax.vmap(simulate) takes lists, and so does trajectory_table")
    require_adaptive(solver)
    require_adjoint(adjoint)
    settings = Settings(tolerance, solver)
    if times is not None:
        times = as_number(times)
        require_times(times, t1)
    if any(is_traced(leaf) for leaf in jax.tree.leaves((scene, launch, times, t1, tolerance))):
        return _legal_or_nan(scene, launch, times, as_number(t1), settings, adjoint)
    if scene.contact == "hybrid":
        solve_flights_dense = simulate_hybrid if scene.flies_in_closed_form else simulate_airborne
        return solve_flights_dense(scene, launch, float(t1), times, settings)
    run = trajectory_problem((scene, launch))
    path = stick_slip_path(run, t1, settings) if scene.friction.set_valued else follow(run, float(t1), settings)
    trajectory = _as_trajectory(scene, run, path, settings.tolerance)
    if times is None:
        return trajectory
    times_reached = np.asarray(times)[np.asarray(times) <= float(trajectory.end_time)]
    if not times_reached.size:
        raise ValueError(
            f"times = {shown(times)} are all after the end of the run at {float(trajectory.end_time):.6g} s "
            f"({trajectory.status}): pass earlier times, or omit `times` to get those of the steps"
        )
    return trajectory.at(times_reached)


def stick_slip_path(run: TrajectoryProblem, t1: float | Float[Array, ""], settings: Settings) -> HybridPath:
    """One run in a scene with `SetValuedCoulomb`, mode by mode, until `t1` or until contact is lost."""
    modes, first, state = contact_modes(run, settings.tolerance)
    return solve_hybrid_dense(modes, int(first[0]), state[:, 0], float(t1), settings, counters=1)


# Compiled as a whole even under a bare `vmap` or `grad`, which would otherwise dispatch each operation.
@eqx.filter_jit
def _legal_or_nan(
    scene: Scene,
    launch: Launch,
    times: Any,
    t1: Any,
    settings: Settings,
    adjoint: diffrax.AbstractAdjoint | None,
) -> Trajectory | HybridTrajectory:
    """The result of `_traced`, or NaN and the status "illegal" if a traced number is out of range."""
    if times is None:
        # This raises the error that explains the problem.
        return _traced(scene, launch, times, t1, settings, adjoint)
    bounds = (*all_bounds(scene), *all_bounds(launch), *scene.start_bounds(launch))
    is_legal, t1, tolerance = legal_run(legal(bounds), t1, settings.tolerance, times)
    settings = settings.with_tolerance(tolerance)
    if adjoint is not None:
        # An illegal run has zero length, but Diffrax would differentiate it.
        scene, launch = nan_unless(is_legal, (scene, launch))
    trajectory = _traced(scene, launch, times, t1, settings, adjoint)
    status = jnp.where(is_legal, trajectory.status, int(Status.ILLEGAL))
    return eqx.tree_at(lambda run: (run.t, run.status), nan_unless(is_legal, trajectory), (times, status))


def _traced(
    scene: Scene,
    launch: Launch,
    times: Any,
    t1: Any,
    settings: Settings,
    adjoint: diffrax.AbstractAdjoint | None,
) -> Trajectory | HybridTrajectory:
    if scene.friction.set_valued:
        raise ValueError(
            f"friction = {type(scene.friction).__name__} must be a law with a single mode inside jit, vmap and grad"
        )
    if times is None:
        raise ValueError("times must be given inside jit, vmap and grad, where the number of steps is not known")
    if scene.contact == "hybrid":
        if adjoint is not None:
            raise ValueError(f"adjoint = {shown(adjoint)} must be omitted for contact = 'hybrid'")
        explicit_tableau(settings.for_lanes)
        return (sampled_hybrid if scene.flies_in_closed_form else sampled_airborne)(scene, launch, times, t1, settings)
    samples = sampled(scene, launch, times, t1, settings, adjoint)
    status = samples.status.astype(int)
    stats = {"accepted": samples.accepted.astype(int), "rejected": samples.rejected.astype(int)}
    assert samples.quadratures is not None
    quadratures = samples.quadratures.T
    parts = (samples.states.T, quadratures[:-2], quadratures[-2], quadratures[-1])
    return Trajectory(times, scene, *parts, status, samples.end_time, stats)


def parts_of(lean: int, states: Any) -> tuple[Any, Any, Any, Any]:
    """State, with its number of components, cyclic coordinates, spin angle and work, of an array (components, times)."""
    return states[:lean], states[lean:-2], states[-2], states[-1]


_ended = eqx.filter_jit(ended)


def _as_trajectory(
    scene: Scene, run: TrajectoryProblem, path: DenseSolution | HybridPath, tolerance: float | Float[Array, ""]
) -> Trajectory:
    # NumPy slices these arrays, because JAX would compile each slice again for every number of steps.
    states = np.asarray(path.states)
    times, end, last = on_device(path.times, path.times[-1], states[:, -1])
    codes = (jnp.asarray(path.left_domain), jnp.asarray(path.failed))
    status = Status(int(_ended(run, scene, last, *codes, jnp.asarray(tolerance)))).word
    counts = {"sticks": int(path.counts[0])} if isinstance(path, HybridPath) else {}
    lean, cyclic, spin_angle, work = on_device(*parts_of(run.leading, states))
    trajectory = Trajectory(times, scene, lean, cyclic, spin_angle, work, status, end, {}, path)
    return if_balanced(trajectory.with_stats(path, **counts), tolerance)
