"""The interface of all surfaces, and those in closed form: plane, cylinder, sphere, spheroid and torus.

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
from collections.abc import Iterator, Mapping
from typing import ClassVar, NamedTuple, TypeAlias, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float

from ..compilation.components import held, map_methods
from ..text import shown
from ..validation import Bound, Bounded, Usual, as_number, require
from .vector import Component, Vector, difference, dot, multiply, none_if_zero, planar_length, scale, tangents, unit

#: A surface, or a value that the checks of a scene reject.
Other = TypeVar("Other")

#: The coordinates of a place, or the numbers that a frame integrates.
Place: TypeAlias = tuple[Component, ...]

#: Largest distance of a place (x, y, z) from its surface, relative to its size, that counts as round-off.
ROUND_OFF = 1e-9

#: The words for the sides of a closed surface, of an open surface, and of an implicit one, each with the sign of the
#: normal that points to that side.
CLOSED: Mapping[str, float] = {"outside": 1.0, "inside": -1.0}
OPEN: Mapping[str, float] = {"above": 1.0}
DIVIDED: Mapping[str, float] = {"positive": 1.0}

#: The range of a radius, by a name that tells it from that of a body.
RADIUS = {"range": {"above": 0.0, "name": "surface radius"}}


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

    def __init_subclass__(cls, **options: object):
        super().__init_subclass__(**options)
        map_methods(cls, MAPPED)

    #: How many of a position's three components do not vanish identically.
    axes: ClassVar[int] = 3

    #: Whether the surface may rise and fall often along the path of a flight, so that flights look at it more often.
    is_wavy: ClassVar[bool] = True

    #: Whether the Gaussian curvature vanishes identically.
    is_developable: ClassVar[bool] = False

    #: The words for the side on which a body can be, and the sign of n that points to that side.
    sides: ClassVar[Mapping[str, float]] = CLOSED

    #: Names and units of the coordinates of a place.
    coordinates: ClassVar[tuple[tuple[str, str], ...]] = (("mu", "rad"), ("eta", "rad"))

    @property
    def up(self) -> Vector:
        """Components of the upward vertical in the surface's axes, which are those of the fixed frame turned about y."""
        return (None, None, 1.0)

    @abc.abstractmethod
    def normal(self, position: Vector) -> Vector:
        """Unit normal n at a position [m]; off the surface, the normal of a nearby parallel surface."""

    @abc.abstractmethod
    def normal_rate(self, position: Vector, velocity: Vector) -> Vector:
        """Rate n' [1/s] of the normal at a position [m] that moves with a velocity [m/s]: minus the shape operator
        times the velocity."""

    def bending(self, position: Vector, a: Vector, b: Vector) -> Vector:
        """(a . n'(a), a . n'(b), b . n'(b)) [1/m] for two vectors along the surface: minus its second fundamental form."""
        by_a, by_b = self.normal_rate(position, a), self.normal_rate(position, b)
        return dot(a, by_a), dot(b, by_a), dot(b, by_b)

    def elevation(self, position: Vector) -> Component:
        """Height [m] of a position: above the lowest point, or above the origin, the default, of a surface that has none."""
        return dot(position, self.up)

    def gaussian_curvature(self, position: Vector) -> Component:
        """Gaussian curvature K [1/m^2] at a position [m] on the surface."""
        if self.is_developable:
            return None
        aa, ab, bb = self.bending(position, *tangents(self.normal(position)))
        return aa * bb - ab * ab

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
        foot = tuple(0.0 * centre[0] if part is None else part for part in self.nearest(centre))
        normal = scale(side, self.normal(foot))
        return BallGap(foot, normal, dot(difference(centre, foot), normal) - radius)

    def offset(self, position: Vector) -> Component:
        """Distance [m] of a position close to the surface, exact, or to first order if that is cheaper."""
        return self.distance(position)

    def distance(self, position: Vector) -> Component:
        """Distance [m] of a position from the surface, positive on the side to which n points."""
        foot = self.nearest(position)
        return dot(difference(position, foot), self.normal(foot))

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
            place = self.place_at(self.nearest(self.in_own_axes(place)))
        return self.charted(place)

    def place_bounds(self, place: Place, size: Component) -> Iterator[Bound]:
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
            distance = self.offset(self.in_own_axes(place))
            tolerance = ROUND_OFF * (size + jnp.sqrt(place[0] ** 2 + place[1] ** 2 + place[2] ** 2))
            reason = "in metres: three numbers are (x, y, z), z the height, of a point on the surface up to round-off"
            name, distance = f"place = {shown(place)}: distance from the surface", 0.0 if distance is None else distance
            yield Bound(distance, name, at_least=-tolerance, at_most=tolerance, why=reason)

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

    def in_fixed_frame(self, vector: Vector) -> Vector:
        """Components of a vector in the fixed frame (x, y, z), z up."""
        (x, y, z), (sine, _, cosine) = vector, self.up
        z = jnp.zeros_like(x) if z is None else z
        return (x, y, z) if sine is None else (x * cosine - z * sine, y, x * sine + z * cosine)

    def in_own_axes(self, vector: Vector) -> Vector:
        """Components in the surface's axes of a vector in the fixed frame."""
        (x, y, z), (sine, _, cosine) = vector, self.up
        return vector if sine is None else (x * cosine + z * sine, y, z * cosine - x * sine)


