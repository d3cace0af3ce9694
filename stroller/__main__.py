"""The main job, `python -m stroller`: a stroller that parks, rides on some surfaces, with and without friction, and their
audit."""

import argparse
import sys
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from html import escape
from importlib.util import find_spec
from pathlib import Path
from threading import Lock
from typing import Any, NamedTuple

import equinox as eqx
import jax.numpy as jnp

from nonholonomic import __version__
from nonholonomic.command_line import closing_lines, run_and_exit
from nonholonomic.compilation.cache import are_kept, enable_compilation_cache, kept_files
from nonholonomic.geometry import CLOSED, AbstractSurface, Cylinder, Paraboloid, Plane, Sphere, Spheroid, Torus
from nonholonomic.integration import ImplicitMidpoint
from nonholonomic.sweeps import Table
from nonholonomic.terminal import Progress, status_line
from nonholonomic.validation import as_number, replacing, require, require_folder
from nonholonomic.views import NO_VIEW, can_view, page, picture_as_html

from .model.scene import FORKS, Scene
from .model.vehicle import Damping, Launch, Stroller
from .planning.obstacles import Box
from .planning.plan import plan
from .planning.problem import Goal, Limits
from .planning.result import Plan, draw_plan, planned_stage
from .runs.trajectory import Trajectory, table_of
from .runs.verbs import simulate
from .runs.view import draw_rides, grouped

RIDES = ("without friction", "with friction")

#: The heading of the energy audit, and the name of its text among the computed files.
HEADING = (
    f"{'ride':38s} {'solver':10s} {'E start [J]':>12s} {'E end [J]':>12s} {'work [J]':>12s} "
    f"{'residual':>10s} {'slip [m/s]':>10s} {'N min [N]':>10s} {'steps':>6s}  status"
)
AUDIT = "audit"

#: Tolerances of the rides that show how the energy residual depends on the tolerance.
TOLERANCES = (1e-4, 1e-5, 1e-6, 1e-7, 1e-8, 1e-9, 1e-10, 1e-11, 1e-12)


class Ground(NamedTuple):
    """A surface to ride on: how options create it, and where a ride starts (near the bottom; outside a surface, near
    the top)."""

    build: Callable[[argparse.Namespace], AbstractSurface]
    place: tuple[float, float]
    heading: float
    top: tuple[float, float] = (0.0, 0.0)


GROUNDS = {
    "plane": Ground(lambda options: Plane(options.tilt), (0.0, 0.0), 1.2),
    "cylinder": Ground(lambda options: Cylinder(options.radius), (0.0, 0.6), 0.4, (0.0, 3.0)),
    "sphere": Ground(lambda options: Sphere(options.radius), (0.0, -0.9), 0.4, (0.0, 1.5)),
    "spheroid": Ground(lambda options: Spheroid(options.equatorial, options.polar), (0.0, -0.9), 0.4, (0.0, 1.5)),
    "torus": Ground(lambda options: Torus(options.ring, options.tube), (0.0, -1.2), 0.4, (0.0, 1.5)),
    "paraboloid": Ground(lambda options: Paraboloid(options.p), (2.0, 0.0), 1.2),
}


class Helm(eqx.Module):
    """Steer alternately left and right, by a torque towards a moving angle, and pull with a constant force."""

    force: Any = eqx.field(converter=as_number)
    angle: Any = eqx.field(converter=as_number)
    period: Any = eqx.field(converter=as_number)

    def __check_init__(self) -> None:
        require(self.period, "period", above=0.0)

    def __call__(self, t: Any, motion: Any) -> tuple[Any, Any]:
        target = self.angle * jnp.sin(2.0 * jnp.pi * t / self.period)
        return self.force, 1.0 * (target - motion.steering) - 0.3 * motion.steering_rate


