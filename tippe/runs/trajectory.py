"""One run of a tippe top, with its path, in contact or through flights."""

import dataclasses
from typing import Any

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float

from nonholonomic.geometry import scale, sum_vectors
from nonholonomic.hybrid import BETWEEN, MOST_ROUNDS, HybridOutcome, HybridPath, Segment, solve_hybrid_dense
from nonholonomic.integration import DenseSolution, Settings, explicit_tableau, follow
from nonholonomic.integration.problem import UNRESOLVED, Status, require_adaptive, require_adjoint, require_times
from nonholonomic.runs.model import Number
from nonholonomic.runs.simulate import sampled_if_legal
from nonholonomic.text import shown
from nonholonomic.validation import ArrayOrList, as_number, is_traced, nan_unless

from ..friction import length
from ..model.scene import Scene
from ..model.stick_slip import StickSlip
from ..modes.airborne import FLYING, ON_STEM, STRIKING, as_if_flying, below, carried_frame, motion_on_stem
from ..modes.impact import BOTH, TOUCHING, balls
from ..modes.plane import MOST_BOUNCES, height
from ..modes.sticking import lifted
from .observables import AbstractTrajectory, Values, audited, of_each_run


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
        return self.scene.dynamics.normal_spin(self.states)

    @of_each_run
    def contact(self) -> Float[Array, "times 3"]:
        """The point at which the top touches the arena [m]."""
        pose = self._pose
        foot = sum_vectors(pose.position, scale(-self.scene.frame.distance, pose.axes[2]))
        return jnp.stack(foot, axis=-1)

    @of_each_run
    def slip(self) -> Float[Array, "times 2"]:
        """Velocity of the contact point along the arena, in the moving frame [m/s]."""
        return self.scene.slip_velocity(self.states).T

    def with_rows(self, times: Float[np.ndarray, " times"], rows: Values, mode: Values | None) -> "Trajectory":
        parts = {"t": times, **self.parts_of(self.scene, rows, mode, len(self.start))}
        # Unlike `jnp.asarray`, this compiles nothing for new shapes.
        parts = jax.device_put({name: np.asarray(part, dtype=float) for name, part in parts.items()})
        return dataclasses.replace(self, **parts)


# One run through contacts, flights and impacts, with its path.

#: A sphere is at the arena if its distance is below this fraction of its radius, at the end of a run.
NEAR = 1e-6


