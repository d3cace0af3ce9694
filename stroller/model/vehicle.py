"""The vehicle: frame and wheels, friction, heading and launch."""

import abc
import math
from collections.abc import Iterator
from typing import Any, ClassVar, NamedTuple

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from nonholonomic.compilation.components import held, map_methods
from nonholonomic.compilation.xla_cpu import greatest
from nonholonomic.geometry import (
    AbstractSurface,
    Component,
    Vector,
    cross,
    dot,
    multiply,
    none_if_zero,
    scale,
    subtract,
    sum_vectors,
)
from nonholonomic.parameters import as_one
from nonholonomic.text import shown
from nonholonomic.validation import IN_DEGREES, Bound, Bounded, Converted, as_number, largest


def as_numbers(value: Any) -> Any:
    """A sequence of numbers as a tuple of arrays; anything else stays unchanged, for later checks."""
    try:
        return tuple(as_number(number) for number in tuple(value))
    except TypeError:
        return value


# The body: a rigid frame on two rear wheels, with one front wheel in a fork that steers.

#: A wheelbase above this [m], more than any vehicle's, suggests millimetres or centimetres.
LONGEST = 20.0


class Stroller(Bounded):
    """A stroller: wheels without mass or width, the steering axis through the front wheel's contact point.

    **Arguments:**

    - `mass`: mass [kg], positive.
    - `wheelbase`: distance l [m] from the middle of the rear axle to the front contact point, positive.
    - `inertia`: moment of inertia J [kg m^2] in yaw about the middle of the rear axle, positive.
    - `steering_inertia`: moment of inertia J_f [kg m^2] of the fork about the steering axis, positive.
    - `steering_spring`: stiffness [N m/rad] of a spring that pulls the fork straight, at least 0.
    - `centre`: distance b [m] of the centre of mass ahead of the rear axle, in [0, `wheelbase`], which loads the front
      wheel. `inertia` must be at least `mass` b^2. The equations hold for b > 0 on a plane.

    **Raises:** `ValueError` for numbers outside these ranges.

    **Example:**

    ```
    >>> import stroller
    >>> stroller.Stroller(mass=12.0, wheelbase=0.7, inertia=1.5, steering_inertia=0.05)
    Stroller(mass=12 kg, wheelbase=0.7 m, inertia=1.5 kg m², steering_inertia=0.05 kg m²)

    ```
    """

    units: ClassVar[dict[str, str]] = {"mass": "kg", "wheelbase": "m", "inertia": "kg m2", "steering_inertia": "kg m2"}
    units |= {"steering_spring": "N m rad-1", "centre": "m"}

    mass: Float[Array, "..."] = eqx.field(converter=as_number, metadata=Bound.POSITIVE)
    wheelbase: Float[Array, "..."] = eqx.field(converter=as_number, metadata=Bound.POSITIVE)
    inertia: Float[Array, "..."] = eqx.field(converter=as_number, metadata=Bound.POSITIVE)
    steering_inertia: Float[Array, "..."] = eqx.field(converter=as_number, metadata=Bound.POSITIVE)
    steering_spring: Float[Array, "..."] | None = eqx.field(
        converter=none_if_zero, default=None, metadata=Bound.NOT_NEGATIVE
    )
    centre: Float[Array, "..."] | None = eqx.field(converter=none_if_zero, default=None, metadata=Bound.NOT_NEGATIVE)

    def suspicion(self) -> str | None:
        longest = largest(self.wheelbase)
        if longest <= LONGEST:
            return None
        unit, metres = ("mm", longest / 1e3) if longest > 10.0 * LONGEST else ("cm", longest / 1e2)
        return f"wheelbase = {longest:g} m is long: was it in {unit}? {longest:g} {unit} are {metres:g} m"

    def bounds(self) -> Iterator[Bound]:
        yield from super().bounds()
        if self.centre is not None:
            yield Bound(self.centre, "centre", at_most=self.wheelbase, why="the wheelbase")
            min_inertia = self.mass * self.centre**2
            yield Bound(
                self.inertia, "inertia", at_least=min_inertia, why="mass centre^2, as it is about the rear axle"
            )


# Friction of the wheels and of the fork, along the velocities that the constraints allow. Each law is a class.


