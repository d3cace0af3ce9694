"""The friction laws, and the classes for a law of your own: the slip at the contact, and the load that the law
returns."""

import abc
from typing import ClassVar, NamedTuple, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from nonholonomic.compilation.components import held, map_methods
from nonholonomic.compilation.xla_cpu import compiled_setup
from nonholonomic.geometry import Component, Vector, add, dot, sum_vectors
from nonholonomic.text import one_line, shown
from nonholonomic.validation import UNTRACEABLE, Bound, Bounded, Usual, as_number, is_traced, largest, require_kind

#: A law, or a value that the checks of a scene reject.
Other = TypeVar("Other")

# Argument and result of a friction law: the motion at the contact, and force and torque per unit normal force.


class Slip(NamedTuple):
    """The motion of the body at the contact, in the moving frame (t1, t2, n).

    - `x`, `y`: velocity of the material contact point along the arena [m/s].
    - `turning`: angular velocity of the body [rad/s]; its component along n is the drilling.
    """

    x: Float[Array, "..."]
    y: Float[Array, "..."]
    turning: Vector = (None, None, None)


class ContactLoad(NamedTuple):
    """The effect of friction at the contact per unit normal force, in the moving frame.

    - `force`: the tangential force [1].
    - `torque`: the torque about the contact point [m].

    A component is `None` where it vanishes identically.
    """

    force: tuple[Component, Component]
    torque: Vector = (None, None, None)

    def power(self, slip: Slip) -> Component:
        """Power per unit normal force, f.v_s + tau.w [m/s] (`tippe.md`, section 2)."""
        return add(dot(self.force, (slip.x, slip.y)), dot(self.torque, slip.turning))


# The laws. Each is a class.

#: Addition to the message about an object that is not a friction law.
A_LAW = " law, such as tippe.Viscous(0.3) or tippe.Coulomb(mu=0.3, slip_speed=0.01)"

#: What to do where an argument of Coulomb's law is missing.
ADVICE = {"slip_speed": "usual slip speeds are 0.01 to 0.1 m/s, as in slip_speed=0.05"}

#: The greatest usual slip speed [m/s] and mu, if they may have been exchanged; the slip speed above which another unit is
#: suspected.
USUAL_SLIP_SPEED, USUAL_MU, GREATEST_SLIP_SPEED = 0.2, 1.5, 5.0

#: Ranges of the numbers of the laws, and above which another unit is suspected.
FRICTION = Bound.NOT_NEGATIVE | {"usual": Usual(5.0, {"%": 0.01})}
SLIP_SPEED = Bound.POSITIVE | {"usual": Usual(GREATEST_SLIP_SPEED, {"mm/s": 1e-3})}
CONTACT = Bound.NOT_NEGATIVE | {"usual": Usual(0.02, {"mm": 1e-3})}

#: Slip speeds [m/s] and turning rates [rad/s] at which a law is tried.
SPEEDS, TURNINGS = (1e-3, 1e-2, 0.1, 1.0), (0.0, 100.0, -100.0)


