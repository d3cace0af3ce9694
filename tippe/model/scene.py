"""The scene, with its body, arena, friction and gravity; and the launches that start runs in it."""

import dataclasses
import math
from collections.abc import Iterator
from typing import Any, ClassVar, Generic, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float

from nonholonomic import validation
from nonholonomic.geometry.frames import AbstractFrame, PlaneFrame, frame_of, place_named
from nonholonomic.geometry.surface import AbstractSurface, Cylinder, Plane, Sphere, Torus, as_surface
from nonholonomic.geometry.vector import Component, Vector, cross, dot, none_if_zero, scale, sum_vectors
from nonholonomic.integration import Components, States
from nonholonomic.parameters import as_one, numbers
from nonholonomic.text import Stated, likely_fix, shown
from nonholonomic.validation import Bound, Bounded, Usual, as_number, largest, require

from ..friction import A_LAW, AbstractFriction, Frictionless, NoSlip, SetValuedCoulomb, as_law
from .body import AbstractBody, Top
from .dynamics import TURNING, Dynamics, RollingDynamics, from_frame, inclination, joined, parts, to_frame
from .rigid import AbstractRigidBody, RigidRolling, RigidSlipping, several
from .stick_slip import StickSlip

#: Spins [rad/s], speeds [m/s] and azimuths [rad] above which another unit is suspected: by hand a top gets 100 to 300 rad/s,
#: 1000 to 3000 rpm.
SPIN = {"usual": Usual(1000.0, {"rpm": math.pi / 30.0})}
SPEED = {"usual": Usual(20.0, {"cm/s": 0.01, "mm/s": 1e-3})}
AZIMUTH = {"usual": Usual(4.0 * math.pi)}

#: Ranges of angles of a launch.
INCLINATION = {"range": {"at_least": 0.0, "at_most": math.pi, "unit": "rad"}}
HALF_TURN = {"range": {"at_least": -math.pi, "at_most": math.pi, "unit": "rad"}}

#: What to do where the spin is missing, or in another unit, and where a launch has a height.
SPINS = "Launch takes spin in rad/s, Launch.degrees takes rpm: 20 turns a second are spin=125.7 or rpm=1200"
HEIGHT = "a launch touches the arena; place= states where"

#: Angles [deg] below this, closer to upright than a hand can launch a top, suggest radians.
LEAST_DEGREES = 0.5


#: Units of the texts and pictures of `Launch.degrees`. Where a picture has no angle, it has a time.
DEGREES = ("deg", "rpm", "s")