class WheelMotion(NamedTuple):
    """The motion of the stroller as friction laws use it: rolling speeds of the wheels [m/s], rates [rad/s], loads [N]
    on the axles.

    A load is `None` where it is exactly zero, as on the front axle if the centre of mass is above the rear axle.
    """

    rear_speed: Float[Array, "..."]
    front_speed: Float[Array, "..."]
    yaw_rate: Float[Array, "..."]
    steering_rate: Float[Array, "..."]
    rear_load: Component
    front_load: Component


class Drag(NamedTuple):
    """The effect of friction: forces [N] along the wheels, torques [N m] about the normal and the steering axis."""

    rear: Component = None
    front: Component = None
    yaw: Component = None
    steering: Component = None


class AbstractFriction(Bounded):
    """A friction law.

    **Example:**

    ```
    >>> import stroller
    >>> from stroller.friction import Drag
    >>> class AirDrag(stroller.AbstractFriction):
    ...     def drag(self, wheels):
    ...         return Drag(rear=-0.3 * wheels.rear_speed * abs(wheels.rear_speed))
    ...
    >>> body = stroller.Stroller(mass=12.0, wheelbase=0.7, inertia=1.5, steering_inertia=0.05)
    >>> print(stroller.Scene(body, friction=AirDrag()).friction)
    AirDrag()

    ```
    """

    def __init_subclass__(cls, **options: Any):
        super().__init_subclass__(**options)
        map_methods(cls, ["drag"])

    #: Whether the law can dissipate energy; if not, its work is not recorded.
    dissipates: ClassVar[bool] = True

    @abc.abstractmethod
    def drag(self, wheels: WheelMotion) -> Drag:
        """Forces and torques of friction.

        **Arguments:**

        - `wheels`: a `WheelMotion`.

        **Returns:** a `Drag`; a component is `None` where it vanishes identically.
        """


def as_law(law: Any) -> Any:
    """A user's law with every number of its arrays as a leaf; anything else unchanged."""
    if not isinstance(law, AbstractFriction):
        return law
    return held(law, lambda law: law.drag(WheelMotion(*(jnp.zeros(()),) * len(WheelMotion._fields))))


class Frictionless(AbstractFriction):
    """No friction: the wheels roll freely and do not slip sideways.

    **Example:**

    ```
    >>> import stroller
    >>> stroller.Frictionless().dissipates
    False

    ```
    """

    dissipates: ClassVar[bool] = False

    def drag(self, wheels: WheelMotion) -> Drag:
        return Drag()


class Damping(AbstractFriction):
    """Viscous damping of two speeds and two angular rates, by a Rayleigh function (`stroller.md`, section 7).

    **Arguments:**

    - `rolling`: coefficient c_v [N s/m] for the speed of the rear wheels, at least 0.
    - `front`: coefficient c_w [N s/m] for the speed of the front wheel, at least 0.
    - `scrub`: coefficient c_O [N m s] for the yaw rate, at least 0.
    - `steering`: coefficient c_s [N m s] for the steering rate, at least 0.

    **Example:**

    ```
    >>> import stroller
    >>> stroller.Damping(rolling=2.0, front=1.0, scrub=0.2, steering=0.05)
    Damping(rolling=2 N s/m, front=1 N s/m, scrub=0.2 N m s, steering=0.05 N m s)

    ```
    """

    units: ClassVar[dict[str, str]] = {"rolling": "N s m-1", "front": "N s m-1", "scrub": "N m s", "steering": "N m s"}

    rolling: Float[Array, "..."] = eqx.field(converter=as_number, metadata=Bound.NOT_NEGATIVE)
    front: Float[Array, "..."] = eqx.field(converter=as_number, default=0.0, metadata=Bound.NOT_NEGATIVE)
    scrub: Float[Array, "..."] = eqx.field(converter=as_number, default=0.0, metadata=Bound.NOT_NEGATIVE)
    steering: Float[Array, "..."] = eqx.field(converter=as_number, default=0.0, metadata=Bound.NOT_NEGATIVE)

    def drag(self, wheels: WheelMotion) -> Drag:
        return Drag(
            rear=-self.rolling * wheels.rear_speed,
            front=-self.front * wheels.front_speed,
            yaw=-self.scrub * wheels.yaw_rate,
            steering=-self.steering * wheels.steering_rate,
        )


