"""The quantities of a top with units and names, and the drawing of a run."""

from collections.abc import Sequence
from typing import Any, Generic, NamedTuple, TypeVar

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from nonholonomic.parameters import description
from nonholonomic.sweeps import Quantity, Table, chosen, run_table
from nonholonomic.text import distinguishing_labels, in_unit
from nonholonomic.validation import require_one_run
from nonholonomic.views import (
    COLOURS,
    DARK,
    PALE,
    Arrow,
    Body,
    Curve,
    Mesh,
    Show,
    Stage,
    Trace,
    arena,
    ball,
    distinguished_by_colour,
    rod,
    striped,
    turned,
)

from ..model.body import AbstractBody, Top
from ..model.rigid_body import AbstractRigidBody
from ..model.scene import Scene

# The quantities of a run of a tippe top, with units and names, and the table of a run.

#: What a quantity may need in addition to the state: a frame that does not turn about n; the path on a curved arena, or on
#: any arena; the rotation about the axis and the work; the start of the run.
DIRECTION, ON_CURVED, PATH, PASSIVE, START = (
    frozenset({name}) for name in ("direction", "curved", "path", "passive", "start")
)

QUANTITIES = {
    "theta": Quantity("rad", "inclination θ"),
    "eta": Quantity("rad", "place η", needs=ON_CURVED),
    "azimuth": Quantity("rad", "azimuth φ", needs=DIRECTION),
    "spin": Quantity("rad s-1", "spin ω₃"),
    "theta_rate": Quantity("rad s-1", "θ'"),
    "energy": Quantity("J", "energy"),
    "jellett": Quantity("kg m3 s-1", "Jellett's quantity"),
    "normal_force": Quantity("N", "normal force"),
    "axis": Quantity("1", "axis e", "component", needs=DIRECTION | ON_CURVED),
    "position": Quantity("m", "position of the centre", "component", needs=DIRECTION | PATH),
    "velocity": Quantity("m s-1", "velocity of the centre", "component", needs=DIRECTION | ON_CURVED),
    "angular_momentum": Quantity("kg m2 s-1", "angular momentum", "component", needs=DIRECTION | ON_CURVED),
    "slip": Quantity("m s-1", "slip velocity", "tangent", needs=DIRECTION),
    "jellett_drift": Quantity("1", "relative drift of Jellett's quantity", needs=START),
    "spin_angle": Quantity("rad", "spin angle", needs=PASSIVE),
    "work": Quantity("J", "work of friction", needs=PASSIVE),
}

#: Quantities of a body of any shape and inertia.
OF_RIGID_BODIES = {
    "normal_spin": Quantity("rad s-1", "spin about the normal"),
    "grip": Quantity("1", "friction over normal force"),
    "reaction": Quantity("N", "force of the arena", "component", needs=DIRECTION | ON_CURVED),
}

#: Names of components: in the fixed frame, and in the moving frame.
COMPONENTS = {"component": ("x", "y", "z"), "tangent": ("t1", "t2")}


def quantities_of(scene: Any) -> dict[str, Quantity]:
    """The quantities of runs in a scene."""
    return QUANTITIES | OF_RIGID_BODIES if isinstance(scene.body, AbstractRigidBody) else QUANTITIES


def table_of(run: Any, names: Sequence[str] = ()) -> Table:
    """Quantities of a run, over its times.

    **Arguments:** `run`: a `Trajectory` or a `HybridTrajectory`, not a batch; `names`: as for `chosen`.

    **Raises:** `ValueError` for a batch of runs.
    """
    require_one_run(run, "to_table", "; trajectory_table makes a table of many")
    quantities = chosen(quantities_of(run.scene), names)
    dims = [quantity.components for quantity in quantities.values() if quantity.components is not None]
    coords = {"time": np.asarray(run.t)} | {dim: np.array(COMPONENTS[dim]) for dim in dict.fromkeys(dims)}
    values = {name: np.asarray(quantity.of(name, run)) for name, quantity in quantities.items()}
    request = description("scene", run.scene) | ({} if run.launch is None else description("launch", run.launch))
    request |= {"status": str(run.status), "end_time": float(run.end_time)}
    return run_table(quantities, coords, values, ["time"], request)


# The drawing of a run: body, trace of the contact, path of the axis, arrows, and curves over time.

#: Approximate angle [rad] by which the top turns from frame to frame, and the greatest number of frames.
TURN_PER_FRAME = 0.4
MOST_FRAMES = 12_000
LEAST_FRAMES = 400

#: Lengths in units of the radius: of the drawn axis from the centre, and of the arrows for the weight, for the longest
#: slip, and for the angular velocity and momentum at the start.
AXIS, WEIGHT, SLIP, SPIN = 1.6, 1.5, 2.0, 2.5

#: Slips above this quantile are clipped; otherwise the large slips at the start would make all others invisible.
COMMON_SLIP = 0.9

GREEN, VIOLET, BLUE, GOLD = 0x1F8A4C, 0x7B4FA3, 0x1B6CA8, 0xE0A100
BLACK, TEAL, PINK = 0x23262B, 0x008C95, 0xC2378E


