"""Frames (t1, t2, n) that move with a ball on a surface, where n is the surface's normal towards the ball.

The ball touches the surface at its foot; its centre is at a distance R from there along n, on the parallel surface.
With V the velocity of the centre, the frame turns as t1' = o1 n, t2' = o2 n, n' = -(o1 t1 + o2 t2), where (o1, o2) = S
V and S is the shape operator of the parallel surface, positive where it is concave towards the ball. The frame does not
turn about n, so the components of a fixed vector change as `vector.rate_in_frame` states.

The frame of a convex body of any shape moves with its contact point: R = 0, and V is that point's velocity along the surface
(`AbstractFrame.convex_motion`).

Plane, cylinder and sphere have their own frames, with fewer numbers than the general one, `CarriedFrame`. A sphere
or cylinder is the same from both sides, except for the sign of its radius, which is positive inside.
"""

import abc
from collections.abc import Iterator
from typing import ClassVar, NamedTuple, TypeAlias

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float

from ..compilation.xla_cpu import least, stored
from ..validation import Bound, as_number
from .surface import AbstractSurface, Cylinder, Place, Plane, Sphere, Torus
from .vector import (
    Component,
    Vector,
    add,
    cross,
    difference,
    dot,
    multiply,
    planar_length,
    rate_in_frame,
    scale,
    subtract,
    sum_vectors,
    tangents,
    unit,
)

#: A vector's components along t1 and t2.
Tangent: TypeAlias = tuple[Component, Component]
#: The components 11, 12 and 22 of a symmetric operator on the tangent plane.
TangentOperator: TypeAlias = Vector


def contact_velocity(
    shape: TangentOperator, radii: TangentOperator, velocity: Tangent
) -> tuple[Tangent, Tangent, Component]:
    """Velocity q' of the contact point of a convex body along a surface, with (1 - H S) q' = V.

    **Arguments:** `shape`: S [1/m] of the surface; `radii`: H [m], whose eigenvalues are the body's principal radii of
    curvature; `velocity`: V [m/s], the velocity of the contact point if the surface did not bend away.

    **Returns:** q' [m/s]; S q' [rad/s]; the room: 1 on a flat surface, and 0 where the body no longer touches at one
    point alone.
    """
    (S11, S12, S22), (H11, H12, H22), (V1, V2) = shape, radii, velocity
    # B = H S.
    B11, B12 = add(multiply(H11, S11), multiply(H12, S12)), add(multiply(H11, S12), multiply(H12, S22))
    B21, B22 = add(multiply(H12, S11), multiply(H22, S12)), add(multiply(H12, S12), multiply(H22, S22))
    A11, A22 = subtract(1.0, B11), subtract(1.0, B22)
    determinant = subtract(A11 * A22, multiply(B12, B21))
    q1 = add(multiply(A22, V1), multiply(B12, V2)) / determinant
    q2 = add(multiply(A11, V2), multiply(B21, V1)) / determinant
    frame_rate = add(multiply(S11, q1), multiply(S12, q2)), add(multiply(S12, q1), multiply(S22, q2))
    # H S has real eigenvalues k; both values 1 - k are positive if these are.
    return (q1, q2), frame_rate, least(determinant, 0.5 * (A11 + A22))


class FrameMotion(NamedTuple):
    """The motion of a frame while the ball moves.

    - `frame_rate`: (o1, o2) = S V [rad/s]; `vertical`: the upward vertical in the frame.
    - `place_rate`: rate of the place.
    - `room`: positive where the ball fits, 1 where the surface is flat; `None` if it fits everywhere.
    """

    frame_rate: Tangent
    vertical: Vector
    place_rate: Place
    room: Component = None


