"""Check the arguments of a ride before anything compiles."""

from typing import Any

from nonholonomic.integration.checks import require_run

from ..model.input import check_input
from ..model.launch import Launch
from ..model.scene import Scene


def check_run(scene: Any, launch: Any, t1: Any, input: Any, tolerance: Any) -> None:
    """Raise `ValueError` unless scene, launch, horizon, input and tolerance are legal and the scene can start with the
    launch."""
    lists = "axes of sweep take lists, and jax.vmap maps over them"
    require_run(scene, launch, t1, tolerance, (Scene, Launch), lists)
    scene.check(launch)
    check_input(input, scene, launch)
