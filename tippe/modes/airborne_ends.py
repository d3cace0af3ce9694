"""Convert the final states of runs over any arena to states in contact, and compute their energy and why a contact
ended."""

from typing import Any

import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from ..model.scene import Scene
from ..model.state import parts
from ..model.stick_slip import StickSlip
from ..model.top import Top
from .airborne import FLYING, ON_STEM, OWN, SLIDING, flying_body, below, flight_state, in_contact, lift_off, standing
from .airborne_stick_slip import ROLLING
from .free_body import balls, gap_rate


def on_the_ground(
    scene: Scene[Top], state: Float[Array, "components cells"], mode: Int[Array, " cells"]
) -> Float[Array, "14 cells"]:
    """States of runs, in the layout for sliding on the top's own sphere. States of other modes refer to the foot below
    that sphere.
    """
    return _above_the_ground(scene, state, mode)[0]


def airborne_energy(
    scene: Scene[Top], state: Float[Array, "components cells"], mode: Int[Array, " cells"]
) -> tuple[Float[Array, " cells"], Float[Array, " cells"]]:
    """The least and the greatest energy [J] that a state in a mode may have; here these are the same."""
    state, distance, rate = _above_the_ground(scene, state, mode)
    if isinstance(scene.dynamics, StickSlip):
        state = jnp.where(mode == ROLLING, scene.dynamics.rolling.carried_along(state), state)
    total = scene.energy(state) + lifted(scene, state, distance, rate)
    return total, total


def lifted(scene: Scene[Top], state: Float[Array, "14 ..."], distance: Any, rate: Any) -> Float[Array, "..."]:
    """Difference [J] between the energy of a flying top and that of the same state in contact; `distance` [m] is that
    of its sphere from the ground, and `rate` [m/s] the rate of this distance."""
    _, e, L, place = parts(state)
    # In contact the velocity along n is that of the centre of mass about the sphere's centre.
    moment = -scene.body.offset * (L[0] * e[1] - L[1] * e[0]) / scene.body.I1
    potential = scene.gravity * distance * scene.frame.vertical(place)[2]
    return scene.body.mass * (potential + 0.5 * ((moment + rate) ** 2 - moment**2))


def _above_the_ground(
    scene: Scene[Top], state: Float[Array, "components cells"], mode: Int[Array, " cells"]
) -> tuple[Float[Array, "14 cells"], Float[Array, " cells"], Float[Array, " cells"]]:
    """States as `on_the_ground` has them, and the distance [m] of the top's own sphere with its rate [m/s]."""
    flies, flight = mode == FLYING, state[:OWN]
    if scene.body.stem is not None:
        on_stem = mode == ON_STEM
        flies, flight = (
            mode != SLIDING,
            jnp.where(on_stem, lift_off(scene, flight, False, balls(scene.body)[1]), flight),
        )
    flying = flight_state(flight)
    ground = below(scene, flying)
    free = flying_body(scene, flying, ground)
    rate = gap_rate(scene.body, balls(scene.body)[0], free)
    contact = jnp.where(flies, in_contact(ground, free), state[:OWN])
    return contact, jnp.where(flies, ground.gap, 0.0), jnp.where(flies, rate, 0.0)


def loss(scene: Scene[Top], state: Float[Array, "components ..."]) -> Int[Array, "..."]:
    """Why a contact ended, if it was not merely lost: a code in `LOSSES` (`tippe/model/contact_dynamics.py`)."""
    dynamics, state = scene.dynamics, state[:OWN]
    if scene.body.stem is None:
        return dynamics.loss(state)
    # The domain margin of the touching sphere has vanished.
    stem = standing(scene, balls(scene.body)[1])
    on_stem = jnp.abs(stem.contact_margin(state)) < jnp.abs(dynamics.contact_margin(state))
    return jnp.where(on_stem, stem.loss(state), dynamics.loss(state))