#: JAX's arrays, or NumPy's for drawing.
Numbers = TypeVar("Numbers", Array, np.ndarray)


class DrawnMotion(NamedTuple, Generic[Numbers]):
    """The drawn quantities of a run: vectors in the fixed frame, (times, 3), and the rotation from the body to this
    frame."""

    times: Float[Numbers, " times"]
    position: Float[Numbers, "times 3"]
    axis: Float[Numbers, "times 3"]
    normal: Float[Numbers, "times 3"]
    contact: Float[Numbers, "times 3"]
    slip: Float[Numbers, "times 3"]
    rotation: Float[Numbers, "times 3 3"]
    theta: Float[Numbers, " times"]
    energy: Float[Numbers, " times"]
    jellett: Float[Numbers, " times"]
    normal_force: Float[Numbers, " times"]
    angular_velocity: Float[Numbers, "times 3"]
    angular_momentum: Float[Numbers, "times 3"]

    @staticmethod
    def of(run: Any) -> "DrawnMotion[Array]":
        """The motion of one run, inside or outside of transformations."""
        body, slip = run.scene.body, run.slip
        position, axis, normal, zero = run.position, run.axis, run.normal, jnp.zeros_like(run.t)
        contact: Array = run.contact if not isinstance(body, Top) else position - body.radius * normal
        if isinstance(body, Top) and body.stem is not None:
            stem = position + (body.stem.offset - body.offset) * axis - body.stem.radius * normal
            contact = jnp.where((run.contact == 1)[:, None], stem, contact)
        parts = {"times": run.t, "position": position, "axis": axis, "normal": normal, "contact": contact}
        parts |= {"slip": run._fixed((slip[:, 0], slip[:, 1], zero))}
        return DrawnMotion(**parts, **{name: getattr(run, name) for name in DrawnMotion._fields if name not in parts})


_motion = eqx.filter_jit(DrawnMotion.of)
_rotation_rate = eqx.filter_jit(lambda run: jnp.linalg.norm(run.angular_velocity, axis=-1))


def as_stages(runs: list[Any], overlaid: bool, unit: Any = None) -> list[Stage]:
    """Runs as stages: one stage for each, or a common one for overlaid runs. **Arguments:** `unit`: as for `plot`."""
    motions_by_name = [(name, run.scene, motion(run)) for name, run in zip(names_of(runs, unit), runs, strict=True)]
    return stages([motions_by_name] if overlaid else [[run] for run in motions_by_name])


def names_of(runs: list[Any], unit: Any = None) -> list[str]:
    """Names of runs, by what differs in their launches and scenes. **Arguments:** `unit`: as for `plot`."""
    for run in runs:
        require_one_run(run, "a picture", ", and pass the others as others=")
    (angle, per_angle), (rate, per_rate) = (in_unit(si, unit) for si in ("rad", "rad/s"))
    starts = [
        (f"θ(0) = {per_angle * float(run.theta[0]):.3g} {angle}", f"{per_rate * float(run.spin[0]):.4g} {rate}")
        for run in runs
    ]
    return distinguishing_labels(starts, [run.scene for run in runs], unit=unit)


def motion(run: Any) -> DrawnMotion[np.ndarray]:
    """The motion of one run. If the run can be evaluated between its times, the times are close enough to show the
    rotation."""
    if run.dense is not None:
        times = np.asarray(run.t)
        # The angle about the axis is not enough: half-way up, a top turns about other directions equally fast.
        turned_by = np.trapezoid(np.asarray(_rotation_rate(run.padded()))[: len(times)], times)
        frames = int(np.clip(turned_by / TURN_PER_FRAME, LEAST_FRAMES, MOST_FRAMES))
        run = run.at(np.linspace(0.0, float(run.end_time), frames))
    count = len(run.t)
    return DrawnMotion(*(np.asarray(part)[:count] for part in _motion(run.padded())))


def show(scene: Scene, motion: DrawnMotion[np.ndarray], number: int, name: str) -> Show:
    """The drawing of one run, the `number`-th of its stage."""
    body, colour = scene.body, COLOURS[number % len(COLOURS)]
    motion = DrawnMotion(*(np.asarray(part)[np.isfinite(motion.theta)] for part in motion))
    radius, weight = float(body.size), float(body.mass * scene.gravity)
    arrow_start = motion.contact + 0.02 * radius * motion.normal
    return Show(
        name,
        colour,
        motion.times,
        motion.normal,
        radius,
        (Body("top", motion.position, turned(motion.rotation), meshes(body, colour)),),
        (
            Trace("contact", arrow_start, GREEN, 0.06 * radius),
            Trace("path of the axis", AXIS * radius * motion.axis, BLUE, 0.012 * radius, motion.position, False),
        ),
        arrows(motion, float(body.offset) if isinstance(body, Top) else 0.0, radius, weight),
        (
            Curve("θ, normal to axis [rad]", motion.theta),
            Curve(QUANTITIES["energy"].label, motion.energy),
            Curve(*curve_of_rotation(scene, motion)),
            Curve(QUANTITIES["normal_force"].label, motion.normal_force),
        ),
    )