class AbstractGradientSurface(AbstractSurface):
    """A surface whose normal is the direction of a vector with a simple rate, such as a gradient."""

    @abc.abstractmethod
    def gradient(self, position: Vector) -> Vector:
        """A vector along the normal at a position [m]."""

    def gradient_rate(self, position: Vector, velocity: Vector) -> Vector:
        """Rate [1/s] of the gradient at a position [m] that moves with a velocity [m/s]."""
        numbers = jnp.broadcast_arrays(*position, *velocity)
        return jax.jvp(self.gradient, (tuple(numbers[:3]),), (tuple(numbers[3:]),))[1]

    def normal(self, position: Vector) -> Vector:
        return unit(self.gradient(position))

    def normal_rate(self, position: Vector, velocity: Vector) -> Vector:
        gradient, gradient_rate = self.gradient(position), self.gradient_rate(position, velocity)
        per_size = 1.0 / jnp.sqrt(dot(gradient, gradient))
        normal = scale(per_size, gradient)
        return scale(per_size, difference(gradient_rate, scale(dot(normal, gradient_rate), normal)))

    def bending(self, position: Vector, a: Vector, b: Vector) -> Vector:
        # The gradient's size changes the normal only along n, which is perpendicular to a and b.
        gradient, by_a, by_b = self.gradient(position), self.gradient_rate(position, a), self.gradient_rate(position, b)
        return scale(1.0 / jnp.sqrt(dot(gradient, gradient)), (dot(a, by_a), dot(b, by_a), dot(b, by_b)))


def as_surface(surface: Other) -> Other:
    """A user's surface with every number of its arrays as a leaf, in a scene with many lanes; anything else unchanged."""
    if not isinstance(surface, AbstractSurface):
        return surface
    return held(surface, lambda surface: surface.normal((jnp.zeros(()), jnp.zeros(()), jnp.ones(()))))


# The plane, level or tilted.


class Plane(AbstractSurface):
    """A plane through the origin; its axes are x, along which it rises, y, and its normal. A level plane adds no terms.

    A place on it is (x, y) [m], along the plane; east is its x axis and north y.

    **Arguments:**

    - `tilt`: angle [rad] by which the plane rises along its own x axis, in [-pi/2, pi/2].

    **Example:**

    ```
    >>> import tippe
    >>> tippe.Plane()
    Plane()
    >>> tippe.Plane(tilt=0.1)
    Plane(tilt=0.1 rad)

    ```
    """

    units: ClassVar[dict[str, str]] = {"tilt": "rad"}
    is_wavy: ClassVar[bool] = False
    is_developable: ClassVar[bool] = True

    axes: ClassVar[int] = 2
    # "outside" is accepted for the only side of a plane, so that grounds can be compared.
    sides: ClassVar[Mapping[str, float]] = {"outside": CLOSED["outside"], **OPEN}
    coordinates: ClassVar[tuple[tuple[str, str], ...]] = (("x", "m"), ("y", "m"))

    tilt: Float[Array, "..."] | None = eqx.field(
        converter=none_if_zero,
        default=None,
        metadata={"range": {"at_least": -jnp.pi / 2.0, "at_most": jnp.pi / 2.0, "unit": "rad"}, "usual": Usual(0.9)},
    )

    @property
    def up(self) -> Vector:
        return (None, None, 1.0) if self.tilt is None else (jnp.sin(self.tilt), None, jnp.cos(self.tilt))

    def normal(self, position: Vector) -> Vector:
        return (None, None, 1.0)

    def normal_rate(self, position: Vector, velocity: Vector) -> Vector:
        return (None, None, None)

    def nearest(self, position: Vector) -> Vector:
        return (position[0], position[1], None)

    def place_at(self, position: Vector) -> Place:
        return position[:2]

    def charted(self, place: Place) -> tuple[Vector, Vector, Vector]:
        one, zero = jnp.ones_like(place[0]), jnp.zeros_like(place[0])
        return (place[0], place[1], None), (one, zero, None), (zero, one, None)