class AbstractFrame(eqx.Module):
    """A moving frame of a ball on a surface.

    The place contains the numbers that are integrated because the motion depends on them; `cyclic` contains those
    needed only to draw the motion.
    """

    #: Distance R [m] from the foot to the point with which the frame moves.
    distance: eqx.AbstractVar[Float[Array, "..."]]

    @abc.abstractmethod
    def at_angle(self, eta: Float[ArrayLike, "..."]) -> tuple[Place, Place]:
        """Place and cyclic coordinates at the angle `eta` [rad] from the lowest point, in the x-z plane."""

    @abc.abstractmethod
    def at_foot(self, foot: Vector) -> tuple[Place, Place]:
        """Place and cyclic coordinates of a ball that touches the surface at a point [m], given in the surface's axes."""

    @abc.abstractmethod
    def place_scales(self, size: Component) -> Place:
        """Magnitudes of the place's components. **Arguments:** `size`: size of the body [m]."""

    @abc.abstractmethod
    def frame_motion(self, place: Place, velocity: Tangent) -> FrameMotion:
        """Motion of the frame while the centre moves with the velocity (V1, V2) [m/s]."""

    @abc.abstractmethod
    def convex_motion(self, place: Place, velocity: Tangent, radii: TangentOperator) -> tuple[FrameMotion, Tangent]:
        """Motion of the frame of a convex body, and the velocity of its contact point along the surface [m/s].

        **Arguments:** `velocity`, `radii`: as for `contact_velocity`; the frame has R = 0.
        """

    @abc.abstractmethod
    def vertical(self, place: Place) -> Vector:
        """Components of the upward vertical in the frame."""

    @abc.abstractmethod
    def height(self, place: Place) -> Component:
        """Height [m] of the centre above the lowest point of the surface, or above z = 0 if there is no lowest
        point."""

    @abc.abstractmethod
    def cyclic_rate(self, cyclic: Place, velocity: Tangent, frame_rate: Tangent) -> Place:
        """Rate of change of `cyclic`."""

    @abc.abstractmethod
    def angle(self, place: Place, cyclic: Place) -> Float[Array, "..."]:
        """Angle eta [rad] from the lowest point."""

    @abc.abstractmethod
    def axes(self, place: Place, cyclic: Place) -> tuple[Vector, Vector, Vector]:
        """The vectors t1, t2 and n in the fixed frame."""

    @abc.abstractmethod
    def position(self, place: Place, cyclic: Place) -> Vector:
        """Position of the centre [m] in the fixed frame."""


class PlaneFrame(AbstractFrame):
    """A plane: the frame does not turn. A level plane has no place; the place on a tilted one is x [m], along the
    rising axis.

    - `distance`: R [m]; `slope`: sine and cosine of the tilt, `None` for a level plane.
    """

    distance: Float[Array, "..."]
    slope: tuple[Float[Array, "..."], Float[Array, "..."]] | None = None

    def at_angle(self, eta: Float[ArrayLike, "..."]) -> tuple[Place, Place]:
        zero = jnp.zeros_like(as_number(eta))
        return self.at_foot((zero, zero))

    def at_foot(self, foot: Vector) -> tuple[Place, Place]:
        return ((), foot[:2]) if self.slope is None else (foot[:1], foot[1:2])

    def place_scales(self, size: Component) -> Place:
        return () if self.slope is None else (size,)

    def frame_motion(self, place: Place, velocity: Tangent) -> FrameMotion:
        return FrameMotion((None, None), self.vertical(place), () if self.slope is None else velocity[:1])

    def convex_motion(self, place: Place, velocity: Tangent, radii: TangentOperator) -> tuple[FrameMotion, Tangent]:
        return self.frame_motion(place, velocity), velocity

    def vertical(self, place: Place) -> Vector:
        return (None, None, 1.0) if self.slope is None else (self.slope[0], None, self.slope[1])

    def height(self, place: Place) -> Component:
        return self.distance if self.slope is None else self.slope[0] * place[0] + self.slope[1] * self.distance

    def cyclic_rate(self, cyclic: Place, velocity: Tangent, frame_rate: Tangent) -> Place:
        return velocity[2 - len(cyclic) :]

    def angle(self, place: Place, cyclic: Place) -> Float[Array, "..."]:
        return jnp.zeros_like(cyclic[0])

    def axes(self, place: Place, cyclic: Place) -> tuple[Vector, Vector, Vector]:
        zero, one = jnp.zeros_like(cyclic[0]), jnp.ones_like(cyclic[0])
        if self.slope is None:
            return (one, zero, zero), (zero, one, zero), (zero, zero, one)
        sine, cosine = one * self.slope[0], one * self.slope[1]
        return (cosine, zero, sine), (zero, one, zero), (-sine, zero, cosine)

    def position(self, place: Place, cyclic: Place) -> Vector:
        x, y = (*place, *cyclic)
        t1, t2, normal = self.axes(place, cyclic)
        return sum_vectors(scale(x, t1), scale(y, t2), scale(self.distance, normal))


