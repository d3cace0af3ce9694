"""Bodies of any shape and any inertia, such as an unbalanced top or a rattleback, and their equations of motion, free of
trigonometry and of coordinate singularities.

A strictly convex body touches an arena at the point that is farthest in the direction opposite to the arena's normal.
In the body's own axes this point is p(d) = grad h at d = -normal. The support function h(d), extended to all vectors
with degree 1, is the distance from the origin of the axes to the plane that the body touches with the outward normal d.

Source: Bonnesen and Fenchel, Theorie der konvexen Koerper (1934), section 15.
"""

import abc
from collections.abc import Callable, Iterable, Iterator
from typing import Any, ClassVar, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from nonholonomic.compilation.components import over_lanes
from nonholonomic.compilation.xla_cpu import stored
from nonholonomic.geometry import AbstractFrame, Component, FrameMotion, Place, PlaneFrame, Tangent, Vector, as_function
from nonholonomic.geometry.vector import add, cross, dot, multiply, rate_in_frame, scale, subtract, sum_vectors
from nonholonomic.integration import Components, States
from nonholonomic.text import shown
from nonholonomic.validation import ArrayOrList, Bound, Bounded, as_number, is_traced

from ..friction import AbstractFriction, ContactLoad, Slip
from .dynamics import AXIS, AbstractContactDynamics, AbstractRollingDynamics, Motion, from_frame, parts, to_frame

# The inertia tensor of a rigid body, and symmetric matrices stored by their six components.

#: Rounding error allowed in the moments of a flat body, as a fraction of their sum.
FLAT = 1e-12

#: What a vector along the body's axes must be.
ALONG_AXES = "three numbers, along the body's axes x, y and z"

#: Names of the components of inertia.
COMPONENTS = ("xx", "yy", "zz", "xy", "xz", "yz")

#: Degrees of the principal minors of a matrix in its components, in the order of `SymmetricMatrix.principal_minors`.
DEGREES = (1, 1, 1, 2, 2, 2, 3)


