"""The quantities of a run of a tippe top, in contact or through flights: one state at each time."""

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any, ClassVar, Self, TypeAlias, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from nonholonomic.compilation.cache import padded
from nonholonomic.geometry import Component, Pose, Vector, dot, rate_in_frame, scale, stacked, sum_vectors
from nonholonomic.hybrid import HybridPath
from nonholonomic.integration.dense import DenseSolution, all_crossings
from nonholonomic.integration.problem import Status
from nonholonomic.parameters import description
from nonholonomic.runs.model import AbstractModel, Number, model_of
from nonholonomic.runs.trajectory import AbstractRun
from nonholonomic.sweeps import Quantity, Table, chosen, run_table
from nonholonomic.text import Unit, distinguishing_labels, in_unit, unit_of
from nonholonomic.validation import ArrayOrList, is_traced, require_one_run, times_within
from nonholonomic.views.stage import Marks

from ..friction import Frictionless
from ..model.body import AbstractBody, Top
from ..model.rigid import AbstractRigidBody
from ..model.scene import Launch, Scene
from ..modes.problems import INVERTED
from ..presets import TOPS
from ..steady import group, upright_critical_spin

# The quantities of a run of a tippe top, with units and names, and the table of a run.

#: What a quantity may need in addition to the state: a frame that does not turn about n; the path on a curved arena, or on
#: any arena; the rotation about the axis and the work; the start of the run.
DIRECTION, ON_CURVED, PATH, PASSIVE, START = "direction", "curved", "path", "passive", "start"

QUANTITIES = {
    "theta": Quantity("rad", "inclination θ"),
    "eta": Quantity("rad", "place η", needs=frozenset({ON_CURVED})),
    "azimuth": Quantity("rad", "azimuth φ", needs=frozenset({DIRECTION})),
    "spin": Quantity("rad s-1", "spin ω₃"),
    "theta_rate": Quantity("rad s-1", "θ'"),
    "energy": Quantity("J", "energy"),
    "jellett": Quantity("kg m3 s-1", "Jellett's quantity"),
    "normal_force": Quantity("N", "normal force"),
    "axis": Quantity("1", "axis e", "component", needs=frozenset({DIRECTION, ON_CURVED})),
    "position": Quantity("m", "position of the centre", "component", needs=frozenset({DIRECTION, PATH})),
    "velocity": Quantity("m s-1", "velocity of the centre", "component", needs=frozenset({DIRECTION, ON_CURVED})),
    "angular_momentum": Quantity("kg m2 s-1", "angular momentum", "component", needs=frozenset({DIRECTION, ON_CURVED})),
    "slip": Quantity("m s-1", "slip velocity", "tangent", needs=frozenset({DIRECTION})),
    "jellett_drift": Quantity("1", "relative drift of Jellett's quantity", needs=frozenset({START})),
    "spin_angle": Quantity("rad", "spin angle", needs=frozenset({PASSIVE})),
    "work": Quantity("J", "work of friction", needs=frozenset({PASSIVE})),
}

#: Quantities of a body of any shape and inertia.
OF_RIGID_BODIES = {
    "normal_spin": Quantity("rad s-1", "spin about the normal"),
    "grip": Quantity("1", "friction over normal force"),
    "reaction": Quantity("N", "force of the arena", "component", needs=frozenset({DIRECTION, ON_CURVED})),
}

#: Names of components: in the fixed frame, and in the moving frame.
COMPONENTS = {"component": ("x", "y", "z"), "tangent": ("t1", "t2")}


def quantities_of(scene: Scene) -> dict[str, Quantity]:
    """The quantities of runs in a scene."""
    return QUANTITIES | OF_RIGID_BODIES if isinstance(scene.body, AbstractRigidBody) else QUANTITIES


# The run of a top: one state at each time.

#: What a top may do after it turned over: nothing, or fall back, so that it leans less than 90 degrees or stands on its sphere.
AFTERWARDS = ("", "fell back")

#: JAX's arrays, or NumPy's outside of transformations.
Values: TypeAlias = Array | np.ndarray


