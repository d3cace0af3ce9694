"""Bodies of any shape and any inertia: an unbalanced top, a rattleback.

A strictly convex body touches an arena at the point that is farthest in the direction opposite to the arena's normal.
In the body's own axes this point is p(d) = grad h at d = -normal. The support function h(d), extended to all vectors
with degree 1, is the distance from the origin of the axes to the plane that the body touches with the outward normal d.

Source: Bonnesen and Fenchel, Theorie der konvexen Koerper (1934), section 15.
"""

import abc
import contextlib
from collections.abc import Iterator
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from nonholonomic.compilation.components import TooLarge, by_components
from nonholonomic.compilation.tracing import with_own_numbers
from nonholonomic.geometry import Vector, dot, scale, sum_vectors
from nonholonomic.text import shown
from nonholonomic.validation import UNTRACEABLE, Bound, Bounded, as_number, is_traced

from .launch import as_numbers

# The inertia tensor of a rigid body, and symmetric matrices stored by their six components.

#: Rounding error allowed in the moments of a flat body, as a fraction of their sum.
FLAT = 1e-12

#: Names of the components of inertia.
COMPONENTS = ("xx", "yy", "zz", "xy", "xz", "yz")

#: Degrees of the principal minors of a matrix in its components, in the order of `SymmetricMatrix.principal_minors`.
DEGREES = (1, 1, 1, 2, 2, 2, 3)