class HybridTrajectory(AbstractTrajectory):
    """A run through contacts, flights and impacts; vectors are arrays (times, 3) in the fixed frame (x, y, z).

    - `status`: "completed", "jammed" (as in `Trajectory`), "failed" or "unresolved"; the run ends at `end_time`.
      `print(run)` states why a run is unresolved: more than 10 000 flights in a row or 2000 contacts; a flight that does
      not end at the arena; an energy that grows or does not balance, by more than 1e4 times the tolerance, relative to
      the energy; or, for a top with a stem, contact of sphere and stem at once, on the level plane with so much friction
      that the forces are not determined, or at rest on any other arena.
    - `contact`: the sphere that touches at each time: 0 for the top's sphere, 1 for the stem's, 2 for both, -1 for none.
      At the time of an impact, values are those before the impact.
    - `distance`: distance of the top's own sphere from the arena [m], and its rate [m/s].
    - `theta`, `azimuth`, `slip`: over any arena, `theta` and `azimuth` refer to the frame at the foot, the point of the
      arena nearest to the centre of the top's own sphere, and `slip` to that at the foot of the touching sphere.
    - `hops`: start and end [s] of each flight until `end_time`, one row per flight; a table counts only the flights
      before the inversion. When the speed of bounces has decreased to 1e-5 sqrt(g R), the top counts as in contact,
      although the remaining bounces would take e / (1 - e) times as long as the last one (restitution e).
    - `stem_time`: when the stem of a top first carries it [s].
    - `work`: work of friction and of the impacts [J].
    - `stats`: accepted and rejected steps, the greatest drift of |e|, the greatest energy residual |E - E(0) - work| and
      the energy lost in impacts [J].
    - `rotation`, `angular_velocity`: as in `Trajectory`.

    Inside a transformation, `status` is the integer of the `Status`, `hops` is `None`, and `stats["hops"]` is the number
    of flights. First derivatives with respect to the scene and the launch pass through flights and impacts. They are
    NaN after a grazing event, because within the tolerance such an event may not happen.

    **Example:**

    ```
    >>> import tippe
    >>> top = tippe.Top(mass=0.02, radius=0.02, offset=0.006, I1=2.994e-6, I3=3.2e-6)
    >>> scene = tippe.Scene(top, friction=tippe.Viscous(0.3), contact="hybrid")
    >>> run = tippe.simulate(scene, tippe.Launch(0.1, 155.0), t1=0.1, tolerance=1e-6)
    >>> int(run.contact[0]), len(run.hops)
    (0, 0)

    ```
    """

    distance: Any = None
    contact: Any = None
    hops: Float[np.ndarray, "hops 2"] | None = None

    by_time = (*AbstractTrajectory.by_time, "distance", "contact")

    @property
    def above(self) -> tuple[Float[np.ndarray, " times"], Float[np.ndarray, " times"]]:
        """Distance of the top's own sphere from the arena [m] and its rate [m/s]."""
        return self.distance[0], self.distance[1]

    @property
    def inversion_time(self) -> float:
        return self.stem_time if self.scene.has_stem else super().inversion_time

    @property
    def stem_time(self) -> float:
        """Time [s] at which the stem first carries the top, as it bears a force or, in a bounce, an impulse; infinite if
        the stem does not touch by the end, or if there is no stem.

        **Raises:** as for `inversion_time`.
        """
        if self.dense is None:
            raise ValueError("a run made inside jit, vmap or grad has no dense output: use tippe.inversion_time there")
        if not self.scene.has_stem:
            return np.inf
        segments = self.dense.segments
        on_stem = [segment.begin for segment in segments if self.touching(self.scene, np.asarray(segment.number)) >= 1]
        # The stem may bounce before it slides. Values at the end of a flight are those before the impact.
        ends = np.unique([segment.end for segment in segments])
        first = min([*on_stem, np.inf])
        ends = ends[ends < min(first, self.end_time)]
        if not ends.size:
            return float(first)
        strokes = ends[np.asarray(self.resampled(ends)._stem_gap) < TOUCHING * float(self.scene.body.radius)]
        return float(min([*strokes, first]))

    @of_each_run
    def theta_rate(self) -> Float[Array, " times"]:
        """Rate of change of theta [rad/s]."""
        dynamics = self.scene.dynamics
        # theta changes with velocities only, so rolling and slipping do not differ.
        dynamics = dynamics.slipping if isinstance(dynamics, StickSlip) else dynamics
        if not self.scene.flies_in_closed_form:
            # The frame moves with the centre of the top's sphere, also in flight.
            frame = dataclasses.replace(carried_frame(self.scene), distance=self.scene.body.radius + self.above[0])
            dynamics = dataclasses.replace(dynamics, frame=frame)
        return jax.jvp(self.scene.theta, (self.states,), (dynamics.field(self.states),))[1]

    @of_each_run
    def _stem_gap(self) -> Any:
        """Distance of the stem from the arena [m]."""
        main, stem = balls(self.scene.body)
        if self.scene.flies_in_closed_form:
            return self.above[0] + height(main, stem, self.states)
        return below(self.scene, as_if_flying(self.scene, self.states, self.above), stem).gap

    @of_each_run
    def energy(self) -> Float[Array, " times"]:
        """Kinetic energy plus weight times the height of the centre of mass [J]."""
        return self.scene.energy(self.states) + lifted(self.scene, self.states, *self.above)

    @of_each_run
    def normal_force(self) -> Float[Array, " times"]:
        """Normal force [N]; 0 in flight. If both spheres touch, this is the sum of both forces, the weight."""
        force = self.scene.normal_force(self.states)
        if self.scene.has_stem:
            on_stem = motion_on_stem(self.scene, self.states, self.above)
            force = jnp.where(self.contact == 1, on_stem.normal_force, force)
            force = jnp.where(self.contact == BOTH, self.scene.body.mass * self.scene.gravity, force)
        return jnp.where(self.contact < 0, 0.0, force)

    @of_each_run
    def slip(self) -> Float[Array, "times 2"]:
        """Velocity along the tangent plane of the point of a sphere that is closest to the arena [m/s]: of the stem's
        sphere while it alone touches, otherwise of the top's own."""
        slip = self.scene.slip_velocity(self.states)
        if self.scene.has_stem:
            of_stem = motion_on_stem(self.scene, self.states, self.above).slip
            slip = jnp.where(self.contact == 1, jnp.stack([of_stem.x, of_stem.y]), slip)
        return slip.T

    @classmethod
    def parts_of(cls, scene: Scene, rows: Values, mode: Any, core: int) -> dict[str, Any]:
        # The rows end with the distance and its rate.
        parts = super().parts_of(scene, rows[:-2], mode, core)
        return parts | {"distance": rows[-2:], "contact": cls.touching(scene, mode)}

    @staticmethod
    def touching(scene: Scene, numbers: Values) -> Values:
        """The sphere that touches, for each mode index."""
        if scene.flies_in_closed_form:
            return numbers
        if scene.friction.set_valued:
            # Between two modes, a slip begins.
            return -1 * (numbers == FLYING)
        # Also for traced numbers; -1 after the end of a run.
        return (numbers == ON_STEM) - 1 * ((numbers == FLYING) | (numbers == STRIKING) | (numbers < 0))

    def reason(self) -> str:
        assert self.hops is not None
        contacts = sum(segment.number != BETWEEN for segment in self.dense.segments)
        if self.dense.status != UNRESOLVED:
            return super().reason()
        if len(self.hops) >= MOST_BOUNCES or contacts >= MOST_ROUNDS:
            return "there were too many flights or changes of contact"
        if self.scene.flies_in_closed_form:
            return "sphere and stem touch the plane together, with so much friction that the forces are undetermined"
        body, distance = self.scene.body, self.resampled(np.array([self.end_time])).distance[0, 0]
        if body.stem is not None and abs(distance) < NEAR * body.radius:
            return (
                "sphere and stem came to rest on the arena together; sliding on both at once is implemented only for the level "
                "plane, Plane() without tilt"
            )
        return "a flight does not end at the arena"

    @property
    def notes(self) -> list[str]:
        # A run made inside a transformation knows only the number of flights.
        if "impact_loss" not in self.stats:
            return [f"  {int(self.stats['hops'])} flights"] if "hops" in self.stats else []
        assert self.hops is not None
        return [f"  {len(self.hops)} flights, {self.stats['impact_loss']:.3g} J lost in impacts"]


