"""The scene: body, arena, friction and gravity."""

import math
from collections.abc import Iterator
from typing import Any, ClassVar, Generic, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from nonholonomic.geometry import (
    AbstractFrame,
    AbstractSurface,
    CarriedFrame,
    Component,
    Plane,
    PlaneFrame,
    Sphere,
    Vector,
    cross,
    dot,
    frame_of,
    multiply,
    none_if_zero,
    place_named,
    room_bounds,
    scale,
    sum_vectors,
)
from nonholonomic.geometry.surface import as_surface
from nonholonomic.parameters import numbers
from nonholonomic.text import likely_fix, shown, suspected_gravity
from nonholonomic.validation import Bound, Bounded, as_number, is_traced, largest, require_all, require_kind

from .body import AbstractBody, Top
from .dynamics import TURNING, Dynamics
from .friction import A_LAW, AbstractFriction, Frictionless, NoSlip, as_law
from .launch import Launch, angular_velocity, as_launch, inclination, joined, parts
from .rigid_body import AbstractRigidBody
from .rigid_dynamics import AbstractRigidDynamics, rigid_dynamics
from .stick_slip import StickSlip

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
    gravity: Float[Array, "..."] = eqx.field(converter=as_number, default=9.81)
    contact: str = eqx.field(static=True, default="stop")
    restitution: Float[Array, "..."] | None = eqx.field(converter=none_if_zero, default=None)
    side: str | None = eqx.field(static=True, default=None)

    def __check_init__(self):
        check_parts(self)

    def bounds(self) -> Iterator[Bound]:
        yield Bound(self.gravity, "gravity", above=0.0)
        if not isinstance(self.surface, Plane):
            yield from room_bounds(self.surface, self.surface.sign(self.side, "inside"), self._least_room)
        if self.restitution is not None:
            yield Bound(self.restitution, "restitution", at_least=0.0, at_most=1.0)

    @property
    def _least_room(self) -> Float[Array, "..."]:
        """The radius [m] that a closed arena must exceed so that the body can be inside."""
        if not isinstance(self.body, AbstractRigidBody):
            return self.body.size
        lowest, highest = self.body.half_widths
        return highest if isinstance(self.surface, Sphere) else lowest

    def suspicion(self) -> str | None:
        for name, value in numbers("surface", self.surface, functions=False).items():
            unit = self.surface.units.get(name.removeprefix("surface."), "1")
            if (
                unit == "m"
                and isinstance(value, jax.Array)
                and not is_traced(value)
                and np.any(np.asarray(value) > LARGEST_ARENA)
            ):
                size = float(np.max(np.asarray(value)))
                unit = "mm" if size > 10.0 * LARGEST_ARENA else "cm"
                return f"{name} = {size:g} m is larger than a room: was it in {unit}? There a top moves as on a Plane"
        return suspected_gravity(largest(self.gravity))

    @property
    def frame(self) -> AbstractFrame:
        """The moving frame of the body on the arena; that of an `Ellipsoid` or a `RigidBody` moves with the contact point."""
        distance = jnp.zeros(()) if isinstance(self.body, AbstractRigidBody) else self.body.size
        side, pull = self.surface.sign(self.side, "inside"), PULL * jnp.sqrt(self.gravity / self.body.size)
        if self.contact == "hybrid" and not self.flies_in_closed_form:
            # A flight can take the top anywhere, so use the frame that stores its position.
            return CarriedFrame.of(self.surface, distance, pull, side)
        return frame_of(self.surface, side, distance, pull)

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
        """Whether flights of a hybrid scene need no integration: above a level plane, under a law with a single
        mode."""
        return self.level and not self.friction.set_valued

    @property
    def dynamics(self) -> Any:
        """The equations of motion, with the precomputed combinations of the scene's numbers: a `Dynamics`, a `StickSlip` or an
        `AbstractRigidDynamics`."""
        numbers = (self.frame, self.friction, self.gravity)
        if self.friction.set_valued and isinstance(self.body, Top | AbstractRigidBody):
            return StickSlip.of(self.body, *numbers)
        if isinstance(self.body, AbstractRigidBody):
            return rigid_dynamics(self.body, *numbers)
        return Dynamics.of(self.body, *numbers)

    @property
    def _rigid_dynamics(self) -> AbstractRigidDynamics:
        """The equations of motion of a rigid body; if it can both slip and roll, the equations of slipping."""
        equations = self.dynamics
        equations = equations.slipping if isinstance(equations, StickSlip) else equations
        assert isinstance(equations, AbstractRigidDynamics)
        return equations

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
        return equations.turning(jax.lax.stop_gradient(jnp.where(may_invert, TURNING, 0.0)))

    def check_start(self, launch: Launch) -> None:
        """Raise `ValueError` if a launch has no place on this arena."""
        require_all(self.start_bounds(launch))

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
        if launch.place is None:
            return self.frame.at_angle(launch.eta)
        return self.frame.at_foot(self.surface.chart(place_named(self.surface, launch.place))[0])

    def state(self, launch: Launch) -> Float[Array, "components ..."]:
        """The state at the start of a run (see `launch.py` for its components).

        **Arguments:**

        - `launch`: a `Launch` whose numbers, like the scene's, are scalars or one per lane; or a list of launches.

        **Returns:** an array (components, ...) in SI units.
        """
        launch = as_launch(launch)
        body, sine, zero = self.body, jnp.sin(launch.theta), jnp.zeros_like(launch.theta)
        e = (sine * jnp.cos(launch.azimuth), sine * jnp.sin(launch.azimuth), jnp.cos(launch.theta))
        if isinstance(body, AbstractRigidBody):
            w = sum_vectors(scale(launch.spin, e), launch.angular_velocity or (None, None, None))
            return self._rigid_dynamics.start(launch, self.start(launch)[0], e, tuple(w))
        L, u = scale(body.I3 * launch.spin, e), launch.velocity or (zero, zero)
        if launch.angular_velocity is not None:
            w = tuple(launch.angular_velocity)
            axial_rate = dot(w, e)
            L = sum_vectors(L, scale(body.I1, w), scale((body.I3 - body.I1) * axial_rate, e))
            u = sum_vectors(u, scale(multiply(-1.0, body.offset_of_path), cross(w, e)[:2]))
        return joined(u, e, L, self.start(launch)[0])

    def scales(self, launch: Launch) -> Float[Array, "components ..."]:
        """Scales of absolute errors of the state, component by component.

        Velocities are measured in units of sqrt(g R) with the body's size R, directions in units of 1, angular momenta
        in units of the launch's own, or of I1 sqrt(g / R) if that is more. For a launch within `NEARLY_UPRIGHT` of the
        normal, components that vanish with the tilt are measured in proportion to it; otherwise errors would hide their
        growth, which decides when the top turns over.

        **Arguments:** as for `state`. **Returns:** an array (components, ...) in SI units.
        """
        launch = as_launch(launch)
        one = jnp.ones_like(launch.theta)
        rate = jnp.sqrt(self.gravity / self.body.size)
        velocity = rate * self.body.size
        I1, I3 = self._moments
        momentum = jnp.maximum(I3 * jnp.abs(launch.spin), I1 * rate)
        if launch.angular_velocity is not None:
            w = launch.angular_velocity
            momentum = jnp.maximum(momentum, I1 * jnp.sqrt(dot(w, w)))
        place = scale(one, self.frame.place_scales(self.body.size))
        tilt = jnp.sin(launch.theta) / NEARLY_UPRIGHT
        # A top that stands exactly upright has no growth to resolve.
        tilt = jnp.where(tilt > 0.0, jnp.clip(tilt, 1e-280, 1.0), 1.0)
        velocities, momenta = (velocity * tilt, velocity * tilt), (momentum * tilt, momentum * tilt, momentum)
        x_axis = (one, one, tilt) if isinstance(self.body, AbstractRigidBody) else ()
        return joined(velocities, (tilt, tilt, one), momenta, place, x_axis)

    @property
    def _moments(self) -> tuple[Float[Array, "..."], Float[Array, "..."]]:
        """The magnitudes of the body's moments of inertia across and along its axis [kg m^2]."""
        if isinstance(self.body, AbstractRigidBody):
            inertia = self.body.inertia
            return 0.5 * (inertia.xx + inertia.yy), inertia.zz
        return self.body.I1, self.body.I3

    def field(self, state: Float[Array, "components ..."]) -> Float[Array, "components ..."]:
        """Rate of change of the state: (m/s^2, 1/s, N m, 1/s) for (velocity, axis, angular momentum, place)."""
        return self.dynamics.field(state)

    def normal_force(self, state: Float[Array, "components ..."]) -> Float[Array, "..."]:
        """Force of the arena on the top along n [N]; at zero the contact is lost."""
        return self.dynamics.motion(state).normal_force

    def slip_velocity(self, state: Float[Array, "components ..."]) -> Float[Array, "2 ..."]:
        """Velocity of the material contact point in the moving frame [m/s]."""
        slip = self.dynamics.motion(state).slip
        return jnp.stack([slip.x, slip.y])

    def friction_power(self, state: Float[Array, "components ..."]) -> Float[Array, "..."]:
        """Power of friction N (f.v_s + tau.w) [W], at most 0 (`tippe.md`, section 2)."""
        motion = self.dynamics.motion(state)
        power = motion.friction_power
        return jnp.zeros_like(motion.normal_force) if power is None else power

    def energy(self, state: Float[Array, "components ..."]) -> Float[Array, "..."]:
        """Kinetic energy plus weight times the height of the centre of mass above the arena's lowest point [J]."""
        body, dynamics = self.body, self.dynamics
        if isinstance(body, AbstractRigidBody):
            return self._rigid_dynamics.energy(state)
        (u1, u2), e, L, place = parts(state)
        e3_dot = (L[0] * e[1] - L[1] * e[0]) / body.I1
        speed2 = u1**2 + u2**2 + (body.meridian.at(e[2]).offset * e3_dot) ** 2
        axial = dot(L, e)
        rotation = (dot(L, L) - axial**2) / (2.0 * body.I1) + axial**2 / (2.0 * body.I3)
        height = dynamics.frame.height(place) + dot(body.mass_from_frame(e), dynamics.frame.vertical(place))
        return 0.5 * body.mass * speed2 + rotation + body.mass * self.gravity * height

    def jellett(self, state: Float[Array, "components ..."]) -> Float[Array, "..."]:
        """Jellett's quantity L.(R n - a e) [kg m^3/s]: for a sphere on the plane, constant under every friction at the
        contact point. For other bodies -L.r, which is nearly constant while they spin fast.

        On a curved arena it changes at the rate R L.n', and a contact torque N tau changes it at the rate N tau.(R n -
        a e) (`tippe.md`, section 2).
        """
        _, e, L, _ = parts(state)
        if isinstance(self.body, AbstractRigidBody):
            return dot(L, self._rigid_dynamics.mass_from_contact(state))
        lever = self.body.meridian.at(e[2])
        return lever.radius * L[2] - lever.offset * dot(e, L)

    def theta(self, state: Float[Array, "components ..."]) -> Float[Array, "..."]:
        """Angle [rad] from the arena's normal to the axis, in [0, pi]."""
        return inclination(parts(state).axis)

    def spin(self, state: Float[Array, "components ..."]) -> Float[Array, "..."]:
        """Angular velocity about the axis, w.e [rad/s]."""
        _, e, L, _ = parts(state)
        if isinstance(self.body, AbstractRigidBody):
            return dot(e, self.angular_velocity(state))
        return dot(e, L) / self.body.I3

    def angular_velocity(self, state: Float[Array, "components ..."]) -> Vector:
        """Angular velocity of the body in the moving frame [rad/s]."""
        if isinstance(self.body, AbstractRigidBody):
            return self._rigid_dynamics.angular_velocity(state)
        _, e, L, _ = parts(state)
        return angular_velocity(self.body, e, L)

    def path_from_frame(self, state: Float[Array, "components ..."]) -> Vector:
        """Vector from the point with which the frame moves to the point whose path is reported [m], in the moving
        frame."""
        if isinstance(self.body, AbstractRigidBody):
            return self._rigid_dynamics.mass_from_contact(state)
        return self.body.path_from_frame(parts(state).axis)


