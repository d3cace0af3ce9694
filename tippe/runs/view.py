"""The drawing of a run, its page with sliders, and the plot of the main job."""

import dataclasses
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Generic, NamedTuple, TypeVar

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from nonholonomic import views
from nonholonomic.hybrid import HybridOutcome
from nonholonomic.integration import Settings
from nonholonomic.integration.problem import CROSSED, REACHED_END, Status
from nonholonomic.parameters import numbers, numbers_of, with_numbers
from nonholonomic.runs.event import Ensemble
from nonholonomic.runs.model import Sliders
from nonholonomic.runs.table import at_the_end
from nonholonomic.runs.trajectory import (
    TOLERANCE,
    explore_model,
    live_run,
    page_of,
    runs_at_ends,
    sliders_of,
    stages_of,
)
from nonholonomic.sweeps import chunk_for
from nonholonomic.terminal import status_line
from nonholonomic.text import Unit, readable_unit
from nonholonomic.views.explore import Frame, LiveRun, Summary, quaternion

from ..friction import NoSlip
from ..model.body import AbstractBody, Top
from ..model.rigid import AbstractRigidBody
from ..model.scene import Launch, Scene
from ..modes.plane import Slide
from .launches import check_reversible, check_run, event_of
from .model import TopModel
from .observables import OF_RIGID_BODIES, QUANTITIES, AbstractTrajectory, names_of

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
    def of(run: AbstractTrajectory) -> "DrawnMotion[Array]":
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


def motion(run: AbstractTrajectory) -> DrawnMotion[np.ndarray]:
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


def show(scene: Scene, motion: DrawnMotion[np.ndarray], number: int, name: str) -> views.Show:
    """The drawing of one run, the `number`-th of its stage."""
    body, colour = scene.body, views.COLOURS[number % len(views.COLOURS)]
    motion = DrawnMotion(*(np.asarray(part)[np.isfinite(motion.theta)] for part in motion))
    radius, weight = float(body.size), float(body.mass * scene.gravity)
    arrow_start = motion.contact + 0.02 * radius * motion.normal
    return views.Show(
        name,
        colour,
        motion.times,
        motion.normal,
        radius,
        (views.Body("top", motion.position, views.turned(motion.rotation), meshes(body, colour)),),
        (
            views.Trace("contact", arrow_start, GREEN, 0.06 * radius),
            views.Trace("path of the axis", AXIS * radius * motion.axis, BLUE, 0.012 * radius, motion.position, False),
        ),
        arrows(motion, float(body.offset) if isinstance(body, Top) else 0.0, radius, weight),
        (
            views.Curve("θ, normal to axis [rad]", motion.theta),
            views.Curve(QUANTITIES["energy"].label, motion.energy),
            views.Curve(*curve_of_rotation(scene, motion)),
            views.Curve(QUANTITIES["normal_force"].label, motion.normal_force),
        ),
    )


def curve_of_rotation(scene: Scene, motion: DrawnMotion[Numbers]) -> tuple[str, Any]:
    """Label and values of the curve of the rotation: Jellett's quantity, or, for a body of any shape and inertia, the spin
    about the normal."""
    if isinstance(scene.body, AbstractRigidBody):
        return OF_RIGID_BODIES["normal_spin"].label, (motion.angular_velocity * motion.normal).sum(axis=-1)
    return QUANTITIES["jellett"].label, motion.jellett


def arrows(motion: DrawnMotion[np.ndarray], offset: float, radius: float, weight: float) -> tuple[views.Arrow, ...]:
    """Forces and slip at the contact, weight, angular velocity and momentum at the centre of mass."""
    arrow_start = motion.contact + 0.02 * radius * motion.normal
    centre = motion.position - offset * motion.axis
    speed = np.linalg.norm(motion.slip, axis=-1)
    common = max(float(np.quantile(speed, COMMON_SLIP)), 1e-12)
    weight_vector = np.broadcast_to([0.0, 0.0, -weight], centre.shape)
    push, width = motion.normal_force[:, None] * motion.normal, 0.05 * radius
    arrows = [
        views.Arrow("normal force", arrow_start, push, "N", WEIGHT * radius / weight, VIOLET, width, through=True),
        views.Arrow("slip", arrow_start, motion.slip, "m/s", SLIP * radius / common, GOLD, width, SLIP * radius),
    ]
    for name, vector, unit, length, colour in (
        ("weight at the centre of mass", weight_vector, "N", WEIGHT, BLACK),
        ("angular velocity", motion.angular_velocity, "rad/s", SPIN, TEAL),
        ("angular momentum", motion.angular_momentum, "kg m²/s", SPIN, PINK),
    ):
        scale = length * radius / max(float(np.linalg.norm(vector, axis=-1).max()), 1e-300)
        arrows.append(views.Arrow(name, centre, vector, unit, scale, colour, width, None, True, False))
    return tuple(arrows)