class AbstractFriction(Bounded):
    """A friction law whose force and torque are proportional to the normal force. The law therefore also determines
    impacts, where the normal impulse takes the place of the normal force.

    Friction never does positive work: f.v_s + tau.w <= 0 (`ContactLoad.power`). You get a warning when you construct a law
    that breaks this rule; a run whose energy grows ends as "unresolved".

    **Example:**

    ```
    >>> import tippe
    >>> from tippe.friction import ContactLoad
    >>> class Quadratic(tippe.AbstractFriction):
    ...     def per_normal_force(self, slip):
    ...         speed = (slip.x**2 + slip.y**2) ** 0.5
    ...         return ContactLoad(force=(-0.5 * speed * slip.x, -0.5 * speed * slip.y))
    ...
    >>> top = tippe.Top(mass=0.02, radius=0.02, offset=0.006, I1=2.994e-6, I3=3.2e-6)
    >>> print(tippe.Scene(top, friction=Quadratic()).friction)
    Quadratic()

    ```
    """

    def __init_subclass__(cls, **options: object):
        super().__init_subclass__(**options)
        map_methods(cls, ["per_normal_force"])
        # A law derived from another one must declare this again.
        if "per_normal_force" in cls.__dict__ and "isotropic" not in cls.__dict__:
            cls.isotropic = False

    #: Whether friction on a contact at rest takes the value that keeps the contact at rest, within limits.
    set_valued: ClassVar[bool] = False

    #: Whether the law is the same in all directions along the arena; tables on the level plane are then faster and more
    #: accurate (`Scene.turning_dynamics`). If this is `True` for a law that is not isotropic, tables are wrong.
    isotropic: ClassVar[bool] = False

    def suspicion(self) -> str | None:
        # The laws of this package oppose every slip. Traced numbers have no values to judge.
        is_own = str(type(self).per_normal_force.__module__).startswith("tippe.")
        if not is_own:
            return None if is_traced(self) else drive(as_law(self))
        mu, speed = (largest(getattr(self, name, 0.0)) for name in ("mu", "slip_speed"))
        if 0.0 < mu < USUAL_SLIP_SPEED < speed <= USUAL_MU:
            return f"slip_speed = {speed:g} m/s > mu = {mu:g}: were they exchanged? {ADVICE['slip_speed']}"
        return super().suspicion()

    @abc.abstractmethod
    def per_normal_force(self, slip: Slip) -> ContactLoad:
        """The load per unit normal force.

        **Arguments:**

        - `slip`: velocity of the contact point [m/s] and angular velocity [rad/s].

        **Returns:** a `ContactLoad`.
        """


def as_law(law: Other) -> Other:
    """A user's law with every number of its arrays as a leaf; anything else unchanged."""
    if not isinstance(law, AbstractFriction):
        return law
    zero = jnp.zeros(())
    return held(law, lambda law: law.per_normal_force(Slip(zero, zero, (zero, zero, zero))))


class Frictionless(AbstractFriction):
    """No friction: the arena pushes only along its normal.

    **Example:**

    ```
    >>> import tippe
    >>> from tippe.friction import Slip
    >>> tippe.Frictionless().per_normal_force(Slip(0.1, 0.0)).force
    (None, None)

    ```
    """

    isotropic: ClassVar[bool] = True

    def per_normal_force(self, slip: Slip) -> ContactLoad:
        return ContactLoad(force=(None, None))


class Viscous(AbstractFriction):
    """Viscous sliding friction, F = -mu N v_s (Rutstam 2012, equation 1.1).

    **Arguments:**

    - `mu`: coefficient [s/m], at least 0.

    **Example:**

    ```
    >>> import tippe
    >>> from tippe.friction import Slip
    >>> load = tippe.Viscous(mu=0.3).per_normal_force(Slip(0.1, 0.0))
    >>> print(f"{load.force[0]:.4f} of the normal force")
    -0.0300 of the normal force

    ```
    """

    units: ClassVar[dict[str, str]] = {"mu": "s m-1"}
    isotropic: ClassVar[bool] = True

    mu: Float[Array, "..."] = eqx.field(converter=as_number, metadata=Bound.NOT_NEGATIVE)

    def per_normal_force(self, slip: Slip) -> ContactLoad:
        return ContactLoad(force=(-self.mu * slip.x, -self.mu * slip.y))


