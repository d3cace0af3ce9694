"""A page with sliders that simulates a top in the browser."""

import dataclasses
import math
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from nonholonomic.hybrid import HybridOutcome
from nonholonomic.integration import LaneState, Settings, crossing_time
from nonholonomic.integration.status import CROSSED, FAILED, LEFT_DOMAIN, Status
from nonholonomic.parameters import numbers, readable_unit, with_numbers
from nonholonomic.runs import page_of
from nonholonomic.validation import all_bounds, legal
from nonholonomic.views import Stage, arena
from nonholonomic.views.explore import (
    Answer,
    Frame,
    HybridSimulator,
    LiveRun,
    Simulator,
    Summary,
    ends_of,
    quaternion,
    sliders_of,
)

from ..model.contact_dynamics import LOSSES
from ..model.friction import NoSlip
from ..model.launch import Launch
from ..model.rigid_body import AbstractRigidBody
from ..model.scene import Scene
from ..model.top import Top
from ..modes.inversion_problem import InversionProblem
from ..modes.sliding import Slide
from ..modes.trajectory_problem import TrajectoryProblem, trajectory_problem
from .checks import check_reversible, check_run, event_of
from .launches import LONG_NAMES, UNITS
from .model import TopModel
from .quantities import OF_RIGID_BODIES, QUANTITIES
from .trajectory import Trajectory, parts_of
from .view import AXIS, DrawnMotion, curve_of_rotation, show
from .view import motion as drawn_motion

Numbers = Float[Array, " numbers"]

#: The tolerance in the page.
TOLERANCE = 1e-7

#: Tolerance of the runs that determine the drawn part of the arena.
DRAWN = 1e-5

#: Drawn radius of a level plane about the start of a run with flights, in units of sqrt(g R) t1.
REACH = 0.5

#: Greatest number of steps of a run in the page; they take some hundred milliseconds.
MOST_STEPS_OF_A_PAGE = 50_000


#: The words for the statuses of runs that end with a reversal of the spin.
REVERSED = {int(Status.INVERTED): "reversed", int(Status.NOT_INVERTED): "not_reversed"}


@page_of.register(TopModel)
def _(model: TopModel, sliders: Any, t1: float) -> tuple[LiveRun, Stage]:
    live = live_run(model, sliders, t1)
    if model.scene.contact == "hybrid" and model.scene.level:
        return live, stage_at_start(model, t1)
    models = [model, *(model.replaced({path: end}) for path, end in ends_of(live.sliders))]
    return live, stage_of_runs([changed.simulate(t1, None, DRAWN, None, None) for changed in models])


def live_run(model: TopModel, sliders: dict[str, tuple[float, float]] | None, t1: float) -> LiveRun:
    """The contents of the page. **Arguments:** `model`: without an event; the others as for `explore`."""
    scene, launch = model.scene, model.launch
    check_run(scene, launch, t1, TOLERANCE)
    if reverses(scene):
        check_reversible(launch, {})
    roots = {"scene": scene, "launch": launch}
    ranges = default_ranges(scene, launch) if sliders is None else sliders
    # The position of the stem's end is relative to the centre of mass, so another offset would change the shape.
    paths_drawn = ("scene.body.stem.", "scene.body.offset") if scene.has_stem else ()
    knobs = sliders_of(ranges, roots, LONG_NAMES, UNITS | scene.body.units | scene.friction.units, paths_drawn)

    def modules(values: Numbers) -> tuple[Scene, Launch]:
        new_roots = with_numbers(roots, {knob.path: value for knob, value in zip(knobs, values, strict=True)})
        return new_roots["scene"], new_roots["launch"]

    def allowed(values: Numbers) -> Bool[Array, ""]:
        scene, launch = modules(values)
        is_legal = jnp.all(legal((*all_bounds(scene), *all_bounds(launch), *scene.start_bounds(launch))))
        return is_legal & (scene.dynamics.normal_spin(scene.state(launch)) != 0.0) if reverses(scene) else is_legal

    settings, quantities = Settings(TOLERANCE, max_steps=MOST_STEPS_OF_A_PAGE), QUANTITIES | OF_RIGID_BODIES
    simulators = smooth_simulators if model.smooth else hybrid_simulators
    answer, motion = simulators(model, modules, float(t1), settings)
    return LiveRun(
        title=f"{'Rigid body' if is_rigid(scene) else 'Tippe top'} on a {type(scene.surface).__name__.lower()}",
        sliders=knobs,
        allowed=allowed,
        answer=Answer("reversal time", "s", answer, REVERSED)
        if reverses(scene)
        else Answer("time until its stem carries it" if scene.has_stem else "inversion time", "s", answer),
        motion=motion,
        summaries=tuple(
            Summary(quantities[name].long_name, readable_unit(quantities[name].unit), row)
            for row, name in enumerate(("energy", "normal_spin" if is_rigid(scene) else "jellett"), start=1)
        ),
    )