class Launch(Stated, Bounded):
    """A launch: position on the arena, inclination, spin and velocity of the top.

    The axis is e = cos(theta) n + sin(theta) (cos(azimuth) t1 + sin(azimuth) t2), with n the arena's normal towards the
    top. In a cylinder, t1 points along growing eta and t2 along y. On other arenas, t1 is the projection of the x axis
    onto the tangent plane (of the y axis where n is along x), and t2 = n x t1; inside a sphere, if the place is given
    by `eta`, t1 points along growing eta.

    **Arguments:**

    - `theta`: angle [rad] from the arena's normal to the axis, in [0, pi]; 0 is stem out, pi is stem in.
    - `spin`: angular velocity about the axis [rad/s].
    - `eta`: angle [rad] of the place from the arena's lowest point, in [-pi, pi]; 0 on arenas without such an angle.
    - `azimuth`: direction [rad] in which the axis leans, from t1 towards t2.
    - `place`: where the top touches the arena, instead of `eta`. On a plane, paraboloid or graph, (x, y) [m], which on
      a tilted plane are measured along the plane. On a cylinder, (y, eta). On a sphere, spheroid or torus, (mu, eta)
      [rad], azimuth and angle from the lowest point. On any arena, (x, y, z) [m], a point of the arena up to round-off.
    - `velocity`: velocity of the sphere's centre, or of the centre of mass for other bodies, along (t1, t2), (2,)
      [m/s]; zero by default.
    - `angular_velocity`: (3,) [rad/s] in (t1, t2, n), in addition to the spin about the axis; zero by default.

    **Raises:** `ValueError` for numbers outside these ranges.

    **Example:** half a metre up the x side of a bowl, moving sideways at 0.2 m/s.

    ```
    >>> import tippe
    >>> tippe.Launch(theta=0.1, spin=155.0)
    Launch(theta=0.1 rad, spin=155 rad/s, eta=0 rad, azimuth=0 rad)
    >>> launch = tippe.Launch(0.1, 100.0, place=(0.5, 0.0), velocity=(0.0, 0.2))
    >>> scene = tippe.Scene(tippe.Top(0.02, 0.02, 0.006, 3e-6, 3.2e-6), tippe.Paraboloid(1.0), tippe.Viscous(0.3))
    >>> print(f"{scene.normal_force(scene.state(launch)):.3f} N")
    0.176 N

    ```
    """

    units: ClassVar[dict[str, str]] = {"theta": "rad", "spin": "rad s-1", "eta": "rad", "azimuth": "rad"}
    units |= {"place": "m or rad", "velocity": "m s-1", "angular_velocity": "rad s-1"}
    advice: ClassVar[dict[str, str]] = dict.fromkeys(("spin", "rpm", "omega"), SPINS) | {"height": HEIGHT}
    advice |= dict.fromkeys(("unit", "units"), "Launch.degrees(theta=6, rpm=1800) takes degrees and turns a minute")

    theta: Float[Array, "..."] = eqx.field(converter=as_number, metadata=INCLINATION)
    spin: Float[Array, "..."] = eqx.field(converter=as_number, metadata=SPIN)
    eta: Float[Array, "..."] = eqx.field(converter=as_number, default=0.0, metadata=HALF_TURN)
    azimuth: Float[Array, "..."] = eqx.field(converter=as_number, default=0.0, metadata=AZIMUTH)
    place: tuple[Float[Array, "..."], ...] | None = eqx.field(
        converter=several("place", (2, 3), "(x, y), (mu, eta) or (x, y, z)", True), default=None, kw_only=True
    )
    velocity: tuple[Float[Array, "..."], ...] | None = eqx.field(
        converter=several("velocity", (2,), "two numbers, along t1 and t2", True),
        default=None,
        kw_only=True,
        metadata=SPEED,
    )
    angular_velocity: tuple[Float[Array, "..."], ...] | None = eqx.field(
        converter=several("angular_velocity", (3,), "three numbers, along t1, t2 and n", True),
        default=None,
        kw_only=True,
    )

    @classmethod
    @validation.explaining
    def degrees(
        cls, theta: ArrayLike, rpm: ArrayLike, *, eta: ArrayLike = 0.0, azimuth: ArrayLike = 0.0, **others: Any
    ) -> "Launch":
        """A launch in degrees and revolutions per minute.

        **Arguments:**

        - `theta`: angle [deg] from the arena's normal to the axis, in [0, 180].
        - `rpm`: spin about the axis [revolutions per minute].
        - `eta`, `azimuth`: as for `Launch`, in degrees.
        - `others`: `place`, `velocity` and `angular_velocity`, as for `Launch`, in SI units.

        **Returns:** a `Launch` with numbers in SI units, whose texts and pictures are in degrees and rpm.

        **Raises:** `ValueError` for numbers outside these ranges.

        **Example:**

        ```
        >>> import tippe
        >>> launch = tippe.Launch.degrees(theta=6, rpm=1800)
        >>> launch, launch.spin.round(2).item()
        (Launch(theta=6 deg, spin=1800 rpm, eta=0 deg, azimuth=0 deg), 188.5)

        ```
        """
        require(theta, "theta", at_least=0.0, at_most=180.0, why="in degrees")
        require(eta, "eta", at_least=-180.0, at_most=180.0, why="in degrees")
        require(azimuth, "azimuth", why="in degrees")
        require(rpm, "rpm")
        if 0.0 < (inclination := largest(as_number(theta))) < LEAST_DEGREES:
            validation.warn(
                f"theta = {inclination:g} deg is closer to upright than a hand can launch a top: was it in radians? "
                f"{inclination:g} rad are {math.degrees(inclination):.3g} deg"
            )
        theta, eta, azimuth = (jnp.radians(as_number(angle)) for angle in (theta, eta, azimuth))
        return cls(theta, as_number(rpm) * (2.0 * jnp.pi / 60.0), eta, azimuth, **others).stated_in(DEGREES)

    def suspicion(self) -> str | None:
        # People write whole degrees; radians above 1 are rarely whole numbers.
        is_whole = largest(self.theta) > 1.0 and largest(self.spin) > 0.0 and not np.any(np.asarray(self.theta) % 1.0)
        return Usual(0.0).question("theta", self.theta, "rad") if is_whole else super().suspicion()

    def bounds(self) -> Iterator[Bound]:
        yield from super().bounds()
        if self.place is not None:
            yield Bound(self.eta, "eta", at_least=0.0, at_most=0.0, why="place is given")


