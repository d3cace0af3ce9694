"""The main job, `python -m tippe`: a wooden top that climbs onto its stem, on a table and in a cylinder."""

import argparse
import functools
import json
import math
import sys
from concurrent.futures import ThreadPoolExecutor
from html import escape
from pathlib import Path
from statistics import median_high as middle
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float

from nonholonomic import __version__, views
from nonholonomic.command_line import run_and_exit
from nonholonomic.compilation.cache import are_kept, enable_compilation_cache, kept_files
from nonholonomic.geometry import Cylinder, Plane
from nonholonomic.sweeps import AnotherRun, Table, saved_cells
from nonholonomic.terminal import Progress
from nonholonomic.validation import replacing, require_folder

from . import paper, steady
from .friction import Coulomb
from .model.scene import Launch, Scene
from .modes.problems import INVERTED
from .presets import TOPS
from .runs.model import TopModel
from .runs.verbs import inversion_table
from .runs.view import Panel, draw_launches, page_of_launch, stage_at_start, theta_over_time

# Only for type checkers: matplotlib is optional.
if TYPE_CHECKING:
    from matplotlib.figure import Figure

#: The arenas, which name the files of the tables.
ARENAS = ("plane", "cylinder")

#: Times at which theta is drawn, close enough to show nutation, and the longest time of the picture [s].
SAMPLES, SHOWN = 2048, 5.0

#: The page's title, and the placeholder for the contents below the top.
TITLE, BELOW = "A tippe top on a table", "<!-- below -->"

Times = Float[np.ndarray, " times"]

#: The words for the end of a run, as in the table.
WORDS = {"not_inverted": "not in time", "contact_lost": "lost contact", "does_not_fit": "no room"}


def parser() -> argparse.ArgumentParser:
    """The options of the main job."""
    command = argparse.ArgumentParser(
        prog="python -m tippe",
        description="A tippe top turns over, through flights and onto its stem. Computes inversion times over the inclination "
        "and the friction, on a table and in a cylinder. Writes HDF5 tables, a picture, and a page on which the top "
        "moves. `python -m tippe --paper --help` describes the tables of the papers.",
        formatter_class=argparse.ArgumentDefaultsHelpFormatter,
    )
    command.add_argument("--version", action="version", version=f"nonholonomic {__version__}")
    command.add_argument(
        "--paper", action="store_true", help="the papers' Tables 2 and 3 beside computed times, instead"
    )
    command.add_argument("--top", choices=list(TOPS), default="wooden", help="one of `tippe.presets`")
    command.add_argument(
        "--theta", type=float, nargs="+", default=[3.0, 6.0, 12.0, 18.0], help="inclinations theta(0) [deg]"
    )
    command.add_argument("--rpm", type=float, default=1900.0, help="spin at the start [revolutions per minute]")
    command.add_argument("--mu", type=float, nargs="+", default=[0.1, 0.2, 0.3, 0.4, 0.5], help="Coulomb friction [1]")
    command.add_argument("--slip-speed", type=float, default=0.05, help="slip below which friction falls to zero [m/s]")
    command.add_argument("--cylinder-radius", type=float, default=0.3, help="radius of the cylinder [m]")
    command.add_argument("--t1", type=float, default=10.0, help="horizon [s]")
    command.add_argument("--tolerance", type=float, default=1e-6, help="relative tolerance of the integration")
    command.add_argument("--out", type=Path, default=Path("tippe-out"), help="folder for tables, picture and page")
    return command


def scene(options: argparse.Namespace, arena: str) -> Scene:
    """The scene in an arena, with the middle one of the friction coefficients."""
    surface = Plane() if arena == "plane" else Cylinder(options.cylinder_radius)
    law = Coulomb(middle(options.mu), options.slip_speed)
    return Scene(TOPS[options.top](), surface, law, contact="hybrid")


def remark(options: argparse.Namespace) -> str:
    """An explanation of the times in the tables."""
    angle = f"{math.degrees(angle_counted(options)):.0f} deg"
    if TOPS[options.top]().stem is None:
        return f"A top has turned over when theta first exceeds {angle}."
    return f"A top has turned over when its stem first carries it (it may fall back); on a table the stem touches at {angle}."


def angle_counted(options: argparse.Namespace) -> float:
    """The inclination [rad] beyond which the top has turned over on a table."""
    top = TOPS[options.top]()
    return INVERTED if top.stem is None else float(top.stem_angle)