def smooth_simulators(
    model: TopModel, modules: Callable[[Numbers], tuple[Scene, Launch]], t1: float, settings: Settings
) -> tuple[Simulator, Simulator]:
    """The simulators of a smooth run: one up to the inversion, and one for the drawn run."""

    def moment(values: Numbers, problem: TrajectoryProblem, lane: LaneState) -> Frame:
        return smooth_frame(modules(values)[0], problem, lane)

    readings = {"outcome": lambda values, problem, lane: outcome(problem, lane)}
    return (
        Simulator(lambda values: timed(modules(values)).problem(1, ()), t1, settings, readings),
        Simulator(lambda values: trajectory_problem(modules(values), 1), t1, settings, {"frame": moment}),
    )


def timed(modules: tuple[Scene, Launch]) -> TopModel:
    """The model of a launch up to the inversion, or, without slip, to the reversal of the spin."""
    scene, launch = modules
    return TopModel.timed(scene, launch, None if reverses(scene) else event_of(scene, None))


def is_rigid(scene: Scene) -> bool:
    """Whether the body is an `Ellipsoid` or a `RigidBody`."""
    return isinstance(scene.body, AbstractRigidBody)


def reverses(scene: Scene) -> bool:
    """Whether the page shows times of reversal: a body that rolls keeps its energy, so it does not invert."""
    return isinstance(scene.friction, NoSlip)


def hybrid_simulators(
    model: TopModel, modules: Callable[[Numbers], tuple[Scene, Launch]], t1: float, settings: Settings
) -> tuple[HybridSimulator, HybridSimulator]:
    """The same for runs with flights, impacts, a stem, or stick and slip."""

    def start(model: TopModel, names: Any) -> Any:
        return model.modes(1, jnp.asarray(TOLERANCE), names, False)

    def sampled(values: Numbers) -> TopModel:
        scene, launch = modules(values)
        return dataclasses.replace(model, scene=scene, launch=launch)

    def moment(values: Numbers, number: Any, rows: Any, time: Any) -> Frame:
        return frame(modules(values)[0], sampled(values).moment(rows, number))

    def last(values: Numbers, runs: HybridOutcome) -> tuple[Int[Array, ""], Float[Array, ""]]:
        return hybrid_outcome(timed(modules(values)), runs)

    counters = len(model.counters)
    return (
        HybridSimulator(lambda values: start(timed(modules(values)), ()), t1, settings, counters, {"outcome": last}),
        HybridSimulator(lambda values: start(sampled(values), None), t1, settings, counters, {}, moment),
    )


def default_ranges(scene: Scene, launch: Launch) -> dict[str, tuple[float, float]]:
    """The default sliders: theta, spin, friction, and the offset of a top without a stem, around their own values."""
    theta, spin = float(launch.theta), float(launch.spin)
    if reverses(scene):
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
            value = float(values[path])
            ranges[path] = (
                low * value,
                min(high * value, 0.9 * float(scene.body.size)) if name == "offset" else high * value,
            )
    return ranges


def outcome(problem: InversionProblem, lane: LaneState) -> tuple[Int[Array, ""], Float[Array, ""]]:
    """The `Status` of a run that ends with the inversion, and its inversion time [s], or infinity."""
    inverted = lane.status == CROSSED
    # A run that starts above the angle is inverted at once.
    time = jnp.where(lane.time > 0.0, crossing_time(problem, lane.time, lane.state), 0.0)
    loss_codes = jnp.array([int(status) for status in LOSSES])[problem.dynamics.loss(lane.state)]
    codes = jnp.where(lane.status == FAILED, int(Status.FAILED), int(Status.NOT_INVERTED))
    status = jnp.where(lane.status == LEFT_DOMAIN, loss_codes, codes)
    return jnp.where(inverted, int(Status.INVERTED), status)[0], jnp.where(inverted, time, jnp.inf)[0]


def hybrid_outcome(model: TopModel, runs: HybridOutcome) -> tuple[Int[Array, ""], Float[Array, ""]]:
    """The same for a run with several modes."""
    status = model.ended(runs, TOLERANCE)[0]
    for ended, word in ((Status.EVENT, Status.INVERTED), (Status.COMPLETED, Status.NOT_INVERTED)):
        status = jnp.where(status == int(ended), int(word), status)
    return status, jnp.where(runs.status[0] == CROSSED, runs.crossing_time[0], jnp.inf)


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
    initial_show = initial_show._replace(
        arrows=(normal_force, slip._replace(scale=slip.limit / max(fastest, 1e-12)), *arrows)
    )
    reach = REACH * math.sqrt(float(scene.gravity) * size) * t1
    ground = arena(scene.surface, start.contact, start.normal[0], max(reach, 10.0 * size), 2.5 * size)
    return Stage("", ground, (initial_show,), follows=True)


@eqx.filter_jit
def _motion_at_start(model: TopModel) -> DrawnMotion[Array]:
    modes, number, state = model.modes(1, jnp.asarray(TOLERANCE), None, False)
    # The other tops stand on their stem.
    rows = (
        dataclasses.replace(modes[0], number=number).shown(state)
        if isinstance(modes[0], Slide)
        else modes[0].shown(state)
    )
    return DrawnMotion.of(model.moment(rows, number))


def smooth_frame(scene: Scene, problem: TrajectoryProblem, lane: LaneState) -> Frame:
    """The drawn quantities of a top at one time in contact."""
    return frame(scene, Trajectory(lane.time, scene, *parts_of(problem.leading, lane.state)))


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
