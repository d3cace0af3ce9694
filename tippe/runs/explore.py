"""A page with sliders in which a top is simulated anew in the browser."""

import math
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from nonholonomic.integration import (
    CROSSED,
    FAILED,
    LEFT_DOMAIN,
    LaneState,
    Settings,
    Status,
    crossing_time,
)
from nonholonomic.parameters import numbers, with_numbers
from nonholonomic.progress import status_line
from nonholonomic.validation import all_bounds, legal
from nonholonomic.views import Page, Stage, arena
from nonholonomic.views.explore import (
    Answer,
    Frame,
    LiveRun,
    Simulator,
    Slider,
    Summary,
    ends_of,
    live_page,
    quaternion,
    sliders_of,
)

from ..model.dynamics import LOSSES
from ..model.launch import Launch
from ..model.scene import Scene
from ..model.top import Top
from ..modes.inversion_problem import InversionProblem
from ..modes.trajectory_problem import TrajectoryProblem
from .checks import check_revolution, check_run
from .launches import LONG_NAMES, UNITS
from .trajectory import Trajectory, simulate
from .view import AXIS, BESIDE, Motion, aside

Numbers = Float[Array, " numbers"]

#: The angle that counts as inverted [rad], and the tolerance, in the page.
ANGLE = 0.95 * math.pi
TOLERANCE = 1e-7

#: Tolerance of the runs that only say how far the arena is drawn.
DRAWN = 1e-5

#: Steps after which a run in the page is given up: some hundred milliseconds.
MOST_STEPS_OF_A_PAGE = 50_000