class Inertia(Bounded):
    """The inertia tensor about the centre of mass, in the body's axes, by its six components [kg m^2].

    The off-diagonal components are those of the matrix: `xy` is minus the integral of x y over the mass. `RigidBody` and
    `Ellipsoid` create it from a symmetric matrix (3, 3).

    **Raises:** `ValueError` for a tensor that is impossible for a rigid body: the principal moments must be positive,
    and the largest at most the sum of the other two.
    """

    units: ClassVar[dict[str, str]] = dict.fromkeys(COMPONENTS, "kg m2")

    xx: Float[Array, "..."] = eqx.field(converter=as_number)
    yy: Float[Array, "..."] = eqx.field(converter=as_number)
    zz: Float[Array, "..."] = eqx.field(converter=as_number)
    xy: Float[Array, "..."] = eqx.field(converter=as_number)
    xz: Float[Array, "..."] = eqx.field(converter=as_number)
    yz: Float[Array, "..."] = eqx.field(converter=as_number)

    @classmethod
    def of(cls, matrix: Any) -> "Inertia":
        """The tensor from a symmetric matrix (3, 3); for a traced matrix, its symmetric part."""
        if isinstance(matrix, Inertia):
            return matrix
        values = as_number(matrix)
        if not eqx.is_array(values) or values.shape != (3, 3):
            raise ValueError(
                f"inertia = {shown(matrix)} must be a matrix of shape (3, 3), in kg m^2 about the centre of mass"
            )
        if not is_traced(values):
            asymmetry = np.abs(np.asarray(values) - np.asarray(values).T)
            if np.any(asymmetry > 1e-12 * np.max(np.abs(values))):
                row, column = np.unravel_index(np.argmax(asymmetry), (3, 3))
                entry, mirrored = float(values[row, column]), float(values[column, row])
                raise ValueError(
                    f"inertia must be symmetric: inertia[{row}][{column}] = {entry:g}, inertia[{column}][{row}] = {mirrored:g}"
                )
        values = 0.5 * (values + values.T)
        (xx, xy, xz), (_, yy, yz), (_, _, zz) = values
        return cls(xx, yy, zz, xy, xz, yz)

    def bounds(self) -> Iterator[Bound]:
        for name in COMPONENTS:
            yield Bound(getattr(self, name), name)
        xx, yy, zz, xy, xz, yz = self.numbers
        half = 0.5 * (xx + yy + zz)
        # Half the trace minus the tensor is the matrix of the second moments of the mass, which is positive
        # semidefinite; the tensor is positive definite. Both are divided by powers of the trace, so that rounding
        # errors are comparable.
        second = SymmetricMatrix(half - xx, half - yy, half - zz, -xy, -xz, -yz)
        reason = "the largest principal moment of a rigid body is at most the sum of the other two" + self._moments
        for number, degree in zip(second.principal_minors, DEGREES, strict=True):
            yield Bound(number / half**degree, "inertia: excess of moments", at_least=-FLAT, why=reason)
        for number, degree in zip(self.tensor.principal_minors, DEGREES, strict=True):
            positive = f"the principal moments of a rigid body are positive{self._moments}"
            yield Bound(number / half**degree, "inertia: product of moments", above=0.0, why=positive)

    @property
    def numbers(self) -> tuple[Float[Array, "..."], ...]:
        """The six components, in the order of the fields."""
        return self.xx, self.yy, self.zz, self.xy, self.xz, self.yz

    @property
    def tensor(self) -> "SymmetricMatrix":
        """The tensor, without checks."""
        return SymmetricMatrix(*self.numbers)

    @property
    def matrix(self) -> Float[Array, "3 3"]:
        """The tensor as a matrix."""
        xx, yy, zz, xy, xz, yz = self.numbers
        return jnp.stack([jnp.stack([xx, xy, xz]), jnp.stack([xy, yy, yz]), jnp.stack([xz, yz, zz])])

    @property
    def _moments(self) -> str:
        """The principal moments of a known tensor, as an addition to messages."""
        if any(is_traced(number) or np.ndim(number) for number in self.numbers):
            return ""
        # In NumPy: inside a transformation, JAX would trace this even for known numbers.
        xx, yy, zz, xy, xz, yz = map(float, self.numbers)
        moments = np.linalg.eigvalsh([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
        return f"; here they are {', '.join(f'{moment:.4g}' for moment in moments)}"


class SymmetricMatrix(eqx.Module):
    """A symmetric matrix as six components, each a scalar or one per lane."""

    xx: Float[Array, "..."]
    yy: Float[Array, "..."]
    zz: Float[Array, "..."]
    xy: Float[Array, "..."]
    xz: Float[Array, "..."]
    yz: Float[Array, "..."]

    def times(self, vector: Vector) -> Vector:
        """The product with a vector."""
        x, y, z = vector
        return (
            self.xx * x + self.xy * y + self.xz * z,
            self.xy * x + self.yy * y + self.yz * z,
            self.xz * x + self.yz * y + self.zz * z,
        )

    @property
    def adjugate(self) -> "SymmetricMatrix":
        """The matrix of the cofactors."""
        xx, yy, zz, xy, xz, yz = self.xx, self.yy, self.zz, self.xy, self.xz, self.yz
        diagonal = (yy * zz - yz * yz, xx * zz - xz * xz, xx * yy - xy * xy)
        return SymmetricMatrix(*diagonal, xz * yz - xy * zz, xy * yz - xz * yy, xy * xz - yz * xx)

    def determinant(self, adjugate: "SymmetricMatrix") -> Float[Array, "..."]:
        """The determinant, from the cofactors."""
        return self.xx * adjugate.xx + self.xy * adjugate.xy + self.xz * adjugate.xz

    @property
    def inverse(self) -> "SymmetricMatrix":
        """The inverse."""
        adjugate = self.adjugate
        determinant = self.determinant(adjugate)
        return jax.tree.map(lambda cofactor: cofactor / determinant, adjugate)

    def solve(self, right: Vector) -> Vector:
        """Solution x of A x = right."""
        adjugate = self.adjugate
        return scale(1.0 / self.determinant(adjugate), adjugate.times(right))

    @property
    def principal_minors(self) -> tuple[Float[Array, "..."], ...]:
        """The seven principal minors, from one row to three rows; all are nonnegative if the matrix is positive
        semidefinite."""
        adjugate = self.adjugate
        minors = (self.xx, self.yy, self.zz, adjugate.xx, adjugate.yy, adjugate.zz)
        return (*minors, self.determinant(adjugate))


#: Number of directions in which a support function is evaluated to check that the body is convex.
SAMPLES = 200


class AbstractRigidBody(Bounded):
    """A strictly convex body of any inertia.

    Its axes x, y and z are fixed in it; theta is the angle from the arena's normal to its z axis.
    """

    mass: eqx.AbstractVar[Float[Array, "..."]]
    inertia: eqx.AbstractVar[Inertia]
    centre_of_mass: eqx.AbstractVar[tuple[Float[Array, "..."], ...]]

    @property
    @abc.abstractmethod
    def size(self) -> Float[Array, "..."]:
        """A length of the body [m], the unit for places and velocities."""

    @property
    @abc.abstractmethod
    def half_widths(self) -> tuple[Float[Array, "..."], Float[Array, "..."]]:
        """Half the least and half the greatest distance [m] of parallel planes that touch the body."""

    @abc.abstractmethod
    def surface_point(self, normal: Vector, rate: Vector) -> tuple[Vector, Vector]:
        """The point at which the body touches a plane.

        **Arguments:** `normal`: the normal of the plane, towards the body, in the body's axes; `rate`: the rate of
        change of these components.

        **Returns:** the point [m] in the body's axes, and its rate of change [m/s].
        """

    def contact(self, normal: Vector, rate: Vector) -> tuple[Vector, Vector]:
        """The vector r from the centre of mass to the contact [m] in the body's axes, and its rate; arguments as above."""
        point, point_rate = self.surface_point(normal, rate)
        return sum_vectors(point, scale(-1.0, self.centre_of_mass)), point_rate

    def check_components(self) -> None:
        """Raise `ValueError` unless the centre of mass has three components."""
        require_three(self.centre_of_mass, "centre_of_mass")


def require_three(value: Any, name: str) -> None:
    """Raise `ValueError` unless these are three numbers."""
    if not isinstance(value, tuple) or len(value) != 3:
        raise ValueError(f"{name} = {shown(value)} must be three numbers, along the body's axes x, y and z")


#: Units of the common parameters of rigid bodies, with their names in scenes and tables.
UNITS = {"mass": "kg", "centre_of_mass": "m"} | {f"centre_of_mass[{k}]": "m" for k in range(3)} | Inertia.units


class Ellipsoid(AbstractRigidBody):
    """An ellipsoid with any inertia and any centre of mass inside: a rattleback, or an unbalanced sphere.

    The scene can have any arena, and any friction law; `NoSlip` is rolling without slip. On a
    curved arena, a run ends with the status "does_not_fit" where the body is not more strongly curved than the arena;
    the program does not notice a second contact elsewhere. The part of the surface that never touches the arena does
    not matter: half an ellipsoid, such as a boat, moves like the whole ellipsoid. At a `Launch`, the body's axes x, y
    and z are those of the arena (t1, t2, n), turned by theta about a tangent of the arena so that z leans in the
    direction `azimuth`. `spin` is the angular velocity about z.

    **Arguments:**

    - `mass`: mass [kg], positive.
    - `semi_axes`: the three semi-axes [m], along the body's axes x, y and z, positive.
    - `centre_of_mass`: position of the centre of mass [m], from the centre of the ellipsoid, in the body's axes;
      inside.
    - `inertia`: symmetric matrix (3, 3) of the inertia about the centre of mass [kg m^2], in the body's axes. Its principal
      moments are positive, and the largest is at most the sum of the other two. Tables name the components
      `"scene.body.inertia.xx"`, `.yy`, `.zz`, `.xy`, `.xz` and `.yz`.

    **Raises:** `ValueError` for numbers outside these ranges.

    **Example:** Kane and Levinson's rattleback, spun against its preferred sense.

    ```
    >>> import tippe
    >>> body = tippe.Ellipsoid(
    ...     mass=1.0,
    ...     semi_axes=(0.2, 0.03, 0.02),
    ...     centre_of_mass=(0.0, 0.0, -0.01),
    ...     inertia=[[2e-4, -2e-5, 0.0], [-2e-5, 1.6e-3, 0.0], [0.0, 0.0, 1.7e-3]],
    ... )
    >>> scene = tippe.Scene(body, friction=tippe.NoSlip())
    >>> time = tippe.reversal_time(scene, tippe.Launch(0.02, spin=-5.0), t1=5.0, tolerance=1e-6)
    >>> print(f"it spins the other way after {time:.1f} s")
    it spins the other way after 2.6 s

    ```
    """

    units: ClassVar[dict[str, str]] = UNITS | {"semi_axes": "m"} | {f"semi_axes[{k}]": "m" for k in range(3)}

    mass: Float[Array, "..."] = eqx.field(converter=as_number)
    semi_axes: tuple[Float[Array, "..."], ...] = eqx.field(converter=as_numbers)
    centre_of_mass: tuple[Float[Array, "..."], ...] = eqx.field(converter=as_numbers)
    inertia: Inertia = eqx.field(converter=Inertia.of)

    def __check_init__(self):
        self.check_components()
        require_three(self.semi_axes, "semi_axes")

    def bounds(self) -> Iterator[Bound]:
        yield Bound(self.mass, "mass", above=0.0)
        for k in range(3):
            yield Bound(self.semi_axes[k], f"semi_axes[{k}]", above=0.0)
            yield Bound(self.centre_of_mass[k], f"centre_of_mass[{k}]")
        depth = sum((place / axis) ** 2 for place, axis in zip(self.centre_of_mass, self.semi_axes, strict=True))
        yield Bound(depth, "sum of (centre_of_mass / semi_axes)^2", below=1.0, why="the centre of mass lies inside")

    @property
    def size(self) -> Float[Array, "..."]:
        a, b, c = self.semi_axes
        return jnp.maximum(jnp.maximum(a, b), c)

    @property
    def half_widths(self) -> tuple[Float[Array, "..."], Float[Array, "..."]]:
        a, b, c = self.semi_axes
        return jnp.minimum(jnp.minimum(a, b), c), self.size

    def surface_point(self, normal: Vector, rate: Vector) -> tuple[Vector, Vector]:
        # p = -A n / q with q^2 = n.A n, A the squares of the semi-axes.
        scaled_normal = tuple(axis * axis * part for axis, part in zip(self.semi_axes, normal, strict=True))
        per_height = 1.0 / jnp.sqrt(dot(normal, scaled_normal))
        point = scale(-per_height, scaled_normal)
        projection = dot(point, rate)
        change = (
            projection * part - axis * axis * component
            for axis, part, component in zip(self.semi_axes, point, rate, strict=True)
        )
        return point, scale(per_height, tuple(change))


class RigidBody(AbstractRigidBody):
    """A body of any strictly convex shape, given by its support function, with any inertia, for the same scenes as an
    `Ellipsoid`.

    **Arguments:**

    - `mass`: mass [kg], positive.
    - `inertia`: as for `Ellipsoid`.
    - `support`: function of a unit vector (3,) in the body's axes that returns how far [m] the body extends in this
      direction from the origin of its axes, `jnp.sqrt(jnp.sum((semi_axes * d) ** 2))` for an ellipsoid. Write it with
      `jax.numpy`, smooth in the neighbourhood of all unit vectors. Both principal radii of curvature must be positive,
      which is checked in 200 directions. If it is an `equinox.Module`, you can sweep and differentiate its numbers.
    - `centre_of_mass`: position of the centre of mass [m] in the body's axes; inside, by default at the origin.

    **Raises:** `ValueError` for numbers outside these ranges, and for an illegal support function.

    **Example:** an unbalanced top, whose moments of inertia across its axis differ by 4 %.

    ```
    >>> import jax.numpy as jnp, tippe
    >>> def support(direction):  # a sphere, whose centre is 6 mm above the centre of mass
    ...     return 0.02 * jnp.sqrt(jnp.sum(direction**2)) + 0.006 * direction[2]
    >>> top = tippe.RigidBody(0.02, [[2.94e-6, 0, 0], [0, 3.06e-6, 0], [0, 0, 3.2e-6]], support)
    >>> scene = tippe.Scene(top, friction=tippe.Viscous(0.3))
    >>> start = scene.state(tippe.Launch(0.1, 155.0))
    >>> print(f"{1e3 * scene.energy(start):.1f} mJ, {scene.normal_force(start):.3f} N")
    41.2 mJ, 0.196 N

    ```
    """

    units: ClassVar[dict[str, str]] = UNITS

    mass: Float[Array, "..."] = eqx.field(converter=as_number)
    inertia: Inertia = eqx.field(converter=Inertia.of)
    support: Any = eqx.field(converter=lambda value: as_support(value))
    centre_of_mass: tuple[Float[Array, "..."], ...] = eqx.field(converter=as_numbers, default=(0.0, 0.0, 0.0))

    def __check_init__(self):
        self.check_components()

    def bounds(self) -> Iterator[Bound]:
        yield Bound(self.mass, "mass", above=0.0)
        for k in range(3):
            yield Bound(self.centre_of_mass[k], f"centre_of_mass[{k}]")
        height, min_radius = (jnp.min(part, axis=0) for part in self._samples())
        yield Bound(height, "least support seen from centre_of_mass", above=0.0, why="the centre of mass lies inside")
        yield Bound(min_radius, "least radius of curvature by support", above=0.0, why="the body is strictly convex")

    def _samples(self) -> tuple[Float[Array, "samples ..."], Float[Array, "samples ..."]]:
        """Height of the centre of mass above a plane, and the smaller principal radius of curvature [m], by direction."""

        def sample(normal: Float[Array, "3"], first: Float[Array, "3"], second: Float[Array, "3"]) -> tuple[Any, Any]:
            # A plane that turns about one tangent moves the contact by the radius along the other.
            point, projection = self.contact(tuple(normal), tuple(first))
            _, across = self.contact(tuple(normal), tuple(second))
            a, b, c = -dot(tuple(first), projection), -dot(tuple(first), across), -dot(tuple(second), across)
            return -dot(tuple(normal), point), 0.5 * (a + c) - jnp.sqrt(0.25 * (a - c) ** 2 + b * b)

        return jax.vmap(sample)(*evenly_spread(SAMPLES))

    @property
    def size(self) -> Float[Array, "..."]:
        return jnp.max(self._samples()[0], axis=0)

    @property
    def half_widths(self) -> tuple[Float[Array, "..."], Float[Array, "..."]]:
        def half_width(normal: Float[Array, "3"]) -> Any:
            no_velocity = tuple(jnp.zeros(3))
            (low, _), (high, _) = (self.surface_point(tuple(sign * normal), no_velocity) for sign in (1.0, -1.0))
            return 0.5 * dot(tuple(normal), sum_vectors(high, scale(-1.0, low)))

        half_widths = jax.vmap(half_width)(evenly_spread(SAMPLES)[0])
        return jnp.min(half_widths, axis=0), jnp.max(half_widths, axis=0)

    def surface_point(self, normal: Vector, rate: Vector) -> tuple[Vector, Vector]:
        leaves, structure = jax.tree.flatten(self.support)

        def of_one(leaves: list[Any], direction: Vector, rate: Vector) -> tuple[Vector, Vector]:
            support = jax.tree.unflatten(structure, leaves)

            def point(direction: Float[Array, "3"]) -> Float[Array, "3"]:
                # The gradient of |d| h(d / |d|), the support function's extension with degree 1.
                return jax.grad(lambda d: _length(d) * support(d / _length(d)))(direction)

            place, change = jax.jvp(point, (jnp.stack(direction),), (jnp.stack(rate),))
            return tuple(place), tuple(change)

        numbers = (leaves, *(scale(-1.0, vector) for vector in (normal, rate)))
        scalar = jax.ShapeDtypeStruct((), jnp.result_type(float))
        with contextlib.suppress(TooLarge):
            return by_components(of_one, *jax.tree.map(lambda _: scalar, numbers))(*numbers)
        if all(jnp.ndim(number) == 0 for number in jax.tree.leaves(numbers)):
            return of_one(*numbers)
        return jax.vmap(of_one, in_axes=jax.tree.map(lambda number: 0 if jnp.ndim(number) else None, numbers))(*numbers)


def _length(vector: Float[Array, "3"]) -> Float[Array, ""]:
    return jnp.sqrt(jnp.sum(vector * vector))


class Plain(eqx.Module):
    """A support function without parameters; the same function gives the same program."""

    function: Any = eqx.field(static=True)

    def __call__(self, direction: Float[Array, "3"]) -> Float[Array, ""]:
        return self.function(direction)


def as_support(value: Any) -> eqx.Module:
    """Convert a support function to a module whose parameters are arrays.

    **Raises:** `ValueError` unless it returns one number for a vector of three.
    """
    if not callable(value):
        raise ValueError(f"support = {shown(value)} must be a function of a direction (3,)")
    if isinstance(value, eqx.Module):
        value = jax.tree.map(lambda leaf: as_number(leaf) if isinstance(leaf, float | np.ndarray) else leaf, value)
        if any(np.ndim(leaf) and not is_traced(leaf) for leaf in jax.tree.leaves(value)):
            return value
    direction = jnp.array([0.0, 0.0, 1.0])
    try:
        result = jax.eval_shape(value, direction)
    except jax.errors.JAXTypeError as error:
        raise ValueError(f"support = {shown(value)} {UNTRACEABLE}") from error
    except (TypeError, IndexError) as error:
        raise ValueError(f"support = {shown(value)} must be a function of a direction (3,): {error}") from error
    if getattr(result, "shape", None) != () or not jnp.issubdtype(result.dtype, jnp.floating):
        raise ValueError(f"support = {shown(value)} must give one number for a direction (3,), not {result}")
    if isinstance(value, eqx.Module):
        return value
    closed = with_own_numbers(value, direction)
    return closed if isinstance(closed, eqx.Module) else Plain(value)


def evenly_spread(count: int) -> tuple[Any, ...]:
    """Unit vectors (count, 3) that cover a sphere evenly, along a spiral, and two unit vectors across each."""
    z = 1.0 - (2.0 * np.arange(count) + 1.0) / count
    angle = np.pi * (1.0 + np.sqrt(5.0)) * np.arange(count)
    radius = np.sqrt(1.0 - z * z)
    normal = np.stack([radius * np.cos(angle), radius * np.sin(angle), z], axis=-1)
    first = np.stack([-np.sin(angle), np.cos(angle), np.zeros(count)], axis=-1)
    return normal, first, np.cross(normal, first)