def parser() -> argparse.ArgumentParser:
    """The options of the main job; the defaults are those of a light stroller."""
    command = argparse.ArgumentParser(
        prog="python -m stroller",
        description="A planned drive of a stroller into a gap; and rides on a plane and inside a spheroid, or on the surfaces "
        "named, with and without friction, steered alternately left and right, and pulled. Prints the energy audit of both "
        "integrators, writes an HDF5 file and pictures.",
        formatter_class=argparse.ArgumentDefaultsHelpFormatter,
    )
    command.add_argument("--version", action="version", version=f"nonholonomic {__version__}")
    body = command.add_argument_group("the stroller")
    body.add_argument("--mass", type=float, default=12.0, help="mass [kg]")
    body.add_argument("--wheelbase", type=float, default=0.7, help="rear axle to front wheel [m]")
    body.add_argument("--inertia", type=float, default=1.5, help="yaw inertia about the rear axle [kg m^2]")
    body.add_argument("--steering-inertia", type=float, default=0.05, help="inertia of the fork [kg m^2]")
    scene = command.add_argument_group("the scene")
    scene.add_argument(
        "--surface", nargs="+", choices=list(GROUNDS), default=["plane", "spheroid"], help="surfaces to ride on"
    )
    scene.add_argument("--side", choices=list(CLOSED), default="inside", help="side of a closed surface")
    scene.add_argument("--tilt", type=float, default=0.05, help="tilt of the plane [rad]")
    scene.add_argument("--radius", type=float, default=6.0, help="radius of the cylinder and of the sphere [m]")
    scene.add_argument("--equatorial", type=float, default=6.0, help="equatorial radius of the spheroid [m]")
    scene.add_argument("--polar", type=float, default=3.0, help="polar semi-axis of the spheroid [m]")
    scene.add_argument("--ring", type=float, default=8.0, help="radius of the ring of the torus [m]")
    scene.add_argument("--tube", type=float, default=3.0, help="radius of the tube of the torus [m]")
    scene.add_argument("--p", type=float, default=4.0, help="radius of curvature at the bottom of the paraboloid [m]")
    scene.add_argument(
        "--damping", type=float, nargs=4, default=[2.0, 1.0, 0.2, 0.05], help="rolling, front, scrub, steering"
    )
    scene.add_argument("--gravity", type=float, default=9.81, help="acceleration of free fall [m/s^2]")
    scene.add_argument("--fork", choices=list(FORKS), default="absolute", help="what the fork's inertia resists")
    ride = command.add_argument_group("the ride")
    ride.add_argument("--speed", type=float, default=2.0, help="speed at the start [m/s]")
    ride.add_argument("--force", type=float, default=1.0, help="drive force [N]")
    ride.add_argument("--steer", type=float, default=0.3, help="target steering angle [rad]")
    ride.add_argument("--period", type=float, default=6.0, help="period of the steering [s]")
    ride.add_argument("--t1", type=float, default=20.0, help="end of the ride [s]")
    ride.add_argument("--tolerance", type=float, default=1e-9, help="relative tolerance of Dopri8")
    ride.add_argument("--step", type=float, default=0.01, help="step of the implicit midpoint rule [s]")
    ride.add_argument("--out", type=Path, default=Path("stroller-out"), help="folder for the file and the picture")
    return command


def scenes(options: argparse.Namespace) -> dict[tuple[str, str], tuple[Scene, Launch]]:
    """The rides, without and with friction on each surface: (ground, friction) -> scene and launch."""
    body = Stroller(options.mass, options.wheelbase, options.inertia, options.steering_inertia)
    # Zero damping stands for no friction, so that both rides share one program.
    laws = dict(zip(RIDES, (Damping(0.0, 0.0, 0.0, 0.0), Damping(*options.damping)), strict=True))
    rides = {}
    for name in dict.fromkeys(options.surface):
        ground = GROUNDS[name]
        surface = ground.build(options)
        two_sided = "inside" in surface.sides
        side = options.side if two_sided else None
        place_name = f"{side} the {name}" if two_sided else name
        launch = Launch(ground.top if side == "outside" else ground.place, ground.heading, options.speed)
        for ride, law in laws.items():
            rides[place_name, ride] = (Scene(body, surface, law, options.gravity, side=side, fork=options.fork), launch)
    return rides


