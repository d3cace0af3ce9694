"""The drawing of a run, its page with sliders, and the plot of the main job."""

import dataclasses
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from nonholonomic import views
from nonholonomic.hybrid import HybridOutcome
from nonholonomic.integration.problem import REACHED_END, Settings
from nonholonomic.parameters import numbers, numbers_of, with_numbers
from nonholonomic.runs.event import Ensemble
from nonholonomic.runs.model import Sliders
from nonholonomic.runs.table import at_the_end
from nonholonomic.runs.trajectory import TOLERANCE, explore_model, live_run, page_of, runs_at_ends, sliders_of
from nonholonomic.sweeps import chunk_for
from nonholonomic.terminal import status_line
from nonholonomic.text import Unit, readable_unit, with_unit
from nonholonomic.views.pages import Frame, LiveRun
from nonholonomic.views.plot import coloured, new_figure

from ..friction import NoSlip
from ..model.body import AbstractBody, Top
from ..model.rigid import AbstractRigidBody
from ..model.scene import Launch, Scene
from ..modes.plane import Slide
from ..modes.problems import event_of
from .model import INVERSIONS, REVERSALS, TopModel, of_launches
from .observables import AFTERWARDS, OF_RIGID_BODIES, QUANTITIES, AbstractTrajectory
from .verbs import check_reversible, check_run

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


#: The arrows that a page does not show at first, all from the centre of mass: name, unit, length and colour.
AT_CENTRE = (
    ("weight at the centre of mass", "N", WEIGHT, BLACK),
    ("angular velocity", "rad/s", SPIN, TEAL),
    ("angular momentum", "kg m²/s", SPIN, PINK),
)


def frames(run: AbstractTrajectory) -> Frame[Array]:
    """The drawn quantities of a run at its times, the first axis of every array, in the order of `show`; inside or outside
    of transformations."""
    scene, body, slip, position, axis, normal = run.scene, run.scene.body, run.slip, run.position, run.axis, run.normal
    radius, offset, zero = body.size, 0.0, jnp.zeros_like(run.t)
    contact: Array = run.contact
    if isinstance(body, Top):
        contact, offset = position - body.radius * normal, body.offset
        if body.stem is not None:
            stem = position + (body.stem.offset - body.offset) * axis - body.stem.radius * normal
            # In flight that of the stem if it is clearly lower: the trace of a stem that bounces would be a zigzag.
            is_lower = ((contact - stem) * normal).sum(axis=-1) > 0.02 * radius
            contact = jnp.where(((run.contact == 1) | (run.contact < 0) & is_lower)[:, None], stem, contact)
    # Above the ground, where lines are visible.
    above, centre = contact + 0.02 * radius * normal, position - offset * axis
    rotation = (run.angular_velocity * normal).sum(axis=-1) if isinstance(body, AbstractRigidBody) else run.jellett
    return Frame(
        normal=normal,
        bodies=((position, views.stage.quaternion(run.rotation)),),
        traces=((above, None), (AXIS * radius * axis, position)),
        arrows=(
            (above, run.normal_force[:, None] * normal),
            (above, run._fixed((slip[:, 0], slip[:, 1], zero))),
            (centre, jnp.stack([zero, zero, zero - body.mass * scene.gravity], axis=-1)),
            (centre, run.angular_velocity),
            (centre, run.angular_momentum),
        ),
        curves=(run.theta, run.energy, rotation, run.normal_force),
        turning_rate=jnp.linalg.norm(run.angular_velocity, axis=-1),
    )


_frames = eqx.filter_jit(frames)


def motion(run: AbstractTrajectory) -> tuple[np.ndarray, Frame[np.ndarray]]:
    """The times and the drawn quantities of one run. If the run can be evaluated between its times, the times are close enough
    to show the rotation."""
    if run.dense is not None:
        # The angle about the axis is not enough: half-way up, a top turns about other directions equally fast.
        turned_by = np.trapezoid(np.linalg.norm(run.angular_velocity, axis=-1), run.t)
        count = int(np.clip(turned_by / TURN_PER_FRAME, LEAST_FRAMES, MOST_FRAMES))
        run = run.at(np.linspace(0.0, float(run.end_time), count))
    return np.asarray(run.t), jax.tree.map(lambda part: np.asarray(part)[: len(run.t)], _frames(run.padded()))


