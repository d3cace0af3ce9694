"""The top as a model for the functions of `nonholonomic.runs`."""

import dataclasses
from collections import Counter
from collections.abc import Collection
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Bool, Float, Int, PyTree

from nonholonomic.compilation.xla_cpu import compiled_setup
from nonholonomic.geometry import CarriedFrame, Cylinder, Plane, Sphere, cross, scale, sum_vectors
from nonholonomic.geometry.vector import planar_length
from nonholonomic.hybrid import BETWEEN, AbstractBatchedMode, HybridOutcome
from nonholonomic.integration import AbstractProblem, CoreProblem, Outcome
from nonholonomic.integration.problem import FAILED, Status
from nonholonomic.parameters import description, full_name, numbers, numbers_of
from nonholonomic.runs.event import EventFunction, with_event
from nonholonomic.runs.model import AbstractModel, AbstractSceneModel, Names, Number, Start, model_of, run_of, statuses
from nonholonomic.runs.table import TableForm
from nonholonomic.sweeps import Quantity, Variable
from nonholonomic.text import name_of
from nonholonomic.validation import Bound, Function, all_bounds, explaining, legal, require_kind, require_scalars

from ..friction import NoSlip
from ..model.body import Top
from ..model.dynamics import LOSSES, NO_COSINE, inclination, joined, parts
from ..model.rigid import AbstractRigidBody
from ..model.scene import SPINS, Launch, Scene
from ..modes.airborne import airborne_modes
from ..modes.plane import hopping_modes
from ..modes.problems import BEHIND_PATH, INVERTED, Event, InversionProblem, StemContact, event_of, trajectory_problem
from ..modes.sticking import ROLLING, above_the_ground, energy_in, loss, stick_slip_modes
from .observables import COMPONENTS, DIRECTION, ON_CURVED, PASSIVE, PATH, AbstractTrajectory, allowance, quantities_of
from .trajectory import HybridTrajectory, Trajectory, simulate_launch

#: What to do about a number of a launch that a function does not take.
IN_A_LAUNCH = "a launch has it: launch=tippe.Launch(theta, spin), or launch=tippe.Launch.degrees(theta, rpm)"


def of_launches(function: Function) -> Function:
    """Let a function of launches name its arguments where it is called with others, and say how a launch is made."""
    names = ("theta", "spin", "eta", "azimuth", "degrees")
    advice = {name: IN_A_LAUNCH for name in names} | {"rpm": SPINS, "omega": SPINS}
    return explaining(function, advice | {"friction": "a scene has the law; mu takes coefficients"})


def modes_of(
    scene: Scene, problem: InversionProblem, tolerance: Number, last: bool, with_quadratures: bool = False
) -> tuple[tuple[AbstractBatchedMode, ...], Int[Array, " cells"]]:
    """The modes of runs in a scene whose runs are not smooth, and the index of each cell's first mode. **Arguments:** as for
    `stick_slip_modes`."""
    if scene.friction.set_valued:
        return stick_slip_modes(scene, problem, tolerance, last, with_quadratures)
    modes = hopping_modes if scene.flies_in_closed_form else airborne_modes
    return modes(scene, problem, last, with_quadratures)


@compiled_setup
def _start_with_path(scene: Scene, launch: Launch, cells: int) -> InversionProblem:
    """The launches of runs of several modes, with the passive quadratures: path, rotation and work."""
    state, scales = trajectory_problem((scene, launch), cells).start()
    if scene.flies_in_closed_form:
        # The path is that of the centre of mass.
        place = state[8:10] - scene.body.offset * state[2:4]
        state = jnp.concatenate([state[:8], place, state[10:]])
    return InversionProblem(scene.dynamics, jnp.asarray(NO_COSINE), state, scales)


def why_unresolved(smooth: bool) -> str:
    """The reasons why a run may be unresolved, of one smooth motion or of several modes."""
    grown = (
        "its energy has grown by more than the tolerance allows, although nothing drives the top: the law of friction pushes "
        "it, or the arena's heights do not fit its normals"
    )
    reasons = "the model does not determine the motion from there on, or the mode changed too often, or"
    return grown if smooth else f"{reasons} {grown}; tippe.simulate states which"


