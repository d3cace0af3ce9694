"""The two inversion tables of a paper, as printed and computed: `python -m tippe --paper`.

The paper: "Modeling of Dynamics Object with Non-Holonomic Constraints Based on Maple in Cylinder Coordinate R x S^1 x SO(3)".
Its numbers are in g, cm and s and are converted here only.

The printed and the computed times have different trends: the numbers of the paper's top are lost, and its equations of
motion are not those of a top (`benchmarks/papers/tippe_audit.py`). The same launches also run on the plane.
"""

import argparse
import math
from collections.abc import Sequence
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from nonholonomic import __version__, views
from nonholonomic.compilation.cache import enable_compilation_cache
from nonholonomic.geometry import AbstractSurface, Cylinder, Paraboloid, Plane, Sphere, Spheroid, Torus
from nonholonomic.sweeps import Table
from nonholonomic.terminal import status_line
from nonholonomic.validation import require_folder

from .friction import AbstractFriction, Coulomb, Viscous
from .model.body import Top
from .model.scene import Launch, Scene
from .runs.verbs import inversion_table, simulate, trajectory_table
from .runs.view import MOST_FRAMES, TURN_PER_FRAME, Panel, draw_launches

# Only for type checkers: matplotlib is optional.
if TYPE_CHECKING:
    from matplotlib.figure import Figure

#: The paper's units in SI.
GRAM, CENTIMETRE = 1e-3, 1e-2

#: beta1 of Tables 2 and 3 [kg m^2/s], its "2,500 g m^2 rad/s" read as 2500 g cm^2/s.
BETA1 = 2500.0 * GRAM * CENTIMETRE**2


class Row(NamedTuple):
    """One row of Table 2 or 3.

    - `theta`: inclination at the start [rad].
    - `time`: time at which the top is reversed [s]; None for "Not reversed".
    """

    theta: float
    time: float | None


class PrintedTable(NamedTuple):
    """Table 2 or 3, whose rows differ only in the inclination.

    - `eta`: place at the start [rad].
    - `mu`: coefficient of friction, of a law that the paper does not state.
    - `rows`: the nine rows.
    """

    eta: float
    mu: float
    rows: tuple[Row, ...]


THETAS = (0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.8, 1.0, math.pi / 2.0)
TABLE_2 = PrintedTable(0.0, 0.3, tuple(map(Row, THETAS, (25.0, 22.0, *(None,) * 7))))
TABLE_3 = PrintedTable(math.pi / 2.0, 0.3, tuple(map(Row, THETAS, (23.0, 19.0, 20.0, 22.0, *(None,) * 5))))

#: The arenas by name, and their numbers.
SURFACES = {"sphere RADIUS": Sphere, "spheroid EQUATORIAL POLAR": Spheroid, "torus RING TUBE": Torus}
SURFACES |= {"paraboloid P": Paraboloid, "plane TILT": Plane}

#: Times at which theta is drawn.
SAMPLES = 3000


def parser() -> argparse.ArgumentParser:
    """The options of the main job; the defaults are the declared top and the papers' launches."""
    command = argparse.ArgumentParser(
        prog="python -m tippe --paper",
        description="Inversion times of a tippe top inside a cylinder (the paper's Tables 2 and 3) and on the plane. "
        "Prints them beside the published times, writes an HDF5 table for each arena and a picture of theta(t).",
        formatter_class=argparse.ArgumentDefaultsHelpFormatter,
        argument_default=argparse.SUPPRESS,
    )
    command.add_argument("--version", action="version", version=f"nonholonomic {__version__}")
    top = command.add_argument_group("the top (the numbers of the paper's Table 1 are lost; these are Rutstam's)")
    top.add_argument("--mass", type=float, default=0.02, help="mass [kg]")
    top.add_argument("--radius", type=float, default=0.02, help="radius R of the sphere [m]")
    top.add_argument("--offset", type=float, default=0.006, help="distance of the centre of mass from the centre [m]")
    top.add_argument("--I1", type=float, help="transverse moment of inertia [kg m^2] (default: 131/350 m R^2)")
    top.add_argument("--I3", type=float, help="axial moment of inertia [kg m^2] (default: 2/5 m R^2)")
    scene = command.add_argument_group("the scene")
    scene.add_argument("--cylinder-radius", type=float, default=0.3, help="radius of the cylinder [m]")
    scene.add_argument("--mu", type=float, default=0.3, help="friction, viscous [s/m], or Coulomb with --slip-speed")
    scene.add_argument("--slip-speed", type=float, help="regularised Coulomb friction with this slip speed [m/s]")
    scene.add_argument(
        "--surface",
        nargs="+",
        metavar=("NAME", "NUMBER"),
        help="another arena, by its name and numbers [m, rad]: " + ", ".join(SURFACES),
    )
    scene.add_argument("--gravity", type=float, default=9.81, help="acceleration of free fall [m/s^2]")
    launch = command.add_argument_group("the launches")
    launch.add_argument("--theta", type=float, nargs="+", default=list(THETAS), help="inclinations theta(0) [rad]")
    launch.add_argument("--eta", type=float, nargs="+", default=[0.0, math.pi / 2.0], help="places eta(0) [rad]")
    launch.add_argument("--beta1", type=float, default=BETA1, help="I3 w3 at the start [kg m^2/s]")
    launch.add_argument("--spin", type=float, help="spin w3 [rad/s] instead of --beta1; --spin=-100 if negative")
    run = command.add_argument_group("the run")
    run.add_argument("--t1", type=float, default=60.0, help="horizon [s]")
    run.add_argument("--angle", type=float, default=0.95 * math.pi, help="angle that counts as inverted [rad]")
    run.add_argument("--tolerance", type=float, default=1e-9, help="relative tolerance of the integration")
    run.add_argument(
        "--out",
        type=Path,
        default=Path("tippe-paper-out"),
        help="folder for the tables and the picture; use another one for another run",
    )
    return command


