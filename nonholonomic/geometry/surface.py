"""The interface of all surfaces, and users' functions that describe one.

A surface has its own axes, in which positions, velocities and normals are given. These are the axes of the fixed frame
(x, y, z), z up, except on a tilted plane, whose third axis is its normal; `up` is the vertical in the surface's axes.
The components have no singularities. `chart` and `place_at` convert between positions and places, the few coordinates
with which users name a position.

The unit normal points outward on a closed surface (sphere, spheroid, torus, cylinder), upward on an open one (plane,
paraboloid, graph) and to positive values of an implicit surface's function. The scene decides on which side of the
surface the body is; `sign` converts the word for a side.

Vectors are tuples of three components, each a number or an array over lanes, or `None` where it vanishes identically.
"""

import abc
from collections.abc import Callable, Iterator, Mapping
from typing import Any, ClassVar, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import eval_jaxpr
from jaxtyping import Array, Float

from ..compilation.components import Held, held, map_methods
from ..text import gathered, parted, shown, spread
from ..validation import UNTRACEABLE, Bound, Bounded, as_number, is_traced
from .vector import Component, Vector, dot, scale, subtract

Place = tuple[Any, ...]

#: Largest distance of a place (x, y, z) from its surface, relative to its size, that counts as round-off.
ROUND_OFF = 1e-9

#: The words for the sides of a closed surface, of an open surface, and of an implicit one, each with the sign of the
#: normal that points to that side.
CLOSED: Mapping[str, float] = {"outside": 1.0, "inside": -1.0}
OPEN: Mapping[str, float] = {"above": 1.0}
DIVIDED: Mapping[str, float] = {"positive": 1.0}


#: The methods of a user's surface that are mapped over lanes.
MAPPED = ("normal", "normal_rate", "bending", "elevation", "gaussian_curvature", "nearest", "onto", "ball_gap")
MAPPED += ("offset", "distance", "place_at", "charted", "chart")


class BallGap(NamedTuple):
    """The gap between a ball and a surface.

    - `foot`: the point [m] that the ball is about to touch; `normal`: the unit normal there, towards the ball.
    - `gap`: distance [m] between them, to first order if the surface is given by a function alone; negative only where
      the ball is in the arena.
    """

    foot: Vector
    normal: Vector
    gap: Component