class RollingResistance(AbstractFriction):
    """Rolling resistance F = -c N tanh(v / v_s) of each axle under its load N (`stroller.md`, section 7).

    The regularised law creeps: a stroller on a slope too gentle to overcome the resistance does not stop, but keeps
    rolling at a speed of the order of v_s. An axle off the ground has no resistance.

    **Arguments:**

    - `coefficient`: c [1], at least 0.
    - `speed`: v_s [m/s] at which 76 % of the resistance is reached, positive.

    **Example:**

    ```
    >>> import stroller
    >>> law = stroller.RollingResistance(coefficient=0.01, speed=0.05)
    >>> print(f"{law.resistance(100.0, 1.0):.2f} N")
    -1.00 N

    ```
    """

    units: ClassVar[dict[str, str]] = {"coefficient": "1", "speed": "m s-1"}

    coefficient: Float[Array, "..."] = eqx.field(converter=as_number, metadata=Bound.NOT_NEGATIVE)
    speed: Float[Array, "..."] = eqx.field(converter=as_number, metadata=Bound.POSITIVE)

    def drag(self, wheels: WheelMotion) -> Drag:
        return Drag(
            rear=self.resistance(wheels.rear_load, wheels.rear_speed),
            front=self.resistance(wheels.front_load, wheels.front_speed),
        )

    def resistance(self, load: Component, speed: Float[Array, "..."]) -> Component:
        """Force [N] along a wheel with the given load [N] that rolls at the given speed [m/s]."""
        return None if load is None else -self.coefficient * greatest(load, 0.0) * jnp.tanh(speed / self.speed)


VERTICAL: Vector = (None, None, 1.0)


class Heading(eqx.Module):
    """One of two meanings of "the wheels do not slip sideways" on curved ground; on a plane they are equal.

    In both, the rear axle moves with the velocity w cos(phi) d and the heading turns at the rate w nu sin(phi) / l, where w
    is the one free speed of the motion. Vectors are in the ground's axes.

    - Intrinsic: the heading is a unit vector e along the ground that turns about the normal: d = e, nu = 1 (section 4).
    - `projected`: it is a horizontal unit vector h, as in the paper: d = h n_z - z (h.n), nu = n_z (section 3). The velocity
      along d has the horizontal component n_z h, so the paper's speed is w cos(phi) n_z, which passes through zero at the
      equator. Where d = 0 the constraints lose rank.
    """

    projected: bool = eqx.field(static=True)

    def axes(self, ground: AbstractSurface) -> int:
        """Number of components of the heading that do not vanish identically."""
        return 2 if self.projected else ground.axes

    def unit(self, heading: Vector, normal: Vector) -> Vector:
        """The heading, corrected for a drift off the ground or off unit length.

        An exact heading is unchanged, and so is its rate.
        """
        if not self.projected:
            heading = sum_vectors(heading, scale(subtract(None, dot(heading, normal)), normal))
        return scale(1.0 / jnp.sqrt(dot(heading, heading)), heading)

    def direction(self, heading: Vector, normal: Vector, side: float) -> tuple[Vector, Component, Component]:
        """The vector d along the ground, its square d.d, and the factor nu, from the outward normal and the side: 1
        outside, -1 inside."""
        if not self.projected:
            return heading, 1.0, 1.0
        lift = scale(subtract(None, dot(heading, normal)), VERTICAL)
        direction = scale(side, sum_vectors(scale(normal[2], heading), lift))
        return direction, dot(direction, direction), multiply(side, normal[2])

    def rate(self, heading: Vector, normal: Vector, normal_rate: Vector, turn: Component, side: float) -> Vector:
        """Rate [1/s] of a heading that turns at the rate `turn` [rad/s] to the driver's left."""
        if self.projected:
            # The driver's left is to the left as seen from above on either side, as in the paper's equations.
            return cross(scale(turn, VERTICAL), heading)
        yaw = scale(multiply(side, turn), normal)
        return cross(sum_vectors(yaw, cross(normal, normal_rate)), heading)

    def at_angle(self, angle: Float[Array, "..."], east: Vector, north: Vector) -> Vector:
        """The heading at an angle [rad], given the unit vectors of the place."""
        if self.projected:
            return (jnp.cos(angle), jnp.sin(angle), None)
        return sum_vectors(scale(jnp.cos(angle), east), scale(jnp.sin(angle), north))

    def angle(self, heading: Vector, east: Vector, north: Vector) -> Float[Array, "..."]:
        """The angle [rad] of a heading, in (-pi, pi]."""
        if self.projected:
            return jnp.arctan2(heading[1], heading[0])
        return jnp.arctan2(dot(heading, north), dot(heading, east))


