"""One ride of the stroller: its steps, the states between them, and its quantities."""

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any, ClassVar, NamedTuple

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Bool, Float, Int

from nonholonomic.compilation.xla_cpu import compiled_quickly
from nonholonomic.hybrid import HybridOutcome
from nonholonomic.integration import ImplicitMidpoint, Settings, explicit_tableau, follow, sample
from nonholonomic.integration.dense import all_crossings
from nonholonomic.integration.problem import REACHED_END, require_adaptive, require_adjoint, require_times
from nonholonomic.runs import evenly_spaced, explore_model, sampled_if_legal
from nonholonomic.sweeps import Quantity, Table, Tabular
from nonholonomic.terminal import status_line
from nonholonomic.text import batch_title
from nonholonomic.validation import (
    as_known,
    is_traced,
    nan_unless,
    require_one_run,
    require_outside,
    require_whole,
    times_within,
)
from nonholonomic.views import Page, Stage, Viewable

from ..model.dynamics import Power, State
from ..model.input import Input
from ..model.scene import CONTACT_ROUND_OFF, RANK_LOST, RideProblem, Scene
from ..model.vehicle import Launch
from .view import MOST_GRIP, QUANTITIES, RideState, as_stages, grip, names_of, spread, table_of_one

# The steps of a ride, the states between them, found by repeating a step with another length, and zero crossings.
#
# A state therefore has the accuracy of the integration, not of an interpolant. Only the field is compiled; the stages of
# the steps are summed in NumPy.


class Stats(NamedTuple):
    """Numbers of accepted and rejected steps, and whether the integration reached its end."""

    steps: Int[Array, ""]
    rejected: Int[Array, ""]
    finished: Bool[Array, ""]


class RideSpec(eqx.Module):
    """A ride and the options of its integration, in a form that can leave a transformation: its numbers are leaves and
    everything else is static."""

    numbers: Any
    static: Any = eqx.field(static=True)

    @classmethod
    def of(cls, model: Any, t1: Array, settings: Settings, grid: Float[Array, " steps"] | None) -> "RideSpec":
        """The specification of a ride.

        **Arguments:** `model`: the `RideModel`; `t1`: end [s]; `grid`: the ends of the steps [s] of a solver without an
        error estimate.
        """
        return cls(*eqx.partition((model, t1, settings, grid), eqx.is_array_like))

    @property
    def parts(self) -> tuple[Any, Array, Settings, Array | None]:
        """The arguments of `of`."""
        return eqx.combine(self.numbers, self.static)

    @property
    def model(self) -> Any:
        """The `RideModel`."""
        return self.parts[0]

    @property
    def settings(self) -> Settings:
        """The settings of the integration."""
        return self.parts[2]

    @property
    def scene(self) -> Scene:
        """The scene of the ride."""
        return self.model.scene

    @property
    def launch(self) -> Launch:
        """The launch of the ride."""
        return self.model.launch

    @property
    def input(self) -> Input | None:
        """The input of the ride."""
        return self.model.input


def stats_of(outcome: HybridOutcome[Array]) -> Stats:
    """The statistics of a run of one cell."""
    accepted, rejected = outcome.steps[0] - outcome.rejected[0], outcome.rejected[0]
    return Stats(accepted.astype(int), rejected.astype(int), outcome.status[0] == REACHED_END)


Lanes = Float[np.ndarray, " lanes"]
States = Float[np.ndarray, "components lanes"]

#: Number of states in a call of a compiled function, always the same, so that it is compiled once.
WIDTH = 256


