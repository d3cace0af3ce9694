"""Surfaces on which a function vanishes: the paraboloid, the graph of a user's function, and its zero set.

Both searches here are minimisations. The nearest point minimises the distance over the surface, which may have many
local minima for positions farther than the surface's least radius of curvature. The region that can contain the nearest
point is therefore divided into sectors, and a descent starts at the best of several points in each sector. The gap
below a ball needs no nearest point: the ball touches where the function is least over the ball, so the search never
leaves the ball, however far the surface is. The gap is negative only if a point of the ball is in the arena.

Each descent is Newton's method with the curvature kept positive and steps cut to a trust region (Nocedal and Wright, Numerical
Optimization, chapter 4). A last Newton step carries the derivatives (implicit function theorem).
"""

import abc
import functools
from collections.abc import Callable, Mapping
from typing import Any, ClassVar, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from ..compilation.components import Held
from ..compilation.tracing import GivenFunction, with_own_numbers
from ..text import parted, shown
from ..validation import UNTRACEABLE, Bound, as_number, is_traced
from .surface import DIVIDED, NEWTON_STEPS, OPEN, TINY, AbstractGradientSurface, AbstractSurface, BallGap, Place
from .vector import Component, Vector, difference, dot, scale, sum_vectors, tangents, unit

# Users' functions: convert them to modules with visible parameters, check them, and differentiate them.


class Plain(eqx.Module):
    """A function without parameters; equal functions give the same program."""

    function: Callable[..., Component] = eqx.field(static=True)
    signature: str | None = eqx.field(static=True, default=None, repr=False)

    def __call__(self, *at: Float[Array, "..."]) -> Float[Array, "..."]:
        # Users may compare, sort and look up numbers, or join them, which would mix lanes.
        return jnp.vectorize(lambda *numbers: jnp.asarray(self.function(*numbers)), signature=self.signature)(*at)


def as_function(value: Any, name: str, arguments: tuple[str, ...], vector: bool = False) -> Any:
    """Convert a function of lengths [m], or of a unit vector, to a module whose parameters are arrays.

    **Raises:** `ValueError` unless the function returns one number for numbers.
    """
    words = ", ".join(arguments)
    if not callable(value):
        raise ValueError(f"{name} = {shown(value)} must be a function of ({words})")
    if isinstance(value, eqx.Module):
        value = jax.tree.map(lambda leaf: as_number(leaf) if isinstance(leaf, float | np.ndarray) else leaf, value)
        if vector and any(np.ndim(leaf) and not is_traced(leaf) for leaf in jax.tree.leaves(value)):
            return value
    at = (jnp.array([0.0, 0.0, 1.0]),) if vector else (jnp.zeros(()),) * len(arguments)
    try:
        # A new function, because JAX would not look again at what one that it knows reads from elsewhere.
        program = jax.make_jaxpr(lambda *numbers: value(*numbers))(*at)
    except jax.errors.JAXTypeError as error:
        raise ValueError(f"{name} = {shown(value)} {UNTRACEABLE}") from error
    except (TypeError, IndexError) as error:
        raise ValueError(f"{name} = {shown(value)} must be a function of ({words}): {error}") from error
    # The parameters of a module may have one value per lane.
    shapes = {(), *(leaf.shape for leaf in jax.tree.leaves(value) if eqx.is_array(leaf) and not vector)}
    results = program.out_avals
    if len(results) != 1 or results[0].shape not in shapes or not jnp.issubdtype(results[0].dtype, jnp.floating):
        raise ValueError(
            f"{name} = {shown(value)} must return one number for ({words}), not {', '.join(map(str, results))}"
        )
    if isinstance(value, eqx.Module):
        # If the parameters have one number per lane, so have the results.
        of_lanes = vector or results[0].shape or (len(shapes) == 1 and _takes_lanes(value, len(arguments)))
        return value if of_lanes or isinstance(value, Held) else Held(parted(value))
    if any(is_traced(constant) for constant in program.consts):
        function = with_own_numbers(value, *at)
        return function if vector else Held(parted(function))
    # Equinox warns of the arrays of a tree, such as JAX's partial functions, but not of those of its method.
    function = GivenFunction(value if jax.tree_util.all_leaves([value]) else value.__call__, program)
    return Plain(function, "(n)->()" if vector else None)