def several(name: str, counts: tuple[int, ...], words: str, optional: bool = False) -> Callable[[Any], Any]:
    """The converter of a vector to a tuple of arrays; if it is `optional`, `None` stays `None`.

    **Arguments:** `counts`: the allowed numbers of components; `words`: what the vector must be, in the message of the
    `ValueError` about another one.
    """

    def converted(value: Any) -> Any:
        if value is None and optional:
            return None
        if isinstance(value, Iterable) and not isinstance(value, str) and getattr(value, "ndim", 1) != 0:
            value = tuple(as_number(part) for part in value)
        if not isinstance(value, tuple) or len(value) not in counts:
            raise ValueError(f"{name} = {shown(value)} must be {words}")
        return value

    return converted


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
    def of(cls, matrix: "ArrayOrList | Inertia") -> "Inertia":
        """The tensor from a symmetric matrix (3, 3); for a traced matrix, its symmetric part."""
        if isinstance(matrix, Inertia):
            return matrix
        values = as_number(matrix)
        if not eqx.is_array(values) or values.shape != (3, 3):
            raise ValueError(f"inertia = {shown(matrix)} must be a (3, 3) matrix, in kg m^2 about the centre of mass")
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
        xx, yy, zz, xy, xz, yz = self.tensor
        yield from super().bounds()
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
    def tensor(self) -> "SymmetricMatrix":
        """The tensor, without checks."""
        return SymmetricMatrix(self.xx, self.yy, self.zz, self.xy, self.xz, self.yz)

    @property
    def _moments(self) -> str:
        """The principal moments of a known tensor, as an addition to messages."""
        if any(is_traced(number) or np.ndim(number) for number in self.tensor):
            return ""
        # In NumPy: inside a transformation, JAX would trace this even for known numbers.
        xx, yy, zz, xy, xz, yz = map(float, self.tensor)
        moments = np.linalg.eigvalsh([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
        return f"; here they are {', '.join(f'{moment:.4g}' for moment in moments)}"


class SymmetricMatrix(NamedTuple):
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
    def cofactors(self) -> tuple["SymmetricMatrix", Float[Array, "..."]]:
        """The matrix of the cofactors, and the determinant."""
        xx, yy, zz, xy, xz, yz = self
        diagonal = (yy * zz - yz * yz, xx * zz - xz * xz, xx * yy - xy * xy)
        adjugate = SymmetricMatrix(*diagonal, xz * yz - xy * zz, xy * yz - xz * yy, xy * xz - yz * xx)
        return adjugate, xx * adjugate.xx + xy * adjugate.xy + xz * adjugate.xz

    @property
    def inverse(self) -> "SymmetricMatrix":
        """The inverse."""
        adjugate, determinant = self.cofactors
        return SymmetricMatrix(*(cofactor / determinant for cofactor in adjugate))

    def solve(self, right: Vector) -> Vector:
        """Solution x of A x = right."""
        adjugate, determinant = self.cofactors
        return scale(1.0 / determinant, adjugate.times(right))

    @property
    def principal_minors(self) -> tuple[Float[Array, "..."], ...]:
        """The seven principal minors, from one row to three rows; all are nonnegative if the matrix is positive
        semidefinite."""
        adjugate, determinant = self.cofactors
        return (*self[:3], *adjugate[:3], determinant)


#: Number of directions in which a support function is evaluated to check that the body is convex.
SAMPLES = 200


class AbstractRigidBody(Bounded):
    """A strictly convex body of any inertia.

    Its axes x, y and z are fixed in it; theta is the angle from the arena's normal to its z axis.
    """

    mass: eqx.AbstractVar[Float[Array, "..."]]
    inertia: eqx.AbstractVar[Inertia]
    centre_of_mass: eqx.AbstractVar[tuple[Float[Array, "..."], ...]]

    #: A length of the body [m], the unit for places and velocities; and half the least and half the greatest distance
    #: [m] of parallel planes that touch the body. Every body has these properties.
    size: ClassVar[Float[Array, "..."]]
    half_widths: ClassVar[tuple[Float[Array, "..."], Float[Array, "..."]]]

    @property
    def moments(self) -> tuple[Float[Array, "..."], Float[Array, "..."]]:
        """The magnitudes of the moments of inertia across and along the body's z axis [kg m^2]."""
        return 0.5 * (self.inertia.xx + self.inertia.yy), self.inertia.zz

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

    mass: Float[Array, "..."] = eqx.field(converter=as_number, metadata=Bound.POSITIVE)
    semi_axes: tuple[Float[Array, "..."], ...] = eqx.field(
        converter=several("semi_axes", (3,), ALONG_AXES), metadata=Bound.POSITIVE
    )
    centre_of_mass: tuple[Float[Array, "..."], ...] = eqx.field(converter=several("centre_of_mass", (3,), ALONG_AXES))
    inertia: Inertia = eqx.field(converter=Inertia.of)

    def bounds(self) -> Iterator[Bound]:
        yield from super().bounds()
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

    mass: Float[Array, "..."] = eqx.field(converter=as_number, metadata=Bound.POSITIVE)
    inertia: Inertia = eqx.field(converter=Inertia.of)
    support: Any = eqx.field(converter=lambda value: as_function(value, "support", ("direction (3,)",), vector=True))
    centre_of_mass: tuple[Float[Array, "..."], ...] = eqx.field(
        converter=several("centre_of_mass", (3,), ALONG_AXES), default=(0.0, 0.0, 0.0)
    )

    def bounds(self) -> Iterator[Bound]:
        yield from super().bounds()
        height, min_radius = (jnp.min(part, axis=0) for part in self._samples())
        yield Bound(height, "least support seen from centre_of_mass", above=0.0, why="the centre of mass lies inside")
        yield Bound(min_radius, "least radius of curvature by support", above=0.0, why="the body is strictly convex")

    def _samples(self) -> tuple[Float[Array, "samples ..."], Float[Array, "samples ..."]]:
        """Height of the centre of mass above a plane, and the smaller principal radius of curvature [m], by direction."""

        def sample(normal, first, second):
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
        def half_width(normal):
            no_velocity = tuple(jnp.zeros(3))
            (low, _), (high, _) = (self.surface_point(tuple(sign * normal), no_velocity) for sign in (1.0, -1.0))
            return 0.5 * dot(tuple(normal), sum_vectors(high, scale(-1.0, low)))

        half_widths = jax.vmap(half_width)(evenly_spread(SAMPLES)[0])
        return jnp.min(half_widths, axis=0), jnp.max(half_widths, axis=0)

    def surface_point(self, normal: Vector, rate: Vector) -> tuple[Vector, Vector]:
        leaves, structure = jax.tree.flatten(self.support)

        def of_one(leaves: list[Array], direction: Vector, rate: Vector) -> tuple[Vector, Vector]:
            support = jax.tree.unflatten(structure, leaves)

            def extended(d: Float[Array, "3"]) -> Float[Array, ""]:
                """The support function's extension with degree 1, |d| h(d / |d|)."""
                return jnp.sqrt(jnp.sum(d * d)) * support(d / jnp.sqrt(jnp.sum(d * d)))

            place, change = jax.jvp(jax.grad(extended), (jnp.stack(direction),), (jnp.stack(rate),))
            return tuple(place), tuple(change)

        return over_lanes(of_one, leaves, *(scale(-1.0, vector) for vector in (normal, rate)))


def evenly_spread(count: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Unit vectors (count, 3) that cover a sphere evenly, along a spiral, and two unit vectors across each."""
    z = 1.0 - (2.0 * np.arange(count) + 1.0) / count
    angle = np.pi * (1.0 + np.sqrt(5.0)) * np.arange(count)
    radius = np.sqrt(1.0 - z * z)
    normal = np.stack([radius * np.cos(angle), radius * np.sin(angle), z], axis=-1)
    first = np.stack([-np.sin(angle), np.cos(angle), np.zeros(count)], axis=-1)
    return normal, first, np.cross(normal, first)


# The equations of motion.
#
# The state is that of a top (`dynamics.py`) with an additional vector: in the arena's frame (t1, t2, n) the velocity (u1,
# u2) of the centre of mass along the arena, the body's z axis e, the angular momentum L about the centre of mass, the
# arena's place, and the body's x axis c. With d = e x c, the components of n in the body's axes are (c.n, d.n, e.n),
# which determine the contact.
#
# With r from the centre of mass to the contact, the laws of motion are L' = r x F + N tau and m u' = F - m g z; the contact
# persists if the contact point has no velocity along n. The frame moves with the contact point, whose velocity along the arena
# is q' = (1 - H S)^-1 (v - H (n x w)), with the slip velocity v, the shape operator S of the arena, and the operator H whose
# eigenvalues are the body's principal radii of curvature; n' = -S q'. Source: Newton and Euler; for the contact, Montana,
# Int. J. Robotics Research 7 (1988) 17; for rolling, Garcia and Hubbard, Proc. R. Soc. A 418 (1988) 165, and Kane and
# Levinson, Int. J. Non-Linear Mechanics 17 (1982) 175.


class Attitude(NamedTuple):
    """The attitude and rotation of a body, and its contact point.

    - `axes`: the body's axes x, y and z in the frame (t1, t2, n).
    - `normal`, `momentum`, `angular_velocity`: n, angular momentum and angular velocity in the body's axes.
    - `lever`: the vector r from the centre of mass to the contact [m] in the body's axes.
    - `fixed_rates`: rates of change of the components of n and of r if n is fixed, as on a plane.
    """

    axes: tuple[Vector, Vector, Vector]
    normal: Vector
    momentum: Vector
    angular_velocity: Vector
    lever: Vector
    fixed_rates: tuple[Vector, Vector]


class ContactMotion(NamedTuple):
    """The motion of the contact point.

    - `normal_rate`, `lever_rate`: rates of change of the components of n and of r in the body's axes.
    - `frame`: motion of the frame and of the contact point along the arena.
    """

    normal_rate: Vector
    lever_rate: Vector
    frame: FrameMotion


class AbstractRigidDynamics(AbstractContactDynamics):
    """A scene with a rigid body, with the precomputed combinations of its numbers; in place of `Dynamics`."""

    frame: AbstractFrame
    body: AbstractRigidBody
    gravity: Float[Array, "..."]
    inverse: SymmetricMatrix

    def attitude(self, state: Components) -> Attitude:
        """The attitude and rotation of the body, and its contact point."""
        _, e, L, place = parts(state)
        c = tuple(place[-3:])
        axes = (c, cross(e, c), e)
        n = tuple(axis[2] for axis in axes)
        momentum = tuple(dot(L, axis) for axis in axes)
        angular_velocity = stored(*self.inverse.times(momentum))
        normal_rate = cross(n, angular_velocity)
        lever, lever_rate = self.body.contact(n, normal_rate)
        return Attitude(axes, n, momentum, angular_velocity, lever, (normal_rate, lever_rate))

    def contact_motion(self, place: Place, attitude: Attitude, slip: Tangent) -> ContactMotion:
        """The motion of the contact point. **Arguments:** `place`: place of the frame; `slip`: velocity v along the
        arena [m/s]."""
        normal_rate, lever_rate = attitude.fixed_rates
        over_body, axes = from_frame(lever_rate, attitude.axes), attitude.axes
        V1, V2 = add(slip[0], over_body[0]), add(slip[1], over_body[1])
        if isinstance(self.frame, PlaneFrame):
            return ContactMotion(normal_rate, lever_rate, self.frame.frame_motion(place, (V1, V2)))
        # If n turns along a tangent, the contact moves against it over the body, by H.
        tangents = [tuple(axis[k] for axis in axes) for k in (0, 1)]
        first, second = (from_frame(self.body.contact(attitude.normal, t)[1], axes) for t in tangents)
        H11, H12, H22, V1, V2 = stored(-first[0], -first[1], -second[1], V1, V2)
        frame = self.frame.frame_motion(place, (V1, V2), (H11, H12, H22))
        path = stored(*frame.contact_velocity)
        frame_part = to_frame((subtract(None, frame.frame_rate[0]), subtract(None, frame.frame_rate[1]), None), axes)
        lever_rate = to_frame((subtract(path[0], slip[0]), subtract(path[1], slip[1]), None), axes)
        return ContactMotion(sum_vectors(normal_rate, frame_part), lever_rate, frame._replace(contact_velocity=path))

    def rotation(self, state: Components) -> tuple[Vector, Vector]:
        attitude = self.attitude(state)
        return from_frame(attitude.angular_velocity, attitude.axes), from_frame(attitude.lever, attitude.axes)

    def carried_rates(
        self,
        state: Components,
        attitude: Attitude,
        contact: ContactMotion,
        push: Tangent,
        rise: Component,
        torque: tuple[Component, ...],
    ) -> tuple[Component, ...]:
        """Rate of change of the state's components, in the frame that moves with the contact.

        **Arguments:** `push`: force along the arena, over the mass [m/s^2]; `rise`: velocity of the centre of mass along n
        [m/s]; `torque`: L' [N m].
        """
        _, e, L, place = parts(state)
        o, up, place_rate, _, _ = contact.frame
        # The body's axes turn with it.
        (x, y, z), (w1, w2, w3) = attitude.axes, attitude.angular_velocity
        x_rate = tuple(w3 * b - w2 * c for b, c in zip(y, z, strict=True))
        z_rate = tuple(w2 * a - w1 * b for a, b in zip(x, y, strict=True))
        u1_dot = add(push[0], multiply(-self.gravity, up[0]), multiply(o[0], rise))
        u2_dot = add(push[1], multiply(-self.gravity, up[1]), multiply(o[1], rise))
        e_dot, L_dot = sum_vectors(z_rate, rate_in_frame(e, o)), sum_vectors(torque, rate_in_frame(L, o))
        return (u1_dot, u2_dot, *e_dot, *L_dot, *place_rate, *sum_vectors(x_rate, rate_in_frame(place[-3:], o)))


class RigidSlipping(AbstractRigidDynamics):
    """The equations of motion under a friction law that determines the force from the slip."""

    friction: AbstractFriction
    per_mass: Float[Array, "..."]

    def motion(self, state: Components) -> Motion:
        """Evaluate the equations of motion, solving for the normal force with friction included.

        With q = r x n and J the inertia, all in the body's axes, the centre of mass rises at u.n = -w.q. Its second rate gives
        N (1 + m (J^-1 q).M) = m (g z.n + u.S q' - (J^-1 q).(L x w) - w.q'), M the moment per unit normal force.
        """
        (u1, u2), _, _, place = parts(state)
        attitude = self.attitude(state)
        axes, normal, momentum, w, lever, _ = attitude
        r, swing = from_frame(lever, axes), from_frame(cross(w, lever), axes)
        slip_x, slip_y = stored(u1 + swing[0], u2 + swing[1])
        contact = self.contact_motion(place[:-3], attitude, (slip_x, slip_y))
        o, up, _, room, path = contact.frame
        slip = Slip(slip_x, slip_y, from_frame(w, axes))
        friction = self.friction.per_normal_force(slip)
        f1, f2 = friction.force
        moment = stored(*sum_vectors(cross(r, (f1, f2, 1.0)), friction.torque))

        rise = cross(lever, normal)
        arm = self.inverse.times(rise)
        rise_rate = sum_vectors(cross(contact.lever_rate, normal), cross(lever, contact.normal_rate))
        bend = dot(arm, cross(momentum, w)) + dot(w, rise_rate)
        mass = self.body.mass
        painleve_factor = 1.0 + mass * dot(arm, to_frame(moment, axes))
        pull = add(multiply(self.gravity, up[2]), dot((u1, u2), o))
        N = mass * (pull - bend) / painleve_factor

        thrust = N * self.per_mass
        push = (multiply(thrust, f1), multiply(thrust, f2))
        u3 = None if o == (None, None) else -dot(w, rise)
        rates = self.carried_rates(state, attitude, contact, push, u3, scale(N, moment))
        return Motion(rates, N, friction, slip, path, o, w[2], painleve_factor, room)


class RigidRolling(AbstractRigidDynamics, AbstractRollingDynamics):
    """The equations of motion of a body whose contact point is at rest: the nonholonomic constraint itself."""

    def evaluate(self, state: Components) -> tuple[Motion, Vector]:
        """The motion and the reaction F in the frame.

        In the body's axes, with the velocity r x w of the centre of mass and r' the rate of r as a vector,
        (J + m (r^2 - r r^T)) w' = L x w + m r x (r' x w + g z), and F = m (r' x w + r x w' + g z).
        """
        place, attitude = parts(state).place, self.attitude(state)
        m, r, w = self.body.mass, attitude.lever, attitude.angular_velocity
        contact = self.contact_motion(place[:-3], attitude, (None, None))
        o, up, _, room, path = contact.frame
        r_dot = sum_vectors(contact.lever_rate, cross(w, r))
        steady_push = sum_vectors(cross(r_dot, w), scale(self.gravity, to_frame(up, attitude.axes)))
        torque = sum_vectors(cross(attitude.momentum, w), scale(m, cross(r, steady_push)))
        w_dot = self._about_contact(r).solve(stored(*torque))
        reaction = from_frame(scale(m, sum_vectors(steady_push, cross(r, w_dot))), attitude.axes)
        F = stored(*reaction)

        push = (F[0] / m, F[1] / m)
        u3 = None if o == (None, None) else dot(attitude.normal, cross(r, w))
        rates = self.carried_rates(state, attitude, contact, push, u3, cross(from_frame(r, attitude.axes), F))
        load = ContactLoad((F[0] / F[2], F[1] / F[2]))
        zero = jnp.zeros_like(F[2])
        slip = Slip(zero, zero, from_frame(w, attitude.axes))
        return Motion(rates, F[2], load, slip, path, o, w[2], 1.0 + zero, room), F

    def _about_contact(self, lever: Vector) -> SymmetricMatrix:
        """The inertia about the contact, J + m (r^2 - r r^T), in the body's axes."""
        m, r, square, inertia = self.body.mass, lever, dot(lever, lever), self.body.inertia
        return SymmetricMatrix(
            inertia.xx + m * (square - r[0] * r[0]),
            inertia.yy + m * (square - r[1] * r[1]),
            inertia.zz + m * (square - r[2] * r[2]),
            inertia.xy - m * r[0] * r[1],
            inertia.xz - m * r[0] * r[2],
            inertia.yz - m * r[1] * r[2],
        )

    def over_inertia(self, state: Components, lever: Vector, torque: Vector) -> Vector:
        axes = self.attitude(state).axes
        solution = self._about_contact(to_frame(lever, axes)).solve(to_frame(torque, axes))
        return from_frame(solution, axes)

    def momentum(self, state: States, w: Vector) -> Vector:
        axes = self.attitude(state).axes
        return from_frame(self.body.inertia.tensor.times(to_frame(w, axes)), axes)

    def with_unit_axes(self, state: States) -> States:
        e, x = state[AXIS] / jnp.linalg.norm(state[AXIS], axis=0), state[-3:]
        x = x - jnp.sum(e * x, axis=0) * e
        return state.at[AXIS].set(e).at[-3:].set(x / jnp.linalg.norm(x, axis=0))
