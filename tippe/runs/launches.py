"""Launches of a table, the events of a top, and their checks."""

import math
from collections import Counter
from collections.abc import Collection, Iterable
from typing import Any

import numpy as np
from jaxtyping import Array, Float

from nonholonomic.integration.problem import require_run
from nonholonomic.parameters import full_axes, numbers, with_numbers
from nonholonomic.runs.model import Number
from nonholonomic.sweeps import Axis, axis
from nonholonomic.text import shown
from nonholonomic.validation import IN_DEGREES, as_number, is_traced, require, require_kind, warn

from ..friction import Frictionless
from ..model.body import Top
from ..model.rigid import AbstractRigidBody
from ..model.scene import Launch, Scene
from ..modes.problems import StemContact

# The events of a top, and checks of the arguments of a run, before anything compiles and inside a program.

#: The inclination [rad] at which a body without a stem counts as turned over.
INVERTED = 0.95 * math.pi


def event_of(scene: Scene, angle: Any) -> Float[Array, "..."] | StemContact:
    """The event of a run: theta reaches the angle [rad]; or, without an angle, the top has turned over.

    A top with a stem has turned over when its stem first carries it: when the stem bears a force or, as it lands, an
    impulse. In flight nothing carries the top, whatever theta. No angle defines this event, because after a hop the stem
    lands at a larger theta, and in a curved arena `Top.stem_angle` is not exactly the angle of the contact.
    """
    if angle is None and scene.has_stem:
        return StemContact()
    return as_number(INVERTED if angle is None else angle)


def angle_of(scene: Scene, angle: Any) -> Float[Array, "..."]:
    """The angle [rad] itself; or, without an angle, the inclination beyond which the top has turned over on a level
    plane."""
    event = event_of(scene, angle)
    return scene.body.stem_angle if isinstance(event, StemContact) else event


#: The most turns a second by hand: greater spins are not taken for turns a second.
MOST_TURNS = 50.0

#: Advice in messages about lists, where a table is the better choice.
LISTS = "inversion_table takes lists, and jax.vmap maps over them"


def check_run(scene: Any, launch: Any, t1: Number, tolerance: Number, lists: str = LISTS) -> None:
    """Raise `ValueError` unless the arguments are a scene, a launch that the scene allows, a positive horizon and a
    legal tolerance.

    **Arguments:** as for `require_run`.
    """
    require_run(scene, launch, t1, tolerance, (Scene, Launch), lists)
    scene.check_start(launch)


def warn_if_it_cannot_invert(scene: Scene, launch: Launch, theta: Any, spin: object, angle: Any) -> None:
    """Warn if the scene has no friction, if the top stands exactly upright on a level plane or is inverted already, or if
    it is too slow to turn over, and would not be if its spin were in turns a second.

    **Arguments:** `launch`: its theta and its spin are ignored; `theta`: one angle or several [rad]; `spin`: one or
    several [rad/s]; `angle`: the angle to be reached, or `None` (see `event_of`).
    """
    if isinstance(scene.friction, Frictionless):
        warn(
            "friction = Frictionless(): without friction no top turns over; give the scene a law, such as "
            "tippe.Scene(top, friction=tippe.Viscous(0.3))"
        )
    limit = angle_of(scene, angle)
    if isinstance(scene.body, AbstractRigidBody) or is_traced(theta) or is_traced(limit):
        return
    if np.any(np.asarray(theta) >= np.min(limit)):
        start = np.max(np.asarray(theta))
        on_stem = angle is None and scene.has_stem
        reached = "the angle at which the stem touches a level plane" if on_stem else "the angle to be reached"
        warn(
            f"theta = {start:g} rad is not below {reached}, {float(np.min(limit)):.4g} rad: the top "
            f"{'stands on its stem' if on_stem else 'is inverted'} from the start{IN_DEGREES.format(f'{start:g}')}"
        )
    at_rest = launch.velocity is None and launch.angular_velocity is None
    if scene.level and at_rest and np.any(np.asarray(theta) == 0.0):
        warn("theta = 0.0 is exactly upright, where a top stays forever: launch it at a small angle, such as 0.01 rad")
    if not isinstance(scene.body, Top) or not at_rest or is_traced((scene, spin)):
        return
    # The spin of which Jellett's constant is that of the tumbling top at the angle (`steady.tumbling`).
    body, fastest = scene.body, float(np.max(np.abs(np.asarray(spin))))
    mass, R, a, I1, I3 = (float(getattr(body, name)) for name in body.units)
    end, start = (float(np.cos(np.min(inclination))) for inclination in (limit, theta))
    if abs(I1 - I3) * R < I3 * a and start * R > a and fastest <= MOST_TURNS:
        precession = math.sqrt(mass * float(scene.gravity) * a / (I3 * (a / R - end) + I1 * end))
        slowest = R * (I1 * (1.0 - end**2) + I3 * (end - a / R) ** 2) * precession / (I3 * (R * start - a))
        if fastest < slowest < 2.0 * math.pi * fastest:
            advice = f"was it in turns a second? {fastest:.4g} turns a second are {2.0 * math.pi * fastest:.4g} rad/s"
            warn(f"spin = {fastest:.4g} rad/s is slow: this top needs about {slowest:.3g} rad/s to turn over; {advice}")