def described(options: argparse.Namespace) -> list[str]:
    """A description of the job, in some lines."""
    top, mm = TOPS[options.top](), lambda length: f"{1e3 * float(length):.3g} mm"
    alpha, gamma = steady.proportions(top)
    stem = "no stem" if top.stem is None else f"a stem {mm(2.0 * top.stem.radius)} thick"
    spin = float(launch_shown(options).spin)
    return [
        f"A {options.top} top: {1e3 * float(top.mass):.3g} g, {mm(2.0 * top.radius)} across, {stem}, "
        f"its centre of mass {mm(top.offset)} below the centre.",
        f"I1 / I3 = {float(gamma):.3f} lies {'' if steady.group(top) == 'II' else 'not '}between 1 - a / R = "
        f"{1.0 - float(alpha):.3f} and 1 + a / R = {1.0 + float(alpha):.3f}, so it can "
        f"{'' if steady.group(top) == 'II' else 'not '}turn over.",
        f"Spun at {options.rpm:g} rpm ({spin:.4g} rad/s), inclined by theta(0).",
        f"Coulomb friction mu falls to zero below a slip speed of {options.slip_speed:g} m/s.",
    ]


def facts(options: argparse.Namespace, kind: str) -> tuple[str, list[tuple[str, str]]]:
    """Everything that a kind of result depends on, besides these packages."""
    return kind, sorted((name, repr(value)) for name, value in vars(options).items() if name != "out")


def table(options: argparse.Namespace, arena: str, cache: Path | None) -> Table:
    """The table of an arena, written to its file."""
    path = options.out / f"{arena}.h5"
    compute = functools.partial(
        inversion_table,
        scene(options, arena),
        theta=[float(Launch.degrees(theta, 0.0).theta) for theta in options.theta],
        spin=float(launch_shown(options).spin),
        mu=options.mu,
        t1=options.t1,
        tolerance=options.tolerance,
        path=path,
        progress=False,
    )

    def computed() -> dict[str, bytes]:
        compute()
        return {path.name: path.read_bytes()}

    # Another version may have computed the cells that are already in the folder.
    if saved_cells(path) == 0:
        contents = kept_files(cache, facts(options, arena), computed)[path.name]
        if not path.exists():
            with replacing(path) as scratch:
                scratch.write_bytes(contents)
    return compute()


def launch_shown(options: argparse.Namespace) -> Launch:
    """The launch of the picture and of the page: the middle one."""
    return Launch.degrees(middle(options.theta), options.rpm)


def sliders(options: argparse.Namespace) -> str:
    """The page of the top with sliders, with a placeholder for the contents below."""
    model = TopModel(scene=scene(options, "plane"), launch=launch_shown(options))
    live = page_of_launch(model, None, options.t1)._replace(title=TITLE)
    return views.pages.live_page(live, stage_at_start(model, options.t1), 0.2, BELOW, ("deg", "rpm")).html


def computed(options: argparse.Namespace, cache: Path | None) -> tuple[dict[str, Table], list[Path], str]:
    """The table of each arena, the picture of the displayed launch if matplotlib is installed, and the page with sliders if
    three.js is. Each table is printed as soon as it is computed, that of the plane first.

    They are computed in parallel, because the compiler uses little more than one core. **Arguments:** `cache`: folder for
    results that later commands with the same options read.
    """
    threads, display = ThreadPoolExecutor(2), Progress(4, "job", "compiling")
    tables, pictures, live = {}, [], None
    try:
        with display:
            display.begin()
            futures = {arena: threads.submit(table, options, arena, cache) for arena in ("cylinder", "plane")}
            if not views.pages.without_motion():
                page_facts, contents = facts(options, "page"), lambda: {"page": sliders(options).encode()}
                live = threads.submit(kept_files, cache, page_facts, contents)
            for arena in ARENAS:
                tables[arena] = futures[arena].result()
                heading = f"\nTime until it has turned over, {headings(options)[arena]}"
                with display.aside():
                    print(heading, *paper.aligned(rows_of(options, tables[arena])), sep="\n", flush=True)
                display.advance(1)
                # Drawn while the threads compile, after the table of the plane, whose programs it uses.
                if arena == "plane" and views.pages.can_draw():
                    pictures.append(options.out / "theta.png")
                    picture(options, *theta_shown(options, cache), tables["plane"]).savefig(pictures[0], dpi=130)
                    display.advance(1)
            return tables, pictures, "" if live is None else live.result()["page"].decode()
    finally:
        # After Ctrl-C, the process ends while the compiler is working, which nothing can interrupt.
        threads.shutdown(wait=False, cancel_futures=True)


def theta_shown(options: argparse.Namespace, cache: Path | None) -> tuple[Times, Times]:
    """The times [s] of the picture, and theta [rad] of the displayed launch on the plane at these times."""
    times = np.linspace(0.0, min(SHOWN, options.t1), SAMPLES)

    def angles() -> dict[str, bytes]:
        axes = ("launch.theta", "scene.friction.mu")
        theta = theta_over_time(scene(options, "plane"), launch_shown(options), times, options.tolerance, axes)
        return {"theta": json.dumps(theta.tolist()).encode()}

    return times, np.array(json.loads(kept_files(cache, facts(options, "theta"), angles)["theta"]))