def curve_of_rotation(scene: Scene, motion: DrawnMotion[Any]) -> tuple[str, Any]:
    """Label and values of the curve of the rotation: Jellett's quantity, or, for a body of any shape and inertia, the spin
    about the normal."""
    if isinstance(scene.body, AbstractRigidBody):
        return OF_RIGID_BODIES["normal_spin"].label, (motion.angular_velocity * motion.normal).sum(axis=-1)
    return QUANTITIES["jellett"].label, motion.jellett


def arrows(motion: DrawnMotion[np.ndarray], offset: float, radius: float, weight: float) -> tuple[Arrow, ...]:
    """Forces and slip at the contact, weight, angular velocity and momentum at the centre of mass."""
    arrow_start = motion.contact + 0.02 * radius * motion.normal
    centre = motion.position - offset * motion.axis
    speed = np.linalg.norm(motion.slip, axis=-1)
    common = max(float(np.quantile(speed, COMMON_SLIP)), 1e-12)
    weight_vector = np.broadcast_to([0.0, 0.0, -weight], centre.shape)
    push, width = motion.normal_force[:, None] * motion.normal, 0.05 * radius
    arrows = [
        Arrow("normal force", arrow_start, push, "N", WEIGHT * radius / weight, VIOLET, width, through=True),
        Arrow("slip", arrow_start, motion.slip, "m/s", SLIP * radius / common, GOLD, width, SLIP * radius),
    ]
    for name, vector, unit, length, colour in (
        ("weight at the centre of mass", weight_vector, "N", WEIGHT, BLACK),
        ("angular velocity", motion.angular_velocity, "rad/s", SPIN, TEAL),
        ("angular momentum", motion.angular_momentum, "kg m²/s", SPIN, PINK),
    ):
        scale = length * radius / max(float(np.linalg.norm(vector, axis=-1).max()), 1e-300)
        arrows.append(Arrow(name, centre, vector, unit, scale, colour, width, None, True, False))
    return tuple(arrows)


def stages(groups: list[list[tuple[str, Scene, DrawnMotion]]]) -> list[Stage]:
    """A stage for each group of runs on a common arena, with their names; all runs have different colours."""
    all_stages, number = [], 0
    for group in groups:
        (_, scene, first), radius = group[0], float(group[0][1].body.size)
        points = np.concatenate([motion.contact for _, _, motion in group])
        ground = arena(scene.surface, points, first.normal[0], 4.0 * radius, 2.5 * radius)
        shows = distinguished_by_colour(
            tuple(show(of_run, motion, number + k, name) for k, (name, of_run, motion) in enumerate(group))
        )
        all_stages.append(Stage("; ".join(name for name, _, _ in group), ground, shows))
        number += len(group)
    return all_stages


def meshes(body: AbstractBody | AbstractRigidBody, colour: int) -> tuple[Mesh, ...]:
    """The body in two colours; a top has its stem, or a short stem that only shows the axis."""
    if isinstance(body, AbstractRigidBody):
        return tuple(mesh._replace(vertices=touching(body, mesh.vertices)) for mesh in ball(1.0, (colour, PALE)))
    if not isinstance(body, Top):
        return striped(profile(body), (colour, PALE))
    radius = float(body.radius)
    if body.stem is None:
        sphere = ball(radius, (colour, PALE))
        return (*sphere, rod(0.10 * radius, 0.9 * radius, AXIS * radius - 0.16 * radius, 0.16 * radius, DARK))
    knob, end = float(body.stem.radius), float(body.stem.offset - body.offset)
    return (*striped(truncated(radius, knob, end), (colour, PALE)), rod(0.999 * knob, 0.0, end, knob, DARK))


def touching(body: AbstractRigidBody, directions: Float[np.ndarray, "points 3"]) -> Float[np.ndarray, "points 3"]:
    """The points of a body's surface at which it has the given outward unit normals, from the centre of mass, in the
    body's axes [m]."""
    normal, zero = tuple(-jnp.asarray(directions).T), jnp.zeros(len(directions))
    return np.stack(body.contact(normal, (zero, zero, zero))[0], axis=-1)


def truncated(radius: float, knob: float, end: float) -> Float[np.ndarray, "points 2"]:
    """The meridian of a ball whose cap is cut off, about its centre, from the flat down.

    The scene does not contain the height of the cut; the rim must not touch the arena before the stem does.
    """
    lower_radius = min(radius * (radius - knob) / end, 0.9 * radius)
    polar = np.linspace(np.arccos((radius - 0.8 * (radius - lower_radius)) / radius), np.pi, 25)
    ball = radius * np.stack([np.sin(polar), np.cos(polar)], axis=-1)
    return np.concatenate([[[0.0, ball[0, 1]]], ball])


def profile(body: AbstractBody) -> Float[np.ndarray, "points 2"]:
    """The meridian of a body about its centre of mass, from the top of its axis down: (distance from the axis, height) [m]."""
    theta = jnp.linspace(jnp.pi, 0.0, 49)
    lever = body.meridian.at(jnp.cos(theta))
    return np.stack([lever.radius * jnp.sin(theta), lever.offset - lever.radius * jnp.cos(theta)], axis=-1)