class Coulomb(AbstractFriction):
    """Regularised Coulomb friction, F = -mu N v_s / sqrt(v_s^2 + slip_speed^2) (`tippe.md`, section 3).

    The regularised law creeps: below the slip speed it is viscous with the coefficient mu / slip_speed, and a top that
    would stick and roll under exact Coulomb friction may still turn over, after a time that grows as 1 / slip_speed.
    Cohen's top (Am. J. Phys. 45 (1977) 12) takes 1.8, 5.9 and 50 s at 0.1, 0.01 and 0.001 m/s, and never turns over
    under `SetValuedCoulomb`, the limit. Always report the slip speed with a result. The number of explicit steps also
    grows as 1 / slip_speed; at 1e-4 m/s and below, an implicit solver is cheaper (`benchmarks/hard/sticking.py`).

    **Arguments:**

    - `mu`: coefficient of friction [1], at least 0.
    - `slip_speed`: speed [m/s] at which the force reaches 71 % of its limit, positive.

    **Example:**

    ```
    >>> import tippe
    >>> from tippe.friction import Slip
    >>> load = tippe.Coulomb(mu=0.3, slip_speed=0.01).per_normal_force(Slip(0.1, 0.0))
    >>> print(f"{load.force[0]:.4f} of the normal force")
    -0.2985 of the normal force

    ```
    """

    units: ClassVar[dict[str, str]] = {"mu": "1", "slip_speed": "m s-1"}
    advice: ClassVar[dict[str, str]] = ADVICE
    isotropic: ClassVar[bool] = True

    mu: Float[Array, "..."] = eqx.field(converter=as_number, metadata=FRICTION)
    slip_speed: Float[Array, "..."] = eqx.field(converter=as_number, metadata=SLIP_SPEED)

    def per_normal_force(self, slip: Slip) -> ContactLoad:
        speed = jnp.sqrt(slip.x * slip.x + slip.y * slip.y + self.slip_speed * self.slip_speed)
        factor = -self.mu / speed
        return ContactLoad(force=(factor * slip.x, factor * slip.y))


class Contensou(AbstractFriction):
    """Coulomb friction on a small contact disc, with one limit for sliding and drilling together (`tippe.md`, section
    3).

    The force is -mu N v_s / Q and the torque is -mu N Rb^2 w_n n / Q, with Q = sqrt(v_s^2 + Rb^2 w_n^2 + slip_speed^2)
    and Rb = 3 pi / 16 contact_radius. Both are minus the derivatives of the potential mu N Q, with respect to v_s and
    w_n. For small slip_speed, force and torque lie on an ellipsoid with the semi-axes mu N and mu N Rb: the limits of a
    disc under Hertzian pressure in pure sliding and in pure drilling. Between these limits, the force differs from the
    exact force of the disc by up to 0.11 mu N, and the torque by up to 0.083 mu N contact_radius. As the radius tends
    to 0, the law tends to `Coulomb`.

    **Arguments:**

    - `mu`: coefficient of friction [1], at least 0.
    - `contact_radius`: radius [m] of the disc of contact, at least 0.
    - `slip_speed`: speed [m/s] at which the force without drilling reaches 71 % of its limit, positive.

    **Example:**

    ```
    >>> import tippe
    >>> from tippe.friction import Slip
    >>> law = tippe.Contensou(mu=0.3, contact_radius=5e-4, slip_speed=0.01)
    >>> load = law.per_normal_force(Slip(0.1, 0.0, (0.0, 0.0, 100.0)))
    >>> print(f"{load.force[0]:.4f} of the normal force, and {load.torque[2]:.2e} m times it")
    -0.2865 of the normal force, and -2.48e-05 m times it

    ```
    """

    units: ClassVar[dict[str, str]] = {"mu": "1", "contact_radius": "m", "slip_speed": "m s-1"}
    advice: ClassVar[dict[str, str]] = ADVICE
    isotropic: ClassVar[bool] = True

    mu: Float[Array, "..."] = eqx.field(converter=as_number, metadata=FRICTION)
    contact_radius: Float[Array, "..."] = eqx.field(converter=as_number, metadata=CONTACT)
    slip_speed: Float[Array, "..."] = eqx.field(converter=as_number, metadata=SLIP_SPEED)

    def per_normal_force(self, slip: Slip) -> ContactLoad:
        lever = 3.0 * np.pi / 16.0 * self.contact_radius
        drilling = lever * slip.turning[2]
        speed = jnp.sqrt(slip.x * slip.x + slip.y * slip.y + drilling * drilling + self.slip_speed * self.slip_speed)
        factor = -self.mu / speed
        return ContactLoad((factor * slip.x, factor * slip.y), (None, None, factor * lever * drilling))


