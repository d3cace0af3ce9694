"""One ride of the stroller: its quantities, its steps, and the states between them."""

import dataclasses
import functools
from collections.abc import Callable, Iterable, Sequence
from typing import Any, ClassVar, NamedTuple

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Bool, Float, Int, PyTree

from nonholonomic import validation
from nonholonomic.compilation.xla_cpu import compiled_quickly
from nonholonomic.geometry import Component, dot, multiply, scale, sum_vectors
from nonholonomic.integration import ImplicitMidpoint, Settings, explicit_tableau, follow, sample
from nonholonomic.integration.dense import all_crossings
from nonholonomic.integration.problem import REACHED_END, require_adaptive, require_adjoint, require_times
from nonholonomic.runs.model import AbstractModel
from nonholonomic.runs.simulate import evenly_spaced, sampled_if_legal
from nonholonomic.runs.trajectory import AbstractRun
from nonholonomic.sweeps import Quantity, Table, chosen, run_table
from nonholonomic.text import Unit, as_text, distinguishing_labels

from ..model.input import Input
from ..model.scene import CONTACT_ROUND_OFF, RANK_LOST, Number, Power, Scene, State

#: Times [s].
Times = Float[Array, " times"]

# The quantities of a ride, with units and names, as functions of its states, and the table of a run.


class RideState:
    """The states of a ride at times `t` [s], and what several quantities share; the states may have an axis of times or of
    cells, which is the first axis of every quantity."""

    def __init__(self, scene: Scene, controls: Input | None, t: Float[Array, "..."], states: State):
        self.scene, self.controls, self.t = scene, controls, t
        self.integrated, self.states = states, scene.dynamics.righted(states)
        self.geometry = scene.dynamics.geometry(self.states)
        self.motion, surface = self.geometry.motion, scene.surface
        # Vectors in the fixed frame, and the numbers of the place.
        self.position, self.direction = (surface.in_fixed_frame(vector) for vector in self.motion[:2])
        self.place = surface.place_at(self.motion.position)
        self.load = self.vector(self.geometry.loads)

    @functools.cached_property
    def power(self) -> Power:
        forces = self.scene.dynamics.forces(self.t, self.geometry, self.controls)
        return Power(*(self.number(part) for part in forces.power))

    @functools.cached_property
    def side_force(self) -> Float[Array, "... 2"]:
        return self.vector(self.scene.dynamics.side_force(self.t, self.states, self.controls))

    def number(self, component: Component) -> Float[Array, "..."]:
        """A component as an array, with zeros if it vanishes identically."""
        example = self.states[0]
        return jnp.zeros_like(example) if component is None else jnp.broadcast_to(component, example.shape)

    def vector(self, components: Iterable[Component]) -> Float[Array, "... components"]:
        """Components along the last axis."""
        return jnp.stack([self.number(component) for component in components], axis=-1)


#: The quantities of a ride; `read` gets a `RideState`.
QUANTITIES = {
    "place": Quantity("m or rad", "place", "coordinate", lambda state: state.vector(state.place)),
    "position": Quantity("m", "position of the rear axle", "component", lambda state: state.vector(state.position)),
    "direction": Quantity("1", "direction of the heading", "component", lambda state: state.vector(state.direction)),
    "heading": Quantity("rad", "heading ψ", None, lambda state: state.scene.dynamics.angle(*state.motion[:2])),
    "steering": Quantity("rad", "steering angle φ", None, lambda state: state.motion.steering),
    "steering_rate": Quantity("rad s-1", "φ'", None, lambda state: state.number(state.motion.steering_rate)),
    "speed": Quantity("m s-1", "speed v", None, lambda state: state.motion.speed),
    "front_speed": Quantity("m s-1", "speed of the front wheel", None, lambda state: state.motion.front_speed),
    "yaw_rate": Quantity("rad s-1", "yaw rate", None, lambda state: state.motion.yaw_rate),
    "energy": Quantity("J", "energy", None, lambda state: state.scene.energy(state.states)),
    "work": Quantity("J", "work of inputs and friction", None, lambda state: state.scene.work(state.states)),
    "drive_power": Quantity("W", "power of the drive", None, lambda state: state.power.drive),
    "steering_power": Quantity("W", "power of the steering", None, lambda state: state.power.steering),
    "friction_power": Quantity("W", "power of friction", None, lambda state: sum(state.power[2:])),
    "side_force": Quantity("N", "side force", "axle", lambda state: state.side_force),
    "grip": Quantity("1", "friction that the tyres need", "axle", lambda state: grip(state.side_force, state.load)),
    "load": Quantity("N", "load", "axle", lambda state: state.load),
    "normal_force": Quantity("N", "normal force", None, lambda state: state.number(state.geometry.normal_force)),
}

