"""Surfaces on which a function is zero: what follows from its first and second derivatives."""

import abc
from collections.abc import Iterable

import jax
import jax.numpy as jnp

from .surface import AbstractSurface
from .vector import Component, Vector, dot, scale, subtract, sum_vectors, tangents

#: Newton steps to the nearest point. They double its digits, so that a few are enough.
STEPS = 8


class AbstractLevel(AbstractSurface):
    """A surface whose nearest points are found by Newton's method, from its normal and shape operator."""

    @abc.abstractmethod
    def offset(self, position: Vector) -> Component:
        """Distance [m] of a position from the surface, to first order: the function over the size of its gradient."""

    def nearest(self, position: Vector) -> Vector:
        first = jnp.stack(jnp.broadcast_arrays(*self._down(position)))
        foot = jax.lax.fori_loop(0, STEPS, lambda _, foot: jnp.stack(self._closer(position, _vector(foot))), first)
        return self._down(_vector(foot))

    def _down(self, position: Vector) -> Vector:
        """A position moved along its normal to the surface, to first order."""
        away = scale(self.offset(position), self.normal(position))
        return _vector(subtract(a, b) for a, b in zip(position, away, strict=True))

    def _closer(self, position: Vector, foot: Vector) -> Vector:
        """One step: where r = q + d n(q) + w, the foot q moves along the surface by s with s + d n'(s) = w."""
        q = self._down(foot)
        n = self.normal(q)
        away = tuple(subtract(a, b) for a, b in zip(position, q, strict=True))
        d, (t1, t2) = dot(away, n), tangents(n)
        both = jnp.broadcast_arrays(*t1, *t2)
        rates = self.normal_rate(q, _vector(jnp.stack(pair) for pair in zip(both[:3], both[3:], strict=True)))
        (a, b), (c, e) = d * dot(rates, t1), d * dot(rates, t2)
        a, e, w1, w2 = 1.0 + a, 1.0 + e, dot(away, t1), dot(away, t2)
        per_determinant = 1.0 / (a * e - b * c)
        s1, s2 = (e * w1 - b * w2) * per_determinant, (a * w2 - c * w1) * per_determinant
        return _vector(sum_vectors(q, scale(s1, t1), scale(s2, t2)))


def _vector(components: Iterable[Component]) -> Vector:
    x, y, z = components
    return (x, y, z)


class AbstractDifferentiated(AbstractLevel):
    """A surface that gives only a function's first and second derivatives, which automatic differentiation finds."""

    @abc.abstractmethod
    def gradient(self, position: Vector) -> Vector:
        """Gradient of the function at a position [m], along the normal."""

    @abc.abstractmethod
    def second_derivative(self, position: Vector, a: Vector, b: Vector) -> Component:
        """Second derivative of the function at a position [m], along two vectors."""

    def normal(self, position: Vector) -> Vector:
        gradient = self.gradient(position)
        return scale(1.0 / jnp.sqrt(dot(gradient, gradient)), gradient)

    def normal_rate(self, position: Vector, velocity: Vector) -> Vector:
        together = jnp.broadcast_arrays(*position, *velocity)
        return jax.jvp(self.normal, (_vector(together[:3]),), (_vector(together[3:]),))[1]

    def bending(self, position: Vector, a: Vector, b: Vector) -> tuple[Component, Component, Component]:
        # Along the surface the change of the gradient's size is across a and b.
        gradient = self.gradient(position)
        per_size = 1.0 / jnp.sqrt(dot(gradient, gradient))
        aa, ab, bb = (self.second_derivative(position, *pair) for pair in ((a, a), (a, b), (b, b)))
        return per_size * aa, per_size * ab, per_size * bb

    def gaussian_curvature(self, position: Vector) -> Component:
        aa, ab, bb = self.bending(position, *tangents(self.normal(position)))
        return aa * bb - ab * ab