class Arena(NamedTuple):
    """An arena of the report.

    - `name`, `scene`: its name, and the declared top in it.
    - `etas`: the places eta(0) [rad]; none where `eta` names no places, and every launch starts at the origin.
    - `spin`: spin of the launches [rad/s].
    """

    name: str
    scene: Scene[Top]
    etas: list[float]
    spin: float


def arenas_of(options: argparse.Namespace) -> dict[str, Arena]:
    """The two arenas of the papers, and the requested arena, by the names of their files."""
    inertia = options.mass * options.radius**2
    moments = {"I1": 131.0 / 350.0 * inertia, "I3": 0.4 * inertia} | vars(options)
    top = Top(options.mass, options.radius, options.offset, moments["I1"], moments["I3"])
    friction: AbstractFriction = Viscous(options.mu)
    if "slip_speed" in options:
        friction = Coulomb(options.mu, options.slip_speed)
    surfaces = {"cylinder": ("cylinder", Cylinder(options.cylinder_radius)), "plane": ("plane", Plane())}
    if "surface" in options:
        surfaces["surface"] = (" ".join(options.surface), surface_of(options.surface))
    spin, arenas = options.spin if "spin" in options else options.beta1 / float(top.I3), {}
    for file, (name, surface) in surfaces.items():
        counts_eta = any(coordinate == "eta" for coordinate, _ in surface.coordinates)
        scene = Scene(top, surface, friction, options.gravity)
        arenas[file] = Arena(name, scene, options.eta if counts_eta else [], spin)
    return arenas


def surface_of(words: list[str]) -> AbstractSurface:
    """An arena by its name and numbers.

    **Raises:** `ValueError` for an unknown name or illegal numbers.
    """
    name, *numbers = words
    for surface_name, kind in SURFACES.items():
        if surface_name.split()[0] == name and len(numbers) == len(surface_name.split()) - 1:
            try:
                arguments = [float(number) for number in numbers]
            except ValueError:
                break
            return kind(*arguments)
    raise ValueError(f"--surface {' '.join(words)} must be one of: {', '.join(SURFACES)}")


def tables(options: argparse.Namespace) -> dict[str, Table]:
    """The table of each arena, first and last crossing of the angle, written to its file."""
    arenas, by_arena = arenas_of(options), {}
    require_folder(options.out, "--out")
    for file, arena in arenas.items():
        by_arena[file] = inversion_table(
            arena.scene,
            theta=options.theta,
            eta=arena.etas or 0.0,
            spin=arena.spin,
            t1=options.t1,
            angle=options.angle,
            tolerance=options.tolerance,
            crossing="both",
            path=options.out / f"{file}.h5",
        )
    return by_arena


def rows_of(options: argparse.Namespace, by_arena: dict[str, Table]) -> list[tuple[str, ...]]:
    """The rows of the report: two headings, and a row for every theta(0) with the times in each arena and place, beside
    those of the paper if the launches are its own."""
    columns = [["theta(0)", "[rad]", *(f"{theta:.4g}" for theta in options.theta)]]
    words = {"not_inverted": "-", "contact_lost": "lost contact", "does_not_fit": "no room"}
    for file, arena in arenas_of(options).items():
        table = by_arena[file]
        places = [(f"eta={eta:.4g}", eta, (slice(None), i)) for i, eta in enumerate(arena.etas)]
        for place, eta, cells in places or [("", math.nan, (slice(None),))]:
            for crossing, times in (("first", table.first_time), ("last", table.last_time)):
                ends = zip(times[cells], table.status[cells], strict=True)
                entries = [f"{end:.4f}" if math.isfinite(end) else str(words.get(word, word)) for end, word in ends]
                columns.append([f"{arena.name} {place}", f"{crossing} [s]", *entries])
            for printed in (TABLE_2, TABLE_3) if file == "cylinder" else ():
                if list(options.theta) == [row.theta for row in printed.rows] and math.isclose(eta, printed.eta):
                    columns.append(
                        ["paper", "[s]", *("-" if row.time is None else f"{row.time:g}" for row in printed.rows)]
                    )
    return list(zip(*columns, strict=True))