# The parameters that can be varied, and the names of the axes along them.

UNITS = Top.units | Scene.units | Launch.units

#: Descriptions of the axes.
LONG_NAMES = {"theta": "θ(0)", "eta": "η(0)", "azimuth": "φ(0)", "spin": "spin ω₃(0)", "mu": "friction μ"}
LONG_NAMES |= {"mass": "mass m", "radius": "radius", "offset": "offset a", "equatorial": "equatorial half axis b"}
LONG_NAMES |= {"polar": "polar half axis p", "I1": "moment of inertia I₁", "I3": "moment of inertia I₃"}
LONG_NAMES |= {"gravity": "gravity g", "slip_speed": "slip speed", "restitution": "restitution e_N"}

#: The parts of a launch that consist of several numbers: the name of an axis along each number, and its unit.
SEVERAL = {
    "velocity": [(f"velocity_{axis}", "m s-1") for axis in ("t1", "t2")],
    "angular_velocity": [(f"angular_velocity_{axis}", "rad s-1") for axis in ("t1", "t2", "n")],
}

#: All of these names.
LABELS = tuple(label for parts in SEVERAL.values() for label, _ in parts)


# The top as a model.

#: The names in tables of inversion times and of reversal times.
INVERSIONS = TableForm(
    {Status.EVENT: Status.INVERTED, Status.COMPLETED: Status.NOT_INVERTED},
    "inversion",
    of_time="{crossing} inversion time",
    nan_if_failed=False,
    left_open="runs end when first inverted, and crossing='both' tells which stay so",
)
REVERSALS = TableForm(
    {Status.EVENT: Status.REVERSED, Status.COMPLETED: Status.NOT_REVERSED},
    "reversal",
    of_time="reversal time",
    nan_if_failed=False,
)

#: The numbers of a run's end.
ENDS = {"end_theta": Variable("rad", np.float64, long_name="θ at the end of the run")}

#: A tilt [rad] that no number shows: a plane with a tilt has the equations for any arena.
NO_TILT = 1e-300