class AbstractRoundFrame(AbstractFrame):
    """Inside or outside of a cylinder or a sphere.

    - `radius`: radius of the path of the centre [m], negative outside; `distance`: R [m].
    - `side`: 1 inside, -1 outside.
    """

    #: Whether the surface is curved along t2, too.
    is_curved_along_t2: ClassVar[bool]

    radius: Float[Array, "..."]
    distance: Float[Array, "..."]
    side: float = eqx.field(static=True)

    def place_scales(self, size: Component) -> Place:
        return (1.0, 1.0, 1.0) if self.is_curved_along_t2 else (1.0, 1.0)

    def frame_motion(self, place: Place, velocity: Tangent) -> FrameMotion:
        up = self.vertical(place)
        frame_rate = (velocity[0] / self.radius, velocity[1] / self.radius if self.is_curved_along_t2 else None)
        # The place has the components of the vertical that do not vanish.
        place_rate = tuple(rate for rate in rate_in_frame(up, frame_rate) if rate is not None)
        return FrameMotion(frame_rate, up, place_rate)

    def convex_motion(self, place: Place, velocity: Tangent, radii: TangentOperator) -> tuple[FrameMotion, Tangent]:
        curvature = 1.0 / self.radius
        shape = (curvature, None, curvature if self.is_curved_along_t2 else None)
        contact_rate, _, room = contact_velocity(shape, radii, velocity)
        return self.frame_motion(place, contact_rate)._replace(room=room), contact_rate

    def height(self, place: Place) -> Component:
        # The lowest point is at the distance of the radius below the axis or the centre, on either side.
        return self.side * (self.radius + self.distance) - self.radius * place[-1]


class CylinderFrame(AbstractRoundFrame):
    """A cylinder whose axis is y: t2 along y, n = (-sin c, 0, cos c), and the place is (sin c, cos c).

    Inside, c is eta and t1 points along growing eta; outside, c = eta - pi.
    """

    is_curved_along_t2: ClassVar[bool] = False

    def at_angle(self, eta: Float[ArrayLike, "..."]) -> tuple[Place, Place]:
        eta = as_number(eta)
        return scale(self.side, (jnp.sin(eta), jnp.cos(eta))), (eta, jnp.zeros_like(eta))

    def at_foot(self, foot: Vector) -> tuple[Place, Place]:
        x, y, z = foot
        place, (eta, _) = self.at_angle(jnp.arctan2(x, -z))
        return place, (eta, y)

    def vertical(self, place: Place) -> Vector:
        sine, cosine = place
        return (sine, None, cosine)

    def cyclic_rate(self, cyclic: Place, velocity: Tangent, frame_rate: Tangent) -> Place:
        return (frame_rate[0], velocity[1])

    def angle(self, place: Place, cyclic: Place) -> Float[Array, "..."]:
        return cyclic[0]

    def axes(self, place: Place, cyclic: Place) -> tuple[Vector, Vector, Vector]:
        sine, cosine = place
        zero, one = jnp.zeros_like(sine), jnp.ones_like(sine)
        return (cosine, zero, sine), (zero, one, zero), (-sine, zero, cosine)

    def position(self, place: Place, cyclic: Place) -> Vector:
        sine, cosine = place
        return (self.radius * sine, cyclic[1], -self.radius * cosine)


class SphereFrame(AbstractRoundFrame):
    """A sphere; the frame is carried parallel to itself, so no place is singular.

    The place is the vertical z seen in the frame; `cyclic` adds the horizontal x axis seen in it.
    """

    is_curved_along_t2: ClassVar[bool] = True

    def at_angle(self, eta: Float[ArrayLike, "..."]) -> tuple[Place, Place]:
        eta = as_number(eta)
        zero, sine, cosine = jnp.zeros_like(eta), self.side * jnp.sin(eta), self.side * jnp.cos(eta)
        return (sine, zero, cosine), (cosine, zero, -sine)

    def at_foot(self, foot: Vector) -> tuple[Place, Place]:
        n = scale(-self.side / jnp.sqrt(dot(foot, foot)), foot)
        t1, t2 = tangents(n)
        return (t1[2], t2[2], n[2]), (t1[0], t2[0], n[0])

    def vertical(self, place: Place) -> Vector:
        return tuple(place)

    def cyclic_rate(self, cyclic: Place, velocity: Tangent, frame_rate: Tangent) -> Place:
        return rate_in_frame(cyclic, frame_rate)

    def angle(self, place: Place, cyclic: Place) -> Float[Array, "..."]:
        return jnp.arctan2(planar_length(place[0], place[1]), self.side * place[2])

    def axes(self, place: Place, cyclic: Place) -> tuple[Vector, Vector, Vector]:
        y = cross(place, cyclic)
        t1, t2, n = zip(cyclic, y, place, strict=True)
        return t1, t2, n

    def position(self, place: Place, cyclic: Place) -> Vector:
        return scale(-self.radius, self.axes(place, cyclic)[2])


