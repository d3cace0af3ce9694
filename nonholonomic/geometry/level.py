"""Surfaces on which a function vanishes, computed from the function and its derivatives alone.

Both searches here are minimisations. The nearest point minimises the distance over the surface, which may have many
local minima for positions farther than the surface's least radius of curvature. The region that can contain the nearest
point is therefore divided into sectors, and a descent starts at the best of several points in each sector. The gap
below a ball needs no nearest point: the ball touches where the function is least over the ball, so the search never
leaves the ball, however far the surface is. The gap is negative only if a point of the ball is in the arena.

Each descent is Newton's method with the curvature kept positive and steps cut to a trust region (Nocedal and Wright, Numerical
Optimization, chapter 4). A last Newton step carries the derivatives (implicit function theorem).
"""

import abc
from collections.abc import Callable
from typing import Any, ClassVar, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from .surface import AbstractSurface, BallGap
from .vector import Component, Vector, dot, scale, subtract, sum_vectors, tangents, vector_of

#: Most iterations of a search. Most searches take three to six; ten times as many would not move any point.
MOST_ITERATIONS = 40

#: Smaller curvatures of the minimised function are raised to this value, relative to the curvature above a flat
#: surface.
LEAST_CURVATURE = 0.05

#: A search ends when a step is shorter than this fraction of the distance; the last step squares this error.
SETTLED = 1e-8

#: Steps shorter than this fraction are accepted without comparing values: the gain is below round-off.
UNSEEN = 1e-4


def newton_step(a: Component, b: Component, c: Component, x: Component, y: Component) -> tuple[Component, Component]:
    """Solution s of ((a, b), (b, c)) s = (x, y), with smaller eigenvalues raised to `LEAST_CURVATURE`."""
    least_eigenvalue = 0.5 * (a + c) - jnp.sqrt((0.5 * (a - c)) ** 2 + b**2)
    lift = jnp.maximum(LEAST_CURVATURE - jax.lax.stop_gradient(least_eigenvalue), 0.0)
    a, c = a + lift, c + lift
    per_determinant = 1.0 / (a * c - b * b)
    return (c * x - b * y) * per_determinant, (a * y - b * x) * per_determinant


class Descent(NamedTuple):
    """The state of a search: a vector, its value, the longest step allowed next, and whether the search has ended."""

    point: Float[Array, "3 ..."]
    value: Float[Array, "..."]
    reach: Float[Array, "..."]
    ended: Bool[Array, "..."]


def descended(
    step: Callable[[Vector], tuple[Component, Component, Vector, Vector]],
    onto: Callable[[Vector], Vector],
    value: Callable[[Vector], Component],
    start: Vector,
    size: Component,
    reach: Component,
) -> Vector:
    """A local minimum of a function of a vector that stays on a surface.

    **Arguments:**

    - `step`: Newton's step, as two components, and the unit tangents for these components.
    - `onto`: brings a vector back to the surface; `value`: the function to minimise.
    - `start`: a vector on the surface; `size`: unit for steps; `reach`: the longest first step.
    """

    def going_on(carry: tuple[Descent, Any]) -> Bool[Array, ""]:
        descent, count = carry
        return ~jnp.all(descent.ended) & (count < MOST_ITERATIONS)

    def descend(carry: tuple[Descent, Any]) -> tuple[Descent, Any]:
        descent, count = carry
        point = vector_of(descent.point)
        s1, s2, t1, t2 = step(point)
        length = jnp.sqrt(s1 * s1 + s2 * s2)
        cut = jnp.minimum(1.0, descent.reach / jnp.where(length > 0.0, length, 1.0))
        trial = onto(vector_of(sum_vectors(point, scale(cut * s1, t1), scale(cut * s2, t2))))
        trial_value = value(trial)
        improves = (trial_value <= descent.value) | (length <= UNSEEN * size)
        accepted = improves & ~descent.ended
        # NaN ends the search, too.
        ended = descent.ended | ~(length > SETTLED * size)
        new = Descent(
            point=jnp.where(accepted, _stacked(trial), descent.point),
            value=jnp.where(accepted, trial_value, descent.value),
            reach=jnp.where(improves, 2.0, 0.25) * descent.reach,
            ended=ended,
        )
        return new, count + 1

    first = _stacked(start)
    zero = jnp.zeros_like(first[0])
    initial = Descent(first, value(start) + zero, reach + zero, zero > 0.0)
    minimum, _ = jax.lax.while_loop(going_on, descend, (initial, jnp.zeros((), int)))
    return vector_of(minimum.point)