def _takes_lanes(function: Any, count: int) -> bool:
    """Whether a function of numbers, whose parameters are single numbers, takes one number per lane, too."""
    lanes = jax.ShapeDtypeStruct((2,), float)
    try:
        return jax.eval_shape(function, *(lanes,) * count).shape == lanes.shape
    except Exception:
        # Any error: the function is a user's.
        return False


def second_derivative(function: Callable[..., Component], at: Vector, a: Vector, b: Vector) -> Float[Array, "..."]:
    """Second derivative of a function of several numbers along two vectors, each component a number or an array over lanes."""
    size, numbers = len(at), tuple(jnp.broadcast_arrays(*at, *a, *b))
    place, first, second = numbers[:size], numbers[size : 2 * size], numbers[2 * size :]
    return jax.jvp(lambda *point: jax.jvp(function, point, first)[1], place, second)[1]


# Searches for the nearest point and for the gap below a ball.

#: Most iterations of a search. Most searches take three to six; ten times as many would not move any point.
MOST_ITERATIONS = 40

#: The least curvature of the minimised function, relative to the curvature above a flat surface. If a curvature is smaller,
#: both are raised by the same amount.
LEAST_CURVATURE = 0.05

#: A search ends when a step is shorter than this fraction of the unit for steps; the last step squares this error.
SETTLED = 1e-8

#: Steps shorter than this fraction are accepted without comparing values: the gain is below round-off.
UNSEEN = 1e-4


def newton_step(a: Component, b: Component, c: Component, x: Component, y: Component) -> tuple[Component, Component]:
    """Solution s of ((a, b), (b, c)) s = (x, y), with both eigenvalues raised by the same amount if one is less than
    `LEAST_CURVATURE`."""
    least_eigenvalue = 0.5 * (a + c) - jnp.sqrt((0.5 * (a - c)) ** 2 + b**2)
    lift = jnp.maximum(LEAST_CURVATURE - jax.lax.stop_gradient(least_eigenvalue), 0.0)
    a, c = a + lift, c + lift
    per_determinant = 1.0 / (a * c - b * b)
    return (c * x - b * y) * per_determinant, (a * y - b * x) * per_determinant


#: Newton's step: two components, and the unit tangents for these components.
Step = tuple[Component, Component, Vector, Vector]


class Descent(NamedTuple):
    """The state of a search: a vector, its value, the longest step allowed next, whether the search has ended, and the number
    of iterations."""

    point: Float[Array, "3 ..."]
    value: Float[Array, "..."]
    reach: Float[Array, "..."]
    ended: Bool[Array, "..."]
    count: Int[Array, ""]