def along(n: Vector, direction: Vector) -> tuple[Vector, Vector]:
    """Unit vectors across n: t1 along the projection of a direction onto the tangent plane, and t2 = n x t1."""
    t1 = unit(difference(direction, scale(dot(n, direction), n)))
    return t1, cross(n, t1)


# The moving frame of a ball on any smooth surface, without coordinate singularities, and the choice of frame for a
# surface.
#
# The place consists of the foot, where the ball touches the surface, and the first tangent, both in the surface's axes.
# The surface gives its normal n and the rate n' = -S_a q' for a velocity q' along the surface. The centre is at O = q + R
# n, so its velocity is V = (1 - R S_a) q', and with S = S_a (1 - R S_a)^-1 the rate is n' = -S V (`tippe.md`, section 2
# (iv)). The ball fits while no principal curvature reaches 1/R.


def place_named(surface: AbstractSurface, place: Place) -> Place:
    """Convert a place whose eta is measured from the lowest point of a closed surface to a place for `surface.chart`.

    **Arguments:** `place`: numbers named by `surface.coordinates`, or (x, y, z).
    """
    return (place[0], place[1] - 0.5 * jnp.pi) if len(place) == 2 and surface.coordinates[0][0] == "mu" else place


def frame_of(
    surface: AbstractSurface, side: float, distance: Float[Array, "..."], pull: Float[Array, "..."]
) -> AbstractFrame:
    """The frame of a ball on a surface: the surface's own if it has one, else a `CarriedFrame`.

    **Arguments:** as for `CarriedFrame`.
    """
    if isinstance(surface, Plane):
        slope = None if surface.tilt is None else (jnp.sin(surface.tilt), jnp.cos(surface.tilt))
        return PlaneFrame(distance, slope)
    if isinstance(surface, Cylinder | Sphere):
        kind = CylinderFrame if isinstance(surface, Cylinder) else SphereFrame
        return kind(-side * surface.radius - distance, distance, -side)
    return CarriedFrame.of(surface, distance, pull, side)


def room_bounds(surface: AbstractSurface, side: float, distance: Float[Array, "..."]) -> Iterator[Bound]:
    """The ranges of a surface's parameters for which a ball fits at some point of the surface.

    **Arguments:** as for `CarriedFrame`.
    """
    if side < 0.0 and isinstance(surface, Cylinder | Sphere):
        yield Bound(surface.radius, "surface radius", above=distance, why="the body must fit inside")
    if side < 0.0 and isinstance(surface, Torus):
        yield Bound(surface.tube, "surface tube", above=distance, why="the body must fit inside")


