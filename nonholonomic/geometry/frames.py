"""Frames (t1, t2, n) that move with a ball on a surface, where n is the surface's normal towards the ball.

The ball touches the surface at its foot; its centre is at a distance R from there along n, on the parallel surface.
With V the velocity of the centre, the frame turns as t1' = o1 n, t2' = o2 n, n' = -(o1 t1 + o2 t2), where (o1, o2) = S
V and S is the shape operator of the parallel surface, positive where it is concave towards the ball. The frame does not
turn about n, so the components of a fixed vector change as `vector.rate_in_frame` states.

The frame of a convex body of any shape moves with its contact point: R = 0, and V is that point's velocity along the surface
(`AbstractFrame.frame_motion`).

Plane, cylinder and sphere have their own frames, with fewer numbers than the general one, `CarriedFrame`. A sphere
or cylinder is the same from both sides, except for the sign of its radius, which is positive inside.
"""

import abc
from typing import ClassVar, NamedTuple, TypeAlias

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from ..compilation.xla_cpu import least, stored
from .surface import AbstractSurface, Cylinder, Place, Plane, Sphere
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
    - `contact_velocity`: velocity of the contact point of a convex body along the surface [m/s].
    """

    frame_rate: Tangent
    vertical: Vector
    place_rate: Place
    room: Component
    contact_velocity: Tangent


class Pose(NamedTuple):
    """Where a frame is, for pictures: the vectors t1, t2 and n in the fixed frame, the position of the centre [m] in
    the fixed frame, and the angle eta [rad] from the lowest point."""

    axes: tuple[Vector, Vector, Vector]
    position: Vector
    angle: Float[Array, "..."]


class AbstractFrame(eqx.Module):
    """A moving frame of a ball on a surface.

    The place contains the numbers that are integrated because the motion depends on them; `cyclic` contains those
    needed only to draw the motion.
    """

    #: Distance R [m] from the foot to the point with which the frame moves.
    distance: eqx.AbstractVar[Float[Array, "..."]]

    #: Which components of the place are lengths, the others have the magnitude 1: a constant or property of every kind.
    lengths: ClassVar[tuple[bool, ...]]

    @abc.abstractmethod
    def start(self, foot: Vector, along_eta: bool = False) -> tuple[Place, Place]:
        """Place and cyclic coordinates of a ball that touches the surface at a point [m], given in the surface's axes.

        **Arguments:** `along_eta`: whether t1 points along growing eta inside a sphere, as it always does in a cylinder;
        the projection of the x axis reverses its direction at eta = pi/2.
        """

    @abc.abstractmethod
    def frame_motion(self, place: Place, velocity: Tangent, radii: TangentOperator | None = None) -> FrameMotion:
        """Motion of the frame while the centre of a ball moves with the velocity (V1, V2) [m/s], or the contact point of
        a convex body.

        **Arguments:** for a convex body, `velocity` and `radii` as for `contact_velocity`; the frame then has R = 0.
        """

    @abc.abstractmethod
    def height(self, place: Place) -> Component:
        """Height [m] of the centre above the lowest point of the surface, or above z = 0 if there is no lowest
        point."""

    def cyclic_rate(self, cyclic: Place, velocity: Tangent, frame_rate: Tangent) -> Place:
        """Rate of change of `cyclic`: by default, of the last coordinates of a plane."""
        return velocity[2 - len(cyclic) :]

    @abc.abstractmethod
    def pose(self, place: Place, cyclic: Place) -> Pose:
        """Where the frame is."""

    def vertical(self, place: Place) -> Vector:
        """Components of the upward vertical in the frame."""
        return self.frame_motion(place, (0.0, 0.0)).vertical


class PlaneFrame(AbstractFrame):
    """A plane: the frame does not turn. A level plane has no place; the place on a tilted one is x [m], along the
    rising axis.

    - `distance`: R [m]; `slope`: sine and cosine of the tilt, `None` for a level plane.
    """

    distance: Float[Array, "..."]
    slope: tuple[Float[Array, "..."], Float[Array, "..."]] | None = None

    @property
    def lengths(self) -> tuple[bool, ...]:
        return () if self.slope is None else (True,)

    def start(self, foot: Vector, along_eta: bool = False) -> tuple[Place, Place]:
        return ((), foot[:2]) if self.slope is None else (foot[:1], foot[1:2])

    def frame_motion(self, place: Place, velocity: Tangent, radii: TangentOperator | None = None) -> FrameMotion:
        up = (None, None, 1.0) if self.slope is None else (self.slope[0], None, self.slope[1])
        return FrameMotion((None, None), up, velocity[: len(self.lengths)], None, velocity)

    def height(self, place: Place) -> Component:
        return self.distance if self.slope is None else self.slope[0] * place[0] + self.slope[1] * self.distance

    def pose(self, place: Place, cyclic: Place) -> Pose:
        x, y = (*place, *cyclic)
        zero, unity = jnp.zeros_like(y), jnp.ones_like(y)
        sine, cosine = (zero, unity) if self.slope is None else (unity * self.slope[0], unity * self.slope[1])
        axes = (cosine, zero, sine), (zero, unity, zero), (-sine, zero, cosine)
        t1, t2, normal = axes
        position = sum_vectors(scale(x, t1), scale(y, t2), scale(self.distance, normal))
        return Pose(axes, position, zero)


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

    def frame_motion(self, place: Place, velocity: Tangent, radii: TangentOperator | None = None) -> FrameMotion:
        room = None
        if radii is not None:
            curvature = 1.0 / self.radius
            shape = (curvature, None, curvature if self.is_curved_along_t2 else None)
            velocity, _, room = contact_velocity(shape, radii, velocity)
        # The place has the components of the vertical that do not vanish.
        up = tuple(place) if self.is_curved_along_t2 else (place[0], None, place[1])
        frame_rate = (velocity[0] / self.radius, velocity[1] / self.radius if self.is_curved_along_t2 else None)
        place_rate = tuple(rate for rate in rate_in_frame(up, frame_rate) if rate is not None)
        return FrameMotion(frame_rate, up, place_rate, room, velocity)

    def height(self, place: Place) -> Component:
        # The lowest point is at the distance of the radius below the axis or the centre, on either side.
        return self.side * (self.radius + self.distance) - self.radius * place[-1]


class CylinderFrame(AbstractRoundFrame):
    """A cylinder whose axis is y: t2 along y, n = (-sin c, 0, cos c), and the place is (sin c, cos c).

    Inside, c is eta and t1 points along growing eta; outside, c = eta - pi. The cyclic coordinates are eta and y.
    """

    is_curved_along_t2: ClassVar[bool] = False
    lengths: ClassVar[tuple[bool, ...]] = (False, False)

    def start(self, foot: Vector, along_eta: bool = False) -> tuple[Place, Place]:
        x, y, z = foot
        eta = jnp.arctan2(x, -z)
        return scale(self.side, (jnp.sin(eta), jnp.cos(eta))), (eta, y)

    def cyclic_rate(self, cyclic: Place, velocity: Tangent, frame_rate: Tangent) -> Place:
        return (frame_rate[0], velocity[1])

    def pose(self, place: Place, cyclic: Place) -> Pose:
        (sine, cosine), (eta, y) = place, cyclic
        zero, one = jnp.zeros_like(sine), jnp.ones_like(sine)
        axes = (cosine, zero, sine), (zero, one, zero), (-sine, zero, cosine)
        return Pose(axes, (self.radius * sine, y, -self.radius * cosine), eta)


class SphereFrame(AbstractRoundFrame):
    """A sphere; the frame is carried parallel to itself, so no place is singular.

    The place is the vertical z seen in the frame; `cyclic` adds the horizontal x axis seen in it.
    """

    is_curved_along_t2: ClassVar[bool] = True
    lengths: ClassVar[tuple[bool, ...]] = (False, False, False)

    def start(self, foot: Vector, along_eta: bool = False) -> tuple[Place, Place]:
        n = scale(-self.side / jnp.sqrt(dot(foot, foot)), foot)
        t1, t2 = start_tangents(n, along_eta)
        return (t1[2], t2[2], n[2]), (t1[0], t2[0], n[0])

    def cyclic_rate(self, cyclic: Place, velocity: Tangent, frame_rate: Tangent) -> Place:
        return rate_in_frame(cyclic, frame_rate)

    def pose(self, place: Place, cyclic: Place) -> Pose:
        y = cross(place, cyclic)
        t1, t2, n = zip(cyclic, y, place, strict=True)
        angle = jnp.arctan2(planar_length(place[0], place[1]), self.side * place[2])
        return Pose((t1, t2, n), scale(-self.radius, n), angle)


def start_tangents(normal: Vector, along_eta: bool) -> tuple[Vector, Vector]:
    """The vectors t1 and t2 of a start: t1 along growing eta, or the projection of the x axis."""
    if not along_eta:
        return tangents(normal)
    t1 = (normal[2], jnp.zeros_like(normal[1]), -normal[0])
    return t1, cross(normal, t1)


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
    surface: AbstractSurface, side: float, distance: Component, pull: Component, carried: bool = False
) -> AbstractFrame:
    """The frame of a ball on a surface: the surface's own if it has one, else a `CarriedFrame`.

    **Arguments:** as for `CarriedFrame`; `carried`: whether to use a `CarriedFrame` for every surface.
    """
    up = surface.up
    if isinstance(surface, Plane) and not carried:
        return PlaneFrame(distance, None if surface.tilt is None else (up[0], up[2]))
    if isinstance(surface, Cylinder | Sphere) and not carried:
        kind = CylinderFrame if isinstance(surface, Cylinder) else SphereFrame
        return kind(-side * surface.radius - distance, distance, -side)
    # The vertical is computed once: a tilted plane stores its tilt as an angle, and no step should compute the sine.
    return CarriedFrame(surface=surface, distance=distance, pull=pull, up=up, side=side)


class CarriedFrame(AbstractFrame):
    """A frame that is carried along any surface.

    - `surface`: the surface that the ball touches; `side`: 1 if the ball is on the side of the surface's normal, else
      -1.
    - `distance`: R [m].
    - `pull`: rate [1/s] at which the foot is pulled back to the surface if round-off and step errors move it off.
    - `up`: the upward vertical in the surface's axes.
    """

    lengths: ClassVar[tuple[bool, ...]] = (True, True, True, False, False, False)

    surface: AbstractSurface
    distance: Float[Array, "..."]
    pull: Float[Array, "..."]
    up: Vector
    side: float = eqx.field(static=True)

    def start(self, foot: Vector, along_eta: bool = False) -> tuple[Place, Place]:
        foot = tuple(jnp.broadcast_arrays(*(0.0 if x is None else x for x in foot)))
        follows_eta = isinstance(self.surface, Cylinder) or (along_eta and isinstance(self.surface, Sphere))
        return (*foot, *start_tangents(self.normal(foot), follows_eta)[0]), ()

    def normal(self, foot: Vector) -> Vector:
        """The normal n at a foot, in the surface's axes."""
        normal = scale(self.side, self.surface.normal(foot))
        return tuple(jnp.broadcast_to(0.0 if x is None else x, jnp.shape(foot[0])) for x in normal)

    def frame_motion(self, place: Place, velocity: Tangent, radii: TangentOperator | None = None) -> FrameMotion:
        foot, zero = place[:3], jnp.zeros_like(place[0])
        t1, t2, n = self.own_axes(place)
        bending = scale(-self.side, self.surface.bending(foot, t1, t2))
        shape = stored(*(zero if S is None else S for S in bending))
        # The distance R is the radius of the ball that touches.
        radii = (self.distance, None, self.distance) if radii is None else radii
        foot_velocity, frame_rate, room = contact_velocity(shape, radii, velocity)
        o1, o2, *up = stored(*frame_rate, *(dot(axis, self.up) for axis in (t1, t2, n)))
        pull_back = -self.pull * self.side * self.surface.offset(foot)
        carried = sum_vectors(scale(foot_velocity[0], t1), scale(foot_velocity[1], t2), scale(pull_back, n))
        return FrameMotion((o1, o2), tuple(up), (*carried, *scale(o1, n)), room, foot_velocity)

    def own_axes(self, place: Place) -> tuple[Vector, Vector, Vector]:
        """The vectors t1, t2 and n in the surface's axes."""
        # Stored, because otherwise each of the values that need them, and each of their derivatives, would compute them again.
        n = stored(*self.normal(place[:3]))
        # If the first tangent has drifted, only its direction along the surface counts.
        t1 = stored(*unit(difference(place[3:], scale(dot(n, place[3:]), n))))
        return t1, cross(n, t1), n

    def height(self, place: Place) -> Component:
        return self.surface.elevation(place[:3]) + self.distance * dot(self.normal(place[:3]), self.up)

    def vertical(self, place: Place) -> Vector:
        # Without the curvature, which the motion of the frame needs.
        return tuple(dot(axis, self.up) for axis in self.own_axes(place))

    def pose(self, place: Place, cyclic: Place) -> Pose:
        """Where the frame is; the angle is eta in the surface's convention, or the slope of the ground if no coordinate of
        the surface is an angle."""
        foot, names = place[:3], [name for name, _ in self.surface.coordinates]
        axes = self.own_axes(place)
        if "eta" in names:
            eta = self.surface.place_at(foot)[names.index("eta")]
            angle = eta + 0.5 * jnp.pi if names[0] == "mu" else eta
        else:
            t1_up, t2_up, n_up = (dot(axis, self.up) for axis in axes)
            angle = jnp.arctan2(planar_length(t1_up, t2_up), n_up)
        t1, t2, n = map(self.surface.in_fixed_frame, axes)
        centre = sum_vectors(foot, scale(self.distance, axes[2]))
        return Pose((t1, t2, n), self.surface.in_fixed_frame(centre), angle)