class Steps(NamedTuple):
    """The ends of a run's steps: times [s], beginning with 0, and states."""

    times: Float[np.ndarray, " steps"]
    states: Float[np.ndarray, "components steps"]

    def at(self, spec: RideSpec, times: Lanes) -> States:
        """The states at the given times [s]; NaN after the end of the run."""
        step = np.clip(np.searchsorted(self.times, times, side="right") - 1, 0, len(self.times) - 2)
        ends = np.where(times == self.times[step], step, step + 1)
        states = self.states[:, ends]
        is_inside = (times > self.times[step]) & (times < self.times[step + 1])
        if is_inside.any():
            states[:, is_inside] = self._between(spec, step[is_inside], times[is_inside] - self.times[step[is_inside]])
        states[:, times > self.times[-1]] = np.nan
        return states

    def _between(self, spec: RideSpec, step: Any, length: Lanes) -> States:
        """The states at given times [s] after the starts of some steps."""

        def field(times: Lanes, states: States) -> States:
            return in_blocks(lambda *arguments: _field(spec, *arguments), times, states)

        time, start, solver = self.times[step], self.states[:, step], spec.settings.for_steps_alone
        rates = [field(time, start)]
        if not isinstance(solver, diffrax.AbstractERK):
            # Use the cubic through states and rates at both ends; repeating an implicit step would be expensive.
            length_of_step, end = self.times[step + 1] - time, self.states[:, step + 1]
            part, change = length / length_of_step, end - start
            last = field(time + length_of_step, end)
            bend = (1.0 - part) * (length_of_step * rates[0] - change) - part * (length_of_step * last - change)
            return start + part * (change + (1.0 - part) * bend)
        tableau = explicit_tableau(solver)
        for fraction, row in zip(tableau.c, tableau.a_lower, strict=True):
            end = start + length * np.tensordot(row, np.stack(rates), 1)
            rates.append(field(time + fraction * length, end))
        return start + length * np.tensordot(tableau.b_sol, np.stack(rates), 1)


@eqx.filter_jit
def _field(spec: RideSpec, times: Float[Array, "*lanes"], states: State) -> State:
    return spec.scene.dynamics.field(times, states, spec.input)


def in_blocks(function: Callable[..., Any], *columns: Any) -> Any:
    """A compiled function of any number of columns, `WIDTH` at a time; the last block is padded with its last column."""
    count = columns[0].shape[-1]
    results = []
    for first in range(0, count, WIDTH):
        lanes = np.minimum(np.arange(first, first + WIDTH), count - 1)
        results.append(np.asarray(function(*(column[..., lanes] for column in columns))))
    return np.concatenate(results, axis=-1)[..., :count]


def followed(spec: RideSpec) -> tuple[Steps, Stats]:
    """Run a ride outside of transformations, and keep its steps."""
    problem, (_, t1, settings, grid) = _problem(spec), spec.parts
    if grid is None:
        path = follow(problem, float(t1), settings, dense=False)
        return Steps(path.times, path.states), _counted(path.accepted, path.rejected, not path.failed)
    solution = _on_grid(problem, spec)
    ends = np.asarray(grid)
    mask = ends <= float(solution.end_time)
    steps = Steps(ends[mask], np.asarray(solution.states)[:, mask])
    return steps, _counted(int(solution.accepted), int(solution.rejected), bool(mask.all()))


def _counted(accepted: int, rejected: int, finished: bool) -> Stats:
    """Statistics as arrays: plain numbers would be constants of a program, and other values would compile another
    program."""
    return Stats(jnp.asarray(accepted), jnp.asarray(rejected), jnp.asarray(finished))


@eqx.filter_jit
def _problem(spec: RideSpec) -> RideProblem:
    return RideProblem.of(spec.scene, spec.launch, spec.input, jumps=spec.model.jumps)


@compiled_quickly
def _on_grid(problem: RideProblem, spec: RideSpec) -> Any:
    """A ride with given steps, sampled at their ends."""
    _, t1, settings, grid = spec.parts
    return sample(problem, None, t1, settings, grid=grid)


#: Quantities that can be watched: the normal force [N], the cosine of the steering angle, and the relative reduced
#: mass.
WATCHED = ("normal_force", "steering_cosine", "rank")


def watched(spec: RideSpec, states: States, name: str) -> Lanes:
    """A quantity in `WATCHED` at the given states."""
    return in_blocks(lambda state: _watched(spec, state), states)[WATCHED.index(name)]


@eqx.filter_jit
def _watched(spec: RideSpec, states: State) -> Float[Array, "watched lanes"]:
    dynamics = spec.scene.dynamics
    quantities = (dynamics.contact(states), dynamics.geometry(states).cosine, dynamics.rank(states))
    return jnp.stack(jnp.broadcast_arrays(*quantities))