def aligned(rows: Sequence[Sequence[str]]) -> list[str]:
    """The rows of a table as lines of text, with columns of equal width."""
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    return ["  ".join(text.rjust(width) for text, width in zip(row, widths, strict=True)).rstrip() for row in rows]


def described(options: argparse.Namespace) -> list[str]:
    """The lines above the report."""
    scene = arenas_of(options)["cylinder"].scene
    body, law = scene.body, scene.friction
    friction = f"{'viscous' if isinstance(law, Viscous) else 'Coulomb'} mu = {options.mu:g}"
    friction += " s/m" if isinstance(law, Viscous) else f", slip speed {options.slip_speed:g} m/s"
    return [
        "Inversion of a tippe top: time at which theta reaches "
        f"{options.angle:.4g} rad, for the first time (first) and for good (last).",
        f"Top: m = {float(body.mass):g} kg, R = {float(body.radius):g} m, a = {float(body.offset):g} m, "
        f"I1 = {float(body.I1):.4g}, I3 = {float(body.I3):.4g} kg m^2; friction {friction}; "
        f"cylinder {options.cylinder_radius:g} m.",
        "The numbers of the paper's Table 1 are lost, so we use Rutstam's top: compare trends, not digits.",
        f"-: not inverted within {options.t1:g} s.",
    ]


def picture(options: argparse.Namespace, by_arena: dict[str, Table]) -> "Figure":
    """theta(t) of every launch."""
    times, thetas, panels = np.linspace(0.0, options.t1, SAMPLES), np.asarray(options.theta), []
    for file, arena in arenas_of(options).items():
        sampled = trajectory_table(
            arena.scene,
            theta=thetas,
            eta=arena.etas or 0.0,
            spin=arena.spin,
            times=times,
            quantities=("theta",),
            tolerance=options.tolerance,
            progress=False,
        )
        titles = [f"{arena.name}, η(0) = {eta:.4g}" for eta in arena.etas] or [arena.name]
        angles, ends = (
            part.reshape(len(thetas), len(titles), -1) for part in (sampled.theta, by_arena[file].last_time)
        )
        panels += [Panel(title, times, angles[:, i], thetas, ends[:, i, 0]) for i, title in enumerate(titles)]
    return draw_launches(panels, options.angle, "Dots: above the dashed angle for good")


def motions(options: argparse.Namespace, by_arena: dict[str, Table]) -> list[views.Stage]:
    """In both arenas, the most upright launch that turns over without losing contact, or else the first launch that
    turns over."""
    ends = np.stack([table.last_time.reshape(len(options.theta), -1)[:, 0] for table in by_arena.values()]).max(axis=0)
    # In a longer run, the frames would be too far apart to follow the spin.
    arenas = arenas_of(options).values()
    longest = MOST_FRAMES * TURN_PER_FRAME / max(abs(arena.spin) for arena in arenas)
    tilt = np.where(ends + 0.5 <= longest, options.theta, np.inf)
    row = int(np.argmin(tilt if np.isfinite(tilt).any() else ends))
    theta, last = options.theta[row], min(options.t1, longest, float(ends[row]) + 0.5)
    first, *others = (
        simulate(arena.scene, Launch(theta, arena.spin, *arena.etas[:1]), last, tolerance=options.tolerance)
        for arena in arenas
    )
    return first.stages(others, label=[f"{arena.name}, θ {theta:.4g} rad" for arena in arenas])


def write(options: argparse.Namespace) -> views.pages.Outputs:
    """Compute and write the tables, the picture if matplotlib is installed, and the page: two moving tops if three.js is
    installed, the tables, and the picture."""
    by_arena = tables(options)
    print("\n".join([*described(options), "", *aligned(rows_of(options, by_arena))]))
    with status_line("drawing"):
        files = [options.out / f"{arena}.h5" for arena in by_arena]
        sections = "<h2>Inversion times</h2>" + views.pages.table_as_html(
            list(map(list, rows_of(options, by_arena))), 2
        )
        sections += "".join(f'<p class="note">{escape(line)}</p>' for line in described(options))
        if views.pages.can_draw():
            files.append(options.out / "theta.png")
            picture(options, by_arena).savefig(files[-1], dpi=130)
            sections += views.pages.picture_as_html(files[-1], "θ(t) of every launch")
        path = options.out / "index.html"
        views.pages.page_of_job(lambda: motions(options, by_arena), "A tippe top turns over", 0.5, sections).save(path)
    return views.pages.Outputs(sum(table.status.size for table in by_arena.values()), files, path)


def main(arguments: list[str] | None = None) -> int:
    """Run the main job.

    **Arguments:** `arguments`: the command line, by default that of the process.

    **Returns:** the exit status: 0, or 2 for input that cannot be used.
    """
    options = parser().parse_args(arguments)
    enable_compilation_cache()
    return views.pages.run_job(lambda: write(options), "tippe --paper")
