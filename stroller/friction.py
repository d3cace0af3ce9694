"""The friction laws of the wheels and of the fork, along the velocities that the constraints allow. Each law is a class; write
your own as a subclass of `AbstractFriction`."""

import abc
from typing import ClassVar, NamedTuple, TypeVar

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from nonholonomic.compilation.components import held, map_methods
from nonholonomic.compilation.xla_cpu import greatest
from nonholonomic.geometry import Component
from nonholonomic.validation import Bound, Bounded, as_number

#: A law, or a value that the checks of a scene reject.
Other = TypeVar("Other")


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

    def __init_subclass__(cls, **options: object):
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


def as_law(law: Other) -> Other:
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
