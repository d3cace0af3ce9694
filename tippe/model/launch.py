"""Launches: how a run starts; and the parts of the state by name."""

import math
from collections.abc import Iterator
from typing import Any, ClassVar, NamedTuple

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from nonholonomic.geometry import Component, Tangent, Vector, dot, planar_length, scale, sum_vectors
from nonholonomic.parameters import as_one
from nonholonomic.text import shown
from nonholonomic.validation import Bound, Bounded, as_number, largest, require

# Launches: how a run starts.


def as_numbers(value: Any) -> Any:
    """Several numbers as a tuple of arrays; `None` and single values stay unchanged, for later checks."""
    if value is None or isinstance(value, str) or getattr(value, "ndim", 1) == 0:
        return value
    try:
        return tuple(as_number(part) for part in value)
    except TypeError:
        return value


def as_launch(value: Any) -> Any:
    """A list of launches as one `Launch` whose numbers are lists; anything else stays unchanged, for later checks."""
    return as_one(value, "launch", Launch)


#: Spins above this [rad/s] suggest revolutions per minute: by hand a top gets 100 to 300 rad/s, 1000 to 3000 rpm.
FASTEST = 1000.0


class Launch(Bounded):
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

    theta: Float[Array, "..."] = eqx.field(converter=as_number)
    spin: Float[Array, "..."] = eqx.field(converter=as_number)
    eta: Float[Array, "..."] = eqx.field(converter=as_number, default=0.0)
    azimuth: Float[Array, "..."] = eqx.field(converter=as_number, default=0.0)
    place: tuple[Float[Array, "..."], ...] | None = eqx.field(converter=as_numbers, default=None, kw_only=True)
    velocity: tuple[Float[Array, "..."], ...] | None = eqx.field(converter=as_numbers, default=None, kw_only=True)
    angular_velocity: tuple[Float[Array, "..."], ...] | None = eqx.field(
        converter=as_numbers, default=None, kw_only=True
    )

    @classmethod
    def degrees(cls, theta: Any, rpm: Any, *, eta: Any = 0.0, azimuth: Any = 0.0, **others: Any) -> "Launch":
        """A launch in degrees and revolutions per minute.

        **Arguments:**

        - `theta`: angle [deg] from the arena's normal to the axis, in [0, 180].
        - `rpm`: spin about the axis [revolutions per minute].
        - `eta`, `azimuth`: as for `Launch`, in degrees.
        - `others`: `place`, `velocity` and `angular_velocity`, as for `Launch`, in SI units.

        **Returns:** a `Launch` with numbers in SI units.

        **Raises:** `ValueError` for numbers outside these ranges.

        **Example:**

        ```
        >>> import tippe
        >>> tippe.Launch.degrees(theta=6, rpm=1800)
        Launch(theta=0.10472 rad, spin=188.496 rad/s, eta=0 rad, azimuth=0 rad)

        ```
        """
        for value, name, limit in ((theta, "theta", 180.0), (eta, "eta", 180.0), (azimuth, "azimuth", None)):
            lower_limit = 0.0 if name == "theta" else None if limit is None else -limit
            require(value, name, at_least=lower_limit, at_most=limit, why="in degrees")
        require(rpm, "rpm")
        theta, eta, azimuth = (jnp.radians(as_number(angle)) for angle in (theta, eta, azimuth))
        return cls(theta, as_number(rpm) * (2.0 * jnp.pi / 60.0), eta, azimuth, **others)

    def __check_init__(self):
        allowed = {
            "place": ((2, 3), "(x, y), (mu, eta) or (x, y, z)"),
            "velocity": ((2,), "two numbers, along t1 and t2"),
            "angular_velocity": ((3,), "three numbers, along t1, t2 and n"),
        }
        for name, (counts, words) in allowed.items():
            value = getattr(self, name)
            if value is not None and not (isinstance(value, tuple) and len(value) in counts):
                raise ValueError(f"{name} = {shown(value)} must be {words}")

    def suspicion(self) -> str | None:
        fastest = largest(self.spin)
        if fastest <= FASTEST:
            return None
        return (
            f"spin = {fastest:g} rad/s is {fastest * 30.0 / math.pi:.3g} revolutions a minute, fast for a top: was it in rpm? "
            f"{fastest:g} rpm are {fastest * math.pi / 30.0:.4g} rad/s"
        )

    def bounds(self) -> Iterator[Bound]:
        yield Bound(self.theta, "theta", at_least=0.0, at_most=math.pi, unit="rad")
        yield Bound(self.spin, "spin")
        yield Bound(self.eta, "eta", at_least=-math.pi, at_most=math.pi, unit="rad")
        if self.place is not None:
            yield Bound(self.eta, "eta", at_least=0.0, at_most=0.0, why="place is given")
        yield Bound(self.azimuth, "azimuth")
        for name in ("place", "velocity", "angular_velocity"):
            for k, number in enumerate(getattr(self, name) or ()):
                yield Bound(number, f"{name}[{k}]")


# The state of a top in contact, and its parts by name.
#
# In the arena's moving frame (t1, t2, n): velocity (u1, u2) of the centre of mass along the arena [m/s], axis (e1, e2,
# e3) [1], angular momentum (L1, L2, L3) about the centre of mass [kg m^2/s], then the arena's place. The components are
# along axis 0.

#: Indices of the parts in a state.
VELOCITY, AXIS, MOMENTUM, PLACE = slice(0, 2), slice(2, 5), slice(5, 8), slice(8, None)

#: Index of the component of the axis along n, cos(theta).
COS_THETA = 4


class Parts(NamedTuple):
    """The parts of a state."""

    velocity: Tangent
    axis: Vector
    momentum: Vector
    place: tuple[Component, ...]


def parts(state: Float[Array, "components ..."]) -> Parts:
    """Split a state into its parts."""
    u1, u2, e1, e2, e3, L1, L2, L3, *place = (state[k] for k in range(len(state)))
    return Parts((u1, u2), (e1, e2, e3), (L1, L2, L3), tuple(place))


def joined(*vectors: tuple[Component, ...]) -> Float[Array, "components ..."]:
    """The state made of its parts, in order; a component is a scalar or has one number per lane."""
    return jnp.stack(jnp.broadcast_arrays(*(component for part in vectors for component in part)))


def inclination(axis: Vector) -> Float[Array, "..."]:
    """The angle theta [rad] from the arena's normal to the axis, in [0, pi]."""
    return jnp.arctan2(planar_length(axis[0], axis[1]), axis[2])


def angular_velocity(body: Any, axis: Vector, momentum: Vector) -> Vector:
    """w = L / I1 + (1 / I3 - 1 / I1) (L.e) e [rad/s].

    **Arguments:** `body`: a body with the moments of inertia `I1` and `I3` [kg m^2].
    """
    factor = (1.0 / body.I3 - 1.0 / body.I1) * dot(momentum, axis)
    return sum_vectors(scale(1.0 / body.I1, momentum), scale(factor, axis))