class AbstractLevel(AbstractSurface):
    """A surface on which a function is zero; bodies are where the function is positive."""

    #: Start points for the search for the nearest point, about a position; its distance is less than 1 in their unit.
    starts: ClassVar[Float[np.ndarray, "sectors starts 3"]]

    @abc.abstractmethod
    def level(self, position: Vector) -> Component:
        """The function at a position [m]."""

    @abc.abstractmethod
    def gradient(self, position: Vector) -> Vector:
        """Gradient of the function at a position [m], along the normal."""

    @abc.abstractmethod
    def second_derivative(self, position: Vector, a: Vector, b: Vector) -> Component:
        """Second derivative of the function at a position [m], along two vectors."""

    def offset(self, position: Vector) -> Component:
        gradient = self.gradient(position)
        return self.level(position) / jnp.sqrt(dot(gradient, gradient))

    def normal(self, position: Vector) -> Vector:
        gradient = self.gradient(position)
        return scale(1.0 / jnp.sqrt(dot(gradient, gradient)), gradient)

    def normal_rate(self, position: Vector, velocity: Vector) -> Vector:
        numbers = jnp.broadcast_arrays(*position, *velocity)
        return jax.jvp(self.normal, (vector_of(numbers[:3]),), (vector_of(numbers[3:]),))[1]

    def bending(self, position: Vector, a: Vector, b: Vector) -> tuple[Component, Component, Component]:
        # The gradient's size changes the normal only along n, which is perpendicular to a and b.
        gradient = self.gradient(position)
        per_size = 1.0 / jnp.sqrt(dot(gradient, gradient))
        aa, ab, bb = (self.second_derivative(position, *pair) for pair in ((a, a), (a, b), (b, b)))
        return per_size * aa, per_size * ab, per_size * bb

    def gaussian_curvature(self, position: Vector) -> Component:
        aa, ab, bb = self.bending(position, *tangents(self.normal(position)))
        return aa * bb - ab * ab

    def onto(self, position: Vector) -> Vector:
        for _ in range(2):
            difference = scale(self.offset(position), self.normal(position))
            position = vector_of(subtract(a, b) for a, b in zip(position, difference, strict=True))
        return position

    def nearest(self, position: Vector) -> Vector:
        surface, place = _held(self), jax.lax.stop_gradient(position)
        # A start that is off the surface, on the position's side, could be nearer than every point of the surface.
        first = surface.onto(surface.onto(place))
        distance = jnp.sqrt(_square(place, first))
        starts = jnp.asarray(self.starts)

        def step(foot: Vector) -> tuple[Component, Component, Vector, Vector]:
            return surface._step_on_surface(place, foot)

        def in_sector(k: Any, nearest: Float[Array, "3 ..."]) -> Float[Array, "3 ..."]:
            def start(i: Any, nearest: Float[Array, "3 ..."]) -> Float[Array, "3 ..."]:
                start_point = vector_of(x + distance * starts[k, i, axis] for axis, x in enumerate(place))
                return nearer(nearest, surface.onto(start_point))

            initial = vector_of(jax.lax.fori_loop(0, self.starts.shape[1], start, _stacked(first)))
            initial = surface.onto(surface.onto(initial))
            searched = (step, surface.onto, lambda foot: _square(place, foot), initial, distance, 0.25 * distance)
            return nearer(nearest, descended(*searched))

        def nearer(old: Float[Array, "3 ..."], new: Vector) -> Float[Array, "3 ..."]:
            return jnp.where(_square(place, new) < _square(place, vector_of(old)), _stacked(new), old)

        foot = vector_of(jax.lax.fori_loop(0, len(self.starts), in_sector, _stacked(first)))
        s1, s2, t1, t2 = self._step_on_surface(position, foot)
        return self.onto(vector_of(sum_vectors(foot, scale(s1, t1), scale(s2, t2))))

    def ball_gap(self, centre: Vector, radius: Component, side: float) -> BallGap:
        surface, place, size = _held(self), jax.lax.stop_gradient(centre), jax.lax.stop_gradient(radius)

        def step(normal: Vector) -> tuple[Component, Component, Vector, Vector]:
            return surface._step_on_ball(place, size, normal)

        def value(normal: Vector) -> Component:
            return surface.level(_lowered(place, size, normal))

        normal = descended(step, _unit, value, surface.normal(place), 1.0, 0.5)
        s1, s2, t1, t2 = self._step_on_ball(centre, radius, normal)
        normal = _unit(vector_of(sum_vectors(normal, scale(s1, t1), scale(s2, t2))))
        minimum = _lowered(centre, radius, normal)
        gap = self.offset(minimum)
        return BallGap(_lowered(minimum, gap, normal), normal, gap)

    def _step_on_surface(self, position: Vector, foot: Vector) -> tuple[Component, Component, Vector, Vector]:
        """Newton's step from a foot towards the least squared distance to a position, and the two tangents at the foot
        for its components."""
        n = self.normal(foot)
        difference = vector_of(subtract(a, b) for a, b in zip(position, foot, strict=True))
        d, (t1, t2) = dot(difference, n), tangents(n)
        aa, ab, bb = self.bending(foot, t1, t2)
        return *newton_step(1.0 + d * aa, d * ab, 1.0 + d * bb, dot(difference, t1), dot(difference, t2)), t1, t2

    def _step_on_ball(
        self, centre: Vector, radius: Component, normal: Vector
    ) -> tuple[Component, Component, Vector, Vector]:
        """Newton's step from the point of a ball opposite to a normal towards the least value of the function, per unit
        gradient and radius, and the two tangents there for its components."""
        minimum, (t1, t2) = _lowered(centre, radius, normal), tangents(normal)
        m = self.normal(minimum)
        aa, ab, bb = self.bending(minimum, t1, t2)
        cosine = dot(m, normal)
        return *newton_step(cosine + radius * aa, radius * ab, cosine + radius * bb, dot(m, t1), dot(m, t2)), t1, t2


def _held(surface: AbstractLevel) -> AbstractLevel:
    """A surface whose parameters are constants in derivatives."""
    return jax.tree.map(lambda leaf: jax.lax.stop_gradient(leaf) if eqx.is_array(leaf) else leaf, surface)


def _stacked(vector: Vector) -> Float[Array, "3 ..."]:
    return jnp.stack(jnp.broadcast_arrays(*vector))


def _square(a: Vector, b: Vector) -> Component:
    difference = vector_of(subtract(x, y) for x, y in zip(a, b, strict=True))
    return dot(difference, difference)


def _unit(vector: Vector) -> Vector:
    return vector_of(scale(1.0 / jnp.sqrt(dot(vector, vector)), vector))


def _lowered(position: Vector, distance: Component, normal: Vector) -> Vector:
    return vector_of(subtract(x, distance * n) for x, n in zip(position, normal, strict=True))