def rows_of(options: argparse.Namespace, table: Table) -> list[list[str]]:
    """The entries of a table, numbers or words, under its two headings."""
    rows = [["theta(0)", *(f"mu = {mu:g}" for mu in options.mu)]]
    for theta, times, words in zip(options.theta, table.time, table.status, strict=True):
        entries = [f"{t:.2f}" if math.isfinite(t) else str(WORDS.get(w, w)) for t, w in zip(times, words, strict=True)]
        rows.append([f"{theta:g} deg", *entries])
    return rows


def headings(options: argparse.Namespace) -> dict[str, str]:
    """The headings of the table of each arena."""
    return {"plane": "on a table [s]", "cylinder": f"in a cylinder of {100 * options.cylinder_radius:g} cm radius [s]"}


def picture(options: argparse.Namespace, times: Times, theta: Times, plane: Table) -> "Figure":
    """theta(t) of the displayed launch, with the time at which it has turned over in the table of the plane."""
    end = float(plane.time[options.theta.index(middle(options.theta)), options.mu.index(middle(options.mu))])
    angle, start = angle_counted(options), f"{options.rpm:g} rpm, θ(0) = {middle(options.theta):g}°"
    title = f"{options.top} top, {start}, mu = {middle(options.mu):g}, on a table"
    if end <= times[-1]:
        # Between the times, theta may be above the angle only for a moment.
        index = np.searchsorted(times, end)
        times, theta = np.insert(times, index, end), np.insert(theta, index, max(angle, np.interp(end, times, theta)))
    panel = Panel(title, times, theta[None], theta[:1], np.array([end if end <= times[-1] else np.inf]))
    dot = "The dot is the first time above the dashed angle."
    if TOPS[options.top]().stem is not None:
        dot = "The dot is the time at which the stem first carries the top. On the dashed line, sphere and stem touch together."
    return draw_launches([panel], angle, dot if end <= times[-1] else f"Not turned over by {times[-1]:g} s.", "deg")


def write(options: argparse.Namespace) -> views.pages.Outputs:
    """Compute and write the tables, the picture and the page: the top with sliders if three.js is installed, the tables, and
    the picture.

    **Raises:** `ValueError` if the folder holds tables of other options.
    """
    cache = enable_compilation_cache()
    print("\n".join(described(options)), flush=True)
    require_folder(options.out, "--out")
    read = all(are_kept(cache, facts(options, arena)) for arena in ARENAS)
    paths = {arena: options.out / f"{arena}.h5" for arena in ARENAS}
    try:
        tables, pictures, live = computed(options, cache)
    except AnotherRun as error:
        advice = f"name another folder with --out, or remove {options.out}"
        raise ValueError(f"{options.out} holds another run: {error.difference}; {advice}") from None
    except KeyboardInterrupt:
        cells, total = sum(map(saved_cells, paths.values())), len(ARENAS) * len(options.theta) * len(options.mu)
        words = f"saved {cells} of {total} cells to {options.out}; run the same command again to resume"
        raise KeyboardInterrupt(words) from None
    turned_over = np.concatenate([table.status.ravel() for table in tables.values()]) == "inverted"
    claim = f"{turned_over.sum()} of {turned_over.size} tops have turned over within {options.t1:g} s."
    print(f"\n{claim} {remark(options)}", flush=True)
    sections = ""
    for arena, heading in headings(options).items():
        rows = views.pages.table_as_html(rows_of(options, tables[arena]), 1)
        sections += f"<h2>Time until it has turned over, {heading}</h2>{rows}"
    sections += "".join(f'<p class="note">{escape(line)}</p>' for line in (claim, remark(options), *described(options)))
    sections += "".join(views.pages.picture_as_html(path, "θ(t)") for path in pictures)
    path = options.out / "index.html"
    views.Page((live or views.pages.page_of_job(list, TITLE, 1.0, BELOW).html).replace(BELOW, sections)).save(path)
    return views.pages.Outputs(turned_over.size, [*paths.values(), *pictures], path, cache if read else None)


def main(arguments: list[str] | None = None) -> int:
    """Run the main job.

    **Arguments:** `arguments`: the command line, by default that of the process.

    **Returns:** the exit status: 0, or 2 for input that cannot be used.
    """
    arguments = sys.argv[1:] if arguments is None else arguments
    if "--paper" in arguments:
        return paper.main([word for word in arguments if word != "--paper"])
    options = parser().parse_args(arguments)
    return views.pages.run_job(lambda: write(options), "tippe", "To see the top move")


if __name__ == "__main__":
    run_and_exit(main, "tippe")