# The cylinder with a horizontal axis.


class Cylinder(AbstractGradientSurface):
    """A cylinder whose axis is the y axis.

    A place on it is (y, eta): along the axis [m], and the angle [rad] about it from the lowest line, towards x; east is y
    and north is along growing eta.

    **Arguments:**

    - `radius`: radius [m], positive.

    **Example:**

    ```
    >>> import tippe
    >>> tippe.Cylinder(radius=0.3)
    Cylinder(radius=0.3 m)

    ```
    """

    units: ClassVar[dict[str, str]] = {"radius": "m"}
    is_wavy: ClassVar[bool] = False
    is_developable: ClassVar[bool] = True

    coordinates: ClassVar[tuple[tuple[str, str], ...]] = (("y", "m"), ("eta", "rad"))

    radius: Float[Array, "..."] = eqx.field(converter=as_number, metadata=RADIUS)

    def gradient(self, position: Vector) -> Vector:
        return (position[0], None, position[2])

    def elevation(self, position: Vector) -> Component:
        return position[2] + self.radius

    def nearest(self, position: Vector) -> Vector:
        x, y, z = position
        part = self.radius / jnp.sqrt(x * x + z * z)
        return (part * x, y, part * z)

    def distance(self, position: Vector) -> Component:
        return jnp.sqrt(position[0] * position[0] + position[2] * position[2]) - self.radius

    def place_at(self, position: Vector) -> Place:
        return (position[1], jnp.arctan2(position[0], -position[2]))

    def charted(self, place: Place) -> tuple[Vector, Vector, Vector]:
        axial, eta = place
        sine, cosine, zero = jnp.sin(eta), jnp.cos(eta), jnp.zeros_like(eta)
        return (
            (self.radius * sine, axial, -self.radius * cosine),
            (zero, jnp.ones_like(eta), zero),
            (cosine, zero, sine),
        )


# Sphere and spheroid: the quadrics of revolution about the vertical.

#: Newton steps to the nearest point of a spheroid: enough for the worst positions.
NEWTON_STEPS = 12

#: A negligible distance [m], to avoid division by zero.
TINY = 1e-100


class AbstractQuadric(AbstractGradientSurface):
    """A sphere or spheroid r.N r = 1, N = diag(1/A^2, 1/A^2, 1/c^2), about the origin, its axis vertical.

    A place on it is (mu, eta) [rad], azimuth and reduced latitude: -pi/2 at the lowest point, pi/2 at the highest.
    """

    is_wavy: ClassVar[bool] = False

    @property
    @abc.abstractmethod
    def semi_axes(self) -> tuple[Float[Array, "..."], Float[Array, "..."]]:
        """Equatorial radius A and polar semi-axis c [m]."""

    def gradient(self, position: Vector) -> Vector:
        # N r [1/m], half the gradient of r.N r.
        equatorial, polar = self.semi_axes
        across, along = 1.0 / (equatorial * equatorial), 1.0 / (polar * polar)
        return (multiply(across, position[0]), multiply(across, position[1]), multiply(along, position[2]))

    def elevation(self, position: Vector) -> Component:
        return position[2] + self.semi_axes[1]

    def gaussian_curvature(self, position: Vector) -> Component:
        equatorial, polar = self.semi_axes
        gradient = self.gradient(position)
        return 1.0 / (equatorial**2 * polar * dot(gradient, gradient)) ** 2

    def place_at(self, position: Vector) -> Place:
        equatorial, polar = self.semi_axes
        x, y, z = position
        return (jnp.arctan2(y, x), jnp.arctan2(z / polar, planar_length(x, y) / equatorial))

    def charted(self, place: Place) -> tuple[Vector, Vector, Vector]:
        (equatorial, polar), (mu, eta) = self.semi_axes, place
        east = (-jnp.sin(mu), jnp.cos(mu), jnp.zeros_like(mu))
        outwards, across, along = (jnp.cos(mu), jnp.sin(mu)), equatorial * jnp.cos(eta), polar * jnp.sin(eta)
        inwards, rise = -equatorial * jnp.sin(eta), polar * jnp.cos(eta)
        per_length = 1.0 / jnp.sqrt(inwards**2 + rise**2)
        north = scale(per_length, (inwards * outwards[0], inwards * outwards[1], rise))
        return (across * outwards[0], across * outwards[1], along), east, north

    def place_bounds(self, place: Place, size: Component) -> Iterator[Bound]:
        yield from super().place_bounds(place, size)
        if len(place) == 2:
            limit = jnp.pi / 2.0 + 1e-12
            reason = "reduced latitude, from -pi/2 to pi/2"
            yield Bound(place[1], "place[1]", at_least=-limit, at_most=limit, why=reason, unit="rad")