class AbstractSurface(Bounded):
    """A smooth surface in space, with a unit normal n.

    **Example:**

    ```
    >>> import nonholonomic
    >>> bowl = nonholonomic.Sphere(radius=0.5)
    >>> isinstance(bowl, nonholonomic.AbstractSurface)
    True
    >>> print(bowl.gaussian_curvature((0.0, 0.0, -0.5)))
    4.0

    ```
    """

    def __init_subclass__(cls, **options: Any):
        super().__init_subclass__(**options)
        map_methods(cls, MAPPED)

    #: How many of a position's three components do not vanish identically.
    axes: ClassVar[int] = 3

    #: Whether the surface may rise and fall often along the path of a flight, so that flights look at it more often.
    is_wavy: ClassVar[bool] = True

    #: The words for the side on which a body can be, and the sign of n that points to that side.
    sides: ClassVar[Mapping[str, float]] = CLOSED

    #: Names and units of the coordinates of a place.
    coordinates: ClassVar[tuple[tuple[str, str], ...]] = (("mu", "rad"), ("eta", "rad"))

    @property
    def up(self) -> Vector:
        """Components of the upward vertical in the surface's axes."""
        return (None, None, 1.0)

    @abc.abstractmethod
    def normal(self, position: Vector) -> Vector:
        """Unit normal n at a position [m]; off the surface, the normal of a nearby parallel surface."""

    @abc.abstractmethod
    def normal_rate(self, position: Vector, velocity: Vector) -> Vector:
        """Rate n' [1/s] of the normal at a position [m] that moves with a velocity [m/s]: minus the shape operator
        times the velocity."""

    def bending(self, position: Vector, a: Vector, b: Vector) -> tuple[Component, Component, Component]:
        """(a . n'(a), a . n'(b), b . n'(b)) [1/m] for two vectors along the surface: minus its second fundamental form."""
        by_a, by_b = self.normal_rate(position, a), self.normal_rate(position, b)
        return dot(a, by_a), dot(b, by_a), dot(b, by_b)

    @abc.abstractmethod
    def elevation(self, position: Vector) -> Component:
        """Height [m] of a position: above the lowest point, or above the origin of a surface that has none."""

    @abc.abstractmethod
    def gaussian_curvature(self, position: Vector) -> Component:
        """Gaussian curvature K [1/m^2] at a position [m] on the surface."""

    @abc.abstractmethod
    def nearest(self, position: Vector) -> Vector:
        """The point [m] of the surface that is nearest to a position [m]; if there are several, any of these points."""

    def onto(self, position: Vector) -> Vector:
        """The point of the surface for a position [m] that has drifted off it."""
        return self.nearest(position)

    def ball_gap(self, centre: Vector, radius: Component, side: float) -> BallGap:
        """The point where a ball is about to touch the surface, and the gap.

        **Arguments:** `centre`, `radius`: centre and radius of the ball [m]; the radius must be less than the radii of
        curvature where the surface is concave; `side`: 1.0 if the ball is on the side to which n points, else -1.0.
        """
        foot = self.nearest(centre)
        foot = tuple(0.0 * centre[0] if part is None else part for part in foot)
        normal = scale(side, self.normal(foot))
        difference = tuple(subtract(a, b) for a, b in zip(centre, foot, strict=True))
        return BallGap(
            (foot[0], foot[1], foot[2]), (normal[0], normal[1], normal[2]), subtract(dot(difference, normal), radius)
        )

    def offset(self, position: Vector) -> Component:
        """Distance [m] of a position close to the surface, exact, or to first order if that is cheaper."""
        return self.distance(position)

    def distance(self, position: Vector) -> Component:
        """Distance [m] of a position from the surface, positive on the side to which n points."""
        foot = self.nearest(position)
        difference = (subtract(position[0], foot[0]), subtract(position[1], foot[1]), subtract(position[2], foot[2]))
        return dot(difference, self.normal(foot))

    @abc.abstractmethod
    def place_at(self, position: Vector) -> Place:
        """The place of a position [m] on the surface, named by `coordinates`."""

    @abc.abstractmethod
    def charted(self, place: Place) -> tuple[Vector, Vector, Vector]:
        """Like `chart`, for a place that is named by `coordinates`."""

    def chart(self, place: Place) -> tuple[Vector, Vector, Vector]:
        """Position [m] of a place, and two unit vectors along the surface there, east and north; n = east x north.

        **Arguments:**

        - `place`: numbers named by `coordinates`, or (x, y, z) [m] in the fixed frame, which is moved to the nearest point.
        """
        if len(place) > len(self.coordinates):
            place = self.place_at(self.nearest(self.in_own_axes((place[0], place[1], place[2]))))
        return self.charted(place)

    def place_bounds(self, place: Place, size: Any) -> Iterator[Bound]:
        """The ranges of the numbers of a place.

        **Arguments:** `place`: as for `chart`; `size`: a length [m] of the body, the scale for round-off.

        **Raises:** `ValueError` for a wrong number of coordinates.
        """
        count = len(self.coordinates)
        if len(place) not in (count, 3):
            names = ", ".join(f"{name} [{unit}]" for name, unit in self.coordinates)
            three = "" if count == 3 else " or (x [m], y [m], z [m])"
            raise ValueError(f"place = {shown(place)} must be ({names}){three} on a {type(self).__name__}")
        if len(place) == 3:
            distance = self.offset(self.in_own_axes((place[0], place[1], place[2])))
            tolerance = ROUND_OFF * (size + jnp.sqrt(place[0] ** 2 + place[1] ** 2 + place[2] ** 2))
            reason = "of the place from the surface, in metres: the place must be on the surface up to round-off"
            yield Bound(
                0.0 if distance is None else distance, "distance", at_least=-tolerance, at_most=tolerance, why=reason
            )

    def sign(self, side: str | None, closed: str) -> float:
        """1.0 if n points to the side where the body is, else -1.0.

        **Arguments:** `side`: one of `sides`, or `None`; `closed`: the meaning of `None` if there are two sides.

        **Raises:** `ValueError` for another word.
        """
        if side is None:
            return self.sides.get(closed, next(iter(self.sides.values())))
        words = (*CLOSED, *OPEN, *DIVIDED)
        if not isinstance(side, str) or side not in words:
            raise ValueError(f"side = {shown(side)} must be one of {', '.join(map(repr, words))}, or None")
        if side not in self.sides:
            # On a surface without this side, all words have the same meaning.
            raise ValueError(f"side = {shown(side)} must be {next(iter(self.sides))!r} on a {type(self).__name__}")
        return self.sides[side]

    def in_fixed_frame(self, vector: Vector) -> tuple[Any, Any, Any]:
        """Components of a vector in the fixed frame (x, y, z), z up."""
        x, y, z = vector
        return (x, y, jnp.zeros_like(x) if z is None else z)

    def in_own_axes(self, vector: Vector) -> Vector:
        """Components in the surface's axes of a vector in the fixed frame."""
        return vector


def as_surface(surface: Any) -> Any:
    """A user's surface with every number of its arrays as a leaf, in a scene with many lanes; anything else unchanged."""
    if not isinstance(surface, AbstractSurface):
        return surface
    return held(surface, lambda surface: surface.normal((jnp.zeros(()), jnp.zeros(()), jnp.ones(()))))


