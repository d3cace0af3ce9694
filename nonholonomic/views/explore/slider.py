"""The sliders of a page: parameters of a scene and a launch, and the ranges in which they can be set."""

import math
from typing import Any, NamedTuple

import numpy as np

from ...parameters import full_name, numbers, readable_unit, with_numbers
from ...validation import shown

#: Parameters that change the drawn meshes.
DRAWN = ("scene.surface.", "scene.body.radius", "scene.body.equatorial", "scene.body.polar", "scene.body.wheelbase")


class Slider(NamedTuple):
    """A slider: its `name` in the page's address, the `path` of its parameter, a `label`, its unit, its range and its value."""

    name: str
    path: str
    label: str
    unit: str
    low: float
    high: float
    value: float


def sliders_of(
    ranges: Any, roots: dict[str, Any], labels: dict[str, str], units: dict[str, str], drawn: tuple[str, ...] = ()
) -> tuple[Slider, ...]:
    """The sliders for the ranges that a user passes.

    **Arguments:**

    - `ranges`: name of a parameter -> (lowest, highest) value.
    - `roots`: "scene" and "launch".
    - `labels`, `units`: labels and units of parameters, by their full or their short names.
    - `drawn`: parameters, in addition to `DRAWN`, that change the drawn meshes.

    **Raises:** `ValueError` for an unknown name, an illegal range, and numbers that the modules do not allow.
    """
    if not (isinstance(ranges, dict) and ranges and all(isinstance(name, str) for name in ranges)):
        raise ValueError(
            f"sliders = {shown(ranges)} must be a dictionary, name of a parameter -> (low, high), such as "
            '{"theta": (0.05, 0.5)}'
        )
    values = {path: value for root, tree in roots.items() for path, value in numbers(root, tree).items()}
    scalars = [path for path, value in values.items() if value is not None and np.ndim(value) == 0]
    sliders = []
    for name, ends in ranges.items():
        path = full_name("sliders", name, scalars)
        low, high = _ends(name, ends)
        if path.startswith((*DRAWN, *drawn)):
            raise ValueError(
                f"sliders[{name!r}]: {path} changes the drawn arena or body, which a page cannot change; "
                "write a page for each value"
            )
        value, label_name = float(values[path]), path.rsplit(".", 1)[-1]
        if not low <= value <= high:
            raise ValueError(
                f"sliders[{name!r}] = {shown(ends)} must contain the parameter's own value, {value:g}: the page starts there"
            )
        for end in (low, high):
            # The modules check the number.
            with_numbers(roots, {path: end})
        unit = readable_unit(units.get(path, units.get(label_name, "1")))
        label = labels.get(path, labels.get(label_name, label_name.replace("_", " ")))
        sliders.append(Slider(name, path, label, unit, low, high, value))
    return tuple(sliders)


def ends_of(sliders: tuple[Slider, ...]) -> list[tuple[str, float]]:
    """The path of every slider with each end of its range."""
    return [(slider.path, end) for slider in sliders for end in (slider.low, slider.high)]


def _ends(name: str, ends: Any) -> tuple[float, float]:
    try:
        low, high = (float(end) for end in ends)
    except (TypeError, ValueError):
        low, high = math.nan, math.nan
    if not (math.isfinite(low) and math.isfinite(high) and low < high):
        raise ValueError(f"sliders[{name!r}] = {shown(ends)} must be two numbers, (low, high), with low < high")
    return low, high
