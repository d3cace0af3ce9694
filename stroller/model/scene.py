"""The scene: vehicle, ground, friction and gravity; launches, and rides as problems."""

from collections.abc import Iterator
from typing import Any, ClassVar, TypeAlias

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from nonholonomic.geometry import AbstractQuadric, AbstractSurface, Plane, Sphere, Torus, stacked
from nonholonomic.geometry.surface import as_surface
from nonholonomic.integration import AbstractProblem, Jumps
from nonholonomic.parameters import as_one
from nonholonomic.text import is_array, shown
from nonholonomic.validation import Bound, Bounded, Converted, Usual, as_number, is_traced, require_all, require_kind

from ..friction import AbstractFriction, Frictionless, as_law
from .dynamics import Dynamics, State, Stroller
from .input import Input, PerRide

# Launches: how a ride starts.


def as_numbers(value: Any) -> Any:
    """A sequence of numbers as a tuple of arrays; anything else stays unchanged, for later checks."""
    try:
        return tuple(as_number(number) for number in tuple(value))
    except TypeError:
        return value


#: Largest usual angles [rad] of a recording: a front wheel that turns by half a turn, and a heading after two turns.
USUAL = {"steering": np.pi, "heading": 4.0 * np.pi}

#: Angles that are greater may be in degrees, and are wrong beyond a turn.
STEERING, HEADING = {"usual": Usual(np.pi, turns=1)}, {"usual": Usual(2.0 * np.pi, turns=1)}

#: Speeds above 60 m/s suggest kilometres per hour. Gravity may be zero.
SPEED, GRAVITY = {"usual": Usual(60.0, {"km/h": 1.0 / 3.6})}, Bound.GRAVITY | Bound.NOT_NEGATIVE


def as_place(value: Any, name: str = "place", counts: tuple = (2, 3), single: bool = False) -> tuple[Converted, ...]:
    """Two or three numbers, or `single` ones, as a tuple of arrays; raises `ValueError` for anything else."""
    numbers = as_numbers(value)
    if is_array(value) and np.shape(value)[1:] == (1,):
        raise ValueError(f"{name} is an array of shape {np.shape(value)} and must be a pair of numbers: flatten it")
    if not isinstance(numbers, tuple) or len(numbers) not in counts or (single and any(map(np.ndim, numbers))):
        raise ValueError(f"{name} = {shown(numbers)} must be a pair of numbers{', or (x, y, z) [m]' * (3 in counts)}")
    return numbers


class Launch(Bounded):
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
    heading: Float[Array, "..."] = eqx.field(converter=as_number, metadata=HEADING)
    speed: Float[Array, "..."] = eqx.field(converter=as_number, metadata=SPEED)
    steering: Float[Array, "..."] = eqx.field(converter=as_number, default=0.0, metadata=STEERING)
    steering_rate: Float[Array, "..."] = eqx.field(converter=as_number, default=0.0)


# The scene: vehicle, ground, friction and gravity.

#: The default side of a closed surface.
DRIVES = "outside"
FORKS = {"relative": None, "absolute": 1.0}
HEADINGS = ("intrinsic", "projected")

#: Cosine of the steering angle, or of the slope, below which a start cannot be distinguished from a right angle.
RIGHT_ANGLE = 1e-9


#: A condition, in JAX for traced numbers.
Condition: TypeAlias = Bool[Array | np.ndarray, "..."] | np.bool_ | bool


