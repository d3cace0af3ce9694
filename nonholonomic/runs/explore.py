"""A page with sliders that simulates any model in the browser."""

import functools
from typing import Any

from ..integration.checks import run_bounds
from ..progress import status_line
from ..validation import require_all, require_file
from ..views import Page, Stage
from ..views.explore import LiveRun, live_page
from .model import AbstractModel, model_of


@status_line("writing a page")
def explore(
    system: Any,
    start: Any,
    path: Any = None,
    sliders: dict[str, tuple[float, float]] | None = None,
    t1: float = 8.0,
    input: Any = None,
) -> Page:
    """Make a page with sliders that simulates a run in the browser while you move a slider.

    The page is one file that needs no network; a notebook shows the returned `Page`. The equations of motion, the
    Runge-Kutta pair and the step-size control are generated from those of tables, at a tolerance of 1e-7. A scene shows
    its body; your own system shows the first and the last component of its state as a point in a plane, and the curves of
    all components.

    **Arguments:**

    - `system`, `start`, `input`: as for `event_time`; the run that the page shows first.
    - `path`: file to write the page to, or `None`.
    - `sliders`: name of a parameter -> (lowest, highest) value; the end of a name is enough if only one parameter
      matches.
    - `t1`: horizon [s].

    **Returns:** a `Page`, with its `html`.

    **Raises:** `ValueError` for arguments out of range, an unknown slider, or equations with an operation of JAX that cannot
    be written in JavaScript; `ModuleNotFoundError` if the library for views is not installed; `OSError` if the file cannot be
    written.

    **Example:** a page with a slider for the drag of a ball.

    ```
    >>> import jax.numpy as jnp
    >>> import nonholonomic
    >>> class Ball(nonholonomic.AbstractMode):
    ...     drag: float = 0.1
    ...
    ...     def field(self, t, y):
    ...         return jnp.array([y[1], -9.81 - self.drag * y[1]])
    ...
    ...     def margin(self, t, y):
    ...         return y[0]
    ...
    ...     def reset(self, t, y):
    ...         return jnp.array([0.0, -0.8 * y[1]]), 0
    >>> page = nonholonomic.explore(nonholonomic.Hybrid([Ball()]), [1.0, 0.0], sliders={"drag": (0.0, 0.3)}, t1=2.0)
    >>> "range" in page.html
    True

    ```
    """
    return explore_model(model_of(system, start, None, input), path, sliders, float(t1))


def explore_model(model: AbstractModel, path: Any, sliders: Any, t1: float) -> Page:
    """The page of a model. **Arguments:** as for `explore`."""
    if path is not None:
        require_file(path, "path", ".html", ".htm")
    require_all(run_bounds(t1, 1e-9))
    model.check()
    html_page = live_page(*page_of(model, sliders, t1))
    if path is not None:
        html_page.save(path)
    return html_page


@functools.singledispatch
def page_of(model: AbstractModel, sliders: Any, t1: float) -> tuple[LiveRun, Stage]:
    """The contents of the page of a model, and the stage on which the page draws the run.

    Each kind of model registers its own function.

    **Arguments:** as for `explore`.

    **Raises:** `ValueError` for an unknown slider, and for numbers that are out of range.

    **Example:**

    >>> import jax.numpy as jnp
    >>> import nonholonomic
    >>> from nonholonomic.runs import model_of, page_of
    >>> class Decay(nonholonomic.AbstractMode):
    ...     rate: float = 2.0
    ...
    ...     def field(self, t, y):
    ...         return -self.rate * y
    >>> live, stage = page_of(model_of(nonholonomic.Hybrid([Decay()]), [1.0]), {"rate": (1.0, 3.0)}, 1.0)
    >>> [slider.label for slider in live.sliders]
    ['rate']
    """
    raise NotImplementedError(f"{type(model).__name__} has no page")
