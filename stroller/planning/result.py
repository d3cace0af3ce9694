"""The result of a plan."""

from collections.abc import Sequence
from typing import Any

import equinox as eqx
from jaxtyping import Array, Float

from nonholonomic.progress import status_line
from nonholonomic.text import readable_unit, require_unit
from nonholonomic.validation import require_file, require_package
from nonholonomic.views import Page, page
from nonholonomic.views.stage import curves_in

from ..runs.trajectory import Trajectory
from .check import Verdict
from .drawing import draw_plan, planned_stage
from .drive import Drive
from .problem import Problem


class Plan(eqx.Module):
    """A planned drive, its run at a tolerance of 1e-9, and what the check of this run says.

    - `input`: the input of the drive, an `equinox.Module` that `simulate`, `sweep` and `identify` accept;
    - `t1`: its duration [s]; `run`: its `Trajectory`;
    - `reached`: whether the run ends at the goal, keeps all limits, up to 0.001 of their ranges, and touches no obstacle;
    - `clearance`: least distance [m] of the footprint from an obstacle, negative for an overlap, infinite without
      obstacles;
    - `margins`: the distance of the run from each limit, by name, negative where the limit is exceeded;
    - `effort`: integral over time of F^2 + (torque / wheelbase)^2 [N^2 s];
    - `errors`: errors of place [m], heading [rad] and speed [m/s] at the end;
    - `hindrances`: what is wrong with the run, in words; empty if the goal is reached;
    - `candidates`: the paths [m] of all optimised candidates, (candidates, knots, 3), in the fixed frame.

    `print` shows the result, `plot` draws it, and `view` writes a page on which it is played.

    **Example:**

    ```
    >>> import stroller
    >>> body = stroller.Stroller(mass=5.0, wheelbase=0.25, inertia=0.1, steering_inertia=0.005)
    >>> scene = stroller.Scene(body, friction=stroller.Damping(2.0, 0.5, 0.1, 0.05))
    >>> gap = [stroller.Box((1.1, 0.3), (0.5, 0.25)), stroller.Box((2.7, 0.3), (0.5, 0.25))]
    >>> start, goal = stroller.Launch((0.7, 0.8), 0.0, 0.0), stroller.Goal((1.8, 0.3), heading=0.0)
    >>> plan = stroller.plan(scene, start, goal, 12.0, obstacles=gap, limits=stroller.Limits(steering=1.0))
    >>> print(f"{plan.run.place[-1, 0]:.1f} m, {plan.run.place[-1, 1]:.1f} m")
    1.8 m, 0.3 m

    ```
    """

    input: Drive
    t1: float
    run: Trajectory
    verdict: Verdict
    problem: Problem
    candidates: Float[Array, "candidates knots 3"]

    @property
    def reached(self) -> bool:
        return not self.verdict.hindrances

    @property
    def clearance(self) -> float:
        return self.verdict.clearance

    @property
    def margins(self) -> dict[str, float]:
        return self.verdict.margins

    @property
    def effort(self) -> float:
        return self.verdict.effort

    @property
    def errors(self) -> tuple[float, float, float]:
        return self.verdict.errors

    @property
    def hindrances(self) -> tuple[str, ...]:
        return self.verdict.hindrances

    def __str__(self) -> str:
        units = {name: readable_unit(unit) for name, unit in self.problem.limits.units.items()}
        goal, count = self.problem.goal, len(self.problem.obstacles)
        obstacles = "1 obstacle" if count == 1 else f"{count} obstacles"
        place, heading, speed = self.errors
        turn = "" if goal.heading is None else f"heading {heading:.2g} rad, "
        lines = [
            f"Plan of {self.t1:.4g} s: {'reaches the goal' if self.reached else 'does not reach the goal'}",
            f"  end        place off by {place:.2g} m, {turn}speed {speed:.2g} m/s; allowed {float(goal.within):g}",
            *([f"  clearance  {self.clearance:.3g} m from {obstacles}"] if count else []),
            *(f"  {name:9s}  margin {margin:.3g} {units[name]}".rstrip() for name, margin in self.margins.items()),
            f"  effort     {self.effort:.4g} N² s",
            f"  tried      {len(self.candidates)} candidates",
            *(f"  hindrance  {words}" for words in self.hindrances),
        ]
        return "\n".join(lines)

    def __repr__(self) -> str:
        return str(self)

    def plot(self, unit: str | Sequence[str] | None = None) -> Any:
        """Draw the plan from above, with its obstacles, footprint and candidates, and its speed and steering over time
        (needs matplotlib).

        **Arguments:** `unit`: unit of speed and steering, such as "deg", "km/h", or both.

        **Returns:** a matplotlib figure.

        **Raises:** `ValueError` for an unknown unit.
        """
        require_package("matplotlib", "plot", "plot")
        require_unit(unit)
        return draw_plan(self, unit)

    @status_line("drawing")
    def view(self, path: Any = None, unit: str | Sequence[str] | None = None) -> Page:
        """An animated page of the drive, with its obstacles, the footprint, and the candidates as thin lines (needs
        jupyter-threejs-sage).

        **Arguments:** `path`: file for the page, with a name that ends in .html, or `None`; `unit`: unit of the curves.

        **Returns:** a `Page`, which a notebook shows.

        **Raises:** `ModuleNotFoundError` if jupyter-threejs-sage is not installed, `OSError` if the file cannot be
        written, `ValueError` for another file type.
        """
        require_package("jupyter_threejs_sage", "view", "view")
        if path is not None:
            require_file(path, "path", ".html", ".htm")
        require_unit(unit)
        (stage,) = curves_in([planned_stage(self)], unit)
        html_page = page([stage], stage.title, speed=1.0)
        if path is not None:
            html_page.save(path)
        return html_page
