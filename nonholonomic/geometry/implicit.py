"""The zero set of any smooth function of three coordinates."""

from collections.abc import Mapping
from typing import Any, ClassVar

import equinox as eqx
import numpy as np
from jaxtyping import Float

from .function import as_function, partials, second_derivative
from .level import AbstractLevel
from .surface import DIVIDED, Place
from .vector import Component, Vector, tangents


def _sphere() -> Float[np.ndarray, "6 9 3"]:
    """Points spread over the unit sphere: a square grid on each face of a cube, projected from its centre."""
    a, b = np.meshgrid(*[np.tan(np.pi / 4.0 * np.array([-2.0, 0.0, 2.0]) / 3.0)] * 2)
    sides = [np.stack([a, b, side + 0.0 * a], axis=-1).reshape(-1, 3) for side in (-1.0, 1.0)]
    points = np.stack([np.roll(side, axis, axis=1) for axis in range(3) for side in sides])
    return points / np.linalg.norm(points, axis=-1, keepdims=True)


class Implicit(AbstractLevel):
    """The surface function(x, y, z) = 0 in the fixed frame; bodies are where the function is positive.

    A place on it is (x, y, z) [m]; east is the projection of x onto the surface, or of y where the normal is along x,
    and north is to its left.

    **Arguments:**

    - `function`: a smooth function of the numbers x, y and z [m] whose gradient does not vanish on the surface. Write it
      with `jax.numpy` and without `if`. If it is an `equinox.Module`, its numbers are parameters of the scene, which you
      can sweep and differentiate.

    **Raises:** `ValueError` if `function` is not a function of x, y and z.

    **Example:**

    ```
    >>> import nonholonomic
    >>> egg = nonholonomic.Implicit(lambda x, y, z: 1.0 - x * x - y * y - 0.5 * z * z)
    >>> float(egg.normal((1.0, 0.0, 0.0))[0])
    -1.0

    ```
    """

    sides: ClassVar[Mapping[str, float]] = DIVIDED
    coordinates: ClassVar[tuple[tuple[str, str], ...]] = (("x", "m"), ("y", "m"), ("z", "m"))

    starts: ClassVar[Float[np.ndarray, "sectors starts 3"]] = _sphere()

    function: Any = eqx.field(converter=lambda function: as_function(function, "function", ("x", "y", "z")))

    def gradient(self, position: Vector) -> Vector:
        slope = partials(self.function, position)
        return (slope[0], slope[1], slope[2])

    def second_derivative(self, position: Vector, a: Vector, b: Vector) -> Component:
        return second_derivative(self.function, position, a, b)

    def level(self, position: Vector) -> Component:
        return self.function(*position)

    def elevation(self, position: Vector) -> Component:
        return position[2]

    def place_at(self, position: Vector) -> Place:
        return (position[0], position[1], position[2])

    def charted(self, place: Place) -> tuple[Vector, Vector, Vector]:
        position = self.nearest((place[0], place[1], place[2]))
        return position, *tangents(self.normal(position))