# Simulate one launch of a top: a single run with its path, or a run inside a transformation.


def simulate_launch(
    model: Any,
    t1: ArrayLike,
    times: ArrayOrList | None,
    tolerance: ArrayLike,
    solver: diffrax.AbstractSolver | None = None,
    adjoint: diffrax.AbstractAdjoint | None = None,
) -> Trajectory | HybridTrajectory:
    """The run of a `TopModel`. **Arguments:** as for `tippe.simulate`."""
    require_adaptive(solver)
    require_adjoint(adjoint)
    settings, horizon = Settings(tolerance, solver), as_number(t1)
    if times is not None:
        times = as_number(times)
        require_times(times, t1)
    if is_traced((model, times, t1, tolerance)):
        return _traced(model, times, horizon, settings, adjoint)
    if model.smooth:
        path = follow(model.problem(None, None), float(horizon), settings)
    else:
        modes, first, state = model.modes(1, settings.tolerance, None, False)
        start = int(np.asarray(first)[0]), np.asarray(state)[:, 0]
        path = solve_hybrid_dense(modes, *start, float(horizon), settings, counters=len(model.counters))
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


def _along(model: Any, path: DenseSolution | HybridPath, tolerance: Number) -> Any:
    """The run along its path, at the times of its steps. A run whose energy does not balance the work of friction and
    impacts ends as "unresolved"."""
    scene, kind, times = model.scene, model.trajectories, path.times
    mode, counts = (path.numbers(times), path.counts) if isinstance(path, HybridPath) else (None, ())
    end = path.end_time if isinstance(path, HybridPath) and scene.contact == "hybrid" else jax.device_put(times[-1])
    rows, start = np.asarray(path.states), scene.state(model.launch)
    state, last_mode = (path.state, path.mode) if isinstance(path, HybridPath) else (rows[:, -1], 0)
    one, none = np.ones(1), np.zeros(1, int)
    state, inf = np.asarray(state)[:, None], np.inf * one
    outcome = HybridOutcome(
        none + path.status, inf, one, state, none, none, np.stack([inf, one, one]), none + last_mode, none, none[None]
    )
    (ended,) = np.asarray(eqx.filter_jit(model.ended)(jax.tree.map(jnp.asarray, outcome), jnp.asarray(tolerance)))
    status = Status(int(ended)).word
    # The states and what else has a value for each time come next.
    run = kind(times, scene, rows, rows, times, times, status, end, dense=path, start=start, launch=model.launch)
    # NumPy slices the states, because JAX would compile each slice again for every number of steps.
    run = run.with_rows(times, rows, mode)
    counted = {name: int(count) for name, count in zip(model.counters, counts, strict=True) if name == "sticks"}
    if scene.contact == "hybrid":
        assert isinstance(path, HybridPath)
        in_flight = BETWEEN if scene.flies_in_closed_form else FLYING
        segments = [segment for segment in path.segments if segment.number == in_flight and segment.end > segment.begin]
        hops = np.array([(segment.begin, segment.end) for segment in segments]).reshape(-1, 2)
        run = dataclasses.replace(run, hops=hops)
        # The remaining work is that of the impacts.
        in_contact = sum(work_in(scene, segment) for segment in path.segments)
        counted = {"impact_loss": float(in_contact - path.state[-1]), **counted}
    return audited(run, path, tolerance, **counted)


def work_in(scene: Scene, piece: Segment) -> float:
    """The work [J] of friction in a segment of the path, without the work of impacts."""
    if piece.number != BETWEEN:
        return piece.motion.states[-1, -1] - piece.motion.states[-1, 0]
    if not scene.friction.set_valued:
        return 0.0
    rows = piece.at(np.array([piece.begin, piece.end]))
    # The last rows are the distance and its rate.
    return float(np.diff(rows[-3])[0])


# Compiled as a whole even under a bare `vmap` or `grad`, which would otherwise dispatch each operation.
@eqx.filter_jit
def _traced(
    model: Any, times: Any, t1: Array, settings: Settings, adjoint: diffrax.AbstractAdjoint | None
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
    is_legal, status, run = sampled_if_legal(model, times, t1, settings, adjoint=adjoint)
    outcome = run.outcome
    rejected, start = outcome.rejected[0], scene.state(model.launch)
    stats = {"accepted": outcome.steps[0] - rejected, "rejected": rejected}
    stats |= {name: count[0] for name, count in zip(model.counters, outcome.counts, strict=True)}
    kind, rows = model.trajectories, run.rows
    parts = kind.parts_of(scene, rows, run.mode, len(start))
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