class Rolling(AbstractFriction):
    """Rolling resistance in addition to a sliding law: a torque of the size N resistance opposes the rolling
    (`tippe.md`, section 3).

    The torque is -N resistance w_t / sqrt(w_t^2 + turning_speed^2), with w_t the angular velocity without its component
    along n: the normal force acts ahead of the contact point, at the distance `resistance`.

    **Arguments:**

    - `resistance`: lever [m] of the normal force, at least 0.
    - `turning_speed`: angular velocity [rad/s] at which the torque reaches 71 % of its limit, positive.
    - `sliding`: the law of the force, such as `Coulomb(mu, slip_speed)`.

    **Example:**

    ```
    >>> import tippe
    >>> from tippe.friction import Slip
    >>> law = tippe.Rolling(resistance=1e-4, turning_speed=1.0, sliding=tippe.Coulomb(0.3, 0.01))
    >>> load = law.per_normal_force(Slip(0.1, 0.0, (10.0, 0.0, 0.0)))
    >>> print(f"{load.force[0]:.4f} of the normal force, and {load.torque[0]:.2e} m times it")
    -0.2985 of the normal force, and -9.95e-05 m times it

    ```
    """

    resistance: Float[Array, "..."] = eqx.field(converter=as_number, metadata=Bound.NOT_NEGATIVE)
    turning_speed: Float[Array, "..."] = eqx.field(converter=as_number, metadata=Bound.POSITIVE)
    sliding: AbstractFriction

    def __check_init__(self):
        require_kind(self.sliding, "sliding", AbstractFriction, A_LAW)
        if isinstance(self.sliding, Rolling | NoSlip) or self.sliding.set_valued:
            raise ValueError(
                f"sliding = {shown(self.sliding)} must be a sliding law with a force at every slip velocity"
            )

    @property
    def units(self) -> dict[str, str]:
        return {"resistance": "m", "turning_speed": "rad s-1"} | self.sliding.units

    @property
    def isotropic(self) -> bool:
        return self.sliding.isotropic

    def per_normal_force(self, slip: Slip) -> ContactLoad:
        w1, w2, _ = slip.turning
        factor = -self.resistance / jnp.sqrt(w1 * w1 + w2 * w2 + self.turning_speed * self.turning_speed)
        load = self.sliding.per_normal_force(slip)
        return ContactLoad(load.force, sum_vectors(load.torque, (factor * w1, factor * w2, None)))


class NoSlip(AbstractFriction):
    """Pure rolling of an `Ellipsoid` or a `RigidBody`: the contact point is at rest, whatever force this takes. The
    nonholonomic constraint replaces the friction law. A run reports the force of the arena as `reaction`, and the
    coefficient of friction that this force needs as `grip`.

    **Example:**

    ```
    >>> import tippe
    >>> inertia = [[1e-5, 0, 0], [0, 2e-5, 0], [0, 0, 2.5e-5]]
    >>> ball = tippe.Ellipsoid(0.1, (0.02, 0.02, 0.02), (0.0, 0.0, 0.0), inertia)  # Chaplygin's ball
    >>> scene = tippe.Scene(ball, friction=tippe.NoSlip())
    >>> launch = tippe.Launch(0.5, spin=20.0, angular_velocity=(5.0, 0.0, 0.0))
    >>> run = tippe.simulate(scene, launch, t1=0.1, tolerance=1e-6)
    >>> print(f"{run.grip.max():.3f}")
    0.050

    ```
    """

    def per_normal_force(self, slip: Slip) -> ContactLoad:
        """
        **Raises:** `ValueError`, because the force follows from the equations of motion.
        """
        raise ValueError("NoSlip has no force per slip: the reaction follows from the equations of motion")