def audit(name: str, runs: dict[str, Trajectory]) -> list[str]:
    """The lines of the energy audit of one ride, one for each integrator."""
    lines = []
    for solver, run in runs.items():
        residual, slip = (float(jnp.max(jnp.abs(part))) for part in (run.energy_residual, run.constraint))
        numbers = (float(run.energy[0]), float(run.energy[-1]), float(run.work[-1]))
        columns = " ".join(f"{number:12.6f}" for number in numbers)
        steps = int(run.stats.steps)
        min_force = float(jnp.min(run.normal_force))
        lines.append(
            f"{name:38s} {solver:10s} {columns} {residual:10.1e} {slip:10.1e} {min_force:10.3f} {steps:6d}  {run.status}"
        )
    return lines


def tolerance_curve(options: argparse.Namespace, helm: Helm) -> list[str]:
    """The largest energy residual over the tolerance of Dopri8, for the last ride."""
    (ground, ride), (scene, launch) = list(scenes(options).items())[-1]
    lines = [f"Dopri8 {ground}, {ride}: largest residual [J] of energy minus work, by tolerance"]
    for tolerance in TOLERANCES:
        run = simulate(scene, launch, options.t1, helm, tolerance=tolerance)
        residual = float(jnp.max(jnp.abs(run.energy_residual)))
        lines.append(f"  {tolerance:7.0e}  {residual:8.1e}  in {int(run.stats.steps)} steps")
    return lines


def audited(options: argparse.Namespace, helm: Helm, name: tuple[str, str]) -> tuple[Trajectory, list[str]]:
    """One ride by Dopri8, and its energy audit by both integrators."""
    scene, launch = scenes(options)[name]
    runs = {
        "Dopri8": simulate(scene, launch, options.t1, helm, tolerance=options.tolerance),
        "midpoint": simulate(scene, launch, options.t1, helm, solver=ImplicitMidpoint(options.step)),
    }
    return runs["Dopri8"], audit(", ".join(name), runs)


def parked(options: argparse.Namespace) -> Plan:
    """A planned drive into a gap between two strollers, on a level plane."""
    length = options.wheelbase
    body = Stroller(options.mass, length, options.inertia, options.steering_inertia)
    scene = Scene(body, friction=Damping(*options.damping), gravity=options.gravity, fork=options.fork)
    others = [Box((x * length, 0.0), (1.4 * length, 0.87 * length)) for x in (-2.2, 0.0, 3.7)]
    kerb = Box((0.75 * length, -0.95 * length), (8.0 * length, 0.4 * length))
    return plan(
        scene,
        Launch((2.9 * length, 1.5 * length), 0.0, 0.0),
        Goal((1.35 * length, 0.0), 0.0),
        15.0,
        obstacles=[*others, kerb],
        limits=Limits(steering=1.0, speed=(-2.0 * length, 3.0 * length)),
        progress=False,
    )


def table(options: argparse.Namespace, rides: dict[tuple[str, str], Trajectory]) -> Table:
    """The rides as a table over ride and time."""
    request = {name: value for name, value in vars(options).items() if name != "out"}
    names = ["_".join(name).replace(" ", "_") for name in rides]
    return table_of(list(rides.values()), names, request | {"ride": names})


def write_page(
    options: argparse.Namespace,
    parking: Plan,
    rides: dict[tuple[str, str], Trajectory],
    words: list[str],
    drawings: dict[str, Path],
) -> Path:
    """Write the page of the main job: the moving plan and rides if three.js is installed, the audit, and the drawings by
    their headings."""
    groups: dict[str, list[tuple[int, Trajectory]]] = {}
    for number, ((ground, _), run) in enumerate(rides.items()):
        groups.setdefault(ground, []).append((number, run))
    viewed = []
    if can_view():
        # The title of the stage names the ground of both rides; the name of each ride is beside it.
        viewed = [planned_stage(parking)]
        viewed += [
            stage._replace(title=ground)
            for ground, stage in zip(groups, grouped(list(groups.values()), [ride for _, ride in rides]), strict=True)
        ]
    note = "" if viewed else f'<p class="note">{NO_VIEW}</p>'
    pictures = [f"<h2>{heading}</h2>{picture_as_html(drawing)}" for heading, drawing in drawings.items()]
    audit_section = "<h2>Energy against work</h2><pre>" + escape("\n".join(words)) + "</pre>"
    path = options.out / "index.html"
    sections = "".join([*pictures[:1], audit_section, *pictures[1:]])
    page(viewed, "A stroller parks, and rides", 1.0, note, sections).save(path)
    return path