#: What a run has in addition, which no table shows.
FURTHER: dict[str, Callable[[RideState], PyTree[Array]]] = {
    "power": lambda state: state.power,
    "constraint": lambda state: state.vector(side_slip(state)),
    "departure": lambda state: state.number(state.scene.surface.offset(state.motion.position)),
    "wheelbase_error": lambda state: jnp.abs(state.number(relative_curvature(state))) / 6.0,
    "state": lambda state: jnp.moveaxis(state.integrated, 0, -1),
}

#: The quantities that depend on the input, and so on the time.
TIMED = {"drive_power", "steering_power", "friction_power", "side_force", "grip"}

#: Names of the components of vectors, by dimension.
VECTORS = {"component": ("x", "y", "z"), "axle": ("rear", "front")}

#: The coefficient of friction [1] that no tyre exceeds on a dry road: 0.7 to 1.0 is usual, and 1.8 is that of racing slicks
#: (Milliken and Milliken, Race Car Vehicle Dynamics (1995), chapter 2).
MOST_GRIP = 1.8


def grip(side_force: Float[Array, "... 2"], load: Float[Array, "... 2"]) -> Float[Array, "... 2"]:
    """Coefficient of friction that each axle needs to avoid slip; infinite for a force without a load."""
    force = jnp.abs(side_force)
    return jnp.where(force == 0.0, 0.0, force / jnp.maximum(load, 0.0))


def relative_curvature(ride: RideState) -> Component:
    """Gaussian curvature of the ground, times the square of the wheelbase."""
    wheelbase = ride.scene.body.wheelbase
    return multiply(ride.scene.surface.gaussian_curvature(ride.motion.position), wheelbase**2)


def side_slip(ride: RideState) -> tuple[Component, Component]:
    """Speeds [m/s] at which the rear axle and the front wheel slip sideways.

    They come from the rates of the position r and of the heading, with the front wheel l ahead of the rear axle.
    """
    scene, state, g = ride.scene, ride.states, ride.geometry
    dynamics, rate = scene.dynamics, scene.dynamics.field(ride.t, state, ride.controls)
    velocity = dynamics.unpack(rate)[0]
    heading_rate = jax.jvp(lambda state: dynamics.geometry(state).motion.heading, (state,), (rate,))[1]
    if scene.heading == "projected":
        heading, left = g.motion.heading, (-g.motion.heading[1], g.motion.heading[0], None)
    else:
        heading, left = g.direction, g.left
    sideways = sum_vectors(scale(-g.sine, heading), scale(g.cosine, left))
    front = sum_vectors(velocity, scale(multiply(scene.body.wheelbase, dot(heading_rate, left)), left))
    return dot(velocity, left), dot(front, sideways)


# The steps of a ride, the states between them, found by repeating a step with another length, and zero crossings.
#
# A state therefore has the accuracy of the integration, not of an interpolant. Only the field is compiled; the stages of
# the steps are summed in NumPy.


class Stats(NamedTuple):
    """Numbers of accepted and rejected steps, and whether the integration reached its end."""

    steps: Int[Array, ""]
    rejected: Int[Array, ""]
    finished: Bool[Array, ""]


class Ride(NamedTuple):
    """A ride: its `RideModel`, its end [s], the settings, and the ends of the steps [s] of a solver without an error
    estimate."""

    model: Any
    t1: Array
    settings: Settings
    grid: Float[Array, " steps"] | None


class RideSpec(eqx.Module):
    """A ride in a form that can leave a transformation: its numbers are leaves and everything else is static."""

    numbers: Ride
    static: Ride = eqx.field(static=True)

    @property
    def ride(self) -> Ride:
        """The ride."""
        return eqx.combine(self.numbers, self.static)


Lanes = Float[np.ndarray, " lanes"]
States = Float[np.ndarray, "components lanes"]