class Scene(Bounded):
    """A stroller on a ground.

    Every number in it is a leaf of a pytree: you can sweep, trace and differentiate it.

    **Arguments:**

    - `body`: a `Stroller`.
    - `surface`: the ground: `Plane(tilt)`, `Cylinder(radius)`, `Sphere(radius)`, `Spheroid(equatorial, polar)`,
      `Torus(ring, tube)`, `Paraboloid(p)`, `Graph(height)` or `Implicit(function)`.
    - `friction`: `Frictionless()`, `Damping(rolling, front, scrub, steering)` or
      `RollingResistance(coefficient, speed)`.
    - `gravity`: acceleration of free fall [m/s^2], at least 0.
    - `side`: "outside" (the default) or "inside" of a cylinder, sphere, spheroid or torus; "above" a plane, paraboloid
      or graph; or the "positive" side of an implicit surface.
    - `fork`: "relative" if the fork's inertia resists only the steering rate phi', "absolute" if it resists the whole
      rate phi' + Omega about the steering axis, as in a rigid fork.
    - `heading`: "intrinsic", or "projected" to reproduce the paper on a plane, sphere or spheroid, which constrains the
      horizontal projection of the velocities (`stroller.md`, section 3, explains why this is not the default).

    **Raises:** `ValueError` if a part is of the wrong kind, a word is unknown, a number is out of range, or the diameter of a
    sphere, spheroid or torus is smaller than the wheelbase. Along a cylinder's axis, there is room for both axles.

    **Example:**

    ```
    >>> import stroller
    >>> body = stroller.Stroller(mass=12.0, wheelbase=0.7, inertia=1.5, steering_inertia=0.05)
    >>> scene = stroller.Scene(body, friction=stroller.Damping(2.0, 1.0, 0.2, 0.05))
    >>> print(scene)
    Scene
      body      Stroller(mass=12 kg, wheelbase=0.7 m, inertia=1.5 kg m², steering_inertia=0.05 kg m²)
      surface   Plane()
      friction  Damping(rolling=2 N s/m, front=1 N s/m, scrub=0.2 N m s, steering=0.05 N m s)
      gravity   9.81 m/s²
      fork      'relative'
      heading   'intrinsic'

    ```
    """

    units: ClassVar[dict[str, str]] = {"gravity": "m s-2"}

    body: Stroller
    surface: AbstractSurface = eqx.field(converter=as_surface, default=Plane())
    friction: AbstractFriction = eqx.field(converter=as_law, default=Frictionless())
    gravity: Float[Array, "..."] = eqx.field(converter=as_number, default=9.81, metadata=GRAVITY)
    side: str | None = eqx.field(static=True, default=None)
    fork: str = eqx.field(static=True, default="relative")
    heading: str = eqx.field(static=True, default="intrinsic")

    def __check_init__(self):
        require_kind(self.body, "body", Stroller)
        require_kind(self.surface, "surface", AbstractSurface, ", such as stroller.Plane() or stroller.Sphere(10.0)")
        require_kind(self.friction, "friction", AbstractFriction, " law, such as stroller.Damping(rolling=2.0)")
        for name, words in (("fork", tuple(FORKS)), ("heading", HEADINGS)):
            if (word := getattr(self, name)) not in words:
                raise ValueError(f"{name} = {shown(word)} must be one of {', '.join(map(repr, words))}")
        self.surface.sign(self.side, DRIVES)
        if not isinstance(self.surface, Plane) and self.body.centre is not None:
            raise ValueError(f"centre = {shown(self.body.centre)} must be 0.0 on curved ground, where it is not exact")
        if self.heading == "projected" and not isinstance(self.surface, Plane | AbstractQuadric):
            raise ValueError(f"heading = 'projected' must be 'intrinsic' on a {type(self.surface).__name__}")

    def bounds(self) -> Iterator[Bound]:
        yield from super().bounds()
        surface, half = self.surface, 0.5 * self.body.wheelbase
        why = "half the wheelbase, as both axles touch the surface"
        if isinstance(surface, Sphere):
            yield Bound(surface.radius, "surface radius", at_least=half, why=why)
        elif isinstance(surface, AbstractQuadric):
            yield Bound(jnp.maximum(*surface.semi_axes), "greater semi-axis of the surface", at_least=half, why=why)
        elif isinstance(surface, Torus):
            yield Bound(surface.ring + surface.tube, "surface ring + tube", at_least=half, why=why)

    @property
    def dynamics(self) -> Dynamics:
        """The equations of motion for the scene's ground, side, fork and heading."""
        return Dynamics(
            body=self.body,
            surface=self.surface,
            friction=self.friction,
            gravity=self.gravity,
            up=self.surface.up,
            side=self.surface.sign(self.side, DRIVES),
            projected=self.heading == "projected",
            absolute=FORKS[self.fork],
        )

    def check(self, launch: Launch) -> None:
        """Raise `ValueError` if the scene cannot start with the launch."""
        require_kind(launch, "launch", Launch)
        require_all(self.surface.place_bounds(launch.place, self.body.wheelbase))
        sideways, on_equator = self.stuck(launch)
        if not is_traced(sideways) and np.any(sideways):
            raise ValueError(
                f"steering = {shown(launch.steering)} must differ from a right angle for speed = {shown(launch.speed)}: "
                "the rear axle cannot move while the front wheel is at a right angle"
            )
        if not is_traced(on_equator) and np.any(on_equator):
            raise ValueError(
                f"place[1] = {shown(launch.place[1])} must differ from 0 for heading = 'projected': on the equator, motion "
                "along the ground has no horizontal speed, and the constraints may lose rank"
            )

    def stuck(self, launch: Launch) -> tuple[Condition, Condition]:
        """Whether a launch has a speed although its front wheel is at a right angle, and whether it is on the equator with a
        projected heading; concrete values for a concrete launch."""
        steering, speed, last = launch.steering, launch.speed, launch.place[-1]
        xp = jnp if is_traced(steering) or is_traced(speed) else np
        sideways = (xp.abs(xp.cos(xp.asarray(steering))) < RIGHT_ANGLE) & (xp.asarray(speed) != 0.0)
        if self.heading != "projected" or not isinstance(self.surface, AbstractQuadric):
            return sideways, False
        polar = self.surface.semi_axes[1]
        xp = jnp if is_traced(last) or is_traced(polar) else np
        sine = xp.sin(xp.asarray(last)) if len(launch.place) == 2 else xp.asarray(last) / xp.asarray(polar)
        return sideways, xp.abs(sine) < RIGHT_ANGLE

    def state(self, launch: Launch, driven: bool = False) -> State:
        """The state at the start of a run (see `dynamics.py` for its components).

        **Arguments:**

        - `launch`: a `Launch` whose numbers, like the scene's, are scalars or one per lane; or a list of launches.
        - `driven`: whether there is an input, whose work is then part of the state.

        **Returns:** an array (components, ...) in SI units.
        """
        launch, dynamics = as_one(launch, "launch", Launch), self.dynamics
        position, heading = dynamics.pose(launch.place, launch.heading)
        _, _, lead = dynamics.direction(heading, self.surface.normal(position))
        wheel = launch.speed / (jnp.cos(launch.steering) * lead)
        works = 2 * driven + self.friction.dissipates
        return dynamics.state(position, heading, launch.steering, launch.steering_rate, wheel, works)

    def scales(self, launch: Launch, driven: bool = False) -> State:
        """Scales of absolute errors of the state, component by component.

        Positions are measured in wheelbases, directions and angles in units of 1, other components in units of the
        launch's speed or of the speed of a fall through a wheelbase, whichever is greater.

        **Arguments:** as for `state`. **Returns:** an array (components, ...) in SI units.
        """
        launch, body = as_one(launch, "launch", Launch), self.body
        one = jnp.ones_like(self.state(launch, driven)[0])
        rate = jnp.sqrt(self.gravity / body.wheelbase) + jnp.abs(launch.steering_rate) + 1e-3
        rate = rate + jnp.abs(launch.speed) / body.wheelbase
        speed = rate * body.wheelbase
        places, headings = self.surface.axes, self.dynamics.pose_size - self.surface.axes
        motion = (one, jnp.sqrt(body.mass) * speed, rate, one, one)
        work_components = (body.mass * speed**2,) * (2 * driven + self.friction.dissipates)
        return stacked((*(body.wheelbase,) * places, *(one,) * headings, *motion, *work_components), one[None])

    def energy(self, state: State) -> Float[Array, "..."]:
        """Kinetic and potential energy [J] at a state."""
        return self.dynamics.energy(state)

    def work(self, state: State) -> Float[Array, "..."]:
        """Work [J] done on the stroller so far by its inputs and by friction; negative if they took energy."""
        return jnp.sum(state[self.dynamics.pose_size + 5 :], axis=0)

    def contact(self, state: State) -> Float[Array, "..."]:
        """Normal force [N] of the ground on the stroller; negative where the ground would have to pull."""
        return self.dynamics.contact(state)


