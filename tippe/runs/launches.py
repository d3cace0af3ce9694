"""Build and check the grid of launches and scenes of a table."""

from collections import Counter
from collections.abc import Collection, Iterable
from typing import Any

import numpy as np

from nonholonomic.integration.checks import require_run
from nonholonomic.parameters import full_axes, numbers, with_numbers
from nonholonomic.sweeps import Axis, axis
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


def labels(
    scene: Scene, launch: Launch, names: Iterable[str], taken: Collection[str]
) -> dict[str, tuple[str, str, str]]:
    """For each full name of a parameter the name of an axis, its unit, and a description. The name of the axis is the last
    part of the full name, or the full name if another of the `names` has the same last part or if it is `taken`."""
    coordinates = list(scene.surface.coordinates)
    if "launch.place[2]" in numbers("launch", launch) and len(coordinates) == 2:
        coordinates = [("x", "m"), ("y", "m"), ("z", "m")]
    components = {
        f"launch.{name}[{k}]": label
        for name, parts in {"place": coordinates, **SEVERAL}.items()
        for k, label in enumerate(parts)
    }
    units = UNITS | scene.body.units | scene.friction.units
    shorts = {name: name.rsplit(".", 1)[-1] for name in names}
    shorts |= {name: label for name, (label, _) in components.items() if name in shorts}
    # `place` replaces the argument `eta`.
    counts = Counter(short for name, short in shorts.items() if name != "launch.eta" or launch.place is None)
    return {
        name: (
            short if counts[short] == 1 and short not in taken else name,
            components[name][1] if name in components else units.get(short, "1"),
            LONG_NAMES.get(short, short),
        )
        for name, short in shorts.items()
    }


def launches(
    scene: Any, launch_values: dict[str, Any], axes: Any, t1: Any, tolerance: Any, taken: Collection[str] = ()
) -> tuple[dict[str, Any], list[Axis]]:
    """The scene and launch that all cells share, and the axes of the grid.

    **Arguments:**

    - `scene`: the scene; all its numbers must be scalars.
    - `launch_values`: parameter of the launch, or "mu" for the scene's friction -> a number or a list; `None` keeps the
      scene's own `mu`.
    - `axes`: full name of a parameter, or its unambiguous end -> values, or `None`; the numbers of a launch's vectors
      are `"launch.place[0]"` and so on; omitted numbers are 0.
    - `t1`, `tolerance`: as for `inversion_table`.
    - `taken`: names that no axis may have, as for `labels`.

    **Returns:** a dictionary with "scene" and "launch", in which only the numbers that are not axes have their values,
    for `with_numbers`; and the axes, the last varying fastest.

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
    launch = _with_room(scene, values)
    names = labels(scene, launch, values, taken)
    listed = [(number, *names[number]) for number in values if number not in scalars]
    grid = [axis(name, number, unit, values[number], long_name) for number, name, unit, long_name in listed]
    roots = with_numbers({"scene": scene, "launch": launch}, scalars)
    # The numbers of axes are 0 here, which may not be a place on the arena; starts are checked cell by cell.
    require_run(roots["scene"], roots["launch"], t1, tolerance, (Scene, Launch), LISTS)
    return roots, grid


def _with_room(scene: Scene, values: Collection[str]) -> Launch:
    """A launch with entries for all given numbers."""
    sizes = {name: len(parts) for name, parts in SEVERAL.items()}
    sizes["place"] = 3 if "launch.place[2]" in values else len(scene.surface.coordinates)
    parts = {
        name: (0.0,) * size for name, size in sizes.items() if any(f"launch.{name}[{k}]" in values for k in range(size))
    }
    return Launch(theta=0.0, spin=0.0, **parts)
