"""Checks of what is asked of a ride, before anything compiles."""

from collections.abc import Iterator
from typing import Any

import numpy as np

from nonholonomic.integration import ImplicitMidpoint, require_adaptive, require_adjoint, tolerance_bound
from nonholonomic.parameters import numbers
from nonholonomic.validation import Bound, require_all, require_increasing, require_whole

from .input import check_input
from .launch import Launch
from .scene import Scene


def check_run(scene: Any, launch: Any, t1: Any, input: Any, tolerance: Any) -> None:
    """Raise `ValueError` unless these are a scene, a launch it can start from, a positive horizon, an input, a tolerance."""
    if not isinstance(scene, Scene):
        raise ValueError(f"scene = {scene!r} must be a Scene")
    if not isinstance(launch, Launch):
        raise ValueError(f"launch = {launch!r} must be a Launch")
    require_all(run_bounds(t1, tolerance))
    values = numbers("scene", scene, functions=False) | numbers("launch", launch) | {"t1": t1, "tolerance": tolerance}
    for name, value in values.items():
        if value is not None and np.ndim(value) != 0:
            raise ValueError(f"{name} must be one number, not of shape {np.shape(value)}; axes of sweep take lists")
    scene.check(launch)
    check_input(input, scene, launch)


def check_times(times: Any, t1: Any) -> None:
    """Raise `ValueError` unless these are times of output: a list that increases, within [0, t1]."""
    require_all(times_bounds(times, t1))
    require_increasing(times, "times")


def check_options(solver: Any, max_steps: Any, adjoint: Any) -> None:
    """Raise `ValueError` unless the solver chooses its steps or is an `ImplicitMidpoint`, and the others are in range too."""
    if not isinstance(solver, ImplicitMidpoint):
        require_adaptive(solver, ", or an ImplicitMidpoint")
    require_whole(max_steps, "max_steps", 1)
    require_adjoint(adjoint)


def run_bounds(t1: Any, tolerance: Any) -> Iterator[Bound]:
    """The ranges of the horizon [s] and of the tolerance."""
    yield Bound(t1, "t1", above=0.0)
    yield tolerance_bound(tolerance)


def times_bounds(times: Any, t1: Any) -> Iterator[Bound]:
    """The range of the times of output [s]."""
    yield Bound(times, "times", at_least=0.0, at_most=t1)
