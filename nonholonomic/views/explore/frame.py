"""The contents of a page at one time of a run, in the form for the player (`player.js`)."""

from typing import Any, NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float

Three = Float[Array, "3"]


class Frame(NamedTuple):
    """One moment of a run, with bodies, traces, arrows and curves in the order of the `Show` of the page.

    - `normal`: normal of the arena, towards the body; `bodies`: position [m] and quaternion (x, y, z, w) of each body.
    - `traces`: the point of each trace [m], and the point to which it is relative, or `None`.
    - `arrows`: start [m] and vector of each arrow, in its unit; `curves`: a number for each curve.
    - `turning_rate`: greatest rotation rate of all parts [rad/s], which determines the number of frames.
    """

    normal: Three
    bodies: tuple[tuple[Three, Float[Array, "4"]], ...]
    traces: tuple[tuple[Three, Three | None], ...]
    arrows: tuple[tuple[Three, Three], ...]
    curves: tuple[Float[Array, ""], ...]
    turning_rate: Float[Array, ""]

    def layout(self) -> dict[str, Any]:
        """The number of items of each kind, for readers of the flat list of numbers."""
        return {
            "bodies": len(self.bodies),
            "traces": [about is not None for _, about in self.traces],
            "arrows": len(self.arrows),
            "curves": len(self.curves),
        }


def quaternion(rotation: Float[Array, "3 3"]) -> Float[Array, "4"]:
    """The quaternion (x, y, z, w) of a rotation matrix, from its largest component (Shepperd 1978)."""
    m, trace = rotation, rotation[0, 0] + rotation[1, 1] + rotation[2, 2]
    # Four times the products of the quaternion's components, one row each.
    skew = (m[2, 1] - m[1, 2], m[0, 2] - m[2, 0], m[1, 0] - m[0, 1])
    symmetric = (m[0, 1] + m[1, 0], m[0, 2] + m[2, 0], m[1, 2] + m[2, 1])
    squares = [1.0 - trace + 2.0 * m[k, k] for k in range(3)]
    rows = jnp.stack(
        [
            jnp.stack([squares[0], symmetric[0], symmetric[1], skew[0]]),
            jnp.stack([symmetric[0], squares[1], symmetric[2], skew[1]]),
            jnp.stack([symmetric[1], symmetric[2], squares[2], skew[2]]),
            jnp.stack([*skew, 1.0 + trace]),
        ]
    )
    row = rows[0]
    for k in range(1, 4):
        # `row` is the largest of the first k compared rows.
        row = jnp.where(rows[k, k] > jnp.max(jnp.stack([rows[j, j] for j in range(k)])), rows[k], row)
    return row / jnp.sqrt(jnp.sum(row * row))