def show(scene: Scene, times: np.ndarray, frames: Frame[np.ndarray], number: int, name: str) -> views.Show:
    """The drawing of one run, the `number`-th of a page."""
    body, colour, (theta, *_) = scene.body, views.COLOURS[number % len(views.COLOURS)], frames.curves
    times, frames = jax.tree.map(lambda part: part[np.isfinite(theta)], (times, frames))
    radius, weight = float(body.size), float(body.mass * scene.gravity)
    (pose,), (contact, axis), (force, slip, *others) = frames.bodies, frames.traces, frames.arrows
    width, speed = 0.05 * radius, np.linalg.norm(slip[1], axis=-1)
    common = max(float(np.quantile(speed, COMMON_SLIP)), 1e-12)
    arrows = [
        views.Arrow("normal force", *force, "N", WEIGHT * radius / weight, VIOLET, width, through=True),
        views.Arrow("slip", *slip, "m/s", SLIP * radius / common, GOLD, width, SLIP * radius),
    ]
    for (arrow, unit, length, shade), (start, vector) in zip(AT_CENTRE, others, strict=True):
        scale = length * radius / max(float(np.linalg.norm(vector, axis=-1).max()), 1e-300)
        arrows.append(views.Arrow(arrow, start, vector, unit, scale, shade, width, None, True, False))
    rotation = OF_RIGID_BODIES["normal_spin"] if isinstance(body, AbstractRigidBody) else QUANTITIES["jellett"]
    quantities = (QUANTITIES["theta"], QUANTITIES["energy"], rotation, QUANTITIES["normal_force"])
    curves = zip(quantities, frames.curves, strict=True)
    return views.Show(
        name,
        colour,
        times,
        frames.normal,
        radius,
        (views.Body(*pose, meshes(body, colour)),),
        (
            views.Trace("contact", contact[0], GREEN, 0.06 * radius),
            views.Trace("path of the axis", axis[0], BLUE, 0.012 * radius, axis[1], False),
        ),
        tuple(arrows),
        tuple(views.Curve(part.long_name, readable_unit(part.unit), values) for part, values in curves),
    )


@views.stage_of.register(AbstractTrajectory)
def _(
    run: AbstractTrajectory, runs: list[AbstractTrajectory], numbers: Sequence[int], names: Sequence[str]
) -> views.Stage:
    times, drawn = zip(*map(motion, runs), strict=True)
    scenes = [run.scene for run in runs]
    shows = tuple(map(show, scenes, times, drawn, numbers, names))
    return views.Stage("; ".join(names), arena_of(scenes[0], drawn, drawn[0].normal[0]), shows)


def arena_of(scene: Scene, runs: Sequence[Frame[np.ndarray]], normal: np.ndarray, margin: float = 0.0) -> views.Arena:
    """The part of the arena on which runs take place. **Arguments:** `margin`: its least width [m] beyond their contacts."""
    points, size = np.concatenate([frames.traces[0][0] for frames in runs]), float(scene.body.size)
    return views.stage.arena(scene.surface, points, normal, max(margin, 4.0 * size), 2.5 * size)


def meshes(body: AbstractBody | AbstractRigidBody, colour: int) -> tuple[views.Mesh, ...]:
    """The body in two colours; a top has its stem, or a short stem that only shows the axis."""
    if isinstance(body, AbstractRigidBody):
        rigid_meshes = []
        for mesh in views.stage.ball(1.0, (colour, views.PALE)):
            # The points of the surface at which the body has the outward unit normals of a ball.
            normal, zero = tuple(-jnp.asarray(mesh.vertices).T), jnp.zeros(len(mesh.vertices))
            vertices = np.stack(body.contact(normal, (zero, zero, zero))[0], axis=-1)
            rigid_meshes.append(mesh._replace(vertices=vertices))
        return tuple(rigid_meshes)
    if not isinstance(body, Top):
        # The meridian from the top of the axis down: (distance from the axis, height above the centre of mass) [m].
        theta = jnp.linspace(jnp.pi, 0.0, 49)
        lever = body.meridian.at(jnp.cos(theta))
        meridian = (lever.radius * jnp.sin(theta), lever.offset - lever.radius * jnp.cos(theta))
        return views.stage.striped(np.stack(meridian, axis=-1), (colour, views.PALE))
    radius = float(body.radius)
    if body.stem is None:
        axis = views.stage.rod(0.10 * radius, 0.9 * radius, AXIS * radius - 0.16 * radius, 0.16 * radius, views.DARK)
        return (*views.stage.ball(radius, (colour, views.PALE)), axis)
    knob, end = float(body.stem.radius), float(body.stem.offset - body.offset)
    return (
        *views.stage.striped(truncated(radius, knob, end), (colour, views.PALE)),
        views.stage.rod(0.999 * knob, 0.0, end, knob, views.DARK),
    )