# User functions for surfaces: convert them to modules with visible parameters, check them, and differentiate them.


class Plain(eqx.Module):
    """A function without parameters; the same function gives the same program."""

    function: Callable[..., Any] = eqx.field(static=True)

    def __call__(self, *at: Float[Array, "..."]) -> Float[Array, "..."]:
        # Users may compare, sort and look up numbers, or join them, which would mix lanes.
        return jnp.vectorize(lambda *numbers: jnp.asarray(self.function(*numbers)))(*at)


class Closure(eqx.Module):
    """A function whose leaves are the traced numbers that it closes over. It was traced with single numbers; since
    then, each may have become one number per lane."""

    numbers: tuple[Any, ...]
    # JAX's Jaxpr; equal only if it is the same object.
    program: Any = eqx.field(static=True)

    def __call__(self, *at: Float[Array, "..."]) -> Float[Array, "..."]:
        shapes, count = tuple(constant.aval.shape for constant in self.program.constvars), len(self.numbers)

        def value(*scalars: Float[Array, ""]) -> Float[Array, ""]:
            return eval_jaxpr(self.program, gathered(scalars[:count], shapes), *scalars[count:])[0]

        return jnp.vectorize(value)(*self.numbers, *at)


def as_function(value: Any, name: str, arguments: tuple[str, ...]) -> eqx.Module:
    """Convert a function of lengths [m] to a module whose parameters are arrays.

    **Raises:** `ValueError` unless the function returns one number for numbers.
    """
    if not callable(value):
        raise ValueError(f"{name} = {shown(value)} must be a function of ({', '.join(arguments)})")
    if isinstance(value, eqx.Module):
        value = jax.tree.map(lambda leaf: as_number(leaf) if isinstance(leaf, float | np.ndarray) else leaf, value)
    zeros = (jnp.zeros(()),) * len(arguments)
    try:
        program = jax.make_jaxpr(value)(*zeros)
    except jax.errors.JAXTypeError as error:
        raise ValueError(f"{name} = {shown(value)} {UNTRACEABLE}") from error
    except TypeError as error:
        raise ValueError(f"{name} = {shown(value)} must be a function of ({', '.join(arguments)}): {error}") from error
    # The parameters of a module may have one value per lane.
    shapes = {(), *(leaf.shape for leaf in jax.tree.leaves(value) if eqx.is_array(leaf))}
    results = program.out_avals
    if len(results) != 1 or results[0].shape not in shapes or not jnp.issubdtype(results[0].dtype, jnp.floating):
        names_of_results = ", ".join(map(str, results))
        raise ValueError(
            f"{name} = {shown(value)} must return one number for numbers {', '.join(arguments)}, not {names_of_results}"
        )
    if isinstance(value, eqx.Module):
        # If the parameters have one number per lane, so have the results.
        of_one_run = results[0].shape == () and (len(shapes) > 1 or not _takes_lanes(value, len(arguments)))
        return Held(parted(value)) if of_one_run and not isinstance(value, Held) else value
    if any(is_traced(constant) for constant in program.consts):
        return Closure(spread(program.consts), program.jaxpr)
    # Equinox warns of the arrays of a tree, such as JAX's partial functions, but not of those of its method.
    return Plain(value if jax.tree_util.all_leaves([value]) else value.__call__)


def _takes_lanes(function: Any, count: int) -> bool:
    """Whether a function of numbers, whose parameters are single numbers, takes one number per lane, too."""
    lanes = jax.ShapeDtypeStruct((2,), float)
    try:
        return jax.eval_shape(function, *(lanes,) * count).shape == lanes.shape
    except Exception:
        # Any error: the function is a user's.
        return False


def partials(function: Callable[..., Any], at: tuple[Any, ...]) -> tuple[Float[Array, "..."], ...]:
    """Partial derivatives of a function of several numbers, each a number or an array over lanes."""

    def along(k: int) -> Float[Array, "..."]:
        return jax.jvp(
            lambda coordinate: function(*at[:k], coordinate, *at[k + 1 :]), (at[k],), (jnp.ones_like(at[k]),)
        )[1]

    return tuple(along(k) for k in range(len(at)))


def second_derivative(
    function: Callable[..., Any], at: tuple[Any, ...], a: tuple[Any, ...], b: tuple[Any, ...]
) -> Float[Array, "..."]:
    """Second derivative of a function of several numbers along two vectors, each component a number or an array over lanes."""
    size, numbers = len(at), tuple(jnp.broadcast_arrays(*at, *a, *b))
    place, first, second = numbers[:size], numbers[size : 2 * size], numbers[2 * size :]
    return jax.jvp(lambda *point: jax.jvp(function, point, first)[1], place, second)[1]