def of_each_run(function: Callable[[Any], Array]) -> property:
    """A property of one run that is also defined for a batch of runs from `vmap`, run by run.

    Outside transformations, the property is compiled only for numbers of times that are powers of two, because runs
    differ in their numbers of steps.
    """
    compiled = eqx.filter_jit(function)

    def get(self):
        if self.t.ndim == 1 and not is_traced((self.t, self.states, self.scene)):
            return jax.device_put(np.asarray(compiled(self.padded()))[: len(self.t)])
        batched = function
        for _ in range(self.t.ndim - 1):
            batched = eqx.filter_vmap(batched)
        return batched(self)

    return property(get, doc=function.__doc__)


def unit(vectors: Float[Array, "times 3"]) -> Float[Array, "times 3"]:
    """Vectors at unit length."""
    return vectors / jnp.linalg.norm(vectors, axis=-1, keepdims=True)


class AbstractTrajectory(AbstractRun):
    """A run at its times `t`: states as in `tippe/model/dynamics.py`, the path on the arena, spin angle [rad] and work [J].

    Vectors are arrays (times, 3) in the fixed frame (x, y, z); see `Trajectory`.
    """

    t: Float[Values, " times"]
    scene: Scene
    states: Float[Any, "components times"]
    cyclic: Float[Values, "paths times"]
    spin_angle: Float[Values, " times"]
    work: Float[Values, " times"]
    # The end of the run; not needed where only the times are read, as in a page.
    status: Any = None
    end_time: Any = None
    stats: dict[str, Any] = eqx.field(default_factory=dict)
    dense: Any = None
    # The state at the launch, and the launch.
    start: Any = None
    launch: Launch | None = None

    #: The fields with a value for each time, along the last axis.
    by_time: ClassVar[tuple[str, ...]] = ("t", "states", "cyclic", "spin_angle", "work")

    quantities: ClassVar[dict[str, Quantity]] = QUANTITIES
    portrait_axes = ("theta", "theta_rate")

    #: Distance of the top's sphere from the arena [m] and its rate [m/s]; `None` if the sphere touches at all times.
    above: ClassVar[tuple[Component, Component]] = (None, None)

    #: Further lines of the text of a run.
    notes: ClassVar[list[str]] = []

    #: Kinetic and potential energy [J], (times,); a property of every kind of run.
    energy: ClassVar[Float[Array, " times"]]

    def padded(self) -> Self:
        """The run with its last time repeated, up to a power of two, and only with the fields that observables need."""
        arrays: Any = {name: padded(np.asarray(getattr(self, name)), len(self.t)) for name in self.by_time}
        return type(self)(scene=self.scene, start=self.start, **arrays)

    @classmethod
    def parts_of(cls, scene: Scene, rows: Values, mode: Values | None, core: int) -> dict[str, Any]:
        """The fields `by_time` but the times, from output rows.

        **Arguments:** `mode`: the indices of the modes at these times, or `None` for a smooth run; `core`: the number of
        components of the state.
        """
        return {"states": rows[:core], "cyclic": rows[core:-2], "spin_angle": rows[-2], "work": rows[-1]}

    def with_rows(self, times: Float[np.ndarray, " times"], rows: Values, mode: Values | None) -> Self:
        """The same run at other times, from the output rows there."""
        return dataclasses.replace(self, t=times, **self.parts_of(self.scene, rows, mode, len(self.start)))

    def resampled(self, times: Float[np.ndarray, " times"]) -> Self:
        """The same run at other times, without checking them."""
        mode = self.dense.numbers(times) if isinstance(self.dense, HybridPath) else None
        return self.with_rows(times, self.dense.at(times), mode)

    @of_each_run
    def theta(self) -> Float[Array, " times"]:
        """Angle from the normal to the axis [rad]."""
        return self.scene.theta(self.states)

    @property
    def inversion_time(self) -> float:
        """Time [s] at which the top has turned over, like `tippe.inversion_time`: theta first reaches 0.95 pi or, for a
        top with a stem, the stem first carries the top (`stem_time`). Infinite if this does not happen by the end. The
        time is located on the run's dense output, to the tolerance of the run.

        **Raises:** `ValueError` for a run that was made inside a transformation, and for a batch.
        """
        if self.dense is None:
            raise ValueError("a run made inside jit, vmap or grad has no dense output: use tippe.inversion_time there")

        def beyond(times: Float[np.ndarray, " looks"]) -> Float[np.ndarray, " looks"]:
            return np.asarray(self.resampled(times).theta) - INVERTED

        times = np.asarray(self.dense.times)
        value = beyond(times)
        return 0.0 if value[0] >= 0.0 else float(min(all_crossings(beyond, times, value), default=np.inf))

    @of_each_run
    def theta_rate(self) -> Float[Array, " times"]:
        """Rate of change of theta [rad/s]."""
        return jax.jvp(self.scene.theta, (self.states,), (self.scene.field(self.states),))[1]

    @of_each_run
    def eta(self) -> Float[Array, " times"]:
        """Angle of the position from the arena's lowest point [rad]; 0 on the plane."""
        return self._pose.angle

    @of_each_run
    def azimuth(self) -> Float[Array, " times"]:
        """Direction in which the axis leans [rad], from t1 towards t2, in (-pi, pi]."""
        return jnp.arctan2(self.states[3], self.states[2])

    @of_each_run
    def spin(self) -> Float[Array, " times"]:
        """Angular velocity about the axis [rad/s]."""
        return self.scene.spin(self.states)

    @of_each_run
    def axis(self) -> Float[Array, "times 3"]:
        """The unit vector e along the axis."""
        return self._fixed(tuple(self.states[2:5]))

    @of_each_run
    def angular_momentum(self) -> Float[Array, "times 3"]:
        """Angular momentum about the centre of mass [kg m^2/s]."""
        return self._fixed(tuple(self.states[5:8]))

    @of_each_run
    def velocity(self) -> Float[Array, "times 3"]:
        """Velocity of the point whose path is `position` [m/s]."""
        motion = self.scene.dynamics.motion(self.states)
        rate = stacked(motion.rate, self.states)
        path_vector, change = jax.jvp(self.scene.path_from_frame, (self.states,), (rate,))
        # The frame turns while the components of the vector change.
        frame_part = scale(-1.0, rate_in_frame(path_vector, motion.frame_rate))
        return self._fixed(sum_vectors((*motion.velocity, self.above[1]), change, frame_part))

    @of_each_run
    def position(self) -> Float[Array, "times 3"]:
        """Position of the sphere's centre, or of the centre of mass for other bodies [m]; the plane is z = 0, the
        cylinder's axis x = z = 0, and a run on the plane starts above the origin."""
        pose = self._pose
        centre = sum_vectors(pose.position, scale(self.above[0], pose.axes[2]))
        path_vector = self.scene.path_from_frame(self.states)
        point = jnp.stack(centre, axis=-1)
        return point if path_vector == (None, None, None) else point + self._fixed(path_vector)

    @of_each_run
    def jellett(self) -> Float[Array, " times"]:
        """Jellett's quantity of the top's own sphere [kg m^3/s]; constant on the plane while friction acts at a point
        of this sphere, but not while a stem touches."""
        return self.scene.jellett(self.states)

    @of_each_run
    def jellett_drift(self) -> Float[Array, " times"]:
        """Change of Jellett's quantity since the launch, relative to its value there [1]."""
        start = self.scene.jellett(self.start)
        return (self.jellett - start) / jnp.abs(start)

    def at(self, times: ArrayOrList) -> Self:
        """The same run at other times, from the dense output.

        **Arguments:** `times`: increasing, within [0, `end_time`] [s]; or one time, for a run of one time.

        **Raises:** `ValueError` for times outside the run, or if the run was made inside a transformation.
        """
        if self.dense is None:
            raise ValueError("a run made inside jit, vmap or grad has no dense output: pass `times` to simulate")
        return self.resampled(times_within(times, self.end_time, "run"))

    @property
    def of_page(self) -> tuple[AbstractModel, float]:
        assert self.launch is not None
        return model_of(self.scene, self.launch), float(self.end_time)

    @property
    def codes(self) -> Int[Array, "..."] | str | None:
        return self.status

    def table_of(self, names: Sequence[str]) -> Table:
        require_one_run(self, "to_table", "; trajectory_table makes a table of many")
        quantities = chosen(quantities_of(self.scene), names)
        dims = [quantity.components for quantity in quantities.values() if quantity.components is not None]
        coords = {"time": np.asarray(self.t)} | {dim: np.array(COMPONENTS[dim]) for dim in dict.fromkeys(dims)}
        values = {name: np.asarray(quantity.of(name, self)) for name, quantity in quantities.items()}
        request = description("scene", self.scene)
        request |= {} if self.launch is None else description("launch", self.launch)
        request |= {"status": str(self.status), "end_time": float(self.end_time), "shown_in": unit_of(self)}
        return run_table(quantities, coords, values, ["time"], request)

    def labels_of(self, runs: list[Any], unit: Unit) -> list[str]:
        # By what differs in their launches and scenes.
        for run in runs:
            require_one_run(run, "a picture", ", and pass the others as others=")
        (angle, per_angle), (rate, per_rate) = (in_unit(si, unit) for si in ("rad", "rad/s"))
        scenes = [run.scene for run in runs]
        tops = [
            next((f"{name} top" for name, top in TOPS.items() if eqx.tree_equal(top(), s.body)), "own top")
            for s in scenes
        ]
        theta = "θ(0) =" if len(runs) == 1 else "θ"
        starts = [
            (f"{theta} {per_angle * float(run.theta[0]):.3g} {angle}", f"{per_rate * float(run.spin[0]):.4g} {rate}")
            for run in runs
        ]
        if set(tops) != {"own top"}:
            # The names of presets say more than their numbers.
            starts = [(top.replace("_", " "), *start) for top, start in zip(tops, starts, strict=True)]
        if tops.count("own top") < 2:
            scenes = [eqx.tree_at(lambda scene: scene.body, scene, scenes[0].body) for scene in scenes]
        return distinguishing_labels(starts, scenes, unit=unit)

    @property
    def marks(self) -> Marks:
        if self.dense is None or not isinstance(self.scene.body, AbstractBody):
            return ()
        time, afterwards = self.inversion_time, AFTERWARDS[int(self.afterwards)]
        words = f"turned over at {time:.3g} s" + (f", {afterwards}" if afterwards else "")
        return ((time, words),) if np.isfinite(time) else ()

    @property
    def afterwards(self) -> Int[Array, ""]:
        """What a top that turned over has done by the last time, as an index of `AFTERWARDS`: it fell back if it is below
        90 degrees, or if it stands on its sphere again after its stem carried it."""
        stands = self.scene.has_stem and (self.contact[-1] >= 0) & (self.contact[-1] != 1)
        return jnp.where((self.theta[-1] < 0.5 * jnp.pi) | stands, 1, 0)

    @of_each_run
    def normal(self) -> Float[Array, "times 3"]:
        """The arena's unit normal n where the top is, from the arena to the sphere's centre."""
        return jnp.stack(self._pose.axes[2], axis=-1)

    @of_each_run
    def angular_velocity(self) -> Float[Array, "times 3"]:
        """Angular velocity of the body [rad/s]."""
        return self._fixed(self.scene.dynamics.rotation(self.states)[0])

    @of_each_run
    def rotation(self) -> Float[Array, "times 3 3"]:
        """Rotation from the body to the fixed frame: its columns are the body's axes, and the third is e. For bodies of
        revolution, the first axis is de/dtheta at the start: the direction across e that leads away from the arena's
        normal."""
        # Step errors change the unit length of both vectors and their right angle.
        if isinstance(self.scene.body, AbstractRigidBody):
            e, x = unit(self.axis), self._fixed(tuple(self.states[-3:]))
            side_axis = unit(jnp.cross(e, x))
            return jnp.stack([jnp.cross(side_axis, e), side_axis, e], axis=-1)
        e, angle = unit(self.axis), self.spin_angle[:, None]
        side_axis = unit(jnp.cross(e, self._fixed(tuple(self.cyclic[-3:]))))
        c_vector = jnp.cross(side_axis, e)
        first = jnp.cos(angle) * c_vector + jnp.sin(angle) * side_axis
        return jnp.stack([first, jnp.cross(e, first), e], axis=-1)

    @property
    def _pose(self) -> Pose:
        """Where the arena's frame is."""
        place, path = tuple(self.states[8:]), tuple(self.cyclic[:-3])
        return self.scene.frame.pose(place[:-3] if isinstance(self.scene.body, AbstractRigidBody) else place, path)

    def _fixed(self, vector: Vector) -> Float[Array, "times 3"]:
        return jnp.stack([dot(vector, directions) for directions in zip(*self._pose.axes, strict=True)], axis=-1)

    @property
    def _whether_it_turned_over(self) -> str:
        """Whether and when the top turned over, as text."""
        body, time, afterwards = self.scene.body, self.inversion_time, AFTERWARDS[int(self.afterwards)]
        if np.isfinite(time):
            stem = ": the stem first carries it" if self.scene.has_stem else ""
            return f"turned over{stem} at {time:.6g} s" + (f", but {afterwards}" if afterwards else "")
        reason = ""
        if isinstance(self.scene.friction, Frictionless):
            reason = ": without friction no top turns over"
        elif self.scene.level and isinstance(body, Top):
            critical = float(upright_critical_spin(self.scene))
            if group(body) == "I":
                reason = ": a top of group I (tippe.steady.group) cannot"
            elif float(self.theta[0]) == 0.0:
                reason = ": it starts exactly upright"
            elif abs(float(self.spin[0])) < critical:
                unit, factor = in_unit("rad/s", unit_of(self))
                reason = (
                    f": below {factor * critical:.4g} {unit}, it is stable upright (tippe.steady.upright_critical_spin)"
                )
        return f"not turned over{reason}"

    def in_words(self) -> str:
        word = self.status if isinstance(self.status, str) else Status(int(self.status)).word
        angle, factor = in_unit("rad", unit_of(self))
        theta = factor * np.asarray(self.theta)
        lines = [
            f"Trajectory of {len(self.t)} times, {word} at {float(self.end_time):.6g} s",
            *([] if self.launch is None else [f"  {self.launch}"]),
            f"  theta: {theta[0]:.6g} {angle} at the start, {theta[-1]:.6g} {angle} at the end",
        ]
        if self.dense is not None and isinstance(self.scene.body, AbstractBody):
            lines.append(f"  {self._whether_it_turned_over}")
        if word == "contact_lost" and self.scene.contact == "stop" and isinstance(self.scene.body, Top):
            lines.append("  to continue through the flight, use a Scene with contact='hybrid'")
        if "axis_drift" in self.stats:
            lines.append(f"  steps: {self.stats['accepted']} accepted, {self.stats['rejected']} rejected")
            lines.append(f"  drift of |e|: {self.stats['axis_drift']:.1e}")
            lines.append(f"  energy residual: {self.stats['energy_residual']:.1e} J of {float(self.energy[0]):.4g} J")
        lines += self.notes
        # A run made inside a transformation does not know the reason.
        if isinstance(self.status, str) and word == Status.UNRESOLVED.word:
            lines.append(f"  unresolved: {self.reason()}")
        return "\n".join(lines)

    def reason(self) -> str:
        """The reason for the status "unresolved"."""
        energy = np.asarray(self.energy)
        if (gain := energy[-1] - energy[0]) > self.stats["energy_residual"]:
            return f"the energy has grown by {gain:.1e} J, although nothing drives the top"
        return f"the energy residual of {self.stats['energy_residual']:.1e} J is beyond what the tolerance allows"