class TopModel(AbstractSceneModel):
    """A launch in a scene, or the launches of many cells, and the event.

    Without another event, runs end when theta reaches `angle` [rad]; when the stem first carries the top, if `angle` is
    a `StemContact`; or, with `reverses`, when the spin about the arena's normal reverses.
    """

    scene: Scene
    launch: Launch
    angle: Event = None
    event: EventFunction | None = None
    reverses: bool = eqx.field(static=True, default=False)
    #: The index of the first mode, if it is known: round-off would let a rolling start slip.
    first: Int[Array, "..."] | None = None

    components = COMPONENTS
    comparable = ("direction",)
    ends = ENDS

    @classmethod
    def of(cls, scene: Scene, launch: Launch, event: Any = None) -> AbstractModel:
        """The model of a launch, with a user's event if there is one."""
        if event is None:
            reverses = isinstance(scene.friction, NoSlip)
            return cls.timed(scene, launch, None if reverses else event_of(scene, None))
        return with_event(cls(scene=_integrated(scene), launch=launch), event)

    @classmethod
    def timed(cls, scene: Scene, launch: Launch, angle: Event) -> "TopModel":
        """The model of a launch until theta reaches an angle [rad], until the stem carries the top (`StemContact`), or,
        without an angle, until the spin reverses."""
        event = angle if angle is None or isinstance(angle, StemContact) else jnp.asarray(angle, float)
        return cls(scene=scene, launch=launch, angle=event, reverses=angle is None)

    def __reduce__(self) -> tuple[object, ...]:
        # A traced function cannot be pickled, so each process traces it.
        if self.event is None:
            return TopModel, (self.scene, self.launch, self.angle, None, self.reverses)
        return TopModel.of, (self.scene, self.launch, self.event.function)

    def without_event(self) -> "TopModel":
        return TopModel(scene=_integrated(self.scene), launch=self.launch)

    def direction(self, cells: int, number: int = 0) -> Float[Array, "components cells"]:
        # The body's axes keep their length and right angle, and the vertical keeps length 1; a body that rolls keeps rolling.
        scene, launch = self.scene, self.launch
        magnitudes, state = scene.scales(launch), scene.state(launch)
        u1, u2, r1, r2, r3, *L = (magnitudes[i] * jnp.cos(1.0 + i + number * (1.0 + i) ** 2) for i in range(8))
        _, e, _, last = parts(state)
        place = scene.frame.frame_motion(scene.start(launch)[0], (scene.body.size, scene.body.size)).place_rate
        rigid = isinstance(scene.body, AbstractRigidBody)
        x_axis = cross((r1, r2, r3), tuple(last[-3:])) if rigid else ()
        direction = joined((u1, u2), cross((r1, r2, r3), e), tuple(L), place, x_axis)
        if rigid:
            direction = jax.jvp(scene.dynamics.carried_along, (state,), (direction,))[1]
        return jnp.broadcast_to(direction.reshape(len(direction), -1), (len(direction), cells))

    @property
    def roots(self) -> dict[str, PyTree]:
        """The trees whose numbers are parameters."""
        return {"scene": self.scene, "launch": self.launch}

    def full_name(self, argument: str, name: str) -> str:
        if argument == "axes":
            return super().full_name(argument, name)
        values = numbers_of(self.roots)
        present = [name for name, value in values.items() if value is not None and np.ndim(value) == 0]
        return full_name(argument, name, [*present, *(name for name in self.known if name.startswith("event."))])

    @property
    def fixed(self) -> tuple[str, ...]:
        # A vector that a launch leaves out is no number.
        vectors = [f"launch.{name}" for name in ("place", *SEVERAL)]
        return (*vectors, *(() if self.scene.contact == "hybrid" else ("scene.restitution",)))

    def label(self, names: list[str], taken: Collection[str] | None = None) -> dict[str, tuple[str, str, str]]:
        """The name of an axis is the last part of the full name, or the full name if another of the `names` has the same last
        part or if it is `taken`, by default by a variable of a table."""
        scene, launch = self.scene, self.launch
        if taken is None:
            taken = (*self.quantities, "time", "status", "end_time", *self.ends, *self.counters, "steps", "rejected")
        coordinates = list(scene.surface.coordinates)
        if "launch.place[2]" in numbers("launch", launch) and len(coordinates) == 2:
            coordinates = [("x", "m"), ("y", "m"), ("z", "m")]
        components = {
            f"launch.{name}[{k}]": label
            for name, parts in {"place": coordinates, **SEVERAL}.items()
            for k, label in enumerate(parts)
        }
        units = UNITS | scene.body.units | scene.friction.units
        shorts = {name: name.rsplit(".", 1)[-1] for name in names}
        shorts |= {name: label for name, (label, _) in components.items() if name in shorts}
        # `place` replaces the argument `eta`.
        counts = Counter(short for name, short in shorts.items() if name != "launch.eta" or launch.place is None)
        return {
            name: (
                short if counts[short] == 1 and short not in taken else name,
                components[name][1] if name in components else units.get(short, "1"),
                LONG_NAMES.get(short, short),
            )
            for name, short in shorts.items()
        }

    def description(self) -> dict[str, Any]:
        request = {path: value for name, root in self.roots.items() for path, value in description(name, root).items()}
        return request if self.event is None else request | {"event": name_of(self.event.function)}

    def check(self) -> None:
        self.scene.check_start(self.launch)

    def legal(self) -> Bool[Array, "..."]:
        scene, launch = self.scene, self.launch
        bounds = [*all_bounds(scene), *all_bounds(launch), *scene.start_bounds(launch)]
        if self.angle is not None and not isinstance(self.angle, StemContact):
            bounds.append(Bound(self.angle, "angle", above=0.0, at_most=np.pi, unit="rad"))
        is_legal = legal(bounds)
        return is_legal & (scene.dynamics.normal_spin(scene.state(launch)) != 0.0) if self.reverses else is_legal

    @property
    def smooth(self) -> bool:
        return self.scene.contact == "stop" and not self.scene.friction.set_valued

    @property
    def fit_slopes(self) -> str:
        # The time jumps with every flight, so its derivative may have the opposite sign of the trend.
        return "exact" if self.smooth else "differences"

    @property
    def has_event(self) -> bool:
        return self.event is not None or self.angle is not None or self.reverses

    @property
    def counters(self) -> dict[str, str]:
        hops = {"hops": "flights"} if self.scene.contact == "hybrid" else {}
        return hops | ({"sticks": "changes from slip to rolling"} if self.scene.friction.set_valued else {})

    def require_differentiable(self, nested: bool, continues: bool = False) -> None:
        if continues and isinstance(self.angle, StemContact):
            raise ValueError(
                "crossing = 'last' has no derivatives for the contact of a stem: give an angle, such as "
                "angle=0.95 * np.pi, or take crossing = 'first'"
            )
        if nested and not self.smooth:
            raise ValueError(
                "second derivatives do not exist through changes of mode: contact = 'hybrid', SetValuedCoulomb"
            )

    @property
    def reduced_names(self) -> tuple[str, ...]:
        scene, law, is_rigid = self.scene, self.scene.friction, isinstance(self.scene.body, AbstractRigidBody)
        # A body of revolution that leans in another direction is the same, where all directions are alike.
        is_shifted = scene.level and (law.isotropic or law.set_valued) and not is_rigid
        place = ("eta",) * isinstance(scene.surface, Cylinder | Sphere) + ("azimuth",) * (not is_shifted)
        return ("theta", *place, *(() if isinstance(law, NoSlip) else LABELS[:2]), *LABELS[2:])

    @property
    def reduced_start(self) -> list[Array]:
        launch = self.launch
        velocity = () if isinstance(self.scene.friction, NoSlip) else launch.velocity or ()
        place = [getattr(launch, name) for name in ("theta", "eta", "azimuth") if name in self.reduced_names]
        return [*place, *velocity, *(launch.angular_velocity or ())]

    def normalised(self) -> "TopModel":
        scene = self.scene
        if isinstance(scene.frame, CarriedFrame) or (isinstance(scene.body, AbstractRigidBody) and not scene.level):
            place = "a level plane for this body" if scene.contact == "stop" else "contact = 'stop'"
            raise ValueError(f"system: periodic motions are found on planes, cylinders and spheres; choose {place}")
        Bound(self.launch.theta, "theta", above=0.0, below=np.pi, why="the axis must lean on the section").require()
        first = jnp.zeros(1, int) if self.smooth else self.modes(1, jnp.asarray(1e-9), self.comparable, False)[1]
        state = self.reduced(scene.state(self.launch)[:, None], first)[:, 0]
        values = dict(zip(self.reduced_names, state, strict=True))
        velocity = None if isinstance(scene.friction, NoSlip) else tuple(state[-5:-3])
        numbers = (values["theta"], 0.0, values.get("eta", 0.0), values.get("azimuth", 0.0))
        place = (0.0, 0.0) if isinstance(scene.surface, Plane) else None
        launch = Launch(*numbers, place=place, velocity=velocity, angular_velocity=tuple(state[-3:]))
        return dataclasses.replace(self, launch=launch, first=None if self.smooth else first[0])

    def reduced(self, rows: Float[Array, "rows cells"], mode: Int[Array, " cells"]) -> Float[Array, "components cells"]:
        scene = self.scene
        inside, is_rigid = -scene.surface.sign(scene.side, "inside"), isinstance(scene.body, AbstractRigidBody)
        state = rows[: 8 + len(scene.frame.lengths) + 3 * is_rigid]
        if scene.friction.set_valued:
            state = jnp.where(mode == ROLLING, scene.dynamics.rolling.carried_along(state), state)
        (u, e, _, place), w = parts(state), scene.dynamics.rotation(state)[0]
        if isinstance(scene.body, Top):
            u = sum_vectors(u, scale(scene.body.offset, cross(w, e)[:2]))
        # The angle from the frame's first tangent to that of a launch.
        east, lean = jnp.zeros_like(e[0]), jnp.arctan2(e[1], e[0])
        if "azimuth" not in self.reduced_names:
            east = lean
        elif scene.level and is_rigid:
            # The direction of the normal in the body's axes, of which x is the last part of the place.
            east = lean - jnp.arctan2(-cross(e, place[-3:])[2], -place[-1])
        elif isinstance(scene.surface, Sphere):
            east = jnp.arctan2(inside * place[1], inside * place[0])
        cosine, sine = jnp.cos(east), jnp.sin(east)
        (x, y), *others = (
            (cosine * part[0] + sine * part[1], cosine * part[1] - sine * part[0], *part[2:]) for part in (e[:2], u, w)
        )
        values = {"theta": inclination(e), "azimuth": jnp.arctan2(y, x)} | dict(
            zip(LABELS, sum(others, ()), strict=True)
        )
        if isinstance(scene.surface, Sphere):
            values["eta"] = jnp.arctan2(planar_length(place[0], place[1]), inside * place[2])
        elif isinstance(scene.surface, Cylinder):
            values["eta"] = jnp.arctan2(inside * place[0], inside * place[1])
        return jnp.stack([values[name] for name in self.reduced_names])

    @property
    def further_times(self) -> dict[str, tuple[str, AbstractModel]]:
        if not self.scene.has_stem or self.event is not None:
            return {}
        on_stem = TopModel.timed(self.scene, self.launch, StemContact())
        return {"stem_time": ("time at which the stem first carries the top", on_stem)}

    def _without_path(self, cells: int | None, names: Names) -> InversionProblem | None:
        """The motion of runs that need no path, because nearby runs are compared, without an event, or because they end on
        the event of the model itself; `None` for other runs."""
        compares = names == self.comparable
        if not compares and not (self.event is None and self.has_event and names == ()):
            return None
        assert cells is not None
        problem = InversionProblem.of(self.scene, self.launch, INVERTED if compares else self.angle, cells)
        return dataclasses.replace(problem, cos_angle=jnp.asarray(NO_COSINE)) if compares else problem

    def problem(self, cells: int | None, names: Names) -> AbstractProblem:
        if (problem := self._without_path(cells, names)) is not None:
            # A turning frame turns by a different angle for each launch, and the difference would count as divergence.
            return dataclasses.replace(problem, dynamics=self.scene.dynamics) if names else problem
        scene, run = self.scene, trajectory_problem((self.scene, self.launch), cells)
        # Nearby runs are compared in a frame that does not turn.
        needs = {PASSIVE} if names is None else set(names).intersection(self.comparable or ())
        needs = needs.union(*(self.quantities[name].needs for name in names or () if name not in needs))
        if PASSIVE in needs:
            return run
        # Only some quantities need the path, and few need rotation or work. On the plane, a run without path, rotation and
        # work takes half the time. If no quantity has a direction, the frame turns on the level plane, and samples are
        # thirty to a hundred times as accurate.
        if scene.level and DIRECTION not in needs:
            turning = eqx.tree_at(lambda run: run.problem.dynamics, run, scene.turning_dynamics)
            return CoreProblem(turning, run.leading)
        has_path = PATH in needs or (ON_CURVED in needs and not isinstance(scene.surface, Plane))
        return CoreProblem(run, len(run.start()[0]) - BEHIND_PATH if has_path else run.leading)

    def modes(self, cells: int, tolerance: Number, names: Names, continues: bool) -> Start:
        if self.smooth:
            return super().modes(cells, tolerance, names, continues)
        core = self._without_path(cells, names)
        problem = _start_with_path(self.scene, self.launch, cells) if core is None else core
        modes, first = modes_of(self.scene, problem, tolerance, continues and core is not None, core is None)
        return modes, first if self.first is None else jnp.broadcast_to(self.first, cells), problem.states

    @property
    def quantities(self) -> dict[str, Quantity]:
        return quantities_of(self.scene)

    def read(
        self, names: tuple[str, ...], time: Array, rows: Float[Array, "rows *cells"], mode: Int[ArrayLike, "..."] | None
    ) -> dict[str, Array]:
        run = dataclasses.replace(self.moment(rows, mode), start=self.scene.state(self.launch))
        return {name: getattr(run, name) for name in names}

    def moment(self, rows: Float[Array, "rows *cells"], mode: Any) -> AbstractTrajectory:
        """The states as a trajectory without times."""
        scene, kind, zeros = self.scene, self.trajectories, jnp.zeros(rows.shape[1:])
        core = len(scene.state(self.launch))
        if scene.contact == "hybrid":
            mode = jnp.broadcast_to(BETWEEN if mode is None else mode, zeros.shape)
        else:
            # Rows without a path, or without rotation and work, end earlier.
            missing = core + len(scene.start(self.launch)[1]) + BEHIND_PATH - len(rows)
            rows = jnp.concatenate([rows, jnp.zeros((missing, *zeros.shape))]) if missing > 0 else rows
        return kind(zeros, scene, **kind.parts_of(scene, rows, mode, core))

    @property
    def trajectories(self) -> type[AbstractTrajectory]:
        """The class of trajectories of the scene."""
        return HybridTrajectory if self.scene.contact == "hybrid" else Trajectory

    def ended(self, outcome: Outcome | HybridOutcome, tolerance: Number) -> Int[Array, " cells"]:
        scene = self.scene
        cells = outcome.status.shape[0]
        start = InversionProblem.of(scene, self.launch, None if self.reverses else INVERTED, cells)
        first = mode = jnp.zeros(cells, int)
        if isinstance(outcome, HybridOutcome) and not self.smooth:
            first, mode = modes_of(scene, start, tolerance, False)[1], outcome.mode
        state = jnp.asarray(outcome.state)[: len(start.states)]
        energy_before = energy_in(scene, start.states, first)[1]
        energy_after = energy_in(scene, state, mode)[0]
        # Then the arena's heights, the law of friction or the integration is wrong. NaN counts as not grown.
        grown = (energy_after > energy_before + allowance(scene, energy_before, tolerance)) & (outcome.status != FAILED)
        codes = jnp.array([int(status) for status in LOSSES])
        # On the level plane, a run continues where contact is lost, and the ball fits everywhere.
        left_domain = Status.JAMMED if scene.flies_in_closed_form else codes[loss(scene, state)]
        return jnp.where(grown, int(Status.UNRESOLVED), statuses(outcome.status, left_domain))

    def at_end(self, outcome: Any, start: Float[Array, "components cells"]) -> dict[str, Array]:
        state = jnp.asarray(outcome.state)[: len(start)]
        if self.scene.contact == "hybrid" and not self.scene.flies_in_closed_form:
            state = above_the_ground(self.scene, state, outcome.mode)[0]
        return {"end_theta": self.scene.theta(state)}


def _integrated(scene: Scene) -> Scene:
    """A scene whose flights, if any, are integrated. A flight in closed form can end only at an angle, not at another event
    or time interval."""
    if scene.flies_in_closed_form:
        return eqx.tree_at(lambda scene: scene.surface, scene, Plane(NO_TILT))
    return scene


run_of.register(TopModel, simulate_launch)


@model_of.register(Scene)
def _(system: Scene, start: Any, event: Any = None, input: object = None, jumps: object = None) -> AbstractModel:
    require_kind(start, "start", Launch)
    if input is not None or jumps is not None:
        name = "jumps" if input is None else "input"
        raise ValueError(f"{name} must be None for a tippe.Scene: nothing drives a top")
    lists = "axes of sweep take lists, and jax.vmap maps over them"
    require_scalars(numbers("scene", system, functions=False) | numbers("launch", start), lists)
    system.check_start(start)
    return TopModel.of(system, start, event)