# Rides as problems.

#: Reduced mass, relative to its largest value, below which the constraints count as having lost rank.
RANK_LOST = 1e-8

#: Largest pull on the ground, relative to the weight, that counts as round-off.
CONTACT_ROUND_OFF = 1e-12


class RideProblem(AbstractProblem):
    """One ride, or the rides of many cells. If `watched`, the event is that the ground would have to pull; if
    `guarded`, a ride ends when the constraints lose rank. `press`: a force [N] that measures the normal force.
    """

    dynamics: Dynamics
    input: Input | None
    states: Float[Array, "components *cells"]
    scales: Float[Array, "components *cells"]
    press: Float[Array, "..."]
    watched: bool = eqx.field(static=True)
    guarded: bool = eqx.field(static=True)
    jump_times: Float[Array, "jumps *cells"] | None = None

    @property
    def fits_one_kernel(self) -> bool:
        return not isinstance(self.input, PerRide) or self.input.by_elements

    def start(self) -> tuple[Float[Array, "components *cells"], Float[Array, "components *cells"]]:
        return self.states, self.scales

    def field(self, time: Float[Array, "..."], state: State) -> State:
        return self.dynamics.field(time, state, self.input)

    def event_function(self, state: State) -> Float[Array, "..."] | None:
        return self.dynamics.contact(state) / self.press + CONTACT_ROUND_OFF if self.watched else None

    def crossing_along(self, state: State, rate: State) -> Float[Array, "..."] | None:
        return self.dynamics.contact(state, rate) / self.press + CONTACT_ROUND_OFF if self.watched else None

    def domain_margin(self, time: Float[Array, "..."], state: State) -> Float[Array, "..."] | None:
        return self.dynamics.rank(state) / RANK_LOST - 1.0 if self.guarded else None

    def jumps(self, time: Float[Array, "..."], state: State) -> Jumps | None:
        return None if self.jump_times is None else Jumps.at(self.jump_times)
