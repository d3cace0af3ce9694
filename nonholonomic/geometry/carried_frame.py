"""The moving frame of a ball on any smooth surface, without coordinate singularities, and the choice of frame for a
surface.

The place consists of the foot, where the ball touches the surface, and the first tangent, both in the surface's axes.
The surface gives its normal n and the rate n' = -S_a q' for a velocity q' along the surface. The centre is at O = q + R
n, so its velocity is V = (1 - R S_a) q', and with S = S_a (1 - R S_a)^-1 the rate is n' = -S V (`tippe.md`, section 2
(iv)). The ball fits while no principal curvature reaches 1/R.
"""

from collections.abc import Iterator

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float

from ..compilation.xla_cpu import stored
from ..validation import Bound, as_number
from .cylinder import Cylinder
from .frames import (
    AbstractFrame,
    CylinderFrame,
    Fixed,
    FrameMotion,
    Place,
    PlaneFrame,
    SphereFrame,
    Tangent,
    TangentOperator,
    along,
    contact_velocity,
)
from .planar_length import planar_length
from .plane import Plane
from .quadric import Sphere
from .surface import AbstractSurface
from .torus import Torus
from .vector import Component, Vector, cross, dot, scale, sum_vectors, tangents, vector_of


def place_named(surface: AbstractSurface, place: Place) -> Place:
    """Convert a place whose eta is measured from the lowest point of a closed surface to a place for `surface.chart`.

    **Arguments:** `place`: numbers named by `surface.coordinates`, or (x, y, z).
    """
    if len(place) == 2 and surface.coordinates[0][0] == "mu":
        return (place[0], place[1] - 0.5 * jnp.pi)
    return place


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
        return kind(-side * surface.radius - distance, distance, side < 0.0)
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

    def at_foot(self, foot: Fixed) -> tuple[Place, Place]:
        return self._start(foot, along_eta=isinstance(self.surface, Cylinder))

    def _start(self, foot: Fixed, along_eta: bool) -> tuple[Place, Place]:
        """The frame at a foot. `along_eta`: whether t1 points along growing eta inside, as in `CylinderFrame`; the
        projection of the x axis reverses its direction at eta = pi/2."""
        foot = vector_of(jnp.broadcast_arrays(*(0.0 if x is None else x for x in foot)))
        normal = self.normal(foot)
        t1 = (normal[2], jnp.zeros_like(normal[1]), -normal[0]) if along_eta else tangents(normal)[0]
        return (*foot, *t1), ()

    def normal(self, foot: Fixed) -> Fixed:
        """The normal n at a foot, in the surface's axes."""
        normal = scale(self.side, self.surface.normal(foot))
        return vector_of(jnp.broadcast_to(0.0 if x is None else x, jnp.shape(foot[0])) for x in normal)

    def place_scales(self, size: Component) -> tuple[Component, ...]:
        return (size,) * 3 + (1.0,) * 3

    def frame_motion(self, place: Place, velocity: Tangent) -> FrameMotion:
        axes, (S11, S12, S22) = self._bent(place)
        R = self.distance
        A11, A12, A22 = 1.0 - R * S11, -R * S12, 1.0 - R * S22
        determinant = A11 * A22 - A12 * A12
        q1 = (A22 * velocity[0] - A12 * velocity[1]) / determinant
        q2 = (A11 * velocity[1] - A12 * velocity[0]) / determinant
        # Both are positive if both values 1 - R k are; when the first of these vanishes, so does the determinant.
        room = jnp.minimum(determinant, 0.5 * (A11 + A22))
        return self._moved(place[:3], axes, (q1, q2), (S11 * q1 + S12 * q2, S12 * q1 + S22 * q2), room)

    def convex_motion(self, place: Place, velocity: Tangent, radii: TangentOperator) -> tuple[FrameMotion, Tangent]:
        axes, shape = self._bent(place)
        foot_velocity, frame_rate, room = contact_velocity(shape, radii, velocity)
        return self._moved(place[:3], axes, foot_velocity, frame_rate, room), foot_velocity

    def _bent(self, place: Place) -> tuple[tuple[Fixed, Fixed, Fixed], TangentOperator]:
        """The vectors t1, t2 and n in the surface's axes, and the shape operator of the arena."""
        # Stored, because otherwise each of the values below, and each of their derivatives, would compute these again.
        n = stored(*self.normal(place[:3]))
        # If the first tangent has drifted, only its direction along the surface counts.
        t1 = stored(*along(n, place[3:])[0])
        t2 = cross(n, t1)
        return (t1, t2, n), stored(*self._shape(place[:3], t1, t2))

    def _moved(
        self, foot: Fixed, axes: tuple[Fixed, Fixed, Fixed], velocity: Tangent, frame_rate: Tangent, room: Component
    ) -> FrameMotion:
        """The motion of the frame. **Arguments:** `velocity`: velocity of the foot, along the axes."""
        t1, t2, n = axes
        o1, o2, *up = stored(*frame_rate, *self._seen(t1, t2, n))
        pull_back = -self.pull * self.side * self.surface.offset(foot)
        carried = sum_vectors(scale(velocity[0], t1), scale(velocity[1], t2), scale(pull_back, n))
        return FrameMotion((o1, o2), vector_of(up), (*carried, *scale(o1, n)), room)

    def _shape(self, foot: Fixed, t1: Fixed, t2: Fixed) -> TangentOperator:
        """The shape operator of the arena, n' = -S_a q', as (S11, S12, S22)."""
        bending, zero = scale(-self.side, self.surface.bending(foot, t1, t2)), jnp.zeros_like(foot[0])
        return vector_of(zero if S is None else S for S in bending)

    def _seen(self, *axes: Fixed) -> Vector:
        """The upward vertical in the frame."""
        return vector_of(dot(axis, self.up) for axis in axes)

    def own_axes(self, place: Place) -> tuple[Fixed, Fixed, Fixed]:
        """The vectors t1, t2 and n in the surface's axes."""
        n = self.normal(place[:3])
        return (*along(n, place[3:]), n)

    def vertical(self, place: Place) -> Vector:
        return self._seen(*self.own_axes(place))

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

    def axes(self, place: Place, cyclic: Place) -> tuple[Fixed, Fixed, Fixed]:
        return vector_of(self.surface.in_fixed_frame(axis) for axis in self.own_axes(place))

    def position(self, place: Place, cyclic: Place) -> Fixed:
        centre = sum_vectors(place[:3], scale(self.distance, self.normal(place[:3])))
        return self.surface.in_fixed_frame(centre)
