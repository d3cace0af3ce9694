"""Motion on one smooth contact, as problems for the integrator, and the base of the modes with flights."""

from typing import Any, TypeAlias

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Bool, Float, Int

from nonholonomic.compilation.xla_cpu import compiled_setup, least
from nonholonomic.geometry import Component, Tangent, Vector, cross, dot, rate_in_frame, scale, stacked, sum_vectors
from nonholonomic.hybrid import AbstractBatchedMode
from nonholonomic.integration import AbstractPassive, AbstractProblem, Components, ExtendedProblem, Lanes, States
from nonholonomic.validation import as_number

from ..model.body import Top
from ..model.dynamics import COS_THETA, AbstractDynamics, Dynamics, parts
from ..model.rigid import AbstractRigidDynamics
from ..model.scene import Launch, Scene
from ..model.stick_slip import StickSlip

# Motion on one smooth contact until theta reaches an angle, or the spin reverses, or the contact ends, for many cells.


class StemContact(eqx.Module):
    """The event that the stem of a top first carries it, in place of an angle that theta reaches."""


#: The inclination [rad] at which a body without a stem counts as turned over.
INVERTED = 0.95 * jnp.pi

#: Stands for the cosine of the angle where the event is that the stem first carries the top, so that one program serves both;
#: and the cosine that puts every state beyond the event.
STEM_COSINE, BEYOND = -3.0, 2.0


def event_of(scene: Scene, angle: ArrayLike | None) -> Float[Array, "..."] | StemContact:
    """The event of a run: theta reaches the angle [rad]; or, without an angle, the top has turned over.

    A top with a stem has turned over when its stem first carries it: when the stem bears a force or, as it lands, an
    impulse. In flight nothing carries the top, whatever theta. No angle defines this event, because after a hop the stem
    lands at a larger theta, and in a curved arena `Top.stem_angle` is not exactly the angle of the contact.
    """
    if angle is None and scene.has_stem:
        return StemContact()
    return as_number(INVERTED if angle is None else angle)


def angle_of(scene: Scene, angle: ArrayLike | None) -> Float[Array, "..."]:
    """The angle [rad] itself; or, without an angle, the inclination beyond which the top has turned over on a level
    plane."""
    event = event_of(scene, angle)
    return scene.body.stem_angle if isinstance(event, StemContact) else event


#: The angle that ends a run [rad], the contact of the stem, or `None`: a reversal of the spin.
Event: TypeAlias = Float[ArrayLike, "..."] | StemContact | None


class InversionProblem(AbstractProblem):
    """Launches that end when theta reaches an angle or the contact is lost or jams.

    If `cos_angle` is `None`, they end when the spin about the arena's normal reverses; `spin` is the initial spin
    [rad/s]. If the event is that the stem first carries the top, no angle ends a run: reset maps determine when the stem
    takes over.
    """

    dynamics: AbstractDynamics
    # An array, or `None`.
    cos_angle: Any
    states: States
    scales: States
    spin: Float[Array, "..."] | None = None
    # Whether a flight follows where the contact is lost.
    flies: bool = eqx.field(static=True, default=False, kw_only=True)

    @classmethod
    def of(cls, scene: Scene[Top], launch: Launch, angle: Event, cells: int) -> "InversionProblem":
        """The problem of the given number of cells; the numbers of scene and launch are scalars or arrays with one
        number per cell. The frame is that of `Scene.turning_dynamics`, so final states do not contain directions.
        """
        event = angle if angle is None or isinstance(angle, StemContact) else jnp.asarray(angle)
        return _inversion_problem(scene, launch, event, cells)

    def start(self) -> tuple[States, States]:
        return self.states, self.scales

    def field(self, time: Lanes, state: Components) -> States:
        return self.dynamics.field(state)

    def event_function(self, state: States) -> Lanes:
        if self.cos_angle is None:
            assert isinstance(self.dynamics, StickSlip | AbstractRigidDynamics)
            assert self.spin is not None
            return self.dynamics.normal_spin(state) / self.spin
        return state[COS_THETA] - self.cos_angle

    def domain_margin(self, time: Lanes, state: States) -> Lanes:
        return least(*self.margins(time, state))

    def lost_at_start(self, state: States) -> Bool[Array, "*lanes"] | None:
        # A top that may fly slides on without load: both are the same motion.
        return None if self.flies else self.dynamics.unloaded(state, self.scales)

    def margins(self, time: Lanes, state: States) -> tuple[Lanes, ...]:
        return self.dynamics.margins(state)


@compiled_setup
def _inversion_problem(scene: Scene[Top], launch: Launch, angle: Event, cells: int) -> InversionProblem:
    states = scene.state(launch)
    shape = (states.shape[0], cells)
    states = jnp.broadcast_to(states.reshape(shape[0], -1), shape)
    scales = jnp.broadcast_to(scene.scales(launch).reshape(shape[0], -1), shape)
    dynamics = scene.turning_dynamics
    if angle is None:
        return InversionProblem(dynamics, None, states, scales, dynamics.normal_spin(states))
    cos_angle = jnp.asarray(STEM_COSINE) if isinstance(angle, StemContact) else jnp.cos(angle)
    return InversionProblem(dynamics, cos_angle, states, scales)