def check_parts(scene: Any) -> None:
    """Raise `ValueError` if a part of a scene is of the wrong kind, or does not allow another part or an option."""
    if not isinstance(scene.body, AbstractBody | AbstractRigidBody):
        kinds = f"a Top, a SpheroidBody, a ConvexBody, an Ellipsoid or a RigidBody{likely_fix(scene.body)}"
        raise ValueError(f"body = {shown(scene.body)} must be {kinds}")
    require_kind(scene.surface, "surface", AbstractSurface, ", such as tippe.Plane() or tippe.Cylinder(0.3)")
    require_kind(scene.friction, "friction", AbstractFriction, A_LAW)
    # This raises an error if the surface has no such side.
    scene.surface.sign(scene.side, "inside")
    if scene.contact not in ("stop", "hybrid"):
        raise ValueError(f"contact = {shown(scene.contact)} must be 'stop' or 'hybrid'")
    if scene.restitution is not None and scene.contact == "stop":
        raise ValueError(
            f"restitution = {shown(scene.restitution)} needs contact='hybrid', because a run without flights has no impacts"
        )
    if isinstance(scene.friction, NoSlip) and not isinstance(scene.body, AbstractRigidBody):
        raise ValueError(
            f"friction = NoSlip() must be another law for a {type(scene.body).__name__}, such as Coulomb; describe the "
            "body as an Ellipsoid or a RigidBody to roll it"
        )
    if not isinstance(scene.body, Top):
        _check_convex(scene)
        return
    if scene.friction.set_valued and scene.body.stem is not None:
        raise ValueError(
            f"friction = {shown(scene.friction)} must be a law with a single mode for a top with a stem, such as Coulomb: "
            "with two contacts it is undetermined which one sticks"
        )
    if scene.contact == "stop" and scene.body.stem is not None:
        raise ValueError(
            "a top with a stem needs contact='hybrid', as in Scene(top, contact='hybrid'): it hops from its sphere onto its "
            "stem; the default, 'stop', ends a run where the contact is lost"
        )


