"""The main job, `python -m tippe`: a wooden top that climbs onto its stem, on a table and in a cylinder."""

import argparse
import functools
import json
import math
import sys
import time
from concurrent.futures import ThreadPoolExecutor, as_completed
from html import escape
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np

from nonholonomic import __version__
from nonholonomic.command_line import closing_lines, run_and_exit
from nonholonomic.compilation.cache import are_kept, enable_compilation_cache, kept_files
from nonholonomic.geometry import Cylinder, Plane
from nonholonomic.sweeps import AnotherRun, Table, saved_cells
from nonholonomic.terminal import Progress
from nonholonomic.validation import replacing, require_folder
from nonholonomic.views import NO_VIEW, Page, can_view, page, picture_as_html, table_as_html
from nonholonomic.views.explore import live_page

from . import paper, presets, steady
from .friction import Coulomb
from .model.scene import Launch, Scene
from .runs.launches import INVERTED
from .runs.model import TopModel
from .runs.verbs import inversion_table
from .runs.view import Panel, draw_launches, page_of_launch, stage_at_start, theta_over_time

TOPS = {top.__name__: top for top in (presets.wooden, presets.rutstam, presets.cohen, presets.leine_glocker)}

#: The arenas, which name the files of the tables.
ARENAS = ("plane", "cylinder")

#: Times at which theta is drawn, close enough to show nutation, and duration of the displayed run [s].
SAMPLES, SHOWN = 2048, 5.0

#: The page's title, and the placeholder for the contents below the top.
TITLE, BELOW = "A tippe top climbs onto its stem", "<!-- below -->"

#: The words for the end of a run, as in the table.
WORDS = {"not_inverted": "not in time", "contact_lost": "lost contact", "does_not_fit": "no room"}