# Motion on one smooth contact with the path on the arena, the orientation about the axis and the work of friction.

#: Number of the passive quadratures after the path.
BEHIND_PATH = 5


class Quadratures(AbstractPassive):
    """The passive quadratures of a top in contact: the arena's path, the vector c, the spin angle and the work of friction.

    c is a unit vector across the axis that moves with the axis without rotation about it. The body's first axis is c
    turned about e by the spin angle, so every integrated component changes as slowly as the axis.

    - `of_mass`: whether the path belongs to the centre of mass, along a level plane.
    """

    of_mass: bool = eqx.field(static=True, default=False)

    def rates(self, problem: Any, time: Lanes, state: States, passive: Array) -> Array:
        dynamics, (u, e, L, _) = problem.dynamics, parts(state)
        motion, (*path, c1, c2, c3, _, _) = dynamics.motion(state), passive
        c, frame_rate = (c1, c2, c3), (None, None) if self.of_mass else motion.frame_rate
        path_rate = u if self.of_mass else dynamics.frame.cyclic_rate(tuple(path), motion.velocity, frame_rate)
        # In a frame that turns, the components of the axis have another rate than the axis.
        if self.of_mass or not isinstance(dynamics, Dynamics):
            axial_rate = dot(sum_vectors(motion.rate[2:5], scale(-1.0, rate_in_frame(e, frame_rate))), c)
        else:
            axial_rate = dot(cross(L, e), c) * dynamics.per_transverse
        rates = (*path_rate, *c_rate(c, e, axial_rate, frame_rate), motion.spin)
        return stacked((*motion.rate, *rates, motion.friction_power), state)


def c_rate(c: Vector, axis: Vector, axial_rate: Component, frame_rate: Tangent = (None, None)) -> tuple[Component, ...]:
    """c' = (e x e') x c = -(e'.c) e, with `axial_rate` = e'.c [1/s], in a frame that turns at a rate [rad/s]."""
    return sum_vectors(scale(-axial_rate, axis), rate_in_frame(c, frame_rate))


@compiled_setup
def trajectory_problem(modules: tuple[Scene, Launch], cells: int | None = None) -> ExtendedProblem[InversionProblem]:
    """The run of one launch, or the runs of several cells; numbers are scalars or arrays with one number per cell."""
    scene, launch = modules
    size, weight = scene.body.size, scene.body.mass * scene.gravity
    sine, cosine = jnp.sin(launch.theta), jnp.cos(launch.theta)
    perpendicular = (cosine * jnp.cos(launch.azimuth), cosine * jnp.sin(launch.azimuth), -sine)
    path, zero, unit = scene.start(launch)[1], jnp.zeros(()), jnp.ones(())
    values = (*path, *perpendicular, zero, zero)
    scales = (*[size] * len(path), unit, unit, unit, unit, weight * size)
    values, scales = (jnp.stack(jnp.broadcast_arrays(*rows)) for rows in (values, scales))
    rows = (scene.state(launch), scene.scales(launch), values, scales)
    if cells is not None:
        rows = tuple(jnp.broadcast_to(row.reshape(len(row), -1), (len(row), cells)) for row in rows)
    problem = InversionProblem(scene.dynamics, None, rows[0], rows[1])
    return ExtendedProblem(problem, Quadratures(), rows[2], rows[3], ends_on_event=False)


# Common base of all modes of runs with flights.


class AbstractFlyingMode(AbstractBatchedMode):
    """A mode of runs that continue through flights.

    - `scene`: a scene with `contact="hybrid"`; `scales`: magnitudes that scale absolute errors of the state.
    - `cos_angle`: cosine of the theta that is the event, or `STEM_COSINE`.
    - `with_quadratures`: whether this is a single run whose path is kept, with passive quadratures after its state.
    """

    scene: Scene[Top]
    scales: States
    cos_angle: Float[Array, "..."]
    with_quadratures: bool = eqx.field(static=True)

    @property
    def awaits_stem(self) -> Bool[Array, "..."]:
        """Whether the event is that the stem first carries the top."""
        return self.cos_angle == STEM_COSINE

    def cos_angle_for(self, on_stem: Bool[Array, ""] | bool) -> Float[Array, "..."]:
        """The cosine of the angle for runs in which the stem carries the top or not: if so, an event of the stem is past."""
        return jnp.where(on_stem & self.awaits_stem, BEYOND, self.cos_angle)

    def extended(self, problem: AbstractProblem, passive: AbstractPassive, state: States) -> AbstractProblem:
        """The problem for given states, including the passive quadratures."""
        size = len(problem.start()[0])
        if not self.with_quadratures:
            return problem
        return ExtendedProblem(problem, passive, state[size:], self.scales[size:])


#: The modes of runs, and the index of the mode in which each starts.
Started = tuple[tuple[AbstractFlyingMode, ...], Int[Array, " cells"]]