def check_smooth(scene: Scene, caller: str) -> None:
    """Raise `ValueError` for a scene with hybrid runs, which do not support derivatives here."""
    if scene.contact == "hybrid":
        raise ValueError(f"contact = 'hybrid' must be 'stop' for {caller}; inversion_table supports flights")
    if scene.friction.set_valued:
        kind = type(scene.friction).__name__
        raise ValueError(
            f"friction = {kind} must be a law with a single mode for {caller}; inversion_table supports others"
        )


def check_reversible(launch: Launch, values: dict[str, Any]) -> None:
    """Raise `ValueError` for a launch without spin, because there is no spin to reverse.

    **Arguments:** `values`: full name of a number -> values in place of the launch's own.
    """
    spin = values.get("launch.spin", launch.spin)
    if launch.angular_velocity is None and not is_traced(spin) and np.any(np.asarray(spin) == 0.0):
        raise ValueError("spin = 0.0 must not be zero: a spin of zero cannot reverse")


def check_event(angle: Any, crossing: Any, known: tuple[str, ...] = ("first", "last")) -> None:
    """Raise `ValueError` unless the angle is `None` or in (0, pi], and the crossing is a known word."""
    if angle is not None:
        require(angle, "angle", above=0.0, at_most=math.pi, unit="rad")
    if angle is not None and np.ndim(angle) != 0:
        raise ValueError(f"angle must be one number, not of shape {np.shape(angle)}")
    if crossing not in known:
        raise ValueError(f"crossing = {shown(crossing)} must be {' or '.join(map(repr, known))}")


def require_rigid(scene: Scene) -> None:
    """Raise `ValueError` unless the body can reverse its spin."""
    if not isinstance(scene.body, AbstractRigidBody):
        kind = type(scene.body).__name__
        raise ValueError(
            f"body = {kind} must be an Ellipsoid or a RigidBody for times of reversal: a body of revolution keeps its "
            "sense of rotation"
        )


# Build and check the grid of launches and scenes of a table.

UNITS = Top.units | Scene.units | Launch.units

#: Descriptions of the axes.
LONG_NAMES = {"theta": "θ(0)", "eta": "η(0)", "azimuth": "φ(0)", "spin": "spin ω₃(0)", "mu": "friction μ"}
LONG_NAMES |= {"mass": "mass m", "radius": "radius", "offset": "offset a", "equatorial": "equatorial half axis b"}
LONG_NAMES |= {"polar": "polar half axis p", "I1": "moment of inertia I₁", "I3": "moment of inertia I₃"}
LONG_NAMES |= {"gravity": "gravity g", "slip_speed": "slip speed", "restitution": "restitution e_N"}

#: The parts of a launch that consist of several numbers: the name of an axis along each number, and its unit.
SEVERAL = {
    "velocity": [(f"velocity_{axis}", "m s-1") for axis in ("t1", "t2")],
    "angular_velocity": [(f"angular_velocity_{axis}", "rad s-1") for axis in ("t1", "t2", "n")],
}

#: Parameters of a launch that can be varied.
NUMBERS_OF_A_LAUNCH = [f"launch.{name}" for name in ("theta", "spin", "eta", "azimuth")]
NUMBERS_OF_A_LAUNCH += [
    f"launch.{name}[{k}]"
    for name, count in (("place", 3), ("velocity", 2), ("angular_velocity", 3))
    for k in range(count)
]


def variable_numbers(scene: Scene) -> list[str]:
    """The full names of a scene's parameters that can be varied: single numbers, including omitted ones, which are
    0."""
    names = [name for name, value in numbers("scene", scene).items() if np.ndim(value) == 0]
    return [name for name in names if name != "scene.restitution" or scene.contact == "hybrid"]


