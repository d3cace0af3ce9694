"""A generic direction in the set of the states of a scene."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from nonholonomic.geometry import cross, vector_of

from .launch import Launch
from .rigid_body import AbstractRigidBody
from .scene import Scene
from .state import joined, parts


def generic_direction(scene: Scene, launch: Launch, cells: int) -> Float[Array, "components cells"]:
    """A generic direction, tangent to the set of states: the body's axes keep their length and right angle, and the
    vertical keeps length 1; a body that rolls keeps rolling."""
    magnitudes, state = scene.scales(launch), scene.state(launch)
    u1, u2, r1, r2, r3, *L = (magnitudes[i] * jnp.cos(1.0 + i) for i in range(8))
    _, e, _, last = parts(state)
    frame, (place, _) = scene.frame, scene.start(launch)
    place = frame.frame_motion(place, (scene.body.size, scene.body.size)).place_rate
    rigid = isinstance(scene.body, AbstractRigidBody)
    x_axis = cross((r1, r2, r3), vector_of(last[-3:])) if rigid else ()
    direction = joined((u1, u2), cross((r1, r2, r3), e), tuple(L), place, x_axis)
    if rigid:
        direction = jax.jvp(scene.dynamics.carried_along, (state,), (direction,))[1]
    return jnp.broadcast_to(direction.reshape(len(direction), -1), (len(direction), cells))