@stages_of.register(AbstractTrajectory)
def _(run: AbstractTrajectory, runs: list[AbstractTrajectory], overlaid: bool, unit: Unit) -> list[views.Stage]:
    drawn = [(name, run.scene, motion(run)) for name, run in zip(names_of(runs, unit), runs, strict=True)]
    return stages([drawn] if overlaid else [[one] for one in drawn])


def stages(groups: list[list[tuple[str, Scene, DrawnMotion]]]) -> list[views.Stage]:
    """A stage for each group of runs on a common arena, with their names; all runs have different colours."""
    all_stages, number = [], 0
    for group in groups:
        (_, scene, first), radius = group[0], float(group[0][1].body.size)
        points = np.concatenate([motion.contact for _, _, motion in group])
        ground = views.arena(scene.surface, points, first.normal[0], 4.0 * radius, 2.5 * radius)
        shows = views.distinguished_by_colour(
            tuple(show(of_run, motion, number + k, name) for k, (name, of_run, motion) in enumerate(group))
        )
        all_stages.append(views.Stage("; ".join(name for name, _, _ in group), ground, shows))
        number += len(group)
    return all_stages


def meshes(body: AbstractBody | AbstractRigidBody, colour: int) -> tuple[views.Mesh, ...]:
    """The body in two colours; a top has its stem, or a short stem that only shows the axis."""
    if isinstance(body, AbstractRigidBody):
        return tuple(
            mesh._replace(vertices=touching(body, mesh.vertices)) for mesh in views.ball(1.0, (colour, views.PALE))
        )
    if not isinstance(body, Top):
        return views.striped(profile(body), (colour, views.PALE))
    radius = float(body.radius)
    if body.stem is None:
        sphere = views.ball(radius, (colour, views.PALE))
        return (
            *sphere,
            views.rod(0.10 * radius, 0.9 * radius, AXIS * radius - 0.16 * radius, 0.16 * radius, views.DARK),
        )
    knob, end = float(body.stem.radius), float(body.stem.offset - body.offset)
    return (
        *views.striped(truncated(radius, knob, end), (colour, views.PALE)),
        views.rod(0.999 * knob, 0.0, end, knob, views.DARK),
    )


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
    sphere = radius * np.stack([np.sin(polar), np.cos(polar)], axis=-1)
    return np.concatenate([[[0.0, sphere[0, 1]]], sphere])


def profile(body: AbstractBody) -> Float[np.ndarray, "points 2"]:
    """The meridian of a body about its centre of mass, from the top of its axis down: (distance from the axis, height) [m]."""
    theta = jnp.linspace(jnp.pi, 0.0, 49)
    lever = body.meridian.at(jnp.cos(theta))
    return np.stack([lever.radius * jnp.sin(theta), lever.offset - lever.radius * jnp.cos(theta)], axis=-1)


# A page with sliders that simulates a top in the browser.

#: Drawn radius of a level plane about the start of a run with flights, in units of sqrt(g R) t1.
REACH = 0.5

#: The words for the statuses of runs that end with a reversal of the spin.
REVERSED = {int(Status.INVERTED): "reversed", int(Status.NOT_INVERTED): "not_reversed"}