class CarriedFrame(AbstractFrame):
    """A frame that is carried along any surface.

    - `surface`: the surface that the ball touches; `side`: 1 if the ball is on the side of the surface's normal, else
      -1.
    - `distance`: R [m].
    - `pull`: rate [1/s] at which the foot is pulled back to the surface if round-off and step errors move it off.
    - `up`: the upward vertical in the surface's axes.
    """

    surface: AbstractSurface
    distance: Float[Array, "..."]
    pull: Float[Array, "..."]
    up: Vector
    side: float = eqx.field(static=True, default=1.0)

    @classmethod
    def of(
        cls, surface: AbstractSurface, distance: Float[Array, "..."], pull: Float[Array, "..."], side: float = 1.0
    ) -> "CarriedFrame":
        """The frame of a ball on a surface. **Arguments:** the fields except `up`."""
        # Computed once: a tilted plane stores its tilt as an angle, and no step should compute the sine.
        return cls(surface=surface, distance=distance, pull=pull, up=surface.up, side=side)

    def at_angle(self, eta: Float[ArrayLike, "..."]) -> tuple[Place, Place]:
        eta = as_number(eta)
        zero = jnp.zeros_like(eta)
        names = [name for name, _ in self.surface.coordinates]
        place = tuple(eta if name == "eta" else zero for name in names)
        foot = self.surface.chart(place_named(self.surface, place))[0]
        return self._start(foot, along_eta=isinstance(self.surface, Cylinder | Sphere))

    def at_foot(self, foot: Vector) -> tuple[Place, Place]:
        return self._start(foot, along_eta=isinstance(self.surface, Cylinder))

    def _start(self, foot: Vector, along_eta: bool) -> tuple[Place, Place]:
        """The frame at a foot. `along_eta`: whether t1 points along growing eta inside, as in `CylinderFrame`; the
        projection of the x axis reverses its direction at eta = pi/2."""
        foot = tuple(jnp.broadcast_arrays(*(0.0 if x is None else x for x in foot)))
        normal = self.normal(foot)
        t1 = (normal[2], jnp.zeros_like(normal[1]), -normal[0]) if along_eta else tangents(normal)[0]
        return (*foot, *t1), ()

    def normal(self, foot: Vector) -> Vector:
        """The normal n at a foot, in the surface's axes."""
        normal = scale(self.side, self.surface.normal(foot))
        return tuple(jnp.broadcast_to(0.0 if x is None else x, jnp.shape(foot[0])) for x in normal)

    def place_scales(self, size: Component) -> Place:
        return (size,) * 3 + (1.0,) * 3

    def frame_motion(self, place: Place, velocity: Tangent) -> FrameMotion:
        # The distance R is the radius of the ball that touches.
        return self.convex_motion(place, velocity, (self.distance, None, self.distance))[0]

    def convex_motion(self, place: Place, velocity: Tangent, radii: TangentOperator) -> tuple[FrameMotion, Tangent]:
        foot, zero = place[:3], jnp.zeros_like(place[0])
        # Stored, because otherwise each of the values below, and each of their derivatives, would compute these again.
        n = stored(*self.normal(foot))
        # If the first tangent has drifted, only its direction along the surface counts.
        t1 = stored(*along(n, place[3:])[0])
        t2 = cross(n, t1)
        bending = scale(-self.side, self.surface.bending(foot, t1, t2))
        shape = stored(*(zero if S is None else S for S in bending))
        foot_velocity, frame_rate, room = contact_velocity(shape, radii, velocity)
        o1, o2, *up = stored(*frame_rate, *(dot(axis, self.up) for axis in (t1, t2, n)))
        pull_back = -self.pull * self.side * self.surface.offset(foot)
        carried = sum_vectors(scale(foot_velocity[0], t1), scale(foot_velocity[1], t2), scale(pull_back, n))
        return FrameMotion((o1, o2), tuple(up), (*carried, *scale(o1, n)), room), foot_velocity

    def own_axes(self, place: Place) -> tuple[Vector, Vector, Vector]:
        """The vectors t1, t2 and n in the surface's axes."""
        n = self.normal(place[:3])
        return (*along(n, place[3:]), n)

    def vertical(self, place: Place) -> Vector:
        return tuple(dot(axis, self.up) for axis in self.own_axes(place))

    def height(self, place: Place) -> Component:
        return self.surface.elevation(place[:3]) + self.distance * dot(self.normal(place[:3]), self.up)

    def cyclic_rate(self, cyclic: Place, velocity: Tangent, frame_rate: Tangent) -> Place:
        return ()

    def angle(self, place: Place, cyclic: Place) -> Float[Array, "..."]:
        """The angle eta in the surface's convention, or the slope of the ground if no coordinate of the surface is an
        angle."""
        foot, names = place[:3], [name for name, _ in self.surface.coordinates]
        if "eta" not in names:
            t1_up, t2_up, n_up = self.vertical(place)
            return jnp.arctan2(planar_length(t1_up, t2_up), n_up)
        eta = self.surface.place_at(foot)[names.index("eta")]
        return eta + 0.5 * jnp.pi if names[0] == "mu" else eta

    def axes(self, place: Place, cyclic: Place) -> tuple[Vector, Vector, Vector]:
        t1, t2, n = map(self.surface.in_fixed_frame, self.own_axes(place))
        return t1, t2, n

    def position(self, place: Place, cyclic: Place) -> Vector:
        centre = sum_vectors(place[:3], scale(self.distance, self.normal(place[:3])))
        return self.surface.in_fixed_frame(centre)
