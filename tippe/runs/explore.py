"""A page with sliders that simulates a top in the browser, and the plot of the main job."""

import dataclasses
import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from nonholonomic.hybrid import HybridOutcome
from nonholonomic.integration import Settings, crossing_time
from nonholonomic.integration.problem import CROSSED, REACHED_END, Status
from nonholonomic.parameters import numbers, numbers_of, with_numbers
from nonholonomic.runs import TOLERANCE, Ensemble, at_the_end, live_run, page_of, runs_at_ends, sliders_of
from nonholonomic.sweeps import chunk_for
from nonholonomic.text import readable_unit
from nonholonomic.views import Stage, arena
from nonholonomic.views.explore import Frame, LiveRun, Summary, quaternion

from ..friction import NoSlip
from ..model.body import Top
from ..model.rigid import AbstractRigidBody
from ..model.scene import Launch, Scene
from ..modes.plane import Slide
from .launches import check_reversible, check_run, event_of
from .model import TopModel
from .trajectory import Trajectory
from .view import AXIS, OF_RIGID_BODIES, QUANTITIES, DrawnMotion, curve_of_rotation, show
from .view import motion as drawn_motion

# A page with sliders that simulates a top in the browser.

#: Drawn radius of a level plane about the start of a run with flights, in units of sqrt(g R) t1.
REACH = 0.5

#: The words for the statuses of runs that end with a reversal of the spin.
REVERSED = {int(Status.INVERTED): "reversed", int(Status.NOT_INVERTED): "not_reversed"}


@page_of.register(TopModel)
def _(model: TopModel, sliders: Any, t1: float) -> tuple[LiveRun, Stage]:
    live = page_of_launch(model, sliders, t1)
    if model.scene.contact == "hybrid" and model.scene.level:
        return live, stage_at_start(model, t1)
    return live, stage_of_runs(runs_at_ends(model, live.sliders, t1))


def page_of_launch(model: TopModel, sliders: dict[str, tuple[float, float]] | None, t1: float) -> LiveRun:
    """The contents of the page. **Arguments:** `model`: without an event; the others as for `explore`."""
    scene, launch = model.scene, model.launch
    check_run(scene, launch, t1, TOLERANCE)
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


def outcome(model: TopModel, problem: Any, ended: Any) -> tuple[Int[Array, ""], Float[Array, ""]]:
    """The `Status` of a run that ends with the inversion, and its inversion time [s], or infinity. **Arguments:** as for
    the function `outcome` of `live_run`."""
    time = ended.crossing_time
    if problem is not None:
        # A run that starts above the angle is inverted at once.
        time = jnp.where(ended.time > 0.0, crossing_time(problem, ended.time, ended.state), 0.0)
    status = model.ended(ended, TOLERANCE)[0]
    for code, word in ((Status.EVENT, Status.INVERTED), (Status.COMPLETED, Status.NOT_INVERTED)):
        status = jnp.where(status == int(code), int(word), status)
    return status, jnp.where(ended.status[0] == CROSSED, time[0], jnp.inf)


def stage_of_runs(runs: list[Trajectory]) -> Stage:
    """The first run, on a part of the arena that also contains the others."""
    (first,), scene = runs[0].stages(), runs[0].scene
    points, size = np.concatenate([drawn_motion(run).contact for run in runs]), float(scene.body.size)
    return first._replace(arena=arena(scene.surface, points, first.arena.normal, 4.0 * size, 2.5 * size))


def stage_at_start(model: TopModel, t1: float) -> Stage:
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
    ground = arena(scene.surface, start.contact, start.normal[0], max(reach, 10.0 * size), 2.5 * size)
    return Stage("", ground, (initial_show,), follows=True)


@eqx.filter_jit
def _motion_at_start(model: TopModel) -> DrawnMotion[Array]:
    modes, number, state = model.modes(1, jnp.asarray(TOLERANCE), None, False)
    # The other tops stand on their stem.
    mode = dataclasses.replace(modes[0], number=number) if isinstance(modes[0], Slide) else modes[0]
    return DrawnMotion.of(model.moment(mode.shown(state), number))


def frame(scene: Scene, run: Any) -> Frame:
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