def _check_convex(scene: Any) -> None:
    """Raise `ValueError` for options that need a sphere, whose contact follows from the place of its centre."""
    kind = type(scene.body).__name__
    kind = f"an {kind}" if kind[0] in "AEIOU" else f"a {kind}"
    if not isinstance(scene.surface, Plane) and isinstance(scene.body, AbstractBody):
        allowed_bodies = "a Top runs on any arena, as an Ellipsoid or a RigidBody does"
        raise ValueError(f"surface = {shown(scene.surface)} must be a Plane for {kind}; {allowed_bodies}")
    if scene.contact != "stop":
        raise ValueError(f"contact = {shown(scene.contact)} must be 'stop' for {kind}; only a Top can fly")
    if scene.friction.set_valued and isinstance(scene.body, AbstractBody):
        raise ValueError(
            f"friction = {shown(scene.friction)} must be a law with a single mode for {kind}, such as Coulomb; describe the "
            "body as an Ellipsoid or a RigidBody to stick and slip"
        )


def generic_direction(scene: Scene, launch: Launch, cells: int) -> Float[Array, "components cells"]:
    """A generic direction, tangent to the set of states: the body's axes keep their length and right angle, and the
    vertical keeps length 1; a body that rolls keeps rolling."""
    magnitudes, state = scene.scales(launch), scene.state(launch)
    u1, u2, r1, r2, r3, *L = (magnitudes[i] * jnp.cos(1.0 + i) for i in range(8))
    _, e, _, last = parts(state)
    frame, (place, _) = scene.frame, scene.start(launch)
    place = frame.frame_motion(place, (scene.body.size, scene.body.size)).place_rate
    rigid = isinstance(scene.body, AbstractRigidBody)
    x_axis = cross((r1, r2, r3), tuple(last[-3:])) if rigid else ()
    direction = joined((u1, u2), cross((r1, r2, r3), e), tuple(L), place, x_axis)
    if rigid:
        direction = jax.jvp(scene.dynamics.carried_along, (state,), (direction,))[1]
    return jnp.broadcast_to(direction.reshape(len(direction), -1), (len(direction), cells))