@status_line("writing a page")
def explore(
    scene: Scene,
    launch: Launch,
    path: str | Path | None = None,
    sliders: Sliders | None = None,
    t1: float = 8.0,
    unit: Unit = None,
) -> views.Page:
    """Make a page with sliders that simulates the top in the browser while you move a slider. The page is one file that
    needs no network; a notebook shows the returned `Page`. The equations of motion, the Runge-Kutta pair, the step-size
    control and the location of the event are generated from those of `inversion_table`, or, under `NoSlip`, of
    `reversal_table`, so times and statuses are the same, at a tolerance of 1e-7. The page also computes a map of these
    times over two of the sliders; click on the map to set both. The address of the page contains the slider values, so
    that you can copy a link to a run. Press space to play or pause, and r to reset the sliders.

    **Arguments:**

    - `scene`, `launch`: the run at the start; all numbers must be scalars.
    - `path`: file to write the page to, or `None`.
    - `sliders`: name of a parameter -> (lowest, highest) value. The end of a name is enough if only one parameter
      matches, such as "theta", "spin", "mu", "friction.mu" or "offset". By default theta, spin, the coefficient of
      friction and, for a top without a stem, the offset; under `NoSlip` theta and spin in both senses.
    - `t1`: horizon [s].
    - `unit`: unit of the curves, such as "deg" for all angles.

    **Returns:** a `Page`, with its `html`.

    **Raises:** `ValueError` for arguments out of range, an unknown slider, or equations with an operation of JAX that cannot
    be written in JavaScript; `ModuleNotFoundError` if the library for views is not installed; `OSError` if the file cannot be
    written.

    **Example:** a page with two sliders.

    ```
    >>> import tippe
    >>> top = tippe.Top(mass=0.02, radius=0.02, offset=0.006, I1=2.994e-6, I3=3.2e-6)
    >>> scene = tippe.Scene(top, friction=tippe.Viscous(0.3))
    >>> page = tippe.explore(scene, tippe.Launch(0.1, 155.0), sliders={"theta": (0.05, 0.5), "spin": (60.0, 200.0)})
    >>> len(page.html) < 2.5e6
    True

    ```
    """
    check_run(scene, launch, t1, TOLERANCE)
    return explore_model(TopModel(scene=scene, launch=launch), path, sliders, float(t1), unit)


@page_of.register(TopModel)
def _(model: TopModel, sliders: Sliders | None, t1: float) -> tuple[LiveRun, views.Stage]:
    live = page_of_launch(model, sliders, t1)
    if model.scene.contact == "hybrid" and model.scene.level:
        return live, stage_at_start(model, t1)
    # The first run, on a part of the arena that also contains the others.
    runs = runs_at_ends(model, live.sliders, t1)
    (first,), surface, size = runs[0].stages(), runs[0].scene.surface, float(runs[0].scene.body.size)
    points = np.concatenate([motion(run).contact for run in runs])
    return live, first._replace(arena=views.arena(surface, points, first.arena.normal, 4.0 * size, 2.5 * size))


def page_of_launch(model: TopModel, sliders: Sliders | None, t1: float) -> LiveRun:
    """The contents of the page. **Arguments:** `model`: without an event; the others as for `explore`."""
    scene, launch = model.scene, model.launch
    # A body that rolls keeps its energy: it does not invert, and the page shows times of reversal.
    reverses = isinstance(scene.friction, NoSlip)
    if reverses:
        check_reversible(launch, {})
    # The position of the stem's end is relative to the centre of mass, so another offset would change the shape.
    paths_drawn = ("scene.body.stem.", "scene.body.offset") if scene.has_stem else ()
    knobs = sliders_of(model, default_ranges(scene, launch) if sliders is None else sliders, paths_drawn)
    is_rigid = isinstance(scene.body, AbstractRigidBody)
    answer = "time until its stem carries it" if scene.has_stem else "inversion time"
    quantities = QUANTITIES | OF_RIGID_BODIES
    return live_run(
        TopModel.of(scene, launch),
        model,
        knobs,
        float(t1),
        outcome,
        lambda drawn, time, rows, mode: frame(drawn.scene, drawn.moment(rows, mode)),
        title=f"{'Rigid body' if is_rigid else 'Tippe top'} on a {type(scene.surface).__name__.lower()}",
        answer=("reversal time" if reverses else answer, "s"),
        words=REVERSED if reverses else None,
        summaries=tuple(
            Summary(quantities[name].long_name, readable_unit(quantities[name].unit), row)
            for row, name in enumerate(("energy", "normal_spin" if is_rigid else "jellett"), start=1)
        ),
    )


