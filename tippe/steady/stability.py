"""Matrices of the linear motion near steady motions, and their growth rates.

The matrices are Jacobians of the scene's own field, without the directions that are neutral by symmetry or by
conservation, so an eigenvalue with a positive real part always means instability.
"""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float

from nonholonomic.geometry import CarriedFrame, Torus
from nonholonomic.validation import as_number, require

from ..model.launch import Launch
from ..model.scene import Scene
from ..model.state import AXIS, PLACE
from ..model.top import Top
from .checks import MANY, require_one_scene, require_standing
from .tumbling_tops import Tumbling, quarter_turn, require_motion, tumbling_state


def standing_state(scene: Scene, spin: Float[ArrayLike, ""], inverted: bool = False) -> Float[Array, " components"]:
    """State of the vector form of a standing top at the arena's lowest point.

    **Arguments:**

    - `scene`: a `Scene` on any arena.
    - `spin`: angular velocity about the axis [rad/s].
    - `inverted`: whether the stem points into the arena.

    **Example:** with the scene of the module.

    >>> print(f"{scene.theta(steady.standing_state(scene, 100.0, inverted=True)):.4f} rad")
    3.1416 rad
    """
    require_standing(scene, spin, inverted)
    state = scene.state(Launch(0.0, spin))
    # The axis and the angular momentum point along n; only their components 4 and 7 are not 0.
    return state.at[np.array([4, 7])].multiply(-1.0 if inverted else 1.0)


def standing_matrix(scene: Scene, spin: Float[ArrayLike, ""], inverted: bool = False) -> Float[Array, "k k"]:
    """Matrix [1/s] of the linear motion near a standing top, on any arena.

    The matrix omits components along n, which change only at second order, the direction of the frame, and
    displacements along which the arena is symmetric. A scene with `contact="hybrid"` is treated like one with "stop".

    **Arguments:** as for `standing_state`.

    **Returns:** (k, k), for the velocity, axis, angular momentum and place across n, in the units of `Scene.scales`.

    **Example:** with the scene of the module.

    >>> steady.standing_matrix(scene, 50.0, inverted=True).shape
    (6, 6)
    """
    require_standing(scene, spin, inverted)
    require_one_scene(scene, spin=spin)
    body = dataclasses.replace(scene.body, stem=None) if scene.contact == "hybrid" else scene.body
    scene = dataclasses.replace(scene, body=body, contact="stop", restitution=None)
    return _standing_matrix(scene, as_number(spin), bool(inverted))


@eqx.filter_jit
def _standing_matrix(scene: Scene, spin: Float[Array, ""], inverted: bool) -> Float[Array, "k k"]:
    state = standing_state(scene, spin, inverted)
    components = [0, 1, 2, 3, 5, 6, *_places_across(scene)]
    scales = scene.scales(Launch(0.0, spin))
    jacobian = jax.jacfwd(scene.field)(state) * scales / scales[:, None]
    return jacobian[np.ix_(components, components)]


def _places_across(scene: Scene) -> range:
    """Indices of the place components that matter for the motion near the arena's lowest point."""
    count = max(len(scene.frame.place_scales(1.0)) - 1, 0)
    if isinstance(scene.frame, CarriedFrame):
        # The foot (x, y, z), whose z is along n, and the first tangent, which is only the frame's choice of axes.
        count = 1 if isinstance(scene.surface, Torus) else 2
    return range(PLACE.start, PLACE.start + count)


def tumbling_matrix(scene: Scene[Top], motion: Tumbling) -> Float[Array, "5 5"]:
    """Matrix [1/s] of the linear motion near a tumbling top, in a frame that precesses with it.

    The matrix covers the five directions that preserve |e| and Jellett's constant, without the turn about the vertical.

    **Arguments:**

    - `scene`: a `Scene` on the plane, with friction.
    - `motion`: a motion from `tumbling`.

    **Example:** with the scene of the module.

    >>> motion = steady.tumbling(scene, 1.0)
    >>> print(f"{steady.growth_rate(steady.tumbling_matrix(scene, motion)):.2f} 1/s")
    -0.35 1/s
    """
    require_motion(scene, motion)
    require_one_scene(scene, **{f"motion.{name}": value for name, value in motion._asdict().items()})
    return _tumbling_matrix(scene, motion)


@eqx.filter_jit
def _tumbling_matrix(scene: Scene[Top], motion: Tumbling) -> Float[Array, "5 5"]:
    state = tumbling_state(scene, motion)
    scales = scene.scales(Launch(motion.theta, motion.spin))

    def field_in_frame(scaled_state):
        """The rate of a scaled state in the frame that precesses."""
        state = scaled_state * scales
        return (scene.field(state) - motion.precession * quarter_turn(state)) / scales

    scaled_state = state / scales
    length = jax.grad(lambda x: jnp.sum((x * scales)[AXIS] ** 2))(scaled_state)
    jellett = jax.grad(lambda x: scene.jellett(x * scales))(scaled_state)
    excluded_directions = jnp.stack([length, jellett, quarter_turn(state) / scales], axis=1)
    basis = jnp.linalg.qr(excluded_directions / jnp.linalg.norm(excluded_directions, axis=0), mode="complete")[0][:, 3:]
    return basis.T @ jax.jacfwd(field_in_frame)(scaled_state) @ basis


def growth_rate(matrix: Float[Array, "k k"]) -> Float[Array, ""]:
    """Largest real part [1/s] of the eigenvalues of a stability matrix: positive if the motion is unstable.

    **Example:** with the scene of the module.

    >>> print(f"{steady.growth_rate(steady.standing_matrix(scene, 50.0, inverted=True)):.2f} 1/s")
    -0.80 1/s
    """
    shape = np.shape(matrix)
    if len(shape) != 2 or shape[0] != shape[1] or not shape[0]:
        raise ValueError(
            f"matrix must be square, not of shape {shape}, as standing_matrix and tumbling_matrix are; {MANY}"
        )
    require(matrix, "matrix")
    return jnp.max(jnp.linalg.eigvals(matrix).real)