def simulated(options: argparse.Namespace) -> tuple[Plan, dict[tuple[str, str], Trajectory], list[str]]:
    """The plan, the rides, and the lines of their audit and of the plan, which are printed as the rides end."""
    rides, audits, helm, scenes_to_run = {}, [], Helm(options.force, options.steer, options.period), scenes(options)
    # Compile in parallel, because the compiler uses little more than one core. The two rides of a ground share one program.
    with Progress(len(scenes_to_run) + 2, "ride") as display, ThreadPoolExecutor(2) as threads:
        display.begin()
        locks = {ground: Lock() for ground, _ in scenes_to_run}

        def in_turn(name: tuple[str, str]) -> tuple[Trajectory, list[str]]:
            with locks[name[0]]:
                return audited(options, helm, name)

        futures = {
            name: threads.submit(in_turn, name) for name in sorted(scenes_to_run, key=lambda name: RIDES.index(name[1]))
        }
        curves = threads.submit(tolerance_curve, options, helm)
        planned = threads.submit(parked, options)
        for name in scenes_to_run:
            rides[name], lines = futures[name].result()
            audits += lines
            with display.aside():
                print("\n".join(lines), flush=True)
            display.advance(1)
        curve = ["", *curves.result()]
        display.advance(1)
        parking = planned.result()
        display.advance(1)
        curve += ["", f"Parking: {parking}"]
        with display.aside():
            print("\n".join(curve), flush=True)
    return parking, rides, [*audits, *curve]


def computed(options: argparse.Namespace) -> dict[str, bytes]:
    """Plan the drive, simulate the rides, print their audit, and write all files.

    **Returns:** name -> contents of each file, and of the audit.
    """
    parking, rides, audits = simulated(options)
    with status_line("drawing"):
        paths, drawings = [options.out / "rides.h5"], dict[str, Path]()
        table(options, rides).save(paths[0])
        if has_matplotlib():
            grounds = {ground: scene.surface for (ground, _), (scene, _) in scenes(options).items()}
            figures = {"parked.png": draw_plan(parking), "rides.png": draw_rides(grounds, rides)}
            for name, figure in figures.items():
                figure.savefig(options.out / name, dpi=110)
            paths += [options.out / name for name in figures]
            drawings |= zip(("Parking", "Paths, speeds, energies, side forces"), paths[1:], strict=True)
        paths.append(write_page(options, parking, rides, [HEADING, *audits], drawings))
    return {AUDIT: "\n".join(audits).encode()} | {path.name: path.read_bytes() for path in paths}


def has_matplotlib() -> bool:
    """Whether pictures can be drawn."""
    return find_spec("matplotlib") is not None


def main(arguments: list[str] | None = None) -> int:
    """Run the main job.

    **Arguments:** `arguments`: the command line, by default that of the process.

    **Returns:** the exit status: 0, or 2 for input that cannot be used.
    """
    options = parser().parse_args(arguments)
    cache = enable_compilation_cache()
    start_time = time.perf_counter()
    facts = "rides", sorted((name, repr(value)) for name, value in vars(options).items() if name != "out")
    try:
        require_folder(options.out, "--out")
        print(HEADING, flush=True)
        read = are_kept(cache, facts)
        files = kept_files(cache, facts, lambda: computed(options))
        if read:
            print(files[AUDIT].decode())
            for name in files.keys() - {AUDIT}:
                with replacing(options.out / name) as scratch:
                    scratch.write_bytes(files[name])
    except (ValueError, OSError) as error:
        print(f"python -m stroller: {error}", file=sys.stderr)
        return 2
    if not has_matplotlib():
        print("No picture: matplotlib is not installed (pip install 'nonholonomic[plot]').", file=sys.stderr)
    *paths, page_path = (
        options.out / name for name in ("rides.h5", "parked.png", "rides.png", "index.html") if name in files
    )
    see = f"To see it, open {page_path}{'' if can_view() else f'. {NO_VIEW}'}"
    print(closing_lines(2 * len(scenes(options)), start_time, paths, see, cache if read else None))
    return 0


if __name__ == "__main__":
    run_and_exit(main, "stroller")