# Launches: how a ride starts.


def as_launch(value: Any) -> Any:
    """A list of launches as one `Launch` whose numbers are lists; anything else stays unchanged, for later checks."""
    return as_one(value, "launch", Launch)


#: Largest usual angles [rad]: a front wheel that turns by half a turn, and a heading after two turns.
USUAL = {"steering": math.pi, "heading": 4.0 * math.pi}


def as_place(value: Any) -> tuple[Converted, ...]:
    """Two or three numbers as a tuple of arrays; raises `ValueError` for anything else."""
    numbers = as_numbers(value)
    if not (isinstance(numbers, tuple) and len(numbers) in (2, 3)):
        raise ValueError(f"place = {shown(numbers)} must be a pair of numbers, or (x, y, z) [m]")
    return numbers


class Angled(Bounded):
    """A module whose angles may have been given in degrees."""

    def suspicion(self) -> str | None:
        """The suspicion that an angle, of those that have usual values, is in degrees; `None` if none is. Raises `ValueError`
        for an angle beyond a turn."""
        for name, limit in USUAL.items():
            magnitude = largest(getattr(self, name, None))
            degrees = IN_DEGREES.format(f"{magnitude:g}")
            if magnitude > 2.0 * math.pi:
                raise ValueError(f"{name} = {shown(getattr(self, name))} must be within [-2 pi, 2 pi]{degrees}")
            if magnitude > limit:
                return f"{name} = {magnitude:g} rad is large{degrees}"
        return None


#: Speeds above this [m/s] suggest kilometres per hour.
FASTEST = 60.0


class Launch(Angled):
    """A launch: position of the rear axle, heading, speed and steering.

    **Arguments:**

    - `place`: position on the surface. On a plane, paraboloid or graph, (x, y) [m], which on a tilted plane are
      measured along the plane. On a sphere or spheroid, azimuth and reduced latitude [rad]. On a torus, azimuth and
      angle about the tube [rad]. On a cylinder, distance along the axis [m] and angle from the lowest line [rad]. Any
      surface also accepts (x, y, z) [m] in the fixed frame.
    - `heading`: angle psi [rad] of the heading from the surface's east towards its north: from x towards y on a plane.
      The projected heading of the paper is the angle theta [rad] of its horizontal projection from x towards y.
    - `speed`: speed v [m/s] of the rear axle along the heading, negative in reverse; the horizontal speed where the
      heading is projected.
    - `steering`: angle phi [rad] of the front wheel, positive to the driver's left.
    - `steering_rate`: rate phi' of the steering angle [rad/s].

    **Raises:** `ValueError` for numbers that are not finite, angles beyond 2 pi, or a place that does not have two or three
    numbers.

    **Example:**

    ```
    >>> import stroller
    >>> stroller.Launch(place=(0.0, 0.0), heading=0.3, speed=2.0)
    Launch(place=(0, 0) m or rad, heading=0.3 rad, speed=2 m/s, steering=0 rad, steering_rate=0 rad/s)

    ```
    """

    units: ClassVar[dict[str, str]] = {"place": "m or rad", "heading": "rad", "speed": "m s-1", "steering": "rad"}
    units |= {"steering_rate": "rad s-1"}

    place: tuple[Float[Array, "..."], ...] = eqx.field(converter=as_place)
    heading: Float[Array, "..."] = eqx.field(converter=as_number)
    speed: Float[Array, "..."] = eqx.field(converter=as_number)
    steering: Float[Array, "..."] = eqx.field(converter=as_number, default=0.0)
    steering_rate: Float[Array, "..."] = eqx.field(converter=as_number, default=0.0)

    def suspicion(self) -> str | None:
        fastest = largest(self.speed)
        if fastest > FASTEST:
            return f"speed = {fastest:g} m/s is fast: was it in km/h? {fastest:g} km/h are {fastest / 3.6:.4g} m/s"
        return super().suspicion()