@status_line("writing a page")
def explore(
    scene: Scene,
    launch: Launch,
    path: Any = None,
    sliders: dict[str, tuple[float, float]] | None = None,
    t1: float = 8.0,
) -> Page:
    """Make a page with sliders that simulates the top again, in the browser, while you move a slider.

    The page is one file that needs no network; a notebook shows the returned `Page`. The equations of motion, the Runge-Kutta
    pair, the step-size control and the location of the event are generated from those of `inversion_table`, so times and
    statuses are the same, at a tolerance of 1e-7. In the background, a map of inversion times over two of the sliders fills in;
    click it to set both. The page's address holds the sliders: a copied link opens the same run. Press space to play or pause,
    r to reset the sliders.

    **Arguments:**

    - `scene`, `launch`: the run at the start, every number a scalar; `contact` must be "stop", and the friction law
      must have a single mode.
    - `path`: file to write the page to, or `None`.
    - `sliders`: name of a parameter -> (lowest, highest) value. The end of a name will do where only one parameter fits, such
      as "theta", "spin", "mu", "friction.mu" or "offset". By default theta, spin, the coefficient of friction and the offset.
    - `t1`: horizon [s].

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
    check_smooth(scene)
    check_revolution(scene, "explore")
    roots = {"scene": scene, "launch": launch}
    ranges = default_ranges(scene, launch) if sliders is None else sliders
    knobs = sliders_of(ranges, roots, LONG_NAMES, UNITS | scene.body.units | scene.friction.units)
    shapes = [roots, *(with_numbers(roots, {path: end}) for path, end in ends_of(knobs))]
    page = live_page(live_run(roots, knobs, float(t1)), stage(shapes, float(t1)))
    if path is not None:
        page.save(path)
    return page


def live_run(roots: dict[str, Any], knobs: tuple[Slider, ...], t1: float) -> LiveRun:
    """What the page shows of a scene and a launch, `roots`, some of whose numbers are those of sliders."""

    def modules(values: Numbers) -> tuple[Scene, Launch]:
        replaced = with_numbers(roots, {knob.path: value for knob, value in zip(knobs, values, strict=True)})
        return replaced["scene"], replaced["launch"]

    def allowed(values: Numbers) -> Bool[Array, ""]:
        scene, launch = modules(values)
        return jnp.all(legal((*all_bounds(scene), *all_bounds(launch), *scene.start_bounds(launch))))

    def moment(values: Numbers, problem: TrajectoryProblem, lane: LaneState) -> Frame:
        return frame(modules(values)[0], problem, lane)

    settings = Settings(TOLERANCE, max_steps=MOST_STEPS_OF_A_PAGE)
    asked = {"outcome": lambda values, problem, lane: outcome(problem, lane)}
    launched = Simulator(lambda values: InversionProblem.of(*modules(values), ANGLE, 1), t1, settings, asked)
    return LiveRun(
        title=f"Tippe top on a {type(roots['scene'].surface).__name__.lower()}",
        sliders=knobs,
        allowed=allowed,
        answer=Answer("inversion time", "s", launched),
        motion=Simulator(lambda values: TrajectoryProblem.of(*modules(values), 1), t1, settings, {"frame": moment}),
        summaries=(Summary("energy", "J", 1), Summary("Jellett's constant", "kg m²/s", 2)),
    )


def check_smooth(scene: Scene) -> None:
    """Raise `ValueError` for a scene whose runs have several modes, which the page does not know."""
    if scene.contact == "hybrid":
        raise ValueError(
            "contact = 'hybrid' must be 'stop' for explore, whose page ends a run where contact is lost; leave the stem "
            "out, by dataclasses.replace(top, stem=None), or show one run with its flights by simulate(...).view()"
        )
    if scene.friction.set_valued:
        raise ValueError(
            f"friction = {type(scene.friction).__name__} must be a law without modes for explore, such as Coulomb"
        )


def default_ranges(scene: Scene, launch: Launch) -> dict[str, tuple[float, float]]:
    """The sliders if a user names none: theta, spin, the coefficient of friction and the offset, about their own values."""
    theta, spin = float(launch.theta), float(launch.spin)
    ranges = {"theta": (min(0.02, theta), max(0.6, theta)), "spin": tuple(sorted((0.4 * spin, 1.4 * spin)))}
    if spin == 0.0:
        ranges["spin"] = (0.0, 200.0)
    known = numbers("scene", scene)
    for name, (least, most) in {"mu": (0.1, 3.0), "offset": (0.5, 1.5)}.items():
        path = next((path for path in known if path.endswith(f".{name}")), None)
        if path is not None and known[path] > 0.0:
            value = float(known[path])
            ranges[path] = (
                least * value,
                min(most * value, 0.9 * float(scene.body.size)) if name == "offset" else most * value,
            )
    return ranges


def outcome(problem: InversionProblem, lane: LaneState) -> tuple[Int[Array, ""], Float[Array, ""]]:
    """How a run that ends with the inversion ended, a `Status`, and its inversion time [s], or infinity."""
    inverted = lane.status == CROSSED
    # A run that starts above the angle is there at once.
    time = jnp.where(lane.time > 0.0, crossing_time(problem, lane.time, lane.state), 0.0)
    lost = jnp.array([int(status) for status in LOSSES])[problem.dynamics.loss(lane.state)]
    others = jnp.where(lane.status == FAILED, int(Status.FAILED), int(Status.NOT_INVERTED))
    status = jnp.where(lane.status == LEFT_DOMAIN, lost, others)
    return jnp.where(inverted, int(Status.INVERTED), status)[0], jnp.where(inverted, time, jnp.inf)[0]


def stage(runs: list[dict[str, Any]], t1: float) -> Stage:
    """The first of some scenes and launches as it is drawn, on a piece of the arena on which all of them are."""
    paths = [simulate(run["scene"], run["launch"], t1, tolerance=DRAWN) for run in runs]
    (first,), size = paths[0].stages(), float(runs[0]["scene"].body.size)
    points = np.concatenate([np.asarray(path.contact) for path in paths])
    surface, normal = runs[0]["scene"].surface, first.arena.normal
    return first._replace(arena=arena(surface, points, normal, 4.0 * size, 2.5 * size))


def frame(scene: Scene, problem: TrajectoryProblem, lane: LaneState) -> Frame:
    """What is drawn of a top at one time, as `view.show` orders it."""
    lean, rows = len(problem.state), lane.state
    parts = (rows[:lean], rows[lean:-2], rows[-2], rows[-1])
    run = Trajectory(lane.time, scene, *parts, status=0, end_time=lane.time[0], stats={}, dense=None)
    motion = Motion(*(part[0] for part in Motion.of(run)))
    radius = scene.body.size
    lifted = motion.contact + 0.02 * radius * motion.normal
    offset = scene.body.offset if isinstance(scene.body, Top) else 0.0
    centre = motion.position - offset * motion.axis
    weight = jnp.stack([jnp.zeros(()), jnp.zeros(()), -scene.body.mass * scene.gravity])
    return Frame(
        normal=motion.normal,
        bodies=((motion.position, quaternion(motion.rotation)),),
        traces=((lifted, None), (AXIS * radius * motion.axis, motion.position)),
        arrows=(
            (lifted + BESIDE * radius * aside(motion.normal[None])[0], motion.normal_force * motion.normal),
            (lifted, motion.slip),
            (centre, weight),
            (centre, motion.angular_velocity),
            (centre, motion.angular_momentum),
        ),
        curves=(motion.theta, motion.energy, motion.jellett, motion.normal_force),
        turning_rate=jnp.linalg.norm(motion.angular_velocity),
    )