def parser() -> argparse.ArgumentParser:
    """The options of the main job."""
    command = argparse.ArgumentParser(
        prog="python -m tippe",
        description="A tippe top turns over, through flights and onto its stem. Computes inversion times over the inclination "
        "and the friction, on a table and in a cylinder. Writes HDF5 tables, a picture, and a page on which the top climbs "
        "onto its stem. `python -m tippe --paper --help` describes the tables of the papers.",
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
    command.add_argument(
        "--out", type=Path, default=Path("tippe-out"), help="folder for the tables, the picture and the page"
    )
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
    return f"A top has turned over when its stem first carries it; on a table the stem touches at {angle}."


def angle_counted(options: argparse.Namespace) -> float:
    """The inclination [rad] beyond which the top has turned over on a table."""
    top = TOPS[options.top]()
    return INVERTED if top.stem is None else float(top.stem_angle)


def middle(values: list[float]) -> float:
    """The middle one of some values."""
    return sorted(values)[len(values) // 2]


def described(options: argparse.Namespace) -> list[str]:
    """A description of the job, in some lines."""
    top, mm = TOPS[options.top](), lambda length: f"{1e3 * float(length):.3g} mm"
    alpha, gamma = steady.proportions(top)
    stem = "no stem" if top.stem is None else f"a stem {mm(2.0 * top.stem.radius)} thick"
    launch = Launch.degrees(middle(options.theta), options.rpm)
    return [
        f"A {options.top} top: {1e3 * float(top.mass):.3g} g, {mm(2.0 * top.radius)} across, {stem}, "
        f"its centre of mass {mm(top.offset)} below the centre.",
        f"I1 / I3 = {float(gamma):.3f} lies {'' if steady.group(top) == 'II' else 'not '}between 1 - a / R = "
        f"{1.0 - float(alpha):.3f} and 1 + a / R = {1.0 + float(alpha):.3f}, so it can "
        f"{'' if steady.group(top) == 'II' else 'not '}turn over.",
        f"Spun at {options.rpm:g} rpm ({float(launch.spin):.4g} rad/s), inclined by theta(0); Coulomb friction mu.",
    ]


def facts(options: argparse.Namespace, kind: str) -> Any:
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
    t1 = min(SHOWN, options.t1)
    return live_page(page_of_launch(model, None, t1)._replace(title=TITLE), stage_at_start(model, t1), 0.2, BELOW).html


def computed(options: argparse.Namespace, cache: Path | None) -> tuple[dict[str, Table], Path | None, str]:
    """The table of each arena, the picture of the displayed launch if matplotlib is installed, and the page with sliders.
    Each table is printed as soon as it is computed, that of the plane first.

    They are computed in parallel, because the compiler uses little more than one core. **Arguments:** `cache`: folder for
    results that later commands with the same options read.
    """
    times = np.linspace(0.0, min(SHOWN, options.t1), SAMPLES)
    display, unprinted, reports = Progress(3, "job", "compiling"), list(ARENAS), {}

    def table_of(arena: str) -> Table:
        result = table(options, arena, cache)
        # One thread at a time.
        with display.aside():
            reports[arena] = report(options, arena, result)
            while unprinted and unprinted[0] in reports:
                print(reports[unprinted.pop(0)], flush=True)
        return result

    def angles() -> dict[str, bytes]:
        run, axes = (scene(options, "plane"), launch_shown(options)), ("launch.theta", "scene.friction.mu")
        return {"theta": json.dumps(theta_over_time(*run, times, options.tolerance, axes).tolist()).encode()}

    def on_plane() -> tuple[Table, Path | None]:
        # Compute the table first, because the picture uses its programs.
        plane = table_of("plane")
        if not has_matplotlib():
            return plane, None
        theta = json.loads(kept_files(cache, facts(options, "theta"), angles)["theta"])
        cell = options.theta.index(middle(options.theta)), options.mu.index(middle(options.mu))
        path = options.out / "theta.png"
        # Drawn while other threads compile.
        picture(options, times, np.array(theta), float(plane.time[cell])).savefig(path, dpi=130)
        return plane, path

    def live() -> str:
        if not can_view():
            return ""
        return kept_files(cache, facts(options, "page"), lambda: {"page": sliders(options).encode()})["page"].decode()

    jobs = (lambda: table_of("cylinder"), on_plane, live)
    threads = ThreadPoolExecutor(2)
    try:
        with display:
            display.begin()
            futures: list[Any] = [threads.submit(job) for job in jobs]
            for future in as_completed(futures):
                future.result()
                display.advance(1)
    finally:
        # After Ctrl-C, the process ends while the compiler is working, which nothing can interrupt.
        threads.shutdown(wait=False, cancel_futures=True)
    cylinder, (plane, drawing), html = (future.result() for future in futures)
    return {"plane": plane, "cylinder": cylinder}, drawing, html


def has_matplotlib() -> bool:
    """Whether pictures can be drawn."""
    return find_spec("matplotlib") is not None


def saved(options: argparse.Namespace) -> str:
    """Message after Ctrl-C."""
    cells = sum(saved_cells(options.out / f"{arena}.h5") for arena in ARENAS)
    total = len(ARENAS) * len(options.theta) * len(options.mu)
    return f"saved {cells} of {total} cells to {options.out}; run the same command again to resume"


def rows_of(options: argparse.Namespace, table: Table) -> list[list[str]]:
    """The entries of a table, numbers or words, under its two headings."""
    rows = [["theta(0)", *(f"mu = {mu:g}" for mu in options.mu)]]
    for theta, times, words in zip(options.theta, table.time, table.status, strict=True):
        entries = [f"{t:.2f}" if math.isfinite(t) else str(WORDS.get(w, w)) for t, w in zip(times, words, strict=True)]
        rows.append([f"{theta:g} deg", *entries])
    return rows


def headings(options: argparse.Namespace) -> dict[str, str]:
    """The headings of the table of each arena."""
    return {
        "plane": "on a table [s]",
        "cylinder": f"in a cylinder of {100.0 * options.cylinder_radius:g} cm radius [s]",
    }


def report(options: argparse.Namespace, arena: str, table: Table) -> str:
    """The table of an arena as text."""
    rows = rows_of(options, table)
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    lines = ["  ".join(entry.rjust(width) for entry, width in zip(row, widths, strict=True)) for row in rows]
    return "\n".join(["", f"Time until it has turned over, {headings(options)[arena]}", *lines])


def picture(options: argparse.Namespace, times: Any, theta: Any, end: float) -> Any:
    """theta(t) of the displayed launch, which has turned over at `end` [s]."""
    angle, start = angle_counted(options), f"{options.rpm:g} rpm, θ(0) = {middle(options.theta):g}°"
    title = f"{options.top} top, {start}, mu = {middle(options.mu):g}, on a table"
    if end <= times[-1]:
        # Between the times, theta may be above the angle only for a moment.
        index = np.searchsorted(times, end)
        times, theta = np.insert(times, index, end), np.insert(theta, index, max(angle, np.interp(end, times, theta)))
    panel = Panel(title, times, theta[None], theta[:1], np.array([end if end <= times[-1] else np.inf]))
    dot = "is the first time above the dashed angle."
    if TOPS[options.top]().stem is not None:
        dot = "is the time at which the stem first carries the top. On the dashed line, sphere and stem touch together."
    return draw_launches([panel], angle, f"The dot {dot}")


def write_page(options: argparse.Namespace, arenas: dict[str, Table], live: str, drawing: Path | None) -> Path:
    """Write the page of the main job: the top with sliders if three.js is installed, the tables, and the plot, if
    any."""
    sections = ""
    for name, heading in headings(options).items():
        sections += f"<h2>Time until it has turned over, {heading}</h2>" + table_as_html(
            rows_of(options, arenas[name]), 1
        )
    sections += "".join(f'<p class="note">{escape(line)}</p>' for line in (remark(options), *described(options)))
    sections += "" if drawing is None else "<h2>θ(t)</h2>" + picture_as_html(drawing)
    path = options.out / "index.html"
    html = live or page([], TITLE, 1.0, f'<p class="note">{NO_VIEW}</p>', BELOW).html
    Page(html.replace(BELOW, sections)).save(path)
    return path


def main(arguments: list[str] | None = None) -> int:
    """Run the main job.

    **Arguments:** `arguments`: the command line, by default that of the process.

    **Returns:** the exit status: 0, or 2 for input that cannot be used.
    """
    arguments = sys.argv[1:] if arguments is None else arguments
    if "--paper" in arguments:
        return paper.main([word for word in arguments if word != "--paper"])
    options = parser().parse_args(arguments)
    cache = enable_compilation_cache()
    start_time = time.perf_counter()
    try:
        print("\n".join(described(options)), flush=True)
        require_folder(options.out, "--out")
        read = all(are_kept(cache, facts(options, arena)) for arena in ARENAS)
        arenas, drawing, live = computed(options, cache)
        print(f"\n{remark(options)}", flush=True)
        paths = [options.out / f"{arena}.h5" for arena in arenas]
        if drawing is None:
            print("No picture: matplotlib is not installed (pip install 'nonholonomic[plot]').", file=sys.stderr)
        else:
            paths.append(drawing)
        path = write_page(options, arenas, live, drawing)
    except AnotherRun as error:
        advice = f"name another folder with --out, or remove {options.out}"
        print(f"python -m tippe: {options.out} holds another run: {error.difference}; {advice}", file=sys.stderr)
        return 2
    except (ValueError, OSError) as error:
        print(f"python -m tippe: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        raise KeyboardInterrupt(saved(options)) from None
    cells = sum(table.status.size for table in arenas.values())
    see = f"To see the top climb onto its stem, open {path}{'' if can_view() else f'. {NO_VIEW}'}"
    print(closing_lines(cells, start_time, paths, see, cache if read else None))
    return 0


if __name__ == "__main__":
    run_and_exit(main, "tippe")