def labels(
    scene: Scene, launch: Launch, names: Iterable[str], taken: Collection[str]
) -> dict[str, tuple[str, str, str]]:
    """For each full name of a parameter the name of an axis, its unit, and a description. The name of the axis is the last
    part of the full name, or the full name if another of the `names` has the same last part or if it is `taken`."""
    coordinates = list(scene.surface.coordinates)
    if "launch.place[2]" in numbers("launch", launch) and len(coordinates) == 2:
        coordinates = [("x", "m"), ("y", "m"), ("z", "m")]
    components = {
        f"launch.{name}[{k}]": label
        for name, parts in {"place": coordinates, **SEVERAL}.items()
        for k, label in enumerate(parts)
    }
    units = UNITS | scene.body.units | scene.friction.units
    shorts = {name: name.rsplit(".", 1)[-1] for name in names}
    shorts |= {name: label for name, (label, _) in components.items() if name in shorts}
    # `place` replaces the argument `eta`.
    counts = Counter(short for name, short in shorts.items() if name != "launch.eta" or launch.place is None)
    return {
        name: (
            short if counts[short] == 1 and short not in taken else name,
            components[name][1] if name in components else units.get(short, "1"),
            LONG_NAMES.get(short, short),
        )
        for name, short in shorts.items()
    }


def launches(
    scene: Any, launch_values: dict[str, Any], axes: Any, t1: Number, tolerance: Number, taken: Collection[str] = ()
) -> tuple[dict[str, Any], list[Axis]]:
    """The scene and launch that all cells share, and the axes of the grid.

    **Arguments:**

    - `scene`: the scene; all its numbers must be scalars.
    - `launch_values`: parameter of the launch, or "mu" for the scene's friction -> a number or a list; `None` keeps the
      scene's own `mu`.
    - `axes`: full name of a parameter, or its unambiguous end -> values, or `None`; the numbers of a launch's vectors
      are `"launch.place[0]"` and so on; omitted numbers are 0.
    - `t1`, `tolerance`: as for `inversion_table`.
    - `taken`: names that no axis may have, as for `labels`.

    **Returns:** a dictionary with "scene" and "launch", in which only the numbers that are not axes have their values,
    for `with_numbers`; and the axes, the last varying fastest.

    **Raises:** `ValueError` for arguments out of range or an unknown axis.
    """
    require_kind(scene, "scene", Scene)
    if axes is not None and not (isinstance(axes, dict) and all(isinstance(number, str) for number in axes)):
        raise ValueError(f"axes = {shown(axes)} must be a dictionary, path of a number -> values")
    axes = full_axes(axes or {}, [*variable_numbers(scene), *NUMBERS_OF_A_LAUNCH])
    friction_numbers = numbers("scene.friction", scene.friction)
    of_mu = next((number for number in friction_numbers if number.endswith(".mu")), "scene.friction.mu")
    paths = {name: of_mu if name == "mu" else f"launch.{name}" for name in launch_values}
    values = {paths[name]: value for name, value in launch_values.items() if name != "mu" or value is not None}
    for number in values:
        if number in axes:
            raise ValueError(f"axes: {number!r} has its own argument")
    values |= axes
    scalars = {number: value for number, value in values.items() if np.ndim(value) == 0}
    # A launch with entries for all given numbers.
    sizes = {name: len(parts) for name, parts in SEVERAL.items()}
    sizes["place"] = 3 if "launch.place[2]" in values else len(scene.surface.coordinates)
    parts = {name: [f"launch.{name}[{k}]" for k in range(size)] for name, size in sizes.items()}
    vectors = {
        name: tuple(scalars.get(part, 0.0) for part in own) for name, own in parts.items() if set(own) & set(values)
    }
    angles = {name: scalars.get(f"launch.{name}", 0.0) for name in ("theta", "spin", "eta", "azimuth")}
    launch = Launch(**angles, **vectors)
    names = labels(scene, launch, values, taken)
    listed = [(number, *names[number]) for number in values if number not in scalars]
    grid = [axis(name, number, unit, values[number], long_name) for number, name, unit, long_name in listed]
    of_scene = {number: value for number, value in scalars.items() if not number.startswith("launch.")}
    roots = with_numbers({"scene": scene}, of_scene) | {"launch": launch}
    # The numbers of axes are 0 here, which may not be a place on the arena; starts are checked cell by cell.
    require_run(roots["scene"], roots["launch"], t1, tolerance, (Scene, Launch), LISTS)
    return roots, grid
