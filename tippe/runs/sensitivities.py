"""Derivatives of the inversion times of a table's cells with respect to parameters of the scene and the launch."""

from typing import Any

import numpy as np

from nonholonomic.parameters import full_name, numbers
from nonholonomic.sweeps import Variable
from nonholonomic.validation import shown


def sensitivity_names(roots: dict[str, Any], names: Any) -> list[str]:
    """The full names of the parameters with respect to which to differentiate.

    **Arguments:** `roots`: the table's scene and launch; `names`: full names, or ends of names that are unique.

    **Raises:** `ValueError` unless `names` is a list of such names.
    """
    if not isinstance(names, list | tuple) or not all(isinstance(name, str) for name in names):
        raise ValueError(f"sensitivities = {shown(names)} must be a list of names, such as ['scene.friction.mu']")
    number_names = [
        name for root, tree in roots.items() for name, value in numbers(root, tree).items() if value is not None
    ]
    full_names = [full_name("sensitivities", name, number_names) for name in names]
    if len(set(full_names)) < len(full_names):
        raise ValueError(f"sensitivities = {shown(names)} must name every parameter only once")
    return full_names


def sensitivity_columns(names: list[str]) -> list[str]:
    """The table's variables: `time_by_mu` for `scene.friction.mu`, the full name if two parameters share a name."""
    ends = [name.rsplit(".", 1)[-1] for name in names]
    return [
        "time_by_" + (end if ends.count(end) == 1 else name.replace(".", "_"))
        for name, end in zip(names, ends, strict=True)
    ]


def sensitivity_variables(names: list[str], units: dict[str, str], event: str = "inversion") -> dict[str, Variable]:
    """The table's variables, with their units; `event`: description of the event."""

    def unit(name: str) -> str:
        of_number = units.get(name.rsplit(".", 1)[-1], "1")
        return "s" if of_number == "1" else f"s ({of_number})-1"

    return {
        slope: Variable(unit(name), np.float64, long_name=f"{event} time by {name}")
        for slope, name in zip(sensitivity_columns(names), names, strict=True)
    }