def crossings(spec: RideSpec, steps: Steps, name: str, level: float) -> Float[np.ndarray, " times"]:
    """Times [s] at which a watched quantity passes a level, in either direction, in increasing order."""
    value = watched(spec, steps.states, name) - level
    return all_crossings(lambda times: watched(spec, steps.at(spec, times), name) - level, steps.times, value)


# One run of the stroller and its quantities.


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


# One ride: with its steps outside of transformations, and sampled inside.

#: Default limit of the steps of a ride.
DEFAULT_STEPS = 65536


def ride(
    model: Any,
    t1: Any,
    times: Any,
    tolerance: Any,
    solver: diffrax.AbstractSolver | None,
    max_steps: int,
    adjoint: diffrax.AbstractAdjoint | None,
) -> Trajectory:
    """The trajectory of a `RideModel`. **Arguments:** as for `stroller.simulate`; the model was checked."""
    if not isinstance(solver, ImplicitMidpoint):
        require_adaptive(solver, ", or an ImplicitMidpoint")
    require_whole(max_steps, "max_steps", 1)
    require_adjoint(adjoint)
    end, grid = as_known(t1), None
    times = evenly_spaced(end) if times is None else as_known(times)
    require_times(times, t1)
    if isinstance(solver, ImplicitMidpoint):
        jumps = model.problem(None, ()).jump_times
        known = jumps is not None and not is_traced((jumps, times, end))
        inside = [time for time in np.asarray(jumps) if 0.0 < time < end] if known else []
        grid = even_steps(jnp.asarray(np.union1d(times, inside)) if inside else times, end, solver.step_length)
        max_steps = grid.size
    settings = Settings(tolerance, solver, max_steps=max_steps)
    # Inside a transformation, this traces all numbers, even if they are known.
    spec = RideSpec.of(model, jnp.add(end, 0.0), settings, grid)
    inside = is_traced((spec, times))
    # Steps of other implicit solvers cannot be repeated cheaply, so they end on the times.
    if inside or not isinstance(settings.for_steps_alone, diffrax.AbstractERK | ImplicitMidpoint):
        return _sampled(spec, times, adjoint if inside else None)
    steps, stats = followed(spec)
    return dataclasses.replace(read_off_compiled(spec, times, steps.at(spec, np.asarray(times)), stats), steps=steps)


# Compiled as a whole even under a bare `vmap` or `grad`, which would otherwise dispatch each operation.
@eqx.filter_jit
def _sampled(spec: RideSpec, times: Float[Array, " times"], adjoint: diffrax.AbstractAdjoint | None) -> Trajectory:
    """The run at `times`; NaN and `finished` false if a traced number is out of range."""
    model, t1, settings, grid = spec.parts
    is_legal, samples, _ = sampled_if_legal(model, times, t1, settings, grid, adjoint)
    run = read_off(spec, times, samples.rows, stats_of(samples.outcome))
    stats = run.stats._replace(finished=run.stats.finished & is_legal)
    return eqx.tree_at(lambda trajectory: (trajectory.t, trajectory.stats), nan_unless(is_legal, run), (times, stats))


def even_steps(
    times: Float[Array, " times"], t1: Float[Array, ""], max_duration: Float[Array, ""]
) -> Float[Array, " steps"]:
    """Times from 0 to `t1`, at most `max_duration` apart, that include all `times` and are evenly spaced between them.

    **Raises:** `ValueError` if an argument is traced, because the number of steps is part of the program.
    """
    for name, number in {"t1": t1, "times": times, "step_length": max_duration}.items():
        if is_traced(number):
            raise ValueError(
                f"{name} is traced and must be known for ImplicitMidpoint, whose steps have a given length"
            )
    knots = np.union1d(np.asarray(times), [0.0, float(t1)])
    counts = np.ceil(np.diff(knots) / float(max_duration) * (1.0 - 1e-12)).astype(int)
    pieces = [np.linspace(a, b, n, endpoint=False) for a, b, n in zip(knots, knots[1:], counts, strict=False)]
    return jnp.asarray(np.concatenate([*pieces, knots[-1:]]))
