"""The scene of a ride: the vehicle, its launches, and its equations of motion in the P-form (`stroller.md`, section 5), without
singular angles or tan(phi).

The state, with vectors in the ground's axes, contains the position r of the rear axle, the heading e, the steering
angle phi, the quasi-momentum P = w sqrt(M_w), where w is the speed of the front wheel and M_w its reduced mass, and the
rate sg of the fork: phi', or phi' + Omega for a fork that turns with the frame. The state also contains sin(phi) and
cos(phi), because computing them would take four fifths of the field's time. Only the spring, inputs and outputs need
phi itself, which may exceed pi. The last components are the work [J] done so far by the inputs and by friction, if
there are any.

The energy P^2/2 + J_f sg^2/2 + V is quadratic in the state, with V linear except for the spring, so the implicit
midpoint rule keeps the energy balance and sin^2 + cos^2 exactly. With other solvers, this sum drifts with the errors of
the steps. Only the speed of the front wheel depends on the sum, so `righted` corrects the sum when a state is read, and
the field does not.
"""

from collections.abc import Iterator
from typing import Any, ClassVar, NamedTuple, TypeAlias

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from nonholonomic.geometry import AbstractQuadric, AbstractSurface, Component, Place, Plane, Sphere, Torus, Vector
from nonholonomic.geometry.surface import as_surface
from nonholonomic.geometry.vector import add, cross, dot, multiply, none_if_zero, scale, stacked, subtract, sum_vectors
from nonholonomic.integration import AbstractProblem, Jumps
from nonholonomic.parameters import as_one
from nonholonomic.text import is_array, shown
from nonholonomic.validation import Bound, Bounded, Converted, Usual, as_number, is_traced, require_all, require_kind

from ..friction import AbstractFriction, Drag, Frictionless, WheelMotion, as_law
from .input import Input, Motion, PerRide

State = Float[Array, "components ..."]

#: A number, or one for each of several states.
Number = Float[Array, "..."]

# The body: a rigid frame on two rear wheels, with one front wheel in a fork that steers.

#: The range of a wheelbase [m]; above 20 m, more than any vehicle's, it suggests millimetres or centimetres.
WHEELBASE = Bound.POSITIVE | {"usual": Usual(20.0, {"mm": 1e-3, "cm": 1e-2})}

#: The usual radius of gyration about the rear axle, in wheelbases.
GYRATION = (0.13, 10.0)
ODD = ", as the inertia is usually mass wheelbase^2 / 4: were they exchanged, or not in kg, m and kg m^2?"


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
    wheelbase: Float[Array, "..."] = eqx.field(converter=as_number, metadata=WHEELBASE)
    inertia: Float[Array, "..."] = eqx.field(converter=as_number, metadata=Bound.POSITIVE)
    steering_inertia: Float[Array, "..."] = eqx.field(converter=as_number, metadata=Bound.POSITIVE)
    steering_spring: Float[Array, "..."] | None = eqx.field(
        converter=none_if_zero, default=None, metadata=Bound.NOT_NEGATIVE
    )
    centre: Float[Array, "..."] | None = eqx.field(converter=none_if_zero, default=None, metadata=Bound.NOT_NEGATIVE)

    def suspicion(self) -> str | None:
        question = super().suspicion()
        if question or is_traced(self) or np.ndim(self.mass + self.wheelbase + self.inertia):
            return question
        radius = np.sqrt(np.asarray(self.inertia) / np.asarray(self.mass)) / np.asarray(self.wheelbase)
        is_usual = GYRATION[0] <= radius <= GYRATION[1]
        values = ", ".join(f"{name} = {float(getattr(self, name)):g}" for name in ("mass", "wheelbase", "inertia"))
        return None if is_usual else f"{values} do not fit{ODD}"

    def bounds(self) -> Iterator[Bound]:
        yield from super().bounds()
        if self.centre is not None:
            yield Bound(self.centre, "centre", at_most=self.wheelbase, why="the wheelbase")
            min_inertia = self.mass * self.centre**2
            yield Bound(
                self.inertia, "inertia", at_least=min_inertia, why="mass centre^2, as it is about the rear axle"
            )