def default_ranges(scene: Scene, launch: Launch) -> dict[str, tuple[float, float]]:
    """The default sliders: theta, spin, friction, and the offset of a top without a stem, around their own values."""
    theta, spin = float(launch.theta), float(launch.spin)
    if isinstance(scene.friction, NoSlip):
        return {
            "theta": (0.25 * theta, 4.0 * theta) if theta > 0.0 else (0.0, 0.1),
            "spin": (-1.4 * abs(spin), 1.4 * abs(spin)),
        }
    ranges = {"theta": (min(0.02, theta), max(0.6, theta)), "spin": tuple(sorted((0.4 * spin, 1.4 * spin)))}
    if spin == 0.0:
        ranges["spin"] = (0.0, 200.0)
    values, parts = numbers("scene", scene), {"mu": (0.1, 3.0)} | ({} if scene.has_stem else {"offset": (0.5, 1.5)})
    for name, (low, high) in parts.items():
        path = next((path for path in values if path.endswith(f".{name}")), None)
        if path is not None and values[path] > 0.0:
            value, most = float(values[path]), 0.9 * float(scene.body.size) if name == "offset" else math.inf
            ranges[path] = (low * value, min(high * value, most))
    return ranges


def outcome(model: TopModel, ended: HybridOutcome) -> tuple[Int[Array, ""], Float[Array, ""]]:
    """The `Status` of a run that ends with the inversion, and its inversion time [s], or infinity."""
    status = model.ended(ended, TOLERANCE)[0]
    for code, word in ((Status.EVENT, Status.INVERTED), (Status.COMPLETED, Status.NOT_INVERTED)):
        status = jnp.where(status == int(code), int(word), status)
    return status, jnp.where(ended.status[0] == CROSSED, ended.crossing_time[0], jnp.inf)


def stage_at_start(model: TopModel, t1: float) -> views.Stage:
    """The top on a level plane at its launch; the page replaces it by a simulated run before it is visible."""
    scene = model.scene
    start = DrawnMotion(*(np.repeat(np.asarray(part), 2, axis=0) for part in _motion_at_start(model)))
    initial_show, size = show(scene, start._replace(times=np.array([0.0, 1.0])), 0, ""), float(scene.body.size)
    # Slips grow as the top rises; a slip at half the speed of the equator gets the longest arrow.
    normal_force, slip, *arrows = initial_show.arrows
    assert slip.limit is not None
    fastest = 0.5 * size * float(np.linalg.norm(start.angular_velocity[0]))
    slip = slip._replace(scale=slip.limit / max(fastest, 1e-12))
    initial_show = initial_show._replace(arrows=(normal_force, slip, *arrows))
    reach = REACH * math.sqrt(float(scene.gravity) * size) * t1
    ground = views.arena(scene.surface, start.contact, start.normal[0], max(reach, 10.0 * size), 2.5 * size)
    return views.Stage("", ground, (initial_show,), follows=True)


@eqx.filter_jit
def _motion_at_start(model: TopModel) -> DrawnMotion[Array]:
    modes, number, state = model.modes(1, jnp.asarray(TOLERANCE), None, False)
    # The other tops stand on their stem.
    mode = dataclasses.replace(modes[0], number=number) if isinstance(modes[0], Slide) else modes[0]
    return DrawnMotion.of(model.moment(mode.shown(state), number))


def frame(scene: Scene, run: AbstractTrajectory) -> Frame:
    """The drawn quantities of a top for a run with a single time, in the order of `view.show`."""
    motion = DrawnMotion(*(part[0] for part in DrawnMotion.of(run)))
    radius = scene.body.size
    arrow_start = motion.contact + 0.02 * radius * motion.normal
    offset = scene.body.offset if isinstance(scene.body, Top) else 0.0
    centre = motion.position - offset * motion.axis
    weight = jnp.stack([jnp.zeros(()), jnp.zeros(()), -scene.body.mass * scene.gravity])
    return Frame(
        normal=motion.normal,
        bodies=((motion.position, quaternion(motion.rotation)),),
        traces=((arrow_start, None), (AXIS * radius * motion.axis, motion.position)),
        arrows=(
            (arrow_start, motion.normal_force * motion.normal),
            (arrow_start, motion.slip),
            (centre, weight),
            (centre, motion.angular_velocity),
            (centre, motion.angular_momentum),
        ),
        curves=(motion.theta, motion.energy, curve_of_rotation(scene, motion)[1], motion.normal_force),
        turning_rate=jnp.linalg.norm(motion.angular_velocity),
    )


# The plot of the main job: theta(t) of every launch, as in the papers' figures 2 and 3 (needs matplotlib), and theta(t) of
# a launch with flights.

