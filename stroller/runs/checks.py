"""Check the arguments of a ride before anything compiles."""

from typing import Any

from nonholonomic.integration import ImplicitMidpoint, require_adaptive, require_adjoint, run_bounds, times_bounds
from nonholonomic.parameters import numbers
from nonholonomic.validation import require_all, require_increasing, require_kind, require_scalars, require_whole

from ..model.input import check_input
from ..model.launch import Launch
from ..model.scene import Scene


def check_run(scene: Any, launch: Any, t1: Any, input: Any, tolerance: Any) -> None:
    """Raise `ValueError` unless scene, launch, horizon, input and tolerance are legal and the scene can start with the
    launch."""
    require_kind(scene, "scene", Scene)
    require_kind(launch, "launch", Launch)
    require_all(run_bounds(t1, tolerance))
    values = numbers("scene", scene, functions=False) | numbers("launch", launch) | {"t1": t1, "tolerance": tolerance}
    require_scalars(values, "axes of sweep take lists, and jax.vmap maps over them")
    scene.check(launch)
    check_input(input, scene, launch)


def check_times(times: Any, t1: Any) -> None:
    """Raise `ValueError` unless the times of output are an increasing list within [0, t1]."""
    require_all(times_bounds(times, t1))
    require_increasing(times, "times")


def check_options(solver: Any, max_steps: Any, adjoint: Any) -> None:
    """Raise `ValueError` unless the solver is adaptive or an `ImplicitMidpoint`, and the other options are in range."""
    if not isinstance(solver, ImplicitMidpoint):
        require_adaptive(solver, ", or an ImplicitMidpoint")
    require_whole(max_steps, "max_steps", 1)
    require_adjoint(adjoint)