# The check of the energy: without a drive, it never grows, and it decreases by the work of friction.

#: Largest allowed error of the energy, relative to its size, divided by the tolerance. Flights over ripples and in a
#: spheroid stay below 1e-4 of this value; a faulty landing away from the arena once left 8e4 times this value.
BALANCED = 1e4


#: The kind of a run.
Run = TypeVar("Run", bound=AbstractTrajectory)


def allowance(scene: Scene, energy: Number, tolerance: Number) -> Number:
    """The allowed error [J] of an energy of the given size [J] at a tolerance."""
    return BALANCED * tolerance * (abs(energy) + scene.body.mass * scene.gravity * scene.body.size)


def audited(run: Run, path: DenseSolution | HybridPath, tolerance: Number, **more: float) -> Run:
    """A single run with its statistics: steps, the greatest drift of |e|, the greatest |E - E(0) - work| [J], and more. Its
    status is "unresolved" if its energy has grown or does not balance the work of friction and impacts."""
    energy, work = np.asarray(run.energy), np.asarray(run.work)
    residual = float(np.max(np.abs(energy - energy[0] - work)))
    drift = float(np.max(np.abs(np.linalg.norm(np.asarray(run.states)[2:5], axis=0) - 1.0)))
    stats = {"accepted": path.accepted, "rejected": path.rejected, "axis_drift": drift, "energy_residual": residual}
    limit = float(allowance(run.scene, np.max(np.abs(energy)), tolerance))
    balanced = residual <= limit and energy[-1] <= energy[0] + limit
    status = run.status if balanced or run.status == Status.FAILED.word else Status.UNRESOLVED.word
    return dataclasses.replace(run, stats=stats | more, status=status)
