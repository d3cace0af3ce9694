"""The main job, `python -m stroller`: a stroller that parks, rides on some surfaces, with and without friction, and their
audit."""

import argparse
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from html import escape
from pathlib import Path
from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from nonholonomic import __version__, views
from nonholonomic.command_line import run_and_exit
from nonholonomic.compilation.cache import are_kept, enable_compilation_cache, kept_files
from nonholonomic.geometry import CLOSED, AbstractSurface, Cylinder, Paraboloid, Plane, Sphere, Spheroid, Torus
from nonholonomic.integration import ImplicitMidpoint
from nonholonomic.sweeps import run_table
from nonholonomic.terminal import Progress, status_line
from nonholonomic.validation import Bound, Bounded, as_number, replacing, require_folder

from .friction import Damping
from .model.input import Motion
from .model.scene import FORKS, Launch, Scene, Stroller
from .planning.plan import Plan, plan, planned_stage
from .planning.problem import Box, Goal, Limits
from .runs.model import simulate
from .runs.trajectory import QUANTITIES, VECTORS, Trajectory
from .runs.view import stage_of_rides

RIDES = ("without friction", "with friction")

#: The ground and the friction of a ride.
Name = tuple[str, str]

#: The heading of the energy audit, and the name of its text among the computed files.
HEADING = (
    f"{'ride':38s} {'solver':10s} {'E start [J]':>12s} {'E end [J]':>12s} {'work [J]':>12s} "
    f"{'residual':>10s} {'slip [m/s]':>10s} {'N min [N]':>10s} {'steps':>6s}  status"
)
AUDIT = "audit"

#: The name of the page.
PAGE = "index.html"


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


class Helm(Bounded):
    """Steer alternately left and right, by a torque towards a moving angle, and pull with a constant force."""

    force: Float[Array, ""] = eqx.field(converter=as_number)
    angle: Float[Array, ""] = eqx.field(converter=as_number)
    period: Float[Array, ""] = eqx.field(converter=as_number, metadata=Bound.POSITIVE)

    def __call__(self, t: Float[Array, "..."], motion: Motion) -> tuple[Float[Array, "..."], Float[Array, "..."]]:
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


def scenes(options: argparse.Namespace) -> dict[Name, tuple[Scene, Launch]]:
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


def parked(options: argparse.Namespace) -> tuple[Plan, list[str]]:
    """A planned drive into a gap between two strollers, on a level plane, and its lines."""
    length = options.wheelbase
    body = Stroller(options.mass, length, options.inertia, options.steering_inertia)
    scene = Scene(body, friction=Damping(*options.damping), gravity=options.gravity, fork=options.fork)
    others = [Box((x * length, 0.0), (1.4 * length, 0.87 * length)) for x in (-2.2, 0.0, 3.7)]
    kerb = Box((0.75 * length, -0.95 * length), (8.0 * length, 0.4 * length))
    parking = plan(
        scene,
        Launch((2.9 * length, 1.5 * length), 0.0, 0.0),
        Goal((1.35 * length, 0.0), 0.0),
        15.0,
        obstacles=[*others, kerb],
        limits=Limits(steering=1.0, speed=(-2.0 * length, 3.0 * length)),
        progress=False,
    )
    return parking, [f"Parking: {parking}", "", HEADING]


def audited(options: argparse.Namespace, helm: Helm, ground: str) -> tuple[dict[Name, Trajectory], list[str]]:
    """The rides on a ground by Dopri8, which share one program, and the lines of their energy audit, for both integrators."""
    rides, lines = {}, []
    for name, (scene, launch) in scenes(options).items():
        if name[0] != ground:
            continue
        rides[name] = simulate(scene, launch, options.t1, helm, tolerance=options.tolerance)
        again = simulate(scene, launch, options.t1, helm, solver=ImplicitMidpoint(options.step))
        for solver, run in {"Dopri8": rides[name], "midpoint": again}.items():
            residual, slip = (float(jnp.max(jnp.abs(part))) for part in (run.energy_residual, run.constraint))
            energies = " ".join(f"{float(part):12.6f}" for part in (run.energy[0], run.energy[-1], run.work[-1]))
            force, steps = float(jnp.min(run.normal_force)), int(run.stats.steps)
            ride = f"{', '.join(name):38s} {solver:10s} {energies} {residual:10.1e} {slip:10.1e}"
            lines.append(f"{ride} {force:10.3f} {steps:6d}  {run.status}")
    return rides, lines