#: Number of states in a call of the compiled function, always the same, so that it is compiled once.
WIDTH = 256


class Steps(NamedTuple):
    """The ends of a run's steps: times [s], beginning with 0, and states."""

    times: Float[np.ndarray, " steps"]
    states: Float[np.ndarray, "components steps"]

    def at(self, spec: RideSpec, times: Lanes) -> States:
        """The states at the given times [s]; NaN after the end of the run."""
        step = np.clip(np.searchsorted(self.times, times, side="right") - 1, 0, len(self.times) - 2)
        states = self.states[:, np.where(times == self.times[step], step, step + 1)]
        states[:, times > self.times[-1]] = np.nan
        inside = np.flatnonzero((times > self.times[step]) & (times < self.times[step + 1]))
        if not inside.size:
            return states
        step, solver = step[inside], spec.ride.settings.for_steps_alone
        time, start, end = self.times[step], self.states[:, step], self.states[:, step + 1]
        length, whole = times[inside] - time, self.times[step + 1] - time
        rates = [along(spec, time, start)[: len(start)]]
        if isinstance(solver, diffrax.AbstractERK):
            tableau = explicit_tableau(solver)
            for fraction, row in zip(tableau.c, tableau.a_lower, strict=True):
                stage = start + length * np.tensordot(row, np.stack(rates), 1)
                rates.append(along(spec, time + fraction * length, stage)[: len(start)])
            states[:, inside] = start + length * np.tensordot(tableau.b_sol, np.stack(rates), 1)
        else:
            # Use the cubic through states and rates at both ends; repeating an implicit step would be expensive.
            part, change, last = length / whole, end - start, along(spec, time + whole, end)[: len(start)]
            bend = (1.0 - part) * (whole * rates[0] - change) - part * (whole * last - change)
            states[:, inside] = start + part * (change + (1.0 - part) * bend)
        return states


#: Quantities that can be watched, and their rows in `along`: the normal force [N], the cosine of the steering angle, and the
#: relative reduced mass.
WATCHED = {"normal_force": -3, "steering_cosine": -2, "rank": -1}


def along(spec: RideSpec, times: Lanes, states: States) -> Float[np.ndarray, "rows lanes"]:
    """The rates of any number of states, and below them the quantities in `WATCHED`, by a program for `WIDTH` states at a time;
    the last block is padded with its last state."""
    count = len(times)
    results = []
    for first in range(0, count, WIDTH):
        lanes = np.minimum(np.arange(first, first + WIDTH), count - 1)
        results.append(np.asarray(_along(spec, times[lanes], states[:, lanes])))
    return np.concatenate(results, axis=-1)[:, :count]


@eqx.filter_jit
def _along(
    spec: RideSpec, times: Float[Array | np.ndarray, " lanes"], states: Float[Array | np.ndarray, "components lanes"]
) -> Float[Array, "rows lanes"]:
    model, dynamics = spec.ride.model, spec.ride.model.scene.dynamics
    watched = (dynamics.contact(states), dynamics.geometry(states).cosine, dynamics.rank(states))
    return jnp.stack(jnp.broadcast_arrays(*dynamics.field(times, states, model.input), *watched))


def followed(spec: RideSpec) -> tuple[Steps, Stats]:
    """Run a ride outside of transformations, and keep its steps."""
    model, t1, settings, grid = spec.ride
    problem = _problem(model)
    if grid is None:
        path = follow(problem, float(t1), settings, dense=False)
        steps, counts = Steps(path.times, path.states), (path.accepted, path.rejected, not path.failed)
    else:
        (outcome, states), ends = _sample(problem, None, t1, settings, grid=grid), np.asarray(grid)
        mask = ends <= float(outcome.end_time)
        steps = Steps(ends[mask], np.asarray(states)[:, mask])
        rejected = int(outcome.rejected)
        counts = (int(outcome.steps) - rejected, rejected, bool(mask.all()))
    # Plain numbers would be constants of a program, and other values would compile another program.
    return steps, Stats(*map(jnp.asarray, counts))


_problem = eqx.filter_jit(lambda model: model.problem(None, None))

_sample = compiled_quickly(sample)


# One run of the stroller and its quantities.


