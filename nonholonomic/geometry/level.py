"""Surfaces on which a function is zero: what follows from its first and second derivatives."""

import abc

import jax
import jax.numpy as jnp

from .surface import AbstractSurface
from .vector import Component, Vector, cross, dot, scale, subtract, sum_vectors, tangents

#: Newton steps to the nearest point. They double its digits, so that a few are enough and the rest costs little.
STEPS = 8


class AbstractLevel(AbstractSurface):
    """A surface whose nearest points are found by Newton's method, from its normal and shape operator."""

    @abc.abstractmethod
    def offset(self, position: Vector) -> Component:
        """Distance [m] of a position from the surface, to first order: the function over the size of its gradient."""

    def nearest(self, position: Vector) -> Vector:
        first = jnp.stack(jnp.broadcast_arrays(*self._down(position)))
        found = jax.lax.fori_loop(0, STEPS, lambda _, foot: jnp.stack(self._closer(position, foot)), first)
        return self._down((found[0], found[1], found[2]))

    def _down(self, position: Vector) -> Vector:
        """A position moved along its normal to the surface, to first order."""
        away = scale(self.offset(position), self.normal(position))
        return (subtract(position[0], away[0]), subtract(position[1], away[1]), subtract(position[2], away[2]))

    def _closer(self, position: Vector, foot: Vector) -> Vector:
        """One step: where r = q + d n(q) + w, the foot q moves along the surface by s with s + d n'(s) = w."""
        q = self._down((foot[0], foot[1], foot[2]))
        n = self.normal(q)
        away = tuple(subtract(a, b) for a, b in zip(position, q, strict=True))
        d, (t1, t2) = dot(away, n), tangents(n)
        along1, along2 = self.normal_rate(q, t1), self.normal_rate(q, t2)
        a, b = 1.0 + d * dot(along1, t1), d * dot(along2, t1)
        c, e = d * dot(along1, t2), 1.0 + d * dot(along2, t2)
        w1, w2, determinant = dot(away, t1), dot(away, t2), a * e - b * c
        s1, s2 = (e * w1 - b * w2) / determinant, (a * w2 - c * w1) / determinant
        moved = sum_vectors(q, scale(s1, t1), scale(s2, t2))
        return (moved[0], moved[1], moved[2])


class AbstractDifferentiated(AbstractLevel):
    """A surface that gives only a gradient along its normal; the rest follows by automatic differentiation."""

    @abc.abstractmethod
    def gradient(self, position: Vector) -> Vector:
        """Gradient of the function at a position [m]."""

    def normal(self, position: Vector) -> Vector:
        gradient = self.gradient(position)
        return scale(1.0 / jnp.sqrt(dot(gradient, gradient)), gradient)

    def normal_rate(self, position: Vector, velocity: Vector) -> Vector:
        position, velocity = (
            jnp.broadcast_arrays(*position, *velocity)[:3],
            jnp.broadcast_arrays(*position, *velocity)[3:],
        )
        return jax.jvp(self.normal, (tuple(position),), (tuple(velocity),))[1]

    def gaussian_curvature(self, position: Vector) -> Component:
        n = self.normal(position)
        t1, t2 = tangents(n)
        return dot(n, cross(self.normal_rate(position, t1), self.normal_rate(position, t2)))