def descended(
    step: Callable[[Vector], Step],
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

    def descend(descent: Descent) -> Descent:
        point = tuple(descent.point)
        s1, s2, t1, t2 = step(point)
        length = jnp.sqrt(s1 * s1 + s2 * s2)
        cut = jnp.minimum(1.0, descent.reach / jnp.where(length > 0.0, length, 1.0))
        trial = onto(sum_vectors(point, scale(cut * s1, t1), scale(cut * s2, t2)))
        trial_value = value(trial)
        improves = (trial_value <= descent.value) | (length <= UNSEEN * size)
        accepted = improves & ~descent.ended
        # NaN ends the search, too.
        ended = descent.ended | ~(length > SETTLED * size)
        return Descent(
            point=jnp.where(accepted, _stacked(trial), descent.point),
            value=jnp.where(accepted, trial_value, descent.value),
            reach=jnp.where(improves, 2.0, 0.25) * descent.reach,
            ended=ended,
            count=descent.count + 1,
        )

    first = _stacked(start)
    zero = jnp.zeros_like(first[0])
    initial = Descent(first, value(start) + zero, reach + zero, zero > 0.0, jnp.zeros((), int))
    minimum = jax.lax.while_loop(
        lambda descent: ~jnp.all(descent.ended) & (descent.count < MOST_ITERATIONS), descend, initial
    )
    return tuple(minimum.point)


class AbstractLevel(AbstractGradientSurface):
    """A surface on which a function is zero; bodies are where the function is positive."""

    #: Start points for the search for the nearest point, relative to the position; their unit is an upper bound of its
    #: distance from the surface.
    starts: ClassVar[Float[np.ndarray, "sectors starts 3"]]

    @abc.abstractmethod
    def level(self, x: Component, y: Component, z: Component) -> Component:
        """The function at a position [m]."""

    def offset(self, position: Vector) -> Component:
        gradient = self.gradient(position)
        return self.level(*position) / jnp.sqrt(dot(gradient, gradient))

    def gradient(self, position: Vector) -> Vector:
        x, y, z = position
        level = self.level
        lines = ((lambda x: level(x, y, z), x), (lambda y: level(x, y, z), y), (lambda z: level(x, y, z), z))
        return tuple(jax.jvp(along, (start,), (jnp.ones_like(start),))[1] for along, start in lines)

    def bending(self, position: Vector, a: Vector, b: Vector) -> Vector:
        # As for any gradient; these derivatives cost less than its rate.
        gradient = self.gradient(position)
        second = (second_derivative(self.level, position, *pair) for pair in ((a, a), (a, b), (b, b)))
        return scale(1.0 / jnp.sqrt(dot(gradient, gradient)), tuple(second))

    def onto(self, position: Vector) -> Vector:
        for _ in range(2):
            position = difference(position, scale(self.offset(position), self.normal(position)))
        return position

    def nearest(self, position: Vector) -> Vector:
        surface, place = _held(self), jax.lax.stop_gradient(position)
        # A start that is off the surface, on the position's side, could be nearer than every point of the surface.
        first = surface.onto(surface.onto(place))
        distance = jnp.sqrt(_square(place, first))
        starts, step = jnp.asarray(self.starts), functools.partial(surface._step_on_surface, place)

        def in_sector(k: Int[Array, ""], nearest: Float[Array, "3 ..."]) -> Float[Array, "3 ..."]:
            def start(i: Int[Array, ""], nearest: Float[Array, "3 ..."]) -> Float[Array, "3 ..."]:
                start_point = tuple(x + distance * starts[k, i, axis] for axis, x in enumerate(place))
                return nearer(nearest, surface.onto(start_point))

            initial = tuple(jax.lax.fori_loop(0, self.starts.shape[1], start, _stacked(first)))
            initial = surface.onto(surface.onto(initial))
            searched = (step, surface.onto, lambda foot: _square(place, foot), initial, distance, 0.25 * distance)
            return nearer(nearest, descended(*searched))

        def nearer(old: Float[Array, "3 ..."], new: Vector) -> Float[Array, "3 ..."]:
            return jnp.where(_square(place, new) < _square(place, tuple(old)), _stacked(new), old)

        foot = tuple(jax.lax.fori_loop(0, len(self.starts), in_sector, _stacked(first)))
        s1, s2, t1, t2 = self._step_on_surface(position, foot)
        return self.onto(sum_vectors(foot, scale(s1, t1), scale(s2, t2)))

    def ball_gap(self, centre: Vector, radius: Component, side: float) -> BallGap:
        surface, place, size = _held(self), jax.lax.stop_gradient(centre), jax.lax.stop_gradient(radius)

        step, start = functools.partial(surface._step_on_ball, place, size), surface.normal(place)
        normal = descended(step, unit, lambda normal: surface.level(*_lowered(place, size, normal)), start, 1.0, 0.5)
        s1, s2, t1, t2 = self._step_on_ball(centre, radius, normal)
        normal = unit(sum_vectors(normal, scale(s1, t1), scale(s2, t2)))
        minimum = _lowered(centre, radius, normal)
        gap = self.offset(minimum)
        return BallGap(_lowered(minimum, gap, normal), normal, gap)

    def _step_on_surface(self, position: Vector, foot: Vector) -> Step:
        """Newton's step from a foot towards the least squared distance to a position, and the two tangents at the foot
        for its components."""
        n = self.normal(foot)
        away, (t1, t2) = difference(position, foot), tangents(n)
        d = dot(away, n)
        aa, ab, bb = self.bending(foot, t1, t2)
        return *newton_step(1.0 + d * aa, d * ab, 1.0 + d * bb, dot(away, t1), dot(away, t2)), t1, t2

    def _step_on_ball(self, centre: Vector, radius: Component, normal: Vector) -> Step:
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
    return dot(difference(a, b), difference(a, b))


def _lowered(position: Vector, distance: Component, normal: Vector) -> Vector:
    return difference(position, scale(distance, normal))


# Open surfaces: the paraboloid and the graph of any smooth function.


class AbstractOpen(AbstractSurface):
    """A surface above the whole x-y plane.

    A place on it is (x, y) [m]; east is the projection of x onto the surface, and north is to its left.
    """

    sides: ClassVar[Mapping[str, float]] = OPEN
    coordinates: ClassVar[tuple[tuple[str, str], ...]] = (("x", "m"), ("y", "m"))

    def place_at(self, position: Vector) -> Place:
        return position[:2]

    def charted(self, place: Place) -> tuple[Vector, Vector, Vector]:
        x, y = jnp.broadcast_arrays(*place)
        position = (x, y, self.ground(x, y))
        return position, *tangents(self.normal(position))

    @abc.abstractmethod
    def ground(self, x: Float[Array, "..."], y: Float[Array, "..."]) -> Float[Array, "..."]:
        """Height z [m] of the surface at (x, y) [m]."""


class Paraboloid(AbstractOpen, AbstractGradientSurface):
    """The bowl z = (x^2 + y^2) / (2 p).

    **Arguments:**

    - `p`: radius of curvature [m] at the lowest point, positive.

    **Example:**

    ```
    >>> import nonholonomic
    >>> bowl = nonholonomic.Paraboloid(p=0.5)
    >>> print(bowl.elevation((0.5, 0.0, 0.25)))
    0.25

    ```
    """

    units: ClassVar[dict[str, str]] = {"p": "m"}
    is_wavy: ClassVar[bool] = False

    p: Float[Array, "..."] = eqx.field(converter=as_number, metadata=Bound.POSITIVE)

    def ground(self, x: Float[Array, "..."], y: Float[Array, "..."]) -> Float[Array, "..."]:
        return (x * x + y * y) / (2.0 * self.p)

    def gradient(self, position: Vector) -> Vector:
        return (-position[0], -position[1], self.p)

    def gradient_rate(self, position: Vector, velocity: Vector) -> Vector:
        return (-velocity[0], -velocity[1], None)

    def gaussian_curvature(self, position: Vector) -> Component:
        x, y, _ = position
        return (self.p / (x * x + y * y + self.p * self.p)) ** 2

    def offset(self, position: Vector) -> Component:
        return (position[2] - self.ground(position[0], position[1])) * self.normal(position)[2]

    def nearest(self, position: Vector) -> Vector:
        # At a distance s from the axis, s^3 / (2 p^2) + (1 - z / p) s = r; the greatest root is the nearest point.
        # Above this root the cubic is convex, so Newton's method converges from above.
        x, y, z = position
        square = x * x + y * y
        r = jnp.sqrt(jnp.maximum(square, TINY * TINY))
        rise, bend = 1.0 - z / self.p, 1.0 / (2.0 * self.p * self.p)

        def fallen(s: Component, r: Component, rise: Component, bend: Component) -> Component:
            return s - ((bend * s * s + rise) * s - r) / (3.0 * bend * s * s + rise)

        numbers = (r, rise, bend)
        r, rise, bend = constants = jax.lax.stop_gradient(numbers)
        # An upper bound of the root. A cube root is expensive. By the inequality of means, (2 c + cube / c^2) / 3 is not
        # below the cube root for any c; this c is close to the root.
        cube = r / bend
        fourth_root = jnp.sqrt(jnp.sqrt(cube))
        c = fourth_root * jnp.sqrt(jnp.sqrt(fourth_root))
        bound = jnp.sqrt(jnp.maximum(-rise / bend, 0.0)) + (2.0 * c + cube / (c * c)) / 3.0
        bound = jnp.where(rise > 0.0, jnp.minimum(bound, r / jnp.where(rise > 0.0, rise, 1.0)), bound)
        s = jax.lax.fori_loop(0, NEWTON_STEPS, lambda _, s: fallen(s, *constants), bound)
        s = fallen(s, *numbers)
        # On the axis, above the centre of curvature, all directions are equally near.
        part, x = s / numbers[0], x + jnp.where(square == 0.0, TINY, 0.0)
        return (part * x, part * y, s * s / (2.0 * self.p))


def _disc(sectors: int, starts: int) -> Float[np.ndarray, "sectors starts 3"]:
    """Points spread evenly over sectors of the unit disc of x and y."""
    distance = np.sqrt((np.arange(starts) + 0.5) / starts)
    # The golden ratio prevents neighbouring radii from having similar angles.
    part = (np.arange(starts) * 0.5 * (np.sqrt(5.0) - 1.0)) % 1.0
    angle = 2.0 * np.pi * (np.arange(sectors)[:, None] + part) / sectors
    return np.stack([distance * np.cos(angle), distance * np.sin(angle), 0.0 * angle], axis=2)


class Graph(AbstractOpen, AbstractLevel):
    """The surface z = height(x, y) of any smooth function.

    **Arguments:**

    - `height`: returns z [m] for x and y [m], numbers. Write it with `jax.numpy` and without `if`. It may look up measured
      heights, as `jax.numpy.interp` and `jax.scipy.interpolate.RegularGridInterpolator` do. If it is an
      `equinox.Module`, its numbers are parameters of the scene, which you can sweep and differentiate.

    **Raises:** `ValueError` if `height` is not a function of x and y.

    **Example:**

    ```
    >>> import jax.numpy as jnp
    >>> import nonholonomic
    >>> hills = nonholonomic.Graph(lambda x, y: 0.1 * jnp.cos(x) * jnp.cos(y))
    >>> print(hills.elevation((0.0, 0.0, 0.1)))
    0.1

    ```
    """

    starts: ClassVar[Float[np.ndarray, "sectors starts 3"]] = _disc(5, 12)

    height: Callable[..., Component] = eqx.field(converter=lambda height: as_function(height, "height", ("x", "y")))

    def ground(self, x: Float[Array, "..."], y: Float[Array, "..."]) -> Float[Array, "..."]:
        return self.height(x, y)

    def level(self, x: Component, y: Component, z: Component) -> Component:
        return z - self.height(x, y)

    def onto(self, position: Vector) -> Vector:
        x, y, z = jnp.broadcast_arrays(*position)
        return (x, y, self.height(x, y) + 0.0 * z)


# The zero set of any smooth function of three coordinates.


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

    function: Callable[..., Component] = eqx.field(
        converter=lambda function: as_function(function, "function", ("x", "y", "z"))
    )

    def level(self, x: Component, y: Component, z: Component) -> Component:
        return self.function(x, y, z)

    def place_at(self, position: Vector) -> Place:
        return tuple(position)

    def charted(self, place: Place) -> tuple[Vector, Vector, Vector]:
        position = self.nearest(place)
        return position, *tangents(self.normal(position))