# The equations of motion.

VERTICAL: Vector = (None, None, 1.0)


class Geometry(NamedTuple):
    """Position and motion of a state, before any force is computed.

    The rear axle moves along `direction` d; `lead` is the factor nu of the heading, `gauge` 1 / sqrt(M_w), and `sine` and
    `cosine` are those of the steering angle. `loads` [N]: those of the rear and the front axle.
    """

    motion: Motion
    normal: Vector
    normal_rate: Vector
    direction: Vector
    velocity: Vector
    left: Vector
    lead: Component
    gauge: Float[Array, "..."]
    sine: Float[Array, "..."]
    cosine: Float[Array, "..."]
    normal_force: Component
    loads: tuple[Component, Component]


class Power(NamedTuple):
    """Power [W] through each port: of the drive, of the steering torque, and of each kind of friction."""

    drive: Component
    steering: Component
    rear: Component
    front: Component
    yaw: Component
    fork: Component


class Forces(NamedTuple):
    """Drive force [N] and steering torque [N m] of the input, the friction, the total torque [N m] on the fork, and the power
    of each."""

    drive: Component
    torque: Component
    drag: Drag
    fork: Component
    power: Power


class Dynamics(eqx.Module):
    """The equations of motion of a scene, for its ground, side, fork and heading. Vectors are in the ground's axes.

    `up` is the upward vertical; `side` is 1 outside and -1 inside; `absolute` is 1 if the fork turns with the frame, otherwise
    `None`. "The wheels do not slip sideways" has two meanings on curved ground; on a plane they are equal. In both, the rear
    axle moves with the velocity w cos(phi) d and the heading turns at the rate w nu sin(phi) / l, where w is the one free
    speed of the motion.

    - Intrinsic: the heading is a unit vector e along the ground that turns about the normal: d = e, nu = 1 (section 4).
    - `projected`: it is a horizontal unit vector h, as in the paper: d = h n_z - z (h.n), nu = n_z (section 3). The velocity
      along d has the horizontal component n_z h, so the paper's speed is w cos(phi) n_z, which passes through zero at the
      equator. Where d = 0 the constraints lose rank.
    """

    body: Stroller
    surface: AbstractSurface
    friction: AbstractFriction
    gravity: Float[Array, "..."]
    up: Vector
    side: float = eqx.field(static=True)
    projected: bool = eqx.field(static=True)
    absolute: float | None = eqx.field(static=True)

    @property
    def pose_size(self) -> int:
        """Number of components of a position and a heading that do not vanish identically."""
        return self.surface.axes + (2 if self.projected else self.surface.axes)

    def pose(self, place: Place, angle: Float[Array, "..."]) -> tuple[Vector, Vector]:
        """The position of a place, and the heading at an angle [rad] there."""
        position, east, north = self.surface.chart(place)
        cosine, sine = jnp.cos(angle), jnp.sin(angle)
        if self.projected:
            return position, (cosine, sine, None)
        return position, sum_vectors(scale(cosine, east), scale(sine, north))

    def angle(self, position: Vector, heading: Vector) -> Float[Array, "..."]:
        """The angle [rad] of a heading at a position, in (-pi, pi]."""
        if self.projected:
            return jnp.arctan2(heading[1], heading[0])
        _, east, north = self.surface.chart(self.surface.place_at(position))
        return jnp.arctan2(dot(heading, north), dot(heading, east))

    def direction(self, heading: Vector, normal: Vector) -> tuple[Vector, Component, Component]:
        """The vector d along the ground, its square d.d, and the factor nu, from the outward normal."""
        if not self.projected:
            return heading, 1.0, 1.0
        lift = scale(subtract(None, dot(heading, normal)), VERTICAL)
        direction = scale(self.side, sum_vectors(scale(normal[2], heading), lift))
        return direction, dot(direction, direction), multiply(self.side, normal[2])

    def unpack(self, state: State) -> tuple[Vector, Vector, Float[Array, "others ..."]]:
        """Position, heading and the other components of a state."""
        place, end = self.surface.axes, self.pose_size
        return padded(state[:place]), padded(state[place:end]), state[end:]

    def state(
        self, position: Vector, heading: Vector, steering: Number, steering_rate: Number, wheel: Number, works: int = 0
    ) -> State:
        """The state of a motion.

        **Arguments:** `position` [m], `heading`: vectors in the ground's axes; `steering` [rad], `steering_rate` [rad/s];
        `wheel`: the free speed w [m/s], that of the front wheel if the heading is intrinsic; `works`: number of work
        components, which are 0.
        """
        sine, cosine = jnp.sin(steering), jnp.cos(steering)
        _, square, lead = self.direction(heading, self.surface.normal(position))
        momentum = wheel * jnp.sqrt(self.inertia(square, lead, sine, cosine))
        fork_rate = steering_rate
        if self.absolute is not None:
            fork_rate = fork_rate + wheel * lead * sine / self.body.wheelbase
        place = self.surface.axes
        vectors = (*position[:place], *heading[: self.pose_size - place])
        start = (*vectors, steering, momentum, fork_rate, sine, cosine)
        example = jnp.broadcast_arrays(*(component for component in start if component is not None))[0]
        return stacked((*start, *(None,) * works), example[None])

    def righted(self, state: State) -> State:
        """The state with sin^2 + cos^2 of the steering angle corrected to 1."""
        first = self.pose_size + 3
        sine, cosine = state[first], state[first + 1]
        unit = state[first : first + 2] * (1.0 / jnp.sqrt(sine * sine + cosine * cosine))
        return jnp.concatenate([state[:first], unit, state[first + 2 :]])

    def inertia(self, square: Component, lead: Component, sine: Component, cosine: Component) -> Component:
        """Reduced mass M_w = m cos^2(phi) d.d + J nu^2 sin^2(phi) / l^2 [kg] of the speed w."""
        arm = multiply(lead, sine, 1.0 / self.body.wheelbase)
        return multiply(self.body.mass, cosine, cosine, square) + self.body.inertia * arm * arm

    def geometry(self, state: State) -> Geometry:
        """Velocities, rates and normal force at a state (components, ...)."""
        body, surface = self.body, self.surface
        position, heading, others = self.unpack(state)
        steering, momentum, fork_rate, sine, cosine = others[:5]
        normal = surface.normal(position)
        # The heading, corrected for a drift off the ground or off unit length; an exact one, and its rate, stay unchanged.
        if not self.projected:
            heading = sum_vectors(heading, scale(subtract(None, dot(heading, normal)), normal))
        heading = scale(1.0 / jnp.sqrt(dot(heading, heading)), heading)
        direction, square, lead = self.direction(heading, normal)
        gauge = 1.0 / jnp.sqrt(self.inertia(square, lead, sine, cosine))
        wheel = momentum * gauge
        velocity = scale(wheel * cosine, direction)
        normal_rate = surface.normal_rate(position, velocity)
        normal_force = self.normal_force(normal, normal_rate, velocity)
        front_speed = multiply(wheel, lead)
        yaw_rate = front_speed * sine / body.wheelbase
        steering_rate = subtract(fork_rate, multiply(self.absolute, yaw_rate))
        front_load = multiply(normal_force, None if body.centre is None else body.centre / body.wheelbase)
        loads = (subtract(normal_force, front_load), front_load)
        motion = Motion(position, heading, steering, front_speed * cosine, front_speed, yaw_rate, steering_rate)
        left = scale(self.side, cross(normal, direction))
        return Geometry(
            motion, normal, normal_rate, direction, velocity, left, lead, gauge, sine, cosine, normal_force, loads
        )

    def normal_force(self, normal: Vector, normal_rate: Vector, velocity: Vector) -> Component:
        """Normal force [N] of the ground, which carries the weight and bends the path."""
        weight = multiply(self.side, self.body.mass * self.gravity, dot(normal, self.up))
        return subtract(weight, multiply(self.side, self.body.mass, dot(normal_rate, velocity)))

    def forces(self, t: Float[Array, "..."], geometry: Geometry, controls: Input | None) -> Forces:
        """The forces of the input, of friction and of the steering spring at a time [s]."""
        motion = geometry.motion
        drive, torque = (None, None) if controls is None else controls(t, motion)
        speeds = (motion.speed, motion.front_speed, motion.yaw_rate, motion.steering_rate)
        drag = self.friction.drag(WheelMotion(*speeds, *geometry.loads))
        spring = multiply(self.body.steering_spring, motion.steering)
        # Of each force and torque, with the speed along it.
        power = Power(*map(multiply, (drive, torque, *drag), (motion.speed, motion.steering_rate, *speeds)))
        return Forces(drive, torque, drag, subtract(add(torque, drag.steering), spring), power)

    def field(self, t: Float[Array, "..."], state: State, controls: Input | None = None) -> State:
        """Rate of change of the state, (components, ...)."""
        body, g, e = self.body, self.geometry(state), self.unpack(state)[1]
        forces = self.forces(t, g, controls)
        drag, torque = forces.drag, forces.fork
        arm = g.sine / body.wheelbase
        weight = body.mass * self.gravity
        # If the centre of mass is ahead of the axle, it swings with the yaw, and its weight has a moment about the
        # normal.
        side_axis = cross(g.normal, e)
        swing = multiply(weight, body.centre, self.side, dot(side_axis, self.up))
        yaw_torque = subtract(drag.yaw, add(multiply(self.absolute, torque), swing))
        pushing = add(multiply(g.cosine, add(forces.drive, drag.rear)), drag.front, multiply(arm, yaw_torque))
        weight_force = multiply(weight, g.cosine, dot(g.direction, self.up))
        momentum_rate = multiply(g.gauge, subtract(multiply(g.lead, pushing), weight_force))
        if self.projected:
            # The driver's left is to the left as seen from above on either side, as in the paper's equations.
            spin = scale(g.motion.yaw_rate, VERTICAL)
        else:
            turn = scale(multiply(self.side, g.motion.yaw_rate), g.normal)
            spin = sum_vectors(turn, cross(g.normal, g.normal_rate))
        heading_rate, power = cross(spin, e), forces.power
        steering_rate, place = g.motion.steering_rate, self.surface.axes
        return stacked(
            (
                *g.velocity[:place],
                *heading_rate[: self.pose_size - place],
                steering_rate,
                momentum_rate,
                multiply(torque, 1.0 / body.steering_inertia),
                multiply(g.cosine, steering_rate),
                multiply(-g.sine, steering_rate),
                *((power.drive, power.steering) if controls is not None else ()),
                *((add(*power[2:]),) if self.friction.dissipates else ()),
            ),
            state,
        )

    def energy(self, state: State) -> Float[Array, "..."]:
        """Energy H = P^2/2 + J_f sg^2/2 + m g z + k phi^2/2 [J], where z is the height of the centre of mass."""
        (r, e, (phi, P, fork_rate, *_)), body = self.unpack(state), self.body
        height = add(self.surface.elevation(r), multiply(body.centre, dot(e, self.up)))
        kinetic = 0.5 * (P * P + body.steering_inertia * fork_rate * fork_rate)
        return add(kinetic, multiply(body.mass * self.gravity, height), multiply(0.5, body.steering_spring, phi, phi))

    def rank(self, state: State) -> Float[Array, "..."]:
        """Reduced mass M_w relative to m + J/l^2: at zero the constraints lose rank and the motion is undetermined."""
        total = self.body.mass + self.body.inertia / self.body.wheelbase**2
        return 1.0 / (total * self.geometry(state).gauge ** 2)

    def contact(self, state: State, rate: State | None = None) -> Float[Array, "..."]:
        """Normal force [N] of the ground on the stroller; negative where the ground would have to pull. It is cheaper for a
        known `rate` of the state, which contains the velocity."""
        if rate is None:
            force = self.geometry(state).normal_force
        else:
            place, velocity = padded(state[: self.surface.axes]), padded(rate[: self.surface.axes])
            normal = self.surface.normal(place)
            force = self.normal_force(normal, self.surface.normal_rate(place, velocity), velocity)
        return jnp.broadcast_to(multiply(1.0, force), state[0].shape)

    def side_force(self, t: Number, state: State, controls: Input | None) -> tuple[Number, Number]:
        """Side forces [N] of the ground on the rear axle and on the front wheel, to the left of each; with the projected
        heading on curved ground, they act horizontally.

        From the balance of momentum and of spin about the normal (`stroller.md`, section 4): the front force times
        -sin(phi) nu is the missing momentum along d, and the front force times cos(phi) l the missing spin; together, both
        give the force without dividing by cos(phi). The rear force follows from the sideways momentum.
        """
        body, is_horizontal = self.body, self.projected and not isinstance(self.surface, Plane)

        def moving(state):
            g = self.geometry(state)
            return g.velocity, g.motion.yaw_rate

        _, (acceleration, yaw_acceleration) = jax.jvp(moving, (state,), (self.field(t, state, controls),))
        g = self.geometry(state)
        forces = self.forces(t, g, controls)
        drag, heading, v, yaw = forces.drag, g.motion.heading, g.motion.speed, g.motion.yaw_rate
        left = cross(self.up, heading) if is_horizontal else g.left
        wheel_direction = sum_vectors(scale(g.cosine, heading), scale(g.sine, left))
        push = sum_vectors(scale(add(forces.drive, drag.rear), heading), scale(drag.front, wheel_direction))
        # The centre of mass swings with the yaw if it is ahead of the axle.
        swing = scale(body.centre, sum_vectors(scale(yaw_acceleration, left), scale(-yaw * yaw, heading)))
        proper_acceleration = sum_vectors(acceleration, swing, scale(self.gravity, self.up))
        missing_force = sum_vectors(scale(body.mass, proper_acceleration), scale(-1.0, push))
        spin = add(
            body.inertia * yaw_acceleration,
            multiply(body.mass, body.centre, add(v * yaw, multiply(self.gravity, dot(left, self.up)))),
            multiply(self.absolute, forces.fork),
        )
        if not is_horizontal:
            # Curvature turns the frame as it moves, and the spin of the frame reacts with a sideways force.
            fork_rate = self.unpack(state)[2][2]
            carried = add(body.inertia * yaw, multiply(self.absolute, body.steering_inertia, fork_rate))
            gyration = multiply(self.surface.gaussian_curvature(g.motion.position), carried, v)
            missing_force = sum_vectors(missing_force, scale(subtract(None, gyration), left))
        moment = add(drag.yaw, multiply(drag.front, body.wheelbase, g.sine))
        swept = multiply(g.sine, g.lead)
        momentum = multiply(swept, dot(missing_force, g.direction))
        front = subtract(g.cosine / body.wheelbase * subtract(spin, moment), momentum) / (g.cosine**2 + swept**2)
        square = dot(g.direction, g.direction)
        tilt = multiply(g.sine, dot(heading, g.normal), dot(left, g.normal), 1.0 / square)
        return dot(missing_force, g.left) / square - front * add(g.cosine, tilt), front


def padded(components: State | list[Array]) -> Vector:
    """A vector made from its components; missing components at the end vanish identically."""
    return (*components, None, None)[:3]


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
        """The state at the start of a run (see the top of this file for its components).

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