def stages(parking: Plan, rides: dict[Name, Trajectory]) -> list[views.Stage]:
    """The stages of the page: the plan, and each ground with its rides."""
    groups: dict[str, list[tuple[Trajectory, int, str]]] = {}
    # The plan has the first colour.
    for number, ((ground, ride), run) in enumerate(rides.items(), 1):
        groups.setdefault(ground, []).append((run, number, ride))
    all_stages = [planned_stage(parking)]
    for ground, group in groups.items():
        # The title of the stage names the ground of both rides; the name of each ride is beside it.
        runs, *numbers_and_names = map(list, zip(*group, strict=True))
        all_stages.append(stage_of_rides(runs[0], runs, *numbers_and_names)._replace(title=ground))
    return all_stages


def computed(options: argparse.Namespace) -> dict[str, bytes]:
    """Plan the drive, simulate the rides, print their audit, each part as soon as it is known, and write all files.

    **Returns:** name -> contents of each file, and of the audit.
    """
    grounds = dict.fromkeys(ground for ground, _ in scenes(options))
    helm = Helm(options.force, options.steer, options.period)
    jobs = [partial(parked, options), *(partial(audited, options, helm, ground) for ground in grounds)]
    results, texts = [], []
    # Compile in parallel, because the compiler uses little more than one core.
    with Progress(len(jobs), "job") as display, ThreadPoolExecutor(2) as threads:
        display.begin()
        for future in [threads.submit(job) for job in jobs]:
            result, lines = future.result()
            results.append(result)
            texts.append("\n".join(lines))
            with display.aside():
                print(texts[-1], flush=True)
            display.advance(1)
    parking, *rides_by_ground = results
    rides = {name: run for runs in rides_by_ground for name, run in runs.items()}
    names = ["_".join(name).replace(" ", "_") for name in rides]
    facts = vars(options) | {"ride": names}
    request: dict[str, object] = {name: fact for name, fact in facts.items() if name != "out"}
    with status_line("drawing"):
        first, *others = rides.values()
        # Every ground has coordinates of its own.
        axes = {"ride": names, "time": first.t} | VECTORS | {"coordinate": ("first", "second")}
        coords = {dim: np.array(labels) for dim, labels in axes.items()}
        values = {name: np.stack([run[name] for run in rides.values()]) for name in QUANTITIES}
        run_table(QUANTITIES, coords, values, ["ride", "time"], request).save(options.out / "rides.h5")
        files, pictures = ["rides.h5"], []
        if views.pages.can_draw():
            labels = [", ".join(name) for name in rides]
            curves = first.plot("speed", "energy", "side_force", others=others, label=labels)
            for heading, name, figure in (
                ("Parking", "parked.png", parking.plot()),
                ("Speeds, energies, side forces", "rides.png", curves),
            ):
                figure.savefig(options.out / name, dpi=110)
                files.append(name)
                pictures.append(views.pages.picture_as_html(options.out / name, heading))
        audit = "\n".join([HEADING, *texts[1:]])
        plan_text, audit = (f"<pre>{escape(text)}</pre>" for text in (str(parking), audit))
        sections = "".join([*pictures[:1], plan_text, "<h2>Energy against work</h2>", audit, *pictures[1:]])
        page = views.pages.page_of_job(lambda: stages(parking, rides), "A stroller parks, and rides", 1.0, sections)
        page.save(options.out / PAGE)
    return {AUDIT: "\n".join(texts).encode()} | {name: (options.out / name).read_bytes() for name in [*files, PAGE]}


def write(options: argparse.Namespace) -> views.pages.Outputs:
    """Write all files, computed or from an earlier run of the same options, and print the audit."""
    cache = enable_compilation_cache()
    facts = "rides", sorted((name, repr(value)) for name, value in vars(options).items() if name != "out")
    require_folder(options.out, "--out")
    read = are_kept(cache, facts)
    files = kept_files(cache, facts, lambda: computed(options))
    paths = {name: options.out / name for name in files if name != AUDIT}
    if read:
        print(files[AUDIT].decode())
        for name, path in paths.items():
            with replacing(path) as scratch:
                scratch.write_bytes(files[name])
    page = paths.pop(PAGE)
    return views.pages.Outputs(2 * len(scenes(options)), list(paths.values()), page, cache if read else None)


def main(arguments: list[str] | None = None) -> int:
    """Run the main job.

    **Arguments:** `arguments`: the command line, by default that of the process.

    **Returns:** the exit status: 0, or 2 for input that cannot be used.
    """
    options = parser().parse_args(arguments)
    return views.pages.run_job(lambda: write(options), "stroller")


if __name__ == "__main__":
    run_and_exit(main, "stroller")