Values = Float[np.ndarray, "..."]


class Panel(NamedTuple):
    """One arena and place: its title, times [s], theta [rad] of every launch (launches, times), theta(0), and the times
    of the dots."""

    title: str
    times: Values
    theta: Values
    starts: Values
    ends: Values


def draw_launches(panels: list[Panel], angle: float, dots: str) -> Any:
    """Draw theta(t) of every launch, a panel for each arena and place.

    **Arguments:**

    - `panels`: the panels; `ends` are the times [s] that get a dot, if finite.
    - `angle`: angle [rad] that counts as inverted; `dots`: description of the dots, above the plot.

    **Returns:** a matplotlib figure.
    """
    from matplotlib import colormaps
    from matplotlib.figure import Figure

    figure = Figure(figsize=(13.0 if len(panels) > 1 else 8.0, 4.2), layout="constrained")
    drawings = figure.subplots(1, len(panels), sharey=True, squeeze=False)[0]
    for drawing, panel in zip(drawings, panels, strict=True):
        colours = colormaps["viridis"](np.linspace(0.0, 0.92, len(panel.starts)))
        for theta, start, end, colour in zip(panel.theta, panel.starts, panel.ends, colours, strict=True):
            drawing.plot(panel.times, theta, color=colour, label=f"{start:.4g}", linewidth=1.2)
            if np.isfinite(end):
                dot = {"color": colour, "markersize": 9, "markeredgecolor": "black", "zorder": 3}
                drawing.plot(end, np.interp(end, panel.times, theta), "o", **dot)
        drawing.axhline(angle, color="0.5", linewidth=0.8, linestyle="--")
        drawing.set_title(panel.title)
        drawing.set_xlabel("time [s]")
        drawing.set_yticks([0.0, np.pi / 2.0, np.pi], ["0", "π/2", "π"])
    drawings[0].set_ylabel("θ, angle from the normal to the stem [rad]")
    figure.suptitle(dots, fontsize=9, color="0.4")
    if len(panels[-1].starts) > 1:
        drawings[-1].legend(title="θ(0) [rad]", loc="center left", bbox_to_anchor=(1.01, 0.5))
    return figure


def theta_over_time(
    scene: Scene, launch: Launch, times: Float[np.ndarray, " times"], tolerance: float, axes: Sequence[str]
) -> Float[np.ndarray, " times"]:
    """theta [rad] of one launch at the given increasing times, also in flight. A program that has computed a table
    compiles nothing more for its plot, whereas `simulate` compiles fifty programs.

    All cells of a table run this launch. Each cell runs to the first time of its own part of the times, and from there
    from time to time.

    **Arguments:** `axes`: full names of the parameters along the axes of that table, such as "launch.theta".
    """
    roots = {"scene": scene, "launch": launch}
    values, size, settings = numbers_of(roots), chunk_for(1), Settings(tolerance)
    cells = with_numbers(roots, {name: np.full(size, float(values[name])) for name in axes})
    model = TopModel.timed(**cells, angle=event_of(scene, None))
    ensemble = Ensemble.of(model, size, settings.tolerance, False)
    # No inclination exceeds pi, so no run ends before its time, in the programs of the table.
    never = {"cos_angle": jnp.asarray(-1.0)} | ({"stem_counts": jnp.zeros(())} if scene.has_stem else {})
    modes = tuple(dataclasses.replace(mode, **never) for mode in ensemble.modes or ())
    ensemble = dataclasses.replace(ensemble, modes=modes)
    parts = -(-len(times) // size)
    ends = np.pad(times, (0, size * parts - len(times)), mode="edge").reshape(size, parts)
    rows, goes = [], np.ones(size, bool)
    for spans in np.diff(ends, axis=1, prepend=0.0).T:
        outcome: Any = ensemble.solve(spans, size, settings)
        assert isinstance(outcome, HybridOutcome)
        theta = np.asarray(at_the_end(model, ensemble, outcome, settings.tolerance)[1]["end_theta"])
        rows.append(theta if not rows else np.where(goes, theta, rows[-1]))
        goes &= outcome.status == REACHED_END
        ensemble = dataclasses.replace(ensemble, states=outcome.state, first=outcome.mode)
    return np.stack(rows, axis=1).ravel()[: len(times)]
