"""The grid of launches and scenes that a table is asked for, made of its arguments and checked."""

from collections.abc import Collection
from typing import Any

import numpy as np

from nonholonomic.parameters import description, numbers, with_numbers
from nonholonomic.sweeps import Axis, axis, cells_to_check

from .inversion import check_run
from .launch import Launch
from .scene import Scene

UNITS = {"mass": "kg", "radius": "m", "offset": "m", "I1": "kg m2", "I3": "kg m2", "gravity": "m s-2"}
UNITS |= {"theta": "rad", "eta": "rad", "azimuth": "rad", "spin": "rad s-1"}


def launches(
    scene: Any, given: dict[str, Any], axes: Any, t1: Any, tolerance: Any, taken: Collection[str] = ()
) -> tuple[dict[str, Any], list[Axis], dict[str, str]]:
    """The scene and launch that all cells share, and the axes of the grid, its cells checked before anything compiles.

    **Arguments:**

    - `scene`: the scene, every number a scalar.
    - `given`: number of the launch, or "mu" for the scene's friction, its own if `None` -> a number or a list.
    - `axes`: path of a number -> values, or `None`.
    - `t1`, `tolerance`: as for `inversion_table`.
    - `taken`: names that no axis may have; it then goes by its path, as do axes that would share a name.

    **Returns:** "scene" and "launch" with the numbers that are no axes, for `with_numbers`; the axes, the last varying
    fastest; and the units of numbers by their short names.

    **Raises:** `ValueError` for arguments out of range or an unknown axis.
    """
    if not isinstance(scene, Scene):
        raise ValueError(f"scene = {scene!r} must be a Scene")
    if axes is not None and not isinstance(axes, dict):
        raise ValueError(f"axes = {axes!r} must be a dictionary, path of a number -> values")
    known = numbers("scene.friction", scene.friction)
    of_mu = next((number for number in known if number.endswith(".mu")), "scene.friction.mu")
    paths = {name: of_mu if name == "mu" else f"launch.{name}" for name in given}
    values = {paths[name]: value for name, value in given.items() if name != "mu" or value is not None}
    for number in values:
        if number in (axes or {}):
            raise ValueError(f"axes: {number!r} is an argument of its own")
    values |= axes or {}
    fixed = {number: value for number, value in values.items() if np.ndim(value) == 0}
    names = [number.rsplit(".", 1)[-1] for number in values]
    units = UNITS | scene.friction.units
    grid = []
    for number, name in zip(values, names, strict=True):
        if number not in fixed:
            alone = names.count(name) == 1 and name not in taken
            grid.append(axis(name if alone else number, number, units.get(name, "1"), values[number]))
    roots = with_numbers({"scene": scene, "launch": Launch(theta=0.0, spin=0.0)}, fixed)
    check_run(roots["scene"], roots["launch"], t1, tolerance)
    # The modules check their numbers, which may be impossible only together.
    for cells in cells_to_check(grid):
        with_numbers(roots, cells)
    return roots, grid, units


def described(roots: dict[str, Any], grid: list[Axis]) -> dict[str, Any]:
    """What is asked of which scene and launch, as plain data; the values of axes stand elsewhere."""
    found = {path: told for name, root in roots.items() for path, told in description(name, root).items()}
    return found | {one.number: "an axis" for one in grid}
