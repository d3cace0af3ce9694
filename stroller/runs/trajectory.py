"""One run of the stroller and its quantities."""

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float

from nonholonomic.progress import status_line
from nonholonomic.runs import explore_model
from nonholonomic.sweeps import Quantity, Table, Tabular
from nonholonomic.text import batch_title
from nonholonomic.validation import is_traced, require_one_run, require_outside, times_within
from nonholonomic.views import Page, Stage, Viewable

from ..model.dynamics import Power
from ..model.ride import CONTACT_ROUND_OFF, RANK_LOST
from .quantities import MOST_GRIP, QUANTITIES, RideState, grip, spread, table_of_one
from .steps import RideSpec, Stats, Steps, crossings, followed, watched
from .view import as_stages, names_of


class Trajectory(Viewable, Tabular, eqx.Module):
    """A run at the given times. Times are the first axis of every array.

    - `t` [s]; `place`, as the surface names it (see `Launch`), (times, 2), or (times, 3) on an implicit surface; `position`
      [m] in the fixed frame, z up, (times, 3);
    - `heading` [rad], as in `Launch`; `direction`: the heading as a unit vector in the fixed frame, (times, 3);
    - `steering` [rad], `steering_rate` [rad/s], `yaw_rate` [rad/s], `speed` of the rear axle and `front_speed` at which
      the front wheel rolls [m/s];
    - `energy` [J], `work` [J] done so far by inputs and friction, `power` [W] through each port (a `Power`);
    - `side_force` [N] of the ground on the rear axle and the front wheel, to the left of each, (times, 2);
    - `normal_force` [N] of the ground, and `load` [N] on the rear and the front axle, (times, 2);
    - `constraint` [m/s]: speed at which the rear axle and the front wheel slip sideways, (times, 2);
    - `departure`: distance of the position from the ground [m], an integration error;
    - `stats` of the integration; `spec`: the specification of the run; `steps`: the ends of its steps. They are `None`
      for a run inside a transformation; if you request events of such a run, the run is repeated.

    **Example:**

    ```
    >>> import stroller
    >>> body = stroller.Stroller(mass=12.0, wheelbase=0.7, inertia=1.5, steering_inertia=0.05)
    >>> scene = stroller.Scene(body, friction=stroller.Damping(2.0, 1.0, 0.2, 0.05))
    >>> launch = stroller.Launch(place=(0.0, 0.0), heading=0.3, speed=2.0)
    >>> run = stroller.simulate(scene, launch, 1.0, stroller.Steady(1.0, 0.1), times=[0.5, 1.0], tolerance=1e-6)
    >>> run.position.shape, run.side_force.shape
    ((2, 3), (2, 2))
    >>> print(f"{run.work[-1]:.2f} J of work")
    -8.25 J of work

    ```
    """

    t: Float[Array, " times"]
    place: Float[Array, "times numbers"]
    position: Float[Array, "times 3"]
    heading: Float[Array, " times"]
    direction: Float[Array, "times 3"]
    steering: Float[Array, " times"]
    speed: Float[Array, " times"]
    front_speed: Float[Array, " times"]
    steering_rate: Float[Array, " times"]
    yaw_rate: Float[Array, " times"]
    energy: Float[Array, " times"]
    work: Float[Array, " times"]
    power: Power
    side_force: Float[Array, "times 2"]
    normal_force: Float[Array, " times"]
    load: Float[Array, "times 2"]
    constraint: Float[Array, "times 2"]
    departure: Float[Array, " times"]
    state: Float[Array, "times components"]
    stats: Stats
    spec: RideSpec
    steps: Steps | None

    readable: ClassVar[tuple[str, ...]] = tuple(QUANTITIES)
    quantities: ClassVar[dict[str, Quantity]] = QUANTITIES

    @property
    def portrait_axes(self) -> tuple[str, str]:
        return "steering", "yaw_rate"

    @property
    def energy_residual(self) -> Float[Array, " times"]:
        """Energy minus the initial energy and the work since the start [J]: zero for an exact solution."""
        return self.energy - self.energy[0] - (self.work - self.work[0])

    @property
    def wheelbase_error(self) -> Float[Array, " times"]:
        """Relative error |K| l^2 / 6 of replacing the ground by its tangent plane over the wheelbase l.

        K is the Gaussian curvature (`stroller.md`, section 9). The model holds if the wheelbase is short compared with
        the radii of curvature.
        """
        scene = self.spec.scene
        states = self.state.T
        curvature = scene.surface.gaussian_curvature(scene.dynamics.unpack(states)[0])
        return jnp.abs(spread(curvature, states[0])) * scene.body.wheelbase**2 / 6.0

    def grip(self) -> Float[Array, "times 2"]:
        """Coefficient of friction that each axle needs to avoid slip; infinite for a force without a load."""
        return grip(self.side_force, self.load)

    @property
    def loaded_axles(self) -> tuple[str, ...]:
        """The axles that carry a load: only the rear one if the centre of mass is above it (`centre` 0)."""
        return ("rear",) if self.spec.scene.body.centre is None else ("rear", "front")

    def grip_margin(self, coefficient: Float[Array, ""]) -> Float[Array, "times 2"]:
        """Reserve of side force [N] of each axle before it slips, for a given coefficient of friction [1]."""
        return coefficient * jnp.maximum(self.load, 0.0) - jnp.abs(self.side_force)

    @property
    def _grip_line(self) -> str:
        """The greatest friction coefficient that each axle needs, and the axle that slips if tyres cannot provide
        it."""
        grip_needed = dict(zip(self.loaded_axles, np.max(np.asarray(self.grip()), axis=0), strict=False))
        text = " and ".join(f"{grip:.3g} under the {name} axle" for name, grip in grip_needed.items())
        slips = " and ".join(name for name, grip in grip_needed.items() if grip > MOST_GRIP)
        remark = f": the {slips} wheels would slip, because tyres provide at most {MOST_GRIP:g}" if slips else ""
        return f"needs a friction coefficient of {text}{remark}"

    def at(self, times: Float[ArrayLike, " times"]) -> "Trajectory":
        """The same ride at other times, as accurate as the integration.

        **Arguments:** `times`: increasing, within [0, the end of the ride] [s]; or one time, for a ride of one time.

        **Raises:** `ValueError` for times outside the ride, inside a transformation, and for a batch.
        """
        require_outside((self.t, times), "at", "times= of simulate")
        require_one_run(self, "at", "")
        run = self.with_steps()
        assert run.steps is not None
        times = times_within(times, run.steps.times[-1], "ride")
        read = read_off_compiled(self.spec, times, run.steps.at(self.spec, times), self.stats)
        return dataclasses.replace(read, steps=run.steps)

    def with_steps(self) -> "Trajectory":
        """The same run with its steps."""
        return self if self.steps is not None else dataclasses.replace(self, steps=followed(self.spec)[0])

    @property
    def contact_lost_at(self) -> float:
        """Time [s] at which the ground first has to pull on the stroller to keep contact; infinite if there is no such
        time."""
        run = self.with_steps()
        assert run.steps is not None
        force = watched(run.spec, run.steps.states, "normal_force")
        allowed = -CONTACT_ROUND_OFF * np.max(np.abs(force[np.isfinite(force)]), initial=0.0)
        return run._first_below("normal_force", allowed)

    @property
    def rank_lost_at(self) -> float:
        """Time [s] at which the constraints first lose rank (only with a projected heading); otherwise infinite."""
        return self.with_steps()._first_below("rank", RANK_LOST)

    @property
    def jackknifed_at(self) -> Float[np.ndarray, " times"]:
        """Times [s] at which the steering angle passes a right angle, where the rear axle reverses."""
        steps = self.with_steps().steps
        assert steps is not None
        return crossings(self.spec, steps, "steering_cosine", 0.0)

    def _first_below(self, name: str, level: float) -> float:
        """Time [s] at which a watched quantity is first below a level; infinite if it never is."""
        assert self.steps is not None
        if watched(self.spec, self.steps.states[:, :1], name)[0] < level:
            return float(self.steps.times[0])
        return float(min(crossings(self.spec, self.steps, name, level), default=np.inf))

    @property
    def status(self) -> Any:
        """How the run ended: the first of the words `illegal`, `failed`, `rank_lost`, `contact_lost` and `completed` that
        applies; for a batch of runs, an array of words.

        After `contact_lost`, the run continues as if the ground could pull. A run from inside a transformation is `illegal`
        if its numbers raise an error elsewhere.
        """
        if self.t.ndim > 1:
            count = self.t.shape[0]
            return np.array([jax.tree.map(lambda leaf, k=k: leaf[k], self).status for k in range(count)])
        if not (bool(self.stats.finished) and np.all(np.isfinite(self.state))):
            is_legal = self.spec.parts[0].legal()
            return "failed" if np.all(is_legal) else "illegal"
        run = self.with_steps()
        if np.isfinite(run.rank_lost_at):
            return "rank_lost"
        return "contact_lost" if np.isfinite(run.contact_lost_at) else "completed"

    def explore(
        self, path: Any = None, sliders: dict[str, tuple[float, float]] | None = None, unit: Any = None
    ) -> Page:
        """A page with sliders that simulates the ride in the browser; see `stroller.explore`.

        **Raises:** as for `stroller.explore`, and `ValueError` for a batch of rides.
        """
        require_one_run(self, "explore", "")
        model, t1, *_ = self.spec.parts
        return explore_model(model, path, sliders, float(t1), unit)

    @status_line("reading off")
    def to_table(self) -> Table:
        return table_of_one(self)

    def table_of(self, names: Sequence[str]) -> Table:
        return table_of_one(self, names)

    def labels_of(self, runs: list[Any], unit: Any) -> list[str]:
        return names_of(runs, unit) if len(runs) > 1 else [""]

    def stages(self, others: Sequence[Any] = (), overlaid: bool = False, unit: Any = None) -> list[Stage]:
        return as_stages([self, *others], overlaid, unit)

    @status_line("reading off")
    def __str__(self) -> str:
        # A batch, or a run inside a transformation, has no single values to show.
        if is_traced(self.t) or self.t.ndim > 1:
            return batch_title(self.t.shape)
        self = self.with_steps()
        jackknives = self.jackknifed_at
        lines = [
            f"Trajectory of {self.t.size} times, {float(self.t[0]):g} s to {float(self.t[-1]):g} s: {self.status}",
            f"  steps           {int(self.stats.steps)} accepted, {int(self.stats.rejected)} rejected",
            f"  end             place {shown(self.place[-1])}, heading {float(self.heading[-1]):.6g} rad, "
            f"speed {float(self.speed[-1]):.6g} m/s, steering {float(self.steering[-1]):.6g} rad",
            f"  energy          {float(self.energy[0]):.6g} J to {float(self.energy[-1]):.6g} J, "
            f"work {float(self.work[-1]):.6g} J, residual {float(jnp.max(jnp.abs(self.energy_residual))):.1e} J",
            f"  normal force    {float(jnp.min(self.normal_force)):.6g} N to {float(jnp.max(self.normal_force)):.6g} N",
            f"  side forces     up to {shown(jnp.max(jnp.abs(self.side_force), axis=0))} N, rear and front",
            f"  grip            {self._grip_line}",
            f"  no-slip         {float(jnp.max(jnp.abs(self.constraint))):.1e} m/s",
        ]
        error = float(jnp.max(self.wheelbase_error))
        if error > 0.0:
            lines.append(f"  wheelbase       relative error up to {error:.1e}, because the ground is curved")
        if np.isfinite(self.contact_lost_at):
            lines.append(f"  contact lost    at {self.contact_lost_at:.6g} s; after that the ground would have to pull")
        if np.isfinite(self.rank_lost_at):
            lines.append(f"  rank lost       at {self.rank_lost_at:.6g} s; from there the motion is undetermined")
        if jackknives.size:
            lines.append(f"  jackknifed      at {', '.join(f'{time:.6g}' for time in jackknives)} s")
        return "\n".join(lines)


def shown(numbers: Float[Array, " n"]) -> str:
    """Numbers in brackets, to six digits."""
    return f"({', '.join(f'{float(number):.6g}' for number in numbers)})"


def read_off(
    spec: RideSpec, t: Float[Array, " times"], states: Float[Array, "components times"], stats: Stats
) -> Trajectory:
    """The trajectory of the given states at the given times."""
    state = RideState(spec.scene, spec.input, t, states)
    arrays = {field.name: getattr(state, field.name) for field in dataclasses.fields(Trajectory)[:-3]}
    return Trajectory(**arrays, stats=stats, spec=spec, steps=None)


# Compiled functions also accept NumPy arrays.
read_off_compiled: Callable[..., Trajectory] = eqx.filter_jit(read_off)
