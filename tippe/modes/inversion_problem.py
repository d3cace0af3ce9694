"""Motion on one smooth contact until theta reaches an angle, or the spin reverses, or the contact ends, for many cells."""

from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Bool, Float

from nonholonomic.compilation.xla_cpu import compiled_setup
from nonholonomic.integration import AbstractProblem

from ..model.dynamics import NO_COSINE, Dynamics
from ..model.launch import Launch
from ..model.rigid_dynamics import AbstractRigidDynamics
from ..model.scene import Scene
from ..model.state import COS_THETA
from ..model.stick_slip import ContactMode, StickSlip
from ..model.top import Top


class StemContact(eqx.Module):
    """The event that the stem of a top first carries it, in place of an angle that theta reaches."""


class InversionProblem(AbstractProblem):
    """Launches that end when theta reaches an angle or the contact is lost or jams.

    If `cos_angle` is `None`, they end when the spin about the arena's normal reverses; `spin` is the initial spin
    [rad/s]. For a top with a stem, `stem_counts` is 1 if the event is that the stem first carries the top, and 0 if the
    event is an angle; one program serves both.
    """

    dynamics: Dynamics | StickSlip | ContactMode | AbstractRigidDynamics
    # An array, or `None`.
    cos_angle: Any
    states: Float[Array, "components cells"]
    scales: Float[Array, "components cells"]
    spin: Float[Array, "..."] | None = None
    # An array for a top with a stem, or `None`.
    stem_counts: Any = None
    # Whether a flight follows where the contact is lost.
    flies: bool = eqx.field(static=True, default=False, kw_only=True)

    @classmethod
    def of(
        cls, scene: Scene[Top], launch: Launch, angle: Float[ArrayLike, "..."] | StemContact | None, cells: int
    ) -> "InversionProblem":
        """The problem of the given number of cells; the numbers of scene and launch are scalars or arrays with one
        number per cell. The frame is that of `Scene.turning_dynamics`, so final states do not contain directions.
        """
        event = angle if angle is None or isinstance(angle, StemContact) else jnp.asarray(angle)
        return _problem(scene, launch, event, cells)

    def start(self) -> tuple[Float[Array, "components cells"], Float[Array, "components cells"]]:
        return self.states, self.scales

    def field(self, time: Float[Array, " lanes"], state: Float[Array, "components lanes"]) -> Any:
        return self.dynamics.field(state)

    def event_function(self, state: Float[Array, "components lanes"]) -> Float[Array, " lanes"]:
        if self.cos_angle is None:
            assert not isinstance(self.dynamics, Dynamics)
            assert self.spin is not None
            return self.dynamics.normal_spin(state) / self.spin
        return state[COS_THETA] - self.cos_angle

    def domain_margin(
        self, time: Float[Array, " lanes"], state: Float[Array, "components lanes"]
    ) -> Float[Array, " lanes"]:
        return self.dynamics.contact_margin(state)

    def lost_at_start(self, state: Float[Array, "components lanes"]) -> Bool[Array, " lanes"] | None:
        # A top that may fly slides on without load: both are the same motion.
        return None if self.flies else self.dynamics.unloaded(state, self.scales)

    def margins(self, time: Float[Array, " lanes"], state: Float[Array, "components lanes"]) -> tuple[Any, ...]:
        return self.dynamics.margins(state)


def beyond_on_stem(
    value: Float[Array, " cells"], on_stem: Bool[Array, "..."], stem_counts: Float[Array, "..."] | None
) -> Float[Array, " cells"]:
    """The event function, or -1 if the stem carries the top and this counts, so that a run which starts on the stem is
    beyond the event. Later, reset maps determine when the stem takes over."""
    return value if stem_counts is None else jnp.where(on_stem & (stem_counts > 0.0), -1.0, value)


@compiled_setup
def _problem(
    scene: Scene[Top], launch: Launch, angle: Float[Array, "..."] | StemContact | None, cells: int
) -> InversionProblem:
    states = scene.state(launch)
    shape = (states.shape[0], cells)
    states = jnp.broadcast_to(states.reshape(shape[0], -1), shape)
    scales = jnp.broadcast_to(scene.scales(launch).reshape(shape[0], -1), shape)
    dynamics = scene.turning_dynamics
    if angle is None:
        return InversionProblem(dynamics, None, states, scales, dynamics.normal_spin(states))
    if not scene.has_stem:
        assert not isinstance(angle, StemContact)
        return InversionProblem(dynamics, jnp.cos(angle), states, scales)
    if isinstance(angle, StemContact):
        return InversionProblem(dynamics, jnp.asarray(NO_COSINE), states, scales, stem_counts=jnp.ones(()))
    return InversionProblem(dynamics, jnp.cos(angle), states, scales, stem_counts=jnp.zeros(()))