def truncated(radius: float, knob: float, end: float) -> Float[np.ndarray, "points 2"]:
    """The meridian of a ball whose cap is cut off, about its centre, from the flat down.

    The scene does not contain the height of the cut; the rim must not touch the arena before the stem does.
    """
    lower_radius = min(radius * (radius - knob) / end, 0.9 * radius)
    polar = np.linspace(np.arccos((radius - 0.8 * (radius - lower_radius)) / radius), np.pi, 25)
    sphere = radius * np.stack([np.sin(polar), np.cos(polar)], axis=-1)
    return np.concatenate([[[0.0, sphere[0, 1]]], sphere])


# A page with sliders that simulates a top in the browser.

#: Drawn radius of a level plane about the start of a run with flights, in units of sqrt(g R) t1.
REACH = 0.5


@of_launches
@status_line("writing a page")
def explore(
    scene: Scene,
    launch: Launch,
    path: str | Path | None = None,
    sliders: Sliders | None = None,
    t1: float = 8.0,
    unit: Unit = None,
    label: str | None = None,
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
    - `label`: title of the page.

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
    return explore_model(TopModel(scene=scene, launch=launch), path, sliders, float(t1), unit, label)


@page_of.register(TopModel)
def _(model: TopModel, sliders: Sliders | None, t1: float) -> tuple[LiveRun, views.Stage]:
    live = page_of_launch(model, sliders, t1)
    if model.scene.contact == "hybrid" and model.scene.level:
        return live, stage_at_start(model, t1)
    # The first run, on a part of the arena that also contains the others.
    runs = runs_at_ends(model, live.sliders, t1)
    (first,) = runs[0].stages()
    return live, first._replace(arena=arena_of(runs[0].scene, [motion(run)[1] for run in runs], first.arena.normal))


def page_of_launch(model: TopModel, sliders: Sliders | None, t1: float) -> LiveRun:
    """The contents of the page. **Arguments:** `model`: without an event; the others as for `explore`."""
    scene, launch = model.scene, model.launch
    # A body that rolls keeps its energy: it does not invert, and the page shows times of reversal.
    reverses = isinstance(scene.friction, NoSlip)
    if reverses:
        check_reversible(scene, launch)
    # The position of the stem's end is relative to the centre of mass, so another offset would change the shape.
    paths_drawn = ("scene.body.stem.", "scene.body.offset") if scene.has_stem else ()
    knobs = sliders_of(model, default_ranges(scene, launch) if sliders is None else sliders, paths_drawn)
    answer = "time until its stem carries it" if scene.has_stem else "inversion time"
    kind = "Rigid body" if isinstance(scene.body, AbstractRigidBody) else "Tippe top"
    return live_run(
        TopModel.of(scene, launch),
        model,
        knobs,
        t1,
        lambda drawn, time, rows, mode: jax.tree.map(lambda part: part[0], frames(drawn.moment(rows, mode))),
        title=f"{kind} on a {type(scene.surface).__name__.lower()}",
        answer=("reversal time" if reverses else answer, "s"),
        summaries=(1, 2),
        named=(REVERSALS if reverses else INVERSIONS).named,
        afterwards=None if reverses else lambda drawn, ended: drawn.moment(ended.state, ended.mode).afterwards,
    )._replace(afterwards=() if reverses else AFTERWARDS)


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


def stage_at_start(model: TopModel, t1: float) -> views.Stage:
    """The top on a level plane at its launch; the page replaces it by a simulated run before it is visible."""
    scene, size = model.scene, float(model.scene.body.size)
    start = jax.tree.map(lambda part: np.repeat(np.asarray(part), 2, axis=0), _frames_at_start(model))
    initial_show = show(scene, np.array([0.0, 1.0]), start, 0, "")
    # Slips grow as the top rises; a slip at half the speed of the equator gets the longest arrow.
    normal_force, slip, *arrows = initial_show.arrows
    slip = slip._replace(scale=SLIP * size / max(0.5 * size * float(start.turning_rate[0]), 1e-12))
    initial_show = initial_show._replace(arrows=(normal_force, slip, *arrows))
    reach = max(REACH * math.sqrt(float(scene.gravity) * size) * t1, 10.0 * size)
    return views.Stage("", arena_of(scene, [start], start.normal[0], reach), (initial_show,), follows=True)


@eqx.filter_jit
def _frames_at_start(model: TopModel) -> Frame[Array]:
    modes, number, state = model.modes(1, jnp.asarray(TOLERANCE), None, False)
    # The other tops stand on their stem.
    mode = dataclasses.replace(modes[0], number=number) if isinstance(modes[0], Slide) else modes[0]
    return frames(model.moment(mode.shown(state), number))


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


def draw_launches(panels: list[Panel], angle: float, dots: str, unit: str = "rad") -> Any:
    """Draw theta(t) of every launch, a panel for each arena and place.

    **Arguments:**

    - `panels`: the panels; `ends` are the times [s] that get a dot, if finite.
    - `angle`: angle [rad] that counts as inverted; `dots`: description of the dots, below the plot; `unit`: "rad" or "deg",
      that of the vertical axis.

    **Returns:** a matplotlib figure.
    """
    figure = new_figure(13.0 if len(panels) > 1 else 8.0, 4.2)
    drawings = figure.subplots(1, len(panels), sharey=True, squeeze=False)[0]
    for drawing, panel in zip(map(coloured, drawings), panels, strict=True):
        for theta, start, end in zip(panel.theta, panel.starts, panel.ends, strict=True):
            (line,) = drawing.plot(panel.times, theta, label=f"{start:.4g}", linewidth=1.2)
            if np.isfinite(end):
                dot = {"color": line.get_color(), "markersize": 9, "markeredgecolor": "black", "zorder": 3}
                drawing.plot(end, np.interp(end, panel.times, theta), "o", **dot)
        drawing.axhline(angle, color="0.5", linewidth=0.8, linestyle="--")
        drawing.set_title(panel.title)
        drawing.set_xlabel("time [s]")
        drawing.set_yticks([0.0, np.pi / 2.0, np.pi], ["0", "π/2", "π"] if unit == "rad" else ["0", "90", "180"])
    drawings[0].set_ylabel(with_unit(QUANTITIES["theta"].long_name, unit))
    figure.supxlabel(dots, fontsize=10)
    if len(panels[-1].starts) > 1:
        drawings[-1].legend(title="θ(0) [rad]", loc="center left", bbox_to_anchor=(1.01, 0.5))
    return figure


def theta_over_time(scene: Scene, launch: Launch, times: Values, tolerance: float, axes: Sequence[str]) -> Values:
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
    modes = tuple(dataclasses.replace(mode, cos_angle=jnp.asarray(-1.0)) for mode in ensemble.start[0])
    ensemble = dataclasses.replace(ensemble, start=(modes, *ensemble.start[1:]))
    parts = -(-len(times) // size)
    ends = np.pad(times, (0, size * parts - len(times)), mode="edge").reshape(size, parts)
    rows, goes = [], np.ones(size, bool)
    for spans in np.diff(ends, axis=1, prepend=0.0).T:
        outcome: Any = ensemble.solve(spans, size, settings)
        assert isinstance(outcome, HybridOutcome)
        theta = np.asarray(at_the_end(model, ensemble, outcome, settings.tolerance)[1]["end_theta"])
        rows.append(theta if not rows else np.where(goes, theta, rows[-1]))
        goes &= outcome.status == REACHED_END
        ensemble = dataclasses.replace(ensemble, start=(modes, outcome.mode, outcome.state))
    return np.stack(rows, axis=1).ravel()[: len(times)]
