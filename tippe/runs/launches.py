"""Build and check the grid of launches and scenes of a table."""

from collections import Counter
from collections.abc import Collection
from typing import Any

import numpy as np

from nonholonomic.integration.checks import require_run
from nonholonomic.parameters import description, full_axes, numbers, with_numbers
from nonholonomic.sweeps import Axis, axis, cells_to_check, scattered_cells
from nonholonomic.validation import require_kind, shown

from ..model.launch import Launch
from ..model.scene import Scene
from ..model.top import Top
from .checks import LISTS

UNITS = Top.units | Scene.units | Launch.units

#: Descriptions of the axes.
LONG_NAMES = {
    "theta": "θ(0)",
    "eta": "η(0)",
    "azimuth": "φ(0)",
    "spin": "spin ω₃(0)",
    "mu": "friction μ",
    "mass": "mass m",
    "radius": "radius",
    "offset": "offset a",
    "equatorial": "equatorial half axis b",
    "polar": "polar half axis p",
    "I1": "moment of inertia I₁",
    "I3": "moment of inertia I₃",
    "gravity": "gravity g",
    "slip_speed": "slip speed",
    "restitution": "restitution e_N",
}

#: The parts of a launch that consist of several numbers: the name of an axis along each number, and its unit.
SEVERAL = {
    "velocity": [(f"velocity_{axis}", "m s-1") for axis in ("t1", "t2")],
    "angular_velocity": [(f"angular_velocity_{axis}", "rad s-1") for axis in ("t1", "t2", "n")],
}

#: Parameters of a launch that can be varied.
NUMBERS_OF_A_LAUNCH = [f"launch.{name}" for name in ("theta", "spin", "eta", "azimuth")]
NUMBERS_OF_A_LAUNCH += [
    f"launch.{name}[{k}]"
    for name, count in (("place", 3), ("velocity", 2), ("angular_velocity", 3))
    for k in range(count)
]


def variable_numbers(scene: Scene) -> list[str]:
    """The full names of a scene's parameters that can be varied: single numbers, including omitted ones, which are
    0."""
    names = [name for name, value in numbers("scene", scene).items() if np.ndim(value) == 0]
    return [name for name in names if name != "scene.restitution" or scene.contact == "hybrid"]


def launches(
    scene: Any,
    launch_values: dict[str, Any],
    axes: Any,
    t1: Any,
    tolerance: Any,
    taken: Collection[str] = (),
    scattered: bool = False,
) -> tuple[dict[str, Any], list[Axis], dict[str, str]]:
    """The scene and launch that all cells share, and the axes of the grid; checks the cells before anything compiles.

    **Arguments:**

    - `scene`: the scene; all its numbers must be scalars.
    - `launch_values`: parameter of the launch, or "mu" for the scene's friction -> a number or a list; `None` keeps the
      scene's own `mu`.
    - `axes`: full name of a parameter, or its unambiguous end -> values, or `None`; the numbers of a launch's vectors
      are `"launch.place[0]"` and so on; omitted numbers are 0.
    - `t1`, `tolerance`: as for `inversion_table`.
    - `taken`: names that no axis may have. An axis gets its full name if its short name is taken or not unique.
    - `scattered`: whether the lists have equal length and are combined element by element: the k-th cell has the k-th
      element of each list.

    **Returns:** a dictionary with "scene" and "launch", in which only the numbers that are not axes have their values,
    for `with_numbers`; the axes, the last varying fastest; and the units of numbers by their short names.

    **Raises:** `ValueError` for arguments out of range or an unknown axis.
    """
    require_kind(scene, "scene", Scene)
    if axes is not None and not (isinstance(axes, dict) and all(isinstance(number, str) for number in axes)):
        raise ValueError(f"axes = {shown(axes)} must be a dictionary, path of a number -> values")
    axes = full_axes(axes or {}, [*variable_numbers(scene), *NUMBERS_OF_A_LAUNCH])
    friction_numbers = numbers("scene.friction", scene.friction)
    of_mu = next((number for number in friction_numbers if number.endswith(".mu")), "scene.friction.mu")
    paths = {name: of_mu if name == "mu" else f"launch.{name}" for name in launch_values}
    values = {paths[name]: value for name, value in launch_values.items() if name != "mu" or value is not None}
    for number in values:
        if number in axes:
            raise ValueError(f"axes: {number!r} has its own argument")
    values |= axes
    scalars = {number: value for number, value in values.items() if np.ndim(value) == 0}
    launch, axes_of_lists = _with_room(scene, values)
    units = UNITS | scene.body.units | scene.friction.units | dict(axes_of_lists.values())
    names = {number: axes_of_lists.get(number, (number.rsplit(".", 1)[-1],))[0] for number in values}
    # `place` replaces the argument `eta`.
    counts = Counter(name for number, name in names.items() if number != "launch.eta" or launch.place is None)
    grid = []
    for number, name in names.items():
        if number not in scalars:
            is_unique = counts[name] == 1 and name not in taken
            unit, long_name = units.get(name, "1"), LONG_NAMES.get(name, name)
            grid.append(axis(name if is_unique else number, number, unit, values[number], long_name))
    roots = with_numbers({"scene": scene, "launch": launch}, scalars)
    # The numbers of axes are 0 here, which may not be a place on the arena; starts are checked cell by cell.
    require_run(roots["scene"], roots["launch"], t1, tolerance, (Scene, Launch), LISTS)
    # The modules check their numbers, which may be illegal only in combination.
    for cells in [scattered_cells(grid)] if scattered else cells_to_check(grid):
        looked_at = with_numbers(roots, cells)
        looked_at["scene"].check_start(looked_at["launch"])
    return roots, grid, units


def _with_room(scene: Scene, values: Collection[str]) -> tuple[Launch, dict[str, tuple[str, str]]]:
    """A launch with entries for all given numbers, and the name and unit of each number of a vector."""
    components: dict[str, tuple[str, str]] = {}
    parts: dict[str, Any] = {}
    coordinates = list(scene.surface.coordinates)
    if "launch.place[2]" in values and len(coordinates) == 2:
        coordinates = [("x", "m"), ("y", "m"), ("z", "m")]
    for name, labels in {"place": coordinates, **SEVERAL}.items():
        labelled = {f"launch.{name}[{k}]": label for k, label in enumerate(labels)}
        if not labelled.keys().isdisjoint(values):
            parts[name] = (0.0,) * len(labels)
            components |= labelled
    return Launch(theta=0.0, spin=0.0, **parts), components


def described(roots: dict[str, Any], grid: list[Axis]) -> dict[str, Any]:
    """The request for a scene and launch as plain data, without the values of axes."""
    texts = {path: value for name, root in roots.items() for path, value in description(name, root).items()}
    return texts | {grid_axis.number: "an axis" for grid_axis in grid}