def as_launch(value: Any) -> Any:
    """A list of launches as one `Launch` whose numbers are lists; anything else stays unchanged, for later checks."""
    return as_one(value, "launch", Launch)


#: The body's class: code that needs a sphere takes a `Scene[Top]`.
Body = TypeVar("Body", bound=AbstractBody | AbstractRigidBody)

#: Tilt [rad] of a launch below which errors across the normal are measured in proportion to the tilt.
NEARLY_UPRIGHT = 1e-2

#: Rate at which the foot of a top on a general arena is pulled back to the arena, over sqrt(g / R).
PULL = 1.0


#: Arenas with a number above this [m] suggest another unit.
LARGEST_ARENA = 20.0


class Scene(Bounded, Generic[Body]):
    """A tippe top on an arena.

    Every number in it is a leaf of a pytree: you can sweep, trace and differentiate it.

    **Arguments:**

    - `body`: a `Top`, an `Ellipsoid`, a `RigidBody`, a `SpheroidBody` or a `ConvexBody`. All but a `Top` need
      `contact="stop"`; a `SpheroidBody` and a `ConvexBody` also need a plane and a friction law with a single mode.
    - `surface`: the arena: `Plane(tilt)`, `Cylinder(radius)`, `Sphere(radius)`, `Spheroid(equatorial, polar)`, `Torus(ring,
      tube)`, `Paraboloid(p)`, `Graph(height)` or `Implicit(function)`.
    - `friction`: `Frictionless()`, `Viscous(mu)`, `Coulomb(mu, slip_speed)`, `Contensou(mu, contact_radius, slip_speed)`
      or `Rolling(resistance, turning_speed, sliding)` with one of them. A top without a stem, an `Ellipsoid` and a
      `RigidBody` also allow `SetValuedCoulomb(mu)`; the latter two also allow `NoSlip()`.
    - `gravity`: acceleration of free fall [m/s^2], positive.
    - `contact`: "stop" (the default): a run ends where the contact is lost; "hybrid": it continues through flights,
      impacts, and changes to the stem and back (`modes/`). "stop" compiles faster and works for every body and law; the
      status of a run that loses contact is "contact_lost". A top with a stem needs "hybrid". If such a top comes to
      rest on its sphere and its stem at once, it leans on both on the level plane; on any other arena, the run ends
      with the status "unresolved".
    - `restitution`: Newton's coefficient e_N of impacts [1], in [0, 1], for "hybrid" only; `None` is 0.
    - `side`: "inside" or "outside" of a closed surface, or "above" an open surface; `None` means inside, or above.

    **Raises:** `ValueError` if a part is of the wrong kind, if the top does not fit into the arena, if gravity is not
    positive, or if the arena, the body or the friction does not allow the contact.

    **Example:**

    ```
    >>> import tippe
    >>> top = tippe.Top(mass=0.02, radius=0.02, offset=0.006, I1=2.994e-6, I3=3.2e-6)
    >>> scene = tippe.Scene(top, surface=tippe.Cylinder(0.3), friction=tippe.Viscous(0.3))
    >>> print(scene)
    Scene
      body      Top(mass=0.02 kg, radius=0.02 m, offset=0.006 m, I1=2.994e-06 kg m², I3=3.2e-06 kg m²)
      surface   Cylinder(radius=0.3 m)
      friction  Viscous(mu=0.3 s/m)
      gravity   9.81 m/s²
      contact   'stop'

    ```
    """

    units: ClassVar[dict[str, str]] = {"gravity": "m s-2", "restitution": "1"}

    body: Body
    surface: AbstractSurface = eqx.field(converter=as_surface, default=Plane())
    friction: AbstractFriction = eqx.field(converter=as_law, default=Frictionless())
    gravity: Float[Array, "..."] = eqx.field(converter=as_number, default=9.81, metadata=Bound.GRAVITY)
    contact: str = eqx.field(static=True, default="stop")
    restitution: Float[Array, "..."] | None = eqx.field(
        converter=none_if_zero, default=None, metadata={"range": {"at_least": 0.0, "at_most": 1.0}}
    )
    side: str | None = eqx.field(static=True, default=None)

    def __check_init__(self):
        body, surface, friction = self.body, self.surface, self.friction
        if not isinstance(body, AbstractBody | AbstractRigidBody):
            kinds = f"a Top, a SpheroidBody, a ConvexBody, an Ellipsoid or a RigidBody{likely_fix(body)}"
            raise ValueError(f"body = {shown(body)} must be {kinds}")
        law = "; pass a law by its name, friction=" if isinstance(surface, AbstractFriction) else ""
        validation.require_kind(
            surface, "surface", AbstractSurface, f", such as tippe.Plane() or tippe.Cylinder(0.3){law}"
        )
        validation.require_kind(friction, "friction", AbstractFriction, A_LAW)
        # This raises an error if the surface has no such side.
        surface.sign(self.side, "inside")
        if self.contact not in ("stop", "hybrid"):
            raise ValueError(f"contact = {shown(self.contact)} must be 'stop' or 'hybrid'")
        if self.restitution is not None and self.contact == "stop":
            raise ValueError(
                f"restitution = {shown(self.restitution)} needs contact='hybrid', because a run without flights has no "
                "impacts"
            )
        # What only a sphere allows, whose contact follows from the place of its centre, and only some bodies.
        kind, is_rigid = type(body).__name__, isinstance(body, AbstractRigidBody)
        if isinstance(friction, NoSlip) and not is_rigid:
            raise ValueError(
                f"friction = NoSlip() must be another law for a {kind}, such as Coulomb; describe the body as an Ellipsoid "
                "or a RigidBody to roll it"
            )
        if not isinstance(body, Top):
            kind = f"an {kind}" if kind[0] in "AEIOU" else f"a {kind}"
            if not isinstance(surface, Plane) and not is_rigid:
                allowed_bodies = "a Top runs on any arena, as an Ellipsoid or a RigidBody does"
                raise ValueError(f"surface = {shown(surface)} must be a Plane for {kind}; {allowed_bodies}")
            if self.contact != "stop":
                raise ValueError(f"contact = {shown(self.contact)} must be 'stop' for {kind}; only a Top can fly")
            if friction.set_valued and not is_rigid:
                raise ValueError(
                    f"friction = {shown(friction)} must be a law with a single mode for {kind}, such as Coulomb; describe "
                    "the body as an Ellipsoid or a RigidBody to stick and slip"
                )
        elif friction.set_valued and body.stem is not None:
            raise ValueError(
                f"friction = {shown(friction)} must be a law with a single mode for a top with a stem, such as Coulomb: "
                "with two contacts it is undetermined which one sticks"
            )
        elif self.contact == "stop" and body.stem is not None:
            raise ValueError(
                "a top with a stem needs contact='hybrid', as in Scene(top, contact='hybrid'): it hops from its sphere onto "
                "its stem; the default, 'stop', ends a run where the contact is lost"
            )

    def bounds(self) -> Iterator[Bound]:
        yield from super().bounds()
        surface = self.surface
        if isinstance(surface, Cylinder | Sphere | Torus) and surface.sign(self.side, "inside") < 0.0:
            # The radius that the arena must exceed so that the body fits inside.
            room = self.body.size
            if isinstance(self.body, AbstractRigidBody):
                lowest, highest = self.body.half_widths
                room = highest if isinstance(surface, Sphere) else lowest
            name = "tube" if isinstance(surface, Torus) else "radius"
            yield Bound(getattr(surface, name), f"surface {name}", above=room, why="the body must fit inside")

    def suspicion(self) -> str | None:
        for name, value in numbers("surface", self.surface, functions=False).items():
            unit = self.surface.units.get(name.removeprefix("surface."), "1")
            if unit == "m" and (size := largest(value)) > LARGEST_ARENA:
                unit = "mm" if size > 10.0 * LARGEST_ARENA else "cm"
                return f"{name} = {size:g} m is larger than a room: was it in {unit}? There a top moves as on a Plane"
        return super().suspicion()

    @property
    def frame(self) -> AbstractFrame:
        """The moving frame of the body on the arena; that of an `Ellipsoid` or a `RigidBody` moves with the contact point."""
        size, is_integrated = self.body.size, self.contact == "hybrid" and not self.flies_in_closed_form
        distance = jnp.zeros(()) if isinstance(self.body, AbstractRigidBody) else size
        if self.level and not is_integrated:
            return PlaneFrame(distance)
        # A flight can take the top anywhere, so it needs the frame that stores its position.
        side, pull = self.surface.sign(self.side, "inside"), PULL * jnp.sqrt(self.gravity / size)
        return frame_of(self.surface, side, distance, pull, carried=is_integrated)

    @property
    def has_stem(self) -> bool:
        """Whether the body is a top with a stem."""
        return isinstance(self.body, Top) and self.body.stem is not None

    @property
    def level(self) -> bool:
        """Whether the arena is a level plane."""
        return isinstance(self.surface, Plane) and self.surface.tilt is None

    @property
    def flies_in_closed_form(self) -> bool:
        """Whether there are flights that need no integration: above a level plane, under a law with a single mode."""
        return self.contact == "hybrid" and self.level and not self.friction.set_valued

    @property
    def dynamics(self) -> Any:
        """The equations of motion, with the precomputed combinations of the scene's numbers: a `Dynamics`, a `StickSlip` or an
        `AbstractRigidDynamics`."""
        body, frame, friction, gravity = self.body, self.frame, self.friction, self.gravity
        if isinstance(body, AbstractRigidBody):
            parts_of_scene = {"frame": frame, "body": body, "gravity": gravity, "inverse": body.inertia.tensor.inverse}
            rolling = RigidRolling(**parts_of_scene)
            if isinstance(friction, NoSlip):
                return rolling
            slipping = RigidSlipping(**parts_of_scene, friction=friction, per_mass=1.0 / body.mass)
            return StickSlip(slipping, rolling, friction.mu) if isinstance(friction, SetValuedCoulomb) else slipping
        per_mass, per_transverse, axial_excess = 1.0 / body.mass, 1.0 / body.I1, 1.0 / body.I3 - 1.0 / body.I1
        parts_of_body = (body.mass, gravity, per_mass, per_transverse, axial_excess)
        slipping = Dynamics(frame, friction, body.meridian, *parts_of_body)
        if not isinstance(friction, SetValuedCoulomb):
            return slipping
        assert isinstance(body, Top)
        return StickSlip(slipping, RollingDynamics(frame=frame, body=body, gravity=gravity), friction.mu)

    @property
    def turning_dynamics(self) -> Any:
        """The equations of motion for angles, times, energies and forces, which are cheaper in a turning frame.

        On a level plane under an isotropic law, the frame turns with the top; how far it has turned is not recorded.
        """
        equations, body = self.dynamics, self.body
        is_isotropic = self.level and self.friction.isotropic
        if not (isinstance(equations, Dynamics) and isinstance(body, Top)) or not is_isotropic:
            return equations
        # Tops of group I (`tippe/steady.py`) soon stand upright, with the axis close to L; in a turning frame, both would
        # move.
        may_invert = 1.0 - body.offset / body.radius < body.I1 / body.I3
        turns = jax.lax.stop_gradient(jnp.where(may_invert, TURNING, 0.0))
        return dataclasses.replace(equations, turns=turns)

    def check_start(self, launch: Launch) -> None:
        """Raise `ValueError` if a launch has no place on this arena."""
        validation.require_all(self.start_bounds(launch))

    def start_bounds(self, launch: Launch) -> Iterator[Bound]:
        """The ranges of a launch's numbers on this arena.

        **Raises:** `ValueError` for a place with the wrong number of coordinates.
        """
        if isinstance(self.friction, NoSlip) and launch.velocity is not None:
            raise ValueError(
                f"velocity = {shown(launch.velocity)} must be left out where friction = NoSlip(): it follows from the rotation"
            )
        surface = self.surface
        names, kind = [name for name, _ in surface.coordinates], type(surface).__name__
        if launch.place is None:
            if len(names) == 3:
                raise ValueError(f"place must be given, as (x, y, z), on a {kind}, which has no coordinate eta")
            if "eta" not in names and not isinstance(self.frame, PlaneFrame):
                yield Bound(launch.eta, "eta", at_least=0.0, at_most=0.0, why=f"a place on a {kind} is given by place")
            return
        counts_from_below = len(launch.place) == 2 and names[0] == "mu"
        for bound in surface.place_bounds(place_named(surface, launch.place), self.body.size):
            if counts_from_below and bound.name == "place[1]":
                reason = "from the lowest point"
                yield Bound(launch.place[1], "place[1]", at_least=0.0, at_most=math.pi, why=reason, unit="rad")
            else:
                yield bound

    def start(self, launch: Launch) -> tuple[tuple[Component, ...], tuple[Component, ...]]:
        """Place and cyclic coordinates of the frame at the start of a run."""
        place, zero = launch.place, jnp.zeros_like(launch.eta)
        if place is None:
            place = tuple(launch.eta if name == "eta" else zero for name, _ in self.surface.coordinates)
        foot = self.surface.chart(place_named(self.surface, place))[0]
        return self.frame.start(foot, along_eta=launch.place is None)

    def state(self, launch: Launch) -> States:
        """The state at the start of a run (see `dynamics.py` for its components).

        **Arguments:**

        - `launch`: a `Launch` whose numbers, like the scene's, are scalars or one per lane; or a list of launches.

        **Returns:** an array (components, ...) in SI units.
        """
        launch = as_launch(launch)
        body, sine, zero = self.body, jnp.sin(launch.theta), jnp.zeros_like(launch.theta)
        t1, t2 = jnp.cos(launch.azimuth), jnp.sin(launch.azimuth)
        e, u = (sine * t1, sine * t2, jnp.cos(launch.theta)), launch.velocity or (zero, zero)
        if isinstance(body, AbstractRigidBody):
            # The body's axes are those of the frame, rotated about a direction across n, so that z becomes e.
            fall, (place, _) = 1.0 - e[2], self.start(launch)
            c = (1.0 - fall * t1 * t1, -fall * t1 * t2, -e[0])
            axes = (c, cross(e, c), e)
            w = sum_vectors(scale(launch.spin, e), launch.angular_velocity or (None, None, None))
            L = from_frame(body.inertia.tensor.times(to_frame(w, axes)), axes)
            return self.dynamics.carried_along(joined(u, e, L, place, c))
        L = scale(body.I3 * launch.spin, e)
        if launch.angular_velocity is not None:
            w = launch.angular_velocity
            axial_rate = dot(w, e)
            L = sum_vectors(L, scale(body.I1, w), scale((body.I3 - body.I1) * axial_rate, e))
            if isinstance(body, Top):
                # The launch has the velocity of the sphere's centre.
                u = sum_vectors(u, scale(-body.offset, cross(w, e)[:2]))
        return joined(u, e, L, self.start(launch)[0])

    def scales(self, launch: Launch) -> States:
        """Scales of absolute errors of the state, component by component.

        Velocities are measured in units of sqrt(g R) with the body's size R, directions in units of 1, angular momenta
        in units of the launch's own, or of I1 sqrt(g / R) if that is more. For a launch within `NEARLY_UPRIGHT` of the
        normal, components that vanish with the tilt are measured in proportion to it; otherwise errors would hide their
        growth, which decides when the top turns over.

        **Arguments:** as for `state`. **Returns:** an array (components, ...) in SI units.
        """
        launch = as_launch(launch)
        one = jnp.ones_like(launch.theta)
        size = self.body.size
        rate = jnp.sqrt(self.gravity / size)
        velocity = rate * size
        I1, I3 = self.body.moments
        momentum = jnp.maximum(I3 * jnp.abs(launch.spin), I1 * rate)
        if launch.angular_velocity is not None:
            w = launch.angular_velocity
            momentum = jnp.maximum(momentum, I1 * jnp.sqrt(dot(w, w)))
        place = tuple(one * size if is_length else one for is_length in self.frame.lengths)
        tilt = jnp.sin(launch.theta) / NEARLY_UPRIGHT
        # A top that stands exactly upright has no growth to resolve.
        tilt = jnp.where(tilt > 0.0, jnp.clip(tilt, 1e-280, 1.0), 1.0)
        velocities, momenta = (velocity * tilt, velocity * tilt), (momentum * tilt, momentum * tilt, momentum)
        x_axis = (one, one, tilt) if isinstance(self.body, AbstractRigidBody) else ()
        return joined(velocities, (tilt, tilt, one), momenta, place, x_axis)

    def field(self, state: Components) -> States:
        """Rate of change of the state: (m/s^2, 1/s, N m, 1/s) for (velocity, axis, angular momentum, place)."""
        return self.dynamics.field(state)

    def normal_force(self, state: States) -> Float[Array, "..."]:
        """Force of the arena on the top along n [N]; at zero the contact is lost."""
        return self.dynamics.motion(state).normal_force

    def slip_velocity(self, state: States) -> Float[Array, "2 ..."]:
        """Velocity of the material contact point in the moving frame [m/s]."""
        slip = self.dynamics.motion(state).slip
        return jnp.stack([slip.x, slip.y])

    def friction_power(self, state: States) -> Float[Array, "..."]:
        """Power of friction N (f.v_s + tau.w) [W], at most 0 (`tippe.md`, section 2)."""
        motion = self.dynamics.motion(state)
        power = motion.friction_power
        return jnp.zeros_like(motion.normal_force) if power is None else power

    def energy(self, state: States) -> Float[Array, "..."]:
        """Kinetic energy plus weight times the height of the centre of mass above the arena's lowest point [J]."""
        mass, dynamics = self.body.mass, self.dynamics
        (u1, u2), _, L, place = parts(dynamics.carried_along(state))
        w, r = dynamics.rotation(state)
        # The contact point has no velocity along the normal.
        u3 = cross(r, w)[2]
        frame, place = dynamics.frame, place[: len(dynamics.frame.lengths)]
        height = frame.height(place) + dot(_mass_from_frame(frame, r), frame.vertical(place))
        return mass * (0.5 * (u1**2 + u2**2 + u3**2) + self.gravity * height) + 0.5 * dot(w, L)

    def jellett(self, state: States) -> Float[Array, "..."]:
        """Jellett's quantity L.(R n - a e) [kg m^3/s]: for a sphere on the plane, constant under every friction at the
        contact point. For other bodies -L.r, which is nearly constant while they spin fast.

        On a curved arena it changes at the rate R L.n', and a contact torque N tau changes it at the rate N tau.(R n -
        a e) (`tippe.md`, section 2).
        """
        return -dot(parts(state).momentum, self.dynamics.rotation(state)[1])

    def theta(self, state: States) -> Float[Array, "..."]:
        """Angle [rad] from the arena's normal to the axis, in [0, pi]."""
        return inclination(parts(state).axis)

    def spin(self, state: States) -> Float[Array, "..."]:
        """Angular velocity about the axis, w.e [rad/s]."""
        _, e, L, _ = parts(state)
        if isinstance(self.body, AbstractRigidBody):
            return dot(e, self.dynamics.rotation(state)[0])
        return dot(e, L) / self.body.I3

    def path_from_frame(self, state: States) -> Vector:
        """Vector from the point with which the frame moves to the point whose path is reported [m], in the moving
        frame."""
        # The path of a top is that of its sphere's centre, with which the frame moves.
        if isinstance(self.body, Top):
            return (None, None, None)
        dynamics = self.dynamics
        return _mass_from_frame(dynamics.frame, dynamics.rotation(state)[1])


def _mass_from_frame(frame: AbstractFrame, lever: Vector) -> Vector:
    """Vector from the point with which the frame moves to the centre of mass [m], given the vector from there to the
    contact."""
    return (-lever[0], -lever[1], -lever[2] - frame.distance)