class Sphere(AbstractQuadric):
    """A sphere about the origin.

    **Arguments:**

    - `radius`: radius [m], positive.

    **Example:**

    ```
    >>> import tippe
    >>> tippe.Sphere(radius=0.5)
    Sphere(radius=0.5 m)

    ```
    """

    units: ClassVar[dict[str, str]] = {"radius": "m"}

    radius: Float[Array, "..."] = eqx.field(converter=as_number, metadata=RADIUS)

    @property
    def semi_axes(self) -> tuple[Float[Array, "..."], Float[Array, "..."]]:
        return self.radius, self.radius

    def nearest(self, position: Vector) -> Vector:
        return scale(self.radius / jnp.sqrt(dot(position, position)), position)

    def distance(self, position: Vector) -> Component:
        return jnp.sqrt(dot(position, position)) - self.radius


class Spheroid(AbstractQuadric):
    """An ellipsoid of revolution with a vertical axis, oblate or prolate.

    **Arguments:**

    - `equatorial`: equatorial radius A [m], positive.
    - `polar`: polar semi-axis c [m], positive.

    **Example:**

    ```
    >>> import stroller
    >>> stroller.Spheroid(equatorial=6.0, polar=3.0)
    Spheroid(equatorial=6 m, polar=3 m)

    ```
    """

    units: ClassVar[dict[str, str]] = {"equatorial": "m", "polar": "m"}

    equatorial: Float[Array, "..."] = eqx.field(converter=as_number, metadata=Bound.POSITIVE)
    polar: Float[Array, "..."] = eqx.field(converter=as_number, metadata=Bound.POSITIVE)

    @classmethod
    def from_oblate(cls, a: ArrayLike, xi: ArrayLike) -> "Spheroid":
        """The spheroid of constant xi in oblate spheroidal coordinates: A = a cosh xi, c = a sinh xi.

        **Arguments:**

        - `a`: focal radius [m], positive.
        - `xi`: coordinate [1], positive.

        **Raises:** `ValueError` for numbers outside these ranges.

        **Example:**

        ```
        >>> import stroller
        >>> stroller.Spheroid.from_oblate(a=2.0, xi=0.8)
        Spheroid(equatorial=2.67487 m, polar=1.77621 m)

        ```
        """
        a, xi = as_number(a), as_number(xi)
        require(a, "a", above=0.0)
        require(xi, "xi", above=0.0)
        return cls(equatorial=a * jnp.cosh(xi), polar=a * jnp.sinh(xi))

    @property
    def semi_axes(self) -> tuple[Float[Array, "..."], Float[Array, "..."]]:
        return self.equatorial, self.polar

    def offset(self, position: Vector) -> Component:
        gradient = self.gradient(position)
        return 0.5 * (dot(position, gradient) - 1.0) / jnp.sqrt(dot(gradient, gradient))

    def nearest(self, position: Vector) -> Vector:
        # q = (1 + t N)^-1 r, with the greatest t for which q is on the surface: this is the nearest solution. The
        # inverse length of N^1/2 q is almost linear in t, so Newton's method needs few steps (Moré and Sorensen, SIAM
        # Journal on Scientific and Statistical Computing 4 (1983) 553).
        equatorial, polar = self.semi_axes
        x, y, z = position
        # Where the nearest points in all directions are equally near, take the point in the direction of growing
        # coordinates.
        radial, axial = jnp.sqrt(jnp.maximum(x * x + y * y, TINY * TINY)), jnp.maximum(jnp.abs(z), TINY)
        minor = jnp.minimum(equatorial, polar)
        numbers = (equatorial * radial, polar * axial, equatorial**2 - minor**2, polar**2 - minor**2)

        def closer(s: Component, u: Component, v: Component, p: Component, q: Component) -> Component:
            a, b = u / (s + p), v / (s + q)
            square = a * a + b * b
            return s + square * (jnp.sqrt(square) - 1.0) / (a * a / (s + p) + b * b / (s + q))

        u, v, p, q = constants = jax.lax.stop_gradient(numbers)
        s = jax.lax.fori_loop(0, NEWTON_STEPS, lambda _, s: closer(s, *constants), jnp.maximum(u - p, v - q))
        s = closer(s, *numbers)
        radial_factor, axial_factor = equatorial**2 / (s + numbers[2]), polar**2 / (s + numbers[3])
        x = x + jnp.where((x == 0.0) & (y == 0.0), TINY, 0.0)
        return (radial_factor * x, radial_factor * y, axial_factor * (z + jnp.where(z == 0.0, TINY, 0.0)))


