"""Pictures of a user's system: the first and the last component of its state as a point in a plane, and curves of all."""

from typing import Any

import numpy as np
from jaxtyping import Float

from ..validation import require_one_run
from ..views import COLOURS, PALE, Arena, Body, Curve, Mesh, Show, Stage, Trace

#: Half the side of the drawn plane [m], and the radius of the point and the width of its trace, in the same unit.
HALF, RADIUS, WIDTH = 1.0, 0.03, 0.012

#: Number of lines of the plane's grid in each direction.
LINES = 9


def portraits(runs: list[Any], overlaid: bool, drawn: tuple[np.ndarray, np.ndarray] | None = None) -> list[Stage]:
    """Runs as stages: one stage for each, or a common one for overlaid runs.

    **Arguments:** `drawn`: middle and scales of the drawn part of the plane, by default that of the runs.
    """
    for run in runs:
        require_one_run(run, "a picture", ", and pass the others as others=")
    groups = [list(enumerate(runs))] if overlaid else [[numbered] for numbered in enumerate(runs)]
    stages = []
    for group in groups:
        points = np.concatenate([plane_points(run) for _, run in group])
        centre, scale = frame_of(points) if drawn is None else drawn
        shows = tuple(show(run, number, centre, scale) for number, run in group)
        names = group[0][1].portrait_axes
        stages.append(Stage(f"{names[1]} over {names[0]}", plane(scale), shows))
    return stages


def plane_points(run: Any) -> Float[np.ndarray, "times 2"]:
    """The drawn components of a run."""
    return np.stack([np.asarray(run[name], float) for name in run.portrait_axes], axis=-1)


def frame_of(points: Float[np.ndarray, "points 2"]) -> tuple[np.ndarray, np.ndarray]:
    """The middle of some points, and the factors that scale them to the drawn plane."""
    points = points[np.all(np.isfinite(points), axis=-1)]
    low, high = points.min(axis=0), points.max(axis=0)
    span = np.where(high > low, high - low, 1.0)
    return 0.5 * (low + high), 1.8 * HALF / span


def show(run: Any, number: int, centre: np.ndarray, scale: np.ndarray) -> Show:
    """The drawing of one run, the `number`-th of all."""
    colour = COLOURS[number % len(COLOURS)]
    is_reached = np.all(np.isfinite(np.asarray(run.state)), axis=-1)
    points = ((plane_points(run) - centre) * scale)[is_reached]
    position = np.concatenate([points, np.full((len(points), 1), RADIUS)], axis=-1)
    upright, ball = np.tile([0.0, 0.0, 0.0, 1.0], (len(points), 1)), octahedron(colour)
    curves = tuple(Curve(name, np.asarray(run[name])[is_reached]) for name in run.names)
    trace = Trace(" over ".join(run.portrait_axes[::-1]), position, colour, WIDTH)
    normal = np.tile([0.0, 0.0, 1.0], (len(points), 1))
    body = Body("state", position, upright, (ball,))
    return Show(f"run {number + 1}", colour, np.asarray(run.t)[is_reached], normal, HALF, (body,), (trace,), (), curves)


def octahedron(colour: int) -> Mesh:
    """The drawn point."""
    vertices = RADIUS * np.concatenate([np.eye(3), -np.eye(3)])
    corners = [(0, 1, 2), (1, 3, 2), (3, 4, 2), (4, 0, 2), (1, 0, 5), (3, 1, 5), (4, 3, 5), (0, 4, 5)]
    return Mesh(vertices, np.array(corners), colour)


def plane(scale: np.ndarray) -> Arena:
    """The drawn part of the plane, with lines at a spacing that is named."""
    corners = HALF * np.array([(-1.0, -1.0, 0.0), (1.0, -1.0, 0.0), (1.0, 1.0, 0.0), (-1.0, 1.0, 0.0)])
    places = HALF * np.linspace(-1.0, 1.0, LINES)
    ends = HALF * np.array([-1.0, 1.0])
    lines = [np.stack([np.full(2, place), ends, np.zeros(2)], axis=-1) for place in places]
    lines += [np.stack([ends, np.full(2, place), np.zeros(2)], axis=-1) for place in places]
    spacing = 2.0 * HALF / (LINES - 1) / scale
    text = f"{spacing[0]:.3g} by {spacing[1]:.3g}"
    mesh = Mesh(corners, np.array([(0, 1, 2), (0, 2, 3)]), PALE)
    return Arena(mesh, tuple(lines), text, np.array([0.0, 0.0, 1.0]))