class Trajectory(AbstractRun):
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
    - `wheelbase_error`: relative error |K| l^2 / 6 of replacing the ground, of Gaussian curvature K, by its tangent plane over
      the wheelbase l (`stroller.md`, section 9). The model holds if the wheelbase is short compared with the radii of
      curvature;
    - `stats` of the integration; `model`: its `scene`, `launch` and `input`; `spec`: the model, the horizon and the settings;
      `steps`: the ends of the steps, `None` for a run inside a transformation; if you request events of such a run, the
      run is repeated.

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

    t: Times
    values: dict[str, PyTree[Array]]
    stats: Stats
    spec: RideSpec
    steps: Steps | None

    quantities: ClassVar[dict[str, Quantity]] = QUANTITIES
    portrait_axes = ("steering", "yaw_rate")

    def __getattr__(self, name: str) -> Any:
        # Python calls this only for names that are not attributes, also while a copy has none yet.
        values = vars(self).get("values", {})
        return values[name] if name in values else super().__getattr__(name)

    def __dir__(self) -> list[str]:
        return [*super().__dir__(), *self.values]

    def __getitem__(self, name: str) -> Any:
        return self.values[name] if name in QUANTITIES else super().__getitem__(name)

    @property
    def model(self) -> Any:
        """The `RideModel`."""
        return self.spec.ride.model

    @property
    def of_page(self) -> tuple[AbstractModel, float]:
        return self.model, float(self.spec.ride.t1)

    @property
    def energy_residual(self) -> Times:
        """Energy minus the initial energy and the work since the start [J]: zero for an exact solution."""
        return self.energy - self.energy[..., :1] - (self.work - self.work[..., :1])

    def grip(self) -> Float[Array, "times 2"]:
        """Coefficient of friction that each axle needs to avoid slip; infinite for a force without a load."""
        return self["grip"]

    @property
    def loaded_axles(self) -> tuple[str, ...]:
        """The axles that carry a load: only the rear one if the centre of mass is above it (`centre` 0)."""
        return ("rear",) if self.model.scene.body.centre is None else ("rear", "front")

    def grip_margin(self, coefficient: Float[Array, ""]) -> Float[Array, "times 2"]:
        """Reserve of side force [N] of each axle before it slips, for a given coefficient of friction [1]."""
        return coefficient * jnp.maximum(self.load, 0.0) - jnp.abs(self.side_force)

    @property
    def grip_in_words(self) -> str:
        """The greatest friction coefficient that each axle needs, the axle that slips if tyres cannot provide it, and the
        side force of a wheel without load."""
        grip_needed = dict(zip(self.loaded_axles, np.max(np.asarray(self.grip()), axis=0), strict=False))
        text = " and ".join(f"{grip:.3g} under the {name} axle" for name, grip in grip_needed.items())
        slips = " and ".join(name for name, grip in grip_needed.items() if grip > MOST_GRIP)
        remark = f": the {slips} wheels would slip, because tyres provide at most {MOST_GRIP:g}" if slips else ""
        force = float(np.max(np.abs(self.side_force[:, 1]))) * (len(grip_needed) == 1)
        side = f"; the front wheel carries no load, and a side force of up to {force:.3g} N" if force > 0.0 else ""
        return f"needs a friction coefficient of {text}{remark}{side}"

    def at(self, times: ArrayLike | Sequence[float]) -> "Trajectory":
        """The same ride at other times, as accurate as the integration.

        **Arguments:** `times`: increasing, within [0, the end of the ride] [s]; or one time, for a ride of one time.

        **Raises:** `ValueError` for times outside the ride, inside a transformation, and for a batch.
        """
        validation.require_outside((self.t, times), "at", "times= of simulate")
        validation.require_one_run(self, "at", "")
        steps = self._all_steps
        times = validation.times_within(times, steps.times[-1], "ride")
        read = read_off_compiled(self.spec, times, steps.at(self.spec, times), self.stats)
        return dataclasses.replace(read, steps=steps)

    @functools.cached_property
    def _all_steps(self) -> Steps:
        """The ends of the steps; a run inside a transformation is repeated for them."""
        return followed(self.spec)[0] if self.steps is None else self.steps

    @property
    def contact_lost_at(self) -> float:
        """Time [s] at which the ground first has to pull on the stroller to keep contact; infinite if there is no such
        time."""
        force = along(self.spec, *self._all_steps)[WATCHED["normal_force"]]
        allowed = -CONTACT_ROUND_OFF * np.max(np.abs(force[np.isfinite(force)]), initial=0.0)
        return self._first_below("normal_force", allowed)

    @property
    def rank_lost_at(self) -> float:
        """Time [s] at which the constraints first lose rank (only with a projected heading); otherwise infinite."""
        return self._first_below("rank", RANK_LOST)

    @property
    def jackknifed_at(self) -> Float[np.ndarray, " times"]:
        """Times [s] at which the steering angle passes a right angle, where the rear axle reverses."""
        return self._crossings("steering_cosine", 0.0)[1]

    def _crossings(self, name: str, level: float) -> tuple[float, Float[np.ndarray, " times"]]:
        """A watched quantity less a level at the start, and the times [s] at which it passes this level."""
        steps, row = self._all_steps, WATCHED[name]
        value = along(self.spec, *steps)[row] - level
        times = all_crossings(
            lambda times: along(self.spec, times, steps.at(self.spec, times))[row] - level, steps.times, value
        )
        return value[0], times

    def _first_below(self, name: str, level: float) -> float:
        """Time [s] at which a watched quantity is first below a level; infinite if it never is."""
        start, times = self._crossings(name, level)
        return 0.0 if start < 0.0 else float(min(times, default=np.inf))

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
            is_legal = self.model.legal()
            return "failed" if np.all(is_legal) else "illegal"
        if np.isfinite(self.rank_lost_at):
            return "rank_lost"
        return "contact_lost" if np.isfinite(self.contact_lost_at) else "completed"

    def table_of(self, names: Sequence[str]) -> Table:
        validation.require_one_run(self, "to_table", "; stroller.sweep makes a table of many")
        units = {unit for _, unit in self.model.scene.surface.coordinates}
        place = QUANTITIES["place"]._replace(unit=units.pop()) if len(units) == 1 else QUANTITIES["place"]
        quantities = chosen(QUANTITIES | {"place": place}, names)
        coords = {"time": np.asarray(self.t)}
        coords |= {dim: np.array(parts) for dim, parts in self.model.components.items()}
        values = {name: np.asarray(self[name]) for name in quantities}
        return run_table(quantities, coords, values, ["time"], self.model.description() | {"status": self.status})

    def labels_of(self, runs: list[Any], unit: Unit) -> list[str]:
        """Names of rides, by what differs in their durations, scenes and launches."""
        for run in runs:
            validation.require_one_run(run, "a picture", ", and pass the others as others=")
        starts = [(f"ride of {float(run.t[-1]):.3g} s",) for run in runs]
        scenes, launches = ([getattr(run.model, name) for run in runs] for name in ("scene", "launch"))
        return distinguishing_labels(starts, scenes, launches, unit=unit)

    def in_words(self) -> str:
        jackknives = self.jackknifed_at
        lines = [
            f"Trajectory of {self.t.size} times, {float(self.t[0]):g} s to {float(self.t[-1]):g} s: {self.status}",
            f"  launch          {self.model.launch}",
            f"  steps           {int(self.stats.steps)} accepted, {int(self.stats.rejected)} rejected",
            f"  end             place {as_text(tuple(self.place[-1]))}, heading {float(self.heading[-1]):.6g} rad, "
            f"speed {float(self.speed[-1]):.6g} m/s, steering {float(self.steering[-1]):.6g} rad",
            f"  energy          {float(self.energy[0]):.6g} J at the start, {float(self.energy[-1]):.6g} J at the end, "
            f"work {float(self.work[-1]):.6g} J, residual {float(jnp.max(jnp.abs(self.energy_residual))):.1e} J",
            f"  normal force    {float(jnp.min(self.normal_force)):.6g} N to {float(jnp.max(self.normal_force)):.6g} N",
            f"  side forces     up to {as_text(tuple(jnp.max(jnp.abs(self.side_force), axis=0)))} N, rear and front",
            f"  grip            {self.grip_in_words}",
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


def read_off(spec: RideSpec, t: Times, states: Float[Array, "components times"], stats: Stats) -> Trajectory:
    """The trajectory of the given states at the given times."""
    model = spec.ride.model
    state = RideState(model.scene, model.input, t, states)
    values = {name: quantity.of(name, state) for name, quantity in QUANTITIES.items()}
    values |= {name: read(state) for name, read in FURTHER.items()}
    return Trajectory(t, values, stats, spec, None)


# Compiled functions also accept NumPy arrays.
read_off_compiled: Callable[..., Trajectory] = eqx.filter_jit(read_off)


# One ride: with its steps outside of transformations, and sampled inside.


def ride(
    model: Any,
    t1: ArrayLike,
    times: ArrayLike | Sequence[float] | None,
    tolerance: ArrayLike,
    solver: diffrax.AbstractSolver | None = None,
    adjoint: diffrax.AbstractAdjoint | None = None,
    max_steps: int = 65536,
) -> Trajectory:
    """The trajectory of a `RideModel`. **Arguments:** as for `stroller.simulate`; the model was checked."""
    if not isinstance(solver, ImplicitMidpoint):
        require_adaptive(solver, ", or an ImplicitMidpoint")
    validation.require_whole(max_steps, "max_steps", 1)
    require_adjoint(adjoint)
    end, grid = validation.as_known(t1), None
    times = evenly_spaced(end) if times is None else validation.as_known(times)
    require_times(times, t1)
    if isinstance(solver, ImplicitMidpoint):
        grid = even_steps(times, end, solver.step_length, model.problem(None, ()).jump_times)
        max_steps = grid.size
    settings = Settings(tolerance, solver, max_steps=max_steps)
    # Inside a transformation, this traces all numbers, even if they are known.
    ride = Ride(model, jnp.add(end, 0.0), settings, grid)
    spec = RideSpec(*eqx.partition(ride, eqx.is_array_like))
    inside = validation.is_traced((spec, times))
    # Steps of other implicit solvers cannot be repeated cheaply, so they end on the times.
    if inside or not isinstance(settings.for_steps_alone, diffrax.AbstractERK | ImplicitMidpoint):
        return _sampled(spec, times, adjoint if inside else None)
    steps, stats = followed(spec)
    return dataclasses.replace(read_off_compiled(spec, times, steps.at(spec, np.asarray(times)), stats), steps=steps)


# Compiled as a whole even under a bare `vmap` or `grad`, which would otherwise dispatch each operation.
@eqx.filter_jit
def _sampled(spec: RideSpec, times: Times, adjoint: diffrax.AbstractAdjoint | None) -> Trajectory:
    """The run at `times`; NaN and `finished` false if a traced number is out of range."""
    model, t1, settings, grid = spec.ride
    is_legal, _, samples = sampled_if_legal(model, times, t1, settings, grid, adjoint)
    outcome = samples.outcome
    rejected = outcome.rejected[0].astype(int)
    accepted = (outcome.steps[0] - outcome.rejected[0]).astype(int)
    stats = Stats(accepted, rejected, is_legal & (outcome.status[0] == REACHED_END))
    run = read_off(spec, times, samples.rows, stats)
    return eqx.tree_at(
        lambda trajectory: (trajectory.t, trajectory.stats), validation.nan_unless(is_legal, run), (times, stats)
    )


def even_steps(times: Times, t1: Number, max_duration: Number, jumps: Array | None) -> Float[Array, " steps"]:
    """Times from 0 to `t1`, at most `max_duration` apart, that include all `times` and all known `jumps` of the input, and are
    evenly spaced between them.

    **Raises:** `ValueError` if another argument is traced, because the number of steps is part of the program.
    """
    for name, number in {"t1": t1, "times": times, "step_length": max_duration}.items():
        if validation.is_traced(number):
            raise ValueError(f"{name} is traced and must be known for ImplicitMidpoint, whose steps are fixed")
    known_jumps = np.zeros(0) if jumps is None or validation.is_traced(jumps) else np.asarray(jumps)
    # Inside of `jit`, a comparison with an array of JAX would be traced.
    inside = known_jumps[(known_jumps > 0.0) & (known_jumps < float(t1))]
    knots = np.union1d(np.append(np.asarray(times), inside), [0.0, float(t1)])
    counts = np.ceil(np.diff(knots) / float(max_duration) * (1.0 - 1e-12)).astype(int)
    pieces = [np.linspace(a, b, n, endpoint=False) for a, b, n in zip(knots, knots[1:], counts, strict=False)]
    return jnp.asarray(np.concatenate([*pieces, knots[-1:]]))