# The torus with a vertical axis.


class Torus(AbstractGradientSurface):
    """A ring-shaped tube about the vertical axis, its middle at the height of the origin.

    A place on it is (mu, eta) [rad]: azimuth, and angle about the tube from its outermost circle upwards, so that -pi/2 is
    its lowest circle and pi/2 its highest.

    **Arguments:**

    - `ring`: radius [m] of the circle along the middle of the tube, positive.
    - `tube`: radius [m] of the tube, positive and less than `ring`.

    **Example:**

    ```
    >>> import nonholonomic
    >>> tube = nonholonomic.Torus(ring=2.0, tube=0.5)
    >>> print(round(float(tube.gaussian_curvature((2.5, 0.0, 0.0))), 6))
    0.8

    ```
    """

    units: ClassVar[dict[str, str]] = {"ring": "m", "tube": "m"}
    is_wavy: ClassVar[bool] = False

    ring: Float[Array, "..."] = eqx.field(converter=as_number, metadata=Bound.POSITIVE)
    tube: Float[Array, "..."] = eqx.field(converter=as_number, metadata=Bound.POSITIVE)

    def bounds(self) -> Iterator[Bound]:
        yield from super().bounds()
        yield Bound(
            self.tube, "tube", below=self.ring, why="the radius of the ring: otherwise the tube would cut itself"
        )

    def gradient(self, position: Vector) -> Vector:
        # The vector [m] to the position from the nearest point of the circle along the middle of the tube.
        x, y, z = position
        part = 1.0 - self.ring / jnp.sqrt(x * x + y * y)
        return (part * x, part * y, z)

    def gradient_rate(self, position: Vector, velocity: Vector) -> Vector:
        x, y, _ = position
        per_axis = 1.0 / (x * x + y * y)
        # The nearest point of the circle moves along it at this rate about the axis.
        turn = self.ring * (x * velocity[1] - y * velocity[0]) * per_axis * jnp.sqrt(per_axis)
        return (velocity[0] + y * turn, velocity[1] - x * turn, velocity[2])

    def elevation(self, position: Vector) -> Component:
        return position[2] + self.tube

    def gaussian_curvature(self, position: Vector) -> Component:
        # cos(eta) / (tube (ring + tube cos(eta))), with the distance from the axis for ring + tube cos(eta).
        from_axis = jnp.sqrt(position[0] ** 2 + position[1] ** 2)
        return (1.0 - self.ring / from_axis) / self.tube**2

    def nearest(self, position: Vector) -> Vector:
        return difference(position, scale(self.distance(position), self.normal(position)))

    def distance(self, position: Vector) -> Component:
        spoke = self.gradient(position)
        return jnp.sqrt(dot(spoke, spoke)) - self.tube

    def place_at(self, position: Vector) -> Place:
        x, y, z = position
        return (jnp.arctan2(y, x), jnp.arctan2(z, jnp.sqrt(x * x + y * y) - self.ring))

    def charted(self, place: Place) -> tuple[Vector, Vector, Vector]:
        (mu, eta), zero = place, jnp.zeros_like(place[0])
        cm, sm, ce, se = jnp.cos(mu), jnp.sin(mu), jnp.cos(eta), jnp.sin(eta)
        from_axis = self.ring + self.tube * ce
        return (from_axis * cm, from_axis * sm, self.tube * se), (-sm, cm, zero), (-se * cm, -se * sm, ce)