class SetValuedCoulomb(AbstractFriction):
    """Exact Coulomb friction without a slip speed: F = -mu N v_s / |v_s| while the contact slips, and any force along
    the arena up to mu N while it sticks (`tippe.md`, section 3).

    A run consists of modes. During a slip, the force is mu N. When the slip stops, the top rolls, with the
    equations of `tippe/model/dynamics.py`, if the required force is within the friction cone, and slips again when the
    required force leaves the cone. Rolling conserves the energy. With `contact="hybrid"`, a top without a stem
    flies when contact is lost, and slips, rolls or rebounds after an impact (`tippe/modes/sticking.py`).

    **Arguments:**

    - `mu`: coefficient of friction [1], at least 0.

    **Example:**

    ```
    >>> import tippe
    >>> from tippe.friction import Slip
    >>> load = tippe.SetValuedCoulomb(mu=0.3).per_normal_force(Slip(0.1, 0.0))
    >>> print(f"{load.force[0]:.4f} of the normal force")
    -0.3000 of the normal force

    ```
    """

    units: ClassVar[dict[str, str]] = {"mu": "1"}
    set_valued: ClassVar[bool] = True

    mu: Float[Array, "..."] = eqx.field(converter=as_number, metadata=FRICTION)

    def per_normal_force(self, slip: Slip) -> ContactLoad:
        """The load of a slipping contact; at zero slip, where the law does not define it, the load is 0."""
        speed = length(slip.x, slip.y)
        factor = -self.mu / jnp.where(speed > 0.0, speed, 1.0)
        return ContactLoad(force=(factor * slip.x, factor * slip.y))


def length(x: Float[Array, "..."], y: Float[Array, "..."]) -> Float[Array, "..."]:
    """Length of a vector of two components, with derivative 0 where it vanishes."""
    square = x * x + y * y
    moving = square > 0.0
    return jnp.where(moving, jnp.sqrt(jnp.where(moving, square, 1.0)), 0.0)


def drive(law: AbstractFriction) -> str | None:
    """The message about a law whose power is positive for one of some slips in eight directions; `None` if the law
    always brakes."""
    angle, speed, turning = (
        grid.ravel() for grid in np.meshgrid(np.arange(8) * np.pi / 4.0, SPEEDS, TURNINGS, indexing="ij")
    )
    x, y = speed * np.cos(angle), speed * np.sin(angle)
    try:
        with jax.ensure_compile_time_eval():
            zero = jnp.zeros(turning.shape)
            power = np.asarray(_power(law, Slip(jnp.asarray(x), jnp.asarray(y), (zero, zero, jnp.asarray(turning)))))
    except jax.errors.JAXTypeError as error:
        raise ValueError(f"friction = {one_line(law)}: per_normal_force {UNTRACEABLE}") from error
    except NoLoad:
        raise ValueError(
            f"friction = {one_line(law)}: per_normal_force must return a tippe.friction.ContactLoad, as in "
            "ContactLoad(force=(x, y))"
        ) from None
    except Exception:
        # The first run reports what is wrong with such a law.
        return None
    if power.shape != x.shape or not np.any(power > 1e-12):
        return None
    index = int(np.nanargmax(power / speed))
    drills = f" and a turning of {turning[index]:g} rad/s" if turning[index] else ""
    return (
        f"friction = {one_line(law)} drives the top: at a slip of ({x[index]:.3g}, {y[index]:.3g}) m/s{drills} its power is "
        f"{power[index]:.3g} W per newton of normal force, but the power of friction is never positive. Is a sign wrong? A run "
        "whose energy grows ends as 'unresolved'. For a level belt, give Launch the velocity relative to it"
    )


class NoLoad(Exception):
    """A law that returns something else than a load."""


@compiled_setup
def _power(law: AbstractFriction, slip: Slip) -> Component:
    load = law.per_normal_force(slip)
    if not isinstance(load, ContactLoad):
        raise NoLoad
    return load.power(slip)
